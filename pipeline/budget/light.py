"""How the light may be wrong: a few patterns of radiance, each of one standard uncertainty, that move independently.

The map's stated variance has four parts with different shapes. What all texels share is *scale* (exposure between plate
and probe, reflectance of the ball). An emitter's *flux* is its own, as sure as it states. The rest of the sky is taken
in six smooth *lobes*, the squares of the direction's components, which sum to 1: errors of texels are alike within a
few pixels of the probe's picture (`pipeline.light.alike`). What no view saw moves as one, *unseen*. A wrong centre of
the ball or a wrong pose of the camera turns the whole map: three *turns*; not lamps that a shadow's edge places, which
turn by their own two, level and upright. How much the probe's picture widened lamps,
and so how soft their shadows are, is known to some percent: all lamps wider at once are one *width*. Which of them the
composite can notice is bounded by the irradiance they carry to the plane and to the six sides of an object; those that
together stay below a share of the variance are left out, and said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.rigid import rotation_exp, skew
from pipeline.conventions import (
    direction_from_latlong,
    latlong_directions,
    latlong_from_direction,
    latlong_solid_angles,
)
from pipeline.light.alike import alike_rows, cell_sums, own_sigma
from pipeline.light.environment import AXES, AXIS_NAMES, irradiance, resize_environment, total_energy
from pipeline.light.narrowing import measured, widened
from pipeline.light.placed import draw_disc, is_placed, turned_to, without_placed
from pipeline.types import BallFit, Emitter, Raster, View

BOUND_MAP = (64, 128)  # of the maps whose irradiance bounds a pattern
SKY_MAP = (256, 512)  # of the lobes: errors of texels are alike over several degrees
UNSEEN = 0.25  # coverage below which a texel was filled in, as the probe stage has it


@dataclass(frozen=True, eq=False)
class Lamps:
    """A map (H, W, 3) and the emitters in it, on its texels."""

    rgb: np.ndarray
    emitters: list[Emitter]


@dataclass(frozen=True, eq=False)
class Pattern:
    """One way for the light to be wrong, by one standard uncertainty.

    ``source``: scale, flux, sky, unseen, turn or width. Either ``factor`` (3,), relative, the same all round; or
    ``radiance`` (H, W, 3), what is added; or ``turn`` (3,), a rotation vector [rad] of the map in the world; or the map
    with other ``lamps``. ``bound``: largest change of irradiance, relative, on the plane and on the six sides of a box;
    of a width, and of a lamp's own turn, within penumbrae.
    """

    name: str
    source: str
    bound: float
    factor: np.ndarray | None = None
    radiance: np.ndarray | None = None
    turn: np.ndarray | None = None
    emitter: Emitter | None = None  # whose flux it is
    lamps: Lamps | None = None


def scale_patterns(covariance: np.ndarray) -> list[Pattern]:
    """Independent patterns of a covariance (3, 3) of the logarithms of the three channels, the largest first."""
    values, vectors = np.linalg.eigh(covariance)
    found: list[Pattern] = []
    for value, vector in sorted(zip(values, vectors.T), key=lambda pair: -pair[0]):
        if value > 1e-6 * max(values[-1], 1e-300):
            factor = np.sqrt(value) * vector * (1 if vector.sum() >= 0 else -1)
            name = "scale" if not found else f"tint_{len(found)}"
            found.append(Pattern(name, "scale", float(np.abs(factor).max()), factor=factor))
    return found


def scale_covariance(shared: np.ndarray, balance: np.ndarray | None) -> np.ndarray:
    """(3, 3) of log scale: the balance's, and what else the map's ``shared`` (3,) holds, in all channels alike."""
    known = np.zeros((3, 3)) if balance is None else np.asarray(balance)
    rest = np.sqrt(np.maximum(shared**2 - np.diag(known), 0))
    return known + np.outer(rest, rest)


def flux_patterns(environment: Raster, emitters: list[Emitter], shared: np.ndarray) -> list[Pattern]:
    """One pattern per emitter: all its texels by the relative sigma that it states, less what all light shares."""
    rgb, found = environment.rgb().astype(float), []
    level = sides(np.maximum(rgb, 0))
    height, width = environment.shape
    for emitter in emitters:
        inside = np.zeros((height, width, 1), bool)
        inside.reshape(-1)[np.asarray(emitter.texels, int)] = True
        stated = np.divide(
            emitter.irradiance_sigma, emitter.irradiance, out=np.zeros(3), where=np.asarray(emitter.irradiance) > 0
        )
        relative = np.sqrt(np.maximum(stated**2 - shared**2, 0))
        added = np.where(inside, rgb, 0) * relative
        bound = relative_change(sides(added), level)
        found.append(Pattern(f"flux_{emitter.name}", "flux", bound, radiance=added, emitter=emitter))
    return found


def sky_patterns(environment: Raster, emitters: list[Emitter], shared: np.ndarray) -> list[Pattern]:
    """The six lobes, and what nobody saw; emitters' texels are none of it. On `SKY_MAP` where the map is finer."""
    level, sigma = np.maximum(environment.rgb().astype(float), 0), own_sigma(environment, shared)
    before = sides(level)
    for emitter in emitters:
        level.reshape(-1, 3)[np.asarray(emitter.texels, int)] = 0
        sigma.reshape(-1, 3)[np.asarray(emitter.texels, int)] = 0
    seen = environment.channels.get("seen", np.ones(environment.shape))
    unseen = np.where((seen < UNSEEN)[..., None], sigma, 0)
    sigma, rows = sigma - unseen, alike_rows(environment)
    if environment.shape[0] > SKY_MAP[0]:
        level, sigma, unseen = (resize_environment(values, *SKY_MAP) for values in (level, sigma, unseen))
        rows = max(1, round(rows * SKY_MAP[0] / environment.shape[0]))
    height, width = level.shape[:2]
    directions, weight = latlong_directions(height, width), latlong_solid_angles(height, width)[..., None]
    unsure, energy = weight * sigma, weight * level
    lobes, sizes, changes, direct = [], [], [], np.zeros(3)
    for axis in AXES:
        cosine = np.maximum(directions @ axis, 0)[..., None]
        lobe = cosine**2
        size = np.sqrt((cell_sums(lobe * unsure, rows) ** 2).sum(0))
        size /= np.maximum(np.einsum("hwk,hwc->c", lobe, energy), 1e-300)
        lobes.append(lobe)
        sizes.append(size)
        changes.append(size * sides(lobe * level))
        direct += (cell_sums(cosine * unsure, rows) ** 2).sum(0)
    # Six numbers average what varies within a lobe: as much is given back as irradiance has of it.
    carried = np.square(changes).sum((0, 1))
    back = np.sqrt(np.divide(direct, carried, out=np.ones(3), where=carried > 0))
    found = []
    for name, lobe, size, change in zip(AXIS_NAMES, lobes, sizes, changes, strict=True):
        bound = relative_change(change * back, before)
        found.append(Pattern(f"sky_{name}", "sky", bound, radiance=lobe * level * (size * back)))
    if unseen.any():
        found.append(Pattern("unseen", "unseen", relative_change(sides(unseen), before), radiance=unseen))
    return [pattern for pattern in found if pattern.bound > 0]


def direction_covariance(balls: dict[str, BallFit], views: dict[str, View]) -> np.ndarray:
    """(3, 3) rad^2 of the map's rotation vector, world: pose of the ball's camera and where the ball was fitted.

    A centre off by c across the line of sight turns every normal by c / R, every mirrored direction by twice that; the
    camera's own rotation turns all. Views are averaged, so their covariances count by the square of their share.
    """
    total = np.zeros((3, 3))
    for name, ball in balls.items():
        rotation = views[name].world_from_camera[:3, :3]
        sight = rotation @ (ball.centre_camera_m / np.linalg.norm(ball.centre_camera_m))
        by_centre = 2 / ball.radius_m * skew(sight) @ rotation
        total += by_centre @ ball.covariance @ by_centre.T + np.asarray(views[name].covariance)[:3, :3]
    return total / max(len(balls), 1) ** 2


def turn_patterns(environment: Raster, emitters: list[Emitter], covariance: np.ndarray) -> list[Pattern]:
    """Three independent turns of the map by its covariance (3, 3) rad^2; placed lamps stay where they are."""
    values, vectors = np.linalg.eigh(covariance)
    rgb = environment.rgb()
    small = coarse(np.maximum(without_placed(rgb, emitters), 0))
    before, level = irradiance(small, AXES), sides(np.maximum(rgb, 0))
    found = []
    for number, (value, vector) in enumerate(sorted(zip(values, vectors.T), key=lambda pair: -pair[0])):
        if value > 0:
            turn = np.sqrt(value) * vector
            after = irradiance(small, AXES @ rotation_exp(turn))  # the light that came to R^T n now comes to n
            found.append(Pattern(f"turn_{number}", "turn", relative_change(after - before, level), turn=turn))
    return found


def turned(rgb: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """A map (H, W, 3) turned by a rotation vector (3,) [rad], bilinear; its energy is kept exactly."""
    height, width = rgb.shape[:2]
    u, v = latlong_from_direction(latlong_directions(height, width) @ rotation_exp(turn))
    column, row = u * width - 0.5, np.clip(v * height - 0.5, 0, height - 1)
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = (column - left)[..., None], (row - top)[..., None]
    below = np.minimum(top + 1, height - 1)
    upper = rgb[top, left % width] * (1 - across) + rgb[top, (left + 1) % width] * across
    lower = rgb[below, left % width] * (1 - across) + rgb[below, (left + 1) % width] * across
    result = upper * (1 - down) + lower * down
    energy = total_energy(result)
    return np.asarray(result * np.divide(total_energy(rgb), energy, out=np.ones(len(energy)), where=energy > 0))


def turned_texels(texels: np.ndarray, height: int, turn: np.ndarray) -> np.ndarray:
    """(M,) texels of a map of ``height`` rows on which `turned` leaves light of ``texels`` (N,), and those about them.

    What of a lamp is left to the sky, few samples meet; what of the sky is taken for a lamp, as many as the lamp.
    """
    width = 2 * height
    row, column = np.divmod(texels, width)
    directions = direction_from_latlong((column + 0.5) / width, (row + 0.5) / height)
    u, v = latlong_from_direction(directions @ rotation_exp(turn).T)
    right, down = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3))
    rows = np.clip((v * height).astype(int)[:, None] + down.ravel(), 0, height - 1)
    columns = ((u * width).astype(int)[:, None] + right.ravel()) % width
    return np.unique(rows * width + columns)


def width_patterns(environment: Raster, emitters: list[Emitter]) -> list[Pattern]:
    """All lamps wider by one sigma of their half angles, which one lens spread alike; none where none is unsure.

    Two distributions whose widths have the ratio c, about one point, differ by at most (1 - c) / 2 in what lies on one
    side of an edge, so by that share of a lamp's light in its penumbra.
    """
    if not any(emitter.half_angle_sigma_rad > 0 for emitter in emitters):
        return []
    rgb = environment.rgb().astype(float)
    lost = np.zeros(rgb.shape)
    for emitter in emitters:
        wide = emitter.half_angle_rad + emitter.half_angle_sigma_rad
        ratio = emitter.half_angle_rad / max(wide, 1e-9)
        texels = np.asarray(emitter.texels, int)
        lost.reshape(-1, 3)[texels] = (1 - ratio) / 2 * rgb.reshape(-1, 3)[texels]
    bound = relative_change(sides(lost), sides(np.maximum(rgb, 0)))
    return [Pattern("width", "width", bound, lamps=Lamps(*widened(rgb, emitters)))]


def lamp_turns(environment: Raster, emitters: list[Emitter]) -> list[Pattern]:
    """Two turns of every placed lamp by its own sigmas, level and upright; none of any other.

    The middle of a disc of half angle a lies 2 / (pi a) of its light per radian: more no edge can move.
    """
    rgb, found = environment.rgb().astype(float), []
    level = sides(np.maximum(rgb, 0)) if any(map(is_placed, emitters)) else np.zeros((6, 3))
    for number, emitter in enumerate(emitters):
        if not is_placed(emitter):
            continue
        texels = np.asarray(emitter.texels, int)
        alone = np.zeros(rgb.shape)
        alone.reshape(-1, 3)[texels] = rgb.reshape(-1, 3)[texels]
        share = 2 / (np.pi * max(emitter.half_angle_rad, 1e-9)) * emitter.direction_sigma_rad
        for word, angles, part in zip(("level", "upright"), np.diag(emitter.direction_sigma_rad), share, strict=True):
            flat = rgb.reshape(-1, 3).copy()
            there = emitter.model_copy(update={"direction": turned_to(emitter.direction, *angles)})
            half = emitter.half_angle_rad
            moved = measured(flat, draw_disc(flat, texels, there.direction, half), there, half, half)
            others = [*emitters[:number], moved, *emitters[number + 1 :]]
            bound = relative_change(min(float(part), 1.0) * sides(alone), level)
            name = f"turn_{emitter.name}_{word}"
            found.append(Pattern(name, "turn", bound, lamps=Lamps(flat.reshape(rgb.shape), others)))
    return found


def relative_change(change: np.ndarray, level: np.ndarray) -> float:
    """Largest ratio of the norms over RGB of irradiances (N, 3)."""
    before = np.linalg.norm(level, axis=1)
    return float(np.max(np.linalg.norm(change, axis=1) / np.maximum(before, 1e-300)))


def coarse(rgb: np.ndarray) -> np.ndarray:
    """A map (H, W, 3) on `BOUND_MAP`: its rows first, which lie in memory as they are summed."""
    return resize_environment(resize_environment(rgb, BOUND_MAP[0], rgb.shape[1]), *BOUND_MAP)


def sides(rgb: np.ndarray) -> np.ndarray:
    """Irradiance (6, 3) that a map (H, W, 3) gives the sides of a box."""
    return irradiance(coarse(rgb), AXES)


def worth_following(patterns: list[Pattern], share: float) -> tuple[list[Pattern], list[Pattern]]:
    """Those that are followed to the pixels, and those that together stay below a ``share`` of the squared bounds.

    Bounds of a width and of a lamp's turn hold in penumbrae alone: they make no other pattern small, and are left out
    below what is left out.
    """
    ordered = sorted((p for p in patterns if p.lamps is None), key=lambda pattern: pattern.bound)
    squares = np.cumsum([pattern.bound**2 for pattern in ordered])
    total = float(squares[-1]) if len(ordered) else 0.0
    few = int(np.searchsorted(squares, share * total)) if total > 0 else len(ordered)
    left = {pattern.name for pattern in ordered[:few]}
    left |= {pattern.name for pattern in patterns if pattern.lamps is not None and pattern.bound**2 < share * total}
    return [p for p in patterns if p.name not in left], [p for p in patterns if p.name in left]
