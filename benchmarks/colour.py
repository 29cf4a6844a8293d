"""How right colours come out: measured camera sensitivities, two matrices as in a DNG, and a fit to a chart.

The truth is integrated by the simulator's own spectra; matrices, interpolation and fit are the pipeline's. Matrices are
fitted to 190 reflectances, none of them a patch of the chart they are judged by. Run: ``make bench-colour``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image import chart, colour, sensitivities
from pipeline.simulation import spectra

LIGHTS = {"D65": ("D65",), "A": ("A",), "half A, half D65": ("A", "D65"), "FL2": ("FL2",), "LED-B1": ("LED-B1",)}
PLACES = np.stack(np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4), -1).reshape(-1, 2)
OUT = Path(__file__).parents[1] / "docs/benchmarks"
HEADING = """# How right colours come out

Made by `make bench-colour` in some ten seconds; every figure is in [colour.json](colour.json). CIE DE2000 over the 24
patches (ISO 17321-1 spectra), camera against CIE observer, both under the light, adapted by Bradford: mean / largest.

"""
NOTES = """
- **two matrices**: ColorMatrix 1 and 2 under A and D65, interpolated as DNG 1.7.1 says. They are fitted to the 190
  reflectances of Academy P-2013-001; none is a patch (the nearest to a grey is {nearest:.3f} rms
  away, to a colour {coloured:.3f}).
- **D65 alone**: the same with one matrix, as files of one calibration have it.
- **chart**: `[chart] fit = "matrix"` on a noiseless chart whose true colours under that light are known: about the
  floor of a matrix that keeps white (the fit weighs errors as CIE94 does, and squares them). **held out**: each patch
  judged by a fit to the other 23.
- **published chart**: the fit to the chart's published values instead, as in a real capture (charts made before
  November 2014, brought from D50 to the light's temperature; the patches here are another specimen's, 1.0 DE2000 in
  the mean from the published ones under D50).
- Fluorescent light (FL2) has no colour temperature in the matrices' sense: what is left is metamerism of the camera
  under a spiky light, which the chart's fit takes out. Published values then mean the colours of the surfaces in
  daylight, not their colours under that lamp, hence the last column.
"""


def seen_and_true(curves: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera values (24, 3) of the patches, their true ACEScg (24, 3), and the camera's values of white (3,)."""
    lit = np.stack(list(spectra.patches().values())) * light
    seen, white = spectra.integrate(lit[:, None] * curves), spectra.integrate(light * curves)
    xyz, white_xyz = spectra.integrate(lit[:, None] * spectra.observer()), spectra.integrate(light * spectra.observer())
    adapted = colour.adaptation(white_xyz, colour.xyz_of_xy(colour.ACESCG_CHROMATICITIES[3]))
    return seen, xyz / white_xyz[1] @ (colour.matrix("xyz", "acescg") @ adapted).T, white


def rows(hold_out: bool = True) -> list[dict[str, Any]]:
    """Errors of each camera under each light, mean and largest."""
    found = []
    for camera in spectra.CAMERAS:
        known = sensitivities.profile_of(camera)
        curves = spectra.sensitivities(camera)
        curves = curves / curves.max(-1, keepdims=True)  # as published; the simulator makes them 1 on D65
        found += [_row(camera, name, curves, known, hold_out) for name in LIGHTS]
    return found


def _row(camera: str, name: str, curves: np.ndarray, known: dict[str, Any], hold_out: bool) -> dict[str, Any]:
    light = np.mean([spectra.illuminant(part) for part in LIGHTS[name]], 0)
    seen, truth, white = seen_and_true(curves, light)
    one = colour.acescg_from_camera(known["color_matrix_2"], white / white[1], illuminant=21)
    two = colour.acescg_from_camera(known["color_matrix"], white / white[1], known["color_matrix_2"], 17, 21)
    patches = chart.Patches(seen, 1e-4 * seen, PLACES, np.zeros(24))
    neutral = white / white[1]
    found = colour.camera_white(known["color_matrix"], neutral, known["color_matrix_2"], 17, 21)[1]
    kelvin = colour.temperature_of_xy(found[:2] / found.sum())  # what the pipeline knows of the light
    fit, published = (
        chart.fit(patches, truth, hold_out=hold_out),
        chart.fit(patches, chart.reference("before_2014", kelvin), hold_out=False),
    )
    assert fit is not None
    assert published is not None
    errors = {
        "two matrices": chart.delta_e(seen / white[1] @ two.T, truth),
        "D65 alone": chart.delta_e(seen / white[1] @ one.T, truth),
        "chart": fit.delta_e,
        "held out": fit.held_out,
        "published chart": chart.delta_e(seen @ published.matrix.T, truth),
    }
    return {"camera": camera, "light": name, **{key: [float(e.mean()), float(e.max())] for key, e in errors.items()}}


def nearest() -> tuple[float, float]:
    """Rms difference of the patches' spectra to the nearest training reflectance: smallest, and smallest of colours."""
    import colour as science

    data = science.characterisation.read_training_data_rawtoaces_v1()
    training = np.stack([np.interp(spectra.WAVELENGTHS, data.wavelengths, one) for one in data.values.T])
    patches = np.stack(list(spectra.patches().values()))
    away = np.sqrt(((training[:, None] - patches) ** 2).mean(-1)).min(0)
    return float(away.min()), float(away[:18].min())


def main() -> None:
    """Write the page and the figures."""
    table = rows()
    columns = [key for key in table[0] if key not in ("camera", "light")]
    lines = ["| camera | light | " + " | ".join(columns) + " |", "| --- " * (len(columns) + 2) + "|"]
    for row in table:
        cells = [f"{row[key][0]:.2f} / {row[key][1]:.1f}" for key in columns]
        lines.append(f"| {row['camera']} | {row['light']} | " + " | ".join(cells) + " |")
    least, coloured = nearest()
    page = HEADING + "\n".join(lines) + "\n" + NOTES.format(nearest=least, coloured=coloured)
    (OUT / "colour.md").write_text(page)
    (OUT / "colour.json").write_text(json.dumps({"rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
