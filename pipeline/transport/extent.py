"""How much of the plane has to be modelled: where objects change it, and what of it they see.

The rectangle holds every point at which an object can change the plane by more than may be left out
(`pipeline.transport.influence`), long shadows of a low sun among them, and the ground around each object beyond which
lies less than `FAR_SEEN` of what its upright faces see: there the map shows that same ground, from the probe's place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.transport.influence import Fall, influence, reach
from pipeline.transport.meshes import Material, load_meshes
from pipeline.transport.placing import world_from_object
from pipeline.types import Plane

FAR_SEEN = 0.05  # of what an upright face at an object's middle sees; measured on both captures, see `far_ground`
METAL = 0.8  # of a polished metal, roughly
BORDER = 64  # points along each side of the rectangle


@dataclass(frozen=True)
class Standing:
    """An object as a sphere (4,: centre, radius; m, world) around its middle, and what it emits (1 is white).

    ``albedo`` (3,): roughly, the mean of its materials' colours.
    """

    name: str
    sphere: np.ndarray
    emission: float = 0.0
    albedo: np.ndarray = field(default_factory=lambda: np.full(3, 0.5))


def standing(wishes: dict[str, Any], plane: Plane, size_m: float) -> list[Standing]:
    """Every wished object; one without a file is a ball of ``size_m``. Raises ManifestError for an unreadable file."""
    found = []
    for wish in wishes.get("object", []):
        if not wish.get("path"):
            x, z = wish["position_m"]
            found.append(Standing(wish["name"], np.array([x, size_m / 2, z, size_m / 2])))
            continue
        meshes = load_meshes(Path(wish["path"]))[0]
        placed = world_from_object(wish, plane)
        world = np.concatenate([part.vertices for part in meshes]) @ placed[:3, :3].T + placed[:3, 3]
        centre = (world.min(0) + world.max(0)) / 2
        radius = float(np.sqrt(((world - centre) ** 2).sum(1).max()))
        given = {key: value for key, value in (wish.get("material") or {}).items() if key != "space"}
        materials = [Material(**given)] if given else [part.material for part in meshes]
        emission = max(max(material.emission) for material in materials)
        albedo = np.mean([mean_color(material) for material in materials], 0)
        found.append(Standing(wish["name"], np.array([*centre, radius]), float(emission), albedo))
    return found


def mean_color(material: Material) -> np.ndarray:
    """(3,) base colour with its texture, METAL for a metal by name; colour spaces are not told apart."""
    if material.conductor:
        return np.full(3, METAL)
    texture = 1.0 if material.base_texture is None else material.base_texture.reshape(-1, 3).mean(0)
    return np.asarray(np.array(material.shown_color) * texture)


def far_ground(height_m: float) -> float:
    """Distance [m] beyond which lies `FAR_SEEN` of what an upright face at a height sees.

    The ground beyond a distance d fills the view down to the depression a = h / d, the share (2 / pi)(a + sin(2 a) / 2)
    / 2 of the face's view, a for the small angles that are meant: about 2 h / (pi d).
    """
    return 2 * max(height_m, 0.0) / (np.pi * FAR_SEEN)


def needed(objects: Sequence[Standing], light: Fall, left_out: float, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends (2, 3) of the rectangle (least x, z and largest), and the reach [m] of each object (K,).

    ``left_out``: relative change that may be left out; ``extent``: the most, in radii of the object.
    """
    ends, reaches = [], []
    for thing in objects:
        x, y, z, radius = thing.sphere
        points = reach(thing.sphere, light, left_out, extent * radius, thing.emission)
        reaches.append(float(np.linalg.norm(points - [x, 0, z], axis=1).max()))
        far = min(far_ground(y), extent * radius)
        ends += [points.min(0), points.max(0), np.array([x - far, 0, z - far]), np.array([x + far, 0, z + far])]
    return np.array([np.min(ends, 0), np.max(ends, 0)]) * (1, 0, 1), np.array(reaches)


def beyond(corners_m: np.ndarray, objects: Sequence[Standing], light: Fall) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) along the border of the rectangle (4, 3), and the bound (N,) on the change that ends there."""
    share = np.arange(BORDER)[:, None] / BORDER
    sides = [a + share * (b - a) for a, b in zip(corners_m, np.roll(corners_m, -1, 0), strict=True)]
    points = np.concatenate(sides)
    total = np.zeros(len(points))
    for thing in objects:
        total += influence(points, thing.sphere[None], light, thing.emission)
    return points, total
