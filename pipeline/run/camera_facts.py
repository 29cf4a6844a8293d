"""Facts of how a view is oriented when not by a board: surveyed points, a matrix, or a camera of another program.

Imports no numpy.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipeline.run.strict import Coordinate, Matrix4, Strict

ORDERS = Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]
CAMERA_SUFFIXES = (".chan", ".usd", ".usda", ".usdc", ".usdz")


class PointFacts(Strict):
    """A surveyed point and where it is seen."""

    world_m: tuple[Coordinate, Coordinate, Coordinate]
    px: tuple[Coordinate, Coordinate] = Field(description="first pixel centre at (0.5, 0.5)")
    sigma_m: float | None = Field(None, ge=0, description="standard uncertainty of each coordinate; without it, none")
    sigma_px: float | None = Field(None, gt=0, description="of the picture; without it, pose.corner_sigma_px")


class PoseFacts(Strict):
    """How one view is oriented when not by the board."""

    view: str
    route: Literal["charuco", "marker", "points", "given", "colmap"]
    points: list[PointFacts] = Field([])
    world_from_camera: Matrix4 | None = None
    file: str | None = Field(None, description="given: .chan or USD camera; relative to capture.toml, else to root")
    frame: float = Field(1.0, description="of the file")
    rotation_order: ORDERS = Field("zxy", description="of a .chan file, axis applied first; Nuke zxy, Houdini xyz")
    unit_m: float | None = Field(None, gt=0, description="metres per unit of the file; without it 1, or the USD's own")
    prim: str | None = Field(None, description="path of the camera in a USD that has several")

    @model_validator(mode="after")
    def _one_source(self) -> PoseFacts:
        if self.route == "given" and self.file is not None and self.world_from_camera is not None:
            raise ValueError("world_from_camera and file both place the camera; give one")
        if self.route != "given" and self.file is not None:
            raise ValueError(f"file: is read by route 'given' only, route is {self.route!r}")
        if self.file is not None and not self.file.lower().endswith(CAMERA_SUFFIXES):
            raise ValueError(f"file: is {self.file!r}; expected one of {', '.join(CAMERA_SUFFIXES)}")
        return self
