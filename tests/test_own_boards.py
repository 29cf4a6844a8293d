"""EXIF's lens made surer by boards in the capture's own views: coverage, what gains nothing, and through the stages."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import BOARD, charuco_print, looking_at, photograph

from pipeline.camera.adjustment import lens_vector, with_lens
from pipeline.camera.lens import project
from pipeline.camera.own_boards import bundle_of_boards, sharpened
from pipeline.camera.rigid import camera_points
from pipeline.camera.sfm import Seen
from pipeline.types import Bracket, Camera, Frame, Raster, Reconstruction
from stages import calibrate, knobs, sources

X, Z = np.meshgrid(np.arange(1, 7) * 0.03, np.arange(1, 5) * 0.03)
POINTS = np.stack([X.ravel(), 0 * X.ravel(), Z.ravel()], -1)
CENTRE = np.array([0.105, 0, 0.075])
FREE = [0, 2, 3, 4]  # of fx fy cx cy k1: one focal length
CHI2_4 = 9.488  # 95 % of chi-square with four degrees of freedom


def by_words() -> Camera:
    """1100 px, known to 5 %, the axis to 1 % of the side, the corners to 3 % of their radius, as for EXIF."""
    sigma = np.array([55.0, 55.0, 10.24, 10.24, 0.03 / (640 / 1100) ** 2, 0, 0, 0, 0])
    covariance = np.diag(sigma**2)
    covariance[0, 1] = covariance[1, 0] = 55.0**2
    return Camera(width=1024, height=768, fx=1100, fy=1100, cx=512, cy=384, covariance=covariance, source="exif")


def seen_boards(rng: np.random.Generator, lens: Camera, tilts: list[tuple[float, float]]) -> dict[str, Seen]:
    """A board 350 to 550 mm away by views of these tilts and azimuths [deg], corners to 0.1 px."""
    views = {}
    for number, (tilt, azimuth) in enumerate(tilts):
        pose = looking_at(CENTRE, tilt, azimuth, rng.uniform(0.35, 0.55), rng.uniform(-30, 30))
        exact = project(lens, camera_points(pose, POINTS)[0])
        views[str(number)] = Seen(0, POINTS, exact + 0.1 * rng.normal(size=exact.shape))
    return views


def test_regions_hold_lenses_drawn_from_exifs_word() -> None:
    """60 lenses, three views each: 95 % regions, less three standard errors of 60 trials (0.084), hold 0.866."""
    words = by_words()
    sigma = np.sqrt(np.diag(words.covariance))
    inside, left = 0, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        off = sigma * rng.normal(size=9)
        off[1] = off[0]
        true = with_lens(words, lens_vector(words) + off)
        views = seen_boards(rng, true, [(rng.uniform(20, 55), rng.uniform(0, 360)) for _ in range(3)])
        found = sharpened(words, bundle_of_boards(words, views, 0.1, 4.0), 0.1)
        assert found is not None
        error = (lens_vector(found[0]) - lens_vector(true))[FREE]
        covariance = found[0].covariance[np.ix_(FREE, FREE)]
        inside += bool(error @ np.linalg.solve(covariance, error) <= CHI2_4)
        left.append(np.sqrt(covariance[0, 0]) / sigma[0])
    assert inside / 60 > 0.866
    assert np.median(left) < 0.1  # measured 0.075: 5 % become 0.4 %


def test_a_board_seen_squarely_changes_nothing() -> None:
    words = by_words()
    views = seen_boards(np.random.default_rng(1), words, [(0.5, 10)])
    boards = bundle_of_boards(words, views, 0.1, 1.0)
    assert len(boards.poses) == 1
    assert sharpened(words, boards, 0.1) is None
    assert sharpened(words, bundle_of_boards(words, {}, 0.1, 4.0), 0.1) is None


@pytest.fixture(scope="module")
def made():
    """Both stages on a plate and a hand-held ball view that show the board; EXIF says 5 % too much."""
    true = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1, distortion=np.array([-0.1, 0.02, 0, 0, 0]))
    at = {"plate": looking_at(CENTRE, 40, 10, 0.42), "hand": looking_at(CENTRE, 35, 80, 0.45)}
    rasters = {
        name: Raster(dict.fromkeys("RGB", photograph(charuco_print(BOARD), true, pose, 3)), "acescg")
        for name, pose in at.items()
    }
    frame = Frame(file="p.dng", sha256="", exposure_s=1, iso=100, fnumber=8, width=480, height=360, cfa="", white=255,
                  black=np.zeros((1, 3)), focal_35mm=1.05 * 640 / 600 * float(np.hypot(36, 24)))  # fmt: skip
    facts = {"board": BOARD, "marker": [], "ball": [{"name": "hand", "tripod": False}], "pose": [], "lens": None,
             "capture_root": ".", "views": None, "camera": {"given": None}}  # fmt: skip
    brackets = {"plate": Bracket(name="plate", role="plate", frames=[frame])}
    decided = sources.compute(facts, {"object": []}, brackets, [], [], rasters, knobs.Sources())
    found = calibrate.compute(facts, brackets, [], Reconstruction(), decided.outputs["sources"], knobs.Calibrate())
    return true, decided, found


def test_the_plate_is_its_own_calibration(made) -> None:
    true, decided, found = made
    camera = found.outputs["camera"]
    assert camera.source == "exif and boards"
    sigma = np.sqrt(np.diag(camera.covariance))
    error = lens_vector(camera) - lens_vector(true)
    assert (np.abs(error[FREE]) < 4 * sigma[FREE]).all(), (error, sigma)
    assert abs(camera.fx / true.fx - 1) < 0.02  # EXIF: 5 %
    assert found.numbers["focal_sigma_rel"] == pytest.approx(sigma[0] / camera.fx)
    row = next(row for row in decided.evidence if row["term"] == "EXIF's lens by boards in view")
    assert row["because"].startswith("2 views show them: focal length -")
    assert decided.warnings == []
    assert decided.outputs["sources"].cloud is False


def test_what_is_said_of_the_lens_is_what_boards_made_of_it(made) -> None:
    """Not EXIF's word: that is 5 % of the focal length by rule, and no distortion."""
    _, _, found = made
    camera = found.outputs["camera"]
    rows = {row["term"]: row for row in found.evidence}
    sigma = np.sqrt(np.diag(camera.covariance))
    assert rows["focal length"]["could_cost"].startswith(f"{sigma[0] / camera.fx:.2%} of distances")
    assert camera.distortion[0] != 0
    assert rows["distortion"]["modelled"]
    at_corner = project_corner(camera, sigma[4]) - project_corner(camera, 0.0)
    assert float(rows["distortion"]["could_cost"].split(" px")[0]) == pytest.approx(at_corner, rel=0.06)  # two digits
    assert not any("by rule" in row["could_cost"] for row in rows.values())


def project_corner(camera: Camera, more_k1: float) -> float:
    """Distance [px] from the axis of what an undistorted lens shows in the corner, by k1 alone that is larger."""
    half = 0.5 * float(np.hypot(camera.width, camera.height))
    changed = camera.model_copy(update={"distortion": np.array([more_k1, 0, 0, 0, 0])})
    return float(project(changed, np.array([[half / camera.fx, 0, 1.0]]))[0, 0] - camera.cx)


def test_residual_is_what_corners_are_off_by() -> None:
    """Noise of 0.1 px each way where 0.3 px is the least that a corner is taken for: 144 coordinates, 22 unknowns."""
    words = by_words()
    views = seen_boards(np.random.default_rng(1), words, [(40, 10), (30, 130), (35, 250)])
    found = sharpened(words, bundle_of_boards(words, views, 0.3, 1.0), 0.3)
    assert found is not None
    expected = 0.1 * np.sqrt(2 * (1 - 22 / 144))
    assert found[0].rms_px == pytest.approx(expected, rel=0.2)  # 122 squares: 6.4 %, three of these
