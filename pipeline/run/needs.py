"""What a build modelled, what it did not, on what evidence, what that could cost, and the seconds: from its records."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from pipeline.run.errors import ArtifactError
from pipeline.run.runner import Build, is_complete

MARKS = {True: "+", False: "-"}  # anything else that `modelled` says is a part: "~"


def needs(build: Build) -> dict[str, Any]:
    """Per stage: its terms with evidence and cost, seconds, and whether the record is still right.

    ``stages``: [{stage, seconds, cpu_seconds, stale, terms: [{term, modelled, because, could_cost}]}]; ``stale`` is
    empty, or says why the record no longer holds. Raises ArtifactError when a stage has not run.
    """
    records = {stage.name: build.record(stage.name) for stage in build.graph.stages}
    if missing := [name for name, record in records.items() if record is None]:
        ran = "has" if len(missing) == 1 else "have"
        raise ArtifactError(f"{build.out}: {', '.join(missing)} {ran} not run; {how_to_run(build)} makes them")
    stages = []
    for stage in build.graph.stages:
        record = records[stage.name] or {}
        stages.append(
            {
                "stage": stage.name,
                "seconds": record.get("seconds"),
                "cpu_seconds": record.get("cpu_seconds"),
                "stale": stale(build, stage.name),
                "terms": [
                    {key: entry.get(key, "") for key in ("term", "modelled", "because", "could_cost")}
                    for entry in record.get("evidence") or []
                ],
            }
        )
    return {"build": str(build.out), "quality": build.settings.quality, "stages": stages}


def how_to_run(build: Build) -> str:
    """The command that brings a build up to date."""
    return f"insitu run {build.settings.capture} {build.settings.switches} --out {build.out}"


def stale(build: Build, name: str) -> str:
    """Why a stage would run again, in a few words; empty when it would not."""
    stage = build.graph[name]
    record = build.record(name) or {}
    if not is_complete(record):
        return "was interrupted"
    wanted = build.wanted(stage)
    different = [key for key, value in wanted.items() if record.get(key) != value]
    words = {"inputs": "its inputs", "params": "its settings", "code": "its code", "versions": "a library"}
    if different:
        return f"{', '.join(words.get(key, key) for key in different)} changed since"
    if not build.is_fresh(stage, wanted, record):
        return "a file of it is missing"
    if stage.impure:
        made = (build.out / name / "record.json").stat().st_mtime_ns
        texts = [Path(path) for path in (build.settings.capture, build.settings.scene) if path]
        newer = [path.name for path in texts if path.exists() and path.stat().st_mtime_ns > made]
        return f"{', '.join(newer)} changed since" if newer else ""
    return ""


def as_text(found: dict[str, Any], build: Build) -> str:
    """Plain text, one stage after the other; + modelled, - not, ~ in part."""
    lines = [f"{found['build']}, {found['quality']}: + modelled, - not modelled, ~ in part"]
    for stage in found["stages"]:
        note = f"  ({stage['stale']})" if stage["stale"] else ""
        lines += ["", f"{stage['stage']}  {stage['seconds']:.2f} s, {stage['cpu_seconds']:.2f} CPU s{note}"]
        for term in stage["terms"]:
            known = isinstance(term["modelled"], bool)
            lines.append(f"  {MARKS[term['modelled']] if known else '~'} {term['term']}")
            if not known:
                lines += wrapped("how far", term["modelled"])
            lines += wrapped("because", term["because"]) + wrapped("could cost", term["could_cost"])
    terms = [term for stage in found["stages"] for term in stage["terms"]]
    counts = [sum(term["modelled"] is state for term in terms) for state in (True, False)]
    lines += ["", f"modelled {counts[0]}, not {counts[1]}, in part {len(terms) - sum(counts)}"]
    if any(stage["stale"] for stage in found["stages"]):
        lines.append(f"some of this is out of date; {how_to_run(build)} renews it")
    return "\n".join(lines)


def wrapped(name: str, text: Any) -> list[str]:
    """A named text in an indented block; nothing when there is none."""
    if text in ("", None):
        return []
    return textwrap.wrap(f"{name}: {text}", 116, initial_indent="      ", subsequent_indent="        ")
