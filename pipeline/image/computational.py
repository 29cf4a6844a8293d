"""Pictures that are not proportional to exposure: a phone merges and tone maps frames before it writes its "RAW".

Two witnesses. Metadata (`by_metadata`): three channels per pixel from a maker of phones, masks of what is seen, a gain
table. And the bracket itself (`not_proportional`): the ratio of two frames of one sensor is one number, whatever the
brightness; through a tone curve, or with an exposure the phone chose itself, it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

PHONES = ("apple", "google", "samsung", "xiaomi", "huawei", "oneplus", "oppo", "vivo", "honor", "motorola", "nothing")
SLOPE_SIGMA = 4.0  # standard errors; and ...
SLOPE = 0.02  # ... the power of brightness that the ratio must follow beyond what flare and black errors explain
ASIDE = (2, 4)  # columns, either side: neighbours of the same colour in a Bayer mosaic
JUDGED = 100_000  # samples of a pair that tell whether it is proportional
LABEL_STOPS = 0.5  # disagreement with the labels that no shutter has: rounding of 1/3 stops reaches 0.1


def by_metadata(maker: str, linear: bool, masks: bool, gain_table: bool, tone_curve: bool) -> list[str]:
    """Marks of a file whose metadata tell of merging; ``maker``: a maker of phones, or empty."""
    told = [
        word
        for word, there in (
            (f"three channels per pixel from {maker}", linear and bool(maker)),
            ("masks of what is seen", masks),
            ("a gain table", gain_table),
        )
        if there
    ]
    if told:
        curve = " with a tone curve of its own" if tone_curve else ""
        return [f"computational ({', '.join(told)}{curve}): may not be proportional to exposure"]
    if maker:
        return [f"from a phone ({maker}): frames may have been merged before they were written"]
    return []


def not_proportional(levels: np.ndarray, log_ratios: np.ndarray, sigmas: np.ndarray, log_label: float) -> str:
    """Why two frames are not one sensor's at two exposures; empty when they may be.

    ``levels`` (N,): signal of the longer frame's pixels by group of brightness, black subtracted, below clipping.
    ``log_ratios`` (N,): ln(short / long) of each group, ``sigmas`` (N,) their standard errors, ``log_label`` what the
    labels say. A line ln ratio = a + b ln level is fitted by weighted least squares; errors are scaled by the residual
    where that exceeds them. Fewer than three groups tell nothing about the slope.
    """
    good = (levels > 0) & np.isfinite(log_ratios) & (sigmas > 0)
    if not good.any():
        return ""
    x, y, w = np.log(levels[good]), log_ratios[good], 1 / sigmas[good] ** 2
    mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
    spread = float(np.sum(w * (x - mean_x) ** 2))
    if good.sum() >= 3 and spread > 0:
        slope = float(np.sum(w * (x - mean_x) * (y - mean_y))) / spread
        rest = y - mean_y - slope * (x - mean_x)
        error = np.sqrt(max(1.0, float(np.sum(w * rest**2)) / (good.sum() - 2)) / spread)
        if abs(slope) > max(SLOPE, SLOPE_SIGMA * error):
            return f"ratio of frames follows brightness to the power {slope:+.3f} +- {error:.3f}: a tone curve"
    stops = (mean_y - log_label) / np.log(2)
    if abs(stops) > LABEL_STOPS:
        return f"ratio of frames is {stops:+.2f} stops off the labels: an exposure of the camera's own"
    return ""


def groups_of(
    long: np.ndarray, short: np.ndarray, limit: float, ratio: float, count: int = 8
) -> tuple[np.ndarray, ...]:
    """Levels, ln ratios and standard errors (N,) of two frames' signals (H, W) or (H, W, 3), for `not_proportional`.

    A sample is grouped by its neighbours' brightness in both frames, and left out where that is below 1 % of ``limit``
    or one exceeds it: their noise is not the sample's. Grouped or cut by its own value, noise would choose: the darkest
    of eight groups then misses 12 % at 3000 electrons of full scale. Both frames count alike, ``short`` over ``ratio``
    (short / long, about), so that a shift between them does not choose either.
    """
    rows = slice(None, None, max(1, long.size // JUDGED) | 1)  # odd, so that it meets every colour of a mosaic
    if long.shape[1] <= 2 * max(ASIDE) or not ratio > 0:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    pair = np.stack([long[rows], short[rows] / ratio]).astype(float)
    beside = np.concatenate([np.roll(pair, by, axis=2) for by in (*ASIDE, *(-by for by in ASIDE))])
    use = (beside.mean(0) > 0.01 * limit) & (beside.max(0) < limit) & (pair.max(0) < limit)
    use[:, : max(ASIDE)] = use[:, -max(ASIDE) :] = False
    guide, a, b = (one[use] for one in (beside.mean(0), pair[0], ratio * pair[1]))
    if a.size < 50 * count:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    found: list[Sequence[float]] = []
    for low, high in pairwise(np.quantile(guide, np.linspace(0, 1, count + 1))):
        inside = (guide >= low) & (guide < high)
        if inside.sum() >= 25 and (sums := (a[inside].sum(), b[inside].sum())) and min(sums) > 0:
            own = sums[1] / sums[0]
            error = np.std(b[inside] - own * a[inside]) / np.sqrt(inside.sum()) / b[inside].mean()
            found.append((a[inside].mean(), np.log(own), max(error, 1e-6)))
    table = np.array(found).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]
