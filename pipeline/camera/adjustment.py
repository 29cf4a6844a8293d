"""Joint adjustment of one lens and the poses of its board photographs, with the lens's covariance.

Gauss-Newton with Levenberg's damping on the reprojection error; the poses are eliminated by Schur's complement. Which
of the lens's numbers are free is a matrix, so that one focal length for both axes is a column, not a case. Terms that
are left out are no zeros known for sure: what they may be, and what the fitted numbers took up of them, is a covariance
of its own (considered parameters: Schmidt, "Application of state-space methods to navigation problems", 1966).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.camera.distortion import TERMS, model_of
from pipeline.camera.lens import project_jacobians
from pipeline.camera.rigid import camera_points, perturb
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

FRAME = ("fx", "fy", "cx", "cy")  # what every lens has, before the coefficients of its distortion


@dataclass(frozen=True)
class Adjustment:
    """The lens with covariance, poses (4, 4) and residuals (N_i, 2) px of each photograph, sigma of a coordinate."""

    camera: Camera
    poses: list[np.ndarray]
    residuals_px: list[np.ndarray]
    sigma_px: float

    @property
    def rms_px(self) -> float:
        """Root mean square distance over all corners."""
        return float(np.sqrt((np.concatenate(self.residuals_px) ** 2).sum(-1).mean()))


def free_columns(terms: tuple[str, ...], one_focal: bool, count: int = 5) -> np.ndarray:
    """(L, K) matrix of what moves: the focal length(s), the principal point and the named terms of distortion.

    ``count`` of the coefficients tells the model (`pipeline/camera/distortion.py`).
    """
    names = FRAME + TERMS[count]
    each = np.eye(len(names))
    columns = [each[:, [0, 1]].sum(1)] if one_focal else [each[:, 0], each[:, 1]]
    return np.stack([*columns, *(each[:, names.index(term)] for term in ("cx", "cy", *terms))], -1)


def lens_vector(camera: Camera) -> np.ndarray:
    """(L,) fx fy cx cy and the coefficients of distortion."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def with_lens(camera: Camera, lens: np.ndarray) -> Camera:
    """The camera with other numbers (L,)."""
    fx, fy, cx, cy = (float(v) for v in lens[:4])
    return camera.model_copy(update={"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": np.array(lens[4:])})


def adjust(
    camera: Camera, poses: list[np.ndarray], world_m: list[np.ndarray], px: list[np.ndarray], free: np.ndarray
) -> Adjustment:
    """Least squares from a start. Terms outside ``free`` keep their start value.

    Raises NumericalError when the photographs do not fix the free terms.
    """
    damping, cost = 1e-6, np.inf
    lens, state = lens_vector(camera), list(poses)
    system = _normal_equations(camera, state, world_m, px, free)
    for _ in range(60):
        lens_step, pose_steps = _step(*system[:3], system[3], damping)
        candidate = with_lens(camera, lens + free @ lens_step)
        moved = [perturb(pose, step) for pose, step in zip(state, pose_steps, strict=True)]
        trial = _normal_equations(candidate, moved, world_m, px, free)
        cost = system[4]
        if np.isfinite(trial[4]) and trial[4] <= cost:
            camera, state, system, lens = candidate, moved, trial, lens_vector(candidate)
            damping = max(damping * 0.1, 1e-12)
            if cost - trial[4] <= 1e-10 * cost + 1e-18:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return _finish(camera, state, world_m, px, free, system)


def considered(
    found: Adjustment,
    world_m: list[np.ndarray],
    px: list[np.ndarray],
    free: np.ndarray,
    left_out: np.ndarray,
    sigma: np.ndarray,
) -> np.ndarray:
    """(L, L) covariance of the lens that its left-out terms add, after a fit of the ``free`` columns (L, K).

    ``left_out`` (L, M): columns of terms that stayed zero; ``sigma`` (M,): what lenses have of them. With the reduced
    normal equations H of both, a term p moves what was fitted by A p, A = H_ff^-1 H_fp, and is itself off by -p. What p
    may be is its second moment once the photographs have spoken: their score at zero and H_pp - H_pf A, with the prior.
    """
    both = np.concatenate([free, left_out], 1)
    lens_lens, cross, pose_pose, gradients, _ = _normal_equations(found.camera, found.poses, world_m, px, both)
    reduced, right = lens_lens.copy(), gradients[0].copy()
    for c, p, g in zip(cross, pose_pose, gradients[1], strict=True):
        reduced -= c @ np.linalg.solve(p, c.T)
        right -= c @ np.linalg.solve(p, g)
    kept = free.shape[1]
    taken_up = np.linalg.solve(reduced[:kept, :kept], reduced[:kept, kept:])
    information = reduced[kept:, kept:] - reduced[kept:, :kept] @ taken_up
    score = right[kept:] - taken_up.T @ right[:kept]
    variance = np.linalg.inv(information / found.sigma_px**2 + np.diag(sigma**-2))
    mean = variance @ score / found.sigma_px**2
    moved = free @ taken_up - left_out
    covariance = moved @ (variance + np.outer(mean, mean)) @ moved.T
    return np.asarray((covariance + covariance.T) / 2)


_System = tuple[np.ndarray, list[np.ndarray], list[np.ndarray], tuple[np.ndarray, list[np.ndarray]], float]


def _normal_equations(
    camera: Camera, poses: list[np.ndarray], world_m: list[np.ndarray], px: list[np.ndarray], free: np.ndarray
) -> _System:
    """Blocks of J^T J (lens, lens-pose, pose), the gradients, and the cost (inf when a point leaves the lens)."""
    lens_lens = np.zeros((free.shape[1], free.shape[1]))
    lens_gradient = np.zeros(free.shape[1])
    cross, pose_pose, pose_gradient, cost = [], [], [], 0.0
    for residuals, by_pose, by_lens in _linearised(camera, poses, world_m, px):
        flat, lens, r = by_pose.reshape(-1, 6), np.concatenate(by_lens) @ free, residuals.ravel()
        lens_lens += lens.T @ lens
        lens_gradient += lens.T @ r
        cross.append(lens.T @ flat)
        pose_pose.append(flat.T @ flat)
        pose_gradient.append(flat.T @ r)
        cost += float(r @ r)
    return lens_lens, cross, pose_pose, (lens_gradient, pose_gradient), cost if np.isfinite(cost) else np.inf


def _linearised(
    camera: Camera, poses: list[np.ndarray], world_m: list[np.ndarray], px: list[np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`residuals_and_jacobian` of each photograph; the lens is asked once for all, as each is a few dozen points."""
    placed = [camera_points(pose, points) for pose, points in zip(poses, world_m, strict=True)]
    predicted, by_point, by_lens = project_jacobians(camera, np.concatenate([points for points, _ in placed]))
    by_pose = by_point @ np.concatenate([derivative for _, derivative in placed])
    end = 0
    for seen in px:
        start, end = end, end + len(seen)
        yield seen - predicted[start:end], by_pose[start:end], by_lens[start:end]


def _damped(block: np.ndarray, damping: float) -> np.ndarray:
    return block + damping * np.diag(np.diag(block))


def _step(
    lens_lens: np.ndarray,
    cross: list[np.ndarray],
    pose_pose: list[np.ndarray],
    gradients: tuple[np.ndarray, list[np.ndarray]],
    damping: float,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Damped step of the lens terms and of every pose."""
    lens_gradient, pose_gradient = gradients
    reduced, right = _damped(lens_lens, damping), lens_gradient.copy()
    solved = []
    for c, p, g in zip(cross, pose_pose, pose_gradient, strict=True):
        answer = np.linalg.solve(_damped(p, damping), np.column_stack([c.T, g]))
        reduced = reduced - c @ answer[:, :-1]
        right = right - c @ answer[:, -1]
        solved.append(answer)
    lens_step = np.linalg.solve(reduced, right)
    return lens_step, [answer[:, -1] - answer[:, :-1] @ lens_step for answer in solved]


def _finish(
    camera: Camera,
    poses: list[np.ndarray],
    world_m: list[np.ndarray],
    px: list[np.ndarray],
    free: np.ndarray,
    system: _System,
) -> Adjustment:
    """Residuals and the covariance, scaled by chi2 per degree of freedom."""
    lens_lens, cross, pose_pose, _, cost = system
    if not np.isfinite(cost):
        raise NumericalError(
            f"calibrate: no lens of the {model_of(camera.distortion)} model images all corners of {len(poses)} board "
            "photographs, needed one that does; check squares and square_m of [board]"
        )
    residuals = [item[0] for item in _linearised(camera, poses, world_m, px)]
    reduced = lens_lens - sum(c @ np.linalg.solve(p, c.T) for c, p in zip(cross, pose_pose, strict=True))
    scale = np.sqrt(np.maximum(np.diag(lens_lens), 1e-300))
    scaled = reduced / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < 1e-12:
        raise NumericalError(
            f"calibrate: {len(poses)} board photographs do not fix the lens, needed different tilts; take some "
            "with the board tilted 30 to 45 degrees in several directions"
        )
    freedom = max(2 * sum(len(r) for r in residuals) - free.shape[1] - 6 * len(poses), 1)
    sigma = float(np.sqrt(cost / freedom))
    covariance = free @ (sigma**2 * np.linalg.inv(scaled) / np.outer(scale, scale)) @ free.T
    rms = float(np.sqrt(cost / sum(len(r) for r in residuals)))
    done = camera.model_copy(update={"covariance": (covariance + covariance.T) / 2, "rms_px": rms})
    return Adjustment(done, poses, residuals, sigma)
