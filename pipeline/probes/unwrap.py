"""From a photographed mirror ball to a lat-long map, by the exact reflection of `pipeline.probes.reflection`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import distort
from pipeline.conventions import invert_rigid
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.reflection import rays_from_directions
from pipeline.types import Camera

BLOCK_TEXELS = 1 << 15  # texels per block of rows: the temporaries stay in the cache


@dataclass(frozen=True)
class Unwrapped:
    """One view on the lat-long grid: area means of the samples the ball shows.

    ``values`` (H, W, C), zero where nothing is seen; ``coverage`` (H, W) fraction of the texel seen inside the rim cut;
    ``sine`` (H, W) sin of the incidence at the texel's centre (radius as a fraction of the silhouette), NaN if unseen.
    """

    values: np.ndarray
    coverage: np.ndarray
    sine: np.ndarray


def samples_per_axis(width: int, radius_px: float, wanted: int) -> int:
    """Sub-samples per texel and axis so that neighbours on the ball are at most about one pixel apart."""
    return max(wanted, int(np.ceil(2 * np.pi / width * radius_px)))


def unwrap(
    picture: np.ndarray, camera: Camera, world_from_camera: np.ndarray, centre: np.ndarray, radius: float,
    height: int, width: int, supersample: int, rim: float,
) -> Unwrapped:  # fmt: skip
    """Lat-long map (height, width), world frame, of the ball in ``picture`` (H, W, C); radiance as photographed.

    Each texel is the solid-angle mean of ``supersample**2`` bilinear lookups; those outside the frame or beyond
    ``rim`` of the silhouette's radius are left out. ``centre`` (3,) of the ball is in the camera frame, metres.
    """
    values = np.zeros((height, width, picture.shape[2]), np.float32)
    coverage, sine_map = np.zeros((height, width), np.float32), np.full((height, width), np.nan, np.float32)
    groups, distance = planes(picture), float(np.linalg.norm(centre))
    rotation = invert_rigid(world_from_camera)[:3, :3]
    offsets = (np.arange(supersample) + 0.5) / supersample
    rows = max(1, BLOCK_TEXELS // width)
    for top in range(0, height, rows):
        block = slice(top, min(top + rows, height))
        v = np.arange(block.start, block.stop)
        total = np.zeros((len(v), 1), np.float32)
        for dv in offsets:
            weight = np.sin(np.pi * (v + dv) / height).astype(np.float32)[:, None]
            total += supersample * weight
            for du in offsets:
                w = _directions(v + dv, np.arange(width) + du, height, width, rotation)
                rays, sine = rays_from_directions(w, (-centre / distance).astype(np.float32), radius / distance)
                x, y, inside = _pixels(camera, rays)
                use = weight * (inside & (sine <= rim))
                values[block] += use[..., None] * bilinear(groups, x, y)
                coverage[block] += use
        _, sine = rays_from_directions(
            _directions(v + 0.5, np.arange(width) + 0.5, height, width, rotation),
            (-centre / distance).astype(np.float32), radius / distance,
        )  # fmt: skip
        sine_map[block] = sine
        values[block] /= np.where(coverage[block] > 0, coverage[block], 1)[..., None]
        coverage[block] /= total
    return Unwrapped(values, coverage, sine_map)


def _directions(row: np.ndarray, column: np.ndarray, height: int, width: int, rotation: np.ndarray) -> np.ndarray:
    """Unit directions (N, M, 3) float32 of lat-long positions in texels, rotated by ``rotation`` (3, 3)."""
    theta, phi = np.pi * row / height, 2 * np.pi * column / width
    ring = np.stack([np.sin(phi), 0 * phi, -np.cos(phi)], -1) @ rotation.T
    up = np.cos(theta)[:, None] * rotation[:, 1]
    return (np.sin(theta)[:, None, None] * ring + up[:, None, :]).astype(np.float32)


def _pixels(camera: Camera, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels x, y of rays (..., 3), float32, and whether bilinear lookup there is inside the frame."""
    xy = distort(camera.distortion.astype(np.float32), rays[..., :2] / rays[..., 2:])
    x = xy[..., 0] * np.float32(camera.fx) + np.float32(camera.cx)
    y = xy[..., 1] * np.float32(camera.fy) + np.float32(camera.cy)
    inside = (x >= 0.5) & (x <= camera.width - 0.5) & (y >= 0.5) & (y <= camera.height - 0.5) & (rays[..., 2] > 0)
    return np.where(inside, x, 0), np.where(inside, y, 0), inside
