"""ColorMatrix 1 and 2 of a camera whose spectral sensitivities are published, for files that carry no matrix.

Under each of two calibration lights (CIE A and D65) a matrix that keeps white is fitted in CIELAB to many measured
reflectances, the 190 with which ACES input transforms are made; the result is used as the tags of a DNG.

Sources: Academy P-2013-001 (training reflectances), DNG 1.7.1 chapter 6 (what ColorMatrix is); data by colour-science:
CIE illuminants and observer, NPL's measured cameras.
Limits: a copy of a camera model differs from the measured one by about 1 delta E; the published curves lack the lens.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from pipeline.image import colour
from pipeline.image.chart import lab, misfit, white_keeping

LIGHTS = {"A": 17, "D65": 21}  # CIE illuminant: EXIF LightSource code
KNOWN = {"NIKON D5100": "Nikon 5100 (NPL)"}  # model as its files name it: colour-science's name
WAVELENGTHS = (380, 780, 5)  # nm: first, last, step


def is_known(camera: str) -> bool:
    """Whether `known_profile` has a profile of the camera."""
    return any(camera.upper().endswith(model) for model in KNOWN)


def known_profile(camera: str) -> dict[str, Any] | None:
    """color_matrix(_2) and illuminant(_2) of a camera that colour-science has measured; None of any other."""
    name = next((name for model, name in KNOWN.items() if camera.upper().endswith(model)), None)
    return None if name is None else profile_of(name)


@cache
def profile_of(name: str) -> dict[str, Any]:
    """The same by colour-science's name of the camera."""
    import colour as science

    return calibrated(_aligned(science.MSDS_CAMERA_SENSITIVITIES[name]))


def calibrated(curves: np.ndarray, reflectances: np.ndarray | None = None) -> dict[str, Any]:
    """ColorMatrix 1 and 2 (3, 3) of sensitivities (N, 3) at WAVELENGTHS, fitted to reflectances (M, N)."""
    import colour as science

    if reflectances is None:
        reflectances = _aligned(science.characterisation.read_training_data_rawtoaces_v1()).T
    one, two = (color_matrix(curves, _aligned(science.SDS_ILLUMINANTS[name])[:, 0], reflectances) for name in LIGHTS)
    first, second = LIGHTS.values()
    return {"color_matrix": one, "color_matrix_2": two, "illuminant": first, "illuminant_2": second}


def color_matrix(curves: np.ndarray, light: np.ndarray, reflectances: np.ndarray) -> np.ndarray:
    """(3, 3) camera_rgb from XYZ under a light (N,), best over the reflectances (M, N) in CIELAB; white is exact."""
    import colour as science
    from scipy.optimize import least_squares

    observer = _aligned(science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"])
    white, neutral = light @ observer, light @ curves
    to_aces = colour.matrix("xyz", "acescg") @ colour.adaptation(
        white, colour.xyz_of_xy(colour.ACESCG_CHROMATICITIES[3])
    )
    seen = (reflectances * light) @ curves / neutral
    wanted = lab((reflectances * light) @ observer @ to_aces.T / white[1])
    best = least_squares(lambda free: misfit(lab(seen @ white_keeping(free).T), wanted).ravel(), [1.0, 0, 0, 0, 0, 1.0])
    return np.asarray((neutral / neutral[1])[:, None] * np.linalg.solve(white_keeping(best.x), to_aces))


def _aligned(data: Any) -> np.ndarray:
    """(N, K) of a colour-science distribution at WAVELENGTHS, zero outside what was measured."""
    first, last, step = WAVELENGTHS
    values = np.asarray(data.values, float).reshape(len(data.wavelengths), -1)
    at = np.arange(first, last + step, step)
    return np.stack([np.interp(at, data.wavelengths, one, left=0, right=0) for one in values.T], -1)
