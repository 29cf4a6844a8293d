"""From a photographed mirror ball to a lat-long map: solid-angle means over texels of what the ball shows.

Two ways to the same integral. Where the ball is finer than the map, its pixels are splat: each spreads its radiance
over the solid angle it mirrors (`pipeline.probes.area_sums`), so lamps keep their energy exactly. Where it is coarser,
texels gather bilinear lookups, spaced by half a pixel at most, which is smooth; energy is then kept to the curvature
of the solid angle over a pixel.

Variance has parts that are shared differently. Photon noise (`Unwrapped.spread` times the pixels' variance) is each
pixel's own: only neighbours that look up the same pixels share it. The direction's (`displaced_variance`) comes from
three numbers of the fit and three of the pose, so all texels move together. The reflectance's is one number per channel
for the whole map and is not in here: `Observation.scale_sigma`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_solid_angles
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.area_sums import area_sums
from pipeline.probes.mirror_geometry import BAND_TEXELS, WORKERS, Mirror, bands, corners

FINE_PX = 1.0  # pixels per texel along a side, face on, from which on the ball counts as finer than the map
GATHER_PX = 0.5  # largest step of lookups
KERNEL_FIT = 0.94  # of the Gaussian that stands for texel and pixel below: within 6 % of boxes and tents of 0 to 5 px
PIXEL_KERNEL = {"splat": 1 / 12, "gather": 1 / 6}  # variance [px^2] along an axis: pixels are boxes, lookups tents


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """One view on the lat-long grid.

    ``values`` (H, W, C) means of the channels, zero where nothing is seen; ``coverage`` (H, W) in [0, 1] how much of
    the texel is seen inside the rim and valid; ``pixels`` (H, W) area of the texel in the photograph [px]; ``spread``
    (H, W) variance of a texel's mean over that of one of its pixels, which are taken as independent.
    """

    values: np.ndarray
    coverage: np.ndarray
    pixels: np.ndarray
    spread: np.ndarray
    method: str


def method_for(radius_px: float, width: int) -> str:
    """``splat`` for a ball finer than the map, else ``gather``: a pixel's side in its middle mirrors 2 / radius rad."""
    return "splat" if np.pi / width * radius_px > FINE_PX else "gather"


def unwrap(
    valid: np.ndarray, channels: list[np.ndarray], mirror: Mirror, height: int, width: int, method: str
) -> Unwrapped:
    """Lat-long map (height, width), world frame, of the ball in a picture; radiance as photographed.

    ``valid`` (h, w) float32, 1 where the channels are known; ``channels`` (h, w) float32 each, zero elsewhere. Pixels
    beyond the mirror's rim are left out. ``method``: ``splat`` or ``gather``, see `method_for`.
    """
    edges = corners(mirror, height, width)
    if method == "splat":
        sums = area_sums([valid, *channels], mirror, edges)
        whole = latlong_solid_angles(height, width).astype(np.float32)
    else:
        sums, whole = _gather([valid, *channels], mirror, edges)
    weight = sums[..., 0]
    weight[weight < 1e-5 * whole] = 0  # slivers: rounding
    values = sums[..., 1:]
    values *= np.where(weight > 0, 1 / np.where(weight > 0, weight, 1), 0)[..., None]
    coverage = np.minimum(weight / whole, 1)
    pixels, spread = footprint(edges[0], edges[1], PIXEL_KERNEL[method])
    return Unwrapped(values, coverage, pixels, spread / np.maximum(coverage, 1e-3), method)


def footprint(x: np.ndarray, y: np.ndarray, kernel: float) -> tuple[np.ndarray, np.ndarray]:
    """Area of texels in the photograph [px] and the sum of the squared weights that their means give to pixels.

    From corners (H + 1, W + 1). Texel and pixel, convolved, are taken as the Gaussian of the same second moments, whose
    square integrates to ``1 / (4 pi sqrt(det))``.
    """
    ux, uy = (0.5 * (np.diff(p[1:], axis=1) + np.diff(p[:-1], axis=1)) for p in (x, y))
    vx, vy = (0.5 * (np.diff(p[:, 1:], axis=0) + np.diff(p[:, :-1], axis=0)) for p in (x, y))
    xx, yy, xy = ((a * b + c * d) / 12 for a, b, c, d in ((ux, ux, vx, vx), (uy, uy, vy, vy), (ux, uy, vx, vy)))
    determinant = (xx + kernel) * (yy + kernel) - xy * xy
    spread = KERNEL_FIT / (4 * np.pi * np.sqrt(determinant))
    return np.abs(ux * vy - uy * vx).astype(np.float32), spread.astype(np.float32)


def _gather(
    channels: list[np.ndarray], mirror: Mirror, edges: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Sums (H, W, C) of weight times lookup, weights the sine of the latitude's angle; and of the weights (H, W)."""
    height, width = edges[0].shape[0] - 1, edges[0].shape[1] - 1
    groups = planes(np.stack(channels, -1))
    focal = max(mirror.camera.fx, mirror.camera.fy)
    count = max(2, int(np.ceil(np.pi / width * focal * np.tan(np.arcsin(mirror.ratio)) / GATHER_PX)))
    sums = np.zeros((height, width, len(channels)), np.float32)
    whole = np.zeros((height, width), np.float32)
    with ThreadPoolExecutor(WORKERS) as pool:
        blocks = bands(height, BAND_TEXELS // width)
        list(pool.map(lambda b: _gather_band(groups, mirror, edges, b, count, sums[b], whole[b]), blocks))
    return sums, whole


def _gather_band(
    groups: list[np.ndarray], mirror: Mirror, edges: tuple[np.ndarray, np.ndarray, np.ndarray], block: slice,
    count: int, sums: np.ndarray, whole: np.ndarray,
) -> None:  # fmt: skip
    """Some rows of `_gather`, into ``sums`` and ``whole``; positions are bilinear between the texel's corners."""
    height = edges[0].shape[0] - 1
    camera, limit = mirror.camera, np.arcsin(mirror.rim)
    lines = [e[block.start : block.stop + 1] for e in edges]
    for dv in (np.arange(count) + 0.5) / count:
        row = [e[:-1] + dv * (e[1:] - e[:-1]) for e in lines]
        sine = np.sin(np.pi * (np.arange(block.start, block.stop) + dv) / height).astype(np.float32)[:, None]
        for du in (np.arange(count) + 0.5) / count:
            x, y, angle = (e[:, :-1] + du * (e[:, 1:] - e[:, :-1]) for e in row)
            inside = (x >= 0.5) & (x <= camera.width - 0.5) & (y >= 0.5) & (y <= camera.height - 0.5)
            weight = sine * (inside & (angle <= limit))
            sums += weight[..., None] * bilinear(groups, np.where(inside, x, 0), np.where(inside, y, 0))
            whole += sine


def displaced_variance(rgb: np.ndarray, direction: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Variance (H, W, C), float32, of texels whose direction is uncertain: to first order, gradient' K gradient.

    ``direction`` (H, W, 3): covariance of the direction [rad^2], (down down, east east, down east). The gradient is
    over two texels; beside what is not covered it is zero. Noise of the texels counts as gradient.
    """
    height, width = coverage.shape
    out = np.zeros(rgb.shape, np.float32)

    def fill(block: slice) -> None:
        rows = np.arange(block.start, block.stop)
        above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, height - 1)
        span = (np.pi / height * (below - above))[:, None].astype(np.float32)
        down = (rgb[below] - rgb[above]) * (((coverage[below] > 0) & (coverage[above] > 0)) / span)[..., None]
        here, covered = rgb[block], coverage[block] > 0
        sine = np.sin(np.pi * (rows + 0.5) / height).astype(np.float32)[:, None]
        both = np.roll(covered, -1, 1) & np.roll(covered, 1, 1)
        east = (np.roll(here, -1, 1) - np.roll(here, 1, 1)) * (both / (np.float32(4 * np.pi / width) * sine))[..., None]
        k = direction[block]
        out[block] = k[..., :1] * down * down + k[..., 1:2] * east * east + 2 * k[..., 2:] * down * east

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(fill, bands(height, BAND_TEXELS // width)))
    return out
