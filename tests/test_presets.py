"""The presets of stages/knobs.py are those of the run of `insitu trade` that docs/trade/desk.json records."""

from __future__ import annotations

import itertools
import json

import pytest
from command import DESK, ROOT

from pipeline.run.settings import resolve
from stages.knobs import KNOBS, PRESETS

RECORD = ROOT / "docs" / "trade" / "desk.json"
pytestmark = pytest.mark.skipif(not RECORD.exists(), reason="make speed writes docs/trade/desk.json")


@pytest.fixture(scope="module")
def recorded() -> dict:
    return json.loads(RECORD.read_text())


def test_the_run_is_named(recorded):
    assert len(recorded["id"]) == 12
    assert recorded["id"] in (ROOT / "docs" / "speed.md").read_text()
    assert recorded["capture"] == "desk"
    assert recorded["against"] == "truth"


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_what_was_measured(recorded, name):
    """Otherwise change it back, or run `make speed` (an hour or more) and commit what it writes."""
    assert name in recorded["presets"], f"{name} was not measured in run {recorded['id']}"
    found = recorded["presets"][name]
    now = resolve(DESK, None, name, [], KNOBS, PRESETS).params
    for stage, knobs in PRESETS[name].items():
        measured = found["settings"][stage]
        assert {knob: measured.get(knob) for knob in knobs} == {knob: now[stage][knob] for knob in knobs}, stage
    for figure, better in found["beaten_by"].items():
        assert not better, f"{name}, {figure}: {', '.join(better)} cost less and err less, both beyond chance"


def test_a_better_preset_costs_more_and_errs_less(recorded):
    """Of the figures that all have."""
    known = [recorded["presets"][name] for name in ("draft", "preview", "final")]
    for quick, slow in itertools.pairwise(known):
        assert quick["cpu_seconds"] < slow["cpu_seconds"]
        assert all(quick["errors"][figure] > slow["errors"][figure] for figure in quick["errors"])
