"""[[sensor]]: what files lack is stated, what is stated wrongly is refused, what nobody says is asked for."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from pipeline.image import sensor
from pipeline.image.libraw import XTRANS_MARK
from pipeline.image.raw import read_metadata
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Frame
from stages import ingest, knobs
from tests.command import HEIGHT, WIDTH, tiny
from tests.dng_writer import ASCII, SHORT, SRATIONAL, write_dng

MATRIX = [[0.7, -0.2, -0.1], [-0.4, 1.2, 0.2], [-0.1, 0.2, 0.6]]


def picture(channels: int = 0) -> np.ndarray:
    shape = (60, 80, channels) if channels else (60, 80)
    return np.random.default_rng(0).integers(600, 9000, shape).astype(np.uint16)


def frame_of(path: Path, channels: int = 0, **options: object) -> Frame:
    return read_metadata(write_dng(path / "a.dng", picture(channels), **options))  # type: ignore[arg-type]


def test_stated_facts_replace_the_files(tmp_path):
    frame = frame_of(tmp_path, main=[(50722, SRATIONAL, MATRIX), (50964, SRATIONAL, MATRIX), (50779, SHORT, 17)])
    assert frame.color_matrix_2 is not None
    found = sensor.restated(
        frame,
        {"color_matrix": MATRIX, "illuminant": 21, "black": [1, 2, 3, 4], "white": 14000.0, "linear_limit": 0.9,
         "as_shot_neutral": (0.4, 1, 0.6)},
    )  # fmt: skip
    np.testing.assert_array_equal(found.color_matrix, MATRIX)
    assert (found.color_matrix_2, found.forward_matrix, found.illuminant, found.illuminant_2) == (None, None, 21, 0)
    np.testing.assert_array_equal(found.black, [[1, 2], [3, 4]])
    assert (found.white, found.linear_limit, found.as_shot_neutral.tolist()) == (14000, 0.9, [0.4, 1, 0.6])
    assert sensor.restated(frame, {}) is frame


@pytest.mark.parametrize(
    ("channels", "stated", "found"),
    [(0, 7.0, [[7, 7], [7, 7]]), (0, [1, 2, 3], [[1, 2], [2, 3]]), (3, 7.0, [[7, 7, 7]]), (3, [1, 2, 3], [[1, 2, 3]])],
)
def test_black_of_any_kind(tmp_path, channels, stated, found):
    np.testing.assert_array_equal(sensor.restated(frame_of(tmp_path, channels), {"black": stated}).black, found)


def test_facts_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(CaptureError, match="stated for a CFA cell"):
        sensor.restated(frame_of(tmp_path, 3), {"black": [1, 2, 3, 4]})
    with pytest.raises(CaptureError, match="no inverse"):
        sensor.restated(frame_of(tmp_path), {"color_matrix": np.ones((3, 3))})


def test_what_is_missing_is_asked_for(tmp_path):
    assert sensor.missing(frame_of(tmp_path)) == []
    assert "no colour matrix" in sensor.missing(frame_of(tmp_path, without=[50721]))[0]
    table = [(50712, SHORT, np.arange(1024) * 16)]
    bare = frame_of(tmp_path, extra=table, without=[50717, 50714])
    assert "no white level" in sensor.missing(bare)[0]
    assert sensor.missing(sensor.restated(bare, {"white": 16000.0})) == []
    dark = frame_of(tmp_path).model_copy(update={"black": np.zeros((1, 3)), "cfa": "", "marks": [XTRANS_MARK]})
    assert "no X-Trans sensor has" in sensor.missing(dark)[0]
    known = dark.model_copy(update={"space": "acescg", "color_matrix": None, "marks": []})
    assert sensor.missing(known) == []


def test_lists_of_bad_pixels(tmp_path):
    plain, dcraw, packed = (tmp_path / name for name in ("a.txt", "b.badpixels", "c.gz"))
    plain.write_text("# row column\n3 4\n1 2\n3 4\n")
    dcraw.write_text("4 3 0\n2 1 1700000000  # column row time\n")
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    for path in (plain, dcraw, packed):
        assert sensor.read_bad_pixels(path).tolist() == [[1, 2], [3, 4]]
    for text in ("1 2\n3 4 5\n", "1\n", "a b\n", "", "-1 2\n", "1.5 2\n"):
        plain.write_text(text)
        with pytest.raises(CaptureError, match=r"a\.txt: "):
            sensor.read_bad_pixels(plain)
    with pytest.raises(CaptureError, match=r"d\.txt: no list"):
        sensor.read_bad_pixels(tmp_path / "d.txt")


def test_capture_toml_states_them(tmp_path):
    """A capture whose plate lacks a matrix is refused with the line to write, and read once it is written."""
    folder = tiny(tmp_path)
    name = next(path for path in sorted(folder.rglob("*.dng")) if "plate" in path.as_posix())
    large = np.random.default_rng(0).integers(600, 9000, (HEIGHT, WIDTH)).astype(np.uint16)
    write_dng(name, large, without=[50721], main=[(271, ASCII, "Google")])
    with pytest.raises(CaptureError, match=r"no colour matrix in the file.*\[\[sensor\]\]"):
        ingest.compute(folder, None, knobs.Ingest())
    manifest = folder / "capture.toml"
    (folder / "hot.txt").write_text("5 6\n")
    file = name.relative_to(folder).as_posix()
    text = manifest.read_text()
    manifest.write_text(
        f'{text}\n[[sensor]]\nfiles = ["{file}"]\ncolor_matrix = {MATRIX}\nilluminant = 21\nblack = 500\n'
        'bad_pixels = "hot.txt"\n'
    )
    found = ingest.compute(folder, None, knobs.Ingest())
    frame = next(one for one in found.outputs["brackets"]["plate"].frames if one.file == file)
    np.testing.assert_array_equal(frame.color_matrix, MATRIX)
    assert (frame.black.max(), frame.bad_pixels.tolist()) == (500, [[5, 6]])
    assert any("from a phone (Google)" in line for line in found.warnings)
    manifest.write_text(f'{text}\n[[sensor]]\nfiles = ["{file}"]\nblack = [1, 2]\nbad_pixels = "none.txt"\n')
    with pytest.raises(ManifestError, match="black has 2 numbers"):
        ingest.compute(folder, None, knobs.Ingest())
    manifest.write_text(f'{text}\n[[sensor]]\nfiles = ["{file}"]\nbad_pixels = "none.txt"\n')
    with pytest.raises(ManifestError, match=r"'none\.txt'; no such file"):
        ingest.compute(folder, None, knobs.Ingest())
