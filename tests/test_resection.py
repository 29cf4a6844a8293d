"""Poses from simulated corners: coverage of the stated regions, accuracy, flips, degenerate points."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import looking_at

from pipeline.camera.adjustment import free_columns
from pipeline.camera.colmap_bridge import pose_of_points
from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.resection import corner_noise, is_planar, refine, resect_plane
from pipeline.camera.rigid import camera_points, difference
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

CAMERA = Camera(
    width=1024, height=768, fx=1100, fy=1100, cx=515, cy=380, distortion=np.array([-0.1, 0.02, 5e-4, -3e-4, 0])
)
X, Z = np.meshgrid(np.arange(1, 7) * 0.03, np.arange(1, 5) * 0.03)
BOARD = np.stack([X.ravel(), 0 * X.ravel(), Z.ravel()], -1)
CENTRE = np.array([0.105, 0, 0.075])
SPREAD = np.random.default_rng(5).uniform(-0.15, 0.15, (12, 3)) * (1, 0.6, 1) + (0.1, 0.1, 0.08)
CHI2_95 = 12.592  # six degrees of freedom
SIGMA = 0.1
TRIALS = 300
# With 300 trials of probability 0.95 the share has a standard error of 1.3 %: 90 to 98 % is -4 to +2.4 of them.
LOW, HIGH = 0.90, 0.985


def seen(points: np.ndarray, pose: np.ndarray, rng: np.random.Generator, sigma: float = SIGMA) -> np.ndarray:
    return project(CAMERA, camera_points(pose, points)[0]) + sigma * rng.normal(size=(len(points), 2))


def random_pose(
    rng: np.random.Generator, tilts: tuple[float, float], distance: float, centre: np.ndarray = CENTRE
) -> np.ndarray:
    return looking_at(
        centre, rng.uniform(*tilts), rng.uniform(0, 360), distance * rng.uniform(0.8, 1.3), rng.uniform(-20, 20)
    )


@pytest.mark.parametrize("lens_known", [True, False])
def test_board_coverage_and_accuracy(lens_known: bool) -> None:
    rng = np.random.default_rng(11)
    spread = np.diag([2.0, 0, 2, 2, 1e-3, 1e-3, 1e-5, 1e-5, 0]) ** 2
    free = free_columns(("k1", "k2", "p1", "p2", "k3"), True)
    covariance = np.zeros((9, 9)) if lens_known else free @ np.delete(np.delete(spread, 1, 0), 1, 1) @ free.T
    inside, rotation_deg, position = 0, [], []
    for _ in range(TRIALS):
        pose = random_pose(rng, (20, 60), 0.45)
        px = seen(BOARD, pose, rng)
        error = rng.multivariate_normal(np.zeros(9), covariance, method="svd")
        values = {name: getattr(CAMERA, name) + error[i] for i, name in enumerate(("fx", "fy", "cx", "cy"))}
        camera = CAMERA.model_copy(
            update={**values, "distortion": CAMERA.distortion + error[4:], "covariance": covariance}
        )
        best, _, ambiguity = resect_plane(camera, BOARD, px, SIGMA)
        assert ambiguity > 4
        delta = difference(best.world_from_camera, pose)
        inside += delta @ np.linalg.solve(best.covariance, delta) < CHI2_95
        rotation_deg.append(np.degrees(np.linalg.norm(delta[:3])))
        position.append(np.linalg.norm(delta[3:]) / np.linalg.norm(pose[:3, 3] - CENTRE))
    assert LOW < inside / TRIALS < HIGH
    if lens_known:  # the brief's figures for a board about 480 px wide
        assert np.median(rotation_deg) < 0.05
        assert np.median(position) < 1e-3


def test_a_boards_residuals_tell_its_corners_noise() -> None:
    """Corners of 0.04 px where 0.1 is stated: the region is as wide as 0.04 asks for, and what corners may share.

    Mean chi2 of 120 boards: 6 for six numbers, less the share of 24 x 0.005^2 in 0.04^2 (4.5), +- 0.3. With the stated
    noise it is 1. Fewer than 13 corners tell too little: there the stated one stays.
    """
    rng, found = np.random.default_rng(8), []
    for _ in range(120):
        pose = random_pose(rng, (20, 60), 0.45)
        best, _, _ = resect_plane(CAMERA, BOARD, seen(BOARD, pose, rng, 0.04), SIGMA, True)
        delta = difference(best.world_from_camera, pose)
        found.append(float(delta @ np.linalg.solve(best.covariance, delta)))
    assert 3.6 < np.mean(found) < 5.4
    assert np.mean(np.array(found) < CHI2_95) > LOW
    assert corner_noise(12 * 2 * 0.04**2, 12, SIGMA, True) == SIGMA
    assert corner_noise(24 * 2 * 0.2**2, 24, SIGMA, True) > 0.2  # worse than stated is told as well


def test_board_coverage_at_all_tilts() -> None:
    rng = np.random.default_rng(12)
    inside = 0
    for _ in range(TRIALS):
        pose = random_pose(rng, (0, 30), 0.45)
        best, _, _ = resect_plane(CAMERA, BOARD, seen(BOARD, pose, rng), SIGMA)
        delta = difference(best.world_from_camera, pose)
        inside += delta @ np.linalg.solve(best.covariance, delta) < CHI2_95
    assert LOW < inside / TRIALS < HIGH


@pytest.mark.parametrize(("distance", "tilts"), [(0.8, (0.0, 10.0)), (0.8, (30.0, 60.0)), (1.5, (30.0, 60.0))])
def test_marker_coverage(distance: float, tilts: tuple[float, float]) -> None:
    rng = np.random.default_rng(13)
    points = marker_points(0.1)
    inside = accepted = 0
    for _ in range(TRIALS):
        pose = random_pose(rng, tilts, distance, np.zeros(3))
        best, second, ambiguity = resect_plane(CAMERA, points, seen(points, pose, rng), SIGMA)
        if ambiguity < 4:
            assert second is not None
            continue
        delta = difference(best.world_from_camera, pose)
        accepted += 1
        inside += delta @ np.linalg.solve(best.covariance, delta) < CHI2_95
    assert accepted > 0.95 * TRIALS
    assert LOW < inside / accepted < HIGH


def test_points_coverage() -> None:
    rng = np.random.default_rng(14)
    inside = 0
    for _ in range(TRIALS):
        pose = random_pose(rng, (20, 70), 0.8)
        px = seen(SPREAD, pose, rng, 0.5)
        best = refine(CAMERA, pose_of_points(CAMERA, SPREAD, px, 10.0), SPREAD, px, 0.5)
        delta = difference(best.world_from_camera, pose)
        inside += delta @ np.linalg.solve(best.covariance, delta) < CHI2_95
    assert LOW < inside / TRIALS < HIGH


def test_small_marker_never_flips_unnoticed(saw) -> None:
    """A 30 px marker is refused or right: accepted poses are flipped in less than 1 % of all trials."""
    rng = np.random.default_rng(15)
    points = marker_points(0.1)
    flipped = refused = 0
    for _ in range(TRIALS):
        pose = random_pose(rng, (10, 60), 3.3, np.zeros(3))
        best, _, ambiguity = resect_plane(CAMERA, points, seen(points, pose, rng), SIGMA)
        if ambiguity < 4:
            refused += 1
        else:
            flipped += np.degrees(np.linalg.norm(difference(best.world_from_camera, pose)[:3])) > 15
    assert refused > 0
    said = f"{refused} of {TRIALS} refused with both poses"
    saw("marker.30px", "degraded", flipped / TRIALS, said=said)


def test_exact_data_give_the_exact_pose() -> None:
    pose = looking_at(CENTRE, 35, 100, 0.5)
    best, second, ambiguity = resect_plane(CAMERA, BOARD, project(CAMERA, camera_points(pose, BOARD)[0]), SIGMA)
    assert np.abs(difference(best.world_from_camera, pose)).max() < 1e-9
    assert second is not None
    assert ambiguity > 100
    assert best.rms_px < 1e-7


def test_outliers_are_left_out() -> None:
    rng = np.random.default_rng(16)
    pose = looking_at(CENTRE, 35, 100, 0.5)
    px = seen(BOARD, pose, rng)
    px[[3, 17]] += [[6.0, -4.0], [-3.0, 9.0]]
    best, _, _ = resect_plane(CAMERA, BOARD, px, SIGMA)
    assert not best.kept[[3, 17]].any()
    assert best.kept.sum() >= 20
    delta = difference(best.world_from_camera, pose)
    assert delta @ np.linalg.solve(best.covariance, delta) < 22.5  # 99.9 %


def test_straight_on_is_widened_not_refused() -> None:
    points = marker_points(0.1)
    pose = looking_at(np.zeros(3), 0, 0, 1.2)
    best, _, ambiguity = resect_plane(CAMERA, points, project(CAMERA, camera_points(pose, points)[0]), SIGMA)
    assert ambiguity == np.inf
    assert best.frontal
    assert np.degrees(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1])) > 1


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_scale_of_the_world_does_not_matter(scale: float) -> None:
    pose = looking_at(CENTRE * scale, 40, 10, 0.5 * scale)
    points = BOARD * scale
    best, _, _ = resect_plane(CAMERA, points, project(CAMERA, camera_points(pose, points)[0]), SIGMA)
    delta = difference(best.world_from_camera, pose)
    assert np.abs(delta[:3]).max() < 1e-9
    assert np.abs(delta[3:]).max() < 1e-9 * scale


def test_far_from_the_origin() -> None:
    far = np.array([1e6, 0, -1e6])  # metres; positions there have 1e-10 m of rounding
    pose = looking_at(CENTRE + far, 40, 10, 0.5)
    points = BOARD + far
    best, _, _ = resect_plane(CAMERA, points, project(CAMERA, camera_points(pose, points)[0]), SIGMA)
    assert np.abs(difference(best.world_from_camera, pose)).max() < 1e-7


def test_collinear_and_few_points_are_refused(saw) -> None:
    with pytest.raises(NumericalError, match="on a line or fewer than 4") as refusal:
        is_planar(np.outer(np.arange(6), [0.1, 0, 0.2]))
    saw("points.collinear", "refused", said=str(refusal.value))
    with pytest.raises(NumericalError, match="on a line or fewer than 4"):
        is_planar(BOARD[:3])
    row = BOARD[[0, 1, 2, 4, 5, 6]]  # five of a row and one beside it: no homography
    pose = looking_at(CENTRE, 30, 20, 0.4)
    with pytest.raises(NumericalError, match="too many of them on one line"):
        resect_plane(CAMERA, row, seen(row, pose, np.random.default_rng(18)), SIGMA)
    assert is_planar(BOARD)
    assert not is_planar(SPREAD)
    nonsense = np.random.default_rng(17).uniform(0, 700, (6, 2))
    with pytest.raises(NumericalError, match="agree with one pose"):
        pose_of_points(CAMERA, SPREAD[:6], nonsense, 1.0)
