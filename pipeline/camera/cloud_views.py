"""Poses of views that ask further photographs: tracks and markers adjusted together, brought to records and figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.board_doubts import sizes_in_views
from pipeline.camera.cloud_plane import in_world
from pipeline.camera.estimates import MOVED_CHI2
from pipeline.camera.rigid import difference
from pipeline.camera.sfm import Seen, oriented, scale_sigma, scaled_covariance
from pipeline.types import Camera, Reconstruction, View


def views_of_cloud(
    reconstruction: Reconstruction, cameras: list[Camera], seen: dict[str, list[Seen]], asked: list[str],
    tripod: list[str], facts: list[dict[str, Any]],
) -> tuple[dict[str, View], dict[str, Any], Reconstruction, list[str]]:  # fmt: skip
    """Views that ``asked`` (and those on the plate's ``tripod`` that moved), numbers, the cloud in the world, warnings.

    ``cameras``: lens of each body, held. ``seen``: board or markers by photograph. ``facts``: of the markers as stated.
    Raises NumericalError when the first marker is not seen from two places.
    """
    done, markers = oriented(reconstruction, cameras, seen, None)
    warnings = sizes_in_views(done.bundle, markers, facts)
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
    return views, numbers, in_world(reconstruction, done, cameras), warnings
