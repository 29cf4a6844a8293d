"""Rows of a trade with made-up numbers, for the tests of what is made of them."""

from __future__ import annotations

from pipeline.trade import front


def row(label: str, kind: str, cpu: float, error: float | None, **changes) -> dict:
    stage = {"seconds": cpu / 2, "cpu_seconds": cpu, "peak_mb": 500.0}
    changes = {knob.replace("__", "."): value for knob, value in changes.items()}
    return {
        "label": label, "kind": kind, "quality": "preview", "changes": changes,
        "errors": {"changed_rel_err": error, "object_rel_err": error, "shadow_change_err": None},
        "cpu_seconds": cpu, "seconds": cpu / 2, "peak_mb": 500.0, "composite_mb": 9.0, "stages": {"render": stage},
        "linked": [], "spent_seconds": cpu / 2,
    }  # fmt: skip


ROWS = [
    row("seed 1", "repeat", 31.0, 0.020, render__seed=1),
    row("seed 2", "repeat", 29.0, 0.022, render__seed=2),
    row("preview", "base", 30.0, 0.021),
    row("draft", "preset", 12.0, 0.050),
    row("final", "preset", 150.0, 0.010),
    row("render.samples=8", "knob", 15.0, 0.035, render__samples=8),
    row("render.samples=4", "knob", 11.0, 0.060, render__samples=4),
    row("render.samples=128", "knob", 60.0, 0.014, render__samples=128),
    row("probe.width=512", "knob", 26.0, 0.024, probe__width=512),
    row("composite.kind=ratio", "knob", 29.5, 0.0215, composite__kind="ratio"),
    row("merge.weights=poisson", "knob", 31.0, None, merge__weights="poisson"),
    {"label": "probe.width=64", "kind": "knob", "quality": "", "changes": {"probe.width": 64}, "failed": "no ball"},
]


def about() -> dict:
    told = {"capture": "made_up", "against": "truth", "base": "preview", "cores": 2, "machine": "x86_64", "repeats": 2}
    return {**told, "noise": front.noise(ROWS)}
