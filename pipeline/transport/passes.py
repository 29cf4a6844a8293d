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

FIRST = 2  # samples per pixel and half of the first pass; with one, the renderer would compile anew for every seed
LONGEST = 64  # samples per pixel, half and pass: how much an interruption may lose
OBJECT_BOOST = 4  # a pixel that shows an object may take that many times the samples


class Interrupted(Exception):
    """Raised by a progress callback to end within a pass."""


@dataclass(frozen=True, eq=False)
class Halves:
    """What has been sampled of a set of pixels: two independent halves, the passes made, and what is still open.

    ``thrown`` is what light tracing adds to the gained light of each half (`pipeline.transport.caustics`): in the
    passes that pixels without an object take, for all pixels, open or not.
    """

    first: Samples
    second: Samples
    thrown: np.ndarray  # (2, 2, N, 3): half, then local scene or object
    passes: int
    open: np.ndarray  # (N,) bool, pixels that want more samples

    @classmethod
    def none(cls, pixels: int) -> Halves:
        """Before the first pass."""
        return cls(Samples.none(pixels), Samples.none(pixels), np.zeros((2, 2, pixels, 3)), 0, np.ones(pixels, bool))

    @property
    def a(self) -> Samples:
        """One half."""
        return self.first.lit(self.thrown[0], 2 * self.thrown_variance)

    @property
    def b(self) -> Samples:
        """The other."""
        return self.second.lit(self.thrown[1], 2 * self.thrown_variance)

    @property
    def both(self) -> Samples:
        """All samples."""
        return (self.first + self.second).lit(self.thrown.mean(0), self.thrown_variance)

    @property
    def thrown_variance(self) -> np.ndarray:
        """(2, N, 3) of the mean of both halves' thrown light, as their difference shows it: one degree of freedom."""
        return np.asarray((self.thrown[0] - self.thrown[1]) ** 2 / 4)

    def arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        parts = {"first": self.first, "second": self.second}
        samples = {f"{half}_{f.name}": getattr(part, f.name) for half, part in parts.items() for f in fields(Samples)}
        return samples | {"thrown": self.thrown, "passes": np.array(self.passes), "open": self.open}

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray]) -> Halves:
        """From a checkpoint."""
        first, second = (
            Samples(**{f.name: arrays[f"{half}_{f.name}"] for f in fields(Samples)}) for half in ("first", "second")
        )
        return cls(first, second, arrays["thrown"], int(arrays["passes"]), arrays["open"])


def schedule(samples: int) -> tuple[list[int], int]:
    """Samples per pixel and half of each pass, and how many passes belong to pixels without an object.

    First a few for a picture to look at, then as many at once as `LONGEST` allows: samples of one pass share their
    strata, those of two do not. In all ``samples`` (both halves), and `OBJECT_BOOST` times as many for objects.
    """
    steps: list[int] = []
    plain = 0
    for wanted in (max(1, (samples + 1) // 2), max(1, (samples * OBJECT_BOOST + 1) // 2)):
        plain = len(steps)
        if not steps:
            steps.append(min(FIRST, wanted))
        rest = wanted - sum(steps)
        passes = -(-rest // LONGEST)
        steps += [rest // passes + (number < rest % passes) for number in range(passes)]
        plain = plain or len(steps)
    return steps, plain


def refine(
    strategy: Strategy,
    worlds: Worlds,
    rays: Rays,
    samples: int,
    depth: int,
    seed: int,
    noisy: Callable[[Halves, int], np.ndarray],
    thrown: Callable[[int, int], np.ndarray] | None = None,
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
        thrown: light tracing for as many samples of a pixel, with a seed: (2, N, 3) to add to the gained light
            and to the object layer.
        start: where an earlier run stopped. The result is the same to the byte as without stopping.
        progress: told the share of samples done, which never falls and ends at 1; may raise `Interrupted`.
    """
    steps, plain = schedule(samples)
    halves = start or Halves.none(len(rays))
    spent, told = 0, 0.0

    def forward(share: float) -> None:
        nonlocal told
        told = max(told, share)  # the first pass finds objects, and with them more to do
        progress(told)

    for number in range(halves.passes, len(steps)):
        index = np.flatnonzero(halves.open)
        if not len(index):
            break
        step, on_object = steps[number], (halves.first.alpha + halves.second.alpha) > 0
        ahead = _ahead(halves.open, on_object, steps, plain, number) or 1
        parts, light = [], halves.thrown.copy()
        for half, part in enumerate((halves.first, halves.second)):
            tell = _part(forward, spent, len(index) * step, ahead, half)
            more = trace(strategy, worlds, rays[index], step, depth, seed + 2 * number + half, progress=tell)
            parts.append(part.placed(index, more) if number else more)
            if thrown is not None and number < plain:
                share = step / sum(steps[: number + 1])
                light[half] += share * (thrown(step, seed + 2 * number + half) - light[half])
        spent += len(index) * step
        on_object = (parts[0].alpha + parts[1].alpha) > 0
        left = np.full(len(rays), number + 1 < plain) | (on_object & (number + 1 < len(steps)))
        halves = Halves(parts[0], parts[1], light, number + 1, halves.open & left)
        ahead = _ahead(halves.open, on_object, steps, plain, number + 1)
        if ahead:
            halves = replace(halves, open=halves.open & noisy(halves, ahead))
        yield halves
    progress(1.0)


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
