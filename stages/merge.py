"""Merge brackets to radiance before demosaicking, with variance and masks.

Method: black per CFA cell, measured on masked photosites where there are any; clip level and knee of every ISO from the
frames; noise given, from DNG NoiseProfile, or measured between the frames (photon transfer), each with its uncertainty;
exposures estimated from the frames with what the labels mean as prior, a tripod view's against the plate's on what the
ball leaves alone; inverse-variance weights (Poisson or with read noise), unbiased at clip and in the dark; chi-square
flags what moved; defective photosites replaced; the sensor's fixed pattern, which no average over frames removes, added
to the variance. The equations and their sources: pipeline/image, from bracket_noise.py, bracket_exposure.py and
radiometry.py on.

Unit: one per capture, ``(DN - black) / (white - black) * N^2 * 100 / (t * ISO)``, with t as estimated.
Limits: frames of a view are moved whole when they lie a pixel apart, else left (noise and exposures are then estimated
again, from what all of them show); what turns is refused. Views that
neither stand where the plate was taken from nor share body and exposure setting with a view that is tied to it are
scaled by their labels.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from pipeline.conventions import CAMERA_RGB, CHART_VIEW, CLIPPED, DARK, FLAT_VIEW, GHOST
from pipeline.image import (
    alignment,
    bracket_exposure,
    bracket_noise,
    defects,
    exposure,
    fixed_pattern,
    noise,
    optical_black,
    radiometry,
)
from pipeline.image.bracket_exposure import Exposures
from pipeline.image.bracket_noise import Sample, Sensor
from pipeline.image.cells import planes
from pipeline.image.fixed_pattern import FixedPattern
from pipeline.image.frames import is_encoded, read_samples
from pipeline.image.linearise import linearise
from pipeline.image.optical_black import OpticalBlack
from pipeline.image.radiometry import Exposed, Merged
from pipeline.image.raw import read_sensor
from pipeline.run.artifacts import BRACKETS, EXPOSURES, FACTS, MOSAICS
from pipeline.run.evidence import TRIED
from pipeline.run.stage import Stage
from pipeline.types import Bracket, Frame, Raster, Result
from stages import knobs

HELD_BYTES = 2**30  # of decoded photographs kept between their statistics and their merge; the others are read again
NUMBER_SAMPLES = 4_000_000  # of a view, for its middle and its range
SHIFT_WARNING_PX = 0.5  # more than this, and no more than what is mended, is said


@dataclass(frozen=True, eq=False)
class Decoded:
    """Samples of a photograph, (H, W) or (H, W, 3) DN, its black measured on masked photosites, its listed defects."""

    samples: np.ndarray
    black: OpticalBlack | None = None
    defects: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))  # (N, 2) row, column


def compute(facts: dict[str, Any], brackets: dict[str, Bracket], params: knobs.Merge) -> Result:
    """Merged mosaics by view and the exposures of their frames. Raises CaptureError when a file cannot be decoded."""
    root = Path(facts["capture_root"])
    balls = facts.get("ball", [])
    still = {ball["name"] for ball in balls if ball.get("tripod")}
    own = {ball["name"]: json.dumps(ball["camera"], sort_keys=True) for ball in balls if ball.get("camera")}
    own |= {lens["name"]: "fisheye" for lens in facts.get("probe", {}).get("fisheye", [])}

    brackets = {view: taken(bracket, params.frames) for view, bracket in brackets.items()}
    linear = linearise(brackets, lambda frame: read_samples(root / frame.file, frame))

    def decode(frame: Frame) -> Decoded:
        if is_encoded(root / frame.file):
            return Decoded(linear.samples(frame, read_samples(root / frame.file, frame)))
        sensor = read_sensor(root / frame.file, frame)
        listed = [sensor.defects] if frame.bad_pixels is None else [sensor.defects, frame.bad_pixels]
        return Decoded(sensor.samples, sensor.black, np.concatenate(listed))

    return linear.completed(merge_brackets(linear.brackets, decode, params, still, own, facts.get("noise", [])))


def taken(bracket: Bracket, which: Literal["all", "second", "extremes"]) -> Bracket:
    """The bracket with those frames that are merged: all, every second from the shortest, or shortest and longest.

    The shortest always stays: it alone may hold the lamps. Only `insitu trade` should ask for fewer than all.
    """
    frames = bracket.frames
    kept = {"all": frames, "second": frames[::2], "extremes": [*frames[:1], *frames[1:][-1:]]}[which]
    return bracket.model_copy(update={"frames": kept})


def merge_brackets(
    brackets: dict[str, Bracket],
    decode: Callable[[Frame], Decoded],
    params: knobs.Merge,
    still: Collection[str] = (),
    own: Mapping[str, str] = MappingProxyType({}),
    given: Sequence[Mapping[str, Any]] = (),
) -> Result:
    """The stage on photographs wherever they come from. One view at a time is held in memory.

    ``still``: views taken from where the plate was taken. ``own``: views with another camera than the plate's, and what
    tells it from others: one speed of two bodies is not one exposure. ``given``: tables of [[noise]].
    """
    entries = [(view, frame) for view, bracket in sorted(brackets.items()) for frame in _ordered(bracket.frames)]
    views = [view for view, _ in entries]
    photographs = _Photographs([frame for _, frame in entries], decode)
    frames, warnings = photographs.frames, photographs.warnings

    def estimated(samples: list[Sample]) -> tuple[Sensor, Exposures]:
        sensor = bracket_noise.sensor_of(views, samples, given, params.noise)
        if not params.estimate_exposures:
            return sensor, bracket_exposure.by_labels(frames)
        return sensor, bracket_exposure.estimate(views, samples, sensor.models, sensor.limits, still, own)

    sensor, exposures = estimated(photographs.samples)
    found = _merge_views(brackets, views, photographs, sensor, exposures, params)
    if found.moved:  # what was estimated compared pixels that do not show the same
        sensor, exposures = estimated([found.moved.get(i, one) for i, one in enumerate(photographs.samples)])
        found = _merge_views(brackets, views, photographs, sensor, exposures, params)
    merged, numbers, aligned = found.merged, found.numbers, found.aligned
    warnings += [*sensor.warnings, *exposures.warnings]
    profiles = colour_profiles(brackets, warnings)
    for view in brackets:
        _warn_extremes(view, numbers[view], bool(aligned[view][1]["modelled"]), warnings)
    patterns = _add_fixed_patterns(merged, views, frames, sensor)
    for view, pattern in patterns.items():
        numbers[view]["prnu"] = pattern.prnu if pattern.believed else 0.0
        numbers[view]["prnu_sigma"] = pattern.prnu * pattern.sigma if pattern.believed else 0.0
        numbers[view]["prnu_at_most"] = pattern.prnu * (1 + 3 * pattern.sigma * pattern.believed)
    rasters = {view: raster_of(one, frames[views.index(view)], profiles[view]) for view, one in merged.items()}
    totals = {"noise": sensor.numbers, **exposures.numbers, "optical_black": photographs.black_numbers}
    totals |= {"shift_px": max((shift for shift, _ in aligned.values()), default=0.0)}
    evidence = _evidence(sensor, exposures, aligned, numbers, patterns, found.labels, warnings)
    return Result({"mosaics": rasters, "exposures": found.listing}, {"views": numbers, **totals}, warnings, evidence)


@dataclass
class _Views:
    """What came of each view; ``moved``: statistics of frames by index, of views whose frames were moved."""

    merged: dict[str, Merged] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    listing: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    aligned: dict[str, tuple[float, dict[str, Any]]] = field(default_factory=dict)
    labels: dict[str, tuple[float, np.ndarray]] = field(default_factory=dict)
    moved: dict[int, Sample] = field(default_factory=dict)


def _merge_views(
    brackets: Mapping[str, Bracket], views: Sequence[str], photographs: _Photographs, sensor: Sensor,
    exposures: Exposures, params: knobs.Merge,
) -> _Views:  # fmt: skip
    """Every view aligned, merged and mended, one after the other."""
    found, frames, threads = _Views(), photographs.frames, os.cpu_count() or 1
    for view in brackets:
        members = [i for i, name in enumerate(views) if name == view]
        taken = [photographs.exposed(i, sensor, exposures) for i in members]
        exposed, shift, said = alignment.align(taken, [frames[i].file for i in members], params.align)
        merged = radiometry.merge(exposed, params.weights, threads)
        moved = [one is not other for one, other in zip(exposed, taken, strict=True)]
        if any(moved):
            said |= alignment.cost(merged.radiance, radiometry.merge(taken, params.weights, threads).radiance, shift)
            samples = [bracket_noise.sample_of(one.mosaic, frames[i]) for i, one in zip(members, exposed)]
            found.moved |= dict(zip(members, bracket_noise.shown_by_all(samples, moved), strict=True))
        found.aligned[view] = (shift or 0.0, said)
        found.listing[view] = [_exposure_row(frames[i], one, exposures, i) for i, one in zip(members, exposed)]
        if view != CHART_VIEW and not view.startswith(FLAT_VIEW):
            found.labels[view] = _label_cost(merged, exposed, [frames[i] for i in members])
        exposed.clear()
        taken.clear()
        photographs.release(members)
        found.merged[view], hot = _without_defects(merged, photographs.defects(members))
        found.numbers[view] = _view_numbers(found.merged[view], hot, len(members))
    return found


def _ordered(frames: list[Frame]) -> list[Frame]:
    return sorted(frames, key=lambda frame: (exposure.exposure_of(frame), frame.file))


class _Photographs:
    """The capture's photographs: statistics of all, samples of those that fit into HELD_BYTES, the others on demand.

    ``frames`` carry the black that is subtracted: the measured one, where it differs from metadata.
    """

    def __init__(self, frames: Sequence[Frame], decode: Callable[[Frame], Decoded]) -> None:
        self._decode, self._stated = decode, list(frames)
        self._held: dict[int, np.ndarray] = {}
        self.frames, self.warnings = list(frames), list[str]()
        self.samples: list[Sample] = []
        self._defects: list[np.ndarray] = []
        found: list[tuple[str, np.ndarray, OpticalBlack | None]] = []
        size = max((frame.width * frame.height * (2 if frame.cfa else 6) for frame in frames), default=1)
        workers = max(1, min(os.cpu_count() or 1, HELD_BYTES // max(size, 1)))
        room = HELD_BYTES
        with ThreadPoolExecutor(workers) as pool:
            for start in range(0, len(frames), workers):  # in turns, so that no more than these are in memory
                for i, one in enumerate(pool.map(decode, frames[start : start + workers]), start):
                    found.append((frames[i].file, frames[i].black, one.black))
                    if one.black is not None:
                        black = optical_black.chosen(frames[i].black, one.black)
                        self.frames[i] = frames[i].model_copy(update={"black": black})
                    self.samples.append(bracket_noise.sample_of(one.samples, self.frames[i]))
                    self._defects.append(one.defects)
                    if one.samples.nbytes <= room:
                        room -= one.samples.nbytes
                        self._held[i] = one.samples
        self.black_numbers, said = optical_black.report(found)
        self.warnings += said

    def exposed(self, index: int, sensor: Sensor, exposures: Exposures) -> Exposed:
        """One frame, ready to merge."""
        frame, held = self.frames[index], self._held.get(index)
        samples = self._decode(self._stated[index]).samples if held is None else held
        limit, model = sensor.limits[index], sensor.models[index]
        return Exposed(samples, float(exposures.values[index]), frame.black, frame.white, limit, model)

    def defects(self, members: Sequence[int]) -> np.ndarray:
        """Rows and columns (N, 2) of the defects that any of these files lists."""
        return np.unique(np.concatenate([self._defects[i] for i in members]).reshape(-1, 2), axis=0)

    def release(self, members: Sequence[int]) -> None:
        """Forget the samples of these frames."""
        for i in members:
            self._held.pop(i, None)


def _without_defects(merged: Merged, listed: np.ndarray) -> tuple[Merged, int]:
    """Defects replaced, and how many: those listed and, in a mosaic, what stands out of its neighbours.

    Data without a mosaic are interpolated: a defect is no single sample there.
    """
    count = defects.replace_listed(merged.radiance, merged.variance, merged.mask, listed)
    if merged.radiance.ndim == 3:
        return merged, count
    replaced, found = radiometry.replace_defects(merged)
    return replaced, found + count


def _add_fixed_patterns(
    merged: Mapping[str, Merged], views: Sequence[str], frames: Sequence[Frame], sensor: Sensor
) -> dict[str, FixedPattern]:
    """What is known of each view's fixed pattern (PRNU), given or measured; added to the variances, in place.

    One camera has one pattern: views that show no flat part take the most certain of the camera's others.
    """
    found = {}
    cameras = {view: frames[views.index(view)].camera for view in merged}
    for view, one in merged.items():
        model = sensor.models[views.index(view)]
        if model.prnu > 0:
            found[view] = FixedPattern(model.prnu, model.prnu_sigma, 0, True, "given")
        elif (measured := fixed_pattern.measure(one.radiance, one.variance, one.mask)) is not None:
            found[view] = measured
    patterns = {}
    for view, one in merged.items():
        same = [pattern for other, pattern in found.items() if cameras[other] == cameras[view]]
        believed = [found[view]] if view in found and found[view].believed else [one for one in same if one.believed]
        options = believed or same
        if options:
            patterns[view] = min(options, key=lambda pattern: (pattern.sigma, pattern.prnu))
        if believed:
            noise.add_fixed_pattern(one.variance, one.radiance, patterns[view].prnu)
    return patterns


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
    keys = {"camera", "color_matrix", "color_matrix_2", "illuminant", "illuminant_2", "as_shot_neutral"}
    keys |= {"forward_matrix", "forward_matrix_2"}
    optics = {"lens", "focal_mm", "focal_35mm", "fnumber", "vignetting"}
    dumped = {
        camera: {"file": frame.file, **frame.model_dump(mode="json", include=keys)} for camera, frame in first.items()
    }
    return {
        view: {**dumped[one.frames[0].camera], "optics": one.frames[0].model_dump(mode="json", include=optics)}
        for view, one in brackets.items()
    }


def raster_of(merged: Merged, frame: Frame, profile: dict[str, Any]) -> Raster:
    """The artifact of one view: Y, variance, mask; CFA and colour profile in the header.

    Data without a mosaic: R G B, variance.RGB, and one mask, whose bits are those of any channel.
    """
    header = {"insitu:cfa": frame.cfa, "insitu:colour": json.dumps(profile)}
    if frame.cfa:
        channels = {"Y": merged.radiance, "variance": merged.variance, "mask": merged.mask.astype(np.uint32)}
        return Raster(channels, CAMERA_RGB, header)
    channels = Raster.split(merged.radiance) | Raster.split(merged.variance, "variance")
    mask = np.bitwise_or.reduce(merged.mask, -1).astype(np.uint32)
    return Raster({**channels, "mask": mask}, frame.space or CAMERA_RGB, header)


def _view_numbers(merged: Merged, hot: int, frames: int) -> dict[str, Any]:
    """What is written of one view; middle and range of large pictures from evenly spaced rows."""
    rows = slice(None, None, max(1, merged.radiance.size // NUMBER_SAMPLES))
    radiance, variance = merged.radiance[rows], merged.variance[rows]
    bright = np.isfinite(variance) & (merged.mask[rows] & DARK == 0)
    snr = radiance[bright] / np.sqrt(variance[bright])
    return {
        "frames": frames,
        "clipped_fraction": _share(merged.mask, CLIPPED),
        "dark_fraction": _share(merged.mask, DARK),
        "ghost_fraction": _share(merged.mask, GHOST),
        "negative_fraction": np.count_nonzero(merged.radiance < 0) / merged.radiance.size,
        "hot_pixels": hot,
        "hot_limit": _hot_limit(merged),
        "median_snr": float(np.median(snr)) if snr.size else 0.0,
        "range_stops": _stops(radiance[bright]),
    }


def _label_cost(merged: Merged, exposed: Sequence[Exposed], frames: Sequence[Frame]) -> tuple[float, np.ndarray]:
    """`bracket_exposure.label_cost` of a view, large pictures from evenly spaced rows."""
    rows = slice(None, None, max(1, merged.radiance.size // NUMBER_SAMPLES))
    found = np.array([one.exposure for one in exposed])
    clips = np.array([float(np.min(one.limit)) for one in exposed]) / found
    falling = np.argsort(-clips, kind="stable")
    labelled = np.array([exposure.exposure_of(frame) for frame in frames])
    return bracket_exposure.label_cost(merged.radiance[rows], clips[falling], found[falling], labelled[falling])


def _hot_limit(merged: Merged) -> float | None:
    """Share of the signal from which half of all hot photosites are found; None where none are looked for."""
    limit = radiometry.defect_limit(merged) if merged.radiance.ndim == 2 else np.inf
    return limit if np.isfinite(limit) else None


def _share(mask: np.ndarray, bit: int) -> float:
    """Share of the samples that carry a bit."""
    return sum(np.count_nonzero(mask[start : start + 256] & bit) for start in range(0, len(mask), 256)) / mask.size


def _stops(radiance: np.ndarray) -> float:
    """Dynamic range of the seen values, 0.1 to 99.99 %."""
    if radiance.size < 2:
        return 0.0
    low, high = np.percentile(radiance, [0.1, 99.99])
    return float(np.log2(high / low)) if low > 0 else 0.0


def _warn_extremes(view: str, numbers: dict[str, Any], moved: bool, warnings: list[str]) -> None:
    if numbers["clipped_fraction"] > 0.5:
        share = f"{numbers['clipped_fraction']:.0%}"
        warnings.append(f"{view}: {share} of the pixels clip in every frame; add a shorter exposure")
    elif numbers["clipped_fraction"] > 0:
        share = f"{numbers['clipped_fraction']:.3%}"
        warnings.append(f"{view}: {share} of the pixels clip in the shortest frame; their values are lower bounds")
    if numbers["dark_fraction"] > 0.5:
        warnings.append(f"{view}: {numbers['dark_fraction']:.0%} of the pixels lie below noise; add a longer exposure")
    if numbers["ghost_fraction"] > 0.01:
        why = "edges, by what whole cells leave of the shift, or something moved" if moved else "something moved"
        warnings.append(f"{view}: frames disagree in {numbers['ghost_fraction']:.1%} of the pixels; {why}")


def _exposure_row(frame: Frame, one: Exposed, exposures: Exposures, index: int) -> dict[str, Any]:
    """What is written of one frame; ``nominal_s``: the time that its labels mean, the f-number's rounding folded in."""
    limit = np.ravel(one.limit * (one.white - one.black) + one.black)
    clipped = [np.mean(plane >= level) for plane, level in zip(planes(one.mosaic), limit)]
    factor = float(exposures.values[index] / exposure.exposure_of(frame))
    return {
        "file": frame.file,
        "label_s": frame.exposure_s,
        "nominal_s": frame.exposure_s * float(exposures.meant[index] / exposure.exposure_of(frame)),
        "estimated_s": frame.exposure_s * factor,
        "sigma_rel": float(exposures.sigmas[index]),
        "iso": frame.iso,
        "fnumber": frame.fnumber,
        "nd_stops": frame.nd_stops,
        "clipped_fraction": float(np.mean(clipped)),
    }


def _evidence(
    sensor: Sensor,
    exposures: Exposures,
    aligned: Mapping[str, tuple[float, dict[str, Any]]],
    numbers: dict[str, Any],
    patterns: Mapping[str, FixedPattern],
    labels: Mapping[str, tuple[float, np.ndarray]],
    warnings: list[str],
) -> list[dict[str, Any]]:
    for view, (shift, said) in aligned.items():
        if said["modelled"]:
            warnings.append(f"{view}: frames lay up to {shift:.2f} px apart and were moved; use a tripod")
        elif shift > SHIFT_WARNING_PX:
            warnings.append(f"{view}: frames are shifted by up to {shift:.2f} px and are not aligned; use a tripod")
    worst = max(aligned.values(), key=lambda one: (one[1].get("predicted_rel", -1.0), one[0]), default=None)
    ghosts = max((n["ghost_fraction"] for n in numbers.values()), default=0.0)
    sources = sorted({model.source for model in sensor.models})
    knees = sorted({one["linear_to"] for one in sensor.numbers.values() if "linear_to" in one})
    return [
        {
            "term": "noise model",
            "modelled": sources != ["assumed"],
            "because": f"source: {', '.join(sources)}",
            "could_cost": "weights and variances off; radiance stays unbiased",
            "no_bound": "the sensor's noise is nowhere described",
        },
        {
            "term": "knee below the clip level",
            "modelled": bool(knees),
            "because": f"longer frames depart from shorter ones beyond {', '.join(f'{knee:.0%}' for knee in knees)}"
            if knees
            else "no departure of 0.5 % where frames overlap",
            "could_cost": "up to 0.5 % in the last tenths of a frame's range",
            "bound_rel": 0.005,
            **TRIED,
        },
        _pattern_evidence(patterns),
        bracket_exposure.label_evidence(labels, exposures),
        *([] if worst is None else [worst[1]]),
        {
            "term": "motion between frames",
            "modelled": False,
            "because": f"chi-square beyond noise in {ghosts:.3%} of the worst view; flagged, variance raised",
            "could_cost": "a mixture of states in flagged pixels",
            **({"no_bound": "what stood there in either state is not known"} if ghosts else {"bound_rel": 0.0}),
        },
    ]


UNKNOWN_PRNU = 0.01  # of the sensors of cameras, 0.5 to 1 %


def _pattern_evidence(patterns: Mapping[str, FixedPattern]) -> dict[str, Any]:
    """The sensor's fixed pattern: what is known of it, and what not knowing it could cost."""
    known = [pattern for pattern in patterns.values() if pattern.believed]
    if known:
        prnu = known[0].prnu
        because = f"{prnu:.2%} +- {prnu * known[0].sigma:.2%}: {known[0].because}"
        cost = "variance of bright parts"
    elif patterns:
        bound = min(patterns.values(), key=lambda pattern: pattern.prnu)
        prnu, because = bound.prnu, f"at most {bound.prnu:.2%}: {bound.because}"
        cost = f"up to {bound.prnu:.2%} of each bright photosite beyond the stated variance; state prnu in [[noise]]"
    else:
        prnu, because = UNKNOWN_PRNU, "no flat and bright part to measure it"
        cost = "about 0.5 to 1 % of each bright photosite beyond the stated variance; state prnu in [[noise]]"
    return {
        "term": "fixed pattern (PRNU)", "modelled": bool(known), "because": because, "could_cost": cost,
        "bound_rel": float(prnu), **(TRIED if patterns else {}),
    }  # fmt: skip


STAGE = Stage(
    "merge",
    compute,
    knobs.Merge,
    inputs={"facts": FACTS, "brackets": BRACKETS},
    outputs={"mosaics": MOSAICS, "exposures": EXPOSURES},
)
