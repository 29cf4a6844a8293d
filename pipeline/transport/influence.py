"""How far from an object the light changes: an upper bound from its bounding sphere, before anything is rendered.

At a point of a surface, a sphere of radius r whose centre lies at distance D under an angle theta to the normal covers
the share ``F = (r / D)^2 cos(theta)`` of the projected hemisphere (Howell, Menguc, Siegel, Thermal Radiation Heat
Transfer, configuration factor of an element and a sphere). What it hides is at most F times pi times the brightest
radiance behind it, plus every compact light behind it; what it sends back is at most F times the largest irradiance on
any of its sides, as if it were white, plus what it emits. The larger of the two bounds the change, as they have
opposite signs. Limits: what a concave or clear object focuses (a caustic) is brighter than this and is not bounded;
light that bounces between object and surface is left out (it is F times as small again).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_directions
from pipeline.light.environment import irradiance, resize_environment
from pipeline.types import Emitter

ROWS = 32  # of the sky that is looked at behind a sphere; finer lights are emitters
SIDES = 6  # rows of directions for the largest irradiance on any side
STEP = 1.1  # from one distance to the next
AZIMUTHS = 72
CHUNK = 512  # points at once


@dataclass(frozen=True, eq=False)
class Fall:
    """Light that falls on a surface of one orientation, all relative to its irradiance, by channel.

    ``sky`` (T, 3): pi times the radiance of each texel (directions ``toward`` (T, 3)) without the emitters;
    ``lamps`` (L, 3): share that each emitter gives, from ``lamp_toward`` (L, 3), discs of ``lamp_half`` (L,) rad;
    ``sides`` (S, 3): irradiance on surfaces of normals ``side_normal`` (S, 3), of all orientations.
    """

    normal: np.ndarray
    sky: np.ndarray
    toward: np.ndarray
    lamps: np.ndarray
    lamp_toward: np.ndarray
    lamp_half: np.ndarray
    sides: np.ndarray
    side_normal: np.ndarray


def light_on(normal: np.ndarray, environment: np.ndarray, emitters: Sequence[Emitter]) -> Fall:
    """What an environment (H, W, 3) with these emitters in it sheds on a surface of a unit normal (3,), world frame."""
    sky = environment.reshape(-1, 3).astype(float)
    for emitter in emitters:
        sky[np.asarray(emitter.texels, int)] = 0.0
    coarse = resize_environment(sky.reshape(environment.shape), ROWS, 2 * ROWS)
    whole = resize_environment(np.asarray(environment, float), ROWS, 2 * ROWS)
    fall = np.maximum(irradiance(environment, normal[None])[0], 1e-30)
    sides = np.concatenate([latlong_directions(SIDES, 2 * SIDES).reshape(-1, 3), normal[None]])
    lamps = np.array([e.irradiance * max(float(e.direction @ normal), 0.0) for e in emitters]).reshape(-1, 3)
    return Fall(
        normal,
        np.pi * np.maximum(coarse, 0).reshape(-1, 3) / fall,
        latlong_directions(ROWS, 2 * ROWS).reshape(-1, 3),
        lamps / fall,
        np.array([e.direction for e in emitters]).reshape(-1, 3),
        np.array([e.half_angle_rad for e in emitters]),
        irradiance(whole, sides) / fall,
        sides,
    )


def influence(points: np.ndarray, spheres: np.ndarray, light: Fall, emission: float = 0.0) -> np.ndarray:
    """(N,) bound on the relative change of irradiance at points (N, 3) by spheres (K, 4: centre, radius), summed.

    A sphere that dips under the surface is lifted until it touches it, which covers more than the part above. Wholly
    behind it, it does nothing. ``emission``: radiance that the objects send out, 1 as in `manifest.MaterialWish`.
    """
    total = np.zeros(len(points))
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        for *centre, radius in spheres:
            total[part] += _of_sphere(points[part], np.array(centre), float(radius), light, emission)
    return total


def _of_sphere(points: np.ndarray, centre: np.ndarray, radius: float, light: Fall, emission: float) -> np.ndarray:
    arm = centre - points
    above = arm @ light.normal
    arm = arm + np.maximum(radius - above, 0)[:, None] * light.normal
    distance = np.linalg.norm(arm, axis=1)
    way = arm / distance[:, None]
    half = np.arcsin(np.minimum(radius / distance, 1.0))
    covered = ((radius / distance) ** 2 * (way @ light.normal))[:, None]  # F
    reach = half + np.pi / ROWS / np.sqrt(2)  # a texel's half diagonal more
    behind = way @ light.toward.T > np.cos(np.minimum(reach, np.pi))[:, None]
    brightest = np.stack([np.where(behind, light.sky[:, c], 0.0).max(1) for c in range(3)], -1)
    lost = covered * brightest
    for share, toward, wide in zip(light.lamps, light.lamp_toward, light.lamp_half, strict=True):
        met = np.arccos(np.clip(way @ toward, -1, 1)) < half + wide
        lost += (met * np.minimum((half / max(wide, 1e-9)) ** 2, 1.0))[:, None] * share
    gained = covered * (light.sides.max(0) + emission)
    return np.where(above > -radius, np.maximum(np.minimum(lost, 1.0), gained).max(1), 0.0)


def expected(
    points: np.ndarray, sphere: np.ndarray, light: Fall, albedo: np.ndarray, emission: float = 0.0
) -> np.ndarray:
    """(N,) relative change of irradiance at points (N, 3) that a diffuse ball (4: centre, radius) would make.

    Not a bound: what the ball sends back, lit as its visible side is on average and of ``albedo`` (3,), less what it
    hides on average. For an object of another shape, or a shiny one, an order of magnitude.
    """
    arm, above = sphere[:3] - points, (sphere[:3] - points) @ light.normal
    arm = arm + np.maximum(sphere[3] - above, 0)[:, None] * light.normal
    distance = np.linalg.norm(arm, axis=1)
    way = arm / distance[:, None]
    half = np.arcsin(np.minimum(sphere[3] / distance, 1.0))
    covered = ((sphere[3] / distance) ** 2 * (way @ light.normal))[:, None]
    behind = way @ light.toward.T > np.cos(np.minimum(half + np.pi / ROWS / np.sqrt(2), np.pi))[:, None]
    lost = covered * (behind @ light.sky) / np.maximum(behind.sum(1, keepdims=True), 1)
    for share, toward, wide in zip(light.lamps, light.lamp_toward, light.lamp_half, strict=True):
        met = np.arccos(np.clip(way @ toward, -1, 1)) < half
        lost += (met * np.minimum((half / max(wide, 1e-9)) ** 2, 1.0))[:, None] * share
    facing = np.maximum(-way @ light.side_normal.T, 0)
    lit = (facing @ light.sides) / np.maximum(facing.sum(1, keepdims=True), 1e-12)
    gained = covered * (albedo * lit + emission)
    return np.where(above > -sphere[3], np.abs(gained - np.minimum(lost, 1.0)).max(1), 0.0)


def reach(sphere: np.ndarray, light: Fall, threshold: float, most: float, emission: float = 0.0) -> np.ndarray:
    """(A, 3) outermost points of the plane y = 0, one per azimuth, where a sphere (4,) changes it by the threshold.

    ``most``: distance [m] from the sphere's foot at which the search ends. Directions away from every emitter are
    among the azimuths, so that no long shadow is stepped over.
    """
    turn = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    ways = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1)
    away = -light.lamp_toward * (1, 0, 1)
    length = np.linalg.norm(away, axis=1)
    ways = np.concatenate([ways, away[length > 1e-6] / length[length > 1e-6, None]])
    radius = float(sphere[3])
    if most <= radius:
        distances = np.array([most])
    else:
        distances = np.append(radius * STEP ** np.arange(0, np.log(most / radius) / np.log(STEP)), most)
    foot = sphere[:3] * (1, 0, 1)
    points = foot + ways[:, None] * distances[:, None]
    over = influence(points.reshape(-1, 3), sphere[None], light, emission).reshape(points.shape[:2]) >= threshold
    last = np.where(over.any(1), over.shape[1] - 1 - np.argmax(over[:, ::-1], axis=1), 0)
    beyond = np.minimum(last + 1, len(distances) - 1)  # the step on which it falls below
    return np.asarray(foot + ways * distances[beyond][:, None])
