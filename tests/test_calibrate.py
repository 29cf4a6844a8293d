"""Calibration from simulated corners and from photographs of known lens."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from printed_board import BOARD, charuco_print, looking_at, photograph

from pipeline.camera import board_photos, opencv_bridge
from pipeline.camera.adjustment import adjust, considered, free_columns, lens_vector
from pipeline.camera.lens import project
from pipeline.camera.lens_ladder import disagreement
from pipeline.camera.markers import tone
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.rigid import camera_points
from pipeline.run.errors import CaptureError, ManifestError, NumericalError
from pipeline.types import Camera, Reconstruction, Sources
from stages import calibrate, knobs

TRUTH = Camera(
    width=1024, height=768, fx=1150.0, fy=1150.0, cx=515.3, cy=381.6, distortion=np.array([-0.081, 0.0, 0, 0, 0])
)
X, Z = np.meshgrid(np.arange(1, 7) * 0.03, np.arange(1, 5) * 0.03)
POINTS = np.stack([X.ravel(), 0 * X.ravel(), Z.ravel()], -1)
KITCHEN = Path(os.environ.get("INSITU_DATA", "../shared/data")) / "captures/kitchen_table"
DESK = Path(__file__).parents[1] / "sample_captures/desk"


def poses_of(count: int, tilts: tuple[float, float], seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    poses = []
    while len(poses) < count:
        target = np.array([rng.uniform(0.03, 0.18), 0, rng.uniform(0.03, 0.12)])
        pose = looking_at(
            target, rng.uniform(*tilts), rng.uniform(0, 360), rng.uniform(0.25, 0.45), rng.uniform(-40, 40)
        )
        px = project(TRUTH, camera_points(pose, POINTS)[0])
        if np.isfinite(px).all() and (px > 0).all() and (px < (1024, 768)).all():
            poses.append(pose)
    return poses


def corners_of(poses: list[np.ndarray], camera: Camera, sigma: float, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [project(camera, camera_points(p, POINTS)[0]) + sigma * rng.normal(size=(24, 2)) for p in poses]


def run(monkeypatch: pytest.MonkeyPatch, corners: list[np.ndarray], sizes: list[tuple[int, int]] | None = None):
    """The stage on given corners instead of pictures."""
    sizes = sizes or [(768, 1024)] * len(corners)
    monkeypatch.setattr(
        board_photos, "board_picture", lambda path: (np.full(sizes[int(path.stem)], int(path.stem), np.uint8),) * 2
    )
    monkeypatch.setattr(
        board_photos, "sightings_of",
        lambda grey, _, board: Sightings(POINTS[: len(corners[grey[0, 0]])], corners[grey[0, 0]], np.arange(24), 17),
    )  # fmt: skip
    facts = {"capture_root": ".", "board": BOARD, "camera": {"calibration": ["*.jpg"], "given": None}}
    return calibrate.compute(
        facts, {}, [{"file": f"{i}.jpg"} for i in range(len(corners))], Reconstruction(), Sources(), knobs.Calibrate()
    )


def test_lens_and_model_are_recovered(monkeypatch: pytest.MonkeyPatch) -> None:
    result = run(monkeypatch, corners_of(poses_of(12, (5, 50), 1), TRUTH, 0.03, 1))
    camera = result.outputs["camera"]
    taken = {entry["term"] for entry in result.evidence if entry["modelled"]}
    assert taken == {"lens k1"}
    error = lens_vector(camera) - lens_vector(TRUTH)
    sigma = np.sqrt(np.diag(camera.covariance))
    assert (np.abs(error) <= 4 * sigma).all()  # terms left out: both zero
    assert disagreement(TRUTH, camera) < 0.5
    assert not result.warnings
    assert 0.025 < result.numbers["corner_sigma_px"] < 0.035


def test_a_straight_lens_gets_no_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    straight = TRUTH.model_copy(update={"distortion": np.zeros(5)})
    result = run(monkeypatch, corners_of(poses_of(10, (5, 50), 2), straight, 0.03, 2))
    assert not any(entry["modelled"] for entry in result.evidence)
    assert result.outputs["camera"].fx == result.outputs["camera"].fy


def test_full_lens_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    full = TRUTH.model_copy(update={"fy": 1157.0, "distortion": np.array([-0.2, 0.09, 1.5e-3, -1e-3, 0.0])})
    result = run(monkeypatch, corners_of(poses_of(14, (5, 50), 3), full, 0.03, 3))
    taken = {entry["term"] for entry in result.evidence if entry["modelled"]}
    assert {"lens k1", "lens fy", "lens p1 p2"} <= taken
    assert disagreement(full, result.outputs["camera"]) < 1.0


def test_covariance_holds_the_truth() -> None:
    """Coverage of the 95 % region of (f, cx, cy, k1) over 300 simulated calibrations."""
    free = free_columns(("k1",), True)
    poses = poses_of(6, (10, 50), 4)
    inside = 0
    for seed in range(300):
        fit = adjust(TRUTH, poses, [POINTS] * 6, corners_of(poses, TRUTH, 0.1, 100 + seed), free)
        index = [0, 2, 3, 4]
        error = (lens_vector(fit.camera) - lens_vector(TRUTH))[index]
        inside += error @ np.linalg.solve(fit.camera.covariance[np.ix_(index, index)], error) < 9.488
    assert 0.90 < inside / 300 < 0.98


def test_covariance_holds_decentring_that_was_left_out() -> None:
    """Mean squared z of the principal point and of p1, p2 of lenses that have them, fitted without.

    One on average by construction; of 200 lenses 1 +- 0.1 (one sigma, normal z). Without the added part it is over 3.
    """
    rng, sigma = np.random.default_rng(41), np.full(2, 5e-4)
    free, left_out = free_columns(("k1",), True), free_columns(("p1", "p2"), True)[:, -2:]
    poses = poses_of(6, (10, 50), 4)
    z2, z2_without = [], []
    for seed in range(200):
        lens = TRUTH.model_copy(update={"distortion": np.array([-0.081, 0, *(sigma * rng.normal(size=2)), 0])})
        corners = corners_of(poses, lens, 0.1, 1000 + seed)
        fit = adjust(TRUTH, poses, [POINTS] * 6, corners, free)
        more = considered(fit, [POINTS] * 6, corners, free, left_out, sigma)
        error = (lens_vector(fit.camera) - lens_vector(lens))[[2, 3, 6, 7]]
        own = np.diag(fit.camera.covariance)[[2, 3, 6, 7]]
        z2.append(error**2 / (own + np.diag(more)[[2, 3, 6, 7]]))
        z2_without.append(error[:2] ** 2 / own[:2])
    assert np.abs(np.mean(z2, 0) - 1).max() < 0.3
    assert np.mean(z2_without) > 3


def test_agrees_with_opencv() -> None:
    poses = poses_of(8, (10, 50), 5)
    corners = corners_of(poses, TRUTH, 0.1, 5)
    start, found = opencv_bridge.first_calibration([POINTS] * 8, corners, (1024, 768))
    ours = adjust(start, found, [POINTS] * 8, corners, free_columns(("k1",), False)).camera
    flat = [np.stack([POINTS[:, 0], POINTS[:, 2], 0 * POINTS[:, 0]], -1).astype(np.float32)] * 8
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    answer = cv2.calibrateCameraExtended(
        flat, [(c - 0.5).astype(np.float32) for c in corners], (1024, 768), None, None, flags=flags
    )
    K, sigma = answer[1], np.ravel(answer[5])
    # Two least-squares solvers on float32 corners (3e-5 px): equal far inside their own uncertainty.
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5])
    assert np.abs((lens_vector(ours)[:4] - theirs) / sigma[:4]).max() < 0.02
    np.testing.assert_allclose(np.sqrt(np.diag(ours.covariance))[:5], sigma[:5], rtol=0.03)


def test_bad_photograph_is_named_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = corners_of(poses_of(9, (5, 50), 6), TRUTH, 0.03, 6)
    corners[4] = corners[4] + np.random.default_rng(6).normal(size=(24, 2)) * 3
    corners[7] = corners[7][:3]
    result = run(monkeypatch, corners)
    text = "\n".join(result.warnings)
    assert "4.jpg: residual" in text
    assert "7.jpg: 3 corners" in text
    assert result.numbers["photos"] == 7
    assert disagreement(TRUTH, result.outputs["camera"]) < 0.7


def test_fronto_parallel_boards_are_refused_or_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = corners_of(poses_of(6, (0, 2), 7), TRUTH, 0.05, 7)
    try:
        warnings = run(monkeypatch, corners).warnings
    except NumericalError as error:
        warnings = [str(error)]
    assert any("tilt" in text for text in warnings)


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = corners_of(poses_of(5, (5, 50), 8), TRUTH, 0.03, 8)
    with pytest.raises(CaptureError, match=r"1024x768.*640x480"):
        run(monkeypatch, corners, [(768, 1024)] * 4 + [(480, 640)])
    with pytest.raises(CaptureError, match="2 of 5 photographs show the board"):
        run(monkeypatch, corners[:2] + [points[:2] for points in corners[2:]])
    noisy = corners_of(poses_of(5, (5, 50), 8), TRUTH, 3.0, 8)
    with pytest.raises(NumericalError, match=r"needed 1\.0 px"):
        run(monkeypatch, noisy)


def test_given_camera() -> None:
    given = {"width": 640, "height": 480, "fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0, "distortion": [0.1]}
    result = calibrate.compute({"camera": {"given": given}}, {}, [], Reconstruction(), Sources(), knobs.Calibrate())
    camera = result.outputs["camera"]
    assert camera.source == "given"
    np.testing.assert_array_equal(camera.distortion, [0.1, 0, 0, 0, 0])
    assert not camera.covariance.any()
    bad = {**given, "focal": 1.0}
    del bad["fx"]
    with pytest.raises(ManifestError) as error:
        calibrate.compute({"camera": {"given": bad}}, {}, [], Reconstruction(), Sources(), knobs.Calibrate())
    assert len(error.value.problems) == 2


def photographs_of(folder: Path) -> tuple[dict, dict, list[dict[str, str]]]:
    files = sorted(folder.glob("calibration/*.jpg"))
    if not files:
        pytest.skip(f"no capture in {folder}")
    facts = {"capture_root": str(folder), "board": BOARD, "camera": {"calibration": ["x"], "given": None}}
    return facts, {}, [{"file": str(file.relative_to(folder))} for file in files]


@pytest.mark.parametrize(
    ("folder", "truth"),
    [
        (KITCHEN, Camera(width=1200, height=800, fx=1400, fy=1400, cx=606.8, cy=395.7)),
        (
            DESK,
            Camera(width=1024, height=768, fx=1150, fy=1151.2, cx=515.3, cy=381.6,
                   distortion=np.array([-0.081, 0.021, 0.0006, -0.0004, 0.0])),
        ),
    ],
)  # fmt: skip
def test_captures_with_known_lens(folder: Path, truth: Camera) -> None:
    result = calibrate.compute(*photographs_of(folder), Reconstruction(), Sources(), knobs.Calibrate())
    camera = result.outputs["camera"]
    assert result.numbers["rms_px"] < 0.2  # the brief's figure
    assert abs(camera.fx / truth.fx - 1) < 1e-3  # measured 1e-4 and 4e-4
    assert np.hypot(camera.cx - truth.cx, camera.cy - truth.cy) < 1.0  # measured 0.17 and 0.57 px
    assert disagreement(truth, camera) < 1.0  # measured 0.2 and 0.6 px rms over the frame


def test_boards_in_one_corner_and_few_are_flagged_with_what_to_take(monkeypatch: pytest.MonkeyPatch) -> None:
    everywhere = poses_of(60, (10, 50), 9)
    low_right = [p for p in everywhere if (project(TRUTH, camera_points(p, POINTS)[0]) > (300, 200)).all()]
    result = run(monkeypatch, corners_of(low_right[:7], TRUTH, 0.03, 9))
    text = "\n".join(result.warnings)
    assert "upper left" in text
    assert "extrapolated" in text
    assert "photograph next: a board in the" in text
    few = run(monkeypatch, corners_of(poses_of(4, (10, 50), 10), TRUTH, 0.03, 10))
    assert any("4 photographs, needed 6" in text for text in few.warnings)
    assert any("photograph next" in text for text in few.warnings)


def test_a_shifted_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """The principal point off by 20 % of the frame, as a shift lens puts it; the start assumes the middle."""
    shifted = TRUTH.model_copy(update={"cx": 0.7 * 1024, "cy": 0.35 * 768, "distortion": np.array([-0.05, 0, 0, 0, 0])})
    result = run(monkeypatch, corners_of(poses_of(14, (5, 50), 12), shifted, 0.03, 12))
    camera = result.outputs["camera"]
    error = (lens_vector(camera) - lens_vector(shifted))[[0, 2, 3, 4]]
    assert (np.abs(error) <= 4 * np.sqrt(np.diag(camera.covariance))[[0, 2, 3, 4]]).all()
    assert disagreement(shifted, camera) < 1.0


def fisheye_corners(poses: list[np.ndarray], focal: float, sigma: float) -> list[np.ndarray]:
    """Equidistant projection, r = f theta, with its centre in the middle of the frame."""
    rng = np.random.default_rng(13)
    corners = []
    for pose in poses:
        points = camera_points(pose, POINTS)[0]
        across = np.hypot(points[:, 0], points[:, 1])
        radius = focal * np.arctan2(across, points[:, 2])
        px = points[:, :2] / across[:, None] * radius[:, None] + (512, 384)
        corners.append(px + sigma * rng.normal(size=px.shape))
    return corners


def wide_poses() -> list[np.ndarray]:
    """Boards over a frame of 150 degrees across: near, and in every direction."""
    rng, poses = np.random.default_rng(14), []
    for turn in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        for off in (0.3, 0.95):
            pose = looking_at(np.array([0.1, 0, 0.07]), rng.uniform(0, 35), rng.uniform(0, 360), 0.16)
            c, s, a, b = np.cos(off), np.sin(off), np.cos(turn), np.sin(turn)
            axis = np.array([[0, 0, b], [0, 0, -a], [-b, a, 0]])
            pose[:3, :3] = pose[:3, :3] @ (np.eye(3) + s * axis + (1 - c) * axis @ axis)
            poses.append(pose)
    return poses


def test_a_fisheye_that_looks_behind_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """188 degrees across the diagonal: the corners of the frame have no ray before the camera."""
    corners = [px for px in fisheye_corners(wide_poses(), 390.0, 0.03) if (px > 0).all() and (px < (1024, 768)).all()]
    with pytest.raises(NumericalError, match=r"ends within the frame, .* fisheye"):
        run(monkeypatch, corners)


@pytest.mark.parametrize("focal", [450.0, 600.0])
def test_a_fisheye_is_told_and_fitted(monkeypatch: pytest.MonkeyPatch, focal: float) -> None:
    """130 and 98 degrees across the width, equidistant: no term of a fisheye is needed but its own projection."""
    corners = [
        px for px in fisheye_corners(wide_poses(), focal, 0.03) if (px > 0).all() and (px < (1024, 768)).all()
    ]  # fmt: skip
    result = run(monkeypatch, corners)
    camera = result.outputs["camera"]
    assert result.numbers["distortion_model"] == "fisheye"
    assert result.numbers["rms_px"] < 0.05  # 0.03 px each way
    row = next(row for row in result.evidence if row["term"] == "lens fisheye or rational")
    assert row["modelled"]
    truth = camera.model_copy(update={"fx": focal, "fy": focal, "cx": 512.0, "cy": 384.0, "distortion": np.zeros(4)})
    error = lens_vector(camera) - lens_vector(truth)
    assert (np.abs(error[:4]) <= 4 * np.sqrt(np.diag(camera.covariance))[:4] + 1e-9).all()
    assert disagreement(camera, truth) < 1.0


def test_a_mild_fisheye_is_within_browns_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    """51 degrees across, equidistant: what Brown leaves is in the evidence, and below the corners' noise of 0.03 px."""
    result = run(monkeypatch, fisheye_corners(poses_of(14, (5, 50), 15), 1150.0, 0.03))
    row = next(row for row in result.evidence if "fisheye" in row["term"])
    assert not row["modelled"]
    assert float(row["could_cost"].split()[0]) < 0.02
    assert result.numbers["rms_px"] < 0.05


def test_bad_board_frames_are_named(tmp_path: Path) -> None:
    """Rendered pictures: five good ones, one half out of the frame, one out of focus, one of another board."""
    lens = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
    printed, other = charuco_print(BOARD), charuco_print({**BOARD, "dictionary": "DICT_4X4_50"})
    middle = np.array([0.105, 0, 0.075])
    for number, (tilt, azimuth) in enumerate([(35, 0), (35, 90), (40, 180), (35, 270), (10, 45)]):
        save(tmp_path / f"good_{number}.png", photograph(printed, lens, looking_at(middle, tilt, azimuth, 0.42), 3))
    pose = looking_at(middle, 30, 200, 0.42)
    save(tmp_path / "half.png", photograph(printed, lens, looking_at(middle + np.array([0.13, 0, 0]), 30, 20, 0.42), 3))
    save(tmp_path / "blurred.png", cv2.GaussianBlur(photograph(printed, lens, pose, 3), (0, 0), 7))
    save(tmp_path / "other.png", photograph(other, lens, pose, 3))
    facts = {"capture_root": str(tmp_path), "board": BOARD, "camera": {"calibration": ["*"], "given": None}}
    files = [{"file": path.name} for path in sorted(tmp_path.glob("*.png"))]
    result = calibrate.compute(facts, {}, files, Reconstruction(), Sources(), knobs.Calibrate())
    left_out = [text.split(":")[0] for text in result.warnings if "left out" in text]
    assert left_out == ["blurred.png", "other.png"]
    assert "half.png" in result.numbers["photo_rms_px"]
    camera = result.outputs["camera"]
    assert abs(camera.fx - 640) < 4 * np.sqrt(camera.covariance[0, 0])


def save(path: Path, light: np.ndarray) -> None:
    cv2.imwrite(str(path), np.uint8(np.clip(tone(light) * 255, 0, 255)))
