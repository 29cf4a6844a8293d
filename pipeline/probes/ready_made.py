"""A ready-made lat-long map as the light: read, cleaned, turned, and brought to the plate's unit.

The map's own error is what the manifest states; to it come the file's quantisation (Ward 1991: 8 bits of the brightest
channel; half floats 11), the stated rotation through the map's gradient, and the scale's uncertainty, which all texels
share. Limits: light is taken as distant; a map made of clipped frames says so only by equal largest values.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from pipeline.camera.rigid import rotation_exp
from pipeline.image.colour import Space, acescg_from_primaries, apply_matrix, convert
from pipeline.probes import combine, map_scale
from pipeline.probes.observation import Grid, Observation, Shots, ViewMap
from pipeline.probes.resample import Gathered, turned
from pipeline.run.errors import CaptureError
from pipeline.run.formats import read_latlong
from pipeline.types import Raster

QUANTISATION = 2**-9 / np.sqrt(3)  # of the brightest channel: eight bits of mantissa, the worst of the two formats
RINGING = 1e-4  # of the light: less below zero is a resampling filter's, and only counted
PLATEAU = 4  # texels that share the largest value exactly


@dataclass(frozen=True)
class LatLong:
    """A clean map in its own frame: radiance (h, w, 3) ACEScg >= 0 in the file's unit, valid and clipped (h, w)."""

    rgb: np.ndarray
    valid: np.ndarray
    clipped: np.ndarray
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def channels(self) -> np.ndarray:
        """(h, w, 5): RGB, valid, clipped; invalid texels are zero."""
        return np.dstack([self.rgb * self.valid[..., None], self.valid, self.clipped]).astype(np.float32)


class ReadyMade:
    """A map that was not taken for this plate, or was finished elsewhere; its rotation is stated."""

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        """One map, turned by ``yaw_deg`` and ``up``. Raises CaptureError or ArtifactError for an unusable file."""
        probe = shots.facts["probe"]
        light = clean(read_latlong(Path(probe["path"])), probe, "map")
        rotation = rotation_of(float(probe["yaw_deg"]), np.array(probe["up"], float))
        turn = turned(light.channels(), rotation, grid.height, grid.width, grid.supersample)
        sigma = float(np.radians(probe["orientation_sigma_deg"]))
        return finished("map", light, turn, sigma, shots, taken_here=probe["position_m"] is not None)


def clean(raster: Raster, probe: dict[str, Any], name: str) -> LatLong:
    """A file's picture as non-negative ACEScg, with everything that had to be mended counted; ``name`` is for messages.

    NaN is not seen; infinite is clipped at the largest finite value; what is negative in ACEScg becomes zero. Raises
    CaptureError when nothing positive is left.
    """
    rgb = raster.rgb().astype(np.float64)
    nan, infinite = np.isnan(rgb).any(-1), np.isposinf(rgb).any(-1)
    usable = np.isfinite(rgb).all(-1)
    if not (rgb[usable] > 0).any():
        raise CaptureError(f"{name}: no texel is positive, needed light; is it the right file?")
    largest = float(rgb[usable].max())
    rgb = np.nan_to_num(rgb, nan=0.0, posinf=largest, neginf=0.0)
    peak = rgb.max(-1)
    plateau = int((peak >= largest).sum())
    limit = probe.get("clipped_at") or np.inf
    clipped = np.asarray(infinite | (peak >= limit))
    rgb, space = to_acescg(rgb / float(raster.attributes.get("exposure", 1.0)), raster, probe.get("space"))
    negative = (rgb < 0).any(-1) & ~nan
    missing = float(-rgb[rgb < 0].sum() / max(float(np.abs(rgb).sum()), 1e-300))
    warnings = []
    for count, said in (
        (int(nan.sum()), "are not a number; taken as not seen"),
        (int(infinite.sum()), f"are infinite; taken as clipped at {largest:.4g}, a lower bound"),
        (
            int(negative.sum()) * (missing > RINGING),
            f"are negative in ACEScg ({missing:.2%} of the light); set to zero",
        ),
    ):
        if count:
            warnings.append(f"{name}: {count} texels {said}")
    if plateau >= PLATEAU and not clipped.any():
        warnings.append(
            f"{name}: {plateau} texels share the largest value {largest:.6g}: a lamp clipped there is a "
            f"lower bound; say so by probe.clipped_at = {largest:.6g}"
        )
    numbers = {
        "size_px": [*raster.shape[::-1]], "space": space, "nan_texels": int(nan.sum()),
        "infinite_texels": int(infinite.sum()), "negative_texels": int(negative.sum()), "plateau_texels": plateau,
    }  # fmt: skip
    return LatLong(np.maximum(rgb, 0), np.logical_not(nan), clipped, numbers, warnings)


def to_acescg(rgb: np.ndarray, raster: Raster, stated: str | None) -> tuple[np.ndarray, str]:
    """Colours in ACEScg and the space they came from: stated, else the file's name or primaries, else Rec.709."""
    if stated is None and raster.space == "unknown" and raster.attributes.get("chromaticities") is not None:
        primaries = np.asarray(raster.attributes["chromaticities"], float).reshape(4, 2)
        return apply_matrix(acescg_from_primaries(primaries), rgb), "chromaticities of the file"
    space = stated or (raster.space if raster.space in ("acescg", "linear_rec709") else "linear_rec709")
    return convert(rgb, cast(Space, space), "acescg"), space


def rotation_of(yaw_deg: float, up: np.ndarray) -> np.ndarray:
    """``world_from_map`` (3, 3): the shortest turn that takes ``up`` (map frame) to +Y, then yaw about +Y."""
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 1.0, 0.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[1])
    axis = axis / sine if sine > 1e-12 else np.array([0.0, 0.0, 1.0])  # upside down: any horizontal axis
    upright = rotation_exp(np.arctan2(sine, cosine) * axis)
    return rotation_exp(np.array([0.0, np.radians(yaw_deg), 0.0])) @ upright


def centre_of(probe: dict[str, Any]) -> np.ndarray:
    """Where the light was measured (3,), world frame: stated, else above the origin."""
    given = probe.get("position_m")
    return np.array(given, float) if given is not None else np.array([0.0, float(probe["height_m"]), 0.0])


def finished(
    name: str, light: LatLong, turn: Gathered, sigma_rad: float, shots: Shots, taken_here: bool,
    seen: np.ndarray | None = None,
) -> Observation:  # fmt: skip
    """The observation of one map on the grid: `LatLong.channels` turned, brought to the plate's unit, with variance.

    ``sigma_rad``: standard uncertainty of the rotation; ``seen`` (H, W) in [0, 1] hides what is not of the room.
    """
    probe, centre = shots.facts["probe"], centre_of(shots.facts["probe"])
    valid = turn.values[..., 3]
    safe = np.where(valid > 0, valid, 1)
    coverage = turn.coverage * valid * (1.0 if seen is None else seen)
    raw = turn.values[..., :3] / safe[..., None]
    found = map_scale.solve(shots, raw, coverage, centre, taken_here)
    rgb = raw * found.factor
    variance = (float(probe["sigma_rel"]) * rgb) ** 2
    variance += (QUANTISATION * rgb.max(-1, keepdims=True)) ** 2
    variance += (combine.gradient_per_radian(rgb) * min(sigma_rad, np.pi)) ** 2
    view = ViewMap(rgb, variance, coverage.astype(float), coverage, turn.values[..., 4] / safe)
    numbers = {name: light.numbers | {"orientation_sigma_deg": float(np.degrees(sigma_rad))}, "scale": found.numbers}
    evidence = [*found.evidence, parallax(probe)]
    warnings = [*light.warnings, *found.warnings]
    return Observation({name: view}, centre, {}, numbers, warnings, evidence, scale_sigma=found.sigma_rel)


def parallax(probe: dict[str, Any]) -> dict[str, Any]:
    """Why the light of another place is taken as that of the objects' place."""
    here = probe.get("position_m") is not None
    return {
        "term": "distance between where the light was measured and the objects",
        "modelled": False,
        "because": "probe.position_m is stated and the light is taken as distant" if here
        else "probe.position_m is not stated: the map is taken as that at the objects",
        "could_cost": "directions off by the distance moved over the distance of what is seen; near lamps by more",
        "no_bound": "how far off walls and lamps are is not known",
    }  # fmt: skip
