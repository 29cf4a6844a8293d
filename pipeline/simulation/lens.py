"""The simulated lens: a pinhole that bends its rays, written apart from the one that is estimated.

Brown (1971): k1 k2 p1 p2 k3; with k4 k5 k6 behind them the rational model; four numbers are the fisheye of Kannala and
Brandt (2006). Orders as OpenCV's. The same functions serve numpy arrays and DrJit arrays inside a kernel. Pixel origin:
the first pixel centre is (0.5, 0.5).
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
    distortion: tuple[float, ...]  # 5, 8 or 4 numbers

    def distort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Distorted from ideal coordinates, both at z = 1."""
        r2 = x * x + y * y
        if len(self.distortion) == 4:
            ideal = (r2 + 1e-30) ** 0.5
            scale = self._bent(_of("arctan", ideal)) / ideal
            return x * scale, y * scale
        _, _, p1, p2, _ = self.distortion[:5]
        above, below, _, _ = self._parts(r2)
        radial = above / below
        dx = 2 * p1 * (x * y) + p2 * (r2 + 2 * (x * x))
        dy = p1 * (r2 + 2 * (y * y)) + 2 * p2 * (x * y)
        return x * radial + dx, y * radial + dy

    def _parts(self, r2: Any) -> tuple[Any, Any, Any, Any]:
        """Numerator and denominator of the radial factor, and their derivatives by r2."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, 0.0, 0.0, 0.0)[:8]
        above, below = (1 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
        rises, falls = (a + r2 * (2 * b + r2 * (3 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
        return above, below, rises, falls

    def _bent(self, angle: Any, order: int = 0) -> Any:
        """Radius in the fisheye's picture, in focal lengths, of an angle; ``order`` 1: its derivative."""
        k1, k2, k3, k4 = (k * (2 * i + 3) if order else k for i, k in enumerate(self.distortion))
        a2 = angle * angle
        growth = 1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))
        return growth if order else angle * growth

    def undistort(self, xd: Any, yd: Any, steps: int = 5) -> tuple[Any, Any]:
        """Ideal from distorted coordinates by Newton's method on ``distort``; quadratic, five steps reach 1e-12.

        A rational lens may bend so much that a whole step runs away: its steps are held below a half, and are more.
        """
        if len(self.distortion) == 4:
            return self._undistort_fisheye(xd, yd)
        _, _, p1, p2, _ = self.distortion[:5]
        x, y = xd, yd
        whole = len(self.distortion) == 5
        for _ in range(steps if whole else 4 * steps):
            r2 = x * x + y * y
            above, below, rises, falls = self._parts(r2)
            radial = above / below
            slope = 2 * (rises - radial * falls) / below
            fx, fy = self.distort(x, y)
            fx, fy = fx - xd, fy - yd
            xx = radial + slope * (x * x) + 2 * p1 * y + 6 * p2 * x
            yy = radial + slope * (y * y) + 6 * p1 * y + 2 * p2 * x
            xy = slope * (x * y) + 2 * p1 * x + 2 * p2 * y
            determinant = xx * yy - xy * xy
            dx, dy = (yy * fx - xy * fy) / determinant, (xx * fy - xy * fx) / determinant
            held = 1.0 if whole else 1 / (1 + dx * dx + dy * dy)
            x, y = x - dx * held, y - dy * held
        return x, y

    def _undistort_fisheye(self, xd: Any, yd: Any, steps: int = 8) -> tuple[Any, Any]:
        """The same for a fisheye, by Newton's method on the angle."""
        radius = (xd * xd + yd * yd + 1e-30) ** 0.5
        angle = radius
        for _ in range(steps):
            angle = angle - (self._bent(angle) - radius) / self._bent(angle, 1)
        scale = _of("tan", angle) / radius
        return xd * scale, yd * scale

    def ideal_from_pixel(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Coordinates at z = 1 of the ray through a pixel position."""
        return self.undistort((u - self.cx) / self.fx, (v - self.cy) / self.fy)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) of the camera frame, z > 0."""
        x, y = self.distort(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], -1)


def _of(function: str, values: Any) -> Any:
    """``arctan`` or ``tan`` of numpy's or of DrJit's arrays."""
    if isinstance(values, float | np.ndarray):
        return getattr(np, function)(values)
    import drjit

    return {"arctan": drjit.atan, "tan": drjit.tan}[function](values)


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
