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

from pipeline.transport.canvas import (
    JUDGED,
    TRUSTED,
    Canvas,
    Sigma,
    halves_in,
    in_frame,
    in_tiles,
    pictures,
    planes_of,
    scattered,
)
from pipeline.transport.caustics import Film, photons_for, thrown, throws
from pipeline.transport.denoise import QuietChange, bounding_window, needs_more, quieted, tile_means
from pipeline.transport.difference import difference_block
from pipeline.transport.passes import Halves, refine
from pipeline.transport.pilot import PILOT_SHARE, REFINED, Effort, looked, pilot_samples, received
from pipeline.transport.region import CELL, Limits, in_pixels, of_cells, plan
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import LensRays, Rays, Strategy, reference_block, trace

STRATEGIES: dict[str, Strategy] = {"difference": difference_block, "reference": reference_block}
JUDGE_SAMPLES = 10  # samples per pixel that cost about four times as much as judging its noise
PILOT_PIXELS = 1 << 20  # most pixels whose worth of photons a pilot takes
WORTH_TRACING = 0.02  # of the added light: less of it in caustics is left to paths from the camera

Tell = Callable[[str], Callable[[float], None]]


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
