"""Read, compute, check, write, record: the one way from files to files.

Make decides what to ask by time; this decides what to do by digest of inputs, parameters, code and library versions.
``record.json`` is removed before the first output is replaced and written last, so an interrupted stage leaves none and
runs again. Two processes may work on one build: a stage is locked while it runs, its inputs while they are read.

A stage may offer results while it computes (`pipeline.run.progress`): their files, and the pictures that follow live
from them, replace the old ones without a record. Interrupted, it returns what it has; the record then says incomplete,
which is good enough for the stages after it and never fresh.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import importlib.metadata
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from pipeline.run import closure, formats, memory, progress
from pipeline.run.errors import ArtifactError
from pipeline.run.live import Live, Stop
from pipeline.run.settings import Settings
from pipeline.run.stage import Artifact, Graph, Stage
from pipeline.types import Raster, Result

LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "pycolmap", "mitsuba", "OpenEXR", "rawpy")
log = logging.getLogger("insitu")


@dataclass
class Build:
    """One capture's build folder, with what this process already holds in memory."""

    graph: Graph
    out: Path
    settings: Settings
    knobs: dict[str, Any]
    memory: dict[str, tuple[str, Any]] = field(default_factory=dict)  # artifact -> its digest and value
    versions: dict[str, str] = field(default_factory=lambda: {n: importlib.metadata.version(n) for n in LIBRARIES})
    stop: Stop = field(default_factory=Stop)

    def record(self, name: str) -> dict[str, Any] | None:
        """The record of a stage, or None when it has not run."""
        path = self.out / name / "record.json"
        try:
            record = json.loads(path.read_bytes())
        except (FileNotFoundError, ValueError):
            return None
        produced = {artifact.name for artifact in self.graph[name].outputs.values()}
        whole = isinstance(record, dict) and produced <= set(record.get("outputs") or {})
        return record if whole else None

    def value(self, artifact: Artifact) -> Any:
        """An input, from memory when that is what its producer recorded last, else from disk."""
        producer = self.graph.producer[artifact.name].name
        digest = (self.record(producer) or {"outputs": {}})["outputs"].get(artifact.name, "")
        known, value = self.memory.get(artifact.name, ("", None))
        if not digest or known != digest:
            value = formats.read(self.out / producer, artifact)
            self.memory[artifact.name] = digest, value
        return value

    def input_digests(self, stage: Stage) -> dict[str, str]:
        """Digest of every input as its producer recorded it. Raises ArtifactError when a producer has not run."""
        digests = {}
        for argument, artifact in stage.inputs.items():
            if artifact.kind == "records":
                digests[argument] = _digest_of(self.records_before(stage, timing=False))
                continue
            producer = self.graph.producer[artifact.name].name
            record = self.record(producer)
            if record is None:
                raise ArtifactError(
                    f"{self.out / producer}: has not run; needed by {stage.name}; run insitu {producer}"
                )
            digests[argument] = record["outputs"][artifact.name]
        return digests

    def records_before(self, stage: Stage, timing: bool = True) -> dict[str, Any]:
        """numbers, warnings, evidence, params (and seconds) of the stages before this one."""
        keys = ["numbers", "warnings", "evidence", "params", "versions", *(["seconds"] if timing else [])]
        records = {parent.name: self.record(parent.name) or {} for parent in self.graph.parents(stage)}
        told = {name: {key: record.get(key) for key in keys} for name, record in records.items()}
        if "evaluate" in told:
            told["evaluate"]["waterfall"] = self.waterfall()
        return told

    def waterfall(self) -> dict[str, dict[str, float]]:
        """Errors with truth in place of what stages estimated, if `keep_waterfall` was told of this very composite."""
        try:
            found = json.loads((self.out / "waterfall.json").read_bytes())
        except (FileNotFoundError, ValueError):
            return {}
        current = (self.record("composite") or {"outputs": {}})["outputs"].get("composite")
        return found["errors"] if current and found.get("composite") == current else {}

    def keep_waterfall(self, errors: dict[str, dict[str, float]]) -> None:
        """Write what `waterfall` reads: these rows, and former ones of the same composite and the same truth.

        The truth is the same where the error with nothing in place is. Terms forced off stand last.
        """
        former = self.waterfall()
        known = {**former, **errors} if former.get("nothing") == errors["nothing"] else errors
        rows = dict(sorted(known.items(), key=lambda row: row[0].startswith("without ")))
        current = (self.record("composite") or {"outputs": {}})["outputs"].get("composite")
        text = json.dumps({"composite": current, "errors": rows}, indent=1)
        formats.write_bytes(self.out / "waterfall.json", text.encode() + b"\n")

    @contextlib.contextmanager
    def locked(self, stage: Stage) -> Iterator[None]:
        """Keep other processes from running the stage, or from replacing its inputs, until the block ends.

        Locks are taken in reading order, so that no two processes wait for each other.
        """
        with contextlib.ExitStack() as stack:
            for other in [*self.graph.parents(stage), stage]:
                (self.out / other.name).mkdir(parents=True, exist_ok=True)
                file = stack.enter_context((self.out / other.name / ".lock").open("w"))
                fcntl.flock(file, fcntl.LOCK_EX if other is stage else fcntl.LOCK_SH)
            yield

    def run(self, stage: Stage) -> str:
        """Run one stage unless its record shows that nothing changed.

        ``"fresh"``, ``"ran"``, ``"same"`` (it ran, to the same bytes), or ``"part"`` (it was interrupted).
        """
        with self.locked(stage):
            return self._run(stage)

    def wanted(self, stage: Stage) -> dict[str, Any]:
        """What the record of a stage says when nothing changed. Raises ArtifactError when a producer has not run."""
        return {
            "stage": stage.name,
            "inputs": self.input_digests(stage),
            "params": self.settings.params[stage.name],
            "code": closure.digest(stage.compute.__module__),
            "versions": self.versions,
        }

    def _run(self, stage: Stage) -> str:
        wanted = self.wanted(stage)
        old = self.record(stage.name)
        if old and not stage.impure and self.is_fresh(stage, wanted, old):
            os.utime(self.out / stage.name / "record.json")
            return "fresh"
        folder = self.out / stage.name
        for scratch in folder.glob(".*/"):
            shutil.rmtree(scratch)  # of a process that was killed while writing; ours begin only now
        checkpoint = folder / "checkpoint.npz"
        show = functools.partial(self._show, stage)
        live = Live(stage.name, self.stop, checkpoint, _digest_of(wanted), show)
        memory.reset_peak()
        with progress.hosted(live):
            try:
                result = self._compute(stage)
            finally:
                self.stop.patient = False
                progress.report(stage.name, 1.0)
        values = settled(stage, result)
        (folder / "record.json").unlink(missing_ok=True)
        outputs = {}
        for artifact in stage.outputs.values():
            outputs[artifact.name] = formats.digest(formats.write(folder, artifact, values[artifact.name]))
            self.memory[artifact.name] = outputs[artifact.name], as_read(values[artifact.name])
        spent = dict(zip(("seconds", "cpu_seconds"), live.spent().tolist(), strict=True))
        spent["peak_mb"] = memory.peak_mb()  # of the whole process, so with what it holds of earlier stages
        measured = {"numbers": result.numbers, "warnings": result.warnings, "evidence": result.evidence}
        changed = old is None or old.get("outputs") != outputs
        record = wanted | {"outputs": outputs} | spent | measured
        formats.write_bytes(folder / "record.json", _json(record))
        for warning in result.warnings:
            log.warning("%s: %s", stage.name, warning.removeprefix(f"{stage.name}: "))
        if not is_complete(record):
            os.utime(folder / "record.json", (0, 0))  # older than all it needs, so that make asks for it again
            return "part"
        checkpoint.unlink(missing_ok=True)
        return "ran" if changed else "same"

    def is_fresh(self, stage: Stage, wanted: dict[str, Any], old: dict[str, Any]) -> bool:
        """Whether a record is complete, says what is ``wanted``, and its files are there."""
        if any(old.get(key) != json.loads(_json(value)) for key, value in wanted.items()):
            return False
        if not is_complete(old):
            return False
        return all((self.out / stage.name / artifact.filename).exists() for artifact in stage.outputs.values())

    def _compute(self, stage: Stage) -> Result:
        params = self.knobs[stage.name].model_validate(self.settings.params[stage.name])
        if stage.impure:
            scene = Path(self.settings.scene) if self.settings.scene else None
            return stage.compute(Path(self.settings.capture), scene, params)
        inputs = {
            argument: self.records_before(stage) if artifact.kind == "records" else self.value(artifact)
            for argument, artifact in stage.inputs.items()
        }
        return stage.compute(**inputs, params=params)

    def _show(self, stage: Stage, result: Result, seen: Callable[[Path], None]) -> None:
        """Write an offered result, after the pictures that follow live from it; ``seen`` is told of each."""
        values = settled(stage, result)
        for follower in self.graph.stages:
            if follower.live and stage in self.graph.parents(follower):
                self._follow(follower, stage, values, seen)
        self._replace(stage, values, seen)

    def _follow(self, follower: Stage, stage: Stage, values: dict[str, Any], seen: Callable[[Path], None]) -> None:
        """Run a live stage on offered values, unless another input is missing or another process is at work there.

        Locks are only tried, never waited for: ``stage`` is locked already, and may come later in reading order.
        """
        others = [parent for parent in self.graph.parents(follower) if parent is not stage]
        if any(self.record(parent.name) is None for parent in others):
            return
        with contextlib.ExitStack() as stack:
            for other in [*others, follower]:
                (self.out / other.name).mkdir(exist_ok=True)
                file = stack.enter_context((self.out / other.name / ".lock").open("w"))
                try:
                    fcntl.flock(file, fcntl.LOCK_NB | (fcntl.LOCK_EX if other is follower else fcntl.LOCK_SH))
                except BlockingIOError:
                    return
            inputs = {
                argument: as_read(values[artifact.name]) if artifact.name in values else self.value(artifact)
                for argument, artifact in follower.inputs.items()
            }
            params = self.knobs[follower.name].model_validate(self.settings.params[follower.name])
            with progress.hosted(progress.NOBODY):
                result = follower.compute(**inputs, params=params)
            self._replace(follower, settled(follower, result), seen)

    def _replace(self, stage: Stage, values: dict[str, Any], seen: Callable[[Path], None]) -> None:
        """Write outputs that no record vouches for, pictures first."""
        (self.out / stage.name / "record.json").unlink(missing_ok=True)
        for artifact in sorted(stage.outputs.values(), key=lambda artifact: artifact.kind != "picture"):
            path = formats.write(self.out / stage.name, artifact, values[artifact.name])
            if artifact.kind == "picture":
                seen(path)

    def run_all(self, stages: Iterable[Stage], report: Callable[[str, str, float], None]) -> None:
        """Run stages in order; ``report(name, outcome, seconds)`` after each."""
        for stage in stages:
            start = time.perf_counter()
            outcome = self.run(stage)
            report(stage.name, outcome, time.perf_counter() - start)

    def verify(self) -> list[str]:
        """Problems found by recomputing the digest of every output on disk."""
        problems = []
        for stage in self.graph.stages:
            record = self.record(stage.name)
            if record is None:
                problems.append(f"{stage.name}: has not run")
                continue
            for artifact in stage.outputs.values():
                path = self.out / stage.name / artifact.filename
                if not path.exists():
                    problems.append(f"{path}: missing; delete {stage.name}/record.json and run again")
                elif formats.digest(path) != record["outputs"][artifact.name]:
                    problems.append(f"{path}: differs from what {stage.name} wrote")
        return problems


def is_complete(record: dict[str, Any]) -> bool:
    """Whether a record is of a stage that was not interrupted."""
    return (record.get("numbers") or {}).get("complete") is not False


def settled(stage: Stage, result: Result) -> dict[str, Any]:
    """Every output by the name of its artifact, settled. Raises TypeError when they are not those declared."""
    if set(result.outputs) != set(stage.outputs):
        raise TypeError(f"{stage.name}: compute returned {sorted(result.outputs)}, declared {sorted(stage.outputs)}")
    return {artifact.name: settle(artifact, result.outputs[key]) for key, artifact in stage.outputs.items()}


def settle(artifact: Artifact, value: Any) -> Any:
    """The value as it is written; `as_read` of it is what a later process reads back."""
    if artifact.kind == "json":
        adapter = TypeAdapter(artifact.type)
        return adapter.validate_json(adapter.dump_json(value))
    if artifact.kind == "raster":
        return settle_raster(value)
    if artifact.kind == "rasters":
        return {name: settle_raster(raster) for name, raster in sorted(value.items())}
    return value


def settle_raster(raster: Raster) -> Raster:
    """Channels as float32, uint32 or, where the stage chose it, float16; contiguous."""
    channels: dict[str, np.ndarray] = {
        name: np.ascontiguousarray(values, _stored_type(values)) for name, values in raster.channels.items()
    }
    return Raster(channels, raster.space, raster.attributes)


def _stored_type(values: np.ndarray) -> type:
    if values.dtype == np.float16:
        return np.float16
    return np.uint32 if values.dtype.kind in "ub" else np.float32


def as_read(value: Any) -> Any:
    """A settled value exactly as a later process reads it back: one process and many come to the same bytes."""
    if isinstance(value, Raster):
        wide = {n: v.astype(np.float32) if v.dtype == np.float16 else v for n, v in value.channels.items()}
        said = {name: v for name, v in value.attributes.items() if name not in formats.LAYOUT}
        return Raster(wide, value.space, said)
    if isinstance(value, dict) and any(isinstance(part, Raster) for part in value.values()):
        return {name: as_read(part) for name, part in value.items()}
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} does not go into a record")


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=1, default=_plain, sort_keys=True).encode() + b"\n"


def _digest_of(value: Any) -> str:
    return hashlib.sha256(_json(value)).hexdigest()
