"""Small simulated plates of a plane, path traced apart from the code that estimates; for the reflectance tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from pipeline.camera.lens import pixel_rays
from pipeline.conventions import latlong_directions
from pipeline.simulation.lens import look_at
from pipeline.transport.scene import environment_emitter, ground_shape, ground_texture, proxy_shape
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Plane, Proxy, Raster, View

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0)
EYE = np.array([0.1, 0.45, 0.6])
VIEW = View(
    world_from_camera=look_at(EYE, [0, 0, -0.05]), covariance=np.zeros((6, 6)), route="given", rms_px=0, points=0
)
NOISE = 0.003  # relative, on top of the path tracer's own
REPEATS = 4  # independent renders, whose spread is the variance


def ground(half: float = 1.0) -> Plane:
    corners = half * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], float)
    return Plane(normal=[0, 1, 0], offset_m=0, covariance=np.zeros((3, 3)), corners_m=corners, source="test")


def lamp_and_sky(lamp: float, towards: tuple[float, float, float], height: int = 64) -> np.ndarray:
    """A bluish sky and a warm lamp of 5.7 degrees around ``towards``."""
    d = latlong_directions(height, 2 * height)
    way = np.array(towards) / np.linalg.norm(towards)
    disc = (d @ way > 0.995)[..., None] * np.array([1.0, 0.85, 0.6]) * lamp
    return np.stack([0.8 + 0.3 * d[..., 1], 0.9 + 0.3 * d[..., 1], 1.1 + 0.3 * d[..., 0]], -1) + disc


def texture(seed: int, base: tuple[float, float, float] = (0.45, 0.35, 0.25), amount: float = 0.15) -> np.ndarray:
    """(256, 256, 3) log-normal texture with detail at three scales, its channels almost together."""
    rng = np.random.default_rng(seed)
    fields = [gaussian_filter(rng.normal(size=(256, 256)), scale, mode="wrap") for scale in (1, 4, 16)]
    total = np.sum([field / field.std() for field in fields], 0)
    return np.clip(np.array(base) * np.exp(amount / total.std() * total[..., None] * [1, 1.05, 1.15]), 0.01, 0.95)


def box(centre: tuple[float, float, float], size: tuple[float, float, float], name: str) -> Proxy:
    import trimesh

    mesh = trimesh.creation.box(extents=size)
    return Proxy(name=name, vertices_m=mesh.vertices + centre, faces=mesh.faces)


def photograph(
    albedo: np.ndarray,
    environment: np.ndarray,
    gloss: dict[str, float] | None = None,
    proxies: tuple[tuple[Proxy, tuple[float, float, float]], ...] = (),
    samples: int = 32,
    seed: int = 0,
    depth: int = 3,
) -> Raster:
    """The plate: mean of REPEATS path-traced renders and NOISE, with the variance of both."""
    rng = np.random.default_rng(seed)
    traced = tracer(albedo, environment, gloss, proxies, depth)
    row, column = np.divmod(np.arange(CAMERA.width * CAMERA.height), CAMERA.width)
    renders = []
    for repeat in range(REPEATS):
        px = np.repeat(np.stack([column, row], -1), samples, 0) + rng.uniform(size=(len(row) * samples, 2))
        way = pixel_rays(CAMERA, px) @ VIEW.world_from_camera[:3, :3].T
        radiance = traced(np.broadcast_to(EYE, way.shape), way, 1000 * seed + repeat)
        renders.append(radiance.reshape(CAMERA.height, CAMERA.width, samples, 3).mean(2))
    mean = np.mean(renders, 0)
    variance = np.var(renders, 0, ddof=1) / REPEATS + (NOISE * mean) ** 2
    noisy = mean + NOISE * mean * rng.normal(size=mean.shape)
    mask = np.zeros(mean.shape[:2], np.uint32)
    return Raster({**Raster.split(noisy), **Raster.split(variance, "variance"), "mask": mask}, "acescg")


def tracer(
    albedo: np.ndarray, environment: np.ndarray, gloss: dict[str, float] | None = None,
    proxies: tuple[tuple[Proxy, tuple[float, float, float]], ...] = (), depth: int = 3,
) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:  # fmt: skip
    """A function of starts and unit ways (N, 3) and a seed: one path's radiance (N, 3) each."""
    mi = use_mitsuba()
    bsdf: dict[str, Any] = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": ground_texture(mi, albedo)}}
    if gloss is not None:
        bsdf = {"type": "insitu_gltf", "base_color": ground_texture(mi, albedo), **gloss}
    shapes = {f"p{i}": proxy_shape(mi, proxy, np.array(color)) for i, (proxy, color) in enumerate(proxies)}
    distant, plane = environment_emitter(mi, environment), ground_shape(ground(), bsdf)
    scene = mi.load_dict({"type": "scene", "distant": distant, "ground": plane, **shapes})
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})

    def traced(start: np.ndarray, way: np.ndarray, seed: int) -> np.ndarray:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, len(way))
        vectors = [np.ascontiguousarray(part.T, np.float32) for part in (start, way)]
        ray = mi.RayDifferential3f(mi.Point3f(vectors[0]), mi.Vector3f(vectors[1]))
        return np.array(integrator.sample(scene, sampler, ray)[0]).T

    return traced
