"""Exposure of a ball's frames against the plate's, measured where the ball changes nothing.

When the camera stood still, plate and ball photograph show one scene but for the ball, its shadow, its glow and what
else changed in between. Pictures are averaged over blocks; the ratio that most blocks share (shortest half, then
Tukey's biweight) is that of the exposures. Blocks near what disagrees are left out: the glow of the ball fades with
distance. What remains of it is no noise and does not average away, so it is stated as a floor.

Sources: Rousseeuw and Leroy 1988 (shortest half), Beaton and Tukey 1974 (biweight).
Limits: more than half of the well exposed blocks must be unchanged. Light that changes everywhere looks like exposure;
only frames of one setting, where the views share one, can tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.image.noise import Noise

BLOCKS = 3000  # in a picture: 16 px at a megapixel
LEAST_SIGNAL = 0.004  # of full scale: the black level's error stays below the floor
FLOOR = 0.002  # relative: what the ball does to light far from it; goes with one over root of the share that agrees
CHANGED = 0.01  # a block and its neighbours that differ by more have been changed by the ball or in its time
MAX_NOISE = 0.02  # relative, of a block's ratio
MAX_SPREAD = 0.04  # relative, between blocks: beyond, the pictures do not show one scene
MIN_BLOCKS = 30
BIWEIGHT = 4.685  # 95 % efficient for normal errors


@dataclass(frozen=True, eq=False)
class Blocks:
    """A frame in blocks: mean normalised signal, its variance, and whether every photosite lies below the limit."""

    mean: np.ndarray  # (h, w)
    variance: np.ndarray  # (h, w)
    clear: np.ndarray  # (h, w) bool


@dataclass(frozen=True)
class Agreement:
    """Measured ln(ball / plate), its standard uncertainty, blocks used, share of the frame that agrees."""

    log: float
    sigma: float
    blocks: int
    share: float


def block_means(signal: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Mean (h, w) float64 and largest sample of blocks of whole CFA cells of (H, W) or (H, W, 3) data, and their side.

    What is left at the right and lower edge is cut. Works on DN as on normalised signal.
    """
    side = max(2, 2 * round(np.sqrt(signal.shape[0] * signal.shape[1] / BLOCKS) / 2))
    height, width = signal.shape[0] // side, signal.shape[1] // side
    parts = signal[: height * side, : width * side].reshape(height, side, width, side, signal[:1, :1].size)
    return parts.mean((1, 3, 4), dtype=np.float64), parts.max((1, 3, 4)), side


def blocks_of(signal: np.ndarray, limit: float, noise: Noise) -> Blocks:
    """Blocks of a normalised signal (H, W) or (H, W, 3)."""
    mean, top, side = block_means(signal)
    return blocks_from(mean, top, side, limit, noise)


def blocks_from(mean: np.ndarray, top: np.ndarray, side: int, limit: float, noise: Noise) -> Blocks:
    """Blocks of what `block_means` found in a normalised signal."""
    variance = (noise.shot.mean() * np.maximum(mean, 0) + noise.floor.mean()) / side**2
    return Blocks(mean, variance, top < 0.95 * limit)  # a NaN compares false


def usable_blocks(plate: Blocks, ball: Blocks, label_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Blocks (h, w) well exposed in both, and the variance of their log ratio (infinite elsewhere).

    Decided on the frames' sum, as in `exposure.measure_ratio`. ``label_ratio``: ball over plate.
    """
    bright = plate.mean + ball.mean > LEAST_SIGNAL * (1 + max(label_ratio, 1 / label_ratio))
    usable = bright & plate.clear & ball.clear & (np.minimum(plate.mean, ball.mean) > LEAST_SIGNAL / 4)
    variance = np.full(usable.shape, np.inf)
    for frame in (plate, ball):
        relative = np.divide(frame.variance, frame.mean**2, out=np.full(usable.shape, np.inf), where=usable)
        variance = relative if frame is plate else variance + relative
    usable &= variance < MAX_NOISE**2
    return usable, np.where(usable, variance, np.inf)


def information(plate: Blocks, ball: Blocks, label_ratio: float) -> float:
    """How much a pair of frames can tell of its ratio: blocks well exposed in both, noisy ones counting less."""
    _, variance = usable_blocks(plate, ball, label_ratio)
    return float(np.sum(1 / (1 + variance / FLOOR**2)))


def measure(plate: Blocks, ball: Blocks, label_ratio: float) -> Agreement | None:
    """The ratio of exposures ball over plate that most blocks share; None when no ratio stands out."""
    usable, variance = usable_blocks(plate, ball, label_ratio)
    if np.count_nonzero(usable) < MIN_BLOCKS:
        return None
    logs = np.log(ball.mean / plate.mean, out=np.zeros(usable.shape), where=usable)
    first, spread, _ = _centre(logs[usable], variance[usable])
    changed = _neighbourhood_mean(np.clip(logs - first, -0.5, 0.5), usable)
    changed = np.abs(changed) > max(CHANGED, 4 * spread / 3)  # the mean of nine
    agreeing = usable & ~changed
    far = _farther_half(agreeing, changed)
    if spread > MAX_SPREAD or np.count_nonzero(far) < MIN_BLOCKS:
        return None
    log, _, sigma = _centre(logs[far], variance[far])
    share = float(np.mean(agreeing))
    return Agreement(log, float(np.hypot(sigma, FLOOR / np.sqrt(share))), int(np.count_nonzero(far)), share)


def measure_views(
    plate: Sequence[tuple[float, Blocks]], ball: Sequence[tuple[float, Blocks]]
) -> list[tuple[int, int, Agreement]]:
    """Ratios of a plate's and a ball view's frames, as index into plate, index into ball, agreement.

    Frames come with their exposure by label. Each plate frame is measured with the frame that tells most. What the
    ball does to the scene is common to all pairs: their uncertainties are raised so as not to average it away.
    """
    found = []
    for p, (label, one) in enumerate(plate if ball else []):
        best = max(range(len(ball)), key=lambda b: information(one, ball[b][1], ball[b][0] / label))
        measured = measure(one, ball[best][1], ball[best][0] / label)
        if measured is not None:
            found.append((p, best, measured))
    least = min((measured.sigma for _, _, measured in found), default=0.0)
    found = [entry for entry in found if entry[2].sigma <= 2 * least]
    return [(p, b, replace(one, sigma=one.sigma * float(np.sqrt(len(found))))) for p, b, one in found]


def _centre(values: np.ndarray, variance: np.ndarray) -> tuple[float, float, float]:
    """Robust centre of values (N,), their spread, and the centre's standard uncertainty."""
    ordered = np.sort(values)
    half = (len(values) + 1) // 2
    widths = ordered[half:] - ordered[:-half]
    start = int(np.argmin(widths))
    centre = float(np.median(ordered[start : start + half + 1]))
    spread = float(widths[start]) / (2 * 0.6745)  # the middle half of a normal distribution is 2 * 0.6745 sigma wide
    scale = np.sqrt(np.maximum(spread**2, variance))
    for _ in range(50):
        pull = (values - centre) / scale
        weight = np.where(np.abs(pull) < BIWEIGHT, (1 - (pull / BIWEIGHT) ** 2) ** 2, 0) / scale**2
        previous, centre = centre, float(np.average(values, weights=weight))
        if abs(centre - previous) < 1e-7:
            break
    sigma = np.sqrt(np.sum((weight * scale) ** 2)) / np.sum(weight)
    return centre, spread, float(sigma)


def _shifted(values: np.ndarray) -> list[np.ndarray]:
    """The 3 x 3 neighbourhood of every element of (h, w), zero beyond the edge."""
    padded = np.pad(values, 1)
    height, width = values.shape
    return [padded[r : r + height, c : c + width] for r in range(3) for c in range(3)]


def _neighbourhood_mean(values: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Mean over the usable blocks of each 3 x 3 neighbourhood, 0 without any."""
    count = np.sum(_shifted(usable.astype(float)), 0)
    return np.divide(
        np.sum(_shifted(np.where(usable, values, 0.0)), 0), count, out=np.zeros(count.shape), where=count > 0
    )


def _farther_half(agreeing: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """The agreeing blocks left when the changed region has been grown until about half of them remain."""
    wanted, kept, region = np.count_nonzero(agreeing) / 2, agreeing, changed
    while region.any() and not region.all():
        region = np.logical_or.reduce(_shifted(region))
        grown = agreeing & ~region
        if np.count_nonzero(grown) < wanted:
            break
        kept = grown
    return kept
