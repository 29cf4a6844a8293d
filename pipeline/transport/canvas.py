"""What is computed where, and samples as pictures of it: both halves, LS_noobj, the smooth change, denoised."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipeline.image.blank import blank
from pipeline.transport.caustics import Film
from pipeline.transport.denoise import TILE, Half, QuietChange, bounding_window, glimpsed, quieted
from pipeline.transport.passes import Halves
from pipeline.transport.pilot import Effort, Pilot
from pipeline.transport.region import WHOLE, Region, Window
from pipeline.transport.scene import Worlds
from pipeline.transport.softened import PlateLens
from pipeline.transport.trace import LensRays, Rays, Samples, centre_albedo

TRUSTED = 16  # samples of a pixel and half from which noise is judged
JUDGED = (
    "obj", "lost", "gained", "albedo", "alpha", "obj_albedo", "obj_normal", "obj_variance", "change_variance",
)  # fmt: skip


class Sigma(Protocol):
    """Noise of the photograph (H, W), radiance, not finite where unknown; asked for by window."""

    def __getitem__(self, window: Window, /) -> np.ndarray:
        """(h, w) of a window."""
        ...


@dataclass(frozen=True, eq=False)
class Canvas:
    """What is computed where. ``light``: irradiance E, (3,) or per pixel of the window (h w, 3)."""

    worlds: Worlds
    rays: Rays | LensRays  # of every pixel
    shape: tuple[int, int]
    region: Region
    light: np.ndarray
    plate_sigma: Sigma
    white: float  # radiance of display white
    effort: Effort
    film: Film | None = None  # where light tracing is worth its cost
    pilot: Pilot | None = None  # what the region was made from
    softness: PlateLens | None = None  # of the photograph; None leaves pixels boxes

    @functools.cached_property
    def traced(self) -> np.ndarray:
        """Flat index of the pixels that are sampled."""
        return in_frame(self.window, self.shape)[self.region.traced]

    @property
    def window(self) -> Window:
        """Rows and columns around the region: all that is computed is a picture of this size."""
        return self.region.window

    @functools.cached_property
    def places(self) -> np.ndarray:
        """Flat index of the traced pixels within the window."""
        return np.flatnonzero(self.region.traced)

    @functools.cached_property
    def smooth_albedo(self) -> np.ndarray:
        """(h, w, 3) of the window: albedo where the change is interpolated, at the middle of the pixel; else zero."""
        there = self.region.interpolated
        image = np.zeros((*there.shape, 3), np.float32)
        image[there] = centre_albedo(self.worlds, self.rays[in_frame(self.window, self.shape)[there]])
        return image

    @property
    def light_traced(self) -> np.ndarray:
        """(N, 3) or (3,) irradiance of the traced pixels."""
        return self.light if self.light.ndim == 1 else self.light[self.places]

    def framed(self, picture: np.ndarray) -> np.ndarray:
        """A picture of the window (h, w, ...) in the frame (H, W, ...), zero around it."""
        image = blank((*self.shape, *picture.shape[2:]))
        image[self.window] = picture
        return image


def in_frame(window: Window, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) flat indices in a frame (H, W) of the pixels of a window."""
    rows, columns = (np.arange(size)[part] for size, part in zip(shape, window, strict=True))
    return np.asarray(rows[:, None] * shape[1] + columns)


def scattered(canvas: Canvas, values: np.ndarray) -> np.ndarray:
    """Values (N, ...) of the traced pixels as a picture of the canvas's window, zero elsewhere."""
    height, width = canvas.region.traced.shape
    image = np.zeros((height * width, *values.shape[1:]), np.float32)
    image[canvas.places] = values
    return image.reshape(height, width, *values.shape[1:])


def planes_of(
    canvas: Canvas, samples: Samples, names: tuple[str, ...], window: Window = WHOLE
) -> dict[str, np.ndarray]:
    """The named fields as pictures of a window in the canvas's, and LS_noobj; the smooth part of the change is in."""
    images = {name: scattered(canvas, getattr(samples, name))[window] for name in names}
    region, smooth = canvas.region[window], canvas.smooth_albedo[window]  # zero where pixels are traced
    light = canvas.light if canvas.light.ndim == 1 else canvas.light.reshape(*canvas.region.weight.shape, 3)[window]
    light = np.asarray(light / np.pi, np.float32)
    images["albedo"] += smooth
    images["without"] = images["albedo"] * light  # equation 7
    model = smooth * light
    for name, relative in (("lost", region.lost), ("gained", region.gained)):
        if name in images:
            images[name] += relative * model
    if "change_variance" in images:
        images["change_variance"] += region.variance * model**2
    if "ground" in images:
        images["ground"] += region.interpolated
    return images


def halves_in(
    canvas: Canvas, halves: Halves, images: dict[str, np.ndarray], window: Window
) -> tuple[Half, Half, np.ndarray, np.ndarray, np.ndarray, float]:
    """What the denoiser wants to know of a window; ``images`` holds both halves' alpha and guides there."""
    parts = []
    for samples in (halves.a, halves.b):
        part = planes_of(canvas, samples, ("lost", "gained", "albedo", "obj"), window)
        parts.append(Half(part["lost"], part["gained"], part["without"], part["obj"]))
    return parts[0], parts[1], images["alpha"], images["obj_albedo"], images["obj_normal"], canvas.white


def pictures(canvas: Canvas, halves: Halves) -> tuple[dict[str, np.ndarray], QuietChange | None]:
    """Every field as a picture of the canvas's window, zero where nothing was computed; and what the denoiser says.

    It says nothing of fewer than `TRUSTED` samples.
    """
    images = planes_of(canvas, halves.both, (*JUDGED, "ground"))
    for name in ("change", "obj"):  # RMS over the channels, as the denoiser tells it below
        images[f"{name}_noise"] = np.sqrt(images[f"{name}_variance"].mean(-1))
    if not canvas.effort.denoise:
        return images, None
    window = bounding_window(canvas.region.traced)
    view = {name: image[window] for name, image in images.items()}
    given = halves_in(canvas, halves, view, window)
    quiet = None if halves.a.count.max() < TRUSTED else quieted(*given)
    if quiet is None:
        survives, added, obj = glimpsed(*given, fast=halves.passes == 1)
    else:
        survives, added, obj = quiet.survives.rgb, quiet.added.rgb, quiet.obj.rgb
    here, model = canvas.region.traced[window][..., None], view["without"]
    ground, shown = here & (model > 0), here & (view["alpha"][..., None] > 0)
    view["lost"][:] = np.where(ground, np.minimum(survives - 1, 0) * model, view["lost"])
    view["gained"][:] = np.where(ground, added * model, view["gained"])
    view["obj"][:] = np.where(shown, obj, view["obj"])
    if quiet is not None:
        left = in_tiles(np.hypot(quiet.survives.noise, quiet.added.noise), here.shape) * model.mean(-1)
        view["change_noise"][:] = np.where(ground[..., 0], left, view["change_noise"])
        view["obj_noise"][:] = in_tiles(quiet.obj.noise, here.shape) * view["alpha"]
    return images, quiet


def in_tiles(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Values (h, w) of tiles at their pixels (H, W)."""
    return np.repeat(np.repeat(values, TILE, 0), TILE, 1)[: shape[0], : shape[1]]
