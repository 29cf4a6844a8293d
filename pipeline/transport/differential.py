"""Differential rendering: how the modelled change enters the photograph (Debevec 1998; equations 3 to 5).

    (3)  Error    = LS_noobj - LS_b
    (4)  LS_final = LS_obj - Error = LS_b + (LS_obj - LS_noobj)      additive; may turn negative
    (5)  LS_final = LS_b * LS_obj / LS_noobj                         ratio; undefined as LS_noobj -> 0

Every form is returned as the layers ``plate * mul + add + obj``. With D = LS_obj - LS_noobj
estimated directly and N the *expected* LS_noobj (closed form on a plane), the ratio is 1 + D / N: linear in the noise,
so unbiased, which a quotient of two noisy renders is not. All arrays are float, (H, W, 3) or (H, W), and carry
coverage: a pixel half covered by an object has ``alpha`` 0.5 and D, N of its uncovered half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NEGATIVE = 1  # the result is below zero although the plate was not
CLIPPED_PLATE = 2  # the light changes on a clipped plate: the true value is unknowable
GAIN_LIMITED = 4  # added light was scaled by plate over model, bounded
NO_MODEL = 8  # LS_noobj too small for a ratio: additive instead
BOUNDED = 16  # the ratio would have been negative: held at zero

GAIN_RANGE = (0.5, 2.0)
FAINT_MODEL = 1e-4  # of the median LS_noobj: below this a ratio is not formed


@dataclass(frozen=True, eq=False)
class Change:
    """What the render says of the local scene, per pixel; see `pipeline.transport.trace.Samples`."""

    obj: np.ndarray  # (H, W, 3) premultiplied object layer
    alpha: np.ndarray  # (H, W) coverage by objects
    lost: np.ndarray  # (H, W, 3) light that the objects take from the uncovered part, <= 0
    gained: np.ndarray  # (H, W, 3) light that they add to it
    without: np.ndarray  # (H, W, 3) expected LS_noobj of the uncovered part
    ground: np.ndarray  # (H, W) share of the pixel that shows the modelled local scene

    @property
    def difference(self) -> np.ndarray:
        """LS_obj - LS_noobj of the uncovered part (H, W, 3)."""
        return self.lost + self.gained


@dataclass(frozen=True, eq=False)
class Layers:
    """``plate * mul + add + obj`` is the result; ``guards`` (H, W) uint32 says which guard fired where."""

    mul: np.ndarray
    add: np.ndarray
    obj: np.ndarray
    guards: np.ndarray

    def apply(self, plate: np.ndarray) -> np.ndarray:
        """The composite (H, W, 3) float32; pixels that no layer touches keep the plate's own bits."""
        touched = (self.mul != 1).any(-1) | (self.add != 0).any(-1) | (self.obj != 0).any(-1)
        return np.where(touched[..., None], plate * self.mul + self.add + self.obj, plate)


def additive(change: Change) -> Layers:
    """Equation 4."""
    mul = np.repeat((1 - change.alpha)[..., None], 3, -1)
    return _layers(mul, change.difference, change, np.zeros(change.alpha.shape, np.uint32))


def ratio(change: Change) -> Layers:
    """Equation 5, additive where LS_noobj is too small for it (flag NO_MODEL)."""
    relative, usable = relative_to_model(change, change.difference)
    mul = (1 - change.alpha)[..., None] + np.where(usable, relative, 0.0)
    guards = NO_MODEL * (~usable & (change.difference != 0)).any(-1)
    guards = guards + BOUNDED * (mul < 0).any(-1)
    return _layers(np.maximum(mul, 0), np.where(usable, 0.0, change.difference), change, guards)


def chosen(change: Change, plate: np.ndarray) -> Layers:
    """The default: lost light as a ratio, gained light additively with a bounded gain of plate over model.

    ``LS_b * V + I * bounded gain``: a shadow is a share of the light that was there, so its ratio is right whatever the
    albedo; added light is right up to the albedo's error, which the plate tells, and bounding that gain keeps it finite
    where the model fails.
    """
    relative, usable = relative_to_model(change, change.lost)
    share = change.ground[..., None]
    model = np.divide(change.without, share, out=np.zeros(plate.shape), where=share > 0)
    gain = np.divide(plate, model, out=np.ones(plate.shape), where=usable & (model > 0))
    bounded = np.clip(gain, *GAIN_RANGE)
    mul = (1 - change.alpha)[..., None] + np.where(usable, relative, 0.0)
    add = change.gained * bounded + np.where(usable, 0.0, change.lost)
    guards = NO_MODEL * (~usable & (change.difference != 0)).any(-1)
    guards = guards + GAIN_LIMITED * ((bounded != gain) & (change.gained != 0)).any(-1)
    guards = guards + BOUNDED * (mul < 0).any(-1)
    return _layers(np.maximum(mul, 0), add, change, guards)


def relative_to_model(change: Change, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``part`` / LS_noobj (H, W, 3) times the uncovered share, and where LS_noobj is large enough to form it."""
    share = change.ground[..., None]
    lit = change.without[change.ground > 0.5]
    floor = FAINT_MODEL * float(np.median(lit)) if lit.size else 0.0
    usable = (change.without > floor * share) & (share > 0)
    relative = np.divide(part, change.without, out=np.zeros(part.shape), where=usable)
    return relative * share, usable


def _layers(mul: np.ndarray, add: np.ndarray, change: Change, guards: np.ndarray) -> Layers:
    mul, add, obj = (np.asarray(values, np.float32) for values in (mul, add, change.obj))
    return Layers(mul, add, obj, np.asarray(guards, np.uint32))
