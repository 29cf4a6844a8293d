"""Noise of sensor samples: variance = shot * signal + floor, on the signal x = (DN - black) / (white - black).

``shot`` is 1 / (electrons at white); ``floor`` holds read noise and quantisation. The form is that of DNG NoiseProfile
(DNG 1.7.1), and the photon-transfer measurement that of Janesick 2007: the variance of the difference of two frames of
one scene, brought to one exposure, against their signal.

Limits: fixed-pattern gain (PRNU) is the same in every frame of a view and is not noise here; the gain is one number for
the three colours when it is measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.types import Frame

ASSUMED_ELECTRONS = 30000.0  # at white, ISO 100: between a phone's 5 000 and a full frame's 80 000
ASSUMED_READ_ELECTRONS = 3.0
MIN_BIN = 200  # samples in a photon-transfer bin: its variance is then known to 10 %
MAX_SAMPLES = 200_000  # of one pair of frames


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of one frame: ``shot`` and ``floor`` (2, 2) in CFA cell order, of normalised signal, and their source."""

    shot: np.ndarray
    floor: np.ndarray
    source: str

    def variance(self, signal: float) -> np.ndarray:
        """(2, 2) variance of a sample of this signal."""
        return self.shot * max(signal, 0.0) + self.floor


@dataclass(frozen=True, eq=False)
class Bin:
    """One photon-transfer measurement: ``variance = shot * signal_term + floor * floor_term``."""

    signal_term: float
    floor_term: float
    variance: float
    count: int


def from_profile(frame: Frame) -> Noise | None:
    """The DNG NoiseProfile of a frame, its floor at least quantisation; None without one, or with one not positive."""
    profile = frame.noise_profile
    if profile is None or not np.all(np.isfinite(profile)) or profile[0] <= 0 or np.any(profile < 0):
        return None
    pairs = profile.reshape(-1, 2)
    planes = np.array([0 if len(pairs) == 1 else "RGB".index(colour) for colour in frame.cfa]).reshape(2, 2)
    quantisation = 1 / (12 * (frame.white - float(np.mean(frame.black))) ** 2)
    return Noise(pairs[planes, 0], np.maximum(pairs[planes, 1], quantisation), "NoiseProfile")


def assumed(iso: float, white_minus_black: float) -> Noise:
    """A usual sensor at this ISO, for want of anything better."""
    shot = iso / 100 / ASSUMED_ELECTRONS
    floor = (ASSUMED_READ_ELECTRONS * shot) ** 2 + 1 / (12 * white_minus_black**2)
    return Noise(np.full((2, 2), shot), np.full((2, 2), floor), "assumed")


def transfer_bins(long: np.ndarray, short: np.ndarray, ratio: float, limit: float, step: float) -> list[Bin]:
    """Photon-transfer bins of two frames of one scene and one ISO.

    ``long``, ``short``: normalised signals (N,); ``ratio``: exposure of short over long, at most 1; samples at or above
    ``limit`` are left out; ``step`` is one DN. The variance of ``short - ratio * long`` is
    ``shot * ratio * long * (1 + ratio) + floor * (1 + ratio^2)``; its mean in a bin (exposure error) is taken off.
    """
    usable = np.flatnonzero((long < limit) & (short < limit) & (long > -0.1))
    usable = usable[:: max(1, len(usable) // MAX_SAMPLES)]
    long, short = long[usable], short[usable]
    edges = np.concatenate([[-0.1], np.geomspace(2e-4, 1.0, 25)])
    which = np.digitize(long, edges)
    bins = []
    for number in np.flatnonzero(np.bincount(which, minlength=len(edges)) >= MIN_BIN):
        members = which == number
        expected = ratio * long[members]
        difference = short[members] - expected
        difference -= np.median(difference)
        # motion, hot pixels and edges are outliers; one DN keeps quantised data from being cut to nothing
        cut = 4 * max(1.4826 * float(np.median(np.abs(difference))), step)
        kept = np.abs(difference) < cut
        count = int(kept.sum())
        if count >= MIN_BIN:
            variance = float(np.var(difference[kept], dtype=np.float64))
            signal = max(float(expected[kept].mean(dtype=np.float64)), 0.0)
            bins.append(Bin(signal * (1 + ratio), 1 + ratio**2, variance, count))
    return bins


def from_transfer(bins: list[Bin], step: float) -> Noise | None:
    """Shot and floor by weighted least squares over bins; None when the bins do not tell them apart.

    ``step`` is one DN; the floor is at least its quantisation noise, step^2 / 12.
    """
    if len(bins) < 3:
        return None
    terms = np.array([[b.signal_term, b.floor_term] for b in bins])
    variance = np.array([b.variance for b in bins])
    least = step**2 / 12
    # relative error of a variance from n samples, and 3 % of model error so that one huge bin does not rule
    weight = 1 / np.maximum(variance, least) / np.sqrt([2 / b.count + 0.03**2 for b in bins])
    scaled, target = terms * weight[:, None], variance * weight
    shot, floor = np.linalg.lstsq(scaled, target, rcond=None)[0]
    if floor < least:
        floor = least
        shot = float(scaled[:, 0] @ (target - floor * scaled[:, 1]) / (scaled[:, 0] @ scaled[:, 0]))
    information = scaled.T @ scaled
    if np.linalg.det(information) <= 0 or shot < 4 * float(np.sqrt(np.linalg.inv(information)[0, 0])):
        return None  # too little range of signal
    return Noise(np.full((2, 2), shot), np.full((2, 2), floor), "photon transfer")
