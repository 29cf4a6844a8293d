"""Lamps that a shadow's edge places: fitted on edges of known discs, carried, drawn, and turned by their own sigmas."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.budget import light
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.alike import ALIKE
from pipeline.light.ball_shadow import Ball, edge_angle, visible_part
from pipeline.light.environment import SCALE_SIGMA, irradiance
from pipeline.light.placed import (
    SUN_HALF_ANGLE,
    Placed,
    axes_about,
    disc_texels,
    draw_disc,
    header_of,
    is_placed,
    placed_in,
    turned_to,
    without_placed,
)
from pipeline.probes.rim import BLUR_LOG_SIGMA, BLUR_PX
from pipeline.probes.shadow_edge import Edge, Penumbra, fit_edge
from pipeline.types import Emitter, Raster
from stages import knobs
from stages import lights as room

HEIGHT, WIDTH = 256, 512
UP = np.array([[0, 1.0, 0]])
SUN = np.array([0.52, 0.7, -0.49]) / np.linalg.norm([0.52, 0.7, -0.49])
FLUX, SKY = np.array([40000.0, 36000.0, 30000.0]), 3000.0
SIGMA = np.radians([0.05, 0.03])
BALL = Ball(np.array([0.0, 0.065, 0.0]), 0.065, np.ones(3))
PIXEL, NOISE = 0.001, 0.005  # m on the plane; of a block's ratio


def middle_of(rgb: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """Mean direction (3,) of what texels show, by energy."""
    height = rgb.shape[0]
    energy = rgb.reshape(-1, 3)[texels, 1] * latlong_solid_angles(height, 2 * height).ravel()[texels]
    mean = energy @ latlong_directions(height, 2 * height).reshape(-1, 3)[texels]
    return np.asarray(mean / np.linalg.norm(mean))


# the edge's own errors


def edge_seen(random: np.random.Generator, ball: Ball, half: float) -> Penumbra:
    """Blocks of 3 x 3 pixels about the shadow's edge of ``ball``, with noise, through a blur drawn from its prior."""
    foot = random.uniform([-0.2, 0, -0.05], [0.05, 0, 0.25], (6000, 3))
    near = np.abs(edge_angle(foot, SUN, BALL)) < np.radians(2.5)
    points = foot[near & (np.hypot(foot[:, 0], foot[:, 2]) > 0.02)][:250]
    count = len(points)
    step = np.broadcast_to(PIXEL * np.array([[1.0, 0, 0], [0, 0, 1.0]]), (count, 2, 3))
    flat = np.zeros(count), np.full(count, NOISE)
    exact = Penumbra(points, step, 3, *flat, np.full(count, 0.25), np.ones(count))
    blur = BLUR_PX * np.exp(BLUR_LOG_SIGMA * random.standard_normal())
    seen = exact.predicted(SUN, half, blur, ball) + NOISE * random.standard_normal(count)
    return Penumbra(points, step, 3, seen, flat[1], exact.dark, exact.lit)


@pytest.mark.parametrize("half_deg", [0.2665, 0.6])
def test_the_edge_places_a_lamp_as_surely_as_it_says(half_deg):
    """60 draws about an exact ball: a spread of z over 60 is known to 1 / sqrt(120) = 9 %; three of these.

    It is to be 0.82: soft_l1's second derivative counts rows (1 + f^2)^(-3/2), its slope has the mean square
    f^2 / (1 + f^2), and of Gaussian noise the root of their means' ratio is 0.82, so sigmas are a fifth too wide.
    """
    random, score, stated = np.random.default_rng(4), [], []
    for _ in range(60):
        start = turned_to(SUN, *np.radians(0.3) * random.standard_normal(2))
        edge = found_edge(edge_seen(random, BALL, np.radians(half_deg)), start, None)
        score.append(axes_about(SUN) @ (edge.direction - SUN) / edge.direction_sigma)
        stated.append(edge.direction_sigma)
    assert np.std(score, 0) == pytest.approx(np.full(2, 0.82), abs=0.27 * 0.82)
    assert np.abs(np.mean(score, 0)).max() < 4 / np.sqrt(60)
    assert np.degrees(np.max(stated)) < 0.05


def found_edge(seen: Penumbra, start: np.ndarray, place: np.ndarray | None) -> Edge:
    edge = fit_edge(seen, start, np.radians(2), BALL, place)
    assert edge is not None
    return edge


def test_an_uncertain_ball_makes_the_direction_less_sure():
    """The more, the less sure it is; not without end, as its edge near by moves with the ball."""
    random = np.random.default_rng(5)
    seen = edge_seen(random, BALL, SUN_HALF_ANGLE)
    sigmas = [None, 1e-5, 1e-4, 1e-3, 1e-2]
    found = [found_edge(seen, SUN, None if s is None else np.eye(3) * s**2) for s in sigmas]
    turns = np.array([np.hypot(*edge.direction_sigma) for edge in found])
    assert np.all(np.diff(turns[:4]) > 0)
    assert turns[4] == pytest.approx(turns[3], rel=0.01)
    assert all(edge.direction == pytest.approx(found[0].direction) for edge in found)


# what is drawn


def probe_map(direction: np.ndarray, half: float, placed: bool) -> Raster:
    """As the probe stage leaves a recovered sun: the disc on coarse texels, over an even sky, 2 % unsure."""
    rgb = np.full((HEIGHT, WIDTH, 3), SKY)
    texels, share = disc_texels(direction, half, HEIGHT)
    solid = latlong_solid_angles(HEIGHT, WIDTH).ravel()[texels, None]
    rgb.reshape(-1, 3)[texels] += share[:, None] * FLUX / solid
    held = np.zeros((HEIGHT, WIDTH), np.float32)
    held.ravel()[texels] = 1
    channels = {
        **Raster.split(rgb.astype(np.float32)), **Raster.split((0.02 * rgb).astype(np.float32) ** 2, "variance"),
        "clipped": held, "recovered": held, "seen": np.ones((HEIGHT, WIDTH), np.float32),
    }  # fmt: skip
    lamp = Placed(tuple(direction), half, np.radians(0.06), tuple(SIGMA))
    return Raster(channels, "acescg", {ALIKE: "4", SCALE_SIGMA: "0 0 0"} | (header_of([lamp]) if placed else {}))


def test_headers_come_back():
    lamps = [Placed((0.0, 0.6, 0.8), 0.01, 0.002, (0.001, 0.002)), Placed((1.0, 0.0, 0.0), 0.005, 0.0, (0.1, 0.1))]
    assert placed_in(Raster({}, "acescg", header_of(lamps))) == lamps
    assert header_of([]) == {}
    assert placed_in(Raster({}, "acescg")) == []


@pytest.mark.parametrize("direction", [SUN, np.array([0.003, 0.8, -0.6]), np.array([0.002, 1.0, 0.001])])
def test_a_recovered_sun_is_drawn_where_and_as_wide_as_its_edge_says(direction):
    """Its middle to a tenth of a fine texel of 0.18 degrees, its light to a part of it that its own width leaves."""
    direction = direction / np.linalg.norm(direction)
    picture = probe_map(direction, SUN_HALF_ANGLE, placed=True)
    result = room.compute(picture, knobs.Lights())
    (sun,), lit = result.outputs["emitters"], result.outputs["lighting"]
    assert is_placed(sun)
    assert sun.half_angle_rad == pytest.approx(SUN_HALF_ANGLE)
    assert sun.half_angle_sigma_rad == pytest.approx(np.radians(0.06))
    assert sun.direction_sigma_rad == pytest.approx(SIGMA)
    assert np.degrees(np.arccos(min(sun.direction @ direction, 1.0))) < 1e-3
    assert lit.shape == (1024, 2048)
    assert np.degrees(np.arccos(min(middle_of(lit.rgb(), sun.texels) @ direction, 1.0))) < 0.02
    assert irradiance(lit.rgb(), UP)[0] == pytest.approx(SKY * np.pi + FLUX * direction[1], rel=2e-3)
    assert np.all(lit.rgb() >= SKY * 0.999)
    (row,) = [row for row in result.evidence if row["term"].startswith("place and width")]
    assert row["modelled"]
    assert "0.27 +- 0.06" in row["because"]


def test_what_no_edge_places_stays_on_the_maps_texels():
    picture = probe_map(SUN, SUN_HALF_ANGLE, placed=False)
    result = room.compute(picture, knobs.Lights())
    (sun,) = result.outputs["emitters"]
    assert not is_placed(sun)
    assert sun.half_angle_sigma_rad == 0
    assert (result.outputs["lighting"].rgb() == picture.rgb()).all()
    asked = room.compute(probe_map(SUN, SUN_HALF_ANGLE, placed=True), knobs.Lights(width="seen"))
    assert not is_placed(asked.outputs["emitters"][0])
    assert (asked.outputs["lighting"].rgb() == picture.rgb()).all()


def test_a_disc_keeps_its_flux_and_leaves_its_border():
    """Drawn elsewhere, the old texels show what bordered on them; at the seam and beside the pole too."""
    for way in (SUN, [0.001, 0.5, -0.86], [0.01, 0.99, 0.02]):
        direction = np.array(way) / np.linalg.norm(way)
        rgb = probe_map(direction, SUN_HALF_ANGLE, placed=True).rgb().astype(float).reshape(-1, 3)
        texels, _ = disc_texels(direction, SUN_HALF_ANGLE, HEIGHT)
        solid = latlong_solid_angles(HEIGHT, WIDTH).ravel()
        before = solid @ rgb
        landed = draw_disc(rgb, texels, turned_to(direction, 0.05, 0.0), SUN_HALF_ANGLE)
        assert solid @ rgb == pytest.approx(before, rel=1e-6)
        assert rgb[np.setdiff1d(texels, landed)] == pytest.approx(SKY)


# how it may be wrong


def drawn_sun() -> tuple[Raster, Emitter]:
    found = room.compute(probe_map(SUN, SUN_HALF_ANGLE, placed=True), knobs.Lights()).outputs
    return found["lighting"], found["emitters"][0]


def test_a_placed_lamp_turns_by_its_own_sigmas():
    """Patterns move its middle by one sigma along each axis, a tenth of which is a texel's rounding; its flux stays."""
    lit, sun = drawn_sun()
    level, upright = light.lamp_turns(lit, [sun])
    for pattern, axis, sigma in zip((level, upright), axes_about(SUN), SIGMA, strict=True):
        assert pattern.source == "turn"
        assert pattern.lamps is not None
        (there,) = pattern.lamps.emitters
        moved = middle_of(pattern.lamps.rgb, there.texels) - middle_of(lit.rgb(), sun.texels)
        assert moved @ axis == pytest.approx(sigma, abs=0.2 * sigma)
        assert np.linalg.norm(moved - (moved @ axis) * axis) < 0.25 * sigma
        solid = latlong_solid_angles(*lit.shape).ravel()
        assert solid @ pattern.lamps.rgb.reshape(-1, 3) == pytest.approx(solid @ lit.rgb().reshape(-1, 3), rel=1e-5)
    assert light.lamp_turns(lit, [sun.model_copy(update={"direction_sigma_rad": np.zeros(2)})]) == []


def test_the_bound_of_a_turn_is_the_steepest_part_of_its_edge():
    """2 / (pi a) of the light per radian, against the visible part of a disc, whose slope is taken in the middle."""
    a, step = SUN_HALF_ANGLE, 1e-4 * SUN_HALF_ANGLE
    slope = float(np.diff(visible_part(np.array([-step, step]), a))[0] / (2 * step))
    assert slope == pytest.approx(2 / (np.pi * a), rel=1e-3)
    lit, sun = drawn_sun()
    level, _ = light.lamp_turns(lit, [sun])
    sides = SKY * np.pi + FLUX * np.maximum(np.r_[SUN, -SUN], 0)[:, None]
    share = np.linalg.norm(sides - SKY * np.pi, axis=1) / np.linalg.norm(sides, axis=1)
    assert level.bound == pytest.approx(SIGMA[0] * slope * share.max(), rel=0.02)


def test_the_balls_pose_does_not_turn_a_placed_lamp():
    lit, sun = drawn_sun()
    covariance = np.eye(3) * np.radians(0.3) ** 2
    held = light.turn_patterns(lit, [sun], covariance)
    free = light.turn_patterns(lit, [sun.model_copy(update={"direction_sigma_rad": np.zeros(2)})], covariance)
    assert max(pattern.bound for pattern in held) < 1e-3 * max(pattern.bound for pattern in free)  # an even sky
    assert without_placed(lit.rgb(), [sun]) == pytest.approx(SKY, rel=1e-4)
