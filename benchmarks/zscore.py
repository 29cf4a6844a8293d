"""Is the fast strategy unbiased? Fast minus reference on random scenes, over the standard error of the difference.

    .venv/bin/python -m benchmarks.zscore [scenes]

Both strategies estimate the change of the local scene and the object layer on tiles of 8 x 8 pixels. A *replicate* is
the mean of a tile over ``spp`` samples per pixel with a seed of its own; means and standard errors come from the
scatter of independent replicates and from nothing that a strategy says of itself. Clamp, region and denoiser are off.
Student's t of the difference (degrees of freedom after Welch and Satterthwaite) is turned into the z of equal
probability, so that few replicates are no excuse; a z beyond 5 happens by chance once in 1.7 million.

The effort goes where it is needed: a pilot, thrown away, tells how many replicates bring the reference's standard error
to 1 % of the change. Tiles that would need more than the budget get what is left, and are counted.

What is biased on purpose (speckles spread before denoising, the region, the denoiser) is measured apart, each on
against off, relative to the change.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.deliberate import measured_apart
from benchmarks.random_scenes import Case, random_case
from pipeline.transport.difference import difference_block
from pipeline.transport.trace import Strategy, reference_block, trace

TILE, DEPTH = 8, 24  # depth: the two count vertices from different starts; 0.75**24 of the light is left out
LEAST = 16  # replicates of every tile: the scatter of the scatter is 18 %
LAUNCH = 1 << 20  # camera samples traced together
CHANGED, SHADOW = 0.01, 0.05  # of LS_noobj: what counts as changed, and as a shadow (`evaluate` draws the line there)
WANTED = 0.01  # standard error of the reference over the change
LIMIT = 5.0


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

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(self.tile, column, self.tiles) for column in values.T], -1)


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
    values = []
    for start in range(0, len(jobs), together):
        index = pixels[jobs[start : start + together]].ravel()
        found = trace(strategy, case.worlds, case.rays[index], spp, DEPTH, int(random.integers(2**31)))
        both = np.concatenate([found.lost + found.gained, found.obj], 1)
        values.append(both.reshape(-1, TILE * TILE, 6).mean(1))
    return Tally(jobs, np.concatenate(values), len(pixels))


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


def z_of(fast: Tally, reference: Tally) -> tuple[np.ndarray, np.ndarray]:
    """The z (T, 6) of the difference of means, and its standard error (T, 6); 0 where both are the same constant."""
    from scipy import stats

    (a, a2), (b, b2) = fast.of(fast.values), reference.of(reference.values)
    variance = a2 + b2
    free = np.maximum(fast.count - 1, 1)[:, None], np.maximum(reference.count - 1, 1)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        degrees = variance**2 / (a2**2 / free[0] + b2**2 / free[1])
        t = (a - b) / np.sqrt(variance)
        z = np.sign(a - b) * stats.norm.isf(stats.t.sf(np.abs(t), degrees))
    same = np.isclose(a, b, rtol=1e-6, atol=1e-9 * max(np.abs(b).max(), 1e-30))  # float32, summed
    return np.where(variance > 0, z, np.where(same, 0.0, np.inf)), np.sqrt(variance)


def common_bias(fast: Tally, reference: Tally, sigma: np.ndarray) -> tuple[float, float]:
    """Relative bias of the change common to all tiles, best weighted, and its standard error.

    Channels of a replicate are the same paths, so they are projected on one number before their scatter is taken.
    """
    level = reference.of(reference.values)[0][:, :3]
    weight = np.divide(level, sigma[:, :3] ** 2, out=np.zeros_like(level), where=sigma[:, :3] > 0)
    ends = [t.of((t.values[:, :3] * weight[t.tile]).sum(1, keepdims=True)) for t in (fast, reference)]
    total = float((weight * level).sum())
    if not total:
        return 0.0, 0.0
    (a, a2), (b, b2) = ends
    return float((a - b).sum() / total), float(np.sqrt((a2 + b2).sum()) / total)


def compare(case: Case, seed: int, cpu_s: float, spp: int = 256) -> dict[str, Any]:
    """One scene in about ``cpu_s`` CPU seconds: the largest |z|, what could have been seen, how good the oracle was."""
    return judged(*tallied(case, seed, cpu_s, spp)) | {"scene": case.name}


def tallied(case: Case, seed: int, cpu_s: float, spp: int, pilot: int = 8) -> tuple[Tally, Tally, np.ndarray]:
    """Replicates of the fast strategy and of the reference, and LS_noobj (T, 3).

    A third of ``cpu_s`` goes to the fast strategy, whose target is half the reference's. ``spp`` of the reference; the
    fast strategy takes 64, as more strata help it little.
    """
    random = np.random.default_rng([seed, 9])
    noobj = unchanged(case, random)
    tallies = []
    for strategy, per_pixel, part, target in (
        (difference_block, 64, 1 / 3, WANTED / 2), (reference_block, spp, 2 / 3, WANTED),
    ):  # fmt: skip
        replicates(case, strategy, np.ones(len(noobj), int), per_pixel, random)  # compiles
        start = time.process_time()
        first = replicates(case, strategy, np.full(len(noobj), pilot), per_pixel, random)
        each = (time.process_time() - start) / len(first.tile)
        mean, square = first.of(first.values)
        changed = np.abs(mean[:, :3]) > CHANGED * noobj
        aim = np.where(changed, target * np.abs(mean[:, :3]), np.inf)
        wanted = share_out((pilot * square[:, :3] / aim**2).max(1), int(part * cpu_s / each))
        tallies.append(replicates(case, strategy, wanted, per_pixel, random))
    fast, reference = tallies
    return fast, reference, noobj


def judged(fast: Tally, reference: Tally, noobj: np.ndarray) -> dict[str, Any]:
    """What two tallies say of each other; ``noobj`` (T, 3) is LS_noobj."""
    z, sigma = z_of(fast, reference)
    mean, square = reference.of(reference.values)
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
        "detectable_rel": (LIMIT * sigma[:, :3][changed] / level[changed]).tolist(),
        "bias_rel": bias, "bias_sigma_rel": bias_sigma,
        "replicates_fast": int(fast.count.sum()), "replicates_reference": int(reference.count.sum()),
    }  # fmt: skip


def run(
    scenes: int = 20, scene_cpu_s: float = 15.0, bias_scenes: int = 4, tell: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """All scenes, and the deliberate biases on the first few. ``zscore_max`` must stay below 5."""
    table = []
    for seed in range(scenes):
        table.append(row := compare(random_case(seed), seed, scene_cpu_s))
        tell(line(seed, row))
    seen = np.concatenate([row.pop("detectable_rel") for row in table])
    weights = np.array([1 / max(row["bias_sigma_rel"], 1e-9) ** 2 for row in table])
    tested = [row["tested"] for row in table]
    return {
        "zscore_max": max(row["zscore_max"] for row in table),
        "zscore_square_mean": float(np.average([row["zscore_square_mean"] for row in table], weights=tested)),
        "tile_channels_tested": sum(tested),
        "smallest_detectable_bias_rel": float(np.median(seen)),
        "smallest_detectable_common_bias_rel": float(LIMIT / np.sqrt(weights.sum())),
        "common_bias_rel": float(np.average([row["bias_rel"] for row in table], weights=weights)),
        "oracle_reached_changed": _share(table, "oracle_reached_changed", "changed"),
        "oracle_reached_shadow": _share(table, "oracle_reached_shadow", "shadow"),
        "scenes": table,
        "bias": measured_apart(bias_scenes),
    }


def _share(table: list[dict[str, Any]], key: str, size: str) -> float:
    return float(sum(row[key] * row[size] for row in table) / max(sum(row[size] for row in table), 1))


def line(seed: int, row: dict[str, Any]) -> str:
    """A scene in a line."""
    return (
        f"{seed:3d}  max|z| {row['zscore_max']:5.2f}  mean z^2 {row['zscore_square_mean']:5.2f}  common bias "
        f"{row['bias_rel']:+.2%} +- {row['bias_sigma_rel']:.2%}  oracle at 1 %: {row['oracle_reached_changed']:4.0%} "
        f"(shadow {row['oracle_reached_shadow']:4.0%})  {row['scene']}"
    )


def main() -> None:
    """Measure and say so."""
    found = run(int(sys.argv[1]) if len(sys.argv) > 1 else 20, tell=lambda text: print(text, flush=True))  # noqa: T201  a command's progress
    print(json.dumps({key: value for key, value in found.items() if key != "scenes"}, indent=1))  # noqa: T201  a command's answer


if __name__ == "__main__":
    main()
