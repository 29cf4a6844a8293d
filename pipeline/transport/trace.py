"""Rays through the photographed lens, and the reference strategy: two full path-traced images.

A camera sample that meets an object goes to the object layer (premultiplied); one that meets the local scene
contributes to LS_obj, LS_noobj and their difference, so coverage, object and difference come from the same samples
and edges are exact. Camera rays go through the inverse of the lens: neither plate nor layers are ever resampled. The
reference traces every sample in both worlds with the same random numbers; `pipeline.transport.difference` is the fast
strategy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from pipeline.transport.scene import Worlds

RAYS_PER_BLOCK = 1 << 21  # wavefront size: 30 floats per ray are kept until the samples of a pixel are summed
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

    What concerns the local scene is over the samples that meet it, divided by *all* samples of the pixel (so it carries
    the share of the pixel left to the local scene).
    """

    obj: np.ndarray  # (N, 3) object layer, premultiplied
    alpha: np.ndarray  # (N,)
    lost: np.ndarray  # (N, 3) light of LS_noobj that the objects take away, <= 0
    gained: np.ndarray  # (N, 3) light that the objects add
    without: np.ndarray  # (N, 3) LS_noobj
    albedo: np.ndarray  # (N, 3) albedo of the local scene where it is seen
    obj_albedo: np.ndarray  # (N, 3) base colour of the objects, premultiplied
    obj_normal: np.ndarray  # (N, 3) shading normal of the objects, world, premultiplied
    ground: np.ndarray  # (N,) share of samples that meet the local scene
    obj_variance: np.ndarray  # (N, 3)
    change_variance: np.ndarray  # (N, 3) of lost + gained
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

    def merged(self, index: np.ndarray, other: Samples, share: float) -> Samples:
        """Pixels ``index`` averaged with ``other``, which has weight ``share``; the rest as they are."""
        result = {}
        for field in fields(self):
            values = getattr(self, field.name)
            if field.name == "not_finite":
                continue
            own, theirs = ((1 - share) ** 2, share**2) if "variance" in field.name else (1 - share, share)
            result[field.name] = values.copy()
            result[field.name][index] = own * values[index] + theirs * getattr(other, field.name)
        return Samples(**result, not_finite=self.not_finite + other.not_finite)


class Strategy(Protocol):
    """Traces one block of pixels; see `reference_block` and `pipeline.transport.difference.difference_block`."""

    def __call__(self, worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
        """Samples of every pixel of ``rays``."""
        ...


def trace(
    strategy: Strategy,
    worlds: Worlds,
    rays: Rays,
    samples: int,
    depth: int,
    seed: int,
    footprint_px: float = 1.0,
    progress: Callable[[float], None] = lambda share: None,
) -> Samples:
    """Trace ``samples`` camera samples per pixel with paths of at most ``depth`` vertices.

    ``footprint_px`` is the side of the square over which camera rays are spread (1 = the pixel, box filter). The same
    seed gives the same bytes. Samples that are not finite count as zero and are counted.
    """
    pixels = max(1, RAYS_PER_BLOCK // samples)
    parts = []
    for start in range(0, len(rays), pixels):
        block = rays[start : start + pixels]
        parts.append(strategy(worlds, block, samples, depth, seed + 7919 * (start // pixels), footprint_px))
        progress(min(1.0, (start + pixels) / len(rays)))
    return Samples.joined(parts)


def camera_rays(mi: Any, dr: Any, rays: Rays, samples: int, jitter: Any, footprint_px: float) -> Any:
    """A ray per sample; ``jitter`` in [0, 1)^2 places it in the footprint."""
    pixel = dr.arange(mi.UInt32, len(rays) * samples) // samples
    offset = (jitter - 0.5) * footprint_px

    def fetch(rows: np.ndarray) -> Any:
        columns = [mi.Float(np.ascontiguousarray(rows[:, i], np.float32)) for i in range(3)]
        return mi.Vector3f(*[dr.gather(mi.Float, column, pixel) for column in columns])

    direction = fetch(rays.centre) + fetch(rays.by_x) * offset.x + fetch(rays.by_y) * offset.y
    return mi.RayDifferential3f(mi.Point3f(*[float(v) for v in rays.origin]), dr.normalize(direction))


def make_sampler(mi: Any, samples: int) -> Any:
    """Low-discrepancy points where there are enough samples for a grid of strata."""
    return mi.load_dict({"type": "multijitter" if samples >= 4 else "independent", "sample_count": samples})


def reference_block(worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
    """The reference strategy: LS_obj and LS_noobj path traced in full, with the same random numbers."""
    import drjit as dr

    mi = worlds.mi
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NEVER, "hide_emitters": True})
    sampler = make_sampler(mi, samples)
    count = sampler.sample_count()

    def radiance(scene: Any) -> tuple[Any, Any]:
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, len(rays) * count)
        ray = camera_rays(mi, dr, rays, count, sampler.next_2d(), footprint_px)
        return ray, integrator.sample(scene, sampler, ray)[0]

    ray, with_objects = radiance(worlds.with_objects)
    _, without_objects = radiance(worlds.without_objects)
    hit = worlds.with_objects.ray_intersect(ray)
    on_ground = hit.is_valid() & (hit.shape == mi.ShapePtr(worlds.ground_with))
    on_object = hit.is_valid() & ~on_ground
    finite = dr.all(dr.isfinite(with_objects)) & dr.all(dr.isfinite(without_objects))
    kept = on_ground & finite
    difference = dr.select(kept, with_objects - without_objects, mi.Color3f(0.0))
    return collect(
        mi,
        count,
        obj=dr.select(on_object & finite, with_objects, mi.Color3f(0.0)),
        lost=dr.minimum(difference, 0.0),
        gained=dr.maximum(difference, 0.0),
        without=dr.select(kept, without_objects, mi.Color3f(0.0)),
        albedo=dr.select(on_ground, worlds.ground_albedo.eval(hit, on_ground), mi.Color3f(0.0)),
        surface=object_surface(mi, hit, on_object),
        masks=(on_object, on_ground, finite),
    )


def object_surface(mi: Any, hit: Any, on_object: Any) -> tuple[Any, Any]:
    """Base colour and shading normal where an object is met, else zero: what a denoiser may lean on."""
    import drjit as dr

    base = hit.bsdf().eval_diffuse_reflectance(hit, on_object)
    return dr.select(on_object, base, mi.Color3f(0.0)), dr.select(on_object, hit.sh_frame.n, mi.Normal3f(0.0))


def collect(
    mi: Any,
    count: int,
    obj: Any,
    lost: Any,
    gained: Any,
    without: Any,
    albedo: Any,
    surface: tuple[Any, Any],
    masks: tuple[Any, Any, Any],
) -> Samples:
    """Sum the samples of each pixel. ``masks``: meets an object, meets the local scene, is finite."""
    import drjit as dr

    ones = [dr.select(mask, mi.Float(1.0), mi.Float(0.0)) for mask in (masks[0], masks[1], ~masks[2])]
    change = lost + gained
    triples = [obj, lost, gained, without, albedo, *surface, dr.square(obj), dr.square(change)]
    planes = [*(channel for triple in triples for channel in triple), *ones]
    planes = [mi.Float(plane) for plane in planes]
    dr.eval(planes)  # once, else each sum below would run the whole kernel again
    means = np.stack([np.asarray(dr.block_sum(plane, count)) for plane in planes]).astype(np.float64) / count
    names = ("obj", "lost", "gained", "without", "albedo", "obj_albedo", "obj_normal", "obj_square", "change_square")
    triple = {name: means[3 * i : 3 * i + 3].T for i, name in enumerate(names)}
    alpha, ground, not_finite = means[3 * len(names) :]
    spread = 1.0 / max(count - 1, 1)
    obj_square, change_square = triple.pop("obj_square"), triple.pop("change_square")
    mean_change = triple["lost"] + triple["gained"]
    return Samples(
        **triple,
        alpha=alpha,
        ground=ground,
        obj_variance=np.maximum(obj_square - triple["obj"] ** 2, 0) * spread,
        change_variance=np.maximum(change_square - mean_change**2, 0) * spread,
        not_finite=round(not_finite.sum() * count),
    )
