"""The map at another place than the probe's, through the walls of a room: what using it unmoved costs, and the cure.

The map is the light at the probe's centre. From a place ``q`` metres away, a wall at distance ``d`` lies in another
direction by about q / d, and a lamp on it is nearer or farther. Through a known room every ray of the new place hits a
point whose direction from the probe is known; radiance is conserved along rays (walls taken as diffuse), so the new
texel is the mean, by solid angle, of what its part of the map shows. Box projection as in Lagarde and Zanuttini, Local
Image-based Lighting with Parallax-corrected Cubemaps (2012), here for the light itself, not for a lookup.

Limits: walls, ceiling and the plane y = 0 only, which are convex, so nothing appears that the probe did not see; what
stands in the room moves with the wall behind it. Proxies need no place here: they are rendered where they stand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import direction_from_latlong, latlong_from_direction
from pipeline.light.environment import AXES, irradiance, resize_environment

PREDICTION_ROWS = 64  # rows of the map on which errors are predicted
ASSUMED_M = (1.0, 2.0, 4.0)  # distances for which the error is stated when none is known
WORTH = 0.75  # of the error: what is left at the centroid must be less, or nothing is moved
NORMALS = 96  # of a ball, on which light is compared; half of them face the camera
UP = 2  # of AXES
SPLIT = 3  # samples per texel and axis; more where the new place looks at the old map from afar

VALID, MEASURED = "insitu:valid_at_m", "insitu:measured_at_m"  # attributes of the map

Depth = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Room:
    """A box of walls: centre (3,), size (3,) in metres, turned about +Y, counter-clockwise seen from above."""

    centre: np.ndarray
    size: np.ndarray
    yaw_rad: float = 0.0

    def local(self, vectors: np.ndarray) -> np.ndarray:
        """World vectors (..., 3) along the axes of the box."""
        cosine, sine = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.asarray(vectors @ np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]))

    def holds(self, point: np.ndarray) -> bool:
        """Whether a point (3,) lies inside the walls and above the plane y = 0."""
        return bool((np.abs(self.local(point - self.centre)) < self.size / 2).all() and point[1] > 0)

    def depth(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance (...) from a point inside to the walls or to the plane y = 0, along unit directions (..., 3)."""
        start, way = self.local(origin - self.centre), self.local(directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = np.where(way == 0, np.inf, (np.copysign(self.size / 2, way) - start) / way).min(-1)
            ground = np.where(directions[..., 1] < 0, -origin[1] / directions[..., 1], np.inf)
        return np.asarray(np.minimum(walls, ground))


def sphere(centre: np.ndarray, radius: float) -> Depth:
    """Distance to a sphere from a point inside it, for walls of which nothing but a distance is assumed."""

    def depth(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        offset = origin - centre
        along = directions @ offset
        return np.asarray(np.sqrt(along**2 - offset @ offset + radius**2) - along)

    return depth


def relocate(maps: Sequence[np.ndarray], depth: Depth, source: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """Maps (H, W, C) valid at ``source`` (3,), as they are at ``target`` (3,); the same arrays when they coincide.

    A texel is the mean by solid angle of samples of the patches of constant radiance that the old texels are.
    """
    if np.array_equal(source, target):
        return list(maps)
    height, width = maps[0].shape[:2]
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    split = min(8, SPLIT + int(np.ceil(_compression(depth, source, target))))
    sums = [np.zeros(one.shape) for one in maps]
    u = np.arange(width)[None, :]
    for i in range(split):
        cosine = edges[:-1] + (edges[1:] - edges[:-1]) * (i + 0.5) / split
        v = (np.arccos(np.clip(cosine, -1, 1)) / np.pi)[:, None]
        for j in range(split):
            ways = direction_from_latlong((u + (j + 0.5) / split) / width, np.broadcast_to(v, (height, width)))
            point = target - source + depth(target, ways)[..., None] * ways
            old_u, old_v = latlong_from_direction(point)
            row = np.minimum((old_v * height).astype(int), height - 1)
            column = np.minimum((old_u * width).astype(int), width - 1)
            for total, one in zip(sums, maps, strict=True):
                total += one[row, column]
    return [total / split**2 for total in sums]


def _compression(depth: Depth, source: np.ndarray, target: np.ndarray) -> float:
    """Largest ratio of distances from target and from source to one surface point: old texels per new one, an axis."""
    v, u = np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(32) + 0.5) / 32, indexing="ij")
    ways = direction_from_latlong(u, v)
    far = depth(target, ways)
    near = np.linalg.norm(target - source + far[..., None] * ways, axis=-1)
    return float((far / np.maximum(near, 1e-9)).max())


def irradiance_errors(
    rgb: np.ndarray, depth: Depth, source: np.ndarray, used: np.ndarray, target: np.ndarray, normals: np.ndarray = AXES
) -> np.ndarray:
    """Relative errors (N,) of the irradiance of ``normals`` (N, 3) at ``target`` (3,), when the map of ``used`` serves.

    ``rgb`` (H, W, 3) is valid at ``source``; ``used`` (3,) is where it was brought to.
    """
    rows = min(PREDICTION_ROWS, rgb.shape[0])
    small = resize_environment(rgb, rows, 2 * rows)
    found, true = (irradiance(relocate([small], depth, source, place)[0], normals) for place in (used, target))
    return np.asarray(np.linalg.norm(found - true, axis=1) / np.maximum(np.linalg.norm(true, axis=1), 1e-300))


def error_on_objects(rgb: np.ndarray, depth: Depth, source: np.ndarray, target: np.ndarray, eye: np.ndarray) -> float:
    """Mean of these errors, unmoved, over what a ball at ``target`` shows a camera at ``eye`` (3,), by size there."""
    normals, seen = facing(eye - target)
    return float(irradiance_errors(rgb, depth, source, source, target, normals) @ seen)


def facing(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (N, 3) that a ball shows from direction ``way`` (3,), and shares (N,) of its picture; evenly spread.

    A spiral over the sphere (Swinbank and Purser 2006, Fibonacci grids), of which half is seen.
    """
    number = np.arange(NORMALS) + 0.5
    height, turn = 1 - 2 * number / NORMALS, np.pi * (1 + np.sqrt(5)) * number
    radius = np.sqrt(1 - height**2)
    every = np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], -1)
    cosine = every @ way / np.linalg.norm(way)
    return every[cosine > 0], cosine[cosine > 0] / cosine[cosine > 0].sum()


@dataclass(frozen=True)
class Assessment:
    """What the distance between probe and objects costs, and where the map should be brought to (None: nowhere)."""

    target: np.ndarray | None
    numbers: dict[str, Any]
    warnings: list[str]
    evidence: dict[str, Any]


def assess(
    rgb: np.ndarray, source: np.ndarray, objects: Sequence[np.ndarray], room: Room | None, budget: float,
    eye: np.ndarray,
) -> Assessment:  # fmt: skip
    """Error of the map of ``source`` (3,) at the ``objects`` [(3,)], and whether it exceeds the ``budget``.

    With a room the error is predicted, and cured at the objects' centroid when it is too large and that helps. Without,
    it is stated for the farthest object and walls all around at 1, 2 and 4 m. ``eye`` (3,): the plate's camera.
    """
    if not objects:
        return Assessment(None, {}, [], _reason(False, "no objects are placed", "nothing", 0.0))
    farthest = max(objects, key=lambda place: float(np.linalg.norm(place - source)))
    offset = float(np.linalg.norm(farthest - source))
    numbers: dict[str, Any] = {"near_offset_m": offset, "near_depth": "unknown" if room is None else "room"}
    if room is None:
        known = {
            d: float(irradiance_errors(rgb, sphere(source, d), source, source, farthest).max())
            for d in ASSUMED_M
            if offset < 0.9 * d
        }
        numbers["near_irradiance_error_if_walls_at"] = {f"{d:g}_m": error for d, error in known.items()}
        listed = ", ".join(f"{error:.1%} for walls at {d:g} m" for d, error in known.items()) or "offset beyond 4 m"
        cost = f"of irradiance, objects up to {offset:.2f} m from the probe: {listed}"
        because = "no [room]: distances are not known"
        return Assessment(None, numbers, [], _reason(False, because, cost, max(known.values(), default=None)))
    outside = [place for place in objects if not room.holds(place)]
    if outside:
        listed = ", ".join(f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in outside)
        warning = f"room: objects at {listed} m lie outside its walls; the map is left at the probe"
        cost = f"unknown, objects up to {offset:.2f} m from the probe"
        return Assessment(None, numbers, [warning], _reason(False, "objects lie outside the room", cost, None))
    target = np.mean(objects, 0)
    at = np.array([irradiance_errors(rgb, room.depth, source, source, place) for place in objects])
    error, plane = float(at.max()), float(at[:, UP].max())
    shown = max(error_on_objects(rgb, room.depth, source, place, eye) for place in objects)
    numbers |= {"near_irradiance_error": error, "near_plane_error": plane, "near_object_error": shown}
    cost = (
        f"{shown:.1%} of the light on what objects show, {plane:.1%} of it on the plane, {error:.1%} on the worst side"
    )
    needed = error > budget
    because = f"predicted through the room: {error:.2%} of irradiance at {offset:.2f} m; budget {budget:.2%}"
    if not needed:
        return Assessment(None, numbers, [], _reason(False, because, cost, error))
    left = max(float(irradiance_errors(rgb, room.depth, source, target, place).max()) for place in objects)
    numbers["near_irradiance_error_left"] = left
    if left > WORTH * error:
        because += f"; {left:.2%} would be left at their centroid: they stand around the probe, no one place serves all"
        warning = (
            f"near field: the light at the objects differs by {error:.1%} from that at the probe, on every side of it"
        )
        return Assessment(None, numbers, [warning], _reason(False, because, cost, error))
    cost += f"; {left:.2%} is left between the objects, with the error of the room and what hangs before its walls"
    return Assessment(target, numbers, [], _reason(True, because, cost, error))


def room_of(facts: dict[str, Any]) -> Room | None:
    """The box of capture.toml's [room], if there is one."""
    box = facts.get("room")
    return box and Room(np.array(box["centre_m"]), np.array(box["size_m"]), float(np.radians(box["yaw_deg"])))


def places_of(wishes: dict[str, Any], height: float) -> list[np.ndarray]:
    """Where the objects are [(3,)], world frame: at ``height`` [m] over their foot, as the probe is over its own."""
    return [
        np.array([wish["position_m"][0], wish.get("lift_m", 0.0) + height, wish["position_m"][1]])
        for wish in wishes.get("object", [])
    ]


def at_probe(rgb: np.ndarray, attributes: dict[str, Any], room: Room | None) -> np.ndarray:
    """A map (H, W, 3) as the probe saw it, from one that was brought elsewhere: see `places` for its ``attributes``."""
    return _between(rgb, attributes, room, VALID, MEASURED)


def from_probe(rgb: np.ndarray, attributes: dict[str, Any], room: Room | None) -> np.ndarray:
    """A map (H, W, 3) of the probe's place, brought to where the map with these ``attributes`` holds."""
    return _between(rgb, attributes, room, MEASURED, VALID)


def _between(rgb: np.ndarray, attributes: dict[str, Any], room: Room | None, start: str, end: str) -> np.ndarray:
    if room is None or VALID not in attributes or MEASURED not in attributes:
        return rgb
    source, target = (np.array([float(x) for x in attributes[key].split()]) for key in (start, end))
    return relocate([rgb], room.depth, source, target)[0]


def places(valid: np.ndarray, measured: np.ndarray) -> dict[str, str]:
    """Header of a map: the world positions (3,) at which it holds and at which it was measured, metres."""
    return {VALID: " ".join(map(repr, valid.tolist())), MEASURED: " ".join(map(repr, measured.tolist()))}


def _reason(modelled: bool, because: str, cost: str, bound: float | None) -> dict[str, Any]:
    return {
        "term": "near field: the map at the objects", "modelled": modelled, "because": because, "could_cost": cost,
        **({"no_bound": "objects lie beyond known or assumed walls"} if bound is None else {"bound_rel": bound}),
    }  # fmt: skip
