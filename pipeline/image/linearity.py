"""Where a sensor stops being proportional to light, below the converter's maximum, from two frames of one scene.

The shorter frame, brought to the longer one's exposure, says what the longer one should read. Samples are put into
levels by their neighbours in the shorter frame, so that a sample's own noise does not choose its level, and the levels'
medians are compared. What departs from one at the top is the knee of the full well or of the converter. (What departs
everywhere is no sensor's answer to light: pipeline/image/computational.py.)

Source: the two-exposure linearity test of EMVA 1288 (release 4.0, 2021), on a photograph instead of a flat field.
Limits: the levels must be there: a knee in a range that no pixel shows is not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.image.cells import planes
from pipeline.image.noise import Noise

LEVELS = np.concatenate([np.geomspace(0.02, 0.5, 15), np.arange(0.52, 1.0, 0.02)])  # of the longer frame's range
MIN_SAMPLES, MAX_SAMPLES = 300, 60_000  # in a level; of one pair of frames and colour
FLAT = 0.05  # half the relative difference of the neighbours: else one sample clips where its neighbours do not
DARKEST = 0.004  # of the shorter frame's range: below, the black level's error shows
LOWEST_KNEE = 0.25
KNEE = 0.005  # relative departure from which the samples are not used
EVIDENCE = 4.0  # standard errors


@dataclass(frozen=True)
class Linearity:
    """``knee``: normalised signal up to which the longer frame is proportional, None without a limit in what was seen.

    ``top``: highest level compared.
    """

    knee: float | None
    top: float


def compare(long: np.ndarray, short: np.ndarray, ratio: float, limit: float, noise: Noise) -> Linearity:
    """How proportional two frames are; normalised signals (h, W) or (h, W, 3) of whole rows of cells.

    ``ratio``: exposure of short over long, measured well below any knee. ``limit``: signal at which samples clip.
    ``noise``: of the shorter frame.
    """
    # grain brings clipped samples among unclipped neighbours; they go, less what noise alone brings there
    highest = limit * ratio + 3 * float(np.sqrt(noise.variance(limit * ratio).mean()))
    found = [_quotients(a, b, ratio, highest) for a, b in zip(planes(long), planes(short))]
    which, quotient = (np.concatenate(parts) for parts in zip(*found))
    departure, error = np.zeros(len(LEVELS)), np.full(len(LEVELS), np.inf)
    for level in range(1, len(LEVELS)):  # level k lies between LEVELS[k - 1] and LEVELS[k]
        members = quotient[which == level]
        if len(members) >= MIN_SAMPLES and LEVELS[level] <= limit and LEVELS[level - 1] * ratio > DARKEST:
            departure[level] = float(np.median(members)) - 1
            spread = 1.4826 * float(np.median(np.abs(members - 1 - departure[level])))
            error[level] = 1.2533 * spread / np.sqrt(len(members))
    tested = np.flatnonzero(np.isfinite(error))
    below = departure < -np.maximum(KNEE, EVIDENCE * error)
    count = len(tested)
    if count and departure[tested[-1]] > -2 * KNEE:
        below[:] = False  # a knee bends on; grain that clips in single samples comes to half of this
    while count > 0 and below[tested[count - 1]]:
        count -= 1
    first = float(LEVELS[tested[count] - 1]) if count < len(tested) else 0.0
    knee = first if first >= LOWEST_KNEE else None
    return Linearity(knee, float(LEVELS[tested[-1]]) if len(tested) else 0.0)


def _quotients(long: np.ndarray, short: np.ndarray, ratio: float, highest: float) -> tuple[np.ndarray, np.ndarray]:
    """Level index and long over what short makes of it, of the samples of one colour in flat surroundings."""
    if short.shape[1] < 3:
        return np.zeros(0, int), np.zeros(0)
    rows = slice(None, None, max(1, short.size // MAX_SAMPLES))
    long, short = long[rows], short[rows]
    left, right, middle = short[:, :-2], short[:, 2:], short[:, 1:-1]
    level = (left + right) / np.float32(2 * ratio)
    flat = (np.abs(left - right) < FLAT * (left + right)) & (level < 1)  # a NaN compares false
    flat &= (middle > 0) & (middle < highest)
    which = np.digitize(level[flat], LEVELS)
    return which, (long[:, 1:-1][flat] * np.float32(ratio) / middle[flat]).astype(np.float64)


def knee_of(found: Sequence[Linearity]) -> float | None:
    """The knee that the pairs of frames agree on: their median, unless most that saw beyond it have none."""
    knees = sorted(one.knee for one in found if one.knee is not None)
    if not knees:
        return None
    middle = knees[len(knees) // 2]
    against = sum(one.knee is None and one.top > middle + 0.05 for one in found)
    return middle if len(knees) > against else None
