"""What `insitu needs` says beside a record's own words: seconds saved, bounds, and their sums."""

from __future__ import annotations

import json

import pytest

from pipeline.run import needs
from pipeline.run.runner import Build
from pipeline.run.settings import Settings
from stages.knobs import KNOBS
from stages.order import graph


@pytest.mark.parametrize(
    ("text", "bound"),
    [
        ("3 % at 70 degrees of incidence on a ball of 0.9, 10 % on chrome; nothing head on", 0.10),
        ("values there are off by 1.3% (median), 13.1% (95 %)", 0.131),
        ("of irradiance: 5.2% for walls at 1 m, 2.7% for walls at 2 m", 0.052),
        ("nothing: its texels are the map's", 0.0),
        ("0 for a plane", 0.0),
        ("0.577 px rms over the frame", None),
        ("a seam of that ratio", None),
        ("", None),
    ],
)
def test_a_bound_is_the_largest_percentage_in_the_words(text, bound):
    assert needs.bound_in(text) == (bound if bound is None else pytest.approx(bound))


def test_a_stage_may_say_seconds_and_bound_itself():
    entry = {"term": "gloss", "modelled": False, "because": "no peak", "could_cost": "2 %"}
    assert needs.told(entry, {}) == entry | {"saved_s": None, "bound_rel": 0.02, "bound_px": None}
    said = entry | {"saved_rel": 1.5, "bound_rel": 0.03, "bound_px": 0.4}
    assert needs.told(said, {}, 4.0) == entry | {"saved_s": 6.0, "bound_rel": 0.03, "bound_px": 0.4}
    assert needs.told(said, {})["saved_s"] is None  # nobody knows what the stage took
    in_part = entry | {"modelled": "half of it"}
    assert needs.told(in_part, {})["bound_rel"] == 0.02
    modelled = entry | {"modelled": True}
    assert needs.told(modelled, {}) == modelled


def test_seconds_come_from_the_trade_where_the_entry_names_the_knob(tmp_path):
    params = {name: model().model_dump() for name, model in KNOBS.items()}
    params["render"]["denoise"] = False
    build = Build(graph(), tmp_path, Settings(capture="c", scene=None, quality="preview", params=params), KNOBS)
    assert needs.bought_by_knobs(build) == {}
    bought = [
        {"knob": "render.denoise", "value": False, "d_cpu_seconds": -3.0},
        {"knob": "render.samples", "value": 8, "d_cpu_seconds": -20.0},  # not what this build has
    ]
    (tmp_path / "trade").mkdir()
    (tmp_path / "trade" / "trade.json").write_text(json.dumps({"buys": bought}))
    assert needs.bought_by_knobs(build) == {"render.denoise": 3.0}
    entry = {"term": "denoiser", "modelled": False, "because": "knob render.denoise; 48 samples", "could_cost": ""}
    assert needs.told(entry, needs.bought_by_knobs(build))["saved_s"] == 3.0


def test_sums_are_over_what_is_known():
    terms = [
        {"term": "a", "modelled": False, "saved_s": 2.0, "bound_rel": 0.03, "bound_px": None},
        {"term": "b", "modelled": "in part", "saved_s": None, "bound_rel": 0.04, "bound_px": None},
        {"term": "c", "modelled": False, "saved_s": None, "bound_rel": None, "bound_px": None},
        {"term": "d", "modelled": True},
        {"term": "e", "modelled": False, "saved_s": None, "bound_rel": None, "bound_px": 0.5},
    ]
    found = needs.left_out([{"terms": terms[:2]}, {"terms": terms[2:]}])
    assert found == {
        "terms": 4, "bounded": 2, "moved": 1, "bound_rel_sum": pytest.approx(0.07),
        "bound_rel_root": pytest.approx(0.05), "timed": 1, "saved_s": 2.0,
    }  # fmt: skip
    line = needs.summed(found)
    assert "7.0% if all" in line
    assert "5.0% if" in line
    assert "of 4 terms 1 only move things, 1 name no figure" in line
    assert "2.0 CPU s saved by 1" in line
