"""Turn photographs of a probe into a world-oriented environment map with variance.

What the probe is, is a kind of its own (`pipeline.probes.kinds`): it gives one map per view. Views are brought to one
exposure and averaged by inverse variance. Limits: light is distant unless [room] says how far; lamps clipped in
every frame are lower bounds unless their shadow tells (`pipeline.probes.clipped`); directions that nobody sees are
filled smoothly and marked by ``seen`` = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera.view_checks import check_feet, feet_of, height_above
from pipeline.conventions import ACESCG, RADIANCE_UNIT, latlong_solid_angles
from pipeline.image.balance import balanced, shared_sigma
from pipeline.light import near_field, resolution, smooth
from pipeline.light.alike import RAISED
from pipeline.light.environment import AXES, AXIS_NAMES, SCALE_SIGMA, irradiance
from pipeline.light.harmonics import COSINE_LOBE, sh9_irradiance, sh9_of_environment, sh9_sigma
from pipeline.light.placed import header_of
from pipeline.probes import clipped, combine, filling, ground_gloss, levelling
from pipeline.probes.kinds import KINDS
from pipeline.probes.observation import Grid, Shots, ViewMap, lookup_channels
from pipeline.probes.witness import Witness, witness_of
from pipeline.run.artifacts import BALANCE, BALLS, CAMERA, ENVIRONMENT, FACTS, HARMONICS, PHOTOGRAPHS, VIEWS, WISHES
from pipeline.run.errors import CaptureError
from pipeline.run.evidence import TRIED
from pipeline.run.stage import Stage
from pipeline.types import Balance, Camera, Harmonics, Raster, Result, View
from stages import knobs


def compute(
    facts: dict[str, Any], photographs: dict[str, Raster], camera: Camera, views: dict[str, View],
    balance: dict[str, Balance], wishes: dict[str, Any], params: knobs.Probe,
) -> Result:  # fmt: skip
    """Fitted balls, and the light at the probe (H, W) with H = width / 2, world frame."""
    height_above(views["plate"])  # what the plate cannot show is refused before the light is looked for
    check_feet(feet_of(wishes), camera, views["plate"])
    photographs = balanced(photographs, balance)
    grid = Grid(params.width, params.supersample, params.rim)
    shots = Shots(facts, photographs, camera, views)
    observed = KINDS[facts["probe"]["kind"]].observe(shots, grid)
    maps, warnings = dict(observed.maps), list(observed.warnings)
    numbers = dict(observed.numbers)
    numbers["views"], applied = level_views(maps, warnings)
    merged = combine.merge(list(maps.values()))
    shared = np.hypot(observed.scale_sigma, shared_sigma(balance, next(iter(maps))))  # by all: merging keeps it
    plate, eye = lookup_channels(photographs["plate"])[..., :7], views["plate"].world_from_camera
    below = combine.plate_below(plate, camera, eye, observed.centre_world, merged.seen.shape)
    over = clipped.clipped_share(merged.share, list(maps.values())) * (1 - below.share)
    witness = Witness(missing="knob probe.recover = never")
    if params.recover == "auto":
        witness = witness_of(shots, observed) if over.any() else Witness()
    whole = completed(merged, shared, below, over, witness)
    gloss = ground_gloss.assess(
        whole.lamps.rgb, merged.rgb, merged.seen, below, plate, camera, eye, observed.centre_world
    )
    if gloss.taken:
        whole = completed(merged, shared, gloss.below, over, witness, gloss)
    lamps, known, gap, laid = whole.lamps, whole.known, whole.gap, below.share
    rgb, variance, seen = lamps.rgb, lamps.variance, np.maximum(merged.seen, laid)
    if observed.smooth_only:
        rgb, variance = smooth.reduced(rgb, variance)
    centre, room = observed.centre_world, near_field.room_of(facts)
    if room and not room.holds(centre):
        raise CaptureError(
            f"room: the probe, at {np.round(centre, 2).tolist()} m, lies outside; correct centre_m, size_m"
        )
    near = near_field.assess(rgb, centre, near_field.places_of(wishes, centre[1]), room, params.near_budget, eye[:3, 3])
    recovered, raised = lamps.recovered, 1 + (merged.disagreement - 1) * (1 - laid)
    if room and near.target is not None:
        maps_of = [rgb, variance, np.stack([seen, over, recovered, raised], -1)]
        rgb, variance, rest = near_field.relocate(maps_of, room.depth, centre, near.target)
        seen, over, recovered, raised = np.moveaxis(rest, -1, 0)
    numbers |= near.numbers
    numbers |= {"plane_from_plate_fraction": float((laid * latlong_solid_angles(*seen.shape)).sum() / (4 * np.pi))}
    differing, filled = combine.disagreement_numbers(merged), filling.report(rgb, known, gap)
    numbers |= differing | filled | ground_gloss.numbers(gloss)
    numbers |= lamps.numbers | map_numbers(rgb, seen)
    environment = Raster(
        {
            **Raster.split(rgb.astype(np.float32)),
            **Raster.split(variance.astype(np.float32), "variance"),
            "seen": seen.astype(np.float32),
            "clipped": over.astype(np.float32),
            "recovered": recovered.astype(np.float32),
            RAISED: raised.astype(np.float32),
        },
        ACESCG,
        {"insitu:unit": RADIANCE_UNIT, "insitu:frame": "world", "envmap": "latlong"}
        | {SCALE_SIGMA: " ".join(f"{sigma:.6g}" for sigma in np.broadcast_to(shared, 3))}
        | combine.picture_header(merged, maps, views, photographs)
        | near_field.places(centre if near.target is None else near.target, centre)
        | ({} if near.target is not None or observed.smooth_only else header_of(lamps.placed)),
    )
    coefficients = sh9_of_environment(rgb)
    sigma = np.hypot(sh9_sigma(variance), np.abs(coefficients) * shared)
    harmonics = Harmonics(coefficients=coefficients, sigma=sigma, irradiance_factors=COSINE_LOBE)
    outputs = {"balls": observed.balls, "environment": environment, "harmonics": harmonics}
    evidence = [*observed.evidence, *lamps.evidence, *reasons(applied, numbers["views"])]
    evidence += [combine.disagreement_reason(differing, len(maps)), filling.reason(filled, gap), near.evidence]
    evidence += [ground_gloss.reason(gloss), resolution.reason(rgb)]
    return Result(outputs, numbers, [*warnings, *lamps.warnings, *near.warnings], evidence)


@dataclass(frozen=True)
class Whole:
    """The map with the plate laid under it, gaps filled, and lamps recovered; ``known`` (H, W), and the gaps' prior."""

    lamps: clipped.Recovered
    known: np.ndarray
    gap: filling.Prior | None


def completed(
    merged: combine.Merged, shared: np.ndarray, below: combine.Below, over: np.ndarray, witness: Witness,
    gloss: ground_gloss.Gloss | None = None,
) -> Whole:  # fmt: skip
    """From what the probe saw to a map of all directions; with ``gloss``, what is filled shows its mirror images."""
    known = np.minimum(merged.seen * 4, 1)
    rgb, variance = combine.lay_under(merged.rgb, merged.variance + (shared * merged.rgb) ** 2, known, below)
    known = np.maximum(known, below.share)
    offset = np.zeros(rgb.shape) if gloss is None else gloss.offset
    matt = rgb - offset * (known > 0)[..., None]
    gap = filling.prior(matt, known)
    filled = filling.fill(matt, known)
    variance = filling.filled_variance(filled, variance, known, gap)
    if gloss is None:
        rgb = filled
    else:
        # What was seen in part is mixed with its surroundings in `filled` already.
        rgb = np.where(known[..., None] > 0, filled, np.maximum(filled, 0)) + offset
        variance = variance + ground_gloss.mirrored_variance(gloss, known)
    return Whole(clipped.recover(rgb, variance, over, witness), known, gap)


def level_views(maps: dict[str, ViewMap], warnings: list[str]) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Bring every view to the exposure of the first; returns the figures, and the names of those that were changed."""
    figures: dict[str, dict[str, float]] = {}
    applied = []
    names = list(maps)
    levels = levelling.level(list(maps.values()))
    for number, name in enumerate(names[1:], 1):
        ratio, sigma = float(np.exp(levels.log[number])), float(np.sqrt(levels.covariance[number, number]))
        pair = levels.pairs.get((0, number))
        figures[name] = {
            "exposure_ratio": ratio, "exposure_ratio_sigma": ratio * sigma,
            "overlap_disagreement_median_rel": pair.disagreement if pair else np.nan,
        }  # fmt: skip
        if not np.isfinite(sigma):
            warnings.append(f"{name}: shares too few directions with {names[0]} to compare exposures; taken as equal")
        elif abs(levels.log[number]) > levelling.SIGNIFICANT * sigma:
            maps[name] = maps[name].scaled(1 / ratio)
            applied.append(name)
            warnings.append(f"{name}: {ratio:.3f} +- {ratio * sigma:.3f} times as bright as {names[0]}; brought to it")
    return figures, applied


def map_numbers(rgb: np.ndarray, seen: np.ndarray) -> dict[str, Any]:
    """Figures of the finished map."""
    exact = irradiance(rgb, AXES)
    smooth = sh9_irradiance(sh9_of_environment(rgb), AXES)
    grey, weight = rgb.mean(-1), latlong_solid_angles(*seen.shape)
    return {
        "seen_fraction": float((seen * weight).sum() / weight.sum()),
        "max_over_median": float(grey.max() / max(float(np.median(grey)), 1e-300)),
        "irradiance": {name: value.tolist() for name, value in zip(AXIS_NAMES, exact, strict=True)},
        "irradiance_sh9": {name: value.tolist() for name, value in zip(AXIS_NAMES, smooth, strict=True)},
        "negative_texels": int((grey < 0).sum()),
    }


def reasons(applied: list[str], views: dict[str, dict[str, float]]) -> list[dict[str, Any]]:
    """Which terms that are common to all kinds are in, and why; ``views``: figures of `level_views`."""
    sigma = [one["exposure_ratio_sigma"] / one["exposure_ratio"] for one in views.values()]
    return [
        {
            "term": "relative exposure of views",
            "modelled": bool(applied),
            "because": f"differs by more than {levelling.SIGNIFICANT:.0f} sigma in {', '.join(applied) or 'no view'}",
            "could_cost": "a seam of that ratio",
            **(
                {"bound_rel": levelling.SIGNIFICANT * max(sigma, default=0.0), **TRIED}
                if np.isfinite(sigma).all()
                else {"no_bound": "they share too few directions to compare"}
            ),
        },
        {
            "term": "plane from the plate below 7 degrees under the horizon",
            "modelled": True,
            "because": "the ball mirrors its own shadow; the plate shows the plane without it, taken as diffuse",
            "could_cost": "13 % of the irradiance from below, 3 % of that from the side on one capture; 2 % on another",
        },
    ]


STAGE = Stage(
    "probe", compute, knobs.Probe,
    inputs={
        "facts": FACTS, "photographs": PHOTOGRAPHS, "camera": CAMERA, "views": VIEWS, "balance": BALANCE,
        "wishes": WISHES,
    },
    outputs={"balls": BALLS, "environment": ENVIRONMENT, "harmonics": HARMONICS},
)  # fmt: skip
