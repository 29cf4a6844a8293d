"""Small consistent artifacts of every stage from closed forms: a grey plane under a smooth sky, a ball, an object."""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np

from pipeline.conventions import invert_rigid, latlong_directions, transform_points
from pipeline.light import ball_shadow, prediction
from pipeline.light.harmonics import COSINE_LOBE, sh9_of_environment
from pipeline.probes import shadow_flux
from pipeline.run import formats
from pipeline.simulation.lens import look_at
from pipeline.types import BallFit, Camera, Harmonics, Plane, Raster, View

WIDTH, HEIGHT, FOCAL = 192, 128, 200.0
RADIUS, ALBEDO = 0.04, 0.5
CENTRE = np.array([0.1, RADIUS, 0.08])
NORMAL = np.array([0.0, 1.0, 0.0])


def sky(height: int = 64) -> np.ndarray:
    """Brighter overhead and to +x; smooth, so that sampling it is exact to 1e-3."""
    x, y, z = np.moveaxis(latlong_directions(height, 2 * height), -1, 0)
    return np.stack([1 + 0.4 * y + 0.3 * x, 1 + 0.4 * y, 1 + 0.5 * y + 0.2 * z], -1)


def artifacts() -> dict[str, Any]:
    """All of them. They are shared by all tests, and only the facts may be added to."""
    found = _artifacts()
    return {**found, "facts": dict(found["facts"])}


@functools.cache
def _artifacts() -> dict[str, Any]:
    camera = Camera(width=WIDTH, height=HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2 - 3, cy=HEIGHT / 2 + 2)
    poses = {
        "plate": look_at([0.1, 0.35, 0.5], [0.1, 0.0, 0.05]),
        "ball_b": look_at([0.55, 0.3, 0.1], [0.1, 0.02, 0.08]),
    }
    poses["ball_a"] = poses["plate"]
    still = {"covariance": np.zeros((6, 6)), "route": "charuco", "rms_px": 0.1, "points": 24}
    views = {name: View(world_from_camera=pose, **still) for name, pose in poses.items()}
    balls = {}
    for name in ("ball_a", "ball_b"):
        local = transform_points(invert_rigid(poses[name]), CENTRE)
        radius_px = FOCAL * RADIUS / local[2]
        balls[name] = BallFit(
            centre_camera_m=local,
            radius_m=RADIUS,
            covariance=np.eye(3) * 1e-10,
            rms_px=0.1,
            points=99,
            radius_px=radius_px,
        )
    corners = np.array([[-0.6, 0, -0.6], [-0.6, 0, 0.9], [0.9, 0, 0.9], [0.9, 0, -0.6]])
    plane = Plane(normal=NORMAL, offset_m=0, covariance=np.zeros((3, 3)), corners_m=corners, source="board")
    light = sky()
    found: dict[str, Any] = {"camera": camera, "views": views, "balls": balls, "plane": plane}
    found["environment"] = acescg(light, seen=np.ones(light.shape[:2]), layers={"variance": 0 * light})
    found["harmonics"] = Harmonics(
        coefficients=sh9_of_environment(light), sigma=np.zeros((9, 3)), irradiance_factors=COSINE_LOBE
    )
    found["albedo"] = acescg(np.full((32, 32, 3), ALBEDO), seen=np.ones((32, 32)))
    photographs = {"plate": acescg(np.full((HEIGHT, WIDTH, 3), 0.2), mask=np.zeros((HEIGHT, WIDTH)))}
    for name, ball in balls.items():
        photographs[name] = acescg(
            ball_photograph(camera, views[name], ball, light, name == "ball_a"), mask=np.zeros((HEIGHT, WIDTH))
        )
    found["photographs"] = {
        name: Raster({**raster.channels, **Raster.split(np.full((HEIGHT, WIDTH, 3), 1e-6), "variance")}, "acescg")
        for name, raster in photographs.items()
    }
    board = {"squares": [7, 5], "square_m": 0.03, "marker_m": 0.022, "margin_m": 0.01, "legacy": False}
    found["facts"] = {
        "name": "staged", "probe": {"diameter_m": 2 * RADIUS, "reflectance": [1, 1, 1], "reflectance_space": "acescg"},
        "board": board, "truth_path": None,
    }  # fmt: skip
    found["wishes"] = {"object": [{"name": "cube", "file": "cube.glb", "position_m": [0.1, 0.05]}], "quality": "draft"}
    found |= picture_with_object(photographs["plate"].rgb())
    found["balance"] = {}
    found["records"] = {"merge": {"seconds": 1.5}, "render": {"seconds": 2.5}}
    return found


def acescg(rgb, layers=None, **more) -> Raster:
    channels = Raster.split(np.asarray(rgb, np.float32))
    for name, values in (layers or {}).items():
        channels |= Raster.split(np.asarray(values, np.float32), name)
    for name, values in more.items():
        channels[name] = np.asarray(values, np.uint32 if name in ("mask", "guards") else np.float32)
    return Raster(channels, "acescg")


def ball_photograph(camera, view, ball, light, with_shadow) -> np.ndarray:
    """The plate, darkened by the ball's shadow (its model has its own test, in test_clipped), and the ball in front."""
    whole = slice(0, HEIGHT), slice(0, WIDTH)
    plane = Plane(normal=NORMAL, offset_m=0, covariance=np.zeros((3, 3)), corners_m=np.zeros((4, 3)), source="board")
    px = prediction.pixel_centres(*whole).reshape(-1, 2)
    hits = prediction.plane_hits(plane, camera, view.world_from_camera, px)
    picture = np.full((HEIGHT * WIDTH, 3), 0.2)
    near = np.isfinite(hits[:, 0]) & (np.linalg.norm(hits - CENTRE, axis=-1) < 5.5 * RADIUS)
    near &= np.linalg.norm(hits - CENTRE, axis=-1) > RADIUS * 1.001
    if with_shadow:
        rest, mirror = shadow_flux.setting(light, 0 * light, []), ball_shadow.Ball(CENTRE, RADIUS, np.ones(3))
        picture[near] *= shadow_flux.shadow_of(rest, hits[near], mirror)
    picture = picture.reshape(HEIGHT, WIDTH, 3)
    directions, sine = prediction.ball_directions(camera, ball, view.world_from_camera, *whole)
    mirrored = prediction.mirrored_picture(light, directions, np.ones(3))
    return np.where(np.isfinite(sine)[..., None], mirrored, picture)


def picture_with_object(plate) -> dict[str, Any]:
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    alpha = np.clip(16 - np.hypot(x - 60, y - 60), 0, 1)[..., None]
    distance = np.hypot((x - 82) / 1.5, y - 72)
    with_object = 0.2 * (1 - 0.5 * np.exp(-((distance / 14) ** 2)))[..., None] * np.ones(3)
    influence = (distance < 34) | (alpha[..., 0] > 0)
    with_object = np.where(influence[..., None], with_object, 0.2)
    obj = alpha * np.array([0.5, 0.1, 0.05])
    composite = np.where(influence[..., None], (1 - alpha) * with_object + obj, plate)
    layers = {"with": with_object, "without": np.full((HEIGHT, WIDTH, 3), 0.2), "obj": obj}
    rgba = acescg(np.zeros((HEIGHT, WIDTH, 3)), layers, influence=influence)
    rendered = {k: v for k, v in rgba.channels.items() if k not in "RGB"} | {"obj.A": alpha[..., 0].astype(np.float32)}
    mul = np.where(influence[..., None], with_object / 0.2 * (1 - alpha), 1)
    stack = {"mul": mul, "add": np.zeros_like(mul), "obj": obj}
    composed = acescg(composite, stack, guards=np.zeros((HEIGHT, WIDTH)))
    return {
        "layers": Raster(rendered, "acescg"),
        "composite": Raster({**composed.channels, "obj.A": rendered["obj.A"]}, "acescg"),
    }


def write_truth(folder, staged, scale: float = 2.0, gain: float = 1.0) -> str:
    """A truth.json that says the staged composite is right, in a unit ``scale`` times smaller; ``gain`` on objects."""
    plate, composite = staged["photographs"]["plate"].rgb(), staged["composite"].rgb()
    alpha = staged["layers"]["obj.A"]
    seen = np.concatenate([np.full(plate.shape, ALBEDO), np.ones((*alpha.shape, 1))], -1)
    pictures = {
        "plate": acescg(plate / scale),
        "objects": acescg(np.where(alpha[..., None] > 0, gain, 1) * composite / scale),
        "coverage": Raster({"cube": alpha}, "data"),
        "albedo": acescg(seen[..., :3], seen=seen[..., 3]),
        "light": acescg(sky() / scale),
    }
    for name, raster in pictures.items():
        formats.write_exr(folder / f"{name}.exr", raster)
    camera = staged["camera"]
    facts = {
        "space": "acescg", "plate": "plate.exr", "with_objects": "objects.exr", "coverage": "coverage.exr",
        "albedo": "albedo.exr", "environment": {"file": "light.exr", "world_from_map": np.eye(3).tolist()},
        "camera": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "distortion": [0] * 5},
        "views": {n: {"world_from_camera": v.world_from_camera.tolist()} for n, v in staged["views"].items()},
    }  # fmt: skip
    (folder / "truth.json").write_text(json.dumps(facts))
    return str(folder / "truth.json")
