"""Lamps of a map as texels with the glare around them, over the radiance of their surroundings; which are clipped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.light.emitters import Sky, components

PART = 0.05  # of a texel that is clipped: from here on it is a lower bound
HALO, RING = np.radians(5.0), np.radians(6.0)  # how far glare is followed beyond what is clipped; width of the ring
GLARE = 2.0  # times the ring's level: what is brighter belongs to the lamp


@dataclass(frozen=True, eq=False)
class Light:
    """A clipped lamp: texels (N,), unit direction (3,), half angle; ``bound`` (3,): its flux over its surroundings.

    ``around`` (3,): radiance of the surroundings, which its texels also have; ``shape`` (N, 3): their shares of it.
    """

    texels: np.ndarray
    direction: np.ndarray
    half_angle: float
    bound: np.ndarray
    around: np.ndarray
    shape: np.ndarray


def find_lights(rgb: np.ndarray, clipped: np.ndarray) -> list[Light]:
    """Clipped lamps of a map (H, W, 3) with ``clipped`` (H, W), by falling bound; glare around them is theirs."""
    inside = clipped > PART
    if not inside.any():
        return []
    sky = Sky(rgb)
    whole = inside.copy()
    labels = components(inside)
    for label in np.unique(labels[labels > 0]):
        whole |= _glare(sky, labels == label, inside)
    labels = components(whole)
    found = [light_of(sky, np.flatnonzero(labels.ravel() == label)) for label in np.unique(labels[labels > 0])]
    return sorted(found, key=lambda light: -float(light.bound.mean()))


def _ring(sky: Sky, texels: np.ndarray, inner: float) -> tuple[np.ndarray, np.ndarray]:
    """Angle (H, W) to the middle of texels (N,), and the ring (H, W) that begins ``inner`` beyond them."""
    directions = sky.directions.reshape(-1, 3)
    middle = sky.solid_angles.ravel()[texels] @ directions[texels]
    angle = np.arccos(np.clip(sky.directions @ (middle / np.linalg.norm(middle)), -1, 1))
    reach = angle.ravel()[texels].max() + inner
    return angle, (angle > reach) & (angle < reach + RING)


def _glare(sky: Sky, part: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Texels (H, W) that hang together with a clipped ``part`` and are brighter than its surroundings."""
    texels = np.flatnonzero(part)
    angle, ring = _ring(sky, texels, HALO)
    ring &= ~inside
    level = np.median(sky.grey[ring]) if ring.any() else 0.0
    near = angle < angle.ravel()[texels].max() + HALO
    labels = components(near & (part | (sky.grey > GLARE * level)))
    return np.isin(labels, np.unique(labels[part]))


def light_of(sky: Sky, texels: np.ndarray) -> Light:
    """The lamp that texels (N,) of a map are, over what a ring around them shows."""
    _, ring = _ring(sky, texels, np.radians(0.5))
    ring.ravel()[texels] = False
    values = sky.rgb.reshape(-1, 3)
    around = np.median(values[ring.ravel()], 0) if ring.any() else np.zeros(3)
    over = np.maximum(values[texels] - around, 0) * sky.solid_angles.ravel()[texels, None]
    bound = over.sum(0)
    share = np.where(bound > 0, over / np.where(bound > 0, bound, 1), 1 / len(texels))
    patch = sky.patch(texels, float(around.mean()))
    return Light(texels, patch.direction, patch.half_angle_rad, bound, around, share)


def held_by(shape: tuple[int, ...], found: list[Light]) -> np.ndarray:
    """The texels (H, W) of all lamps."""
    held = np.zeros(shape, bool)
    for light in found:
        held.ravel()[light.texels] = True
    return held


def without(rgb: np.ndarray, found: list[Light]) -> np.ndarray:
    """The map with every lamp replaced by the radiance around it."""
    rest = np.array(rgb, float)
    for light in found:
        rest.reshape(-1, 3)[light.texels] = light.around
    return rest
