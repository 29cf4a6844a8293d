"""Photosites that a file or the manifest names as defective: replaced from their neighbours, and flagged.

Those that nobody names are found by `pipeline.image.radiometry.replace_defects`.
"""

from __future__ import annotations

import warnings

import numpy as np

from pipeline.conventions import HOT


def replace_listed(radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray, sites: np.ndarray) -> int:
    """Replace ``sites`` (N, 2) row, column of a merged (H, W) or (H, W, 3) picture, in place; how many lie in it.

    By the median of the eight nearest samples of the same colour that are not listed themselves; the variance is their
    scatter. A site without any such neighbour keeps its value and gets an infinite variance.
    """
    height, width = radiance.shape[:2]
    inside = np.all((sites >= 0) & (sites < (height, width)), axis=1)
    rows, columns = np.unique(sites[inside], axis=0).reshape(-1, 2).T
    if not len(rows):
        return 0
    listed = np.zeros((height, width), bool)
    listed[rows, columns] = True
    step = 2 if radiance.ndim == 2 else 1
    around = []
    for dy, dx in [(dy, dx) for dy in (-step, 0, step) for dx in (-step, 0, step) if (dy, dx) != (0, 0)]:
        y, x = rows + dy, columns + dx
        there = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        y, x = np.where(there, y, 0), np.where(there, x, 0)
        good = (there & ~listed[y, x]).reshape(-1, *[1] * (radiance.ndim - 2))
        around.append(np.where(good, radiance[y, x], np.nan))
    values = np.stack(around).astype(np.float64)
    count = np.isfinite(values).sum(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of sites without a neighbour, which are handled below
        middle, spread = np.nanmedian(values, 0), np.nanvar(values, 0, ddof=1)
    known = count > 1
    radiance[rows, columns] = np.where(known, middle, radiance[rows, columns])
    # 1.25^2 / n: variance of a median over its samples'; the rest is how far a photosite lies from its neighbours
    variance[rows, columns] = np.where(known, spread * (1 + 1.25**2 / np.maximum(count, 1)), np.inf)
    mask[rows, columns] |= np.uint32(HOT)
    return len(rows)
