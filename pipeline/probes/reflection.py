"""A mirror ball in perspective: which ray sees which direction, exactly.

Geometry, in the plane of camera, ball centre and reflected ray: a ray that makes the angle ``rho`` with the ray to the
centre passes the centre at distance ``D sin rho``, so it meets the ball (radius R) under the incidence ``i`` with
``sin i = sin rho / k``, ``k = R / D``, and leaves it under the angle
    theta = 2 i - rho,   rho = asin(k sin i)
from the direction ball -> camera. theta grows with i up to ``pi - asin(k)``: the cone of half angle asin(k) behind the
ball is blind. For k -> 0 this is Debevec's (1998) ``theta = 2 asin(r)``, r = sin i the radius as a fraction of the
silhouette's. A mirror behind glass turns the ray further (`pipeline.probes.glass`). Directions belong to infinitely
distant light; near surfaces are displaced by up to R / distance.
"""

from __future__ import annotations

import numpy as np

from pipeline.probes.glass import Glass, leaving

NEWTON_STEPS, GLASS_STEPS = (
    4,
    3,
)  # further ones behind glass; f'' <= k f': from i = theta / (2 - k) four steps reach rounding for k <= 0.9


def blind_half_angle(ratio: float) -> float:
    """Half angle [rad] of the cone behind the ball that reflects nothing to the camera; ``ratio`` = R / D."""
    return float(np.arcsin(ratio))


def deviation(sine: np.ndarray, ratio: float, glass: Glass | None = None) -> np.ndarray:
    """Angle theta [rad] between the direction to the camera and the reflected direction; ``sine`` = sin(incidence)."""
    theta = 2 * np.arcsin(sine) - np.arcsin(ratio * np.asarray(sine))
    return theta if glass is None else theta + glass.turn(sine)


def incidence(theta: np.ndarray, ratio: float, glass: Glass | None = None) -> np.ndarray:
    """Incidence i [rad] that reflects towards ``theta``, by Newton: inverse of `deviation`; over pi/2 if blind."""
    angle = theta / (2 - np.asarray(ratio, theta.dtype))
    k = angle.dtype.type(ratio)
    for _ in range(NEWTON_STEPS + (0 if glass is None else GLASS_STEPS)):
        sine = k * np.sin(angle)
        slope = 2 - k * np.cos(angle) / np.sqrt(1 - sine * sine)
        over = 2 * angle - np.arcsin(sine) - theta
        if glass is not None:
            outer = np.sin(angle)
            slope, over = slope + np.cos(angle) * glass.turn_slope(outer), over + glass.turn(outer)
        angle = angle - over / slope
    return angle


def rays_from_directions(
    directions: np.ndarray, to_camera: np.ndarray, ratio: float, glass: Glass | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays from the camera (..., 3) that the ball reflects to unit ``directions`` (..., 3), same frame.

    Also returns the sine of the incidence (...), NaN in the blind cone. ``to_camera`` (3,) is the unit direction from
    the centre to the camera. Float32 in, float32 out: 1e-7 rad.
    """
    directions = np.asarray(directions)
    to_camera = np.asarray(to_camera, directions.dtype)
    cosine = np.clip(directions @ to_camera, -1, 1)
    theta = np.arccos(cosine)
    angle = incidence(theta, ratio, glass)
    sine = np.where(angle <= np.pi / 2, np.sin(angle), np.nan).astype(directions.dtype)
    sine_rho = directions.dtype.type(ratio) * sine
    sine_theta = np.sin(theta)
    tiny = sine_theta < 1e-4  # towards the camera: the limit of sin rho / sin theta, k / (2 - k) of a front mirror
    along = np.where(tiny, ratio / first_slope(ratio, glass), sine_rho / np.where(tiny, 1, sine_theta)).astype(
        directions.dtype
    )
    back = np.sqrt(1 - sine_rho * sine_rho) + cosine * along
    return along[..., None] * directions - back[..., None] * to_camera, sine


def direction_sigma(
    centre: np.ndarray, covariance: np.ndarray, radius: float, glass: Glass | None = None, rim: float = 0.9
) -> float:
    """Rms error [rad] to be expected of directions over the disc inside ``rim``, of a centre (3,) with covariance.

    One displacement along each principal axis of ``covariance`` (3, 3) [m^2], by its sigma; to first order.
    """
    distance = float(np.linalg.norm(centre))
    first, second = np.linalg.svd(centre[None] / distance)[2][1:]
    r, angle = rim * np.sqrt((np.arange(200) + 0.5) / 200), 2.4 * np.arange(200)  # the golden angle: even over the area
    sine = (r * radius / distance)[:, None]
    spokes = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    rays = np.sqrt(1 - sine**2) * centre / distance + sine * spokes
    there = directions_from_rays(rays, centre, radius, glass)
    size, axes = np.linalg.eigh(covariance)
    total, step = 0.0, 1e-4 * radius
    for variance, axis in zip(size, axes.T, strict=True):
        moved = directions_from_rays(rays, centre + step * axis, radius, glass)
        total += max(float(variance), 0.0) * float(np.nanmean(((moved - there) ** 2).sum(1))) / step**2
    return float(np.sqrt(total))


def first_slope(ratio: float, glass: Glass | None) -> float:
    """Derivative of `deviation` by the sine, head on."""
    return 2 - ratio + (0.0 if glass is None else float(glass.turn_slope(np.array(0.0))))


def directions_from_rays(
    rays: np.ndarray, centre: np.ndarray, radius: float, glass: Glass | None = None
) -> np.ndarray:  # fmt: skip
    """Unit directions (N, 3) into which unit ``rays`` (N, 3) from the origin are reflected; NaN where they miss."""
    along = rays @ centre
    inside = along**2 - centre @ centre + radius**2
    distance = along - np.sqrt(np.where(inside >= 0, inside, np.nan))
    normal = (distance[:, None] * rays - centre) / radius
    if glass is not None:
        return leaving(glass, rays, normal)[1]
    return rays - 2 * (rays * normal).sum(-1, keepdims=True) * normal


def solid_angle_gain(sine2: np.ndarray, ratio: float, glass: Glass | None = None) -> np.ndarray:
    """Solid angle of environment per solid angle of picture, at squared sines of the incidence ``sine2``.

    ``sin theta dtheta / (sin rho drho)`` in closed form; (2 / k - 1)^2 in the middle, infinite at the silhouette.
    """
    k = np.asarray(ratio, np.asarray(sine2).dtype)
    into, along = np.sqrt(1 - sine2), np.sqrt(1 - k * k * sine2)  # cosines of incidence and of rho
    if glass is not None:
        sine = np.sqrt(np.maximum(sine2, 1e-12))
        slope = 2 / into - k / along + glass.turn_slope(sine)
        return np.asarray(np.sin(deviation(sine, ratio, glass)) / sine * slope * along / k**2)
    return (2 * into * along / k - (1 - 2 * sine2)) * (2 * along / (k * into) - 1)


def radians_per_pixel(
    sine: np.ndarray, ratio: float, radius_px: float, glass: Glass | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """How many radians of environment one pixel spans along the radius and across it, at radius fraction ``sine``."""
    sine = np.asarray(sine)
    radial = (2 / np.sqrt(1 - sine**2) - ratio / np.sqrt(1 - (ratio * sine) ** 2)) / radius_px
    if glass is not None:
        radial = radial + glass.turn_slope(sine) / radius_px
    small = sine < 1e-3
    across = np.sin(deviation(sine, ratio, glass)) / (np.where(small, 1, sine) * radius_px)
    return radial, np.where(small, first_slope(ratio, glass) / radius_px, across)
