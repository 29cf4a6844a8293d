"""What a stage says while it works: how far it is, a result so far, a checkpoint; and whether it was asked to stop.

``compute`` stays a pure function: outside a run every call here does nothing, and what it returns when nobody
interrupts never depends on them. The runner is the `Host` that listens during a run (`pipeline.run.live`).
"""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TextIO

import numpy as np

from pipeline.types import Result

Arrays = dict[str, np.ndarray]
log = logging.getLogger("insitu.progress")


class Host:
    """Who listens to the stage at hand. This one, outside a run, hears nothing and never interrupts."""

    def told(self, share: float) -> None:
        """See `report`."""

    def offer(self, make: Callable[[], Result]) -> None:
        """See `offer`."""

    def interrupted(self) -> bool:
        """See `interrupted`."""
        return False

    def checkpoint_load(self) -> Arrays | None:
        """See `checkpoint_load`."""
        return None

    def checkpoint_save(self, make: Callable[[], Arrays]) -> None:
        """See `checkpoint_save`."""


NOBODY = Host()
_host: ContextVar[Host] = ContextVar("host", default=NOBODY)


@contextlib.contextmanager
def hosted(host: Host) -> Iterator[None]:
    """Calls within the block, in this thread, go to ``host``."""
    token = _host.set(host)
    try:
        yield
    finally:
        _host.reset(token)


def report(what: str, share: float) -> None:
    """Say that ``share`` (0 to 1) of ``what`` is done. Not shares of several tasks in turn: one task, one name."""
    log.info("%s", what, extra={"share": share})
    _host.get().told(share)


def offer(make: Callable[[], Result]) -> None:
    """Offer what the stage would return if it ended now: every output, whole, of its final size.

    ``make`` is called only when someone will look, so offer as often as results improve. The first offer goes through
    at once; later ones when seconds have passed and showing them stays within a tenth of the stage's time. None does,
    the first no more than others, when by the share that was reported the stage is done in seconds anyway. A stage that
    has offered is asked by `interrupted` instead of being broken off.
    """
    _host.get().offer(make)


def interrupted() -> bool:
    """Whether to return now what there is. True only after an offer, so there is something to return.

    Then return the result with ``numbers["complete"] = False``, ``numbers["share_done"]`` (0 to 1) and a warning that
    says what is missing. The runner records it as incomplete and goes on from the checkpoint next time.
    """
    return _host.get().interrupted()


def checkpoint_load() -> Arrays | None:
    """The arrays of the last `checkpoint_save` of a run that did not complete, or None to start at the beginning.

    Only for the same inputs, params, code and library versions. With them the stage must come to the same bytes as if
    it had never stopped: keep sums, not means, and the number of the next block, from which its seed follows.
    """
    return _host.get().checkpoint_load()


def checkpoint_save(make: Callable[[], Arrays]) -> None:
    """Keep what the stage needs to go on from here. Call it after every block.

    ``make`` is called, and the file written, at most every ten seconds and for a twentieth of the stage's time; at once
    when the stage is `interrupted`, so ask that *before* saving and stop after it. Arrays of objects are refused.
    """
    _host.get().checkpoint_save(make)


class TimeLeft:
    """Seconds left of one task from the shares it reports; None until they mean something.

    The mean rate of the later half of the time since the first report: smooth, and what is slow at the beginning only
    (kernels being compiled, the first picture) is forgotten. The first report may have any share: a task that goes on
    from a checkpoint begins at more than zero.
    """

    MIN_SECONDS, MIN_SHARE = 2.0, 0.05  # since the first report

    def __init__(self) -> None:
        self.first: tuple[float, float] | None = None
        self.later: deque[tuple[float, float]] = deque()  # reports, from the last one of the earlier half on

    def update(self, now: float, share: float) -> float | None:
        """Seconds left at time ``now`` [s] with ``share`` done."""
        self.first = self.first or (now, share)
        self.later.append((now, share))
        while len(self.later) > 1 and self.later[1][0] <= (self.first[0] + now) / 2:
            self.later.popleft()
        if now - self.first[0] < self.MIN_SECONDS or share - self.first[1] < self.MIN_SHARE:
            return None
        seconds, gained = now - self.later[0][0], share - self.later[0][1]
        return seconds * max(1 - share, 0.0) / gained if gained > 0 else None


def spoken(seconds: float) -> str:
    """A time left, as coarse as it is known: ``7 s``, ``45 s``, ``4 min``, ``2 h 10 min``."""
    if seconds < 10:
        return f"{max(1, round(seconds))} s"
    if seconds < 57.5:
        return f"{5 * round(seconds / 5)} s"
    minutes = max(1, round(seconds / 60))
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60 // 10 * 10} min"


class Lines(logging.Handler):
    """Shows reports: one line rewritten on a terminal, else a line of its own now and then, as a log file wants it.

    Messages without a share (``first picture after ...``) always get a line. A finished task clears the terminal's.
    """

    EVERY_S = 10.0  # between lines of a log file

    def __init__(self, stream: TextIO, terminal: bool, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self.stream, self.terminal, self.clock = stream, terminal, clock
        self.what, self.left, self.width, self.written = "", TimeLeft(), 0, clock()

    def emit(self, record: logging.LogRecord) -> None:
        """Show one message or report."""
        text, share = record.getMessage(), getattr(record, "share", None)
        if share is None:
            self._clear()
            self._write(text + "\n")
            return
        now = self.clock()
        if text != self.what:
            self.what, self.left = text, TimeLeft()
            self.written = now
        left = self.left.update(now, share)
        line = f"{text} {share:4.0%}" + (f", {spoken(left)} left" if left is not None else "")
        if self.terminal:
            self._clear()
            if share < 1:
                self._write(line)
                self.width = len(line)
        elif share < 1 and now - self.written >= self.EVERY_S:
            self.written = now
            self._write(line + "\n")

    def _clear(self) -> None:
        if self.width:
            self._write("\r" + " " * self.width + "\r")
            self.width = 0

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()


@contextlib.contextmanager
def shown() -> Iterator[None]:
    """Show progress on stderr within the block."""
    lines = Lines(sys.stderr, sys.stderr.isatty())
    before = log.level, log.propagate
    log.addHandler(lines)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(lines)
        log.setLevel(before[0])
        log.propagate = before[1]
