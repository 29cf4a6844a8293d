"""Formulas that subtract or divide, in float32 and float64 over a sweep: where single precision loses a hundredth.

Each sweep evaluates the formula as the pipeline writes it, its inputs rounded once to the precision asked for, against
a form that does not cancel. ``error(dtype, x)`` is relative unless said; the sweep goes towards the hard end.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import test_resection
from printed_board import looking_at

from pipeline.camera.resection import residuals_and_jacobian
from pipeline.probes import reflection

LOST = 0.01  # what counts as broken
Error = Callable[[type, float], float]
DRAWS = np.random.default_rng(0).uniform(0.5, 1.0, 200)


def worst(values: np.ndarray, truth: np.ndarray) -> float:
    """Largest relative error; infinite where a value is not finite."""
    with np.errstate(all="ignore"):
        error = np.abs(np.asarray(values, np.longdouble) / truth - 1)
    return float(np.max(np.where(np.isfinite(error), error, np.inf)))


def difference(dtype: type, change: float) -> float:
    """Equation 4: LS_obj - LS_noobj of two pictures, ``change`` apart relative to either."""
    noobj = DRAWS.astype(np.longdouble)
    obj = noobj * (1 + np.longdouble(change))
    return worst(obj.astype(dtype) - noobj.astype(dtype), noobj * np.longdouble(change))


def shade(dtype: type, left: float) -> float:
    """Equation 5 as layers: mul = 1 + lost / LS_noobj, of which a share ``left`` of the light is left."""
    noobj = DRAWS.astype(np.longdouble)
    lost = -noobj * (1 - np.longdouble(left))
    return worst(dtype(1) + lost.astype(dtype) / noobj.astype(dtype), np.full(len(DRAWS), np.longdouble(left)))


def quotient(dtype: type, level: float) -> float:
    """Equations 5 and 8: a quotient of two radiances of this level."""
    with np.errstate(all="ignore"):
        below = (DRAWS.astype(np.longdouble) * level).astype(dtype)
        return worst((below * dtype(0.3)) / below, np.full(len(DRAWS), np.longdouble(dtype(0.3))))


def signal(dtype: type, dn: float) -> float:
    """Merge: (DN - black) / (white - black) of a mean ``dn`` above a black level measured between two DN."""
    black = 512 + DRAWS.astype(np.longdouble)
    raw = black + np.longdouble(dn)
    found = (raw.astype(dtype) - black.astype(dtype)) / dtype(15288.0)
    return worst(found, np.full(len(DRAWS), np.longdouble(dn) / 15288))


def weight(dtype: type, electrons: float) -> float:
    """Merge: w = g^2 / (shot g y + floor), of five frames, summed."""
    shot, floor, y = 1 / 30000, 1e-8, electrons / 30000
    exposures = [4.0**-k for k in range(5)]

    def total(kind: type) -> np.ndarray:
        parts = [kind(g) ** 2 / (kind(shot) * kind(g) * kind(y) + kind(floor)) for g in exposures]
        return np.sum(np.array(parts, kind))[None]

    return worst(total(dtype), total(np.longdouble))


def gain(dtype: type, below: float) -> float:
    """Jacobian of the unwrap d cos(theta) / d cos(rho) at a sine of 1 - ``below``, the sine squared as stored."""
    square = (1 - np.longdouble(below)) ** 2
    with np.errstate(all="ignore"):
        found = reflection.solid_angle_gain(np.array([square], dtype), 0.125)
    return worst(found, reflection.solid_angle_gain(np.array([square], np.longdouble), 0.125))


def rim(dtype: type, below: float) -> float:
    """Deviation at a sine of 1 - ``below`` of the silhouette's: radians."""
    sine = np.array([1 - np.longdouble(below)])
    found = reflection.deviation(sine.astype(dtype), 0.125)
    return float(np.abs(found - reflection.deviation(sine, np.longdouble(0.125)))[0])


def pole(dtype: type, angle: float) -> float:
    """Polar angle by acos(y), which is not what is used, relative."""
    return worst(np.arccos(np.cos(np.array([angle], np.longdouble)).astype(dtype)), np.array([angle]))


def pole_kept(dtype: type, angle: float) -> float:
    """Polar angle by atan2(hypot(x, z), y), as used, relative."""
    side, up = (f(np.array([angle], np.longdouble)).astype(dtype) for f in (np.sin, np.cos))
    return worst(np.arctan2(side, up), np.array([angle]))


def texel(dtype: type, rows: float) -> float:
    """Solid angle of a texel at the pole, cos a - cos b, of a map of so many rows."""
    step = np.longdouble(np.pi) / np.longdouble(rows)
    return worst(np.array([dtype(1) - np.cos(dtype(step))]), np.array([2 * np.sin(step / 2) ** 2]))


def horizon(dtype: type, rows: float) -> float:
    """Irradiance: integral of sin^2 over a texel at the pole, theta / 2 - sin(2 theta) / 4."""
    theta = np.longdouble(np.pi) / np.longdouble(rows)
    series = theta**3 / 3 - theta**5 / 15 + 2 * theta**7 / 315
    found = dtype(theta) / dtype(2) - np.sin(dtype(2) * dtype(theta)) / dtype(4)
    return worst(np.array([found]), np.array([series]))


def sky_beside_sun(dtype: type, contrast: float) -> float:
    """Irradiance of the sky as that of all less that of a sun of one of 8192 texels so many times brighter."""
    texels = np.resize(DRAWS, 8192)
    sun = texels.copy()
    sun[77] = contrast
    total = np.add.reduce(sun.astype(dtype))
    return worst(np.array([total - dtype(contrast)]), np.array([texels.sum() - texels[77]]))


def deviations(dtype: type, distance: float, by_qr: bool) -> float:
    """Standard deviations of the pose of a board seen squarely from so many metres, J^T J inverted or by QR."""
    points = test_resection.BOARD
    pose = looking_at(test_resection.CENTRE, 0.5, 20, distance)
    px = np.zeros((len(points), 2))
    jacobian = residuals_and_jacobian(test_resection.CAMERA, pose, points, px)[1].reshape(-1, 6)
    size = np.linalg.norm(jacobian, axis=0)

    def found(scaled: np.ndarray, qr: bool) -> np.ndarray:
        if qr:
            half = np.linalg.inv(np.linalg.qr(scaled, mode="r"))
            return np.sqrt((half.astype(float) ** 2).sum(1))
        return np.sqrt(np.abs(np.diag(np.linalg.inv(scaled.T @ scaled))).astype(float))

    singular = np.linalg.svd(jacobian / size)
    truth = np.sqrt(((singular[2].T / singular[1]) ** 2).sum(1))
    return worst(found((jacobian / size).astype(dtype), by_qr), truth)


def limit(error: Error, sweep: np.ndarray) -> tuple[float, float, float | None]:
    """Worst error of float32 and of float64 over a sweep, and where float32 first loses `LOST`."""
    single = [error(np.float32, float(x)) for x in sweep]
    double = [error(np.float64, float(x)) for x in sweep]
    broken = [float(x) for x, e in zip(sweep, single) if e > LOST]
    return max(single), max(double), broken[0] if broken else None


SWEEPS: list[tuple[str, str, Error, np.ndarray, str, str]] = [
    (
        "(4) `LS_obj - LS_noobj`", "2 / f, f the relative change", difference, np.geomspace(1, 1e-9, 37), "f below",
        "the default estimates the change itself, as lost and gained light; only `reference` subtracts",
    ),
    (
        "(5) `1 + lost / LS_noobj`", "(1 - s) / s, s the light left", shade, np.geomspace(1, 1e-9, 37), "s below",
        "computed in float64, rounded once to the layer; a factor below zero is held at zero and flagged BOUNDED",
    ),
    (
        "(5), (8) quotients", "1; of noise LS_noobj / sigma", quotient, np.geomspace(1, 1e-45, 46), "radiance below",
        "float64; no quotient below 1e-4 of the median LS_noobj (NO_MODEL), none at all at zero (unknown)",
    ),
    (
        "merge, `DN - black`", "DN / (DN - black)", signal, np.geomspace(1000, 1e-5, 33), "DN above black below",
        "float32: off by 3e-5 DN, and read noise is 1 to 10 DN",
    ),
    (
        "merge weights", "1: sums of positive terms", weight, np.geomspace(1e6, 1e-6, 37), "electrons below",
        "float32; weights are bounded below by read noise",
    ),
    (
        "unwrap, `d cos(theta) / d cos(rho)`", "1 / (2 d), d = 1 - sine", gain, np.geomspace(0.5, 1e-9, 36), "d below",
        "the rim ends whole pixels inside the outline: d above 1e-3 up to a radius of 1000 px",
    ),
    (
        "rim, `2 asin(s) - asin(k s)` (rad)", "1 / sqrt(2 d)", rim, np.geomspace(0.5, 1e-9, 36), "d below",
        "float64 for fits; float32 in the map, where d ends likewise",
    ),
    (
        "pole, `acos(y)`", "1 / theta^2", pole, np.geomspace(1, 1e-9, 37), "theta below",
        "not used: see the next row",
    ),
    (
        "pole, `atan2(hypot(x, z), y)`", "1", pole_kept, np.geomspace(1, 1e-9, 37), "theta below", "as it stands",
    ),
    (
        "solid angle, `cos a - cos b`", "2 / theta^2 at the pole", texel, np.geomspace(8, 65536, 40), "rows above",
        "float64, rounded once; 65536 rows lose no more than the float64 column says",
    ),
    (
        "irradiance, `theta/2 - sin(2 theta)/4`", "3 / (2 theta^2) at the pole", horizon, np.geomspace(8, 65536, 40),
        "rows above", "float64",
    ),
    (
        "irradiance of the sky, all less the sun", "(sun + sky) / sky", sky_beside_sun, np.geomspace(1, 1e12, 37),
        "sun over sky above", "sets of texels, each summed alone; only shares of light groups subtract, in float64",
    ),
    (
        "covariance, `inv(J^T J)`", "cond(J)^2", lambda t, x: deviations(t, x, False), np.geomspace(0.3, 30, 21),
        "metres above", "poses: see the next row; bundle and marker map invert it scaled, in float64",
    ),
    (
        "covariance by QR", "cond(J)", lambda t, x: deviations(t, x, True), np.geomspace(0.3, 30, 21), "metres above",
        "float64; refused as collinear above cond(J^T J) = 1e13",
    ),
]  # fmt: skip


def rows() -> list[dict[str, str]]:
    """One row for each formula; see `extreme_cases.FORMULA_COLUMNS`."""
    found = []
    for formula, condition, error, sweep, towards, done in SWEEPS:
        single, double, broken = limit(error, sweep)
        over = f"{sweep[0]:.3g} to {sweep[-1]:.3g}"
        where = "nowhere" if broken is None else f"{towards} {broken:.2g}"
        found.append(
            {
                "formula": formula, "condition": condition, "sweep": over, "float32": f"{single:.1e}",
                "float64": f"{double:.1e}", "breaks": where, "done": done,
            }
        )  # fmt: skip
    return found
