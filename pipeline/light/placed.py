"""Lamps placed by the edge of a shadow: a disc's direction, half angle and how sure both are; drawn, and turned.

The map's own texels are too coarse for a sun (0.7 degrees at draft, for 0.53): what the edge says travels in the map's
header, as JSON, and a finer map is drawn with it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np

from pipeline.conventions import latlong_from_direction, latlong_solid_angles
from pipeline.types import Emitter, Raster

PLACED = "insitu:placed_lamps"
SUN_HALF_ANGLE = np.radians(0.2665)  # no lamp is taken to be narrower than the sun
POINTS = 4096  # that a disc is drawn with
NEAR = np.radians(1.5)  # from a lamp's middle as a map has it, texels and all, to where its shadow's edge puts it


@dataclass(frozen=True)
class Placed:
    """A disc: unit ``direction`` (3,), world; half angle [rad] with its sigma upwards; ``direction_sigma`` (2,) [rad].

    The latter along `axes_about` the direction: level, and upright.
    """

    direction: tuple[float, float, float]
    half_angle: float
    half_angle_sigma: float
    direction_sigma: tuple[float, float]


def header_of(lamps: list[Placed]) -> dict[str, str]:
    """What a map's header says of them; nothing without any."""
    return {PLACED: json.dumps([asdict(lamp) for lamp in lamps])} if lamps else {}


def placed_in(environment: Raster) -> list[Placed]:
    """Lamps that a map's header places."""
    rows = json.loads(str(environment.attributes.get(PLACED, "[]")))
    return [
        Placed(tuple(row["direction"]), row["half_angle"], row["half_angle_sigma"], tuple(row["direction_sigma"]))
        for row in rows
    ]


def nearest(lamps: list[Placed], direction: np.ndarray) -> Placed | None:
    """The lamp that stands where a light (3,) of the map does; None without one within `NEAR`."""
    found = max(lamps, key=lambda lamp: float(direction @ lamp.direction), default=None)
    return found if found is not None and direction @ found.direction > np.cos(NEAR) else None


def axes_about(direction: np.ndarray) -> np.ndarray:
    """Unit vectors (2, 3) across a direction: level, along Y x direction, and upright; of the zenith, level is X."""
    level = np.array([direction[2], 0.0, -direction[0]])
    length = np.linalg.norm(level)
    level = level / length if length > 1e-6 else np.array([1.0, 0, 0])
    return np.stack([level, np.cross(direction, level)])


def turned_to(direction: np.ndarray, level: float, upright: float) -> np.ndarray:
    """A direction (3,) turned by small angles [rad] along `axes_about` it."""
    moved = direction + np.array([level, upright]) @ axes_about(direction)
    return np.asarray(moved / np.linalg.norm(moved))


def disc_texels(direction: np.ndarray, half_angle: float, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels (N,), ascending, of a disc on a map of ``height`` rows, and its share (N,) in each; shares sum to 1."""
    r = half_angle * np.sqrt((np.arange(POINTS) + 0.5) / POINTS)
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(POINTS)
    across, up = axes_about(direction)
    w = np.cos(r)[:, None] * direction
    w = w + np.sin(r)[:, None] * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up)
    u, v = latlong_from_direction(w)
    row = np.minimum((v * height).astype(int), height - 1)
    column = np.minimum((u * 2 * height).astype(int), 2 * height - 1)
    texels, number = np.unique(row * 2 * height + column, return_counts=True)
    return texels, number / POINTS


def border(texels: np.ndarray, height: int) -> np.ndarray:
    """Texels (M,) of a map of ``height`` rows that touch a set of texels (N,) and are none of it; round the seam."""
    row, column = np.divmod(texels, 2 * height)
    step = np.array([-1, 0, 1])
    rows = np.clip(row[:, None, None] + step[:, None], 0, height - 1)
    columns = np.mod(column[:, None, None] + step, 2 * height)
    return np.setdiff1d(rows * 2 * height + columns, texels)


def draw_disc(rgb: np.ndarray, texels: np.ndarray, direction: np.ndarray, half_angle: float) -> np.ndarray:
    """Make a lamp on texels (N,) of a map (H * W, 3) a disc, in place; returns the disc's texels (M,), ascending.

    What its texels held over the median of their border becomes the disc's: its flux [radiance x sr] is kept exactly.
    """
    height = round(np.sqrt(len(rgb) / 2))
    solid = latlong_solid_angles(height, 2 * height).ravel()
    around = np.median(rgb[border(texels, height)], 0)
    flux = solid[texels] @ (rgb[texels] - around)
    rgb[texels] = around
    landed, share = disc_texels(direction, half_angle, height)
    rgb[landed] += share[:, None] * flux / solid[landed, None]
    return landed


def is_placed(emitter: Emitter) -> bool:
    """Whether a shadow's edge says where an emitter stands."""
    return bool(np.any(emitter.direction_sigma_rad > 0))


def without_placed(rgb: np.ndarray, emitters: list[Emitter]) -> np.ndarray:
    """A map (H, W, 3) with every placed lamp replaced by what borders on it."""
    rest = np.array(rgb, float)
    for emitter in emitters:
        if is_placed(emitter):
            texels = np.asarray(emitter.texels, int)
            flat = rest.reshape(-1, 3)
            flat[texels] = np.median(flat[border(texels, rgb.shape[0])], 0)
    return rest
