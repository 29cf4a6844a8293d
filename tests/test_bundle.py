"""Joint adjustment of cloud and markers: truth found, regions that hold it, better than a similarity alone."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.camera.adjustment import free_columns
from pipeline.camera.bundle import Adjusted, Bundle, Corners, adjust
from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.rigid import camera_points, difference, perturb, umeyama
from pipeline.conventions import transform_points
from pipeline.run.errors import NumericalError
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


def test_exact_data_give_the_truth() -> None:
    rng = np.random.default_rng(1)
    truth = world(rng)
    start = noisy(truth, rng, 0.0)
    start = Bundle(**{**vars(start), "px": truth.px, "corners": truth.corners})
    found = adjust(start, corner_sigma_px=0.1)
    for pose, true in zip(found.bundle.poses, truth.poses, strict=True):
        assert np.abs(difference(pose, true)).max() < 1e-6  # Newton's last step; the data are float64
    assert np.abs(difference(found.bundle.markers[1], truth.markers[1])).max() < 1e-6


def pooled(trials: int) -> tuple[np.ndarray, np.ndarray, list[Adjusted]]:
    """Errors (trials, 6) of the view that shows no marker, their chi-square, the adjustments."""
    errors, chi2, done = [], [], []
    for seed in range(trials):
        rng = np.random.default_rng(100 + seed)
        truth = world(rng, views=8, points=160)
        found = adjust(noisy(truth, rng))
        errors.append(difference(found.bundle.poses[0], truth.poses[0]))
        chi2.append(errors[-1] @ np.linalg.solve(found.pose_covariance[0], errors[-1]))
        done.append(found)
    return np.array(errors), np.array(chi2), done


def test_regions_hold_the_truth_and_noise_is_found() -> None:
    _, chi2, done = pooled(24)
    inside = float((chi2 < 12.59).mean())  # 95 % of chi-square with 6 degrees
    assert inside >= 0.79, chi2  # binomial: 24 trials at 95 % give fewer than 19 once in 1600
    assert 4.0 < np.mean(chi2) < 9.0  # 6 expected, its standard error 0.7; Huber widens by 5 %
    assert np.median([one.track_sigma_px for one in done]) == pytest.approx(TRACK_PX, rel=0.1)
    assert np.median([one.corner_sigma_px for one in done]) == pytest.approx(CORNER_PX, rel=0.15)


def test_beats_a_similarity_alone() -> None:
    """The cloud adjusted by itself and then fitted to the markers' triangulated corners is worse than both together.

    Compared over the root mean square of the position of the view that shows no marker.
    """
    ours, theirs = [], []
    for seed in range(6):
        rng = np.random.default_rng(300 + seed)
        truth = world(rng, views=8, points=160)
        start = noisy(truth, rng)
        ours.append(difference(adjust(start).bundle.poses[0], truth.poses[0]))
        bare = Bundle(**{**vars(start), "markers": [], "corners": []})
        cloud = adjust(bare, hold_first=True).bundle
        seen = np.array([_triangulated(cloud, start, marker) for marker in (0, 1)]).reshape(-1, 3)
        true = np.concatenate([transform_points(place, CORNERS) for place in truth.markers])
        matrix, scale = umeyama(true, seen, scale=True)
        pose = matrix @ cloud.poses[0]
        pose[:3, :3] /= scale
        theirs.append(difference(pose, truth.poses[0]))
    rms = [float(np.sqrt((np.array(e)[:, 3:] ** 2).mean())) for e in (ours, theirs)]
    assert rms[0] < rms[1], rms


def _triangulated(cloud: Bundle, start: Bundle, marker: int) -> np.ndarray:
    """Corners (4, 3) of a marker from its sights in the cloud's frame: nearest point to the rays."""
    from pipeline.camera.lens import pixel_rays

    seen = [c for c in start.corners if c.marker == marker]
    answer = []
    for corner in range(4):
        A, b = np.zeros((3, 3)), np.zeros(3)
        for c in seen:
            pose = cloud.poses[c.view]
            ray = pose[:3, :3] @ pixel_rays(cloud.cameras[0], c.px[corner : corner + 1])[0]
            across = np.eye(3) - np.outer(ray, ray)
            A, b = A + across, b + across @ pose[:3, 3]
        answer.append(np.linalg.solve(A, b))
    return np.array(answer)


def test_lens_is_found_with_its_covariance() -> None:
    chi2 = []
    for seed in range(10):
        rng = np.random.default_rng(500 + seed)
        truth = world(rng, views=8, points=160)
        start = noisy(truth, rng)
        off = CAMERA.model_copy(update={"fx": 1070.0, "fy": 1070.0, "distortion": np.zeros(5)})
        found = adjust(
            Bundle(**{**vars(start), "cameras": [off]}), [free_columns(("k1", "k2"), True)],
            [np.array([50, 50, 10, 10, 1, 1, 1, 1, 1.0])],
        )  # fmt: skip
        camera = found.bundle.cameras[0]
        error = np.array(
            [camera.fx - 1046, camera.cx - 484.2, camera.cy - 356.1, *(camera.distortion - CAMERA.distortion)[:2]]
        )
        keep = [0, 2, 3, 4, 5]
        chi2.append(error @ np.linalg.solve(found.lens_covariance[0][np.ix_(keep, keep)], error))
    assert np.mean(chi2) < 9.0  # 5 expected, standard error 1


def test_too_little_is_refused() -> None:
    rng = np.random.default_rng(3)
    truth = world(rng)
    few = Bundle(
        **{**vars(truth), "seen_view": truth.seen_view[:5], "seen_point": truth.seen_point[:5], "px": truth.px[:5]}
    )
    with pytest.raises(NumericalError, match="overlap"):
        adjust(few)
    with pytest.raises(NumericalError, match="nothing fixes metre"):
        adjust(Bundle(**{**vars(truth), "markers": [], "corners": []}))
