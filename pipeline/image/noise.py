"""Noise of sensor samples: variance = shot * signal + floor, on the signal x = (DN - black) / (white - black).

``shot`` is 1 / (electrons at white); ``floor`` holds read noise and quantisation. The form is that of DNG NoiseProfile
(DNG 1.7.1); pipeline/image/photon_transfer.py measures it. Both numbers, and the photo-response non-uniformity (PRNU),
carry their own relative standard uncertainty.

PRNU is a gain of each photosite, the same in every frame of a camera: averaging over frames leaves it, so it is added
to the variance of the merged radiance (`add_fixed_pattern`) and stays out of the weights and of the comparison of
frames, where it cancels.

Between ISO settings ``shot`` goes with the ISO. Read noise before the amplifier goes with its square, behind it (the
converter) not at all: two known settings tell them apart, one does not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.types import Frame

ASSUMED_ELECTRONS = 30000.0  # at white, ISO 100: between a phone's 5 000 and a full frame's 80 000
ASSUMED_READ_ELECTRONS = 3.0
ASSUMED_SIGMA = 0.7  # relative, of both: a factor of two either way
PROFILE_SIGMA = (0.05, 0.1)  # relative, of shot and floor: a profile is of a model at an ISO, not of this body
ISO_SIGMA = 0.03  # relative, of the ratio of two ISO labels


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of one frame: ``shot`` and ``floor`` per CFA cell (2, 2) or channel (1, 3), of normalised signal.

    ``prnu``: relative standard deviation of the photosites' gain. Sigmas are relative standard uncertainties.
    """

    shot: np.ndarray
    floor: np.ndarray
    source: str
    shot_sigma: float = 0.0
    floor_sigma: float = 0.0
    prnu: float = 0.0
    prnu_sigma: float = 0.0

    def variance(self, signal: float) -> np.ndarray:
        """Per cell or channel, variance of a sample of this signal; the fixed pattern apart."""
        return self.shot * max(signal, 0.0) + self.floor

    def numbers(self) -> dict[str, Any]:
        """Electrons at white, read noise in electrons and PRNU, each with its standard uncertainty, for the record."""
        electrons = float(1 / self.shot.mean())
        read = float(np.sqrt(self.floor.mean()) / self.shot.mean())
        found: dict[str, Any] = {
            "source": self.source,
            "electrons_at_white": electrons,
            "electrons_at_white_sigma": electrons * self.shot_sigma,
            "read_noise_electrons": read,
            "read_noise_electrons_sigma": read * float(np.hypot(self.floor_sigma / 2, self.shot_sigma)),
            "prnu": self.prnu,
            "prnu_sigma": self.prnu * self.prnu_sigma,
        }
        if np.ptp(self.shot) > 0:
            found["electrons_at_white_by_cell"] = (1 / self.shot.ravel()).tolist()
        return found


def full_scale(frame: Frame) -> float:
    """White less the mean black level, DN."""
    return frame.white - float(np.mean(frame.black))


def steps(frame: Frame) -> float:
    """Steps of quantisation from black to white. Floating-point data, whose white lies below 255, count as 16 bits."""
    return full_scale(frame) if frame.white >= 255 else 65535.0


def _uniform(frame: Frame, shot: float, floor: float, source: str, **more: float) -> Noise:
    return Noise(np.full(frame.black.shape, shot), np.full(frame.black.shape, floor), source, **more)


def from_profile(frame: Frame) -> Noise | None:
    """The DNG NoiseProfile of a frame, its floor at least quantisation; None without one, or with one not positive."""
    profile = frame.noise_profile
    if profile is None or not np.all(np.isfinite(profile)) or profile[0] <= 0 or np.any(profile < 0):
        return None
    pairs = profile.reshape(-1, 2)
    colours = frame.cfa or "RGB"
    cells = np.array([0 if len(pairs) == 1 else "RGB".index(colour) for colour in colours]).reshape(frame.black.shape)
    quantisation = 1 / (12 * steps(frame) ** 2)
    return Noise(pairs[cells, 0], np.maximum(pairs[cells, 1], quantisation), "NoiseProfile", *PROFILE_SIGMA)


def from_facts(frame: Frame, tables: Sequence[Mapping[str, Any]]) -> Noise | None:
    """What [[noise]] of capture.toml says of a frame's ISO; None when it says nothing of it."""
    for table in tables:
        if table["iso"] == frame.iso and table["camera"] in ("", frame.camera):
            scale = full_scale(frame)
            electrons = table["electrons_at_white"] or table["electrons_per_dn"] * scale
            read = (table["read_noise_electrons"] / electrons) ** 2
            floor = read + 1 / (12 * steps(frame) ** 2)
            sigmas = {"shot_sigma": table["gain_sigma_rel"], "floor_sigma": 2 * table["read_noise_sigma_rel"]}
            pattern = {"prnu": table["prnu"] or 0.0, "prnu_sigma": table["prnu_sigma_rel"] if table["prnu"] else 0.0}
            return _uniform(frame, 1 / electrons, floor, "given", **sigmas, **pattern)
    return None


def assumed(frame: Frame) -> Noise:
    """A usual sensor at a frame's ISO, for want of anything better."""
    shot = frame.iso / 100 / ASSUMED_ELECTRONS
    floor = (ASSUMED_READ_ELECTRONS * shot) ** 2 + 1 / (12 * steps(frame) ** 2)
    return _uniform(frame, shot, floor, "assumed", shot_sigma=ASSUMED_SIGMA, floor_sigma=2 * ASSUMED_SIGMA)


def scaled(iso: float, known: Mapping[float, Noise]) -> Noise:
    """Noise at an ISO from that of other settings of the same camera.

    With two or more, the floor's parts before and behind the amplifier are solved for (not negative). With one it goes
    with the square upward, which is its upper bound, and with the first power downward, halfway between its bounds;
    the floor's uncertainty is that of the choice.
    """
    nearest = min(known, key=lambda other: (abs(np.log(other / iso)), other))
    source, gain = known[nearest], iso / nearest
    others = " and ".join(f"{other:g}" for other in sorted(known)[:2]) if len(known) > 1 else f"{nearest:g}"
    text = f"scaled from ISO {others}"
    shot_sigma = float(np.hypot(source.shot_sigma, ISO_SIGMA))
    if len(known) > 1:
        from scipy.optimize import nnls

        isos = np.array(sorted(known))
        floors = np.array([known[other].floor.mean() for other in isos])
        terms = np.stack([(isos / iso) ** 2, np.ones(len(isos))], 1)
        before, behind = nnls(terms / floors[:, None], np.ones(len(isos)))[0]
        floor = source.floor * (before + behind) / source.floor.mean()
        return replace(source, shot=source.shot * gain, floor=floor, source=text, shot_sigma=shot_sigma)
    floor = source.floor * (gain**2 if gain > 1 else gain)
    sigma = float(np.hypot(source.floor_sigma, abs(np.log(gain))))
    return replace(source, shot=source.shot * gain, floor=floor, source=text, shot_sigma=shot_sigma, floor_sigma=sigma)


def disagreement(stated: Noise, measured: Noise) -> dict[str, float]:
    """Relative difference of stated from measured shot and floor, and how many standard uncertainties each is."""
    found = {}
    for name in ("shot", "floor"):
        one, other = (float(getattr(noise, name).mean()) for noise in (stated, measured))
        sigmas = [getattr(noise, f"{name}_sigma") for noise in (stated, measured)]
        found[f"{name}_rel"] = one / other - 1
        found[f"{name}_sigmas"] = abs(one / other - 1) / max(float(np.hypot(*sigmas)), 1e-12)
    return found


def add_fixed_pattern(variance: np.ndarray, radiance: np.ndarray, prnu: float) -> None:
    """Add ``(prnu * radiance)^2`` to the variance of a merged radiance, in place, both (H, W) or (H, W, 3) float32."""
    for start in range(0, len(radiance) if prnu > 0 else 0, 256):
        rows = slice(start, start + 256)
        variance[rows] += np.square(np.float32(prnu) * radiance[rows])
