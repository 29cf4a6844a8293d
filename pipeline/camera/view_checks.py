"""Whether photographs taken together are what is needed: one lens for all by their metadata, and places that differ."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from pipeline.types import Frame, Reconstruction

SAME_FOCAL = 0.02  # as metadata round it
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
