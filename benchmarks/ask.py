"""What ``--max-error`` and ``--time-budget`` reach on a capture with truth: predicted beside reached.

``python -m benchmarks.ask`` runs the bundled desk with each question and writes docs/benchmarks/ask.md; run.json of
each stays in the build folder. What is refused is run with ``--quality final``, which must miss it too. About 500 CPU
seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.trade.ask import TRUTH

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks" / "ask.md"
QUESTIONS = ("--max-error 0.01", "--max-error 0.02", "--max-error 0.05", "--max-error 0.1", "--time-budget 60")
ALLOWED, TIME = 1.5, 0.25  # the project's: reached over asked, and how far CPU seconds may be from those predicted
LONGER = 1.25  # times the least time that can be kept, where it is above the one that is asked
INTRODUCTION = """# An error or a time, asked of the desk

`make bench-ask` runs `insitu run sample_captures/desk` with each question, one after the other in one build folder, so
that they share a pilot. Where one is refused, `--quality final` is run and its error stands here. The error is the
larger of `object_rel_err` and `shadow_change_err`; *by its records* is what a run says of itself without truth. CPU
seconds are of the stages up to the composite; *with the pilot* is what was spent from nothing, what the pilot left
finished not counted twice.

{machine}, {cores} cores, load {load:.1f} at the end{busy}.

| asked | samples | map [px] | predicted | by its records | against truth | CPU s predicted | taken | with the pilot |
|---|---:|---:|---:|---:|---:|---:|---:|---:|
"""


def line_of(told: dict[str, Any]) -> str:
    """A row of the table, of one run.json, or of what was refused {asked, refused, final}."""
    asked = ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in told["asked"].items())
    if "refused" in told:
        return f"| {asked} | refused | | {told['refused']:.4f} | | final: {told['final']:.4f} | | | |"
    predicted, reached, settings = told["predicted"], told["reached"], told["settings"]
    errors = (predicted["error"], reached["error"], reached["against_truth"]["error"])
    seconds = (predicted["cpu_seconds"], reached["cpu_seconds"], reached["with_pilot_cpu_seconds"])
    cells = [asked, str(settings["render.samples"]), str(settings["probe.width"])]
    cells += [f"{error:.4f}" for error in errors] + [f"{spent:.0f}" for spent in seconds]
    return f"| {' | '.join(cells)} |"


def verdict(runs: Sequence[dict[str, Any]]) -> str:
    """Whether what the project asks of these runs holds, one sentence each."""
    refused, runs = [run for run in runs if "refused" in run], [run for run in runs if "refused" not in run]
    asked = [run for run in runs if "max_error" in run["asked"]]
    worst = max(run["reached"]["against_truth"]["error"] / run["asked"]["max_error"] for run in asked)
    apart = max(abs(run["reached"]["cpu_seconds"] / run["predicted"]["cpu_seconds"] - 1) for run in runs)
    costs = [run["reached"]["cpu_seconds"] for run in asked]
    distinct = len({json.dumps(run["settings"], sort_keys=True) for run in asked})
    words = (
        f"Reached over asked, against truth: {worst:.2f} at most (bound {ALLOWED}). CPU seconds are within {apart:.0%} "
        f"of what was predicted (bound {TIME:.0%}). {distinct} distinct settings, the dearest "
        f"{max(costs) / min(costs):.1f} times the cheapest (asked: 3, and 4 times)."
    )
    for run in refused:
        both = "which final misses too" if run["final"] > run["asked"]["max_error"] else "wrongly: final reaches it"
        words += f" {run['asked']['max_error']:.0%} is refused, {both} ({run['final']:.4f} against truth)."
    return textwrap.fill(words, 120) + "\n"


def page(runs: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    about: dict[str, Any] = {"machine": platform.machine(), "cores": os.cpu_count() or 1, "load": os.getloadavg()[1]}
    busy = ": busy with other work, seconds are indicative" if about["load"] > 1.5 * about["cores"] else ""
    return INTRODUCTION.format(**about, busy=busy) + "\n".join(map(line_of, runs)) + "\n\n" + verdict(runs)


def final_error(capture: Path, out: Path) -> float:
    """The larger figure against truth of ``--quality final``, run in a folder beside."""
    words = [sys.executable, "-m", "stages", "run", str(capture), "--out", f"{out}_final", "--quality", "final"]
    subprocess.run([*words, "--upto", "evaluate"], cwd=ROOT, check=True)
    numbers = json.loads((Path(f"{out}_final") / "evaluate" / "record.json").read_bytes())["numbers"]
    return max(numbers[name] for name in TRUTH.values())


def main() -> None:
    """Run what is asked, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capture", type=Path, default=ROOT / "sample_captures" / "desk")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "ask")
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    runs = []
    for question in QUESTIONS:
        words = [sys.executable, "-m", "stages", "run", str(args.capture), "--out", str(args.out), *question.split()]
        done = subprocess.run(words, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        if predicted := re.search(r"is predicted to err by ([\d.]+)", done.stderr):
            asked = {"max_error": float(question.split()[1])}
            final = final_error(args.capture, args.out)
            runs.append({"asked": asked, "refused": float(predicted[1]), "final": final})
            continue
        if least := re.search(r"ask (\d+) or more", done.stderr):  # a slow machine: the pilot alone took that long
            words[-1] = str(round(LONGER * int(least[1])))
            done = subprocess.run(words, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(done.stderr)
        runs.append(json.loads((args.out / "run.json").read_bytes()))
        (args.out / f"run{question.replace(' ', '_')}.json").write_text(json.dumps(runs[-1], indent=1))
    args.page.write_text(page(runs))


if __name__ == "__main__":
    main()
