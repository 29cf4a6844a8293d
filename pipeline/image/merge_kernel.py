"""The merge of rows of photosites as one compiled loop; `radiometry.merge` says what it estimates and hands rows over.

A row is taken in chunks. A chunk is first sorted by colour: then all coefficients are numbers, which stay in registers,
and neighbours of one colour lie side by side. Every inner loop is a plain pass over such a chunk, of a length that the
compiler knows and with selections instead of branches; the frames are a tuple, whose length it knows as well: so it
unrolls the loop over frames and turns that over photosites into vector instructions without remainder. Memory is asked
for the next chunk a little at a time in between, so that it works while the processor does. What is rare is found by a
cheap test of the whole chunk and only then worked out: samples that clip, pixels so dark that read noise matters,
frames that disagree.

All arithmetic is float32, neither contracted nor reordered, so that bits agree on every processor and powers of two in
the exposures go straight through.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.conventions import CLIPPED, DARK, GHOST
from pipeline.image.machine_code import LINE, ask_for_line, compiled, numbers

CHUNK = 512  # photosites of one colour that a pass settles: whole vectors, and all that it needs stays in cache
BLOCK = 64  # photosites that memory is asked for at a time
REACH = 2  # of its neighbours on either side are looked at
MARGIN = 16  # room for them in the working memory, a whole vector
WINDOW = CHUNK + 2 * MARGIN
ROWS = range(0, 10 * WINDOW, WINDOW)  # beginnings in a colour's working memory
TOP, SPREAD, CHI2, BITS, ROUGH, LEVEL, SQUARES, TOTAL, SHOTS, SIGNALS = ROWS  # the last: of frame after frame
BLACK, SCALE, SHOT, FLOOR, LIMIT, POISSON = range(6)  # a frame's coefficients
SLOTS = (5, 9, 16)  # frames that a kernel is compiled for; more in multiples of the last
NONE, SOME, ALL = range(3)  # of a chunk's samples clip
BRIGHT_RATIO = 50.0  # shot over read noise, as variances: here Poisson weights lose 1.1 %, at ten times this 0.03 %
RATIO_ERROR = 0.005  # relative disagreement of frames that exposure error and flicker explain
BOUND_SIGMA = 4.0  # a clipped sample that lies farther above the shorter frames is no noise but motion


@functools.cache
def rows_kernel() -> Callable[..., None]:
    """`merge_rows`, compiled."""
    load = (_load, _load_around, _sample, _split_two, _clipping, _unclipped_first)
    usual = (_is_bright, _usual, _settle, _bright, _rough_mean, _dim, _chi2)
    rare = (_careful, _sums, _add, _add_careful, _anything_below, _rough, _level, _mean, _disagreement, _raise_ghosts)
    write = (_ask_for, _write, _bound, _store, _join_two)
    return compiled(merge_rows, *load, *usual, *rare, *write, counted=False)


def slots(frames: int) -> int:
    """Length of the tuple of frames that `merge_rows` takes for so many; the last stands in for those that lack."""
    return next((count for count in SLOTS if count >= frames), -(-frames // SLOTS[-1]) * SLOTS[-1])


def working_memory(frames: int, colours: int) -> np.ndarray:
    """(colours, S) float32 zeros for `merge_rows`, whose rows start on whole vectors and lines of cache."""
    size = SIGNALS + slots(frames) * WINDOW
    flat = np.zeros(colours * size + 16, np.float32)
    start = -(flat.ctypes.data // 4) % 16
    return flat[start : start + colours * size].reshape(colours, size)


def merge_rows(
    samples: tuple[np.ndarray, ...],
    first: int,
    coefficients: np.ndarray,
    unclipped: np.ndarray,
    together: np.ndarray,
    bounds: np.ndarray,
    poisson: bool,
    chi2_limits: np.ndarray,
    like: tuple[int, ...],
    streams: np.ndarray,
    memory: np.ndarray,
    state: np.ndarray,
    least: np.ndarray,
    radiance: np.ndarray,
    variance: np.ndarray,
    mask: np.ndarray,
) -> None:
    """Radiance, variance, mask (h, S) of as many rows of ``samples``, DN, frames from the shortest, from ``first`` on.

    All arrays are contiguous: ``streams`` (N, 2) says where those of samples and results begin, and bytes per element.
    ``like``: a tuple of the length of ``samples``, `slots`. ``memory``: `working_memory`; ``state``, ``least`` (F,).

    Of even and odd rows and the C colours of a row: ``coefficients`` (2, C, F, 6) black [DN]; then in units of
    radiance 1 DN, shot noise (variance over radiance), floor (variance), linear limit, 1 / shot. Of the first n frames
    alone: ``unclipped`` (2, C, F + 1, 5, slots) their 1 DN over shot, 1 DN, shot, floor, and whether they are one of
    these; ``together`` (2, C, F + 1, 5) sums 1 / (sum of 1 / shot), sum of 1 / shot, floors, limit of the next frame,
    floor over shot of the last. ``bounds`` (F, 3): DN below which nothing clips, from which on all does, and from
    which on read noise does not matter. ``chi2_limits`` (F + 1,): of as many frames. NaN are left out.
    """
    (height, width), (colours, frames) = radiance.shape, coefficients.shape[1:3]
    cells = -(-width // colours)
    for row in range(height):
        parity = (first + row) % 2
        for number in range(-(-cells // CHUNK)):
            start = max(min(number * CHUNK, cells - CHUNK), 0)
            whole = (start + CHUNK) * colours <= width
            near = slice(max(start - REACH, 0) * colours, min((start + CHUNK + REACH) * colours, width))
            later = row * width + (start + CHUNK) * colours
            for f in range(frames):
                dn = samples[f][row]
                _load(dn, f, start, whole, coefficients[parity], memory)
                state[f], least[f] = _clipping(dn[near], bounds[f])
            usual, bright = _unclipped_first(state), poisson or _is_bright(state, least, bounds)
            if usual == 0 or not bright:
                for f in range(frames):
                    _load_around(samples[f][row], f, start, coefficients[parity], memory)
            for c in range(colours):
                one, sums, limit = unclipped[parity, c, usual], together[parity, c, usual], chi2_limits[usual]
                if usual == 0 or not _usual(
                    memory[c], one, sums, bright, limit, usual, like, streams, later + c * CHUNK
                ):
                    _careful(memory[c], state, coefficients[parity, c], bright, chi2_limits)
            _store(memory, start, whole, radiance[row], variance[row], mask[row])


def _ask_for(streams: np.ndarray, place: int) -> None:
    """Have memory send `BLOCK` photosites from ``place`` on, of all frames and results."""
    for s in range(len(streams)):
        size = streams[s, 1]
        for byte in range(place * size, (place + BLOCK) * size, LINE):
            ask_for_line(streams[s, 0] + byte)


def _load(row: np.ndarray, f: int, start: int, whole: bool, coefficients: np.ndarray, memory: np.ndarray) -> None:
    """Signal [DN above black] of frame ``f`` from cell ``start`` of a row on, by colour."""
    colours = len(memory)
    at, inner = SIGNALS + f * WINDOW + MARGIN, slice(start * colours, (start + CHUNK) * colours)
    if whole and colours == 2:
        _split_two(row[inner], coefficients[0, f, BLACK], coefficients[1, f, BLACK], memory[0, at:], memory[1, at:])
        return
    for c in range(colours):
        black = coefficients[c, f, BLACK]
        for x in range(CHUNK if whole else 0):
            memory[c, at + x] = np.float32(row[(start + x) * colours + c]) - black
        for x in range(0 if whole else CHUNK):
            memory[c, at + x] = _sample(row, start + x, c, colours) - black


def _load_around(row: np.ndarray, f: int, start: int, coefficients: np.ndarray, memory: np.ndarray) -> None:
    """`_load` of the neighbours of a chunk on either side."""
    colours, at = len(memory), SIGNALS + f * WINDOW + MARGIN
    for c in range(colours):
        for x in (-2, -1, CHUNK, CHUNK + 1):
            memory[c, at + x] = _sample(row, start + x, c, colours) - coefficients[c, f, BLACK]


def _sample(row: np.ndarray, cell: int, colour: int, colours: int) -> np.float32:
    """A sample of a row; beyond its ends one of the same colour from inside it."""
    place = cell * colours + colour
    if place < 0 or place >= len(row):
        last = (len(row) - 1 - colour) // colours
        cell = 2 - cell if cell < 0 else 2 * last - 2 - cell if cell > last else cell  # -1 is 3, -2 is 4: none twice
        place = min(max(min(cell, last), 0) * colours + colour, len(row) - 1)
    return np.float32(row[place])


def _split_two(row: np.ndarray, black: float, black_2: float, even: np.ndarray, odd: np.ndarray) -> None:
    for x in range(CHUNK):
        even[x] = np.float32(row[2 * x]) - black
        odd[x] = np.float32(row[2 * x + 1]) - black_2


def _clipping(dn: np.ndarray, bounds: np.ndarray) -> tuple[int, float]:
    """Whether none, some or all of a chunk clips, as its extremes tell, and the least; some, if one is no number."""
    least, most, strange = dn[0], dn[0], 0
    for x in range(len(dn)):
        least, most = (dn[x] if dn[x] < least else least), (dn[x] if dn[x] > most else most)
    for x in range(len(dn)):
        strange |= 0 if dn[x] == dn[x] else 1
    if strange > 0:
        return SOME, 0.0
    return NONE if most < bounds[0] else ALL if least >= bounds[1] else SOME, float(least)


def _unclipped_first(state: np.ndarray) -> int:
    """How many frames do not clip in a chunk, when all longer ones clip wholly; else none."""
    count = 0
    for f in range(len(state)):
        if state[f] == SOME or (state[f] == NONE and count < f):
            return 0
        count = f + 1 if state[f] == NONE else count
    return count


def _is_bright(state: np.ndarray, least: np.ndarray, bounds: np.ndarray) -> bool:
    """Whether the longest frame of which nothing clips says that read noise matters nowhere in a chunk."""
    bright = False
    for f in range(len(state)):
        bright = bool(least[f] >= bounds[f, 2]) if state[f] == NONE else bright
    return bright


def _usual(
    memory: np.ndarray,
    one: np.ndarray,
    sums: np.ndarray,
    bright: bool,
    chi2_limit: float,
    frames: int,
    like: Any,
    streams: np.ndarray,
    later: int,
) -> bool:
    """Settle a colour of a chunk of ``frames`` unclipped frames; not if a longer one, which clips, lies above them."""
    freedom: Any = np.float32(1 / max(frames - 1, 1))
    if bright:
        return not _bright(memory, one, sums, chi2_limit, freedom, like, streams, later)
    if _rough_mean(memory, one, sums, like):
        return False
    if _dim(memory, one, sums, chi2_limit, like, streams, later):
        _chi2(memory, one, chi2_limit, freedom, like)
    return True


def _settle(mean: Any, spread: Any, chi2: Any, chi2_limit: Any, freedom: Any) -> tuple[Any, Any]:
    """Variance, raised to what the frames show where they disagree, and the bits of the mask."""
    ghost = chi2 > chi2_limit
    spread = spread * chi2 * freedom if ghost else spread
    bits = np.float32(GHOST) if ghost else np.float32(0)
    return spread, bits + (np.float32(DARK) if mean * abs(mean) < spread else np.float32(0))


def _bright(
    memory: np.ndarray,
    one: np.ndarray,
    sums: np.ndarray,
    chi2_limit: float,
    freedom: float,
    like: Any,
    streams: np.ndarray,
    later: int,
) -> bool:
    """All of a chunk where Poisson weights do; whether the mean lies anywhere below a limit that it should pass."""
    counts, scale, shot = numbers(one[0], like), numbers(one[1], like), numbers(one[2], like)
    floor, used = numbers(one[3], like), numbers(one[4], like)
    inverse, total, floors, limit = sums[0], sums[1], sums[2], sums[3]
    zero, slack, below = np.float32(0), np.float32(RATIO_ERROR**2), np.int32(0)
    for block in range(0, CHUNK, BLOCK):
        _ask_for(streams, later + block)
        for x in range(MARGIN + block, MARGIN + block + BLOCK):
            top, chi2 = zero, zero
            for f in range(len(counts)):
                top += memory[SIGNALS + f * WINDOW + x] * counts[f]
            mean = top * inverse
            level = max(mean, zero)
            extra = slack * level * level
            for f in range(len(counts)):
                misfit = memory[SIGNALS + f * WINDOW + x] * scale[f] - mean
                chi2 += used[f] * (misfit * misfit) / (shot[f] * level + floor[f] + extra)
            spread = (level * total + floors) * inverse * inverse
            below = np.int32(below | np.int32(mean < limit))
            memory[TOP + x] = mean
            memory[SPREAD + x], memory[BITS + x] = _settle(mean, spread, chi2, chi2_limit, freedom)
    return bool(below > 0)


def _rough_mean(memory: np.ndarray, one: np.ndarray, sums: np.ndarray, like: Any) -> bool:
    """Mean by Poisson weights, of the chunk and its neighbours; whether it lies below a limit that it should pass."""
    counts, inverse, limit, below = numbers(one[0], like), sums[0], sums[3], np.int32(0)
    for x in range(MARGIN, MARGIN + CHUNK):
        top = np.float32(0)
        for f in range(len(counts)):
            top += memory[SIGNALS + f * WINDOW + x] * counts[f]
        memory[ROUGH + x] = top * inverse
        below = np.int32(below | np.int32(top * inverse < limit))
    for place in (MARGIN - 2, MARGIN - 1, MARGIN + CHUNK, MARGIN + CHUNK + 1):
        top = np.float32(0)
        for f in range(len(counts)):
            top += memory[SIGNALS + f * WINDOW + place] * counts[f]
        memory[ROUGH + place] = top * inverse
    return bool(below > 0)


def _dim(
    memory: np.ndarray, one: np.ndarray, sums: np.ndarray, chi2_limit: float, like: Any, streams: np.ndarray, later: int
) -> bool:
    """All of a chunk but its chi-square, with weights of the neighbours' mean; whether it may be too large anywhere.

    The chi-square of the sums takes the noise of the weights' radiance: scaled so that it can only be too large.
    """
    scale, shot, floor = numbers(one[1], like), numbers(one[2], like), numbers(one[3], like)
    used, least = numbers(one[4], like), sums[4]
    zero, quarter, odd = np.float32(0), np.float32(0.25), np.int32(0)
    for block in range(0, CHUNK, BLOCK):
        _ask_for(streams, later + block)
        for x in range(MARGIN + block, MARGIN + block + BLOCK):
            around = (memory[ROUGH + x - 2] + memory[ROUGH + x + 2]) + (memory[ROUGH + x - 1] + memory[ROUGH + x + 1])
            level = max(quarter * around, zero)
            top, squares, total, shots, floors = zero, zero, zero, zero, zero
            for f in range(len(scale)):
                value = memory[SIGNALS + f * WINDOW + x] * scale[f]
                weight = used[f] / (shot[f] * level + floor[f])
                weighted, square = weight * value, weight * weight
                top += weighted
                squares += weighted * value
                total += weight
                shots += square * shot[f]
                floors += square * floor[f]
            inverse = np.float32(1) / total
            mean = top * inverse
            own = max(mean, zero)
            chi2 = squares - mean * top
            odd = np.int32(odd | np.int32(chi2 * (max(level, own) + least) > chi2_limit * (own + least)))
            memory[TOP + x] = mean
            memory[SPREAD + x], memory[BITS + x] = _settle(
                mean, (own * shots + floors) * inverse * inverse, zero, zero, zero
            )
    return bool(odd > 0)


def _chi2(memory: np.ndarray, one: np.ndarray, chi2_limit: float, freedom: float, like: Any) -> None:
    """What `_dim` left: the chi-square of its mean, and what follows from it."""
    scale, shot, floor = numbers(one[1], like), numbers(one[2], like), numbers(one[3], like)
    used, zero, slack = numbers(one[4], like), np.float32(0), np.float32(RATIO_ERROR**2)
    for x in range(MARGIN, MARGIN + CHUNK):
        mean, chi2 = memory[TOP + x], zero
        level = max(mean, zero)
        extra = slack * level * level
        for f in range(len(scale)):
            misfit = memory[SIGNALS + f * WINDOW + x] * scale[f] - mean
            chi2 += used[f] * (misfit * misfit) / (shot[f] * level + floor[f] + extra)
        memory[SPREAD + x], memory[BITS + x] = _settle(mean, memory[SPREAD + x], chi2, chi2_limit, freedom)


def _careful(
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
        weighted, square = weight * value, weight * weight
        memory[TOP + x] += weighted
        memory[SQUARES + x] += weighted * value
        memory[TOTAL + x] += weight
        memory[SHOTS + x] += square * shot
        memory[SPREAD + x] += square * floor
    return bool(odd > 0)


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


def _store(
    memory: np.ndarray, start: int, whole: bool, radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray
) -> None:
    """Put a chunk's colours back into their row."""
    colours = len(memory)
    if whole and colours == 2:
        inner = slice(start * colours, (start + CHUNK) * colours)
        _join_two(memory[0], memory[1], radiance[inner], variance[inner], mask[inner])
        return
    for c in range(colours):
        for x in range(min(CHUNK, (len(radiance) - c + colours - 1) // colours - start)):
            place, at = (start + x) * colours + c, MARGIN + x
            radiance[place], variance[place] = memory[c, TOP + at], memory[c, SPREAD + at]
            mask[place] = np.uint8(memory[c, BITS + at])


def _join_two(even: np.ndarray, odd: np.ndarray, radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> None:
    for x in range(CHUNK):
        radiance[2 * x], radiance[2 * x + 1] = even[TOP + MARGIN + x], odd[TOP + MARGIN + x]
    for x in range(CHUNK):
        variance[2 * x], variance[2 * x + 1] = even[SPREAD + MARGIN + x], odd[SPREAD + MARGIN + x]
    for x in range(CHUNK):
        mask[2 * x], mask[2 * x + 1] = np.uint8(even[BITS + MARGIN + x]), np.uint8(odd[BITS + MARGIN + x])
