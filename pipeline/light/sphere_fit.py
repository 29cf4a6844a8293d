"""The mirror ball in a photograph, found and fitted as a sphere under the lens, with the plane it stands on as a prior.

The silhouette of a sphere is the cone of half angle ``rho = asin(R / D)`` about the ray to its centre, so the residual of
an edge point is its ray's angle to the centre less rho, in pixels; three unknowns, exact off axis and under distortion.

A mirror's rim continues its background (at grazing incidence it reflects what is behind it), so the steepest place of the
profile lies inside the silhouette. That inset is a fourth unknown, in pixels, with a prior: it trades against the
distance, which is why the height of the centre over the plane, when the ball stands on it, carries the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project, unproject
from pipeline.light.sampling import bilinear, planes
from pipeline.types import Camera

# Of the steepest place of the rim's profile, measured on ray-traced balls of 30 to 200 px (tests/test_probe.py).
INSET_PX, INSET_SIGMA_PX = 0.15, 0.3
WINDOWS = (0.20, 0.08, 0.04)  # half widths of the edge search of successive rounds, in radii
LAST_WINDOW_PX = 3.0
SEARCH_AZIMUTHS = 64
MIN_RADIUS_PX = 8.0  # below this a ball has no profile to fit


@dataclass(frozen=True)
class Height:
    """Prior: ``normal . centre + offset_m = radius +- sigma_m`` with the plane in the camera frame."""

    normal: np.ndarray
    offset_m: float
    sigma_m: float

    def of(self, centre: np.ndarray) -> float:
        """Height [m] of a point (3,) of the camera frame above the plane."""
        return float(self.normal @ centre + self.offset_m)


@dataclass(frozen=True)
class SphereFit:
    """Centre (3,) in the camera frame [m] with covariance (3, 3), and how well its outline explains the edges.

    ``support``: fraction of the outline inside the frame that has an edge within 2 px; ``contrast``: mean slope on the
    outline over the mean slope beside it; ``visible``: fraction of the outline inside the frame.
    """

    centre: np.ndarray
    covariance: np.ndarray
    rms_px: float
    points: int
    radius_px: float
    inset_px: float
    support: float
    contrast: float
    visible: float


def tone(rgb: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Perceptual-like signal (H, W) of a linear picture: asinh, logarithmic in the light, linear in the noise.

    ``scale`` is where it bends; by default 2 % of the median, so two pictures to be compared must share it.
    """
    grey = np.asarray(rgb, np.float32).mean(-1)
    scale = 0.02 * float(np.median(grey[np.isfinite(grey)])) if scale is None else scale
    return np.arcsinh(grey / np.float32(max(scale, 1e-30)))


def silhouette(
    camera: Camera, centre: np.ndarray, radius: float, azimuth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outline of spheres with ``centre`` (..., 3): pixels (..., N, 2), outward unit normals, and pixels per radian."""
    distance = np.linalg.norm(centre, axis=-1, keepdims=True)
    axis = centre / distance
    first = np.cross(axis, (0.0, 1.0, 0.0))
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(axis, first)
    spokes = np.cos(azimuth)[:, None] * first[..., None, :] + np.sin(azimuth)[:, None] * second[..., None, :]
    rho = np.arcsin(np.minimum(radius / distance, 0.999))[..., None]
    step = 1e-4 * rho
    px, outer = (
        project(camera, np.cos(angle) * axis[..., None, :] + np.sin(angle) * spokes) for angle in (rho, rho + step)
    )
    normal = outer - px
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return px, normal / length, (length / step)[..., 0]


def radius_in_pixels(camera: Camera, centre: np.ndarray, radius: float) -> float:
    """Radius of the circle that has the area of the outline."""
    px = silhouette(camera, centre, radius, _azimuths(90))[0]
    x, y = (px - px.mean(0)).T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) * (2 * np.pi / 90) / np.sin(2 * np.pi / 90)
    return float(np.sqrt(area / np.pi))


def fraction_in_frame(camera: Camera, centre: np.ndarray, radius: float) -> float:
    """Fraction of the outline that lies in the frame."""
    return float(_inside(camera, silhouette(camera, centre, radius, _azimuths(180))[0]).mean())


def search_on_plane(signal: np.ndarray, camera: Camera, radius: float, height: Height, keep: int = 6) -> np.ndarray:
    """Centres (keep, 3) of balls standing on the plane whose outlines carry the most slope of ``signal`` (H, W).

    The centre is restricted to the plane at the ball's height, so the search is over two pixel coordinates; the score is
    the mean over the outline of the slope across it, capped so that a lamp's edge cannot outvote a whole contour.
    """
    centres = _lattice(camera, radius, height)
    if not len(centres):
        return centres
    typical = float(np.median([radius_in_pixels(camera, c, radius) for c in centres[:: max(1, len(centres) // 20)]]))
    slope = _slopes(signal, max(1.0, typical / 12))
    scores = _outline_score(slope, camera, centres, radius)
    found: list[np.ndarray] = []
    for index in np.argsort(-scores):
        if len(found) == keep or not np.isfinite(scores[index]):
            break
        if all(np.linalg.norm(centres[index] - other) > 0.5 * radius for other in found):
            found.append(centres[index])
    fine = _slopes(signal, max(1.0, typical / 25))
    refined = np.stack([_climb(fine, camera, centre, radius, height) for centre in found])
    return refined[np.argsort(-_outline_score(fine, camera, refined, radius))]


def _lattice(camera: Camera, radius: float, height: Height) -> np.ndarray:
    """Centres (N, 3) at the ball's height, on a pixel lattice as fine as a quarter of the smallest useful radius."""
    focal = 0.5 * (camera.fx + camera.fy)
    middle = unproject(camera, np.array([[camera.width / 2, camera.height / 2]]))[0]
    depth = _depth_at_height(np.append(middle, 1.0), height, radius)
    typical = focal * radius / depth if depth > 0 else 40.0
    pitch = float(np.clip(typical / 5, 4, max(camera.width, camera.height) / 12))
    x, y = np.meshgrid(np.arange(pitch / 2, camera.width, pitch), np.arange(pitch / 2, camera.height, pitch))
    xy = unproject(camera, np.stack([x.ravel(), y.ravel()], -1))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    depths = _depth_at_height(rays, height, radius)
    size = focal * radius / np.where(depths > 0, depths, np.inf)
    return (rays * depths[:, None])[(depths > 1.5 * radius) & (size > MIN_RADIUS_PX)]


def _depth_at_height(rays: np.ndarray, height: Height, radius: float) -> np.ndarray:
    """Factor by which rays (..., 3) reach the plane parallel to the ground through the ball's centre."""
    speed = rays @ height.normal
    return (radius - height.offset_m) / np.where(np.abs(speed) < 1e-12, 1e-12, speed)


def _slopes(signal: np.ndarray, sigma_px: float) -> list[np.ndarray]:
    """Gradient (H, W, 2) of the smoothed signal, per pixel, for lookups."""
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(signal, sigma_px, truncate=3)
    down, right = np.gradient(smooth)
    return planes(np.stack([right, down], -1))


def _outline_score(slope: list[np.ndarray], camera: Camera, centres: np.ndarray, radius: float) -> np.ndarray:
    """How much each centre (N, 3) has an outline: slope across it, less what is beside; -inf when mostly out of frame.

    The slope is capped, so a lamp's edge cannot outvote a contour, and counts by how well it points across.
    """
    if not len(centres):
        return np.empty(0)
    cap = 4 * float(np.median(np.hypot(*np.moveaxis(slope[0], -1, 0)))) + 1e-12
    total = np.zeros(len(centres))
    for grown, share in ((1.0, 1.0), (0.85, -0.3), (1.15, -0.7)):
        px, normal, _ = silhouette(camera, centres, radius * grown, _azimuths(SEARCH_AZIMUTHS))
        inside = _inside(camera, px)
        found = bilinear(slope, px[..., 0], px[..., 1])
        strength = np.hypot(found[..., 0], found[..., 1]) + 1e-12
        aligned = (np.abs((found * normal).sum(-1)) / strength) ** 4
        total += share * (inside * aligned * strength / (strength + cap)).sum(-1) / np.maximum(inside.sum(-1), 1)
        if grown == 1.0:
            total[inside.mean(-1) < 0.6] = -np.inf
    return total


def _climb(slope: list[np.ndarray], camera: Camera, centre: np.ndarray, radius: float, height: Height) -> np.ndarray:
    """Pattern search of the outline score over the two directions along the plane."""
    along = np.linalg.svd(height.normal[None])[2][1:]
    best, step = centre, 0.25 * radius
    score = _outline_score(slope, camera, best[None], radius)[0]
    pattern = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j], float)
    while step > 0.01 * radius:
        trial = best + step * pattern @ along
        scores = _outline_score(slope, camera, trial, radius)
        winner = int(np.argmax(scores))
        if scores[winner] > score:
            best, score = trial[winner], scores[winner]
        else:
            step /= 2
    return best


def fit_sphere(
    signal: np.ndarray, camera: Camera, radius: float, seed: np.ndarray, height: Height | None
) -> SphereFit:
    """Fit the centre (3,) [m, camera frame] from a seed that is right to about a fifth of the radius."""
    groups, centre, inset = planes(signal), np.asarray(seed, float), INSET_PX
    typical = radius_in_pixels(camera, centre, radius)
    azimuth = _azimuths(int(np.clip(np.pi * typical, 60, 720)))  # one ray every two pixels: edges nearly independent
    beside = _slope_beside(groups, camera, centre, radius, azimuth)
    windows = [max(LAST_WINDOW_PX, share * typical) for share in WINDOWS]
    for window in [*windows, LAST_WINDOW_PX, LAST_WINDOW_PX]:
        edges, strength = _edge_points(groups, camera, centre, radius, azimuth, window, inset, 2 * beside)
        if len(edges) < 12:
            break
        centre, inset, covariance, residual, weight = _solve(camera, edges, centre, inset, radius, height, window)
    if len(edges) < 12:
        return SphereFit(centre, np.full((3, 3), np.inf), np.inf, len(edges), typical, inset, 0.0, 0.0, 0.0)
    visible = fraction_in_frame(camera, centre, radius)
    near = np.abs(residual) < 2
    rms = float(np.sqrt((weight * residual**2).sum() / weight.sum()))
    beside = _slope_beside(groups, camera, centre, radius, azimuth)
    contrast = float(np.median(strength) / max(beside, 1e-12))
    support = float(near.sum() / max(visible * len(azimuth), 1))
    size = radius_in_pixels(camera, centre, radius)
    return SphereFit(centre, covariance, rms, int(near.sum()), size, inset, min(support, 1.0), contrast, visible)


def _edge_points(
    groups: list[np.ndarray], camera: Camera, centre: np.ndarray, radius: float, azimuth: np.ndarray,
    window: float, inset: float, floor: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Pixels (M, 2) of the edge of each profile within ``window`` px of the expected one, and their slopes per pixel.

    ``floor`` is the slope that texture reaches beside the outline: an edge counts fully when it is well above.
    """
    px, normal, _ = silhouette(camera, centre, radius, azimuth)
    step = max(0.25, window / 40)
    offset = np.arange(-window - 2, window + 2 + step / 2, step)
    profile_px = px[:, None] + (offset - inset)[:, None] * normal[:, None]
    profile = bilinear(groups, profile_px[..., 0], profile_px[..., 1])[..., 0]
    blur = max(0.7, window / 8) / step
    taps = np.arange(-int(3 * blur), int(3 * blur) + 1)
    kernel = -taps * np.exp(-0.5 * (taps / blur) ** 2)  # derivative of a Gaussian: slope of the smoothed profile
    kernel /= np.abs(kernel * taps).sum() * step
    padded = np.pad(profile, ((0, 0), (len(taps) // 2,) * 2), mode="edge")
    slope = np.abs(np.lib.stride_tricks.sliding_window_view(padded, len(taps), 1) @ kernel[::-1])
    # A saturating strength, so that lamps mirrored just inside cannot outvote the rim; of comparable ones, the outermost.
    preferred = slope / (slope + floor) * np.exp(-0.5 * (2 * offset / window) ** 2)
    peak = np.zeros_like(slope, bool)
    peak[:, 1:-1] = (slope[:, 1:-1] >= slope[:, :-2]) & (slope[:, 1:-1] > slope[:, 2:])
    preferred *= peak
    strong = preferred >= 0.5 * preferred.max(1, keepdims=True)
    best = len(offset) - 1 - (strong & peak)[:, ::-1].argmax(1)
    rows = np.arange(len(px))
    left, here, right = (slope[rows, np.clip(best + shift, 0, len(offset) - 1)] for shift in (-1, 0, 1))
    bend = left - 2 * here + right
    shift = np.where(bend < -1e-12, 0.5 * (left - right) / np.where(bend < -1e-12, bend, 1), 0)
    found = px + ((offset[best] + np.clip(shift, -1, 1) * step) - inset)[:, None] * normal
    use = _inside(camera, found, 2) & _inside(camera, px, 2) & (here > 0) & (preferred[rows, best] > 0)
    return found[use], here[use]


def _solve(
    camera: Camera, edges: np.ndarray, centre: np.ndarray, inset: float, radius: float, height: Height | None,
    window: float,
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Gauss-Newton with Cauchy weights: centre, inset, covariance of the centre, residuals [px] and weights."""
    xy = unproject(camera, edges)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for _ in range(12):
        scale = _pixels_per_radian(camera, centre, edges)
        distance = np.linalg.norm(centre)
        axis, ratio = centre / distance, radius / distance
        cosine = rays @ axis
        sine = np.sqrt(1 - cosine**2)
        residual = scale * (np.arccos(cosine) - np.arcsin(ratio)) + inset
        by_centre = -(rays - cosine[:, None] * axis) / (sine[:, None] * distance)
        by_centre = scale[:, None] * (by_centre + ratio / distance / np.sqrt(1 - ratio**2) * axis)
        jacobian = np.concatenate([by_centre, np.ones((len(edges), 1))], 1)
        spread = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 0.05)
        tuning = max(2 * spread, 0.1 * window)
        weight = 1 / (1 + (residual / tuning) ** 2)
        normal = jacobian.T @ (weight[:, None] * jacobian) / spread**2
        right = jacobian.T @ (weight * residual) / spread**2
        normal[3, 3] += 1 / INSET_SIGMA_PX**2
        right[3] += (inset - INSET_PX) / INSET_SIGMA_PX**2
        if height is not None:
            normal[:3, :3] += np.outer(height.normal, height.normal) / height.sigma_m**2
            right[:3] += height.normal * (height.of(centre) - radius) / height.sigma_m**2
        step = np.linalg.solve(normal, right)
        step[:3] *= min(1.0, 0.3 * radius / max(float(np.linalg.norm(step[:3])), 1e-300) * 4)
        centre, inset = centre - step[:3], inset - float(step[3])
        if np.linalg.norm(step[:3]) < 1e-7 * distance:
            break
    return centre, inset, np.linalg.inv(normal)[:3, :3], residual, weight


def _pixels_per_radian(camera: Camera, centre: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Pixels per radian away from the centre's ray at pixels (M, 2), from the outline at the same azimuth."""
    axis = centre / np.linalg.norm(centre)
    xy = unproject(camera, edges)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    outward = rays - (rays @ axis)[:, None] * axis
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    step = 1e-5
    moved = project(camera, rays + step * (outward - (rays * outward).sum(1, keepdims=True) * rays))
    travelled = np.abs((rays * axis).sum(1)) * step  # the tangent step turns the ray by its length, and cos of it counts
    return np.linalg.norm(moved - edges, axis=1) / np.maximum(travelled, 1e-12)


def _slope_beside(
    groups: list[np.ndarray], camera: Camera, centre: np.ndarray, radius: float, azimuth: np.ndarray
) -> float:
    """Median steepest slope that a 3 px search finds just outside the outline: the level of chance."""
    found = [
        _edge_points(groups, camera, centre, radius * grown, azimuth, LAST_WINDOW_PX, 0.0, 1e-12)[1] for grown in (1.15, 1.3)
    ]
    values = np.concatenate(found)
    return float(np.median(values)) if len(values) else 0.0


def _inside(camera: Camera, px: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether pixels (..., 2) lie in the frame by at least ``margin``; NaN does not."""
    x, y = px[..., 0], px[..., 1]
    return (x >= margin) & (x <= camera.width - margin) & (y >= margin) & (y <= camera.height - margin)


def _azimuths(count: int) -> np.ndarray:
    return 2 * np.pi * (np.arange(count) + 0.5) / count
