"""Laws of rigid motions."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.camera import rigid
from pipeline.conventions import invert_rigid, transform_points


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-3, 1.0, 3.0, np.pi - 1e-9, np.pi])
def test_log_inverts_exp(angle: float) -> None:
    axis = np.array([0.36, -0.48, 0.8])
    rotation = rigid.rotation_exp(angle * axis)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    back = rigid.rotation_log(rotation)
    back = -back if angle == np.pi and back @ axis < 0 else back  # at pi both axes are right
    np.testing.assert_allclose(back, angle * axis, atol=4e-15 + 1e-14 * angle)


def test_difference_inverts_perturb() -> None:
    rng = np.random.default_rng(0)
    pose = rigid.perturb(np.eye(4), rng.normal(size=6))
    delta = rng.normal(size=6) * 0.4
    np.testing.assert_allclose(rigid.difference(rigid.perturb(pose, delta), pose), delta, atol=1e-14)


def test_camera_points_and_derivative() -> None:
    rng = np.random.default_rng(1)
    pose = rigid.perturb(np.eye(4), rng.normal(size=6))
    points = rng.normal(size=(5, 3))
    seen, derivative = rigid.camera_points(pose, points)
    np.testing.assert_allclose(seen, transform_points(invert_rigid(pose), points), atol=1e-14)
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        ahead, behind = (rigid.camera_points(rigid.perturb(pose, s), points)[0] for s in (step, -step))
        np.testing.assert_allclose(derivative[:, :, axis], (ahead - behind) / 2e-6, atol=1e-9)


@pytest.mark.parametrize("flat", [False, True])
def test_umeyama_recovers_motion_and_scale(flat: bool) -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(10, 3)) * (1, 1, 0 if flat else 1)
    motion = rigid.perturb(np.eye(4), rng.normal(size=6))
    target = transform_points(motion, 2.5 * source)
    matrix, scale = rigid.umeyama(target, source, scale=True)
    assert scale == pytest.approx(2.5, rel=1e-12)
    np.testing.assert_allclose(transform_points(matrix, source), target, atol=1e-12)
    still, one = rigid.umeyama(transform_points(motion, source), source)
    assert one == 1.0
    np.testing.assert_allclose(still, motion, atol=1e-12)


def test_nearest_rotation_has_no_mirror() -> None:
    rotation = rigid.rotation_exp(np.array([0.3, 0.2, -0.5]))
    np.testing.assert_allclose(rigid.nearest_rotation(1.1 * rotation), rotation, atol=1e-14)
    assert np.linalg.det(rigid.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)
