"""Where the error comes from: the truth put in place of what a stage estimated, everything after it computed again.

Nothing is written over: the build's files stay as they are. Each substitution is made alone and then all together; the
differences are the waterfall of the final error. It goes upwards, too: a term of the model forced off by its knob, and
what the error is without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import (
    ACESCG,
    HALF_PIXEL,
    invert_rigid,
    latlong_directions,
    latlong_from_direction,
    transform_points,
)
from pipeline.image.metrics import box, scale_of
from pipeline.image.truth import Truth, load_truth, other_scene
from pipeline.light import near_field
from pipeline.light.alike import ALIKE
from pipeline.light.sampling import bilinear, planes
from pipeline.run.errors import ManifestError
from pipeline.run.runner import Build, settle
from pipeline.transport.plate_texture import continued, read_plate, texture_size
from pipeline.types import Camera, Raster, View

# Where the map holds is known from the ball's measured height; by so much a lamp a metre off turns by a degree.
SAME_PLACE_M = 0.02
FIGURES = ("object_rel_err", "shadow_change_err", "faint_change_err", "shadow_rel_err")
Values = dict[str, Any]


def true_camera(values: Values, truth: Truth) -> Camera:
    """The lens that photographed."""
    known = {key: value for key, value in truth.camera.items() if key in Camera.model_fields}
    return Camera(**{**known, "source": "truth"})


def true_views(values: Values, truth: Truth) -> dict[str, View]:
    """Where every view was taken from."""
    return {
        name: view.model_copy(update={"world_from_camera": truth.views[name]}) for name, view in values["views"].items()
    }


def true_environment(values: Values, truth: Truth) -> Raster:
    """The light where the build's map holds, turned to the world, brought to the plate's unit.

    Where the truth tells it there; else the light at the ball, moved through the room's walls as an estimate is.
    """
    if truth.environment is None:
        raise ManifestError("--with-truth probe: truth.json names no environment")
    attributes, room = values["environment"].attributes, near_field.room_of(values["facts"])
    if near_field.VALID in attributes:
        valid = np.array(attributes[near_field.VALID].split(), float)
        for at, light in truth.elsewhere:
            if np.linalg.norm(at - valid) < SAME_PLACE_M:
                return _lit(light, values, truth)
    height, width = truth.environment.shape[:2]
    u, v = latlong_from_direction(latlong_directions(height, width) @ truth.world_from_map)
    wrapped = np.concatenate([truth.environment[:, -1:], truth.environment, truth.environment[:, :1]], 1)
    light = bilinear(planes(wrapped), u * width + 1, v * height)
    return _lit(near_field.from_probe(light, attributes, room), values, truth)


def _lit(light: np.ndarray, values: Values, truth: Truth) -> Raster:
    """A true map (H, W, 3) in the plate's unit, with the header of the build's, less the picture: no lens blurs it."""
    scale = scale_of(box(values["photographs"]["plate"].rgb()), box(truth.plate))
    header = {name: text for name, text in values["environment"].attributes.items() if name != ALIKE}
    return Raster(Raster.split((light * scale).astype(np.float32)), ACESCG, header)


def true_places(values: Values, truth: Truth, build: Build, names: list[str]) -> Raster:
    """Layers under the true light of every object's own place, each pixel's by its distances to them in the picture.

    One map serves all of the model. Between the places whose light the truth tells, layers are interpolated by the
    inverse squares of pixel distances: what is left of near lamps is their fall over an object, and behind the last.
    """
    held = near_field.places_of(values["wishes"], 0.0)
    near = [[light for at, light in truth.elsewhere if np.allclose(at[[0, 2]], foot[[0, 2]])] for foot in held]
    if not held or not all(near):
        raise ManifestError("--with-truth places: truth.json does not tell the light at every object (elsewhere)")
    pose, camera = values["views"]["plate"].world_from_camera, values["camera"]
    feet = project(camera, transform_points(invert_rigid(pose), np.array(held)))
    shape = values["layers"].shape
    y, x = np.mgrid[: shape[0], : shape[1]] + HALF_PIXEL
    weights = 1 / (1 + (x[..., None] - feet[:, 0]) ** 2 + (y[..., None] - feet[:, 1]) ** 2)
    weights /= weights.sum(-1, keepdims=True)
    others = [name for name in names if name not in ("probe", "places")]
    sums: dict[str, Any] = {}
    for number, (light, *_) in enumerate(near):
        lit = _lit(light, values, truth)
        layers = recompute(build, values, truth, others, {"environment": lit}, last="render")["layers"]
        for name, channel in layers.channels.items():
            part = weights[..., number] * channel
            sums[name] = np.maximum(sums.get(name, 0), channel) if name == "influence" else sums.get(name, 0) + part
    return Raster({name: channel.astype(np.float32) for name, channel in sums.items()}, ACESCG, layers.attributes)


def true_albedo(values: Values, truth: Truth, build: Build) -> Raster:
    """The albedo that the plate camera sees, on the plane's texture: read as the plate is, but divided by no light."""
    if truth.albedo is None:
        raise ManifestError("--with-truth albedo: truth.json names no albedo")
    rgb = np.where(truth.albedo[..., 3:] > 0.5, truth.albedo[..., :3], np.nan)
    picture = Raster({**Raster.split(rgb), "mask": np.zeros(rgb.shape[:2], np.uint32)}, ACESCG)
    params = build.knobs["reflectance"].model_validate(build.settings.params["reflectance"])
    shape = texture_size(values["plane"], params.texture_px)
    texture = read_plate(picture, values["camera"], values["views"]["plate"], values["plane"], shape)
    seen = np.zeros(shape)
    seen[texture.window] = texture.seen
    known = np.where(texture.seen > 0.5, texture.seen, 0.0)
    return Raster({**Raster.split(continued(texture.radiance, known, texture.window, shape)), "seen": seen}, ACESCG)


# What can be substituted: the artifact it replaces and how it is made.
TRUTHS: dict[str, tuple[str, Callable[..., Any]]] = {
    "camera": ("camera", true_camera),
    "pose": ("views", true_views),
    "probe": ("environment", true_environment),
    "albedo": ("albedo", true_albedo),
    "places": ("layers", true_places),
}

# What can be forced off: the stage, and its knobs.
TERMS: dict[str, tuple[str, dict[str, Any]]] = {
    "alignment": ("merge", {"align": "never"}),
    "exposures": ("merge", {"estimate_exposures": False}),
    "sun": ("probe", {"recover": "never"}),
    "near_field": ("probe", {"near_budget": 1e6}),  # beside a lamp, light is off by more than all of it
    "proxies": ("plane", {"find_proxies": "never"}),
    "gloss": ("reflectance", {"gloss": "never"}),
    "texture": ("reflectance", {"model": "uniform"}),
    "bounces": ("render", {"depth": 2}),
}


def waterfall(
    build: Build, names: list[str], tell: Callable[[str], None], without: Sequence[str] = ()
) -> dict[str, dict[str, float]]:
    """Errors with nothing, each, and all of ``names`` substituted, and with each term of ``without`` off, by label.

    Raises ManifestError for an unknown name or a capture without truth.
    """
    for option, given, known in (("--with-truth", names, TRUTHS), ("--without", without, TERMS)):
        if unknown := sorted(set(given) - set(known)):
            raise ManifestError(f"{option}: is {', '.join(unknown)}; expected names of {', '.join(known)}")
    values = {
        artifact.name: build.value(artifact) for stage in build.graph.stages for artifact in stage.outputs.values()
    }
    path = values["facts"].get("truth_path")
    asked = " and ".join(option for option, given in (("--with-truth", names), ("--without", without)) if given)
    if not path:
        raise ManifestError(f"{asked}: this capture has no truth to tell errors by; name it in capture.toml")
    truth = load_truth(Path(path))
    if other := other_scene(truth.objects, values["wishes"]["object"]):
        raise ManifestError(f"{asked}: the truth shows another scene ({'; '.join(other)}); undo that in scene.toml")
    result = {}

    def found(label: str, metrics: dict[str, Any]) -> None:
        result[label] = {key: metrics[key] for key in FIGURES}
        tell(f"{label:<40}" + "".join(f"{metrics[key]:10.4f}" for key in FIGURES))

    found("nothing", values["metrics"])
    for chosen in [*([name] for name in names), *([names] if len(names) > 1 else [])]:
        found(" + ".join(chosen), recompute(build, values, truth, chosen)["metrics"])
    for term in without:
        found(f"without {term}", forced_off(build, values, term)["metrics"])
    return result


def forced_off(build: Build, values: Values, term: str) -> Values:
    """Every artifact with a term of `TERMS` forced off, up to the metrics; only what depends on it is computed."""
    stage, knobs = TERMS[term]
    return _computed(build, values, {}, {stage: knobs}, "evaluate")


def recompute(
    build: Build, values: Values, truth: Truth, names: list[str], given: Values | None = None, last: str = "evaluate"
) -> Values:
    """Every artifact with the truth of ``names``, and what is ``given``, in place, up to the stage ``last``."""

    def made(make: Callable[..., Any]) -> Callable[[Values], Any]:
        if make is true_albedo:
            return lambda values: true_albedo(values, truth, build)
        if make is true_places:
            return lambda values: true_places(values, truth, build, names)
        return lambda values: make(values, truth)

    replaced = {TRUTHS[name][0]: made(TRUTHS[name][1]) for name in names}
    replaced |= {name: _constant(value) for name, value in (given or {}).items()}
    return _computed(build, values, replaced, {}, last)


def _constant(value: Any) -> Callable[[Values], Any]:
    return lambda _: value


def _computed(
    build: Build, values: Values, replaced: dict[str, Callable[[Values], Any]], knobs: dict[str, dict[str, Any]],
    last: str,
) -> Values:  # fmt: skip
    """Artifacts with some replaced, and stages run with other ``knobs``; only what depends on either is computed."""
    values = dict(values)
    changed: set[str] = set()
    for stage in build.graph.upto(last):
        if stage.name == "uncertainty":  # metrics do not ask for it
            continue
        if stage.name in knobs or any(artifact.name in changed for artifact in stage.inputs.values()):
            inputs = {
                name: build.records_before(stage) if artifact.kind == "records" else values[artifact.name]
                for name, artifact in stage.inputs.items()
            }
            asked = build.settings.params[stage.name] | knobs.get(stage.name, {})
            result = stage.compute(**inputs, params=build.knobs[stage.name].model_validate(asked))
            for name, artifact in stage.outputs.items():
                values[artifact.name] = settle(artifact, result.outputs[name])
                changed.add(artifact.name)
        for artifact in stage.outputs.values():
            if make := replaced.get(artifact.name):
                values[artifact.name] = settle(artifact, make(values))
                changed.add(artifact.name)
    return values
