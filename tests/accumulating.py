"""A toy renderer that offers, keeps checkpoints and can be interrupted, the picture that follows it, and its build.

Run as a program, it is killed after a block: ``python accumulating.py FOLDER BLOCK``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from pipeline.run import live, progress
from pipeline.run.runner import Build
from pipeline.run.settings import Settings
from pipeline.run.stage import Artifact, Graph, Stage
from pipeline.types import Raster, Result

SHAPE = (4, 5)
BLOCKS = 6


class Knob(BaseModel):
    blocks: int = BLOCKS
    gain: float = 1.0


LEVEL = Artifact("level", "json", "what the picture is added to", type=float)
MEAN = Artifact("mean", "raster", "mean of the blocks", "1", "data")
SEEN = Artifact("seen", "picture", "the mean, to look at", "", "display")
COMPUTED: list[int] = []  # blocks, in the order of their computation


def nothing_happens(block: int) -> None:
    """After a block, by default."""


happens: list[Callable[[int], None]] = [nothing_happens]  # called after each block


def level(params: Knob) -> Result:
    return Result({"level": params.gain})


def mean(params: Knob) -> Result:
    """The recipe of CONTRIBUTING.md, on random numbers."""
    state = progress.checkpoint_load() or {"total": np.zeros(SHAPE), "blocks": np.array(0)}
    total, done = state["total"], int(state["blocks"])

    def sums() -> progress.Arrays:
        return {"total": total, "blocks": np.array(done)}

    def result() -> Result:
        numbers = {"complete": done == params.blocks, "share_done": done / params.blocks}
        return Result({"mean": Raster({"v": params.gain * total / done}, "data")}, numbers)

    while done < params.blocks:
        total += np.random.default_rng(done).normal(size=SHAPE)
        done += 1
        COMPUTED.append(done)
        happens[0](done)
        stop = progress.interrupted()
        progress.checkpoint_save(sums)
        progress.offer(result)
        progress.report("mean", done / params.blocks)
        if stop:
            break
    return result()


def seen(level: float, mean: Raster, params: Knob) -> Result:
    grey = np.clip(128 + 40 * (mean["v"] + level), 0, 255).astype(np.uint8)
    return Result({"seen": np.repeat(grey[..., None], 3, -1)})


STAGES = [
    Stage("level", level, Knob, {}, {"level": LEVEL}),
    Stage("mean", mean, Knob, {}, {"mean": MEAN}),
    Stage("seen", seen, Knob, {"level": LEVEL, "mean": MEAN}, {"seen": SEEN}, live=True),
]


def build(out: Path, **knobs: float) -> Build:
    """A new build on the folder, as a new process would have it; ``knobs`` are those of ``mean``."""
    params = {stage.name: Knob().model_dump() for stage in STAGES}
    params["mean"] |= knobs
    settings = Settings(capture="", scene=None, quality="draft", params=params)
    return Build(Graph(STAGES), out, settings, {stage.name: Knob for stage in STAGES})


def run(one: Build) -> dict[str, str]:
    """Outcome of every stage."""
    outcomes: dict[str, str] = {}
    COMPUTED.clear()
    with one.stop.listening():
        one.run_all(one.graph.stages, lambda name, outcome, seconds: outcomes.update({name: outcome}))
    return outcomes


def always_due() -> None:
    """Every offer shown, every checkpoint written, whatever they cost."""
    live.OFFER_EVERY_S = live.SAVE_EVERY_S = live.OFFER_LEFT_S = 0.0
    live.OFFER_SHARE = live.SAVE_SHARE = 1.0


if __name__ == "__main__":
    always_due()
    happens[0] = lambda block: os._exit(9) if block == int(sys.argv[2]) else None
    run(build(Path(sys.argv[1])))
