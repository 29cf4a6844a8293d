"""What follows from measured points: the Pareto front, what each knob buys, which knobs mattered. Pure functions.

A row is a dict with ``kind``, ``changes`` ({stage.knob: value}), ``errors`` ({figure: value or None}), ``cpu_seconds``,
``seconds``, ``peak_mb``; a row of a point that failed has ``failed`` and none of the measured keys.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.trade.points import MOST_FACTORS

Row = Mapping[str, Any]
FIGURES = ("changed_rel_err", "object_rel_err", "shadow_change_err")
MAIN = FIGURES[0]
SIGMAS = 2.0  # of a difference: below, it may be chance
ALLOWED = 2.0  # times the base's error: beyond, a saving is no candidate for a combination
SAVED = 0.05  # of the base's CPU seconds: what saves less is none either
DEAR = 4.0  # times the base's CPU seconds: beyond, a gain is none


def pareto(points: Sequence[tuple[float, float]]) -> list[bool]:
    """Which of (cost, error) no other is better than in one and at least as good in the other; NaN never is.

    Of equal points all are on the front.
    """
    finite = [p for p in points if not any(map(math.isnan, p))]
    return [
        not any(math.isnan(v) for v in p)
        and not any(q[0] <= p[0] and q[1] <= p[1] and (q[0] < p[0] or q[1] < p[1]) for q in finite)
        for p in points
    ]


def fronts(rows: Sequence[Row], figure: str) -> list[bool]:
    """Which rows are on the front of CPU seconds and one figure; repeats and failures never are."""
    nan = float("nan")
    return pareto(
        [
            (nan, nan) if not is_measured(row) or row["errors"].get(figure) is None
            else (row["cpu_seconds"], row["errors"][figure])
            for row in rows
        ]
    )  # fmt: skip


def beaten_by(row: Row, rows: Sequence[Row], figure: str) -> list[str]:
    """Labels of the rows that cost less than ``row`` and err less by one figure, both beyond chance.

    Near the front many settings differ by less than repeats do, and which of them `fronts` names is chance.
    """
    sigma, ours = noise(rows), row["errors"].get(figure)
    return [
        other["label"]
        for other in rows
        if is_measured(other) and None not in (ours, theirs := other["errors"].get(figure))
        and (saved := row["cpu_seconds"] - other["cpu_seconds"]) > 0 and resolved(saved, sigma["cpu_seconds"])
        and (gain := ours - theirs) > 0 and resolved(gain, sigma[figure])
    ]  # fmt: skip


def is_measured(row: Row) -> bool:
    """Whether a row is a point of its own with results: no failure, no repeat."""
    return "failed" not in row and row["kind"] != "repeat"


def spread(values: Sequence[float]) -> float | None:
    """Standard deviation of repeats, or None when there are fewer than two."""
    if len(values) < 2:
        return None
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1))


def noise(rows: Sequence[Row]) -> dict[str, float | None]:
    """Standard deviation of the base's figures and costs over it and its repeats, by name."""
    same = [row for row in rows if row["kind"] in ("base", "repeat") and "failed" not in row]
    found = {key: spread([row[key] for row in same]) for key in ("cpu_seconds", "seconds", "peak_mb")}
    for figure in FIGURES:
        values = [row["errors"].get(figure) for row in same]
        found[figure] = spread([v for v in values if v is not None]) if None not in values else None
    return found


def resolved(difference: float | None, sigma: float | None) -> bool:
    """Whether a difference of two measurements, each of that standard deviation, is more than chance.

    Without a known deviation every difference but 0 counts.
    """
    return difference is not None and abs(difference) > SIGMAS * math.sqrt(2) * (sigma or 0.0)


def base_of(rows: Sequence[Row]) -> Row:
    """The row that the others are compared with."""
    return next(row for row in rows if row["kind"] == "base")


def buys(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Per knob and value: what it changes against the base.

    Keys: knob, value, ``d_<figure>`` and ``d_cpu_seconds``, ``d_seconds``, ``d_peak_mb``, and ``chance``, the names of
    those differences that repeats of the base may show too.
    """
    base, sigma = base_of(rows), noise(rows)
    table = []
    for row in rows:
        if row["kind"] != "knob" or "failed" in row:
            continue
        ((knob, value),) = row["changes"].items()
        entry: dict[str, Any] = {"knob": knob, "value": value}
        for key in ("cpu_seconds", "seconds", "peak_mb"):
            entry[f"d_{key}"] = row[key] - base[key]
        for figure in FIGURES:
            ours, theirs = row["errors"].get(figure), base["errors"].get(figure)
            entry[f"d_{figure}"] = None if ours is None or theirs is None else ours - theirs
        names = ("cpu_seconds", "seconds", "peak_mb", *FIGURES)
        entry["chance"] = [key for key in names if not resolved(entry[f"d_{key}"], sigma[key])]
        table.append(entry)
    return table


def savers(rows: Sequence[Row], most: int = MOST_FACTORS) -> dict[str, Any]:
    """Knobs that save `SAVED` of the CPU time at an error of at most `ALLOWED` times the base's: knob -> value.

    Of each knob the value that saves most; the largest savings first, at most ``most``. Whether one run's saving is
    beyond chance is not asked: the design is to tell, in which half of the runs have it.
    """
    base = base_of(rows)
    best: dict[str, tuple[float, Any]] = {}
    for row in rows:
        error = row["errors"].get(MAIN) if "failed" not in row else None
        if row["kind"] != "knob" or error is None or error > ALLOWED * (base["errors"].get(MAIN) or math.inf):
            continue
        ((knob, value),) = row["changes"].items()
        saved = base["cpu_seconds"] - row["cpu_seconds"]
        if saved > SAVED * base["cpu_seconds"] and saved > best.get(knob, (0.0, None))[0]:
            best[knob] = saved, value
    ranked = sorted(best, key=lambda knob: -best[knob][0])[:most]
    return {knob: best[knob][1] for knob in ranked}


def betterers(rows: Sequence[Row], most: int = 4) -> dict[str, Any]:
    """Knobs that lower the error beyond chance at up to `DEAR` times the base's CPU time: knob -> the best value.

    The largest gains first, at most ``most``. Costs multiply in a combination: two that are dear take an hour.
    """
    base, sigma = base_of(rows), noise(rows)[MAIN]
    best: dict[str, tuple[float, Any]] = {}
    for row in rows:
        error = row["errors"].get(MAIN) if "failed" not in row else None
        if row["kind"] != "knob" or error is None or base["errors"].get(MAIN) is None:
            continue
        ((knob, value),) = row["changes"].items()
        gain = base["errors"][MAIN] - error
        if row["cpu_seconds"] > DEAR * base["cpu_seconds"]:
            continue
        if gain > 0 and resolved(gain, sigma) and gain > best.get(knob, (0.0, None))[0]:
            best[knob] = gain, value
    ranked = sorted(best, key=lambda knob: -best[knob][0])[:most]
    return {knob: best[knob][1] for knob in ranked}


def predicted(changes: Mapping[str, Any], rows: Sequence[Row]) -> dict[str, float] | None:
    """``cpu_seconds`` and `MAIN` of a combination, from its knobs alone; None when one of them was not measured.

    Costs of one stage multiply by what each knob alone multiplies them by; errors are taken as independent, so that
    their squares add: ``e^2 = e_0^2 + sum (e_i^2 - e_0^2)``, at least 0. How far this is right is what the designed
    combinations measure.
    """
    base = base_of(rows)
    single = {knob: row for row in rows if row["kind"] == "knob" and "failed" not in row for knob in row["changes"]
              if row["changes"] == {knob: changes.get(knob)}}  # fmt: skip
    errors = [row["errors"].get(MAIN) for row in (base, *single.values())]
    if single.keys() != changes.keys() or None in errors:
        return None
    cost = 0.0
    for name, stage in base["stages"].items():
        ratios = [row["stages"][name]["cpu_seconds"] / stage["cpu_seconds"] for row in single.values()
                  if stage["cpu_seconds"] > 0]  # fmt: skip
        cost += stage["cpu_seconds"] * math.prod(ratios)
    square = errors[0] ** 2 + sum(error**2 - errors[0] ** 2 for error in errors[1:])
    return {"cpu_seconds": cost, MAIN: math.sqrt(max(0.0, square))}
