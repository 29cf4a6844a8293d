"""Rays of Mitsuba from numpy arrays: whether they are free, and what stands before points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.run.errors import ToolError
from pipeline.transport.scene import proxy_shape
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Proxy

RAYS = 1 << 21  # per batch
SHORT = 1e-5  # of the way: how far before a point a ray to it ends, 80 steps of float32


def arrays_of_rays(what: str) -> Any:
    """The mitsuba module, for code that traces arrays. Raises ToolError where only the scalar variant loads."""
    mi = use_mitsuba()
    if mi.variant().startswith("scalar"):
        raise ToolError(f"{what} need LLVM or CUDA, found only {mi.variant()}; run insitu doctor")
    return mi


def batches(count: int, rays: int = 1) -> list[slice]:
    """Slices that cover ``count`` things of so many ``rays`` each, at most ``RAYS`` of these in one."""
    step = max(1, RAYS // rays)
    return [slice(first, min(first + step, count)) for first in range(0, count, step)]


def rays_along(mi: Any, start: np.ndarray, direction: np.ndarray, reach: np.ndarray | float) -> Any:
    """Mitsuba's rays from ``start`` (N, 3) along ``direction`` (N, 3), as long as ``reach`` (N,) in units of that."""
    vectors = [np.ascontiguousarray(a.T, np.float32) for a in (start, direction)]
    far = np.array(np.broadcast_to(np.minimum(reach, 1e30), len(start)), np.float32)
    return mi.Ray3f(mi.Point3f(vectors[0]), mi.Vector3f(vectors[1]), mi.Float(far), 0.0, [])


def clear(mi: Any, scene: Any, start: np.ndarray, direction: np.ndarray, reach: np.ndarray | float) -> np.ndarray:
    """(N,) bool: whether `rays_along` meet nothing of a scene."""
    reach = np.broadcast_to(reach, len(start))
    found = [
        ~np.array(scene.ray_test(rays_along(mi, start[part], direction[part], reach[part])), bool)
        for part in batches(len(start))
    ]
    return np.concatenate(found) if found else np.zeros(0, bool)


def hidden_by(proxies: Sequence[Proxy], eye: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) bool: whether a face of a proxy, seen from either side, stands between the eye (3,) and points (N, 3).

    Raises ToolError where only the scalar variant loads.
    """
    if not len(proxies) or not len(points):
        return np.zeros(len(points), bool)
    mi = arrays_of_rays("composite: proxies before pixels whose albedo was not seen")
    shapes = {f"proxy_{number:04d}": proxy_shape(mi, proxy, None) for number, proxy in enumerate(proxies)}
    scene = mi.load_dict({"type": "scene", **shapes})
    return ~clear(mi, scene, np.broadcast_to(eye, points.shape), points - eye, 1 - SHORT)
