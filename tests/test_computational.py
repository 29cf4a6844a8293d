"""A picture that is not proportional to exposure is told from its metadata, and from the bracket itself."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.image import computational
from pipeline.image.raw import read_metadata
from tests.dng_writer import ASCII, BYTE, DOUBLE, write_dng

ELECTRONS = 20000.0  # at full scale


def bracket(
    seed: int,
    step: float = 4.0,
    tone: float = 1.0,
    electrons: float = ELECTRONS,
    read: float = 0.0,
    top: float = 1.0,
    shift: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Signals (300, 600) of a long and a short frame of a scene over 2.5 decades below ``top`` of full scale.

    Waves of 50 pixels; shot noise and ``read`` electrons; ``tone``: power that follows; the scene of the short frame
    lies ``shift`` pixels aside.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:300, :600]
    scene = top * 10 ** (-1.25 + 1.25 * np.sin(2 * np.pi * (x + 0.3 * y + 20 * np.sin(y / 30)) / 50))
    frames = []
    for by, moved in ((1.0, 0), (step, shift)):
        counts = rng.poisson(np.roll(scene, moved, 1) * electrons / by) + read * rng.normal(size=scene.shape)
        frames.append(np.sign(counts) * np.minimum(np.abs(counts) / electrons, 1) ** tone)
    return frames[0], frames[1]


def test_a_sensor_is_believed():
    """30 brackets, no false alarm: the slope's limit is 4 standard errors."""
    for seed in range(30):
        groups = computational.groups_of(*bracket(seed), 0.9, 1 / 4)
        assert computational.not_proportional(*groups, np.log(1 / 4)) == ""


HIGH_ISO = {  # ISO 3200: 3000 electrons of full scale
    "read noise": {"read": 8.0},
    "wide steps": {"read": 4.0, "step": 16.0},
    "clipped": {"read": 4.0, "top": 3.0},
    "dim": {"read": 4.0, "top": 0.2},
    "moved": {"read": 4.0, "shift": 3, "top": 0.6},
    "moved and clipped": {"read": 4.0, "shift": 3, "top": 3.0},
}


@pytest.mark.parametrize("case", HIGH_ISO)
def test_noise_is_no_tone_curve(case):
    """Every group's ratio is within 5 of its standard errors (80 groups: 5e-5 by chance), and no alarm is given.

    And half a percent, measured: samples near the limit are cut by their own value. Grouped by their own brightness the
    darkest group of the first case is off by 20 %.
    """
    options = HIGH_ISO[case]
    ratio = 1 / float(options.get("step", 4.0))
    for seed in range(10):
        long, short = bracket(seed, electrons=3000.0, **options)
        levels, logs, sigmas = computational.groups_of(long, short, 0.95, ratio)
        assert len(levels) == 8
        assert np.all(np.abs(logs - np.log(ratio)) < 5 * sigmas + 0.005)
        assert computational.not_proportional(levels, logs, sigmas, np.log(ratio)) == ""


def test_a_tone_curve_is_seen_through_noise():
    """At 3000 electrons, labels as measured."""
    for seed in range(5):
        long, short = (frame / (frame + 0.3) for frame in bracket(seed, electrons=3000.0, read=4.0))
        levels, logs, sigmas = computational.groups_of(long, short, 0.7, float(np.mean(short) / np.mean(long)))
        assert "a tone curve" in computational.not_proportional(levels, logs, sigmas, logs.mean())


@pytest.mark.parametrize("tone", [0.45, 0.8])
def test_a_power_keeps_the_ratio_one_number_but_not_the_label(tone):
    groups = computational.groups_of(*bracket(0, step=16.0, tone=tone), 0.9, 16.0**-tone)
    assert "off the labels" in computational.not_proportional(*groups, np.log(1 / 16))


def test_a_tone_curve_is_seen_without_labels():
    long, short = (frame / (frame + 0.3) for frame in bracket(1))  # a shoulder, as phones have
    groups = computational.groups_of(long, short, 0.7, float(np.mean(short) / np.mean(long)))
    said = computational.not_proportional(*groups, float(np.log(np.mean(short) / np.mean(long))))
    assert "a tone curve" in said


def test_an_exposure_of_its_own_is_seen():
    long, short = bracket(2)
    groups = computational.groups_of(long, short * 1.8, 0.9, 1.8 / 4)
    assert "+0.85 stops off" in computational.not_proportional(*groups, np.log(1 / 4))


def test_rounded_labels_and_small_pictures_say_nothing():
    groups = computational.groups_of(*bracket(3, step=4.3), 0.9, 1 / 4.3)
    assert computational.not_proportional(*groups, np.log(1 / 4)) == ""
    for shape in ((1, 6), (4, 20)):
        few = computational.groups_of(np.ones(shape), np.ones(shape), 2.0, 1.0)
        assert computational.not_proportional(*few, 0.0) == ""


PHONES = {
    "proraw": ({"main": [(271, ASCII, "Apple"), (50940, BYTE, (0,))]}, 3, "computational (three channels per pixel"),
    "masks": ({"extra": [(52526, ASCII, "sky")]}, 0, "computational (masks"),
    "merged mosaic": ({"main": [(271, ASCII, "Google")]}, 0, "from a phone (Google)"),
    "gain table": ({"main": [(52525, DOUBLE, (1.0,))]}, 0, "computational (a gain table"),
    "camera": ({"main": [(271, ASCII, "NIKON")]}, 0, None),
    "converted": ({"main": [(271, ASCII, "NIKON")]}, 3, None),
}


@pytest.mark.parametrize("case", PHONES)
def test_metadata_tell(tmp_path, case):
    options, channels, words = PHONES[case]
    shape = (60, 80, channels) if channels else (60, 80)
    picture = np.random.default_rng(0).integers(600, 9000, shape).astype(np.uint16)
    marks = read_metadata(write_dng(tmp_path / "a.dng", picture, **options)).marks
    assert marks == [] if words is None else any(mark.startswith(words) for mark in marks)
