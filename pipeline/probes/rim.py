"""The rim of a mirror ball: where a blurred silhouette lies, by a model of the light on both of its sides.

At grazing incidence a mirror continues its background, and at depth ``u`` under the rim of a ball of radius ``R`` px it
shows the world ``2 acos(1 - u / R)``, about ``sqrt(8 u / R)`` rad, away from it. So just inside the rim a picture goes
as the square root of the depth, beside a step where the mirror loses light; blur moves the steepest place of that
mixture inwards by 0 (all step) to 0.76 of its sigma (all root), and how far depends on what is mirrored. A common inset
of edge points is therefore wrong by design. Here the mixture itself is fitted, in linear radiance:

The outline is cut into short sectors. In each, the radiance is a constant outside, nearly the same constant inside, and
on both sides a Brownian path: in the distance outside, in the mirrored angle inside; all blurred, with trends along the
arc. Their amplitudes have priors, and what they explain is integrated out (Gaussian process; Rasmussen and Williams
2006, 2.3), the determinant included: without it the rim drifts to the stiffer side, 0.3 to 1 px. What is left depends
on centre (3) and blur (1) alone. Each sector's misfit sets its own weight (Student's likelihood), so that the foot, a
mirrored edge, a saturated rim or a stand speak little; the covariance is clustered by sector (sandwich; White 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import unproject
from pipeline.probes.outline import azimuths, radius_in_pixels, silhouette
from pipeline.types import Camera

ARC_PX, MAX_SECTORS = 5.0, 180  # length of a sector; more sectors than these are thinned evenly
BESIDE_PX = 0.0  # of the annulus on both sides, beyond three times the blur or 2 px
BLUR_PX, BLUR_LOG_SIGMA, BLUR_RANGE = 0.8, 0.5, (0.3, 6.0)  # prior of the blur: pixel, lens and demosaicking
KEEP, STEP = 0.92, 0.06  # radiance just inside the rim over that outside, and its spread
MIRRORED, BEHIND, ALONG = 0.15, 0.01, 0.05  # relative change of radiance per root radian; outside; along the arc
SLOPE_IN, SLOPE_OUT = 0.4, 0.01  # relative slope per mirrored radian, and per pixel outside
INNER_TERMS, OUTER_TERMS = 5, 3
GRID = 0.04  # of the profiles' table, in blurs
SCATTER, CAUCHY = 0.2, 5.0  # of the sectors' median disagreement: what none knows better, and what is astray
STUDENT = 4.0  # degrees of freedom that the noise model has in a sector's weight
DARKEST = 1e-4  # sector, over the outline's median
MODEL_REL = 1e-3  # of the radiance: no model of the light is better than this
# What the sectors have in common that the sandwich cannot see, in blurs: a common inset, and a drift to one side.
# Measured over simulated balls by `benchmarks.probe_fit.coverage`. A drift evens out over the outline less when the
# frame shows only a part of it, so the part is its divisor: judged by hand on 30 balls cut to 40 to 57 %, of which 29
# lay in their 95 % region with it and 23 without. Too few to say more than that it helps.
INSET_BLURS, DRIFT_BLURS = 0.65, 0.58


@dataclass(frozen=True)
class Patches:
    """Pixels about the outline by sector: S sectors, N pixels, C channels; radiance over the sector's median."""

    rays: np.ndarray  # (S, N, 3) unit
    by_px: np.ndarray  # (S, N, 3, 2)
    values: np.ndarray  # (S, N, C)
    use: np.ndarray  # (S, N) 0 or 1
    along: np.ndarray  # (S, N) in [-1, 1]
    floor: np.ndarray  # (S, C) variance of a value
    inner: float  # px inside the rim
    outer: float  # px outside
    expected: int  # sectors of the whole outline


@dataclass(frozen=True)
class RimFit:
    """Centre (3,) [m], blur [px], covariance (4, 4) of (centre, log blur), and what the sectors said."""

    centre: np.ndarray
    blur_px: float
    covariance: np.ndarray
    rms_px: float  # scatter of the rim's place over sectors, weighted as they count
    sectors: int
    converged: bool


def _path(t: np.ndarray, count: int) -> np.ndarray:
    """Karhunen-Loeve terms (..., count) of a Brownian path on [0, 1]."""
    k = np.pi * (np.arange(count) + 0.5)
    return np.sqrt(2) * np.sin(k * t[..., None]) / k


def _table(blur: float, inner: float, outer: float, size: float) -> tuple[float, float, np.ndarray]:
    """First depth, pitch [px] and values (M, P) of the blurred profiles: out, in, out's and in's path, in's swing."""
    from scipy.ndimage import gaussian_filter1d

    pitch = GRID * blur
    depth = np.arange(-outer - 5 * blur, inner + 5 * blur, pitch)
    inside = np.clip(depth / pitch + 0.5, 0, 1)[:, None]
    swing = np.arccos(1 - np.clip(depth / size, 0, 1)) / np.arccos(1 - min(inner / size, 1))
    within = _path(np.minimum(swing, 1.5), INNER_TERMS) * inside
    beyond = _path(np.clip(-depth / outer, 0, 1.5), OUTER_TERMS) * (1 - inside)
    swing = swing[:, None] * inside
    columns = np.concatenate([1 - inside, inside, swing, np.clip(-depth / outer, 0, 2)[:, None], within, beyond], 1)
    return depth[0], pitch, gaussian_filter1d(columns, 1 / GRID, axis=0, mode="nearest", truncate=4)


def gather(
    picture: np.ndarray, variance: np.ndarray, valid: np.ndarray, camera: Camera, centre: np.ndarray, radius: float,
    blur: float, beside: float = BESIDE_PX,
) -> Patches | None:  # fmt: skip
    """Pixels of the sectors of the outline about ``centre``; None when fewer than four are seen.

    ``picture``, ``variance`` (H, W, C) are linear and finite; ``valid`` (H, W) says which pixels are measured.
    """
    size = radius_in_pixels(camera, centre, radius)
    count = int(np.clip(2 * np.pi * size / ARC_PX, 12, MAX_SECTORS))
    px, normal, _ = silhouette(camera, centre, radius, azimuths(count))
    outer = max(3 * blur, 2.0) + beside
    inner = min(outer, 0.4 * size)
    half = 0.5 * min(ARC_PX, 2 * np.pi * size / count)
    reach = int(np.ceil(outer + half)) + 1
    shifts = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), -1).reshape(-1, 2)
    place = np.floor(px)[:, None] + shifts + 0.5
    offset = place - px[:, None]
    across = (offset * normal[:, None]).sum(-1)
    along = (offset[..., 1] * normal[:, None, 0] - offset[..., 0] * normal[:, None, 1]) / half
    near = (across < outer) & (across > -inner) & (np.abs(along) <= 1)
    framed = (place > 0).all(-1) & (place < (camera.width, camera.height)).all(-1)
    column, row = (np.clip(place[..., i].astype(int), 0, n - 1) for i, n in enumerate((camera.width, camera.height)))
    use = near & framed & valid[row, column]
    kept = use.sum(1) >= np.maximum(0.7 * near.sum(1), 12)
    if kept.sum() < 4:
        return None
    most = int(use.sum(1).max())
    order = np.argsort(~use, axis=1, kind="stable")[:, :most]
    use, along, row, column = (np.take_along_axis(a, order, 1)[kept] for a in (use, along, row, column))
    there = use[..., None]
    rays, by_px = _rays(camera, np.where(there, np.stack([column, row], -1) + 0.5, px[kept][:, None]))
    values = np.where(there, picture[row, column], 0).astype(float)
    level = np.nanmedian(np.where(there, np.abs(values), np.nan), 1)
    level = np.maximum(level, max(DARKEST * float(np.median(level)), 1e-30))  # pictures of 8 bits have sectors of 0
    noise = np.where(there, variance[row, column], 0).sum(1) / use.sum(1)[:, None] / level**2
    return Patches(
        rays, by_px, values / level[:, None], use.astype(float), along, noise + MODEL_REL**2, inner, outer, count
    )


def _rays(camera: Camera, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (..., 3) of pixels (..., 2), and their derivative (..., 3, 2) by the pixel."""

    def unit(px: np.ndarray) -> np.ndarray:
        xy = unproject(camera, px.reshape(-1, 2)).reshape(px.shape)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    rays, step = unit(place), 0.25
    return rays, np.stack([(unit(place + step * e) - rays) / step for e in np.eye(2)], -1)


def depth_under_rim(patches: Patches, centre: np.ndarray, radius: float) -> np.ndarray:
    """Depth (S, N) [px] of pixels inside the silhouette: angle to it over the angle's gradient in the picture."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    cosine = np.clip(patches.rays @ axis, -1, 1)
    gradient = np.linalg.norm(np.einsum("snij,i->snj", patches.by_px, axis), axis=-1)
    gradient = gradient / np.sqrt(np.maximum(1 - cosine**2, 1e-18))
    return (np.arcsin(min(float(radius / distance), 0.999)) - np.arccos(cosine)) / np.maximum(gradient, 1e-12)


def misfit(
    patches: Patches, centre: np.ndarray, radius: float, blur: float, size: float, relative: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What the light's model leaves (S, N + P - 1, C), its priors as further rows, and its log determinant (S,).

    ``relative`` (S,) is the noise of a sector over its radiance, ``size`` the ball's radius in pixels.
    """
    # A blurred disc's half level lies inside it by sigma^2 / 2 R (mean-curvature flow).
    depth = depth_under_rim(patches, centre, radius) - blur**2 / (2 * size)
    first, pitch, table = _table(blur, patches.inner, patches.outer, size)
    place = np.clip((depth - first) / pitch, 0, len(table) - 1.001)
    low = place.astype(int)
    profile = table[low] + (place - low)[..., None] * (table[low + 1] - table[low])
    tilted = patches.along[..., None] * profile[..., :3]
    basis = np.concatenate([profile, tilted], -1) * patches.use[..., None]
    swing = 2 * np.arccos(1 - min(patches.inner / size, 1))
    spread = [float(SLOPE_IN * swing), SLOPE_OUT * patches.outer] + [MIRRORED * np.sqrt(swing)] * INNER_TERMS
    spread += [BEHIND] * OUTER_TERMS + [ALONG] * 3
    rows = np.zeros((len(basis), 1 + len(spread), basis.shape[2]))
    rows[:, 0, 1], rows[:, 0, 0] = relative / STEP, -KEEP * relative / STEP
    terms = np.arange(len(spread))
    rows[:, 1 + terms, 2 + terms] = relative[:, None] / spread
    basis = np.concatenate([basis, rows], 1)
    values = np.concatenate([patches.values, np.zeros((len(rows), rows.shape[1], patches.values.shape[2]))], 1)
    turned = np.swapaxes(basis, 1, 2)
    gram = turned @ basis + 1e-9 * np.eye(basis.shape[2])
    return values - basis @ np.linalg.solve(gram, turned @ values), np.linalg.slogdet(gram)[1]


def evidence(patches: Patches, left: np.ndarray, determinant: np.ndarray) -> np.ndarray:
    """Minus twice the log likelihood (S,) of each sector, up to a constant."""
    freedom = patches.use.sum(1)[:, None]
    spread = np.log((left**2).sum(1) + STUDENT * patches.floor)
    return ((freedom + STUDENT) * spread).sum(1) + left.shape[2] * determinant


def fit_rim(
    patches: Patches, camera: Camera, centre: np.ndarray, radius: float, blur: float, steps: int = 10
) -> RimFit:  # fmt: skip
    """Gauss-Newton on (centre, log blur) over the sectors of `gather`."""
    size, distance = radius_in_pixels(camera, centre, radius), float(np.linalg.norm(centre))
    frame = np.linalg.svd(centre[None] / distance)[2]  # along the ray, and two across
    frame[0] = centre / distance
    pixel = radius / size
    scale = np.array([pixel * distance / radius, pixel, pixel])  # metres that move the rim by about a pixel
    freedom = np.maximum(patches.use.sum(1) - 5, 1)[:, None]
    relative = np.sqrt(patches.floor.mean(-1))
    converged, held, normal = False, np.eye(4), np.eye(4)
    for _ in range(steps):
        score, hessian, relative = _slopes(patches, centre, radius, blur, size, relative, freedom, frame, scale)
        share = agreement(score, hessian)
        score, hessian = share[:, None] * score, share[:, None, None] * hessian
        normal, pull = hessian.sum(0), score.sum(0)
        normal[3, 3] += 1 / BLUR_LOG_SIGMA**2
        pull[3] += np.log(blur / BLUR_PX) / BLUR_LOG_SIGMA**2
        held = normal + 1e-6 * np.trace(normal) * np.eye(4)
        step = np.linalg.solve(held, pull) if np.isfinite(held).all() else np.full(4, np.nan)
        if not np.isfinite(step).all():  # black all around: nothing to fit
            return RimFit(np.full(3, np.nan), blur, np.full((4, 4), np.inf), np.inf, len(patches.use), False)
        step[:3] *= min(1.0, 1.0 / max(np.abs(step[:3]).max(), 1e-12))  # a pixel at a time
        step[3] = np.clip(step[3], -0.3, 0.3)
        centre = centre - frame.T @ (scale * step[:3])
        blur = float(np.clip(blur * np.exp(-step[3]), *BLUR_RANGE))
        if np.abs(step).max() < 5e-3:
            converged = True
            break
    covariance = _covariance(score, normal, held, blur / min(1.0, len(patches.use) / patches.expected))
    turn = np.eye(4)
    turn[:3, :3] = frame.T * scale
    information = np.maximum(np.einsum("skk->s", hessian[:, :3, :3]), 1e-12)
    shift = np.sqrt((score[:, :3] ** 2).sum(1)) / information
    rms = float(np.sqrt(np.average(shift**2, weights=information)))
    return RimFit(centre, blur, turn @ covariance @ turn.T, rms, len(patches.use), converged)


def _slopes(
    patches: Patches, centre: np.ndarray, radius: float, blur: float, size: float, relative: np.ndarray,
    freedom: np.ndarray, frame: np.ndarray, scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Score (S, 4), information (S, 4, 4) by (along, across, across, log blur) and relative noise of every sector."""
    left, determinant = misfit(patches, centre, radius, blur, size, relative)
    by_residual, by_determinant, step = [], [], 0.03
    for k in range(4):
        moved = centre + step * scale[k] * frame[k] if k < 3 else centre
        there, other = misfit(patches, moved, radius, blur * np.exp(step) if k == 3 else blur, size, relative)
        by_residual.append((there - left) / step)
        by_determinant.append((other - determinant) / step)
    jacobian = np.stack(by_residual, -1)
    spread = ((left**2).sum(1) + STUDENT * patches.floor) / (freedom + STUDENT)
    spread = np.maximum(spread, patches.floor)
    score = np.einsum("snck,snc,sc->sk", jacobian, left, 1 / spread)
    score += 0.5 * left.shape[2] * np.stack(by_determinant, -1)
    hessian = np.einsum("snck,sncl,sc->skl", jacobian, jacobian, 1 / spread, optimize=True)
    return score, hessian, np.sqrt(spread.mean(-1))


def agreement(score: np.ndarray, hessian: np.ndarray) -> np.ndarray:
    """Share (S,) of each sector's information that counts: random effects, and Cauchy's weight for those astray.

    Sectors scatter by more than their noise, as their light is not the model's: with a scatter of tau no sector knows
    the rim better than tau (DerSimonian and Laird 1986), however much contrast it has. Unit: pixels of rim.
    """
    information = np.maximum(np.einsum("skk->s", hessian[:, :3, :3]), 1e-9)
    astray = np.linalg.norm(score[:, :3], axis=1) / information
    order = np.argsort(astray)
    weight = 1 / (1 + 0.01 / information[order])
    middle = max(float(astray[order][np.searchsorted(np.cumsum(weight), 0.5 * weight.sum())]), 0.02)
    return 1 / (1 + information * (SCATTER * middle) ** 2) / (1 + (astray / (CAUCHY * middle)) ** 2)


def _covariance(score: np.ndarray, normal: np.ndarray, held: np.ndarray, blur: float) -> np.ndarray:
    """Clustered sandwich (4, 4) in pixels of rim, and what all sectors have in common, by the blur over their share."""
    inverse = np.linalg.inv(held)
    centred = score - score.mean(0)
    meat = centred.T @ centred * len(score) / max(len(score) - 4, 1)
    common = np.diag(np.square([INSET_BLURS * blur, DRIFT_BLURS * blur, DRIFT_BLURS * blur, 0]))
    meat = meat + normal @ common @ normal
    return inverse @ meat @ inverse
