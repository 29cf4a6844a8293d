"""Colour matrices against colour-science and the DNG specification's own laws."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.image import colour as c
from pipeline.run.errors import CaptureError

KISS_X4 = np.array([[0.6461, -0.1164, -0.0857], [-0.3825, 1.1597, 0.2534], [-0.0416, 0.1540, 0.6039]])
EOS350_A = np.array([[0.6159, -0.0945, -0.0745], [-0.6846, 1.3563, 0.3684], [-0.0802, 0.1086, 0.7555]])
EOS350_D65 = np.array([[0.6018, -0.0617, -0.0965], [-0.8645, 1.5881, 0.2975], [-0.1530, 0.1719, 0.7642]])


@pytest.fixture(scope="module")
def science():
    return pytest.importorskip("colour")


def test_matrices_agree_with_colour_science(science):
    aces = science.RGB_COLOURSPACES["ACEScg"]
    rec709 = science.RGB_COLOURSPACES["ITU-R BT.709"].copy()
    rec709.use_derived_transformation_matrices(True)
    # colour-science stores derived matrices in double precision: only rounding may differ.
    np.testing.assert_allclose(c.matrix("acescg", "xyz"), aces.matrix_RGB_to_XYZ, atol=2e-6)
    expected = science.matrix_RGB_to_RGB(rec709, aces, "Bradford")
    np.testing.assert_allclose(c.matrix("linear_rec709", "acescg"), expected, atol=2e-6)


def test_srgb_curve_agrees_with_colour_science(science):
    values = np.linspace(0, 1, 1001)
    # the standard's two branches do not quite meet; both ends use the same constants, so 1e-7 is rounding
    np.testing.assert_allclose(c.encode_srgb(values), science.models.eotf_inverse_sRGB(values), atol=1e-7)
    np.testing.assert_allclose(c.decode_srgb(values), science.models.eotf_sRGB(values), atol=1e-7)


def test_srgb_round_trip_and_negative_values():
    values = np.array([-0.5, -1e-3, 0.0, 1e-4, 0.2, 1.0, 7.0])
    np.testing.assert_allclose(c.decode_srgb(c.encode_srgb(values)), values, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("space", ["acescg", "linear_rec709"])
def test_white_stays_white_and_round_trips(space):
    white = c.convert(np.ones(3), space, "acescg")
    np.testing.assert_allclose(white, 1, atol=1e-12)
    colours = np.random.default_rng(0).normal(size=(5, 7, 3))
    back = c.convert(c.convert(colours, space, "xyz"), "xyz", space)
    np.testing.assert_allclose(back, colours, atol=1e-12)
    assert c.convert(colours.astype(np.float32), space, "xyz").dtype == np.float32


def test_luminance_of_acescg():
    np.testing.assert_allclose(c.luminance(np.eye(3)), [0.2722287, 0.6740818, 0.0536895], atol=1e-6)  # S-2014-004


def test_unknown_space_is_refused():
    with pytest.raises(ValueError, match="unknown colour space"):
        c.convert(np.ones(3), "rec2020", "acescg")


def test_temperature_against_colour_science(science):
    for name in ("A", "D50", "D65"):
        xy = np.array(science.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][name])
        expected = science.temperature.xy_to_CCT_McCamy1992(xy)
        assert c.temperature_of_xy(xy) == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("neutral", [[0.405, 1, 0.77], [0.7, 1.0, 0.4], [0.592408, 1, 0.501692]])
def test_neutral_becomes_white(neutral):
    for second in (None, EOS350_D65):
        result = c.acescg_from_camera(EOS350_A, np.array(neutral), second, 17, 21)
        np.testing.assert_allclose(result @ neutral, 1, atol=1e-9)


def test_single_matrix_recovers_known_colours():
    # A camera whose response is exactly ColorMatrix x XYZ, under D65: Rec.709 colours must come out as ACEScg.
    rgb = np.random.default_rng(1).uniform(size=(50, 3))
    d65 = c.xyz_of_xy(c.REC709_CHROMATICITIES[3])
    camera = rgb @ c.xyz_from_rgb(c.REC709_CHROMATICITIES).T @ KISS_X4.T
    neutral = KISS_X4 @ d65
    result = c.acescg_from_camera(KISS_X4, neutral, illuminant=21)
    expected = c.convert(rgb, "linear_rec709", "acescg") * neutral[1]  # white has green = 1, not Y = 1
    np.testing.assert_allclose(camera @ result.T, expected, atol=1e-9)


def test_interpolation_ends_and_middle():
    kelvin = (2856.0, 6504.0)
    np.testing.assert_allclose(c.interpolated_matrix(EOS350_A, EOS350_D65, kelvin, 2000), EOS350_A)
    np.testing.assert_allclose(c.interpolated_matrix(EOS350_A, EOS350_D65, kelvin, 9000), EOS350_D65)
    middle = 2 / (1 / 2856 + 1 / 6504)
    expected = (EOS350_A + EOS350_D65) / 2
    np.testing.assert_allclose(c.interpolated_matrix(EOS350_A, EOS350_D65, kelvin, middle), expected, atol=1e-12)
    swapped = c.interpolated_matrix(EOS350_D65, EOS350_A, kelvin[::-1], 4000)
    np.testing.assert_allclose(swapped, c.interpolated_matrix(EOS350_A, EOS350_D65, kelvin, 4000), atol=1e-12)


def test_dual_illuminant_finds_the_white_it_was_given():
    # A neutral made under 4000 K with the matrix in force there must be solved back to 4000 K.
    kelvin = (2856.0, 6504.0)
    xy = np.array([0.3804, 0.3768])
    white = c.xyz_of_xy(xy)
    made = c.interpolated_matrix(EOS350_A, EOS350_D65, kelvin, c.temperature_of_xy(xy))
    _, found = c.camera_white(EOS350_A, made @ white, EOS350_D65, 17, 21)
    np.testing.assert_allclose(found, white, atol=1e-6)


def test_missing_matrix_and_bad_neutral_are_refused():
    with pytest.raises(CaptureError, match="ColorMatrix1"):
        c.acescg_from_camera(None, np.ones(3))
    with pytest.raises(CaptureError, match="AsShotNeutral"):
        c.acescg_from_camera(KISS_X4, np.array([1.0, 0.0, 1.0]))


def forward_of(color_matrix: np.ndarray, white: np.ndarray) -> np.ndarray:
    """The ForwardMatrix that says the same as a ColorMatrix under a light with the white XYZ (3,)."""
    neutral = color_matrix @ white
    return c.adaptation(white, c.xyz_of_xy(c.D50_XY)) / white[1] @ np.linalg.inv(color_matrix) * neutral


@pytest.mark.parametrize("kelvin", [2856, 4000, 6504])
def test_forward_matrices_that_say_the_same_give_the_same(kelvin):
    """Both routes of DNG chapter 6 agree where the two kinds of matrix are made from one another, and keep white.

    At the two illuminants to what McCamy's temperature is off by (2 K, a thousandth of the way to the other matrix);
    between them each kind is interpolated by itself, which differs in second order: measured 0.025 for these two far
    apart matrices.
    """
    whites = [c.xyz_of_xy(np.array(xy)) for xy in ((0.44758, 0.40745), (0.3127, 0.3290))]
    forward = [forward_of(*pair) for pair in zip((EOS350_A, EOS350_D65), whites)]
    white = {2856: whites[0], 6504: whites[1]}.get(kelvin, c.xyz_of_xy(np.array([0.3804, 0.3768])))
    current = c.interpolated_matrix(EOS350_A, EOS350_D65, (2856, 6504), c.temperature_of_xy(white[:2] / white.sum()))
    neutral = current @ white / (current @ white)[1]
    by_color = c.acescg_from_camera(EOS350_A, neutral, EOS350_D65, 17, 21)
    by_forward = c.acescg_from_camera(EOS350_A, neutral, EOS350_D65, 17, 21, "", *forward)
    np.testing.assert_allclose(by_forward @ neutral, 1, atol=1e-12)
    atol = 1e-3 if kelvin in (2856, 6504) else 0.03
    np.testing.assert_allclose(by_forward, by_color, atol=atol)


def test_a_forward_matrix_that_is_not_of_d50_is_refused():
    with pytest.raises(CaptureError, match="ForwardMatrix1 maps the neutral"):
        c.acescg_from_camera(KISS_X4, np.array([0.5, 1.0, 0.6]), forward_matrix=np.eye(3))
