"""What exposure labels mean: names of thirds or halves of a stop, rounded for people; 1/60 s is 2^-6 s, f/5.6 is 2^2.5.

A name on a ladder stands for the ladder's own value; any other number (a phone's 1/83 s, f/1.78) for itself. Which
ladder a camera uses is told by its labels, and by measured exposure ratios where these can tell: some shutters, and all
simulated ones without rounding, do take the label at its word.

Source: ISO 2720 and APEX (ASA PH2.5-1960) for the ladders; the names are those that cameras write.
Limits: ISO is taken as written, its roundings stay below 1.6 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from pipeline.types import Frame

Ladder = Literal["thirds", "halves", "stated"]
LADDERS: tuple[Ladder, ...] = ("thirds", "halves", "stated")
SAME_NAME = 0.01  # relative; names are at least 4 % apart
SAME_NUMBER = 0.002
STEP_SIGMA = 0.01  # relative, of a ratio of two shutter times
DECISIVE = 20.0

_WHOLE = "30 15 8 4 2 1 1/2 1/4 1/8 1/15 1/30 1/60 1/125 1/250 1/500 1/1000 1/2000 1/4000 1/8000 1/16000 1/32000"
_TIMES = {
    "thirds": "25 20 13 10 6 5 3.2 2.5 1.6 1.3 0.8 1/1.3 0.6 1/1.6 0.4 0.3 1/3 1/5 1/6 1/10 1/13 1/20 1/25 1/40 1/50 "
    "1/80 1/100 1/160 1/200 1/320 1/400 1/640 1/800 1/1250 1/1600 1/2500 1/3200 1/5000 1/6400 1/10000 1/12800 1/20000 "
    "1/25600",
    "halves": "20 10 6 3 1.5 0.7 0.3 1/3 1/6 1/10 1/20 1/45 1/90 1/180 1/350 1/750 1/1500 1/3000 1/6000",
}
_WHOLE_STOPS = "1 1.4 2 2.8 4 5.6 8 11 16 22 32 45"
_STOPS = {
    "thirds": "1.1 1.2 1.6 1.8 2.2 2.5 3.2 3.5 4.5 5 6.3 7.1 9 10 13 14 18 20 25 29 36 40",
    "halves": "1.2 1.7 2.4 3.3 4.8 6.7 9.5 13 19 27 38",
}
_STEPS = {"thirds": 3, "halves": 2}


def _values(text: str) -> np.ndarray:
    parts = (name.partition("/") for name in text.split())
    return np.array([float(top) / float(bottom or 1) for top, _, bottom in parts])


_TIME_NAMES = {ladder: _values(f"{_WHOLE} {names}") for ladder, names in _TIMES.items()}
_STOP_NAMES = {ladder: _values(f"{_WHOLE_STOPS} {names}") for ladder, names in _STOPS.items()}


def _meaning(value: float, names: np.ndarray, steps: int) -> float | None:
    """``2^(k / steps)`` that a name, or the number itself, stands for; None when it is neither."""
    meant = 2.0 ** (np.round(steps * np.log2(value)) / steps)
    known = np.any(np.abs(names / value - 1) < SAME_NAME) or abs(meant / value - 1) < SAME_NUMBER
    return float(meant) if known else None


def time_meant(seconds: float, ladder: Ladder) -> float | None:
    """Seconds that a label stands for; None when it is no name of this ladder."""
    return seconds if ladder == "stated" else _meaning(seconds, _TIME_NAMES[ladder], _STEPS[ladder])


def fnumber_meant(fnumber: float, ladder: Ladder) -> float | None:
    """f-number that a label stands for; None when it is no name of this ladder."""
    return fnumber if ladder == "stated" else _meaning(fnumber, _STOP_NAMES[ladder], 2 * _STEPS[ladder])


def exposure_meant(frame: Frame, ladder: Ladder) -> float:
    """Relative exposure ``t * ISO / (100 N^2)`` less the filter's stops; what is no name stands for itself."""
    seconds = time_meant(frame.exposure_s, ladder) or frame.exposure_s
    fnumber = fnumber_meant(frame.fnumber, ladder) or frame.fnumber
    return seconds * frame.iso / (100 * fnumber**2) * 2.0**-frame.nd_stops


def choose_ladder(frames: Sequence[Frame], measured: Sequence[tuple[int, int, float]]) -> tuple[Ladder, str]:
    """The ladder that the labels of one camera are on, and why.

    ``measured``: (long, short, ln of the exposure ratio short over long) with indices into ``frames``. A ladder must
    know every shutter time; thirds come first, the labels at their word last, unless measured ratios fit a later one
    by a likelihood of `DECISIVE` better. The likelihood is heavy-tailed: single speeds of a shutter may be off.
    """
    times = {frame.exposure_s for frame in frames}
    possible = [ladder for ladder in LADDERS if all(time_meant(seconds, ladder) is not None for seconds in times)]
    scores = {}
    for ladder in possible:
        logs = np.log([exposure_meant(frame, ladder) for frame in frames])
        misses = np.array([log - (logs[short] - logs[long]) for long, short, log in measured])
        scores[ladder] = float(np.sum(np.log1p((misses / STEP_SIGMA) ** 2)))
    best = min(possible, key=lambda ladder: scores[ladder])
    if scores[possible[0]] - scores[best] > np.log(DECISIVE):
        return best, f"{len(measured)} measured ratios fit it best"
    if possible[0] == "stated":
        return "stated", "the times are no names of thirds or halves of a stop"
    return possible[0], f"all {len(times)} times are its names"
