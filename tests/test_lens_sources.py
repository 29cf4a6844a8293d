"""Where a lens comes from besides good boards: EXIF, a former calibration, RAW boards; and what a set lacks."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import tifffile
from printed_board import BOARD, charuco_print, looking_at, photograph
from pydantic import ValidationError
from test_calibrate import POINTS, TRUTH, corners_of, poses_of

from pipeline.camera import exif_camera as exif
from pipeline.camera import former_camera, lens, residual_pattern, view_set
from pipeline.camera.adjustment import adjust, free_columns
from pipeline.camera.board_pictures import board_picture
from pipeline.camera.opencv_bridge import board_sightings
from pipeline.camera.resection import refine
from pipeline.camera.rigid import camera_points, difference
from pipeline.image.frames import read_frame
from pipeline.image.lens_database import distortion_samples
from pipeline.run.errors import CaptureError
from pipeline.run.manifest import BallFacts, CameraFacts
from pipeline.types import Bracket, Camera, Frame, Reconstruction, Sources
from stages import calibrate, knobs
from tests.dng_writer import write_dng

DATA = Path(os.environ.get("INSITU_DATA", "../shared/data"))
CANON, ZOOM = "Canon EOS 5D Mark III", "EF24-105mm f/4L IS USM"


def frame_of(**facts: object) -> Frame:
    stated = {
        "file": "plate.dng", "sha256": "0", "exposure_s": 0.1, "iso": 100, "fnumber": 8, "width": 6000, "height": 4000,
        "cfa": "RGGB", "black": np.zeros((2, 2)), "white": 4095.0,
    }  # fmt: skip
    return Frame(**(stated | facts))


# A camera from EXIF ---------------------------------------------------------------------------------------------------


def test_focal_length_by_label_and_sensor() -> None:
    """50 mm on 36 x 24 mm is 50 / 36 of the picture's width, which is exact for a 3:2 picture."""
    camera, numbers, warnings, _ = exif.exif_camera(frame_of(camera=CANON, focal_mm=50.0))
    assert camera.fx == camera.fy == pytest.approx(6000 * 50 / 36)
    assert (camera.cx, camera.cy) == (3000, 2000)
    assert np.sqrt(camera.covariance[0, 0]) / camera.fx == pytest.approx(0.04)
    assert np.sqrt(camera.covariance[2, 2]) == pytest.approx(60)
    assert numbers["source"] == camera.source == "exif"
    assert "known to 4% only" in warnings[0]
    square = exif.exif_camera(frame_of(camera=CANON, focal_mm=50.0, height=6000))[0]
    assert np.sqrt(square.covariance[0, 0]) / square.fx == pytest.approx(0.05)  # cut, and nobody says how


def test_focal_length_by_its_equivalent() -> None:
    """Of the diagonal: 26 mm of a 4:3 telephone is 26 / 43.27 of it, 4 % more than by the width of 36 mm."""
    phone = frame_of(camera="Maker Phone", focal_mm=4.2, focal_35mm=26.0, width=4000, height=3000, encoding="display")
    camera = exif.exif_camera(phone)[0]
    assert camera.fx == pytest.approx(26 / np.hypot(36, 24) * 5000)
    assert np.sqrt(camera.covariance[0, 0]) / camera.fx == pytest.approx(0.05)
    assert not camera.distortion.any()
    cropped = exif.exif_camera(frame_of(camera=CANON, focal_mm=50.0, focal_35mm=75.0))[0]  # the sensor's middle only
    assert cropped.fx == pytest.approx(6000 * 75 / 36)


@pytest.mark.parametrize("facts", [{}, {"focal_mm": 50.0}, {"focal_mm": 50.0, "camera": "No Such Camera"}])
def test_no_word_on_the_lens(facts: dict) -> None:
    with pytest.raises(CaptureError, match=r"plate.dng: focal length in EXIF: .*; needed one with its sensor"):
        exif.exif_camera(frame_of(**facts))


def test_a_fisheye_is_refused() -> None:
    name = "AF DX Fisheye-Nikkor 10.5mm f/2.8G ED"
    with pytest.raises(CaptureError, match="is a fisheye"):
        exif.exif_camera(frame_of(camera="NIKON CORPORATION NIKON D7000", lens=name, focal_mm=10.5))


def test_a_real_lens_lies_within_what_is_stated() -> None:
    """Eleven photographs by a compact of 2001: COLMAP's tracks say 697.1 +- 0.8 px and k1 = -0.19 (conventions)."""
    file = DATA / "sfm_kermit/kermit000.jpg"
    if not file.is_file():
        pytest.skip(f"no {file}")
    camera = exif.exif_camera(read_frame(file))[0]
    assert abs(camera.fx - 697.1) < 2 * np.sqrt(camera.covariance[0, 0])
    assert abs(-0.193) < 2.5 * np.sqrt(camera.covariance[4, 4])


def test_distortion_of_the_database() -> None:
    """The camera bends rays as lensfun says (odd powers of the radius as Brown's even ones: to 0.6 px of 6000)."""
    frame = frame_of(camera=CANON, lens=ZOOM, focal_mm=24.0)
    camera, _, _, evidence = exif.exif_camera(frame)
    straight, bent, model = distortion_samples(CANON, ZOOM, 24.0, 4000, 6000)
    xy = straight[:, None] * np.array([0.6, 0.8]) / (6000 * 24 / 36)
    px = lens.project(camera, np.concatenate([xy, np.ones((len(xy), 1))], -1))
    assert np.abs(np.hypot(*(px - (3000, 2000)).T) - bent).max() < 1.0
    assert bent[-1] / straight[-1] < 0.98  # a barrel
    assert model in evidence[1]["because"]
    finished = exif.exif_camera(frame.model_copy(update={"encoding": "display", "cfa": ""}))[0]
    assert not finished.distortion.any()


def test_the_pose_carries_what_exif_does_not_know() -> None:
    """True lenses drawn from the stated uncertainty; the pose's 95 % region holds the truth in 90 % or more.

    More than 95 % is right: a wrong focal length shows in the residuals, which widen the covariance further.
    """
    frame = frame_of(width=1024, height=768, camera=CANON, focal_mm=37.0)
    camera = exif.exif_camera(frame)[0]
    rng = np.random.default_rng(5)
    inside, count = 0, 100
    for pose in poses_of(count, (25, 50), 11):
        values = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
        drawn = rng.multivariate_normal(values, camera.covariance)
        truth = camera.model_copy(
            update=dict(zip(("fx", "fy", "cx", "cy"), drawn[:4], strict=True)) | {"distortion": drawn[4:]}
        )
        px = lens.project(truth, camera_points(pose, POINTS)[0]) + 0.1 * rng.normal(size=(24, 2))
        found = refine(camera, pose, POINTS, px, 0.1)
        error = difference(found.world_from_camera, pose)
        inside += error @ np.linalg.solve(found.covariance, error) < 12.59
    assert inside / count >= 0.90


def test_stage_without_anything_but_exif() -> None:
    bracket = Bracket(name="plate", role="plate", frames=[frame_of(camera=CANON, focal_mm=50.0)])
    facts = {"camera": {"calibration": [], "given": None}, "views": None, "lens": {"name": ZOOM}}
    result = calibrate.compute(facts, {"plate": bracket}, [], Reconstruction(), Sources(), knobs.Calibrate())
    assert result.outputs["camera"].source == "exif"
    assert result.outputs["camera"].lens == ZOOM
    assert len(result.warnings) == 1


# A former calibration -------------------------------------------------------------------------------------------------


def former(**changes: object) -> Camera:
    covariance = np.diag([4.0, 4, 1, 1, 1e-6, 0, 0, 0, 0])
    named = {"body": CANON, "lens": ZOOM, "focal_mm": 50.0, "covariance": covariance, "source": "calibrated"}
    return Camera(width=6000, height=4000, fx=8300, fy=8301, cx=3010, cy=1990, distortion=[-0.1, 0, 0, 0, 0], **named
                  ).model_copy(update=changes)  # fmt: skip


def test_a_former_calibration_is_taken_up(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(former().model_dump_json())
    facts = {"camera": {"file": "camera.json", "given": None, "calibration": []}, "ball": [], "views": None}
    assert former_camera.add_former_cameras(facts, tmp_path / "capture.toml", [tmp_path]) == []
    bracket = Bracket(name="plate", role="plate", frames=[frame_of(camera=CANON, lens=ZOOM, focal_mm=50.0)])
    result = calibrate.compute(facts, {"plate": bracket}, [], Reconstruction(), Sources(), knobs.Calibrate())
    camera = result.outputs["camera"]
    np.testing.assert_array_equal(camera.covariance, former().covariance)
    assert (camera.fx, camera.source, result.warnings) == (8300, "reused", [])
    assert "refocused" in result.evidence[0]["could_cost"]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"width": 3000, "height": 2000}, "is the camera of 3000x2000, plate.dng is 6000x4000"),
        ({"body": "Canon EOS R5"}, "body 'Canon EOS R5', plate.dng is 'Canon EOS 5D Mark III'"),
        ({"lens": "EF50mm f/1.4 USM"}, "lens 'EF50mm f/1.4 USM', plate.dng is 'EF24-105mm"),
        ({"focal_mm": 51.0}, "focal length 51 mm, plate.dng is 50 mm"),
    ],
)
def test_another_cameras_calibration_is_refused(changes: dict, text: str) -> None:
    frame = frame_of(camera=CANON, lens=ZOOM, focal_mm=50.0)
    with pytest.raises(CaptureError) as error:
        former_camera.reused(former(**changes), frame, "camera")
    assert text in str(error.value)


def test_what_metadata_do_not_say_is_said() -> None:
    _, warnings, _ = former_camera.reused(former(focal_mm=0.0), frame_of(camera=CANON, lens=ZOOM), "camera")
    assert "state no focal length" in warnings[0]


@pytest.mark.parametrize("text", ["{", "[]", '{"width": 3}', json.dumps({"fx": 1})])
def test_what_is_no_camera(tmp_path: Path, text: str) -> None:
    (tmp_path / "camera.json").write_text(text)
    facts = {"camera": {"file": "camera.json"}, "ball": [{"camera": {"file": "none.json"}}]}
    problems = former_camera.add_former_cameras(facts, tmp_path / "capture.toml", [tmp_path])
    assert "camera.file: is 'camera.json'; expected the camera.json" in problems[0]
    assert "ball[0].camera.file: is 'none.json'; no such file" in problems[1]


# RAW photographs of a board -------------------------------------------------------------------------------------------


def test_corners_of_a_raw_board(tmp_path: Path) -> None:
    """A mosaic under lamp light (red 2.2 times blue). Measured 0.061 px rms, of which 0.055 are in the grey picture
    before the mosaic: its edges come from nine rays a pixel."""
    camera = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
    pose = looking_at(np.array([0.105, 0, 0.075]), 35, 20, 0.42)
    light = photograph(charuco_print(BOARD), camera, pose, 3)
    rgb = light[..., None] * np.array([1.0, 0.9, 0.45])
    mosaic = np.empty(light.shape)
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[row::2, column::2] = rgb[row::2, column::2, channel]
    path = tmp_path / "board.dng"
    write_dng(path, np.uint16(512 + mosaic * 15000))
    plain, precise = board_picture(path)
    assert plain.shape == (360, 480)
    assert plain.dtype == np.uint8
    seen = board_sightings(plain, precise, BOARD)
    assert len(seen.px) == 24
    off = seen.px - lens.project(camera, camera_points(pose, seen.world_m)[0])
    assert np.sqrt((off**2).mean()) < 0.08
    assert np.abs(off.mean(0)).max() < 0.03  # no half pixel, no shift of the colours


def test_a_deep_tiff_keeps_its_corners(tmp_path: Path) -> None:
    """16 bit, nearly black: 8 bit would leave 10 steps between black and white. Twice the brightness, same corners."""
    camera = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
    pose = looking_at(np.array([0.105, 0, 0.075]), 35, 20, 0.42)
    light = photograph(charuco_print(BOARD), camera, pose, 2)
    found = []
    for number, scale in enumerate((3000, 6000)):
        tifffile.imwrite(tmp_path / f"{number}.tif", np.repeat(np.uint16(light * scale)[..., None], 3, -1))
        found.append(board_sightings(*board_picture(tmp_path / f"{number}.tif"), BOARD).px)
    assert len(found[0]) == 24
    assert np.abs(found[0] - found[1]).max() < 0.02


# In the manifest ------------------------------------------------------------------------------------------------------


def test_a_former_camera_stands_alone() -> None:
    assert CameraFacts(file="camera.json").file == "camera.json"
    with pytest.raises(ValidationError, match="a former calibration stands alone"):
        CameraFacts(file="camera.json", calibration=["*.jpg"])
    ball = {"name": "ball_b", "files": ["b.dng"], "camera": {"file": "camera.json"}}
    assert BallFacts.model_validate(ball).camera is not None


# What a set of photographs fixes --------------------------------------------------------------------------------------


def less_rotation(camera: Camera, other: Camera) -> float:
    """Rms distance, px, over the frame between two lenses' pictures of one bundle of rays, best turned."""
    y, x = np.meshgrid(np.linspace(0, 768, 7), np.linspace(0, 1024, 9), indexing="ij")
    rays = lens.pixel_rays(camera, np.stack([x, y], -1).reshape(-1, 2))

    def off(turn: np.ndarray) -> np.ndarray:
        return (lens.project(other, rays + np.cross(turn, rays)) - lens.project(camera, rays)).ravel()

    slope = np.stack([(off(1e-6 * e) - off(-1e-6 * e)) / 2e-6 for e in np.eye(3)], -1)
    left = off(np.zeros(3)) - slope @ np.linalg.lstsq(slope, off(np.zeros(3)), rcond=None)[0]
    return float(np.sqrt((left.reshape(-1, 2) ** 2).sum(-1).mean()))


def test_sigma_of_the_lens_over_the_frame() -> None:
    """Against 60 simulated calibrations: rms of their errors over the frame, less rotation, to 20 % (3 sigma of 60)."""
    poses = poses_of(6, (10, 50), 4)
    free = free_columns(("k1", "k2"), True)
    found = [
        less_rotation(TRUTH, adjust(TRUTH, poses, [POINTS] * 6, corners_of(poses, TRUTH, 0.05, seed), free).camera)
        for seed in range(60)
    ]
    views = view_set.ViewSet(TRUTH, poses, [POINTS] * 6, corners_of(poses, TRUTH, 0.0, 0), 0.05)
    stated = view_set.lens_sigma(TRUTH, view_set.summed(views), 0.05)[0]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(stated, rel=0.2)


@pytest.mark.parametrize(("tilts", "gain"), [((0, 2), 20.0), ((10, 50), 1.3)])
def test_the_next_photograph_helps(tilts: tuple[float, float], gain: float) -> None:
    poses = poses_of(6, tilts, 7)
    views = view_set.ViewSet(TRUTH, poses, [POINTS] * 6, corners_of(poses, TRUTH, 0.05, 7), 0.05)
    before = view_set.lens_sigma(TRUTH, view_set.summed(views), 0.05)[0]
    text, after = view_set.next_photograph(views)
    assert "tilted by 40 degrees" in text
    assert before / after > gain


def test_a_proposed_board_is_where_its_words_say() -> None:
    ends = {"left": (0, -1), "right": (0, 1), "upper": (1, -1), "lower": (1, 1)}
    for side, turn in view_set.TILTS.items():
        pose = view_set.proposed_pose(TRUTH, POINTS, turn, (-1, -1))
        points = camera_points(pose, POINTS)[0]
        px = lens.project(TRUTH, points)
        assert (px.mean(0) < (0.4 * 1024, 0.4 * 768)).all()
        axis, sign = ends[side]
        away = points[np.argmax(sign * px[:, axis]), 2] - points[np.argmin(sign * px[:, axis]), 2]
        assert away > 0.02


def test_a_pattern_of_residuals_is_told_from_noise() -> None:
    rng = np.random.default_rng(2)
    px = [rng.uniform((0, 0), (1024, 768), (40, 2)) for _ in range(10)]
    noise = [0.1 * rng.normal(size=(40, 2)) for _ in px]
    quiet = residual_pattern.pattern(px, noise, 1024, 768)
    assert quiet.chance > 1e-3
    assert quiet.rms_px < 0.03
    assert quiet.cells == 12

    def bend(at: np.ndarray) -> np.ndarray:  # radial, and it changes its sign across the frame
        away = (at - (512, 384)) / 640
        return 1.2 * away * (np.hypot(*away.T)[:, None] - 0.5)

    bent = residual_pattern.pattern(px, [n + bend(at) for n, at in zip(noise, px, strict=True)], 1024, 768)
    assert bent.chance < 1e-6
    truth = np.sqrt(np.mean([(bend(at) ** 2).sum(-1).mean() for at in px]))
    assert 0.6 * truth < bent.rms_px < 1.1 * truth  # means over cells lose some of it
    biased = [n + rng.normal(size=2) for n in noise]  # a photograph that is off as a whole is none of the lens's
    assert residual_pattern.pattern(px, biased, 1024, 768).chance > 1e-3
