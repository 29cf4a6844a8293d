"""The camera's lens: points to pixels, pixels to rays, and every derivative, on numpy.

``px = (fx x' + cx, fy y' + cy)`` with x', y' of the distortion model that the camera's coefficients belong to: Brown,
rational or fisheye (`pipeline/camera/distortion.py`). Points that the model does not image project to NaN, and pixels
that no ray of it reaches are refused. Pixels: first centre (0.5, 0.5). Points: camera frame, metres.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.distortion import (
    coefficient_jacobian,
    distort,
    distortion_jacobian,
    fold_radius_squared,
    undistort,
)
from pipeline.types import Camera

BLOCK = 1 << 15  # pixels at once: their temporaries stay in the cache


def normalised(points_camera: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """(N, 2) X/Z, Y/Z; NaN for points behind the camera or beyond the fold of the distortion."""
    points = np.asarray(points_camera, float)
    ahead = points[..., 2] > 0
    xy = np.where(ahead[..., None], points[..., :2], np.nan) / np.where(ahead, points[..., 2], 1.0)[..., None]
    inner = xy[..., 0] ** 2 + xy[..., 1] ** 2 < fold_radius_squared(distortion)  # a sum over an axis of two is slow
    return np.where(inner[..., None], xy, np.nan)


def project(camera: Camera, points_camera: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in the camera frame, metres; NaN where the lens does not image a point."""
    xy = distort(camera.distortion, normalised(points_camera, camera.distortion))
    return xy * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def project_jacobians(camera: Camera, points_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2), their derivatives by the point (N, 2, 3) and by fx fy cx cy and C coefficients (N, 2, 4 + C)."""
    points = np.asarray(points_camera, float)
    xy = normalised(points, camera.distortion)
    bent = distort(camera.distortion, xy)
    focal = np.array([camera.fx, camera.fy])
    z = points[:, 2]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
    by_point[:, :, 2] = -xy / z[:, None]
    by_point = focal[:, None] * (distortion_jacobian(camera.distortion, xy) @ by_point)
    by_lens = np.zeros((len(points), 2, 4 + len(camera.distortion)))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = bent[:, 0], bent[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = focal[:, None] * coefficient_jacobian(camera.distortion, xy)
    return bent * focal + (camera.cx, camera.cy), by_point, by_lens


def unproject(camera: Camera, px: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates (N, 2) of pixels (N, 2): the ray is (x, y, 1) in the camera frame."""
    distorted = (np.asarray(px, float) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return undistort(camera.distortion, distorted)


def pixel_rays(camera: Camera, px: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3), camera frame, of pixels (N, 2), through the full inverse of the lens."""
    xy = unproject(camera, px)
    rays = np.ones((*xy.shape[:-1], 3))
    rays[..., :2] = xy
    rays /= np.sqrt(1 + xy[..., 0] ** 2 + xy[..., 1] ** 2)[..., None]
    return rays


def rays_through(camera: Camera, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted normalised coordinates of pixels and their derivative by the pixel, for jittered rays.

    Args:
        camera: the lens.
        px: (N, 2) pixels.

    Returns:
        xn: (N, 2) float64; the ray of a pixel is (xn, 1) in the camera frame.
        dxn: (N, 2, 2) float64; ``dxn[:, i, j] = d xn_i / d px_j`` with px = (x, y).
    """
    xn = np.empty((len(px), 2))
    dxn = np.empty((len(px), 2, 2))
    for start in range(0, len(px), BLOCK):
        some = slice(start, start + BLOCK)
        xn[some] = unproject(camera, px[some])
        jacobian = distortion_jacobian(camera.distortion, xn[some])
        a, b, d = jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 1]
        determinant = a * d - b * b
        dxn[some, 0, 0], dxn[some, 1, 1] = d / determinant / camera.fx, a / determinant / camera.fy
        dxn[some, 0, 1], dxn[some, 1, 0] = -b / determinant / camera.fy, -b / determinant / camera.fx
    return xn, dxn
