"""A pilot of a capture: its stages up to the plane, once, and a few small renders that differ in one thing each.

The renders see the plate through a camera of fewer pixels. Two of few samples tell how fast sampling converges (the
noise that the denoiser leaves, which no formula gives); a third, of more, is made only when the first two do not reach
what is asked. One under a map of half the width, repeated to the same texels so that its paths stay the same, tells
what the map's width is worth. One without each lamp that may matter tells what an error of its flux does to a pixel: in
its shadow little, as the plate holds the sum of all light, which is not in doubt.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.image import metrics
from pipeline.light.environment import total_energy
from pipeline.run.artifacts import CAMERA, EMITTERS, HARMONICS, PHOTOGRAPHS
from pipeline.run.evidence import not_covered
from pipeline.run.runner import Build
from pipeline.trade.model import Setting
from pipeline.types import Camera, Emitter, Occluder, Raster

LONGEST_PX = 512  # of the pilot's pictures
FEW, MORE = (2, 8), 32  # samples
MAP_SAMPLES = FEW[-1]  # of the pair under two maps
SEED = 1_000  # far from the run's, so that its picture's noise is not the pilot's
LAMPS = 3  # at most, of which each costs a render
WEAK = 0.1  # of the largest sigma of flux: a lamp below it is left out, 0.5 % of the variance
UNLIT = 1e-3  # of the light's energy: what a lamp leaves below it is black, and shows a renderer nothing
LEAST_PX = 50  # pixels of which a median is taken; fewer are no figure
SHADOW, GROW = metrics.SHADOW, metrics.GROW
BOXED = metrics.BOX  # pixels along a box, over which noise that is independent averages


def factor_of(camera: Camera) -> int:
    """How many pixels of the plate, along a side, become one of the pilot's."""
    return max(1, math.ceil(max(camera.width, camera.height) / LONGEST_PX))


def smaller(camera: Camera, factor: int) -> Camera:
    """The camera with pixels ``factor`` times as large; what does not fill a pixel is cut off."""
    return camera.model_copy(
        update={
            "width": camera.width // factor, "height": camera.height // factor, "fx": camera.fx / factor,
            "fy": camera.fy / factor, "cx": camera.cx / factor, "cy": camera.cy / factor,
        }
    )  # fmt: skip


def shrunk(raster: Raster, factor: int) -> Raster:
    """Means over ``factor`` x ``factor`` pixels; masks by their largest. Variances stay those of one pixel.

    A pilot's pixel is to look as noisy as the plate's own: by that noise the render decides where to stop.
    """
    channels = {}
    for name, values in raster.channels.items():
        height, width = (size // factor for size in values.shape)
        cells = values[: height * factor, : width * factor].reshape(height, factor, width, factor)
        channels[name] = cells.max((1, 3)) if values.dtype.kind == "u" else cells.mean((1, 3), dtype=np.float32)
    return Raster(channels, raster.space, raster.attributes)


def coarser(environment: Raster, emitters: list[Emitter]) -> Raster:
    """The sky at half the map's width, each texel repeated; an odd edge is continued. Lamps stay as they are drawn."""
    rows, columns = environment.shape
    lamps = np.concatenate([np.zeros(0, int), *(np.asarray(one.texels, int) for one in emitters)])
    sky = {name: np.array(values) for name, values in environment.channels.items()}
    for values in sky.values():
        for one in emitters:
            texels = np.asarray(one.texels, int)
            values.ravel()[texels] = values.ravel()[texels].min(initial=np.inf)
    half = shrunk(Raster(sky, environment.space), 2).channels
    whole = {name: values.repeat(2, 0).repeat(2, 1) for name, values in half.items()}
    channels = {
        name: np.pad(values, ((0, rows - values.shape[0]), (0, columns - values.shape[1])), "edge")
        for name, values in whole.items()
    }
    for name, values in channels.items():
        values.ravel()[lamps] = environment[name].ravel()[lamps]
    return Raster(channels, environment.space, environment.attributes)


def differences(layers: Raster, other: Raster) -> dict[str, float | None]:
    """How far layers (of `pipeline.run.artifacts.LAYERS`) are from others, as `insitu evaluate` weighs a composite.

    ``object``: median relative difference where an object covers the pixel; ``shadow``: of the change's 5x5 means where
    that is over 5 %. None for fewer than `LEAST_PX` pixels.
    """
    inside, shown = figures_of(layers, other)
    by_pixel = metrics.relative(layers.rgb("obj") - other.rgb("obj"), other.rgb("obj"))
    ours, theirs = changed(layers), changed(other)
    return {
        "object": _median(by_pixel[inside]),
        "shadow": _median(metrics.relative(ours - theirs, theirs)[shown]),
    }


def figures_of(layers: Raster, other: Raster) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (H, W) inside an object, and of shadows, as `insitu evaluate` has them; others are the truth."""
    from scipy.ndimage import binary_dilation, binary_erosion

    alpha, change = other["obj.A"], changed(other)
    inside = binary_erosion((alpha > 0.99) & (layers["obj.A"] > 0.99), np.ones((3, 3)), border_value=1)
    shown = metrics.relative(change, metrics.box(other.rgb("without"))) > SHADOW
    shown &= ~binary_dilation(alpha > 0, np.ones((GROW, GROW))) & np.isfinite(change).all(-1)
    return inside, shown


def changed(layers: Raster) -> np.ndarray:
    """5x5 means (H, W, 3) of the change that shadows and thrown light make."""
    return metrics.box(layers.rgb("lost") + layers.rgb("gained"))


def by_lamps(layers: Raster, dark: Sequence[tuple[np.ndarray, Raster]]) -> dict[str, float | None]:
    """What relative sigmas (3,) of the flux of lamps do to both figures; ``dark``: each with layers without that lamp.

    All light adds up, so an object's pixel follows a lamp by its share in it. A shadow's change is laid on the plate as
    a ratio to the light there, P c / B: it follows by ``c' / c - B' / B``, parts of the lamp in change c and light B.
    Lamps err independently: root of the sum of squares at each pixel, of which the median is taken.
    """
    names = ("object", "shadow")
    if not dark:
        return dict.fromkeys(names, 0.0)
    squares = {name: np.zeros((*layers.shape, 3)) for name in names}
    whole = {"obj": layers.rgb("obj"), "change": changed(layers), "without": metrics.box(layers.rgb("without"))}
    for sigma, without in dark:
        less = {"obj": without.rgb("obj"), "change": changed(without), "without": metrics.box(without.rgb("without"))}
        part = {name: whole[name] - less[name] for name in whole}  # the lamp's
        lit = whole["without"] > 0
        light = np.divide(part["without"], whole["without"], out=np.zeros(lit.shape), where=lit)
        squares["object"] += (sigma * part["obj"]) ** 2
        squares["shadow"] += (sigma * (part["change"] - light * whole["change"])) ** 2
    inside, shown = figures_of(layers, layers)
    off = {name: np.sqrt(values) for name, values in squares.items()}
    return {
        "object": _median(metrics.relative(off["object"], whole["obj"])[inside]),
        "shadow": _median(metrics.relative(off["shadow"], whole["change"])[shown]),
    }


def unsure(emitters: list[Emitter]) -> list[int]:
    """Which emitters are rendered without: those whose sigma of flux is largest, at most `LAMPS`."""
    sizes = [float(np.linalg.norm(np.where(np.isfinite(e.irradiance_sigma), e.irradiance_sigma, 0))) for e in emitters]
    order = sorted(range(len(sizes)), key=lambda index: -sizes[index])
    return [index for index in order if sizes[index] > WEAK * sizes[order[0]]][:LAMPS]


def sigma_of(emitter: Emitter) -> np.ndarray:
    """(3,) relative sigma of a lamp's flux; of channels without a finite one, or without light, zero."""
    sigma, value = np.asarray(emitter.irradiance_sigma, float), np.asarray(emitter.irradiance, float)
    known = np.isfinite(sigma) & (value > 0)
    return np.divide(sigma, value, out=np.zeros(3), where=known)


def flux_sigma(build: Build) -> float:
    """Relative sigma of the flux of the lamp that is least sure, as a build states it; 0 without lamps."""
    emitters = build.value(EMITTERS)
    return share_of(emitters[0].irradiance_sigma, emitters[0].irradiance) if emitters else 0.0


def without_lamp(environment: Raster, emitter: Emitter) -> Raster:
    """The map with the texels of an emitter black."""
    inside = np.zeros(environment.shape, bool)
    inside.ravel()[np.asarray(emitter.texels, int)] = True
    channels = {
        name: np.where(inside, np.float32(0), values) if name in "RGB" else values
        for name, values in environment.channels.items()
    }
    return Raster(channels, environment.space, environment.attributes)


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if values.size >= LEAST_PX else None


class Pilot:
    """Small renders of a build whose stages before the render are run, and the record of them.

    ``build``: settings at the pilot's width. ``record`` is JSON: width of the map, scale (pixels of the plate along a
    side of one of the pilot's), megapixels, stages [CPU s], renders, differences, map, lamps, flux_sigma, stated,
    bounds, wall over CPU seconds, and the CPU seconds that all of it took, the stages' included.
    """

    def __init__(self, build: Build, record: dict[str, Any] | None = None) -> None:
        self.build = build
        self.record: dict[str, Any] = record or {}
        self.layers: dict[int, Raster] = {}
        self.inputs: dict[str, Any] = {}
        self.warm_seconds = 0.0

    def begin(self) -> None:
        """Run the stages, and the renders of `FEW` samples."""
        cpu, start = time.process_time(), time.perf_counter()
        records = self._prepared()
        plate = self.build.value(PHOTOGRAPHS)["plate"]
        self.record = {
            "width": self.build.settings.params["probe"]["width"],
            "scale": factor_of(self.build.value(CAMERA)),
            "megapixels": plate.shape[0] * plate.shape[1] / 1e6,
            "stages": {name: found["cpu_seconds"] for name, found in records.items()},
            "renders": [self._measured(samples) for samples in FEW],
            "differences": {"-".join(map(str, FEW)): differences(*(self.layers[samples] for samples in FEW))},
            "map": differences(self._under_coarse_map(), self.layers[MAP_SAMPLES]),
            "lamps": self._by_lamps(),
            "flux_sigma": flux_sigma(self.build),
            "stated": stated(self.build),
            "bounds": not_covered(records),
        }
        last = self.record["renders"][-1]
        last["cpu_seconds"] = min(last["cpu_seconds"], self.warm_seconds)
        spent = time.process_time() - cpu
        self.record |= {"cpu_seconds": spent, "wall_over_cpu": (time.perf_counter() - start) / spent}

    @property
    def is_short(self) -> bool:
        """Whether `extend` can still tell something."""
        return len(self.record["renders"]) == len(FEW)

    def extend(self) -> None:
        """One render of `MORE` samples, against the last of `FEW`."""
        cpu = time.process_time()
        if FEW[-1] not in self.layers:  # a pilot of an earlier process
            self._prepared()
            self._measured(FEW[-1])
        self.record["renders"] = [*self.record["renders"], self._measured(MORE)]
        self.record["differences"][f"{FEW[-1]}-{MORE}"] = differences(self.layers[FEW[-1]], self.layers[MORE])
        self.record["cpu_seconds"] += time.process_time() - cpu

    def _prepared(self) -> dict[str, dict[str, Any]]:
        """Run the stages before the render, and make its inputs small; the stages' records."""
        build = self.build
        before = build.graph.upto("render")[:-1]
        build.run_all(before, lambda *_: None)
        inputs = {argument: build.value(artifact) for argument, artifact in build.graph["render"].inputs.items()}
        camera, plate = inputs["camera"], inputs["photographs"]["plate"]
        factor = factor_of(camera)
        self.inputs = inputs | {
            "camera": smaller(camera, factor),
            "photographs": {"plate": shrunk(plate, factor)},
            "occluders": [item for item in inputs["occluders"] if _is_mesh(item)],  # a mask has the plate's size
        }
        return {stage.name: build.record(stage.name) or {} for stage in before}

    def _measured(self, samples: int) -> dict[str, float]:
        """Render, keep the layers, and say what it took and how noisy it was."""
        cpu = time.process_time()
        layers, numbers = self._render(samples)
        spent = time.process_time() - cpu
        self.layers[samples] = layers
        traced = numbers.get("traced_fraction", 0.0) * layers.shape[0] * layers.shape[1]
        return {
            "samples": samples,
            "cpu_seconds": spent,
            "work": max(traced * numbers.get("samples_per_traced_pixel", samples), 1.0),
            "noise": numbers.get("object_noise_rel", 0.0),
        }

    def _under_coarse_map(self) -> Raster:
        """Layers of `MAP_SAMPLES` under the map at half its width. Compiled already: its CPU is that render's price."""
        cpu = time.process_time()
        layers, _ = self._render(
            MAP_SAMPLES, {"environment": coarser(self.inputs["environment"], self.inputs["emitters"])}
        )
        self.warm_seconds = time.process_time() - cpu
        return layers

    def _by_lamps(self) -> dict[str, float | None]:
        """What the stated sigmas of the lamps' flux do to both figures, by layers of `MAP_SAMPLES` without each."""
        lamps, environment, layers, dark = self.inputs["emitters"], self.inputs["environment"], self.layers, []
        for index in unsure(lamps):
            others = [lamp for other, lamp in enumerate(lamps) if other != index]
            rest = without_lamp(environment, lamps[index])
            if total_energy(rest.rgb()).sum() <= UNLIT * total_energy(environment.rgb()).sum():
                black = {name: np.zeros_like(values) for name, values in layers[MAP_SAMPLES].channels.items()}
                without = Raster(black, layers[MAP_SAMPLES].space)
            else:
                without, _ = self._render(MAP_SAMPLES, {"environment": rest, "emitters": others})
            dark.append((sigma_of(lamps[index]), without))
        return by_lamps(layers[MAP_SAMPLES], dark)

    def _render(self, samples: int, instead: Mapping[str, Any] | None = None) -> tuple[Raster, dict[str, Any]]:
        """Layers of the small picture, and the stage's numbers; some inputs ``instead`` of the capture's."""
        build, inputs = self.build, self.inputs | dict(instead or {})
        changes = Setting(samples, 0).changes
        knobs = {knob.removeprefix("render."): value for knob, value in changes.items() if knob.startswith("render.")}
        params = build.settings.params["render"] | knobs | {"seed": SEED + samples}
        result = build.graph["render"].compute(**inputs, params=build.knobs["render"].model_validate(params))
        return result.outputs["layers"], result.numbers


def _is_mesh(item: Occluder) -> bool:
    return item.mask_file is None


def stated(build: Build) -> dict[str, dict[str, float]]:
    """Figure -> {source: relative standard uncertainty}, from what the stages before the render say.

    A scale of the light moves the objects and leaves shadows, which are ratios. Noise and interpolation of the plate
    reach a shadow over a box of pixels.
    """
    merge, develop, probe = (
        (build.record(name) or {"numbers": {}})["numbers"] for name in ("merge", "develop", "probe")
    )
    harmonics = build.value(HARMONICS)
    light = share_of(harmonics.sigma[0], harmonics.coefficients[0])
    interpolated = (develop.get("interpolation") or {}).get("median_rel") or 0.0
    return {
        "object": {
            "light": light,
            "exposures": float(merge.get("largest_sigma") or 0.0),
            "ball's reflectance": float(np.median((probe.get("reflectance") or {}).get("sigma_rel") or 0.0)),
        },
        "shadow": {
            "light": light,
            "plate's noise": noise_of(build.value(PHOTOGRAPHS)["plate"]) / BOXED,
            "plate's interpolation": float(interpolated) / BOXED,
        },
    }


def share_of(sigma: np.ndarray, value: np.ndarray) -> float:
    """Median over channels of a relative uncertainty; of channels without a value, nothing."""
    known = np.isfinite(sigma) & (value > 0)
    return float(np.median(sigma[known] / value[known])) if known.any() else 0.0


def noise_of(plate: Raster) -> float:
    """Median relative standard deviation of a pixel, over every 16th pixel with a finite variance."""
    rgb, variance = plate.rgb()[::4, ::4], plate.rgb("variance")[::4, ::4]
    known = np.isfinite(variance).all(-1) & (rgb > 0).all(-1)
    return float(np.median(np.sqrt(variance[known]).mean(-1) / rgb[known].mean(-1))) if known.any() else 0.0
