"""What the objects are and what they change: object layer, lost and gained light, where it matters.

``strategy = "difference"`` estimates the change itself (`pipeline.transport.difference`); ``"reference"`` traces two
full images with the same random numbers, every pixel. Sampling goes in passes over two independent halves: the first
picture is there after seconds, and pixels leave when their noise is below half the photograph's
(`pipeline.transport.estimate`). Limits: the distant light is the same everywhere; proxies are diffuse.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import ACESCG, invert_rigid, transform_points
from pipeline.image.colour import luminance
from pipeline.image.display import display_exposure
from pipeline.light.environment import irradiance
from pipeline.run import artifacts as A
from pipeline.run import progress
from pipeline.run.errors import ManifestError
from pipeline.run.evidence import TRIED
from pipeline.run.formats import data_window
from pipeline.run.stage import Stage
from pipeline.transport.canvas import Canvas
from pipeline.transport.caustics import Film
from pipeline.transport.estimate import WORTH_TRACING, Shot, lit, prepare, sampled
from pipeline.transport.near_one import near_one
from pipeline.transport.passes import Halves, Interrupted
from pipeline.transport.pilot import Effort
from pipeline.transport.placing import clearances, feet, off_plane, place_objects
from pipeline.transport.reflectance import reflected_radiance
from pipeline.transport.region import BLUR, Window, limits_for
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.softened import SOFTNESS, PlateLens, softened, softness_of
from pipeline.transport.trace import LensRays, Rays
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Emitter, Occluder, Plane, Proxy, Raster, Result, Surface, View
from stages import knobs

WHITE = 0.8  # albedo of white paint
BLURRED = 1 + 4 * BLUR**2  # interpolation errs by an eighth of second differences, the pilot's blur by 4 BLUR^2 more
STATISTICS_PX = 1 << 20  # pixels of the plate from which its median noise and its exposure are taken
WORTH_A_RAY = 0.15  # of the irradiance: a weaker light is sampled with the sky, by its brightness
Outcome = tuple[Raster, dict[str, Any], list[str]]  # layers, numbers, warnings


def tell(what: str) -> Callable[[float], None]:
    """A progress callback that names its task, and ends it when the user wants to stop."""

    def callback(share: float) -> None:
        progress.report(what, share)
        if progress.interrupted():
            raise Interrupted

    return callback


def compute(
    wishes: dict[str, Any],
    camera: Camera,
    views: dict[str, View],
    photographs: dict[str, Raster],
    environment: Raster,
    emitters: list[Emitter],
    plane: Plane,
    albedo: Raster,
    surface: Surface,
    local_proxies: list[Proxy],
    occluders: list[Occluder],
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
    pose = views["plate"].world_from_camera
    standing = clearances(wishes, plane)
    unsteady, lifted = off_plane(wishes, standing)
    moved = near_one(pose, feet(wishes, plane))
    if moved is not None:
        wishes, plane, pose = moved.wishes(wishes), moved.plane(plane), moved.pose(pose)
        local_proxies, occluders = moved.meshes(local_proxies), moved.meshes(occluders)
    upward = irradiance(environment.rgb(), plane.normal[None])[0]
    shapes, warnings = place_objects(wishes, plane, float(luminance(upward)) / np.pi, params.materials, pose[:3, 3])
    rays = LensRays(camera, pose)
    plate = photographs["plate"]
    some = thinned(plate)
    white = 2.0 ** -display_exposure(some.rgb())
    limits = limits_for(some.rgb(), some.rgb("variance"), params.threshold)
    effort = Effort(
        params.strategy, params.samples, params.depth, params.denoise, params.seed, adaptive=not params.light_groups
    )

    def worlds_under(light: np.ndarray, lamps: list[Emitter], objects: dict[str, Any]) -> tuple[Worlds, np.ndarray]:
        worlds = build_worlds(plane, albedo.rgb(), light, objects, local_proxies, lamps, surface, occluders)
        return worlds, irradiance(light, plane.normal[None])[0]

    film = film_of(camera, pose, rays)
    apart = strong(emitters, plane, upward)
    worlds = build_worlds(plane, albedo.rgb(), environment.rgb(), shapes, local_proxies, apart, surface, occluders)
    canvas, left = prepare(worlds, rays, shape, upward, Grain(plate), white, limits, effort, film, tell)
    soft = softness_of(views, params.softness_px)
    canvas = replace(canvas, softness=soft)
    if not (canvas.region.weight > 0).any() or not len(canvas.traced):
        raise ManifestError("scene.toml: no object and no shadow falls into the frame; check position_m and scale")
    numbers: dict[str, Any] = left | {
        "threshold": limits.threshold,
        "step_over_hidden_step": left["left_out_max"] / limits.hidden,
        "lights": len(apart) + 1,
        "variant": use_mitsuba().variant(),
    }
    numbers["lowest_point_mm"] = {name: 1e3 * lowest for name, (lowest, _) in standing.items()}
    if moved is not None:
        numbers["rendered_about_m"], numbers["rendered_at_scale"] = moved.origin_m.tolist(), moved.scale
    if params.light_groups:
        # What the objects themselves send out is light of one group only, the sky's.
        objects = {"sky": shapes, "lamp": place_objects(wishes, plane, 0.0, params.materials)[0]}
        parts = {
            name: worlds_under(*part, objects["sky" if name == "sky" else "lamp"])
            for name, part in groups(environment.rgb(), emitters).items()
        }
        result = by_group({name: lit(canvas, *part) for name, part in parts.items()})
    else:
        result = refined(canvas)
    layers, found, said = result
    numbers |= found
    numbers["softness_px"], numbers["softness_sigma_px"] = soft.px, soft.sigma_px
    rows = [*evidence(params, numbers), through_lens(soft), *lifted]
    return Result({"layers": layers}, numbers, unsteady + warnings + said, rows)


def strong(emitters: list[Emitter], plane: Plane, light: np.ndarray) -> list[Emitter]:
    """The emitters that give enough of the plane's irradiance ``light`` (3,) to be worth a ray of their own."""
    given = [float((e.irradiance * max(e.direction @ plane.normal, 0.0)).sum()) for e in emitters]
    return [e for e, part in zip(emitters, given, strict=True) if part >= WORTH_A_RAY * light.sum()]


@dataclass(frozen=True)
class Grain:
    """Noise of the plate (H, W), root mean square of the channels, made where it is asked for."""

    plate: Raster

    def __getitem__(self, window: Window) -> np.ndarray:
        """(h, w) of a window."""
        return np.asarray(np.sqrt(sum(self.plate[f"variance.{c}"][window] for c in "RGB") / np.float32(3)))


def thinned(picture: Raster) -> Raster:
    """Every n-th pixel in both directions: about a million tell medians as well as 24."""
    step = max(1, round(np.sqrt(picture.shape[0] * picture.shape[1] / STATISTICS_PX)))
    return Raster({name: values[::step, ::step] for name, values in picture.channels.items()}, picture.space)


def film_of(camera: Camera, world_from_camera: np.ndarray, rays: Rays | LensRays) -> Film:
    """Where photons land in the photograph."""
    camera_from_world = invert_rigid(world_from_camera)
    return Film(
        lambda points: project(camera, transform_points(camera_from_world, points)),
        (camera.height, camera.width),
        lambda pixels: rays[pixels].solid_angles(),
        world_from_camera[:3, 3],
    )


def refined(canvas: Canvas) -> Outcome:
    """Passes until nothing is open, shown as they come; goes on from a checkpoint; ends early when asked to."""
    saved = progress.checkpoint_load()
    start = None if saved is None else Halves.of_arrays(saved)
    shot = None if start is None else Shot(canvas, start)
    stopped = False
    try:
        for latest in sampled(canvas, start, tell("render")):
            shot = latest
            progress.offer(functools.partial(offered, shot))
            stopped = progress.interrupted()
            progress.checkpoint_save(shot.halves.arrays)
            if stopped:
                break
    except Interrupted:
        stopped = True
    if shot is None:
        raise KeyboardInterrupt
    layers, numbers, warnings = outcome(shot)
    if stopped and shot.halves.open.any():
        progress.checkpoint_save(shot.halves.arrays)
        done = shot.halves.both.count
        share = float(done.sum() / (done + shot.halves.open * canvas.effort.samples).sum())
        numbers |= {"complete": False, "share_done": share}
        warnings = [*warnings, f"render: interrupted; about {share:.0%} of the samples are in the picture"]
    return layers, numbers, warnings


def offered(shot: Shot) -> Result:
    """What there is so far."""
    layers, numbers, warnings = outcome(shot)
    return Result({"layers": layers}, numbers, warnings)


def outcome(shot: Shot) -> Outcome:
    """Layers, numbers and warnings of what has been sampled."""
    images, quiet = shot.drawn
    numbers = measure(shot.canvas, shot.halves)
    if quiet is not None:
        for name, part in (("shadow", quiet.survives), ("added_light", quiet.added), ("object", quiet.obj)):
            numbers[f"raw_share_{name}"] = part.raw_share
            numbers[f"speckle_share_{name}"] = part.speckle_share
    missing = numbers["not_finite_samples"]
    warnings = [f"render: {missing} samples were not finite and count as zero"] if missing else []
    return to_layers(images, shot.canvas), numbers, warnings


def groups(light: np.ndarray, emitters: list[Emitter]) -> dict[str, tuple[np.ndarray, list[Emitter]]]:
    """The environment (H, W, 3) of each light group alone, and the emitters in it. Their sum is the environment."""
    sky = light.reshape(-1, 3).copy()
    parts = {}
    for emitter in emitters:
        alone = np.zeros_like(sky)
        texels = np.asarray(emitter.texels, int)
        alone[texels] = sky[texels]
        sky[texels] = 0
        parts[emitter.name] = (alone.reshape(light.shape), [emitter])
    return {"sky": (sky.reshape(light.shape), []), **parts}


def by_group(canvases: dict[str, Canvas]) -> Outcome:
    """Every light group alone, and their sum, which is the result: light is additive."""
    total: Raster | None = None
    channels: dict[str, np.ndarray] = {}
    numbers: dict[str, Any] = {}
    warnings: list[str] = []
    for name, canvas in canvases.items():
        *_, shot = sampled(canvas, None, tell(f"render: {name}"))
        layers, numbers, said = outcome(shot)
        warnings += said
        for layer in ("obj", "lost", "gained"):
            channels |= Raster.split(layers.rgb(layer), f"{layer}.{name}")
        # Coverage comes from the same camera samples in every group, so it is not summed.
        shared = {"obj.A", "ground", "influence"}
        if total is None:
            total = layers
        else:
            joined = {n: np.hypot if n.startswith("noise.") else np.add for n in total.channels}
            summed = {n: v if n in shared else joined[n](v, layers[n]) for n, v in total.channels.items()}
            total = Raster(summed, ACESCG, total.attributes)
    assert total is not None
    attributes = total.attributes | {"insitu:groups": ",".join(canvases)}
    return Raster(total.channels | channels, ACESCG, attributes), numbers, warnings


def empty_layers(shape: tuple[int, int]) -> Raster:
    """Layers that change nothing."""
    names = [
        f"{layer}.{c}"
        for layer in ("obj", "with", "without", "lost", "gained", "variance", "objvariance")
        for c in "RGB"
    ]
    names += ["obj.A", "ground", "noise.change", "noise.obj", "influence"]
    return Raster({name: np.zeros(shape, np.float32) for name in names}, ACESCG)


def to_layers(images: dict[str, np.ndarray], canvas: Canvas) -> Raster:
    """Channels of the size of the plate of pictures of the canvas's window, as soft as the plate.

    The feather scales the change; where it ends the plate is left alone, whatever the lens would carry there.
    """
    fade = canvas.region.weight[..., None]
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
    shown = canvas.region.weight > 0
    by = canvas.softness.variance if canvas.softness else 0.0
    layers = {name: softened(rgb, by) * shown[..., None] for name, rgb in layers.items()}
    channels = {name: values for layer, rgb in layers.items() for name, values in Raster.split(rgb, layer).items()}
    channels |= {n: softened(images[m], by) * shown for n, m in (("obj.A", "alpha"), ("ground", "ground"))}
    channels |= {"noise.change": images["change_noise"] * canvas.region.weight, "noise.obj": images["obj_noise"]}
    channels["influence"] = canvas.region.weight
    framed = {name: canvas.framed(values) for name, values in channels.items()}
    told = {SOFTNESS: f"{canvas.softness.px:.7g} {canvas.softness.sigma_px:.7g}"} if canvas.softness else {}
    return Raster(framed, ACESCG, {"dataWindow": data_window(*canvas.window), **told})


def measure(canvas: Canvas, halves: Halves) -> dict[str, Any]:
    """What was sampled, how noisy it is before denoising, and how well the closed form agrees with LS_noobj."""
    samples = halves.both
    model = reflected_radiance(samples.albedo, canvas.light_traced)
    bare = (samples.ground > 0.999) & (model > 0).all(1)
    covered = (samples.alpha > 0.99) & (samples.obj > 0).any(1)
    pixels = canvas.shape[0] * canvas.shape[1]
    numbers: dict[str, Any] = {
        "influenced_fraction": int((canvas.region.weight > 0).sum()) / pixels,
        "traced_fraction": len(samples.count) / pixels,
        "object_fraction": int((samples.alpha > 0).sum()) / pixels,
        "not_finite_samples": round(float((samples.not_finite * samples.count).sum())),
        "samples_per_traced_pixel": float(samples.count.mean()),
        "quiet_early_fraction": float((samples.count < samples.count.max()).mean()),
        "passes": halves.passes,
    }
    if bare.any():
        level, noise = np.linalg.norm(model[bare], axis=1), np.sqrt(samples.change_variance[bare].sum(1))
        numbers["change_noise_rel"] = float(np.median(noise / level))
        numbers["deepest_shadow"] = float(
            np.quantile((samples.lost + samples.gained)[bare].sum(1) / model[bare].sum(1), 0.001)
        )
        if canvas.effort.strategy == "reference":
            numbers["noobj_over_closed_form"] = float(samples.without[bare].sum() / model[bare].sum())
    if covered.any():
        level, noise = np.linalg.norm(samples.obj[covered], axis=1), np.sqrt(samples.obj_variance[covered].sum(1))
        numbers["object_noise_rel"] = float(np.median(noise / level))
    return numbers


UNTRACED = "at most: pixels not traced, each as dear as a traced one"  # on desk it is two thirds of that


def evidence(params: knobs.Render, numbers: dict[str, Any]) -> list[dict[str, Any]]:
    """What was modelled of the transport, and why. Savings suppose that every pixel costs what a traced one does."""
    region, traced = numbers["influenced_fraction"], numbers["traced_fraction"]
    between, deeper = BLURRED * params.threshold / 2, deeper_light(params.depth)
    return [
        {
            "term": "region",
            "modelled": region >= 1 or f"{region:.1%} of the frame",
            "because": f"a pilot found the rest to change by less than {numbers['threshold']:.2%}",
            "could_cost": f"{numbers['left_out_max']:.2%} of the plate where most is left out (pilot noise "
            f"{numbers['left_out_noise']:.2%}), {numbers['left_out_mean']:+.1e} of the frame's light",
            "bound_rel": numbers["left_out_max"],
            "saved_rel": 1 / region - 1,
            "saved_by": UNTRACED,
        },
        {
            "term": "every pixel of the region",
            "modelled": traced >= region or f"{traced:.1%} of the frame traced, the rest of the region interpolated",
            "because": "second differences of the pilot bound the error of interpolation",
            "could_cost": f"{between:.2%} of the plate at most, and the pilot's noise",
            "bound_rel": between,
            "saved_rel": max(region / traced - 1, 0.0),
            "saved_by": UNTRACED,
        },
        {
            "term": "light tracing",
            "modelled": numbers["light_traced_share"] >= WORTH_TRACING,
            "because": f"in the pilot {numbers['light_traced_share']:.1%} of the added light was better found from the "
            f"emitters; worth it from {WORTH_TRACING:.0%}",
            "could_cost": "noise where mirrors and glass throw the light of lamps",
            "bound_rel": numbers["light_traced_share"],
            **TRIED,
        },
        {
            "term": "denoiser",
            "modelled": params.denoise,
            "because": f"knob render.denoise; {params.samples} samples leave noise",
            "could_cost": "fine detail of reflections; sharpness of caustics"
            if params.denoise
            else f"noise of {numbers.get('object_noise_rel', 0.0):.1%} on objects, a median",
            "bound_rel": 2 * numbers.get("object_noise_rel", 0.0),
        },
        {
            "term": "path depth",
            "modelled": params.depth,
            "because": "knob render.depth",
            "could_cost": f"{deeper:.2%}: light of more bounces, next to a right angle of white surfaces",
            "bound_rel": deeper,
        },
    ]


def through_lens(soft: PlateLens) -> dict[str, Any]:
    """Why what is rendered is as soft as it is."""
    because = {
        "stated": "knob render.softness_px",
        "measured": "the edges of the print in the plate",
        "measured elsewhere": "the edges of the print in another view of its camera",
        "assumed": "no view shows a print; as soft as lenses usually are",
    }[soft.source]
    return {
        "term": "the plate's lens on what is rendered",
        "modelled": soft.variance > 0,
        "because": f"{because}: {soft.px:.2f} +- {soft.sigma_px:.2f} px, pixel included",
        "could_cost": "its sigma, at edges" if soft.variance > 0 else "nothing: a pixel's own box is as soft",
        **({} if soft.variance > 0 else {"bound_rel": 0.0}),
    }


def deeper_light(depth: int) -> float:
    """Light of paths of more vertices than ``depth``, over that of one bounce, where surfaces face each other closely.

    Each bounce keeps the albedo WHITE, and half of what leaves a surface meets the other, as next to the edge of two
    at a right angle: a geometric series.
    """
    kept = WHITE / 2
    return float(kept ** (depth - 1) / (1 - kept))


STAGE = Stage(
    "render",
    compute,
    knobs.Render,
    inputs={
        "wishes": A.WISHES,
        "camera": A.CAMERA,
        "views": A.VIEWS,
        "photographs": A.PHOTOGRAPHS,
        "environment": A.LIGHTING,
        "emitters": A.EMITTERS,
        "plane": A.PLANE,
        "albedo": A.ALBEDO,
        "surface": A.SURFACE,
        "local_proxies": A.LOCAL_PROXIES,
        "occluders": A.OCCLUDERS,
    },
    outputs={"layers": A.LAYERS},
)
