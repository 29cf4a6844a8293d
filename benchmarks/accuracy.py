"""docs/accuracy.md: every figure that is promised, beside what records of real runs say of it. Nothing is run here.

``python -m benchmarks.accuracy`` reads docs/benchmarks/*.json, docs/numerics.json and the tables of docs/figures.md; a
figure that no record holds is said to be not measured. Figures that tests alone hold name the test.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
Records = dict[str, Any]
Value = Callable[[Records], float]
CLASSES = ("pixels", "region means")  # of places, as the coverage's record has them
CAPTURES = 100  # of a kind, from which on its coverage is a figure
APART = ("object pixels", "shadow pixels", "object means", "shadow means")


@dataclass(frozen=True)
class Promise:
    """A figure: what is asked, where a record holds it, and the command that makes the record."""

    stage: str
    what: str
    limit: float
    read: Value | None  # None: a test holds it
    source: str  # the command, or the test
    least: bool = False  # the limit is one from below
    unit: str = ""


def at(record: str, *path: str) -> Value:
    """A number of a record under docs/benchmarks, by its keys."""

    def read(records: Records) -> float:
        found = records[record]
        for key in path:
            found = found[key]
        return float(found)

    return read


def over(above: Value, below: Value) -> Value:
    """A ratio of two."""
    return lambda records: above(records) / below(records)


def cell(capture: str, quality: str, column: str) -> Value:
    """A number of the first table of docs/figures.md; of "133.6 (227.6)" the first."""
    return lambda records: float(records["figures"][capture, quality][column].split()[0])


def of_routes(choose: Callable[[list[float]], float]) -> Value:
    """The least or the largest coverage of the routes to a pose."""

    def read(records: Records) -> float:
        shares = records["pose"]["coverage95"].values()
        return float(choose([share["share"] if isinstance(share, dict) else share for share in shares]))

    return read


def extremes(records: Records) -> float:
    """Share of the extreme cases that were seen as defined."""
    rows = records["numerics"]
    return sum(row["ok"] for row in rows) / len(rows)


def of_kind(records: Records, kind: str) -> Records:
    """What the coverage's record says of a kind. Raises ValueError when too few captures of it were built."""
    found: Records = records["budget"]["kinds"][kind]
    if found["captures"] < CAPTURES:
        raise ValueError(f"budget: {found['captures']} captures of {kind}, needed {CAPTURES}")
    return found


def bounded(kind: str) -> Value:
    """Least share, over kinds of places, of errors within 1.96 sigma and the bound that is named as not covered."""
    return lambda records: float(min(of_kind(records, kind)["bounded"].values()))


def intervals(kind: str | None, places: tuple[str, ...]) -> Value:
    """How many of the intervals of some places (three shares each) hold the truth as often as they state.

    Of one kind of captures, or of all that are pooled.
    """

    def read(records: Records) -> float:
        found = of_kind(records, kind)["coverage"] if kind else records["budget"]["pooled"]
        return float(sum(holds for place in places for holds in found[place]["truth"]["holds"].values()))

    return read


MERGE, PROBE, RENDER, POSE, FIGURES = (
    f"`make {target}`" for target in ("bench-merge", "bench-probe", "bench-render", "bench-pose", "figures")
)
PROMISES = [
    Promise("merge", "bias, worst bin of 1/3 decade", 0.001, at("merge", "bias_max"), MERGE),
    Promise("merge", "RMSE over the Cramer-Rao bound, worst bin", 1.02, at("merge", "rmse_over_crb_max"), MERGE),
    Promise("merge", "exposure ratios, worst", 0.003, at("merge", "exposure_ratio_err_max"), MERGE),
    Promise(
        "merge", "CPU over that of moving the data", 1.5,
        over(at("merge", "ms_per_mpx"), at("merge", "floor_ms_per_mpx")), MERGE,
    ),
    Promise(
        "merge", "OpenCV's MergeDebevec over ours, CPU", 7,
        over(at("merge", "opencv_ms_per_mpx"), at("merge", "ms_per_mpx")), MERGE, least=True,
    ),
    Promise("merge", "peak memory of 5 x 100 Mpx", 4, at("merge", "peak_gib_5x100mpx"), MERGE, unit="GiB"),
    Promise("calibrate", "reprojection", 0.2, at("pose", "reproj_px"), POSE, unit="px"),
    Promise("pose", "rotation, median, board of 480 px at 30 degrees, true lens", 0.05, at("pose", "rot_deg_30"), POSE,
            unit="deg"),
    Promise("pose", "position over distance, median, likewise", 0.001, at("pose", "pos_rel_30"), POSE),
    Promise("pose", "likewise, lens calibrated from the capture", 0.002, at("pose", "pos_rel_30_calibrated"), POSE),
    Promise("pose", "95 % regions hold the truth, least of all routes", 0.90, of_routes(min), POSE, least=True),
    Promise("pose", "95 % regions hold the truth, most of all routes", 0.98, of_routes(max), POSE),
    Promise("plane", "normal", 0.2, at("pose", "normal_deg"), POSE, unit="deg"),
    Promise("plane", "contact", 0.5, at("pose", "contact_px"), POSE, unit="px"),
    Promise("probe", "direction, rms inside r < 0.9, radius >= 100 px", 0.3, at("probe", "direction_rms_deg"), PROBE,
            unit="deg"),
    Promise("probe", "irradiance of the harmonics, lights split", 0.01, at("probe", "sh_rel_err"), PROBE),
    Promise("probe", "energy of a clipped sun with evidence", 0.03, at("probe", "sun_flux_rel_err"), PROBE),
    Promise("reflectance", "albedo given the true light", 0.01, None,
            "`test_reflectance::test_plane_under_distant_light_is_closed_form`"),
    Promise("reflectance", "albedo end to end, desk, preview", 0.02, cell("desk", "preview", "albedo"), FIGURES),
    Promise("reflectance", "albedo end to end, kitchen_table, preview", 0.02,
            cell("kitchen_table", "preview", "albedo"), FIGURES),
    Promise("reflectance", "albedo in a corner", 0.02, None,
            "`test_reflectance_bounces::test_damped_iteration_reaches_one_percent_within_eight_steps`"),
    Promise("render", "two renders over ours, equal error, diffuse and glossy", 50,
            at("render", "diffuse_glossy", "speedup_over_naive"), RENDER, least=True),
    Promise("render", "Cycles' shadow catcher over ours, likewise", 20,
            at("render", "diffuse_glossy", "speedup_over_cycles"), RENDER, least=True),
    Promise("render", "two renders over ours, glass and mirror", 20,
            at("render", "glass_mirror", "speedup_over_naive"), RENDER, least=True),
    Promise("render", "Cycles' shadow catcher over ours, likewise", 10,
            at("render", "glass_mirror", "speedup_over_cycles"), RENDER, least=True),
    Promise("render", "first complete preview at 720p, CPU", 3, at("render", "preview_cpu_s"), RENDER, unit="s"),
    *(
        Promise("whole", f"{what}, {capture}, {quality}", limit, cell(capture, quality, column), FIGURES)
        for capture, limits in (("desk", (0.02, 0.08)), ("kitchen_table", (0.05, 0.15)))
        for quality in ("final", "preview", "draft")
        for (what, column), limit in zip((("object", "object"), ("shadow change", "shadow change")), limits)
    ),
    Promise("whole", "draft of desk, wall", 15, cell("desk", "draft", "seconds"), FIGURES, unit="s"),
    Promise("whole", "--help, --version and refused manifests, wall", 0.3, None,
            "`test_cli::test_quick_answers_are_quick_and_leave_numpy_alone`", unit="s"),
    *(
        Promise("uncertainty", f"intervals of {3 * len(places)} that hold: {what}, 100 captures of {name}",
                3 * len(places), intervals(kind, places), "`make bench-budget`", least=True)
        for what, places in (("pixels, region means", CLASSES), ("objects and shadows apart", APART))
        for name, kind in (("desk", "desk"), ("courtyard", "courtyard"), ("rooms", "rooms"), ("each, pooled", None))
    ),
    Promise("uncertainty", "intervals of 6 that hold: pixels, region means, 100 captures of corner", 6,
            intervals("corner", CLASSES), "`make bench-budget`", least=True),
    Promise("uncertainty", "errors within 1.96 sigma and the bound that is named, 100 captures of corner",
            0.95, bounded("corner"), "`make bench-budget`", least=True),
    Promise("extremes", "cases seen as they were defined", 1.0, extremes, "`make extremes`", least=True),
]  # fmt: skip


def figures(text: str) -> dict[tuple[str, str], dict[str, str]]:
    """Rows of the first table of docs/figures.md by capture and quality."""
    lines = [line for line in text.split("\n\n## ")[0].splitlines() if line.startswith("|")]
    cells = [[part.strip() for part in line.strip("|").split("|")] for line in lines]
    return {(row[0], row[1]): dict(zip(cells[0], row)) for row in cells[2:]}


def collected(docs: Path = DOCS) -> Records:
    """Every record there is."""
    found: Records = {path.stem: json.loads(path.read_text()) for path in sorted(docs.glob("benchmarks/*.json"))}
    if (docs / "numerics.json").exists():
        found["numerics"] = json.loads((docs / "numerics.json").read_text())
    found["figures"] = figures((docs / "figures.md").read_text())
    return found


def judged(promise: Promise, records: Records) -> tuple[str, str]:
    """What was measured, and "met", "missed" or why neither."""
    if promise.read is None:
        return "-", "held by a test"
    try:
        value = promise.read(records)
    except (KeyError, TypeError, ValueError):
        return "-", "not measured"
    met = value >= promise.limit if promise.least else value <= promise.limit
    return f"{value:.4g} {promise.unit}".strip(), "met" if met else "**missed**"


def page(records: Records) -> str:
    """docs/accuracy.md."""
    lines = [
        "# Accuracy",
        "",
        "Written by `make accuracy` from the records of real runs in `docs/`, without running anything: each figure",
        "that is promised beside the last one measured, and the command that measures it. Conditions stand on the",
        "pages of those commands: [merge](benchmarks/merge.md), [probe](benchmarks/probe.md),",
        "[render](benchmarks/render.md), [whole](figures.md), [extremes](numerics.md). Fractions unless a unit is",
        "given.",
        "",
        "| stage | figure | promised | measured | | by |",
        "|---|---|---|---|---|---|",
    ]
    for promise in PROMISES:
        measured, verdict = judged(promise, records)
        limit = f"{'>=' if promise.least else '<='} {promise.limit:g} {promise.unit}".strip()
        lines.append(f"| {promise.stage} | {promise.what} | {limit} | {measured} | {verdict} | {promise.source} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(page(collected()))
