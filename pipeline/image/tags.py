"""TIFF tags of a photograph: every directory, numbers as float64, and what EXIF says of exposure and lens."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

RATIONAL, SRATIONAL = 5, 10  # TIFF types that tifffile returns as flat numerator, denominator pairs
SINGLE = (256, 257, 259, 262, 277, 278, 284, 317, 322, 323)  # TIFF tags of size and coding that hold one number
TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
MAX_DIRECTORIES = 64  # of a photograph: main, raw, previews, masks; more is a damaged chain

Tags = dict[int, Any]


@contextmanager
def opened(path: Path) -> Iterator[tuple[Any, list[Any]]]:
    """The TIFF and all its directories, SubIFDs included.

    Raises ValueError where its chain of directories is damaged, and tifffile's own error for what is no TIFF.
    """
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # it logs what callers raise as errors
    with tifffile.TiffFile(path) as tiff:
        found: list[Any] = []
        queue = list(tiff.pages)
        while queue:
            page = queue.pop(0)
            found.append(page)
            queue.extend(page.pages or [])
            if len(found) > MAX_DIRECTORIES:
                raise ValueError(f"more than {MAX_DIRECTORIES} directories")
        yield tiff, found


def is_tiff(path: Path) -> bool:
    """Whether the file starts as a TIFF does; RAW files of some makers (CRW, RAF, CR3, X3F) do not."""
    with path.open("rb") as stream:
        return stream.read(4) in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def check_directory(tiff: Any, page: Any) -> None:
    """Raises ValueError when entries of a directory were skipped as unreadable, or are out of order.

    Every reader passes over such an entry in silence, and what it said of the coding is lost. TIFF 6.0 wants entries
    sorted by code, so that one whose code is damaged shows.
    """
    stream, order = tiff.filehandle, tiff.byteorder
    stream.seek(page.offset)
    (count,) = struct.unpack(order + "H", stream.read(2))
    codes = [struct.unpack_from(order + "H", stream.read(12))[0] for _ in range(count)]
    if any(one >= other for one, other in pairwise(codes)):
        raise ValueError("directory entries out of order")
    found = {tag.code for tag in page.tags.values()}
    if lost := [code for code in codes if code not in found]:
        raise ValueError(f"entry {lost[0]} of the directory cannot be read")
    for code in SINGLE:
        if code in found and page.tags[code].count != 1:
            raise ValueError(f"entry {code} of the directory holds {page.tags[code].count} values, needed 1")


def occupied(tiff: Any, pages: list[Any]) -> list[tuple[int, int, str]]:
    """Ranges of bytes [start, stop) that directories and their longer values take, EXIF's included."""
    ranges = []
    for page in pages:
        ranges.append((page.offset, page.offset + 2 + 12 * len(page.tags), "directory"))
        for tag in page.tags.values():
            if tag.valuebytecount > 4:
                ranges.append((tag.valueoffset, tag.valueoffset + tag.valuebytecount, "values"))
    exif = {tag.offset for page in pages for tag in page.tags.values() if tag.code == 34665}
    stream, order = tiff.filehandle, tiff.byteorder
    for entry in exif:
        stream.seek(entry + 8)
        (start,) = struct.unpack(order + "I", stream.read(4))
        stream.seek(start)
        (count,) = struct.unpack(order + "H", stream.read(2))
        ranges.append((start, start + 2 + 12 * count, "directory"))
        for _ in range(count):
            _, kind, number, place = struct.unpack(order + "HHII", stream.read(12))
            if (size := number * TYPE_BYTES.get(kind, 0)) > 4:
                ranges.append((place, place + size, "values"))
    return ranges


def tags_of(page: Any) -> Tags:
    """Tag code -> tag of one directory."""
    return {tag.code: tag for tag in page.tags.values()}


def main_tags(pages: list[Any]) -> Tags:
    """Tag code -> tag of the first directory, completed by the others'."""
    tags: Tags = {}
    for page in pages:
        for tag in page.tags.values():
            tags.setdefault(tag.code, tag)
    return tags


def numbers(tags: Tags, code: int) -> np.ndarray | None:
    """Values of a numeric tag as float64 (N,), rationals divided; None when absent. Raises ValueError for x / 0."""
    tag = tags.get(code)
    if tag is None:
        return None
    value = np.asarray(list(tag.value) if isinstance(tag.value, (bytes, tuple, list)) else [tag.value], float)
    if tag.dtype in (RATIONAL, SRATIONAL):
        if np.any(value[1::2] == 0):
            raise ValueError(f"{tag.name} has a zero denominator")
        value = value[0::2] / value[1::2]
    return value


def whole(tags: Tags, code: int, default: int) -> int:
    """First value of an integer tag."""
    found = numbers(tags, code)
    return default if found is None or not found.size else int(found[0])


def text(tags: Tags, code: int) -> str:
    """A text tag, stripped; empty when absent."""
    return str(tags[code].value).strip("\0 ") if code in tags and isinstance(tags[code].value, str) else ""


def ratio(value: Any) -> float:
    """A number or an EXIF rational; 0 when it says nothing."""
    if isinstance(value, (tuple, list)):
        return float(value[0]) / float(value[1]) if len(value) == 2 and value[1] else 0.0
    return float(value) if isinstance(value, (int, float)) else 0.0


def exif_exposure(tags: Tags) -> dict[str, Any]:
    """Exposure and lens of the EXIF directory, or of IFD 0 where TIFF/EP writers put them; only what says something."""
    exif = tags[34665].value if 34665 in tags else {}
    exif = exif if isinstance(exif, dict) else {}

    def get(key: str, code: int) -> Any:
        return exif.get(key, tags[code].value if code in tags else 0)

    iso = get("ISOSpeedRatings", 34855)
    iso = iso[0] if isinstance(iso, (tuple, list)) and iso else iso
    date, lens = exif.get("DateTimeOriginal") or text(tags, 306), get("LensModel", 42036)
    facts = {
        "exposure_s": ratio(get("ExposureTime", 33434)),
        "fnumber": ratio(get("FNumber", 33437)),
        "iso": ratio(iso),
        "focal_mm": ratio(get("FocalLength", 37386)),
        "focal_35mm": ratio(get("FocalLengthIn35mmFilm", 41989)),
        "timestamp": date if isinstance(date, str) else "",
        "lens": lens.strip("\0 ") if isinstance(lens, str) else "",
    }
    return {key: value for key, value in facts.items() if value}


def camera_name(tags: Tags) -> str:
    """UniqueCameraModel of a DNG, else maker and model."""
    return text(tags, 50708) or " ".join(filter(None, (text(tags, 271), text(tags, 272))))
