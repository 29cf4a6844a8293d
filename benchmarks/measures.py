"""What is measured: error as the eye would see it, CPU seconds, and the ratio of costs at equal error.

The error of a picture is the mean of squared differences in sRGB code values (0 to 255) after a stated exposure, over
all pixels and channels, against the truth. The truth is known only through renders with noise of their own. Two
independent ones, A and B, give the error without that noise and without having to know it:

    E (X - A)(X - B) = E (X - truth)^2      A, B unbiased, independent of X and of each other

A speed-up is a ratio of CPU seconds at equal error: a picture's own seconds, against those at which the other strategy,
without bias, reaches the same error. Its curve is measured, and continued as one over time. That holds for biased
pictures (a region left out, a denoiser) too, at the error where they were measured; there the bias counts as error.
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


@dataclass(frozen=True)
class Point:
    """One picture: its squared error in code values, what it cost, and the samples per pixel asked for."""

    error: float
    cpu_s: float
    samples: int = 0


def middle(points: list[Point]) -> Point:
    """The median of replicates, error and cost apart."""
    error, seconds = (float(np.median([getattr(p, name) for p in points])) for name in ("error", "cpu_s"))
    return Point(error, seconds, points[0].samples)


def cost_at(error: float, curve: list[Point]) -> float:
    """CPU seconds at which a curve of a strategy without bias reaches ``error``.

    Log-log interpolation between its points; beyond them the error of an unbiased mean falls as one over time.
    """
    points = sorted(curve, key=lambda p: p.cpu_s)
    if error >= points[0].error:
        return points[0].cpu_s * points[0].error / error
    if error <= points[-1].error:
        return points[-1].cpu_s * points[-1].error / error
    errors, seconds = (np.log([getattr(p, name) for p in reversed(points)]) for name in ("error", "cpu_s"))
    return float(np.exp(np.interp(np.log(error), errors, seconds)))


def speedup(point: Point, curve: list[Point]) -> float:
    """How many times the CPU seconds of ``point`` the strategy of ``curve`` needs for the same error."""
    return cost_at(point.error, curve) / point.cpu_s
