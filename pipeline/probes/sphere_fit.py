"""The mirror ball in a photograph, found and fitted as a sphere under the lens, with the plane it stands on as a prior.

The silhouette of a sphere is the cone of half angle ``rho = asin(R / D)`` about the ray to its centre, so the residual
of an edge point is its ray's angle to the centre less rho, in pixels; exact off axis and under distortion.

A mirror's rim continues its background: at grazing incidence it reflects what is behind it. Single edge points are
therefore weak, and grain, shadows and mirrored edges are strong. So the outline votes first, all azimuths at once and
every slope saturating (`settle`); only then are edge points taken, close to it, for the least squares. The steepest
place of a rim lies a little inside the silhouette: that inset is a fourth unknown, with a prior; it trades against the
distance, which is why the height of the centre over the plane, when the ball stands on it, carries the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project, unproject
from pipeline.light.sampling import bilinear, planes
from pipeline.types import Camera

# Of the steepest place of the rim's profile: 0.0 to 0.15 px on sharp ray-traced balls, 0.3 to 0.8 px on two blurred,
# demosaicked captures where the distance was known.
INSET_PX, INSET_SIGMA_PX = 0.4, 0.4
WINDOW_PX = 2.0  # half width of the search for edge points about the settled outline
SEARCH_AZIMUTHS, SEARCH_RADIUS_PX = 36, 20.0
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

    ``support``: fraction of the outline inside the frame that has an edge within 1 px; ``contrast``: votes for the
    outline over the median votes of outlines moved by up to 10 px; ``visible``: fraction of the outline in the frame.
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
    votes: float = 0.0

    @property
    def merit(self) -> float:
        """How much of a ball there is: votes, their excess over chance, and the share of edges that agree."""
        return self.votes * self.contrast * self.support


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


def search_on_plane(
    signals: list[np.ndarray], camera: Camera, radius: float, height: Height, keep: int = 12
) -> np.ndarray:
    """Centres (M <= keep, 3) of balls standing on the plane whose outlines get most votes, best first.

    The centre is restricted to the plane at the ball's height, so the search is over two pixel coordinates; it is done
    on pictures reduced until the ball is about 20 px in radius.
    """
    focal = 0.5 * (camera.fx + camera.fy)
    middle = unproject(camera, np.array([[camera.width / 2, camera.height / 2]]))[0]
    depth = float(_depth_at_height(np.append(middle, 1.0), height, radius))
    typical = focal * radius / depth if depth > 0 else SEARCH_RADIUS_PX
    small, view = zip(
        *(reduced(signal, camera, max(1, round(typical / SEARCH_RADIUS_PX))) for signal in signals), strict=True
    )
    centres = _lattice(view[0], radius, height, 2.0)
    if not len(centres):
        return centres
    score = _lattice_votes(list(small), view[0], centres, radius)
    found: list[np.ndarray] = []
    for index in np.argsort(-score):
        if len(found) == keep or not np.isfinite(score[index]):
            break
        if all(np.linalg.norm(centres[index] - other) > 0.3 * radius for other in found):
            found.append(centres[index])
    return np.array(found).reshape(-1, 3)


def reduced(signal: np.ndarray, camera: Camera, factor: int) -> tuple[np.ndarray, Camera]:
    """Signal and camera averaged down by a whole factor."""
    if factor == 1:
        return signal, camera
    height, width = (n // factor for n in signal.shape)
    means = signal[: height * factor, : width * factor].reshape(height, factor, width, factor).mean((1, 3))
    scaled = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return means, camera.model_copy(update={"width": width, "height": height, **scaled})


def _lattice(camera: Camera, radius: float, height: Height, pitch: float) -> np.ndarray:
    """Centres (N, 3) at the ball's height on a pixel lattice, those that make an outline of useful size."""
    x, y = np.meshgrid(np.arange(pitch / 2, camera.width, pitch), np.arange(pitch / 2, camera.height, pitch))
    xy = unproject(camera, np.stack([x.ravel(), y.ravel()], -1))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    depths = _depth_at_height(rays, height, radius)
    size = 0.5 * (camera.fx + camera.fy) * radius / np.where(depths > 0, depths, np.inf)
    return (rays * depths[:, None])[(depths > 1.2 * radius) & (size > MIN_RADIUS_PX)]


def _lattice_votes(signals: list[np.ndarray], camera: Camera, centres: np.ndarray, radius: float) -> np.ndarray:
    """Votes of outlines all over small pictures, less half of those just outside; -inf when mostly out of frame."""
    slopes = [_slopes(signal, 0.8) for signal in signals]
    total, beside = np.zeros(len(centres)), [np.zeros((len(centres), 1))] * len(slopes)
    for grown, share in ((1.25, -0.5), (1.0, 1.0)):
        px, normal, _ = silhouette(camera, centres, radius * grown, _azimuths(SEARCH_AZIMUTHS))
        inside = _inside(camera, px, 1)
        count = np.maximum(inside.sum(-1), 1)
        for i, slope in enumerate(slopes):
            found = bilinear(slope, px[..., 0], px[..., 1])
            strength = np.linalg.norm(found, axis=-1) + 1e-12
            if grown > 1:
                beside[i] = 2 * np.median(strength, -1, keepdims=True) + 1e-9
            across = np.abs((found * normal).sum(-1))
            vote = inside * (across / strength) ** 2 * across / (across + beside[i])
            total += share * vote.sum(-1) / count / len(slopes)
    total[inside.mean(-1) < 0.5] = -np.inf
    return total


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


def settle(
    signals: list[np.ndarray], camera: Camera, radius: float, seed: np.ndarray, height: Height
) -> tuple[np.ndarray, float, float]:
    """Centre (3,) on the plane near a seed where the outline has most votes; those, and the median votes about it.

    Three grids of centres, from a tenth of the radius or more to an eighth of a pixel. A vote is the slope across
    the outline over that slope plus twice the slope usual beside the ball, times how squarely it points across;
    ``signals`` (H, W) vote alike.
    """
    along = np.linalg.svd(height.normal[None])[2][1:]
    centre, votes, chance = seed + height.normal * (radius - height.of(seed)), 0.0, 0.0
    typical = min(radius_in_pixels(camera, centre, radius), 200.0)
    for blur, reach, step in ((1.0, max(10.0, 0.15 * typical), 1.0), (1.0, 1.5, 0.5), (0.7, 0.75, 0.125)):
        metres = radius / radius_in_pixels(camera, centre, radius)
        offsets = np.arange(-reach, reach + 1e-9, step) * metres
        grid = centre + np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2) @ along
        azimuth = _azimuths(int(np.clip(np.pi * typical, 60, 120 if step == 1.0 else 360)))
        counted = np.mean([_votes(signal, camera, grid, radius, blur, azimuth) for signal in signals], 0)
        chance = chance or float(np.median(counted))
        centre, votes = grid[counted.argmax()], float(counted.max())
    return centre, votes, chance


def _votes(
    signal: np.ndarray, camera: Camera, centres: np.ndarray, radius: float, blur: float, azimuth: np.ndarray
) -> np.ndarray:
    """Mean vote of the outline of each centre (N, 3), which lie close together."""
    typical = radius_in_pixels(camera, centres[len(centres) // 2], radius)
    corner, part, view = _around(signal, camera, centres[len(centres) // 2], radius, 1.4, typical)
    slope = _slopes(part, blur)
    beside = silhouette(view, centres[len(centres) // 2], 1.25 * radius, azimuth)[0]
    floor = (
        2 * float(np.median(np.linalg.norm(bilinear(slope, beside[None, :, 0], beside[None, :, 1]), axis=-1))) + 1e-9
    )
    px, normal, _ = silhouette(view, centres, radius, azimuth)
    inside = _inside(camera, px + corner, 2)
    found = bilinear(slope, px[..., 0], px[..., 1])
    across, strength = np.abs((found * normal).sum(-1)), np.linalg.norm(found, axis=-1) + 1e-12
    vote = inside * (across / strength) ** 2 * across / (across + floor)
    return vote.sum(-1) / np.maximum(inside.sum(-1), 1)


def _around(
    signal: np.ndarray, camera: Camera, centre: np.ndarray, radius: float, grown: float, typical: float
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Corner (x, y), pixels and camera of the part of a picture about a ball, with 15 px to spare."""
    px = silhouette(camera, centre, grown * radius, _azimuths(60))[0]
    limit = np.array([camera.width, camera.height])
    low = np.clip(np.floor(np.nanmin(px, 0)) - 15, 0, limit - 2).astype(int)
    high = np.clip(np.ceil(np.nanmax(px, 0)) + 15, low + 2, limit).astype(int)
    size = high - low
    moved = {
        "cx": camera.cx - int(low[0]),
        "cy": camera.cy - int(low[1]),
        "width": int(size[0]),
        "height": int(size[1]),
    }
    return low, signal[low[1] : high[1], low[0] : high[0]], camera.model_copy(update=moved)


def fit_sphere(
    signals: list[np.ndarray],
    camera: Camera,
    radius: float,
    settled: tuple[np.ndarray, float, float],
    height: Height,
) -> tuple[SphereFit, SphereFit]:
    """Fit the centre (3,) [m, camera frame] about a settled place: with the plane, and without it.

    Without the plane the distance rests on the radius of the rim alone, and inherits the uncertainty of its inset.
    """
    start, votes, chance = settled
    typical = radius_in_pixels(camera, start, radius)
    azimuth = _azimuths(int(np.clip(np.pi * typical, 60, 720)))  # one ray every two pixels: edges nearly independent
    visible = fraction_in_frame(camera, start, radius)
    best = max(signals, key=lambda signal: float(_votes(signal, camera, start[None], radius, 0.7, azimuth)[0]))
    groups, fits = planes(best), []
    for prior in (height, None):
        centre, inset, points = start, INSET_PX, 0
        covariance, rms = np.full((3, 3), np.inf), np.inf
        for _ in range(3):
            edges = _edge_points(groups, camera, centre, radius, azimuth, inset)
            if len(edges) < 12:
                break
            centre, inset, covariance, residual, weight = _solve(camera, edges, centre, inset, radius, prior)
            rms = float(np.sqrt((weight * residual**2).sum() / weight.sum()))
            points = int((np.abs(residual) < 1).sum())
        size = radius_in_pixels(camera, centre, radius)
        support = min(points / max(visible * len(azimuth), 1), 1.0)
        contrast = votes / max(chance, 1e-12)
        fits.append(SphereFit(centre, covariance, rms, points, size, inset, support, contrast, visible, votes))
    return fits[0], fits[1]


def _edge_points(
    groups: list[np.ndarray], camera: Camera, centre: np.ndarray, radius: float, azimuth: np.ndarray, inset: float
) -> np.ndarray:
    """Pixels (M, 2) of the steepest place of each profile near the expected edge; nearer counts more."""
    px, normal, _ = silhouette(camera, centre, radius, azimuth)
    step = 0.25
    offset = np.arange(-WINDOW_PX - 2, WINDOW_PX + 2 + step / 2, step)
    profile_px = px[:, None] + (offset - inset)[:, None] * normal[:, None]
    profile = bilinear(groups, profile_px[..., 0], profile_px[..., 1])[..., 0]
    blur = 0.7 / step
    taps = np.arange(-int(3 * blur), int(3 * blur) + 1).astype(float)
    kernel = -taps * np.exp(-0.5 * (taps / blur) ** 2)  # derivative of a Gaussian: slope of the smoothed profile
    kernel /= np.abs(kernel * taps).sum() * step
    padded = np.pad(profile, ((0, 0), (len(taps) // 2,) * 2), mode="edge")
    slope = np.abs(np.lib.stride_tricks.sliding_window_view(padded, len(taps), 1) @ kernel[::-1])
    preferred = slope * np.exp(-0.5 * (2 * offset / WINDOW_PX) ** 2)
    preferred[:, [0, -1]] = 0
    best = preferred.argmax(1)
    rows = np.arange(len(px))
    left, here, right = (slope[rows, np.clip(best + shift, 0, len(offset) - 1)] for shift in (-1, 0, 1))
    bend = left - 2 * here + right
    shift = np.where(bend < -1e-12, 0.5 * (left - right) / np.where(bend < -1e-12, bend, 1), 0)
    found = px + ((offset[best] + np.clip(shift, -1, 1) * step) - inset)[:, None] * normal
    use = _inside(camera, found, 2) & _inside(camera, px, 2) & (here > 0) & (preferred[rows, best] > 0)
    return found[use]


def _solve(
    camera: Camera, edges: np.ndarray, centre: np.ndarray, inset: float, radius: float, height: Height | None
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
        tuning = 2 * spread
        weight = 1 / (1 + (residual / tuning) ** 2)
        normal = jacobian.T @ (weight[:, None] * jacobian) / spread**2
        right = jacobian.T @ (weight * residual) / spread**2
        normal[3, 3] += 1 / INSET_SIGMA_PX**2
        right[3] += (inset - INSET_PX) / INSET_SIGMA_PX**2
        if height is not None:
            normal[:3, :3] += np.outer(height.normal, height.normal) / height.sigma_m**2
            right[:3] += height.normal * (height.of(centre) - radius) / height.sigma_m**2
        step = np.linalg.solve(normal, right)
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
    travelled = (
        np.abs((rays * axis).sum(1)) * step
    )  # the tangent step turns the ray by its length, and cos of it counts
    return np.linalg.norm(moved - edges, axis=1) / np.maximum(travelled, 1e-12)


def _inside(camera: Camera, px: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether pixels (..., 2) lie in the frame by at least ``margin``; NaN does not."""
    x, y = px[..., 0], px[..., 1]
    return (x >= margin) & (x <= camera.width - margin) & (y >= margin) & (y <= camera.height - margin)


def _azimuths(count: int) -> np.ndarray:
    return 2 * np.pi * (np.arange(count) + 0.5) / count
