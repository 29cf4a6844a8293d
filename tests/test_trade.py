"""Speed against accuracy: scores, the bench and the session on made-up stages; two points of the desk by command."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import DESK, command, copied, refused
from made_up_trade import about

from pipeline.image import metrics
from pipeline.image.truth import Truth
from pipeline.run.errors import ArtifactError, CaptureError, ToolError
from pipeline.run.settings import Settings
from pipeline.trade import front, page, scores, trade, work
from pipeline.trade.points import Point
from stages.knobs import KNOBS
from stages.order import graph


def test_what_depends_on_a_changed_knob_has_another_key_and_nothing_else_has():
    defaults = {name: model().model_dump() for name, model in KNOBS.items()}
    base = work.chain_keys(graph(), defaults)
    lights = work.chain_keys(graph(), defaults | {"lights": defaults["lights"] | {"min_share": 0.5}})
    changed = {name for name in base if base[name] != lights[name]}
    assert "lights" in changed
    assert "composite" in changed
    assert not {"ingest", "merge", "develop", "pose", "probe"} & changed
    assert {"evaluate", "report"}.isdisjoint(base)  # nobody waits for them


def test_doing_nothing_scores_one_and_the_truth_nothing():
    """Also with another unit: the truth's is a quarter of the capture's."""
    rng = np.random.default_rng(1)
    plate = rng.uniform(0.2, 0.4, (48, 64, 3))
    right = plate.copy()
    right[10:20, 10:30] = 0.9  # an object
    right[24:34, 10:40] *= 0.7  # its shadow
    coverage = {"cube": np.zeros((48, 64))}
    coverage["cube"][10:20, 10:30] = 1
    truth = Truth(plate / 4, right / 4, coverage)
    assert scores.scores(plate, plate, coverage, truth)["changed_rel_err"] == pytest.approx(1, abs=1e-6)
    found = scores.scores(right, plate, coverage, truth)
    assert max(found.values()) < 1e-6
    halfway = scores.scores((plate + right) / 2, plate, coverage, truth)
    assert halfway["changed_rel_err"] == pytest.approx(0.5, abs=1e-6)
    assert halfway["shadow_change_err"] == pytest.approx(0.5, abs=1e-6)


def test_a_change_where_there_is_none_counts():
    plate = np.full((40, 40, 3), 0.3)
    right = plate.copy()
    right[5:15, 5:15] = 0.6
    coverage = {"cube": (right != plate).any(-1).astype(float)}
    wrong = right.copy()
    wrong[25:35, 25:35] += 0.3  # the same change once more, where nothing stands: 5x5 means of both are alike
    found = scores.scores(wrong, plate, coverage, Truth(plate, right, coverage))
    assert found["changed_rel_err"] == pytest.approx(1.0, abs=1e-5)
    assert found["object_rel_err"] == pytest.approx(0)
    even = metrics.box(plate)
    assert scores.changed_error(even, even, metrics.reference(plate, even, {}, 1)) is None


def test_errors_of_a_point_are_those_of_its_process():
    assert isinstance(work.error_of(3, "no ball"), CaptureError)
    crashed = work.error_of(-9, "render.samples=512: ")
    assert isinstance(crashed, ToolError)
    assert "code -9" in str(crashed)


def test_one_at_a_time(tmp_path):
    with work.alone(tmp_path), pytest.raises(ArtifactError, match="another insitu trade"), work.alone(tmp_path):
        pass


def test_durations_are_words():
    assert [trade.duration(s) for s in (12.3, 600.0, 7260.0)] == ["12 s", "10 min", "2 h 01 min"]


def test_refusals(capsys, tmp_path):
    (line,) = refused(capsys, 2, "trade", DESK, "--out", tmp_path, "--knobs", "render.speed")
    assert "render.speed" in line
    (line,) = refused(capsys, 2, "trade", DESK, "--out", tmp_path, "--repeats", "-1")
    assert "--repeats" in line
    (line,) = refused(capsys, 4, "needs", DESK, "--out", tmp_path / "nowhere")
    assert "insitu run" in line


CODE = {stage.name: "same" for stage in graph().stages}


class Toy(work.Bench):
    """A bench whose points write their records themselves."""

    def _run(self, point, work_folder):
        if dict(point.changes).get("render.samples") == 4:
            return 3, "too dark"
        if dict(point.changes).get("render.samples") == 512:
            return -9, ""
        if dict(point.changes).get("render.samples") == 8:
            raise KeyboardInterrupt
        for name in self.keys(point):
            folder = work_folder / name
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / "record.json").exists():
                record = {"seconds": 1.0, "cpu_seconds": 2.0, "peak_mb": 100.0, "numbers": {}, "code": "same"}
                (folder / "record.json").write_text(json.dumps(record))
        (work_folder / "composite" / "composite.exr").write_bytes(b"picture")
        return 0, ""


@pytest.fixture
def toy(tmp_path) -> Toy:
    def settle(point: Point) -> Settings:
        params = {name: model().model_dump() for name, model in KNOBS.items()}
        for knob, value in point.changes:
            stage, name = knob.split(".")
            params[stage][name] = value
        return Settings(capture="c", scene=None, quality="preview", params=params)

    bench = Toy(graph(), tmp_path, settle, lambda build: {"changed_rel_err": 0.1}, "source", {}, CODE)
    bench.keep = frozenset(bench.keys(Point("preview", "base", "preview")).values())
    return bench


def test_points_share_stages_are_charged_in_full_and_are_not_run_again(toy):
    said: list[str] = []
    session = trade.Session(toy, said.append)
    base = Point("preview", "base", "preview")
    width = Point("probe.width=512", "knob", "preview", (("probe.width", 512),))
    dark = Point("render.samples=4", "knob", "preview", (("render.samples", 4),))
    session.run([base, width, dark, Point("again", "design", "preview")])
    first, second, third = session.rows  # the fourth has the settings of the first
    assert first["linked"] == []
    assert set(second["linked"]) == {"ingest", "merge", "develop", "balance", "sources", "sfm", "calibrate", "pose"}
    assert second["cpu_seconds"] == first["cpu_seconds"] == 2.0 * len(first["stages"])
    assert third["failed"] == "too dark"
    again = trade.Session(toy, said.append)
    toy._run = None  # type: ignore[method-assign,assignment]
    again.run([base, width, dark])
    assert [r["cpu_seconds"] for r in again.rows[:2]] == [first["cpu_seconds"]] * 2
    assert again.rows[2]["failed"] == "too dark"
    assert said[-1].startswith("[3/3] render.samples=4: failed: too dark, known")


def test_the_store_keeps_what_later_points_need_only(toy):
    base = Point("preview", "base", "preview")
    wide = Point("w", "knob", "preview", (("probe.width", 512),))
    both = Point("b", "design", "preview", (("probe.width", 512), ("render.samples", 16)))
    toy.measure(base)
    toy.measure(wide, [both])
    assert toy.stored("probe", toy.keys(both)["probe"]).exists()
    assert not toy.stored("render", toy.keys(wide)["render"]).exists()
    row_ = toy.measure(both)
    assert "reflectance" in row_["linked"]
    assert not toy.stored("probe", toy.keys(both)["probe"]).exists()
    assert toy.stored("probe", toy.keys(base)["probe"]).exists()


def test_code_or_photographs_that_change_make_a_new_point(toy):
    base = Point("preview", "base", "preview")
    toy.measure(base)
    assert toy.known(base)
    toy.source = "other photographs"
    assert toy.known(base) is None
    toy.code = CODE | {"render": "other"}
    with pytest.raises(ArtifactError, match="render: the code changed while it was measured"):
        toy.measure(base)


class Priced(Toy):
    """A bench on which stages cost, and pictures err, by formulas."""

    def _run(self, point, work_folder):
        params = self.settle(point).params
        for name in self.keys(point):
            cpu = {"probe": params["probe"]["width"] / 100, "render": float(params["render"]["samples"])}.get(name, 0.5)
            record = {"seconds": cpu / 2, "cpu_seconds": cpu, "peak_mb": 100.0, "numbers": {}, "code": "same"}
            (work_folder / name).mkdir(parents=True, exist_ok=True)
            (work_folder / name / "record.json").write_text(json.dumps(record))
        error = (1 / params["render"]["samples"] + 1 / params["probe"]["width"]) ** 0.5
        (work_folder / "composite" / "composite.exr").write_text(str(error))
        return 0, ""


def test_the_whole_of_a_trade_on_made_up_costs(toy, tmp_path):
    """Knobs alone, both designs, the front and the pages; presets and repeats are told apart."""
    bench = Priced(graph(), tmp_path, toy.settle, error_of_a_text, "source", {}, CODE)
    session = trade.Session(bench, lambda line: None)

    def settle(quality: str, switches: list[str]) -> Settings:
        return toy.settle(Point("", "", quality))

    knobs = ["probe.width", "render.samples", "composite.half"]
    asked = trade.Asked(tmp_path, settle, graph(), KNOBS, knobs=knobs, presets=False)
    trade.explore(asked, session, Point("preview", "base", "preview"), "truth")
    kinds = [r["kind"] for r in session.rows]
    assert kinds[:3] == ["repeat", "repeat", "base"]
    assert kinds.count("knob") == 3 + 6 + 1
    combined = {r["label"] for r in session.rows if r["kind"] == "design"}
    assert combined == {"probe.width=256 render.samples=16", "probe.width=2048 render.samples=128"}
    assert [r["label"] for r in session.rows if r["kind"] == "knob" and r["cpu_seconds"] > 100] == [
        "render.samples=128", "render.samples=512",
    ]  # fmt: skip
    told = {**about(), "noise": front.noise(session.rows)}
    record = json.loads(page.write(tmp_path, session.rows, told)[0].read_text())
    for label, guess in record["predicted"].items():
        measured = next(r for r in session.rows if r["label"] == label)
        assert measured["cpu_seconds"] == pytest.approx(guess["cpu_seconds"])  # its stages are independent
        assert measured["errors"]["changed_rel_err"] == pytest.approx(guess["changed_rel_err"])


def error_of_a_text(build) -> dict:
    return {"changed_rel_err": float((build / "composite" / "composite.exr").read_text())}


def test_the_base_is_charged_where_a_shared_stage_had_to_run_again(toy):
    base = Point("preview", "base", "preview")
    row_ = toy.measure(base)
    row_["stages"]["merge"]["cpu_seconds"] = 7.0
    toy.enter(base, row_)
    shutil.rmtree(toy.root / "store")
    again = toy.measure(Point("w", "knob", "preview", (("probe.width", 512),)))
    assert again["linked"] == []
    assert again["stages"]["merge"]["cpu_seconds"] == 7.0
    assert again["stages"]["probe"]["cpu_seconds"] == 2.0


def test_a_point_that_compiled_is_run_twice(toy, monkeypatch):
    found = iter([set(), {"kernel"}, {"kernel"}, {"kernel"}])
    monkeypatch.setattr(work, "kernels", lambda: next(found))
    runs = []
    once = toy._run
    toy._run = lambda point, folder: (runs.append(point.label), once(point, folder))[1]
    toy.measure(Point("cold", "base", "preview"))
    toy.measure(Point("warm", "knob", "preview", (("probe.width", 512),)))
    assert runs == ["cold", "cold", "warm"]


def test_a_point_that_was_killed_is_tried_again_next_time(toy):
    large = Point("render.samples=512", "knob", "preview", (("render.samples", 512),))
    assert toy.measure(large)["failed"] == "killed by signal 9"
    assert toy.known(large) is None


def test_a_relative_folder_is_meant_from_where_the_command_was_given(toy, tmp_path, monkeypatch):
    """The process of a point has another working folder; what it is told must not depend on it."""
    told = []

    class Child:
        def __init__(self, words, **rest):
            told.extend(words)

        def wait(self):
            return 0

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(work.subprocess, "Popen", Child)
    work.Bench._run(toy, Point("preview", "base", "preview"), Path("out/trade/points/one"))
    assert told[told.index("--out") + 1] == str((tmp_path / "out/trade/points/one").resolve())
    assert (tmp_path / "out/trade/points/one/log.txt").exists()


def test_interrupted_keeps_what_is_done(toy):
    session = trade.Session(toy, lambda line: None)
    with pytest.raises(KeyboardInterrupt):
        session.run([Point("preview", "base", "preview"), Point("s", "knob", "preview", (("render.samples", 8),))])
    assert len(session.rows) == 1
    assert toy.known(Point("preview", "base", "preview"))


def test_two_points_of_the_desk(desk_build, tmp_path):
    """The base taken from a finished draft, one knob by the command; measured again nothing runs. About 12 CPU s."""
    out = copied(desk_build, tmp_path / "build")
    (out / "settings.json").write_bytes((desk_build / "settings.json").read_bytes())
    words = ["trade", DESK, "--out", out, "--quality", "draft", "--reuse", "--repeats", 0, "--knobs", "composite.half"]
    words += ["--no-presets"]
    done = command(*words)
    assert done.returncode == 0, done.stderr
    record = json.loads((out / "trade" / "trade.json").read_text())
    base, half = record["points"]
    assert half["changes"] == {"composite.half": True}
    assert "render" in half["linked"]
    built = json.loads((desk_build / "evaluate" / "metrics.json").read_text())
    for key in ("object_rel_err", "shadow_change_err"):
        assert base["errors"][key] == pytest.approx(built[key], abs=1e-12)  # the same figures as insitu evaluate
        assert half["errors"][key] == pytest.approx(built[key], rel=0.02)  # half floats round by 2^-12 of the factor
    for name in base["stages"].keys() - {"ingest"}:  # it reads outside the build, so it is asked every time
        taken = json.loads((desk_build / name / "record.json").read_text())
        assert base["stages"][name] == {key: taken[key] for key in ("seconds", "cpu_seconds", "peak_mb")}, name
    for one in (base, half):
        assert one["cpu_seconds"] == pytest.approx(sum(stage["cpu_seconds"] for stage in one["stages"].values()))
    assert half["stages"]["render"] == base["stages"]["render"]
    assert half["stages"]["composite"] != base["stages"]["composite"]
    assert base["peak_mb"] == max(stage["peak_mb"] for stage in base["stages"].values()) > 50
    assert half["composite_mb"] < base["composite_mb"]
    again = command(*words)
    assert again.stdout.count("known") == 2
    assert (out / "trade" / "trade.csv").read_text().count("\n") == 3
    assert not (out / "trade" / "store").exists()


def test_needs_prints_every_term_and_notices_a_stale_build(desk_build, tmp_path, capsys):
    from pipeline.run.cli import main

    out = copied(desk_build, tmp_path / "build")
    (out / "settings.json").write_bytes((desk_build / "settings.json").read_bytes())
    assert main(["needs", str(DESK), "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    records = {s["stage"]: json.loads((out / s["stage"] / "record.json").read_text()) for s in found["stages"]}
    assert sum(len(s["terms"]) for s in found["stages"]) == sum(len(r["evidence"]) for r in records.values()) > 10
    assert not any(s["stale"] for s in found["stages"])
    settings = json.loads((out / "settings.json").read_text())
    settings["params"]["render"]["samples"] = 9
    (out / "settings.json").write_text(json.dumps(settings))
    assert main(["needs", str(DESK), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "its settings changed since" in text
    assert "insitu run" in text.splitlines()[-1]
    assert "  + " in text
    assert "  - " in text
    (out / "render" / "record.json").unlink()
    (line,) = refused(capsys, 4, "needs", DESK, "--out", out)
    assert "render has not run" in line
