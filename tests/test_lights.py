"""Lights apart from the sky, on maps whose lamps are known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.emitters import components, lights
from pipeline.light.environment import total_energy
from pipeline.run.artifacts import EMITTERS
from pipeline.run.runner import settle
from pipeline.types import Raster
from stages import knobs
from stages import lights as room

HEIGHT, WIDTH = 128, 256
TEXEL = np.pi / HEIGHT
DIRECTIONS, SOLID_ANGLES = latlong_directions(HEIGHT, WIDTH), latlong_solid_angles(HEIGHT, WIDTH)
LIMIT = np.radians(10)
WHERE = {
    "aside": (0.6, 0.5, 0.4), "seam": (0.0, 0.4, -1.0), "zenith": (0.0, 1.0, 0.0), "nadir": (0.0, -1.0, 0.0),
    "near zenith": (0.03, 1.0, -0.02),
}  # fmt: skip


def unit(vector) -> np.ndarray:
    return np.asarray(vector, float) / np.linalg.norm(vector)


def smooth_sky() -> np.ndarray:
    x, y, z = np.moveaxis(DIRECTIONS, -1, 0)
    return np.stack([1 + 0.4 * y + 0.3 * x, 1 + 0.4 * y, 1 + 0.5 * y + 0.2 * z], -1)


def disc(direction, half_angle: float) -> np.ndarray:
    """Texels (H, W) whose centres a disc covers."""
    return DIRECTIONS @ unit(direction) > np.cos(half_angle)


def lamp(direction, half_angle: float, energy) -> np.ndarray:
    """A uniform disc (H, W, 3) whose integral of radiance is ``energy`` exactly."""
    inside = disc(direction, half_angle)
    return inside[..., None] * np.asarray(energy, float) / SOLID_ANGLES[inside].sum()


def blurred(direction, sigma: float, energy: float) -> np.ndarray:
    """A Gaussian lamp (H, W, 3)."""
    angle = np.arccos(np.clip(DIRECTIONS @ unit(direction), -1, 1))
    shape = np.exp(-0.5 * (angle / sigma) ** 2)
    return (shape / (shape * SOLID_ANGLES).sum())[..., None] * energy * np.ones(3)


def found(rgb, min_share: float = 0.02):
    return lights(rgb, min_share, LIMIT)[0]


def computed(rgb, **changes):
    raster = Raster(Raster.split(np.asarray(rgb, np.float32)), "acescg")
    return room.compute(raster, knobs.Lights(**changes))


@pytest.mark.parametrize("half_angle_deg", [3.0, 7.0])
@pytest.mark.parametrize("where", WHERE)
def test_lamp_has_its_texels_direction_size_and_energy(where, half_angle_deg):
    half_angle, energy = np.radians(half_angle_deg), np.array([3.0, 2.0, 1.0])
    rgb = 0.5 * smooth_sky() + lamp(WHERE[where], half_angle, energy)
    (patch,) = found(rgb)
    inside = disc(WHERE[where], half_angle)
    np.testing.assert_array_equal(patch.texels, np.flatnonzero(inside))
    assert patch.solid_angle_sr == pytest.approx(SOLID_ANGLES[inside].sum())
    # Texels are whole or not at all: with n = 2 pi a / texel of them on the border, in or out at random, the
    # centroid is off by sqrt(n / 12) texel^2 / (pi a), 0.1 texel at 7 degrees; three times that is allowed, and half
    # a texel of radius.
    assert np.degrees(np.arccos(min(patch.direction @ unit(WHERE[where]), 1))) < np.degrees(0.3 * TEXEL)
    assert patch.half_angle_rad == pytest.approx(half_angle, abs=0.5 * TEXEL)
    below = 0.5 * (smooth_sky() * (inside * SOLID_ANGLES)[..., None]).sum((0, 1))
    facing = (1 + np.cos(half_angle)) / 2  # mean cosine over a cap
    np.testing.assert_allclose(patch.irradiance, (energy + below) * facing, rtol=1e-3)


def test_one_texel_is_as_wide_as_a_texel():
    rgb = smooth_sky()
    rgb[40, 100] += 5 / SOLID_ANGLES[40, 100]
    (patch,) = found(rgb)
    assert patch.texels.tolist() == [40 * WIDTH + 100]
    # A disc of half angle a has the mean square distance a^2 / 2, a square of side s has s^2 / 6.
    sides = TEXEL**2 * (1 + np.sin(np.pi * 40.5 / HEIGHT) ** 2) / 12
    assert patch.half_angle_rad == pytest.approx(np.sqrt(2 * sides), rel=1e-3)


def test_groups_are_sets_of_texels_so_light_is_conserved_exactly():
    rgb = smooth_sky() + lamp((1, 1, 0), 0.05, 3.0) + lamp((0, 0.2, -1), 0.04, 2.0)
    emitters = settle(EMITTERS, computed(rgb).outputs["emitters"])
    assert [emitter.name for emitter in emitters] == ["lamp_1", "lamp_2"]
    held = np.concatenate([emitter.texels for emitter in emitters])
    assert len(set(held.tolist())) == len(held)
    for emitter in emitters:
        assert np.all(np.diff(emitter.texels) > 0)
        assert 0 <= emitter.texels[0] <= emitter.texels[-1] < HEIGHT * WIDTH
        energy = SOLID_ANGLES.ravel()[emitter.texels]
        assert emitter.solid_angle_sr == pytest.approx(energy.sum())


def test_two_near_lamps_are_two_and_keep_their_blur():
    """Blurred until they touch: 6 sigma apart the saddle is 3 % of the weaker peak, and sharp is a fall to 10 %.

    Beyond the saddle a Gaussian holds 1 % of its light there; shared out by nearness, energies come back to 1 %.
    """
    sigma = np.radians(1.5)
    one, other = unit((1, 1, 0)), unit((np.cos(np.pi / 4 + 6 * sigma), np.sin(np.pi / 4 + 6 * sigma), 0))
    rgb = 0.01 * smooth_sky() + blurred(one, sigma, 3.0) + blurred(other, sigma, 2.0)
    pair = found(rgb)
    assert len(pair) == 2
    for patch, direction, energy in zip(pair, (one, other), (3.0, 2.0), strict=True):
        assert patch.direction @ direction > np.cos(0.3 * sigma)
        assert patch.irradiance == pytest.approx(np.full(3, energy), rel=0.01)
    assert not set(pair[0].texels) & set(pair[1].texels)


def test_one_blurred_lamp_is_one_light_and_keeps_its_energy():
    """A Gaussian's share beyond the level t is t over its peak: here 0.005 of the sky's level over 200."""
    (patch,) = found(0.01 * smooth_sky() + blurred((0.5, 1, 0.2), np.radians(2), 3.0))
    assert patch.irradiance == pytest.approx(np.full(3, 3.0), rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_sky_without_lamps_has_no_lights(noise):
    """Smooth, constant, and with noise up to a single photon's (exponential: the variance is the mean squared)."""
    random = np.random.default_rng(1)
    for rgb in (smooth_sky(), np.ones((HEIGHT, WIDTH, 3))):
        grain = random.exponential(1.0, (HEIGHT, WIDTH, 1))
        assert found(rgb * (1 - noise + noise * grain)) == []


def test_a_broad_glow_is_sky():
    """cos^40: half its light lies within 15 degrees, nothing about it is sharp."""
    glow = np.maximum(DIRECTIONS @ unit((1, 1, 1)), 0) ** 40
    assert found(glow[..., None] * 20 + smooth_sky()) == []


def test_lamp_in_noise_is_found():
    """Noise of 20 % per texel: what it adds to the patch turns the direction by less than a fifth of a texel."""
    random = np.random.default_rng(2)
    rgb = smooth_sky() * random.gamma(25.0, 1 / 25.0, (HEIGHT, WIDTH, 1)) + lamp((0.6, 0.5, 0.4), 0.06, 4.0)
    (patch,) = found(rgb)
    inside = disc((0.6, 0.5, 0.4), 0.06)
    assert set(np.flatnonzero(inside)) <= set(patch.texels)
    assert patch.direction @ unit((0.6, 0.5, 0.4)) > np.cos(0.2 * TEXEL)


def test_window_of_four_panes_stays_in_the_sky():
    azimuth = np.degrees(np.arctan2(DIRECTIONS[..., 0], DIRECTIONS[..., 2]))
    elevation = np.degrees(np.arcsin(DIRECTIONS[..., 1]))
    pane = (np.abs(np.abs(azimuth) - 11) < 10) & (np.abs(np.abs(elevation - 30) - 8) < 7)
    kept, wide = lights(0.3 * smooth_sky() + 4.0 * (0.2 + 0.8 * pane[..., None]) * (np.abs(elevation - 30) < 15)[
        ..., None] * (np.abs(azimuth) < 21)[..., None], 0.02, LIMIT)  # fmt: skip
    assert kept == []
    assert len(wide) == 1
    assert wide[0].half_angle_rad > LIMIT


def test_turning_the_world_about_the_vertical_turns_the_lights():
    rgb = smooth_sky() + lamp((0.3, 0.5, 1), 0.05, 3.0)
    (before,) = found(rgb)
    for shift in (100, 128, 133, 200):
        (after,) = found(np.roll(rgb, shift, 1))
        row, column = np.divmod(before.texels, WIDTH)
        assert sorted((row * WIDTH + (column + shift) % WIDTH).tolist()) == after.texels.tolist()
        assert after.half_angle_rad == pytest.approx(before.half_angle_rad)


def test_exposure_changes_no_decision():
    rgb = smooth_sky() + blurred((0.3, 0.5, 1), 0.03, 3.0)
    (one,), (other,) = found(rgb), found(1e4 * rgb)
    np.testing.assert_array_equal(one.texels, other.texels)
    np.testing.assert_allclose(other.irradiance, 1e4 * one.irradiance)


def test_what_is_not_a_map_of_light_has_no_lights():
    assert found(np.zeros((8, 16, 3))) == []
    rgb = smooth_sky() + lamp((1, 1, 0), 0.05, 3.0)
    rgb[3, 5] = np.nan
    rgb[9, 9] = -7.0
    assert len(found(rgb)) == 1


@pytest.mark.parametrize("shape", [(8, 16), (9, 18)])
def test_components_join_over_seam_and_poles(shape):
    inside = np.zeros(shape, bool)
    inside[3, 0] = inside[4, -1] = True  # touch by a corner over the seam
    inside[0, 2] = inside[0, 9] = True  # touch at the pole
    inside[-1, 4] = True
    inside[5, 5] = True
    labels = components(inside)
    assert np.all((labels > 0) == inside)
    assert labels[3, 0] == labels[4, -1]
    assert labels[0, 2] == labels[0, 9]
    assert len({labels[3, 0], labels[0, 2], labels[-1, 4], labels[5, 5]}) == 4


# the stage: names, limits, reasons


def sun(direction=(0.5, 0.8, 0.2), half_angle: float = np.radians(1.2), energy: float = 30.0) -> np.ndarray:
    return smooth_sky() + lamp(direction, half_angle, energy)


def test_only_a_sun_is_called_so():
    for rgb, names in [
        (sun(), ["sun"]), (sun(direction=(0.5, -0.8, 0.2)), ["lamp_1"]), (sun(half_angle=0.1), ["lamp_1"]),
        (sun(half_angle=np.radians(1.8), energy=0.28), ["lamp_1"]),
            (sun() + lamp((-1, 1, 0), 0.05, 20.0), ["lamp_1", "lamp_2"]),
        (smooth_sky(), []),
    ]:  # fmt: skip
        assert [emitter.name for emitter in computed(rgb).outputs["emitters"]] == names


def test_the_four_strongest_are_kept_and_the_fifth_is_reported():
    energies = [1.0, 5.0, 3.0, 2.0, 4.0]
    rgb = smooth_sky()
    for azimuth, energy in enumerate(energies):
        rgb = rgb + lamp((np.sin(azimuth), 0.7, np.cos(azimuth)), 0.05, energy)
    result = computed(rgb)
    strengths = [emitter.irradiance.mean() for emitter in result.outputs["emitters"]]
    np.testing.assert_allclose(strengths, [5, 4, 3, 2], rtol=0.02)
    assert len(result.warnings) == 1
    assert "left in the sky" in result.warnings[0]
    shares = [values["share"] for values in result.numbers.values()]
    assert sum(shares) == pytest.approx(1)
    grey = total_energy(rgb).mean()
    assert result.numbers["lamp_1"]["share"] == pytest.approx(5 / grey, rel=0.02)


def test_every_decision_has_its_reason():
    result = computed(sun())
    assert [row["modelled"] for row in result.evidence] == [True]
    assert "elevation 56" in result.evidence[0]["because"]
    result = computed(smooth_sky())
    assert [row["modelled"] for row in result.evidence] == [False]
    result = computed(sun(energy=1.0), min_share=0.2)
    assert "holds 20.0%" in result.evidence[0]["because"]
    result = computed(smooth_sky() + lamp((0, 1, 1), np.radians(16), 20.0))
    assert result.outputs["emitters"] == []
    assert "wider than 10" in result.evidence[0]["because"]
    assert len(computed(sun(half_angle=0.2), max_half_angle_deg=15).outputs["emitters"]) == 1
