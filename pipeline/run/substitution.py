"""Where the error comes from: the truth put in place of what a stage estimated, everything after it computed again.

Nothing is written over: the build's files stay as they are. Each substitution is made alone and then all together; the
differences are the waterfall of the final error.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, latlong_directions, latlong_from_direction
from pipeline.image.metrics import box, scale_of
from pipeline.image.truth import Truth, load_truth, other_scene
from pipeline.light import near_field
from pipeline.light.sampling import bilinear, planes
from pipeline.run.errors import ManifestError
from pipeline.run.runner import Build, settle
from pipeline.transport.plate_texture import continued, read_plate, texture_size
from pipeline.types import Camera, Raster, View

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
    """The light at the ball, turned to the world, brought to the plate's unit and to where the build's map holds."""
    if truth.environment is None:
        raise ManifestError("--with-truth probe: truth.json names no environment")
    height, width = truth.environment.shape[:2]
    u, v = latlong_from_direction(latlong_directions(height, width) @ truth.world_from_map)
    wrapped = np.concatenate([truth.environment[:, -1:], truth.environment, truth.environment[:, :1]], 1)
    light = bilinear(planes(wrapped), u * width + 1, v * height)
    light = light * scale_of(box(values["photographs"]["plate"].rgb()), box(truth.plate))
    attributes, room = values["environment"].attributes, near_field.room_of(values["facts"])
    return Raster(Raster.split(near_field.from_probe(light, attributes, room)), ACESCG)


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
}


def waterfall(build: Build, names: list[str], tell: Callable[[str], None]) -> dict[str, dict[str, float]]:
    """Errors with nothing, each, and all of ``names`` substituted, by label.

    Raises ManifestError for an unknown name or a capture without truth.
    """
    unknown = sorted(set(names) - set(TRUTHS))
    if unknown:
        raise ManifestError(f"--with-truth: is {', '.join(unknown)}; expected names of {', '.join(TRUTHS)}")
    values = {
        artifact.name: build.value(artifact) for stage in build.graph.stages for artifact in stage.outputs.values()
    }
    path = values["facts"].get("truth_path")
    if not path:
        raise ManifestError("--with-truth: this capture has no truth; name it in capture.toml")
    truth = load_truth(Path(path))
    if other := other_scene(truth.objects, values["wishes"]["object"]):
        raise ManifestError(
            f"--with-truth: the truth shows another scene ({'; '.join(other)}); undo that in scene.toml"
        )
    sets = [[], *([name] for name in names), *([names] if len(names) > 1 else [])]
    result = {}
    for chosen in sets:
        metrics = recompute(build, values, truth, chosen)["metrics"] if chosen else values["metrics"]
        label = " + ".join(chosen) or "nothing"
        result[label] = {key: metrics[key] for key in FIGURES}
        tell(f"{label:<32}" + "".join(f"{metrics[key]:10.4f}" for key in FIGURES))
    return result


def recompute(build: Build, values: Values, truth: Truth, names: list[str]) -> Values:
    """Every artifact with the truth of ``names`` in place, up to the metrics; only what depends on it is computed."""
    values = dict(values)
    replaced = {TRUTHS[name][0]: TRUTHS[name][1] for name in names}
    changed: set[str] = set()
    for stage in build.graph.stages:
        if stage.name == "report":
            break
        if stage.name == "uncertainty":  # metrics do not ask for it
            continue
        if any(artifact.name in changed for artifact in stage.inputs.values()):
            inputs = {
                name: build.records_before(stage) if artifact.kind == "records" else values[artifact.name]
                for name, artifact in stage.inputs.items()
            }
            params = build.knobs[stage.name].model_validate(build.settings.params[stage.name])
            result = stage.compute(**inputs, params=params)
            for name, artifact in stage.outputs.items():
                values[artifact.name] = settle(artifact, result.outputs[name])
                changed.add(artifact.name)
        for artifact in stage.outputs.values():
            if make := replaced.get(artifact.name):
                extra = {"build": build} if make is true_albedo else {}
                values[artifact.name] = settle(artifact, make(values, truth, **extra))
                changed.add(artifact.name)
    return values
