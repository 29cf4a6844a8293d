"""Noise and linear range of every frame of a capture: what is stated, what the brackets show, and whether they agree.

Frames of one camera, ISO and white level share a model. In this order it is given ([[noise]]), stated by the file
(NoiseProfile), measured on the bracket (photon transfer), scaled from another ISO of the camera, or assumed; every
choice but the first three warns. Whatever is stated is compared with what is measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from pipeline.image import exposure, linearity, noise, photon_transfer, radiometry, tripod
from pipeline.image.cells import per_sample, planes
from pipeline.image.noise import Noise
from pipeline.types import Frame

SAMPLE_PIXELS = 2_000_000  # of a frame, for statistics
FEW = 300_000  # of a sample, for a ratio that is not the last word
BELOW_KNEE = 0.5  # of the clip level: ratios that a knee is judged by
DISAGREE = 3.0  # standard uncertainties
Key = tuple[str, float, float]  # camera, ISO, white


@dataclass(frozen=True, eq=False)
class Sample:
    """What statistics need of a photograph: whole rows of cells (h, W) or (h, W, 3) DN, and blocks of all of it."""

    frame: Frame
    rows: np.ndarray
    block_mean: np.ndarray  # normalised
    block_top: np.ndarray
    block_side: int
    moved: bool = False  # onto the others of its view: what whole cells leave of a shift looks like noise

    def signal(self) -> np.ndarray:
        """Normalised signal of the rows, float32."""
        return normalised(self.rows, self.frame)

    def blocks(self, limit: float, model: Noise) -> tripod.Blocks:
        """Blocks of the whole photograph."""
        return tripod.blocks_from(self.block_mean, self.block_top, self.block_side, limit, model)


@dataclass(frozen=True, eq=False)
class Sensor:
    """Noise and linear limit (per cell or channel, normalised) of each frame; numbers and warnings of how they came."""

    models: list[Noise]
    limits: list[np.ndarray]
    numbers: dict[str, Any]
    warnings: list[str]


def normalised(values: np.ndarray, frame: Frame) -> np.ndarray:
    """``(DN - black) / (white - black)``, float32, of rows that start on a whole cell."""
    scale = 1 / (frame.white - frame.black)
    return (values - per_sample(frame.black, values)) * per_sample(scale, values)


def sample_of(samples: np.ndarray, frame: Frame) -> Sample:
    """Keep few enough rows of (H, W) or (H, W, 3) DN, and the blocks; the photograph itself can be forgotten."""
    step = max(1, round(samples.shape[0] * samples.shape[1] / SAMPLE_PIXELS))
    rows = samples if step == 1 else samples[(np.arange(samples.shape[0]) // 2) % step == 0]
    mean, top, side = tripod.block_means(samples)
    black, scale = float(frame.black.mean()), 1 / (frame.white - float(frame.black.mean()))
    return Sample(frame, rows, (mean - black) * scale, (top - black) * scale, side)


def shown_by_all(samples: Sequence[Sample], moved: Sequence[bool]) -> list[Sample]:
    """Samples of a view of which some were ``moved`` by whole cells, rows cut to the rectangle in which none is NaN."""
    shown = np.logical_and.reduce([np.isfinite(one.rows).reshape(*one.rows.shape[:2], -1).all(-1) for one in samples])
    lines, columns = shown.any(1), shown.any(0)
    return [replace(one, rows=one.rows[lines][:, columns], moved=was) for one, was in zip(samples, moved, strict=True)]


def neighbours(views: Sequence[str]) -> list[tuple[int, int]]:
    """Index pairs (longer, shorter) of frames that follow each other in a view, sorted from the shortest."""
    return [(i + 1, i) for i in range(len(views) - 1) if views[i] == views[i + 1]]


def sensor_of(
    views: Sequence[str],
    samples: Sequence[Sample],
    given: Sequence[Mapping[str, Any]] = (),
    prefer: Literal["stated", "measured"] = "stated",
) -> Sensor:
    """Noise and linear limits; ``prefer`` decides where what is stated and what the frames show are both there."""
    warnings: list[str] = []
    groups: dict[Key, list[int]] = {}
    for index, sample in enumerate(samples):
        groups.setdefault(_key(sample.frame), []).append(index)
    levels = {key: _clip_level([samples[i] for i in members]) for key, members in groups.items()}
    pairs = [_Pair.of(samples, levels, *pair) for pair in neighbours(views)]
    measured = {key: _transfer(_still([one for one in pairs if one and one.keys == (key, key)])) for key in groups}
    chosen, stated = {}, {}
    for key, members in groups.items():
        frame = samples[members[0]].frame
        stated[key] = noise.from_facts(frame, given) or noise.from_profile(frame)
        options = [stated[key], measured[key]] if prefer == "stated" else [measured[key], stated[key]]
        chosen[key] = next((one for one in options if one is not None), None)
    models, limits = dict[int, Noise](), dict[int, np.ndarray]()
    numbers: dict[str, Any] = {}
    for key, members in groups.items():
        frame = samples[members[0]].frame
        model = chosen[key] or _without(key, frame, chosen, pairs, warnings)
        knee = linearity.knee_of([one.linearity(model) for one in pairs if one and one.keys[0] == key])
        for i in members:
            own = noise.from_profile(samples[i].frame) if model.source == "NoiseProfile" else None
            models[i] = own or model
            limits[i] = _limit(levels[key], samples[i].frame, models[i], knee)
        numbers[_name(key, groups)] = _report(
            key, frame, model, stated[key], measured[key], levels[key], knee, warnings
        )
    order = range(len(samples))
    return Sensor([models[i] for i in order], [limits[i] for i in order], numbers, warnings)


def _key(frame: Frame) -> Key:
    return frame.camera, frame.iso, frame.white


def _name(key: Key, groups: Mapping[Key, Any]) -> str:
    """Key of the numbers: the ISO alone where the capture has one camera."""
    several = len({(camera, white) for camera, _, white in groups}) > 1
    return f"iso_{key[1]:g}" + (f" {key[0]} {key[2]:g}" if several else "")


def _clip_level(samples: Sequence[Sample]) -> np.ndarray:
    """DN at which the samples of each cell or channel clip, as the frames of one camera and ISO show it."""
    frame, rows = samples[0].frame, [one.rows for one in samples]
    if frame.cfa:
        return radiometry.clip_levels(rows, frame.white, frame.black)
    channels = [
        radiometry.clip_levels([one[..., c] for one in rows], frame.white, np.full((2, 2), frame.black[0, c]))
        for c in range(3)
    ]
    return np.array([[level.min() for level in channels]])


def _limit(level: np.ndarray, frame: Frame, model: Noise, knee: float | None) -> np.ndarray:
    """Per cell, the normalised signal up to which samples are linear: clip level, the file's statement, the knee."""
    limit = radiometry.linear_limits(level, frame.black, frame.white, model)
    return np.minimum(limit, min(knee or np.inf, getattr(frame, "linear_limit", 1.0)))


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two frames of a scene: their signals, the measured ratio short over long, and what they were taken with."""

    keys: tuple[Key, Key]  # of the longer one, of the shorter one
    long: np.ndarray
    short: np.ndarray
    ratio: float
    limit: float
    step: float
    moved: bool

    @classmethod
    def of(cls, samples: Sequence[Sample], levels: Mapping[Key, np.ndarray], long: int, short: int) -> _Pair | None:
        frames = samples[long].frame, samples[short].frame
        keys = _key(frames[0]), _key(frames[1])
        if frames[0].encoding != "linear" or samples[long].rows.shape != samples[short].rows.shape:
            return None
        tops = [(levels[key] - frame.black) / (frame.white - frame.black) for key, frame in zip(keys, frames)]
        limit = float(min(top.min() for top in tops)) - radiometry.LIMIT_MARGIN
        a, b = samples[long].signal(), samples[short].signal()
        label = exposure.exposure_of(frames[1]) / exposure.exposure_of(frames[0])
        rough = noise.assumed(frames[0]), noise.assumed(frames[1])
        few = slice(None, None, max(1, a.size // FEW))
        found = exposure.measure_ratio(a.ravel()[few], b.ravel()[few], label, BELOW_KNEE * limit, rough)
        if found is None:
            found = exposure.measure_ratio(a.ravel(), b.ravel(), label, limit, rough)
        step = 1 / noise.steps(frames[0])
        moved = samples[long].moved or samples[short].moved
        return None if found is None else cls(keys, a, b, float(np.exp(found[0])), limit, step, moved)

    def bins(self) -> list[photon_transfer.Bin]:
        """Photon-transfer bins in units of the longer frame's ISO."""
        gain = self.keys[1][1] / self.keys[0][1]
        found = []
        for cell, (a, b) in enumerate(zip(planes(self.long), planes(self.short))):
            found += photon_transfer.transfer_bins(a, b, self.ratio, self.limit, self.step, cell, gain)
        return found

    def linearity(self, model: Noise) -> linearity.Linearity:
        """How far the longer frame is proportional."""
        return linearity.compare(self.long, self.short, self.ratio, self.limit, model)


def _still(pairs: list[_Pair]) -> list[_Pair]:
    """Those of which no frame was moved; all, where there are none."""
    return [one for one in pairs if not one.moved] or pairs


def _transfer(pairs: Sequence[_Pair]) -> Noise | None:
    """Photon transfer over the pairs of one ISO."""
    if not pairs:
        return None
    shape = (2, 2) if pairs[0].long.ndim == 2 else (1, 3)
    return photon_transfer.from_transfer([one for pair in pairs for one in pair.bins()], pairs[0].step, shape)


def _without(
    key: Key, frame: Frame, chosen: Mapping[Key, Noise | None], pairs: Sequence[_Pair | None], warnings: list[str]
) -> Noise:
    """Noise of an ISO that nobody states and no pair shows: scaled from other ISOs, from mixed pairs, or assumed."""
    camera, iso, _ = key
    known = {other[1]: model for other, model in chosen.items() if other[0] == camera and model is not None}
    if known:
        model = noise.scaled(iso, known)
        warnings.append(f"ISO {iso:g}: noise {model.source}, for want of NoiseProfile and frame pairs")
        return replace(
            model, shot=np.resize(model.shot, frame.black.shape), floor=np.resize(model.floor, frame.black.shape)
        )
    mixed = [one for one in pairs if one and one.keys[0][0] == one.keys[1][0] == camera]
    bins = [
        replace(one, signal_term=one.signal_term * g, floor_term=one.floor_term * g**2)
        for pair in mixed
        for g in [pair.keys[0][1] / iso]
        for one in pair.bins()
    ]
    found = photon_transfer.from_transfer(bins, mixed[0].step, frame.black.shape) if mixed else None
    if found is not None:
        isos = " and ".join(f"{one:g}" for one in sorted({k[1] for pair in mixed for k in pair.keys}))
        warnings.append(f"ISO {iso:g}: noise measured between frames of ISO {isos}, taken as proportional to ISO")
        sigma = float(np.hypot(found.shot_sigma, noise.ISO_SIGMA))
        return replace(found, source=f"photon transfer between ISO {isos}", shot_sigma=sigma)
    warnings.append(f"ISO {iso:g}: no NoiseProfile and too few frames to measure; a usual sensor is assumed")
    return noise.assumed(frame)


def _report(
    key: Key,
    frame: Frame,
    model: Noise,
    stated: Noise | None,
    measured: Noise | None,
    level: np.ndarray,
    knee: float | None,
    warnings: list[str],
) -> dict[str, Any]:
    """Numbers of one camera and ISO; warns of a low clip level, of a knee, and where stated and measured disagree."""
    _, iso, white = key
    numbers = {**model.numbers(), "clip_dn": float(level.min())}
    if np.any(level < white):
        warnings.append(f"ISO {iso:g}: frames clip at {level.min():.0f} DN, not at {white:.0f} as metadata say")
    if knee is not None:
        numbers["linear_to"] = knee
        at = float(frame.black.mean()) + knee * noise.full_scale(frame)
        warnings.append(f"ISO {iso:g}: signals beyond {at:.0f} DN ({knee:.0%}) are not linear and not used")
    if stated is not None and measured is not None:
        numbers["measured"] = measured.numbers()
        off = noise.disagreement(stated, measured)
        numbers["stated_against_measured"] = off
        if max(off["shot_sigmas"], off["floor_sigmas"]) > DISAGREE:
            one, other = stated.numbers(), measured.numbers()
            warnings.append(
                f"ISO {iso:g}: {stated.source} says {one['electrons_at_white']:.0f} electrons at white and "
                f"{one['read_noise_electrons']:.1f} of read noise, the frames show {other['electrons_at_white']:.0f} "
                f"+- {other['electrons_at_white_sigma']:.0f} and {other['read_noise_electrons']:.1f} "
                f"+- {other['read_noise_electrons_sigma']:.1f}; {model.source} is used, merge.noise chooses"
            )
    return numbers
