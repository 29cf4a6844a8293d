"""Where the objects change the photograph, and how finely that has to be computed.

A pilot estimates the change on cells of `CELL` pixels. Cells below the threshold are left to the plate. Where the
change, relative to LS_noobj, bends so little from cell to cell that linear interpolation errs by less than the
tolerance, the pilot itself is the answer (soft shadows far from the object are smooth); elsewhere every pixel is
traced.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.transport.trace import Samples

CELL = 8  # px
BLUR = 0.8  # cells: less noise for a bias of a third of the second difference, which the tolerance bounds
FEATHER = 2 * CELL  # px over which the change fades out at the border of the region
LEAST = 1e-4  # relative change below which a pilot's noise decides what is left out


@dataclass(frozen=True)
class Limits:
    """Relative to LS_noobj. ``threshold``: change left to the plate; ``tolerance``: error of interpolation;
    ``hidden``: the step that the photograph's noise hides.
    """

    threshold: float
    tolerance: float
    hidden: float


@dataclass(frozen=True, eq=False)
class Region:
    """Per pixel: ``weight`` (H, W) in [0, 1], 0 where the plate is left alone; ``traced`` (H, W) bool, every pixel
    computed; elsewhere the relative changes ``lost`` and ``gained`` (H, W, 3), interpolated, with ``variance``.
    """

    weight: np.ndarray
    traced: np.ndarray
    lost: np.ndarray
    gained: np.ndarray
    variance: np.ndarray

    @property
    def interpolated(self) -> np.ndarray:
        """(H, W) bool: changed, but smoothly."""
        return (self.weight > 0) & ~self.traced


def cell_pixels(height: int, width: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Flat index of the pixel in the middle of every cell, and the grid's size (rows, columns)."""
    rows = np.minimum(np.arange(CELL // 2, height + CELL // 2, CELL), height - 1)
    columns = np.minimum(np.arange(CELL // 2, width + CELL // 2, CELL), width - 1)
    return (rows[:, None] * width + columns).ravel(), (len(rows), len(columns))


def plan(
    pilot: Samples, model: np.ndarray, grid: tuple[int, int], shape: tuple[int, int], limits: Limits
) -> tuple[Region, dict[str, float]]:
    """Decide from a pilot on ``grid`` what to do with each of the ``shape`` (H, W) pixels.

    Args:
        pilot: samples of the cells, in rows.
        model: (cells, 3) expected LS_noobj of the cells.
        grid: rows and columns of cells.
        shape: (H, W) of the photograph.
        limits: what may be left out, and how far interpolation may err.

    Returns the region, and what of the change is left out: the largest, the noise of that figure, and the mean over the
    frame, relative to LS_noobj.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter

    usable = ((model > 0).all(1) & (pilot.ground > 0.5))[:, None]

    def field(values: np.ndarray) -> np.ndarray:
        return np.divide(values, model, out=np.zeros_like(values), where=usable).reshape(*grid, 3)

    lost, gained = field(pilot.lost), field(pilot.gained)
    variance = np.divide(pilot.change_variance, model**2, out=np.zeros_like(model), where=usable).reshape(*grid, 3)
    lost, gained = (gaussian_filter(values, (BLUR, BLUR, 0), mode="nearest") for values in (lost, gained))
    smoothed = gaussian_filter(lost + gained, (BLUR, BLUR, 0), mode="nearest")
    shown = pilot.alpha.reshape(grid) > 0
    changed = (np.abs(smoothed).max(-1) > limits.threshold) | shown
    changed = binary_dilation(changed, np.ones((5, 5)))
    rough = np.maximum(bend(lost), bend(gained)) > limits.tolerance
    rough |= shown | (pilot.ground.reshape(grid) < 1)
    traced = changed & binary_dilation(rough, np.ones((3, 3)))
    mask = enlarge(changed, shape)
    weight = np.ones(shape)
    left = {"left_out_max": 0.0, "left_out_noise": 0.0, "left_out_mean": 0.0}
    if not mask.all():
        ramp = np.clip(distance_transform_edt(mask) / FEATHER, 0, 1)
        weight = ramp * ramp * (3 - 2 * ramp)
        out = np.abs(smoothed[~changed])
        left = {
            "left_out_max": float(out.max()),
            "left_out_noise": float(np.sqrt(variance[~changed].max())),
            "left_out_mean": float(smoothed[~changed].sum() / smoothed.size),
        }
    smooth = [interpolate(values, shape) for values in (lost, gained, variance)]
    return Region(weight, enlarge(traced, shape) & (weight > 0), *smooth), left


def limits_for(plate: np.ndarray, variance: np.ndarray, threshold: float) -> Limits:
    """Limits under which nobody can see the region's border: tied to the photograph's own noise.

    A change that is cut off at the relative size t leaves a step of at most t between neighbouring cells, even without
    the feather. It is hidden when it is below a quarter of the noise of a cell's mean, sigma / CELL for the white noise
    of a photograph: t <= sigma / (4 CELL). The user's ``threshold`` only ever lowers it; below `LEAST` the pilot's own
    noise would decide.

    Args:
        plate: (H, W, 3) photograph.
        variance: (H, W, 3) of its noise; infinite where clipped.
        threshold: the most that may be left out, relative to LS_noobj.
    """
    known = np.isfinite(variance) & (variance > 0) & (plate > 0)
    sigma = np.sqrt(variance[known]) / plate[known]
    hidden = float(np.median(sigma)) / (4 * CELL) if sigma.size else threshold
    return Limits(min(threshold, max(hidden, LEAST)), threshold / 2, hidden)


def bend(values: np.ndarray) -> np.ndarray:
    """(R, C) bound on the error of linear interpolation between cells: an eighth of the second differences."""
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    down = np.abs(padded[:-2, 1:-1] - 2 * values + padded[2:, 1:-1])
    across = np.abs(padded[1:-1, :-2] - 2 * values + padded[1:-1, 2:])
    return (down + across).max(-1) / 8


def enlarge(cells: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cells (R, C) repeated to pixels (H, W)."""
    return np.repeat(np.repeat(cells, CELL, 0), CELL, 1)[: shape[0], : shape[1]]


def interpolate(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cells (R, C, K) to pixels (H, W, K), linear between the cells' middle pixels, constant beyond."""
    result = values
    for axis, size in enumerate(shape):
        count = values.shape[axis]
        middle = np.minimum(np.arange(count) * CELL + CELL // 2, size - 1)
        position = np.interp(np.arange(size), middle, np.arange(count))
        low = np.minimum(position.astype(int), max(count - 2, 0))
        share = (position - low).reshape([-1 if i == axis else 1 for i in range(3)])
        high = np.minimum(low + 1, count - 1)
        result = np.take(result, low, axis) * (1 - share) + np.take(result, high, axis) * share
    return result
