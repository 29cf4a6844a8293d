"""From a photographed mirror ball to a lat-long map: solid-angle means over texels of what the ball shows.

Pixels are splat: each spreads its radiance over the solid angle it mirrors (`pipeline.probes.area_sums`), so lamps
neither alias nor lose energy. Where the ball is coarser than the map its picture is first enlarged, bilinear, so that
texels do not show its pixels as blocks; energy is then kept to the curvature of the solid angle over a pixel.

Variance has parts that are shared differently. Photon noise (`Unwrapped.spread` times the pixels' variance) is each
pixel's own: only neighbours that look up the same pixels share it. The direction's (`displaced_variance`) comes from
three numbers of the fit and three of the pose, so all texels move together. The reflectance's is one number per channel
for the whole map and is not in here: `Observation.scale_sigma`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from pipeline.conventions import latlong_solid_angles
from pipeline.light.sampling import enlarged
from pipeline.probes.area_sums import area_sums
from pipeline.probes.mirror_geometry import BAND_TEXELS, WORKERS, Mirror, bands, corners
from pipeline.probes.reflection import incidence

FINE_PX = 1.0  # pixels per texel along a side, face on, from which on the ball is not enlarged
MOST = 8  # times that it is enlarged: blocks of a ball that is coarser still are no worse than its blur
LEAST_WIDTH = 1024  # of the grid whose texels are polygons: coarser ones are sums, as their edges are curved
KERNEL_FIT = 0.94  # of the Gaussian that stands for texel and pixel below: within 6 % of boxes and tents of 0 to 5 px
BOX, TENT = 1 / 12, 1 / 6  # variance [px^2] along an axis of a pixel, and of one that was enlarged


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


def enlargement(mirror: Mirror, width: int) -> int:
    """How many times the picture is enlarged: until a pixel in the ball's middle, 2 / radius rad, is a texel's size."""
    return int(np.clip(np.ceil(FINE_PX * width / (np.pi * mirror.radius_px)), 1, MOST))


def unwrap(
    valid: np.ndarray, channels: list[np.ndarray], mirror: Mirror, height: int, width: int, factor: int | None = None
) -> Unwrapped:
    """Lat-long map (height, width), world frame, of the ball in a picture; radiance as photographed.

    ``valid`` (h, w) float32, 1 where the channels are known; ``channels`` (h, w) float32 each, zero elsewhere. Pixels
    beyond the mirror's rim are left out. ``factor`` overrides `enlargement`.
    """
    factor = enlargement(mirror, width) if factor is None else factor
    gap = np.hypot(
        np.pi / height, 2 * np.pi / width
    )  # a texel's diagonal stays unseen: its corners must not surround it
    widest = np.sin(np.minimum(incidence(np.array(np.pi - gap), mirror.ratio, mirror.glass), np.pi / 2))
    mirror = replace(mirror, rim=min(mirror.rim, float(widest)))
    parts = -(-LEAST_WIDTH // width)
    edges = corners(mirror, parts * height, parts * width)
    coarse = slice(None, None, parts)
    pixels, spread = footprint(edges[0][coarse, coarse], edges[1][coarse, coarse], BOX if factor == 1 else TENT)
    layers = [valid, *channels]
    if factor > 1:
        layers = [enlarged(layer, factor) for layer in layers]
        mirror = mirror.enlarged(factor)
        edges = (edges[0] * factor, edges[1] * factor, edges[2])
    sums = area_sums(layers, mirror, edges)
    if parts > 1:
        sums = sums.reshape(height, parts, width, parts, -1).sum((1, 3))
    whole = latlong_solid_angles(height, width).astype(np.float32)
    weight, values = sums[..., 0], sums[..., 1:]
    weight[weight < 1e-5 * whole] = 0  # slivers: rounding
    values *= np.where(weight > 0, 1 / np.where(weight > 0, weight, 1), 0)[..., None]
    coverage = np.minimum(weight / whole, 1)
    return Unwrapped(values, coverage, pixels, spread / np.maximum(coverage, 1e-3))


def footprint(x: np.ndarray, y: np.ndarray, kernel: float) -> tuple[np.ndarray, np.ndarray]:
    """Area of texels in the photograph [px] and the sum of the squared weights that their means give to pixels.

    From corners (H + 1, W + 1). Texel and pixel, convolved, are taken as the Gaussian of the same second moments, whose
    square integrates to ``1 / (4 pi sqrt(det))``.
    """
    height, width = x.shape[0] - 1, x.shape[1] - 1
    area, spread = np.empty((height, width), np.float32), np.empty((height, width), np.float32)

    def fill(block: slice) -> None:
        lines = slice(block.start, block.stop + 1)
        area[block], spread[block] = _footprint(x[lines], y[lines], kernel)

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(fill, bands(height, BAND_TEXELS // width)))
    return area, spread


def _footprint(x: np.ndarray, y: np.ndarray, kernel: float) -> tuple[np.ndarray, np.ndarray]:
    """Some rows of `footprint`."""
    ux, uy = (0.5 * (np.diff(p[1:], axis=1) + np.diff(p[:-1], axis=1)) for p in (x, y))
    vx, vy = (0.5 * (np.diff(p[:, 1:], axis=0) + np.diff(p[:, :-1], axis=0)) for p in (x, y))
    xx, yy, xy = ((a * b + c * d) / 12 for a, b, c, d in ((ux, ux, vx, vx), (uy, uy, vy, vy), (ux, uy, vx, vy)))
    determinant = (xx + kernel) * (yy + kernel) - xy * xy
    spread = KERNEL_FIT / (4 * np.pi * np.sqrt(determinant))
    return np.abs(ux * vy - uy * vx), spread


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
