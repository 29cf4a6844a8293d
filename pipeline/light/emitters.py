"""Compact lights of a lat-long map as exact sets of its texels: suns, lamps; what none holds stays sky.

A light is a connected patch of texels above some level whose own brightness is ``SHARP`` times that level or more, so
that its border is real, and whose spread is small. Levels are octaves; the lowest at which a patch is both is taken, so
that the blur around a lamp belongs to it. Where a patch falls apart at a higher level into several lights that hold
most of its energy, these are taken and share the rest by nearness. The map is periodic in u, and all texels of the
first and of the last row touch at their pole. Groups are sets of texels: no energy is made, lost or moved.

Spread: a cap of half angle a and constant radiance has the mean direction of length (1 + cos a) / 2; a patch gets the
half angle of the cap whose mean direction, weighted by radiance, is as long (Mardia and Jupp, Directional Statistics,
2000, section 9.2: the mean resultant length).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles

SHARP = 5.0  # brightness of a light over the level at its border; panes of a window differ by 2 from their frames
FIRST_LEVEL = 1.0  # of the map's mean radiance
APART = 0.5  # of a patch's energy: what its parts must hold to be taken for several lights
WIDEST = np.radians(45)  # half angle of what is still called a bright patch


@dataclass(frozen=True, eq=False)
class Patch:
    """Connected bright texels. Vectors in the world frame, energies in the map's unit times steradian."""

    texels: np.ndarray  # (N,) flat indices, ascending
    direction: np.ndarray  # (3,), unit, weighted by radiance
    solid_angle_sr: float
    half_angle_rad: float
    irradiance: np.ndarray  # (C,), on a surface that faces ``direction``
    share: float  # of the map's scalar irradiance, mean of channels
    brightness: float  # mean radiance of the channels, weighted by itself
    level: float  # radiance that all of its texels exceed

    @property
    def sharp(self) -> bool:
        """Whether the radiance falls by ``SHARP`` within the patch."""
        return self.brightness >= SHARP * self.level


class Sky:
    """A map (H, W, C) with what is asked of its patches, computed once."""

    def __init__(self, rgb: np.ndarray) -> None:
        self.rgb = np.asarray(rgb, float)
        height, width = self.rgb.shape[:2]
        self.grey = np.maximum(np.where(np.isfinite(self.rgb), self.rgb, 0).mean(-1), 0)
        self.solid_angles = latlong_solid_angles(height, width)
        self.directions = latlong_directions(height, width)
        self.energy = self.grey * self.solid_angles
        self.total = float(self.energy.sum())
        sine = np.hypot(self.directions[..., 0], self.directions[..., 2])
        # Mean square distance from its centre within a texel, halved: what 1 - cos loses by taking centres only.
        self.inner = ((np.pi / height) ** 2 + (sine * 2 * np.pi / width) ** 2) / 24

    def patch(self, texels: np.ndarray, level: float) -> Patch:
        """Measures of a set of texels with some energy."""
        energy, directions = self.energy.ravel()[texels], self.directions.reshape(-1, 3)[texels]
        total = energy.sum()
        mean = energy @ directions / total
        length = float(np.linalg.norm(mean))
        direction = mean / length
        lost = 1 - length + float(energy @ self.inner.ravel()[texels] / total)
        cosine = directions @ direction * self.solid_angles.ravel()[texels]
        return Patch(
            texels, direction, float(self.solid_angles.ravel()[texels].sum()), float(np.arccos(max(1 - 2 * lost, -1))),
            cosine @ self.rgb.reshape(-1, self.rgb.shape[-1])[texels], float(total / self.total),
            float(energy @ self.grey.ravel()[texels] / total), level,
        )  # fmt: skip

    def patches(self, inside: np.ndarray, level: float, min_share: float) -> list[Patch]:
        """Connected patches (8 neighbours on the sphere) of ``inside`` (H, W) above a level, with their share or more.

        In the order of their first texel.
        """
        labels = components(inside & (self.grey > level))
        found = np.bincount(labels.ravel(), self.energy.ravel())
        found[0] = 0  # what is not inside
        return [
            self.patch(np.flatnonzero(labels.ravel() == label), level)
            for label in np.flatnonzero((found >= min_share * self.total) & (found > 0))
        ]


def components(inside: np.ndarray) -> np.ndarray:
    """Labels (H, W) of connected texels on the sphere, 0 outside; labels need not be contiguous."""
    from scipy.ndimage import label
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    labels, count = label(inside, np.ones((3, 3)))
    right, left = labels[:, -1], labels[:, 0]
    joined = [(right, left), (right[1:], left[:-1]), (right[:-1], left[1:])]
    joined += [(np.full(row.sum(), values[row].min(initial=count)), values[row])
               for values in (labels[0], labels[-1]) if (row := values > 0).any()]  # fmt: skip
    one, other = (np.concatenate(side) for side in zip(*joined, strict=True))
    both = (one > 0) & (other > 0)
    graph = coo_array((np.ones(both.sum()), (one[both], other[both])), shape=(count + 1, count + 1))
    merged = connected_components(graph, directed=False)[1] + 1
    merged[0] = 0
    return merged[labels]


def lights(rgb: np.ndarray, min_share: float, max_half_angle_rad: float) -> tuple[list[Patch], list[Patch]]:
    """Compact lights of a map (H, W, C), and the sharp bright patches too wide to be one; both strongest first.

    ``min_share`` of the scalar irradiance is the least that is looked at. Texels that are not finite count as black.
    """
    sky = Sky(rgb)
    if not sky.total > 0:
        return [], []
    found, wide = _search(sky, np.ones(sky.grey.shape, bool), 0, min_share, max_half_angle_rad)
    return sorted(found, key=lambda patch: -patch.share), sorted(wide, key=lambda patch: -patch.share)


def _search(
    sky: Sky, inside: np.ndarray, octave: int, min_share: float, max_half_angle_rad: float
) -> tuple[list[Patch], list[Patch]]:
    """Lights within ``inside`` at this octave or above, and the largest sharp patches that hold none."""
    level = FIRST_LEVEL * sky.total / (4 * np.pi) * 2.0**octave
    found, wide = [], []
    for patch in sky.patches(inside, level, min_share):
        within = np.zeros(sky.grey.shape, bool)
        within.ravel()[patch.texels] = True
        inner, inner_wide = _search(sky, within, octave + 1, min_share, max_half_angle_rad)
        compact = patch.sharp and patch.half_angle_rad <= max_half_angle_rad
        if compact and not (len(inner) > 1 and sum(part.share for part in inner) >= APART * patch.share):
            found.append(patch)
        elif compact:
            found += _shared_out(sky, patch, inner)
        else:
            found += inner
            wide += [patch] if patch.sharp and patch.half_angle_rad < WIDEST and not inner else inner_wide
    return found, wide


def _shared_out(sky: Sky, patch: Patch, parts: list[Patch]) -> list[Patch]:
    """The parts, each with those texels of the whole that no part holds and that are nearest to it."""
    nearest = np.argmax(sky.directions.reshape(-1, 3)[patch.texels] @ np.stack([p.direction for p in parts], 1), 1)
    for number, part in enumerate(parts):
        nearest[np.isin(patch.texels, part.texels)] = number
    return [sky.patch(patch.texels[nearest == number], patch.level) for number in range(len(parts))]
