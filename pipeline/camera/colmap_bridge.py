"""The only importer of pycolmap. COLMAP's pixel origin is ours: no half pixel here."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.conventions import invert_rigid
from pipeline.run.errors import NumericalError
from pipeline.types import Camera


def colmap_camera(camera: Camera) -> Any:
    """The same camera for pycolmap; FULL_OPENCV is Brown's model when its denominator is 1."""
    import pycolmap

    k1, k2, p1, p2, k3 = camera.distortion
    params = [camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, p1, p2, k3, 0, 0, 0]
    return pycolmap.Camera(model="FULL_OPENCV", width=camera.width, height=camera.height, params=params)


def pose_of_points(camera: Camera, world_points: np.ndarray, px: np.ndarray, max_error_px: float) -> np.ndarray:
    """``world_from_camera`` (4, 4) of points (N, 3) seen at pixels (N, 2), robust (LO-RANSAC over P3P).

    Raises NumericalError when no pose explains at least four of the points.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(
        np.asarray(px, float), np.asarray(world_points, float), colmap_camera(camera), options
    )
    if answer is None or answer["num_inliers"] < 4:
        found = 0 if answer is None else answer["num_inliers"]
        raise NumericalError(
            f"pose: {found} of {len(px)} points agree with one pose within {max_error_px:g} px, needed 4; "
            "check the points"
        )
    camera_from_world = np.eye(4)
    camera_from_world[:3] = answer["cam_from_world"].matrix()
    return invert_rigid(camera_from_world)
