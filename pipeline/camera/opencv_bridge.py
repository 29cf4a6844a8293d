"""The only importer of cv2 in the estimators; adds the half pixel, as OpenCV puts the first pixel centre at (0, 0).

Board: every inner corner of the ChArUco board that is seen, refined on the float picture in a window that no marker
reaches (an X corner is symmetric about itself, so neither blur nor tone curve moves it). Single marker: only the rough
corners come from OpenCV, whose refinements shrink a marker by 0.25 to 1 %; `markers.fit_marker` finds the edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.distortion import model_of
from pipeline.conventions import HALF_PIXEL, WORLD_FROM_BOARD, transform_points
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Camera

DETECTION_PIXELS = 3e6  # larger pictures are averaged down for finding markers, not for measuring corners
SMALLEST_WINDOW, LARGEST_WINDOW = 2, 11  # half size of the window of a corner, px


@dataclass(frozen=True)
class Sightings:
    """Points of known place found in a picture: world (N, 3) m, pixels (N, 2), ids (N,), and the markers seen.

    ``twice``: ids of markers that are seen in two places; ``note``: what is shown instead of what was looked for.
    """

    world_m: np.ndarray
    px: np.ndarray
    ids: np.ndarray
    markers: int
    twice: tuple[int, ...] = ()
    note: str = ""


def ours(opencv_px: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of OpenCV in the pixel origin of conventions."""
    return np.asarray(opencv_px, float).reshape(-1, 2) + HALF_PIXEL


def theirs(px: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of conventions as OpenCV counts them."""
    return np.asarray(px, float).reshape(-1, 2) - HALF_PIXEL


def read_grey(path: str | Path) -> np.ndarray:
    """(H, W) uint8 of a JPEG, PNG or TIFF, as it lies on the sensor (orientation tags are ignored, as RAW has none)."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise CaptureError(f"{path}: not a readable picture, needed JPEG, PNG or TIFF; export it again or take it out")
    return picture


def dictionary(name: str) -> Any:
    """The predefined ArUco or AprilTag dictionary. Raises ManifestError for an unknown name."""
    import cv2

    known = [n for n in dir(cv2.aruco) if n.startswith("DICT_")]
    if name not in known:
        raise ManifestError(f"dictionary: is {name!r}; expected one of {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def charuco_board(board: dict[str, Any]) -> Any:
    """OpenCV's board of the manifest's facts."""
    import cv2

    across, down = board["squares"]
    name, ids = board["dictionary"], board.get("first_id", 0) + np.arange(across * down // 2)
    held = len(dictionary(name).bytesList)
    if ids[-1] >= held:
        raise ManifestError(f"board: needs marker ids up to {ids[-1]}; {name} holds {held}; expected a larger one")
    made = cv2.aruco.CharucoBoard((across, down), board["square_m"], board["marker_m"], dictionary(name), ids)
    made.setLegacyPattern(bool(board.get("legacy", False)))
    return made


def shrunk(picture: np.ndarray) -> tuple[np.ndarray, int]:
    """The picture averaged over blocks until it is small enough for detection, and the block size."""
    import cv2

    step = int(np.ceil(np.sqrt(picture.size / DETECTION_PIXELS)))
    if step == 1:
        return np.ascontiguousarray(picture), 1
    height, width = (n // step * step for n in picture.shape)
    small = cv2.resize(picture[:height, :width], (width // step, height // step), interpolation=cv2.INTER_AREA)
    return small, step


def board_sightings(
    picture: np.ndarray, precise: np.ndarray, board: dict[str, Any], camera: Camera | None = None
) -> Sightings:
    """Inner corners of the ChArUco board.

    Args:
        picture: (H, W) uint8 for finding the markers.
        precise: (H, W) uint8 or float32 for measuring the corners, any monotone function of radiance.
        board: the manifest's facts of the board.
        camera: lets OpenCV predict corners through the lens; without it each is interpolated from its neighbours.
    """
    import cv2

    small, step = shrunk(picture)
    options = cv2.aruco.CharucoParameters()
    if camera is not None and model_of(camera.distortion) != "fisheye":  # which its detector does not know
        K = camera.K.copy()
        K[:2] /= step
        K[:2, 2] -= HALF_PIXEL
        options.cameraMatrix, options.distCoeffs = K, np.asarray(camera.distortion, float)
    made = charuco_board(board)
    corners, ids, quads, marker_ids = cv2.aruco.CharucoDetector(made, options).detectBoard(small)
    markers = 0 if marker_ids is None else len(marker_ids)
    twice = () if marker_ids is None else repeated(np.reshape(quads, (-1, 4, 2)), np.ravel(marker_ids))
    if ids is None or len(ids) < 4:
        return Sightings(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, int), markers, twice)
    ids = np.asarray(ids).ravel()
    flat = np.asarray(made.getChessboardCorners(), float).reshape(-1, 3)
    marker_corners = np.concatenate([np.asarray(m, float).reshape(-1, 3) for m in made.getObjPoints()])
    rough = ours(corners) * step
    px = refined_corners(precise, flat[ids], rough, marker_corners)
    return Sightings(transform_points(WORLD_FROM_BOARD, flat[ids]), px, ids, markers, twice)


def repeated(quads: np.ndarray, ids: np.ndarray) -> tuple[int, ...]:
    """Ids of markers (N, 4, 2) px that are seen in two places, more than a side apart; sorted."""
    centres, sides = quads.mean(1), np.linalg.norm(quads - np.roll(quads, 1, 1), axis=-1).mean(1)
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1) > np.minimum(sides[:, None], sides[None])
    return tuple(sorted({int(i) for i in ids[((ids[:, None] == ids[None]) & apart).any(1)]}))


def refined_corners(
    precise: np.ndarray, flat: np.ndarray, rough_px: np.ndarray, marker_corners: np.ndarray
) -> np.ndarray:
    """Sub-pixel X corners (N, 2) near ``rough_px``; each window ends before the nearest corner of a marker.

    A corner that runs away from its start by more than its window keeps its start: the residual test judges it.
    """
    import cv2

    homography, _ = cv2.findHomography(flat[:, :2], rough_px, cv2.RANSAC, 3.0)
    if homography is None:
        return rough_px
    mapped = cv2.perspectiveTransform(marker_corners[None, :, :2], homography)[0]
    predicted = cv2.perspectiveTransform(flat[None, :, :2], homography)[0]
    reach = np.abs(mapped[None] - predicted[:, None]).max(-1).min(-1)
    windows = np.clip(np.floor(reach) - 2, SMALLEST_WINDOW, LARGEST_WINDOW).astype(int)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    picture = np.ascontiguousarray(precise)
    px = rough_px.copy()
    for window in np.unique(windows):
        chosen = windows == window
        start = np.ascontiguousarray(theirs(rough_px[chosen]), np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(picture, start, (int(window), int(window)), (-1, -1), criteria)
        px[chosen] = ours(found)
    moved = np.abs(px - rough_px).max(-1)
    return np.where((moved <= windows)[:, None], px, rough_px)


def markers_px(picture: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Ids (K,) and rough corners (K, 4, 2), clockwise from x right and y down the print, of a dictionary's markers."""
    import cv2

    small, step = shrunk(picture)
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    quads, ids, _ = cv2.aruco.ArucoDetector(dictionary(name), options).detectMarkers(small)
    ids = np.empty(0, int) if ids is None else np.asarray(ids).ravel()
    return ids, np.array([ours(quad) * step for quad in quads]).reshape(-1, 4, 2)


def marker_pattern(name: str, marker_id: int) -> np.ndarray:
    """(n, n) bool, rows down the print: the black cells of a marker, its black border included."""
    import cv2

    cells = marker_cells(name)
    return np.asarray(cv2.aruco.generateImageMarker(dictionary(name), marker_id, cells)) == 0


def marker_cells(name: str) -> int:
    """Cells along the side of a marker of the dictionary, its black border included."""
    return int(dictionary(name).markerSize) + 2


def planar_poses(flat: np.ndarray, xy: np.ndarray) -> list[np.ndarray]:
    """Both ``camera_from_plane`` (4, 4) of points (N, 2) in the plane z = 0 at normalised coordinates (N, 2) (IPPE).

    Seen exactly squarely it divides zero by zero; a camera turned about its own centre then sees the same points.
    """
    poses = _ippe(flat, xy, np.eye(3))
    if np.isfinite(poses).all():
        return poses
    cosine, sine = np.cos(0.1), np.sin(0.1)
    return _ippe(flat, xy, np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]))


def _ippe(flat: np.ndarray, xy: np.ndarray, turned_from_camera: np.ndarray) -> list[np.ndarray]:
    """`planar_poses` by way of a camera that is turned by a rotation (3, 3)."""
    import cv2

    points = np.concatenate([flat, np.zeros((len(flat), 1))], -1)
    if not np.array_equal(turned_from_camera, np.eye(3)):
        rays = np.concatenate([xy, np.ones((len(xy), 1))], -1) @ turned_from_camera.T
        xy = rays[:, :2] / rays[:, 2:]
    _, rotations, translations, _ = cv2.solvePnPGeneric(points, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = turned_from_camera.T @ cv2.Rodrigues(rotation)[0]
        pose[:3, 3] = turned_from_camera.T @ np.ravel(translation)
        poses.append(pose)
    return poses


def first_calibration(
    world_m: list[np.ndarray], px: list[np.ndarray], size: tuple[int, int]
) -> tuple[Camera, list[np.ndarray]]:
    """A start for the adjustment: one focal length and k1 from board views, and ``world_from_camera`` of each."""
    import cv2

    flat = [transform_points(WORLD_FROM_BOARD.T, points).astype(np.float32) for points in world_m]
    pixels = [theirs(points).astype(np.float32) for points in px]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    guess = cv2.initCameraMatrix2D(flat, pixels, size, 1.0)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # several add up in the order in which they end: other bytes each time
    try:
        _, K, distortion, rotations, translations, *_ = cv2.calibrateCameraExtended(
            flat, pixels, size, guess, np.zeros(5), flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS
        )
    finally:
        cv2.setNumThreads(threads)
    centre = ours(K[:2, 2])[0]
    camera = Camera(
        width=size[0], height=size[1], fx=K[0, 0], fy=K[1, 1], cx=centre[0], cy=centre[1],
        distortion=np.ravel(distortion)[:5], source="calibrated",
    )  # fmt: skip
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        turn = cv2.Rodrigues(rotation)[0]
        board_from_camera = np.eye(4)
        board_from_camera[:3, :3] = turn.T
        board_from_camera[:3, 3] = -turn.T @ np.ravel(translation)
        poses.append(WORLD_FROM_BOARD @ board_from_camera)
    return camera, poses


@dataclass(frozen=True)
class Features:
    """Spots that can be found again: pixels (N, 2) and their descriptions (N, 128)."""

    px: np.ndarray
    described: np.ndarray


def features(picture: np.ndarray) -> Features:
    """SIFT features (Lowe 2004) of a picture (H, W) uint8."""
    import cv2

    finder: Any = cv2.SIFT.create(contrastThreshold=0.02, enable_precise_upscale=True)
    spots, described = finder.detectAndCompute(np.ascontiguousarray(picture), None)
    if described is None:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    return Features(ours(np.array([spot.pt for spot in spots])), described)


def feature_matches(first: Features, second: Features, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and (N, 2) of the same spots in two pictures.

    A match is kept when the second-best in ``first`` is farther by 1 / ``ratio``, and when it is the best both ways.
    Many are wrong: they are to be judged by geometry.
    """
    import cv2

    if min(len(first.px), len(second.px)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(first.described, second.described)}
    pairs = [
        (best.trainIdx, best.queryIdx)
        for best, other in matcher.knnMatch(second.described, first.described, k=2)
        if best.distance < ratio * other.distance and back[best.trainIdx] == best.queryIdx
    ]
    here, there = np.array(pairs, int).reshape(-1, 2).T
    return first.px[here], second.px[there]
