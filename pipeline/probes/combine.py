"""Several views of one probe on one lat-long grid, made one map: weights, disagreement, the plate laid under.

Views are weighted by the inverse of a variance that geometry and their common signal give, not their own noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import direction_from_latlong, invert_rigid, latlong_solid_angles, transform_points
from pipeline.image.small_lights import RESTORED
from pipeline.light.alike import ALIASED, ALIKE, ALIKE_PX, ALIKE_VIEWS, SOFT
from pipeline.light.environment import resize_environment
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.filling import enlarge
from pipeline.probes.levelling import precision
from pipeline.probes.observation import Quality, ViewMap
from pipeline.types import Camera, Raster, View

WEIGHT_ROWS = 64  # rows of the grid on which views are weighed: cells of 2.8 degrees, wider than views are displaced
LEAST_SHARE = 0.05  # of the weight: a view that has less was set aside, and does not contradict
FLOOR = 0.003  # relative: below it two views are equally good
PLATE_SPLIT, PLATE_SIGMA_PX = 2, 0.5  # lookups per texel and axis; blur and misplacement of the plate's pixels
SIGNIFICANT = 3.0  # standard deviations
SHARPEST_PX = 0.4  # of lens and pixel: an edge sharper than that was sharpened by a camera


def ramp(inside: np.ndarray, fade: float) -> np.ndarray:
    """0 below ``-fade``, 1 above 0, smooth between."""
    t = np.clip(inside / fade + 1, 0, 1)
    return t * t * (3 - 2 * t)


def rim_fade(sine: np.ndarray, sigma_rad: np.ndarray, rim: float) -> np.ndarray:
    """Trust (H, W) of a view in [0, 1]: nothing where it is blind, fading out over 0.04 before the rim cut at 0.04."""
    fade = ramp(np.where(np.isfinite(sine), rim - sine, -1) - 0.04, 0.04)
    return np.where(np.isfinite(sigma_rad), fade, 0)


@dataclass(frozen=True)
class Merged:
    """One map of several views: radiance and variance (H, W, 3), zero and infinite where nobody sees; seen (H, W).

    ``disagreement`` (H, W): squared differences of views over those that their variances explain, at least 1 where one
    view sees alone; ``share`` (V, H, W): weights that sum to 1.
    """

    rgb: np.ndarray
    variance: np.ndarray
    seen: np.ndarray
    disagreement: np.ndarray
    share: np.ndarray


def merge(views: list[ViewMap]) -> Merged:
    """Mean of the views by the inverse of their variance; where they disagree beyond it, the variance is raised.

    The variance that weighs is the same function of the same light for every view: pooled signal, its gradient and its
    noise per pixel, with the view's own pixels per texel and direction error (see `expected_variance`). A view's own
    variance follows its own signal, so weighting by it prefers the darker of two views that differ, and loses lamps.
    """
    trust = np.stack([view.weight for view in views])
    weights = trust if len(views) == 1 else trust / expected_variance(views)
    total = weights.sum(0)
    share = weights / np.where(total > 0, total, 1)
    rgb = sum_of(share, [view.rgb for view in views])
    variance = sum_of(share**2, [view.variance for view in views])
    ratio = disagreement(views, share, rgb, variance)
    variance *= ratio[..., None]
    variance[total <= 0] = np.inf
    seen = np.einsum("vhw,vhw->hw", share, np.stack([view.coverage for view in views]))
    return Merged(rgb, variance, np.clip(seen, 0, 1), ratio, share)


def alike_deg(views: list[ViewMap]) -> float | None:
    """Width [degrees] of cells within which texels err alike: `ALIKE_PX` median pixels of the probe's pictures.

    None when no view says how large its pixels are.
    """
    sizes = []
    for view in views:
        if view.quality is not None and (seen := view.quality.pixels > 0).any():
            size = np.sqrt(latlong_solid_angles(*seen.shape)[seen] / view.quality.pixels[seen])
            weight = np.cumsum(latlong_solid_angles(*seen.shape)[seen][np.argsort(size)])
            sizes.append(float(np.sort(size)[np.searchsorted(weight, weight[-1] / 2)]))
    return float(np.degrees(ALIKE_PX * np.mean(sizes))) if sizes else None


def equal_views(merged: Merged) -> str:
    """How many equal views a map's light is the mean of: 1 over the sum of squared shares, weighted by the light."""
    light = latlong_solid_angles(*merged.seen.shape) * np.maximum(merged.rgb.mean(-1), 0) * (merged.share.sum(0) > 0)
    squares = float((light * (merged.share**2).sum(0)).sum())
    return f"{float(light.sum()) / squares if squares > 0 else 1.0:.4g}"


def picture_header(
    merged: Merged, maps: dict[str, ViewMap], views: dict[str, View], photographs: dict[str, Raster]
) -> dict[str, str]:
    """What a map's header says of the pictures it is from, ``maps`` by view; ``views`` may lack one that is no picture.

    Nothing when no map says how large its pixels are; no softness when that of one view is not known.
    """
    degrees = alike_deg(list(maps.values()))
    soft = soft_px([views[name].softness_px if name in views else None for name in maps])
    if degrees is None:
        return {}
    told = {} if soft is None else {SOFT: " ".join(f"{one:.4g}" for one in soft)}
    aliased = [int(name not in photographs or not _is_restored(photographs[name])) for name in maps]
    told[ALIASED] = " ".join(map(str, aliased))
    return {ALIKE: f"{degrees:.4g}", ALIKE_VIEWS: equal_views(merged), **told}


def _is_restored(photograph: Raster) -> bool:
    return photograph.attributes.get(RESTORED) == "1"


def soft_px(measured: list[float | None]) -> np.ndarray | None:
    """Softness (V,) [px] of lens and pixel of each view; None where one is not known, or is not a lens's."""
    known = np.array([one for one in measured if one is not None])
    return None if len(known) < len(measured) or (known < SHARPEST_PX).any() else known


def sum_of(share: np.ndarray, maps: list[np.ndarray]) -> np.ndarray:
    """Sum (H, W, C) of maps (H, W, C) times shares (V, H, W)."""
    return np.asarray(sum(part[..., None] * one for part, one in zip(share, maps, strict=True)), float)


def expected_variance(views: list[ViewMap]) -> np.ndarray:
    """Variance (V, H, W) of each view, up to a common factor, as geometry and the pooled signal have it.

    Noise of one pixel over pixels per texel, plus gradient times direction error squared, plus a floor. Evaluated on
    cells of 2.8 degrees and interpolated: weights that varied across a lamp would weigh its two displaced pictures
    differently, and change its energy.
    """
    height, width = views[0].weight.shape
    rows = min(WEIGHT_ROWS, height)
    trust = np.stack([precision(view) for view in views])
    pooled = sum_of(trust / np.where(trust.sum(0) > 0, trust.sum(0), 1), [view.rgb for view in views])
    fine = resize_environment(pooled, min(4 * rows, height), 2 * min(4 * rows, height))
    slope = resize_environment(gradient_per_radian(fine) ** 2, rows, 2 * rows).mean(-1)
    signal = resize_environment(pooled, rows, 2 * rows).mean(-1)
    noise, terms = [], []
    for view in views:
        known = view.quality or Quality(np.zeros(view.weight.shape), np.ones(view.weight.shape), view.variance.mean(-1))
        area = np.asarray(view.weight > 0, float)
        kept = [np.where(area > 0, one, 0) for one in (known.pixel_variance, known.sigma_rad**2, known.pixels)]
        cells = np.moveaxis(resize_environment(np.stack([area, *kept], -1), rows, 2 * rows), -1, 0)
        cells[1:] /= np.where(cells[0] > 0, cells[0], 1)
        noise.append(np.where(cells[0] > 0, cells[1], np.nan))
        terms.append((cells[2], np.maximum(cells[3], 1e-6)))
    common = np.nan_to_num(_mean_of_known(np.stack(noise)))
    model = []
    for own, (sigma_squared, pixels) in zip(noise, terms, strict=True):
        both = np.isfinite(own) & (common > 0) & (np.nan_to_num(own) > 0)
        factor = float(np.median(own[both] / common[both])) if both.any() else 1.0
        model.append(factor * common / pixels + slope * sigma_squared + (FLOOR * signal) ** 2 + 1e-30)
    return np.moveaxis(enlarge(np.stack(model, -1), height, width), -1, 0)


def _mean_of_known(values: np.ndarray) -> np.ndarray:
    """Mean over the first axis of what is finite; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(0)
    return np.where(count > 0, np.where(known, values, 0).sum(0) / np.maximum(count, 1), np.nan)


def disagreement(views: list[ViewMap], share: np.ndarray, rgb: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Squared differences from the mean over expected ones (H, W), on cells of 2.8 degrees, never below 1.

    ``E (L_v - m)^2 = V_v (1 - 2 s_v) + V_m`` with shares ``s`` and the mean's variance ``V_m``. Only what exceeds 1 by
    three standard deviations of so many independent pixels counts; a cell that is one view's alone keeps 1.
    """
    rows, squares, expected = min(WEIGHT_ROWS, rgb.shape[0]), 0.0, 0.0
    pixels = np.zeros(rgb.shape[:2])
    for part, view in zip(share, views, strict=True):
        valid = (part > LEAST_SHARE) & (part < 1 - LEAST_SHARE)
        allowed = (view.variance * (1 - 2 * part[..., None]) + variance).mean(-1)
        squares = squares + part * np.where(valid, ((view.rgb - rgb) ** 2).mean(-1), 0)
        expected = expected + part * np.where(valid, np.maximum(allowed, 0), 0)
        pixels += np.where(valid, np.minimum(view.quality.pixels, 1) if view.quality else 1, 0) / len(views)
    small = resize_environment(np.stack([squares, expected, pixels], -1), rows, 2 * rows)
    ratio = np.where(small[..., 1] > 0, small[..., 0] / np.where(small[..., 1] > 0, small[..., 1], 1), 1)
    count = small[..., 2] * rgb.shape[0] * rgb.shape[1] / (2 * rows * rows) * max(len(views) - 1, 1)
    ratio = np.where(ratio > 1 + SIGNIFICANT * np.sqrt(2 / np.maximum(count, 1)), ratio, 1)
    return enlarge(ratio[..., None], *rgb.shape[:2])[..., 0] if len(views) > 1 else np.ones(rgb.shape[:2])


def disagreement_numbers(merged: Merged) -> dict[str, float]:
    """How much of the sphere, and of the light, was seen twice and differently, and the root of the worst ratio."""
    weight = latlong_solid_angles(*merged.seen.shape)
    light = weight * merged.rgb.mean(-1)
    several = merged.share.max(0) < 1 - LEAST_SHARE
    differs = (merged.disagreement > 1) & several
    both = float((several * weight).sum())
    return {
        "seen_by_several_fraction": both / (4 * np.pi),
        "disagreeing_fraction": float((differs * weight).sum()) / max(both, 1e-12),
        "disagreeing_light_rel": float((differs * light).sum()) / max(float((several * light).sum()), 1e-300),
        "disagreement_worst": float(np.sqrt(merged.disagreement.max())),
    }


def disagreement_reason(figures: dict[str, float], views: int) -> dict[str, Any]:
    """Whether views contradicted each other, and where the variance was raised."""
    share = figures["disagreeing_fraction"]
    return {
        "term": "disagreement of views in the variance",
        "modelled": share > 0,
        "because": f"beyond their variances in {share:.1%} of what several views share, "
        f"{figures['disagreeing_light_rel']:.1%} of its light"
        if views > 1
        else "one view only: nothing to compare",
        "could_cost": "variance too small by up to "
        f"{figures['disagreement_worst'] ** 2:.0f} times where near things, clouds or people moved",
        **({"bound_rel": 0.0} if views > 1 else {"no_bound": "one view only: nothing to compare"}),
    }


@dataclass(frozen=True)
class Below:
    """The plate's picture of the plane near the probe, on the map: radiance and variance (H, W, 3), share (H, W)."""

    rgb: np.ndarray
    variance: np.ndarray
    share: np.ndarray


def plate_below(
    plate: np.ndarray, camera: Camera, world_from_camera: np.ndarray, centre: np.ndarray, shape: tuple[int, int]
) -> Below:
    """What the plate shows in the directions of a map of ``shape`` that meet the plane y = 0 near the probe.

    The ball mirrors its own shadow and contact, and displaces what is a few radii away; the plate shows the same
    plane without it. ``plate`` (h, w, 7): RGB, variance RGB, valid. From 7 degrees down, fully from 11: within 8 radii
    of the foot. A texel is the mean of 2 x 2 lookups; half a pixel of misplacement of what the plate shows is in its
    variance.
    """
    height, width = shape
    first = int(height * (0.5 + np.radians(7.0) / np.pi))
    groups = planes(_displaced(plate))
    sums = np.zeros((height, width, 7))
    for row, column in np.ndindex(PLATE_SPLIT, PLATE_SPLIT):
        v = (np.arange(first, height) + (row + 0.5) / PLATE_SPLIT) / height
        u = (np.arange(width) + (column + 0.5) / PLATE_SPLIT) / width
        w = direction_from_latlong(*np.meshgrid(u, v))
        foot = centre - w * (centre[1] / w[..., 1])[..., None]
        px = project(camera, transform_points(invert_rigid(world_from_camera), foot).reshape(-1, 3))
        px = px.reshape(*w.shape[:2], 2)
        inside = ((px > 1) & (px < (camera.width - 1, camera.height - 1))).all(-1)
        found = bilinear(groups, np.where(inside, px[..., 0], 0), np.where(inside, px[..., 1], 0))
        weight = ramp(-np.arcsin(w[..., 1]) - np.radians(11.0), np.radians(4.0)) * inside * (found[..., 6] > 0.999)
        sums[first:] += weight[..., None] * np.concatenate([found[..., :6], np.ones_like(found[..., :1])], -1)
    laid = sums[..., :6] / np.where(sums[..., 6:] > 0, sums[..., 6:], 1)
    return Below(laid[..., :3], laid[..., 3:], sums[..., 6] / PLATE_SPLIT**2)


def lay_under(rgb: np.ndarray, variance: np.ndarray, known: np.ndarray, below: Below) -> tuple[np.ndarray, np.ndarray]:
    """A map (H, W, 3) and its variance with the plate laid over what the probe saw of the plane near it.

    ``known`` (H, W) in [0, 1] says how far the map is measured.
    """
    rest = (1 - below.share) * known
    total = np.where(below.share + rest > 0, below.share + rest, 1)
    parts = [(weight / total)[..., None] for weight in (below.share, rest)]
    mixed = parts[0] * below.rgb + parts[1] * rgb
    return mixed, parts[0] ** 2 * below.variance + parts[1] ** 2 * np.where(parts[1] > 0, variance, 0)


def _displaced(plate: np.ndarray) -> np.ndarray:
    """The plate (h, w, 7) with the variance of a misplacement of half a pixel added to that of its noise."""
    slope = sum(np.square(np.gradient(plate[..., :3], axis=axis)) for axis in (0, 1))
    return np.concatenate([plate[..., :3], plate[..., 3:6] + PLATE_SIGMA_PX**2 * slope, plate[..., 6:]], -1)


def gradient_per_radian(rgb: np.ndarray) -> np.ndarray:
    """Length (H, W, C) of the radiance gradient on the sphere."""
    height, width = rgb.shape[:2]
    down = np.gradient(rgb, np.pi / height, axis=0)
    across = (np.roll(rgb, -1, 1) - np.roll(rgb, 1, 1)) / (4 * np.pi / width)
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    return np.hypot(down, across / sine)
