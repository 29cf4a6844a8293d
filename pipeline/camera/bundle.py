"""Joint adjustment of cameras, poses, a cloud of points and markers of known size: one least squares, one covariance.

Residuals: where the tracks of the cloud are seen, and the corners of the markers in every view that shows them.
Unknown: a lens per body, a pose per photograph, every point, and the place of every marker but the first, which is the
world frame (metres, +Y its normal). Gauss-Newton with Levenberg's damping; the points, three unknowns each, are
eliminated (Triggs, McLauchlan, Hartley, Fitzgibbon 2000, section 6.1). Tracks are robust (Huber), and tracks and
corners have a noise of their own each, estimated from the residuals: a similarity that fits the finished cloud to the
markers has neither, and leaves the cloud's own bending in the pose.

The covariance of the poses is that of what is estimated here. A lens that is held is carried by its derivative, as in
`resection`; a lens that is estimated is in the system.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.camera.adjustment import lens_vector, with_lens
from pipeline.camera.lens import project, project_jacobians
from pipeline.camera.rigid import camera_points, perturb, skew
from pipeline.conventions import transform_points
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

HUBER = 2.0  # of a track's sigma: residuals beyond it lose weight
GATE = 5.0  # and tracks' sightings beyond it are left out before the last steps
STEPS = 40
FEWEST_SIGHTINGS = 20
CORNER_FLOOR_PX, TRACK_FLOOR_PX = 0.02, 0.05  # no better than the methods that measure them


@dataclass(frozen=True)
class Corners:
    """Points of one marker (or board) in one view: numbers of view and marker, place in the marker's frame, pixels."""

    view: int
    marker: int
    points: np.ndarray  # (n, 3), +Y outward
    px: np.ndarray  # (n, 2)


@dataclass(frozen=True)
class Bundle:
    """Everything that is adjusted, and the measurements.

    ``poses``: world_from_camera (4, 4) each; ``camera_of``: (N,) number of each view's lens; ``points``: (M, 3), world;
    ``seen_view``, ``seen_point``: (K,), no pair twice, ``px``: (K, 2); ``markers``: world_from_marker (4, 4) each, the
    first the identity.
    """

    cameras: list[Camera]
    poses: list[np.ndarray]
    camera_of: np.ndarray
    points: np.ndarray
    seen_view: np.ndarray
    seen_point: np.ndarray
    px: np.ndarray
    markers: list[np.ndarray] = field(default_factory=list)
    corners: list[Corners] = field(default_factory=list)


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


@dataclass(frozen=True)
class _Layout:
    """Where each unknown but the points stands in the reduced system."""

    lens: list[np.ndarray]  # (L, k) free columns of each lens
    lens_at: list[int]
    pose_at: np.ndarray  # (N,), -1 when held
    marker_at: np.ndarray
    size: int


@dataclass(frozen=True)
class _Terms:
    """Residuals and derivatives of all sightings, cloud first, corners after them, weighted by their sigma."""

    residuals: np.ndarray  # (K + C, 2) px
    by_pose: np.ndarray  # (.., 2, 6)
    by_lens: np.ndarray  # (.., 2, L) of the longest lens, zero beyond a shorter one's
    by_point: np.ndarray  # (K, 2, 3)
    by_marker: np.ndarray  # (C, 2, 6)
    view: np.ndarray
    marker: np.ndarray  # (C,)


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
    layout = _layout(bundle, free or _held(bundle), hold_first)
    start = bundle
    priors = prior or _unknown(bundle)
    anchor = _anchor(bundle) if hold_first else None
    used = (np.bincount(bundle.seen_point, minlength=len(bundle.points)) > 1)[bundle.seen_point]
    sigma = (1.0, corner_sigma_px or 0.1)
    if like is not None:
        return _finish(bundle, start, layout, priors, anchor, like.used, (like.track_sigma_px, like.corner_sigma_px))
    for _ in range(3):  # noise, then outliers, then the fit, until they agree
        bundle = _descend(bundle, start, layout, priors, anchor, used, sigma)
        fixed = _fixed_by_corners(bundle, start, layout, priors, anchor, used, sigma)
        sigma = _noise(bundle, used, corner_sigma_px, layout, fixed)
        distance = np.hypot(*_residuals(bundle)[: len(bundle.px)].T)
        used = np.where(np.isfinite(distance), distance, np.inf) <= GATE * sigma[0]
        # one sighting does not place a point: its block would be singular, and its rounding would spoil the others'
        used &= (np.bincount(bundle.seen_point[used], minlength=len(bundle.points)) > 1)[bundle.seen_point]
    return _finish(bundle, start, layout, priors, anchor, used, sigma)


def settled(bundle: Bundle, corner_sigma_px: float) -> tuple[Bundle, float]:
    """A bundle without a cloud at its minimum, lenses held, and chi-square of its corners there."""
    none, sigma = np.zeros(0, bool), (1.0, corner_sigma_px)
    layout, priors = _layout(bundle, _held(bundle), False), _unknown(bundle)
    found = _descend(bundle, bundle, layout, priors, None, none, sigma)
    return found, _cost(_residuals(found), none, sigma)


def _layout(bundle: Bundle, free: list[np.ndarray], hold_first: bool) -> _Layout:
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
    return _Layout(free, lens_at, pose_at, marker_at, at)


def _anchor(bundle: Bundle) -> tuple[int, np.ndarray, float]:
    """The view farthest from the first, the direction to it, and the weight that holds its distance."""
    apart = np.array([pose[:3, 3] - bundle.poses[0][:3, 3] for pose in bundle.poses])
    far = int(np.argmax((apart**2).sum(-1)))
    distance = float(np.linalg.norm(apart[far]))
    return far, apart[far] / distance, 1e8 / distance**2


def _terms(bundle: Bundle) -> _Terms:
    """Residuals measured - predicted, and the prediction's derivatives."""
    count, corners = len(bundle.px), bundle.corners
    view = np.concatenate([bundle.seen_view, *(np.full(len(c.px), c.view) for c in corners)]).astype(int)
    marker = np.array([c.marker for c in corners for _ in c.px], int)
    place = [bundle.points[bundle.seen_point]]
    place += [transform_points(bundle.markers[c.marker], c.points) for c in corners]
    world, px = np.concatenate(place), np.concatenate([bundle.px, *(c.px for c in corners)])
    residuals, by_pose = np.empty((len(px), 2)), np.empty((len(px), 2, 6))
    longest = max(len(lens_vector(camera)) for camera in bundle.cameras)
    by_lens, by_world = np.zeros((len(px), 2, longest)), np.empty((len(px), 2, 3))
    for number, pose in enumerate(bundle.poses):
        mine = np.flatnonzero(view == number)
        points, moved = camera_points(pose, world[mine])
        predicted, by_point, lens = project_jacobians(bundle.cameras[bundle.camera_of[number]], points)
        residuals[mine], by_pose[mine] = px[mine] - predicted, by_point @ moved
        by_lens[mine, :, : lens.shape[2]] = lens
        by_world[mine] = by_point @ pose[:3, :3].T
    arm = world[count:] - np.array([bundle.markers[m][:3, 3] for m in marker]).reshape(-1, 3)
    by_motion = np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], -1)
    return _Terms(residuals, by_pose, by_lens, by_world[:count], by_world[count:] @ by_motion, view, marker)


def _residuals(bundle: Bundle) -> np.ndarray:
    """(K + C, 2) measured - predicted, as in `_terms`, without the derivatives."""
    residuals = np.empty((len(bundle.px) + sum(len(c.px) for c in bundle.corners), 2))
    for number, pose in enumerate(bundle.poses):
        camera, mine = bundle.cameras[bundle.camera_of[number]], bundle.seen_view == number
        points = (bundle.points[bundle.seen_point[mine]] - pose[:3, 3]) @ pose[:3, :3]
        residuals[: len(bundle.px)][mine] = bundle.px[mine] - project(camera, points)
    at = len(bundle.px)
    for c in bundle.corners:
        pose, camera = bundle.poses[c.view], bundle.cameras[bundle.camera_of[c.view]]
        points = (transform_points(bundle.markers[c.marker], c.points) - pose[:3, 3]) @ pose[:3, :3]
        residuals[at : at + len(c.px)] = c.px - project(camera, points)
        at += len(c.px)
    return residuals


def _weights(terms: _Terms, used: np.ndarray, sigma: tuple[float, float]) -> np.ndarray:
    """(K + C,) weight of each sighting: Huber's over its variance, 0 for those left out."""
    count = len(used)
    size = np.hypot(*terms.residuals.T)
    weight = np.full(len(size), 1 / sigma[1] ** 2)
    scaled = np.where(np.isfinite(size[:count]), size[:count], np.inf) / sigma[0]
    weight[:count] = np.where(used & np.isfinite(scaled), np.minimum(1, HUBER / np.maximum(scaled, 1e-12)), 0)
    weight[:count] /= sigma[0] ** 2
    return weight


def _cost(residuals: np.ndarray, used: np.ndarray, sigma: tuple[float, float]) -> float:
    """Huber's cost, doubled: chi-square where nothing is far off; infinite when a used sighting leaves its lens."""
    count = len(used)
    size = np.hypot(*residuals.T)
    size[:count] = np.where(used, size[:count], 0)
    scaled = size / np.where(np.arange(len(size)) < count, sigma[0], sigma[1])
    far = (scaled > HUBER) & (np.arange(len(size)) < count)
    cost = float(np.where(far, HUBER * (2 * scaled - HUBER), scaled**2).sum())
    return cost if np.isfinite(cost) else np.inf


def _penalty(bundle: Bundle, start: Bundle, priors: list[np.ndarray]) -> float:
    return sum(
        float((((lens_vector(camera) - lens_vector(first)) / sigma)[np.isfinite(sigma)] ** 2).sum())
        for camera, first, sigma in zip(bundle.cameras, start.cameras, priors, strict=True)
    )


def _held(bundle: Bundle) -> list[np.ndarray]:
    return [np.zeros((len(lens_vector(camera)), 0)) for camera in bundle.cameras]


def _unknown(bundle: Bundle) -> list[np.ndarray]:
    return [np.full(len(lens_vector(camera)), np.inf) for camera in bundle.cameras]


_System = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _system(
    bundle: Bundle, start: Bundle, layout: _Layout, priors: list[np.ndarray],
    anchor: tuple[int, np.ndarray, float] | None, used: np.ndarray, sigma: tuple[float, float],
) -> _System:  # fmt: skip
    """Normal equations: block U and gradient of all but the points, V (M, 3, 3) and gradient of these, W (3, n, M)."""
    terms = _terms(bundle)
    weight = _weights(terms, used, sigma)
    count, size = len(used), layout.size
    U, gradient = _marker_equations(terms, weight, bundle, layout)
    root = np.sqrt(weight[:count])
    live = root > 0
    residuals = np.where(live[:, None], terms.residuals[:count], 0) * root[:, None]
    by_pose, by_lens, by_point = (
        np.where(live[:, None, None], part[:count], 0) * root[:, None, None]
        for part in (terms.by_pose, terms.by_lens, terms.by_point)
    )
    view, index, many = bundle.seen_view, bundle.seen_point, len(bundle.points)
    turned = by_point.transpose(0, 2, 1)
    V, points_gradient = (
        _summed(turned @ by_point, index, many),
        _summed((turned @ residuals[..., None])[..., 0], index, many),
    )
    W = np.zeros((3, size, many))
    pairs, own = by_pose.transpose(0, 2, 1) @ by_point, by_pose.transpose(0, 2, 1)
    blocks = _summed(own @ by_pose, view, len(bundle.poses))
    slopes = _summed((own @ residuals[..., None])[..., 0], view, len(bundle.poses))
    for number, at in enumerate(layout.pose_at):
        if at >= 0:
            U[at : at + 6, at : at + 6] += blocks[number]
            gradient[at : at + 6] += slopes[number]
            mine = view == number
            W[:, at : at + 6, index[mine]] = pairs[mine].transpose(2, 1, 0)  # a view shows a point once
    for number, columns in enumerate(layout.lens):
        if not columns.shape[1]:
            continue
        place = slice(layout.lens_at[number], layout.lens_at[number] + columns.shape[1])
        mine = bundle.camera_of[view] == number
        lens = by_lens[mine, :, : len(columns)] @ columns
        U[place, place] += np.tensordot(lens, lens, ([0, 1], [0, 1]))
        gradient[place] += np.tensordot(lens, residuals[mine], ([0, 1], [0, 1]))
        W[:, place] = _summed(lens.transpose(0, 2, 1) @ by_point[mine], index[mine], many).transpose(2, 1, 0)
        cross = _summed(lens.transpose(0, 2, 1) @ by_pose[mine], view[mine], len(bundle.poses))
        for pose, at in enumerate(layout.pose_at):
            if at >= 0:
                U[place, at : at + 6] += cross[pose]
                U[at : at + 6, place] += cross[pose].T
    for number, (columns, known) in enumerate(zip(layout.lens, priors, strict=True)):
        place = slice(layout.lens_at[number], layout.lens_at[number] + columns.shape[1])
        strength = np.where(np.isfinite(known), 1 / np.where(np.isfinite(known), known, 1) ** 2, 0)
        U[place, place] += columns.T @ (strength[:, None] * columns)
        gradient[place] -= columns.T @ (
            strength * (lens_vector(bundle.cameras[number]) - lens_vector(start.cameras[number]))
        )
    if anchor is not None:
        far, direction, hold = anchor
        place = slice(layout.pose_at[far] + 3, layout.pose_at[far] + 6)
        U[place, place] += hold * np.outer(direction, direction)
    return U, gradient, V, points_gradient, W


def _marker_equations(
    terms: _Terms, weight: np.ndarray, bundle: Bundle, layout: _Layout
) -> tuple[np.ndarray, np.ndarray]:
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


def _reduce(system: _System, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reduced normal matrix and right side with the points eliminated, and the points' inverse blocks."""
    U, gradient, V, points_gradient, W = system
    trace = np.trace(V, axis1=1, axis2=2)
    lifted = V + (damping * trace[:, None, None] + np.where(trace > 0, 1e-12 * trace, 1.0)[:, None, None]) * np.eye(3)
    inverse = np.linalg.inv(lifted)
    half = np.linalg.cholesky(inverse)
    coupled = [sum(W[i] * half[:, i, j] for i in range(3)) for j in range(3)]
    turned = np.einsum("mij,mi->jm", half, points_gradient)
    reduced = U + damping * np.diag(np.diag(U)) - sum(part @ part.T for part in coupled)
    return reduced, gradient - sum(part @ one for part, one in zip(coupled, turned)), inverse


def _moved(bundle: Bundle, layout: _Layout, step: np.ndarray, points: np.ndarray) -> Bundle:
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


def _descend(
    bundle: Bundle, start: Bundle, layout: _Layout, priors: list[np.ndarray],
    anchor: tuple[int, np.ndarray, float] | None, used: np.ndarray, sigma: tuple[float, float],
) -> Bundle:  # fmt: skip
    """Levenberg-Marquardt at a given noise; a start that already is the minimum comes back."""
    damping = 1e-6
    cost = _cost(_residuals(bundle), used, sigma) + _penalty(bundle, start, priors)
    system = _system(bundle, start, layout, priors, anchor, used, sigma)
    for _ in range(STEPS):
        reduced, right, inverse = _reduce(system, damping)
        try:
            step = np.linalg.solve(reduced, right)
        except np.linalg.LinAlgError:
            damping = max(damping * 10, 1e-8)
            continue
        _, _, _, points_gradient, W = system
        points = np.einsum("mij,mj->mi", inverse, points_gradient - np.stack([part.T @ step for part in W], -1))
        trial = _moved(bundle, layout, step, points)
        new = _cost(_residuals(trial), used, sigma) + _penalty(trial, start, priors)
        if new <= cost:
            done = cost - new <= 1e-8 * cost
            bundle, cost, damping = trial, new, max(damping * 0.1, 1e-12)
            if done:
                break
            system = _system(bundle, start, layout, priors, anchor, used, sigma)
        else:
            damping = max(damping, 1e-9) * 10
            if damping > 1e6:
                break
    return bundle


def _fixed_by_corners(
    bundle: Bundle, start: Bundle, layout: _Layout, priors: list[np.ndarray],
    anchor: tuple[int, np.ndarray, float] | None, used: np.ndarray, sigma: tuple[float, float],
) -> float:  # fmt: skip
    """How many unknowns the markers' corners settle, beside the tracks, at a given noise.

    The trace of their part of the normal matrix over the whole (Foerstner 1979, variance components): corners are few
    and sharp, so they take more of the poses than their number says, and their residuals are smaller for it.
    """
    terms = _terms(bundle)
    own, _ = _marker_equations(terms, _weights(terms, used, sigma), bundle, layout)
    reduced, _, _ = _reduce(_system(bundle, start, layout, priors, anchor, used, sigma), 1e-9)
    size = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    scale = np.outer(size, size)
    # least squares: where nothing fixes an unknown, `_finish` says so
    return float(np.trace(np.linalg.lstsq(reduced / scale, own / scale, rcond=None)[0]))


def _noise(
    bundle: Bundle, used: np.ndarray, corner_sigma_px: float | None, layout: _Layout, fixed: float
) -> tuple[float, float]:
    """Standard deviation of a coordinate of the tracks and of the corners, by the redundancy of each.

    A point seen n times leaves 2 n - 3 of its 2 n coordinates, so that its residuals are smaller than the noise by
    their own factor; of the other unknowns ``fixed`` are taken from the corners, the rest from the tracks.
    """
    residuals = _residuals(bundle)
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


def _finish(
    bundle: Bundle, start: Bundle, layout: _Layout, priors: list[np.ndarray],
    anchor: tuple[int, np.ndarray, float] | None, used: np.ndarray, sigma: tuple[float, float],
) -> Adjusted:  # fmt: skip
    """Covariances at the minimum, and the poses' derivatives by lenses that are held."""
    bundle = _descend(bundle, start, layout, priors, anchor, used, sigma)
    system = _system(bundle, start, layout, priors, anchor, used, sigma)
    reduced, _, _ = _reduce(system, 0.0)
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    scaled = reduced / np.outer(scale, scale)
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled)[0] < 1e-13:
        raise NumericalError(
            "bundle: the photographs and markers do not fix the poses, needed markers in at least two views and "
            "overlap between all; photograph from more sides"
        )
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale)
    poses, markers = (
        np.array([covariance[a : a + 6, a : a + 6] if a >= 0 else np.zeros((6, 6)) for a in at]).reshape(-1, 6, 6)
        for at in (layout.pose_at, layout.marker_at)
    )
    lenses = []
    for columns, at in zip(layout.lens, layout.lens_at, strict=True):
        part = covariance[at : at + columns.shape[1], at : at + columns.shape[1]]
        lenses.append(columns @ part @ columns.T)
    by_lens = _by_lens(bundle, anchor is not None, used, sigma)
    deviance = _cost(_residuals(bundle), used, sigma)
    return Adjusted(bundle, *sigma, used, poses, by_lens, lenses, markers, deviance)


def _by_lens(bundle: Bundle, hold_first: bool, used: np.ndarray, sigma: tuple[float, float]) -> list[np.ndarray]:
    """N of (6, L): how each pose answers when its own lens is moved and all else adjusts again: -S_pp^-1 S_pl."""
    sizes = [len(lens_vector(camera)) for camera in bundle.cameras]
    answer = [np.zeros((6, sizes[number])) for number in bundle.camera_of]
    for number in range(len(bundle.cameras)):
        size = sizes[number]
        free = [np.eye(size) if n == number else held for n, held in enumerate(_held(bundle))]
        layout = _layout(bundle, free, hold_first)
        anchor = _anchor(bundle) if hold_first else None
        reduced, _, _ = _reduce(_system(bundle, bundle, layout, _unknown(bundle), anchor, used, sigma), 0.0)
        moved = -np.linalg.solve(reduced[size:, size:], reduced[size:, :size])
        for view, at in enumerate(layout.pose_at):
            if at >= 0 and bundle.camera_of[view] == number:
                answer[view] = moved[at - size : at - size + 6]
    return answer


def _summed(values: np.ndarray, index: np.ndarray, size: int) -> np.ndarray:
    """Sums (size, ...) of values (K, ...) by index (K,)."""
    order = np.argsort(index, kind="stable")
    first = np.flatnonzero(np.diff(index[order], prepend=-1))
    total = np.zeros((size, *values.shape[1:]))
    if len(first):
        total[index[order][first]] = np.add.reduceat(values[order], first, axis=0)
    return total
