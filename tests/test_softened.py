"""What is rendered is as soft as the photograph: kernel, layers of a real render, and what an unsure softness makes."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from test_composite_render import made, wish

from pipeline.conventions import BOX_PX2
from pipeline.simulation.lens import blur
from pipeline.transport.softened import TAIL, USUAL_PX, kernel, softened, softer, softness_of
from pipeline.types import View
from stages import composite, knobs
from stages.uncertainty import softness_modes


def view(px: float | None = None, sigma_px: float = 0.0) -> View:
    return View(
        world_from_camera=np.eye(4), covariance=np.zeros((6, 6)), route="given", rms_px=0.0, points=0, softness_px=px,
        softness_sigma_px=sigma_px,
    )  # fmt: skip


@pytest.mark.parametrize("variance", [1e-3, 0.05, 0.22, 0.5, 4.0, 100.0])
def test_kernel_has_its_variance(variance: float) -> None:
    """Sum 1, and the variance but for the tail that is cut: `TAIL` of the weight, as far out as it reaches."""
    weights = kernel(variance)
    reach = len(weights) // 2
    away = np.arange(-reach, reach + 1)
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    assert variance - (away**2 * weights).sum() == pytest.approx(0, abs=2 * TAIL * (reach + 2) ** 2)


def test_a_wide_lens_is_a_gaussian() -> None:
    """The discrete Gaussian has 1 / v more kurtosis, which raises its middle by 1 / (8 v) along each axis.

    That is the first order; the next is (1 / v)^2.
    """
    point = np.zeros((65, 65), np.float32)
    point[32, 32] = 1
    ours, theirs = softened(point, 16.0), gaussian_filter(point, 4.0)
    assert np.abs(ours - theirs).max() < (1 / (4 * 16) + 1 / 16**2) * theirs.max()


def test_two_lenses_are_one_and_none_is_the_picture() -> None:
    """Variances add: the kernels are a semigroup, exact but for the tails."""
    picture = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    twice = softened(softened(picture, 0.2), 0.3)[8:-8, 8:-8]
    np.testing.assert_allclose(twice, softened(picture, 0.5)[8:-8, 8:-8], atol=4 * TAIL)
    assert softened(picture, 0.0) is picture


def test_softer_is_the_derivative() -> None:
    """A central difference of two variances errs by h^3 / 24 of the third derivative, which is 4^3 at most."""
    picture, h = np.random.default_rng(1).random((40, 50, 3)), 1e-2
    at = softened(picture, 0.3)
    change = softened(picture, 0.3 + h / 2).astype(float) - softened(picture, 0.3 - h / 2)
    inside = np.s_[8:-8, 8:-8]
    np.testing.assert_allclose(softer(at, h)[inside], change[inside], atol=h**3 / 24 * 64 + 8 * TAIL + 4e-7)


def test_plate_first_then_other_views_then_what_is_usual() -> None:
    views = {"plate": view(0.8, 0.02), "a": view(0.6, 0.01)}
    assert softness_of(views, 1.5).px == 1.5
    assert softness_of(views, None).px == 0.8
    other = softness_of(views | {"plate": view()}, None)
    assert other.px == 0.6
    assert other.sigma_px > 0.1
    assert softness_of({"plate": view()}, None).px == USUAL_PX
    assert softness_of({"plate": view(0.2)}, None).variance == 0  # sharpened: a render is soft enough


def test_objects_of_a_render_are_as_soft_as_asked(tmp_path: Path) -> None:
    """A convolution adds its variance to the second moments of an outline and keeps its area, whatever the outline.

    The simulator's own three taps, which share no code with ours, have the same variance, so moments agree with them.
    """
    wishes, stated = [wish(tmp_path, 0.0, base_color=(0.5, 0.5, 0.5))], 0.7
    _, box = made(wishes, softness_px=0.0)
    _, soft = made(wishes, softness_px=stated)
    before, after, theirs = box["obj.A"], soft["obj.A"], blur(box["obj.A"], stated)
    assert after.sum() == pytest.approx(before.sum(), rel=1e-5)
    for axis in (0, 1):
        spread = [moment(picture.astype(float), axis) for picture in (before, after, theirs)]
        assert spread[1] - spread[0] == pytest.approx(stated**2 - BOX_PX2, rel=0.01)
        assert spread[1] == pytest.approx(spread[2], rel=1e-4)
    assert soft.attributes["insitu:softness_px"] == "0.7 0"


def moment(picture: np.ndarray, axis: int) -> float:
    """Variance [px^2] of a picture about its middle, along an axis."""
    along = picture.sum(1 - axis)
    place = np.arange(len(along))
    middle = (along * place).sum() / along.sum()
    return float((along * (place - middle) ** 2).sum() / along.sum())


def test_an_unsure_softness_is_a_mode_of_edges(tmp_path: Path) -> None:
    """The mode against two composites a sigma apart, central difference; what is far from edges keeps its radiance.

    Second order: half the curvature of the change over two sigmas, below a tenth here. Plate and rule are the same.
    """
    wishes, px, sigma = [wish(tmp_path, 0.0, base_color=(0.5, 0.5, 0.5))], 0.7, 0.05
    pictures = {}
    for soft in (px - sigma, px, px + sigma):
        given, layers = made(wishes, softness_px=soft)
        found = composite.compute(layers=layers, **given, params=knobs.Composite(kind="additive"))
        pictures[soft] = found.outputs["composite"]
    plate, window = given["photographs"]["plate"], (slice(0, 48), slice(0, 64))
    (mode,) = softness_modes(pictures[px], plate, f"{px} {sigma}", window)
    change = (pictures[px + sigma].rgb().astype(float) - pictures[px - sigma].rgb()) / 2
    assert np.linalg.norm(mode.change - change) < 0.1 * np.linalg.norm(change)
    alpha = pictures[px]["obj.A"]
    edges = (alpha > 0.02) & (alpha < 0.98)
    assert np.abs(mode.change[edges]).mean() > 5 * np.abs(mode.change[~edges]).mean()
    assert softness_modes(pictures[px], plate, "0.7 0", window) == []
