"""RAW files: what is read from them, and what is refused, in one line each."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from pipeline.image.raw import file_sha256, read_metadata, read_mosaic
from pipeline.run.errors import CaptureError
from pipeline.simulation.dng import DngFacts, dng_bytes

MATRIX = np.array([[0.742, -0.205, -0.062], [-0.456, 1.248, 0.233], [-0.106, 0.215, 0.648]])


def facts(**changes: object) -> DngFacts:
    values: dict = {
        "exposure": Fraction(1, 60),
        "iso": 200,
        "fnumber": Fraction(56, 10),
        "focal_mm": Fraction(35),
        "make": "Maker",
        "model": "One",
        "timestamp": "2026:01:02 03:04:05",
        "cfa": "RGGB",
        "black": (512, 513, 514, 515),
        "white": 15800,
        "color_matrix": MATRIX,
        "neutral": np.array([0.5, 1.0, 0.75]),
        "noise": (2.5e-5, 6e-9),
    }
    return DngFacts(**{**values, **changes})


def write(path: Path, mosaic: np.ndarray, **changes: object) -> Path:
    path.write_bytes(dng_bytes(mosaic, facts(**changes)))
    return path


def ramp(height: int = 60, width: int = 80) -> np.ndarray:
    return (512 + np.arange(height * width) % 9000).reshape(height, width).astype(np.uint16)


def test_what_is_written_is_read(tmp_path):
    path = write(tmp_path / "a.dng", ramp(), color_matrix_2=MATRIX + 0.01)
    frame = read_metadata(path, "plate/a.dng")
    assert (frame.file, frame.sha256) == ("plate/a.dng", file_sha256(path))
    assert (frame.width, frame.height, frame.cfa, frame.white) == (80, 60, "RGGB", 15800)
    assert (frame.exposure_s, frame.iso, frame.fnumber, frame.focal_mm) == (1 / 60, 200, 5.6, 35)
    assert frame.timestamp == "2026:01:02 03:04:05"
    np.testing.assert_array_equal(frame.black, [[512, 513], [514, 515]])
    np.testing.assert_allclose(frame.color_matrix, MATRIX, atol=1e-9)
    np.testing.assert_allclose(frame.color_matrix_2, MATRIX + 0.01, atol=1e-9)
    np.testing.assert_allclose(frame.as_shot_neutral, [0.5, 1, 0.75])
    np.testing.assert_allclose(frame.noise_profile, [2.5e-5, 6e-9])
    assert (frame.illuminant, frame.illuminant_2) == (21, 17)
    np.testing.assert_array_equal(read_mosaic(path, frame), ramp())


def test_one_wall_at_twice_the_exposure_decodes_to_twice_the_signal(tmp_path):
    """LibRaw's own development rescales each file by its maximum; the mosaic must not be."""
    wall = np.full((64, 64), 2000, np.uint16)
    wall[::7, ::5] = 2400
    frames = []
    for name, signal in (("a", wall), ("b", 2 * wall)):
        path = write(tmp_path / f"{name}.dng", signal + np.uint16(512), black=(512,) * 4)
        frames.append(read_mosaic(path, read_metadata(path)).astype(float) - 512)
    np.testing.assert_array_equal(frames[1], 2 * frames[0])


def test_odd_active_area_keeps_its_colours(tmp_path):
    """LibRaw moves an odd margin and mislabels the colours; the crop and the pattern must come from the file."""
    import tifffile

    path = write(tmp_path / "a.dng", ramp())
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        area, crop = (tiff.pages[0].tags[code].valueoffset for code in (50829, 50720))
    data[area : area + 16] = np.array([1, 3, 59, 77], "<u4").tobytes()
    data[crop : crop + 8] = np.array([74, 58], "<u4").tobytes()
    path.write_bytes(data)
    frame = read_metadata(path)
    assert (frame.width, frame.height, frame.cfa) == (74, 58, "RGGB")  # DNG: the pattern starts at the active area
    np.testing.assert_array_equal(read_mosaic(path, frame), ramp()[1:59, 3:77])


def test_wholly_clipped_frame_is_read_and_a_constant_one_refused(tmp_path):
    clipped = write(tmp_path / "clipped.dng", np.full((32, 32), 15800, np.uint16))
    assert read_mosaic(clipped, read_metadata(clipped)).min() == 15800
    empty = write(tmp_path / "empty.dng", np.zeros((32, 32), np.uint16))
    with pytest.raises(CaptureError, match="every pixel is 0"):
        read_mosaic(empty, read_metadata(empty))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("text.dng", b"this is no picture\n"),
        ("empty.dng", b""),
        ("png.dng", b"\x89PNG\r\n\x1a\n" + bytes(100)),
        ("tiff.dng", b"II*\0\x08\0\0\0\0\0\0\0\0\0"),
    ],
)
def test_not_raw_is_refused_in_one_line(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(CaptureError) as error:
        read_metadata(path)
    assert str(error.value).startswith(name)
    assert "\n" not in str(error.value)


def test_missing_and_truncated_files_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="no such file"):
        read_metadata(tmp_path / "none.dng")
    path = write(tmp_path / "a.dng", ramp())
    frame = read_metadata(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(CaptureError, match="image data end at"):
        read_metadata(path)
    path.unlink()
    with pytest.raises(CaptureError, match="no such file"):
        read_mosaic(path, frame)


def test_another_size_than_the_index_says_is_refused(tmp_path):
    path = write(tmp_path / "a.dng", ramp())
    frame = read_metadata(path).model_copy(update={"width": 70})
    with pytest.raises(CaptureError, match="80 x 60, metadata say 70 x 60"):
        read_mosaic(path, frame)


def test_missing_exposure_is_zero_not_invented(tmp_path):
    path = write(tmp_path / "a.dng", ramp(), exposure=Fraction(0), iso=0, fnumber=Fraction(0))
    frame = read_metadata(path)
    assert (frame.exposure_s, frame.iso, frame.fnumber) == (0, 0, 0)
