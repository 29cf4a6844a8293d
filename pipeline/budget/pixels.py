"""Standard uncertainty of every pixel: what is each pixel's own, and what a few shared modes move together.

C = plate * mul + add + obj, so that of its own a pixel has mul^2 times the plate's variance and what sampling and
denoising left of the render. Modes are signed pictures, the change of C per standard uncertainty; they are independent
of each other, so squares add. Means over regions: a mode keeps its size; of what is the pixels' own, neighbours share
some, by demosaicking (`PLATE_PX`) and by denoising. A denoiser moves noise about and keeps its sum, so that the mean of
a region is as unsure as the samples were before it: `of_means` is what independent pixels would need for that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

# Pixels that share one sample's worth of noise: sum of the autocovariance over the variance. Bilinear demosaicking of
# independent photosites: 4 / (9/16) = 7.1 for red and blue, 2 / (5/8) = 3.2 for green; camera to ACEScg mixes them.
PLATE_PX = 5.0
# Of the RMS error that a tile of the denoised render has, what a pixel's intervals need: few bad pixels (highlights,
# borders of shadows) make most of a tile's mean square. `python -m benchmarks.denoised_noise`, counter's draft as soft
# as its plate, five seeds of 16 samples against 160: 50, 68, 95 % intervals of the RMS itself hold 74, 86 and 97 % of
# object pixels and 78, 89 and 98 % of shadow pixels; of this share of it 48, 63 and 86, and 54, 68 and 89 %.
TYPICAL = 0.5
# Of the squared disagreement of two interpolations, what the plate's own errs. Of pixels that show only the plate (desk
# and courtyard, 512 px, bilinear) intervals of 50, 68 and 95 % hold 30, 42, 68 and 27, 38, 61 % without it, 51, 66, 89
# and 56, 71, 93 with three quarters. In shadows those hold 57, 75 and 95 % (59 captures): it is less.
INTERPOLATED = 0.6
SHADOW = 0.05  # relative change of the plate that is called a shadow, as `evaluate` has it
COVERED = 0.999


@dataclass(frozen=True, eq=False)
class Mode:
    """What one shared error makes of the composite: its change (h, w, 3) per standard uncertainty, in a window."""

    name: str
    source: str
    change: np.ndarray


def plate_variance(mul: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(H, W, 3) of the plate's part; infinite where the plate is clipped and shines through."""
    return np.where(mul == 0, 0, np.square(mul) * np.where(mul == 0, 0, variance))


def render_variance(
    on_change: np.ndarray, without: np.ndarray, obj: np.ndarray, noise_change: np.ndarray, noise_obj: np.ndarray
) -> np.ndarray:
    """(H, W, 3) of sampling and denoising.

    Noise (H, W) is RMS over the channels; it is shared out as the layers' own channels are. ``on_change``: what the
    composite makes of a unit of changed light.
    """
    parts = np.zeros(obj.shape, np.float32)
    for factor, level, noise in ((on_change, without, noise_change), (1.0, obj, noise_obj)):
        rms = np.sqrt(np.mean(np.square(level), -1, keepdims=True))
        hue = np.divide(np.abs(level), rms, out=np.ones(level.shape), where=rms > 0)
        parts += np.square(factor * hue * noise[..., None])
    return parts


def of_means(plate: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """(H, W, 3) variance of independent pixels whose means over regions are as unsure as the real ones'.

    ``plate``: the plate's part; ``samples``: the render's before it was denoised; both (H, W, 3).
    """
    return np.asarray(PLATE_PX * plate + samples)


def total_variance(own: list[np.ndarray], modes: list[Mode], window: tuple[slice, slice]) -> np.ndarray:
    """(H, W, 3): the pixels' own variances and the squares of all modes."""
    total = np.sum(own, axis=0)
    for mode in modes:
        total[window] += np.square(mode.change)
    return np.asarray(total)


def regions(composite: np.ndarray, plate: np.ndarray, alpha: np.ndarray) -> dict[str, np.ndarray]:
    """Where the budget is told: fully covered object pixels, and pixels whose light changes by `SHADOW`."""
    change = np.linalg.norm(composite - plate, axis=-1)
    return {"object": alpha > COVERED, "shadow": (alpha == 0) & (change > SHADOW * np.linalg.norm(plate, axis=-1))}


def waterfall(
    composite: np.ndarray, plate: np.ndarray, alpha: np.ndarray, own: dict[str, np.ndarray],
    means: dict[str, np.ndarray], modes: list[Mode], window: tuple[slice, slice],
) -> dict[str, Any]:  # fmt: skip
    """Per region and source: relative standard uncertainty of a pixel (RMS) and of the region's mean, over RGB norms.

    ``own``: variances of pixels by source; ``means``: the same, as means of regions need them (see `of_means`).
    Relative to the composite; ``mean_of_change`` to the mean change, for shadows. Pixels of infinite variance are
    left out and counted.
    """
    found: dict[str, Any] = {}
    for name, where in regions(composite, plate, alpha).items():
        known = where & np.logical_and.reduce([np.isfinite(v).all(-1) for v in own.values()])
        if not known.any():
            continue
        inside = known[window]
        count, level = int(known.sum()), np.linalg.norm(composite[known].mean(0))
        square = np.mean(np.square(composite[known]).sum(-1))
        change = np.linalg.norm((composite - plate)[known].mean(0))
        sources: dict[str, list[float]] = {}
        for source, variance in own.items():
            sources[source] = [variance[known].mean(0).sum() / square, means[source][known].mean(0).sum() / count]
        for mode in modes:
            part = mode.change[inside]
            old = sources.setdefault(mode.source, [0.0, 0.0])
            old[0] += np.mean(np.square(part).sum(-1)) / square
            old[1] += np.square(part.mean(0)).sum()
        total = np.sum(list(sources.values()), axis=0)
        rows = {**{key: np.array(value) for key, value in sources.items()}, "total": total}
        found[name] = {
            "pixels": count, "unknown_pixels": int((where & ~known).sum()),
            "pixel_rel": {key: float(np.sqrt(value[0])) for key, value in rows.items()},
            "mean_rel": {key: float(np.sqrt(value[1]) / level) for key, value in rows.items()},
            "mean_of_change": {key: float(np.sqrt(value[1]) / max(change, 1e-300)) for key, value in rows.items()},
        }  # fmt: skip
    return found


def stored(layers: dict[str, np.ndarray], level: float) -> dict[str, np.ndarray]:
    """Pictures in 16 bit where the plate's ``level`` leaves them their digits, else in 32; infinity stays infinity."""
    wide = not 1e-2 < level < 1e3
    kind, top = (np.float32, np.finfo(np.float32).max) if wide else (np.float16, np.finfo(np.float16).max)
    kept = {}
    for name, values in layers.items():
        kept[name] = np.clip(values.astype(np.float32), -top, top).astype(kind)
        unknown = ~np.isfinite(values)
        kept[name][unknown] = values[unknown]
    return kept
