"""What is compared: two independent renders, and insitu's own way, each from a scene to a composite.

All take the composite's plate to be LS_noobj of the reference, so that the whole error is the render's. Pictures are
scene-linear ACEScg, (N, 3), N pixels in rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.scenes import Item, Scene
from pipeline.camera.lens import ray_grid
from pipeline.light.environment import irradiance
from pipeline.transport.difference import difference_block
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import color_texture, mesh_shape
from pipeline.transport.trace import NEVER, RAYS_PER_BLOCK, Rays, Samples, camera_rays, make_sampler, trace
from pipeline.transport.variant import use_mitsuba


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene as the renderers want it, loaded once."""

    scene: Scene
    worlds: Worlds
    rays: Rays


def surface(mi: Any, item: Item) -> dict[str, Any]:
    """The material as one of Mitsuba's own, which other renderers have too."""
    if item.kind == "diffuse":
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color_texture(mi, np.array(item.color))}}
    if item.kind == "glossy":
        return {"type": "roughconductor", "distribution": "ggx", "alpha": item.alpha, "material": "none"}
    if item.kind == "mirror":
        return {"type": "conductor", "material": "none"}
    return {"type": "dielectric", "int_ior": item.ior, "ext_ior": 1.0}


def load(scene: Scene) -> Stage:
    """Build the worlds of a scene and the rays of its camera."""
    mi = use_mitsuba()
    shapes = {
        item.name: mesh_shape(
            mi, item.name, Mesh(item.vertices, item.faces, item.normals, None, Material()), np.eye(4), surface(mi, item)
        )
        for item in scene.items
    }
    worlds = build_worlds(scene.plane, scene.albedo, scene.environment, shapes)
    xn, dxn = ray_grid(scene.camera)
    rays = Rays.of(scene.world_from_camera, xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    return Stage(scene, worlds, rays)


def composite(plate: np.ndarray, samples: Samples) -> np.ndarray:
    """Equation 4 with coverage: the plate where no object is, plus the change, plus the object layer."""
    return plate * (1 - samples.alpha)[:, None] + samples.obj + samples.lost + samples.gained


def ours(stage: Stage, plate: np.ndarray, samples: int, depth: int, seed: int) -> np.ndarray:
    """The difference strategy on every pixel: no region, no denoiser, no bias."""
    return composite(plate, trace(difference_block, stage.worlds, stage.rays, samples, depth, seed))


def naive(stage: Stage, plate: np.ndarray, samples: int, depth: int, seed: int) -> np.ndarray:
    """Two path-traced renders with random numbers of their own: ``plate + LS_obj - LS_noobj`` beside the objects."""
    parts = []
    pixels = max(1, RAYS_PER_BLOCK // samples)
    for start in range(0, len(stage.rays), pixels):
        rays = stage.rays[start : start + pixels]
        with_objects, alpha = render(stage, stage.worlds.with_objects, rays, samples, depth, 2 * (seed + 7919 * start))
        without, _ = render(stage, stage.worlds.without_objects, rays, samples, depth, 2 * (seed + 7919 * start) + 1)
        bare = (1 - alpha)[:, None]
        parts.append(with_objects + bare * (plate[start : start + pixels] - without))
    return np.concatenate(parts)


def render(stage: Stage, scene: Any, rays: Rays, samples: int, depth: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean radiance (N, 3) and coverage by objects (N,) of one path-traced image."""
    import drjit as dr

    mi = stage.worlds.mi
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NEVER, "hide_emitters": True})
    sampler = make_sampler(mi, samples)
    count = sampler.sample_count()
    sampler.set_samples_per_wavefront(count)
    sampler.seed(seed % 2**32, len(rays) * count)
    ray = camera_rays(mi, dr, rays, count, sampler.next_2d(), 1.0)
    radiance = integrator.sample(scene, sampler, ray)[0]
    planes = [mi.Float(radiance[i]) for i in range(3)]
    if scene is stage.worlds.with_objects:
        first = scene.ray_intersect_preliminary(ray, coherent=True)
        local = mi.Bool(False)
        for shape in stage.worlds.local_with:
            local |= first.shape == mi.ShapePtr(shape)
        planes.append(dr.select(first.is_valid() & ~local, mi.Float(1.0), mi.Float(0.0)))
    dr.eval(planes)
    means = np.stack([np.asarray(dr.block_sum(plane, count)) for plane in planes]).astype(np.float64) / count
    return means[:3].T, means[3] if len(means) > 3 else np.zeros(len(rays))


def closed_form(stage: Stage, depth: int) -> np.ndarray:
    """LS_noobj (N, 3) of a plane alone: albedo times irradiance over pi, the albedo averaged over each pixel."""
    import drjit as dr

    light = irradiance(stage.scene.environment, stage.scene.plane.normal[None])[0]
    mi = stage.worlds.mi
    count, parts = 64, []
    for start in range(0, len(stage.rays), RAYS_PER_BLOCK // count):
        rays = stage.rays[start : start + RAYS_PER_BLOCK // count]
        sampler = make_sampler(mi, count)
        sampler.set_samples_per_wavefront(count)
        sampler.seed(start, len(rays) * count)
        hit = stage.worlds.without_objects.ray_intersect(camera_rays(mi, dr, rays, count, sampler.next_2d(), 1.0))
        albedo = dr.select(hit.is_valid(), hit.bsdf().eval_diffuse_reflectance(hit), mi.Color3f(0.0))
        planes = [mi.Float(albedo[i]) for i in range(3)]
        dr.eval(planes)
        parts.append(np.stack([np.asarray(dr.block_sum(plane, count)) for plane in planes], -1) / count)
    return np.concatenate(parts) * light / np.pi
