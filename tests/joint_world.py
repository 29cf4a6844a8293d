"""A cloud, two markers and cameras on an arc, for the joint adjustment: the truth, and as measured."""

from __future__ import annotations

import numpy as np

from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.reprojection import Bundle, Corners
from pipeline.camera.rigid import camera_points, perturb
from pipeline.conventions import transform_points
from pipeline.simulation.lens import look_at
from pipeline.types import Camera

CAMERA = Camera(
    width=960, height=720, fx=1046, fy=1046, cx=484.2, cy=356.1, distortion=np.array([-0.062, 0.018, 0, 0, 0])
)
TRACK_PX, CORNER_PX = 0.4, 0.08
CORNERS = marker_points(0.06)


def world(rng: np.random.Generator, views: int = 10, points: int = 300) -> Bundle:
    """Cameras on an arc, a cloud on and above a table, two markers in all views but the first, all without noise."""
    angle = np.linspace(-0.9, 0.9, views)
    eyes = np.stack([0.5 * np.sin(angle) + 0.13, 0.35 + 0.1 * np.cos(5 * angle), 0.5 * np.cos(angle)], -1)
    poses = [look_at(eye, np.array([0.13, 0.0, 0.0])) for eye in eyes]
    cloud = np.stack(
        [rng.uniform(-0.2, 0.45, points), rng.uniform(0, 0.12, points) * (rng.random(points) < 0.3),
         rng.uniform(-0.25, 0.25, points)], -1,
    )  # fmt: skip
    second = perturb(np.eye(4), np.array([0.0, 0.4, 0.0, 0.26, 0.0, 0.09]))
    sights = []
    for view, pose in enumerate(poses):
        px = project(CAMERA, camera_points(pose, cloud)[0])
        inside = np.flatnonzero((px > 4).all(1) & (px < (CAMERA.width - 4, CAMERA.height - 4)).all(1))
        sights += [(view, point, *px[point]) for point in inside if rng.random() < 0.6]
    table = np.array(sights)
    corners = [
        Corners(view, marker, CORNERS, project(CAMERA, camera_points(poses[view], transform_points(place, CORNERS))[0]))
        for view in range(1, views) for marker, place in enumerate([np.eye(4), second])
    ]  # fmt: skip
    return Bundle(
        [CAMERA], poses, np.zeros(views, int), cloud, table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:],
        [np.eye(4), second], corners,
    )  # fmt: skip


def noisy(truth: Bundle, rng: np.random.Generator, outliers: float = 0.02) -> Bundle:
    """The truth as measured, started off its place."""
    px = truth.px + TRACK_PX * rng.standard_normal(truth.px.shape)
    wild = rng.random(len(px)) < outliers
    px[wild] += rng.uniform(-40, 40, (int(wild.sum()), 2))
    corners = [
        Corners(c.view, c.marker, c.points, c.px + CORNER_PX * rng.standard_normal((4, 2))) for c in truth.corners
    ]
    step = np.array([0.01] * 3 + [0.004] * 3)
    return Bundle(
        truth.cameras, [perturb(pose, step * rng.standard_normal(6)) for pose in truth.poses], truth.camera_of,
        truth.points + 0.003 * rng.standard_normal(truth.points.shape), truth.seen_view, truth.seen_point, px,
        [truth.markers[0], perturb(truth.markers[1], 0.5 * step * rng.standard_normal(6))], corners,
    )  # fmt: skip
