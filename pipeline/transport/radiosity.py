"""Reflectance where surfaces see each other: radiosity on patches, and two ways to invert it.

With B the radiosity (pi times the radiance) of diffuse patches, F their form factors, E0 the irradiance of the distant
light and rho the albedo (Goral et al. 1984),

    B = rho (E0 + F B),      irradiance E = E0 + F B.

*Gathered.* Where B is measured, the irradiance follows from it and rho = B / (E0 + F B) is exact in one step.

*Damped.* Equation 8 repeated, rho' = rho (L_r1 / L_r2)^w with L_r2 the radiance that the present rho predicts, needs no
measured bounce. Near the answer the error of the eigenmode mu of rho F is multiplied by 1 - w / (1 - mu), so w = 1
diverges as soon as mu > 1/2. F is reciprocal, hence all mu are real and within +-lambda, the spectral radius, and
1 / (1 - mu) within [1 / (1 + lambda), 1 / (1 - lambda)]. The exponents w are the reciprocal Chebyshev points of that
interval (Richardson's method; Young 1953), in Leja's order so that no prefix of them grows; the constant exponent
1 - lambda also converges but needs up to twice the steps.

Arrays: (N,) or (N, C) per patch, F (N, N) with ``F[i, j]`` the share of patch i's hemisphere that j fills.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEPS = 8  # of the damped iteration: one full set of Chebyshev points
TOLERANCE = 0.002  # largest relative change of a prediction that ends the iteration
MAX_ALBEDO = 0.98  # during the iteration: above it the prediction of a closed scene explodes
MIN_ALBEDO = 1e-3
POWER_STEPS = 60
MIN_MEASURED_SHARE = 0.99  # of the bounced light that must come from measured patches for the gathered form alone


@dataclass(frozen=True, eq=False)
class Estimate:
    """Albedo and irradiance (N, C) of every patch, how they were found, and the contraction (largest over channels)."""

    albedo: np.ndarray
    irradiance: np.ndarray
    method: str  # gathered or damped
    steps: int
    spectral_radius: float
    measured_share: float  # of the bounced light, from patches that the plate shows
    residual: float  # largest relative difference of predicted and measured radiance


def irradiance(albedo: np.ndarray, direct: np.ndarray, form_factors: np.ndarray) -> np.ndarray:
    """Irradiance (N, C) of patches with ``albedo`` (N, C) under ``direct`` (N, C): E = (1 - F rho)^-1 E0."""
    albedo, direct = np.broadcast_arrays(np.asarray(albedo, float), np.asarray(direct, float))
    identity = np.eye(len(direct))
    columns = [np.linalg.solve(identity - form_factors * albedo[:, c], direct[:, c]) for c in range(direct.shape[1])]
    return np.stack(columns, -1)


def spectral_radius(albedo: np.ndarray, form_factors: np.ndarray) -> float:
    """Largest absolute eigenvalue of ``rho F`` over the channels of ``albedo`` (N, C), by power iteration.

    The geometric mean of two successive growths is taken: it converges also where -lambda is an eigenvalue as well.
    """
    state = np.ones_like(albedo)
    growth = np.zeros((2, albedo.shape[1]))
    for _ in range(POWER_STEPS):
        following = albedo * (form_factors @ state)
        size = np.linalg.norm(following, axis=0)
        growth = np.stack([growth[1], size / np.linalg.norm(state, axis=0)])
        if not np.all(size > 0):
            break
        state = following / size
    return float(np.sqrt(growth[0] * growth[1]).max())


def gathered(radiosity: np.ndarray, direct: np.ndarray, form_factors: np.ndarray) -> np.ndarray:
    """Albedo (N, C) from measured radiosity (N, C) of *all* patches; NaN where no light arrives."""
    light = direct + form_factors @ radiosity
    return np.divide(radiosity, light, out=np.full(light.shape, np.nan), where=light > 0)


def exponents(radius: float) -> np.ndarray:
    """The ``STEPS`` exponents of the damped iteration for a spectral radius, in the order of their use."""
    points = np.cos(np.pi * (2 * np.arange(STEPS) + 1) / (2 * STEPS))
    order = [0]
    while len(order) < STEPS:
        left = [i for i in range(STEPS) if i not in order]
        spread = [np.log(np.abs(points[i] - points[order])).sum() for i in left]
        order.append(left[int(np.argmax(spread))])
    low, high = 1 / (1 + radius), 1 / (1 - radius)
    return 1 / ((low + high) / 2 + (high - low) / 2 * points[order])


def estimate(
    radiosity: np.ndarray, direct: np.ndarray, form_factors: np.ndarray, likeness: np.ndarray,
    given: np.ndarray | None = None, method: str | None = None,
) -> Estimate:  # fmt: skip
    """Albedo of all patches from the radiosity of those that the plate shows.

    Args:
        radiosity: (N, C) pi times the measured radiance; NaN for patches that are not seen.
        direct: (N, C) irradiance of the distant light, occlusion included.
        form_factors: (N, N).
        likeness: (N, N) weights by which an unseen patch takes its albedo from others; rows need no norm.
        given: (N, C) albedo that is known beforehand, NaN where it is not; it wins over the measurement.
        method: ``gathered`` or ``damped``; None takes the gathered form where nearly all bounced light is measured.

    An unseen patch without likeness to a seen one counts as black. The damped iteration keeps
    albedos in [MIN_ALBEDO, MAX_ALBEDO]; ``radiosity / irradiance`` of the result knows no limit.
    """
    given = np.full(radiosity.shape, np.nan) if given is None else given
    fixed = np.isfinite(given).all(-1)
    seen = np.isfinite(radiosity).all(-1) & ~fixed
    radiosity = np.where(seen[:, None], radiosity, np.nan)
    weight = np.where((seen & (direct.sum(-1) > 0))[None, :], likeness, 0.0)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-300)

    def complete(albedo: np.ndarray) -> np.ndarray:
        filled = np.where(seen[:, None], albedo, weight @ np.where(seen[:, None], albedo, 0.0))
        return np.clip(np.where(fixed[:, None], given, filled), 0.0, MAX_ALBEDO)

    albedo = complete(_start(radiosity, direct, form_factors, seen))
    bounced = albedo * irradiance(albedo, direct, form_factors)
    total = (form_factors @ bounced)[seen].sum()
    share = float((form_factors[:, seen] @ bounced[seen])[seen].sum() / total) if total > 0 else 1.0
    if (method or ("gathered" if share >= MIN_MEASURED_SHARE else "damped")) == "gathered":
        for _ in range(3):  # the unseen rest is the prediction of the last albedo
            predicted = albedo * irradiance(albedo, direct, form_factors)
            light = direct + form_factors @ np.where(seen[:, None], np.nan_to_num(radiosity), predicted)
            albedo = complete(_ratio(radiosity, light))
        measured = np.where(seen[:, None], _ratio(radiosity, light), albedo)
        return Estimate(
            measured, light, "gathered", 1, spectral_radius(albedo, form_factors), share,
            _residual(radiosity, albedo * irradiance(albedo, direct, form_factors), seen),
        )  # fmt: skip
    step, radius = 0, spectral_radius(albedo, form_factors)
    while True:
        light = irradiance(albedo, direct, form_factors)
        residual = _residual(radiosity, albedo * light, seen)
        if residual < TOLERANCE or step == STEPS:
            break
        radius = min(spectral_radius(albedo, form_factors), 0.95)
        moved = albedo * np.clip(_ratio(radiosity, albedo * light), 1e-3, 1e3) ** exponents(radius)[step]
        albedo = complete(np.clip(moved, MIN_ALBEDO, MAX_ALBEDO))
        step += 1
    return Estimate(albedo, light, "damped", step, radius, share, residual)


def _start(radiosity: np.ndarray, direct: np.ndarray, form_factors: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The pattern of the plate under the mean light: scale and shading are left to the iteration."""
    known = np.where(seen[:, None], np.nan_to_num(radiosity), 0.0)
    reach = form_factors[:, seen].sum(1, keepdims=True)
    gain = np.divide(form_factors.sum(1, keepdims=True), reach, out=np.ones_like(reach), where=reach > 0)
    light = direct + gain * (form_factors @ known)
    mean = light[seen].mean(0) if seen.any() else np.ones(direct.shape[1])
    return np.clip(known / np.where(mean > 0, mean, 1.0), MIN_ALBEDO, MAX_ALBEDO)


def _ratio(radiosity: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Equation 8 on patches; 1 where nothing is measured or no light arrives (an exponent then changes nothing)."""
    known = np.isfinite(radiosity) & (light > 0)
    return np.divide(radiosity, light, out=np.ones(light.shape), where=known)


def _residual(radiosity: np.ndarray, predicted: np.ndarray, seen: np.ndarray) -> float:
    difference = np.abs(_ratio(radiosity, predicted) - 1)[seen]
    return float(difference.max(initial=0.0))
