"""RAW files: what their metadata say, and the samples as the sensor gave them.

A DNG is read from its tags and decoded here (`dng`, `dng_data`): Bayer mosaics, linear DNG of three channels, integers
and floating point; X-Trans goes through LibRaw's demosaic. Other RAW files take geometry, black and white from LibRaw
(`libraw`). Exposure comes from EXIF alone. Nothing is scaled, white balanced or clipped; what nobody states is 0 or
None, and `pipeline.image.sensor` asks for it.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image import dng, libraw, optical_black
from pipeline.image.computational import by_metadata
from pipeline.image.dng_data import Layout, check_places, layout_of, read_samples
from pipeline.image.optical_black import OpticalBlack
from pipeline.image.tags import (
    Tags,
    camera_name,
    check_directory,
    exif_exposure,
    is_tiff,
    main_tags,
    numbers,
    opened,
    tags_of,
)
from pipeline.run.errors import CaptureError
from pipeline.types import Frame

# What readers of damaged files raise besides their own errors.
DAMAGE = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, OSError, ArithmeticError, RuntimeError, MemoryError,
    struct.error, AssertionError, NotImplementedError,
)  # fmt: skip

EMPTY_BELOW = 16  # DN: a row of zeros is no picture where black is above this
MIN_SIGNAL = 0.02  # of full scale, of blocks that tell the pattern's phase
GREENS_DIFFER = 0.05  # half their relative difference


@dataclass(frozen=True, eq=False)
class Sensor:
    """The samples of one frame with what the same decode tells about its sensor."""

    samples: np.ndarray  # (H, W) or (H, W, 3) DN of the active area, black not subtracted
    black: OpticalBlack | None  # measured on masked photosites of a Bayer mosaic, where there are any
    defects: np.ndarray  # (N, 2) row, column that the file marks as defective


@dataclass(frozen=True, eq=False)
class _Dng:
    """A DNG's raw directory."""

    kind: str  # "bayer", "linear", "xtrans"
    tags: Tags
    layout: Layout
    area: dng.Box


def file_sha256(path: Path) -> str:
    """Hex digest of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_metadata(path: Path, name: str = "") -> Frame:
    """What a RAW file says about itself; ``name`` (default: the file's) is stored in ``Frame.file``.

    Exposure time, ISO or f-number that EXIF lacks, and a white level that nothing says, come back as 0; a missing
    colour matrix as None. Raises CaptureError, one line, when the file is no RAW, is shorter than it declares, or is of
    an unsupported kind.
    """
    name = name or path.name
    if not path.is_file():
        raise CaptureError(f"{name}: no such file")
    facts: dict[str, Any] = {"exposure_s": 0.0, "iso": 0.0, "fnumber": 0.0}
    try:
        if not _may_be_dng(path):
            facts |= libraw.sensor_of(name, path)
        else:
            with opened(path) as (tiff, pages):
                main = main_tags(pages)
                is_dng = _is_dng(path, main)
                own = _dng_facts(name, path, tiff, pages) if is_dng else _other_facts(name, path, tiff, pages)
                facts |= {**own, **exif_exposure(main), "camera": camera_name(main)}
        return Frame(**facts, file=name, sha256=file_sha256(path))
    except PermissionError as error:
        raise CaptureError(f"{name}: cannot be read ({error.strerror}); give it permission") from error
    except DAMAGE as error:
        raise _damaged(name, error) from error
    except Exception as error:  # tifffile's own error derives from Exception alone
        if type(error).__module__.split(".")[0] != "tifffile":
            raise
        raise _damaged(name, error) from error


def _damaged(name: str, error: Exception) -> CaptureError:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return CaptureError(f"{name}: damaged RAW metadata ({reason}); copy the file again from the card")


def _dng_of(name: str, path: Path, tiff: Any, pages: list[Any]) -> _Dng:
    page = dng.raw_page(name, pages)
    for directory in (pages[0], page):
        check_directory(tiff, directory)
    tags = tags_of(page)
    layout = layout_of(name, tiff, page, pages, path.stat().st_size)
    for tag in tags.values():
        _ = tag.value  # long values are read when first asked for, and the file is closed by then
    return _Dng(dng.mosaic_of(name, tags), tags, layout, dng.active_area(tags))


def _may_be_dng(path: Path) -> bool:
    """Whether it is a TIFF. Raises ValueError where the file's name promises one: LibRaw finds pictures in wrecks."""
    if is_tiff(path):
        return True
    if path.suffix.lower() == ".dng":
        raise ValueError("no TIFF header")
    return False


def _is_dng(path: Path, main: Tags) -> bool:
    """Whether the tags are a DNG's. Raises ValueError where the file's name says so and its tags do not."""
    if dng.DNG_VERSION in main:
        return True
    if not main or path.suffix.lower() == ".dng":
        raise ValueError("no DNGVersion" if main else "no directory")
    return False


def _dng_facts(name: str, path: Path, tiff: Any, pages: list[Any]) -> dict[str, Any]:
    """Everything a DNG says besides its exposure."""
    file, main = _dng_of(name, path, tiff, pages), main_tags(pages)
    colour, marks = dng.colour_of(main)
    tags = file.tags
    marks += dng.oddities(name, main, tags)
    marks += by_metadata(
        dng.phone_maker(main), file.kind == "linear", dng.semantic_masks(pages), 52525 in main, 50940 in main
    )
    marks += [libraw.XTRANS_MARK] * (file.kind == "xtrans")
    if (pictures := len(dng.raw_pages(pages))) > 1:
        marks.append(f"holds {pictures} pictures of sensor data; the first of the largest is read")
    defects = dng.listed_defects(tags)
    return {
        **colour,
        **dng.sensor_of(name, main, tags),
        "lens": dng.lens_of(main),
        "vignetting": dng.vignetting_of(tags),
        "bad_pixels": defects if len(defects) else None,
        "marks": list(dict.fromkeys(marks)),
    }


def _other_facts(name: str, path: Path, tiff: Any, pages: list[Any]) -> dict[str, Any]:
    """Facts of a TIFF based RAW that is no DNG, its declared bytes counted."""
    size = path.stat().st_size
    for page in pages:
        tags = tags_of(page)
        for code, other in ((273, 279), (324, 325)):
            offsets, counts = numbers(tags, code), numbers(tags, other)
            if offsets is None and counts is None:
                continue
            if offsets is None or counts is None or len(offsets) != len(counts):
                raise ValueError("pieces of a picture without their sizes or places")
            if (end := int((offsets + counts).max())) > size:
                raise CaptureError(f"{name}: {size} bytes, its image data end at {end}; copy the file again")
            if counts.sum() > size / 2:  # the sensor data; previews may lie within a maker's note
                check_places(name, offsets.astype(np.int64), counts.astype(np.int64), tiff, pages)
    return libraw.sensor_of(name, path)


def read_sensor(path: Path, frame: Frame) -> Sensor:
    """Samples of the active area as stored, with measured black and marked defects, from one decode.

    Raises CaptureError when the file cannot be decoded, has another size than ``frame`` says, is constant below white
    (LibRaw decodes some damaged files to zeros without an error), or when its colours contradict its CFA pattern.
    """
    file = _dng_or_none(path, frame)
    if file is None and frame.cfa:
        stored, area = libraw.stored_mosaic(frame.file, path)
        found = _black(stored, optical_black.margins(stored.shape, area), area, frame, "margins")
        mosaic = _checked(_crop(stored, area), frame)
        _refuse_wrong_phase(mosaic, frame)
        return Sensor(mosaic, found, np.zeros((0, 2), int))
    if file is None or file.kind == "xtrans":
        samples = libraw.developed(frame.file, path, None if file is None else file.area)
        return Sensor(_checked(samples, frame), None, np.zeros((0, 2), int))
    stored = read_samples(frame.file, path, file.layout)
    found = None
    if file.kind == "bayer":
        masked = dng.masked_areas(file.tags)
        source = "MaskedAreas" if masked else "margins"
        found = _black(stored, masked or optical_black.margins(stored.shape, file.area), file.area, frame, source)
    samples = _checked(_crop(stored, file.area), frame)
    if file.kind == "bayer":
        _refuse_wrong_phase(samples, frame)
    value = dng.defect_value(file.tags)
    defects = np.zeros((0, 2), int) if value is None else np.argwhere(samples == value)
    return Sensor(_flattened(samples, file.tags, frame.white), found, defects)


def read_mosaic(path: Path, frame: Frame) -> np.ndarray:
    """Active area as stored: (H, W) uint16 DN of a mosaic, (H, W, 3) of a frame with an empty ``cfa``.

    float32 for floating-point files and where black differs along rows or columns. Raises as `read_sensor`.
    """
    return read_sensor(path, frame).samples


def _dng_or_none(path: Path, frame: Frame) -> _Dng | None:
    """The DNG's directory; None for other files. Raises CaptureError when it is gone or damaged."""
    if not path.is_file():
        raise CaptureError(f"{frame.file}: no such file; restore it or run ingest again")
    try:
        if not _may_be_dng(path):
            return None
        with opened(path) as (tiff, pages):
            return _dng_of(frame.file, path, tiff, pages) if _is_dng(path, main_tags(pages)) else None
    except DAMAGE as error:
        raise _damaged(frame.file, error) from error


def _crop(stored: np.ndarray, area: dng.Box) -> np.ndarray:
    top, left, bottom, right = area
    return np.ascontiguousarray(stored[top:bottom, left:right])


def _checked(samples: np.ndarray, frame: Frame) -> np.ndarray:
    """The samples, if they are what the frame says and are no blank."""
    if samples.shape[:2] != (frame.height, frame.width):
        raise _other_size(frame, samples.shape)
    low, high = samples.min(), samples.max()
    if low == high and (high < frame.white or high == 0):  # all at white is a clipped frame, which merge can tell
        raise CaptureError(f"{frame.file}: every pixel is {low:g}, so its RAW data are missing; copy it again")
    if samples.dtype.kind == "u" and low == 0 and np.min(frame.black) > EMPTY_BELOW:
        rows = int(np.sum(~samples.any(axis=tuple(range(1, samples.ndim)))))
        if rows:
            raise CaptureError(
                f"{frame.file}: {rows} of {len(samples)} rows hold nothing but 0, black is {np.min(frame.black):g}: "
                "data are missing; copy it again"
            )
    return samples


def _refuse_wrong_phase(mosaic: np.ndarray, frame: Frame) -> None:
    """Raises CaptureError where the photosites called green differ and the two others agree: pattern or area is wrong.

    Means over blocks of 16 x 16 cells, every fourth row of blocks. Greens of one sensor agree within 2 %.
    """
    size, height, width = 32, *mosaic.shape
    blocks = mosaic[: height // size * size, : width // size * size]
    if blocks.shape[0] < 4 * size or blocks.shape[1] < 4 * size:
        return
    cells = blocks.reshape(-1, size // 2, 2, blocks.shape[1] // size, size // 2, 2)
    cells = cells[:: 4 if len(cells) >= 16 else 1]
    means = cells.mean((1, 4), dtype=np.float32).transpose(0, 2, 1, 3) - frame.black.astype(np.float32)
    means = means.reshape(-1, 4)
    means = means[means.max(1) > MIN_SIGNAL * (frame.white - frame.black.mean())]
    if len(means) < 16:
        return
    corner, other = (np.median(np.abs(a - b) / np.maximum(np.abs(a + b), 1e-6)) for a, b in
                     ((means[:, 0], means[:, 3]), (means[:, 1], means[:, 2])))  # fmt: skip
    green, rest = (corner, other) if frame.cfa[0] == "G" else (other, corner)
    if green > GREENS_DIFFER and green > 5 * rest:
        raise CaptureError(
            f"{frame.file}: photosites that its pattern {frame.cfa} calls green differ by {2 * green:.0%}, "
            f"the others by {2 * rest:.0%}: pattern or active area is wrong; give the camera's own file"
        )


def _other_size(frame: Frame, shape: tuple[int, ...]) -> CaptureError:
    found = f"{shape[1]} x {shape[0]}"
    return CaptureError(f"{frame.file}: decodes to {found}, metadata say {frame.width} x {frame.height}; copy again")


def _flattened(samples: np.ndarray, tags: Tags, white: float) -> np.ndarray:
    """Samples less the part of black that differs along rows and columns; those at white stay there."""
    ripple = dng.black_ripple(tags)
    if ripple is None:
        return samples
    ripple = ripple if samples.ndim == 2 else ripple[..., None]
    return np.where(samples >= white, samples.astype(np.float32), samples - ripple)


def _black(stored: np.ndarray, areas: list[dng.Box], area: dng.Box, frame: Frame, source: str) -> OpticalBlack | None:
    scale = frame.white - float(np.mean(frame.black))
    return optical_black.measure(stored, areas, area, scale, frame.black, source) if areas and scale > 0 else None
