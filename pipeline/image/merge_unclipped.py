"""Chunks of which the first frames do not clip and all longer ones clip wholly, in the merge's kernel: the usual."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.conventions import DARK, GHOST
from pipeline.image.machine_code import LINE, ask_for_line, numbers
from pipeline.image.merge_chunk import BITS, CHUNK, MARGIN, RATIO_ERROR, ROUGH, SIGNALS, SPREAD, TOP, WINDOW

BLOCK = 64  # photosites that memory is asked for at a time


def settle_unclipped(
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


def _settle(mean: Any, spread: Any, chi2: Any, chi2_limit: Any, freedom: Any) -> tuple[Any, Any]:
    """Variance, raised to what the frames show where they disagree, and the bits of the mask."""
    ghost = chi2 > chi2_limit
    spread = spread * chi2 * freedom if ghost else spread
    bits = np.float32(GHOST) if ghost else np.float32(0)
    return spread, bits + (np.float32(DARK) if mean * abs(mean) < spread else np.float32(0))


def _ask_for(streams: np.ndarray, place: int) -> None:
    """Have memory send `BLOCK` photosites from ``place`` on, of all frames and results."""
    for s in range(len(streams)):
        size = streams[s, 1]
        for byte in range(place * size, (place + BLOCK) * size, LINE):
            ask_for_line(streams[s, 0] + byte)


PARTS = (settle_unclipped, _bright, _rough_mean, _dim, _chi2, _settle, _ask_for)
