"""How right the light is: ``make bench-probe`` writes docs/benchmarks/probe.json, probe.md and probe.svg.

    python -m benchmarks.probe [--parts fit,small,coverage,unwrap,speed,flux,captures,real] [--out docs/benchmarks]

Simulated balls over distance, angle and size; a sun clipped in every frame; whole captures with truth; real balls.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import probe_captures, probe_fit, probe_flux, probe_unwrap
from benchmarks.probe_page import write_page

LEAST_RADIUS_PX, FINE_RADIUS_PX = (
    100,
    500,
)  # from which the figures are promised: directions, and light that is not split
CAPTURES = {"desk": "sample_captures/desk", "kitchen_table": "tests/kitchen_table"}


def figures(record: dict[str, Any]) -> dict[str, Any]:
    """The worst cells, and one object per peer."""
    balls = [row for row in record["fit"] if row["radius_px"] >= LEAST_RADIUS_PX]
    found = {"direction_rms_deg": max(row["direction_rms_deg"] for row in balls)}
    found |= light(record["unwrap"], "ours")
    found["sun_flux_rel_err"] = record["flux_summary"].get("sun_flux_rel_err")
    found |= record["speed"]
    peers = {
        name: light(record["unwrap"], name)
        for name in ("orthographic", "skylibs")
        if any(row["method"] == name for row in record["unwrap"])
    }
    peers["orthographic"]["direction_rms_deg"] = max(row["orthographic_rms_deg"] for row in balls)
    for name, capture in record["captures"].items():
        key = f"{name.split('_')[0]}_sh_rel_err"
        found[key] = capture["sh_rel_err"]
        peers["orthographic"][key] = capture["orthographic"]["sh_rel_err"]
    return {**found, "peers": peers}


def light(rows: list[dict[str, Any]], method: str) -> dict[str, float]:
    """Worst irradiance and sun of one method: whole light from 500 px of radius on, the sky alone from 100."""
    mine = [row for row in rows if row["method"] == method]
    fine = [row for row in mine if row["radius_px"] >= FINE_RADIUS_PX]
    return {
        "sh_rel_err": max([row["sh_rel_err"] for row in fine] + [row["split_sh_rel_err"] for row in mine]),
        "sun_rel_err": max(row["sun_rel_err"] for row in fine),
    }


def captures(folder: Path) -> dict[str, Any]:
    """The whole chain on captures with truth, those that are there."""
    there = {"desk": True, "kitchen_table": (probe_captures.DATA / "captures/kitchen_table").is_dir()}
    return {
        name: probe_captures.measure(Path(path), folder / name) for name, path in CAPTURES.items() if there[name]
    }  # fmt: skip


PARTS: dict[str, Callable[[Path], Any]] = {
    "fit": lambda folder: probe_fit.sweep(),
    "small": lambda folder: probe_fit.small(),
    "coverage": lambda folder: probe_fit.coverage(100),
    "unwrap": lambda folder: probe_unwrap.rows(),
    "speed": lambda folder: probe_unwrap.unwrap_s_24mpx(),
    "flux": lambda folder: probe_flux.rows(),
    "captures": captures,
    "real": probe_captures.real,
}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--parts", default=",".join(PARTS), help="which, with commas; the others are kept as they were")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder")
    given = parser.parse_args()
    file, wanted = given.out / "probe.json", given.parts.split(",")
    record = {} if set(wanted) == set(PARTS) else json.loads(file.read_text())
    record, seconds = {name: record[name] for name in PARTS if name in record}, dict(record.get("seconds", {}))
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted:
            started = time.time()
            record[name] = PARTS[name](Path(folder))
            seconds[name] = time.time() - started
            print(f"{seconds[name]:5.0f} s  {name}", file=sys.stderr, flush=True)  # noqa: T201  a command's progress
    record["flux_summary"] = probe_flux.summary(record["flux"])
    record = {**figures(record), "threads": len(os.sched_getaffinity(0)), "seconds": seconds, **record}
    given.out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(record, indent=1) + "\n")
    write_page(record, given.out)


if __name__ == "__main__":
    main()
