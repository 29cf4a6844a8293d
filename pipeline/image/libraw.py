"""RAW files that are no DNG, and mosaics that are no Bayer pattern: what LibRaw knows of them. Importer of rawpy.

Bayer mosaics come back as stored, nothing scaled, balanced or clipped. X-Trans comes back through LibRaw's demosaic
with black left in (`developed`), so that nothing below black is cut off; stacked and staggered sensors are refused.
LibRaw reports 1 s and f/1 where EXIF says 0: such an exposure counts as not stated.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.dng import BAYER, Box
from pipeline.run.errors import CaptureError

XTRANS_MARK = (
    "X-Trans through LibRaw's demosaic: interpolated samples are rounded to DN and share noise with their neighbours; "
    "the variance holds for the samples a photosite measured"
)
LIBRAW_D65 = 21  # EXIF LightSource of the matrices that LibRaw keeps


def sensor_of(name: str, path: Path) -> dict[str, Any]:
    """Facts of a RAW that is no DNG, as LibRaw knows its camera. Raises CaptureError, one line."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            kind, cfa, cells = _mosaic(name, raw)
            black = np.asarray(raw.black_level_per_channel, float)
            matrix = np.asarray(raw.rgb_xyz_matrix, float)[:3]
            balance = np.asarray(raw.camera_whitebalance, float)[:3]
            linear = [value for value in (raw.camera_white_level_per_channel or []) if value > 0]
            sizes = raw.sizes
            square = abs(sizes.pixel_aspect - 1) < 1e-3
            return {
                "width": sizes.width, "height": sizes.height, "cfa": cfa,
                "black": black[cells] if kind == "bayer" else black[None, :3],
                "white": float(min([raw.white_level, *linear])),
                "color_matrix": matrix if np.any(matrix) else None,
                "illuminant": LIBRAW_D65 if np.any(matrix) else 0,
                "as_shot_neutral": 1 / balance if np.all(balance > 0) and np.ptp(balance) > 0 else None,
                "lens": (raw.lens.model or "").strip("\0 ") if raw.lens else "",
                "marks": [XTRANS_MARK] * (kind == "xtrans")
                + [f"pixels are not square: {sizes.pixel_aspect:g}"] * (not square),
                **_exposure(raw.other),
            }  # fmt: skip
    except rawpy.LibRawError as error:
        raise CaptureError(f"{name}: not a readable RAW file ({error_text(error)}); give the camera's RAW") from error


def _mosaic(name: str, raw: Any) -> tuple[str, str, np.ndarray]:
    """Kind of mosaic, letters of its 2x2 cell ("" for X-Trans), colour numbers (2, 2) at the visible corner."""
    import rawpy

    pattern, letters = raw.raw_pattern, raw.color_desc.decode()
    if raw.raw_type != rawpy.RawType.Flat or pattern is None:
        raise CaptureError(f"{name}: its sensor is no mosaic (stacked, or three channels); give a linear DNG of it")
    if pattern.shape == (6, 6) and letters[:3] == "RGB":
        return "xtrans", "", np.zeros((2, 2), int)
    cells = np.asarray(raw.raw_colors_visible[:2, :2], int)  # raw_pattern is that of the stored corner
    cfa = "".join(letters[number] for number in cells.ravel())
    if cfa not in BAYER or not np.array_equal(raw.raw_colors_visible[2:4, 2:4], cells):
        raise CaptureError(f"{name}: colour filter {cfa} is no Bayer pattern of red, green, blue; give a linear DNG")
    return "bayer", cfa, cells


def stored_mosaic(name: str, path: Path) -> tuple[np.ndarray, Box]:
    """All photosites (H, W) DN, margins included, and the box that sees the picture."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            sizes = raw.sizes
            stored = np.array(raw.raw_image)
            top, left = sizes.top_margin, sizes.left_margin
            return stored, (top, left, top + sizes.height, left + sizes.width)
    except rawpy.LibRawError as error:
        raise CaptureError(f"{name}: cannot be decoded ({error_text(error)}); copy it again") from error


def developed(name: str, path: Path, area: Box | None) -> np.ndarray:
    """X-Trans through LibRaw's demosaic, (H, W, 3) uint16 DN, black not subtracted, nothing balanced or brightened.

    ``area``: the active area that the file states; LibRaw must have found the same, for it decides the pattern's phase.
    """
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            sizes = raw.sizes
            box = (sizes.top_margin, sizes.left_margin)
            if area is not None and box != area[:2]:
                raise CaptureError(
                    f"{name}: LibRaw starts the X-Trans pattern at {box}, the file at {area[:2]}; convert it to a "
                    "linear DNG"
                )
            stored = raw.raw_image_visible
            _refuse_constant(name, stored, raw.white_level)
            params = rawpy.Params(
                output_color=rawpy.ColorSpace.raw, gamma=(1, 1), output_bps=16, no_auto_bright=True,
                no_auto_scale=True, user_wb=[1, 1, 1, 1], adjust_maximum_thr=0.0, user_flip=0,
                user_black=0, user_cblack=[0, 0, 0, 0],  # black stays in, so that nothing below it is cut off
                demosaic_algorithm=rawpy.DemosaicAlgorithm.AHD,  # of X-Trans: Markesteijn's, three passes
            )  # fmt: skip
            return np.asarray(raw.postprocess(params))
    except rawpy.LibRawError as error:
        raise CaptureError(f"{name}: cannot be decoded ({error_text(error)}); copy it again") from error


def _refuse_constant(name: str, stored: np.ndarray, white: float) -> None:
    if stored.min() == stored.max() < white:
        raise CaptureError(f"{name}: every pixel is {stored.flat[0]}, so its RAW data are missing; copy it again")


def _exposure(other: Any) -> dict[str, float]:
    """LibRaw's exposure of a file whose EXIF is elsewhere; 1 s at f/1 is what it says when it found none."""
    invented = other.shutter_speed == 1.0 and other.aperture in (0.0, 1.0)
    found = {"iso": other.iso_speed, "focal_mm": other.focal_length}
    if not invented:
        found |= {"exposure_s": other.shutter_speed, "fnumber": other.aperture}
    return {key: float(value) for key, value in found.items()}


def error_text(error: Exception) -> str:
    """What LibRaw says of an error, one line."""
    text = error.args[0] if error.args else type(error).__name__
    return text.decode() if isinstance(text, bytes) else str(text)
