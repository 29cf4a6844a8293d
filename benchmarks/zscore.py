"""Is the fast strategy unbiased? Fast minus reference on random scenes, over the standard error of the difference.

    .venv/bin/python -m benchmarks.zscore [--scenes 20] [--cpu-s 500] [--out docs/benchmarks]

Both strategies estimate the change of the local scene and the object layer on tiles of 8 x 8 pixels. A *replicate* is
the mean of a tile over ``spp`` samples per pixel with a seed of its own; means and standard errors come from the
scatter of independent replicates and from nothing that a strategy says of itself. Clamp, region and denoiser are off.
Student's t of the difference (degrees of freedom after Welch and Satterthwaite) is turned into the z of equal
probability, so that few replicates are no excuse; a z beyond 5 happens by chance once in 1.7 million.

A tile counts as *changed*, channel by channel, where the change is more than 1 % of LS_noobj. The effort goes where it
is needed: a pilot, thrown away, tells how many replicates bring the reference's standard error to 1 % of the change
there, rounds after it add what is still missing, until it is there or the scene's budget ends; then the share that got
there is said. Stopping by the scatter moves a mean of hundreds of skewed replicates by less than a tenth of its error;
the mean of z^2 of whole runs drawn again from a pool of replicates, so stopped, is 0.99 to 1.06. Tiles of a scene share
its light, so that one scene's mean scatters by 0.3 to 0.5, and that of twenty by 0.1: as large is what the page gives.

The two worlds of the reference are traced with the same random numbers, so that what the objects do not change drops
out of its noise. Its paths end by chance from the third vertex on: between walls, where its noise is largest, that
costs a third less for the same noise. Longer strata, other samplers and tiles traced as one pixel were no better.

Where a compact light shines on objects the fast strategy is tested twice: with paths from the camera alone, and with
light tracing (`pipeline.transport.caustics`), where those paths leave to it, whole or in part, what it is good at.

What is biased on purpose (speckles spread before denoising, the region, the denoiser) is measured apart, each on
against off, relative to the change.

A scene that is measured is kept in ``build/zscore`` and not measured again while the code of the transport stays.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.deliberate import measured_apart
from benchmarks.random_scenes import Case, random_case
from pipeline.transport.caustics import photons_for, thrown, throws
from pipeline.transport.difference import difference_block
from pipeline.transport.trace import Strategy, reference_block, trace

TILE, DEPTH = 8, 24  # depth: the two count vertices from different starts; 0.75**24 of the light is left out
PILOT, LEAST = 16, 16  # replicates of every tile: the scatter of the scatter is 18 %
ROUNDS = 12  # at most
ROULETTE = 3  # vertex from which the reference's paths end by chance
MARGIN = 1.15  # more replicates than the scatter so far asks for
LAUNCH = 1 << 20  # camera samples traced together
PHOTONS = 1 << 18  # of a replicate of light tracing, of each light
LIGHT_REPLICATES = 32
CHANGED, SHADOW = 0.01, 0.05  # of LS_noobj: what counts as changed, and as a shadow (`evaluate` draws the line there)
WANTED = 0.01  # standard error of the reference over the change
FAST_CPU_S = 25.0  # most CPU seconds of a scene for each way of the fast strategy
ORACLE = functools.partial(reference_block, roulette=ROULETTE)
LIMIT = 5.0
KEPT = Path("build/zscore")


@dataclass(frozen=True, eq=False)
class Tally:
    """Replicates of every tile: six numbers each, the change and the object layer in three channels."""

    tile: np.ndarray  # (J,) which tile
    values: np.ndarray  # (J, 6)
    tiles: int

    @property
    def count(self) -> np.ndarray:
        """(T,) replicates."""
        return np.bincount(self.tile, minlength=self.tiles)

    def of(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and squared standard error (T, K) of something (J, K) that every replicate has."""
        count = np.maximum(self.count, 1)[:, None]
        mean = self._sum(values) / count
        square = self._sum((values - mean[self.tile]) ** 2)
        return mean, square / np.maximum(count - 1, 1) / count

    def __add__(self, other: Tally) -> Tally:
        """More replicates."""
        tile, values = np.concatenate([self.tile, other.tile]), np.concatenate([self.values, other.values])
        return Tally(tile, values, self.tiles)

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(self.tile, column, self.tiles) for column in values.T], -1)


Estimate = Sequence[Tally]  # independent parts, whose means add up: paths from the camera, light tracing


def tile_pixels(shape: tuple[int, int]) -> np.ndarray:
    """(T, 64) flat index of the pixels of each whole tile."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    rows, columns = shape[0] // TILE, shape[1] // TILE
    cut = index[: rows * TILE, : columns * TILE]
    return cut.reshape(rows, TILE, columns, TILE).swapaxes(1, 2).reshape(rows * columns, TILE * TILE)


def replicates(case: Case, strategy: Strategy, wanted: np.ndarray, spp: int, random: np.random.Generator) -> Tally:
    """So many replicates (T,) of each tile, traced together in launches with a seed each."""
    pixels = tile_pixels(case.shape)
    jobs = np.repeat(np.arange(len(pixels)), wanted)
    together = max(1, LAUNCH // (TILE * TILE * spp))
    values = [np.zeros((0, 6))]
    for start in range(0, len(jobs), together):
        index = pixels[jobs[start : start + together]].ravel()
        found = trace(strategy, case.worlds, case.rays[index], spp, DEPTH, int(random.integers(2**31)))
        both = np.concatenate([found.lost + found.gained, found.obj], 1)
        values.append(both.reshape(-1, TILE * TILE, 6).mean(1))
    return Tally(jobs, np.concatenate(values), len(pixels))


def light_replicates(case: Case, count: int, random: np.random.Generator) -> Tally:
    """So many replicates of what light tracing adds to every tile, to go with paths of ``case.worlds.photons``."""
    pixels = tile_pixels(case.shape)
    tiles = len(pixels)
    slot = np.full(case.shape[0] * case.shape[1], -1)
    slot[pixels.ravel()] = np.repeat(np.arange(tiles), TILE * TILE)
    samples = PHOTONS / case.worlds.photons
    passes = [
        thrown(case.worlds, case.film, samples, int(random.integers(2**31)), lambda pixel: slot[pixel], tiles)
        for _ in range(count)
    ]
    values = np.concatenate([np.concatenate([one[0], one[1]], 1) for one in passes]) / TILE**2
    return Tally(np.tile(np.arange(tiles), count), values, tiles)


def unchanged(case: Case, random: np.random.Generator) -> np.ndarray:
    """(T, 3) LS_noobj to a few percent, to say which tiles count as changed."""
    pixels = tile_pixels(case.shape)
    samples = trace(reference_block, case.worlds, case.rays[pixels.ravel()], 64, DEPTH, int(random.integers(2**31)))
    return samples.without.reshape(-1, TILE * TILE, 3).mean(1)


def share_out(needed: np.ndarray, budget: int) -> np.ndarray:
    """Whole numbers (T,), at least `LEAST`, at most what is ``needed``, cut off at one height to keep the sum."""
    needed = np.clip(np.ceil(needed), LEAST, 1e7).astype(int)
    low, high = LEAST, int(needed.max())
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if np.minimum(needed, middle).sum() <= budget else (low, middle - 1)
    return np.minimum(needed, low)


def enough(
    case: Case, strategy: Strategy, spp: int, noobj: np.ndarray, cpu_s: float, random: np.random.Generator
) -> Tally:
    """Replicates until the standard error is `WANTED` of the change in every changed tile, or ``cpu_s`` are spent."""
    replicates(case, strategy, np.ones(len(noobj), int), spp, random)  # compiles
    start = time.process_time()
    seen = replicates(case, strategy, np.full(len(noobj), PILOT), spp, random)
    each = (time.process_time() - start) / len(seen.tile)
    tally = replicates(case, strategy, np.zeros(len(noobj), int), spp, random)
    for _ in range(ROUNDS):
        mean, square = seen.of(seen.values)
        level = np.abs(mean[:, :3])
        aim = np.where(level > CHANGED * noobj, WANTED * level, np.inf)
        needed = MARGIN * (seen.count[:, None] * square[:, :3] / aim**2).max(1)
        left = max(cpu_s - (time.process_time() - start), 0.0)
        wanted = share_out(np.maximum(needed, tally.count), int(tally.count.sum() + left / each))
        more = np.maximum(wanted - tally.count, 0)
        if not more.any():
            break
        tally = seen = tally + replicates(case, strategy, more, spp, random)
    return tally


def total(parts: Estimate, weight: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, squared standard error and degrees of freedom (Welch, Satterthwaite), each (T, K), of a sum of parts.

    ``weight`` (T, 3): of the channels of the change, which then are one number (K = 1) in every replicate.
    """
    means, squares, spread = [], [], []
    for part in parts:
        values = part.values
        if weight is not None:
            values = (values[:, :3] * weight[part.tile]).sum(1, keepdims=True)
        mean, square = part.of(values)
        means.append(mean)
        squares.append(square)
        spread.append(square**2 / np.maximum(part.count - 1, 1)[:, None])
    variance = np.sum(squares, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sum(means, 0), variance, variance**2 / np.sum(spread, 0)


def z_of(fast: Estimate, reference: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """The z (T, 6) of the difference of means, and its standard error (T, 6); 0 where both are the same constant."""
    from scipy import stats

    (a, _, _), (b, _, _) = total(fast), total(reference)
    _, variance, degrees = total([*fast, *reference])
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (a - b) / np.sqrt(variance)
        z = np.sign(a - b) * stats.norm.isf(stats.t.sf(np.abs(t), degrees))
    same = np.isclose(a, b, rtol=1e-6, atol=1e-9 * max(np.abs(b).max(), 1e-30))  # float32, summed
    return np.where(variance > 0, z, np.where(same, 0.0, np.inf)), np.sqrt(variance)


def common_bias(fast: Estimate, reference: Estimate, sigma: np.ndarray) -> tuple[float, float]:
    """Relative bias of the change common to all tiles, best weighted, and its standard error.

    Channels of a replicate are the same paths, so they are projected on one number before their scatter is taken.
    """
    level = total(reference)[0][:, :3]
    weight = np.divide(level, sigma[:, :3] ** 2, out=np.zeros_like(level), where=sigma[:, :3] > 0)
    whole = float((weight * level).sum())
    if not whole:
        return 0.0, 0.0
    (a, a2, _), (b, b2, _) = total(fast, weight), total(reference, weight)
    return float((a - b).sum() / whole), float(np.sqrt((a2 + b2).sum()) / whole)


@dataclass(frozen=True, eq=False)
class Tallied:
    """One scene: both strategies' replicates, the fast one's with light tracing where there is any, LS_noobj (T, 3)."""

    fast: Estimate
    lit: Estimate | None
    reference: Estimate
    noobj: np.ndarray


def tallied(case: Case, seed: int, cpu_s: float, spp: int = 256, light_count: int = LIGHT_REPLICATES) -> Tallied:
    """Replicates of a scene: the reference in at most about ``cpu_s`` CPU seconds, the fast strategy in few.

    ``spp`` of the reference; the fast strategy takes 64, as more strata help it little. ``light_count``:
    replicates of light tracing.
    """
    random = np.random.default_rng([seed, 9])
    noobj = unchanged(case, random)
    reference = enough(case, ORACLE, spp, noobj, cpu_s, random)
    fast = enough(case, difference_block, 64, noobj, min(FAST_CPU_S, cpu_s), random)
    if not throws(case.worlds):
        return Tallied([fast], None, [reference], noobj)
    photons = photons_for(case.worlds, case.shape[0] * case.shape[1])
    lit = replace(case, worlds=replace(case.worlds, photons=photons))
    light = light_replicates(lit, light_count, random)
    paths = enough(lit, difference_block, 64, noobj, min(FAST_CPU_S, cpu_s), random)
    return Tallied([fast], [paths, light], [reference], noobj)


def compare(case: Case, seed: int, cpu_s: float) -> dict[str, Any]:
    """One scene: the largest |z|, what could have been seen, how good the oracle was; with light tracing too."""
    start = time.process_time()
    found = tallied(case, seed, cpu_s)
    row = judged(found.fast, found.reference, found.noobj) | {"scene": case.name}
    if found.lit is not None:
        row["light_traced"] = judged(found.lit, found.reference, found.noobj)
        row["light_share"] = light_share(found.lit, found.noobj)
    return row | {"cpu_s": time.process_time() - start}


def light_share(lit: Estimate, noobj: np.ndarray) -> float:
    """Largest share of LS_noobj that light tracing alone adds to a tile."""
    traced = lit[1].of(lit[1].values)[0][:, :3]
    return float(np.divide(traced, noobj, out=np.zeros_like(noobj), where=noobj > 0).max())


def judged(fast: Estimate, reference: Estimate, noobj: np.ndarray) -> dict[str, Any]:
    """What two estimates say of each other; ``noobj`` (T, 3) is LS_noobj."""
    z, sigma = z_of(fast, reference)
    mean, square, _ = total(reference)
    level, error = np.abs(mean[:, :3]), np.sqrt(square[:, :3])
    changed, shadow = level > CHANGED * noobj, level > SHADOW * noobj
    bias, bias_sigma = common_bias(fast, reference, sigma)

    def reached(where: np.ndarray) -> float:
        return float((error[where] <= WANTED * level[where]).mean()) if where.any() else 1.0

    return {
        "zscore_max": float(np.abs(z).max()), "zscore_max_change": float(np.abs(z[:, :3]).max()),
        "zscore_square_mean": float((z[sigma > 0] ** 2).mean()) if (sigma > 0).any() else 0.0,
        "tested": int((sigma > 0).sum()), "changed": int(changed.sum()), "shadow": int(shadow.sum()),
        "oracle_reached_changed": reached(changed), "oracle_reached_shadow": reached(shadow),
        "oracle_rel_error_median": float(np.median(error[changed] / level[changed])) if changed.any() else 0.0,
        "oracle_rel_error_max": float((error[changed] / level[changed]).max()) if changed.any() else 0.0,
        "detectable_rel": (LIMIT * sigma[:, :3][changed] / level[changed]).tolist(),
        "bias_rel": bias, "bias_sigma_rel": bias_sigma,
        "replicates_fast": int(fast[0].count.sum()), "replicates_reference": int(reference[0].count.sum()),
    }  # fmt: skip


@functools.cache
def code_digest() -> str:
    """Of what a scene's figures depend on: the transport, the random scenes, and this file."""
    here = Path(__file__).resolve().parent
    names = ("caustics", "difference", "directions", "materials", "paths", "scene", "surfaces", "trace")
    files = [here.parent / "pipeline" / "transport" / f"{name}.py" for name in names]
    digest = hashlib.sha256()
    for file in (*files, here / "random_scenes.py", Path(__file__).resolve()):
        digest.update(file.read_bytes())
    effort = (
        TILE, DEPTH, PILOT, LEAST, ROUNDS, ROULETTE, MARGIN, PHOTONS, LIGHT_REPLICATES, CHANGED, SHADOW, WANTED,
        FAST_CPU_S,
    )  # fmt: skip
    digest.update(repr(effort).encode())
    return digest.hexdigest()[:16]


def kept(seed: int, cpu_s: float, folder: Path | None) -> dict[str, Any]:
    """The figures of scene ``seed``: of an earlier run of the same code, else measured and kept in ``folder``."""
    file = folder / f"scene_{seed:03d}.json" if folder is not None else None
    asked = {"code": code_digest(), "budget_cpu_s": cpu_s}
    if file is not None and file.exists():
        found: dict[str, Any] = json.loads(file.read_text())
        if {name: found.get(name) for name in asked} == asked:
            return found
    row = compare(random_case(seed), seed, cpu_s) | asked
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(row, indent=1) + "\n")
    return row


def run(
    scenes: int = 20,
    scene_cpu_s: float = 500.0,
    bias_scenes: int = 4,
    tell: Callable[[str], None] = lambda text: None,
    folder: Path | None = None,
) -> dict[str, Any]:
    """All scenes, and the deliberate biases on the first few. ``zscore_max`` must stay below 5."""
    table = []
    code_digest()  # of the code that runs, whatever is edited meanwhile
    for seed in range(scenes):
        table.append(row := kept(seed, scene_cpu_s, folder))
        tell(line(seed, row))
    light = [row["light_traced"] for row in table if "light_traced" in row]
    found = summary(table) | {"light_traced": summary(light) if light else None}
    found["zscore_max"] = max([row["zscore_max"] for row in table] + [row["zscore_max"] for row in light])
    found["cpu_s"] = sum(row["cpu_s"] for row in table)
    start = time.process_time()
    found["bias"] = measured_apart(bias_scenes)
    found["bias_cpu_s"] = time.process_time() - start
    for row in (*table, *light):
        row.pop("detectable_rel")
    return found | {"scenes": table}


def summary(table: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the rows of several scenes, the fast strategy one way."""
    seen = np.concatenate([row["detectable_rel"] for row in table])
    weights = np.array([1 / max(row["bias_sigma_rel"], 1e-9) ** 2 if row["bias_sigma_rel"] else 0.0 for row in table])
    tested = [row["tested"] for row in table]
    return {
        "zscore_max": max(row["zscore_max"] for row in table),
        "zscore_square_mean": float(np.average([row["zscore_square_mean"] for row in table], weights=tested)),
        "number_of_scenes": len(table),
        "tile_channels_tested": sum(tested),
        "tile_channels_changed": sum(row["changed"] for row in table),
        "smallest_detectable_bias_rel": float(np.median(seen)),
        "smallest_detectable_bias_rel_p90": float(np.quantile(seen, 0.9)),
        "smallest_detectable_common_bias_rel": float(LIMIT / np.sqrt(weights.sum())),
        "common_bias_rel": float(np.average([row["bias_rel"] for row in table], weights=weights)),
        "oracle_reached_changed": _share(table, "oracle_reached_changed", "changed"),
        "oracle_reached_shadow": _share(table, "oracle_reached_shadow", "shadow"),
        "oracle_rel_error_max": max(row["oracle_rel_error_max"] for row in table),
    }


def _share(table: list[dict[str, Any]], key: str, size: str) -> float:
    return float(sum(row[key] * row[size] for row in table) / max(sum(row[size] for row in table), 1))


def line(seed: int, row: dict[str, Any]) -> str:
    """A scene in a line."""
    light = row.get("light_traced")
    return (
        f"{seed:3d}  max|z| {row['zscore_max']:5.2f}  mean z^2 {row['zscore_square_mean']:5.2f}  common bias "
        f"{row['bias_rel']:+.2%} +- {row['bias_sigma_rel']:.2%}  oracle at 1 %: {row['oracle_reached_changed']:4.0%} "
        f"of {row['changed']:2d} (largest {row['oracle_rel_error_max']:.1%})  {row['cpu_s']:4.0f} CPU s  {row['scene']}"
        + (f"; light traced {row['light_share']:.0%}, max|z| {light['zscore_max']:.2f}" if light else "")
    )


def main() -> None:
    """Measure, say so, and write it into render.json and its page."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=20, help="how many")
    parser.add_argument("--cpu-s", type=float, default=500.0, help="most CPU seconds of a scene's reference")
    parser.add_argument("--biases", type=int, default=4, help="scenes on which the deliberate biases are measured")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder of render.json")
    given = parser.parse_args()
    found = run(
        given.scenes, given.cpu_s, given.biases, lambda text: print(text, flush=True), KEPT  # noqa: T201  progress
    )  # fmt: skip
    print(json.dumps({key: value for key, value in found.items() if key != "scenes"}, indent=1))  # noqa: T201  a command's answer
    into_record(found, given.out)


def into_record(found: dict[str, Any], out: Path) -> None:
    """Put the figures into ``out/render.json``, beside what is there, and write its page anew if it is whole."""
    from benchmarks.page import write_page

    file = out / "render.json"
    record = json.loads(file.read_text()) if file.exists() else {}
    record |= {"zscore_max": found["zscore_max"], "zscore": found}
    out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(record, indent=1) + "\n")
    if "size" in record:
        write_page(record, out)


if __name__ == "__main__":
    main()
