"""Photo-response non-uniformity (PRNU) of a sensor, from flat parts of a merged mosaic.

Without texture the photosites of one colour scatter by temporal noise, which is known, and by their own gains. Texture
only adds to that, so the blocks of a picture pile up at the sensor's PRNU with a tail above it. A lens spreads whatever
texture there is over photosites of all colours, while gains of neighbours have nothing to do with each other: blocks
whose colours vary together are no measurement.

Source: Janesick, Photon Transfer, 2007 (fixed pattern noise); the two tests that tell it from texture are ours.
Limits: mosaics only, for demosaicking mixes the photosites; a print's or a weave's grain at the scale of one photosite
that fills the picture evenly, in no colour's common rhythm, would be taken for the sensor's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.image.cells import planes

SIDE = 16  # photosites of one colour along a block
MAX_PIXELS = 4_000_000
MAX_NOISE = 0.01  # relative, temporal, in a block that is used
MAX_PRNU = 0.03  # beyond, it is no sensor's
MIN_BLOCKS = 40  # that agree
WHITE_GAIN = 1.25  # variance of white noise after `_high_pass`
CORRELATED = 3.38 / SIDE**2  # squared relative error of a block's variance: 2/n times the residuals' correlation
COMMON = 0.1  # of the pattern's variance that the colours may share


@dataclass(frozen=True)
class FixedPattern:
    """PRNU (relative standard deviation), its relative standard uncertainty, blocks; ``believed`` or an upper bound."""

    prnu: float
    sigma: float
    blocks: int
    believed: bool
    because: str


def measure(radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> FixedPattern | None:
    """PRNU of a merged mosaic (H, W) with its temporal variance and its flags; None without flat and bright parts."""
    if radiance.ndim != 2 or min(radiance.shape) < 4 * SIDE:
        return None
    excess, sigma, common = _blocks(radiance, variance, mask)
    if len(excess) < MIN_BLOCKS:
        return None
    centre, chosen = _pile(excess, sigma)
    count = int(np.count_nonzero(chosen))
    if count < MIN_BLOCKS:
        return None
    weight = 1 / sigma[chosen] ** 2
    error = float(1 / np.sqrt(weight.sum()))
    shared = float(np.average(common[chosen], weights=weight))
    least = float(np.sqrt(max(centre, 0) + 3 * error))
    if centre < 3 * error:
        return FixedPattern(least, 1.0, count, False, "no scatter beyond the noise in flat parts")
    if shared > COMMON * centre + 3 * error:
        return FixedPattern(least, 1.0, count, False, "the colours vary together: texture, not the sensor")
    if centre > MAX_PRNU**2:
        return FixedPattern(least, 1.0, count, False, "more than any sensor has: texture")
    relative = float(np.hypot(error, abs(shared)) / (2 * centre))
    return FixedPattern(float(np.sqrt(centre)), relative, count, True, f"{count} flat blocks agree")


def _blocks(radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per usable block (N,): relative variance beyond the noise, its standard error, what the colours share of it."""
    step = max(1, round(radiance.size / MAX_PIXELS))
    found = []
    for start in range(0, radiance.shape[0] - 2 * SIDE - 3, (2 * SIDE + 4) * step):
        rows = slice(start, start + 2 * SIDE + 4)  # two more on either side for the high pass
        parts = zip(*(planes(values[rows]) for values in (radiance, variance, mask)))
        cells = [_strip(*part) for part in parts]
        residuals, totals, noises = (np.stack(values) for values in zip(*cells))
        scatter = np.mean(residuals**2, (1, 3)) / WHITE_GAIN  # (4, blocks)
        pairs = [(0, 1), (0, 2), (1, 3), (2, 3)]
        common = np.mean([np.mean(residuals[i] * residuals[j], (0, 2)) for i, j in pairs], 0) / WHITE_GAIN
        good = np.all(totals, 0) & np.all(noises < MAX_NOISE**2, 0)
        error = np.sqrt(CORRELATED * np.mean(scatter**2, 0) / len(cells))
        values = (np.mean(scatter - noises, 0), error, common)
        found.append(np.stack([value[good] for value in values]))
    together = np.concatenate(found, 1) if found else np.zeros((3, 0))
    return together[0], together[1], together[2]


def _strip(radiance: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One colour of a strip: relative high-pass residuals (SIDE, blocks, SIDE), usable (blocks,), noise (blocks,)."""
    width = (radiance.shape[1] - 2) // SIDE * SIDE

    def blocks(values: np.ndarray) -> np.ndarray:
        return values[1 : 1 + SIDE, 1 : 1 + width].reshape(SIDE, -1, SIDE)

    padded = np.where(mask == 0, radiance, np.nan)
    smooth = (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4
    high = np.full_like(padded, np.nan)
    high[1:-1, 1:-1] = padded[1:-1, 1:-1] - smooth
    level = blocks(padded).mean((0, 2), dtype=np.float64)
    usable = np.isfinite(level) & (level > 0) & np.isfinite(blocks(high)).all((0, 2))
    safe = np.where(usable, level, 1.0)
    residual = np.where(usable[:, None], blocks(high) / safe[:, None], 0.0)
    noise = np.where(usable, blocks(variance).mean((0, 2), dtype=np.float64), 1.0) / safe**2
    return residual, usable, noise


def _pile(excess: np.ndarray, sigma: np.ndarray) -> tuple[float, np.ndarray]:
    """Where most blocks agree with few below, and those that do: texture adds, so nothing lies below the sensor's."""
    trial = np.quantile(excess, np.linspace(0.005, 0.995, 200))
    pull = (excess[None, :] - trial[:, None]) / sigma
    score = np.count_nonzero(np.abs(pull) < 2, 1) - 5 * np.count_nonzero(pull < -2.5, 1)
    centre = float(trial[np.argmax(score)])
    for _ in range(20):  # symmetric about the centre, so that the tail's pull stays small
        chosen = np.abs(excess - centre) < 1.5 * sigma
        if not chosen.any():
            break
        previous, centre = centre, float(np.average(excess[chosen], weights=1 / sigma[chosen] ** 2))
        if abs(centre - previous) < 1e-4 * abs(centre):
            break
    return centre, np.abs(excess - centre) < 2 * sigma
