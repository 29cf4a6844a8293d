"""The DNG writer: what is written is what three independent readers read."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from pipeline.simulation.dng import DngFacts, decimal_fraction, dng_bytes

BLACK = (512, 514, 511, 513)
MATRIX = np.array([[0.6633, -0.0758, -0.0956], [-0.4168, 1.1848, 0.1941], [-0.0803, 0.1880, 0.5498]])


def facts(**changes: object) -> DngFacts:
    given = {
        "exposure": Fraction(1, 125), "iso": 100, "fnumber": Fraction(8), "focal_mm": Fraction(404, 10),
        "timestamp": "2026:03:14 10:00:00", "make": "insitu", "model": "Simulated", "cfa": "RGGB", "black": BLACK,
        "white": 15800, "color_matrix": MATRIX, "neutral": np.array([0.450524, 1.000036, 0.710442]),
        "noise": (2.6e-5, 7.4e-9),
    }  # fmt: skip
    return DngFacts(**{**given, **changes})  # type: ignore[arg-type]


def noisy_mosaic(height: int, width: int, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    level = np.tile([[3000, 6000], [6100, 4000]], (height // 2, width // 2))
    return random.normal(level, 40).round().clip(0, 15800).astype(np.uint16)


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, np.ndarray]:
    mosaic = noisy_mosaic(64, 96)
    mosaic[0, 0], mosaic[-1, -1], mosaic[3, 5] = 0, 15800, 15800  # extremes
    path = tmp_path / "frame.dng"
    path.write_bytes(dng_bytes(mosaic, facts()))
    return path, mosaic


def test_rawpy_reads_samples_and_facts(written: tuple[Path, np.ndarray]) -> None:
    import rawpy

    path, mosaic = written
    with rawpy.imread(str(path)) as raw:
        assert np.array_equal(raw.raw_image_visible, mosaic)
        assert raw.raw_pattern.tolist() == [[0, 1], [3, 2]]
        by_cell = [raw.black_level_per_channel[raw.raw_pattern[r, c]] for r in (0, 1) for c in (0, 1)]
        assert by_cell == list(BLACK)
        assert raw.white_level == 15800
        assert raw.other.iso_speed == 100
        assert raw.other.shutter_speed == pytest.approx(1 / 125, rel=1e-6)  # float32
        assert raw.other.aperture == 8
        assert raw.other.focal_length == pytest.approx(40.4, rel=1e-6)


def test_tifffile_reads_samples_and_tags(written: tuple[Path, np.ndarray]) -> None:
    import tifffile

    path, mosaic = written
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        assert np.array_equal(page.asarray(), mosaic)
        tags = {tag.name: tag.value for tag in page.tags}
    matrix = np.array(tags["ColorMatrix1"], float).reshape(9, 2)
    assert np.array_equal(np.round(matrix[:, 0] / matrix[:, 1], 10), MATRIX.ravel())
    neutral = np.array(tags["AsShotNeutral"], float).reshape(3, 2)
    assert np.allclose(neutral[:, 0] / neutral[:, 1], facts().neutral, rtol=0, atol=5e-7)  # six decimals
    assert tags["BlackLevel"] == BLACK
    assert tags["NoiseProfile"] == facts().noise
    assert tags["CalibrationIlluminant1"] == 21
    assert tags["UniqueCameraModel"] == "insitu Simulated"
    assert "ColorMatrix2" not in tags


def test_exifread_finds_the_exif_ifd(written: tuple[Path, np.ndarray]) -> None:
    import exifread

    with written[0].open("rb") as stream:
        tags = exifread.process_file(stream, details=False)
    assert str(tags["EXIF ExposureTime"]) == "1/125"
    assert str(tags["EXIF FNumber"]) == "8"
    assert str(tags["EXIF ISOSpeedRatings"]) == "100"
    assert str(tags["EXIF DateTimeOriginal"]) == "2026:03:14 10:00:00"
    assert str(tags["EXIF FocalLength"]) == "202/5"


def test_second_matrix_is_written(tmp_path: Path) -> None:
    import tifffile

    path = tmp_path / "two.dng"
    path.write_bytes(dng_bytes(noisy_mosaic(16, 16), facts(color_matrix_2=MATRIX + 0.1)))
    with tifffile.TiffFile(path) as file:
        tags = {tag.name: tag.value for tag in file.pages[0].tags}
    matrix = np.array(tags["ColorMatrix2"], float).reshape(9, 2)
    assert np.allclose(matrix[:, 0] / matrix[:, 1], (MATRIX + 0.1).ravel())
    assert tags["CalibrationIlluminant2"] == 17


@pytest.mark.parametrize("shape", [(2, 2), (2, 64), (64, 2), (768, 1024)])
def test_any_even_size_survives(tmp_path: Path, shape: tuple[int, int]) -> None:
    import tifffile

    mosaic = noisy_mosaic(*shape)
    path = tmp_path / "frame.dng"
    path.write_bytes(dng_bytes(mosaic, facts()))
    with tifffile.TiffFile(path) as file:
        assert np.array_equal(file.pages[0].asarray().reshape(shape), mosaic)


def test_pairs_of_rows_compress_better() -> None:
    """Same-colour prediction must pay: 40 DN of noise are about 7.4 bits, other colours cost two bits more."""
    import imagecodecs

    mosaic = noisy_mosaic(256, 384)
    assert len(dng_bytes(mosaic, facts())) < 0.85 * len(imagecodecs.ljpeg_encode(mosaic))


def test_bad_mosaics_are_refused() -> None:
    with pytest.raises(ValueError, match="even sides"):
        dng_bytes(np.zeros((3, 4), np.uint16), facts())
    with pytest.raises(ValueError, match="uint16"):
        dng_bytes(np.zeros((4, 4), np.int32), facts())
    with pytest.raises(ValueError, match="above the white level"):
        dng_bytes(np.full((4, 4), 15801, np.uint16), facts())


def test_decimal_fraction_is_exact() -> None:
    assert decimal_fraction(-0.4168, 4) == Fraction(-4168, 10000)
    assert decimal_fraction(40.4, 2) == Fraction(202, 5)
