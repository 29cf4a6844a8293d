"""A photographed 24-patch chart: the light's neutral and level, a 3x3 matrix, and how far the colours are off.

The light's colour comes from the chart's greys. The matrix is fitted to all patches by least squares in CIELAB, the
neutral held white, so that errors weigh as they are seen and greys stay grey. A fall-off of the light across the
chart is a plane in the logarithm, fitted where an F test asks for it. Patches that clip, are uneven within (a
shadow's edge, a highlight) or whose brightness is far from what all others say (shadow, glare) are left out.

Patch values: colour-science (X-Rite under D50, charts made before and after November 2014), adapted by Bradford to the
ACES white. Under a light of another temperature surfaces change colour by more than adaptation: that change is taken
from spectra of the same patches (BabelColor's average chart), as a ratio.

Sources: CIE 15 (CIELAB), CIE 116 (CIE94, whose weights the fit has), Sharma, Wu and Dalal 2005 (CIE DE2000, by
colour-science), Lam 1985 (Bradford).
Limits: veiling glare of the lens lifts the dark patches and is not modelled; a light without a colour temperature
(fluorescent) is taken as the daylight or Planckian spectrum nearest to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.image import balance, colour
from pipeline.types import Raster

EDITIONS = {
    "before_2014": "ColorChecker24 - Before November 2014", "after_2014": "ColorChecker24 - After November 2014",
}  # fmt: skip
GREY_ROW = slice(18, 24)
FEWEST_PATCHES = 12  # of 24, for six numbers of a matrix and three of the light
UNEVEN = 0.05  # relative scatter of the cells of a patch that is let pass in any case
OFF_LIGHT = 0.25  # relative error of a patch's brightness that is let pass in any case: what a 3x3 may be off by
ROBUST = 5.0  # standard deviations, from the median absolute deviation
GRADIENT_F = 7.8  # 99.9 % of F with 2 and about 60 degrees of freedom


@dataclass(frozen=True, eq=False)
class Patches:
    """The 24 patches as photographed: means (24, 3), their standard errors, places on the chart's unit square.

    NaN where a patch clips, is not positive or lies outside the picture. ``uneven`` (24,): relative scatter within.
    """

    mean: np.ndarray
    sigma: np.ndarray
    place: np.ndarray
    uneven: np.ndarray


@dataclass(frozen=True, eq=False)
class Fit:
    """What a chart says of light and camera.

    ``matrix`` (3, 3): ACEScg reflectance from the photograph's values. ``neutral`` (3,): values of a perfect white
    diffuser there, with relative sigma (3,). ``gradient`` (2,): of the light's logarithm along the chart's x and y, 0
    without evidence; ``gradient_f`` is that evidence. ``delta_e`` (24,): CIE DE2000, NaN where not seen; ``held_out``:
    the same of fits without that patch. ``used`` (24,): bool.
    """

    matrix: np.ndarray
    matrix_sigma: np.ndarray
    neutral: np.ndarray
    neutral_sigma: np.ndarray
    gradient: np.ndarray
    gradient_f: float
    delta_e: np.ndarray
    held_out: np.ndarray
    used: np.ndarray


@cache
def _published(edition: str) -> np.ndarray:
    """(24, 3) XYZ of the patches under D50, white Y = 1."""
    import colour as science

    x, y, luminance = np.array(list(science.CCS_COLOURCHECKERS[EDITIONS[edition]].data.values())).T
    return np.stack([x / y, np.ones(24), (1 - x - y) / y], -1) * luminance[:, None]


@cache
def _inconstancy(kelvin: float) -> np.ndarray:
    """(24, 3) XYZ of the patches under a light of that temperature, adapted to D50, over that under D50."""
    import colour as science

    shape = science.SpectralShape(380, 730, 10)
    observer = science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    spectra = science.SDS_COLOURCHECKERS["BabelColor Average"].values()
    patches = np.stack([one.copy().align(shape).values for one in spectra])

    def seen(temperature: float) -> np.ndarray:
        if temperature < 4000:
            light = science.sd_blackbody(temperature, shape).values
        else:
            xy = science.temperature.CCT_to_xy_CIE_D(temperature * 1.4388 / 1.4380)
            light = science.sd_CIE_illuminant_D_series(xy).align(shape).values
        white = light @ observer
        return (patches * light) @ observer @ colour.adaptation(white, colour.xyz_of_xy(colour.D50_XY)).T / white[1]

    return np.asarray(seen(kelvin) / seen(5000.0))


def reference(edition: str = "after_2014", kelvin: float | None = None) -> np.ndarray:
    """(24, 3) ACEScg of the patches under a white light of 1, adapted by Bradford, as a light of ``kelvin`` shows them.

    None: as published under D50. Daylight spectra from 4000 K up to 25000 K, Planckian below.
    """
    xyz = _published(edition)
    if kelvin is not None:
        xyz = xyz * _inconstancy(float(np.clip(round(kelvin, -1), 1500, 25000)))
    white = (colour.xyz_of_xy(balance.D50_WHITE_XY), colour.xyz_of_xy(colour.ACESCG_CHROMATICITIES[3]))
    return colour.convert(xyz @ colour.adaptation(*white).T, "xyz", "acescg")


def measure(photograph: Raster, corners: np.ndarray) -> Patches:
    """The patches of the chart with these corners (4, 2) px: beside dark skin, bluish green, black, white."""
    across = balance.cells_across([corners], "chart")
    cells = balance.cells_of(photograph, corners, "chart", across)
    each = cells.mean.reshape(24, -1, 3)
    mean = each.mean(1)
    scatter = each.std(1, ddof=1) if across > 1 else np.full((24, 3), np.nan)
    with np.errstate(invalid="ignore"):
        uneven = np.nan_to_num(scatter / mean).max(-1)
    sigma = np.nan_to_num(scatter / np.sqrt(across**2 - 1)) if across > 1 else 0.01 * np.nan_to_num(mean)
    return Patches(mean, sigma, cells.place.reshape(24, -1, 2).mean(1), uneven)


def neutral(patches: Patches, known: np.ndarray) -> np.ndarray | None:
    """(3,) how the photograph shows white, green 1, by the chart's light greys; None with fewer than two of them."""
    usable = np.isfinite(patches.mean).all(-1) & (patches.uneven <= UNEVEN)
    greys = np.flatnonzero(usable[GREY_ROW])[: balance.GREYS] + GREY_ROW.start
    if len(greys) < 2:
        return None
    white = np.exp(np.log(patches.mean[greys] / known[greys]).mean(0))
    return np.asarray(white / white[1])


def fit(patches: Patches, known: np.ndarray, matrix: np.ndarray | None = None, hold_out: bool = True) -> Fit | None:
    """What the patches say, of reflectance ``known`` (24, 3) ACEScg; None with too few of them.

    ``matrix`` (3, 3) to ACEScg: it is kept, and only neutral and light are estimated; it must take the photograph's
    neutral to (1, 1, 1) up to a factor for its errors to be those of the colours. Without ``hold_out``, which takes
    a fit per patch, ``held_out`` repeats ``delta_e``.
    """
    kept = np.isfinite(patches.mean).all(-1)
    if kept.sum() >= FEWEST_PATCHES:
        kept &= patches.uneven <= np.maximum(UNEVEN, _robust(patches.uneven[kept]))
    for _ in range(4):
        greys = np.flatnonzero(kept[GREY_ROW])[: balance.GREYS] + GREY_ROW.start
        if kept.sum() < FEWEST_PATCHES or len(greys) < 2:
            return None
        found = _Model(patches, known, greys, matrix).solve(kept)
        off = np.abs(found.brightness)
        still = np.isfinite(off) & (off <= np.maximum(OFF_LIGHT, _robust(off[kept]))) & kept
        if np.array_equal(still, kept):
            break
        kept = still
    held_out = found.delta_e.copy()
    if matrix is None and hold_out:
        for patch in np.flatnonzero(kept):
            without = kept.copy()
            without[patch] = False
            if without.sum() >= FEWEST_PATCHES:
                held_out[patch] = _Model(patches, known, greys, matrix, found).solve(without).delta_e[patch]
    return Fit(
        found.matrix, found.matrix_sigma, found.neutral, found.neutral_sigma, found.gradient, found.gradient_f,
        found.delta_e, held_out, kept,
    )  # fmt: skip


def _robust(values: np.ndarray) -> float:
    middle = np.median(values)
    return float(middle + ROBUST * 1.4826 * np.median(np.abs(values - middle)))


def delta_e(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """CIE DE2000 (...) between ACEScg colours (..., 3), white (1, 1, 1)."""
    from colour.difference import delta_E_CIE2000

    return np.asarray(delta_E_CIE2000(lab(first), lab(second)))


def lab(acescg: np.ndarray) -> np.ndarray:
    """CIELAB (..., 3) of ACEScg (..., 3), white (1, 1, 1); its linear part goes on below zero."""
    ratio = colour.convert(np.asarray(acescg, float), "acescg", "xyz")
    ratio = ratio / colour.matrix("acescg", "xyz").sum(1)
    f = np.where(ratio > 216 / 24389, np.cbrt(np.maximum(ratio, 1e-9)), ratio * (24389 / 27 / 116) + 16 / 116)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


def misfit(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(..., 3) differences of CIELAB colours in lightness, chroma and hue, weighted as CIE94 weights them."""
    chroma = np.hypot(wanted[..., 1], wanted[..., 2])
    along = wanted[..., 1:] / np.maximum(chroma, 1e-9)[..., None]
    away = found - wanted
    in_chroma = (away[..., 1:] * along).sum(-1)
    in_hue = away[..., 2] * along[..., 0] - away[..., 1] * along[..., 1]
    return np.stack([away[..., 0], in_chroma / (1 + 0.045 * chroma), in_hue / (1 + 0.015 * chroma)], -1)


def white_keeping(free: np.ndarray) -> np.ndarray:
    """(3, 3) whose rows sum to 1, of the six numbers (6,) of its first and last column."""
    rows = free.reshape(3, 2)
    return np.insert(rows, 1, 1 - rows.sum(1), axis=1)


class _Model:
    """Least squares in CIELAB: six numbers of a white-keeping matrix, the light's level, and its slope on evidence."""

    def __init__(
        self, patches: Patches, known: np.ndarray, greys: np.ndarray, matrix: np.ndarray | None,
        like: _Model | None = None,
    ) -> None:  # fmt: skip
        ratios = np.log(patches.mean[greys] / known[greys])
        self.white = np.exp(ratios.mean(0))  # up to the level, which all patches share
        tint = ratios - ratios.mean(-1, keepdims=True)  # the level's scatter is the light's fall-off, not its colour
        scatter = tint.std(0, ddof=1) / np.sqrt(len(greys)) * np.sqrt(3 / 2)
        self.neutral_sigma = np.hypot(scatter, (patches.sigma[greys] / patches.mean[greys]).max(0))
        self.seen, self.wanted = patches.mean / self.white, lab(known)
        self.known, self.known_y = known, colour.luminance(known)
        self.place = patches.place - 0.5
        self.fixed = None if matrix is None else matrix * self.white / (matrix @ self.white).mean()
        self.like = like

    def _matrix(self, free: np.ndarray) -> np.ndarray:
        if self.fixed is not None:
            return self.fixed
        return white_keeping(free[3:])

    def _colours(self, free: np.ndarray) -> np.ndarray:
        light = np.exp(free[0] + self.place @ free[1:3])
        return self.seen / light[:, None] @ self._matrix(free).T

    def _least_squares(self, kept: np.ndarray, start: np.ndarray, open_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        from scipy.optimize import least_squares

        def residual(part: np.ndarray) -> np.ndarray:
            free = start.copy()
            free[open_] = part
            return misfit(lab(self._colours(free)[kept]), self.wanted[kept]).ravel()

        solved = least_squares(residual, start[open_])
        result = start.copy()
        result[open_] = solved.x
        freedom = max(1, 3 * int(kept.sum()) - int(open_.sum()))
        covariance = np.zeros((len(start), len(start)))
        covariance[np.ix_(open_, open_)] = np.linalg.pinv(solved.jac.T @ solved.jac) * 2 * solved.cost / freedom
        self.cost = 2 * solved.cost
        return result, covariance

    def solve(self, kept: np.ndarray) -> _Model:
        """Fit the kept patches; the attributes are those of `Fit`, and ``brightness``: log error of every patch."""
        start = np.array([0.0, 0, 0, 1, 0, 0, 0, 0, 1])
        open_ = np.array([True, False, False] + [self.fixed is None] * 6)
        free, covariance = self._least_squares(kept, start, open_)
        level = self.cost
        slanted = open_ | np.array([False, True, True] + [False] * 6)
        if self.like is None:
            tilted, its_covariance = self._least_squares(kept, free, slanted)
            freedom = 3 * int(kept.sum()) - int(slanted.sum())
            self.gradient_f = float((level - self.cost) / 2 / (self.cost / freedom))
        else:  # a fit beside another: what that one decided
            self.gradient_f = self.like.gradient_f
            if self.gradient_f > GRADIENT_F:
                tilted, its_covariance = self._least_squares(kept, free, slanted)
        if self.gradient_f > GRADIENT_F:
            free, covariance = tilted, its_covariance
        found = self._colours(free)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.brightness = np.log(colour.luminance(found) / self.known_y)
        self.gradient = free[1:3]
        self.neutral = self.white * np.exp(free[0])
        self.neutral_sigma = np.hypot(self.neutral_sigma, np.sqrt(covariance[0, 0]))
        self.matrix = self._matrix(free) / self.neutral
        per_row = np.diag(covariance)[3:].reshape(3, 2)
        spread = np.insert(per_row, 1, per_row.sum(1) + 2 * covariance[[3, 5, 7], [4, 6, 8]], axis=1)
        self.matrix_sigma = np.sqrt(np.maximum(spread, 0)) / self.neutral
        seen = np.isfinite(found).all(-1)
        self.delta_e = np.full(24, np.nan)
        self.delta_e[seen] = delta_e(found[seen], self.known[seen])
        return self
