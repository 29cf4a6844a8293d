"""The sensor: radiance in, a Bayer mosaic in DN out, with the noise of a real one.

The camera is linear: ``camera_rgb = camera_from_acescg @ acescg``, with
``camera_from_acescg = ColorMatrix1 @ Bradford(D60 -> D65) @ XYZ_from_AP1``, so that the matrices of the DNG are exact.
ColorMatrix1 is scaled so that green of D65 white is 1; then an ACEScg value L (in the capture's radiometric unit) fills
the fraction ``L t ISO / (100 N^2)`` of the green range. Noise: Poisson electrons, Gaussian read noise, multiplicative
photo-response non-uniformity (fixed for the camera), hot photosites that collect electrons in proportion to time.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

# CIE 1931 2 degree white points as xy: ACES white (TB-2018-001) and D65.
ACES_WHITE_XY = (0.32168, 0.33767)
D65_XY = (0.3127, 0.3290)
AP1_XY = ((0.713, 0.293), (0.165, 0.830), (0.128, 0.044))
REC709_XY = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
# Lam 1985; the cone response matrix of the Bradford transform.
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

# Thirds of a stop from 30 s (true 32 s) to 1/8000 s (true 1/8192 s), as cameras name them.
_LONG = "30 25 20 15 13 10 8 6 5 4 3.2 2.5 2 1.6 1.3 1 0.8 0.6 0.5 0.4 0.3"
_SHORT = (
    "4 5 6 8 10 13 15 20 25 30 40 50 60 80 100 125 160 200 250 320 400 500 640 800 1000 1250 1600 2000 2500 3200 4000 "
    "5000 6400 8000"
)
SHUTTER_LABELS = [Fraction(text) for text in _LONG.split()] + [Fraction(1, int(text)) for text in _SHORT.split()]


def shutter(third: int) -> tuple[float, Fraction]:
    """True time in seconds, ``2**(-third / 3)``, and what the camera writes. Raises ValueError off the ladder."""
    if not 0 <= third + 15 < len(SHUTTER_LABELS):
        raise ValueError(f"shutter: 2^({-third}/3) s is off the ladder of 30 s to 1/8000 s")
    return 2.0 ** (-third / 3), SHUTTER_LABELS[third + 15]


def white_xyz(xy: tuple[float, float]) -> np.ndarray:
    """XYZ with Y = 1 of a chromaticity."""
    return np.array([xy[0] / xy[1], 1.0, (1 - xy[0] - xy[1]) / xy[1]])


def xyz_from_rgb(primaries: tuple[tuple[float, float], ...], white: tuple[float, float]) -> np.ndarray:
    """(3, 3) of an RGB space, white (1, 1, 1) at Y = 1 (SMPTE RP 177)."""
    columns = np.stack([white_xyz(xy) for xy in primaries], 1)
    return columns * np.linalg.solve(columns, white_xyz(white))


def bradford(source: tuple[float, float], target: tuple[float, float]) -> np.ndarray:
    """(3, 3) XYZ adaptation from one white to the other."""
    gain = (BRADFORD @ white_xyz(target)) / (BRADFORD @ white_xyz(source))
    return np.linalg.inv(BRADFORD) @ (gain[:, None] * BRADFORD)


def acescg_from_rec709() -> np.ndarray:
    """(3, 3) linear Rec.709 to ACEScg, Bradford adapted."""
    adapted = bradford(D65_XY, ACES_WHITE_XY) @ xyz_from_rgb(REC709_XY, D65_XY)
    return np.linalg.inv(xyz_from_rgb(AP1_XY, ACES_WHITE_XY)) @ adapted


def camera_from_acescg(color_matrix: np.ndarray) -> np.ndarray:
    """(3, 3) of the camera whose ColorMatrix1 under D65 is given."""
    return np.asarray(color_matrix) @ bradford(ACES_WHITE_XY, D65_XY) @ xyz_from_rgb(AP1_XY, ACES_WHITE_XY)


@dataclass(frozen=True)
class Sensor:
    """A camera body. ``color_matrix``: (3, 3) camera_rgb from XYZ under D65, four decimals as in the DNG."""

    cfa: str
    black: tuple[int, int, int, int]  # DN of the 2x2 cell in rows
    white: int  # DN, also where samples clip
    e_per_dn: float
    read_noise_e: float
    prnu: float  # relative standard deviation
    hot_pixels: int
    hot_e_per_s: tuple[float, float]  # range of the log-uniform rate
    color_matrix: np.ndarray
    seed: int

    @property
    def neutral(self) -> np.ndarray:
        """(3,) camera_rgb of D65 white at Y = 1: the AsShotNeutral of every frame."""
        return self.color_matrix @ white_xyz(D65_XY)

    @property
    def full_well_e(self) -> float:
        """Electrons between the mean black and white."""
        return (self.white - float(np.mean(self.black))) * self.e_per_dn

    def noise_profile(self) -> tuple[float, float]:
        """DNG NoiseProfile: variance of x = S x + O. Quantisation is in O; the fixed pattern is not."""
        read = self.read_noise_e / self.full_well_e
        step = self.e_per_dn / self.full_well_e
        return 1.0 / self.full_well_e, read**2 + step**2 / 12

    def cells(self, height: int, width: int, values: tuple[float, ...]) -> np.ndarray:
        """(H, W) picture of four values repeated over the 2x2 cell."""
        return np.tile(np.reshape(np.asarray(values, float), (2, 2)), (height // 2, width // 2))

    def fixed_pattern(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Gain of every photosite (H, W), and the hot ones (N, 3) as row, column, electrons per second."""
        random = np.random.default_rng([self.seed, 1])
        gain = 1 + self.prnu * random.standard_normal((height, width))
        sites = random.choice(height * width, self.hot_pixels, replace=False)
        low, high = np.log(self.hot_e_per_s)
        rates = np.exp(random.uniform(low, high, self.hot_pixels))
        return gain, np.stack([sites // width, sites % width, np.round(rates, 1)], 1)

    def expose(self, camera_rgb: np.ndarray, exposure: float, time_s: float, frame: int) -> np.ndarray:
        """Mosaic (H, W) uint16 of camera_rgb radiance (H, W, 3).

        ``exposure`` is true ``t ISO / (100 N^2)``, ``time_s`` the true time (for hot photosites), ``frame`` the number
        that makes this frame's noise its own.
        """
        height, width, _ = camera_rgb.shape
        gain, hot = self.fixed_pattern(height, width)
        plane = np.array(["RGB".index(c) for c in self.cfa])
        colour = np.tile(plane.reshape(2, 2), (height // 2, width // 2))
        fraction = np.take_along_axis(camera_rgb, colour[..., None], 2)[..., 0].astype(float) * exposure
        electrons = fraction * gain * (self.white - self.cells(height, width, self.black)) * self.e_per_dn
        electrons[hot[:, 0].astype(int), hot[:, 1].astype(int)] += hot[:, 2] * time_s
        random = np.random.default_rng([self.seed, 2, frame])
        # A camera_rgb below zero (a colour outside the camera's gamut) collects no electrons.
        collected = random.poisson(np.clip(electrons, 0, 4 * self.full_well_e)).astype(float)
        collected += self.read_noise_e * random.standard_normal((height, width))
        counts = np.rint(self.cells(height, width, self.black) + collected / self.e_per_dn)
        return np.clip(counts, 0, self.white).astype(np.uint16)
