"""Exposure and colour of one photograph against another, from a grey card, chart or ball that both show.

A reference is cut into cells that are the same spots of it in both pictures (homography of its corners), so that uneven
light on it cancels: every cell gives one log ratio per channel. Their mean is the log gain; what scatters between the
cells gives its covariance, and a slope across the reference, which averaging does not lessen, goes in whole. Floors
are stated for what no scatter shows. References are joined by least squares on their full covariances, Huber's
weights against one that disagrees.

Sources: Huber 1964; Birge 1932 (covariance raised by chi2 per degree of freedom where references disagree); chart
colours: X-Rite ColorChecker 24 after November 2014, the tests hold them against colour-science.
Limits: three gains are no 3x3 matrix: where two cameras differ by more, colours other than grey keep an error, which a
chart shows. The reference must be lit alike in both photographs and is taken as diffuse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.markers import apply, square_homography
from pipeline.conventions import CLIPPED
from pipeline.image import colour
from pipeline.types import Balance, Raster

SAME_PLACE = 0.003  # relative: flicker and repeatability of a speed, between photographs from one place
OTHER_PLACE = 0.01  # relative: no card is perfectly diffuse; what it may change by when seen from elsewhere
OWN_SHARE = 0.1  # of the floor's variance is each channel's own, the rest common to the three
INNER = 0.1  # of a card's side is left out at its edges, against blur and wrong corners
PATCH_INNER = 0.2  # and of a chart's patch
FEWEST_CELLS = 8
FEWEST_PIXELS = 4  # of a cell
MOST_CELLS = 8  # along a side
OUTLIER = 5.0  # robust standard deviations of a cell; 4 costs nine cells 1 % of their 95 % intervals
SLOPE_F = 7.8  # 99.9 % of F with 2 and about 60 degrees of freedom
SIGNIFICANT_CHI2 = 14.16  # of three gains: as improbable as three standard deviations of one number
HUBER = 2.0  # a reference's rms pull, in standard deviations, from which it counts less
CHART_ROWS, CHART_COLUMNS = 4, 6
GREYS = 4  # the lightest of the chart's last row; veiling glare lifts the darker ones
CHART_AGREES = 0.9  # least correlation of the patches' log luminance with what is known of them

# x, y, Y of the chart's patches under D50 (D50_WHITE_XY), read in rows from dark skin to black.
D50_WHITE_XY = np.array([0.34570291, 0.35853860])
CHART_XYY = np.array([
    [0.4375, 0.3785, 0.0983], [0.4222, 0.3725, 0.3362], [0.2761, 0.2984, 0.1786], [0.3733, 0.4512, 0.1347],
    [0.3029, 0.2863, 0.2287], [0.2864, 0.3897, 0.4144], [0.5281, 0.4053, 0.3126], [0.2324, 0.2112, 0.1091],
    [0.5044, 0.3271, 0.1890], [0.3335, 0.2506, 0.0628], [0.3989, 0.5041, 0.4332], [0.4936, 0.4443, 0.4293],
    [0.2052, 0.1687, 0.0560], [0.3230, 0.5104, 0.2233], [0.5629, 0.3356, 0.1278], [0.4678, 0.4760, 0.5993],
    [0.4213, 0.2669, 0.1895], [0.2091, 0.3027, 0.1806], [0.3489, 0.3642, 0.8807], [0.3456, 0.3599, 0.5900],
    [0.3441, 0.3592, 0.3649], [0.3458, 0.3591, 0.1906], [0.3426, 0.3576, 0.0882], [0.3438, 0.3561, 0.0315],
])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Cells:
    """A reference in one photograph: mean radiance (K, 3) of its cells, NaN where one cannot be used."""

    mean: np.ndarray
    place: np.ndarray  # (K, 2) of each cell's centre, on the reference's unit square


@dataclass(frozen=True, eq=False)
class Gains:
    """Logarithms of three gains (3,), their covariance (3, 3), and the cells they come from."""

    log: np.ndarray
    covariance: np.ndarray
    cells: int


def chart_acescg() -> np.ndarray:
    """(24, 3) reflectances of the chart's patches, ACEScg, white adapted from D50."""
    x, y, luminance = CHART_XYY.T
    xyz = np.stack([x / y, np.ones(24), (1 - x - y) / y], -1) * luminance[:, None]
    white = (colour.xyz_of_xy(D50_WHITE_XY), colour.xyz_of_xy(colour.ACESCG_CHROMATICITIES[3]))
    return colour.convert(xyz @ colour.adaptation(*white).T, "xyz", "acescg")


def reflectance_of(kind: str, stated: np.ndarray | None, cells: int) -> np.ndarray:
    """(K, 3) ACEScg reflectance of every cell, up to one factor: the chart's greys, as stated, or neutral."""
    if kind == "chart":
        return np.repeat(chart_acescg()[18 : 18 + GREYS], cells // GREYS, 0)
    return np.tile(np.ones(3) if stated is None else stated, (cells, 1))


def cells_across(outlines: list[np.ndarray], kind: str) -> int:
    """Cells along a side, so that one has enough pixels in the view that shows the reference smallest."""
    smallest = min(area(outline) for outline in outlines)
    if kind == "chart":
        patch = smallest * (1 - 2 * PATCH_INNER) ** 2 / (CHART_ROWS * CHART_COLUMNS)
        return int(np.clip(np.sqrt(patch / (2 * FEWEST_PIXELS)), 1, 3))
    return int(np.clip(np.sqrt(smallest * (1 - 2 * INNER) ** 2 / (2 * FEWEST_PIXELS)), 1, MOST_CELLS))


def area(outline: np.ndarray) -> float:
    """Area of a polygon (N, 2), px^2."""
    x, y = outline.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def cells_of(photograph: Raster, outline: np.ndarray, kind: str, across: int) -> Cells:
    """Means over the cells of a reference with the outline (N, 2) px; of a chart, patch by patch.

    A cell with a clipped or non-finite pixel, one that is not positive, and one outside the outline is NaN.
    """
    height, width = photograph.shape
    low, high = np.floor(outline.min(0)).astype(int), np.ceil(outline.max(0)).astype(int)
    rows = slice(max(low[1], 0), min(high[1], height))
    columns = slice(max(low[0], 0), min(high[0], width))
    y, x = np.mgrid[rows, columns] + 0.5
    px = np.stack([x, y], -1).reshape(-1, 2)
    uv = _on_reference(px, outline)
    number, inside, place = (_patch_cells if kind == "chart" else _grid_cells)(uv, across)
    inside_outline = _inside(px, outline)
    if kind == "grey_ball" and len(outline) == 4:
        inside_outline &= np.hypot(*(uv - 0.5).T) < 0.4  # the corners are of the square around it
    rgb = np.stack([photograph[c][rows, columns] for c in "RGB"], -1).reshape(-1, 3).astype(float)
    good = np.isfinite(rgb).all(-1) & (photograph["mask"][rows, columns].ravel() & CLIPPED == 0) & inside_outline
    count = np.bincount(number[inside], minlength=len(place))
    bad = np.bincount(number[inside & ~good], minlength=len(place))
    sums = [np.bincount(number[inside], np.where(good, c, 0)[inside], len(place)) for c in rgb.T]
    mean = np.stack(sums, -1) / np.maximum(count, 1)[:, None]
    usable = (count >= FEWEST_PIXELS) & (bad == 0) & (mean > 0).all(-1)
    return Cells(np.where(usable[:, None], mean, np.nan), place)


def _on_reference(px: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) on the unit square of four corners; of any other outline, on that of its bounding box."""
    if len(outline) == 4:
        return np.asarray(apply(np.linalg.inv(square_homography(outline)), px))
    return (px - outline.min(0)) / np.ptp(outline, axis=0)


def _inside(px: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Which pixels (N, 2) lie within a convex outline."""
    left, right = np.ones(len(px), bool), np.ones(len(px), bool)
    for start, end in zip(outline, np.roll(outline, -1, 0), strict=True):  # one by one: a card has many pixels
        turn = (end[0] - start[0]) * (px[:, 1] - start[1]) - (end[1] - start[1]) * (px[:, 0] - start[0])
        left &= turn > 0
        right &= turn < 0
    return left | right


def _grid_cells(uv: np.ndarray, across: int, margin: float = INNER) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of the cell of each place (N, 2), whether it is in one, and the cells' centres (K, 2)."""
    at = (uv - margin) / (1 - 2 * margin) * across
    inside = np.asarray(((at >= 0) & (at < across)).all(-1))
    column, row = np.where(inside[:, None], at, 0).astype(int).T
    centre = margin + (np.arange(across) + 0.5) / across * (1 - 2 * margin)
    return row * across + column, inside, np.stack(np.meshgrid(centre, centre), -1).reshape(-1, 2)


def _patch_cells(uv: np.ndarray, across: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same for the patches of a chart, one after another in rows."""
    size = np.array([CHART_COLUMNS, CHART_ROWS])
    at = uv * size
    on_chart = ((at >= 0) & (at < size)).all(-1)
    corner = np.where(on_chart[:, None], np.floor(at), 0).astype(int)
    number, inside, offset = _grid_cells(at - corner, across, PATCH_INNER)
    corners = np.stack(np.meshgrid(np.arange(CHART_COLUMNS), np.arange(CHART_ROWS)), -1).reshape(-1, 1, 2)
    number += (corner[:, 1] * CHART_COLUMNS + corner[:, 0]) * across**2
    return np.where(on_chart & inside, number, 0), on_chart & inside, ((corners + offset) / size).reshape(-1, 2)


def greys(cells: Cells) -> Cells:
    """Of the cells of a chart, those of its light greys."""
    each = len(cells.mean) // (CHART_ROWS * CHART_COLUMNS)
    part = slice(18 * each, (18 + GREYS) * each)
    return Cells(cells.mean[part], cells.place[part])


def chart_agreement(cells: Cells) -> float:
    """Correlation of the patches' log luminance with what is known of them; NaN when fewer than half can be used."""
    patches = cells.mean.reshape(CHART_ROWS * CHART_COLUMNS, -1, 3).mean(1)
    usable = np.isfinite(patches).all(-1)
    usable[usable] = colour.luminance(patches[usable]) > 0
    if usable.sum() < CHART_ROWS * CHART_COLUMNS / 2:
        return np.nan
    seen, known = np.log(colour.luminance(patches[usable])), np.log(CHART_XYY[usable, 2])
    return float(np.corrcoef(seen, known)[0, 1])


def ratio(plate: Cells, view: Cells, floor: float) -> Gains | None:
    """Log of plate over view from cells that both can use; None with fewer than FEWEST_CELLS of them.

    ``floor``: relative, of what does not scatter, see SAME_PLACE and OTHER_PLACE.
    """
    both = np.isfinite(plate.mean).all(-1) & np.isfinite(view.mean).all(-1)
    if both.sum() < FEWEST_CELLS:
        return None
    log, covariance, cells = centre(np.log(plate.mean[both] / view.mean[both]), plate.place[both])
    return Gains(log, covariance + floor**2 * ((1 - OWN_SHARE) + OWN_SHARE * np.eye(3)), cells)


def neutral(plate: Cells, reflectance: np.ndarray) -> Gains | None:
    """Log gains that give the plate's reference the colour of its reflectance (K, 3), luminance kept."""
    usable = np.isfinite(plate.mean).all(-1)
    if usable.sum() < FEWEST_CELLS:
        return None
    known, seen = (v / colour.luminance(v)[:, None] for v in (reflectance[usable], plate.mean[usable]))
    log, covariance, cells = centre(np.log(known / seen), plate.place[usable])
    return Gains(log, covariance + SAME_PLACE**2 * OWN_SHARE * np.eye(3), cells)


def centre(logs: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Mean (3,) of the cells' logs (K, 3) without outliers, its covariance (3, 3), and the cells kept.

    Outliers are judged on what a plane over the reference leaves. The covariance is that of the mean of independent
    cells about the plane; where the plane has a slope beyond chance, all of its variance is added.
    """
    kept = np.ones(len(logs), bool)
    mean, left = np.median(logs, 0), logs - np.median(logs, 0)
    for _ in range(20):
        spread = 1.4826 * np.median(np.abs(left[kept]), 0)
        previous, kept = kept, (np.abs(left) <= OUTLIER * np.maximum(spread, 1e-12)).all(-1)
        if kept.sum() < FEWEST_CELLS or np.array_equal(previous, kept):
            kept = previous if kept.sum() < FEWEST_CELLS else kept
            break
        slope, mean, left = _plane(logs, place, kept)
    slope, mean, left = _plane(logs, place, kept)
    count = int(kept.sum())
    covariance = left[kept].T @ left[kept] / (count * (count - 5))  # the variance of Student's t
    chance = (slope[kept] ** 2).sum(0) / 2 / np.maximum((left[kept] ** 2).sum(0) / (count - 3), 1e-300)
    if chance.max() > SLOPE_F:
        covariance = covariance + slope[kept].T @ slope[kept] / count
    return mean, covariance + 1e-14 * np.eye(3), count


def _plane(logs: np.ndarray, place: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope part (K, 3) of the plane through the kept logs, their mean (3,), and what both leave (K, 3)."""
    away = place - place[kept].mean(0)
    mean = logs[kept].mean(0)
    slope = away @ np.linalg.lstsq(away[kept], logs[kept] - mean, rcond=None)[0]
    return slope, mean, logs - mean - slope


def joined(found: list[Gains]) -> tuple[Gains, float]:
    """One estimate from several references, and their chi2 per degree of freedom (1 for a single one)."""
    inverses = [np.linalg.inv(one.covariance) for one in found]
    weights = np.ones(len(found))
    for _ in range(20):
        information = np.einsum("r,rij->ij", weights, inverses)
        right = np.einsum("r,rij,rj->i", weights, inverses, [one.log for one in found])
        log = np.linalg.solve(information, right)
        pull = np.array([(one.log - log) @ inverse @ (one.log - log) for one, inverse in zip(found, inverses)])
        if len(found) < 3:  # of two that disagree neither is the odd one
            break
        weights = np.minimum(1, HUBER / np.maximum(np.sqrt(pull / 3), 1e-12))
    freedom = 3 * (len(found) - 1)
    disagreement = float(weights @ pull) / freedom if freedom else 1.0
    covariance = np.linalg.inv(information) * max(1.0, disagreement)
    return Gains(log, covariance, sum(one.cells for one in found)), disagreement


def significance(gains: Gains) -> float:
    """Chi2 (three degrees of freedom) of the gains against 1."""
    return float(gains.log @ np.linalg.solve(gains.covariance, gains.log))


def chart_residual(plate: Cells, view: Cells, gains: Gains) -> float:
    """Relative rms over a chart's colours of what the gains leave between plate and view; NaN without a colour."""
    log = np.log(plate.mean / view.mean).reshape(CHART_ROWS * CHART_COLUMNS, -1, 3)[:18] - gains.log
    known = np.isfinite(log).all((1, 2))
    return float(np.sqrt((log[known].mean(1) ** 2).mean())) if known.any() else np.nan


def shared_sigma(balance: dict[str, Balance], view: str) -> np.ndarray:
    """(3,) relative error that all pixels of a view share: of its gains, applied or not; zeros for an unknown view."""
    return np.sqrt(np.diag(balance[view].covariance)) if view in balance else np.zeros(3)


def balanced(photographs: dict[str, Raster], balance: dict[str, Balance]) -> dict[str, Raster]:
    """The photographs at the plate's exposure and colour: radiance and variance of views whose gains are applied."""
    done = dict(photographs)
    for name, one in balance.items():
        if name in photographs and one.applied:
            raster = photographs[name]
            rgb = Raster.split(raster.rgb() * one.gains.astype(np.float32))
            variance = Raster.split(raster.rgb("variance") * (one.gains**2).astype(np.float32), "variance")
            done[name] = Raster({**raster.channels, **rgb, **variance}, raster.space, raster.attributes)
    return done
