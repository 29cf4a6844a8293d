"""How far each pixel can be trusted: the stated uncertainties of all stages, carried to the composite.

Independent per pixel: the plate's noise and what sampling and denoising left of the render. Shared: a few modes, each
exported as the change of the composite per standard uncertainty (scale of the light, flux and width of lamps, the sky
in lobes, turns of the map, pose and lens, softness of the plate). Light enters linearly and is rendered once per
pattern, few pixels, few samples (`pipeline.budget.response`); patterns too weak to matter are left out and said.
``sigma`` is relative to the plate's own scale: what plate and light share (the capture's one unit) is no error here.
Limits: first order; what the objects reflect is taken as wished; what no stage states an uncertainty for is named in
``not_covered``, in its words.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.budget import geometry, light, pixels
from pipeline.budget.response import DIMMER, STEP_RAD, Grid, Layers, Response, Seen, points_on, rendered
from pipeline.conventions import ACESCG
from pipeline.light.alike import shared_sigma_of
from pipeline.light.environment import irradiance, resize_environment
from pipeline.light.placed import is_placed, without_placed
from pipeline.run import artifacts as A
from pipeline.run.evidence import not_covered
from pipeline.run.masks import masks_of
from pipeline.run.stage import Stage
from pipeline.transport import differential as d
from pipeline.transport.placing import place_objects
from pipeline.transport.region import Window
from pipeline.transport.scene import Worlds, build_worlds, relit
from pipeline.transport.softened import SOFTNESS, softer
from pipeline.transport.trace import LensRays
from pipeline.types import Balance, BallFit, Camera, Emitter, Occluder, Plane, Proxy, Raster, Result, Surface, View
from stages import knobs

DEPTH = 4  # vertices of a path: what more bounces would change of a ratio is of second order
FOLLOWED_CHANGE = 0.01  # of LS_noobj: a change of light that is worth a ray of the budget


def compute(
    wishes: dict[str, Any], camera: Camera, views: dict[str, View], photographs: dict[str, Raster],
    balance: dict[str, Balance], balls: dict[str, BallFit], environment: Raster, emitters: list[Emitter], plane: Plane,
    albedo: Raster, surface: Surface, local_proxies: list[Proxy], occluders: list[Occluder], layers: Raster,
    composite: Raster, records: dict[str, Any], params: knobs.Uncertainty,
) -> Result:  # fmt: skip
    """Sigma, its parts and the shared modes, plate-sized, ACEScg; and the budget by source."""
    plate = photographs["plate"]
    mul, free = composite.rgb("mul"), in_sight(occluders, plate.shape)
    on_lost, on_gained = slopes(layers, plate, records, free)
    size = np.abs(layers.rgb("lost")) + np.abs(layers.rgb("gained"))
    share = np.divide(np.abs(layers.rgb("lost")), size, out=np.full(size.shape, 0.5), where=size > 0)
    on_change = share * on_lost + (1 - share) * on_gained
    remaining, sampled, intervals = (
        pixels.render_variance(on_change, layers.rgb("without"), composite.rgb("obj"), change, obj * free)
        for change, obj in (
            (layers["noise.change"], layers["noise.obj"]),
            (rms(layers.rgb("variance")), rms(layers.rgb("objvariance"))),
            (pixels.TYPICAL * layers["noise.change"], pixels.TYPICAL * layers["noise.obj"]),
        )
    )
    shown = pixels.plate_variance(mul, plate.rgb("variance"))
    own = {"plate": shown + pixels.plate_variance(mul, interpolated(plate)), "render": remaining}
    means = {"plate": pixels.PLATE_PX * shown, "render": sampled}
    changed = (size > FOLLOWED_CHANGE * layers.rgb("without")).any(-1) & (layers["ground"] > 0)
    wanted = ((layers["obj.A"] > 0) | changed) & (free > 0)
    modes: list[pixels.Mode] = []
    window = (slice(0, 0), slice(0, 0))
    evidence: list[dict[str, Any]] = []
    numbers: dict[str, Any] = {}
    if wishes["object"] and wanted.any():
        grid = Grid.over(wanted, params.pixels)
        window = grid.window
        studio = Studio(
            wishes, camera, views["plate"], environment, emitters, plane, albedo, surface, local_proxies, occluders,
            grid, params.samples, settings(records, "render", "materials", "conserving"),
        )  # fmt: skip
        full = Layers(
            layers.rgb("lost")[window], layers.rgb("gained")[window], composite.rgb("obj")[window], on_lost[window],
            on_gained[window],
        )  # fmt: skip
        followed, left = patterns(environment, emitters, balance, balls, views, params.share)
        modes = light_modes(studio, full, followed)
        modes += geometry_modes(studio, composite, plate, params.share)
        modes += softness_modes(composite, plate, str(layers.attributes.get(SOFTNESS, "0 0")), window)
        numbers = {"step_px": grid.step, "traced_px": int(grid.chosen.sum()), "followed": [p.name for p in followed]}
        evidence = reasons(followed, left, params.share)
    picture = composite.rgb()
    typical = own | {"render": intervals}
    variance = pixels.total_variance(list(typical.values()), modes, window)
    fall = pixels.waterfall(picture, plate.rgb(), composite["obj.A"], own, means, modes, window)
    unknown = int((~np.isfinite(variance)).any(-1).sum())
    numbers |= {"unknown_px": unknown, "modes": {mode.name: mode.source for mode in modes}}
    numbers |= {f"{region}_sigma_rel": part["pixel_rel"]["total"] for region, part in fall.items()}
    numbers |= {f"{region}_mean_sigma_rel": part["mean_rel"]["total"] for region, part in fall.items()}
    parts = {"sigma": np.sqrt(variance), **{name: np.sqrt(part) for name, part in typical.items()}}
    parts["of_means"] = np.sqrt(pixels.of_means(shown, sampled))
    level = float(np.median(plate.rgb()))
    channels: dict[str, np.ndarray] = {}
    for layer, rgb in parts.items():
        channels |= pixels.stored(Raster.split(rgb, layer), level)
    for mode in modes:
        for name, values in pixels.stored(Raster.split(mode.change, f"mode_{mode.name}"), level).items():
            channels[name] = np.zeros(picture.shape[:2], values.dtype)
            channels[name][window] = values
    header = {"insitu:modes": ",".join(mode.name for mode in modes), "insitu:sigma": SIGMA}
    raster = Raster(channels, ACESCG, header)
    uncovered = not_covered(records)
    warnings = [f"uncertainty: {unknown} px have none, as the plate is clipped there"] if unknown else []
    warnings += [f"{one.name} is a lower bound: no sigma covers what it lacks" for one in emitters if one.lower_bound]
    outputs = {"uncertainty": raster, "budget": {"regions": fall, "not_covered": uncovered}}
    return Result(outputs, numbers, warnings, evidence)


SIGMA = (
    "sigma^2 = plate^2 + render^2 + sum(mode^2); modes are signed, independent of each other, one sigma each; channels "
    "of flux and sky modes are independent too; of the mean over n px: sum(of_means^2) / n^2 + sum(mean(mode)^2)"
)


class Studio:
    """Worlds of the scene under any light, and renders of the grid's pixels in them."""

    def __init__(
        self, wishes: dict[str, Any], camera: Camera, view: View, environment: Raster, emitters: list[Emitter],
        plane: Plane, albedo: Raster, surface: Surface, proxies: list[Proxy], occluders: list[Occluder], grid: Grid,
        samples: int, materials: str,
    ) -> None:  # fmt: skip
        self.camera, self.view, self.grid, self.samples = camera, view, grid, samples
        self.plane, self.albedo, self.surface = plane, albedo.rgb(), surface
        self.proxies, self.occluders, self.emitters = proxies, occluders, emitters
        self.rgb = np.asarray(environment.rgb(), float)
        self.irradiance = self.upward(self.rgb)
        self.rays = LensRays(camera, view.world_from_camera)
        self.dark = place_objects(wishes, plane, 0.0, materials)[0]  # without what they send out themselves

    def upward(self, rgb: np.ndarray) -> np.ndarray:
        """Irradiance (3,) on the plane."""
        return np.asarray(irradiance(rgb, self.plane.normal[None])[0])

    @functools.cached_property
    def sky(self) -> np.ndarray:
        """The map (H, W, 3) without emitters, on no more than `light.SKY_MAP`."""
        rest = self.rgb.copy()
        for emitter in self.emitters:
            rest.reshape(-1, 3)[np.asarray(emitter.texels, int)] = 0
        return rest if len(rest) <= light.SKY_MAP[0] else resize_environment(rest, *light.SKY_MAP)

    @functools.cached_property
    def under_sky(self) -> Seen:
        """A render under it."""
        return self.seen(self.sky, [])

    @functools.cached_property
    def surfaces(self) -> Worlds:
        """The scene without light."""
        return self.unlit(1.0)

    def unlit(self, ground: float) -> Worlds:
        """The scene without light, its real surfaces ``ground`` times as bright."""
        proxies = [
            proxy if proxy.albedo is None else proxy.model_copy(update={"albedo": ground * proxy.albedo})
            for proxy in self.proxies
        ]
        albedo, night = ground * self.albedo, np.zeros((1, 2, 3))
        return build_worlds(self.plane, albedo, night, self.dark, proxies, (), self.surface, self.occluders)

    def seen(self, rgb: np.ndarray, emitters: list[Emitter]) -> Seen:
        """A render under a map."""
        return self.seen_in(self.surfaces, rgb, emitters)

    def dim(self) -> Seen:
        """A render under the whole light over a `DIMMER` ground."""
        return self.seen_in(self.unlit(DIMMER), self.rgb, self.emitters)

    def seen_in(self, unlit: Worlds, rgb: np.ndarray, emitters: list[Emitter]) -> Seen:
        """A render of a scene under a map, whose lights are gone afterwards: the next one's get the same numbers.

        They are part of a compiled kernel, so that lights of one kind need one kernel.
        """
        return rendered(relit(unlit, rgb, emitters), self.rays, self.grid, self.samples, DEPTH, seed=1)


def interpolated(plate: Raster) -> np.ndarray:
    """(H, W, 3) squared error of the plate's interpolation: each pixel's own, and none of a region's mean."""
    named = "interpolation.R" in plate.channels
    return pixels.INTERPOLATED * plate.rgb("interpolation") if named else np.zeros((*plate.shape, 3), np.float32)


def rms(variance: np.ndarray) -> np.ndarray:
    """(H, W) root of the mean over the channels of (H, W, 3)."""
    return np.asarray(np.sqrt(np.mean(variance, -1)))


def settings(records: dict[str, Any], stage: str, knob: str, otherwise: Any) -> Any:
    """What an earlier stage ran with."""
    return (records.get(stage, {}).get("params") or {}).get(knob, otherwise)


def in_sight(occluders: list[Occluder], shape: tuple[int, int]) -> np.ndarray:
    """(H, W) share of each pixel that no masked real thing covers, as in composite."""
    free = np.ones(shape)
    for mask in masks_of(occluders, shape):
        free *= 1 - mask
    return free


def slopes(layers: Raster, plate: Raster, records: dict[str, Any], free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the composite makes of a unit of lost and of added light, each (H, W, 3), by the rule that it followed."""
    parts = {name: layers.rgb(name) for name in ("obj", "lost", "gained", "without", "variance")}
    change = d.Change(**parts, alpha=layers["obj.A"], ground=layers["ground"])
    kind = settings(records, "composite", "kind", "auto")
    if kind == "auto":
        rule = d.chosen(change, plate.rgb(), plate.rgb("variance"))
    else:
        rule = {"additive": d.additive, "ratio": d.ratio}[kind](change)
    model = change.model
    k = np.divide(plate.rgb(), model, out=np.ones(model.shape), where=model > 0)
    found = []
    for t, gain in ((rule.lost_share, 1.0), (rule.gained_share, rule.gain)):
        found.append((t * k + (1 - t) * gain) * free[..., None])
    return found[0], found[1]


def patterns(
    environment: Raster, emitters: list[Emitter], balance: dict[str, Balance], balls: dict[str, BallFit],
    views: dict[str, View], share: float,
) -> tuple[list[light.Pattern], list[light.Pattern]]:  # fmt: skip
    """Ways for the light to be wrong that are followed to the pixels, and those too weak to matter."""
    shared = shared_sigma_of(environment)
    tied = next((balance[name].covariance for name in [*balls, *balance] if name in balance), None)
    found = light.scale_patterns(light.scale_covariance(shared, tied))
    found += light.flux_patterns(environment, emitters, shared) + light.sky_patterns(environment, emitters, shared)
    found += light.width_patterns(environment, emitters) + light.lamp_turns(environment, emitters)
    if balls:
        found += light.turn_patterns(environment, emitters, light.direction_covariance(balls, views))
    return light.worth_following(found, share)


def light_modes(studio: Studio, full: Layers, followed: list[light.Pattern]) -> list[pixels.Mode]:
    """What each pattern makes of the composite."""
    if not followed:
        return []
    dim = studio.dim()  # before there are other surfaces, as lights
    whole = studio.seen(studio.rgb, studio.emitters)
    response = Response(studio.grid, full, whole, dim)
    modes = []
    for pattern in followed:
        if pattern.factor is not None:
            change = response.of_factor(pattern.factor)
        elif pattern.radiance is not None:
            seen = studio.seen(pattern.radiance, [pattern.emitter] if pattern.emitter else [])
            change = response.of_light(seen, studio.upward(pattern.radiance) / studio.irradiance)
        elif pattern.lamps is not None:
            wide = pattern.lamps
            # Of shadows alone: a highlight narrower than the grid's squares would be met by chance, and keeps its sum.
            lost = studio.seen(wide.rgb, wide.emitters).lost - whole.lost
            apart = Seen(lost, np.zeros_like(lost), np.zeros_like(lost))
            share = (studio.upward(wide.rgb) - studio.irradiance) / studio.irradiance
            change = response.of_turn(apart, share)
        else:
            assert pattern.turn is not None
            angle = float(np.linalg.norm(pattern.turn))
            step = pattern.turn * STEP_RAD / angle
            rest = without_placed(studio.rgb, studio.emitters)
            moved = light.turned(rest, step) + studio.rgb - rest
            apart = studio.seen(moved, moved_emitters(studio, step)).minus(whole)
            # Objects by the sky alone: highlights of lamps are met by the grid's squares by chance, and keep their sum.
            apart = replace(apart, obj=studio.seen(light.turned(studio.sky, step), []).obj - studio.under_sky.obj)
            share = (studio.upward(moved) - studio.irradiance) / studio.irradiance
            change = angle / STEP_RAD * response.of_turn(apart, share)
        modes.append(pixels.Mode(pattern.name, pattern.source, change.astype(np.float32)))
    return modes


def moved_emitters(studio: Studio, turn: np.ndarray) -> list[Emitter]:
    """The emitters on the texels that a turned map has them on; placed ones stay."""
    moved = []
    for emitter in studio.emitters:
        if is_placed(emitter):
            moved.append(emitter)
            continue
        texels = light.turned_texels(np.asarray(emitter.texels, int), studio.rgb.shape[0], turn)
        moved.append(emitter.model_copy(update={"texels": texels}))
    return moved


def geometry_modes(studio: Studio, composite: Raster, plate: Raster, share: float) -> list[pixels.Mode]:
    """What pose and lens make of the composite: objects and shadows are drawn elsewhere, the plate stays."""
    grid, window = studio.grid, studio.grid.window
    points, px, on_object = points_on(studio.surfaces, studio.rays, grid)
    if not len(points):
        return []
    alpha = composite["obj.A"][window][..., None]
    shade = composite.rgb("mul")[window] - 1 + alpha
    obj, add, ground = composite.rgb("obj")[window], composite.rgb("add")[window], plate.rgb()[window]
    modes = []
    for number, field in enumerate(geometry.fields(studio.camera, studio.view, points, px, on_object, share)):
        by_object, by_ground = geometry.shifts(field, grid.shape, window)
        change = geometry.moved_by(obj, by_object) - ground * geometry.moved_by(alpha, by_object)
        change += ground * geometry.moved_by(shade, by_ground) + geometry.moved_by(add, by_ground)
        modes.append(pixels.Mode(f"pose_{number}", "pose", change.astype(np.float32)))
    return modes


def softness_modes(composite: Raster, plate: Raster, stated: str, window: Window) -> list[pixels.Mode]:
    """What a softer plate than the ``stated`` one (b and its sigma, px) would make of all that is drawn into it."""
    px, sigma_px = (float(number) for number in stated.split())
    variance = 2 * px * sigma_px
    if variance <= 0:
        return []
    mul, add, obj = (softer(composite.rgb(layer)[window], variance) for layer in ("mul", "add", "obj"))
    return [pixels.Mode("softness", "softness", (plate.rgb()[window] * mul + add + obj).astype(np.float32))]


def reasons(followed: list[light.Pattern], left: list[light.Pattern], share: float) -> list[dict[str, Any]]:
    """Which patterns of the light were followed, and why the others were not."""
    rows = [
        {
            "term": f"uncertain light: {pattern.name}",
            "modelled": kept,
            "because": f"it may change irradiance by {pattern.bound:.2%}"
            + ("" if kept else f"; all that are left out stay below {share:.0%} of the squared bounds"),
            "could_cost": "nothing: it is a mode" if kept else f"{pattern.bound:.2%} of the light on a surface",
            "bound_rel": pattern.bound,
        }
        for kept, some in ((True, followed), (False, left))
        for pattern in some
    ]
    return rows


STAGE = Stage(
    "uncertainty",
    compute,
    knobs.Uncertainty,
    inputs={
        "wishes": A.WISHES, "camera": A.CAMERA, "views": A.VIEWS, "photographs": A.PHOTOGRAPHS, "balance": A.BALANCE,
        "balls": A.BALLS, "environment": A.LIGHTING, "emitters": A.EMITTERS, "plane": A.PLANE, "albedo": A.ALBEDO,
        "surface": A.SURFACE, "local_proxies": A.LOCAL_PROXIES, "occluders": A.OCCLUDERS, "layers": A.LAYERS,
        "composite": A.COMPOSITE, "records": A.RECORDS,
    },
    outputs={"uncertainty": A.UNCERTAINTY, "budget": A.BUDGET},
)  # fmt: skip
