"""The page of the pose benchmark: figures in tables, curves as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.probe_page import OURS, PEER, percent, plain_ticks
from pipeline.camera.resection import SHARED_PX

COLOURS = (OURS, "#2563eb", "#0f9d76", "#d97706", "#7c3aed")
MEANT = {
    "single": "one marker 40 to 300 px wide, 0 to 65 degrees, four corners",
    "multi": "a plate with one or two of three markers of unknown layout, four views",
    "board": "24 corners of a board 180 to 600 px wide",
    "charuco": "6 to 23 of them, the rest hidden",
    "apriltag": "one tag 80 to 500 px wide",
    "points": "6 to 15 surveyed points, 0.2 to 2 mm and 0.2 to 1 px, far from the origin, a quarter coplanar",
    "colmap": "a plate without markers, from tracks of 160 points and two markers in seven further views",
}
METHOD = """## Method

- **Boards**: prints on a table, box-filtered over each pixel, through a bent lens, blurred by 0.5 to 1.1 px, noise of
  1 % of the paper's white; 480 to 560 px wide, 30 degrees off the vertical, from every side. Each lens is calibrated by
  stage calibrate from ten such photographs of 8 bits. The foot is 4 cm in front of the board. Position is over the
  distance to the board's middle. `normal_deg` and `contact_px` are the worst photograph's, lens calibrated.
- **Markers**: plain OpenCV is its detector with sub-pixel corners and `solvePnP` by `IPPE_SQUARE`, first pose, true
  lens, on the same photographs. A pose more than 10 degrees off is a flip.
- **Coverage**: corners and tracks with noise, every other lens drawn from a calibration's covariance; the squared error
  of the six numbers in units of their own covariance is held against chi-square's 95 %; of poses that are not refused.
  Corners have the noise that stage pose assumes where no board tells it (knob `corner_sigma_px`).
- **Herzjesu**: K and poses of the set. Rotations after one similarity over centres and rotations, each over its own rms
  residual; centres after the similarity of the centres alone. They lie within 16, 2.2 and 0.3 m (singular values), so
  that they leave the turn about their line open: millimetres of centres turn all cameras alike (last column).
- **Abakisita**: all 42 photographs; the board's poses by its corners and the lens that they give, COLMAP's by its
  own tracks and the lens that they give; centres after a similarity, over the distance to the board.
"""


def curves(record: dict[str, Any], path: Path) -> None:
    """Single markers over size: errors, refusals and flips; coverage by route; rendered boards."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams |= {"svg.hashsalt": "insitu", "font.size": 9, "svg.fonttype": "none"}
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.5, 7.0), layout="constrained")
    over_size(axes[0][0], record["markers"], "rot_deg", "Single marker: rotation, median [degrees]")
    over_size(axes[0][1], record["markers"], "pos_rel", "Single marker: position over distance, median")
    shares(axes[1][0], record["markers"])
    by_route(axes[1][1], record["coverage"])
    for axis in axes.ravel():
        axis.grid(alpha=0.25, which="both", linewidth=0.5)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def over_size(axis: Any, rows: list[dict[str, Any]], key: str, title: str) -> None:
    """One line per tilt, solid ours, dotted plain OpenCV."""
    for tilt, colour in zip(sorted({row["tilt_deg"] for row in rows}), COLOURS, strict=False):
        part = [row for row in rows if row["tilt_deg"] == tilt]
        size = [row["size_px"] for row in part]
        nothing = float("nan")
        for name, line in (("ours", "-o"), ("opencv", ":s")):
            values = [nothing if row[f"{name}_{key}"] is None else row[f"{name}_{key}"] for row in part]
            label = f"{tilt}°" if name == "ours" else None
            axis.loglog(size, values, line, color=colour, markersize=3, label=label)
    axis.plot([], [], ":s", color=PEER, markersize=3, label="plain OpenCV")
    plain_ticks(axis, sorted({row["size_px"] for row in rows}))
    axis.set_xlabel("side [px]")
    axis.set_title(title)
    axis.legend(frameon=False, fontsize=8, ncols=2)


def shares(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Refused and not read by ours, flipped unnoticed by either, over size, all tilts together."""
    sizes = sorted({row["size_px"] for row in rows})
    looks = {
        "refused": ("refused, ambiguous", OURS, "-o"), "unseen": ("not read", "#2563eb", "-o"),
        "ours_flipped": ("flipped, insitu", "black", "-o"), "opencv_flipped": ("flipped, plain OpenCV", PEER, ":s"),
    }  # fmt: skip
    for key, (label, colour, line) in looks.items():
        values = [
            sum(row[key] for row in rows if row["size_px"] == size)
            / sum(row["photographs"] for row in rows if row["size_px"] == size)
            for size in sizes
        ]
        axis.semilogx(sizes, values, line, color=colour, markersize=3, label=label)
    plain_ticks(axis, sizes)
    axis.set_xlabel("side [px]")
    axis.set_title("Single marker: share of photographs")
    axis.legend(frameon=False, fontsize=8)


def by_route(axis: Any, routes: dict[str, Any]) -> None:
    """Share of regions that hold the truth, with its 95 % interval."""
    for at, found in enumerate(routes.values()):
        low, high = found["interval"]
        share = found["held_95"]
        axis.errorbar([at], [share], [[share - low], [high - share]], fmt="o", color=OURS, capsize=4, markersize=5)
    axis.axhspan(0.90, 0.98, color="black", alpha=0.06)
    axis.set_xticks(range(len(routes)), list(routes))
    axis.set_ylim(0.85, 1.0)
    axis.set_title("95 % regions that hold the truth")


def table_head(names: tuple[str, ...]) -> list[str]:
    """The first two lines of a table."""
    return [f"| {' | '.join(names)} |", "|" + " --- |" * len(names)]


def promised(record: dict[str, Any]) -> list[str]:
    """What was asked and what was measured."""
    real = record["real"]
    plain = real["herzjesu"].get("pycolmap", {})
    rows = [
        ("reprojection, median", f"{record['reproj_px']:.3f} px", "0.2 px"),
        ("rotation, median", f"{record['rot_deg_30']:.4f}°", "0.05°"),
        ("position over distance, median", percent(record["pos_rel_30"]), "0.1 %"),
        ("position, lens calibrated, median", percent(record["pos_rel_30_calibrated"]), "0.2 %"),
        ("plane's normal, lens calibrated, worst", f"{record['normal_deg']:.3f}°", "0.2°"),
        ("contact at the object's foot, lens calibrated, worst", f"{record['contact_px']:.3f} px", "0.5 px"),
    ]
    if real["herzjesu"]:
        rows += [
            ("herzjesu, rotation, K given", f"{record['herzjesu_rot_deg']:.3f}°", "0.1°"),
            (
                "herzjesu, centres, K given", f"{record['herzjesu_centre_mm']:.1f} mm",
                f"below plain pycolmap's {plain['centre_mm_by_centres']:.1f} mm",
            ),
        ]  # fmt: skip
    if real["abakisita"]:
        rows += [
            ("abakisita, markers against COLMAP, median", percent(record["abakisita_rel_median"]), "0.3 %"),
            ("abakisita, 90 %", percent(real["abakisita"]["rel_p90"]), "0.6 %"),
        ]
    for name, one in real["captures"].items():
        rows += [
            (f"{name}, plate, lens estimated: rotation ({one['route']})", f"{one['rot_deg']:.3f}°", "-"),
            (f"{name}, plate, lens estimated: position over distance", percent(one["pos_rel"]), "-"),
        ]
    lines = table_head(("what", "measured", "asked"))
    return lines + [f"| {what} | {measured} | {asked} |" for what, measured, asked in rows]


def coverage_lines(routes: dict[str, Any]) -> list[str]:
    """A row per route."""
    head = ("route", "what is simulated", "poses", "refused", "held", "95 % interval", "mean chi2 of 6")
    lines = ["## Coverage", "", *table_head(head)]
    for name, found in routes.items():
        low, high = found["interval"]
        lines.append(
            f"| {name} | {MEANT[name]} | {found['trials']} | {found['refused']} | {found['held_95']:.1%} "
            f"| {low:.1%} to {high:.1%} | {found['chi2_mean']:.2f} |"
        )
    return lines


def board_lines(boards: dict[str, Any]) -> list[str]:
    """Spread of the errors of rendered boards, and what the corners' noise is beside what is assumed."""
    names = {
        "reproj_px": "reprojection [px]", "rot_deg": "rotation [°]", "pos_rel": "position over distance",
        "normal_deg": "normal [°]", "contact_px": "contact [px]",
    }  # fmt: skip
    head = ("", "median", "95 %", "worst", "calibrated: median", "95 %", "worst")
    lines = [f"## {boards['photographs']} rendered boards", "", *table_head(head)]
    lenses, parts = ("true_lens", "calibrated_lens"), ("median", "p95", "worst")
    for key, name in names.items():
        shown = [f"{boards[lens][key][part]:.2g}" for lens in lenses for part in parts]
        lines.append(f"| {name} | " + " | ".join(shown) + " |")
    return [
        *lines, "",
        f"Corners have an error of {boards['corner_rms_px']:.3f} px rms ({boards['corner_bias_px']:.4f} px in the mean "
        f"of all, {boards['corner_mean_rms_px']:.3f} px rms in a photograph's mean); stage pose takes "
        f"what a board's residuals say, and {SHARED_PX:g} px that its corners may have in common. Of the 95 % regions "
        f"{boards['true_lens']['held_95']:.0%} hold the truth with the true lens, "
        f"{boards['calibrated_lens']['held_95']:.0%} with a calibrated one.",
    ]  # fmt: skip


def real_lines(real: dict[str, Any]) -> list[str]:
    """Photographs that were taken."""
    lines = ["## Herzjesu", ""]
    if not real["herzjesu"]:
        return [*lines, "Its photographs were not there."]
    lines += [
        "| | centres [mm] | rotation [°] | worst | by centres alone: centres [mm] | rotation [°] |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    names = {"with_K": "insitu, K given", "pycolmap_with_K": "its start: pycolmap, K given",
             "pycolmap": "plain pycolmap, no K"}  # fmt: skip
    for name, text in names.items():
        one = real["herzjesu"][name]
        lines.append(
            f"| {text} | {one['centre_mm']:.1f} | {one['rot_deg']:.3f} | {one['rot_deg_worst']:.3f} "
            f"| {one['centre_mm_by_centres']:.1f} | {one['rot_deg_by_centres']:.3f} |"
        )
    return lines


def write_page(record: dict[str, Any], folder: Path) -> None:
    """pose.md and its picture, pose.svg."""
    curves(record, folder / "pose.svg")
    spent = ", ".join(f"{name} {seconds:.0f}" for name, seconds in record["cpu_seconds"].items())
    flips = [sum(row[key] for row in record["markers"]) for key in ("ours_flipped", "opencv_flipped", "photographs")]
    lines = [
        "# Where the camera was",
        "",
        f"Made by `make bench-pose` with {record['threads']} threads (CPU seconds of a machine with other work to do: "
        f"{spent}); every figure is in [pose.json](pose.json).",
        "",
        "![errors and refusals of single markers, coverage of every route](pose.svg)",
        "",
        *promised(record),
        "",
        *coverage_lines(record["coverage"]),
        "",
        *board_lines(record["boards"]),
        "",
        "## Single markers",
        "",
        f"Of {flips[2]} photographs, {flips[0]} poses flipped unnoticed here and {flips[1]} with plain OpenCV.",
        "",
        *real_lines(record["real"]),
        "",
        METHOD,
    ]
    (folder / "pose.md").write_text("\n".join(lines).rstrip() + "\n")
