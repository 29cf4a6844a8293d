"""Laws of lat-long integrals: constants, conservation, rotation by whole texels, known point lights."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import AXES, irradiance, resize_environment, total_energy
from pipeline.light.harmonics import sh9_basis, sh9_irradiance, sh9_of_environment, sh9_sigma

TILTED = np.array([[0.3, 0.8, -0.52], [-0.11, 0.02, 0.99], [0.7, -0.7, 0.1]])
NORMALS = np.concatenate([AXES, TILTED / np.linalg.norm(TILTED, axis=1, keepdims=True)])


def noise_map(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).gamma(0.5, 1.0, (height, width, 3))


def test_constant_map_gives_pi_for_any_normal():
    # 1e-6: the texels cut by the horizon are integrated from 8 x 8 parts (docstring; measured 2e-7)
    assert irradiance(np.ones((256, 512, 3)), NORMALS) == pytest.approx(np.pi, rel=1e-6)


@pytest.mark.parametrize("shape", [(1, 2), (2, 4), (16, 32), (33, 70)])
def test_constant_map_small_and_odd_sizes(shape):
    # the cut of the horizon is resolved to 1/8 of a texel: error below (texel/8)^2 / 2 in radians squared
    bound = max((np.pi / shape[0] / 8) ** 2, 1e-6)
    assert irradiance(np.full((*shape, 3), 2.0), NORMALS) == pytest.approx(2 * np.pi, rel=bound)


def test_opposite_normals_differ_by_the_vector_irradiance():
    rgb = noise_map(64, 128)
    rough = np.einsum("hw,hwc,hwk->kc", latlong_solid_angles(64, 128), rgb, latlong_directions(64, 128))
    # centre directions against exact texel integrals: texel^2 / 24 = 1e-4
    assert irradiance(rgb, AXES[::2]) - irradiance(rgb, AXES[1::2]) == pytest.approx(rough, abs=3e-4 * np.pi)


def test_lamp_texel_gives_cosine_times_solid_angle():
    rgb = np.zeros((64, 128, 3))
    rgb[20, 33] = 1e9
    cosine = np.maximum(NORMALS @ latlong_directions(64, 128)[20, 33], 0)
    expected = 1e9 * latlong_solid_angles(64, 128)[20, 33] * cosine
    assert irradiance(rgb, NORMALS)[:, 1] == pytest.approx(expected, rel=4e-4)  # texel^2 / 6 bounds the centre rule


def test_lamp_on_the_seam_equals_lamp_off_the_seam():
    rgb = np.zeros((32, 64, 3))
    rgb[9:12, [63, 0]] = 5.0
    turned = np.roll(rgb, 16, 1)  # a quarter turn about +Y: -Z goes to +X
    assert irradiance(turned, AXES[[0, 2]]) == pytest.approx(irradiance(rgb, AXES[[5, 2]]), rel=1e-12)


@pytest.mark.parametrize("size", [(16, 32), (10, 33), (64, 128), (100, 190)])
def test_resize_keeps_energy_and_constants(size):
    rgb = noise_map(64, 128)
    assert total_energy(resize_environment(rgb, *size)) == pytest.approx(total_energy(rgb), rel=1e-12)
    assert resize_environment(np.ones((64, 128, 3)), *size) == pytest.approx(1.0, rel=1e-12)


def test_resizing_agrees_with_weighted_mean_of_blocks():
    rgb, weight = noise_map(8, 16), latlong_solid_angles(8, 16)
    block = (rgb[2:4, 6:8] * weight[2:4, 6:8, None]).sum((0, 1)) / weight[2:4, 6:8].sum()
    assert resize_environment(rgb, 4, 8)[1, 3] == pytest.approx(block, rel=1e-12)


def test_same_size_resize_is_identity():
    rgb = noise_map(16, 32)
    assert resize_environment(rgb, 16, 32) == pytest.approx(rgb, rel=1e-12)


def test_harmonics_are_orthonormal_and_reproduce_themselves():
    directions, weight = latlong_directions(128, 256), latlong_solid_angles(128, 256)
    basis = sh9_basis(directions)
    assert np.einsum("hw,hwa,hwb->ab", weight, basis, basis) == pytest.approx(np.eye(9), abs=2e-4)  # midpoint rule
    coefficients = np.random.default_rng(0).normal(size=(9, 3))
    again = sh9_of_environment(sh9_basis(directions) @ coefficients)
    assert again == pytest.approx(coefficients, abs=1e-3)


def test_harmonic_irradiance_is_exact_for_light_of_second_order():
    coefficients = np.random.default_rng(1).normal(size=(9, 3))
    rgb = sh9_basis(latlong_directions(256, 512)) @ coefficients
    assert sh9_irradiance(coefficients, NORMALS) == pytest.approx(irradiance(rgb, NORMALS), abs=1e-3)


def test_uncertainty_of_the_harmonics_is_their_scatter():
    rng, sigma = np.random.default_rng(3), 0.1 + np.abs(latlong_directions(16, 32)[..., :1])
    found = [sh9_of_environment(sigma * rng.standard_normal((16, 32, 1))) for _ in range(2000)]
    # The scatter of 2000 normal draws is known to 1 / sqrt(4000) = 1.6 %; four of those.
    assert sh9_sigma(sigma**2) == pytest.approx(np.std(found, 0), rel=0.064)
