"""Merging the frames of one view into radiance, before demosaicking: maximum likelihood, with variance and mask.

Per photosite and frame i: signal ``x_i = (DN - black) / (white - black)``, exposure ``g_i``, ``E[x_i] = g_i y``,
``var(x_i) = shot_i g_i y + floor_i``. The estimate is ``y = sum(w_i x_i / g_i) / sum(w_i)`` over unclipped frames:

- *poisson*: ``w_i = g_i / shot_i``, which is sum of counts over sum of times; needs no iteration and no signal.
- *optimal*: ``w_i = g_i^2 / (shot_i g_i y' + floor_i)`` with y' the Poisson estimate averaged over the four nearest
  photosites of the same colour in the row, *without* the photosite itself: a weight that depends on the sample's own
  noise biases deep shadows (-0.6 % at 5 electrons). Where all of a stretch of a row has fifty times more shot than
  read noise the Poisson weights are used: they lose 1.1 % at that edge and 0.03 % at ten times its light.

A sample at or above its limit says that the radiance is at least the limit. It enters *as the limit* when the shorter
frames together lie below it by no more than four sigma, else not at all. To leave all clipped samples out would lose
0.4 sigma, by choosing on the samples' own noise; so the bias stays below 0.1 sigma for frames up to two stops apart and
0.3 at three, within two sigma of the limit and nowhere else, and neighbours have no say in it: texture does no harm.
Negative values are kept. Sources: Hasinoff, Durand, Freeman 2010; Aguerrebere et al. 2014 (estimators and bounds).

Data without a mosaic, (H, W, 3), go the same way, each channel for itself.
Limits: the frames are taken as aligned; the noise of one photosite is taken as independent of the others'.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.conventions import HOT
from pipeline.image import machine_code, merge_chunk, merge_kernel
from pipeline.image.noise import Noise

TILE_ROWS = 128  # even, so that a tile starts on a whole CFA cell; more than calls cost
LIMIT_MARGIN = 0.002  # of full scale kept from the clip level: knee of the converter
GHOST_SIGMA = 5.0  # of the chi-square, as a normal deviate: one false alarm in 3.5 million photosites
LEAST_SHOT, LEAST_FLOOR = 1e-9, 1e-14  # of full scale: no data are better, and weights stay finite
HOT_SIGMA = 8.0
MAX_SUSPECTS = 0.005  # of the photosites are looked at as defects, the worst first; sensors have a tenth of it
LIMIT_PLACES = (
    20_000  # photosites that the limit of detection is the median of: known to half a percent of their spread
)
ISOLATION = 0.15  # a defect's neighbours of other colours show less than this of it; optics spread light wider
NEIGHBOURS = [(dy, dx) for dy in (-2, 0, 2) for dx in (-2, 0, 2) if (dy, dx) != (0, 0)]  # same colour
ADJACENT = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


@dataclass(frozen=True, eq=False)
class Exposed:
    """One frame of a view, ready to merge.

    A mosaic is (H, W), its (2, 2) arrays in CFA cell order; data without one are (H, W, 3), their arrays (1, 3).
    """

    mosaic: np.ndarray  # (H, W) or (H, W, 3) DN; see `merge` for what else it may be
    exposure: float  # t * ISO / (100 * N^2)
    black: np.ndarray  # (2, 2) DN
    white: float  # DN
    limit: np.ndarray  # (2, 2) largest normalised signal taken as linear
    noise: Noise

    def signal(self, rows: slice = slice(None)) -> np.ndarray:
        """(h, W) or (h, W, 3) float32 normalised signal of rows that start on an even row."""
        part = self.mosaic[rows]
        scale = 1 / (self.white - self.black)
        if part.ndim == 3:
            return ((part - self.black.astype(np.float32)) * scale.astype(np.float32)).astype(np.float32, copy=False)
        return (part - tiled(self.black, part.shape)) * tiled(scale, part.shape)


@dataclass(frozen=True, eq=False)
class Merged:
    """Radiance float32 of the frames' shape, its variance, its mask (uint8, the bits of conventions)."""

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

    A frame's ``mosaic`` is asked for `TILE_ROWS` rows at a time and for each row once (twice when two exposures are
    equal): it may be a memory-mapped file, or anything else with ``shape``, ``dtype`` and slices of rows.
    """
    from concurrent.futures import ThreadPoolExecutor

    tied = len({frame.exposure for frame in frames}) < len(frames)
    ordered = sorted(frames, key=lambda frame: (frame.exposure, _digest(frame.mosaic) if tied else b""))
    shape = ordered[0].mosaic.shape
    result = Merged(*(np.empty(shape, dtype) for dtype in (np.float32, np.float32, np.uint8)))
    tables, limits = _coefficients(ordered), _chi2_limits(len(ordered))
    dtype = np.uint16 if all(frame.mosaic.dtype in (np.uint8, np.uint16) for frame in ordered) else np.float32
    kernel, tiles = merge_kernel.rows_kernel(), range(0, shape[0], TILE_ROWS)
    lacking = merge_chunk.slots(len(ordered)) - len(ordered)

    def work(share: range) -> None:
        memory = merge_chunk.working_memory(len(ordered), 2 if len(shape) == 2 else shape[2])
        for start in share:
            rows = slice(start, min(start + TILE_ROWS, shape[0]))
            out = [
                part[rows].reshape(rows.stop - start, -1) for part in (result.radiance, result.variance, result.mask)
            ]
            samples = [_rows(frame.mosaic[rows], dtype) for frame in ordered]
            samples += samples[-1:] * lacking
            room = (0,) * len(samples), _streams([*samples, *out]), memory, np.zeros(len(ordered), int)
            kernel(tuple(samples), start, *tables, weights == "poisson", limits, *room, np.zeros(len(ordered)), *out)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, (tiles[number::workers] for number in range(workers))))
    return result


def _digest(mosaic: np.ndarray) -> bytes:
    """What tells frames of one exposure apart."""
    digest = hashlib.sha256()
    for start in range(0, mosaic.shape[0], TILE_ROWS):
        digest.update(np.ascontiguousarray(mosaic[start : start + TILE_ROWS]).data)
    return digest.digest()


def _rows(mosaic: np.ndarray, dtype: type) -> np.ndarray:
    """(h, S) contiguous DN of some rows, copied only where they are not; infinite samples become NaN."""
    rows: np.ndarray = np.ascontiguousarray(mosaic, dtype).reshape(len(mosaic), -1)
    if dtype is np.float32 and not np.isfinite(rows).all():
        return np.where(np.isfinite(rows), rows, np.float32(np.nan))
    return rows if rows.flags.writeable else rows.copy()  # the compiler takes another type for another machine code


def _streams(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """(N, 2) where arrays begin in memory and bytes per element."""
    return np.array([(array.ctypes.data, array.itemsize) for array in arrays])


def _coefficients(frames: Sequence[Exposed]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """``coefficients``, ``unclipped``, ``together`` and ``bounds`` of `merge_kernel.merge_rows`."""
    single, bounds = [], []
    for frame in frames:
        g = frame.exposure
        shot, floor = np.maximum(frame.noise.shot, LEAST_SHOT), np.maximum(frame.noise.floor, LEAST_FLOOR)
        dn = 1 / ((frame.white - frame.black) * g)
        cells = [frame.black, dn, shot / g, floor / g**2, frame.limit / g, g / shot]
        single.append(np.stack(np.broadcast_arrays(*cells), -1))
        bounds.append(_bounds(frame, shot, floor))
    each = np.stack([np.broadcast_to(cell, (2, *cell.shape[1:])) for cell in single], 2)  # (2, C, F, 6)
    _, dn, shot, floor, limit, weight = np.moveaxis(each, -1, 0)
    count, lacking = len(frames), merge_chunk.slots(len(frames)) - len(frames)
    used = np.tri(count + 1, count, -1)  # (F + 1, F): of the first 0, 1, 2, ...
    parts = [np.broadcast_to(part[..., None, :], (*part.shape[:2], *used.shape)) for part in (dn, shot, floor)]
    alone = np.stack([used * (dn * weight)[..., None, :], *parts, np.broadcast_to(used, parts[0].shape)], -2)
    alone = np.concatenate([alone, np.repeat(alone[..., -1:], lacking, -1)], -1)
    alone[..., [0, 4], count:] = 0
    total, floors = used @ weight[..., None], used @ (weight**2 * floor)[..., None]
    beyond = np.concatenate([limit, np.full((*limit.shape[:2], 1), -np.inf)], -1)
    least = np.concatenate([np.zeros((*limit.shape[:2], 1)), floor * weight], -1)
    with np.errstate(divide="ignore"):
        sums = np.stack([1 / total[..., 0], total[..., 0], floors[..., 0], beyond, least], -1)
    return each.astype(np.float32), alone.astype(np.float32), sums.astype(np.float32), np.array(bounds)


def _bounds(frame: Exposed, shot: np.ndarray, floor: np.ndarray) -> tuple[float, float, float]:
    """DN below which no sample clips, from which on all do, a DN of rounding allowed for, and all are bright."""
    span = frame.white - frame.black
    level, bright = frame.limit * span + frame.black, merge_kernel.BRIGHT_RATIO * floor / shot * span + frame.black
    margin = 1e-6 * float(np.abs(level).max())
    return float(level.min()) - margin, float(level.max()) + margin, float(np.max(bright))


def _chi2_limits(frames: int) -> np.ndarray:
    """(frames + 1,) chi-square at GHOST_SIGMA of as many frames (Wilson and Hilferty 1931, within 2 % here)."""
    k = np.maximum(np.arange(frames + 1) - 1, 1)
    limits = k * (1 - 2 / (9 * k) + GHOST_SIGMA * np.sqrt(2 / (9 * k))) ** 3
    limits[:2] = np.inf  # one frame cannot disagree
    return limits.astype(np.float32)


def _mirror(index: np.ndarray, size: int) -> np.ndarray:
    """Index reflected at the ends, which keeps its CFA parity; clipped where the picture is smaller than that."""
    index = np.abs(index)
    return np.clip(np.where(index >= size, 2 * (size - 1) - index, index), 0, size - 1)


def replace_defects(merged: Merged) -> tuple[Merged, int]:
    """Hot and dead photosites replaced, in place, by the median of their same-colour neighbours and flagged HOT.

    Also how many. A defect stands out of all eight same-colour neighbours by HOT_SIGMA, while the adjacent photosites
    of the other colours show nothing: light, however small its source, is spread over several photosites by lens and
    filter. Weaker ones hide in texture: `defect_limit` says how weak.
    """
    radiance, variance = merged.radiance, merged.variance
    rows, columns = _outliers(radiance, variance)
    if not len(rows):
        return merged, 0
    excess, middle, spread = _excess(radiance, rows, columns)
    keep = _shown_beside(merged, rows, columns) < ISOLATION * np.abs(excess)
    rows, columns, middle, spread = rows[keep], columns[keep], middle[keep], spread[keep]
    radiance[rows, columns] = middle
    # 1.25^2 / 8: variance of the median of eight over theirs; the rest is how far a photosite lies from its neighbours
    variance[rows, columns] = spread * (1 + 1.25**2 / 8)
    merged.mask[rows, columns] = HOT
    return merged, len(rows)


def defect_limit(merged: Merged) -> float:
    """Excess, as a share of the signal, at which `replace_defects` finds a hot photosite in half of the places.

    From what it asks for at up to `LIMIT_PLACES` evenly spread photosites of a mosaic that are seen and sound; the shot
    noise of the excess itself is left out. NaN where there are none.
    """
    radiance, variance = merged.radiance, merged.variance
    height, width = radiance.shape
    step = max(1, radiance.size // LIMIT_PLACES)
    rows, columns = np.divmod(np.arange(0, radiance.size, step), width)
    rows, columns = (part[merged.mask[rows, columns] == 0] for part in (rows, columns))
    if not len(rows) or min(radiance.shape) < 5:
        return float("nan")
    around = [radiance[_mirror(rows + dy, height), _mirror(columns + dx, width)] for dy, dx in NEIGHBOURS]
    excess, middle, _ = _excess(radiance, rows, columns)
    beyond = np.max(around, 0) + HOT_SIGMA * np.sqrt(variance[rows, columns]) - middle
    needed = np.maximum(beyond, _shown_beside(merged, rows, columns) / ISOLATION)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(middle > 0, (needed - excess) / middle, np.inf)
    return float(np.median(share))


def _shown_beside(merged: Merged, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The largest excess that a photosite's neighbours of other colours show beyond three sigma; not below 0."""
    height, width = merged.radiance.shape
    worst = np.zeros(len(rows))
    for dy, dx in ADJACENT:
        y, x = _mirror(rows + dy, height), _mirror(columns + dx, width)
        beside = np.abs(_excess(merged.radiance, y, x)[0]) - 3 * np.sqrt(merged.variance[y, x])
        worst = np.maximum(worst, np.where(np.isfinite(beside), beside, np.inf))
    return worst


def _outliers(radiance: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of photosites beyond all same-colour neighbours by HOT_SIGMA; if many, those farthest beyond.

    Texture at the scale of photosites is full of them and none is a defect.
    """
    if min(radiance.shape) < 5:
        return np.zeros(0, int), np.zeros(0, int)
    beyond = np.zeros(radiance.shape, bool)
    _outlier_kernel()(radiance, variance, np.float32(HOT_SIGMA**2), beyond)
    rows, columns = np.nonzero(beyond)
    most = max(1000, round(MAX_SUSPECTS * radiance.size))
    if len(rows) > most:
        height, width = radiance.shape
        around = [radiance[_mirror(rows + dy, height), _mirror(columns + dx, width)] for dy, dx in NEIGHBOURS]
        value = radiance[rows, columns]
        gap = np.maximum(value - np.max(around, 0), np.min(around, 0) - value) / np.sqrt(variance[rows, columns])
        worst = gap > np.partition(gap, -most)[-most]
        rows, columns = rows[worst], columns[worst]
    return rows, columns


@functools.cache
def _outlier_kernel() -> Callable[..., None]:
    """`_mark_outliers`, compiled."""
    return machine_code.compiled(_mark_outliers, _column_extremes)


def _mark_outliers(radiance: np.ndarray, variance: np.ndarray, reach: float, beyond: np.ndarray) -> None:
    """Mark in ``beyond`` (H, W) what lies above or below its eight same-colour neighbours by root ``reach`` sigma."""
    height, width = radiance.shape
    low, high = np.empty(width + 4, np.float32), np.empty(width + 4, np.float32)  # of three rows, mirrored at the ends
    for y in range(height):
        above, own, below = radiance[abs(y - 2)], radiance[y], radiance[y + 2 if y + 2 < height else 2 * height - 4 - y]
        _column_extremes(above, own, below, low, high)
        west, east, middle, mark, noise = low[:width], low[4:], radiance[y], beyond[y], variance[y]
        west_high, east_high = high[:width], high[4:]
        for x in range(width):
            most = max(max(west_high[x], east_high[x]), max(above[x], below[x]))
            least = min(min(west[x], east[x]), min(above[x], below[x]))
            gap = max(max(middle[x] - most, least - middle[x]), np.float32(0))
            mark[x] = gap * gap > reach * noise[x]  # infinite where clipped: never


def _column_extremes(above: np.ndarray, own: np.ndarray, below: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Least and greatest of three rows (W,) by column, from the third element on."""
    width = len(own)
    inner_low, inner_high = low[2:], high[2:]
    for x in range(width):
        inner_low[x] = min(min(above[x], own[x]), below[x])
        inner_high[x] = max(max(above[x], own[x]), below[x])
    for x in range(2):
        for extremes in (low, high):
            extremes[x] = extremes[4 - x]
            extremes[width + 3 - x] = extremes[width - 1 + x]


def _excess(radiance: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At some pixels: value less the median of the same-colour neighbours, that median, the neighbours' variance."""
    height, width = radiance.shape
    around = np.stack(
        [radiance[_mirror(rows + dy, height), _mirror(columns + dx, width)] for dy, dx in NEIGHBOURS]
    ).astype(np.float64)
    middle = np.median(around, 0)
    return radiance[rows, columns] - middle, middle, around.var(0, ddof=1)
