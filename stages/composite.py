"""The photograph with the objects in it: additive (4), ratio (5), or chosen per pixel; linear EXR and display picture.

The plate is never resampled. Pixels that nothing touches keep their bits. ``plate * mul + add + obj`` rebuilds the
result from the EXR's layers; with ``render.light_groups`` so do those of every light. Real things in front that are
given as masks take their share back. Every guard that fires is counted and marked in ``guards``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, CLIPPED
from pipeline.image.display import display_exposure, display_transform
from pipeline.light.environment import irradiance
from pipeline.light.prediction import plane_hits, plane_texture
from pipeline.run import artifacts as A
from pipeline.run.errors import ArtifactError
from pipeline.run.masks import masks_of
from pipeline.run.stage import Stage
from pipeline.transport import differential as d
from pipeline.transport.ray_arrays import hidden_by
from pipeline.types import Camera, Emitter, Occluder, Plane, Proxy, Raster, Result, View
from stages import knobs

GUARDS = {
    "negative": d.NEGATIVE,
    "clipped_plate": d.CLIPPED_PLATE,
    "gain_limited": d.GAIN_LIMITED,
    "no_model": d.NO_MODEL,
    "bounded_ratio": d.BOUNDED,
    "edge_of_model": d.EDGE_OF_MODEL,
    "unseen_albedo": d.UNSEEN_ALBEDO,
}
FEW = 1e-3  # of the touched pixels: fewer whose albedo was not seen are counted and not told
PREDICTED_PX = 20_000  # pixels whose predicted error is asked for
REBUILD = "R,G,B = plate * mul + add + obj"
REBUILD_GROUPS = "mul = 1 - obj.A + sum(mul.g - 1); add = sum(add.g); obj = sum(obj.g)"
RELIGHT = (
    "w.g: gains, s.g: insitu:group_shares; "
    "plate * ((1 - obj.A) * sum(w.g * s.g) + sum(w.g * (mul.g - 1))) + sum(w.g * (add.g + obj.g))"
)


def change_of(layers: Raster) -> d.Change:
    """What the render says, as the composite takes it."""
    parts = {name: layers.rgb(name) for name in ("obj", "lost", "gained", "without", "variance")}
    return d.Change(**parts, alpha=layers["obj.A"], ground=layers["ground"])


def rule_of(kind: str, change: d.Change, plate: Raster) -> d.Rule:
    """The rule of a ``kind``: additive, ratio or auto."""
    if kind == "auto":
        return d.chosen(change, plate.rgb(), plate.rgb("variance"))
    return {"additive": d.additive, "ratio": d.ratio}[kind](change)


def compose(
    plate: Raster, layers: Raster, kind: str, mask: np.ndarray | None = None, half: bool = False
) -> tuple[np.ndarray, d.Layers, d.Rule]:
    """The composite (H, W, 3) float32, its layers, guards complete, and the rule that they follow.

    Args:
        plate: R G B, variance, mask.
        layers: of the render.
        kind: additive, ratio or auto.
        mask: (H, W) coverage by real things in front.
        half: round ``mul`` to 16 bit, so that what is stored rebuilds the result.
    """
    change, rgb = change_of(layers), plate.rgb()
    rule = rule_of(kind, change, plate)
    built = d.build(change, rule)
    built = d.flagged(built, d.EDGE_OF_MODEL, d.edge_of_model(change, layers["influence"]))
    if mask is not None:
        built = built.behind(mask)
    if half:
        built = built.with_half_mul()
    picture = built.apply(rgb)
    built = d.flagged(built, d.NEGATIVE, ((picture < 0) & (rgb >= 0)).max(-1))
    clipped = built.touched & (built.alpha < 1) & ((plate["mask"] & CLIPPED) > 0)
    return picture, d.flagged(built, d.CLIPPED_PLATE, np.asarray(clipped)), rule


def in_front(occluders: list[Occluder], shape: tuple[int, int]) -> np.ndarray | None:
    """Coverage (H, W) by the occluders that are pictures, None without any; independent edges multiply.

    Raises CaptureError when a mask cannot be read or has another size than the plate.
    """
    free: np.ndarray | None = None
    for mask in masks_of(occluders, shape):
        free = (1 - mask) if free is None else free * (1 - mask)
    return None if free is None else 1 - free


def unseen_albedo(
    change: d.Change, camera: Camera, view: View, plane: Plane, albedo: Raster, proxies: list[Proxy]
) -> np.ndarray:
    """(H, W) bool: pixels that show the plane, whose light changes visibly and whose albedo the plate never showed.

    A proxy before the plane has an albedo of its own: the plane behind it is not what changes.
    """
    visible = (np.abs(change.difference) > d.SEEN_CHANGE * change.without).any(-1) & (change.ground > 0)
    result = np.zeros(change.alpha.shape, bool)
    row, column = np.nonzero(visible)
    if "seen" in albedo.channels and len(row):
        points = plane_hits(plane, camera, view.world_from_camera, np.stack([column, row], -1) + 0.5)
        seen = plane_texture(plane, np.repeat(albedo["seen"][..., None], 3, -1), points)[:, 0]
        unseen = ~(seen >= 0.5) & np.isfinite(points).all(-1)  # a ray that meets no plane shows a proxy
        asked = np.flatnonzero(unseen)
        unseen[asked[hidden_by(proxies, view.world_from_camera[:3, 3], points[asked])]] = False
        result[row, column] = unseen
    return result


def group_layers(change: d.Change, rule: d.Rule, layers: Raster, mask: np.ndarray | None) -> dict[str, d.Layers]:
    """Layers of every light group that the render kept apart, in its order."""
    names = [name for name in str(layers.attributes.get("insitu:groups", "")).split(",") if name]
    found = {}
    for name in names:
        parts = [layers.rgb(f"{layer}.{name}") for layer in ("lost", "gained", "obj")]
        group = d.build_group(change, rule, *parts)
        found[name] = group if mask is None else group.behind(mask)
    return found


def group_shares(
    names: list[str], environment: np.ndarray, emitters: list[Emitter], plane: Plane
) -> dict[str, np.ndarray]:
    """Share (3,) of every group in the irradiance on the plane; the sky is what no emitter holds.

    Raises ArtifactError for a group that is no emitter's.
    """
    normal = plane.normal[None]
    whole = irradiance(environment, normal)[0]
    texels = {emitter.name: np.asarray(emitter.texels, int) for emitter in emitters}
    if unknown := [name for name in names if name != "sky" and name not in texels]:
        raise ArtifactError(f"layers: light groups {unknown} are no emitters of {sorted(texels)}; render again")
    shares = {}
    for name in names:
        if name != "sky":
            alone = np.zeros(environment.shape)
            alone.reshape(-1, 3)[texels[name]] = environment.reshape(-1, 3)[texels[name]]
            shares[name] = irradiance(alone, normal)[0] / whole
    rest = 1 - sum(shares.values(), np.zeros(3))
    return {name: rest if name == "sky" else shares[name] for name in names}


def predicted(change: d.Change, rule: d.Rule, plate: Raster) -> dict[str, float]:
    """Median predicted error, relative to the plate, of (4), (5) and ``rule`` where light changes visibly."""
    row, column = np.nonzero((np.abs(change.difference) > d.SEEN_CHANGE * change.without).any(-1))
    row, column = (index[:: len(index) // PREDICTED_PX + 1] for index in (row, column))
    some = d.picked(change, row, column)
    rgb, variance = (plate.rgb(layer)[row, column][:, None] for layer in ("", "variance"))
    taken = {name: getattr(rule, name)[row, column][:, None] for name in ("lost_share", "gained_share", "gain")}
    rules = {"additive": d.additive(some), "ratio": d.ratio(some), "taken": replace(rule, **taken)}
    found = {}
    for kind, one in rules.items():
        error = d.predicted_error(one, some, rgb, variance)
        known = np.isfinite(error) & (rgb > 0)
        if known.any():
            found[f"predicted_error_{kind}"] = float(np.median(np.sqrt(error[known]) / rgb[known]))
    return found


def compute(
    photographs: dict[str, Raster],
    layers: Raster,
    occluders: list[Occluder],
    camera: Camera,
    views: dict[str, View],
    plane: Plane,
    albedo: Raster,
    environment: Raster,
    emitters: list[Emitter],
    proxies: list[Proxy],
    params: knobs.Composite,
) -> Result:
    """Composite and display pictures.

    Raises ManifestError for an unknown display, view or look, CaptureError for an unusable mask.
    """
    plate = photographs["plate"]
    mask = in_front(occluders, plate.shape)
    picture, built, rule = compose(plate, layers, params.kind, mask, params.half)
    change = change_of(layers)
    unseen = unseen_albedo(change, camera, views["plate"], plane, albedo, proxies)
    built = d.flagged(built, d.UNSEEN_ALBEDO, unseen if mask is None else unseen & (mask < 1))
    channels = {
        **Raster.split(picture),
        **Raster.split(built.mul.astype(np.float16) if params.half else built.mul, "mul"),
        **Raster.split(built.add, "add"),
        **Raster.split(built.obj, "obj"),
        "obj.A": built.alpha,
        "guards": built.guards,
    }
    attributes = {"insitu:layers": REBUILD}
    groups = group_layers(change, rule, layers, mask)
    for name, group in groups.items():
        for layer in ("mul", "add", "obj"):
            channels |= Raster.split(getattr(group, layer), f"{layer}.{name}")
    if groups:
        shares = group_shares(list(groups), environment.rgb().astype(float), emitters, plane)
        attributes |= {
            "insitu:groups": ",".join(groups),
            "insitu:group_layers": REBUILD_GROUPS,
            "insitu:relight": RELIGHT,
            "insitu:group_shares": "; ".join(
                f"{name} " + " ".join(f"{value:.7g}" for value in share) for name, share in shares.items()
            ),
        }
    exposure = display_exposure(plate.rgb()) + params.exposure_ev
    numbers: dict[str, Any] = {
        f"guard_{name}_px": int(((built.guards & bit) > 0).sum()) for name, bit in GUARDS.items()
    }
    numbers["touched_fraction"] = float((picture != plate.rgb()).any(-1).mean())
    numbers["not_finite_px"] = int((~np.isfinite(picture)).any(-1).sum())
    numbers["exposure_ev"] = exposure
    numbers |= predicted(change, rule, plate)
    if mask is not None:
        numbers["occluded_fraction"] = float(mask.mean())
    looking = (params.display, params.view, exposure, params.look)
    outputs = {
        "composite": Raster(channels, ACESCG, attributes),
        "display": display_transform(picture, *looking),
        "plate_display": display_transform(plate.rgb(), *looking),
    }
    touched_px = numbers["touched_fraction"] * picture[..., 0].size
    return Result(outputs, numbers, warnings_of(numbers, touched_px, params.kind))


def warnings_of(numbers: dict[str, Any], touched_px: float, kind: str) -> list[str]:
    """What of the counters a user has to know, and can do."""
    found = []
    if count := numbers["guard_clipped_plate_px"]:
        found.append(
            f"composite: the light changes on {count} px where the plate is clipped; their true value is unknowable, "
            "add a shorter plate frame"
        )
    if count := numbers["guard_negative_px"]:
        cure = "more render.samples lessen that" if kind == "auto" else "kind = auto avoids most of that"
        found.append(f"composite: {count} px are below zero; {cure}")
    if count := numbers["guard_edge_of_model_px"]:
        found.append(
            f"composite: a visible change ends at the border of the modelled local scene on {count} px; lower "
            "plane.left_out, raise plane.extent, or add the surface beyond it as a [[proxy]]"
        )
    count = numbers["guard_unseen_albedo_px"]
    if count > FEW * touched_px:
        found.append(f"composite: the light changes on {count} px whose albedo was extrapolated, not seen")
    return found


STAGE = Stage(
    "composite",
    compute,
    knobs.Composite,
    inputs={
        "photographs": A.PHOTOGRAPHS,
        "layers": A.LAYERS,
        "occluders": A.OCCLUDERS,
        "camera": A.CAMERA,
        "views": A.VIEWS,
        "plane": A.PLANE,
        "albedo": A.ALBEDO,
        "environment": A.LIGHTING,
        "emitters": A.EMITTERS,
        "proxies": A.LOCAL_PROXIES,
    },
    outputs={"composite": A.COMPOSITE, "display": A.DISPLAY, "plate_display": A.PLATE_DISPLAY},
    live=True,
)
