"""Which settings are tried: ladders of the knobs, the presets, and two-level designs. Data and pure functions."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.run.errors import ManifestError

# Values tried of each knob, quick first where they have an order. Left out: knobs that say what is right rather than
# how well it is done (render.materials, pose.corner_sigma_px, probe.rim, ...), and reflectance.route, whose second
# value takes minutes.
LADDERS: dict[str, tuple[Any, ...]] = {
    "merge.frames": ("extremes", "second", "all"),
    "merge.weights": ("poisson", "optimal"),
    "merge.estimate_exposures": (False, True),
    "develop.demosaic": ("bilinear", "malvar", "menon"),
    "sources.cloud": ("never", "auto", "always"),  # source of the pose, where further views are given
    "probe.width": (256, 512, 1024, 2048),
    "probe.supersample": (1, 3, 4),
    "lights.min_share": (1.0, 0.1, 0.02, 0.005),  # 1: no light is told from the sky
    "lights.max_half_angle_deg": (5.0, 10.0, 20.0),
    "lights.width": ("seen", "unblurred"),
    "plane.left_out": (0.02, 0.008, 0.004, 0.001),
    "plane.find_proxies": ("never", "evidence"),
    "reflectance.model": ("uniform", "textured"),
    "reflectance.texture_px": (256, 512, 1024, 2048),
    "render.samples": (2, 4, 8, 16, 48, 128, 512),
    "render.depth": (2, 3, 4, 6, 10),
    "render.threshold": (0.05, 0.02, 0.008, 0.004, 0.001, 0.0),
    "render.denoise": (False, True),
    "render.light_groups": (False, True),
    "render.strategy": ("difference", "reference"),
    "composite.kind": ("additive", "ratio", "auto"),
    "composite.half": (False, True),
}
Changes = tuple[tuple[str, Any], ...]  # (stage.knob, value), sorted
# Two-level designs of few runs: for k factors, the columns beyond a full factorial of the first ones are products of
# those (Box, Hunter & Hunter 2005, table 6.22). No main effect is mixed with an interaction of two factors.
GENERATORS: dict[int, tuple[int, tuple[tuple[int, ...], ...]]] = {
    1: (1, ()),
    2: (2, ()),
    3: (3, ()),
    4: (3, ((0, 1, 2),)),
    5: (4, ((0, 1, 2, 3),)),
    6: (4, ((0, 1, 2), (1, 2, 3))),
    7: (4, ((0, 1, 2), (1, 2, 3), (0, 2, 3))),
    8: (4, ((1, 2, 3), (0, 2, 3), (0, 1, 2), (0, 1, 3))),
}
MOST_FACTORS = max(GENERATORS)


@dataclass(frozen=True)
class Point:
    """One setting to be measured: a preset, knobs changed from it, and what it is for."""

    label: str
    kind: str  # "base", "repeat", "preset", "knob" or "design"
    quality: str
    changes: Changes = ()

    @property
    def switches(self) -> list[str]:
        """As ``--set`` takes them."""
        return [f"{knob}={value if isinstance(value, str) else json.dumps(value)}" for knob, value in self.changes]


def label_of(changes: Changes) -> str:
    """``stage.knob=value`` of every change."""
    return " ".join(Point("", "", "", changes).switches)


def singles(base: Mapping[str, Mapping[str, Any]], quality: str, knobs: Iterable[str]) -> list[Point]:
    """Each knob alone at every value of its ladder that is not the base's. ``base``: stage -> knob -> value."""
    points = []
    for knob in knobs:
        stage, name = knob.split(".")
        for value in LADDERS[knob]:
            if value != base[stage][name]:
                points.append(Point(label_of(((knob, value),)), "knob", quality, ((knob, value),)))
    return points


def chosen_knobs(text: str | None) -> list[str]:
    """Knobs of ``a.b,c.d``; all with a ladder when nothing is said. Raises ManifestError."""
    if text is None:
        return list(LADDERS)
    names = [name.strip() for name in text.split(",") if name.strip()]
    if unknown := [name for name in names if name not in LADDERS]:
        raise ManifestError(f"--knobs: is {', '.join(unknown)}; expected names of {', '.join(LADDERS)}")
    return names


def without_effect(knobs: Iterable[str], views: bool) -> dict[str, str]:
    """Of these knobs, those that can change nothing in a capture, and why. ``views``: whether it has further views."""
    return {knob: "the capture has no further views" for knob in knobs if knob == "sources.cloud" and not views}


def design(factors: int) -> list[tuple[bool, ...]]:
    """Runs of a two-level design of that many factors: which are changed. 2, 4 or 8 runs for 1, 2, 3 and 4; else 16.

    Raises ValueError above `MOST_FACTORS`.
    """
    if factors not in GENERATORS:
        raise ValueError(f"design: {factors} factors; expected 1 to {MOST_FACTORS}")
    full, products = GENERATORS[factors]
    runs = []
    for signs in itertools.product((-1, 1), repeat=full):
        extra = [_product(signs, columns) for columns in products]
        runs.append(tuple(sign > 0 for sign in (*signs, *extra)))
    return runs


def _product(signs: tuple[int, ...], columns: tuple[int, ...]) -> int:
    """Of the columns, with the sign that leaves nothing changed where none of them is."""
    result = (-1) ** (len(columns) + 1)
    for column in columns:
        result *= signs[column]
    return result


def combinations(levels: Mapping[str, Any], quality: str, known: Iterable[Changes] = ()) -> list[Point]:
    """The design over knobs and the value each is changed to; runs that are ``known`` already are left out."""
    done = {(), *known}
    points = []
    for run in design(len(levels)) if levels else []:
        changes = tuple(sorted((knob, value) for (knob, value), on in zip(levels.items(), run, strict=True) if on))
        if changes not in done:
            points.append(Point(label_of(changes), "design", quality, changes))
    return points
