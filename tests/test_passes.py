"""Passes: what they spend, that blocks merge exactly, that stopping and going on changes no byte."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from test_transport import GREY, all_rays, scene, sky, sphere

from pipeline.transport import trace as trace_module
from pipeline.transport.difference import difference_block
from pipeline.transport.passes import LONGEST, OBJECT_BOOST, Halves, Interrupted, refine, schedule
from pipeline.transport.trace import Rays, Samples, trace

PIXELS = 60
SAMPLES = 400  # enough for several passes
OBJECT = np.arange(PIXELS) % 5 == 0  # the pixels that show one


def pixels() -> Rays:
    """Rays that carry their own number."""
    number = np.repeat(np.arange(PIXELS, dtype=float)[:, None], 3, 1)
    return Rays(np.zeros(3), number, number, number)


def drawn(worlds: Any, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
    """A strategy without a scene: random numbers of the seed and the pixel."""
    random = np.random.default_rng(seed)
    values = random.uniform(size=(PIXELS, len(fields(Samples)), 3))[rays.centre[:, 0].astype(int)]
    flat = {"count", "alpha", "ground", "not_finite"}
    made = {f.name: values[:, i, 0] if f.name in flat else values[:, i] for i, f in enumerate(fields(Samples))}
    shown = OBJECT[rays.centre[:, 0].astype(int)]
    return Samples(**made | {"count": np.full(len(rays), float(samples)), "alpha": made["alpha"] * shown})


def light(samples: int, seed: int) -> np.ndarray:
    """Light tracing without a scene."""
    return np.random.default_rng(1000 + seed).uniform(size=(2, PIXELS, 3))


def every(halves: Halves, ahead: int) -> np.ndarray:
    """Nothing is ever quiet enough."""
    return halves.open


def thirds(halves: Halves, ahead: int) -> np.ndarray:
    """A third of the pixels is quiet after two passes."""
    return np.arange(PIXELS) % 3 > 0 if halves.passes >= 2 else halves.open


def passes(
    samples: int = SAMPLES, noisy: Callable[[Halves, int], np.ndarray] = every, start: Halves | None = None, **more: Any
) -> list[Halves]:
    found = refine(drawn, None, pixels(), samples, 4, 11, noisy, light, start, **more)  # type: ignore[arg-type]
    return list(found)


def same_bytes(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all(first[n].tobytes() == second[n].tobytes() for n in first)


def samples_of(part: Samples) -> dict[str, np.ndarray]:
    return {f.name: getattr(part, f.name) for f in fields(part)}


@pytest.mark.parametrize("samples", [1, 2, 3, 16, 48, 333])
def test_schedule_spends_what_was_asked_for(samples: int) -> None:
    """Both halves together: all samples (one more where they are odd), and the boost for objects; no pass too long."""
    steps, plain = schedule(samples)
    assert sum(steps[:plain]) == (samples + 1) // 2
    assert sum(steps) == (samples * OBJECT_BOOST + 1) // 2
    assert all(0 < step <= LONGEST for step in steps)


def test_pixels_get_their_samples() -> None:
    *_, last = passes(SAMPLES)
    assert np.array_equal(last.both.count, np.where(OBJECT, SAMPLES * OBJECT_BOOST, SAMPLES))
    assert np.array_equal(last.a.count, last.b.count)
    assert not last.open.any()


def test_blocks_of_pixels_traced_apart_join_to_the_same_bytes(monkeypatch) -> None:
    worlds = scene(sky(), np.array([0.5, 0.3, 0.2]), sphere(0.1, (0, 0.1, 0), GREY))
    size = 1200
    monkeypatch.setattr(trace_module, "RAYS_PER_BLOCK", 4 * size)
    whole = trace(difference_block, worlds, all_rays(), 4, 4, 7)
    blocks = [
        difference_block(worlds, all_rays()[s : s + size], 4, 4, 7 + 7919 * (s // size), 1.0) for s in (2400, 0, 1200)
    ]
    assert same_bytes(samples_of(Samples.joined([blocks[1], blocks[2], blocks[0]])), samples_of(whole))


def test_blocks_of_samples_add_up() -> None:
    """In any order the mean over all samples, to float64 rounding; in the same order to the byte."""
    parts = [drawn(None, pixels(), count, 4, seed, 1.0) for seed, count in ((1, 3), (2, 16), (3, 5))]
    forth, back = (parts[0] + parts[1]) + parts[2], parts[2] + (parts[1] + parts[0])
    assert same_bytes(samples_of(forth), samples_of((parts[0] + parts[1]) + parts[2]))
    assert np.array_equal(forth.count, np.full(PIXELS, 24.0))
    for name in samples_of(forth).keys() - {"count"}:
        mean = sum(getattr(part, name) * weight for part, weight in zip(parts, (3, 16, 5), strict=True)) / 24
        for total in (forth, back):
            np.testing.assert_allclose(getattr(total, name), mean, rtol=1e-14, atol=1e-15)
    assert same_bytes(samples_of(Samples.none(PIXELS) + parts[0]), samples_of(parts[0]))


def test_light_tracing_is_the_mean_over_its_samples() -> None:
    """Weighted by samples, over the passes of pixels without an object; in all pixels, open or not."""
    steps, plain = schedule(SAMPLES)
    *_, last = passes(SAMPLES, thirds)
    for half in range(2):
        parts = [steps[number] * light(0, 11 + 2 * number + half) for number in range(plain)]
        np.testing.assert_allclose(last.thrown[half], sum(parts) / sum(steps[:plain]), rtol=1e-13)
    np.testing.assert_allclose(last.both.gained.mean(), (last.a.gained + last.b.gained).mean() / 2, rtol=1e-12)


@pytest.mark.parametrize("stop", [1, 3, 6])
def test_going_on_gives_the_bytes_of_never_having_stopped(stop: int, tmp_path) -> None:
    whole = passes(SAMPLES, thirds)
    np.savez(tmp_path / "checkpoint.npz", **whole[stop - 1].arrays())
    with np.load(tmp_path / "checkpoint.npz") as saved:
        start = Halves.of_arrays(dict(saved))
    assert same_bytes(passes(SAMPLES, thirds, start)[-1].arrays(), whole[-1].arrays())
    assert passes(SAMPLES, thirds, whole[-1]) == []


def test_quiet_pixels_stay_as_they_are() -> None:
    found = passes(SAMPLES, thirds)
    closed = ~found[1].open
    assert closed.sum() == PIXELS // 3
    for part in (lambda halves: halves.first, lambda halves: halves.second):
        before, after = (samples_of(part(halves)[closed]) for halves in (found[1], found[-1]))
        assert same_bytes(before, after)


def test_interruption_leaves_whole_passes_only() -> None:
    """What was yielded is that of an undisturbed run, wherever it broke off; and it goes on to the same end."""
    undisturbed = passes(SAMPLES)
    told: list[float] = []
    passes(SAMPLES, progress=told.append)
    for limit in range(1, len(told), 3):
        calls: list[float] = []

        def until(share: float, calls: list[float] = calls, limit: int = limit) -> None:
            calls.append(share)
            if len(calls) == limit:
                raise Interrupted

        kept = []
        run = refine(drawn, None, pixels(), SAMPLES, 4, 11, every, light, None, until)  # type: ignore[arg-type]
        with pytest.raises(Interrupted):
            kept.extend(replace(halves) for halves in run)
        for found, expected in zip(kept, undisturbed, strict=False):
            assert same_bytes(found.arrays(), expected.arrays())
        start = kept[-1] if kept else None
        assert same_bytes((passes(SAMPLES, start=start) or kept)[-1].arrays(), undisturbed[-1].arrays())


@pytest.mark.parametrize("noisy", [every, thirds, lambda halves, ahead: halves.open & (halves.passes < 4)])
def test_progress_never_falls_and_ends_at_one(noisy: Callable[[Halves, int], np.ndarray]) -> None:
    """Though objects are found on the way, and pixels leave."""
    told: list[float] = []
    passes(SAMPLES, noisy, progress=told.append)
    assert np.all(np.diff(told) >= 0)
    assert told[0] > 0
    assert told[-1] == 1
