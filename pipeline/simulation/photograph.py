"""Rays through the distorted lens, traced by Mitsuba, averaged over each pixel.

The film is a box per pixel; the lens' blur is applied afterwards to the whole picture. One wavefront holds whole pixels
with all samples of a pass, so sums are made in a fixed order: the same seed gives the same bits. Two scenes traced with
the same pixels, samples and seed share their random numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.simulation.lens import Lens

WAVEFRONT = 1 << 21  # rays at once

Shoot = Callable[[Any, Any], Any]  # pixel number, jitter in [0, 1)^2 -> ray
Measure = Callable[[Any, Any], list[Any]]  # ray, sampler -> values


def camera_rays(mi: Any, lens: Lens, world_from_camera: np.ndarray) -> Shoot:
    """Rays of the pixels, numbered row by row."""
    import drjit as dr

    pose = [[float(v) for v in row] for row in world_from_camera]

    def shoot(number: Any, jitter: Any) -> Any:
        row = number // lens.width
        x, y = lens.ideal_from_pixel(mi.Float(number - row * lens.width) + jitter.x, mi.Float(row) + jitter.y)
        direction = mi.Vector3f(*(pose[i][0] * x + pose[i][1] * y + pose[i][2] for i in range(3)))
        return mi.RayDifferential3f(mi.Point3f(*(pose[i][3] for i in range(3))), dr.normalize(direction))

    return shoot


def latlong_rays(mi: Any, centre: np.ndarray, width: int, height: int) -> Shoot:
    """Rays from a point through the texels of a lat-long map of conventions, numbered row by row."""
    import drjit as dr

    def shoot(number: Any, jitter: Any) -> Any:
        row = number // width
        phi = 2 * dr.pi * (mi.Float(number - row * width) + jitter.x) / width
        theta = dr.pi * (mi.Float(row) + jitter.y) / height
        direction = mi.Vector3f(dr.sin(theta) * dr.sin(phi), dr.cos(theta), -dr.sin(theta) * dr.cos(phi))
        return mi.RayDifferential3f(mi.Point3f(*(float(v) for v in centre)), direction)

    return shoot


def path_radiance(mi: Any, scene: Any, depth: int, brightest: float = np.inf) -> Measure:
    """Path-traced radiance along a ray: three values. Samples above ``brightest`` count nothing."""
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 5})

    def measure(ray: Any, sampler: Any) -> list[Any]:
        value, _, _ = integrator.sample(scene, sampler, ray)
        return dimmed(mi, value, brightest)

    return measure


def dimmed(mi: Any, value: Any, brightest: float) -> list[Any]:
    """Three values, nothing where one is above ``brightest``: such a sample met a small lamp by way of a mirror."""
    import drjit as dr

    if np.isfinite(brightest):
        value = dr.select(dr.max(value) > brightest, mi.Color3f(0), value)
    return [value.x, value.y, value.z]


def mirrored_radiance(
    mi: Any, scene: Any, depth: int, ball: Any, reflectance: tuple[float, ...], brightest: float = np.inf
) -> Measure:
    """Radiance of a scene with a black ball, seen directly or once mirrored in that ball: three values.

    What the ball throws onto its surroundings is missing. Samples above ``brightest`` count nothing.
    """
    import drjit as dr

    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 5})

    def measure(ray: Any, sampler: Any) -> list[Any]:
        hit = scene.ray_intersect(ray)
        on_ball = hit.is_valid() & (hit.shape == mi.ShapePtr(ball))
        mirrored = hit.spawn_ray(hit.to_world(mi.reflect(hit.wi)))
        origin, direction = dr.select(on_ball, mirrored.o, ray.o), dr.select(on_ball, mirrored.d, ray.d)
        value, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(origin, direction))
        value = dr.select(on_ball, value * mi.Color3f(*(float(r) for r in reflectance)), value)
        return dimmed(mi, value, brightest)

    return measure


def first_hit(mi: Any, scene: Any, shapes: list[Any]) -> Measure:
    """1 where the first hit is each of the shapes."""
    import drjit as dr

    def measure(ray: Any, sampler: Any) -> list[Any]:
        hit = scene.ray_intersect(ray)
        return [dr.select(hit.is_valid() & (hit.shape == mi.ShapePtr(s)), mi.Float(1), mi.Float(0)) for s in shapes]

    return measure


def surface_albedo(mi: Any, scene: Any, shapes: list[Any]) -> Measure:
    """Albedo of the first hit times whether it is one of the shapes, and whether it is: four values."""
    import drjit as dr

    def measure(ray: Any, sampler: Any) -> list[Any]:
        hit = scene.ray_intersect(ray)
        wanted = mi.Bool(False)
        for shape in shapes:
            wanted |= hit.is_valid() & (hit.shape == mi.ShapePtr(shape))
        albedo = dr.select(wanted, hit.bsdf().eval_diffuse_reflectance(hit, wanted), 0)
        return [albedo.x, albedo.y, albedo.z, dr.select(wanted, mi.Float(1), mi.Float(0))]

    return measure


def trace(mi: Any, shoot: Shoot, measure: Measure, pixels: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """Mean (N, K) float32 of a measurement over the numbered pixels (N,), ``samples`` stratified samples each."""
    import drjit as dr

    parts = []
    step = max(1, WAVEFRONT // samples)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    samples = sampler.sample_count()
    for chunk, start in enumerate(range(0, len(pixels), step)):
        some = mi.UInt32(pixels[start : start + step].astype(np.uint32))
        size = dr.width(some) * samples
        sampler.set_samples_per_wavefront(samples)
        sampler.seed(dr.opaque(mi.UInt32, seed * 1009 + chunk), size)
        number = dr.gather(mi.UInt32, some, dr.arange(mi.UInt32, size) // samples)
        values = measure(shoot(number, sampler.next_2d()), sampler)
        dr.eval(*values)
        parts.append(np.stack([np.array(dr.block_sum(value, samples)) for value in values], -1) / samples)
    return np.concatenate(parts).astype(np.float32)


def picture(
    mi: Any, shoot: Shoot, measure: Measure, shape: tuple[int, int], samples: int, pass_samples: int, seed: int
) -> np.ndarray:
    """(H, W, K) float32 mean of as many passes as the samples need."""
    pixels = np.arange(shape[0] * shape[1])
    passes = max(1, round(samples / pass_samples))
    total = np.zeros(1)
    for number in range(passes):
        total = total + trace(mi, shoot, measure, pixels, min(samples, pass_samples), seed + number)
    return (total / passes).reshape(*shape, -1).astype(np.float32)
