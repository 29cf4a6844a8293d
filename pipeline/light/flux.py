"""Fluxes of lamps from what they do to surfaces: weighted least squares with lower bounds, errors, and condition.

Two kinds of evidence, any number of rows. A shadow: the ratio of the irradiance with a blocker to that without, which
needs no albedo, ``r = g E(x) / E`` as `pipeline.light.ball_shadow` has it; g is the exposure of one photograph over the
other, solved too; so are, in units of their prior sigma, other things that the shadow hangs on. A surface of known
albedo: ``sum_k c_k Phi_k = E_measured - E_sky``. The ratio is linearised about the current fluxes (Gauss-Newton), so
that its noise does not enter the matrix and bias the fluxes; every step is a bounded linear problem
(`scipy.optimize.lsq_linear`; with the bound at zero, NNLS).

Errors: residuals of a shadow are correlated, as what the model lacks is smooth. Their covariance is that of clusters of
neighbouring points (Liang and Zeger, Biometrika 73, 1986), or the photographs' noise if that is larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.light.ball_shadow import Reach

STEPS = 60  # from far below the step only doubles a flux
CONVERGED = 1e-6
EXPOSURE_SIGMA = 0.05  # prior of ln g: labels of exposure are wrong by percents
HUBER = 3.0  # residuals over so many sigma count linearly, not squared: a moved thing is not light


@dataclass(frozen=True)
class Shadow:
    """Ratios (N, 3) with sigma (N, 3) at points, what reaches them, and the cluster (N,) of each point.

    ``known`` (J, 3): fluxes of the lamps of ``reach`` that come after those to be solved for. ``moved``: what would
    reach the points if one uncertain thing, the ball's place say, were off by its standard deviation; one for each.
    """

    ratio: np.ndarray
    sigma: np.ndarray
    reach: Reach
    cluster: np.ndarray
    known: np.ndarray
    moved: tuple[Reach, ...] = ()


@dataclass(frozen=True)
class Card:
    """Surfaces of known albedo: irradiance (M, 3) with sigma (M, 3), that of the sky (M, 3), lamps' cosines (M, K)."""

    irradiance: np.ndarray
    sigma: np.ndarray
    sky: np.ndarray
    cosine: np.ndarray

    @staticmethod
    def measured(
        irradiance: np.ndarray, sigma: np.ndarray, normal: np.ndarray, sky: np.ndarray, directions: np.ndarray
    ) -> Card:
        """From measured irradiance (M, 3) with sigma (M, 3), unit normals (M, 3), the sky's irradiance (M, 3) there."""
        facing = np.maximum(np.atleast_2d(normal) @ np.reshape(directions, (-1, 3)).T, 0)
        return Card(np.atleast_2d(irradiance), np.atleast_2d(sigma), np.atleast_2d(sky), facing)


@dataclass(frozen=True)
class Fluxes:
    """Solved fluxes (K, 3), their covariance (3, K, K), and what it rests on.

    ``condition`` (3,): of the weighted columns at unit length; ``weakest`` (3, K): right singular vector of the least
    singular value, fluxes only; ``exposure`` (3,): g; ``chi2`` (3,): per degree of freedom of the shadow's points;
    ``residual`` (N, 3): measured minus predicted ratio.
    """

    value: np.ndarray
    covariance: np.ndarray
    condition: np.ndarray
    weakest: np.ndarray
    exposure: np.ndarray
    chi2: np.ndarray
    residual: np.ndarray


def predicted(reach: Reach, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratio (N, 3) for fluxes (K, 3), and its derivative (N, K, 3), the lamps' shares in ``lost`` held."""
    total = reach.free + reach.cosine @ flux
    share = reach.cosine[:, None] * flux / total
    light = reach.sky + np.einsum("nkc,kc->nc", reach.lamp, flux) - np.einsum("nkc,kc->nc", reach.lost, share)
    ratio = (light - reach.lost_sky * (1 - share.sum(0))) / total
    own = reach.lamp - (reach.lost - reach.lost_sky[:, None]) * (reach.cosine[:, None] / total)
    return ratio, (own - ratio[:, None] * reach.cosine[:, None]) / total


def solve(shadow: Shadow | None, card: Card | None, bound: np.ndarray) -> Fluxes:
    """Fluxes not below ``bound`` (K, 3), channel by channel. At least one kind of evidence must be given."""
    channels = [_channel(shadow, card, bound, c) for c in range(3)]
    value, covariance, condition, weakest, exposure, chi2, residual = zip(*channels, strict=True)
    return Fluxes(
        np.stack(value, -1), np.stack(covariance), np.array(condition), np.stack(weakest), np.array(exposure),
        np.array(chi2), np.stack(residual, -1),
    )  # fmt: skip


def _channel(
    shadow: Shadow | None, card: Card | None, bound: np.ndarray, c: int
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, float, float, np.ndarray]:
    from scipy.optimize import lsq_linear

    count, extra = len(bound), 1 + (len(shadow.moved) if shadow else 0)
    low = np.concatenate([bound[:, c], np.full(extra, -np.inf)])
    state = np.concatenate([np.maximum(bound[:, c], 1e-12), np.zeros(extra)])  # fluxes, ln g, what else is uncertain
    for outliers_count_less in (False, True):  # far from the answer everything is an outlier
        for _ in range(STEPS):
            matrix, gap, _, weight = _rows(shadow, card, state, bound, c)
            root = np.sqrt(weight) if outliers_count_less else np.ones(len(weight))
            scale = np.linalg.norm(matrix, axis=0)
            scale = np.where(scale > 0, scale, 1)
            limits = ((low - state) * scale, np.full(count + extra, np.inf))
            step = lsq_linear(matrix / scale * root[:, None], gap * root, limits, method="bvls").x / scale
            state = np.maximum(state + step, low)
            if np.all(np.abs(step[:count]) <= CONVERGED * np.maximum(state[:count], 1e-300)):
                break
    matrix, gap, cluster, robust = _rows(shadow, card, state, bound, c)
    covariance = _covariance(matrix, gap, cluster, robust)
    scale = np.linalg.norm(matrix[:, :count], axis=0)
    others = np.maximum(np.linalg.norm(matrix[:, count:], axis=0), 1e-300)
    scaled = matrix / np.concatenate([np.where(scale > 0, scale, np.inf), others])
    _, singular, right = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
    told = len(singular) == len(right) and singular[-1] > 0
    condition = float(singular[0] / singular[-1]) if told else np.inf
    points = len(shadow.ratio) if shadow else 0
    dof = max(points - int((scale > 0).sum()) - 1, 1)
    chi2 = float((robust[:points] * gap[:points] ** 2).sum() / dof)
    residual = gap[:points] * (shadow.sigma[:, c] if shadow else 1.0)
    return (
        state[:count], covariance[:count, :count], condition, right[-1, :count], float(np.exp(state[count])), chi2,
        residual,
    )  # fmt: skip


def _rows(
    shadow: Shadow | None, card: Card | None, state: np.ndarray, bound: np.ndarray, c: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Matrix (M, P) and gap (M,) in sigmas about ``state``, cluster (M,), and robust weight (M,) of each row."""
    count, extra = len(bound), len(state) - len(bound)
    blocks, gaps, clusters = [], [], []
    points = 0
    if shadow is not None:
        flux = bound.copy()
        flux[:, c] = state[:count]
        flux = np.concatenate([flux, shadow.known])
        ratio, slope = (part[..., c] for part in predicted(shadow.reach, flux))
        steps = [predicted(reach, flux)[0][:, c] - ratio for reach in shadow.moved]
        ratio = ratio + sum((t * step for t, step in zip(state[count + 1 :], steps, strict=True)), np.zeros(len(ratio)))
        g, sigma = np.exp(state[count]), shadow.sigma[:, c]
        blocks.append(g * np.column_stack([slope[:, :count], ratio, *steps]) / sigma[:, None])
        gaps.append((shadow.ratio[:, c] - g * ratio) / sigma)
        clusters.append(shadow.cluster)
        points = len(sigma)
    if card is not None:
        sigma = card.sigma[:, c]
        blocks.append(np.column_stack([card.cosine, np.zeros((len(sigma), extra))]) / sigma[:, None])
        gaps.append((card.irradiance[:, c] - card.sky[:, c] - card.cosine @ state[:count]) / sigma)
        clusters.append(-1 - np.arange(len(sigma)))
    prior = np.diag(1 / np.array([EXPOSURE_SIGMA, *np.ones(extra - 1)]))
    blocks.append(np.column_stack([np.zeros((extra, count)), prior]))
    gaps.append(-prior @ state[count:])
    clusters.append(-(10**9) - np.arange(extra))
    gap = np.concatenate(gaps)
    robust = np.ones(len(gap))
    if points:
        spread = max(1.4826 * float(np.median(np.abs(gap[:points]))), 1.0)
        robust[:points] = np.minimum(1, HUBER * spread / np.maximum(np.abs(gap[:points]), 1e-12))
    return np.concatenate(blocks), gap, np.concatenate(clusters), robust


def _covariance(matrix: np.ndarray, gap: np.ndarray, cluster: np.ndarray, robust: np.ndarray) -> np.ndarray:
    """(P, P): of clustered residuals, or of the rows' own noise where that is larger (variance by variance)."""
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 0, scale, 1)
    matrix = matrix / scale  # fluxes and exposures differ by orders of magnitude, which is no rank deficiency
    bread = np.linalg.pinv((matrix * robust[:, None]).T @ matrix)
    label, index = np.unique(cluster, return_inverse=True)
    score = np.zeros((len(label), matrix.shape[1]))
    np.add.at(score, index, matrix * (robust * gap)[:, None])
    small = len(label) / max(len(label) - matrix.shape[1], 1)
    clustered = bread @ (score.T @ score * small) @ bread
    grow = np.sqrt(np.maximum(np.diag(clustered) / np.maximum(np.diag(bread), 1e-300), 1))
    return np.asarray(bread * np.outer(grow / scale, grow / scale))
