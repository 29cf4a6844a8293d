"""The plane of the local scene in the cloud of a reconstruction: a robust, weighted fit with covariance.

Each point's variance along +Y is that of its triangulation (independent sightings of one pixel noise), with the
surface's own unevenness on top, found from the scatter. Heights are fitted as ``y = offset + b x + c z`` by reweighted
least squares with Tukey's biweight, so that what stands on the plane does not lift it. Limits: the surface is nearly
the markers' plane (a few degrees); errors that all points share, those of the views' poses, are not in this covariance
but in the plate's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.bundle import Adjusted
from pipeline.types import Camera, Reconstruction

TRACK_SIGMA_PX = 0.25  # of a SIFT feature in a track, each coordinate; 0.23 was measured on a rendered capture
BAND = 0.1  # of the camera's height: points farther from the markers' plane are no candidates
TUKEY = 4.685  # 95 % efficient on Gaussian errors
FEWEST = 20  # points
ROUNDS = 30
AGREE_CHI2 = 16.27  # 99.9 % of chi2 with three degrees of freedom


@dataclass(frozen=True)
class CloudPlane:
    """Fit (tilt about x [rad], about z [rad], offset [m]) as in `types.Plane`, its covariance (3, 3), and what it used.

    ``scatter_m``: robust, of the heights about the plane; ``uneven_m``: the part that triangulation does not explain.
    """

    fit: np.ndarray
    covariance: np.ndarray
    points: int
    scatter_m: float
    uneven_m: float

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (3,), upward, world frame."""
        normal = np.array([-self.fit[1], 1.0, self.fit[0]])
        return np.asarray(normal / np.linalg.norm(normal))

    def height(self, spot: np.ndarray) -> float:
        """Height [m] of the surface at a point (3,) of the world."""
        return float(self.fit[2] + self.fit[1] * spot[0] - self.fit[0] * spot[2])

    def chi2(self, covariance: np.ndarray) -> float:
        """Of the markers' plane y = 0 being this one; ``covariance`` (3, 3): the markers' plane's, in these terms."""
        return float(self.fit @ np.linalg.solve(self.covariance + covariance, self.fit))


def in_world(made: Reconstruction, done: Adjusted, cameras: list[Camera]) -> Reconstruction:
    """The reconstruction after its adjustment with the markers: world frame, metres, these lenses."""
    bundle, used = done.bundle, done.used
    return made.model_copy(
        update={
            "world_from_camera": np.array(bundle.poses), "cameras": cameras, "points": bundle.points,
            "seen_view": bundle.seen_view[used], "seen_point": bundle.seen_point[used], "px": bundle.px[used],
        }
    )  # fmt: skip


def point_covariances(made: Reconstruction) -> np.ndarray:
    """(M, 3, 3) covariance of the cloud's points, of triangulation alone, in its frame."""
    focal = np.array([(camera.fx + camera.fy) / 2 for camera in made.cameras])[made.camera_of]
    away = made.points[made.seen_point] - made.world_from_camera[made.seen_view, :3, 3]
    depth = np.linalg.norm(away, axis=1)
    ray = away / np.maximum(depth, 1e-300)[:, None]
    weight = (focal[made.seen_view] / (TRACK_SIGMA_PX * np.maximum(depth, 1e-300))) ** 2
    information = np.zeros((len(made.points), 3, 3))
    np.add.at(information, made.seen_point, weight[:, None, None] * (np.eye(3) - ray[:, :, None] * ray[:, None, :]))
    values, vectors = np.linalg.eigh(information)
    least = np.maximum(values, 1e-12 * values[:, 2:] + 1e-300)  # along a single sight line nothing is known
    return np.asarray((vectors / least[:, None]) @ vectors.transpose(0, 2, 1))


def variance_along(covariances: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Variance (M,) of points with covariances (M, 3, 3) along a unit direction (3,)."""
    return np.asarray(np.einsum("nij,i,j->n", covariances, direction, direction, optimize=True))


def fit_plane(points: np.ndarray, variance: np.ndarray) -> CloudPlane | None:
    """Plane of points (N, 3) near y = 0 with variances (N,) of their heights; None when they do not span one."""
    if len(points) < FEWEST:
        return None
    middle = points[:, [0, 2]].mean(0)
    design = np.stack([np.ones(len(points)), *(points[:, [0, 2]] - middle).T], -1)
    height = points[:, 1]
    solution = np.array([np.median(height), 0.0, 0.0])
    uneven = 0.0
    for _ in range(ROUNDS):
        off = height - design @ solution
        scatter = 1.4826 * float(np.median(np.abs(off)))
        uneven = float(np.sqrt(max(scatter**2 - float(np.median(variance)), 0.0)))
        total = variance + uneven**2 + 1e-18
        share = off**2 / (TUKEY**2 * np.maximum(total, scatter**2 * 0.01))
        weight = np.where(share < 1, (1 - share) ** 2, 0.0) / total
        normal = design.T @ (weight[:, None] * design)
        if np.count_nonzero(weight) < FEWEST or np.linalg.cond(normal * _unit(normal)) > 1e8:
            return None
        before, solution = solution, np.linalg.solve(normal, design.T @ (weight * height))
        if np.abs(design @ (solution - before)).max() < 1e-9 * max(1.0, float(np.abs(height).max())):
            break
    off, used = height - design @ solution, weight > 0
    # Sandwich of an M-estimator (Huber 1967): right whatever the true variances are.
    slope = np.where(share < 1, (1 - share) * (1 - 5 * share), 0.0) / total
    inverse = np.linalg.inv(design.T @ (slope[:, None] * design))
    spread = inverse @ (design.T * (weight * off) ** 2) @ design @ inverse
    to_fit = np.array([[0, 0, -1.0], [0, 1.0, 0], [1.0, -middle[0], -middle[1]]])
    return CloudPlane(
        to_fit @ solution, to_fit @ spread @ to_fit.T, int(used.sum()),
        float(1.4826 * np.median(np.abs(off[used]))), uneven,
    )  # fmt: skip


def _unit(normal: np.ndarray) -> np.ndarray:
    """What scales a normal matrix to a unit diagonal."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(1 / np.outer(size, size))


def plane_of_cloud(cloud: Reconstruction, camera_height_m: float, corners_m: np.ndarray) -> CloudPlane | None:
    """Plane of the points of a cloud in the world within the modelled rectangle (4, 3); None when they do not tell.

    The rectangle bounds x and z; points higher or lower than a tenth of the plate camera's height are left out.
    """
    variance = variance_along(point_covariances(cloud), np.array([0.0, 1.0, 0.0]))
    (x0, _, z0), (x1, _, z1) = corners_m.min(0), corners_m.max(0)
    x, y, z = cloud.points.T
    kept = (x >= x0) & (x <= x1) & (z >= z0) & (z <= z1) & (np.abs(y) < BAND * camera_height_m)
    kept &= np.isfinite(variance) & (np.bincount(cloud.seen_point, minlength=len(x)) >= 2)
    return fit_plane(cloud.points[kept], variance[kept])
