"""The ball's centre by the plane that it mirrors: the rim says where the outline is, the plane's image says it better.

A mirror's rim continues its background, so that one side of it can drift by a pixel and more. The plane's texture is
seen twice, directly and in the ball, and where its mirror image lies depends on the centre alone (`plane_image`). Both
are joined by their covariances; where they contradict each other, a plane that agrees with its image to a third of a
pixel is believed. Needs a plane with texture near the ball, and the ball standing on it. Where no sphere fits the image
its contrast is left free, as gloss changes it and moves nothing (`contrast`); such an image is never believed against
the rim.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.conventions import transform_points
from pipeline.probes import plane_image, sphere_fit
from pipeline.probes.finding import Found, height_prior
from pipeline.probes.glass import MOST, Glass
from pipeline.probes.sphere_fit import SphereFit
from pipeline.types import Camera, Raster, View

MOST_LEFT_PX = 0.6  # that the alignment may leave: 0.03 to 0.2 on simulated balls
MOST_CHI2 = 25.0  # of the two centres, 3 degrees of freedom: beyond, one of them is wrong
SURE_PX = 0.35  # that it may leave to be believed against the rim
MOST_MOVED_PX, MOST_HEIGHT_SIGMA = 4.0, 3.0  # and how far it may be then: dents can look like a centre that is farther

# Of a solved radius: rounds, the slope of the height by it that is assumed at first, where it is settled (relative).
RADIUS_ROUNDS, FIRST_SLOPE, SETTLED = 6, -8.0, 3e-4


def anchored_radius(
    fit: SphereFit, photograph: Raster, camera: Camera, view: View, radius: float, glass_m: float | None = None
) -> tuple[float, float] | None:
    """Radius [m] and its standard uncertainty of a ball on the plane, by the plane's mirror image; None where it fails.

    ``fit`` has the outline, for an assumed ``radius``. For a radius that is too large by a millimetre the image puts
    the centre 5 to 10 mm too low under the plane's height for it, so that the height, which is known, gives the radius
    (secant method). ``glass_m`` [m] is before the mirror. Pose's errors are in the sigma of both, as if they were
    independent.
    """
    centre, slope, before = fit.centre, FIRST_SLOPE, None
    for _ in range(RADIUS_ROUNDS):
        glass = None if glass_m is None else Glass(min(glass_m / radius, MOST))
        aligned = plane_image.align(photograph, camera, view, centre, radius, fit.blur_px, glass)
        if aligned is None:
            return None
        height = height_prior(view, radius)
        over = height.of(aligned.centre) - radius
        if before is not None and abs(radius - before[0]) > SETTLED * radius:
            slope = (over - before[1]) / (radius - before[0])
        if slope > 0.3 * FIRST_SLOPE:  # of a radius alone it is -1: the image says nothing
            return None
        step = float(np.clip(-over / slope, -0.03 * radius, 0.03 * radius))
        if abs(step) < SETTLED * radius and aligned.left_px <= SURE_PX:
            variance = float(height.normal @ aligned.covariance @ height.normal) + height.sigma_m**2
            return radius + step, float(np.sqrt(variance)) / abs(slope)
        before = (radius, over)
        centre, radius = aligned.centre * (radius + step) / radius, radius + step
    return None


def anchored(
    ball: Found, photograph: Raster, camera: Camera, view: View, radius: float, glass: Glass | None = None
) -> tuple[Found, dict[str, Any]]:
    """The ball with its centre joined with the mirrored plane's, and what that measured; as it was where it cannot."""
    if not ball.on_plane:
        return ball, {"used": False, "why": "the ball is not on the plane"}
    start = ball.fit.centre
    as_is = aligned = plane_image.align(photograph, camera, view, start, radius, ball.fit.blur_px, glass)
    if as_is is None or aligned is None:
        return ball, {"used": False, "why": "too little of the plane's texture is mirrored"}
    if free := as_is.left_px > MOST_LEFT_PX:
        aligned = plane_image.align(photograph, camera, view, start, radius, ball.fit.blur_px, glass, free) or as_is
    centre, covariance = aligned.centre, aligned.covariance
    moved = centre - ball.fit.centre
    chi2 = float(moved @ np.linalg.solve(ball.fit.covariance + covariance, moved))
    pixels = float(np.linalg.norm(moved - (moved @ centre) / (centre @ centre) * centre) * ball.fit.radius_px / radius)
    numbers: dict[str, Any] = {"moved_px": pixels, "chi2": chi2, "left_px": aligned.left_px}
    if free:
        numbers["left_with_its_contrast_px"] = as_is.left_px
    if aligned.left_px > MOST_LEFT_PX:
        return ball, {"used": False, "why": "no sphere fits the plane's mirror image", **numbers}
    numbers["against_the_rim"] = chi2 > MOST_CHI2
    if chi2 <= MOST_CHI2:
        fit = sphere_fit.joined(ball.fit, radius, moved, covariance, camera)
    elif not free and believable(aligned, pixels) and stands(ball, centre, covariance, radius):
        seen = replace(ball.free, centre=centre, covariance=covariance)
        fit = sphere_fit.standing(seen, radius, ball.height, camera)
    else:
        return ball, {"used": False, "why": "rim and mirrored plane disagree", **numbers}
    there = transform_points(view.world_from_camera, fit.centre)
    return replace(ball, fit=fit, centre_world=there), {"used": True, **numbers}


def believable(aligned: plane_image.Aligned, pixels: float) -> bool:
    """Whether an image that says a centre this many pixels away may overrule the rim."""
    return aligned.left_px <= SURE_PX and pixels <= MOST_MOVED_PX


def stands(ball: Found, centre: np.ndarray, covariance: np.ndarray, radius: float) -> bool:
    """Whether a ball with this centre (3,) would stand on the plane, by the covariance and the height's."""
    up = ball.height.normal
    sigma = np.hypot(ball.height.sigma_m, np.sqrt(up @ covariance @ up))
    return bool(abs(ball.height.of(centre) - radius) < MOST_HEIGHT_SIGMA * sigma)
