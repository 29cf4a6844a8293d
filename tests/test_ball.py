"""``insitu ball``: JPEG crops of a mirror ball alone, simulated with a known curve and motion, and real ones."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from mirror_scene import Lamp, Place, photograph, sky
from PIL import Image

from pipeline.conventions import direction_from_latlong
from pipeline.image import jpeg
from pipeline.probes import cropped
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.run.formats import read_exr
from pipeline.types import Camera
from stages.ball import ball, exposures_of

DATA = Path(os.environ.get("INSITU_DATA", Path(__file__).resolve().parents[1] / "../shared/data")).resolve()
TIMES = [1 / 8, 1 / 32, 1 / 128, 1 / 512]
LAMPS = [Lamp((0.3, 0.8, -0.4), 0.08, 120.0), Lamp((-0.6, 0.5, -0.5), 0.12, 60.0)]
SHIFTS = [(0, 0), (3, -2), (-4, 1), (2, 5)]  # px, of a hand that does not hold still
DISTANCE = 15.0
GAMMA = 1 / 2.4  # of the simulated camera's curve


@pytest.fixture(scope="module")
def crops(tmp_path_factory) -> list[Path]:
    """Four exposures of a ball 15 radii away, 300 px, with a curve, a little motion and JPEG compression."""
    folder = tmp_path_factory.mktemp("crops")
    camera = Camera(width=300, height=300, fx=2050.0, fy=2050.0, cx=151.0, cy=148.0)
    place = Place(sky(LAMPS), ball=(0.0, 0.0, 0.0), radius=1.0)
    pose = cropped.WORLD_FROM_CAMERA.copy()
    pose[:3, 3] = (0.0, 0.0, -DISTANCE)
    light = photograph(place, camera, pose, 2)
    files = []
    for number, (time, shift) in enumerate(zip(TIMES, SHIFTS, strict=True)):
        moved = np.roll(light, shift[::-1], (0, 1))[6:-6, 6:-6]
        codes = 255 * np.clip(moved * time / 0.6, 0, 1) ** GAMMA
        files.append(folder / f"{number}.jpg")
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x829A] = time
        Image.fromarray(np.rint(codes).astype(np.uint8)).save(files[-1], quality=96, subsampling=0, exif=exif)
    return files


def test_curve_and_radiance_are_recovered(crops):
    frames = [jpeg.read(file) for file in crops]
    assert [frame.exposure for frame in frames] == pytest.approx([100 * time for time in TIMES])
    merged = jpeg.merge(frames)
    codes = np.array([40, 80, 160, 220])
    true = ((codes / 255) ** (1 / GAMMA) / (128 / 255) ** (1 / GAMMA))[:, None]
    assert merged.curve[codes] == pytest.approx(true * np.ones(3), rel=0.02)  # measured 0.8 %; OpenCV's fit: 6 %
    assert (np.abs(merged.curve[codes] / true - 1) < 3 * merged.curve_sigma[codes]).all()


def test_frame_order_changes_nothing(crops):
    frames = [jpeg.read(file) for file in crops]
    assert np.array_equal(jpeg.merge(frames).rgb, jpeg.merge(frames[::-1]).rgb)


def test_ball_and_lamps_are_found(crops, tmp_path):
    numbers = ball(crops, tmp_path / "map.exr", None, DISTANCE, 256, lambda text: None)
    x, y, radius = numbers["circle_px"]
    true_radius = 2050.0 / np.sqrt(DISTANCE**2 - 1)
    assert np.hypot(x - 145.0, y - 142.0) < 1.0  # 6 px were cut off to the left and above
    assert radius == pytest.approx(true_radius, abs=1.5)
    found = np.array([lamp["direction"] for lamp in numbers["lamps"]])
    for lamp in LAMPS:
        toward = np.asarray(lamp.direction) / np.linalg.norm(lamp.direction)
        # 1 px of the outline is 0.8 degrees of a direction at half the radius (2 / 140 px).
        assert np.degrees(np.arccos((found @ toward).max())) < 1.5
    environment = read_exr(tmp_path / "map.exr", "acescg")
    assert environment.attributes["envmap"] == "latlong"
    assert environment["seen"][64, 128] == 0  # +Z: behind the ball
    assert environment["seen"][64, 2] > 0


def test_missing_exposures_are_asked_for(crops, tmp_path):
    bare = tmp_path / "bare.jpg"
    Image.open(crops[1]).save(bare, exif=Image.Exif())
    with pytest.raises(CaptureError, match=r"bare\.jpg: no ExposureTime .* give --exposures"):
        ball([crops[0], bare], tmp_path / "map.exr", None, DISTANCE, 256, lambda text: None)
    ball([crops[0], bare], tmp_path / "map.exr", "1/8,1/32", DISTANCE, 256, lambda text: None)


def test_what_cannot_be_used_is_refused(crops, tmp_path):
    other = tmp_path / "other.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (288, 288, 3)).astype(np.uint8)
    Image.fromarray(noise).save(other, exif=Image.open(crops[1]).getexif())
    with pytest.raises(CaptureError, match=r"other\.jpg"):
        ball([crops[0], other], tmp_path / "map.exr", "1/8,1/32", DISTANCE, 256, lambda text: None)
    with pytest.raises(CaptureError, match="no mirror ball"):
        cropped.find_circle(noise / 255.0)
    (tmp_path / "text.jpg").write_text("no picture")
    with pytest.raises(CaptureError, match="not a readable photograph"):
        jpeg.read(tmp_path / "text.jpg")
    for text in ("1/20", "1/20,x", "1/20,0"):
        with pytest.raises(ManifestError, match="--exposures"):
            exposures_of(text, 2)


def real(name: str, names: tuple[str, ...]) -> list[Path]:
    files = [DATA / name / file for file in names]
    if not all(file.is_file() for file in files):
        pytest.skip(f"INSITU_DATA has no {name}")
    return files


def test_real_ball_in_an_office(tmp_path):
    """Seven ceiling lights; their directions agree with the set's own map after one rotation, the tubes are clipped."""
    files = real("ball_uiuc", ("0024.jpg", "0060.jpg", "0120.jpg", "0205.jpg", "0553.jpg"))
    numbers = ball(files, tmp_path / "map.exr", None, 15.0, 768, lambda text: None)
    assert numbers["circle_px"][2] == pytest.approx(190, abs=4)  # the ball fills the crop, 380 px
    assert 0.001 < numbers["clipped_fraction"] < 0.01
    ours = np.array([lamp["direction"] for lamp in numbers["lamps"]])
    theirs = office_lamps(DATA / "ball_uiuc/latlon.hdr")
    assert len(ours) == len(theirs) == 7
    order = np.argmax(ours @ theirs.T, 0)  # both maps look along the camera: the rotation is small
    left, _, right = np.linalg.svd(theirs.T @ ours[order])
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    cosine = (theirs * (ours[order] @ rotation.T)).sum(-1)
    assert np.degrees(np.arccos(cosine)).max() < 5


def office_lamps(path: Path) -> np.ndarray:
    """Directions (N, 3) of the lights of the set's own map."""
    import cv2

    from pipeline.light.emitters import lights

    rgb = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(float)
    found = [patch.direction for group in lights(rgb, 0.01, np.radians(30)) for patch in group]
    assert direction_from_latlong(0.5, 0.5) == pytest.approx((0, 0, 1))  # of the middle of both maps
    return np.array(found)


def test_real_ball_without_exposures_in_its_files(tmp_path):
    files = real("ball_molly1", ("0020.jpg", "0060.jpg", "0160.jpg", "0320.jpg", "0640.jpg"))
    with pytest.raises(CaptureError, match=r"0060\.jpg, 0160\.jpg, 0320\.jpg, 0640\.jpg: no ExposureTime"):
        ball(files, tmp_path / "map.exr", None, 20.0, 256, lambda text: None)
    numbers = ball(files, tmp_path / "map.exr", "1/20,1/60,1/160,1/320,1/640", 20.0, 256, lambda text: None)
    assert numbers["lamps"][0]["share"] > 0.3  # one strong lamp
    assert numbers["clipped_fraction"] > 5e-4  # even at 1/640


def test_real_ball_from_an_unsteady_hand(tmp_path):
    """The ball moves and grows between frames, and leaves the frame a little: brought together, not averaged."""
    files = real("ball_kartik", ("10.JPG", "40.JPG", "160.JPG"))
    numbers = ball(files, tmp_path / "map.exr", None, 20.0, 256, lambda text: None)
    assert min(numbers["correlations"]) > 0.95
    assert numbers["outline_in_frame"] < 1
