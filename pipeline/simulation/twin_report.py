"""What the two worlds of the spectral twin differ in, and the page that says so.

All on means over 5 x 5 pixels. DE2000 takes a white table top as white. Noise is found from the halves: the same figure
for half their difference.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.simulation.spectra import delta_e, spread

CHANGED = 0.05  # relative change of a channel from which a pixel counts as changed by the objects
COVERED = 0.999
BOX_PX = 5  # pictures are compared on means over this square


def box(values: np.ndarray) -> np.ndarray:
    """Mean of (H, W, ...) over a square of BOX_PX."""
    from scipy.ndimage import uniform_filter

    return uniform_filter(values, (BOX_PX, BOX_PX, *[1] * (values.ndim - 2)), mode="nearest")


def compare(
    worlds: dict[str, dict[str, np.ndarray]], coverage: np.ndarray | None, names: list[str], white: float
) -> dict[str, Any]:
    """Figures of one kind of lamp.

    ``worlds[sort][picture]`` are halves (2, H, W, 3) in ACEScg; sorts rgb, camera (spectral, by camera and matrix) and
    observer (spectral, by CIE); pictures plate, with and environment. ``coverage`` (H, W, number of objects).
    """
    mean = {sort: {name: box(halves.mean(0)) for name, halves in made.items()} for sort, made in worlds.items()}
    noise = {n: box(half_difference(worlds["camera"][n] - worlds["rgb"][n])) for n in ("plate", "with", "environment")}

    def colours(name: str, mask: np.ndarray) -> dict[str, Any]:
        truth, guess = mean["camera"][name][mask] / white, mean["rgb"][name][mask] / white
        still = spread(delta_e(truth, truth + noise[name][mask] / white))
        return {**spread(delta_e(truth, guess)), "noise_median": still["median"], "noise_p95": still["p95"]}

    shape = mean["rgb"]["plate"].shape[:2]
    found: dict[str, Any] = {"plate_delta_e": colours("plate", np.ones(shape, bool))}
    pair = mean["camera"]["plate"] / white, mean["observer"]["plate"] / white
    found["camera_delta_e"] = spread(delta_e(*pair))
    around = mean["camera"]["environment"]
    found["environment_relative"] = with_noise(
        relative(mean["rgb"]["environment"], around), relative(around + noise["environment"], around)
    )
    if coverage is None or not names:
        return found
    found["object_delta_e"] = {
        name: colours("with", mask) for i, name in enumerate(names) if (mask := box(coverage[..., i]) > COVERED).any()
    }
    return found | change(mean, noise, coverage, white)


def half_difference(halves: np.ndarray) -> np.ndarray:
    """Half the difference of two halves: as noisy as their mean."""
    return (halves[0] - halves[1]) / 2


def relative(guess: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Length of the difference over the length of the truth, over the last axis."""
    return np.linalg.norm(guess - truth, axis=-1) / np.linalg.norm(truth, axis=-1)


def change(
    mean: dict[str, dict[str, np.ndarray]], noise: dict[str, np.ndarray], coverage: np.ndarray, white: float
) -> dict[str, Any]:
    """How the ratio with / without of the RGB world serves the spectral plate, where the objects change it."""
    (truth, plate), (guess, bare) = ([mean[s][n] for n in ("with", "plate")] for s in ("camera", "rgb"))
    ratio, model = truth / plate, guess / bare
    mask = (box(coverage.sum(-1)) < 1e-6) & (np.abs(ratio - 1).max(-1) > CHANGED)
    found: dict[str, Any] = {"changed_pixels": int(mask.sum())}
    if not mask.any():
        return found
    noisy = ratio + (noise["with"] - ratio * noise["plate"]) / plate
    ratio, model, noisy, plate, truth = (values[mask] for values in (ratio, model, noisy, plate, truth))
    found["ratio_relative"] = with_noise(np.abs(model / ratio - 1).max(-1), np.abs(noisy / ratio - 1).max(-1))
    found["change_relative"] = with_noise(
        relative(plate * model - plate, truth - plate), relative(plate * noisy - plate, truth - plate)
    )
    found["composite_delta_e"] = with_noise(
        delta_e(truth / white, plate * model / white), delta_e(truth / white, plate * noisy / white)
    )
    tint, tint_model, tint_noisy = (np.log(values[:, 0] / values[:, 2]) for values in (ratio, model, noisy))
    found["tint_rms"] = float(np.sqrt(np.mean(tint**2)))
    found["tint_error"] = with_noise(np.abs(tint_model - tint), np.abs(tint_noisy - tint))
    if (tint != 0).any():
        found["tint_slope"] = float((tint * tint_model).sum() / (tint**2).sum())
    return found


def with_noise(error: np.ndarray, still: np.ndarray) -> dict[str, float]:
    """Median and 95 % of an error, and of what noise alone makes of it."""
    floor = spread(still)
    return {**spread(error), "noise_median": floor["median"], "noise_p95": floor["p95"]}


def cell(figures: dict[str, float], scale: float = 1.0, digits: int = 2) -> str:
    """``median / 95 %``, with the noise of both in brackets where it is known."""
    text = f"{scale * figures['median']:.{digits}f} / {scale * figures['p95']:.{digits}f}"
    if "noise_median" in figures:
        text += f" ({scale * figures['noise_median']:.{digits}f} / {scale * figures['noise_p95']:.{digits}f})"
    return text


def rows(title: list[str], lines: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in [title, ["---"] * len(title), *lines]) + "\n"


def markdown(record: dict[str, Any]) -> str:
    """The page of a record. Every figure in it comes from the record."""
    return "\n".join([opening(record), foundations(record), pictures(record)])


def opening(record: dict[str, Any]) -> str:
    """What was done."""
    width, height = record["pixels"]
    made_of = ", ".join(f"{name} ({patch.split(' (')[0]})" for name, patch in record["objects"].items()) or "none"
    return f"""# What RGB costs

The simulator, like the pipeline, multiplies three numbers per bounce. This page compares that with the same place in
spectra. Made by one command, figures and text:

    insitu simulate sample_captures/scenes/{record["scene"]}.toml build/spectral --spectral
    cp build/spectral/spectral.md docs/spectral.md

Camera: {record["camera"]}, its 3x3 matrix fitted to ISO 17321-1 under D65.
Picture: {width} x {height} pixels about the objects, {record["paths_per_pixel"]} paths each,
{record["wavelengths_per_path"]} wavelengths per path. Objects and their measured spectra: {made_of}.
The main window is {record["window"]}, the rest of the room D65 times smooth spectra; the columns are kinds of lamps.

RGB lights are what camera and matrix make of the spectra, RGB surfaces what they make of them under D65. Figures are
median / 95 %; in brackets what noise alone would give. Beside the page: `spectral.json` and the pictures as EXR.
"""


def foundations(record: dict[str, Any]) -> str:
    """What needs no picture."""
    lamps = list(record["matrix_delta_e"][record["camera"]])
    furnace = [[name, f"{100 * value:.3f} %"] for name, value in record["furnace_relative_difference"].items()]
    matrix = [[name, *[cell(cost[lamp]) for lamp in lamps]] for name, cost in record["matrix_delta_e"].items()]
    bounce = [[n, *[cell(cost[lamp]) for lamp in lamps]] for n, cost in record["bounce_delta_e"].items()]
    return f"""## Do both agree where they must?

Largest difference of a channel between both renders of a sphere under an even D65 sky, light once reflected:

{rows(["sphere", "difference"], furnace)}
## The camera's matrix

DE2000 of the 24 patches, camera and matrix against the CIE observer, one light:

{rows(["camera", *lamps], matrix)}
## Bounces

DE2000 of light x reflectance^n in RGB against spectra, the 24 patches, at luminance 0.2. No rendering:

{rows(["n", *lamps], bounce)}"""


def pictures(record: dict[str, Any]) -> str:
    """What the renders say."""
    lamps = record["lamps"]
    lines = [["plate, DE2000", *[cell(found["plate_delta_e"]) for found in lamps.values()]]]
    for name in record["objects"]:
        seen = [found.get("object_delta_e", {}).get(name) for found in lamps.values()]
        lines.append([f"{name}, DE2000", *[cell(figures) if figures else "not seen" for figures in seen]])
    for key, title, scale, digits in (
        ("ratio_relative", "ratio with / without, error [%]", 100, 2),
        ("change_relative", "the change itself, error [%]", 100, 1),
        ("composite_delta_e", "spectral plate x RGB ratio, DE2000", 1, 2),
        ("tint_error", "bleeding: error of ln(R/B) of the ratio [%]", 100, 2),
    ):
        seen = [found.get(key) for found in lamps.values()]
        lines.append([title, *[cell(figures, scale, digits) if figures else "no change" for figures in seen]])
    slopes = [
        f"{f['tint_slope']:.3f}, {100 * f['tint_rms']:.1f} %" if "tint_slope" in f else "" for f in lamps.values()
    ]
    lines.append(["bleeding: RGB per spectral, and its rms", *slopes])
    lines.append(["light at the ball, error [%]", *[cell(f["environment_relative"], 100) for f in lamps.values()]])
    lines.append(["camera and matrix against CIE, plate, DE2000", *[cell(f["camera_delta_e"]) for f in lamps.values()]])
    return f"""## Pictures

RGB against spectral, both as camera and matrix develop them (last row: the spectral plate against what CIE sees).
All on {BOX_PX} x {BOX_PX} means. Changes: off the objects, where a channel changes by more than {100 * CHANGED:.0f} %.

{rows(["", *[f"lamps {name}" for name in lamps]], lines)}
How to read it: the pipeline takes the ground's albedo from the photograph, under the light that is there, so the row
*plate* is the simulator's cost and not the pipeline's; *spectral plate x RGB ratio* is what stays of it in a composite.
The objects' rows are the price of a colour that was chosen under D65. Light at the ball is mostly seen directly.

Limits: one camera, smooth wood, no fluorescence, no coloured glass; the matrix for D65 is used under every lamp, as a
DNG of one calibration is.
"""
