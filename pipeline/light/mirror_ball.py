"""A mirror ball in perspective: which ray sees which direction, exactly, and the unwrap to lat-long built on it.

Geometry, in the plane of camera, ball centre and reflected ray: a ray that makes the angle ``rho`` with the ray to the
centre passes the centre at distance ``D sin rho``, so it meets the ball (radius R) under the incidence ``i`` with
``sin i = sin rho / k``, ``k = R / D``, and leaves it under the angle
    theta = 2 i - rho,   rho = asin(k sin i)
from the direction ball -> camera. theta grows with i up to ``pi - asin(k)``: the cone of half angle asin(k) behind the
ball is blind. For k -> 0 this is Debevec's (1998) ``theta = 2 asin(r)``, r = sin i the radius as a fraction of the
silhouette's. Directions belong to infinitely distant light; near surfaces are displaced by up to R / distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import distort
from pipeline.conventions import invert_rigid
from pipeline.light.sampling import bilinear, planes
from pipeline.types import Camera

NEWTON_STEPS = 4  # f'' <= k f': from i = theta / (2 - k) four steps reach rounding for k <= 0.9
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


def blind_half_angle(ratio: float) -> float:
    """Half angle [rad] of the cone behind the ball that reflects nothing to the camera; ``ratio`` = R / D."""
    return float(np.arcsin(ratio))


def deviation(sine: np.ndarray, ratio: float) -> np.ndarray:
    """Angle theta [rad] between the direction to the camera and the reflected direction; ``sine`` = sin(incidence)."""
    return 2 * np.arcsin(sine) - np.arcsin(ratio * np.asarray(sine))


def incidence(theta: np.ndarray, ratio: float) -> np.ndarray:
    """Incidence i [rad] that reflects towards ``theta``, by Newton: inverse of `deviation`; over pi/2 if blind."""
    angle = theta / (2 - np.asarray(ratio, theta.dtype))
    k = angle.dtype.type(ratio)
    for _ in range(NEWTON_STEPS):
        sine = k * np.sin(angle)
        slope = 2 - k * np.cos(angle) / np.sqrt(1 - sine * sine)
        angle = angle - (2 * angle - np.arcsin(sine) - theta) / slope
    return angle


def rays_from_directions(directions: np.ndarray, to_camera: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays from the camera (..., 3) that the ball reflects to unit ``directions`` (..., 3), same frame.

    Also returns the sine of the incidence (...), NaN in the blind cone. ``to_camera`` (3,) is the unit direction from
    the centre to the camera. Float32 in, float32 out: 1e-7 rad.
    """
    directions = np.asarray(directions)
    to_camera = np.asarray(to_camera, directions.dtype)
    cosine = np.clip(directions @ to_camera, -1, 1)
    theta = np.arccos(cosine)
    angle = incidence(theta, ratio)
    sine = np.where(angle <= np.pi / 2, np.sin(angle), np.nan).astype(directions.dtype)
    sine_rho = directions.dtype.type(ratio) * sine
    sine_theta = np.sin(theta)
    tiny = sine_theta < 1e-4  # towards the camera: the limit of sin rho / sin theta is k / (2 - k)
    along = np.where(tiny, ratio / (2 - ratio), sine_rho / np.where(tiny, 1, sine_theta)).astype(directions.dtype)
    back = np.sqrt(1 - sine_rho * sine_rho) + cosine * along
    return along[..., None] * directions - back[..., None] * to_camera, sine


def directions_from_rays(rays: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Unit directions (N, 3) into which unit ``rays`` (N, 3) from the origin are reflected; NaN where they miss."""
    along = rays @ centre
    inside = along**2 - centre @ centre + radius**2
    distance = along - np.sqrt(np.where(inside >= 0, inside, np.nan))
    normal = (distance[:, None] * rays - centre) / radius
    return rays - 2 * (rays * normal).sum(-1, keepdims=True) * normal


def radians_per_pixel(sine: np.ndarray, ratio: float, radius_px: float) -> tuple[np.ndarray, np.ndarray]:
    """How many radians of environment one pixel spans along the radius and across it, at radius fraction ``sine``."""
    sine = np.asarray(sine)
    radial = (2 / np.sqrt(1 - sine**2) - ratio / np.sqrt(1 - (ratio * sine) ** 2)) / radius_px
    small = sine < 1e-3
    across = np.sin(deviation(sine, ratio)) / (np.where(small, 1, sine) * radius_px)
    return radial, np.where(small, (2 - ratio) / radius_px, across)


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
