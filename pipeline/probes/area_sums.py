"""Integrals of a ball's picture over lat-long texels: an area splat that is exact, however small the pixels are.

Each pixel spreads its radiance over the solid angle it mirrors, and each texel collects what falls into it. The outline
of a texel, as the ball shows it, is a polygon in the picture. Its edges are replaced by stairs that keep its area, and
the sum of the pixels' ``L dw`` inside stairs is read off a summed-area table (Crow, Summed-area tables for texture
mapping, 1984), without any error but rounding. Two neighbours walk along the same stairs in opposite directions, so
what one loses the other gains: the sum over texels is the sum over pixels to rounding, for lamps of any size, on the
seam and at the poles. Near the rim texels are slanted slivers, and stairs of neighbours may cross: of light that is
nothing but lamps of one pixel 0.1 to 0.2 % comes out negative there; of smooth light nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from pipeline.image.machine_code import compiled
from pipeline.light.sampling import summed_areas
from pipeline.probes.mirror_geometry import BAND_PIXELS, BAND_TEXELS, WORKERS, Mirror, bands, pixel_solid_angles

STAIR = 0.5  # height of a stair over the texel's thickness
MOST_STEPS = 32  # stairs per edge, a power of two


def area_sums(
    channels: list[np.ndarray], mirror: Mirror, corners: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> np.ndarray:
    """Sums over texels (H, W, C), float32, of channel times solid angle [sr].

    ``channels``: (h, w) each, float32, finite. ``corners``: x, y and incidence (H + 1, W + 1) of the texels' corners,
    from `mirror_geometry.corners`. Texels whose corners all lie beyond the rim are zero. The result does not depend on
    the number of threads.
    """
    height, width = corners[0].shape[0] - 1, corners[0].shape[1] - 1
    size = np.pi / width * mirror.radius_px
    outside = corners[2] > np.arcsin(min(mirror.rim + 1 / mirror.radius_px, 0.5 + 0.5 * mirror.rim))  # pixels are wide
    outline = mirror.ends
    sums = np.zeros((height, width, len(channels)), np.float32)
    with ThreadPoolExecutor(WORKERS) as pool:
        _ = mirror.lens_nodes  # once, before the threads ask for it
        rows = list(bands(mirror.camera.height, BAND_PIXELS // mirror.camera.width))
        density = np.concatenate(list(pool.map(lambda block: pixel_solid_angles(mirror, block), rows)))
        product = np.zeros((*density.shape, 4), np.float32)
        table = np.empty((density.shape[0] + 1, density.shape[1] + 1, 4))
        for first in range(0, len(channels), 4):
            group = channels[first : first + 4]
            list(pool.map(lambda block, group=group: _fill(product[block], group, density, block), rows))
            summed_areas(product, table)
            work = [
                pool.submit(_band, table, corners, outside, outline, size, block, sums[block, :, first : first + 4])
                for block in bands(height, BAND_TEXELS // width)
            ]
            for job in work:
                job.result()
    return sums


def _fill(product: np.ndarray, group: list[np.ndarray], density: np.ndarray, block: slice) -> None:
    for i, channel in enumerate(group):
        np.multiply(channel[block], density[block], out=product[..., i])


def _band(
    table: np.ndarray, corners: tuple[np.ndarray, np.ndarray, np.ndarray], outside: np.ndarray, outline: np.ndarray,
    size: float, block: slice, out: np.ndarray,
) -> None:  # fmt: skip
    """Sums of the texels of some rows of the map, into ``out`` (n, W, C)."""
    lines = slice(block.start, block.stop + 1)
    x, y, away = corners[0][lines], corners[1][lines], outside[lines]
    dark = away[1:, 1:] & away[:-1, 1:] & away[1:, :-1] & away[:-1, :-1]
    if dark.all():
        return
    level = _edge_sums(table, x[:, :-1], y[:, :-1], x[:, 1:], y[:, 1:], away[:, :-1] & away[:, 1:], outline, size)
    upright = _edge_sums(table, x[:-1], y[:-1], x[1:], y[1:], away[:-1] & away[1:], outline, size)
    found = level[1:] - level[:-1] + upright[:, :-1] - upright[:, 1:]
    out[...] = np.where(dark[..., None], 0, found[..., : out.shape[2]])


def _edge_sums(
    table: np.ndarray, x0: np.ndarray, y0: np.ndarray, x1: np.ndarray, y1: np.ndarray, beyond: np.ndarray,
    outline: np.ndarray, size: float,
) -> np.ndarray:  # fmt: skip
    """What lies left of straight edges (N, M, 4); minus that where they run upwards.

    A stair must stay lower than the texel is thick, or it counts what the neighbour's neighbour holds. Where edges are
    long texels are thin: ``size**2`` over the length. Along rows and columns one stair is exact. Edges ``beyond`` the
    rim go around the ball instead.
    """
    x0, y0, x1, y1, beyond = (np.ascontiguousarray(part) for part in (x0, y0, x1, y1, beyond))
    total = np.zeros((*x0.shape, 4))
    _stairs_kernel()(table, x0.ravel(), y0.ravel(), x1.ravel(), y1.ravel(), beyond.ravel(), size, total.reshape(-1, 4))
    if beyond.any():
        total[beyond] = _around(table, x0[beyond], y0[beyond], x1[beyond], y1[beyond], outline)
    return total


def _around(
    table: np.ndarray, x0: np.ndarray, y0: np.ndarray, x1: np.ndarray, y1: np.ndarray, outline: np.ndarray
) -> np.ndarray:
    """What lies left (N, 4) of the way around the ball from one point outside to another, over the nearer end.

    ``outline`` (2, 2): x, y of the ball's highest and lowest point. On the left of the ball there is nothing; on its
    right there is the whole ball, down to the row.
    """
    (top_x, top_y), (low_x, low_y) = outline
    right = [x > top_x + (y - top_y) / (low_y - top_y) * (low_x - top_x) for x, y in ((x0, y0), (x1, y1))]
    last = np.float64(table.shape[1] - 1)
    start, end = (
        side[:, None] * _interpolated(table, np.full_like(y, last), y) for side, y in zip(right, (y0, y1), strict=True)
    )
    below = 0.5 * (y0 + y1) > 0.5 * (top_y + low_y)
    turns = below * (right[0].astype(float) - right[1])
    return end - start + turns[:, None] * table[-1, -1]


@functools.cache
def _stairs_kernel() -> Callable[..., None]:
    """`_stairs`, compiled."""
    return compiled(_stairs, _add)


def _stairs(
    table: np.ndarray, x0: np.ndarray, y0: np.ndarray, x1: np.ndarray, y1: np.ndarray, beyond: np.ndarray, size: float,
    total: np.ndarray,
) -> None:  # fmt: skip
    """Into ``total`` (N, 4): what lies left of edges that go straight up in the middle of each of their stairs."""
    for i in range(x0.size):
        if beyond[i]:
            continue
        dx, dy = x1[i] - x0[i], y1[i] - y0[i]
        if not np.isfinite(x0[i] + y0[i] + dx + dy):  # compiled code would read anywhere
            total[i] = np.nan
            continue
        needed = abs(dx) * abs(dy) / (STAIR * size * size)
        steps = 1
        while steps < needed and steps < MOST_STEPS:
            steps *= 2
        for k in range(steps):
            x = x0[i] + (k + 0.5) / steps * dx
            _add(table, x, y0[i] + (k + 1) / steps * dy, 1.0, total[i])
            _add(table, x, y0[i] + k / steps * dy, -1.0, total[i])


def _add(table: np.ndarray, x: float, y: float, sign: float, total: np.ndarray) -> None:
    """`_interpolated` at one place, times ``sign``, added to ``total`` (4,)."""
    x = min(max(x, 0.0), table.shape[1] - 1 - 1e-9)
    y = min(max(y, 0.0), table.shape[0] - 1 - 1e-9)
    column, row = int(x), int(y)
    right, down = x - column, y - row
    for c in range(4):
        above, below = table[row, column, c], table[row + 1, column, c]
        above += right * (table[row, column + 1, c] - above)
        below += right * (table[row + 1, column + 1, c] - below)
        total[c] += sign * (above + down * (below - above))


def _interpolated(table: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The table (N, 4) at pixels, bilinear in float64: OpenCV rounds positions in doubles to 1/32 px."""
    rows, columns = table.shape[:2]
    x, y = np.clip(x, 0, columns - 1 - 1e-9), np.clip(y, 0, rows - 1 - 1e-9)
    column, row = x.astype(np.intp), y.astype(np.intp)
    right, down = (x - column)[..., None], (y - row)[..., None]
    flat, index = table.reshape(-1, 4), row * columns + column
    above, below = flat.take(index, 0), flat.take(index + columns, 0)
    above += right * (flat.take(index + 1, 0) - above)
    below += right * (flat.take(index + columns + 1, 0) - below)
    below -= above
    below *= down
    above += below
    return above
