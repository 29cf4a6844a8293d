"""The mirror ball in a photograph, fitted as a sphere under the lens: three numbers, their covariance, and the blur.

The silhouette of a sphere is the cone of half angle ``rho = asin(R / D)`` about the ray to its centre, exact off axis
and under distortion. `rim` says where it lies in the picture; the size of the outline gives the distance, and so does
the height of the centre over the plane when the ball stands on it: both are fitted, with the plane and without, so that
they can be compared. An unknown radius scales the sphere along its cone until it touches the plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.probes import rim
from pipeline.probes.outline import Height, fraction_in_frame, radius_in_pixels, silhouette
from pipeline.types import Camera

__all__ = ["Height", "SphereFit", "fit_sphere", "radius_in_pixels", "radius_on_plane", "silhouette", "tone"]

ROUNDS = 2  # of gathering pixels about the outline and fitting it
REACH_PX = 1.5  # further pixels beside the rim in the first round


@dataclass(frozen=True)
class SphereFit:
    """Centre (3,) in the camera frame [m] with covariance (3, 3), and how well its outline explains the edges.

    ``support``: fraction of the outline's sectors that voted for it rather than for outlines beside it; ``contrast``:
    votes for the outline over the median votes of outlines moved by up to 10 px; ``visible``: fraction of the outline
    in the frame; ``blur_px``: sigma of the rim's blur.
    """

    centre: np.ndarray
    covariance: np.ndarray
    rms_px: float
    points: int
    radius_px: float
    blur_px: float
    support: float
    contrast: float
    visible: float
    votes: float = 0.0
    converged: bool = True

    @property
    def merit(self) -> float:
        """How much of a ball there is, from 0 to 1: the share of azimuths that see its outline, less chance's."""
        return self.support


def tone(rgb: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Perceptual-like signal (H, W) of a linear picture: asinh, logarithmic in the light, linear in the noise.

    ``scale`` is where it bends; by default 2 % of the median, so two pictures to be compared must share it.
    """
    grey = np.asarray(rgb, np.float32).mean(-1)
    scale = 0.02 * float(np.median(grey[np.isfinite(grey)])) if scale is None else scale
    return np.arcsinh(grey / np.float32(max(scale, 1e-30)))


def fit_sphere(
    picture: np.ndarray, variance: np.ndarray, valid: np.ndarray, camera: Camera, radius: float, start: np.ndarray,
    height: Height | None, support: float = 1.0, contrast: float = 1.0, votes: float = 0.0,
) -> tuple[SphereFit, SphereFit]:  # fmt: skip
    """Fit the centre (3,) [m, camera frame] about a place known to a pixel or two: with the plane, and without it.

    ``picture``, ``variance`` (H, W, C) linear and finite, ``valid`` (H, W). Without enough of the rim in the frame the
    fit's ``rms_px`` is infinite.
    """
    visible = fraction_in_frame(camera, start, radius)
    centre, blur, found = start, rim.BLUR_PX, None
    for turn in range(ROUNDS):
        beside = REACH_PX if turn == 0 else rim.BESIDE_PX
        patches = rim.gather(picture, variance, valid, camera, centre, radius, blur, beside)
        if patches is None:
            break
        found = rim.fit_rim(patches, camera, centre, radius, blur)
        centre, blur = found.centre, found.blur_px
        if not np.isfinite(centre).all():
            break
    size = radius_in_pixels(camera, centre, radius)
    if found is None or not np.isfinite(centre).all():
        nothing = np.full((3, 3), np.inf)
        none = SphereFit(start, nothing, np.inf, 0, size, blur, support, contrast, visible, votes, False)
        return none, none
    free = SphereFit(
        centre, found.covariance[:3, :3], found.rms_px, found.sectors, size, blur, support, contrast,
        fraction_in_frame(camera, centre, radius), votes, found.converged,
    )  # fmt: skip
    return free if height is None else standing(free, radius, height, camera), free


def standing(free: SphereFit, radius: float, height: Height, camera: Camera) -> SphereFit:
    """The fit with the knowledge that its centre is at ``radius`` over the plane, each by its covariance.

    The rim's covariance holds what its sectors have in common, which their number does not lessen; the plane is
    therefore joined to the finished fit (Kalman's update), not to the sectors.
    """
    lever = free.covariance @ height.normal
    gain = lever / (float(height.normal @ lever) + height.sigma_m**2)
    centre = free.centre - gain * (height.of(free.centre) - radius)
    covariance = free.covariance - np.outer(gain, lever)
    return replace(
        free, centre=centre, covariance=0.5 * (covariance + covariance.T),
        radius_px=radius_in_pixels(camera, centre, radius), visible=fraction_in_frame(camera, centre, radius),
    )  # fmt: skip


def joined(fit: SphereFit, radius: float, moved: np.ndarray, covariance: np.ndarray, camera: Camera) -> SphereFit:
    """The fit joined with an independent measurement ``moved`` (3,) [m] from its centre, by both covariances (3, 3)."""
    gain = fit.covariance @ np.linalg.inv(fit.covariance + covariance)
    centre = fit.centre + gain @ moved
    kept = (np.eye(3) - gain) @ fit.covariance
    return replace(
        fit, centre=centre, covariance=0.5 * (kept + kept.T), radius_px=radius_in_pixels(camera, centre, radius),
        visible=fraction_in_frame(camera, centre, radius),
    )  # fmt: skip


def radius_on_plane(fit: SphereFit, radius: float, height: Height) -> tuple[float, float]:
    """Radius [m] of the ball on the plane that has the outline of ``fit``, and its standard uncertainty.

    ``fit`` is without the plane, for an assumed ``radius``. Spheres along one cone are scaled copies: with scale q,
    ``q normal . c + offset = q R``, so ``q = offset / (R - normal . c)``.
    """
    lever = radius - float(height.normal @ fit.centre)
    scale = height.offset_m / lever
    slope = radius * height.offset_m / lever**2 * height.normal
    variance = float(slope @ fit.covariance @ slope) + (radius / lever * height.sigma_m) ** 2
    return radius * scale, float(np.sqrt(variance))
