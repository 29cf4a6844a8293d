"""Lamps that are clipped in every frame: what they must at least be, and what their shadows say they are.

A clipped lamp is a connected set of texels with the glare around it; its measured light is a lower bound. Its flux is
recovered where something in the photographs answers to it (`pipeline.probes.shadow_flux`): the ball's own shadow on the
plane, as the tripod's ball photograph over the plate, needs no albedo; a card of known albedo gives an equation of its
own. Lit surfaces of unknown albedo say nothing, as albedo and flux are one product there; nor are lit and shaded faces
of a box asked, which say as much as they share one albedo and the light at the box is known: of a sun that gives 6
times the sky on the lit face, hypot(albedo, light) * 7 / 6, so 6 % at 2 and 5 %, 13 % at 10 and 5 %, where a shadow
gives 1.3 % and a card 5 %. What is not told apart is named and stays a lower bound. Limits: light from afar; the plane
diffuse enough that a shadow is its loss of irradiance; an error of scale that the whole map has (the ball's
reflectance) the fluxes share.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.conventions import latlong_solid_angles
from pipeline.light.placed import SUN_HALF_ANGLE, Placed, disc_texels
from pipeline.probes.clipped_lights import PART, Light, find_lights, held_by
from pipeline.probes.observation import ViewMap
from pipeline.probes.shadow_edge import Edge
from pipeline.probes.shadow_flux import (
    LEAST,
    WIDEST,
    Setting,
    edge_of,
    lit_cards,
    setting,
    solved,
    systematic,
    unseen_lamp,
)
from pipeline.probes.witness import Witness
from pipeline.run.evidence import ABSENT

MOST = 6  # lamps solved for together
UNKNOWN = 0.01  # of the plane's light: clipped light without an answer that leaves those of others open
LOWEST = 0.05  # cosine with the plane's normal below which a lamp hardly lights it
WORST_CONDITION = 30.0
INVOLVED = 0.3  # of the least determined combination of fluxes, from where on a lamp takes part in it
MATTERS = 0.002  # of all light: clipped spots below are only counted
NARROWER = 0.6  # of the clipped picture's half angle: a sharper edge is believed
WEAK = 0.5  # relative sigma of a flux from which on the bound says as much


NOTHING = {
    "term": "flux of clipped lamps", "modelled": False, "because": "nothing is clipped in every frame",
    "could_cost": "nothing", **ABSENT,
}  # fmt: skip


@dataclass(frozen=True)
class Recovered:
    """The map (H, W, 3) with what could be recovered, its variance, and per texel (H, W): clipped, recovered.

    ``placed``: the lamps that are discs where their shadows' edges say.
    """

    rgb: np.ndarray
    variance: np.ndarray
    clipped: np.ndarray
    recovered: np.ndarray
    placed: list[Placed] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)


def recover(rgb: np.ndarray, variance: np.ndarray, clipped: np.ndarray, seen: Witness) -> Recovered:
    """Scale the clipped lamps of a map (H, W, 3) to the fluxes that the evidence gives; say which stay lower bounds.

    ``variance`` (H, W, 3): on the texels of a recovered lamp it becomes that of the flux, which all of them share:
    their errors are fully correlated, so that their sigmas add, not their variances. ``clipped`` (H, W) in [0, 1].
    """
    found = find_lights(rgb, clipped)
    if not found:
        nowhere = np.zeros(clipped.shape)
        numbers = {"clipped_lights": [], **_bounds(rgb, clipped, nowhere)}
        return Recovered(rgb, variance, clipped, nowhere, numbers=numbers, evidence=[NOTHING])
    asked, refused = _asked(found)
    verdicts = dict(refused)
    rest = setting(rgb, np.where(held_by(clipped.shape, found)[..., None], 0, variance), [light for _, light in asked])
    answers, numbers = _sharpened(seen, rest, [light for _, light in asked])
    if vague := _vague(found, refused, rest):
        answers = [replace(answer, refused=answer.refused or vague) for answer in answers]
    out, spread, recovered = np.array(rgb, float), np.array(variance, float), np.zeros(clipped.shape)
    rows: list[dict[str, Any]] = []
    placed: list[Placed] = []
    for number, light in enumerate(found, 1):
        place = next((at for at, (other, _) in enumerate(asked) if other == number), None)
        answer = answers[place] if place is not None else None
        why = verdicts.get(number) or (answer.refused if answer else "")
        if answer is not None and not why:
            recovered.ravel()[light.texels] = 1
            whole, light = light, narrowed(out, spread, light, answer.edge)
            placed += [place_of(answer.edge)] if answer.edge is not None and light is not whole else []
            _put(out, spread, light, answer)
            recovered.ravel()[light.texels] = 1
        rows.append(_row(light, answer, why, rest))
    warnings = [_warning(number, row) for number, row in enumerate(rows, 1) if row["lower_bound"] and row["matters"]]
    small = sum(1 for row in rows if row["lower_bound"] and not row["matters"])
    if small:
        warnings.append(f"{small} more clipped spots hold less than {MATTERS:.1%} of the light each, as lower bounds")
    evidence = [_reason(number, row) for number, row in enumerate(rows, 1) if row["matters"] or not row["lower_bound"]]
    numbers = {"clipped_lights": rows, **numbers, **_bounds(out, clipped, recovered)}
    return Recovered(out, spread, clipped, recovered, placed, numbers, warnings, evidence)


def _bounds(rgb: np.ndarray, clipped: np.ndarray, recovered: np.ndarray) -> dict[str, Any]:
    """How many texels are clipped, and how much of the light is still a lower bound."""
    weighted = rgb.mean(-1) * latlong_solid_angles(*clipped.shape)
    touched = clipped > PART
    share = float(weighted[touched & (recovered == 0)].sum() / max(float(weighted.sum()), 1e-300))
    return {"clipped_texels": int(touched.sum()), "clipped_light_lower_bound_rel": share}


@dataclass(frozen=True)
class Answer:
    """What the evidence says of one lamp: flux and sigma (3,), the condition number, and why it is not used, if so."""

    flux: np.ndarray
    sigma: np.ndarray
    condition: float
    refused: str = ""
    edge: Edge | None = None


def _asked(found: list[Light]) -> tuple[list[tuple[int, Light]], dict[int, str]]:
    """The lamps, by their number from 1, whose fluxes can be asked for; and why not of the others."""
    refused: dict[int, str] = {}
    asked: list[tuple[int, Light]] = []
    for number, light in enumerate(found, 1):
        if light.half_angle > WIDEST:
            refused[number] = f"it is {np.degrees(light.half_angle):.0f} degrees wide: no shadow of its own"
        elif light.direction[1] < LOWEST:
            refused[number] = "it stands too low over the plane to light it"
        elif len(asked) == MOST:
            refused[number] = f"only the {MOST} brightest are solved for"
        else:
            asked.append((number, light))
    return asked, refused


def _vague(found: list[Light], refused: dict[int, str], rest: Setting) -> str:
    """Why no flux can be had from shares of the plane's light: a clipped light that is not asked for adds to it too."""
    for number in refused:
        light = found[number - 1]
        if np.any(light.bound * max(light.direction[1], 0) > UNKNOWN * rest.free):
            return "another clipped light, not told by its shadow, lights the plane by an unknown amount"
    return ""


def _sharpened(seen: Witness, rest: Setting, asked: list[Light]) -> tuple[list[Answer], dict[str, Any]]:
    """The answers, once more with lamps where and as wide as their shadows' edges say, if an edge does.

    Glare about a clipped lamp puts its middle off by up to a degree, and widens it, which hides much of its shadow.
    """
    first, numbers = _answers(seen, rest, asked)
    sharp = [
        replace(light, direction=answer.edge.direction, half_angle=answer.edge.half_angle)
        if answer.edge and believed(light, answer.edge) else light
        for light, answer in zip(asked, first, strict=True)
    ]  # fmt: skip
    if all(light is other for light, other in zip(asked, sharp, strict=True)):
        return first, numbers
    second, more = _answers(seen, rest, sharp)
    if any(answer.refused and not before.refused for answer, before in zip(second, first, strict=True)):
        return first, numbers
    return [replace(a, edge=a.edge or before.edge) for a, before in zip(second, first, strict=True)], more


def _answers(seen: Witness, rest: Setting, asked: list[Light]) -> tuple[list[Answer], dict[str, Any]]:
    """One answer for each lamp, and figures of the solution."""
    said: dict[str, Any] = {"flux_references": seen.cards.said} if seen.cards.said else {}
    none = [Answer(light.bound, np.full(3, np.inf), np.inf, seen.missing) for light in asked]
    card, shaded = lit_cards(seen.cards, rest, asked) if asked else (None, 0)
    said |= {"flux_rows_shaded": shaded} if said else {}
    fluxes, shadow = solved(seen, rest, asked, card) if asked else (None, None)
    if fluxes is None:
        shade = [replace(answer, refused="the references lie in the shade") for answer in none]
        return shade if shaded else none, said
    sigma = np.sqrt(np.stack([np.diag(one) for one in fluxes.covariance], -1) + systematic(seen, rest, asked, fluxes))
    unseen = unseen_lamp(shadow, fluxes) if shadow else ""
    answers = []
    for k in range(len(asked)):
        dark = int((shadow.reach.visible[:, k] < 0.5).sum()) if shadow else 0
        faced = card is not None and bool((card.cosine[:, k] > LOWEST).any())
        worst = max(
            (fluxes.condition[c] for c in range(3) if abs(fluxes.weakest[c, k]) > INVOLVED), default=0.0
        )  # fmt: skip
        why = ""
        if dark < LEAST and not faced:
            why = "the shadow that it casts of the ball is not in the picture"
        elif worst > WORST_CONDITION:
            why = f"its share cannot be told from another lamp's (condition number {worst:.0f})"
        elif unseen:
            why = unseen
        elif np.any(sigma[k] > WEAK * fluxes.value[k]):
            why = "its shadow is too faint to tell"
        edge = edge_of(seen, rest, asked, k, fluxes.value) if not why and dark >= LEAST else None
        answers.append(Answer(fluxes.value[k], sigma[k], float(fluxes.condition.max()), why, edge))
    numbers = {"flux_condition": fluxes.condition.tolist(), **said}
    if shadow:
        numbers |= {
            "ball_over_plate": fluxes.exposure.tolist(), "shadow_chi2": fluxes.chi2.tolist(),
            "shadow_points": len(shadow.ratio),
        }  # fmt: skip
    return answers, numbers


def _put(out: np.ndarray, spread: np.ndarray, light: Light, answer: Answer) -> None:
    """Give the lamp's texels its flux exactly, over their surroundings, in the shape that they had."""
    solid = latlong_solid_angles(*out.shape[:2]).ravel()[light.texels, None]
    out.reshape(-1, 3)[light.texels] = light.around + light.shape * answer.flux / solid
    spread.reshape(-1, 3)[light.texels] = (light.shape * answer.sigma / solid) ** 2


def _row(light: Light, answer: Answer | None, why: str, rest: Setting) -> dict[str, Any]:
    """One lamp's figures."""
    elevation, azimuth = np.degrees([np.arcsin(light.direction[1]), np.arctan2(light.direction[0], light.direction[2])])
    told = answer is not None and not why
    flux = answer.flux if told and answer else light.bound
    share = float(flux.mean() / (rest.energy + flux.mean()))
    return {
        "elevation_deg": float(elevation), "azimuth_deg": float(azimuth),
        "half_angle_deg": float(np.degrees(light.half_angle)), "texels": len(light.texels),
        "lower_bound": not told, "bound": light.bound.tolist(), "flux": flux.tolist(),
        "flux_sigma": answer.sigma.tolist() if told and answer else None,
        "edge_half_angle_deg": float(np.degrees(answer.edge.half_angle)) if answer and answer.edge else None,
        "edge_half_angle_sigma_deg": float(np.degrees(answer.edge.sigma)) if answer and answer.edge else None,
        "edge_blur_px": answer.edge.blur_px if answer and answer.edge else None,
        "direction_sigma_deg": np.degrees(answer.edge.direction_sigma).tolist() if answer and answer.edge else None,
        "condition": answer.condition if told and answer else None, "why_not": why, "share": share,
        "matters": share > MATTERS,
    }  # fmt: skip


def _named(row: dict[str, Any]) -> str:
    return f"elevation {row['elevation_deg']:.0f}, azimuth {row['azimuth_deg']:.0f} degrees"


def _warning(number: int, row: dict[str, Any]) -> str:
    return (
        f"clipped lamp {number} ({_named(row)}) stays a lower bound of {row['share']:.1%} of the light: "
        f"{row['why_not']}; add a shorter exposure or an ND filter, lay a card of known reflectance into its light "
        "([[reference]]), or photograph the ball with its whole shadow from the tripod"
    )


def _reason(number: int, row: dict[str, Any]) -> dict[str, Any]:
    if row["lower_bound"]:
        because, cost = row["why_not"], f"all that it is brighter than {row['share']:.1%} of the light"
    else:
        factor, sigma = np.mean(row["flux"]) / np.mean(row["bound"]), np.mean(row["flux_sigma"]) / np.mean(row["flux"])
        because = (
            f"the ball's shadow and cards give {factor:.3g} times the clipped value, +- {sigma:.1%}, condition number "
            f"{row['condition']:.1f}"
        )
        cost = f"{1 - 1 / factor:.0%} of that lamp, {row['share']:.0%} of the light"
    return {
        "term": f"flux of clipped lamp {number}, {_named(row)}", "modelled": not row["lower_bound"],
        "because": because, "could_cost": cost,
        **({"no_bound": "no photograph says how bright it was"} if row["lower_bound"] else {}),
    }  # fmt: skip


def clipped_share(share: np.ndarray, maps: list[ViewMap]) -> np.ndarray:
    """How much of what a merged texel (H, W) rests on is clipped in every frame, in [0, 1]; ``share`` (V, H, W)."""
    parts = np.stack([np.broadcast_to(view.clipped, share.shape[1:]) for view in maps])
    return np.asarray((share * parts).sum(0))


def believed(light: Light, edge: Edge) -> bool:
    """Whether the edge of its shadow says by twice its sigma that a lamp is narrower than its clipped picture."""
    return edge.half_angle + 2 * edge.sigma <= NARROWER * light.half_angle


def place_of(edge: Edge) -> Placed:
    """The disc as it is drawn: no narrower than the sun, and as unsure of its square as the edge is."""
    half = max(edge.half_angle, SUN_HALF_ANGLE)
    square = (edge.half_angle + edge.sigma) ** 2 - edge.half_angle**2
    x, y, z = (float(part) for part in edge.direction)
    level, upright = (float(part) for part in edge.direction_sigma)
    return Placed((x, y, z), half, float(np.sqrt(half**2 + square)) - half, (level, upright))


def narrowed(out: np.ndarray, spread: np.ndarray, light: Light, edge: Edge | None) -> Light:
    """The lamp as the disc that its shadow's edge gives, if sharper than its picture, which becomes its surroundings.

    The disc must lie where the lamp was clipped.
    """
    if edge is None or not believed(light, edge):
        return light
    texels, share = disc_texels(edge.direction, max(edge.half_angle, SUN_HALF_ANGLE), len(out))
    if not np.isin(texels, light.texels).all():
        return light
    out.reshape(-1, 3)[light.texels] = light.around
    spread.reshape(-1, 3)[light.texels] = light.around**2
    return replace(light, texels=texels, direction=edge.direction, shape=np.repeat(share[:, None], 3, 1))
