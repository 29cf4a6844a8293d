"""Further photographs orient a plate without markers: against truth, and what cannot be done is said."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from command import SAMPLES

from pipeline.camera.rigid import difference
from pipeline.camera.sfm import Seen, camera_start, oriented
from pipeline.run import artifacts as A
from pipeline.run import formats
from pipeline.run.errors import CaptureError, ManifestError, NumericalError
from pipeline.types import Bracket, Camera, Frame, Reconstruction
from stages import knobs, sfm, sources
from stages.order import graph

COUNTER = SAMPLES / "counter"
TRUTH = json.loads((COUNTER / "truth/truth.json").read_text()) if (COUNTER / "truth/truth.json").is_file() else {}
CHI2_6 = 22.46  # 99.9 % of chi-square with six degrees of freedom

with_counter = pytest.mark.skipif(not TRUTH, reason="sample_captures/counter is not there")


def frame(name: str, width: int = 96, height: int = 72, **changes: Any) -> Frame:
    given = {"file": name, "sha256": "", "exposure_s": 0.0, "iso": 0.0, "fnumber": 0.0, "width": width,
             "height": height, "cfa": "", "black": np.zeros((1, 3)), "white": 255.0}  # fmt: skip
    return Frame(**{**given, **changes})


def test_focal_length_from_exif_or_a_guess_that_says_so() -> None:
    by_diagonal = 39 / np.hypot(36, 24) * 1200
    assert camera_start(frame("a.jpg", 960, 720, focal_35mm=39)).fx == pytest.approx(by_diagonal)
    guess = camera_start(frame("a.jpg", 960, 720))
    assert (guess.source, guess.fx) == ("guess", 1.2 * 960)


def test_photographs_of_another_size_ask_for_a_camera_of_their_own() -> None:
    facts = {"ball": [], "camera": {"given": None}, "views": {"own_camera": False}}
    brackets = {"plate": Bracket(name="plate", role="plate", frames=[frame("p.dng")])}
    with pytest.raises(CaptureError, match=r"v\.jpg: is 64x48, needed 96x72 as the plate; views\.own_camera"):
        sfm.bodies_of(facts, brackets, [frame("v.jpg", 64, 48)])
    facts["views"] = {"own_camera": True}
    cameras, bodies = sfm.bodies_of(facts, brackets, [frame("v.jpg", 64, 48)])
    assert [camera.width for camera in cameras] == [96, 64]
    assert bodies == {"plate": 0, "v.jpg": 1}


def test_a_given_lens_is_checked_before_it_is_used() -> None:
    facts = {"ball": [], "camera": {"given": {"width": 96, "height": 72}}, "views": {"own_camera": False}}
    brackets = {"plate": Bracket(name="plate", role="plate", frames=[frame("p.dng")])}
    with pytest.raises(ManifestError, match=r"camera\.given\.fx: missing"):
        sfm.bodies_of(facts, brackets, [frame("v.jpg")])


def test_nothing_is_done_without_further_views() -> None:
    decided = sources.compute({}, {}, {}, [], [], {}, knobs.Sources())
    assert decided.evidence[0]["modelled"] is False
    result = sfm.compute({}, {}, [], {}, decided.outputs["sources"], knobs.Sfm())
    assert result.outputs["reconstruction"].names == []


def test_a_marker_seen_once_gives_no_metre() -> None:
    camera = Camera(width=96, height=72, fx=100, fy=100, cx=48, cy=36)
    two = Reconstruction(
        names=["a", "b"], world_from_camera=np.array([np.eye(4), np.eye(4)]), cameras=[camera], camera_of=[0, 0]
    )
    seen = {"a": [Seen(0, np.zeros((4, 3)), np.full((4, 2), 40.0))]}
    with pytest.raises(NumericalError, match="the first marker is seen in 1 of the 2"):
        oriented(two, [camera], seen, None)


@pytest.fixture(scope="module")
def made(counter_build) -> dict[str, Any]:
    names = (A.VIEWS, A.CAMERA, A.RECONSTRUCTION)
    return {a.name: formats.read(counter_build / graph().producer[a.name].name, a) for a in names}


@with_counter
def test_every_photograph_is_oriented(made) -> None:
    assert made["reconstruction"].missing == []
    assert len(made["reconstruction"].names) == 14  # eleven views, plate and two ball views


@with_counter
@pytest.mark.parametrize("name", ["plate", "ball_a", "ball_b"])
def test_poses_hold_the_truth(made, name: str) -> None:
    """The brief's figures: 0.05 degrees and 0.2 % of the distance with a lens found in the capture itself."""
    view, true = made["views"][name], np.array(TRUTH["views"][name]["world_from_camera"])
    error = difference(view.world_from_camera, true)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.05
    assert np.linalg.norm(error[3:]) < 0.002 * np.linalg.norm(true[:3, 3])
    assert error @ np.linalg.solve(view.covariance, error) < CHI2_6


@with_counter
def test_lens_comes_from_the_tracks(made) -> None:
    camera, true = made["camera"], TRUTH["camera"]
    assert camera.source == "colmap"
    error = np.array([camera.fx - true["fx"], camera.cx - true["cx"], camera.cy - true["cy"]])
    sigma = np.sqrt(np.diag(camera.covariance))[[0, 2, 3]]
    # SIFT places neighbours alike, so tracks are not quite independent: five sigma, and a pixel in any case
    assert (np.abs(error) < np.minimum(5 * sigma, 1.0)).all(), (error, sigma)


@with_counter
def test_tripod_is_found_to_have_stayed(made) -> None:
    assert made["views"]["ball_a"].world_from_camera == pytest.approx(made["views"]["plate"].world_from_camera)
