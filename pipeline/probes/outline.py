"""The outline of a sphere under the camera: the cone of half angle ``rho = asin(R / D)`` about the ray to its centre.

Exact off axis and under distortion; and the prior that says how high over the plane its centre is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project
from pipeline.types import Camera


@dataclass(frozen=True)
class Height:
    """Prior: ``normal . centre + offset_m = radius +- sigma_m`` with the plane in the camera frame."""

    normal: np.ndarray
    offset_m: float
    sigma_m: float

    def of(self, centre: np.ndarray) -> float:
        """Height [m] of a point (3,) of the camera frame above the plane."""
        return float(self.normal @ centre + self.offset_m)


def silhouette(
    camera: Camera, centre: np.ndarray, radius: float, azimuth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outline of spheres with ``centre`` (..., 3): pixels (..., N, 2), outward unit normals, and pixels per radian."""
    distance = np.linalg.norm(centre, axis=-1, keepdims=True)
    axis = centre / distance
    first = np.cross(axis, (0.0, 1.0, 0.0))
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(axis, first)
    spokes = np.cos(azimuth)[:, None] * first[..., None, :] + np.sin(azimuth)[:, None] * second[..., None, :]
    rho = np.arcsin(np.minimum(radius / distance, 0.999))[..., None]
    step = 1e-4 * rho
    px, outer = (
        project(camera, np.cos(angle) * axis[..., None, :] + np.sin(angle) * spokes) for angle in (rho, rho + step)
    )
    normal = outer - px
    length = np.sqrt(normal[..., :1] ** 2 + normal[..., 1:] ** 2)  # a norm over an axis of two is slow
    return px, normal / length, (length / step)[..., 0]


def radius_in_pixels(camera: Camera, centre: np.ndarray, radius: float) -> float:
    """Radius of the circle that has the area of the outline."""
    px = silhouette(camera, centre, radius, azimuths(90))[0]
    x, y = (px - px.mean(0)).T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) * (2 * np.pi / 90) / np.sin(2 * np.pi / 90)
    return float(np.sqrt(area / np.pi))


def fraction_in_frame(camera: Camera, centre: np.ndarray, radius: float) -> float:
    """Fraction of the outline that lies in the frame."""
    return float(inside(camera, silhouette(camera, centre, radius, azimuths(180))[0]).mean())


def inside(camera: Camera, px: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether pixels (..., 2) lie in the frame by at least ``margin``; NaN does not."""
    x, y = px[..., 0], px[..., 1]
    return (x >= margin) & (x <= camera.width - margin) & (y >= margin) & (y <= camera.height - margin)


def azimuths(count: int) -> np.ndarray:
    """``count`` angles evenly around, not starting at zero."""
    return 2 * np.pi * (np.arange(count) + 0.5) / count


def part_of(camera: Camera, low: np.ndarray, high: np.ndarray) -> Camera:
    """The camera of the part of its picture from pixel ``low`` (x, y) up to, not including, ``high``."""
    width, height = (int(side) for side in high - low)
    moved = {"cx": camera.cx - int(low[0]), "cy": camera.cy - int(low[1]), "width": width, "height": height}
    return camera.model_copy(update=moved)
