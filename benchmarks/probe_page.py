"""The page of the probe benchmark: figures in words and tables, curves as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

OURS, PEER = "#b91c6b", "#888888"
METHOD = """## Method

- **Fit**: ray-traced balls on a table, lens blur, noise of 0.5 %, in pixels of known covariance; errors are of the
  mirrored direction, root mean square over the disc inside 0.9 of the radius. The peer fits a circle, exactly, and
  takes the camera to be infinitely far, as HDRShop's and most scripts' unwraps do.
- **Unwrap**: balls of known place under a smooth sky and a sun of 0.53 degrees, 1e5 times as bright, at up to four
  angles; maps of 1024 x 512. The error of the irradiance is the largest over 200 normals of what nine harmonics give,
  over the mean; once with the sun, once of the sky alone (*split*), as when the sun is a light of its own. Only light
  outside the cone that no ball of that distance mirrors is counted.
- **Clipped sun**: the whole stage on photographs in which the sun is clipped at 30 times the mean sky in every frame of
  the ball; evidence is the ball's shadow on the plane in the tripod's photograph.
- **Captures**: the whole chain from RAW files, poses and lens estimated, against the true environment at the ball. The
  peer has the true circle, the estimated camera and the ball's reflectance, one view, and the mean where it is blind.
- **Real balls**: JPEG crops without board or lens, by `insitu ball`.
"""


def curves(record: dict[str, Any], path: Path) -> None:
    """Directions over distance, angle and size; irradiance over size; clipped sun over contrast."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams |= {"svg.hashsalt": "insitu", "font.size": 9, "svg.fonttype": "none"}
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.5, 7.0), layout="constrained")
    over_distance(axes[0][0], record["fit"])
    over_size(axes[0][1], record["fit"])
    over_radius(axes[1][0], record["unwrap"])
    over_contrast(axes[1][1], record["flux"])
    for axis in axes.ravel():
        axis.grid(alpha=0.25, which="both", linewidth=0.5)
        axis.legend(frameon=False, fontsize=8, ncols=2 if len(axis.lines) > 4 else 1)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def over_distance(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Direction error over D / R, one line per angle off the axis."""
    chosen = [row for row in rows if row["radius_px"] == 100 and row["blur"] < 1]
    for angle, line in zip(sorted({row["off_axis_deg"] for row in chosen}), ("-", "--", ":"), strict=False):
        part = sorted((row for row in chosen if row["off_axis_deg"] == angle), key=lambda row: row["distance_ratio"])
        ratio = [row["distance_ratio"] for row in part]
        ours, peer = ([row[key] for row in part] for key in ("direction_rms_deg", "orthographic_rms_deg"))
        axis.loglog(ratio, ours, line, color=OURS, marker="o", markersize=4, label=f"insitu, {angle:g}° off axis")
        axis.loglog(ratio, peer, line, color=PEER, marker="s", markersize=4, label=f"circle, far camera, {angle:g}°")
    axis.axhline(0.3, color="black", linewidth=0.6)
    axis.set_title("Directions, ball of 100 px radius")
    axis.set_xlabel("distance over radius")
    plain_ticks(axis, sorted({row["distance_ratio"] for row in chosen}))
    axis.set_ylabel("rms [degrees]")


def plain_ticks(axis: Any, values: list[float]) -> None:
    """Ticks at the measured places of a logarithmic axis, as plain numbers."""
    axis.set_xticks(values, [f"{value:g}" for value in values])
    axis.set_xticks([], minor=True)


def over_size(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Direction error, and what the fit says of it, over the radius in pixels."""
    part = [row for row in rows if row["distance_ratio"] == 10 and row["off_axis_deg"] == 0 and row["blur"] < 1]
    part = sorted(part, key=lambda row: row["radius_px"])
    size = [row["radius_px"] for row in part]
    axis.loglog(size, [row["direction_rms_deg"] for row in part], "-o", color=OURS, markersize=4, label="insitu")
    axis.loglog(size, [row["sigma"] for row in part], ":", color=OURS, label="stated")
    axis.loglog(size, [row["orthographic_rms_deg"] for row in part], "-s", color=PEER, markersize=4, label="circle")
    axis.axhline(0.3, color="black", linewidth=0.6)
    axis.set_title("Directions, 10 radii away")
    axis.set_xlabel("radius [px]")
    plain_ticks(axis, size)


def over_radius(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Irradiance error over the radius in pixels, with the sun and of the sky alone."""
    looks = {"ours": (OURS, "insitu"), "orthographic": (PEER, "one lookup"), "skylibs": ("#d97706", "skylibs")}
    for method, (colour, label) in looks.items():
        for key, line, what in (("sh_rel_err", "-", "with sun"), ("split_sh_rel_err", ":", "sky alone")):
            part = [row for row in rows if row["method"] == method and row["distance_over_radius"] < 100]
            if part:
                size = [row["radius_px"] for row in part]
                values = [row[key] for row in part]
                axis.loglog(size, values, line, color=colour, marker="o", markersize=4, label=f"{label}, {what}")
    axis.axhline(0.01, color="black", linewidth=0.6)
    axis.set_title("Irradiance, ball 8 radii away")
    axis.set_xlabel("radius [px]")
    axis.set_ylim(top=30)  # room for the legend
    plain_ticks(axis, sorted({row["radius_px"] for row in rows}))
    axis.set_ylabel("largest error over mean")


def over_contrast(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Recovered flux of a clipped sun over its contrast, one line per elevation, with two stated sigma."""
    for elevation, colour in zip(
        sorted({row["elevation_deg"] for row in rows}), ("#2563eb", OURS, "#0f9d76"), strict=False
    ):
        part = [row for row in rows if row["elevation_deg"] == elevation and row["flux_rel_err"] is not None]
        if part:
            axis.errorbar(
                [row["contrast"] for row in part], [row["flux_rel_err"] for row in part],
                [2 * row["flux_sigma"] for row in part], color=colour, marker="o", markersize=4, capsize=3,
                label=f"sun {elevation:g}° high",
            )  # fmt: skip
    axis.set_xscale("log")
    axis.axhspan(-0.03, 0.03, color="black", alpha=0.06)
    axis.set_title("Flux of a clipped sun, error and 2 σ")
    axis.set_xlabel("radiance over the sky's")


def percent(value: float | None) -> str:
    """A fraction as a percentage, or a dash."""
    return "-" if value is None else f"{100 * value:.2f} %"


def summary(record: dict[str, Any]) -> list[str]:
    """What was promised and reached."""
    flux, peers = record["flux_summary"], record["peers"]
    rows = [
        ("direction, rms inside 0.9 R, worst cell from 100 px", 0.3, f"{record['direction_rms_deg']:.3f}°",
         f"{peers['orthographic']['direction_rms_deg']:.1f}°", "0.3°"),
        ("irradiance of the map, worst cell", 0.01, percent(record["sh_rel_err"]),
         percent(peers["orthographic"]["sh_rel_err"]), "1 %"),
        ("energy of a sun in the map, from 500 px", None, percent(record["sun_rel_err"]),
         percent(peers["orthographic"]["sun_rel_err"]), "-"),
        (f"flux of a clipped sun, worst of {flux.get('with_evidence', 0)} stated to 10 % or better", 0.03,
         percent(record["sun_flux_rel_err"]), "-", "3 %"),
        ("24 Mpx photograph, R = 1500 px, to 2048 x 1024", None, f"{record['unwrap_s_24mpx']:.2f} s", "-", "2 s"),
    ]  # fmt: skip
    for name, capture in record["captures"].items():
        rows.append(
            (f"{name}, irradiance, nine harmonics", None, percent(capture["sh_rel_err"]),
             percent(capture["orthographic"]["sh_rel_err"]), "3 %" if name == "kitchen_table" else "-")
        )  # fmt: skip
        rows.append(
            (f"{name}, irradiance, worst of six sides", None, percent(capture["worst_side_rel_err"]),
             percent(capture["orthographic"]["worst_side_rel_err"]), "-")
        )  # fmt: skip
    lines = ["| what | insitu | circle and far camera | wanted |", "| --- | --- | --- | --- |"]
    return lines + [f"| {what} | {ours} | {peer} | {wanted} |" for what, _, ours, peer, wanted in rows]


def real_lines(found: dict[str, Any]) -> list[str]:
    """What real photographs gave."""
    lines = ["## Real balls", ""]
    for name, one in found.items():
        if "refused" in one:
            lines.append(f"- `{name}`: refused: {one['refused']}")
            continue
        text = f"- `{name}`: radius {one['circle_px'][2]:.0f} px, {len(one['lamps'])} lights, "
        text += f"{percent(one['clipped_fraction'])} of the ball clipped in every frame (a lower bound)"
        if "lamps_worst_deg" in one:
            text += (
                f"; its lights agree with the set's own map to {one['lamps_worst_deg']:.1f} degrees after one rotation"
            )
        lines.append(text + ".")
    return lines if found else [*lines, "Their photographs were not there."]


def write_page(record: dict[str, Any], folder: Path) -> None:
    """probe.md and its picture, probe.svg."""
    curves(record, folder / "probe.svg")
    cover = record["coverage"]
    lines = [
        "# How right the light is",
        "",
        f"Made by `make bench-probe` with {record['threads']} threads, in about ten minutes; every figure is in",
        "[probe.json](probe.json).",
        "",
        "![errors of directions, irradiance and a clipped sun](probe.svg)",
        "",
        *summary(record),
        "",
        f"Of {cover['balls']} simulated balls, 3 to 50 radii away, up to 30 degrees off the axis and 30 to 150 px in "
        f"radius, {cover['held_95']:.0%} have their true centre in the stated 95 % region, {cover['held_68']:.0%} in "
        "that of 68 %.",
        "",
        "## Small balls",
        "",
        "With the plane, 5 to 30 radii away, up to 20 degrees off the axis, blurred by 0.4 to 1.2 px; degrees.",
        "",
        "| radius [px] | balls | rms | median | 90 % | above 1° | stated, median | in the stated 95 % region |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
        *[
            f"| {row['radius_px']:g} | {row['balls']} | {row['direction_rms_deg']:.2f} "
            f"| {row['direction_median_deg']:.2f} | {row['direction_p90_deg']:.2f} | {row['above_1_deg']:.0%} "
            f"| {row['sigma_median_deg']:.2f} | {row['held_95']:.0%} |"
            for row in record["small"]
        ],
        "",
        "## Unwrap",
        "",
        "| radius [px] | distance / R | method | irradiance with sun | sky alone | sun | CPU s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {row['radius_px']} | {row['distance_over_radius']} | {row['method']} | {percent(row['sh_rel_err'])} "
        f"| {percent(row['split_sh_rel_err'])} | {percent(row['sun_rel_err'])} | {row['cpu_s']:.2f} |"
        for row in record["unwrap"]
    ]
    lines += ["", "## Clipped sun", "", "| elevation | contrast | clipped by | error | stated | why not |"]
    lines.append("| --- | --- | --- | --- | --- | --- |")
    lines += [
        f"| {row['elevation_deg']:g}° | {row['contrast']:.0e} | {row['clipped_by']:.0f} x "
        f"| {percent(row['flux_rel_err'])} | {percent(row['flux_sigma'])} | {row['why'] or ''} |"
        for row in record["flux"]
    ]
    lines += ["", *real_lines(record["real"]), "", METHOD]
    if not any(row["method"] == "skylibs" for row in record["unwrap"]):
        lines += ["skylibs was left out: `make bench-skylibs-env` installs it in an environment of its own.", ""]
    (folder / "probe.md").write_text("\n".join(lines).rstrip() + "\n")
