"""How well a sun that is clipped in every frame is recovered from the ball's shadow, over elevation and contrast.

The whole probe stage runs on photographs of `benchmarks.flux_scene`: noise of 1 % per pixel, a lens blur of 0.7 px,
everything over 30 times the mean sky clipped in the ball photograph, a ball of 100 px.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks import flux_scene
from stages import knobs, probe

ELEVATIONS_DEG, CONTRASTS = (15.0, 45.0, 75.0), (1e3, 1e4, 1e5, 1e6)
AZIMUTH_DEG = 120.0
CLIP = 30.0  # times the sky's mean
COLOUR = np.array([1.0, 0.9, 0.8])
WIDTH = 512  # of the map
EVIDENCE = 0.1  # stated relative uncertainty up to which a flux counts as known


def rows(
    elevations_deg: tuple[float, ...] = ELEVATIONS_DEG, contrasts: tuple[float, ...] = CONTRASTS
) -> list[dict[str, Any]]:
    """One row per elevation and contrast (radiance of the sun over the mean sky's).

    ``clipped_by``: true flux over the clipped; ``flux_rel_err``: of the worst channel; ``flux_sigma``: what was
    predicted for that channel, relative to the truth; both None where the stage leaves a lower bound, with its ``why``.
    """
    found = []
    solid_angle = 2 * np.pi * (1 - np.cos(flux_scene.SUN))
    for elevation in elevations_deg:
        sun = flux_scene.Lamp(flux_scene.from_angles(elevation, AZIMUTH_DEG), np.ones(3))
        scene = flux_scene.with_lamps(flux_scene.standard(), sun)
        pictures = flux_scene.photograph(scene)
        for number, contrast in enumerate(contrasts):
            flux = contrast * solid_angle * COLOUR
            found.append({"elevation_deg": elevation, "contrast": contrast, **row(scene, pictures, flux, number)})
    return found


def row(scene: flux_scene.Scene, pictures: flux_scene.Pictures, flux: np.ndarray, seed: int) -> dict[str, Any]:
    """What the stage makes of one sun of this flux (3,)."""
    plate, ball = pictures.at([flux])
    photographs = {
        "plate": flux_scene.raster(plate, np.inf, 2 * seed), "ball": flux_scene.raster(ball, CLIP, 2 * seed + 1)
    }  # fmt: skip
    view = flux_scene.view(scene.world_from_camera)
    facts, views = flux_scene.facts(scene), {"plate": view, "ball": view}
    params = knobs.Probe(width=WIDTH)
    result = probe.compute(
        facts=facts, photographs=photographs, camera=scene.camera, views=views, balance={}, wishes={}, params=params
    )
    lamp = result.numbers["clipped_lights"][0]
    error = np.array(lamp["flux"]) / flux - 1
    worst = int(np.argmax(np.abs(error)))
    told = not lamp["lower_bound"]
    return {
        "clipped_by": float(np.mean(flux / lamp["bound"])), "flux_rel_err": float(error[worst]) if told else None,
        "flux_sigma": float(lamp["flux_sigma"][worst] / flux[worst]) if told else None,
        "condition": lamp["condition"], "why": lamp["why_not"], "sun_share": lamp["share"],
    }  # fmt: skip


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Median and worst error of what was recovered, and how often it lies within 1 and 2 predicted sigma.

    ``sun_flux_rel_err`` is the worst with evidence, that is with a stated sigma of `EVIDENCE` or better;
    ``sun_flux_rel_err_all`` the worst of all.
    """
    error = np.abs([one["flux_rel_err"] for one in found if one["flux_rel_err"] is not None])
    sigma = np.array([one["flux_sigma"] for one in found if one["flux_sigma"] is not None])
    if not len(error):
        return {"recovered": 0}
    return {
        "recovered": len(error), "asked": len(found), "sun_flux_rel_err": float(error[sigma <= EVIDENCE].max()),
        "with_evidence": int((sigma <= EVIDENCE).sum()), "sun_flux_rel_err_all": float(error.max()),
        "sun_flux_rel_err_median": float(np.median(error)),
        "within_1_sigma": float((error < sigma).mean()), "within_2_sigma": float((error < 2 * sigma).mean()),
    }  # fmt: skip
