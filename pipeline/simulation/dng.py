"""A Bayer mosaic as a DNG: one IFD with the picture, a real ExifIFD, lossless JPEG.

Layout after the DNG specification 1.4 and TIFF 6.0 (little-endian). The lossless JPEG (ITU-T T.81, process 14) of
`imagecodecs` predicts from the sample above and the difference to the left, which in a mosaic are other colours. DNG
readers fill the picture with the samples in the order they are decoded, so two rows of the mosaic are coded as one row
of twice the width: then the sample above has the same colour, and the files are a quarter smaller.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
_FORMATS = {BYTE: "B", SHORT: "H", LONG: "I", DOUBLE: "d"}
_COLOURS = {"R": 0, "G": 1, "B": 2}

Entry = tuple[int, int, object]


@dataclass(frozen=True)
class DngFacts:
    """Everything a DNG says beside its samples.

    ``black``: DN of the 2x2 cell in rows. ``color_matrix``: (3, 3) camera_rgb from XYZ under ``illuminant`` (EXIF
    LightSource code, 21 = D65). ``neutral``: (3,) camera_rgb of that neutral. ``noise``: DNG NoiseProfile (S, O): the
    variance of a normalised sample x in [0, 1] is S x + O.
    """

    exposure: Fraction
    iso: int
    fnumber: Fraction
    focal_mm: Fraction
    timestamp: str  # "YYYY:MM:DD HH:MM:SS"
    make: str
    model: str
    cfa: str
    black: tuple[int, int, int, int]
    white: int
    color_matrix: np.ndarray
    neutral: np.ndarray
    noise: tuple[float, float]
    illuminant: int = 21
    color_matrix_2: np.ndarray | None = None
    illuminant_2: int = 17


def pack(kind: int, values: object) -> tuple[int, bytes]:
    """Count and little-endian bytes of a TIFF field."""
    if kind in (ASCII, UNDEFINED):
        data = str(values).encode("ascii") + (b"\0" if kind == ASCII else b"")
        return len(data), data
    items: list[Any] = list(values) if isinstance(values, (list, tuple, np.ndarray)) else [values]
    if kind in (RATIONAL, SRATIONAL):
        pairs = [(part.numerator, part.denominator) for part in map(Fraction, items)]
        code = "<II" if kind == RATIONAL else "<ii"
        return len(items), b"".join(struct.pack(code, *pair) for pair in pairs)
    return len(items), struct.pack(f"<{len(items)}{_FORMATS[kind]}", *items)


def write_ifd(entries: list[Entry], offset: int) -> bytes:
    """One IFD that starts at ``offset`` of the file, followed by the data of the fields longer than four bytes."""
    entries = sorted(entries, key=lambda entry: entry[0])
    data_offset = offset + 2 + 12 * len(entries) + 4
    directory, data = struct.pack("<H", len(entries)), b""
    for tag, kind, values in entries:
        count, payload = pack(kind, values)
        if len(payload) > 4:
            data += b"\0" * (len(data) % 2)
            field, data = struct.pack("<I", data_offset + len(data)), data + payload
        else:
            field = payload.ljust(4, b"\0")
        directory += struct.pack("<HHI", tag, kind, count) + field
    data += b"\0" * (len(data) % 2)
    return directory + struct.pack("<I", 0) + data


def decimal_fraction(value: float, digits: int) -> Fraction:
    """The value rounded to so many decimals, exactly."""
    return Fraction(round(float(value) * 10**digits), 10**digits)


def _exif_entries(facts: DngFacts) -> list[Entry]:
    return [
        (33434, RATIONAL, facts.exposure),
        (33437, RATIONAL, facts.fnumber),
        (34850, SHORT, 1),  # ExposureProgram: manual
        (34855, SHORT, facts.iso),
        (36864, UNDEFINED, "0231"),
        (36867, ASCII, facts.timestamp),
        (36868, ASCII, facts.timestamp),
        (37386, RATIONAL, facts.focal_mm),
    ]


def _picture_entries(facts: DngFacts, height: int, width: int) -> list[Entry]:
    entries: list[Entry] = [
        (254, LONG, 0), (256, LONG, width), (257, LONG, height), (258, SHORT, 16), (259, SHORT, 7), (262, SHORT, 32803),
        (271, ASCII, facts.make), (272, ASCII, facts.model), (274, SHORT, 1), (277, SHORT, 1), (278, LONG, height),
        (284, SHORT, 1), (305, ASCII, "insitu simulate"), (306, ASCII, facts.timestamp),
        (33421, SHORT, (2, 2)), (33422, BYTE, [_COLOURS[c] for c in facts.cfa]),
        (50706, BYTE, (1, 4, 0, 0)), (50707, BYTE, (1, 2, 0, 0)), (50708, ASCII, f"{facts.make} {facts.model}"),
        (50710, BYTE, (0, 1, 2)), (50711, SHORT, 1), (50713, SHORT, (2, 2)), (50714, SHORT, facts.black),
        (50717, LONG, facts.white), (50719, LONG, (0, 0)), (50720, LONG, (width, height)),
        (50721, SRATIONAL, [decimal_fraction(v, 4) for v in np.ravel(facts.color_matrix)]),
        (50728, RATIONAL, [decimal_fraction(v, 6) for v in facts.neutral]),
        (50778, SHORT, facts.illuminant), (50829, LONG, (0, 0, height, width)), (51041, DOUBLE, facts.noise),
    ]  # fmt: skip
    if facts.color_matrix_2 is not None:
        entries.append((50722, SRATIONAL, [decimal_fraction(v, 4) for v in np.ravel(facts.color_matrix_2)]))
        entries.append((50779, SHORT, facts.illuminant_2))
    return entries


def dng_bytes(mosaic: np.ndarray, facts: DngFacts) -> bytes:
    """The file of a mosaic (H, W) uint16 with even sides. Raises ValueError for odd sides or samples above white."""
    import imagecodecs

    height, width = mosaic.shape
    if height % 2 or width % 2 or mosaic.dtype != np.uint16:
        raise ValueError(f"mosaic: is {mosaic.dtype} {mosaic.shape}; expected uint16 with even sides")
    if int(mosaic.max()) > facts.white:
        raise ValueError(f"mosaic: reaches {int(mosaic.max())}, above the white level {facts.white}")
    samples = imagecodecs.ljpeg_encode(np.ascontiguousarray(mosaic).reshape(height // 2, 2 * width))
    main = _picture_entries(facts, height, width)
    pointers = [(273, LONG, 0), (279, LONG, len(samples)), (34665, LONG, 0)]
    exif_offset = 8 + len(write_ifd([*main, *pointers], 8))  # its length does not depend on the values
    exif = write_ifd(_exif_entries(facts), exif_offset)
    pointers = [(273, LONG, exif_offset + len(exif)), (279, LONG, len(samples)), (34665, LONG, exif_offset)]
    return struct.pack("<2sHI", b"II", 42, 8) + write_ifd([*main, *pointers], 8) + exif + samples
