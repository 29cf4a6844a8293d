"""The contract of all probe kinds: what they may look at, and what they return.

A kind is a class with one method, ``observe(shots, grid) -> Observation``, registered in `pipeline.probes.kinds`. It
turns photographs into one lat-long map per view, world frame, ACEScg radiance in the plate's unit, with a variance, and
says what it does not see. The stage `probe` knows no kind: it levels views, merges, fills, and writes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from pipeline.conventions import CLIPPED
from pipeline.types import BallFit, Camera, Raster, View


@dataclass(frozen=True)
class Shots:
    """Everything a kind may look at: validated facts, developed photographs, the plate's camera, poses of the views."""

    facts: dict[str, Any]
    photographs: dict[str, Raster]
    camera: Camera
    views: dict[str, View]

    def camera_of(self, view: str) -> Camera:
        """The camera of a view: its own, else the plate's."""
        return self.views[view].camera or self.camera


@dataclass(frozen=True)
class Grid:
    """The map that is asked for: ``width`` texels around, half as many down.

    ``supersample``: least lookups per texel and axis; ``rim``: outermost radius of a ball that may be used, as a
    fraction of its outline's.
    """

    width: int
    supersample: int = 3
    rim: float = 0.999

    @property
    def height(self) -> int:
        """Texels from pole to pole."""
        return self.width // 2


@dataclass(frozen=True)
class Quality:
    """What a view's geometry makes of the light, which its own noise does not enter: views are weighted by it.

    ``sigma_rad`` (H, W): standard uncertainty of a texel's direction, with the blur of a pixel, NaN where blind;
    ``pixels`` (H, W): pixels per texel, below 1 where it is enlarged; ``pixel_variance`` (H, W): of the noise of one
    pixel, mean over the channels, radiance squared.
    """

    sigma_rad: np.ndarray
    pixels: np.ndarray
    pixel_variance: np.ndarray


@dataclass(frozen=True)
class ViewMap:
    """One view on the grid, world frame.

    Radiance and variance (H, W, 3); weight (H, W) in [0, 1], how far the view is to be trusted besides its variance;
    coverage (H, W) in [0, 1], how much of a texel was seen; ``clipped`` (H, W) in [0, 1], how much of what was seen is
    clipped in every frame; zeros when not given. Without ``quality`` the direction is exact and the variance is noise.
    """

    rgb: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    coverage: np.ndarray
    clipped: np.ndarray | float = 0.0
    quality: Quality | None = None

    def scaled(self, factor: float | np.ndarray) -> ViewMap:
        """The same view at ``factor`` times the exposure, a number or one per channel."""
        square, known = np.square(factor), self.quality
        return replace(
            self, rgb=self.rgb * factor, variance=self.variance * square,
            quality=known and replace(known, pixel_variance=known.pixel_variance * np.mean(square)),
        )  # fmt: skip


@dataclass(frozen=True)
class Observation:
    """What a kind saw.

    ``maps``: view name -> map, the view to which others are levelled first; ``centre_world`` (3,): where the light was
    measured; ``balls``: fitted balls by view, empty for other kinds; ``numbers`` by view or name, ``warnings`` and
    ``evidence`` as in `Result`. ``scale_sigma`` (3,): relative standard uncertainty that all texels of all views share.
    ``smooth_only``: directions are too poor for more than nine harmonics.
    """

    maps: dict[str, ViewMap]
    centre_world: np.ndarray
    balls: dict[str, BallFit] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)
    scale_sigma: np.ndarray | float = 0.0
    smooth_only: bool = False


class Kind(Protocol):
    """A probe kind. Raises CaptureError when its photographs cannot be used."""

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        """Maps of every view."""
        ...


def lookup_channels(photograph: Raster, window: tuple[slice, slice] = (slice(None), slice(None))) -> np.ndarray:
    """(H, W, 8): RGB, variance RGB, valid, clipped, of a part of a photograph; invalid pixels are zero.

    A clipped pixel's infinite variance becomes the square of its value: 100 %.
    """
    colours = [photograph[c][window] for c in "RGB"]  # cut before they are put together: a ball is a small part
    valid = np.isfinite(colours).all(0)
    found = np.empty((*valid.shape, 8), np.float32)
    for i, (name, colour) in enumerate(zip("RGB", colours, strict=True)):
        variance = photograph[f"variance.{name}"][window]
        found[..., i] = np.where(valid, colour, 0)
        found[..., 3 + i] = np.where(np.isfinite(variance) & valid, variance, np.where(valid, colour, 0) ** 2)
    found[..., 6] = valid
    found[..., 7] = (photograph["mask"][window] & CLIPPED > 0) & valid
    return found
