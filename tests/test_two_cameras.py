"""A ball photographed by another body, lens and size than the plate: RAW files, calibration, pose, probe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import manifest
from mirror_scene import Place, look_at, sky
from mirror_scene import photograph as mirrored
from printed_board import BOARD, charuco_print, looking_at, photograph
from test_merge_develop import MATRIX, NEUTRAL, write_frame

from pipeline.camera.rigid import difference
from pipeline.conventions import invert_rigid, latlong_directions, transform_points
from pipeline.image import colour
from pipeline.light.environment import AXES, irradiance
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Balance, Camera, Raster, Reconstruction, Sources, View
from stages import balance, calibrate, develop, ingest, knobs, merge, pose, probe

OTHER_MATRIX = np.array([[0.95, -0.33, -0.10], [-0.38, 1.15, 0.26], [-0.05, 0.16, 0.55]])
D65 = colour.xyz_of_xy(colour.REC709_CHROMATICITIES[3])
DESK = Path(__file__).parents[1] / "sample_captures/desk"
FASTER = 1.25  # the other body's sensitivity at one ISO

REFERENCE = """[[reference]]
name = "grey"
kind = "grey_card"
[[reference.seen]]
view = "plate"
corners_px = [[32, 24], [96, 24], [96, 72], [32, 72]]
[[reference.seen]]
view = "ball"
corners_px = [[24, 20], [88, 20], [88, 68], [24, 68]]
"""
BALL_CAMERA = "{ given = { width = 112, height = 80, fx = 90, fy = 90, cx = 56, cy = 40 } }"
MANIFEST = manifest(
    "two", "plate/*.dng", "ball/*.dng", REFERENCE, BALL_CAMERA, width=128, height=96, fx=100, fy=100, cx=64, cy=48
)


def scene(height: int, width: int, card: tuple[int, int, int, int]) -> np.ndarray:
    """ACEScg radiance (H, W, 3): a grey card in uneven light, red to its left, blue to its right."""
    y, x = np.mgrid[:height, :width] + 0.5
    left, top, right, bottom = card
    level = 6 * (1 + 0.2 * (x - left) / (right - left))
    rgb = level[..., None] * np.where((x < width / 2)[..., None], (0.9, 0.3, 0.2), (0.2, 0.4, 0.9))
    on = (x > left - 4) & (x < right + 4) & (y > top - 4) & (y < bottom + 4)
    return np.where(on[..., None], level[..., None] * np.ones(3), rgb)


CARDS = {"plate": (32, 24, 96, 72), "ball": (24, 20, 88, 68)}
SIZES = {"plate": (96, 128), "ball": (80, 112)}


def as_seen_by(matrix: np.ndarray, neutral: np.ndarray, acescg: np.ndarray) -> np.ndarray:
    """What `write_frame`, whose sensor is the plate's, must be given to write another sensor's response."""
    here, there = colour.acescg_from_camera(MATRIX, NEUTRAL), colour.acescg_from_camera(matrix, neutral)
    return acescg @ np.linalg.inv(there).T @ here.T


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two bodies: other matrix, other size, faster, its white balance set to tungsten; one setting in both."""
    (tmp_path / "capture.toml").write_text(MANIFEST)
    seen = OTHER_MATRIX @ D65 / (OTHER_MATRIX @ D65)[1]
    for number, label in enumerate((1 / 128, 1 / 32)):  # what such labels mean
        write_frame(tmp_path / f"plate/{number}.dng", scene(*SIZES["plate"], CARDS["plate"]), label, label, number)
        acescg = as_seen_by(OTHER_MATRIX, seen, scene(*SIZES["ball"], CARDS["ball"]))
        write_frame(
            tmp_path / f"ball/{number}.dng", acescg, label, label * FASTER, 10 + number,
            model="Two", color_matrix=OTHER_MATRIX, neutral=seen * (0.6, 1, 1.7),
        )  # fmt: skip
    return tmp_path


def test_raw_files_of_two_bodies_come_to_one_radiance(folder):
    index = ingest.compute(folder, None, knobs.Ingest()).outputs
    merged = merge.compute(index["facts"], index["brackets"], knobs.Merge())
    assert any(text.startswith("ball: neither static scene nor exposure setting ties it") for text in merged.warnings)
    developed = develop.compute({}, merged.outputs["mosaics"], knobs.Develop(demosaic="bilinear"))
    shots = developed.outputs["photographs"]
    assert {view: shot.shape for view, shot in shots.items()} == SIZES
    # its own matrices and the plate's white: colours differ by the sensitivity alone, whatever its white balance says
    for columns in (slice(8, 16), slice(96, 104)):  # red, blue
        ratio = shots["ball"].rgb()[:16, columns] / scene(*SIZES["ball"], CARDS["ball"])[:16, columns]
        assert np.median(ratio, (0, 1)) == pytest.approx(np.full(3, FASTER), rel=0.02)  # noise and demosaicking
    result = balance.compute(index["facts"], index["brackets"], merged.outputs["exposures"], shots, knobs.Balance())
    found = result.outputs["balance"]["ball"]
    assert found.applied
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(np.log(found.gains * FASTER)) < 3 * sigma).all()
    assert any(row["term"] == "colour of Maker Two" for row in developed.evidence)


def test_neutral_of_a_white_undoes_the_white_of_a_neutral():
    warm = colour.xyz_of_xy(np.array([0.42, 0.39]))
    two = {"color_matrix_2": MATRIX * 1.03 + 0.01, "illuminant": 17, "illuminant_2": 21}
    for more in ({}, two):
        neutral = colour.neutral_of_white(warm, MATRIX, **more)
        white = colour.camera_white(MATRIX, neutral, **more)[1]
        assert white / white[1] == pytest.approx(warm, rel=1e-6)


def test_a_ball_of_another_size_must_state_its_camera(folder):
    text = MANIFEST.replace("camera = { given", "# camera = { given")
    (folder / "capture.toml").write_text(text)
    with pytest.raises(CaptureError, match=r"ball: its frames are 112 x 80 .*state the ball's own camera"):
        ingest.compute(folder, None, knobs.Ingest())


def test_another_model_without_a_camera_of_its_own_is_pointed_out(folder):
    for number in range(2):
        write_frame(
            folder / f"ball/{number}.dng", scene(*SIZES["plate"], CARDS["plate"]), 0.1, 0.1, number, model="Two"
        )
    text = MANIFEST.replace("camera = { given", "# camera = { given")
    (folder / "capture.toml").write_text(text)
    warnings = ingest.compute(folder, None, knobs.Ingest()).warnings
    assert any("ball: taken with Maker Two, the plate with Maker One; the plate's lens" in text for text in warnings)


def test_a_reference_outside_its_photograph_is_refused(folder):
    text = MANIFEST.replace("[[24, 20], [88, 20], [88, 68]", "[[24, 20], [118, 20], [88, 68]")
    (folder / "capture.toml").write_text(text)
    with pytest.raises(ManifestError, match=r"capture.toml:26: reference\[0\].seen\[1\].corners_px: reach x 24 to 118"):
        ingest.compute(folder, None, knobs.Ingest())


def test_cameras_of_views_are_kept_apart():
    given = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
    other = {"given": {**given, "fx": 900.0, "fy": 900.0}, "calibration": []}
    balls = [{"name": "a", "camera": None}, {"name": "b", "camera": other}, {"name": "c", "camera": other}]
    result = calibrate.compute(
        {"camera": {"given": given}, "ball": balls}, {}, [], Reconstruction(), Sources(), knobs.Calibrate()
    )
    assert result.outputs["camera"].fx == 600
    assert {name: camera.fx for name, camera in result.outputs["view_cameras"].items()} == {"b": 900, "c": 900}
    balls[1] = {"name": "b", "camera": {"given": {"fx": 1}, "calibration": []}}
    with pytest.raises(ManifestError) as error:
        calibrate.compute(
            {"camera": {"given": given}, "ball": balls}, {}, [], Reconstruction(), Sources(), knobs.Calibrate()
        )
    assert "ball[1].camera.given.fy: missing; it is required" in str(error.value)


def test_a_balls_own_board_photographs_calibrate_its_camera():
    files = sorted(DESK.glob("calibration/*.jpg"))
    given = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
    facts = {
        "capture_root": str(DESK), "board": BOARD, "camera": {"given": given, "calibration": []},
        "ball": [{"name": "b", "camera": {"calibration": ["x"], "given": None}}],
    }  # fmt: skip
    photos = [{"file": str(file.relative_to(DESK)), "view": "b"} for file in files]
    result = calibrate.compute(facts, {}, photos, Reconstruction(), Sources(), knobs.Calibrate())
    assert result.outputs["camera"].fx == 600
    assert result.outputs["view_cameras"]["b"].fx == pytest.approx(1150, rel=1e-3)  # the desk's true lens
    assert result.numbers["b"]["rms_px"] < 0.2
    assert all("(b)" in row["term"] for row in result.evidence[1:])


PLATE_CAMERA = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
BALL_CAMERA = Camera(
    width=400, height=420, fx=760, fy=755, cx=190.0, cy=215.0, distortion=np.array([-0.15, 0.03, 0, 0, 0])
)


def test_pose_of_each_view_by_its_own_camera():
    centre = np.array([0.105, 0, 0.075])
    places = {"plate": looking_at(centre, 40, 10, 0.42), "ball": looking_at(centre, 35, 80, 0.5)}
    cameras = {"plate": PLATE_CAMERA, "ball": BALL_CAMERA}
    shots = {name: photograph(charuco_print(BOARD), cameras[name], place, 4) for name, place in places.items()}
    rasters = {name: Raster({c: np.asarray(s, np.float32) for c in "RGB"}, "acescg") for name, s in shots.items()}
    facts = {"board": BOARD, "marker": None, "ball": [{"name": "ball"}], "pose": []}
    result = pose.compute(facts, rasters, PLATE_CAMERA, {"ball": BALL_CAMERA}, Reconstruction(), [], knobs.Pose())
    views = result.outputs["views"]
    assert views["plate"].camera is None
    assert views["ball"].camera == BALL_CAMERA or views["ball"].camera.fx == 760
    for name, place in places.items():
        delta = difference(views[name].world_from_camera, place)
        assert np.degrees(np.linalg.norm(delta[:3])) < 0.1  # the brief's figure
        assert np.linalg.norm(delta[3:]) < 0.002 * 0.42
        assert delta @ np.linalg.solve(views[name].covariance, delta) < 22.5  # 99.9 % of chi2, six degrees of freedom
    with pytest.raises(CaptureError, match="ball: photograph is 400x420, camera is 480x360"):
        pose.compute(facts, rasters, PLATE_CAMERA, {}, Reconstruction(), [], knobs.Pose())


RADIUS = 0.04
UP = int(np.argmax(AXES[:, 1]))
CAST = np.array([1.2, 0.9, 0.7])  # of the other body: what the ball's photograph is multiplied by


@pytest.fixture(scope="module")
def shots() -> dict[str, Any]:
    """The plate by one camera, the ball by another of longer focus, other size and distortion; 0.3 % noise."""
    place = Place(sky([]), plane=True, ball=(0.02, RADIUS, 0.01))
    empty = Place(place.light, plane=True, ball=None)
    plate_camera = Camera(width=240, height=180, fx=420, fy=420, cx=118, cy=92)
    a, b = look_at((0.08, 0.27, 0.40), (0.03, 0.03, 0)), look_at((0.45, 0.30, 0.05), (0.03, 0.03, 0))
    covariance = np.eye(6) * 2e-4**2

    def view(pose: np.ndarray, camera: Camera | None = None) -> View:
        return View(world_from_camera=pose, covariance=covariance, route="given", rms_px=0.1, points=20, camera=camera)

    def raster(picture: np.ndarray) -> Raster:
        variance = Raster.split(np.float32((0.003 * picture) ** 2), "variance")
        mask = np.zeros(picture.shape[:2], np.uint32)
        return Raster({**Raster.split(np.float32(picture)), **variance, "mask": mask}, "acescg")

    camera = Camera(width=300, height=280, fx=900, fy=898, cx=143, cy=146, distortion=np.array([-0.2, 0.05, 0, 0, 0]))
    ball = mirrored(place, camera, b, 2, 0.003, 2)
    photographs = {"plate": raster(mirrored(empty, plate_camera, a, 2, 0.003, 1)), "ball": raster(ball)}
    cast = {**photographs, "ball": raster(ball * CAST)}
    views = {"plate": view(a), "ball": view(b, camera)}
    return {"place": place, "camera": plate_camera, "views": views, "photographs": photographs, "cast": cast}


def light(shots: dict[str, Any], which: str, balanced: dict[str, Balance]):
    facts = {
        "ball": [{"name": "ball", "tripod": False}],
        "probe": {"kind": "mirror_ball", "diameter_m": 2 * RADIUS, "reflectance": (0.8, 0.8, 0.8),
                  "reflectance_space": "acescg"},
    }  # fmt: skip
    return probe.compute(
        facts, shots[which], shots["camera"], shots["views"], balanced, {}, knobs.Probe(width=64, supersample=2)
    )


def test_the_ball_is_found_and_unwrapped_by_its_own_camera(shots):
    result = light(shots, "photographs", {})
    ball = result.outputs["balls"]["ball"]
    true = transform_points(invert_rigid(shots["views"]["ball"].world_from_camera), np.array(shots["place"].ball))
    error = ball.centre_camera_m - true
    assert ball.radius_px == pytest.approx(900 * RADIUS / true[2], rel=0.02)
    assert error @ np.linalg.solve(ball.covariance, error) < 16.3  # 99.9 % of chi2, three degrees of freedom
    directions = latlong_directions(64, 128).reshape(-1, 3)
    truth = shots["place"].radiance(np.tile(shots["place"].ball, (len(directions), 1)), directions).reshape(64, 128, 3)
    found = irradiance(result.outputs["environment"].rgb(), AXES[[UP]]) / irradiance(truth, AXES[[UP]])
    assert found == pytest.approx(1, abs=0.003)  # measured 0.0005; the wall behind the ball is filled


def test_gains_undo_the_other_bodys_cast(shots):
    """The same light from the photograph with a cast and its gains as from the one without; and not without them."""
    gains = Balance(gains=1 / CAST, covariance=np.eye(3) * 1e-4, references=["grey"], applied=True)
    plain, undone, left = (
        irradiance(light(shots, which, balanced).outputs["environment"].rgb(), AXES)
        for which, balanced in (("photographs", {}), ("cast", {"ball": gains}), ("cast", {}))
    )
    assert undone == pytest.approx(plain, rel=1e-5)  # float32; measured 6e-8
    assert left[UP] / plain[UP] == pytest.approx(CAST, rel=0.05)
