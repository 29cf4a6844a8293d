"""What the objects are and what they change: object layer, lost and gained light, where it matters.

A pilot at one eighth of the size says which blocks change by more than ``threshold`` of LS_noobj; only those are traced.
``strategy = "difference"`` estimates the change itself; ``"reference"`` traces two full images with the same random
numbers. Pixels that objects cover get more samples. Limits: one plane as local scene, distant light.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.lens import ray_grid
from pipeline.conventions import ACESCG
from pipeline.light.environment import irradiance
from pipeline.run import artifacts as A
from pipeline.run.errors import ManifestError
from pipeline.run.stage import Stage
from pipeline.transport.difference import difference_block
from pipeline.transport.meshes import Material, load_meshes
from pipeline.transport.scene import build_worlds, material_bsdf, mesh_shape
from pipeline.transport.trace import Rays, Samples, reference_block, trace
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Plane, Raster, Result, View
from stages import knobs

BLOCK = 8  # px, side of a pilot cell
PILOT_SAMPLES = 64
FEATHER = 2 * BLOCK  # px over which the change fades out at the border of the region
STRATEGIES = {"difference": difference_block, "reference": reference_block}
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
            material, space = mesh.material, "linear_rec709"
            if wish["material"]:
                given = dict(wish["material"])
                space = given.pop("space")
                material = Material(**given)
            name = f"{wish['name']}_{index}"
            bsdf = material_bsdf(mi, material, space)
            shapes[name] = mesh_shape(mi, name, mesh, world_from_object(wish, plane), bsdf)
    return shapes, warnings


def influence(
    worlds: Any, camera_rays: Rays, shape: tuple[int, int], light: np.ndarray, params: knobs.Render
) -> np.ndarray:
    """(H, W) weight in [0, 1]: 0 where the objects change less than the threshold, feathered towards that border."""
    from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter

    height, width = shape
    rows = np.minimum(np.arange(BLOCK // 2, height + BLOCK // 2, BLOCK), height - 1)
    columns = np.minimum(np.arange(BLOCK // 2, width + BLOCK // 2, BLOCK), width - 1)
    index = (rows[:, None] * width + columns).ravel()
    pilot = trace(
        difference_block, worlds, camera_rays[index], PILOT_SAMPLES, min(params.depth, 4), params.seed + 1, BLOCK
    )
    grid = (len(rows), len(columns))
    expected = pilot.albedo * light / np.pi

    def smooth(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values.reshape(*grid, 3), (1, 1, 0), mode="nearest")

    change = np.linalg.norm(smooth(pilot.lost + pilot.gained), axis=-1)
    level = np.linalg.norm(smooth(expected), axis=-1)
    blocks = (change > params.threshold * level) & (level > 0) | (pilot.alpha.reshape(grid) > 0)
    blocks = binary_dilation(blocks, np.ones((5, 5)))
    mask = np.repeat(np.repeat(blocks, BLOCK, 0), BLOCK, 1)[:height, :width]
    if mask.all():
        return np.ones(shape)
    weight = np.clip(distance_transform_edt(mask) / FEATHER, 0, 1)
    return weight * weight * (3 - 2 * weight)


def trace_region(worlds: Any, rays: Rays, params: knobs.Render) -> Samples:
    """The pixels of the region, then those that show an object again with more samples, merged by sample count."""
    strategy = STRATEGIES[params.strategy]
    first = trace(strategy, worlds, rays, params.samples, params.depth, params.seed + 2)
    shown = np.flatnonzero(first.alpha > 0)
    if not len(shown):
        return first
    again = trace(strategy, worlds, rays[shown], params.samples * OBJECT_BOOST, params.depth, params.seed + 3)
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
    weight = influence(worlds, rays, shape, light, params)
    pixels = np.flatnonzero(weight > 0)
    if not len(pixels):
        raise ManifestError("scene.toml: no object and no shadow falls into the frame; check position_m and scale")
    samples = trace_region(worlds, rays[pixels], params)
    layers = to_layers(samples, pixels, weight, shape, light)
    numbers = measure(samples, weight, layers, light, params)
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


def to_layers(
    samples: Samples, pixels: np.ndarray, weight: np.ndarray, shape: tuple[int, int], light: np.ndarray
) -> Raster:
    """Scatter the traced pixels into plate-sized channels; the feather scales the difference."""

    def place(values: np.ndarray) -> np.ndarray:
        image = np.zeros((shape[0] * shape[1], *values.shape[1:]), np.float32)
        image[pixels] = values
        return image.reshape(*shape, *values.shape[1:])

    fade = weight.ravel()[pixels, None]
    without = samples.albedo * light / np.pi  # equation 7: in closed form, so without noise
    lost, gained = samples.lost * fade, samples.gained * fade
    layers = {
        "obj": samples.obj,
        "with": without + lost + gained,
        "without": without,
        "lost": lost,
        "gained": gained,
        "variance": samples.change_variance * fade**2,
        "objvariance": samples.obj_variance,
    }
    channels = {
        name: values for layer, rgb in layers.items() for name, values in Raster.split(place(rgb), layer).items()
    }
    channels |= {"obj.A": place(samples.alpha), "ground": place(samples.ground), "influence": weight}
    return Raster(channels, ACESCG)


def measure(
    samples: Samples, weight: np.ndarray, layers: Raster, light: np.ndarray, params: knobs.Render
) -> dict[str, Any]:
    """What was traced, how noisy it is, and how well the closed form of LS_noobj agrees with the render."""
    model = samples.albedo * light / np.pi
    bare = (samples.ground > 0.999) & (model > 0).all(1)
    covered = samples.alpha > 0.99
    numbers: dict[str, Any] = {
        "influenced_fraction": float((weight > 0).mean()),
        "object_fraction": float((layers["obj.A"] > 0).mean()),
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
