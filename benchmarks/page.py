"""The page of the render benchmark: figures in words and tables, curves as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scenes import SCENES

LOOK = {  # strategy: label, colour, marker, line
    "naive": ("two renders", "#888888", "o", "-"),
    "cycles": ("Cycles, no denoiser", "#d97706", "s", "-"),
    "cycles_oidn": ("Cycles + OIDN", "#d97706", "D", ":"),
    "difference": ("difference, every pixel", "#2563eb", "o", "-"),
    "region": ("difference, region", "#0f9d76", "^", "-"),
    "insitu": ("insitu: region + denoiser", "#b91c6b", "*", "-"),
}
METHOD = """## Method

One run, one machine, the same scenes, the same number of threads. Cost is process CPU seconds of all threads, without
loading the scene and compiling kernels; it moves by a quarter with what else the machine does, so replicates of the
strategies take turns and medians are given. Error is the mean squared error over all pixels and channels in code values
(0 to 255, not rounded) of the sRGB curve after an exposure that puts the median of the plate's green channel at 0.18.
The truth is two independent renders A and B of the difference strategy, 12 vertices deep: `mean (X - A)(X - B)` is the
error of X without the noise of either; in `glass_mirror` the sun is traced from its own side too, else the references
would lack the caustics. Whatever a strategy leaves out (deeper paths, the region's outside, what a
denoiser smears) counts as error. The plate is LS_noobj itself (closed form; in `corner` a long render), the same for
all, so that the error is the render's alone. The error is taken on every third pixel in both directions. There alone
the two strategies that treat all pixels alike are traced, their cost counted ninefold; all others render the whole.

- **two renders**: path tracing of LS_obj and LS_noobj, {naive_depth} vertices, no Russian roulette, multijittered
  samples, random numbers of their own; composite `plate + LS_obj - LS_noobj` beside the objects. The same kernels as
  insitu's reference strategy.
- **difference, every pixel**: insitu's estimator alone, unbiased: no region, no denoiser, {naive_depth} vertices, no
  light tracing.
- **region**: the same with region, interpolation, light tracing and passes as the render stage makes them, not
  denoised.
- **insitu**: that, denoised: what the render stage delivers with the knobs of preview, after each pass. The
  photograph's noise is taken to be 1 % of the radiance.
- **Cycles** (Blender {version}): shadow catcher, 8 bounces, box filter, no clamp, no adaptive sampling. Its cost
  is the slope of CPU seconds by samples, without the fixed cost of a frame.

A speed-up is the ratio of CPU seconds at equal error: a strategy's own seconds at its largest sample count, against
those at which the other reaches the same error on its own curve, continued as 1 / time. For region and denoiser, which
are biased, it holds at that error and not beyond.
"""


def curves(record: dict[str, Any], path: Path) -> None:
    """Error over CPU seconds of each scene, both logarithmic."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams |= {"svg.hashsalt": "insitu", "font.size": 9, "svg.fonttype": "none"}
    import matplotlib.pyplot as plt

    names = [name for name in SCENES if name in record]
    figure, axes = plt.subplots(1, len(names), figsize=(3.6 * len(names), 3.9), squeeze=False, layout="constrained")
    for axis, name in zip(axes[0], names, strict=True):
        for strategy, (label, colour, marker, line) in LOOK.items():
            points = record[name]["curves"].get(strategy)
            if not points:
                continue
            seconds, errors = ([p[key] for p in points] for key in ("cpu_s", "error"))
            axis.loglog(seconds, errors, line, color=colour, marker=marker, label=label, markersize=5)
            if strategy in ("naive", "cycles", "difference"):  # without bias: on as one over time
                far = [seconds[-1], seconds[-1] * 30]
                axis.loglog(far, [errors[-1], errors[-1] / 30], ":", color=colour, linewidth=0.8)
        axis.set_title(name)
        axis.set_xlabel("CPU seconds")
        axis.grid(alpha=0.25, which="both", linewidth=0.5)
    axes[0][0].set_ylabel("squared error [code values²]")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def number(value: float | None, digits: int = 1) -> str:
    """A figure, or a dash when it was not measured."""
    return "-" if value is None else f"{value:.{digits}f}"


def table(record: dict[str, Any]) -> list[str]:
    """Speed-ups by scene."""
    lines = [
        "| scene | estimator alone / two renders | with region | as delivered | estimator alone / Cycles "
        "| as delivered / Cycles |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    keys = ("over_naive_estimator", "over_naive_region", "over_naive", "over_cycles_estimator", "over_cycles")
    for name in SCENES:
        if name in record:
            lines.append(f"| {name} | " + " | ".join(number(record[name][f"speedup_{key}"]) for key in keys) + " |")
    return lines


def points(record: dict[str, Any], name: str) -> list[str]:
    """Every point of a scene's curves."""
    lines = ["| strategy | samples | CPU s | RMSE / 255 |", "| --- | --- | --- | --- |"]
    for strategy, (label, *_) in LOOK.items():
        for p in record[name]["curves"].get(strategy, []):
            lines.append(f"| {label} | {p['samples']} | {p['cpu_s']:.2f} | {max(p['error'], 0) ** 0.5:.2f} |")
    return lines


def bias(record: dict[str, Any]) -> list[str]:
    """What the test for bias found, in words."""
    found = record.get("zscore")
    if not found:
        return ["Largest z of a tile's mean against the reference strategy: " + number(record["zscore_max"]) + "."]
    light, codes = found["light_traced"], {row["code"] for row in found["scenes"]}
    lines = [
        "",
        f"`python -m benchmarks.zscore` ({found['cpu_s']:.0f} CPU s): the fast strategy against two full path-traced "
        f"renders on {found['number_of_scenes']} random scenes, tiles of 8 x 8 pixels, three channels of change and "
        f"three of objects. Largest z {found['zscore_max']:.2f} (limit 5), mean square "
        f"{found['zscore_square_mean']:.2f} +- {square_sigma(found['scenes']):.2f}, by the scatter of scenes, of "
        f"{found['tile_channels_tested']} (expected: 1); "
        f"{found['tile_channels_changed']} of the change are over 1 % of LS_noobj, and in "
        f"{found['oracle_reached_changed']:.0%} of these the oracle's standard error is at most 1 % of the change "
        f"(largest {found['oracle_rel_error_max']:.1%}). A bias of {found['smallest_detectable_bias_rel']:.1%} "
        f"of the change would be seen in the median tile, of {found['smallest_detectable_bias_rel_p90']:.1%} in nine "
        f"of ten, and of {found['smallest_detectable_common_bias_rel']:.2%} if all share it; found: "
        f"{found['common_bias_rel']:+.2%}. Measured with the code of digest {', '.join(sorted(codes))}.",
    ]
    if light:
        traced = [row["light_traced"] for row in found["scenes"] if "light_traced" in row]
        lines.append(
            f"With light tracing, on the {light['number_of_scenes']} scenes with a compact light: largest z "
            f"{light['zscore_max']:.2f}, mean square {light['zscore_square_mean']:.2f} +- {square_sigma(traced):.2f}."
        )
    return lines


def square_sigma(scenes: list[dict[str, Any]]) -> float:
    """Standard error of the mean z^2 of all tiles, by the scatter of scenes: tiles of one scene share its light."""
    weight = np.array([row["tested"] for row in scenes], float)
    value = np.array([row["zscore_square_mean"] for row in scenes])
    off = weight * (value - weight @ value / weight.sum())
    return float(np.sqrt((off**2).sum() * len(scenes) / max(len(scenes) - 1, 1)) / weight.sum())


def write_page(record: dict[str, Any], folder: Path) -> None:
    """render.md and its picture, render.svg."""
    curves(record, folder / "render.svg")
    names = [name for name in SCENES if name in record]
    peers = [record[name]["cycles"] for name in names if record[name]["cycles"]]
    version = peers[0]["version"] if peers else "not installed"
    width, height = record["size"]
    lines = [
        "# How fast the render is",
        "",
        f"CPU seconds at equal error, {width} x {height} pixels, {record['threads']} threads. Made by",
        "`make bench-render`; every figure is in [render.json](render.json).",
        "",
        "![error over CPU seconds](render.svg)",
        "",
        *table(record),
        "",
    ]
    if "seconds" in record:
        each = ", ".join(f"{name} {part['wall_s']:.0f}" for name, part in record["seconds"].items())
        lines += [f"Measured in {record['wall_s']:.0f} s: {each}.", ""]
    if record.get("remark"):
        lines += [record["remark"], ""]
    if not peers:
        lines += ["Cycles was left out: `make bench-cycles-env` installs it in an environment of its own.", ""]
    if "preview_cpu_s" in record:
        cold = record.get("preview_cold_cpu_s")
        lines.append(
            f"First complete composite of diffuse_glossy from a loaded scene, knobs of draft: "
            f"{record['preview_cpu_s']:.1f} CPU s, RMSE {record['preview_rmse_255']:.2f} / 255"
            + (f"; with nothing compiled yet {cold:.1f} CPU s." if cold is not None else ".")
        )
    if "tiny" in record:
        tiny = record["tiny"]
        lines.append(
            "The render stage on 24 Mpx over that on a crop of 1 Mpx, same object: "
            f"{record['tiny_24mpx_over_1mpx']:.2f} ({tiny['large_cpu_s']:.1f} and {tiny['small_cpu_s']:.1f} CPU s)."
        )
    lines += [
        *bias(record),
        "",
        METHOD.format(naive_depth=8, version=version),
        "## Scenes",
        "",
        "| scene | map, max / median | sun, share of red | noise of a reference [code values²] |",
        "| --- | --- | --- | --- |",
    ]
    for name in names:
        light = record[name]["map"]
        lines.append(
            f"| {name} | {light['map_max_over_median']:.1e} | {light['sun_share_red']:.0%} "
            f"| {record[name]['reference_noise']:.2f} |"
        )
    for name in names:
        doc = (SCENES[name].__doc__ or "").strip()
        lines += ["", f"### {name}", "", doc, "", *points(record, name)]
        peer = record[name]["cycles"]
        if peer:
            pairs = zip(peer["mean"], peer["reference_mean"], strict=True)
            lines += [
                "",
                "Cycles and the reference: mean of the picture "
                + ", ".join(f"{a:.2f} / {b:.2f}" for a, b in pairs)
                + f" (R, G, B); means of 64 pixels differ by {peer['tiles_median']:.2f} (median), "
                f"{peer['tiles_p99']:.2f} (99 %), noise included. Fixed cost of a frame: "
                f"{peer['fixed_cpu_s']:.1f} CPU s.",
            ]
    (folder / "render.md").write_text("\n".join(lines) + "\n")
