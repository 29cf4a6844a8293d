"""Fisheye photographs that together see all around: each lens by its projection, blended where they overlap.

Projections (theta from the axis): equidistant ``r ~ theta``, equisolid ``r ~ sin theta/2``, stereographic
``r ~ tan theta/2`` (Miyamoto 1964). A rotation is stated, or found from features shared with the plate, or with a
photograph whose rotation is known. Photographs fade out over 10 degrees at their rim and are brought to one exposure.
Limits: no vignetting, and a real lens follows its formula to about one percent of the radius.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.rigid import rotation_exp
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.probes import combine, levelling, map_scale, orientation
from pipeline.probes.observation import Grid, Observation, Shots, ViewMap, lookup_channels
from pipeline.probes.orientation import Orientation
from pipeline.probes.ready_made import QUANTISATION, centre_of, clean, parallax
from pipeline.probes.resample import Gathered, ToPixel, gather
from pipeline.run.errors import CaptureError
from pipeline.run.formats import read_linear

FADE = np.radians(10.0)  # over which a photograph's weight falls to nothing at its rim
CUT_PX = 1.5  # at the rim of the image circle, where pixels are partly outside
REGISTERED = 512, 1024  # texels of the maps on which features are looked for
UPRIGHT = np.diag([-1.0, -1.0, 1.0])  # a camera that looks along +Z of the world: x to its right, y down


class FisheyePair:
    """Two hemispheres, or as many photographs as it takes."""

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        """One map per photograph. Raises CaptureError when nothing says how one of them was held."""
        probe, centre = shots.facts["probe"], centre_of(shots.facts["probe"])
        pictures, warnings = {}, []
        for lens in probe["fisheye"]:
            pictures[lens["name"]], said = picture_of(lens, shots)
            warnings += said
        turns = oriented(probe, pictures, shots, centre)
        maps = {
            lens["name"]: view_map(pictures[lens["name"]], lens, turns[lens["name"]], grid) for lens in probe["fisheye"]
        }
        levels = levelling.level(list(maps.values()))
        level = [view.scaled(float(np.exp(-log))) for view, log in zip(maps.values(), levels.log, strict=True)]
        merged = combine.merge(level)
        developed = not any(lens.get("path") for lens in probe["fisheye"])
        found = map_scale.solve(shots, merged.rgb, merged.seen, centre, True, developed)
        maps = {name: view.scaled(found.factor) for name, view in zip(maps, level, strict=True)}
        numbers: dict[str, Any] = {
            name: turn.numbers | {"route": turn.route, "sigma_deg": float(np.degrees(turn.sigma_rad)),
                                  "world_from_camera": turn.rotation.tolist()}
            for name, turn in turns.items()
        }  # fmt: skip
        numbers |= {"scale": found.numbers, "seams": seams(list(maps.values()), levels)}
        evidence = [*found.evidence, parallax(probe), *reasons(turns)]
        warnings += found.warnings
        return Observation(maps, centre, {}, numbers, warnings, evidence, scale_sigma=found.sigma_rel)


def picture_of(lens: dict[str, Any], shots: Shots) -> tuple[np.ndarray, list[str]]:
    """(h, w, 8) as `lookup_channels`, of a file or of a developed bracket, and warnings."""
    if not lens.get("path"):
        return lookup_channels(shots.photographs[lens["name"]]), []
    light = clean(read_linear(Path(lens["path"])), shots.facts["probe"], lens["name"])
    noise = float(shots.facts["probe"]["sigma_rel"])
    variance = (noise * light.rgb) ** 2 + (QUANTISATION * light.rgb.max(-1, keepdims=True)) ** 2
    channels = np.dstack([light.rgb, variance, light.valid, light.clipped]) * light.valid[..., None]
    return channels.astype(np.float32), light.warnings


def to_pixel_of(lens: dict[str, Any], shape: tuple[int, int]) -> ToPixel:
    """Pixels of directions in the camera's frame (x right, y down, z along the axis) for a lens of the manifest."""
    half = np.radians(lens["fov_deg"]) / 2
    x0, y0 = lens["centre_px"] or (shape[1] / 2, shape[0] / 2)
    bend = {"equidistant": lambda t: t, "equisolid": lambda t: np.sin(t / 2), "stereographic": lambda t: np.tan(t / 2)}
    radius = bend[lens["projection"]]

    def to_pixel(w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        across = np.hypot(w[..., 0], w[..., 1])
        theta = np.minimum(np.arctan2(across, w[..., 2]), 0.999 * np.pi)
        r = lens["radius_px"] * radius(theta) / radius(half)
        safe = np.where(across > 1e-12, across, 1.0)
        x, y = x0 + r * w[..., 0] / safe, y0 + r * w[..., 1] / safe
        inside = (x >= 0.5) & (x <= shape[1] - 0.5) & (y >= 0.5) & (y <= shape[0] - 0.5)
        return x, y, inside & (r <= lens["radius_px"] - CUT_PX)

    return to_pixel


def rotation_of(lens: dict[str, Any]) -> np.ndarray:
    """``world_from_camera`` (3, 3) of a stated yaw, pitch and roll."""
    yaw, pitch, roll = (np.radians(float(lens[key])) for key in ("yaw_deg", "pitch_deg", "roll_deg"))
    turn = rotation_exp(np.array([0, yaw, 0])) @ rotation_exp(np.array([-pitch, 0, 0]))
    return np.asarray(turn @ UPRIGHT @ rotation_exp(np.array([0, 0, roll])))


def oriented(
    probe: dict[str, Any], pictures: dict[str, np.ndarray], shots: Shots, centre: np.ndarray
) -> dict[str, Orientation]:
    """``world_from_camera`` of every photograph: stated, else from the plate, else from one that is known already."""
    sigma = float(np.radians(probe["orientation_sigma_deg"]))
    lenses = {lens["name"]: lens for lens in probe["fisheye"]}
    stated = {name: lens for name, lens in lenses.items() if lens["yaw_deg"] is not None}
    turns = {name: Orientation(rotation_of(lens), np.eye(3) * sigma**2, "stated", {}) for name, lens in stated.items()}
    waiting = [name for name in lenses if name not in turns]
    flat = {name: flattened(pictures[name], lenses[name]) for name in (lenses if waiting else ())}
    for name in waiting:
        if found := orientation.from_features(*flat[name], shots, centre):
            turns[name] = found
    for name in [name for name in waiting if name not in turns]:
        for known in list(turns):
            if found := orientation.from_overlap(*flat[name], *flat[known], turns[known]):
                turns[name] = found
                break
        else:
            raise CaptureError(
                f"{name}: it shares too few features with the plate or another fisheye photograph to say how it was "
                f"held, needed {orientation.FEWEST_MATCHES}; state its yaw_deg, pitch_deg and roll_deg"
            )
    return {name: turns[name] for name in lenses}


def flattened(picture: np.ndarray, lens: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Lat-long (H, W, 3) in the camera's own frame, and which texels are shown (H, W)."""
    found = gather(picture, to_pixel_of(lens, picture.shape[:2]), np.eye(3), *REGISTERED, 2)
    return found.values[..., :3], (found.coverage > 0.99) & (found.values[..., 6] > 0.99)


def view_map(picture: np.ndarray, lens: dict[str, Any], turn: Orientation, grid: Grid) -> ViewMap:
    """One photograph on the grid, world frame, in its own unit."""
    half = np.radians(lens["fov_deg"]) / 2
    per_radian = lens["radius_px"] / half
    count = max(grid.supersample, int(np.ceil(2 * np.pi / grid.width * per_radian)))
    to_pixel = to_pixel_of(lens, picture.shape[:2])
    found: Gathered = gather(picture, to_pixel, turn.rotation, grid.height, grid.width, count)
    valid = found.values[..., 6]
    safe = np.where(valid > 0, valid, 1)[..., None]
    rgb, coverage = found.values[..., :3] / safe, found.coverage * valid
    pixels = np.maximum(latlong_solid_angles(grid.height, grid.width) * per_radian**2, 1)[..., None]
    variance = found.values[..., 3:6] / safe / pixels
    variance = variance + (combine.gradient_per_radian(rgb) * turn.sigma_rad) ** 2 * (coverage > 0)[..., None]
    theta = np.arccos(np.clip(latlong_directions(grid.height, grid.width) @ turn.rotation[:, 2], -1, 1))
    weight = np.clip((half - theta) / FADE, 0, 1) * coverage
    return ViewMap(rgb, variance, weight, coverage, found.values[..., 7] / safe[..., 0])


def seams(maps: list[ViewMap], levels: levelling.Levels) -> dict[str, Any]:
    """How much of the sphere several photographs see, and how they differ there."""
    many = np.sum([view.weight > 0 for view in maps], 0)
    area = latlong_solid_angles(*many.shape)
    return {
        "overlap_sr": float(area[many > 1].sum()), "unseen_sr": float(area[many == 0].sum()),
        "exposure_over_first": np.exp(levels.log).tolist(),
        "disagreement_median_rel": {f"{i}-{j}": pair.disagreement for (i, j), pair in levels.pairs.items()},
    }  # fmt: skip


def reasons(turns: dict[str, Orientation]) -> list[dict[str, Any]]:
    """How rotations came about, and what of the lens is left out."""
    how = ", ".join(f"{name} {turn.route} ({np.degrees(turn.sigma_rad):.2f} degrees)" for name, turn in turns.items())
    return [
        {
            "term": "rotations of the fisheye photographs",
            "modelled": True,
            "because": how,
            "could_cost": "lamps turned and doubled at the seam by as much",
        },
        {
            "term": "vignetting and distortion of the fisheye lens beside its formula",
            "modelled": False,
            "because": "the manifest gives the formula alone",
            "could_cost": "10 to 30 % towards the rim of a lens at full aperture; a degree of direction",
            "bound_rel": 0.3,
            "bound_deg": 1.0,
        },
    ]
