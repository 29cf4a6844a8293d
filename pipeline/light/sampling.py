"""Bilinear lookup of many channels at sub-pixel positions; the second place that imports cv2 (for its speed only)."""

from __future__ import annotations

import numpy as np

from pipeline.conventions import HALF_PIXEL


def planes(picture: np.ndarray) -> list[np.ndarray]:
    """A picture (H, W, C) or (H, W) as float32 groups of at most four channels, as `bilinear` wants it: split once."""
    picture = np.asarray(picture, np.float32)
    picture = picture[..., None] if picture.ndim == 2 else picture
    return [np.ascontiguousarray(picture[..., i : i + 4]) for i in range(0, picture.shape[2], 4)]


def bilinear(groups: list[np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (N, M, C) float32 of a picture split by `planes` at pixels ``x, y`` (N, M), first centre (0.5, 0.5).

    Positions are those of float32; beyond the outermost centres the border is repeated.
    """
    import cv2

    map_x, map_y = ((np.asarray(p) - HALF_PIXEL).astype(np.float32) for p in (x, y))
    found = [cv2.remap(group, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for group in groups]
    return np.concatenate([f.reshape(*x.shape, -1) for f in found], -1)


def enlarged(picture: np.ndarray, factor: int) -> np.ndarray:
    """A float32 picture (H, W) with ``factor`` times as many pixels along each side, bilinear between their centres."""
    import cv2

    return cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)


def summed_areas(picture: np.ndarray, out: np.ndarray) -> None:
    """Into ``out`` (H + 1, W + 1, C) float64: sums of a float32 picture (H, W, C) above and left of each corner."""
    import cv2

    cv2.integral(picture, sum=out, sdepth=cv2.CV_64F)
