"""Lamps that several views mirror tie their balls' centres: one lamp is in one place, whoever looks at the ball.

A view's directions turn with its ball's centre, by two radians over the ball's radius: where a rim is weak, a lamp is
mirrored degrees from where another view shows it, and a map of both has it twice, or twice as bright where one view's
weight ends. Small bright spots are matched between views by direction and light; then centres, the poses' rotations,
and every lamp's direction and inverse distance are adjusted together to where the spots are seen, each with what is
known of it before (bundle adjustment; Triggs et al. 2000). A distance is needed, as a ball's points lie apart: of a
lamp at two metres two views differ by up to R / 2 m.

What ties two centres does not say where both are. They keep their covariances, which whoever takes the views' mean
counts as independent: that mean is then as sure as the tied centres are. Where the views contradict each other beyond
their sigmas, these are raised (Birge 1932).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.camera.rigid import rotation_exp
from pipeline.conventions import transform_points
from pipeline.image.small_lights import candidates
from pipeline.probes.finding import Found
from pipeline.probes.glass import Glass
from pipeline.probes.outline import radius_in_pixels
from pipeline.probes.reflection import direction_sigma, directions_from_rays, rays_from_directions
from pipeline.types import Camera, Raster, View

INSIDE = 0.93  # of the outline: spots beyond are drawn out to lines
SPOT_PX = 0.15  # of a spot's centroid; in a mosaic one of 3 px is off by up to a tenth
NEAREST_M = 1.5  # of lamps, as a sigma of the inverse distance
NEAR_SIGMA, NEAR_RAD = 3.0, np.radians(3.0)  # within which spots may be one lamp: of the balls' directions, and apart
SAME_LIGHT, SAME_COLOUR = np.log(1.6), np.log(1.3)
ASTRAY = 1 / 3000  # chance of a lamp's residuals, below which its spots are several lamps


@dataclass(frozen=True)
class Spot:
    """Centroid (2,) [px], and light (3,) over the area of the ball's picture."""

    px: np.ndarray
    light: np.ndarray


@dataclass(frozen=True)
class Seen:
    """What a view is for this: where it is, its ball, its spots and their directions (N, 3), world."""

    camera: Camera
    view: View
    ball: Found
    spots: list[Spot]
    ways: np.ndarray
    sigma_rad: float


def tied(
    found: dict[str, Found], photographs: dict[str, Raster], cameras: dict[str, Camera], views: dict[str, View],
    radius: float, glass: Glass | None = None,
) -> tuple[dict[str, Found], dict[str, Any]]:  # fmt: skip
    """The balls with centres adjusted to the lamps that several views show, and what that measured.

    As they were where fewer than two views show one lamp.
    """
    from scipy.special import gammaincc

    seen = {name: _seen(found[name], photographs[name], cameras[name], views[name], radius, glass) for name in found}
    tracks = _tracks(list(seen.values()))
    while tracks:
        solved, total, chi2 = _adjusted(list(seen.values()), tracks, radius, glass)
        freedoms = [2 * len(track) - 2 for track in tracks]
        chances = gammaincc(np.array(freedoms) / 2, chi2 / 2)
        worst = int(np.argmin(chances))
        if chances[worst] >= ASTRAY:
            break
        tracks.pop(worst)
    if not tracks:
        return found, {"lamps": 0}
    excess = max(1.0, total / sum(freedoms))
    result, moved = dict(found), {}
    for number, name in enumerate(found):
        fit, change = found[name].fit, solved[6 * number : 6 * number + 3]
        centre = fit.centre + change
        across = change - (change @ centre) / (centre @ centre) * centre
        moved[name] = float(np.linalg.norm(across) * fit.radius_px / radius)
        size = radius_in_pixels(cameras[name], centre, radius)
        fit = replace(fit, centre=centre, covariance=excess * fit.covariance, radius_px=size)
        there = transform_points(views[name].world_from_camera, centre)
        result[name] = replace(found[name], fit=fit, centre_world=there)
    return result, {"lamps": len(tracks), "chi2": total, "freedoms": sum(freedoms), "moved_px": moved}


def reason(measured: dict[str, Any]) -> dict[str, Any]:
    """Whether lamps tied the views' centres, and by how much they moved them."""
    count = measured["lamps"]
    moved = ", ".join(f"{name} by {pixels:.2f} px" for name, pixels in measured.get("moved_px", {}).items())
    row = {
        "term": "centres by lamps that several views mirror",
        "modelled": count > 0,
        "because": f"{count} in the same place to chi2 {measured['chi2']:.1f} of {measured['freedoms']}: moved {moved}"
        if count
        else "no small lamp is mirrored in two views",
        "could_cost": "lamps that a map has twice, and twice the light where one view's weight ends",
    }
    return row if count else {**row, "no_bound": "it is in the sigma of the views' directions"}


def _seen(
    ball: Found, photograph: Raster, camera: Camera, view: View, radius: float, glass: Glass | None
) -> Seen:  # fmt: skip
    rgb, centre = photograph.rgb(), ball.fit.centre
    grey = np.where(np.isfinite(rgb), rgb, 0).sum(-1)
    limit = np.cos(np.arcsin(INSIDE * radius / np.linalg.norm(centre)))
    spots = []
    for (row, column), reach in candidates(grey):
        top, left = row - reach, column - reach
        part = np.s_[max(top, 0) : row + reach + 1, max(left, 0) : column + reach + 1]
        rows, columns = np.mgrid[part]
        near = (rows - row) ** 2 + (columns - column) ** 2 <= reach**2
        level = np.median(rgb[part][~near], 0) if (~near).any() else np.zeros(3)
        light = np.maximum(rgb[part] - level, 0) * near[..., None]
        weight = light.sum(-1)
        px = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum() + 0.5
        ray = pixel_rays(camera, px[None])[0]
        if ray @ centre > limit * np.linalg.norm(centre):
            spots.append(Spot(px, light.sum((0, 1)) / ball.fit.radius_px**2))
    rays = pixel_rays(camera, np.array([spot.px for spot in spots]).reshape(-1, 2))
    ways = directions_from_rays(rays, centre, radius, glass) @ view.world_from_camera[:3, :3].T
    return Seen(camera, view, ball, spots, ways, direction_sigma(centre, ball.fit.covariance, radius, glass))


def _tracks(seen: list[Seen]) -> list[dict[int, int]]:
    """Spots that are one lamp, by view; those that could be two are left out."""
    tracks: list[dict[int, int]] = []
    for first in range(len(seen)):
        for spot in range(len(seen[first].spots)):
            if any(track.get(first) == spot for track in tracks):
                continue
            track = {first: spot}
            for other in range(first + 1, len(seen)):
                there = _alike(seen[first], spot, seen[other])
                if len(there) == 1 and len(_alike(seen[other], there[0], seen[first])) == 1:
                    track[other] = there[0]
            if len(track) > 1:
                tracks.append(track)
    return tracks


def _alike(one: Seen, spot: int, other: Seen) -> list[int]:
    """Numbers of the other view's spots that could be this lamp."""
    reach = NEAR_SIGMA * np.hypot(one.sigma_rad, other.sigma_rad) + NEAR_RAD
    found = []
    for number, there in enumerate(other.spots):
        ratio = np.log(np.maximum(there.light, 1e-30) / np.maximum(one.spots[spot].light, 1e-30))
        same = abs(ratio.mean()) < SAME_LIGHT and np.abs(ratio - ratio.mean()).max() < SAME_COLOUR
        if same and other.ways[number] @ one.ways[spot] > np.cos(reach):
            found.append(number)
    return found


def _adjusted(
    seen: list[Seen], tracks: list[dict[int, int]], radius: float, glass: Glass | None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Changes (6 V + 3 L,) of centres [m], rotations [rad] and directions; chi2 of all, and (L,) of each lamp."""
    from scipy.optimize import least_squares

    middle = np.mean([one.ball.centre_world for one in seen], 0)
    roots = [
        np.linalg.inv(np.linalg.cholesky(part + 1e-18 * np.eye(3)))
        for one in seen
        for part in (one.ball.fit.covariance, one.view.covariance[:3, :3])
    ]
    start, frames = np.zeros(6 * len(seen) + 3 * len(tracks)), []
    for track in tracks:
        way = np.mean([seen[view].ways[spot] for view, spot in track.items()], 0)
        frames.append(np.linalg.svd(way[None] / np.linalg.norm(way))[2])
        frames[-1][0] = way / np.linalg.norm(way)

    def of_lamp(x: np.ndarray, number: int) -> np.ndarray:
        along, one, two = frames[number]
        first, second, inverse = x[6 * len(seen) + 3 * number :][:3]
        way = along + first * one + second * two
        way = way / np.linalg.norm(way)
        misses = [np.array([inverse * NEAREST_M])]
        for view, spot in tracks[number].items():
            change, turn = x[6 * view : 6 * view + 3], x[6 * view + 3 : 6 * view + 6]
            px = _mirrored(seen[view], change, turn, (way, inverse), middle, radius, glass)
            misses.append((px - seen[view].spots[spot].px) / SPOT_PX)
        return np.concatenate(misses)

    def misses(x: np.ndarray) -> np.ndarray:
        known = [root @ x[3 * i : 3 * i + 3] for i, root in enumerate(roots)]
        return np.concatenate([*known, *(of_lamp(x, number) for number in range(len(tracks)))])

    scale = np.concatenate([np.tile([1e-4] * 3 + [1e-3] * 3, len(seen)), np.tile([1e-2, 1e-2, 0.1], len(tracks))])
    found = least_squares(misses, start, x_scale=scale, method="trf", max_nfev=50)
    chi2 = np.array([float((of_lamp(found.x, number) ** 2).sum()) for number in range(len(tracks))])
    return found.x, float(2 * found.cost), chi2


def _mirrored(
    one: Seen, change: np.ndarray, turn: np.ndarray, lamp: tuple[np.ndarray, float], middle: np.ndarray,
    radius: float, glass: Glass | None,
) -> np.ndarray:  # fmt: skip
    """Pixel (2,) where a view mirrors a lamp: its direction (3,) from ``middle`` and inverse distance [1/m]."""
    way, inverse = lamp
    centre = one.ball.fit.centre + change
    distance = float(np.linalg.norm(centre))
    rotation = rotation_exp(turn) @ one.view.world_from_camera[:3, :3]
    aside = one.ball.centre_world - middle
    towards = way
    for _ in range(3):
        local = towards @ rotation
        normal = local / np.linalg.norm(local) - centre / distance
        point = aside + radius * (rotation @ (normal / np.linalg.norm(normal)))
        towards = way - inverse * point
    local = towards @ rotation / np.linalg.norm(towards)
    ray = rays_from_directions(local[None], -centre / distance, radius / distance, glass)[0]
    return np.asarray(project(one.camera, ray)[0])
