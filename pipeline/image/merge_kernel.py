"""The merge of a block of rows as one compiled loop; `radiometry.merge` says what it estimates and hands it the rows.

Every inner loop is a plain pass over one chunk of a row, which stays in the first-level cache, with selections instead
of branches: compilers turn it into vector instructions. What is rare is found by a cheap test of the whole chunk and
only then worked out: samples that clip, pixels so dark that read noise matters, frames that disagree.

All arithmetic is float32, neither contracted nor reordered, so that bits agree on every processor and powers of two in
the exposures go straight through. Rows know nothing of each other.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.conventions import CLIPPED, DARK, GHOST

CHUNK = 576  # samples that a pass settles; a multiple of 2 and 3, so that every chunk starts on a whole cell
MARGIN = 8  # samples that it looks at on either side: two neighbours, at a pitch of up to 3
WINDOW = CHUNK + 2 * MARGIN  # whole vectors; a fixed number, so that loops need no remainder
ROWS = range(0, 11 * WINDOW, WINDOW)  # beginnings in flat memory: the compiler then sees how far apart they are
BLACK, SCALE, SHOT, FLOOR, LIMIT, POISSON, COUNTS, BRIGHT, *UP_TO_HERE = ROWS  # of a frame's coefficients
ALL_TOTAL, ALL_INVERSE, ALL_FLOORS = UP_TO_HERE  # Poisson weights of this and all shorter frames
TOP, SQUARES, TOTAL, SHOTS, FLOORS, LEVEL, CHI2, COUNT = ROWS[:8]  # of a chunk's working memory
NONE, SOME, ALL = range(3)  # of a chunk's samples clip
BRIGHT_RATIO = 50.0  # shot over read noise, as variances: from here Poisson weights lose less than 0.1 %
RATIO_ERROR = 0.005  # relative disagreement of frames that exposure error and flicker explain
BOUND_SIGMA = 4.0  # a clipped sample that lies farther above the shorter frames is no noise but motion


def compiled(function: Callable[..., Any], *helpers: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays and numbers as machine code, kept beside the source: only the first run waits for it.

    It lets go of the interpreter's lock. ``helpers``: functions that it calls, which become part of it.
    """
    import numba
    from numba.extending import register_jitable

    for helper in helpers:
        register_jitable(helper)
    return numba.njit(function, cache=True, nogil=True, error_model="numpy")  # type: ignore[no-any-return]


@functools.cache
def block_kernel() -> Callable[..., None]:
    """`merge_block`, compiled."""
    usual = (_usual, _count_one, _count_two, _poisson_mean, _below_limit, _add_two, _optimal_mean)
    write = (_chi2, _chi2_one, _chi2_two, _write_usual)
    rare = (_sums, _add, _add_careful, _anything_below, _is_bright, _mean, _disagreement, _raise_ghosts, _write, _bound)
    return compiled(merge_block, _pad, _clipping, _unclipped_first, _rough, _level, *usual, *write, *rare)


def merge_block(
    samples: np.ndarray,
    first: int,
    pitch: int,
    coefficients: np.ndarray,
    bounds: np.ndarray,
    poisson: bool,
    chi2_limits: np.ndarray,
    radiance: np.ndarray,
    variance: np.ndarray,
    mask: np.ndarray,
) -> None:
    """Radiance, variance, mask (h, S) of ``samples`` (F, h, ...) DN, frames from the shortest, rows from ``first`` on.

    ``samples``: rows in the middle of `padded_rows`, whose ends are filled here. ``pitch``: samples from one to the
    next of the same colour. ``coefficients`` (2, F, 11 * WINDOW) float32 of even and odd rows: black [DN]; then in
    units of radiance: 1 DN, shot noise (variance over radiance), floor (variance), linear limit; 1 / shot, 1 DN over
    shot, the radiance from which read noise does not matter, and sums over the frames up to here. ``bounds`` (F, 2): DN
    below which nothing clips, and from which on all does. ``chi2_limits`` (F + 1,): of as many frames. Samples that are
    NaN are left out.
    """
    frames, (height, width) = len(samples), radiance.shape
    work = np.zeros(8 * WINDOW, np.float32)
    rough = np.zeros(WINDOW, np.float32)
    state = np.zeros(frames, np.int64)
    for row in range(height):
        coefficient = coefficients[(first + row) % 2]
        for f in range(frames):
            _pad(samples[f, row], width, pitch)
        for start in range(0, width, CHUNK):
            end = start + WINDOW
            target = slice(start, min(start + CHUNK, width))
            for f in range(frames):
                state[f] = _clipping(samples[f, row, start:end], bounds[f])
            usual = _unclipped_first(state)
            if usual > 0 and _usual(samples, row, start, usual, pitch, coefficient, poisson, work, rough):
                _chi2(samples, row, start, usual, coefficient, work)
                limit = chi2_limits[usual]
                _write_usual(limit, usual, work, radiance[row, target], variance[row, target], mask[row, target])
                continue
            odd = _sums(samples, row, start, state, coefficient, True, work)
            optimal = not poisson and not _is_bright(state, coefficient, work)
            if optimal:
                _rough(coefficient[0], work, rough)
                _level(pitch, rough, work)
                odd = _sums(samples, row, start, state, coefficient, False, work)
            odd |= _mean(optimal, coefficient[frames - 1], chi2_limits[min(2, frames)], work)
            if odd:
                for f in range(frames):
                    _disagreement(samples[f, row, start:end], coefficient[f], work)
                _raise_ghosts(chi2_limits, work)
            if _write(work, radiance[row, target], variance[row, target], mask[row, target]):
                for f in range(frames - 1, -1, -1):
                    _bound(samples[f, row, start:end], coefficient[f], radiance[row, target], mask[row, target])


def padded_rows(frames: int, height: int, width: int, dtype: Any) -> np.ndarray:
    """(frames, height, S) zeros: rows of ``width`` samples from `MARGIN` on, and room behind for whole chunks."""
    return np.zeros((frames, height, -(-width // CHUNK) * CHUNK + 2 * MARGIN), dtype)


def _pad(row: np.ndarray, width: int, pitch: int) -> None:
    """Fill a row's ends with samples of the same colour from inside it, so that none becomes its own neighbour."""
    last = MARGIN + width - 1
    for x in range(MARGIN):
        steps = (MARGIN - 1 - x) // pitch + 1
        source = x + (2 * steps + 2) * pitch
        row[x] = row[source if source <= last else min(x + steps * pitch, last)]
    for x in range(last + 1, last + 1 + MARGIN):
        steps = (x - last - 1) // pitch + 1
        source = x - (2 * steps + 2) * pitch
        row[x] = row[source if source >= MARGIN else max(x - steps * pitch, MARGIN)]
    for x in range(last + 1 + MARGIN, len(row)):
        row[x] = row[x - 6]  # whole cells; nobody asks for them, but they must look like the rest


def _clipping(dn: np.ndarray, bounds: np.ndarray) -> int:
    """Whether none, some or all samples of a chunk clip, as far as their extremes tell; some, when one is no number."""
    least, most, strange = dn[0], dn[0], 0
    for x in range(WINDOW):
        least = dn[x] if dn[x] < least else least
        most = dn[x] if dn[x] > most else most
    for x in range(WINDOW):
        strange |= 0 if dn[x] == dn[x] else 1
    if strange > 0:
        return SOME
    return NONE if most < bounds[0] else ALL if least >= bounds[1] else SOME


def _unclipped_first(state: np.ndarray) -> int:
    """How many frames do not clip in a chunk, when all longer ones clip wholly; else none."""
    count = 0
    for f in range(len(state)):
        if state[f] == SOME or (state[f] == NONE and count < f):
            return 0
        count = f + 1 if state[f] == NONE else count
    return count


def _usual(
    samples: np.ndarray,
    row: int,
    start: int,
    frames: int,
    pitch: int,
    coefficient: np.ndarray,
    poisson: bool,
    work: np.ndarray,
    rough: np.ndarray,
) -> bool:
    """Mean and variance of a chunk of ``frames`` unclipped frames; not if a longer one, which clips, lies above it."""
    work[:WINDOW] = np.float32(0)
    for f in range(0, frames - 1, 2):
        one, two = samples[f, row, start : start + WINDOW], samples[f + 1, row, start : start + WINDOW]
        _count_two(one, two, coefficient[f], coefficient[f + 1], work)
    if frames % 2:
        _count_one(samples[frames - 1, row, start : start + WINDOW], coefficient[frames - 1], work)
    dim = _poisson_mean(coefficient[frames - 1], work)
    if frames < len(coefficient) and _below_limit(coefficient[frames], work):
        return False
    if dim and not poisson:
        rough[:] = work[:WINDOW]
        _level(pitch, rough, work)
        work[:LEVEL] = np.float32(0)
        for f in range(0, frames - 1, 2):
            one, two = samples[f, row, start : start + WINDOW], samples[f + 1, row, start : start + WINDOW]
            _add_two(one, two, coefficient[f], coefficient[f + 1], work)
        if frames % 2:
            _add(samples[frames - 1, row, start : start + WINDOW], coefficient[frames - 1], False, work)
        _optimal_mean(work)
    return True


def _count_one(dn: np.ndarray, one: np.ndarray, work: np.ndarray) -> None:
    """Add an unclipped frame to the sum of counts."""
    for x in range(WINDOW):
        work[TOP + x] += (np.float32(dn[x]) - one[BLACK + x]) * one[COUNTS + x]


def _count_two(dn: np.ndarray, dn_2: np.ndarray, one: np.ndarray, two: np.ndarray, work: np.ndarray) -> None:
    """`_count_one` of two frames at once, which spares the memory of the sum."""
    for x in range(WINDOW):
        first = (np.float32(dn[x]) - one[BLACK + x]) * one[COUNTS + x]
        work[TOP + x] += first + (np.float32(dn_2[x]) - two[BLACK + x]) * two[COUNTS + x]


def _poisson_mean(longest: np.ndarray, work: np.ndarray) -> bool:
    """Turn the sum of counts into mean, level and variance; whether read noise matters anywhere."""
    dim = np.int32(0)
    for x in range(WINDOW):
        inverse = longest[ALL_INVERSE + x]
        mean = work[TOP + x] * inverse
        level = max(mean, np.float32(0))
        work[TOP + x] = mean
        work[LEVEL + x] = level
        work[FLOORS + x] = (level * longest[ALL_TOTAL + x] + longest[ALL_FLOORS + x]) * inverse * inverse
        work[CHI2 + x] = np.float32(0)
        dim |= np.int32(mean < longest[BRIGHT + x])
    return bool(dim > 0)


def _below_limit(brighter: np.ndarray, work: np.ndarray) -> bool:
    """Whether the mean lies anywhere below the limit of a frame that clips."""
    below = np.int32(0)
    for x in range(WINDOW):
        below |= np.int32(work[TOP + x] < brighter[LIMIT + x])
    return bool(below > 0)


def _add_two(dn: np.ndarray, dn_2: np.ndarray, one: np.ndarray, two: np.ndarray, work: np.ndarray) -> None:
    """`_add` of two frames at once, with one division."""
    for x in range(WINDOW):
        value = (np.float32(dn[x]) - one[BLACK + x]) * one[SCALE + x]
        value_2 = (np.float32(dn_2[x]) - two[BLACK + x]) * two[SCALE + x]
        level = work[LEVEL + x]
        noise = one[SHOT + x] * level + one[FLOOR + x]
        noise_2 = two[SHOT + x] * level + two[FLOOR + x]
        both = np.float32(1) / (noise * noise_2)
        weight, weight_2 = both * noise_2, both * noise
        square, square_2 = weight * weight, weight_2 * weight_2
        work[TOP + x] += weight * value + weight_2 * value_2
        work[TOTAL + x] += weight + weight_2
        work[SHOTS + x] += square * one[SHOT + x] + square_2 * two[SHOT + x]
        work[FLOORS + x] += square * one[FLOOR + x] + square_2 * two[FLOOR + x]


def _optimal_mean(work: np.ndarray) -> None:
    """Turn the weighted sums into mean, level and variance."""
    for x in range(WINDOW):
        inverse = np.float32(1) / work[TOTAL + x]
        mean = work[TOP + x] * inverse
        level = max(mean, np.float32(0))
        work[TOP + x] = mean
        work[LEVEL + x] = level
        work[FLOORS + x] = (level * work[SHOTS + x] + work[FLOORS + x]) * inverse * inverse


def _chi2(samples: np.ndarray, row: int, start: int, frames: int, coefficient: np.ndarray, work: np.ndarray) -> None:
    """Chi-square of unclipped frames about their mean, two by two."""
    for f in range(0, frames - 1, 2):
        one, two = samples[f, row, start : start + WINDOW], samples[f + 1, row, start : start + WINDOW]
        _chi2_two(one, two, coefficient[f], coefficient[f + 1], work)
    if frames % 2:
        _chi2_one(samples[frames - 1, row, start : start + WINDOW], coefficient[frames - 1], work)


def _chi2_one(dn: np.ndarray, one: np.ndarray, work: np.ndarray) -> None:
    """Add how far an unclipped frame lies from the mean."""
    slack = np.float32(RATIO_ERROR**2)
    for x in range(WINDOW):
        level = work[LEVEL + x]
        misfit = (np.float32(dn[x]) - one[BLACK + x]) * one[SCALE + x] - work[TOP + x]
        work[CHI2 + x] += misfit * misfit / (one[SHOT + x] * level + one[FLOOR + x] + slack * level * level)


def _chi2_two(dn: np.ndarray, dn_2: np.ndarray, one: np.ndarray, two: np.ndarray, work: np.ndarray) -> None:
    """`_chi2_one` of two frames at once, with one division."""
    slack = np.float32(RATIO_ERROR**2)
    for x in range(WINDOW):
        level, mean = work[LEVEL + x], work[TOP + x]
        misfit = (np.float32(dn[x]) - one[BLACK + x]) * one[SCALE + x] - mean
        misfit_2 = (np.float32(dn_2[x]) - two[BLACK + x]) * two[SCALE + x] - mean
        extra = slack * level * level
        noise = one[SHOT + x] * level + one[FLOOR + x] + extra
        noise_2 = two[SHOT + x] * level + two[FLOOR + x] + extra
        work[CHI2 + x] += (misfit * misfit * noise_2 + misfit_2 * misfit_2 * noise) / (noise * noise_2)


def _write_usual(
    chi2_limit: float, frames: int, work: np.ndarray, radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray
) -> None:
    """Write a chunk in which every sample of ``frames`` frames counts."""
    chunk, freedom = work[MARGIN:], np.float32(1 / max(frames - 1, 1))
    for x in range(len(radiance)):
        mean, spread, chi2 = chunk[TOP + x], chunk[FLOORS + x], chunk[CHI2 + x]
        ghost = chi2 > chi2_limit
        spread = spread * chi2 * freedom if ghost else spread
        radiance[x] = mean
        variance[x] = spread
        bits = np.uint8(GHOST) if ghost else np.uint8(0)
        mask[x] = bits | (np.uint8(DARK) if mean * abs(mean) < spread else np.uint8(0))


def _sums(
    samples: np.ndarray,
    row: int,
    start: int,
    state: np.ndarray,
    coefficient: np.ndarray,
    poisson: bool,
    work: np.ndarray,
) -> bool:
    """Weighted sums over the frames of a chunk; whether one that clips lies beyond what the shorter ones say."""
    odd = False
    work[:LEVEL] = np.float32(0)
    for f in range(len(state)):
        dn = samples[f, row, start : start + WINDOW]
        if state[f] == NONE:
            _add(dn, coefficient[f], poisson, work)
        elif state[f] == SOME or _anything_below(coefficient[f], work):
            odd |= _add_careful(dn, coefficient[f], poisson, work)
    return odd


def _add(dn: np.ndarray, coefficient: np.ndarray, poisson: bool, work: np.ndarray) -> None:
    """Add one frame, of which nothing clips, to the sums."""
    if poisson:
        for x in range(WINDOW):
            value = (np.float32(dn[x]) - coefficient[BLACK + x]) * coefficient[SCALE + x]
            weight = coefficient[POISSON + x]
            weighted = weight * value
            work[TOP + x] += weighted
            work[SQUARES + x] += weighted * value
            work[TOTAL + x] += weight
            work[FLOORS + x] += weight * weight * coefficient[FLOOR + x]
    else:
        for x in range(WINDOW):
            value = (np.float32(dn[x]) - coefficient[BLACK + x]) * coefficient[SCALE + x]
            weight = np.float32(1) / (coefficient[SHOT + x] * work[LEVEL + x] + coefficient[FLOOR + x])
            weighted, square = weight * value, weight * weight
            work[TOP + x] += weighted
            work[SQUARES + x] += weighted * value
            work[TOTAL + x] += weight
            work[SHOTS + x] += square * coefficient[SHOT + x]
            work[FLOORS + x] += square * coefficient[FLOOR + x]


def _anything_below(coefficient: np.ndarray, work: np.ndarray) -> bool:
    """Whether the shorter frames lie below this one's limit anywhere in a chunk that clips."""
    below = 0
    for x in range(WINDOW):
        below |= 1 if coefficient[LIMIT + x] * work[TOTAL + x] > work[TOP + x] else 0
    return below > 0


def _add_careful(dn: np.ndarray, coefficient: np.ndarray, poisson: bool, work: np.ndarray) -> bool:
    """Add one frame to the sums of the shorter ones: what clips enters as its limit where those lie just below it.

    Whether a clipped sample lies too far above them to be noise.
    """
    zero, one, odd = np.float32(0), np.float32(1), 0
    tolerance, slack = np.float32(BOUND_SIGMA**2), np.float32(RATIO_ERROR**2)
    for x in range(WINDOW):
        limit, shot, floor = coefficient[LIMIT + x], coefficient[SHOT + x], coefficient[FLOOR + x]
        value = (np.float32(dn[x]) - coefficient[BLACK + x]) * coefficient[SCALE + x]
        linear, clipped = value < limit, value >= limit
        weight = one / shot if poisson else one / (shot * work[LEVEL + x] + floor)
        known = work[TOTAL + x]
        gap = limit * known - work[TOP + x]  # both sides times the weight of the shorter frames
        noise = known * ((limit if poisson else one) + slack * limit * limit * known)
        below = clipped & (gap > zero)
        near = gap * gap < tolerance * noise
        odd |= 1 if below & (not near) else 0
        used = linear | (below & near)
        value, weight = (value if linear else limit), (weight if used else zero)
        weighted, square = weight * value, weight * weight
        work[TOP + x] += weighted
        work[SQUARES + x] += weighted * value
        work[TOTAL + x] += weight
        work[SHOTS + x] += square * shot
        work[FLOORS + x] += square * floor
    return odd > 0


def _is_bright(state: np.ndarray, coefficient: np.ndarray, work: np.ndarray) -> bool:
    """Whether read noise is too small everywhere in a chunk for the weights to ask for it."""
    longest = 0
    for f in range(len(state)):
        longest = f if state[f] == NONE else longest
    one, dim = coefficient[longest], 0
    for x in range(WINDOW):
        dim |= 1 if work[TOP + x] < one[BRIGHT + x] * work[TOTAL + x] else 0
    return dim == 0


def _rough(shortest: np.ndarray, work: np.ndarray, rough: np.ndarray) -> None:
    """Radiance by Poisson weights; the limit of the shortest frame where all clip."""
    for x in range(WINDOW):
        total = work[TOTAL + x]
        rough[x] = work[TOP + x] / total if total > np.float32(0) else shortest[LIMIT + x]


def _level(pitch: int, rough: np.ndarray, work: np.ndarray) -> None:
    """Mean radiance of the four neighbours of each sample of a chunk, itself left out; not below zero."""
    for x in range(WINDOW):
        work[LEVEL + x] = max(rough[x], np.float32(0))  # of the margins
    far_west, west = rough[MARGIN - 2 * pitch :], rough[MARGIN - pitch :]
    east, far_east = rough[MARGIN + pitch :], rough[MARGIN + 2 * pitch :]
    level = work[LEVEL + MARGIN :]
    for x in range(CHUNK):
        total = (far_west[x] + far_east[x]) + (west[x] + east[x])
        level[x] = max(np.float32(0.25) * total, np.float32(0))


def _mean(optimal: bool, longest: np.ndarray, chi2_limit: float, work: np.ndarray) -> bool:
    """Turn a chunk's sums into mean, 1 / weight and variance; whether frames anywhere may disagree beyond the noise.

    The chi-square of the sums takes the noise of the weights' radiance: scaled so that it can only be too large.
    """
    zero, one, odd = np.float32(0), np.float32(1), 0
    for x in range(WINDOW):
        top, total = work[TOP + x], work[TOTAL + x]
        inverse = one / total if total > zero else zero
        mean = top * inverse
        level = max(mean, zero)
        shots = work[SHOTS + x] if optimal else total
        floors = work[FLOORS + x]
        chi2 = work[SQUARES + x] - mean * top
        least = longest[FLOOR + x] * longest[POISSON + x]
        weighed_at = max(work[LEVEL + x], level) + least if optimal else one
        odd |= 1 if chi2 * weighed_at > chi2_limit * (level + least) else 0
        work[TOP + x] = mean
        work[TOTAL + x] = inverse
        work[LEVEL + x] = level
        work[FLOORS + x] = (level * shots + floors) * inverse * inverse
        work[CHI2 + x] = zero
        work[COUNT + x] = zero
    return odd > 0


def _disagreement(dn: np.ndarray, coefficient: np.ndarray, work: np.ndarray) -> None:
    """Add how far one frame lies from the mean. One that clips tells only that it is more than its limit."""
    zero, one, slack = np.float32(0), np.float32(1), np.float32(RATIO_ERROR**2)
    for x in range(WINDOW):
        mean, level, limit = work[TOP + x], work[LEVEL + x], coefficient[LIMIT + x]
        value = (np.float32(dn[x]) - coefficient[BLACK + x]) * coefficient[SCALE + x]
        tells = (value < limit) | ((value >= limit) & (limit > mean))
        value = value if value < limit else limit
        misfit = value - mean if tells else zero
        noise = coefficient[SHOT + x] * level + coefficient[FLOOR + x]
        work[CHI2 + x] += misfit * misfit / (noise + slack * level * level)
        work[COUNT + x] += one if tells else zero


def _raise_ghosts(chi2_limits: np.ndarray, work: np.ndarray) -> None:
    """Where frames disagree, give the variance that they show, and mark it in the row COUNT."""
    zero, one = np.float32(0), np.float32(1)
    for x in range(WINDOW):
        count, chi2 = work[COUNT + x], work[CHI2 + x]
        ghost = (work[TOTAL + x] > zero) & (chi2 > chi2_limits[int(count)])
        work[FLOORS + x] = work[FLOORS + x] * chi2 / (count - one) if ghost else work[FLOORS + x]
        work[COUNT + x] = one if ghost else zero


def _write(work: np.ndarray, radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> bool:
    """Write a chunk; whether something in it clips in every frame."""
    zero, unseen = np.float32(0), 0
    chunk = work[MARGIN:]
    for x in range(len(radiance)):
        mean, spread = chunk[TOP + x], chunk[FLOORS + x]
        seen = chunk[TOTAL + x] > zero
        unseen |= 0 if seen else 1
        radiance[x] = mean
        variance[x] = spread if seen else np.float32(np.inf)
        bits = (GHOST if chunk[COUNT + x] > zero else 0) | (DARK if mean * abs(mean) < spread else 0)
        mask[x] = np.uint8(bits if seen else CLIPPED)
    return unseen > 0


def _bound(dn: np.ndarray, coefficient: np.ndarray, radiance: np.ndarray, mask: np.ndarray) -> None:
    """Put the bound that one frame gives where all clip. Called from the longest to the shortest, whose word stands."""
    for x in range(len(radiance)):
        j = MARGIN + x
        value = (np.float32(dn[j]) - coefficient[BLACK + j]) * coefficient[SCALE + j]
        if mask[x] == np.uint8(CLIPPED) and value >= coefficient[LIMIT + j]:
            radiance[x] = value
