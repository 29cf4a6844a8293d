"""Relative exposure of the views of one probe.

Views are compared on cells of 11 degrees, on which lamps that moved, noise and small errors of direction are outliers
or average away. Ratios of all overlapping pairs are solved together by weighted least squares on log exposure, the
first view held.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pipeline.conventions import latlong_solid_angles
from pipeline.light.environment import resize_environment
from pipeline.probes.observation import ViewMap

CELL_ROWS = 16  # rows of the grid on which exposures are compared: cells of 11 degrees
LEAST_CELLS = 8
SIGNIFICANT = 3.0  # standard deviations, for a ratio of exposures to be believed
GOOD = 0.1  # of a view's best precision: there it is compared
DETAIL_RAD = 0.02  # finer displacements than this cost nothing on cells this wide


@dataclass(frozen=True)
class Pair:
    """``other / reference`` in radiance: ln ratio, its standard uncertainty, and the median disagreement of cells."""

    log: float
    sigma: float
    disagreement: float


@dataclass(frozen=True)
class Levels:
    """ln exposure of every view over the first's (V,), covariance (V, V), zeros for the first; infinite when untied.

    ``pairs``: measured ratios by view indices; ``chi2``: of the loops they close, over their number, NaN without.
    """

    log: np.ndarray
    covariance: np.ndarray
    pairs: dict[tuple[int, int], Pair]
    chi2: float


def level(views: list[ViewMap]) -> Levels:
    """Exposure of all views against the first from every pair that overlaps.

    A view that no chain of pairs ties to the first keeps ln ratio 0 with infinite variance. Where loops disagree by
    more than their uncertainty, the covariance is scaled up to it (Birge 1932).
    """
    pairs = {
        (i, j): pair
        for i, j in combinations(range(len(views)), 2)
        if (pair := relative_exposure(views[i], views[j])) is not None
    }
    tied = _reachable(len(views), pairs)
    free = [i for i in range(1, len(views)) if i in tied]
    log, covariance = np.zeros(len(views)), np.diag([0.0 if i in tied else np.inf for i in range(len(views))])
    used = [(i, j) for i, j in pairs if i in tied]
    chi2 = np.nan
    if free:
        design = np.array([[float(k == j) - float(k == i) for k in free] for i, j in used])
        sigma = np.array([pairs[p].sigma for p in used])
        measured = np.array([pairs[p].log for p in used])
        precision_of = np.linalg.inv(_shared_errors(used, sigma, len(views)))
        inverse = np.linalg.inv(design.T @ precision_of @ design)
        log[free] = inverse @ design.T @ precision_of @ measured
        loops = len(used) - len(free)
        if loops:
            left = measured - design @ log[free]
            chi2 = float(left @ precision_of @ left / loops)
        covariance[np.ix_(free, free)] = inverse * (max(1.0, chi2) if loops else 1.0)
    return Levels(log, covariance, pairs, chi2)


def _shared_errors(pairs: list[tuple[int, int]], sigma: np.ndarray, count: int) -> np.ndarray:
    """Covariance (P, P) of measured log ratios: two thirds of a variance are its two views', and return in their other
    ratios; one third is the pair's own (its cells). Taken as independent, redundant pairs would promise too much.
    """
    signs = np.zeros((len(pairs), count))
    for row, (i, j) in enumerate(pairs):
        signs[row, [i, j]] = -1, 1
    return np.outer(sigma, sigma) * (signs @ signs.T / 3 + np.eye(len(pairs)) / 3)


def _reachable(count: int, pairs: dict[tuple[int, int], Pair]) -> set[int]:
    """Indices of the views that chains of pairs join to the first."""
    tied = {0}
    for _ in range(count):
        tied |= {k for pair in pairs for k in pair if set(pair) & tied}
    return tied


def relative_exposure(reference: ViewMap, other: ViewMap) -> Pair | None:
    """Robust ratio ``other / reference`` on cells that both views see well; None where fewer than eight are shared.

    Median of log ratios weighted by solid angle; its uncertainty is that of a median of independent cells of the
    spread that the median absolute deviation gives, with Student's factor for so few.
    """
    shared = np.minimum(trust(reference), trust(other))
    height, width = CELL_ROWS, 2 * CELL_ROWS
    area = resize_environment(shared[..., None], height, width)[..., 0]
    means = [resize_environment(view.rgb * shared[..., None], height, width).mean(-1) for view in (reference, other)]
    good = (area > 0.5) & (means[0] > 0) & (means[1] > 0)
    if good.sum() < LEAST_CELLS:
        return None
    logarithm = np.log(means[1][good] / means[0][good])
    weight = (latlong_solid_angles(height, width) * area)[good]
    centre = _weighted_median(logarithm, weight)
    disagreement = _weighted_median(np.abs(logarithm - centre), weight)
    effective = weight.sum() ** 2 / (weight**2).sum()
    sigma = 1.2533 * 1.4826 * disagreement / np.sqrt(max(effective - 1, 1))
    return Pair(float(centre), float(max(sigma, 1e-6)), float(disagreement))


def precision(view: ViewMap) -> np.ndarray:
    """How well a view knows what it sees (H, W): trust over the variance of its direction."""
    sigma = np.broadcast_to(view.quality.sigma_rad if view.quality else 0.0, view.weight.shape)
    return np.where(np.isfinite(sigma), view.weight / (DETAIL_RAD**2 + np.where(np.isfinite(sigma), sigma, 0) ** 2), 0)


def trust(view: ViewMap) -> np.ndarray:
    """1 where a view is at least a tenth as good as at its best."""
    quality = precision(view)
    return np.asarray(quality > GOOD * quality.max(), float)


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
