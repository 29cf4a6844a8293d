"""Errors of a composite against the truth: the figures of the project, as pure functions of pictures.

``T`` is the true photograph with the objects, ``P`` the true plate, ``B`` the developed plate, ``C`` the composite: all
(H, W, 3), linear ACEScg. One scale per capture, ``s = median(|box(B)| / |box(P)|)``, is never fitted again. Norms are
over RGB, ``box`` is the 5x5 mean. Masks come from truth alone:

object   the coverage is over 0.99 in the whole 3x3 neighbourhood
shadow   no coverage within 7x7, and ``|box(T - P)| / |box(P)| > 5 %``
faint    the same, 0.5 to 5 %

Non-finite values of C or B are replaced by black (an error of 1) and counted, so that one NaN cannot hide a picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.image.colour import convert, encode_srgb

SHADOW, FAINT = 0.05, 0.005  # change that makes a shadow pixel, and a faint one
BOX, GROW, SHRINK = 5, 7, 3  # px
CLASSES = ("elsewhere", "object", "shadow", "faint", "edge")


def norm(picture: np.ndarray) -> np.ndarray:
    """Length over RGB, (H, W) of (H, W, 3)."""
    return np.sqrt(np.einsum("...c,...c->...", picture, picture))


def box(picture: np.ndarray, size: int = BOX) -> np.ndarray:
    """Mean over ``size`` x ``size`` pixels, the border mirrored (its own pixel repeated); float32 or float64 as given.

    Sums are float64 either way; float32 results cost 1e-5 of a change of 0.5 %.
    """
    from scipy.ndimage import uniform_filter

    return uniform_filter(picture, (size, size, *[1] * (picture.ndim - 2)), mode="reflect")


def relative(difference: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Relative error (...) of vectors (..., 3); 0 where both vanish, inf where only the reference does."""
    above, below = norm(difference), norm(reference)
    without = np.where(above > 0, np.inf, 0.0).astype(np.result_type(above, below))
    return np.divide(above, below, out=without, where=below > 0)


def scale_of(plate_box: np.ndarray, true_box: np.ndarray) -> float:
    """The capture's one scale: median of ``|box(B)| / |box(P)|`` over pixels where P is not black; 1 if none is."""
    below = norm(true_box)
    lit = below > 0
    return float(np.median(norm(plate_box)[lit] / below[lit])) if lit.any() else 1.0


def finite(picture: np.ndarray) -> tuple[np.ndarray, int]:
    """The picture with non-finite values black (a copy if there are any), and how many values those were."""
    bad = ~np.isfinite(picture)
    return (np.where(bad, 0, picture), int(bad.sum())) if bad.any() else (picture, 0)


@dataclass(frozen=True, eq=False)
class Reference:
    """The truth, scaled to the capture, and its masks. Build with `reference`."""

    truth: np.ndarray  # (H, W, 3) s T
    truth_box: np.ndarray  # box(s T)
    change_box: np.ndarray  # box(s (T - P))
    objects: dict[str, np.ndarray]  # (H, W) bool, fully covered pixels of each object
    inside: np.ndarray  # (H, W) bool
    shadow: np.ndarray  # (H, W) bool
    faint: np.ndarray  # (H, W) bool
    covered: np.ndarray  # (H, W) bool, any coverage at all

    @property
    def classes(self) -> np.ndarray:
        """(H, W) uint32, index into CLASSES."""
        layers = [self.covered & ~self.inside, self.inside, self.shadow, self.faint]
        return np.select(layers, [4, 1, 2, 3], 0).astype(np.uint32)


def reference(truth: np.ndarray, true_box: np.ndarray, coverage: dict[str, np.ndarray], scale: float) -> Reference:
    """Masks and smoothed truth. ``true_box``: 5x5 means of P; ``coverage``: one (H, W) in [0, 1] per object."""
    from scipy.ndimage import binary_dilation, binary_erosion

    shape = truth.shape[:2]
    total = np.clip(sum(coverage.values(), np.zeros(shape)), 0, 1)
    near = binary_dilation(total > 0, np.ones((GROW, GROW)))

    def fully(values: np.ndarray) -> np.ndarray:
        return binary_erosion(values > 0.99, np.ones((SHRINK, SHRINK)), border_value=1)

    truth_box = box(truth)
    change = relative(truth_box - true_box, true_box)
    return Reference(
        truth=scale * truth,
        truth_box=scale * truth_box,
        change_box=scale * (truth_box - true_box),
        objects={name: fully(values) for name, values in coverage.items()},
        inside=fully(total),
        shadow=~near & (change > SHADOW),
        faint=~near & (change > FAINT) & (change <= SHADOW),
        covered=total > 0,
    )


def error_maps(
    composite: np.ndarray, composite_box: np.ndarray, plate_box: np.ndarray, ref: Reference
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per pixel (H, W): relative error, that of 5x5 means, and error of the *change* on 5x5 means."""
    by_pixel = relative(composite - ref.truth, ref.truth)
    by_box = relative(composite_box - ref.truth_box, ref.truth_box)
    change = relative(composite_box - plate_box - ref.change_box, ref.change_box)
    return by_pixel, by_box, change


def errors(maps: tuple[np.ndarray, np.ndarray, np.ndarray], ref: Reference) -> dict[str, Any]:
    """The linear figures from the maps of `error_maps`; None where truth has no such pixel."""
    by_pixel, by_box, change = maps
    return {
        "object_rel_err": _quantile(by_pixel[ref.inside], 0.5),
        "object_rel_err_p90": _quantile(by_pixel[ref.inside], 0.9),
        "object_rel_err_of": {name: _quantile(by_pixel[mask], 0.5) for name, mask in ref.objects.items()},
        "shadow_change_err": _quantile(change[ref.shadow], 0.5),
        "shadow_change_err_p90": _quantile(change[ref.shadow], 0.9),
        "faint_change_err": _quantile(change[ref.faint], 0.5),
        "shadow_rel_err": _quantile(by_box[ref.shadow], 0.5),
    }


def _quantile(values: np.ndarray, fraction: float) -> float | None:
    return float(np.quantile(values, fraction)) if values.size else None


def coded(picture: np.ndarray, exposure_ev: float) -> np.ndarray:
    """An sRGB picture in [0, 1], float32, of ACEScg (H, W, 3); clipped. The perceptual figures compare such pictures.

    Plain sRGB, no tone curve: those figures must not depend on the display transform in use. Expose by the truth's
    `auto_exposure`, so that its median is at mid grey.
    """
    linear = convert(np.asarray(picture, np.float32) * np.float32(2.0**exposure_ev), "acescg", "linear_rec709")
    return encode_srgb(np.clip(linear, 0, 1)).astype(np.float32)


def psnr(picture: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal to noise [dB] of pictures in [0, 1]; inf when they are the same."""
    error = float(np.mean((np.asarray(picture, float) - truth) ** 2))
    return float(-10 * np.log10(error)) if error else float("inf")


def ssim(picture: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity of pictures (H, W, 3) in [0, 1] (Wang 2004: Gaussian window, sigma 1.5).

    NaN for pictures smaller than the window of 11.
    """
    from skimage.metrics import structural_similarity

    if min(picture.shape[:2]) < 11:
        return float("nan")
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(picture, truth, channel_axis=2, data_range=1.0, **window))


def flip(picture: np.ndarray, truth: np.ndarray, pixels_per_degree: float) -> tuple[float, np.ndarray]:
    """Mean FLIP and its map (H, W) of sRGB pictures in [0, 1] (Andersson 2020, the authors' LDR-FLIP)."""
    import flip_evaluator

    pair = [np.ascontiguousarray(p, np.float32) for p in (truth, picture)]
    found, mean, _ = flip_evaluator.evaluate(
        *pair, "LDR", inputsRGB=True, applyMagma=False, parameters={"ppd": float(pixels_per_degree)}
    )
    return float(mean), np.asarray(found).reshape(truth.shape[:2])


def untouched(composite: np.ndarray, plate: np.ndarray, influence: np.ndarray, alpha: np.ndarray) -> tuple[bool, float]:
    """Whether every pixel outside the influenced region and the objects is the plate's, bit for bit; their fraction.

    The same bits: NaN equals the same NaN, and 0 differs from -0.
    """
    free = (influence == 0) & (alpha == 0)
    ours, theirs = (np.ascontiguousarray(p[free], np.float32).view(np.uint32) for p in (composite, plate))
    return bool(np.array_equal(ours, theirs)), float(free.mean())
