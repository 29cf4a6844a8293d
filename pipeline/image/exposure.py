"""Exposures of the frames of a capture from the frames themselves: shutters miss their names, filters theirs by more.

Ratios of frames of one view are measured on pixels that neither frame clips (ratio of sums, outliers rejected), then
all frames of all views are solved together by weighted least squares on log exposure. A frame's exposure is the product
of what its shutter time, ISO, aperture and filter really gave, each one unknown per camera and label, so that plate and
ball share a scale even when one of the four differs; and of its own repeatability. What the data leave open, the common
factor above all, is held by what the labels mean (pipeline/image/labels.py) through a heavy-tailed prior.

Source: joint log-domain least squares as in Hanji, Zhong, Mantiuk 2020 (HDRutils), with labels as prior and ties added.
Ratios between plate and ball come from pipeline/image/tripod.py.
Limits: a global factor is not observable; views that neither a ratio nor a label joins relate only through the prior,
and say so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.image.noise import Noise
from pipeline.types import Frame

LABEL_SIGMA = 0.05  # of an exposure by its labels, relative: the four below together
TIME_SIGMA = 0.03  # of a shutter time against the value its label means; the prior's tails are Cauchy's
ISO_SIGMA = 0.03
APERTURE_SIGMA = 0.03  # of the area
FILTER_SIGMA = 0.15  # of a neutral filter's transmission: a fifth of a stop
BODY_SIGMA = 0.05  # between two cameras of equal settings
TIE_SIGMA = 0.003  # repeatability of one speed, and flicker, relative
RATIO_FLOOR = 3e-4  # what linearity and black level leave of a measured ratio, relative
REPORTED = 3.0  # standard uncertainties from which a disagreement is reported
MIN_PIXELS, MAX_PIXELS = 100, 200_000  # of a ratio; so many well exposed pixels know it to 1e-4


@dataclass(frozen=True)
class Ratio:
    """Measured ln(exposure of frame ``short`` / exposure of frame ``long``), indices into the capture's frames."""

    long: int
    short: int
    log: float
    sigma: float
    pixels: int


@dataclass(frozen=True)
class Setting:
    """What the camera of one frame was set to, by its labels. Equal settings are one exposure."""

    body: str
    exposure_s: float
    iso: float = 100.0
    fnumber: float = 1.0
    nd_stops: float = 0.0


@dataclass(frozen=True, eq=False)
class Solution:
    """ln(estimated / label) (F,) of each frame, and its covariance (F, F) against the mean of all.

    ``label_pulls``: offsets in standard uncertainties of label and estimate together. ``tie_pulls``: how far each frame
    lies from the others of its setting, in units of `TIE_SIGMA` and the estimate's own.
    """

    offsets: np.ndarray
    covariance: np.ndarray
    label_pulls: np.ndarray
    tie_pulls: np.ndarray

    @property
    def sigmas(self) -> np.ndarray:
        """(F,) standard uncertainties of ``offsets``."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))


def exposure_of(frame: Frame) -> float:
    """Relative exposure ``t * ISO / (100 * N^2)`` by the labels; radiance is normalised signal over this."""
    return frame.exposure_s * frame.iso / (100 * frame.fnumber**2) * 2.0**-frame.nd_stops


def setting_of(frame: Frame, body: str = "") -> Setting:
    """A frame's setting; ``body`` tells cameras of one model apart."""
    return Setting(f"{body}|{frame.camera}", frame.exposure_s, frame.iso, frame.fnumber, frame.nd_stops)


def measure_ratio(
    long: np.ndarray,
    short: np.ndarray,
    label_ratio: float,
    limit: float,
    noise: tuple[Noise, Noise],
    floor: float = RATIO_FLOOR,
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
    shot, read = [n.shot.mean() for n in noise], [n.floor.mean() for n in noise]
    middle = float(np.median(a))
    ratio = float(np.median(b)) / middle if middle > 0 else 0.0
    kept = np.ones(len(a), bool)
    for _ in range(5):
        if ratio <= 0 or np.count_nonzero(kept) < MIN_PIXELS:
            return None
        variance = shot[1] * ratio * np.maximum(a, 0) + read[1] + ratio**2 * (shot[0] * np.maximum(a, 0) + read[0])
        pull = (b - ratio * a) / np.sqrt(variance)
        scale = max(1.4826 * float(np.median(np.abs(pull))), 1.0)
        previous, kept = kept, np.abs(pull) < 4 * scale
        ratio = float(b[kept].sum() / a[kept].sum()) if kept.any() else 0.0
        if np.array_equal(previous, kept):
            break
    sigma = scale * float(np.sqrt(variance[kept].sum())) / (ratio * float(a[kept].sum()))
    return float(np.log(ratio)), float(np.hypot(sigma, floor)), int(np.count_nonzero(kept))


def _factors(settings: Sequence[Setting]) -> list[tuple[tuple[str | float, ...], float]]:
    """The unknowns that frames share, each a key that starts with its kind, and the sigma of its prior.

    Every shutter time of every camera; ISO, aperture and filter where a camera used several; the camera, where there
    are several.
    """
    bodies = sorted({one.body for one in settings})
    factors: dict[tuple[str | float, ...], float] = {}
    for one in settings:
        factors["exposure_s", one.body, one.exposure_s] = TIME_SIGMA
        for kind, sigma in (("iso", ISO_SIGMA), ("fnumber", APERTURE_SIGMA), ("nd_stops", FILTER_SIGMA)):
            several = len({getattr(other, kind) for other in settings if other.body == one.body}) > 1
            if several and (kind != "nd_stops" or one.nd_stops > 0):  # no filter is exact
                factors[kind, one.body, getattr(one, kind)] = sigma
        if len(bodies) > 1:
            factors["body", one.body] = BODY_SIGMA
    return sorted(factors.items(), key=str)


def _holds(key: tuple[str | float, ...], setting: Setting) -> bool:
    return key[1] == setting.body and (key[0] == "body" or getattr(setting, str(key[0])) == key[2])


def solve_exposures(labels: np.ndarray, settings: Sequence[Setting], ratios: Sequence[Ratio]) -> Solution:
    """What the frames were really exposed to, relative to ``labels`` (F,), relative exposures that their labels mean.

    Unknowns are one value per frame and one per factor of the settings; the prior acts on the factors.
    """
    factors = _factors(settings)
    count, total = len(labels), len(labels) + len(factors)
    holds = np.array([[_holds(key, one) for key, _ in factors] for one in settings], float)  # (F, factors)
    prior = np.array([sigma for _, sigma in factors])
    rows, values, sigmas = [], [], []
    for ratio in ratios:
        row = np.zeros(total)
        row[ratio.short], row[ratio.long] = 1, -1
        rows.append(row)
        values.append(ratio.log - float(np.log(labels[ratio.short] / labels[ratio.long])))
        sigmas.append(ratio.sigma)
    for frame in range(count):
        row = np.zeros(total)
        row[frame], row[count:] = 1, -holds[frame]
        rows.append(row)
        values.append(0.0)
        sigmas.append(TIE_SIGMA)
    design, target = np.array(rows) / np.array(sigmas)[:, None], np.array(values) / sigmas
    normal, right = design.T @ design, design.T @ target
    solution: np.ndarray = np.zeros(total)
    for _ in range(50):  # iteratively reweighted: Cauchy prior
        weights = 1 / prior**2 / (1 + (solution[count:] / prior) ** 2)
        held = normal + np.diag(np.concatenate([np.zeros(count), weights]))
        previous, solution = solution, np.linalg.solve(held, right)
        if np.abs(solution - previous).max() < 1e-10:
            break
    whole = np.linalg.inv(held)
    centred = np.eye(count) - 1 / count
    covariance = centred @ whole[:count, :count] @ centred.T
    own = solution[:count] - holds @ solution[count:]
    tie = np.concatenate([np.eye(count), -holds], 1)
    spread = np.maximum(TIE_SIGMA**2 - np.diag(tie @ whole @ tie.T), (0.1 * TIE_SIGMA) ** 2)  # of a fit's residual
    expected = np.sqrt(np.diag(covariance) + holds @ prior**2)
    return Solution(solution[:count], covariance, solution[:count] / expected, own / np.sqrt(spread))


def linked_views(views: list[str], settings: Sequence[Setting], ratios: Sequence[Ratio]) -> list[set[str]]:
    """Views of each connected set of frames, joined by measured ratios and by shared settings.

    A view that no set holds together with another has its scale against it by label alone.
    """
    component = list(range(len(views)))

    def join(a: int, b: int) -> None:
        old, new = component[a], component[b]
        component[:] = [new if number == old else number for number in component]

    for ratio in ratios:
        join(ratio.long, ratio.short)
    for first, one in enumerate(settings):
        for second in range(first):
            if settings[second] == one:
                join(first, second)
    return [{views[i] for i, c in enumerate(component) if c == number} for number in sorted(set(component))]
