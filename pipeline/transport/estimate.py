"""From worlds and camera rays to pictures of what the objects are and change: region, passes, LS_noobj, denoiser.

A pilot on cells says where something changes, and where so smoothly that the pilot itself, interpolated, is the answer.
The rest is refined in passes until its noise is below half the photograph's. LS_noobj, which every change is held
against, is ``albedo * E / pi`` with one irradiance E in closed form on a plane (equation 7); where local surfaces see
each other or gloss, E is the path-traced radiance without objects over the albedo, smoothed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pipeline.transport.denoise import bounding_window, denoise
from pipeline.transport.difference import difference_block
from pipeline.transport.passes import Halves, refine
from pipeline.transport.region import CELL, Limits, Region, cell_pixels, plan
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import Rays, Samples, Strategy, centre_albedo, reference_block, trace, unchanged_block

STRATEGIES: dict[str, Strategy] = {"difference": difference_block, "reference": reference_block}
PILOT_SHARE = 4  # samples of a cell over samples of a pixel: a cell stands for 64 pixels
TRUSTED = 8  # samples per half from which their variance says something
LEAST_NOISE = 0.002  # of the radiance: quieter than this nobody asks for
STOP_RATIO = 0.5  # of the photograph's noise


@dataclass(frozen=True)
class Effort:
    """How much to spend: see the knobs of the render stage."""

    strategy: str = "difference"
    samples: int = 48
    depth: int = 6
    denoise: bool = True
    seed: int = 0
    adaptive: bool = True  # leave, interpolate, stop early; else every pixel takes all samples


@dataclass(frozen=True, eq=False)
class Canvas:
    """What is computed where. ``light``: irradiance E, (3,) or per pixel (H W, 3)."""

    worlds: Worlds
    rays: Rays  # of every pixel
    shape: tuple[int, int]
    region: Region
    light: np.ndarray
    target: np.ndarray  # (H, W, 3) noise that is quiet enough, relative to the radiance
    effort: Effort

    @property
    def traced(self) -> np.ndarray:
        """Flat index of the pixels that are sampled."""
        return np.flatnonzero(self.region.traced)

    def light_at(self, pixels: np.ndarray) -> np.ndarray:
        """(N, 3) or (3,) irradiance of the pixels."""
        return self.light if self.light.ndim == 1 else self.light[pixels]


Tell = Callable[[str], Callable[[float], None]]


def prepare(
    worlds: Worlds,
    rays: Rays,
    shape: tuple[int, int],
    light: np.ndarray,
    target: np.ndarray,
    limits: Limits,
    effort: Effort,
    tell: Tell = lambda what: lambda share: None,
) -> tuple[Canvas, dict[str, float]]:
    """The pilot, the region, and LS_noobj in it; and what is left out of the region, relative.

    Args:
        worlds: the scene.
        rays: one per pixel of the photograph, in rows.
        shape: (H, W).
        light: (3,) irradiance on the plane under the distant light alone.
        target: (H, W, 3) relative noise of the photograph.
        limits: of the region.
        effort: what to spend.
        tell: gives a progress callback for a named task.
    """
    index, grid = cell_pixels(*shape)
    samples = max(64, PILOT_SHARE * effort.samples)
    closed = worlds.convex and worlds.diffuse
    pilot = trace(
        difference_block, worlds, rays[index], samples, effort.depth, effort.seed + 1, CELL, tell("render: pilot")
    )
    cell_light = light if closed else received(worlds, rays[index], grid, samples, effort, CELL)
    region, left = plan(pilot, pilot.albedo * cell_light / np.pi, grid, shape, limits)
    if effort.strategy == "reference" or not effort.adaptive:
        region = replace(region, traced=region.weight > 0)
    canvas = Canvas(worlds, rays, shape, region, light, target, effort)
    return lit(canvas, worlds, light, tell), left


def lit(canvas: Canvas, worlds: Worlds, light: np.ndarray, tell: Tell = lambda what: lambda share: None) -> Canvas:
    """The same pixels in other worlds (one light group alone), with the irradiance E there.

    ``light`` (3,) is the irradiance on the plane under their distant light; it is all of E on a plane alone.
    """
    if not (worlds.convex and worlds.diffuse):
        # A picture around the region, for its smoothing.
        part = np.zeros(canvas.shape, bool)
        part[bounding_window(canvas.region.weight > 0)] = True
        inside, size = np.flatnonzero(part), (part.any(1).sum(), part.any(0).sum())
        light = np.zeros((part.size, 3))
        effort = canvas.effort
        light[inside] = received(
            worlds, canvas.rays[inside], size, effort.samples, effort, 1.0, tell("render: without")
        )
    return replace(canvas, worlds=worlds, light=light)


def received(
    worlds: Worlds,
    rays: Rays,
    shape: tuple[int, int],
    samples: int,
    effort: Effort,
    footprint_px: float,
    progress: Callable[[float], None] = lambda share: None,
) -> np.ndarray:
    """(H W, 3) irradiance that explains LS_noobj of a rectangle of pixels, path traced and smoothed."""
    from scipy.ndimage import distance_transform_edt

    traced = trace(unchanged_block, worlds, rays, samples, effort.depth + 1, effort.seed + 5, footprint_px, progress)
    known = (traced.albedo > 0).all(1).reshape(shape)
    if not known.any():
        return np.zeros((len(rays), 3))
    light = np.divide(traced.without * np.pi, traced.albedo, out=np.zeros_like(traced.albedo), where=traced.albedo > 0)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    image = light.reshape(*shape, 3)[tuple(nearest)]
    guide = traced.albedo.reshape(*shape, 3)[tuple(nearest)]
    return denoise(image, guide)[0].reshape(-1, 3).astype(float) if effort.denoise else image.reshape(-1, 3)


def sampled(
    canvas: Canvas, start: Halves | None = None, progress: Callable[[float], None] = lambda share: None
) -> Iterator[Halves]:
    """Passes over the traced pixels; see `pipeline.transport.passes.refine`."""
    effort, index = canvas.effort, canvas.traced
    strategy = STRATEGIES[effort.strategy]

    def noisy(halves: Halves) -> np.ndarray:
        return still_noisy(canvas, halves) if effort.adaptive else halves.open

    yield from refine(
        strategy,
        canvas.worlds,
        canvas.rays[index],
        effort.samples,
        effort.depth,
        effort.seed + 2,
        noisy,
        start,
        progress,
    )


def still_noisy(canvas: Canvas, halves: Halves) -> np.ndarray:
    """(N,) of the traced pixels: whether their tile's noise is above half the photograph's."""
    both = halves.both
    model = both.albedo * canvas.light_at(canvas.traced) / np.pi
    level = np.maximum(both.obj + model, 1e-12)
    variance = both.obj_variance + both.change_variance
    target = STOP_RATIO * np.maximum(canvas.target.reshape(-1, 3)[canvas.traced], LEAST_NOISE)
    excess = variance / (level * target) ** 2
    tiles = tile_means(excess.max(1), canvas.traced, canvas.shape)
    return (tiles > 1) | (halves.a.count < TRUSTED)


def tile_means(values: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(N,) mean over the pixels of the same `CELL` x `CELL` tile."""
    rows, columns = np.divmod(pixels, shape[1])
    tile = rows // CELL * (shape[1] // CELL + 1) + columns // CELL
    total, count = np.bincount(tile, values), np.bincount(tile)
    return (total / np.maximum(count, 1))[tile]


def pictures(canvas: Canvas, halves: Halves) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Every field as a picture (H, W, ...), zero where nothing was computed; and numbers of the denoiser."""
    smooth = np.flatnonzero(canvas.region.interpolated)
    samples = Samples.joined([interpolated(canvas, smooth), halves.both])
    pixels = np.concatenate([smooth, canvas.traced])
    variances = {"obj_variance": samples.obj_variance, "change_variance": samples.change_variance}
    if len(smooth):
        model = samples.albedo[: len(smooth)] * canvas.light_at(smooth) / np.pi
        variances["change_variance"][: len(smooth)] = canvas.region.variance.reshape(-1, 3)[smooth] * model**2
    images = {}
    for name, values in ({f.name: getattr(samples, f.name) for f in fields(Samples)} | variances).items():
        image = np.zeros((canvas.shape[0] * canvas.shape[1], *values.shape[1:]))
        image[pixels] = values
        images[name] = image.reshape(*canvas.shape, *values.shape[1:])
    light = canvas.light if canvas.light.ndim == 1 else canvas.light.reshape(*canvas.shape, 3)
    images["without"] = images["albedo"] * light / np.pi  # equation 7
    return quieted(images, canvas.region.traced) if canvas.effort.denoise else (images, {})


def interpolated(canvas: Canvas, pixels: np.ndarray) -> Samples:
    """The smooth part of the change as if it had been traced: relative change times LS_noobj of each pixel."""
    albedo = centre_albedo(canvas.worlds, canvas.rays[pixels])
    model = albedo * canvas.light_at(pixels) / np.pi
    lost, gained = (field.reshape(-1, 3)[pixels] * model for field in (canvas.region.lost, canvas.region.gained))
    return replace(Samples.none(len(pixels)), lost=lost, gained=gained, albedo=albedo, ground=np.ones(len(pixels)))


def quieted(images: dict[str, np.ndarray], traced: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Lost and gained light and the object layer, denoised; the pictures, and how much light was in speckles."""
    from scipy.ndimage import distance_transform_edt

    window = bounding_window(traced)
    view = {name: image[window] for name, image in images.items()}
    model, shown = view["without"], view["alpha"][..., None]
    bare = (model > 0).all(-1)
    # Below an object the ground's values continue, so that its outline is no edge of theirs.
    nearest = distance_transform_edt(~bare, return_distances=False, return_indices=True) if bare.any() else None

    def relative(part: np.ndarray) -> np.ndarray:
        ratio = np.divide(part, model, out=np.zeros_like(part), where=model > 0)
        return ratio if nearest is None else ratio[tuple(nearest)]

    guide = np.repeat(view["ground"][..., None], 3, -1)
    survives, _ = denoise(np.maximum(1 + relative(view["lost"]), 0), guide)
    added, moved = denoise(relative(view["gained"]), guide)
    obj, moved_obj = denoise(view["obj"], view["obj_albedo"], view["obj_normal"])
    result = {name: image.copy() for name, image in images.items() if name in ("lost", "gained", "obj")}
    here = traced[window][..., None]
    result["lost"][window] = np.where(here, np.minimum(survives - 1, 0) * model, view["lost"])
    result["gained"][window] = np.where(here, added * model, view["gained"])
    result["obj"][window] = np.where(shown > 0, obj, view["obj"])
    return images | result, {"speckle_light_moved_change": moved, "speckle_light_moved_object": moved_obj}
