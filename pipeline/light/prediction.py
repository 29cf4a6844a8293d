"""Predictions of what really stood there, from what was estimated: the mirror ball, its shadow, the board's paper.

Forward models on purpose: the probe stage goes from map to ball, these go from the ball's pixel to the map, so a wrong
sign in one is not hidden by the same wrong sign in the other.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import (
    invert_rigid,
    latlong_from_direction,
    transform_points,
)
from pipeline.image.metrics import box
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.glass import Glass
from pipeline.probes.reflection import directions_from_rays
from pipeline.transport.conductors import GRAZING, reflectance_at
from pipeline.types import BallFit, Camera, Plane

SAMPLE_ROW = 1024
OUTLINE_PX = 4.0  # rim of the ball's picture that is left out beside its silhouette


def sample(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (N, C) of a picture (H, W, C) at any number of pixel positions (N,), bilinear, border repeated."""
    if not x.size:
        return np.zeros((0, picture.shape[2]), np.float32)
    shape = (-(-x.size // SAMPLE_ROW), SAMPLE_ROW)  # OpenCV takes at most 32767 positions in one row
    found = bilinear(planes(picture), np.resize(x, shape), np.resize(y, shape))
    return found.reshape(-1, picture.shape[2])[: x.size]


def lookup(environment: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance (N, C) of a lat-long map (H, W, C) in world ``directions`` (N, 3), bilinear, wrapping around."""
    height, width = environment.shape[:2]
    u, v = latlong_from_direction(directions)
    around = np.concatenate([environment[:, -1:], environment, environment[:, :1]], 1)
    return sample(around, u * width + 1, v * height)


def ball_crop(camera: Camera, ball: BallFit, margin: float = 1.25) -> tuple[slice, slice]:
    """Rows and columns of the picture around the ball, ``margin`` radii to each side, inside the frame."""
    x, y = project(camera, ball.centre_camera_m[None])[0]
    reach = margin * ball.radius_px
    rows = slice(max(0, int(y - reach)), min(camera.height, int(np.ceil(y + reach))))
    return rows, slice(max(0, int(x - reach)), min(camera.width, int(np.ceil(x + reach))))


def pixel_centres(rows: slice, columns: slice) -> np.ndarray:
    """(h, w, 2) x, y of the pixels of a crop."""
    y, x = np.mgrid[rows, columns]
    return np.stack([x, y], -1) + 0.5


def ball_directions(
    camera: Camera, ball: BallFit, world_from_camera: np.ndarray, rows: slice, columns: slice
) -> tuple[np.ndarray, np.ndarray]:
    """World directions (h, w, 3), as seen from the ball's centre, of what each pixel of a crop mirrors; NaN outside.

    Also the sine of the incidence (h, w). Below the horizon that is the plane y = 0, at its finite place.
    """
    px = pixel_centres(rows, columns)
    rays = pixel_rays(camera, px.reshape(-1, 2))
    glass = Glass(ball.glass) if ball.glass > 0 else None
    away = directions_from_rays(rays, ball.centre_camera_m, ball.radius_m, glass)
    normal = away - rays
    normal = ball.radius_m * normal / np.linalg.norm(normal, axis=-1, keepdims=True) @ world_from_camera[:3, :3].T
    mirrored = away @ world_from_camera[:3, :3].T
    height = transform_points(world_from_camera, ball.centre_camera_m)[1] + normal[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = normal + np.where(mirrored[:, 1] < 0, -height / mirrored[:, 1], np.inf)[:, None] * mirrored
        seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
        below = (mirrored[:, 1] < -1e-6) & (height > 0)
    mirrored = np.where(below[:, None], seen, mirrored)
    sine = np.linalg.norm(np.cross(rays, ball.centre_camera_m), axis=-1) / ball.radius_m
    sine[~np.isfinite(mirrored[:, 0])] = np.nan
    return mirrored.reshape(*px.shape[:2], 3), sine.reshape(px.shape[:2])


def ball_reflectance(ball: BallFit, sine: np.ndarray) -> np.ndarray:
    """Reflectance (..., 3) of a ball under incidences of this ``sine`` (...); head on where it is NaN."""
    if ball.glass > 0:
        return Glass(ball.glass).total(ball.reflectance, np.nan_to_num(sine))
    if ball.edge_tint is None:
        return np.broadcast_to(ball.reflectance, (*sine.shape, 3))
    cosine = np.sqrt(np.clip(1 - np.nan_to_num(sine) ** 2, 0, 1))
    at_edge = ball.reflectance + (1 - ball.reflectance) * (1 - GRAZING) ** 5
    return reflectance_at(ball.reflectance, at_edge * ball.edge_tint, cosine)


def mirrored_picture(environment: np.ndarray, directions: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
    """The ball's picture (h, w, 3) from its directions (h, w, 3): map x reflectance; NaN outside the ball."""
    picture = np.full(directions.shape, np.nan, np.float32)
    inside = np.isfinite(directions[..., 0])
    picture[inside] = lookup(environment, directions[inside]) * np.broadcast_to(reflectance, directions.shape)[inside]
    return picture


def splat(directions: np.ndarray, values: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (H, W, 3) of the values (N, 3) that fall into each texel of a lat-long map, and how many (H, W)."""
    u, v = latlong_from_direction(directions)
    texel = np.minimum((v * height).astype(int), height - 1) * width + np.minimum((u * width).astype(int), width - 1)
    count = np.bincount(texel, minlength=height * width)
    sums = np.stack([np.bincount(texel, values[:, c], height * width) for c in range(values.shape[1])], -1)
    mean = np.divide(sums, count[:, None], out=np.zeros_like(sums), where=count[:, None] > 0)
    return mean.reshape(height, width, -1), count.reshape(height, width)


def shadow_ratio(
    photograph: np.ndarray, plate: np.ndarray, bad: np.ndarray, camera: Camera, world_from_camera: np.ndarray,
    ball: BallFit, points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Measured ratio (N, 3) of 5x5 means, photograph over plate, at world ``points`` (N, 3); and which are usable (N,).

    Not usable: outside the frame, a ``bad`` (H, W) pixel among the 25, or behind or beside the ball's own picture.
    """
    local = transform_points(invert_rigid(world_from_camera), points)
    px = project(camera, local)
    inside = np.isfinite(px).all(-1) & (px > 3).all(-1) & (px < (camera.width - 3, camera.height - 3)).all(-1)
    towards = ball.centre_camera_m / np.linalg.norm(ball.centre_camera_m)
    away = np.arccos(np.clip(local @ towards / np.linalg.norm(local, axis=-1), -1, 1))
    silhouette = np.arcsin(ball.radius_m / np.linalg.norm(ball.centre_camera_m))
    usable = inside & (away > silhouette + OUTLINE_PX / camera.fx)
    ratio = np.full(points.shape, np.nan)
    if not usable.any():
        return ratio, usable
    column, row = px[usable].astype(int).T
    crop = slice(row.min() - 3, row.max() + 4), slice(column.min() - 3, column.max() + 4)
    at = row - crop[0].start, column - crop[1].start
    numerator, denominator = box(photograph[crop])[at], box(plate[crop])[at]
    clean = (box(bad[crop].astype(float))[at] < 1e-6) & (denominator > 0).all(-1)
    found = np.full(numerator.shape, np.nan)
    found[clean] = numerator[clean] / denominator[clean]
    ratio[usable] = found
    usable[usable] = clean
    return ratio, usable


def plane_coordinates(plane: Plane, points: np.ndarray) -> np.ndarray:
    """(N, 2) position of world ``points`` (N, 3) in the modelled rectangle, 0..1 along its first and its last edge."""
    origin, along, _, down = plane.corners_m
    edges = np.stack([along - origin, down - origin], -1)
    return np.linalg.lstsq(edges, (points - origin).T, rcond=None)[0].T


def plane_texture(plane: Plane, texture: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, C) of a texture (h, w, C) over the rectangle at world ``points`` (N, 3); NaN outside it."""
    at = plane_coordinates(plane, points)
    height, width = texture.shape[:2]
    values = sample(texture, at[:, 0] * width, at[:, 1] * height)
    values[~((at >= 0) & (at <= 1)).all(-1)] = np.nan
    return values


def plane_hits(plane: Plane, camera: Camera, world_from_camera: np.ndarray, px: np.ndarray) -> np.ndarray:
    """World points (N, 3) where the rays of pixels (N, 2) meet the plane; NaN where they do not, in front."""
    rays = pixel_rays(camera, px) @ world_from_camera[:3, :3].T
    start = world_from_camera[:3, 3]
    slope = rays @ plane.normal
    with np.errstate(divide="ignore", invalid="ignore"):  # grazing rays: no hit
        distance = (plane.offset_m - start @ plane.normal) / slope
    return start + np.where(distance > 0, distance, np.nan)[:, None] * rays


def paper_points(squares: tuple[int, int], square_m: float, marker_m: float, legacy: bool) -> np.ndarray:
    """World points (N, 3) on the white paper of a ChArUco board: midway between the markers and their squares' edges.

    The squares that hold markers are those with odd row + column (OpenCV), even in the legacy layout with even rows.
    """
    columns, rows = squares
    first = 0 if legacy and rows % 2 == 0 else 1
    reach = (square_m + marker_m) / 4  # from the square's centre to the middle of the white rim
    steps = np.linspace(-0.8, 0.8, 9) * reach
    rim = [(s, t * reach) for s in steps for t in (-1, 1)] + [(t * reach, s) for s in steps for t in (-1, 1)]
    centres = [
        ((c + 0.5) * square_m, (r + 0.5) * square_m)
        for r in range(rows)
        for c in range(columns)
        if (r + c) % 2 == first
    ]
    flat = (np.array(centres)[:, None] + np.array(rim)[None]).reshape(-1, 2)
    return np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], -1)
