"""Pose from surveyed points, each with its own uncertainty in space and in the picture.

Start: LO-RANSAC over P3P (COLMAP). Then least squares on residuals whitened by
``S_i = sigma_px_i^2 I + sigma_m_i^2 J_i J_i^T`` (J_i: derivative of the picture by the point): to first order the same
minimum as with every point as an unknown held by its survey (Triggs et al. 2000, section 6.1, points eliminated). The
points' mean is taken off before and added to the position after, so that coordinates of a national grid keep their
millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.camera.lens import project, project_jacobians
from pipeline.camera.resection import (
    GATE,
    GATE_POINTS,
    Evaluated,
    Resection,
    descend,
    is_planar,
    planar_candidates,
    pose_covariance,
    residuals_and_jacobian,
    widened,
)
from pipeline.camera.rigid import camera_points, difference
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

WIDEST_PX = (4.0, 16.0, 64.0)  # tried in turn: how far a point may be off and still agree with a pose
FEWEST_AGREEING = 0.6  # of the points, before a wider threshold is tried


@dataclass(frozen=True)
class Surveyed:
    """Best pose, the second one of coplanar points, their ambiguity, and which points (N,) agree."""

    best: Resection
    second: Resection | None
    ambiguity: float
    agrees: np.ndarray


def resect_points(
    camera: Camera, world_m: np.ndarray, px: np.ndarray, sigma_px: np.ndarray, sigma_m: np.ndarray
) -> Surveyed:
    """Pose of points (N, 3) m seen at (N, 2) px, with standard uncertainties (N,) of each coordinate.

    Raises NumericalError for fewer than four points, points on a line, or none that agree.
    """
    from pipeline.camera.colmap_bridge import pose_of_points

    if len(world_m) < 4:
        is_planar(world_m)
    offset = world_m.mean(0)
    local = world_m - offset
    is_planar(local)  # refuses points on a line

    def agreeing(pose: np.ndarray, gate: np.ndarray | float) -> np.ndarray:
        off = _whitened(camera, pose, local, px, sigma_px, sigma_m)[0]
        distance = np.hypot(*off.T)
        return np.where(np.isfinite(distance), distance, np.inf) <= gate

    for widest in WIDEST_PX:
        threshold = max(widest, 20 * float(np.median(sigma_px)))
        try:
            start = pose_of_points(camera, local, px, threshold)
        except NumericalError:
            if widest == WIDEST_PX[-1] or not np.any(sigma_m):
                raise
            continue
        distance = np.hypot(*(project(camera, camera_points(start, local)[0]) - px).T)
        agrees = np.where(np.isfinite(distance), distance, np.inf) <= threshold
        if agrees.mean() >= FEWEST_AGREEING or not np.any(sigma_m):
            break
    planar = is_planar(local[agrees])
    starts = planar_candidates(camera, local[agrees], px[agrees]) if planar else [start]
    for _ in range(2 if np.any(sigma_m) or agrees.sum() >= GATE_POINTS else 0):
        pose = _fit(camera, starts[0], local[agrees], px[agrees], sigma_px[agrees], sigma_m[agrees]).world_from_camera
        agrees = agreeing(pose, GATE * max(1.0, _scale(camera, pose, local, px, sigma_px, sigma_m, agrees)))
        starts = [pose, *starts[1:]]

    def fit(begin: np.ndarray) -> Resection:
        return _fit(camera, begin, local[agrees], px[agrees], sigma_px[agrees], sigma_m[agrees])

    ways = sorted((fit(begin) for begin in starts), key=lambda way: way.chi2)
    best, second, ambiguity = ways[0], None, np.inf
    if len(ways) > 1:
        apart = difference(ways[1].world_from_camera, best.world_from_camera)
        if apart @ np.linalg.solve(best.covariance, apart) >= 1:
            freedom = max(2 * int(agrees.sum()) - 6, 1)
            second, ambiguity = ways[1], float(ways[1].chi2 / max(best.chi2, freedom))
    if planar:
        best = widened(camera, local[agrees], best)
    return Surveyed(_shifted(best, offset), None if second is None else _shifted(second, offset), ambiguity, agrees)


def _shifted(found: Resection, offset: np.ndarray) -> Resection:
    pose = found.world_from_camera.copy()
    pose[:3, 3] += offset
    return replace(found, world_from_camera=pose)


def _whitened(
    camera: Camera, pose: np.ndarray, local: np.ndarray, px: np.ndarray, sigma_px: np.ndarray, sigma_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, 2) in units of their own sigma, and what whitens them (N, 2, 2)."""
    points, _ = camera_points(pose, local)
    predicted, by_point, _ = project_jacobians(camera, points)
    spread = sigma_px[:, None, None] ** 2 * np.eye(2)
    spread = spread + sigma_m[:, None, None] ** 2 * by_point @ by_point.transpose(0, 2, 1)
    finite = np.isfinite(spread).all((1, 2))
    whiten = np.linalg.inv(np.linalg.cholesky(np.where(finite[:, None, None], spread, np.eye(2))))
    whiten[~finite] = np.nan
    return (whiten @ (px - predicted)[:, :, None])[..., 0], whiten


def _scale(
    camera: Camera, pose: np.ndarray, local: np.ndarray, px: np.ndarray, sigma_px: np.ndarray, sigma_m: np.ndarray,
    chosen: np.ndarray,
) -> float:  # fmt: skip
    """How many times the stated uncertainties the residuals are, robustly."""
    off = _whitened(camera, pose, local[chosen], px[chosen], sigma_px[chosen], sigma_m[chosen])[0]
    return float(1.4826 * np.median(np.abs(off)))


def _fit(
    camera: Camera, start: np.ndarray, local: np.ndarray, px: np.ndarray, sigma_px: np.ndarray, sigma_m: np.ndarray
) -> Resection:
    """Whitened least squares from a start; covariance times the larger of 1 and chi2 per degree of freedom."""
    pose = start
    for _ in range(3):  # the points' part of the weights moves with the pose, little
        _, whiten = _whitened(camera, pose, local, px, sigma_px, sigma_m)
        pose = descend(partial(_equations, camera, local, px, whiten), pose)
    residuals, jacobian, lens = _terms(camera, local, px, whiten, pose)
    chi2 = float((residuals**2).sum())
    factor = max(1.0, chi2 / max(2 * len(px) - 6, 1))
    by_noise, by_lens, with_lens = pose_covariance(jacobian, lens, camera.covariance)
    noise = factor * by_noise
    plain = residuals_and_jacobian(camera, pose, local, px)[0]
    sigma = float(np.sqrt(factor) * np.sqrt(np.mean(np.linalg.inv(whiten).transpose(0, 2, 1)[:, [0, 1], [0, 1]] ** 2)))
    kept = np.ones(len(px), bool)
    return Resection(pose, noise + by_lens, noise, with_lens, plain, kept, sigma, chi2)


def _terms(
    camera: Camera, local: np.ndarray, px: np.ndarray, whiten: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    residuals, by_pose, by_lens = residuals_and_jacobian(camera, pose, local, px)
    return (whiten @ residuals[:, :, None])[..., 0], whiten @ by_pose, whiten @ by_lens


def _equations(camera: Camera, local: np.ndarray, px: np.ndarray, whiten: np.ndarray, pose: np.ndarray) -> Evaluated:
    residuals, jacobian, _ = _terms(camera, local, px, whiten, pose)
    cost, flat = float((residuals**2).sum()), jacobian.reshape(-1, 6)
    return cost if np.isfinite(cost) else np.inf, flat.T @ flat, flat.T @ residuals.ravel()
