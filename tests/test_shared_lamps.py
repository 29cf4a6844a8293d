"""A ball's centres by the lamps that two views mirror, and by the rim fitted from the other view's; ray-traced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mirror_scene import Lamp, Place, look_at, photograph, sky

from pipeline.camera.lens import pixel_rays
from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes import shared_lamps
from pipeline.probes.finding import Found, agreed, find_ball
from pipeline.probes.outline import Height, radius_in_pixels
from pipeline.probes.reflection import directions_from_rays
from pipeline.probes.sphere_fit import SphereFit
from pipeline.types import Camera, Raster, View

RADIUS = 0.04
CENTRE = np.array([0.0, RADIUS, 0.0])
CAMERA = Camera(width=300, height=260, fx=620.0, fy=620.0, cx=150.0, cy=130.0)
POSES = {"a": look_at((0.30, 0.28, 0.12), (0.03, 0.02, 0.0)), "b": look_at((-0.20, 0.30, 0.28), (0.0, 0.03, 0.0))}
LAMPS = [Lamp((0.3, 0.8, 0.4), 0.06, 60.0), Lamp((-0.4, 0.7, 0.5), 0.05, 90.0), Lamp((0.1, 0.7, -0.6), 0.05, 70.0)]


def view_of(pose: np.ndarray) -> View:
    return View(world_from_camera=pose, covariance=1e-8 * np.eye(6), route="given", rms_px=0.1, points=20)


VIEWS = {name: view_of(pose) for name, pose in POSES.items()}
CAMERAS = dict.fromkeys(POSES, CAMERA)


def raster_of(rgb: np.ndarray) -> Raster:
    """The photograph with its variance, and nothing masked."""
    variance = Raster.split((0.005 * rgb) ** 2, "variance")
    return Raster({**Raster.split(rgb), **variance, "mask": np.zeros(rgb.shape[:2], np.uint32)}, "acescg")


@pytest.fixture(scope="module")
def pictures() -> dict[str, Raster]:
    place = Place(sky(LAMPS, 0.3), plane=True, reflectance=0.8)
    return {name: raster_of(photograph(place, CAMERA, pose, 4, 0.005, 1)) for name, pose in POSES.items()}


def true_of(name: str) -> np.ndarray:
    return transform_points(invert_rigid(POSES[name]), CENTRE)


def ball(name: str, off_px: tuple[float, float], sigma_px: float) -> Found:
    """A fit that is off across the ray by so many pixels, and says by how many it may be."""
    true = true_of(name)
    size = radius_in_pixels(CAMERA, true, RADIUS)
    pixel = RADIUS / size
    there = true + np.array([*off_px, 0.0]) * pixel
    covariance = np.diag([sigma_px * pixel, sigma_px * pixel, 0.01 * RADIUS]) ** 2
    fit = SphereFit(there, covariance, 0.2, 100, size, 0.8, 0.9, 3.0, 1.0)
    pose = POSES[name]
    height = Height(pose[1, :3].copy(), float(pose[1, 3]), 2e-4)
    return Found(fit, fit, height, transform_points(pose, there))


def across_px(found: Found, name: str) -> float:
    error, ray = found.fit.centre - true_of(name), found.fit.centre / np.linalg.norm(found.fit.centre)
    return float(np.linalg.norm(error - (error @ ray) * ray) * found.fit.radius_px / RADIUS)


@pytest.mark.parametrize("off_px", [(1.5, 0.0), (-0.8, 1.2)])
def test_an_unsure_centre_follows_the_lamps_to_the_sure_one_s(pictures, off_px):
    found = {"a": ball("a", (0.0, 0.0), 0.1), "b": ball("b", off_px, 1.0)}
    tied, numbers = shared_lamps.tied(found, pictures, CAMERAS, VIEWS, RADIUS)
    assert numbers["lamps"] == len(LAMPS)
    # Three sigma of three lamps' centroids beside the sure centre's, and what its prior holds of the unsure one.
    bound = 3 * np.hypot(0.1, shared_lamps.SPOT_PX * np.sqrt(2 / 3)) + 0.1**2 * np.hypot(*off_px)
    assert across_px(tied["b"], "b") < bound < np.hypot(*off_px)
    assert across_px(tied["a"], "a") < 0.1
    assert tied["b"].centre_world == pytest.approx(transform_points(POSES["b"], tied["b"].fit.centre))
    row = shared_lamps.reason(numbers)
    assert row["modelled"]


def test_views_that_contradict_each_other_state_more(pictures):
    found = {"a": ball("a", (0.0, 0.0), 0.1), "b": ball("b", (1.5, 0.0), 0.1)}
    tied, numbers = shared_lamps.tied(found, pictures, CAMERAS, VIEWS, RADIUS)
    assert numbers["chi2"] > 6 * len(LAMPS)
    for name, one in tied.items():
        raised = np.trace(one.fit.covariance) / np.trace(found[name].fit.covariance)
        assert raised == pytest.approx(numbers["chi2"] / (2 * len(LAMPS)))


def test_a_third_view_brings_two_freedoms_more(pictures, monkeypatch):
    monkeypatch.setitem(POSES, "c", look_at((0.05, 0.30, 0.36), (0.0, 0.02, 0.0)))
    views = {name: view_of(pose) for name, pose in POSES.items()}
    third = raster_of(photograph(Place(sky(LAMPS, 0.3), plane=True, reflectance=0.8), CAMERA, POSES["c"], 4, 0.005, 1))
    off = {"a": (1.5, 0.0), "b": (0.0, 0.0), "c": (0.0, -1.5)}
    found = {name: ball(name, off[name], 0.1) for name in POSES}
    cameras = dict.fromkeys(POSES, CAMERA)
    tied, numbers = shared_lamps.tied(found, {**pictures, "c": third}, cameras, views, RADIUS)
    assert numbers["lamps"] == len(LAMPS)
    assert numbers["freedoms"] == 4 * len(LAMPS)
    raised = np.trace(tied["c"].fit.covariance) / np.trace(found["c"].fit.covariance)
    assert raised == pytest.approx(numbers["chi2"] / numbers["freedoms"])
    assert raised > 1


def test_views_that_agree_stay(pictures):
    found = {name: ball(name, (0.0, 0.0), 0.3) for name in POSES}
    tied, numbers = shared_lamps.tied(found, pictures, CAMERAS, VIEWS, RADIUS)
    assert numbers["chi2"] < 11.3 * 2  # six freedoms, far beyond 99 %
    for name in POSES:
        assert across_px(tied[name], name) < 2 * shared_lamps.SPOT_PX
        np.testing.assert_array_equal(tied[name].fit.covariance, found[name].fit.covariance)


def test_without_a_lamp_in_two_views_nothing_moves(pictures):
    alone = {"a": ball("a", (1.0, 0.0), 1.0)}
    assert shared_lamps.tied(alone, pictures, CAMERAS, VIEWS, RADIUS) == (alone, {"lamps": 0})
    dark = {name: raster_of(photograph(Place(sky([]), plane=True), CAMERA, POSES[name], 2)) for name in POSES}
    found = {name: ball(name, (1.0, 0.0), 1.0) for name in POSES}
    tied, numbers = shared_lamps.tied(found, dark, CAMERAS, VIEWS, RADIUS)
    assert tied == found
    assert not shared_lamps.reason(numbers)["modelled"]


def test_a_lamp_of_another_colour_is_another_lamp(pictures):
    tinted = pictures["b"]
    red = raster_of(tinted.rgb() * (2.0, 1.0, 1.0))
    found = {name: ball(name, (0.0, 0.0), 0.3) for name in POSES}
    _, numbers = shared_lamps.tied(found, {"a": pictures["a"], "b": red}, CAMERAS, VIEWS, RADIUS)
    assert numbers["lamps"] == 0


@pytest.mark.parametrize("distance", [0.5, 2.0, 50.0])
def test_a_near_lamp_is_mirrored_where_its_ray_goes(distance):
    """Pixels followed to a point at a distance from the ball's surface, and that point back to its pixel."""
    seen = shared_lamps.Seen(CAMERA, VIEWS["a"], ball("a", (0.0, 0.0), 0.1), [], np.zeros((0, 3)), 0.01)
    centre, rotation = seen.ball.fit.centre, POSES["a"][:3, :3]
    middle = CENTRE + np.array([2e-3, 0.0, -1e-3])
    size, random = seen.ball.fit.radius_px, np.random.default_rng(1)
    px = CAMERA.fx * centre[:2] / centre[2] + (CAMERA.cx, CAMERA.cy) + 0.5 * size * random.uniform(-1, 1, (20, 2))
    rays = pixel_rays(CAMERA, px)
    reach = rays @ centre - np.sqrt((rays @ centre) ** 2 - centre @ centre + RADIUS**2)
    ways = directions_from_rays(rays, centre, RADIUS) @ rotation.T
    lamps = transform_points(POSES["a"], reach[:, None] * rays) + distance * ways - middle
    for lamp, where in zip(lamps, px, strict=True):
        far = float(np.linalg.norm(lamp))
        found = shared_lamps._mirrored(seen, np.zeros(3), np.zeros(3), (lamp / far, 1 / far), middle, RADIUS, None)
        # Three rounds of a direction that is off by R / distance at first: (R / distance)^3 radians of 2 / size.
        assert found == pytest.approx(where, abs=2 * size * (2 * RADIUS / distance) ** 3 + 0.01)


def test_a_rim_that_settled_beside_is_fitted_again_from_the_other_view(pictures):
    """A fit that stayed on another edge, by its scatter: the other view's place leaves less, and is taken."""
    right = {name: find_ball(name, pictures[name], None, CAMERA, VIEWS[name], RADIUS, []) for name in POSES}
    size = right["b"].fit.radius_px
    off = right["b"].fit.centre + np.array([0.0, 3.5 * RADIUS / size, 0.0])
    stuck = replace(right["b"], fit=replace(right["b"].fit, centre=off, rms_px=0.4))
    stuck = replace(stuck, centre_world=transform_points(POSES["b"], off))
    better = agreed({"a": right["a"], "b": stuck}, pictures, CAMERAS, VIEWS, RADIUS)
    assert across_px(better["b"], "b") < across_px(right["b"], "b") + 0.1
    assert better["b"].centre_world == pytest.approx(transform_points(POSES["b"], better["b"].fit.centre))
    assert better["a"].fit.rms_px <= right["a"].fit.rms_px
    kept = agreed({"b": stuck}, pictures, CAMERAS, VIEWS, RADIUS)
    assert kept["b"] is stuck
