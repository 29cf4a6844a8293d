"""Fluxes of lamps by the shadow that a ball casts of them on the plane, and by cards; the edge of that shadow.

The model is `pipeline.light.ball_shadow`, the least squares `pipeline.light.flux`; here they meet the map, its lamps
and the blocks of pixels around the ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light import ball_shadow
from pipeline.light.emitters import Sky, lights
from pipeline.light.environment import irradiance, resize_environment
from pipeline.light.flux import Card, Fluxes, Shadow, predicted, solve
from pipeline.probes.cards import Cards
from pipeline.probes.clipped_lights import Light, light_of, without
from pipeline.probes.shadow_edge import Edge, Penumbra, fit_edge
from pipeline.probes.witness import Witness

WIDEST = np.radians(10.0)  # half angle; the shadow of a wider one is as soft as the sky's
KNOWN_SHARE = 0.003  # of the light: lamps that are not clipped and are kept apart from the smooth sky
SKY_ROWS = 128  # of the smooth map that is looked up
TURNS, SETTLED = 6, 1e-3  # of fluxes and albedo by turns; change of the irradiance
POINTS = 1600  # blocks of pixels that are looked at, at most
LEAST = 12  # blocks in a lamp's full shadow
CELL_ROWS = 16  # cells of 11 degrees
DIRECTION_SIGMA = np.radians(0.25)  # of a clipped lamp's centroid
# Of the plane's light: what the model of a whole shadow is off by, the same at all its points. Recovered fluxes of the
# desk's three lamps and the bundled courtyard's sun, times their shares of that light, were off by 0.007 (rms); of the
# courtyard photographed 24 times at 512 px by 0.012: at the ball's foot camera and photographer hide 0.5 to 1.6 % more
# of the sky than from its centre. With 0.012 stated, 31 courtyards had 62, 81 and 100 % of their objects' means within
# intervals of 50, 68 and 95 %.
SHADOW_SIGMA = 0.010
REFLECTANCE_SIGMA = 0.02  # of the ball, for what it mirrors to the plane
SHADED = 3.0  # sigma below what lamps must at least give it: a card that something shades
DARKER, PATCH = 0.05, 25  # a patch of so many blocks this much darker than predicted: a lamp that the map lacks


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


def lit_cards(cards: Cards, rest: Setting, found: list[Light]) -> tuple[Card | None, int]:
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


def unseen_lamp(shadow: Shadow, fluxes: Fluxes) -> str:
    """A complaint if patches of the plane are far darker than all lamps of the map together explain; else nothing."""
    gap = fluxes.residual.mean(-1)
    count = np.bincount(shadow.cluster)
    mean = np.bincount(shadow.cluster, gap) / np.maximum(count, 1)
    dark = (mean < -DARKER) & (count >= LEAST)
    if count[dark].sum() < PATCH:
        return ""
    return f"the ball casts a shadow that no lamp of the map explains ({-mean[dark].min():.0%} darker): one is unseen"


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
    edge = Penumbra(blocks.points[index], blocks.step[index], blocks.side, values[0], sigma, values[1], values[2])
    return fit_edge(edge, asked[k].direction, asked[k].half_angle, seen.ball, seen.place)
