"""Colour as 3x3 matrices: primaries, chromatic adaptation, DNG camera colour, the sRGB curve.

Everything is derived from published chromaticities, so nothing is imported but numpy (colour-science takes 1.5 s to
import; the tests hold these numbers against it). RGB is linear and scene-referred unless a name says ``srgb``.

Sources: SMPTE RP 177 (primaries to matrix), Lam 1985 (Bradford), Adobe DNG 1.7.1 chapter 6 (camera colour), McCamy 1992
(correlated colour temperature), IEC 61966-2-1 (sRGB curve), S-2014-004 (ACEScg).
Limits: DNG's third calibration (ColorMatrix3) is not read: the first two are interpolated, as before DNG 1.6.
"""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np

from pipeline.run.errors import CaptureError

Space = Literal["acescg", "linear_rec709", "linear_p3", "linear_rec2020", "linear_adobe_rgb", "linear_prophoto", "xyz"]

# Chromaticities x, y of red, green, blue and white.
ACESCG_CHROMATICITIES = np.array([[0.713, 0.293], [0.165, 0.830], [0.128, 0.044], [0.32168, 0.33767]])
REC709_CHROMATICITIES = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], [0.3127, 0.3290]])
D50_XY = np.array([0.34567, 0.35850])
D65_XY = REC709_CHROMATICITIES[3]
# Linear spaces that photographs come in, by name: the primaries and white of Display P3, Rec.2020, Adobe RGB (1998) and
# ROMM RGB (ISO 22028-2).
PRIMARIES = {
    "linear_rec709": REC709_CHROMATICITIES,
    "linear_p3": np.array([[0.680, 0.320], [0.265, 0.690], [0.150, 0.060], D65_XY]),
    "linear_rec2020": np.array([[0.708, 0.292], [0.170, 0.797], [0.131, 0.046], D65_XY]),
    "linear_adobe_rgb": np.array([[0.64, 0.33], [0.21, 0.71], [0.15, 0.06], D65_XY]),
    "linear_prophoto": np.array([[0.734699, 0.265301], [0.159597, 0.840403], [0.036598, 0.000105], [0.3457, 0.3585]]),
}

BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

# Correlated colour temperature [K] of the EXIF LightSource codes (DNG 1.7.1, CalibrationIlluminant).
ILLUMINANT_K = {
    1: 5500, 2: 4230, 3: 2850, 4: 5500, 9: 5500, 10: 6500, 11: 7500, 12: 6430, 13: 5000, 14: 4150, 15: 3450, 16: 2940,
    17: 2856, 18: 4874, 19: 6774, 20: 5503, 21: 6504, 22: 7504, 23: 5003, 24: 3200,
}  # fmt: skip


def xyz_of_xy(xy: np.ndarray) -> np.ndarray:
    """XYZ (3,) with Y = 1 of a chromaticity (2,)."""
    x, y = xy
    return np.array([x / y, 1.0, (1 - x - y) / y])


def xyz_from_rgb(chromaticities: np.ndarray) -> np.ndarray:
    """(3, 3) matrix of a space given by the x, y of R, G, B, white (4, 2); its white (1, 1, 1) has Y = 1."""
    primaries = np.stack([xyz_of_xy(xy) for xy in chromaticities[:3]], -1)
    return primaries * np.linalg.solve(primaries, xyz_of_xy(chromaticities[3]))


def adaptation(source_white: np.ndarray, target_white: np.ndarray) -> np.ndarray:
    """(3, 3) Bradford matrix that takes XYZ under one white (XYZ, any scale) to another of equal Y."""
    source, target = (BRADFORD @ (np.asarray(white, float) / white[1]) for white in (source_white, target_white))
    return np.linalg.solve(BRADFORD, (target / source)[:, None] * BRADFORD)


@cache
def _from_xyz(space: Space) -> np.ndarray:
    """(3, 3) of a space from XYZ under the ACES white (about D60), adapted where its own white is another."""
    aces_white = xyz_of_xy(ACESCG_CHROMATICITIES[3])
    if space == "xyz":
        return np.eye(3)
    if space == "acescg":
        return np.linalg.inv(xyz_from_rgb(ACESCG_CHROMATICITIES))
    if space in PRIMARIES:
        to_white = adaptation(aces_white, xyz_of_xy(PRIMARIES[space][3]))
        return np.linalg.solve(xyz_from_rgb(PRIMARIES[space]), to_white)
    raise ValueError(f"unknown colour space {space!r}; expected acescg, xyz, {', '.join(PRIMARIES)}")


@cache
def matrix(from_space: Space, to_space: Space) -> np.ndarray:
    """(3, 3) matrix between linear spaces, white kept white (Bradford). ``xyz`` is CIE 1931 under the ACES white."""
    result = _from_xyz(to_space) @ np.linalg.inv(_from_xyz(from_space))
    result.flags.writeable = False
    return result


def convert(rgb: np.ndarray, from_space: Space, to_space: Space) -> np.ndarray:
    """Convert (..., 3) linear colours; float32 stays float32. Out-of-gamut colours come out negative and are kept."""
    if from_space == to_space:
        return np.asarray(rgb)
    return apply_matrix(matrix(from_space, to_space), rgb)


def acescg_from_primaries(chromaticities: np.ndarray) -> np.ndarray:
    """(3, 3) to ACEScg of a linear space given by the x, y of R, G, B, white (4, 2); white stays white (Bradford)."""
    to_aces = adaptation(xyz_of_xy(chromaticities[3]), xyz_of_xy(ACESCG_CHROMATICITIES[3]))
    return _from_xyz("acescg") @ to_aces @ xyz_from_rgb(chromaticities)


def apply_matrix(target_from_source: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """(..., 3) colours through a (3, 3) matrix; float32 stays float32."""
    rgb = np.asarray(rgb)
    dtype = rgb.dtype if rgb.dtype.kind == "f" else np.float64
    return rgb.astype(dtype, copy=False) @ target_from_source.T.astype(dtype)


def luminance(rgb: np.ndarray, space: Space = "acescg") -> np.ndarray:
    """Relative luminance Y (...) of (..., 3) linear colours."""
    return np.asarray(rgb) @ matrix(space, "xyz")[1].astype(np.asarray(rgb).dtype)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB curve (IEC 61966-2-1) on linear values; odd about zero, unbounded above. Space stays Rec.709."""
    magnitude = np.abs(linear)
    curve = np.where(
        magnitude <= 0.0031308, 12.92 * magnitude, 1.055 * np.maximum(magnitude, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.copysign(curve, linear)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """Inverse of `encode_srgb`; values in [0, 1] are 8-bit code values / 255."""
    magnitude = np.abs(encoded)
    curve = np.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)
    return np.copysign(curve, encoded)


def temperature_of_xy(xy: np.ndarray) -> float:
    """Correlated colour temperature [K] (McCamy 1992): within 2 K of the Planckian locus from 2856 to 6504 K."""
    n = (xy[0] - 0.3320) / (xy[1] - 0.1858)
    return float(-449.0 * n**3 + 3525.0 * n**2 - 6823.3 * n + 5520.33)


def calibration_weight(kelvin: tuple[float, float], temperature: float) -> float:
    """Share of the first of two calibrations: linear in 1/K between their illuminants, held outside (DNG chapter 6)."""
    low, high = sorted(kelvin)
    inverse = 1 / min(max(temperature, low), high)
    return float((inverse - 1 / kelvin[1]) / (1 / kelvin[0] - 1 / kelvin[1]))


def interpolated_matrix(
    color_matrix: np.ndarray, color_matrix_2: np.ndarray, kelvin: tuple[float, float], temperature: float
) -> np.ndarray:
    """ColorMatrix (3, 3) between two calibration illuminants."""
    weight = calibration_weight(kelvin, temperature)
    return weight * color_matrix + (1 - weight) * color_matrix_2


def kelvin_of(illuminant: int, illuminant_2: int) -> tuple[float, float] | None:
    """Temperatures of two calibration illuminants, EXIF codes; None where they cannot be interpolated between."""
    kelvin = ILLUMINANT_K.get(illuminant, 0), ILLUMINANT_K.get(illuminant_2, 0)
    return None if 0 in kelvin or kelvin[0] == kelvin[1] else kelvin


def camera_white(
    color_matrix: np.ndarray,
    neutral: np.ndarray,
    color_matrix_2: np.ndarray | None = None,
    illuminant: int = 0,
    illuminant_2: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """The ColorMatrix (3, 3) in force and the XYZ (3,) of the scene's white, for a camera neutral (3,).

    With two calibrations the white and the matrix depend on each other; iterated from D50 as DNG chapter 6 says.
    """
    kelvin = kelvin_of(illuminant, illuminant_2)
    if color_matrix_2 is None or kelvin is None:
        return color_matrix, np.linalg.solve(color_matrix, neutral)
    xy = D50_XY
    for _ in range(30):
        current = interpolated_matrix(color_matrix, color_matrix_2, kelvin, temperature_of_xy(xy))
        white = np.linalg.solve(current, neutral)
        previous, xy = xy, white[:2] / white.sum()
        if np.abs(xy - previous).max() < 1e-9:
            break
    return current, white


def neutral_of_white(
    white: np.ndarray,
    color_matrix: np.ndarray,
    color_matrix_2: np.ndarray | None = None,
    illuminant: int = 0,
    illuminant_2: int = 0,
) -> np.ndarray:
    """How a camera sees a white given as XYZ (3,): its neutral (3,), green 1. The inverse of `camera_white`."""
    kelvin = kelvin_of(illuminant, illuminant_2)
    current = color_matrix
    if color_matrix_2 is not None and kelvin is not None:
        temperature = temperature_of_xy(white[:2] / white.sum())
        current = interpolated_matrix(color_matrix, color_matrix_2, kelvin, temperature)
    neutral = current @ white
    return np.asarray(neutral / neutral[1])


def acescg_from_camera(
    color_matrix: np.ndarray | None,
    as_shot_neutral: np.ndarray | None,
    color_matrix_2: np.ndarray | None = None,
    illuminant: int = 0,
    illuminant_2: int = 0,
    where: str = "camera colour",
    forward_matrix: np.ndarray | None = None,
    forward_matrix_2: np.ndarray | None = None,
) -> np.ndarray:
    """(3, 3) matrix from camera_rgb (black subtracted, *not* white balanced) to ACEScg, by the DNG colour matrices.

    A camera neutral scaled to green = 1 becomes (1, 1, 1): the scene's white is ACEScg white (Bradford). Without
    ``as_shot_neutral`` the scene's white is taken as D65. With ForwardMatrix tags the ColorMatrix gives only the
    scene's white, and they the colours (XYZ D50 of white balanced camera_rgb, adapted to ACEScg white).
    Raises CaptureError without a usable ColorMatrix.
    """
    if color_matrix is None or abs(np.linalg.det(color_matrix)) < 1e-6:
        raise CaptureError(
            f"{where}: no usable ColorMatrix1 in the RAW, needed for ACEScg; state it, "
            '[sensor] color_matrix, or photograph a chart, [chart] fit = "matrix"'
        )
    neutral = as_shot_neutral
    if neutral is None:
        neutral = color_matrix @ xyz_of_xy(REC709_CHROMATICITIES[3])
    neutral = np.asarray(neutral, float)
    if neutral.shape != (3,) or not np.all(neutral > 0):
        raise CaptureError(f"{where}: AsShotNeutral is {neutral.tolist()}, needed three positive numbers; fix the file")
    neutral = neutral / neutral[1]
    current, white = camera_white(color_matrix, neutral, color_matrix_2, illuminant, illuminant_2)
    if not np.all(white > 0):
        raise CaptureError(
            f"{where}: ColorMatrix1 maps the neutral to XYZ {white.round(4).tolist()}; no colour, fix it"
        )
    aces_white = xyz_of_xy(ACESCG_CHROMATICITIES[3])
    if forward_matrix is None:
        return _from_xyz("acescg") @ adaptation(white, aces_white) / white[1] @ np.linalg.inv(current)
    forward = forward_matrix
    kelvin = kelvin_of(illuminant, illuminant_2)
    if forward_matrix_2 is not None and kelvin is not None:
        temperature = temperature_of_xy(white[:2] / white.sum())
        forward = interpolated_matrix(forward_matrix, forward_matrix_2, kelvin, temperature)
    d50 = xyz_of_xy(D50_XY)
    sums = forward.sum(1)
    if not np.allclose(sums, d50, atol=0.03):  # DNG: the neutral is D50 but for rounding
        raise CaptureError(f"{where}: ForwardMatrix1 maps the neutral to XYZ {sums.round(4).tolist()}, not D50; fix it")
    return _from_xyz("acescg") @ adaptation(d50, aces_white) @ ((d50 / sums)[:, None] * forward / neutral)
