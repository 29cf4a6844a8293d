"""Large pictures of which little will be written."""

from __future__ import annotations

import mmap

import numpy as np


def blank(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros, float32, whose memory is taken page by page (4 kB) where something is written.

    An array of numpy's own takes 2 MB at the first touch where the system has such pages, and zeroing those costs more
    than what is written.
    """
    size = int(np.prod(shape))
    return np.frombuffer(mmap.mmap(-1, max(4 * size, 1)), np.float32, size).reshape(shape)
