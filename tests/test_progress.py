"""What is said about long work: time left, on a terminal and in a log file; and silence outside a run."""

from __future__ import annotations

import io
import logging

import numpy as np
import pytest

from pipeline.run import progress
from pipeline.run.progress import Lines, TimeLeft, spoken


def never() -> None:
    raise AssertionError("nobody looks, yet something was made")


def test_outside_a_run_nothing_is_made_nor_asked():
    progress.offer(never)
    progress.checkpoint_save(never)
    assert progress.checkpoint_load() is None
    assert not progress.interrupted()
    progress.report("task", 0.5)


@pytest.mark.parametrize("begun", [0.0, 0.6])
def test_time_left_of_constant_work_is_exact(begun):
    """Also of work that goes on from a checkpoint: 40 s for all of it, wherever it begins."""
    left = TimeLeft()
    for second in np.arange(0, 40 * (1 - begun), 0.5):
        share = begun + second / 40
        found = left.update(1000 + second, share)
        if found is not None:
            assert found == pytest.approx(40 * (1 - share))
    assert found is not None


def test_no_number_before_it_means_something():
    left = TimeLeft()
    assert left.update(0.0, 0.0) is None
    assert left.update(1.9, 0.5) is None  # too early
    left = TimeLeft()
    assert left.update(0.0, 0.0) is None
    assert left.update(60.0, 0.04) is None  # too little
    assert left.update(100.0, 0.5) == pytest.approx(100.0 * 0.5 / 0.5)
    assert left.update(200.0, 1.0) == 0.0


def test_time_left_is_smooth():
    """Blocks of 0.5 to 1.5 s. The mean of the n/2 blocks or more in view has sigma 0.29 / sqrt(n / 2), so that n = 20
    blocks (a tenth) give 9 % or better: four of those are allowed. Twenty series."""
    for seed in range(20):
        blocks = np.random.default_rng(seed).uniform(0.5, 1.5, 200)
        left, now = TimeLeft(), 0.0
        left.update(0.0, 0.0)
        for done, seconds in enumerate(blocks, 1):
            now += seconds
            estimate = left.update(now, done / 200)
            if done >= 20:
                assert estimate == pytest.approx(200 - done, rel=4 * 0.29 / np.sqrt(done / 2 - 1))


def test_slow_beginning_is_forgotten():
    """Half a minute for the first tenth, then a hundredth each second: exact when as much time has passed again."""
    left = TimeLeft()
    left.update(0.0, 0.0)
    left.update(30.0, 0.1)
    for second in range(1, 90):
        found = left.update(30.0 + second, 0.1 + second / 100)
        if second >= 30:
            assert found == pytest.approx(90 - second)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "1 s"), (6.6, "7 s"), (12, "10 s"), (57, "55 s"), (58, "1 min"), (200, "3 min"), (3599, "1 h 0 min"),
     (8000, "2 h 10 min")],
)  # fmt: skip
def test_time_left_is_spoken_coarsely(seconds, text):
    assert spoken(seconds) == text


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def tell(lines: Lines, text: str, share: float | None = None) -> None:
    record = logging.LogRecord("insitu.progress", logging.INFO, "", 0, text, None, None)
    if share is not None:
        record.share = share
    lines.emit(record)


def screen(written: str) -> list[str]:
    """What a terminal shows at the end: carriage returns overwrite."""
    rows = []
    for line in written.split("\n"):
        cells: list[str] = []
        for part in line.split("\r"):
            cells[: len(part)] = part
        rows.append("".join(cells).rstrip())
    return rows


def test_terminal_has_one_line_rewritten_and_messages_above_it():
    clock, stream = Clock(), io.StringIO()
    lines = Lines(stream, True, clock)
    for share in (0.1, 0.2, 0.3):
        tell(lines, "render", share)
        clock.now += 3
    assert screen(stream.getvalue()) == ["render  30%, 20 s left"]
    tell(lines, "first picture: x.png")
    tell(lines, "render", 0.4)
    assert screen(stream.getvalue()) == ["first picture: x.png", "render  40%, 20 s left"]
    tell(lines, "render", 1.0)
    assert screen(stream.getvalue()) == ["first picture: x.png", ""]


def test_log_file_has_a_line_now_and_then():
    clock, stream = Clock(), io.StringIO()
    lines = Lines(stream, False, clock)
    for second in range(31):
        clock.now = float(second)
        tell(lines, "render", second / 30)
    tell(lines, "message")
    assert stream.getvalue().splitlines() == ["render  33%, 20 s left", "render  67%, 10 s left", "message"]


def test_another_task_begins_anew():
    clock, stream = Clock(), io.StringIO()
    lines = Lines(stream, True, clock)
    tell(lines, "pilot", 0.0)
    clock.now = 100.0
    tell(lines, "pilot", 0.5)
    tell(lines, "render", 0.5)
    assert screen(stream.getvalue()) == ["render  50%"]


def test_shown_puts_logging_back(capsys):
    before = progress.log.level, progress.log.propagate, list(progress.log.handlers)
    with progress.shown():
        progress.log.info("said")
        assert capsys.readouterr().err == "said\n"
    progress.log.info("not said")
    assert (progress.log.level, progress.log.propagate, list(progress.log.handlers)) == before
    assert capsys.readouterr().err == ""
