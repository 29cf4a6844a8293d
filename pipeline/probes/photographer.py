"""Camera and photographer in the views of a probe: their direction is known, whether they show is measured.

Who moved round for a view was not there for the plate; who stood at the tripod was, and lights it. Where a moved view
differs from the others in his direction, more than views differ elsewhere, the others answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import resize_environment
from pipeline.probes.combine import ramp, sum_of
from pipeline.probes.filling import enlarge
from pipeline.probes.levelling import LEAST_CELLS, trust
from pipeline.probes.observation import ViewMap

MOVED_WEIGHT = 1e-3  # another view wins wherever it sees; alone, the view still answers
BODY_RADIUS_M, COLUMN_AZIMUTH, COLUMN_ABOVE, COLUMN_FOOT = 0.12, np.radians(16.0), np.radians(10.0), np.radians(-12.0)
BODY_ROWS = 32  # rows of the grid on which a person is looked for: cells of 6 degrees
REACH = np.radians(40.0)  # of azimuth, from the direction of the camera: beyond, it is no person
LEAST_DIFFERENCE, DIFFERENCE = 0.1, 4.0  # of log ratio, and in medians of it: what belongs to a person
LAMP = 5.0  # times the median
SUSPICIOUS = 2.0  # standard deviations: to remove who was not there costs next to nothing


def toward_photographer(height: int, width: int, to_camera: np.ndarray, distance: float) -> np.ndarray:
    """Softness (H, W) in [0, 1]: 1 where camera or photographer hide the room, given the direction (3,) to the camera.

    The camera is a disc of 0.12 m; the photographer a column 16 degrees to either side, from 10 degrees above it
    down to 12 degrees below the horizon, where the table hides the rest. Edges fade over 2 degrees.
    """
    w = latlong_directions(height, width)
    fade = np.radians(2.0)
    body = np.arcsin(min(1.0, BODY_RADIUS_M / distance))
    disc = ramp(body - np.arccos(np.clip(w @ to_camera, -1, 1)), fade)
    azimuth = np.arctan2(w[..., 0], w[..., 2]) - np.arctan2(to_camera[0], to_camera[2])
    azimuth = np.abs(np.mod(azimuth + np.pi, 2 * np.pi) - np.pi)
    elevation = np.arcsin(np.clip(w[..., 1], -1, 1))
    top = np.arcsin(np.clip(to_camera[1], -1, 1)) + COLUMN_ABOVE
    column = ramp(COLUMN_AZIMUTH - azimuth, fade) * ramp(top - elevation, fade) * ramp(elevation - COLUMN_FOOT, fade)
    return np.maximum(disc, column)


def shade(
    maps: dict[str, ViewMap], to_camera: dict[str, np.ndarray], tripod: set[str]
) -> tuple[dict[str, ViewMap], dict[str, dict[str, Any]]]:
    """The maps with moved views' weights lowered where they show their own photographer, or lack the tripod's.

    ``to_camera``: from the probe to each view's camera [m], world frame. Figures by view: excess of the residual in
    standard deviations, and whether he was removed. A view that no other one checks keeps its weight.
    """
    hidden = {}
    for name, view in maps.items():
        distance = float(np.linalg.norm(to_camera[name]))
        height, width = view.weight.shape
        hidden[name] = toward_photographer(height, width, to_camera[name] / distance, distance)
    result, figures = dict(maps), {}
    for name in [name for name in maps if name not in tripod] if len(maps) > 1 else ():
        others = {"own": [maps[other] for other in maps if other != name]}
        others |= {"tripod": [maps[other] for other in maps if other in tripod]}
        masks = {
            "own": hidden[name],
            "tripod": np.max([hidden[t] for t in maps if t in tripod] or [0 * hidden[name]], 0),
        }
        entry: dict[str, Any] = {}
        shaded = np.zeros(hidden[name].shape)
        for whose in masks:
            if not others[whose]:
                continue
            found = person(maps[name], others[whose], masks[whose])
            entry[f"{whose}_photographer_residual_rel"], entry[f"{whose}_photographer_z"] = found.residual, found.z
            entry[f"{whose}_photographer_removed"] = removed = bool(found.z > SUSPICIOUS)
            if removed:
                shaded = np.maximum(shaded, found.outline)
        figures[name] = entry
        result[name] = replace(maps[name], weight=maps[name].weight * (1 - (1 - MOVED_WEIGHT) * shaded))
    return result, figures


def reason(figures: dict[str, dict[str, Any]], views: int) -> dict[str, Any]:
    """Whether anyone was removed, and on what evidence."""
    found = {f"{name} ({whose})": entry.get(f"{whose}_photographer_z", np.nan)
             for name, entry in figures.items() for whose in ("own", "tripod")}  # fmt: skip
    measured = {name: z for name, z in found.items() if np.isfinite(z)}
    if views < 2:
        because = "one view only: nothing to tell him from the room, nor to see the room behind him"
    elif not measured:
        because = "no other view sees where he stood"
    else:
        listed = ", ".join(f"{name} {z:.1f}" for name, z in measured.items())
        because = f"residual of views in his direction over that elsewhere, in sigma: {listed}; {SUSPICIOUS:g} counts"
    return {
        "term": "moved photographer removed, the tripod's kept",
        "modelled": any(z > SUSPICIOUS for z in measured.values()),
        "because": because,
        "could_cost": "one person's solid angle of wrong light",
        "no_bound": "how bright he was against what he hid is not known",
    }


@dataclass(frozen=True)
class Person:
    """How much views differ where someone must have stood, that over the differences elsewhere, and his outline.

    ``residual``: mean absolute log ratio; ``z``: standard deviations, NaN where the views cannot be compared;
    ``outline`` (H, W) in [0, 1]: the given mask and what differs beside it.
    """

    residual: float
    z: float
    outline: np.ndarray


def person(view: ViewMap, others: list[ViewMap], hidden: np.ndarray) -> Person:
    """Whether ``view`` differs from ``others`` in the directions ``hidden`` (H, W) in [0, 1], and where exactly.

    The same figure of the mask turned about the vertical says what errors of direction, parallax and noise amount to
    (median, and median absolute deviation for the spread).
    """
    height, width = BODY_ROWS, 2 * BODY_ROWS
    ratio, good, lamp = _log_ratio(view, others, height, width)
    mask = resize_environment(hidden[..., None], height, width)[..., 0]
    weight = latlong_solid_angles(height, width) * good
    turned = [np.roll(mask, step, 1) for step in range(width)]
    usable = np.array([float((t * weight).sum()) for t in turned])
    figure = np.array([float((t * weight * ratio).sum()) for t in turned]) / np.maximum(usable, 1e-12)
    apart = np.array([float((mask * t).sum()) < 0.1 * float((mask * mask).sum()) for t in turned])
    null = figure[apart & (usable > 0.5 * usable.max())]
    if usable.max() <= 0 or usable[0] < 0.2 * usable.max() or len(null) < LEAST_CELLS:
        return Person(np.nan, np.nan, hidden)
    spread = 1.4826 * float(np.median(np.abs(null - np.median(null))))
    z = float((figure[0] - np.median(null)) / max(spread, 1e-6))
    return Person(float(figure[0]), z, np.maximum(hidden, _beside(ratio, good, lamp, mask, hidden.shape)))


def _log_ratio(
    view: ViewMap, others: list[ViewMap], height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Absolute log ratio of cells of a view to the mean of the others, less its median; cells both see; lamps."""
    seen = np.stack([trust(one) for one in [view, *others]])
    both = seen[0] * seen[1:].max(0)
    share = seen[1:] / np.maximum(seen[1:].sum(0), 1)
    rest = sum_of(share, [one.rgb for one in others])
    area = resize_environment(both[..., None], height, width)[..., 0]
    means = [resize_environment(rgb * both[..., None], height, width).mean(-1) for rgb in (view.rgb, rest)]
    good = (area > 0.5) & (means[0] > 0) & (means[1] > 0)
    ratio = np.zeros(good.shape)
    ratio[good] = np.log(means[0][good] / means[1][good])
    ratio[good] = np.abs(ratio[good] - np.median(ratio[good])) if good.any() else 0
    bright = np.maximum(*means)
    return ratio, good, good & (bright > LAMP * np.median(bright[good])) if good.any() else good


def _beside(
    ratio: np.ndarray, good: np.ndarray, lamp: np.ndarray, mask: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Cells near the mask that differ and join it, widened by a cell: people are broader than columns. (H, W).

    Lamps differ by the least error of direction and would be cut by an outline that ran through them: left out.
    """
    from scipy.ndimage import binary_dilation, label

    width = mask.shape[1]
    weight = mask * latlong_solid_angles(*mask.shape)
    azimuth = np.angle((weight.sum(0) * np.exp(2j * np.pi * np.arange(width) / width)).sum())
    shift = width // 2 - round(azimuth / (2 * np.pi) * width)
    away = np.abs(np.arange(width) - width // 2) * 2 * np.pi / width
    level = max(LEAST_DIFFERENCE, DIFFERENCE * float(np.median(ratio[good])))
    differs = (np.roll((ratio > level) & good & ~lamp, shift, 1)) & (away < REACH)
    core = np.roll(mask > 0.3, shift, 1)
    parts, _ = label(differs | core, np.ones((3, 3)))
    joined = np.isin(parts, np.setdiff1d(np.unique(parts[core]), [0]))
    grown = np.roll(binary_dilation(joined & (differs | core)), -shift, 1) & ~binary_dilation(lamp)
    return enlarge(np.asarray(grown, float)[..., None], *shape)[..., 0]
