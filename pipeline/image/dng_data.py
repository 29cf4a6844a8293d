"""The samples of a DNG: where its tags say they lie, checked, decoded by imagecodecs, put together.

A damaged header must not decode to another picture in silence, so everything a file says twice is compared: number,
order and place of the pieces, stored bytes against size and depth, the size inside each JPEG against its tile, the
checksum and length of deflated data. LibRaw decodes a DNG with missing tiles to zeros without an error.

Compressions: none, lossless JPEG (ITU-T T.81), deflate with the predictors of TIFF and DNG (also floating point), lossy
JPEG, JPEG XL (DNG 1.7, with its interleaved rows and columns). Integers of 8 to 16 bits come out as uint16 DN after
LinearizationTable, floating point of 16, 24 and 32 bits as float32.
"""

from __future__ import annotations

import os
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.image.dng import floating
from pipeline.image.tags import Tags, numbers, occupied, tags_of, whole
from pipeline.run.errors import CaptureError

NONE, JPEG, DEFLATE, LOSSY_JPEG, JPEG_XL = 1, 7, 8, 34892, 52546
COMPRESSIONS = (NONE, JPEG, DEFLATE, LOSSY_JPEG, JPEG_XL)
STRIDES = {1: 0, 2: 1, 34892: 2, 34893: 4, 3: 1, 34894: 2, 34895: 4}  # predictor -> pixels between the differences
FLOAT_PREDICTORS = (3, 34894, 34895)
JPEG_END = b"\xff\xd9"
MAX_PIXELS = 2**30  # four times the largest sensor made; more is a damaged size


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the samples of one directory lie and how they are coded. Pieces are strips (full width) or tiles."""

    height: int
    width: int
    samples: int
    bits: int
    floating: bool
    compression: int
    predictor: int
    big_endian: bool
    piece: tuple[int, int]  # rows, columns
    tiled: bool
    offsets: np.ndarray  # (N,) bytes from the file's start
    counts: np.ndarray  # (N,)
    interleave: tuple[int, int]  # fields of rows, of columns
    tables: bytes | None
    linearization: np.ndarray | None  # uint16

    @property
    def across(self) -> int:
        """Pieces side by side."""
        return -(-self.width // self.piece[1])

    def box(self, index: int) -> tuple[int, int, int, int]:
        """Top, left, rows and columns of a piece within the picture."""
        top, left = index // self.across * self.piece[0], index % self.across * self.piece[1]
        return top, left, min(self.piece[0], self.height - top), min(self.piece[1], self.width - left)


def layout_of(name: str, tiff: Any, page: Any, pages: list[Any], file_size: int) -> Layout:
    """Layout of a raw directory, checked against the file. Raises CaptureError, one line."""
    tags = tags_of(page)
    tiled = 324 in tags
    height, width = whole(tags, 257, 0), whole(tags, 256, 0)
    offsets, counts = numbers(tags, 324 if tiled else 273), numbers(tags, 325 if tiled else 279)
    if offsets is None or counts is None:
        raise CaptureError(f"{name}: declares no image data; copy the file again")
    table = numbers(tags, 50712)
    layout = Layout(
        height=height,
        width=width,
        samples=whole(tags, 277, 1),
        bits=whole(tags, 258, 1),
        floating=floating(tags),
        compression={32946: DEFLATE}.get(whole(tags, 259, 1), whole(tags, 259, 1)),
        predictor=whole(tags, 317, 1),
        big_endian=page.parent.byteorder == ">",
        piece=(whole(tags, 323, 0), whole(tags, 322, 0)) if tiled else (min(whole(tags, 278, height), height), width),
        tiled=tiled,
        offsets=offsets.astype(np.int64),
        counts=counts.astype(np.int64),
        interleave=(whole(tags, 50975, 1), whole(tags, 52547, 1)),
        tables=bytes(tags[347].value) if 347 in tags else None,
        linearization=None if table is None else table.clip(0, 65535).astype(np.uint16),
    )
    _check_coding(name, tags, layout)
    _check_pieces(name, layout, file_size)
    check_places(name, layout.offsets, layout.counts, tiff, pages)
    return layout


def _check_coding(name: str, tags: Tags, layout: Layout) -> None:
    size = f"{layout.width} x {layout.height}"
    if min(layout.height, layout.width, *layout.piece) < 1 or layout.height * layout.width > MAX_PIXELS:
        raise CaptureError(f"{name}: says it is {size} in pieces of {layout.piece}; copy the file again")
    if layout.compression not in COMPRESSIONS or layout.predictor not in STRIDES:
        raise CaptureError(
            f"{name}: compression {layout.compression} with predictor {layout.predictor} is not read; convert the file "
            "to a DNG of lossless JPEG"
        )
    depths = (16, 24, 32) if layout.floating else range(8, 17)
    depth = numbers(tags, 258)
    if layout.bits not in depths or depth is None or np.ptp(depth) > 0 or whole(tags, 339, 1) not in (1, 3):
        raise CaptureError(
            f"{name}: samples of {layout.bits} bits, format {whole(tags, 339, 1)}; needed integers of 8 to 16 or "
            "floating point of 16 to 32; convert the file"
        )
    if layout.floating and layout.compression not in (NONE, DEFLATE):
        raise CaptureError(f"{name}: floating point in compression {layout.compression} is not read; convert the file")
    if layout.samples > 1 and whole(tags, 284, 1) != 1:
        raise CaptureError(f"{name}: channels are stored apart, needed together; convert the file")
    if whole(tags, 266, 1) != 1:
        raise CaptureError(f"{name}: FillOrder {whole(tags, 266, 1)} is not read; convert the file")
    if not all(1 <= fields <= 8 for fields in layout.interleave):
        raise CaptureError(f"{name}: rows and columns interleaved {layout.interleave} is not read; convert the file")


def _check_pieces(name: str, layout: Layout, file_size: int) -> None:
    """Number and bytes of the pieces; uncompressed ones are exactly as long as their samples."""
    expected = layout.across * -(-layout.height // layout.piece[0])
    found = min(len(layout.offsets), len(layout.counts))
    if found < expected:
        raise CaptureError(f"{name}: {found} of {expected} pieces of the picture are there; copy the file again")
    if found > expected or len(layout.offsets) != len(layout.counts):
        raise CaptureError(
            f"{name}: {len(layout.offsets)} pieces of the picture, its size needs {expected}; copy the file again"
        )
    if (end := int((layout.offsets + layout.counts).max())) > file_size:
        raise CaptureError(f"{name}: {file_size} bytes, its image data end at {end}; copy the file again")
    if layout.compression == NONE:
        for index, count in enumerate(layout.counts.tolist()):
            if count not in _byte_counts(layout, index):
                raise CaptureError(
                    f"{name}: piece {index} has {count} bytes, its samples need {_byte_counts(layout, index)[0]}; "
                    "copy the file again"
                )


def _byte_counts(layout: Layout, index: int) -> list[int]:
    """Bytes of a piece's samples: of its rows in the picture, or of a whole piece (always so for tiles)."""
    row = -(-layout.piece[1] * layout.samples * layout.bits // 8)
    rows = layout.piece[0] if layout.tiled else layout.box(index)[2]
    return list(dict.fromkeys([rows * row, layout.piece[0] * row]))


def check_places(name: str, offsets: np.ndarray, counts: np.ndarray, tiff: Any, pages: list[Any]) -> None:
    """Raises CaptureError where pieces (N,) overlap each other, a directory or its values: so a wrong offset shows."""
    ranges = [(0, 8, "header"), *occupied(tiff, pages)]
    ranges += [(start, start + size, "picture") for start, size in zip(offsets.tolist(), counts.tolist())]
    furthest, what = 0, ""
    for start, stop, kind in sorted(ranges):
        if start < furthest and "picture" in (kind, what):
            other = what if what != "picture" else kind
            raise CaptureError(f"{name}: its picture and its {other} overlap at byte {start}; copy the file again")
        if stop > furthest:
            furthest, what = stop, kind


def read_samples(name: str, path: Path, layout: Layout) -> np.ndarray:
    """Samples as stored, (H, W) or (H, W, 3), uint16 or float32. Raises CaptureError for pieces that do not decode."""
    shape = (layout.height, layout.width, layout.samples)
    picture = np.empty(shape, np.float32 if layout.floating else np.uint16)

    def place(index: int) -> None:
        top, left, height, width = layout.box(index)
        with path.open("rb") as stream:
            stream.seek(int(layout.offsets[index]))
            data = stream.read(int(layout.counts[index]))
        picture[top : top + height, left : left + width] = _decoded(name, data, layout, index)[:height, :width]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(place, range(len(layout.offsets))))
    picture = _deinterleaved(picture, layout.interleave)
    if layout.linearization is not None and not layout.floating:
        table = layout.linearization
        picture = table[np.minimum(picture, len(table) - 1)]
    return picture[..., 0] if layout.samples == 1 else picture


def _deinterleaved(picture: np.ndarray, fields: tuple[int, int]) -> np.ndarray:
    """Rows and columns that are stored field by field (all even ones first) in their places."""
    for axis, count in enumerate(fields):
        if count > 1:
            size = picture.shape[axis]
            order = np.concatenate([np.arange(field, size, count) for field in range(count)])
            result = np.empty_like(picture)
            result[(slice(None),) * axis + (order,)] = picture
            picture = result
    return picture


def _decoded(name: str, data: bytes, layout: Layout, index: int) -> np.ndarray:
    """One piece, (rows, columns, samples) of at least its part of the picture."""
    try:
        if layout.compression in (NONE, DEFLATE):
            piece = _unpacked(_inflated(data, layout, index), layout)
        else:
            piece = _shaped(_image(data, layout), layout, index)
    except (ValueError, RuntimeError, zlib.error, OverflowError, MemoryError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CaptureError(f"{name}: piece {index} of the picture is damaged ({reason}); copy it again") from error
    if layout.bits < 16 and piece.max(initial=0) >= 2**layout.bits:
        raise CaptureError(
            f"{name}: piece {index} reaches {piece.max()}, {layout.bits} bits were declared; copy it again"
        )
    if layout.floating and not np.all(np.isfinite(piece)):
        raise CaptureError(f"{name}: piece {index} holds {np.sum(~np.isfinite(piece))} values that are no number")
    return piece


def _inflated(data: bytes, layout: Layout, index: int) -> bytes:
    """Bytes of the samples; deflated data must end, with a good checksum, exactly where the samples do."""
    if layout.compression == NONE:
        return data
    sizes = _byte_counts(layout, index)
    stream = zlib.decompressobj()
    result = stream.decompress(data, max(sizes) + 1)
    if len(result) not in sizes or not stream.eof:
        raise ValueError(f"{len(result)} bytes, needed {sizes[0]}")
    return result


def _unpacked(data: bytes, layout: Layout) -> np.ndarray:
    """(rows, columns, samples) of a piece's bytes, differences summed."""
    import imagecodecs

    columns, samples, bits = layout.piece[1], layout.samples, layout.bits
    order: Literal["<", ">"] = ">" if layout.big_endian else "<"
    if layout.floating:
        return _floats(data, layout, order)
    if bits == 8:
        values = np.frombuffer(data, np.uint8)
    elif bits == 16:
        values = np.frombuffer(data, order + "u2").astype(np.uint16, copy=False)
    else:
        values = imagecodecs.packints_decode(data, np.dtype("u2"), bits, runlen=columns * samples)
    values = values.reshape(-1, columns, samples)
    if layout.predictor in FLOAT_PREDICTORS:
        raise ValueError("a floating point predictor on integers")
    return _summed(values, STRIDES[layout.predictor])


def _summed(values: np.ndarray, stride: int) -> np.ndarray:
    """Horizontal differences between pixels ``stride`` apart, summed in the width of the type."""
    if stride == 0:
        return values
    rows, columns, samples = values.shape
    if columns % stride:
        raise ValueError(f"{columns} columns, predicted over {stride}")
    grouped = values.reshape(rows, columns // stride, stride * samples)
    return np.cumsum(grouped, axis=1, dtype=values.dtype).reshape(values.shape)


def _floats(data: bytes, layout: Layout, order: Literal["<", ">"]) -> np.ndarray:
    """float32 (rows, columns, samples); the predictor differences bytes, most significant plane first (TIFF note 3)."""
    import imagecodecs

    width, n = layout.piece[1] * layout.samples, layout.bits // 8
    if layout.predictor in FLOAT_PREDICTORS:
        stride = STRIDES[layout.predictor] * layout.samples
        planes = np.frombuffer(data, np.uint8).reshape(-1, n * width // stride, stride)
        planes = np.cumsum(planes, axis=1, dtype=np.uint8).reshape(-1, n, width)
        data, order = np.ascontiguousarray(planes.transpose(0, 2, 1)).tobytes(), ">"
    elif layout.predictor != 1:
        raise ValueError(f"predictor {layout.predictor} on floating point")
    if layout.bits == 24:
        values = imagecodecs.float24_decode(data, byteorder=order)
    else:
        values = np.frombuffer(data, f"{order}f{n}").astype(np.float32)
    return np.asarray(values).reshape(-1, layout.piece[1], layout.samples)


def _image(data: bytes, layout: Layout) -> np.ndarray:
    """A piece that is a coded image, as its own header says its shape."""
    import imagecodecs

    if layout.compression != JPEG_XL and JPEG_END not in data[-64:]:
        raise ValueError("no end marker")  # decoders fill up what is missing
    if layout.compression == JPEG_XL:
        image = imagecodecs.jpegxl_decode(data, numthreads=1)
    elif layout.compression == JPEG and b"\xff\xc3" in data[:1024]:
        image = imagecodecs.ljpeg_decode(data)
    else:
        image = imagecodecs.jpeg8_decode(data, tables=layout.tables)
    image = np.asarray(image)
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"decodes to {image.dtype}")
    return image


def _shaped(image: np.ndarray, layout: Layout, index: int) -> np.ndarray:
    """A decoded image as (rows, columns, samples): a whole piece, or its part within the picture.

    Lossless JPEG fills the piece in decoding order: two photosites may be one pixel of two components, and two rows one
    of twice the width.
    """
    rows, columns = layout.piece
    for height, width in dict.fromkeys([(rows, columns), layout.box(index)[2:]]):
        if image.size == height * width * layout.samples and image.shape[0] in (height, height // 2):
            return image.reshape(height, width, layout.samples)
    raise ValueError(f"is {image.shape}, needed {rows} x {columns} of {layout.samples}")
