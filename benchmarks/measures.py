"""What is measured: error as the eye would see it, CPU seconds, and the ratio of costs at equal error.

The error of a picture is the mean of squared differences in sRGB code values (0 to 255) after a stated exposure, over
all pixels and channels, against the truth. The truth is known only through renders with noise of their own. Two
independent ones, A and B, give the error without that noise and without having to know it:

    E (X - A)(X - B) = E (X - truth)^2      A, B unbiased, independent of X and of each other

A picture without bias costs CPU seconds inversely to its error, so ``error * cpu`` says what a strategy is worth and
the ratio of two such products is a speed-up. A biased picture (a region left out, a denoiser) has no such constant: it
is compared at its own error with what the unbiased strategy would have needed to reach that.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from pipeline.image.colour import encode_srgb

MID_GREY = 0.18


@dataclass
class Timer:
    """CPU seconds spent inside the block of `cpu_seconds`, once it is over."""

    seconds: float = np.nan
    wall: float = np.nan


@contextmanager
def cpu_seconds() -> Iterator[Timer]:
    """User and system time of all threads of this process and of its finished children."""
    timer = Timer()

    def used() -> float:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return time.process_time() + children.ru_utime + children.ru_stime

    start, wall = used(), time.perf_counter()
    try:
        yield timer
    finally:
        timer.seconds, timer.wall = used() - start, time.perf_counter() - wall


def exposure_gain(plate: np.ndarray) -> float:
    """Factor that puts the median of the plate's green channel, (H, W, 3) or (N, 3), at mid grey."""
    return float(MID_GREY / np.median(plate[..., 1]))


def display(picture: np.ndarray, gain: float) -> np.ndarray:
    """Code values 0 to 255, not rounded, of scene-linear values (..., 3): the sRGB curve on each channel, clipped."""
    return 255 * encode_srgb(np.clip(picture * gain, 0, 1))


def squared_error(shown: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Mean squared error of ``shown`` against what ``first`` and ``second`` independently estimate; see above."""
    return float(np.mean((shown - first) * (shown - second)))


def speedup(cheap: list[tuple[float, float]], dear: list[tuple[float, float]]) -> float:
    """Cost of ``dear`` over that of ``cheap`` at equal error, both unbiased: medians of (error, CPU s) products."""
    return product(dear) / product(cheap)


def product(runs: list[tuple[float, float]]) -> float:
    """Median over runs of error times CPU seconds."""
    return float(np.median([error * seconds for error, seconds in runs]))


def speedup_at(error: float, seconds: float, dear: list[tuple[float, float]]) -> float:
    """CPU seconds of an unbiased strategy at ``error``, from its runs (error, CPU s), over ``seconds``."""
    return product(dear) / error / seconds
