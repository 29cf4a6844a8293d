"""How well a set of board photographs fixes a lens over the whole frame, and which further one would help most.

The lens's uncertainty is pushed to pixels: standard deviation of where rays are imaged, less what turning the camera
would do, which every pose takes up. It is taken for a lens with k1 and k2 even where they were not needed: a term that
boards in one corner do not ask for may still bend the others. Candidates for the next photograph are boards tilted by
40 degrees four ways, at five places of the frame; the one that lowers the uncertainty most is named.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from pipeline.camera.adjustment import free_columns
from pipeline.camera.distortion import distortion_jacobian
from pipeline.camera.lens import project, project_jacobians, unproject
from pipeline.camera.resection import residuals_and_jacobian
from pipeline.camera.rigid import camera_points, rotation_exp
from pipeline.types import Camera

TILT_DEG = 40.0
FILL = 0.45  # of the frame's width or height that the proposed board takes
OFFSET = 0.27  # of the frame, from its middle, of a board near a corner
TILTS = {"left": (0, 1), "right": (0, -1), "upper": (-1, 0), "lower": (1, 0)}  # side farther away: turn about x, y
PLACES = {
    "in the middle": (0, 0), "in the upper left": (-1, -1), "in the upper right": (1, -1), "in the lower left": (-1, 1),
    "in the lower right": (1, 1),
}  # fmt: skip
WARNED_FOCAL = 0.01  # standard uncertainty, relative
LEAST_SPAN = 0.6  # of the frame, by corners of boards, each way
LEAST_TILT_DEG = 10.0  # boards all nearer to parallel to the sensor do not separate focal length from distance
ENOUGH_PHOTOS = 6
PRIOR_PX, PRIOR_BEND = 1e4, 1.0  # of focal length and centre, and of k1, k2: keeps what nothing determines finite


@dataclass(frozen=True)
class ViewSet:
    """What was photographed: poses (4, 4), world points (N_i, 3) m, pixels (N_i, 2), sigma of a coordinate px."""

    camera: Camera
    poses: list[np.ndarray]
    world_m: list[np.ndarray]
    px: list[np.ndarray]
    sigma_px: float


def information(camera: Camera, pose: np.ndarray, world_m: np.ndarray, px: np.ndarray) -> np.ndarray:
    """(5, 5) of (f, cx, cy, k1, k2) from one photograph, its pose free, corners of 1 px."""
    _, by_pose, by_lens = residuals_and_jacobian(camera, pose, world_m, px)
    lens = np.concatenate(by_lens) @ free_columns(("k1", "k2"), True, len(camera.distortion))
    turned = by_pose.reshape(-1, 6)
    along = np.linalg.lstsq(turned, lens, rcond=None)[0]
    return np.asarray(lens.T @ (lens - turned @ along))


def lens_sigma(camera: Camera, total: np.ndarray, sigma_px: float) -> tuple[float, float]:
    """Standard deviation, px, of where rays are imaged, less a rotation: rms over the frame, and at the worst corner.

    ``total``: (5, 5) summed information.
    """
    y, x = np.meshgrid(np.linspace(0, camera.height, 7), np.linspace(0, camera.width, 9), indexing="ij")
    xy = unproject(camera, np.stack([x, y], -1).reshape(-1, 2))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], -1)
    lens = np.concatenate(project_jacobians(camera, rays)[2])
    lens = lens @ free_columns(("k1", "k2"), True, len(camera.distortion))
    x, y = xy.T
    spin = np.stack([np.stack([-x * y, 1 + x * x, -y], -1), np.stack([-1 - y * y, x * y, x], -1)], 1)
    turned = np.array([[camera.fx], [camera.fy]]) * (distortion_jacobian(camera.distortion, xy) @ spin)
    flat = turned.reshape(-1, 3)
    left = lens - flat @ np.linalg.lstsq(flat, lens, rcond=None)[0]
    prior = np.diag([PRIOR_PX**-2.0] * 3 + [PRIOR_BEND**-2.0] * 2)
    covariance = np.linalg.inv(total / max(sigma_px, 1e-6) ** 2 + prior)
    variance = np.einsum("ij,jk,ik->i", left, covariance, left).reshape(-1, 2).sum(-1)
    return float(np.sqrt(variance.mean())), float(np.sqrt(variance.max()))


def summed(views: ViewSet) -> np.ndarray:
    """(5, 5) information of all photographs."""
    each = zip(views.poses, views.world_m, views.px, strict=True)
    return np.asarray(sum(information(views.camera, *one) for one in each))


def proposed_pose(camera: Camera, points: np.ndarray, turn: tuple[int, int], place: tuple[int, int]) -> np.ndarray:
    """``world_from_camera`` that shows a board (N, 3) at a place of the frame, turned about camera x, y."""
    extent = np.ptp(points, axis=0)
    distance = max(extent[0] * camera.fx / camera.width, extent[2] * camera.fy / camera.height) / FILL
    middle_px = (0.5 + OFFSET * np.array(place)) * (camera.width, camera.height)
    at = unproject(camera, middle_px[None])
    facing = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # camera x along world x, y along z, looking down
    rotation = rotation_exp(np.radians(TILT_DEG) * np.array([turn[0], turn[1], 0.0])) @ facing
    middle = (points.min(0) + points.max(0)) / 2
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = middle - rotation.T @ (distance * np.array([*at[0], 1.0]))
    return pose


def next_photograph(views: ViewSet) -> tuple[str, float]:
    """The most helpful further photograph in words, and the lens's rms sigma, px, that it would leave."""
    points = max(views.world_m, key=len)
    total = summed(views)
    best = ("", np.inf)
    for (side, turn), (where, place) in product(TILTS.items(), PLACES.items()):
        pose = proposed_pose(views.camera, points, turn, place)
        px = project(views.camera, camera_points(pose, points)[0])
        inside = np.isfinite(px).all(-1) & (px > 0).all(-1) & (px < (views.camera.width, views.camera.height)).all(-1)
        if inside.sum() < len(points) / 2:
            continue
        more = information(views.camera, pose, points[inside], px[inside])
        rms = lens_sigma(views.camera, total + more, views.sigma_px)[0]
        if rms < best[1]:
            best = (f"a board {where} of the frame, tilted by {TILT_DEG:.0f} degrees with its {side} side away", rms)
    return best


def empty_corners(px: np.ndarray, width: int, height: int) -> list[str]:
    """Corner ninths of the frame in which no corner (N, 2) was seen."""
    column = np.clip(px[:, 0] / width * 3, 0, 2).astype(int)
    row = np.clip(px[:, 1] / height * 3, 0, 2).astype(int)
    seen = set(zip(row.tolist(), column.tolist(), strict=True))
    names = {(0, 0): "upper left", (0, 2): "upper right", (2, 0): "lower left", (2, 2): "lower right"}
    return [name for cell, name in names.items() if cell not in seen]


def doubts_of(
    camera: Camera, photos: int, tilt_deg: float, focal_sigma: float, px: np.ndarray, span: list[float], worst_px: float
) -> list[str]:
    """What the photographs hardly determine, one line each, the gravest first."""
    doubts = []
    if tilt_deg < LEAST_TILT_DEG or focal_sigma > WARNED_FOCAL:
        doubts.append(
            f"board tilts reach {tilt_deg:.0f} deg and the focal length is known to {focal_sigma:.2%}, "
            "needed tilts of 30 deg and 1 %; add photographs with the board tilted 30 to 45 degrees several ways"
        )
    if empty := empty_corners(px, camera.width, camera.height):
        doubts.append(
            f"the {', '.join(empty)} of the frame never showed the board, needed all corners; distortion "
            f"there is extrapolated and rays are known to {worst_px:.2g} px at worst"
        )
    elif min(span) < LEAST_SPAN:
        doubts.append(
            f"corners span {span[0]:.0%} by {span[1]:.0%} of the frame, needed {LEAST_SPAN:.0%}; distortion "
            f"outside is extrapolated and rays are known to {worst_px:.2g} px at worst"
        )
    if photos < ENOUGH_PHOTOS:
        doubts.append(f"{photos} photographs, needed {ENOUGH_PHOTOS} for an error on held-out ones to choose the model")
    return doubts
