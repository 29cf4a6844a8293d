"""Brackets of JPEGs: clearly second best to RAW, because a camera's curve, sharpening and colours are baked in.

Frames are brought onto each other by their content, the curve is recovered from the bracket itself, with its
uncertainty (`pipeline.image.response`), and they are merged like counts: the longest unclipped exposures weigh most.
Colours are the camera's rendering, taken as linear Rec.709; the unit is free.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.run.errors import CaptureError

CLIPPED_FROM, DARK_TO = 250, 4  # codes that say no more than "at least" and "at most"
CODE_SIGMA = 1.5  # codes: noise, compression and rounding of a phone's JPEG
ALIGN_BLUR, ALIGN_STEPS, ALIGN_STOP = 5, 200, 1e-6
MIN_CORRELATION, MAX_SHIFT, MAX_STRETCH = 0.8, 0.15, 0.1  # of aligned frames; shift as a fraction of the width
WHITE = 255


@dataclass(frozen=True)
class JpegFrame:
    """One photograph: codes (H, W, 3) uint8, RGB, and its exposure t ISO / N^2; None where its metadata lack it."""

    name: str
    codes: np.ndarray
    exposure: float | None


@dataclass(frozen=True)
class Merged:
    """Radiance and variance (H, W, 3) on the grid of the first frame, free unit; flags (H, W); how frames moved."""

    rgb: np.ndarray
    variance: np.ndarray
    clipped: np.ndarray  # in every frame that sees the pixel: a lower bound
    correlations: list[float]  # of each frame with the one before, after alignment
    curve: np.ndarray  # (256, 3) relative exposure of each code
    curve_sigma: np.ndarray  # (256, 3) its standard uncertainty, relative


def read(path: Path) -> JpegFrame:
    """Read a photograph as it is stored, with its exposure. Raises CaptureError when it cannot be read."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            header = picture.getexif()
            tags = {**header, **header.get_ifd(0x8769)}
            codes = np.asarray(picture.convert("RGB"))
    except (OSError, UnidentifiedImageError) as error:
        raise CaptureError(f"{path}: not a readable photograph ({error})") from error
    seconds, iso, stop = (float(tags.get(code) or 0) for code in (0x829A, 0x8827, 0x829D))
    exposure = seconds * (iso or 100) / (stop or 1) ** 2 if seconds > 0 else None
    return JpegFrame(path.name, codes, exposure)


def aligned(frames: list[JpegFrame]) -> tuple[list[np.ndarray], list[np.ndarray], list[float]]:
    """Codes of every frame on the first one's grid, float32; where each is seen (H, W); and correlations.

    Frames from the brightest to the darkest, each brought to the one before by an affine map of highest correlation
    (Evangelidis and Psarakis, Parametric Image Alignment using Enhanced Correlation Coefficient, 2008), on logarithms
    of light that both can show. Raises CaptureError when one does not fit.
    """
    import cv2

    height, width = frames[0].codes.shape[:2]
    size = (width, height)
    codes, seen, found = [frames[0].codes.astype(np.float32)], [np.ones((height, width), bool)], []
    total = np.eye(3)
    for before, frame in pairwise(frames):
        one, other = _comparable(before, frame)
        start = np.eye(2, 3, dtype=np.float32)
        start[:, 2] = (np.array(other.shape[::-1]) - one.shape[::-1]) / 2
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, ALIGN_STEPS, ALIGN_STOP)
        try:
            correlation, step = cv2.findTransformECC(  # type: ignore[call-overload]
                one, other, start, cv2.MOTION_AFFINE, criteria, None, ALIGN_BLUR
            )
        except cv2.error as error:
            raise CaptureError(
                f"{frame.name}: does not show what {before.name} shows; is it of this bracket?"
            ) from error
        _check_motion(before.name, frame.name, float(correlation), np.asarray(step), one.shape)
        total = np.vstack([step, [0, 0, 1]]) @ total
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(frame.codes.astype(np.float32), total[:2], size, flags=flags)
        codes.append(np.asarray(moved, np.float32))
        ones = np.ones(frame.codes.shape[:2], np.float32)
        seen.append(cv2.warpAffine(ones, total[:2], size, flags=flags) > 0.999)
        found.append(float(correlation))
    return codes, seen, found


def _comparable(one: JpegFrame, other: JpegFrame) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the light of two frames, within what both can show; the curve is taken as a power of 2.2."""
    exposures = [float(frame.exposure or 1) for frame in (one, other)]
    brightest, floor = 0.9 / max(exposures), 0.02 / max(exposures)
    light = [(f.codes.astype(np.float32).mean(-1) / 255) ** 2.2 / t for f, t in zip((one, other), exposures)]
    first, second = (np.log(np.minimum(values, brightest) + floor).astype(np.float32) for values in light)
    return first, second


def _check_motion(before: str, name: str, correlation: float, step: np.ndarray, shape: tuple[int, int]) -> None:
    """Raise CaptureError when a frame cannot be brought onto the one before it."""
    stretch = float(np.abs(step[:, :2] - np.eye(2)).max())
    shift = float(np.abs(step[:, 2]).max()) / shape[1]
    if correlation < MIN_CORRELATION or stretch > MAX_STRETCH or shift > MAX_SHIFT:
        raise CaptureError(
            f"{name}: correlates {correlation:.2f} with {before} when moved by {shift:.0%} and stretched by "
            f"{stretch:.0%}; needed {MIN_CORRELATION}, {MAX_SHIFT:.0%}, {MAX_STRETCH:.0%}; use a tripod"
        )


def response(codes: list[np.ndarray], exposures: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Relative exposure (256, 3) of each code, 1 at code 128, never falling; its relative standard uncertainty."""
    from pipeline.image.response import TABLE, recover

    found = recover([codes], [exposures], WHITE)
    grid, code = np.linspace(0, 1, TABLE), found.above(np.repeat(np.arange(WHITE + 1)[:, None] / WHITE, 3, 1))
    light, sigma = (
        np.stack([np.interp(code[:, c], grid, table[:, c]) for c in range(3)], -1)
        for table in (found.log_light, found.sigma())
    )
    return np.exp(light - light[128]), sigma


def merge(frames: list[JpegFrame]) -> Merged:
    """Radiance of a bracket (any order). Raises CaptureError: an exposure is missing, or a frame does not fit.

    Weights are the exposures of codes that are neither clipped nor dark (photon counts); a pixel without one keeps the
    shortest exposure's value if it is clipped everywhere, the longest's if dark. The variance is that of the codes
    and of the curve.
    """
    missing = [frame.name for frame in frames if not frame.exposure]
    if missing:
        raise CaptureError(
            f"{', '.join(missing)}: no ExposureTime in the metadata; needed for every frame; give --exposures, as "
            "1/20,1/60,..., in the order of the files"
        )
    frames = sorted(frames, key=lambda frame: (-float(frame.exposure or 0), frame.name))
    exposures = [float(frame.exposure or 0) for frame in frames]
    codes, seen, correlations = aligned(frames)
    curve, unsure = response(codes, exposures)
    total, weight, noise, doubt = (np.zeros(codes[0].shape) for _ in range(4))
    bright, dark = np.ones(codes[0].shape, bool), np.zeros(codes[0].shape)
    steps = np.arange(WHITE + 1)
    slope = np.gradient(curve, axis=0)
    for code, inside, exposure in zip(codes, seen, exposures):
        light = np.stack([np.interp(code[..., c], steps, curve[:, c]) for c in range(3)], -1) / exposure
        spread = np.stack([np.interp(code[..., c], steps, slope[:, c]) for c in range(3)], -1) * CODE_SIGMA / exposure
        off = light * np.stack([np.interp(code[..., c], steps, unsure[:, c]) for c in range(3)], -1)
        good = (code < CLIPPED_FROM) & (code > DARK_TO) & inside[..., None]
        total += np.where(good, exposure * light, 0)
        noise += np.where(good, (exposure * spread) ** 2, 0)
        doubt += np.where(good, exposure * off, 0)
        weight += np.where(good, exposure, 0)
        bright &= (code >= CLIPPED_FROM) | ~inside[..., None]
        dark = np.where(dark > 0, dark, light)  # the longest's: sorted from the longest
    none = weight == 0
    safe = np.where(none, 1, weight)
    lower = curve[CLIPPED_FROM] / exposures[-1]
    rgb = np.where(none, np.where(bright, lower, dark), total / safe)
    variance = np.where(none, rgb**2, (noise + doubt**2) / safe**2)  # the curve is off in all frames alike
    return Merged(rgb, variance, (none & bright).any(-1), correlations, curve, unsure)
