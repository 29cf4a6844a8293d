"""Merging: laws, then bias and efficiency against the Cramer-Rao bound on simulated frames, then extremes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline.conventions import CLIPPED, DARK, GHOST, HOT
from pipeline.image import radiometry
from pipeline.image.noise import Noise
from pipeline.image.radiometry import Exposed, merge

WHITE, BLACK, ELECTRONS, READ = 15800.0, 512.0, 30000.0, 3.0
STEP = 1 / (WHITE - BLACK)
MODEL = Noise(np.full((2, 2), 1 / ELECTRONS), np.full((2, 2), (READ / ELECTRONS) ** 2 + STEP**2 / 12), "given")
LIMIT = radiometry.linear_limits(np.full((2, 2), WHITE), np.full((2, 2), BLACK), WHITE, MODEL)
STOPS = [4.0**-k for k in (4, 3, 2, 1, 0)]  # five frames, two stops apart, shortest first


def photograph(radiance: np.ndarray, exposure: float, seed: int) -> Exposed:
    """A frame of linear sensor: Poisson, read noise, rounding, clip. ``radiance * exposure`` = 1 is white."""
    random = np.random.default_rng(seed)
    electrons = random.poisson(np.clip(radiance * exposure * ELECTRONS, 0, 4 * ELECTRONS))
    electrons = electrons + READ * random.standard_normal(radiance.shape)
    mosaic = np.clip(np.rint(electrons / ELECTRONS / STEP + BLACK), 0, WHITE).astype(np.uint16)
    return Exposed(mosaic, exposure, np.full((2, 2), BLACK), WHITE, LIMIT, MODEL)


def bracket(radiance: np.ndarray, seed: int = 0, stops: list[float] = STOPS) -> list[Exposed]:
    return [photograph(radiance, g, 100 * seed + i) for i, g in enumerate(stops)]


@pytest.mark.parametrize("weights", ["poisson", "optimal"])
def test_frame_order_changes_no_byte(weights):
    frames = bracket(np.geomspace(1e-4, 300, 96 * 90).reshape(96, 90))
    reference = merge(frames, weights)
    for order in ([4, 2, 0, 1, 3], [4, 3, 2, 1, 0]):
        other = merge([frames[i] for i in order], weights, workers=3)
        for name in ("radiance", "variance", "mask"):
            assert getattr(reference, name).tobytes() == getattr(other, name).tobytes()


@pytest.mark.parametrize("weights", ["poisson", "optimal"])
def test_exposure_times_two_gives_radiance_over_two(weights):
    # A power of two commutes with rounding, so the law is exact.
    frames = bracket(np.geomspace(1e-4, 200, 64 * 64).reshape(64, 64))
    doubled = [Exposed(f.mosaic, 2 * f.exposure, f.black, f.white, f.limit, f.noise) for f in frames]
    one, two = merge(frames, weights), merge(doubled, weights)
    np.testing.assert_array_equal(one.radiance, 2 * two.radiance)
    np.testing.assert_array_equal(one.mask, two.mask)


def test_tiles_leave_no_seam(monkeypatch):
    frames = bracket(np.geomspace(1e-3, 250, 200 * 30).reshape(200, 30))
    small = merge(frames)
    monkeypatch.setattr(radiometry, "TILE_ROWS", 1000)
    whole = merge(frames)
    for name in ("radiance", "variance", "mask"):
        assert getattr(small, name).tobytes() == getattr(whole, name).tobytes()


@pytest.mark.parametrize("weights", ["poisson", "optimal"])
@pytest.mark.parametrize("electrons", [5, 20, 200, 2e3, 2.9e4, 2.99e4, 3.1e4, 1.15e5, 1.195e5, 4.5e5, 5e6])
def test_unbiased(weights, electrons):
    """|bias| < 0.2 % (4 sigma of the simulation) from 5 electrons in the longest frame to the clip of the shortest."""
    size = 400 if electrons > 50 else 1400 if electrons > 5 else 2300
    merged = merge(bracket(np.full((size, size), electrons / ELECTRONS), seed=int(electrons)), weights, workers=2)
    assert not np.any(merged.mask & CLIPPED)
    relative = merged.radiance.astype(float) / (electrons / ELECTRONS)
    assert relative.std() / size < 0.0005  # of one pixel 110 % at 5 electrons, so many are needed
    assert abs(relative.mean() - 1) < 0.002


def test_close_to_the_cramer_rao_bound():
    """RMSE over the bound of samples below the clip level, in bins of 1/3 decade."""
    edges = np.geomspace(5, 7.0e6, 19) / ELECTRONS
    ratios = []
    for seed, (low, high) in enumerate(itertools.pairwise(edges)):
        radiance = np.tile(np.geomspace(low, high, 200), (200, 1))
        merged = merge(bracket(radiance, seed=1000 + seed), "optimal", workers=2)
        information = np.zeros_like(radiance)
        for g in STOPS:
            variance = g * radiance / ELECTRONS + MODEL.floor[0, 0]
            information += np.where(g * radiance < 1, g * g / variance, 0)
        ratios.append(np.sqrt(np.mean((merged.radiance - radiance) ** 2 * information)))
    # 40 000 samples know an RMSE to 0.35 %; bins with a clip level lose the samples within two sigma of it
    assert np.median(ratios) < 1.01
    assert max(ratios) < 1.05


def test_variance_is_honest():
    radiance = np.geomspace(2e-4, 200, 300 * 300).reshape(300, 300)
    for weights in ("poisson", "optimal"):
        merged = merge(bracket(radiance, seed=7), weights)
        pull = (merged.radiance - radiance) / np.sqrt(merged.variance)
        # 90 000 pulls: 0.25 % on the standard deviation; selection near clips and Poisson tails allow 2 %
        assert np.std(pull[np.isfinite(pull)]) == pytest.approx(1, abs=0.02)
        assert np.mean(merged.mask & GHOST > 0) < 1e-3


def test_constant_exposure_error_between_mixed_iso():
    # The same light at ISO 100 and 400: signal four times, half the electrons at white per stop of gain.
    light = np.full((200, 200), 0.02)
    frames = [photograph(light, 1.0, 1)]
    gained = Noise(MODEL.shot * 4, MODEL.floor * 16, "given")
    random = np.random.default_rng(2)
    electrons = random.poisson(light * ELECTRONS) + READ * random.standard_normal(light.shape)
    mosaic = np.clip(np.rint(4 * electrons / ELECTRONS / STEP + BLACK), 0, WHITE).astype(np.uint16)
    frames.append(Exposed(mosaic, 4.0, np.full((2, 2), BLACK), WHITE, LIMIT, gained))
    for weights in ("poisson", "optimal"):
        merged = merge(frames, weights)
        # equal electrons in both frames: equal weights, so the variance halves
        single = merge(frames[:1], weights)
        assert merged.radiance.mean() == pytest.approx(0.02, rel=4 * 0.03 / 200)
        assert np.median(merged.variance) == pytest.approx(np.median(single.variance) / 2, rel=0.03)


# extremes


def test_single_frame_is_the_scaled_frame():
    frame = photograph(np.geomspace(1e-3, 0.9, 32 * 32).reshape(32, 32), 0.5, 3)
    merged = merge([frame])
    np.testing.assert_allclose(merged.radiance, frame.signal() / 0.5, rtol=1e-6)
    assert np.all(merged.variance > 0)


def test_duplicate_frames_keep_the_value():
    frame = photograph(np.geomspace(1e-3, 0.9, 32 * 32).reshape(32, 32), 0.5, 3)
    np.testing.assert_allclose(merge([frame, frame]).radiance, merge([frame]).radiance, rtol=1e-5)


def test_all_clipped_is_a_flagged_lower_bound():
    merged = merge(bracket(np.full((16, 16), 1e4)))
    assert np.all(merged.mask == CLIPPED)
    assert np.all(np.isinf(merged.variance))
    assert np.all((merged.radiance > 0.99 / STOPS[0]) & (merged.radiance < 1e4))


def test_all_dark_is_flagged_and_keeps_negatives():
    merged = merge(bracket(np.zeros((300, 300))))
    assert np.mean(merged.mask & DARK > 0) > 0.8  # 84 % of a normal deviate lie below +1 sigma
    assert np.mean(merged.radiance < 0) == pytest.approx(0.5, abs=0.02)
    assert abs(merged.radiance.mean()) < 4 * merged.radiance.std() / 300


def test_black_level_above_the_signal_gives_negatives_not_nonsense():
    frame = photograph(np.full((8, 8), 1e-3), 1.0, 0)
    merged = merge([Exposed(frame.mosaic, 1.0, frame.black + 400, WHITE, frame.limit, MODEL)])
    assert np.all(np.isfinite(merged.radiance))
    assert np.all(merged.radiance < 0)
    assert np.all(merged.mask == DARK)


def test_nan_in_a_float_frame_is_left_out():
    frames = bracket(np.full((16, 16), 0.1))
    broken = frames[4].mosaic.astype(np.float32)
    broken[5, 6], broken[8, 8] = np.nan, np.inf
    frames[4] = Exposed(broken, 1.0, frames[4].black, WHITE, frames[4].limit, MODEL)
    for weights in ("poisson", "optimal"):
        merged = merge(frames, weights)
        assert np.all(np.isfinite(merged.radiance))
        assert merged.radiance[5, 6] == pytest.approx(0.1, rel=0.3)


def test_24_stops():
    radiance = np.geomspace(1e-3, 1e-3 * 2**24, 64 * 64).reshape(64, 64)
    merged = merge(bracket(radiance, stops=[2.0**-k for k in (15, 12, 9, 6, 3, 0)]))
    seen = merged.mask & (CLIPPED | DARK) == 0
    assert np.mean(seen) > 0.98
    pull = np.abs(merged.radiance - radiance) / np.sqrt(merged.variance)
    assert np.median(pull[seen]) == pytest.approx(0.6745, abs=0.05)


def test_one_pixel():
    merged = merge(bracket(np.full((1, 1), 0.1)))
    assert merged.radiance[0, 0] == pytest.approx(0.1, rel=0.1)


def test_ghost_is_flagged_with_larger_variance():
    radiance = np.full((64, 64), 0.05)
    frames = bracket(radiance)
    moved = radiance.copy()
    moved[20:30, 20:30] = 0.1
    frames[3] = photograph(moved, STOPS[3], 77)
    merged = merge(frames)
    ghost = merged.mask & GHOST > 0
    assert ghost[20:30, 20:30].mean() > 0.99
    assert ghost.sum() <= 101
    assert np.median(merged.variance[20:30, 20:30]) > 20 * np.median(merged.variance[:15])


def test_hot_and_dead_photosites_are_replaced_and_a_small_light_is_not():
    y, x = np.mgrid[:120, :100]
    radiance = 0.05 * (1 + 0.2 * np.sin(x / 9) * np.cos(y / 7))
    for cy, cx in ((30, 30), (61, 70)):  # lights of one pixel's width, through a lens of 0.6 px
        radiance += 3 * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * 0.6**2))
    frames = bracket(radiance)
    spots = [(50, 50), (90, 21), (0, 0), (119, 99)]
    for frame in frames:
        for spot in spots:
            frame.mosaic[spot] = min(frame.mosaic[spot] + round(0.3 * frame.exposure / STEP), WHITE)
        frame.mosaic[80, 81] = BLACK
    merged, count = radiometry.replace_defects(merge(frames))
    assert {tuple(p) for p in np.argwhere(merged.mask & HOT > 0)} == {*spots, (80, 81)}
    assert count == 5
    np.testing.assert_allclose(merged.radiance[50, 50], radiance[50, 50], rtol=0.05)
    assert merged.radiance[30, 30] > 1


def test_clip_level_below_white_is_found_only_when_frames_share_it():
    radiance = np.geomspace(0.01, 40, 200 * 200).reshape(200, 200)
    frames = [np.minimum(frame.mosaic, 14000) for frame in bracket(radiance)]
    levels = radiometry.clip_levels(frames, WHITE, np.full((2, 2), BLACK))
    np.testing.assert_array_equal(levels, 14000)
    alone = radiometry.clip_levels(frames[-1:], WHITE, np.full((2, 2), BLACK))
    np.testing.assert_array_equal(alone, WHITE)


def test_shift_between_frames():
    y, x = np.mgrid[:200, :240]

    def scene(dx: float) -> np.ndarray:
        return 0.2 + 0.1 * np.sin((x - dx) / 11) + 0.05 * np.sin((x - dx) / 7 + y / 5)

    still = radiometry.measure_shift(photograph(scene(0), 1.0, 1), photograph(scene(0), 0.25, 2))
    moved = radiometry.measure_shift(photograph(scene(0), 1.0, 1), photograph(scene(1.0), 0.25, 2))
    assert still is not None
    assert still < 0.05  # noise of 48 000 samples on gradients of 1 %/px
    assert moved == pytest.approx(1.0, abs=0.1)
    assert radiometry.measure_shift(photograph(np.zeros((64, 64)), 1, 1), photograph(np.zeros((64, 64)), 1, 2)) is None
