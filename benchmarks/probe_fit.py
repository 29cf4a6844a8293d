"""How well a mirror ball is fitted: simulated rims against their truth, and what orthographic tools make of them."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes import sphere_fit
from pipeline.probes.anchor import anchored
from pipeline.probes.finding import Found, measured
from pipeline.probes.outline import Height, azimuths, radius_in_pixels, silhouette
from pipeline.probes.reflection import directions_from_rays
from pipeline.types import Camera, Raster, View
from tests.mirror_scene import Lamp, Place, look_at, sky

RADIUS = 0.04


@dataclass(frozen=True)
class Setup:
    """One simulated photograph of a ball: distance over radius, off axis [deg], radius and blur [px], noise, seed."""

    distance_ratio: float = 10.0
    off_axis_deg: float = 0.0
    radius_px: float = 100.0
    blur_px: float = 0.6
    noise: float = 0.005
    reflectance: float = 0.9
    plane: bool = True
    seed: int = 0
    mosaic: bool = False
    margin: float = 1.4


class Table(Place):
    """The plane with grain of many scales, a board on it, and the ball's ambient and lamp shadows."""

    def radiance(self, origin: np.ndarray, w: np.ndarray) -> np.ndarray:
        """RGB (N, 3): as `Place`, the plane shaded and with grain."""
        rgb = super().radiance(origin, w)
        if not self.plane:
            return rgb
        below = w[:, 1] < -1e-9
        t = np.where(below, -origin[:, 1] / np.where(below, w[:, 1], 1), 0)
        hit = origin + t[:, None] * w
        x, z = hit[:, 0], hit[:, 2]
        grain = 1 + sum(
            0.04 * np.sin(2 * np.pi * (x * np.cos(1.7 * k) + 3 * z * np.sin(1.7 * k)) / (0.09 / 1.6**k) + k * k)
            for k in range(6)
        )
        near = np.linalg.norm(hit - np.asarray(self.ball), axis=1) if self.ball is not None else np.full(len(w), np.inf)
        ambient = 1 - self.radius**3 / near**3  # the sphere's form factor from a point of the plane
        lamp = np.array((0.5, 0.8, 0.3)) / np.linalg.norm((0.5, 0.8, 0.3))
        across = np.linalg.norm(np.cross(hit - np.asarray(self.ball), lamp), axis=1) if self.ball is not None else near
        shadow = 1 - 0.4 * np.clip((self.radius + 0.004 - across) / 0.008, 0, 1)
        return np.where(below[:, None], rgb * (grain * ambient * shadow)[:, None], rgb)


def scene(setup: Setup) -> tuple[Place, Camera, np.ndarray]:
    """Place, camera that holds the ball alone, and pose, all drawn from the seed."""
    rng = np.random.default_rng(setup.seed)
    lamps = [Lamp((rng.normal(), rng.uniform(0.5, 1.5), rng.normal()), 0.06, 100.0)]
    place = Table(sky(lamps), plane=setup.plane, ball=(0.0, RADIUS, 0.0), radius=RADIUS, reflectance=setup.reflectance)
    turn, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(25, 50))
    toward = np.array([np.cos(rise) * np.cos(turn), np.sin(rise), np.cos(rise) * np.sin(turn)])
    pose = look_at(tuple(np.array([0, RADIUS, 0]) + setup.distance_ratio * RADIUS * toward), (0, RADIUS, 0))
    off, about = np.radians(setup.off_axis_deg), rng.uniform(0, 2 * np.pi)
    spin = np.array([np.cos(about), np.sin(about), 0])
    cross = np.array([[0, 0, spin[1]], [0, 0, -spin[0]], [-spin[1], spin[0], 0]])
    pose[:3, :3] = pose[:3, :3] @ (np.eye(3) + np.sin(off) * cross + (1 - np.cos(off)) * cross @ cross)
    focal = setup.radius_px / np.tan(np.arcsin(1 / setup.distance_ratio)) * np.cos(off) ** 1.5
    centre = transform_points(invert_rigid(pose), np.array([0, RADIUS, 0]))
    x, y = focal * centre[:2] / centre[2]
    half = int(setup.margin * setup.radius_px / np.cos(off)) + 12
    jitter = rng.uniform(-0.5, 0.5, 2)
    camera = Camera(
        width=2 * half, height=2 * half, fx=focal, fy=focal, cx=half - x + jitter[0], cy=half - y + jitter[1]
    )
    return place, camera, pose


def picture(setup: Setup, split: int = 5) -> tuple[Raster, Place, Camera, np.ndarray]:
    """The photograph (ACEScg, variance known), what it shows, its camera, and world_from_camera."""
    from scipy.ndimage import gaussian_filter

    place, camera, pose = scene(setup)
    fine = camera.model_copy(
        update={
            "width": camera.width * split, "height": camera.height * split,
            **{name: getattr(camera, name) * split for name in ("fx", "fy", "cx", "cy")},
        }
    )  # fmt: skip
    total = traced(place, fine, pose)
    if setup.blur_px:
        total = gaussian_filter(total, (setup.blur_px * split, setup.blur_px * split, 0), truncate=4)
    rgb = total.reshape(camera.height, split, camera.width, split, 3).mean((1, 3))
    rng = np.random.default_rng(setup.seed + 1000)
    level = float(np.median(rgb))
    sigma = setup.noise * np.sqrt(np.maximum(rgb, 0) * level + (0.2 * level) ** 2)
    rgb = rgb + sigma * rng.normal(size=rgb.shape)
    if setup.mosaic:
        rgb = demosaicked(rgb)
    mask = np.zeros(rgb.shape[:2], np.uint32)
    channels = {**Raster.split(np.float32(rgb)), **Raster.split(np.float32(sigma**2), "variance"), "mask": mask}
    return Raster(channels, "acescg"), place, camera, pose


def traced(place: Place, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """(H, W, 3): one ray through each pixel's centre of a pinhole."""
    y, x = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    out = np.empty((camera.height, camera.width, 3), np.float32)
    rows = max(1, 60000 // camera.width)
    for top in range(0, camera.height, rows):
        part = slice(top, top + rows)
        xy = [(x[part].ravel() - camera.cx) / camera.fx, (y[part].ravel() - camera.cy) / camera.fy]
        rays = np.stack([*xy, np.ones_like(xy[0])], -1) @ pose[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        out[part] = place.traced(np.broadcast_to(pose[:3, 3], rays.shape), rays).reshape(-1, camera.width, 3)
    return out


def demosaicked(rgb: np.ndarray) -> np.ndarray:
    """The picture through an RGGB mosaic and the bilinear interpolation of its gaps."""
    from scipy.ndimage import convolve

    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]]
    sites = [(y % 2 == 0) & (x % 2 == 0), (y + x) % 2 == 1, (y % 2 == 1) & (x % 2 == 1)]
    kernel = np.array([[0.25, 0.5, 0.25], [0.5, 1, 0.5], [0.25, 0.5, 0.25]])
    return np.stack(
        [convolve(rgb[..., c] * s, kernel) / convolve(s.astype(float), kernel) for c, s in enumerate(sites)], -1
    )


def rays_over_disc(centre: np.ndarray, radius: float, rim: float) -> np.ndarray:
    """Unit rays (2000, 3), evenly over the area of the disc r < ``rim`` of a ball's silhouette."""
    rng = np.random.default_rng(0)
    r, angle = rim * np.sqrt(rng.random(2000)), 2 * np.pi * rng.random(2000)
    axis = centre / np.linalg.norm(centre)
    second, first = np.linalg.svd(axis[None])[2][1:]
    sine = r * radius / np.linalg.norm(centre)
    spokes = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return np.sqrt(1 - sine**2)[:, None] * axis + sine[:, None] * spokes


def direction_rms_deg(fitted: np.ndarray, true: np.ndarray, radius: float = RADIUS, rim: float = 0.9) -> float:
    """Error [deg] of mirrored directions over the disc r < ``rim`` of the true silhouette, weighted by its area."""
    rays = rays_over_disc(true, radius, rim)
    two = [directions_from_rays(rays, centre, radius) for centre in (fitted, true)]
    return float(np.degrees(np.sqrt(np.nanmean(np.arccos(np.clip((two[0] * two[1]).sum(1), -1, 1)) ** 2))))


def fitted(setup: Setup, start_px: float = 0.7, on_plane: bool = False) -> dict[str, float]:
    """One simulated ball, fitted from a start that is ``start_px`` off: errors, predicted sigma, blur.

    ``on_plane``: with the plane, its height and its mirror image, as the stage has it; else by the rim alone.
    """
    raster, place, camera, pose = picture(setup, 5 if setup.radius_px < FINE_PX else 3)
    true = transform_points(invert_rigid(pose), np.array(place.ball, float))
    size = radius_in_pixels(camera, true, RADIUS)
    off = start_px * np.random.default_rng(setup.seed + 7).normal(size=3)
    start = true * (1 + off[2] / size) + np.array([off[0], off[1], 0]) * RADIUS / size
    height = Height(pose[1, :3].copy(), float(pose[1, 3]), 5e-3 * RADIUS) if on_plane else None
    fit, free = sphere_fit.fit_sphere(*measured(raster), camera, RADIUS, start, height)
    if height is not None:  # as the stage does: joined with the plane's mirror image
        view = View(world_from_camera=pose, covariance=1e-10 * np.eye(6), route="given", rms_px=0.1, points=20)
        found = Found(fit, free, height, transform_points(pose, fit.centre))
        fit = anchored(found, raster, camera, view, RADIUS)[0].fit
    error = fit.centre - true
    covariance = fit.covariance + 1e-18 * np.eye(3)
    rng, drawn = np.random.default_rng(1), []
    for shift in rng.multivariate_normal(np.zeros(3), covariance, 12):
        drawn.append(direction_rms_deg(true + shift, true))
    return {
        "radius_px": size, "direction_rms_deg": direction_rms_deg(fit.centre, true),
        "direction_sigma_deg": float(np.sqrt(np.mean(np.square(drawn)))),
        "mahalanobis_squared": float(error @ np.linalg.solve(covariance, error)), "blur_fitted_px": fit.blur_px,
        "orthographic_rms_deg": orthographic_rms_deg(camera, true),
    }  # fmt: skip


def orthographic_rms_deg(camera: Camera, true: np.ndarray, radius: float = RADIUS, rim: float = 0.9) -> float:
    """Error [deg] of a circle fitted to the outline, exactly seen, and the unwrap of an infinitely far camera.

    The circle is the least-squares one through the true outline, and the map is turned to the ray to the ball: better
    than a tool can that knows no lens.
    """
    px = silhouette(camera, true, radius, azimuths(180))[0]
    solved = np.linalg.lstsq(np.column_stack([2 * px, np.ones(len(px))]), (px**2).sum(1), rcond=None)[0]
    middle, size = solved[:2], np.sqrt(solved[2] + solved[:2] @ solved[:2])
    axis, rays = true / np.linalg.norm(true), rays_over_disc(true, radius, rim)
    x, y = ((project(camera, rays) - middle) / size).T
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], -1)
    turn = np.cross((0, 0, 1.0), axis)
    cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    normal = normal @ (np.eye(3) + cross + cross @ cross / (1 + axis[2])).T
    found = axis - 2 * (normal @ axis)[:, None] * normal
    error = np.arccos(np.clip((found * directions_from_rays(rays, true, radius)).sum(1), -1, 1))
    return float(np.degrees(np.sqrt(np.mean(error[inside] ** 2))))


RATIOS, OFF_AXIS_DEG, RADII_PX, BLURS_PX = (3.0, 5.0, 10.0, 20.0, 50.0), (0.0, 15.0, 30.0), (30, 50, 200, 400), (1.5,)


FINE_PX = 150  # of radius, from which pixels are so small that fewer rays do
MARGIN = 2.6  # radii of the plane about the ball that the photograph shows


def _on_plane(setup: Setup) -> dict[str, float]:
    return fitted(setup, on_plane=True)


def sweep(
    seeds: int = 3, ratios: tuple[float, ...] = RATIOS, off_axis: tuple[float, ...] = OFF_AXIS_DEG,
    radii: tuple[float, ...] = RADII_PX, blurs: tuple[float, ...] = BLURS_PX,
) -> list[dict[str, Any]]:  # fmt: skip
    """Rows of the figure: rms over ``seeds`` of each cell, over distance and angle at 100 px, over radius, over blur.

    Keys: distance_ratio, off_axis_deg, radius_px, blur (px, of the simulation, pixel and mosaic beside it),
    direction_rms_deg inside r < 0.9, sigma (what the fit's covariance predicts of it), orthographic_rms_deg (a circle
    and an infinitely far camera).
    """
    cells = [Setup(distance_ratio=ratio, off_axis_deg=angle) for ratio in ratios for angle in off_axis]
    cells += [Setup(radius_px=float(size)) for size in radii] + [Setup(blur_px=blur) for blur in blurs]
    jobs = [replace(cell, seed=100 + seed, margin=MARGIN) for cell in cells for seed in range(seeds)]
    with ProcessPoolExecutor() as pool:
        each = list(pool.map(_on_plane, jobs))
    measured_cells = {cell: each[i * seeds : (i + 1) * seeds] for i, cell in enumerate(cells)}
    rows = []
    for cell in cells:
        found = measured_cells[cell]
        rms = {key: float(np.sqrt(np.mean([one[key] ** 2 for one in found]))) for key in found[0]}
        rows.append(
            {
                "distance_ratio": cell.distance_ratio, "off_axis_deg": cell.off_axis_deg,
                "radius_px": cell.radius_px, "blur": cell.blur_px, "direction_rms_deg": rms["direction_rms_deg"],
                "sigma": rms["direction_sigma_deg"], "orthographic_rms_deg": rms["orthographic_rms_deg"],
            }
        )  # fmt: skip
    return rows


def small(balls: int = 20, radii: tuple[float, ...] = (30.0, 40.0, 60.0)) -> list[dict[str, float]]:
    """Rows by radius: errors of ``balls`` drawn balls with a plane, what is stated of them, and whether that is so.

    Keys: radius_px; direction_rms_deg, direction_median_deg, direction_p90_deg and above_1_deg (share) inside r < 0.9;
    sigma_median_deg, stated; held_95, share of true centres in the stated 95 % region; flagged, share of those above a
    degree that state more than half a degree.
    """
    rows = []
    with ProcessPoolExecutor() as pool:
        for size in radii:
            rng = np.random.default_rng(int(size))
            jobs = [
                Setup(
                    distance_ratio=float(np.exp(rng.uniform(np.log(5), np.log(30)))), off_axis_deg=rng.uniform(0, 20),
                    radius_px=size, blur_px=rng.uniform(0.4, 1.2), seed=3000 + k, margin=MARGIN,
                )
                for k in range(balls)
            ]  # fmt: skip
            found = list(pool.map(_on_plane, jobs))
            error, sigma, square = (
                np.array([one[key] for one in found])
                for key in ("direction_rms_deg", "direction_sigma_deg", "mahalanobis_squared")
            )
            far = error > 1
            rows.append(
                {
                    "radius_px": size, "balls": balls, "direction_rms_deg": float(np.sqrt(np.mean(error**2))),
                    "direction_median_deg": float(np.median(error)),
                    "direction_p90_deg": float(np.quantile(error, 0.9)),
                    "above_1_deg": float(far.mean()), "sigma_median_deg": float(np.median(sigma)),
                    "held_95": float((square < 7.815).mean()),
                    "flagged": float((sigma[far] > 0.5).mean()) if far.any() else 1.0,
                }
            )  # fmt: skip
    return rows


def coverage(count: int = 200, first: int = 0) -> dict[str, float]:
    """Share of simulated balls whose 95 % region of the centre holds the truth, over distance, angle, blur, contrast"""
    found = []
    for seed in range(first, first + count):
        rng = np.random.default_rng(10_000 + seed)
        setup = Setup(
            distance_ratio=float(np.exp(rng.uniform(np.log(3), np.log(50)))), off_axis_deg=rng.uniform(0, 30),
            radius_px=float(np.exp(rng.uniform(np.log(30), np.log(150)))), blur_px=rng.uniform(0.4, 1.5),
            noise=float(np.exp(rng.uniform(np.log(0.002), np.log(0.02)))), reflectance=rng.uniform(0.6, 0.97),
            seed=seed, mosaic=bool(rng.integers(2)),
        )  # fmt: skip
        found.append(fitted(setup, 0.5)["mahalanobis_squared"])
    squares = np.array(found)
    return {
        "balls": count, "held_95": float((squares < 7.815).mean()), "held_68": float((squares < 3.506).mean()),
        "median_mahalanobis_squared": float(np.median(squares)),
    }  # fmt: skip
