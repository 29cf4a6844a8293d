"""How sure a sum over texels is: which of their errors are alike.

The map's stated variance is a texel's. Three things tie texels together. What all share (exposure between plate and
probe, reflectance of the ball) is stated in the map's header. What one flux was recovered for, its texels share. The
rest is the probe's picture: where it is displaced, texels within a few pixels err together, so those count as alike
within cells, and as independent beyond. About a whole lamp they err with both signs, brighter where it moved to, darker
where it left: that cancels. How its pixels sample a small lamp, each colour of a mosaic by itself, no texel knows: that
error is the lamp's, by the pixels that it covers (`sampled`). Where views differ, texels were given a larger variance
for it (channel ``raised``); about a lamp they differ by just that, a displacement and its sampling, so that a lamp's
sum takes the variance that was not raised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import SCALE_SIGMA
from pipeline.types import Raster

ALIKE = "insitu:alike_deg"  # in a map's header: width of the cells within which texels err alike
ALIKE_VIEWS = "insitu:alike_views"  # in a map's header: how many equal views its light is the mean of
SOFT = "insitu:soft_px"  # in a map's header: softness of each of its views, lens and pixel [px]; absent: not known
ALIKE_PX = 3.0  # pixels of the probe's picture: demosaicking takes in two to each side
ALIKE_DEG = 2.8  # of a map that does not say: as wide as the cells of `pipeline.probes.combine`
RAISED = "raised"  # of a map: what texels' variances were multiplied by because views differ, 1 where not
ALIASED = "insitu:aliased"  # in a map's header: of each of its views, 1 where small lights keep their aliases
ADDED_PX2 = 0.72  # variance [px^2] along an axis that demosaicking and looking up add to lens and pixel
HARDLY = 0.1  # of the brightest channel: no lamp that glows has so little green in ACEScg, only red and blue diodes


@dataclass(frozen=True)
class Sampling:
    """Relative error of a lamp's light by how a mosaic samples it; of red and blue, a quarter of an RGGB mosaic each.

    Of a lens of b px that is known: ``(top exp(-pi^2 b^2 / 2) (1 + a / knee)^-falls, border s n^-ends)``, squares
    added, of n pixels that the lamp covers, a = n - 4 pi s^2 of its own, where s [px] is what a point becomes. Of a
    lens that is not known: ``(point exp(-n / fades), spread n^(-3/4))``. Of green ``green`` of either.
    """

    top: float
    knee: float
    falls: float
    border: float
    ends: float
    point: float
    fades: float
    spread: float
    green: float


# Of bilinear pictures as they are, and of those whose small lights lost their aliases (`pipeline.image.small_lights`).
AS_SEEN = Sampling(1.75, 1.0, 0.75, 0.06, 0.5, 3.0, 4.2, 0.32, 0.4)
RESTORED = Sampling(0.72, 1.13, 1.2, 0.067, 0.54, 1.9, 3.7, 0.18, 0.5)


def alike_rows(environment: Raster) -> int:
    """Rows of a map within which texels err alike, at least one."""
    degrees = float(environment.attributes.get(ALIKE, ALIKE_DEG))
    return max(1, round(environment.shape[0] * degrees / 180))


def shared_sigma_of(environment: Raster) -> np.ndarray:
    """(3,) relative standard uncertainty that all texels share; zeros for a map that does not say."""
    stated = str(environment.attributes.get(SCALE_SIGMA, "0 0 0"))
    return np.array([float(value) for value in stated.split()])


def own_sigma(environment: Raster, shared: np.ndarray) -> np.ndarray:
    """(H, W, 3) standard uncertainty of each texel less what all share; zeros for a map without variance.

    Where it is not finite the texel is a lower bound: no sigma covers it, and it is left to the evidence.
    """
    if "variance.R" not in environment.channels:
        return np.zeros((*environment.shape, 3))
    variance = environment.rgb("variance").astype(float) - (shared * environment.rgb()) ** 2
    return np.sqrt(np.where(np.isfinite(variance), np.maximum(variance, 0), 0))


def cell_sums(values: np.ndarray, rows: int) -> np.ndarray:
    """Sums (N, C) of a map (H, W, C) over cells of ``rows`` rows, about as wide as high on the sphere."""
    height, width = values.shape[:2]
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    sums = []
    for top in range(0, height, rows):
        part = values[top : top + rows].sum(0)
        up = (edges[top] + edges[min(top + rows, height)]) / 2
        columns = min(max(1, round(rows * width / (2 * height) / np.sqrt(max(1 - up**2, 1e-4)))), width)
        sums.append(np.add.reduceat(part, np.arange(0, width, columns), 0))
    return np.concatenate(sums)


def sampled(pixels: float, law: Sampling = AS_SEEN) -> np.ndarray:
    """Relative sigma (3,) of the light of a lamp that a mosaic's bilinear picture shows ``pixels`` pixels large.

    Bilinear kernels keep each colour's sum, so a colour's light is a sum over its own photosites, which by Poisson's
    formula is off by the lamp's picture at the photosites' frequency: 1/2 per pixel for red and blue, along rows and
    along columns, and for green 1/2 along both. A point behind a lens and pixel of b px together has
    ``exp(-2 pi^2 b^2 / 4)`` of its light there, and covers 4 pi b^2 px and what the kernels add, so that its error
    falls with the exponential of the area; the edge of a larger disc has (area)^(-3/4) of that.
    Of pictures whose softness is not known (else `sampled_behind`): b evenly from 0.55 to 0.85 px (half the contrast is
    left at 0.34 to 0.22 cycles per px). A lamp errs three times as much behind the sharpest of these lenses as behind
    the softest, so errors have heavier tails than normal, and the constants are of largest Student's likelihood.
    See `benchmarks.sampled_lamps`.
    """
    return _of_channels(float(np.hypot(law.point * np.exp(-pixels / law.fades), law.spread * pixels**-0.75)), law)


def sampled_behind(pixels: float, soft_px: float, point_px: float, law: Sampling = AS_SEEN) -> np.ndarray:
    """As `sampled`, of a picture whose lens and pixel are ``soft_px`` together, and where a point becomes ``point_px``.

    Then how many pixels the lamp has for itself is known: a point covers 4 pi s^2 of them, s = ``point_px``, and areas
    add. What ends a patch leaves some of the lamp's slope out: the second term. Limit: a lens is taken for a Gaussian;
    the benchmark's and the simulator's, which act on whole pixels, leave 1.6 to 1.9 times as much at the photosites'
    frequency, for which the constants allow: behind a real lens lamps err by about half of it.
    """
    own = max(pixels - 4 * np.pi * point_px**2, 0.0)
    ends = law.border * point_px * pixels**-law.ends
    return _of_channels(float(np.hypot(by_photosites(own, soft_px, law), ends)), law)


def by_photosites(own_px: float, soft_px: float, law: Sampling = AS_SEEN) -> float:
    """Relative sigma of the light of a disc of ``own_px`` by a quarter of the photosites, by the formula of `sampled`.

    A point has exp(-2 pi^2 b^2 / 4) of its light at their frequency, b = ``soft_px``; a disc of a px has 2 J_1(x) / x
    of that, x = sqrt(pi a), whose ripples end as a^(-3/4), as those of pictures as they are do.
    """
    return float(law.top * np.exp(-((np.pi * soft_px) ** 2) / 2) * (1 + own_px / law.knee) ** -law.falls)


def _of_channels(of_quarter: float, law: Sampling) -> np.ndarray:
    """Relative sigma (3,) by that of a colour which a quarter of the photosites see; no light errs by more than all."""
    return np.asarray(np.minimum(of_quarter * np.array([1, law.green, 1]), 1))


def laws_of(environment: Raster) -> list[Sampling]:
    """The law of each of a map's views; one, of pictures as they are, for a map that does not say."""
    return [
        AS_SEEN if aliased == "1" else RESTORED for aliased in str(environment.attributes.get(ALIASED, "1")).split()
    ]


def softness_of(environment: Raster) -> np.ndarray | None:
    """Softness (V,) [px] of a map's views, lens and pixel together; None for a map that does not say."""
    stated = environment.attributes.get(SOFT)
    return None if stated is None else np.array([float(value) for value in str(stated).split()])


def views_of(environment: Raster) -> float:
    """Of how many equal views a map's light is the mean; 1 for a map that does not say."""
    return float(environment.attributes.get(ALIKE_VIEWS, 1.0))


def pixel_rad(environment: Raster) -> float:
    """Width [rad] of a pixel of the probe's picture; 0 for a map that names no picture."""
    return float(np.radians(float(environment.attributes.get(ALIKE, 0.0))) / ALIKE_PX)


def point_px(environment: Raster, soft_px: float) -> float:
    """Standard deviation [px] along an axis of what a point becomes in a map that a lens and pixel of ``soft_px`` gave.

    Variances add: lens and pixel; demosaicking (1/2 px^2 of red and blue, 1/4 of green) and looking up between pixels,
    together `ADDED_PX2` as measured; and a texel's box, once as its light is averaged, once as it is drawn.
    """
    texel = np.pi / environment.shape[0] / pixel_rad(environment)
    return float(np.sqrt(soft_px**2 + ADDED_PX2 + texel**2 / 6))


def sampling_sigma(environment: Raster, light: np.ndarray) -> np.ndarray:
    """Relative sigma (3,) of the sum of ``light`` (H, W, 3) by the pixels that it covers; zero where no map says so.

    Covered is ``(sum L)^2 / sum L^2`` over solid angle, of green, whose own error moves it least; of a lamp that has
    hardly any, of its brightest channel, as noise covers no pixels. Views lie on their mosaics independently.
    """
    if ALIKE not in environment.attributes:
        return np.zeros(3)
    pixel = pixel_rad(environment) ** 2
    solid, sums = latlong_solid_angles(*environment.shape), light.sum((0, 1))
    shape = light[..., 1 if sums[1] > HARDLY * sums.max() else int(np.argmax(sums))]
    squares = float((np.square(shape) / solid).sum())
    covered = float(shape.sum()) ** 2 / squares if squares > 0 else 0.0
    pixels, views = max(covered / pixel, 1.0), views_of(environment)
    soft, laws = softness_of(environment), laws_of(environment)
    if soft is None:
        each = [sampled(pixels, law) for law in laws]
    else:
        point = point_px(environment, float(np.sqrt(np.mean(soft**2))))  # the map is the mean of its views
        laws = laws if len(laws) == len(soft) else [AS_SEEN] * len(soft)
        each = [sampled_behind(pixels, one, point, law) for one, law in zip(soft, laws, strict=True)]
    return np.asarray(np.sqrt(np.mean(np.square(each), 0) / views))


def displaced_sums(values: np.ndarray, light: np.ndarray) -> np.ndarray:
    """What errors (H, W, C), one sigma each, of a displaced picture ``light`` (H, W, 3) sum to: (2, C), east and south.

    A picture displaced by d errs by -grad L . d: brighter on one side of a lamp by what the other side lacks. So errors
    add with the cosine of the gradient's direction, and what lies about a whole lamp cancels; where a sum ends within
    the light's slope it does not.
    """
    height = len(light)
    grey = np.pad(light.mean(-1), ((0, 0), (1, 1)), "wrap")
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None]
    slope = np.stack([np.gradient(grey, axis=1)[:, 1:-1] / sine, np.gradient(grey, axis=0)[:, 1:-1]])
    size = np.linalg.norm(slope, axis=0)
    cosine = np.divide(slope, size, out=np.zeros(slope.shape), where=size > 0)
    return np.asarray((cosine[..., None] * values).sum((1, 2)))


def flux_sigma(environment: Raster, texels: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Sigma (3,) of the irradiance that texels (N,), flat indices, give a surface that faces ``direction`` (3,).

    A texel's own variance, as it was before views that differ raised it, is noise, alike within a pixel of the probe's
    picture, or a displacement of that picture; which, it does not say: the larger counts, beside what sampling adds.
    Recovered texels share one error, and their variance holds the map's own scale. Zero for a map without variance.
    """
    height, width = environment.shape
    inside = np.zeros((height, width), bool)
    inside.ravel()[np.asarray(texels, int)] = True
    weight = latlong_solid_angles(height, width) * np.maximum(latlong_directions(height, width) @ direction, 0)
    weight = (weight * inside)[..., None]
    shared, told = shared_sigma_of(environment), environment.channels.get("recovered", np.zeros((height, width))) > 0
    one = weight * own_sigma(environment, np.zeros(3)) * told[..., None]
    raised = environment.channels.get(RAISED, np.ones((height, width)))
    own = weight * own_sigma(environment, shared) / np.sqrt(raised)[..., None] * ~told[..., None]
    measured = weight * environment.rgb() * ~told[..., None]
    all_of_it = shared * measured.sum((0, 1))
    known = "variance.R" in environment.channels
    by_mosaic = sampling_sigma(environment, measured) * measured.sum((0, 1))
    pixel = max(1, round(alike_rows(environment) / ALIKE_PX))
    causes = (cell_sums(own, pixel) ** 2).sum(0), (displaced_sums(own, environment.rgb()) ** 2).sum(0)
    total = one.sum((0, 1)) ** 2 + known * (np.max(causes, 0) + by_mosaic**2 + all_of_it**2)
    return np.asarray(np.sqrt(total))
