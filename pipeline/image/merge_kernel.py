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

import numpy as np

from pipeline.image import merge_chunk, merge_clipped, merge_unclipped
from pipeline.image.machine_code import compiled
from pipeline.image.merge_chunk import ALL, CHUNK, NONE, REACH, SOME, load, load_around, store
from pipeline.image.merge_clipped import settle_clipped
from pipeline.image.merge_unclipped import settle_unclipped

BRIGHT_RATIO = 50.0  # shot over read noise, as variances: here Poisson weights lose 1.1 %, at ten times this 0.03 %


@functools.cache
def rows_kernel() -> Callable[..., None]:
    """`merge_rows`, compiled."""
    own = (_clipping, _unclipped_first, _is_bright)
    return compiled(merge_rows, *own, *merge_chunk.PARTS, *merge_unclipped.PARTS, *merge_clipped.PARTS, counted=False)


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
                load(dn, f, start, whole, coefficients[parity], memory)
                state[f], least[f] = _clipping(dn[near], bounds[f])
            usual, bright = _unclipped_first(state), poisson or _is_bright(state, least, bounds)
            if usual == 0 or not bright:
                for f in range(frames):
                    load_around(samples[f][row], f, start, coefficients[parity], memory)
            for c in range(colours):
                one, sums, limit = unclipped[parity, c, usual], together[parity, c, usual], chi2_limits[usual]
                if usual == 0 or not settle_unclipped(
                    memory[c], one, sums, bright, limit, usual, like, streams, later + c * CHUNK
                ):
                    settle_clipped(memory[c], state, coefficients[parity, c], bright, chi2_limits)
            store(memory, start, whole, radiance[row], variance[row], mask[row])


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
