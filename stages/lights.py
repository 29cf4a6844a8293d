"""Find the compact lights of the environment: suns and lamps that cast hard shadows; the rest is sky.

A light is a connected set of the map's texels that stands out sharply, is narrow, and carries a share of the light that
matters (`pipeline.light.emitters`). Nothing is fitted or moved: the light of a group is the map on its texels, so that
lights and sky sum to the map exactly, and what the probe measured stays what is rendered. What was clipped and not
recovered is said to be a lower bound. Limits: a lamp is as sharp as the probe saw it; light is distant; windows and
tubes that are wide stay in the sky, which the renderer samples by brightness.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.light.alike import flux_sigma
from pipeline.light.emitters import Patch, lights
from pipeline.light.environment import total_energy
from pipeline.run.artifacts import EMITTERS, ENVIRONMENT
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
# A sun, by what no lamp in a room is at once: the only light, above, a disc of half a degree as a probe blurs it, and
# brighter than the mean of all else by this.
SUN_HALF_ANGLE_DEG, SUN_CONTRAST = 2.0, 100.0


def compute(environment: Raster, params: knobs.Lights) -> Result:
    """Compact lights of the map, strongest first; an empty list when the map is all sky."""
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
    numbers = {
        emitter.name: {
            "share": patch.share, "half_angle_deg": float(np.degrees(patch.half_angle_rad)), **angles(patch),
            "irradiance": patch.irradiance.tolist(), "texels": len(patch.texels),
            "irradiance_sigma": emitter.irradiance_sigma.tolist(), "lower_bound": emitter.lower_bound,
        }
        for emitter, patch in zip(emitters, kept, strict=True)
    }  # fmt: skip
    numbers["sky"] = {"share": 1 - sum(patch.share for patch in kept)}
    warnings = [f"{name(patch)} is left in the sky: only the {MOST} strongest lights are told apart" for patch in rest]
    warnings += [f"{one.name} is clipped: its irradiance is a lower bound" for one in emitters if one.lower_bound]
    return Result({"emitters": emitters}, numbers, warnings, evidence(emitters, kept, wide, params))


def source(environment: Raster, patch: Patch) -> str:
    """Where the brightness of a light comes from: measured, recovered by the probe stage, or clipped."""
    if "clipped" not in environment.channels:
        return "measured"
    over = environment["clipped"].ravel()[patch.texels] > CLIPPED_PART
    if not over.any():
        return "measured"
    return "recovered" if environment["recovered"].ravel()[patch.texels][over].all() else "clipped"


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


STAGE = Stage(
    "lights", compute, knobs.Lights, inputs={"environment": ENVIRONMENT}, outputs={"emitters": EMITTERS}
)  # fmt: skip
