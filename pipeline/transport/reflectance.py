"""Albedo of the local scene from the plate: equations 6 to 8 of differential rendering, and their texture.

    (6)  L_r1 = rho_d  integral of L_i cos(theta) dw           what the plate shows
    (7)  L_r2 = the same integral with rho_d = 1, the irradiance E on a surface without inter-reflection
    (8)  rho_d' = L_r1 / L_r2,  albedo = pi rho_d'

On one convex plane under distant light nothing on the right depends on rho_d, so one step is exact.
"""

from __future__ import annotations

import numpy as np


def reflected_radiance(albedo: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Equation 6: radiance of a diffuse surface, rho_d = albedo / pi, under an irradiance (both (..., 3))."""
    return np.asarray(albedo * irradiance / np.pi)


def updated_brdf(l_r1: np.ndarray, l_r2: np.ndarray) -> np.ndarray:
    """Equation 8: the BRDF value that explains ``l_r1``, given ``l_r2`` (equation 7, the same with rho_d = 1).

    NaN where no light arrives (``l_r2 <= 0``): the albedo is unknown there, not zero.
    """
    l_r1, l_r2 = np.broadcast_arrays(np.asarray(l_r1, float), np.asarray(l_r2, float))
    return np.divide(l_r1, l_r2, out=np.full(l_r1.shape, np.nan), where=l_r2 > 0)


def fill_unseen(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Continue a texture (H, W, C) smoothly into texels of weight 0 (H, W): averages of ever larger cells.

    Texels of weight 1 keep their value. A texture that is nowhere seen comes back as zeros.
    """
    height, width = weight.shape
    if min(height, width) == 1 or weight.min() >= 1:
        total = weight.sum()
        mean = (values * weight[..., None]).sum((0, 1)) / total if total > 0 else np.zeros(values.shape[-1])
        return np.where(weight[..., None] > 0, values, mean)
    even = (height + height % 2, width + width % 2)
    pad = ((0, even[0] - height), (0, even[1] - width))
    w = np.pad(weight, pad)
    v = np.pad(values * weight[..., None], (*pad, (0, 0)))
    w4 = w.reshape(even[0] // 2, 2, even[1] // 2, 2).sum((1, 3))
    v4 = v.reshape(even[0] // 2, 2, even[1] // 2, 2, -1).sum((1, 3))
    coarse = fill_unseen(v4 / np.maximum(w4, 1e-12)[..., None], np.minimum(w4, 1.0))
    rows, columns = np.arange(height), np.arange(width)
    up = linear(linear(coarse, (rows - 0.5) / 2, 0), (columns - 0.5) / 2, 1)
    return values * weight[..., None] + up * (1 - weight[..., None])


def linear(values: np.ndarray, position: np.ndarray, axis: int) -> np.ndarray:
    """Values at fractional indices ``position`` (K,) along an axis, linear between samples, the border repeated."""
    size = values.shape[axis]
    position = np.clip(position, 0, size - 1)
    low = np.minimum(position.astype(int), max(size - 2, 0))
    share = (position - low).reshape([-1 if i == axis else 1 for i in range(values.ndim)])
    return np.take(values, low, axis) * (1 - share) + np.take(values, np.minimum(low + 1, size - 1), axis) * share
