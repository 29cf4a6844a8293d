"""DNGs of every coding, phase and area: what was written is what is read, or one line says why not."""

from __future__ import annotations

import itertools
import struct
from pathlib import Path

import numpy as np
import pytest

from pipeline.image import dng
from pipeline.image.raw import read_metadata, read_mosaic, read_sensor
from pipeline.run.errors import CaptureError
from tests import dng_writer as writer
from tests.dng_writer import BYTE, DOUBLE, LONG, SHORT, SRATIONAL, UNDEFINED, write_dng


def picture(height: int = 60, width: int = 80, channels: int = 0, top: int = 15000, seed: int = 0) -> np.ndarray:
    shape = (height, width, channels) if channels else (height, width)
    return np.random.default_rng(seed).integers(0, top, shape).astype(np.uint16)


def back(path: Path) -> np.ndarray:
    return read_mosaic(path, read_metadata(path))


CODINGS = {
    "plain": {},
    "plain_strips": {"piece": (7, 80)},
    "plain_big_endian": {"order": ">"},
    "plain_tiles": {"piece": (32, 48), "tiled": True},
    "8_bits": {"bits": 8},
    "10_bits": {"bits": 10},
    "12_bits": {"bits": 12, "piece": (7, 80)},
    "14_bits": {"bits": 14},
    "lossless_jpeg": {"compression": 7, "code": writer.lossless_jpeg},
    "lossless_jpeg_tiles": {"compression": 7, "code": writer.lossless_jpeg, "piece": (32, 48), "tiled": True},
    "deflate": {"compression": 8, "code": writer.deflated()},
    "deflate_predicted": {"compression": 8, "code": writer.deflated(stride=1), "extra": [(317, SHORT, 2)]},
    "deflate_predicted_x2": {
        "compression": 8, "code": writer.deflated(stride=2), "extra": [(317, SHORT, 34892)], "piece": (16, 16),
        "tiled": True,
    },
    "deflate_big_endian": {"compression": 8, "code": writer.deflated(order=">"), "order": ">"},
    "jpeg_xl": {"compression": 52546, "code": writer.jpeg_xl, "extra": [(52553, writer.RATIONAL, 0)]},
    "jpeg_xl_tiles": {"compression": 52546, "code": writer.jpeg_xl, "piece": (32, 48), "tiled": True},
    "sub_directory": {"main": [(50734, writer.RATIONAL, 1)]},
}  # fmt: skip


@pytest.mark.parametrize("channels", [0, 3], ids=["mosaic", "linear"])
@pytest.mark.parametrize("coding", CODINGS)
def test_every_coding_gives_back_what_was_written(tmp_path, coding, channels):
    options = CODINGS[coding]
    bits = options.get("bits", 16)
    samples = picture(channels=channels, top=min(2**bits, 15000))
    extra = [*options.get("extra", ())]
    if bits < 14:
        extra += [(50714, SHORT, [16] * (channels or 1)), (50717, LONG, [2**bits - 1] * (channels or 1))]
    path = write_dng(tmp_path / "a.dng", samples, **{**options, "extra": extra})
    frame = read_metadata(path)
    assert frame.cfa == ("" if channels else "RGGB")
    assert frame.black.shape == ((1, 3) if channels else (2, 2))
    found = read_mosaic(path, frame)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, samples)


@pytest.mark.parametrize("coding", ["plain", "plain_tiles", "14_bits", "lossless_jpeg", "lossless_jpeg_tiles"])
def test_libraw_reads_the_same(tmp_path, coding):
    """A second reader that shares no code with ours."""
    import rawpy

    tiles = {"piece": (32, 32)} if "tiles" in coding else {}  # LibRaw 0.22.2 misreads tiles of 48 in lossless JPEG
    path = write_dng(tmp_path / "a.dng", picture(64, 96), **{**CODINGS[coding], **tiles})
    with rawpy.imread(str(path)) as raw:
        np.testing.assert_array_equal(raw.raw_image, back(path))


@pytest.mark.parametrize("bits", [16, 24, 32])
@pytest.mark.parametrize("stride", [None, 0, 1, 2])
@pytest.mark.parametrize("channels", [0, 3])
def test_floating_point(tmp_path, bits, stride, channels):
    """Values that a 16-bit float holds exactly come back exactly; negatives are kept."""
    rng = np.random.default_rng(1)
    shape = (24, 32, channels) if channels else (24, 32)
    samples = (rng.integers(-100, 2000, shape) / 1024).astype(np.float32)
    coding = {"code": writer.plain(bits), "compression": 1}
    if stride is not None:
        coding = {"code": writer.deflated(bits, stride=stride), "compression": 8}
    predictor = {None: 1, 0: 1, 1: 3, 2: 34894}[stride]
    path = write_dng(
        tmp_path / "a.dng", samples, bits=bits, without=[50714, 50717], extra=[(317, SHORT, predictor)], **coding
    )
    frame = read_metadata(path)
    assert (frame.white, frame.black.max()) == (1.0, 0.0)  # DNG's defaults for floating point
    found = read_mosaic(path, frame)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, samples)


@pytest.mark.parametrize("cfa", dng.BAYER)
@pytest.mark.parametrize(("top", "left"), list(itertools.product((0, 1, 2, 3), repeat=2)))
def test_every_phase_in_every_odd_active_area(tmp_path, cfa, top, left):
    """CFA and BlackLevel start at the active area's corner (LibRaw moves odd margins and mislabels the colours)."""
    samples = np.zeros((40, 44), np.uint16)
    levels = {"R": 3000, "G": 6000, "B": 4000}
    bottom, right = 37, 42
    inside = np.array([[levels[c] for c in row] for row in (cfa[:2], cfa[2:])])
    samples[top:bottom, left:right] = np.tile(inside, (20, 22))[: bottom - top, : right - left]
    extra = [
        (50829, LONG, (top, left, bottom, right)),
        (50713, SHORT, (2, 2)),
        (50714, SHORT, (500, 510, 520, 530)),
    ]
    path = write_dng(tmp_path / "a.dng", samples, cfa=cfa, extra=extra)
    frame = read_metadata(path)
    assert (frame.width, frame.height, frame.cfa) == (right - left, bottom - top, cfa)
    np.testing.assert_array_equal(frame.black, [[500, 510], [520, 530]])
    found = read_mosaic(path, frame)
    for place, letter in zip(np.ndindex(2, 2), frame.cfa):
        assert set(np.unique(found[place[0] :: 2, place[1] :: 2])) == {levels[letter]}


def test_black_of_linear_files_is_per_channel(tmp_path):
    path = write_dng(tmp_path / "a.dng", picture(channels=3), extra=[(50714, SHORT, (64, 65, 66))])
    np.testing.assert_array_equal(read_metadata(path).black, [[64, 65, 66]])


def test_black_deltas_are_subtracted_and_clipped_samples_stay(tmp_path):
    along, down = np.linspace(-4, 4, 80), np.where(np.arange(60) % 7 == 0, 3.0, 0.0)
    flat = np.full((60, 80), 3000.0)
    stored = (flat + along + down[:, None]).round().astype(np.uint16)
    stored[5, 5] = 15800
    extra = [(50715, SRATIONAL, along), (50716, SRATIONAL, down)]
    path = write_dng(tmp_path / "a.dng", stored, extra=extra)
    frame = read_metadata(path)
    assert frame.black[0, 0] == pytest.approx(512 + along.mean() + down.mean(), abs=1e-4)
    assert any("black differs along rows" in mark for mark in frame.marks)
    found = read_mosaic(path, frame)
    assert found[5, 5] == 15800
    # what is left is the rounding of the samples (half a DN) and of the rationals
    assert np.abs(np.delete(found.ravel(), 5 * 80 + 5) - 3000 - down.mean()).max() <= 0.5 + 1e-3


def test_linearization_table_is_applied(tmp_path):
    table = (np.arange(200) ** 2 // 4).astype(np.uint16)
    stored = picture(top=255)
    path = write_dng(tmp_path / "a.dng", stored, bits=8, extra=[(50712, SHORT, table), (50717, LONG, 9900)])
    frame = read_metadata(path)
    np.testing.assert_array_equal(read_mosaic(path, frame), table[np.minimum(stored, 199)])
    assert any("8-bit samples" in mark for mark in frame.marks)


def test_interleaved_rows_and_columns_of_jpeg_xl(tmp_path):
    """DNG 1.7 stores a mosaic as four quarter pictures of one colour each."""
    samples = picture(61, 83)
    rows, columns = (np.concatenate([np.arange(f, n, 2) for f in (0, 1)]) for n in samples.shape)
    extra = [(50975, LONG, 2), (52547, LONG, 2), (52553, writer.RATIONAL, 0)]
    path = write_dng(
        tmp_path / "a.dng", samples[rows][:, columns], writer.jpeg_xl, compression=52546, extra=extra,
        piece=(32, 32), tiled=True,
    )  # fmt: skip
    frame = read_metadata(path)
    np.testing.assert_array_equal(read_mosaic(path, frame), samples)
    assert frame.marks == []


def test_lossy_codings_are_marked(tmp_path):
    import imagecodecs

    smooth = np.add.outer(np.arange(64), np.arange(64)).astype(np.uint16) * 100 + 600
    lossy = write_dng(
        tmp_path / "xl.dng", smooth, lambda piece: writer.jpeg_xl(piece, 1.0), compression=52546,
        extra=[(52553, writer.RATIONAL, 1)],
    )  # fmt: skip
    assert any("JPEG XL of distance 1" in mark for mark in read_metadata(lossy).marks)
    assert np.abs(back(lossy).astype(float) - smooth).mean() < 200  # near, not the same
    grey = np.repeat((smooth // 64).astype(np.uint8)[..., None], 3, 2)
    jpeg = write_dng(
        tmp_path / "jpeg.dng", grey, lambda piece: imagecodecs.jpeg8_encode(piece, level=95), compression=34892,
        bits=8, extra=[(50714, SHORT, [2] * 3), (50717, LONG, [255] * 3)],
    )  # fmt: skip
    marks = read_metadata(jpeg).marks
    assert any("lossy JPEG" in mark for mark in marks)
    assert any("8-bit samples" in mark for mark in marks)
    assert np.abs(back(jpeg).astype(float) - grey).max() <= 8


@pytest.mark.parametrize(("top", "left"), [(0, 0), (1, 3)])
def test_xtrans_keeps_measured_samples_and_what_lies_below_black(tmp_path, top, left):
    rng = np.random.default_rng(3)
    pattern = np.array(["RGB".index(c) for c in writer.XTRANS]).reshape(6, 6)
    level = np.array([700.0, 900.0, 600.0])
    colours = np.tile(pattern, (86, 87))[:513, :520]  # LibRaw refuses pictures below 512
    seen = np.clip(rng.normal(level[colours], 120), 0, 15000).round().astype(np.uint16)
    stored = np.pad(seen, ((top, 0), (left, 0)))
    extra = [(50829, LONG, (top, left, *stored.shape))]
    path = write_dng(tmp_path / "a.dng", stored, cfa=writer.XTRANS, extra=extra)
    frame = read_metadata(path)
    assert (frame.cfa, frame.black.shape) == ("", (1, 3))
    assert any("X-Trans" in mark for mark in frame.marks)
    found = read_mosaic(path, frame)
    inner = (slice(8, -8), slice(8, -8))
    own = np.take_along_axis(found, colours[..., None], 2)[..., 0]
    np.testing.assert_array_equal(own[inner], seen[inner])
    assert found[..., 2].min() < 512  # noise below black is not cut off
    # 4 standard errors of the mean; the demosaic averages, so the spread of a plane is at most that of a photosite
    np.testing.assert_allclose(found[inner].mean((0, 1)), level, atol=4 * 120 / np.sqrt(500 * 500 * 2 / 9))


def test_metadata_of_lens_colour_and_linearity(tmp_path):
    forward = np.array([[0.6, 0.2, 0.16], [0.25, 0.7, 0.05], [0.02, 0.1, 0.7]])
    vignette = writer.opcode_list((3, 1, struct.pack(">7d", 0.3, 0.2, 0.1, 0, 0, 0.5, 0.5)))
    path = write_dng(
        tmp_path / "a.dng", picture(), main=[
            (50964, SRATIONAL, forward), (50965, SRATIONAL, forward.T), (50723, SRATIONAL, np.diag([1.1, 1, 0.9])),
            (50727, writer.RATIONAL, (1, 1.2, 1)), (50734, writer.RATIONAL, 0.9),
        ], extra=[(51022, UNDEFINED, vignette), (51041, DOUBLE, (1e-4, 1e-8))],
    )  # fmt: skip
    frame = read_metadata(path)
    assert (frame.lens, frame.focal_mm, frame.focal_35mm) == ("Maker 35 mm", 35, 52)
    assert frame.linear_limit == pytest.approx(0.9)
    np.testing.assert_allclose(frame.color_matrix, np.diag([1.1, 1.2, 0.9]) @ writer.MATRIX, atol=1e-9)
    np.testing.assert_allclose(frame.forward_matrix, forward, atol=1e-9)  # a diagonal calibration cancels
    np.testing.assert_allclose(frame.forward_matrix_2, forward.T, atol=1e-9)
    np.testing.assert_allclose(frame.vignetting, [0.3, 0.2, 0.1, 0, 0, 0.5, 0.5])
    np.testing.assert_allclose(frame.noise_profile, [1e-4, 1e-8])
    assert (frame.exposure_s, frame.iso, frame.fnumber) == (pytest.approx(1 / 60, rel=3e-3), 200, 5.6)


def test_forward_matrix_with_a_calibration_that_mixes_channels_is_left_out(tmp_path):
    mixing = np.eye(3) + 0.01
    path = write_dng(tmp_path / "a.dng", picture(), extra=[(50964, SRATIONAL, np.eye(3)), (50723, SRATIONAL, mixing)])
    frame = read_metadata(path)
    assert frame.forward_matrix is None
    assert any("ForwardMatrix left out" in mark for mark in frame.marks)


def test_defects_that_the_file_lists(tmp_path):
    points = struct.pack(">IIIIIII", 0, 2, 1, 10, 12, 3, 4) + struct.pack(">IIII", 20, 30, 22, 31)
    lists = writer.opcode_list((5, 0, points), (4, 0, struct.pack(">II", 0, 0)), (9, 1, b"1234"))
    samples = picture() + np.uint16(1)
    samples[33, 44] = 0
    extra = [(51008, UNDEFINED, lists), (50829, LONG, (2, 4, 60, 80))]
    path = write_dng(tmp_path / "a.dng", samples, extra=extra)
    frame = read_metadata(path)
    assert frame.bad_pixels.tolist() == [[1, 0], [8, 8], [18, 26], [19, 26]]
    assert read_sensor(path, frame).defects.tolist() == [[31, 40]]
    assert frame.marks == ["OpcodeList1 GainMap is not applied"]


@pytest.mark.parametrize("number", [7, 8, 12])
def test_curves_in_opcodes_are_refused_unless_optional(tmp_path, number):
    for optional in (0, 1):
        lists = writer.opcode_list((number, optional, b"abcd"))
        path = write_dng(tmp_path / "a.dng", picture(), extra=[(51009, UNDEFINED, lists)])
        if optional:
            assert "is not applied" in read_metadata(path).marks[0]
        else:
            with pytest.raises(CaptureError, match="OpcodeList2 maps samples by"):
                read_metadata(path)


def test_white_that_nobody_states_is_no_guess(tmp_path):
    assert read_metadata(write_dng(tmp_path / "a.dng", picture(), bits=14, without=[50717])).white == 2**14 - 1
    table = [(50712, SHORT, np.arange(256) * 16)]
    path = write_dng(tmp_path / "b.dng", picture(top=255), bits=8, extra=table, without=[50717, 50714])
    assert read_metadata(path).white == 0


REFUSED = {
    "quad bayer": ({"cfa": "RRGGRRGGGGBBGGBB"}, "X-Trans"),
    "colours": ({"extra": [(33422, BYTE, (0, 1, 1, 3))]}, "colour filter 00010103"),
    "staggered": ({"extra": [(50711, SHORT, 2)]}, "staggered"),
    "32 bits": ({"bits": 32, "code": lambda piece: piece.astype("<u4").tobytes()}, "samples of 32 bits"),
    "codec": ({"compression": 34713}, "compression 34713"),
    "black": ({"extra": [(50714, SHORT, 15800)]}, "not below WhiteLevel"),
    "black cell": ({"extra": [(50713, SHORT, (1, 4)), (50714, SHORT, (1, 2, 3, 4))]}, "BlackLevel repeats"),
    "area": ({"extra": [(50829, LONG, (0, 0, 61, 80))]}, "lies outside"),
    "limit": ({"extra": [(50734, SRATIONAL, 1.5)]}, "LinearResponseLimit is 1.5"),
    "preview only": ({"extra": [(254, LONG, 1)]}, "no sensor data"),
    "too long": ({"extra": [(257, LONG, 30)], "piece": (30, 80)}, "2 pieces of the picture, its size needs 1"),
    "too wide": ({"extra": [(256, LONG, 81)]}, "its samples need"),
    "huge": ({"extra": [(256, LONG, 2**31), (257, LONG, 2**31)]}, "copy the file again"),
    "bits": ({"bits": 14, "code": writer.plain(16)}, "its samples need"),
    "list": ({"extra": [(51008, UNDEFINED, struct.pack(">IIIII", 1, 5, 0, 0, 99))]}, "OpcodeList"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, case):
    options, words = REFUSED[case]
    path = write_dng(tmp_path / "a.dng", picture(), **options)
    with pytest.raises(CaptureError, match=words) as error:
        read_metadata(path)
    assert str(error.value).startswith("a.dng: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("coding", ["plain", "12_bits", "lossless_jpeg", "deflate", "jpeg_xl", "lossless_jpeg_tiles"])
@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_truncated_data_are_refused(tmp_path, coding, share):
    path = write_dng(tmp_path / "a.dng", picture(top=4000), **CODINGS[coding])
    frame, data = read_metadata(path), path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(CaptureError):
        read_metadata(path)
    with pytest.raises(CaptureError):
        read_mosaic(path, frame)


@pytest.mark.parametrize("coding", ["lossless_jpeg", "deflate", "jpeg_xl"])
def test_a_piece_that_ends_early_is_refused(tmp_path, coding):
    """The file has all its bytes, but the last quarter of the picture is zeros, as a bad card leaves it."""
    path = write_dng(tmp_path / "a.dng", picture(top=4000), **CODINGS[coding])
    data = path.read_bytes()
    path.write_bytes(data[: int(0.75 * len(data))] + bytes(len(data) - int(0.75 * len(data))))
    with pytest.raises(CaptureError, match="is damaged"):
        back(path)


def test_samples_without_content_are_refused(tmp_path):
    for value in (0, 512, 700):
        path = write_dng(tmp_path / "a.dng", np.full((60, 80), value, np.uint16))
        with pytest.raises(CaptureError, match=f"every pixel is {value}"):
            back(path)
    assert back(write_dng(tmp_path / "b.dng", np.full((60, 80), 15800, np.uint16))).min() == 15800
    hole = np.ones((60, 80), np.float32)
    hole[0, 0] = np.nan
    path = write_dng(tmp_path / "c.dng", hole, bits=32, without=[50714, 50717])
    with pytest.raises(CaptureError, match="1 values that are no number"):
        back(path)


@pytest.mark.parametrize("said", dng.BAYER)
def test_a_pattern_that_its_own_picture_contradicts_is_refused(tmp_path, said):
    """Greens of one sensor agree; red and blue exchanged cannot be told from the samples, nor can a grey scene."""
    rng = np.random.default_rng(4)
    light = rng.uniform(500, 4000, (160, 192))
    gains = np.tile([[0.5, 1.0], [1.01, 0.75]], (80, 96))  # RGGB
    coloured = (512 + light * gains).round().astype(np.uint16)
    path = write_dng(tmp_path / "a.dng", coloured, cfa=said)
    if said in ("RGGB", "BGGR"):
        np.testing.assert_array_equal(back(path), coloured)
    else:
        with pytest.raises(CaptureError, match=f"its pattern {said} calls green differ by 4"):
            back(path)
    grey = write_dng(tmp_path / "b.dng", (512 + light).round().astype(np.uint16), cfa=said)
    assert back(grey).shape == light.shape


@pytest.mark.parametrize("rows", [1, 15])
def test_rows_without_data_are_refused(tmp_path, rows):
    """An uncompressed file whose end the card lost has all its bytes, and zeros for a picture."""
    path = write_dng(tmp_path / "a.dng", picture() + np.uint16(400))
    data = path.read_bytes()
    path.write_bytes(data[: -rows * 160] + bytes(rows * 160))
    with pytest.raises(CaptureError, match=f"{rows} of 60 rows hold nothing but 0"):
        back(path)


def test_a_second_picture_is_pointed_at(tmp_path):
    """Sensor shift and bursts put several into one file."""
    more = [(262, SHORT, 32803), (254, LONG, 0), (256, LONG, 8), (257, LONG, 8)]
    path = write_dng(tmp_path / "a.dng", picture(), main=more)
    frame = read_metadata(path)
    assert frame.marks == ["holds 2 pictures of sensor data; the first of the largest is read"]
    np.testing.assert_array_equal(read_mosaic(path, frame), picture())
