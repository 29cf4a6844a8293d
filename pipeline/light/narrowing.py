"""Lamps as wide as they are: what the probe's picture spread is drawn together again, about the lamp's own centre.

A picture of a ball shows a lamp wider than it is: its pixels' boxes, the lens, demosaicking and the texels all spread a
point. Second moments add, so a lamp seen with half angle h by a spread s along each axis has ``a^2 = h^2 - 4 s^2``
(a uniform disc of half angle a has a^2 / 4). What a lamp's texels hold above their least is drawn together, about its
centre, so that its second moments become the lamp's and its irradiance stays; what was below stays as sky. A lamp that
the picture resolves (``a / h`` of `RESOLVED` or more) keeps its shape, at a / h of its size. The shape of a smaller one
is the picture's more than its own: it becomes the uniform ellipse of its moments.
A recovered lamp that its shadow's edge places (`pipeline.light.placed`) is drawn as the disc that the edge gives; one
that is clipped has no width to tell, and stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import (
    direction_from_latlong,
    latlong_directions,
    latlong_from_direction,
    latlong_solid_angles,
)
from pipeline.light.alike import pixel_rad, point_px, softness_of, views_of
from pipeline.light.emitters import Sky
from pipeline.light.placed import draw_disc, is_placed
from pipeline.types import Emitter, Raster

# What a point becomes in a map, in pixels of the probe's picture, where nothing tells how soft that is (else
# `pipeline.light.alike.point_px`): the middle of lenses of 0.55 to 0.85 px, with the pixel. Relative sigmas: of these
# lenses, and of one lamp in one view, whose place on mosaic and ball counts. See `benchmarks.sampled_lamps`.
SPREAD_PX = 1.11
LENS_SIGMA, LAMP_SIGMA = 0.05, 0.095
TEXELS = 2.0  # of the map that a lamp's radius is to hold, at least
FINEST = 2048  # columns; a map that is finer already stays
RESOLVED = 0.9  # of half angles, true over seen, from which on a lamp's shape is its own
POINTS = 4096  # that an ellipse is drawn with
PARTS = 6  # a texel is moved in PARTS x PARTS: its energy lands on texels no smaller than a quarter of it


@dataclass(frozen=True, eq=False)
class Drawn:
    """A map with its lamps on it; where nothing was narrowed, the same."""

    environment: Raster
    emitters: list[Emitter]


def spread_of(environment: Raster) -> float:
    """Standard deviation [rad] along an axis of what a point becomes in a map; 0 where it names no picture."""
    pixel, soft = pixel_rad(environment), softness_of(environment)
    if soft is None or pixel == 0:
        return SPREAD_PX * pixel
    return point_px(environment, float(np.sqrt(np.mean(soft**2)))) * pixel


def spread_sigma_of(environment: Raster) -> float:
    """Relative standard uncertainty of `spread_of`, of one lamp."""
    of_lens = LENS_SIGMA if softness_of(environment) is None else 0.0
    return float(np.hypot(of_lens, LAMP_SIGMA / np.sqrt(views_of(environment))))


def half_angle_of(seen_rad: float, spread_rad: float) -> float:
    """Half angle [rad] of a disc that a picture of this spread shows ``seen_rad`` wide; 0 of what may be a point."""
    return float(np.sqrt(max(seen_rad**2 - 4 * spread_rad**2, 0)))


def columns_for(width: int, half_angles: list[float]) -> int:
    """Columns of a map, ``width`` times a power of two, whose texels show the narrowest lamp; `FINEST` at most.

    Of a lamp that may be wider by a sigma, that is its width: texels finer than what is known show nothing more.
    """
    columns = width
    while columns < FINEST and min(half_angles) * columns / (2 * np.pi) < TEXELS:
        columns *= 2
    return columns


@dataclass(frozen=True, eq=False)
class Seen:
    """What a lamp's texels show: the least of it (3,), what exceeds that (N, 3), and how wide that is."""

    least: np.ndarray
    radiance: np.ndarray
    half_angle_rad: float


def above_least(rgb: np.ndarray, texels: np.ndarray) -> Seen:
    """What texels (N,) of a map (H * W, 3) show; its half angle as `pipeline.light.emitters` has one of a patch."""
    shown = rgb[texels]
    least = shown.min(0)
    height = round(np.sqrt(len(rgb) / 2))
    alone = np.zeros((height, 2 * height, 3))
    alone.reshape(-1, 3)[texels] = shown - least
    half = Sky(alone).patch(texels, 0.0).half_angle_rad if alone.any() else 0.0
    return Seen(least, shown - least, half)


def resized(
    radiance: np.ndarray, texels: np.ndarray, centre: np.ndarray, ratio: float, rows: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """What texels (N,) of ``radiance`` (N, 3) show, drawn to ``ratio`` of its size about ``centre`` (3,).

    ``rows`` of the map that the texels are of, and of the one that it is drawn on. Returns texels (M,), ascending, of
    the latter and what they gain (M, 3). The irradiance on a surface that faces the centre is kept exactly.
    """
    old, height = rows
    columns, parts = 2 * old, max(PARTS, int(np.ceil(PARTS * ratio)))
    inner = (np.arange(parts) + 0.5) / parts
    row, column = np.divmod(texels, columns)
    v, u = np.broadcast_arrays(
        ((row[:, None] + inner) / old)[:, :, None], ((column[:, None] + inner) / columns)[:, None, :]
    )
    ways = direction_from_latlong(u, v).reshape(-1, 3)
    along = ways @ centre
    across = ways - along[:, None] * centre
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, along)
    unit = across / np.maximum(sine, 1e-12)[:, None]
    moved = np.cos(ratio * angle)[:, None] * centre + np.sin(ratio * angle)[:, None] * unit
    right, down = latlong_from_direction(moved)
    places = np.minimum((down * height).astype(int), height - 1) * 2 * height
    places += np.minimum((right * 2 * height).astype(int), 2 * height - 1)
    part = np.sin(np.pi * v).reshape(len(texels), -1)
    part = (part / part.sum(1, keepdims=True)).ravel() * np.maximum(along, 0)
    landed, number = np.unique(places, return_inverse=True)
    energy = radiance * latlong_solid_angles(old, columns).ravel()[texels, None]
    energy = np.repeat(energy, parts**2, 0) * part[:, None]
    sums = np.stack([np.bincount(number, energy[:, channel], len(landed)) for channel in range(3)], 1)
    facing = latlong_solid_angles(height, 2 * height).ravel()[landed]
    facing *= latlong_directions(height, 2 * height).reshape(-1, 3)[landed] @ centre
    return landed, sums / facing[:, None]


def ellipse(
    seen: Seen, texels: np.ndarray, centre: np.ndarray, spread_rad: float, rows: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """As `resized`: a uniform ellipse of the moments of what texels show, less a spread [rad] along each axis.

    Its axes are those of the picture's moments, brought to the picture's half angle, which holds texels' own widths.
    """
    old, height = rows
    ways = latlong_directions(old, 2 * old).reshape(-1, 3)[texels]
    facing = latlong_solid_angles(old, 2 * old).ravel()[texels] * np.maximum(ways @ centre, 0)
    energy = facing @ seen.radiance
    across = np.cross(centre, np.eye(3)[np.argmin(np.abs(centre))])
    across /= np.linalg.norm(across)
    basis = np.stack([across, np.cross(centre, across)])
    flat = ways @ basis.T
    moments = np.einsum("n,ni,nj->ij", facing * seen.radiance.mean(-1), flat, flat)
    values, axes = np.linalg.eigh(moments * seen.half_angle_rad**2 / 2 / np.trace(moments))
    half_axes = 2 * np.sqrt(np.maximum(values - spread_rad**2, 0))
    r = np.sqrt((np.arange(POINTS) + 0.5) / POINTS)
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(POINTS)
    points = (np.stack([np.cos(turn), np.sin(turn)], 1) * r[:, None] * half_axes) @ axes.T @ basis
    right, down = latlong_from_direction(centre + points)
    places = np.minimum((down * height).astype(int), height - 1) * 2 * height
    places += np.minimum((right * 2 * height).astype(int), 2 * height - 1)
    landed, count = np.unique(places, return_counts=True)
    solid = latlong_solid_angles(height, 2 * height).ravel()[landed]
    solid = solid * (latlong_directions(height, 2 * height).reshape(-1, 3)[landed] @ centre)
    return landed, (count / POINTS / solid)[:, None] * energy


def finer(environment: Raster, factor: int) -> Raster:
    """A map with every texel cut into factor x factor."""
    if factor == 1:
        return environment
    channels = {name: values.repeat(factor, 0).repeat(factor, 1) for name, values in environment.channels.items()}
    return Raster(channels, environment.space, environment.attributes)


def within(texels: np.ndarray, width: int, factor: int) -> np.ndarray:
    """Flat indices of the parts of texels (N,) of a map ``width`` wide on one that is ``factor`` times finer."""
    row, column = np.divmod(np.asarray(texels, int), width)
    step = np.arange(factor)
    rows, columns = (row * factor)[:, None, None] + step[:, None], (column * factor)[:, None, None] + step
    return np.sort((rows * width * factor + columns).ravel())


def drawn(environment: Raster, emitters: list[Emitter], spread_rad: float) -> Drawn:
    """The map with every measured and every placed lamp as wide as it is; finer where that takes smaller texels.

    A lamp's texels are then those that it is drawn on; its ``irradiance`` is what they hold, its sigma stays.
    Variances go with the square of the light: they are relative to what a texel shows.
    """
    rows, columns = environment.shape
    radiance = environment.rgb().astype(float).reshape(-1, 3)
    seen = {
        number: above_least(radiance, np.asarray(emitter.texels, int))
        for number, emitter in enumerate(emitters)
        if emitter.evidence == "measured" and spread_rad > 0
    }
    seen = {number: picture for number, picture in seen.items() if picture.half_angle_rad > 0}
    placed = [emitter for emitter in emitters if is_placed(emitter)]
    if not seen and not placed:
        return Drawn(environment, emitters)
    unsure = spread_sigma_of(environment)
    narrow = [
        max(half_angle_of(picture.half_angle_rad, spread_rad * s) for s in (1, 1 - unsure)) for picture in seen.values()
    ]
    narrow += [emitter.half_angle_rad for emitter in placed]
    factor = columns_for(columns, narrow) // columns
    fine = finer(environment, factor)
    rgb, moved = fine.rgb().astype(float).reshape(-1, 3), []
    before = rgb.copy()
    for number, emitter in enumerate(emitters):
        texels = np.asarray(emitter.texels, int)
        parts = within(texels, columns, factor)
        if is_placed(emitter):
            half = emitter.half_angle_rad
            landed = draw_disc(rgb, parts, emitter.direction, half)
            moved.append(measured(rgb, landed, emitter, half, half + emitter.half_angle_sigma_rad))
            continue
        if number not in seen:
            moved.append(emitter.model_copy(update={"texels": parts}))
            continue
        picture, on = seen[number], (rows, rows * factor)
        true, wider = (half_angle_of(picture.half_angle_rad, spread_rad * s) for s in (1, 1 - unsure))
        if true >= RESOLVED * picture.half_angle_rad:
            ratio = true / picture.half_angle_rad
            landed, gained = resized(picture.radiance, texels, emitter.direction, ratio, on)
        else:
            landed, gained = ellipse(picture, texels, emitter.direction, spread_rad, on)
        rgb[parts] = picture.least
        rgb[landed] += gained
        moved.append(measured(rgb, landed, emitter, true, wider))
    return Drawn(redrawn(fine, before, rgb), moved)


def measured(rgb: np.ndarray, texels: np.ndarray, emitter: Emitter, half: float, wider: float) -> Emitter:
    """An emitter on texels (M,) of a map of radiance ``rgb`` (H * W, 3); half angles [rad], wider by one sigma."""
    height = round(np.sqrt(len(rgb) / 2))
    solid = latlong_solid_angles(height, 2 * height).ravel()[texels]
    facing = solid * (latlong_directions(height, 2 * height).reshape(-1, 3)[texels] @ emitter.direction)
    found = {
        "texels": texels, "solid_angle_sr": float(solid.sum()), "half_angle_rad": half,
        "half_angle_sigma_rad": wider - half, "irradiance": facing @ rgb[texels],
    }  # fmt: skip
    return emitter.model_copy(update=found)


def redrawn(environment: Raster, before: np.ndarray, after: np.ndarray) -> Raster:
    """A map with other radiance (H * W, 3), its variance in the same ratio to the squared light."""
    shape = environment.shape
    changed = np.flatnonzero((before != after).any(1))
    channels = {name: np.array(values) for name, values in environment.channels.items()}
    for number, name in enumerate("RGB"):
        channels[name] = after[:, number].reshape(shape).astype(np.float32)
        if f"variance.{name}" in channels:
            was = before[changed, number]
            ratio = np.divide(after[changed, number], was, out=np.ones(len(changed)), where=was > 0)
            channels[f"variance.{name}"].reshape(-1)[changed] *= (ratio**2).astype(np.float32)
    return Raster(channels, environment.space, environment.attributes)


def widened(rgb: np.ndarray, emitters: list[Emitter]) -> tuple[np.ndarray, list[Emitter]]:
    """A map (H, W, 3) whose lamps are each wider by the sigma of its half angle, of the same irradiance."""
    height, width = rgb.shape[:2]
    flat, texel = np.array(rgb, float).reshape(-1, 3), np.pi / height / 2
    moved = []
    for emitter in emitters:
        texels, half = np.asarray(emitter.texels, int), max(emitter.half_angle_rad, texel)
        wide = emitter.half_angle_rad + emitter.half_angle_sigma_rad
        if wide <= half:
            moved.append(emitter)
            continue
        shown = flat[texels].copy()
        least = shown.min(0) if len(texels) > 1 else np.zeros(3)
        landed, gained = resized(shown - least, texels, emitter.direction, wide / half, (height, height))
        flat[texels] = least
        flat[landed] += gained
        moved.append(measured(flat, np.union1d(texels, landed), emitter, wide, wide))
    return flat.reshape(height, width, 3), moved
