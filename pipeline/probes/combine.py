"""Several views of one ball, unwrapped on one lat-long grid, made one map: weights, relative exposure, gaps.

Weights are inverse variances of *where* a texel looked, not of its photons: photon variance follows the signal, so that
weighting by it would prefer whichever view is darker wherever two views disagree, and lamps would lose energy.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import invert_rigid, latlong_directions, latlong_solid_angles, transform_points
from pipeline.light.environment import resize_environment
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.observation import ViewMap
from pipeline.types import Camera

MOVED_PHOTOGRAPHER_WEIGHT = 1e-3  # another view wins wherever it sees; alone, the view still answers
BODY_RADIUS_M, COLUMN_AZIMUTH, COLUMN_ABOVE, COLUMN_FOOT = 0.12, np.radians(16.0), np.radians(10.0), np.radians(-12.0)
TEXTURE_SCALE = 0.02  # rad: finer displacements than this cost nothing; sets how steep the weights are
CELL_ROWS = 16  # rows of the coarse grid on which views are compared: cells of 11 degrees
SIGNIFICANT = 3.0  # standard deviations


def toward_photographer(height: int, width: int, to_camera: np.ndarray, distance: float) -> np.ndarray:
    """Softness (H, W) in [0, 1]: 1 where camera or photographer hide the room, given the direction (3,) to the camera.

    The camera is a disc of 0.12 m; the photographer a column 16 degrees to either side, from 10 degrees above it
    down to 12 degrees below the horizon, where the table hides the rest. Edges fade over 2 degrees.
    """
    w = latlong_directions(height, width)
    fade = np.radians(2.0)
    body = np.arcsin(min(1.0, BODY_RADIUS_M / distance))
    disc = _ramp(body - np.arccos(np.clip(w @ to_camera, -1, 1)), fade)
    azimuth = np.arctan2(w[..., 0], w[..., 2]) - np.arctan2(to_camera[0], to_camera[2])
    azimuth = np.abs(np.mod(azimuth + np.pi, 2 * np.pi) - np.pi)
    elevation = np.arcsin(np.clip(w[..., 1], -1, 1))
    top = np.arcsin(np.clip(to_camera[1], -1, 1)) + COLUMN_ABOVE
    column = _ramp(COLUMN_AZIMUTH - azimuth, fade) * _ramp(top - elevation, fade) * _ramp(elevation - COLUMN_FOOT, fade)
    return np.maximum(disc, column)


def _ramp(inside: np.ndarray, fade: float) -> np.ndarray:
    """0 below ``-fade``, 1 above 0, smooth between."""
    t = np.clip(inside / fade + 1, 0, 1)
    return t * t * (3 - 2 * t)


def angular_weight(sine: np.ndarray, sigma_rad: np.ndarray, rim: float) -> np.ndarray:
    """Weight (H, W) of a view from the angular uncertainty of its texels; it fades to nothing at the rim cut."""
    fade = _ramp(np.where(np.isfinite(sine), rim - sine, -1) - 0.04, 0.04)
    return np.where(np.isfinite(sigma_rad), fade / (TEXTURE_SCALE**2 + sigma_rad**2), 0)


def relative_exposure(reference: ViewMap, other: ViewMap) -> tuple[float, float, float]:
    """``other / reference`` in radiance: robust ratio, its relative standard uncertainty, and the median disagreement.

    Compared on cells of 11 degrees that both views see well, weighted by solid angle. Cells are taken as independent;
    NaN where fewer than eight cells are shared.
    """
    shared = np.minimum(_trust(reference), _trust(other))
    height, width = CELL_ROWS, 2 * CELL_ROWS
    area = resize_environment(shared[..., None], height, width)[..., 0]
    means = [resize_environment(view.rgb * shared[..., None], height, width).mean(-1) for view in (reference, other)]
    good = (area > 0.5) & (means[0] > 0) & (means[1] > 0)
    if good.sum() < 8:
        return np.nan, np.nan, np.nan
    logarithm = np.log(means[1][good] / means[0][good])
    weight = latlong_solid_angles(height, width)[good]
    centre = _weighted_median(logarithm, weight)
    spread = 1.4826 * _weighted_median(np.abs(logarithm - centre), weight)
    effective = weight.sum() ** 2 / (weight**2).sum()
    disagreement = _weighted_median(np.abs(logarithm - centre), weight)
    return float(np.exp(centre)), float(1.2533 * spread / np.sqrt(effective)), float(disagreement)


def _trust(view: ViewMap) -> np.ndarray:
    """1 where a view is at least a tenth as good as at its best."""
    return np.asarray(view.weight > 0.1 * view.weight.max(), float)


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def merge(views: list[ViewMap]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted mean of the views: radiance and variance (H, W, 3), zero and infinite where nobody sees; seen (H, W)."""
    weights = np.stack([view.weight for view in views])
    total = weights.sum(0)
    share = weights / np.where(total > 0, total, 1)
    rgb = np.einsum("vhw,vhwc->hwc", share, np.stack([view.rgb for view in views]))
    variance = np.einsum("vhw,vhwc->hwc", share**2, np.stack([view.variance for view in views]))
    variance[total <= 0] = np.inf
    seen = np.einsum("vhw,vhw->hw", share, np.stack([view.coverage for view in views]))
    return rgb, variance, np.clip(seen, 0, 1)


def fill(rgb: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Radiance (H, W, 3) with unknown texels taken from ever wider solid-angle means of known neighbours.

    ``known`` (H, W) in [0, 1]. A pyramid: each level halves the map, gaps take the interpolated coarser one (push-pull,
    Gortler et al., The Lumigraph, 1996). Positive input gives positive output.
    """
    height, width = known.shape
    if height <= 2 or width <= 4 or known.min() >= 1:
        mean = (rgb * known[..., None]).sum((0, 1)) / max(float(known.sum()), 1e-12)
        return known[..., None] * rgb + (1 - known[..., None]) * mean
    small = ((height + 1) // 2, (width + 1) // 2)
    weight = resize_environment(known[..., None], *small)
    coarse = resize_environment(rgb * known[..., None], *small) / np.where(weight > 0, weight, 1)
    coarse = fill(coarse, np.minimum(4 * weight[..., 0], 1))
    return known[..., None] * rgb + (1 - known[..., None]) * _enlarge(coarse, height, width)


def _enlarge(rgb: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear enlargement, periodic in u."""
    row = np.clip((np.arange(height) + 0.5) * rgb.shape[0] / height - 0.5, 0, rgb.shape[0] - 1)
    column = (np.arange(width) + 0.5) * rgb.shape[1] / width - 0.5
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    down, right = (row - top)[:, None, None], (column - left)[None, :, None]
    below = np.minimum(top + 1, rgb.shape[0] - 1)
    tall = rgb[top] * (1 - down) + rgb[below] * down
    return tall[:, left % rgb.shape[1]] * (1 - right) + tall[:, (left + 1) % rgb.shape[1]] * right


def lay_plate(
    rgb: np.ndarray, variance: np.ndarray, seen: np.ndarray, plate: np.ndarray, camera: Camera,
    world_from_camera: np.ndarray, centre: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:  # fmt: skip
    """Directions that meet the plane y = 0 near the ball show the plate's pixel there, not the ball's reflection.

    The ball mirrors its own shadow and contact, and displaces what is a few radii away; the plate shows the same
    plane, taken as diffuse, without it. ``plate`` (h, w, 7): RGB, variance RGB, valid. From 7 degrees down, fully from
    11: within 8 radii of the foot. Returns radiance, variance, seen and the fraction of the sphere that was laid.
    """
    height, width = seen.shape
    w = latlong_directions(height, width)
    down = np.minimum(w[..., 1], -1e-6)
    foot = centre - w * (centre[1] / down)[..., None]
    px = project(camera, transform_points(invert_rigid(world_from_camera), foot).reshape(-1, 3)).reshape(
        height, width, 2
    )
    size = np.array([camera.width, camera.height])
    inside = ((px > 1) & (px < size - 1)).all(-1)
    found = bilinear(planes(plate), np.where(inside, px[..., 0], 0), np.where(inside, px[..., 1], 0))
    share = _ramp(-np.arcsin(w[..., 1]) - np.radians(11.0), np.radians(4.0)) * inside * (found[..., 6] > 0.999)
    mixed = [share[..., None] * found[..., i : i + 3] for i in (0, 3)]
    rest = 1 - share[..., None]
    laid = float((share * latlong_solid_angles(height, width)).sum() / (4 * np.pi))
    return mixed[0] + rest * rgb, share[..., None] * mixed[1] + rest**2 * variance, np.maximum(seen, share), laid


def gradient_per_radian(rgb: np.ndarray) -> np.ndarray:
    """Length (H, W, C) of the radiance gradient on the sphere."""
    height, width = rgb.shape[:2]
    down = np.gradient(rgb, np.pi / height, axis=0)
    across = (np.roll(rgb, -1, 1) - np.roll(rgb, 1, 1)) / (4 * np.pi / width)
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    return np.hypot(down, across / sine)
