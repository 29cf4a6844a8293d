"""The one page of conventions: frames, units, pixel origin, colour space, lat-long.

World       right-handed, +Y up, metres. Origin at the marker; its outward normal is +Y.
Camera      OpenCV: x right, y down, z forward. ``world_from_camera @ p_camera = p_world``.
Pixels      the centre of the first pixel is (0.5, 0.5), as in COLMAP and Mitsuba; OpenCV puts it at (0, 0), so its
            coordinates gain ``HALF_PIXEL`` on entry and lose it on exit.
Radiance    one unit per capture: ``(DN - black) / (white - black) * N**2 * 100 / (t * ISO)``.
Colour      linear, scene-referred ACEScg (AP1 primaries, white at D60 of ACES); sensor data are ``camera_rgb``.
Lat-long    as OpenEXR and Mitsuba: ``v = acos(y) / pi``, ``u = atan2(x, -z) / (2 pi) mod 1``; texel (row, col) has its
            centre at ``u = (col + 0.5) / W, v = (row + 0.5) / H``; the centre of the picture looks along +Z.
Covariance  of a pose: 6x6, order (rotation vector [rad], position [m]), both of the camera *in the world frame*:
            ``R' = exp([w]x) R`` and ``t' = t + d`` for ``world_from_camera = [R t]``.
Albedo      hemispherical reflectance in [0, 1]; the BRDF value of a diffuse surface is ``albedo / pi``.
"""

from __future__ import annotations

import numpy as np

HALF_PIXEL = 0.5

# A board (ChArUco or grid) of OpenCV 5 has its origin at the outer corner of the top-left square, x along the top
# edge, y down the print and z into the table.
WORLD_FROM_BOARD = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)

# A single marker (IPPE_SQUARE) has its origin at the centre, x right, y up the print and z outward.
WORLD_FROM_MARKER = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)

# Mask bits of a merged or developed photograph. A pixel may carry several.
BOX_PX2 = 1 / 12  # variance along an axis of a pixel's own box
CLIPPED = 1  # clipped in every frame: the value is a lower bound, its variance infinite
DARK = 2  # below the noise in every frame
GHOST = 4  # frames disagree beyond the noise model
HOT = 8  # defective photosite, replaced from its neighbours of the same colour

# Views that show no scene: photographs of a chart, and of an even surface ("flat_1", ...). Their scale is not used.
CHART_VIEW, FLAT_VIEW = "chart", "flat_"

ACESCG = "acescg"
CAMERA_RGB = "camera_rgb"
RADIANCE_UNIT = "(DN-black)/(white-black)*N^2*100/(t*ISO)"


def direction_from_latlong(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit directions, shape (..., 3), world frame, of lat-long coordinates ``u, v`` in [0, 1]."""
    phi, theta = 2 * np.pi * np.asarray(u), np.pi * np.asarray(v)
    sin_theta = np.sin(theta)
    return np.stack([sin_theta * np.sin(phi), np.cos(theta) + 0 * phi, -sin_theta * np.cos(phi)], -1)


def latlong_from_direction(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lat-long coordinates ``(u, v)`` in [0, 1) and [0, 1] of directions (..., 3); they need not be unit length."""
    x, y, z = np.moveaxis(np.asarray(direction, float), -1, 0)
    u = np.mod(np.arctan2(x, -z) / (2 * np.pi), 1.0)
    v = np.arctan2(np.hypot(x, z), y) / np.pi  # better than acos near the poles
    return u, v


def latlong_directions(height: int, width: int) -> np.ndarray:
    """Directions (H, W, 3) of the texel centres of a lat-long map."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return direction_from_latlong(u, v)


def latlong_solid_angles(height: int, width: int) -> np.ndarray:
    """Exact solid angle (H, W) in steradian of each texel; the sum is 4 pi."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return np.repeat(((edges[:-1] - edges[1:]) * 2 * np.pi / width)[:, None], width, 1)


def transform_points(target_from_source: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) of the source frame, in the target frame, for a 4x4 rigid or affine matrix."""
    return points @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def invert_rigid(target_from_source: np.ndarray) -> np.ndarray:
    """Inverse of a 4x4 rigid transform."""
    rotation = target_from_source[:3, :3].T
    inverse = np.eye(4)
    inverse[:3, :3] = rotation
    inverse[:3, 3] = -rotation @ target_from_source[:3, 3]
    return inverse
