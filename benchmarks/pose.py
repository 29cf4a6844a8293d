"""Where the camera was: ``make bench-pose`` writes docs/benchmarks/pose.json, pose.md and pose.svg.

    python -m benchmarks.pose [--parts boards,real,coverage,markers] [--out docs/benchmarks]

Simulated corners and tracks for every route; rendered boards and markers through the detector; real photographs.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import pose_boards, pose_coverage, pose_real
from benchmarks.measures import cpu_seconds
from benchmarks.pose_page import write_page

PARTS: dict[str, Callable[[Path], Any]] = {
    "boards": lambda folder: pose_boards.boards(),
    "real": pose_real.real,
    "coverage": lambda folder: pose_coverage.all_routes(),
    "markers": lambda folder: pose_boards.markers(),
}


def figures(record: dict[str, Any]) -> dict[str, Any]:
    """The figures that were promised; None where photographs were not there."""
    true, calibrated, real = record["boards"]["true_lens"], record["boards"]["calibrated_lens"], record["real"]
    herzjesu, kitchen = real["herzjesu"].get("with_K", {}), real["captures"].get("kitchen", {})
    return {
        "reproj_px": true["reproj_px"]["median"], "rot_deg_30": true["rot_deg"]["median"],
        "pos_rel_30": true["pos_rel"]["median"], "pos_rel_30_calibrated": calibrated["pos_rel"]["median"],
        "coverage95": {route: found["held_95"] for route, found in record["coverage"].items()},
        "normal_deg": calibrated["normal_deg"]["worst"], "contact_px": calibrated["contact_px"]["worst"],
        "herzjesu_centre_mm": herzjesu.get("centre_mm_by_centres"), "herzjesu_rot_deg": herzjesu.get("rot_deg"),
        "abakisita_rel_median": real["abakisita"].get("rel_median"),
        "kitchen_rot_deg": kitchen.get("rot_deg"), "kitchen_pos_rel": kitchen.get("pos_rel"),
    }  # fmt: skip


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--parts",
        default=",".join(PARTS),
        help="which, with commas; the others are kept as they were, of none only the page is written",
    )
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder")
    given = parser.parse_args()
    file, wanted = given.out / "pose.json", [name for name in given.parts.split(",") if name]
    record = {} if set(wanted) == set(PARTS) else json.loads(file.read_text())
    seconds = dict(record.get("cpu_seconds", {}))
    record = {name: record[name] for name in PARTS if name in record}
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in wanted:
            with cpu_seconds() as timer:
                record[name] = PARTS[name](Path(folder))
            seconds[name] = timer.seconds
            file.write_text(
                json.dumps({**record, "cpu_seconds": seconds}, indent=1) + "\n"
            )  # kept if a later part fails
            print(f"{timer.seconds:5.0f} CPU s, {timer.wall:5.0f} s  {name}", file=sys.stderr, flush=True)  # noqa: T201
    record = {**figures(record), "threads": len(os.sched_getaffinity(0)), "cpu_seconds": seconds, **record}
    file.write_text(json.dumps(record, indent=1) + "\n")
    write_page(record, given.out)


if __name__ == "__main__":
    main()
