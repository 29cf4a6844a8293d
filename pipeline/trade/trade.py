"""Measure what speed costs in accuracy: the base and its repeats, presets, each knob alone, then designed combinations.

Combinations are chosen from what was found: knobs that save time without doubling the error, and knobs that lower it.
Rows, pages and the list of what failed lie in ``trade/`` of the build folder; nothing else of it is touched.
"""

from __future__ import annotations

import functools
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.run.errors import ManifestError
from pipeline.run.live import Stop
from pipeline.run.runner import Build
from pipeline.run.settings import Settings
from pipeline.run.stage import Graph
from pipeline.trade import front, page, scores
from pipeline.trade.points import Changes, Point, combinations, singles
from pipeline.trade.work import Bench, Row, alone, code_of, digest_of, error_of, source_of

if TYPE_CHECKING:
    from pipeline.image.truth import Truth

PRESETS = ("draft", "preview", "final")
REFERENCE = "final"  # stands in for the truth where there is none
Say = Callable[[str], None]


@dataclass(frozen=True)
class Asked:
    """What a trade is asked. ``settle`` resolves (preset, ``stage.knob=value`` switches) into settings."""

    out: Path  # the build folder
    settle: Callable[[str, list[str]], Settings]
    graph: Graph
    models: dict[str, Any]  # stage -> class of its knobs
    base: str = "preview"
    knobs: Sequence[str] = ()
    repeats: int = 2  # of the base, with other seeds: the error bar of everything
    presets: bool = True
    design: bool = True
    reuse: bool = False  # take the finished stages of the build folder
    against: str = ""  # "truth" or "final"; empty: truth where there is one


@dataclass
class Session:
    """The rows so far and the pace of the work."""

    bench: Bench
    say: Say
    reuse: bool = False  # whether the base may take stages that were run before
    rows: list[Row] = field(default_factory=list)
    seen: set[str] = field(default_factory=set)  # keys of points
    worked: float = 0.0  # wall seconds of points measured now
    foreseen: float = 0.0  # and what they were expected to take

    def run(self, points: Sequence[Point], more: str = "") -> None:
        """Measure what of the points is not known, in order; one line each."""
        points = self.new(points)
        for number, point in enumerate(points, 1):
            later = points[number:]
            row = self.bench.known(point)
            if row is None:
                row = self._measure(point, later)
                note = f"ran {row.get('spent_seconds', 0.0):.0f} s"
            else:
                note = "known"
            self.rows.append(row)
            if row["kind"] == "base" and "failed" not in row:
                self.bench.enter(point, row)
            left = self.left(later)
            ending = f", about {left} left{more}" if later and left else more if not later else ""
            self.say(f"[{number}/{len(points)}] {told(row)}, {note}{ending}")

    def new(self, points: Sequence[Point]) -> list[Point]:
        """Points whose settings were not among those before."""
        found = []
        for point in points:
            if (key := self.bench.key(point)) not in self.seen:
                self.seen.add(key)
                found.append(point)
        return found

    def _measure(self, point: Point, later: Sequence[Point]) -> Row:
        known = self.seconds()
        guess = self.bench.expected(point, known) if known else 0.0
        start = time.perf_counter()
        fresh = point.kind == "repeat" or (point.kind == "base" and not self.reuse)
        row = self.bench.measure(point, later, fresh)
        if guess:
            self.worked += time.perf_counter() - start
            self.foreseen += guess
        return row

    def seconds(self) -> dict[str, float]:
        """Wall seconds per stage of the base, or of the first point that there is."""
        measured = [row for row in self.rows if "failed" not in row]
        found = next((row for row in measured if row["kind"] in ("base", "repeat")), measured[0] if measured else None)
        return {name: stage["seconds"] for name, stage in found["stages"].items()} if found else {}

    def left(self, later: Sequence[Point]) -> str:
        """Time left for these points, as words; empty while nothing tells."""
        todo = [point for point in later if self.bench.known(point) is None]
        seconds = sum(self.bench.expected(point, self.seconds()) for point in todo)
        pace = self.worked / self.foreseen if self.foreseen else 1.0
        return duration(seconds * pace) if seconds else ""


def trade(asked: Asked, say: Say) -> None:
    """Measure, and write trade.csv, trade.json, trade.md and trade.svg. KeyboardInterrupt ends it; what is done stays.

    Raises ManifestError, and what the base itself fails with.
    """
    root = asked.out / "trade"
    with alone(root), Stop().listening():
        against, session, base = prepared(asked, root, say)
        try:
            explore(asked, session, base, against)
        finally:
            if any(row["kind"] == "base" and "failed" not in row for row in session.rows):
                for path in page.write(root, session.rows, about(asked, session, against)):
                    say(str(path))
        shutil.rmtree(root / "store", ignore_errors=True)
        shutil.rmtree(root / "work", ignore_errors=True)


def prepared(asked: Asked, root: Path, say: Say) -> tuple[str, Session, Point]:
    """What errors are against, the bench, and the base."""
    from pipeline.image.truth import load_truth, other_scene
    from pipeline.run.artifacts import WISHES

    settings = asked.settle(asked.base, [])
    build = Build(asked.graph, root / "source", settings, asked.models)
    against, (source, facts) = asked.against, source_of(build, asked.against)
    truth = load_truth(Path(facts["truth_path"])) if facts.get("truth_path") else None
    if truth is not None and (other := other_scene(truth.objects, build.value(WISHES)["object"])):
        if against == "truth":
            raise ManifestError(f"--against: is truth, which shows another scene ({'; '.join(other)}); take final")
        truth = None
    if against == "truth" and truth is None:
        raise ManifestError("--against: is truth; this capture names none; take final, or add truth to capture.toml")
    if not against:
        against = "truth" if truth is not None else REFERENCE
        source, _ = source_of(build, against)
    base = Point(f"{asked.base}", "base", asked.base)

    @functools.cache
    def settle(point: Point) -> Settings:
        return asked.settle(point.quality, point.switches)

    judge = judge_of(root, truth if against == "truth" else None)
    bench = Bench(asked.graph, root, settle, judge, source, build.versions, code_of(asked.graph))
    bench.keep = frozenset(bench.keys(base).values())
    if asked.reuse:
        bench.adopt(asked.out, base)
    return against, Session(bench, say, asked.reuse), base


def judge_of(root: Path, truth: Truth | None) -> Callable[[Path], dict[str, float | None]]:
    """The figures of a finished build; without truth the reference build is the first that is judged."""
    known = [] if truth is None else [truth]

    def judge(build: Path) -> dict[str, float | None]:
        reference = root / "reference"
        if not known and not (reference / "composite" / "composite.exr").exists():
            for part in ("composite/composite.exr", "develop/photographs/plate.exr"):
                (reference / part).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(build / part, reference / part)
        if not known:
            known.append(scores.as_truth(reference))
        composite, plate, _ = scores.pictures_of(build)
        return scores.scores(composite, plate, known[0].coverage, known[0])

    return judge


def explore(asked: Asked, session: Session, base: Point, against: str) -> None:
    """All points in order. Without truth the reference comes first."""
    settings = asked.settle(asked.base, [])
    presets = [Point(name, "preset", name) for name in PRESETS if asked.presets and name != asked.base]
    if against == REFERENCE:
        reference = Point(REFERENCE, "base" if asked.base == REFERENCE else "preset", REFERENCE)
        if session.bench.known(reference) is None or not (session.bench.root / "reference").exists():
            session.bench.forget(reference)  # its picture is what the others are judged by: both or none
            shutil.rmtree(session.bench.root / "reference", ignore_errors=True)
        session.run([reference])
    seed = settings.params.get("render", {}).get("seed", 0)
    repeats = [
        Point(f"{asked.base}, seed {seed + n}", "repeat", asked.base, (("render.seed", seed + n),))
        for n in range(1, asked.repeats + 1)
    ]
    session.run([*repeats, base])  # repeats first: they warm the caches of compiled kernels
    failed = next((row for row in session.rows if row["kind"] == "base" and "failed" in row), None)
    if failed:
        raise error_of(3, failed["failed"])
    alone_ = singles(settings.params, asked.base, asked.knobs)
    session.run([*presets, *alone_], ", then combinations" if asked.design else "")
    if asked.design:
        tried: list[Changes] = [point.changes for point in alone_]
        savers = combinations(front.savers(session.rows), asked.base, tried)
        betterers = combinations(front.betterers(session.rows), asked.base, tried)
        session.run([*savers, *betterers])


def about(asked: Asked, session: Session, against: str) -> dict[str, Any]:
    """Conditions of the measurement."""
    import os
    import platform

    settings = asked.settle(asked.base, [])
    bench = session.bench
    return {
        "id": digest_of([bench.source, bench.code, bench.versions, settings.params])[:12],
        "presets": {name: asked.settle(name, []).params for name in PRESETS},
        "load": os.getloadavg()[1],
        "capture": Path(settings.capture).parent.name,
        "against": "truth" if against == "truth" else f"the {REFERENCE} preset",
        "base": asked.base,
        "base_settings": settings.params,
        "repeats": asked.repeats,
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "versions": session.bench.versions,
        "noise": front.noise(session.rows),
    }


def told(row: Row) -> str:
    """One line about a row."""
    if "failed" in row:
        return f"{row['label']}: failed: {row['failed']}"
    errors = ", ".join(
        f"{key.split('_')[0]} {row['errors'][key]:.4f}" for key in front.FIGURES if row["errors"].get(key) is not None
    )
    return f"{row['label']}: {errors}, CPU {row['cpu_seconds']:.1f} s, {row['peak_mb']:.0f} MB"


def duration(seconds: float) -> str:
    """Seconds as words."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
