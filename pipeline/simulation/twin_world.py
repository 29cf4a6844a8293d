"""The two worlds of the spectral twin: wavelengths, light groups, and the place in spectra or in RGB.

Everything of the RGB world is what the camera says of the spectral one: textures and the room's map are evaluated in
Mitsuba's spectral variant, where they are made, and integrated here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.simulation import light, shapes, spectra, surfaces
from pipeline.simulation.photograph import Measure
from pipeline.simulation.scene_file import ObjectModel, SimulatedScene
from pipeline.simulation.sensor import ACES_WHITE_XY, AP1_XY, acescg_from_rec709, xyz_from_rgb
from pipeline.simulation.world import Place, mesh

BINS = 1 << 14  # of the table of wavelengths
UNIFORM_SHARE = 0.3  # of the wavelengths; the rest goes where the curves are
HAT_NM = 5.0  # knots between which smooth reflectances are taken as linear
MAP_WIDTH = 512
TEXEL_M = 0.004
PRINT_PX_PER_MM = 1.0


def daylight(mi: Any, wavelengths: np.ndarray) -> np.ndarray:
    """(N,) of what Mitsuba emits for a grey light of radiance 1."""
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(wavelengths))
    si.wavelengths = mi.Spectrum(mi.Float(wavelengths.astype(np.float32)))
    return np.array(mi.load_dict({"type": "d65"}).eval(si)[0], float)


def photographed(mi: Any, source: Any, si: Any, curves: np.ndarray) -> np.ndarray:
    """(M, 3) of what ``curves`` (3, N) collect from a texture or an emitter at M interactions.

    The spectra are evaluated at knots; between them a texture, or a light relative to D65, is taken as linear.
    """
    knots = np.arange(spectra.WAVELENGTHS[0], spectra.WAVELENGTHS[-1] + 1, HAT_NM)
    hats = np.maximum(0, 1 - np.abs(spectra.WAVELENGTHS - knots[:, None]) / HAT_NM)
    weights = spectra.integrate(curves[:, None] * spectra.illuminant("D65") * hats)  # (3, knots)
    if isinstance(source, mi.Emitter):
        weights = weights / daylight(mi, knots)
    total = np.zeros((1, 3))
    for start in range(0, len(knots), 4):
        some = [float(k) for k in np.resize(knots[start : start + 4], 4)]
        si.wavelengths = mi.Spectrum(*some)
        values = source.eval(si)
        for i in range(min(4, len(knots) - start)):
            total = total + np.array(values[i], float)[:, None] * weights[:, start + i]
    return total


def path(mi: Any, depth: int) -> Any:
    """A path tracer without Russian roulette, so that both worlds take the same turns."""
    return mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})


def rgb_radiance(mi: Any, scene: Any, depth: int) -> Measure:
    """Three values along a ray; one random number is left to the wavelengths of the other world."""
    integrator = path(mi, depth)

    def measure(ray: Any, sampler: Any) -> list[Any]:
        sampler.next_1d()
        value, _, _ = integrator.sample(scene, sampler, ray)
        return [value.x, value.y, value.z]

    return measure


def wavelength_table(curves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths (BINS,) of even fractions in [0, 1), denser where curves (K, N) are large; weights (K, BINS).

    The mean over the fractions of radiance times weight is the integral of radiance times curve.
    """
    shape = (curves / spectra.integrate(curves)[:, None]).mean(0)
    low, high = float(spectra.WAVELENGTHS[0]), float(spectra.WAVELENGTHS[-1])
    fine = np.linspace(low, high, 20 * len(spectra.WAVELENGTHS))
    density = UNIFORM_SHARE / (high - low) + (1 - UNIFORM_SHARE) * np.interp(fine, spectra.WAVELENGTHS, shape)
    total = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2)])
    edges = np.interp(np.linspace(0, 1, BINS + 1), total / total[-1], fine)
    places = (edges[1:] + edges[:-1]) / 2
    weights = [np.interp(places, spectra.WAVELENGTHS, c) * np.diff(edges) * BINS for c in curves]
    return places, np.array(weights)


def spectral_radiance(mi: Any, scene: Any, depth: int, curves: np.ndarray, shift: float = 0.0) -> Measure:
    """Integrals of the radiance along a ray with K curves (K, N); ``shift`` in [0, 1/4) moves the four wavelengths."""
    import drjit as dr

    integrator = path(mi, depth)
    moved = dr.opaque(mi.Float, shift)  # a variable of the kernel: one compilation serves all shifts
    places, weights = wavelength_table(curves)
    wavelengths = mi.Float(places.astype(np.float32))
    table = mi.Float((weights.ravel() / 4).astype(np.float32))

    def measure(ray: Any, sampler: Any) -> list[Any]:
        first = sampler.next_1d() + moved
        fractions = [first + 0.25 * i - dr.floor(first + 0.25 * i) for i in range(4)]
        index = [dr.minimum(mi.UInt32(f * BINS), BINS - 1) for f in fractions]
        ray.wavelengths = mi.Spectrum(*(dr.gather(mi.Float, wavelengths, i) for i in index))
        value, _, _ = integrator.sample(scene, sampler, ray)
        parts = [
            [value[i] * dr.gather(mi.Float, table, index[i] + k * BINS) for i in range(4)] for k in range(len(curves))
        ]
        return [a + b + c + d for a, b, c, d in parts]

    return measure


def spectrum(values: np.ndarray) -> dict[str, Any]:
    """A Mitsuba spectrum of a table (N,)."""
    step = round(HAT_NM / spectra.STEP_NM)
    return {
        "type": "regular",
        "wavelength_min": float(spectra.WAVELENGTHS[0]),
        "wavelength_max": float(spectra.WAVELENGTHS[-1]),
        "values": ",".join(f"{v:.7g}" for v in values[::step]),
    }


def rec709(acescg: np.ndarray) -> np.ndarray:
    """ACEScg to linear Rec.709 float32, what lies outside brought to its border."""
    return np.maximum(acescg @ np.linalg.inv(acescg_from_rec709()).T, 0).astype(np.float32)


def patch_of(model: ObjectModel) -> str:
    """The measured patch that an object is made of."""
    return spectra.nearest_patch(acescg_from_rec709() @ shapes.stored_colour(model))


def grey(part: Any) -> Any:
    """The same description with every colour replaced by its mean, the same in both worlds."""
    if not isinstance(part, dict):
        return part
    if part.get("type") == "rgb":
        return {"type": "uniform", "value": float(np.mean(part["value"]))}
    return {key: grey(value) for key, value in part.items()}


def dim(scene: SimulatedScene) -> SimulatedScene:
    """The scene with coarser textures."""
    table = scene.table.model_copy(update={"texel_m": max(TEXEL_M, scene.table.texel_m)})
    paper = scene.board_print.model_copy(update={"px_per_mm": min(PRINT_PX_PER_MM, scene.board_print.px_per_mm)})
    return scene.model_copy(update={"table": table, "board_print": paper})


def luminance(acescg: Any) -> Any:
    """Relative luminance (...) of ACEScg (..., 3)."""
    return np.asarray(acescg, float) @ xyz_from_rgb(AP1_XY, ACES_WHITE_XY)[1]


def groups(scene: SimulatedScene) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """Maps (H, W, 3) of the room in ACEScg, and of its main window and of its lamps as grey; the spectra of each."""
    facts = scene.light.model_copy(update={"map_width": min(MAP_WIDTH, scene.light.map_width)})
    order = sorted(facts.softbox, key=lambda box: luminance(box.radiance) * box.half_deg[0] * box.half_deg[1])
    rest = [box for box in facts.softbox if not order or box is not order[-1]]
    maps = {"room": light.mitsuba_envmap(facts.model_copy(update={"lamp": [], "softbox": rest}))}
    names: dict[str, tuple[str, ...]] = {"room": ("D65",)}
    black = dict.fromkeys(("wall", "ceiling", "floor"), (0.0, 0.0, 0.0))
    for group, kind, sources in (("window", "softbox", order[-1:]), ("lamps", "lamp", facts.lamp)):
        if not sources:
            continue
        plain = [s.model_copy(update={"radiance": (float(luminance(s.radiance)),) * 3}) for s in sources]
        values = light.mitsuba_envmap(facts.model_copy(update={**black, "softbox": [], "lamp": [], kind: plain}))
        # Mitsuba interpolates a texel's spectrum and its strength apart: black beside a lamp would dim its edge.
        maps[group] = np.maximum(values.mean(-1, keepdims=True), 1e-7 * values.max()) * np.ones(3, np.float32)
        names[group] = spectra.LAMPS if kind == "lamp" else (spectra.nearest_illuminant(np.array(sources[0].radiance)),)
    return maps, names


@dataclass
class Twin(Place):
    """One of the two worlds. ``maps``: RGB textures (H, W, 3) of table, board and room; None in the spectral world."""

    camera: spectra.Camera | None = None
    maps: dict[str, np.ndarray] | None = None
    lights: dict[str, np.ndarray] | None = None
    group: str = "room"

    def pixels(self, name: str) -> dict[str, Any]:
        """The texture of the table or of the board."""
        common = {"type": "bitmap", "filter_type": "bilinear", "wrap_mode": "clamp"}
        if self.maps is not None:
            return {**common, "data": self.mi.TensorXf(self.maps[name].astype(np.float32)), "raw": True}
        is_table = name == "table"
        made = surfaces.table_texture(self.scene.table, self.scene.seed) if is_table else self.print_pixels(name)
        return {**common, "bitmap": self.mi.Bitmap(rec709(made))}

    def base(self, patch: str) -> dict[str, Any]:
        """Reflectance of a measured patch."""
        values = spectra.patches()[patch]
        if self.maps is None:
            return spectrum(values)
        assert self.camera is not None
        return {"type": "rgb", "value": [float(v) for v in self.camera.reflectance(values)]}

    def objects(self) -> dict[str, Any]:
        """Every object, of its patch."""
        made = {}
        for model in self.scene.object:
            bsdf = self.mi.load_dict(
                {
                    "type": "insitu_gltf",
                    "base_color": self.base(patch_of(model)),
                    "metallic": model.metallic,
                    "roughness": model.roughness,
                }
            )
            made[f"object_{model.name}"] = mesh(self.mi, model.name, shapes.placed(model), bsdf)
        return made

    def photographer(self, world_from_camera: np.ndarray) -> dict[str, Any]:
        """As the simulator's, in grey."""
        found: dict[str, Any] = grey(super().photographer(world_from_camera))
        return found

    def room(self) -> dict[str, Any]:
        """The distant light of the current group."""
        assert self.lights is not None
        return {"room": {"type": "envmap", "bitmap": self.mi.Bitmap(self.lights[self.group].astype(np.float32))}}


def group_curves(mi: Any, camera: spectra.Camera, names: dict[str, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Curves (K, N) that make camera_rgb and XYZ of what Mitsuba traces, six for each spectrum of a group."""
    seen = np.concatenate([camera.curves, spectra.observer()]) / daylight(mi, spectra.WAVELENGTHS)
    return {group: np.concatenate([seen * spectra.illuminant(name) for name in some]) for group, some in names.items()}


def rgb_world(place: Twin, camera: spectra.Camera) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Textures and light maps of the RGB world: what the camera makes of the spectral world's."""
    import drjit as dr

    mi, maps = place.mi, {}
    for name in ("table", "board"):
        description = place.pixels(name)
        width, height = description["bitmap"].size()
        u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        si = dr.zeros(mi.SurfaceInteraction3f, width * height)
        si.uv = mi.Point2f(u.ravel().astype(np.float32), v.ravel().astype(np.float32))
        seen = photographed(mi, mi.load_dict(description), si, camera.curves)
        maps[name] = (seen @ camera.acescg_from_camera.T).reshape(height, width, 3)
    assert place.lights is not None
    place.group = "room"
    height, width, _ = place.lights["room"].shape
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, np.arange(height) / (height - 1))
    phi, theta = 2 * np.pi * u.ravel(), np.pi * v.ravel()
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)])
    si = dr.zeros(mi.SurfaceInteraction3f, width * height)
    si.wi = mi.Vector3f(*(-towards).astype(np.float32))
    seen = photographed(mi, mi.load_dict(place.room()["room"]), si, camera.curves)
    lights = {**place.lights, "room": (seen @ camera.acescg_from_camera.T).reshape(height, width, 3)}
    return maps, lights


def table_white(lights: dict[str, np.ndarray]) -> float:
    """Luminance of a white table top under the lights (H, W, 3)."""
    total = sum(lights.values())
    assert isinstance(total, np.ndarray)
    height, width, _ = total.shape
    theta = np.pi * np.arange(height) / (height - 1)
    weight = np.maximum(np.cos(theta), 0) * np.sin(theta) * (np.pi / (height - 1)) * (2 * np.pi / width) / np.pi
    return float((luminance(total) * weight[:, None]).sum())
