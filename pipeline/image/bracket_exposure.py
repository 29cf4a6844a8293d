"""Exposures of all frames of a capture together: ratios within views, ratios between views, labels, and who disagrees.

Measured ratios come from neighbouring frames of a view, and from what plate and tripod views share; what the labels
mean is chosen per camera; pipeline/image/exposure.py solves for all.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import CHART_VIEW, FLAT_VIEW
from pipeline.image import computational, exposure, labels, tripod
from pipeline.image.bracket_noise import Sample, neighbours
from pipeline.image.cells import planes
from pipeline.image.exposure import REPORTED, Ratio
from pipeline.image.noise import Noise
from pipeline.types import Frame

LIGHT_WARNING = 0.01  # static scene against shared settings
CLEAR_OF_LIMIT = 0.95


@dataclass(frozen=True, eq=False)
class Exposures:
    """Relative exposure (F,) of every frame, what its labels mean (F,), and the first's relative uncertainty (F,).

    ``ratios`` within views, ``across`` plate and still views; numbers and warnings of how they came.
    """

    values: np.ndarray
    meant: np.ndarray
    sigmas: np.ndarray
    ratios: list[Ratio]
    across: list[Ratio]
    numbers: dict[str, Any]
    warnings: list[str]


def by_labels(frames: Sequence[Frame]) -> Exposures:
    """The labels at their word."""
    values = np.array([exposure.exposure_of(frame) for frame in frames])
    return Exposures(values, values, np.full(len(values), exposure.LABEL_SIGMA), [], [], {}, [])


def label_cost(
    radiance: np.ndarray, clips: np.ndarray, found: np.ndarray, labelled: np.ndarray
) -> tuple[float, np.ndarray]:
    """What a view would be, labels at their word, over what it is: of its light together, and of each band (F,) of it.

    ``radiance``: merged samples. ``clips`` (F,): radiance at which each frame clips, falling; ``found``, ``labelled``
    (F,): exposures as estimated and by labels. Band i lies below the clip of frame i and above that of frame i + 1, so
    frames 0 to i hold it: by photon noise all their charge over all their exposure. A band without light is NaN.
    """
    level = np.maximum(np.nan_to_num(radiance, nan=0.0, posinf=0.0), 0).ravel()
    band = np.searchsorted(-clips, -level, side="left")  # how many frames clip above this level
    light = np.bincount(np.clip(band - 1, 0, None), level, len(clips))
    each = np.cumsum(found) / np.cumsum(labelled)
    whole = light @ each / light.sum() if light.any() else each[-1]
    return float(whole), np.where(light > 0, each, np.nan)


def label_evidence(costs: Mapping[str, tuple[float, np.ndarray]], exposures: Exposures) -> dict[str, Any]:
    """Whether exposures are estimated, and what the labels' errors would do: ``costs`` of every view by `label_cost`.

    Views are compared with the plate: what all have in common is the capture's unit, and costs nothing.
    """
    term = {
        "term": "exposure errors",
        "modelled": bool(exposures.ratios or exposures.across),
        "because": f"{len(exposures.ratios)} ratios measured between frames of a view, {len(exposures.across)} between "
        "plate and ball",
    }
    unit = costs["plate"][0] if "plate" in costs else 1.0
    if not term["modelled"] or not unit > 0:
        return {
            **term,
            "could_cost": "up to 7 % between parts of the range that different frames cover: labels round",
            "bound_rel": 0.07,
        }
    whole = {view: abs(factor / unit - 1) for view, (factor, _) in costs.items()}
    bands = {view: float(np.nanmax(np.abs(each / unit - 1), initial=0.0)) for view, (_, each) in costs.items()}
    view, band = (max(some, key=some.__getitem__, default="plate") for some in (whole, bands))
    one, other = whole.get(view, 0.0), bands.get(band, 0.0)
    cost = f"{one:.1%} of the light of {view} against the plate, {other:.1%} of what only some frames of {band} hold"
    return {**term, "could_cost": cost, "predicted_rel": one, "bound_rel": other}


def estimate(
    views: Sequence[str],
    samples: Sequence[Sample],
    models: Sequence[Noise],
    limits: Sequence[np.ndarray],
    still: Collection[str] = (),
    own: Mapping[str, str] | None = None,
) -> Exposures:
    """Exposures of frames sorted by view, each from the shortest; arguments as in stages/merge.py."""
    frames = [sample.frame for sample in samples]
    bodies = [(own or {}).get(view, "") for view in views]
    warnings: list[str] = []
    ratios = _ratios(views, samples, models, limits, warnings)
    across = _across(views, samples, models, limits, still)
    meant, ladders = _meant(frames, bodies, ratios)
    settings = [exposure.setting_of(frame, body) for frame, body in zip(frames, bodies)]
    found = exposure.solve_exposures(meant, settings, [*ratios, *across])
    _warn_gaps(views, frames, ratios, warnings)
    _warn_pulls(frames, settings, meant, found, warnings)
    _warn_links(views, settings, [*ratios, *across], warnings)
    numbers = {
        "ratios_measured": len(ratios),
        "labels": ladders,
        "against_plate": _against_plate(views, meant, across, found.offsets, warnings),
        "largest_label_error": float(np.expm1(np.abs(found.offsets).max(initial=0.0))),
        "largest_sigma": float(found.sigmas.max(initial=0.0)),
    }
    return Exposures(meant * np.exp(found.offsets), meant, found.sigmas, ratios, across, numbers, warnings)


def _ratios(
    views: Sequence[str],
    samples: Sequence[Sample],
    models: Sequence[Noise],
    limits: Sequence[np.ndarray],
    warnings: list[str],
) -> list[Ratio]:
    """Measured ratios of neighbours in a view; of the next but one where neighbours share no well exposed pixels."""
    found: list[Ratio] = []
    for long, short in neighbours(views):
        options = [short, short - 1] if short > 0 and views[short - 1] == views[short] else [short]
        for other in options:
            a, b = samples[long].signal(), samples[other].signal()
            if a.shape != b.shape:
                break
            label = exposure.exposure_of(samples[other].frame) / exposure.exposure_of(samples[long].frame)
            limit = float(min(limits[long].min(), limits[other].min()))
            one = exposure.measure_ratio(a.ravel(), b.ravel(), label, limit, (models[long], models[other]))
            if one is not None:
                found.append(Ratio(long, other, *one))
                _judge(samples[long].frame, samples[other].frame, a, b, limit, label, float(np.exp(one[0])), warnings)
                break
    return found


def _judge(
    long: Frame,
    short: Frame,
    a: np.ndarray,
    b: np.ndarray,
    limit: float,
    label: float,
    ratio: float,
    warnings: list[str],
) -> None:
    """Warn of frames that are not one sensor's at two exposures, and of a filter that is not neutral."""
    levels, logs, sigmas = computational.groups_of(a, b, CLEAR_OF_LIMIT * limit, ratio)
    if why := computational.not_proportional(levels, logs, sigmas, float(np.log(label))):
        warnings.append(f"{short.file}, {long.file}: {why}")
    if long.nd_stops == short.nd_stops:
        return
    clear = [(x < CLEAR_OF_LIMIT * limit) & (y < CLEAR_OF_LIMIT * limit) for x, y in zip(planes(a), planes(b))]
    sums = [(x[use].sum(), y[use].sum()) for x, y, use in zip(planes(a), planes(b), clear)]
    colours = [float(np.log(y / x)) for x, y in sums if x > 0 and y > 0]
    if len(colours) > 1 and np.ptp(colours) > LIGHT_WARNING:
        warnings.append(
            f"{short.file}, {long.file}: the filter is not neutral, its colours differ by "
            f"{np.expm1(np.ptp(colours)):.1%}; one factor is used for all"
        )


def _across(
    views: Sequence[str],
    samples: Sequence[Sample],
    models: Sequence[Noise],
    limits: Sequence[np.ndarray],
    still: Collection[str],
) -> list[Ratio]:
    """Exposure ratios of the plate's frames and the still views' frames."""
    members = {view: [i for i, name in enumerate(views) if name == view] for view in sorted({"plate", *still})}
    plates = members.pop("plate")
    wanted = [*plates, *(i for group in members.values() for i in group)] if any(members.values()) else []
    brightness = [exposure.exposure_of(sample.frame) for sample in samples]
    blocks = {i: samples[i].blocks(float(limits[i].min()), models[i]) for i in wanted}
    found = []
    for group in members.values():
        pairs = tripod.measure_views(
            [(brightness[i], blocks[i]) for i in plates], [(brightness[i], blocks[i]) for i in group]
        )
        found += [Ratio(plates[p], group[b], one.log, one.sigma, one.blocks) for p, b, one in pairs]
    return found


def _meant(
    frames: Sequence[Frame], bodies: Sequence[str], ratios: Sequence[Ratio]
) -> tuple[np.ndarray, dict[str, str]]:
    """Relative exposures (F,) that the labels mean, and by camera on which ladder they are and why."""
    meant = np.zeros(len(frames))
    names: dict[str, str] = {}
    cameras = [(frame.camera, body) for frame, body in zip(frames, bodies)]
    for camera in sorted(set(cameras)):
        members = [i for i, one in enumerate(cameras) if one == camera]
        place = {i: n for n, i in enumerate(members)}
        own = [(place[r.long], place[r.short], r.log) for r in ratios if r.long in place and r.short in place]
        ladder, why = labels.choose_ladder([frames[i] for i in members], own)
        for i in members:
            meant[i] = labels.exposure_meant(frames[i], ladder)
        names[camera[0] or "camera"] = f"{ladder}: {why}"
    return meant, names


def _warn_gaps(views: Sequence[str], frames: Sequence[Frame], ratios: Sequence[Ratio], warnings: list[str]) -> None:
    reached = {ratio.long for ratio in ratios}
    for long, short in neighbours(views):
        if long not in reached:
            warnings.append(
                f"{frames[short].file}, {frames[long].file}: no pixels well exposed in both; their ratio is the labels'"
            )


def _warn_pulls(
    frames: Sequence[Frame],
    settings: Sequence[exposure.Setting],
    meant: np.ndarray,
    found: exposure.Solution,
    warnings: list[str],
) -> None:
    """Frames whose exposure is not what their label means, or not that of the others of their setting."""
    for i, frame in enumerate(frames):
        if abs(found.label_pulls[i]) > REPORTED:
            factor = meant[i] * np.exp(found.offsets[i]) / exposure.exposure_of(frame)
            warnings.append(
                f"{frame.file}: exposure is {factor:.3f} times its label "
                f"({abs(found.label_pulls[i]):.1f} sigma); the estimate is used"
            )
        elif settings.count(settings[i]) > 1 and abs(found.tie_pulls[i]) > REPORTED:
            warnings.append(
                f"{frame.file}: exposure differs from that of other frames of its setting by "
                f"{abs(found.tie_pulls[i]):.1f} sigma; shutter or light is not steady, the estimate is used"
            )


def _warn_links(
    views: Sequence[str], settings: Sequence[exposure.Setting], ratios: Sequence[Ratio], warnings: list[str]
) -> None:
    groups = exposure.linked_views(list(views), settings, ratios)
    linked = set().union(*(group for group in groups if "plate" in group)) if "plate" in views else set(views)
    for view in sorted(set(views) - linked):
        if view == CHART_VIEW or view.startswith(FLAT_VIEW):
            continue
        warnings.append(
            f"{view}: neither static scene nor exposure setting ties it to the plate; "
            f"its scale rests on labels (about {exposure.LABEL_SIGMA:.0%})"
        )


def _against_plate(
    views: Sequence[str], meant: np.ndarray, across: Sequence[Ratio], offsets: np.ndarray, warnings: list[str]
) -> dict[str, dict[str, float]]:
    """Pairs of each still view, and how the static scene's brightness differs from what the exposures explain."""
    numbers: dict[str, dict[str, float]] = {}
    logs = np.log(meant) + offsets
    for view in sorted({views[ratio.short] for ratio in across}):
        pairs = [ratio for ratio in across if views[ratio.short] == view]
        change = float(np.expm1(np.mean([ratio.log - (logs[ratio.short] - logs[ratio.long]) for ratio in pairs])))
        numbers[view] = {"pairs": len(pairs), "light_change_rel": change}
        if abs(change) > LIGHT_WARNING:
            warnings.append(
                f"{view}: the scene is {abs(change):.1%} {'brighter' if change > 0 else 'darker'} than in the plate, "
                "judged by the exposure settings that tie them; the light changed in between"
            )
    return numbers
