"""Which of two poses is right, by the ball: it stands on the plane of one of them.

A plane's second pose turns the world about the marker by twice its tilt, so a ball beside the marker leaves the plane
by a share of its distance. Its place in the camera's frame is known without the plane, from the outline's size.
"""

from __future__ import annotations

import numpy as np

from pipeline.conventions import transform_points
from pipeline.probes.finding import STAND_SIGMA, find_ball
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Raster, View


def standing_chi2(
    name: str, photograph: Raster, plate: Raster | None, camera: Camera, views: list[View], radius: float
) -> np.ndarray | None:
    """Chi-square (K,), one degree of freedom, of the ball's height over the plane under each view; None without a ball.

    ``photograph`` and ``plate`` as in `find_ball`; ``views`` are poses of the photograph with their covariances.
    """
    free = None
    for view in views:
        try:
            free = find_ball(name, photograph, plate, camera, view, radius, []).free
            break
        except CaptureError:
            continue
    if free is None:
        return None
    chi2 = []
    for view in views:
        up = view.world_from_camera[1, :3]
        arm = view.world_from_camera[:3, :3] @ free.centre
        slope = np.array([arm[2], 0.0, -arm[0], 0.0, 1.0, 0.0])  # dy = (w x arm)_y + d_y, in conventions' order
        variance = slope @ view.covariance @ slope + up @ free.covariance @ up + (STAND_SIGMA * radius) ** 2
        height = float(transform_points(view.world_from_camera, free.centre)[1])
        chi2.append((height - radius) ** 2 / float(variance))
    return np.array(chi2)
