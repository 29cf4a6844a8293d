"""What a build modelled, what it did not, on what evidence, what that could cost, and the seconds: from its records.

Bounds are those that each row of evidence states (`pipeline.run.evidence`). Seconds come from `insitu trade` of the
same build, where the row names the knob, else from what the row says of them.
"""

from __future__ import annotations

import json
import math
import re
import textwrap
from pathlib import Path
from typing import Any

from pipeline.run.errors import ArtifactError
from pipeline.run.evidence import BOUNDS, bound_text, is_open
from pipeline.run.runner import Build, is_complete
from pipeline.trade.points import LADDERS

NAMED = re.compile(r"\bknob ([a-z]+\.[a-z_]+)")
MARKS = {True: "+", False: "-"}  # anything else that `modelled` says is a part: "~"


def needs(build: Build) -> dict[str, Any]:
    """Per stage: its terms with evidence and cost, seconds, and whether the record is still right.

    ``stages``: [{stage, seconds, cpu_seconds, stale, terms: [{term, modelled, because, could_cost}]}]; ``stale`` is
    empty, or says why the record no longer holds. A term that was not modelled, or in part, also has ``saved_s``
    [CPU s] and ``saved_by``, how that is or can be known; ``bound_rel``, ``bound_px`` and ``bound_deg``, each None
    where it is not stated, and ``no_bound``, why. ``left_out``: how many those are, and over those that are known the
    sum of the seconds, and of the bounds (and of their squares, rooted).

    Raises ArtifactError when a stage has not run.
    """
    bought = bought_by_knobs(build)
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
                "terms": [told(entry, bought, record.get("cpu_seconds")) for entry in record.get("evidence") or []],
            }
        )
    return {
        "build": str(build.out), "quality": build.settings.quality, "stages": stages, "left_out": left_out(stages),
    }  # fmt: skip


def told(entry: dict[str, Any], bought: dict[str, float], cpu_seconds: float | None = None) -> dict[str, Any]:
    """An entry of evidence, and of what was not wholly modelled the seconds saved and the bounds, None where unknown.

    ``cpu_seconds``: of its stage.
    """
    term = {key: entry.get(key, "") for key in ("term", "modelled", "because", "could_cost")}
    if not is_open(entry):
        return term
    knob = NAMED.search(str(term["because"]))
    saved, by = (bought.get(knob[1]) if knob else None), "this build's trade"
    if saved is None:
        saved, by = entry.get("saved_s"), entry.get("saved_by", "")
    if saved is None and cpu_seconds is not None and "saved_rel" in entry:
        saved = cpu_seconds * entry["saved_rel"]
    if saved is None:
        by = f"insitu trade --knobs {knob[1]} measures it" if knob and knob[1] in LADDERS else ""
    bounds = {name: entry.get(name) for name in BOUNDS}
    return {
        **term, "saved_s": saved, "saved_by": by, **bounds,
        "no_bound": entry.get("no_bound", ""),
    }  # fmt: skip


def bought_by_knobs(build: Build) -> dict[str, float]:
    """CPU seconds that this build saves by each knob's value, against the base of its `insitu trade`."""
    try:
        trade = json.loads((build.out / "trade" / "trade.json").read_bytes())
    except (FileNotFoundError, ValueError):
        return {}
    params = build.settings.params
    found = {}
    for row in trade.get("buys") or []:
        stage, _, knob = row["knob"].partition(".")
        if params.get(stage, {}).get(knob) == row["value"]:
            found[row["knob"]] = -row["d_cpu_seconds"]
    return found


def left_out(stages: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums over what was not modelled, or in part; how many of the terms tell nothing."""
    terms = [term for stage in stages for term in stage["terms"] if term["modelled"] is not True]
    bounds = [term["bound_rel"] for term in terms if term["bound_rel"] is not None]
    moves = [term for term in terms if term["bound_rel"] is None]
    moved = [term for term in moves if term["bound_px"] is not None or term["bound_deg"] is not None]
    saved = [term["saved_s"] for term in terms if term["saved_s"] is not None]
    return {
        "terms": len(terms), "bounded": len(bounds), "moved": len(moved), "bound_rel_sum": math.fsum(bounds),
        "bound_rel_root": math.hypot(0.0, *bounds), "timed": len(saved), "saved_s": math.fsum(saved),
    }  # fmt: skip


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
            if "saved_s" in term:
                saved, by = term["saved_s"], f" ({term['saved_by']})" if term["saved_by"] else ""
                lines += wrapped("saved", f"{'-' if saved is None else f'{saved:.1f} CPU s'}{by}")
                lines += wrapped("bound", bound_text(term))
    terms = [term for stage in found["stages"] for term in stage["terms"]]
    counts = [sum(term["modelled"] is state for term in terms) for state in (True, False)]
    lines += ["", f"modelled {counts[0]}, not {counts[1]}, in part {len(terms) - sum(counts)}"]
    lines.append(summed(found["left_out"]))
    if any(stage["stale"] for stage in found["stages"]):
        lines.append(f"some of this is out of date; {how_to_run(build)} renews it")
    return "\n".join(lines)


def summed(left: dict[str, Any]) -> str:
    """One line on what was not modelled, all together."""
    silent = left["terms"] - left["bounded"] - left["moved"]
    line = (
        f"not modelled, or in part, could cost {left['bound_rel_sum']:.1%} if all bounds were met at once, "
        f"{left['bound_rel_root']:.1%} if they were independent; of {left['terms']} terms "
        f"{left['moved']} only move things, {silent} say why they have no figure"
    )
    return line + (f"; {left['saved_s']:.1f} CPU s saved by {left['timed']} of them" if left["timed"] else "")


def wrapped(name: str, text: Any) -> list[str]:
    """A named text in an indented block; nothing when there is none."""
    if text in ("", None):
        return []
    return textwrap.wrap(f"{name}: {text}", 116, initial_indent="      ", subsequent_indent="        ")
