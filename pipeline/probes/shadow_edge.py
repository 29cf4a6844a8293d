"""How wide a lamp is, and where it stands, from the edge of its shadow: sharper than its clipped picture in the ball.

A clipped lamp's picture is as wide as its glare. The penumbra of the ball's shadow on the plane is as wide as the lamp
itself, once the blur of the photograph is taken off: so much of a lamp's width as the photograph's pixels are wide, as
a point at the edge sees them against the ball. That differs along the edge by five times, near the ball most and less
far out, which tells blur and lamp apart. Fitted are the lamp's half angle, a small turn of its direction, and the blur.

The ball is held at its place. How uncertain that is enters the sigmas, less what the edge itself knows of it: near the
ball an edge moves with the ball, far out with the lamp, which bounds both. Fitted too, the place follows what the model
of a penumbra leaves out: directions of 13 simulated captures were then off by 0.10 and 0.04 degrees rms, held by 0.05
and 0.03.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.light.ball_shadow import Ball, edge_angle, visible_part
from pipeline.light.placed import SUN_HALF_ANGLE, turned_to
from pipeline.probes.rim import BLUR_LOG_SIGMA, BLUR_PX, BLUR_RANGE

LEAST = 60  # blocks at the edge
MOST_TURN = np.radians(3.0)
SHORT = 1e-2  # of a standard deviation of the ball's place: for its derivative


@dataclass(frozen=True)
class Edge:
    """A lamp as its shadow's edge has it: unit direction (3,), half angle and its sigma upwards [rad], blocks used.

    ``blur_px``: sigma of the photograph's blur, pixel and demosaicking in it. ``direction_sigma`` (2,) [rad], along
    `pipeline.light.placed.axes_about` the direction that the fit began from: level, upright.
    """

    direction: np.ndarray
    half_angle: float
    sigma: float
    points: int
    blur_px: float
    direction_sigma: np.ndarray


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


def fit_edge(
    seen: Penumbra, direction: np.ndarray, half_angle: float, ball: Ball, place: np.ndarray | None = None
) -> Edge | None:
    """Fit the edge, from ``direction`` and ``half_angle`` on; None if it does not show.

    ``place`` (3, 3) [m^2]: covariance of the ball's centre, world frame; None: exact. What photographs and model differ
    by beyond their sigma is more sigma, so that the blur's prior counts as it should.
    """
    from scipy.optimize import least_squares

    if len(seen.points) < LEAST or np.median((seen.lit - seen.dark) / seen.sigma) < 5:
        return None
    spread = 1.0

    def gaps(state: np.ndarray, there: Ball) -> np.ndarray:
        width, blur = np.exp(state[2:])
        model = seen.predicted(turned_to(direction, *state[:2]), width, blur, there)
        return np.append((model - seen.ratio) / (seen.sigma * spread), (state[3] - np.log(BLUR_PX)) / BLUR_LOG_SIGMA)

    low = [-MOST_TURN, -MOST_TURN, np.log(SUN_HALF_ANGLE / 4), np.log(BLUR_RANGE[0])]
    high = [MOST_TURN, MOST_TURN, np.log(np.radians(15)), np.log(BLUR_RANGE[1])]
    state = np.array([0, 0, np.log(np.clip(half_angle, SUN_HALF_ANGLE, np.radians(10))), np.log(BLUR_PX)])
    for _ in range(2):
        found = least_squares(
            gaps, state, bounds=(low, high), loss="soft_l1", x_scale=[0.01, 0.01, 1, 1], args=(ball,)
        )  # fmt: skip
        state = np.clip(found.x, np.add(low, 1e-6), np.subtract(high, 1e-6))
        last, spread = spread, spread * max(1.4826 * float(np.median(np.abs(found.fun[:-1]))), 1.0)
    spread = last  # as of the last fit
    width, blur = np.exp(found.x[2:])
    shifts = _axes_of(place)
    moved = [
        (gaps(found.x, replace(ball, centre=ball.centre + shift * SHORT)) - found.fun) / SHORT for shift in shifts
    ]  # fmt: skip
    covariance = _covariance(found.jac, found.fun, moved)
    # The edge tells the square of a width that the blur hides, and of the width itself how large it may be.
    square = 2 * width**2 * float(np.sqrt(covariance[2, 2]))
    sigma = float(np.sqrt(width**2 + square) - width)
    turn = np.sqrt(np.diag(covariance)[:2])
    return Edge(turned_to(direction, *found.x[:2]), float(width), sigma, len(seen.points), float(blur), turn)


def _axes_of(covariance: np.ndarray | None) -> np.ndarray:
    """(N, 3) principal axes of a covariance, one standard deviation long; none of None."""
    if covariance is None:
        return np.zeros((0, 3))
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0))).T)


def _covariance(jac: np.ndarray, gap: np.ndarray, moved: list[np.ndarray]) -> np.ndarray:
    """(4, 4) of the fit's numbers, with other uncertain things of unit sigma beside them that change the gaps (N,).

    Rows of ``jac`` (N, 4) are weighted as the loss has them: of soft_l1's second derivative, (1 + gap^2)^(-3/4).
    """
    if moved:
        sides = np.stack(moved, -1) * ((1 + gap**2) ** -0.75)[:, None]
        prior = np.column_stack([np.zeros((len(moved), jac.shape[1])), np.eye(len(moved))])
        jac = np.concatenate([np.column_stack([jac, sides]), prior])
    return np.asarray(np.linalg.pinv(jac.T @ jac)[:4, :4])
