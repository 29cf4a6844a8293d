"""The render stage on a small place: a lamp, a soft sky, a table, an object; at any scale and anywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from agreement import TILE, standing
from test_composite_render import inputs

from pipeline.run.manifest import MaterialWish
from pipeline.types import Camera, Raster, Result, Surface
from stages import knobs, render

GREY = {"base_color": (0.5, 0.4, 0.3), "metallic": 0.0, "roughness": 0.6}


def ball(folder: Path, name: str = "ball.ply", inverted: bool = False) -> Path:
    """A sphere of 80 mm."""
    mesh = trimesh.creation.icosphere(4, 0.08)
    if inverted:
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    mesh.export(folder / name)
    return folder / name


def wish(path: Path, x: float = 0.0, z: float = 0.0, lift: float = 0.09, **material: Any) -> dict[str, Any]:
    """An object on the table."""
    made = MaterialWish.model_validate(material or GREY).model_dump(mode="json")
    return {
        "name": "thing", "path": str(path), "position_m": (x, z), "lift_m": lift, "yaw_deg": 0.0, "scale": 1.0,
        "material": made,
    }  # fmt: skip


def world(scale: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
    """The inputs of the stage with every length times ``scale``, then moved by ``shift`` (x, z) [m]."""
    given = inputs()
    offset = np.array([shift[0], 0.0, shift[1]])
    pose = given["views"]["plate"].world_from_camera.copy()
    pose[:3, 3] = pose[:3, 3] * scale + offset
    given["views"] = {"plate": given["views"]["plate"].model_copy(update={"world_from_camera": pose})}
    given["plane"] = given["plane"].model_copy(update={"corners_m": given["plane"].corners_m * scale + offset})
    return given


def moved(wished: dict[str, Any], scale: float, shift: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
    """The wish in that world."""
    x, z = wished["position_m"]
    place = (x * scale + shift[0], z * scale + shift[1])
    return wished | {"scale": wished["scale"] * scale, "lift_m": wished["lift_m"] * scale, "position_m": place}


def rendered(wishes: list[dict[str, Any]], given: dict[str, Any] | None = None, **params: Any) -> Result:
    """The stage's result."""
    knob = knobs.Render(**({"samples": 16, "depth": 4, "denoise": False} | params))
    return render.compute(
        wishes={"object": wishes}, **(given or world()), surface=Surface(), local_proxies=[], params=knob
    )


def several(wishes: list[dict[str, Any]], given: dict[str, Any] | None = None, first: int = 0, count: int = 6,
            **params: Any) -> list[Raster]:  # fmt: skip
    """Layers of independent renders."""
    return [rendered(wishes, given, seed=first + number, **params).outputs["layers"] for number in range(count)]


def parts(layers: Raster) -> np.ndarray:
    """(3, H, W, 3): object, lost and gained light."""
    return np.stack([layers.rgb(name) for name in ("obj", "lost", "gained")])


def largest_z(
    first: list[Raster], second: list[Raster], crop: tuple[slice, slice] = (slice(None), slice(None))
) -> float:
    """Largest z of the means of 8 x 8 tiles of object, lost and gained light; those of ``second`` cropped."""
    worst = 0.0
    for part in range(3):
        one = [parts(layers)[part] for layers in first]
        other = [parts(layers)[part][crop] for layers in second]
        shape = one[0].shape[:2]
        assert shape == other[0].shape[:2]
        assert not shape[0] % TILE
        assert not shape[1] % TILE
        (a, a_square), (b, b_square) = standing(one, shape), standing(other, shape)
        assert np.isfinite(a).all()
        assert np.isfinite(b).all()
        spread = np.sqrt(a_square + b_square)
        # a tile at the border of the region is sampled in one and left out in the other: what is left out is below the
        # threshold, 0.4 % of the plate, which enters as an error of its own
        floor = np.sqrt(spread**2 + (0.004 * 0.2) ** 2)
        worst = max(worst, float(np.max(np.abs(a - b) / floor)))
    return worst


def wide(given: dict[str, Any], left: int) -> dict[str, Any]:
    """The same with ``left`` more columns at the left."""
    camera: Camera = given["camera"]
    more = camera.model_copy(update={"width": camera.width + left, "cx": camera.cx + left})
    plate = given["photographs"]["plate"]
    channels = {name: np.pad(values, ((0, 0), (left, 0)), "edge") for name, values in plate.channels.items()}
    return given | {"camera": more, "photographs": {"plate": Raster(channels, plate.space)}}
