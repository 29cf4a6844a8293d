"""Brackets of known radiance for the merge benchmark, and the bound that no unbiased estimator passes.

The sensor: 30 000 electrons at white, 3 of read noise, 14 bits. Five frames two stops apart; radiance 1 fills the
longest. The Cramer-Rao bound counts shot, read and rounding noise of every frame that white does not cut off at the
true radiance.
"""

from __future__ import annotations

import numpy as np

from pipeline.image import radiometry
from pipeline.image.noise import Noise
from pipeline.image.radiometry import Exposed

WHITE, BLACK, ELECTRONS, READ = 15800.0, 512.0, 30000.0, 3.0
STEP = 1 / (WHITE - BLACK)
MODEL = Noise(np.full((2, 2), 1 / ELECTRONS), np.full((2, 2), (READ / ELECTRONS) ** 2 + STEP**2 / 12), "given")
LIMIT = radiometry.linear_limits(np.full((2, 2), WHITE), np.full((2, 2), BLACK), WHITE, MODEL)
EXPOSURES = [4.0**-k for k in (4, 3, 2, 1, 0)]
DARKEST = 5 / ELECTRONS  # five electrons in the longest frame
BRIGHTEST = float(LIMIT[0, 0]) / EXPOSURES[0]  # the shortest frame clips


def photograph(radiance: np.ndarray, exposure: float, seed: int) -> np.ndarray:
    """(H, W) uint16 DN of a linear sensor: Poisson, read noise, rounding, clip."""
    random = np.random.default_rng(seed)
    electrons = random.poisson(np.minimum(radiance * exposure, 4) * ELECTRONS).astype(np.float32)
    electrons += np.float32(READ) * random.standard_normal(radiance.shape, np.float32)
    return np.clip(np.rint(electrons * np.float32(1 / ELECTRONS / STEP) + np.float32(BLACK)), 0, WHITE).astype(
        np.uint16
    )


def bracket(radiance: np.ndarray, seed: int, exposures: list[float] = EXPOSURES) -> list[np.ndarray]:
    """The frames of a radiance (H, W), shortest first."""
    return [photograph(radiance, exposure, 1000 * seed + i) for i, exposure in enumerate(exposures)]


def exposed(mosaics: list[np.ndarray], exposures: list[float] = EXPOSURES) -> list[Exposed]:
    """Frames ready to merge."""
    black = np.full((2, 2), BLACK)
    return [Exposed(mosaic, g, black, WHITE, LIMIT, MODEL) for mosaic, g in zip(mosaics, exposures, strict=True)]


def information(radiance: np.ndarray) -> np.ndarray:
    """Inverse of the Cramer-Rao bound on the variance of an unbiased estimate of a radiance."""
    total = np.zeros(radiance.shape)
    for g in EXPOSURES:
        total += np.where(g * radiance < 1, g * g / (g * radiance / ELECTRONS + MODEL.floor[0, 0]), 0)
    return total


def bins() -> np.ndarray:
    """Edges of bins of a third of a decade, from the darkest to the brightest radiance; the last may be shorter."""
    edges = DARKEST * 10 ** (np.arange(0, 3 * np.log10(BRIGHTEST / DARKEST)) / 3)
    return np.append(edges, BRIGHTEST)


def ramp(height: int, width: int) -> np.ndarray:
    """(H, W) radiance over the whole range, darkest row first."""
    return np.repeat(np.geomspace(DARKEST, BRIGHTEST * (1 - 1e-9), height)[:, None], width, 1)
