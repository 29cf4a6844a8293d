"""capture.toml (facts of what was photographed) and scene.toml (wishes): validated, all problems at once.

Imports no numpy: a refused manifest answers at once.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from pipeline.run.board_facts import BoardFacts, Dictionary
from pipeline.run.camera_facts import PoseFacts
from pipeline.run.develop_facts import ChartFacts, LensFacts
from pipeline.run.errors import ManifestError
from pipeline.run.noise_facts import NoiseFacts
from pipeline.run.probe_facts import BALL_KINDS, PROBE_KINDS, ProbeFacts
from pipeline.run.sensor_facts import SensorFacts
from pipeline.run.strict import Coordinate, Length, Rgb, Share, Strict


class PlateFacts(Strict):
    """The photograph that objects are put into."""

    files: list[str] = Field(min_length=1, description="RAW files or globs, relative to root")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


# What a key of [camera.given] must be, in words and as a test of what TOML held.
PIXELS = ("whole pixels above 0", lambda value: _is_number(value) and value > 0 and value % 1 == 0)
FOCAL = ("pixels above 0", lambda value: _is_number(value) and value > 0)
PLACE = ("a finite number", _is_number)
BEND = ("finite numbers", lambda value: all(map(_is_number, value if isinstance(value, list) else [value])))
NAME = ("a name", lambda value: isinstance(value, str))
GIVEN: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "width": PIXELS, "height": PIXELS, "fx": FOCAL, "fy": FOCAL, "cx": PLACE, "cy": PLACE, "distortion": BEND,
    "distortion_model": NAME,
}  # fmt: skip


class CameraFacts(Strict):
    """Where the intrinsics come from: board photographs, given numbers (pixel origin of conventions), a camera.json."""

    calibration: list[str] = Field([], description="board photographs, files or globs")
    given: dict[str, float | list[float] | str] | None = Field(
        None, description="width height fx fy cx cy [distortion [distortion_model: brown, rational or fisheye]]"
    )
    file: str | None = Field(None, description="camera.json of a former build, same optics; relative to capture.toml")

    @field_validator("given", mode="before")
    @classmethod
    def _numbers(cls, given: Any) -> Any:
        """What `pipeline.camera.given_camera` computes with is of its kind; which keys it wants, it says itself."""
        wrong = [
            f"{key} is {value!r}; expected {GIVEN[key][0]}"
            for key, value in (given.items() if isinstance(given, dict) else ())
            if key in GIVEN and not GIVEN[key][1](value)
        ]
        if wrong:
            raise ValueError(". ".join(wrong))
        return given

    @model_validator(mode="after")
    def _one_source(self) -> CameraFacts:
        if self.file is not None and (self.calibration or self.given is not None):
            raise ValueError("file: a former calibration stands alone; drop it, or calibration and given")
        return self


class BallFacts(Strict):
    """One view of the mirror ball."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    files: list[str] = Field(min_length=1)
    tripod: bool = Field(False, description="taken from the plate's own camera position")
    click_px: tuple[float, float] | None = Field(None, description="near the ball's centre; used only if not found")
    camera: CameraFacts | None = Field(None, description="of another body, lens or size; without it, the plate's")

    @model_validator(mode="after")
    def _one_camera(self) -> BallFacts:
        if self.camera is not None and self.tripod:
            raise ValueError("tripod = true says the plate's camera in its place, camera another one; drop one of them")
        if self.camera is not None and not (self.camera.calibration or self.camera.given or self.camera.file):
            raise ValueError("camera: neither calibration photographs nor given numbers, nor a former camera's file")
        return self


class MarkerFacts(Strict):
    """An ArUco or AprilTag marker; the first one defines the world, the places of others are found."""

    dictionary: Dictionary = "DICT_5X5_100"
    id: int = Field(ge=0)
    side_m: float = Field(gt=0.001, lt=5.0)


class ViewsFacts(Strict):
    """Further photographs of the place (JPEG or RAW, one exposure each): they orient the others by what all show."""

    files: list[str] = Field(min_length=1, description="files or globs")
    own_camera: bool = Field(False, description="taken by another body, lens or focus than the plate")


class ExposureFacts(Strict):
    """Exposure of files whose EXIF is missing or wrong, and the filter, which EXIF never tells."""

    files: list[str]
    exposure_s: float | None = Field(None, gt=0)
    iso: float | None = Field(None, gt=0)
    fnumber: float | None = Field(None, gt=0)
    nd_stops: float | None = Field(None, ge=0, le=30, description="of a neutral density filter on the lens")


class ProxyFacts(Strict):
    """A further real surface near the objects: a box, or a mesh file in the world frame, metres."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    file: str | None = Field(None, description=".glb, .obj or .ply; relative to capture.toml, else to root")
    centre_m: tuple[Coordinate, Coordinate, Coordinate] | None = Field(None, description="of a box, world frame")
    size_m: tuple[Length, Length, Length] | None = Field(None, description="of a box along its x, y, z")
    yaw_deg: float = Field(0.0, description="of a box about +Y, counter-clockwise seen from above")
    albedo: tuple[Share, Share, Share] | None = Field(None, description="linear; without it, measured from the plate")
    albedo_space: Literal["linear_rec709", "acescg"] = "linear_rec709"

    @model_validator(mode="after")
    def _one_shape(self) -> ProxyFacts:
        box = [self.centre_m is not None, self.size_m is not None]
        if not ((self.file and not any(box)) or (not self.file and all(box))):
            raise ValueError("expected either file, or centre_m with size_m")
        if self.file and self.yaw_deg:
            raise ValueError("yaw_deg turns a box; a mesh file is in the world frame already")
        return self


class RoomFacts(Strict):
    """The walls around probe and objects, roughly a box, world frame: takes the light from probe to objects."""

    centre_m: tuple[Coordinate, Coordinate, Coordinate] = Field(description="of the box")
    size_m: tuple[Length, Length, Length] = Field(description="along its x, y, z")
    yaw_deg: float = Field(0.0, description="about +Y, counter-clockwise seen from above")


class OccluderFacts(Strict):
    """A real thing in front of the objects: a mesh file in the world frame, or a mask picture of the plate."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    file: str = Field(description="mesh .glb .obj .ply, or mask .png .exr (1 = in front); relative to capture.toml")


class SeenFacts(Strict):
    """Where one view shows a reference."""

    view: str
    corners_px: list[tuple[Coordinate, Coordinate]] = Field(
        min_length=3, max_length=64, description="in order, first pixel centre at (0.5, 0.5)"
    )

    @model_validator(mode="after")
    def _convex(self) -> SeenFacts:
        corners = self.corners_px
        turns = []
        for i, (x, y) in enumerate(corners):
            (bx, by), (cx, cy) = corners[(i + 1) % len(corners)], corners[(i + 2) % len(corners)]
            turns.append((bx - x) * (cy - by) - (by - y) * (cx - bx))
        if not (min(turns) > 0 or max(turns) < 0):
            raise ValueError("corners_px cross, coincide or turn inward; expected a convex outline, corner by corner")
        return self


class ReferenceFacts(Strict):
    """A grey card, white card, 24-patch chart or grey ball that plate and balls show: it ties their colours."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    kind: Literal["grey_card", "white_card", "chart", "grey_ball"]
    reflectance: tuple[Share, Share, Share] | None = Field(None, description="linear RGB; without it, neutral")
    reflectance_space: Literal["acescg", "linear_rec709"] = "acescg"
    on_plane: bool | None = Field(None, description="lies flat on the plane; without it, where its outline says so")
    size_mm: tuple[Length, Length] | None = Field(None, description="first side and second: how a card is tilted")
    seen: list[SeenFacts] = Field(min_length=1, description="one table per view that shows it")

    @model_validator(mode="after")
    def _shape(self) -> ReferenceFacts:
        views = [seen.view for seen in self.seen]
        if len(set(views)) < len(views):
            raise ValueError(f"seen.view is {views}; expected each view once")
        if self.kind == "chart" and self.reflectance is not None:
            raise ValueError("reflectance: a chart's 24 patches are known; take it out")
        if self.kind == "chart" and any(len(seen.corners_px) != 4 for seen in self.seen):
            raise ValueError("corners_px: expected a chart's four corners: dark skin, bluish green, black, white")
        if len({len(seen.corners_px) == 4 for seen in self.seen}) > 1:
            raise ValueError("corners_px: four corners in one view, another outline in another; expected one kind")
        if self.size_mm and (self.kind == "grey_ball" or len(self.seen[0].corners_px) != 4):
            raise ValueError("size_mm: is for a card with four corners; take it out")
        if self.reflectance is not None and min(self.reflectance) <= 0:
            raise ValueError(f"reflectance is {self.reflectance}; expected three numbers above 0")
        return self


class CaptureFacts(Strict):
    """capture.toml."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    root: str = Field(".", description="where the photographs lie; relative to this file; environment variables expand")
    plate: PlateFacts
    ball: list[BallFacts] = Field([], description="views of the ball, for the kinds that are one")
    probe: ProbeFacts
    board: BoardFacts | None = None
    marker: list[MarkerFacts] = Field([], description="one [marker] table, or several [[marker]]")
    views: ViewsFacts | None = None
    camera: CameraFacts = CameraFacts()
    pose: list[PoseFacts] = Field([])
    exposure: list[ExposureFacts] = Field([])
    sensor: list[SensorFacts] = Field([])
    noise: list[NoiseFacts] = Field([])
    proxy: list[ProxyFacts] = Field([])
    room: RoomFacts | None = None
    occluder: list[OccluderFacts] = Field([])
    reference: list[ReferenceFacts] = Field([])
    chart: ChartFacts | None = None
    lens: LensFacts | None = None
    truth: str | None = Field(None, description="truth.json of a simulated capture, relative to this file")

    @field_validator("marker", mode="before")
    @classmethod
    def _one_marker(cls, value: Any) -> Any:
        return [value] if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _consistent(self) -> CaptureFacts:
        names = [ball.name for ball in self.ball]
        if self.probe.kind in BALL_KINDS and not names:
            raise ValueError(f"ball: missing; probe.kind = {self.probe.kind} needs at least one [[ball]]")
        if self.probe.kind not in BALL_KINDS and names:
            raise ValueError(f"ball: probe.kind = {self.probe.kind} looks at no ball; take the [[ball]] tables out")
        if "plate" in names or len(set(names)) < len(names):
            raise ValueError(f"ball names are {names}; each must be unique and none may be 'plate'")
        taken = [name for name in names if name == "chart" or name.startswith("flat_")]
        if taken:
            raise ValueError(f"ball names {taken} are those of photographs of [chart] and [lens]; choose others")
        views = {"plate", *names}
        unknown = [pose.view for pose in self.pose if pose.view not in views]
        if unknown:
            raise ValueError(f"pose.view is {unknown}; expected one of {sorted(views)}")
        twice = sorted({pose.view for pose in self.pose if [other.view for other in self.pose].count(pose.view) > 1})
        if twice:
            raise ValueError(f"pose.view {twice} has several [[pose]] tables; expected one per view")
        shown = views | {lens.name for lens in getattr(self.probe, "fisheye", []) if lens.files}
        strange = sorted({seen.view for one in self.reference for seen in one.seen} - shown)
        if strange:
            raise ValueError(f"reference.seen.view is {strange}; expected one of {sorted(shown)}")
        sensors = [(noise.camera, noise.iso) for noise in self.noise]
        if len(set(sensors)) < len(sensors):
            raise ValueError(f"noise is given for (camera, ISO) {sensors}; expected each pair once")
        for kind, tables in (("proxy", self.proxy), ("occluder", self.occluder), ("reference", self.reference)):
            given = [table.name for table in tables]
            if len(set(given)) < len(given):
                raise ValueError(f"{kind} names are {given}; each must be unique")
        marks = [(marker.dictionary, marker.id) for marker in self.marker]
        if len(set(marks)) < len(marks):
            raise ValueError(f"marker ids are {[mark[1] for mark in marks]}; each must be unique")
        if any(pose.route == "colmap" for pose in self.pose) and self.views is None:
            raise ValueError("pose.route colmap needs [views]: further photographs of the place")
        cameras = [self.camera, *(ball.camera for ball in self.ball if ball.camera is not None)]
        if any(camera.calibration for camera in cameras) and self.board is None:
            raise ValueError("camera.calibration needs [board]")
        return self


class MaterialWish(Strict):
    """Material of an object; replaces the file's own. Colours are linear in ``space``."""

    base_color: Rgb | None = Field(None, description="0.8 grey when not given, clear for glass")
    metallic: float = Field(0.0, ge=0, le=1)
    roughness: float | None = Field(None, ge=0, le=1, description="0.5 when not given, 0 for glass")
    conductor: Literal["aluminium", "brass", "chromium", "copper", "gold", "iron", "silver"] | None = None
    transmission: float = Field(0.0, ge=0, le=1, description="1 is glass, a thick solid")
    ior: float = Field(1.5, gt=1, le=4, description="refractive index")
    emission: Rgb = Field((0.0, 0.0, 0.0), description="1 is the radiance of a white surface lying on the plane")
    space: Literal["linear_rec709", "acescg"] = "linear_rec709"

    @model_validator(mode="after")
    def _one_kind(self) -> MaterialWish:
        if self.conductor and (self.base_color or "metallic" in self.model_fields_set):
            raise ValueError(f"conductor {self.conductor!r} sets base_color and metallic; give one or the other")
        if self.transmission and (self.conductor or self.metallic):
            raise ValueError("transmission: a metal lets no light through; give transmission or metal")
        if min(self.emission) < 0:
            raise ValueError(f"emission is {self.emission}; expected three numbers >= 0")
        return self


class ObjectWish(Strict):
    """One object and where it stands."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    file: str = Field(description=".glb, .obj or .ply; relative to scene.toml, else to the capture's root")
    position_m: tuple[float, float] = Field(description="x and z on the plane, world frame")
    lift_m: float = Field(0.0, description="height of the object's origin above the plane")
    yaw_deg: float = Field(0.0, description="about +Y, counter-clockwise seen from above")
    scale: float = Field(1.0, gt=0, description="metres per unit of the file")
    material: MaterialWish | None = None

    @field_validator("position_m", mode="before")
    @classmethod
    def _on_the_plane(cls, value: Any) -> Any:
        if isinstance(value, list) and len(value) == 3:
            raise ValueError(f"is {value}; expected two numbers, x and z on the plane; the height above it is lift_m")
        return value


class SceneWishes(Strict):
    """scene.toml, less the knobs of the stages (tables named after a stage, checked against stages/knobs.py)."""

    object: list[ObjectWish] = Field([])
    quality: Literal["draft", "preview", "final"] = "preview"

    @model_validator(mode="after")
    def _unique(self) -> SceneWishes:
        names = [wish.name for wish in self.object]
        if len(set(names)) < len(names):
            raise ValueError(f"object names are {names}; each must be unique")
        return self


MEANT = {"height_m": ("lift_m",), "y_m": ("lift_m",), "rotation_deg": ("yaw_deg",), "size": ("scale",)}  # other names


def load_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file. Raises ManifestError when it is missing, not TOML, or not to be read."""
    if not path.is_file():
        raise ManifestError(f"{path}: no such file")
    try:
        content = path.read_bytes()
        return tomllib.loads(content.decode("utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ManifestError(f"{path}: not valid TOML: {error}") from error
    except UnicodeDecodeError as error:
        line, byte = content[: error.start].count(b"\n") + 1, content[error.start]
        raise ManifestError(
            f"{path}:{line}: not valid TOML: byte 0x{byte:02x} is no UTF-8; save it as UTF-8"
        ) from error
    except OSError as error:
        raise ManifestError(f"{path}: cannot be read ({error.strerror}); give it permission") from error


def problems_of(error: ValidationError, path: Path, model: type[BaseModel], prefix: str = "") -> list[str]:
    """One line per problem: file:line: key: what was found; what was expected."""
    text = path.read_text().splitlines() if path.is_file() else []
    lines = []
    for item in error.errors(include_url=False):
        loc = [part for i, part in enumerate(item["loc"]) if not _is_tag(item["loc"], i)]
        keys = [*([prefix] if prefix else []), *[str(part) for part in loc]]
        keys += ["kind"] if item["type"] == "probe_kind" else []  # it is the union's place that pydantic names
        dotted = re.sub(r"\.(\d+)(?=\.|$)", r"[\1]", ".".join(keys))
        where = f"{path}:{number}" if (number := line_of(text, keys)) else str(path)
        where += f": {dotted}" if dotted else ""  # what concerns the whole file names its keys itself
        if item["type"] == "extra_forbidden":
            known = known_keys(model, item["loc"][:-1])
            meant = [name for name in MEANT.get(keys[-1], ()) if name in known]
            close = meant or difflib.get_close_matches(keys[-1], known, 1)
            lines.append(f"{where}: unknown key" + (f"; did you mean {close[0]}?" if close else ""))
        elif item["type"] == "missing":
            lines.append(f"{where}: missing; it is required")
        elif isinstance(item["input"], str) and item["input"].startswith("TODO"):  # as insitu init writes them
            lines.append(f"{where}: still to be filled in: {item['input'].removeprefix('TODO').lstrip(': ')}")
        elif item["type"] == "probe_kind":
            stated = item["input"].get("kind") if isinstance(item["input"], dict) else item["input"]
            lines.append(f"{where}: is {stated!r}; {item['msg']}")
        else:
            message = item["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
            message = message.replace("a valid tuple", "a list in brackets")
            found = "" if item["type"] == "value_error" else f"is {item['input']!r}; expected: "
            lines.append(f"{where}: {found}{message}")
    return lines


def _is_tag(loc: tuple[int | str, ...], at: int) -> bool:
    """Whether a part of an error's place is no key but the kind of probe that pydantic chose."""
    return at == 1 and loc[0] == "probe" and loc[1] in PROBE_KINDS


def known_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Names of the fields of the model that ``loc`` points into."""
    current: Any = model
    for at, part in enumerate(loc):
        if isinstance(part, int):
            continue
        if _is_tag(loc, at):
            current = PROBE_KINDS[str(part)]
            continue
        field = getattr(current, "model_fields", {}).get(part)
        if field is None:
            return []
        options = [field.annotation, *getattr(field.annotation, "__args__", ())]
        current = next(
            (option for option in options if isinstance(option, type) and issubclass(option, BaseModel)), None
        )
    return list(getattr(current, "model_fields", {}))


def line_of(text: list[str], keys: list[str]) -> int | None:
    """Line of the key in a TOML text, or of what holds it, found by its table headings; None when neither is there."""
    names: list[str] = []
    wanted: dict[str, int] = {}  # dotted name of an array of tables -> index
    for key in keys:
        if key.isdigit():
            wanted.setdefault(".".join(names), int(key))
        else:
            names.append(key)
    counts: dict[str, int] = {}
    table, best, depth = [""], None, 0
    for number, line in enumerate(text, 1):
        if match := re.match(r"\s*\[(\[?)\s*([\w.\-]+)\s*\]\]?", line):
            if match[1]:
                counts = {name: count for name, count in counts.items() if not name.startswith(match[2] + ".")}
                counts[match[2]] = counts.get(match[2], -1) + 1
            found = table = match[2].split(".")
        elif match := re.match(r"\s*([\w\-]+)\s*=", line):
            found = [*filter(None, table), match[1]]
        else:
            continue
        held = [".".join(found[: i + 1]) for i in range(len(found))]
        if found == names[: len(found)] and all(counts[h] == wanted.get(h, 0) for h in held if h in counts):
            if found == names:
                return number
            if len(found) > depth:
                best, depth = number, len(found)
    return best


def load_capture(folder: Path) -> tuple[CaptureFacts, Path, Path]:
    """Facts, path of capture.toml, and the resolved root of a capture folder (or of a capture.toml).

    Raises ManifestError with every problem at once.
    """
    path = folder if folder.suffix == ".toml" else folder / "capture.toml"
    data = load_toml(path)
    try:
        facts = CaptureFacts.model_validate(data)
    except ValidationError as error:
        raise ManifestError(*problems_of(error, path, CaptureFacts)) from error
    root = (path.parent / os.path.expandvars(facts.root)).resolve()
    if not root.is_dir():
        raise ManifestError(f"{path}: root: is {facts.root!r}, which is no folder ({root})")
    return facts, path, root


def resolve_files(patterns: list[str], root: Path, where: str) -> tuple[list[Path], list[str]]:
    """Files of names and globs, sorted and unique, and the problems found."""
    files: set[Path] = set()
    problems = []
    for pattern in patterns:
        found = sorted(root.glob(pattern)) if any(c in pattern for c in "*?[") else [root / pattern]
        found = [file for file in found if file.is_file()]
        if not found and pattern.startswith("TODO"):  # as insitu init writes it
            problems.append(f"{where}: still to be filled in: {pattern.removeprefix('TODO').lstrip(': ')}")
        elif not found:
            problems.append(f"{where}: is {pattern!r}; no such file in {root}")
        files.update(found)
    return sorted(files), problems
