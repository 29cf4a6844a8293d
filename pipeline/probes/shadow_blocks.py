"""Blocks of pixels of the plane around a ball: how much darker they are with the ball than without it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import CLIPPED, GHOST, HOT, invert_rigid, transform_points
from pipeline.types import BallFit, Camera, Raster

REACH = 9.0  # ball radii around the foot that are looked at: the shadow of a lamp 13 degrees above the plane
BLOCKS_PER_RADIUS, OUTLINE_PX = 20, 4.0
MODEL = 0.002  # of the free irradiance: what the model of a shadow leaves out (1e-3 rms at 1.2 radii, on truth)


@dataclass(frozen=True)
class Blocks:
    """Means of square blocks of ``side`` x ``side`` pixels: points (N, 3) on the plane, ratio and sigma (N, 3).

    ``size`` (N,): half diagonal [m]; ``step`` (N, 2, 3): how far on the plane a pixel along the row, and one along the
    column, goes [m].
    """

    points: np.ndarray
    ratio: np.ndarray
    sigma: np.ndarray
    size: np.ndarray
    step: np.ndarray
    side: int


def plane_blocks(
    photograph: Raster, plate: Raster, camera: Camera, world_from_camera: np.ndarray, ball: BallFit
) -> Blocks:
    """Ball photograph over plate, in blocks of pixels that show the plane y = 0 beside the ball, within ``REACH``."""
    side = max(3, round(ball.radius_px / BLOCKS_PER_RADIUS))
    centre = transform_points(world_from_camera, ball.centre_camera_m)
    window = _window(camera, world_from_camera, centre * (1, 0, 1), REACH * ball.radius_m, side)
    means = []
    bad = np.zeros([(part.stop - part.start) // side for part in window], bool)
    for raster in (photograph, plate):
        mask = (raster["mask"][window] & (CLIPPED | GHOST | HOT)) != 0
        bad |= _blocks(mask[..., None].astype(float), side)[..., 0] > 0
        means.append(_blocks(raster.rgb()[window].astype(float), side))
        means.append(_blocks(raster.rgb("variance")[window].astype(float), side) / side**2)
    one, one_variance, other, other_variance = means
    row, column = (np.arange(n) * side + part.start + side / 2 for n, part in zip(bad.shape, window, strict=True))
    px = np.stack(np.meshgrid(column, row), -1).reshape(-1, 2)
    corners = [
        _on_plane(camera, world_from_camera, px + np.array(step) * side / 2) for step in ((0, 0), (1, 1), (1, -1))
    ]
    step = np.stack([corners[1] + corners[2] - 2 * corners[0], corners[1] - corners[2]], 1) / side
    size = np.max([np.linalg.norm(corner - corners[0], axis=-1) for corner in corners[1:]], 0)
    rays = pixel_rays(camera, px)
    outline = np.arcsin(ball.radius_m / np.linalg.norm(ball.centre_camera_m)) + (OUTLINE_PX + side) / camera.fx
    towards = ball.centre_camera_m / np.linalg.norm(ball.centre_camera_m)
    good = ~bad.ravel() & (np.arccos(np.clip(rays @ towards, -1, 1)) > outline) & np.isfinite(size)
    good &= np.linalg.norm(corners[0] - centre * (1, 0, 1), axis=-1) < REACH * ball.radius_m
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (one / other).reshape(-1, 3)
        sigma = ratio * np.sqrt(one_variance / one**2 + other_variance / other**2).reshape(-1, 3)
    good &= np.isfinite(ratio).all(-1) & np.isfinite(sigma).all(-1) & (other.reshape(-1, 3) > 0).all(-1)
    return Blocks(corners[0][good], ratio[good], np.hypot(sigma[good], MODEL), size[good], step[good], side)


def _window(
    camera: Camera, world_from_camera: np.ndarray, foot: np.ndarray, reach: float, side: int
) -> tuple[slice, slice]:
    """Rows and columns, whole blocks, that hold what the picture shows of a disc on the plane."""
    turn = 2 * np.pi * np.arange(72) / 72
    disc = np.concatenate([
        foot + r * np.stack([np.sin(turn), 0 * turn, np.cos(turn)], -1) for r in np.linspace(0.1, 1, 8) * reach
    ])  # fmt: skip
    local = transform_points(invert_rigid(world_from_camera), disc)
    px = project(camera, local[local[:, 2] > 0])
    px = px[np.isfinite(px).all(-1)]
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(px.min(0)), 0, size - side).astype(int) if len(px) else np.zeros(2, int)
    high = np.clip(np.ceil(px.max(0)), low + side, size).astype(int) if len(px) else low + side
    high = low + (high - low) // side * side
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _blocks(picture: np.ndarray, side: int) -> np.ndarray:
    """Means (h, w, C) of blocks of side x side pixels."""
    height, width, channels = picture.shape
    return np.asarray(picture.reshape(height // side, side, width // side, side, channels).mean((1, 3)))


def _on_plane(camera: Camera, world_from_camera: np.ndarray, px: np.ndarray) -> np.ndarray:
    """World points (N, 3) of pixels (N, 2) on y = 0; NaN where their rays do not come down on it."""
    rays = pixel_rays(camera, px) @ world_from_camera[:3, :3].T
    start = world_from_camera[:3, 3]
    down = rays[:, 1] < -1e-6
    return start - rays * np.where(down, start[1] / np.where(down, rays[:, 1], 1), np.nan)[:, None]
