"""From worlds and camera rays to pictures of what the objects are and change: region, passes, LS_noobj, denoiser.

A pilot on cells says where something changes, and where so smoothly that the pilot itself, interpolated, is the answer.
The rest is refined in passes until its noise is below half the photograph's. LS_noobj, which every change is held
against, is ``albedo * E / pi`` with one irradiance E in closed form on a plane (equation 7); where local surfaces see
each other or gloss, E is the path-traced radiance without objects over the albedo, smoothed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.transport.caustics import Film, photons_for, thrown, throws
from pipeline.transport.denoise import (
    TILE,
    Half,
    QuietChange,
    bounding_window,
    continued,
    denoise,
    glimpsed,
    needs_more,
    quieted,
    tile_means,
)
from pipeline.transport.difference import difference_block
from pipeline.transport.passes import Halves, refine
from pipeline.transport.region import CELL, Limits, Region, cell_pixels, plan
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import Rays, Samples, Strategy, centre_albedo, reference_block, trace, unchanged_block

STRATEGIES: dict[str, Strategy] = {"difference": difference_block, "reference": reference_block}
PILOT_SHARE = 8  # samples of a cell over samples of a pixel: a cell stands for 64 pixels
MOST_PILOT = 512
TRUSTED = 16  # samples of a pixel and half from which noise is judged
JUDGE_SAMPLES = 10  # samples per pixel that cost about four times as much as judging its noise
PILOT_PHOTONS = 2  # samples' worth
PILOT_PIXELS = 1 << 20  # most pixels whose worth of photons a pilot takes
WORTH_TRACING = 0.02  # of the added light: less of it in caustics is left to paths from the camera
JUDGED = (
    "obj", "lost", "gained", "albedo", "alpha", "obj_albedo", "obj_normal", "obj_variance", "change_variance",
)  # fmt: skip


@dataclass(frozen=True)
class Effort:
    """How much to spend: see the knobs of the render stage."""

    strategy: str = "difference"
    samples: int = 48
    depth: int = 6
    denoise: bool = True
    seed: int = 0
    adaptive: bool = True  # leave, interpolate, stop early; else every pixel takes all samples

    @property
    def stream(self) -> int:
        """Where this seed's random numbers begin: far from the next seed's, which its passes count up to."""
        return 100_003 * self.seed % 2**31


@dataclass(frozen=True, eq=False)
class Canvas:
    """What is computed where. ``light``: irradiance E, (3,) or per pixel (H W, 3)."""

    worlds: Worlds
    rays: Rays  # of every pixel
    shape: tuple[int, int]
    region: Region
    light: np.ndarray
    plate_sigma: np.ndarray  # (H, W) noise of the photograph, radiance; not finite where unknown
    white: float  # radiance of display white
    effort: Effort
    film: Film | None = None  # where light tracing is worth its cost

    @property
    def traced(self) -> np.ndarray:
        """Flat index of the pixels that are sampled."""
        return np.flatnonzero(self.region.traced)

    @functools.cached_property
    def smooth_albedo(self) -> np.ndarray:
        """(H, W, 3) albedo where the change is interpolated, at the middle of the pixel; zero elsewhere."""
        pixels = np.flatnonzero(self.region.interpolated)
        image = np.zeros((self.region.traced.size, 3))
        image[pixels] = centre_albedo(self.worlds, self.rays[pixels])
        return image.reshape(*self.shape, 3)

    def light_at(self, pixels: np.ndarray) -> np.ndarray:
        """(N, 3) or (3,) irradiance of the pixels."""
        return self.light if self.light.ndim == 1 else self.light[pixels]


Tell = Callable[[str], Callable[[float], None]]


def prepare(
    worlds: Worlds,
    rays: Rays,
    shape: tuple[int, int],
    light: np.ndarray,
    plate_sigma: np.ndarray,
    white: float,
    limits: Limits,
    effort: Effort,
    film: Film | None = None,
    tell: Tell = lambda what: lambda share: None,
) -> tuple[Canvas, dict[str, float]]:
    """The pilot, the region, and LS_noobj in it; and what is left out of the region, relative.

    Args:
        worlds: the scene.
        rays: one per pixel of the photograph, in rows.
        shape: (H, W).
        light: (3,) irradiance on the plane under the distant light alone.
        plate_sigma: (H, W) noise of the photograph, radiance; not finite where unknown.
        white: radiance of display white.
        limits: of the region.
        effort: what to spend.
        film: the photograph's lens, for light tracing; None to leave all light to paths from the camera.
        tell: gives a progress callback for a named task.
    """
    index, grid = cell_pixels(*shape)
    samples = min(max(64, PILOT_SHARE * effort.samples), MOST_PILOT)
    closed = worlds.convex and worlds.diffuse
    film = film if effort.strategy == "difference" and throws(worlds) else None
    if film is not None:
        worlds = replace(worlds, photons=photons_for(worlds, min(shape[0] * shape[1], PILOT_PIXELS)))
    pilot = trace(
        difference_block, worlds, rays[index], samples, effort.depth, effort.stream + 1, CELL, tell("render: pilot")
    )
    share = 0.0
    if film is not None:
        light_by_cell = cells_of(thrown(worlds, film, PILOT_PHOTONS, effort.stream + 1)[0])
        share = float(light_by_cell.sum() / max((pilot.gained + light_by_cell).sum(), 1e-30))
        pilot = replace(pilot, gained=pilot.gained + light_by_cell)
        if share < WORTH_TRACING:
            film, worlds = None, replace(worlds, photons=0.0)
    cell_light = light if closed else received(worlds, rays[index], grid, samples, effort, CELL)
    region, left = plan(pilot, pilot.albedo * cell_light / np.pi, grid, shape, limits)
    if effort.strategy == "reference" or not effort.adaptive:
        region = replace(region, traced=region.weight > 0)
    if film is not None:
        worlds = replace(worlds, photons=photons_for(worlds, int(region.traced.sum())))
    canvas = Canvas(worlds, rays, shape, region, light, plate_sigma, white, effort, film)
    return lit(canvas, worlds, light, tell), left | {"light_traced_share": share}


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
    return replace(canvas, worlds=replace(worlds, photons=canvas.worlds.photons), light=light)


def cells_of(picture: np.ndarray) -> np.ndarray:
    """(cells, 3) means of a picture (H, W, 3) over the region's cells."""
    return np.stack([tile_means(picture[..., channel]).ravel() for channel in range(3)], -1)


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
    traced = trace(
        unchanged_block, worlds, rays, samples, effort.depth + 1, effort.stream + 90_001, footprint_px, progress
    )
    known = np.asarray((traced.albedo > 0).all(1)).reshape(shape)
    if not known.any():
        return np.zeros((len(rays), 3))
    light = np.divide(traced.without * np.pi, traced.albedo, out=np.zeros_like(traced.albedo), where=traced.albedo > 0)
    image, guide = (continued(part.reshape(*shape, 3), known) for part in (light, traced.albedo))
    return denoise(image, guide)[0].reshape(-1, 3) if effort.denoise else image.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Shot:
    """What there is after a pass; the pictures are made when somebody looks."""

    canvas: Canvas
    halves: Halves

    @functools.cached_property
    def drawn(self) -> tuple[dict[str, np.ndarray], QuietChange | None]:
        """See `pictures`."""
        return pictures(self.canvas, self.halves)


def sampled(
    canvas: Canvas, start: Halves | None = None, progress: Callable[[float], None] = lambda share: None
) -> Iterator[Shot]:
    """Passes over the traced pixels; see `pipeline.transport.passes.refine`."""
    effort = canvas.effort

    def noisy(halves: Halves, ahead: int) -> np.ndarray:
        return still_noisy(canvas, halves, ahead) if effort.adaptive else halves.open

    def light(samples: int, seed: int) -> np.ndarray:
        assert canvas.film is not None
        return thrown(canvas.worlds, canvas.film, samples, seed).reshape(2, -1, 3)[:, canvas.traced]

    rays, worlds, seed = canvas.rays[canvas.traced], canvas.worlds, effort.stream + 2
    strategy, traced_light = STRATEGIES[effort.strategy], light if canvas.film is not None else None
    for halves in refine(
        strategy, worlds, rays, effort.samples, effort.depth, seed, noisy, traced_light, start, progress
    ):
        yield Shot(canvas, halves)


def still_noisy(canvas: Canvas, halves: Halves, ahead: int) -> np.ndarray:
    """(N,) of the open pixels: whether the picture is noisier there than half of what the photograph hides.

    Asked only where the samples still to come (``ahead``, of all pixels and one half) cost several times the answer.
    """
    window = bounding_window(scattered(canvas, halves.open) > 0)
    area = np.zeros(canvas.shape)[window].size
    if halves.a.count.max() < TRUSTED or ahead < JUDGE_SAMPLES * area:
        return halves.open
    images = planes_of(canvas, halves.both, JUDGED, window)
    composite = (images["obj"] + images["without"] + images["lost"] + images["gained"]).mean(-1)
    if canvas.effort.denoise:
        noise = quieted(*halves_in(canvas, halves, images, window)).noise(tile_means(images["without"].mean(-1)))
    else:
        noise = np.sqrt(tile_means((images["obj_variance"] + images["change_variance"]).mean(-1)))
    more = needs_more(noise, canvas.plate_sigma[window], tile_means(composite), canvas.white)
    wanted = np.zeros(canvas.shape, bool)
    inside = wanted[window]
    inside[:] = np.repeat(np.repeat(more, TILE, 0), TILE, 1)[: inside.shape[0], : inside.shape[1]]
    return wanted.ravel()[canvas.traced]


def scattered(canvas: Canvas, values: np.ndarray) -> np.ndarray:
    """Values (N, ...) of the traced pixels as a picture (H, W, ...), zero elsewhere."""
    image = np.zeros((canvas.shape[0] * canvas.shape[1], *values.shape[1:]), np.float32)
    image[canvas.traced] = values
    return image.reshape(*canvas.shape, *values.shape[1:])


def planes_of(
    canvas: Canvas, samples: Samples, names: tuple[str, ...], window: tuple[slice, slice]
) -> dict[str, np.ndarray]:
    """The named fields as pictures of a window, and LS_noobj; the smooth part of the change is filled in."""
    images = {name: scattered(canvas, getattr(samples, name))[window] for name in names}
    gap = canvas.region.interpolated[window]
    images["albedo"][gap] = canvas.smooth_albedo[window][gap]
    light = canvas.light if canvas.light.ndim == 1 else canvas.light.reshape(*canvas.shape, 3)[window]
    images["without"] = model = images["albedo"] * light / np.pi  # equation 7
    region = canvas.region
    fill = {
        "lost": (region.lost, model),
        "gained": (region.gained, model),
        "change_variance": (region.variance, model**2),
    }
    for name, (relative, scale) in fill.items():
        if name in images:
            images[name][gap] = relative[window][gap] * scale[gap]
    if "ground" in images:
        images["ground"][gap] = 1.0
    return images


def halves_in(
    canvas: Canvas, halves: Halves, images: dict[str, np.ndarray], window: tuple[slice, slice]
) -> tuple[Half, Half, np.ndarray, np.ndarray, np.ndarray, float]:
    """What the denoiser wants to know of a window; ``images`` holds both halves' alpha and guides there."""
    parts = []
    for samples in (halves.a, halves.b):
        part = planes_of(canvas, samples, ("lost", "gained", "albedo", "obj"), window)
        parts.append(Half(part["lost"], part["gained"], part["without"], part["obj"]))
    return parts[0], parts[1], images["alpha"], images["obj_albedo"], images["obj_normal"], canvas.white


def pictures(canvas: Canvas, halves: Halves) -> tuple[dict[str, np.ndarray], QuietChange | None]:
    """Every field as a picture (H, W, ...), zero where nothing was computed; and what the denoiser says of its work.

    It says nothing of fewer than `TRUSTED` samples.
    """
    images = planes_of(canvas, halves.both, (*JUDGED, "ground"), (slice(None), slice(None)))
    if not canvas.effort.denoise:
        return images, None
    window = bounding_window(canvas.region.traced)
    view = {name: image[window] for name, image in images.items()}
    given = halves_in(canvas, halves, view, window)
    quiet = None if halves.a.count.max() < TRUSTED else quieted(*given)
    if quiet is None:
        survives, added, obj = glimpsed(*given, fast=halves.passes == 1)
    else:
        survives, added, obj = quiet.survives.rgb, quiet.added.rgb, quiet.obj.rgb
    here, model = canvas.region.traced[window][..., None], view["without"]
    ground, shown = here & (model > 0), here & (view["alpha"][..., None] > 0)
    view["lost"][:] = np.where(ground, np.minimum(survives - 1, 0) * model, view["lost"])
    view["gained"][:] = np.where(ground, added * model, view["gained"])
    view["obj"][:] = np.where(shown, obj, view["obj"])
    return images, quiet
