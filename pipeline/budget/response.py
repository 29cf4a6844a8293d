"""What a wrong light does to the layers: low-sample renders of every n-th pixel, relative to the same render unharmed.

Light enters linearly, so a pattern of radiance is rendered as a light of its own. What its render makes of the lost and
added light and of the objects is kept relative to that of the whole light, with the same random numbers, and multiplies
the full layers: noise that both share cancels, and texture and edges are the full picture's.

The albedo was measured under the same light: where the irradiance E on the plane is too high by s, the albedo is too
low by s, and what the plane sends out stays what the plate shows. So per unit of a pattern with irradiance s E,

    d X = X[pattern] - s dX / d ln(albedo),        X: lost light, added light, objects

with the derivative from a render over a `DIMMER` ground: once the albedo for light that meets the ground once, twice
for what it sends to an object and receives back. A light that is too bright as a whole thus changes no shadow, and
objects only as far as the ground does not light them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.transport.difference import difference_block
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import LensRays, Rays, Samples, seen_points, trace

STEP_RAD = 0.02  # of a turn that is rendered: well above rounding, below the width of a lamp's penumbra
DIMMER = 0.8  # albedo of the ground in the second render, relative: the derivative by it comes from the difference
SMOOTHED = 3  # squares of the grid over which renders are summed before they are divided
STEEP = 0.05  # of the steepest slope of a shadow, alone in a square of the grid: less is no edge
LAYERS = ("lost", "gained", "obj")
MOST_RATIO = 4.0  # of a pattern's part in the whole: beyond, the whole is too faint to be divided by


@dataclass(frozen=True, eq=False)
class Grid:
    """Every ``step``-th pixel of a window of the frame, and which of them are traced."""

    shape: tuple[int, int]  # (H, W) of the frame
    window: tuple[slice, slice]
    step: int
    chosen: np.ndarray  # (h, w) bool

    @classmethod
    def over(cls, wanted: np.ndarray, most: int) -> Grid:
        """Over the True pixels of (H, W), as fine as ``most`` pixels allow."""
        rows, columns = (np.flatnonzero(wanted.any(axis)) for axis in (1, 0))
        window = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
        inside = wanted[window]
        step = max(1, int(np.ceil(np.sqrt(inside.sum() / most))))
        return cls(wanted.shape, window, step, inside[step // 2 :: step, step // 2 :: step])

    @property
    def pixels(self) -> np.ndarray:
        """Flat index of the traced pixels in the frame."""
        row, column = np.nonzero(self.chosen)
        rows, columns = ((at * self.step + self.step // 2 + part.start) for at, part in zip((row, column), self.window))
        return np.asarray(rows * self.shape[1] + columns)

    def scattered(self, values: np.ndarray) -> np.ndarray:
        """Values (N, C) of the traced pixels on the grid (h, w, C), zero elsewhere."""
        result = np.zeros((*self.chosen.shape, values.shape[-1]))
        result[self.chosen] = values
        return result

    def enlarged(self, values: np.ndarray) -> np.ndarray:
        """(h, w, C) on the grid at every pixel of the window, bilinear."""
        for axis, part in enumerate(self.window):
            place = (np.arange(part.stop - part.start) - self.step // 2) / self.step
            place = np.clip(place, 0, values.shape[axis] - 1)
            low = np.minimum(place.astype(int), max(values.shape[axis] - 2, 0))
            share = (place - low).reshape([-1 if a == axis else 1 for a in range(3)])
            high = np.minimum(low + 1, values.shape[axis] - 1)
            values = values.take(low, axis) * (1 - share) + values.take(high, axis) * share
        return np.asarray(values)


@dataclass(frozen=True, eq=False)
class Seen:
    """What a render says on the grid: lost and gained light and objects, each (h, w, 3)."""

    lost: np.ndarray
    gained: np.ndarray
    obj: np.ndarray

    def minus(self, other: Seen) -> Seen:
        """The difference of two renders."""
        return Seen(self.lost - other.lost, self.gained - other.gained, self.obj - other.obj)


def rendered(worlds: Worlds, rays: Rays | LensRays, grid: Grid, samples: int, depth: int, seed: int) -> Seen:
    """A render of the grid's pixels with few samples."""
    found: Samples = trace(difference_block, worlds, rays[grid.pixels], samples, depth, seed)
    return Seen(*(grid.scattered(values) for values in (found.lost, found.gained, found.obj)))


def points_on(worlds: Worlds, rays: Rays | LensRays, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points (N, 3) that traced pixels see in their middle, the pixels (N, 2), and whether objects; only hits."""
    points, on_object, on_local = seen_points(worlds, rays[grid.pixels])
    row, column = np.divmod(grid.pixels, grid.shape[1])
    hit = on_object | on_local
    return points[hit], (np.stack([column, row], -1) + 0.5)[hit], on_object[hit]


def summed(values: np.ndarray) -> np.ndarray:
    """Sums (h, w, C) over `SMOOTHED` by `SMOOTHED` neighbours, zero outside."""
    for axis in (0, 1):
        padded = np.pad(values, [(SMOOTHED // 2, SMOOTHED // 2) if a == axis else (0, 0) for a in range(3)])
        steps = (padded.take(range(k, k + values.shape[axis]), axis) for k in range(SMOOTHED))
        values = np.sum(list(steps), axis=0)
    return values


def share_of(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a pattern's render in the whole's; the mean over all where the whole is too faint to tell."""
    total = whole.sum((0, 1))
    mean = np.divide(part.sum((0, 1)), total, out=np.zeros(3), where=total != 0)
    above, below = summed(part), summed(whole)
    faint = np.abs(below) <= 1e-3 * np.abs(below).max(initial=0.0)
    ratio = np.divide(above, below, out=np.broadcast_to(mean, above.shape).copy(), where=~faint)
    return np.asarray(np.clip(ratio, -MOST_RATIO, MOST_RATIO))


def boxed(values: np.ndarray, side: int) -> np.ndarray:
    """Means (h, w, C) over squares of ``side`` pixels, zero outside the picture."""
    from scipy.ndimage import uniform_filter

    return np.asarray(uniform_filter(values, (side, side, 0), mode="constant"))


@dataclass(frozen=True, eq=False)
class Layers:
    """The full pictures that renders of the grid are taken relative to, within the grid's window (h, w, 3)."""

    lost: np.ndarray
    gained: np.ndarray
    obj: np.ndarray
    on_lost: np.ndarray  # what the composite makes of a unit of lost light: (1 - t) + t LS_b / LS_noobj
    on_gained: np.ndarray  # likewise of added light

    def changed(self, lost: np.ndarray, gained: np.ndarray, obj: np.ndarray) -> np.ndarray:
        """Change of the composite (h, w, 3) by changes of lost light, added light and objects."""
        return np.asarray(self.on_lost * lost + self.on_gained * gained + obj)


@dataclass(frozen=True, eq=False)
class Response:
    """Renders of the whole light, over the real and over a `DIMMER` ground; what patterns make of the composite."""

    grid: Grid
    layers: Layers
    whole: Seen
    dim: Seen

    @functools.cached_property
    def undone(self) -> dict[str, np.ndarray]:
        """(h, w, 3) of the window for lost, gained and obj: dX / d ln(albedo), which every pattern shares."""
        found = {}
        for name in LAYERS:
            share = share_of(getattr(self.dim, name), getattr(self.whole, name))
            by_albedo = self.grid.enlarged(np.maximum(1 - share, 0) / (1 - DIMMER))
            found[name] = by_albedo * getattr(self.layers, name)
        return found

    def of_factor(self, factor: np.ndarray) -> np.ndarray:
        """Change of the composite when all light is brighter by a relative factor (3,)."""
        return self._changed(dict.fromkeys(LAYERS, 1.0), factor, factor)

    def of_light(self, seen: Seen, irradiance_share: np.ndarray) -> np.ndarray:
        """When the light of a render is added that gives a share (3,) of the plane's irradiance."""
        shares = {name: self.grid.enlarged(share_of(getattr(seen, name), getattr(self.whole, name))) for name in LAYERS}
        return self._changed(shares, irradiance_share, 1.0)

    def of_turn(self, apart: Seen, irradiance_share: np.ndarray) -> np.ndarray:
        """When the light moves: by the difference of two renders, whose sign changes over an edge, so not relative."""
        lost, gained, obj = (self.grid.enlarged(summed(getattr(apart, name)) / SMOOTHED**2) for name in LAYERS)
        full = self.layers
        lost = self.at_edges(lost, full.lost)
        moved = full.changed(np.minimum(full.lost + lost, 0) - full.lost, gained, obj)
        return moved + self._changed(dict.fromkeys(LAYERS, 0.0), irradiance_share, 1.0)

    def at_edges(self, change: np.ndarray, layer: np.ndarray) -> np.ndarray:
        """A change (h, w, 3) that the grid shows, where the full ``layer`` says that it happens: in ratio to its slope.

        What moves a shadow changes it at its edge, which may be a pixel wide, and the grid's squares many.
        """
        slope = np.hypot(*(np.gradient(layer, axis=axis) if layer.shape[axis] > 1 else 0 * layer for axis in (0, 1)))
        side = SMOOTHED * self.grid.step
        around = boxed(slope, side)
        ratio = np.divide(slope, around, out=np.ones_like(slope), where=around > STEEP * slope.max(initial=0.0) / side)
        return np.asarray(change * ratio)

    def _changed(self, shares: dict[str, Any], irradiance_share: np.ndarray, factor: np.ndarray | float) -> np.ndarray:
        """``factor * shares`` of every layer, less what the albedo undoes."""
        parts = [
            factor * shares[name] * getattr(self.layers, name) - irradiance_share * self.undone[name] for name in LAYERS
        ]
        return self.layers.changed(*parts)
