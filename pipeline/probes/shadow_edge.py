"""How wide a lamp is, and where it stands, from the edge of its shadow: sharper than its clipped picture in the ball.

A clipped lamp's picture is as wide as its glare. The penumbra of the ball's shadow on the plane is as wide as the lamp
itself, once the blur of the photograph is taken off: so much of a lamp's width as the photograph's pixels are wide, as
a point at the edge sees them against the ball. That differs along the edge by five times, near the ball most and less
far out, which tells blur and lamp apart. Fitted are the lamp's half angle, a small turn of its direction, and the blur.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_from_direction
from pipeline.light.ball_shadow import Ball, edge_angle, visible_part
from pipeline.probes.rim import BLUR_LOG_SIGMA, BLUR_PX, BLUR_RANGE

LEAST = 60  # blocks at the edge
SUN_HALF_ANGLE = np.radians(0.2665)  # no lamp is taken to be narrower than the sun
MOST_TURN = np.radians(3.0)


@dataclass(frozen=True)
class Edge:
    """A lamp as its shadow's edge has it: unit direction (3,), half angle and its sigma upwards [rad], blocks used.

    ``blur_px``: sigma of the photograph's blur, pixel and demosaicking in it.
    """

    direction: np.ndarray
    half_angle: float
    sigma: float
    points: int
    blur_px: float


@dataclass(frozen=True, eq=False)
class Penumbra:
    """Blocks of ``side`` x ``side`` pixels at a shadow's edge: plane points (N, 3), ``step`` (N, 2, 3) of a pixel [m].

    ``ratio``, ``sigma`` (N,): measured; ``dark``, ``lit`` (N,): predicted with the lamp all hidden and all visible.
    """

    points: np.ndarray
    step: np.ndarray
    side: int
    ratio: np.ndarray
    sigma: np.ndarray
    dark: np.ndarray
    lit: np.ndarray

    def per_pixel(self, direction: np.ndarray, ball: Ball) -> np.ndarray:
        """Angle (N,) [rad] from lamp to outline that a pixel across the edge is worth."""
        here = edge_angle(self.points, direction, ball)
        steps = [edge_angle(self.points + step, direction, ball) - here for step in np.moveaxis(self.step, 1, 0)]
        return np.asarray(np.hypot(*steps))

    def predicted(self, direction: np.ndarray, half_angle: float, blur_px: float, ball: Ball) -> np.ndarray:
        """Ratio (N,) under a disc. A disc of half angle a has the variance a^2 / 4 across an edge: variances add.

        Pixels' centres in a block have (side^2 - 1) / 12; a pixel's own box is in the blur.
        """
        variance = (self.side**2 - 1) / 12 + blur_px**2
        wide = np.hypot(half_angle, 2 * np.sqrt(variance) * self.per_pixel(direction, ball))
        visible = visible_part(edge_angle(self.points, direction, ball) / wide, 1.0)
        return np.asarray(self.dark + (self.lit - self.dark) * visible)


def fit_edge(seen: Penumbra, direction: np.ndarray, half_angle: float, ball: Ball) -> Edge | None:
    """Fit the edge, from ``direction`` and ``half_angle`` on; None if it does not show.

    What photographs and model differ by beyond their sigma is more sigma, so that the blur's prior counts as it should.
    """
    from scipy.optimize import least_squares

    if len(seen.points) < LEAST or np.median((seen.lit - seen.dark) / seen.sigma) < 5:
        return None
    across = np.cross(direction, [1.0, 0, 0] if abs(direction[0]) < 0.9 else [0, 0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(direction, across)
    spread = 1.0

    def gaps(state: np.ndarray) -> np.ndarray:
        width, blur = np.exp(state[2:])
        model = seen.predicted(_turned(direction, across, up, state), width, blur, ball)
        return np.append((model - seen.ratio) / (seen.sigma * spread), (state[3] - np.log(BLUR_PX)) / BLUR_LOG_SIGMA)

    low = [-MOST_TURN, -MOST_TURN, np.log(SUN_HALF_ANGLE / 4), np.log(BLUR_RANGE[0])]
    high = [MOST_TURN, MOST_TURN, np.log(np.radians(15)), np.log(BLUR_RANGE[1])]
    state = np.array([0, 0, np.log(np.clip(half_angle, SUN_HALF_ANGLE, np.radians(10))), np.log(BLUR_PX)])
    for _ in range(2):
        found = least_squares(gaps, state, bounds=(low, high), loss="soft_l1", x_scale=[0.01, 0.01, 1, 1])
        state = np.clip(found.x, np.add(low, 1e-6), np.subtract(high, 1e-6))
        spread *= max(1.4826 * float(np.median(np.abs(found.fun[:-1]))), 1.0)
    width, blur = np.exp(found.x[2:])
    # The edge tells the square of a width that the blur hides, and of the width itself how large it may be.
    square = 2 * width**2 * float(np.sqrt(np.linalg.pinv(found.jac.T @ found.jac)[2, 2]))
    sigma = float(np.sqrt(width**2 + square) - width)
    return Edge(_turned(direction, across, up, found.x), float(width), sigma, len(seen.points), float(blur))


def _turned(direction: np.ndarray, across: np.ndarray, up: np.ndarray, state: np.ndarray) -> np.ndarray:
    turned = direction + state[0] * across + state[1] * up
    return np.asarray(turned / np.linalg.norm(turned))


def disc_texels(direction: np.ndarray, half_angle: float, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels (N,), ascending, of a disc on a map of ``height`` rows, and its share (N,) in each; shares sum to 1."""
    count = 4096
    r = half_angle * np.sqrt((np.arange(count) + 0.5) / count)
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.cross(direction, [1.0, 0, 0] if abs(direction[0]) < 0.9 else [0, 0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(direction, across)
    w = np.cos(r)[:, None] * direction
    w = w + np.sin(r)[:, None] * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * up)
    u, v = latlong_from_direction(w)
    row = np.minimum((v * height).astype(int), height - 1)
    column = np.minimum((u * 2 * height).astype(int), 2 * height - 1)
    texels, number = np.unique(row * 2 * height + column, return_counts=True)
    return texels, number / count
