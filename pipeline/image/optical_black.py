"""Black of one frame, measured on photosites that see no light, and whether it replaces what metadata say.

A sensor's black drifts with temperature, gain and exposure time; metadata often carry one number per model. MaskedAreas
of a DNG, or the margins beside the active area that behave as dark ones, give it per CFA cell.

The mean is that of samples within 4 robust standard deviations (integers make a median useless here). Its standard
error is the largest that photosites, rows and columns give, since rows and columns share noise of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Box = tuple[int, int, int, int]  # top, left, bottom, right, in stored coordinates

MIN_SAMPLES = 64  # of each CFA cell
GUARD = 4  # photosites nearest to light and to the rim of the sensor: leaks, settling, test patterns
MAX_SPREAD = 0.01  # standard deviation of dark photosites, of full scale; more is no dark area
MAX_SHIFT = 0.02  # of full scale that black may differ from metadata; more is no dark area
BESIDE = 32  # photosites of the active area next to a margin
LEAK = 0.05
SIGMAS = 3.0
SMALLEST_DN = 0.05  # differences below this cost less than 4e-6 of full scale at 14 bits


@dataclass(frozen=True, eq=False)
class OpticalBlack:
    """Measured black of a frame: DN (2, 2) in CFA cell order from the active area's corner."""

    level: np.ndarray
    sigma: np.ndarray  # (2, 2) standard error of the level
    noise: np.ndarray  # (2, 2) standard deviation of one photosite: read noise, DN
    photosites: int
    source: str  # "MaskedAreas" or "margins"


def margins(shape: tuple[int, int], active: Box) -> list[Box]:
    """Left and top margins of a stored picture beside its active area, less a guard; empty when too narrow."""
    top, left, bottom, right = active
    boxes = []
    if left > 3 * GUARD:
        boxes.append((top, GUARD, bottom, left - GUARD))
    if top > 3 * GUARD:
        boxes.append((GUARD, left, top - GUARD, right))
    return boxes


def measure(
    stored: np.ndarray, areas: Sequence[Box], active: Box, scale: float, stated: np.ndarray, source: str
) -> OpticalBlack | None:
    """Black of the areas of a stored picture (H, W) DN; None when none of them looks dark or all are too small.

    ``scale``: white - black DN. An area is dark when its samples spread less than MAX_SPREAD and lie within MAX_SHIFT
    of the ``stated`` black (2, 2). The area with the smallest standard error is used. Margins, which nobody says are
    masked, must stay dark beside light: see `_lit`.
    """
    found = [(area, one) for area in areas if (one := _of_area(stored, area, active, source)) is not None]
    dark = [
        one
        for area, one in found
        if np.all(one.noise < MAX_SPREAD * scale)
        and np.all(np.abs(one.level - stated) < MAX_SHIFT * scale)
        and not (source == "margins" and _lit(stored, area, active, one.level, stated))
    ]
    if not dark:
        return None
    return min(dark, key=lambda one: float(one.sigma.sum()))


def _lit(stored: np.ndarray, area: Box, active: Box, level: np.ndarray, stated: np.ndarray) -> bool:
    """Whether a margin may be ordinary photosites that were cropped: above black by more than LEAK of what is beside.

    In a dark scene nobody can tell, and metadata are kept.
    """
    top, left, bottom, right = active
    beside = stored[top:bottom, left : left + BESIDE] if area[3] <= left else stored[top : top + BESIDE, left:right]
    above, light = float(np.mean(level - stated)), float(beside.mean() - level.mean())
    return above > SMALLEST_DN and above > LEAK * max(light, 0.0)


def _of_area(stored: np.ndarray, area: Box, active: Box, source: str) -> OpticalBlack | None:
    top, left, bottom, right = area
    level, sigma, noise = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2))
    count = 0
    for row, column in np.ndindex(2, 2):
        first_row, first_column = top + (row + active[0] - top) % 2, left + (column + active[1] - left) % 2
        plane = stored[first_row:bottom:2, first_column:right:2].astype(np.float64)
        if plane.size < MIN_SAMPLES or min(plane.shape) < 2:
            return None
        level[row, column], sigma[row, column], noise[row, column] = clipped_mean(plane)
        count += plane.size
    return OpticalBlack(level, sigma, noise, count, source)


def clipped_mean(plane: np.ndarray) -> tuple[float, float, float]:
    """Mean of (H, W) samples within 4 robust standard deviations, its standard error, and the standard deviation."""
    middle = np.median(plane)
    robust = 1.4826 * np.median(np.abs(plane - middle)) + 0.5  # half a step: an area may hold one value
    inside = np.abs(plane - middle) <= 4 * robust
    kept = np.where(inside, plane, np.nan)
    values = plane[inside]
    spread = float(values.std(ddof=1))
    errors = [spread / np.sqrt(values.size)]
    for axis in (0, 1):
        with np.errstate(invalid="ignore"):
            lines = np.nansum(kept, axis) / np.maximum(inside.sum(axis), 1)
        lines = lines[inside.sum(axis) > 0]
        if lines.size > 1:
            errors.append(float(lines.std(ddof=1) / np.sqrt(lines.size)))
    return float(values.mean()), max(errors), spread


def differs(stated: np.ndarray, found: OpticalBlack | None) -> bool:
    """Whether the measured black is another than metadata say, beyond its error and beyond what matters."""
    if found is None:
        return False
    off = np.abs(found.level - stated)
    return bool(np.any((off > SIGMAS * found.sigma) & (off > SMALLEST_DN)))


def chosen(stated: np.ndarray, found: OpticalBlack | None) -> np.ndarray:
    """The black (2, 2) to subtract: measured where the evidence says it differs, else what metadata say."""
    return found.level if found is not None and differs(stated, found) else np.asarray(stated, float)


def report(frames: Sequence[tuple[str, np.ndarray, OpticalBlack | None]]) -> tuple[dict[str, float], list[str]]:
    """Numbers and warnings over (file, stated black (2, 2), measured) of a capture's frames of one camera and ISO."""
    seen = [(file, stated, found) for file, stated, found in frames if found is not None]
    if not seen:
        return {}, []
    means = np.array([float(found.level.mean()) for _, _, found in seen])
    sigmas = np.array([float(np.sqrt(np.mean(found.sigma**2)) / 2) for _, _, found in seen])
    off = np.array([np.abs(found.level - stated).max() for _, stated, found in seen])
    numbers = {
        "frames_with_optical_black": float(len(seen)),
        "black_off_metadata_dn": float(off.max()),
        "black_drift_dn": float(np.ptp(means)),
        "black_drift_sigma_dn": float(sigmas.max() * np.sqrt(2)),
        "read_noise_dn": float(np.mean([np.sqrt(np.mean(found.noise**2)) for _, _, found in seen])),
    }
    warnings = []
    used = [(file, value) for (file, stated, found), value in zip(seen, off) if differs(stated, found)]
    if used:
        file, worst = max(used, key=lambda item: item[1])
        warnings.append(
            f"{file}: black of the masked photosites is up to {worst:.2f} DN off its metadata; the measured one is used"
            + (f" (as in {len(used) - 1} more)" if len(used) > 1 else "")
        )
    if len(seen) > 1 and numbers["black_drift_dn"] > max(SIGMAS * numbers["black_drift_sigma_dn"], SMALLEST_DN):
        warnings.append(f"black drifts by {numbers['black_drift_dn']:.2f} DN between frames; each has its own")
    return numbers, warnings
