"""Frames of a simulated sensor: electrons are Poisson, read noise Gaussian, samples rounded to DN and clipped."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.image.noise import Noise
from pipeline.types import Frame

WHITE, BLACK, ELECTRONS, READ = 15800.0, 512.0, 30000.0, 3.0
STEP = 1 / (WHITE - BLACK)
FLOOR = (READ / ELECTRONS) ** 2 + STEP**2 / 12
MODEL = Noise(np.full((2, 2), 1 / ELECTRONS), np.full((2, 2), FLOOR), "given")


def expose(
    radiance: np.ndarray,
    exposure: float,
    random: np.random.Generator,
    gain: float | np.ndarray = 1.0,
    full_well: float = ELECTRONS,
) -> np.ndarray:
    """Normalised signal float32: ``radiance * exposure`` = 1 is white; ``gain`` is each photosite's (PRNU)."""
    return (photograph(radiance, exposure, random, gain, full_well).astype(np.float32) - BLACK) * np.float32(STEP)


def photograph(
    radiance: np.ndarray,
    exposure: float,
    random: np.random.Generator,
    gain: float | np.ndarray = 1.0,
    full_well: float = ELECTRONS,
) -> np.ndarray:
    """The same as uint16 DN."""
    electrons = random.poisson(np.clip(radiance * exposure * gain, 0, 4) * full_well)
    electrons = electrons + READ * random.standard_normal(radiance.shape)
    return np.clip(np.rint(electrons / full_well / STEP + BLACK), 0, WHITE).astype(np.uint16)


def frame(**changes: Any) -> Frame:
    """A frame of this sensor: 1/60 s, ISO 100, f/8."""
    facts = {
        "file": "a.dng", "sha256": "", "exposure_s": 1 / 60, "iso": 100.0, "fnumber": 8.0, "width": 640, "height": 480,
        "cfa": "RGGB", "black": np.full((2, 2), BLACK), "white": WHITE, "camera": "One",
    }  # fmt: skip
    return Frame(**{**facts, **changes})


def hills(height: int = 240, width: int = 320, seed: int = 0) -> np.ndarray:
    """Radiance (H, W) over four decades, smooth along a row with some grain."""
    random = np.random.default_rng(seed)
    level = np.exp(random.normal(-3, 1.5, (height, 1)))
    walk = np.exp(0.06 * np.cumsum(random.standard_normal((height, width)), 1))
    return np.clip(level * walk, 1e-4, 3)
