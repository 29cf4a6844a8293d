"""Where wished objects stand: their meshes as Mitsuba shapes in the world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.colour import Space
from pipeline.transport.meshes import Material, load_meshes
from pipeline.transport.surfaces import object_shape
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Plane


def world_from_object(wish: dict[str, Any], plane: Plane) -> np.ndarray:
    """(4, 4) from the object file's frame (+Y up) to the world: scale, yaw about +Y, then its place on the plane."""
    yaw = np.radians(wish["yaw_deg"])
    x, z = wish["position_m"]
    rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    height = (plane.offset_m - plane.normal[0] * x - plane.normal[2] * z) / plane.normal[1]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * wish["scale"]
    matrix[:3, 3] = [x, height + wish["lift_m"], z]
    return matrix


def place_objects(
    wishes: dict[str, Any], plane: Plane, white: float, materials: str = "conserving"
) -> tuple[dict[str, Any], list[str]]:
    """Mitsuba shapes of every wished object, and warnings.

    ``white``: radiance that an emission of 1 stands for; ``materials``: the knob.
    """
    mi = use_mitsuba()
    shapes, warnings = {}, []
    for wish in wishes["object"]:
        meshes, notes = load_meshes(Path(wish["path"]))
        warnings += notes
        for index, mesh in enumerate(meshes):
            material: Material = mesh.material
            space: Space = "linear_rec709"
            if wish["material"]:
                given = dict(wish["material"])
                space = given.pop("space")
                material = Material(**given)
            name = f"{wish['name']}_{index}"
            placed = world_from_object(wish, plane)
            shapes[name], notes = object_shape(
                mi, name, mesh, placed, material, space, white, materials == "conserving"
            )
            warnings += notes
    return shapes, warnings
