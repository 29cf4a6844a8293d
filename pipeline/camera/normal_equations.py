"""Normal equations of the joint adjustment: which unknown stands where, robust weights, blocks, points eliminated.

The points, three unknowns each, are eliminated by Schur's complement (Triggs, McLauchlan, Hartley, Fitzgibbon 2000,
section 6.1). The markers' corners are few: their Jacobian is written out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.adjustment import lens_vector
from pipeline.camera.reprojection import Bundle, Terms, derivatives

HUBER = 2.0  # of a track's sigma: residuals beyond it lose weight


Anchor = tuple[int, np.ndarray, float]  # view, direction, weight: holds the distance of a cloud without markers


@dataclass(frozen=True)
class Layout:
    """Where each unknown but the points stands in the reduced system."""

    lens: list[np.ndarray]  # (L, k) free columns of each lens
    lens_at: list[int]
    pose_at: np.ndarray  # (N,), -1 when held
    marker_at: np.ndarray
    size: int


@dataclass(frozen=True)
class Problem:
    """What is asked of a bundle whatever its values are: what moves, and what is known of the lenses at its start.

    ``priors``: (L,) standard uncertainty of each lens of ``start``; infinite where nothing is known.
    """

    start: Bundle
    layout: Layout
    priors: list[np.ndarray]
    anchor: Anchor | None = None


@dataclass(frozen=True)
class System:
    """Normal equations: U (n, n) of all but the points, V (M, 3, 3) of these, W (3, n, M) between; both gradients."""

    U: np.ndarray
    gradient: np.ndarray  # (n,)
    V: np.ndarray
    points_gradient: np.ndarray  # (M, 3)
    W: np.ndarray


def posed(
    bundle: Bundle, free: list[np.ndarray] | None = None, priors: list[np.ndarray] | None = None,
    hold_first: bool = False,
) -> Problem:  # fmt: skip
    """The problem of a start, with columns ``free`` (L, k) of each lens moving, and priors; None: none, and unknown."""
    sizes = [len(lens_vector(camera)) for camera in bundle.cameras]
    layout = _layout(bundle, free or [np.zeros((size, 0)) for size in sizes], hold_first)
    known = priors or [np.full(size, np.inf) for size in sizes]
    return Problem(bundle, layout, known, _anchor(bundle) if hold_first else None)


def _layout(bundle: Bundle, free: list[np.ndarray], hold_first: bool) -> Layout:
    at, lens_at = 0, []
    for columns in free:
        lens_at.append(at)
        at += columns.shape[1]
    pose_at = np.full(len(bundle.poses), -1)
    for view in range(len(bundle.poses)):
        if not (hold_first and view == 0):
            pose_at[view] = at
            at += 6
    marker_at = np.full(len(bundle.markers), -1)
    for marker in range(1, len(bundle.markers)):
        marker_at[marker] = at
        at += 6
    return Layout(free, lens_at, pose_at, marker_at, at)


def _anchor(bundle: Bundle) -> Anchor:
    """The view farthest from the first, the direction to it, and the weight that holds its distance."""
    apart = np.array([pose[:3, 3] - bundle.poses[0][:3, 3] for pose in bundle.poses])
    far = int(np.argmax((apart**2).sum(-1)))
    distance = float(np.linalg.norm(apart[far]))
    return far, apart[far] / distance, 1e8 / distance**2


def weights(terms: Terms, used: np.ndarray, sigma: tuple[float, float]) -> np.ndarray:
    """(K + C,) weight of each sighting: Huber's over its variance, 0 for those left out."""
    count = len(used)
    size = np.hypot(*terms.residuals.T)
    weight = np.full(len(size), 1 / sigma[1] ** 2)
    scaled = np.where(np.isfinite(size[:count]), size[:count], np.inf) / sigma[0]
    weight[:count] = np.where(used & np.isfinite(scaled), np.minimum(1, HUBER / np.maximum(scaled, 1e-12)), 0)
    weight[:count] /= sigma[0] ** 2
    return weight


def system_of(bundle: Bundle, problem: Problem, used: np.ndarray, sigma: tuple[float, float]) -> System:
    """Normal equations at a bundle; ``used`` (K,) sightings of the cloud, ``sigma`` [px] of tracks and corners."""
    terms, layout = derivatives(bundle), problem.layout
    weight = weights(terms, used, sigma)
    count, many = len(used), len(bundle.points)
    U, gradient = marker_equations(terms, weight, bundle, layout)
    root = np.sqrt(weight[:count])
    live = root > 0
    residuals = np.where(live[:, None], terms.residuals[:count], 0) * root[:, None]
    by_pose, by_lens, by_point = (
        np.where(live[:, None, None], part[:count], 0) * root[:, None, None]
        for part in (terms.by_pose, terms.by_lens, terms.by_point)
    )
    turned = by_point.transpose(0, 2, 1)
    V = _summed(turned @ by_point, bundle.seen_point, many)
    points_gradient = _summed((turned @ residuals[..., None])[..., 0], bundle.seen_point, many)
    system = System(U, gradient, V, points_gradient, np.zeros((3, layout.size, many)))
    _add_poses(system, bundle, layout, residuals, by_pose, by_point)
    _add_lenses(system, bundle, layout, residuals, by_pose, by_lens, by_point)
    _add_known(system, bundle, problem)
    return system


def _add_poses(
    system: System, bundle: Bundle, layout: Layout, residuals: np.ndarray, by_pose: np.ndarray, by_point: np.ndarray
) -> None:
    """The poses' blocks, and those between poses and points."""
    pairs, own = by_pose.transpose(0, 2, 1) @ by_point, by_pose.transpose(0, 2, 1)
    blocks = _summed(own @ by_pose, bundle.seen_view, len(bundle.poses))
    slopes = _summed((own @ residuals[..., None])[..., 0], bundle.seen_view, len(bundle.poses))
    for number, at in enumerate(layout.pose_at):
        if at >= 0:
            system.U[at : at + 6, at : at + 6] += blocks[number]
            system.gradient[at : at + 6] += slopes[number]
            mine = bundle.seen_view == number
            # a view shows a point once
            system.W[:, at : at + 6, bundle.seen_point[mine]] = pairs[mine].transpose(2, 1, 0)


def _add_lenses(
    system: System, bundle: Bundle, layout: Layout, residuals: np.ndarray, by_pose: np.ndarray, by_lens: np.ndarray,
    by_point: np.ndarray,
) -> None:  # fmt: skip
    """The blocks of lenses that move, and those between them, poses and points."""
    view, index = bundle.seen_view, bundle.seen_point
    for number, columns in enumerate(layout.lens):
        if not columns.shape[1]:
            continue
        place = slice(layout.lens_at[number], layout.lens_at[number] + columns.shape[1])
        mine = bundle.camera_of[view] == number
        lens = by_lens[mine, :, : len(columns)] @ columns
        turned = lens.transpose(0, 2, 1)
        system.U[place, place] += np.tensordot(lens, lens, ([0, 1], [0, 1]))
        system.gradient[place] += np.tensordot(lens, residuals[mine], ([0, 1], [0, 1]))
        system.W[:, place] = _summed(turned @ by_point[mine], index[mine], len(bundle.points)).transpose(2, 1, 0)
        cross = _summed(turned @ by_pose[mine], view[mine], len(bundle.poses))
        for pose, at in enumerate(layout.pose_at):
            if at >= 0:
                system.U[place, at : at + 6] += cross[pose]
                system.U[at : at + 6, place] += cross[pose].T


def _add_known(system: System, bundle: Bundle, problem: Problem) -> None:
    """What is known of the lenses, and what holds the distance of a cloud without markers."""
    layout = problem.layout
    for number, (columns, known) in enumerate(zip(layout.lens, problem.priors, strict=True)):
        place = slice(layout.lens_at[number], layout.lens_at[number] + columns.shape[1])
        strength = np.where(np.isfinite(known), 1 / np.where(np.isfinite(known), known, 1) ** 2, 0)
        moved = lens_vector(bundle.cameras[number]) - lens_vector(problem.start.cameras[number])
        system.U[place, place] += columns.T @ (strength[:, None] * columns)
        system.gradient[place] -= columns.T @ (strength * moved)
    if problem.anchor is not None:
        far, direction, hold = problem.anchor
        place = slice(layout.pose_at[far] + 3, layout.pose_at[far] + 6)
        system.U[place, place] += hold * np.outer(direction, direction)


def marker_equations(terms: Terms, weight: np.ndarray, bundle: Bundle, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix (n, n) and gradient of the markers' corners, which are few: their Jacobian is written out."""
    first = len(terms.by_point)
    rows = np.arange(len(terms.marker))
    jacobian = np.zeros((len(rows), 2, layout.size))
    view = terms.view[first:]
    for at, part in ((layout.pose_at[view], terms.by_pose[first:]), (layout.marker_at[terms.marker], terms.by_marker)):
        chosen = at >= 0
        for column in range(6):
            jacobian[rows[chosen], :, at[chosen] + column] = part[chosen, :, column]
    for number, columns in enumerate(layout.lens):
        mine = bundle.camera_of[view] == number
        place = slice(layout.lens_at[number], layout.lens_at[number] + columns.shape[1])
        jacobian[mine, :, place] = terms.by_lens[first:][mine, :, : len(columns)] @ columns
    weighted = jacobian * weight[first:, None, None]
    return (
        np.tensordot(weighted, jacobian, ([0, 1], [0, 1])),
        np.tensordot(weighted, terms.residuals[first:], ([0, 1], [0, 1])),
    )


def reduced(system: System, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reduced normal matrix and right side with the points eliminated, and the points' inverse blocks."""
    U, V, W = system.U, system.V, system.W
    trace = np.trace(V, axis1=1, axis2=2)
    lifted = V + (damping * trace[:, None, None] + np.where(trace > 0, 1e-12 * trace, 1.0)[:, None, None]) * np.eye(3)
    inverse = np.linalg.inv(lifted)
    half = np.linalg.cholesky(inverse)
    coupled = [sum(W[i] * half[:, i, j] for i in range(3)) for j in range(3)]
    turned = np.einsum("mij,mi->jm", half, system.points_gradient)
    matrix = U + damping * np.diag(np.diag(U)) - sum(part @ part.T for part in coupled)
    return matrix, system.gradient - sum(part @ one for part, one in zip(coupled, turned)), inverse


def _summed(values: np.ndarray, index: np.ndarray, size: int) -> np.ndarray:
    """Sums (size, ...) of values (K, ...) by index (K,)."""
    order = np.argsort(index, kind="stable")
    first = np.flatnonzero(np.diff(index[order], prepend=-1))
    total = np.zeros((size, *values.shape[1:]))
    if len(first):
        total[index[order][first]] = np.add.reduceat(values[order], first, axis=0)
    return total
