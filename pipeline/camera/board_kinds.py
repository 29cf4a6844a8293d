"""Known points of a printed board of any kind: ChArUco corners, centres of a grid's markers, corners of a chessboard.

All have the outer corner of the first cell as origin, x along the first row, y down the print. A grid's points are the
centres of its markers, where the diagonals cross: refinements of OpenCV move a marker's corners inwards by up to 1 % of
its side, all alike, and leave its centre. A chessboard has no ids: it must be seen whole, its first square is black,
and one of even + even or odd + odd squares looks the same when turned by 180 degrees, which a lens does not mind and a
pose does.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.opencv_bridge import Sightings, board_sightings, markers_px, ours, repeated, shrunk, theirs
from pipeline.camera.opencv_bridge import dictionary as dictionary_of
from pipeline.conventions import WORLD_FROM_BOARD, transform_points
from pipeline.run.errors import ManifestError
from pipeline.types import Camera

LEAST_WINDOW, LARGEST_WINDOW = 2, 11  # half size of the window of a corner, px
REACH = 0.35  # of it, in squares: the next corner stays outside


def kind_of(board: dict[str, Any]) -> str:
    """charuco, grid or chessboard."""
    return str(board.get("kind", "charuco"))


def points_on(board: dict[str, Any]) -> int:
    """How many points of known place the board has."""
    across, down = board["squares"]
    return int(across * down) if kind_of(board) == "grid" else int((across - 1) * (down - 1))


def turns_alike(board: dict[str, Any]) -> bool:
    """Whether the board looks the same from two sides: a chessboard of even + even or odd + odd squares."""
    return kind_of(board) == "chessboard" and sum(board["squares"]) % 2 == 0


def sightings_of(
    picture: np.ndarray, precise: np.ndarray, board: dict[str, Any], camera: Camera | None = None
) -> Sightings:
    """Points of the stated board in a picture (H, W) uint8; ``precise``, ``camera``: as for `board_sightings`."""
    if kind_of(board) == "grid":
        return grid_sightings(picture, board)
    if kind_of(board) == "chessboard":
        return chessboard_sightings(picture, precise, board)
    return board_sightings(picture, precise, board, camera)


def grid_sightings(picture: np.ndarray, board: dict[str, Any]) -> Sightings:
    """Centres of the markers of a grid of ArUco markers or AprilTags; those seen twice are left out and named."""
    across, down = board["squares"]
    first, held = board.get("first_id", 0), len(dictionary_of(board["dictionary"]).bytesList)
    if first + across * down > held:
        last = first + across * down - 1
        raise ManifestError(
            f"board: needs marker ids up to {last}; {board['dictionary']} holds {held}; expected a larger one"
        )
    ids, quads = markers_px(picture, board["dictionary"])
    mine = (ids >= first) & (ids < first + across * down)
    ids, quads = ids[mine] - first, quads[mine]
    twice = repeated(quads, ids)
    _, single = np.unique(ids, return_index=True)
    single = single[~np.isin(ids[single], twice)]
    flat = np.stack([ids % across + 0.5, ids // across + 0.5, 0.0 * ids], -1)[single] * board["square_m"]
    px = _crossings(quads[single])
    world_m = transform_points(WORLD_FROM_BOARD, flat.reshape(-1, 3))
    return Sightings(world_m, px, ids[single], len(ids), tuple(first + i for i in twice))


def _crossings(quads: np.ndarray) -> np.ndarray:
    """Where the diagonals (N, 2) of quadrilaterals (N, 4, 2) cross: the pictures of squares' centres."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    along, across, off = c - a, b - d, b - a
    turned = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    share = (off[:, 0] * across[:, 1] - off[:, 1] * across[:, 0]) / np.where(turned == 0, 1.0, turned)
    return np.asarray(a + share[:, None] * along)


def chessboard_sightings(picture: np.ndarray, precise: np.ndarray, board: dict[str, Any]) -> Sightings:
    """Inner corners of a chessboard that is seen whole; none when it is not found.

    The order follows the black first square; where the board turns alike either order may come.
    """
    import cv2

    none = Sightings(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, int), 0)
    across, down = (n - 1 for n in board["squares"])
    small, step = shrunk(picture)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    for size in dict.fromkeys([(across, down), (down, across)]):  # a board on its side
        found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
        if found:
            break
    else:
        return none
    rough = (ours(corners) * step).reshape(size[1], size[0], 2)
    if size != (across, down):
        rough = rough.transpose(1, 0, 2)
    rough = _ordered(rough, picture)
    px = _refined(precise, rough)
    columns, rows = np.meshgrid(np.arange(1, across + 1), np.arange(1, down + 1))
    flat = np.stack([columns, rows, 0 * rows], -1).reshape(-1, 3) * board["square_m"]
    return Sightings(transform_points(WORLD_FROM_BOARD, flat), px.reshape(-1, 2), np.arange(len(flat)), 0)


def _ordered(corners: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Corners (R, C, 2) px so that x runs to the right of y down the print, and the first square is black if it can."""
    right, below = corners[0, -1] - corners[0, 0], corners[-1, 0] - corners[0, 0]
    if right[0] * below[1] - right[1] * below[0] < 0:  # as seen from behind
        corners = corners[:, ::-1]
    turned = corners[::-1, ::-1]
    return corners if _first_is_black(corners, picture) or not _first_is_black(turned, picture) else turned


def _first_is_black(corners: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the cells of the colour of the first square are the dark ones; all cells between corners vote."""
    middle = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
    at = np.clip(np.round(theirs(middle)).astype(int), 0, np.array(picture.shape[::-1]) - 1)
    value = picture[at[:, 1], at[:, 0]].reshape(middle.shape[:2]).astype(float)
    row, column = np.indices(value.shape)
    same = (row + column) % 2 == 0  # the cell between the first four corners is square (1, 1), coloured as (0, 0)
    return bool(value[same].mean() < value[~same].mean())


def _refined(precise: np.ndarray, rough: np.ndarray) -> np.ndarray:
    """Sub-pixel corners (R, C, 2) in windows that hold no second corner; one that runs away keeps its start."""
    import cv2

    sides = [np.linalg.norm(np.diff(rough, axis=axis), axis=-1) for axis in (0, 1)]
    window = int(np.clip(REACH * min(float(side.min()) for side in sides), LEAST_WINDOW, LARGEST_WINDOW))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    start = np.ascontiguousarray(theirs(rough), np.float32).reshape(-1, 1, 2)
    found = ours(cv2.cornerSubPix(np.ascontiguousarray(precise), start, (window, window), (-1, -1), criteria))
    found = found.reshape(rough.shape)
    return np.where(np.abs(found - rough).max(-1, keepdims=True) <= window, found, rough)
