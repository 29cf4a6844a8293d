"""Flat surfaces that stand beside the plane, in the cloud of a reconstruction: walls, sides of boxes, another table.

One at a time: three neighbouring points propose a plane, the proposal with the most points in reach of it is refined by
a robust weighted fit (`cloud_plane.fit_plane`, in a frame that the proposal spans) and its largest connected part is
kept; its points are taken out and the next is looked for. A surface counts only when points in front of and behind it
are few: a cluttered heap has planes through it as well. Its outline is the smallest upright rectangle around its
points. Limits: what has no texture has no points; what stands on the plane is taken to reach down to it when its
lowest points are nearly there; the back of things, which no photograph shows, is not made up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.cloud_plane import CloudPlane, fit_plane, point_covariances, variance_along
from pipeline.types import Reconstruction

FEWEST = 24  # points of a surface: a chance plane among neighbours rarely has half as many
NEAREST = 24  # neighbours of a point that may propose a plane with it
PROPOSALS = 400  # per surface
GATE = 3.0  # standard uncertainties of a point, with the surface's own unevenness
FLAT = 0.02  # of a surface's size: it may be that uneven
CLEAR = 0.7  # of the points over a surface's outline, within a quarter of its size, must lie on it
LINK = 6.0  # median distances between neighbours: a wider gap parts two surfaces
FEW_VIEWS = 3  # a point seen in two is a match that nothing confirms
ABOVE = 4.0  # standard uncertainties of a height: below it a point is one of the plane's
TO_GROUND = 0.2  # of a surface's height: nearer the ground than that, it stands on it
STRAY = 12.0  # scatters of a surface within which a point over it is none of another surface
MOST = 8  # surfaces
SEED = 20


@dataclass(frozen=True, eq=False)
class Found:
    """A flat surface: ``corners_m`` (4, 3) counter-clockwise seen from its cameras' side, world frame.

    ``fit``: tilts [rad] about the first and second side of its own frame and offset [m], with covariance (3, 3);
    ``sigma_deg``, ``sigma_m``: standard uncertainty of its normal and of its place, at its middle.
    """

    corners_m: np.ndarray
    normal: np.ndarray
    fit: CloudPlane
    members: np.ndarray

    @property
    def area_m2(self) -> float:
        """Of the outline."""
        sides = self.corners_m[[1, 3]] - self.corners_m[0]
        return float(np.prod(np.linalg.norm(sides, axis=1)))

    @property
    def sigma_deg(self) -> float:
        """Standard uncertainty of the normal [deg]."""
        return float(np.degrees(np.sqrt(np.trace(self.fit.covariance[:2, :2]))))

    @property
    def sigma_m(self) -> float:
        """Standard uncertainty of its place along the normal, at the middle [m]."""
        return float(np.sqrt(self.fit.covariance[2, 2]))


def flat_surfaces(cloud: Reconstruction, corners_m: np.ndarray, uneven_m: float) -> list[Found]:
    """Surfaces beside the plane y = 0 in a cloud in the world, those with most points first.

    ``corners_m`` (4, 3): the modelled rectangle; what stands farther off than half its size is no local scene.
    ``uneven_m``: standard deviation of the plane's own heights. One seed: the same cloud gives the same surfaces.
    """
    covariances = point_covariances(cloud)
    spread = np.sqrt(variance_along(covariances, np.array([0.0, 1.0, 0.0])) + uneven_m**2)
    low, high = corners_m.min(0), corners_m.max(0)
    margin = (high - low).max() / 2
    points = cloud.points
    near = ((points >= low - margin) & (points <= high + margin)).all(1) & (points[:, 1] > ABOVE * spread)
    near &= np.bincount(cloud.seen_point, minlength=len(points)) >= FEW_VIEWS
    left = np.flatnonzero(near & np.isfinite(spread))
    everything, rng = left, np.random.default_rng(SEED)
    found: list[Found] = []
    while len(left) >= FEWEST and len(found) < MOST:
        members = _largest(points, covariances, left, rng)
        if len(members) < FEWEST:
            break
        left = np.setdiff1d(left, members)
        surface = _outlined(cloud, covariances, members)
        if surface is not None and _is_clear(points[everything], surface):
            found.append(surface)
            left = left[~_strays(points[left], surface)]
    return found


def _largest(points: np.ndarray, covariances: np.ndarray, left: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Indices of the largest connected part of the best proposal among the points ``left``; few when there is none."""
    from scipy.spatial import cKDTree

    here, within = points[left], covariances[left]
    tree = cKDTree(here)
    away, neighbours = tree.query(here, min(NEAREST, len(here)))
    spacing = float(np.median(away[:, 1:4]))
    best, most = np.empty(0, int), 0
    for _ in range(PROPOSALS):
        seed = rng.integers(len(here))
        a, b, c = here[[seed, *rng.choice(neighbours[seed][1:], 2, replace=False)]]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-6 * spacing**2:
            continue
        inside = _on(here, within, a, normal / length)
        if inside.sum() > most:
            best, most = np.flatnonzero(inside), int(inside.sum())
    if most < FEWEST:
        return best
    for _ in range(2):  # the proposal of three points is coarse: those of the fit are the members
        middle, normal = _spanned(here[best])
        best = np.flatnonzero(_on(here, within, middle, normal))
        if len(best) < FEWEST:
            return best
    return np.asarray(left[best[_connected(here[best])]])


def _on(points: np.ndarray, covariances: np.ndarray, origin: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(N,) bool: points on a plane within their own uncertainty."""
    sigma = np.sqrt(variance_along(covariances, normal))
    return np.asarray(np.abs((points - origin) @ normal) < GATE * np.maximum(sigma, np.median(sigma)))


def _spanned(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and unit normal of points (N, 3)."""
    middle = np.median(points, axis=0)
    return middle, np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]


def _connected(points: np.ndarray) -> np.ndarray:
    """Indices of the largest set of points without a gap."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    away = tree.query(points, 2)[0][:, 1]
    pairs = tree.query_pairs(LINK * float(np.median(away)), output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    label = connected_components(links, directed=False)[1]
    return np.flatnonzero(label == np.bincount(label).argmax())


def _outlined(cloud: Reconstruction, covariances: np.ndarray, members: np.ndarray) -> Found | None:
    """The surface through some points: fit, side that its cameras are on, upright outline; None when they span none."""
    points = cloud.points[members]
    middle, normal = _spanned(points)
    views = cloud.seen_view[np.isin(cloud.seen_point, members)]
    if (cloud.world_from_camera[views, :3, 3].mean(0) - middle) @ normal < 0:
        normal = -normal
    frame = upright(normal)
    fit = fit_plane((points - middle) @ frame.T, variance_along(covariances[members], normal))
    if fit is None:
        return None
    frame = upright(frame.T @ fit.normal)
    origin = middle + frame[1] * fit.fit[2]
    across, up = ((points - origin) @ frame[[0, 2]].T).T
    (left, right), (low, high) = (_ends(values) for values in (across, up))
    if min(right - left, high - low) <= 0:
        return None
    feet = origin + frame[2] * low
    slope = frame[2, 1]
    if slope > 0.5 and feet[1] < TO_GROUND * slope * (high - low):  # a side that stands on the plane
        low -= feet[1] / slope
    corners = np.array([origin + a * frame[0] + b * frame[2]
                        for a, b in ((left, low), (right, low), (right, high), (left, high))])  # fmt: skip
    return Found(corners, frame[1], fit, members)


def upright(normal: np.ndarray) -> np.ndarray:
    """(3, 3) rows: level side, unit normal, and the side that goes up, so that (side, up, normal) is right-handed."""
    level = np.cross([0.0, 1.0, 0.0], normal)
    side = _unit(level) if np.linalg.norm(level) > 1e-3 else np.array([1.0, 0.0, 0.0])
    side = _unit(side - normal * (side @ normal))
    return np.stack([side, normal, np.cross(normal, side)])


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Ends of what evenly strewn values fill: the outermost, and half a gap more; stray ones (1 %) left out."""
    low, high = np.quantile(values, [0.01, 0.99])
    kept = np.sort(values[(values >= low) & (values <= high)])
    gap = (kept[-1] - kept[0]) / len(kept)
    return float(kept[0] - gap), float(kept[-1] + gap)


def _strays(points: np.ndarray, surface: Found) -> np.ndarray:
    """(N,) bool: points over the outline and so near it that they are its own, measured worse than they say."""
    local = (points - surface.corners_m.mean(0)) @ upright(surface.normal).T
    half = np.linalg.norm(surface.corners_m[[1, 3]] - surface.corners_m[0], axis=1) / 2
    near = np.abs(local[:, 1]) < STRAY * np.maximum(surface.fit.scatter_m, 1e-12)
    return np.asarray(near & (np.abs(local[:, [0, 2]]) < half + 0.1 * half.max()).all(1))


def _is_clear(points: np.ndarray, surface: Found) -> bool:
    """Whether most points over the outline lie on it, and it is as flat as it is large."""
    frame = upright(surface.normal)
    local = (points - surface.corners_m.mean(0)) @ frame.T
    half = np.linalg.norm(surface.corners_m[[1, 3]] - surface.corners_m[0], axis=1) / 2
    over = (np.abs(local[:, [0, 2]]) <= 0.9 * half).all(1) & (np.abs(local[:, 1]) < half.min() / 2)
    thick = max(GATE * surface.fit.scatter_m, 1e-12)
    on = np.abs(local[over, 1]) < thick
    return bool(on.sum() >= CLEAR * max(over.sum(), 1) and surface.fit.scatter_m < FLAT * 2 * half.max())
