"""Lamps that are clipped in every frame: what they must at least be, and what their shadows say they are.

A clipped lamp is a connected set of texels with the glare around it; its measured light is a lower bound. Its flux is
recovered where something in the photographs answers to it (`pipeline.light.flux`): the ball's own shadow on the plane,
as the tripod's ball photograph over the plate, needs no albedo; a card of known albedo gives an equation of its own.
Lit surfaces of unknown albedo say nothing, as albedo and flux are one product there; nor are lit and shaded faces of a
box asked, which say as much as they share one albedo and the light at the box is known: of a sun that gives 6 times the
sky on the lit face, hypot(albedo, light) * 7 / 6, so 6 % at 2 and 5 %, 13 % at 10 and 5 %, where a shadow gives 1.3 %
and a card 5 %. What is not told apart is named and stays a lower bound. Limits: light from afar; the plane diffuse
enough that a shadow is its loss of irradiance; an error of scale that the whole map has (the ball's reflectance) the
fluxes share.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles, transform_points
from pipeline.light import ball_shadow
from pipeline.light.emitters import Sky, lights
from pipeline.light.environment import irradiance, resize_environment
from pipeline.light.flux import Card, Fluxes, Shadow, predicted, solve
from pipeline.probes.cards import Cards, cards_of
from pipeline.probes.clipped_lights import PART, Light, find_lights, held_by, light_of, without
from pipeline.probes.observation import Observation, Shots, ViewMap
from pipeline.probes.shadow_blocks import Blocks, plane_blocks
from pipeline.probes.shadow_edge import SUN_HALF_ANGLE, Edge, disc_texels, fit_edge

WIDEST = np.radians(10.0)  # half angle; the shadow of a wider one is as soft as the sky's
MOST = 6  # lamps solved for together
KNOWN_SHARE = 0.003  # of the light: lamps that are not clipped and are kept apart from the smooth sky
UNKNOWN = 0.01  # of the plane's light: clipped light without an answer that leaves those of others open
LOWEST = 0.05  # cosine with the plane's normal below which a lamp hardly lights it
SKY_ROWS = 128  # of the smooth map that is looked up
TURNS, SETTLED = 6, 1e-3  # of fluxes and albedo by turns; change of the irradiance
POINTS = 1600  # blocks of pixels that are looked at, at most
LEAST = 12  # blocks in a lamp's full shadow
WORST_CONDITION = 30.0
INVOLVED = 0.3  # of the least determined combination of fluxes, from where on a lamp takes part in it
MATTERS = 0.002  # of all light: clipped spots below are only counted
CELL_ROWS = 16  # cells of 11 degrees
NARROWER = 0.6  # of the clipped picture's half angle: a sharper edge is believed
WEAK = 0.5  # relative sigma of a flux from which on the bound says as much
DIRECTION_SIGMA = np.radians(0.25)  # of a clipped lamp's centroid
# Of the plane's light: what the model of a whole shadow is off by, the same at all its points. Recovered fluxes of the
# courtyard's sun and of the desk's three lamps, times their shares of that light, were off by 0.007 (rms).
SHADOW_SIGMA = 0.007
REFLECTANCE_SIGMA = 0.02  # of the ball, for what it mirrors to the plane
LEVEL = np.diag([1.0, 0.0, 1.0])  # the ball stands on the plane
SHADED = 3.0  # sigma below what lamps must at least give it: a card that something shades
DARKER, PATCH = 0.05, 25  # a patch of so many blocks this much darker than predicted: a lamp that the map lacks


NOTHING = {
    "term": "flux of clipped lamps", "modelled": False, "because": "nothing is clipped in every frame",
    "could_cost": "nothing",
}  # fmt: skip


@dataclass(frozen=True)
class Witness:
    """What may answer to the fluxes: blocks of the plane around a ball, or surfaces of known albedo; either or both.

    ``cards``: surfaces of known reflectance. ``shift`` (3,): one standard deviation
    of the ball's centre [m] on the plane, along the axis where it is largest, world frame; ``eye`` (3,): the camera.
    ``scale_sigma`` (3,): relative, of the whole map.
    """

    ball: ball_shadow.Ball | None = None
    blocks: Blocks | None = None
    cards: Cards = field(default_factory=Cards)
    scale_sigma: np.ndarray | float = 0.0
    shift: np.ndarray | None = None
    eye: np.ndarray | None = None
    missing: str = "no photograph of the ball from the tripod"


@dataclass(frozen=True)
class Recovered:
    """The map (H, W, 3) with what could be recovered, its variance, and per texel (H, W): clipped, recovered."""

    rgb: np.ndarray
    variance: np.ndarray
    clipped: np.ndarray
    recovered: np.ndarray
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
        return Recovered(rgb, variance, clipped, nowhere, numbers, evidence=[NOTHING])
    asked, refused = _asked(found)
    verdicts = dict(refused)
    rest = setting(rgb, np.where(held_by(clipped.shape, found)[..., None], 0, variance), [light for _, light in asked])
    answers, numbers = _answers(seen, rest, [light for _, light in asked])
    if vague := _vague(found, refused, rest):
        answers = [replace(answer, refused=answer.refused or vague) for answer in answers]
    out, spread, recovered = np.array(rgb, float), np.array(variance, float), np.zeros(clipped.shape)
    rows: list[dict[str, Any]] = []
    for number, light in enumerate(found, 1):
        place = next((at for at, (other, _) in enumerate(asked) if other == number), None)
        answer = answers[place] if place is not None else None
        why = verdicts.get(number) or (answer.refused if answer else "")
        if answer is not None and not why:
            recovered.ravel()[light.texels] = 1
            light = narrowed(out, spread, light, answer.edge)
            _put(out, spread, light, answer)
            recovered.ravel()[light.texels] = 1
        rows.append(_row(light, answer, why, rest))
    warnings = [_warning(number, row) for number, row in enumerate(rows, 1) if row["lower_bound"] and row["matters"]]
    small = sum(1 for row in rows if row["lower_bound"] and not row["matters"])
    if small:
        warnings.append(f"{small} more clipped spots hold less than {MATTERS:.1%} of the light each, as lower bounds")
    evidence = [_reason(number, row) for number, row in enumerate(rows, 1) if row["matters"] or not row["lower_bound"]]
    numbers = {"clipped_lights": rows, **numbers, **_bounds(out, clipped, recovered)}
    return Recovered(out, spread, clipped, recovered, numbers, warnings, evidence)


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
    dark_points: int
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


def _answers(seen: Witness, rest: Setting, asked: list[Light]) -> tuple[list[Answer], dict[str, Any]]:
    """One answer for each lamp, and figures of the solution."""
    said: dict[str, Any] = {"flux_references": seen.cards.said} if seen.cards.said else {}
    none = [Answer(light.bound, np.full(3, np.inf), np.inf, 0, seen.missing) for light in asked]
    card, shaded = _lit(seen.cards, rest, asked) if asked else (None, 0)
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
        answers.append(Answer(fluxes.value[k], sigma[k], float(fluxes.condition.max()), dark, why, edge))
    numbers = {"flux_condition": fluxes.condition.tolist(), **said}
    if shadow:
        numbers |= {
            "ball_over_plate": fluxes.exposure.tolist(), "shadow_chi2": fluxes.chi2.tolist(),
            "shadow_points": len(shadow.ratio),
        }  # fmt: skip
    return answers, numbers


def systematic(seen: Witness, rest: Setting, asked: list[Light], fluxes: Fluxes) -> np.ndarray:
    """Variance (K, 3) of fluxes that no number of points averages out.

    Of the sky's own irradiance, of the scale of the map, of what the model of the shadow leaves out (taken as one error
    of all points of a shadow), and of the cosine of a lamp whose middle is uncertain.
    """
    total = fluxes.value**2 * ((rest.free_sigma / rest.free) ** 2 + np.square(seen.scale_sigma))
    cosine = np.array([light.direction[1] for light in asked])
    everything = rest.free + cosine @ fluxes.value
    total = total + (SHADOW_SIGMA * everything / cosine[:, None]) ** 2
    tilt = np.array([DIRECTION_SIGMA * np.hypot(*light.direction[[0, 2]]) / light.direction[1] for light in asked])
    total = total + (fluxes.value * tilt[:, None]) ** 2
    return np.asarray(total)


def turned_by(direction: np.ndarray, seen: Witness, ball: ball_shadow.Ball) -> np.ndarray:
    """Where the lamp (3,) really is if the ball stands ``seen.shift`` beside where the map was unwrapped from."""
    assert seen.shift is not None
    assert seen.eye is not None
    back = (seen.eye - ball.centre) / np.linalg.norm(seen.eye - ball.centre)
    normal = (direction + back) / np.linalg.norm(direction + back)
    normal = normal - seen.shift / ball.radius
    normal /= np.linalg.norm(normal)
    turned = 2 * (normal @ back) * normal - back
    return np.asarray(turned / np.linalg.norm(turned))


def unseen_lamp(shadow: Shadow, fluxes: Fluxes) -> str:
    """A complaint if patches of the plane are far darker than all lamps of the map together explain; else nothing."""
    gap = fluxes.residual.mean(-1)
    count = np.bincount(shadow.cluster)
    mean = np.bincount(shadow.cluster, gap) / np.maximum(count, 1)
    dark = (mean < -DARKER) & (count >= LEAST)
    if count[dark].sum() < PATCH:
        return ""
    return f"the ball casts a shadow that no lamp of the map explains ({-mean[dark].min():.0%} darker): one is unseen"


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
    }  # fmt: skip


def clipped_share(share: np.ndarray, maps: list[ViewMap]) -> np.ndarray:
    """How much of what a merged texel (H, W) rests on is clipped in every frame, in [0, 1]; ``share`` (V, H, W)."""
    parts = np.stack([np.broadcast_to(view.clipped, share.shape[1:]) for view in maps])
    return np.asarray((share * parts).sum(0))


def witness(shots: Shots, observed: Observation) -> Witness:
    """What the photographs offer: the plane beside the first ball that the tripod saw, as the plate did."""
    scale, cards = np.broadcast_to(observed.scale_sigma, 3), cards_of(shots)
    for ball in shots.facts.get("ball", []):
        name = ball["name"]
        if not ball.get("tripod", False) or name not in observed.balls or shots.views[name].camera is not None:
            continue
        if shots.photographs[name].shape != shots.photographs["plate"].shape:
            continue
        fit, pose = observed.balls[name], shots.views[name].world_from_camera
        blocks = plane_blocks(shots.photographs[name], shots.photographs["plate"], shots.camera, pose, fit)
        centre = transform_points(pose, fit.centre_camera_m)
        values, axes = np.linalg.eigh(LEVEL @ pose[:3, :3] @ fit.covariance @ pose[:3, :3].T @ LEVEL)
        return Witness(
            ball_shadow.Ball(centre, fit.radius_m, fit.reflectance), blocks, cards,
            shift=axes[:, -1] * np.sqrt(values[-1]), eye=pose[:3, 3],
            scale_sigma=scale, missing="the plane beside the ball cannot be compared with the plate",
        )  # fmt: skip
    return Witness(cards=cards, scale_sigma=scale)


@dataclass(frozen=True, eq=False)
class Setting:
    """All light but the clipped lamps': the map (H, W, 3), its smooth part, smaller, with what that gives the plane
    (3,) and its sigma, all its light, and the lamps of known flux.
    """

    whole: np.ndarray
    sky: np.ndarray
    free: np.ndarray
    free_sigma: np.ndarray
    energy: float
    known: list[Light]


def setting(rgb: np.ndarray, variance: np.ndarray, found: list[Light]) -> Setting:
    """The smooth rest of the map, and the lamps in it that are not clipped."""
    whole = without(rgb, found)
    sky = Sky(whole)
    patches = lights(whole, KNOWN_SHARE, WIDEST)[0]
    known = [light_of(sky, patch.texels) for patch in patches]
    rest = without(whole, known)
    rows = min(SKY_ROWS, len(rgb))
    free = irradiance(rest, ball_shadow.UP[None])[0]
    small = resize_environment(rest, rows, 2 * rows)
    return Setting(whole, small, free, _free_sigma(variance), float(sky.total), known)


def _free_sigma(variance: np.ndarray) -> np.ndarray:
    """Sigma (3,) of the irradiance on the plane; errors are taken as one within cells of 11 degrees."""
    height, width = CELL_ROWS, 2 * CELL_ROWS
    sigma = resize_environment(np.sqrt(np.where(np.isfinite(variance), variance, 0)), height, width)
    weight = latlong_solid_angles(height, width) * np.maximum(latlong_directions(height, width)[..., 1], 0)
    return np.asarray(np.sqrt(((weight[..., None] * sigma) ** 2).sum((0, 1))))


def solved(seen: Witness, rest: Setting, found: list[Light], card: Card | None) -> tuple[Fluxes | None, Shadow | None]:
    """Fluxes of the lamps from all evidence, and the shadow they rest on; None without any.

    The light between ball and plane needs the plane's albedo and so the fluxes: solved by turns.
    """
    bound = np.array([light.bound for light in found])
    chosen = _chosen(seen, found, rest.known)
    if chosen is None:
        return (solve(None, card, bound) if card else None), None
    assert seen.ball is not None
    assert seen.blocks is not None
    index, cluster = chosen
    everyone = [*found, *rest.known]
    points = seen.blocks.points[index]
    prepared = _prepared(points, seen.ball, rest, everyone)
    moved = [_prepared(points, ball, rest, turned) for ball, turned in _uncertain(seen, everyone)]
    known = np.array([light.bound for light in rest.known]).reshape(-1, 3)
    ratio, sigma = seen.blocks.ratio[index], seen.blocks.sigma[index]
    # No plane reflects more than it gets: its radiance bounds its irradiance from below.
    least = np.maximum(np.pi * rest.sky[len(rest.sky) // 2 :].mean((0, 1)), rest.free)
    total = np.maximum(rest.free / np.clip(np.percentile(ratio, 5, axis=0), 1e-6, 1), least)
    for _ in range(TURNS):
        reaches = tuple(one.reach(total) for one in moved)
        shadow = Shadow(ratio, sigma, prepared.reach(total), cluster, known, reaches)
        fluxes = solve(shadow, card, bound)
        before, flux = total, np.concatenate([fluxes.value, known])
        total = np.maximum(rest.free + prepared.cosine @ flux, least)
        if np.all(np.abs(total - before) < SETTLED * total):
            break
    return fluxes, shadow


def _lit(cards: Cards, rest: Setting, found: list[Light]) -> tuple[Card | None, int]:
    """The cards as equations, None without any; and how many have less light than the lamps must at least give them:

    something shades these, and they are left out.
    """
    if not len(cards.normal):
        return None, 0
    rows = min(SKY_ROWS, len(rest.whole))
    sky = irradiance(resize_environment(rest.whole, rows, 2 * rows), cards.normal)
    card = Card.measured(
        cards.irradiance, cards.sigma, cards.normal, sky, np.array([light.direction for light in found])
    )
    least = sky + card.cosine @ np.array([light.bound for light in found])
    lit = (card.irradiance > least - SHADED * card.sigma).all(-1)
    kept = Card(card.irradiance[lit], card.sigma[lit], sky[lit], card.cosine[lit]) if lit.any() else None
    return kept, int((~lit).sum())


def _prepared(points: np.ndarray, ball: ball_shadow.Ball, rest: Setting, everyone: list[Light]) -> ball_shadow.Prepared:
    directions = np.array([light.direction for light in everyone])
    return ball_shadow.prepare(
        points, ball, rest.sky, rest.free, directions, np.array([light.half_angle for light in everyone])
    )


def _uncertain(seen: Witness, everyone: list[Light]) -> list[tuple[ball_shadow.Ball, list[Light]]]:
    """The ball and the lamps if one thing were off by its standard deviation: its reflectance, its place.

    Its place turns every direction of the map too.
    """
    assert seen.ball is not None
    others = [(replace(seen.ball, reflectance=seen.ball.reflectance * (1 + REFLECTANCE_SIGMA)), everyone)]
    if seen.shift is not None:
        turned = [replace(light, direction=turned_by(light.direction, seen, seen.ball)) for light in everyone]
        others.append((replace(seen.ball, centre=seen.ball.centre + seen.shift), turned))
    return others


def shadow_of(rest: Setting, points: np.ndarray, ball: ball_shadow.Ball) -> np.ndarray:
    """Irradiance at plane points (N, 3) with the ball there over that without it, (N, 3), all lamps known."""
    prepared = _prepared(points, ball, rest, rest.known)
    flux = np.array([light.bound for light in rest.known]).reshape(-1, 3)
    return predicted(prepared.reach(rest.free + prepared.cosine @ flux), flux)[0]


def edge_of(seen: Witness, rest: Setting, asked: list[Light], k: int, flux: np.ndarray) -> Edge | None:
    """Lamp ``k`` from the edge of its shadow, where no other lamp's edge lies; None if it does not tell."""
    assert seen.ball is not None
    assert seen.blocks is not None
    everyone, blocks = [*asked, *rest.known], seen.blocks
    distance = np.linalg.norm(blocks.points - seen.ball.centre, axis=-1)
    use = np.ones(len(blocks.points), bool)
    for number, light in enumerate(everyone):
        edge = np.abs(ball_shadow.edge_angle(blocks.points, light.direction, seen.ball))
        margin = light.half_angle + DIRECTION_SIGMA + blocks.size / distance
        use &= edge < margin + DIRECTION_SIGMA if number == k else edge > margin
    index = np.random.default_rng(0).permutation(np.flatnonzero(use))[: POINTS // 4]
    if not len(index):
        return None
    both = np.concatenate([flux, np.array([light.bound for light in rest.known]).reshape(-1, 3)])
    prepared = _prepared(blocks.points[index], seen.ball, rest, everyone)
    reach = prepared.reach(rest.free + prepared.cosine @ both)
    step = prepared.cosine[k] * flux[k] / (rest.free + prepared.cosine @ both)
    dark = predicted(reach, both)[0] - reach.visible[:, k, None] * step
    values = [part.mean(-1) for part in (blocks.ratio[index], dark, dark + step)]
    sigma = np.sqrt((blocks.sigma[index] ** 2).sum(-1)) / 3
    return fit_edge(
        blocks.points[index], blocks.size[index], values[0], sigma, values[1], values[2], asked[k].direction,
        asked[k].half_angle, seen.ball,
    )  # fmt: skip


def narrowed(out: np.ndarray, spread: np.ndarray, light: Light, edge: Edge | None) -> Light:
    """The lamp as the disc that its shadow's edge gives, if sharper than its picture, which becomes its surroundings.

    The edge must say so by twice its sigma, and the disc must lie where the lamp was clipped.
    """
    if edge is None or edge.half_angle + 2 * edge.sigma > NARROWER * light.half_angle:
        return light
    texels, share = disc_texels(edge.direction, max(edge.half_angle, SUN_HALF_ANGLE), len(out))
    if not np.isin(texels, light.texels).all():
        return light
    out.reshape(-1, 3)[light.texels] = light.around
    spread.reshape(-1, 3)[light.texels] = light.around**2
    return replace(light, texels=texels, direction=edge.direction, shape=np.repeat(share[:, None], 3, 1))


def _chosen(seen: Witness, found: list[Light], known: list[Light]) -> tuple[np.ndarray, np.ndarray] | None:
    """Which blocks (N,) to use, without those on the edge of a lamp's shadow, and their clusters; None without any."""
    if seen.ball is None or seen.blocks is None:
        return None
    ball, blocks = seen.ball, seen.blocks
    clear = np.ones(len(blocks.points), bool)
    dark = np.zeros(len(blocks.points), int)
    distance = np.linalg.norm(blocks.points - ball.centre, axis=-1)
    for number, light in enumerate([*found, *known]):
        edge = ball_shadow.edge_angle(blocks.points, light.direction, ball)
        clear &= np.abs(edge) > light.half_angle + DIRECTION_SIGMA + blocks.size / distance
        dark += (edge < 0) * (1 << min(number, 40))
    order = np.random.default_rng(0).permutation(np.flatnonzero(clear))
    lit = dark[order] == 0
    index = np.sort(np.concatenate([order[~lit][: POINTS // 2], order[lit][: POINTS // 2]]))
    if not len(index):
        return None
    cell = np.floor(blocks.points[index][:, [0, 2]] / ball.radius).astype(int)
    return index, np.unique(np.column_stack([cell, dark[index]]), axis=0, return_inverse=True)[1].ravel()
