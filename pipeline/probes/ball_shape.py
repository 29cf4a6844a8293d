"""How far a mirror ball is from a sphere, and what its dents do to mirrored directions.

The plane is the test chart: its texture is known from the direct view, so the ball's picture of it can be predicted
pixel by pixel, and where a patch of the real picture lies beside its prediction the surface is tilted. What no other
centre explains and stands out of the patches' own noise is the ball's shape. Two views bound that besides: what
they disagree on above the horizon is dents, parallax and noise together.

The outline is no witness: a mirror's rim continues its background, so single stretches of it are known to 0.2 to 1.7 px
only. Harmonics 2 to 6 of perfect balls of 80 to 106 px, ray-traced and captured, came out at 0.2 to 0.9 px rms, by
steepest slopes, by a path through all of them, and by a model of the light on both sides: 1 to 11 degrees of direction,
where the mirrored plane shows half a degree. For the same reason the plane's image knows the centre better than the rim
does (`plane_image`).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import resize_environment
from pipeline.probes.ball_pairs import Pairs, Sight, ball_points
from pipeline.probes.combine import gradient_per_radian
from pipeline.probes.observation import Quality, ViewMap
from pipeline.probes.reflection import radians_per_pixel

PATCH, REACH = 13, 7  # side of a patch, and largest shift that is looked for [px]
STRIDE = PATCH // 2  # of the grid of patches
MAX_SIGMA_PX = 0.35  # patches that know their place worse have too little texture
# A patch that fits as well elsewhere within so many sigma knows no place: print slips by its period, grain along it;
# half the patches of a ball of 82 px, of grain near its rim, were 2 to 7 px off and made it a dented ball.
RIVAL_SIGMA = 3.0
MIN_PATCHES = 8
FLOOR_PX = 0.3  # of a perfect ball: on ray-traced ones 0.1, on two demosaicked captures 0.2 to 0.3
SIGNIFICANT, OPEN_SIGMA = 3.0, 3.0
TOO_DENTED = 0.1  # rad: of order l, exp(-l (l + 1) s^2 / 2) is left: 97 % of order 2, half of order 11
COMPARED_ROWS, HORIZON = 128, 0.1


@dataclass(frozen=True)
class Dents:
    """Shifts [px] of patches from where a sphere would have them, with its centre where the fit allows.

    ``direction_sigma_rad``: rms angle by which mirrored directions are off, 0 when it does not stand out of
    ``floor_rad``, what a perfect ball shows.
    """

    patches: int
    rms_px: float
    direction_rms_rad: float
    floor_rad: float
    centre_shift_m: np.ndarray  # (3,), camera frame: by how much the shifts alone would move the fitted centre

    @property
    def direction_sigma_rad(self) -> float:
        """Beyond the floor."""
        excess = self.direction_rms_rad**2 - self.floor_rad**2
        return float(np.sqrt(excess)) if self.direction_rms_rad > 1.5 * self.floor_rad else 0.0


def patch_shifts(pairs: Pairs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (N, 2) of textured patches, their shift (N, 2) from the prediction, and its standard error (N,), px.

    ``pairs`` of every pixel. The patch is sought in the logarithm, its mean taken off: reflectance, dirt and gloss
    change the level, not the place. Parabola about the least sum of squares over whole pixels.
    """
    from scipy.ndimage import uniform_filter1d

    ok = (pairs.mirrored > 0).all(1) & (pairs.direct > 0).all(1)
    column, row = pairs.pixel[ok].T
    low = np.array([row.min(), column.min()]) if len(row) else np.zeros(2, int)
    size = np.array([row.max(), column.max()]) - low + 1 if len(row) else np.ones(2, int)
    real, model, mask = np.zeros(size), np.zeros(size), np.zeros(size)
    at = row - low[0], column - low[1]
    # A power of two: a stop more or less of exposure leaves the same bits, and the same shifts.
    level = 2.0 ** np.round(np.log2(np.median(pairs.direct[ok]))) if len(row) else 1.0
    real[at], model[at] = (np.log(part[ok] / level).mean(1) for part in (pairs.mirrored, pairs.direct))
    mask[at] = 1
    shifts = np.arange(-REACH, REACH + 1)
    known = np.pad(mask, REACH)
    padded = np.pad(model, REACH)
    rows, columns = (len(range(0, side, STRIDE)) for side in size)
    misfit = np.full((len(shifts), len(shifts), rows, columns), np.inf)

    def mean_of(values: np.ndarray) -> np.ndarray:
        """Mean over each patch of the grid: rows that hold no patch are not taken any further."""
        down = uniform_filter1d(values, PATCH, 0, mode="constant")[::STRIDE]
        return np.asarray(uniform_filter1d(down, PATCH, 1, mode="constant")[:, ::STRIDE])

    def compare(i: int) -> None:
        for j, dx in enumerate(shifts):
            window = slice(REACH - shifts[i], REACH - shifts[i] + size[0]), slice(REACH - dx, REACH - dx + size[1])
            both = mask * known[window]
            left = (real - padded[window]) * both
            share = mean_of(both)
            enough = share > 0.5
            safe = np.where(enough, share, 1)
            mean = mean_of(left) / safe
            misfit[i, j] = np.where(enough, np.maximum(mean_of(left**2) / safe - mean**2, 0), np.inf)

    with ThreadPoolExecutor() as pool:
        list(pool.map(compare, range(len(shifts))))
    return _least(misfit, low, shifts)


def _least(
    misfit: np.ndarray, low: np.ndarray, shifts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Of misfits (K, K, M, N) by shift: centres, shifts and standard errors of the patches of a grid that know them."""
    centres, found, errors = [], [], []
    for y in range(misfit.shape[2]):
        for x in range(misfit.shape[3]):
            cost = misfit[:, :, y, x].copy()
            i, j = np.unravel_index(cost.argmin(), cost.shape)
            if min(i, j) == 0 or max(i, j) == len(shifts) - 1 or np.isfinite(cost).mean() < 0.5:
                continue
            if not np.isfinite(cost[i - 1 : i + 2, j - 1 : j + 2]).all():
                continue
            place = []
            curvature = []
            for before, here, after in (
                (cost[i, j - 1], cost[i, j], cost[i, j + 1]),
                (cost[i - 1, j], cost[i, j], cost[i + 1, j]),
            ):
                bend = before - 2 * here + after
                curvature.append(bend)
                place.append(0.5 * (before - after) / max(bend, 1e-30))
            least = max(float(cost[i, j]), 1e-12)
            # of a mean square over PATCH^2 pixels, whose neighbours share half of their noise
            error = np.sqrt(2 * 2 * least / (PATCH**2 * max(min(curvature), 1e-30)))
            cost[i - 1 : i + 2, j - 1 : j + 2] = np.inf
            if PATCH**2 / 2 * (float(cost.min()) / least - 1) < RIVAL_SIGMA**2:
                continue
            if error < MAX_SIGMA_PX:
                centres.append((STRIDE * x + low[1], STRIDE * y + low[0]))
                found.append((shifts[j] + place[0], shifts[i] + place[1]))
                errors.append(error)
    return np.array(centres).reshape(-1, 2), np.array(found).reshape(-1, 2), np.array(errors)


def dents(
    sight: Sight, radius_px: float, covariance: np.ndarray, shifted: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Dents | None:
    """What the shifts of patches mean for directions, beyond what another centre explains. None when too few.

    ``covariance`` (3, 3) of the fitted centre: how far another one may be.
    """
    centre, shift, error = shifted
    if len(centre) < MIN_PATCHES:
        return None
    by_centre = _by_centre(sight, centre + 0.5)
    known = np.isfinite(by_centre).all((1, 2))
    centre, shift, error, by_centre = centre[known], shift[known], error[known], by_centre[known]
    if len(centre) < MIN_PATCHES:
        return None
    # Another centre is no dent, as far as the fit leaves it open; beyond, dents look like one.
    moved = _centre_shift(by_centre, shift, error)
    astray = float(np.sqrt(moved @ np.linalg.solve(covariance, moved)))
    shift = shift - by_centre @ (moved * min(1.0, OPEN_SIGMA / max(astray, 1e-12)))
    arm = (centre + 0.5 - project(sight.camera, sight.centre[None])[0]) / radius_px
    sine = np.clip(np.linalg.norm(arm, axis=1), 1e-3, 0.97)
    outward = arm / np.linalg.norm(arm, axis=1)[:, None]
    ratio = sight.radius / float(np.linalg.norm(sight.centre))
    radial, across = radians_per_pixel(sine, ratio, radius_px, sight.glass)
    along = (shift * outward).sum(1) * radial
    beside = (shift[:, 0] * outward[:, 1] - shift[:, 1] * outward[:, 0]) * across
    angle = float(np.sqrt(np.median(along**2 + beside**2) / np.log(2)))
    noise = float(np.sqrt(np.median((error**2 + FLOOR_PX**2) * (radial**2 + across**2))))
    rms = float(np.sqrt(np.median((shift**2).sum(1)) / np.log(2)))
    return Dents(len(arm), rms, angle, noise, moved)


def _centre_shift(by_centre: np.ndarray, shift: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Robust least squares of shifts (N, 2) by the centre: its move (3,) [m]."""
    columns, target, own = by_centre.reshape(-1, 3), shift.ravel(), np.repeat(1 / np.hypot(error, FLOOR_PX) ** 2, 2)
    weight, moved = own, np.zeros(3)
    for _ in range(10):
        moved = np.linalg.solve(columns.T @ (weight[:, None] * columns), columns.T @ (weight * target))
        left = (target - columns @ moved).reshape(-1, 2)
        spread = float(np.sqrt(np.median((left**2).sum(1)) / (2 * np.log(2)))) + 1e-9
        weight = own / np.repeat(1 + (left**2).sum(1) / (2 * max(spread, FLOOR_PX)) ** 2, 2)
    return moved


def _by_centre(sight: Sight, px: np.ndarray) -> np.ndarray:
    """How far (N, 2, 3) the picture of the plane point that is mirrored at pixels (N, 2) moves with the centre [px/m].

    The mirrored point is held: ``dx = -(dP/dx)^-1 dP/dc``, by central differences.
    """

    def ground(place: np.ndarray, centre: np.ndarray) -> np.ndarray:
        return ball_points(replace(sight, centre=centre), place)[3][:, ::2]

    step, metres = 0.25, 1e-3 * sight.radius
    by_px = np.stack(
        [(ground(px + step * e, sight.centre) - ground(px - step * e, sight.centre)) / (2 * step) for e in np.eye(2)],
        -1,
    )
    by_centre = np.stack(
        [
            (ground(px, sight.centre + metres * e) - ground(px, sight.centre - metres * e)) / (2 * metres)
            for e in np.eye(3)
        ],
        -1,
    )
    good = np.isfinite(by_px).all((1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(by_px))) > 1e-14)
    found = np.full((len(px), 2, 3), np.nan)
    found[good] = -np.linalg.solve(by_px[good], by_centre[good])
    return found


def second_view_sigma(one: ViewMap, other: ViewMap) -> float:
    """Rms angle [rad] by which one view's directions would have to be off to explain how two views disagree.

    Above the horizon, where both see well: squared differences beyond their variances over the squared gradient, both
    of the logarithm so that lamps do not decide alone. An upper bound of what dents do: parallax is in it. NaN when
    they share too little.
    """
    rows = min(COMPARED_ROWS, one.rgb.shape[0])
    good = np.minimum(one.weight > 0.5 * one.weight.max(), other.weight > 0.5 * other.weight.max()).astype(float)
    good = good * (np.maximum(one.clipped, other.clipped) < 0.01)
    share = resize_environment(good[..., None], rows, 2 * rows)[..., 0]
    used = (share > 0.99) & (latlong_directions(rows, 2 * rows)[..., 1] > HORIZON)
    if used.sum() < 100:
        return np.nan
    grey = [resize_environment(view.rgb, rows, 2 * rows).mean(-1) for view in (one, other)]
    used &= (grey[0] > 0) & (grey[1] > 0)
    scale = 0.1 * float(np.median(grey[0][used]))
    tone = [np.log(np.maximum(part, 0) + scale) for part in grey]
    across = rows / one.rgb.shape[0]  # texels are means: noise of independent ones falls so
    noise = sum(
        resize_environment(np.where(good[..., None] > 0, view.variance, 0), rows, 2 * rows).mean(-1) * across**2
        / (part + scale) ** 2
        for view, part in zip((one, other), grey, strict=True)
    )  # fmt: skip
    difference = tone[0] - tone[1]
    difference = difference - np.median(difference[used])
    slope = gradient_per_radian(0.5 * (tone[0] + tone[1])[..., None])[..., 0]
    area = latlong_solid_angles(rows, 2 * rows)
    excess = float(((difference**2 - noise) * area)[used].sum())
    return float(np.sqrt(max(excess, 0) / max(float((slope**2 * area)[used].sum()), 1e-30)))


def unsure(view: ViewMap, sigma: float) -> ViewMap:
    """A view whose directions are off by ``sigma`` [rad] more than was thought."""
    per_axis = sigma / np.sqrt(2)  # along the gradient
    variance = view.variance + (gradient_per_radian(view.rgb) * per_axis) ** 2
    quality = view.quality
    if quality is not None:
        quality = Quality(np.hypot(quality.sigma_rad, per_axis), quality.pixels, quality.pixel_variance)
    return replace(view, variance=variance, quality=quality)
