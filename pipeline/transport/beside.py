"""Which flat surfaces beside the plane, found in the cloud, the objects would change, and so are worth modelling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.camera.planes_in_cloud import Found
from pipeline.camera.rigid import camera_points
from pipeline.transport.extent import Standing
from pipeline.transport.influence import expected, influence, light_on
from pipeline.types import Camera, Emitter, Proxy, View

GRID = 8  # points along each side of a surface
ON_PROXY = 0.05  # of a surface's size: nearer to a stated proxy it is that proxy


def weighed(
    surface: Found, objects: Sequence[Standing], proxies: Sequence[Proxy], environment: np.ndarray,
    emitters: Sequence[Emitter], camera: Camera, view: View,
) -> dict[str, Any]:  # fmt: skip
    """What a found surface is and what the objects can change on it, as written into the record.

    ``change``: largest relative change of its light to be expected, of diffuse balls in the objects' place, and
    ``change_bound`` what it cannot exceed. ``seen_px``: area of its outline in the plate [px], 0 when it faces away.
    ``of_object``: the share of the nearest object's surroundings (4 pi) that it fills.
    """
    points = over(surface.corners_m)
    light = light_on(surface.normal, environment, emitters)
    bound, change = np.zeros(len(points)), np.zeros(len(points))
    for thing in objects:
        bound += influence(points, thing.sphere[None], light, thing.emission)
        change += expected(points, thing.sphere, light, thing.albedo, thing.emission)
    centres = np.array([thing.sphere[:3] for thing in objects]).reshape(-1, 3)
    arms = points[None] - centres[:, None]
    distance = np.linalg.norm(arms, axis=2)
    cosine = np.maximum(-(arms @ surface.normal) / np.maximum(distance, 1e-12), 0)
    filled = (cosine / np.maximum(distance, 1e-12) ** 2).mean(1) * surface.area_m2 / (4 * np.pi)
    return {
        "area_m2": surface.area_m2, "normal": surface.normal.tolist(), "corners_m": surface.corners_m.tolist(),
        "points": len(surface.members), "normal_sigma_deg": surface.sigma_deg, "place_sigma_m": surface.sigma_m,
        "scatter_m": surface.fit.scatter_m, "distance_m": float(distance.min(initial=np.inf)),
        "of_object": float(filled.max(initial=0.0)), "change_bound": float(bound.max()),
        "change": float(change.max()), "seen_px": seen_px(surface, camera, view),
        "described": described(points, surface, proxies),
    }  # fmt: skip


def over(corners_m: np.ndarray) -> np.ndarray:
    """(GRID^2, 3) points spread over a parallelogram (4, 3)."""
    share = (np.arange(GRID) + 0.5) / GRID
    a, b = np.meshgrid(share, share)
    along, up = corners_m[1] - corners_m[0], corners_m[3] - corners_m[0]
    return np.asarray(corners_m[0] + a.reshape(-1, 1) * along + b.reshape(-1, 1) * up)


def seen_px(surface: Found, camera: Camera, view: View) -> float:
    """Area [px] of a surface's outline in the plate, by its points within the frame; 0 when it faces away."""
    points = over(surface.corners_m)
    if (view.world_from_camera[:3, 3] - points.mean(0)) @ surface.normal <= 0:
        return 0.0
    px = project(camera, camera_points(view.world_from_camera, points)[0])
    inside = np.isfinite(px).all(-1) & (px >= 0).all(-1) & (px <= (camera.width, camera.height)).all(-1)
    grid = px.reshape(GRID, GRID, 2)
    along, up = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    cells = np.abs(along[..., 0] * up[..., 1] - along[..., 1] * up[..., 0])
    return float((cells * inside.reshape(GRID, GRID))[np.isfinite(cells)].sum())


def described(points: np.ndarray, surface: Found, proxies: Sequence[Proxy]) -> str:
    """Name of the stated proxy on which most of a surface's points (N, 3) lie; empty when there is none."""
    near = max(ON_PROXY * np.sqrt(surface.area_m2), 3 * surface.sigma_m)
    for proxy in proxies:
        on = np.zeros(len(points), bool)
        for a, b, c in np.asarray(proxy.vertices_m)[proxy.faces]:
            normal = np.cross(b - a, c - a)
            twice = float(normal @ normal)
            if twice == 0:
                continue
            arm = points - a
            v, w = np.cross(arm, c - a) @ normal / twice, np.cross(b - a, arm) @ normal / twice
            on |= (np.abs(arm @ normal) <= near * np.sqrt(twice)) & (v >= 0) & (w >= 0) & (v + w <= 1)
        if on.mean() > 0.5:
            return proxy.name
    return ""


def as_proxy(name: str, surface: Found) -> Proxy:
    """A rectangle of two triangles whose albedo is to be measured from the plate."""
    return Proxy(name=name, vertices_m=surface.corners_m, faces=np.array([[0, 1, 2], [0, 2, 3]]))
