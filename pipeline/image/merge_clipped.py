"""Chunks in which some samples clip, in the merge's kernel: what clips is a bound, and frames may contradict it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.conventions import CLIPPED, DARK, GHOST
from pipeline.image.merge_chunk import (
    BITS,
    CHI2,
    CHUNK,
    FLOOR,
    LEVEL,
    LIMIT,
    MARGIN,
    NONE,
    POISSON,
    RATIO_ERROR,
    ROUGH,
    SCALE,
    SHOT,
    SHOTS,
    SIGNALS,
    SOME,
    SPREAD,
    SQUARES,
    TOP,
    TOTAL,
    WINDOW,
)  # fmt: skip

BOUND_SIGMA = 4.0  # a clipped sample that lies farther above the shorter frames is no noise but motion


def settle_clipped(
    memory: np.ndarray, state: np.ndarray, coefficients: np.ndarray, bright: bool, chi2_limits: np.ndarray
) -> None:
    """Settle a colour of a chunk in which some samples clip."""
    odd = _sums(memory, state, coefficients, True)
    if not bright:
        _rough(coefficients[0, LIMIT], memory)
        _level(memory)
        odd = _sums(memory, state, coefficients, False)
    odd |= _mean(memory, not bright, coefficients[-1], chi2_limits[min(2, len(state))])
    if odd:
        for f in range(len(state)):
            _disagreement(memory, f, coefficients[f])
        _raise_ghosts(memory, chi2_limits)
    if _write(memory):
        for f in range(len(state) - 1, -1, -1):
            _bound(memory, f, coefficients[f])


def _sums(memory: np.ndarray, state: np.ndarray, coefficients: np.ndarray, poisson: bool) -> bool:
    """Weighted sums over the frames of a chunk; whether one that clips lies beyond what the shorter ones say."""
    odd = False
    for x in range(WINDOW):
        for at in (TOP, SQUARES, TOTAL, SHOTS, SPREAD):
            memory[at + x] = np.float32(0)
    for f in range(len(state)):
        if state[f] == NONE:
            _add(memory, f, coefficients[f], poisson)
        elif state[f] == SOME or _anything_below(memory, coefficients[f]):
            odd |= _add_careful(memory, f, coefficients[f], poisson)
    return odd


def _add(memory: np.ndarray, f: int, one: np.ndarray, poisson: bool) -> None:
    """Add one frame, of which nothing clips, to the sums."""
    signal, scale, shot, floor = memory[SIGNALS + f * WINDOW :], one[SCALE], one[SHOT], one[FLOOR]
    constant = one[POISSON]
    for x in range(WINDOW):
        value = signal[x] * scale
        weight = constant if poisson else np.float32(1) / (shot * memory[LEVEL + x] + floor)
        _weigh(memory, x, value, weight, shot, floor)


def _add_careful(memory: np.ndarray, f: int, one: np.ndarray, poisson: bool) -> bool:
    """Add one frame to the sums of the shorter ones: what clips enters as its limit where those lie just below it.

    Whether a clipped sample lies too far above them to be noise.
    """
    signal, scale, shot, floor = memory[SIGNALS + f * WINDOW :], one[SCALE], one[SHOT], one[FLOOR]
    limit, constant = one[LIMIT], one[POISSON]
    zero, unit, odd = np.float32(0), np.float32(1), np.int32(0)
    tolerance, slack = np.float32(BOUND_SIGMA**2), np.float32(RATIO_ERROR**2)
    for x in range(WINDOW):
        value = signal[x] * scale
        linear, clipped = value < limit, value >= limit
        weight = constant if poisson else unit / (shot * memory[LEVEL + x] + floor)
        known = memory[TOTAL + x]
        gap = limit * known - memory[TOP + x]  # both sides times the weight of the shorter frames
        noise = known * ((limit if poisson else unit) + slack * limit * limit * known)
        below = clipped & (gap > zero)
        near = gap * gap < tolerance * noise
        odd = np.int32(odd | np.int32(below & (not near)))
        used = linear | (below & near)
        value, weight = (value if linear else limit), (weight if used else zero)
        _weigh(memory, x, value, weight, shot, floor)
    return bool(odd > 0)


def _weigh(memory: np.ndarray, x: int, value: Any, weight: Any, shot: Any, floor: Any) -> None:
    """Add one sample to the sums."""
    weighted, square = weight * value, weight * weight
    memory[TOP + x] += weighted
    memory[SQUARES + x] += weighted * value
    memory[TOTAL + x] += weight
    memory[SHOTS + x] += square * shot
    memory[SPREAD + x] += square * floor


def _anything_below(memory: np.ndarray, one: np.ndarray) -> bool:
    """Whether the shorter frames lie below this one's limit anywhere in a chunk that clips."""
    limit, below = one[LIMIT], np.int32(0)
    for x in range(MARGIN, MARGIN + CHUNK):
        below = np.int32(below | np.int32(limit * memory[TOTAL + x] > memory[TOP + x]))
    return bool(below > 0)


def _rough(limit: float, memory: np.ndarray) -> None:
    """Radiance by Poisson weights; the limit of the shortest frame where all clip."""
    for x in range(WINDOW):
        total = memory[TOTAL + x]
        memory[ROUGH + x] = memory[TOP + x] / total if total > np.float32(0) else limit


def _level(memory: np.ndarray) -> None:
    """Mean radiance of the four neighbours of each sample of a chunk, itself left out; not below zero."""
    for x in range(MARGIN, MARGIN + CHUNK):
        around = (memory[ROUGH + x - 2] + memory[ROUGH + x + 2]) + (memory[ROUGH + x - 1] + memory[ROUGH + x + 1])
        memory[LEVEL + x] = max(np.float32(0.25) * around, np.float32(0))


def _mean(memory: np.ndarray, optimal: bool, longest: np.ndarray, chi2_limit: float) -> bool:
    """Turn a chunk's sums into mean, 1 / weight and variance; whether frames anywhere may disagree beyond the noise.

    The chi-square of the sums takes the noise of the weights' radiance: scaled so that it can only be too large.
    """
    zero, unit, odd = np.float32(0), np.float32(1), np.int32(0)
    least = longest[FLOOR] * longest[POISSON]
    for x in range(MARGIN, MARGIN + CHUNK):
        top, total = memory[TOP + x], memory[TOTAL + x]
        inverse = unit / total if total > zero else zero
        mean = top * inverse
        level = max(mean, zero)
        chi2 = memory[SQUARES + x] - mean * top
        weighed_at = max(memory[LEVEL + x], level) + least if optimal else unit
        odd = np.int32(odd | np.int32(chi2 * weighed_at > chi2_limit * (level + least)))
        memory[TOP + x] = mean
        memory[TOTAL + x] = inverse
        memory[LEVEL + x] = level
        memory[SPREAD + x] = (level * memory[SHOTS + x] + memory[SPREAD + x]) * inverse * inverse
        memory[CHI2 + x] = zero
        memory[BITS + x] = zero
    return bool(odd > 0)


def _disagreement(memory: np.ndarray, f: int, one: np.ndarray) -> None:
    """Add how far one frame lies from the mean. One that clips tells only that it is more than its limit."""
    signal, scale, shot, floor = memory[SIGNALS + f * WINDOW :], one[SCALE], one[SHOT], one[FLOOR]
    limit, zero, unit, slack = one[LIMIT], np.float32(0), np.float32(1), np.float32(RATIO_ERROR**2)
    for x in range(MARGIN, MARGIN + CHUNK):
        mean, level = memory[TOP + x], memory[LEVEL + x]
        value = signal[x] * scale
        tells = (value < limit) | ((value >= limit) & (limit > mean))
        value = value if value < limit else limit
        misfit = value - mean if tells else zero
        memory[CHI2 + x] += misfit * misfit / (shot * level + floor + slack * level * level)
        memory[BITS + x] += unit if tells else zero


def _raise_ghosts(memory: np.ndarray, chi2_limits: np.ndarray) -> None:
    """Where frames disagree, give the variance that they show; the row of bits, a count so far, marks them."""
    zero, unit = np.float32(0), np.float32(1)
    for x in range(MARGIN, MARGIN + CHUNK):
        count, chi2 = memory[BITS + x], memory[CHI2 + x]
        ghost = (memory[TOTAL + x] > zero) & (chi2 > chi2_limits[int(count)])
        memory[SPREAD + x] = memory[SPREAD + x] * chi2 / (count - unit) if ghost else memory[SPREAD + x]
        memory[BITS + x] = np.float32(GHOST) if ghost else zero


def _write(memory: np.ndarray) -> bool:
    """Variance and bits of a chunk; whether something in it clips in every frame."""
    zero, unseen = np.float32(0), np.int32(0)
    for x in range(MARGIN, MARGIN + CHUNK):
        mean, spread, seen = memory[TOP + x], memory[SPREAD + x], memory[TOTAL + x] > zero
        unseen = np.int32(unseen | np.int32(not seen))
        memory[SPREAD + x] = spread if seen else np.float32(np.inf)
        bits = memory[BITS + x] + (np.float32(DARK) if mean * abs(mean) < spread else zero)
        memory[BITS + x] = bits if seen else np.float32(CLIPPED)
    return bool(unseen > 0)


def _bound(memory: np.ndarray, f: int, one: np.ndarray) -> None:
    """Put the bound that one frame gives where all clip. Called from the longest to the shortest, whose word stands."""
    signal, scale, limit = memory[SIGNALS + f * WINDOW :], one[SCALE], one[LIMIT]
    for x in range(MARGIN, MARGIN + CHUNK):
        value = signal[x] * scale
        bound = (memory[BITS + x] == np.float32(CLIPPED)) & (value >= limit)
        memory[TOP + x] = value if bound else memory[TOP + x]


PARTS = (
    settle_clipped, _sums, _add, _add_careful, _weigh, _anything_below, _rough, _level, _mean, _disagreement,
    _raise_ghosts, _write, _bound,
)  # fmt: skip
