"""What the plane y = 0 looks like directly and in the ball, in one photograph: pairs of radiances, pixel by pixel.

A pixel of the ball is followed from the camera over the ball to the plane; the point it meets is seen directly at its
own pixel. The point is finite, so this is exact at any distance from the ball, and no reflection point has to be
solved for. For a diffuse plane both show the same radiance: mirrored over direct is the ball's reflectance, free of
exposure, since both stand in one photograph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import invert_rigid, transform_points
from pipeline.light.sampling import bilinear, planes
from pipeline.probes import sphere_fit
from pipeline.probes.glass import Glass, leaving
from pipeline.probes.observation import lookup_channels
from pipeline.types import Camera, Raster

SPLIT = 6  # rays per axis over what a pixel takes in
FAR = 2.0  # standard deviations of its blur, to either side
MAX_ACROSS = 160  # pixels across the ball that are looked at: larger balls are looked at in steps
NEAREST, FARTHEST = 1.3, 5.0  # distance from the foot, in radii: nearer is the contact's shadow, farther grazing
# How much farther balls of so many px begin, by their size's square: they do not resolve that shadow. From 1.3 to 1.7
# radii desk's table is 2 % darker in balls of 43 px than beside them, in balls of 86 px 0.1 %.
UNRESOLVED, UNRESOLVED_PX = 0.4, 43.0
BESIDE_PX = 4.0  # about the outline, where the direct picture may hold some of the ball
LOOKUP_ROW = 1024
AROUND = 2 * np.pi * np.arange(90) / 90


@dataclass(frozen=True)
class Sight:
    """One view of the ball: its picture (H, W, 8) as `lookup_channels` has it, lens, pose, centre in its frame [m].

    The picture may be a part of the photograph, in larger pixels: ``corner`` column and row, and ``binned`` pixels.
    ``glass`` before the mirror, if any. ``blur_px``: what a pixel takes in, standard deviation along an axis, in pixels
    of the picture; where nothing is said two pixels, as a tent.
    """

    picture: np.ndarray
    camera: Camera
    world_from_camera: np.ndarray
    centre: np.ndarray
    radius: float
    corner: tuple[int, int] = (0, 0)
    binned: int = 1
    glass: Glass | None = None
    blur_px: float | None = None


@dataclass(frozen=True)
class Pairs:
    """M pixels of the ball that mirror a visible point of the plane.

    ``pixel`` (M, 2) column and row; ``sine`` (M,) of the incidence; ``point`` (M, 3) world [m]; ``mirrored`` and
    ``direct`` (M, 3) radiance with ``mirrored_variance`` and ``direct_variance``; ``texture`` (M, 3): variance of the
    direct radiance within the pixel, which says what a displacement or a blur of one pixel would change; ``slope``
    (M,): sine of the elevation under which the point sees the ball; ``tilt`` (M,): that less the sine of the elevation
    under which it sees the camera; ``azimuth`` (M,) of the point about the ball's foot.
    """

    pixel: np.ndarray
    sine: np.ndarray
    point: np.ndarray
    mirrored: np.ndarray
    mirrored_variance: np.ndarray
    direct: np.ndarray
    direct_variance: np.ndarray
    texture: np.ndarray
    slope: np.ndarray
    tilt: np.ndarray
    azimuth: np.ndarray

    def __len__(self) -> int:
        return len(self.sine)

    def at(self, chosen: np.ndarray) -> Pairs:
        """The chosen ones."""
        return Pairs(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def neighbourhood(
    photograph: Raster, camera: Camera, world_from_camera: np.ndarray, centre: np.ndarray, radius: float,
    glass: Glass | None = None, blur_px: float | None = None,
) -> Sight:  # fmt: skip
    """The ball and the plane around it, as far as `FARTHEST`; binned when the ball is larger than needed.

    ``blur_px``: of a pixel of the photograph, see `Sight`.
    """
    size = np.array([camera.width, camera.height])
    outline = sphere_fit.silhouette(camera, centre, radius, AROUND)[0]
    around = FARTHEST * radius * np.stack([np.cos(AROUND), 0 * AROUND, np.sin(AROUND)], -1)
    local = transform_points(invert_rigid(world_from_camera), _foot(world_from_camera, centre) + around)
    px = np.concatenate([outline, project(camera, local)])
    px = np.clip(np.where(np.isfinite(px), px, 0), 0, size)  # what lies behind the camera: to the corner, at worst
    binned = max(1, int((outline.max(0) - outline.min(0)).max() // MAX_ACROSS))
    low = np.floor(px.min(0) / binned).astype(int) * binned
    shape = (np.minimum(np.ceil(px.max(0)), size).astype(int) - low) // binned
    high = low + shape * binned
    found = lookup_channels(photograph, (slice(low[1], high[1]), slice(low[0], high[0])))
    if binned > 1:
        found = found.reshape(shape[1], binned, shape[0], binned, 8).mean((1, 3))
        found[..., 3:6] /= binned**2
    moved = {
        "fx": camera.fx / binned, "fy": camera.fy / binned, "cx": (camera.cx - int(low[0])) / binned,
        "cy": (camera.cy - int(low[1])) / binned, "width": int(shape[0]), "height": int(shape[1]),
    }  # fmt: skip
    if blur_px is not None:
        blur_px = float(np.sqrt(blur_px**2 + (binned**2 - 1) / 12) / binned)
    return Sight(
        found, camera.model_copy(update=moved), world_from_camera, centre, radius, (int(low[0]), int(low[1])), binned,
        glass, blur_px,
    )  # fmt: skip


def plane_pairs(sight: Sight, limit: float = 0.97, every: bool = False, split: int | None = None) -> Pairs:
    """Pairs of one view; of ``every`` pixel, with fewer rays each, for what needs a picture of them.

    ``split``: rays per axis and pixel, if others than usual.

    Left out: incidence beyond ``limit``, points nearer to or farther from the foot than a few radii, out of the frame,
    hidden by the ball, and whatever touches an invalid or clipped pixel. The way from the ball to the plane is free:
    a reflected ray leaves a sphere for good.
    """
    picture, camera, world_from_camera = sight.picture, sight.camera, sight.world_from_camera
    centre, radius = sight.centre, sight.radius
    px = ball_pixels(sight, 1 if every else pixel_step(sight))
    spread, part = taken_in(split or (SPLIT // 2 if every else SPLIT), None if every else sight.blur_px)
    dx, dy = (offset.ravel() for offset in np.meshgrid(spread, spread))
    share = np.outer(part, part).ravel()
    _, sine, _, point = ball_points(sight, px + 0.5)
    foot = _foot(world_from_camera, centre)
    near = np.linalg.norm((point - foot)[:, ::2], axis=-1) / radius
    size_px = camera.fx * radius / np.linalg.norm(centre) * sight.binned
    nearest = NEAREST if every else NEAREST + UNRESOLVED * (UNRESOLVED_PX / size_px) ** 2
    keep = (sine < limit) & (near > nearest) & (near < (4 if every else 1) * FARTHEST)
    px, sine, point = px[keep], sine[keep], point[keep]
    if not len(px):
        return _none()
    fine = (px[:, None] + 0.5 + np.stack([dx, dy], -1)).reshape(-1, 2)
    _, _, _, there = ball_points(sight, fine)
    found, seen = _direct(picture, camera, world_from_camera, centre, radius, there)
    if sight.glass is not None and sight.glass.thickness != 0:
        found = _with_ghosts(sight, fine, found, picture[px[:, 1], px[:, 0], :3])
    found = found.reshape(len(px), -1, 8)
    own = picture[px[:, 1], px[:, 0]].astype(float)
    good = seen.reshape(len(px), -1).all(1) & (own[:, 6] > 0.999) & (own[:, 7] == 0)
    good &= (found[..., 6].min(1) > 0.999) & (found[..., 7].max(1) == 0)
    direct = np.einsum("mkc,k->mc", found[..., :3], share)
    texture = np.einsum("mkc,k->mc", (found[..., :3] - direct[:, None]) ** 2, share)
    variance = np.einsum("mkc,k->mc", found[..., 3:6], share)
    slope = radius / np.linalg.norm(point - foot - (0, radius, 0), axis=-1)
    position = world_from_camera[:3, 3]
    tilt = slope - position[1] / np.linalg.norm(position - point, axis=-1)
    azimuth = np.arctan2(*(point - foot)[:, ::2].T)
    return Pairs(px, sine, point, own[:, :3], own[:, 3:6], direct, variance, texture, slope, tilt, azimuth).at(good)


def taken_in(split: int, blur_px: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (split,) [px] along an axis, and what a pixel takes in from there: shares of a Gaussian, or a tent."""
    even = ((np.arange(split) + 0.5) / split - 0.5) * 2  # -1 to 1
    part = 1 - np.abs(even) if blur_px is None else np.exp(-((FAR * even) ** 2) / 2)
    part /= part.sum()
    return even if blur_px is None else even * blur_px / np.sqrt(part @ even**2), part


def _with_ghosts(sight: Sight, px: np.ndarray, found: np.ndarray, mirrored: np.ndarray) -> np.ndarray:
    """Direct values (N, 8) of pixels (N, 2) with what the glass's ghosts show mixed in, by their shares.

    ``mirrored`` (M, 3) of the ball's pixels, for its reflectance. Where a ghost's point is not seen, the pixel's own.
    """
    assert sight.glass is not None
    rays = len(px) // len(mirrored)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = mirrored / found[:, :3].reshape(-1, rays, 3).mean(1)
    usable = np.isfinite(ratio).all(1)
    facing = np.clip(np.median(ratio[usable], 0), 0.05, 1) if usable.any() else np.ones(3)
    rays_px = pixel_rays(sight.camera, px)
    sine = np.minimum(np.nan_to_num(ball_points(sight, px, rays_px)[1]), 1)
    mixed = found.copy()
    for order, share in zip((0, 2), sight.glass.ghosts(facing, sine), strict=True):
        ghost = replace(sight, glass=replace(sight.glass, order=order))
        there = ball_points(ghost, px, rays_px)[3]
        values, seen = _direct(
            sight.picture, sight.camera, sight.world_from_camera, sight.centre, sight.radius, np.nan_to_num(there)
        )
        seen &= np.isfinite(there).all(1) & (values[:, 6] > 0.999) & (values[:, 7] == 0)
        mixed[:, :3] += np.where(seen[:, None], share * (values[:, :3] - found[:, :3]), 0)
    return mixed


def ball_points(
    sight: Sight, px: np.ndarray, rays: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of pixels (N, 2), in the world: outward normal of the ball (N, 3), sine of the incidence (N,), reflected unit
    direction (N, 3), and point of y = 0 that it meets (N, 3).

    NaN where the ball is not hit; the point also where the direction does not go down. Of a glass ball the normal is
    that where the ray enters. ``rays`` (N, 3): those of the pixels, when they are at hand: most of the work.
    """
    centre, radius, world_from_camera = sight.centre, sight.radius, sight.world_from_camera
    rays = pixel_rays(sight.camera, px) if rays is None else rays
    along = rays @ centre
    inside = along**2 - centre @ centre + radius**2
    hit = (along - np.sqrt(np.where(inside >= 0, inside, np.nan)))[:, None] * rays
    normal = (hit - centre) / radius
    away = rays - 2 * np.einsum("ni,ni->n", rays, normal)[:, None] * normal
    (a, b, c), (u, v, w) = rays.T, normal.T
    sine = np.sqrt((b * w - c * v) ** 2 + (c * u - a * w) ** 2 + (a * v - b * u) ** 2)
    if sight.glass is not None:
        outward, away = leaving(sight.glass, rays, normal)
        hit = centre + radius * outward
    rotation, position = world_from_camera[:3, :3], world_from_camera[:3, 3]
    start, away = hit @ rotation.T + position, away @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(away[:, 1] < 0, -start[:, 1] / away[:, 1], np.nan)
    return normal @ rotation.T, sine, away, start + reach[:, None] * away


def ball_pixels(sight: Sight, step: int) -> np.ndarray:
    """Columns and rows (N, 2) of pixels about the ball, ``step`` apart."""
    low, high = _box(sight)
    columns, rows = np.arange(low[0], high[0] + 1, step), np.arange(low[1], high[1] + 1, step)
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)


def pixel_step(sight: Sight) -> int:
    """Every how many pixels a ball of this size is looked at."""
    low, high = _box(sight)
    return max(1, int(np.ceil((high - low).max() / MAX_ACROSS)))


def _box(sight: Sight) -> tuple[np.ndarray, np.ndarray]:
    outline = sphere_fit.silhouette(sight.camera, sight.centre, sight.radius, AROUND)[0]
    size = np.array([sight.camera.width, sight.camera.height])
    low = np.clip(np.floor(outline.min(0)), 1, size - 2).astype(int)
    return low, np.clip(np.ceil(outline.max(0)), 1, size - 2).astype(int)


def _foot(world_from_camera: np.ndarray, centre: np.ndarray) -> np.ndarray:
    foot = world_from_camera[:3, :3] @ centre + world_from_camera[:3, 3]
    foot[1] = 0
    return foot


def _direct(
    picture: np.ndarray, camera: Camera, world_from_camera: np.ndarray, centre: np.ndarray, radius: float,
    point: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Values (N, 8) of the pixels where world points (N, 3) are seen, and whether they are (N,)."""
    camera_from_world = invert_rigid(world_from_camera)
    local = point @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    px = project(camera, local)
    distance = float(np.linalg.norm(centre))
    with np.errstate(invalid="ignore"):
        length = np.sqrt(np.einsum("ni,ni->n", local, local))
        away = np.arccos(np.clip(local @ (centre / distance) / length, -1, 1))
        beside = np.arcsin(radius / distance) + BESIDE_PX / min(camera.fx, camera.fy)
        (x, y), right, bottom = px.T, camera.width - 1, camera.height - 1
        seen = (x > 1) & (y > 1) & (x < right) & (y < bottom) & (away > beside)
    shape = (-(-len(px) // LOOKUP_ROW), LOOKUP_ROW)  # OpenCV takes at most 32767 positions in one row
    x, y = (np.resize(np.where(seen, px[:, i], 1), shape) for i in (0, 1))
    return bilinear(planes(picture), x, y).reshape(-1, picture.shape[2])[: len(px)].astype(float), seen


def _none() -> Pairs:
    rows, none = np.zeros((0, 3)), np.zeros(0)
    return Pairs(np.zeros((0, 2), int), none, rows, rows, rows, rows, rows, rows, none, none, none)
