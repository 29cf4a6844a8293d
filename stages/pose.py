"""Where every view was taken from: board, marker, points, given or further views, each with a 6x6 covariance.

Method: corners are measured in the photograph itself and the pose minimises their reprojection error through the lens
(Levenberg-Marquardt, Huber search, then least squares without outliers). Both poses that a plane allows (IPPE, Collins
and Bartoli 2014) are refined; when the second is nearly as good, a further marker decides, else a mirror ball of known
diameter that stands on the plane of one, else the view is refused with both. Several markers are mapped from all views
(`pipeline/camera/marker_map.py`). Surveyed points start by LO-RANSAC (COLMAP) and count by their own uncertainty. Views
that show no marker are oriented by what they share with further photographs: tracks of the cloud and markers seen in
any of them are adjusted together (`pipeline/camera/bundle.py`). Covariance: inverse normal matrix times the larger of
the stated corner variance and chi2 per degree of freedom, plus the camera's covariance carried through; corners are
taken as independent. Views from one tripod position are tested for having stayed (chi2 of the difference) and then
share one pose, estimated from their averaged corners. Limits: a flat board of the stated size; a wrong size scales the
world unnoticed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera import board_doubts
from pipeline.camera.cloud_plane import in_world
from pipeline.camera.lens import project
from pipeline.camera.map_report import report
from pipeline.camera.marker_map import MarkerMap, with_tripod
from pipeline.camera.markers import grey
from pipeline.camera.opencv_bridge import Sightings, read_grey
from pipeline.camera.resection import Resection, refine, resect_plane
from pipeline.camera.rigid import camera_points, difference
from pipeline.camera.sfm import Seen, oriented, scale_sigma, scaled_covariance
from pipeline.camera.sights import FEWEST_CORNERS, averaged, marks_in
from pipeline.camera.stated import rigid
from pipeline.camera.survey import resect_points
from pipeline.image.colour import decode_srgb
from pipeline.probes.standing import standing_chi2
from pipeline.run.artifacts import (
    CAMERA,
    CLOUD,
    FACTS,
    PHOTOGRAPHS,
    RECONSTRUCTION,
    VIEW_CAMERAS,
    VIEW_PHOTOS,
    VIEWS,
)
from pipeline.run.errors import CaptureError, ManifestError, NumericalError
from pipeline.run.stage import Stage
from pipeline.types import Camera, Frame, Raster, Reconstruction, Result, View
from stages import knobs

MOVED_CHI2 = 22.46  # 99.9 % of chi2 with six degrees of freedom
STANDS_CHI2 = 10.8  # and with one: a ball higher or lower than this does not stand on the plane
WIDE_ROTATION_DEG = 1.0
LARGE_RMS_PX = 0.5
FAR_M = 1e4  # from the origin: there single precision, which renders, has steps of a millimetre


@dataclass(frozen=True)
class Estimate:
    """What was seen in one view and the pose it gave."""

    route: str
    seen: Sightings
    best: Resection
    second: Resection | None
    ambiguity: float
    decided: str = ""  # what told the two poses apart, beside the corners


def compute(
    facts: dict[str, Any], photographs: dict[str, Raster], camera: Camera, view_cameras: dict[str, Camera],
    reconstruction: Reconstruction, view_photos: list[Frame], params: knobs.Pose,
) -> Result:  # fmt: skip
    """``world_from_camera`` of "plate" and of every ball, and the camera of each that is not the plate's."""
    balls = {ball["name"]: bool(ball.get("tripod", False)) for ball in facts["ball"]}
    orders = {name: order_of(facts, name, balls) for name in ("plate", *balls)}
    cameras = {name: view_cameras.get(name, camera) for name in orders}
    check_sizes(photographs, cameras)
    tripod = [name for name, stays in balls.items() if stays and not orders[name]["explicit"]]
    several = len(facts.get("marker") or []) > 1
    settled = tripod if orders["plate"]["route"] == "colmap" else []  # all photographs say whether these stayed
    mapped = [n for n, order in orders.items() if order["route"] == "marker" and several and n not in settled]
    looked = [name for name, order in orders.items() if order["route"] in ("charuco", "marker") and name not in mapped]
    looked = [name for name in looked if name not in settled]
    with ThreadPoolExecutor(2) as pool:  # OpenCV releases the GIL
        sights = dict(
            zip(looked, pool.map(lambda n: sight(facts, n, orders[n], photographs[n], cameras[n]), looked), strict=True)
        )
    warnings: list[str] = []
    estimates: dict[str, Estimate] = {}
    views: dict[str, View] = {}
    asked = [name for name, order in orders.items() if order["route"] == "colmap"]
    extra: dict[str, Any] = {}
    cloud = Reconstruction()
    if asked:
        found = by_views(facts, asked, tripod, photographs, camera, reconstruction, view_photos, warnings)
        views, extra, cloud = views | found[0], found[1], found[2]
    places: dict[str, Any] = {}
    if mapped:
        by_marker = by_map(facts, mapped, tripod, photographs, cameras, view_photos, params, warnings)
        views, estimates, places = views | by_marker[0], by_marker[1], by_marker[2]
    for name in orders:
        if name not in tripod and name not in views:
            estimate = estimate_view(name, orders[name], sights.get(name), cameras[name], params)
            if isinstance(estimate, Estimate):
                estimate = by_ball(facts, name, estimate, photographs, cameras, params)
                refuse_named(name, estimate, params)
                estimates[name] = estimate
            views[name] = view_of(estimate) if isinstance(estimate, Estimate) else estimate
    shifts = settle_tripod(tripod, sights, estimates, views, camera, params, warnings)
    numbers = {
        name: figures(name, view, estimates.get(name), sights.get(name), warnings) for name, view in views.items()
    }
    warnings += board_doubts.of_prints(facts, views, sights, grey(photographs["plate"].rgb()), cameras["plate"])
    for name, shift in {**shifts, **places.pop("tripod_shift_px", {})}.items():
        numbers[name]["tripod_shift_px"] = shift
    numbers |= {key: part for key, part in (("sfm", extra), ("marker_map", places)) if part}
    result = {name: views[name].model_copy(update={"camera": view_cameras.get(name)}) for name in orders}
    return Result({"views": result, "cloud": cloud}, numbers, warnings, reasons(orders, views, list(cameras.values())))


def order_of(facts: dict[str, Any], name: str, balls: dict[str, bool]) -> dict[str, Any]:
    """How a view is to be oriented: the manifest's [[pose]] entry, else by the board, else by the marker."""
    for entry in facts.get("pose", []):
        if entry["view"] == name:
            if entry["route"] in ("charuco", "marker") and not facts.get(
                "board" if entry["route"] == "charuco" else "marker"
            ):
                raise ManifestError(
                    f"pose: view {name} asks for {entry['route']}, which the manifest does not describe"
                )
            return {**entry, "explicit": True}
    for route, fact in (("charuco", "board"), ("marker", "marker")):
        if facts.get(fact):
            return {"route": route, "explicit": False}
    if balls.get(name):
        return {"route": "same_as", "explicit": False}
    raise ManifestError(f"view {name}: neither [board], [marker] nor a [[pose]] entry; needed one to orient it")


def by_views(
    facts: dict[str, Any], asked: list[str], tripod: list[str], photographs: dict[str, Raster], camera: Camera,
    reconstruction: Reconstruction, view_photos: list[Frame], warnings: list[str],
) -> tuple[dict[str, View], dict[str, Any], Reconstruction]:  # fmt: skip
    """Poses of the views that asked for it from all photographs together, the numbers of that adjustment, its cloud."""
    lost = [name for name in asked if name not in reconstruction.names]
    if lost:
        raise CaptureError(
            f"{lost[0]}: shares too little with the further views to be oriented by them, needed common texture; "
            "photograph [views] from nearer to it, or give it another [[pose]] route"
        )
    cameras = [camera, *reconstruction.cameras[1:]]
    root = Path(facts["capture_root"])
    files = {photo.file for photo in view_photos}
    seen: dict[str, list[Seen]] = {}
    for number, name in enumerate(reconstruction.names):
        lens = cameras[reconstruction.camera_of[number]]
        linear = linear_of(root / name) if name in files else grey(photographs[name].rgb())
        seen[name] = marks_in(facts, linear, lens)[0]
    done, markers = oriented(reconstruction, cameras, seen, None)
    warnings += board_doubts.sizes_in_views(done.bundle, markers, facts.get("marker") or [])
    views: dict[str, View] = {}
    scale = scale_sigma(done)
    for number, name in enumerate(reconstruction.names):
        if name not in asked and name not in tripod:
            continue
        by_lens, lens = done.by_lens[number], cameras[reconstruction.camera_of[number]]
        mine = (done.bundle.seen_view == number) & done.used
        views[name] = View(
            world_from_camera=done.bundle.poses[number],
            covariance=scaled_covariance(
                done.pose_covariance[number] + by_lens @ lens.covariance @ by_lens.T, done.bundle.poses[number], scale
            ), route="colmap",
            rms_px=float(done.track_sigma_px * np.sqrt(2)), points=int(mine.sum()),
            lens_covariance=by_lens @ lens.covariance,
        )  # fmt: skip
    shown = {name: len(marks) for name, marks in seen.items() if marks}
    numbers: dict[str, Any] = {
        "scale_sigma_rel": scale, "track_sigma_px": done.track_sigma_px, "corner_sigma_px": done.corner_sigma_px,
        "left_out": int((~done.used).sum()), "sightings": len(done.used), "markers_seen_in": len(shown),
        "markers_placed": len(markers),
    }  # fmt: skip
    for name in [name for name in tripod if name in views and "plate" in views]:
        apart = difference(views[name].world_from_camera, views["plate"].world_from_camera)
        at = [reconstruction.names.index(n) for n in (name, "plate")]
        chi2 = float(apart @ np.linalg.solve(done.pose_covariance[at].sum(0), apart))
        numbers[f"{name}_tripod_chi2"] = chi2
        if chi2 <= MOVED_CHI2:
            views.pop(name)  # it stayed: the plate's pose is its own
        else:
            warnings.append(
                f"{name}: the tripod moved by {np.linalg.norm(apart[3:]) * 1000:.1f} mm; its own pose is used"
            )
    return views, numbers, in_world(reconstruction, done, cameras)


def linear_of(file: Path) -> np.ndarray:
    """(H, W) float32 linear grey of a further photograph."""
    return np.asarray(decode_srgb(np.asarray(read_grey(file), np.float32) / 255), np.float32)


def by_map(
    facts: dict[str, Any], asked: list[str], tripod: list[str], photographs: dict[str, Raster],
    cameras: dict[str, Camera], view_photos: list[Frame], params: knobs.Pose, warnings: list[str],
) -> tuple[dict[str, View], dict[str, Estimate], dict[str, Any]]:  # fmt: skip
    """Views, estimates and numbers of the views that show markers of unknown layout; further photographs help."""
    root, seen, lenses = Path(facts["capture_root"]), {}, dict(cameras)
    for name in asked:
        seen[name], notes = marks_in(facts, grey(photographs[name].rgb()), cameras[name])
        warnings += [f"{name}: {note}" for note in notes]
    ours = not (facts.get("views") or {}).get("own_camera", False)
    for photo in view_photos if ours else []:
        lenses[photo.file] = cameras["plate"]
        seen[photo.file] = marks_in(facts, linear_of(root / photo.file), cameras["plate"])[0]
    here = [name for name in tripod if name in asked]
    found, moved = with_tripod(seen, lenses, here, params.corner_sigma_px, MOVED_CHI2)
    views: dict[str, View] = {}
    estimates: dict[str, Estimate] = {}
    for name in asked:
        if name in here and "plate" in found.names and name not in found.names:
            continue  # it stayed, or shows nothing that says it did not: the plate's pose is its own
        if name not in found.names:
            shown = sorted(facts["marker"][one.marker]["id"] for one in seen[name])
            raise CaptureError(
                f"{name}: shows {f'markers {shown}' if shown else 'no marker'}, none that hangs together with the "
                f"first ({facts['marker'][0]['id']}), needed one; photograph both in one picture as well"
            )
        estimates[name] = map_estimate(found, name, seen[name], cameras[name], params)
        if name in found.lone:
            estimates[name] = by_ball(facts, name, estimates[name], photographs, cameras, params)
        refuse_named(name, estimates[name], params)
        views[name] = view_of(estimates[name])
    for name, (chi2, shift) in moved.items():
        if name in views:
            warnings.append(moved_by(name, "markers", shift, chi2))
    for name in here:
        if name not in views and "plate" in views:
            views[name] = views["plate"].model_copy(update={"route": "same_as"})
    numbers, said = report(facts["marker"], found, params.min_ambiguity)
    warnings += said
    return views, estimates, numbers | {"tripod_shift_px": {name: shift for name, (_, shift) in moved.items()}}


def map_estimate(found: MarkerMap, name: str, marks: list[Seen], camera: Camera, params: knobs.Pose) -> Estimate:
    """One view of the map as an estimate."""
    world_m, px, ids = found.world_points(marks)
    pose = found.done.bundle.poses[found.names.index(name)]
    covariance, by_lens = found.covariance(name, camera)
    residuals = px - project(camera, camera_points(pose, world_m)[0])
    best = Resection(
        pose, covariance, found.done.pose_covariance[found.names.index(name)], by_lens, residuals,
        np.ones(len(px), bool), found.done.corner_sigma_px, float((residuals**2).sum()) / params.corner_sigma_px**2,
        name in found.lone and found.lone[name].frontal,
    )  # fmt: skip
    other = found.alternatives.get(name)
    worse = best.chi2 + 2 * (found.ambiguity[name] - 1)
    second = None if other is None else replace(best, world_from_camera=other, chi2=worse)
    return Estimate("marker", Sightings(world_m, px, ids, len(marks)), best, second, found.ambiguity[name])


def check_sizes(photographs: dict[str, Raster], cameras: dict[str, Camera]) -> None:
    """Every view exists and has the size that its camera was calibrated at."""
    for name, camera in cameras.items():
        if name not in photographs:
            raise CaptureError(
                f"{name}: no photograph was developed, needed one per view; check its files in the manifest"
            )
        height, width = photographs[name].shape
        if (width, height) != (camera.width, camera.height):
            raise CaptureError(
                f"{name}: photograph is {width}x{height}, camera is {camera.width}x{camera.height}, needed equal "
                "sizes; calibrate with photographs of the sensor's full size"
            )


def sight(facts: dict[str, Any], name: str, order: dict[str, Any], photograph: Raster, camera: Camera) -> Sightings:
    """Corners of the board, or the four corners of the marker, in one view."""
    try:
        return board_doubts.sighted(facts, order["route"], grey(photograph.rgb()), camera)
    except CaptureError as error:
        raise CaptureError(f"{name}: {error}") from error


def estimate_view(
    name: str, order: dict[str, Any], seen: Sightings | None, camera: Camera, params: knobs.Pose
) -> Estimate | View:
    """Pose of a view by its own route. Raises CaptureError or NumericalError naming the view."""
    route = order["route"]
    if route == "given":
        return given_view(name, order)
    try:
        if route == "points":
            return points_estimate(order, camera, params)
        assert seen is not None
        needed = 4 if route == "marker" else FEWEST_CORNERS
        if len(seen.px) < needed:
            raise CaptureError(
                f"{len(seen.px)} corners of the {'marker' if route == 'marker' else 'board'} found ({seen.markers} "
                f"markers read), needed {needed}; {seen.note or 'check dictionary, id and legacy in the manifest'}, or "
                "photograph it unobstructed, sharp and larger in the frame, or orient the view by a [[pose]] entry"
            )
        best, second, ambiguity = resect_plane(camera, seen.world_m, seen.px, params.corner_sigma_px)
        estimate = Estimate(route, seen, best, second, ambiguity)
    except (CaptureError, NumericalError) as error:
        raise type(error)(f"{name}: {error}") from error
    return estimate


def given_view(name: str, order: dict[str, Any]) -> View:
    """The manifest's matrix as a view; it carries no covariance."""
    matrix = rigid(np.asarray(order.get("world_from_camera"), float), f"pose: view {name}")
    return View(world_from_camera=matrix, covariance=np.zeros((6, 6)), route="given", rms_px=0.0, points=0)


def points_estimate(order: dict[str, Any], camera: Camera, params: knobs.Pose) -> Estimate:
    """Pose from surveyed points; coplanar points get the two-pose test."""
    points = order["points"]
    world_m = np.array([point["world_m"] for point in points], float).reshape(-1, 3)
    px = np.array([point["px"] for point in points], float).reshape(-1, 2)
    stated = [point.get("sigma_px") for point in points]
    sigma_px = np.array([params.corner_sigma_px if one is None else one for one in stated], float)
    sigma_m = np.array([point.get("sigma_m") or 0.0 for point in points], float)
    found = resect_points(camera, world_m, px, sigma_px, sigma_m)
    seen = Sightings(world_m[found.agrees], px[found.agrees], np.flatnonzero(found.agrees), 0)
    return Estimate("points", seen, found.best, found.second, found.ambiguity)


def by_ball(
    facts: dict[str, Any], name: str, estimate: Estimate, photographs: dict[str, Raster], cameras: dict[str, Camera],
    params: knobs.Pose,
) -> Estimate:  # fmt: skip
    """An ambiguous estimate decided by a ball that stands on the plane of one pose only; else as it was."""
    probe = facts.get("probe") or {}
    radius = 0.5 * (probe.get("diameter_m") or 0.0)
    if estimate.second is None or estimate.ambiguity >= params.min_ambiguity or not radius:
        return estimate
    tripod = [ball["name"] for ball in facts["ball"] if ball.get("tripod")]
    shown = name if name != "plate" else next(iter(tripod), None)
    if shown is None or probe.get("kind", "mirror_ball") != "mirror_ball":
        return estimate
    plate = photographs["plate"] if shown in tripod else None
    ways = [estimate.best, estimate.second]
    poses = [view_of(replace(estimate, best=way)) for way in ways]
    stands = standing_chi2(shown, photographs[shown], plate, cameras[shown], poses, radius)
    if stands is None or stands.min() > STANDS_CHI2:
        return estimate
    total = np.array([way.chi2 for way in ways]) + stands
    first, other = np.argsort(total)
    freedom = max(2 * int(estimate.best.kept.sum()) - 5, 1)
    ratio = float(total[other] / max(total[first], freedom))
    if ratio < params.min_ambiguity:
        return estimate
    return replace(estimate, best=ways[first], second=ways[other], ambiguity=ratio, decided="ball")


def refuse_named(name: str, estimate: Estimate, params: knobs.Pose) -> None:
    """`refuse_ambiguous`, naming the view."""
    try:
        refuse_ambiguous(estimate, params)
    except NumericalError as error:
        raise NumericalError(f"{name}: {error}") from error


def refuse_ambiguous(estimate: Estimate, params: knobs.Pose) -> None:
    """Raise NumericalError naming both poses when the second explains the picture nearly as well."""
    if estimate.second is None or estimate.ambiguity >= params.min_ambiguity:
        return

    def spell(pose: np.ndarray) -> str:
        eye, axis = (", ".join(f"{value:.4g}" for value in vector) for vector in (pose[:3, 3], pose[:3, 2]))
        return f"camera at ({eye}) m looking along ({axis})"

    raise NumericalError(
        f"two poses explain the {estimate.route} picture (chi2 ratio {estimate.ambiguity:.2f}, needed "
        f"{params.min_ambiguity:g}): {spell(estimate.best.world_from_camera)}, or "
        f"{spell(estimate.second.world_from_camera)}; photograph the marker larger and tilted by 30 deg or more, "
        "lay a second one beside it in two views ([[marker]]), or give the right one as [[pose]] route 'given'"
    )


def view_of(estimate: Estimate) -> View:
    """The record of an estimate."""
    best = estimate.best
    return View(
        world_from_camera=best.world_from_camera, covariance=best.covariance, route=estimate.route, rms_px=best.rms_px,
        points=int(best.kept.sum()), ambiguity=estimate.ambiguity, lens_covariance=best.lens_covariance,
        alternative=None if estimate.second is None else estimate.second.world_from_camera,
    )  # fmt: skip


def settle_tripod(
    names: list[str],
    sights: dict[str, Sightings],
    estimates: dict[str, Estimate],
    views: dict[str, View],
    camera: Camera,
    params: knobs.Pose,
    warnings: list[str],
) -> dict[str, float]:
    """Give tripod views the plate's pose where their own corners agree with it; returns the shifts seen, px."""
    plate, shifts, pool = estimates.get("plate"), {}, []
    for name in names:
        seen = sights.get(name)
        if plate is None or plate.route == "points" or seen is None:
            continue
        if len(seen.px) < (4 if plate.route == "marker" else FEWEST_CORNERS):
            continue
        own = refine(camera, plate.best.world_from_camera, seen.world_m, seen.px, params.corner_sigma_px)
        apart = difference(own.world_from_camera, plate.best.world_from_camera)
        chi2 = float(apart @ np.linalg.solve(own.noise_covariance + plate.best.noise_covariance, apart))
        shift = [project(camera, camera_points(pose, seen.world_m)[0]) for pose in
                 (own.world_from_camera, plate.best.world_from_camera)]  # fmt: skip
        shifts[name] = float(np.sqrt(((shift[0] - shift[1]) ** 2).sum(-1).mean()))
        if chi2 <= MOVED_CHI2:
            pool.append(Sightings(seen.world_m[own.kept], seen.px[own.kept], seen.ids[own.kept], seen.markers))
            continue
        warnings.append(moved_by(name, "board", shifts[name], chi2))
        estimates[name] = Estimate(plate.route, seen, own, None, np.inf)
        views[name] = view_of(estimates[name])
    if plate is not None and pool:
        seen = averaged([plate.seen, *pool])
        if plate.decided:  # the corners alone may prefer the other pose
            own = refine(camera, plate.best.world_from_camera, seen.world_m, seen.px, params.corner_sigma_px)
            estimates["plate"] = replace(plate, seen=seen, best=own)
        else:
            found = resect_plane(camera, seen.world_m, seen.px, params.corner_sigma_px)
            estimates["plate"] = Estimate(plate.route, seen, *found)
        views["plate"] = view_of(estimates["plate"])
    for name in names:
        if name not in views:
            views[name] = views["plate"].model_copy(update={"route": "same_as"})
    return shifts


def moved_by(name: str, what: str, shift_px: float, chi2: float) -> str:
    """The warning that a tripod view is not where the plate was taken."""
    return (
        f"{name}: the tripod moved: {what} shifted by {shift_px:.2f} px (chi2 {chi2:.0f}, expected below "
        f"{MOVED_CHI2:.0f}); its own pose is used"
    )


def figures(
    name: str, view: View, estimate: Estimate | None, seen: Sightings | None, warnings: list[str]
) -> dict[str, Any]:
    """Measured numbers of one view; warns about wide poses and large residuals."""
    sigma = np.sqrt(np.diag(view.covariance))
    rotation_deg = float(np.degrees(np.linalg.norm(sigma[:3])))
    numbers: dict[str, Any] = {
        "route": view.route, "points": view.points, "rms_px": view.rms_px, "rotation_sigma_deg": rotation_deg,
        "position_sigma_m": float(np.linalg.norm(sigma[3:])),
        "ambiguity": None if np.isinf(view.ambiguity) else view.ambiguity,
        "tilt_deg": float(np.degrees(np.arccos(min(1.0, abs(view.world_from_camera[1, 2]))))),
    }  # fmt: skip
    if seen is not None:
        numbers["markers"] = seen.markers
    if estimate is not None:
        distance = float(np.linalg.norm(estimate.seen.world_m.mean(0) - view.world_from_camera[:3, 3]))
        numbers |= {
            "distance_m": distance, "corner_sigma_px": estimate.best.sigma_px,
            "outliers": int((~estimate.best.kept).sum()), "position_sigma_rel": numbers["position_sigma_m"] / distance,
        }  # fmt: skip
    if estimate is not None and estimate.decided:
        numbers["decided_by"] = estimate.decided
    if estimate is not None and estimate.best.frontal:
        warnings.append(
            f"{name}: the {view.route} is seen so squarely that its tilt is hardly known ({rotation_deg:.2f} deg); "
            "tilt it by 30 deg against the camera"
        )
    if rotation_deg > WIDE_ROTATION_DEG:
        warnings.append(
            f"{name}: rotation is known to {rotation_deg:.1f} deg only; show the marker larger or more tilted"
        )
    far_m = float(np.linalg.norm(view.world_from_camera[:3, 3]))
    if far_m > FAR_M:
        warnings.append(
            f"{name}: the camera is {far_m:.3g} m from the origin, needed below {FAR_M:g} to render to "
            "a millimetre; take a common offset off all world_m"
        )
    if view.rms_px > LARGE_RMS_PX:
        warnings.append(f"{name}: residual {view.rms_px:.2f} px; is the print flat, and its size and the lens right?")
    return numbers


def reasons(orders: dict[str, dict[str, Any]], views: dict[str, View], cameras: list[Camera]) -> list[dict[str, Any]]:
    """Which pose source each view took, and why."""
    why = {
        "charuco": "the board is described", "marker": "markers are described", "points": "asked for",
        "given": "asked for", "same_as": "same tripod position as the plate", "colmap": "asked for",
    }  # fmt: skip
    entries = [
        {
            "term": f"pose of {name}: {view.route}", "modelled": True,
            "because": "asked for" if orders[name]["explicit"] else why[view.route], "could_cost": "",
        }
        for name, view in views.items()
    ]  # fmt: skip
    known = all(np.any(camera.covariance) for camera in cameras)
    because = "calibrated" if known else "a camera was given without covariance"
    cost = "" if known else "pose covariances are too small by the unknown error of the intrinsics"
    return [
        *entries,
        {"term": "intrinsics in the pose covariance", "modelled": known, "because": because, "could_cost": cost},
    ]


STAGE = Stage(
    "pose",
    compute,
    knobs.Pose,
    {
        "facts": FACTS, "photographs": PHOTOGRAPHS, "camera": CAMERA, "view_cameras": VIEW_CAMERAS,
        "reconstruction": RECONSTRUCTION, "view_photos": VIEW_PHOTOS,
    },
    {"views": VIEWS, "cloud": CLOUD},
)  # fmt: skip
