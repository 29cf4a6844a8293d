"""A map that knows nothing but its nine harmonics: the smoothest positive radiance that has them.

Cutting the series off after order 2 rings below zero beside every lamp, and clipping that changes the irradiance. Of
all positive maps with the given nine moments the one of most entropy is ``exp(sum a_k Y_k)`` (Jaynes 1957); its
coefficients are the minimum of the convex dual ``integral exp(a . Y) - a . c``, found by Newton's method.
"""

from __future__ import annotations

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.harmonics import sh9_basis, sh9_of_environment

ROWS = 48  # of the grid on which the integrals are taken: exact to 1e-4 for what nine harmonics can make
STEPS, TOLERANCE = 60, 1e-8
RIDGE = 1e-5  # of the energy, on the exponents: moments at the edge of what positive light can have, a lone sun's


def smooth_environment(rgb: np.ndarray) -> np.ndarray:
    """Positive map (H, W, C) of most entropy whose nine harmonics are those of ``rgb`` (H, W, C); zero stays zero."""
    height, width = rgb.shape[:2]
    moments = sh9_of_environment(np.asarray(rgb, float))
    basis = sh9_basis(latlong_directions(height, width))
    found = np.zeros((height, width, moments.shape[1]))
    for channel, wanted in enumerate(moments.T):
        if wanted[0] > 0:
            found[..., channel] = wanted[0] * np.exp(basis @ _exponents(wanted / wanted[0]))
    return found


def reduced(rgb: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`smooth_environment`, and its variance: what was left out, which may be anywhere, on every texel alike."""
    found = smooth_environment(rgb)
    weight = latlong_solid_angles(*rgb.shape[:2])[..., None] / (4 * np.pi)
    return found, variance + ((rgb - found) ** 2 * weight).sum((0, 1))


def _exponents(wanted: np.ndarray) -> np.ndarray:
    """Exponents (9,) of the map of most entropy with moments (9,), whose first is 1."""
    basis = sh9_basis(latlong_directions(ROWS, 2 * ROWS)).reshape(-1, 9)
    weight = latlong_solid_angles(ROWS, 2 * ROWS).ravel()
    exponents = np.zeros(9)
    exponents[0] = np.log(1 / (4 * np.pi * basis[0, 0])) / basis[0, 0]
    ridge = RIDGE * (np.arange(9) > 0)

    def dual(a: np.ndarray) -> float:
        with np.errstate(over="ignore"):
            return float(weight @ np.exp(basis @ a) - a @ wanted + 0.5 * ridge @ a**2)

    for _ in range(STEPS):
        flux = weight * np.exp(basis @ exponents)
        slope = basis.T @ flux - wanted + ridge * exponents
        step = np.linalg.solve(basis.T @ (flux[:, None] * basis) + np.diag(ridge), slope)
        size, value, gain = 1.0, dual(exponents), float(slope @ step)
        while size > 1e-6 and not dual(exponents - size * step) <= value - 1e-4 * size * gain:
            size *= 0.5
        exponents = exponents - size * step
        if gain < TOLERANCE:
            break
    return exponents
