"""Speed against accuracy: front, designs and tables on made-up numbers; two points of the desk through the command."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from command import DESK, command, copied, refused

from pipeline.image import metrics
from pipeline.image.truth import Truth
from pipeline.run.errors import ArtifactError, CaptureError, ManifestError, ToolError
from pipeline.run.settings import Settings
from pipeline.trade import front, page, points, scores, trade, work
from pipeline.trade.points import Point
from stages.knobs import KNOBS
from stages.order import graph


def row(label: str, kind: str, cpu: float, error: float | None, **changes) -> dict:
    stage = {"seconds": cpu / 2, "cpu_seconds": cpu, "peak_mb": 500.0}
    changes = {knob.replace("__", "."): value for knob, value in changes.items()}
    return {
        "label": label, "kind": kind, "quality": "preview", "changes": changes,
        "errors": {"changed_rel_err": error, "object_rel_err": error, "shadow_change_err": None},
        "cpu_seconds": cpu, "seconds": cpu / 2, "peak_mb": 500.0, "composite_mb": 9.0, "stages": {"render": stage},
        "linked": [], "spent_seconds": cpu / 2,
    }  # fmt: skip


ROWS = [
    row("seed 1", "repeat", 31.0, 0.020, render__seed=1),
    row("seed 2", "repeat", 29.0, 0.022, render__seed=2),
    row("preview", "base", 30.0, 0.021),
    row("draft", "preset", 12.0, 0.050),
    row("final", "preset", 150.0, 0.010),
    row("render.samples=8", "knob", 15.0, 0.035, render__samples=8),
    row("render.samples=4", "knob", 11.0, 0.060, render__samples=4),
    row("render.samples=128", "knob", 60.0, 0.014, render__samples=128),
    row("probe.width=512", "knob", 26.0, 0.024, probe__width=512),
    row("composite.kind=ratio", "knob", 29.5, 0.0215, composite__kind="ratio"),
    row("merge.weights=poisson", "knob", 31.0, None, merge__weights="poisson"),
    {"label": "probe.width=64", "kind": "knob", "quality": "", "changes": {"probe.width": 64}, "failed": "no ball"},
]


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
    """samples=4 saves more, at more than twice the error; the ratio saves within chance; what is known is not asked."""
    assert front.savers(ROWS) == {"render.samples": 8, "probe.width": 512}
    assert front.betterers(ROWS) == {"render.samples": 128}
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


def about() -> dict:
    told = {"capture": "made_up", "against": "truth", "base": "preview", "cores": 2, "machine": "x86_64", "repeats": 2}
    return {**told, "noise": front.noise(ROWS)}


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
    assert combined == {"probe.width=256 render.samples=16", "probe.width=2048 render.samples=512"}
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
