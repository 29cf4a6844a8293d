"""Rigid motions as 4x4 matrices, their six-vector perturbations (conventions: rotation in the world, then position)."""

from __future__ import annotations

import numpy as np


def skew(v: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrices with ``skew(v) @ w = v x w``."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def rotation_exp(w: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    K = skew(w)
    if angle < 1e-5:  # the series keeps all digits where sin(a)/a and (1 - cos a)/a^2 would not
        return np.eye(3) + (1 - angle**2 / 6) * K + (0.5 - angle**2 / 24) * K @ K
    return np.eye(3) + np.sin(angle) / angle * K + 2 * (np.sin(angle / 2) / angle) ** 2 * K @ K


def rotation_log(rotation: np.ndarray) -> np.ndarray:
    """Rotation vector (3,), length in [0, pi] rad, of a rotation matrix; by the quaternion, good at 0 and at pi."""
    m = rotation
    # Four forms of 4 q q^T (Shepperd 1978); the row with the largest diagonal has no cancellation.
    rows = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    q = rows[np.argmax(np.diag(rows))]
    q = q / np.linalg.norm(q)
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-12:
        return 2 * q[1:]
    return 2 * np.arctan2(sine, q[0]) * q[1:] / sine


def perturb(world_from_camera: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """The pose (4, 4) moved by delta (6,): ``R' = exp([w]x) R``, ``t' = t + d``."""
    moved = np.eye(4)
    moved[:3, :3] = rotation_exp(delta[:3]) @ world_from_camera[:3, :3]
    moved[:3, 3] = world_from_camera[:3, 3] + delta[3:]
    return moved


def difference(moved: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """The delta (6,) with ``perturb(world_from_camera, delta) = moved``."""
    rotation = moved[:3, :3] @ world_from_camera[:3, :3].T
    return np.concatenate([rotation_log(rotation), moved[:3, 3] - world_from_camera[:3, 3]])


def camera_points(world_from_camera: np.ndarray, world_points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in the camera frame, and their derivative (N, 3, 6) by the pose's perturbation."""
    rotation, arm = world_from_camera[:3, :3], world_points - world_from_camera[:3, 3]
    derivative = np.empty((len(arm), 3, 6))
    derivative[:, :, :3] = rotation.T @ skew(arm)
    derivative[:, :, 3:] = -rotation.T
    return arm @ rotation, derivative


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) closest to a matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def umeyama(target: np.ndarray, source: np.ndarray, scale: bool = False) -> tuple[np.ndarray, float]:
    """Least-squares ``target = s R source + t`` (Umeyama 1991), points (N, 3); coplanar points are fine.

    Returns the 4x4 matrix [sR t] and s (1 without ``scale``).
    """
    target_mean, source_mean = target.mean(0), source.mean(0)
    target_arm, source_arm = target - target_mean, source - source_mean
    u, singular, vt = np.linalg.svd(target_arm.T @ source_arm)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    s = float((singular * sign).sum() / (source_arm**2).sum()) if scale else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = s * rotation
    matrix[:3, 3] = target_mean - s * rotation @ source_mean
    return matrix, s


def plane_frame(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frame (4, 4) ``world_from_plane`` at the centroid with z along the least extent, and the rms extents (3,)."""
    centre = points.mean(0)
    _, singular, vt = np.linalg.svd(points - centre, full_matrices=False)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([vt[0], vt[1], np.cross(vt[0], vt[1])], -1)
    frame[:3, 3] = centre
    return frame, singular / np.sqrt(len(points))
