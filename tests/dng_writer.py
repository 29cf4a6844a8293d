"""DNGs of any coding for tests of the reader, written from tags and pieces; shares no code with what reads them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
FORMATS = {BYTE: "B", SHORT: "H", LONG: "I", DOUBLE: "d"}
CFA, LINEAR = 32803, 34892
MATRIX = np.array([[0.742, -0.205, -0.062], [-0.456, 1.248, 0.233], [-0.106, 0.215, 0.648]])
XTRANS = "GBGGRGRGRBGBGBGGRGGRGGBGBGBRGRGRGGBG"  # a 6x6 cell: each row and column has all three colours

Entry = tuple[int, int, Any]


def packed(kind: int, values: Any, order: str) -> tuple[int, bytes]:
    """Count and bytes of a TIFF field."""
    if kind == ASCII:
        data = str(values).encode() + b"\0"
        return len(data), data
    if isinstance(values, bytes):
        return len(values), values
    items = np.ravel(values).tolist()
    if kind in (RATIONAL, SRATIONAL):
        code = order + ("II" if kind == RATIONAL else "ii")
        return len(items), b"".join(struct.pack(code, round(item * 10000), 10000) for item in items)
    return len(items), struct.pack(f"{order}{len(items)}{FORMATS[kind]}", *items)


def directory(entries: Iterable[Entry], offset: int, order: str) -> bytes:
    """One IFD at ``offset`` with the values that do not fit into it behind it."""
    entries = sorted(entries, key=lambda entry: entry[0])
    at = offset + 2 + 12 * len(entries) + 4
    result, data = struct.pack(order + "H", len(entries)), b""
    for tag, kind, values in entries:
        count, payload = packed(kind, values, order)
        field = payload.ljust(4, b"\0")
        if len(payload) > 4:
            data += b"\0" * (len(data) % 2)
            field = struct.pack(order + "I", at + len(data))
            data += payload
        result += struct.pack(order + "HHI", tag, kind, count) + field
    return result + struct.pack(order + "I", 0) + data + b"\0" * (len(data) % 2)


def pieces_of(samples: np.ndarray, size: tuple[int, int], tiled: bool) -> list[np.ndarray]:
    """(rows, columns, samples) pieces of a picture; tiles are filled up with their last rows and columns."""
    samples = samples if samples.ndim == 3 else samples[..., None]
    found = []
    for top in range(0, samples.shape[0], size[0]):
        for left in range(0, samples.shape[1], size[1]):
            piece = samples[top : top + size[0], left : left + size[1]]
            if tiled:
                rest = [(0, size[0] - piece.shape[0]), (0, size[1] - piece.shape[1]), (0, 0)]
                piece = np.pad(piece, rest, mode="edge")
            found.append(np.ascontiguousarray(piece))
    return found


def plain(bits: int = 16, order: str = "<") -> Callable[[np.ndarray], bytes]:
    """Uncompressed samples of 8 to 16 bits, rows filled up to whole bytes, or floating point of 16 to 32."""

    def code(piece: np.ndarray) -> bytes:
        if piece.dtype.kind == "f":
            if bits == 24:
                return imagecodecs.float24_encode(piece.astype(np.float32), byteorder=order)
            return piece.astype(f"{order}f{bits // 8}").tobytes()
        if bits in (8, 16):
            return piece.astype(f"{order}u{bits // 8}").tobytes()
        rows = piece.reshape(len(piece), -1)
        shifts = np.arange(bits - 1, -1, -1)
        return np.packbits((rows[..., None] >> shifts & 1).astype(np.uint8).reshape(len(rows), -1), axis=1).tobytes()

    return code


def deflated(bits: int = 16, order: str = "<", stride: int = 0) -> Callable[[np.ndarray], bytes]:
    """Deflated samples, ``stride`` pixels between horizontal differences (0: none)."""

    def code(piece: np.ndarray) -> bytes:
        if piece.dtype.kind == "f" and stride:
            return zlib.compress(float_differences(piece, bits, stride))
        if stride:
            before = np.zeros_like(piece)
            before[:, stride:] = piece[:, :-stride]
            piece = piece - before  # wraps
        return zlib.compress(plain(bits, order)(piece))

    return code


def float_differences(piece: np.ndarray, bits: int, stride: int) -> bytes:
    """Bytes of rows by significance, differences between pixels ``stride`` apart."""
    rows, columns, samples = piece.shape
    data = np.frombuffer(plain(bits, ">")(piece), np.uint8).reshape(rows, columns * samples, bits // 8)
    planes = data.transpose(0, 2, 1).reshape(rows, -1)
    step = stride * samples
    before = np.zeros_like(planes)
    before[:, step:] = planes[:, :-step]
    return (planes - before).tobytes()


def lossless_jpeg(piece: np.ndarray) -> bytes:
    """One component per sample; a mosaic's two neighbours become one pixel of two components."""
    rows, columns, samples = piece.shape
    shape = (rows, columns // 2, 2) if samples == 1 and columns % 2 == 0 else (rows, columns)
    return imagecodecs.jpeg8_encode(piece.reshape(shape) if samples == 1 else piece, lossless=True, bitspersample=16)


def jpeg_xl(piece: np.ndarray, distance: float = 0.0) -> bytes:
    piece = piece[..., 0] if piece.shape[2] == 1 else piece
    if distance:
        return imagecodecs.jpegxl_encode(piece, distance=distance)
    return imagecodecs.jpegxl_encode(piece, lossless=True)


def write_dng(
    path: Path,
    samples: np.ndarray,
    code: Callable[[np.ndarray], bytes] | None = None,
    *,
    compression: int = 1,
    piece: tuple[int, int] | None = None,
    tiled: bool = False,
    bits: int = 16,
    order: str = "<",
    cfa: str = "RGGB",
    extra: Iterable[Entry] = (),
    without: Iterable[int] = (),
    main: Iterable[Entry] | None = None,
) -> Path:
    """A DNG of stored samples (H, W) or (H, W, 3).

    ``extra`` replaces or adds tags, ``without`` drops some. With ``main`` the picture lies in a SubIFD, and these tags
    are added to the first directory. Levels: black 512, white 15800; 1/60 s, ISO 200, f/5.6.
    """
    height, width = samples.shape[:2]
    piece = piece or (height, width)
    code = code or plain(bits, order)
    data = [code(one) for one in pieces_of(samples, piece, tiled)]
    channels = 1 if samples.ndim == 2 else samples.shape[2]
    places = (324, 325) if tiled else (273, 279)
    raw: dict[int, Entry] = {entry[0]: entry for entry in [
        (254, LONG, 0), (256, LONG, width), (257, LONG, height), (258, SHORT, [bits] * channels),
        (259, SHORT, compression), (262, SHORT, CFA if channels == 1 else LINEAR), (277, SHORT, channels),
        (284, SHORT, 1), (50714, SHORT, [512] * channels), (50717, LONG, [15800] * channels),
    ]}  # fmt: skip
    if channels == 1:
        side = int(np.sqrt(len(cfa)))
        raw |= {33421: (33421, SHORT, (side, side)), 33422: (33422, BYTE, ["RGB".index(c) for c in cfa])}
    if samples.dtype.kind == "f":
        raw[339] = (339, SHORT, [3] * channels)
    if tiled:
        raw |= {322: (322, LONG, piece[1]), 323: (323, LONG, piece[0])}
    else:
        raw[278] = (278, LONG, piece[0])
    colour = [
        (271, ASCII, "Maker"), (272, ASCII, "One"), (50706, BYTE, (1, 7, 1, 0)), (50708, ASCII, "Maker One"),
        (50721, SRATIONAL, MATRIX), (50728, RATIONAL, (0.5, 1, 0.75)), (50778, SHORT, 21),
    ]  # fmt: skip
    exif = [
        (33434, RATIONAL, 1 / 60), (33437, RATIONAL, 5.6), (34855, SHORT, 200), (37386, RATIONAL, 35),
        (41989, SHORT, 52), (42036, ASCII, "Maker 35 mm"), (36867, ASCII, "2026:01:02 03:04:05"),
    ]  # fmt: skip
    raw |= {entry[0]: entry for entry in extra}
    first = {entry[0]: entry for entry in [*colour, *(main or ())]}
    for tag in without:
        raw.pop(tag, None)
        first.pop(tag, None)

    def build(offsets: list[int], exif_at: int, raw_at: int) -> tuple[bytes, bytes, bytes]:
        where = [(places[0], LONG, offsets), (places[1], LONG, [len(one) for one in data])]
        here = [*raw.values(), *where]
        link = [*first.values(), (34665, LONG, exif_at)]
        if main is None:
            ifd0, ifd1 = directory([*{e[0]: e for e in [*link, *here]}.values()], 8, order), b""
        else:
            here_first = {entry[0] for entry in first.values()}
            preview = [e for e in ((254, LONG, 1), (256, LONG, 1), (257, LONG, 1)) if e[0] not in here_first]
            preview.append((330, LONG, raw_at))
            ifd0, ifd1 = directory([*link, *preview], 8, order), directory(here, raw_at, order)
        return ifd0, ifd1, directory(exif, exif_at, order)

    ifd0, ifd1, ifd2 = build([0] * len(data), 0, 0)
    raw_at = 8 + len(ifd0)
    exif_at = raw_at + len(ifd1)
    at, offsets = exif_at + len(ifd2), []
    for one in data:
        offsets.append(at)
        at += len(one) + len(one) % 2
    header = struct.pack(order + "2sHI", b"II" if order == "<" else b"MM", 42, 8)
    body = b"".join(one + b"\0" * (len(one) % 2) for one in data)
    path.write_bytes(header + b"".join(build(offsets, exif_at, raw_at)) + body)
    return path


def opcode_list(*entries: tuple[int, int, bytes]) -> bytes:
    """An OpcodeList of (number, flags, data)."""
    return struct.pack(">I", len(entries)) + b"".join(
        struct.pack(">IIII", number, 0x01030000, flags, len(data)) + data for number, flags, data in entries
    )
