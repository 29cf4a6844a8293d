"""Path tracing through the photographed lens: what the objects are, and what they change on the local scene.

Every camera sample is traced in both worlds with the same random numbers. A sample that meets an object goes to the
object layer (premultiplied); one that meets the local scene contributes to LS_obj, LS_noobj and their difference, so
coverage, object and difference come from the same samples and edges are exact. Camera rays go through the inverse of
the lens: neither plate nor layers are ever resampled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipeline.transport.scene import Worlds

RAYS_PER_BLOCK = 1 << 21  # wavefront size: 21 floats per ray are kept until the samples of a pixel are summed
NEVER = 1 << 20  # Russian roulette is left off: it adds noise to the difference of two paths


@dataclass(frozen=True, eq=False)
class Rays:
    """Camera rays of a set of pixels: origin (3,), and per pixel the centre's direction and its derivatives, world."""

    origin: np.ndarray  # (3,)
    centre: np.ndarray  # (N, 3) unnormalised direction of the pixel centre
    by_x: np.ndarray  # (N, 3) change per pixel to the right
    by_y: np.ndarray  # (N, 3) change per pixel down

    @classmethod
    def of(cls, world_from_camera: np.ndarray, xn: np.ndarray, dxn: np.ndarray) -> Rays:
        """From undistorted coordinates (N, 2) of pixel centres and their derivatives by the pixel (N, 2, 2)."""
        rotation = world_from_camera[:3, :3]
        return cls(
            world_from_camera[:3, 3],
            np.concatenate([xn, np.ones((len(xn), 1))], 1) @ rotation.T,
            dxn[:, :, 0] @ rotation[:, :2].T,
            dxn[:, :, 1] @ rotation[:, :2].T,
        )

    def __getitem__(self, index: Any) -> Rays:
        return Rays(self.origin, self.centre[index], self.by_x[index], self.by_y[index])

    def __len__(self) -> int:
        return len(self.centre)


@dataclass(frozen=True, eq=False)
class Samples:
    """Means over the samples of each pixel, and variances of those means. Radiance, ACEScg.

    ``ground*`` are over the samples that meet the local scene, divided by *all* samples of the pixel (so they carry
    the factor of coverage left to the local scene).
    """

    obj: np.ndarray  # (N, 3) object layer, premultiplied
    alpha: np.ndarray  # (N,)
    ground_with: np.ndarray  # (N, 3) LS_obj
    ground_without: np.ndarray  # (N, 3) LS_noobj
    difference: np.ndarray  # (N, 3) LS_obj - LS_noobj
    albedo: np.ndarray  # (N, 3) albedo of the local scene where it is seen
    ground: np.ndarray  # (N,) share of samples that meet the local scene
    obj_variance: np.ndarray  # (N, 3)
    difference_variance: np.ndarray  # (N, 3)
    not_finite: int = 0

    @classmethod
    def joined(cls, parts: list[Samples]) -> Samples:
        """Concatenate pixels."""
        arrays = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(cls)
            if field.name != "not_finite"
        }
        return cls(**arrays, not_finite=sum(part.not_finite for part in parts))


def trace(
    worlds: Worlds,
    rays: Rays,
    samples: int,
    depth: int,
    seed: int,
    footprint_px: float = 1.0,
    progress: Callable[[float], None] = lambda share: None,
) -> Samples:
    """Trace ``samples`` paths of at most ``depth`` vertices per pixel in both worlds.

    ``footprint_px`` is the side of the square over which camera rays are spread (1 = the pixel, box filter). The same
    seed gives the same bytes. Samples that are not finite count as zero and are counted.
    """
    pixels = max(1, RAYS_PER_BLOCK // samples)
    parts = []
    for start in range(0, len(rays), pixels):
        block = rays[start : start + pixels]
        parts.append(_trace_block(worlds, block, samples, depth, seed + 7919 * (start // pixels), footprint_px))
        progress(min(1.0, (start + pixels) / len(rays)))
    return Samples.joined(parts)


def _camera_rays(mi: Any, dr: Any, rays: Rays, samples: int, jitter: Any, footprint_px: float) -> Any:
    pixel = dr.arange(mi.UInt32, len(rays) * samples) // samples
    offset = (jitter - 0.5) * footprint_px

    def fetch(rows: np.ndarray) -> Any:
        return mi.Vector3f(
            *[dr.gather(mi.Float, mi.Float(np.ascontiguousarray(rows[:, i], np.float32)), pixel) for i in range(3)]
        )

    direction = fetch(rays.centre) + fetch(rays.by_x) * offset.x + fetch(rays.by_y) * offset.y
    return mi.RayDifferential3f(mi.Point3f(*[float(v) for v in rays.origin]), dr.normalize(direction))


def _trace_block(worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
    import drjit as dr

    mi = worlds.mi
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NEVER, "hide_emitters": True})
    # Low-discrepancy points need a rectangular grid of at least 2 x 2 strata.
    sampler = mi.load_dict({"type": "multijitter" if samples >= 4 else "independent", "sample_count": samples})
    count = sampler.sample_count()

    def radiance(scene: Any) -> tuple[Any, Any, Any]:
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, len(rays) * count)
        ray = _camera_rays(mi, dr, rays, count, sampler.next_2d(), footprint_px)
        color, valid, _ = integrator.sample(scene, sampler, ray)
        return ray, color, valid

    ray, with_objects, _ = radiance(worlds.with_objects)
    _, without_objects, _ = radiance(worlds.without_objects)
    hit = worlds.with_objects.ray_intersect(ray)
    on_ground = hit.is_valid() & (hit.shape == mi.ShapePtr(worlds.ground_with))
    on_object = hit.is_valid() & ~on_ground
    finite = dr.all(dr.isfinite(with_objects)) & dr.all(dr.isfinite(without_objects))
    zero = mi.Color3f(0.0)
    obj = dr.select(on_object & finite, with_objects, zero)
    kept = on_ground & finite
    ground_with = dr.select(kept, with_objects, zero)
    ground_without = dr.select(kept, without_objects, zero)
    difference = ground_with - ground_without
    albedo = dr.select(on_ground, worlds.ground_albedo.eval(hit, on_ground), zero)
    one = [dr.select(on_object, 1.0, 0.0), dr.select(on_ground, 1.0, 0.0), dr.select(finite, 0.0, 1.0)]
    planes = [*obj, *ground_with, *ground_without, *difference, *albedo, *dr.square(obj), *dr.square(difference), *one]
    planes = [mi.Float(plane) for plane in planes]
    dr.eval(planes)  # once, else each sum below would run the whole kernel again
    means = np.stack([np.asarray(dr.block_sum(plane, count)) for plane in planes]).astype(np.float64) / count
    return _collect(means, count)


def _collect(means: np.ndarray, count: int) -> Samples:
    triple = [means[3 * i : 3 * i + 3].T for i in range(7)]
    obj, ground_with, ground_without, difference, albedo, obj_square, difference_square = triple
    spread = 1.0 / max(count - 1, 1)
    return Samples(
        obj=obj,
        alpha=means[21],
        ground_with=ground_with,
        ground_without=ground_without,
        difference=difference,
        albedo=albedo,
        ground=means[22],
        obj_variance=np.maximum(obj_square - obj**2, 0) * spread,
        difference_variance=np.maximum(difference_square - difference**2, 0) * spread,
        not_finite=round(means[23].sum() * count),
    )
