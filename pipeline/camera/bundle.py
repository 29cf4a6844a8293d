"""Joint adjustment of cameras, poses, a cloud of points and markers of known size: one least squares, one covariance.

Residuals (`reprojection`): where the tracks of the cloud are seen, and the corners of the markers in every view that
shows them. Unknown: a lens per body, a pose per photograph, every point, and the place of every marker but the first,
which is the world frame (metres, +Y its normal). Gauss-Newton with Levenberg's damping (`normal_equations`). Tracks are
robust (Huber), and tracks and corners have a noise of their own each, estimated from the residuals: a similarity that
fits the finished cloud to the markers has neither, and leaves the cloud's own bending in the pose.

The covariance of the poses is that of what is estimated here. A lens that is held is carried by its derivative, as in
`resection`; a lens that is estimated is in the system.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.adjustment import lens_vector, with_lens
from pipeline.camera.normal_equations import (
    HUBER,
    Layout,
    Problem,
    marker_equations,
    posed,
    reduced,
    system_of,
    weights,
)
from pipeline.camera.reprojection import Bundle, derivatives, residuals_of
from pipeline.camera.rigid import perturb
from pipeline.run.errors import NumericalError

GATE = 5.0  # and tracks' sightings beyond it are left out before the last steps
STEPS = 40
FEWEST_SIGHTINGS = 20
CORNER_FLOOR_PX, TRACK_FLOOR_PX = 0.02, 0.05  # no better than the methods that measure them


@dataclass(frozen=True)
class Adjusted:
    """The adjusted bundle with its noise and covariances.

    ``pose_covariance``: (N, 6, 6) without the held lenses' part; ``by_lens``: N of (6, L), the pose's derivative by
    the lens of that view, held; ``lens_covariance``: (L, L) of each estimated lens; ``marker_covariance``: (J, 6, 6).
    """

    bundle: Bundle
    track_sigma_px: float
    corner_sigma_px: float
    used: np.ndarray  # (K,) bool: sightings that were not left out
    pose_covariance: np.ndarray
    by_lens: list[np.ndarray]
    lens_covariance: list[np.ndarray]
    marker_covariance: np.ndarray
    deviance: float  # robust cost in units of the noise, for comparing models on the same sightings


def adjust(
    bundle: Bundle, free: list[np.ndarray] | None = None, prior: list[np.ndarray] | None = None,
    hold_first: bool = False, corner_sigma_px: float | None = None,
    like: Adjusted | None = None,
) -> Adjusted:  # fmt: skip
    """Least squares from a start.

    Args:
        bundle: start and measurements; without a cloud (M = K = 0) the markers alone hold the views together.
        free: (L, k) for each lens: what of it moves (`adjustment.free_columns`); None holds all.
        prior: (L,) standard uncertainty of each lens's start; infinite where nothing is known.
        hold_first: hold the first pose and the distance of the farthest other: for a cloud without markers.
        corner_sigma_px: of a marker's corner; estimated when None and there are enough of them.
        like: take noise and outliers from this fit of the same sightings, so that two models can be compared.

    Raises NumericalError when the sightings do not fix the unknowns.
    """
    if len(bundle.px) < FEWEST_SIGHTINGS and not (bundle.corners and not len(bundle.px)):
        raise NumericalError(
            f"bundle: {len(bundle.px)} sightings of the cloud, needed {FEWEST_SIGHTINGS}; photograph more overlap"
        )
    if not bundle.corners and not hold_first:
        raise NumericalError("bundle: nothing fixes metre and frame, needed markers in two views; photograph a marker")
    problem = posed(bundle, free, prior, hold_first)
    used = (np.bincount(bundle.seen_point, minlength=len(bundle.points)) > 1)[bundle.seen_point]
    sigma = (1.0, corner_sigma_px or 0.1)
    if like is not None:
        return _finish(bundle, problem, like.used, (like.track_sigma_px, like.corner_sigma_px))
    for _ in range(3):  # noise, then outliers, then the fit, until they agree
        bundle = _descend(bundle, problem, used, sigma)
        fixed = _fixed_by_corners(bundle, problem, used, sigma)
        sigma = _noise(bundle, used, corner_sigma_px, problem.layout, fixed)
        distance = np.hypot(*residuals_of(bundle)[: len(bundle.px)].T)
        used = np.where(np.isfinite(distance), distance, np.inf) <= GATE * sigma[0]
        # one sighting does not place a point: its block would be singular, and its rounding would spoil the others'
        used &= (np.bincount(bundle.seen_point[used], minlength=len(bundle.points)) > 1)[bundle.seen_point]
    return _finish(bundle, problem, used, sigma)


def settled(bundle: Bundle, corner_sigma_px: float) -> tuple[Bundle, float]:
    """A bundle without a cloud at its minimum, lenses held, and chi-square of its corners there."""
    none, sigma = np.zeros(0, bool), (1.0, corner_sigma_px)
    found = _descend(bundle, posed(bundle), none, sigma)
    return found, _cost(residuals_of(found), none, sigma)


def _cost(residuals: np.ndarray, used: np.ndarray, sigma: tuple[float, float]) -> float:
    """Huber's cost, doubled: chi-square where nothing is far off; infinite when a used sighting leaves its lens."""
    count = len(used)
    size = np.hypot(*residuals.T)
    size[:count] = np.where(used, size[:count], 0)
    scaled = size / np.where(np.arange(len(size)) < count, sigma[0], sigma[1])
    far = (scaled > HUBER) & (np.arange(len(size)) < count)
    cost = float(np.where(far, HUBER * (2 * scaled - HUBER), scaled**2).sum())
    return cost if np.isfinite(cost) else np.inf


def _penalty(bundle: Bundle, problem: Problem) -> float:
    return sum(
        float((((lens_vector(camera) - lens_vector(first)) / sigma)[np.isfinite(sigma)] ** 2).sum())
        for camera, first, sigma in zip(bundle.cameras, problem.start.cameras, problem.priors, strict=True)
    )


def _moved(bundle: Bundle, layout: Layout, step: np.ndarray, points: np.ndarray) -> Bundle:
    """The bundle after a step of the reduced unknowns (n,) and the points (M, 3)."""
    cameras = [
        with_lens(camera, lens_vector(camera) + columns @ step[at : at + columns.shape[1]])
        for camera, columns, at in zip(bundle.cameras, layout.lens, layout.lens_at, strict=True)
    ]
    poses = [
        pose if at < 0 else perturb(pose, step[at : at + 6])
        for pose, at in zip(bundle.poses, layout.pose_at, strict=True)
    ]
    markers = [
        marker if at < 0 else perturb(marker, step[at : at + 6])
        for marker, at in zip(bundle.markers, layout.marker_at, strict=True)
    ]
    return replace(bundle, cameras=cameras, poses=poses, markers=markers, points=bundle.points + points)


def _descend(bundle: Bundle, problem: Problem, used: np.ndarray, sigma: tuple[float, float]) -> Bundle:
    """Levenberg-Marquardt at a given noise; a start that already is the minimum comes back."""
    damping = 1e-6
    cost = _cost(residuals_of(bundle), used, sigma) + _penalty(bundle, problem)
    system = system_of(bundle, problem, used, sigma)
    for _ in range(STEPS):
        matrix, right, inverse = reduced(system, damping)
        try:
            step = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            damping = max(damping * 10, 1e-8)
            continue
        right = system.points_gradient - np.stack([part.T @ step for part in system.W], -1)
        trial = _moved(bundle, problem.layout, step, np.einsum("mij,mj->mi", inverse, right))
        new = _cost(residuals_of(trial), used, sigma) + _penalty(trial, problem)
        if new <= cost:
            done = cost - new <= 1e-8 * cost
            bundle, cost, damping = trial, new, max(damping * 0.1, 1e-12)
            if done:
                break
            system = system_of(bundle, problem, used, sigma)
        else:
            damping = max(damping, 1e-9) * 10
            if damping > 1e6:
                break
    return bundle


def _fixed_by_corners(bundle: Bundle, problem: Problem, used: np.ndarray, sigma: tuple[float, float]) -> float:
    """How many unknowns the markers' corners settle, beside the tracks, at a given noise.

    The trace of their part of the normal matrix over the whole (Foerstner 1979, variance components): corners are few
    and sharp, so they take more of the poses than their number says, and their residuals are smaller for it.
    """
    terms = derivatives(bundle)
    own, _ = marker_equations(terms, weights(terms, used, sigma), bundle, problem.layout)
    matrix, _, _ = reduced(system_of(bundle, problem, used, sigma), 1e-9)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scale = np.outer(size, size)
    # least squares: where nothing fixes an unknown, `_finish` says so
    return float(np.trace(np.linalg.lstsq(matrix / scale, own / scale, rcond=None)[0]))


def _noise(
    bundle: Bundle, used: np.ndarray, corner_sigma_px: float | None, layout: Layout, fixed: float
) -> tuple[float, float]:
    """Standard deviation of a coordinate of the tracks and of the corners, by the redundancy of each.

    A point seen n times leaves 2 n - 3 of its 2 n coordinates, so that its residuals are smaller than the noise by
    their own factor; of the other unknowns ``fixed`` are taken from the corners, the rest from the tracks.
    """
    residuals = residuals_of(bundle)
    count = len(used)
    seen = np.bincount(bundle.seen_point[used], minlength=len(bundle.points))
    spread = 0.0
    if used.any():
        track = residuals[:count][used] / np.sqrt(1 - 1.5 / seen[bundle.seen_point[used]])[:, None]
        spare = 2 * used.sum() - 3 * (seen > 0).sum()
        freedom = max(1 - (layout.size - fixed) / max(spare, 1), 0.05)
        spread = float(1.4826 * np.median(np.abs(track))) / np.sqrt(freedom)
    corners = residuals[count:]
    if corner_sigma_px is not None or len(corners) < 12:
        return max(spread, TRACK_FLOOR_PX), corner_sigma_px or 0.1
    measured = float(np.sqrt((corners**2).sum() / max(corners.size - fixed, 6)))
    return max(spread, TRACK_FLOOR_PX), max(measured, CORNER_FLOOR_PX)


def _finish(bundle: Bundle, problem: Problem, used: np.ndarray, sigma: tuple[float, float]) -> Adjusted:
    """Covariances at the minimum, and the poses' derivatives by lenses that are held."""
    bundle = _descend(bundle, problem, used, sigma)
    matrix, _, _ = reduced(system_of(bundle, problem, used, sigma), 0.0)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < 1e-13:
        raise NumericalError(
            "bundle: the photographs and markers do not fix the poses, needed markers in at least two views and "
            "overlap between all; photograph from more sides"
        )
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale)
    poses, markers = (
        np.array([covariance[a : a + 6, a : a + 6] if a >= 0 else np.zeros((6, 6)) for a in at]).reshape(-1, 6, 6)
        for at in (problem.layout.pose_at, problem.layout.marker_at)
    )
    lenses = []
    for columns, at in zip(problem.layout.lens, problem.layout.lens_at, strict=True):
        part = covariance[at : at + columns.shape[1], at : at + columns.shape[1]]
        lenses.append(columns @ part @ columns.T)
    by_lens = _by_lens(bundle, problem.anchor is not None, used, sigma)
    deviance = _cost(residuals_of(bundle), used, sigma)
    return Adjusted(bundle, *sigma, used, poses, by_lens, lenses, markers, deviance)


def _by_lens(bundle: Bundle, hold_first: bool, used: np.ndarray, sigma: tuple[float, float]) -> list[np.ndarray]:
    """N of (6, L): how each pose answers when its own lens is moved and all else adjusts again: -S_pp^-1 S_pl."""
    sizes = [len(lens_vector(camera)) for camera in bundle.cameras]
    answer = [np.zeros((6, sizes[number])) for number in bundle.camera_of]
    for number in range(len(bundle.cameras)):
        size = sizes[number]
        free = [np.eye(size) if n == number else np.zeros((other, 0)) for n, other in enumerate(sizes)]
        problem = posed(bundle, free, hold_first=hold_first)
        matrix, _, _ = reduced(system_of(bundle, problem, used, sigma), 0.0)
        moved = -np.linalg.solve(matrix[size:, size:], matrix[size:, :size])
        for view, at in enumerate(problem.layout.pose_at):
            if at >= 0 and bundle.camera_of[view] == number:
                answer[view] = moved[at - size : at - size + 6]
    return answer
