"""The spectral twin: what must agree agrees, what RGB cannot do shows, and the caller's Mitsuba stays as it was."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.run.cli import build_parser
from pipeline.run.errors import ManifestError, ToolError
from pipeline.run.formats import read_exr
from pipeline.simulation import spectra
from pipeline.simulation.spectral import FURNACE, Size
from pipeline.simulation.twin_report import compare, markdown
from pipeline.simulation.twin_world import grey, wavelength_table
from stages.simulate import simulate_spectral

DESK = Path(__file__).parents[1] / "sample_captures/scenes/desk.toml"
CAMERA = spectra.CAMERAS[0]


# ---------------------------------------------------------------- spectra


@pytest.mark.parametrize("name", spectra.CAMERAS)
def test_daylight_is_white_and_grey_stays_grey(name: str) -> None:
    camera = spectra.camera_of(name)
    assert np.allclose(camera.acescg_from_camera.sum(1), 1, atol=1e-12)
    for level in (1.0, 0.18):
        flat = np.full(len(spectra.WAVELENGTHS), level)
        assert np.allclose(camera.reflectance(flat), level, atol=1e-12)
        assert np.allclose(spectra.colorimetric(flat * spectra.illuminant("D65")), level, atol=1e-12)


def test_colours_agree_with_colour_science() -> None:
    """Lab, and the chromaticity of the illuminants, against the library's own way from spectrum to colour."""
    import colour

    power = spectra.illuminant("A")
    x, y, z = spectra.integrate(power * spectra.observer())
    assert y == pytest.approx(1, abs=1e-12)
    # CIE 15 sums 360 to 830 nm; 380 to 780 nm leaves 1e-4 of illuminant A out
    assert np.allclose([x / (x + y + z), y / (x + y + z)], [0.44758, 0.40745], atol=3e-4)
    acescg = np.array([[0.2, 0.4, 0.1], [1.0, 1.0, 1.0], [0.002, 0.001, 0.003]])
    space = colour.RGB_COLOURSPACES["ACEScg"]
    xyz = acescg @ np.asarray(space.matrix_RGB_to_XYZ).T
    # colour-science rounds the matrix of ACEScg to ten decimals and its white to five
    assert np.allclose(spectra.lab(acescg), colour.XYZ_to_Lab(xyz, space.whitepoint), atol=2e-3)


def test_camera_matrix_is_as_good_as_published() -> None:
    """Fits of these cameras to the 24 patches are known to leave a mean of about one DE2000, and two for the Sigma."""
    nikon, sigma = (spectra.matrix_cost(spectra.camera_of(name)) for name in spectra.CAMERAS)
    assert nikon["D65"]["median"] < 1.0
    assert nikon["D65"]["median"] < sigma["D65"]["median"] < 2.0
    assert nikon["A"]["median"] > nikon["D65"]["median"]


def test_one_bounce_of_daylight_is_free_and_more_are_not() -> None:
    camera = spectra.camera_of(CAMERA)
    costs = [spectra.bounce_cost(camera, n) for n in (1, 2, 3)]
    assert costs[0]["D65"]["p95"] < 1e-9
    for lamp in spectra.LAMPS:
        medians = [cost[lamp]["median"] for cost in costs]
        assert medians == sorted(medians)


def test_grey_costs_nothing_under_any_lamp() -> None:
    camera = spectra.camera_of(CAMERA)
    flat = np.full(len(spectra.WAVELENGTHS), 0.4)
    for lamp in spectra.LAMPS:
        power = spectra.illuminant(lamp)
        rgb = camera.develop(power) * camera.reflectance(flat) ** 3
        assert np.allclose(camera.develop(power * flat**3), rgb, atol=1e-12)


def test_patch_and_illuminant_are_found_by_colour() -> None:
    names = list(spectra.patches())
    seen = spectra.colorimetric(spectra.patches()["blue"] * spectra.illuminant("D65"))
    assert spectra.nearest_patch(seen) == "blue"
    assert len(names) == 24
    assert spectra.nearest_illuminant(7 * spectra.colorimetric(spectra.illuminant("D50"))) == "D50"


def test_wavelengths_integrate_what_they_meet() -> None:
    """Mean of value x weight over the fractions is the integral; 16 even ones already give it within a per cent."""
    curves = spectra.sensitivities(CAMERA) * spectra.illuminant("FL11")
    places, weights = wavelength_table(curves)
    assert (np.diff(places) > 0).all()
    exact = spectra.integrate(curves * spectra.patches()["red"])
    values = weights * np.interp(places, spectra.WAVELENGTHS, spectra.patches()["red"])
    # the lamp's lines have corners 0.5 nm wide; the table's steps are below 0.1 nm where they are
    assert np.allclose(values.mean(1), exact, rtol=1e-3)


def test_people_become_grey() -> None:
    part = {
        "a": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}}
    }
    assert grey(part)["a"]["bsdf"]["reflectance"] == {"type": "uniform", "value": pytest.approx(0.2)}
    assert grey(part)["a"]["type"] == "sphere"


# ---------------------------------------------------------------- comparison


def worlds(gain: np.ndarray) -> tuple[dict, np.ndarray]:
    """Two noiseless worlds (20 x 20) that differ by a gain of the shadow's colour; an object in the corner."""
    plate = np.full((2, 20, 20, 3), 0.3)
    shadow = plate * np.where(np.arange(20) < 10, 0.5, 1.0)[:, None]
    made = {"plate": plate, "with": shadow, "environment": plate}
    coverage = np.zeros((20, 20, 1))
    coverage[14:, 14:] = 1
    return {"camera": made, "observer": made, "rgb": {**made, "with": shadow * gain}}, coverage


def test_equal_worlds_cost_nothing() -> None:
    found = compare(*worlds(np.ones(3)), ["thing"], 1.0)
    assert found["plate_delta_e"]["p95"] == 0
    assert found["object_delta_e"]["thing"]["p95"] == 0
    assert found["change_relative"]["p95"] == 0
    assert found["ratio_relative"]["noise_p95"] == 0


def test_a_wrong_shadow_is_measured() -> None:
    found = compare(*worlds(np.array([1.02, 1.0, 1.0])), ["thing"], 1.0)
    # red of the ratio is 2 % too high; where the shadow is whole it is 0.5, so the change is 2 % of one channel of it
    assert found["ratio_relative"]["median"] == pytest.approx(0.02, abs=1e-9)
    assert found["change_relative"]["median"] == pytest.approx(0.02 / np.sqrt(3), rel=1e-6)
    assert found["tint_error"]["median"] == pytest.approx(np.log(1.02), abs=1e-9)


# ---------------------------------------------------------------- both worlds, rendered


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The desk in 64 x 48, few samples; Mitsuba of this process is in use meanwhile."""
    from pipeline.transport.variant import use_mitsuba

    out = tmp_path_factory.mktemp("twin") / "out"
    mi = use_mitsuba()
    before = mi.variant()
    lines: list[str] = []
    simulate_spectral(DESK, out, lines.append, Size(64, 48, 16, 2, 32))
    assert mi.variant() == before
    assert "comparing" in lines
    return out


def test_furnace_and_grey_agree(tiny: Path) -> None:
    furnace = json.loads((tiny / "spectral.json").read_text())["furnace_relative_difference"]
    assert set(furnace) == set(FURNACE)
    assert max(furnace.values()) < 2e-3  # asked for; measured 2e-4


def test_daylight_costs_less_than_a_warm_lamp(tiny: Path) -> None:
    """Under daylight both worlds agree but for bounces; under another lamp the plate's colours differ beyond noise."""
    lamps = json.loads((tiny / "spectral.json").read_text())["lamps"]
    assert set(lamps) == set(spectra.LAMPS)
    assert lamps["D65"]["plate_delta_e"]["median"] < 0.2  # the window is not D65 and the print bounces: 0.08 measured
    for lamp in ("A", "LED-B1", "FL11"):
        plate = lamps[lamp]["plate_delta_e"]
        assert plate["median"] > 3 * plate["noise_median"]
        assert plate["median"] > 2 * lamps["D65"]["plate_delta_e"]["median"]
    assert {"vase", "red_sphere"} <= set(lamps["A"]["object_delta_e"])  # the ring is thinner than 5 pixels here


def test_pictures_and_page_come_from_the_run(tiny: Path) -> None:
    record = json.loads((tiny / "spectral.json").read_text())
    assert markdown(record) == (tiny / "spectral.md").read_text()
    for world in ("rgb", "camera"):
        pixels = read_exr(tiny / f"with_{world}_a.exr", "acescg").rgb()
        assert pixels.shape == (48, 64, 3)
        assert np.isfinite(pixels).all()


def test_lamps_keep_their_edges(tiny: Path) -> None:
    """Mitsuba dims a lamp's edge beside black in spectral variants, unless prevented: 3 % of the lamps' light."""
    rgb, seen = (read_exr(tiny / f"plate_{world}_d65.exr", "acescg").rgb() for world in ("rgb", "camera"))
    assert np.allclose(seen.mean((0, 1)) / rgb.mean((0, 1)), 1, atol=5e-3)


def test_refusals(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ManifestError, match="not empty"):
        simulate_spectral(DESK, tiny, lambda _: None)
    assert build_parser().parse_args(["simulate", "a.toml", "b", "--spectral"]).spectral
    monkeypatch.setenv("INSITU_VARIANT", "scalar_rgb")
    with pytest.raises(ToolError, match=r"no spectral variant.*only scalar_rgb.*doctor"):
        simulate_spectral(DESK, tmp_path / "new", lambda _: None, Size(16, 12, 1, 1, 8))
