"""What a setting will cost and how far its picture will be off, from a pilot of the capture: laws, and their solution.

Two figures, as `insitu evaluate` has them: the relative error of object pixels, and that of the change that shadows
and thrown light make; each the median over its pixels. The one number is the larger. Independent parts add as squares:

sampling    noise over the samples n, from differences of pilot renders of other samples and seeds; beyond them n^-1/2
map         c / w over the probe's width w, from two pilot renders under the map and under it at half its width
lamp        what the stated sigmas of the lamps' flux do to a pixel, by a pilot render without each; the same for all
            settings, as how a photograph samples a lamp is not the map's doing
stated      the other standard uncertainties of the stages before (exposures, ball, light, plate), for all settings

Of the last two, `EXPECTED` of the standard uncertainty: the error that a run has in the mean, not its root mean square.
Of what is no more than bounded (near field, what a photograph cannot show) nothing is in it. Costs are CPU seconds of
all threads, of the stages up to the composite.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.run.live import OFFER_SHARE

FIGURES = ("object", "shadow")
SAMPLES = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)  # the last is final's
WIDTHS = (256, 512, 1024, 2048)  # likewise
# What goes with the samples: (up to, threshold, depth), as in the presets of as many; and with the width: supersample.
TIERS = ((16, 0.008, 4), (256, 0.004, 6), (math.inf, 0.001, 10))
SUPERSAMPLES = ((512, 2), (1024, 3), (math.inf, 4))
PILOT_WIDTH = 512
# Share of a stage's CPU at `PILOT_WIDTH` that grows with the texels of map and texture (docs/figures.md: 512 to 2048).
GROWING = {"probe": 0.155, "lights": 1.0, "reflectance": 0.41}
# CPU seconds, and per megapixel of the plate, on the bundled desk: of the composite, and of the first picture shown.
COMPOSITE, SHOWN = (0.6, 0.8), (0.5, 3.0)
STARTING = 0.5  # CPU seconds of a render whatever its size: shapes, tables of the light
BY_SAMPLES = 0.5  # of a pilot render of few samples: what grows with them; measured as soon as there are two
# Beyond so many samples pixels leave as they get quiet, and their samples grow with this power of what is asked for. A
# sample asked for is taken by .34, .33, .23 of desk's pixels at 8, 48, 512 and .36, .33, .26 of kitchen_table's.
LEAVING_FROM, LEAVING = 32, 0.87
FEWER_TRACED = 0.25  # the traced share falls with a picture's side to this power: desk at 256, 512, 1024 px
RATE = 0.5  # noise falls with the samples to this power: variances of independent samples add
# E|x| of a normal error of one sigma. What all pixels share moves their median as a whole: a run errs by its absolute
# value, in the mean this much of its standard uncertainty. Over many pixels sampling is a median already.
EXPECTED = math.sqrt(2 / math.pi)
LEAST = 1e-9  # difference of two pictures, so that logarithms exist


@dataclass(frozen=True)
class Setting:
    """What is solved for. Threshold and depth go with the samples, the ground's texture with the map's width."""

    samples: int
    width: int

    @property
    def changes(self) -> dict[str, Any]:
        """``stage.knob`` -> value."""
        _, threshold, depth = next(tier for tier in TIERS if self.samples <= tier[0])
        return {
            "probe.width": self.width, "probe.supersample": next(n for most, n in SUPERSAMPLES if self.width <= most),
            "reflectance.texture_px": self.width, "render.samples": self.samples, "render.threshold": threshold,
            "render.depth": depth,
        }  # fmt: skip


FINEST = Setting(SAMPLES[-1], WIDTHS[-1])


@dataclass(frozen=True)
class Noise:
    """Noise over samples: logarithms interpolated between ``anchors`` (samples, noise), and `RATE` beyond them."""

    anchors: tuple[tuple[int, float], ...]

    def at(self, samples: float) -> float:
        """The noise of a picture of so many samples."""
        (n0, m0), (n1, m1) = self.anchors[0], self.anchors[-1]
        if samples <= n0 or samples >= n1:
            n, m = (n0, m0) if samples <= n0 else (n1, m1)
            return m * (samples / n) ** -RATE
        pairs = itertools.pairwise(self.anchors)
        (n0, m0), (n1, m1) = next(pair for pair in pairs if samples <= pair[1][0])
        return math.exp(math.log(m0) + math.log(m1 / m0) * math.log(samples / n0) / math.log(n1 / n0))


def noise_of(differences: Mapping[tuple[int, int], float]) -> Noise:
    """Noise from how far pictures of n and 4 n samples or so are apart: ``d^2 = m_n^2 + m_4n^2``.

    Of the last pair by `RATE`. A pair before shares a picture with the next; the rest of ``d^2`` is its first one's, at
    least what the next has. Raises ValueError without any pair.
    """
    pairs = sorted(differences.items(), reverse=True)
    if not pairs:
        raise ValueError("noise_of: no difference")
    (few, many), apart = pairs[0]
    noise = max(apart, LEAST) / math.sqrt(1 + (few / many) ** (2 * RATE))
    anchors = [(many, noise * (few / many) ** RATE), (few, noise)]
    for (fewer, _), wider in pairs[1:]:
        noise = max(math.sqrt(max(wider**2 - noise**2, 0.0)), noise)
        anchors.append((fewer, noise))
    return Noise(tuple(sorted(anchors)))


@dataclass(frozen=True)
class Law:
    """``scale * n ** power``; from ``turn`` on it grows by the power `LEAVING`, or its own where that is less."""

    scale: float
    power: float
    turn: float

    def at(self, n: float) -> float:
        """The value at n."""
        return self.scale * min(n, self.turn) ** self.power * max(n / self.turn, 1.0) ** min(self.power, LEAVING)


def line_of(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Intercept and slope, neither negative, of the least-squares line through (x, y)."""
    x, y = ([point[axis] for point in points] for axis in (0, 1))
    mean_x, mean_y = math.fsum(x) / len(x), math.fsum(y) / len(y)
    spread = math.fsum((value - mean_x) ** 2 for value in x)
    slope = math.fsum((u - mean_x) * (v - mean_y) for u, v in points) / spread if spread else 0.0
    if slope <= 0:
        return 0.0, mean_y / mean_x
    start = mean_y - slope * mean_x
    return (start, slope) if start >= 0 else (0.0, math.fsum(u * v for u, v in points) / math.fsum(u * u for u in x))


@dataclass(frozen=True)
class Model:
    """A capture's laws. Built by `fitted`."""

    sampling: dict[str, Noise]  # figure -> noise over samples
    width: int  # of the pilot's map
    map_error: dict[str, float]  # figure -> error at that width
    lamp: dict[str, float]  # figure -> standard uncertainty by the flux of lamps
    stated: dict[str, float]  # figure -> standard uncertainty
    stages: dict[str, float]  # CPU seconds of the pilot's stages
    work: Law  # pixel samples of a whole render
    render: tuple[float, float]  # CPU seconds of a whole render, and per pixel sample
    megapixels: float

    def parts(self, setting: Setting) -> dict[str, dict[str, float]]:
        """Of each figure {sampling, map, lamp, stated, all}."""
        found = {}
        for figure, noise in self.sampling.items():
            parts = {
                "sampling": noise.at(setting.samples),
                "map": self.map_error.get(figure, 0.0) * self.width / setting.width,
                "lamp": EXPECTED * self.lamp.get(figure, 0.0),
                "stated": EXPECTED * self.stated.get(figure, 0.0),
            }
            found[figure] = parts | {"all": math.hypot(*parts.values())}
        return found

    def error(self, setting: Setting) -> float:
        """The larger of the figures."""
        return max(part["all"] for part in self.parts(setting).values())

    def cost(self, setting: Setting) -> dict[str, float]:
        """CPU seconds per stage up to the composite."""
        texels = (setting.width / self.width) ** 2
        costs = {name: spent * (1 + GROWING.get(name, 0.0) * (texels - 1)) for name, spent in self.stages.items()}
        shown, composite = (start + more * self.megapixels for start, more in (SHOWN, COMPOSITE))
        sampled = self.render[0] + self.render[1] * self.work.at(setting.samples)
        costs["render"] = sampled / (1 - OFFER_SHARE) + shown  # later pictures take their share of the time
        costs["composite"] = composite
        return costs

    def seconds(self, setting: Setting) -> float:
        """CPU seconds of the whole chain."""
        return math.fsum(self.cost(setting).values())

    def rest(self, setting: Setting) -> set[str]:
        """Stages that are still to be run after the pilot, which leaves its own at its width."""
        done = self.stages if setting.width == self.width else self.stages.keys() - GROWING.keys()
        return self.cost(setting).keys() - done

    def left(self, setting: Setting) -> float:
        """CPU seconds of these."""
        cost = self.cost(setting)
        return math.fsum(cost[name] for name in self.rest(setting))


def fitted(pilot: Mapping[str, Any]) -> Model:
    """The model of a pilot's record (see `pipeline.trade.pilot`): JSON, so pairs of samples are texts, "2-8"."""
    sampling = {}
    for figure in FIGURES:
        apart = {pair_of(pair): values[figure] for pair, values in pilot["differences"].items()}
        if known := {pair: value for pair, value in apart.items() if value is not None}:
            sampling[figure] = noise_of(known)
    stated = pilot["stated"]
    works = [(run["samples"], run["work"] * pilot["scale"] ** (2 - FEWER_TRACED)) for run in pilot["renders"]]
    return Model(
        sampling=sampling,
        width=pilot["width"],
        map_error={figure: value for figure, value in pilot["map"].items() if value is not None},
        lamp={figure: value for figure, value in pilot["lamps"].items() if value is not None},
        stated={figure: math.hypot(0.0, *parts.values()) for figure, parts in stated.items()},
        stages=pilot["stages"],
        work=growth_of(works),
        render=price_of([(run["work"], run["cpu_seconds"]) for run in pilot["renders"][1:]], pilot["scale"]),
        megapixels=pilot["megapixels"],
    )


def pair_of(text: str) -> tuple[int, int]:
    """(2, 8) of "2-8"."""
    few, many = text.split("-")
    return int(few), int(many)


def price_of(renders: Sequence[tuple[float, float]], scale: int) -> tuple[float, float]:
    """CPU seconds of a whole picture without its samples, and per pixel sample, from small ones (work, CPU seconds).

    What does not grow with the samples grows with the picture's area, but for `STARTING`.
    """
    if len(renders) > 1:
        flat, each = line_of(renders)
    else:
        ((work, seconds),) = renders
        flat, each = (1 - BY_SAMPLES) * seconds, BY_SAMPLES * seconds / work
    return flat + (scale**2 - 1) * max(flat - STARTING, 0.0), each


def growth_of(works: Sequence[tuple[float, float]]) -> Law:
    """The power law of pixel samples over samples, through the first and the last render; at most proportional.

    It holds as far as the last render, and to `LEAVING_FROM` samples.
    """
    (n0, w0), (n1, w1) = works[0], works[-1]
    power = min(math.log(w1 / w0) / math.log(n1 / n0), 1.0) if n1 > n0 else 1.0
    return Law(w1 / n1**power, power, max(n1, LEAVING_FROM))


def candidates(fixed: Mapping[str, Any]) -> list[Setting]:
    """All settings, those that the user fixed at their value, cheapest first by samples and width."""
    samples = (int(fixed["render.samples"]),) if "render.samples" in fixed else SAMPLES
    widths = (int(fixed["probe.width"]),) if "probe.width" in fixed else WIDTHS
    return [Setting(n, width) for n in samples for width in widths]


def cheapest(model: Model, among: Iterable[Setting], error: float) -> Setting | None:
    """The one that costs least of those that err by at most ``error``; None when none does."""
    able = [setting for setting in among if model.error(setting) <= error]
    return min(able, key=lambda setting: (model.seconds(setting), model.error(setting)), default=None)


def best_within(model: Model, among: Iterable[Setting], seconds: float) -> Setting | None:
    """The one that errs least of those whose work that is still to be done takes at most ``seconds``; or None."""
    able = [setting for setting in among if model.left(setting) <= seconds]
    return min(able, key=lambda setting: (model.error(setting), model.seconds(setting)), default=None)
