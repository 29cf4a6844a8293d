"""How far long work is: stages say so through logging, the command line shows it where someone is looking."""

from __future__ import annotations

import logging
import sys
import time

log = logging.getLogger("insitu.progress")


def report(what: str, share: float) -> None:
    """Say that ``share`` (0 to 1) of ``what`` is done."""
    log.info("%s", what, extra={"share": share})


class Line(logging.Handler):
    """One line of a terminal, rewritten: what, how much is done, seconds left."""

    def __init__(self) -> None:
        super().__init__()
        self.what, self.start, self.width = "", 0.0, 0

    def emit(self, record: logging.LogRecord) -> None:
        """Show a report; a finished task clears the line."""
        what, share = record.getMessage(), float(getattr(record, "share", 0.0))
        now = time.monotonic()
        if what != self.what:
            self.what, self.start = what, now
        left = (now - self.start) * (1 - share) / share if share > 0 else 0.0
        text = "" if share >= 1 else f"{what} {share:4.0%}, {left:.0f} s left"
        sys.stderr.write("\r" + text.ljust(self.width) + ("\r" if not text else ""))
        sys.stderr.flush()
        self.width = len(text)


def show_on_terminal() -> None:
    """Attach the line to stderr when that is a terminal."""
    if sys.stderr.isatty():
        log.addHandler(Line())
        log.setLevel(logging.INFO)
    log.propagate = False
