"""Spectra, camera sensitivities and the 3x3 matrix of a real camera, for the spectral twin.

All functions of wavelength are tables at ``WAVELENGTHS`` (nm), linear between; all integrals are sums over them.
Illuminants are scaled to luminance 1 (CIE 1931), sensitivities to 1 on D65, so that a white surface under D65 is
(1, 1, 1) in every space. Data: colour-science (CIE illuminants, ISO 17321-1 patches, NPL's camera measurements).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pipeline.simulation.sensor import ACES_WHITE_XY, AP1_XY, bradford, xyz_from_rgb

WAVELENGTHS = np.arange(380.0, 780.5, 0.5)  # nm; what NPL measured
STEP_NM = 0.5
CAMERAS = ("Nikon 5100 (NPL)", "Sigma SDMerill (NPL)")
LAMPS = ("D65", "A", "LED-B1", "FL11")  # daylight; tungsten; white LED 2733 K; three-band fluorescent 4000 K
WINDOWS = ("D50", "D55", "D65", "D75", "A")
PATCHES = "ISO 17321-1"


def integrate(values: np.ndarray) -> np.ndarray:
    """Trapezoidal integral over the last axis [per nm]."""
    return (values.sum(-1) - 0.5 * (values[..., 0] + values[..., -1])) * STEP_NM


def _table(distribution: Any) -> np.ndarray:
    """(..., N) of a colour-science distribution, linear between its samples, zero outside them."""
    values = np.asarray(distribution.values, float)
    columns = values[:, None] if values.ndim == 1 else values
    found = [np.interp(WAVELENGTHS, distribution.wavelengths, c, left=0.0, right=0.0) for c in columns.T]
    return found[0] if values.ndim == 1 else np.stack(found)


@cache
def observer() -> np.ndarray:
    """(3, N) CIE 1931 2 degree colour-matching functions."""
    import colour

    return _table(colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"])


@cache
def illuminant(name: str) -> np.ndarray:
    """(N,) relative power of a CIE illuminant, luminance 1."""
    import colour

    power = _table(colour.SDS_ILLUMINANTS[name])
    return power / integrate(power * observer()[1])


@cache
def patches() -> dict[str, np.ndarray]:
    """Measured reflectances (N,) of the 24 patches, in their order."""
    import colour

    return {name: _table(patch) for name, patch in colour.SDS_COLOURCHECKERS[PATCHES].items()}


@cache
def sensitivities(camera: str) -> np.ndarray:
    """(3, N) of a camera, white-balanced: 1 on D65."""
    import colour

    curves = _table(colour.MSDS_CAMERA_SENSITIVITIES[camera])
    return curves / integrate(curves * illuminant("D65"))[:, None]


@cache
def acescg_from_xyz() -> np.ndarray:
    """(3, 3), Bradford adapted so that D65, as integrated here, is (1, 1, 1)."""
    x, y, z = integrate(observer() * illuminant("D65"))
    adapted = bradford((x / (x + y + z), y / (x + y + z)), ACES_WHITE_XY)
    return np.linalg.inv(xyz_from_rgb(AP1_XY, ACES_WHITE_XY)) @ adapted


def lab(acescg: np.ndarray) -> np.ndarray:
    """CIELAB (..., 3) of ACEScg (..., 3) with white (1, 1, 1)."""
    ratio = np.asarray(acescg, float) @ (xyz_from_rgb(AP1_XY, ACES_WHITE_XY)).T
    ratio = ratio / xyz_from_rgb(AP1_XY, ACES_WHITE_XY).sum(1)
    linear = ratio * (24389 / 27 / 116) + 16 / 116
    f = np.where(ratio > 216 / 24389, np.cbrt(np.maximum(ratio, 0)), linear)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


def delta_e(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """CIE DE2000 (...) between ACEScg colours (..., 3) with white (1, 1, 1)."""
    from colour.difference import delta_E_CIE2000

    return np.asarray(delta_E_CIE2000(lab(first), lab(second)))


@dataclass(frozen=True)
class Camera:
    """A camera as the pipeline knows it: curves that it does not know, and the matrix that it does.

    ``acescg_from_camera`` keeps white and is fitted to the 24 patches under D65, as ColorMatrix1 of a DNG is.
    """

    name: str
    curves: np.ndarray  # (3, N)
    acescg_from_camera: np.ndarray  # (3, 3)

    def develop(self, spectra: np.ndarray) -> np.ndarray:
        """ACEScg (..., 3) of radiance spectra (..., N), by the camera and its matrix."""
        return integrate(np.asarray(spectra)[..., None, :] * self.curves) @ self.acescg_from_camera.T

    def reflectance(self, spectra: np.ndarray) -> np.ndarray:
        """ACEScg reflectance (..., 3) as it is photographed under D65."""
        return self.develop(np.asarray(spectra) * illuminant("D65"))


def colorimetric(spectra: np.ndarray) -> np.ndarray:
    """ACEScg (..., 3) of radiance spectra (..., N), by the CIE observer."""
    return integrate(np.asarray(spectra)[..., None, :] * observer()) @ acescg_from_xyz().T


@cache
def camera_of(name: str) -> Camera:
    """The camera with its matrix: least squares in CIELAB over the patches, each row summing to 1."""
    from scipy.optimize import least_squares

    curves = sensitivities(name)
    lit = np.stack(list(patches().values())) * illuminant("D65")
    seen, wanted = integrate(lit[:, None] * curves), lab(colorimetric(lit))

    def matrix(free: np.ndarray) -> np.ndarray:
        rows = free.reshape(3, 2)
        return np.insert(rows, 1, 1 - rows.sum(1), axis=1)  # the rest is the green column

    found = least_squares(lambda free: (lab(seen @ matrix(free).T) - wanted).ravel(), [1.0, 0, 0, 0, 0, 1.0])
    return Camera(name, curves, matrix(found.x))


def matrix_cost(camera: Camera) -> dict[str, dict[str, float]]:
    """DE2000 over the patches of camera and matrix against the observer, under each lamp."""
    spectra = np.stack(list(patches().values()))
    found = {}
    for lamp in LAMPS:
        error = delta_e(camera.develop(spectra * illuminant(lamp)), colorimetric(spectra * illuminant(lamp)))
        found[lamp] = spread(error)
    return found


def bounce_cost(camera: Camera, bounces: int) -> dict[str, dict[str, float]]:
    """DE2000 over the patches of light * reflectance^n in RGB against the same in spectra, under each lamp.

    Both are brought to luminance 0.2, so that dark colours count as bright ones.
    """
    spectra = np.stack(list(patches().values()))
    albedo = camera.reflectance(spectra)
    found = {}
    for lamp in LAMPS:
        power = illuminant(lamp)
        truth = camera.develop(power * spectra**bounces)
        rgb = camera.develop(power) * albedo**bounces
        gain = 0.2 / (truth @ xyz_from_rgb(AP1_XY, ACES_WHITE_XY)[1])
        found[lamp] = spread(delta_e(truth * gain[:, None], rgb * gain[:, None]))
    return found


def spread(values: np.ndarray) -> dict[str, float]:
    """Median and 95 % quantile."""
    return {"median": float(np.median(values)), "p95": float(np.quantile(values, 0.95))}


def nearest_patch(acescg: np.ndarray) -> str:
    """The patch whose colour under D65 is nearest by DE2000."""
    known = colorimetric(np.stack(list(patches().values())) * illuminant("D65"))
    return list(patches())[int(np.argmin(delta_e(known, np.broadcast_to(acescg, known.shape))))]


def nearest_illuminant(acescg: np.ndarray) -> str:
    """The one of WINDOWS whose colour is nearest by DE2000 at equal luminance."""
    known = colorimetric(np.stack([illuminant(name) for name in WINDOWS]))
    wanted = acescg / (xyz_from_rgb(AP1_XY, ACES_WHITE_XY)[1] @ acescg)
    return WINDOWS[int(np.argmin(delta_e(known, np.broadcast_to(wanted, known.shape))))]
