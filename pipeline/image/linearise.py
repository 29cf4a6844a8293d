"""Display-encoded brackets made linear, so that what follows treats them as it treats a sensor's samples.

The curve of each camera is recovered from all of its views together (`pipeline.image.response`); codes become
samples proportional to light, with the noise that neighbouring frames show, as if a DNG had stated it. What the curve
does not know is no noise: it is the same in every pixel of one code, so it is added to the merged variance afterwards.

A pixel of which one channel clips says nothing in the others either, except in the shortest frame: the sensor clipped
before the camera mixed its channels, so the others are wrong without being clipped. Such samples are NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.image.exposure import exposure_of
from pipeline.image.response import CLIPPED_CODE, LINEAR_WHITE, PEDESTAL_SIGMAS, TABLE, Response, recover
from pipeline.types import Bracket, Frame, Raster, Result

CURVE_PIXELS = 3_000_000  # of a frame, whole rows of JPEG transforms, from which its curve is recovered
STRIP = 8  # rows
LEVELS = 512  # radiances at which the curve's share of the variance is tabulated
NODES, RANGES, MAX_PAIRS = 9, 24, 200_000  # of the noise of a code; ranges of codes and pixels of a pair of frames
ASSUMED_SIGMA, LEAST_SIGMA = 1.5 / 255, 0.29 / 255  # noise of a code: a phone's JPEG; rounding alone, 1 / sqrt(12)
WEAK_SIGMA = 0.1  # relative uncertainty of a curve over its well exposed codes, from which on it is warned of
WELL_EXPOSED = (20 / 255, 235 / 255)


@dataclass(frozen=True, eq=False)
class Linearised:
    """``brackets`` without display encodings; ``responses`` by camera; what to report."""

    brackets: dict[str, Bracket]
    responses: dict[str, Response]
    tables: dict[str, np.ndarray]  # by file: (codes, 3) uint16
    shortest: set[str] = field(default_factory=set)  # files that are the shortest of a view
    noise: dict[str, np.ndarray] = field(default_factory=dict)  # by file: (6,) shot and floor of R, G, B
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)

    def samples(self, frame: Frame, codes: np.ndarray) -> np.ndarray:
        """(H, W, 3) float32 linear samples of a display-encoded frame's codes; any other frame's as they are."""
        table = self.tables.get(frame.file)
        if table is None:
            return codes
        linear = np.stack([table[codes[..., c], c] for c in range(3)], -1).astype(np.float32)
        if frame.file not in self.shortest:
            clipped = linear == LINEAR_WHITE
            linear[clipped.any(-1)[..., None] & ~clipped] = np.nan
        return linear

    def completed(self, merged: Result) -> Result:
        """Merge's result with the curves' share of the variance, and what is to be said of them."""
        if not self.responses:
            return merged
        listing = merged.outputs["exposures"]
        mosaics = {view: self.widened(view, one, listing[view]) for view, one in merged.outputs["mosaics"].items()}
        numbers = {**merged.numbers, "response": self.numbers}
        said = [*self.warnings, *merged.warnings], [*merged.evidence, *self.evidence]
        return Result({**merged.outputs, "mosaics": mosaics}, numbers, *said)

    def widened(self, view: str, raster: Raster, rows: list[dict[str, Any]]) -> Raster:
        """A merged view with the curve's uncertainty in its variance; ``rows``: its estimated exposures."""
        frames = self.brackets[view].frames
        if not frames or frames[0].file not in self.tables:
            return raster
        estimated = {row["file"]: row["estimated_s"] / row["label_s"] for row in rows}
        exposures = np.array([exposure_of(frame) * estimated.get(frame.file, 1.0) for frame in frames])
        rgb, variance = raster.rgb(), raster.rgb("variance")
        response = self.responses[frames[0].camera]
        for channel in range(3):
            levels, relative = curve_variance(response, channel, exposures)
            at = np.interp(np.log(np.maximum(rgb[..., channel], 1e-30)), levels, relative)
            variance[..., channel] += (at * rgb[..., channel] ** 2).astype(np.float32)
        return Raster({**raster.channels, **Raster.split(variance, "variance")}, raster.space, raster.attributes)


def linearise(brackets: dict[str, Bracket], decode: Callable[[Frame], np.ndarray]) -> Linearised:
    """Recover the curve of every camera with display-encoded frames; ``decode`` gives (H, W, 3) codes."""
    views: dict[str, list[list[Frame]]] = {}
    for name in sorted(brackets):
        frames = [frame for frame in brackets[name].frames if frame.encoding == "display"]
        if frames:
            frames = sorted(frames, key=lambda frame: (exposure_of(frame), frame.file))
            views.setdefault(frames[0].camera, []).append(frames)
    result = Linearised(dict(brackets), {}, {})
    for camera, group in views.items():
        codes = [[_strips(decode(frame)) * (1 / frame.white) for frame in frames] for frames in group]
        response = recover(codes, [[exposure_of(frame) for frame in frames] for frames in group], 1.0)
        noise = pixel_noise(response, codes, [[exposure_of(frame) for frame in frames] for frames in group])
        result.responses[camera] = response
        result.shortest.update(frames[0].file for frames in group)
        result.noise.update({frame.file: noise.ravel() for frames in group for frame in frames})
        result.tables.update({frame.file: response.table(frame.white) for frames in group for frame in frames})
        _report(result, camera, response, [frame for frames in group for frame in frames])
    for name, bracket in brackets.items():
        linear = [_as_linear(frame, result.noise.get(frame.file)) for frame in bracket.frames]
        result.brackets[name] = bracket.model_copy(update={"frames": linear})
    return result


def _as_linear(frame: Frame, noise: np.ndarray | None) -> Frame:
    """The frame that its linear samples make, with its noise where a DNG would state it; others as they are."""
    if noise is None:
        return frame
    changes = {"encoding": "linear", "white": LINEAR_WHITE, "black": np.zeros((1, 3)), "noise_profile": noise}
    return frame.model_copy(update=changes)


def pixel_noise(
    response: Response, views: Sequence[Sequence[np.ndarray]], labels: Sequence[Sequence[float]]
) -> np.ndarray:
    """(3, 2) ``shot`` and ``floor``: variance = shot x + floor of linear samples x (share of white), per channel.

    From neighbouring frames, pixel by pixel: ``ln L(z_i) - ln L(z_j) - ln(t_i / t_j)`` has the variance of both codes'
    noise through the curve's slope; its median absolute deviation in ranges of codes gives the noise of a code, which
    holds photons, quantisation, compression and what small motions and sharpening do. Without two frames it is that of
    `ASSUMED_SIGMA`. At least quantisation's.
    """
    offsets = iter(response.offsets)
    logs = [[float(np.log(label)) + float(next(offsets)) for label in group] for group in labels]
    result = np.zeros((3, 2))
    for channel in range(3):
        terms: list[np.ndarray] = []
        seen: list[float] = []
        for stack, times in zip(views, logs):
            for (one, t), (other, u) in pairwise(zip(stack, times)):
                _noise_terms(response, channel, one, other, u - t, terms, seen)
        sigma2 = np.full(NODES, ASSUMED_SIGMA**2)
        if len(terms) >= NODES:
            from scipy.optimize import nnls

            scale = 1 / np.maximum(seen, 1e-12)  # relative errors are alike
            smooth = np.diff(np.eye(NODES), axis=0) / ASSUMED_SIGMA**2
            rows = np.concatenate([np.array(terms) * scale[:, None], smooth])
            sigma2 = nnls(rows, np.concatenate([np.ones(len(seen)), np.zeros(NODES - 1)]))[0]
        result[channel] = _shot_and_floor(response, channel, np.maximum(sigma2, LEAST_SIGMA**2))
    return result


def _noise_terms(
    response: Response, channel: int, one: np.ndarray, other: np.ndarray, step: float,
    terms: list[np.ndarray], seen: list[float],
) -> None:  # fmt: skip
    """Adds, per range of codes, how the nodes' code variances make up the variance of a pair, and that variance."""
    grid = np.linspace(0, 1, TABLE)
    a, b = (response.above(picture)[..., channel].ravel() for picture in (one, other))
    every = max(1, len(a) // MAX_PAIRS)
    a, b = a[::every], b[::every]
    usable = (np.minimum(a, b) > response.dark[channel]) & (np.maximum(a, b) < CLIPPED_CODE)
    a, b = a[usable], b[usable]
    curve = response.log_light[:, channel]
    misfit = np.interp(b, grid, curve) - np.interp(a, grid, curve) - step
    slopes = response.steepness(a, channel), response.steepness(b, channel)
    ranges = np.minimum((a * RANGES).astype(int), RANGES - 1)
    for number in range(RANGES):
        members = ranges == number
        if members.sum() >= 200:
            left = misfit[members]
            terms.append(sum(
                np.stack([np.interp(code[members], _nodes(), node) for node in np.eye(NODES)], -1).T
                @ slope[members] ** 2 / members.sum() for code, slope in zip((a, b), slopes)
            ))  # fmt: skip
            seen.append((1.4826 * float(np.median(np.abs(left - np.median(left))))) ** 2)


def _nodes() -> np.ndarray:
    return np.linspace(0, 1, NODES)


def _shot_and_floor(response: Response, channel: int, sigma2: np.ndarray) -> np.ndarray:
    """The line through ``(dx/dz)^2 sigma^2`` over x that errs least in proportion, both parts positive."""
    from scipy.optimize import nnls

    grid = np.linspace(0, 1, TABLE)
    top = max(float(np.interp(CLIPPED_CODE, grid, response.log_light[:, c])) for c in range(3))
    lnx = np.interp(grid, grid, response.log_light[:, channel]) - top
    wanted = np.linspace(lnx[int(response.dark[channel] * TABLE) + 1], lnx[int(CLIPPED_CODE * TABLE)], 200)
    code = np.interp(wanted, np.maximum.accumulate(lnx + 1e-9 * np.arange(TABLE)), grid)
    x = np.exp(wanted)
    variance = (x * response.steepness(code, channel)) ** 2 * np.interp(code, _nodes(), sigma2)
    shot, floor = np.maximum(nnls(np.stack([x, np.ones_like(x)], -1) / variance[:, None], np.ones_like(x))[0], 1e-12)
    dark = response.dark[channel]  # below it light is a straight line over codes: its noise is that of the pedestal
    sigma = dark / PEDESTAL_SIGMAS if response.pedestal[channel] else np.sqrt(sigma2[0])
    return np.array([shot, max(floor, (np.exp(wanted[0]) * sigma / dark) ** 2)])


def _strips(codes: np.ndarray) -> np.ndarray:
    """Whole strips of rows, evenly spaced, of at most CURVE_PIXELS in all; float32."""
    step = max(1, -(-codes.shape[0] * codes.shape[1] // CURVE_PIXELS))
    rows = np.arange(codes.shape[0] // STRIP * STRIP)
    return codes[rows[(rows // STRIP) % step == 0]].astype(np.float32)


def curve_variance(response: Response, channel: int, exposures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative variance that the curve's uncertainty leaves in a merged channel: ln radiance (N,), variance (N,).

    The frames weigh by their exposure, as counts do; those in which the radiance clips or is dark do not, unless it
    does in all. ``exposures``: of the view's frames, such that radiance times exposure is the share of LINEAR_WHITE.
    """
    grid = np.linspace(0, 1, TABLE)
    light = response.log_light[:, channel]
    top = max(float(np.interp(CLIPPED_CODE, grid, response.log_light[:, c])) for c in range(3))
    low, high = np.interp((response.dark[channel], CLIPPED_CODE), grid, light) - top
    levels = np.linspace(low - np.log(exposures.max()), high - np.log(exposures.min()), LEVELS)
    logs = levels[:, None] + np.log(exposures)  # (N, F) ln of the share of white
    weight = np.where((logs < high) & (logs > low), exposures, exposures * 1e-9)
    weight /= weight.sum(1, keepdims=True)
    codes = np.interp(logs + top, np.maximum.accumulate(light + 1e-9 * np.arange(TABLE)), grid)
    rows = np.einsum("nf,nfk->nk", weight, response.basis[np.rint(codes * (TABLE - 1)).astype(int)])
    return levels, np.einsum("nk,kl,nl->n", rows, response.covariance[channel], rows)


def _report(result: Linearised, camera: str, response: Response, frames: list[Frame]) -> None:
    grid = np.linspace(0, 1, TABLE)
    well = (grid > WELL_EXPOSED[0]) & (grid < WELL_EXPOSED[1])
    sigma = float(np.sqrt(np.mean(response.sigma()[well] ** 2)))
    name = camera or frames[0].file
    result.numbers[name] = {
        "frames": len(frames),
        "blocks": response.blocks,
        "sigma_rel": sigma,
        "noise_codes": response.misfit,
        "pedestal_codes": (255 * response.pedestal).round(1).tolist(),
        "codes_seen": (255 * response.support).round(1).tolist(),
        "exposure_correction": {f.file: float(np.exp(o)) for f, o in zip(frames, response.offsets)},
    }
    known = response.blocks > 0
    said = f"recovered to {sigma:.1%}" if known else f"not to be recovered (no two frames overlap): sRGB, {sigma:.0%}"
    result.warnings.append(
        f"{name}: {len(frames)} display-encoded photographs (no RAW), their curve {said}; RAW of the same bracket is "
        "3 to 4 times more accurate per pixel and has no such error in common (docs/capture.md)"
    )
    if known and sigma > WEAK_SIGMA:
        result.warnings.append(f"{name}: the curve is known to {sigma:.0%} only; add frames about 1 EV apart")
    result.evidence.append({
        "term": f"response curve of {name}",
        "modelled": known,
        "because": f"{response.blocks} flat blocks seen in several frames, noise {response.misfit:.2f} codes",
        "could_cost": f"{sigma:.1%} of radiance, in the variance; local tone mapping and saturation are not modelled",
        "bound_rel": 2 * sigma,
    })  # fmt: skip
