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
def test_frame_order_changes_no_byte(weights, saw):
    frames = bracket(np.geomspace(1e-4, 300, 96 * 90).reshape(96, 90))
    reference = merge(frames, weights)
    for order in ([4, 2, 0, 1, 3], [4, 3, 2, 1, 0]):
        other = merge([frames[i] for i in order], weights, workers=3)
        for name in ("radiance", "variance", "mask"):
            one, two = (np.frombuffer(getattr(part, name).tobytes(), np.uint8) for part in (reference, other))
            saw("frames.unordered", "exact", np.count_nonzero(one != two))


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
    # 40 000 samples know an RMSE to 0.35 %; make bench-merge has 2 million in each and finds at most 1.004
    assert np.median(ratios) < 1.003
    assert max(ratios) < 1.004 + 4 * 0.0035


def test_variance_is_honest():
    radiance = np.geomspace(2e-4, 200, 300 * 300).reshape(300, 300)
    for weights in ("poisson", "optimal"):
        merged = merge(bracket(radiance, seed=7), weights)
        pull = (merged.radiance - radiance) / np.sqrt(merged.variance)
        # 90 000 pulls: 0.25 % on the standard deviation; selection near clips and Poisson tails allow 2 %
        assert np.std(pull[np.isfinite(pull)]) == pytest.approx(1, abs=0.02)
        assert np.mean(merged.mask & GHOST > 0) < 1e-3


def test_constant_exposure_error_between_mixed_iso(saw):
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
        saw("exif.mixed_iso", "exact", abs(merged.radiance.mean() / 0.02 - 1))


# extremes


def test_single_frame_is_the_scaled_frame(saw):
    frame = photograph(np.geomspace(1e-3, 0.9, 32 * 32).reshape(32, 32), 0.5, 3)
    merged = merge([frame])
    saw("frames.single", "exact", np.abs(merged.radiance / (frame.signal() / 0.5) - 1).max())
    assert np.all(merged.variance > 0)


def test_duplicate_frames_keep_the_value(saw):
    frame = photograph(np.geomspace(1e-3, 0.9, 32 * 32).reshape(32, 32), 0.5, 3)
    error = np.abs(merge([frame, frame]).radiance / merge([frame]).radiance - 1).max()
    saw("frames.duplicate", "exact", error)


def test_all_clipped_is_a_flagged_lower_bound(saw):
    merged = merge(bracket(np.full((16, 16), 1e4)))
    assert np.all(merged.mask == CLIPPED)
    assert np.all(np.isinf(merged.variance))
    assert np.all(merged.radiance < 1e4)
    error = np.abs(merged.radiance * STOPS[0] - 1).max()
    saw("frames.all_clipped", "degraded", error, said="mask CLIPPED, variance infinite")


def test_all_dark_is_flagged_and_keeps_negatives(saw):
    merged = merge(bracket(np.zeros((300, 300))))
    assert np.mean(merged.mask & DARK > 0) > 0.8  # 84 % of a normal deviate lie below +1 sigma
    assert np.mean(merged.radiance < 0) == pytest.approx(0.5, abs=0.02)
    error = abs(merged.radiance.mean()) / (merged.radiance.std() / 300)
    saw("frames.all_dark", "degraded", error, said="mask DARK")


def test_black_level_above_the_signal_gives_negatives_not_nonsense(saw):
    frame = photograph(np.full((8, 8), 1e-3), 1.0, 0)
    merged = merge([Exposed(frame.mosaic, 1.0, frame.black + 400, WHITE, frame.limit, MODEL)])
    assert np.all(np.isfinite(merged.radiance))
    assert np.all(merged.radiance < 0)
    assert np.all(merged.mask == DARK)
    expected = (frame.mosaic.astype(float) - BLACK - 400) / (WHITE - BLACK - 400)
    saw("black.above_signal", "degraded", np.abs(merged.radiance / expected - 1).max(), said="mask DARK")


def test_nan_in_a_float_frame_is_left_out(saw):
    frames = bracket(np.full((16, 16), 0.1))
    broken = frames[4].mosaic.astype(np.float32)
    broken[5, 6], broken[8, 8] = np.nan, np.inf
    frames[4] = Exposed(broken, 1.0, frames[4].black, WHITE, frames[4].limit, MODEL)
    for weights in ("poisson", "optimal"):
        merged = merge(frames, weights)
        assert np.all(np.isfinite(merged.radiance))
        for case, at in (("frames.nan", (5, 6)), ("frames.inf", (8, 8))):
            assert merged.variance[at] > 1.5 * np.median(merged.variance)
            error = abs(merged.radiance[at] - 0.1) / np.sqrt(merged.variance[at])
            saw(case, "degraded", error, said="variance of the frames that are left")
    for number, frame in enumerate(frames):
        whole = frame.mosaic.astype(np.float32)
        whole[5, 6] = np.nan
        frames[number] = Exposed(whole, frame.exposure, frame.black, WHITE, frame.limit, MODEL)
    for weights in ("poisson", "optimal"):
        merged = merge(frames, weights)
        assert np.isfinite(np.delete(merged.radiance.ravel(), 5 * 16 + 6)).all()
        unmarked = merged.mask[5, 6] == 0 or np.isfinite(merged.variance[5, 6])
        saw("frames.nan_everywhere", "degraded", float(unmarked), said="mask, variance infinite")


def test_24_stops(saw):
    radiance = np.geomspace(1e-3, 1e-3 * 2**24, 64 * 64).reshape(64, 64)
    merged = merge(bracket(radiance, stops=[2.0**-k for k in (15, 12, 9, 6, 3, 0)]))
    seen = merged.mask & (CLIPPED | DARK) == 0
    assert np.mean(seen) > 0.98
    pull = np.abs(merged.radiance - radiance) / np.sqrt(merged.variance)
    assert np.median(pull[seen]) == pytest.approx(0.6745, abs=0.05)
    stop = np.minimum(np.log2(radiance / 1e-3).astype(int), 23)
    signed = (merged.radiance - radiance) / np.sqrt(merged.variance)
    biases = [signed[seen & (stop == k)].mean() * np.sqrt((seen & (stop == k)).sum()) for k in range(24)]
    saw("range.24_stops", "exact", np.abs(biases).max())


def test_one_pixel(saw):
    merged = merge(bracket(np.full((1, 1), 0.1)))
    saw("picture.1x1", "exact", abs(merged.radiance[0, 0] - 0.1) / np.sqrt(merged.variance[0, 0]))


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


def test_half_of_the_hot_photosites_at_the_stated_limit_are_found():
    """By its definition, in noise and in texture. 400 places know a share of a half to 2.5 %: 10 % is four sigma."""
    random = np.random.default_rng(5)
    y, x = np.mgrid[:420, :420]
    for grain in (0.0, 0.1):
        texture = np.exp(grain * random.standard_normal((210, 210))).repeat(2, 0).repeat(2, 1)
        merged = merge(bracket(0.05 * texture * (1 + 0.2 * np.sin(x / 9) * np.cos(y / 7)), seed=3))
        limit = radiometry.defect_limit(merged)
        rows, columns = (part.ravel() for part in np.mgrid[10:410:20, 10:410:20])
        rows, columns = rows + random.integers(0, 4, rows.size), columns + random.integers(0, 4, rows.size)
        middle = radiometry._excess(merged.radiance, rows, columns)[1]
        found = []
        for share in (0.3 * limit, limit, 3 * limit):
            hot = radiometry.Merged(merged.radiance.copy(), merged.variance, merged.mask.copy())
            hot.radiance[rows, columns] += share * middle
            found.append(np.mean(radiometry.replace_defects(hot)[0].mask[rows, columns] & HOT > 0))
        assert found[1] == pytest.approx(0.5, abs=0.1)
        assert found[0] < 0.1 < 0.9 < found[2]


def test_clip_level_below_white_is_found_only_when_frames_share_it():
    radiance = np.geomspace(0.01, 40, 200 * 200).reshape(200, 200)
    frames = [np.minimum(frame.mosaic, 14000) for frame in bracket(radiance)]
    levels = radiometry.clip_levels(frames, WHITE, np.full((2, 2), BLACK))
    np.testing.assert_array_equal(levels, 14000)
    alone = radiometry.clip_levels(frames[-1:], WHITE, np.full((2, 2), BLACK))
    np.testing.assert_array_equal(alone, WHITE)


def test_three_channels_are_merged_each_as_a_mosaic_of_its_own():
    """(H, W, 3) data and the three (H, W) pictures agree to what neighbours of another pitch change in the weights."""
    radiance = np.geomspace(1e-3, 250, 40 * 700).reshape(40, 700)
    black, limit = np.array([[512.0, 530, 490]]), np.array([[0.998, 0.99, 0.985]])
    model = Noise(np.array([[1.0, 1.3, 0.8]]) / ELECTRONS, np.array([[1.0, 2, 3]]) * 1e-8, "given")
    random, frames = np.random.default_rng(4), []
    for g in STOPS:
        signal = random.poisson(np.clip(radiance[..., None] * g, 0, 4) / model.shot) * model.shot
        signal = signal + np.sqrt(model.floor) * random.standard_normal(signal.shape)
        mosaic = np.clip(np.rint(signal * (WHITE - black) + black), 0, WHITE).astype(np.uint16)
        frames.append(Exposed(mosaic, g, black, WHITE, limit, model))
    merged = merge(frames)
    for c in range(3):
        cell = [np.full((2, 2), part[0, c]) for part in (black, limit, model.shot, model.floor)]
        alone = merge(
            [
                Exposed(f.mosaic[..., c], f.exposure, cell[0], WHITE, cell[1], Noise(cell[2], cell[3], "given"))
                for f in frames
            ]
        )
        pull = (merged.radiance[..., c] - radiance) / np.sqrt(merged.variance[..., c])
        assert np.std(pull) == pytest.approx(1, abs=0.02)  # 28 000 pulls: 0.4 %
        apart = np.abs(merged.radiance[..., c] - alone.radiance) / np.sqrt(alone.variance)
        assert np.median(apart) < 0.02
        assert np.mean((merged.mask[..., c] ^ alone.mask) > 0) < 0.01


def test_machine_code_is_the_source():
    """The compiled kernel and the same lines run by Python give the same bytes."""
    from pipeline.image import merge_kernel

    frames = bracket(np.geomspace(2e-4, 300, 3 * 1301).reshape(3, 1301))  # chunks within the row, and beyond its end
    compiled = merge(frames)
    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"):
        patch.setattr(merge_kernel, "rows_kernel", lambda: merge_kernel.merge_rows)
        plain = merge(frames)
    for name in ("radiance", "variance", "mask"):
        assert getattr(compiled, name).tobytes() == getattr(plain, name).tobytes()


def test_against_plain_arithmetic_of_double_precision():
    """Unclipped frames far above read noise: counts over times, to float32."""
    frames = bracket(np.geomspace(0.1, 0.9, 20 * 640).reshape(20, 640))
    counts = sum((f.mosaic.astype(float) - BLACK) * STEP for f in frames)
    np.testing.assert_allclose(merge(frames).radiance, counts / sum(STOPS), rtol=1e-6)


def test_frames_are_asked_for_by_rows(tmp_path):
    frames, asked = bracket(np.geomspace(1e-3, 200, 100 * 50).reshape(100, 50)), []

    class Rows:
        def __init__(self, mosaic):
            self.mosaic, self.shape, self.dtype = mosaic, mosaic.shape, mosaic.dtype

        def __getitem__(self, rows):
            asked.append(rows.stop - rows.start)
            return self.mosaic[rows]

    lazy = [Exposed(Rows(f.mosaic), f.exposure, f.black, f.white, f.limit, f.noise) for f in frames]
    assert merge(lazy).radiance.tobytes() == merge(frames).radiance.tobytes()
    assert max(asked) <= radiometry.TILE_ROWS
    assert sum(asked) == 100 * len(frames)


def test_no_bias_about_a_clip_level_in_texture():
    """Each pixel within three sigma of a clip, its neighbours far from it: below 0.15 sigma of the clipping frame."""
    sigma = 1 / np.sqrt(ELECTRONS)
    random = np.random.default_rng(11)
    for offset in (-1.0, 0.0, 1.0):
        radiance = np.exp(random.uniform(-3, 3, (1000, 1000)))
        site = np.zeros(radiance.shape, bool)
        site[::3, ::3] = True
        radiance[site] = LIMIT[0, 0] * (1 + offset * sigma)  # of the longest frame
        merged = merge(bracket(radiance, seed=21 + int(offset)), workers=2)
        error = merged.radiance[site] / radiance[site] - 1
        assert abs(error.mean()) < (0.15 + 4 / np.sqrt(site.sum())) * sigma


def test_a_light_seen_only_by_a_clipped_frame_is_a_ghost():
    frames = bracket(np.full((32, 64), 0.05))
    frames[4].mosaic[10:14, 20:24] = int(WHITE)
    merged = merge(frames)
    assert np.all(merged.mask[10:14, 20:24] & GHOST)
    np.testing.assert_allclose(merged.radiance[10:14, 20:24], 0.05, rtol=0.3)  # and the value is the others'
