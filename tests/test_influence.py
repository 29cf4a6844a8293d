"""How far objects change the light: the bound against what is really hidden, shadows of a low sun, the rectangle."""

from __future__ import annotations

import numpy as np
import pytest
from test_composite_render import wish

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.transport.extent import FAR_SEEN, Standing, beyond, far_ground, needed, standing
from pipeline.transport.influence import expected, influence, light_on, reach
from pipeline.transport.proxies import box
from pipeline.types import Emitter, Plane

UP = np.array([0.0, 1.0, 0.0])
EVEN = np.ones((64, 128, 3))
HALF = (0.04, 0.06, 0.03)  # of a box that stands on the plane


def with_sun(elevation_deg: float, share: float) -> tuple[np.ndarray, list[Emitter]]:
    """An even sky with one bright texel towards +x, that gives a share of the plane's irradiance."""
    row = int((90 - elevation_deg) / 180 * 64)
    column = 32  # u = 1/4: +x
    direction = latlong_directions(64, 128)[row, column]
    angle = latlong_solid_angles(64, 128)[row, column]
    irradiance = np.full(3, np.pi * share / (1 - share) / direction[1])
    light = EVEN.copy()
    light[row, column] += irradiance / angle
    sun = Emitter(
        name="sun", direction=direction, solid_angle_sr=angle, half_angle_rad=np.radians(1.4), irradiance=irradiance,
        texels=[row * 128 + column],
    )  # fmt: skip
    return light, [sun]


def hidden_by_box(points: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Share of the irradiance at points of the plane that a box takes: slabs (Kay and Kajiya 1986), texel by texel."""
    ways = latlong_directions(64, 128).reshape(-1, 3)
    weight = (light.mean(-1) * latlong_solid_angles(64, 128)).ravel() * np.maximum(ways[:, 1], 0)
    low, high = np.array([-HALF[0], 0, -HALF[2]]), np.array([HALF[0], 2 * HALF[1], HALF[2]])
    with np.errstate(divide="ignore"):
        near, far = ((end - points[:, None]) / ways for end in (low, high))
    entry, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
    return np.asarray(((leave > np.maximum(entry, 0)) * weight).sum(1) / weight.sum())


@pytest.mark.parametrize("sun_deg", [None, 60.0, 12.0])
def test_it_bounds_what_a_box_hides(sun_deg: float | None) -> None:
    """300 points around a box: never less than a sum over texels, and far off not more than 4 times that.

    4: a sphere around this box has 2.4 times its mean outline, and the bound lifts it to touch the plane.
    """
    light, sun = (EVEN, []) if sun_deg is None else with_sun(sun_deg, 0.5)
    rng = np.random.default_rng(1)
    turn, away = rng.uniform(0, 2 * np.pi, 300), rng.uniform(0.05, 0.6, 300)
    points = np.stack([away * np.cos(turn), 0 * turn, away * np.sin(turn)], -1)
    sphere = np.array([0, HALF[1], 0, np.linalg.norm(HALF)])
    bound = influence(points, sphere[None], light_on(UP, light, sun))
    really = hidden_by_box(points, light)
    assert (bound >= really - 1e-4).all()  # texels are 2.8 degrees wide: what a sum of them is good for
    far = (away > 0.3) & (really > 1e-4) & (really < 0.2)
    assert sun_deg is not None or np.median(bound[far] / really[far]) < 4


def test_a_sphere_under_an_even_sky_is_the_configuration_factor() -> None:
    points = np.array([[0.5, 0, 0.0], [0, 0, -2.0]])
    found = influence(points, np.array([[0, 0.3, 0, 0.1]]), light_on(UP, EVEN, []))
    distance = np.hypot(np.linalg.norm(points, axis=1), 0.3)
    np.testing.assert_allclose(found, (0.1 / distance) ** 2 * 0.3 / distance, rtol=1e-3)
    assert not influence(np.array([[0, 0.5, 0.0]]), np.array([[0, 0.1, 0, 0.1]]), light_on(UP, EVEN, [])).any()
    dark, bright = (influence(points, np.array([[0, 0.3, 0, 0.1]]), light_on(UP, EVEN, []), e) for e in (0.0, 4.0))
    np.testing.assert_allclose(bright, 5 * dark, rtol=1e-6)  # what it reflects at most, and four times as much light


@pytest.mark.parametrize("elevation", [45.0, 12.0, 4.0])
def test_a_low_sun_throws_long_shadows_one_way(elevation: float) -> None:
    """The shadow of a ball of radius r that lies on the plane ends r (1 + 1 / sin e) / tan e + ... away from the sun.

    Its far end is where the tangent from the sun over the ball meets the plane: r / tan(e / 2) from the foot.
    """
    light, sun = with_sun(elevation, 0.5)
    rise = np.arcsin(sun[0].direction[1])
    end = 0.05 / np.tan(rise / 2)
    points = reach(np.array([0, 0.05, 0, 0.05]), light_on(UP, light, sun), 0.05, 10.0)
    assert end <= -points[:, 0].min() <= 1.1 * 0.05 / np.tan(rise / 2 - np.radians(1.4))  # a penumbra and a step more
    assert points[:, 0].max() < 0.4
    assert np.abs(points[:, 2]).max() < 0.5
    shorter = reach(np.array([0, 0.05, 0, 0.05]), light_on(UP, light, sun), 0.05, 0.3)
    assert np.linalg.norm(shorter, axis=1).max() <= 0.3 + 1e-9


def test_far_ground_against_a_sum() -> None:
    """An upright element at height h: the ground beyond d is within 2 % of FAR_SEEN of its view, by Monte Carlo."""
    rng = np.random.default_rng(3)
    u, v = rng.uniform(size=(2, 400_000))
    sine = np.sqrt(u)  # cosine law about +x
    ways = np.stack([np.sqrt(1 - u), sine * np.sin(2 * np.pi * v), sine * np.cos(2 * np.pi * v)], -1)
    down = ways[ways[:, 1] < 0]
    met = 0.07 / -down[:, 1] * np.hypot(down[:, 0], down[:, 2])
    assert (met > far_ground(0.07)).sum() / 400_000 == pytest.approx(FAR_SEEN, rel=0.02)


def test_the_rectangle_holds_what_changes_and_its_border_says_what_it_cuts() -> None:
    light = light_on(UP, *with_sun(20.0, 0.4))
    things = [Standing("a", np.array([0.0, 0.05, 0.0, 0.05])), Standing("b", np.array([0.5, 0.02, 0.3, 0.02]))]
    ends, reaches = needed(things, light, 0.004, 40.0)
    (x0, _, z0), (x1, _, z1) = ends
    corners = np.array([[x0, 0, z1], [x1, 0, z1], [x1, 0, z0], [x0, 0, z0]])
    border, change = beyond(corners, things, light)
    assert change.max() < 2 * 0.004  # each object alone stays below
    assert reaches[0] > reaches[1] > 0
    less, _ = needed(things, light, 0.02, 40.0)
    assert (less[0, [0, 2]] >= ends[0, [0, 2]]).all()
    assert (less[1, [0, 2]] <= ends[1, [0, 2]]).all()
    tight, _ = needed(things, light, 0.004, 2.0)
    np.testing.assert_allclose(tight[:, 0], [-0.1, 0.54])
    _, cut = beyond(corners * 0.2, things, light)
    assert cut.max() > 0.004
    assert np.isfinite(border).all()


def test_what_is_to_be_expected_of_a_ball() -> None:
    """Black under an even sky: the configuration factor. As white as the sky: nothing. Never more than the bound."""
    points, ball = np.array([[0.5, 0, 0.0], [0, 0, -2.0]]), np.array([0, 0.3, 0, 0.1])
    light = light_on(UP, EVEN, [])
    bound = influence(points, ball[None], light)
    np.testing.assert_allclose(expected(points, ball, light, np.zeros(3)), bound, rtol=1e-3)
    np.testing.assert_allclose(expected(points, ball, light, np.ones(3)), 0, atol=2e-3 * bound.max())
    lit, sun = with_sun(30.0, 0.5)
    spots = np.random.default_rng(2).uniform(-1, 1, (200, 3)) * (1, 0, 1)
    under = light_on(UP, lit, sun)
    for albedo in (0.0, 0.5, 1.0):
        assert (expected(spots, ball, under, np.full(3, albedo)) <= influence(spots, ball[None], under) + 1e-12).all()


def test_objects_are_spheres_of_their_files(tmp_path) -> None:
    """A ball's own sphere whatever its yaw and scale; colour and emission of the material."""
    level = Plane(normal=UP, offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=np.zeros((4, 3)), source="test")
    lamp = wish(tmp_path, 0.2, base_color=[0.2, 0.4, 0.6], emission=[0.0, 3.0, 1.0]) | {"yaw_deg": 30.0, "scale": 2.0}
    (found,) = standing({"object": [lamp]}, level, 0.1)
    np.testing.assert_allclose(found.sphere, [0.2, 0.09, 0.0, 0.16], atol=1e-6)
    assert (found.emission, found.albedo.tolist()) == (3.0, [0.2, 0.4, 0.6])
    gold = wish(tmp_path, 0.2, conductor="gold")
    assert standing({"object": [gold]}, level, 0.1)[0].albedo.min() > 0.5
    (bare,) = standing({"object": [{"name": "a", "position_m": (0.1, 0.3)}]}, level, 0.1)
    np.testing.assert_allclose(bare.sphere, [0.1, 0.05, 0.3, 0.05])


def test_a_surface_behind_an_object_is_not_touched() -> None:
    vertices, _ = box((0, 0.5, -0.4), (1, 1, 0.02))
    light = light_on(np.array([0.0, 0, 1.0]), EVEN, [])
    on_front = vertices[vertices[:, 2] > -0.395]
    assert (influence(on_front, np.array([[0, 0.1, 0, 0.1]]), light) > 0).all()
    assert not influence(on_front, np.array([[0, 0.1, -0.6, 0.1]]), light).any()
