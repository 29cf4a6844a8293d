"""Whether two photographs show one view, whatever their exposures: compared block by block through the tone curve
that fits them best.

Of two pictures of one thing one is a rising function of the other; the function is the running median, and nothing
need be known of exposure, response or white balance. What is left of the logarithms beside it is noise where the view
is the same, a compact region where something was put down or taken away, and everything where the view is another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.capture.photographs import Photo

CELLS = 160  # along the longer side
BINS = 16  # of the tone curve
LEAST_CELLS = 150  # well exposed in both, to tell anything
GLANCE = 0.2  # likeness of every ninth cell below which two views are others
LEAST_RANGE = 0.05  # robust spread of ln light below which a picture is blank
MAX_CELL_SIGMA = 0.12  # of ln light, of cells that are compared
DEVIATION, SIGMAS = 0.12, 5.0  # a cell is changed beyond both
SAME, OTHER = 0.8, 0.5  # of the likeness: at least and at most
MOST_CHANGED = 0.25  # of the cells compared, in one view
OVEREXPOSED = 0.3  # share of clipped cells from which it counts which cells clip, not how bright the others are
TEXTURE = 0.35  # of ln light within a cell: whether a sample of it clips is known no better
REACH = 0.06  # of the longer side: how far a camera in the hand may have moved


@dataclass(frozen=True, eq=False)
class Cells:
    """A photograph in CELLS along its longer side: ln light (h, w), its standard error, and which cells tell.

    ``clipped`` (h, w): a sample of the cell clips, so its light is a lower bound.
    """

    log: np.ndarray
    sigma: np.ndarray
    usable: np.ndarray
    clipped: np.ndarray

    def at(self, index: Any) -> Cells:
        """The cells of an index."""
        return Cells(self.log[index], self.sigma[index], self.usable[index], self.clipped[index])


@dataclass(frozen=True, eq=False)
class Likeness:
    """Of two pictures: cells compared, likeness (1: one is a function of the other; 0: unrelated), which cells changed.

    ``curve``: median of ln(second / first) over the cells. ``shift``: (x, y) cells by which the second was moved.
    ``rough``: told by which cells clip alone.
    """

    cells: int
    value: float
    changed: np.ndarray  # (h, w) bool
    curve: float
    shift: tuple[int, int] = (0, 0)
    rough: bool = False

    @property
    def blob(self) -> int:
        """Cells of the largest connected region that changed."""
        from scipy.ndimage import label

        return int(np.bincount(label(self.changed)[0].ravel())[1:].max(initial=0))

    @property
    def same_view(self) -> bool:
        """Whether the two look from one place to one place."""
        return self.cells >= LEAST_CELLS and self.value >= SAME and self.changed.sum() < MOST_CHANGED * self.cells

    @property
    def other_view(self) -> bool:
        """Whether they certainly do not."""
        return self.cells >= LEAST_CELLS and self.value <= OTHER


def cells_of(photo: Photo) -> Cells:
    """The photograph in cells of whole blocks."""
    grey = photo.rgb.mean(-1)
    side = max(1, round(max(grey.shape) / CELLS))
    height, width = (n // side for n in grey.shape)
    cut = (slice(height * side), slice(width * side))
    blocks = grey[cut].reshape(height, side, width, side)
    mean = blocks.mean((1, 3), dtype=np.float64)
    clipped = photo.clipped[cut].reshape(height, side, width, side).any((1, 3))
    safe = np.maximum(mean, 1e-6)
    black = 0.5 / (photo.frame.white - float(photo.frame.black.mean()))
    variance = np.maximum(photo.sigma(safe) ** 2 - black**2, 0) / side**2 + black**2  # noise averages, black does not
    sigma = np.sqrt(variance) / safe
    return Cells(np.log(safe), sigma, np.asarray(~clipped & (mean > 0) & (sigma < MAX_CELL_SIGMA)), np.asarray(clipped))


def compare(first: Cells, second: Cells, shift: tuple[int, int] = (0, 0)) -> Likeness:
    """Likeness of two pictures of one size, the second moved back by ``shift`` (x, y) cells."""
    moved = second if shift == (0, 0) else _moved(second, shift)
    sigma = np.hypot(first.sigma, moved.sigma)
    ordered = (first, moved) if first.clipped.mean() <= moved.clipped.mean() else (moved, first)
    if max(first.clipped.mean(), moved.clipped.mean()) > OVEREXPOSED:
        if min(first.clipped.mean(), moved.clipped.mean()) > OVEREXPOSED:
            return Likeness(0, 0.0, np.zeros(first.usable.shape, bool), 0.0, shift)
        return _compare_clipped(*ordered, shift)
    usable = first.usable & moved.usable & (sigma < 1.5 * MAX_CELL_SIGMA)
    count = int(usable.sum())
    nothing = np.zeros(usable.shape, bool)
    if count < BINS:
        return Likeness(count, 0.0, nothing, 0.0, shift)
    one, other = first.log[usable], moved.log[usable]
    noise = float(np.median(sigma[usable]))
    ranges = [float(_spread(values)) for values in (one, other)]
    if min(ranges) < max(LEAST_RANGE, 2 * noise):  # blank, or nothing but noise
        return Likeness(0, 0.0, nothing, float(np.median(other - one)), shift)
    left = other - curve_of(one, other)
    spread = float(_spread(left))
    value = 1 - max(spread - 2 * noise, 0.0) / ranges[1]
    changed = nothing.copy()
    changed[usable] = np.abs(left) > np.maximum(DEVIATION, SIGMAS * np.maximum(sigma[usable], spread))
    return Likeness(count, value, compact(changed), float(np.median(other - one)), shift)


def _compare_clipped(one: Cells, other: Cells, shift: tuple[int, int]) -> Likeness:
    """Likeness to an overexposed picture: in one view just the cells above some brightness clip in it."""
    told = one.usable & (other.clipped | other.usable)
    log, clips = one.log[told], other.clipped[told]
    share = float(clips.mean()) if told.any() else 0.0
    nothing = np.zeros(told.shape, bool)
    if not told.sum() * min(share, 1 - share) > BINS:
        return Likeness(0, 0.0, nothing, 0.0, shift)
    edge = float(np.quantile(log, 1 - share))
    gap = np.where(clips, edge - log, log - edge)  # above zero: on the wrong side
    value = 1 - float(np.mean(gap > DEVIATION)) / (2 * share * (1 - share))
    changed = nothing.copy()
    changed[told] = gap > TEXTURE
    return Likeness(int(told.sum()), value, compact(changed), 0.0, shift, True)


def curve_of(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The tone curve at ``one`` (N,): running median of ``other`` (N,) over bins of equal count, never falling."""
    order = np.argsort(one, kind="stable")
    parts = np.array_split(order, BINS)
    x = np.array([np.median(one[part]) for part in parts])
    y = np.maximum.accumulate([np.median(other[part]) for part in parts])
    slope = [(y[1] - y[0]) / max(x[1] - x[0], 1e-3), (y[-1] - y[-2]) / max(x[-1] - x[-2], 1e-3)]
    low, high = (float(np.clip(value, 0.3, 3)) for value in slope)
    inside = np.interp(one, x, y)
    below, above = np.minimum(one - x[0], 0), np.maximum(one - x[-1], 0)
    return np.asarray(inside + low * below + high * above)


def compact(changed: np.ndarray) -> np.ndarray:
    """Changed cells (h, w) that lie in a whole 2 x 2 of them: edges that moved a little and single cells go."""
    padded = np.pad(changed, 1)
    squares = padded[:-1, :-1] & padded[1:, :-1] & padded[:-1, 1:] & padded[1:, 1:]
    return np.asarray(squares[:-1, :-1] | squares[1:, :-1] | squares[:-1, 1:] | squares[1:, 1:])


def compare_moved(first: Cells, second: Cells) -> Likeness:
    """Likeness when the camera may have moved a little: the whole-cell shift with the best likeness."""
    glance = compare(first.at(np.s_[::3, ::3]), second.at(np.s_[::3, ::3]))
    if 9 * glance.cells > 4 * LEAST_CELLS and glance.value < GLANCE:
        return replace(glance, cells=9 * glance.cells, changed=np.zeros(first.log.shape, bool))
    still = compare(first, second)
    if still.same_view or still.cells < LEAST_CELLS:
        return still
    found = compare(first, second, cell_shift(first, second))
    return found if found.value > still.value else still


def cell_shift(first: Cells, second: Cells) -> tuple[int, int]:
    """Shift (x, y) of the second in cells: peak of the correlation of the two logarithms' details."""
    from scipy.ndimage import gaussian_filter

    details = []
    for cells in (first, second):
        filled = np.where(cells.usable, cells.log, np.median(cells.log[cells.usable]) if cells.usable.any() else 0)
        detail = filled - gaussian_filter(filled, 6)
        details.append(np.where(first.usable & second.usable, np.clip(detail, -0.5, 0.5), 0))
    spectra = [np.fft.rfft2(np.pad(detail, [(0, n) for n in detail.shape])) for detail in details]
    correlation = np.fft.irfft2(spectra[0].conj() * spectra[1], [2 * n for n in details[0].shape])
    reach = max(2, round(REACH * max(details[0].shape)))
    around = np.roll(correlation, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    row, column = np.unravel_index(int(around.argmax()), around.shape)
    return int(column) - reach, int(row) - reach


def _moved(cells: Cells, shift: tuple[int, int]) -> Cells:
    """Cells as they lie when a shift is taken back; what comes from outside tells nothing."""
    x, y = shift
    height, width = cells.log.shape
    rows, columns = np.arange(height) + y, np.arange(width) + x
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    grid = np.ix_(np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1))
    found = cells.at(grid)
    return replace(found, usable=found.usable & inside, clipped=found.clipped & inside)


def _spread(values: np.ndarray) -> np.ndarray:
    """Robust standard deviation: 1.4826 times the median absolute deviation."""
    return 1.4826 * np.median(np.abs(values - np.median(values)))


def relative_exposures(photos: Sequence[Photo], cells: Sequence[Cells]) -> list[float]:
    """Exposures of frames of one view: their labels, or where one lacks it, ratios measured along the brightness."""
    labels = [photo.exposure for photo in photos]
    if min(labels) > 0:
        return labels
    order = np.argsort([float(np.mean(photo.rgb)) for photo in photos], kind="stable")
    found = [1.0] * len(photos)
    for before, here in pairwise(order.tolist()):
        likeness = compare(cells[before], cells[here])
        found[here] = found[before] * float(np.exp(max(likeness.curve, 0.0)))
    return found
