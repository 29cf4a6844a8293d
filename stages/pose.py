"""Where every view was taken from: board, marker, points, given or further views, each with a 6x6 covariance.

Method: corners are measured in the photograph itself and the pose minimises their reprojection error through the lens
(Levenberg-Marquardt, Huber search, then least squares without outliers). Both poses that a plane allows (IPPE, Collins
and Bartoli 2014) are refined; when the second is nearly as good, a further marker decides, else a mirror ball of known
diameter that stands on the plane of one, else the view is refused with both. Several markers are mapped from all views
(`pipeline/camera/marker_map.py`). Surveyed points start by LO-RANSAC (COLMAP) and count by their own uncertainty. Views
that show no marker are oriented by what they share with further photographs: tracks of the cloud and markers seen in
any of them are adjusted together (`pipeline/camera/bundle.py`). Covariance: inverse normal matrix times the variance of
a corner, plus the camera's covariance carried through; corners are taken as independent. That variance is what the
residuals of 13 corners of a board tell, elsewhere the larger of the stated one and chi2 per degree of freedom. Views
from one tripod position are tested for having stayed (chi2 of the difference) and then share one pose, estimated from
their averaged corners. A plate without the board gets its pose from a tripod view that shows it and from how far both
pictures say that the camera turned. Limits: a flat board of the stated size; a wrong size scales the world unnoticed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera import board_doubts
from pipeline.camera.board_pictures import linear_of
from pipeline.camera.cloud_views import views_of_cloud
from pipeline.camera.estimates import (
    MOVED_CHI2,
    Estimate,
    given_view,
    map_estimate,
    moved_by,
    points_estimate,
    refuse_named,
    settle_tripod,
    view_of,
)
from pipeline.camera.map_report import report
from pipeline.camera.marker_map import with_tripod
from pipeline.camera.markers import grey
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.pose_report import figures, reasons, softness_reason
from pipeline.camera.resection import resect_plane
from pipeline.camera.sfm import Seen
from pipeline.camera.sights import FEWEST_CORNERS, marks_in
from pipeline.camera.softness import of_lens, softness
from pipeline.camera.tripod_registration import lender, registered, turned
from pipeline.image.demosaic import METHOD
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

STANDS_CHI2 = 10.8  # and with one: a ball higher or lower than this does not stand on the plane


def compute(
    facts: dict[str, Any], photographs: dict[str, Raster], camera: Camera, view_cameras: dict[str, Camera],
    reconstruction: Reconstruction, view_photos: list[Frame], params: knobs.Pose,
) -> Result:  # fmt: skip
    """``world_from_camera`` of "plate" and of every ball, and the camera of each that is not the plate's."""
    balls = {ball["name"]: bool(ball.get("tripod", False)) for ball in facts["ball"]}
    by_cloud = [name for name in reconstruction.orients if name in reconstruction.names]
    orders = {name: order_of(facts, name, balls, by_cloud) for name in ("plate", *balls)}
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
        try:
            found = by_views(facts, asked, tripod, photographs, camera, reconstruction, view_photos, warnings)
        except (CaptureError, NumericalError) as error:
            if any(orders[name]["explicit"] for name in asked):
                raise
            without = reconstruction.model_copy(update={"orients": []})
            said = f"pose: further views cannot orient {', '.join(asked)} ({error})"
            try:
                whole = compute(facts, photographs, camera, view_cameras, without, view_photos, params)
            except (CaptureError, NumericalError) as alone:
                raise type(alone)(f"{said}, nor can boards and markers alone: {alone}") from error
            return replace(whole, warnings=[f"{said}; boards and markers alone did", *whole.warnings])
        views, extra, cloud = views | found[0], found[1], found[2]
    places: dict[str, Any] = {}
    if mapped:
        by_marker = by_map(facts, mapped, tripod, photographs, cameras, view_photos, params, warnings)
        views, estimates, places = views | by_marker[0], by_marker[1], by_marker[2]
    bare: dict[str, Any] = {}
    shows = lender(sights, tripod, 4 if orders["plate"]["route"] == "marker" else FEWEST_CORNERS)
    if shows and not orders["plate"]["explicit"]:
        estimate = estimate_view(shows, orders[shows], sights[shows], camera, params)
        assert isinstance(estimate, Estimate)
        estimate = by_ball(facts, shows, estimate, photographs, cameras, params)
        refuse_named(shows, estimate, params.min_ambiguity)
        estimates[shows], views[shows] = estimate, view_of(estimate)
        views["plate"], bare = bare_plate(shows, views[shows], photographs, camera)
    for name in orders:
        if name not in tripod and name not in views:
            estimate = estimate_view(name, orders[name], sights.get(name), cameras[name], params)
            if isinstance(estimate, Estimate):
                estimate = by_ball(facts, name, estimate, photographs, cameras, params)
                refuse_named(name, estimate, params.min_ambiguity)
                estimates[name] = estimate
            views[name] = view_of(estimate) if isinstance(estimate, Estimate) else estimate
    shifts = settle_tripod(tripod, sights, estimates, views, camera, params.corner_sigma_px, warnings)
    shifts |= places.pop("tripod_shift_px", {})
    turns = without_marks([name for name in tripod if name not in shifts], views, photographs, camera, warnings)
    numbers = {
        name: figures(name, view, estimates.get(name), sights.get(name), warnings) for name, view in views.items()
    }
    warnings += board_doubts.of_prints(facts, views, sights, grey(photographs["plate"].rgb()), cameras["plate"])
    for name, shift in shifts.items():
        numbers[name]["tripod_shift_px"] = shift
    for name, turn in turns.items():
        numbers[name]["registration"] = turn
    numbers["plate"] |= bare
    numbers |= {key: part for key, part in (("sfm", extra), ("marker_map", places)) if part}
    soft = {n: softness(photographs[n], cameras[n], views[n].world_from_camera, facts) for n in orders}
    result = {name: views[name].model_copy(update={"camera": view_cameras.get(name)}) for name in orders}
    for name, edges in soft.items():
        if edges is not None:
            lens = of_lens(edges, photographs[name].attributes.get(METHOD))
            numbers[name]["softness"] = asdict(edges) | {"lens_px": lens.px, "lens_sigma_px": lens.sigma_px}
            update = {"softness_px": lens.px, "softness_sigma_px": lens.sigma_px}
            result[name] = result[name].model_copy(update=update)
    why = reasons(orders, views, list(cameras.values()))
    method = photographs["plate"].attributes.get(METHOD)
    why.append(softness_reason(soft["plate"], method, [name for name in tripod if soft[name]]))
    return Result({"views": result, "cloud": cloud}, numbers, warnings, why)


def bare_plate(shows: str, view: View, photographs: dict[str, Raster], camera: Camera) -> tuple[View, dict[str, Any]]:
    """The pose of a plate without a board by a tripod view that shows it, and the registration's figures.

    How far it moved where objects stand, stage plane says.
    """
    try:
        found = registered(grey(photographs["plate"].rgb()), grey(photographs[shows].rgb()), camera)
    except NumericalError as error:
        raise NumericalError(f"plate: shows no board, and beside {shows} {error}") from error
    return turned(view, found, shows), {"registered_to": shows, "registration": found.evidence}


def without_marks(
    names: list[str], views: dict[str, View], photographs: dict[str, Raster], camera: Camera, warnings: list[str]
) -> dict[str, Any]:
    """Tripod views in which no board says whether they stayed are compared with the plate; the turned are turned.

    Returns each one's registration, or why there is none: then it keeps the plate's pose, which nothing checked.
    """
    figures: dict[str, Any] = {}
    for name in names:
        if views[name].route != "same_as":
            continue
        try:
            found = registered(grey(photographs[name].rgb()), grey(photographs["plate"].rgb()), camera)
        except NumericalError as error:
            figures[name] = {"not_checked": str(error)}
            continue
        figures[name] = found.evidence
        if found.evidence["chi2"] > MOVED_CHI2:
            views[name] = turned(views["plate"], found)
            warnings.append(moved_by(name, "the picture", found.evidence["shift_px"], found.evidence["chi2"]))
    return figures


def order_of(facts: dict[str, Any], name: str, balls: dict[str, bool], by_cloud: list[str]) -> dict[str, Any]:
    """How a view is to be oriented: its [[pose]] entry, else by the cloud (``by_cloud``), the board or the marker."""
    for entry in facts.get("pose", []):
        if entry["view"] == name:
            if entry["route"] in ("charuco", "marker") and not facts.get(
                "board" if entry["route"] == "charuco" else "marker"
            ):
                raise ManifestError(
                    f"pose: view {name} asks for {entry['route']}, which the manifest does not describe"
                )
            return {**entry, "explicit": True}
    if name in by_cloud:
        return {"route": "colmap", "explicit": False}
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

    def linear(name: str) -> np.ndarray:
        return linear_of(root / name) if name in files else grey(photographs[name].rgb())

    for number, name in enumerate(reconstruction.names):
        seen[name] = marks_in(facts, linear(name), cameras[reconstruction.camera_of[number]])[0]
    if not any(one.marker == 0 for marks in seen.values() for one in marks):
        note = board_doubts.instead(facts, (linear(name) for name in reversed(reconstruction.names)))
        raise CaptureError(
            f"sfm: the {'board' if facts.get('board') else 'first marker'} is seen in none of the {len(seen)} oriented "
            "photographs, needed two from places that differ, to bring the cloud to metres; "
            f"{note or 'check its dictionary and id'}, or photograph it more often"
        )
    found, numbers, cloud, said = views_of_cloud(
        reconstruction, cameras, seen, asked, tripod, facts.get("marker") or []
    )
    warnings += said
    return found, numbers, cloud


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
        estimates[name] = map_estimate(found, name, seen[name], cameras[name], params.corner_sigma_px)
        if name in found.lone:
            estimates[name] = by_ball(facts, name, estimates[name], photographs, cameras, params)
        refuse_named(name, estimates[name], params.min_ambiguity)
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
            return points_estimate(order, camera, params.corner_sigma_px)
        assert seen is not None
        needed = 4 if route == "marker" else FEWEST_CORNERS
        if len(seen.px) < needed:
            raise CaptureError(
                f"{len(seen.px)} corners of the {'marker' if route == 'marker' else 'board'} found ({seen.markers} "
                f"markers read), needed {needed}; {seen.note or 'check dictionary, id and legacy in the manifest'}, or "
                "photograph it unobstructed, sharp and larger in the frame, or orient the view by a [[pose]] entry"
            )
        best, second, ambiguity = resect_plane(
            camera, seen.world_m, seen.px, params.corner_sigma_px, route == "charuco"
        )
        estimate = Estimate(route, seen, best, second, ambiguity)
    except (CaptureError, NumericalError) as error:
        raise type(error)(f"{name}: {error}") from error
    return estimate


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
