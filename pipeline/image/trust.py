"""Pictures of how far a composite can be trusted: its uncertainty, the shared errors, and where they come from."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.image import figures as fig
from pipeline.image import pictures
from pipeline.types import Raster

HIGH = 0.05  # relative, top of the map of uncertainty
LARGEST = 6  # shared errors that get a picture
BAR_PX, WIDE_PX, FRAME_PX = 34, 560, 8
COLOURS = {
    "plate": (104, 116, 128), "render": (76, 120, 168), "scale": (245, 133, 24), "flux": (238, 202, 59),
    "sky": (114, 183, 178), "unseen": (160, 160, 160), "turn": (178, 121, 162), "pose": (84, 162, 75),
    "softness": (255, 157, 166),
}  # fmt: skip
OTHER, GROUND = (157, 117, 93), (24, 25, 27)
MEANINGS = {
    "plate": "noise and interpolation of the plate",
    "render": "sampling and denoising", "scale": "scale of the light", "sky": "the sky",
    "flux": "flux of lamps", "unseen": "directions not seen", "turn": "direction of the light", "pose": "pose and lens",
    "softness": "softness of the plate",
}  # fmt: skip


def shown(uncertainty: Raster, composite: Raster, budget: dict[str, Any], width: int) -> dict[str, Any]:
    """Figures and tables of the report's section."""
    if not budget.get("regions"):
        return {}
    level = np.linalg.norm(composite.rgb(), axis=-1)
    level = np.maximum(level, 1e-3 * np.median(level))
    sigma = np.linalg.norm(uncertainty.rgb("sigma").astype(float), axis=-1) / level
    figures = [
        fig.heat_figure(
            pictures.shrink(np.where(np.isfinite(sigma), sigma, np.nan), width), HIGH, "Standard uncertainty",
            "of every pixel, relative; grey: not known", width="wide",
        )
    ]  # fmt: skip
    for region, part in budget["regions"].items():
        figures.append(fall(part["pixel_rel"], f"Pixels: {region}", part["pixels"]))
        figures.append(fall(part["mean_rel"], f"Mean over all: {region}", part["pixels"]))
    figures += modes(uncertainty, level, width)
    return {"figures": figures, "tables": tables(budget)}


def modes(uncertainty: Raster, level: np.ndarray, width: int) -> list[fig.Figure]:
    """The largest shared errors: the composite's change per standard uncertainty."""
    names = [name for name in str(uncertainty.attributes.get("insitu:modes", "")).split(",") if name]
    changes = {}
    for name in names:
        red, green, blue = (uncertainty[f"mode_{name}.{c}"].astype(np.float32) for c in "RGB")
        changes[name] = (red + green + blue) / (np.sqrt(3) * level)
    ordered = sorted(changes, key=lambda name: -float(np.square(changes[name]).mean()))
    return [
        fig.signed_figure(
            pictures.shrink(changes[name], width), 0.02, f"Shared error: {name}", "change per standard uncertainty"
        )
        for name in ordered[:LARGEST]
    ]


def fall(parts: dict[str, float], title: str, count: int) -> fig.Figure:
    """A waterfall: each source's share of the variance after that of the larger ones; labels are sigmas."""
    total = parts["total"]
    ordered = sorted((name for name in parts if name != "total" and parts[name] > 0), key=lambda name: -parts[name])
    picture = np.empty((BAR_PX * (len(ordered) + 1), WIDE_PX, 3), np.uint8)
    picture[:] = GROUND
    labels, start = [], 0.0
    rows = [*((name, parts[name], COLOURS.get(name, OTHER)) for name in ordered), ("total", total, (200, 200, 200))]
    for number, (name, sigma, colour) in enumerate(rows):
        if name == "total":
            start = 0.0
        end = start + (sigma / total) ** 2 if total > 0 else start
        left, right = (round(min(at, 1.0) * (WIDE_PX - 1)) for at in (start, end))
        top = number * BAR_PX
        picture[top + 4 : top + BAR_PX - 4, left : max(right, left + 2)] = colour
        text = f"{MEANINGS.get(name, name)}: {fig.short(100 * sigma)} %"
        labels.append(fig.Label(WIDE_PX / 2, top + 0.65 * BAR_PX, text))
        start = end
    caption = f"{count} px; bars: shares of the variance, one after the other; figures: standard uncertainty"
    return fig.photo(picture, title, caption, 92, labels=labels)


def tables(budget: dict[str, Any]) -> list[dict[str, Any]]:
    """What no sigma holds, in the words of the stages."""
    rows = [[row["stage"], row["term"], row["could_cost"]] for row in budget.get("not_covered", [])]
    head = ["stage", "not modelled", "could cost"]
    return [{"title": "What no sigma covers", "head": head, "rows": rows, "numeric": False}] if rows else []
