"""The plane under a mirror ball, put where it is: near, so that the ball's mirrored directions are not its own.

A mirrored ray leaves the ball up to 2 R above the plane, so the edge of the table and all that lies on it show lower
in a map of mirrored directions than they are seen from the ball's centre: by up to R over their distance, 3 degrees at
0.8 m for a ball of 80 mm. What lies below the horizon is taken to be the plane y = 0 on which the ball stands: the
texel of a direction shows what the ball mirrors of the plane's point there. At the horizon both agree, so that what
lies beyond the plane's end moves by less than it did.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.conventions import latlong_directions, latlong_from_direction
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.glass import Glass
from pipeline.probes.observation import ViewMap

STEPS = 30  # of the reflection point: each gains a factor of about the distance over R
SETTLED = 1e-4  # of the radius: what the last step may move the reflection point


def mirrored_directions(
    points: np.ndarray, centre: np.ndarray, radius: float, camera: np.ndarray, glass: Glass | None = None
) -> np.ndarray:
    """Unit directions (N, 3) in which the ball's mirrored rays leave it towards finite ``points`` (N, 3), world frame.

    The reflection point is where the normal halves the ways to ``camera`` (3,) and to the point; NaN where the steps
    do not settle, or the camera does not see it. Behind ``glass`` it is that of `Glass.virtual`, whose size goes with
    the angle.
    """
    normal = _unit(_unit(points - centre) + _unit(camera - centre))
    moved = np.full(len(points), np.inf)
    for _ in range(STEPS):
        place = centre + _reach(normal, centre, radius, camera, glass)[0] * normal
        better = _unit(_unit(points - place) + _unit(camera - place))
        moved = np.linalg.norm(better - normal, axis=-1)
        normal = better
        if not len(moved) or moved.max() < 0.1 * SETTLED:
            break
    reach, seen = _reach(normal, centre, radius, camera, glass)
    place = centre + reach * normal
    away = _unit(points - place)
    good = (moved < SETTLED) & seen & ((away * normal).sum(-1) > 0)
    return np.where(good[:, None], away, np.nan)


def _reach(
    normal: np.ndarray, centre: np.ndarray, radius: float, camera: np.ndarray, glass: Glass | None
) -> tuple[np.ndarray, np.ndarray]:
    """How far (N, 1) from the centre, along normals (N, 3), light is mirrored, and whether the camera sees it (N,)."""
    reach = np.full((len(normal), 1), radius)
    to_camera = camera - centre - reach * normal
    if glass is None:
        return reach, (to_camera * normal).sum(-1) > 0
    angle = np.arctan2(np.linalg.norm(np.cross(to_camera, normal), axis=-1), (to_camera * normal).sum(-1))
    size, seen = glass.virtual(angle)
    return radius * size[:, None], seen


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt(np.einsum("...i,...i", vectors, vectors))[..., None]


def set_down(
    view: ViewMap, centre: np.ndarray, radius: float, camera: np.ndarray, glass: Glass | None = None
) -> ViewMap:  # fmt: skip
    """A view's map with what is below the horizon taken from the plane y = 0, seen from the ball's centre.

    ``centre`` and ``camera`` (3,) in the world. Directions whose reflection does not settle keep what they had: points
    at the ball's foot that it hides from the camera.
    """
    height, width = view.coverage.shape
    below = slice(height // 2, height)
    w = latlong_directions(height, width)[below].reshape(-1, 3)
    points = centre - w * (centre[1] / w[:, 1])[:, None]
    away = mirrored_directions(points, centre, radius, camera, glass)
    away = np.where(np.isfinite(away), away, w)
    u, v = latlong_from_direction(away)
    shape = (height - height // 2, width)
    stack = _stacked(view)
    around = planes(np.concatenate([stack[:, -1:], stack, stack[:, :1]], 1))
    found = bilinear(around, (u * width + 1).reshape(shape), (v * height).reshape(shape))
    return _unstacked(view, np.concatenate([stack[: height // 2], found]))


def _stacked(view: ViewMap) -> np.ndarray:
    """(H, W, 9): what moves with the light: radiance and variance times coverage; coverage, weight, clipped."""
    covered = view.coverage[..., None]
    flags = [np.broadcast_to(part, view.coverage.shape) for part in (view.coverage, view.weight, view.clipped)]
    return np.concatenate([view.rgb * covered, view.variance * covered, np.stack(flags, -1)], -1)


def _unstacked(view: ViewMap, stack: np.ndarray) -> ViewMap:
    coverage = stack[..., 6]
    safe = np.where(coverage > 0, coverage, 1)[..., None]
    return replace(
        view, rgb=stack[..., :3] / safe, variance=stack[..., 3:6] / safe, coverage=coverage, weight=stack[..., 7],
        clipped=stack[..., 8],
    )  # fmt: skip
