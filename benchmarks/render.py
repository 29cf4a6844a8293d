"""How fast the render is at equal error: ``make bench-render`` writes docs/benchmarks/render.json and render.md.

    python -m benchmarks.render [--full] [--size 1280x720] [--parts diffuse_glossy,...] [--resume] [--out FOLDER]

Replicates of the strategies take turns, so that whatever else the machine does burdens all alike. Every part is kept
in ``build/bench_render`` as soon as it is measured: ``--resume`` goes on where a run was broken off. The test for bias
is a command of its own, `benchmarks.zscore`; its figures in render.json are kept.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import cycles, preview
from benchmarks.estimators import Loaded, insitu, load, naive, ours, plate_of, reference
from benchmarks.measures import Point, cpu_seconds, display, exposure_gain, middle, speedup, squared_error
from benchmarks.page import write_page
from benchmarks.plates import tiny_ratio
from benchmarks.scenes import SCENES, Scene, facts
from stages.knobs import Render

NAIVE_DEPTH = 8
LATTICE = 3  # every third pixel in both directions: an error needs no more, a reference costs a ninth
TILE = 8  # chosen pixels, of the comparison of means
KEPT = Path("build/bench_render")


@dataclass(frozen=True)
class Budget:
    """How much to measure."""

    replicates: int = 3
    naive: tuple[int, ...] = (4, 16, 64)  # samples per pixel; the last is replicated
    ours: tuple[int, ...] = (4, 16)
    reference: tuple[int, int] = (16, 128)  # samples per pixel; the second where there is noise
    plate: int = 16
    cycles: int = 4


FULL = Budget(5, (4, 16, 64, 256), (4, 16, 64), (64, 1024), 64, 32)


def measure(scene: Scene, budget: Budget, threads: int, say: Any) -> dict[str, Any]:
    """Curves and speed-ups of one scene."""
    stage = load(scene)
    plate = plate_of(stage, NAIVE_DEPTH, budget.plate)
    gain = exposure_gain(plate)
    width, height = scene.camera.width, scene.camera.height
    chosen = lattice(width, height)
    part, share = stage.at(chosen), len(stage.rays) / len(chosen)
    warm(part, plate[chosen], budget)
    with cpu_seconds() as spent:
        truths = [display(reference(part, plate[chosen], budget.reference, 1000 + half), gain) for half in range(2)]
    say(f"{scene.name}: two references, {spent.seconds:.0f} CPU s")
    groups: dict[tuple[str, int], list[Point]] = {}

    def add(name: str, picture: np.ndarray, seconds: float, samples: int) -> None:
        point = Point(squared_error(display(picture, gain), *truths), seconds, samples)
        groups.setdefault((name, samples), []).append(point)
        say(f"{scene.name}: {name} {samples} spp, squared error {point.error:.3f}, {seconds:.2f} CPU s")

    for turn in range(budget.replicates):
        for name, strategy, ladder in (("naive", naive, budget.naive), ("difference", ours, budget.ours)):
            for samples in ladder if turn == 0 else ladder[-1:]:
                with cpu_seconds() as spent:
                    picture = strategy(part, plate[chosen], samples, NAIVE_DEPTH, 101 * turn)
                add(name, picture, spent.seconds * share, samples)
        for made in insitu(stage, plate, Render(), 101 * turn, every=turn == 0):
            add("insitu" if made.denoised else "region", made.picture[chosen], made.cpu_s, made.samples)
    curves: dict[str, list[Point]] = {}
    for (name, _), points in sorted(groups.items()):
        curves.setdefault(name, []).append(middle(points))
    peer = None
    if cycles.available():
        peer, apart = cycles_facts(stage, plate, gain, chosen, truths, budget, threads)
        say(f"{scene.name}: Cycles {apart}, {peer}")
        curves |= apart
    first: dict[str, Any] = {}
    if scene.name == "diffuse_glossy":
        first["preview"] = asdict(preview.warm(stage, plate, truths, chosen, budget.replicates))
        say(f"{scene.name}: first composite {first['preview']}")
    result: dict[str, Any] = {
        f"speedup_over_{other}{ending}": speedup(curves[own][-1], curves[other]) if other in curves else None
        for other in ("naive", "cycles")
        for own, ending in (("difference", "_estimator"), ("region", "_region"), ("insitu", ""))
    }
    return (
        result
        | first
        | {
            "curves": {name: [asdict(point) for point in points] for name, points in curves.items()},
            "cycles": peer,
            "map": facts(scene),
            "reference_noise": float(np.mean((truths[0] - truths[1]) ** 2) / 2),
        }
    )


def lattice(width: int, height: int) -> np.ndarray:
    """Flat indices of every third pixel in both directions: those whose error is taken."""
    return (np.arange(LATTICE // 2, height, LATTICE)[:, None] * width + np.arange(LATTICE // 2, width, LATTICE)).ravel()


def warm(part: Loaded, plate: np.ndarray, budget: Budget) -> None:
    """Compile the kernels on few pixels: compiling is not rendering."""
    few = part.at(np.arange(0, len(part.rays), 64))
    for samples in {*budget.naive, *budget.ours}:
        for strategy in (naive, ours):
            strategy(few, plate[::64], samples, NAIVE_DEPTH, 1)


def cycles_facts(
    stage: Loaded,
    plate: np.ndarray,
    gain: float,
    chosen: np.ndarray,
    truths: list[np.ndarray],
    budget: Budget,
    threads: int,
) -> tuple[dict[str, Any], dict[str, list[Point]]]:
    """What Cycles costs per frame and how far its mean is from the reference's; its curves by marginal cost.

    Its noise from the difference of replicates is told beside its error: equal where both agree in the mean.
    """
    noisy = [cycles.Wanted(budget.cycles, 11 + i) for i in range(budget.replicates)]
    wanted = [cycles.Wanted(1, 1), *noisy, cycles.Wanted(budget.cycles, 99, denoise=True)]
    with tempfile.TemporaryDirectory() as folder:
        renders, version = cycles.render(stage.scene, wanted, Path(folder), threads)
    single, *same, quiet = renders
    per_sample = (np.median([r.cpu_s for r in same]) - single.cpu_s) / (budget.cycles - 1)
    fixed = float(single.cpu_s - per_sample)
    shown = [display(r.composite(plate), gain)[chosen] for r in same]
    noise = [np.mean((a - b) ** 2) / 2 for i, a in enumerate(shown) for b in shown[:i]]
    errors = [squared_error(picture, *truths) for picture in shown]
    error = squared_error(display(quiet.composite(plate), gain)[chosen], *truths)
    columns = len(range(LATTICE // 2, stage.scene.camera.width, LATTICE))
    apart = (np.mean(shown, 0) - np.mean(truths, 0)).reshape(-1, columns, 3)
    rows = len(apart) // TILE * TILE
    tiles = apart[:rows, : columns // TILE * TILE].reshape(rows // TILE, TILE, -1, TILE, 3).mean((1, 3))
    return {
        "version": version,
        "fixed_cpu_s": fixed,
        "noise": float(np.median(noise)),
        "mean": [float(v) for v in np.mean(shown, (0, 1))],
        "reference_mean": [float(v) for v in np.mean(truths, (0, 1))],
        "tiles_median": float(np.median(np.abs(tiles))),
        "tiles_p99": float(np.quantile(np.abs(tiles), 0.99)),
    }, {
        "cycles": [Point(float(np.median(errors)), float(per_sample * budget.cycles), budget.cycles)],
        "cycles_oidn": [Point(error, quiet.cpu_s - fixed, budget.cycles)],
    }


def parts(width: int, height: int, budget: Budget, threads: int, say: Any) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to measure, by name; each gives its rows of render.json."""

    def scene(name: str) -> dict[str, Any]:
        found = measure(SCENES[name](width, height), budget, threads, say)
        first = found.pop("preview", None)
        rows = {} if first is None else {
            "preview_cpu_s": first["cpu_s"], "preview_rmse_255": max(first["error"], 0.0) ** 0.5
        }  # fmt: skip
        return {name: found} | rows

    def tiny() -> dict[str, Any]:
        ratio, costs = tiny_ratio(budget.replicates)
        say(f"24 over 1 Mpx: {ratio:.2f}")
        return {"tiny_24mpx_over_1mpx": ratio, "tiny": costs}

    def preview_cold() -> dict[str, Any]:
        return {"preview_cold_cpu_s": preview.cold(width, height)}

    scenes = {name: functools.partial(scene, name) for name in SCENES}
    return {**scenes, "tiny": tiny, "preview_cold": preview_cold}


def measured(name: str, part: Callable[[], dict[str, Any]], asked: dict[str, Any], resume: bool) -> dict[str, Any]:
    """The rows of a part, its seconds with them: those kept of a run that was broken off, or measured now."""
    file = KEPT / f"{name}.json"
    if resume and file.exists():
        kept: dict[str, Any] = json.loads(file.read_text())
        if kept["asked"] == asked:
            return kept
    with cpu_seconds() as timer:
        rows = part()
    kept = {"asked": asked, "rows": rows, "wall_s": timer.wall, "cpu_s": timer.seconds}
    KEPT.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(kept, indent=1) + "\n")
    return kept


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--full", action="store_true", help="more samples and replicates (an hour)")
    parser.add_argument("--size", default="1280x720", help="of the pictures [px]")
    parser.add_argument(
        "--parts", help="which, with commas: scenes, tiny, preview_cold; the others are kept as they were"
    )
    parser.add_argument("--resume", action="store_true", help="keep the parts that a run of the same settings measured")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder")
    given = parser.parse_args()
    width, height = (int(v) for v in given.size.split("x"))
    budget = FULL if given.full else Budget()
    threads = len(os.sched_getaffinity(0))
    started = time.time()

    def say(text: str) -> None:
        print(f"{time.time() - started:5.0f} s  {text}", file=sys.stderr, flush=True)  # noqa: T201  a command's progress

    if not cycles.available():
        say("Cycles is left out: no .blender environment; `make bench-cycles-env` makes it")
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / "render.json"
    old: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    every = parts(width, height, budget, threads, say)
    wanted = given.parts.split(",") if given.parts else list(every)
    kept_rows = ("zscore_max", "zscore") if set(wanted) == set(every) else tuple(old)
    record: dict[str, Any] = {"zscore_max": None} | {name: old[name] for name in kept_rows if name in old}
    asked = {"size": [width, height], "budget": asdict(budget) | {"full": given.full}, "threads": threads}
    seconds = dict(record.get("seconds", {}))
    for name in wanted:
        found = measured(name, every[name], json.loads(json.dumps(asked)), given.resume)
        record |= found["rows"]
        seconds[name] = {"wall_s": found["wall_s"], "cpu_s": found["cpu_s"]}
        say(f"{name}: {found['wall_s']:.0f} s, {found['cpu_s']:.0f} CPU s")
    wall = sum(part["wall_s"] for part in seconds.values())
    record |= {"size": [width, height], "threads": threads, "seconds": seconds, "wall_s": wall}
    file.write_text(json.dumps(record, indent=1) + "\n")
    write_page(record, given.out)
    say(f"wrote {given.out / 'render.md'}")


if __name__ == "__main__":
    main()
