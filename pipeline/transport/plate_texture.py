"""The plate on the plane: radiance of every texel of the modelled rectangle, with its variance, noise not baked in.

A texel is the weighted mean of the pixels it covers, with the weight of a random-effects mean (DerSimonian and Laird
1986), 1 / (noise variance + texture variance): plain averages on texture, inverse-variance averages where noise rules.
Then it is drawn towards the mean of its surroundings by noise / (noise + texture) (Lee 1980, with the noise known from
the plate instead of guessed), so detail below the noise does not become albedo, and detail above it stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import CLIPPED, invert_rigid, transform_points
from pipeline.image.metrics import box
from pipeline.light.sampling import bilinear, planes
from pipeline.transport.reflectance import fill_unseen
from pipeline.types import Camera, Plane, Raster, View

MAX_SUPERSAMPLE = 2
COARSE = 24  # steps of the grid that finds which part of the rectangle the plate shows
WINDOW_PX = 7  # of the surroundings that tell texture from noise
SURROUNDINGS_PX = 15  # whose noise and texture weigh a pixel: weights of neighbours differ by a few percent
OUTLIER = 4.0  # a pixel's variance over that of its surroundings, from which on it is its own (disagreeing frames)


@dataclass(frozen=True, eq=False)
class Texture:
    """Radiance (h, w, 3) of texels, variance (h, w, 3) of their noise, ``seen`` share (h, w).

    ``window``: the slices of the whole rectangle's rows and columns that these texels are; nothing outside is seen.
    """

    radiance: np.ndarray
    variance: np.ndarray
    seen: np.ndarray
    window: tuple[slice, slice]
    texel_px: float  # median side of a texel in the plate


def texture_size(plane: Plane, longest: int) -> tuple[int, int]:
    """(rows, columns) of a texture with square texels and ``longest`` of them along the longer side."""
    size = np.linalg.norm(plane.corners_m[[1, 3]] - plane.corners_m[0], axis=1)
    columns, rows = np.maximum(1, np.round(longest * size / size.max())).astype(int)
    return int(rows), int(columns)


def texel_points(plane: Plane, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """World points (len(rows), len(columns), 3) at fractional texel positions; row 0 starts at corners 0 and 1."""
    along_u, along_v = plane.corners_m[1] - plane.corners_m[0], plane.corners_m[3] - plane.corners_m[0]
    v, u = np.asarray(rows) / shape[0], np.asarray(columns) / shape[1]
    return plane.corners_m[0] + v[:, None, None] * along_v + u[None, :, None] * along_u


def window_points(plane: Plane, window: tuple[slice, slice], shape: tuple[int, int]) -> np.ndarray:
    """World points (h, w, 3) of the texel centres of a window of a texture of ``shape`` over the plane."""
    rows, columns = (np.arange(part.start, part.stop) + 0.5 for part in window)
    return texel_points(plane, rows, columns, shape)


def seen_window(camera: Camera, view: View, plane: Plane, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns that hold every texel the plate can show, by a coarse grid and one of its steps around."""
    edges = [np.linspace(0, size, COARSE + 1) for size in shape]
    points = texel_points(plane, edges[0], edges[1], shape)
    px = project(camera, transform_points(invert_rigid(view.world_from_camera), points.reshape(-1, 3)))
    inside = np.all((px >= 0) & (px <= (camera.width, camera.height)), -1).reshape(points.shape[:2])
    window = []
    for axis in (0, 1):
        found = np.flatnonzero(inside.any(1 - axis))
        low, high = (found[0], found[-1]) if len(found) else (0, COARSE)
        window.append(slice(int(edges[axis][max(low - 1, 0)]), int(np.ceil(edges[axis][min(high + 1, COARSE)]))))
    return window[0], window[1]


def weights(rgb: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(H, W) random-effects weights of pixels for averages over neighbours; only their ratio within a texel matters.

    Noise and texture are those of the surroundings, so that a weight does not follow its own pixel's value (a Poisson
    variance falls with it: inverse-variance means of few counts are too dark) and edges stay where they are. Pixels
    with OUTLIER times the noise of their surroundings keep their own.
    """
    own, value = variance.sum(-1), rgb.sum(-1)
    noise = box(own, SURROUNDINGS_PX)
    spread = np.maximum(box(value * value, SURROUNDINGS_PX) - box(value, SURROUNDINGS_PX) ** 2, 0.0)
    texture = np.maximum(spread - noise, 0.0)
    return 1.0 / np.maximum(np.where(own > OUTLIER * noise, own, noise) + texture, 1e-30)


def read_plate(plate: Raster, camera: Camera, view: View, plane: Plane, shape: tuple[int, int]) -> Texture:
    """The plate's radiance on a texture of ``shape`` over the plane. Clipped and unusable pixels have no weight.

    Without variance channels the noise is taken as none. The variance of a texel is that of one pixel over the number
    of pixels it covers; that pixels next to each other share photosites is not counted.
    """
    rgb = plate.rgb()
    window = seen_window(camera, view, plane, shape)
    rows, columns = (np.arange(part.start, part.stop) for part in window)
    noise = plate.rgb("variance") if "variance.R" in plate.channels else np.zeros_like(rgb)
    usable = np.isfinite(rgb).all(-1) & np.isfinite(noise).all(-1) & ((plate["mask"] & CLIPPED) == 0)
    rgb, noise = np.where(usable[..., None], rgb, 0.0), np.where(usable[..., None], noise, 0.0)
    weight = usable * (weights(rgb, noise) if noise.any() else 1.0)
    weight = weight / max(float(np.median(weight[usable])) if usable.any() else 1.0, 1e-300)
    weight = np.clip(weight, 1e-6 * usable, 1e6)
    picture = planes(np.dstack([weight[..., None] * rgb, weight, (weight**2)[..., None] * noise, usable]))
    camera_from_world = invert_rigid(view.world_from_camera)
    middle = texel_points(plane, rows[:: max(1, len(rows) // 8)] + 0.5, columns + 0.5, shape)
    texel_px = _texel_px(camera, camera_from_world, middle)
    splits = int(np.clip(np.ceil(texel_px), 1, MAX_SUPERSAMPLE))
    total = np.zeros((len(rows), len(columns), 8))
    for i in range(splits * splits):
        step = (np.array(divmod(i, splits)) + 0.5) / splits
        points = texel_points(plane, rows + step[0], columns + step[1], shape)
        px = project(camera, transform_points(camera_from_world, points.reshape(-1, 3))).reshape(*points.shape[:2], 2)
        inside = np.all((px >= 0) & (px <= (camera.width, camera.height)), -1)  # False for NaN: not imaged
        px = np.where(inside[..., None], px, 0.0)
        total += np.where(inside[..., None], bilinear(picture, px[..., 0], px[..., 1]), 0.0)
    weight = np.maximum(total[..., 3:4], 1e-12)
    covered = np.clip(texel_px, 1, splits) ** 2  # pixels that went into a texel
    variance = total[..., 4:7] / weight**2 * splits**2 / covered
    return Texture(total[..., :3] / weight, variance, total[..., 7] / splits**2, window, texel_px)


def _texel_px(camera: Camera, camera_from_world: np.ndarray, points: np.ndarray) -> float:
    """Median distance in the plate of neighbouring points (K, M, 3) of a row; 1 when none is in the frame."""
    px = project(camera, transform_points(camera_from_world, points.reshape(-1, 3))).reshape(*points.shape[:2], 2)
    inside = np.all((px >= 0) & (px <= (camera.width, camera.height)), -1)
    steps = np.linalg.norm(np.diff(px, axis=1), axis=-1)[inside[:, 1:] & inside[:, :-1]]
    return float(np.median(steps)) if len(steps) else 1.0


def shrunk(texture: Texture) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (h, w, 3) with noise drawn out, and the share (h, w, 3) of each texel's own detail that was kept.

    ``mean + k (value - mean)`` with ``k = t / (t + n)``: n the texel's noise variance, t the texture variance of its
    surroundings (their sample variance less their noise), over seen texels of a window of WINDOW_PX plate pixels.
    """
    if not texture.variance.any():
        return texture.radiance, np.ones_like(texture.radiance)
    size = 2 * round(WINDOW_PX / 2 / min(texture.texel_px, 1.5)) + 1
    seen = (texture.seen > 0.5).astype(float)[..., None]
    count = np.maximum(box(seen, size), 1e-9)
    mean = box(seen * texture.radiance, size) / count
    away = texture.radiance - mean
    noise = box(seen * texture.variance, size) / count
    spread = np.maximum(box(seen * texture.radiance**2, size) / count - mean**2 - noise, 0.0)
    kept = np.divide(spread, spread + texture.variance, out=np.ones_like(spread), where=texture.variance > 0)
    return mean + kept * away, kept


def continued(
    values: np.ndarray, weight: np.ndarray, window: tuple[slice, slice], shape: tuple[int, int]
) -> np.ndarray:
    """The texture (H, W, 3) of ``shape`` with ``values`` (h, w, 3) in its window, continued where ``weight`` is 0."""
    whole, share = np.zeros((*shape, values.shape[-1])), np.zeros(shape)
    whole[window] = np.where(weight[..., None] > 0, values, 0.0)
    share[window] = np.minimum(weight, 1.0)
    return fill_unseen(whole, share)
