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
from typing import Protocol

import numpy as np

from pipeline.image.blank import blank
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
from pipeline.transport.region import (
    BLUR_NOISE,
    CELL,
    GLANCE,
    WHOLE,
    Limits,
    Region,
    Window,
    cell_pixels,
    in_pixels,
    near_objects,
    of_cells,
    plan,
    worth_a_look,
)
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import (
    LensRays,
    Rays,
    Samples,
    Strategy,
    centre_albedo,
    reference_block,
    trace,
    unchanged_block,
)

STRATEGIES: dict[str, Strategy] = {"difference": difference_block, "reference": reference_block}
PILOT_SHARE = 8  # samples of a cell over samples of a pixel: a cell stands for 64 pixels
FIRST_PILOT = 2  # likewise, before the first picture
LEAST_PILOT, MOST_PILOT = 16, 512  # samples of a cell before the first picture
FEW_NOISY = 0.02  # of the cells
CALM = 0.25  # of the tolerance of interpolation: noise of the pilot that need not be less
STRATA = 3  # along a cell's side, for a pilot of few samples
GLANCE_SAMPLES = 2  # of a square; as many as the first pass takes, so that kernels are compiled once
GLANCED, REFINED, THROWN = 95_001, 96_001, 97_001  # seeds, far from those of the passes
TRUSTED = 16  # samples of a pixel and half from which noise is judged
JUDGE_SAMPLES = 10  # samples per pixel that cost about four times as much as judging its noise
PILOT_PHOTONS = 1 / 48  # samples' worth of photons over the pilot's samples of a cell
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


class Sigma(Protocol):
    """Noise of the photograph (H, W), radiance, not finite where unknown; asked for by window."""

    def __getitem__(self, window: Window, /) -> np.ndarray:
        """(h, w) of a window."""
        ...


@dataclass(frozen=True, eq=False)
class Canvas:
    """What is computed where. ``light``: irradiance E, (3,) or per pixel of the window (h w, 3)."""

    worlds: Worlds
    rays: Rays | LensRays  # of every pixel
    shape: tuple[int, int]
    region: Region
    light: np.ndarray
    plate_sigma: Sigma
    white: float  # radiance of display white
    effort: Effort
    film: Film | None = None  # where light tracing is worth its cost
    pilot: Pilot | None = None  # what the region was made from

    @functools.cached_property
    def traced(self) -> np.ndarray:
        """Flat index of the pixels that are sampled."""
        return in_frame(self.window, self.shape)[self.region.traced]

    @property
    def window(self) -> Window:
        """Rows and columns around the region: all that is computed is a picture of this size."""
        return self.region.window

    @functools.cached_property
    def places(self) -> np.ndarray:
        """Flat index of the traced pixels within the window."""
        return np.flatnonzero(self.region.traced)

    @functools.cached_property
    def smooth_albedo(self) -> np.ndarray:
        """(h, w, 3) of the window: albedo where the change is interpolated, at the middle of the pixel; else zero."""
        there = self.region.interpolated
        image = np.zeros((*there.shape, 3), np.float32)
        image[there] = centre_albedo(self.worlds, self.rays[in_frame(self.window, self.shape)[there]])
        return image

    @property
    def light_traced(self) -> np.ndarray:
        """(N, 3) or (3,) irradiance of the traced pixels."""
        return self.light if self.light.ndim == 1 else self.light[self.places]

    def framed(self, picture: np.ndarray) -> np.ndarray:
        """A picture of the window (h, w, ...) in the frame (H, W, ...), zero around it."""
        image = blank((*self.shape, *picture.shape[2:]))
        image[self.window] = picture
        return image


Tell = Callable[[str], Callable[[float], None]]


def in_frame(window: Window, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) flat indices in a frame (H, W) of the pixels of a window."""
    rows, columns = (np.arange(size)[part] for size, part in zip(shape, window, strict=True))
    return np.asarray(rows[:, None] * shape[1] + columns)


def prepare(
    worlds: Worlds,
    rays: Rays | LensRays,
    shape: tuple[int, int],
    light: np.ndarray,
    plate_sigma: Sigma,
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
        plate_sigma: noise of the photograph.
        white: radiance of display white.
        limits: of the region.
        effort: what to spend.
        film: the photograph's lens, for light tracing; None to leave all light to paths from the camera.
        tell: gives a progress callback for a named task.
    """
    film = film if effort.strategy == "difference" and throws(worlds) else None
    if film is not None:
        worlds = replace(worlds, photons=photons_for(worlds, min(shape[0] * shape[1], PILOT_PIXELS)))
    pilot = looked(worlds, rays, shape, light, limits, effort, film, tell("render: pilot"))
    region, left = plan(pilot.samples, pilot.model, pilot.grid, shape, limits, pilot.glanced)
    if effort.strategy == "reference" or not effort.adaptive:
        region = replace(region, traced=region.weight > 0)
    share = float(pilot.thrown[0].sum() / max(pilot.samples.gained.sum(), 1e-30))
    if share < WORTH_TRACING:
        film, worlds = None, replace(worlds, photons=0.0)
    if film is not None:
        worlds = replace(worlds, photons=photons_for(worlds, int(region.traced.sum())))
    canvas = Canvas(worlds, rays, shape, region, light, plate_sigma, white, effort, film, pilot)
    return lit(canvas, worlds, light, tell), left | {"light_traced_share": share}


def lit(canvas: Canvas, worlds: Worlds, light: np.ndarray, tell: Tell = lambda what: lambda share: None) -> Canvas:
    """The same pixels in other worlds (one light group alone), with the irradiance E there.

    ``light`` (3,) is the irradiance on the plane under their distant light; it is all of E on a plane alone.
    """
    inside = in_frame(canvas.window, canvas.shape)
    if inside.size and not (worlds.convex and worlds.diffuse):
        light = received(
            worlds, canvas.rays[inside.ravel()], inside.shape, canvas.effort.samples, canvas.effort, 1.0,
            tell("render: without"),
        )  # fmt: skip
    return replace(canvas, worlds=replace(worlds, photons=canvas.worlds.photons), light=light)


@dataclass(frozen=True, eq=False)
class Pilot:
    """What is known of the cells before any pixel is traced; of those ``glanced`` at, what their square told."""

    worlds: Worlds
    samples: Samples  # thrown light in it
    model: np.ndarray  # (cells, 3) expected LS_noobj
    thrown: np.ndarray  # (2, cells, 3) what light tracing finds, local and on objects (none), and its variance
    thrown_variance: np.ndarray
    glanced: np.ndarray  # (cells,) bool
    grid: tuple[int, int]
    shape: tuple[int, int]  # of the photograph
    index: np.ndarray  # (cells,) flat index of the pixel in the middle
    tolerance: float  # relative to LS_noobj, see `Limits`

    def too_noisy(self, region: Region) -> np.ndarray:
        """Indices of the cells that stand for their pixels, and are noisier than a quarter of what is tolerated.

        None where they are fewer than `FEW_NOISY` of those that stand: not worth another pass.
        """
        rows, columns = np.unravel_index(self.index, self.shape)
        stands = region.at(rows, columns, region.interpolated) & ~self.glanced
        known = stands & (self.model > 0).all(1)
        relative = self.samples.change_variance[known] / self.model[known] ** 2
        noisy = np.flatnonzero(known)[np.sqrt(relative.max(1) * BLUR_NOISE) > CALM * self.tolerance]
        return noisy if len(noisy) > FEW_NOISY * stands.sum() else noisy[:0]


def settled(canvas: Canvas, progress: Callable[[float], None]) -> Canvas:
    """With the rest of the samples in those of the pilot's cells that stand for their pixels and are too noisy for it.

    They come after the first picture. Which pixels are traced stays as it is.
    """
    pilot, effort, region = canvas.pilot, canvas.effort, canvas.region
    rest = PILOT_SHARE * effort.samples - pilot_samples(effort)
    if pilot is None or rest <= 0 or not effort.adaptive or not len(cells := pilot.too_noisy(region)):
        return canvas
    seed = effort.stream + REFINED
    rays = canvas.rays[pilot.index[cells]]
    more = trace(difference_block, pilot.worlds, rays, rest, effort.depth, seed, CELL, progress)
    samples = pilot.samples.placed(cells, more.lit(pilot.thrown[:, cells], pilot.thrown_variance[:, cells]))
    found = of_cells(samples, pilot.model, pilot.grid, pilot.glanced)
    lost, gained, variance = in_pixels(found, canvas.shape, canvas.window)
    return replace(canvas, region=replace(region, lost=lost, gained=gained, variance=variance))


def pilot_samples(effort: Effort) -> int:
    """Samples of a cell where a glance is not enough, at first."""
    return min(max(LEAST_PILOT, FIRST_PILOT * effort.samples), MOST_PILOT)


def looked(
    worlds: Worlds,
    rays: Rays | LensRays,
    shape: tuple[int, int],
    light: np.ndarray,
    limits: Limits,
    effort: Effort,
    film: Film | None,
    progress: Callable[[float], None],
) -> Pilot:
    """A glance at every cell, and the pilot's samples where `worth_a_look` asks for them; arguments of `prepare`."""
    index, grid = cell_pixels(*shape)
    squares, coarse = cell_pixels(*shape, GLANCE * CELL)
    square = (np.arange(grid[0])[:, None] // GLANCE * coarse[1] + np.arange(grid[1]) // GLANCE).ravel()  # of each cell
    none = np.zeros((2, len(index), 3))
    light_thrown, spread = light_by_cell(worlds, film, grid, effort) if film is not None else (none, none)

    def traced(seen: Rays, samples: int, seed: int, side: float) -> Samples:
        return trace(difference_block, worlds, seen, samples, effort.depth, effort.stream + seed, side, progress)

    closed = worlds.convex and worlds.diffuse
    seen = rays[squares]
    glance = traced(seen, GLANCE_SAMPLES, GLANCED, GLANCE * CELL)[square]
    glance = glance.lit(light_thrown, spread)
    if closed:
        cell_light = np.broadcast_to(light, (len(index), 3))
    else:
        cell_light = received(worlds, seen, coarse, GLANCE_SAMPLES, effort, GLANCE * CELL)[square]
    near = near_objects(worlds, seen, GLANCE * CELL)[square]
    wanted = worth_a_look(glance, glance.albedo * cell_light / np.pi, grid, limits, near)
    some, samples = np.flatnonzero(wanted), glance
    if len(some):
        few = pilot_samples(effort) <= GLANCE_SAMPLES * STRATA**2  # one kernel does for glance, pilot and first pass
        if few:
            parts = rays[index[some]].strata(CELL, STRATA)
            found = traced(parts, GLANCE_SAMPLES, 1, CELL / STRATA).gathered(STRATA**2)
        else:
            found = traced(rays[index[some]], pilot_samples(effort), 1, CELL)
        samples = glance.replaced(some, found.lit(light_thrown[:, some], spread[:, some]))
    if not closed and len(some):
        part = np.ix_(*(np.arange(there.min(), there.max() + 1) for there in np.nonzero(wanted.reshape(grid))))
        inside = np.arange(len(index)).reshape(grid)[part]
        cell_light[inside.ravel()] = received(
            worlds, rays[index[inside.ravel()]], inside.shape, pilot_samples(effort), effort, CELL
        )
    model = samples.albedo * cell_light / np.pi
    return Pilot(worlds, samples, model, light_thrown, spread, ~wanted, grid, shape, index, limits.tolerance)


def light_by_cell(worlds: Worlds, film: Film, grid: tuple[int, int], effort: Effort) -> tuple[np.ndarray, np.ndarray]:
    """(2, cells, 3) mean radiance of the local scene, and none of objects, by what emitters send there by way of
    objects; and the variance of that, by two halves.
    """
    height, width = film.shape

    def cell(pixel: np.ndarray) -> np.ndarray:
        row, column = np.divmod(pixel, width)
        return np.asarray(row // CELL * grid[1] + column // CELL)

    samples = PILOT_PHOTONS * pilot_samples(effort) / 2
    seeds = (effort.stream + 1, effort.stream + THROWN)
    halves = np.stack([thrown(worlds, film, samples, seed, cell, grid[0] * grid[1]) for seed in seeds])
    halves[:, 1] = 0
    rows, columns = (
        np.minimum(CELL, size - CELL * np.arange(n)) for size, n in zip((height, width), grid, strict=True)
    )
    halves /= (rows[:, None] * columns).reshape(-1, 1)
    return halves.mean(0), (halves[0] - halves[1]) ** 2 / 4


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
    """Passes over the traced pixels, from where an earlier run stopped; see `pipeline.transport.passes.refine`.

    After the first the pilot is `settled`.
    """
    effort, told = canvas.effort, 0.0

    def forward(share: float) -> None:
        nonlocal told
        told = share
        progress(told)

    def noisy(halves: Halves, ahead: int) -> np.ndarray:
        return still_noisy(canvas, halves, ahead) if effort.adaptive else halves.open

    def place(pixel: np.ndarray) -> np.ndarray:
        found = np.minimum(np.searchsorted(canvas.traced, pixel), len(canvas.traced) - 1)
        return np.where(canvas.traced[found] == pixel, found, -1)

    def light(samples: int, seed: int) -> np.ndarray:
        assert canvas.film is not None
        return thrown(canvas.worlds, canvas.film, samples, seed, place, len(canvas.traced))

    rays, worlds, seed = canvas.rays[canvas.traced], canvas.worlds, effort.stream + 2
    strategy, traced_light = STRATEGIES[effort.strategy], light if canvas.film is not None else None
    if start is not None and start.passes > 0:
        canvas = settled(canvas, lambda share: progress(told))
        yield Shot(canvas, start)
    for halves in refine(
        strategy, worlds, rays, effort.samples, effort.depth, seed, noisy, traced_light, start, forward
    ):
        if halves.passes == 1 and halves.open.any():
            yield Shot(canvas, halves)
        if halves.passes == 1:
            canvas = settled(canvas, lambda share: progress(told))
        if halves.passes > 1 or not halves.open.any():
            yield Shot(canvas, halves)


def still_noisy(canvas: Canvas, halves: Halves, ahead: int) -> np.ndarray:
    """(N,) of the open pixels: whether the picture is noisier there than half of what the photograph hides.

    Asked only where the samples still to come (``ahead``, of all pixels and one half) cost several times the answer.
    """
    if halves.a.count.max() < TRUSTED:
        return halves.open
    window = bounding_window(scattered(canvas, halves.open) > 0)
    here = canvas.region[window].weight.shape
    if ahead < JUDGE_SAMPLES * here[0] * here[1]:
        return halves.open
    images = planes_of(canvas, halves.both, JUDGED, window)
    composite = (images["obj"] + images["without"] + images["lost"] + images["gained"]).mean(-1)
    if canvas.effort.denoise:
        noise = quieted(*halves_in(canvas, halves, images, window)).noise(tile_means(images["without"].mean(-1)))
    else:
        noise = np.sqrt(tile_means((images["obj_variance"] + images["change_variance"]).mean(-1)))
    more = needs_more(noise, canvas.plate_sigma[canvas.window][window], tile_means(composite), canvas.white)
    wanted = np.zeros(canvas.region.traced.shape, bool)
    wanted[window] = in_tiles(more, here)
    return wanted.ravel()[canvas.places]


def scattered(canvas: Canvas, values: np.ndarray) -> np.ndarray:
    """Values (N, ...) of the traced pixels as a picture of the canvas's window, zero elsewhere."""
    height, width = canvas.region.traced.shape
    image = np.zeros((height * width, *values.shape[1:]), np.float32)
    image[canvas.places] = values
    return image.reshape(height, width, *values.shape[1:])


def planes_of(
    canvas: Canvas, samples: Samples, names: tuple[str, ...], window: Window = WHOLE
) -> dict[str, np.ndarray]:
    """The named fields as pictures of a window in the canvas's, and LS_noobj; the smooth part of the change is in."""
    images = {name: scattered(canvas, getattr(samples, name))[window] for name in names}
    region, smooth = canvas.region[window], canvas.smooth_albedo[window]  # zero where pixels are traced
    light = canvas.light if canvas.light.ndim == 1 else canvas.light.reshape(*canvas.region.weight.shape, 3)[window]
    light = np.asarray(light / np.pi, np.float32)
    images["albedo"] += smooth
    images["without"] = images["albedo"] * light  # equation 7
    model = smooth * light
    for name, relative in (("lost", region.lost), ("gained", region.gained)):
        if name in images:
            images[name] += relative * model
    if "change_variance" in images:
        images["change_variance"] += region.variance * model**2
    if "ground" in images:
        images["ground"] += region.interpolated
    return images


def halves_in(
    canvas: Canvas, halves: Halves, images: dict[str, np.ndarray], window: Window
) -> tuple[Half, Half, np.ndarray, np.ndarray, np.ndarray, float]:
    """What the denoiser wants to know of a window; ``images`` holds both halves' alpha and guides there."""
    parts = []
    for samples in (halves.a, halves.b):
        part = planes_of(canvas, samples, ("lost", "gained", "albedo", "obj"), window)
        parts.append(Half(part["lost"], part["gained"], part["without"], part["obj"]))
    return parts[0], parts[1], images["alpha"], images["obj_albedo"], images["obj_normal"], canvas.white


def pictures(canvas: Canvas, halves: Halves) -> tuple[dict[str, np.ndarray], QuietChange | None]:
    """Every field as a picture of the canvas's window, zero where nothing was computed; and what the denoiser says.

    It says nothing of fewer than `TRUSTED` samples.
    """
    images = planes_of(canvas, halves.both, (*JUDGED, "ground"))
    for name in ("change", "obj"):  # RMS over the channels, as the denoiser tells it below
        images[f"{name}_noise"] = np.sqrt(images[f"{name}_variance"].mean(-1))
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
    if quiet is not None:
        left = in_tiles(np.hypot(quiet.survives.noise, quiet.added.noise), here.shape) * model.mean(-1)
        view["change_noise"][:] = np.where(ground[..., 0], left, view["change_noise"])
        view["obj_noise"][:] = in_tiles(quiet.obj.noise, here.shape) * view["alpha"]
    return images, quiet


def in_tiles(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Values (h, w) of tiles at their pixels (H, W)."""
    return np.repeat(np.repeat(values, TILE, 0), TILE, 1)[: shape[0], : shape[1]]
