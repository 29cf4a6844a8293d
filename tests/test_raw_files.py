"""Every real RAW file at hand is read as its manifest says, or refused in one line; no damaged header goes unseen."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.image import sensor
from pipeline.image.raw import file_sha256, read_metadata, read_mosaic, read_sensor
from pipeline.run.errors import CaptureError
from tests import dng_writer as writer
from tests.dng_writer import LONG, SHORT, write_dng

DATA = Path(os.environ.get("INSITU_DATA", "../shared/data"))
BROKEN = {
    "CanonRaw.cr2": "not a readable RAW file",
    "CanonRaw.cr3": "Input/output error",
    "CanonRaw.crw": "Input/output error",
    "DNG.dng": "1 of 140 pieces",  # LibRaw decodes it to zeros without an error
    "FujiFilm.raf": "Input/output error",
    "Minolta.mrw": "Input/output error",
    "Nikon.nef": "Data error",
    "PhaseOne.iiq": "Input/output error",
    "Sigma.x3f": "Input/output error",
}
real = pytest.mark.skipif(not (DATA / "raw").is_dir(), reason="no INSITU_DATA")


def files(folder: str) -> list[str]:
    return sorted(path.name for path in (DATA / folder).iterdir()) if (DATA / folder).is_dir() else []


@real
def test_every_file_has_its_test():
    assert files("raw") == ["RAW_KODAK_DC50.KDC", "RAW_NIKON_D1.NEF", "bad_pixels.gz", "colorchart.dng"]
    assert files("raw_broken") == sorted(BROKEN)


@real
@pytest.mark.parametrize("name", BROKEN)
def test_headers_without_data_are_refused(name):
    with pytest.raises(CaptureError, match=BROKEN[name]) as error:
        read_metadata(DATA / "raw_broken" / name)
    assert str(error.value).startswith(name)
    assert "\n" not in str(error.value)


@real
def test_magic_lantern_dng():
    """EXIF says 0 s, f/0, ISO 0 (LibRaw: 1 s at f/1). Its tags do hold ColorMatrix1, which LibRaw does not hand out."""
    path = DATA / "raw/colorchart.dng"
    frame = read_metadata(path)
    assert (frame.exposure_s, frame.iso, frame.fnumber) == (0, 0, 0)
    assert (frame.width, frame.height, frame.cfa) == (1734, 1156, "RGGB")
    assert (frame.white, frame.linear_limit) == (15000, 1)
    np.testing.assert_array_equal(frame.black, np.full((2, 2), 2056))
    np.testing.assert_allclose(frame.as_shot_neutral, [1, 2.477, 1.462])
    assert frame.color_matrix[0, 0] == 0.6461
    assert sensor.missing(frame) == []
    found = read_sensor(path, frame)
    assert found.samples.shape == (1156, 1734)


@real
def test_magic_lantern_black_is_measured_off_its_metadata():
    """Its 144 dark columns hold 2047.3 and 2050.3 DN in alternate rows, the tag says 2056 (0.06 % of full scale)."""
    path = DATA / "raw/colorchart.dng"
    frame = read_metadata(path)
    black = read_sensor(path, frame).black
    assert black.source == "margins"
    np.testing.assert_allclose(black.level, [[2047.3, 2047.3], [2050.3, 2050.3]], atol=0.4)
    assert np.all(black.sigma < 0.4)


@real
def test_nikon_d1_nef():
    import rawpy

    path = DATA / "raw/RAW_NIKON_D1.NEF"
    frame = read_metadata(path)
    assert (frame.exposure_s, frame.iso, frame.fnumber, frame.focal_mm) == (0.004, 200, 7.6, 20)
    assert (frame.width, frame.height, frame.cfa) == (2012, 1324, "BGGR")
    assert frame.black.max() == 0
    assert frame.white <= 4095
    assert frame.color_matrix.shape == (3, 3)
    assert sensor.missing(frame) == []
    mosaic = read_mosaic(path, frame)
    with rawpy.imread(str(path)) as raw:
        np.testing.assert_array_equal(mosaic, raw.raw_image_visible)
    assert np.mean(mosaic == 4095) == pytest.approx(0.0005, abs=0.0001)  # as its manifest says; greens end at 3998


@real
def test_kodak_dc50_kdc_is_asked_for_a_colour_matrix():
    path = DATA / "raw/RAW_KODAK_DC50.KDC"
    frame = read_metadata(path)
    assert (frame.exposure_s, frame.fnumber, frame.iso) == (0.00435, 6.2, 84)
    assert (frame.width, frame.height, frame.color_matrix, frame.as_shot_neutral) == (768, 512, None, None)
    assert read_mosaic(path, frame).shape == (512, 768)
    (line,) = sensor.missing(frame)
    assert "no colour matrix" in line
    assert "[[sensor]]" in line
    assert sensor.missing(sensor.restated(frame, {"color_matrix": writer.MATRIX, "illuminant": 21})) == []


@real
def test_list_of_bad_pixels():
    """A camera's list, rows and columns of a 4284 x 2844 sensor: no frame of another size takes it."""
    listed = sensor.read_bad_pixels(DATA / "raw/bad_pixels.gz")
    assert listed.shape == (26484, 2)
    assert listed.max(0).tolist() == [2843, 4281]
    with pytest.raises(CaptureError, match="not a readable RAW file"):
        read_metadata(DATA / "raw/bad_pixels.gz")
    frame = read_metadata(DATA / "raw/colorchart.dng")
    with pytest.raises(CaptureError, match="give the list of this camera"):
        sensor.restated(frame, {"bad_pixels": listed})
    large = frame.model_copy(update={"width": 4284, "height": 2844})
    assert len(sensor.restated(large, {"bad_pixels": listed}).bad_pixels) == 26484


CODINGS = {
    "plain": {},
    "strips": {"piece": (7, 80)},
    "14_bits": {"bits": 14},
    "lossless_jpeg": {"compression": 7, "code": writer.lossless_jpeg},
    "tiles": {"compression": 7, "code": writer.lossless_jpeg, "piece": (32, 48), "tiled": True},
    "predicted": {"compression": 8, "code": writer.deflated(stride=1), "extra": [(317, SHORT, 2)]},
    "jpeg_xl": {"compression": 52546, "code": writer.jpeg_xl},
    "sub_directory": {"main": [(50734, writer.RATIONAL, 1)]},
}


@pytest.mark.parametrize("coding", CODINGS)
def test_no_damaged_header_gives_another_picture_in_silence(tmp_path, coding):
    """60 headers with 6 random bytes each: refused in one line, or the same samples (0 of 6000 escaped, long run)."""
    rng = np.random.default_rng(list(CODINGS).index(coding))
    samples = rng.integers(0, 15000, (60, 80)).astype(np.uint16)
    path = write_dng(tmp_path / "a.dng", samples, **CODINGS[coding])
    assert_no_silence(path, samples, slice(0, 540), 60, rng)


@real
@pytest.mark.parametrize(
    ("name", "header", "count"),
    [
        ("colorchart.dng", slice(0, 1536), 40),
        ("RAW_NIKON_D1.NEF", slice(58880, 59642), 40),
        ("RAW_NIKON_D1.NEF", slice(0, 1280), 8),
    ],
)
def test_no_damaged_header_of_a_real_file_gives_another_picture(tmp_path, name, header, count):
    path = DATA / "raw" / name
    samples = read_mosaic(path, read_metadata(path))
    copy = tmp_path / name
    copy.write_bytes(path.read_bytes())
    assert_no_silence(copy, samples, header, count, np.random.default_rng(7))


def assert_no_silence(path: Path, samples: np.ndarray, header: slice, count: int, rng: np.random.Generator) -> None:
    whole = path.read_bytes()
    lines: list[str] = []
    for _ in range(count):
        damaged = bytearray(whole)
        for place in rng.integers(header.start, header.stop, 6):
            damaged[place] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            found = read_mosaic(path, read_metadata(path))
        except CaptureError as error:
            lines.append(str(error))
            continue
        assert np.array_equal(found, samples), "another picture, in silence"
    assert lines
    assert not any("\n" in line for line in lines)


def test_a_file_changed_after_ingest_is_refused(tmp_path):
    path = write_dng(tmp_path / "a.dng", np.arange(4800, dtype=np.uint16).reshape(60, 80))
    frame = read_metadata(path)
    assert frame.sha256 == file_sha256(path)
    write_dng(path, np.arange(4800, dtype=np.uint16).reshape(60, 80), extra=[(50829, LONG, (0, 0, 60, 70))])
    with pytest.raises(CaptureError, match="70 x 60, metadata say 80 x 60"):
        read_mosaic(path, frame)


@real
@pytest.mark.parametrize("name", ["colorchart.dng", "RAW_NIKON_D1.NEF", "RAW_KODAK_DC50.KDC"])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.99])
def test_truncated_real_files_are_refused(tmp_path, name, share):
    data = (DATA / "raw" / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CaptureError) as error:
        read_metadata(path)
    assert "\n" not in str(error.value)
