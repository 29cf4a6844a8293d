from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from pipeline.image import pictures
from pipeline.image.colour import decode_srgb, luminance


def opened(uri):
    head, _, data = uri.partition(",")
    return head, np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


def test_shrink_keeps_the_mean_and_the_width():
    picture = np.random.default_rng(1).random((40, 60, 3)).astype(np.float32)
    small = pictures.shrink(picture, 20)
    assert small.shape == (13, 20, 3)
    assert small.mean() == pytest.approx(picture[:39].mean(), rel=1e-6)
    assert pictures.shrink(picture, 100) is picture
    assert pictures.shrink(np.ones((1, 1, 3)), 10).shape == (1, 1, 3)
    assert pictures.shrink(np.ones((2, 900, 3)), 100).shape == (2, 900, 3)


def test_heat_rises_in_lightness_by_even_steps():
    ramp = pictures.heat(np.linspace(0, 1, 256)[None], 1.0)[0]
    y = luminance(decode_srgb(ramp / 255), "linear_rec709")
    lightness = np.where(y > 0.008856, 116 * np.cbrt(y) - 16, 903.3 * y)
    steps = np.diff(lightness[::16])
    assert (np.diff(lightness) > -0.3).all()  # rounding to 8 bits
    assert steps.min() > 0.5 * steps.mean()
    assert steps.max() < 1.6 * steps.mean()


def test_maps_mark_what_is_not_known():
    values = np.array([[np.nan, np.inf, 0.5, 7.0, -3.0]])
    for picture in (pictures.heat(values, 1.0), pictures.signed(values, 1.0)):
        assert picture.shape == (1, 5, 3)
        assert tuple(picture[0, 0]) == tuple(picture[0, 1]) == pictures.NOT_KNOWN
    assert np.array_equal(pictures.heat(values, 1.0)[0, 3], pictures.HEAT[-1].astype(np.uint8))
    assert np.array_equal(pictures.heat(np.zeros((1, 1)), 0.0)[0, 0], pictures.HEAT[0].astype(np.uint8))


def test_signed_is_white_at_zero():
    picture = pictures.signed(np.array([[-1.0, 0.0, 1.0]]), 1.0)[0]
    assert picture[1].min() > 240
    assert picture[0, 2] > picture[0, 0]
    assert picture[2, 0] > picture[2, 2]


def test_bits_to_classes():
    mask = np.array([[0, 1, 2, 4, 8, 6]], np.uint32)
    assert pictures.first_bit(mask).tolist() == [[0, 1, 2, 3, 4, 2]]
    table = [(0, 0, 0), (1, 1, 1), (2, 2, 2)]
    assert pictures.classes(pictures.first_bit(mask), table)[0, :, 0].tolist() == [0, 1, 2, 2, 2, 2]


def test_checkerboard_shows_through_only_where_transparent():
    rgb = np.full((4, 4, 3), 10, np.uint8)
    assert (pictures.checkered(rgb, np.ones((4, 4))) == 10).all()
    assert set(np.unique(pictures.checkered(rgb, np.zeros((4, 4)), 2))) == {196, 226}


def test_uris_hold_the_picture():
    picture = np.random.default_rng(2).integers(0, 255, (9, 7, 3), dtype=np.uint8)
    head, back = opened(pictures.png_uri(picture[:, ::-1]))
    assert head == "data:image/png;base64"
    assert np.array_equal(back, picture[:, ::-1])
    smooth = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    head, back = opened(pictures.jpeg_uri(smooth))
    assert head == "data:image/jpeg;base64"
    assert np.abs(back.astype(int) - smooth).max() <= 3


def test_thumbnail_is_exposed_by_its_own_median():
    rgb = np.random.default_rng(3).random((30, 40, 3)).astype(np.float32)
    assert np.array_equal(pictures.thumbnail(rgb), pictures.thumbnail(8 * rgb))
    assert not np.array_equal(pictures.thumbnail(rgb, exposure_ev=0), pictures.thumbnail(8 * rgb, exposure_ev=0))
