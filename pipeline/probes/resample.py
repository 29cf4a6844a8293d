"""Pictures that know a direction for every pixel, brought to the world's lat-long grid by dense lookups.

The gather's twin of `pipeline.probes.unwrap` for pictures without a ball: a panorama, a ready-made map, a fisheye.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_from_direction
from pipeline.light.environment import resize_environment
from pipeline.light.sampling import bilinear, planes

BLOCK_TEXELS = 1 << 15  # texels per block of rows: the temporaries stay in the cache
MOST_SAMPLES = 12  # per texel and axis

# Directions (..., 3) in the picture's frame -> pixels x, y and which of them the picture shows.
ToPixel = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Gathered:
    """Solid-angle means (H, W, C) of what a picture shows, zero where nothing; coverage (H, W) in [0, 1]."""

    values: np.ndarray
    coverage: np.ndarray


def gather(
    picture: np.ndarray, to_pixel: ToPixel, world_from_picture: np.ndarray, height: int, width: int, count: int
) -> Gathered:
    """Lat-long map (height, width), world frame, of a picture (h, w, C) turned by ``world_from_picture`` (3, 3).

    Each texel is the solid-angle mean of ``count**2`` bilinear lookups, at most 12 x 12; those that the picture does
    not show are left out.
    """
    count = min(count, MOST_SAMPLES)
    values = np.zeros((height, width, picture.shape[2]), np.float32)
    coverage = np.zeros((height, width), np.float32)
    groups, rows = planes(picture), max(1, BLOCK_TEXELS // width)
    offsets = (np.arange(count) + 0.5) / count
    for top in range(0, height, rows):
        block = slice(top, min(top + rows, height))
        v = np.arange(block.start, block.stop)
        total = np.zeros((len(v), 1), np.float32)
        for dv in offsets:
            theta = np.pi * (v + dv) / height
            weight = np.sin(theta).astype(np.float32)[:, None]
            total += count * weight
            for du in offsets:
                phi = 2 * np.pi * (np.arange(width) + du) / width
                ring = np.stack([np.sin(phi), 0 * phi, -np.cos(phi)], -1) @ world_from_picture
                w = np.sin(theta)[:, None, None] * ring + (np.cos(theta)[:, None] * world_from_picture[1])[:, None]
                x, y, shown = to_pixel(w)
                use = weight * shown
                values[block] += use[..., None] * bilinear(groups, np.where(shown, x, 0), np.where(shown, y, 0))
                coverage[block] += use
        values[block] /= np.where(coverage[block] > 0, coverage[block], 1)[..., None]
        coverage[block] /= total
    return Gathered(values, coverage)


def turned(picture: np.ndarray, world_from_map: np.ndarray, height: int, width: int, least: int) -> Gathered:
    """A lat-long map (h, w, C) turned by ``world_from_map`` (3, 3), on another grid.

    Without a turn it is the exact area mean. Else it is first averaged to the grid where it is finer, and then looked
    up at a quarter of a texel's steps: lamps of one texel keep their energy to 0.2 %, at worst to 1.5 %.
    """
    if np.allclose(world_from_map, np.eye(3), atol=1e-12):
        return Gathered(resize_environment(picture, height, width).astype(np.float32), np.ones((height, width)))
    if picture.shape[0] > height:
        picture = resize_environment(picture, height, width).astype(np.float32)
    around = np.concatenate([picture[:, -1:], picture, picture[:, :1]], 1)
    size_v, size_u = picture.shape[:2]

    def to_pixel(w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        u, v = latlong_from_direction(w)
        return u * size_u + 1, v * size_v, np.ones(u.shape, bool)

    return gather(around, to_pixel, world_from_map, height, width, max(least, 4))
