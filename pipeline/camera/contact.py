"""How surely a point of the world is seen where it is drawn: pose and lens covariance pushed to pixels at a foot."""

from __future__ import annotations

import numpy as np

from pipeline.camera.lens import project_jacobians
from pipeline.camera.rigid import camera_points
from pipeline.types import Camera, View


def contact_sigma(camera: Camera, view: View, spot: np.ndarray) -> float:
    """Largest standard uncertainty, px, of where a point (3,) of the world appears in the plate; NaN outside the lens.

    Pose and lens were estimated together: a lens error is mostly undone by the pose, which their correlation carries.
    """
    covariance = contact_covariance(camera, view, spot)
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0))) if np.isfinite(covariance).all() else np.nan


def contact_covariance(camera: Camera, view: View, spot: np.ndarray) -> np.ndarray:
    """(2, 2) px^2 of where a point (3,) of the world appears in a view; NaN where the lens does not image it."""
    point, by_pose = camera_points(view.world_from_camera, spot[None])
    _, by_point, by_lens = project_jacobians(camera, point)
    if not np.isfinite(by_point).all():
        return np.full((2, 2), np.nan)
    pose, lens = by_point[0] @ by_pose[0], by_lens[0]
    covariance = pose @ view.covariance @ pose.T
    if view.lens_covariance is not None:
        cross = pose @ view.lens_covariance @ lens.T
        covariance = covariance + cross + cross.T + lens @ camera.covariance @ lens.T
    return np.asarray(covariance)
