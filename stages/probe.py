"""Turn photographs of a mirror ball into a world-oriented environment map with variance.

Each ball is found on the plane (radius and pose leave two unknowns), fitted as a sphere under the lens, and
unwrapped by exact perspective reflection (`pipeline.light.mirror_ball`); radiance is the pixel's over the ball's
reflectance, as mirrors conserve radiance (Debevec 1998). Views are brought to one exposure and averaged by the inverse
variance of their direction; the tripod's own photographer stays, as he stood there for the plate too.
Limits: light is taken as distant, so things at distance d are displaced by up to R/d; no Fresnel, dirt or dents; lamps
clipped in every frame are lower bounds; directions that nobody sees are filled smoothly and marked by ``seen`` = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, CLIPPED, RADIANCE_UNIT, invert_rigid, latlong_solid_angles, transform_points
from pipeline.image.colour import Space, convert
from pipeline.light import combine, mirror_ball, sphere_fit
from pipeline.light.environment import AXES, AXIS_NAMES, irradiance
from pipeline.light.harmonics import sh9_irradiance, sh9_of_environment
from pipeline.run.artifacts import BALLS, CAMERA, ENVIRONMENT, FACTS, PHOTOGRAPHS, VIEWS
from pipeline.run.errors import CaptureError
from pipeline.run.stage import Stage
from pipeline.types import BallFit, Camera, Raster, Result, View
from stages import knobs

MIN_DISTANCE_RATIO = 1.5  # D / R below which the ball fills the view
FLAG_DISTANCE_RATIO, FLAG_RADIUS_PX, REFUSE_RADIUS_PX = 3.0, 40.0, 12.0
MIN_VISIBLE = 0.7  # of the outline; less is refused, less than all is flagged
MIN_MERIT = 0.5  # of an outline: on two captures balls had 0.52 to 0.85, empty tables with a board 0.38 to 0.49
INNER = (0.3, 0.6, 0.8)  # circles, as fractions of the outline, where a mirror shows something else than the table
MIN_CHANGE = 0.02  # median change of tone inside the outline between plate and ball, on a tripod
STAND_SIGMA = 5e-3  # of the radius: how well ball and table touch, and the diameter is known
PIXEL_SIGMA = 0.5  # px: half-width of pixel and lookup, for the angular resolution of a texel


@dataclass(frozen=True)
class Found:
    """A ball view: the fit with the plane, its prior, the free fit, the centre in the world, and what it means."""

    fit: sphere_fit.SphereFit
    free: sphere_fit.SphereFit
    height: sphere_fit.Height
    centre_world: np.ndarray


def compute(
    facts: dict[str, Any], photographs: dict[str, Raster], camera: Camera, views: dict[str, View], params: knobs.Probe
) -> Result:
    """Fitted balls, and the light at the ball (H, W) with H = width / 2, world frame."""
    radius = 0.5 * float(facts["probe"]["diameter_m"])
    names = [ball["name"] for ball in sorted(facts["ball"], key=lambda ball: not ball.get("tripod", False))]
    tripod = {ball["name"] for ball in facts["ball"] if ball.get("tripod", False)}
    warnings: list[str] = []
    found: dict[str, Found] = {}
    for name in names:
        plate = photographs["plate"] if name in tripod else None
        near = [ball.centre_world for ball in found.values()]
        found[name] = find_ball(name, photographs[name], plate, camera, views[name], radius, near)
        warnings += complaints(name, found[name], radius)
    space: Space = "linear_rec709" if facts["probe"].get("reflectance_space") == "linear_rec709" else "acescg"
    reflectance = convert(np.array(facts["probe"]["reflectance"], float), space, "acescg")
    maps, clipped = {}, 0.0
    for name in names:
        maps[name], share = view_map(photographs[name], camera, views[name], found[name], radius, reflectance, params)
        clipped = np.maximum(clipped, share)
    level = plate_level(photographs, camera, found, tripod, radius)
    maps = {
        name: combine.ViewMap(old.rgb / level, old.variance / level**2, old.weight, old.coverage)
        for name, old in maps.items()
    }
    if level != 1:
        warnings.append(f"the ball's photographs are {level:.4f} times as bright as the plate; brought to it")
    shade_photographers(maps, found, views, tripod)
    numbers: dict[str, Any] = {name: fit_numbers(found[name], radius) for name in names}
    numbers["ball_over_plate_exposure"] = level
    numbers["views"], applied = level_views(maps, names, warnings)
    rgb, variance, seen = combine.merge(list(maps.values()))
    lamp = clipped_numbers(rgb, np.asarray(clipped), seen, warnings)
    rgb = combine.fill(rgb, np.minimum(seen * 4, 1) * (seen > 0))
    variance = np.where(np.isfinite(variance) & (seen > 0)[..., None], variance, rgb**2)
    rgb, variance, seen, laid = combine.lay_plate(
        rgb, variance, seen, lookup_channels(photographs["plate"], (slice(None), slice(None)))[..., :7], camera,
        views["plate"].world_from_camera, np.mean([ball.centre_world for ball in found.values()], 0),
    )  # fmt: skip
    numbers |= lamp | map_numbers(rgb, seen) | {"plane_from_plate_fraction": laid}
    environment = Raster(
        {
            **Raster.split(rgb.astype(np.float32)),
            **Raster.split(variance.astype(np.float32), "variance"),
            "seen": seen.astype(np.float32),
        },
        ACESCG,
        {"insitu:unit": RADIANCE_UNIT, "insitu:frame": "world"},
    )
    balls = {name: ball_record(found[name].fit, radius) for name in (ball["name"] for ball in facts["ball"])}
    return Result({"balls": balls, "environment": environment}, numbers, warnings, reasons(found, applied, tripod))


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
        said.append(f"{name}: ball at {ratio:.2f} radii: the blind cone is {_blind_deg(ratio):.0f} degrees")
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


def _blind_deg(ratio: float) -> float:
    return float(np.degrees(mirror_ball.blind_half_angle(1 / ratio)))


def view_map(
    photograph: Raster, camera: Camera, view: View, ball: Found, radius: float, reflectance: np.ndarray,
    params: knobs.Probe,
) -> tuple[combine.ViewMap, np.ndarray]:  # fmt: skip
    """One view on the lat-long grid, with its weights, and the clipped fraction (H, W) of each texel."""
    height, width = params.width // 2, params.width
    fit, ratio = ball.fit, radius / float(np.linalg.norm(ball.fit.centre))
    window, part = crop(camera, fit, radius)
    picture = lookup_channels(photograph, window)
    count = mirror_ball.samples_per_axis(width, fit.radius_px, params.supersample)
    unwrapped = mirror_ball.unwrap(
        picture, part, view.world_from_camera, fit.centre, radius, height, width, count, params.rim
    )
    valid = unwrapped.values[..., 6]
    coverage = unwrapped.coverage * valid
    safe = np.where(valid > 0, valid, 1)[..., None]
    rgb = unwrapped.values[..., :3] / safe / reflectance
    photon = unwrapped.values[..., 3:6] / safe / reflectance**2
    sine = np.minimum(unwrapped.sine, 0.999)
    sigma, per_pixel = angular_sigma(sine, fit, ratio, view)
    pixels = latlong_solid_angles(height, width) / np.where(np.isfinite(per_pixel), per_pixel, np.inf)
    gradient = combine.gradient_per_radian(rgb)
    displaced = (gradient * np.where(np.isfinite(sigma), sigma, 0)[..., None]) ** 2
    variance = photon / np.maximum(pixels, 1)[..., None] + displaced
    blur = PIXEL_SIGMA * np.sqrt(per_pixel)
    weight = combine.angular_weight(sine, np.hypot(sigma, blur), params.rim) * coverage
    share = unwrapped.values[..., 7] / safe[..., 0] * (coverage > 0)
    return combine.ViewMap(rgb, variance, weight / (1 + 100 * share), coverage), share


def crop(camera: Camera, fit: sphere_fit.SphereFit, radius: float) -> tuple[tuple[slice, slice], Camera]:
    """Rows and columns of the ball, and the camera whose picture they are."""
    px = sphere_fit.silhouette(camera, fit.centre, radius, 2 * np.pi * np.arange(180) / 180)[0]
    low = np.clip(np.floor(px.min(0)).astype(int) - 3, 0, (camera.width - 1, camera.height - 1))
    high = np.clip(np.ceil(px.max(0)).astype(int) + 3, low + 1, (camera.width, camera.height))
    size = high - low
    moved = {
        "cx": camera.cx - int(low[0]),
        "cy": camera.cy - int(low[1]),
        "width": int(size[0]),
        "height": int(size[1]),
    }
    return (slice(low[1], high[1]), slice(low[0], high[0])), camera.model_copy(update=moved)


def lookup_channels(photograph: Raster, window: tuple[slice, slice]) -> np.ndarray:
    """(H, W, 8): RGB, variance RGB, valid, clipped, of a part of a photograph; invalid pixels are zero.

    A clipped pixel's infinite variance becomes the square of its value: 100 %.
    """
    rgb = photograph.rgb()[window]
    variance = photograph.rgb("variance")[window]
    clipped = photograph["mask"][window] & CLIPPED > 0
    valid = np.isfinite(rgb).all(-1)
    rgb = np.where(valid[..., None], rgb, 0)
    variance = np.where(np.isfinite(variance) & valid[..., None], variance, rgb**2)
    flags = np.stack([valid, clipped & valid], -1)
    return np.concatenate([rgb, variance, flags], -1).astype(np.float32)


def angular_sigma(
    sine: np.ndarray, fit: sphere_fit.SphereFit, ratio: float, view: View
) -> tuple[np.ndarray, np.ndarray]:
    """Standard uncertainty [rad] of each texel's direction, and the solid angle of one pixel there; NaN where blind.

    The centre's covariance is split into a shift across the ray and a change of size; the pose's rotation is added.
    """
    radial, across = mirror_ball.radians_per_pixel(sine, ratio, fit.radius_px)
    axis = fit.centre / np.linalg.norm(fit.centre)
    pixels_per_metre = fit.radius_px * ratio / np.sin(np.arcsin(ratio)) / (ratio * np.linalg.norm(fit.centre))
    along = float(axis @ fit.covariance @ axis)
    sideways = max(float(np.trace(fit.covariance)) - along, 0.0) / 2
    shift = sideways * pixels_per_metre**2
    growth = along * (fit.radius_px / np.linalg.norm(fit.centre)) ** 2
    turn = float(np.trace(view.covariance[:3, :3])) / 3
    return np.sqrt(radial**2 * (shift + sine**2 * growth) + across**2 * shift + 2 * turn), radial * across


def plate_level(
    photographs: dict[str, Raster], camera: Camera, found: dict[str, Found], tripod: set[str], radius: float
) -> float:
    """How much brighter the tripod's ball photograph is than the plate, away from the ball and its shadow.

    Labels of exposure are wrong by percents; from one place the same table is the same light. Median over pixels more
    than three ball radii from the ball that are known to 10 % in both; 1 without a tripod view or below 0.2 %.
    """
    for name in sorted(tripod & set(found)):
        one, plate = photographs[name], photographs["plate"]
        if one.shape != plate.shape:
            continue
        px = sphere_fit.silhouette(camera, found[name].fit.centre, radius, 2 * np.pi * np.arange(60) / 60)[0]
        y, x = np.mgrid[: one.shape[0], : one.shape[1]]
        far = np.hypot(x - px[:, 0].mean(), y - px[:, 1].mean()) > 3 * found[name].fit.radius_px
        with np.errstate(invalid="ignore"):
            good = far & (one["mask"] & CLIPPED == 0) & (plate["mask"] & CLIPPED == 0) & (plate["G"] > 0)
            good &= np.hypot(np.sqrt(one["variance.G"]), np.sqrt(plate["variance.G"])) < 0.1 * plate["G"]
        if good.sum() > 1000:
            ratio = float(np.median(one["G"][good] / plate["G"][good]))
            return ratio if abs(ratio - 1) > 2e-3 else 1.0
    return 1.0


def shade_photographers(
    maps: dict[str, combine.ViewMap], found: dict[str, Found], views: dict[str, View], tripod: set[str]
) -> None:
    """Lower the weight of moved views where their own camera and photographer stand, and where the tripod's stood.

    The tripod's photographer was there for the plate and lights it: only the tripod's views show him.
    """
    hidden = {}
    for name, view in maps.items():
        to_camera = views[name].world_from_camera[:3, 3] - found[name].centre_world
        distance = float(np.linalg.norm(to_camera))
        height, width = view.weight.shape
        hidden[name] = combine.toward_photographer(height, width, to_camera / distance, distance)
    for name in set(maps) - tripod if len(maps) > 1 else ():
        view = maps[name]
        shade = np.max([hidden[other] for other in {name} | (tripod & set(maps))], 0)
        lowered = view.weight * (1 - (1 - combine.MOVED_PHOTOGRAPHER_WEIGHT) * shade)
        maps[name] = combine.ViewMap(view.rgb, view.variance, lowered, view.coverage)


def level_views(
    maps: dict[str, combine.ViewMap], names: list[str], warnings: list[str]
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Bring every view to the exposure of the first; returns the figures, and the names of those that were changed."""
    figures: dict[str, dict[str, float]] = {}
    applied = []
    for name in names[1:]:
        ratio, sigma, disagreement = combine.relative_exposure(maps[names[0]], maps[name])
        figures[name] = {
            "exposure_ratio": ratio, "exposure_ratio_sigma": sigma, "overlap_disagreement_median_rel": disagreement,
        }  # fmt: skip
        if not np.isfinite(ratio):
            warnings.append(f"{name}: shares too few directions with {names[0]} to compare exposures; taken as equal")
        elif abs(np.log(ratio)) > combine.SIGNIFICANT * sigma:
            old = maps[name]
            maps[name] = combine.ViewMap(old.rgb / ratio, old.variance / ratio**2, old.weight, old.coverage)
            applied.append(name)
            warnings.append(f"{name}: {ratio:.3f} +- {ratio * sigma:.3f} times as bright as {names[0]}; brought to it")
    return figures, applied


def fit_numbers(ball: Found, radius: float) -> dict[str, Any]:
    """Figures of one fitted ball."""
    fit, distance = ball.fit, float(np.linalg.norm(ball.fit.centre))
    gap, gap_sigma = discrepancy(ball, radius)
    return {
        "centre_world_m": ball.centre_world.tolist(),
        "centre_sigma_mm": (1e3 * np.sqrt(np.diag(fit.covariance))).tolist(),
        "rms_px": fit.rms_px, "points": fit.points, "radius_px": fit.radius_px,
        "distance_over_radius": distance / radius,
        "rim_inset_px": fit.inset_px, "outline_support": fit.support, "outline_contrast": fit.contrast,
        "outline_in_frame": fit.visible, "height_discrepancy_mm": 1e3 * gap,
        "height_discrepancy_sigma_mm": 1e3 * gap_sigma,
        "blind_half_angle_deg": _blind_deg(distance / radius),
    }  # fmt: skip


def clipped_numbers(rgb: np.ndarray, clipped: np.ndarray, seen: np.ndarray, warnings: list[str]) -> dict[str, Any]:
    """How much of the light is a lower bound."""
    touched = (clipped > 0.5) & (seen > 0)
    weighted = rgb.mean(-1) * latlong_solid_angles(*seen.shape)
    share = float(weighted[touched].sum() / max(float(weighted.sum()), 1e-300))
    if touched.any():
        warnings.append(
            f"{int(touched.sum())} texels are clipped in every frame ({share:.1%} of the light, a lower bound); add a "
            "shorter exposure or an ND filter"
        )
    return {"clipped_texels": int(touched.sum()), "clipped_light_lower_bound_rel": share}


def map_numbers(rgb: np.ndarray, seen: np.ndarray) -> dict[str, Any]:
    """Figures of the finished map."""
    exact = irradiance(rgb, AXES)
    smooth = sh9_irradiance(sh9_of_environment(rgb), AXES)
    grey, weight = rgb.mean(-1), latlong_solid_angles(*seen.shape)
    return {
        "seen_fraction": float((seen * weight).sum() / weight.sum()),
        "max_over_median": float(grey.max() / max(float(np.median(grey)), 1e-300)),
        "irradiance": {name: value.tolist() for name, value in zip(AXIS_NAMES, exact, strict=True)},
        "irradiance_sh9": {name: value.tolist() for name, value in zip(AXIS_NAMES, smooth, strict=True)},
        "negative_texels": int((grey < 0).sum()),
    }


def ball_record(fit: sphere_fit.SphereFit, radius: float) -> BallFit:
    """The fit as it is stored."""
    return BallFit(
        centre_camera_m=fit.centre, radius_m=radius, covariance=fit.covariance, rms_px=fit.rms_px, points=fit.points,
        radius_px=fit.radius_px,
    )  # fmt: skip


def reasons(found: dict[str, Found], applied: list[str], tripod: set[str]) -> list[dict[str, Any]]:
    """Which terms of the model are in, and why."""
    moved = [name for name in found if name not in tripod]
    height = 1e3 * max(ball.height.sigma_m for ball in found.values())
    rim = 1e3 * max(float(np.sqrt(b.height.normal @ b.free.covariance @ b.height.normal)) for b in found.values())
    return [
        {
            "term": "ball stands on the plane",
            "modelled": True,
            "because": f"pose and contact give the height to {height:.1f} mm, the rim alone to {rim:.1f} mm",
            "could_cost": "the distance from the rim alone: about 1 px of radius",
        },
        {
            "term": "relative exposure of views",
            "modelled": bool(applied),
            "because": f"differs by more than {combine.SIGNIFICANT:.0f} sigma in {', '.join(applied) or 'no view'}",
            "could_cost": "a seam of that ratio",
        },
        {
            "term": "moved photographer removed, the tripod's kept",
            "modelled": len(found) > 1 and bool(moved),
            "because": "who moved was not there for the plate; who stood at the tripod was, and lights it",
            "could_cost": "one person's solid angle of wrong light",
        },
        {
            "term": "plane from the plate below 7 degrees under the horizon",
            "modelled": True,
            "because": "the ball mirrors its own shadow; the plate shows the plane without it, taken as diffuse",
            "could_cost": "13 % of the irradiance from below, 3 % of that from the side on one capture; 2 % on another",
        },
        {
            "term": "Fresnel reflectance of the ball",
            "modelled": False,
            "because": "the manifest gives one reflectance per channel",
            "could_cost": "1 to 3 % near the rim of chrome, 0 of an ideal mirror",
        },
        {
            "term": "parallax of near surfaces",
            "modelled": False,
            "because": "the room's distances are not measured",
            "could_cost": "directions off by R over distance, radiance unbiased",
        },
        {
            "term": "photon noise in the view weights",
            "modelled": False,
            "because": "it follows the signal; views are weighted by how well they know the direction",
            "could_cost": "less than the bias it would bring to lamps",
        },
    ]


STAGE = Stage(
    "probe", compute, knobs.Probe,
    inputs={"facts": FACTS, "photographs": PHOTOGRAPHS, "camera": CAMERA, "views": VIEWS},
    outputs={"balls": BALLS, "environment": ENVIRONMENT},
)  # fmt: skip
