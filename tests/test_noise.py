"""Noise of a sensor: where it comes from, photon transfer and fixed pattern against simulated sensors."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from sensor_frames import ELECTRONS, FLOOR, MODEL, READ, STEP, WHITE, expose, frame, hills

from pipeline.image import bracket_noise, defects, fixed_pattern, linearity, noise
from pipeline.image import photon_transfer as transfer
from pipeline.image.noise import Noise
from pipeline.run.manifest import NoiseFacts

ELECTRONS_PER_DN = ELECTRONS * STEP


def bins_of(frames: list[np.ndarray], ratio: float, gain: float = 1.0) -> list[transfer.Bin]:
    """Bins of neighbouring frames, every fourth row standing for one cell."""
    found = []
    for short, long in pairwise(frames):
        for cell in range(4):
            found += transfer.transfer_bins(long[cell::4], short[cell::4], ratio, 0.97, STEP, cell, gain)
    return found


# photon transfer


def test_photon_transfer_covers_the_sensor():
    """60 sensors: 95 % regions of gain and floor hold 90 to 98 % (counting error of 60 trials: 2.8 %, so 84 to 100)."""
    inside, errors = [], []
    for seed in range(60):
        random = np.random.default_rng(seed)
        scene = hills(160, 240, seed)
        pattern = 1 + 0.01 * random.standard_normal(scene.shape)  # cancels: it is the same in both frames
        found = transfer.from_transfer(
            bins_of([expose(scene, g, random, pattern) for g in (0.05, 0.2, 0.8)], 0.25), STEP
        )
        assert found is not None
        gain, floor = found.shot.mean() * ELECTRONS - 1, found.floor.mean() / FLOOR - 1
        inside.append([abs(gain) < 1.96 * found.shot_sigma, abs(floor) < 1.96 * found.floor_sigma])
        errors.append([gain, floor])
    share = np.mean(inside, 0)
    assert np.all((share >= 0.84) & (share <= 1))  # measured over 150 seeds: 0.927 and 0.933
    assert abs(np.mean(errors, 0)[0]) < 0.003  # of 0.55 % each; 60 of them know it to 0.07 %
    assert abs(np.mean(errors, 0)[1]) < 0.02  # of 2.6 % each


def test_a_gain_per_colour_where_the_colours_disagree():
    random = np.random.default_rng(1)
    scene, wells = hills(400, 400), np.array([30000.0, 20000.0, 20000.0, 25000.0])
    frames = []
    for g in (0.05, 0.2, 0.8):
        cells = [expose(scene[c::4], g, random, full_well=well) for c, well in enumerate(wells)]
        frames.append(np.stack(cells, 1).reshape(-1, 400))
    found = transfer.from_transfer(bins_of(frames, 0.25), STEP)
    assert found is not None
    np.testing.assert_allclose(1 / found.shot.ravel(), wells, rtol=0.05)  # 1 % each
    alike = transfer.from_transfer(bins_of([expose(scene, g, random) for g in (0.05, 0.2, 0.8)], 0.25), STEP)
    assert alike is not None
    assert np.ptp(alike.shot) == 0


def test_mixed_iso_pairs_give_the_gain():
    """ISO 100 and 400 of one exposure time: four times the gain at the same electrons."""
    random = np.random.default_rng(2)
    scene = hills(300, 400)
    long, short = expose(scene, 1.0, random, full_well=ELECTRONS / 4), expose(scene, 0.25, random)
    found = transfer.from_transfer(transfer.transfer_bins(long, short, 0.25, 0.97, STEP, gain=0.25), STEP)
    assert found is not None
    assert 1 / found.shot.mean() == pytest.approx(ELECTRONS / 4, rel=0.05)  # in the long frame's ISO


def test_flicker_does_not_pass_for_shot_noise():
    """A tenth of the rows, 3 % brighter in one frame: as the square of the signal, which is fitted where it shows."""
    random = np.random.default_rng(3)
    scene = hills(400, 400)
    unsteady = scene * (1 + 0.03 * (random.random((400, 400)) < 0.1))
    frames = [expose(scene, 0.2, random), expose(unsteady, 0.8, random)]
    found = transfer.from_transfer(bins_of(frames, 0.25), STEP)
    assert found is not None
    assert 1 / found.shot.mean() == pytest.approx(ELECTRONS, rel=0.1)


def test_flat_dark_and_tiny_frames_are_declined():
    random = np.random.default_rng(4)
    dark = [expose(np.zeros((200, 200)), g, random) for g in (0.25, 1.0)]
    assert transfer.from_transfer(bins_of(dark, 0.25), STEP) is None
    assert transfer.transfer_bins(dark[0][:1, :2], dark[1][:1, :2], 0.25, 0.97, STEP) == []
    assert transfer.from_transfer([], STEP) is None
    one = expose(hills(), 0.25, random)
    assert transfer.from_transfer(bins_of([one, one], 1.0), STEP) is None  # the same frame twice


# where a model comes from


def test_profile_and_facts_agree_on_one_sensor():
    stated = noise.from_profile(frame(noise_profile=np.array([1 / ELECTRONS, FLOOR])))
    table = NoiseFacts(iso=100, electrons_per_dn=ELECTRONS_PER_DN, read_noise_electrons=READ, prnu=0.01).model_dump()
    given = noise.from_facts(frame(), [table])
    assert stated is not None
    assert given is not None
    np.testing.assert_allclose(given.shot, stated.shot)
    np.testing.assert_allclose(given.floor, FLOOR, rtol=1e-6)
    assert (given.source, given.prnu, given.shot_sigma, given.floor_sigma) == ("given", 0.01, 0.02, 0.1)
    assert given.numbers()["read_noise_electrons"] == pytest.approx(np.hypot(READ, ELECTRONS_PER_DN / np.sqrt(12)))
    assert noise.from_facts(frame(iso=200.0), [table]) is None
    assert noise.from_facts(frame(), [{**table, "camera": "Two"}]) is None


def test_six_numbers_of_a_profile_go_to_their_colours():
    profile = np.array([1e-5, 1e-8, 2e-5, 2e-8, 3e-5, 3e-8])
    mosaic = noise.from_profile(frame(noise_profile=profile))
    assert mosaic is not None
    np.testing.assert_array_equal(mosaic.shot, [[1e-5, 2e-5], [2e-5, 3e-5]])
    three = noise.from_profile(frame(noise_profile=profile, cfa="", black=np.zeros((1, 3))))
    assert three is not None
    np.testing.assert_array_equal(three.shot, [[1e-5, 2e-5, 3e-5]])


def sensor_at(iso: float) -> Noise:
    """Read noise of 2 electrons before and 4 DN behind the amplifier; 30 000 electrons at ISO 100."""
    shot = iso / 100 / ELECTRONS
    return Noise(np.full((2, 2), shot), np.full((2, 2), (2 * shot) ** 2 + (4 * STEP) ** 2), "NoiseProfile", 0.01, 0.02)


def test_a_missing_iso_is_scaled():
    known = {100.0: sensor_at(100), 1600.0: sensor_at(1600)}
    found = noise.scaled(400, known)
    np.testing.assert_allclose(found.shot, sensor_at(400).shot)
    np.testing.assert_allclose(found.floor, sensor_at(400).floor, rtol=1e-6)  # two settings tell the parts apart
    assert found.source == "scaled from ISO 100 and 1600"
    up, down = noise.scaled(800, {400.0: sensor_at(400)}), noise.scaled(100, {400.0: sensor_at(400)})
    assert up.floor.mean() > sensor_at(800).floor.mean()  # one setting: upward its upper bound
    for one, iso in ((up, 800), (down, 100)):
        assert abs(np.log(one.floor.mean() / sensor_at(iso).floor.mean())) < 2 * one.floor_sigma


def test_disagreement_is_counted_in_sigmas():
    measured = Noise(MODEL.shot * 1.5, MODEL.floor, "photon transfer", 0.01, 0.03)
    off = noise.disagreement(Noise(MODEL.shot, MODEL.floor, "NoiseProfile", *noise.PROFILE_SIGMA), measured)
    assert off["shot_rel"] == pytest.approx(-1 / 3)
    assert off["shot_sigmas"] > 3
    assert off["floor_sigmas"] == 0


# a capture's frames


def capture_sensor(isos: list[float], profile: bool, well: float = ELECTRONS, **options: object):
    """`bracket_noise.sensor_of` of one bracket, two stops apart, its frames at these ISOs."""
    scene, random, samples = hills(400, 400), np.random.default_rng(5), []
    for number, iso in enumerate(isos):
        exposure = 0.05 * 4.0**number
        stated = {"noise_profile": np.array([iso / 100 / ELECTRONS, FLOOR * (iso / 100) ** 2])} if profile else {}
        one = frame(exposure_s=exposure / (iso / 100), iso=iso, fnumber=1.0, **stated)
        dn = expose(scene, exposure, random, full_well=well * 100 / iso) / STEP + one.black.mean()
        samples.append(bracket_noise.sample_of(np.rint(dn).astype(np.uint16), one))
    return bracket_noise.sensor_of(["plate"] * len(isos), samples, **options)


def test_what_is_stated_is_compared_with_what_is_measured():
    agreeing = capture_sensor([100, 100, 100], profile=True)
    assert not agreeing.warnings
    assert agreeing.models[0].source == "NoiseProfile"
    assert agreeing.numbers["iso_100"]["measured"]["electrons_at_white"] == pytest.approx(ELECTRONS, rel=0.03)
    lying = capture_sensor([100, 100, 100], profile=True, well=ELECTRONS / 2)
    assert any("says 30000 electrons" in text and "merge.noise" in text for text in lying.warnings)
    measured = capture_sensor([100, 100, 100], profile=True, well=ELECTRONS / 2, prefer="measured")
    assert 1 / measured.models[0].shot.mean() == pytest.approx(ELECTRONS / 2, rel=0.05)


def test_mixed_iso_in_one_bracket():
    """No profile: the pair of ISO 100 is measured, ISO 200 scaled from it; with no equal pair, from the mixed pairs."""
    found = capture_sensor([100, 100, 200], profile=False)
    assert [model.source for model in found.models] == ["photon transfer"] * 2 + ["scaled from ISO 100"]
    assert 1 / found.models[2].shot.mean() == pytest.approx(ELECTRONS / 2, rel=0.05)
    mixed = capture_sensor([100, 200, 400], profile=False)
    for model, iso in zip(mixed.models, (100, 200, 400)):
        assert model.source == "photon transfer between ISO 100 and 200 and 400"
        assert 1 / model.shot.mean() == pytest.approx(ELECTRONS * 100 / iso, rel=0.1)
    assert sum("proportional to ISO" in text for text in mixed.warnings) == 3


def test_three_channels_have_three_numbers():
    random = np.random.default_rng(6)
    samples = []
    for exposure in (0.2, 0.8):
        data = np.stack([expose(hills(200, 300, c), exposure, random) for c in range(3)], -1) / STEP
        one = frame(exposure_s=exposure, fnumber=1.0, cfa="", black=np.zeros((1, 3)), white=WHITE - 512)
        samples.append(bracket_noise.sample_of(np.maximum(data, 0).astype(np.float32), one))
    found = bracket_noise.sensor_of(["plate", "plate"], samples)
    assert found.models[0].shot.shape == found.limits[0].shape == (1, 3)
    assert 1 / found.models[0].shot.mean() == pytest.approx(ELECTRONS, rel=0.05)


# fixed pattern


def merged_flat(prnu: float, seed: int, grain: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A smooth merged mosaic with its pattern, 0.3 % of temporal noise, and grain as a lens shows it."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(seed)
    y, x = np.mgrid[:600, :800]
    scene = 0.5 * (1 + 0.8 * np.sin(x / 70) * np.cos(y / 90))
    texture = gaussian_filter(random.standard_normal(scene.shape), 0.8)
    scene = scene * (1 + grain * texture / texture.std())
    variance = 1e-5 * scene
    radiance = scene * (1 + prnu * random.standard_normal(scene.shape))
    radiance = radiance + np.sqrt(variance) * random.standard_normal(scene.shape)
    return radiance.astype(np.float32), variance.astype(np.float32), np.zeros(scene.shape, np.uint32)


@pytest.mark.parametrize("prnu", [0.002, 0.005, 0.01])
def test_fixed_pattern_of_flat_parts(prnu):
    for seed in range(3):
        found = fixed_pattern.measure(*merged_flat(prnu, seed))
        assert found is not None
        assert found.believed
        assert abs(found.prnu / prnu - 1) < 4 * found.sigma
        assert found.sigma < 0.03


def test_no_pattern_and_texture_are_only_bounded():
    clean, grainy = fixed_pattern.measure(*merged_flat(0, 1)), fixed_pattern.measure(*merged_flat(0.005, 1, grain=0.01))
    assert clean is not None
    assert grainy is not None
    assert not clean.believed
    assert clean.prnu < 0.001
    assert not grainy.believed
    assert "texture" in grainy.because
    assert grainy.prnu > 0.005
    assert fixed_pattern.measure(np.ones((8, 8), np.float32), *[np.ones((8, 8), np.float32)] * 2) is None


def test_the_pattern_does_not_average_down():
    """100 frames of one sensor: what the merged mean misses by is the pattern, and the variance says so."""
    random = np.random.default_rng(7)
    prnu, frames = 0.01, 100
    gain = 1 + prnu * random.standard_normal((200, 200))
    mean = np.mean([expose(np.full((200, 200), 0.5), 1.0, random, gain) for _ in range(frames)], 0).astype(np.float32)
    variance = np.full(mean.shape, MODEL.variance(0.5).mean() / frames, np.float32)
    noise.add_fixed_pattern(variance, mean, prnu)
    pull = (mean - 0.5) / np.sqrt(variance)
    assert np.std(pull) == pytest.approx(1, abs=0.02)  # 40 000 pulls: 0.35 %
    doubled = np.full(mean.shape, MODEL.variance(0.5).mean() / frames / 4, np.float32)
    noise.add_fixed_pattern(doubled, mean / 2, prnu)
    np.testing.assert_array_equal(doubled * 4, variance)


# linear range


@pytest.mark.parametrize("ratio", [0.25, 0.0625])
@pytest.mark.parametrize("grain", [0.0, 0.05])
def test_knee_below_the_clip_level(ratio, grain):
    """A soft knee is found where it bends by half a percent, within 0.1 above its foot; a straight sensor has none."""
    random = np.random.default_rng(8)
    y, x = np.mgrid[:600, :800]
    scene = (
        0.5 * np.exp(1.2 * np.sin(x / 97) * np.cos(y / 60)) * (1 + grain * random.standard_normal(x.shape)).clip(0.1)
    )
    for knee in (None, 0.8):
        frames = [expose(scene, g, random) for g in (1.0, ratio)]
        if knee is not None:
            rest = 1 - knee
            frames = [np.where(f > knee, knee + rest * np.tanh((f - knee) / rest), f) for f in frames]
        found = linearity.compare(frames[0], frames[1], ratio, 0.98, MODEL)
        if knee is None:
            assert found.knee is None
        else:
            assert found.knee is not None
            assert knee < found.knee < knee + 0.1
    assert linearity.knee_of([found, linearity.Linearity(None, 0.4)]) == found.knee
    assert linearity.knee_of([found, *[linearity.Linearity(None, 0.96)] * 2]) is None


# listed defects


def test_listed_defects_are_replaced_and_flagged():
    random = np.random.default_rng(9)
    for shape in ((20, 20), (20, 20, 3)):
        radiance = (1 + 0.01 * random.standard_normal(shape)).astype(np.float32)
        variance, mask = np.full(shape, 1e-4, np.float32), np.zeros(shape, np.uint32)
        sites = np.array([[4, 4], [4, 6], [0, 0], [30, 1], [4, 4]])
        radiance[4, 4], radiance[4, 6], radiance[0, 0] = 50, -3, np.nan
        assert defects.replace_listed(radiance, variance, mask, sites) == 3
        assert np.all(np.abs(radiance - 1) < 0.06)
        assert np.all((variance > 0) & (variance < 0.01))
        assert np.count_nonzero(mask) == 3 * (1 if len(shape) == 2 else 3)
    assert defects.replace_listed(radiance, variance, mask, np.zeros((0, 2), int)) == 0


def test_floating_point_is_not_rounded_to_its_white():
    """White 1.0 is no single step: the floor of a usual sensor is its read noise, and not a twelfth."""
    counted = noise.assumed(frame())
    floating = noise.assumed(frame().model_copy(update={"white": 1.0, "black": np.zeros((2, 2))}))
    rounding = (1 / noise.full_scale(frame()) ** 2 - 1 / 65535**2) / 12
    np.testing.assert_allclose(floating.floor, counted.floor - rounding, rtol=1e-9)
