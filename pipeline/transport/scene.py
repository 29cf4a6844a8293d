"""The three-way split of differential rendering as Mitsuba scenes: distant scene, local scene, synthetic objects.

Debevec 1998: the distant scene is light only (the environment map), the local scene is what the objects change (the
plane with its albedo), the objects are added. Mitsuba's world is ours; its rgb variants multiply channels, so ACEScg
passes through as arrays (`raw`), never through its colour conversions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Plane


@dataclass(frozen=True, eq=False)
class Worlds:
    """The scene with the objects and without them; ``ground`` tells the plane from the objects in either."""

    mi: Any
    with_objects: Any
    without_objects: Any
    ground_with: Any
    ground_without: Any
    ground_albedo: Any  # texture, for the albedo at a hit
    above: Any  # scene that holds only the light from above the plane, for sampling and evaluating it
    plane: Plane
    bounds: np.ndarray  # (K, 4) centre and radius of a sphere around each object, world


def envmap_grid(rgb: np.ndarray) -> np.ndarray:
    """Our half-texel rows (H, W, 3) on Mitsuba's grid, where rows 0 and H - 1 are the poles; columns already agree."""
    height = rgb.shape[0]
    rows = np.arange(height + 1) / height * height - 0.5  # row r of H + 1 is at theta = pi r / H
    low = np.clip(np.floor(rows).astype(int), 0, height - 1)
    high = np.clip(low + 1, 0, height - 1)
    weight = np.clip(rows - low, 0, 1)[:, None, None]
    grid = rgb[low] * (1 - weight) + rgb[high] * weight
    grid[0], grid[-1] = rgb[0].mean(0), rgb[-1].mean(0)
    return grid


def environment_emitter(mi: Any, rgb: np.ndarray) -> dict[str, Any]:
    """Mitsuba description of a lat-long radiance map (H, W, 3), ACEScg, as in conventions."""
    bitmap = mi.Bitmap(np.ascontiguousarray(envmap_grid(np.maximum(rgb, 0.0)), np.float32))
    return {"type": "envmap", "bitmap": bitmap}


def ground_shape(plane: Plane, bsdf: dict[str, Any]) -> dict[str, Any]:
    """The modelled rectangle; u runs from corner 0 to corner 1, v from corner 0 to corner 3."""
    mi = use_mitsuba()
    origin = plane.corners_m.mean(0)
    along_u = (plane.corners_m[1] - plane.corners_m[0]) / 2
    along_v = (plane.corners_m[3] - plane.corners_m[0]) / 2
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = along_u, along_v, plane.normal, origin
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), "bsdf": bsdf}


def ground_texture(mi: Any, albedo: np.ndarray) -> dict[str, Any]:
    """Albedo (H, W, 3) over the rectangle, first row at v = 0 (corners 0 and 1), or one colour (3,)."""
    values = np.asarray(albedo, np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(values.reshape(1, 1, 3) if values.ndim == 1 else values))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}


def above_plane(rgb: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A map (H, W, 3) with nothing in texels that lie wholly below the plane: their light never reaches it."""
    height, width = rgb.shape[:2]
    reach = np.hypot(np.pi / height, 2 * np.pi / width)
    return np.where((latlong_directions(height, width) @ normal > -reach)[..., None], rgb, 0.0)


def bounding_sphere(shape: Any) -> np.ndarray:
    """(4,) centre and radius of the sphere around a shape's bounding box."""
    box = shape.bbox()
    low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
    return np.array([*(low + high) / 2, np.linalg.norm(high - low) / 2])


def build_worlds(plane: Plane, albedo: np.ndarray, environment: np.ndarray, objects: dict[str, Any]) -> Worlds:
    """Scenes with and without objects.

    Args:
        plane: the local scene.
        albedo: (H, W, 3) texture over the plane's corners (first row at corner 0 to 1), or (3,).
        environment: (H, W, 3) lat-long radiance, the distant scene.
        objects: name -> Mitsuba shape, world frame.
    """
    mi = use_mitsuba()
    texture = ground_texture(mi, albedo)
    ground_bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}
    shared = {"type": "scene", "distant": environment_emitter(mi, environment)}
    scenes = []
    for synthetic in (objects, {}):
        ground = mi.load_dict(ground_shape(plane, ground_bsdf))
        scenes.append((mi.load_dict({**shared, "ground": ground, **synthetic}), ground))
    (with_objects, ground_with), (without, ground_without) = scenes
    above = environment_emitter(mi, above_plane(environment, plane.normal))
    return Worlds(
        mi=mi,
        with_objects=with_objects,
        without_objects=without,
        ground_with=ground_with,
        ground_without=ground_without,
        ground_albedo=mi.load_dict(texture),
        above=mi.load_dict({"type": "scene", "distant": above}),
        plane=plane,
        bounds=np.array([bounding_sphere(shape) for shape in objects.values()]).reshape(-1, 4),
    )
