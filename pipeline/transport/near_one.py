"""Worlds that a renderer of single precision cannot hold: brought near the origin, and near a metre.

A renderer starts each ray a little off its surface, by about 1e-4 of (1 m + distance from the origin); a millimetre's
world, or one a kilometre from its origin, loses its contact shadows to that, and its vertices to rounding. Light is
distant and radiance knows no length, so a world moved and scaled as a whole gives the same picture. Worlds of common
size near their origin are left as they are. Scales are powers of two: exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from pipeline.types import Occluder, Plane, Proxy

NEAREST_M, FARTHEST_M = 0.25, 256.0  # distance from the camera to the objects that is left as it is
FAR_OUT = 4.0  # such distances from the origin to the camera, from which on the world is moved
Mesh = TypeVar("Mesh", Proxy, Occluder)


@dataclass(frozen=True, eq=False)
class Moved:
    """The world's points p become ``scale * (p - origin_m)``."""

    origin_m: np.ndarray  # (3,)
    scale: float

    def points(self, world_m: np.ndarray) -> np.ndarray:
        """Points (..., 3)."""
        return (world_m - self.origin_m) * self.scale

    def pose(self, world_from_camera: np.ndarray) -> np.ndarray:
        """A camera's (4, 4)."""
        moved = np.array(world_from_camera, float)
        moved[:3, 3] = self.points(moved[:3, 3])
        return moved

    def plane(self, plane: Plane) -> Plane:
        """The local scene's plane."""
        offset = (plane.offset_m - float(plane.normal @ self.origin_m)) * self.scale
        return plane.model_copy(update={"offset_m": offset, "corners_m": self.points(plane.corners_m)})

    def meshes(self, things: list[Mesh]) -> list[Mesh]:
        """Proxies, or occluders; those that are masks stay."""
        return [
            thing
            if thing.vertices_m is None
            else thing.model_copy(update={"vertices_m": self.points(thing.vertices_m)})
            for thing in things
        ]

    def wishes(self, wishes: dict[str, Any]) -> dict[str, Any]:
        """Objects where and as large as wished."""
        x, _, z = self.origin_m
        objects = [
            wish
            | {
                "position_m": ((wish["position_m"][0] - x) * self.scale, (wish["position_m"][1] - z) * self.scale),
                "lift_m": wish["lift_m"] * self.scale,
                "scale": wish["scale"] * self.scale,
            }
            for wish in wishes["object"]
        ]
        return wishes | {"object": objects}


def near_one(world_from_camera: np.ndarray, feet_m: np.ndarray) -> Moved | None:
    """What brings a world to a renderer's precision, None where it is so already.

    Args:
        world_from_camera: (4, 4) of the plate.
        feet_m: (N, 3) where the objects stand, N > 0.
    """
    eye, foot = world_from_camera[:3, 3], feet_m.mean(0)
    distance = float(np.linalg.norm(eye - foot))
    near = np.linalg.norm(eye) <= FAR_OUT * distance
    if distance == 0 or (near and NEAREST_M <= distance <= FARTHEST_M):
        return None
    usual = NEAREST_M <= distance <= FARTHEST_M
    return Moved(np.zeros(3) if near else foot, 1.0 if usual else float(2.0 ** -np.round(np.log2(distance))))
