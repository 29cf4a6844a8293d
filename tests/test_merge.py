"""The merge stage on simulated photographs: data without a mosaic, memory, fixed pattern, filters, black, defects."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_frames import BLACK, ELECTRONS, READ, STEP, WHITE, frame, photograph

from pipeline.conventions import CLIPPED, HOT
from pipeline.image.optical_black import OpticalBlack
from pipeline.run.noise_facts import NoiseFacts
from pipeline.types import Bracket, Frame
from stages import knobs, merge

SHAPE = (120, 160)
TIMES = [1 / 64, 1 / 16, 1 / 4]
SENSOR = {"iso": 100, "electrons_at_white": ELECTRONS, "read_noise_electrons": READ}


def scene(shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    """Smooth radiance over three decades."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    level = 10 ** (3 * x / shape[1] - 1.2) * (1 + 0.2 * np.sin(y / 17))
    return level if len(shape) == 2 else level[..., None] * np.array([0.6, 1.0, 0.8])


def bracket(
    name: str, radiance: np.ndarray, shots: dict[str, merge.Decoded], gain: float | np.ndarray = 1.0, **changes: object
) -> Bracket:
    """Three frames of a view two stops apart, 1 at the longest filling the range; samples go into ``shots``."""
    random = np.random.default_rng(sum(map(ord, name)))
    frames = []
    for number, t in enumerate(TIMES):
        facts = {"file": f"{name}/{number}", "exposure_s": t, "fnumber": 1.0, "width": SHAPE[1], "height": SHAPE[0]}
        one = frame(**{**facts, **changes})
        shots[one.file] = merge.Decoded(photograph(radiance, t, random, gain))
        frames.append(one)
    return Bracket(name=name, role="plate" if name == "plate" else "ball", frames=frames)


def run(brackets: list[Bracket], shots: dict[str, merge.Decoded], given: list[dict] | None = None, **options: object):
    tables = [NoiseFacts(**{**SENSOR, **table}).model_dump() for table in (given if given is not None else [{}])]

    def decode(one: Frame) -> merge.Decoded:
        return shots[one.file]

    return merge.merge_brackets({b.name: b for b in brackets}, decode, knobs.Merge(**options), given=tables)


def test_data_without_a_mosaic_are_merged_channel_by_channel():
    shots: dict[str, merge.Decoded] = {}
    radiance = scene((*SHAPE, 3))
    three = {"cfa": "", "black": np.full((1, 3), BLACK), "space": "linear_rec709"}
    result = run([bracket("plate", radiance, shots, **three)], shots)
    raster = result.outputs["mosaics"]["plate"]
    assert raster.space == "linear_rec709"
    assert raster.attributes["insitu:cfa"] == ""
    assert set(raster.channels) == {"R", "G", "B", "variance.R", "variance.G", "variance.B", "mask"}
    seen = np.isfinite(raster.rgb("variance"))
    pull = (raster.rgb() - radiance)[seen] / np.sqrt(raster.rgb("variance")[seen])
    # exposures are known to 0.05 %, most pixels to 1 %; 50 000 pulls know their spread to 0.3 %
    assert np.std(pull) == pytest.approx(1, abs=0.03)
    assert abs(np.median(raster.rgb()[seen] / radiance[seen]) - 1) < 0.003
    np.testing.assert_array_equal(raster["mask"] & CLIPPED > 0, ~seen.all(-1))
    # each channel is what it would be alone, as a mosaic of one colour
    row = result.outputs["exposures"]["plate"][2]
    assert row["clipped_fraction"] == pytest.approx(np.mean(radiance * TIMES[2] > 1), abs=0.01)


def test_what_does_not_fit_into_memory_is_read_again(monkeypatch):
    shots: dict[str, merge.Decoded] = {}
    views = [bracket("plate", scene(), shots), bracket("ball", scene()[:, ::-1], shots)]
    held = run(views, shots)
    monkeypatch.setattr(merge, "HELD_BYTES", 1)
    again = run(views, shots)
    for view in ("plate", "ball"):
        for name, values in held.outputs["mosaics"][view].channels.items():
            assert values.tobytes() == again.outputs["mosaics"][view][name].tobytes()
    assert held.numbers == again.numbers


def test_given_sensor_rules_and_its_pattern_enters_the_variance():
    """1 % of PRNU: pulls of bright photosites are honest with it, and too large by half without."""
    shots: dict[str, merge.Decoded] = {}
    gain = 1 + 0.01 * np.random.default_rng(1).standard_normal(SHAPE)
    views, radiance = [bracket("plate", scene(), shots, gain)], scene()
    spread = {}
    for prnu in (None, 0.01):
        result = run(views, shots, [{"prnu": prnu}])
        raster = result.outputs["mosaics"]["plate"]
        bright = np.isfinite(raster["variance"]) & (radiance * TIMES[-1] > 0.3)
        spread[prnu] = np.std((raster["Y"] - radiance)[bright] / np.sqrt(raster["variance"][bright]))
    assert spread[0.01] == pytest.approx(1, abs=0.03)  # 7 000 pulls: 0.9 %
    assert spread[None] > 1.4
    assert result.numbers["views"]["plate"]["prnu"] == 0.01
    term = next(one for one in result.evidence if "PRNU" in one["term"])
    assert term["modelled"]
    assert result.numbers["noise"]["iso_100"]["source"] == "given"
    assert result.numbers["noise"]["iso_100"]["electrons_at_white_sigma"] == pytest.approx(0.02 * ELECTRONS)


def test_a_measured_pattern_serves_the_camera_s_other_views():
    random = np.random.default_rng(2)
    shape = (320, 400)
    flat = np.full(shape, 1.5) * (1 + 0.3 * np.sin(np.arange(shape[1]) / 60))
    gain = 1 + 0.01 * random.standard_normal(shape)
    rough = flat * np.exp(0.4 * np.kron(random.standard_normal((80, 100)), np.ones((4, 4))))
    shots: dict[str, merge.Decoded] = {}
    size = {"width": shape[1], "height": shape[0]}
    result = run([bracket(n, r, shots, gain, **size) for n, r in (("plate", rough), ("ball", flat))], shots)
    for view in ("plate", "ball"):
        numbers = result.numbers["views"][view]
        assert abs(numbers["prnu"] - 0.01) < 4 * numbers["prnu_sigma"]


def test_double_exposures_scale_every_number_exactly():
    """A power of two goes through estimates, fixed pattern and variance without a bit's difference."""
    shots: dict[str, merge.Decoded] = {}
    views = [bracket("plate", scene(), shots)]
    doubled = [b.model_copy(update={"frames": [_twice(one) for one in b.frames]}) for b in views]
    one, two = (run(v, shots, [{"prnu": 0.01}]).outputs["mosaics"]["plate"] for v in (views, doubled))
    np.testing.assert_allclose(one["Y"], 2 * two["Y"], rtol=3e-7)  # through the logarithms of the exposures
    np.testing.assert_array_equal(one["mask"], two["mask"])
    labels = {"estimate_exposures": False}
    one, two = (run(v, shots, [{"prnu": 0.01}], **labels).outputs["mosaics"]["plate"] for v in (views, doubled))
    np.testing.assert_array_equal(one["Y"], 2 * two["Y"])
    np.testing.assert_array_equal(one["variance"], 4 * two["variance"])


def _twice(one: Frame) -> Frame:
    return one.model_copy(update={"exposure_s": 2 * one.exposure_s})


def test_measured_black_replaces_what_metadata_say():
    """Black is 5 DN off its metadata: without masked photosites the dark end is off, with them it is not."""
    shots: dict[str, merge.Decoded] = {}
    said = [bracket("plate", scene(), shots, black=np.full((2, 2), BLACK - 5))]
    found = OpticalBlack(np.full((2, 2), BLACK), np.full((2, 2), 0.02), np.full((2, 2), 1.5), 40000, "MaskedAreas")
    dark = scene() < 0.1
    off = {}
    for black in (None, found):
        known = {file: merge.Decoded(one.samples, black) for file, one in shots.items()}
        result = run(said, known)
        off[black is None] = abs(np.mean(result.outputs["mosaics"]["plate"]["Y"][dark] / scene()[dark]) - 1)
    assert off[False] < 0.01
    assert off[True] > 0.02
    assert any("5.00 DN off its metadata" in text for text in result.warnings)
    assert result.numbers["optical_black"]["black_off_metadata_dn"] == pytest.approx(5)


def test_listed_defects_of_any_frame_are_replaced():
    shots: dict[str, merge.Decoded] = {}
    views = [bracket("plate", scene(), shots)]
    first = views[0].frames[0].file
    shots[first] = merge.Decoded(shots[first].samples, None, np.array([[10, 20], [50, 60]]))
    for one in shots.values():
        one.samples[10, 20] = WHITE
    result = run(views, shots)
    raster = result.outputs["mosaics"]["plate"]
    assert raster["mask"][10, 20] & HOT
    assert raster["mask"][50, 60] & HOT
    assert raster["Y"][10, 20] == pytest.approx(scene()[10, 20], rel=0.1)
    assert result.numbers["views"]["plate"]["hot_pixels"] >= 2


def test_a_knee_is_left_out():
    """The longest frame's answer bends over from 80 % on: merged radiance does not."""
    shots: dict[str, merge.Decoded] = {}
    shape = (400, 480)
    views = [bracket("plate", scene(shape), shots, width=shape[1], height=shape[0])]
    for file, one in shots.items():
        signal = (one.samples - BLACK) * STEP
        bent = np.where(signal > 0.8, 0.8 + 0.2 * np.tanh((signal - 0.8) / 0.2), signal)
        shots[file] = merge.Decoded(np.rint(bent / STEP + BLACK).astype(np.uint16))
    result = run(views, shots)
    # half a percent is missing at 0.88; levels are 0.02 wide and mix with their neighbours
    assert 0.85 < result.numbers["noise"]["iso_100"]["linear_to"] < 0.93
    assert any("are not linear and not used" in text for text in result.warnings)
    raster = result.outputs["mosaics"]["plate"]
    edge = np.abs(scene(shape) * TIMES[-1] - 1.0) < 0.1  # where the longest frame would be off by 5 to 10 %
    assert np.mean(raster["Y"][edge] / scene(shape)[edge]) == pytest.approx(1, abs=0.005)
    term = next(one for one in result.evidence if "knee" in one["term"])
    assert term["modelled"]


def test_a_tone_curve_is_no_sensor():
    shots: dict[str, merge.Decoded] = {}
    views = [bracket("plate", scene(), shots)]
    for file, one in shots.items():
        signal = np.clip((one.samples - BLACK) * STEP, 0, 1)
        curve = signal * (1.4 - 0.4 * signal)
        shots[file] = merge.Decoded(np.rint(curve / STEP + BLACK).astype(np.uint16))
    assert any("a tone curve" in text for text in run(views, shots).warnings)


def test_noise_and_exposures_are_estimated_from_what_frames_show_alike():
    """A frame of a finely structured place lies 4 px off: nothing is said of it but that.

    Estimated before it is moved, the sensor seems to hold 280 electrons where it holds 30 000.
    """
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    fine = 0.3 * (1 + 0.8 * np.sin(x / 1.7 + np.sin(y / 5)) * np.sin(y / 2.3))
    shots: dict[str, merge.Decoded] = {}
    taken = [bracket("plate", fine, shots)]
    still = run(taken, shots)
    last = taken[0].frames[-1].file
    shots[last] = merge.Decoded(np.roll(shots[last].samples, 4, 1))
    moved = run(taken, shots)
    assert moved.warnings == ["plate: frames lay up to 4.00 px apart and were moved; use a tripod"]
    rows = [result.outputs["exposures"]["plate"][-1] for result in (still, moved)]
    assert rows[1]["estimated_s"] == pytest.approx(rows[0]["estimated_s"], rel=3 * rows[0]["sigma_rel"])
    assert rows[1]["sigma_rel"] < 1.1 * rows[0]["sigma_rel"]
    said = next(row for row in moved.evidence if row["term"] == "alignment of frames")
    assert said["modelled"]
    assert 0 < said["predicted_rel"] < 0.06  # what crosses the squares' edges; the structure is finer than they are
