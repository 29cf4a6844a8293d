"""The fast strategy against the reference: z of tile means on a few random scenes, and that a bias would be found.

`benchmarks.zscore` does the same on twenty scenes with more samples.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import zscore
from benchmarks.deliberate import Told, figures
from benchmarks.page import square_sigma
from benchmarks.random_scenes import random_case
from benchmarks.zscore import LIMIT, Tally, judged, line, share_out, summary, tallied, tile_pixels, total, z_of

SCENES = (14, 5, 7)  # glossy with boxes, plane, walls; glass, rough glass, metal, mirror, emission; lamps told apart
CPU_S, LIGHT = 3.0, 8


@pytest.mark.parametrize("seed", [*SCENES, pytest.param(6, marks=pytest.mark.slow)])
def test_fast_strategy_has_no_bias_and_one_of_a_tenth_would_be_seen(seed):
    case = random_case(seed)
    found = tallied(case, seed, CPU_S, spp=64, light_count=LIGHT)
    for way in (found.fast, found.lit):
        if way is None:
            continue
        said = judged(way, found.reference, found.noobj)
        assert said["zscore_max"] < LIMIT, case.name
        # 36 squares of z, three channels alike: 12 independent ones scatter by 0.41 about 1; four times that.
        assert said["zscore_square_mean"] < 2.7, case.name
        assert abs(said["bias_rel"]) < 4 * said["bias_sigma_rel"]
        brighter = [replace(part, values=part.values * [1, 1, 1, 1.1, 1.1, 1.1]) for part in way]
        assert judged(brighter, found.reference, found.noobj)["zscore_max"] > LIMIT


def scattered(random: np.random.Generator, counts: np.ndarray, mean: np.ndarray, scale: float) -> Tally:
    tile = np.repeat(np.arange(len(counts)), counts)
    noise = random.gamma(2.0, size=(len(tile), 6)) - 2.0  # skewed, as light is
    return Tally(tile, mean[tile] + scale * noise, len(counts))


def test_z_of_equal_means_is_standard_normal_and_of_others_is_not():
    """6000 z of few, skewed replicates: no larger than normal ones, the mean square 1 within four times its 0.02."""
    random = np.random.default_rng(5)
    mean = random.normal(size=(1000, 6))
    few, many = random.integers(16, 40, 1000), random.integers(16, 200, 1000)
    fast, reference = scattered(random, few, mean, 0.1), scattered(random, many, mean, 0.3)
    z, sigma = z_of([fast], [reference])
    assert np.abs(z).max() < LIMIT
    assert (z**2).mean() == pytest.approx(1, abs=0.08)
    np.testing.assert_allclose(np.median(sigma), np.sqrt(2 * (0.01 / 27 + 0.09 / 107)), rtol=0.1)
    off = replace(fast, values=fast.values + 0.5)
    assert np.median(z_of([off], [reference])[0]) > LIMIT


def test_tally_knows_mean_and_standard_error():
    tally = Tally(np.array([0, 0, 0, 2, 2]), np.repeat([[1.0], [2], [3], [5], [5]], 6, 1), 3)
    mean, square = tally.of(tally.values)
    np.testing.assert_allclose(mean[:, 0], [2, 0, 5])
    np.testing.assert_allclose(square[:, 0], [1 / 3, 0, 0])


def test_parts_of_an_estimate_add_up():
    """Paths and thrown light: means and variances add; Welch's degrees of freedom lie between the least and the sum."""
    random = np.random.default_rng(8)
    mean = random.normal(size=(500, 6))
    paths = scattered(random, np.full(500, 20), 0.7 * mean, 0.1)
    light = scattered(random, np.full(500, 12), 0.3 * mean, 0.2)
    whole, variance, degrees = total([paths, light])
    np.testing.assert_allclose(variance, paths.of(paths.values)[1] + light.of(light.values)[1])
    assert degrees.min() >= 11 - 1e-9
    assert degrees.max() <= 19 + 11 + 1e-9
    assert (((whole - mean) ** 2).mean() / variance.mean()) == pytest.approx(1, abs=0.1)  # 3000 squares: 2.6 %
    other = scattered(random, np.full(500, 100), mean, 0.1)
    assert np.abs(z_of([paths, light], [other])[0]).max() < LIMIT
    assert np.abs(z_of([paths], [other])[0]).max() > LIMIT


def test_scenes_are_summed_up():
    """Shares by how many tiles there are; the smallest bias common to all gets smaller with every scene."""
    random, rows = np.random.default_rng(9), []
    for count in (4, 40):
        mean = -random.uniform(0.1, 1.0, (count, 6))
        fast, reference = (scattered(random, np.full(count, 400), mean, 0.05) for _ in range(2))
        rows.append(judged([fast], [reference], np.ones((count, 3))) | {"scene": "made up", "cpu_s": 1.0})
    found = summary(rows)
    assert found["tile_channels_changed"] == 3 * 44
    assert found["zscore_max"] == max(row["zscore_max"] for row in rows)
    reached = sum(row["oracle_reached_changed"] * row["changed"] for row in rows) / 132
    assert found["oracle_reached_changed"] == pytest.approx(reached)
    assert found["smallest_detectable_common_bias_rel"] < LIMIT * min(row["bias_sigma_rel"] for row in rows)
    assert "made up" in line(0, rows[0])


def test_kept_scenes_are_those_of_the_code_that_judges_them(monkeypatch):
    """Its own file decides on replicates and on z: scenes that it measured before an edit are measured again."""
    read, bytes_of = [], Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path.name) or bytes_of(path))
    zscore.code_digest.__wrapped__()
    assert {"zscore.py", "random_scenes.py", "trace.py"} <= set(read)


def test_the_scatter_of_scenes_is_the_error_of_their_mean():
    """4000 times 20 scenes of 2 to 40 tiles whose z share a scale: the mean's scatter, to 3 % by chance."""
    random = np.random.default_rng(2)
    counts = np.tile([2, 10, 20, 40], 5)
    means = (random.chisquare(4, (4000, 20)) / 4) * random.chisquare(counts, (4000, 20)) / counts
    said = [
        square_sigma([{"tested": n, "zscore_square_mean": m} for n, m in zip(counts, row, strict=True)])
        for row in means
    ]
    scatter = (means @ counts / counts.sum()).std()
    assert np.sqrt(np.mean(np.square(said))) == pytest.approx(scatter, rel=0.1)  # 5 % less: unequal weights


def test_same_constants_agree_and_other_constants_never_do():
    one = Tally(np.array([0, 0, 1, 1]), np.ones((4, 6)), 2)
    other = replace(one, values=np.where(one.tile[:, None] == 1, 1.5, 1.0) * one.values)
    z, _ = z_of([one], [other])
    assert np.all(z[0] == 0)
    assert np.all(np.isinf(z[1]))


def test_common_bias_is_measured():
    """A tenth more light in every tile of one; the estimate agrees with it within four of its own standard errors."""
    random = np.random.default_rng(6)
    mean = -random.uniform(0.1, 1.0, (40, 6))
    counts = np.full(40, 30)
    fast, reference = scattered(random, counts, 1.1 * mean, 0.1), scattered(random, counts, mean, 0.1)
    found = judged([fast], [reference], np.ones((40, 3)))
    assert found["bias_rel"] == pytest.approx(0.1, abs=4 * found["bias_sigma_rel"])
    assert found["bias_sigma_rel"] < 0.02


def test_effort_is_cut_off_at_one_height():
    needed = np.array([1.0, 20.0, 100.0, 1e9])
    np.testing.assert_array_equal(share_out(needed, 236), [16, 20, 100, 100])
    np.testing.assert_array_equal(share_out(needed, 0), [16, 16, 16, 16])
    np.testing.assert_array_equal(share_out(needed[:3], 10**6), [16, 20, 100])


def test_tiles_are_eight_by_eight():
    pixels = tile_pixels((17, 24))
    assert pixels.shape == (6, 64)
    rows, columns = np.divmod(pixels, 24)
    assert np.ptp(rows, 1).max() == np.ptp(columns, 1).max() == 7
    assert rows.max() == 15


def test_figures_of_a_deliberate_bias():
    """A tenth too little in every tile, with noise between the seeds that the figures tell apart."""
    random = np.random.default_rng(7)
    true = random.uniform(0.1, 1.0, 400)
    effect = -0.1 * true + 0.02 * true * random.normal(size=(6, 400))
    found = figures(
        [Told(effect[:, :150], true[:150], 2 * true[:150]), Told(effect[:, 150:], true[150:], 2 * true[150:])]
    )
    assert found["net"] == pytest.approx(-0.1, abs=4 * 0.02 / np.sqrt(6 * 400))
    assert found["noise"] == pytest.approx(0.02 / np.sqrt(6), rel=0.1)
    assert found["rms"] == pytest.approx(np.hypot(0.1, 0.02 / np.sqrt(6)), rel=0.02)
    assert found["p95_of_noobj"] == pytest.approx(found["p95"] / 2)
    assert found["tiles"] == 400
    assert figures([Told(effect[:, :0], true[:0], true[:0])]) == {"tiles": 0}
