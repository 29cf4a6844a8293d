"""The plane under the ball, seen from the ball's centre instead of from its skin."""

from __future__ import annotations

import numpy as np
import pytest
from mirror_scene import Place, look_at, sky

from pipeline.conventions import invert_rigid, latlong_directions, transform_points
from pipeline.light.environment import AXES, irradiance
from pipeline.light.prediction import ball_directions
from pipeline.probes.observation import ViewMap
from pipeline.probes.parallax import mirrored_directions, set_down
from pipeline.probes.reflection import rays_from_directions
from pipeline.types import BallFit, Camera

RADIUS, CENTRE, CAMERA = 0.04, np.array([0.0, 0.04, 0.0]), np.array([0.3, 0.35, 0.45])
PLACE = Place(sky([]), plane=True, ball=None)
HEIGHT = 128


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def skin(w: np.ndarray) -> np.ndarray:
    """Where rays that the ball mirrors into directions (N, 3) leave it."""
    normal = unit(w + unit(CAMERA - CENTRE))
    for _ in range(50):
        normal = unit(w + unit(CAMERA - CENTRE - RADIUS * normal))
    return CENTRE + RADIUS * normal


def view(rgb: np.ndarray) -> ViewMap:
    ones = np.ones(rgb.shape[:2])
    return ViewMap(rgb, 0.01 * rgb**2, ones, ones)


def test_reflection_obeys_its_law():
    points = np.array([[0.2, 0, 0.1], [-0.5, 0, 0.0], [0.05, 0, -0.3], [3.0, 0, 1.0]])
    away = mirrored_directions(points, CENTRE, RADIUS, CAMERA)
    place = skin(away)
    assert np.linalg.norm(np.cross(points - place, away), axis=-1).max() < 1e-3 * RADIUS  # SETTLED, and a little
    raised = unit(points + np.array([0, 0.3, 0]))
    assert mirrored_directions(1e7 * raised, CENTRE, RADIUS, CAMERA) == pytest.approx(raised, abs=1e-6)
    distance = np.linalg.norm(CAMERA - CENTRE)
    rays, _ = rays_from_directions(away, (CAMERA - CENTRE) / distance, RADIUS / distance)
    assert rays == pytest.approx(unit(place - CAMERA), abs=1e-6)


def test_behind_the_ball_nothing_is_invented():
    hidden = CENTRE - 0.5 * unit(CAMERA - CENTRE)
    assert np.isnan(mirrored_directions(hidden[None], CENTRE, RADIUS, CAMERA)).all()


def test_constant_light_and_the_upper_half_stay():
    rgb = np.random.default_rng(1).uniform(0.5, 2, (HEIGHT, 2 * HEIGHT, 3))
    found = set_down(view(rgb), CENTRE, RADIUS, CAMERA)
    assert np.array_equal(found.rgb[: HEIGHT // 2], rgb[: HEIGHT // 2].astype(found.rgb.dtype))
    even = set_down(view(np.full((HEIGHT, 2 * HEIGHT, 3), 3.0)), CENTRE, RADIUS, CAMERA)
    assert even.rgb == pytest.approx(3.0, rel=1e-6)
    assert even.coverage == pytest.approx(1.0)


def test_table_is_where_it_stands():
    """A bright room behind the edge of a dark table: mirrored directions lower the edge, and light comes in."""
    w = latlong_directions(HEIGHT, 2 * HEIGHT).reshape(-1, 3)

    def seen(origin: np.ndarray) -> np.ndarray:
        rgb = PLACE.radiance(np.broadcast_to(origin, w.shape), w)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, z = (origin - w * (origin[..., 1] / w[:, 1])[:, None])[:, ::2].T
            past = (w[:, 1] < 0) & (np.maximum(np.abs(x), np.abs(z)) > 1.2)
        return np.where(past[:, None], 2.0, rgb).reshape(HEIGHT, 2 * HEIGHT, 3)

    true, mirrored = seen(np.broadcast_to(CENTRE, w.shape)), seen(skin(w))
    found = set_down(view(mirrored), CENTRE, RADIUS, CAMERA).rgb
    sides = AXES[[0, 1, 4, 5]]  # from straight below the ball hides its own foot, whichever map it is
    each = [irradiance(picture, sides) for picture in (true, mirrored, found)]
    before, after = (np.abs(e / each[0] - 1).max() for e in each[1:])
    # What is left is beyond the table's edge, 2 degrees below the horizon, and at the foot (measured 0.038, 0.015).
    assert before > 0.03
    assert after < 0.5 * before
    rows = slice(int(HEIGHT * (0.5 + 6 / 180)), int(HEIGHT * (0.5 + 45 / 180)))
    errors = [np.abs(picture[rows] - true[rows]).mean() for picture in (mirrored, found)]
    assert errors[1] < 0.35 * errors[0]


def test_prediction_looks_where_the_map_is():
    """What a pixel of the ball mirrors of the plane is looked up in the direction from the ball's centre."""
    pose = look_at(tuple(CAMERA), tuple(CENTRE))
    local = transform_points(invert_rigid(pose), CENTRE)
    camera = Camera(width=64, height=64, fx=400.0, fy=400.0, cx=32.0, cy=32.0)
    ball = BallFit(
        centre_camera_m=local, radius_m=RADIUS, covariance=np.eye(3), rms_px=0.1, points=9, radius_px=400 * RADIUS
    )
    found, sine = ball_directions(camera, ball, pose, slice(0, 64), slice(0, 64))
    inside = (sine < 0.95) & (found[..., 1] < -0.05)
    points = CENTRE - found[inside] * (CENTRE[1] / found[inside][:, 1])[:, None]
    away = mirrored_directions(points, CENTRE, RADIUS, CAMERA)
    distance = np.linalg.norm(CAMERA - CENTRE)
    rays, _ = rays_from_directions(away, (CAMERA - CENTRE) / distance, RADIUS / distance)
    local_rays = rays @ pose[:3, :3]
    px = 400 * local_rays[:, :2] / local_rays[:, 2:] + 32
    rows, columns = np.nonzero(inside)
    known = np.isfinite(away[:, 0])
    assert known.mean() > 0.9
    assert (
        np.abs(px - np.stack([columns, rows], -1) - 0.5)[known].max() < 0.02
    )  # SETTLED, 1e-4 of 30 px, and a few steps
