"""Shadows that lie in the plate although nothing modelled casts them: found where the evidence is good, never guessed.

Where a compact light g is hidden from a part of the plane, the apparent albedo there is too low by the known ratio
(E - E_g) / E per channel: a step along the line between light with and without g in log colour, of known length. Paint
makes steps of any direction and length. So the picture of the log albedo is cut into flat regions, and a region counts
as shadow when the steps along its border to a brighter neighbour agree with one light's ratio, in length, in colour and
with each other. Soft shadows, shadows of the sky, and regions with fine texture are not found; lights whose ratio is
too near 1 are not asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.types import Emitter

CELLS = 220  # along the longer side of the picture that is examined
REACH = 3  # cells from a step to either side: the width of a penumbra that is still a step
FLAT = 0.5  # of the light's log ratio over twice the reach: a flat region has less
MIN_DARKENING = 0.15  # mean log ratio of a light that is asked for
LENGTH = (0.85, 1.25)  # of a step over the light's log ratio; an occluder takes some sky too
ASIDE = 0.15  # of its length, that a step may lie beside the line
SPREAD = 0.12  # median absolute deviation of the lengths along one border
MIN_BORDER = 12  # steps
MIN_SHARE = 0.35  # of a region's border that has to agree
MIN_AREA, MAX_AREA = 0.002, 0.5  # of what is known; where more is dark, the rest may as well be paint or a light


@dataclass(frozen=True, eq=False)
class Found:
    """Texels (h, w) in shadow, the share of the known that they are, and the lights that are hidden there."""

    mask: np.ndarray
    fraction: float
    lights: list[str]


def darkening(emitters: Sequence[Emitter], normal: np.ndarray, light: np.ndarray) -> dict[str, np.ndarray]:
    """Log ratio (3,), negative, of the irradiance ``light`` (3,) without each emitter; those that matter."""
    result = {}
    for emitter in emitters:
        part = emitter.irradiance * max(float(emitter.direction @ normal), 0.0)
        ratio = np.log(np.clip(1 - part / light, 1e-3, 1.0))
        if -ratio.mean() > MIN_DARKENING:
            result[emitter.name] = ratio
    return result


def unexplained(albedo: np.ndarray, known: np.ndarray, ratios: dict[str, np.ndarray]) -> Found:
    """Shadows in an albedo (h, w, 3), known at (h, w), for the log ratios of `darkening`."""
    from scipy.ndimage import binary_dilation, gaussian_filter

    size = max(1, -(-max(albedo.shape[:2]) // CELLS))
    height, width = albedo.shape[0] // size, albedo.shape[1] // size
    part = (slice(0, height * size), slice(0, width * size))
    weight = known[part].reshape(height, size, width, size).mean((1, 3))
    sums = (albedo[part] * known[part][..., None]).reshape(height, size, width, size, 3).mean((1, 3))
    fine = (weight > 0.5) & (sums.min(-1) > 0)
    picture = np.log(np.where(fine[..., None], sums, 1.0) / np.where(fine, weight, 1.0)[..., None])
    blurred = gaussian_filter(fine.astype(float), 1.0)
    picture = gaussian_filter(picture, (1.0, 1.0, 0.0)) / np.maximum(blurred, 1e-9)[..., None]
    mask, lights = np.zeros((height, width), bool), []
    for name, ratio in ratios.items():
        here = shadowed(picture, fine, ratio)
        if here.any():
            mask |= binary_dilation(here, iterations=2 * REACH) & fine
            lights.append(name)
    whole = np.zeros(known.shape, bool)
    whole[part] = mask.repeat(size, 0).repeat(size, 1)
    whole &= known
    return Found(whole, float(whole.sum() / max(known.sum(), 1)), lights)


def shadowed(picture: np.ndarray, fine: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Cells (h, w) of the log albedo (h, w, 3), usable where ``fine``, in flat regions darker by ``ratio`` (3,)."""
    from scipy.ndimage import binary_erosion, distance_transform_edt, label, maximum_filter1d

    size = float(np.linalg.norm(ratio))
    steps = [_steps(picture, axis) for axis in (0, 1)]
    lengths = [np.linalg.norm(step, axis=-1) for step in steps]
    flat = binary_erosion(fine) & (np.maximum(*lengths) < FLAT * size)
    regions, count = label(flat)
    area = np.bincount(regions.ravel(), minlength=count + 1)
    big = area >= MIN_AREA * fine.sum()
    big[0] = False
    regions = np.where(big[regions], regions, 0)
    away, (row, column) = distance_transform_edt(regions == 0, return_indices=True)
    regions = np.where((away <= 2 * REACH) & fine, regions[row, column], 0)  # up to the middle of the step
    border: dict[tuple[int, int], list[np.ndarray]] = {}
    for axis, step in enumerate(steps):
        low, high = _sides(regions, axis)
        between = (low > 0) & (high > 0) & (low != high) & (lengths[axis] >= lengths[1 - axis])
        between &= lengths[axis] == maximum_filter1d(lengths[axis], 3, axis)  # the middle of the step
        for a, b, value in zip(low[between], high[between], step[between]):
            border.setdefault((int(min(a, b)), int(max(a, b))), []).append(value if a < b else -value)
    perimeter = np.zeros(count + 1)
    agreeing = np.zeros(count + 1)
    for (a, b), values in border.items():
        jump = np.array(values)  # from a to b
        perimeter[[a, b]] += len(jump)
        length = jump @ ratio / size**2
        dark, sign = (b, 1.0) if np.median(length) > 0 else (a, -1.0)
        middle = float(np.median(sign * length))
        aside = np.median(jump, axis=0) - sign * middle * ratio
        spread = float(np.median(np.abs(sign * length - middle)))
        alike = LENGTH[0] < middle < LENGTH[1] and np.linalg.norm(aside) < ASIDE * size and spread < SPREAD
        if alike and len(jump) >= MIN_BORDER:
            agreeing[dark] += len(jump)
    chosen = (agreeing > MIN_SHARE * np.maximum(perimeter, 1)) & (area < MAX_AREA * fine.sum())
    chosen[0] = False
    return chosen[regions]


def _steps(picture: np.ndarray, axis: int) -> np.ndarray:
    """Value REACH cells on less the value REACH cells back, along an axis, the border repeated: (h, w, 3)."""
    low, high = _sides(picture, axis)
    return high - low


def _sides(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Values REACH cells back and REACH cells on along an axis, the border repeated."""
    index = np.arange(values.shape[axis])
    back, on = (np.take(values, np.clip(index + d, 0, len(index) - 1), axis) for d in (-REACH, REACH))
    return back, on
