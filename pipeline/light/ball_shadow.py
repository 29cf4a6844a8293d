"""What a mirror ball on the plane does to the light that reaches the plane: it blocks, and it mirrors.

All for a plane with normal +Y and a ball above it, world frame, light from afar but for the plane's own. Lamps are
linear and told apart, so that their fluxes can be solved for:
    E(x) = S(x) + sum_k Phi_k (cos_k v_k(x) + R m_k(x)) - (1 - sum_k s_k) lost_sky(x) - sum_k s_k lost_k(x)
S is the sky with the ball: the map over the hemisphere, less the ball's cone, plus what the cone mirrors (from above
the sky, from below the plane as it is without the ball). v is the visible part of the lamp's disc. m is the lamp's
light thrown on the plane by the ball: a bundle of parallel light after a sphere of radius R under incidence i has the
focal lengths R cos i / 2 and R / (2 cos i) (Coddington; Born and Wolf, Principles of Optics, 4.6), so that at distance
s it is thinned by f1 / (f1 + s) * f2 / (f2 + s). lost is what the mirrored plane lacks because the ball dims it too, by
sky and by lamp; s_k = Phi_k cos_k / E is the lamp's share of the plane's light. How much
the ball dims the plane by light between the two is a fixed point, on a net around its foot; the plane's albedo in it is
its radiance over E, so that E must be known (`Prepared.reach`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.light.prediction import lookup, sample

CONE_RADII, CONE_AZIMUTHS = 10, 24  # directions over the ball as a plane point sees it, of equal solid angle
BISECTIONS = 36
NET, NET_INNER, NET_OUTER = (20, 24), 0.05, 40.0  # rings, spokes; radii in ball radii
ORDERS = 3  # of light between plane and ball
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Ball:
    """A mirror ball: centre (3,) in metres, world frame; radius; reflectance (3,)."""

    centre: np.ndarray
    radius: float
    reflectance: np.ndarray


@dataclass(frozen=True)
class Reach:
    """What arrives at points with the ball there, per channel, and at a free one; K lamps.

    ``sky`` (N, 3) and ``free`` (3,): irradiance without the lamps; ``lost_sky`` (N, 3); ``visible`` (N, K);
    ``lamp`` (N, K, 3): irradiance per unit flux; ``lost`` (N, K, 3); ``cosine`` (K,).
    """

    sky: np.ndarray
    free: np.ndarray
    lost_sky: np.ndarray
    visible: np.ndarray
    lamp: np.ndarray
    lost: np.ndarray
    cosine: np.ndarray


def edge_angle(points: np.ndarray, direction: np.ndarray, ball: Ball) -> np.ndarray:
    """Angle (N,) [rad] from a lamp's centre to the ball's outline as points (N, 3) see it; negative behind the ball."""
    arm = ball.centre - points
    distance = np.linalg.norm(arm, axis=-1)
    away = np.arccos(np.clip(arm @ direction / distance, -1, 1))
    return np.asarray(away - np.arcsin(np.minimum(ball.radius / distance, 1)))


def visible_part(edge: np.ndarray, half_angle: float) -> np.ndarray:
    """Fraction (N,) of a disc that a straight edge at the angle ``edge`` from its centre leaves free."""
    t = np.clip(edge / max(half_angle, 1e-6), -1, 1)
    return 1 - (np.arccos(t) - t * np.sqrt(1 - t * t)) / np.pi


def thrown(points: np.ndarray, direction: np.ndarray, ball: Ball) -> np.ndarray:
    """Irradiance (N,) on the plane's points by way of an ideal ball, for unit flux from unit ``direction`` (3,).

    The incidence i at which light from ``direction`` is thrown to a point at distance d from the centre, the angle
    gamma away from ``direction``, solves ``d sin(2 i - gamma) = R sin i``: one root between gamma / 2 and the grazing
    ray, by bisection.
    """
    arm = points - ball.centre
    distance = np.linalg.norm(arm, axis=-1)
    along = np.clip(arm @ direction / distance, -1, 1)
    gamma = np.arccos(along)
    low, high = gamma / 2, np.minimum(gamma / 2 + np.pi / 4, np.pi / 2)
    reached = distance * np.sin(2 * high - gamma) > ball.radius * np.sin(high)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        beyond = distance * np.sin(2 * middle - gamma) > ball.radius * np.sin(middle)
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    incidence = (low + high) / 2
    path = distance * np.cos(2 * incidence - gamma) - ball.radius * np.cos(incidence)
    across = arm / distance[:, None] - along[:, None] * direction
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    out = np.cos(2 * incidence)[:, None] * direction + np.sin(2 * incidence)[:, None] * across
    one, two = ball.radius * np.cos(incidence) / 2, ball.radius / (2 * np.maximum(np.cos(incidence), 1e-6))
    thinned = one / (one + path) * two / (two + path)
    return np.where(reached & (path > 0), thinned * np.maximum(-out[:, 1], 0), 0.0)


def cone(points: np.ndarray, ball: Ball) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (N, M, 3) over the ball as each point sees it, and solid angle times cosine (N, M) of each."""
    arm = ball.centre - points
    distance = np.linalg.norm(arm, axis=-1, keepdims=True)
    axis = arm / distance
    span = 1 - np.sqrt(1 - np.minimum(ball.radius / distance, 1) ** 2)  # 1 - cos of the outline, (N, 1)
    u = np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]]))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(axis, u)
    cosine = 1 - span * (np.arange(CONE_RADII) + 0.5) / CONE_RADII  # (N, radii)
    turn = 2 * np.pi * (np.arange(CONE_AZIMUTHS) + 0.5) / CONE_AZIMUTHS
    ring = np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * v[:, None]  # (N, azimuths, 3)
    sine = np.sqrt(1 - cosine**2)
    ways = cosine[..., None, None] * axis[:, None, None] + sine[..., None, None] * ring[:, None]
    ways = ways.reshape(len(points), -1, 3)
    solid_angle = 2 * np.pi * span / (CONE_RADII * CONE_AZIMUTHS)
    return ways, solid_angle * np.maximum(ways[..., 1], 0)


@dataclass(frozen=True)
class Bounce:
    """The ball as the points see it: its directions and weights, where they are mirrored to, and which meet the plane.

    ``ways`` (N, M, 3); ``weight`` (N, M): solid angle times cosine; ``target`` (N, M, 3): directions as from the ball's
    centre; ``ground`` (N, M, 3): places on the plane of those that go ``down`` (N, M).
    """

    ways: np.ndarray
    weight: np.ndarray
    target: np.ndarray
    ground: np.ndarray
    down: np.ndarray


def bounce_of(points: np.ndarray, ball: Ball) -> Bounce:
    """Follow the ball's cone from plane points (N, 3) to the ball and off it."""
    ways, weight = cone(points, ball)
    arm = ball.centre - points
    along = (ways * arm[:, None]).sum(-1)
    step = along - np.sqrt(np.maximum(along**2 - ((arm**2).sum(-1) - ball.radius**2)[:, None], 0))
    normal = (step[..., None] * ways - arm[:, None]) / ball.radius
    away = ways - 2 * (ways * normal).sum(-1, keepdims=True) * normal
    hit = points[:, None] + step[..., None] * ways
    down = away[..., 1] < -1e-6
    ground = hit - away * np.where(down, hit[..., 1] / np.where(down, away[..., 1], 1), 0)[..., None]
    return Bounce(ways, weight, np.where(down[..., None], ground - ball.centre, away), ground, down)


@dataclass(frozen=True)
class Prepared:
    """All that does not depend on the fluxes: at the points (N, 3), and at the net's (G, 3)."""

    ball: Ball
    free: np.ndarray
    seen: Bounce
    blocked: np.ndarray  # (N, 3): sky behind the ball, less the sky that it mirrors
    below: np.ndarray  # (N, M, 3): the free plane, mirrored, as irradiance
    visible: np.ndarray  # (N, K)
    thrown: np.ndarray  # (N, K, 3)
    below_visible: np.ndarray  # (N, M, K): of each lamp at ``seen.ground``
    cosine: np.ndarray  # (K,)
    net: Prepared | None

    def reach(self, total: np.ndarray) -> Reach:
        """What reaches the points where the free plane has the irradiance ``total`` (3,) of sky and lamps together."""
        net = self.net if self.net is not None else self
        dim_sky, dim_lamp = net.dimmed(total)
        lost_sky = (self.below * _on_net(dim_sky, self.seen.ground, self.ball)).sum(1)
        lost = np.zeros((*self.visible.shape, 3))
        for k in range(len(self.cosine)):
            soft = _on_net(dim_lamp[:, k], self.seen.ground, self.ball)
            lost[:, k] = (self.below * (1 - self.below_visible[..., k, None] + soft)).sum(1)
        lamp = self.cosine[:, None] * self.visible[..., None] + self.thrown
        sky = self.free - self.blocked + self.below.sum(1)
        return Reach(sky, self.free, lost_sky, self.visible, lamp, lost, self.cosine)

    def dimmed(self, total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Share of its light that the ball takes from each of these points: the sky's (G, 3), and lamps' (G, K, 3).

        Of the lamps without what it casts in shadow outright, which is sharp: so negative, where light is thrown.
        """
        albedo = self.below / total
        first_sky, dim_lamp = self.blocked / self.free, np.zeros((*self.visible.shape, 3))
        dim_sky = first_sky
        for _ in range(ORDERS):
            dim_sky = first_sky - (albedo * (1 - _on_net(dim_sky, self.seen.ground, self.ball))).sum(1)
        for k, cosine in enumerate(self.cosine):
            first = -self.thrown[:, k] / max(cosine, 1e-3)
            dim_lamp[:, k] = first
            for _ in range(ORDERS):
                lit = self.below_visible[..., k, None] - _on_net(dim_lamp[:, k], self.seen.ground, self.ball)
                dim_lamp[:, k] = first - (albedo * lit).sum(1)
        return dim_sky, dim_lamp


def prepare(
    points: np.ndarray, ball: Ball, sky: np.ndarray, free: np.ndarray, directions: np.ndarray, half_angles: np.ndarray,
    net: bool = True,
) -> Prepared:  # fmt: skip
    """Follow all light to plane ``points`` (N, 3) with the ball there.

    ``sky`` (H, W, 3): the map without the lamps, below the horizon the lit plane without the ball; ``free`` (3,): its
    irradiance on the plane; ``directions`` (K, 3) and ``half_angles`` (K,) of the lamps.
    """
    directions = np.reshape(directions, (-1, 3))
    cosine = np.maximum(directions[:, 1], 0)
    seen = bounce_of(points, ball)
    mirrored = _seen(sky, seen.target) * seen.weight[..., None] * ball.reflectance
    below = mirrored * seen.down[..., None]
    blocked = (_seen(sky, seen.ways) * seen.weight[..., None]).sum(1) - (mirrored - below).sum(1)
    count, shape = len(directions), seen.down.shape
    visible, light = np.zeros((len(points), count)), np.zeros((len(points), count, 3))
    ground_visible = np.zeros((*shape, count))
    for k in np.flatnonzero(cosine > 0):
        visible[:, k] = visible_part(edge_angle(points, directions[k], ball), half_angles[k])
        light[:, k] = thrown(points, directions[k], ball)[:, None] * ball.reflectance
        edge = edge_angle(seen.ground.reshape(-1, 3), directions[k], ball)
        ground_visible[..., k] = visible_part(edge, half_angles[k]).reshape(shape)
    around = prepare(_net(ball), ball, sky, free, directions, half_angles, net=False) if net else None
    return Prepared(ball, free, seen, blocked, below, visible, light, ground_visible, cosine, around)


def _net(ball: Ball) -> np.ndarray:
    """Points (NET[0] * NET[1], 3) on the plane around the ball's foot, log-polar; its dimming is smooth."""
    r = np.geomspace(NET_INNER, NET_OUTER, NET[0])[:, None] * ball.radius
    turn = 2 * np.pi * (np.arange(NET[1]) + 0.5) / NET[1]
    points = np.stack(np.broadcast_arrays(r * np.sin(turn), 0 * r, r * np.cos(turn)), -1).reshape(-1, 3)
    return np.asarray(points + ball.centre * (1, 0, 1))


def _on_net(values: np.ndarray, points: np.ndarray, ball: Ball) -> np.ndarray:
    """Values (N, M, C) at points (N, M, 3) of those on the net (NET[0] * NET[1], C); bilinear."""
    offset = (points - ball.centre).reshape(-1, 3)
    r = np.maximum(np.hypot(offset[:, 0], offset[:, 2]) / ball.radius, NET_INNER)
    row = np.log(r / NET_INNER) / np.log(NET_OUTER / NET_INNER) * (NET[0] - 1) + 0.5
    column = np.mod(np.arctan2(offset[:, 0], offset[:, 2]) / (2 * np.pi), 1) * NET[1]
    grid = values.reshape(*NET, -1)
    around = np.concatenate([grid[:, -1:], grid, grid[:, :1]], 1)
    return np.asarray(sample(around, column + 1, row).reshape(*points.shape[:2], -1), float)


def _seen(environment: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance (N, M, C) of a lat-long map in ``directions`` (N, M, 3), of any length."""
    found = lookup(environment, directions.reshape(-1, 3))
    return np.asarray(found.reshape(*directions.shape[:2], -1), float)
