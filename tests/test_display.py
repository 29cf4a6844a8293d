from __future__ import annotations

import numpy as np
import pytest

from pipeline.image import display
from pipeline.image.colour import luminance
from pipeline.run.errors import ManifestError

PLAIN = "Un-tone-mapped"


@pytest.fixture(autouse=True)
def builtin_config(monkeypatch):
    monkeypatch.delenv("OCIO", raising=False)


def srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_neutral_ramp_is_the_srgb_curve():
    grey = np.linspace(0, 1, 256)
    coded = display.display_transform(np.repeat(grey[None, :, None], 3, -1), view=PLAIN)
    # One code value: rounding, and the 1e-4 of the D60 to D65 adaptation.
    assert np.abs(coded[0].astype(int) - np.round(255 * srgb(grey))[:, None]).max() <= 1


def test_aces_grey():
    # 18 % grey through ACES 2.0 is 0.349 of full code.
    assert display.display_transform(np.full((1, 1, 3), 0.18)).tolist() == [[[89, 89, 89]]]


def test_exposure_is_a_factor():
    rgb = np.random.default_rng(1).random((9, 7, 3)).astype(np.float32)
    brighter = display.display_transform(rgb, exposure_ev=1.0)
    assert np.array_equal(brighter, display.display_transform(2 * rgb))


def test_threads_and_strides_do_not_matter():
    rgb = np.random.default_rng(2).random((31, 17, 3)).astype(np.float32)
    whole = display.display_transform(rgb)
    rows = np.concatenate([display.display_transform(rgb[i : i + 1]) for i in range(31)])
    assert np.array_equal(whole, rows)
    assert np.array_equal(display.display_transform(rgb[:, ::-1])[:, ::-1], whole)


def test_input_is_left_alone():
    rgb = np.full((3, 3, 3), 0.5, np.float32)
    display.display_transform(rgb, exposure_ev=2)
    assert (rgb == 0.5).all()


def test_extremes_are_shown_not_hidden():
    rgb = np.array([[[np.nan, 1, 1], [np.inf, 0, 0], [-1, -1, -1], [1e30, 1e30, 1e30]]])
    coded = display.display_transform(rgb, view=PLAIN)
    assert coded.tolist() == [[[255, 0, 255], [255, 0, 255], [0, 0, 0], [255, 255, 255]]]


@pytest.mark.parametrize(("name", "view"), [("Radio", PLAIN), ("sRGB - Display", "Sepia")])
def test_wrong_names_list_the_right_ones(name, view):
    with pytest.raises(ManifestError, match=r"sRGB - Display|Un-tone-mapped"):
        display.display_transform(np.zeros((1, 1, 3)), name, view)


def test_wrong_config(monkeypatch, tmp_path):
    monkeypatch.setenv("OCIO", str(tmp_path / "none.ocio"))
    with pytest.raises(ManifestError, match="OCIO"):
        display.display_transform(np.zeros((1, 1, 3)))


SMALL_CONFIG = """ocio_profile_version: 2
roles: {aces_interchange: ap0, cie_xyz_d65_interchange: xyz, default: ap0}
displays:
  Box:
    - !<View> {name: Plain, colorspace: coded}
    - !<View> {name: Dim, colorspace: coded, looks: half}
looks:
  - !<Look>
    name: half
    process_space: ap0
    transform: !<MatrixTransform> {matrix: [0.5,0,0,0, 0,0.5,0,0, 0,0,0.5,0, 0,0,0,1]}
  - !<Look>
    name: red
    process_space: ap0
    transform: !<MatrixTransform> {matrix: [1,0,0,0, 0,0,0,0, 0,0,0,0, 0,0,0,1]}
colorspaces:
  - !<ColorSpace> {name: ap0}
  - !<ColorSpace> {name: coded, from_scene_reference: !<ExponentTransform> {value: 2, direction: inverse}}
display_colorspaces:
  - !<ColorSpace> {name: xyz}
"""


def test_config_without_acescg_uses_the_interchange_role(monkeypatch, tmp_path):
    path = tmp_path / "small.ocio"
    path.write_text(SMALL_CONFIG)
    monkeypatch.setenv("OCIO", str(path))
    rgb = np.random.default_rng(3).random((8, 8, 3))
    expected = np.round(255 * np.sqrt((rgb @ display.AP0_FROM_AP1.T).clip(0, 1)))
    assert np.abs(display.display_transform(rgb, "Box", "Plain") - expected).max() <= 1


@pytest.fixture
def own_config(monkeypatch, tmp_path):
    path = tmp_path / "small.ocio"
    path.write_text(SMALL_CONFIG)
    monkeypatch.setenv("OCIO", str(path))


def own(rgb):
    return np.round(255 * np.sqrt((rgb @ display.AP0_FROM_AP1.T).clip(0, 1)))


def test_looks_of_the_users_config(own_config):
    """A look takes the place of the view's own; a view's own holds without one; several in OCIO's notation."""
    rgb = np.random.default_rng(3).random((8, 8, 3))
    red = own(rgb) * (1, 0, 0)
    for view, look, expected in (
        ("Plain", "half", own(rgb / 2)),
        ("Dim", "", own(rgb / 2)),
        ("Dim", "red", red),
        ("Plain", "-half", own(rgb * 2)),
        ("Plain", "half, +red", own(rgb / 2) * (1, 0, 0)),
        ("Plain", "half,-half", own(rgb)),
    ):
        assert np.abs(display.display_transform(rgb, "Box", view, look=look) - expected).max() <= 1, (view, look)


@pytest.mark.parametrize("look", ["sepia", "half, sepia", "-sepia"])
def test_an_unknown_look_lists_what_there_is(own_config, look):
    with pytest.raises(ManifestError, match=r"composite.look.*half.*red.*sepia"):
        display.display_transform(np.zeros((1, 1, 3)), "Box", "Plain", look=look)


def test_the_users_config_names_the_displays_and_the_pinned_one_is_the_fallback(own_config, monkeypatch):
    assert display.display_views() == {"Box": ["Plain", "Dim"]}
    with pytest.raises(ManifestError, match=r"composite.display: is 'sRGB - Display'.*Box"):
        display.display_transform(np.zeros((1, 1, 3)))
    monkeypatch.delenv("OCIO")
    assert display.config_name() == display.BUILTIN_CONFIG
    assert display.DISPLAY in display.display_views()


def test_the_built_in_gamut_compression_is_a_look():
    """It leaves colours inside the gamut alone and brings a blue outside it back, before the view."""
    grey, blue = np.full((1, 1, 3), 0.3), np.array([[[-0.1, -0.05, 0.8]]])
    look = "ACES 1.3 Reference Gamut Compression"
    assert np.array_equal(display.display_transform(grey, look=look), display.display_transform(grey))
    assert not np.array_equal(display.display_transform(blue, look=look), display.display_transform(blue))


def test_auto_exposure_follows_exposure():
    rgb = np.random.default_rng(4).random((20, 20, 3))
    first = display.auto_exposure(rgb)
    assert display.auto_exposure(4 * rgb) == pytest.approx(first - 2)
    assert np.median(luminance(rgb * 2**first)) == pytest.approx(0.18)
    assert display.auto_exposure(np.full((2, 2, 3), np.nan)) == 0.0
    assert display.auto_exposure(np.zeros((2, 2, 3))) == 0.0


def test_display_exposure_lies_between_its_two_rules():
    rgb = np.random.default_rng(4).random((200, 20, 3)) * 0.3
    rgb[:4] = 50.0  # a lamp of two per cent
    first = display.display_exposure(rgb)
    assert display.display_exposure(4 * rgb) == pytest.approx(first - 2)
    assert np.log2(display.DIFFUSE_WHITE / 50) < first < display.auto_exposure(rgb)


def test_constants_against_colour_science():
    colour = pytest.importorskip("colour")
    space = colour.models.RGB_COLOURSPACE_ACESCG
    ap0 = colour.matrix_RGB_to_RGB(space, colour.models.RGB_COLOURSPACE_ACES2065_1, None)
    assert np.allclose(ap0, display.AP0_FROM_AP1, atol=1e-6)
