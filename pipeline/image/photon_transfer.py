"""Photon transfer on a bracket: the noise of a sensor from pairs of frames of one scene.

The variance of ``short - ratio * long`` is free of the scene and of each photosite's gain (PRNU), and linear in the
signal: ``shot * (ratio^2 s + gain ratio s) + floor * (ratio^2 + gain^2)``, with s the signal of the long frame and gain
the ISO of the short frame over the long one's. Samples are put into bins by the mean of their neighbours of the same
colour in the row, in both frames, so that a sample's own noise does not choose its bin.

Source: Janesick, Photon Transfer, 2007; variance of a sample variance by the fourth moment.
Limits: what moves by less than the outlier cut, or flickers, adds a term with the square of the signal; it is fitted
where it shows at three sigma. Interpolated data (demosaicked) have less noise from sample to sample than a sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.image.noise import Noise

MIN_BIN = 200  # samples in a bin: its variance is then known to 10 %
MAX_SAMPLES = 60_000  # of one pair of frames and colour
OUTLIERS = 5.0  # in robust standard deviations: motion, hot photosites, edges
EDGES = np.concatenate([[-np.inf], np.geomspace(2e-4, 1.0, 25)])
LEAST_ERROR = 1e-3  # relative, of a bin's variance, however alike its samples
EVIDENCE = 3.0  # sigmas at which a further term, or a gain per colour, is believed


@dataclass(frozen=True)
class Bin:
    """One measurement: ``variance = shot * signal_term + floor * floor_term + excess * square_term``."""

    cell: int  # index into a ravelled (2, 2) or (1, 3) array
    signal_term: float
    floor_term: float
    square_term: float
    variance: float
    sigma: float  # standard uncertainty of ``variance``


def transfer_bins(
    long: np.ndarray, short: np.ndarray, ratio: float, limit: float, step: float, cell: int = 0, gain: float = 1.0
) -> list[Bin]:
    """Photon-transfer bins of two frames of one scene, samples of one colour.

    ``long``, ``short``: normalised signals (h, w), neighbours in a row being neighbours of one colour; ``ratio``:
    exposure of short over long; samples at ``limit`` and near it are left out; ``step`` is one DN.
    """
    if min(long.shape) < 1 or long.shape[1] < 3:
        return []
    rows = slice(None, None, max(1, long.size // MAX_SAMPLES))
    a, b = long[rows], short[rows]
    level = (a[:, :-2] + a[:, 2:] + b[:, :-2] + b[:, 2:]) / np.float32(2 * (1 + ratio))
    a, b = a[:, 1:-1], b[:, 1:-1]
    usable = (a < limit) & (b < limit) & (level * max(1, ratio) < 0.9 * limit)  # a NaN compares false
    a, b = a[usable].astype(np.float64), b[usable].astype(np.float64)
    which = np.digitize(level[usable], EDGES)
    bins = []
    for number in np.flatnonzero(np.bincount(which, minlength=len(EDGES)) >= MIN_BIN):
        members = which == number
        difference = b[members] - ratio * a[members]
        difference -= np.median(difference)
        # one DN keeps quantised data from being cut to nothing
        cut = OUTLIERS * max(1.4826 * float(np.median(np.abs(difference))), step)
        kept = np.abs(difference) < cut
        count = np.count_nonzero(kept)
        if count < MIN_BIN:
            continue
        difference = difference[kept] - difference[kept].mean()
        variance = float(np.mean(difference**2) * count / (count - 1))
        fourth = float(np.mean(difference**4))
        signal = max(float((a[members][kept].sum() + b[members][kept].sum()) / (count * (1 + ratio))), 0.0)
        sigma = np.sqrt(max(fourth - variance**2, 0.5 * variance**2) / count)
        square = (ratio * signal) ** 2
        bins.append(Bin(cell, (ratio**2 + gain * ratio) * signal, ratio**2 + gain**2, square, variance, float(sigma)))
    return bins


def from_transfer(bins: Sequence[Bin], step: float, shape: tuple[int, int] = (2, 2)) -> Noise | None:
    """Shot and floor by weighted least squares over bins; None when the bins do not tell them apart.

    ``step`` is one DN; the floor is at least its quantisation noise, step^2 / 12. A gain per colour, where the colours
    disagree past three sigma. Uncertainties are raised where the fit misses the bins by more than they state.
    """
    pooled = _fit(bins, step)
    if pooled is None:
        return None
    shot, shot_sigma, floor, floor_sigma = pooled
    cells = {cell: _fit([one for one in bins if one.cell == cell], step) for cell in sorted({b.cell for b in bins})}
    gains = np.full(shape[0] * shape[1], shot)
    if len(cells) == len(gains) > 1 and all(cells.values()):
        own = np.array([[fit[0], fit[1]] for fit in cells.values() if fit])
        chi2 = float(np.sum(((own[:, 0] - shot) / own[:, 1]) ** 2))
        freedom = len(own) - 1
        if chi2 > freedom + EVIDENCE * np.sqrt(2 * freedom):
            gains, shot_sigma = own[:, 0], float(np.sqrt(np.mean(own[:, 1] ** 2)))
    source = "photon transfer"
    sigmas = shot_sigma / float(gains.mean()), floor_sigma / floor
    return Noise(gains.reshape(shape), np.full(shape, floor), source, *sigmas)


def _fit(bins: Sequence[Bin], step: float) -> tuple[float, float, float, float] | None:
    """Shot, its sigma, floor, its sigma; None when there is too little range of signal."""
    if len(bins) < 3:
        return None
    terms = np.array([[b.signal_term, b.floor_term, b.square_term] for b in bins])
    variance, least = np.array([b.variance for b in bins]), step**2 / 12
    relative = np.array([max(b.sigma / max(b.variance, least), LEAST_ERROR) for b in bins])
    weight = 1 / (relative * np.maximum(variance, least))
    for _ in range(3):  # a bin that came out low must not weigh more for it: its sigma is that of the fitted variance
        solution, covariance, chi2 = _least_squares(terms[:, :2] * weight[:, None], variance * weight)
        if solution is None or covariance is None:
            return None
        model = np.maximum(terms[:, :2] @ np.maximum(solution, [0, least]), least)
        weight = 1 / (relative * model)
    if len(bins) > 4:
        fuller, spread, score = _least_squares(terms * weight[:, None], variance * weight)
        if fuller is not None and spread is not None and fuller[2] > EVIDENCE * np.sqrt(spread[2, 2] * max(score, 1)):
            solution, covariance, chi2 = fuller[:2], spread[:2, :2], score
    if solution is None or covariance is None:
        return None
    shot, floor = (float(value) for value in solution)
    sigmas = np.sqrt(np.diag(covariance) * max(chi2, 1.0))
    if floor < least:
        scaled, target = terms[:, 0] * weight, (variance - least * terms[:, 1]) * weight
        shot, floor = float(scaled @ target / (scaled @ scaled)), least
    if shot < 4 * sigmas[0]:
        return None
    return shot, float(sigmas[0]), floor, float(sigmas[1])


def _least_squares(terms: np.ndarray, target: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None, float]:
    """Solution, covariance and chi-square per degree of freedom of whitened equations; None where they are singular."""
    scale = np.linalg.norm(terms, axis=0)
    if np.any(scale == 0):
        return None, None, 0.0
    normal = (terms / scale).T @ (terms / scale)
    if np.linalg.cond(normal) > 1e10:
        return None, None, 0.0
    covariance = np.linalg.inv(normal)
    solution = covariance @ ((terms / scale).T @ target)
    misfit = target - (terms / scale) @ solution
    freedom = max(len(target) - terms.shape[1], 1)
    return solution / scale, covariance / np.outer(scale, scale), float(misfit @ misfit) / freedom
