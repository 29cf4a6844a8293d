"""Exposures of the frames of a capture from the frames themselves: labels are wrong by up to 7 %, sometimes 40 %.

Ratios of frames of one view are measured on pixels that neither frame clips (ratio of sums, outliers rejected), then
all frames of all views are solved together by weighted least squares on log exposure. Frames with one label, ISO and
f-number were made by one mechanical speed and are tied to each other, so that plate and ball share a scale. What the
data leave open, the common factor above all, is held by the labels through a heavy-tailed prior.

Source: joint log-domain least squares as in Hanji, Zhong, Mantiuk 2020 (HDRutils), with labels as prior and ties added.
Ratios between plate and ball come from pipeline/image/tripod.py.
Limits: a global factor is not observable; views that neither a ratio nor a label joins relate only through the prior,
and say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.image.noise import Noise
from pipeline.types import Frame

LABEL_SIGMA = 0.05  # usual error of a label, relative; the prior's tails are Cauchy's, so 40 % costs little
TIE_SIGMA = 0.003  # repeatability of one speed, and flicker, relative
RATIO_FLOOR = 3e-4  # what linearity and black level leave of a measured ratio, relative
MIN_PIXELS, MAX_PIXELS = 100, 200_000  # of a ratio; so many well exposed pixels know it to 1e-4


@dataclass(frozen=True)
class Ratio:
    """Measured ln(exposure of frame ``short`` / exposure of frame ``long``), indices into the capture's frames."""

    long: int
    short: int
    log: float
    sigma: float
    pixels: int


def exposure_of(frame: Frame) -> float:
    """Relative exposure ``t * ISO / (100 * N^2)`` by the labels; radiance is normalised signal over this."""
    return frame.exposure_s * frame.iso / (100 * frame.fnumber**2)


def measure_ratio(
    long: np.ndarray, short: np.ndarray, label_ratio: float, limit: float, noise: tuple[Noise, Noise]
) -> tuple[float, float, int] | None:
    """ln(short / long), its standard uncertainty, and the pixels used; None when too few are well exposed in both.

    ``long``, ``short``: normalised signals (N,). Pixels are chosen on the two frames' sum: given the sum of two Poisson
    counts, the share of each is unbiased, while a choice on one frame favours its positive noise (2 % at 100
    electrons where dark pixels abound). Sums, not mean ratios: unbiased in the dark.
    """
    both = long + short
    unclipped = (long < 0.95 * limit) & (short < 0.95 * limit)
    for least in (0.004, 0.001):  # of full scale in the short frame: the black level's error stays below the floor
        chosen = np.flatnonzero(unclipped & (both > max(least / label_ratio, 0.004) * (1 + label_ratio)))
        if len(chosen) >= MIN_PIXELS:
            chosen = chosen[:: max(1, len(chosen) // MAX_PIXELS)]
            break
    else:
        return None
    a, b = long[chosen].astype(np.float64), short[chosen].astype(np.float64)
    shot, floor = [n.shot.mean() for n in noise], [n.floor.mean() for n in noise]
    ratio = float(np.median(b) / np.median(a))
    kept = np.ones(len(a), bool)
    for _ in range(5):
        if ratio <= 0 or np.count_nonzero(kept) < MIN_PIXELS:
            return None
        variance = shot[1] * ratio * a + floor[1] + ratio**2 * (shot[0] * a + floor[0])
        pull = (b - ratio * a) / np.sqrt(variance)
        scale = max(1.4826 * float(np.median(np.abs(pull))), 1.0)
        previous, kept = kept, np.abs(pull) < 4 * scale
        ratio = float(b[kept].sum() / a[kept].sum()) if kept.any() else 0.0
        if np.array_equal(previous, kept):
            break
    sigma = scale * float(np.sqrt(variance[kept].sum())) / (ratio * float(a[kept].sum()))
    return float(np.log(ratio)), float(np.hypot(sigma, RATIO_FLOOR)), int(np.count_nonzero(kept))


def solve_exposures(
    labels: np.ndarray, speeds: Sequence[tuple[Any, ...]], ratios: list[Ratio]
) -> tuple[np.ndarray, np.ndarray]:
    """ln(estimated / label) (F,) of each frame and its standard uncertainty (F,) against the mean of all.

    ``labels``: relative exposures by label (F,). ``speeds``: which camera was set to what, per frame; equals are tied.
    Unknowns are one value per frame and one per distinct setting; the prior acts on the settings.
    """
    settings = sorted(set(speeds))
    count, total = len(labels), len(labels) + len(settings)
    normal: np.ndarray = np.zeros((total, total))
    right: np.ndarray = np.zeros(total)

    def add(plus: int, minus: int, value: float, sigma: float) -> None:
        weight = 1 / sigma**2
        normal[plus, plus] += weight
        normal[minus, minus] += weight
        normal[plus, minus] -= weight
        normal[minus, plus] -= weight
        right[plus] += weight * value
        right[minus] -= weight * value

    for ratio in ratios:
        expected = float(np.log(labels[ratio.short] / labels[ratio.long]))
        add(ratio.short, ratio.long, ratio.log - expected, ratio.sigma)
    for frame, speed in enumerate(speeds):
        add(frame, count + settings.index(speed), 0.0, TIE_SIGMA)
    prior = np.arange(count, total)
    solution: np.ndarray = np.zeros(total)
    for _ in range(50):  # iteratively reweighted: Cauchy prior
        weights = 1 / LABEL_SIGMA**2 / (1 + (solution[prior] / LABEL_SIGMA) ** 2)
        held = normal.copy()
        held[prior, prior] += weights
        previous, solution = solution, np.linalg.solve(held, right)
        if np.abs(solution - previous).max() < 1e-10:
            break
    centred = np.eye(count) - 1 / count
    covariance = centred @ np.linalg.inv(held)[:count, :count] @ centred.T
    return solution[:count], np.sqrt(np.maximum(np.diag(covariance), 0))


def linked_views(views: list[str], speeds: Sequence[tuple[Any, ...]], ratios: list[Ratio]) -> list[set[str]]:
    """Views of each connected set of frames, joined by measured ratios and by shared settings.

    A view that no set holds together with another has its scale against it by label alone.
    """
    component = list(range(len(views)))

    def join(a: int, b: int) -> None:
        old, new = component[a], component[b]
        component[:] = [new if number == old else number for number in component]

    for ratio in ratios:
        join(ratio.long, ratio.short)
    for first, one in enumerate(speeds):
        for second in range(first):
            if speeds[second] == one:
                join(first, second)
    return [{views[i] for i, c in enumerate(component) if c == number} for number in sorted(set(component))]
