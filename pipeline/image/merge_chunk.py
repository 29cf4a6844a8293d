"""The working memory of the merge's kernel: a chunk of a row, sorted by colour, into it and out of it again."""

from __future__ import annotations

import numpy as np

CHUNK = 512  # photosites of one colour that a pass settles: whole vectors, and all that it needs stays in cache
REACH = 2  # of its neighbours on either side are looked at
MARGIN = 16  # room for them in the working memory, a whole vector
WINDOW = CHUNK + 2 * MARGIN
ROWS = range(0, 10 * WINDOW, WINDOW)  # beginnings in a colour's working memory
TOP, SPREAD, CHI2, BITS, ROUGH, LEVEL, SQUARES, TOTAL, SHOTS, SIGNALS = ROWS  # the last: of frame after frame
BLACK, SCALE, SHOT, FLOOR, LIMIT, POISSON = range(6)  # a frame's coefficients
SLOTS = (5, 9, 16)  # frames that a kernel is compiled for; more in multiples of the last
NONE, SOME, ALL = range(3)  # of a chunk's samples clip
RATIO_ERROR = 0.005  # relative disagreement of frames that exposure error and flicker explain


def slots(frames: int) -> int:
    """Length of the tuple of frames that `merge_rows` takes for so many; the last stands in for those that lack."""
    return next((count for count in SLOTS if count >= frames), -(-frames // SLOTS[-1]) * SLOTS[-1])


def working_memory(frames: int, colours: int) -> np.ndarray:
    """(colours, S) float32 zeros for `merge_rows`, whose rows start on whole vectors and lines of cache."""
    size = SIGNALS + slots(frames) * WINDOW
    flat = np.zeros(colours * size + 16, np.float32)
    start = -(flat.ctypes.data // 4) % 16
    return flat[start : start + colours * size].reshape(colours, size)


def load(row: np.ndarray, f: int, start: int, whole: bool, coefficients: np.ndarray, memory: np.ndarray) -> None:
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


def load_around(row: np.ndarray, f: int, start: int, coefficients: np.ndarray, memory: np.ndarray) -> None:
    """`load` of the neighbours of a chunk on either side."""
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


def store(
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


PARTS = (load, load_around, _sample, _split_two, store, _join_two)
