"""One view's pose as estimated: what was seen, the best pose, the second that a plane allows, and what decided.

Every route of `stages/pose.py` ends in an `Estimate`, or in a `View` where nothing was measured. Here is what is common
to the routes: the refusal of an ambiguous one, the record, and tripod views that share the plate's pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.camera.marker_map import MarkerMap
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.resection import Resection, refine, resect_plane
from pipeline.camera.rigid import camera_points, difference
from pipeline.camera.sfm import Seen
from pipeline.camera.sights import FEWEST_CORNERS, averaged
from pipeline.camera.stated import rigid
from pipeline.camera.survey import resect_points
from pipeline.run.errors import NumericalError
from pipeline.types import Camera, View

MOVED_CHI2 = 22.46  # 99.9 % of chi2 with six degrees of freedom


@dataclass(frozen=True)
class Estimate:
    """What was seen in one view and the pose it gave."""

    route: str
    seen: Sightings
    best: Resection
    second: Resection | None
    ambiguity: float
    decided: str = ""  # what told the two poses apart, beside the corners


def map_estimate(found: MarkerMap, name: str, marks: list[Seen], camera: Camera, corner_sigma_px: float) -> Estimate:
    """One view of the map as an estimate."""
    world_m, px, ids = found.world_points(marks)
    pose = found.done.bundle.poses[found.names.index(name)]
    covariance, by_lens = found.covariance(name, camera)
    residuals = px - project(camera, camera_points(pose, world_m)[0])
    best = Resection(
        pose, covariance, found.done.pose_covariance[found.names.index(name)], by_lens, residuals,
        np.ones(len(px), bool), found.done.corner_sigma_px, float((residuals**2).sum()) / corner_sigma_px**2,
        name in found.lone and found.lone[name].frontal,
    )  # fmt: skip
    other = found.alternatives.get(name)
    worse = best.chi2 + 2 * (found.ambiguity[name] - 1)
    second = None if other is None else replace(best, world_from_camera=other, chi2=worse)
    return Estimate("marker", Sightings(world_m, px, ids, len(marks)), best, second, found.ambiguity[name])


def given_view(name: str, order: dict[str, Any]) -> View:
    """The manifest's matrix as a view; it carries no covariance."""
    matrix = rigid(np.asarray(order.get("world_from_camera"), float), f"pose: view {name}")
    return View(world_from_camera=matrix, covariance=np.zeros((6, 6)), route="given", rms_px=0.0, points=0)


def points_estimate(order: dict[str, Any], camera: Camera, corner_sigma_px: float) -> Estimate:
    """Pose from surveyed points; coplanar points get the two-pose test."""
    points = order["points"]
    world_m = np.array([point["world_m"] for point in points], float).reshape(-1, 3)
    px = np.array([point["px"] for point in points], float).reshape(-1, 2)
    stated = [point.get("sigma_px") for point in points]
    sigma_px = np.array([corner_sigma_px if one is None else one for one in stated], float)
    sigma_m = np.array([point.get("sigma_m") or 0.0 for point in points], float)
    found = resect_points(camera, world_m, px, sigma_px, sigma_m)
    seen = Sightings(world_m[found.agrees], px[found.agrees], np.flatnonzero(found.agrees), 0)
    return Estimate("points", seen, found.best, found.second, found.ambiguity)


def refuse_named(name: str, estimate: Estimate, min_ambiguity: float) -> None:
    """`refuse_ambiguous`, naming the view."""
    try:
        refuse_ambiguous(estimate, min_ambiguity)
    except NumericalError as error:
        raise NumericalError(f"{name}: {error}") from error


def refuse_ambiguous(estimate: Estimate, min_ambiguity: float) -> None:
    """Raise NumericalError naming both poses when the second explains the picture nearly as well."""
    if estimate.second is None or estimate.ambiguity >= min_ambiguity:
        return

    def spell(pose: np.ndarray) -> str:
        eye, axis = (", ".join(f"{value:.4g}" for value in vector) for vector in (pose[:3, 3], pose[:3, 2]))
        return f"camera at ({eye}) m looking along ({axis})"

    raise NumericalError(
        f"two poses explain the {estimate.route} picture (chi2 ratio {estimate.ambiguity:.2f}, needed "
        f"{min_ambiguity:g}): {spell(estimate.best.world_from_camera)}, or "
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
    corner_sigma_px: float,
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
        own = refine(
            camera, plate.best.world_from_camera, seen.world_m, seen.px, corner_sigma_px, sharp=plate.route == "charuco"
        )
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
        seen, sharp = averaged([plate.seen, *pool]), plate.route == "charuco"
        if plate.decided:  # the corners alone may prefer the other pose
            own = refine(camera, plate.best.world_from_camera, seen.world_m, seen.px, corner_sigma_px, sharp=sharp)
            estimates["plate"] = replace(plate, seen=seen, best=own)
        else:
            found = resect_plane(camera, seen.world_m, seen.px, corner_sigma_px, sharp)
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
