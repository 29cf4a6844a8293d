"""A picture that is not proportional to exposure is told from its metadata, and from the bracket itself."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.image import computational
from pipeline.image.raw import read_metadata
from tests.dng_writer import ASCII, BYTE, DOUBLE, write_dng

ELECTRONS = 20000.0  # at full scale


def bracket(seed: int, step: float = 4.0, tone: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Signals of a long and a short frame of a scene over 2.5 decades, shot noise; ``tone``: power that follows."""
    rng = np.random.default_rng(seed)
    scene = 10 ** rng.uniform(-2.5, 0, 200_000)
    frames = (rng.poisson(scene * ELECTRONS / by) / ELECTRONS for by in (1, step))
    return tuple(frame**tone for frame in frames)  # type: ignore[return-value]


def test_a_sensor_is_believed():
    """30 brackets, no false alarm: the slope's limit is 4 standard errors."""
    for seed in range(30):
        groups = computational.groups_of(*bracket(seed), 0.9)
        assert computational.not_proportional(*groups, np.log(1 / 4)) == ""


@pytest.mark.parametrize("tone", [0.45, 0.8])
def test_a_power_keeps_the_ratio_one_number_but_not_the_label(tone):
    groups = computational.groups_of(*bracket(0, step=16.0, tone=tone), 0.9)
    assert "off the labels" in computational.not_proportional(*groups, np.log(1 / 16))


def test_a_tone_curve_is_seen_without_labels():
    long, short = (frame / (frame + 0.3) for frame in bracket(1))  # a shoulder, as phones have
    groups = computational.groups_of(long, short, 0.7)
    said = computational.not_proportional(*groups, float(np.log(np.mean(short) / np.mean(long))))
    assert "a tone curve" in said


def test_an_exposure_of_its_own_is_seen():
    long, short = bracket(2)
    groups = computational.groups_of(long, short * 1.8, 0.9)
    assert "+0.85 stops off" in computational.not_proportional(*groups, np.log(1 / 4))


def test_rounded_labels_and_small_pictures_say_nothing():
    groups = computational.groups_of(*bracket(3, step=4.3), 0.9)
    assert computational.not_proportional(*groups, np.log(1 / 4)) == ""
    few = computational.groups_of(np.ones(10), np.ones(10), 2.0)
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
