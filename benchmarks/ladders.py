"""Every ladder of desk forced to its top: what changes beside what evidence says that it could cost, and CPU seconds.

``python -m benchmarks.ladders`` runs the draft of a capture, then each rung alone and all together, and writes
docs/benchmarks/ladders.md. About 400 CPU seconds. A rung without data on desk (further views, a room, geometry) is not
there to be forced.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.metrics import box
from pipeline.run import artifacts as A
from pipeline.run import formats

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks" / "ladders.md"
STAGES = ("merge", "develop", "calibrate", "pose", "probe", "lights", "plane", "reflectance", "render", "composite")

# What forces a rung that the draft of desk does not climb, and the terms whose bounds it answers to.
RUNGS: dict[str, list[str]] = {
    "merge.align=always": ["alignment of frames"],
    "calibrate.distortion=always": ["lens k2", "lens k4 k5 k6"],
    "probe.width=1024": ["directions finer than a texel"],
    "lights.max_half_angle_deg=30": ["bright patch apart from the sky"],
    "plane.left_out=0.001": ["plane beyond the rectangle"],
    "reflectance.gloss=always": ["specular lobe of the ground"],
    "render.threshold=0": ["region", "every pixel of the region"],
    "render.depth=10": ["path depth"],
}
INTRODUCTION = """# Rungs that desk does not climb, forced

`make bench-ladders` runs the draft of desk, then again with each rung of a ladder forced that evidence left out, and
with all of them. *Stated* is what `insitu needs` says that the rung could cost: a share, or a shift, which counts as
what it does to the draft's own picture (*as a share*: median, 95 %). *Changed* is the difference to the draft on 5x5
means, relative to it; objects are pixels that one covers, shadows those that change by more than 5 %. *Another seed* is
the draft again: noise of its 8 samples, which is in every row where the render ran anew. CPU seconds are of the stages
up to the composite, more than the draft's {base:.0f}.

{machine}, {cores} cores, load {load:.1f} at the end{busy}.

| forced | stated | as a share: objects | shadows | changed: objects | shadows | CPU s more |
|---|---:|---:|---:|---:|---:|---:|
"""


@dataclass(frozen=True)
class Regions:
    """What a draft shows, 5x5 means (H, W, 3), and which of its pixels (H, W) are objects and shadows."""

    picture: np.ndarray
    objects: np.ndarray
    shadows: np.ndarray

    def spread(self, relative: np.ndarray) -> dict[str, list[float]]:
        """Median and 95 % of a relative change (H, W) of objects and of shadows."""
        parts = {"objects": self.objects, "shadows": self.shadows}
        return {name: np.quantile(relative[where], [0.5, 0.95]).tolist() for name, where in parts.items()}

    def changed(self, out: Path) -> dict[str, list[float]]:
        """By how much another build's picture differs."""
        other = box(formats.read(out / "composite", A.COMPOSITE).rgb())
        return self.spread(length(other - self.picture) / length(self.picture))

    def moved(self, px: float) -> dict[str, list[float]]:
        """What a shift of the whole picture by ``px`` would change, across its edges."""
        slope = sum(length(part) ** 2 for part in np.gradient(self.picture, axis=(0, 1))) ** 0.5
        return self.spread(px * slope / length(self.picture))


def length(picture: np.ndarray) -> np.ndarray:
    """(H, W) over RGB."""
    return np.asarray(np.linalg.norm(picture, axis=-1))


def regions_of(out: Path) -> Regions:
    """Objects and shadows of a build."""
    picture = box(formats.read(out / "composite", A.COMPOSITE).rgb())
    plate = box(formats.read(out / "develop", A.PHOTOGRAPHS)["plate"].rgb())
    covered = box(formats.read(out / "render", A.LAYERS)["obj.A"])
    shadow = (covered < 1e-3) & (length(picture - plate) > 0.05 * length(plate))
    return Regions(picture, covered > 0.99, shadow)


def stated(out: Path, terms: Iterable[str]) -> dict[str, float]:
    """Sums of the bounds [share], [px] that the evidence of a build states of some terms; what is modelled is none."""
    wanted, records = set(terms), [json.loads(path.read_text()) for path in out.glob("*/record.json")]
    rows = [row for record in records for row in record.get("evidence") or [] if row["term"] in wanted]
    rows = [row for row in rows if row["modelled"] is not True]
    return {name: sum(float(row.get(name) or 0) for row in rows) for name in ("bound_rel", "bound_px")}


def cpu_seconds(out: Path) -> float:
    """Of the stages up to the composite that a rung may change."""
    return float(sum(json.loads((out / stage / "record.json").read_text())["cpu_seconds"] for stage in STAGES))


def forced(capture: Path, base: Path, out: Path, switches: Iterable[str]) -> Path:
    """A draft with these switches, up to the composite; what they do not change is linked from the ``base``."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(base, out, copy_function=os.link)
    (out / "settings.json").unlink()
    words = [word for switch in switches for word in ("--set", switch)]
    run = [sys.executable, "-m", "stages", "run", str(capture), "--out", str(out), "--quality", "draft", *words]
    subprocess.run([*run, "--upto", "composite"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return out


def measured(capture: Path, base: Path, folder: Path, switches: list[str], terms: Iterable[str]) -> dict[str, Any]:
    """What forcing changes of a finished draft, beside what its evidence states; seconds more than the draft's."""
    regions = regions_of(base)
    out = forced(capture, base, folder, switches)
    bound = stated(base, terms)
    return {
        "switches": switches, **bound, "moved": regions.moved(bound["bound_px"]), "changed": regions.changed(out),
        "cpu_seconds": cpu_seconds(out) - cpu_seconds(base),
    }  # fmt: skip


def line_of(row: dict[str, Any]) -> str:
    """A row of the table."""

    def two(values: list[float]) -> str:
        return ", ".join(f"{value:.2%}" for value in values)

    said = [f"{row['bound_rel']:.2%}"] * (row["bound_rel"] > 0) + [f"{row['bound_px']:.3f} px"] * (row["bound_px"] > 0)
    share = [two([row["bound_rel"] + value for value in row["moved"][name]]) for name in ("objects", "shadows")]
    cells = [row["name"], " + ".join(said) or "nothing", *share]
    cells += [two(row["changed"][name]) for name in ("objects", "shadows")]
    return f"| {' | '.join(cells)} | {row['cpu_seconds']:+.1f} |"


def page(rows: list[dict[str, Any]], base: float) -> str:
    """Markdown."""
    about: dict[str, Any] = {"machine": platform.machine(), "cores": os.cpu_count() or 1, "load": os.getloadavg()[1]}
    busy = ": busy with other work, seconds are indicative" if about["load"] > 1.5 * about["cores"] else ""
    return INTRODUCTION.format(**about, busy=busy, base=base) + "\n".join(map(line_of, rows)) + "\n"


def main() -> None:
    """Run the draft, every rung and all of them, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capture", type=Path, default=ROOT / "sample_captures" / "desk")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "ladders")
    parser.add_argument("--page", type=Path, default=PAGE)
    args = parser.parse_args()
    base = args.out / "draft"
    words = [sys.executable, "-m", "stages", "run", str(args.capture), "--out", str(base), "--quality", "draft"]
    subprocess.run([*words, "--upto", "composite"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    wanted: dict[str, tuple[list[str], list[str]]] = {"another seed": (["render.seed=1"], [])}
    wanted |= {f"`{switch}`": ([switch], terms) for switch, terms in RUNGS.items()}
    wanted["all of them"] = (list(RUNGS), [term for terms in RUNGS.values() for term in terms])
    rows = []
    for name, (switches, terms) in wanted.items():
        rows.append({"name": name, **measured(args.capture, base, args.out / "forced", switches, terms)})
        args.page.write_text(page(rows, cpu_seconds(base)))


if __name__ == "__main__":
    main()
