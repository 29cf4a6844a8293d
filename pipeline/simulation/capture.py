"""From rendered pictures to a capture on disk: exposures, RAW files, board photographs, manifests, truth."""

from __future__ import annotations

import datetime
import hashlib
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG
from pipeline.run.errors import ManifestError
from pipeline.run.formats import write_bytes, write_exr
from pipeline.simulation.dng import DngFacts, decimal_fraction, dng_bytes
from pipeline.simulation.lens import Lens
from pipeline.simulation.scene_file import CameraModel, SimulatedScene
from pipeline.simulation.sensor import D65_XY, Sensor, acescg_from_rec709, camera_from_acescg, shutter, white_xyz
from pipeline.types import Raster

UNIT = (
    "(DN-black)/(white-black)*N^2*100/(t*ISO) with the true times; ACEScg (1,1,1) gives green the value 1 in camera_rgb"
)
JPEG_QUALITY = {"calibration": (95, 0), "view": (90, 2)}  # quality, and chroma subsampling as Pillow counts it


def lens_of(camera: CameraModel) -> Lens:
    """The lens of the scene file."""
    return Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)


def sensor_of(scene: SimulatedScene) -> Sensor:
    """The sensor of the scene file; its matrix scaled to green = 1 for D65 and rounded as the DNG stores it."""
    model = scene.sensor
    matrix = np.asarray(model.color_matrix)
    matrix = np.round(matrix / (matrix @ white_xyz(D65_XY))[1], 4)
    return Sensor(
        model.cfa, model.black, model.white, model.e_per_dn, model.read_noise_e, model.prnu, model.hot_pixels,
        model.hot_e_per_s, matrix, scene.seed,
    )  # fmt: skip


@dataclass
class Shoot:
    """Takes RAW frames one after the other; remembers what the truth must say of them."""

    scene: SimulatedScene
    out: Path
    sensor: Sensor
    exposures: dict[str, dict[str, float]] = field(default_factory=dict)

    def to_camera(self, acescg: np.ndarray) -> np.ndarray:
        """camera_rgb (H, W, 3) of radiance."""
        return acescg @ camera_from_acescg(self.sensor.color_matrix).T

    def gain(self, time_s: float) -> float:
        """Fraction of the green range that a radiance of one fills."""
        return time_s * self.scene.camera.iso / (100 * self.scene.camera.fnumber**2)

    def metered(self, pictures: list[np.ndarray], fill: float) -> int:
        """Third of a stop of the longest time at which no channel is fuller than ``fill``."""
        fullest = max(float(self.to_camera(picture).max()) for picture in pictures)
        return int(np.ceil(-3 * np.log2(fill / (fullest * self.gain(1.0))) - 1e-9))

    def take(self, name: str, acescg: np.ndarray, third: int) -> None:
        """Expose one frame of a radiance picture (H, W, 3) and write ``name``. Raises ManifestError off the ladder."""
        wrong = {one.file: one.factor for one in self.scene.bracket.wrong_label}
        try:
            time_s, label = shutter(third)
        except ValueError as error:
            raise ManifestError(f"{name}: {error}; change light.scale or camera.fnumber") from error
        if name in wrong:
            label = (label * Fraction(wrong[name])).limit_denominator(10000)
        number = len(self.exposures)
        mosaic = self.sensor.expose(self.to_camera(acescg), self.gain(time_s), time_s, number)
        write_bytes(self.out / name, dng_bytes(mosaic, self._facts(label, number)))
        clipped = float(np.mean(mosaic >= self.sensor.white))
        self.exposures[name] = {"label_s": float(label), "true_s": time_s, "clipped": clipped}

    def _facts(self, label: Fraction, number: int) -> DngFacts:
        camera, sensor = self.scene.camera, self.sensor
        start = datetime.datetime.strptime(self.scene.bracket.started, "%Y:%m:%d %H:%M:%S")
        stamp = (start + datetime.timedelta(seconds=7 * number)).strftime("%Y:%m:%d %H:%M:%S")
        return DngFacts(
            label, camera.iso, decimal_fraction(camera.fnumber, 2), decimal_fraction(camera.focal_mm, 2), stamp,
            camera.make, camera.model, sensor.cfa, sensor.black, sensor.white, sensor.color_matrix, sensor.neutral,
            sensor.noise_profile(),
        )  # fmt: skip


def take_brackets(shoot: Shoot, pictures: dict[str, np.ndarray]) -> None:
    """All RAW frames of the plate and the ball views; ``pictures`` has "plate", the balls, and turned "plate_0" ..."""
    bracket, frames = shoot.scene.bracket, shoot.scene.frames()
    base = shoot.metered([pictures["plate"]], bracket.plate_fill)
    for number, (file, ev) in enumerate(zip(frames["plate"], bracket.plate_ev, strict=True)):
        shoot.take(file, pictures.get(f"plate_{number}", pictures["plate"]), base - 3 * ev)
    names = [view.name for view in shoot.scene.ball_view]
    shortest = shoot.metered([pictures[name] for name in names], bracket.ball_fill)
    for name in names:
        for number, file in enumerate(frames[name]):
            shoot.take(
                file, pictures.get(f"{name}_{number}", pictures[name]), shortest - 3 * bracket.ball_step_ev * number
            )


def srgb_jpeg(acescg: np.ndarray, sensor: Sensor, seed: int, kind: str = "calibration", exif: bytes = b"") -> bytes:
    """A developed photograph: exposed to its own brightest, sensor noise, sRGB, JPEG."""
    from PIL import Image

    linear = acescg @ np.linalg.inv(acescg_from_rec709()).T
    linear = 0.8 * linear / np.percentile(linear, 99.5)
    slope, offset = sensor.noise_profile()
    noise = np.random.default_rng([sensor.seed, 3, seed]).standard_normal(linear.shape)
    linear = np.clip(linear + noise * np.sqrt(slope * np.clip(linear, 0, 1) + offset), 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    stream = io.BytesIO()
    picture = Image.fromarray(np.rint(encoded * 255).astype(np.uint8))
    quality, subsampling = JPEG_QUALITY[kind]
    picture.save(stream, "JPEG", quality=quality, subsampling=subsampling, **({"exif": exif} if exif else {}))
    return stream.getvalue()


def lens_exif(camera: CameraModel) -> bytes:
    """EXIF of a photograph: make, model and focal length, also as if on 35 mm film by a sensor 36 mm wide."""
    from PIL import Image

    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = camera.make, camera.model
    exif.get_ifd(0x8769).update({0x920A: camera.focal_mm, 0xA405: round(camera.focal_mm)})
    return exif.tobytes()


def write_picture(path: Path, rgb: np.ndarray, extra: dict[str, np.ndarray] | None = None, unit: str = UNIT) -> None:
    """Truth picture (H, W, 3) as EXR in ACEScg, of half floats unless something in it is too bright for them."""
    half = bool(np.max(rgb) < np.finfo(np.float16).max)
    write_exr(path, Raster({**Raster.split(rgb), **(extra or {})}, ACESCG, {"insitu:unit": unit}), half=half)


def write_layers(path: Path, layers: dict[str, np.ndarray], shape: tuple[int, int]) -> None:
    """Named data channels (H, W) as half-float EXR; a channel ``none`` of zeros when there are no layers."""
    write_exr(path, Raster(layers or {"none": np.zeros(shape)}, "data", {"insitu:unit": "1"}), half=True)


def toml_value(value: Any) -> str:
    """A TOML value: strings, numbers, booleans and lists of them."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    return json.dumps(value)


def toml_text(tables: list[tuple[str, dict[str, Any]]]) -> str:
    """TOML of (heading, keys); a heading is "" or bracketed."""
    blocks = []
    for heading, keys in tables:
        lines = [heading] if heading else []
        blocks.append("\n".join(lines + [f"{key} = {toml_value(value)}" for key, value in keys.items()]))
    return "\n\n".join(blocks) + "\n"


def capture_tables(scene: SimulatedScene) -> Iterator[tuple[str, dict[str, Any]]]:
    """The tables of capture.toml."""
    yield "", {"name": scene.name, "truth": "truth/truth.json"}
    yield "[plate]", {"files": ["plate/*.dng"]}
    for view in scene.ball_view:
        click = {} if view.click_px is None else {"click_px": view.click_px}
        yield (
            "[[ball]]",
            {"name": view.name, "files": [f"{view.name}/*.dng"], "tripod": view.position_m is None, **click},
        )
    ball = scene.ball
    yield (
        "[probe]",
        {
            "kind": "mirror_ball",
            "diameter_m": ball.diameter_m,
            "reflectance": ball.reflectance,
            "reflectance_space": ACESCG,
        },
    )
    if scene.board is not None:
        yield "[board]", scene.board.model_dump(exclude_none=True)
    for marker in scene.marker:
        yield "[[marker]]", {key: getattr(marker, key) for key in ("dictionary", "id", "side_m")}
    if scene.view:
        yield "[views]", {"files": ["views/*.jpg"]}
        for name in ["plate", *[view.name for view in scene.ball_view if view.position_m is not None]]:
            yield "[[pose]]", {"view": name, "route": "colmap"}
    for box in scene.box:
        if box.stated:
            (x, z), height = box.position_m, box.size_m[1]
            measures = {"centre_m": (x, height / 2, z), "size_m": box.size_m, "yaw_deg": box.yaw_deg}
            yield "[[proxy]]", {"name": box.name, **measures}
    if scene.room is not None and scene.room.stated:
        yield "[room]", {"centre_m": scene.room.centre_m, "size_m": scene.room.size_m}
    if scene.view and not scene.calibration:
        return
    if scene.calibration:
        yield "[camera]", {"calibration": ["calibration/*.jpg"]}
    else:
        camera = scene.camera
        names = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
        model = {4: "fisheye", 8: "rational"}.get(len(camera.distortion))
        told = {"distortion_model": model} if model else {}
        yield "[camera.given]", {name: getattr(camera, name) for name in names} | told


def wish_tables(scene: SimulatedScene) -> Iterator[tuple[str, dict[str, Any]]]:
    """The tables of scene.toml."""
    for model in scene.object:
        yield (
            "[[object]]",
            {
                "name": model.name,
                "file": f"objects/{model.name}.glb",
                "position_m": model.position_m,
                "yaw_deg": model.yaw_deg,
            },
        )
    if scene.object:
        yield "[render]", {"materials": "gltf"}  # as `World.objects` has them


def write_manifests(scene: SimulatedScene, out: Path) -> None:
    """capture.toml and scene.toml."""
    head = f"# {scene.title}. Simulated: written by insitu simulate.\n"
    write_bytes(out / "capture.toml", (head + toml_text(list(capture_tables(scene)))).encode())
    write_bytes(
        out / "scene.toml",
        ("# The objects of truth/with_objects.exr.\n" + toml_text(list(wish_tables(scene)))).encode(),
    )


def shown_objects(scene: SimulatedScene, out: Path) -> list[dict[str, Any]]:
    """What truth/with_objects.exr shows: each object's file, by its digest, and its place."""
    return [
        {
            "name": model.name,
            "sha256": hashlib.sha256((out / "objects" / f"{model.name}.glb").read_bytes()).hexdigest(),
            "position_m": list(model.position_m),
            "yaw_deg": model.yaw_deg,
        }
        for model in scene.object
    ]


def other_places(scene: SimulatedScene, ball_centre: np.ndarray) -> dict[str, np.ndarray]:
    """Where else the light is told, (3,) world by name of its map: at every object and amid them, as high as the ball.

    Nowhere under a distant light, which is the same everywhere.
    """
    if scene.room is None or not scene.object:
        return {}
    each = [np.array([model.position_m[0], ball_centre[1], model.position_m[1]]) for model in scene.object]
    middle = {"environment_amid": np.mean(each, 0)} if len(each) > 1 else {}
    return middle | {f"environment_{model.name}": at for model, at in zip(scene.object, each, strict=True)}


def truth_record(
    scene: SimulatedScene, shoot: Shoot, views: dict[str, np.ndarray], ball_centre: np.ndarray, noise: dict[str, float]
) -> dict[str, Any]:
    """What truth.json says."""
    camera, sensor = scene.camera, shoot.sensor
    elsewhere = [{"file": f"{name}.exr", "at_m": at.tolist()} for name, at in other_places(scene, ball_centre).items()]
    _, hot = sensor.fixed_pattern(camera.height, camera.width)
    return {
        "unit": UNIT,
        "space": ACESCG,
        "pixel_origin": "first pixel centre at (0.5, 0.5)",
        "plate": "plate.exr",
        "with_objects": "with_objects.exr",
        "coverage": "coverage.exr",
        "albedo": "albedo.exr",
        "environment": {"file": "environment.exr", "world_from_map": np.eye(3).tolist()},
        **({"elsewhere": elsewhere} if elsewhere else {}),
        "camera": {
            **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
            "distortion": list(camera.distortion),
            "blur_sigma_px": camera.blur_sigma_px,
        },
        "views": {name: {"world_from_camera": pose.tolist()} for name, pose in views.items()},
        "ball": {
            "centre_world_m": ball_centre.tolist(),
            "radius_m": scene.ball.diameter_m / 2,
            "reflectance": list(scene.ball.reflectance),
        },
        "sensor": {
            "cfa": sensor.cfa,
            "black": list(sensor.black),
            "white": sensor.white,
            "e_per_dn": sensor.e_per_dn,
            "read_noise_e": sensor.read_noise_e,
            "prnu": sensor.prnu,
            "noise_profile": list(sensor.noise_profile()),
            "camera_from_acescg": camera_from_acescg(sensor.color_matrix).tolist(),
            "color_matrix": sensor.color_matrix.tolist(),
            "hot_pixels": [{"row": int(r), "column": int(c), "e_per_s": float(e)} for r, c, e in hot],
        },
        "objects": shown_objects(scene, shoot.out),
        "exposures": shoot.exposures,
        **({"leaves": leaves} if (leaves := scene.leave.model_dump(exclude_defaults=True)) else {}),
        "noise": noise,
    }


def write_truth(path: Path, record: dict[str, Any]) -> None:
    """truth.json; full precision."""
    write_bytes(path, (json.dumps(record, indent=1) + "\n").encode())
