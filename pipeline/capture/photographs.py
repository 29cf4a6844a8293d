"""Photographs of a folder, each read once and made small: metadata, light per block, and what clips.

A mosaic is averaged over its 2x2 cells, so no demosaicking enters, then over larger blocks down to WORKING_PX. Values
are the normalised signal (DN - black) / (white - black); of files behind a response curve, codes to the power of 2.2:
good enough to tell what a picture shows, no measurement.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.image.encoded import SUFFIXES
from pipeline.image.frames import read_frame, read_samples
from pipeline.image.noise import ASSUMED_ELECTRONS, ASSUMED_READ_ELECTRONS, from_profile
from pipeline.run.errors import CaptureError
from pipeline.types import Frame

RAW_SUFFIXES = (
    ".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".iiq", ".x3f",
    ".mrw", ".kdc", ".3fr", ".rwl", ".raw",
)  # fmt: skip
PICTURES = tuple(suffix for suffix in SUFFIXES if suffix not in (".exr", ".hdr"))  # those are made, not photographed
WORKING_PX = 1200  # longer side of what is kept in memory of a photograph
CURVE = 2.2  # of files that went through one nobody states
LINEAR_LIMIT, DISPLAY_LIMIT = 0.985, (250 / 255) ** CURVE
PILED = 5e-4  # share of the samples at one top value that tells a clip level


@dataclass(frozen=True, eq=False)
class Photo:
    """One photograph. ``rgb`` (h, w, 3): mean signal of blocks of ``step`` px; ``top`` (h, w): their largest sample."""

    path: Path
    frame: Frame
    rgb: np.ndarray
    top: np.ndarray
    step: int
    limit: float  # signal from which a sample is taken as clipped
    noise: tuple[float, float]  # variance of a sample = noise[0] * signal + noise[1]

    @property
    def clipped(self) -> np.ndarray:
        """(h, w) bool: a sample of the block clips."""
        return np.asarray(self.top >= self.limit)

    @property
    def exposure(self) -> float:
        """Relative exposure t * ISO / (100 N^2) by the labels; 0 when its time is not stated."""
        frame = self.frame
        return frame.exposure_s * (frame.iso or 100) / 100 / (frame.fnumber or 1) ** 2 / 2**frame.nd_stops

    def sigma(self, signal: np.ndarray) -> np.ndarray:
        """Standard deviation of the mean of a block of this signal; half a DN of black level is not known better."""
        shot, floor = self.noise
        step = 0.5 / (self.frame.white - float(self.frame.black.mean()))
        samples = self.step**2 if self.frame.cfa else 3 * self.step**2
        code = (
            1.5 / 255 * CURVE * np.maximum(signal, 1e-4) ** (1 - 1 / CURVE) if self.frame.encoding == "display" else 0
        )
        return np.sqrt((shot * np.maximum(signal, 0) + floor) / samples + step**2 + np.square(code))


def files_of(folder: Path) -> list[Path]:
    """Photographs below a folder by their suffix, sorted; hidden folders are left out. Raises CaptureError."""
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; expected one with photographs")
    found = []
    for base, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        wanted = (*RAW_SUFFIXES, *PICTURES)
        found += [Path(base) / n for n in sorted(names) if Path(n).suffix.lower() in wanted and n[0] != "."]
    if not found:
        raise CaptureError(f"{folder}: no photographs; expected RAW, JPEG, HEIC, PNG or TIFF files")
    return sorted(found)


def read_all(files: Sequence[Path], root: Path, working_px: int = WORKING_PX) -> tuple[list[Photo], dict[str, str]]:
    """Photographs in the order of ``files``, names relative to ``root``, and why others could not be read."""
    photos: list[Photo] = []
    flaws: dict[str, str] = {}

    def read(path: Path) -> Photo | str:
        try:
            return read_photo(path, os.path.relpath(path, root), working_px)
        except CaptureError as error:
            return str(error)

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # decoders release the interpreter
        for path, photo in zip(files, pool.map(read, files)):
            if isinstance(photo, str):
                flaws[Path(os.path.relpath(path, root)).as_posix()] = photo
            else:
                photos.append(photo)
    return with_clip_levels(photos), flaws


def read_photo(path: Path, name: str, working_px: int = WORKING_PX) -> Photo:
    """Read one photograph and make it small. Raises CaptureError."""
    frame = read_frame(path, Path(name).as_posix())
    rgb, top, step = reduced(*binned(read_samples(path, frame), frame), working_px)
    limit = LINEAR_LIMIT if frame.encoding == "linear" else DISPLAY_LIMIT
    return Photo(path, frame, rgb, top, step, limit, sample_noise(frame))


def sample_noise(frame: Frame) -> tuple[float, float]:
    """Shot and floor of a sample's variance: the file's NoiseProfile, else that of a usual sensor at this ISO."""
    found = from_profile(frame) if frame.cfa and frame.noise_profile is not None else None
    if found is not None:
        return float(found.shot.mean()), float(found.floor.mean())
    shot = (frame.iso or 100) / 100 / ASSUMED_ELECTRONS
    return shot, (ASSUMED_READ_ELECTRONS * shot) ** 2


def binned(samples: np.ndarray, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Mean signal (H/2, W/2, 3) of 2x2 cells of stored samples, and the largest of each cell (H/2, W/2), float32."""
    height, width = (n // 2 * 2 for n in samples.shape[:2])
    quarters = [samples[r:height:2, c:width:2] for r in (0, 1) for c in (0, 1)]
    if frame.cfa:
        black = np.broadcast_to(frame.black, (2, 2)).astype(np.float32).ravel()
        planes = [(part - b) / np.float32(frame.white - b) for part, b in zip(quarters, black)]
        colours = [[plane for plane, c in zip(planes, frame.cfa) if c == wanted] for wanted in "RGB"]
        rgb = np.stack([np.asarray(sum(found)) / len(found) for found in colours], -1)
        return rgb.astype(np.float32), np.maximum.reduce(planes).astype(np.float32)
    if frame.encoding == "display" and samples.dtype.kind == "u":  # looked up: 36 million powers take seconds
        table = (np.arange(np.iinfo(samples.dtype).max + 1) / frame.white).astype(np.float32) ** np.float32(CURVE)
        top = table[np.maximum.reduce([part.max(-1) for part in quarters])]
        return np.asarray(np.mean([table[part] for part in quarters], 0, np.float32)), top
    black = np.asarray(frame.black, np.float32).reshape(3)
    parts = [(part - black) / (np.float32(frame.white) - black) for part in quarters]
    return np.asarray(np.mean(parts, 0, np.float32)), np.asarray(np.maximum.reduce(parts).max(-1))


def reduced(rgb: np.ndarray, top: np.ndarray, working_px: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Cells averaged over whole blocks until their longer side is at most ``working_px``; and px per block."""
    factor = -(-max(top.shape) // working_px)
    if factor == 1:
        return rgb, top, 2
    height, width = (n // factor for n in top.shape)
    cut = (slice(height * factor), slice(width * factor))
    means = rgb[cut].reshape(height, factor, width, factor, 3).mean((1, 3), dtype=np.float32)
    return means, top[cut].reshape(height, factor, width, factor).max((1, 3)), 2 * factor


def with_clip_levels(photos: list[Photo]) -> list[Photo]:
    """Photographs of one camera and ISO that pile up at one and the same value below white clip there."""
    tops: dict[tuple[str, float, float], list[float]] = {}
    for photo in photos:
        peak = float(photo.top.max())
        if 0.5 < peak < photo.limit and np.mean(photo.top > 0.999 * peak) > PILED:
            tops.setdefault((photo.frame.camera, photo.frame.iso, photo.frame.white), []).append(peak)
    found = []
    for photo in photos:
        peaks = tops.get((photo.frame.camera, photo.frame.iso, photo.frame.white), [])
        levels = [peak for peak in peaks if sum(abs(other - peak) < 1e-3 for other in peaks) > 1]
        found.append(replace(photo, limit=0.99 * max(levels)) if levels else photo)
    return found


def combined(photos: Sequence[Photo], exposures: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Light (h, w, 3) of frames of one view, and where (h, w) the shortest one clips: there it is a lower bound.

    Sum of unclipped signals over the sum of their exposures; the shortest frame stands in where all clip.
    """
    order = np.argsort(exposures, kind="stable")
    total = np.zeros_like(photos[0].rgb, np.float64)
    time = np.zeros(photos[0].top.shape)
    for i in order:
        usable = ~photos[i].clipped
        total += np.where(usable[..., None], photos[i].rgb, 0)
        time += np.where(usable, exposures[i], 0)
    shortest = photos[order[0]]
    all_clip = time == 0
    light = np.where(
        all_clip[..., None], shortest.rgb / exposures[order[0]], total / np.maximum(time, 1e-30)[..., None]
    )
    return light.astype(np.float32), all_clip
