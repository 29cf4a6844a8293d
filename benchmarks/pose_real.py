"""Poses of photographs that were taken, not simulated, and of a capture that another renderer made.

Frames without a common metre are compared after one similarity. Where camera centres lie nearly on a line (herzjesu:
16.3 m along it, 0.3 m across at least), they leave the turn about that line open: then the similarity that fits centres
alone says more of their millimetres than of any camera's rotation. The similarity here fits centres and rotations, each
over its own residual; that of the centres alone stands beside it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.probe_captures import DATA
from pipeline.camera.adjustment import adjust as adjust_lens
from pipeline.camera.adjustment import free_columns
from pipeline.camera.bundle import adjust
from pipeline.camera.colmap_bridge import reconstruct
from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.opencv_bridge import first_calibration, read_grey
from pipeline.camera.resection import refine
from pipeline.camera.rigid import camera_points, difference, nearest_rotation, rotation_log, umeyama
from pipeline.camera.sfm import bundle_of, self_calibrated
from pipeline.camera.sights import marks_in
from pipeline.image.colour import decode_srgb
from pipeline.run import artifacts as A
from pipeline.run import formats
from pipeline.types import Camera

HERZJESU, ABAKISITA = DATA / "sfm_herzjesu8", DATA / "markers_abakisita"
SIDE_M, PITCH_M, ACROSS, MARKERS = 0.0375, 0.0425, 4, 20
THREADS = 2


def herzjesu() -> dict[str, Any]:
    """Eight photographs with true poses: ours with the stated K, its start, and plain pycolmap (no K) beside."""
    if not HERZJESU.is_dir():
        return {}
    K = np.loadtxt(HERZJESU / "images/K.txt")[:3]
    pictures = {file.name: read_grey(file) for file in sorted((HERZJESU / "images").glob("*.jpg"))}
    height, width = next(iter(pictures.values())).shape
    size = {"width": width, "height": height}
    stated = Camera(**size, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], source="given")
    long = float(max(height, width))
    guess = Camera(**size, fx=1.2 * long, fy=1.2 * long, cx=width / 2, cy=height / 2, source="guess")
    bodies = dict.fromkeys(pictures, 0)
    plain = reconstruct(pictures, bodies, [guess], threads=THREADS)
    held = reconstruct(pictures, bodies, [stated], threads=THREADS)
    poses = {
        "with_K": adjust(bundle_of(held, [stated]), hold_first=True).bundle.poses,
        "pycolmap_with_K": list(held.world_from_camera),
        "pycolmap": list(plain.world_from_camera),
    }
    truth = {file.name.removesuffix(".camera"): true_pose(file) for file in (HERZJESU / "gt_dense_cameras").iterdir()}
    names = {"with_K": held.names, "pycolmap_with_K": held.names, "pycolmap": plain.names}
    return {name: against(ours, [truth[n] for n in names[name]]) for name, ours in poses.items()}


def true_pose(file: Path) -> np.ndarray:
    """``world_from_camera`` (4, 4) of a .camera file: K, 0 0 0, rotation, centre, size."""
    values = np.array(file.read_text().split(), float)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = values[12:21].reshape(3, 3), values[21:24]
    return pose


def against(poses: list[np.ndarray], true: list[np.ndarray]) -> dict[str, float]:
    """Errors after the joint similarity, and after the one of the centres."""
    centres, wanted = (np.array([pose[:3, 3] for pose in some]) for some in (poses, true))
    matrix, scale = umeyama(wanted, centres, scale=True)
    by_centres = errors(poses, true, matrix[:3, :3] / scale, scale, matrix[:3, 3])
    together = errors(poses, true, *joint_similarity(poses, true))
    return {**together, **{f"{key}_by_centres": value for key, value in by_centres.items()}}


def errors(
    poses: list[np.ndarray], true: list[np.ndarray], turn: np.ndarray, scale: float, shift: np.ndarray
) -> dict[str, float]:
    """Means of centres [mm] and rotations [deg] over the photographs."""
    away = [scale * turn @ pose[:3, 3] + shift - wanted[:3, 3] for pose, wanted in zip(poses, true, strict=True)]
    turned = [rotation_log(turn @ pose[:3, :3] @ wanted[:3, :3].T) for pose, wanted in zip(poses, true, strict=True)]
    rotation = np.degrees(np.linalg.norm(turned, axis=1))
    return {
        "centre_mm": float(1000 * np.linalg.norm(away, axis=1).mean()), "rot_deg": float(rotation.mean()),
        "rot_deg_worst": float(rotation.max()),
    }  # fmt: skip


def joint_similarity(poses: list[np.ndarray], true: list[np.ndarray]) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale and shift of least squares over centres and rotations, each over its own rms residual.

    Both parts are linear in the rotation sought, so each step is one orthogonal Procrustes problem.
    """
    centres, wanted = (np.array([pose[:3, 3] for pose in some]) for some in (poses, true))
    arm, aim = centres - centres.mean(0), wanted - wanted.mean(0)
    by_rotations = np.sum([w[:3, :3] @ p[:3, :3].T for p, w in zip(poses, true, strict=True)], 0)
    turn, scale, weight = nearest_rotation(by_rotations), 1.0, 0.0
    for _ in range(20):
        turn = nearest_rotation(by_rotations + weight * scale * aim.T @ arm)
        scale = float((aim * (arm @ turn.T)).sum() / (arm**2).sum())
        off = ((scale * arm @ turn.T - aim) ** 2).mean()
        pairs = zip(poses, true, strict=True)
        angle = np.mean([rotation_log(turn @ p[:3, :3] @ w[:3, :3].T) ** 2 for p, w in pairs])
        weight = float(2 * angle / off)  # the trace of a turn falls by half its square
    return turn, scale, wanted.mean(0) - scale * turn @ centres.mean(0)


def abakisita() -> dict[str, Any]:
    """A board of twenty markers on a table: camera centres by its corners and by COLMAP without them."""
    if not ABAKISITA.is_dir():
        return {}
    files = sorted(ABAKISITA.glob("*.jpg"), key=lambda file: int(file.stem))
    pictures = {file.name: read_grey(file) for file in files}
    height, width = next(iter(pictures.values())).shape
    rough = Camera(width=width, height=height, fx=1.2 * width, fy=1.2 * width, cx=width / 2, cy=height / 2)
    facts = {"board": None, "marker": [
        {"dictionary": "DICT_6X6_1000", "id": number, "side_m": SIDE_M} for number in range(MARKERS)
    ]}  # fmt: skip
    world_m, px = [], []
    for picture in pictures.values():
        radiance = np.asarray(decode_srgb(picture.astype(np.float32) / 255), np.float32)
        marks, _ = marks_in(facts, radiance, rough)
        place = [one.points + PITCH_M * np.array([one.marker % ACROSS, 0, one.marker // ACROSS]) for one in marks]
        world_m.append(np.concatenate(place))
        px.append(np.concatenate([one.px for one in marks]))
    start, poses = first_calibration(world_m, px, (width, height))
    lens = adjust_lens(start, poses, world_m, px, free_columns(("k1", "k2", "p1", "p2"), False))
    by_board = [
        refine(lens.camera, pose, *item, 0.1).world_from_camera for pose, *item in zip(lens.poses, world_m, px)
    ]  # fmt: skip
    guess = rough.model_copy(update={"source": "guess"})
    cloud = reconstruct(pictures, dict.fromkeys(pictures, 0), [guess], threads=THREADS)
    found, _, _ = self_calibrated(cloud, 0)
    by_cloud = adjust(bundle_of(cloud, [found]), hold_first=True).bundle.poses
    names = list(pictures)
    return {
        **agreement(by_cloud, [by_board[names.index(name)] for name in cloud.names]),
        "photographs": len(cloud.names), "of": len(names), "corner_rms_px": lens.rms_px,
        "focal_px": [lens.camera.fx, found.fx],
    }  # fmt: skip


def agreement(poses: list[np.ndarray], others: list[np.ndarray]) -> dict[str, float]:
    """Distance of the centres after a similarity, over the distance to the board's middle."""
    centres, wanted = (np.array([pose[:3, 3] for pose in some]) for some in (poses, others))
    matrix, _ = umeyama(wanted, centres, scale=True)
    middle = marker_points(SIDE_M).mean(0) + PITCH_M * np.array([1.5, 0, 2.0])
    away = np.linalg.norm(centres @ matrix[:3, :3].T + matrix[:3, 3] - wanted, axis=1)
    apart = away / np.linalg.norm(wanted - middle, axis=1)
    return {"rel_median": float(np.median(apart)), "rel_p90": float(np.quantile(apart, 0.9))}


def captures(folder: Path) -> dict[str, Any]:
    """Plate poses of whole captures, lens estimated, against their truth."""
    from pipeline.run.cli import main

    paths = {"kitchen": Path("tests/kitchen_table")} if (DATA / "captures/kitchen_table").is_dir() else {}
    found = {}
    for name, path in paths.items():
        out = folder / name
        if main(["run", str(path), "--quality", "draft", "--out", str(out), "--upto", "pose"]):
            raise SystemExit(f"{path}: does not build up to its pose")
        view = formats.read(out / "pose", A.VIEWS)["plate"]
        camera: Camera = formats.read(out / "calibrate", A.CAMERA)
        file = next(file for file in (path / "truth.json", path / "truth/truth.json") if file.is_file())
        truth = json.loads(file.read_text())
        true = np.array(truth["views"]["plate"]["world_from_camera"])
        delta = difference(view.world_from_camera, true)
        parts = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
        lens, spot = Camera(**{key: truth["camera"][key] for key in parts}), np.zeros((1, 3))
        eyes = ((camera, view.world_from_camera), (lens, true))
        shown = [project(one, camera_points(at, spot)[0])[0] for one, at in eyes]
        found[name] = {
            "route": view.route, "rot_deg": float(np.degrees(np.linalg.norm(delta[:3]))),
            "pos_rel": float(np.linalg.norm(delta[3:]) / np.linalg.norm(true[:3, 3])),
            "chi2": float(delta @ np.linalg.solve(view.covariance, delta)), "rms_px": view.rms_px,
            "origin_px": float(np.linalg.norm(shown[0] - shown[1])), "focal_rel_err": camera.fx / lens.fx - 1,
        }  # fmt: skip
    return found


def real(folder: Path) -> dict[str, Any]:
    """All of them; those whose photographs are not there are empty."""
    return {"herzjesu": herzjesu(), "abakisita": abakisita(), "captures": captures(folder)}
