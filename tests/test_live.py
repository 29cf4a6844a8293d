"""Progressive, interruptible, resumable: the runner with a toy renderer (tests/accumulating.py)."""

from __future__ import annotations

import fcntl
import json
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import accumulating as toy
import numpy as np
import pytest

from pipeline.run import closure, formats, live
from pipeline.run.cli import at_work
from pipeline.run.derive import print_summary
from pipeline.run.errors import ArtifactError
from pipeline.run.figures import read_build
from pipeline.run.live import Live, Pace, Stop
from pipeline.types import Result
from stages.order import graph


@pytest.fixture(autouse=True)
def _always_due(monkeypatch):
    for name in ("OFFER_EVERY_S", "SAVE_EVERY_S", "OFFER_LEFT_S"):
        monkeypatch.setattr(live, name, 0.0)
    for name in ("OFFER_SHARE", "SAVE_SHARE"):
        monkeypatch.setattr(live, name, 1.0)
    monkeypatch.setattr(toy, "happens", [toy.nothing_happens])


@pytest.fixture
def whole(tmp_path) -> dict[str, bytes]:
    """Outputs of a run that nothing disturbed."""
    assert toy.run(toy.build(tmp_path / "whole")) == {"level": "ran", "mean": "ran", "seen": "ran"}
    return outputs(tmp_path / "whole")


def outputs(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in ("mean/mean.exr", "seen/seen.png")}


def at(block: int, *signals: int) -> None:
    """Send the signals to this process after a block."""

    def happens(done: int) -> None:
        if done == block:
            for number in signals:
                signal.raise_signal(number)

    toy.happens[0] = happens


def test_outside_a_run_a_stage_is_a_plain_function(whole, tmp_path):
    result = toy.mean(toy.Knob())
    values = result.outputs["mean"]["v"].astype(np.float32)
    assert np.array_equal(values, formats.read(tmp_path / "whole/mean", toy.MEAN)["v"])


def test_offers_and_checkpoints_do_not_change_the_result(whole, tmp_path, monkeypatch):
    for name in ("OFFER_EVERY_S", "SAVE_EVERY_S"):
        monkeypatch.setattr(live, name, 1e9)
    toy.run(toy.build(tmp_path / "out"))
    assert outputs(tmp_path / "out") == whole
    assert not list(tmp_path.rglob("checkpoint*"))  # gone on completion


def test_picture_is_there_after_the_first_block_and_refined_in_place(tmp_path):
    """The second run has the records of the first: none may vouch for what is replaced meanwhile."""
    pictures = []

    def happens(done: int) -> None:
        if done > 1:
            pictures.append((tmp_path / "seen/seen.png").read_bytes())
            assert (tmp_path / "mean/mean.exr").exists()
            assert not list(tmp_path.glob("[ms]*/record.json"))

    toy.happens[0] = happens
    for gain in (1.0, 1.5):
        pictures.clear()
        toy.run(toy.build(tmp_path, gain=gain))
        assert len(set(pictures)) == toy.BLOCKS - 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_stage_keeps_the_best_so_far_and_the_next_run_completes_it(number, whole, tmp_path):
    half = toy.mean(toy.Knob(blocks=3)).outputs["mean"]["v"].astype(np.float32)
    at(3, number)
    one = toy.build(tmp_path / "out")
    assert toy.run(one) == {"level": "ran", "mean": "part", "seen": "ran"}
    assert one.stop.asked
    assert toy.COMPUTED == [1, 2, 3]
    assert np.array_equal(formats.read(tmp_path / "out/mean", toy.MEAN)["v"], half)
    assert toy.build(tmp_path / "out").verify() == []
    record = tmp_path / "out/mean/record.json"
    assert json.loads(record.read_bytes())["numbers"] == {"complete": False, "share_done": 0.5}
    assert record.stat().st_mtime < (tmp_path / "out/level/record.json").stat().st_mtime  # make must ask again
    toy.happens[0] = toy.nothing_happens
    assert toy.run(toy.build(tmp_path / "out")) == {"level": "fresh", "mean": "ran", "seen": "ran"}
    assert toy.COMPUTED == [4, 5, 6]
    assert outputs(tmp_path / "out") == whole
    assert toy.run(toy.build(tmp_path / "out")) == {"level": "fresh", "mean": "fresh", "seen": "fresh"}


def test_killed_process_is_taken_up_where_it_was(whole, tmp_path, saw):
    out = tmp_path / "out"
    done = subprocess.run([sys.executable, toy.__file__, str(out), "5"], check=False, timeout=60)
    assert done.returncode == 9
    assert not (out / "mean/record.json").exists()
    toy.run(toy.build(out))
    assert toy.COMPUTED == [5, 6]  # the fifth was computed, and lost: it was killed before saving it
    assert outputs(out) == whole
    saw("machine.killed", "exact", 0)


@pytest.mark.parametrize("change", ["params", "code", "damage"])
def test_checkpoint_of_something_else_is_ignored(change, whole, tmp_path, monkeypatch):
    at(3, signal.SIGINT)
    toy.run(toy.build(tmp_path / "out", gain=2.0 if change == "params" else 1.0))
    toy.happens[0] = toy.nothing_happens
    checkpoint = tmp_path / "out/mean/checkpoint.npz"
    if change == "code":
        monkeypatch.setattr(closure, "digest", lambda module: "other code")
    if change == "damage":
        checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    toy.run(toy.build(tmp_path / "out"))
    assert toy.COMPUTED == [1, 2, 3, 4, 5, 6]
    assert outputs(tmp_path / "out") == whole
    assert not checkpoint.exists()


@pytest.mark.parametrize("signals", [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM, signal.SIGINT)])
def test_second_signal_stops_at_once(signals, whole, tmp_path):
    at(3, *signals)
    with pytest.raises(KeyboardInterrupt):
        toy.run(toy.build(tmp_path / "out"))
    assert not (tmp_path / "out/mean/record.json").exists()
    toy.happens[0] = toy.nothing_happens
    toy.run(toy.build(tmp_path / "out"))
    assert toy.COMPUTED == [3, 4, 5, 6]
    assert outputs(tmp_path / "out") == whole


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_before_the_first_offer_there_is_nothing_to_keep(number, tmp_path):
    at(1, number)
    with pytest.raises(KeyboardInterrupt):
        toy.run(toy.build(tmp_path))
    assert not (tmp_path / "mean/mean.exr").exists()


def test_handlers_are_put_back():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with Stop().listening():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_patience_ends_with_the_stage(tmp_path):
    one = toy.build(tmp_path)
    toy.run(one)
    assert not one.stop.patient


def test_signal_in_the_last_block_finds_everything_done(whole, tmp_path):
    at(toy.BLOCKS, signal.SIGINT)
    one = toy.build(tmp_path / "out")
    assert toy.run(one)["mean"] == "ran"
    assert one.stop.asked
    assert outputs(tmp_path / "out") == whole


def test_interrupted_command_says_what_is_kept_and_how_to_go_on(tmp_path, capsys):
    one = toy.build(tmp_path)
    args = SimpleNamespace(verb="run", with_truth=None)
    at(3, signal.SIGINT)
    with one.stop.listening():
        assert at_work(args, one, "seen") == 130
    said = capsys.readouterr()
    assert "mean         part" in said.out
    assert "seen         ran" in said.out
    assert said.err == "insitu: interrupted; mean kept at 50%; run the same command to go on from there\n"
    toy.happens[0] = toy.nothing_happens
    assert at_work(args, toy.build(tmp_path), "seen") == 0


def test_figures_are_of_whole_builds(tmp_path):
    at(3, signal.SIGINT)
    toy.run(toy.build(tmp_path))
    for name in ("evaluate/metrics", "ingest/facts", "settings"):
        formats.write_bytes(tmp_path / f"{name}.json", b'{"name": "toy", "quality": "draft"}')
    with pytest.raises(ArtifactError, match="mean was interrupted"):
        read_build(tmp_path)
    toy.happens[0] = toy.nothing_happens
    toy.run(toy.build(tmp_path))
    assert read_build(tmp_path)["name"] == "toy"


def test_what_a_killed_writer_left_is_removed(tmp_path):
    (tmp_path / "mean/.mean.exr.a1b2c3").mkdir(parents=True)
    (tmp_path / "mean/.mean.exr.a1b2c3/mean.exr").write_bytes(b"half")
    toy.run(toy.build(tmp_path))
    assert {path.name for path in (tmp_path / "mean").iterdir()} == {"mean.exr", "record.json", ".lock"}


def test_summary_says_what_is_incomplete(tmp_path):
    part = {"seconds": 1.0, "cpu_seconds": 1.0, "numbers": {"complete": False, "share_done": 0.5}}
    producer = dict.fromkeys(("display", "composite", "report", "metrics"), SimpleNamespace(name="seen"))
    stub = SimpleNamespace(
        settings=SimpleNamespace(quality="draft"), out=tmp_path, record={"mean": part}.get,
        graph=SimpleNamespace(stages=toy.STAGES, producer=producer),
    )  # fmt: skip
    assert "\nmean kept at 50%: run again to complete it\n" in print_summary(stub)


def test_nothing_follows_while_another_process_works_there(tmp_path):
    toy.run(toy.build(tmp_path))
    before = outputs(tmp_path)
    toy.happens[0] = lambda done: None if done == 1 else check()

    def check() -> None:
        assert (tmp_path / "seen/seen.png").read_bytes() == before["seen/seen.png"]
        assert (tmp_path / "mean/mean.exr").read_bytes() != before["mean/mean.exr"]

    one = toy.build(tmp_path, gain=3.0)
    with (tmp_path / "seen/.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert one.run(one.graph["mean"]) == "ran"


def test_composite_follows_the_render():
    composite = graph()["composite"]
    assert composite.live
    assert graph()["render"] in graph().parents(composite)


def test_nothing_follows_whose_other_inputs_are_missing(tmp_path):
    one = toy.build(tmp_path)
    assert one.run(one.graph["mean"]) == "ran"
    assert not (tmp_path / "seen").exists()


def test_seconds_before_the_checkpoint_count(tmp_path):
    """10 s, a checkpoint, 5 s lost with the process; then 2 s from the checkpoint on."""
    clock, arguments = Clock(), ("toy", Stop(), tmp_path / "checkpoint.npz", "digest", lambda result, seen: None)
    host = Live(*arguments, clock)
    clock.now += 10
    host.checkpoint_save(lambda: {"total": np.ones(3)})
    clock.now += 5
    host = Live(*arguments, clock)
    loaded = host.checkpoint_load()
    assert list(loaded) == ["total"]
    clock.now += 2
    assert host.spent()[0] == pytest.approx(12)


class Clock:
    """A clock that moves when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize("cost", [0.01, 0.2, 4.0])
def test_showing_takes_a_tenth_of_the_time_at_most(cost, monkeypatch, tmp_path):
    """1000 s of blocks of 50 ms, each offered; beyond the first offer, which always goes through."""
    monkeypatch.setattr(live, "OFFER_EVERY_S", 3.0)
    monkeypatch.setattr(live, "OFFER_SHARE", 0.1)
    clock, shown = Clock(), []

    def show(result: Result, seen: object) -> None:
        shown.append(clock.now)
        clock.now += cost

    host = Live("toy", Stop(), tmp_path / "checkpoint.npz", "digest", show, clock)
    while clock.now < 1100:
        clock.now += 0.05
        host.offer(lambda: Result({}))
    assert shown[0] == pytest.approx(100.05)
    assert min(np.diff(shown)) >= 3.0
    assert (len(shown) - 1) * cost <= 0.1 * 1000
    assert max(np.diff(shown)) <= max(3.0 + cost, 10 * cost) + 0.1  # and no longer than that


def test_a_stage_near_its_end_is_not_kept_from_it(monkeypatch, tmp_path):
    """At a steady rate: of 60 s, what is offered (every 3 s) until 10 s are left is shown; of 9 s nothing is."""
    monkeypatch.setattr(live, "OFFER_EVERY_S", 3.0)
    monkeypatch.setattr(live, "OFFER_LEFT_S", 10.0)
    assert shown_of(60.0, tmp_path)[-1] == 48.0
    assert shown_of(9.0, tmp_path) == []


def test_a_resumed_stage_shows_pictures_while_much_is_left(monkeypatch, tmp_path):
    """540 s before the checkpoint, 60 s after it: its rate is that of all 600, not of the seconds since."""
    monkeypatch.setattr(live, "OFFER_EVERY_S", 3.0)
    monkeypatch.setattr(live, "OFFER_LEFT_S", 10.0)
    clock, shown = Clock(), []
    host = Live("toy", Stop(), tmp_path / "c.npz", "digest", lambda *_: shown.append(clock.now - 100.0), clock)
    host.before = np.array([540.0, 540.0])
    for second in range(1, 61):
        clock.now = 100.0 + second
        host.told(0.9 + 0.1 * second / 60)
        host.offer(lambda: Result({}))
    assert shown == [float(second) for second in range(1, 50, 3)]  # every 3 s until 10 s are left


def shown_of(seconds: float, folder: Path) -> list[float]:
    """When a stage of so many seconds, told and offered twenty times, is shown."""
    clock, shown = Clock(), []
    host = Live("toy", Stop(), folder / "c.npz", "digest", lambda *_: shown.append(clock.now - 100.0), clock)
    for share in np.linspace(0.05, 1.0, 20):
        clock.now = 100.0 + seconds * share
        host.told(share)
        host.offer(lambda: Result({}))
    assert host.stop.patient
    return shown


def test_pace_follows_the_measured_cost():
    pace = Pace(3.0, 0.1, first=0.0)
    assert pace.due(0.0)
    pace.spent(0.0, 1.0)
    assert not pace.due(9.99)
    assert pace.due(10.0)
    pace.spent(10.0, 10.1)
    assert pace.due(13.1)
