"""Merge RAW brackets to radiance before demosaicking, with variance and masks.

Method: per CFA cell black and clip level; noise from DNG NoiseProfile, else measured between the frames (photon
transfer), else assumed with a warning; exposures estimated from the frames with the labels as prior, a tripod view's
against the plate's on what the ball leaves alone; inverse-variance weights (Poisson or with read noise), unbiased at
clip and in the dark; chi-square flags what moved; defective photosites replaced.
pipeline/image/{radiometry,exposure,tripod,noise}.py hold the equations and their sources.

Unit: one per capture, ``(DN - black) / (white - black) * N^2 * 100 / (t * ISO)``, with t as estimated.
Limits: frames of a view are not aligned; their shift is measured and reported. Views that neither stand where the
plate was taken from nor share body and exposure setting with a view that is tied to it are scaled by their labels.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pipeline.conventions import CAMERA_RGB, CLIPPED, DARK, GHOST
from pipeline.image import exposure, noise, radiometry, tripod
from pipeline.image.exposure import Ratio
from pipeline.image.frames import read_samples
from pipeline.image.noise import Noise
from pipeline.image.radiometry import Exposed, Merged
from pipeline.run.artifacts import BRACKETS, EXPOSURES, FACTS, MOSAICS
from pipeline.run.stage import Stage
from pipeline.types import Bracket, Frame, Raster, Result
from stages import knobs

SAMPLE_PIXELS = 2_000_000  # of a frame, for ratios and photon transfer
SHIFT_WARNING_PX = 0.5
LABEL_WARNING = 0.1
LIGHT_WARNING = 0.01  # static scene against shared settings


def compute(facts: dict[str, Any], brackets: dict[str, Bracket], params: knobs.Merge) -> Result:
    """Merged mosaics by view and the exposures of their frames. Raises CaptureError when a file cannot be decoded."""
    root = Path(facts["capture_root"])
    balls = facts.get("ball", [])
    still = {ball["name"] for ball in balls if ball.get("tripod")}
    own = {ball["name"]: json.dumps(ball["camera"], sort_keys=True) for ball in balls if ball.get("camera")}
    own |= {lens["name"]: "fisheye" for lens in facts.get("probe", {}).get("fisheye", [])}
    return merge_brackets(brackets, lambda frame: read_samples(root / frame.file, frame), params, still, own)


def merge_brackets(
    brackets: dict[str, Bracket],
    decode: Callable[[Frame], np.ndarray],
    params: knobs.Merge,
    still: Collection[str] = (),
    own: Mapping[str, str] = MappingProxyType({}),
) -> Result:
    """The stage on mosaics wherever they come from: ``decode(frame)`` gives (H, W) DN.

    ``still``: views taken from where the plate was taken. ``own``: views with another camera than the plate's, and what
    tells it from others: one speed of two bodies is not one exposure.
    """
    workers = os.cpu_count() or 1
    entries = [(view, frame) for view, bracket in sorted(brackets.items()) for frame in _ordered(bracket.frames)]
    views, frames = [view for view, _ in entries], [frame for _, frame in entries]
    with ThreadPoolExecutor(workers) as pool:
        mosaics = list(pool.map(decode, frames))
    warnings: list[str] = []
    models, limits, noise_numbers = _noise_models(views, frames, mosaics, warnings)
    ratios, across = [], []
    if params.estimate_exposures:
        ratios = _ratios(views, frames, mosaics, models, limits)
        across = _ratios_across(views, frames, mosaics, models, limits, still)
    offsets, sigmas = _exposures(views, frames, [*ratios, *across], own, params, warnings)
    exposed = [
        Exposed(
            mosaic, exposure.exposure_of(frame) * float(np.exp(offset)), frame_black(frame), frame.white, limit, model
        )
        for frame, mosaic, offset, limit, model in zip(frames, mosaics, offsets, limits, models)
    ]
    rasters, numbers = {}, {}
    profiles = colour_profiles(brackets, warnings)
    for view in brackets:
        members = [one for one, name in zip(exposed, views) if name == view]
        merged, hot = radiometry.replace_defects(radiometry.merge(members, params.weights, workers))
        rasters[view] = raster_of(merged, next(f for f, name in zip(frames, views) if name == view), profiles[view])
        numbers[view] = _view_numbers(merged, hot, len(members))
        _warn_extremes(view, numbers[view], warnings)
    listing = _exposure_rows(brackets, views, frames, exposed, offsets, sigmas)
    shifts = _shifts(views, exposed)
    evidence = _evidence(models, ratios, across, shifts, numbers, warnings)
    totals = {
        "noise": noise_numbers,
        "ratios_measured": len(ratios),
        "against_plate": _across_numbers(views, frames, across, offsets, warnings),
        "shift_px": max(shifts.values(), default=0.0),
    }
    return Result({"mosaics": rasters, "exposures": listing}, {"views": numbers, **totals}, warnings, evidence)


def _ordered(frames: list[Frame]) -> list[Frame]:
    return sorted(frames, key=lambda frame: (exposure.exposure_of(frame), frame.file))


def frame_black(frame: Frame) -> np.ndarray:
    """(2, 2) black level in DN."""
    return np.broadcast_to(frame.black, (2, 2)).astype(float)


def _sample(mosaic: np.ndarray) -> np.ndarray:
    """Whole CFA rows of a mosaic, few enough for statistics."""
    step = max(1, round(mosaic.size / SAMPLE_PIXELS))
    if step == 1:
        return mosaic
    rows = np.arange(mosaic.shape[0])
    return mosaic[(rows // 2) % step == 0]


def _signal(frame: Frame, mosaic: np.ndarray) -> np.ndarray:
    """(h, W) normalised signal of the sample."""
    blank = Noise(np.zeros((2, 2)), np.zeros((2, 2)), "")
    return Exposed(_sample(mosaic), 1.0, frame_black(frame), frame.white, np.ones((2, 2)), blank).signal()


def _neighbours(views: list[str], frames: list[Frame]) -> list[tuple[int, int]]:
    """Index pairs (longer, shorter) of frames that follow each other in a view."""
    return [(i + 1, i) for i in range(len(frames) - 1) if views[i] == views[i + 1]]


def _noise_models(
    views: list[str], frames: list[Frame], mosaics: list[np.ndarray], warnings: list[str]
) -> tuple[list[Noise], list[np.ndarray], dict[str, Any]]:
    """Noise and linear limit of every frame; frames of one ISO and camera share what is measured."""
    groups: dict[tuple[str, float, float], list[int]] = {}
    for index, frame in enumerate(frames):
        groups.setdefault((frame.camera, frame.iso, frame.white), []).append(index)
    levels, measured = {}, {}
    for key, members in groups.items():
        black = frame_black(frames[members[0]])
        step = 1 / (key[2] - float(black.mean()))
        levels[key] = radiometry.clip_levels([mosaics[i] for i in members], key[2], black)
        found = noise.from_profile(frames[members[0]]) or _transfer(views, frames, mosaics, members, levels[key], step)
        if found is not None:
            measured[key] = found
    models: dict[int, Noise] = {}
    limits: dict[int, np.ndarray] = {}
    numbers: dict[str, Any] = {}
    for key, members in groups.items():
        _, iso, white = key
        black, level = frame_black(frames[members[0]]), levels[key]
        if np.any(level < white):
            warnings.append(f"ISO {iso:g}: frames clip at {level.min():.0f} DN, not at {white:.0f} as metadata say")
        model = measured.get(key) or _borrowed(key, measured, white - float(black.mean()), warnings)
        for i in members:
            models[i] = noise.from_profile(frames[i]) or model
            limits[i] = radiometry.linear_limits(level, black, white, models[i])
        numbers[f"iso_{iso:g}"] = {
            "source": model.source,
            "electrons_at_white": float(1 / model.shot.mean()),
            "read_noise_electrons": float(np.sqrt(model.floor.mean()) / model.shot.mean()),
            "clip_dn": float(level.min()),
        }
    order = range(len(frames))
    return [models[i] for i in order], [limits[i] for i in order], numbers


def _borrowed(
    key: tuple[str, float, float],
    measured: dict[tuple[str, float, float], Noise],
    full_scale_dn: float,
    warnings: list[str],
) -> Noise:
    """Noise of an ISO that could not be measured: scaled from another ISO of the camera, else assumed."""
    camera, iso, _ = key
    others = sorted((other for other in measured if other[0] == camera), key=lambda other: abs(np.log(other[1] / iso)))
    if others:
        gain, source = iso / others[0][1], measured[others[0]]
        warnings.append(
            f"ISO {iso:g}: noise scaled from ISO {others[0][1]:g}, for want of NoiseProfile and frame pairs"
        )
        return Noise(source.shot * gain, source.floor * gain**2, f"scaled from ISO {others[0][1]:g}")
    warnings.append(f"ISO {iso:g}: no NoiseProfile and too few frames to measure; a usual sensor is assumed")
    return noise.assumed(iso, full_scale_dn)


def _transfer(
    views: list[str], frames: list[Frame], mosaics: list[np.ndarray], members: list[int], level: np.ndarray, step: float
) -> Noise | None:
    """Photon transfer over all neighbouring frames of one ISO."""
    bins = []
    for long, short in _neighbours(views, frames):
        if long in members and short in members:
            black = frame_black(frames[long])
            limit = float(((level - black) * step).min()) - 0.02
            a, b = (_signal(frames[i], mosaics[i]).ravel() for i in (long, short))
            label = exposure.exposure_of(frames[short]) / exposure.exposure_of(frames[long])
            rough = (noise.assumed(frames[long].iso, 1 / step),) * 2
            measured = exposure.measure_ratio(a, b, label, limit, rough)
            if measured is not None:
                bins += noise.transfer_bins(a, b, float(np.exp(measured[0])), limit, step)
    return noise.from_transfer(bins, step)


def _ratios(
    views: list[str], frames: list[Frame], mosaics: list[np.ndarray], models: list[Noise], limits: list[np.ndarray]
) -> list[Ratio]:
    """Measured exposure ratios of neighbouring frames."""
    ratios = []
    for long, short in _neighbours(views, frames):
        a, b = (_signal(frames[i], mosaics[i]).ravel() for i in (long, short))
        label = exposure.exposure_of(frames[short]) / exposure.exposure_of(frames[long])
        limit = float(min(limits[long].min(), limits[short].min()))
        found = exposure.measure_ratio(a, b, label, limit, (models[long], models[short]))
        if found is not None:
            ratios.append(Ratio(long, short, *found))
    return ratios


def _ratios_across(
    views: list[str],
    frames: list[Frame],
    mosaics: list[np.ndarray],
    models: list[Noise],
    limits: list[np.ndarray],
    still: Collection[str],
) -> list[Ratio]:
    """Exposure ratios of the plate's frames and the still views' frames."""
    labels = [exposure.exposure_of(frame) for frame in frames]
    members = {view: [i for i, name in enumerate(views) if name == view] for view in sorted({"plate", *still})}
    plates = members.pop("plate")
    wanted = [*plates, *(i for group in members.values() for i in group)] if any(members.values()) else []
    blocks = {i: tripod.blocks_of(_signal(frames[i], mosaics[i]), float(limits[i].min()), models[i]) for i in wanted}
    found = []
    for group in members.values():
        pairs = tripod.measure_views([(labels[i], blocks[i]) for i in plates], [(labels[i], blocks[i]) for i in group])
        found += [Ratio(plates[p], group[b], one.log, one.sigma, one.blocks) for p, b, one in pairs]
    return found


def _across_numbers(
    views: list[str], frames: list[Frame], across: list[Ratio], offsets: np.ndarray, warnings: list[str]
) -> dict[str, dict[str, float]]:
    """Pairs of each still view, and how the static scene's brightness differs from what the exposures explain."""
    numbers: dict[str, dict[str, float]] = {}
    for view in sorted({views[ratio.short] for ratio in across}):
        pairs = [ratio for ratio in across if views[ratio.short] == view]
        left = [
            ratio.log
            - np.log(exposure.exposure_of(frames[ratio.short]) / exposure.exposure_of(frames[ratio.long]))
            - (offsets[ratio.short] - offsets[ratio.long])
            for ratio in pairs
        ]
        numbers[view] = {"pairs": len(pairs), "light_change_rel": float(np.expm1(np.mean(left)))}
        change = numbers[view]["light_change_rel"]
        if abs(change) > LIGHT_WARNING:
            warnings.append(
                f"{view}: the scene is {abs(change):.1%} {'brighter' if change > 0 else 'darker'} than in the plate, "
                "judged by the exposure settings that tie them; the light changed in between"
            )
    return numbers


def _exposures(
    views: list[str], frames: list[Frame], ratios: list[Ratio], own: Mapping[str, str], params: knobs.Merge,
    warnings: list[str],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """ln(estimated / label) and its standard uncertainty, per frame; warns where labels are all there is."""
    if not params.estimate_exposures:
        return np.zeros(len(frames)), np.full(len(frames), exposure.LABEL_SIGMA)
    speeds = [
        (own.get(view, ""), frame.camera, frame.exposure_s, frame.iso, frame.fnumber)
        for view, frame in zip(views, frames)
    ]
    labels = np.array([exposure.exposure_of(frame) for frame in frames])
    offsets, sigmas = exposure.solve_exposures(labels, speeds, ratios)
    measured = {(ratio.long, ratio.short) for ratio in ratios}
    for long, short in _neighbours(views, frames):
        if (long, short) not in measured:
            warnings.append(
                f"{frames[short].file}, {frames[long].file}: no pixels well exposed in both; their ratio is the labels'"
            )
    for i in np.flatnonzero(np.abs(offsets) > LABEL_WARNING):
        warnings.append(f"{frames[i].file}: exposure is {np.exp(offsets[i]):.3f} times its label; the estimate is used")
    groups = exposure.linked_views(views, speeds, ratios)
    linked = set().union(*(group for group in groups if "plate" in group)) if "plate" in views else set(views)
    for view in sorted(set(views) - linked):
        warnings.append(
            f"{view}: neither static scene nor exposure setting ties it to the plate; "
            "its scale rests on labels (about 5 %)"
        )
    return offsets, sigmas


def colour_profiles(brackets: dict[str, Bracket], warnings: list[str]) -> dict[str, dict[str, Any]]:
    """What develop needs to turn camera_rgb into ACEScg, by view: one profile per camera model, from its first frame.

    The plate's comes first: automatic white balance changes AsShotNeutral from frame to frame, and plate and ball must
    not differ by it.
    """
    ordered = sorted(brackets, key=lambda view: view != "plate")
    first: dict[str, Frame] = {}
    for frame in (frame for view in ordered for frame in _ordered(brackets[view].frames)):
        chosen = first.setdefault(frame.camera, frame)
        one, other = frame.as_shot_neutral, chosen.as_shot_neutral
        if one is not None and other is not None and not np.allclose(one, other, rtol=1e-3):
            text = f"white balance differs between frames; that of {chosen.file} is used for all views"
            if text not in warnings:
                warnings.append(text)
    keys = ("camera", "color_matrix", "color_matrix_2", "illuminant", "illuminant_2", "as_shot_neutral")
    keys += ("forward_matrix", "forward_matrix_2")
    optics = {"lens", "focal_mm", "focal_35mm", "fnumber", "vignetting"}
    dumped = {
        camera: {"file": frame.file, **{key: frame.model_dump(mode="json", include=set(keys))[key] for key in keys}}
        for camera, frame in first.items()
    }
    return {
        view: {**dumped[one.frames[0].camera], "optics": one.frames[0].model_dump(mode="json", include=optics)}
        for view, one in brackets.items()
    }


def raster_of(merged: Merged, frame: Frame, profile: dict[str, Any]) -> Raster:
    """The artifact of one view: Y, variance, mask; CFA and colour profile in the header."""
    channels = {"Y": merged.radiance, "variance": merged.variance, "mask": merged.mask}
    return Raster(channels, CAMERA_RGB, {"insitu:cfa": frame.cfa, "insitu:colour": json.dumps(profile)})


def _view_numbers(merged: Merged, hot: int, frames: int) -> dict[str, Any]:
    seen = np.isfinite(merged.variance)
    bright = seen & (merged.mask & DARK == 0)
    snr = merged.radiance[bright] / np.sqrt(merged.variance[bright])
    return {
        "frames": frames,
        "clipped_fraction": float(np.mean(merged.mask & CLIPPED > 0)),
        "dark_fraction": float(np.mean(merged.mask & DARK > 0)),
        "ghost_fraction": float(np.mean(merged.mask & GHOST > 0)),
        "negative_fraction": float(np.mean(merged.radiance < 0)),
        "hot_pixels": hot,
        "median_snr": float(np.median(snr)) if snr.size else 0.0,
        "range_stops": _stops(merged.radiance[bright]),
    }


def _stops(radiance: np.ndarray) -> float:
    """Dynamic range of the seen values, 0.1 to 99.99 %."""
    if radiance.size < 2:
        return 0.0
    low, high = np.percentile(radiance, [0.1, 99.99])
    return float(np.log2(high / low)) if low > 0 else 0.0


def _warn_extremes(view: str, numbers: dict[str, Any], warnings: list[str]) -> None:
    if numbers["clipped_fraction"] > 0.5:
        share = f"{numbers['clipped_fraction']:.0%}"
        warnings.append(f"{view}: {share} of the pixels clip in every frame; add a shorter exposure")
    elif numbers["clipped_fraction"] > 0:
        share = f"{numbers['clipped_fraction']:.3%}"
        warnings.append(f"{view}: {share} of the pixels clip in the shortest frame; their values are lower bounds")
    if numbers["dark_fraction"] > 0.5:
        warnings.append(f"{view}: {numbers['dark_fraction']:.0%} of the pixels lie below noise; add a longer exposure")
    if numbers["ghost_fraction"] > 0.01:
        warnings.append(f"{view}: frames disagree in {numbers['ghost_fraction']:.1%} of the pixels; something moved")


def _exposure_rows(
    brackets: dict[str, Bracket],
    views: list[str],
    frames: list[Frame],
    exposed: list[Exposed],
    offsets: np.ndarray,
    sigmas: np.ndarray,
) -> dict[str, list[dict[str, Any]]]:
    rows: dict[str, list[dict[str, Any]]] = {view: [] for view in brackets}
    for view, frame, one, offset, sigma in zip(views, frames, exposed, offsets, sigmas):
        limit = one.limit * (one.white - one.black) + one.black
        clipped = [np.mean(one.mosaic[r::2, c::2] >= limit[r, c]) for r, c in np.ndindex(2, 2)]
        rows[view].append(
            {
                "file": frame.file,
                "label_s": frame.exposure_s,
                "estimated_s": frame.exposure_s * float(np.exp(offset)),
                "sigma_rel": float(sigma),
                "iso": frame.iso,
                "fnumber": frame.fnumber,
                "clipped_fraction": float(np.mean(clipped)),
            }
        )
    return rows


def _shifts(views: list[str], exposed: list[Exposed]) -> dict[str, float]:
    """Largest measured shift [px] between neighbouring frames of each view; views without structure are left out."""
    shifts: dict[str, float] = {}
    for index in range(len(exposed) - 1):
        if views[index] == views[index + 1]:
            shift = radiometry.measure_shift(exposed[index + 1], exposed[index])
            if shift is not None:
                shifts[views[index]] = max(shifts.get(views[index], 0.0), shift)
    return shifts


def _evidence(
    models: list[Noise],
    ratios: list[Ratio],
    across: list[Ratio],
    shifts: dict[str, float],
    numbers: dict[str, Any],
    warnings: list[str],
) -> list[dict[str, Any]]:
    moved = max(shifts.values(), default=0.0)
    if moved > SHIFT_WARNING_PX:
        warnings.append(f"frames of a view are shifted by up to {moved:.2f} px and are not aligned; use a tripod")
    ghosts = max((n["ghost_fraction"] for n in numbers.values()), default=0.0)
    sources = sorted({model.source for model in models})
    return [
        {
            "term": "noise model",
            "modelled": sources != ["assumed"],
            "because": f"source: {', '.join(sources)}",
            "could_cost": "weights and variances off; radiance stays unbiased",
        },
        {
            "term": "exposure errors",
            "modelled": bool(ratios or across),
            "because": f"{len(ratios)} ratios measured between frames of a view, {len(across)} between plate and ball",
            "could_cost": "up to 7 % between parts of the range that different frames cover",
        },
        {
            "term": "alignment of frames",
            "modelled": False,
            "because": f"largest shift between neighbouring frames {moved:.3f} px"
            if shifts
            else "no structure to measure it",
            "could_cost": f"blur of {moved:.3f} px",
        },
        {
            "term": "motion between frames",
            "modelled": False,
            "because": f"chi-square beyond noise in {ghosts:.3%} of the worst view; flagged, variance raised",
            "could_cost": "a mixture of states in flagged pixels",
        },
    ]


STAGE = Stage(
    "merge",
    compute,
    knobs.Merge,
    inputs={"facts": FACTS, "brackets": BRACKETS},
    outputs={"mosaics": MOSAICS, "exposures": EXPOSURES},
)
