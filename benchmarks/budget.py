"""Do the stated uncertainties hold? Places photographed and built again and again; errors over sigma, pooled.

    .venv/bin/python -m benchmarks.budget [COUNT] [--kind desk courtyard corner rooms small_balls] [--jobs 2]
                                          [--folder FOLDER] [--judge] [--keep]

Every capture (`benchmarks.resimulate`: own noise, shutter errors, corners, lens and pose) is built to the stage
``uncertainty`` and compared with the truth, scaled by the one factor s = median(LS_b / P) of the capture, as `evaluate`
does: an error of the plate's own scale is none of the composite. Compared are pixels `APART` px apart and means over
regions (each object, shadows in tiles). A z is an error over its sigma, one per colour channel. Two questions:

    scatter   error less its mean over the captures: do the variances describe what noise does?
    truth     the whole error: what no variance holds (near field, blur of the map, truth's own noise) is in it

What is asked is that all pixels together, and all region means together, are held (`CLASSES`); objects and shadows
apart say where the sigma is too wide or too narrow.

A kind is one place, or several that are photographed in turn (`PLACES`); places have their own pixels and regions, and
scatter is about a place's own mean. A capture leaves one small file in FOLDER/KIND (of several places, in a folder
each) and its build is deleted, so COUNT may grow and a broken run goes on. The file names the code that made it: what
other code made is built again, and never pooled.
"""

from __future__ import annotations

import argparse
import collections
import functools
import hashlib
import json
import multiprocessing
import shutil
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import resimulate, rooms
from benchmarks.resimulate import photograph, place_of
from pipeline.budget.pixels import SHADOW
from pipeline.image.truth import load_truth
from pipeline.run.cli import main as insitu
from pipeline.run.cli import say
from pipeline.run.closure import digest
from pipeline.run.formats import read_exr
from stages.order import NAMES

APART = 32  # px
TILE = 48  # px, of the regions into which shadows are cut
EDGE = 5  # px, of the square about a pixel that must be all object, or none: cameras turn by a pixel, its own aside
FEWEST = 200  # shadow pixels of a tile that is a region
SETTINGS = ("render.samples=16", "render.depth=8")
KINDS = {
    "desk": "indoors: a window and three lamps, 4 and 7 degrees wide; a ball of 43 px",
    "courtyard": "one hard sun, clipped in every frame of the ball, under a clear sky",
    "corner": "two bright walls close by that light the table and each other, no [room] stated: what the near field "
    "does to the light on the objects no sigma covers; `not_covered` bounds it, by 4 to 13 %",
    "rooms": "five desks under one to three lamps of 3 to 8 degrees; lamps, window, walls, table, ball and objects are "
    "drawn anew for each (`benchmarks.rooms`): five draws of what a place's captures share; balls of 80 to 95 px, as "
    "the guide to shooting asks",
    "small_balls": "the same five rooms with balls of 36 to 50 px, half of what the guide to shooting asks for",
}
PLACES = dict.fromkeys(rooms.BALL_M, 5)  # of a kind; 1 where nothing is said
# Kinds pooled with no other: light that no sigma holds, bounded and named; balls that the build itself calls too small.
NOT_COVERED = ("corner", "small_balls")
CLASSES = {"pixels": ("object pixels", "shadow pixels"), "region means": ("object means", "shadow means")}
EXPECTED = {"50": (0.45, 0.55), "68": (0.62, 0.74), "95": (0.90, 0.98)}
QUANTILES = {"50": 0.67449, "68": 1.0, "95": 1.95996}  # of |z|, normal
BINS = np.array([-np.inf, -3, -2.5, -2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2, 2.5, 3, np.inf])
DOCS = Path("docs/benchmarks")
SAMPLES = Path("sample_captures")
Records = list[dict[str, Any]]  # of one place


def code(kind: str) -> str:
    """Digest of all that a record depends on: stages up to the last that is run, the simulator, and what is asked."""
    total = hashlib.sha256(repr((SETTINGS, APART, TILE, FEWEST)).encode())
    total.update(Path(resimulate.__file__).read_bytes())
    if kind in rooms.BALL_M:
        total.update(Path(rooms.__file__).read_bytes())
    for name in (*NAMES[: NAMES.index("uncertainty") + 1], "simulate"):
        total.update(digest(f"stages.{name}").encode())
    return total.hexdigest()[:12]


def places(truth_file: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Masks (H, W) of single pixels by kind, and of regions by name: objects, shadows in tiles.

    From the truth of the camera that is not turned, inside edges by as far as cameras turn, so that all share them.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    truth = load_truth(truth_file)
    inside = {name: minimum_filter(cover, EDGE) > 0.999 for name, cover in truth.coverage.items()}
    free = maximum_filter(np.sum(list(truth.coverage.values()), axis=0), EDGE) == 0
    level = np.linalg.norm(truth.plate, axis=-1)
    shadow = free & (np.linalg.norm(truth.with_objects - truth.plate, axis=-1) > SHADOW * level)
    lattice = np.zeros(free.shape, bool)
    lattice[APART // 2 :: APART, APART // 2 :: APART] = True
    pixels = {"object": np.any(list(inside.values()), axis=0) & lattice, "shadow": shadow & lattice}
    means = {name: mask for name, mask in inside.items() if mask.sum() >= FEWEST}
    for top in range(0, shadow.shape[0], TILE):
        for left in range(0, shadow.shape[1], TILE):
            mask = np.zeros_like(shadow)
            part = np.s_[top : top + TILE, left : left + TILE]
            mask[part] = shadow[part]
            if mask.sum() >= FEWEST:
                means[f"shadow_{top}_{left}"] = mask
    return pixels, means


def measured(build: Path, truth_file: Path, shared_truth: Path) -> dict[str, Any]:
    """Errors and sigmas of pixels and of regions of one build, and the budget by source."""
    truth = load_truth(truth_file)
    composite, plate = read_exr(build / "composite/composite.exr"), read_exr(build / "develop/photographs/plate.exr")
    unsure = read_exr(build / "uncertainty/uncertainty.exr")
    scale = float(np.median(np.linalg.norm(plate.rgb(), axis=-1) / np.linalg.norm(truth.plate, axis=-1)))
    error, sigma = composite.rgb() - scale * truth.with_objects, unsure.rgb("sigma").astype(float)
    own = unsure.rgb("of_means").astype(float) ** 2
    modes = [unsure.rgb(f"mode_{name}").astype(float) for name in unsure.attributes["insitu:modes"].split(",")]
    pixels, regions = places(shared_truth)
    single = {
        kind: {"error": error[mask].tolist(), "sigma": sigma[mask].tolist(), "level": composite.rgb()[mask].tolist()}
        for kind, mask in pixels.items()
    }
    means: dict[str, Any] = {}
    for name, mask in regions.items():
        variance = own[mask].mean(0) / mask.sum()
        shared = sum(mode[mask].mean(0) ** 2 for mode in modes)
        means[name] = {
            "error": error[mask].mean(0).tolist(), "sigma": np.sqrt(variance + shared).tolist(),
            "level": composite.rgb()[mask].mean(0).tolist(), "own": np.sqrt(variance).tolist(),
        }  # fmt: skip
    budget = json.loads((build / "uncertainty/budget.json").read_text())
    spent = {path.parent.name: json.loads(path.read_text())["cpu_seconds"] for path in build.glob("*/record.json")}
    seconds = {"all": sum(spent.values()), **{stage: spent[stage] for stage in ("render", "uncertainty")}}
    return {
        "scale": scale, "pixels": single, "means": means, "budget": budget["regions"], "cpu_seconds": seconds,
        "near_field": near_field_bound(build),
    }  # fmt: skip


def near_field_bound(build: Path) -> float:
    """What a build says, of irradiance, that light from near walls may differ by at the objects; 0 where modelled."""
    rows = json.loads((build / "probe/record.json").read_text())["evidence"]
    told = [row for row in rows if row["term"].startswith("near field") and row["modelled"] is False]
    return max((float(row.get("bound_rel", 0.0)) for row in told), default=0.0)


def build_one(scene: Any, pictures: Any, number: int, folder: Path, made_by: str, keep: bool = False) -> None:
    """Photograph and build capture ``number``, keep its record, delete the rest unless it is to be kept."""
    work = folder / f"work_{number:03d}"
    shutil.rmtree(work, ignore_errors=True)
    photograph(scene, pictures, number, folder / "radiance", work / "capture")
    asked = [word for setting in (*SETTINGS, f"render.seed={number}") for word in ("--set", setting)]
    out = work / "build"
    code = insitu(
        ["run", str(work / "capture"), "--out", str(out), "--quality", "draft", "--upto", "uncertainty", *asked]
    )
    if code == 0:
        found = measured(out, work / "capture/truth/truth.json", folder / "radiance/truth/truth.json")
        part = folder / f"capture_{number:03d}.part"
        part.write_text(json.dumps({"code": made_by, **found}))
        part.rename(part.with_suffix(".json"))
    else:
        say(f"capture {number}: insitu ended with {code}")
    if not keep:
        shutil.rmtree(work)


def bounded(groups: list[Records]) -> dict[str, float]:
    """Share of the errors of each kind of place within 1.96 sigma and what the build names as not covered, together."""
    found: dict[str, list[np.ndarray]] = {}
    for records in groups:
        reach = np.array([record["near_field"] for record in records])[:, None, None]
        levels = stacked(records, "level")
        errors, sigmas = stacked(records, "error"), stacked(records, "sigma")
        for kind, error in errors.items():
            allowed = QUANTILES["95"] * sigmas[kind] + reach * np.abs(levels[kind])
            found.setdefault(kind, []).append((np.abs(error) <= allowed)[np.isfinite(sigmas[kind])])
    return {kind: float(np.concatenate(inside).mean()) for kind, inside in found.items()}


def stacked(records: Records, key: str) -> dict[str, np.ndarray]:
    """Error, sigma or level (captures, places, 3) of each kind of place that there is."""
    found = {f"{kind} pixels": np.array([r["pixels"][kind][key] for r in records]) for kind in ("object", "shadow")}
    for kind, chosen in (("object means", False), ("shadow means", True)):
        names = [name for name in records[0]["means"] if name.startswith("shadow_") == chosen]
        found[kind] = np.array([[r["means"][name][key] for name in names] for r in records])
    return {kind: values for kind, values in found.items() if values.size}


def coverage(z: np.ndarray) -> dict[str, Any]:
    """Shares inside the central intervals, mean, standard deviation and histogram of finite z."""
    z = z[np.isfinite(z)]
    inside = {name: float((np.abs(z) < limit).mean()) for name, limit in QUANTILES.items()}
    good = {name: bool(low <= inside[name] <= high) for name, (low, high) in EXPECTED.items()}
    return {
        "n": int(z.size), "inside": inside, "holds": good, "mean": float(z.mean()), "std": float(z.std()),
        "histogram": np.histogram(z, BINS)[0].tolist(),
    }  # fmt: skip


def grouped(groups: list[Records]) -> dict[str, Any]:
    """Coverage of the `CLASSES` and of each kind of place, over some places' records, against scatter and truth.

    Of every place two captures at least, as `records_of` gives them.
    """
    found: dict[str, dict[str, list[np.ndarray]]] = {name: {"scatter": [], "truth": []} for name in CLASSES}
    for records in groups:
        spread = np.sqrt(len(records) / (len(records) - 1))  # the mean took its share of the scatter
        errors, sigmas = stacked(records, "error"), stacked(records, "sigma")
        for kind, error in errors.items():
            z = {"scatter": (error - error.mean(0)) / sigmas[kind] * spread, "truth": error / sigmas[kind]}
            for name in (kind, *(name for name, kinds in CLASSES.items() if kind in kinds)):
                parts = found.setdefault(name, {"scatter": [], "truth": []})
                for against, values in z.items():
                    parts[against].append(values.ravel())
    return {
        n: {a: coverage(np.concatenate(z)) for a, z in parts.items()} for n, parts in found.items() if parts["truth"]
    }


def by_region(records: Records) -> dict[str, dict[str, float]]:
    """Of every region, relative to its level, RMS over the channels: bias and scatter over captures, stated sigma."""
    found = {}
    for name in records[0]["means"]:
        error, sigma, own = (
            np.array([np.divide(r["means"][name][key], r["means"][name]["level"]) for r in records])
            for key in ("error", "sigma", "own")
        )
        parts = {
            "bias": error.mean(0), "scatter": error.std(0, ddof=1), "sigma": np.sqrt((sigma**2).mean(0)),
            "own": np.sqrt((own**2).mean(0)),
        }  # fmt: skip
        found[name] = {key: float(np.sqrt(np.mean(value**2))) for key, value in parts.items()}
    return found


def folders(kind: str, folder: Path) -> list[Path]:
    """Where the records of each place of a kind are."""
    count = PLACES.get(kind, 1)
    return [folder / kind] if count == 1 else [folder / kind / f"place_{number:02d}" for number in range(count)]


def records_of(kind: str, folder: Path) -> tuple[str, list[Records], int]:
    """The records of each place that one code made, that of most of them; its digest, and how many are left out."""
    found = [
        [json.loads(file.read_text()) for file in sorted(at.glob("capture_???.json"))] for at in folders(kind, folder)
    ]
    codes = collections.Counter(record["code"] for records in found for record in records).most_common(1)
    made_by = codes[0][0] if codes else ""
    kept = [[record for record in records if record["code"] == made_by] for records in found]
    groups = [records for records in kept if len(records) > 1]
    return made_by, groups, sum(map(len, found)) - sum(map(len, groups))


def judged(groups: list[Records]) -> dict[str, Any]:
    """What the records of one kind, those of each place, say."""
    records = [record for group in groups for record in group]
    seconds = {name: float(np.median([r["cpu_seconds"][name] for r in records])) for name in records[0]["cpu_seconds"]}
    regions: dict[str, dict[str, float]] = {}
    for number, group in enumerate(groups):
        before = f"{number}: " if len(groups) > 1 else ""
        regions |= {before + name: row for name, row in by_region(group).items()}
    return {
        "captures": len(records), "places": len(groups), "coverage": grouped(groups), "regions": regions,
        "near_field": [float(v) for v in np.quantile([r["near_field"] for r in records], [0, 0.5, 1])],
        "bounded": bounded(groups), "cpu_seconds": seconds,
    }  # fmt: skip


def table(found: dict[str, Any]) -> list[str]:
    """Rows of coverage, places by question."""
    lines = ["| places | against | z | 50 % | 68 % | 95 % | mean z | std z |", "|---|---|---|---|---|---|---|---|"]
    for kind, part in found.items():
        for against in ("scatter", "truth"):
            row = part[against]
            shares = " | ".join(
                f"{100 * row['inside'][name]:.1f}{'' if row['holds'][name] else ' (out)'}" for name in EXPECTED
            )
            lines.append(f"| {kind} | {against} | {row['n']} | {shares} | {row['mean']:+.2f} | {row['std']:.2f} |")
    return lines


def histograms(found: dict[str, Any]) -> list[str]:
    """How z is distributed, of every kind of place, scatter beside truth."""
    lines = []
    for kind, part in found.items():
        lines += [f"{kind}, scatter and truth, per cent:", "", "```"]
        both = [np.array(part[a]["histogram"]) / max(part[a]["n"], 1) for a in ("scatter", "truth")]
        for low, high, first, second in zip(BINS[:-1], BINS[1:], *both, strict=True):
            bars = [f"{100 * v:5.1f} {'#' * round(100 * v):<26.26}" for v in (first, second)]
            lines.append(f"{low:+5.1f} to {high:+5.1f}  {bars[0]}  {bars[1]}".rstrip())
        lines += ["```", ""]
    return lines


def page(found: dict[str, Any], command: str) -> str:
    """The figures as a page of docs."""
    counts = ", ".join(f"{part['captures']} of {kind}" for kind, part in found["kinds"].items())
    lines = [
        "# Do the stated uncertainties hold?",
        "",
        f"Made by `{command}`: captures of 512 px ({counts}),",
        "each with its own noise, shutter errors, corners, lens and pose, cameras turned by up to a pixel either way,",
        "the mosaic's period, ball views as soft as 0.6 to 0.85 px; draft with 16 samples and depth 8. The target is",
        "100 captures and more per scene kind; the command goes on where it stopped.",
        "",
        "`scatter`: errors about their mean over the captures, which is what variances describe. `truth`: the whole",
        "error; what no variance holds is in it. Intervals should hold 45 to 55, 62 to 74 and 90 to 98 % of all pixels",
        "and of all region means; objects and shadows apart, below them, say where a sigma is too wide and where too",
        "narrow. All channels are pooled; channels and places of one capture share modes, so they count for less than",
        "their number. What is the same in every capture of a place (how its ball's reflectance, its sun's flux and",
        "the turn of its map are estimated) is one draw, however many captures there are.",
        "",
        f"## Together: {', '.join(kind for kind in found['kinds'] if kind not in NOT_COVERED)}",
        "",
        *table(found["pooled"]),
        "",
        *histograms(found["pooled"]),
    ]
    for kind, part in found["kinds"].items():
        seconds = ", ".join(f"{stage} {value:.1f}" for stage, value in part["cpu_seconds"].items())
        lines += [
            f"## {kind}", "", f"{KINDS[kind][0].upper()}{KINDS[kind][1:]}. {part['captures']} captures by code",
            f"`{part['code']}`" + (f", {part['left_out']} of other code left out" if part["left_out"] else "")
            + f". CPU seconds, median, on a loaded machine: {seconds}.", "",
            *table(part["coverage"]), "",
            "Near field, which no sigma holds, as `not_covered` bounds it: "
            + "{0:.1%} to {2:.1%} of irradiance, {1:.1%} in the".format(*part["near_field"]),
            "middle. Errors within 1.96 sigma and that bound together: "
            + ", ".join(f"{place} {share:.1%}" for place, share in part["bounded"].items()) + ".", "",
            *histograms(part["coverage"]),
            "Per cent of the region's level, RMS over the channels. Bias and scatter are over the captures; *own* is",
            "the part of the stated sigma that is no mode.", "",
            "| region | bias | scatter | stated sigma | own |", "|---|---|---|---|---|",
        ]  # fmt: skip
        for name, row in part["regions"].items():
            lines.append(f"| {name} | " + " | ".join(f"{100 * row[key]:.2f}" for key in row) + " |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


@functools.lru_cache(maxsize=1)
def photographed(kind: str, folder: Path, number: int) -> tuple[Any, Any]:
    """Scene and radiance of place ``number`` of a kind, kept while captures of the same place follow each other."""
    at = folders(kind, folder)[number] / "radiance"
    if kind in rooms.BALL_M:
        drawn_by, now = at / "drawn_by", hashlib.sha256(Path(rooms.__file__).read_bytes()).hexdigest()
        if not drawn_by.exists() or drawn_by.read_text() != now:
            shutil.rmtree(at, ignore_errors=True)  # pictures of a room that is not drawn any more
        found = rooms.room_of(number, kind, at, photographed("desk", folder, 0)[1].boards)
        drawn_by.write_text(now)
        return found
    return place_of(SAMPLES / "scenes" / f"{kind}.toml", SAMPLES / kind, at)


def build_missing(kind: str, number: int, folder: Path, made_by: str, keep: bool) -> None:
    """One capture of a kind, if it is not there or other code made it; its places take turns."""
    which = number % PLACES.get(kind, 1)
    at = folders(kind, folder)[which]
    path = at / f"capture_{number:03d}.json"
    if not path.exists() or json.loads(path.read_text())["code"] != made_by:
        scene, pictures = photographed(kind, folder, which)
        began = time.process_time()
        build_one(scene, pictures, number, at, made_by, keep)
        say(f"{kind}, capture {number}: {time.process_time() - began:.0f} CPU s")


def build_all(kinds: list[str], count: int, folder: Path, jobs: int, keep: bool) -> None:
    """Captures of all kinds that are missing, ``jobs`` at a time; radiance is rendered before them."""
    for kind in kinds:
        for number in range(PLACES.get(kind, 1)):
            photographed(kind, folder, number)
    context = multiprocessing.get_context("spawn")  # a renderer does not outlive a fork
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        waiting = []
        for kind in kinds:
            made_by = code(kind)
            waiting += [pool.submit(build_missing, kind, number, folder, made_by, keep) for number in range(count)]
        for built in as_completed(waiting):
            built.result()


def main() -> None:
    """Build what is missing, then judge all there is."""
    parser = argparse.ArgumentParser(prog="benchmarks.budget")
    parser.add_argument("count", type=int, nargs="?", default=100)
    parser.add_argument("--kind", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--jobs", type=int, default=1, help="captures built at a time; each takes about 2 GB")
    parser.add_argument("--folder", type=Path, default=Path("build/budget"))
    parser.add_argument("--keep", action="store_true", help="keep builds too, for benchmarks.budget_sources")
    parser.add_argument("--judge", action="store_true", help="build nothing, judge what there is")
    asked = parser.parse_args()
    if not asked.judge:
        build_all(asked.kind, asked.count, asked.folder, asked.jobs, asked.keep)
    kept, kinds = {}, {}
    for kind in KINDS:
        made_by, groups, left_out = records_of(kind, asked.folder)
        if groups:
            kept[kind] = groups
            kinds[kind] = {"code": made_by, "left_out": left_out, **judged(groups)}
    if not kept:
        raise SystemExit(f"{asked.folder}: two captures of one place are needed; run without --judge")
    far = [records for kind, groups in kept.items() if kind not in NOT_COVERED for records in groups]
    found = {"pooled": grouped(far), "kinds": kinds}
    (DOCS / "budget.json").write_text(json.dumps(found, indent=1) + "\n")
    (DOCS / "budget.md").write_text(page(found, "make bench-budget"))
    say(page(found, "make bench-budget"))


if __name__ == "__main__":
    main()
