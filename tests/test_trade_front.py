"""What is made of measured points: front, noise, what knobs buy, what combinations are tried, and the pages."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from made_up_trade import ROWS, about, row

from pipeline.trade import front, page, points


def test_front_is_what_no_other_beats():
    nan = float("nan")
    chosen = [(1, 5), (2, 4), (2, 5), (3, 4), (4, 1), (5, 1), (nan, 0), (4, 1)]
    assert front.pareto(chosen) == [True, True, False, False, True, False, False, True]


def test_front_against_every_subset_of_random_points():
    """By definition: a point is on the front if it is the best of all for some bound on the cost."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        found = [(float(c), float(e)) for c, e in rng.integers(0, 8, (12, 2))]
        best = {min((p for p in found if p[0] <= bound), key=lambda p: (p[1], p[0])) for bound, _ in found}
        assert {p for p, on in zip(found, front.pareto(found), strict=True) if on} == best


def test_noise_is_the_spread_of_base_and_repeats():
    sigma = front.noise(ROWS)
    assert sigma["cpu_seconds"] == pytest.approx(1.0)
    assert sigma["changed_rel_err"] == pytest.approx(1e-3)
    assert sigma["shadow_change_err"] is None
    assert front.noise(ROWS[2:])["cpu_seconds"] is None  # one run has no spread


def test_a_point_is_beaten_by_what_is_cheaper_and_better_beyond_chance():
    """Costs scatter by 1, errors by 0.001: two standard deviations of a difference are 2.8 and 0.0028."""
    same = {"kind": "base", "label": "base", "cpu_seconds": 30.0, "errors": {"changed_rel_err": 0.02}}
    rows = [row for row in ROWS if row["kind"] in ("base", "repeat")]
    tried = {"both": (20.0, 0.010), "cost by chance": (28.0, 0.010), "error by chance": (20.0, 0.018)}
    rows += [
        same | {"kind": "knob", "label": label, "cpu_seconds": cost, "errors": {"changed_rel_err": error}}
        for label, (cost, error) in tried.items()
    ]
    assert front.beaten_by(same, rows, "changed_rel_err") == ["both"]
    assert front.beaten_by(same, rows, "object_rel_err") == []


def test_what_a_knob_buys_is_against_the_base_and_says_what_may_be_chance():
    """A difference of two runs has sqrt(2) of the spread: 2.8 CPU s and 0.0028 are two of its standard deviations."""
    table = {(entry["knob"], entry["value"]): entry for entry in front.buys(ROWS)}
    quick = table["render.samples", 8]
    assert (quick["d_cpu_seconds"], quick["d_changed_rel_err"]) == (-15.0, pytest.approx(0.014))
    assert not {"cpu_seconds", "changed_rel_err"} & set(quick["chance"])
    assert {"cpu_seconds", "changed_rel_err"} <= set(table["composite.kind", "ratio"]["chance"])
    assert "cpu_seconds" not in table["probe.width", 512]["chance"]
    assert table["merge.weights", "poisson"]["d_changed_rel_err"] is None
    assert ("probe.width", 64) not in table  # it failed


def test_combinations_are_of_knobs_that_mattered():
    """samples=4 saves more, at more than twice the error; the ratio saves under 5 %; what is known is not asked."""
    assert front.savers(ROWS) == {"render.samples": 8, "probe.width": 512}
    assert front.betterers(ROWS) == {"render.samples": 128}
    dear = [*ROWS, row("render.light_groups=true", "knob", 121.0, 0.010, render__light_groups=True)]
    assert front.betterers(dear) == {"render.samples": 128}  # over four times the base's 30 s
    tried = [tuple(sorted(r["changes"].items())) for r in ROWS if r["kind"] == "knob"]
    (found,) = points.combinations(front.savers(ROWS), "preview", tried)
    assert found.changes == (("probe.width", 512), ("render.samples", 8))
    assert found.label == "probe.width=512 render.samples=8"
    assert points.combinations({}, "preview") == []


def test_combinations_are_foretold_from_knobs_alone():
    """One stage: 30 s times a half times 26/30; errors by their squares."""
    both = front.predicted({"render.samples": 8, "probe.width": 512}, ROWS)
    assert both == {
        "cpu_seconds": pytest.approx(30 * 15 / 30 * 26 / 30),
        "changed_rel_err": pytest.approx(np.sqrt(0.035**2 + 0.024**2 - 0.021**2)),
    }
    assert front.predicted({}, ROWS) == {"cpu_seconds": 30.0, "changed_rel_err": pytest.approx(0.021)}
    assert front.predicted({"render.depth": 2}, ROWS) is None  # not measured alone
    assert front.predicted({"merge.weights": "poisson"}, ROWS) is None  # without a figure
    combined = row("a b", "design", 14.0, 0.04, render__samples=8, probe__width=512)
    assert page.combinations_table([*ROWS, combined])[-1] == "| `a b` | 14.0 | 13.0 | 0.0400 | 0.0369 |"
    assert page.combinations_table(ROWS) == []


def test_pages_say_what_was_measured(tmp_path):
    files = page.write(tmp_path, ROWS, about())
    assert [file.name for file in files] == ["trade.json", "trade.csv", "trade.svg", "presets.json", "trade.md"]
    record = json.loads(files[0].read_text())
    told = json.loads(files[3].read_text())
    assert set(told["presets"]) == {"draft", "preview", "final"}
    assert told["presets"]["draft"]["cpu_seconds"] == 12.0
    on_front = {entry["label"] for entry in record["points"] if entry["front"]["changed_rel_err"]}
    assert on_front == {"render.samples=4", "draft", "render.samples=8", "probe.width=512", "composite.kind=ratio",
                        "preview", "render.samples=128", "final"}  # fmt: skip
    with files[1].open() as file:
        table = {line["label"]: line for line in csv.DictReader(file)}
    assert len(table) == len(ROWS)
    assert float(table["draft"]["render_cpu_seconds"]) == 12.0
    assert table["probe.width=64"]["failed"] == "no ball"
    drawn = ET.parse(files[2]).getroot()
    circles = [item for item in drawn if item.tag.endswith("circle") and len(item)]
    assert len(circles) == len([r for r in ROWS if front.is_measured(r) and r["errors"]["changed_rel_err"]])
    text = files[4].read_text()
    assert "| `render.samples` | 8 | +0.0140 | +0.0140 | -15.0 | -7.5 | (+0) |" in text
    assert "|  | 4 |" in text  # a knob is named once
    assert "- `probe.width=64`: no ball" in text
    assert "(3 runs): 1 CPU s" in text


def test_a_page_without_repeats_says_so(tmp_path):
    rows = ROWS[2:4]
    text = page.markdown(page.flagged(rows), about() | {"noise": front.noise(rows)})
    assert "no error bar is known" in text
    assert "No knob was tried alone" in text
