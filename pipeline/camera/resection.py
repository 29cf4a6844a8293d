"""Pose of one calibrated photograph from points of known position: robust refinement, covariance, planar ambiguity.

Minimises the reprojection error through the lens (no undistorted copies of the data) by Levenberg-Marquardt with
analytic derivatives. A plane has two poses that explain it almost equally well (Collins and Bartoli 2014, IPPE); both
are refined and compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.lens import project_jacobians, unproject
from pipeline.camera.rigid import camera_points, difference, perturb, plane_frame, rotation_exp
from pipeline.conventions import invert_rigid
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

HUBER = 2.0  # residuals beyond this many sigma lose weight while searching
GATE = 5.0  # and beyond this many are left out of the final fit
GATE_POINTS = 8  # with fewer points an outlier cannot be told from a bad pose
FRONTAL = 3.0  # tilts below this many of their own sigma (seen squarely) are not Gaussian
TELLING = 13  # corners of a board, from which their residuals tell their noise better than a rule does
SHARED_PX = 0.005  # of a corner's error that all corners of a picture may have in common: blur, tone curve, paper
FLAT = 1e-3  # points whose least extent is below this fraction of the largest are one plane


@dataclass(frozen=True)
class Resection:
    """A refined pose (4, 4), covariances (6, 6), covariance with the lens (6, L), residuals (N, 2) px."""

    world_from_camera: np.ndarray
    covariance: np.ndarray
    noise_covariance: np.ndarray  # the part of it that the corners' noise makes
    lens_covariance: np.ndarray
    residuals_px: np.ndarray
    kept: np.ndarray  # (N,) bool
    sigma_px: float  # uncertainty of one coordinate that the covariance assumes
    chi2: float  # of the kept residuals in units of the stated corner sigma
    frontal: bool = False  # the plane is seen so squarely that its tilt is hardly known; the covariance is widened

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the kept points."""
        return float(np.sqrt((self.residuals_px[self.kept] ** 2).sum(-1).mean()))


def residuals_and_jacobian(
    camera: Camera, pose: np.ndarray, world_points: np.ndarray, px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (N, 2) measured - predicted, derivative of the prediction by the pose (N, 2, 6) and lens (N, 2, L)."""
    points, by_pose = camera_points(pose, world_points)
    predicted, by_point, by_lens = project_jacobians(camera, points)
    return px - predicted, by_point @ by_pose, by_lens


def robust_scale(residuals: np.ndarray) -> float:
    """Standard deviation of one coordinate from the median absolute residual."""
    return float(1.4826 * np.median(np.abs(residuals)))


Evaluated = tuple[float, np.ndarray, np.ndarray]  # cost, normal matrix (6, 6), gradient (6,)


def descend(evaluate: Callable[[np.ndarray], Evaluated], pose: np.ndarray, tolerance: float = 1e-12) -> np.ndarray:
    """Levenberg-Marquardt on a pose (4, 4) until a step gains less than ``tolerance`` of the cost.

    Returns the pose; a start that fits nothing (infinite cost) comes back.
    """
    damping = 1e-6
    cost, normal, gradient = evaluate(pose)
    if not np.isfinite(cost):
        return pose
    for _ in range(100):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-300), gradient)
        candidate = perturb(pose, step)
        trial = evaluate(candidate)
        if trial[0] <= cost:
            done = cost - trial[0] <= tolerance * cost + 1e-18
            pose, (cost, normal, gradient), damping = candidate, trial, max(damping * 0.1, 1e-12)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return pose


def minimise(
    camera: Camera, pose: np.ndarray, world_points: np.ndarray, px: np.ndarray, huber_px: float = np.inf
) -> np.ndarray:
    """The pose (4, 4) of least Huber cost, from a start that comes back when it fits nothing.

    A search with a finite ``huber_px`` only prepares the gate and ends early.
    """

    def evaluate(candidate: np.ndarray) -> Evaluated:
        residuals, jacobian, _ = residuals_and_jacobian(camera, candidate, world_points, px)
        size = np.maximum(np.hypot(residuals[:, 0], residuals[:, 1]), 1e-300)
        weight = np.minimum(1.0, huber_px / size)
        cost = float((weight * (2 - weight) * size**2).sum())  # Huber's rho, doubled
        flat = (weight[:, None, None] * jacobian).reshape(-1, 6)
        return (
            cost if np.isfinite(cost) else np.inf, flat.T @ jacobian.reshape(-1, 6), flat.T @ residuals.ravel(),
        )  # fmt: skip

    return descend(evaluate, pose, 1e-12 if np.isinf(huber_px) else 1e-5)


def refine(
    camera: Camera,
    start: np.ndarray,
    world_points: np.ndarray,
    px: np.ndarray,
    sigma_px: float,
    kept: np.ndarray | None = None,
    sharp: bool = False,
) -> Resection:
    """Refine a pose (4, 4) on points (N, 3) and pixels (N, 2); without ``kept`` outliers are found here.

    The covariance assumes `corner_noise`, independent between points, and includes the camera's own covariance.
    ``sharp``: the points are X corners of a board. Raises NumericalError when the points do not fix the pose.
    """
    pose = start
    if kept is None:
        kept = np.ones(len(px), bool)
        if len(px) >= GATE_POINTS:
            pose = minimise(camera, start, world_points, px, 10 * HUBER * sigma_px)
            for _ in range(2):
                scale = max(sigma_px, robust_scale(residuals_and_jacobian(camera, pose, world_points, px)[0]))
                pose = minimise(camera, pose, world_points, px, HUBER * scale)
            residuals = residuals_and_jacobian(camera, pose, world_points, px)[0]
            kept = np.hypot(*residuals.T) <= GATE * max(sigma_px, robust_scale(residuals))
    pose = minimise(camera, pose, world_points[kept], px[kept])
    residuals, jacobian, by_lens = residuals_and_jacobian(camera, pose, world_points, px)
    squares = float((residuals[kept] ** 2).sum())
    sigma = corner_noise(squares, int(kept.sum()), sigma_px, sharp)
    by_noise, by_lens_part, with_lens = pose_covariance(jacobian[kept], by_lens[kept], camera.covariance)
    noise = sigma**2 * by_noise
    covariance = noise + by_lens_part
    return Resection(pose, covariance, noise, with_lens, residuals, kept, float(sigma), squares / sigma_px**2)


def corner_noise(squares: float, count: int, sigma_px: float, sharp: bool) -> float:
    """Standard uncertainty of a coordinate, px, from the sum of squared residuals of ``count`` corners.

    The larger of ``sigma_px`` and chi2 per degree of freedom; of X corners (``sharp``) in number what the residuals
    say alone: their variance over the degrees of freedom less two, which makes the Gaussian region of the pose as wide
    as Student's, and what all may have in common, which averaging over them does not lessen.
    """
    freedom = 2 * count - 6
    if sharp and count >= TELLING:
        return float(np.sqrt(squares / (freedom - 2) + count * SHARED_PX**2))
    return float(max(sigma_px, np.sqrt(squares / max(freedom, 1))))


def pose_covariance(
    jacobian: np.ndarray, by_lens: np.ndarray, lens_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariances of a least squares pose: (6, 6) by noise of unit variance, (6, 6) by the lens, (6, L) with the lens.

    ``jacobian`` (N, 2, 6) and ``by_lens`` (N, 2, L) are those of the residuals, whitened where points have weights of
    their own. A lens that is held moves the pose by ``-(J^T J)^-1 J^T L``. Raises NumericalError when the points do not
    fix the pose.
    """
    flat, lens = jacobian.reshape(-1, 6), np.concatenate(by_lens)
    normal = flat.T @ flat
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(size, size)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e13:
        raise NumericalError(
            f"pose: {len(jacobian)} points do not fix six unknowns (collinear or too few), needed points spread over "
            "an area; show more of the board or add points"
        )
    # By QR: the normal matrix has the square of the Jacobian's condition, 1e7 for a board of 40 px seen squarely.
    half = np.linalg.inv(np.linalg.qr(flat / size, mode="r")) / size[:, None]
    inverse = half @ half.T
    moved = -inverse @ flat.T @ lens
    with_lens = moved @ lens_covariance
    by_lens_part = with_lens @ moved.T
    return (inverse + inverse.T) / 2, (by_lens_part + by_lens_part.T) / 2, with_lens


def planar_candidates(camera: Camera, world_points: np.ndarray, px: np.ndarray) -> list[np.ndarray]:
    """Both analytic poses (4, 4) ``world_from_camera`` of coplanar points, best first.

    Raises NumericalError when all but one of the points lie on a line.
    """
    from pipeline.camera.opencv_bridge import planar_poses

    world_from_plane, _ = plane_frame(world_points)
    flat = (world_points - world_from_plane[:3, 3]) @ world_from_plane[:3, :3]
    found = planar_poses(flat[:, :2], unproject(camera, px))
    if not found:  # all but one on a line: no homography
        raise NumericalError(
            f"pose: {len(px)} points, too many of them on one line to tell a plane, needed 4 of which no 3 are; show "
            "more of the board"
        )
    return [world_from_plane @ invert_rigid(pose) for pose in found]


def is_planar(world_points: np.ndarray) -> bool:
    """Whether the points lie in one plane as far as their pose is concerned. Raises NumericalError when collinear."""
    _, extents = plane_frame(world_points)
    if len(world_points) < 4 or extents[1] < 1e-3 * extents[0]:
        raise NumericalError(
            f"pose: {len(world_points)} points on a line or fewer than 4, needed 4 spread over an area; add points"
        )
    return bool(extents[2] < FLAT * extents[0])


def resect_plane(
    camera: Camera, world_points: np.ndarray, px: np.ndarray, sigma_px: float, sharp: bool = False
) -> tuple[Resection, Resection | None, float]:
    """Best pose of coplanar points, the second one (None when both starts meet), and the ambiguity.

    ``sharp``: as in `refine`.

    The ambiguity is chi2 of the second over the larger of chi2 of the first and its degrees of freedom, so that a lucky
    fit of few points does not look decisive. Candidates nearer to each other than their own uncertainty are one pose.
    """
    candidates = [
        refine(camera, start, world_points, px, sigma_px, sharp=sharp)
        for start in planar_candidates(camera, world_points, px)
    ]
    candidates.sort(key=lambda c: robust_cost(c.residuals_px, sigma_px))
    best = candidates[0]
    if len(candidates) == 1:
        return widened(camera, world_points, best), None, np.inf
    second = refine(camera, candidates[1].world_from_camera, world_points, px, sigma_px, best.kept, sharp)
    if second.chi2 < best.chi2:
        best, second = second, refine(camera, best.world_from_camera, world_points, px, sigma_px, best.kept, sharp)
    apart = difference(second.world_from_camera, best.world_from_camera)
    if apart @ np.linalg.solve(best.covariance, apart) < 1:
        return widened(camera, world_points, best), None, np.inf
    freedom = max(2 * int(best.kept.sum()) - 6, 1)
    return widened(camera, world_points, best), second, float(second.chi2 / max(best.chi2, freedom))


def widened(camera: Camera, world_points: np.ndarray, best: Resection) -> Resection:
    """The same pose with an honest covariance when the plane is seen almost squarely; else unchanged.

    Foreshortening tells the tilt only to second order there, and its linearisation at an estimate that noise has tilted
    promises too much. Taken instead: the covariance at the untilted pose, plus the way to the mirrored one.
    """
    pose, centre = best.world_from_camera, world_points.mean(0)
    arm = pose[:3, 3] - centre
    towards = arm / np.linalg.norm(arm)
    normal = plane_frame(world_points)[0][:3, 2]
    normal = normal if normal @ towards > 0 else -normal
    axis = np.cross(towards, normal)
    sine = float(np.linalg.norm(axis))
    tilt = np.arctan2(sine, normal @ towards)
    turn = rotation_exp(axis / max(sine, 1e-300) * tilt)
    square = np.eye(4)
    square[:3, :3], square[:3, 3] = turn @ pose[:3, :3], centre + turn @ arm
    _, jacobian, _ = residuals_and_jacobian(camera, square, world_points, np.zeros((len(world_points), 2)))
    flat = jacobian[best.kept].reshape(-1, 6)
    if not np.isfinite(flat).all():
        return best
    back = np.kron(np.eye(2), turn.T)
    untilted = back @ (best.sigma_px**2 * np.linalg.inv(flat.T @ flat)) @ back.T
    if tilt > FRONTAL * np.sqrt(np.linalg.eigvalsh(untilted[:3, :3])[-1]):
        return best
    mirrored = 2 * difference(square, pose)
    noise = untilted + np.outer(mirrored, mirrored)
    covariance = best.covariance - best.noise_covariance + noise
    return replace(best, covariance=covariance, noise_covariance=noise, frontal=True)


def robust_cost(residuals: np.ndarray, sigma_px: float) -> float:
    """Sum of squared distances in sigma, each bounded by the gate, so that outliers do not choose the branch."""
    squares = (residuals**2).sum(-1) / sigma_px**2
    return float(np.where(np.isfinite(squares), np.minimum(squares, GATE**2), GATE**2).sum())
