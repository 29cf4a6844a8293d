"""Differential rendering: how the modelled change enters the photograph (Debevec 1998; equations 3 to 5).

    (3)  Error    = LS_noobj - LS_b
    (4)  LS_final = LS_obj - Error = LS_b + (LS_obj - LS_noobj)      additive; may turn negative
    (5)  LS_final = LS_b * LS_obj / LS_noobj                         ratio; undefined as LS_noobj -> 0

Both are members of one family, linear in the light that the objects take (lost, <= 0) and add (gained), with N the
*expected* LS_noobj, so linear in the noise and without the bias of a quotient of two noisy renders:

    LS_final = LS_b * (1 + t lost / N + u gained / N) + (1 - t) lost + (1 - u) g gained

(4) is t = u = 0, g = 1; (5) is t = u = 1; `chosen` picks t and g per pixel by predicted error, with u = 0. Every member
is returned as the layers ``plate * mul + add + obj``. All arrays are float, (H, W, 3) or (H, W), and carry coverage: a
pixel half covered by an object has ``alpha`` 0.5 and lost, gained, N of its uncovered half.

What the plate tells is k = LS_b / N = exp(a + i), a from a wrong albedo and i from a wrong irradiance at that place.
Lost light is a share of the light that was there, so its true factor is k, whichever of the two was wrong. Light that
the objects add was modelled apart from N: its true factor is exp(a). Of a known sum of two normal errors, and plate
noise in it, the part that is a has the median w log k with

    w = A^2 / (A^2 + I^2 + var(LS_b) / LS_b^2),    A, I = standard deviations of a and i,

so g = k^w, held between 1/2 and 2: beyond, the plate shows something that the model does not know. The share t weighs
the additive form's error, (k - 1) lost, against the noise that a ratio multiplies by k; see `lost_share`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, replace

import numpy as np

NEGATIVE = 1  # the result is below zero although the plate was not
CLIPPED_PLATE = 2  # the light changes on a clipped plate: the true value is unknowable
GAIN_LIMITED = 4  # the gain of added light was held at its bounds
NO_MODEL = 8  # LS_noobj too small for a ratio: additive instead
BOUNDED = 16  # the factor on the plate would have been negative: held at zero
EDGE_OF_MODEL = 32  # the change ends where the modelled local scene does, not where it fades out
UNSEEN_ALBEDO = 64  # the light changes where the albedo was never seen: extrapolated

GAIN_RANGE = (0.5, 2.0)
HALF_MAX = 65504.0
ALBEDO_SIGMA = 0.35  # of log albedo, prior
IRRADIANCE_SIGMA = 0.2  # of log irradiance, prior
BLOCK_PX = 3  # plate and model are compared over three such blocks to choose a form
FAINT_MODEL = 1e-4  # of the median LS_noobj: below this a ratio is not formed
SEEN_CHANGE = 0.01  # of LS_noobj: what is cut off at the border of the model is worth telling from here on


@dataclass(frozen=True, eq=False)
class Change:
    """What the render says of the local scene, per pixel; see `pipeline.transport.trace.Samples`."""

    obj: np.ndarray  # (H, W, 3) premultiplied object layer
    alpha: np.ndarray  # (H, W) coverage by objects
    lost: np.ndarray  # (H, W, 3) light that the objects take from the uncovered part, <= 0
    gained: np.ndarray  # (H, W, 3) light that they add to it
    without: np.ndarray  # (H, W, 3) expected LS_noobj of the uncovered part
    ground: np.ndarray  # (H, W) share of the pixel that shows the modelled local scene
    variance: np.ndarray | float = 0.0  # (H, W, 3) of lost + gained

    @property
    def difference(self) -> np.ndarray:
        """LS_obj - LS_noobj of the uncovered part (H, W, 3)."""
        return self.lost + self.gained

    @property
    def model(self) -> np.ndarray:
        """LS_noobj (H, W, 3) as if the local scene filled the pixel, like the plate; 0 where it is not in it."""
        share = self.ground[..., None]
        return np.divide(self.without, share, out=np.zeros(self.without.shape), where=share > 0)

    @functools.cached_property
    def usable(self) -> np.ndarray:
        """(H, W, 3) bool: where LS_noobj is large enough to divide by."""
        share = self.ground[..., None]
        lit = self.without[self.ground > 0.5]
        floor = FAINT_MODEL * float(np.median(lit)) if lit.size else 0.0
        return np.asarray((self.without > floor * share) & (share > 0))


@dataclass(frozen=True, eq=False)
class Rule:
    """A member of the family: t, u and g above, each (H, W, 3)."""

    lost_share: np.ndarray
    gained_share: np.ndarray
    gain: np.ndarray
    guards: np.ndarray  # (H, W) uint32, what fired in choosing


@dataclass(frozen=True, eq=False)
class Layers:
    """``plate * mul + add + obj`` is the result; ``guards`` (H, W) uint32 says which guard fired where."""

    mul: np.ndarray
    add: np.ndarray
    obj: np.ndarray
    alpha: np.ndarray
    guards: np.ndarray

    @functools.cached_property
    def touched(self) -> np.ndarray:
        """(H, W) bool: where the layers change anything."""
        changes = (self.mul != 1) | (self.add != 0) | (self.obj != 0)
        return np.asarray(changes[..., 0] | changes[..., 1] | changes[..., 2])

    def apply(self, plate: np.ndarray) -> np.ndarray:
        """The composite (H, W, 3) float32; pixels that no layer touches keep the plate's own bits."""
        return np.where(self.touched[..., None], plate * self.mul + self.add + self.obj, plate)

    def behind(self, mask: np.ndarray) -> Layers:
        """The same behind something real, by its coverage (H, W) in [0, 1]: where it is 1, nothing changes."""
        covered = np.asarray(mask[..., None], np.float32)
        free = 1 - covered
        return Layers(
            self.mul * free + covered,
            self.add * free,
            self.obj * free,
            self.alpha * free[..., 0],
            np.where(mask < 1, self.guards, 0).astype(np.uint32),
        )

    def with_half_mul(self) -> Layers:
        """The same with ``mul`` rounded to 16 bit: a factor is scale-free, so 2^-11 of the result at any radiance.

        The additive layers are radiance, which 16 bit neither reach (65504) nor resolve (6e-8): they stay float32.
        """
        return replace(self, mul=np.minimum(self.mul, HALF_MAX).astype(np.float16).astype(np.float32))


def additive(change: Change) -> Rule:
    """Equation 4."""
    zero = np.zeros(change.lost.shape)
    return Rule(zero, zero, np.ones(change.lost.shape), np.zeros(change.alpha.shape, np.uint32))


def ratio(change: Change) -> Rule:
    """Equation 5, additive where LS_noobj is too small for it (flag NO_MODEL)."""
    usable = change.usable.astype(float)
    return Rule(usable, usable, np.ones(change.lost.shape), _no_model(change))


def chosen(change: Change, plate: np.ndarray, plate_variance: np.ndarray) -> Rule:
    """The default: t and g by predicted error; additive where LS_noobj is too small to divide by (flag NO_MODEL).

    Args:
        change: what the render says.
        plate: (H, W, 3) photograph.
        plate_variance: (H, W, 3); infinite where it is clipped.
    """
    usable = change.usable
    free, bounded = expected_gain(change, plate, plate_variance)
    limited = (free != bounded) & usable & (change.gained != 0)
    return Rule(
        np.where(usable, lost_share(change, plate, plate_variance), 0.0),
        np.zeros(plate.shape),
        np.where(usable, bounded, 1.0),
        _no_model(change) | (GAIN_LIMITED * limited.any(-1)).astype(np.uint32),
    )


def expected_gain(change: Change, plate: np.ndarray, plate_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median of exp(a) given plate and model (H, W, 3), and the same within `GAIN_RANGE`; 1 where there is no model."""
    model, albedo, light = change.model, ALBEDO_SIGMA**2, IRRADIANCE_SIGMA**2
    known = (model > 0) & (plate > 0)
    k = np.divide(plate, model, out=np.ones(plate.shape), where=known)
    noise = np.divide(plate_variance, plate.astype(float) ** 2, out=np.full(plate.shape, np.inf), where=known)
    gain = k ** (albedo / (albedo + light + noise))
    return gain, np.clip(gain, *GAIN_RANGE)


def lost_share(change: Change, plate: np.ndarray, plate_variance: np.ndarray) -> np.ndarray:
    """Share t (H, W, 3) of the lost light that enters as a ratio: the minimum of the predicted squared error.

        (1 - t)^2 D^2 + (1 + t (k - 1))^2 V + (1 - t f)^2 B

    with f = |lost| / N, D = f (LS_b - N) the additive form's error (less what plate noise makes of it), V the variance
    of the lost light, B that of the plate, whose noise a shadow takes along as a ratio and keeps as a difference.

    All of it, relative to N, is that of the surroundings (3 by 3 blocks of `BLOCK_PX`) and of the three channels
    together: a choice that follows the pixel's own noise would pick the smaller of two changes, everywhere, and wash
    the shadow out; and it would leave grain and hue in the layers. Only what keeps the result from turning negative is
    the pixel's own.
    """
    share = change.ground[..., None]
    has = (change.without > 0) & (share > 0) & np.isfinite(plate_variance)
    variances = (np.where(has, plate_variance, 0) * share**2, _variances(change)[0] * has)
    sums = (change.without * has, np.where(has, plate, 0) * share, -change.lost * has)
    (n, p, lost), (b, v) = ([_blocks(part) for part in parts] for parts in (sums, variances))
    around = np.maximum(_surroundings(n), 1e-30)
    excess = _surroundings(p) / around - 1
    # Variances are of sums over blocks; what stays of the plate's in the surroundings is less by their 9 blocks.
    d = (lost / np.maximum(n, 1e-30)) ** 2 * np.maximum(excess**2 - _surroundings(b) / 9 / around**2, 0)
    f, v, b = (part / np.maximum(n, 1e-30) ** power for part, power in ((lost, 1), (v, 2), (b, 2)))
    v, b = v * BLOCK_PX**2, b * BLOCK_PX**2  # of a pixel
    top = _surroundings(d - excess * v + f * b).sum(-1, keepdims=True)
    bottom = _surroundings(d + excess**2 * v + f**2 * b).sum(-1, keepdims=True)
    coarse = np.divide(top, bottom, out=np.ones_like(top), where=bottom > 0)
    height, width = plate.shape[:2]
    t = coarse.repeat(BLOCK_PX, 0).repeat(BLOCK_PX, 1)[:height, :width]
    # No less than what keeps the result from turning negative: LS_b (1 - t f) >= (1 - t) f N.
    dark = share * np.maximum(plate, 0)
    at_risk = has & (change.lost < -dark) & (dark < change.without)
    if at_risk.any():
        lost, dark, n = -change.lost[at_risk], dark[at_risk], change.without[at_risk]
        least = np.zeros(plate.shape)
        least[at_risk] = (lost - dark) / (lost * (1 - dark / n))
        t = np.maximum(t, least.max(-1, keepdims=True))
    return np.broadcast_to(np.clip(t, 0, 1), plate.shape)


def picked(change: Change, row: np.ndarray, column: np.ndarray) -> Change:
    """Some pixels (N,) of a change, as a picture (N, 1)."""
    whole = {f.name: getattr(change, f.name) for f in fields(change)}
    return replace(change, **{name: values[row, column][:, None] for name, values in whole.items() if np.ndim(values)})


def predicted_error(rule: Rule, change: Change, plate: np.ndarray, plate_variance: np.ndarray) -> np.ndarray:
    """Predicted squared error (H, W, 3) of a member of the family where LS_noobj is usable, NaN elsewhere.

    Model error by the disagreement of plate and model and the priors, noise of render and plate by their variances.
    """
    known = change.usable & (plate > 0) & np.isfinite(plate_variance)
    safe, share = np.where(known, change.model, 1.0), np.maximum(change.ground[..., None], 1e-6)
    k = np.where(known, plate, 1.0) / safe
    lost, gained = change.lost / share, change.gained / share
    v_lost, v_gained = (v / share**2 for v in _variances(change))
    albedo, light = ALBEDO_SIGMA**2, IRRADIANCE_SIGMA**2
    noise = np.where(known, plate_variance, 0.0)
    rest = light + noise / np.where(known, plate, 1.0).astype(float) ** 2
    spread = albedo * rest / (albedo + rest)  # variance of a, given the plate
    truth = k ** (albedo / (albedo + rest))
    t, used = rule.lost_share, rule.gained_share * k + (1 - rule.gained_share) * rule.gain
    bias = (1 - t) ** 2 * lost**2 * np.maximum((k - 1) ** 2 - noise / safe**2, 0.0)
    bias = bias + gained**2 * ((used - truth) ** 2 + truth**2 * spread)
    random = (1 + t * (k - 1)) ** 2 * v_lost + used**2 * v_gained
    random = random + (1 + t * lost / safe + rule.gained_share * gained / safe) ** 2 * noise
    return np.where(known, share**2 * (bias + random), np.nan)


def build(change: Change, rule: Rule) -> Layers:
    """The layers, float32, of a rule."""
    mul, add = _parts(change, change.lost, change.gained, rule)
    mul += (1 - change.alpha)[..., None]
    guards = rule.guards | (BOUNDED * (mul < 0).any(-1)).astype(np.uint32)
    mul, add, obj = (np.asarray(values, np.float32) for values in (np.maximum(mul, 0), add, change.obj))
    return Layers(mul, add, obj, np.asarray(change.alpha, np.float32), guards)


def build_group(change: Change, rule: Rule, lost: np.ndarray, gained: np.ndarray, obj: np.ndarray) -> Layers:
    """The layers of one light group, whose lost, gained and obj (H, W, 3) are its parts of the whole ``change``.

    ``mul`` is 1 + the group's part of the factor. Over all groups of a picture, with alpha that of the whole,

        mul = 1 - alpha + sum(mul_g - 1),    add = sum(add_g),    obj = sum(obj_g).
    """
    mul, add = _parts(change, lost, gained, rule)
    uncovered = (1 - change.alpha)[..., None]
    whole = _parts(change, change.lost, change.gained, rule)[0]
    held = np.divide(-uncovered, whole, out=np.ones(whole.shape), where=uncovered + whole < 0)  # as `build` bounds
    mul, add, obj = (np.asarray(values, np.float32) for values in (1 + mul * held, add, obj))
    return Layers(mul, add, obj, np.asarray(change.alpha, np.float32), np.zeros(change.alpha.shape, np.uint32))


def edge_of_model(change: Change, influence: np.ndarray) -> np.ndarray:
    """(H, W) bool: changed pixels next to ones, inside the region of influence, that the local scene does not reach."""
    outside = (influence > 0) & (change.ground + change.alpha < 0.5)
    changed = (np.abs(change.difference) > SEEN_CHANGE * change.without).any(-1) & (change.ground > 0)
    return changed & (_surroundings(outside.astype(np.float32)) > 0)


def _parts(change: Change, lost: np.ndarray, gained: np.ndarray, rule: Rule) -> tuple[np.ndarray, np.ndarray]:
    """Parts of mul and add (H, W, 3) that lost and gained light make."""
    t, u = rule.lost_share, rule.gained_share
    share = change.ground[..., None]
    relative = np.divide(t * lost + u * gained, change.without, out=np.zeros(lost.shape), where=(t + u > 0))
    return relative * share, (1 - t) * lost + (1 - u) * rule.gain * gained


def _blocks(values: np.ndarray) -> np.ndarray:
    """Sums (h, w, 3) over blocks of `BLOCK_PX`, what lies outside the frame counting as zero."""
    total = values
    for axis in (0, 1):
        summed = np.zeros([-(-size // BLOCK_PX) if i == axis else size for i, size in enumerate(total.shape)])
        for offset in range(BLOCK_PX):
            part = total[(slice(None),) * axis + (slice(offset, None, BLOCK_PX),)]
            summed[tuple(slice(size) for size in part.shape)] += part
        total = summed
    return total


def _surroundings(values: np.ndarray) -> np.ndarray:
    """Mean (h, w, ...) over the 3 by 3 neighbours of every entry, zero outside the frame."""
    for axis in (0, 1):
        total = values.copy()
        low, high = (tuple([slice(None)] * axis + [part]) for part in (slice(None, -1), slice(1, None)))
        total[high] += values[low]
        total[low] += values[high]
        values = total
    return values / 9


def _variances(change: Change) -> tuple[np.ndarray, np.ndarray]:
    """The render's variance (H, W, 3) shared out between lost and gained light by their size."""
    size = np.abs(change.lost) + np.abs(change.gained)
    share = np.divide(np.abs(change.lost), size, out=np.full(size.shape, 0.5), where=size > 0)
    return change.variance * share, change.variance * (1 - share)


def _no_model(change: Change) -> np.ndarray:
    missing = (~change.usable & (change.difference != 0)).any(-1)
    return (NO_MODEL * missing).astype(np.uint32)


def flagged(layers: Layers, bit: int, where: np.ndarray) -> Layers:
    """The layers with a guard marked (H, W) bool."""
    return replace(layers, guards=layers.guards | (bit * where).astype(np.uint32))
