"""Find the compact lights of the environment: suns and lamps that cast hard shadows; the rest is sky.

A light is a connected set of the map's texels that stands out sharply, is narrow, and carries a share of the light that
matters (`pipeline.light.emitters`). The light of a group is the map on its texels, so that lights and sky sum to the
map exactly. A lamp that was measured is drawn as wide as it is, without what the probe's picture spread it
(`pipeline.light.narrowing`): that moves its light by about a pixel of that picture, and adds and loses none. One that
was recovered is drawn as the disc that its shadow's edge gives, where it does (`pipeline.light.placed`). What was
clipped and not recovered is said to be a lower bound. Limits: light is distant; windows and tubes that are wide stay in
the sky, as blurred as the probe saw them, which the renderer samples by brightness.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.light.alike import flux_sigma
from pipeline.light.emitters import Patch, lights
from pipeline.light.environment import total_energy
from pipeline.light.narrowing import drawn, half_angle_of, spread_of
from pipeline.light.placed import is_placed, nearest, placed_in
from pipeline.run.artifacts import EMITTERS, ENVIRONMENT, LIGHTING
from pipeline.run.evidence import TRIED
from pipeline.run.stage import Stage
from pipeline.types import Emitter, Raster, Result
from stages import knobs

CLIPPED_PART = 0.05  # of a texel that is clipped: from here on it is a lower bound
MOST = 4  # lights that are told apart: each costs the renderer a shadow ray
COSTS = {
    "measured": "nothing: its texels are the map's",
    "recovered": "its sigma: it was clipped, and its flux comes from what it does to known surfaces",
    "clipped": "all that it is brighter than its clipped value",
}
STAYS = {  # why a lamp is as wide as the map has it
    "recovered": "its flux is known by cards, or its shadow's edge does not tell that it is narrower than its picture",
    "clipped": "clipped in its middle: its moments do not tell how wide it is",
}
RENDERED = {*"RGB", *(f"variance.{channel}" for channel in "RGB"), "seen"}
# A sun, by what no lamp in a room is at once: the only light, above, a disc of half a degree as a probe blurs it, and
# brighter than the mean of all else by this.
SUN_HALF_ANGLE_DEG, SUN_CONTRAST = 2.0, 100.0


def compute(environment: Raster, params: knobs.Lights) -> Result:
    """Compact lights of the map, strongest first, and what renders; an empty list when the map is all sky."""
    rgb = environment.rgb()
    found, wide = lights(rgb, params.min_share, np.radians(params.max_half_angle_deg))
    kept, rest = found[:MOST], found[MOST:]
    sun = is_sun(rgb, kept)
    emitters = [
        Emitter(
            name="sun" if sun else f"lamp_{number}", direction=patch.direction, solid_angle_sr=patch.solid_angle_sr,
            half_angle_rad=patch.half_angle_rad, irradiance=patch.irradiance, texels=patch.texels,
            irradiance_sigma=flux_sigma(environment, patch.texels, patch.direction),
            lower_bound=source(environment, patch) == "clipped", evidence=source(environment, patch),
        )
        for number, patch in enumerate(kept, 1)
    ]  # fmt: skip
    if params.width == "unblurred":
        emitters = [as_its_edge_says(environment, emitter) for emitter in emitters]
    spread = spread_of(environment)
    lit = drawn(lighting(environment), emitters, spread if params.width == "unblurred" else 0.0)
    numbers = {
        emitter.name: {
            "share": patch.share, "half_angle_deg": float(np.degrees(true.half_angle_rad)),
            "half_angle_sigma_deg": float(np.degrees(true.half_angle_sigma_rad)),
            "direction_sigma_deg": np.degrees(true.direction_sigma_rad).tolist(),
            "seen_half_angle_deg": float(np.degrees(patch.half_angle_rad)), **angles(patch),
            "irradiance": patch.irradiance.tolist(), "texels": len(patch.texels),
            "irradiance_sigma": emitter.irradiance_sigma.tolist(), "lower_bound": emitter.lower_bound,
        }
        for emitter, true, patch in zip(emitters, lit.emitters, kept, strict=True)
    }  # fmt: skip
    numbers["sky"] = {"share": 1 - sum(patch.share for patch in kept)}
    warnings = [f"{name(patch)} is left in the sky: only the {MOST} strongest lights are told apart" for patch in rest]
    warnings += [f"{one.name} is clipped: its irradiance is a lower bound" for one in emitters if one.lower_bound]
    rows = evidence(emitters, kept, wide, params) + widths(lit.emitters, kept, spread, params.width)
    return Result({"emitters": lit.emitters, "lighting": lit.environment}, numbers, warnings, rows)


def lighting(environment: Raster) -> Raster:
    """What of the map the later stages ask for."""
    channels = {name: values for name, values in environment.channels.items() if name in RENDERED}
    return Raster(channels, environment.space, environment.attributes)


def source(environment: Raster, patch: Patch) -> str:
    """Where the brightness of a light comes from: measured, recovered by the probe stage, or clipped."""
    if "clipped" not in environment.channels:
        return "measured"
    over = environment["clipped"].ravel()[patch.texels] > CLIPPED_PART
    if not over.any():
        return "measured"
    return "recovered" if environment["recovered"].ravel()[patch.texels][over].all() else "clipped"


def as_its_edge_says(environment: Raster, emitter: Emitter) -> Emitter:
    """A recovered lamp with direction and half angle of its shadow's edge, and their sigmas, if the map places it."""
    lamp = nearest(placed_in(environment), emitter.direction) if emitter.evidence == "recovered" else None
    if lamp is None:
        return emitter
    found = {
        "direction": np.array(lamp.direction), "direction_sigma_rad": np.array(lamp.direction_sigma),
        "half_angle_rad": lamp.half_angle, "half_angle_sigma_rad": lamp.half_angle_sigma,
    }  # fmt: skip
    return emitter.model_copy(update=found)


def is_sun(rgb: np.ndarray, found: list[Patch]) -> bool:
    """Whether the only light is above the horizon, narrow, and ``SUN_CONTRAST`` times brighter than the rest."""
    if len(found) != 1 or found[0].direction[1] <= 0 or np.degrees(found[0].half_angle_rad) >= SUN_HALF_ANGLE_DEG:
        return False
    patch = found[0]
    rest = total_energy(rgb).mean() * (1 - patch.share) / (4 * np.pi - patch.solid_angle_sr)
    return bool(patch.brightness > SUN_CONTRAST * rest)


def angles(patch: Patch) -> dict[str, float]:
    """Elevation over the horizon, and azimuth about +Y from +Z towards +X, degrees."""
    x, y, z = patch.direction
    return {
        "elevation_deg": float(np.degrees(np.arcsin(np.clip(y, -1, 1)))),
        "azimuth_deg": float(np.degrees(np.arctan2(x, z))),
    }


def name(patch: Patch) -> str:
    """A patch in words."""
    at = angles(patch)
    return (
        f"{patch.share:.1%} of the light at elevation {at['elevation_deg']:.0f}, azimuth {at['azimuth_deg']:.0f} "
        f"degrees, half angle {np.degrees(patch.half_angle_rad):.1f}"
    )


def evidence(
    emitters: list[Emitter], kept: list[Patch], wide: list[Patch], params: knobs.Lights
) -> list[dict[str, Any]]:
    """Why each bright patch is a light of its own, or sky."""
    rows = [
        {
            "term": f"{emitter.name} apart from the sky",
            "modelled": True,
            "because": f"{name(patch)}; {patch.brightness / patch.level:.0f} times brighter than its border",
            "could_cost": COSTS[emitter.evidence],
        }
        for emitter, patch in zip(emitters, kept, strict=True)
    ]
    rows += [
        {
            "term": "bright patch apart from the sky",
            "modelled": False,
            "because": f"{name(patch)}, wider than {params.max_half_angle_deg:g}: knob lights.max_half_angle_deg",
            "could_cost": "nothing: its shadow is soft, and the sky is sampled by brightness",
            "bound_rel": 0.0,
        }
        for patch in wide
    ]
    if not rows:
        because = f"no narrow patch that stands out holds {params.min_share:.1%} of the light, knob lights.min_share"
        rows.append({
            "term": "lights apart from the sky", "modelled": False, "because": because, "could_cost": "nothing",
            "bound_rel": 0.0, **TRIED,
        })  # fmt: skip
    return rows


def widths(lamps: list[Emitter], found: list[Patch], spread_rad: float, width: str) -> list[dict[str, Any]]:
    """Why each lamp is as wide as it is drawn; nothing of a map that no picture spread (``spread_rad`` = 0)."""
    rows: list[dict[str, Any]] = [placement(lamp, patch) for lamp, patch in zip(lamps, found) if is_placed(lamp)]
    for lamp, patch in zip(lamps, found, strict=True) if spread_rad > 0 else ():
        if is_placed(lamp):
            continue
        moved = width == "unblurred" and lamp.evidence == "measured"
        true = lamp.half_angle_rad if moved else half_angle_of(patch.half_angle_rad, spread_rad)
        seen_as = np.hypot(true, 2 * spread_rad) if moved else patch.half_angle_rad
        # Two distributions about one point whose widths have the ratio c differ by at most (1 - c) / 2 beyond an edge.
        ratio = true / max(seen_as, 1e-9)
        told = (
            f"half angle {np.degrees(seen_as):.2f} degrees in a picture that spreads points by "
            f"{np.degrees(spread_rad):.2f}"
        )
        if moved:
            because = f"{told}: {np.degrees(true):.2f} +- {np.degrees(lamp.half_angle_sigma_rad):.2f}"
        else:
            because = STAYS.get(lamp.evidence, f"knob lights.width = {width}; {told}")
        rows.append({
            "term": f"width of {lamp.name} without the picture's spread", "modelled": moved, "because": because,
            "could_cost": f"{(1 - ratio) / 2:.0%} of its light where its shadow ends",
            **({} if moved else {"bound_rel": (1 - ratio) / 2 * patch.share}),
        })  # fmt: skip
    return rows


def placement(lamp: Emitter, patch: Patch) -> dict[str, Any]:
    """Why a recovered lamp stands where it does, and is as wide as it is drawn."""
    level, upright = np.degrees(lamp.direction_sigma_rad)
    return {
        "term": f"place and width of {lamp.name} by its shadow's edge", "modelled": True,
        "because": f"half angle {np.degrees(lamp.half_angle_rad):.2f} +- {np.degrees(lamp.half_angle_sigma_rad):.2f} "
        f"degrees, direction +- {level:.3f} level and +- {upright:.3f} upright; the map's texels have "
        f"{np.degrees(patch.half_angle_rad):.2f}",
        "could_cost": "its sigmas: modes of the budget", "bound_rel": 0.0,
    }  # fmt: skip


STAGE = Stage(
    "lights", compute, knobs.Lights, inputs={"environment": ENVIRONMENT},
    outputs={"emitters": EMITTERS, "lighting": LIGHTING},
)  # fmt: skip
