"""Sampling in passes: a complete picture after the first, refined where it is still noisier than the photograph.

Every pass adds as many samples to each of two independent halves, so that the noise of what is made of them (denoised
or not) can be seen in their difference. Pixels leave when they are quiet enough, or have their share of samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.transport.scene import Worlds
from pipeline.transport.trace import Rays, Samples, Strategy, trace

LONGEST = 32  # samples per pixel, half and pass: how much an interruption may lose
OBJECT_BOOST = 4  # a pixel that shows an object may take that many times the samples


class Interrupted(Exception):
    """Raised by a progress callback to end within a pass."""


@dataclass(frozen=True, eq=False)
class Halves:
    """What has been sampled of a set of pixels: two independent halves, the passes made, and what is still open."""

    a: Samples
    b: Samples
    passes: int
    open: np.ndarray  # (N,) bool, pixels that want more samples

    @classmethod
    def none(cls, pixels: int) -> Halves:
        """Before the first pass."""
        return cls(Samples.none(pixels), Samples.none(pixels), 0, np.ones(pixels, bool))

    @property
    def both(self) -> Samples:
        """All samples."""
        return self.a + self.b

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        halves = {f"{half}_{f.name}": getattr(getattr(self, half), f.name) for half in "ab" for f in fields(Samples)}
        return halves | {"passes": np.array(self.passes), "open": self.open}

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray]) -> Halves:
        """From a checkpoint."""
        a, b = (Samples(**{f.name: arrays[f"{half}_{f.name}"] for f in fields(Samples)}) for half in "ab")
        return cls(a, b, int(arrays["passes"]), arrays["open"])


def schedule(samples: int) -> tuple[list[int], int]:
    """Samples per pixel and half of each pass, and how many passes belong to pixels without an object.

    The total doubles, by at most `LONGEST` a pass, up to ``samples`` (both halves), then for objects up to
    `OBJECT_BOOST` times as many.
    """
    steps: list[int] = []
    for wanted in (max(1, (samples + 1) // 2), max(1, (samples * OBJECT_BOOST + 1) // 2)):
        plain = len(steps)
        while sum(steps) < wanted:
            steps.append(min(max(sum(steps), 1), LONGEST, wanted - sum(steps)))
    return steps, plain


def refine(
    strategy: Strategy,
    worlds: Worlds,
    rays: Rays,
    samples: int,
    depth: int,
    seed: int,
    noisy: Callable[[Halves, int], np.ndarray],
    start: Halves | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Iterator[Halves]:
    """Passes over the pixels of ``rays`` until none is open.

    Args:
        strategy: what traces a block.
        worlds: the scene.
        rays: the pixels.
        depth: of the paths, as `pipeline.transport.trace.trace` takes it.
        seed: of the first pass.
        samples: most samples per pixel; pixels that show an object may take `OBJECT_BOOST` times as many.
        noisy: (N,) bool, the pixels whose noise still matters, asked between passes with the number of samples still to
            come if none leaves, of one half.
        start: where an earlier run stopped. The result is the same to the byte as without stopping.
        progress: told the share of samples done; may raise `Interrupted`.
    """
    steps, plain = schedule(samples)
    halves = start or Halves.none(len(rays))
    spent = 0
    for number in range(halves.passes, len(steps)):
        index = np.flatnonzero(halves.open)
        if not len(index):
            return
        ahead = _ahead(halves.open, (halves.a.alpha + halves.b.alpha) > 0, steps, plain, number) or 1
        tells = [_part(progress, spent, len(index) * steps[number], ahead, half) for half in range(2)]
        a, b = (
            part.placed(
                index,
                trace(
                    strategy, worlds, rays[index], steps[number], depth, seed + 2 * number + half, progress=tells[half]
                ),
            )
            for half, part in enumerate((halves.a, halves.b))
        )
        spent += len(index) * steps[number]
        on_object = (a.alpha + b.alpha) > 0
        left = np.full(len(rays), number + 1 < plain) | (on_object & (number + 1 < len(steps)))
        halves = Halves(a, b, number + 1, halves.open & left)
        ahead = _ahead(halves.open, on_object, steps, plain, number + 1)
        if ahead:
            halves = replace(halves, open=halves.open & noisy(halves, ahead))
        yield halves


def _ahead(still: np.ndarray, on_object: np.ndarray, steps: list[int], plain: int, number: int) -> int:
    """Samples of one half from pass ``number`` on, if no pixel leaves early."""
    objects = int((still & on_object).sum())
    return sum(
        step * (int(still.sum()) if later < plain else objects) for later, step in enumerate(steps) if later >= number
    )


def _part(
    progress: Callable[[float], None], spent: int, pass_size: int, ahead: int, half: int
) -> Callable[[float], None]:
    """Progress of one half of a pass as a share of all that was and will be done."""
    return lambda share: progress((spent + pass_size * (half + share) / 2) / (spent + ahead))
