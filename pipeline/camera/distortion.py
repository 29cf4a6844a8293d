"""How a lens bends rays: Brown's, the rational and the fisheye model, their derivatives, inverse and region.

With ``x = X/Z, y = Y/Z, s = x^2 + y^2, r = sqrt(s)`` all are ``x' = x g(s) + 2 p1 x y + p2 (s + 2 x^2)`` and
``y' = y g(s) + p1 (s + 2 y^2) + 2 p2 x y``. The count of coefficients, in OpenCV's order, tells the model:
    5  Brown (1971)                   k1 k2 p1 p2 k3           g = 1 + k1 s + k2 s^2 + k3 s^3
    8  rational (Claus, Fitzgibbon 2005, as OpenCV's)  k1 k2 p1 p2 k3 k4 k5 k6
                                      g = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
    4  fisheye (Kannala, Brandt 2006) k1 k2 k3 k4, t = atan(r): g = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r
A fisheye has no tangential terms here, and images less than 90 degrees from its axis: its rays are still X/Z, Y/Z.
The inverse is Newton's, to rounding. Beyond the radius where ``r g`` stops growing, or has a pole, the model is not
one-to-one: the region ends there, and positions outside it are refused and counted.
"""

from __future__ import annotations

import functools

import numpy as np

from pipeline.run.errors import NumericalError

TERMS: dict[int, tuple[str, ...]] = {
    5: ("k1", "k2", "p1", "p2", "k3"),
    8: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    4: ("k1", "k2", "k3", "k4"),
}
MODELS = {5: "brown", 8: "rational", 4: "fisheye"}
NEWTON_STEPS = 30
WIDEST_RAD = np.radians(88.0)  # of a fisheye's rays from its axis: beyond it X/Z exceeds 29 and a pixel spans too much
NEAR_AXIS = 1e-6  # squared radius below which a fisheye is its series: 1 - s/3 + s^2/5 to 1e-19


def model_of(distortion: np.ndarray) -> str:
    """Name of the model that these coefficients belong to. Raises NumericalError for another count."""
    try:
        return MODELS[len(distortion)]
    except KeyError:
        counts = ", ".join(f"{n} ({name})" for n, name in MODELS.items())
        raise NumericalError(f"lens: {len(distortion)} coefficients of distortion, needed one of {counts}") from None


def is_pinhole(distortion: np.ndarray) -> bool:
    """Whether rays are not bent at all; a fisheye always bends them."""
    return len(distortion) != 4 and not np.any(distortion)


def fold_radius_squared(distortion: np.ndarray) -> float:
    """Smallest squared radius of undistorted coordinates where the radial curve stops growing; inf if never."""
    return _fold(tuple(float(k) for k in distortion))


@functools.lru_cache(maxsize=64)
def _fold(k: tuple[float, ...]) -> float:
    if not np.isfinite(k).all():
        return 0.0  # a step of an adjustment that ran away: it images nothing
    if len(k) == 4:
        angle = np.sqrt(_first_root([9 * k[3], 7 * k[2], 5 * k[1], 3 * k[0], 1.0]))
        return float(np.tan(min(angle, WIDEST_RAD)) ** 2)
    if len(k) == 5:
        return _first_root([7 * k[4], 5 * k[1], 3 * k[0], 1.0])
    above, below = np.array([k[4], k[1], k[0], 1.0]), np.array([k[7], k[6], k[5], 1.0])
    power = np.array([3.0, 2.0, 1.0])  # of the derivatives, the constants left out
    growth = np.convolve(power * above[:3], below) - np.convolve(above, power * below[:3])
    turn = np.convolve(above, below) + np.append(2 * growth, 0.0)
    return min(_first_root(turn), _first_root(below))


def _first_root(coefficients: object) -> float:
    """Smallest positive root of a polynomial; inf without one."""
    roots = np.roots(np.asarray(coefficients, float))
    real = roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))].real
    return float(min(real[real > 0], default=np.inf))


def _radial(distortion: np.ndarray, s: np.ndarray) -> np.ndarray:
    """``g`` at squared radii s (...)."""
    if len(distortion) == 4:
        near = s < NEAR_AXIS
        t = np.arctan(np.sqrt(np.where(near, 0.0, s)))
        over = np.where(near, 1 - s * (1 / 3 - s / 5), t / np.sqrt(np.where(near, 1.0, s)))
        t2 = np.where(near, s * (1 - 2 / 3 * s), t * t)
        k1, k2, k3, k4 = distortion
        return np.asarray(over * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))
    k1, k2, _, _, k3 = distortion[:5]
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    if len(distortion) == 8:
        k4, k5, k6 = distortion[5:]
        radial = radial / (1 + s * (k4 + s * (k5 + s * k6)))
    return np.asarray(radial)


def _slope(distortion: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Twice the derivative of ``g`` by s, so that dg/dx = x * slope."""
    if len(distortion) == 4:
        near = s < NEAR_AXIS
        safe = np.where(near, 1.0, s)
        r = np.sqrt(safe)
        t = np.arctan(r)
        k1, k2, k3, k4 = distortion
        t2 = t * t
        bent = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        growth = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        far = (growth / (1 + safe) - bent / r) / safe  # (d(r g)/dr - g) / r^2
        return np.asarray(np.where(near, 2 * (k1 - 1 / 3) + s * (4 / 5 - 4 * k1 + 4 * k2), far))
    k1, k2, _, _, k3 = distortion[:5]
    slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
    if len(distortion) == 8:
        k4, k5, k6 = distortion[5:]
        below = 1 + s * (k4 + s * (k5 + s * k6))
        falls = 2 * (k4 + s * (2 * k5 + s * 3 * k6))
        slope = (slope - (1 + s * (k1 + s * (k2 + s * k3))) / below * falls) / below
    return np.asarray(slope)


def _tangential(distortion: np.ndarray) -> tuple[float, float]:
    return (0.0, 0.0) if len(distortion) == 4 else (distortion[2], distortion[3])


def distort(distortion: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Distorted normalised coordinates (..., 2) of undistorted ones (..., 2)."""
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    return np.stack(_bent(distortion, x, y, s, _radial(distortion, s)), -1)


def distortion_jacobian(distortion: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Derivative (..., 2, 2) of `distort` by the undistorted coordinates."""
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    jacobian = np.empty((*xy.shape, 2))
    across, cross, down = _growth(distortion, x, y, s, _radial(distortion, s))
    jacobian[..., 0, 0], jacobian[..., 1, 1] = across, down
    jacobian[..., 0, 1] = jacobian[..., 1, 0] = cross
    return jacobian


def _bent(
    distortion: np.ndarray, x: np.ndarray, y: np.ndarray, s: np.ndarray, radial: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distorted x, y of undistorted ones, of any one shape as all arguments; ``radial`` is ``g`` at ``s``."""
    p1, p2 = _tangential(distortion)
    cross = 2 * x * y
    return x * radial + p1 * cross + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + p2 * cross


def _growth(
    distortion: np.ndarray, x: np.ndarray, y: np.ndarray, s: np.ndarray, radial: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of `_bent`: x' by x; x' by y, which is y' by x; y' by y."""
    p1, p2 = _tangential(distortion)
    slope = _slope(distortion, s)
    cross = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, cross, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x


def coefficient_jacobian(distortion: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Derivative (N, 2, C) of `distort` by its C coefficients, in their order, at undistorted coordinates (N, 2)."""
    x, y = xy[:, 0], xy[:, 1]
    s = x * x + y * y
    found = np.empty((len(xy), 2, len(distortion)))
    if len(distortion) == 4:
        t2 = np.arctan(np.sqrt(s)) ** 2
        straight = _radial(np.zeros(4), s)  # t / r
        for column in range(4):
            found[:, :, column] = xy * (straight * t2 ** (column + 1))[:, None]
        return found
    for column, power in ((0, 1), (1, 2), (4, 3)):
        found[:, :, column] = xy * (s**power)[:, None]
    if len(distortion) == 8:
        below = 1 + s * (distortion[5] + s * (distortion[6] + s * distortion[7]))
        radial = _radial(distortion, s)
        for power in (1, 2, 3):
            found[:, :, 4 + power] = -xy * (radial * s**power / below)[:, None]
        found[:, :, [0, 1, 4]] /= below[:, None, None]
    found[:, :, 2] = np.stack([2 * x * y, s + 2 * y * y], -1)
    found[:, :, 3] = np.stack([s + 2 * x * x, 2 * x * y], -1)
    return found


def undistort(distortion: np.ndarray, distorted: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates (N, 2) of distorted ones (N, 2).

    Raises NumericalError, with their count, when some lie outside what the lens can image.
    """
    distorted = np.asarray(distorted, float)
    if is_pinhole(distortion):
        return distorted.copy()
    xy, inside = undistorted(distortion, distorted)
    if not inside.all():
        first = distorted[np.argmin(inside)]
        raise NumericalError(
            f"lens: {int((~inside).sum())} of {inside.size} positions (first at {first[0]:.4f}, {first[1]:.4f} / Z) "
            "are beyond the distortion model, needed all inside; calibrate with the board near the corners"
        )
    return xy


def undistorted(distortion: np.ndarray, distorted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`undistort` (N, 2) without refusing, and which positions (N,) are inside; the others hold no ray."""
    if len(distortion) == 4:
        return _straight_fisheye(distortion, np.asarray(distorted, float))
    there = np.array(np.moveaxis(np.asarray(distorted, float), -1, 0), order="C")
    x, y = there.copy()
    for _ in range(NEWTON_STEPS):
        s = x * x + y * y
        radial = _radial(distortion, s)
        across, cross, down = _growth(distortion, x, y, s, radial)
        left = np.array(_bent(distortion, x, y, s, radial)) - there
        determinant = across * down - cross * cross
        determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)  # a step near the fold is judged below
        step = np.array([down * left[0] - cross * left[1], across * left[1] - cross * left[0]]) / determinant
        length = np.sqrt(step[0] * step[0] + step[1] * step[1])
        if (length > 0.5).any():
            step *= np.minimum(1.0, 0.5 / np.maximum(length, 0.5))
        x, y = x - step[0], y - step[1]
        if length.max(initial=0.0) < 1e-9:  # quadratic: the step just taken left less than 1e-17
            break
    xy = np.stack([x, y], -1)
    error = np.abs(distort(distortion, xy) - distorted).max(-1)
    return xy, (error < 1e-10) & ((xy**2).sum(-1) < fold_radius_squared(distortion))


def _straight_fisheye(distortion: np.ndarray, distorted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same for a fisheye: Newton's method on the angle alone, where the curve is nearly straight."""
    k1, k2, k3, k4 = distortion
    radius = np.hypot(distorted[..., 0], distorted[..., 1])
    widest = np.arctan(np.sqrt(fold_radius_squared(distortion)))
    t = np.minimum(radius, widest)
    for _ in range(NEWTON_STEPS):
        t2 = t * t
        error = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - radius
        growth = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        step = error / np.maximum(growth, 1e-6)
        t = np.clip(t - step, 0.0, widest)
        if np.abs(step).max(initial=0.0) < 1e-10:
            break
    t2 = t * t
    error = np.abs(t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - radius)
    scale = np.where(radius > 1e-12, np.tan(t) / np.maximum(radius, 1e-12), 1.0)
    return distorted * scale[..., None], (error < 1e-10) & (t < widest)
