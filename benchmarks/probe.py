"""How right the light is: ``make bench-probe`` writes docs/benchmarks/probe.json, probe.md and probe.svg.

    python -m benchmarks.probe [--out docs/benchmarks]

Simulated balls over distance, angle and size; a sun clipped in every frame; whole captures with truth; real balls.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
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


def measure(folder: Path, say: Any) -> dict[str, Any]:
    """Everything, in order of cost."""
    record: dict[str, Any] = {"fit": probe_fit.sweep()}
    say(f"fit: {len(record['fit'])} cells")
    record["coverage"] = probe_fit.coverage(100)
    say(f"fit: 95 % regions hold {record['coverage']['held_95']:.0%}")
    record["unwrap"], record["speed"] = probe_unwrap.rows(), probe_unwrap.unwrap_s_24mpx()
    say(f"unwrap: {record['speed']['unwrap_s_24mpx']:.2f} s of 24 Mpx")
    record["flux"] = probe_flux.rows()
    record["flux_summary"] = probe_flux.summary(record["flux"])
    say(f"clipped sun: {record['flux_summary']}")
    record["captures"] = {}
    for name, path in CAPTURES.items():
        if name != "kitchen_table" or (probe_captures.DATA / "captures/kitchen_table").is_dir():
            record["captures"][name] = probe_captures.measure(Path(path), folder / name)
            say(f"{name}: {record['captures'][name]['sh_rel_err']:.4f}")
    record["real"] = probe_captures.real(folder)
    return record


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder")
    given = parser.parse_args()
    started = time.time()

    def say(text: str) -> None:
        print(f"{time.time() - started:5.0f} s  {text}", file=sys.stderr, flush=True)  # noqa: T201  a command's progress

    with tempfile.TemporaryDirectory() as folder:
        record = measure(Path(folder), say)
    threads = len(os.sched_getaffinity(0))
    record = {**figures(record), "threads": threads, "wall_s": time.time() - started, **record}
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "probe.json").write_text(json.dumps(record, indent=1) + "\n")
    write_page(record, given.out)
    say(f"wrote {given.out / 'probe.md'}")


if __name__ == "__main__":
    main()
