"""How wide a lamp is, and where it stands, from the edge of its shadow: sharper than its clipped picture in the ball.

A clipped lamp's picture is as wide as its glare. The penumbra of the ball's shadow on the plane is as wide as the lamp
itself, so the lamp's half angle and a small turn of its direction are fitted to the blocks of pixels there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_from_direction
from pipeline.light.ball_shadow import Ball, edge_angle, visible_part

LEAST = 60  # blocks at the edge
SUN_HALF_ANGLE = np.radians(0.2665)  # no lamp is taken to be narrower than the sun
FOOTPRINT = 0.7  # half angle of a disc that blurs an edge as a square block of that half diagonal does
MOST_TURN = np.radians(3.0)


@dataclass(frozen=True)
class Edge:
    """A lamp as its shadow's edge has it: unit direction (3,), half angle and its sigma [rad], blocks used."""

    direction: np.ndarray
    half_angle: float
    sigma: float
    points: int


def fit_edge(
    points: np.ndarray, size: np.ndarray, ratio: np.ndarray, sigma: np.ndarray, dark: np.ndarray, lit: np.ndarray,
    direction: np.ndarray, half_angle: float, ball: Ball,
) -> Edge | None:  # fmt: skip
    """Fit the edge over blocks at plane ``points`` (N, 3) of half diagonal ``size`` (N,) [m]; None if it does not show.

    ``ratio``, ``sigma`` (N,): measured; ``dark``, ``lit`` (N,): predicted with the lamp all hidden and all visible;
    ``direction``, ``half_angle``: where to begin.
    """
    from scipy.optimize import least_squares

    if len(points) < LEAST or np.median((lit - dark) / sigma) < 5:
        return None
    blur = FOOTPRINT * size / np.linalg.norm(points - ball.centre, axis=-1)
    across = np.cross(direction, [1.0, 0, 0] if abs(direction[0]) < 0.9 else [0, 0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(direction, across)

    def gaps(state: np.ndarray) -> np.ndarray:
        edge = edge_angle(points, _turned(direction, across, up, state), ball)
        wide = np.hypot(np.exp(state[2]), blur)
        return np.asarray((dark + (lit - dark) * visible_part(edge / wide, 1.0) - ratio) / sigma)

    low = [-MOST_TURN, -MOST_TURN, np.log(SUN_HALF_ANGLE / 4)]
    high = [MOST_TURN, MOST_TURN, np.log(np.radians(15))]
    start = np.log(np.clip(half_angle, SUN_HALF_ANGLE, np.radians(10)))
    found = least_squares(gaps, [0, 0, start], bounds=(low, high), loss="soft_l1", x_scale=[0.01, 0.01, 1])
    spread = max(2 * found.cost / max(len(points) - 3, 1), 1.0)
    variance = float(np.linalg.pinv(found.jac.T @ found.jac)[2, 2]) * spread
    width = float(np.exp(found.x[2]))
    return Edge(_turned(direction, across, up, found.x), width, width * float(np.sqrt(variance)), len(points))


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
