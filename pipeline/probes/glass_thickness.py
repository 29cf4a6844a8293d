"""Whether a ball is of glass, silvered inside, and how thick: by where the plane that it mirrors is seen.

Glass turns what is mirrored away from the camera, by an angle that grows with the incidence (`pipeline.probes.glass`):
the plane's mirror image lies farther inside than a front mirror would have it. `plane_image` compares the two pictures
of the plane; here the thickness is one more unknown beside the centre, which the rim and the plane's height hold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.probes import plane_image
from pipeline.probes.ball_pairs import Sight, neighbourhood
from pipeline.probes.glass import MOST, Glass
from pipeline.probes.plane_image import (
    BLUR_SIGMA,
    COMMON_BLURS,
    INSET_BLURS,
    MOST_INSET,
    MOST_STEP_PX,
    RAYS_BLUR,
    SMOOTH_PX,
)
from pipeline.probes.sphere_fit import SphereFit
from pipeline.run.evidence import TRIED
from pipeline.types import Camera, Raster, View

TYPICAL = 0.03  # of the radius: blown gazing balls have 1 to 3 mm of 50 to 150
PER_PX = 2.5  # thickness, of the radius and over its pixels, that moves the plane's image by about a pixel
SIGNIFICANT = 4.0
LEAST = 0.004  # of the radius: directions are off by less than a quarter of a degree
STATED_SIGMA, DISAGREE = 0.1, 3.0  # relative, of a stated thickness: glass is blown
MOST_LEFT_PX = 0.6
# Relative: ray-traced shells of 1.5, 3 and 6 % seen in two views were off by 1.5 of what is stated without it, by 1.2
# with it; 8 metal balls, ray-traced and captured, by 1.0.
METHOD_REL = 0.05


@dataclass(frozen=True)
class _Guess:
    """Centre (3,) [m], thickness and blur [px^2] so far, with the rim's blur and the border that is left out [px]."""

    centre: np.ndarray
    thick: float
    blurred: float
    start: float
    inset: int


def thickness(
    photograph: Raster, camera: Camera, view: View, fit: SphereFit, radius: float
) -> tuple[float, float, float] | None:
    """Thickness of the glass, of the radius, its standard uncertainty, and what it leaves unexplained [px].

    ``fit`` is the rim's, with the plane's height, before the mirrored plane has moved it. None where too little of the
    plane is mirrored. Of a front mirror zero within the uncertainty, and as often below zero as above.
    """
    return _searched(photograph, camera, view, fit, radius, fit.centre, SMOOTH_PX)


def glimpse(
    photograph: Raster, camera: Camera, view: View, fit: SphereFit, radius: float, centre: np.ndarray
) -> tuple[float, float, float] | None:
    """`thickness` by the one step from a front mirror whose plane and image agree already, at ``centre`` (3,) [m].

    Such a step is Rao's (1948) score test of glass: a tenth of the work, and good near zero.
    """
    return _searched(photograph, camera, view, fit, radius, centre, SMOOTH_PX[-1:])


def worth_measuring(glimpses: dict[str, tuple[float, float, float]]) -> bool:
    """Whether `glimpse` of all views reaches half of what makes glass significant, or leaves too much unexplained.

    Glass that is just significant is passed over once in 44 times: it is seen two of its four sigma too thin.
    """
    if any(left > MOST_LEFT_PX for _, _, left in glimpses.values()):
        return True
    thick, sigma = _joined(glimpses)
    return thick > 0.5 * max(SIGNIFICANT * sigma, LEAST)


def _searched(
    photograph: Raster, camera: Camera, view: View, fit: SphereFit, radius: float, centre: np.ndarray,
    smooths: tuple[float, ...],
) -> tuple[float, float, float] | None:  # fmt: skip
    """`thickness` from a first ``centre`` by rounds that compare pictures smoothed by these [px]."""
    guess, found = _Guess(centre, 0.0, np.nan, 0.0, 0), None
    for smooth in smooths:
        sight = neighbourhood(photograph, camera, view.world_from_camera, guess.centre, radius, Glass(guess.thick))
        if found is None:
            start = max((fit.blur_px / sight.binned) ** 2 - RAYS_BLUR, 0.0)
            most = MOST_INSET * plane_image.size_px(sight)
            inset = int(min(np.ceil(INSET_BLURS * np.sqrt(start)), np.ceil(most)))
            guess = replace(guess, blurred=start, start=start, inset=inset)
        found = _round(sight, view, fit, guess, smooth)
        if found is None:
            return None
        guess, sigma, left = found
    sigma = float(np.hypot(sigma, PER_PX / plane_image.size_px(sight) * COMMON_BLURS * fit.blur_px / sight.binned))
    return guess.thick, float(np.hypot(sigma, METHOD_REL * guess.thick)), left * sight.binned


def _round(
    sight: Sight, view: View, fit: SphereFit, guess: _Guess, smooth: float
) -> tuple[_Guess, float, float] | None:  # fmt: skip
    """The next guess, standard uncertainty of its thickness, and what is left [px of the sight]."""
    radius, size = sight.radius, plane_image.size_px(sight)
    pixel, unit = radius / size, PER_PX / size
    equations = plane_image.equations_of(sight, smooth, guess.blurred, guess.inset, pixel, True)
    if equations is None:
        return None
    equations.by_centre[:, 4] *= unit
    blur_sigma = 0.5 * BLUR_SIGMA * (guess.start + RAYS_BLUR)
    held = np.zeros((5, 5))
    held[:3, :3], held[3, 3] = np.linalg.inv(fit.covariance / pixel**2), blur_sigma**-2
    back = 0.5 * (guess.start - guess.blurred) / blur_sigma**2
    pull = np.append(held[:3, :3] @ ((fit.centre - guess.centre) / pixel), [back, 0])
    found = plane_image.solve(equations, view.covariance, held, pull)
    if found is None:
        return None
    step, covariance, left, _ = found
    way = min(1.0, MOST_STEP_PX / max(float(np.linalg.norm(step[:3])), 1e-12))
    changed = replace(
        guess, centre=guess.centre + pixel * step[:3] * way, blurred=float(max(guess.blurred + 2 * step[3], 0.0)),
        thick=float(np.clip(guess.thick + unit * np.clip(step[4], -2, 2), -0.1, MOST)),
    )  # fmt: skip
    return changed, unit * float(np.sqrt(covariance[4, 4])), left


@dataclass(frozen=True)
class GlassEvidence:
    """The glass that is modelled, if any; rms [rad] of directions its uncertainty makes; what was said about it."""

    glass: Glass | None
    direction_sigma_rad: float
    numbers: dict[str, Any]
    warnings: list[str]
    evidence: list[dict[str, Any]]


def judge(
    stated: Glass | None, measured: dict[str, tuple[float, float, float]], untested: str, metal: str | None = None
) -> GlassEvidence:  # fmt: skip
    """Glass that is stated, or that the mirrored plane of all views asks for; else what leaving it out could cost.

    ``measured``: `thickness` by view, those that have one; ``untested``: why there is none. A stated thickness, or
    ``metal``, is kept and warned about when the measured one contradicts it.
    """
    usable = {name: one for name, one in measured.items() if one[2] <= MOST_LEFT_PX}
    thick, sigma = _joined(usable)
    numbers: dict[str, Any] = {
        "views": {n: dict(zip(("thickness", "sigma", "left_px"), one, strict=True)) for n, one in measured.items()},
        "measured": None if not usable else [thick, sigma],
    }  # fmt: skip
    said = f"the mirrored plane measures {thick:.2%} +- {sigma:.2%} of the radius" if usable else untested
    warnings = []
    glass, error = stated, STATED_SIGMA * (0.0 if stated is None else stated.thickness)
    if stated is not None and usable and abs(thick - stated.thickness) > DISAGREE * np.hypot(sigma, error):
        warnings.append(f"probe.glass_mm: is {stated.thickness:.1%} of the radius, but {said}; the stated is kept")
        error = abs(thick - stated.thickness)
    significant = stated is None and bool(usable) and thick > max(SIGNIFICANT * sigma, LEAST)
    if significant and metal is not None:
        warnings.append(
            f"probe.material: is {metal}, but {said} of glass before the mirror; taken as metal; leave it out if the "
            "ball is of glass, silvered inside"
        )
    elif significant:
        glass, error = Glass(thick), sigma
        warnings.append(
            f"the ball is taken to be of glass, silvered inside: {said}; state probe.glass_mm, or probe.material if it "
            "is metal"
        )
    if any(one[0] >= MOST for one in usable.values()):
        warnings.append(
            f"glass before the ball's mirror measures {MOST:.0%} of the radius, the most that is searched: that is no "
            "measure of it; state probe.glass_mm, or probe.material if it is metal"
        )
    at_most = min(max(thick, 0) + 2 * sigma, MOST) if usable else TYPICAL
    rms, rim = np.degrees(Glass(at_most).displacement())
    cost = f"directions off by {rms:.2f} degrees rms, {rim:.1f} at the rim, for {at_most:.1%} of glass"
    shown = Glass(at_most) if glass is None else glass
    numbers["displacement_at_most_deg" if glass is None else "displacement_deg"] = {
        **{name: float(np.degrees(way)) for name, way in zip(("rms", "rim"), shown.displacement(), strict=True)},
        "thickness": shown.thickness,
    }
    unsure = 0.0 if glass is None else direction_sigma(glass, error)
    row = {
        "term": "glass before the ball's mirror", "modelled": glass is not None, "because": said, "could_cost": cost,
        "bound_deg": float(rms), **(TRIED if usable else {}),
    }  # fmt: skip
    return GlassEvidence(glass, unsure, {"glass": numbers}, warnings, [row])


def direction_sigma(glass: Glass, error: float) -> float:
    """Rms [rad] by which directions are off for an ``error`` of the thickness, the worse way; none is above `MOST`."""
    ways = [
        Glass(float(np.clip(glass.thickness + side, 0, MOST))).displacement()[0] - glass.displacement()[0]
        for side in (error, -error)
    ]
    return max(abs(way) for way in ways)


def _joined(measured: dict[str, tuple[float, float, float]]) -> tuple[float, float]:
    """Mean by inverse variance, and its standard uncertainty, no less than the views' disagreement (Birge's ratio)."""
    if not measured:
        return 0.0, np.inf
    values = np.array(list(measured.values()))
    weight = values[:, 1] ** -2
    mean = float(weight @ values[:, 0] / weight.sum())
    chi2 = float(weight @ (values[:, 0] - mean) ** 2) / max(len(values) - 1, 1)
    return mean, float(weight.sum() ** -0.5 * np.sqrt(max(chi2, 1.0)))
