"""What is compared: two independent renders, and insitu's own way, each from a scene to a composite.

All take the composite's plate to be LS_noobj of the reference, so that the whole error is the render's. Pictures are
scene-linear ACEScg, (N, 3), N pixels in rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.measures import cpu_seconds
from benchmarks.scenes import Item, Scene, Shape, ray_grid
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.image.display import display_exposure
from pipeline.light.environment import irradiance
from pipeline.transport.caustics import Film, photons_for, thrown
from pipeline.transport.denoise import denoise
from pipeline.transport.difference import difference_block
from pipeline.transport.estimate import Shot, prepare, sampled
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.pilot import Effort
from pipeline.transport.region import limits_for
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import color_texture, mesh_shape
from pipeline.transport.trace import (
    NEVER,
    RAYS_PER_BLOCK,
    Rays,
    Samples,
    camera_rays,
    make_sampler,
    trace,
    unchanged_block,
)
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Emitter, Proxy, Raster
from stages import composite
from stages.knobs import Render
from stages.render import film_of, to_layers

LOOK = 8  # samples of the first look of a reference
QUIET = 0.004  # relative noise of that look below which a pixel gets the smaller count
PHOTON_SAMPLES = 1024  # of a reference with glass and mirrors, as `thrown` counts them
REFERENCE_DEPTH = 12
PLATE_NOISE = 0.01  # of the radiance: what region and passes take the photograph's noise to be


@dataclass(frozen=True, eq=False)
class Loaded:
    """A scene as the renderers want it, loaded once."""

    scene: Scene
    worlds: Worlds
    film: Film
    rays: Rays  # of every pixel, or of some
    pixels: np.ndarray  # their flat index

    def at(self, index: np.ndarray) -> Loaded:
        """The same for some of the pixels."""
        return replace(self, rays=self.rays[index], pixels=self.pixels[index])


def surface(mi: Any, item: Item) -> dict[str, Any]:
    """The material as one of Mitsuba's own, which other renderers have too."""
    if item.kind == "diffuse":
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color_texture(mi, np.array(item.color))}}
    if item.kind == "glossy":
        return {"type": "roughconductor", "distribution": "ggx", "alpha": item.alpha, "material": "none"}
    if item.kind == "mirror":
        return {"type": "conductor", "material": "none"}
    return {"type": "dielectric", "int_ior": item.ior, "ext_ior": 1.0}


def mesh_of(shape: Shape) -> Mesh:
    """As the loaders of object files give it; its material is not used."""
    return Mesh(shape.vertices, shape.faces, shape.normals, None, Material())


def load(scene: Scene) -> Loaded:
    """Build the worlds of a scene and the rays of its camera."""
    mi = use_mitsuba()
    shapes = {
        item.name: mesh_shape(mi, item.name, mesh_of(item.shape), np.eye(4), surface(mi, item)) for item in scene.items
    }
    proxies = [
        Proxy(name=wall.name, vertices_m=wall.vertices, faces=wall.faces, albedo=wall.albedo) for wall in scene.walls
    ]
    worlds = build_worlds(scene.plane, scene.albedo, scene.environment, shapes, proxies, [sun_of(scene)])
    xn, dxn = ray_grid(scene.camera)
    rays = Rays.of(scene.world_from_camera, xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    film = film_of(scene.camera, scene.world_from_camera, rays)
    return Loaded(scene, worlds, film, rays, np.arange(len(rays)))


def sun_of(scene: Scene) -> Emitter:
    """The sun's texels as the compact light that the stage `lights` would make of them."""
    height, width = scene.environment.shape[:2]
    solid_angle = latlong_solid_angles(height, width).ravel()[scene.sun]
    radiance = scene.environment.reshape(-1, 3)[scene.sun]
    direction = (latlong_directions(height, width).reshape(-1, 3)[scene.sun] * solid_angle[:, None]).sum(0)
    direction /= np.linalg.norm(direction)
    total = float(solid_angle.sum())
    return Emitter(
        name="sun",
        direction=direction,
        solid_angle_sr=total,
        half_angle_rad=float(np.arccos(1 - total / (2 * np.pi))),
        irradiance=solid_angle @ radiance,
        texels=scene.sun,
    )


def additive(plate: np.ndarray, samples: Samples) -> np.ndarray:
    """Equation 4 with coverage: the plate where no object is, plus the change, plus the object layer."""
    return plate * (1 - samples.alpha)[:, None] + samples.obj + samples.lost + samples.gained


def ours(stage: Loaded, plate: np.ndarray, samples: int, depth: int, seed: int) -> np.ndarray:
    """The difference strategy on every pixel: no region, no denoiser, no bias."""
    return additive(plate, trace(difference_block, stage.worlds, stage.rays, samples, depth, seed))


def reference(stage: Loaded, plate: np.ndarray, samples: tuple[int, int], seed: int) -> np.ndarray:
    """The truth with little noise: `ours`, deeper, with more samples where a first look finds noise.

    In scenes of glass and mirrors no pixel counts as quiet, and the sun is traced from its own side too: where a lens
    gathers it, one path in thousands from the camera carries all the light, and an error in display values would miss
    what the reference misses. The look is thrown away: choosing by the samples that are kept would bias them.
    """
    specular = any(item.kind in ("glass", "mirror") for item in stage.scene.items)
    look = trace(difference_block, stage.worlds, stage.rays, LOOK, REFERENCE_DEPTH, seed)
    level = np.maximum(additive(plate, look), 1e-9)
    noisy = (np.sqrt(look.obj_variance + look.change_variance) > QUIET * level).any(1) | specular
    worlds, picture = stage.worlds, np.zeros_like(plate)
    if specular:
        pixels = stage.film.shape[0] * stage.film.shape[1]
        worlds = replace(worlds, photons=photons_for(worlds, pixels))
        light = thrown(worlds, stage.film, PHOTON_SAMPLES, seed + 2, lambda pixel: pixel, pixels)
        picture += light.sum(0)[stage.pixels]
    for count, index in zip(samples, (np.flatnonzero(~noisy), np.flatnonzero(noisy)), strict=True):
        if len(index):
            part = trace(difference_block, worlds, stage.rays[index], count, REFERENCE_DEPTH, seed + 1)
            picture[index] += additive(plate[index], part)
    return picture


def naive(stage: Loaded, plate: np.ndarray, samples: int, depth: int, seed: int) -> np.ndarray:
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


def render(stage: Loaded, scene: Any, rays: Rays, samples: int, depth: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
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


def plate_of(stage: Loaded, depth: int, samples: int) -> np.ndarray:
    """LS_noobj (N, 3), which every composite takes for the photograph: closed form, or a long render, denoised.

    What noise is left in it is the same for all: a photograph has some too.
    """
    if stage.worlds.convex:
        return closed_form(stage)
    shape = (stage.scene.camera.height, stage.scene.camera.width, 3)
    empty = load(replace(stage.scene, items=[]))
    long = trace(unchanged_block, empty.worlds, empty.rays, samples, depth, 0)
    return denoise(long.without.reshape(shape), long.albedo.reshape(shape))[0].reshape(-1, 3).astype(float)


def closed_form(stage: Loaded) -> np.ndarray:
    """LS_noobj (N, 3) of a plane alone: albedo times irradiance over pi, the albedo averaged over each pixel."""
    import drjit as dr

    light = irradiance(stage.scene.environment, stage.scene.plane.normal[None])[0]
    mi = stage.worlds.mi
    count, parts = 16, []
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


@dataclass(frozen=True, eq=False)
class Made:
    """A composite of insitu's own path after some passes, denoised or not, and the CPU seconds until it stood there."""

    picture: np.ndarray
    cpu_s: float
    samples: int
    denoised: bool


def insitu(stage: Loaded, plate: np.ndarray, knobs: Render, seed: int, every: bool) -> Iterator[Made]:
    """Region, passes, denoiser and the default composite, as the render stage makes them, from a loaded scene.

    After the first pass and the last, or after ``every`` pass; the last also without denoiser. Composing is paid for
    once: a picture's seconds are those of the passes so far and of its own composite.
    """
    height, width = stage.scene.camera.height, stage.scene.camera.width
    picture = plate.reshape(height, width, 3)
    variance = (PLATE_NOISE * picture) ** 2
    channels = {
        name: values.astype(np.float32)
        for name, values in (Raster.split(picture) | Raster.split(variance, "variance")).items()
    }
    photograph = Raster(channels | {"mask": np.zeros((height, width), np.uint32)}, "acescg")
    effort = Effort(samples=knobs.samples, depth=knobs.depth, denoise=True, seed=seed)

    def composed(shot: Shot, quiet: bool, spent: float) -> Made:
        with cpu_seconds() as timer:
            canvas = replace(shot.canvas, effort=replace(effort, denoise=quiet))
            layers = to_layers(Shot(canvas, shot.halves).drawn[0], canvas)
            result = composite.compose(photograph, layers, "auto")[0]
        samples = int(shot.halves.both.count.max())
        return Made(result.reshape(-1, 3), spent + timer.seconds, samples, quiet)

    with cpu_seconds() as begun:
        light = irradiance(stage.scene.environment, stage.scene.plane.normal[None])[0]
        sigma = np.sqrt(variance.mean(-1))
        limits = limits_for(picture, variance, knobs.threshold)
        white = 2.0 ** -display_exposure(picture)
        canvas, _ = prepare(stage.worlds, stage.rays, (height, width), light, sigma, white, limits, effort, stage.film)
        passes = sampled(canvas)
    spent, number, latest = begun.seconds, 0, None
    while True:
        with cpu_seconds() as timer:
            shot = next(passes, None)
        spent += timer.seconds
        if shot is None:
            break
        number, latest = number + 1, shot
        if number == 1 or every:
            yield composed(shot, True, spent)
    if latest is not None:
        if number > 1 and not every:
            yield composed(latest, True, spent)
        yield composed(latest, False, spent)
