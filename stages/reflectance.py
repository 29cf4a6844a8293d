"""Albedo of the plane, and its gloss: the plate's radiance over the light that the probe saw (equations 6 to 8).

The plate is read at every texel of the modelled rectangle through the lens, noise not baked in; texels that the plate
does not show, or shows clipped, or that a proxy or an occluder's mask hides, continue their surroundings and are marked
in ``seen``. A plane alone under distant light needs one step. With proxies their shadows are divided out and their
bounced light is taken off, by the gathered form or the damped iteration (`pipeline.transport.radiosity`); their own
albedo is measured too. Shadows of compact lights that nothing modelled casts are looked for and masked
(`pipeline.transport.shadows`); gloss is taken up when held-out cells ask for it (`pipeline.transport.specular`).
``route = "gradient"`` refines the result by differentiable rendering. Limits: proxies are diffuse; a shadow that is not
found stays in the albedo, and the ratio composite undoes it again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, CLIPPED
from pipeline.light.environment import irradiance
from pipeline.run import artifacts as A
from pipeline.run.errors import NumericalError
from pipeline.run.evidence import ABSENT, TRIED
from pipeline.run.masks import masks_of
from pipeline.run.stage import Stage
from pipeline.transport.gradient import Fit, fit
from pipeline.transport.patches import enlarged
from pipeline.transport.plate_texture import Texture, continued, read_plate, shrunk, texture_size, window_points
from pipeline.transport.radiosity import Estimate
from pipeline.transport.reflectance import updated_brdf
from pipeline.transport.scale import disagreement, unsure_share, warning
from pipeline.transport.shadows import Found, darkening, unexplained
from pipeline.transport.specular import base_of, cells_of, climb, explain
from pipeline.types import Camera, Emitter, Occluder, Plane, Proxy, Raster, Result, Surface, View
from stages import knobs

HIGHEST = 0.98  # albedo that the render is given at most: a brighter ground would gain light at every bounce

UNASKED = Surface(
    scores=[{"model": "diffuse", "because": "not asked for: the lobe of a scene with proxies is unknown"}]
)


def compute(
    photographs: dict[str, Raster],
    camera: Camera,
    views: dict[str, View],
    environment: Raster,
    emitters: list[Emitter],
    plane: Plane,
    proxies: list[Proxy],
    occluders: list[Occluder],
    params: knobs.Reflectance,
) -> Result:
    """Albedo texture, ACEScg. Raises NumericalError when no light arrives or the plate does not show the plane."""
    plate, view = unhidden(photographs["plate"], occluders), views["plate"]
    alone = irradiance(environment.rgb(), plane.normal[None])[0]
    if not np.all(alone > 0):
        raise NumericalError(
            f"environment: irradiance on the plane is {alone}, needed > 0; the probe saw no light from above"
        )
    shape = texture_size(plane, params.texture_px)
    texture = read_plate(plate, camera, view, plane, shape)
    if texture.seen.max(initial=0.0) < 0.5:
        raise NumericalError(
            "plate: shows none of the modelled rectangle; check the board's pose and the object positions"
        )
    values, kept = shrunk(texture)
    light, seen, local_proxies = np.broadcast_to(alone, values.shape), texture.seen, proxies
    warnings: list[str] = []
    near = None
    if proxies or any(occluder.vertices_m is not None for occluder in occluders):
        from pipeline.transport.local_light import local_light

        near = local_light(plane, proxies, occluders, environment.rgb(), plate, camera, view, texture, shape)
        light, seen = near.irradiance, np.where(near.shown, seen, 0.0)
        local_proxies, warnings = near.proxies, near.warnings
    seen = np.where((light > 0).all(-1), seen, 0.0)
    known = seen > 0.5
    if not known.any():
        raise NumericalError("plate: every texel of the modelled rectangle is hidden or unlit; check the proxies")
    matt = measured = np.pi * updated_brdf(values, light)
    surface, fitted = UNASKED, None
    if near is None:
        surface, measured = glossy(values, measured, known, texture, shape, environment, plane, view, params.gloss)
    if surface.model != "diffuse":
        known &= np.isfinite(measured).all(-1)
    elif params.route == "gradient":
        fitted = fit(
            plane, continued(measured, known * seen, texture.window, shape), local_proxies, occluders,
            environment.rgb(), plate, camera, view,
        )  # fmt: skip
        measured = measured * enlarged(fitted.factor, *shape)[texture.window]
        pairs = zip(local_proxies, fitted.proxies)
        local_proxies = [proxy.model_copy(update={"albedo": albedo}) for proxy, albedo in pairs]
    ratios = darkening(emitters, plane.normal, alone)
    shadow = unexplained(measured, known, ratios)
    if shadow.lights:
        known &= ~shadow.mask
        seen = np.where(shadow.mask, 0.0, seen)
        warnings.append(
            f"plate: {shadow.fraction:.1%} of the seen plane lies in a shadow of {', '.join(shadow.lights)} that "
            "nothing modelled casts; the albedo there continues its surroundings. Describe what casts it as a [[proxy]]"
        )
    sigma = np.pi * updated_brdf(np.sqrt(kept * texture.variance), light)
    unsure = unsure_light(environment, plane, alone)
    scale = disagreement(measured[known], sigma[known], unsure, matt[known] if surface.model != "diffuse" else None)
    if said := warning(scale, np.quantile(measured[known], 0.01, axis=0)):
        warnings.append(said)
    if params.model == "uniform":
        albedo = np.broadcast_to(np.median(measured[known], axis=0), (*shape, 3))
    else:
        albedo = continued(measured, known * seen, texture.window, shape)
    share = np.zeros(shape)
    share[texture.window] = seen
    ignored = ignoring(light[known], near.bounced[known]) if near else 0.0
    numbers = {
        "irradiance": alone,
        "albedo_median": np.median(measured[known], axis=0),
        "albedo_p99": np.quantile(measured[known], 0.99, axis=0),
        "above_one_fraction": scale.above,
        "below_zero_fraction": scale.below,
        "map_factor": scale.factor,
        "uncertain_light": unsure,
        "unexplained_shadow_fraction": shadow.fraction,
        "limited_texels": int(((albedo < 0) | (albedo > HIGHEST)).any(-1).sum()),
        "detail_kept": float(kept[known].mean()),
        "texel_mm": float(1e3 * np.linalg.norm(plane.corners_m[1] - plane.corners_m[0]) / shape[1]),
        "seen_fraction": float((share > 0.5).mean()),
        "bounce_ignored_rel": ignored,
    }
    raster = Raster({**Raster.split(np.clip(albedo, 0.0, HIGHEST)), "seen": share}, ACESCG, {"insitu:unit": "albedo"})
    terms = [
        texture_evidence(params.model, numbers["detail_kept"], measured[known]),
        bounce_evidence(near.estimate if near else None, ignored),
        *([gradient_evidence(fitted)] if fitted else []),
        shadow_evidence(list(ratios), shadow),
        explain(surface, params.gloss),
    ]
    outputs = {"albedo": raster, "surface": surface, "local_proxies": local_proxies}
    return Result(outputs, numbers, warnings, terms)


def glossy(
    values: np.ndarray, matt: np.ndarray, known: np.ndarray, texture: Texture, shape: tuple[int, int],
    environment: Raster, plane: Plane, view: View, gloss: str,
) -> tuple[Surface, np.ndarray]:  # fmt: skip
    """The rung of gloss that held-out cells ask for, and the albedo (h, w, 3) under it: ``matt`` where none."""
    points, eye = window_points(plane, texture.window, shape), view.world_from_camera[:3, 3]
    cells = cells_of(values, texture.variance, known, points, eye)
    surface = climb(cells, environment.rgb(), plane.normal, gloss)
    if surface.model == "diffuse":
        return surface, matt
    return surface, base_of(surface, values, environment.rgb(), plane.normal, points, eye)


def unsure_light(environment: Raster, plane: Plane, alone: np.ndarray) -> float:
    """Share of the plane's irradiance that is unsure, by the map's variance where it has one."""
    variance = environment.rgb("variance") if "variance.R" in environment.channels else None
    return unsure_share(environment.rgb(), variance, plane.normal, alone)


def unhidden(plate: Raster, occluders: list[Occluder]) -> Raster:
    """The plate with every pixel that a mask puts behind something real marked as unusable: it shows no plane.

    Raises CaptureError when a mask cannot be read or has another size.
    """
    hidden = np.zeros(plate.shape, bool)
    for mask in masks_of(occluders, plate.shape):
        hidden |= mask > 0
    if not hidden.any():
        return plate
    bits = np.where(hidden, plate["mask"] | np.uint32(CLIPPED), plate["mask"]).astype(np.uint32)
    return Raster({**plate.channels, "mask": bits}, plate.space, plate.attributes)


def texture_evidence(model: str, kept: float, measured: np.ndarray) -> dict[str, Any]:
    """How the texture was made, and what one albedo for all of the known texels (N, 3) would get wrong."""
    scatter, middle = (float(np.linalg.norm(of(measured, axis=0))) for of in (np.std, np.median))
    spread = scatter / middle if middle > 0 else float(scatter > 0)  # a black plane has none, or is none but spots
    return {
        "term": "texture",
        "modelled": model == "textured",
        "because": f"knob reflectance.model = {model}; {kept:.0%} of the texels' own detail is kept, the rest is noise",
        "could_cost": f"wrong reflections of the ground in shiny objects: {spread:.1%} of its light (one sigma)",
        "bound_rel": 2 * spread,
    }


def shadow_evidence(asked: list[str], found: Found) -> dict[str, Any]:
    """Which shadows in the plate were looked for, and what was done about them."""
    if not asked:
        because = "no compact light gives enough of the plane's light to be missed where it is hidden"
    elif not found.lights:
        because = f"no step on the plane has the length and colour of a hidden {' or '.join(asked)}"
    else:
        because = (
            f"steps as of a hidden {' and '.join(found.lights)} around {found.fraction:.1%} of what is seen: masked"
        )
    return {
        "term": "shadows in the plate that nothing modelled casts",
        "modelled": bool(found.lights),
        "because": because,
        "could_cost": "soft shadows and shadows on fine texture are taken for albedo, which the ratio composite undoes",
        "no_bound": "an edge that is soft is not told from texture",
        **(TRIED if asked else {}),
    }


def gradient_evidence(found: Fit) -> dict[str, Any]:
    """What differentiable rendering changed."""
    change = np.abs(found.factor - 1)
    return {
        "term": "refinement by differentiable rendering",
        "modelled": True,
        "because": f"knob reflectance.route = gradient; squared relative error {found.loss[0]:.4g} at first, "
        f"{np.mean(found.loss[-8:]):.4g} at last; albedo changed by {change.mean():.1%}, at most {change.max():.1%}",
        "could_cost": "the path tracer's noise, less than what the loss left",
    }


def ignoring(light: np.ndarray, bounced: np.ndarray) -> float:
    """Median relative error of albedo if what other surfaces throw, (N, 3) of the light (N, 3), were left out of it."""
    return float(
        np.median(np.linalg.norm(bounced, axis=-1) / np.linalg.norm(np.maximum(light - bounced, 1e-9), axis=-1))
    )


def bounce_evidence(found: Estimate | None, ignored: float) -> dict[str, Any]:
    """Whether surfaces light each other, which inversion was used, and what leaving it out would do to the albedo."""
    term = {"term": "inter-reflection of the local scene"}
    if found is None:
        because = "one convex plane: no point of it sees another, one step of equation 8 is exact"
        return {**term, "modelled": False, "because": because, "could_cost": "nothing for a plane", **ABSENT}
    contraction = f"spectral radius of rho F {found.spectral_radius:.2f}"
    if found.method == "gathered":
        because = f"{found.measured_share:.1%} of the bounced light is seen in the plate and gathered; {contraction}"
        left = "what the plate shows as bounce includes gloss"
    else:
        because = (
            f"only {found.measured_share:.1%} of the bounced light is measured in the plate: damped iteration, "
            f"{found.steps} steps; {contraction}"
        )
        left = f"prediction and plate still differ by {found.residual:.1%} at the worst patch; hidden faces are guessed"
    cost = f"albedo {ignored:.1%} too bright (median) if it were left out; {left}"
    return {**term, "modelled": True, "because": because, "could_cost": cost}


STAGE = Stage(
    "reflectance",
    compute,
    knobs.Reflectance,
    inputs={
        "photographs": A.PHOTOGRAPHS,
        "camera": A.CAMERA,
        "views": A.VIEWS,
        "environment": A.LIGHTING,
        "emitters": A.EMITTERS,
        "plane": A.PLANE,
        "proxies": A.SURROUNDINGS,
        "occluders": A.OCCLUDERS,
    },
    outputs={"albedo": A.ALBEDO, "surface": A.SURFACE, "local_proxies": A.LOCAL_PROXIES},
)
