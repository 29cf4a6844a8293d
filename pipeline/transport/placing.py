"""Where wished objects stand: their meshes as Mitsuba shapes in the world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.colour import Space
from pipeline.run.errors import ManifestError
from pipeline.transport.meshes import Material, Mesh, load_meshes
from pipeline.transport.surfaces import object_shape
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Plane


def world_from_object(wish: dict[str, Any], plane: Plane) -> np.ndarray:
    """(4, 4) from the object file's frame (+Y up) to the world: scale, yaw about +Y, then its place on the plane."""
    yaw = np.radians(wish["yaw_deg"])
    rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * wish["scale"]
    matrix[:3, 3] = foot(wish, plane)
    matrix[1, 3] += wish["lift_m"]
    return matrix


def foot(wish: dict[str, Any], plane: Plane) -> np.ndarray:
    """Where on the plane (3,) an object stands."""
    x, z = wish["position_m"]
    return np.array([x, (plane.offset_m - plane.normal[0] * x - plane.normal[2] * z) / plane.normal[1], z])


def feet(wishes: dict[str, Any], plane: Plane) -> np.ndarray:
    """Where on the plane (N, 3) the objects stand."""
    return np.array([foot(wish, plane) for wish in wishes["object"]])


OFF_PLANE_M, OFF_PLANE_REL = 1e-3, 0.01  # of its height, the larger: so far an object may be off the plane in silence


def clearances(wishes: dict[str, Any], plane: Plane) -> dict[str, tuple[float, float]]:
    """Height [m] over the plane of each object's lowest vertex, negative below it, and its own height [m] across it.

    Raises ManifestError for a file that cannot be read.
    """
    found = {}
    for wish in wishes["object"]:
        placed = world_from_object(wish, plane)
        vertices = np.concatenate([mesh.vertices for mesh in load_meshes(Path(wish["path"]))[0]])
        heights = (vertices @ placed[:3, :3].T + placed[:3, 3]) @ plane.normal - plane.offset_m
        found[wish["name"]] = float(heights.min()), float(np.ptp(heights))
    return found


def off_plane(wishes: dict[str, Any], found: dict[str, tuple[float, float]]) -> tuple[list[str], list[dict[str, Any]]]:
    """Warnings of objects that `clearances` found to be sunk, or to float unasked; evidence of those lifted."""
    warnings, evidence = [], []
    for wish in wishes["object"]:
        lowest, height = found[wish["name"]]
        if abs(lowest) <= max(OFF_PLANE_M, OFF_PLANE_REL * height):
            continue
        where = f"object {wish['name']}: its lowest point is {1e3 * abs(lowest):.3g} mm"
        if lowest < 0:
            warnings.append(f"{where} below the plane; lift_m = {wish['lift_m'] - lowest:.4g} puts it on")
        elif not wish["lift_m"]:
            warnings.append(f"{where} above the plane: it floats; lift_m = {-lowest:.4g} puts it on")
        else:
            evidence.append({
                "term": f"{wish['name']} off the plane", "modelled": True,
                "because": f"lift_m = {wish['lift_m']:g}: its lowest point is {1e3 * lowest:.3g} mm above the plane",
                "could_cost": "a shadow apart from the object, where it was meant to stand",
            })  # fmt: skip
    return warnings, evidence


def turns_around(vertices: np.ndarray, faces: np.ndarray, point: np.ndarray) -> float:
    """How often a surface encloses a point (3,): 1 or -1 inside a solid, 0 outside, between where it has a hole.

    Sum of the faces' signed solid angles over 4 pi: van Oosterom and Strackee 1983.
    """
    arms = vertices - point
    arms = arms / np.linalg.norm(arms, axis=1, keepdims=True)
    a, b, c = (arms[faces[:, corner]] for corner in range(3))
    volume = (a * np.cross(b, c)).sum(1)
    around = 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1)
    return float(np.arctan2(volume, around).sum() / (2 * np.pi))


def refuse_around(name: str, mesh: Mesh, world_from_mesh: np.ndarray, eye: np.ndarray) -> None:
    """Raise ManifestError for a mesh that encloses the camera at ``eye`` (3,): it would fill the picture."""
    vertices = mesh.vertices @ world_from_mesh[:3, :3].T + world_from_mesh[:3, 3]
    if (eye <= vertices.min(0)).any() or (eye >= vertices.max(0)).any():
        return
    if abs(turns_around(vertices, mesh.faces, eye)) > 0.5:
        size = np.ptp(vertices, 0).max()
        raise ManifestError(
            f"object {name}: the plate camera is inside it, which is {size:.3g} m across; needed outside; check scale, "
            "the file's unit and position_m"
        )


def place_objects(
    wishes: dict[str, Any], plane: Plane, white: float, materials: str = "conserving", eye: np.ndarray | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Mitsuba shapes of every wished object, and warnings.

    ``white``: radiance that an emission of 1 stands for; ``materials``: the knob; ``eye`` (3,): the plate's camera.
    Raises ManifestError for an object that the camera is inside of.
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
            if eye is not None:
                refuse_around(wish["name"], mesh, placed, eye)
            shapes[name], notes = object_shape(
                mi, name, mesh, placed, material, space, white, materials == "conserving"
            )
            warnings += notes
    return shapes, warnings
