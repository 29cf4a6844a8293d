"""The plate's softness, given to what is rendered: a pixel of a render is a box, one of a photograph is seen by a lens.

How soft a photograph is (b: standard deviation of lens and pixel together, as a Gaussian) is measured on the edges of
the print that it shows (`pipeline.camera.softness`). A render already averages over its pixels, which has the
variance 1/12, so that the rest, b^2 - 1/12, is added: by the discrete Gaussian of Lindeberg (IEEE PAMI 12, 1990), whose
variance is exact however narrow it is, exp(-v) I_n(v), and whose derivative by v is half the Laplacian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.conventions import BOX_PX2
from pipeline.types import View

SOFTNESS = "insitu:softness_px"  # in the layers' header: b and its sigma
TAIL = 1e-6  # of the kernel's weight that is cut off
# Where no view shows a print: lenses as the simulated and real captures have them, without what demosaicking adds.
USUAL_PX, USUAL_SIGMA_PX = 0.65, 0.15
ELSEWHERE_PX = 0.1  # more sigma of a softness that was measured in another photograph than the plate


@dataclass(frozen=True)
class PlateLens:
    """Standard deviation of lens and pixel [px], its sigma, and where it is known from: measured, stated, assumed."""

    px: float
    sigma_px: float
    source: str

    @property
    def variance(self) -> float:
        """What the lens adds to the pixel's box [px^2]."""
        return max(self.px**2 - BOX_PX2, 0.0)


def softness_of(views: dict[str, View], stated_px: float | None) -> PlateLens:
    """The plate's: as ``stated_px`` says, as measured in the plate, or in the surest other view of its camera."""
    if stated_px is not None:
        return PlateLens(stated_px, 0.0, "stated")
    own = views["plate"]
    if own.softness_px is not None:
        return PlateLens(own.softness_px, own.softness_sigma_px, "measured")
    others = [v for v in views.values() if v.camera is None and v.softness_px is not None]
    if others:
        best = min(others, key=lambda view: view.softness_sigma_px)
        assert best.softness_px is not None
        return PlateLens(best.softness_px, float(np.hypot(best.softness_sigma_px, ELSEWHERE_PX)), "measured elsewhere")
    return PlateLens(USUAL_PX, USUAL_SIGMA_PX, "assumed")


def kernel(variance: float) -> np.ndarray:
    """(2 n + 1,) weights of the discrete Gaussian of ``variance`` [px^2], which sum to 1."""
    from scipy.special import ive

    reach = 0
    while 1 - (ive(0, variance) + 2 * ive(np.arange(1, reach + 1), variance).sum()) > TAIL:
        reach += 1
    weights = ive(np.abs(np.arange(-reach, reach + 1)), variance)
    return np.asarray(weights / weights.sum())


def softened(picture: np.ndarray, variance: float) -> np.ndarray:
    """A picture (H, W) or (H, W, 3) through a lens of ``variance`` [px^2], float32; beyond its border it goes on."""
    import cv2

    if variance <= 0:
        return picture
    taps = kernel(variance)
    values = np.ascontiguousarray(picture, np.float32)
    return np.asarray(cv2.sepFilter2D(values, -1, taps, taps, borderType=cv2.BORDER_REPLICATE))


def softer(picture: np.ndarray, variance: float) -> np.ndarray:
    """First-order change (H, W, C) of a picture by ``variance`` [px^2] more of softness: half its Laplacian's."""
    padded = np.pad(picture, ((1, 1), (1, 1), (0, 0)), mode="edge")
    around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
    return np.asarray(variance / 2 * (around - 4 * picture))
