"""The two poses of a small marker, told apart by the ball that stands on the plane of one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_sights import BALL, CAMERA, POSES, RADIUS, ROOM
from mirror_scene import Place, photograph

from pipeline.camera.estimates import Estimate, refuse_ambiguous, view_of
from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.resection import resect_plane
from pipeline.camera.rigid import camera_points, difference
from pipeline.probes.standing import standing_chi2
from pipeline.run.errors import NumericalError
from pipeline.types import Raster
from stages import knobs, pose

SMALL = CAMERA.model_copy(update={"width": 210, "height": 160, "fx": 600.0, "fy": 600.5, "cx": 102.5, "cy": 75.0})
SIDE_M, SIGMA_PX = 0.012, 0.2  # 15 px wide: too small to tell
ASIDE = np.array([0.15, 0.0, 0.1])  # where the marker lies, which is the world's origin, in the ball's scene
TRUTH = POSES["a"].copy()
TRUTH[:3, 3] -= ASIDE
PARAMS = knobs.Pose(corner_sigma_px=SIGMA_PX)


@pytest.fixture(scope="module")
def ball() -> Raster:
    picture = photograph(Place(ROOM, plane=True, ball=BALL), SMALL, POSES["a"], 2, 0.003, 3)
    parts = {**Raster.split(np.float32(picture)), **Raster.split(np.float32((0.003 * picture) ** 2), "variance")}
    return Raster({**parts, "mask": np.zeros(picture.shape[:2], np.uint32)}, "acescg")


def ambiguous(lift: float = 0.0) -> Estimate:
    """The estimate from a marker at the origin, its better and its worse pose exchanged; ``lift`` moves the plane."""
    points = marker_points(SIDE_M)
    px = project(SMALL, camera_points(TRUTH, points + np.array([0, lift, 0]))[0])
    best, second, ambiguity = resect_plane(SMALL, points, px, SIGMA_PX)
    assert second is not None
    assert ambiguity < PARAMS.min_ambiguity
    return Estimate("marker", Sightings(points, px, np.arange(4), 1), second, best, ambiguity)


def decided(estimate: Estimate, picture: Raster, **changes) -> Estimate:
    facts = {"ball": [{"name": "ball_a", "tripod": False}], "probe": {"diameter_m": 2 * RADIUS, **changes}}
    return pose.by_ball(facts, "ball_a", estimate, {"ball_a": picture}, {"ball_a": SMALL}, PARAMS)


def test_the_ball_decides(ball: Raster) -> None:
    wrong = ambiguous()
    found = decided(wrong, ball)
    assert found.decided == "ball"
    assert found.ambiguity > PARAMS.min_ambiguity
    refuse_ambiguous(found, PARAMS.min_ambiguity)
    turned = difference(found.best.world_from_camera, TRUTH)[:3]
    assert np.linalg.norm(turned) < 3 * np.sqrt(np.trace(found.best.covariance[:3, :3]))
    views = [view_of(replace(wrong, best=way)) for way in (found.best, found.second)]
    chi2 = standing_chi2("ball_a", ball, None, SMALL, views, RADIUS)
    assert chi2 is not None
    assert chi2[0] < 10.8 < chi2[1]  # 99.9 % of one number


def test_without_a_ball_on_the_plane_it_stays_refused(ball: Raster) -> None:
    """A plane 15 cm below the ball, no diameter, or another probe: as if there were no ball."""
    wrong = ambiguous()
    cases = [decided(ambiguous(-0.15), ball), decided(wrong, ball, diameter_m=None), decided(wrong, ball, kind="map")]
    for found in cases:
        assert not found.decided
        with pytest.raises(NumericalError, match="two poses explain"):
            refuse_ambiguous(found, PARAMS.min_ambiguity)
