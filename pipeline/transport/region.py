"""Where the objects change the photograph, and how finely that has to be computed.

A pilot estimates the change on cells of `CELL` pixels. Cells below the threshold are left to the plate. Where the
change, relative to LS_noobj, bends so little from cell to cell that linear interpolation errs by less than the
tolerance, the pilot itself is the answer (soft shadows far from the object are smooth); elsewhere every pixel is
traced. The pilot itself looks twice: a glance at squares of four cells, and the whole only where blocks of 16 cells say
that something changes or bounding spheres that it may, so that a large photograph costs what its changed part does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.transport.scene import Worlds
from pipeline.transport.trace import Rays, Samples

CELL = 8  # px
GLANCE = 2  # cells, side of the squares that a glance looks at
BLOCK = 4  # cells, side of the blocks that a glance is judged on
BLUR = 0.8  # cells: less noise for a bias of a third of the second difference, which the tolerance bounds
BLUR_NOISE = 1 / (4 * np.pi * BLUR**2)  # variance after that blur over the variance before
FEATHER = 2 * CELL  # px over which the change fades out at the border of the region
LEAST = 1e-4  # relative change below which a pilot's noise decides what is left out
Window = tuple[slice, slice]  # rows and columns
WHOLE: Window = (slice(None), slice(None))


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
    """Per pixel of a window of the photograph, around which it is left alone: ``weight`` (h, w) in [0, 1], 0 where the
    plate is left alone; ``traced`` (h, w) bool, every pixel computed; elsewhere the relative changes ``lost`` and
    ``gained`` (h, w, 3), interpolated, with ``variance``.
    """

    window: Window
    weight: np.ndarray
    traced: np.ndarray
    lost: np.ndarray
    gained: np.ndarray
    variance: np.ndarray

    @property
    def interpolated(self) -> np.ndarray:
        """(h, w) bool: changed, but smoothly."""
        return (self.weight > 0) & ~self.traced

    def at(self, rows: np.ndarray, columns: np.ndarray, picture: np.ndarray) -> np.ndarray:
        """(N,) a picture (h, w) of the window at pixels of the photograph; zero outside the window."""
        places = [position - own.start for position, own in zip((rows, columns), self.window, strict=True)]
        inside = np.all([(p >= 0) & (p < size) for p, size in zip(places, picture.shape, strict=True)], axis=0)
        found = np.zeros(len(rows), picture.dtype)
        found[inside] = picture[places[0][inside], places[1][inside]]
        return found

    def __getitem__(self, part: Window) -> Region:
        """A part of the window."""
        (top, bottom, _), (left, right, _) = (
            inner.indices(size) for inner, size in zip(part, self.weight.shape, strict=True)
        )
        row, column = (outer.start for outer in self.window)
        window = slice(row + top, row + bottom), slice(column + left, column + right)
        return Region(window, *(values[part] for name, values in vars(self).items() if name != "window"))


def cell_pixels(height: int, width: int, side: int = CELL) -> tuple[np.ndarray, tuple[int, int]]:
    """Flat index of the pixel in the middle of every cell of ``side`` px, and the grid's size (rows, columns)."""
    rows = np.minimum(np.arange(side // 2, height + side // 2, side), height - 1)
    columns = np.minimum(np.arange(side // 2, width + side // 2, side), width - 1)
    return (rows[:, None] * width + columns).ravel(), (len(rows), len(columns))


def near_objects(worlds: Worlds, rays: Rays, side: int = CELL) -> np.ndarray:
    """(N,) bool: cells of ``side`` px that may show an object, or on the plane the shadow of one in an emitter's light.

    By the objects' bounding spheres, with a cell's width around them: what is too thin for few samples is in there.
    """
    length = np.linalg.norm(rays.centre, axis=1)
    unit = rays.centre / length[:, None]
    width = side * np.maximum(*(np.linalg.norm(by, axis=1) for by in (rays.by_x, rays.by_y))) / length  # [rad]
    toward = unit @ worlds.plane.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (worlds.plane.offset_m - rays.origin @ worlds.plane.normal) / toward
    meets = np.isfinite(distance) & (distance > 0)
    point = rays.origin + unit * np.where(meets, distance, 0)[:, None]
    foot = width * np.where(meets, distance / np.abs(np.where(meets, toward, 1)), 0)  # of a cell on the plane [m]
    near = np.zeros(len(rays), bool)
    for *centre, radius in worlds.bounds:
        offset = np.array(centre) - rays.origin
        along = unit @ offset
        aside = np.sqrt(np.maximum(offset @ offset - along**2, 0))
        near |= (along > -radius) & (aside <= radius + width * np.linalg.norm(offset))
        for lamp in (group.emitter for group in worlds.lights if group.emitter is not None):
            along = (np.array(centre) - point) @ lamp.direction
            aside = np.sqrt(np.maximum(((np.array(centre) - point) ** 2).sum(1) - along**2, 0))
            reach = radius + foot + np.tan(lamp.half_angle_rad) * np.maximum(along, 0)
            near |= meets & (along > -radius) & (aside <= reach)
    return near


def worth_a_look(
    glance: Samples, model: np.ndarray, grid: tuple[int, int], limits: Limits, near: np.ndarray
) -> np.ndarray:
    """(cells,) bool: the cells that need more than a glance.

    Blocks of `BLOCK` x `BLOCK` cells whose mean change is half the threshold or more, that show an object, or are
    ``near`` (cells,) one; and the blocks around them, so that a block that is left out has missed in nine.

    Args:
        glance: few samples of every cell, in rows.
        model: (cells, 3) expected LS_noobj of the cells.
        grid: rows and columns of cells.
        limits: what may be left out.
        near: from `near_objects`.
    """
    change = _relative(glance.lost + glance.gained, glance, model, grid)
    certain = ((glance.alpha > 0) | near).reshape(*grid, 1)
    wanted = (np.abs(block_means(change)) > limits.threshold / 2).any(-1) | (block_means(certain) > 0)[..., 0]
    return over_blocks(widened(wanted, 1), grid).ravel()


def block_means(cells: np.ndarray) -> np.ndarray:
    """(r, c, K) means of (R, C, K) over blocks of `BLOCK` x `BLOCK` cells, those at the right and lower border cut."""
    rows, columns = (np.arange(0, size, BLOCK) for size in cells.shape[:2])
    total = np.add.reduceat(np.add.reduceat(cells.astype(float), rows, 0), columns, 1)
    height, width = (
        np.diff(np.append(start, size)) for start, size in zip((rows, columns), cells.shape[:2], strict=True)
    )
    return total / (height[:, None] * width)[..., None]


def over_blocks(blocks: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Blocks (r, c, ...) repeated to cells (R, C, ...)."""
    return np.repeat(np.repeat(blocks, BLOCK, 0), BLOCK, 1)[: grid[0], : grid[1]]


def _usable(pilot: Samples, model: np.ndarray) -> np.ndarray:
    return np.asarray(((model > 0).all(1) & (pilot.ground > 0.5))[:, None])


def _relative(values: np.ndarray, pilot: Samples, model: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """(R, C, 3) values over LS_noobj, zero where that is not known."""
    return np.divide(values, model, out=np.zeros(values.shape), where=_usable(pilot, model)).reshape(*grid, 3)


def plan(
    pilot: Samples,
    model: np.ndarray,
    grid: tuple[int, int],
    shape: tuple[int, int],
    limits: Limits,
    glanced: np.ndarray | None = None,
) -> tuple[Region, dict[str, float]]:
    """Decide from a pilot on ``grid`` what to do with each of the ``shape`` (H, W) pixels.

    Args:
        pilot: samples of the cells, in rows.
        model: (cells, 3) expected LS_noobj of the cells.
        grid: rows and columns of cells.
        shape: (H, W) of the photograph.
        limits: what may be left out, and how far interpolation may err.
        glanced: (cells,) bool, the cells with so few samples that only the mean of their block says something.

    Returns the region, and what of the change is left out: the largest, the noise of that figure, and the mean over the
    frame, relative to LS_noobj.
    """
    lost, gained, variance = of_cells(pilot, model, grid, glanced)
    smoothed = blurred(lost + gained)
    shown = pilot.alpha.reshape(grid) > 0
    changed = (np.abs(smoothed).max(-1) > limits.threshold) | shown
    changed = widened(changed, 2)
    rough = np.maximum(bend(lost), bend(gained)) > limits.tolerance
    rough |= shown | (pilot.ground.reshape(grid) < 1)
    traced = changed & widened(rough, 1)
    left = {"left_out_max": 0.0, "left_out_noise": 0.0, "left_out_mean": 0.0}
    if not changed.all():
        out = np.abs(smoothed[~changed])
        left = {
            "left_out_max": float(out.max()),
            "left_out_noise": float(np.sqrt(variance[~changed].max())),
            "left_out_mean": float(smoothed[~changed].sum() / smoothed.size),
        }
    window = _around(changed, shape)
    mask = enlarge(changed, shape, window)
    ramp = np.clip(from_border(mask) / FEATHER, 0, 1)
    weight = np.asarray(ramp * ramp * (3 - 2 * ramp), np.float32)
    everywhere = enlarge(traced, shape, window) & (weight > 0)
    return Region(window, weight, everywhere, *in_pixels((lost, gained, variance), shape, window)), left


def of_cells(
    pilot: Samples, model: np.ndarray, grid: tuple[int, int], glanced: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lost and gained light, and the variance of their sum, each (R, C, 3), relative to LS_noobj; arguments of `plan`.

    Light is smoothed, the variance is that before smoothing.
    """
    lost, gained = (_relative(values, pilot, model, grid) for values in (pilot.lost, pilot.gained))
    variance = _relative(pilot.change_variance, pilot, model**2, grid)
    if glanced is not None and glanced.any():
        far = glanced.reshape(*grid, 1)
        lost, gained = (np.where(far, over_blocks(block_means(values), grid), values) for values in (lost, gained))
        variance = np.where(far, over_blocks(block_means(variance), grid) / (BLOCK / GLANCE) ** 2, variance)
    return blurred(lost), blurred(gained), variance


def blurred(cells: np.ndarray) -> np.ndarray:
    """Cells (R, C, K) smoothed by a Gaussian of `BLUR`, out to four standard deviations, constant beyond the frame."""
    import cv2

    size = 2 * round(4 * BLUR) + 1
    return np.asarray(cv2.GaussianBlur(cells, (size, size), BLUR, borderType=cv2.BORDER_REPLICATE))


def widened(cells: np.ndarray, by: int) -> np.ndarray:
    """(R, C) bool: cells that are True, and those around them, ``by`` in every direction."""
    import cv2

    square = np.ones((2 * by + 1, 2 * by + 1), np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), square) > 0)


def from_border(mask: np.ndarray) -> np.ndarray:
    """(h, w) distance [px] of every pixel of a mask to the nearest that is not in it; infinite without any."""
    import cv2

    if mask.all():
        return np.full(mask.shape, np.inf)
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))


def in_pixels(cells: tuple[np.ndarray, ...], shape: tuple[int, int], window: Window) -> list[np.ndarray]:
    """Cells (R, C, K), each interpolated to the picture (h, w, K) float32 of a window."""
    return [np.asarray(interpolate(values, shape, window), np.float32) for values in cells]


def _around(cells: np.ndarray, shape: tuple[int, int]) -> Window:
    """Rows and columns of pixels around the cells (R, C) that are True, with two cells' margin."""
    if not cells.any():
        return slice(0, 0), slice(0, 0)
    found = []
    for axis, size in enumerate(shape):
        there = np.flatnonzero(cells.any(1 - axis))
        found.append(slice(max(there[0] - 2, 0) * CELL, min((there[-1] + 3) * CELL, size)))
    return found[0], found[1]


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


def enlarge(cells: np.ndarray, shape: tuple[int, int], window: Window = WHOLE) -> np.ndarray:
    """Cells (R, C) repeated to the pixels of a window of (H, W)."""
    rows, columns = (np.arange(size)[part] // CELL for size, part in zip(shape, window, strict=True))
    return np.take(np.take(cells, rows, 0), columns, 1)


def interpolate(values: np.ndarray, shape: tuple[int, int], window: Window = WHOLE) -> np.ndarray:
    """Cells (R, C, K) to the pixels of a window of (H, W, K), linear between cells' middle pixels, constant beyond."""
    result = values
    for axis, (size, part) in enumerate(zip(shape, window, strict=True)):
        count = values.shape[axis]
        middle = np.minimum(np.arange(count) * CELL + CELL // 2, size - 1)
        position = np.interp(np.arange(size)[part], middle, np.arange(count))
        low = np.minimum(position.astype(int), max(count - 2, 0))
        share = (position - low).reshape([-1 if i == axis else 1 for i in range(3)])
        high = np.minimum(low + 1, count - 1)
        result = np.take(result, low, axis) * (1 - share) + np.take(result, high, axis) * share
    return result
