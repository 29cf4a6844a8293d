"""The page of promised figures says what the records say, and of what no record says, that it was not measured."""

from __future__ import annotations

import json
import re

from extreme_cases import CASES
from extreme_cases import page as extremes_page

from benchmarks.accuracy import DOCS, PROMISES, collected, figures, judged, page


def test_the_page_is_what_the_records_give():
    assert (DOCS / "accuracy.md").read_text() == page(collected()), "run: make accuracy"


def test_every_promise_is_judged_or_says_why_not():
    records = collected()
    verdicts = {promise.what: judged(promise, records)[1] for promise in PROMISES}
    assert set(verdicts.values()) <= {"met", "**missed**", "held by a test", "not measured"}
    assert len(verdicts) >= len({promise.what for promise in PROMISES})


def test_nothing_is_met_without_a_record():
    empty = {"figures": {}}
    assert {judged(promise, empty)[1] for promise in PROMISES} == {"not measured", "held by a test"}


def test_limits_from_above_and_from_below():
    bias = next(promise for promise in PROMISES if promise.what.startswith("bias"))
    peer = next(promise for promise in PROMISES if promise.what.startswith("OpenCV"))
    assert judged(bias, {"merge": {"bias_max": 0.0009}}) == ("0.0009", "met")
    assert judged(bias, {"merge": {"bias_max": 0.002}})[1] == "**missed**"
    assert judged(peer, {"merge": {"opencv_ms_per_mpx": 6.0, "ms_per_mpx": 1.0}})[1] == "**missed**"


def test_coverage_of_few_captures_is_no_figure():
    near = next(promise for promise in PROMISES if "bound that is named" in promise.what)
    held = {"captures": 100, "bounded": {"object pixels": 0.99, "shadow pixels": 0.97}}
    assert judged(near, {"budget": {"kinds": {"corner": held}}}) == ("0.97", "met")
    assert judged(near, {"budget": {"kinds": {"corner": held | {"captures": 99}}}}) == ("-", "not measured")


def test_the_table_of_figures_is_read():
    text = (
        "# Figures\n\n| capture | quality | object |\n|---|---|---|\n| desk | draft | 0.02 |\n\n## More\n| a | b | c |"
    )
    assert figures(text) == {("desk", "draft"): {"capture": "desk", "quality": "draft", "object": "0.02"}}


def test_the_page_of_extremes_is_what_was_seen():
    """Every case has a row, all of them as defined, and the page says no more than the two records."""
    rows, formulas = (json.loads((DOCS / f"{name}.json").read_text()) for name in ("numerics", "formulas"))
    assert [row["case"] for row in rows] == list(CASES)
    assert all(row["ok"] for row in rows)
    assert (DOCS / "numerics.md").read_text() == extremes_page(rows, formulas), "run: make extremes"


def test_tests_that_the_page_names_exist():
    tests = DOCS.parent / "tests"
    named = re.findall(r"`(test_\w+)(?:::(test_\w+))?`", (tests / "extremes/page.md").read_text())
    assert len(named) > 30
    for file, function in named:
        text = (tests / f"{file}.py").read_text()
        assert not function or f"def {function}(" in text, f"{file}::{function}"
