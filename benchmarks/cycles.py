"""Blender's Cycles as a peer: the same scene through its shadow catcher, in an environment and a process of its own.

``make bench-cycles-env`` makes the environment. Cycles gives the object layer with its coverage, and the ratio of the
local scene with the objects over without them; the composite is ``plate * ratio * (1 - alpha) + objects``.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scenes import Scene

ROOT = Path(__file__).resolve().parents[1]
PYTHON = ROOT / ".blender/bin/python"
WORKER = Path(__file__).with_name("cycles_worker.py")
BOUNCES = 8
TIMEOUT_S = 900


@dataclass(frozen=True)
class Wanted:
    """One render."""

    samples: int
    seed: int
    denoise: bool = False


@dataclass(frozen=True, eq=False)
class Rendered:
    """What came back: object layer (N, 3), coverage (N,), ratio (N, 3), CPU seconds of the render call."""

    objects: np.ndarray
    alpha: np.ndarray
    ratio: np.ndarray
    cpu_s: float

    def composite(self, plate: np.ndarray) -> np.ndarray:
        """Over a plate (N, 3)."""
        return plate * self.ratio * (1 - self.alpha)[:, None] + self.objects


def available() -> bool:
    """Whether Blender's environment is there."""
    return PYTHON.exists()


def render(scene: Scene, wanted: list[Wanted], folder: Path, threads: int) -> tuple[list[Rendered], str]:
    """Render a scene several times in one process. Returns the renders and Blender's version."""
    from pipeline.run.formats import read_exr

    folder.mkdir(parents=True, exist_ok=True)
    write_scene(scene, wanted, folder, threads)
    # -P: this folder must not come before Blender's own module of the name cycles.
    command = [str(PYTHON), "-P", str(WORKER), str(folder / "job.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    if done.returncode:
        raise RuntimeError(f"cycles: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    times = json.loads((folder / "times.json").read_text())
    results = []
    for index, spent in enumerate(times["renders"]):
        channels = read_exr(folder / f"{index}.exr").channels
        results.append(Rendered(*layers(channels), cpu_s=spent["cpu_s"]))
    return results, times["blender"]


def layers(channels: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Object layer (N, 3), coverage (N,) and ratio (N, 3) of Blender's multi-layer picture."""

    def rows(layer: str, names: str) -> np.ndarray:
        found = {key.split(".")[-1]: key for key in channels if f".{layer}." in f".{key}"}
        return np.stack([channels[found[name]].ravel() for name in names], -1).astype(float)

    return rows("Combined", "RGB"), rows("Combined", "A")[:, 0], rows("Shadow Catcher", "RGB")


def write_scene(scene: Scene, wanted: list[Wanted], folder: Path, threads: int) -> None:
    """The files that `cycles_worker` reads."""
    from pipeline.run.formats import write_exr
    from pipeline.types import Raster

    def store(name: str, rgb: np.ndarray) -> str:
        channels = {c: np.ascontiguousarray(rgb[..., i], np.float32) for i, c in enumerate("RGB")}
        write_exr(folder / name, Raster(channels, "data"))
        return name

    # Blender's map has +X where ours has -Z: a quarter of its width further on.
    environment = store("environment.exr", np.roll(scene.environment, scene.environment.shape[1] // 4, 1))
    albedo = store("albedo.exr", scene.albedo[::-1])  # its v runs upwards
    plain = {"kind": "diffuse", "color": [1, 1, 1], "alpha": 0.0, "ior": 1.0, "texture": "", "catcher": False}
    meshes = []

    def add(name: str, arrays: dict[str, Any], **facts: object) -> None:
        np.savez(folder / f"{name}.npz", **arrays)
        meshes.append({**plain, "name": name, "file": f"{name}.npz", **facts})

    square = {"vertices": scene.plane.corners_m, "faces": np.array([[0, 1, 2], [0, 2, 3]])}
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    add("ground", {**square, "uv": uv}, texture=albedo, catcher=True)
    for wall in scene.walls:
        add(wall.name, {"vertices": wall.vertices, "faces": wall.faces}, color=list(wall.albedo), catcher=True)
    for item in scene.items:
        arrays = vars(item.shape)
        add(item.name, arrays, kind=item.kind, color=list(item.color), alpha=item.alpha, ior=item.ior)
    job = {
        "width": scene.camera.width,
        "height": scene.camera.height,
        "focal_px": scene.camera.fx,
        "world_from_camera": scene.world_from_camera.tolist(),
        "environment": environment,
        "threads": threads,
        "bounces": BOUNCES,
        "meshes": meshes,
        "renders": [{**vars(want), "file": f"{index}.exr"} for index, want in enumerate(wanted)],
    }
    (folder / "job.json").write_text(json.dumps(job))
