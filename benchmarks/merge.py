"""How good and how fast the merge is: ``make bench-merge`` writes docs/benchmarks/merge.json, merge.md and merge.svg.

    python -m benchmarks.merge [--parts accuracy,texture,ratios,speed,memory,real] [--out docs/benchmarks]

Simulated brackets of known radiance against the Cramer-Rao bound, peers on the same frames, CPU time against the time
to move the data, peak memory of 5 x 100 megapixels, and a real bracket.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import merge_data as data
from benchmarks import merge_peers as peers
from benchmarks.measures import cpu_seconds
from benchmarks.merge_page import write_page
from pipeline.image import exposure, frames, radiometry

THREADS = len(os.sched_getaffinity(0))
BLOCK = 1000  # side of a block of simulated pixels
DATA = Path(os.environ.get("INSITU_DATA", "../shared/data"))
HEIGHT, WIDTH = 3000, 3996  # of the timed frames; a multiple of three, for OpenCV
REPEATS = 7


def say(text: str) -> None:
    """Progress, on the terminal."""
    print(text, file=sys.stderr, flush=True)  # noqa: T201  a command's progress


def bin_errors(radiance: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors, and squared errors over the bound."""
    error = found.astype(np.float64) - radiance
    return error / radiance, error**2 * data.information(radiance)


def accuracy(folder: Path, shuffled: bool = False) -> list[dict[str, Any]]:
    """Bias and RMSE over the bound of both estimators in bins of a third of a decade, on smooth ramps.

    ``shuffled``: every pixel has a radiance of its own from its bin, so that neighbours tell little.
    """
    rows = []
    for number, (low, high) in enumerate(itertools.pairwise(data.bins())):
        blocks = 2 if shuffled else {0: 8, 1: 5, 2: 3}.get(number, 2)
        sums: dict[str, list[np.ndarray]] = {"optimal": [], "poisson": []}
        for block in range(blocks):
            radiance = np.tile(np.geomspace(low, high, BLOCK, endpoint=False), (BLOCK, 1))
            if shuffled:
                radiance = np.random.default_rng(block).permuted(radiance, axis=1)
            mosaics = data.exposed(data.bracket(radiance, 100 * number + block))
            for name, parts in sums.items():
                merged = radiometry.merge(mosaics, name, THREADS)  # type: ignore[arg-type]
                relative, squared = bin_errors(radiance, merged.radiance)
                parts.append(np.array([relative.sum(), (relative**2).sum(), squared.sum(), (squared**2).sum()]))
        count = blocks * BLOCK**2
        row: dict[str, Any] = {"electrons": [low * data.ELECTRONS, high * data.ELECTRONS], "pixels": count}
        for name, parts in sums.items():
            bias, spread, ratio, fourth = np.sum(parts, 0) / count
            row[name] = {
                "bias": bias, "bias_se": float(np.sqrt((spread - bias**2) / count)),
                "rmse_over_crb": float(np.sqrt(ratio)),
                "rmse_over_crb_se": float(np.sqrt((fourth - ratio**2) / count) / (2 * np.sqrt(ratio))),
            }  # fmt: skip
        rows.append(row)
        best = row["optimal"]
        say(
            f"   {row['electrons'][0]:10.0f} electrons, {count / 1e6:.0f} Mpx: bias {100 * best['bias']:+.3f} "
            f"+- {100 * best['bias_se']:.3f} %, "
            f"RMSE {best['rmse_over_crb']:.4f} x bound +- {best['rmse_over_crb_se']:.4f}"
        )
    return rows


def ratios(folder: Path) -> dict[str, Any]:
    """Exposures that are up to 7 % off their labels, estimated from textured frames; the worst relative error."""
    random, errors, pulls = np.random.default_rng(7), [], []
    for trial in range(6):
        radiance = np.exp(random.normal(-2, 1.8, (700, 700)))
        true = [g * float(np.exp(random.uniform(-0.07, 0.07))) for g in data.EXPOSURES]
        signals = [one.signal().ravel() for one in data.exposed(data.bracket(radiance, 50 + trial, true))]
        log, variance = 0.0, 0.0
        for i in range(1, len(true)):
            label = data.EXPOSURES[i - 1] / data.EXPOSURES[i]
            found = exposure.measure_ratio(
                signals[i], signals[i - 1], label, float(data.LIMIT[0, 0]), (data.MODEL, data.MODEL)
            )
            if found is None:
                raise RuntimeError("no ratio could be measured")
            log, variance = log - found[0], variance + found[1] ** 2
            error = log - float(np.log(true[i] / true[0]))
            errors.append(abs(float(np.expm1(error))))
            pulls.append(error / np.sqrt(variance))
    return {"exposure_ratio_err_max": max(errors), "measured": len(errors), "pull_rms": float(np.std(pulls))}


def floor_kernel() -> Callable[..., None]:
    """Reads five uint16 planes, writes two of float32 and one of uint8; compiled as the merge is."""
    from pipeline.image.machine_code import compiled

    return compiled(_move)


def _move(planes: np.ndarray, one: np.ndarray, two: np.ndarray, three: np.ndarray) -> None:
    for y in range(one.shape[0]):
        a, b, c, d, e = planes[0, y], planes[1, y], planes[2, y], planes[3, y], planes[4, y]
        p, q, r = one[y], two[y], three[y]
        for x in range(one.shape[1]):
            value = np.float32(np.int32(a[x]) + np.int32(b[x]) + np.int32(c[x]) + np.int32(d[x]) + np.int32(e[x]))
            p[x], q[x], r[x] = value, value, 0


def move(planes: np.ndarray, kernel: Callable[..., None]) -> None:
    """The floor, in as many threads as the merge."""
    from concurrent.futures import ThreadPoolExecutor

    height, width = planes.shape[1:]
    out = [np.empty((height, width), dtype) for dtype in (np.float32, np.float32, np.uint8)]
    parts = [slice(height * k // THREADS, height * (k + 1) // THREADS) for k in range(THREADS)]
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(lambda part: kernel(planes[:, part], *(one[part] for one in out)), parts))


def timed(planes: np.ndarray, exposures: list[float], folder: Path) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """CPU ms per megapixel and results of everything on five (H, W) frames, by turns; the least of some."""
    import cv2

    cv2.setNumThreads(THREADS)
    kernel = floor_kernel()
    eight = [peers.eight_bit(plane, data.BLACK, data.WHITE) for plane in planes]
    ready = data.exposed(list(planes), exposures)
    runs: dict[str, Callable[[], Any]] = {
        "floor": lambda: move(planes, kernel),
        "optimal": lambda: radiometry.merge(ready, "optimal", THREADS).radiance,
        "poisson": lambda: radiometry.merge(ready, "poisson", THREADS).radiance,
        "numpy": lambda: peers.plain(planes, exposures, data.BLACK, data.WHITE),
        "debevec": lambda: peers.opencv("debevec", eight, exposures),
        "robertson": lambda: peers.opencv("robertson", eight, exposures),
    }
    for name in ("floor", "optimal", "poisson"):
        runs[name]()  # compiles
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    found: dict[str, np.ndarray] = {}
    for repeat in range(REPEATS):
        for name, run in runs.items():
            if repeat < 2 or name in ("floor", "optimal", "poisson"):
                with cpu_seconds() as timer:
                    found[name] = run()
                seconds[name].append(timer.seconds)
    megapixels = planes[0].size / 1e6
    cost = {name: 1e3 * min(values) / megapixels for name, values in seconds.items()}
    np.save(folder / "frames.npy", planes)
    (folder / "meta.json").write_text(json.dumps({"exposures": exposures, "black": data.BLACK, "white": data.WHITE}))
    for library in peers.LIBRARIES:
        outcome = peers.external(folder, library, 2)
        if outcome is not None:
            found[library], cost[library] = outcome[0], 1e3 * outcome[1] / megapixels
    return cost, found


def speed(folder: Path) -> dict[str, Any]:
    """Cost on a ramp over the whole range, and what peers make of the same frames, by thirds of a decade."""
    radiance = data.ramp(HEIGHT, WIDTH)
    planes = np.stack(data.bracket(radiance, 3))
    cost, found = timed(planes, data.EXPOSURES, folder)
    which = np.digitize(radiance[:, 0], data.bins()) - 1
    rows: dict[str, Any] = {}
    for name, picture in found.items():
        if name == "floor":
            continue
        picture = np.nan_to_num(picture.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        middle = (which >= 6) & (which < 12)  # a global scale is not the peers' to know
        picture *= 1 if name in ("optimal", "poisson") else np.mean(radiance[middle]) / np.mean(picture[middle])
        errors = [bin_errors(radiance[which == b], picture[which == b]) for b in range(which.max() + 1)]
        rows[name] = {
            "ms_per_mpx": cost[name],
            "bias": [float(relative.mean()) for relative, _ in errors],
            "rmse_over_crb": [float(np.sqrt(squared.mean())) for _, squared in errors],
        }
    return {"floor_ms_per_mpx": cost["floor"], "methods": rows, "megapixels": planes[0].size / 1e6}


def memory(folder: Path) -> dict[str, float]:
    """Peak of a process that holds five frames of 100 megapixels, merges them and replaces defects."""
    command = [sys.executable, "-m", "benchmarks.merge", "--peak"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def peak() -> None:
    """The process of `memory`."""
    strip = data.bracket(data.ramp(200, 10000), 9)
    mosaics = [np.tile(mosaic, (50, 1)) for mosaic in strip]
    del strip
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    radiometry.replace_defects(radiometry.merge(data.exposed(mosaics), "optimal", THREADS))
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = {"peak_gib": after / 2**20, "frames_gib": before / 2**20, "wall_s": time.perf_counter() - start}
    print(json.dumps(found))  # noqa: T201  its result


def real(folder: Path) -> dict[str, Any] | None:
    """Five frames of a real or path-traced bracket, tiled to the size of the others; decode and EXR writing apart."""
    from pipeline.run.formats import write_exr
    from pipeline.types import Raster

    source = DATA / "captures/kitchen_table/probe_a"
    if not source.is_dir():
        return None
    files = sorted(source.glob("*.dng"))[2:]
    facts = [frames.read_frame(file, file.name) for file in files]
    with cpu_seconds() as decode:
        mosaics = [frames.read_samples(file, one) for file, one in zip(files, facts, strict=True)]
    times = (-(-HEIGHT // mosaics[0].shape[0]), -(-WIDTH // mosaics[0].shape[1]))
    planes = np.stack([np.tile(mosaic, times)[:HEIGHT, :WIDTH] for mosaic in mosaics])
    exposures = [exposure.exposure_of(one) for one in facts]
    order = np.argsort(exposures)
    cost, _ = timed(np.ascontiguousarray(planes[order]), [exposures[i] for i in order], folder)
    merged = radiometry.merge(data.exposed([mosaics[i] for i in order], [exposures[i] for i in order]))
    mask = merged.mask.astype(np.uint32)
    raster = Raster({"Y": merged.radiance, "variance": merged.variance, "mask": mask}, "camera_rgb")
    with cpu_seconds() as write:
        write_exr(folder / "merged.exr", raster)
    megapixels = mosaics[0].size / 1e6
    return {
        "frames": [file.name for file in files],
        "ms_per_mpx": cost,
        "decode_ms_per_mpx": 1e3 * decode.seconds / megapixels,
        "write_ms_per_mpx": 1e3 * write.seconds / megapixels,
    }


PARTS: dict[str, Callable[[Path], Any]] = {
    "accuracy": accuracy,
    "texture": lambda folder: accuracy(folder, shuffled=True),
    "ratios": ratios,
    "speed": speed,
    "memory": memory,
    "real": real,
}


def figures(record: dict[str, Any]) -> dict[str, Any]:
    """The figures that are promised, and one object per peer."""
    best, methods = [row["optimal"] for row in record["accuracy"]], record["speed"]["methods"]
    objects = {
        name: {
            "ms_per_mpx": row["ms_per_mpx"],
            "bias_max": max(abs(value) for value in row["bias"]),
            "rmse_over_crb_max": max(row["rmse_over_crb"]),
        }
        for name, row in methods.items()
        if name != "optimal"
    }
    return {
        "bias_max": max(abs(row["bias"]) for row in best),
        "rmse_over_crb_max": max(row["rmse_over_crb"] for row in best),
        "exposure_ratio_err_max": record["ratios"]["exposure_ratio_err_max"],
        "ms_per_mpx": methods["optimal"]["ms_per_mpx"],
        "floor_ms_per_mpx": record["speed"]["floor_ms_per_mpx"],
        "opencv_ms_per_mpx": min(methods[name]["ms_per_mpx"] for name in ("debevec", "robertson")),
        "peak_gib_5x100mpx": record["memory"]["peak_gib"],
        **objects,
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--parts", default=",".join(PARTS), help="which, with commas; the others are kept as they were")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder")
    parser.add_argument("--peak", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.peak:
        return peak()
    file, wanted = given.out / "merge.json", given.parts.split(",")
    old = {} if set(wanted) == set(PARTS) else json.loads(file.read_text())
    record, seconds = {name: old[name] for name in PARTS if name in old}, dict(old.get("seconds", {}))
    for name in wanted:
        say(f"{name} ...")
        started = time.time()
        with tempfile.TemporaryDirectory() as folder:
            record[name] = PARTS[name](Path(folder))
        seconds[name] = time.time() - started
        say(f"{seconds[name]:5.0f} s  {name}")
    whole = {**figures(record), "threads": THREADS, "seconds": seconds, **record}
    given.out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(whole, indent=1) + "\n")
    write_page(whole, given.out)
    return None


if __name__ == "__main__":
    main()
