"""A stitched 360-degree panorama, taken near the objects: a ready-made map whose rotation is found from the plate.

The rotation is, in this order, stated; from points that were clicked in panorama and plate; from features that both
show; from the yaw at which its tones are the plate's; else it is asked for. The patch where tripod or hand stood is
taken as not seen: the plate's plane is laid there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions
from pipeline.probes import orientation
from pipeline.probes.observation import Grid, Observation, Shots
from pipeline.probes.ready_made import LatLong, centre_of, clean, finished, rotation_of
from pipeline.probes.resample import turned
from pipeline.run.errors import CaptureError
from pipeline.run.formats import read_latlong

ON_TONES = 128, 256  # texels on which tones are compared
SOFT_DEG = 3.0  # over which the nadir patch fades out


class Panorama:
    """A panorama from where the objects will stand, or near it."""

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        """One map. Raises CaptureError when nothing says how the panorama is turned."""
        probe = shots.facts["probe"]
        light = clean(read_latlong(Path(probe["path"])), probe, "panorama")
        found = oriented(light, shots)
        turn = turned(light.channels(), found.rotation, grid.height, grid.width, grid.supersample)
        up = found.rotation @ np.array(probe["up"], float) / np.linalg.norm(probe["up"])
        shown = 1 - nadir(grid.height, grid.width, -up, float(probe["nadir_deg"]))
        seen = finished("panorama", light, turn, found.sigma_rad, shots, taken_here=True, seen=shown)
        told = {"route": found.route, "sigma_deg": float(np.degrees(found.sigma_rad)), **found.numbers}
        numbers = seen.numbers | {"orientation": told | {"world_from_map": found.rotation.tolist()}}
        return replace(seen, numbers=numbers, evidence=[*seen.evidence, *reasons(shots, found)])


def oriented(light: LatLong, shots: Shots) -> orientation.Orientation:
    """How the panorama is turned; see the module's first lines for the order."""
    probe, up = shots.facts["probe"], np.array(shots.facts["probe"]["up"], float)
    level = float(np.radians(probe["orientation_sigma_deg"]))
    if probe["yaw_deg"] is not None:
        rotation = rotation_of(float(probe["yaw_deg"]), up)
        return orientation.Orientation(rotation, np.eye(3) * level**2, "stated", {})
    centre = centre_of(probe)
    if probe["point"]:
        size = light.rgb.shape[0], light.rgb.shape[1]
        pairs = orientation.clicked(probe["point"], size, shots, centre, float(probe["point_sigma_px"]))
        return orientation.from_points(*pairs, up, level)
    found = orientation.from_features(light.rgb, light.valid, shots, centre)
    if found is None:
        upright = rotation_of(0.0, up)
        turn = turned(light.channels(), upright, *ON_TONES, 2)
        found = orientation.from_tones(turn.values[..., :3], turn.values[..., 3] > 0.99, shots, centre, upright, level)
    if found is None:
        raise CaptureError(
            "panorama: it shares too few features with the plate to say how it is turned, needed "
            f"{orientation.FEWEST_MATCHES}, and no yaw makes it look like the plate; click one lamp or "
            "corner in both ([[probe.point]] px, plate_px), or state probe.yaw_deg"
        )
    return found


def nadir(height: int, width: int, down: np.ndarray, half_angle_deg: float) -> np.ndarray:
    """Softness (H, W): 1 within ``half_angle_deg`` of ``down`` (3,), 0 from 3 degrees outside it."""
    if half_angle_deg <= 0:
        return np.zeros((height, width))
    angle = np.degrees(np.arccos(np.clip(latlong_directions(height, width) @ down, -1, 1)))
    return np.asarray(np.clip((half_angle_deg + SOFT_DEG - angle) / SOFT_DEG, 0, 1))


def reasons(shots: Shots, found: orientation.Orientation) -> list[dict[str, Any]]:
    """How the rotation came about, and what is hidden."""
    because = {
        "stated": "probe.yaw_deg states it",
        "points": f"{found.numbers.get('points')} clicked points and the panorama's up",
        "tones": f"at this yaw its tones correlate with the plate's by {found.numbers.get('correlation', 0):.2f}, at "
        f"others by {found.numbers.get('second', 0):.2f} at most",
        "features": f"{found.numbers.get('agree')} of {found.numbers.get('matches')} features agree with the plate to "
        f"{found.numbers.get('rms_deg', 0):.2f} degrees",
    }[found.route]
    half = float(shots.facts["probe"]["nadir_deg"])
    return [
        {
            "term": "rotation of the panorama",
            "modelled": True,
            "because": because,
            "could_cost": f"lamps and shadows turned by {np.degrees(found.sigma_rad):.2f} degrees",
        },
        {
            "term": "patch at the nadir taken as not seen",
            "modelled": half > 0,
            "because": f"probe.nadir_deg = {half:g}: tripod, hand or a painted patch is there",
            "could_cost": "without it, a stitcher's patch as light from below",
            "no_bound": "nothing tells what was painted there",
        },
    ]
