"""Rays through the photographed lens, and the reference strategy: two full path-traced images.

A camera sample that meets an object goes to the object layer (premultiplied); one that meets the local scene
contributes to LS_obj, LS_noobj and their difference, so coverage, object and difference come from the same samples
and edges are exact. Camera rays go through the inverse of the lens: neither plate nor layers are ever resampled. The
reference traces every sample in both worlds with the same random numbers; `pipeline.transport.difference` is the fast
strategy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from pipeline.camera.lens import rays_through
from pipeline.transport.scene import Worlds
from pipeline.transport.variant import kernel_input
from pipeline.types import Camera

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
        right, down, forward = world_from_camera[:3, :3].T

        def turned(x: np.ndarray, y: np.ndarray) -> np.ndarray:  # a matrix product this thin takes five times as long
            return np.asarray(x[:, None] * right + y[:, None] * down)

        return cls(
            world_from_camera[:3, 3],
            turned(xn[:, 0], xn[:, 1]) + forward,
            turned(dxn[:, 0, 0], dxn[:, 1, 0]),
            turned(dxn[:, 0, 1], dxn[:, 1, 1]),
        )

    def __getitem__(self, index: Any) -> Rays:
        return Rays(self.origin, self.centre[index], self.by_x[index], self.by_y[index])

    def __len__(self) -> int:
        return len(self.centre)

    def strata(self, side_px: float, along: int) -> Rays:
        """Through the middles of ``along`` x ``along`` parts of each square of ``side_px``, square after square."""
        step = (np.arange(along) - (along - 1) / 2) * side_px / along
        down, right = (axis.ravel()[None, :, None] for axis in np.meshgrid(step, step, indexing="ij"))
        centre = self.centre[:, None] + right * self.by_x[:, None] + down * self.by_y[:, None]
        each = along * along
        return Rays(self.origin, centre.reshape(-1, 3), np.repeat(self.by_x, each, 0), np.repeat(self.by_y, each, 0))

    def solid_angles(self) -> np.ndarray:
        """(N,) of the pixels [sr]."""
        area = np.abs((np.cross(self.by_x, self.by_y) * self.centre).sum(1))
        return area / np.linalg.norm(self.centre, axis=1) ** 3


@dataclass(frozen=True, eq=False)
class LensRays:
    """The rays of a whole photograph, each made when it is asked for: of 24 million pixels few are traced."""

    camera: Camera
    world_from_camera: np.ndarray  # (4, 4)

    def __getitem__(self, index: np.ndarray) -> Rays:
        """Of the pixels with these flat indices (N,)."""
        row, column = np.divmod(index, self.camera.width)
        xn, dxn = rays_through(self.camera, np.stack([column, row], -1) + 0.5)
        return Rays.of(self.world_from_camera, xn, dxn)

    def __len__(self) -> int:
        return self.camera.width * self.camera.height


@dataclass(frozen=True, eq=False)
class Samples:
    """Means over the samples of each pixel, of values and of their squares. Radiance, ACEScg.

    What concerns the local scene is over the samples that meet it, divided by *all* samples of the pixel (so it carries
    the share of the pixel left to the local scene).
    """

    count: np.ndarray  # (N,) samples of the pixel
    obj: np.ndarray  # (N, 3) object layer, premultiplied
    alpha: np.ndarray  # (N,)
    lost: np.ndarray  # (N, 3) light of LS_noobj that the objects take away, <= 0
    gained: np.ndarray  # (N, 3) light that the objects add
    without: np.ndarray  # (N, 3) LS_noobj
    albedo: np.ndarray  # (N, 3) albedo of the local scene where it is seen
    obj_albedo: np.ndarray  # (N, 3) base colour of the objects, premultiplied
    obj_normal: np.ndarray  # (N, 3) shading normal of the objects, world, premultiplied
    ground: np.ndarray  # (N,) share of samples that meet the local scene
    obj_square: np.ndarray  # (N, 3)
    change_square: np.ndarray  # (N, 3) of lost + gained
    not_finite: np.ndarray  # (N,) share of samples that were not finite and count as zero

    @classmethod
    def none(cls, pixels: int) -> Samples:
        """No sample yet of any of ``pixels``."""
        flat = ("count", "alpha", "ground", "not_finite")
        return cls(**{f.name: np.zeros(pixels if f.name in flat else (pixels, 3)) for f in fields(cls)})

    @classmethod
    def joined(cls, parts: list[Samples]) -> Samples:
        """Concatenate pixels."""
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    @property
    def obj_variance(self) -> np.ndarray:
        """(N, 3) of the mean `obj`; strata make the true one smaller."""
        return self._variance(self.obj_square, self.obj)

    @property
    def change_variance(self) -> np.ndarray:
        """(N, 3) of the mean `lost + gained`."""
        return self._variance(self.change_square, self.lost + self.gained)

    def _variance(self, square: np.ndarray, mean: np.ndarray) -> np.ndarray:
        return np.maximum(square - mean**2, 0) / np.maximum(self.count - 1, 1)[:, None]

    def __getitem__(self, index: Any) -> Samples:
        return Samples(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def __add__(self, other: Samples) -> Samples:
        """More samples of the same pixels: blocks that were computed apart, as if they had been one."""
        count = self.count + other.count
        own = np.divide(self.count, count, out=np.zeros_like(count), where=count > 0)
        blended = {"count": count}
        for name in (f.name for f in fields(self) if f.name != "count"):
            a, b = getattr(self, name), getattr(other, name)
            share = own if a.ndim == 1 else own[:, None]
            blended[name] = a * share + b * (1 - share)
        return Samples(**blended)

    def lit(self, light: np.ndarray, variance: np.ndarray) -> Samples:
        """With light (2, N, 3) that was traced from emitters to the local scene and to objects, and its variance.

        It knows nothing of the paths from the camera: variances of the means add.
        """
        free = np.maximum(self.count - 1, 1)[:, None]
        change, gained, obj = self.lost + self.gained, self.gained + light[0], self.obj + light[1]
        change_square = self.change_square + (change + light[0]) ** 2 - change**2 + free * variance[0]
        obj_square = self.obj_square + obj**2 - self.obj**2 + free * variance[1]
        return replace(self, gained=gained, obj=obj, change_square=change_square, obj_square=obj_square)

    def gathered(self, each: int) -> Samples:
        """Every ``each`` pixels, of as many samples, as if they were one."""
        whole = {f.name: getattr(self, f.name) for f in fields(self)}
        means = {n: v.reshape(len(v) // each, each, *v.shape[1:]).mean(1) for n, v in whole.items()}
        return Samples(**{**means, "count": means["count"] * each})

    def placed(self, index: np.ndarray, more: Samples) -> Samples:
        """``more`` samples of the pixels ``index`` added to those; the rest as they are."""
        return self.replaced(index, self[index] + more)

    def replaced(self, index: np.ndarray, grown: Samples) -> Samples:
        """Other samples of the pixels ``index``; the rest as they are."""
        result = {}
        for f in fields(self):
            result[f.name] = getattr(self, f.name).copy()
            result[f.name][index] = getattr(grown, f.name)
        return Samples(**result)


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
    seed gives the same bytes. Samples that are not finite count as zero and are counted. Blocks may be traced apart, in
    any order, and put together with `Samples.joined` (pixels) and ``+`` (samples, of different seeds).
    """
    pixels = max(1, RAYS_PER_BLOCK // samples)
    parts = []
    for start in range(0, len(rays), pixels):
        block = rays[start : start + pixels]
        parts.append(strategy(worlds, block, samples, depth, seed + 7919 * (start // pixels), footprint_px))
        progress(min(1.0, (start + pixels) / len(rays)))
    return parts[0] if len(parts) == 1 else Samples.joined(parts)


def camera_rays(mi: Any, dr: Any, rays: Rays, samples: int, jitter: Any, footprint_px: float) -> Any:
    """A ray per sample; ``jitter`` in [0, 1)^2 places it in the footprint."""
    pixel = dr.arange(mi.UInt32, len(rays) * samples) // samples
    offset = (jitter - 0.5) * kernel_input(mi, footprint_px)

    def fetch(rows: np.ndarray) -> Any:
        columns = [mi.Float(np.ascontiguousarray(rows[:, i], np.float32)) for i in range(3)]
        return mi.Vector3f(*[dr.gather(mi.Float, column, pixel) for column in columns])

    direction = fetch(rays.centre) + fetch(rays.by_x) * offset.x + fetch(rays.by_y) * offset.y
    return mi.RayDifferential3f(mi.Point3f(*[kernel_input(mi, v) for v in rays.origin]), dr.normalize(direction))


def make_sampler(mi: Any, samples: int) -> Any:
    """Low-discrepancy points where there are enough samples for a grid of strata."""
    return mi.load_dict({"type": "multijitter" if samples >= 4 else "independent", "sample_count": samples})


def camera_hits(worlds: Worlds, rays: Rays, samples: int, jitter: Any, footprint_px: float) -> tuple[Any, ...]:
    """Camera rays, what they meet, and whether that is an object or the local scene; neither behind an occluder."""
    import drjit as dr

    mi = worlds.mi
    ray = camera_rays(mi, dr, rays, samples, jitter, footprint_px)
    hit = worlds.with_objects.ray_intersect(ray)
    seen = hit.is_valid()
    if worlds.occluders is not None:
        towards = mi.Ray3f(ray.o, ray.d, hit.t, ray.time, ray.wavelengths)
        seen &= ~worlds.occluders.ray_test(towards, seen)
    local = worlds.is_local(hit)
    return ray, hit, seen & ~local, seen & local


def require_own_light(worlds: Worlds) -> None:
    """Raise ValueError for worlds of `pipeline.transport.scene.relit`, whose scenes hold another light."""
    if not worlds.own_light:
        raise ValueError("worlds: their scenes hold another light than their groups; build them under this light")


def reference_block(
    worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float, roulette: int = NEVER
) -> Samples:
    """The reference strategy: LS_obj and LS_noobj path traced in full, with the same random numbers.

    From the vertex number ``roulette`` on paths end by chance: cheaper, noisier, as unbiased.
    """
    import drjit as dr

    require_own_light(worlds)
    mi = worlds.mi
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": roulette})
    sampler = make_sampler(mi, samples)
    count = sampler.sample_count()

    def radiance(scene: Any) -> tuple[Any, ...]:
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, len(rays) * count)
        ray, *met = camera_hits(worlds, rays, count, sampler.next_2d(), footprint_px)
        return integrator.sample(scene, sampler, ray)[0], *met

    with_objects, hit, on_object, on_local = radiance(worlds.with_objects)
    without_objects = radiance(worlds.without_objects)[0]
    finite = dr.all(dr.isfinite(with_objects)) & dr.all(dr.isfinite(without_objects))
    kept = on_local & finite
    difference = dr.select(kept, with_objects - without_objects, mi.Color3f(0.0))
    return collect(
        mi,
        count,
        obj=dr.select(on_object & finite, with_objects, mi.Color3f(0.0)),
        lost=dr.minimum(difference, 0.0),
        gained=dr.maximum(difference, 0.0),
        without=dr.select(kept, without_objects, mi.Color3f(0.0)),
        hit=hit,
        masks=(on_object, on_local, finite),
    )


def unchanged_block(worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
    """LS_noobj alone, path traced, where no object hides the local scene: for scenes without a closed form."""
    import drjit as dr

    require_own_light(worlds)
    mi = worlds.mi
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NEVER})
    sampler = make_sampler(mi, samples)
    count = sampler.sample_count()
    sampler.set_samples_per_wavefront(count)
    sampler.seed(seed, len(rays) * count)
    ray, hit, on_object, on_local = camera_hits(worlds, rays, count, sampler.next_2d(), footprint_px)
    radiance, _, _ = integrator.sample(worlds.without_objects, sampler, ray, active=on_local)
    finite = dr.all(dr.isfinite(radiance))
    zero = mi.Color3f(0.0) + 0 * radiance
    without = dr.select(on_local & finite, radiance, mi.Color3f(0.0))
    return collect(mi, count, zero, zero, zero, without, hit, (on_object, on_local, finite))


def centre_albedo(worlds: Worlds, rays: Rays) -> np.ndarray:
    """(N, 3) albedo of the local scene where the middle of each pixel meets it, zero where it does not."""
    import drjit as dr

    if not len(rays):
        return np.zeros((0, 3))
    mi = worlds.mi
    centre = mi.Point2f(0.5) + dr.zeros(mi.Point2f, len(rays))
    _, hit, _, on_local = camera_hits(worlds, rays, 1, centre, 0.0)
    albedo = hit.bsdf().eval_diffuse_reflectance(hit, on_local)
    return np.asarray(dr.select(on_local, albedo, mi.Color3f(0.0))).T.astype(float)


def seen_points(worlds: Worlds, rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points (N, 3) that the middles of pixels meet, and whether each lies on an object, on the local scene."""
    import drjit as dr

    mi = worlds.mi
    centre = mi.Point2f(0.5) + dr.zeros(mi.Point2f, len(rays))
    _, hit, on_object, on_local = camera_hits(worlds, rays, 1, centre, 0.0)
    return np.asarray(hit.p).T.astype(float), np.asarray(on_object, bool), np.asarray(on_local, bool)


def collect(
    mi: Any, count: int, obj: Any, lost: Any, gained: Any, without: Any, hit: Any, masks: tuple[Any, Any, Any]
) -> Samples:
    """Sum the samples of each pixel. ``masks``: meets an object, meets the local scene, is finite.

    The surface that is seen gives its base colour (and an object its shading normal) as well: what divides LS_noobj by
    the light, and what a denoiser may lean on.
    """
    import drjit as dr

    on_object, on_local, finite = masks
    base = hit.bsdf().eval_diffuse_reflectance(hit, on_object | on_local)
    zero = mi.Color3f(0.0)
    triples = [
        obj,
        lost,
        gained,
        without,
        dr.select(on_local, base, zero),
        dr.select(on_object, base, zero),
        dr.select(on_object, mi.Color3f(hit.sh_frame.n), zero),
        dr.square(obj),
        dr.square(lost + gained),
    ]
    ones = [dr.select(mask, mi.Float(1.0), mi.Float(0.0)) for mask in (on_object, on_local, ~finite)]
    planes = [mi.Float(plane) for plane in [*(channel for triple in triples for channel in triple), *ones]]
    dr.eval(planes)  # once, else each sum below would run the whole kernel again
    sums = [np.asarray(dr.block_sum(plane, count)) for plane in planes]
    names = ("obj", "lost", "gained", "without", "albedo", "obj_albedo", "obj_normal", "obj_square", "change_square")
    means = {name: np.empty((len(sums[0]), 3)) for name in names}
    for number, values in enumerate(sums[: 3 * len(names)]):
        np.divide(values, count, out=means[names[number // 3]][:, number % 3], dtype=np.float64)
    alpha, ground, not_finite = (values.astype(np.float64) / count for values in sums[3 * len(names) :])
    counts = np.full(len(alpha), float(count))
    return Samples(**means, count=counts, alpha=alpha, ground=ground, not_finite=not_finite)
