"""What one capture says about its mirror ball: how it reflects, where it is dirty, how far it is from a sphere."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.image.colour import Space, convert
from pipeline.probes import ball_surface
from pipeline.probes.ball_pairs import Pairs, plane_pairs
from pipeline.probes.ball_surface import Measured, Surface
from pipeline.probes.finding import Found
from pipeline.probes.observation import Shots, lookup_channels


@dataclass(frozen=True)
class BallEvidence:
    """The surface that is used, and all that was measured of the ball."""

    surface: Surface
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)


def examine(shots: Shots, found: dict[str, Found], radius: float, rim: float) -> BallEvidence:
    """Surface of the ball that was found in some views; ``rim``: outermost radius that is used, as a fraction."""
    facts = shots.facts["probe"]
    pairs = {name: view_pairs(shots, name, ball, radius, rim) for name, ball in found.items()}
    given = given_reflectance(facts)
    material = facts.get("material")
    tint = None if material is None else ball_surface.preset(material)[1]
    measured = ball_surface.measure(list(pairs.values()), tint)
    surface, warnings = ball_surface.decide(given, material, measured)
    numbers = {"reflectance": surface_numbers(surface, given, measured)}
    return BallEvidence(surface, numbers, warnings, surface_reasons(surface, measured))


def view_pairs(shots: Shots, name: str, ball: Found, radius: float, rim: float) -> Pairs:
    """Pairs of one view."""
    picture, world_from_camera = lookup_channels(shots.photographs[name]), shots.views[name].world_from_camera
    return plane_pairs(picture, shots.camera_of(name), world_from_camera, ball.fit.centre, radius, rim)


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


def surface_reasons(surface: Surface, measured: Measured | None) -> list[dict[str, Any]]:
    """Which terms of the reflectance are in, and why."""
    angle = {
        "term": "angle dependence of the ball's reflectance",
        "modelled": surface.tint is not None,
        "because": "too little of the plane is seen in the ball to test it",
        "could_cost": "3 % at 70 degrees of incidence on a ball of 0.9, 10 % on chrome; nothing head on",
    }
    if measured is None:
        return [
            {
                "term": "reflectance measured from the plane", "modelled": False,
                "because": "fewer blocks of the plane than needed are seen both directly and in the ball",
                "could_cost": "the light is off by what the stated reflectance is off",
            },
            angle,
        ]  # fmt: skip
    said = [
        f"{row['term']}: held-out gain {row['held_out_gain']:.3g} +- {row['standard_error']:.2g}"
        for row in measured.tests
    ]
    angle["because"] = "; ".join(said)
    return [
        {
            "term": "reflectance measured from the plane", "modelled": surface.source == "measured",
            "because": f"{measured.pairs} pixels of the ball show points of the plane that are seen directly, too",
            "could_cost": "the light is off by what the stated reflectance is off",
        },
        angle,
    ]  # fmt: skip
