"""Trade without truth: the reference preset's picture stands in for it."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from pipeline.run import formats
from pipeline.run.settings import Settings
from pipeline.trade import trade, work
from pipeline.trade.points import Point
from pipeline.types import Raster
from stages.knobs import KNOBS, PRESETS
from stages.order import graph

CODE = {stage.name: "same" for stage in graph().stages}
PLATE = np.random.default_rng(5).uniform(0.2, 0.4, (40, 50, 3)).astype(np.float32)


def built(folder, wrong: float):
    """A build whose object, and the shadow beside it, are off by a factor of 1 + ``wrong``."""
    picture, alpha = PLATE.copy(), np.zeros(PLATE.shape[:2], np.float32)
    alpha[8:18, 8:22] = 1
    picture[alpha > 0] = 0.8 * (1 + wrong)
    picture[22:34, 8:30] *= 0.7 * (1 + wrong)
    formats.write_exr(
        folder / "composite" / "composite.exr", Raster({**Raster.split(picture), "obj.A": alpha}, "acescg")
    )
    formats.write_exr(folder / "develop" / "photographs" / "plate.exr", Raster(Raster.split(PLATE), "acescg"))
    return folder


class Drawn(work.Bench):
    """A bench on which a picture is off by one over the samples, and every stage takes a second."""

    def _run(self, point, work_folder):
        for name in self.keys(point):
            (work_folder / name).mkdir(parents=True, exist_ok=True)
            record = {"seconds": 1.0, "cpu_seconds": 1.0, "peak_mb": 100.0, "code": "same"}
            (work_folder / name / "record.json").write_text(json.dumps(record))
        samples = self.settle(point).params["render"]["samples"]
        built(work_folder, 0.0 if samples == 512 else 1 / samples)
        return 0, ""


def settings(quality: str, switches: list[str]) -> Settings:
    params = {name: model.model_validate(PRESETS[quality].get(name, {})).model_dump() for name, model in KNOBS.items()}
    for switch in switches:
        knob, value = switch.split("=")
        stage, name = knob.split(".")
        params[stage][name] = json.loads(value)
    return Settings(capture="c", scene=None, quality=quality, params=params)


def bench(root) -> Drawn:
    judge = trade.judge_of(root, None)
    return Drawn(graph(), root, lambda point: settings(point.quality, point.switches), judge, "source", {}, CODE)


def explored(root) -> list[work.Row]:
    session = trade.Session(bench(root), lambda line: None)
    asked = trade.Asked(root, settings, graph(), KNOBS, knobs=["render.samples"], repeats=1, design=False)
    trade.explore(asked, session, Point("preview", "base", "preview"), "final")
    return session.rows


def test_the_reference_comes_first_and_errors_are_against_it(tmp_path):
    rows = explored(tmp_path)
    assert [row["label"] for row in rows[:3]] == ["final", "preview, seed 1", "preview"]
    assert sum(row["label"] == "final" for row in rows) == 1
    assert rows[0]["errors"] == {"changed_rel_err": 0.0, "object_rel_err": 0.0, "shadow_change_err": 0.0}
    errors = {row["label"]: row["errors"] for row in rows}
    assert errors["preview"]["object_rel_err"] == pytest.approx(1 / 48, rel=1e-5)
    assert errors["render.samples=8"]["object_rel_err"] == pytest.approx(1 / 8, rel=1e-5)
    assert errors["render.samples=8"]["shadow_change_err"] == pytest.approx(0.7 / 8 / 0.3, rel=1e-4)
    assert errors["render.samples=4"]["changed_rel_err"] == pytest.approx(
        2 * errors["render.samples=8"]["changed_rel_err"], rel=1e-4
    )


def test_a_lost_reference_is_made_again_before_anything_is_judged(tmp_path):
    explored(tmp_path)
    shutil.rmtree(tmp_path / "reference")
    (tmp_path / "points" / f"{bench(tmp_path).key(Point('', 'preset', 'draft'))}.json").unlink()
    rows = explored(tmp_path)
    assert next(row for row in rows if row["label"] == "final")["errors"]["changed_rel_err"] == 0
    assert next(row for row in rows if row["label"] == "draft")["errors"]["object_rel_err"] == pytest.approx(1 / 8)
    assert (tmp_path / "reference" / "composite" / "composite.exr").exists()
