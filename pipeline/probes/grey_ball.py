"""A matt ball: it shows irradiance, so the light's nine lowest harmonics, and nothing finer.

Each pixel of the ball is ``albedo / pi`` times the irradiance at its normal. In harmonics irradiance is radiance times
the cosine lobe's ``pi, 2 pi / 3, pi / 4, 0, -pi / 24`` (Ramamoorthi and Hanrahan 2001): bands 0 to 2 are solved for by
Bayesian least squares, band 4 beside them so that it does not leak in, band 3 is invisible. Prior: a coefficient has
the size of the mean's, as that of a single lamp has. The map is the non-negative one of least power that has the solved
coefficients, the plane in it as the plate shows it. Limits: the ball's own shadow on the plane darkens its lower half,
of which the lowest part is left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.image.colour import convert
from pipeline.light.harmonics import COSINE_LOBE, sh9_basis, sh9_of_environment
from pipeline.probes import map_scale
from pipeline.probes.finding import Found, complaints, find_ball
from pipeline.probes.mirror_ball import crop, fit_numbers
from pipeline.probes.observation import Grid, Observation, Shots, ViewMap, lookup_channels

BAND_4 = -np.pi / 24  # of the cosine lobe
RIM = 0.92  # of the outline: beyond, blur and the edge itself mix in
LOWEST = -0.2  # y of normals that are used; below, the ball sees its own shadow
PIXELS = 20_000  # that are used of a view, evenly
CELLS, CELL_SIGMA = 100, 0.01  # paint and shape are good to 1 % on each of a hundred independent parts of a view
STEPS = 100
MISSED = 0.03  # of the mean: what a coarse map and the plane's edge cost
RIDGE = 1e-5  # gives where no positive light has the coefficients


class GreyBall:
    """One or several photographs of a matt ball that stands on the plane."""

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        """One smooth map of all views. Raises CaptureError when there is no ball, or it cannot be used."""
        facts, probe = shots.facts, shots.facts["probe"]
        radius = 0.5 * float(probe["diameter_m"])
        albedo = convert(np.array(probe["albedo"], float), probe["albedo_space"], "acescg")
        warnings: list[str] = []
        found: dict[str, Found] = {}
        samples = []
        for ball in sorted(facts["ball"], key=lambda ball: not ball.get("tripod", False)):
            name = ball["name"]
            plate = shots.photographs["plate"] if ball.get("tripod", False) else None
            near = [one.centre_world for one in found.values()]
            found[name] = find_ball(
                name, shots.photographs[name], plate, shots.camera_of(name), shots.views[name], radius, near
            )
            warnings += complaints(name, found[name], radius)
            samples.append(irradiance_samples(shots, name, found[name], radius, albedo))
        normals, light, variance = (np.concatenate(parts) for parts in zip(*samples, strict=True))
        coefficients, covariance = solve_harmonics(normals, light, variance)
        centre = np.mean([ball.centre_world for ball in found.values()], 0)
        plane, shown = map_scale.seen_by_plate(shots, centre)
        below = shown & (latlong_directions(*map_scale.COARSE)[..., 1] < -np.sin(map_scale.HORIZON))
        rgb = least_power_map(coefficients, covariance, np.where(below[..., None], plane, 0), below, grid)
        view = smooth_view(rgb, covariance, grid)
        numbers: dict[str, Any] = {name: fit_numbers(ball, radius) for name, ball in found.items()}
        sigma = np.sqrt(np.einsum("cii->ci", covariance))
        missed, mean = np.abs(sh9_of_environment(rgb) - coefficients), np.maximum(np.abs(coefficients[0]), 1e-300)
        numbers["harmonics"] = {
            "pixels": len(normals), "sigma_over_mean": (sigma[1] / mean[1]).tolist(),
            "missed_over_mean": float((missed / mean).max()),
        }  # fmt: skip
        if (missed > 3 * sigma.T + MISSED * mean).any():
            warnings.append(
                f"grey ball: no positive light over the plane that the plate shows gives the ball's shading (misses by "
                f"{numbers['harmonics']['missed_over_mean']:.0%}); are exposures alike, is probe.albedo right?"
            )
        warnings.append(
            "grey ball: a diffuse ball shows nine harmonics of the light and no lamps: shadows are as soft as of a "
            "cloudy sky; add a mirror ball or a panorama for the lamps"
        )
        shared = float(probe["albedo_sigma_rel"])
        return Observation({next(iter(found)): view}, centre, {}, numbers, warnings, reasons(), scale_sigma=shared)


def irradiance_samples(
    shots: Shots, name: str, ball: Found, radius: float, albedo: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World normals (N, 3), irradiance (N, 3) and its variance (N, 3) of the ball's pixels in one view."""
    window, part = crop(shots.camera_of(name), ball.fit, radius)
    picture = lookup_channels(shots.photographs[name], window)
    y, x = np.mgrid[: part.height, : part.width] + 0.5
    normals, sine = sphere_normals(pixel_rays(part, np.stack([x, y], -1).reshape(-1, 2)), ball.fit.centre, radius)
    normals = normals @ shots.views[name].world_from_camera[:3, :3].T
    flat = picture.reshape(-1, 8)
    used = np.flatnonzero((sine < RIM) & (normals[:, 1] > LOWEST) & (flat[:, 6] > 0) & (flat[:, 7] == 0))
    used = used[:: max(1, len(used) // PIXELS)]
    light = flat[used, :3] * np.pi / albedo
    noise = flat[used, 3:6] * (np.pi / albedo) ** 2
    return normals[used], light, noise + (CELL_SIGMA * light) ** 2 * len(used) / CELLS


def sphere_normals(rays: np.ndarray, centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (N, 3), camera frame, where unit rays (N, 3) meet a sphere, and sine of the incidence (N,).

    NaN and infinity where they miss.
    """
    along = rays @ centre
    inside = radius**2 - centre @ centre + along**2
    hit = inside > 0
    reach = along - np.sqrt(np.where(hit, inside, 0.0))
    normals = (reach[:, None] * rays - centre) / radius
    sine = np.linalg.norm(np.cross(rays, normals), axis=-1)
    return np.where(hit[:, None], normals, np.nan), np.where(hit, sine, np.inf)


def band_4(directions: np.ndarray) -> np.ndarray:
    """The nine orthonormal real harmonics of degree 4 at unit directions (N, 3): (N, 9)."""
    from scipy.special import sph_harm_y

    polar, azimuth = np.arccos(np.clip(directions[:, 2], -1, 1)), np.arctan2(directions[:, 1], directions[:, 0])
    waves = [sph_harm_y(4, m, polar, azimuth) for m in range(5)]
    parts = [part for w in waves[1:] for part in (np.sqrt(2) * w.real, np.sqrt(2) * w.imag)]
    return np.stack([waves[0].real, *parts], -1)


def solve_harmonics(normals: np.ndarray, irradiance: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance coefficients (9, C) and covariance (C, 9, 9) from irradiance (N, C) at normals (N, 3)."""
    design = np.concatenate([sh9_basis(normals) * COSINE_LOBE, band_4(normals) * BAND_4], 1)
    coefficients, covariances = [], []
    for channel in range(irradiance.shape[1]):
        weight = 1 / variance[:, channel]
        mean = float(np.average(irradiance[:, channel], weights=weight)) / np.pi  # radiance
        size = np.full(18, np.sqrt(4 * np.pi) * mean)
        size[0] *= 10  # the mean itself is not known beforehand
        precision = (design * weight[:, None]).T @ design + np.diag(1 / size**2)
        covariance = np.linalg.inv(precision)
        found = covariance @ ((design * weight[:, None]).T @ irradiance[:, channel])
        coefficients.append(found[:9])
        covariances.append(covariance[:9, :9])
    return np.stack(coefficients, -1), np.stack(covariances)


def least_power_map(
    coefficients: np.ndarray, covariance: np.ndarray, known: np.ndarray, is_known: np.ndarray, grid: Grid
) -> np.ndarray:
    """The non-negative map (H, W, C) of least ``integral L^2`` that has the coefficients (9, C).

    Where ``is_known`` (h, w) it is ``known`` (h, w, C), the plane as the plate shows it. The coefficients may give by
    their covariance (C, 9, 9). The dual has nine unknowns: the rest is ``max(0, sum mu_i Y_i)``, and mu minimises a
    convex function (Newton).
    """
    basis = sh9_basis(latlong_directions(*is_known.shape)).reshape(-1, 9)
    area = latlong_solid_angles(*is_known.shape).ravel()
    free = area * ~is_known.ravel()
    taken = basis.T @ (known.reshape(len(area), -1) * (area - free)[:, None])
    fine = sh9_basis(latlong_directions(grid.height, grid.width))
    channels = []
    for whole, plane, slack in zip(coefficients.T, taken.T, covariance, strict=True):
        soft = slack / max(float(whole[0]) ** 2, 1e-300) + RIDGE * np.eye(9)
        goal = whole - plane
        mu = np.append(max(float(goal[0]), 0.01 * float(whole[0])), np.zeros(8))
        for _ in range(STEPS):
            light = basis @ mu
            lit = free * (light > 0)
            slope = basis.T @ (lit * light) + soft @ mu - goal
            if np.linalg.norm(slope) < 1e-9 * np.linalg.norm(whole):
                break
            step = np.linalg.solve((basis * lit[:, None]).T @ basis + soft, slope)
            mu = mu - _shortened(mu, step, basis, free, soft, goal) * step
        channels.append(np.maximum(fine @ mu, 0))
    u, v = (np.arange(n) * m // n for n, m in ((grid.width, is_known.shape[1]), (grid.height, is_known.shape[0])))
    below = np.ix_(v, u)
    return np.where(is_known[below][..., None], known[below], np.stack(channels, -1))


def _shortened(
    mu: np.ndarray, step: np.ndarray, basis: np.ndarray, area: np.ndarray, soft: np.ndarray, goal: np.ndarray
) -> float:
    """Share of a Newton step after which the dual function has fallen (halved until it has)."""

    def dual(at: np.ndarray) -> float:
        return float(0.5 * (area @ np.maximum(basis @ at, 0) ** 2) + 0.5 * at @ soft @ at - goal @ at)

    share, before = 1.0, dual(mu)
    while share > 1e-6 and dual(mu - share * step) > before:
        share /= 2
    return share


def smooth_view(rgb: np.ndarray, covariance: np.ndarray, grid: Grid) -> ViewMap:
    """The map with the variance of what is known, and of what no diffuse ball shows: all of a texel, or the mean."""
    basis = sh9_basis(latlong_directions(grid.height, grid.width))
    known = np.einsum("hwi,cij,hwj->hwc", basis, covariance, basis, optimize=True)
    mean = np.average(rgb, axis=(0, 1), weights=latlong_solid_angles(grid.height, grid.width)[..., None] + 0 * rgb)
    one = np.ones(rgb.shape[:2])
    return ViewMap(rgb, known + np.maximum(rgb, mean) ** 2, one, one)


def reasons() -> list[dict[str, Any]]:
    """What a matt ball leaves open."""
    return [
        {
            "term": "harmonics of the light beyond the ninth",
            "modelled": False,
            "because": "a diffuse ball does not show band 3 at all and band 4 at a sixth of band 2",
            "could_cost": "hard shadows and highlights; irradiance to 1 %, at a single lamp to 9 % of its peak",
            "bound_rel": 0.09,
        },
        {
            "term": "the ball's own shadow on the plane",
            "modelled": False,
            "because": f"normals lower than y = {LOWEST} are left out; others see little of the ground near the foot",
            "could_cost": "light from below too dark by a few percent of the light",
            "no_bound": "how dark the ground is about the foot was not measured",
        },
    ]
