"""Which points are measured: ladders of knobs, each alone, and designs of combinations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline.run.errors import ManifestError
from pipeline.trade import points
from pipeline.trade.points import Point
from stages.knobs import KNOBS


@pytest.mark.parametrize("factors", range(1, points.MOST_FACTORS + 1))
def test_designs_are_balanced_and_mix_no_main_effect_with_an_interaction_of_two(factors):
    """Resolution IV, or all combinations: columns are orthogonal to each other and to products of two others."""
    runs = 2 * np.array(points.design(factors), int) - 1
    assert len({tuple(run) for run in runs}) == len(runs) == (2**factors if factors <= 3 else 8 if factors == 4 else 16)
    assert not runs.sum(0).any()
    assert (-1,) * factors in {tuple(run) for run in runs}  # the base itself, which is known
    for i, j in itertools.combinations(range(factors), 2):
        assert runs[:, i] @ runs[:, j] == 0
        for k in set(range(factors)) - {i, j}:
            assert runs[:, i] @ (runs[:, j] * runs[:, k]) == 0


def test_designs_have_a_limit():
    with pytest.raises(ValueError, match="9 factors"):
        points.design(9)


def test_ladders_hold_allowed_values_of_existing_knobs_and_their_defaults():
    for knob, ladder in points.LADDERS.items():
        stage, name = knob.split(".")
        for value in ladder:
            KNOBS[stage].model_validate({name: value})
        assert KNOBS[stage].model_fields[name].default in ladder, knob
        assert len(set(ladder)) == len(ladder) > 1


def test_singles_leave_the_base_out():
    base = {"render": {"samples": 48}, "composite": {"kind": "auto"}}
    found = points.singles(base, "preview", ["render.samples", "composite.kind"])
    assert [p.label for p in found] == [
        *(f"render.samples={n}" for n in (2, 4, 8, 16, 128, 512)), "composite.kind=additive", "composite.kind=ratio",
    ]  # fmt: skip
    assert found[-1].switches == ["composite.kind=ratio"]
    assert Point("", "", "", (("render.denoise", False),)).switches == ["render.denoise=false"]


def test_a_source_of_the_pose_is_tried_only_where_there_are_further_views():
    knobs = ["render.depth", "sources.cloud"]
    assert points.without_effect(knobs, views=True) == {}
    assert list(points.without_effect(knobs, views=False)) == ["sources.cloud"]


def test_unknown_knobs_are_refused():
    assert points.chosen_knobs(None) == list(points.LADDERS)
    assert points.chosen_knobs("render.depth, merge.weights") == ["render.depth", "merge.weights"]
    with pytest.raises(ManifestError, match=r"render\.speed"):
        points.chosen_knobs("render.speed")
