"""Merging the frames of one view into radiance, before demosaicking: maximum likelihood, with variance and mask.

Per photosite and frame i: signal ``x_i = (DN - black) / (white - black)``, exposure ``g_i``, ``E[x_i] = g_i y``,
``var(x_i) = shot_i g_i y + floor_i``. The estimate is ``y = sum(w_i x_i / g_i) / sum(w_i)`` over unclipped frames:

- *poisson*: ``w_i = g_i / shot_i``, which is sum of counts over sum of times; needs no iteration and no signal.
- *optimal*: ``w_i = g_i^2 / (shot_i g_i y' + floor_i)`` with y' the Poisson estimate averaged over the eight nearest
  photosites of the same colour, *without* the photosite itself: a weight that depends on the sample's own noise
  biases deep shadows (-0.6 % at 5 electrons).

Clipping is decided the same way. A sample within five sigma of the limit is used when its eight neighbours' mean lies
two sigma below the limit, so that its own noise does not decide: cutting at a fixed level loses 0.4 sigma there.
Negative values are kept. Sources: Hasinoff, Durand, Freeman 2010; Aguerrebere et al. 2014 (estimators and bounds).

Limits: the frames are taken as aligned; the noise of one photosite is taken as independent of the others'.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.conventions import CLIPPED, DARK, GHOST, HOT
from pipeline.image.noise import Noise

TILE_ROWS = 64  # even, so that a tile starts on a whole CFA cell; small enough to stay in cache
HALO = 4  # rows of context: two of the neighbourhood, two more for the neighbours' own clipping decision
LIMIT_MARGIN = 0.002  # of full scale kept from the clip level: knee of the converter
GHOST_SIGMA = 5.0  # of the chi-square, as a normal deviate: one false alarm in 3.5 million photosites
RATIO_ERROR = 0.005  # relative disagreement of frames that exposure error and flicker explain
HOT_SIGMA = 8.0
MAX_SUSPECTS = 0.005  # of the photosites are looked at as defects, the worst first; sensors have a tenth of it
ISOLATION = 0.15  # a defect's neighbours of other colours show less than this of it; optics spread light wider
NEIGHBOURS = [(dy, dx) for dy in (-2, 0, 2) for dx in (-2, 0, 2) if (dy, dx) != (0, 0)]  # same colour
ADJACENT = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


@dataclass(frozen=True, eq=False)
class Exposed:
    """One frame of a view, ready to merge. The (2, 2) arrays are in CFA cell order."""

    mosaic: np.ndarray  # (H, W) DN
    exposure: float  # t * ISO / (100 * N^2)
    black: np.ndarray  # (2, 2) DN
    white: float  # DN
    limit: np.ndarray  # (2, 2) largest normalised signal taken as linear
    noise: Noise

    def signal(self, rows: slice = slice(None)) -> np.ndarray:
        """(h, W) float32 normalised signal of rows that start on an even row."""
        part = self.mosaic[rows]
        scale = 1 / (self.white - self.black)
        return (part - tiled(self.black, part.shape)) * tiled(scale, part.shape)


@dataclass(frozen=True, eq=False)
class Merged:
    """Radiance (H, W) float32, its variance, its mask (uint32 bits of conventions), counts by name."""

    radiance: np.ndarray
    variance: np.ndarray
    mask: np.ndarray


def tiled(cell: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A (2, 2) cell repeated over (H, W), float32; a scalar array when its four values agree."""
    cell = np.broadcast_to(np.asarray(cell, np.float32), (2, 2))
    if np.all(cell == cell[0, 0]):
        return cell[0, 0]
    return np.tile(cell, (-(-shape[0] // 2), -(-shape[1] // 2)))[: shape[0], : shape[1]]


def clip_levels(mosaics: Sequence[np.ndarray], white: float, black: np.ndarray) -> np.ndarray:
    """DN (2, 2) at which the photosites of each CFA cell clip, of frames of one camera and ISO.

    ``white``, unless frames of different exposure pile up at one and the same lower maximum: then that is the level.
    """
    levels = np.full((2, 2), white)
    for row, column in np.ndindex(2, 2):
        tops = []
        for mosaic in mosaics:
            plane = mosaic[row::2, column::2]
            top = plane.max() if plane.size else 0
            if black[row, column] + 0.5 * (white - black[row, column]) < top < white:
                tops.append((float(top), float(np.mean(plane == top))))
        piled = [top for top, share in tops if share > 5e-4]
        levels[row, column] = next((top for top in sorted(piled, reverse=True) if piled.count(top) > 1), white)
    return levels


def linear_limits(level: np.ndarray, black: np.ndarray, white: float, noise: Noise) -> np.ndarray:
    """(2, 2) normalised signal up to which samples are linear, from the clip levels in DN."""
    margin = np.maximum(LIMIT_MARGIN, 2 * np.sqrt(noise.floor))
    return (level - black) / (white - black) - margin


def merge(frames: Sequence[Exposed], weights: Literal["poisson", "optimal"] = "optimal", workers: int = 1) -> Merged:
    """Merge the frames of one view; the order they come in changes nothing.

    Bit CLIPPED: clipped in every frame, the value is the bound of the shortest, variance infinite. DARK: below one
    standard deviation. GHOST: chi-square of the frames beyond the noise, variance raised to what they show.
    """
    from concurrent.futures import ThreadPoolExecutor

    ordered = sorted(frames, key=lambda f: (f.exposure, f.mosaic.tobytes() if _tied(f, frames) else b""))
    height, width = ordered[0].mosaic.shape
    result = Merged(*(np.empty((height, width), dtype) for dtype in (np.float32, np.float32, np.uint32)))

    def work(tile: tuple[slice, slice, slice]) -> None:
        outer, inner, target = tile
        part = _merge_rows(ordered, outer, weights)
        for whole, piece in zip((result.radiance, result.variance, result.mask), part):
            whole[target] = piece[inner]

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, _tiles(height)))
    return result


def _tied(frame: Exposed, frames: Sequence[Exposed]) -> bool:
    return sum(other.exposure == frame.exposure for other in frames) > 1


def _tiles(height: int) -> Iterator[tuple[slice, slice, slice]]:
    """Rows with halo, the rows wanted within them, and where these go."""
    for start in range(0, height, TILE_ROWS):
        stop = min(start + TILE_ROWS, height)
        first = max(start - HALO, 0)
        yield slice(first, min(stop + HALO, height)), slice(start - first, stop - first), slice(start, stop)


def _merge_rows(frames: Sequence[Exposed], rows: slice, weights: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance, variance and mask of some rows; frames sorted from the shortest."""
    signals = [frame.signal(rows) for frame in frames]
    shape = signals[0].shape
    used = [_usable(frame, signal, first=i == 0) for i, (frame, signal) in enumerate(zip(frames, signals))]
    weight = [use * (np.float32(frame.exposure) / tiled(frame.noise.shot, shape)) for use, frame in zip(used, frames)]
    numerator, total = _sums(frames, signals, weight)
    if weights == "optimal":
        around = np.maximum(_ratio(_around(numerator), _around(total)), 0)
        weight = [use / _variance(frame, around) for use, frame in zip(used, frames)]
        numerator, total = _sums(frames, signals, weight)
    seen = total > 0
    radiance = _ratio(numerator, total)
    variance, ghost = _spread(frames, signals, used, weight, radiance, total)
    mask = np.where(seen, 0, CLIPPED).astype(np.uint32)
    mask |= np.where(ghost, np.uint32(GHOST), np.uint32(0))
    mask |= np.where(seen & (radiance < np.sqrt(variance)), np.uint32(DARK), np.uint32(0))
    bound = np.fmax(signals[0], tiled(frames[0].limit, shape)) / np.float32(frames[0].exposure)
    return np.where(seen, radiance, bound), np.where(seen, variance, np.float32(np.inf)), mask


def _variance(frame: Exposed, radiance: np.ndarray) -> np.ndarray:
    """Variance of one frame's estimate of a radiance (h, W) that is not negative."""
    g, shape = np.float32(frame.exposure), radiance.shape
    return tiled(frame.noise.shot, shape) / g * radiance + tiled(frame.noise.floor, shape) / (g * g)


def _spread(
    frames: Sequence[Exposed],
    signals: list[np.ndarray],
    used: list[np.ndarray],
    weight: list[np.ndarray],
    radiance: np.ndarray,
    total: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Variance of the weighted mean, and where the frames disagree beyond it; there the variance is what they show."""
    level = np.maximum(radiance, 0)
    spread, chi2, count = (np.zeros_like(radiance) for _ in range(3))
    for frame, signal, use, w in zip(frames, signals, used, weight):
        noise = _variance(frame, level)
        spread += w * w * noise
        if len(frames) > 1:
            misfit = np.where(use, signal / np.float32(frame.exposure) - radiance, 0)
            chi2 += misfit * misfit / (noise + (np.float32(RATIO_ERROR) * level) ** 2)
            count += use
    variance = _ratio(spread, total * total)
    ghost = (count > 1) & (chi2 > _chi2_limit(count - 1))
    return np.where(ghost, variance * chi2 / np.maximum(count - 1, 1), variance), ghost


def _sums(
    frames: Sequence[Exposed], signals: list[np.ndarray], weight: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    numerator, total = np.zeros_like(signals[0]), np.zeros_like(signals[0])
    for frame, signal, w in zip(frames, signals, weight):
        weighted = np.multiply(w, signal, out=np.zeros_like(signal), where=w > 0)  # 0 * NaN is NaN
        numerator += weighted / np.float32(frame.exposure)
        total += w
    return numerator, total


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Quotient, 0 where the denominator is 0."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0)


def _around(values: np.ndarray) -> np.ndarray:
    """Sum over the eight nearest photosites of the same colour, the photosite itself left out; mirrored at the edge."""
    padded = np.pad(values, 2, mode="reflect" if min(values.shape) > 2 else "edge")
    height, width = values.shape
    rows = padded[:height] + padded[2 : 2 + height] + padded[4 : 4 + height]
    return rows[:, :width] + rows[:, 2 : 2 + width] + rows[:, 4 : 4 + width] - values


def _usable(frame: Exposed, signal: np.ndarray, first: bool) -> np.ndarray:
    """(h, W) bool: the sample is finite and not clipped, decided without its own noise (see the module's text).

    The shortest frame has nothing to fall back on and is cut at the limit itself.
    """
    limit = tiled(frame.limit, signal.shape)
    used = signal < limit
    if frame.mosaic.dtype.kind == "f":
        used &= np.isfinite(signal)
    if first:
        return used
    sigma = np.sqrt(frame.noise.variance(float(frame.limit.max())).max())
    near = used & (signal > limit - np.float32(5 * sigma))
    rows, columns = np.nonzero(near)
    if len(rows):
        height, width = signal.shape
        total = np.zeros(len(rows), np.float32)
        for dy, dx in NEIGHBOURS:
            total += signal[_mirror(rows + dy, height), _mirror(columns + dx, width)]
        threshold = limit if limit.ndim == 0 else limit[rows, columns]
        used[rows, columns] = total / len(NEIGHBOURS) < threshold - np.float32(2 * sigma)
    return used


def _mirror(index: np.ndarray, size: int) -> np.ndarray:
    """Index reflected at the ends, which keeps its CFA parity; clipped where the picture is smaller than that."""
    index = np.abs(index)
    return np.clip(np.where(index >= size, 2 * (size - 1) - index, index), 0, size - 1)


def _chi2_limit(freedom: np.ndarray) -> np.ndarray:
    """Chi-square at GHOST_SIGMA (Wilson and Hilferty 1931, within 2 % here)."""
    k = np.maximum(freedom, 1)
    return k * (1 - 2 / (9 * k) + GHOST_SIGMA * np.sqrt(2 / (9 * k))) ** 3


def replace_defects(merged: Merged) -> tuple[Merged, int]:
    """Hot and dead photosites replaced by the median of their same-colour neighbours and flagged HOT, and how many.

    A defect stands out of all eight same-colour neighbours by HOT_SIGMA, while the adjacent photosites of the other
    colours show nothing: light, however small its source, is spread over several photosites by lens and filter.
    """
    radiance, variance = merged.radiance, merged.variance
    rows, columns = _outliers(radiance, variance)
    keep = np.zeros(len(rows), bool)
    if not len(rows):
        return merged, 0
    excess, middle, spread = _excess(radiance, rows, columns)
    worst = np.zeros(len(rows))
    height, width = radiance.shape
    for dy, dx in ADJACENT:
        y, x = _mirror(rows + dy, height), _mirror(columns + dx, width)
        beside = np.abs(_excess(radiance, y, x)[0]) - 3 * np.sqrt(variance[y, x])
        worst = np.maximum(worst, np.where(np.isfinite(beside), beside, np.inf))
    keep = worst < ISOLATION * np.abs(excess)
    rows, columns, middle, spread = rows[keep], columns[keep], middle[keep], spread[keep]
    new = Merged(radiance.copy(), variance.copy(), merged.mask.copy())
    new.radiance[rows, columns] = middle
    # 1.25^2 / 8: variance of the median of eight over theirs; the rest is how far a photosite lies from its neighbours
    new.variance[rows, columns] = spread * (1 + 1.25**2 / 8)
    new.mask[rows, columns] = HOT
    return new, len(rows)


def _outliers(radiance: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of photosites beyond all same-colour neighbours by HOT_SIGMA; if many, those farthest beyond.

    Texture at the scale of photosites is full of them and none is a defect.
    """
    if min(radiance.shape) < 5:
        return np.zeros(0, int), np.zeros(0, int)
    height, width = radiance.shape
    padded = np.pad(radiance, 2, mode="reflect")
    views = [padded[2 + dy : 2 + dy + height, 2 + dx : 2 + dx + width] for dy, dx in NEIGHBOURS]
    high, low = views[0].copy(), views[0].copy()
    for view in views[1:]:
        np.maximum(high, view, out=high)
        np.minimum(low, view, out=low)
    reach = HOT_SIGMA * np.sqrt(variance)  # infinite where clipped: never an outlier
    beyond = (radiance > high + reach) | (radiance < low - reach)
    most = max(1000, round(MAX_SUSPECTS * radiance.size))
    if np.count_nonzero(beyond) > most:
        gap = np.maximum(radiance - high, low - radiance)[beyond] / reach[beyond]
        beyond[beyond] = gap > np.partition(gap, -most)[-most]
    rows, columns = np.nonzero(beyond)
    return rows, columns


def _excess(radiance: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At some pixels: value less the median of the same-colour neighbours, that median, the neighbours' variance."""
    height, width = radiance.shape
    around = np.stack(
        [radiance[_mirror(rows + dy, height), _mirror(columns + dx, width)] for dy, dx in NEIGHBOURS]
    ).astype(np.float64)
    middle = np.median(around, 0)
    return radiance[rows, columns] - middle, middle, around.var(0, ddof=1)


def measure_shift(long: Exposed, short: Exposed) -> float | None:
    """Shift [px] between two frames of a view, by one Lucas-Kanade step on CFA cells; None without usable structure.

    Meant to tell that there is none: beyond about two pixels it is an underestimate.
    """
    scaled = [_cells(frame) for frame in (long, short)]
    clear = np.isfinite(scaled[0]) & np.isfinite(scaled[1])
    if np.mean(clear) < 0.05:
        return None
    a, b = (np.where(clear, picture, 0) for picture in scaled)
    inner = (slice(1, -1), slice(1, -1))
    whole = clear[inner] & clear[2:, 1:-1] & clear[:-2, 1:-1] & clear[1:-1, 2:] & clear[1:-1, :-2]
    gy, gx = (a[2:, 1:-1] - a[:-2, 1:-1])[whole] / 2, (a[1:-1, 2:] - a[1:-1, :-2])[whole] / 2
    difference = (b - a)[inner][whole]
    mean = np.maximum(a[inner][whole], 0)
    shot, floor = short.noise.shot.mean() / (4 * short.exposure), short.noise.floor.mean() / (4 * short.exposure**2)
    weight = 1 / (shot * mean + floor + (0.01 * mean) ** 2)
    normal = np.array([[np.sum(weight * p * q) for q in (gx, gy)] for p in (gx, gy)])
    # what noise alone gives to each diagonal: half the long frame's variance per pixel
    mimic = 0.5 * float(np.sum(weight * (shot * mean + floor))) * short.exposure / long.exposure
    if len(mean) < 100 or np.linalg.eigvalsh(normal)[0] < 100 + 3 * mimic:
        return None
    step = np.linalg.solve(normal, [np.sum(weight * p * difference) for p in (gx, gy)])
    return 2 * float(np.hypot(*step))


def _cells(frame: Exposed) -> np.ndarray:
    """Mean radiance of each CFA cell, (H/2, W/2), of at most 600 rows about the middle; NaN where a photosite clips."""
    height, width = (size // 2 * 2 for size in frame.mosaic.shape)
    first = max(0, (height // 2 - 300) // 2 * 2)
    signal = frame.signal(slice(first, min(height, first + 600)))[:, :width]
    limit = float(frame.limit.min())
    parts = [signal[r::2, c::2] for r, c in np.ndindex(2, 2)]
    mean = sum(parts[1:], parts[0]) / (4 * np.float32(frame.exposure))
    bad = np.maximum.reduce(parts) >= limit
    return np.where(bad, np.nan, mean)
