"""How often the stated 95 % regions of a pose hold the truth: simulated corners and tracks, every route.

Half of the poses are found with the true lens, half with one drawn from a calibration's covariance. Refused poses are
counted apart: what is judged is what a user gets.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.camera.adjustment import lens_vector, with_lens
from pipeline.camera.bundle import adjust
from pipeline.camera.lens import project
from pipeline.camera.marker_map import solve
from pipeline.camera.markers import marker_points
from pipeline.camera.resection import resect_plane
from pipeline.camera.rigid import camera_points, difference, perturb
from pipeline.camera.sfm import Seen
from pipeline.camera.survey import resect_points
from pipeline.conventions import transform_points
from pipeline.run.errors import NumericalError
from pipeline.types import Camera
from stages.knobs import Pose
from tests import joint_world
from tests.printed_board import looking_at

CHI2_95 = 12.592  # six degrees of freedom
TRIALS = 1000  # several markers cost 0.07, joint adjustments 0.5 CPU seconds each
SIGMA_PX, LEAST_RATIO = Pose().corner_sigma_px, Pose().min_ambiguity
TRUE = Camera(
    width=1024, height=768, fx=1100, fy=1100, cx=515, cy=380, distortion=np.array([-0.1, 0.02, 5e-4, -3e-4, 0])
)
# (fx, fy, cx, cy, k1, k2, p1, p2, k3) of ten board photographs, one focal length for both axes
LENS_SIGMA = np.array([1.1, 0.0, 1.0, 1.0, 2e-3, 4e-3, 1e-4, 1e-4, 0.0])
ONE_FOCAL = np.eye(9)
ONE_FOCAL[1, 0] = 1.0
LENS_COVARIANCE = ONE_FOCAL @ np.diag(LENS_SIGMA**2) @ ONE_FOCAL.T
X, Z = np.meshgrid(np.arange(1, 7) * 0.03, np.arange(1, 5) * 0.03)
BOARD = np.stack([X.ravel(), 0 * X.ravel(), Z.ravel()], -1)
CENTRE = np.array([0.105, 0, 0.075])
SIDES = [0.08, 0.06, 0.06]
PLACES = [np.eye(4), perturb(np.eye(4), np.array([0, 0.6, 0, 0.25, 0, 0.05])),
          perturb(np.eye(4), np.array([1.2, 0, 0.2, 0.1, 0.08, -0.2]))]  # fmt: skip
FAR = np.array([4.5e5, 0, 5.2e6])  # metres: a national grid
Route = Callable[[np.random.Generator, Camera], float | None]


def estimated_lens(rng: np.random.Generator, true: Camera, known: bool) -> Camera:
    """The true lens, or one as a calibration finds it, with its covariance."""
    if known:
        return true
    off = ONE_FOCAL @ (LENS_SIGMA * rng.standard_normal(9))
    return with_lens(true, lens_vector(true) + off).model_copy(update={"covariance": LENS_COVARIANCE})


def measured(rng: np.random.Generator, pose: np.ndarray, points: np.ndarray, sigma: Any = SIGMA_PX) -> np.ndarray:
    """Pixels (N, 2) of points through the true lens, with noise."""
    return project(TRUE, camera_points(pose, points)[0]) + np.reshape(sigma, (-1, 1)) * rng.normal(
        size=(len(points), 2)
    )


def mahalanobis(found: np.ndarray, covariance: np.ndarray, true: np.ndarray) -> float:
    """Squared error of a pose in units of its own covariance."""
    delta = difference(found, true)
    return float(delta @ np.linalg.solve(covariance, delta))


def aimed(rng: np.random.Generator, target: np.ndarray, tilts: tuple[float, float], distance: float) -> np.ndarray:
    """A pose that looks at a place, from any side, the camera rolled and the place off the frame's middle."""
    pose = looking_at(target, rng.uniform(*tilts), rng.uniform(0, 360), distance, rng.uniform(-30, 30))
    return pose @ perturb(np.eye(4), np.array([*rng.uniform(-0.12, 0.12, 2), 0, 0, 0, 0]))


def plane_route(
    rng: np.random.Generator, camera: Camera, points: np.ndarray, pose: np.ndarray, sharp: bool = False
) -> float | None:
    """Mahalanobis distance of the pose of a plane's points, ``sharp`` those of a board; None when it is ambiguous."""
    best, _, ambiguity = resect_plane(camera, points, measured(rng, pose, points), SIGMA_PX, sharp)
    return mahalanobis(best.world_from_camera, best.covariance, pose) if ambiguity >= LEAST_RATIO else None


def one_marker(rng: np.random.Generator, camera: Camera, side_m: float, sizes_px: tuple[float, float]) -> float | None:
    """A marker of any size in the picture, at any tilt up to 65 degrees."""
    distance = TRUE.fx * side_m / np.exp(rng.uniform(*np.log(sizes_px)))
    return plane_route(rng, camera, marker_points(side_m), aimed(rng, np.zeros(3), (0, 65), distance))


def board(rng: np.random.Generator, camera: Camera, fewest: int = len(BOARD)) -> float | None:
    """Corners of a board 180 to 600 px wide; ``fewest``: a random part of them is hidden."""
    pose = aimed(rng, CENTRE, (0, 65), TRUE.fx * 0.18 / rng.uniform(180, 600))
    chosen = BOARD
    if fewest < len(BOARD):  # what an object hides: the corners nearest to a place are gone
        away = np.linalg.norm(BOARD - BOARD[rng.integers(len(BOARD))], axis=1)
        chosen = BOARD[np.argsort(-away)[: rng.integers(fewest, len(BOARD))]]
    return plane_route(rng, camera, chosen, pose, True)


def points(rng: np.random.Generator, camera: Camera) -> float | None:
    """Six to fifteen surveyed points of a national grid with their own uncertainties; one set in four is coplanar."""
    flat = rng.random() < 0.25
    local = rng.uniform(-0.5, 0.5, (rng.integers(6, 16), 3)) * (1, 0.0 if flat else 0.6, 1)
    pose = aimed(rng, np.zeros(3), (20, 70), rng.uniform(1.6, 2.6))
    sigma_px, sigma_m = rng.uniform(0.2, 1.0, len(local)), rng.uniform(2e-4, 2e-3, len(local))
    surveyed = local + sigma_m[:, None] * rng.standard_normal(local.shape) + FAR
    found = resect_points(camera, surveyed, measured(rng, pose, local, sigma_px), sigma_px, sigma_m)
    if found.ambiguity < LEAST_RATIO:
        return None
    pose[:3, 3] += FAR
    return mahalanobis(found.best.world_from_camera, found.best.covariance, pose)


def several_markers(rng: np.random.Generator, camera: Camera) -> float | None:
    """The plate among four views of three markers of unknown layout, of which it shows one or two."""
    middle = np.array([0.12, 0, -0.03])
    shown = {"plate": [[1], [0, 1], [1, 2]][rng.integers(3)], "a": [0, 1], "b": [0, 1, 2], "c": [0, 2]}
    poses = {name: aimed(rng, middle, (25, 60), rng.uniform(0.7, 1.0)) for name in shown}
    seen = {
        name: [
            Seen(m, at := marker_points(SIDES[m]), measured(rng, poses[name], transform_points(PLACES[m], at)))
            for m in ids
        ]
        for name, ids in shown.items()
    }
    found = solve(seen, dict.fromkeys(seen, camera), SIGMA_PX)
    if found.ambiguity["plate"] < LEAST_RATIO:
        return None
    at = found.done.bundle.poses[found.names.index("plate")]
    return mahalanobis(at, found.covariance("plate", camera)[0], poses["plate"])


def joint(rng: np.random.Generator, camera: Camera) -> float | None:
    """The plate, which shows no marker, from tracks of a cloud and marker corners in seven further views."""
    truth = joint_world.world(rng, views=8, points=160)
    start = joint_world.noisy(truth, rng)
    lens = with_lens(joint_world.CAMERA, lens_vector(joint_world.CAMERA) + lens_vector(camera) - lens_vector(TRUE))
    found = adjust(replace(start, cameras=[lens]))
    by_lens = found.by_lens[0]
    covariance = found.pose_covariance[0] + by_lens @ camera.covariance @ by_lens.T
    return mahalanobis(found.bundle.poses[0], covariance, truth.poses[0])


ROUTES: dict[str, Route] = {
    "single": lambda rng, camera: one_marker(rng, camera, 0.1, (40, 300)),
    "multi": several_markers,
    "board": board,
    "charuco": lambda rng, camera: board(rng, camera, 6),
    "apriltag": lambda rng, camera: one_marker(rng, camera, 0.05, (80, 500)),
    "points": points,
    "colmap": joint,
}


def trial(route: str, number: int) -> float | None:
    """Mahalanobis distance of one simulated pose, None when it was refused; even numbers have the true lens."""
    rng = np.random.default_rng([sorted(ROUTES).index(route), number])
    try:
        return ROUTES[route](rng, estimated_lens(rng, TRUE, number % 2 == 0))
    except NumericalError:
        return None


def interval(inside: int, count: int) -> list[float]:
    """95 % interval of a share (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    low = beta.ppf(0.025, inside, count - inside + 1) if inside else 0.0
    return [float(low), float(beta.ppf(0.975, inside + 1, count - inside) if inside < count else 1.0)]


def summed(found: list[float | None]) -> dict[str, Any]:
    """Share of poses whose region holds the truth, its interval, and the refused."""
    chi2 = np.array([value for value in found if value is not None])
    inside = int((chi2 <= CHI2_95).sum())
    return {
        "trials": len(found), "refused": len(found) - len(chi2), "held_95": inside / len(chi2),
        "interval": interval(inside, len(chi2)), "chi2_mean": float(chi2.mean()), "chi2_median": float(np.median(chi2)),
    }  # fmt: skip


def coverage(route: str, trials: int, workers: int = 2) -> dict[str, Any]:
    """The figures of a route, of all and of either lens."""
    with ProcessPoolExecutor(workers) as pool:
        found = list(pool.map(trial, [route] * trials, range(trials), chunksize=10))
    return {**summed(found), "true_lens": summed(found[::2]), "calibrated_lens": summed(found[1::2])}


def all_routes() -> dict[str, Any]:
    """Every route."""
    return {name: coverage(name, TRIALS) for name in ROUTES}
