"""The mirror ball: found on the plane, fitted as a sphere under the lens, unwrapped by exact perspective reflection.

Radiance is the pixel's over the ball's reflectance, as mirrors conserve radiance (Debevec 1998). The tripod's own
photographer stays, as he stood there for the plate too; those of moved views give way to what other views see.
What lies below the horizon is the plane that the ball stands on (`pipeline.probes.parallax`).
Limits: other light is taken as distant, so things at distance d are displaced by up to R/d.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pipeline.conventions import CLIPPED, invert_rigid, latlong_solid_angles
from pipeline.probes import combine, photographer, shared_lamps, sphere_fit
from pipeline.probes.anchor import anchored, anchored_radius
from pipeline.probes.ball_evidence import examine, shape, without
from pipeline.probes.ball_surface import Surface
from pipeline.probes.finding import Found, agreed, complaints, discrepancy, find_ball, refuse_cut, solve_radius
from pipeline.probes.glass import MOST, Glass, unghosted
from pipeline.probes.glass_thickness import GlassEvidence, glimpse, judge, thickness, worth_measuring
from pipeline.probes.mirror_geometry import Mirror, texel_directions
from pipeline.probes.observation import Grid, Observation, Quality, Shots, ViewMap
from pipeline.probes.outline import part_of
from pipeline.probes.parallax import set_down
from pipeline.probes.reflection import deviation, direction_sigma, radians_per_pixel
from pipeline.probes.unwrap import displaced_variance, unwrap
from pipeline.run.errors import CaptureError
from pipeline.types import BallFit, Camera, Raster, View

PIXEL_SIGMA = 0.5  # px: half-width of pixel and lookup, for the angular resolution of a texel
MIN_RIM, EDGE_PX = 0.8, 2.0
FLAG_DIRECTION_DEG = 1.0
SURFACE_RIM = 0.97  # for measuring the reflectance
# Of a radius by the rim and the plane's height: what it states, against its error on five views of three captures
# (-3.7, -1.9, 0.8, -1.2, -0.1 sigma): a rim drifts with its background on one side.
RIM_SIZE_FACTOR = 2.0


class MirrorBall:
    """One or several photographs of a polished ball that stands on the plane."""

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        """One map per ball view. Raises CaptureError when there is no ball, or it cannot be used."""
        facts, photographs, views = shots.facts, shots.photographs, shots.views
        names = [ball["name"] for ball in sorted(facts["ball"], key=lambda ball: not ball.get("tripod", False))]
        tripod = {ball["name"] for ball in facts["ball"] if ball.get("tripod", False)}
        warnings: list[str] = []
        radius, radius_sigma = radius_of(shots, names, tripod, warnings)
        clicks = {ball["name"]: ball.get("click_px") for ball in facts["ball"]}
        stated = stated_glass(facts["probe"], radius)
        found: dict[str, Found] = {}
        anchors: dict[str, dict[str, Any]] = {}
        for name in names:
            plate = photographs["plate"] if name in tripod else None
            near = [ball.centre_world for ball in found.values()]
            found[name] = find_ball(
                name, photographs[name], plate, shots.camera_of(name), views[name], radius, near, clicks[name],
                radius_sigma,
            )  # fmt: skip
        cameras = {name: shots.camera_of(name) for name in names}
        by_rim = agreed(found, photographs, cameras, views, radius)
        for name in names:
            warnings += complaints(name, by_rim[name], radius)
            found[name], anchors[name] = anchored(
                by_rim[name], photographs[name], shots.camera_of(name), views[name], radius, stated
            )
        fronts = {name: found[name].fit.centre for name, anchor in anchors.items() if stated is None and anchor["used"]}
        glassy = glass_of(shots, by_rim, radius, stated, fronts)
        for name in names:
            if glassy.glass is not stated:
                found[name], anchors[name] = anchored(
                    by_rim[name], photographs[name], shots.camera_of(name), views[name], radius, glassy.glass
                )
            if not anchors[name]["used"]:
                refuse_cut(name, found[name].fit, why=f" as {anchors[name]['why']}")
        found, lamps = shared_lamps.tied(found, photographs, cameras, views, radius, glassy.glass)
        gloss = any(one["used"] and "left_with_its_contrast_px" in one for one in anchors.values())
        known = examine(shots, found, radius, min(grid.rim, SURFACE_RIM), glassy.glass, gloss)
        warnings += known.warnings + glassy.warnings

        def mapped(name: str) -> ViewMap:
            photograph, ball, view = without(photographs[name], known.dirty.get(name)), found[name], views[name]
            shown = view_map(photograph, shots.camera_of(name), view, ball, radius, known.surface, grid)
            return set_down(shown, ball.centre_world, radius, view.world_from_camera[:3, 3], glassy.glass)

        with ThreadPoolExecutor() as pool:  # half of it is lookups and sums that hold no lock
            maps = dict(zip(names, pool.map(mapped, names), strict=True))
        to_camera = {name: views[name].world_from_camera[:3, 3] - found[name].centre_world for name in names}
        maps, people = photographer.shade(maps, to_camera, tripod)
        shaped = shape(maps, known.dents, glassy.direction_sigma_rad)
        warnings += shaped.warnings + ghosts_left(maps, glassy.glass)
        numbers: dict[str, Any] = {
            name: fit_numbers(found[name], radius, glassy.glass) | people.get(name, {}) for name in names
        }
        for name, anchor in anchors.items():
            numbers[name]["mirrored_plane"] = anchor
            if (sigma := numbers[name]["direction_sigma_deg"]) > FLAG_DIRECTION_DEG:
                warnings.append(
                    f"{name}: directions are known to {sigma:.1f} degrees, ball of {found[name].fit.radius_px:.0f} px; "
                    "go nearer, or let it mirror print"
                )
        balls = {ball["name"]: ball_record(found[ball["name"]].fit, radius, known.surface) for ball in facts["ball"]}
        centre = np.mean([ball.centre_world for ball in found.values()], 0)
        evidence = [*reasons(found), centred(anchors), photographer.reason(people, len(maps)), *known.evidence]
        evidence += [*glassy.evidence, shared_lamps.reason(lamps)]
        numbers |= known.numbers | shaped.numbers | glassy.numbers
        return Observation(
            shaped.maps, centre, balls, numbers | {"shared_lamps": lamps}, warnings,
            [*evidence, *shaped.evidence], scale_sigma=known.surface.sigma, smooth_only=shaped.smooth_only,
        )  # fmt: skip


def stated_glass(facts: dict[str, Any], radius: float) -> Glass | None:
    """The glass of the [probe] table. Raises CaptureError when it is too thick to be before a mirror."""
    if facts.get("glass_mm") is None:
        return None
    share = 1e-3 * float(facts["glass_mm"]) / radius
    if share > MOST:
        raise CaptureError(
            f"probe.glass_mm: {facts['glass_mm']:g} mm is {share:.0%} of the ball's radius, needed {MOST:.0%} or less; "
            "give the wall's thickness"
        )
    return Glass(share) if share > 0 else None


def glass_of(
    shots: Shots, by_rim: dict[str, Found], radius: float, stated: Glass | None, fronts: dict[str, np.ndarray]
) -> GlassEvidence:  # fmt: skip
    """What is known of the ball's glass: stated, or measured by the plane that the views mirror.

    ``by_rim``: the balls before the mirrored plane moved them; ``fronts``: centres (3,) [m], camera frame, of those
    whose mirrored plane fits a front mirror. Where all do, and a glimpse of them shows no glass, that is what was
    measured. Not measured at unknown size, which the plane's mirror image was used for.
    """
    facts = shots.facts["probe"]
    if facts.get("diameter_m") is None:
        return judge(stated, {}, "at unknown size the mirrored plane tells the diameter")
    names = [name for name, ball in by_rim.items() if ball.on_plane]

    def seen(name: str) -> tuple[Raster, Camera, View, sphere_fit.SphereFit, float]:
        return shots.photographs[name], shots.camera_of(name), shots.views[name], by_rim[name].fit, radius

    def glimpsed(name: str) -> tuple[float, float, float] | None:
        return glimpse(*seen(name), fronts[name])

    def measured(name: str) -> tuple[float, float, float] | None:
        return thickness(*seen(name))

    front = set(names) <= set(fronts)
    known = _known(names, glimpsed) if front else {}
    if not front or worth_measuring(known):
        known = _known(names, measured)
    return judge(stated, known, "too little texture of the plane is seen in the ball to tell", facts.get("material"))


def _known(
    names: list[str], measure: Callable[[str], tuple[float, float, float] | None]
) -> dict[str, tuple[float, float, float]]:
    """What is measured of each view, of those where it can be."""
    with ThreadPoolExecutor() as pool:  # arrays of all rays: most of it holds no lock
        found = list(pool.map(measure, names))
    return {name: one for name, one in zip(names, found, strict=True) if one is not None}


def ghosts_left(maps: dict[str, ViewMap], glass: Glass | None) -> list[str]:
    """Warns of ghosts that could not be taken away."""
    clipped = [name for name, view in maps.items() if (view.clipped * (view.weight > 0)).max(initial=0) > 0.5]
    if glass is None or not clipped:
        return []
    return [
        f"{', '.join(clipped)}: the glass shows clipped lamps twice more, at 4 % each, up to "
        f"{np.degrees(glass.displacement()[1]):.1f} degrees beside; only what the clipped values explain is taken away"
    ]


def radius_of(shots: Shots, names: list[str], tripod: set[str], warnings: list[str]) -> tuple[float, float]:
    """Radius [m] and its standard uncertainty: given, or solved from the plane in every view that allows it, averaged.

    A view whose outline is not found at unknown size takes the size from the others. Radii that differ by more than
    they state raise the uncertainty (Birge's ratio). Raises CaptureError when no view gives a size.
    """
    diameter = shots.facts["probe"].get("diameter_m")
    if diameter is not None:
        return 0.5 * float(diameter), 0.0
    clicks = {ball["name"]: ball.get("click_px") for ball in shots.facts["ball"]}
    solved: dict[str, tuple[float, float]] = {}
    refused: dict[str, CaptureError] = {}
    for name in names:
        photograph, camera, view = shots.photographs[name], shots.camera_of(name), shots.views[name]
        plate = shots.photographs["plate"] if name in tripod else None
        try:
            *by_rim, fit = solve_radius(name, photograph, plate, camera, view, clicks[name])
        except CaptureError as error:
            refused[name] = error
            continue
        rim_only = (by_rim[0], RIM_SIZE_FACTOR * by_rim[1])
        thick = shots.facts["probe"].get("glass_mm")
        glass_m = None if thick is None else 1e-3 * float(thick)
        solved[name] = anchored_radius(fit, photograph, camera, view, by_rim[0], glass_m) or rim_only
    if not solved:
        raise next(iter(refused.values()))
    radius, sigma, birge = averaged(np.array(list(solved.values())))
    each = ", ".join(f"{2e3 * size:.2f} +- {2e3 * error:.2f} by {name}" for name, (size, error) in solved.items())
    warnings.append(
        f"the ball's diameter was not given: {2e3 * radius:.2f} +- {2e3 * sigma:.2f} mm by the plane it stands on "
        f"({each}" + f"; not found at unknown size: {', '.join(refused)}" * bool(refused) + ")"
    )
    if birge > 3:
        warnings.append(f"views' diameters differ by {birge:.1f} times what they state: is it one ball on one plane?")
    return radius, sigma


def averaged(solved: np.ndarray) -> tuple[float, float, float]:
    """Mean by inverse variance of values and sigmas (N, 2), its standard uncertainty, and Birge's ratio (1 for N = 1).

    The uncertainty is multiplied by the ratio where that exceeds one: values that differ by more than they state have
    left something out.
    """
    value, sigma = solved.T
    weight = sigma**-2
    mean = float(weight @ value / weight.sum())
    birge = float(np.sqrt((((value - mean) / sigma) ** 2).sum() / (len(value) - 1))) if len(value) > 1 else 1.0
    return mean, max(birge, 1.0) * float(weight.sum() ** -0.5), birge


def view_map(
    photograph: Raster, camera: Camera, view: View, ball: Found, radius: float, surface: Surface, grid: Grid
) -> ViewMap:  # fmt: skip
    """One view on the lat-long grid, with its weights. The variance leaves out what the reflectance adds to all texels.

    A texel's direction is uncertain by the fit and the pose, and blurred by a pixel; photons are each pixel's own.
    """
    height, width = grid.height, grid.width
    fit = ball.fit
    window, part = crop(camera, fit, radius)
    rotation = invert_rigid(view.world_from_camera)[:3, :3]
    glass = surface.glass
    rim = min(grid.rim, usable_rim(fit, radius, glass))
    mirror = Mirror(part, rotation, fit.centre, radius, rim, glass)
    valid, channels = lookup_planes(photograph, window)
    shown = unwrap(valid, channels, mirror, height, width)
    sine, direction = texel_directions(mirror, height, width, fit.covariance, view.covariance[:3, :3])
    reflectance = surface.at(sine).astype(np.float32)
    rgb = shown.values[..., :3] / reflectance
    photon = shown.values[..., 3:6] / reflectance**2
    if glass is not None:
        rgb, photon = without_ghosts(rgb, photon, shown.coverage, sine, mirror, surface)
    variance = photon * shown.spread[..., None] + displaced_variance(rgb, direction, shown.coverage)
    pixels = np.where(np.isfinite(sine), shown.pixels, 0)
    blur = PIXEL_SIGMA**2 * latlong_solid_angles(height, width) / np.maximum(pixels, 1e-6)
    sigma = np.sqrt(np.where(np.isfinite(sine), direction[..., 0] + direction[..., 1] + blur, np.nan))
    clipped = shown.values[..., 6]
    trust = combine.rim_fade(sine, sigma, rim) * shown.coverage
    quality = Quality(sigma, pixels, photon.mean(-1))
    return ViewMap(rgb, variance, trust / (1 + 100 * clipped), shown.coverage, clipped, quality)


def without_ghosts(
    rgb: np.ndarray, photon: np.ndarray, coverage: np.ndarray, sine: np.ndarray, mirror: Mirror, surface: Surface
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and photon variance (H, W, 3) of the mirror behind the glass alone."""
    assert surface.glass is not None
    away = mirror.rotation.T @ mirror.axis
    light, _ = unghosted(rgb, coverage, sine, away, surface.glass, surface.facing)
    shares = surface.glass.ghosts(surface.facing, np.where(np.isfinite(sine) & (coverage > 0), sine, 0.0))
    return light.astype(np.float32), (photon / (1 - shares[0] - shares[1]) ** 2).astype(np.float32)


def usable_rim(fit: sphere_fit.SphereFit, radius: float, glass: Glass | None = None) -> float:
    """Outermost radius that is worth using, as a fraction of the silhouette's; at least MIN_RIM.

    Towards the silhouette a pixel spans ever more of the world: `radians_per_pixel` grows without bound. A ring is kept
    while three standard uncertainties of its direction (fit and pixel) are less than the half angle of the cone that
    would stay unseen without it, which the gain is. The last EDGE_PX pixels, and three standard uncertainties of the
    outline, mix with what is behind the ball.
    """
    distance = float(np.linalg.norm(fit.centre))
    axis, ratio = fit.centre / distance, radius / distance
    per_metre = fit.radius_px / radius
    along = float(axis @ fit.covariance @ axis)
    aside = 0.5 * max(float(np.trace(fit.covariance)) - along, 0.0)
    edge = per_metre * float(np.sqrt(aside + ratio**2 * along))
    rim = np.linspace(MIN_RIM, 1, 2000, endpoint=False)
    sigma = radians_per_pixel(rim, ratio, fit.radius_px, glass)[0] * np.hypot(edge, PIXEL_SIGMA)
    unseen = np.pi - deviation(rim, ratio, glass)
    margin = EDGE_PX + fit.blur_px + 3 * edge
    good = (3 * sigma < unseen) & (rim < 1 - margin / fit.radius_px)
    return float(rim[good].max(initial=MIN_RIM))


def lookup_planes(photograph: Raster, window: tuple[slice, slice]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Where a part of a photograph is known (h, w), and (h, w) each of RGB, variance RGB and clipped; zero elsewhere.

    A clipped pixel's infinite variance becomes the square of its value: 100 %.
    """
    colours = [np.asarray(photograph[c][window], np.float32) for c in "RGB"]
    variances = [np.asarray(photograph[f"variance.{c}"][window], np.float32) for c in "RGB"]
    valid = np.isfinite(colours[0] + colours[1] + colours[2])
    if not valid.all():
        colours = [np.where(valid, c, 0) for c in colours]
    for i, (c, v) in enumerate(zip(colours, variances, strict=True)):
        known = np.isfinite(v) & valid
        if not known.all():
            variances[i] = np.where(known, v, c * c)
    clipped = (photograph["mask"][window] & CLIPPED > 0) & valid
    return valid.astype(np.float32), [*colours, *variances, clipped.astype(np.float32)]


def crop(camera: Camera, fit: sphere_fit.SphereFit, radius: float) -> tuple[tuple[slice, slice], Camera]:
    """Rows and columns of the ball, and the camera whose picture they are."""
    px = sphere_fit.silhouette(camera, fit.centre, radius, 2 * np.pi * np.arange(180) / 180)[0]
    low = np.clip(np.floor(px.min(0)).astype(int) - 3, 0, (camera.width - 1, camera.height - 1))
    high = np.clip(np.ceil(px.max(0)).astype(int) + 3, low + 1, (camera.width, camera.height))
    return (slice(low[1], high[1]), slice(low[0], high[0])), part_of(camera, low, high)


def fit_numbers(ball: Found, radius: float, glass: Glass | None = None) -> dict[str, Any]:
    """Figures of one fitted ball."""
    fit, distance = ball.fit, float(np.linalg.norm(ball.fit.centre))
    gap, gap_sigma = discrepancy(ball, radius)
    blind = np.pi - float(deviation(np.array(1.0), radius / distance, glass))
    return {
        "centre_world_m": ball.centre_world.tolist(),
        "centre_sigma_mm": (1e3 * np.sqrt(np.diag(fit.covariance))).tolist(),
        "rms_px": fit.rms_px, "points": fit.points, "radius_px": fit.radius_px,
        "distance_over_radius": distance / radius,
        "rim_blur_px": fit.blur_px, "outline_support": fit.support, "outline_contrast": fit.contrast,
        "outline_in_frame": fit.visible, "height_discrepancy_mm": 1e3 * gap,
        "height_discrepancy_sigma_mm": 1e3 * gap_sigma,
        "direction_sigma_deg": float(np.degrees(direction_sigma(fit.centre, fit.covariance, radius, glass))),
        "blind_half_angle_deg": float(np.degrees(max(blind, 0.0))),
    }  # fmt: skip


def ball_record(fit: sphere_fit.SphereFit, radius: float, surface: Surface) -> BallFit:
    """The fit as it is stored, with the reflectance that was used."""
    return BallFit(
        centre_camera_m=fit.centre, radius_m=radius, covariance=fit.covariance, rms_px=fit.rms_px, points=fit.points,
        radius_px=fit.radius_px, reflectance=surface.facing, edge_tint=surface.tint,
        glass=0.0 if surface.glass is None else surface.glass.thickness,
    )  # fmt: skip


def centred(anchors: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Why the mirrored plane has a say in where the ball is, or has none."""
    said = [
        f"{name}: moved by {one['moved_px']:.2f} px, chi2 {one['chi2']:.1f}, {one['left_px']:.2f} px left"
        + ", believed against the rim" * one["against_the_rim"]
        + (
            f", its contrast left free as with it {one['left_with_its_contrast_px']:.2f} px are: gloss"
            if "left_with_its_contrast_px" in one
            else ""
        )
        if one["used"]
        else f"{name}: {one['why']}"
        for name, one in anchors.items()
    ]
    return {
        "term": "centre by the plane's mirror image",
        "modelled": any(one["used"] for one in anchors.values()),
        "because": "; ".join(said),
        "could_cost": "up to a pixel of drift of the rim alone: 1.3 degrees for a ball of 100 px",
        "bound_px": 1.0,
    }


def reasons(found: dict[str, Found]) -> list[dict[str, Any]]:
    """Which terms of the model are in, and why."""
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
            "term": "parallax of the plane",
            "modelled": True,
            "because": "the ball stands on it: a mirrored ray below the horizon meets the plane at a known distance",
            "could_cost": "1.3 to 3.2 % of the irradiance from the side, measured without it on two captures",
        },
        {
            "term": "parallax of other near surfaces",
            "modelled": False,
            "because": "the mirror's points are taken for its middle; [room] serves the map at the objects, not this",
            "could_cost": "directions off by R over distance, radiance unbiased",
            "no_bound": "how far off they are is not known; what the objects feel of it is the near field's row",
        },
    ]
