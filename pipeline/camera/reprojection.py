"""Where points of a cloud and corners of markers are seen, and where they should be: residuals and derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.camera.adjustment import lens_vector
from pipeline.camera.lens import project, project_jacobians
from pipeline.camera.rigid import camera_points, skew
from pipeline.conventions import transform_points
from pipeline.types import Camera


@dataclass(frozen=True)
class Corners:
    """Points of one marker (or board) in one view: numbers of view and marker, place in the marker's frame, pixels."""

    view: int
    marker: int
    points: np.ndarray  # (n, 3), +Y outward
    px: np.ndarray  # (n, 2)


@dataclass(frozen=True)
class Bundle:
    """Everything that is adjusted, and the measurements.

    ``poses``: world_from_camera (4, 4) each; ``camera_of``: (N,) number of each view's lens; ``points``: (M, 3), world;
    ``seen_view``, ``seen_point``: (K,), no pair twice, ``px``: (K, 2); ``markers``: world_from_marker (4, 4) each, the
    first the identity.
    """

    cameras: list[Camera]
    poses: list[np.ndarray]
    camera_of: np.ndarray
    points: np.ndarray
    seen_view: np.ndarray
    seen_point: np.ndarray
    px: np.ndarray
    markers: list[np.ndarray] = field(default_factory=list)
    corners: list[Corners] = field(default_factory=list)


@dataclass(frozen=True)
class Terms:
    """Residuals and derivatives of all sightings, cloud first, corners after them, weighted by their sigma."""

    residuals: np.ndarray  # (K + C, 2) px
    by_pose: np.ndarray  # (.., 2, 6)
    by_lens: np.ndarray  # (.., 2, L) of the longest lens, zero beyond a shorter one's
    by_point: np.ndarray  # (K, 2, 3)
    by_marker: np.ndarray  # (C, 2, 6)
    view: np.ndarray
    marker: np.ndarray  # (C,)


def derivatives(bundle: Bundle) -> Terms:
    """Residuals measured - predicted, and the prediction's derivatives."""
    count, corners = len(bundle.px), bundle.corners
    view = np.concatenate([bundle.seen_view, *(np.full(len(c.px), c.view) for c in corners)]).astype(int)
    marker = np.array([c.marker for c in corners for _ in c.px], int)
    place = [bundle.points[bundle.seen_point]]
    place += [transform_points(bundle.markers[c.marker], c.points) for c in corners]
    world, px = np.concatenate(place), np.concatenate([bundle.px, *(c.px for c in corners)])
    residuals, by_pose = np.empty((len(px), 2)), np.empty((len(px), 2, 6))
    longest = max(len(lens_vector(camera)) for camera in bundle.cameras)
    by_lens, by_world = np.zeros((len(px), 2, longest)), np.empty((len(px), 2, 3))
    for number, pose in enumerate(bundle.poses):
        mine = np.flatnonzero(view == number)
        points, moved = camera_points(pose, world[mine])
        predicted, by_point, lens = project_jacobians(bundle.cameras[bundle.camera_of[number]], points)
        residuals[mine], by_pose[mine] = px[mine] - predicted, by_point @ moved
        by_lens[mine, :, : lens.shape[2]] = lens
        by_world[mine] = by_point @ pose[:3, :3].T
    arm = world[count:] - np.array([bundle.markers[m][:3, 3] for m in marker]).reshape(-1, 3)
    by_motion = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], -1)
    return Terms(residuals, by_pose, by_lens, by_world[:count], by_world[count:] @ by_motion, view, marker)


def residuals_of(bundle: Bundle) -> np.ndarray:
    """(K + C, 2) measured - predicted, as in `derivatives`, without the derivatives."""
    residuals = np.empty((len(bundle.px) + sum(len(c.px) for c in bundle.corners), 2))
    for number, pose in enumerate(bundle.poses):
        camera, mine = bundle.cameras[bundle.camera_of[number]], bundle.seen_view == number
        points = (bundle.points[bundle.seen_point[mine]] - pose[:3, 3]) @ pose[:3, :3]
        residuals[: len(bundle.px)][mine] = bundle.px[mine] - project(camera, points)
    at = len(bundle.px)
    for c in bundle.corners:
        pose, camera = bundle.poses[c.view], bundle.cameras[bundle.camera_of[c.view]]
        points = (transform_points(bundle.markers[c.marker], c.points) - pose[:3, 3]) @ pose[:3, :3]
        residuals[at : at + len(c.px)] = c.px - project(camera, points)
        at += len(c.px)
    return residuals
