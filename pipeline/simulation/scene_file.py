"""SCENE.toml of ``insitu simulate``: what is photographed, with which camera, and how well the truth is computed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from pipeline.run.errors import ManifestError
from pipeline.run.manifest import BoardFacts, Rgb, Share, Strict, load_toml, problems_of

Point = tuple[float, float, float]
Span = tuple[float, float]


class CameraModel(Strict):
    """Lens and body. Pixel origin of conventions."""

    width: int = Field(gt=15, multiple_of=2)
    height: int = Field(gt=15, multiple_of=2)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    distortion: tuple[float, ...] = Field(
        (0, 0, 0, 0, 0), min_length=4, max_length=8,
        description="5: Brown's k1 k2 p1 p2 k3; 8: rational, with k4 k5 k6 behind; 4: fisheye's k1 k2 k3 k4",
    )  # fmt: skip
    blur_sigma_px: float = Field(0.55, ge=0.29, le=0.76, description="Gaussian, the pixel's box included")
    focal_mm: float = Field(gt=0)
    fnumber: float = Field(gt=0)
    iso: int = Field(gt=0)
    make: str = "insitu"
    model: str = "Simulated"


class SensorModel(Strict):
    """Noise and colour of the sensor."""

    cfa: Literal["RGGB", "BGGR", "GRBG", "GBRG"] = "RGGB"
    black: tuple[int, int, int, int] = (512, 512, 512, 512)
    white: int = Field(15800, gt=0, lt=65536)
    e_per_dn: float = Field(gt=0)
    read_noise_e: float = Field(ge=0)
    prnu: float = Field(0.005, ge=0, lt=0.2)
    hot_pixels: int = Field(0, ge=0)
    hot_e_per_s: Span = (2e3, 1e5)
    color_matrix: tuple[Point, Point, Point] = Field(description="camera_rgb from XYZ under D65; scaled to green = 1")


class SoftboxFacts(Strict):
    """A window or a soft light: a rectangle on the sky, with a cross of bars when bar_deg > 0."""

    azimuth_deg: float
    elevation_deg: float = Field(ge=-89, le=89)
    half_deg: Span
    radiance: Rgb
    edge_deg: float = Field(1.5, gt=0)
    bar_deg: float = Field(0.0, ge=0)


class LampFacts(Strict):
    """A round light; the sun is one of 0.53 degrees."""

    azimuth_deg: float
    elevation_deg: float = Field(ge=-90, le=90)
    diameter_deg: float = Field(gt=0.1, lt=90)
    radiance: Rgb
    edge_deg: float = Field(0.6, gt=0)


class LightFacts(Strict):
    """The distant scene. All radiances are multiplied by ``scale``."""

    scale: float = Field(1.0, gt=0)
    wall: Rgb
    wall_variation: float = Field(0.3, ge=0, le=1)
    wall_azimuth_deg: float = 0.0
    ceiling: Rgb
    floor: Rgb
    softbox: list[SoftboxFacts] = Field([], description="later ones cover earlier ones")
    lamp: list[LampFacts] = Field([], description="cover the soft boxes")
    map_width: int = Field(2048, ge=16, le=8192, multiple_of=2)


class NearLampModel(Strict):
    """A glowing ball at a finite distance; its radiance is multiplied by ``light.scale``."""

    position_m: Point
    diameter_m: float = Field(gt=0)
    radiance: Rgb


class RoomModel(Strict):
    """A closed box of matt walls around everything, in place of the distant light."""

    centre_m: Point
    size_m: Point
    wall: Rgb
    ceiling: Rgb
    floor: Rgb
    stated: bool = Field(True, description="capture.toml has its measures as [room]")


class TableFacts(Strict):
    """The table top, y = 0: procedural wood or terrazzo, diffuse, or glossy by the glTF material with a roughness."""

    pattern: Literal["wood", "terrazzo"] = "wood"
    x_m: Span
    z_m: Span
    texel_m: float = Field(0.0005, gt=0)
    albedo: Rgb = (0.45, 0.33, 0.22)
    contrast: float = Field(1.0, ge=0, le=2)
    roughness: float | None = Field(None, gt=0, le=1)


class PrintFacts(Strict):
    """How the board is printed."""

    paper: Rgb = (0.80, 0.80, 0.79)
    ink: Rgb = (0.04, 0.04, 0.042)
    px_per_mm: float = Field(7.0, gt=0)


class MarkerModel(Strict):
    """A printed marker on the table, its sides along x and z; the first of them lies at the origin of the world."""

    dictionary: str = "DICT_5X5_100"
    id: int = Field(ge=0)
    side_m: float = Field(gt=0)
    margin_m: float = Field(0.01, gt=0, description="white paper around it")
    position_m: Span = Field((0.0, 0.0), description="x, z of its centre")


class BoxModel(Strict):
    """A real box (or, thin, a wall) that stands on the table in every photograph, speckled."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    position_m: Span = Field(description="x, z of its middle")
    size_m: Point = Field(description="along its x, y, z")
    yaw_deg: float = 0.0
    albedo: Rgb
    contrast: float = Field(0.9, ge=0, le=2)
    stated: bool = Field(False, description="capture.toml has it as a [[proxy]], without its albedo")


class BallModel(Strict):
    """The mirror ball; it stands on the table."""

    position_m: Span = Field(description="x, z")
    diameter_m: float = Field(gt=0)
    reflectance: Rgb


class ViewFacts(Strict):
    """A camera position. A ball view without position is taken from the plate's tripod."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    position_m: Point | None = None
    target_m: Point | None = None
    click_px: Span | None = Field(None, description="of a ball view: capture.toml says about where the ball is")


class Lathe(Strict):
    """A profile of (radius, height) turned about the y axis, through smooth curves."""

    kind: Literal["lathe"]
    profile_m: list[Span] = Field(min_length=3)


class Sphere(Strict):
    """A sphere that stands on the table."""

    kind: Literal["sphere"]
    radius_m: float = Field(gt=0)


class Torus(Strict):
    """A ring, lying or standing on its edge."""

    kind: Literal["torus"]
    major_m: float = Field(gt=0)
    minor_m: float = Field(gt=0)
    standing: bool = False


class ObjectModel(Strict):
    """A synthetic object; base_color is linear Rec.709 as in glTF, rounded to 1/255 as the file stores it."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    shape: Annotated[Lathe | Sphere | Torus, Field(discriminator="kind")]
    base_color: Rgb
    metallic: float = Field(ge=0, le=1)
    roughness: float = Field(ge=0, le=1)
    position_m: Span
    yaw_deg: float = 0.0
    segments: int = Field(96, ge=8)


class BoardPhoto(Strict):
    """A calibration photograph: the board's centre is seen at the fraction ``at`` of the picture."""

    tilt_deg: float = Field(ge=0, le=70, description="between the view axis to the centre and the board's normal")
    azimuth_deg: float = Field(description="where the camera stands; 0 is below the print (+z), 90 at its right")
    distance_m: float = Field(gt=0)
    roll_deg: float = 0.0
    at: Span = (0.5, 0.5)


class WrongLabel(Strict):
    """A frame whose EXIF exposure time is that of its true one times a factor."""

    file: str
    factor: float = Field(gt=0)


class BracketFacts(Strict):
    """Exposures: the fullest channel of the plate's middle frame and of the shortest ball frame.

    A ``ball_fill`` above 1 lets the brightest light clip in every frame. ``plate_turn_deg``, ``ball_turn_deg``: a hand
    is on the camera, and each frame of the plate, or of every ball view from its darkest, is turned to the right and
    upwards by so much.
    """

    plate_ev: list[int] = Field([-2, 0, 2], min_length=1)
    plate_fill: float = Field(0.85, gt=0, le=1)
    ball_frames: int = Field(6, ge=1, le=12)
    ball_step_ev: int = Field(2, ge=1, le=4)
    ball_fill: float = Field(0.8, gt=0, le=1e5)
    plate_turn_deg: list[Span] = Field([])
    ball_turn_deg: list[Span] = Field([])
    wrong_label: list[WrongLabel] = Field([])
    started: str = Field("2026:03:14 10:00:00", description="EXIF time of the first frame")


class DentFacts(Strict):
    """A dent of the mirror ball: a Gaussian of the angle from its middle. Directions as of the light."""

    azimuth_deg: float
    elevation_deg: float = Field(ge=-90, le=90)
    depth_m: float = Field(description="how far its middle lies inside; negative: a bump")
    sigma_deg: float = Field(gt=1, lt=60)


class LeaveFacts(Strict):
    """What leaves the model class of the estimators on purpose; nothing of it is written into capture.toml."""

    glare: Share = Field(0.0, lt=0.5, description="share of the light that lens and body spread over the picture")
    glare_radius_px: float = Field(60.0, gt=0, description="of the bell (1 + (r / radius)^2)^-3/2 that it is spread by")
    curl_radius_m: float | None = Field(None, gt=0.05, description="printed sheets bend up along x on this radius")
    dent: list[DentFacts] = Field([])
    table_coat: float | None = Field(
        None, gt=0.01, le=1, description="alpha of a clear coat (index 1.5) over the table, with the light within it"
    )


class SamplingFacts(Strict):
    """Samples per pixel; each is a whole number of stratified passes."""

    pass_samples: int = Field(64, ge=1, description="samples per pixel of one pass")
    plate: int = Field(256, ge=1)
    region: int = Field(4096, ge=1, description="where the objects change the plate")
    change: int = Field(0, ge=0, description="of the change, added in the shadows; 0, or at least as many as region")
    object: int = Field(16384, ge=1, description="where the objects are seen")
    region_pass: int = Field(1024, ge=1, description="samples per pixel of one pass in region and object")
    region_threshold: float = Field(0.01, gt=0, description="relative change that puts a pixel into the region")
    ball: int = Field(256, ge=1)
    calibration: int = Field(32, ge=1)
    environment: int = Field(64, ge=1)
    environment_width: int = Field(512, ge=16)
    depth: int = Field(10, ge=2)

    @model_validator(mode="after")
    def _whole_passes(self) -> SamplingFacts:
        if self.change and (self.change < max(self.region, 2 * self.region_pass) or self.change % self.region_pass):
            raise ValueError(
                f"change is {self.change}; expected 0, or whole passes of region_pass ({self.region_pass}), "
                f"at least two and at least region ({self.region})"
            )
        return self


class SimulatedScene(Strict):
    """SCENE.toml."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    title: str
    seed: int = Field(ge=0)
    camera: CameraModel
    sensor: SensorModel
    light: LightFacts
    table: TableFacts
    board: BoardFacts | None = None
    board_print: PrintFacts = PrintFacts()
    marker: list[MarkerModel] = Field([], description="instead of a board")
    bare_plate: bool = Field(False, description="board and markers are taken away before the plate")
    box: list[BoxModel] = Field([])
    near_lamp: list[NearLampModel] = Field([])
    room: RoomModel | None = None
    ball: BallModel
    plate: ViewFacts
    ball_view: list[ViewFacts] = Field(min_length=1)
    view: list[ViewFacts] = Field([], description="further photographs, as JPEG: they orient the others")
    object: list[ObjectModel] = Field([], description="what really stands there in the truth")
    calibration: list[BoardPhoto] = Field(
        [], description="without them capture.toml gives the intrinsics, or leaves them to the further photographs"
    )
    bracket: BracketFacts = BracketFacts()
    leave: LeaveFacts = LeaveFacts()
    sampling: SamplingFacts = SamplingFacts()

    def frames(self) -> dict[str, list[str]]:
        """Files of the RAW frames of every view, the plate's in the order of ``plate_ev``, a ball's darkest first."""
        plate = [f"plate/plate_ev{ev:+d}.dng".replace("+0", "0") for ev in self.bracket.plate_ev]
        count = range(1, self.bracket.ball_frames + 1)
        balls = {view.name: [f"{view.name}/{view.name}_{i}.dng" for i in count] for view in self.ball_view}
        return {"plate": plate, **balls}

    @model_validator(mode="after")
    def _consistent(self) -> SimulatedScene:
        names = [self.plate.name, *[view.name for view in [*self.ball_view, *self.view]]]
        if (self.board is None) == (not self.marker):
            raise ValueError("expected either [board] or [[marker]]")
        if self.marker and self.marker[0].position_m != (0.0, 0.0):
            raise ValueError(f"marker[0].position_m is {self.marker[0].position_m}; it defines the origin")
        if self.calibration and self.board is None:
            raise ValueError("calibration: photographs of a board, and there is no [board]")
        if any(view.position_m is None for view in self.view):
            raise ValueError("view: has no position_m; it is required")
        turns = self.bracket.plate_turn_deg
        if turns and len(turns) != len(self.bracket.plate_ev):
            raise ValueError(f"bracket.plate_turn_deg has {len(turns)} entries; expected one per frame of plate_ev")
        turns = self.bracket.ball_turn_deg
        if turns and len(turns) != self.bracket.ball_frames:
            raise ValueError(f"bracket.ball_turn_deg has {len(turns)} entries; expected one per frame of ball_frames")
        taken = {file for files in self.frames().values() for file in files}
        if strange := [wrong.file for wrong in self.bracket.wrong_label if wrong.file not in taken]:
            raise ValueError(f"bracket.wrong_label: no frame {strange}; expected some of {sorted(taken)}")
        if self.leave.table_coat is not None and self.table.roughness is not None:
            raise ValueError("leave.table_coat and table.roughness are two glosses of one table; give one")
        if names[0] != "plate" or len(set(names)) < len(names):
            raise ValueError(f"views are {names}; expected 'plate' first and unique names")
        if self.plate.position_m is None:
            raise ValueError("plate: has no position_m; it is required")
        missing = [v.name for v in [self.plate, *self.ball_view] if (v.position_m is None) != (v.target_m is None)]
        if missing:
            raise ValueError(f"views {missing}: position_m and target_m go together")
        return self


def load_scene(path: Path) -> SimulatedScene:
    """Read and validate SCENE.toml. Raises ManifestError with every problem at once."""
    data = load_toml(path)
    try:
        return SimulatedScene.model_validate(data)
    except ValidationError as error:
        raise ManifestError(*problems_of(error, path, SimulatedScene)) from error
