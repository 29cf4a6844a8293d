"""Lat-long texels and pixels of one photographed mirror ball: where each is seen, and how much solid angle it holds.

Everything is symmetric about the axis camera -> centre, so the exact reflection (`pipeline.probes.reflection`) is
tabulated once over the cosine of its only angle. Pixels: first centre (0.5, 0.5). Frames: world for directions, the
camera's for the centre.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.distortion import distort, fold_radius_squared, is_pinhole
from pipeline.camera.lens import project, rays_through
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.glass import Glass
from pipeline.probes.reflection import first_slope, incidence, solid_angle_gain
from pipeline.types import Camera

TABLE = 1 << 16  # steps of the cosine: 1e-10 in the table's middle, 1e-5 rad at 1 degree from its end
RAY_STEP_PX, RAY_STEP = 16, 0.02  # grid on which the lens is inverted, at most so many px and focal lengths: between,
# rays are linear, off by 0.75 k1 r RAY_STEP^2, 1e-5 of strong lenses
BAND_TEXELS, BAND_PIXELS = 1 << 14, 1 << 17  # at once, per thread: their temporaries stay in the cache
WORKERS = min(8, os.cpu_count() or 1)


def bands(length: int, size: int) -> Iterator[slice]:
    """Slices of at most ``size`` that cover ``length``."""
    for start in range(0, length, max(1, size)):
        yield slice(start, min(start + max(1, size), length))


@dataclass(frozen=True, eq=False)
class Mirror:
    """A ball in a picture: its camera, ``rotation`` (3, 3) camera_from_world, ``centre`` (3,) and ``radius`` [m].

    ``rim``: outermost radius that is used, as a fraction of the silhouette's (sine of the incidence). ``glass`` before
    the mirror, if any.
    """

    camera: Camera
    rotation: np.ndarray
    centre: np.ndarray
    radius: float
    rim: float
    glass: Glass | None = None

    @property
    def ratio(self) -> float:
        """R / D."""
        return self.radius / float(np.linalg.norm(self.centre))

    @property
    def radius_px(self) -> float:
        """Radius of the silhouette were it in the middle of the picture; a pixel there mirrors about 2 / radius rad."""
        return max(self.camera.fx, self.camera.fy) * float(np.tan(np.arcsin(self.ratio)))

    @property
    def axis(self) -> np.ndarray:
        """(3,) unit direction from the camera to the centre, camera frame."""
        return self.centre / np.linalg.norm(self.centre)

    def enlarged(self, factor: int) -> Mirror:
        """The same ball in a picture with ``factor`` times as many pixels along each side."""
        camera = self.camera
        scaled = {name: factor * getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        return replace(self, camera=camera.model_copy(update=scaled))

    @property
    def ends(self) -> np.ndarray:
        """(2, 2) pixels x, y of the highest and the lowest point of the silhouette."""
        first = np.linalg.svd(self.axis[None])[2][1]
        azimuth = np.linspace(0, 2 * np.pi, 720)[:, None]
        spokes = np.cos(azimuth) * first + np.sin(azimuth) * np.cross(self.axis, first)
        px = project(self.camera, np.sqrt(1 - self.ratio**2) * self.axis + self.ratio * spokes)
        return px[[np.nanargmin(px[:, 1]), np.nanargmax(px[:, 1])]]

    @functools.cached_property
    def table(self) -> np.ndarray:
        """(TABLE + 2, 3) over cos theta = 1 ... -1: how much of the direction and of the axis make the ray; incidence.

        Blind directions get the rays of the silhouette.
        """
        theta = np.arccos(np.clip(1 - 2 * np.arange(TABLE + 2) / TABLE, -1, 1))
        angle = incidence(theta, self.ratio, self.glass)
        sine = self.ratio * np.sin(np.minimum(angle, np.pi / 2))
        sine_theta = np.sin(theta)
        limit = self.ratio / first_slope(self.ratio, self.glass)  # of sin rho / sin theta, towards the camera
        along = np.where(sine_theta > 1e-6, sine / np.maximum(sine_theta, 1e-6), np.where(theta < 1, limit, 0))
        return np.stack([along, np.sqrt(1 - sine * sine) + np.cos(theta) * along, angle], -1)

    @functools.cached_property
    def lens_nodes(self) -> tuple[list[np.ndarray], tuple[float, float], float]:
        """The inverse of the lens on a grid between the outermost pixels' centres (h', w', 3), its steps [px], scale.

        X/Z and Y/Z less the centre's, and the area of Z = 1 that a pixel covers, over ``scale``.
        """
        camera, axis = self.camera, self.axis
        step = int(np.clip(RAY_STEP * min(camera.fx, camera.fy), 1, RAY_STEP_PX))
        x, y = (np.linspace(0.5, n - 0.5, n // step + 2) for n in (camera.width, camera.height))
        xn, dxn = rays_through(camera, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        area = np.abs(np.linalg.det(dxn))
        nodes = np.concatenate([xn - axis[:2] / axis[2], area[:, None] / area.mean()], 1)
        return planes(nodes.reshape(len(y), len(x), 3)), (x[1] - x[0], y[1] - y[0]), float(area.mean())

    def looked_up(self, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The three columns of `table`, linear between its rows."""
        position = (1 - cosine) * (TABLE / 2)
        row = np.clip(position, 0, TABLE).astype(np.intp)
        share = position - row
        low, high = self.table.take(row, 0), self.table.take(row + 1, 0)
        found = low + share[..., None] * (high - low)
        return found[..., 0], found[..., 1], found[..., 2]


def directions(row: np.ndarray, column: np.ndarray, height: int, width: int, rotation: np.ndarray) -> list[np.ndarray]:
    """Components (N, M) of the unit directions of lat-long positions in texels, turned by ``rotation`` (3, 3)."""
    theta, phi = np.pi * row / height, 2 * np.pi * column / width
    ring = rotation @ np.stack([np.sin(phi), 0 * phi, -np.cos(phi)])
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    return [sine * ring[i] + cosine * rotation[i, 1] for i in range(3)]


def pixels_of(
    mirror: Mirror, row: np.ndarray, column: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels x, y (N, M) that show the lat-long positions ``row`` (N,), ``column`` (M,) in texels; and the incidence.

    Blind directions (incidence over pi/2) are put on the silhouette, at their own azimuth.
    """
    w = directions(row, column, height, width, mirror.rotation)
    axis = mirror.axis
    along, back, angle = mirror.looked_up(-(w[0] * axis[0] + w[1] * axis[1] + w[2] * axis[2]))
    ray = [along * w[i] + back * axis[i] for i in range(3)]
    xy = np.stack([ray[0] / ray[2], ray[1] / ray[2]], -1)
    camera = mirror.camera
    if not is_pinhole(camera.distortion):
        fold = 0.98 * np.sqrt(fold_radius_squared(camera.distortion))
        if np.isfinite(fold):
            xy *= np.minimum(1, fold / np.maximum(np.hypot(xy[..., 0], xy[..., 1]), 1e-12))[..., None]
        xy = distort(camera.distortion, xy)
    x, y = xy[..., 0] * camera.fx + camera.cx, xy[..., 1] * camera.fy + camera.cy
    return x, y, angle


def corners(mirror: Mirror, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`pixels_of` the corners of all texels: x, y, incidence (H + 1, W + 1); the last column repeats the first."""
    _ = mirror.table  # once, before the threads ask for it
    with ThreadPoolExecutor(WORKERS) as pool:
        work = (np.arange(b.start, b.stop) for b in bands(height + 1, BAND_TEXELS // width))
        parts = list(pool.map(lambda lines: pixels_of(mirror, lines, np.arange(width), height, width), work))
    x, y, angle = (np.concatenate(p) for p in zip(*parts, strict=True))
    x, y, angle = (np.concatenate([p, p[:, :1]], 1) for p in (x, y, angle))
    return x, y, angle


def pixel_solid_angles(mirror: Mirror, rows: slice) -> np.ndarray:
    """Solid angle [sr] of the environment (h, w), float32, that each pixel of some rows mirrors; 0 beyond the rim.

    The pixel's own solid angle, from the lens, times the gain of the reflection, both at its centre. The rule of the
    centre is off by 0.03 / d^2 of the value at d pixels under the silhouette, where the gain grows as d^-1/2.
    """
    axis = mirror.axis
    nodes, (step_x, step_y), scale = mirror.lens_nodes
    x = np.arange(mirror.camera.width) / step_x + 0.5
    y = np.arange(rows.start, rows.stop) / step_y + 0.5
    fine = bilinear(nodes, *np.broadcast_arrays(x[None], y[:, None]))
    dx, dy = fine[..., 0], fine[..., 1]
    a = axis.astype(np.float32)
    square = 1 + (dx + a[0] / a[2]) ** 2 + (dy + a[1] / a[2]) ** 2
    cross = a[2] ** 2 * (dx * dx + dy * dy) + (dx * a[1] - dy * a[0]) ** 2
    sine2 = cross / (square * np.float32(mirror.ratio**2))
    inside = sine2 <= mirror.rim**2
    gain = solid_angle_gain(np.where(inside, sine2, 0), mirror.ratio, mirror.glass)
    return np.where(inside, gain * fine[..., 2] * np.float32(scale) / (square * np.sqrt(square)), 0)


def texel_directions(
    mirror: Mirror, height: int, width: int, centre_covariance: np.ndarray, turn_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sine of the incidence (H, W) at texel centres, NaN where blind, and the covariance of what they look at.

    The covariance (H, W, 3) [rad^2] is of the direction that a texel really shows, along (down, east): entries
    (down down, east east, down east). ``centre_covariance`` (3, 3) of the fitted centre, camera frame [m^2];
    ``turn_covariance`` (3, 3) of the pose's rotation vector, world frame [rad^2]. Both are taken as independent.

    A fixed ray meets a ball that was displaced by d under a turned normal; the mirrored direction moves by
    ``-(2 / R) (m . d / cos i, cos i t . d)`` in the plane of reflection and across it, m and t being the unit vectors
    normal to the ray in that plane and across it. Glass adds half its turn's slope to ``1 / cos i`` and makes
    ``cos i`` be ``sin(2 i + turn) / (2 sin i)``.
    """
    sine = np.full((height, width), np.nan, np.float32)
    covariance = np.zeros((height, width, 3), np.float32)
    world = mirror.rotation.T @ centre_covariance @ mirror.rotation
    axis = mirror.rotation.T @ mirror.axis

    _ = mirror.table

    def fill(block: slice) -> None:
        row = np.arange(block.start, block.stop) + 0.5
        sine[block], covariance[block] = _band_directions(mirror, axis, world, turn_covariance, row, height, width)

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(fill, bands(height, BAND_TEXELS // width)))
    return sine, covariance


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _band_directions(
    mirror: Mirror, axis: np.ndarray, centre: np.ndarray, turn: np.ndarray, row: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """`texel_directions` of some rows; ``axis`` and the covariance of the ``centre`` in the world frame."""
    column = np.arange(width) + 0.5
    w = np.stack(directions(row, column, height, width, np.eye(3)), -1)
    theta, phi = np.pi * row[:, None] / height, 2 * np.pi * column / width
    down = np.stack([np.cos(theta) * np.sin(phi), -np.sin(theta) + 0 * phi, -np.cos(theta) * np.cos(phi)], -1)
    east = np.stack([np.cos(phi), 0 * phi, np.sin(phi)], -1)
    cosine = -(w @ axis)
    angle = mirror.looked_up(cosine)[2]
    blind = angle > np.pi / 2
    sine = np.where(blind, np.nan, np.sin(angle))
    into = np.maximum(np.cos(angle), 1e-3)
    rho = np.arcsin(mirror.ratio * np.sin(np.minimum(angle, np.pi / 2)))
    across = np.cross(axis, w)
    length = np.maximum(np.sqrt(_dot(across, across)), 1e-9)[..., None]
    across /= length
    spoke = (w + cosine[..., None] * axis) / length
    ahead = np.cos(rho)[..., None] * spoke - np.sin(rho)[..., None] * axis
    scale = 4 / mirror.radius**2
    turned = ahead @ centre
    outward, aside = 1 / into, into
    if mirror.glass is not None:
        safe = np.clip(np.nan_to_num(sine, nan=1.0), 1e-6, 1)
        outward = outward + 0.5 * mirror.glass.turn_slope(safe)
        aside = np.sin(2 * np.arcsin(safe) + mirror.glass.turn(safe)) / (2 * safe)
    radial = scale * _dot(turned, ahead) * outward**2
    mixed = scale * _dot(turned, across) * (outward * aside)
    tangential = scale * _dot(across @ centre, across) * aside**2
    p, q = (((down @ axis) / length[..., 0]), (east @ axis) / length[..., 0])  # of the direction of growing theta
    first, second, turned = east @ turn, down @ turn, _dot(down @ turn, east)
    found = np.stack(
        [
            p * p * radial - 2 * p * q * mixed + q * q * tangential + _dot(first, east),
            q * q * radial + 2 * p * q * mixed + p * p * tangential + _dot(second, down),
            p * q * (radial - tangential) + (p * p - q * q) * mixed - turned,
        ],
        -1,
    )
    return sine, found
