"""A pinhole with Brown distortion: points to pixels, pixels to rays, and every derivative, on numpy.

Model (Brown 1971, as OpenCV's five coefficients): with ``x = X/Z, y = Y/Z, s = x^2 + y^2``
    x' = x (1 + k1 s + k2 s^2 + k3 s^3) + 2 p1 x y + p2 (s + 2 x^2)
    y' = y (1 + k1 s + k2 s^2 + k3 s^3) + p1 (s + 2 y^2) + 2 p2 x y
    px = (fx x' + cx, fy y' + cy)
The inverse is Newton's, to rounding. Beyond the radius where the radial curve turns back the model is not one-to-one:
such points project to NaN and such pixels are refused. Pixels: first centre (0.5, 0.5). Points: camera frame, metres.
"""

from __future__ import annotations

import functools

import numpy as np

from pipeline.run.errors import NumericalError
from pipeline.types import Camera

NEWTON_STEPS = 30
BLOCK = 1 << 15  # pixels at once: their temporaries stay in the cache


def fold_radius_squared(distortion: np.ndarray) -> float:
    """Smallest squared radius of undistorted coordinates where the radial curve stops growing; inf if never."""
    return _fold(*(float(k) for k in np.asarray(distortion)[[0, 1, 4]]))


@functools.lru_cache(maxsize=64)
def _fold(k1: float, k2: float, k3: float) -> float:
    if not np.isfinite((k1, k2, k3)).all():
        return 0.0  # a step of an adjustment that ran away: it images nothing
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))].real
    return float(min(real[real > 0], default=np.inf))


def distort(distortion: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Distorted normalised coordinates (..., 2) of undistorted ones (..., 2)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    cross = 2 * x * y
    return np.stack(
        [x * radial + p1 * cross + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + p2 * cross], -1
    )


def distortion_jacobian(distortion: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Derivative (..., 2, 2) of `distort` by the undistorted coordinates."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))  # d radial / dx = x * slope
    jacobian = np.empty((*xy.shape, 2))
    jacobian[..., 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[..., 0, 1] = jacobian[..., 1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian[..., 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return jacobian


def undistort(distortion: np.ndarray, distorted: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates (N, 2) of distorted ones (N, 2).

    Raises NumericalError when some lie outside what the lens can image.
    """
    distorted = np.asarray(distorted, float)
    if not np.any(distortion):
        return distorted.copy()
    xy = distorted.copy()
    for _ in range(NEWTON_STEPS):
        residual = distort(distortion, xy) - distorted
        jacobian = distortion_jacobian(distortion, xy)
        a, b, d = jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 1, 1]
        determinant = a * d - b * b
        determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)  # a step near the fold is judged below
        step = np.stack([d * residual[..., 0] - b * residual[..., 1], a * residual[..., 1] - b * residual[..., 0]], -1)
        step /= determinant[..., None]
        length = np.hypot(step[..., 0], step[..., 1])[..., None]
        xy -= step * np.minimum(1.0, 0.5 / np.maximum(length, 0.5))
        if length.max(initial=0.0) < 1e-9:  # quadratic: the step just taken left less than 1e-17
            break
    error = np.abs(distort(distortion, xy) - distorted).max(-1)
    outside = ~((error < 1e-10) & ((xy**2).sum(-1) < fold_radius_squared(distortion)))
    if outside.any():
        first = distorted[np.argmax(outside)]
        raise NumericalError(
            f"lens: {int(outside.sum())} of {outside.size} positions (first at {first[0]:.4f}, {first[1]:.4f} / Z) "
            "are beyond the distortion model, needed all inside; calibrate with the board near the corners"
        )
    return xy


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
    """Pixels (N, 2), their derivatives by the point (N, 2, 3) and by (fx fy cx cy k1 k2 p1 p2 k3) (N, 2, 9)."""
    points = np.asarray(points_camera, float)
    xy = normalised(points, camera.distortion)
    bent = distort(camera.distortion, xy)
    focal = np.array([camera.fx, camera.fy])
    x, y, z = xy[:, 0], xy[:, 1], points[:, 2]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
    by_point[:, :, 2] = -xy / z[:, None]
    by_point = focal[:, None] * (distortion_jacobian(camera.distortion, xy) @ by_point)
    s = x * x + y * y
    by_lens = np.zeros((len(points), 2, 9))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = bent[:, 0], bent[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    for column, power in ((4, 1), (5, 2), (8, 3)):
        by_lens[:, :, column] = focal * xy * (s**power)[:, None]
    by_lens[:, :, 6] = focal * np.stack([2 * x * y, s + 2 * y * y], -1)
    by_lens[:, :, 7] = focal * np.stack([s + 2 * x * x, 2 * x * y], -1)
    return bent * focal + (camera.cx, camera.cy), by_point, by_lens


def unproject(camera: Camera, px: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates (N, 2) of pixels (N, 2): the ray is (x, y, 1) in the camera frame."""
    distorted = (np.asarray(px, float) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return undistort(camera.distortion, distorted)


def pixel_rays(camera: Camera, px: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3), camera frame, of pixels (N, 2), through the full inverse of the lens."""
    xy = unproject(camera, px)
    directions = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


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


def ray_grid(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """`rays_through` every pixel centre: (H, W, 2) and (H, W, 2, 2)."""
    y, x = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    xn, dxn = rays_through(camera, np.stack([x.ravel(), y.ravel()], -1))
    return xn.reshape(*x.shape, 2), dxn.reshape(*x.shape, 2, 2)
