"""Bringing the frames of a view onto each other, when the measured shift asks for it and not otherwise.

The shift between neighbouring frames is measured by Lucas-Kanade on CFA cells, weighted by the noise, in whole and in
quadrants. A mosaic is moved by whole cells, which is exact; samples without a mosaic are moved by fractions of a pixel
(linear interpolation), their motion being that of the developed picture.

Source: Lucas, Kanade 1981. Limits: translations only. What turns, zooms or moves within the picture is refused or, when
it is less than half of what would be moved, left and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from pipeline.image.radiometry import Exposed
from pipeline.run.errors import CaptureError
from pipeline.run.evidence import ABSENT

LEAST_PX = 1.0  # half a CFA cell: less cannot be mended by whole cells, and blurs less than the demosaic does
LEAST_SIGMAS = 5.0  # a shift that is no more than its uncertainty is none
LARGEST_SHARE = 0.03  # of the frame's width
DISAGREEMENT_PX = 1.0  # of quadrants beyond their noise: rotation, or something that moves
LEAST_SHARE = 0.05  # of a box, clear in both frames
GUARD_CELLS = 4  # round what clips in one of the frames: left out
LEAST_STRUCTURE = 2.0  # gradients of the picture over those of its noise, known to a tenth: a twentieth of the shift
STEPS = 8  # of Lucas-Kanade, each from the whole cells found so far


@dataclass(frozen=True)
class Shift:
    """Content of the second frame lies ``(dx, dy)`` px right of and below that of the first; standard uncertainties."""

    dx: float
    dy: float
    sigma: float
    quadrants: float = 0.0  # px, largest difference of a quadrant's from the whole's

    @property
    def length(self) -> float:
        """How far, in pixels."""
        return float(np.hypot(self.dx, self.dy))


def align(
    frames: Sequence[Exposed], names: Sequence[str], when: Literal["auto", "always", "never"] = "auto"
) -> tuple[list[Exposed], float | None, dict[str, Any]]:
    """Frames of a view, moved onto the one of middle exposure where they lie off it; largest shift [px]; evidence.

    ``when``: if the shift asks for it, or always, or never. What a moved frame does not show at its edges is NaN.
    Raises CaptureError when the motion is too large or no shift.
    """
    if len(frames) < 2:
        return list(frames), None, {**_evidence(False, "one frame", "nothing"), **ABSENT}
    order = np.argsort([frame.exposure for frame in frames], kind="stable")
    shifts = [measure(frames[i], frames[j]) for i, j in pairwise(order)]
    places = np.zeros((len(frames), 2))
    for (before, after), shift in zip(pairwise(order), shifts, strict=True):
        places[after] = places[before] + (0 if shift is None else (shift.dx, shift.dy))
    places -= places[order[len(order) // 2]]
    for (before, after), shift in zip(pairwise(order), shifts, strict=True):
        if shift is not None:
            _refuse(shift, f"{names[before]}, {names[after]}", frames[after].mosaic.shape[1])
    known = [shift for shift in shifts if shift is not None]
    if not known:
        why = "frames without structure show no shift; nor would its blur show"
        return list(frames), None, {**_evidence(False, "no structure to measure a shift by", "blur"), "no_bound": why}
    sigma = max(shift.sigma for shift in known)
    largest = float(np.hypot(*places.T).max())
    said = f"largest shift {largest:.3f} +- {sigma:.3f} px, quadrants within {max(s.quadrants for s in known):.2f} px"
    if blind := len(shifts) - len(known):
        said += f"; {blind} of {len(shifts)} pairs of frames show too little to tell, and are taken to lie alike"
    needed = max(LEAST_PX, LEAST_SIGMAS * sigma)
    if when == "never" or (when == "auto" and largest < needed) or largest == 0:
        said += f"; knob merge.align = {when}" if largest >= needed else ""
        return list(frames), largest, {**_evidence(False, said, f"blur of {largest:.3f} px"), "bound_px": largest}
    moved = [_moved(frame, *place) for frame, place in zip(frames, places, strict=True)]
    if all(one is frame for one, frame in zip(moved, frames, strict=True)):
        said += "; less than half a CFA cell along either side, which whole cells do not mend"
        return moved, largest, {**_evidence(False, said, f"blur of {largest:.3f} px"), "bound_px": largest}
    left = "up to a pixel and what turned" if frames[0].mosaic.ndim == 2 else "noise of moved frames is smoothed"
    return moved, largest, _evidence(True, said, left)


def cost(aligned: np.ndarray, unmoved: np.ndarray, shift: float | None) -> dict[str, Any]:
    """What frames left where they lie would do, for the row of evidence: how much of the light would lie elsewhere.

    ``aligned``, ``unmoved``: merged radiance (H, W) or (H, W, 3). Compared on squares of twice the ``shift`` [px]:
    detail that stays within one is blurred, light that leaves it comes from another direction. Half of the sum of
    differences is what moved, be it from square to square or away. What one of them does not know is left out of both.
    """
    side = 2 * max(1, round(shift or 0.0))
    known, sums = np.isfinite(aligned) & np.isfinite(unmoved), []
    for picture in (aligned, unmoved):
        height, width = picture.shape[0] // side * side, picture.shape[1] // side * side
        whole = np.where(known, picture, 0)[:height, :width].astype(float)
        sums.append(whole.reshape(height // side, side, width // side, side, -1).sum((1, 3)))
    light = float(np.abs(sums[0]).sum())
    moved = float(np.abs(sums[1] - sums[0]).sum()) / 2 / light if light > 0 else 0.0
    text = f"{moved:.1%} of the view's light would lie elsewhere by more than the shift"
    return {"could_cost": f"{text}; left is up to a pixel and what turned", "predicted_rel": moved}


def _evidence(modelled: bool, because: str, could_cost: str) -> dict[str, Any]:
    return {"term": "alignment of frames", "modelled": modelled, "because": because, "could_cost": could_cost}


def _refuse(shift: Shift, name: str, width: int) -> None:
    """Raise CaptureError for motion that no shift mends."""
    if shift.length > LARGEST_SHARE * width:
        found = f"frames are shifted by {shift.length:.0f} px"
        raise CaptureError(f"{name}: {found}, at most {LARGEST_SHARE * width:.0f} can be mended; use a tripod")
    if shift.length > LEAST_PX and shift.quadrants > max(DISAGREEMENT_PX, shift.length / 2):
        found = f"quadrants disagree by {shift.quadrants:.1f} px about a shift of {shift.length:.1f} px"
        raise CaptureError(f"{name}: {found} (rotation, or things that move), needed one shift; use a tripod")


def measure(first: Exposed, second: Exposed) -> Shift | None:
    """Shift of the second frame's content against the first's; None without usable structure.

    One estimate from the middle of each quadrant, joined by their covariances; where they differ by more than those,
    the uncertainty grows with them.
    """
    found = [one for box in _quadrants(first.mosaic.shape) if (one := _measure_patch(first, second, box)) is not None]
    if not found:
        return None
    information = [np.linalg.inv(covariance) for _, covariance in found]
    covariance = np.linalg.inv(np.sum(information, 0))
    whole = covariance @ np.sum([weight @ step for weight, (step, _) in zip(information, found, strict=True)], 0)
    away = [step - whole for step, _ in found]
    chi2 = sum(float(off @ weight @ off) for off, weight in zip(away, information, strict=True))
    birge = np.sqrt(max(1.0, chi2 / max(2 * len(found) - 2, 1)))
    sigma = float(np.sqrt(np.trace(covariance) / 2) * birge)
    return Shift(float(whole[0]), float(whole[1]), sigma, max(float(np.hypot(*off)) for off in away))


def _quadrants(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Boxes of at most 640 x 640 px in the middle of each quadrant, on whole cells."""
    spans = []
    for size in shape[:2]:
        side = min(size // 2, 640) // 2 * 2
        spans.append(
            [
                slice(start, start + side)
                for start in ((size // 4 - side // 2) // 2 * 2, (3 * size // 4 - side // 2) // 2 * 2)
            ]
        )
    return [(rows, columns) for rows in spans[0] for columns in spans[1]]


def _measure_patch(first: Exposed, second: Exposed, box: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray] | None:
    """Shift (2,) [px] and covariance of one box: coarse by phase correlation, then Lucas-Kanade about whole cells.

    The frames' ratio is that of their sums, which no shift changes: exposures need not be known. What surrounds clipped
    cells is left out: a lamp that clips in one frame only is no structure that both show.
    """
    import cv2
    from scipy.ndimage import binary_dilation

    a, b = _cells(first, box), _cells(second, box)
    scale = 2.0 if first.mosaic.ndim == 2 else 1.0
    clear = np.isfinite(a) & np.isfinite(b)
    if min(a.shape) < 16 or np.mean(clear) < LEAST_SHARE:
        return None
    cap = min(np.nanmax(a), np.nanmax(b))  # what clips in one frame looks alike in both
    if not cap > 0:  # nothing is brighter than the stated black
        return None
    flat = [np.sqrt(np.clip(np.nan_to_num(part, nan=cap), 0, cap)).astype(np.float32) for part in (a, b)]
    wide = ~binary_dilation(~clear, iterations=GUARD_CELLS)
    clear = wide if np.mean(wide) >= LEAST_SHARE else clear
    a, b = np.where(clear, a, np.nan), np.where(clear, b, np.nan)
    sums = [float(np.nansum(part, dtype=float)) for part in (a, b)]
    if min(sums) > 0:  # else both are dark, and noise has no ratio
        gain = sums[1] / sums[0]
        a, first = np.float32(gain) * a, replace(first, exposure=first.exposure / gain)
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(flat[0], flat[1], window)
    for whole in (np.rint([x, y]).astype(int), np.zeros(2, int)):
        for _ in range(STEPS):
            here, there = _overlap(a, b, whole)
            step = _lucas_kanade(here, there, first, second)
            if step is None:
                break
            if np.abs(step[0]).max() < 0.75:
                return scale * (whole + step[0]), scale**2 * step[1]
            whole = whole + np.rint(step[0]).astype(int)
            if np.abs(whole).max() > min(a.shape) // 2:
                break
    return None


def _overlap(a: np.ndarray, b: np.ndarray, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts of two pictures that show the same when the second is ``whole`` (dx, dy) elements off."""
    (height, width), (dx, dy) = a.shape, whole
    rows, columns = slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx))
    return a[rows, columns], b[rows.start + dy : rows.stop + dy, columns.start + dx : columns.stop + dx]


def _cells(frame: Exposed, box: tuple[slice, slice]) -> np.ndarray:
    """Mean radiance (h, w) of the CFA cells, or of the three channels, of a box; NaN where a sample clips."""
    signal = frame.signal(box[0])[:, box[1]]
    if signal.ndim == 3:
        parts = [signal[..., c] for c in range(signal.shape[2])]
    else:
        parts = [signal[r::2, c::2] for r, c in np.ndindex(2, 2)]
    mean = sum(parts[1:], parts[0]) / (len(parts) * np.float32(frame.exposure))
    return np.where(np.maximum.reduce(parts) >= float(frame.limit.min()), np.nan, mean)


def _lucas_kanade(
    a: np.ndarray, b: np.ndarray, first: Exposed, second: Exposed
) -> tuple[np.ndarray, np.ndarray] | None:
    """Shift (dx, dy) of b against a in elements, and its covariance; None without structure beyond the noise.

    Gradients of noise would draw the shift to zero: what they add to the normal matrix is known, and taken off.
    """
    if min(a.shape) < 8:
        return None
    middle = (slice(1, -1), slice(1, -1))
    samples = 4 if first.mosaic.ndim == 2 else first.mosaic.shape[2]
    level = max(float(np.nanmean(a + b)) / 2, 0.0)
    parts = [_noise(frame, level, samples) for frame in (first, second)]
    share = parts[1] / (parts[0] + parts[1])  # of the first frame in the gradient: the quieter one has more
    both = share * a + (1 - share) * b
    difference, mean = (b - a)[middle], np.maximum(both[middle], 0)
    gy, gx = (both[2:, 1:-1] - both[:-2, 1:-1]) / 2, (both[1:-1, 2:] - both[1:-1, :-2]) / 2
    clear = np.isfinite(difference) & np.isfinite(gx) & np.isfinite(gy)
    if np.count_nonzero(clear) < 100:
        return None
    difference, mean, gx, gy = difference[clear], mean[clear], gx[clear], gy[clear]
    noise = [_noise(frame, mean, samples) for frame in (first, second)]
    weight = 1 / (noise[0] + noise[1] + (0.01 * mean) ** 2)
    found = np.array([[np.sum(weight * p * q) for q in (gx, gy)] for p in (gx, gy)])
    mimic = float(np.sum(weight * (share**2 * noise[0] + (1 - share) ** 2 * noise[1]))) / 2  # noise's own gradients
    normal = found - mimic * np.eye(2)
    if np.linalg.eigvalsh(normal)[0] < 100 + LEAST_STRUCTURE * mimic:
        return None
    inverse = np.linalg.inv(normal)
    return -inverse @ np.array([np.sum(weight * p * difference) for p in (gx, gy)]), inverse @ found @ inverse


def _noise(frame: Exposed, level: Any, samples: int) -> Any:
    """Variance of the mean of a cell's samples at a level (...) of radiance."""
    return (frame.noise.shot.mean() * level / frame.exposure + frame.noise.floor.mean() / frame.exposure**2) / samples


def _moved(frame: Exposed, dx: float, dy: float) -> Exposed:
    """The frame with its content moved by (-dx, -dy): by whole cells of a mosaic, else by fractions of a pixel."""
    source = frame.mosaic[:]
    if source.ndim == 3:
        from scipy.ndimage import shift

        moved = [shift(source[..., c].astype(np.float32), (-dy, -dx), order=1, cval=np.nan) for c in range(3)]
        return replace(frame, mosaic=np.stack(moved, -1))
    x, y = 2 * round(dx / 2), 2 * round(dy / 2)
    if x == y == 0:
        return frame
    height, width = source.shape
    target = np.full(source.shape, np.nan, np.float32)
    target[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)] = source[
        max(0, y) : height - max(0, -y), max(0, x) : width - max(0, -x)
    ]
    return replace(frame, mosaic=target)
