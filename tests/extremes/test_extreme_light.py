"""Extremes of maps of light, and laws that hypothesis searches: energy through resizing, splitting and the ball."""

from __future__ import annotations

import numpy as np
import pytest
import test_lights
import test_unwrap
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.conventions import (
    direction_from_latlong,
    latlong_directions,
    latlong_from_direction,
    latlong_solid_angles,
)
from pipeline.light.emitters import lights
from pipeline.light.environment import irradiance, resize_environment, total_energy
from pipeline.probes import reflection
from pipeline.probes.unwrap import unwrap

SUN = np.radians(0.27)
HIGH = 0.6, 0.5, 0.4


def split_up(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sun (H, W, 3) and the sky (H, W, 3) of a map, as the render takes them."""
    found = lights(rgb, 0.02, test_lights.LIMIT)[0]
    assert len(found) == 1
    sun = np.zeros(rgb.shape)
    sun.reshape(-1, 3)[found[0].texels] = rgb.reshape(-1, 3)[found[0].texels]
    return sun, rgb - sun


@pytest.mark.parametrize("contrast", [1e6, 1e9])
def test_sun_above_the_sky(contrast, saw):
    """One texel of sun in float32, as maps are stored: its energy, and what is left of the sky beside it."""
    sky = test_lights.smooth_sky().astype(np.float32)
    rgb = sky.copy()
    row, column = np.unravel_index((test_lights.DIRECTIONS @ test_lights.unit(HIGH)).argmax(), rgb.shape[:2])
    rgb[row, column] = contrast
    sun, rest = split_up(rgb.astype(float))
    energy = total_energy(sun) / (contrast * test_lights.SOLID_ANGLES[row, column]) - 1
    normals = np.array([[0.0, 1, 0], [0, 0, 1]])
    left = irradiance(rest, normals) / irradiance(sky.astype(float), normals) - 1
    # the sky lacks the sun's own texel, 2.5e-4 of a hemisphere at most
    saw(f"sun.1e{round(np.log10(contrast))}", "exact", max(np.abs(energy).max(), np.abs(left).max()))


def test_sun_on_the_seam(saw):
    """The same sun on the seam and off it, by whole texels: what it gives to planes turned with it."""
    worst = 0.0
    base = 0.01 * np.ones((64, 128, 3))
    for height in (5, 30, 50):
        rgb = base.copy()
        rgb[height : height + 2, [127, 0]] = 1e5
        turned = np.roll(rgb, 32, 1)  # a quarter turn about +Y: -Z goes to +X
        on, off = split_up(rgb)[0], split_up(turned)[0]
        up = np.array([[0.0, 1, 0], [0, 0.6, -0.8]]), np.array([[0.0, 1, 0], [0.8, 0.6, 0]])
        lit = irradiance(off, up[1])
        worst = max(worst, np.abs(irradiance(on, up[0]) - lit).max() / lit.max())
    saw("sun.on_seam", "exact", worst)


def test_sun_at_the_pole(saw):
    """A cap about the zenith: energy times the mean cosine of a cap, (1 + cos a) / 2."""
    half = np.radians(3.0)
    lamp = test_lights.lamp((0, 1, 0), half, np.array([3.0, 2, 1])) + 1e-4
    (patch,) = lights(lamp, 0.02, test_lights.LIMIT)[0]
    sun = split_up(lamp)[0]
    inside = test_lights.disc((0, 1, 0), half)
    edge = np.arccos(1 - test_lights.SOLID_ANGLES[inside].sum() / (2 * np.pi))
    expected = total_energy(sun) * (1 + np.cos(edge)) / 2
    given_light = irradiance(sun, np.array([[0.0, 1, 0]]))[0]
    saw(
        "sun.at_pole",
        "exact",
        max(np.abs(given_light / expected - 1).max(), np.abs(patch.irradiance / expected - 1).max()),
    )


def test_black_map_has_no_lights_and_no_irradiance(saw):
    black = np.zeros((32, 64, 3))
    assert lights(black, 0.02, test_lights.LIMIT)[0] == []
    result = test_lights.computed(black)
    assert result.outputs["emitters"] == []
    light = irradiance(black, np.array([[0.0, 1, 0]]))
    assert np.isfinite(light).all()
    saw("environment.black", "exact", np.abs(light).max() + np.abs(resize_environment(black, 16, 32)).max())


# ---- searches ------------------------------------------------------------------------------------------------------


def maps(seed: int, height: int, contrast: float) -> np.ndarray:
    """A map (H, W, 3) with texels up to ``contrast`` decades apart, some black."""
    rng = np.random.default_rng(seed)
    width = int(rng.integers(2, 3 * height + 3))
    return 10 ** (contrast * rng.random((height, width, 3))) * (rng.random((height, width, 1)) < 0.9)


@given(
    seed=st.integers(0, 2**32 - 1), height=st.integers(1, 40), to=st.tuples(st.integers(1, 60), st.integers(1, 90)),
    contrast=st.floats(0, 9),
)  # fmt: skip
def test_resizing_keeps_energy(seed, height, to, contrast, saw):
    rgb = maps(seed, height, contrast)
    before, after = total_energy(rgb), total_energy(resize_environment(rgb, *to))
    saw("law.energy_resize", "exact", np.abs(np.divide(after - before, before, where=before > 0, out=0 * before)).max())


@given(
    seed=st.integers(0, 2**32 - 1), lamps=st.integers(0, 6), contrast=st.floats(0, 9), blur=st.floats(0.01, 0.3),
)  # fmt: skip
def test_splitting_keeps_energy(seed, lamps, contrast, blur, saw):
    """Lamps of any place and size over a noisy sky: every texel is in one light or in the sky."""
    rng = np.random.default_rng(seed)
    rgb = rng.gamma(4.0, 0.25, (48, 96, 3))
    directions = latlong_directions(48, 96)
    for _ in range(lamps):
        towards = rng.normal(size=3)
        rgb += 10**contrast * (directions @ (towards / np.linalg.norm(towards)) > np.cos(blur))[..., None]
    held = [patch.texels for patch in lights(rgb, 0.01, test_lights.LIMIT)[0]]
    whole = np.concatenate([*held, np.zeros(0, int)])
    assert len(set(whole.tolist())) == len(whole)
    parts = []
    sky = rgb.reshape(-1, 3).copy()
    for texels in held:
        lamp = np.zeros_like(sky)
        lamp[texels] = sky[texels]
        sky[texels] = 0
        parts.append(total_energy(lamp.reshape(rgb.shape)))
    total = np.sum([*parts, total_energy(sky.reshape(rgb.shape))], 0)
    saw("law.energy_split", "exact", np.abs(total / total_energy(rgb) - 1).max())


def unwrapped_energy(seed: int, ratio: float, radius_px: int, height: int) -> float:
    """Relative error of the energy of one bright pixel anywhere inside the rim, in a turned world."""
    mirror = test_unwrap.mirror_of(radius_px, ratio)
    rng = np.random.default_rng(seed)
    size = mirror.camera.height
    solid = test_unwrap.pixel_solid_angles(mirror, slice(0, size))
    rows, columns = np.nonzero(solid > 0)
    pick = rng.integers(len(rows))
    picture = np.zeros((size, size), np.float32)
    picture[rows[pick], columns[pick]] = 1e6
    found = unwrap(np.ones_like(picture), [picture], mirror, height, 2 * height)
    return abs(test_unwrap.map_energy(found) / test_unwrap.ball_energy(mirror, picture) - 1)


seeds, ratios = st.integers(0, 2**32 - 1), st.floats(1.5, 100)


@settings(max_examples=10)
@given(seed=seeds, ratio=ratios, radius_px=st.integers(100, 120), height=st.integers(16, 64))
def test_unwrapping_keeps_the_energy_of_a_lamp(seed, ratio, radius_px, height, saw):
    saw("law.energy_unwrap", "exact", unwrapped_energy(seed, ratio, radius_px, height))


@settings(max_examples=10)
@given(seed=seeds, ratio=ratios, radius_px=st.integers(40, 99), height=st.integers(16, 48))
def test_unwrapping_a_middling_ball(seed, ratio, radius_px, height, saw):
    saw("law.energy_unwrap_middle", "exact", unwrapped_energy(seed, ratio, radius_px, height))


@settings(max_examples=10)
@given(seed=seeds, ratio=ratios, radius_px=st.integers(20, 39), height=st.integers(16, 48))
def test_unwrapping_a_small_ball(seed, ratio, radius_px, height, saw):
    """`finding.complaints` says of such balls that their directions are coarse: ``ball.small``."""
    error = unwrapped_energy(seed, ratio, radius_px, height)
    saw("law.energy_unwrap_small", "degraded", error, said="directions are coarse")


@given(sine=st.floats(0, 1), ratio=st.floats(1e-9, 0.99))
def test_the_rim(sine, ratio, saw):
    """Deviation of the ray at ``sine`` of the silhouette's radius, back through the incidence; up to the rim itself."""
    theta = reflection.deviation(np.array(sine), ratio)
    again = reflection.deviation(np.sin(reflection.incidence(theta, ratio)), ratio)
    saw("formula.rim", "exact", abs(float(again - theta)))


@given(sine=st.floats(1e-3, 0.99), ratio=st.floats(1e-3, 0.9))
def test_gain_of_the_reflection(sine, ratio, saw):
    """d cos(theta) / d cos(rho) against central differences over the sine, Richardson's extrapolation."""

    def slope(step: float) -> float:
        low, high = np.array(sine - step), np.array(sine + step)
        # cos a - cos b = -2 sin((a + b) / 2) sin((a - b) / 2), which loses nothing for small angles
        theta = [float(reflection.deviation(s, ratio)) for s in (low, high)]
        rho = [float(np.arcsin(ratio * s)) for s in (low, high)]
        difference = [np.sin((a + b) / 2) * np.sin((b - a) / 2) for a, b in (theta, rho)]
        return difference[0] / difference[1]

    step = 2e-3 * min(sine, 1 - sine)
    numeric = (4 * slope(step / 2) - slope(step)) / 3
    found = float(reflection.solid_angle_gain(np.array(sine**2), ratio))
    saw("formula.jacobian", "exact", abs(found / numeric - 1))


@given(towards=st.tuples(*[st.floats(-1, 1)] * 3), shrink=st.floats(0, 12))
def test_the_pole(towards, shrink, saw):
    """Direction to lat-long and back, up to 10^-12 rad from the poles."""
    direction = np.array(towards) * [10**-shrink, 1, 10**-shrink]
    length = np.linalg.norm(direction)
    if length < 1e-3:
        return
    direction /= length
    back = direction_from_latlong(*latlong_from_direction(direction))
    saw("formula.pole", "exact", np.linalg.norm(np.cross(direction, back)))


@given(
    row=st.integers(0, 63), column=st.integers(0, 127), towards=st.tuples(*[st.floats(-1, 1)] * 3),
    radiance=st.floats(0, 12),
)  # fmt: skip
def test_irradiance_of_a_texel(row, column, towards, radiance, saw):
    """Radiance times solid angle times cosine, for any normal; the horizon may cut the texel: its part above."""
    normal = np.array(towards)
    if np.linalg.norm(normal) < 1e-3:
        return
    normal /= np.linalg.norm(normal)
    rgb = np.zeros((64, 128, 3))
    rgb[row, column] = 10**radiance
    fine = direction_from_latlong(
        *np.meshgrid((column + (np.arange(64) + 0.5) / 64) / 128, (row + (np.arange(64) + 0.5) / 64) / 64)
    )
    weight = np.sin(np.pi * (row + (np.arange(64) + 0.5) / 64) / 64)[:, None]
    expected = (np.maximum(fine @ normal, 0) * weight).sum() / (64 * weight.sum())
    found = irradiance(rgb, normal[None])[0, 1] / (10**radiance * latlong_solid_angles(64, 128)[row, column])
    saw("formula.irradiance", "exact", abs(found - expected))
