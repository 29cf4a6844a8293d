"""Where every view was taken from: board, marker, points, given or further views, each with a 6x6 covariance.

Method: corners are measured in the photograph itself and the pose minimises their reprojection error through the lens
(Levenberg-Marquardt, Huber search, then least squares without outliers). Both poses that a plane allows (IPPE, Collins
and Bartoli 2014) are refined; when the second is nearly as good the view is refused with both. Surveyed points go
through LO-RANSAC (COLMAP). Views that show no marker are oriented by what they share with further photographs: tracks
of the cloud and markers seen in any of them are adjusted together (`pipeline/camera/bundle.py`). Covariance: inverse
normal matrix times the larger of the stated corner variance and chi2 per degree of freedom, plus the camera's
covariance carried through; corners are taken as independent. Views from one tripod position are tested for having
stayed (chi2 of the difference) and then share one pose, estimated from their averaged corners. Limits: a flat board of
the stated size; a wrong size scales the world unnoticed.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.camera.markers import fit_marker, grey, marker_points, tone
from pipeline.camera.opencv_bridge import Sightings, board_sightings, marker_cells, marker_corners_px, read_grey
from pipeline.camera.resection import Resection, is_planar, refine, resect_plane
from pipeline.camera.rigid import camera_points, difference, nearest_rotation
from pipeline.camera.sfm import Seen, oriented, scale_sigma, scaled_covariance
from pipeline.image.colour import decode_srgb
from pipeline.run.artifacts import (
    CAMERA,
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

FEWEST_CORNERS = 6
ENOUGH_OF_BOARD = 0.7  # with fewer corners than this fraction the other tone curve is tried too
MOVED_CHI2 = 22.46  # 99.9 % of chi2 with six degrees of freedom
WIDE_ROTATION_DEG = 1.0
LARGE_RMS_PX = 0.5


@dataclass(frozen=True)
class Estimate:
    """What was seen in one view and the pose it gave."""

    route: str
    seen: Sightings
    best: Resection
    second: Resection | None
    ambiguity: float


def compute(
    facts: dict[str, Any], photographs: dict[str, Raster], camera: Camera, view_cameras: dict[str, Camera],
    reconstruction: Reconstruction, view_photos: list[Frame], params: knobs.Pose,
) -> Result:  # fmt: skip
    """``world_from_camera`` of "plate" and of every ball, and the camera of each that is not the plate's."""
    balls = {ball["name"]: bool(ball.get("tripod", False)) for ball in facts["ball"]}
    orders = {name: order_of(facts, name, balls) for name in ("plate", *balls)}
    cameras = {name: view_cameras.get(name, camera) for name in orders}
    check_sizes(photographs, cameras)
    looked = [name for name, order in orders.items() if order["route"] in ("charuco", "marker")]
    with ThreadPoolExecutor(2) as pool:  # OpenCV releases the GIL
        sights = dict(
            zip(looked, pool.map(lambda n: sight(facts, n, orders[n], photographs[n], cameras[n]), looked), strict=True)
        )
    warnings: list[str] = []
    estimates: dict[str, Estimate] = {}
    views: dict[str, View] = {}
    tripod = [name for name, stays in balls.items() if stays and not orders[name]["explicit"]]
    asked = [name for name, order in orders.items() if order["route"] == "colmap"]
    extra: dict[str, Any] = {}
    if asked:
        placed, extra = by_views(facts, asked, tripod, photographs, camera, reconstruction, view_photos, warnings)
        views |= placed
    for name in orders:
        if name not in tripod and name not in views:
            estimate = estimate_view(name, orders[name], sights.get(name), cameras[name], params)
            views[name] = view_of(estimate) if isinstance(estimate, Estimate) else estimate
            if isinstance(estimate, Estimate):
                estimates[name] = estimate
    shifts = settle_tripod(tripod, sights, estimates, views, camera, params, warnings)
    numbers = {
        name: figures(name, view, estimates.get(name), sights.get(name), warnings) for name, view in views.items()
    }
    for name, shift in shifts.items():
        numbers[name]["tripod_shift_px"] = shift
    if extra:
        numbers["sfm"] = extra
    result = {name: views[name].model_copy(update={"camera": view_cameras.get(name)}) for name in orders}
    return Result({"views": result}, numbers, warnings, reasons(orders, views, list(cameras.values())))


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
) -> tuple[dict[str, View], dict[str, Any]]:  # fmt: skip
    """Poses of the views that asked for it from all photographs together, and the numbers of that adjustment."""
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
        if name in files:
            encoded = np.asarray(read_grey(root / name), np.float32) / 255
            linear = np.asarray(decode_srgb(encoded), np.float32)
        else:
            linear = grey(photographs[name].rgb())
        seen[name] = marks_in(facts, linear, lens)
    done, markers = oriented(reconstruction, cameras, seen, None)
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
    return views, numbers


def marks_in(facts: dict[str, Any], linear: np.ndarray, camera: Camera) -> list[Seen]:
    """The board, or the markers, seen in one photograph; those that cannot be measured are left out."""
    pictures = [(tone(linear, curve) * 255 + 0.5).astype(np.uint8) for curve in ("gamma", "log")]
    if facts.get("board"):
        sights = board_sightings(pictures[0], tone(linear), facts["board"], camera)
        return [Seen(0, sights.world_m, sights.px)] if len(sights.px) >= FEWEST_CORNERS else []
    found = []
    for number, marker in enumerate(facts["marker"]):
        tries = (marker_corners_px(picture, marker["dictionary"], marker["id"])[0] for picture in pictures)
        quads = next((quads for quads in tries if len(quads)), np.empty((0, 4, 2)))
        if len(quads) != 1:
            continue
        try:
            px = fit_marker(linear, quads[0], camera, marker_cells(marker["dictionary"]))
        except CaptureError:
            continue
        found.append(Seen(number, marker_points(marker["side_m"]), px))
    return found


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
    radiance = grey(photograph.rgb())
    if order["route"] == "charuco":
        board = facts["board"]
        total = (board["squares"][0] - 1) * (board["squares"][1] - 1)
        tries = []
        for curve in ("gamma", "log"):
            toned = tone(radiance, curve)
            tries.append(board_sightings((toned * 255 + 0.5).astype(np.uint8), toned, board, camera))
            if len(tries[-1].px) >= ENOUGH_OF_BOARD * total:
                break
        return max(tries, key=lambda seen: len(seen.px))
    marker = facts["marker"][0]
    for curve in ("gamma", "log"):
        picture = (tone(radiance, curve) * 255 + 0.5).astype(np.uint8)
        quads, markers = marker_corners_px(picture, marker["dictionary"], marker["id"])
        if len(quads):
            break
    if len(quads) > 1:
        raise CaptureError(
            f"{name}: marker {marker['id']} is seen {len(quads)} times, needed once; cover the copies or use another id"
        )
    if not len(quads):
        return Sightings(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, int), markers)
    try:
        px = fit_marker(radiance, quads[0], camera, marker_cells(marker["dictionary"]))
    except CaptureError as error:
        raise CaptureError(f"{name}: {error}") from error
    return Sightings(marker_points(marker["side_m"]), px, np.arange(4), markers)


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
                f"markers read), needed {needed}; check dictionary, id and legacy in the manifest, or photograph it "
                "unobstructed, sharp and larger in the frame, or orient the view by a [[pose]] entry"
            )
        best, second, ambiguity = resect_plane(camera, seen.world_m, seen.px, params.corner_sigma_px)
        estimate = Estimate(route, seen, best, second, ambiguity)
        refuse_ambiguous(estimate, params)
    except (CaptureError, NumericalError) as error:
        raise type(error)(f"{name}: {error}") from error
    return estimate


def given_view(name: str, order: dict[str, Any]) -> View:
    """The manifest's matrix as a view; it carries no covariance."""
    matrix = np.asarray(order.get("world_from_camera"), float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ManifestError(
            f"pose: view {name}: world_from_camera is not a 4x4 matrix; it is required by route 'given'"
        )
    rotation = nearest_rotation(matrix[:3, :3])
    error = float(np.abs(matrix[:3, :3] - rotation).max())
    if error > 1e-3 or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ManifestError(
            f"pose: view {name}: world_from_camera is off a rigid motion by {error:.3g}; expected a rotation (no "
            "scale, no mirror) and a last row 0 0 0 1"
        )
    rigid = matrix.copy()
    rigid[:3, :3] = rotation
    return View(world_from_camera=rigid, covariance=np.zeros((6, 6)), route="given", rms_px=0.0, points=0)


def points_estimate(order: dict[str, Any], camera: Camera, params: knobs.Pose) -> Estimate:
    """Pose from surveyed points: LO-RANSAC, then our own least squares; coplanar points get the two-pose test."""
    from pipeline.camera.colmap_bridge import pose_of_points

    world_m = np.array([point["world_m"] for point in order["points"]], float).reshape(-1, 3)
    px = np.array([point["px"] for point in order["points"]], float).reshape(-1, 2)
    is_planar(world_m)  # refuses fewer than four points and points on a line
    threshold = max(4.0, 20 * params.corner_sigma_px)
    start = pose_of_points(camera, world_m, px, threshold)
    distance = np.hypot(*(project(camera, camera_points(start, world_m)[0]) - px).T)
    agrees = np.where(np.isfinite(distance), distance, np.inf) <= threshold
    seen = Sightings(world_m[agrees], px[agrees], np.flatnonzero(agrees), 0)
    if is_planar(seen.world_m):
        estimate = Estimate("points", seen, *resect_plane(camera, seen.world_m, seen.px, params.corner_sigma_px))
        refuse_ambiguous(estimate, params)
        return estimate
    return Estimate("points", seen, refine(camera, start, seen.world_m, seen.px, params.corner_sigma_px), None, np.inf)


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
        f"{spell(estimate.second.world_from_camera)}; photograph the marker larger and tilted by 30 deg or more, or "
        "give the right one as [[pose]] route 'given'"
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
        warnings.append(
            f"{name}: the tripod moved: board shifted by {shifts[name]:.2f} px (chi2 {chi2:.0f}, expected below "
            f"{MOVED_CHI2:.0f}); its own pose is used"
        )
        estimates[name] = Estimate(plate.route, seen, own, None, np.inf)
        views[name] = view_of(estimates[name])
    if plate is not None and pool:
        seen = averaged([plate.seen, *pool])
        estimates["plate"] = Estimate(
            plate.route, seen, *resect_plane(camera, seen.world_m, seen.px, params.corner_sigma_px)
        )
        views["plate"] = view_of(estimates["plate"])
    for name in names:
        if name not in views:
            views[name] = views["plate"].model_copy(update={"route": "same_as"})
    return shifts


def averaged(sightings: list[Sightings]) -> Sightings:
    """Corners by id, the mean over the views that saw them: their scatter stays in the residuals, not counted twice."""
    ids, where = np.unique(np.concatenate([seen.ids for seen in sightings]), return_inverse=True)
    count = np.bincount(where)[:, None]
    world_m, px = np.zeros((len(ids), 3)), np.zeros((len(ids), 2))
    np.add.at(world_m, where, np.concatenate([seen.world_m for seen in sightings]))
    np.add.at(px, where, np.concatenate([seen.px for seen in sightings]))
    return Sightings(world_m / count, px / count, ids, sightings[0].markers)


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
    if estimate is not None and estimate.best.frontal:
        warnings.append(
            f"{name}: the {view.route} is seen so squarely that its tilt is hardly known ({rotation_deg:.2f} deg); "
            "tilt it by 30 deg against the camera"
        )
    if rotation_deg > WIDE_ROTATION_DEG:
        warnings.append(
            f"{name}: rotation is known to {rotation_deg:.1f} deg only; show the marker larger or more tilted"
        )
    if view.rms_px > LARGE_RMS_PX:
        warnings.append(f"{name}: residual {view.rms_px:.2f} px; is the print flat, and its size and the lens right?")
    return numbers


def reasons(orders: dict[str, dict[str, Any]], views: dict[str, View], cameras: list[Camera]) -> list[dict[str, Any]]:
    """Which pose source each view took, and why."""
    why = {
        "charuco": "the board is described", "marker": "the single marker is described", "points": "asked for",
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
        "facts": FACTS,
        "photographs": PHOTOGRAPHS,
        "camera": CAMERA,
        "view_cameras": VIEW_CAMERAS,
        "reconstruction": RECONSTRUCTION,
        "view_photos": VIEW_PHOTOS,
    },
    {"views": VIEWS},
)
