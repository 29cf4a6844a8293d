"""Find the mirror ball of one view, or refuse: seeds, the best outline, and what makes a ball usable."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.conventions import CLIPPED, HOT, invert_rigid, transform_points
from pipeline.probes import seeds, sphere_fit
from pipeline.probes.outline import Height, radius_in_pixels, silhouette
from pipeline.probes.reflection import blind_half_angle
from pipeline.probes.seeds import azimuth_count
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Raster, View

MIN_DISTANCE_RATIO = 1.5  # D / R below which the ball fills the view
FLAG_DISTANCE_RATIO, FLAG_RADIUS_PX, REFUSE_RADIUS_PX = 3.0, 40.0, 12.0
# Of the outline; less than all is flagged. By the rim alone 0.7 is asked: at 0.4 to 0.57 it was off by up to 2 degrees,
# with the plane's mirror image by 0.02 to 0.3.
MIN_VISIBLE, MIN_VISIBLE_ANCHORED = 0.7, 0.4
# Share of azimuths that see the outline, chance taken off, times the root of their number, from which it is a ball.
# Where there was none (`benchmarks.probe_finding` on five plates and 24 photographs): a single place had at most 5.4 of
# 468, 4.4 in one of a hundred; the best of a plate's plane, for one size, at most 5.4 of 35, 6.4 in one of a hundred
# as Gumbel's law has it; the best of a picture, at any size, at most 6.3 of 29, and 7.3. The round window of a church
# had 9.4: what is a circle looks like one. Balls had 6.8 to 14. A person vouches for a click. Outlines of 30 px would
# need nearly all of their azimuths: no false one of any size had a share over 0.62.
SURE, MOST_NEEDED = {"other_view": 6.0, "plane": 7.0, "anywhere": 7.3, "click": 4.0}, 0.65
MAX_RMS_PX = 1.0  # scatter of the rim over sectors: balls had 0.1 to 0.3, a false outline 1.5
MIN_VISIBLE_ANYWHERE = 0.6
INNER = (0.3, 0.6, 0.8)  # circles, as fractions of the outline, where a mirror shows something else than the table
SOFT_PX = 2.5  # sigma of the rim's blur above which the ball is said to be out of focus
MIN_CHANGE = 0.02  # median change of tone inside the outline between plate and ball, on a tripod
STAND_SIGMA = 5e-3  # of the radius: how well ball and table touch, and the diameter is known


@dataclass(frozen=True)
class Found:
    """A ball view: the fit with the plane, its prior, the free fit, the centre in the world, and what it means."""

    fit: sphere_fit.SphereFit
    free: sphere_fit.SphereFit
    height: Height
    centre_world: np.ndarray
    seed: str = "plane"  # or other_view, anywhere, click
    on_plane: bool = True


def find_ball(
    name: str,
    photograph: Raster,
    plate: Raster | None,
    camera: Camera,
    view: View,
    radius: float,
    near: list[np.ndarray],
    click_px: tuple[float, float] | None = None,
    radius_sigma: float = 0.0,
) -> Found:
    """Find and fit the ball of one view; ``near`` are its centres in other views, world frame.

    Seeds are tried in turn until a ball is seen: those of other views, the plane, anywhere in the picture (the pose is
    off, or the ball does not stand on the plane), a click ``click_px`` (x, y) near its centre, pixel origin of
    conventions. What the last two find is fitted without the plane. ``radius_sigma`` [m] is that of the radius.
    Raises CaptureError when there is no ball, or it cannot be used.
    """
    prior = height_prior(view, radius)
    height = Height(prior.normal, prior.offset_m, float(np.hypot(prior.sigma_m, radius_sigma)))
    signals = signals_of(photograph, plate)
    camera_from_world = invert_rigid(view.world_from_camera)
    ways: list[tuple[str, Height | None, Callable[[], Iterable[np.ndarray]]]] = [
        ("other_view", height, lambda: [transform_points(camera_from_world, centre) for centre in near]),
        ("plane", height, lambda: seeds.search_on_plane(signals, camera, radius, height, 8 if plate is None else 4)),
        ("anywhere", None, lambda: seeds.search_anywhere(signals, camera, radius)),
    ]
    if click_px is not None:
        ways.append(("click", None, lambda: seeds.search_anywhere(signals, camera, radius, 3, click_px)))
    best, most, cut = None, (0.0, 1.0), None
    for way, prior_height, places in ways:
        pair = best_fit(signals, photograph, camera, radius, height, list(places()), prior_height is not None)
        if pair is None:
            continue
        needed = needed_merit(way, pair[0])
        most = max(most, (pair[0].merit, needed))
        if way == "anywhere" and pair[0].visible < MIN_VISIBLE_ANYWHERE:
            cut = pair[0] if pair[0].merit >= needed else cut
            continue
        if pair[0].merit >= needed:
            best = (way, prior_height, pair)
            break
    if best is None:
        if cut is not None:
            refuse_cut(name, cut, MIN_VISIBLE_ANYWHERE, " away from the plane")
        raise CaptureError(
            f"{name}: no mirror ball of radius {radius * 1e3:.1f} mm: an outline seen from {most[0]:.0%} of its "
            f"azimuths, needed {most[1]:.0%}; is it in the frame, is probe.diameter_m right, is the view's pose right? "
            "Else give click_px near its centre"
        )
    way, prior_height, (fit, free) = best
    refuse(name, fit, radius)
    if plate is not None and (change := change_at(signals[0], camera, fit.centre, radius, INNER)) < MIN_CHANGE:
        raise CaptureError(
            f"{name}: no mirror ball: the picture equals the plate to {change:.1%} where its outline would be, needed "
            f"{MIN_CHANGE:.0%}; is the view marked as tripod really the one with the ball?"
        )
    centre_world = transform_points(view.world_from_camera, fit.centre)
    return Found(fit, free, height, centre_world, way, prior_height is not None)


def agreed(
    found: dict[str, Found], photographs: dict[str, Raster], cameras: dict[str, Camera], views: dict[str, View],
    radius: float,
) -> dict[str, Found]:  # fmt: skip
    """The balls with their rims fitted once more from where each other view sees the ball, whose sectors agree best.

    Votes settle on whatever edge lies all around: a horizon that a ball mirrors just under its rim, in the tone of what
    is behind it, held one of 41 px 3 px aside, and its fit stayed there. The true outline is where the sectors scatter
    least: on ten views of five simulated rooms the fit of less scatter was the nearer one, or both lay within 0.1 px.
    Pose and other rim put the start within a pixel or two. The view that scatters most goes first.
    """
    now = dict(found)
    for name in sorted(now, key=lambda name: -now[name].fit.rms_px):
        ball = now[name]
        picture, variance, valid = measured(photographs[name])
        camera_from_world = invert_rigid(views[name].world_from_camera)
        for other, seen_from in now.items():
            if other == name or not (ball.on_plane and seen_from.on_plane):
                continue
            start = transform_points(camera_from_world, seen_from.centre_world)
            if start[2] <= radius:
                continue
            fit, free = sphere_fit.fit_sphere(
                picture,
                variance,
                valid,
                cameras[name],
                radius,
                start,
                ball.height,
                0.0,
                ball.fit.contrast,
                ball.fit.votes,
            )
            if fit.rms_px >= now[name].fit.rms_px or np.linalg.norm(fit.centre) <= 1.05 * radius:
                continue
            signals = signals_of(photographs[name], None)
            fit, free = (replace(one, support=seen(signals, cameras[name], one, radius)) for one in (fit, free))
            if fit.merit >= needed_merit("other_view", fit):
                centre = transform_points(views[name].world_from_camera, fit.centre)
                now[name] = replace(now[name], fit=fit, free=free, centre_world=centre)
    return now


def solve_radius(
    name: str, photograph: Raster, plate: Raster | None, camera: Camera, view: View,
    click_px: tuple[float, float] | None = None,
) -> tuple[float, float, sphere_fit.SphereFit]:  # fmt: skip
    """Radius [m] and its standard uncertainty of a ball of unknown size that stands on the plane, and its fit.

    The outline is found at any size and fitted without the plane; the sphere along its cone that touches the plane is
    the ball. Raises CaptureError when there is none, or its outline leaves the radius open by a quarter.
    """
    signals, nominal = signals_of(photograph, plate), 0.05
    places = seeds.search_anywhere(signals, camera, nominal, 3, click_px)
    pair = best_fit(signals, photograph, camera, nominal, height_prior(view, nominal), list(places), False)
    least = 1.0 if pair is None else needed_merit("anywhere" if click_px is None else "click", pair[0])
    if pair is None or pair[0].merit < least:
        merit = 0.0 if pair is None else pair[0].merit
        raise CaptureError(
            f"{name}: no mirror ball of any size: an outline seen from {merit:.0%} of its azimuths, needed "
            f"{least:.0%}; give probe.diameter_m, or click_px near its centre"
        )
    radius, sigma = nominal, np.inf
    for _ in range(2):  # the height's uncertainty is proportional to the radius
        radius, sigma = sphere_fit.radius_on_plane(pair[1], nominal, height_prior(view, radius))
    if not (radius > 0 and sigma < 0.25 * radius):
        raise CaptureError(
            f"{name}: the plane gives a ball radius of {radius * 1e3:.1f} +- {sigma * 1e3:.1f} mm, needed 25 % or "
            "better; give probe.diameter_m"
        )
    return radius, sigma, replace(pair[1], centre=pair[1].centre * radius / nominal)


def height_prior(view: View, radius: float) -> Height:
    """The ball stands on y = 0: its centre is at y = R, as surely as the pose and the contact are known."""
    down = view.world_from_camera[1]
    ahead = view.world_from_camera[:3, 2]  # the ball is about where the camera looks at the plane
    reach = min(abs(down[3] / ahead[1]) if abs(ahead[1]) > 1e-3 else np.inf, 10 * abs(down[3]))
    arm = reach * ahead
    slope = np.array([arm[2], 0.0, -arm[0], 0.0, 1.0, 0.0])  # dy = (w x arm)_y + d_y, in conventions' order
    by_pose = float(slope @ view.covariance @ slope)
    sigma = float(np.sqrt(max(by_pose, 0.0) + (STAND_SIGMA * radius) ** 2))
    return Height(down[:3].copy(), float(down[3]), sigma)


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
    signals: list[np.ndarray], photograph: Raster, camera: Camera, radius: float, height: Height,
    places: list[np.ndarray], on_plane: bool,
) -> tuple[sphere_fit.SphereFit, sphere_fit.SphereFit] | None:  # fmt: skip
    """The fit, with and without the plane, whose outline most azimuths see; None without any."""
    prior = height if on_plane else None
    picture, variance, valid = measured(photograph)
    fits: list[tuple[sphere_fit.SphereFit, sphere_fit.SphereFit]] = []
    for centre, votes, chance in settled(signals, camera, radius, places, prior)[:2]:
        contrast = votes / max(chance, 1e-12)
        pair = sphere_fit.fit_sphere(picture, variance, valid, camera, radius, centre, prior, 0.0, contrast, votes)
        if pair[0].rms_px < MAX_RMS_PX and np.linalg.norm(pair[0].centre) > 1.05 * radius:
            fit, free = (replace(one, support=seen(signals, camera, one, radius)) for one in pair)
            fits.append((fit, free))

    def merit(pair: tuple[sphere_fit.SphereFit, sphere_fit.SphereFit]) -> float:
        inside = change_at(signals[0], camera, pair[0].centre, radius, INNER) if len(signals) > 1 else 1.0
        beside = change_at(signals[0], camera, pair[0].centre, radius, (1.1, 1.25)) if len(signals) > 1 else 0.0
        return pair[0].merit * inside / (inside + beside + 1e-12)

    return max(fits, key=merit, default=None)


def settled(
    signals: list[np.ndarray], camera: Camera, radius: float, places: list[np.ndarray], prior: Height | None
) -> list[tuple[np.ndarray, float, float]]:
    """Centre, votes and chance of `seeds.settle` from each of ``places`` (3,) before the camera, likeliest first.

    By the azimuths' excess over chance, in its spread: small outlines find more.
    """
    found = []
    for place in places:
        if place[2] > radius:
            centre, votes, chance = seeds.settle(signals, camera, radius, place, prior)
            share, even = seeds.coverage(signals, camera, centre, radius)
            size = radius_in_pixels(camera, centre, radius)
            found.append(((share - even) * np.sqrt(min(size, 100.0)), (centre, votes, chance)))
    found.sort(key=lambda place: -place[0])
    return [place for _, place in found]


def needed_merit(way: str, fit: sphere_fit.SphereFit) -> float:
    """Share of azimuths, chance taken off, from which an outline found this ``way`` is a ball.

    What chance and clutter reach falls with the root of the number of azimuths, and grows with the number of places
    that were searched: ``SURE`` is for one place, a plane, and a picture at any size.
    """
    count = azimuth_count(fit.radius_px) * max(fit.visible, 1e-3)
    return min(SURE[way] / float(np.sqrt(count)), MOST_NEEDED)


def seen(signals: list[np.ndarray], camera: Camera, fit: sphere_fit.SphereFit, radius: float) -> float:
    """Share of the azimuths in frame that see the outline, what chance would give taken off: 0 to 1."""
    share, chance = seeds.coverage(signals, camera, fit.centre, radius)
    return max(share - chance, 0.0) / (1 - chance)


def measured(photograph: Raster) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance and variance (H, W, 3), finite, and which pixels (H, W) are neither clipped nor broken."""
    rgb, variance = photograph.rgb(), photograph.rgb("variance")
    valid = np.isfinite(rgb).all(-1) & np.isfinite(variance).all(-1) & (photograph["mask"] & (CLIPPED | HOT) == 0)
    return np.where(valid[..., None], rgb, 0), np.where(valid[..., None], variance, 0), valid


def change_at(
    signal: np.ndarray, camera: Camera, centre: np.ndarray, radius: float, fractions: tuple[float, ...]
) -> float:
    """Median absolute signal on circles of these fractions of the outline, as far as they are in the frame."""
    azimuth = 2 * np.pi * np.arange(90) / 90
    px = np.concatenate([silhouette(camera, centre, radius * f, azimuth)[0] for f in fractions])
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
    refuse_cut(name, fit, MIN_VISIBLE_ANCHORED)


def refuse_cut(name: str, fit: sphere_fit.SphereFit, needed: float = MIN_VISIBLE, why: str = "") -> None:
    """Raise CaptureError for a ball of which the frame shows less than ``needed`` of the outline."""
    if fit.visible < needed:
        raise CaptureError(
            f"{name}: {fit.visible:.0%} of the ball's outline is in the frame, needed {needed:.0%}{why}; frame the ball"
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
    if not ball.on_plane:
        said.append(f"{name}: the ball was not found on the plane but by {ball.seed}: fitted from its rim alone")
    if fit.blur_px > SOFT_PX:
        said.append(f"{name}: the ball's rim is blurred by {fit.blur_px:.1f} px: out of focus?")
    if fit.visible < 1:
        said.append(f"{name}: the frame cuts the ball; {fit.visible:.0%} of its outline is used, the rest is not seen")
    gap, sigma = discrepancy(ball, radius)
    if abs(gap) > 4 * sigma:
        believed = "The plane was believed" if ball.on_plane else "The rim was believed"
        print_size, size_sigma = 1 - gap / ball.height.offset_m, sigma / ball.height.offset_m
        said.append(
            f"{name}: the rim alone puts the ball {gap * 1e3:+.1f} +- {sigma * 1e3:.1f} mm off the plane: does it "
            f"stand on it, are diameter and pose right? If so, the board or marker measures {print_size:.1%} +- "
            f"{size_sigma:.1%} of its stated size. {believed}"
        )
    return said


def discrepancy(ball: Found, radius: float) -> tuple[float, float]:
    """Height [m] of the centre fitted without the plane, less the radius, and its standard uncertainty."""
    sigma = float(np.sqrt(ball.height.normal @ ball.free.covariance @ ball.height.normal))
    return ball.height.of(ball.free.centre) - radius, float(np.hypot(sigma, ball.height.sigma_m))
