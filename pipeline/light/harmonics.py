"""Nine real spherical harmonics of a lat-long map, and irradiance from them.

Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment Maps (2001): a diffuse surface keeps
orders 0 to 2 of the light, weighted by pi, 2 pi / 3 and pi / 4; what is left out is at most about 1 % of the irradiance
for ordinary light, and up to 9 % of the peak for a single point light. Axes are the world's own x, y, z.
"""

from __future__ import annotations

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles

COSINE_LOBE = np.pi * np.array([1, 2 / 3, 2 / 3, 2 / 3, 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 4])


def sh9_basis(directions: np.ndarray) -> np.ndarray:
    """Orthonormal basis (..., 9) at unit directions (..., 3): 1, y, z, x, xy, yz, 3zz-1, xz, xx-yy."""
    x, y, z = np.moveaxis(np.asarray(directions, float), -1, 0)
    linear, mixed = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    first = [np.full_like(x, np.sqrt(1 / (4 * np.pi))), linear * y, linear * z, linear * x]
    second = [mixed * x * y, mixed * y * z, np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1), mixed * x * z]
    return np.stack([*first, *second, mixed / 2 * (x * x - y * y)], -1)


def sh9_of_environment(rgb: np.ndarray) -> np.ndarray:
    """Coefficients (9, C) of the radiance of a lat-long map (H, W, C)."""
    height, width = rgb.shape[:2]
    weighted = sh9_basis(latlong_directions(height, width)) * latlong_solid_angles(height, width)[..., None]
    return weighted.reshape(-1, 9).T @ np.asarray(rgb, float).reshape(height * width, -1)


def sh9_sigma(variance: np.ndarray) -> np.ndarray:
    """Standard uncertainty (9, C) of `sh9_of_environment` from the map's variance (H, W, C), texels independent."""
    height, width = variance.shape[:2]
    weighted = sh9_basis(latlong_directions(height, width)) * latlong_solid_angles(height, width)[..., None]
    return np.sqrt((weighted**2).reshape(-1, 9).T @ np.asarray(variance, float).reshape(height * width, -1))


def sh9_irradiance(coefficients: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance (N, C) at unit normals (N, 3) from coefficients (9, C)."""
    return (sh9_basis(normals) * COSINE_LOBE) @ coefficients
