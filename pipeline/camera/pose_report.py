"""What is said of the poses: measured numbers of each view, warnings, and which source each took."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.estimates import Estimate
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.softness import Softness, of_lens
from pipeline.types import Camera, View

WIDE_ROTATION_DEG = 1.0
LARGE_RMS_PX = 0.5
FAR_M = 1e4  # from the origin: there single precision, which renders, has steps of a millimetre


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
        "given": "asked for", "same_as": "same tripod position as the plate",
        "colmap": "board and markers do not show, or leave it less certain than sources.contact_px",
        "tripod": "shows no board; a view from the same tripod does, and both pictures say how the camera turned",
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
        {
            "term": "intrinsics in the pose covariance",
            "modelled": known,
            "because": because,
            "could_cost": cost,
            **({} if known else {"no_bound": "nobody says how sure the given camera is"}),
        },
    ]


def softness_reason(plate: Softness | None, method: str | None, elsewhere: list[str]) -> dict[str, Any]:
    """Whether the plate's softness was measured; ``elsewhere``: tripod views that tell one where the plate does not.

    ``method``: of the plate's demosaicking.
    """
    row: dict[str, Any] = {"term": "softness of the plate", "modelled": plate is not None, "could_cost": ""}
    if plate is not None:
        lens = of_lens(plate, method)
        said = f"lens and pixel {lens.px:.3f} +- {lens.sigma_px:.3f} px (one sigma)"
        after = f"{plate.edges} edges of the print are {plate.px:.3f} px soft"
        return {**row, "because": f"{said}; {after}{f' after {method} demosaicking' if method else ''}"}
    if elsewhere:
        said = f"the plate shows too few edges of a print; {elsewhere[0]} does"
        return {**row, "modelled": True, "because": said}
    return {
        **row, "because": "no view from the tripod shows enough edges of a board or marker",
        "could_cost": "borders of objects and shadows that are softer or sharper than the plate's",
        "no_bound": "nothing says how soft the plate is: the render takes what is usual, and its spread as its sigma",
    }  # fmt: skip
