"""A matt ball as the probe: harmonics from irradiance, positive maps, and the stage."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from lit_room import GRID, facts, raster
from mirror_scene import look_at

from pipeline.camera.lens import pixel_rays
from pipeline.conventions import (
    latlong_directions,
    latlong_solid_angles,
)
from pipeline.light.environment import AXES, irradiance
from pipeline.light.harmonics import sh9_irradiance, sh9_of_environment
from pipeline.light.prediction import lookup
from pipeline.probes import grey_ball
from pipeline.probes.kinds import KINDS
from pipeline.probes.observation import Grid, Shots
from pipeline.types import Camera, View
from stages import knobs, probe

# ---- a matt ball -----------------------------------------------------------------------------------------------------

RADIUS, GREY = 0.04, 0.4


def soft_sky(w: np.ndarray) -> np.ndarray:
    """RGB (N, 3) of a light of bands 0 to 2 alone, positive."""
    x, y, z = w.T
    return np.stack([1 + 0.5 * x + 0.2 * y, 1.2 + 0.3 * y * z + 0.4 * z, 0.8 + 0.3 * (x * x - z * z) - 0.2 * y], -1)


TABLE = 0.35


def over_table(w: np.ndarray) -> np.ndarray:
    """The soft sky above a table of even radiance."""
    return np.where((w[:, 1] < 0)[:, None], TABLE, soft_sky(w))


def shading(light) -> np.ndarray:
    """Irradiance (32, 64, 3) by normal, lat-long: the plain sum over 48 x 96 directions."""
    w = latlong_directions(48, 96).reshape(-1, 3)
    flux = light(w) * latlong_solid_angles(48, 96).reshape(-1, 1)
    return (np.maximum(latlong_directions(32, 64).reshape(-1, 3) @ w.T, 0) @ flux).reshape(32, 64, 3)


def matt_ball(light, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """A matt ball of albedo GREY in ``light`` from all sides, before the table; 3 x 3 rays a pixel."""
    shade, centre, eye = GREY / np.pi * shading(light), np.array([0, RADIUS, 0]), pose[:3, 3]
    steps = (np.arange(3) + 0.5) / 3
    total = np.zeros((camera.height, camera.width, 3))
    for dy in steps:
        for dx in steps:
            y, x = np.mgrid[: camera.height, : camera.width]
            rays = pixel_rays(camera, np.stack([x + dx, y + dy], -1).reshape(-1, 2)) @ pose[:3, :3].T
            along = rays @ (centre - eye)
            inside = RADIUS**2 - (centre - eye) @ (centre - eye) + along**2
            hit = inside > 0
            normal = (eye + (along - np.sqrt(np.where(hit, inside, 0)))[:, None] * rays - centre) / RADIUS
            seen_at = np.where(hit[:, None], lookup(shade, normal), TABLE)
            total += seen_at.reshape(total.shape)
    return total / 9


BALL_CAMERA = Camera(width=260, height=240, fx=700, fy=700, cx=131, cy=118)
BALL_POSE = look_at((0.25, 0.3, 0.25), (0, RADIUS, 0))


@functools.cache
def ball_shots(light, noise: float = 0.003) -> Shots:
    """One tripod view of the matt ball, and the plate without it."""
    picture = matt_ball(light, BALL_CAMERA, BALL_POSE)
    rng = np.random.default_rng(0)
    noisy = picture * (1 + noise * rng.normal(size=picture.shape))
    of = facts("grey_ball", diameter_m=2 * RADIUS, albedo=[GREY] * 3)
    of["ball"] = [{"name": "ball_a", "tripod": True}]
    view = View(world_from_camera=BALL_POSE, covariance=np.eye(6) * 1e-8, route="given", rms_px=0.1, points=20)
    table = raster(np.full(picture.shape, TABLE) * (1 + noise * rng.normal(size=picture.shape)))
    return Shots(of, {"plate": table, "ball_a": raster(noisy)}, BALL_CAMERA, {"plate": view, "ball_a": view})


def test_harmonics_come_back_from_irradiance():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    w = latlong_directions(24, 48)
    true = sh9_of_environment(soft_sky(w.reshape(-1, 3)).reshape(w.shape))
    light = sh9_irradiance(true, normals)
    for seen in (slice(None), normals @ [0.5, 0.6, 0.6] > 0.1):  # all around, and from one side
        found, covariance = grey_ball.solve_harmonics(normals[seen], light[seen], (0.01 * light[seen]) ** 2)
        sigma = np.sqrt(np.einsum("cii->ic", covariance))
        assert (np.abs(found - true) < 3 * sigma).all()
    assert sigma[0].max() / true[0].max() < 0.1  # the mean is known from one side alone
    assert grey_ball.band_4(normals).T @ grey_ball.band_4(normals) / 4000 * 4 * np.pi == pytest.approx(
        np.eye(9), abs=0.2
    )


def test_map_of_a_matt_ball_is_positive_and_has_its_harmonics():
    """Also for a lamp, whose series rings below zero: the coefficients are kept, not clipped."""
    lamp = np.where((latlong_directions(64, 128) @ np.array([0.6, 0.8, 0]) > 0.99)[..., None], 50.0, 0.1) * np.ones(3)
    goal = sh9_of_environment(lamp)
    nothing = np.zeros((64, 128), bool)
    exact = np.stack([np.eye(9) * 1e-10] * 3)
    found = grey_ball.least_power_map(goal, exact, np.zeros((64, 128, 3)), nothing, Grid(128))
    assert found.min() >= 0
    assert sh9_of_environment(found) == pytest.approx(goal, abs=1e-3 * goal[0, 0])
    below = latlong_directions(64, 128)[..., 1] < -0.2
    found = grey_ball.least_power_map(goal, exact, np.full((64, 128, 3), 0.1), below, Grid(128))
    assert found[below] == pytest.approx(0.1)
    assert sh9_of_environment(found) == pytest.approx(goal, abs=2e-3 * goal[0, 0])


def test_constant_light_on_a_matt_ball_is_constant():
    light = np.full((500, 3), np.pi * 0.7)
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found, covariance = grey_ball.solve_harmonics(normals, light, (0.001 * light) ** 2)
    nothing = np.zeros((64, 128), bool)
    rgb = grey_ball.least_power_map(found, covariance, np.zeros((64, 128, 3)), nothing, GRID)
    assert rgb == pytest.approx(0.7, rel=2e-3)


def test_matt_ball_gives_the_irradiance_it_got():
    given = ball_shots(over_table)
    found = KINDS["grey_ball"].observe(given, GRID)
    view = found.maps["ball_a"]
    assert found.balls == {}
    assert found.centre_world == pytest.approx([0, RADIUS, 0], abs=1e-3)
    w = latlong_directions(64, 128)
    truth = irradiance(over_table(w.reshape(-1, 3)).reshape(w.shape), AXES)
    ours = irradiance(view.rgb, AXES)
    towards = (BALL_POSE[:3, 3] / np.linalg.norm(BALL_POSE[:3, 3])) @ AXES.T > 0.3
    # 4 %: 1 % of paint and shape, and the horizon's step, which has more than nine harmonics
    assert ours[towards] == pytest.approx(truth[towards], rel=0.04)
    assert (np.sqrt(view.variance) >= view.rgb).all()  # no direction by itself is known


def test_stage_takes_a_matt_ball():
    given = ball_shots(over_table)
    result = probe.compute(
        given.facts, given.photographs, given.camera, given.views, {}, {}, knobs.Probe(width=128, supersample=2)
    )
    environment = result.outputs["environment"].rgb()
    assert np.isfinite(environment).all()
    w = latlong_directions(64, 128)
    truth = irradiance(over_table(w.reshape(-1, 3)).reshape(w.shape), AXES[2:3])
    assert irradiance(environment, AXES[2:3]) == pytest.approx(
        truth, rel=0.06
    )  # and the plane, laid finer than the map
    assert any("nine harmonics" in text for text in result.warnings)
