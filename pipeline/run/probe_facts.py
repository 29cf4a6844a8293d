"""The [probe] table of capture.toml: one set of facts per kind, told apart by ``kind``. Imports no numpy."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from pipeline.run.strict import Coordinate, Length, Metal, Rgb, Share, Strict


class MirrorBallFacts(Strict):
    """A polished ball, photographed in the [[ball]] views."""

    kind: Literal["mirror_ball"] = "mirror_ball"
    diameter_m: float | None = Field(None, gt=0.005, lt=2.0, description="metres; without it, solved from the plane")
    reflectance: Rgb | None = Field(None, description="linear RGB, head on; without it, measured from the plane")
    reflectance_space: Literal["acescg", "linear_rec709"] = "acescg"
    material: Metal | None = Field(None, description="clean metal: its reflectance, or that given at all its angles")
    glass_mm: Length | None = Field(None, description="thickness of the glass of a ball that is silvered inside")


class GreyBallFacts(Strict):
    """A matt ball, photographed in the [[ball]] views."""

    kind: Literal["grey_ball"]
    diameter_m: float = Field(gt=0.005, lt=2.0, description="metres")
    albedo: tuple[Share, Share, Share] = Field((0.18, 0.18, 0.18), description="linear RGB albedo of the ball")
    albedo_space: Literal["acescg", "linear_rec709"] = "acescg"
    albedo_sigma_rel: Share = Field(0.03, description="relative standard uncertainty of the albedo")


class LightFacts(Strict):
    """What every kind that brings light from elsewhere than the plate's camera may state."""

    position_m: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="where it was taken, world frame; it then shows the plane that the plate shows"
    )
    height_m: Length = Field(0.1, description="without position_m: it is taken as this far above the origin")
    scale: Length | None = Field(None, description="plate's unit per unit of the file; None: solved")
    scale_sigma_rel: Share = Field(0.05, description="relative standard uncertainty of the stated scale")
    plane_albedo: Share | None = Field(None, description="mean albedo of the plane, to solve the scale from it")
    plane_albedo_sigma_rel: Share = Field(0.1, description="relative standard uncertainty of plane_albedo")
    sigma_rel: Share = Field(0.03, description="relative standard uncertainty of a texel, scale apart")
    clipped_at: Length | None = Field(None, description="values from here on are lower bounds, in the file's unit")


class LatLongFacts(LightFacts):
    """A picture of all directions in one file."""

    file: str = Field(description=".hdr or .exr, twice as wide as high; relative to capture.toml, else to root")
    space: Literal["linear_rec709", "acescg"] | None = Field(
        None, description="colour space; None: as the file says, else linear_rec709"
    )
    up: tuple[Coordinate, Coordinate, Coordinate] = Field((0.0, 1.0, 0.0), description="world's up in the map's frame")
    orientation_sigma_deg: float = Field(1.0, ge=0, le=180, description="standard uncertainty of the stated rotation")

    @model_validator(mode="after")
    def _up_is_a_direction(self) -> LatLongFacts:
        if sum(value * value for value in self.up) < 1e-12:
            raise ValueError("up is (0, 0, 0); expected a direction")
        return self


class MapFacts(LatLongFacts):
    """A ready-made lat-long map; its rotation is stated."""

    kind: Literal["map"]
    yaw_deg: Coordinate = Field(0.0, description="about +Y, counter-clockwise seen from above; 0: centre looks to +Z")


class ProbePointFacts(Strict):
    """Something that is seen in the panorama, and where it is in the plate or in the world."""

    px: tuple[Coordinate, Coordinate] = Field(description="in the panorama; first pixel centre at (0.5, 0.5)")
    plate_px: tuple[Coordinate, Coordinate] | None = Field(None, description="the same thing in the plate")
    direction: tuple[Coordinate, Coordinate, Coordinate] | None = Field(None, description="towards it, world frame")
    world_m: tuple[Coordinate, Coordinate, Coordinate] | None = Field(None, description="its place, world frame")

    @model_validator(mode="after")
    def _one_place(self) -> ProbePointFacts:
        given = [name for name in ("plate_px", "direction", "world_m") if getattr(self, name) is not None]
        if len(given) != 1 or (self.direction and not any(self.direction)):
            raise ValueError(f"has {', '.join(given) or 'only px'}; expected one of plate_px, direction, world_m")
        return self


class PanoramaFacts(LatLongFacts):
    """A stitched 360-degree panorama, taken near the objects."""

    kind: Literal["panorama"]
    yaw_deg: Coordinate | None = Field(None, description="as of a map; None: found from points or features")
    nadir_deg: float = Field(15.0, ge=0, lt=90, description="half-angle of the tripod's patch below, not believed")
    point: list[ProbePointFacts] = Field([], description="things clicked in panorama and plate")
    point_sigma_px: Length = Field(3.0, description="standard uncertainty of a click")


class FisheyeFacts(Strict):
    """One hemispherical photograph: its lens, and how it was held."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    files: list[str] = Field([], description="RAW files or globs of its bracket, relative to root")
    file: str | None = Field(None, description="or one linear picture, .hdr or .exr")
    projection: Literal["equidistant", "equisolid", "stereographic"] = Field(
        "equidistant", description="radius as angle, sine of half of it, or tangent of half of it"
    )
    fov_deg: float = Field(gt=60, le=280, description="angle across the image circle")
    radius_px: Length = Field(description="radius of the image circle")
    centre_px: tuple[Coordinate, Coordinate] | None = Field(None, description="its centre; None: the picture's")
    yaw_deg: Coordinate | None = Field(None, description="of the axis about +Y, counter-clockwise from above, 0 to +Z")
    pitch_deg: Coordinate = Field(0.0, description="of the axis above the horizon")
    roll_deg: Coordinate = Field(0.0, description="of the camera about its axis, clockwise as it looks")

    @model_validator(mode="after")
    def _one_source(self) -> FisheyeFacts:
        if bool(self.files) == bool(self.file):
            raise ValueError("expected either files (RAW) or file (.hdr, .exr)")
        return self


class FisheyePairFacts(LightFacts):
    """Fisheye photographs that together see all around."""

    kind: Literal["fisheye_pair"]
    fisheye: list[FisheyeFacts] = Field(min_length=1, max_length=4, description="two hemispheres, usually")
    space: Literal["linear_rec709", "acescg"] | None = Field(None, description="colour space of files, as of a map")
    orientation_sigma_deg: float = Field(1.0, ge=0, le=180, description="standard uncertainty of stated rotations")

    @model_validator(mode="after")
    def _unique(self) -> FisheyePairFacts:
        names = [one.name for one in self.fisheye]
        if "plate" in names or len(set(names)) < len(names):
            raise ValueError(f"fisheye names are {names}; each must be unique and none may be 'plate'")
        return self


PROBE_KINDS: dict[str, type[Strict]] = {
    "mirror_ball": MirrorBallFacts, "grey_ball": GreyBallFacts, "map": MapFacts, "panorama": PanoramaFacts,
    "fisheye_pair": FisheyePairFacts,
}  # fmt: skip
BALL_KINDS = ("mirror_ball", "grey_ball")


def _probe_kind(value: Any) -> str | None:
    """Name of the kind of a [probe] table; a table without one is a mirror ball's."""
    kind = value.get("kind", "mirror_ball") if isinstance(value, dict) else getattr(value, "kind", None)
    return kind if isinstance(kind, str) else None


ProbeFacts = Annotated[
    Annotated[MirrorBallFacts, Tag("mirror_ball")]
    | Annotated[GreyBallFacts, Tag("grey_ball")]
    | Annotated[MapFacts, Tag("map")]
    | Annotated[PanoramaFacts, Tag("panorama")]
    | Annotated[FisheyePairFacts, Tag("fisheye_pair")],
    Discriminator(
        _probe_kind, custom_error_type="probe_kind",
        custom_error_message="expected one of " + ", ".join(PROBE_KINDS),
    ),
]  # fmt: skip
