"""Photographs of one ray-traced ball by a chequered board, as the tests of its surface and of its shape want them."""

from __future__ import annotations

import functools

import numpy as np
from mirror_scene import Lamp, Place, look_at, photograph, sky

from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes.ball_pairs import Sight
from pipeline.types import Camera

RADIUS = 0.04
CAMERA = Camera(
    width=420, height=320, fx=1200, fy=1201, cx=205, cy=150, distortion=np.array([-0.08, 0.02, 5e-4, -3e-4, 0])
)
POSES = {"a": look_at((0.08, 0.27, 0.40), (0.05, 0.02, 0)), "b": look_at((0.45, 0.30, 0.05), (0.05, 0.02, 0))}
ROOM = sky([Lamp((0.3, 0.8, 0.4), 0.06, 200.0)])
BALL = (0.02, RADIUS, 0.01)
TRUE = np.array([0.93, 0.90, 0.85])


def channels(picture: np.ndarray, noise: float = 0.003) -> np.ndarray:
    """What `lookup_channels` makes of a photograph."""
    flags = np.zeros((*picture.shape[:2], 2))
    flags[..., 0] = 1
    return np.concatenate([picture, (noise * picture) ** 2, flags], -1).astype(np.float32)


SPOTS = {"below": (np.array([0.55, -0.25, 0.75]), 0.10), "above": (np.array([0.5, 0.75, 0.4]), 0.09)}


def dirty(normal: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Half of the light is lost on two spots of the body."""
    rgb = np.broadcast_to(TRUE, (*np.shape(cosine), 3)).copy()
    for axis, size in SPOTS.values():
        rgb[normal @ (axis / np.linalg.norm(axis)) > np.cos(size)] *= 0.5
    return rgb


@functools.cache
def sights(spotted: bool) -> dict[str, Sight]:
    place = Place(ROOM, plane=True, ball=BALL, reflectance=dirty if spotted else tuple(TRUE))
    found = {}
    for view, pose in POSES.items():
        picture = photograph(place, CAMERA, pose, 2, 0.003, 3)
        found[view] = Sight(
            channels(picture), CAMERA, pose, transform_points(invert_rigid(pose), np.array(BALL)), RADIUS
        )
    return found
