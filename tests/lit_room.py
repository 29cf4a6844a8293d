"""A room with a table, its plate, and facts of every kind of probe: what the tests of the probe kinds share."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from mirror_scene import Place, look_at, photograph

from pipeline.conventions import (
    latlong_directions,
    latlong_from_direction,
)
from pipeline.light.environment import resize_environment
from pipeline.probes.kinds import KINDS
from pipeline.probes.observation import Grid, Observation, Shots
from pipeline.run import formats
from pipeline.run.manifest import PROBE_KINDS
from pipeline.types import Camera, Raster, View
from stages import knobs, probe

GRID = Grid(64)
BOARD = {"dictionary": "DICT_5X5_100", "squares": [7, 5], "square_m": 0.03, "marker_m": 0.022, "legacy": False}
EYE = np.array([0.0, 0.12, 0.0])  # where the light is measured in the synthetic place


def wallpaper(height: int = 512, patches: int = 900) -> np.ndarray:
    """RGB (H, 2H, 3) of a far room: hard-edged patches of every size and colour, so that pictures have features."""
    rng = np.random.default_rng(0)
    rgb = np.ones((height, 2 * height, 3))
    for row, column, tall, wide in rng.integers((0, 0, 3, 3), (height, 2 * height, 60, 90), (patches, 4)):
        rgb[row : row + tall, column : column + wide] *= rng.uniform(0.5, 1.7, 3)
    return np.clip(rgb, 0.1, 6.0)


WALLPAPER = wallpaper()


def room(w: np.ndarray) -> np.ndarray:
    """RGB (N, 3) of the wallpaper in directions (N, 3): texels of constant radiance."""
    u, v = latlong_from_direction(w)
    height, width = WALLPAPER.shape[:2]
    return WALLPAPER[np.minimum((v * height).astype(int), height - 1), (u * width).astype(int) % width]


ROOM = Place(room, plane=True, ball=None)
CAMERA = Camera(width=300, height=225, fx=190, fy=190, cx=151, cy=110, distortion=np.array([-0.05, 0.01, 0, 0, 0]))
POSE = look_at((0.3, 0.45, 0.7), (0.1, 0.4, 0.0))


def raster(picture: np.ndarray) -> Raster:
    channels = {**Raster.split(np.float32(picture)), **Raster.split(np.float32(1e-6 + 0 * picture), "variance")}
    return Raster(channels | {"mask": np.zeros(picture.shape[:2], np.uint32)}, "acescg")


@functools.cache
def room_plate() -> Raster:
    """The plate of the room."""
    return raster(photograph(ROOM, CAMERA, POSE, 3))


def latlong_of(place: Place, eye: np.ndarray, height: int, split: int = 2) -> np.ndarray:
    w = latlong_directions(height * split, 2 * height * split).reshape(-1, 3)
    rgb = place.radiance(np.broadcast_to(eye, w.shape), w)
    return resize_environment(rgb.reshape(height * split, 2 * height * split, 3), height, 2 * height)


@functools.cache
def room_light() -> np.ndarray:
    """The room as seen from EYE, lat-long (128, 256, 3)."""
    return latlong_of(ROOM, EYE, 128)


def facts(kind: str, board: bool = False, **stated: Any) -> dict[str, Any]:
    """Facts of a kind as ingest writes them, defaults and all."""
    model = PROBE_KINDS[kind].model_validate({"kind": kind, **stated.pop("facts", {}), **stated})
    return {"probe": model.model_dump(mode="json"), "ball": [], "board": BOARD if board else None}


def shots(of: dict[str, Any], plate: Raster | None = None, **photographs: Raster) -> Shots:
    empty = raster(np.ones((CAMERA.height, CAMERA.width, 3)))
    view = View(world_from_camera=POSE, covariance=np.eye(6) * 1e-8, route="given", rms_px=0.1, points=20)
    return Shots(
        of, {"plate": plate or empty, **photographs}, CAMERA, {"plate": view, **dict.fromkeys(photographs, view)}
    )


def mapped(folder, rgb: np.ndarray, stored: str = "acescg", kind: str = "map", **stated: Any) -> dict[str, Any]:
    """Facts of a map that was written to a folder."""
    path = folder / "light.exr"
    formats.write_exr(path, Raster(Raster.split(np.float32(rgb)), stored))
    found = facts(kind, stated.pop("board", False), facts={"file": path.name} | stated)
    found["probe"]["path"] = str(path)
    return found


def seen(folder, rgb: np.ndarray, plate: Raster | None = None, grid: Grid = GRID, **stated: Any) -> Observation:
    """What the kind ``map`` makes of a picture."""
    return KINDS["map"].observe(shots(mapped(folder, rgb, **stated), plate), grid)


def lamp_map(direction: np.ndarray, height: int = 64) -> np.ndarray:
    """A dark world with one bright texel where ``direction`` points."""
    w = latlong_directions(height, 2 * height)
    rgb = np.full((height, 2 * height, 3), 1e-6)
    rgb[np.unravel_index((w @ direction).argmax(), w.shape[:2])] = 1e4
    return rgb


def stage_on(of: dict[str, Any], plate: Raster, **photographs: Raster) -> tuple[np.ndarray, Any]:
    """The whole stage on arrays: the environment's radiance (H, W, 3), and its result."""
    given = shots(of, plate, **photographs)
    result = probe.compute(
        of, given.photographs, given.camera, given.views, {}, {}, knobs.Probe(width=128, supersample=2)
    )
    return result.outputs["environment"].rgb(), result
