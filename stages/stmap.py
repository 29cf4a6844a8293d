"""Write the lens as STMaps, undistort and distort, for other programs; overscan is sized by itself.

Reads the camera of a build (and of balls that have their own) and writes float32 EXR files: `<view>_undistort.exr` and
`<view>_distort.exr`, R = (x + 0.5) / W, G = (y + 0.5) / H from the bottom, and `<view>_straight.json`, the pinhole to
render with: its picture, warped by the distort map, lies on the plate. Limits: see `pipeline/camera/stmap.py`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.stmap import NOWHERE, STMaps, round_trip_px, stmaps
from pipeline.run.errors import NumericalError
from pipeline.run.formats import write_bytes, write_exr
from pipeline.types import Camera, Raster

ROUND_TRIP_PX = 0.01


def stmap(cameras: dict[str, Camera], folder: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Write the maps of each view's camera and return what was measured.

    Raises NumericalError when a lens cannot be straightened, or its maps do not give each other back to 0.01 px.
    """
    numbers = {}
    for name, camera in cameras.items():
        maps = stmaps(camera)
        numbers[name] = measured(maps, camera)
        if numbers[name]["round_trip_px"] > ROUND_TRIP_PX:
            raise NumericalError(
                f"{name}: maps give back a pixel to {numbers[name]['round_trip_px']:.3f} px, needed {ROUND_TRIP_PX} px;"
                " the lens bends too strongly within a pixel; calibrate with boards near the corners"
            )
        for kind, values in (("undistort", maps.undistort), ("distort", maps.distort)):
            write_exr(folder / f"{name}_{kind}.exr", raster_of(values))
        straight = {key: getattr(maps.straight, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        text = json.dumps({**straight, "plate_offset_px": maps.offset, "plate_size": [camera.width, camera.height]})
        write_bytes(folder / f"{name}_straight.json", (text + "\n").encode())
        say(
            f"{name}: {camera.width} x {camera.height} straightened to {maps.straight.width} x {maps.straight.height} "
            f"(overscan {numbers[name]['overscan']:.3f}); round trip {numbers[name]['round_trip_px']:.5f} px; {folder}"
        )
    return numbers


def measured(maps: STMaps, camera: Camera) -> dict[str, Any]:
    """Round trip (largest, px), overscan (larger side over the plate's), and the share that the lens does not image."""
    step = max(1, round(np.sqrt(camera.width * camera.height / 4e5)))  # 400 000 pixels tell it
    sides = (maps.straight.width / camera.width, maps.straight.height / camera.height)
    return {
        "round_trip_px": float(round_trip_px(maps, camera, step).max()), "overscan": max(sides),
        "straight_px": [maps.straight.width, maps.straight.height],
        "nowhere": float((maps.undistort[..., 0] == NOWHERE).mean()),
    }  # fmt: skip


def raster_of(values: np.ndarray) -> Raster:
    """A map (H, W, 2) as R, G and an empty B: some readers want three channels."""
    return Raster({"R": values[..., 0], "G": values[..., 1], "B": np.zeros(values.shape[:2], np.float32)}, "data")
