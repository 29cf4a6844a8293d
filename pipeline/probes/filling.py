"""What no view saw: filled smoothly from around, with the error that such a fill makes where the truth is known.

The gap's own shape is turned about the vertical (else about other axes) onto places that were seen, filled the same
way, and compared with what is there: the map's own angular covariance, as far as it matters for this gap. It gives the
standard error over the distance to the nearest seen texel, and that of the gap's whole light. A lamp is no part of a
smooth prior: trials that uncover one are counted, not averaged.

Source of the fill: push-pull, Gortler et al., The Lumigraph, 1996.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions, latlong_from_direction, latlong_solid_angles
from pipeline.light.environment import resize_environment
from pipeline.run.evidence import ABSENT

TRIAL_ROWS = 64  # rows of the grid on which trials are made: texels of 2.8 degrees
TURNS = 16  # trials about the vertical
TILTS = (45.0, 90.0, 135.0)  # degrees, when the vertical does not give enough
LEAST_TRIALS = 4
CLEAR = 0.9  # of a trial gap that must have been seen
LAMP = 20.0  # times the fill: what a smooth prior cannot mean
DARK = 0.01  # of the map's median: a fill below it is noise, and no measure of an error
BINS = 6


@dataclass(frozen=True)
class Prior:
    """Relative standard error (B,) of the fill at distances (B,) [rad] from the nearest seen texel, ascending.

    ``light_sigma_rel``: of the gap's whole light; ``trials``: gaps it comes from, 0 when too few could
    be tried and the map's contrast stands in; ``lamps``: further trials that uncovered a lamp.
    """

    distance_rad: np.ndarray
    sigma_rel: np.ndarray
    light_sigma_rel: float
    trials: int
    lamps: int


def fill(rgb: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Radiance (H, W, 3) with unknown texels taken from ever wider solid-angle means of known neighbours.

    ``known`` (H, W) in [0, 1]. A pyramid: each level halves the map, gaps take the interpolated coarser one.
    Positive input gives positive output.
    """
    height, width = known.shape
    if height <= 2 or width <= 4 or known.min() >= 1:
        mean = (rgb * known[..., None]).sum((0, 1)) / max(float(known.sum()), 1e-12)
        return known[..., None] * rgb + (1 - known[..., None]) * mean
    small = ((height + 1) // 2, (width + 1) // 2)
    weight = resize_environment(known[..., None], *small)
    coarse = resize_environment(rgb * known[..., None], *small) / np.where(weight > 0, weight, 1)
    coarse = fill(coarse, np.minimum(4 * weight[..., 0], 1))
    return known[..., None] * rgb + (1 - known[..., None]) * enlarge(coarse, height, width)


def enlarge(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear enlargement of a map (h, w, C), periodic in u."""
    row = np.clip((np.arange(height) + 0.5) * values.shape[0] / height - 0.5, 0, values.shape[0] - 1)
    column = (np.arange(width) + 0.5) * values.shape[1] / width - 0.5
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    down, right = (row - top)[:, None, None], (column - left)[None, :, None]
    below = np.minimum(top + 1, values.shape[0] - 1)
    tall = values[top] * (1 - down) + values[below] * down
    return tall[:, left % values.shape[1]] * (1 - right) + tall[:, (left + 1) % values.shape[1]] * right


def prior(rgb: np.ndarray, known: np.ndarray) -> Prior | None:
    """The fill's error, measured on gaps of the same shape in what was seen; None when nothing is missing.

    ``rgb`` (H, W, 3) of any content where ``known`` (H, W) is 0.
    """
    if known.min() >= 1:
        return None
    height = min(TRIAL_ROWS, known.shape[0])
    area = resize_environment(known[..., None], height, 2 * height)
    coarse = resize_environment(rgb * known[..., None], height, 2 * height) / np.where(area > 0, area, 1)
    kept = np.asarray(area[..., 0] > 0.5, float)
    detail = _detail(rgb, known, height)
    distances, errors, light, lamps = _trials(coarse, kept)
    if len(light) < LEAST_TRIALS:
        return _contrast(coarse, kept, detail, lamps)
    distance, error = np.concatenate(distances), np.concatenate(errors)
    edges = np.quantile(distance, np.linspace(0, 1, BINS + 1))
    number = np.clip(np.searchsorted(edges, distance, side="right") - 1, 0, BINS - 1)
    filled = [k for k in range(BINS) if (number == k).any()]
    centres = np.array([distance[number == k].mean() for k in filled])
    variance = np.array([(error[number == k] ** 2).mean() for k in filled])
    variance = np.maximum.accumulate(variance) + detail
    spread = float(np.sqrt(np.mean(np.square(light))))
    return Prior(centres, np.sqrt(variance), spread, len(light), lamps)


def _trials(rgb: np.ndarray, kept: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], int]:
    """Distances (N,) and relative errors (N, 3) of every trial's texels, errors of its light (3,), lamps uncovered."""
    gap, solid = kept < 0.5, latlong_solid_angles(*kept.shape)[..., None]
    distances: list[np.ndarray] = []
    errors, light, lamps = [], [], 0
    floor = np.maximum(DARK * np.median(rgb[~gap], axis=0), 1e-12) if not gap.all() else 1e-12
    for trial in _turned(gap) if gap.any() else ():
        hole = trial & ~gap
        if not hole.any():  # a small gap that, tilted, holds the centre of no cell
            continue
        if (solid[..., 0] * hole).sum() < CLEAR * (solid[..., 0] * trial).sum():
            continue
        guess = fill(rgb, kept * ~trial)[hole]
        relative = (rgb[hole] - guess) / np.maximum(guess, floor)
        if relative.max() > LAMP:
            lamps += 1
            continue
        distances.append(_distance(hole, (kept > 0) & ~trial))
        errors.append(relative)
        weight = solid[hole]
        light.append((weight * (rgb[hole] - guess)).sum(0) / np.maximum((weight * guess).sum(0), 1e-12))
        if len(light) >= TURNS:
            break
    return distances, errors, light, lamps


def _turned(gap: np.ndarray) -> list[np.ndarray]:
    """The gap about the vertical by equal steps, then tilted first; (H, W) bool each."""
    height, width = gap.shape
    turned = [np.roll(gap, round(k * width / TURNS), 1) for k in range(1, TURNS)]
    w = latlong_directions(height, width)
    for tilt in np.radians(TILTS):
        cosine, sine = np.cos(tilt), np.sin(tilt)
        rotation = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
        u, v = latlong_from_direction(w @ rotation.T)
        row = np.minimum((v * height).astype(int), height - 1)
        tilted = gap[row, np.minimum((u * width).astype(int), width - 1)]
        turned += [np.roll(tilted, round(k * width / TURNS), 1) for k in range(TURNS)]
    return turned


def _distance(hole: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Angle [rad] from the texels of ``hole`` (H, W) to the nearest of ``seen`` (H, W), (N,)."""
    from scipy.spatial import cKDTree

    w = latlong_directions(*hole.shape)
    chord, _ = cKDTree(w[seen]).query(w[hole])
    return np.asarray(2 * np.arcsin(np.minimum(0.5 * chord, 1)))


def _detail(rgb: np.ndarray, known: np.ndarray, height: int) -> float:
    """Relative variance of texels inside the cells of the trials' grid, median over the seen cells."""
    if known.shape[0] <= height:
        return 0.0
    grey = rgb.mean(-1)
    area, first, second = np.moveaxis(
        resize_environment(np.stack([known, known * grey, known * grey**2], -1), height, 2 * height), -1, 0
    )
    seen = (area > 0.99) & (first > 0)
    return float(np.median(second[seen] * area[seen] / first[seen] ** 2 - 1)) if seen.any() else 0.0


def _contrast(rgb: np.ndarray, kept: np.ndarray, detail: float, lamps: int) -> Prior:
    """Where no trial fits: what was seen differs this much from its mean (lamps left out)."""
    solid = (latlong_solid_angles(*kept.shape) * kept)[kept > 0]
    seen = rgb[kept > 0]
    if not len(seen):
        return Prior(np.zeros(1), np.ones(1), 1.0, 0, lamps)
    mean = np.average(seen, axis=0, weights=solid)
    plain = (seen < LAMP * mean).all(-1)
    mean = np.average(seen[plain], axis=0, weights=solid[plain])
    variance = float(np.average((seen[plain] / np.maximum(mean, 1e-12) - 1) ** 2, axis=0, weights=solid[plain]).mean())
    return Prior(np.zeros(1), np.array([np.sqrt(variance + detail)]), float(np.sqrt(variance)), 0, lamps)


def filled_variance(filled: np.ndarray, variance: np.ndarray, known: np.ndarray, error: Prior | None) -> np.ndarray:
    """Variance (H, W, 3) of a filled map: the prior's at the distance from what was seen, by the share that was filled.

    ``variance`` is read where ``known`` > 0.
    """
    share = known[..., None]
    measured = np.where(share > 0, variance, 0)
    measured = share**2 * np.where(np.isfinite(measured), measured, filled**2)
    if error is None:
        return np.asarray(measured)
    away = np.zeros(known.shape)
    rows = min(2 * TRIAL_ROWS, known.shape[0])
    seen = resize_environment(known[..., None], rows, 2 * rows)[..., 0] > 0.5
    if seen.any() and not seen.all():
        coarse = np.zeros(seen.shape)
        coarse[~seen] = _distance(~seen, seen)
        away = enlarge(coarse[..., None], *known.shape)[..., 0]
    sigma = np.interp(away, error.distance_rad, error.sigma_rel)[..., None] * np.abs(filled)
    return np.asarray(measured + ((1 - share) * sigma) ** 2)


def report(filled: np.ndarray, known: np.ndarray, error: Prior | None) -> dict[str, float | int]:
    """Figures of what was filled: its share of the sphere and of the light, the light's error, the trials."""
    weight = latlong_solid_angles(*known.shape)
    light = filled.mean(-1) * weight
    share = float(((1 - known) * light).sum() / max(float(light.sum()), 1e-300))
    return {
        "filled_fraction": float(((1 - known) * weight).sum() / (4 * np.pi)),
        "filled_light_rel": share,
        "filled_light_sigma_rel": share * (error.light_sigma_rel if error else 0.0),
        "filled_sigma_rel_at_edge": float(error.sigma_rel[0]) if error else 0.0,
        "filled_sigma_rel_deepest": float(error.sigma_rel[-1]) if error else 0.0,
        "filled_trials": error.trials if error else 0,
        "filled_trials_with_lamp": error.lamps if error else 0,
    }


def reason(figures: dict[str, float | int], error: Prior | None) -> dict[str, Any]:
    """Whether anything was filled, and what that can cost."""
    if error is None:
        because, cost = "every direction was seen", "nothing"
    else:
        source = (
            f"error from {error.trials} gaps of the same shape in what was seen"
            if error.trials
            else "too few gaps of its shape could be tried: the map's own contrast is its error"
        )
        because = f"{figures['filled_fraction']:.2%} of the sphere was not seen; {source}"
        chance = f"; {error.lamps} further trials uncovered a lamp" if error.lamps else ""
        cost = f"{figures['filled_light_sigma_rel']:.2%} of the light (1 sigma), a lamp hidden there apart{chance}"
    return {
        "term": "smooth prior where nobody saw", "modelled": error is not None, "because": because, "could_cost": cost,
        **(ABSENT if error is None else {"bound_rel": 2 * float(figures["filled_light_sigma_rel"])}),
    }  # fmt: skip
