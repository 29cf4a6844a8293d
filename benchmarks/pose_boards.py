"""Poses from rendered photographs of boards and markers, through the real detector, against their truth.

A box-filtered print on a table, lens blur of 0.5 to 1.1 px, noise of 1 % of the paper's white; the lens bends. Ten such
photographs calibrate a lens where it is said to be calibrated.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.pose_coverage import CHI2_95
from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.opencv_bridge import dictionary, theirs
from pipeline.camera.resection import Resection, resect_plane
from pipeline.camera.rigid import camera_points, difference, perturb
from pipeline.camera.sights import sighted_board, sighted_marker
from pipeline.conventions import WORLD_FROM_MARKER, invert_rigid, transform_points
from pipeline.image.colour import encode_srgb
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.run.formats import write_png
from pipeline.types import Camera, Reconstruction, Sources
from stages import calibrate, knobs
from tests.printed_board import BOARD, MARKER, charuco_print, looking_at, marker_print, straightened

CAMERA = Camera(width=720, height=660, fx=860, fy=860, cx=364.2, cy=326.9, distortion=np.array([-0.06, 0.02, 0, 0, 0]))
SUPERSAMPLE = 4
BLACK, WHITE, TABLE, NOISE = 0.04, 0.8, 0.3, 0.008
BLURS_PX = (0.5, 1.1)
BOARD_M, CENTRE = 0.21, np.array([0.105, 0, 0.075])
FOOT = np.array([0.105, 0, 0.19])  # of an object: 4 cm in front of the board's edge
TILT_DEG, LEAST_PX, WIDEST_PX = 30.0, 480.0, 560.0
LENSES, PER_LENS, PHOTOS = 8, 26, 10
SIZES_PX, TILTS_DEG, REPEATS = (24, 32, 48, 72, 110, 170, 260), (5, 15, 30, 50, 65), 6
FLIPPED_DEG = 10.0
SIGMA_PX, LEAST_RATIO = knobs.Pose().corner_sigma_px, knobs.Pose().min_ambiguity


@cache
def sub_rays() -> np.ndarray:
    """(3, H S, W S) float32 rays of all subsamples of the camera."""
    along = [(np.arange(n * SUPERSAMPLE) + 0.5) / SUPERSAMPLE for n in (CAMERA.width, CAMERA.height)]
    px = np.stack(np.meshgrid(*along), -1)
    K = CAMERA.K
    xy = straightened((px.reshape(-1, 2) - K[:2, 2]) / (K[0, 0], K[1, 1]), CAMERA.distortion)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], -1).T.astype(np.float32)
    return rays.reshape(3, *px.shape[:2])


def rendered(printed: tuple[np.ndarray, float, np.ndarray], pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(H, W) float32 linear radiance of a print (black 0, white 255) on the table, blurred, with noise."""
    picture, per_metre, first = printed
    (rows, columns), rest = picture.shape, np.full((CAMERA.height, CAMERA.width), TABLE, np.float32)
    ends = np.array([[x, 0, z] for x in (0, columns) for z in (0, rows)]) / per_metre + (first[0], 0, first[1])
    px = project(CAMERA, camera_points(pose, ends)[0])
    low = np.maximum(np.floor(px.min(0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(px.max(0)).astype(int) + 3, (CAMERA.width, CAMERA.height))
    part = [slice(low[i] * SUPERSAMPLE, high[i] * SUPERSAMPLE) for i in (1, 0)]
    # where a ray meets y = 0: eye - eye_y / ray_y ray, in pixels of the print, as a homography of the ray
    eye, axes = pose[:3, 3], np.eye(3)
    over = [per_metre * (eye[1] * axes[i] - (eye[i] - f) * axes[1]) for i, f in zip((0, 2), first, strict=True)]
    matrix = (np.stack([*over, -axes[1]]) @ pose[:3, :3]).astype(np.float32)
    x, y, depth = np.tensordot(matrix, sub_rays()[:, part[0], part[1]], 1)
    seen = cv2.remap(picture, x / depth - 0.5, y / depth - 0.5, cv2.INTER_NEAREST, borderValue=128)
    levels = np.full(256, TABLE, np.float32)
    levels[[0, 255]] = BLACK, WHITE
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    rest[low[1] : high[1], low[0] : high[0]] = cv2.resize(levels[seen], size, interpolation=cv2.INTER_AREA)
    linear = cv2.GaussianBlur(rest, (0, 0), rng.uniform(*BLURS_PX))
    return np.asarray(linear + NOISE * rng.standard_normal(linear.shape), np.float32)


def board_pose(rng: np.random.Generator) -> np.ndarray:
    """The board 480 to 560 px wide, 30 degrees off the vertical, from any side, wholly in the frame."""
    while True:
        distance = CAMERA.fx * BOARD_M / rng.uniform(LEAST_PX, WIDEST_PX)
        pose = looking_at(CENTRE, TILT_DEG, rng.uniform(0, 360), distance, rng.uniform(-30, 30))
        if in_frame(pose):
            return pose


def in_frame(pose: np.ndarray) -> bool:
    """Whether the whole board is seen."""
    ends = np.array([[x, 0, z] for x in (0, BOARD_M) for z in (0, 0.15)])
    px = project(CAMERA, camera_points(pose, ends)[0])
    return bool(((px > 3) & (px < (CAMERA.width - 3, CAMERA.height - 3))).all())


def calibration_pose(rng: np.random.Generator) -> np.ndarray:
    """A photograph for calibration: any side, 5 to 45 degrees, the board 300 to 560 px wide somewhere in the frame."""
    while True:
        target = CENTRE + rng.uniform(-0.05, 0.05, 3) * (1, 0, 1)
        distance = CAMERA.fx * BOARD_M / rng.uniform(300, WIDEST_PX)
        pose = looking_at(target, rng.uniform(5, 45), rng.uniform(0, 360), distance, rng.uniform(-40, 40))
        if in_frame(pose):
            return pose


def calibrated_lens(rng: np.random.Generator) -> Camera:
    """The lens that stage calibrate finds in ten rendered photographs of 8 bits."""
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{number}.png" for number in range(PHOTOS)]
        for file in files:
            linear = np.clip(rendered(charuco_print(BOARD), calibration_pose(rng), rng), 0, 1)
            write_png(Path(folder) / file, (encode_srgb(linear) * 255 + 0.5).astype(np.uint8))
        facts = {"capture_root": folder, "board": BOARD, "camera": {"calibration": ["*.png"], "given": None}}
        photos = [{"file": file} for file in files]
        result = calibrate.compute(facts, {}, photos, Reconstruction(), Sources(), knobs.Calibrate())
    return result.outputs["camera"]  # type: ignore[no-any-return]


def errors_of(found: Resection, camera: Camera, true: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """How far a pose is off: whole, its plane's normal as the camera sees it, and an object's foot in the picture."""
    pose = found.world_from_camera
    delta = difference(pose, true)
    normals = [matrix[1, :3] / np.linalg.norm(matrix[1, :3]) for matrix in (pose, true)]
    feet = [project(lens, camera_points(at, FOOT[None])[0])[0] for lens, at in ((camera, pose), (CAMERA, true))]
    return {
        "reproj_px": found.rms_px,
        "rot_deg": float(np.degrees(np.linalg.norm(delta[:3]))),
        "pos_rel": float(np.linalg.norm(delta[3:]) / np.linalg.norm(true[:3, 3] - target)),
        "normal_deg": float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(*normals)))))),
        "contact_px": float(np.linalg.norm(feet[0] - feet[1])),
        "chi2": float(delta @ np.linalg.solve(found.covariance, delta)),
    }


def with_one_lens(number: int) -> dict[str, Any]:
    """Photographs of the board through the true lens and through one that was calibrated; the corners' errors."""
    rng = np.random.default_rng([61, number])
    lens, printed = calibrated_lens(rng), charuco_print(BOARD)
    rows: dict[str, list[dict[str, float]]] = {"true_lens": [], "calibrated_lens": []}
    corners = []
    for _ in range(PER_LENS):
        true = board_pose(rng)
        radiance = rendered(printed, true, rng)
        for name, camera in (("true_lens", CAMERA), ("calibrated_lens", lens)):
            seen = sighted_board(radiance, BOARD, camera)
            best, _, _ = resect_plane(camera, seen.world_m, seen.px, SIGMA_PX, True)
            rows[name].append(errors_of(best, camera, true, CENTRE))
        corners.append(seen.px - project(CAMERA, camera_points(true, seen.world_m)[0]))
    focal = {
        "focal_rel_err": lens.fx / CAMERA.fx - 1,
        "focal_sigma_rel": float(np.sqrt(lens.covariance[0, 0])) / lens.fx,
    }
    return {"rows": rows, "corners": corners, "lens": focal}


def boards(workers: int = 2) -> dict[str, Any]:
    """Medians, 95 % and worst of all photographs with either lens, and the noise of the corners."""
    with ProcessPoolExecutor(workers) as pool:
        sets = list(pool.map(with_one_lens, range(LENSES)))
    found: dict[str, Any] = {"photographs": LENSES * PER_LENS, "lenses": [one["lens"] for one in sets]}
    for name in ("true_lens", "calibrated_lens"):
        rows = [row for one in sets for row in one["rows"][name]]
        found[name] = {key: spread(np.array([row[key] for row in rows])) for key in rows[0]}
        found[name]["held_95"] = float(np.mean([row["chi2"] <= CHI2_95 for row in rows]))
    return {**found, **corner_noise([corners for one in sets for corners in one["corners"]])}


def spread(values: np.ndarray) -> dict[str, float]:
    """Median, 95 % and worst."""
    return {"median": float(np.median(values)), "p95": float(np.quantile(values, 0.95)), "worst": float(values.max())}


def corner_noise(corners: list[np.ndarray]) -> dict[str, float]:
    """Of (N, 2) errors of each photograph: rms of a coordinate, of the photograph's own mean, and the mean of all."""
    every = np.concatenate(corners)
    means = np.array([part.mean(0) for part in corners])
    return {
        "corner_rms_px": float(np.sqrt((every**2).mean())), "corner_mean_rms_px": float(np.sqrt((means**2).mean())),
        "corner_bias_px": float(np.abs(every.mean(0)).max()),
        "corners": len(every),
    }  # fmt: skip


def plain_opencv(radiance: np.ndarray) -> np.ndarray | None:
    """``world_from_camera`` of the marker as a few lines of OpenCV find it: refined corners, IPPE, its first pose."""
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary(MARKER["dictionary"]), options)
    quads, ids, _ = detector.detectMarkers((np.clip(encode_srgb(np.clip(radiance, 0, 1)), 0, 1) * 255).astype(np.uint8))
    mine = [] if ids is None else [quad for quad, number in zip(quads, np.ravel(ids)) if number == MARKER["id"]]
    if not mine:
        return None
    flat = transform_points(WORLD_FROM_MARKER.T, marker_points(MARKER["side_m"]))
    K = CAMERA.K.copy()
    K[:2, 2] = theirs(K[:2, 2])[0]
    flags = cv2.SOLVEPNP_IPPE_SQUARE
    good, turn, shift = cv2.solvePnP(flat, np.reshape(mine[0], (4, 2)).astype(float), K, CAMERA.distortion, flags=flags)
    if not good:
        return None
    camera_from_marker = np.eye(4)
    camera_from_marker[:3, :3], camera_from_marker[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return WORLD_FROM_MARKER @ invert_rigid(camera_from_marker)


def one_marker(size_px: float, tilt_deg: float) -> dict[str, Any]:
    """Errors, refusals and unnoticed flips of ours and of plain OpenCV on the same photographs."""
    rng = np.random.default_rng([62, size_px, tilt_deg])
    marker, ours, peer = marker_print(MARKER), [], []
    refused = unseen = peer_unseen = 0
    for _ in range(REPEATS):
        distance = CAMERA.fx * MARKER["side_m"] / size_px
        true = looking_at(np.zeros(3), tilt_deg, rng.uniform(0, 360), distance, rng.uniform(0, 360))
        true = true @ perturb(np.eye(4), np.array([*rng.uniform(-0.05, 0.05, 2), 0, 0, 0, 0]))
        radiance = rendered(marker, true, rng)
        theirs_pose = plain_opencv(radiance)
        if theirs_pose is None:
            peer_unseen += 1
        else:
            peer.append(off(theirs_pose, true))
        try:
            seen = sighted_marker(radiance, MARKER, CAMERA)
            best, _, ambiguity = resect_plane(CAMERA, seen.world_m, seen.px, SIGMA_PX) if len(seen.px) else (None,) * 3
        except (CaptureError, NumericalError):
            best, ambiguity = None, None
        if best is None:
            unseen += 1
        elif ambiguity < LEAST_RATIO:
            refused += 1
        else:
            ours.append(off(best.world_from_camera, true))
    return {
        "size_px": size_px, "tilt_deg": tilt_deg, "photographs": REPEATS, "refused": refused, "unseen": unseen,
        **marked("ours", ours), **marked("opencv", peer), "opencv_unseen": peer_unseen,
    }  # fmt: skip


def off(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Rotation [deg] and position over distance."""
    delta = difference(found, true)
    away = float(np.linalg.norm(true[:3, 3]))
    return float(np.degrees(np.linalg.norm(delta[:3]))), float(np.linalg.norm(delta[3:]) / away)


def marked(name: str, errors: list[tuple[float, float]]) -> dict[str, Any]:
    """Medians of rotation and of the marker's distance in the camera's frame, and how many flipped unnoticed."""
    if not errors:
        return {f"{name}_rot_deg": None, f"{name}_pos_rel": None, f"{name}_flipped": 0}
    rotation, position = np.array(errors).T
    return {
        f"{name}_rot_deg": float(np.median(rotation)), f"{name}_pos_rel": float(np.median(position)),
        f"{name}_flipped": int((rotation > FLIPPED_DEG).sum()),
    }  # fmt: skip


def markers(workers: int = 2) -> list[dict[str, Any]]:
    """Single markers over size and tilt."""
    cells = [(size, tilt) for size in SIZES_PX for tilt in TILTS_DEG]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(one_marker, *zip(*cells, strict=True)))
