"""How far the final pixels are off, from the truth or from the reference setting: the figures that are traded.

``T`` the picture that is right, ``P`` its plate, ``C`` the composite, ``B`` the developed plate, ``s`` the capture's
one scale; box means of 5x5 and masks are those of `pipeline.image.metrics`.

changed_rel_err    sqrt(sum |box(C - B) - s box(T - P)|^2 / sum |s box(T - P)|^2) over every pixel that an object
                   covers, that truly changes by over 0.5 %, or that we changed; doing nothing scores 1. One norm for
                   all, in which bright highlights count most.
object_rel_err     median over object pixels, and
shadow_change_err  median over shadow pixels, as `insitu evaluate` has them
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.image import metrics
from pipeline.image.truth import Truth
from pipeline.run import formats


def scores(
    composite: np.ndarray, plate: np.ndarray, coverage: dict[str, np.ndarray], truth: Truth
) -> dict[str, float | None]:
    """The figures of pictures (H, W, 3) in ACEScg; ``coverage`` (H, W) per object tells object pixels from shadow.

    Pixels that are not finite count as black, as they do in `insitu evaluate`.
    """
    (composite, _), (plate, _) = metrics.finite(composite), metrics.finite(plate)
    plate_box, true_box, composite_box = (metrics.box(p) for p in (plate, truth.plate, composite))
    ref = metrics.reference(truth.with_objects, true_box, coverage, metrics.scale_of(plate_box, true_box))
    found = metrics.errors(metrics.error_maps(composite, composite_box, plate_box, ref), ref)
    return {
        "changed_rel_err": changed_error(composite_box, plate_box, ref),
        "object_rel_err": found["object_rel_err"],
        "shadow_change_err": found["shadow_change_err"],
    }


def changed_error(composite_box: np.ndarray, plate_box: np.ndarray, ref: metrics.Reference) -> float | None:
    """``changed_rel_err`` of 5x5 means (H, W, 3); None when nothing truly changes."""
    ours = composite_box - plate_box  # as the truth's change is taken, so that a picture has no error against itself
    edge = metrics.relative(ref.change_box, ref.truth_box - ref.change_box) > metrics.FAINT
    changed = ref.covered | edge | (ours != 0).any(-1)
    total = float((ref.change_box[changed].astype(float) ** 2).sum())
    if not total:
        return None
    return float(np.sqrt(((ours - ref.change_box)[changed].astype(float) ** 2).sum() / total))


def pictures_of(build: Path) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Composite and developed plate (H, W, 3) of a finished build, and the objects' coverage (H, W)."""
    composite = formats.read_exr(build / "composite" / "composite.exr")
    plate = formats.read_exr(build / "develop" / "photographs" / "plate.exr").rgb()
    alpha = composite.channels.get("obj.A")
    return composite.rgb(), plate, {} if alpha is None else {"objects": alpha}


def as_truth(build: Path) -> Truth:
    """A finished build in place of the truth."""
    composite, plate, alpha = pictures_of(build)
    return Truth(plate=plate, with_objects=composite, coverage=alpha)
