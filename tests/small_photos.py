"""Photographs made of arrays, for the tests of init and check: a place, exposures of it, and what a camera adds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from pipeline.capture.photographs import LINEAR_LIMIT, Photo
from pipeline.types import Frame

SHAPE = (180, 240)
NOISE = (4e-5, 1e-8)  # 25 000 electrons at white, 2.5 of read noise


def place(seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """(h, w, 3) light of two decades with detail at three scales."""
    rng = np.random.default_rng(seed)
    fields = [gaussian_filter(rng.normal(size=shape), scale) for scale in (3, 10, 30)]
    total = np.sum([field / field.std() for field in fields], 0)
    return np.exp(0.8 * total / total.std())[..., None] * np.array([0.7, 1.0, 0.6])


def with_disc(light: np.ndarray, x: float, y: float, radius: float, other: int = 99) -> np.ndarray:
    """The place with something else in a disc."""
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    inside = np.hypot(columns - x, rows - y) < radius
    return np.where(inside[..., None], 0.6 * place(other, light.shape[:2]), light)


def photo(light: np.ndarray, exposure_s: float, name: str, seed: int = 0, **facts: object) -> Photo:
    """The place (h, w, 3) exposed at f/1, ISO 100: with noise, clipped at white."""
    rng = np.random.default_rng([seed, len(name), round(1e6 * exposure_s)])
    signal = light * exposure_s
    noisy = signal + rng.normal(size=light.shape) * np.sqrt((NOISE[0] * signal + NOISE[1]) / 4)
    clipped = np.minimum(noisy, 1.0).astype(np.float32)
    stated = {
        "file": name, "sha256": name, "exposure_s": exposure_s, "iso": 100.0, "fnumber": 1.0, "cfa": "RGGB",
        "width": 2 * light.shape[1], "height": 2 * light.shape[0], "black": np.zeros((2, 2)), "white": 16000.0,
        "camera": "Maker One",
    } | facts  # fmt: skip
    return Photo(Path(name), Frame(**stated), clipped, clipped.max(-1), 2, LINEAR_LIMIT, NOISE)
