"""What is biased on purpose, each measured apart: the region, the spreading of speckles, the denoiser.

On wider views of the random scenes, 18 x 12 tiles. The truth is the fast strategy with many samples, whose own bias
`benchmarks.zscore` bounds. Each effect is *on minus off on the same samples*, so that noise cancels where the effect
does nothing, averaged over independent seeds; it is given relative to the true change (or object layer) of the tile.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.random_scenes import Case, random_case
from pipeline.transport.canvas import Canvas, pictures
from pipeline.transport.denoise import TILE, tile_means
from pipeline.transport.difference import difference_block
from pipeline.transport.estimate import prepare, sampled
from pipeline.transport.passes import Halves
from pipeline.transport.pilot import Effort
from pipeline.transport.region import Region, limits_for
from pipeline.transport.trace import trace, unchanged_block

SHAPE, FOV_DEG = (96, 144), 80.0
SEEDS, SAMPLES, TRUTH_SAMPLES, DEPTH = 6, 48, 512, 12
PLATE_NOISE, THRESHOLD = 0.01, 0.004  # of the photograph; the knob's default
# Where an effect counts: change over LS_noobj (the region cuts what is fainter than the rest), share of an object.
CHANGED, FAINT, SHOWN = 0.01, 0.001, 0.5
KNOWN = 5.0  # standard errors of the truth by which a change must differ from none
Effects = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Told:
    """An effect (seeds, N) on the tiles where it counts, their true value and LS_noobj (N,); means of the channels."""

    effect: np.ndarray
    true: np.ndarray
    noobj: np.ndarray


def measured_apart(scenes: int) -> dict[str, dict[str, float]]:
    """Figures of every effect, over all changed tiles of the first ``scenes`` random scenes.

    ``rms``, ``median`` and ``p95`` of the effect over the change, ``net`` of the sums over all tiles, ``noise``: what
    the scatter between seeds alone leaves in ``rms``; ``p95_of_noobj``: over LS_noobj.
    """
    found = [effects_of(random_case(seed, SHAPE, FOV_DEG), seed) for seed in range(scenes)]
    return {name: figures([one[name] for one in found]) for name in (found[0] if found else {})}


def effects_of(case: Case, seed: int) -> dict[str, Told]:
    """Every effect in one scene."""
    truth = trace(difference_block, case.worlds, case.rays, TRUTH_SAMPLES, DEPTH, 11 + seed)
    change = (truth.lost + truth.gained).reshape(*case.shape, 3)
    obj, alpha = truth.obj.reshape(*case.shape, 3), truth.alpha.reshape(case.shape)
    rows = []
    for number in range(SEEDS):
        effort = Effort(samples=SAMPLES, depth=DEPTH, seed=1000 * seed + 101 * number)
        canvas = planned(case, truth.albedo, effort)
        noobj, effects = quieting(traced_everywhere(canvas))
        rows.append({"region": grey(cut(canvas, change, noobj) - change), **effects})
    true = {"change": grey(change), "objects": grey(obj)}
    bare = trace(unchanged_block, case.worlds, case.rays, SAMPLES, DEPTH, 12 + seed).without
    level = np.maximum(grey(bare.reshape(*case.shape, 3)), 1e-9)
    sigma = np.sqrt(tile_means(truth.change_variance.max(-1).reshape(case.shape))) / TILE
    places = {
        "region": np.abs(true["change"]) > np.maximum(FAINT * level, KNOWN * sigma),
        "change": np.abs(true["change"]) > CHANGED * level,
        "objects": tile_means(alpha) > SHOWN,
    }

    def told(name: str) -> Told:
        what = "objects" if "objects" in name else "change"
        where = places["region" if name == "region" else what]
        return Told(np.stack([row[name][where] for row in rows]), true[what][where], level[where])

    return {name: told(name) for name in rows[0]}


def grey(rgb: np.ndarray) -> np.ndarray:
    """(h, w) tile means of the channels' mean."""
    return tile_means(rgb.mean(-1))


def planned(case: Case, albedo: np.ndarray, effort: Effort) -> Canvas:
    """Pilot and region for a plate that is the model itself with `PLATE_NOISE`."""
    plate = np.maximum(albedo * case.light / np.pi, 1e-6).reshape(*case.shape, 3)
    limits = limits_for(plate, (PLATE_NOISE * plate) ** 2, THRESHOLD)
    sigma, white = PLATE_NOISE * plate.mean(-1), float(case.light.mean() / np.pi)
    return prepare(case.worlds, case.rays, case.shape, case.light, sigma, white, limits, effort)[0]


def traced_everywhere(canvas: Canvas) -> Canvas:
    """The canvas without region: every pixel traced, all samples."""
    whole, none = np.ones(canvas.shape), np.zeros((*canvas.shape, 3), np.float32)
    window = slice(0, canvas.shape[0]), slice(0, canvas.shape[1])
    region = Region(window, whole, whole > 0, none, none, none)
    return replace(canvas, region=region, effort=replace(canvas.effort, adaptive=False))


def quieting(canvas: Canvas) -> tuple[np.ndarray, Effects]:
    """LS_noobj (H, W, 3), and per tile what speckles and denoiser (speckles included) do to change and object."""
    halves = finished(canvas)
    (raw, _), (calm, quiet) = (
        pictures(one, halves) for one in (replace(canvas, effort=replace(canvas.effort, denoise=False)), canvas)
    )
    assert quiet is not None  # the effort asks for it
    noobj = raw["without"]
    return noobj, {
        "speckles": (quiet.survives.moved + quiet.added.moved) * grey(noobj),
        "denoiser": grey(calm["lost"] + calm["gained"] - raw["lost"] - raw["gained"]),
        "speckles on objects": quiet.obj.moved,
        "denoiser on objects": grey(calm["obj"] - raw["obj"]),
    }


def finished(canvas: Canvas) -> Halves:
    """All samples."""
    *_, shot = sampled(canvas)
    return shot.halves


def cut(canvas: Canvas, truth: np.ndarray, noobj: np.ndarray) -> np.ndarray:
    """The true change (H, W, 3) as the region lets it through: left out, faded, or interpolated from the pilot."""
    region, inside = canvas.region, canvas.window
    smooth = (region.lost + region.gained) * noobj[inside]
    seen = np.where(region.interpolated[..., None], smooth, truth[inside]) * region.weight[..., None]
    return canvas.framed(seen)


def figures(parts: list[Told]) -> dict[str, float]:
    """Of one effect in several scenes; without a tile where it counts, only that."""
    effects = np.concatenate([part.effect for part in parts], 1)
    size = np.abs(np.concatenate([part.true for part in parts]))
    noobj = np.concatenate([part.noobj for part in parts])
    if not len(size):
        return {"tiles": 0}
    mean = effects.mean(0)
    noise = effects.std(0, ddof=1) / np.sqrt(SEEDS) / size
    return {
        "rms": float(np.sqrt(((mean / size) ** 2).mean())), "median": float(np.median(np.abs(mean) / size)),
        "p95": float(np.quantile(np.abs(mean) / size, 0.95)), "net": float(mean.sum() / size.sum()),
        "noise": float(np.sqrt((noise**2).mean())), "p95_of_noobj": float(np.quantile(np.abs(mean) / noobj, 0.95)),
        "tiles": len(size),
    }  # fmt: skip
