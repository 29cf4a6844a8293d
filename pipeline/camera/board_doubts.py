"""Why a board or marker is not what the manifest says: each answer is half a line that ends an error or a warning.

Looked at only once something has failed, as the search over all families of markers costs ten times what one does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from pipeline.camera.board_families import Layout, find_markers, layout_of
from pipeline.camera.board_kinds import kind_of, points_on, turns_alike
from pipeline.camera.lens import pixel_rays, project, unproject
from pipeline.camera.markers import tone
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.reprojection import Bundle, Corners
from pipeline.camera.rigid import camera_points, umeyama
from pipeline.camera.sights import FEWEST_CORNERS, eight_bit, sighted_board, sighted_marker
from pipeline.conventions import WORLD_FROM_BOARD, transform_points
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, View

FEW = 4  # markers: fewer may be texture that reads as one
TWICE = 2  # ids: one may be texture that reads as a marker
LOOKED_AT = 3  # pictures
SQUARE = 0.02  # how far the sides of a marker that lies on the plane differ, of their mean
SIZE_TOLERANCE = 0.01  # what printers do
CORNER_PX = 0.1
CUT = 0.02  # of the board's outline outside the frame


def of_board(pictures: Sequence[np.ndarray], board: dict[str, Any]) -> str:
    """What pictures (H, W) uint8 show instead of the stated ChArUco board; empty when it is that board, or nothing."""
    pictures = list(pictures)[:LOOKED_AT]
    layout = layout_of([find_markers(picture) for picture in pictures])
    if layout is None or len(layout.ids) < FEW:
        return _mirrored(pictures)
    if layout.name and layout.name != board.get("layout"):
        return f'its markers are those of insitu board: [board] layout = "{layout.name}"'
    if layout.kind in ("charuco", "grid") and (layout.kind != kind_of(board) or not _is_stated(layout, board)):
        return f"what it shows fits {_spelled(layout)}"
    if layout.kind == "unknown" and not _same_family(layout, board["dictionary"]):
        return f"its markers are of {layout.dictionary}, [board] says {board['dictionary']}"
    return ""


def of_marker(picture: np.ndarray, marker: dict[str, Any]) -> str:
    """What a picture (H, W) uint8 shows instead of the stated marker; empty when nothing can be said."""
    seen = find_markers(picture)
    if not len(seen.ids):
        return _mirrored([picture])
    layout = layout_of([seen])
    assert layout is not None
    if _same_family(layout, marker["dictionary"]) and marker["id"] in layout.ids:
        return ""
    ids = ", ".join(str(i) for i in layout.ids[:6]) + (", ..." if len(layout.ids) > 6 else "")
    return f"it shows {layout.dictionary}, id {ids}; [marker] says {marker['dictionary']}, id {marker['id']}"


def instead(facts: dict[str, Any], pictures: Iterable[np.ndarray]) -> str:
    """What pictures (H, W) of linear radiance show instead of the stated board or first marker; empty for nothing.

    The first few are looked at, up to the first that shows any marker.
    """
    for radiance in islice(pictures, LOOKED_AT):
        picture = eight_bit(tone(radiance))
        note = of_board([picture], facts["board"]) if facts.get("board") else of_marker(picture, facts["marker"][0])
        if note:
            return note
    return ""


def sighted(facts: dict[str, Any], route: str, radiance: np.ndarray, camera: Camera) -> Sightings:
    """Corners of the stated board or first marker in linear radiance (H, W), with a note on what is shown instead.

    ``route``: charuco or marker. Raises CaptureError for a board or marker that is seen twice.
    """
    if route == "marker":
        marker = facts["marker"][0]
        seen = sighted_marker(radiance, marker, camera)
        return seen if len(seen.px) else replace(seen, note=of_marker(eight_bit(tone(radiance)), marker))
    if turns_alike(facts["board"]):
        across, down = facts["board"]["squares"]
        raise CaptureError(
            f"the chessboard of {across} x {down} squares looks the same when turned by 180 degrees, needed one of an "
            "even and an odd count; lay a [[marker]] and orient the views by [[pose]] route 'marker', or use another"
        )
    seen = sighted_board(radiance, facts["board"], camera)
    if len(seen.twice) >= TWICE:
        ids = ", ".join(str(i) for i in seen.twice[:4]) + (", ..." if len(seen.twice) > 4 else "")
        raise CaptureError(f"ids {ids} are seen twice, needed one board; cover the other or take it away")
    if len(seen.px) >= FEWEST_CORNERS:
        return seen
    return replace(seen, note=of_board([eight_bit(tone(radiance))], facts["board"]))


def of_prints(
    facts: dict[str, Any], views: dict[str, View], sights: dict[str, Sightings], plate: np.ndarray, camera: Camera
) -> list[str]:
    """What to say of boards that the frame cuts, and of markers beside the board whose size is another than stated.

    ``plate``: its linear radiance (H, W). Only markers that lie on the board's plane are measured.
    """
    board, view, said = facts.get("board"), views["plate"], []
    if not board or view.route != "charuco":
        return []
    if "plate" in sights and (text := cut(camera, view.world_from_camera, board, len(sights["plate"].px))):
        said.append(f"plate: {text}")
    for marker in facts.get("marker") or []:
        try:
            px = sighted_marker(plate, marker, camera).px
        except CaptureError:
            continue  # not measurable here, and not needed
        measured = side_on_plane(camera, view.world_from_camera, px) if len(px) == 4 else None
        if measured and (text := wrong_size(marker, measured, "board")):
            said.append(f"plate: {text}")
    return said


def _mirrored(pictures: Sequence[np.ndarray]) -> str:
    """Whether markers are read in the mirror image, as no marker is in its own."""
    best = max((find_markers(np.ascontiguousarray(picture[:, ::-1])) for picture in pictures), key=lambda m: len(m.ids))
    if not len(best.ids):
        return ""
    return (
        f"{len(best.ids)} markers of {best.family} are read in its mirror image: the print or the photograph is "
        "mirrored (a front camera, a film print); flip it back or print the board again"
    )


def _same_family(layout: Layout, name: str) -> bool:
    """Dictionaries of one family share their first markers."""
    return layout.dictionary.rpartition("_")[0] == name.rpartition("_")[0]


def _is_stated(layout: Layout, board: dict[str, Any]) -> bool:
    same = layout.squares == tuple(board["squares"]) and layout.first_id == board.get("first_id", 0)
    legacy = layout.squares[1] % 2 or layout.legacy == bool(board.get("legacy", False))  # alike with odd rows
    return bool(same and legacy and _same_family(layout, board["dictionary"]))


def _spelled(layout: Layout) -> str:
    legacy = ", legacy = true" if layout.legacy else ""
    kind = 'kind = "grid", ' if layout.kind == "grid" else ""
    return f'{kind}dictionary = "{layout.dictionary}", squares = [{layout.squares[0]}, {layout.squares[1]}]{legacy}'


def outside_frame(camera: Camera, pose: np.ndarray, board: dict[str, Any]) -> float:
    """Share of the board's outline that the frame does not show; ``pose`` (4, 4) is ``world_from_camera``."""
    across, down = np.array(board["squares"]) * board["square_m"]
    t = np.linspace(0, 1, 25)[:, None]
    corners = np.array([[0, 0, 0], [across, 0, 0], [across, down, 0], [0, down, 0]])
    outline = np.concatenate([a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])
    px = project(camera, camera_points(pose, transform_points(WORLD_FROM_BOARD, outline))[0])
    shown = np.isfinite(px).all(-1) & (px >= 0).all(-1) & (px <= (camera.width, camera.height)).all(-1)
    return float(1 - shown.mean())


def cut(camera: Camera, pose: np.ndarray, board: dict[str, Any], corners: int) -> str:
    """What to say of a board that reaches out of the frame; empty when the frame holds it."""
    outside = outside_frame(camera, pose, board)
    total = points_on(board)
    if outside <= CUT:
        return ""
    return (
        f"{outside:.0%} of the board's outline is out of the frame, {corners} of {total} corners are used; show all of "
        "it for the smallest uncertainty"
    )


def side_on_plane(camera: Camera, pose: np.ndarray, corners_px: np.ndarray) -> tuple[float, float] | None:
    """Side (m) and its standard uncertainty of a marker (4, 2) px that lies on y = 0; None when it does not lie there.

    Seen on the plane its outline must be a square: a marker that stands or lies higher is none.
    """
    rays = np.concatenate([unproject(camera, corners_px), np.ones((4, 1))], -1) @ pose[:3, :3].T
    if not np.isfinite(rays).all() or (rays[:, 1] >= 0).any():
        return None
    spots = pose[:3, 3] - rays * (pose[1, 3] / rays[:, 1])[:, None]
    sides = np.linalg.norm(spots - np.roll(spots, 1, 0), axis=1)
    diagonals = np.linalg.norm(spots[:2] - spots[2:], axis=1) / np.sqrt(2)
    side = float(sides.mean())
    px = np.linalg.norm(corners_px - np.roll(corners_px, 1, 0), axis=1)
    sigma = CORNER_PX * side / float(px.min())
    uneven = float(np.abs(np.concatenate([sides, diagonals]) - side).max())
    return (side, sigma) if uneven < max(SQUARE * side, 4 * sigma) else None


def wrong_size(marker: dict[str, Any], measured: tuple[float, float], unit: str) -> str:
    """What to say of a marker whose side is not as stated in the world's unit; empty when it is.

    ``measured``: side and uncertainty of `side_on_plane`; ``unit``: what gives the world's size, in words.
    """
    side, sigma = measured
    ratio = side / marker["side_m"]
    if abs(ratio - 1) < max(SIZE_TOLERANCE, 4 * sigma / marker["side_m"]):
        return ""
    return (
        f"marker {marker['id']}: its side is {1000 * side:.1f} mm by the {unit}, side_m says "
        f"{1000 * marker['side_m']:.1f} mm ({ratio - 1:+.1%}); measure both prints"
    )


def sizes_in_views(bundle: Bundle, numbers: Sequence[int], facts: Sequence[dict[str, Any]]) -> list[str]:
    """What to say of markers whose sizes contradict each other in adjusted views.

    ``numbers``: for each marker of the bundle, which of the stated ``facts`` it is.

    Every marker's points are triangulated from the views that show it, apart from what is stated of it. The tracks hold
    the views together, so the ratio of two markers stays what it is, though the scale is a compromise between them.
    """
    ratios: dict[int, tuple[float, float]] = {}
    for number in range(len(bundle.markers)):
        marks = [one for one in bundle.corners if one.marker == number]
        found = _triangulated(bundle, marks)
        if found is not None:
            side_px = float(np.median([np.ptp(one.px, axis=0).max() for one in marks]))
            ratios[number] = (umeyama(found, marks[0].points, scale=True)[1], CORNER_PX / side_px)
    if len(ratios) < 2:
        return []
    small, large = (choose(ratios, key=lambda number: ratios[number][0]) for choose in (min, max))
    apart = ratios[large][0] / ratios[small][0] - 1
    if apart < max(SIZE_TOLERANCE, 4 * float(np.hypot(ratios[large][1], ratios[small][1]))):
        return []
    one, other = facts[numbers[small]], facts[numbers[large]]
    return [
        f"markers {one['id']} and {other['id']}: their sizes contradict each other by {apart:.1%} (stated "
        f"{1000 * one['side_m']:.1f} and {1000 * other['side_m']:.1f} mm); measure both prints"
    ]


def _triangulated(bundle: Bundle, marks: Sequence[Corners]) -> np.ndarray | None:
    """Points (n, 3) of a marker in the world, of the sight lines of all its views; None from one place."""
    if not marks:
        return None
    total, right = np.zeros((len(marks[0].points), 3, 3)), np.zeros((len(marks[0].points), 3))
    for one in marks:
        if one.points.shape != marks[0].points.shape:
            continue  # a board of which each view shows another part
        pose = bundle.poses[one.view]
        ray = pixel_rays(bundle.cameras[bundle.camera_of[one.view]], one.px) @ pose[:3, :3].T
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        total, right = total + across, right + across @ pose[:3, 3]
    values = np.linalg.eigvalsh(total)
    if (values[:, 0] < 1e-4 * values[:, 2]).any():  # sight lines that differ by less than half a degree
        return None
    return np.asarray(np.linalg.solve(total, right[..., None])[..., 0])
