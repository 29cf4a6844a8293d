"""A mirror ball and its shadow on a table, under a sky and lamps: photographs with known fluxes, by integration.

Shares no code with the estimators but the lens. The irradiance on the table is kept on a log-polar grid around the
ball's foot: light of the sky and what the ball blocks and mirrors of it by integrating over the ball's cone; light of a
lamp thrown back by the ball by scattering a dense bundle of rays; the table's light that the ball mirrors back, three
times over. Lamps are linear: made for unit flux, then scaled. World: +Y up, table y = 0, ball on the origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import (
    CLIPPED,
    invert_rigid,
    latlong_directions,
    latlong_solid_angles,
    transform_points,
)
from pipeline.simulation.lens import look_at
from pipeline.types import Camera, Raster, View

RADIUS = 0.04
SUN = np.radians(0.2665)  # half angle of the sun's disc
RINGS, SPOKES, INNER, OUTER = 44, 64, 0.05, 40.0  # log-polar grid; inner and outer ring in ball radii
ORDERS = 3  # of light between table and ball
CONE = (14, 28)  # radii and azimuths of the integral over the ball's cone
CENTRE = np.array([0.0, RADIUS, 0.0])


@dataclass(frozen=True)
class Lamp:
    """A disc of constant radiance. ``flux`` (3,) is its radiance times its solid angle."""

    direction: np.ndarray
    flux: np.ndarray
    half_angle: float = SUN


@dataclass(frozen=True)
class Scene:
    """Everything that is known: lens, pose, ball, lamps, and the reflectance of ball and table."""

    camera: Camera
    world_from_camera: np.ndarray
    lamps: tuple[Lamp, ...] = ()
    reflectance: np.ndarray = field(default_factory=lambda: np.array([0.85, 0.83, 0.8]))
    contrast: float = 1.0  # of the sky's own variation

    def sky(self, w: np.ndarray) -> np.ndarray:
        """Radiance (N, 3) from above without lamps: a bright side, a dark side, walls; mean about 1."""
        x, y, z = w.T
        wave = np.stack([0.5 * x + 0.2 * np.sin(3 * z), 0.4 * y + 0.3 * x * z, 0.3 * y - 0.3 * np.cos(4 * x)], -1)
        return np.maximum(1 + self.contrast * wave, 0.05)


def albedo(points: np.ndarray) -> np.ndarray:
    """Of the table (N, 3) at points (N, 3)."""
    x, _, z = points.T
    grain = 0.45 + 0.06 * np.sin(40 * x + 3 * np.sin(9 * z)) + 0.05 * np.sin(160 * z)
    board = (x > 0.1) & (x < 0.3) & (np.abs(z) < 0.1)
    check = np.where((np.floor(x / 0.03) + np.floor(z / 0.03)) % 2 > 0, 0.85, 0.1)
    return np.where(board, check, grain)[:, None] * (1.0, 0.9, 0.8)


def hit_ball(origin: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which rays meet the ball (N,), where (M, 3), and into which directions (M, 3) it throws them."""
    to_ball = CENTRE - origin
    along = (to_ball * w).sum(1)
    inside = RADIUS**2 - (to_ball**2).sum(1) + along**2
    hit = (inside > 0) & (along > 0)
    point = origin[hit] + (along[hit] - np.sqrt(inside[hit]))[:, None] * w[hit]
    normal = (point - CENTRE) / RADIUS
    return hit, point, w[hit] - 2 * (w[hit] * normal).sum(1, keepdims=True) * normal


def on_table(origin: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Where rays that go down meet y = 0, (N, 3)."""
    return origin - w * (origin[:, 1] / w[:, 1])[:, None]


def grid_points() -> np.ndarray:
    """Points (RINGS * SPOKES, 3) of the log-polar grid."""
    r = np.geomspace(INNER, OUTER, RINGS)[:, None] * RADIUS
    phi = 2 * np.pi * np.arange(SPOKES) / SPOKES
    return np.stack(np.broadcast_arrays(r * np.sin(phi), 0 * r, r * np.cos(phi)), -1).reshape(-1, 3)


def from_grid(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear in log radius and azimuth: (N, C) of values (RINGS * SPOKES, C)."""
    grid = values.reshape(RINGS, SPOKES, -1)
    r = np.hypot(points[:, 0], points[:, 2]) / RADIUS
    ring = np.clip(np.log(np.maximum(r, INNER) / INNER) / np.log(OUTER / INNER) * (RINGS - 1), 0, RINGS - 1.001)
    spoke = np.mod(np.arctan2(points[:, 0], points[:, 2]) / (2 * np.pi), 1) * SPOKES
    i, j = ring.astype(int), spoke.astype(int) % SPOKES
    a, b = (ring - i)[:, None], (spoke - spoke.astype(int))[:, None]
    near = grid[i, j] * (1 - b) + grid[i, (j + 1) % SPOKES] * b
    far = grid[i + 1, j] * (1 - b) + grid[i + 1, (j + 1) % SPOKES] * b
    return near * (1 - a) + far * a


def frame_of(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (N, 3) across unit vectors (N, 3)."""
    other = np.where(np.abs(w[:, 1:2]) > 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    u = np.cross(w, other)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(w, u)


def disc_of(direction: np.ndarray, half_angle: float, count: int = 8) -> np.ndarray:
    """Directions (M, 3) evenly over a lamp's disc: a spiral of equal areas."""
    n = count * count
    r = np.sqrt((np.arange(n) + 0.5) / n) * half_angle
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    u, v = (side[0] for side in frame_of(direction[None]))
    w = direction + (r * np.cos(turn))[:, None] * u + (r * np.sin(turn))[:, None] * v
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def visible(points: np.ndarray, lamp: Lamp) -> np.ndarray:
    """Fraction (N,) of a lamp's disc that the ball leaves free."""
    arm = CENTRE - points
    distance = np.linalg.norm(arm, axis=1)
    limit = np.arcsin(np.minimum(RADIUS / distance, 1))
    angle = np.arccos(np.clip(arm @ lamp.direction / distance, -1, 1))
    seen = np.asarray(angle > limit, float)
    edge = np.flatnonzero(np.abs(angle - limit) < lamp.half_angle)
    arm, limit = arm[edge] / distance[edge][:, None], np.cos(limit[edge])
    ways = disc_of(lamp.direction, lamp.half_angle)
    seen[edge] = (arm @ ways.T < limit[:, None]).mean(1)
    return seen


def scattered(lamp: Lamp, count: int = 800) -> np.ndarray:
    """Irradiance (RINGS * SPOKES,) that an ideal ball throws on the table from unit flux: a bundle of rays, counted."""
    r = np.sqrt((np.arange(count) + 0.5) / count) * RADIUS
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    u, v = (side[0] for side in frame_of(lamp.direction[None]))
    start = CENTRE + 4 * RADIUS * lamp.direction
    start = start + r[:, None, None] * (np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v)
    start = start.reshape(-1, 3)
    _, point, away = hit_ball(start, np.broadcast_to(-lamp.direction, start.shape))
    down = away[:, 1] < -1e-6
    place = on_table(point[down], away[down])
    step = np.log(OUTER / INNER) / (RINGS - 1)
    ring = np.log(np.hypot(place[:, 0], place[:, 2]) / RADIUS / INNER) / step
    spoke = np.mod(np.arctan2(place[:, 0], place[:, 2]) / (2 * np.pi), 1) * SPOKES
    i, j = np.rint(ring).astype(int), np.rint(spoke).astype(int) % SPOKES
    good = (i >= 0) & (i < RINGS)
    power = np.bincount(i[good] * SPOKES + j[good], minlength=RINGS * SPOKES) * np.pi * RADIUS**2 / len(start)
    edges = INNER * RADIUS * np.exp((np.arange(RINGS + 1) - 0.5) * step)
    area = np.repeat(np.diff(edges**2) / 2 * 2 * np.pi / SPOKES, SPOKES)
    return power / area


@dataclass(frozen=True)
class Table:
    """Irradiance on the table, RGB: under the sky with the ball, without it, and of each lamp at unit flux."""

    sky: np.ndarray  # (G, 3)
    sky_free: np.ndarray  # (3,)
    lamp: tuple[np.ndarray, ...]  # (G, 3) each: thrown by the ball and bounced; direct light is added where it is asked


def light_table(scene: Scene) -> Table:
    """Integrate: the ball's cone from every grid point, and the table's own light by turns."""
    points = grid_points()
    arm = CENTRE - points
    distance = np.linalg.norm(arm, axis=1)
    limit = np.arcsin(RADIUS / distance)
    u, v = frame_of(arm / distance[:, None])
    # Equal steps of 1 - cos are equal solid angles.
    mu = 1 - (1 - np.cos(limit))[:, None] * ((np.arange(CONE[0]) + 0.5) / CONE[0])
    turn = 2 * np.pi * (np.arange(CONE[1]) + 0.5) / CONE[1]
    side = np.sqrt(1 - mu**2)[..., None, None]
    w = mu[..., None, None] * (arm / distance[:, None])[:, None, None]
    w = w + side * (np.cos(turn)[:, None] * u[:, None, None] + np.sin(turn)[:, None] * v[:, None, None])
    w = w.reshape(-1, 3)
    origin = np.repeat(points, CONE[0] * CONE[1], 0)
    weight = np.maximum(w[:, 1], 0) * np.repeat(
        2 * np.pi * (1 - np.cos(limit)) / (CONE[0] * CONE[1]), CONE[0] * CONE[1]
    )
    blocked = (scene.sky(w) * weight[:, None]).reshape(len(points), -1, 3).sum(1)
    hit, place, away = hit_ball(origin, w)
    index, weight = np.repeat(np.arange(len(points)), CONE[0] * CONE[1])[hit], weight[hit]
    up = away[:, 1] > 0
    below = on_table(place[~up], away[~up] - (0, 1e-9, 0))

    def gathered(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        light = values * weight[chosen][:, None] * scene.reflectance
        return np.stack([np.bincount(index[chosen], light[:, c], len(points)) for c in range(3)], -1)

    free = sky_irradiance(scene)
    back = albedo(below) / np.pi

    def settled(direct: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Light (G, 3) with what the ball mirrors of the table's own; ``direct`` (M, 3) varies too fast for G."""
        total = light
        for _ in range(ORDERS):
            total = light + gathered(back * (direct + from_grid(total, below)), ~up)
        return total

    sky = settled(np.zeros((1, 3)), free - blocked + gathered(scene.sky(away[up]), up))
    lamps = []
    for lamp in scene.lamps:
        thrown = scattered(lamp)[:, None] * scene.reflectance if lamp.direction[1] > 0 else np.zeros((len(points), 3))
        direct = max(lamp.direction[1], 0) * visible(below, lamp)[:, None]
        lamps.append(settled(direct, thrown))
    return Table(sky, free, tuple(lamps))


def sky_irradiance(scene: Scene) -> np.ndarray:
    """(3,) on the free table: midpoints in sin^2 and azimuth, which makes every sample weigh the same."""
    sine, phi = np.meshgrid(np.sqrt((np.arange(400) + 0.5) / 400), 2 * np.pi * (np.arange(800) + 0.5) / 800)
    w = np.stack([sine * np.sin(phi), np.sqrt(1 - sine**2), sine * np.cos(phi)], -1).reshape(-1, 3)
    return np.pi * scene.sky(w).mean(0)


@dataclass(frozen=True)
class Pictures:
    """Plate and ball photograph (H, W, 3), noise-free: of the sky, and of each lamp at unit flux."""

    plate_sky: np.ndarray
    ball_sky: np.ndarray
    plate_lamp: tuple[np.ndarray, ...]
    ball_lamp: tuple[np.ndarray, ...]

    def at(self, fluxes: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Plate and ball photograph for these fluxes (3,) of the lamps."""
        plate, ball = self.plate_sky.copy(), self.ball_sky.copy()
        for flux, one, other in zip(fluxes, self.plate_lamp, self.ball_lamp, strict=True):
            plate += flux * one
            ball += flux * other
        return plate, ball


def photograph(scene: Scene, split: int = 2) -> Pictures:
    """Box-filtered pixels of ``split**2`` rays."""
    table, camera, lamps = light_table(scene), scene.camera, scene.lamps
    steps = (np.arange(split) + 0.5) / split
    y, x = np.mgrid[: camera.height, : camera.width]
    total = np.zeros((2 + 2 * len(lamps), camera.height * camera.width, 3))
    for dy in steps:
        for dx in steps:
            px = np.stack([(x + dx).ravel(), (y + dy).ravel()], -1)
            total += traced(scene, table, px)
    pictures = (total / split**2).reshape(-1, camera.height, camera.width, 3)
    made = Pictures(pictures[0], pictures[1], tuple(pictures[2 : 2 + len(lamps)]), tuple(pictures[2 + len(lamps) :]))
    for lamp, picture in zip(lamps, made.ball_lamp, strict=True):
        add_image(scene, lamp, picture)
    return made


def rays_of(scene: Scene, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (N, 3), world."""
    w = pixel_rays(scene.camera, px) @ scene.world_from_camera[:3, :3].T
    return np.broadcast_to(scene.world_from_camera[:3, 3], w.shape), w


def traced(scene: Scene, table: Table, px: np.ndarray) -> np.ndarray:
    """(2 + 2 K, N, 3): plate and ball under the sky, plates of each lamp, balls of each; discs themselves left out."""
    origin, w = rays_of(scene, px)
    out = np.zeros((2 + 2 * len(scene.lamps), len(px), 3))
    hit, place, away = hit_ball(origin, w)
    fill(scene, table, origin, w, out, np.arange(len(px)), with_ball=False)
    fill(scene, table, origin[~hit], w[~hit], out, np.flatnonzero(~hit), with_ball=True)
    mirrored = np.zeros((len(out), len(place), 3))
    fill(scene, table, place, away, mirrored, np.arange(len(place)), with_ball=True)
    chosen = [1, *range(2 + len(scene.lamps), len(out))]
    for row in chosen:
        out[row, hit] = mirrored[row] * scene.reflectance
    return out


def fill(
    scene: Scene, table: Table, origin: np.ndarray, w: np.ndarray, out: np.ndarray, at: np.ndarray, with_ball: bool
) -> None:
    """Radiance seen along rays that miss the ball, into rows of ``out``."""
    down = w[:, 1] < -1e-6
    points = on_table(origin[down], w[down])
    shade = albedo(points) / np.pi
    first, lamps = (1, 2 + len(scene.lamps)) if with_ball else (0, 2)
    out[first, at[~down]] = scene.sky(w[~down])
    out[first, at[down]] = shade * (from_grid(table.sky, points) if with_ball else table.sky_free)
    for number, lamp in enumerate(scene.lamps):
        direct = max(lamp.direction[1], 0.0) * np.ones((len(points), 1))
        if with_ball:
            direct = direct * visible(points, lamp)[:, None] + from_grid(table.lamp[number], points)
        out[lamps + number, at[down]] = shade * direct


def add_image(scene: Scene, lamp: Lamp, picture: np.ndarray, split: int = 24) -> None:
    """The lamp's own picture in the ball, at unit flux, added in place."""
    camera = scene.camera
    radiance = 1 / (2 * np.pi * (1 - np.cos(lamp.half_angle)))
    centre = project(camera, transform_points(invert_rigid(scene.world_from_camera), CENTRE[None]))[0]
    y, x = np.mgrid[: camera.height, : camera.width]
    px = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], -1)
    origin, w = rays_of(scene, px)
    hit, _, away = hit_ball(origin, w)
    pixel = np.flatnonzero(hit)[away @ lamp.direction > np.cos(lamp.half_angle + np.radians(4))]
    if not len(pixel) or not np.isfinite(centre).all():
        return
    steps = (np.arange(split) + 0.5) / split - 0.5
    for dy in steps:
        for dx in steps:
            origin, w = rays_of(scene, px[pixel] + (dx, dy))
            hit, _, away = hit_ball(origin, w)
            inside = away @ lamp.direction > np.cos(lamp.half_angle)
            at = pixel[np.flatnonzero(hit)[inside]]
            picture.reshape(-1, 3)[at] += radiance * scene.reflectance / split**2


def raster(
    picture: np.ndarray, clip: float, seed: int, noise: float = 0.01, floor: float = 1e-3, blur: float = 0.7
) -> Raster:
    """A developed photograph: blurred by the lens [px], with noise of the merged bracket, clipped above ``clip``.

    ``noise`` is relative (full frames of 10 000 electrons), ``floor`` absolute.
    """
    from scipy.ndimage import gaussian_filter

    seen = gaussian_filter(picture, (blur, blur, 0))
    sigma = np.hypot(noise * seen, floor)
    seen = seen + sigma * np.random.default_rng(seed).normal(size=seen.shape)
    over = (seen > clip).any(-1)
    seen = np.minimum(seen, clip)
    variance = np.where(over[..., None], np.inf, sigma**2)
    channels = {**Raster.split(seen.astype(np.float32)), **Raster.split(variance.astype(np.float32), "variance")}
    return Raster({**channels, "mask": np.where(over, CLIPPED, 0).astype(np.uint32)}, "acescg")


def from_angles(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Unit direction (3,): elevation over the table, azimuth about +Y from +Z towards +X."""
    e, a = np.radians(elevation_deg), np.radians(azimuth_deg)
    return np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])


def standard(
    radius_px: float = 100.0, width: int = 520, height: int = 400, target: tuple[float, ...] = (0, 0, 0)
) -> Scene:
    """A camera 0.55 m away, 35 degrees above the table, on +Z."""
    position = 0.55 * from_angles(35, 0)
    focal = radius_px * 0.55 / RADIUS
    camera = Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
    return Scene(camera, look_at(position, np.array(target, float)))


def view(world_from_camera: np.ndarray) -> View:
    """A pose known to 0.2 mm and 0.2 mrad."""
    return View(
        world_from_camera=world_from_camera, covariance=np.eye(6) * 2e-4**2, route="given", rms_px=0.1, points=20
    )


def facts(scene: Scene) -> dict[str, Any]:
    """What capture.toml would say: one ball photograph from the tripod."""
    probe = {"kind": "mirror_ball", "diameter_m": 2 * RADIUS, "reflectance": tuple(scene.reflectance)}
    return {"ball": [{"name": "ball", "tripod": True}], "probe": {**probe, "reflectance_space": "acescg"}}


def with_lamps(scene: Scene, *lamps: Lamp) -> Scene:
    """The same place under other lamps."""
    return replace(scene, lamps=lamps)


def true_map(scene: Scene, fluxes: list[np.ndarray], clip: float, height: int = 128) -> tuple[np.ndarray, np.ndarray]:
    """The map (H, 2H, 3) that a perfect probe would give of the free table, and what of it is clipped (H, 2H).

    Lamps are blurred to 1 degree and cut at ``clip``.
    """
    w = latlong_directions(height, 2 * height).reshape(-1, 3)
    up = w[:, 1] > 0
    rgb = np.zeros(w.shape)
    rgb[up] = scene.sky(w[up])
    total = sky_irradiance(scene)
    for lamp, flux in zip(scene.lamps, fluxes, strict=True):
        angle = np.arccos(np.clip(w @ lamp.direction, -1, 1))
        shape = np.exp(-0.5 * (angle / np.radians(1)) ** 2) * up
        rgb += flux * (shape / (shape @ latlong_solid_angles(height, 2 * height).ravel()))[:, None]
        total = total + max(lamp.direction[1], 0) * flux
    rgb[~up] = albedo(on_table(np.broadcast_to(CENTRE, w[~up].shape), w[~up] - (0, 1e-9, 0))) / np.pi * total
    over = (rgb > clip).any(-1) & up
    rgb[over] = np.minimum(rgb[over], clip)
    return rgb.reshape(height, -1, 3), over.reshape(height, -1).astype(float)
