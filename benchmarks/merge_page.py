"""The page of the merge benchmark: figures in words and tables, curves as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

LOOK = {  # method: label, colour
    "optimal": ("insitu, optimal", "#b91c6b"),
    "poisson": ("insitu, poisson", "#2563eb"),
    "numpy": ("counts over times, numpy", "#0f9d76"),
    "hdrutils": ("HDRutils", "#d97706"),
    "colour_hdri": ("colour-hdri", "#7c3aed"),
    "debevec": ("OpenCV Debevec, 8 bit", "#888888"),
    "robertson": ("OpenCV Robertson, 8 bit", "#444444"),
}
METHOD = """## Method

- **Sensor**: 30 000 electrons at white, read noise of 3, 14 bits, black 512, Bayer; Poisson counts, rounding and clip.
  Five frames two stops apart. Radiance runs from 5 electrons in the longest frame to the clip of the shortest.
- **Bound**: Cramer-Rao, from shot, read and rounding noise of the frames whose mean lies below white. Errors are the
  root mean square of the error times the root of the information, and the mean relative error, in bins of a third of a
  decade. In *texture* every pixel has a radiance of its own from its bin: neighbours say little.
- **Cost**: CPU time of all threads, the least of several turns, five frames in memory; the floor reads five planes of
  uint16 and writes radiance, variance (float32) and mask (uint8) into fresh memory, in as many threads. insitu
  writes the same, and pays for threads and page faults too.
- **Peers** are given the exposures; a global factor is fitted to the middle of the range. OpenCV takes 8 bits (the
  conversion is not timed), HDRutils' reading and demosaicking are left out. What is not finite counts as zero.
- **Memory**: peak resident size of a process that holds five frames of 100 megapixels, merges and replaces defects.
"""


def curves(record: dict[str, Any], path: Path) -> None:
    """RMSE over the bound and bias over the signal, ours and the peers'; cost."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams |= {"svg.hashsalt": "insitu", "font.size": 9, "svg.fonttype": "none"}
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.5, 7.0), layout="constrained")
    centres = [(row["electrons"][0] * row["electrons"][1]) ** 0.5 for row in record["accuracy"]]
    for kind, line in (("accuracy", "-"), ("texture", ":")):
        for name in ("optimal", "poisson"):
            part = [row[name] for row in record[kind]]
            label = LOOK[name][0] + (", texture" if kind == "texture" else "")
            for axis, key, scale in ((axes[0][0], "rmse_over_crb", 1), (axes[0][1], "bias", 100)):
                axis.errorbar(
                    centres, [scale * row[key] for row in part], [2 * scale * row[f"{key}_se"] for row in part],
                    linestyle=line, color=LOOK[name][1], label=label, linewidth=1, capsize=2,
                )  # fmt: skip
    axes[0][0].axhline(1.02, color="black", linewidth=0.6)
    axes[0][0].set_ylim(0.97, 1.2)
    axes[0][0].set_title("RMSE over the Cramer-Rao bound")
    axes[0][1].axhspan(-0.1, 0.1, color="black", alpha=0.06)
    axes[0][1].set_ylim(-0.2, 0.2)
    axes[0][1].set_title("Bias [%]")
    methods = record["speed"]["methods"]
    for name, (label, colour) in LOOK.items():
        if name in methods:
            values = methods[name]["rmse_over_crb"]
            axes[1][0].loglog(centres[: len(values)], values, "-o", color=colour, markersize=3, label=label)
    axes[1][0].set_title("RMSE over the bound, with peers")
    names = [name for name in LOOK if name in methods]
    axes[1][1].barh(
        [LOOK[name][0] for name in names], [methods[name]["ms_per_mpx"] for name in names],
        color=[LOOK[name][1] for name in names],
    )  # fmt: skip
    axes[1][1].axvline(record["floor_ms_per_mpx"], color="black", linewidth=0.8)
    axes[1][1].set_xscale("log")
    axes[1][1].set_title("CPU ms per megapixel; line: moving the data")
    for axis in (axes[0][0], axes[0][1], axes[1][0]):
        axis.set_xscale("log")
        axis.set_xlabel("electrons in the longest frame")
        axis.grid(alpha=0.25, which="major", linewidth=0.5)
        axis.legend(frameon=False, fontsize=8)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def summary(record: dict[str, Any]) -> list[str]:
    """What was promised and reached."""
    cost, floor = record["ms_per_mpx"], record["floor_ms_per_mpx"]
    rows = [
        ("largest bias of a bin", f"{100 * record['bias_max']:.3f} %", "0.1 %"),
        ("largest RMSE over the Cramer-Rao bound", f"{record['rmse_over_crb_max']:.4f}", "1.02"),
        ("largest error of an exposure ratio", f"{100 * record['exposure_ratio_err_max']:.3f} %", "0.3 %"),
        ("CPU ms per megapixel, five frames", f"{cost:.2f}", "-"),
        ("over the time to move the data", f"{cost / floor:.2f}", "1.5"),
        ("OpenCV's time over ours", f"{record['opencv_ms_per_mpx'] / cost:.1f}", "7"),
        ("peak memory of 5 x 100 megapixels", f"{record['peak_gib_5x100mpx']:.2f} GiB", "4 GiB"),
    ]
    lines = ["| what | reached | wanted |", "| --- | --- | --- |"]
    return lines + [f"| {what} | {reached} | {wanted} |" for what, reached, wanted in rows]


def peer_table(record: dict[str, Any]) -> list[str]:
    """One line per method on the ramp."""
    lines = [
        "| method | CPU ms / Mpx | largest bias | worst RMSE / bound | median |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, (label, _) in LOOK.items():
        row = record["speed"]["methods"].get(name)
        if row:
            ratios = sorted(row["rmse_over_crb"])
            lines.append(
                f"| {label} | {row['ms_per_mpx']:.1f} | {100 * max(abs(b) for b in row['bias']):.2f} % "
                f"| {ratios[-1]:.2f} | {ratios[len(ratios) // 2]:.2f} |"
            )
    return lines


def real_lines(found: dict[str, Any] | None) -> list[str]:
    """The bracket from files."""
    if found is None:
        return ["Its photographs were not there."]
    cost = found["ms_per_mpx"]
    costs = ", ".join(f"{LOOK[name][0]} {cost[name]:.1f}" for name in LOOK if name in cost)
    return [
        f"Five frames of `kitchen_table` ({found['frames'][0]} and longer), CPU ms per megapixel: {costs}; floor "
        f"{cost['floor']:.2f}. Apart from these: decoding the five files {found['decode_ms_per_mpx']:.0f}, writing the "
        f"EXR {found['write_ms_per_mpx']:.0f}."
    ]


def write_page(record: dict[str, Any], folder: Path) -> None:
    """merge.md and its picture, merge.svg."""
    curves(record, folder / "merge.svg")
    lines = [
        "# How good and how fast the merge is",
        "",
        f"Made by `make bench-merge` with {record['threads']} threads; every figure is in [merge.json](merge.json).",
        "",
        "![errors over the bound, bias and cost](merge.svg)",
        "",
        *summary(record),
        "",
        "## By brightness",
        "",
        "| electrons in the longest frame | Mpx | bias | RMSE / bound | in texture | Poisson weights |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row, rough in zip(record["accuracy"], record["texture"], strict=True):
        best = row["optimal"]
        lines.append(
            f"| {row['electrons'][0]:.0f} to {row['electrons'][1]:.0f} | {row['pixels'] / 1e6:.0f} "
            f"| {100 * best['bias']:+.3f} ± {100 * best['bias_se']:.3f} % "
            f"| {best['rmse_over_crb']:.4f} ± {best['rmse_over_crb_se']:.4f} "
            f"| {rough['optimal']['rmse_over_crb']:.4f} | {row['poisson']['rmse_over_crb']:.4f} |"
        )
    lines += ["", "## Peers, on one ramp over the whole range", "", *peer_table(record), ""]
    lines += [*real_lines(record["real"]), "", METHOD]
    if not any(name in record["speed"]["methods"] for name in ("hdrutils", "colour_hdri")):
        lines += ["HDRutils and colour-hdri were left out: `make bench-merge-env` installs them.", ""]
    (folder / "merge.md").write_text("\n".join(lines).rstrip() + "\n")
