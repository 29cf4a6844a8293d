"""Measure points: each in a process of its own, stages that it shares with others linked, not run again.

A point is charged what the record of *every* stage of its chain says, also of those that were linked. Its row is kept
under a digest of all that decides it (settings, photographs, code, libraries): what was measured is not run again, what
has changed is. A process per point because memory that a renderer keeps for itself would count for the next one.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.run import closure, formats
from pipeline.run.errors import ArtifactError, InsituError, ToolError
from pipeline.run.runner import Build, is_complete
from pipeline.run.settings import Settings
from pipeline.run.settings import load as load_settings
from pipeline.run.stage import Graph
from pipeline.trade.points import Point

LAST = "composite"  # what a user waits for; the stages after it only judge and show
STARTING = 4.0  # seconds, about, to start a process, read what was linked, and score
Row = dict[str, Any]


def digest_of(value: Any) -> str:
    """Short digest of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:24]


def chain_keys(graph: Graph, params: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Per stage up to `LAST`: a digest of its knobs and of those of all stages before it that it depends on."""
    keys: dict[str, str] = {}
    for stage in graph.upto(LAST):
        parents = [keys[parent.name] for parent in graph.parents(stage)]
        keys[stage.name] = digest_of([stage.name, params[stage.name], parents])
    return keys


@dataclass
class Bench:
    """Where points are measured. ``settle`` gives a point's settings, ``judge`` the figures of a finished build."""

    graph: Graph
    root: Path
    settle: Callable[[Point], Settings]
    judge: Callable[[Path], dict[str, float | None]]
    source: str  # digest of the photographs and wishes, and of what the figures are against
    versions: dict[str, str]
    code: dict[str, str]  # digest of every stage's code, as it was at the beginning
    keep: frozenset[str] = frozenset()  # chain keys of stages that stay in the store whoever needs them
    ledger: dict[str, dict[str, float]] = field(default_factory=dict)  # what the base's stages took, by chain key

    def keys(self, point: Point) -> dict[str, str]:
        """Chain keys of a point."""
        return chain_keys(self.graph, self.settle(point).params)

    def key(self, point: Point) -> str:
        """Digest of all that decides a point's row."""
        params = self.settle(point).params
        chosen = {stage.name: params[stage.name] for stage in self.graph.upto(LAST)}
        return digest_of([self.source, chosen, self.code, self.versions])

    def known(self, point: Point) -> Row | None:
        """The row of a point that was measured before."""
        try:
            row: Row = json.loads((self.root / "points" / f"{self.key(point)}.json").read_bytes())
        except (FileNotFoundError, ValueError):
            return None
        return row | said_of(point)

    def enter(self, point: Point, row: Row) -> None:
        """Charge the base's stages to all points that share them, whether they are linked or had to run again."""
        self.ledger |= {key: row["stages"][name] for name, key in self.keys(point).items()}

    def forget(self, point: Point) -> None:
        """Drop a point's row, so that it is measured again."""
        (self.root / "points" / f"{self.key(point)}.json").unlink(missing_ok=True)

    def measure(self, point: Point, later: Sequence[Point] = (), fresh: bool = False) -> Row:
        """Run what of a point's chain is not in the store, and score it. Stages that ``later`` points need are stored.

        ``fresh``: link nothing. Raises KeyboardInterrupt when the user ends it; what was begun goes on next time.
        A point whose photographs do not allow it gives a row with ``failed``.
        """
        work = self.root / "work" / self.key(point)
        keys = self.keys(point)
        linked = [] if fresh else [name for name, key in keys.items() if self._link(name, key, work)]
        start, before = time.perf_counter(), kernels()
        code, said = self._run(point, work)
        if not code and kernels() - before:  # it compiled, which the next run of these settings will not
            for name in self.keys(point).keys() - set(linked):
                (work / name / "record.json").unlink(missing_ok=True)
            code, said = self._run(point, work)
        spent = time.perf_counter() - start
        if code in (3, 6):
            row: Row = {"failed": said}
        elif code < 0:  # by the system, as when memory is short: the others may do, and this one next time
            return {"failed": f"killed by signal {-code}"} | said_of(point)
        elif code:
            raise error_of(code, f"{point.label}: {said}")
        else:
            row = self._row(work, {} if point.kind == "repeat" else self.ledger, keys) | {
                "linked": linked,
                "spent_seconds": spent,
            }
            if point.kind != "repeat":  # the others go on from the base itself
                self._store(work, keys, later)
        formats.write_bytes(self.root / "points" / f"{self.key(point)}.json", json.dumps(row, indent=1).encode())
        shutil.rmtree(work, ignore_errors=True)
        return row | said_of(point)

    def _row(self, work: Path, ledger: dict[str, dict[str, float]], keys: dict[str, str]) -> Row:
        records = {name: json.loads((work / name / "record.json").read_bytes()) for name in keys}
        if part := [name for name, record in records.items() if not is_complete(record)]:
            raise ArtifactError(f"{work}: {', '.join(part)} was interrupted; run insitu trade again")
        if other := [name for name, record in records.items() if record.get("code") != self.code[name]]:
            raise ArtifactError(
                f"{', '.join(other)}: the code changed while it was measured; run insitu trade again, all points anew"
            )
        kept = ("seconds", "cpu_seconds", "peak_mb")
        taken = {name: {key: record.get(key, 0.0) for key in kept} for name, record in records.items()}
        stages = {name: ledger.get(keys[name], costs) for name, costs in taken.items()}
        return {
            "errors": self.judge(work),
            "seconds": sum(stage["seconds"] for stage in stages.values()),
            "cpu_seconds": sum(stage["cpu_seconds"] for stage in stages.values()),
            "peak_mb": max(stage["peak_mb"] for stage in stages.values()),
            "composite_mb": (work / LAST / f"{LAST}.exr").stat().st_size / 1e6,
            "stages": stages,
        }

    def _run(self, point: Point, work: Path) -> tuple[int, str]:
        """Exit code of ``insitu run`` for a point, and the last thing that it said of an error."""
        asked = self.settle(point)
        folder = str(work.resolve())  # the process has another working folder
        words = [sys.executable, "-m", "stages", "run", asked.capture, "--out", folder, "--upto", LAST]
        words += ["--quality", point.quality, *(["--scene", asked.scene] if asked.scene else [])]
        for stage in self.graph.upto(LAST):
            for knob, value in asked.params[stage.name].items():
                words += ["--set", f"{stage.name}.{knob}={value if isinstance(value, str) else json.dumps(value)}"]
        work.mkdir(parents=True, exist_ok=True)
        with (work / "log.txt").open("w+b") as log:
            child = subprocess.Popen(
                words, cwd=closure.ROOT, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True
            )
            while True:
                try:
                    code = child.wait()
                    break
                except KeyboardInterrupt:
                    child.send_signal(signal.SIGINT)  # it keeps what it has; once more stops it at once
            log.seek(0)
            lines = log.read().decode(errors="replace").splitlines()
        if code == 130 or code == -signal.SIGINT:
            raise KeyboardInterrupt
        said = [line.removeprefix("insitu: ") for line in lines if line.startswith("insitu: ")] or lines[-1:]
        return code, "; ".join(said)

    def stored(self, name: str, key: str) -> Path:
        """Where a stage's files lie for other points."""
        return self.root / "store" / name / key

    def _link(self, name: str, key: str, work: Path) -> bool:
        """Link a stage from the store, unless the point has its own already or it is not there."""
        source = self.stored(name, key)
        if (work / name / "record.json").exists() or not (source / "record.json").exists():
            return False
        shutil.rmtree(work / name, ignore_errors=True)
        link_tree(source, work / name)
        return True

    def _store(self, work: Path, keys: dict[str, str], later: Sequence[Point]) -> None:
        """Keep what later points need, drop what they no longer do."""
        wanted = set(self.keep).union(*(set(self.keys(point).values()) for point in later))
        for name, key in keys.items():
            if key in wanted:
                self.take(work / name, name, key)
        for folder in (self.root / "store").glob("*/*"):
            if folder.name not in wanted:
                shutil.rmtree(folder)

    def take(self, folder: Path, name: str, key: str) -> None:
        """Link a finished stage's folder into the store, whole or not at all."""
        with formats.atomic_path(self.stored(name, key)) as scratch:
            link_tree(folder, scratch)

    def adopt(self, build: Path, point: Point) -> list[str]:
        """Take stages of a finished build that a point shares, with the seconds they were recorded with; their names.

        The runner checks them by digest as it does its own.
        """
        try:
            theirs = chain_keys(self.graph, load_settings(build).params)
        except ArtifactError:
            return []
        taken = []
        for name, key in self.keys(point).items():
            if theirs[name] == key and (build / name / "record.json").exists() and not self.stored(name, key).exists():
                self.take(build / name, name, key)
                taken.append(name)
        return taken

    def expected(self, point: Point, seconds: dict[str, float]) -> float:
        """Seconds that a point will take if its stages take what the base's did; linked ones nothing."""
        return STARTING + sum(
            seconds.get(name, 0.0)
            for name, key in self.keys(point).items()
            if not (self.stored(name, key) / "record.json").exists()
        )


def kernels() -> set[str]:
    """Names of the renderer's compiled kernels, which it keeps for later processes."""
    return {path.name for path in (Path.home() / ".drjit").glob("*.bin")}


def code_of(graph: Graph) -> dict[str, str]:
    """Digest of the code of every stage up to `LAST`, and of the scores."""
    modules = {stage.name: stage.compute.__module__ for stage in graph.upto(LAST)}
    return {name: closure.digest(module) for name, module in (modules | {"scores": "pipeline.trade.scores"}).items()}


def said_of(point: Point) -> Row:
    """What a row says of its point."""
    return {
        "label": point.label, "kind": point.kind, "quality": point.quality,
        "changes": dict(point.changes),
    }  # fmt: skip


def link_tree(source: Path, target: Path) -> None:
    """Hard links of a stage's files, locks and scratch left out; copies where the file system has none.

    Links are safe: the runner replaces files and never writes into them.
    """

    def link(old: str, new: str) -> None:
        try:
            os.link(old, new)
        except OSError:
            shutil.copy2(old, new)

    shutil.copytree(source, target, copy_function=link, ignore=shutil.ignore_patterns(".*", "checkpoint.npz"))


def error_of(code: int, text: str) -> InsituError:
    """The error that a process ended with; a crash is a ToolError."""
    for kind in InsituError.__subclasses__():
        if kind.exit_code == code:
            return kind(text)
    return ToolError(f"{text or 'no word'}; ended with code {code}; run insitu trade again to go on")


def source_of(build: Build, against: str) -> tuple[str, dict[str, Any]]:
    """Digest of what the capture holds (every photograph's own digest) and its facts. Runs ingest, which is quick."""
    stage = next(stage for stage in build.graph.stages if stage.impure)
    build.run(stage)
    record = build.record(stage.name) or {}
    facts = json.loads((build.out / stage.name / "facts.json").read_bytes())
    truth = facts.get("truth_path")
    files = [formats.digest(Path(truth))] if truth and against == "truth" else []
    return digest_of([against, record["outputs"], files]), facts


@contextlib.contextmanager
def alone(root: Path) -> Iterator[None]:
    """Nobody else measures in the folder meanwhile. Raises ArtifactError when somebody does."""
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ArtifactError(
                f"{root}: another insitu trade is at work there; wait, or give another --out"
            ) from error
        yield
