"""The local scene as patches: what distant light reaches each, and how much each sees of the others.

Rays are Mitsuba's, their positions and directions a fixed low-discrepancy sequence (Roberts' generalised golden ratio),
so the same scene gives the same numbers. Patches are cells of the modelled rectangle and triangles of the proxies, cut
until they are as small. Occluders with geometry take light away; what they reflect is not known and counts as none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import irradiance, resize_environment
from pipeline.transport.ray_arrays import arrays_of_rays, batches, clear, rays_along
from pipeline.transport.reflectance import linear
from pipeline.transport.scene import ground_shape, proxy_shape
from pipeline.types import Occluder, Plane, Proxy

CELLS = 24  # along the longer side of the rectangle
MAX_TRIANGLES = 600  # of all proxies together
GATHER = 1024  # rays per patch for its form factors
FINAL_GATHER = 256  # rays per point of the plane for the light that patches send it
POINTS = 4  # per patch for the distant light
MAP = (32, 64)  # coarsest grid of the distant light
FINEST = 256  # rows of the distant light's finest grid: 0.7 degrees
SPLIT_SHARE = 0.004  # of the map's irradiance: a texel that holds more is split
STRONG_SHARE = 0.01  # of the plane's irradiance: a light that holds more casts edges worth tracing at every texel
CLEARANCE = 2e-5  # of the scene's size, between a ray's start and its surface


@dataclass(frozen=True, eq=False)
class Lights:
    """Distant light as many directional lights: unit ``direction`` (M, 3), ``power`` (M, 3) at normal incidence."""

    direction: np.ndarray
    power: np.ndarray


@dataclass(frozen=True, eq=False)
class Patches:
    """Parallelograms (the plane's cells, first, in rows) and triangles ``origin + s u + t v`` with their ``normal``."""

    origin: np.ndarray  # (N, 3) m
    u: np.ndarray  # (N, 3) m
    v: np.ndarray  # (N, 3) m
    normal: np.ndarray  # (N, 3) unit
    surface: np.ndarray  # (N,) 0 the plane, k the k-th proxy
    grid: tuple[int, int]  # rows and columns of the plane's cells

    def __len__(self) -> int:
        return len(self.origin)

    @property
    def cells(self) -> int:
        """How many patches belong to the plane."""
        return self.grid[0] * self.grid[1]

    @property
    def area(self) -> np.ndarray:
        """(N,) square metres."""
        return np.linalg.norm(np.cross(self.u, self.v), axis=1) * np.where(self.surface == 0, 1.0, 0.5)

    def points(self, count: int, dimensions: int = 2) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, count, 3) spread over each patch, and further coordinates (N, count, dimensions - 2) in [0, 1)."""
        numbers = golden(len(self) * count, dimensions).reshape(len(self), count, dimensions)
        s, t = numbers[..., 0], numbers[..., 1]
        fold = (self.surface[:, None] > 0) & (s + t > 1)
        s, t = np.where(fold, 1 - s, s), np.where(fold, 1 - t, t)
        points = self.origin[:, None] + s[..., None] * self.u[:, None] + t[..., None] * self.v[:, None]
        return points, numbers[..., 2:]


class Geometry:
    """The surfaces of the local scene, ready for rays from numpy arrays."""

    def __init__(self, plane: Plane, proxies: Sequence[Proxy], occluders: Sequence[Occluder] = ()) -> None:
        self.mi = arrays_of_rays("reflectance: proxies and occluders")
        side = np.linalg.norm(plane.corners_m[[1, 3]] - plane.corners_m[0], axis=1)
        size = side.max() / CELLS
        fine = subdivided(proxies, size)
        shapes: list[Any] = [self.mi.load_dict(ground_shape(plane, {"type": "diffuse"}))]
        shapes += [proxy_shape(self.mi, proxy, None) for proxy in fine]
        blockers = [proxy_shape(self.mi, occluder, None) for occluder in occluders if occluder.vertices_m is not None]
        named = {f"shape_{i:04d}": shape for i, shape in enumerate([*shapes, *blockers])}
        self.scene = self.mi.load_dict({"type": "scene", **named})
        self.shapes = shapes
        self.patches = patches_of(plane, fine, size)
        self.first = np.concatenate([[0], np.flatnonzero(np.diff(self.patches.surface)) + 1])
        self.clearance = CLEARANCE * side.max()

    def clear(self, start: np.ndarray, direction: np.ndarray, reach: np.ndarray | float = np.inf) -> np.ndarray:
        """Whether rays from ``start`` (N, 3) along unit ``direction`` (N, 3) meet nothing within ``reach``: (N,)."""
        return clear(self.mi, self.scene, start, direction, reach)

    def sees(self, points: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Which distant directions ``ways`` (M, 3) are open from ``points`` (P, 3): (P, M) bool."""
        clear = self.clear(np.repeat(points, len(ways), 0), np.tile(ways, (len(points), 1)))
        return clear.reshape(len(points), len(ways))

    def meets(self, start: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Patch that each ray meets (N,), -1 for none or a blocker, and whether it meets its back (N,)."""
        patch, back = np.full(len(start), -1), np.zeros(len(start), bool)
        rows, columns = self.patches.grid
        for part in batches(len(start)):
            hit = self.scene.ray_intersect(rays_along(self.mi, start[part], direction[part], np.inf))
            uv, prim = np.array(hit.uv).reshape(2, -1), np.array(hit.prim_index).astype(int)
            found = np.full(len(start[part]), -1)
            for number, shape in enumerate(self.shapes):
                on = np.array((hit.shape == self.mi.ShapePtr(shape)) & hit.is_valid(), bool)
                if number:
                    found[on] = self.first[number] + prim[on]
                else:
                    row, column = np.clip(
                        (uv[::-1][:, on] * [[rows], [columns]]).astype(int), 0, [[rows - 1], [columns - 1]]
                    )
                    found[on] = row * columns + column
            patch[part] = found
            normal = self.patches.normal[np.maximum(found, 0)]
            back[part] = (found >= 0) & ((normal * direction[part]).sum(1) > 0)
        return patch, back


def golden(count: int, dimensions: int) -> np.ndarray:
    """(count, dimensions) points of Roberts' sequence: multiples of powers of the generalised golden ratio, mod 1."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return np.mod(0.5 + np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1.0, dimensions + 1), 1.0)


def subdivided(proxies: Sequence[Proxy], size: float) -> list[Proxy]:
    """Proxies whose triangles are quartered until their sides are below ``size``, at most MAX_TRIANGLES in all."""
    corners = [np.asarray(p.vertices_m)[np.asarray(p.faces, int)] for p in proxies]  # (M, 3, 3) each
    while corners:
        longest = [np.linalg.norm(c - np.roll(c, 1, 1), axis=2).max(1) for c in corners]
        most = max(float(sides.max()) for sides in longest)
        cut = [sides > max(size, 0.71 * most) for sides in longest]  # the largest first, all of one size together
        if most <= size or sum(len(c) + 3 * mark.sum() for c, mark in zip(corners, cut)) > MAX_TRIANGLES:
            break
        corners = [np.concatenate([c[~mark], quartered(c[mark])]) for c, mark in zip(corners, cut)]
    return [
        p.model_copy(update={"vertices_m": c.reshape(-1, 3), "faces": np.arange(3 * len(c)).reshape(-1, 3)})
        for p, c in zip(proxies, corners)
    ]


def quartered(corners: np.ndarray) -> np.ndarray:
    """The four similar quarters (4 M, 3, 3) of triangles (M, 3, 3)."""
    middle = (corners + np.roll(corners, -1, 1)) / 2  # of the sides 01, 12, 20
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = np.moveaxis(middle, 1, 0)
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, 1) for part in parts])


def patches_of(plane: Plane, proxies: Sequence[Proxy], size: float) -> Patches:
    """Cells of about ``size`` metres of the plane's rectangle, then the triangles of the proxies."""
    corner = plane.corners_m
    along_u, along_v = corner[1] - corner[0], corner[3] - corner[0]
    columns, rows = (max(1, round(float(np.linalg.norm(a)) / size)) for a in (along_u, along_v))
    row, column = np.mgrid[:rows, :columns].reshape(2, -1)
    origin = [corner[0] + (column / columns)[:, None] * along_u + (row / rows)[:, None] * along_v]
    u, v = [np.tile(along_u / columns, (rows * columns, 1))], [np.tile(along_v / rows, (rows * columns, 1))]
    normal, surface = [np.tile(plane.normal, (rows * columns, 1))], [np.zeros(rows * columns, int)]
    for number, proxy in enumerate(proxies, 1):
        a, b, c = np.moveaxis(np.asarray(proxy.vertices_m)[np.asarray(proxy.faces, int)], 1, 0)
        outward = np.cross(b - a, c - a)
        origin.append(a)
        u.append(b - a)
        v.append(c - a)
        normal.append(outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-30))
        surface.append(np.full(len(a), number))
    vectors = [np.concatenate(part) for part in (origin, u, v, normal)]
    return Patches(vectors[0], vectors[1], vectors[2], vectors[3], np.concatenate(surface), (rows, columns))


def lights_of(environment: np.ndarray, coarsest: tuple[int, int] = MAP) -> Lights:
    """A map (H, W, 3) as directional lights: coarse texels, split where much power sits, at their centroid of power."""
    shapes = [coarsest]
    while 2 * shapes[-1][0] <= min(environment.shape[0], FINEST):
        shapes.append((2 * shapes[-1][0], 2 * shapes[-1][1]))
    height, width = shapes[-1]
    power = (
        np.maximum(resize_environment(environment, height, width), 0.0) * latlong_solid_angles(height, width)[..., None]
    )
    grey = power.sum(-1, keepdims=True)
    levels = [(power, grey * latlong_directions(height, width), grey)]
    while levels[-1][0].shape[0] > coarsest[0]:
        power, moment, grey = (_quarter(part) for part in levels[-1])
        levels.append((power, moment, grey))
    wanted = np.ones(coarsest, bool)
    direction, kept = [], []
    for number, (power, moment, grey) in enumerate(reversed(levels)):
        heavy = wanted & (grey[..., 0] > SPLIT_SHARE * levels[0][2].sum()) & (number < len(levels) - 1)
        taken = wanted & ~heavy & (grey[..., 0] > 0)
        direction.append(moment[taken] / np.linalg.norm(moment[taken], axis=-1, keepdims=True))
        kept.append(power[taken])
        wanted = heavy.repeat(2, 0).repeat(2, 1)
    return Lights(np.concatenate(direction), np.concatenate(kept))


def _quarter(values: np.ndarray) -> np.ndarray:
    height, width = values.shape[:2]
    return values.reshape(height // 2, 2, width // 2, 2, -1).sum((1, 3))


def form_factors(geometry: Geometry) -> np.ndarray:
    """(N, N) share of patch i's hemisphere, cosine weighted, that patch j fills; rows sum to at most 1."""
    patches, count = geometry.patches, len(geometry.patches)
    start, more = patches.points(GATHER, 4)
    direction = _cosine(patches.normal, more[..., 0], more[..., 1])
    begin = start + geometry.clearance * patches.normal[:, None]
    found, _ = geometry.meets(begin.reshape(-1, 3), direction.reshape(-1, 3))
    source = np.repeat(np.arange(count), GATHER)
    pair = (source * count + found)[found >= 0]
    factors = np.bincount(pair, minlength=count * count).reshape(count, count) / GATHER
    np.fill_diagonal(factors, 0.0)
    return factors


def _cosine(normal: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Directions (N, K, 3) around normals (N, 3), density cosine over pi, from numbers (N, K) in [0, 1)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normal, x)
    radius, angle = np.sqrt(a)[..., None], (2 * np.pi * b)[..., None]
    flat = radius * (np.cos(angle) * x[:, None] + np.sin(angle) * y[:, None])
    return flat + np.sqrt(np.maximum(1 - radius**2, 0)) * normal[:, None]


def direct_irradiance(geometry: Geometry, environment: np.ndarray, lights: Lights) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance (N, 3) of the distant light on each patch, occlusion included, and the share that is buried (N,).

    Points inside a closed proxy are left out of a patch's mean; a patch that lies wholly inside is NaN. What is not
    hidden is exact: the lights only weigh the visibility.
    """
    patches = geometry.patches
    start = patches.points(POINTS)[0] + geometry.clearance * patches.normal[:, None]
    outward = np.repeat(patches.normal, POINTS, 0)
    _, buried = geometry.meets(start.reshape(-1, 3), outward)
    buried = buried.reshape(len(patches), POINTS)
    normals, kind = np.unique(patches.normal.round(9), axis=0, return_inverse=True)
    exact = irradiance(environment, normals)
    arriving, unhidden = np.zeros((len(patches), 3)), np.zeros((len(patches), 3))
    for number, normal in enumerate(normals):
        ways, flux = upper(lights, normal)
        patch, point = np.nonzero((kind.ravel() == number)[:, None] & ~buried)
        for part in batches(len(patch), len(ways)):
            seen = geometry.sees(start[patch[part], point[part]], ways)
            np.add.at(arriving, patch[part], seen @ flux)
            np.add.at(unhidden, patch[part], flux.sum(0))
    share = np.divide(arriving, unhidden, out=np.full(arriving.shape, np.nan), where=unhidden > 0)
    return share * exact[kind.ravel()], buried.mean(1)


def upper(lights: Lights, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (K, 3) of the lights above a surface, and what each adds to its irradiance (K, 3)."""
    cosine = lights.direction @ normal
    above = cosine > 0
    return lights.direction[above], lights.power[above] * cosine[above][:, None]


def point_light(
    geometry: Geometry, lights: Lights, normal: np.ndarray, light: np.ndarray, points: np.ndarray, radiosity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance (P, 3) at ``points`` (P, 3) of the plane: of the distant light, and of what patches give off.

    ``light`` (3,): the plane's irradiance with nothing in the way; ``radiosity`` (N, 3) of the patches. NaN inside a
    closed proxy.
    """
    start = points + geometry.clearance * normal
    _, buried = geometry.meets(start, np.tile(normal, (len(start), 1)))
    ways, flux = upper(lights, normal)
    direct, bounced = np.full((len(points), 3), np.nan), np.full((len(points), 3), np.nan)
    free = np.flatnonzero(~buried)
    for part in (free[some] for some in batches(len(free), len(ways))):
        direct[part] = light * (geometry.sees(start[part], ways) @ flux) / flux.sum(0)
    numbers = golden(len(free) * FINAL_GATHER, 2).reshape(len(free), FINAL_GATHER, 2)
    direction = _cosine(np.tile(normal, (len(free), 1)), numbers[..., 0], numbers[..., 1])
    found, _ = geometry.meets(np.repeat(start[free], FINAL_GATHER, 0), direction.reshape(-1, 3))
    given = np.concatenate([radiosity, np.zeros((1, 3))])[found]  # -1, nothing met, reads the last row
    bounced[free] = given.reshape(len(free), FINAL_GATHER, 3).mean(1)
    return direct, bounced


def shadow_edges(
    geometry: Geometry, lights: Lights, normal: np.ndarray, light: np.ndarray, cells: np.ndarray, points: np.ndarray,
    wanted: np.ndarray, window: tuple[slice, slice], shape: tuple[int, int],
) -> np.ndarray:  # fmt: skip
    """What the edges of strong lights' shadows add to an irradiance that was interpolated between cells.

    ``cells`` (rows, columns, 3) are the centres of the cells, ``points`` (h, w, 3) the texels of a window of a texture
    of ``shape`` over the same rectangle, ``wanted`` (h, w) those that matter, ``light`` (3,) the plane's irradiance
    with nothing in the way. Returns (h, w, 3): irradiance of the strong lights at each texel less the interpolated one.
    Only cells where a light is partly hidden, and their neighbours, are traced.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    rows, columns = cells.shape[:2]
    row, column = (
        ((np.arange(part.start, part.stop) + 0.5) / size * count).astype(int)
        for part, size, count in zip(window, shape, (rows, columns))
    )
    ways, flux = upper(lights, normal)
    lift = geometry.clearance * normal
    result = np.zeros(points.shape)
    for number in np.flatnonzero((flux / light).max(1) > STRONG_SHARE):
        share = geometry.sees(cells.reshape(-1, 3) + lift, ways[number][None]).reshape(rows, columns, 1).astype(float)
        mixed = maximum_filter(share[..., 0], 3, mode="nearest") != minimum_filter(share[..., 0], 3, mode="nearest")
        texels = mixed[row[:, None], column[None]] & wanted
        traced = geometry.clear(points[texels] + lift, np.tile(ways[number], (texels.sum(), 1)))
        smooth = enlarged(share, *shape)[window][..., 0]
        result[texels] += (traced - smooth[texels])[:, None] * flux[number]
    return result


def enlarged(cells: np.ndarray, height: int, width: int) -> np.ndarray:
    """Cell means (rows, columns, C) on a finer grid (height, width, C), bilinear between the cells' centres."""
    rows, columns = cells.shape[:2]
    at_rows = (np.arange(height) + 0.5) / height * rows - 0.5
    at_columns = (np.arange(width) + 0.5) / width * columns - 0.5
    return linear(linear(cells, at_rows, 0), at_columns, 1)
