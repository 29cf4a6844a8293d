"""Albedo outside [0, 1]: probe and plate disagree about the light; by what factor, and what probably did it.

Nothing diffuse reflects more than it gets, so an albedo above 1 says that the probe's light is too dark against the
plate, or that the plate holds light that is not diffuse reflection. The causes leave different traces; the one that
fits first is named. The factor is that on the map (or one over that on the plate) that brings 99 % of the texels to 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import direction_from_latlong, latlong_solid_angles

SIGMAS = 3.0  # by which a texel has to leave [0, 1] to count
TOLERATED = 0.01  # share of the texels
QUANTILE = 0.99
UNKNOWN = 0.5  # relative uncertainty of a texel from which on its light is not known
UNSURE = 0.02  # share of the irradiance from texels whose light is only a lower bound
PATCHY = 0.1  # share of the texels above 1 up to which it is a highlight, not the scale
MOSTLY = 0.5  # of the texels below 0: what explains so many is named
DARK = 0.02  # 99 % quantile below which nothing real is as dark in all channels


@dataclass(frozen=True)
class Disagreement:
    """Shares of texels outside [0, 1] beyond their noise, the curing factor on the map, and the likely cause.

    ``cause`` is "" without disagreement, ``factor`` is 1 then. The excess's colour says nothing: it may be paint's.
    """

    above: float
    below: float
    factor: float
    cause: str


def unsure_share(environment: np.ndarray, variance: np.ndarray | None, normal: np.ndarray, light: np.ndarray) -> float:
    """Share of the irradiance on a plane that comes from texels (H, W, 3) known to 50 % at best: clipped, or filled.

    ``variance`` (H, W, 3) is the map's, None counts as all known; ``light`` (3,): the irradiance.
    """
    if variance is None:
        return 0.0
    grey = environment.sum(-1)
    rows, columns = np.nonzero(~(variance.sum(-1) < (UNKNOWN * grey) ** 2))
    height, width = grey.shape
    direction = direction_from_latlong((columns + 0.5) / width, (rows + 0.5) / height)
    power = grey[rows, columns] * latlong_solid_angles(height, width)[rows, columns]
    return float((power * np.maximum(direction @ normal, 0)).sum() / light.sum())


def disagreement(
    albedo: np.ndarray, sigma: np.ndarray, unsure: float, matt: np.ndarray | None = None
) -> Disagreement:  # fmt: skip
    """What albedo (N, 3) with noise ``sigma`` (N, 3) says about the scale; ``unsure`` is that of `unsure_share`.

    ``matt`` (N, 3): what it would be had no gloss been taken off the plate's radiance; None where none was.
    """
    above = float((albedo > 1 + SIGMAS * sigma).any(-1).mean())
    negative = (albedo < -SIGMAS * sigma).any(-1)
    below = float(negative.mean())
    high = np.quantile(albedo, QUANTILE, axis=0).max()
    if above > TOLERATED:
        if unsure > UNSURE:
            cause = (
                f"{unsure:.0%} of the map's light is clipped or was not seen: a lamp's light is missing from the map"
            )
        elif above < PATCHY and np.median(albedo) < 0.6:
            cause = "only a part of the plane exceeds it: a highlight, or a lamp so near that the ball saw it elsewhere"
        else:
            cause = (
                "the whole plane exceeds it: exposure between plate and ball, or the ball's reflectance set too high"
            )
        return Disagreement(above, below, float(high), cause)
    if below > TOLERATED and matt is not None and (matt[negative] > 0).all(-1).mean() > MOSTLY:
        cause = (
            "the ground's mirror image was taken off where none is: something matt lies on the glossy ground, as a "
            "board does, or the lobe is not quite the ground's"
        )
        return Disagreement(above, below, 1.0, cause)
    if below > TOLERATED:
        return Disagreement(above, below, 1.0, "black level of the plate, or veiling glare taken off twice")
    if 0 < high < DARK:
        cause = "nothing is so dark: exposure between plate and ball, or the ball's reflectance set too low"
        return Disagreement(above, below, float(high), cause)
    return Disagreement(above, below, 1.0, "")


def warning(found: Disagreement, lowest: np.ndarray) -> str | None:
    """One line about a disagreement; None without one. ``lowest`` (3,): 1 % quantile of the albedo."""
    if not found.cause:
        return None
    if found.above > TOLERATED:
        said = f"{found.above:.1%} of the seen texels exceed 1 beyond their noise, needed <= {TOLERATED:.0%}"
    elif found.below > TOLERATED:
        dark = ", ".join(f"{value:.3f}" for value in lowest)
        return (
            f"albedo: {found.below:.1%} of the seen texels lie below 0 beyond their noise (1 % quantile {dark}), "
            f"needed <= {TOLERATED:.0%}; likely {found.cause}"
        )
    else:
        said = f"99 % of the seen texels lie below {found.factor:.4f}"
    return f"albedo: {said}; likely {found.cause}; a map {found.factor:.3g} times as bright would cure it"
