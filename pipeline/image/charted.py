"""From a photographed 24-patch chart to how its camera's photographs are developed: neutral, and on request matrix."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.conventions import CAMERA_RGB
from pipeline.image import balance, chart, colour
from pipeline.image.chart_finder import find
from pipeline.image.demosaic import balanced_rgb
from pipeline.run.errors import CaptureError
from pipeline.types import Raster

FAR_OFF = 5.0  # mean delta E that is warned of
NAMES = (
    "dark skin", "light skin", "blue sky", "foliage", "blue flower", "bluish green", "orange", "purplish blue",
    "moderate red", "purple", "yellow green", "orange yellow", "blue", "green", "red", "yellow", "magenta", "cyan",
    "white", "neutral 8", "neutral 6.5", "neutral 5", "neutral 3.5", "black",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Charted:
    """What the chart says: the camera's neutral (3,), green 1, and (3, 3) to ACEScg where that was asked for."""

    neutral: np.ndarray
    matrix: np.ndarray | None
    numbers: dict[str, Any]
    evidence: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def read_chart(facts: dict[str, Any], view: str, merged: Raster, profile: dict[str, Any]) -> Charted:
    """Read the chart that a merged view shows.

    ``facts``: [chart] of capture.toml. ``profile``: what merge says of the view's camera. Raises CaptureError when the
    chart is not found, or its patches cannot be used.
    """
    guess = profile["as_shot_neutral"]
    guess = np.ones(3) if guess is None else guess / guess[1]
    seen, variance, mask = balanced_rgb(merged, guess, "bilinear")
    picture = Raster({**Raster.split(seen), **Raster.split(variance, "variance"), "mask": mask}, merged.space)
    corners = facts.get("corners_px")
    outline = find(picture) if corners is None else np.array(corners, float)
    if outline is None:
        raise CaptureError(
            f"{view}: no 24-patch chart was found, needed one that is sharp, near and unclipped; say where it is: "
            "[chart] corners_px = [...] beside dark skin, bluish green, black, white"
        )
    patches = chart.measure(picture, outline)
    agreement = balance.chart_agreement(balance.cells_of(picture, outline, "chart", 1))
    if not agreement >= balance.CHART_AGREES:
        raise CaptureError(
            f"{view}: the chart's patches follow its brightnesses with correlation {agreement:.2f}, needed "
            f"{balance.CHART_AGREES}; give [chart] corners_px beside dark skin, bluish green, black, white, in order"
        )
    return _read(facts, view, patches, outline, guess, profile)


def _read(
    facts: dict[str, Any], view: str, patches: chart.Patches, outline: np.ndarray, guess: np.ndarray,
    profile: dict[str, Any],
) -> Charted:  # fmt: skip
    edition = facts.get("edition", "after_2014")
    tint = chart.neutral(patches, chart.reference(edition))
    if tint is None:
        raise CaptureError(f"{view}: fewer than two of the chart's light greys can be used; they clip or are shaded")
    kelvin = _kelvin(profile, tint * guess)
    known = chart.reference(edition, kelvin)
    neutral = chart.neutral(patches, known) * guess
    neutral = neutral / neutral[1]
    fitted = chart.fit(patches, known)
    by_file = _of_file(profile, neutral)
    kept = None if by_file is None else chart.fit(patches, known, by_file * guess)
    if fitted is None:
        raise CaptureError(
            f"{view}: {int(np.isfinite(patches.mean).all(-1).sum())} patches of the chart can be used, needed "
            f"{chart.FEWEST_PATCHES} evenly lit ones; is it clipped, in the shade of something, or tiny?"
        )
    wanted = facts.get("fit") == "matrix"
    used = fitted if wanted or kept is None else kept
    white = used.neutral * guess
    numbers = {"view": view, "corners_px": outline.round(2).tolist(), "fit": "matrix" if wanted else "neutral"}
    numbers |= figures(used, white) | {"kelvin": kelvin}
    matrix = None
    if wanted:
        matrix = fitted.matrix * fitted.neutral[1] * guess[1] / guess
        matrix = matrix / (matrix @ (white / white[1])).mean()
        numbers |= {
            "matrix": matrix.tolist(),
            "matrix_sigma": (fitted.matrix_sigma * fitted.neutral[1] / guess).tolist(),
        }
        neutral = white / white[1]
    warnings = [] if numbers["delta_e_mean"] < FAR_OFF else [
        f"chart in {view}: its colours are off by {numbers['delta_e_mean']:.1f} delta E in the mean; are edition and "
        "corners right, is it in the scene's light alone?"
    ]  # fmt: skip
    return Charted(neutral, matrix, numbers, [_evidence(facts, fitted, kept, wanted)], warnings)


def figures(used: chart.Fit, white: np.ndarray) -> dict[str, Any]:
    """What is reported: errors by patch, what was left out, the light."""
    seen = np.isfinite(used.delta_e)
    return {
        "delta_e_mean": float(used.delta_e[used.used].mean()),
        "delta_e_max": float(used.delta_e[used.used].max()),
        "delta_e_held_out_mean": float(used.held_out[used.used].mean()),
        "delta_e": {name: float(value) for name, value in zip(NAMES, used.delta_e) if np.isfinite(value)},
        "left_out": [name for name, ok, there in zip(NAMES, used.used, seen) if there and not ok],
        "unusable": [name for name, there in zip(NAMES, seen) if not there],
        "neutral": (white / white[1]).tolist(),
        "white_radiance": float(white[1]),  # of a perfect white diffuser at the chart, the capture's unit
        "neutral_sigma_rel": used.neutral_sigma.tolist(),
        "light_gradient": used.gradient.tolist(),
        "light_gradient_f": used.gradient_f,
    }


def with_chart(profiles: dict[str, dict[str, Any]], camera: str, charted: Charted) -> dict[str, dict[str, Any]]:
    """The profiles with the chart's neutral, and matrix, in all views of that camera model."""
    result = {}
    for view, profile in profiles.items():
        if profile["camera"] != camera:
            result[view] = profile
            continue
        new = {**profile, "as_shot_neutral": charted.neutral}
        if charted.matrix is not None:
            new["fitted"] = charted.matrix
        elif profile["space"] != CAMERA_RGB:
            new["fitted"] = _of_file(profile, charted.neutral)
        result[view] = new
    return result


def _of_file(profile: dict[str, Any], neutral: np.ndarray) -> np.ndarray | None:
    """(3, 3) to ACEScg by what the file says, the neutral (3,), green 1, becoming white; None without a matrix."""
    if profile["space"] != CAMERA_RGB:
        return np.asarray(colour.matrix(profile["space"], "acescg") / neutral)
    if profile["color_matrix"] is None:
        return None
    return colour.acescg_from_camera(
        profile["color_matrix"], neutral, profile["color_matrix_2"], profile["illuminant"], profile["illuminant_2"],
        profile["file"], profile["forward_matrix"], profile["forward_matrix_2"],
    )  # fmt: skip


def _kelvin(profile: dict[str, Any], neutral: np.ndarray) -> float | None:
    """Temperature of the chart's light by the file's matrices; None where it has none."""
    if profile["space"] != CAMERA_RGB or profile["color_matrix"] is None:
        return None
    calibrations = ("color_matrix_2", "illuminant", "illuminant_2")
    neutral = neutral / neutral[1]
    white = colour.camera_white(profile["color_matrix"], neutral, *(profile[key] for key in calibrations))[1]
    kelvin = colour.temperature_of_xy(white[:2] / white.sum()) if np.all(white > 0) else 0.0
    return kelvin if 1500 < kelvin < 25000 else None


def _evidence(facts: dict[str, Any], fitted: chart.Fit, kept: chart.Fit | None, wanted: bool) -> dict[str, Any]:
    held_out = float(fitted.held_out[fitted.used].mean())
    by_file = "the file has none" if kept is None else f"that of the file {kept.delta_e[kept.used].mean():.2f}"
    because = f"mean delta E of the patches: a fit to the chart {held_out:.2f} (each patch held out), {by_file}"
    if not wanted:
        because += '; [chart] fit = "matrix" takes it'
    cost = "colours unlike those of the patches" if wanted else "the difference of the two, in saturated colours"
    return {
        "term": "colour matrix from the chart", "modelled": wanted, "because": because, "could_cost": cost,
        "no_bound": "a difference of colour, delta E, is no share of light",
    }  # fmt: skip
