"""Black measured on masked photosites: right within its error, used only where it differs from metadata."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.image import optical_black
from pipeline.image.raw import read_metadata, read_sensor
from tests.dng_writer import LONG, SHORT, write_dng

ACTIVE = (13, 47, 213, 447)  # odd margins: the cell starts at the active area
LEVELS = np.array([[512.3, 511.1], [514.7, 513.2]])


def stored(seed: int, level: np.ndarray = LEVELS, noise: float = 5.0, banding: float = 0.0) -> np.ndarray:
    """A frame whose margins are dark and whose active area is a bright scene."""
    rng = np.random.default_rng(seed)
    height, width = ACTIVE[2], ACTIVE[3]
    rows, columns = np.mgrid[:height, :width]
    dark = level[(rows - ACTIVE[0]) % 2, (columns - ACTIVE[1]) % 2] + rng.normal(0, banding, (height, 1))
    picture = dark + rng.normal(0, noise, dark.shape)
    picture[ACTIVE[0] :, ACTIVE[1] :] += rng.uniform(500, 9000, (200, 400))
    return picture.round().astype(np.uint16)


def measured(picture: np.ndarray, stated: float = 512.0) -> optical_black.OpticalBlack | None:
    areas = optical_black.margins(picture.shape, ACTIVE)
    return optical_black.measure(picture, areas, ACTIVE, 15000.0, np.full((2, 2), stated), "margins")


@pytest.mark.parametrize("banding", [0.0, 2.0])
def test_level_is_right_within_its_error(banding):
    """Pulls over 40 frames: standard deviation 1 within 4 / sqrt(2 * 160) when nothing but noise is there.

    With noise shared by rows the two columns of a cell share their error, and it must not come out too small.
    """
    pulls = []
    for seed in range(40):
        found = measured(stored(seed, banding=banding))
        pulls.append((found.level - LEVELS) / found.sigma)
    spread = np.std(pulls)
    assert abs(np.mean(pulls)) < 4 * spread / np.sqrt(80)
    assert spread < 1 + 4 / np.sqrt(2 * 80)
    assert spread > 0.6
    found = measured(stored(0))
    np.testing.assert_allclose(found.noise, np.sqrt(25 + 1 / 12), rtol=4 / np.sqrt(2 * found.photosites / 4))


def test_defects_and_leaking_light_do_not_move_it():
    clean = stored(1)
    spoiled = clean.copy()
    spoiled[40:200:9, 20] = 15800  # hot photosites
    spoiled[:, 44:47] += np.arange(100, 400, 100, dtype=np.uint16)  # next to the light: left out
    one, other = measured(clean), measured(spoiled)
    assert np.abs(one.level - other.level).max() < one.sigma.max()


def test_what_is_not_dark_is_not_taken():
    lit = stored(2)
    lit[:, : ACTIVE[1]] += np.random.default_rng(0).integers(0, 3000, lit[:, : ACTIVE[1]].shape).astype(np.uint16)
    lit[: ACTIVE[0]] += np.uint16(600)
    assert measured(lit) is None
    assert measured(stored(3), stated=2000) is None  # 10 % of full scale off: no black
    assert optical_black.margins((220, 450), (8, 8, 220, 450)) == []


def test_metadata_stay_where_they_are_right_and_drift_is_reported():
    stated = LEVELS
    exact = optical_black.OpticalBlack(stated + 0.04, np.full((2, 2), 0.05), np.full((2, 2), 5.0), 1000, "margins")
    assert np.array_equal(optical_black.chosen(stated, exact), stated)
    assert np.array_equal(optical_black.chosen(stated, None), stated)
    warm = measured(stored(5, LEVELS + 3.0))
    assert np.array_equal(optical_black.chosen(stated, warm), warm.level)
    numbers, warnings = optical_black.report([("a", stated, exact), ("b", stated, warm), ("c", stated, None)])
    assert numbers["black_drift_dn"] == pytest.approx(3.0, abs=0.3)
    assert numbers["frames_with_optical_black"] == 2
    assert any(line.startswith("b: black of the masked photosites") for line in warnings)
    assert any("drifts by" in line for line in warnings)
    assert optical_black.report([("c", stated, None)]) == ({}, [])


@pytest.mark.parametrize("masked", [True, False], ids=["MaskedAreas", "margins"])
def test_from_a_file(tmp_path, masked):
    extra = [(50829, LONG, ACTIVE), (50713, SHORT, (2, 2)), (50714, SHORT, (512, 512, 512, 512))]
    if masked:
        extra.append((50830, LONG, (ACTIVE[0], 2, ACTIVE[2], 40, 0, ACTIVE[1], 10, ACTIVE[3])))
    path = write_dng(tmp_path / "a.dng", stored(6), extra=extra)
    frame = read_metadata(path)
    found = read_sensor(path, frame).black
    assert found.source == ("MaskedAreas" if masked else "margins")
    np.testing.assert_allclose(found.level, LEVELS, atol=5 * found.sigma.max())


def test_nothing_is_measured_without_dark_photosites(tmp_path):
    path = write_dng(tmp_path / "a.dng", stored(7))
    assert read_sensor(path, read_metadata(path)).black is None


def test_cropped_photosites_of_a_dark_scene_are_no_black():
    """A margin that sees the same 20 DN of light as the picture beside it is not believed; one below metadata is."""
    rng = np.random.default_rng(8)
    dim = rng.normal(512 + 20, 5, (ACTIVE[2], ACTIVE[3])).round().astype(np.uint16)
    assert measured(dim) is None
    assert measured(dim, stated=535.0) is not None  # light only adds
    masked = optical_black.measure(dim, [(13, 2, 213, 40)], ACTIVE, 15000.0, np.full((2, 2), 512.0), "MaskedAreas")
    assert masked is not None  # the file's own word
