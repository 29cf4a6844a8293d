"""The response curve of photographs that are no longer linear, recovered from their brackets, with its uncertainty.

Per channel the light of a code is ``ln L(z) = h(ln sRGB^-1(z))``: h the identity for a camera that follows sRGB to the
letter, in general a monotone cubic spline (non-negative increments) whose slope is held towards its neighbours' and
towards 1 (`SLOPE_STEP`, `SLOPE_SPREAD`). Small flat blocks seen in several frames say ``ln L(z_pi) - ln y_p - ln t_i =
noise``; the lights y_p are eliminated, the exposures t_i are free within their labels' error and shared by the three
channels. The noise is in the codes: its size in ln L, slope times sigma, is part of what is fitted. Taken as given, it
flattens the curve wherever exposures in equal steps leave it free, by 10 to 30 %. Outliers (what moved) weigh less and
less (Tukey's biweight); the noise is measured in eight ranges of codes. The covariance is that of the free parameters.

What a bracket cannot tell: a power of the whole curve against a power of all exposures (the labels decide, on average),
and a factor per channel (the middle code is taken as grey: equal codes are neutral light there).

Sources: Debevec and Malik 1997 (the equation), Grossberg and Nayar 2003 (what is ambiguous), Ramsay 1988 (monotone
splines). OpenCV's CalibrateDebevec and CalibrateRobertson answer the same question without bounds, exposure errors or
uncertainty; docs/method.md has the three side by side.
Limits: one curve for all frames and the whole picture; local tone mapping and sharpening appear as misfit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.image.colour import decode_srgb

CLIPPED_CODE, DARK_CODE = 250 / 255, 2.5 / 255  # outside, a code says no more than "at least" and "at most"
KNOT_CODES = (2, 4, 8, 14, 22, 32, 44, 58, 74, 92, 112, 134, 156, 178, 198, 214, 228, 240, 248, 255)
SLOPE_STEP, SLOPE_SPREAD, LEAST_SLOPE = 0.05, 1.0, 0.02  # of dh from knot to knot, against 1, and at least
BLOCK = 4  # px
BINS, POINTS = 32, 4000  # ranges of codes, and blocks in all that are kept, evenly over them and the frames
MAX_BLOCK_SPREAD = 0.04  # of full scale: rougher blocks have an edge in them
LEAST_BLOCK_SIGMA = 0.1 / 255  # of a block's mean code: what compression leaves however flat it is
EXPOSURE_SIGMA = 0.05  # of a label, relative
DARK_SHARE = 0.2  # of the shortest frames' pixels, whose code is compared
PEDESTAL_SIGMAS = 4.0  # above the pedestal a code means something
ROBUST = 4.0  # sigma beyond which a block has moved (Tukey's biweight reaches zero at 1.5 times this)
REDUNDANCY = 4.0  # blocks that say the same: three channels share most noise, neighbours share a JPEG transform
ROUNDS = 8
TABLE = 1024  # codes at which curve and uncertainty are tabulated
LINEAR_WHITE = 65535.0


@dataclass(frozen=True, eq=False)
class Response:
    """ln of relative light of code k / (TABLE - 1), (TABLE, 3), never falling; 0 at the largest code of the channels.

    ``covariance`` (3, K, K) of the coefficients and ``basis`` (TABLE, K) give that of the curve, relative to the middle
    code. ``offsets``: ln(exposure / label) of every frame in the order given. ``misfit``: noise of a block's mean,
    codes of 255. ``support`` (3, 2): smallest and largest code / white that a bracket showed twice.
    """

    log_light: np.ndarray
    basis: np.ndarray
    covariance: np.ndarray
    offsets: np.ndarray
    misfit: float
    support: np.ndarray
    blocks: int
    pedestal: np.ndarray  # (3,) code / white of no light: film base, black that was lifted; all codes here are above it
    dark: np.ndarray  # (3,) code / white above the pedestal below which a code says no more than "at most"

    def above(self, code: np.ndarray) -> np.ndarray:
        """Codes / white (..., 3) as share of the range above the pedestal, not below 0."""
        return np.maximum((code - self.pedestal) / (1 - self.pedestal), 0)

    def sigma(self) -> np.ndarray:
        """(TABLE, 3) standard uncertainty of ``log_light``."""
        return np.sqrt(np.stack([np.einsum("tk,kl,tl->t", self.basis, c, self.basis) for c in self.covariance], -1))

    def steepness(self, code: np.ndarray, channel: int) -> np.ndarray:
        """D ln L / d(code / white) of codes / white."""
        slope = np.maximum(np.gradient(self.log_light[:, channel], _grid()), 0.1)
        return np.interp(code, _grid(), slope)

    def table(self, white: float) -> np.ndarray:
        """(white + 1, 3) uint16 light of every code; below the darkest that means anything a straight line to 0."""
        code = self.above(np.repeat(np.arange(round(white) + 1)[:, None] / white, 3, 1))
        light = np.stack([np.exp(np.interp(code[:, c], _grid(), self.log_light[:, c])) for c in range(3)], -1)
        edge = np.array([np.exp(np.interp(self.dark[c], _grid(), self.log_light[:, c])) for c in range(3)])
        light = np.where(code < self.dark, edge * code / self.dark, light)
        top = max(np.exp(np.interp(CLIPPED_CODE, _grid(), self.log_light[:, c])) for c in range(3))
        scaled = np.minimum(np.rint(light / top * LINEAR_WHITE), LINEAR_WHITE)
        scaled[code >= CLIPPED_CODE] = LINEAR_WHITE
        return scaled.astype(np.uint16)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Observations of one channel: which point, which frame, mean code / white."""

    point: np.ndarray
    frame: np.ndarray
    code: np.ndarray


def recover(views: Sequence[Sequence[np.ndarray]], labels: Sequence[Sequence[float]], white: float) -> Response:
    """The curve of one camera from the brackets of its views: codes (H, W, 3) and relative exposures by label.

    Without two frames of one view that show the same things the answer is the prior: sRGB, and as unsure as that is.
    """
    floors = [pedestal(views, labels, white, channel) for channel in range(3)]
    blocks = [_blocks(views, white, channel, *floors[channel]) for channel in range(3)]
    logs = np.log(np.concatenate([np.asarray(label, float) for label in labels]))
    ladder = np.concatenate([np.log(label) - np.mean(np.log(label)) for label in labels])
    errors = _across(ladder)
    weight = [np.ones(len(b.code)) for b in blocks]
    sigma = [np.full(len(b.code), 0.5 / 255) for b in blocks]
    slopes, offsets = np.ones((3, _size())), np.zeros(len(logs))
    for _ in range(ROUNDS):
        slopes, offsets, _ = _step(blocks, sigma, weight, logs, errors, slopes, offsets, SLOPE_STEP)
        pulls = [_pulls(b, k, s, w, logs + offsets) for b, k, s, w in zip(blocks, slopes, sigma, weight)]
        sigma = [_rescaled(b, s, pull) for b, s, pull in zip(blocks, sigma, pulls)]
        weight = [np.clip(1 - (pull / (1.5 * ROBUST)) ** 2, 0, None) ** 2 for pull in pulls]
    # The fit holds slopes together by what curves do as a rule; how unsure it is follows from what this one does.
    bend = max(SLOPE_STEP, float(np.sqrt((np.diff(slopes, axis=1) ** 2).mean())))
    covariance = _step(blocks, sigma, weight, logs, errors, slopes, offsets, bend)[2]
    design = _design(_grid())
    basis = design - design[TABLE // 2]
    curve = basis @ slopes.T
    power = EXPOSURE_SIGMA**2 / max(float(ladder @ ladder), EXPOSURE_SIGMA**2)  # variance of the curve's power
    covariance = covariance + power * np.einsum("ck,cl->ckl", slopes, slopes)
    every = np.concatenate(sigma) if any(len(s) for s in sigma) else np.zeros(1)
    support = [[b.code.min(), b.code.max()] if len(b.code) else [0.5, 0.5] for b in blocks]
    return Response(
        curve - curve[-1].max(), basis, covariance, offsets, 255 * float(np.median(every)), np.array(support),
        sum(len(np.unique(b.point)) for b in blocks), *np.array(floors).T,
    )  # fmt: skip


def pedestal(
    views: Sequence[Sequence[np.ndarray]], labels: Sequence[Sequence[float]], white: float, channel: int
) -> tuple[float, float]:
    """Code / white of no light, and how far above it a code means something: what does not fall with the exposure.

    A fifth of the two shortest frames of a view at the same code, though their exposures differ, has no light in it.
    """
    for stack, label in zip(views, labels):
        order = np.argsort(label)
        if len(order) < 2 or label[order[1]] < 1.4 * label[order[0]]:
            continue
        shortest, next_one = (stack[order[i]][..., channel] / white for i in (0, 1))
        levels = [float(np.quantile(picture, DARK_SHARE)) for picture in (shortest, next_one)]
        if abs(levels[0] - levels[1]) < 0.6 / 255 and levels[0] > DARK_CODE:
            level = float(np.median(shortest[shortest <= 2 * levels[0]]))
            spread = 1.4826 * float(np.median(np.abs(shortest[shortest <= 2 * levels[0]] - level)))
            return level, max(DARK_CODE, PEDESTAL_SIGMAS * spread)
    return 0.0, DARK_CODE


# Basis ----------------------------------------------------------------------------------------------------------------


def _grid() -> np.ndarray:
    return np.linspace(0, 1, TABLE)


def _abscissa(code: np.ndarray) -> np.ndarray:
    """Ln sRGB^-1 of codes / white, held below the first knot."""
    return np.log(decode_srgb(np.maximum(code, KNOT_CODES[0] / 255)))


def _knots() -> np.ndarray:
    inner = _abscissa(np.array(KNOT_CODES) / 255)
    return np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])


def _size() -> int:
    return len(KNOT_CODES) + 1  # increments of the len + 2 cubic splines


def _design(code: np.ndarray) -> np.ndarray:
    """(N, K): d ln L / d slope_k; K slopes of 1 make h the identity, up to a constant."""
    from scipy.interpolate import BSpline

    if not len(code):
        return np.zeros((0, _size()))
    knots = _knots()
    splines = BSpline.design_matrix(np.clip(_abscissa(code), knots[0], knots[-1]), knots, 3).toarray()
    greville = (knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3
    above = np.cumsum(splines[:, ::-1], 1)[:, ::-1][:, 1:]  # sum of splines k and up: what increment k adds to
    return np.asarray(above * np.diff(greville))


def _design_slope(code: np.ndarray) -> np.ndarray:
    """(N, K) derivative of `_design` by code / white."""
    table = np.gradient(_design(_grid()), _grid(), axis=0)
    return np.asarray(table[np.rint(code * (TABLE - 1)).astype(int)])


def _steepness(code: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """(N,) d ln L / d(code / white)."""
    return np.maximum(_design_slope(code) @ slopes, 0.1)


# Observations ---------------------------------------------------------------------------------------------------------


def _blocks(views: Sequence[Sequence[np.ndarray]], white: float, channel: int, floor: float, dark: float) -> _Blocks:
    points, frames, codes = [], [], []
    first_frame, first_point = 0, 0
    per_bin = int(np.clip(POINTS / BINS / max(1, sum(len(stack) for stack in views)), 4, 40))
    for stack in views:
        found = [_block_means((picture[..., channel] / white - floor) / (1 - floor), dark) for picture in stack]
        mean = np.stack([m for m, _ in found])  # (F, P)
        usable = np.stack([ok for _, ok in found])
        wanted = np.flatnonzero(_chosen(mean, usable, per_bin) & (usable.sum(0) > 1))
        frame, point = np.nonzero(usable[:, wanted])
        points.append(point + first_point)
        frames.append(frame + first_frame)
        codes.append(mean[:, wanted][frame, point])
        first_frame, first_point = first_frame + len(stack), first_point + len(wanted)
    return _Blocks(*(np.concatenate(parts) for parts in (points, frames, codes)))


def _block_means(codes: np.ndarray, dark: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean code / white of every block, and whether it is flat and neither clipped nor dark."""
    rows, columns = (size // BLOCK for size in codes.shape)
    cut = codes[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    low, high, mean = cut.min((1, 3)), cut.max((1, 3)), cut.mean((1, 3))
    usable = (low > dark) & (high < CLIPPED_CODE) & (high - low < 3 * MAX_BLOCK_SPREAD)
    return mean.ravel(), usable.ravel()


def _chosen(mean: np.ndarray, usable: np.ndarray, per_bin: int) -> np.ndarray:
    """(P,) bool: evenly over each frame's codes, every so many of those at hand."""
    chosen = np.zeros(mean.shape[1], bool)
    twice = usable.sum(0) > 1
    for codes, good in zip(mean, usable & twice):
        bins = np.clip((codes * BINS).astype(int), 0, BINS - 1)
        for number in range(BINS):
            members = np.flatnonzero(good & (bins == number))
            chosen[members[:: max(1, len(members) // per_bin)]] = True
    return chosen


# Least squares --------------------------------------------------------------------------------------------------------


def _centred(values: np.ndarray, weight: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Rows less the weighted mean of their point: what is left once the light of each point is eliminated."""
    count = int(point.max()) + 1 if len(point) else 0
    total = np.maximum(np.bincount(point, weight, count), 1e-300)
    columns = values[:, None] if values.ndim == 1 else values
    means = np.stack([np.bincount(point, weight * column, count) / total for column in columns.T], -1)
    return np.asarray((columns - means[point]).reshape(values.shape))


def _across(ladder: np.ndarray) -> np.ndarray:
    """(F, F - 1) orthonormal directions of exposure errors across the ladder of labels, (F, F) without a ladder.

    Errors along it are a power of all exposures, which no bracket shows; left free, the fit would flatten the curve to
    lessen its residuals.
    """
    if not ladder.any():
        return np.eye(len(ladder))
    return np.asarray(np.linalg.svd(ladder[None])[2][1:].T)


def _step(
    blocks: list[_Blocks], sigma: list[np.ndarray], weight: list[np.ndarray], logs: np.ndarray, errors: np.ndarray,
    slopes: np.ndarray, offsets: np.ndarray, bend: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """One bounded Gauss-Newton step, shortened until the cost falls, on ``sum (misfit / (sigma d ln L / dz))^2``.

    Slopes (3, K), offsets (F,) within the columns of ``errors`` (F, E), covariance (3, K, K) of the slopes. The noise
    is in the codes, so the denominator belongs to the unknowns too; taken as given, it would reward flat stretches.
    """
    from scipy.optimize import lsq_linear

    size, count = _size(), errors.shape[1]
    total = 3 * size + count
    start = np.concatenate([slopes.ravel(), errors.T @ offsets])
    prior, wanted = _prior(errors, bend)
    normal, right = prior.copy(), wanted.copy()
    for channel, (b, s, w) in enumerate(zip(blocks, sigma, weight)):
        design, steepness = _design(b.code), _steepness(b.code, slopes[channel])
        each = w / (s * steepness) ** 2 / REDUNDANCY
        rows = _centred(np.hstack([design, -errors[b.frame]]), each, b.point)
        left = _centred(design @ slopes[channel] - (logs + offsets)[b.frame], each, b.point)
        where = np.r_[channel * size : (channel + 1) * size, 3 * size : total]
        data = rows.T @ (each[:, None] * rows)
        gradient = rows.T @ (each * left)
        gradient[:size] -= _design_slope(b.code).T @ (each * left**2 / steepness)
        normal[np.ix_(where, where)] += data
        right[where] += data @ start[where] - gradient
    factor = np.linalg.cholesky(normal)
    low = np.r_[np.full(3 * size, LEAST_SLOPE), np.full(count, -np.inf)]
    found = lsq_linear(factor.T, np.linalg.solve(factor, right), (low, np.inf), method="bvls").x
    free = np.flatnonzero(found > low + 1e-9)
    covariance = np.zeros((total, total))
    covariance[np.ix_(free, free)] = np.linalg.inv(normal[np.ix_(free, free)])
    parts = [slice(c * size, (c + 1) * size) for c in range(3)]

    def cost(values: np.ndarray) -> float:
        held = 0.5 * values @ prior @ values - wanted @ values
        for b, s, w, part in zip(blocks, sigma, weight, parts):
            pull = _pulls(b, values[part], s, w, logs + errors @ values[3 * size :], False)
            held += 0.5 * float(w @ pull**2) / REDUNDANCY
        return float(held)

    now, share = cost(start), 1.0
    while share > 0.01 and not cost(start + share * (found - start)) <= now:
        share /= 2
    found = start + share * (found - start) if share > 0.01 else start
    return found[: 3 * size].reshape(3, size), errors @ found[3 * size :], np.stack([covariance[p, p] for p in parts])


def _prior(errors: np.ndarray, bend: float) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and right side of what is known beforehand of offsets, and of slopes that ``bend`` so from knot to
    knot.
    """
    size = _size()
    total = 3 * size + errors.shape[1]
    normal, right = np.zeros((total, total)), np.zeros(total)
    steps = np.diff(np.eye(size), axis=0) / bend
    for channel in range(3):
        part = slice(channel * size, (channel + 1) * size)
        normal[part, part] = steps.T @ steps + np.eye(size) / (size * SLOPE_SPREAD**2)
        right[part] = 1 / (size * SLOPE_SPREAD**2)
    # no heavy tails: one frame far off would buy a power of the curve for all the others
    normal[3 * size :, 3 * size :] = errors.T @ errors / EXPOSURE_SIGMA**2
    return normal, right


def _pulls(
    blocks: _Blocks, slopes: np.ndarray, sigma: np.ndarray, weight: np.ndarray, logs: np.ndarray, freed: bool = True
) -> np.ndarray:
    """Residuals over their standard deviation; ``freed``: corrected for the point's mean having been taken off."""
    if not len(blocks.code):
        return np.zeros(0)
    spread = sigma * _steepness(blocks.code, slopes)
    each = np.maximum(weight, 1e-6) / spread**2
    left = _centred(_design(blocks.code) @ slopes - logs[blocks.frame], each, blocks.point)
    if not freed:
        return np.asarray(left / spread)
    share = each / np.bincount(blocks.point, each)[blocks.point]
    return np.asarray(left / (spread * np.sqrt(np.maximum(1 - share, 0.05))))


def _rescaled(blocks: _Blocks, sigma: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """The noise of a block's mean code, by eight ranges of codes, as the residuals show it (median: motion is none)."""
    bins = np.minimum((blocks.code * 8).astype(int), 7)
    result = sigma.copy()
    for number in range(8):
        members = bins == number
        if members.sum() >= 20:
            result[members] *= 1.4826 * float(np.median(np.abs(pull[members])))
    return np.maximum(result, LEAST_BLOCK_SIGMA)
