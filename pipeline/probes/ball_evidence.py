"""What one capture says about its mirror ball: how it reflects, where it is dirty, how far it is from a sphere."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.image.colour import Space, convert
from pipeline.image.demosaic import ADDED_PX2, METHOD
from pipeline.probes import ball_dirt, ball_shape
from pipeline.probes.ball_pairs import Pairs, Sight, ball_pixels, neighbourhood, pixel_step, plane_pairs
from pipeline.probes.ball_shape import Dents
from pipeline.probes.ball_surface import GLOSS_SIGMA, Measured, Surface, decide, measure, plane_blocks, under_gloss
from pipeline.probes.finding import Found
from pipeline.probes.glass import Glass
from pipeline.probes.observation import Shots, ViewMap
from pipeline.run.errors import NumericalError
from pipeline.run.evidence import TRIED
from pipeline.transport.conductors import preset
from pipeline.types import Raster, View


@dataclass(frozen=True)
class BallEvidence:
    """The surface that is used, dirty pixels (H, W) and dents of the views that show some, and what was measured."""

    surface: Surface
    dirty: dict[str, np.ndarray] = field(default_factory=dict)
    dents: dict[str, Dents] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)


def blur_of(photograph: Raster, view: View) -> float | None:
    """Standard deviation [px] of what a pixel takes in: lens, pixel and demosaicking; None where no print tells."""
    if view.softness_px is None:
        return None
    added = ADDED_PX2[photograph.attributes[METHOD]][0] if METHOD in photograph.attributes else 0.0
    return float(np.sqrt(view.softness_px**2 + added))


def examine(
    shots: Shots, found: dict[str, Found], radius: float, rim: float, glass: Glass | None = None, gloss: bool = False
) -> BallEvidence:  # fmt: skip
    """The ball that was found in some views; ``rim``: outermost radius that is used, as a fraction.

    ``gloss``: the plane's mirror image in the ball is known to have other contrast than the plane.
    """
    facts = shots.facts["probe"]
    sights = {
        name: neighbourhood(
            shots.photographs[name],
            shots.camera_of(name),
            shots.views[name].world_from_camera,
            ball.fit.centre,
            radius,
            glass,
            blur_of(shots.photographs[name], shots.views[name]),
        )
        for name, ball in found.items()
    }
    pairs = {name: plane_pairs(sight, rim) for name, sight in sights.items()}
    given = given_reflectance(facts)
    material = facts.get("material")
    tint = None if material is None else preset(material)[1]
    measured = measure(list(pairs.values()), tint if glass is None else glass)
    measured = under_gloss(measured) if gloss and measured is not None else measured
    surface, warnings = decide(given, material, measured)
    if gloss and surface.source == "measured":
        warnings.append(
            f"reflectance of the ball: measured from a plane with gloss, known to {surface.sigma.max():.0%}; give "
            "probe.reflectance"
        )
    surface = surface if glass is None else replace(surface, glass=glass, tint=None)
    shapes = {name: shots.photographs[name].shape for name in found}
    dented = {}
    for name, sight in sights.items():
        shifts = ball_shape.patch_shifts(plane_pairs(sight, rim, every=True))
        size = found[name].fit.radius_px / sight.binned
        if (one := ball_shape.dents(sight, size, found[name].fit.covariance, shifts)) is not None:
            dented[name] = one
    dirty, spots, tested = find_dirt(sights, pairs, measured, surface, rim, shapes, warnings)
    numbers = {"reflectance": surface_numbers(surface, given, measured), "dirt": spots}
    reasons = [*surface_reasons(surface, measured, gloss), dirt_reason(dirty, tested, measured)]
    return BallEvidence(surface, dirty, dented, numbers, warnings, reasons)


@dataclass(frozen=True)
class Shaped:
    """The maps with the directions' uncertainty that the ball's shape adds; whether only their harmonics are good."""

    maps: dict[str, ViewMap]
    smooth_only: bool
    numbers: dict[str, Any]
    warnings: list[str]
    evidence: list[dict[str, Any]]


def shape(maps: dict[str, ViewMap], dented: dict[str, Dents], glass_sigma: float = 0.0) -> Shaped:
    """What dents, and glass whose thickness leaves directions open by ``glass_sigma`` [rad], do to the views' maps.

    Dents are one ball's, so the view that shows most of them speaks for all; two views that agree better than that
    refute it. Directions that are off by more than `ball_shape.TOO_DENTED` leave nine harmonics and no more. Raises
    NumericalError when nothing finite is known of how far they are off.
    """
    numbers: dict[str, Any] = {name: dent_numbers(one) for name, one in dented.items()}
    names, warnings = list(maps), []
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    bounds = {f"{a}, {b}": ball_shape.second_view_sigma(maps[a], maps[b]) for a, b in pairs}
    seen = [value for value in bounds.values() if np.isfinite(value)]
    sigma = max((one.direction_sigma_rad for one in dented.values()), default=0.0)
    sigma = min([sigma, *seen])
    numbers["second_view_direction_deg"] = {name: float(np.degrees(value)) for name, value in bounds.items()}
    evidence = [dent_reason(dented, sigma, seen)]
    total = float(np.hypot(sigma, glass_sigma))
    if not np.isfinite(total):  # every comparison with it would say: not dented
        raise NumericalError(
            f"ball: directions that it mirrors are off by {np.degrees(sigma):.2g} degrees by dents and "
            f"{np.degrees(glass_sigma):.2g} by its glass, needed finite figures; state probe.glass_mm or probe.material"
        )
    numbers["direction_sigma_deg"] = float(np.degrees(total))
    too_dented = total > ball_shape.TOO_DENTED
    if sigma > 0:
        text = f"the ball is dented: mirrored directions are off by {np.degrees(sigma):.1f} degrees rms"
        warnings.append(
            f"{text}, more than {np.degrees(ball_shape.TOO_DENTED):.1f}; only nine harmonics of the map are kept: soft "
            "light is right, mirror images and hard shadows are not"
            if too_dented
            else f"{text}; the variance says so"
        )
    return Shaped(
        {name: ball_shape.unsure(view, total) if total > 0 else view for name, view in maps.items()},
        too_dented, {"shape": numbers}, warnings, evidence,
    )  # fmt: skip


def dent_numbers(one: Dents) -> dict[str, Any]:
    """Figures of the plane's picture in one view of the ball."""
    return {
        "patches": one.patches, "shift_rms_px": one.rms_px,
        "direction_rms_deg": float(np.degrees(one.direction_rms_rad)),
        "floor_deg": float(np.degrees(one.floor_rad)),
        "centre_shift_mm": (1e3 * one.centre_shift_m).tolist(),
    }  # fmt: skip


def dent_reason(dented: dict[str, Dents], sigma: float, seen: list[float]) -> dict[str, Any]:
    """Whether dents are modelled, and why."""
    if not dented:
        said = "too little texture of the plane is seen in the ball to tell"
    else:
        worst = max(dented.values(), key=lambda one: one.direction_rms_rad / one.floor_rad)
        said = (
            f"the plane is mirrored {np.degrees(worst.direction_rms_rad):.2f} degrees from where a sphere would, a "
            f"perfect ball of this fit {np.degrees(worst.floor_rad):.2f}"
        )
    if seen:
        said += f"; two views leave {np.degrees(min(seen)):.1f} degrees to dents and parallax together"
    off = [one.direction_rms_rad for one in dented.values()] or seen
    return {
        "term": "dents of the ball", "modelled": sigma > 0, "because": said,
        "could_cost": "directions off by twice the surface's tilt; the light's energy hardly",
        **({"bound_deg": float(np.degrees(max(off))), **TRIED} if off else {"no_bound": said}),
    }  # fmt: skip


def find_dirt(
    sights: dict[str, Sight], pairs: dict[str, Pairs], measured: Measured | None, surface: Surface, rim: float,
    shapes: dict[str, tuple[int, int]], warnings: list[str],
) -> tuple[dict[str, np.ndarray], dict[str, Any], int]:  # fmt: skip
    """Masks of dirty pixels in the photographs (``shapes``), figures by view, and how many pixels were comparable."""
    dirty, figures, compared = {}, {}, 0
    marks = _plane_marks(pairs, measured)
    for name, one in sights.items():
        pixels = [pairs[name].pixel[marks[name]]]
        compared += len(marks[name])
        for other in sights.keys() - {name}:
            shared, tested = ball_dirt.shared_spots(one, sights[other], surface, rim)
            pixels.append(shared)
            compared += tested
        step = pixel_step(one)
        mask = ball_dirt.spot_mask(np.unique(np.concatenate(pixels), axis=0), one.picture.shape[:2], step)
        share = float(mask.sum() / (np.pi / 4 * len(ball_pixels(one, step)) * step**2))  # of the disc in its box
        if share > ball_dirt.MOST:
            warnings.append(
                f"{name}: {share:.0%} of the ball is darker than predicted, too much for dirt; nothing is masked; is "
                "probe.reflectance right, and the ball where the fit has it?"
            )
        elif mask.any():
            dirty[name] = unbinned(mask, one, shapes[name])
            figures[name] = {"pixels": int(dirty[name].sum()), "share_of_ball": share}
            warnings.append(
                f"{name}: {int(dirty[name].sum())} pixels of the ball ({share:.1%}) are dirty: darker than two "
                "predictions of them; left out; wipe the ball"
            )
    return dirty, figures, compared


def _plane_marks(pairs: dict[str, Pairs], measured: Measured | None) -> dict[str, np.ndarray]:
    """Which pairs of each view are dirty by what the plane shows."""
    if measured is None:
        return {name: np.zeros(len(view), bool) for name, view in pairs.items()}
    block = plane_blocks(list(pairs.values()))
    marks, start = {}, 0
    for name, view in pairs.items():
        part = slice(start, start + len(view))
        marks[name] = ball_dirt.plane_spots(view, measured.residual[part], measured.scale[part], block[part])
        start += len(view)
    return marks


def unbinned(mask: np.ndarray, sight: Sight, shape: tuple[int, int]) -> np.ndarray:
    """A mask of the sight's picture in the whole photograph (H, W)."""
    large = np.kron(mask, np.ones((sight.binned, sight.binned), bool))
    whole = np.zeros(shape, bool)
    column, row = sight.corner
    whole[row : row + large.shape[0], column : column + large.shape[1]] = large
    return whole


def without(photograph: Raster, mask: np.ndarray | None) -> Raster:
    """A photograph whose masked pixels are unknown (NaN)."""
    if mask is None:
        return photograph
    channels = dict(photograph.channels)
    for name in "RGB":
        channels[name] = np.where(mask, np.nan, channels[name]).astype(np.float32)
    return Raster(channels, photograph.space, photograph.attributes)


def given_reflectance(facts: dict[str, Any]) -> np.ndarray | None:
    """(3,) ACEScg of the manifest's [probe] table, or None."""
    if facts.get("reflectance") is None:
        return None
    space: Space = "linear_rec709" if facts.get("reflectance_space") == "linear_rec709" else "acescg"
    return np.asarray(convert(np.array(facts["reflectance"], float), space, "acescg"))


def surface_numbers(surface: Surface, given: np.ndarray | None, measured: Measured | None) -> dict[str, Any]:
    """Figures of the reflectance: what is used, what was given, what was measured."""
    numbers: dict[str, Any] = {
        "source": surface.source, "used": surface.facing.tolist(), "sigma_rel": surface.sigma.tolist(),
        "edge_tint": None if surface.tint is None else surface.tint.tolist(),
        "given": None if given is None else given.tolist(), "measured": None,
    }  # fmt: skip
    if measured is not None:
        numbers["measured"] = {
            "head_on": measured.facing.tolist(), "sigma": measured.sigma.tolist(), "edge_tint": measured.tint,
            "pairs": measured.pairs, "blocks": measured.blocks, "tests": measured.tests,
        }  # fmt: skip
        if given is not None:
            numbers["given_over_measured"] = (given / measured.facing).tolist()
    return numbers


def surface_reasons(surface: Surface, measured: Measured | None, gloss: bool = False) -> list[dict[str, Any]]:
    """Which terms of the reflectance are in, and why; ``gloss``: of the plane, by its mirror image's contrast."""
    angle = {
        "term": "angle dependence of the ball's reflectance",
        "modelled": surface.tint is not None or surface.glass is not None,
        "because": "too little of the plane is seen in the ball to test it",
        "could_cost": "3 % at 70 degrees of incidence on a ball of 0.9, 10 % on chrome; nothing head on",
        "bound_rel": 0.1,
    }
    if measured is None:
        return [
            {
                "term": "reflectance measured from the plane", "modelled": False,
                "because": "fewer blocks of the plane than needed are seen both directly and in the ball",
                "could_cost": "the light is off by what the stated reflectance is off",
                **(
                    {"bound_rel": 2 * float(np.max(surface.sigma))}
                    if surface.source == "given"
                    else {"no_bound": "nobody states how the ball reflects, and nothing measures it"}
                ),
            },
            angle,
        ]  # fmt: skip
    said = [
        f"{row['term']}: held-out gain {row['held_out_gain']:.3g} +- {row['standard_error']:.2g}"
        for row in measured.tests
    ]
    angle["because"] = "; ".join(said)
    off = np.abs(surface.facing - measured.facing) + 2 * measured.sigma
    return [
        {
            "term": "reflectance measured from the plane", "modelled": "measured" in surface.source,
            "because": (
                f"{measured.pairs} pixels of the ball show points of the plane that are seen directly, too: "
                f"{', '.join(f'{v:.3f} +- {s:.3f}' for v, s in zip(measured.facing, measured.sigma, strict=True))}; "
                + f"{GLOSS_SIGMA:.0%} of it for the plane's gloss, which its mirror image shows; " * gloss
                + f"used is what is {surface.source}"
            ),
            "could_cost": "the light is off by what the stated reflectance is off",
            "bound_rel": float(np.max(off / measured.facing)),
            **TRIED,
        },
        angle | TRIED,
    ]  # fmt: skip


def dirt_reason(dirty: dict[str, np.ndarray], tested: int, measured: Measured | None) -> dict[str, Any]:
    """Whether dirt is masked, and why."""
    two = "the plane seen directly and the other view" if measured is not None else "the other view"
    return {
        "term": "dirt on the ball", "modelled": bool(dirty),
        "because": f"{tested} comparisons with {two} show " + (f"spots in {', '.join(dirty)}" if dirty else "no spot"),
        "could_cost": "the light behind a spot, as much as the spot swallows",
        "no_bound": "spots where nothing was compared are not known", **(TRIED if tested else {}),
    }  # fmt: skip
