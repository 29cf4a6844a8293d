"""The simulated lens: pinhole with Brown distortion, written apart from the one that is estimated.

Only operators are used, so the same functions serve numpy arrays and DrJit arrays inside a kernel. Pixel origin: the
first pixel centre is (0.5, 0.5). Brown (1971), coefficients in OpenCV's order k1 k2 p1 p2 k3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Lens:
    """Intrinsics of the simulated camera, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]

    def distort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Distorted from ideal coordinates, both at z = 1."""
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * (x * y) + p2 * (r2 + 2 * (x * x))
        dy = p1 * (r2 + 2 * (y * y)) + 2 * p2 * (x * y)
        return x * radial + dx, y * radial + dy

    def undistort(self, xd: Any, yd: Any, steps: int = 5) -> tuple[Any, Any]:
        """Ideal from distorted coordinates by Newton's method on ``distort``; quadratic, five steps reach 1e-12."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xd, yd
        for _ in range(steps):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3)))
            fx, fy = self.distort(x, y)
            fx, fy = fx - xd, fy - yd
            xx = radial + slope * (x * x) + 2 * p1 * y + 6 * p2 * x
            yy = radial + slope * (y * y) + 6 * p1 * y + 2 * p2 * x
            xy = slope * (x * y) + 2 * p1 * x + 2 * p2 * y
            determinant = xx * yy - xy * xy
            x, y = x - (yy * fx - xy * fy) / determinant, y - (xx * fy - xy * fx) / determinant
        return x, y

    def ideal_from_pixel(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Coordinates at z = 1 of the ray through a pixel position."""
        return self.undistort((u - self.cx) / self.fx, (v - self.cy) / self.fy)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) of the camera frame, z > 0."""
        x, y = self.distort(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)


def look_at(position: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """world_from_camera (4, 4), OpenCV axes, level horizon turned by ``roll`` [rad] about the view axis."""
    forward = np.asarray(target, float) - np.asarray(position, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    pose = np.eye(4)
    cosine, sine = np.cos(roll), np.sin(roll)
    pose[:3, 0], pose[:3, 1] = cosine * right + sine * down, cosine * down - sine * right
    pose[:3, 2], pose[:3, 3] = forward, position
    return pose


def aim(pose: np.ndarray, ideal: tuple[float, float]) -> np.ndarray:
    """Turn a camera about its own centre so that what was on its axis is seen at ``ideal`` (x, y at z = 1)."""
    seen = np.array([ideal[0], ideal[1], 1.0])
    seen /= np.linalg.norm(seen)
    axis = np.cross(seen, [0.0, 0.0, 1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ (np.eye(3) + skew + skew @ skew / (1 + seen[2]))
    return turned


def blur(picture: np.ndarray, sigma: float) -> np.ndarray:
    """Convolve (H, W) or (H, W, C) with the lens' Gaussian, ``sigma`` [px] including the pixel's own box.

    The picture is already averaged over the pixel (variance 1/12), so the kernel of three taps per axis adds the rest:
    taps (w, 1 - 2 w, w) have the variance 2 w. Edges repeat. Raises ValueError outside 0.29 to 0.76 px.
    """
    side = (sigma**2 - 1 / 12) / 2
    if not 0 <= side <= 0.25:
        raise ValueError(f"blur: sigma is {sigma} px; expected 0.29 to 0.76 px")
    for axis in (0, 1):
        pad = [(1, 1) if i == axis else (0, 0) for i in range(picture.ndim)]
        wide = np.moveaxis(np.pad(picture, pad, mode="edge"), axis, 0)
        picture = np.moveaxis(side * (wide[:-2] + wide[2:]) + (1 - 2 * side) * wide[1:-1], 0, axis)
    return picture
