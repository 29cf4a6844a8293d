"""The light of a small lamp or the sun that the mirror ball throws onto the table, traced from the lamp.

A path from the camera meets such a lamp by way of the mirror by chance only: of a sun, one in a hundred thousand does.
Rays are started on the disc that the ball is from the lamp, mirrored once by the sphere, and counted where they meet
the table. What stands around is not in their way, and the light of large lamps is left to the path tracer.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.simulation.light import unit_direction
from pipeline.simulation.photograph import Measure
from pipeline.simulation.scene_file import LampFacts

CELL_M = 0.002
HALF_WIDTH_CELLS = 300
RAYS = 8_000_000
SMOOTHING_CELLS = 1.2


def thrown_irradiance(
    lamp: LampFacts, scale: float, centre: np.ndarray, radius: float, reflectance: Any, seed: int, rays: int = RAYS
) -> np.ndarray:
    """(N, N, 3) irradiance of the table y = 0 on cells of CELL_M, rows along z and columns along x about the ball.

    ``centre`` (3,) and ``radius`` of the ball, metres; radiance of the lamp in ACEScg times ``scale``.
    """
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng([seed, 9])
    half_angle = np.radians(lamp.diameter_deg / 2)
    to_lamp = unit_direction(lamp.azimuth_deg, lamp.elevation_deg)
    right = np.cross(to_lamp, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(right, to_lamp), to_lamp])
    spread = half_angle * np.sqrt(random.random(rays)), 2 * np.pi * random.random(rays)
    tilt = np.stack([spread[0] * np.cos(spread[1]), spread[0] * np.sin(spread[1])], -1)
    away = np.sqrt(random.random(rays)), 2 * np.pi * random.random(rays)
    start = np.stack([away[0] * np.cos(away[1]), away[0] * np.sin(away[1])], -1)
    # In the lamp's frame, unit sphere: where the ray meets it, and where it goes.
    normal = np.concatenate([start, np.sqrt(np.maximum(1 - (start**2).sum(1, keepdims=True), 0))], 1)
    into = np.concatenate([-tilt, -np.ones((rays, 1))], 1)
    into /= np.linalg.norm(into, axis=1, keepdims=True)
    out = (into - 2 * (into * normal).sum(1, keepdims=True) * normal) @ frame
    hit = centre + radius * normal @ frame
    down = out[:, 1] < -1e-6
    hit, out = hit[down], out[down]
    place = hit - out * (hit[:, 1] / out[:, 1])[:, None] - centre
    edges = (np.arange(2 * HALF_WIDTH_CELLS + 1) - HALF_WIDTH_CELLS) * CELL_M
    counts, _, _ = np.histogram2d(place[:, 2], place[:, 0], (edges, edges))
    flux = np.asarray(lamp.radiance) * scale * 2 * np.pi * (1 - np.cos(half_angle)) * np.pi * radius**2
    smooth = gaussian_filter(counts / rays / CELL_M**2, SMOOTHING_CELLS)
    return np.asarray(smooth[..., None] * flux * np.asarray(reflectance))


def seen_on_table(
    mi: Any, scene: Any, irradiance: np.ndarray, centre: np.ndarray, table: list[Any], ball: Any, reflectance: Any
) -> Measure:
    """Radiance that the table has of ``irradiance``, seen directly or once mirrored in the black ball: three values."""
    import drjit as dr

    size = len(irradiance) * CELL_M
    grid = mi.Texture2f(mi.TensorXf(irradiance.astype(np.float32)), wrap_mode=dr.WrapMode.Clamp)
    x0, z0 = (float(centre[i] - size / 2) for i in (0, 2))

    def measure(ray: Any, sampler: Any) -> list[Any]:
        first = scene.ray_intersect(ray)
        on_ball = first.is_valid() & (first.shape == mi.ShapePtr(ball))
        second = scene.ray_intersect(first.spawn_ray(first.to_world(mi.reflect(first.wi))), on_ball)
        value = mi.Color3f(0)
        for hit, active, share in ((first, ~on_ball, (1.0, 1.0, 1.0)), (second, on_ball, reflectance)):
            wanted = mi.Bool(False)
            for shape in table:
                wanted |= active & hit.is_valid() & (hit.shape == mi.ShapePtr(shape))
            place = mi.Point2f((hit.p.x - x0) / size, (hit.p.z - z0) / size)
            wanted &= (place.x > 0) & (place.x < 1) & (place.y > 0) & (place.y < 1)
            albedo = hit.bsdf().eval_diffuse_reflectance(hit, wanted)
            light = albedo * mi.Color3f(*grid.eval(place)) / dr.pi * mi.Color3f(*(float(r) for r in share))
            value += dr.select(wanted, light, 0)
        return [value.x, value.y, value.z]

    return measure
