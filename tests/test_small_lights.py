"""Lights a few photosites wide: their colours' sums against the light that was there."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.image.demosaic import demosaic
from pipeline.image.small_lights import restored

FINE = 10  # points to a pixel and axis of what is photographed
SIZE = 48  # photosites
COLOUR = np.array([1.4, 1.0, 0.5])


def photographed(inside, lens_px: float, level: float = 0.001) -> np.ndarray:
    """(SIZE, SIZE) of unit radiance where ``inside(x, y)`` [px from the middle], behind a lens and the pixel's box.

    The lens acts before the photosites do: on `FINE` points to a pixel, whose boxes are averaged afterwards.
    """
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - SIZE / 2
    sharp = inside(at[None], at[:, None]).astype(float) + level
    soft = gaussian_filter(sharp, FINE * np.sqrt(lens_px**2 - 1 / 12), mode="nearest")
    return soft.reshape(SIZE, FINE, SIZE, FINE).mean((1, 3))


def mosaic_of(grey: np.ndarray, cfa: str, colour: np.ndarray = COLOUR) -> np.ndarray:
    """What photosites see of ``grey`` (H, W) in one colour (3,)."""
    cell = colour[["RGB".index(letter) for letter in cfa]].reshape(2, 2)
    return (grey * np.tile(cell, (SIZE // 2, SIZE // 2))).astype(np.float32)


def errors(grey: np.ndarray, cfa: str, level: float = 0.001) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors (3,) of each colour's light, bilinear as it is, and without its aliases."""
    mosaic = mosaic_of(grey, cfa)
    plain = demosaic(mosaic, cfa, "bilinear")
    better, _ = restored(plain, mosaic, cfa, np.zeros(mosaic.shape, bool))
    true = COLOUR * (grey - level).sum()
    return tuple((picture - level * COLOUR).sum((0, 1), dtype=float) / true - 1 for picture in (plain, better))


def disc(random: np.random.Generator, radius: float):
    """An ellipse of that mean radius, anywhere among the photosites."""
    x0, y0, turn, squeeze = *random.uniform(-1, 1, 2), random.uniform(0, np.pi), random.uniform(0.6, 1)

    def inside(x, y):
        u = (x - x0) * np.cos(turn) + (y - y0) * np.sin(turn)
        v = (y - y0) * np.cos(turn) - (x - x0) * np.sin(turn)
        return (u * squeeze) ** 2 + (v / squeeze) ** 2 < radius**2

    return inside


@pytest.mark.parametrize("lens_px", [0.55, 0.7, 0.85])
@pytest.mark.parametrize("radius", [0.6, 1.0, 1.6, 2.5, 4.0])
def test_the_light_of_a_small_lamp_is_right_in_every_colour(lens_px, radius):
    """Uniform ellipses behind a Gaussian lens, the fit's own model: what is left is the quadrature's, and the prior's
    pull on the lens: 0.2 of the aliases, and 0.1 % where there are none."""
    random = np.random.default_rng(int(100 * radius))
    found = [errors(photographed(disc(random, radius), lens_px), cfa) for cfa in ("RGGB", "GBRG", "BGGR", "GRBG") * 2]
    before, after = (np.sqrt((np.array(part) ** 2).mean()) for part in zip(*found, strict=True))
    assert after < 0.2 * before + 0.001
    if lens_px == 0.55 and radius < 1.5:
        assert before > 0.04  # they are worth taking off


@pytest.mark.parametrize(("half_px", "bar_px"), [((1.9, 1.2), 0.3), ((2.5, 1.5), 0.0), ((3.5, 2.5), 0.3)])
def test_a_lamp_of_another_shape_stays_as_it_is_and_is_counted(half_px, bar_px):
    """A window, with a bar or without: an ellipse's aliases are not its own."""
    random = np.random.default_rng(3)
    for _ in range(4):
        x0, y0 = random.uniform(-1, 1, 2)
        mosaic = mosaic_of(
            photographed(
                lambda x, y, x0=x0, y0=y0: (
                    (abs(x - x0) < half_px[0]) & (abs(y - y0) < half_px[1]) & (abs(x - x0) >= bar_px)
                ),
                0.55,
            ),
            "RGGB",
        )
        plain = demosaic(mosaic, "RGGB", "bilinear")
        better, lights = restored(plain, mosaic, "RGGB", np.zeros(mosaic.shape, bool))
        assert (len(lights.fitted), lights.left) == (0, 1)
        np.testing.assert_array_equal(better, plain)


LEFT = {"border", "clipped"}  # small lights that keep their aliases


def test_what_is_no_small_lamp_stays_to_the_bit():
    """Noise, an edge, a wide lamp, one at the border, and one that touches an unusable photosite."""
    random = np.random.default_rng(5)
    unusable = np.zeros((SIZE, SIZE), bool)
    unusable[24, 25] = True
    usable = np.zeros((SIZE, SIZE), bool)
    small = photographed(disc(random, 1.5), 0.6)
    cases = {
        "noise": (random.normal(1, 0.1, (SIZE, SIZE)), usable),
        "edge": (np.where(np.arange(SIZE) > 20, 1.0, 0.05) * np.ones((SIZE, 1)), usable),
        "wide": (photographed(lambda x, y: np.hypot(x, y) < 11, 0.6), usable),
        "border": (np.roll(small, 18, 1), usable),
        "clipped": (small, unusable),
    }
    for name, (grey, mask) in cases.items():
        mosaic = mosaic_of(grey, "RGGB")
        plain = demosaic(mosaic, "RGGB", "bilinear")
        better, lights = restored(plain, mosaic, "RGGB", mask)
        assert not lights.fitted, name
        assert lights.left == (name in LEFT), name
        np.testing.assert_array_equal(better, plain, err_msg=name)


def test_two_lamps_are_both_corrected_and_the_rest_of_the_picture_stays():
    random = np.random.default_rng(7)
    grey = np.roll(photographed(disc(random, 1.2), 0.6), 10, 1) + 0.3 * np.roll(
        photographed(disc(random, 1.5), 0.6), -9, 1
    )
    mosaic = mosaic_of(grey, "RGGB")
    plain = demosaic(mosaic, "RGGB", "bilinear")
    better, lights = restored(plain, mosaic, "RGGB", np.zeros(mosaic.shape, bool))
    assert [round(light.shape[0] / 2) for light in lights.fitted] == [17, 7]  # the brighter first, near 34 and 15
    np.testing.assert_array_equal(better[:8], plain[:8])
    assert np.abs(better - plain).max() > 0


def test_a_lamp_without_blue_is_corrected_in_what_it_has():
    """A red diode: its empty channels have nothing to fit, and stay."""
    grey = photographed(disc(np.random.default_rng(9), 1.0), 0.55, level=0.0)
    mosaic = mosaic_of(grey, "RGGB", np.array([1.0, 0.1, 0.0]))
    plain = demosaic(mosaic, "RGGB", "bilinear")
    better, lights = restored(plain, mosaic, "RGGB", np.zeros(mosaic.shape, bool))
    (light,) = lights.fitted
    np.testing.assert_array_equal(better[..., 2], plain[..., 2])
    sums = [np.abs(picture[..., 0].sum(dtype=float) / grey.sum() - 1) for picture in (plain, better)]
    assert sums[1] < 0.3 * sums[0]
    assert light.flux[2] == light.alias[2] == 0
