"""Does a large photograph cost more than its part around the object? The render stage on 24 Mpx and on a crop of 1 Mpx.

The crop is the same camera with a shifted principal point: the object covers the same pixels, the shadow lies in both.
"""

from __future__ import annotations

import inspect
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.estimators import PLATE_NOISE, sun_of
from benchmarks.measures import cpu_seconds
from benchmarks.scenes import Scene, ball, diffuse_glossy
from pipeline.run.manifest import ObjectWish, SceneWishes
from pipeline.types import Camera, Raster, Surface, View
from stages import knobs, render

LARGE = (6000, 4000)
SMALL = (1224, 816)
RADIUS_M = 0.02


def cameras() -> tuple[Camera, Camera]:
    """The large photograph's camera, and that of its middle."""
    large = Camera(
        width=LARGE[0], height=LARGE[1], fx=6600.0, fy=6600.0, cx=LARGE[0] / 2, cy=LARGE[1] / 2,
        distortion=np.array([-0.05, 0.02, 1e-4, -1e-4, 0.0]),
    )  # fmt: skip
    shift = [(big - small) / 2 for big, small in zip(LARGE, SMALL, strict=True)]
    small = large.model_copy(
        update={"width": SMALL[0], "height": SMALL[1], "cx": large.cx - shift[0], "cy": large.cy - shift[1]}
    )
    return large, small


def inputs(scene: Scene, camera: Camera, mesh: Path) -> dict[str, Any]:
    """Every artifact that the render stage may ask for, by the name of the argument."""
    wish = ObjectWish(name="ball", file=mesh.name, position_m=(0.0, 0.0))
    wishes = SceneWishes(object=[wish]).model_dump(mode="json")
    wishes["object"][0] |= {"path": str(mesh), "sha256": ""}
    level = np.full((camera.height, camera.width), 0.3, np.float32)
    variance = (PLATE_NOISE * level) ** 2
    channels = dict.fromkeys("RGB", level) | {f"variance.{c}": variance for c in "RGB"}
    channels["mask"] = np.zeros(level.shape, np.uint32)
    view = View(
        world_from_camera=scene.world_from_camera, covariance=np.zeros((6, 6)), route="given", rms_px=0, points=0
    )
    return {
        "wishes": wishes,
        "facts": {},
        "camera": camera,
        "views": {"plate": view},
        "photographs": {"plate": Raster(channels, "acescg")},
        "environment": Raster(Raster.split(scene.environment.astype(np.float32)), "acescg"),
        "emitters": [sun_of(scene)],
        "plane": scene.plane,
        "albedo": Raster(Raster.split(scene.albedo.astype(np.float32)), "acescg"),
        "surface": Surface(),
        "proxies": [],
        "local_proxies": [],
        "occluders": [],
        "params": knobs.Render(),
    }


def write_ball(folder: Path) -> Path:
    """The object as a file."""
    import trimesh

    shape = ball(RADIUS_M, (0, RADIUS_M, 0), 48)
    path = folder / "ball.ply"
    trimesh.Trimesh(shape.vertices, shape.faces, vertex_normals=shape.normals, process=False).export(path)
    return path


def tiny_ratio(replicates: int) -> tuple[float, dict[str, Any]]:
    """CPU seconds of the render stage on the large photograph over those on the small one; and both, with medians."""
    scene = diffuse_glossy()
    spent: list[list[float]] = [[], []]
    shares = [0.0, 0.0]
    with tempfile.TemporaryDirectory() as folder:
        mesh = write_ball(Path(folder))
        given = [inputs(scene, camera, mesh) for camera in cameras()]
        names = list(inspect.signature(render.compute).parameters)
        render.compute(**{name: given[1][name] for name in names})  # compiles the kernels
        for _ in range(replicates):
            for which in (0, 1):
                with cpu_seconds() as timer:
                    result = render.compute(**{name: given[which][name] for name in names})
                spent[which].append(timer.seconds)
                layers = result.outputs["layers"]
                shares[which] = float((layers["obj.A"] > 0).sum())
    ratios = [large / small for large, small in zip(*spent, strict=True)]
    facts = {"large_cpu_s": float(np.median(spent[0])), "small_cpu_s": float(np.median(spent[1]))}
    return float(np.median(ratios)), facts | {"large_object_px": shares[0], "small_object_px": shares[1]}
