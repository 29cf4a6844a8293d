"""The photograph with the objects in it: additive (4), ratio (5), or chosen per pixel; linear EXR and display picture.

The plate is never resampled. Pixels that nothing touches keep their bits. ``plate * mul + add + obj`` rebuilds the
result from the EXR's layers. Every guard that fires is counted and marked in ``guards``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, CLIPPED
from pipeline.image.display import display_exposure, display_transform
from pipeline.run import artifacts as A
from pipeline.run.stage import Stage
from pipeline.transport import differential as d
from pipeline.types import Raster, Result
from stages import knobs

GUARDS = {
    "negative": d.NEGATIVE,
    "clipped_plate": d.CLIPPED_PLATE,
    "gain_limited": d.GAIN_LIMITED,
    "no_model": d.NO_MODEL,
    "bounded_ratio": d.BOUNDED,
}


def compose(plate: Raster, layers: Raster, kind: str) -> tuple[np.ndarray, d.Layers]:
    """The composite (H, W, 3) float32 and its layers, guards complete."""
    names = ("obj", "lost", "gained", "without")
    parts = {name: layers.rgb(name) for name in names}
    change = d.Change(**parts, alpha=layers["obj.A"], ground=layers["ground"])
    rgb = plate.rgb()
    simple = {"additive": d.additive, "ratio": d.ratio}
    result = simple[kind](change) if kind in simple else d.chosen(change, rgb)
    picture = result.apply(rgb)
    changed = (result.mul != 1).any(-1) | (result.add != 0).any(-1)
    guards = result.guards | (d.NEGATIVE * ((picture < 0) & (rgb >= 0)).any(-1)).astype(np.uint32)
    clipped = changed & ((plate["mask"] & CLIPPED) > 0) & (layers["obj.A"] < 1)
    guards |= (d.CLIPPED_PLATE * clipped).astype(np.uint32)
    return picture, d.Layers(result.mul, result.add, result.obj, guards)


def compute(photographs: dict[str, Raster], layers: Raster, params: knobs.Composite) -> Result:
    """Composite and display pictures. Raises ManifestError for an unknown display or view."""
    plate = photographs["plate"]
    picture, built = compose(plate, layers, params.kind)
    channels = {
        **Raster.split(picture),
        **Raster.split(built.mul, "mul"),
        **Raster.split(built.add, "add"),
        **Raster.split(built.obj, "obj"),
        "obj.A": layers["obj.A"],
        "guards": built.guards,
    }
    exposure = display_exposure(plate.rgb()) + params.exposure_ev
    numbers: dict[str, Any] = {
        f"guard_{name}_px": int(((built.guards & bit) > 0).sum()) for name, bit in GUARDS.items()
    }
    numbers["touched_fraction"] = float((picture != plate.rgb()).any(-1).mean())
    numbers["not_finite_px"] = int((~np.isfinite(picture)).any(-1).sum())
    numbers["exposure_ev"] = exposure
    warnings = []
    if numbers["guard_clipped_plate_px"]:
        warnings.append(
            f"composite: the light changes on {numbers['guard_clipped_plate_px']} px where the plate is clipped; their "
            "true value is unknowable, add a shorter plate frame"
        )
    outputs = {
        "composite": Raster(channels, ACESCG, {"insitu:layers": "R,G,B = plate * mul + add + obj"}),
        "display": display_transform(picture, params.display, params.view, exposure),
        "plate_display": display_transform(plate.rgb(), params.display, params.view, exposure),
    }
    return Result(outputs, numbers, warnings)


STAGE = Stage(
    "composite",
    compute,
    knobs.Composite,
    inputs={"photographs": A.PHOTOGRAPHS, "layers": A.LAYERS},
    outputs={"composite": A.COMPOSITE, "display": A.DISPLAY, "plate_display": A.PLATE_DISPLAY},
    live=True,
)
