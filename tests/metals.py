"""Complex refractive indices of metals in the visible, and what they reflect in ACEScg, by spectral integration.

Measured tables as in refractiveindex.info (public domain): wavelength [um], n, k. Johnson and Christy, Phys. Rev. B 6
(1972) for gold, silver and copper and 9 (1974) for iron and chromium; Rakic, Appl. Opt. 34 (1995) for aluminium;
Querry, CRDC-CR-85034 (1985) for brass of 70 % copper.
"""

import numpy as np

from pipeline.image.colour import ACESCG_CHROMATICITIES, adaptation, matrix, xyz_of_xy

UM = {
    "noble": [0.3679, 0.3815, 0.3974, 0.4133, 0.4305, 0.4509, 0.4714, 0.4959, 0.5209, 0.5486, 0.5821, 0.6168, 0.6595,
              0.7045, 0.7560, 0.8211],
    "transition": [0.368, 0.381, 0.397, 0.413, 0.431, 0.451, 0.471, 0.496, 0.521, 0.549, 0.582, 0.617, 0.659, 0.704,
                   0.756, 0.821],
}  # fmt: skip
TABLES = {
    "gold": (
        UM["noble"],
        [1.48, 1.46, 1.47, 1.46, 1.45, 1.38, 1.31, 1.04, 0.62, 0.43, 0.29, 0.21, 0.14, 0.13, 0.14, 0.16],
        [1.895, 1.933, 1.952, 1.958, 1.948, 1.914, 1.849, 1.833, 2.081, 2.455, 2.863, 3.272, 3.697, 4.103, 4.542,
         5.083],
    ),
    "silver": (
        UM["noble"],
        [0.07, 0.05, 0.05, 0.05, 0.04, 0.04, 0.05, 0.05, 0.05, 0.06, 0.05, 0.06, 0.05, 0.04, 0.03, 0.04],
        [1.657, 1.864, 2.070, 2.275, 2.462, 2.657, 2.869, 3.093, 3.324, 3.586, 3.858, 4.152, 4.483, 4.838, 5.242,
         5.727],
    ),
    "copper": (
        UM["noble"],
        [1.36, 1.33, 1.32, 1.28, 1.25, 1.24, 1.25, 1.22, 1.18, 1.02, 0.70, 0.30, 0.22, 0.21, 0.24, 0.26],
        [1.975, 2.045, 2.116, 2.207, 2.305, 2.397, 2.483, 2.564, 2.608, 2.577, 2.704, 3.205, 3.747, 4.205, 4.665,
         5.180],
    ),
    "iron": (
        UM["transition"],
        [2.02, 2.12, 2.24, 2.35, 2.48, 2.59, 2.67, 2.74, 2.86, 2.95, 2.94, 2.88, 2.92, 2.86, 2.87, 2.94],
        [2.43, 2.50, 2.58, 2.65, 2.71, 2.77, 2.82, 2.88, 2.91, 2.93, 2.99, 3.05, 3.10, 3.19, 3.28, 3.39],
    ),
    "chromium": (
        UM["transition"],
        [1.87, 1.92, 2.00, 2.08, 2.19, 2.33, 2.51, 2.75, 2.94, 3.18, 3.22, 3.17, 3.09, 3.05, 3.08, 3.20],
        [2.69, 2.74, 2.83, 2.93, 3.04, 3.14, 3.24, 3.30, 3.33, 3.33, 3.30, 3.30, 3.34, 3.39, 3.42, 3.48],
    ),
    "aluminium": (
        [0.36466, 0.41328, 0.44280, 0.47687, 0.51660, 0.56357, 0.61993, 0.65225, 0.68881, 0.72932, 0.77491, 0.79478],
        [0.39877, 0.52135, 0.60790, 0.72780, 0.87340, 1.0728, 1.3660, 1.5724, 1.8301, 2.1606, 2.6154, 2.7675],
        [4.3957, 5.0008, 5.3676, 5.7781, 6.2418, 6.7839, 7.4052, 7.7354, 8.0601, 8.3565, 8.4914, 8.3866],
    ),
    "brass": (
        np.arange(0.38, 0.785, 0.02).tolist(),
        [1.487, 1.445, 1.350, 1.191, 0.994, 0.816, 0.686, 0.602, 0.549, 0.505, 0.468, 0.450, 0.449, 0.444, 0.445,
         0.444, 0.446, 0.450, 0.455, 0.458, 0.464],
        [1.818, 1.805, 1.786, 1.797, 1.883, 2.046, 2.250, 2.464, 2.668, 2.860, 3.059, 3.253, 3.434, 3.609, 3.778,
         3.943, 4.106, 4.266, 4.424, 4.579, 4.737],
    ),
}  # fmt: skip
NM = np.arange(380.0, 781.0)


def index_of(metal: str) -> np.ndarray:
    """(N,) complex n + ik at ``NM``, linear between the table's entries."""
    um, n, k = TABLES[metal]
    return np.interp(NM, np.array(um) * 1000, n) + 1j * np.interp(NM, np.array(um) * 1000, k)


def fresnel(index: np.ndarray, cosine: float) -> np.ndarray:
    """Reflectance of unpolarised light for complex indices."""
    refracted = np.sqrt(1 - (1 - cosine**2) / index**2)
    s = (cosine - index * refracted) / (cosine + index * refracted)
    p = (index * cosine - refracted) / (index * cosine + refracted)
    return (np.abs(s) ** 2 + np.abs(p) ** 2) / 2


def acescg_reflectance(spectrum: np.ndarray) -> np.ndarray:
    """(3,) ACEScg of a reflectance spectrum at ``NM`` under D65, a white surface being (1, 1, 1)."""
    import colour

    shape = colour.SpectralShape(380, 780, 1)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    light = colour.SDS_ILLUMINANTS["D65"].copy().align(shape).values
    xyz = (spectrum * light) @ observer / (light @ observer[:, 1])
    white = light @ observer / (light @ observer[:, 1])
    return matrix("xyz", "acescg") @ adaptation(white, xyz_of_xy(ACESCG_CHROMATICITIES[3])) @ xyz
