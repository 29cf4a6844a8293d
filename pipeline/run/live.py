"""The runner's ear while a stage computes: pictures to look at, checkpoints, and what Ctrl-C means meanwhile.

What a stage may say is in `pipeline.run.progress`; this decides when it is worth hearing. Showing and saving are paced
by what they were measured to cost, so that they take a bounded share of the stage's time whatever the picture's size.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.run import formats, progress
from pipeline.types import Result

OFFER_EVERY_S, OFFER_SHARE = 3.0, 0.1
OFFER_LEFT_S = 10.0  # nearer its end a stage is not kept from it: showing the desk's costs 3 CPU s
SAVE_EVERY_S, SAVE_SHARE = 10.0, 0.05
DIGEST, SPENT = "insitu:digest", "insitu:spent"  # keys of the checkpoint's own beside the stage's arrays


class Stop:
    """Whether the user wants to end. The first SIGINT or SIGTERM is a request once a stage has something to keep.

    ``patient`` is set by whoever will poll ``asked``; without it, and the second time, the signal breaks off at once by
    KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.asked = self.patient = False

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Handle both signals within the block; in another thread than the main one, where Python cannot, nothing."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._heard) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _heard(self, number: int, frame: Any) -> None:
        if self.asked or not self.patient:
            raise KeyboardInterrupt
        self.asked = True  # no word here: the signal may have come in the middle of writing one


class Pace:
    """When something that costs time is due again: not before ``every_s``, and within ``share`` of the time."""

    def __init__(self, every_s: float, share: float, first: float) -> None:
        self.every_s, self.share, self.next = every_s, share, first

    def due(self, now: float) -> bool:
        """Whether it may be done at time ``now`` [s]."""
        return now >= self.next

    def spent(self, start: float, end: float) -> None:
        """It was done from ``start`` to ``end``: the cost that the next one is expected to have."""
        self.next = end + max(self.every_s, (end - start) * (1 - self.share) / self.share)


class Live(progress.Host):
    """The host of one stage's compute.

    ``show`` writes an offered result and makes a picture of it, if it can; it calls its second argument with the path
    as soon as the picture is there.
    """

    def __init__(
        self,
        name: str,
        stop: Stop,
        checkpoint: Path,
        digest: str,
        show: Callable[[Result, Callable[[Path], None]], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name, self.stop, self.checkpoint, self.digest = name, stop, checkpoint, digest
        self.show, self.clock, self.start = show, clock, clock()
        self.offers = Pace(OFFER_EVERY_S, OFFER_SHARE, self.start)
        self.saves = Pace(SAVE_EVERY_S, SAVE_SHARE, self.start + SAVE_EVERY_S)
        self.shown = self.warned = False
        self.share = 0.0
        self.cpu_start, self.before = time.process_time(), np.zeros(2)

    def spent(self) -> np.ndarray:
        """(2,) wall and CPU seconds of the stage, those before the checkpoint it went on from included."""
        return self.before + np.array([self.clock() - self.start, time.process_time() - self.cpu_start])

    def told(self, share: float) -> None:
        """How far the stage is."""
        self.share = share

    def left(self) -> float:
        """Seconds to the end at the mean rate so far, a checkpoint's included; infinite while no share was told."""
        return float(self.spent()[0]) * (1 - self.share) / self.share if self.share > 0 else np.inf

    def offer(self, make: Callable[[], Result]) -> None:
        """Show the result when one is due, and the end is not near."""
        self.stop.patient = True
        start = self.clock()
        if not self.offers.due(start) or self.left() < OFFER_LEFT_S or self.interrupted():
            return
        self.show(make(), self._seen)
        self.offers.spent(start, self.clock())

    def _seen(self, picture: Path) -> None:
        if not self.shown:
            seconds = self.clock() - self.start
            progress.log.info("%s: first picture after %.1f s: %s", self.name, seconds, picture)
            self.shown = True

    def interrupted(self) -> bool:
        """Whether the user asked to stop; says once that this was heard."""
        if self.stop.asked and not self.warned:
            progress.log.info("%s: stopping, what there is will be kept; once more stops at once", self.name)
            self.warned = True
        return self.stop.asked

    def checkpoint_load(self) -> progress.Arrays | None:
        """The arrays saved under the same digest; a damaged file counts as none."""
        try:
            with np.load(self.checkpoint, allow_pickle=False) as file:
                arrays = {key: file[key] for key in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        if str(arrays.pop(DIGEST, "")) != self.digest:
            return None
        self.before = arrays.pop(SPENT)
        return arrays

    def checkpoint_save(self, make: Callable[[], progress.Arrays]) -> None:
        """Write the arrays when that is due, or when the stage is about to stop."""
        start = self.clock()
        if not self.saves.due(start) and not self.interrupted():
            return
        arrays = {**make(), DIGEST: np.array(self.digest), SPENT: self.spent()}
        with formats.atomic_path(self.checkpoint) as scratch, scratch.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        self.saves.spent(start, self.clock())
