"""Bring every view to the plate's exposure and colour by references that both show.

Method: grey cards, white cards, 24-patch charts and grey balls are cut into cells that are the same spots in both
photographs; their log ratios give three gains (one exposure and its colour) with a full covariance, and several
references are joined (pipeline/image/balance.py). Gains are applied where they differ from 1 beyond chance (as
improbable as three standard deviations); the stages that read the ball's photographs multiply by them. All gains and
their inverses are written as an ASC CDL collection, and one more that would make the plate's grey neutral, not applied.

Limits: a reference must be lit alike in plate and view, so out of the probe's shadow and glow; a grey ball shows
another side to a camera that moved, so it counts from the plate's place only. Without a common reference the gains are
1 with a stated uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.image import balance as estimate
from pipeline.image.colour import convert
from pipeline.image.display import cdl_collection
from pipeline.image.exposure import LABEL_SIGMA, TIE_SIGMA
from pipeline.run.artifacts import BALANCE, BRACKETS, CORRECTIONS, EXPOSURES, FACTS, PHOTOGRAPHS
from pipeline.run.errors import CaptureError
from pipeline.run.stage import Stage
from pipeline.types import Balance, Bracket, Raster, Result
from stages import knobs

DISAGREE = 5.0  # chi2 per degree of freedom between references that is warned of
COLOUR_SIGMA = 0.05  # relative, of each channel: how alike the developed neutrals of two camera models are taken to be


@dataclass(frozen=True)
class Pair:
    """A reference in the plate and in one view."""

    name: str
    gains: estimate.Gains
    residual: float  # of a chart's colours; NaN for other kinds


def compute(
    facts: dict[str, Any], brackets: dict[str, Bracket], exposures: dict[str, list[dict[str, Any]]],
    photographs: dict[str, Raster], params: knobs.Balance,
) -> Result:  # fmt: skip
    """Gains of every view but the plate, and the corrections as text."""
    warnings: list[str] = []
    references = facts.get("reference", [])
    balls = {ball["name"]: ball for ball in facts.get("ball", [])}
    balances, numbers, evidence = {}, {}, []
    for view in (name for name in photographs if name != "plate"):
        still = bool(balls.get(view, {}).get("tripod"))
        pairs = [pair for one in references if (pair := pair_of(one, view, photographs, still, warnings))]
        own = view not in balls or bool(balls[view].get("camera"))  # what is no ball was taken through another lens
        own |= model_of(brackets, view) != model_of(brackets, "plate")
        if pairs:
            balances[view], numbers[view] = measured(view, pairs, warnings)
        else:
            balances[view], numbers[view] = assumed(exposures, view, own)
            if own and view in balls:
                warnings.append(
                    f"{view}: another camera than the plate's, no reference that both saw: its exposure is uncertain "
                    f"by {LABEL_SIGMA:.0%}, its colour by {COLOUR_SIGMA:.0%}; lay a grey card in both: [[reference]]"
                )
        evidence.append(reason(view, balances[view], numbers[view], own))
        evidence += [matrix_reason(view, pair) for pair in pairs if np.isfinite(pair.residual)]
    for one in references:
        if "plate" not in outlines(one):
            warnings.append(f"reference {one['name']}: the plate does not show it, so it ties nothing; take it out")
    grey = plate_neutral(references, photographs["plate"])
    if grey is not None:
        numbers["plate_neutral"] = {"slope": np.exp(grey.log).tolist(), "sigma_rel": sigma_of(grey.covariance)}
        evidence.append(neutral_reason(grey))
    outputs = {"balance": balances, "corrections": corrections(balances, grey)}
    return Result(outputs, numbers, warnings, evidence)


def model_of(brackets: dict[str, Bracket], view: str) -> str:
    """The camera model that a view's metadata name; empty for none."""
    return brackets[view].frames[0].camera if view in brackets and brackets[view].frames else ""


def outlines(reference: dict[str, Any]) -> dict[str, np.ndarray]:
    """Where each view shows a reference: corners (N, 2) px."""
    return {seen["view"]: np.array(seen["corners_px"], float) for seen in reference["seen"]}


def pair_of(
    reference: dict[str, Any], view: str, photographs: dict[str, Raster], still: bool, warnings: list[str]
) -> Pair | None:
    """A reference's gains of the view; None where the two do not share it, or it cannot be used."""
    name, kind, seen = reference["name"], reference["kind"], outlines(reference)
    if not {"plate", view} <= seen.keys():
        return None
    if kind == "grey_ball" and not still:
        warnings.append(
            f"reference {name}: {view} shows another side of this ball than the plate; left out; a flat card serves "
            "from every side"
        )
        return None
    across = estimate.cells_across([seen["plate"], seen[view]], kind)
    cells = {place: estimate.cells_of(photographs[place], seen[place], kind, across) for place in ("plate", view)}
    if kind == "chart":
        for place in cells:
            check_chart(name, place, cells[place])
    parts = {place: estimate.greys(one) if kind == "chart" else one for place, one in cells.items()}
    gains = estimate.ratio(parts["plate"], parts[view], estimate.SAME_PLACE if still else estimate.OTHER_PLACE)
    if gains is None:
        usable = {place: int(np.isfinite(one.mean).all(-1).sum()) for place, one in parts.items()}
        warnings.append(
            f"reference {name}: {usable['plate']} cells usable in the plate, {usable[view]} in {view}, needed "
            f"{estimate.FEWEST_CELLS} in common; left out; is it clipped, too small or hidden, are its corners right?"
        )
        return None
    residual = estimate.chart_residual(cells["plate"], cells[view], gains) if kind == "chart" else np.nan
    return Pair(name, gains, residual)


def check_chart(name: str, view: str, cells: estimate.Cells) -> None:
    """Raise CaptureError when the patches are not those of the chart in this order."""
    agreement = estimate.chart_agreement(cells)
    if agreement < estimate.CHART_AGREES:
        raise CaptureError(
            f"reference {name}: in {view} its patches follow the chart's with correlation {agreement:.2f}, needed "
            f"{estimate.CHART_AGREES}; give the corners beside dark skin, bluish green, black, white, in this order"
        )


def sigma_of(covariance: np.ndarray) -> list[float]:
    """Relative standard uncertainty of each gain."""
    return [float(value) for value in np.sqrt(np.diag(covariance))]


def measured(view: str, pairs: list[Pair], warnings: list[str]) -> tuple[Balance, dict[str, Any]]:
    """Balance of a view from its references, and the figures."""
    gains, disagreement = estimate.joined([pair.gains for pair in pairs])
    if disagreement > DISAGREE:
        warnings.append(
            f"{view}: its references disagree (chi2 {disagreement:.1f} per degree of freedom, expected 1): "
            f"{', '.join(pair.name for pair in pairs)}; is one lit otherwise than in the plate?"
        )
    chi2 = estimate.significance(gains)
    names = [pair.name for pair in pairs]
    balance = Balance(
        gains=np.exp(gains.log), covariance=gains.covariance, references=names,
        applied=chi2 > estimate.SIGNIFICANT_CHI2,
    )  # fmt: skip
    return balance, {**figures(balance), "chi2": chi2, "cells": gains.cells, "references_chi2_per_dof": disagreement}


def assumed(exposures: dict[str, list[dict[str, Any]]], view: str, own: bool) -> tuple[Balance, dict[str, Any]]:
    """Gains of 1 where no reference joins plate and view: as uncertain as their exposures, or as two cameras'."""
    if own:
        covariance = LABEL_SIGMA**2 * np.ones((3, 3)) + COLOUR_SIGMA**2 * np.eye(3)
    else:
        plate, ball = (
            min((float(row["sigma_rel"]) for row in exposures.get(name, [])), default=LABEL_SIGMA)
            for name in ("plate", view)
        )
        covariance = max(plate**2 + ball**2, TIE_SIGMA**2) * np.ones((3, 3))
    balance = Balance(gains=np.ones(3), covariance=covariance, references=[], applied=False)
    return balance, figures(balance)


def figures(balance: Balance) -> dict[str, Any]:
    """One exposure factor, three gains, and their uncertainties."""
    each = np.full(3, 1 / 3)
    return {
        "exposure": float(np.exp(each @ np.log(balance.gains))),
        "exposure_sigma_rel": float(np.sqrt(each @ balance.covariance @ each)),
        "gains": balance.gains.tolist(), "gains_sigma_rel": sigma_of(balance.covariance),
        "references": len(balance.references), "applied": balance.applied,
    }  # fmt: skip


def plate_neutral(references: list[dict[str, Any]], plate: Raster) -> estimate.Gains | None:
    """Log gains that make the plate's grey references grey; None without one."""
    found = []
    for reference in references:
        kind, seen = reference["kind"], outlines(reference)
        if "plate" not in seen:
            continue
        cells = estimate.cells_of(plate, seen["plate"], kind, estimate.cells_across([seen["plate"]], kind))
        part = estimate.greys(cells) if kind == "chart" else cells
        stated = reference.get("reflectance")
        rgb = None if stated is None else convert(np.array(stated), reference["reflectance_space"], "acescg")
        if (gains := estimate.neutral(part, estimate.reflectance_of(kind, rgb, len(part.mean)))) is not None:
            found.append(gains)
    return estimate.joined(found)[0] if found else None


def corrections(balances: dict[str, Balance], grey: estimate.Gains | None) -> str:
    """The ASC CDL collection: each correction and its inverse."""
    slopes: dict[str, np.ndarray] = {}
    said: dict[str, str] = {}
    for view, balance in balances.items():
        there, back = f"{view}_to_plate", f"plate_to_{view}"
        slopes |= {there: balance.gains, back: 1 / balance.gains}
        source = ", ".join(balance.references) or "no reference"
        sigma = " ".join(f"{100 * value:.2f}" for value in sigma_of(balance.covariance))
        state = "applied to the light" if balance.applied else "not applied"
        said[there] = f"{view} brought to the plate by {source}; sigma {sigma} percent; {state}"
        said[back] = f"undoes {there}"
    if grey is not None:
        slopes |= {"plate_to_neutral": np.exp(grey.log), "neutral_to_plate": np.exp(-grey.log)}
        said["plate_to_neutral"] = "makes the plate as grey as its references, luminance kept; offered, not applied"
        said["neutral_to_plate"] = "undoes plate_to_neutral"
    return cdl_collection(slopes, said, "ACEScg")


def reason(view: str, balance: Balance, numbers: dict[str, Any], own: bool) -> dict[str, Any]:
    """Why a view's gains are applied, or not."""
    sigma = numbers["exposure_sigma_rel"]
    if balance.references:
        gains = " ".join(f"{value:.4f}" for value in balance.gains)
        because = (
            f"{', '.join(balance.references)}: gains {gains}, chi2 {numbers['chi2']:.1f} against 1 (needs "
            f"{estimate.SIGNIFICANT_CHI2:g})"
        )
        bound = float(np.abs(np.log(balance.gains)).max())
        cost = f"at most {bound:.1%} of the light's scale"
    elif own:
        because = "unknown: another camera than the plate's, and no reference that both saw"
        bound = 2 * float(np.hypot(sigma, COLOUR_SIGMA))
        cost = f"about {sigma:.0%} of the light's scale and {COLOUR_SIGMA:.0%} of its colour; lay a grey card in both"
    else:
        because = "one camera, and no reference that both saw"
        bound = 2 * sigma
        cost = f"the exposures' uncertainty, {sigma:.2%}"
    return {
        "term": f"balance of {view}", "modelled": balance.applied, "because": because, "could_cost": cost,
        "bound_rel": bound,
    }  # fmt: skip


def matrix_reason(view: str, pair: Pair) -> dict[str, Any]:
    """What three gains leave of the difference between two cameras, as a chart shows it."""
    return {
        "term": f"3x3 colour matrix of {view}",
        "modelled": False,
        "because": f"three gains leave {pair.residual:.1%} rms on the colours of {pair.name}",
        "could_cost": f"{pair.residual:.1%} of saturated colours, nothing of greys",
        "bound_rel": 2 * pair.residual,
    }


def neutral_reason(grey: estimate.Gains) -> dict[str, Any]:
    """The plate's own white is left as it was developed."""
    cast = float(np.ptp(grey.log))
    return {
        "term": "neutral plate",
        "modelled": False,
        "because": f"the picture is the photographer's; its grey differs by {cast:.1%} between channels",
        "could_cost": "nothing: plate and light share it; corrections.ccc holds plate_to_neutral",
        "bound_rel": 0.0,
    }


STAGE = Stage(
    "balance",
    compute,
    knobs.Balance,
    inputs={"facts": FACTS, "brackets": BRACKETS, "exposures": EXPOSURES, "photographs": PHOTOGRAPHS},
    outputs={"balance": BALANCE, "corrections": CORRECTIONS},
)
