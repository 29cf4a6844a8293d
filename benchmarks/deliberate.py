"""What is biased on purpose, each measured apart: the region, the spreading of speckles, the denoiser.

On wider views of the random scenes, 18 x 12 tiles. The truth is the fast strategy with many samples, whose own bias
`benchmarks.zscore` bounds. Each effect is *on minus off on the same samples*, so that noise cancels where the effect
does nothing, averaged over independent seeds; it is given relative to the true change (or object layer) of the tile.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.random_scenes import Case, random_case
from pipeline.transport.denoise import tile_means
from pipeline.transport.difference import difference_block
from pipeline.transport.estimate import Canvas, Effort, pictures, prepare, sampled
from pipeline.transport.passes import Halves
from pipeline.transport.region import limits_for
from pipeline.transport.trace import trace

SHAPE, FOV_DEG = (96, 144), 80.0
SEEDS, SAMPLES, TRUTH_SAMPLES, DEPTH = 6, 48, 512, 12
PLATE_NOISE, THRESHOLD = 0.01, 0.004  # of the photograph; the knob's default
# Where an effect counts: change over LS_noobj (the region cuts what is fainter than the rest), share of an object.
CHANGED, FAINT, SHOWN = 0.01, 0.001, 0.5
Effects = dict[str, np.ndarray]


def measured_apart(scenes: int) -> dict[str, dict[str, float]]:
    """Figures of every effect, over all changed tiles of the first ``scenes`` random scenes.

    ``rms``, ``p95`` of the effect over the change, ``net`` of the sums over all tiles, and ``noise``: the rms that the
    scatter between seeds alone leaves in ``rms``.
    """
    found = [effects_of(random_case(seed, SHAPE, FOV_DEG), seed) for seed in range(scenes)]
    return {name: figures([one[name] for one in found]) for name in (found[0] if found else {})}


def effects_of(case: Case, seed: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Per effect: (seeds, N) effect and (N,) true value of the tiles where it counts; means of the channels."""
    truth = trace(difference_block, case.worlds, case.rays, TRUTH_SAMPLES, DEPTH, 11 + seed)
    change = (truth.lost + truth.gained).reshape(*case.shape, 3)
    obj, alpha = truth.obj.reshape(*case.shape, 3), truth.alpha.reshape(case.shape)
    rows = []
    for number in range(SEEDS):
        effort = Effort(samples=SAMPLES, depth=DEPTH, seed=1000 * seed + 101 * number)
        canvas = planned(case, truth.albedo, effort)
        noobj, effects = quieting(traced_everywhere(canvas))
        rows.append({"region": grey(cut(canvas, change, noobj) - change), **effects})
    true_change, true_obj = grey(change), grey(obj)
    relative = np.abs(true_change) / np.maximum(grey(noobj), 1e-9)
    places = {"region": relative > FAINT, "change": relative > CHANGED, "objects": tile_means(alpha) > SHOWN}

    def told(name: str) -> tuple[np.ndarray, np.ndarray]:
        what = "objects" if "objects" in name else "region" if name == "region" else "change"
        return np.stack([row[name][places[what]] for row in rows]), (true_obj if what == "objects" else true_change)[
            places[what]
        ]

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
    whole = np.ones(canvas.shape)
    region = replace(canvas.region, weight=whole, traced=whole > 0)
    return replace(canvas, region=region, effort=replace(canvas.effort, adaptive=False))


def quieting(canvas: Canvas) -> tuple[np.ndarray, Effects]:
    """LS_noobj (H, W, 3), and per tile what speckles and denoiser (speckles included) do to change and object."""
    halves = finished(canvas)
    raw, _ = pictures(replace(canvas, effort=replace(canvas.effort, denoise=False)), halves)
    calm, quiet = pictures(canvas, halves)
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
    smooth = (canvas.region.lost + canvas.region.gained) * noobj
    return np.where(canvas.region.interpolated[..., None], smooth, truth) * canvas.region.weight[..., None]


def figures(parts: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Of effects (seeds, N) and true values (N,) of several scenes."""
    effects = np.concatenate([effect for effect, _ in parts], 1)
    size = np.abs(np.concatenate([true for _, true in parts]))
    mean, noise = effects.mean(0) / size, effects.std(0, ddof=1) / np.sqrt(SEEDS) / size
    return {
        "rms": float(np.sqrt((mean**2).mean())), "median": float(np.median(np.abs(mean))),
        "p95": float(np.quantile(np.abs(mean), 0.95)), "net": float(effects.mean(0).sum() / size.sum()),
        "noise": float(np.sqrt((noise**2).mean())), "tiles": len(size),
    }  # fmt: skip
