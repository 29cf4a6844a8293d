"""What the objects are and what they change: object layer, lost and gained light, where it matters.

A pilot on cells of eight pixels says what changes by more than ``threshold`` of LS_noobj, and where that change is
smooth enough to be interpolated; only the rest is traced pixel by pixel. ``strategy = "difference"`` estimates the
change itself; ``"reference"`` traces two full images with the same random numbers, every pixel. Pixels that objects
cover get more samples. Limits: one plane as local scene, distant light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.lens import ray_grid
from pipeline.conventions import ACESCG
from pipeline.image.colour import Space
from pipeline.light.environment import irradiance
from pipeline.light.sampling import bilinear, planes
from pipeline.run import artifacts as A
from pipeline.run.errors import ManifestError
from pipeline.run.progress import report
from pipeline.run.stage import Stage
from pipeline.transport.denoise import bounding_window, denoise
from pipeline.transport.difference import difference_block
from pipeline.transport.meshes import Material, load_meshes
from pipeline.transport.region import CELL, Region, cell_pixels, plan
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import material_bsdf, mesh_shape
from pipeline.transport.trace import Rays, Samples, Strategy, reference_block, trace
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Plane, Raster, Result, View
from stages import knobs

STRATEGIES: dict[str, Strategy] = {"difference": difference_block, "reference": reference_block}
LOOKUP_ROW = 1024  # the lookup takes pictures, whose sides are limited, not long lists
PILOT_SHARE = 4  # samples of a cell over samples of a pixel: a cell stands for 64 pixels
OBJECT_BOOST = 4  # more samples where an object is seen


def world_from_object(wish: dict[str, Any], plane: Plane) -> np.ndarray:
    """(4, 4) from the object file's frame (+Y up) to the world: scale, yaw about +Y, then its place on the plane."""
    yaw = np.radians(wish["yaw_deg"])
    x, z = wish["position_m"]
    rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    height = (plane.offset_m - plane.normal[0] * x - plane.normal[2] * z) / plane.normal[1]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * wish["scale"]
    matrix[:3, 3] = [x, height + wish["lift_m"], z]
    return matrix


def place_objects(wishes: dict[str, Any], plane: Plane) -> tuple[dict[str, Any], list[str]]:
    """Mitsuba shapes of every wished object, and warnings."""
    mi = use_mitsuba()
    shapes, warnings = {}, []
    for wish in wishes["object"]:
        meshes, notes = load_meshes(Path(wish["path"]))
        warnings += notes
        for index, mesh in enumerate(meshes):
            material: Material = mesh.material
            space: Space = "linear_rec709"
            if wish["material"]:
                given = dict(wish["material"])
                space = given.pop("space")
                material = Material(**given)
            name = f"{wish['name']}_{index}"
            bsdf = material_bsdf(mi, material, space)
            shapes[name] = mesh_shape(mi, name, mesh, world_from_object(wish, plane), bsdf)
    return shapes, warnings


def tell(what: str) -> Callable[[float], None]:
    """A progress callback that names its task."""
    return lambda share: report(what, share)


def find_region(worlds: Worlds, rays: Rays, shape: tuple[int, int], light: np.ndarray, params: knobs.Render) -> Region:
    """What to leave, interpolate and trace; the reference strategy interpolates nothing."""
    index, grid = cell_pixels(*shape)
    samples = max(64, PILOT_SHARE * params.samples)
    pilot = trace(
        difference_block, worlds, rays[index], samples, params.depth, params.seed + 1, CELL, tell("render: pilot")
    )
    region = plan(pilot, grid, shape, light, params.threshold)
    return replace(region, traced=region.weight > 0) if params.strategy == "reference" else region


def plane_albedo(plane: Plane, albedo: Raster, rays: Rays) -> np.ndarray:
    """(N, 3) albedo where the middle of each pixel meets the modelled rectangle; rays must meet it."""
    along_u, along_v = plane.corners_m[1] - plane.corners_m[0], plane.corners_m[3] - plane.corners_m[0]
    reach = (plane.offset_m - plane.normal @ rays.origin) / (rays.centre @ plane.normal)
    offset = rays.origin + reach[:, None] * rays.centre - plane.corners_m[0]
    height, width = albedo.shape
    position = np.stack(
        [offset @ along_u / (along_u @ along_u) * width, offset @ along_v / (along_v @ along_v) * height]
    )
    folded = np.pad(position, ((0, 0), (0, -len(rays) % LOOKUP_ROW))).reshape(2, -1, LOOKUP_ROW)
    return bilinear(planes(albedo.rgb()), *folded).reshape(-1, 3)[: len(rays)].astype(float)


def interpolated(region: Region, pixels: np.ndarray, albedo: np.ndarray, light: np.ndarray) -> Samples:
    """The smooth part of the change as if it had been traced: relative change times LS_noobj of each pixel."""
    model = albedo * light / np.pi
    nothing, whole = np.zeros(len(pixels)), np.ones(len(pixels))

    def at(field: np.ndarray) -> np.ndarray:
        return field.reshape(-1, 3)[pixels]

    return Samples(
        obj=np.zeros_like(model),
        alpha=nothing,
        lost=at(region.lost) * model,
        gained=at(region.gained) * model,
        without=model,
        albedo=albedo,
        obj_albedo=np.zeros_like(model),
        obj_normal=np.zeros_like(model),
        ground=whole,
        obj_variance=np.zeros_like(model),
        change_variance=at(region.variance) * model**2,
    )


def trace_region(worlds: Worlds, rays: Rays, params: knobs.Render) -> Samples:
    """The pixels of the region, then those that show an object again with more samples, merged by sample count."""
    strategy = STRATEGIES[params.strategy]
    first = trace(
        strategy, worlds, rays, params.samples, params.depth, params.seed + 2, progress=tell("render: shadows")
    )
    shown = np.flatnonzero(first.alpha > 0)
    if not len(shown):
        return first
    again = trace(
        strategy,
        worlds,
        rays[shown],
        params.samples * OBJECT_BOOST,
        params.depth,
        params.seed + 3,
        progress=tell("render: objects"),
    )
    return first.merged(shown, again, OBJECT_BOOST / (1 + OBJECT_BOOST))


def compute(
    wishes: dict[str, Any],
    camera: Camera,
    views: dict[str, View],
    environment: Raster,
    plane: Plane,
    albedo: Raster,
    params: knobs.Render,
) -> Result:
    """Layers of the size of the plate, ACEScg. Raises ManifestError when an object file cannot be used."""
    shape = (camera.height, camera.width)
    if not wishes["object"]:
        return Result(
            {"layers": empty_layers(shape)},
            {"influenced_fraction": 0.0},
            ["scene.toml: no objects; the plate comes back"],
        )
    mi = use_mitsuba()
    shapes, warnings = place_objects(wishes, plane)
    radiance = environment.rgb()
    worlds = build_worlds(plane, albedo.rgb(), radiance, shapes)
    light = irradiance(radiance, plane.normal[None])[0]
    xn, dxn = ray_grid(camera)
    rays = Rays.of(views["plate"].world_from_camera, xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    region = find_region(worlds, rays, shape, light, params)
    traced, smooth = np.flatnonzero(region.traced), np.flatnonzero(region.interpolated)
    if not len(traced) + len(smooth):
        raise ManifestError("scene.toml: no object and no shadow falls into the frame; check position_m and scale")
    parts = [interpolated(region, smooth, plane_albedo(plane, albedo, rays[smooth]), light)]
    if len(traced):
        parts.append(trace_region(worlds, rays[traced], params))
    pixels = np.concatenate([smooth, traced])
    samples = Samples.joined(parts)
    images = to_images(samples, pixels, shape, light)
    numbers = measure(samples, region.weight, light, params)
    if params.denoise:
        images, moved = quieted(images, region.traced)
        numbers |= moved
    layers = to_layers(images, region.weight)
    numbers["traced_fraction"] = float(region.traced.mean())
    numbers["variant"] = mi.variant()
    if samples.not_finite:
        warnings.append(f"render: {samples.not_finite} samples were not finite and count as zero")
    return Result({"layers": layers}, numbers, warnings, evidence(params, numbers))


def empty_layers(shape: tuple[int, int]) -> Raster:
    """Layers that change nothing."""
    names = [
        f"{layer}.{c}"
        for layer in ("obj", "with", "without", "lost", "gained", "variance", "objvariance")
        for c in "RGB"
    ]
    return Raster({name: np.zeros(shape, np.float32) for name in [*names, "obj.A", "ground", "influence"]}, ACESCG)


def to_images(samples: Samples, pixels: np.ndarray, shape: tuple[int, int], light: np.ndarray) -> dict[str, np.ndarray]:
    """Every field of the samples as a picture (H, W, ...), zero where nothing was computed; LS_noobj in closed form."""
    images = {}
    for name, values in vars(samples).items():
        if name != "not_finite":
            image = np.zeros((shape[0] * shape[1], *values.shape[1:]))
            image[pixels] = values
            images[name] = image.reshape(*shape, *values.shape[1:])
    images["without"] = images["albedo"] * light / np.pi  # equation 7
    return images


def quieted(images: dict[str, np.ndarray], traced: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Lost and gained light and the object layer, denoised; the pictures, and how much light was in speckles."""
    from scipy.ndimage import distance_transform_edt

    window = bounding_window(traced)
    view = {name: image[window] for name, image in images.items()}
    model, shown = view["without"], view["alpha"][..., None]
    bare = (model > 0).all(-1)
    # Below an object the ground's values continue, so that its outline is no edge of theirs.
    nearest = distance_transform_edt(~bare, return_distances=False, return_indices=True) if bare.any() else None

    def relative(part: np.ndarray) -> np.ndarray:
        ratio = np.divide(part, model, out=np.zeros_like(part), where=model > 0)
        return ratio if nearest is None else ratio[tuple(nearest)]

    guide = np.repeat(view["ground"][..., None], 3, -1)
    survives, _ = denoise(np.maximum(1 + relative(view["lost"]), 0), guide)
    added, moved = denoise(relative(view["gained"]), guide)
    obj, moved_obj = denoise(view["obj"], view["obj_albedo"], view["obj_normal"])
    result = {name: image.copy() for name, image in images.items() if name in ("lost", "gained", "obj")}
    here = traced[window][..., None]
    result["lost"][window] = np.where(here, np.minimum(survives - 1, 0) * model, view["lost"])
    result["gained"][window] = np.where(here, added * model, view["gained"])
    result["obj"][window] = np.where(shown > 0, obj, view["obj"])
    return images | result, {"speckle_light_moved_change": moved, "speckle_light_moved_object": moved_obj}


def to_layers(images: dict[str, np.ndarray], weight: np.ndarray) -> Raster:
    """Channels of the size of the plate; the feather scales the change."""
    fade = weight[..., None]
    lost, gained = images["lost"] * fade, images["gained"] * fade
    layers = {
        "obj": images["obj"],
        "with": images["without"] + lost + gained,
        "without": images["without"],
        "lost": lost,
        "gained": gained,
        "variance": images["change_variance"] * fade**2,
        "objvariance": images["obj_variance"],
    }
    channels = {name: values for layer, rgb in layers.items() for name, values in Raster.split(rgb, layer).items()}
    channels |= {"obj.A": images["alpha"], "ground": images["ground"], "influence": weight}
    return Raster(channels, ACESCG)


def measure(samples: Samples, weight: np.ndarray, light: np.ndarray, params: knobs.Render) -> dict[str, Any]:
    """What was traced, how noisy it is before denoising, and how well the closed form agrees with LS_noobj."""
    model = samples.albedo * light / np.pi
    bare = (samples.ground > 0.999) & (model > 0).all(1)
    covered = samples.alpha > 0.99
    numbers: dict[str, Any] = {
        "influenced_fraction": float((weight > 0).mean()),
        "object_fraction": float((samples.alpha > 0).sum() / weight.size),
        "not_finite_samples": samples.not_finite,
    }
    if bare.any():
        level, noise = np.linalg.norm(model[bare], axis=1), np.sqrt(samples.change_variance[bare].sum(1))
        numbers["change_noise_rel"] = float(np.median(noise / level))
        numbers["deepest_shadow"] = float(
            np.quantile((samples.lost + samples.gained)[bare].sum(1) / model[bare].sum(1), 0.001)
        )
        if params.strategy == "reference":
            numbers["noobj_over_closed_form"] = float(samples.without[bare].sum() / model[bare].sum())
    if covered.any():
        level, noise = np.linalg.norm(samples.obj[covered], axis=1), np.sqrt(samples.obj_variance[covered].sum(1))
        numbers["object_noise_rel"] = float(np.median(noise / level))
    return numbers


def evidence(params: knobs.Render, numbers: dict[str, Any]) -> list[dict[str, Any]]:
    """What was modelled of the transport, and why."""
    return [
        {
            "term": "region",
            "modelled": f"{numbers['influenced_fraction']:.1%} of the frame",
            "because": f"a pilot found the rest to change by less than {params.threshold:.2%}",
            "could_cost": f"at most {params.threshold:.2%} of the plate outside the region",
        },
        {
            "term": "every pixel of the region",
            "modelled": f"{numbers['traced_fraction']:.1%} of the frame traced, the rest of the region interpolated",
            "because": "second differences of the pilot bound the error of interpolation",
            "could_cost": f"{params.threshold / 2:.2%} of the plate, and the pilot's noise",
        },
        {
            "term": "denoiser",
            "modelled": params.denoise,
            "because": f"knob render.denoise; {params.samples} samples leave noise",
            "could_cost": "fine detail of reflections; sharpness of caustics",
        },
        {
            "term": "path depth",
            "modelled": params.depth,
            "because": "knob render.depth",
            "could_cost": "light of more bounces",
        },
        {
            "term": "near field of the probe",
            "modelled": False,
            "because": "the map is used as distant light",
            "could_cost": "wrong light direction for lamps nearer than a few metres",
        },
    ]


STAGE = Stage(
    "render",
    compute,
    knobs.Render,
    inputs={
        "wishes": A.WISHES,
        "camera": A.CAMERA,
        "views": A.VIEWS,
        "environment": A.ENVIRONMENT,
        "plane": A.PLANE,
        "albedo": A.ALBEDO,
    },
    outputs={"layers": A.LAYERS},
)
