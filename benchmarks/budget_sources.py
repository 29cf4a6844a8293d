"""Which source of the budget is overstated? A factor on each source's sigma, of the largest likelihood.

    .venv/bin/python -m benchmarks.budget 24 --kind desk --keep --folder build/kept
    .venv/bin/python -m benchmarks.budget_sources build/kept/desk [--against truth]

Errors of the pixels and regions that `benchmarks.budget` compares, of all captures whose builds were kept, are taken as
normal with the covariance that modes, plate and render state; every source gets one factor on its sigma (flux and sky
modes one for green, one for red and blue: their channels are independent), fitted on all captures and on either half.
`scatter`: errors about their mean over the captures; `truth`: whole errors.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.budget import places
from pipeline.image.truth import load_truth
from pipeline.run.cli import say
from pipeline.run.formats import read_exr

OWN = ("plate", "render", "means")  # of single pixels: plate and render; of regions: what `of_means` says
CHANNELS_APART = ("flux", "sky")
LEAST = 1e-4  # of a place's level: what no source is below
DOUBT = 2.0  # prior standard deviation of a factor's logarithm


@dataclass(frozen=True, eq=False)
class Capture:
    """Errors (P, 3) over a place's level; shared errors by source, (K, P, 3); own variances by source, (P, 3)."""

    error: np.ndarray
    shared: dict[str, np.ndarray]
    own: dict[str, np.ndarray]


def loaded(work: Path, shared_truth: Path) -> Capture:
    """What one kept build says of all places, pixels first."""
    build = work / "build"
    single, regions = places(shared_truth)
    pixels = [tuple(at) for mask in single.values() for at in np.argwhere(mask)]
    truth, composite = load_truth(work / "capture/truth/truth.json"), read_exr(build / "composite/composite.exr")
    plate, unsure = (
        read_exr(build / "develop/photographs/plate.exr").rgb(),
        read_exr(build / "uncertainty/uncertainty.exr"),
    )
    scale = float(np.median(np.linalg.norm(plate, axis=-1) / np.linalg.norm(truth.plate, axis=-1)))

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([values[at] for at in pixels] + [values[mask].mean(0) for mask in regions.values()]).astype(
            float
        )

    level = at(composite.rgb()).mean(-1, keepdims=True)
    sources = json.loads((build / "uncertainty/record.json").read_text())["numbers"]["modes"]
    shared: dict[str, list[np.ndarray]] = {}
    for name, source in sources.items():
        change = at(unsure.rgb(f"mode_{name}")) / level
        if source in CHANNELS_APART:
            for channel, key in enumerate(("red, blue", "green", "red, blue")):
                shared.setdefault(f"{source}, {key}", []).append(change * (np.arange(3) == channel))
        else:
            shared.setdefault(source, []).append(change)
    count, means = len(pixels), unsure.rgb("of_means").astype(float) ** 2
    own = {name: np.zeros(level.shape) + np.zeros(3) for name in OWN}
    for name in OWN[:2]:
        own[name][:count] = np.stack([unsure.rgb(name)[at] ** 2 for at in pixels])
    own["means"][count:] = np.stack([means[mask].mean(0) / mask.sum() for mask in regions.values()])
    error = at(composite.rgb() - scale * truth.with_objects) / level
    return Capture(
        error, {name: np.array(parts) for name, parts in shared.items()}, {n: v / level**2 for n, v in own.items()}
    )


def loss(logs: np.ndarray, names: list[str], captures: list[Capture]) -> float:
    """Negative log likelihood of factors exp(``logs``), with a weak prior at 1."""
    factor, total = dict(zip(names, np.exp(logs), strict=True)), float((logs**2).sum()) / (2 * DOUBT**2)
    for one in captures:
        error = one.error.ravel()
        variance = sum(factor[n] ** 2 * v for n, v in one.own.items()).ravel() + LEAST**2
        modes = np.concatenate([factor[n] * v.reshape(len(v), -1) for n, v in one.shared.items()]).T
        weighted = modes / variance[:, None]
        inner, side = np.eye(modes.shape[1]) + modes.T @ weighted, weighted.T @ error
        total += 0.5 * float(
            np.log(variance).sum() + np.linalg.slogdet(inner)[1] + (error**2 / variance).sum()
            - side @ np.linalg.solve(inner, side)
        )  # fmt: skip
    return total


def fitted(names: list[str], captures: list[Capture]) -> np.ndarray:
    """Factors of the largest likelihood."""
    from scipy.optimize import minimize

    bounds = [(-3.5, 3.0)] * len(names)
    found = minimize(loss, np.zeros(len(names)), (names, captures), method="L-BFGS-B", bounds=bounds)
    return np.asarray(np.exp(found.x))


def about_their_mean(captures: list[Capture]) -> list[Capture]:
    """Errors less their mean over the captures, larger by the share of scatter that the mean took."""
    mean, count = np.mean([one.error for one in captures], 0), len(captures)
    spread = np.sqrt(count / (count - 1))
    return [Capture((one.error - mean) * spread, one.shared, one.own) for one in captures]


def main() -> None:
    """Read what was kept, fit, print."""
    parser = argparse.ArgumentParser(prog="benchmarks.budget_sources")
    parser.add_argument("folder", type=Path, help="of one kind, with work_NNN and radiance")
    parser.add_argument("--against", choices=("scatter", "truth"), default="scatter")
    asked = parser.parse_args()
    works = [path for path in sorted(asked.folder.glob("work_*")) if (path / "build/uncertainty/record.json").exists()]
    if len(works) < 4:
        raise SystemExit(f"{asked.folder}: {len(works)} kept builds, needed 4; run benchmarks.budget with --keep")
    captures = [loaded(work, asked.folder / "radiance/truth/truth.json") for work in works]
    if asked.against == "scatter":
        captures = about_their_mean(captures)
    names = sorted({name for one in captures for name in one.shared}) + list(OWN)
    found = [fitted(names, some) for some in (captures, captures[::2], captures[1::2])]
    say(f"{len(captures)} captures, {asked.against}: factor on each source's sigma, of all and of either half")
    for name, *factors in zip(names, *found, strict=True):
        say(f"{name:18s}" + "".join(f"{factor:8.2f}" for factor in factors))


if __name__ == "__main__":
    main()
