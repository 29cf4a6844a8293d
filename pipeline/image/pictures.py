"""Small display pictures for people: thumbnails through the display transform, heat maps, data URIs. Arrays uint8.

Nothing here is read back; sizes are chosen so that a page of twenty pictures stays below 4 MB.
"""

from __future__ import annotations

import base64
import io

import numpy as np

from pipeline.image.display import DISPLAY, VIEW, auto_exposure, display_transform

# Perceptually even ramps as nine sRGB stops each, of our own making: lightness rises by equal steps (tested).
HEAT = np.array([
    [6, 4, 20], [39, 17, 70], [83, 22, 98], [127, 33, 100], [172, 49, 88], [212, 76, 66], [240, 117, 45],
    [250, 170, 52], [252, 226, 130],
], float)  # fmt: skip
NOT_KNOWN = (110, 114, 120)  # where a map holds no number


def shrink(picture: np.ndarray, width: int) -> np.ndarray:
    """Area mean by the whole factor that brings (H, W, ...) nearest to ``width`` columns; a rest is cut off."""
    factor = max(1, round(picture.shape[1] / width))
    if factor == 1:
        return picture
    rows, columns = (side // factor for side in picture.shape[:2])
    if not rows:
        return picture
    blocks = picture[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, *picture.shape[2:])
    return blocks.mean((1, 3), dtype=np.float64).astype(np.float32)


def thumbnail(rgb: np.ndarray, width: int = 560, exposure_ev: float | None = None) -> np.ndarray:
    """Display picture (h, w, 3) of ACEScg (H, W, 3) about ``width`` wide; exposed by its own median unless given."""
    small = shrink(rgb, width)
    exposure = auto_exposure(small) if exposure_ev is None else exposure_ev
    return display_transform(small, DISPLAY, VIEW, exposure)


def heat(values: np.ndarray, high: float, low: float = 0.0) -> np.ndarray:
    """Heat map (H, W, 3) of values (H, W), ``low`` dark and ``high`` or more bright; grey where not finite."""
    known = np.isfinite(values)
    at = np.clip((np.where(known, values, low) - low) / (high - low or 1.0), 0, 1) * (len(HEAT) - 1)
    stops = np.arange(len(HEAT))
    picture = np.stack([np.interp(at, stops, HEAT[:, c]) for c in range(3)], -1).round().astype(np.uint8)
    picture[~known] = NOT_KNOWN
    return picture


def signed(values: np.ndarray, high: float) -> np.ndarray:
    """Map (H, W, 3) of signed values: blue below zero, white at zero, red above; ``high`` is full colour."""
    known = np.isfinite(values)
    at = np.clip(np.where(known, values, 0) / (high or 1.0), -1, 1)[..., None]
    red, blue, white = np.array([178, 42, 52.0]), np.array([38, 94, 170.0]), np.array([246, 246, 244.0])
    picture = (white + np.maximum(at, 0) * (red - white) + np.maximum(-at, 0) * (blue - white)).round().astype(np.uint8)
    picture[~known] = NOT_KNOWN
    return picture


def classes(values: np.ndarray, colours: list[tuple[int, int, int]]) -> np.ndarray:
    """Picture (H, W, 3) of class numbers (H, W); numbers beyond the list take its last colour."""
    table = np.array(colours, np.uint8)
    return table[np.minimum(values.astype(int), len(table) - 1)]


def first_bit(mask: np.ndarray) -> np.ndarray:
    """Class (H, W) of a bit mask: 0 for none, else 1 + the lowest bit set."""
    value = mask.astype(np.int64)
    lowest = value & -value
    return np.where(value > 0, np.log2(np.maximum(lowest, 1)).astype(int) + 1, 0)


def checkered(rgb: np.ndarray, alpha: np.ndarray, size: int = 8) -> np.ndarray:
    """Display picture (H, W, 3) with its transparent parts over a checkerboard; ``alpha`` (H, W) in [0, 1]."""
    rows, columns = np.indices(alpha.shape) // size
    board = np.where((rows + columns) % 2, 196, 226)[..., None]
    a = np.clip(alpha, 0, 1)[..., None]
    return (a * rgb + (1 - a) * board).round().astype(np.uint8)


def jpeg_uri(picture: np.ndarray, quality: int = 84) -> str:
    """``data:`` URI of a picture (H, W, 3) as JPEG."""
    return _uri(picture, "jpeg", quality=quality, subsampling=0 if quality > 88 else 2)


def png_uri(picture: np.ndarray) -> str:
    """``data:`` URI of a picture (H, W, 3) as PNG, for maps whose colours mean numbers."""
    return _uri(picture, "png", compress_level=6)


def _uri(picture: np.ndarray, kind: str, **options: int) -> str:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(stream, kind, **options)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"
