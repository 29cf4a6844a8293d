"""A procedural room as seen from the table: radiance by direction, in ACEScg.

Directions are given by azimuth (0 looks along -Z, 90 degrees along +X) and elevation. Everything has soft edges, so
that the map need not be finer than they are.
"""

from __future__ import annotations

import numpy as np

from pipeline.conventions import direction_from_latlong, latlong_directions
from pipeline.simulation.scene_file import LightFacts

SMALL_DEG = 2.0  # diameter of a lamp below which samples by chance say too little of it
FINE = 48  # points along a side of a texel that a small lamp lies in


def unit_direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """(3,) world direction."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)])


def smooth_step(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below low, 1 above high, cubic between."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def room_radiance(light: LightFacts, direction: np.ndarray) -> np.ndarray:
    """Walls, ceiling and floor (..., 3): a wall that fades upwards into the ceiling and ends softly at the floor."""
    y = direction[..., 1]
    azimuth = np.arctan2(direction[..., 0], -direction[..., 2])
    wall = (
        np.asarray(light.wall)
        * (1 + light.wall_variation * np.cos(azimuth - np.radians(light.wall_azimuth_deg)))[..., None]
    )
    upper = smooth_step(y, 0.35, 0.75)[..., None]
    lower = smooth_step(-y, 0.20, 0.45)[..., None]
    value = wall * (1 - upper) + np.asarray(light.ceiling) * upper
    return value * (1 - lower) + np.asarray(light.floor) * lower


def box_mask(direction: np.ndarray, axis: np.ndarray, half_deg: tuple[float, float], edge_deg: float) -> np.ndarray:
    """1 inside a rectangle of tangent-plane half sizes (horizontal, vertical) about ``axis``, soft at its edge."""
    right = np.cross(axis, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, axis)
    depth = direction @ axis
    safe = np.where(depth > 1e-3, depth, 1.0)
    edge = np.tan(np.radians(edge_deg))
    mask = (depth > 1e-3).astype(float)
    for side, half in ((right, half_deg[0]), (up, half_deg[1])):
        mask = mask * smooth_step(np.tan(np.radians(half)) - np.abs(direction @ side / safe), -edge / 2, edge / 2)
    return mask


def radiance(light: LightFacts, direction: np.ndarray) -> np.ndarray:
    """ACEScg radiance (..., 3) from unit directions (..., 3), in the capture's unit."""
    value = room_radiance(light, direction)
    for box in light.softbox:
        axis = unit_direction(box.azimuth_deg, box.elevation_deg)
        mask = box_mask(direction, axis, box.half_deg, box.edge_deg)
        if box.bar_deg > 0:
            upright = box_mask(direction, axis, (box.bar_deg, 89.0), box.edge_deg)
            across = box_mask(direction, axis, (89.0, box.bar_deg), box.edge_deg)
            mask = mask * (1 - upright) * (1 - across)
        value = value + mask[..., None] * (np.asarray(box.radiance) - value)
    for lamp in light.lamp:
        cosine = direction @ unit_direction(lamp.azimuth_deg, lamp.elevation_deg)
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        mask = smooth_step(lamp.diameter_deg / 2 - angle, -lamp.edge_deg / 2, lamp.edge_deg / 2)
        value = value + mask[..., None] * (np.asarray(lamp.radiance) - value)
    return value * light.scale


def mitsuba_envmap(light: LightFacts) -> np.ndarray:
    """(H, W, 3) float32 at the texels of Mitsuba's ``envmap``: columns half-texel, rows from pole to pole."""
    width, height = light.map_width, light.map_width // 2 + 1
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, np.arange(height) / (height - 1))
    return radiance(light, direction_from_latlong(u, v)).astype(np.float32)


def with_small_lamps(light: LightFacts, picture: np.ndarray) -> np.ndarray:
    """A lat-long picture (H, W, 3) of the place, its texels about small lamps replaced by exact means of the map.

    For a place from which nothing hides those lamps. A texel's samples would meet a sun by chance: of 64, its flux is
    8 % uncertain. The map is read as Mitsuba reads it, between texels linearly.
    """
    small = [lamp for lamp in light.lamp if lamp.diameter_deg < SMALL_DEG]
    if not small:
        return picture
    from scipy.ndimage import map_coordinates

    height, width = picture.shape[:2]
    directions, result = latlong_directions(height, width), picture.copy()
    texels = mitsuba_envmap(light).astype(float)
    texels = np.concatenate([texels[:, -1:], texels, texels[:, :1]], 1)
    step = (np.arange(FINE) + 0.5) / FINE
    for lamp in small:
        reach = np.cos(np.radians(lamp.diameter_deg / 2 + lamp.edge_deg) + 1.5 * np.pi / height)
        for row, column in np.argwhere(directions @ unit_direction(lamp.azimuth_deg, lamp.elevation_deg) > reach):
            top, bottom = np.cos(np.pi * np.array([row, row + 1]) / height)
            v = np.arccos(top + (bottom - top) * step) / np.pi  # even in solid angle
            u = (column + step) / width
            at = np.broadcast_arrays(v[:, None] * (len(texels) - 1), u[None, :] * (texels.shape[1] - 2) + 0.5)
            seen = [map_coordinates(texels[..., c], at, order=1).mean() for c in range(3)]
            result[row, column] = seen
    return result
