"""The ball's centre by the plane it mirrors, against ray-traced balls of known place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mirror_scene import Lamp, Place, look_at, photograph, sky

from benchmarks.probe_fit import Setup, fitted
from pipeline.camera.lens import project
from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes.anchor import MOST_LEFT_PX, anchored, anchored_radius
from pipeline.probes.finding import Found, measured, refuse_cut
from pipeline.probes.outline import Height, part_of, radius_in_pixels
from pipeline.probes.plane_image import Aligned, align
from pipeline.probes.sphere_fit import SphereFit, fit_sphere
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Raster, View

RADIUS = 0.04
CENTRE = np.array([0.0, RADIUS, 0.0])
POSE = look_at((0.30, 0.28, 0.12), (0.03, 0.02, 0.0))
CAMERA = Camera(width=420, height=340, fx=800.0, fy=800.0, cx=210.0, cy=170.0)
PIXEL = RADIUS / radius_in_pixels(CAMERA, transform_points(invert_rigid(POSE), CENTRE), RADIUS)
SIGMA = np.diag([0.5 * PIXEL, 0.5 * PIXEL, 0.01 * RADIUS]) ** 2  # a rim that may drift by half a pixel


@pytest.fixture(scope="module")
def picture() -> Raster:
    place = Place(sky([Lamp((0.3, 0.8, 0.4), 0.06, 50.0)]), plane=True, reflectance=0.8)
    return raster_of(photograph(place, CAMERA, POSE, 3, 0.005, 1))


def raster_of(rgb: np.ndarray) -> Raster:
    """The photograph with its variance, and nothing masked."""
    noise = {"variance.R": rgb[..., 0], "variance.G": rgb[..., 1], "variance.B": rgb[..., 2]}
    variance = {name: (0.005 * value) ** 2 for name, value in noise.items()}
    return Raster({**Raster.split(rgb), **variance, "mask": np.zeros(rgb.shape[:2], np.uint32)}, "acescg")


def ball(off_px: tuple[float, float]) -> Found:
    """A fit that is off across the ray by so many pixels."""
    true = transform_points(invert_rigid(POSE), CENTRE)
    there = true + np.array([*off_px, 0.0]) * PIXEL
    fit = SphereFit(there, SIGMA, 0.2, 100, RADIUS / PIXEL, 0.8, 0.9, 3.0, 1.0)
    height = Height(POSE[1, :3].copy(), float(POSE[1, 3]), 2e-4)
    return Found(fit, fit, height, transform_points(POSE, there))


VIEW = View(world_from_camera=POSE, covariance=1e-10 * np.eye(6), route="given", rms_px=0.1, points=20)


def across_px(found: Found) -> float:
    error = found.fit.centre - transform_points(invert_rigid(POSE), CENTRE)
    ray = found.fit.centre / np.linalg.norm(found.fit.centre)
    return float(np.linalg.norm(error - (error @ ray) * ray) / PIXEL)


@pytest.mark.parametrize("off_px", [(0.0, 0.0), (1.0, 0.0), (-0.7, 0.8)])
def test_drifted_rim_is_brought_back(picture, off_px):
    found, numbers = anchored(ball(off_px), picture, CAMERA, VIEW, RADIUS)
    assert numbers["used"]
    # The rim's pull, (0.08 / 0.5)^2 of it, and three times the tenth of a blur that is stated.
    assert across_px(found) < 0.03 * np.hypot(*off_px) + 0.24
    assert found.centre_world == pytest.approx(transform_points(POSE, found.fit.centre))
    assert (np.linalg.eigvalsh(found.fit.covariance) > 0).all()
    assert np.trace(found.fit.covariance) < np.trace(SIGMA)


def test_plane_that_agrees_with_its_image_is_believed_against_the_rim(picture):
    sure = ball((2.5, 0.0))
    sure = replace(sure, fit=replace(sure.fit, covariance=1e-2 * SIGMA))
    found, numbers = anchored(sure, picture, CAMERA, VIEW, RADIUS)
    assert numbers["used"]
    assert numbers["against_the_rim"]
    assert across_px(found) < 0.24  # as above, without the rim's pull


class Varnished(Place):
    """The plane, but not the board on it, mirrors a soft window: it lies elsewhere for the camera than for the ball."""

    def radiance(self, origin: np.ndarray, w: np.ndarray) -> np.ndarray:
        rgb = super().radiance(origin, w)
        below = w[:, 1] < -1e-9
        x, z = (origin - (origin[:, 1] / np.where(below, w[:, 1], 1))[:, None] * w)[:, ::2].T
        bare = below & ~((x > 0.1) & (x < 0.3) & (np.abs(z) < 0.1))
        window = np.array([-0.5, 0.7, -0.4]) / np.sqrt(0.9)
        shine = 0.5 * np.exp(((w * (1, -1, 1)) @ window - 1) / 0.06)  # the wood's own radiance is 0.5
        return rgb + np.where(bare, shine, 0)[:, None] * (0.8, 1.0, 1.2)


@pytest.fixture(scope="module")
def varnished() -> Raster:
    place = Varnished(sky([Lamp((0.3, 0.8, 0.4), 0.06, 50.0)]), plane=True, reflectance=0.8)
    return raster_of(photograph(place, CAMERA, POSE, 3, 0.005, 1))


@pytest.mark.parametrize("off_px", [(1.0, 0.0), (-0.7, 0.8)])
def test_gloss_beside_print_changes_contrast_and_moves_nothing(varnished, off_px):
    start = ball(off_px)
    as_is = align(varnished, CAMERA, VIEW, start.fit.centre, RADIUS, start.fit.blur_px)
    assert as_is is not None
    assert as_is.left_px > MOST_LEFT_PX
    found, numbers = anchored(start, varnished, CAMERA, VIEW, RADIUS)
    assert numbers["used"]
    assert numbers["left_with_its_contrast_px"] == as_is.left_px
    error = found.fit.centre - transform_points(invert_rigid(POSE), CENTRE)
    assert error @ np.linalg.solve(found.fit.covariance, error) < 11.3  # 99 %
    assert across_px(found) < 0.5 * across_px(start)  # 0.22, 0.31; an image with its contrast is off by 1.3, 1.9 px
    sure = replace(ball((2.5, 0.0)), fit=replace(ball((2.5, 0.0)).fit, covariance=1e-2 * SIGMA))
    assert not anchored(sure, varnished, CAMERA, VIEW, RADIUS)[1]["used"]  # against a sure rim it is not believed


@pytest.mark.parametrize(("radius_px", "ratio", "blur_px"), [(30.0, 10.0, 0.6), (60.0, 3.0, 0.6), (60.0, 50.0, 1.2)])
def test_small_balls(radius_px, ratio, blur_px):
    # Patches of 13 px need a ball of 70 px; all textured pixels together know one of 30 px to a twentieth of a pixel.
    # A colour mosaic is in it.
    setup = Setup(distance_ratio=ratio, radius_px=radius_px, blur_px=blur_px, seed=103, margin=2.6, mosaic=True)
    found = fitted(setup, on_plane=True)
    assert found["direction_rms_deg"] < 1.0  # rms over 24 such balls 0.13 (D = 3 R) to 0.49 (30 px); rim 0.65 to 3
    assert found["mahalanobis_squared"] < 11.3  # 99 %


@pytest.mark.parametrize("side", [1, -1])
def test_half_a_ball_is_enough(picture, side):
    """The frame ends at the ball's middle: by its rim alone such a ball was off by up to 2 degrees."""
    true = transform_points(invert_rigid(POSE), CENTRE)
    middle = int(project(CAMERA, true[None])[0, 0])
    low, high = np.array([0, 0]), np.array([CAMERA.width, CAMERA.height])
    (low if side > 0 else high)[0] = middle
    half = Raster({k: v[:, low[0] : high[0]] for k, v in picture.channels.items()}, "acescg")
    camera = part_of(CAMERA, low, high)
    start = ball((0.5, -0.5))
    fit, _ = fit_sphere(*measured(half), camera, RADIUS, start.fit.centre, start.height)
    assert 0.45 < fit.visible < 0.55
    assert (fit.centre - true) @ np.linalg.solve(fit.covariance, fit.centre - true) < 11.3  # 99 %
    found, numbers = anchored(replace(start, fit=fit, free=fit), half, camera, VIEW, RADIUS)
    assert numbers["used"]
    assert across_px(found) < 0.24
    with pytest.raises(CaptureError, match="needed 70%"):
        refuse_cut("ball", fit)


@pytest.mark.parametrize("wrong", [0.97, 1.02])
def test_radius_is_solved_by_the_planes_image(picture, wrong):
    # The rim alone leaves 0.5 to 2 %; the ball stands on the plane to 0.5 % of its radius, an eighth of which is left.
    true = transform_points(invert_rigid(POSE), CENTRE)
    start = replace(ball((0.0, 0.0)).fit, centre=true * wrong)
    found = anchored_radius(start, picture, CAMERA, VIEW, RADIUS * wrong)
    assert found is not None
    assert abs(found[0] - RADIUS) < 3 * found[1]
    assert found[1] < 0.003 * RADIUS


def test_a_pose_that_is_wrong_is_in_the_covariance(picture):
    """The plane is thought to be turned by half a milliradian: the centre moves with it, and the sigma covers that."""
    turned, angle = POSE.copy(), 5e-4
    turned[:3, :3] = np.array([[1, -angle, 0], [angle, 1, 0], [0, 0, 1]]) @ POSE[:3, :3]
    known = np.diag([1e-10, 1e-10, 1e-10, 1e-14, 1e-14, 1e-14])
    wide = known + np.diag([0, 0, angle**2, 0, 0, 0])
    start = transform_points(invert_rigid(POSE), CENTRE)

    def there(pose: np.ndarray, covariance: np.ndarray) -> Aligned:
        view = VIEW.model_copy(update={"world_from_camera": pose, "covariance": covariance})
        found = align(picture, CAMERA, view, start, RADIUS, 0.5)
        assert found is not None
        return found

    moved = there(turned, known).centre - there(POSE, known).centre
    spread = there(POSE, wide).covariance - there(POSE, known).covariance  # of rank one: that move, with itself
    sigma, axis = (part[..., -1] for part in np.linalg.eigh(spread))
    assert abs(axis @ moved) == pytest.approx(np.sqrt(sigma), rel=0.15)  # the rounds of the alignment are not linear
    assert np.linalg.norm(moved) == pytest.approx(np.sqrt(sigma), rel=0.15)


def test_no_texture_and_no_plane_leave_the_rim_alone(picture):
    even = Raster({k: np.ones_like(v) if k in "RGB" else v for k, v in picture.channels.items()}, "acescg")
    found, numbers = anchored(ball((0.0, 0.0)), even, CAMERA, VIEW, RADIUS)
    assert not numbers["used"]
    aside = replace(ball((0.0, 0.0)), on_plane=False)
    found, numbers = anchored(aside, picture, CAMERA, VIEW, RADIUS)
    assert found is aside
    assert not numbers["used"]
