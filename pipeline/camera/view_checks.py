"""Whether photographs are what is needed: one lens for all by their metadata, places that differ, objects in view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.camera.rigid import camera_points
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Camera, Frame, Reconstruction, View

SAME_FOCAL = 0.02  # as metadata round it
FAR_OUTSIDE = 2.0  # frame diagonals beyond the frame, where not even a shadow returns
LEAST_PARALLAX_DEG = 1.0  # median over the points: below it their depth, and so the camera's way, is mostly noise


def lens_strangers(frames: Sequence[Frame], what: str) -> list[str]:
    """One line for every photograph by another lens or at another focal length than most, as far as metadata say."""
    found = []
    for name, of in (("lens", lambda f: f.lens), ("camera", lambda f: f.camera)):
        named = Counter(of(frame) for frame in frames if of(frame))
        if len(named) > 1:
            usual = named.most_common(1)[0][0]
            found += [
                f"{frame.file}: {name} {of(frame)!r}, the other {what} {usual!r}; needed one (a phone changes lenses "
                "by itself: lock it); take it out"
                for frame in frames if of(frame) and of(frame) != usual
            ]  # fmt: skip
    known = [frame for frame in frames if frame.focal_mm > 0]
    if known and not found:
        usual_mm = float(np.median([frame.focal_mm for frame in known]))
        near = min((frame.focal_mm for frame in known), key=lambda mm: abs(mm - usual_mm))
        found += [
            f"{frame.file}: focal length {frame.focal_mm:g} mm, the other {what} {near:g} mm; needed one; take it out"
            for frame in known if abs(frame.focal_mm / near - 1) > SAME_FOCAL
        ]  # fmt: skip
    return found


def zoom_differs(one: Sequence[Frame], other: Sequence[Frame]) -> tuple[float, float] | None:
    """Focal lengths [mm] of two sets of photographs where metadata say that they differ."""
    mm = [float(np.median([f.focal_mm for f in frames if f.focal_mm > 0] or [0.0])) for frames in (one, other)]
    return (mm[0], mm[1]) if min(mm) > 0 and abs(mm[0] / mm[1] - 1) > SAME_FOCAL else None


def parallax_deg(made: Reconstruction) -> float:
    """Median over the cloud of the largest angle between sight lines to a point: 0 for a camera that only turned."""
    centres = made.world_from_camera[:, :3, 3]
    away = made.points[made.seen_point] - centres[made.seen_view]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)
    order = np.argsort(made.seen_point, kind="stable")
    groups = np.split(away[order], np.flatnonzero(np.diff(made.seen_point[order])) + 1)
    largest = [np.arccos(np.clip((group @ group.T).min(), -1, 1)) for group in groups if len(group) > 1]
    return float(np.degrees(np.median(largest))) if largest else 0.0


def only_turned(made: Reconstruction) -> str:
    """What to say of views whose places hardly differ; empty when they do."""
    angle = parallax_deg(made)
    if angle >= LEAST_PARALLAX_DEG:
        return ""
    return (
        f"sfm: sight lines to a point differ by {angle:.2g} degrees (median), needed {LEAST_PARALLAX_DEG:g}: the "
        "camera was turned on the spot; step aside between photographs"
    )


def height_above(view: View) -> float:
    """Height [m] of the plate's camera above the plane. Raises CaptureError when it is below."""
    height = float(view.world_from_camera[1, 3])
    if not height > 0:
        raise CaptureError(
            f"plate: the camera is {-height:.3g} m below the marker's plane, needed above; is the board described as "
            "printed (legacy, squares), or a given pose in the wrong frame?"
        )
    return height


def feet_of(wishes: dict[str, Any]) -> dict[str, np.ndarray]:
    """Where each object is to stand (3,) [m] on the plane, world frame."""
    return {
        wish["name"]: np.array([wish["position_m"][0], 0.0, wish["position_m"][1]]) for wish in wishes.get("object", [])
    }


def check_feet(feet: dict[str, np.ndarray], camera: Camera, view: View) -> list[str]:
    """Warnings about feet (3,) outside the frame. Raises ManifestError for objects that the plate cannot show."""
    problems, warnings = [], []
    frame = np.array([camera.width, camera.height])
    for name, foot in feet.items():
        x, y, z = camera_points(view.world_from_camera, foot[None])[0][0]
        where = f"object {name}: position_m is ({foot[0]:g}, {foot[2]:g}) m"
        if z <= 0:
            problems.append(f"{where}, which is behind the plate camera; expected a place in front of it")
            continue
        px = np.array(
            [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]
        )  # without the lens's bend: far out
        outside = float(np.linalg.norm(np.maximum(np.maximum(-px, px - frame), 0)))
        if outside > FAR_OUTSIDE * np.hypot(*frame):
            problems.append(f"{where}, {outside:.0f} px outside the plate; expected a place that it shows, or near it")
        elif outside > 0:
            warnings.append(f"{where}: its foot is {outside:.0f} px outside the plate")
    if problems:
        raise ManifestError(*problems)
    return warnings
