"""What each cell of pixels shows, before any pixel is traced: a glance at squares of cells, samples where it matters.

Light that reaches the plane by way of objects is thrown from the emitters here as well; where local surfaces see each
other or gloss, the irradiance that LS_noobj has is the path-traced radiance without objects over the albedo, smoothed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.transport.caustics import Film, thrown
from pipeline.transport.denoise import continued, denoise
from pipeline.transport.difference import difference_block
from pipeline.transport.reflectance import reflected_radiance
from pipeline.transport.region import BLUR_NOISE, CELL, GLANCE, Limits, Region, cell_pixels, near_objects, worth_a_look
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import LensRays, Rays, Samples, trace, unchanged_block

PILOT_SHARE = 8  # samples of a cell over samples of a pixel: a cell stands for 64 pixels
FIRST_PILOT = 2  # likewise, before the first picture
LEAST_PILOT, MOST_PILOT = 16, 512  # samples of a cell before the first picture
FEW_NOISY = 0.02  # of the cells
CALM = 0.25  # of the tolerance of interpolation: noise of the pilot that need not be less
STRATA = 3  # along a cell's side, for a pilot of few samples
GLANCE_SAMPLES = 2  # of a square; as many as the first pass takes, so that kernels are compiled once
GLANCED, REFINED, THROWN = 95_001, 96_001, 97_001  # seeds, far from those of the passes
PILOT_PHOTONS = 1 / 48  # samples' worth of photons over the pilot's samples of a cell


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
    wanted = worth_a_look(glance, reflected_radiance(glance.albedo, cell_light), grid, limits, near)
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
    model = reflected_radiance(samples.albedo, cell_light)
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
