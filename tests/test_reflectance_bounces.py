"""Inverse radiosity against exact solutions: closed and open boxes of patches with known form factors."""

import functools

import numpy as np
import pytest

from pipeline.transport import radiosity

N = 4
FACES = {
    "floor": ((0, 0, 0), (0, 0, 1), (1, 0, 0)), "back": ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    "left": ((0, 0, 0), (0, 1, 0), (0, 0, 1)), "right": ((1, 0, 0), (0, 0, 1), (0, 1, 0)),
    "front": ((0, 0, 1), (0, 1, 0), (1, 0, 0)), "top": ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
}  # fmt: skip
SCENES = {"corner": 2, "three": 3, "open box": 5, "closed box": 6}


@functools.cache
def form_factors(count: int) -> np.ndarray:
    """Reciprocal form factors of the unit box's first faces, N x N patches each; a closed box has row sums of 1.

    Point to point; whether they are those of a real box does not matter here, that they are reciprocal does.
    """
    steps = (np.arange(N) + 0.5) / N
    points, normals = [], []
    for origin, u, v in (np.array(face, float) for face in list(FACES.values())[:count]):
        points.append(origin + np.repeat(steps, N)[:, None] * u + np.tile(steps, N)[:, None] * v)
        normals.append(np.tile(np.cross(u, v), (N * N, 1)))
    point, normal = np.concatenate(points), np.concatenate(normals)
    arm = point[None] - point[:, None]
    square = (arm**2).sum(-1) + np.eye(len(point))
    kernel = np.maximum((arm * normal[:, None]).sum(-1), 0) * np.maximum(-(arm * normal[None]).sum(-1), 0)
    kernel /= np.pi * square**2 * N**2
    for _ in range(200):  # symmetric scaling keeps reciprocity
        size = np.sqrt(np.maximum(kernel.sum(1), 1e-12 if count == 6 else 1.0))
        kernel /= size[:, None] * size[None]
    return kernel


def scene(name: str, radius: float, texture: str, seed: int):
    """Truth of a scene with a given spectral radius: albedo, E0, F, radiosity; None when it needs an albedo > 0.97."""
    rng = np.random.default_rng(seed)
    count = SCENES[name]
    factors = form_factors(count)
    faces = np.repeat(rng.uniform(0.5, 1, count), N * N)
    pattern = {"uniform": np.ones(count * N * N), "faces": faces, "texels": rng.uniform(0.5, 1, count * N * N)}[texture]
    largest = np.abs(np.linalg.eigvals(pattern[:, None] * factors)).max()
    albedo = (pattern * radius / largest)[:, None]
    if albedo.max() > 0.97:
        return None
    direct = (np.repeat(rng.uniform(0.3, 1, count), N * N) * rng.uniform(0.7, 1, count * N * N))[:, None]
    return albedo, direct, factors, albedo * radiosity.irradiance(albedo, direct, factors)


GRID = [(name, texture, seed) for name in SCENES for texture in ("uniform", "faces", "texels") for seed in range(3)]


@pytest.mark.parametrize("radius", [0.15, 0.3, 0.45, 0.52, 0.6, 0.65, 0.72, 0.75])
def test_damped_iteration_reaches_one_percent_within_eight_steps(radius):
    scenes = 0
    for name, texture, seed in GRID:
        if (truth := scene(name, radius, texture, seed)) is None:
            continue
        albedo, direct, factors, measured = truth
        found = radiosity.estimate(measured, direct, factors, np.eye(len(albedo)), method="damped")
        assert found.steps <= radiosity.STEPS == 8
        assert found.spectral_radius == pytest.approx(radius, rel=0.01)
        np.testing.assert_allclose(found.albedo, albedo, rtol=0.01, err_msg=f"{name}, {texture}, {radius}")
        np.testing.assert_allclose(measured / found.irradiance, albedo, rtol=0.01)  # equation 8 with its light
        scenes += 1
    assert scenes >= 6


@pytest.mark.parametrize(("radius", "converges"), [(0.3, True), (0.45, True), (0.52, False), (0.72, False)])
def test_the_plain_iteration_diverges_above_one_half(radius, converges):
    """From 1 % beside the answer: the error of the slowest mode grows by radius / (1 - radius) in each step."""
    albedo, direct, factors, measured = scene("open box", radius, "uniform", 0)
    guess = albedo * 1.01
    errors = []
    for _ in range(8):
        errors.append(np.abs(guess / albedo - 1).max())
        guess = guess * measured / (guess * radiosity.irradiance(guess, direct, factors))
    assert (errors[-1] < errors[0]) == converges
    damped = albedo * 1.01
    for _ in range(8):
        damped = damped * (measured / (damped * radiosity.irradiance(damped, direct, factors))) ** (1 - radius)
    assert np.abs(damped / albedo - 1).max() < 0.01 * max(radius, 0.5) ** 2


def test_gathered_form_is_exact_when_everything_is_seen():
    for radius in (0.3, 0.52, 0.75):
        albedo, direct, factors, measured = scene("closed box", radius, "uniform", 1)
        np.testing.assert_allclose(radiosity.gathered(measured, direct, factors), albedo, rtol=1e-12)
        found = radiosity.estimate(measured, direct, factors, np.eye(len(albedo)))
        assert found.method == "gathered"
        np.testing.assert_allclose(found.albedo, albedo, rtol=1e-12)
        np.testing.assert_allclose(found.irradiance * albedo, measured, rtol=1e-12)


@pytest.mark.parametrize("radius", [0.3, 0.6, 0.72])
def test_what_is_not_seen_takes_the_albedo_of_its_like(radius):
    """An open box, each face of one albedo, one face hidden by half: the damped iteration, and 1 %."""
    albedo, direct, factors, measured = scene("open box", radius, "uniform", 2)
    face = np.arange(len(albedo)) // (N * N)
    measured = measured.copy()
    measured[(face == 1) & (np.arange(len(albedo)) % 2 == 0)] = np.nan
    found = radiosity.estimate(measured, direct, factors, (face[:, None] == face[None]).astype(float))
    assert found.method == "damped"
    assert found.measured_share < 0.95
    np.testing.assert_allclose(found.albedo, albedo, rtol=0.01)


def test_given_albedo_is_kept_and_unlit_patches_are_unknown():
    albedo, direct, factors, measured = scene("open box", 0.5, "faces", 3)
    face = np.arange(len(albedo)) // (N * N)
    given = np.where((face == 4)[:, None], albedo, np.nan)
    measured = np.where((face == 4)[:, None], np.nan, measured)
    found = radiosity.estimate(measured, direct, factors, np.eye(len(albedo)), given)
    np.testing.assert_allclose(found.albedo, albedo, rtol=0.01)
    dark = radiosity.gathered(np.ones((2, 3)), np.zeros((2, 3)), np.zeros((2, 2)))
    assert np.isnan(dark).all()
