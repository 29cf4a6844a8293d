"""Find the mirror ball of one view, or refuse: seeds, the best outline, and what makes a ball usable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes import sphere_fit
from pipeline.probes.reflection import blind_half_angle
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Raster, View

MIN_DISTANCE_RATIO = 1.5  # D / R below which the ball fills the view
FLAG_DISTANCE_RATIO, FLAG_RADIUS_PX, REFUSE_RADIUS_PX = 3.0, 40.0, 12.0
MIN_VISIBLE = 0.7  # of the outline; less is refused, less than all is flagged
MIN_MERIT = 0.5  # of an outline: on two captures balls had 0.52 to 0.85, empty tables with a board 0.38 to 0.49
INNER = (0.3, 0.6, 0.8)  # circles, as fractions of the outline, where a mirror shows something else than the table
MIN_CHANGE = 0.02  # median change of tone inside the outline between plate and ball, on a tripod
STAND_SIGMA = 5e-3  # of the radius: how well ball and table touch, and the diameter is known


@dataclass(frozen=True)
class Found:
    """A ball view: the fit with the plane, its prior, the free fit, the centre in the world, and what it means."""

    fit: sphere_fit.SphereFit
    free: sphere_fit.SphereFit
    height: sphere_fit.Height
    centre_world: np.ndarray


def find_ball(
    name: str,
    photograph: Raster,
    plate: Raster | None,
    camera: Camera,
    view: View,
    radius: float,
    near: list[np.ndarray],
) -> Found:
    """Find and fit the ball of one view; ``near`` are its centres in other views, world frame.

    Raises CaptureError when there is no ball, or it cannot be used.
    """
    height = height_prior(view, radius)
    signals = signals_of(photograph, plate)
    camera_from_world = invert_rigid(view.world_from_camera)
    seeds = [transform_points(camera_from_world, centre) for centre in near]
    best = best_fit(signals, camera, radius, height, seeds)
    if best is None or not is_ball(best[0]):
        seeds = list(sphere_fit.search_on_plane(signals, camera, radius, height, 8 if plate is None else 4))
        best = best_fit(signals, camera, radius, height, seeds)
    if best is None or not is_ball(best[0]):
        shown = "nothing like one" if best is None else f"an outline of merit {best[0].merit:.2f}"
        raise CaptureError(
            f"{name}: no mirror ball of radius {radius * 1e3:.1f} mm on the plane: {shown}, needed {MIN_MERIT}; is it "
            "in the frame, is probe.diameter_m right, is the view's pose right?"
        )
    fit, free = best
    refuse(name, fit, radius)
    if plate is not None and (change := change_at(signals[0], camera, fit.centre, radius, INNER)) < MIN_CHANGE:
        raise CaptureError(
            f"{name}: no mirror ball: the picture equals the plate to {change:.1%} where its outline would be, needed "
            f"{MIN_CHANGE:.0%}; is the view marked as tripod really the one with the ball?"
        )
    return Found(fit, free, height, transform_points(view.world_from_camera, fit.centre))


def height_prior(view: View, radius: float) -> sphere_fit.Height:
    """The ball stands on y = 0: its centre is at y = R, as surely as the pose and the contact are known."""
    down = view.world_from_camera[1]
    ahead = view.world_from_camera[:3, 2]  # the ball is about where the camera looks at the plane
    reach = min(abs(down[3] / ahead[1]) if abs(ahead[1]) > 1e-3 else np.inf, 10 * abs(down[3]))
    arm = reach * ahead
    slope = np.array([arm[2], 0.0, -arm[0], 0.0, 1.0, 0.0])  # dy = (w x arm)_y + d_y, in conventions' order
    by_pose = float(slope @ view.covariance @ slope)
    sigma = float(np.sqrt(max(by_pose, 0.0) + (STAND_SIGMA * radius) ** 2))
    return sphere_fit.Height(down[:3].copy(), float(down[3]), sigma)


def signals_of(photograph: Raster, plate: Raster | None) -> list[np.ndarray]:
    """Signals (H, W) whose edges are the ball's: the tone, and on the tripod first its change from the plate.

    The change is free of the plate's texture but has the edges of the ball's shadow; the tone the other way round.
    """
    rgb = photograph.rgb()
    rgb = np.where(np.isfinite(rgb), rgb, 0)
    tone = sphere_fit.tone(rgb)
    if plate is None or plate.shape != photograph.shape:
        return [tone]
    behind = plate.rgb()
    behind = np.where(np.isfinite(behind), behind, 0)
    scale = 0.1 * float(np.median(behind.mean(-1)))  # not 2 %: where both are noise their difference must be small
    return [sphere_fit.tone(rgb, scale) - sphere_fit.tone(behind, scale), tone]


def best_fit(
    signals: list[np.ndarray], camera: Camera, radius: float, height: sphere_fit.Height, seeds: list[np.ndarray]
) -> tuple[sphere_fit.SphereFit, sphere_fit.SphereFit] | None:
    """The fit, with and without the plane, whose outline stands out most from chance; None without any."""
    settled = [sphere_fit.settle(signals, camera, radius, seed, height) for seed in seeds if seed[2] > radius]
    settled.sort(key=lambda place: -(place[1] ** 2) / max(place[2], 1e-12))  # votes, and their excess over chance
    fits = [sphere_fit.fit_sphere(signals, camera, radius, place, height) for place in settled[:3]]
    fits = [pair for pair in fits if np.isfinite(pair[0].rms_px)]

    def merit(pair: tuple[sphere_fit.SphereFit, sphere_fit.SphereFit]) -> float:
        inside = change_at(signals[0], camera, pair[0].centre, radius, INNER) if len(signals) > 1 else 1.0
        beside = change_at(signals[0], camera, pair[0].centre, radius, (1.1, 1.25)) if len(signals) > 1 else 0.0
        return pair[0].merit * inside / (inside + beside + 1e-12)

    return max(fits, key=merit, default=None)


def is_ball(fit: sphere_fit.SphereFit) -> bool:
    """Whether enough of the outline is there."""
    return fit.merit >= MIN_MERIT


def change_at(
    signal: np.ndarray, camera: Camera, centre: np.ndarray, radius: float, fractions: tuple[float, ...]
) -> float:
    """Median absolute signal on circles of these fractions of the outline, as far as they are in the frame."""
    azimuth = 2 * np.pi * np.arange(90) / 90
    px = np.concatenate([sphere_fit.silhouette(camera, centre, radius * f, azimuth)[0] for f in fractions])
    px = px[((px >= 0) & (px < (camera.width, camera.height))).all(1)].astype(int)
    return float(np.median(np.abs(signal[px[:, 1], px[:, 0]]))) if len(px) else 0.0


def refuse(name: str, fit: sphere_fit.SphereFit, radius: float) -> None:
    """Raise CaptureError for a ball that is too near, too small or too far out of the frame."""
    ratio = float(np.linalg.norm(fit.centre)) / radius
    if ratio < MIN_DISTANCE_RATIO:
        raise CaptureError(
            f"{name}: ball at {ratio:.2f} radii, needed {MIN_DISTANCE_RATIO}; photograph it from farther"
        )
    if fit.radius_px < REFUSE_RADIUS_PX:
        raise CaptureError(
            f"{name}: ball radius {fit.radius_px:.1f} px, needed {REFUSE_RADIUS_PX:.0f} (better 100); go nearer"
        )
    if fit.visible < MIN_VISIBLE:
        raise CaptureError(
            f"{name}: {fit.visible:.0%} of the ball's outline is in the frame, needed {MIN_VISIBLE:.0%}; frame the ball"
        )


def complaints(name: str, ball: Found, radius: float) -> list[str]:
    """Warnings of one view."""
    fit, ratio = ball.fit, float(np.linalg.norm(ball.fit.centre)) / radius
    said = []
    if ratio < FLAG_DISTANCE_RATIO:
        blind = np.degrees(blind_half_angle(1 / ratio))
        said.append(f"{name}: ball at {ratio:.2f} radii: the blind cone is {blind:.0f} degrees")
    if fit.radius_px < FLAG_RADIUS_PX:
        said.append(f"{name}: ball radius {fit.radius_px:.0f} px, below {FLAG_RADIUS_PX:.0f}: directions are coarse")
    if fit.visible < 1:
        said.append(f"{name}: the frame cuts the ball; {fit.visible:.0%} of its outline is used, the rest is not seen")
    gap, sigma = discrepancy(ball, radius)
    if abs(gap) > 4 * sigma:
        said.append(
            f"{name}: the rim alone puts the ball {gap * 1e3:+.1f} +- {sigma * 1e3:.1f} mm off the plane: does it "
            "stand on it, are diameter and pose right? The plane was believed"
        )
    return said


def discrepancy(ball: Found, radius: float) -> tuple[float, float]:
    """Height [m] of the centre fitted without the plane, less the radius, and its standard uncertainty."""
    sigma = float(np.sqrt(ball.height.normal @ ball.free.covariance @ ball.height.normal))
    return ball.height.of(ball.free.centre) - radius, float(np.hypot(sigma, ball.height.sigma_m))
