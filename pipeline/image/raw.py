"""RAW files: what their metadata say, and the mosaic as the sensor gave it. The only importer of rawpy and tifffile.

Metadata of a DNG come from its tags (LibRaw exposes neither ColorMatrix1 nor NoiseProfile of a DNG), with the CFA
pattern and BlackLevel relative to ActiveArea as DNG 1.7.1 defines them: LibRaw labels odd active areas wrongly, so the
crop is made here. Other RAW files take geometry, black and white from LibRaw. Exposure comes from EXIF alone: LibRaw
reports 1 s and f/1 when there is none. Nothing is scaled, white balanced or clipped.

Limits: Bayer mosaics of integers; X-Trans, linear and float DNG are refused. BlackLevelDeltaH/V enter as their mean.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.run.errors import CaptureError
from pipeline.types import Frame

BAYER = ("RGGB", "GRBG", "GBRG", "BGGR")
CFA_PHOTOMETRIC, LINEAR_RAW_PHOTOMETRIC = 32803, 34892
RATIONAL, SRATIONAL = 5, 10  # TIFF types that tifffile returns as flat numerator, denominator pairs


def file_sha256(path: Path) -> str:
    """Hex digest of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_metadata(path: Path, name: str = "") -> Frame:
    """What a RAW file says about itself; ``name`` (default: the file's) is stored in ``Frame.file``.

    Exposure time, ISO or f-number that EXIF lacks come back as 0. Raises CaptureError, one line, when the file is no
    RAW, is shorter than it declares, or is of an unsupported kind.
    """
    import logging

    import tifffile

    name = name or path.name
    if not path.is_file():
        raise CaptureError(f"{name}: no such file")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # it logs what is raised here as errors
    try:
        with tifffile.TiffFile(path) as tiff:
            pages = _all_pages(tiff)
            tags = _main_tags(pages)
            sensor = _dng_sensor(name, pages, path.stat().st_size) if 50706 in tags else _libraw_sensor(name, path)
            facts = {**_dng_colour(tags), **sensor, **_exif_exposure(tags), "camera": _camera_name(tags)}
    except tifffile.TiffFileError:
        facts = _libraw_sensor(name, path)
    except (ValueError, KeyError, IndexError, TypeError, OSError, ZeroDivisionError) as error:
        raise CaptureError(f"{name}: damaged RAW metadata ({error}); copy the file again from the card") from error
    return Frame(**{"exposure_s": 0.0, "iso": 0.0, "fnumber": 0.0, **facts}, file=name, sha256=file_sha256(path))


def read_mosaic(path: Path, frame: Frame) -> np.ndarray:
    """Active area of the mosaic as stored, (H, W) uint16 DN, black not subtracted.

    Raises CaptureError when the file cannot be decoded, has another size than ``frame`` says, or is constant below
    white (LibRaw decodes some damaged files to zeros without an error).
    """
    import rawpy

    if not path.is_file():
        raise CaptureError(f"{frame.file}: no such file; restore it or run ingest again")
    try:
        with rawpy.imread(str(path)) as raw:
            visible = raw.raw_image_visible
            box = _active_area(path) if raw.raw_image.shape != visible.shape else None
            area = visible if box is None else raw.raw_image[box[0] : box[2], box[1] : box[3]]
            mosaic = np.array(area)
    except rawpy.LibRawError as error:
        raise CaptureError(f"{frame.file}: cannot be decoded ({_libraw_text(error)}); copy it again") from error
    if mosaic.shape != (frame.height, frame.width):
        found = f"{mosaic.shape[1]} x {mosaic.shape[0]}"
        raise CaptureError(f"{frame.file}: decodes to {found}, metadata say {frame.width} x {frame.height}; copy again")
    if mosaic.min() == mosaic.max() < frame.white:  # all at white is a clipped frame, which merge can tell
        raise CaptureError(f"{frame.file}: every pixel is {mosaic.flat[0]}, so its RAW data are missing; copy it again")
    return mosaic


def _all_pages(tiff: Any) -> list[Any]:
    """Every IFD of a TIFF, SubIFDs included."""
    found, queue = [], list(tiff.pages)
    while queue:
        page = queue.pop(0)
        found.append(page)
        queue.extend(page.pages or [])
    return found


def _main_tags(pages: list[Any]) -> dict[int, Any]:
    """Tag code -> tag of the first IFD, completed by the others'."""
    tags: dict[int, Any] = {}
    for page in pages:
        for tag in page.tags.values():
            tags.setdefault(tag.code, tag)
    return tags


def _numbers(tags: dict[int, Any], code: int) -> np.ndarray | None:
    """Values of a numeric tag as float64, rationals divided; None when absent."""
    tag = tags.get(code)
    if tag is None:
        return None
    value = np.asarray(list(tag.value) if isinstance(tag.value, (bytes, tuple, list)) else [tag.value], float)
    if tag.dtype in (RATIONAL, SRATIONAL):
        if np.any(value[1::2] == 0):
            raise ValueError(f"{tag.name} has a zero denominator")
        value = value[0::2] / value[1::2]
    return value


def _ratio(value: Any) -> float:
    """A number or an EXIF rational; 0 when it says nothing."""
    if isinstance(value, (tuple, list)):
        return float(value[0]) / float(value[1]) if len(value) == 2 and value[1] else 0.0
    return float(value) if isinstance(value, (int, float)) else 0.0


def _exif_exposure(tags: dict[int, Any]) -> dict[str, Any]:
    """Exposure facts of the EXIF IFD, or of IFD 0 where TIFF/EP writers put them, as far as they say something."""
    exif = tags[34665].value if 34665 in tags else {}
    exif = exif if isinstance(exif, dict) else {}

    def get(key: str, code: int) -> Any:
        return exif.get(key, tags[code].value if code in tags else 0)

    iso = get("ISOSpeedRatings", 34855)
    iso = iso[0] if isinstance(iso, (tuple, list)) and iso else iso
    date = exif.get("DateTimeOriginal") or (tags[306].value if 306 in tags else "")
    facts = {
        "exposure_s": _ratio(get("ExposureTime", 33434)),
        "fnumber": _ratio(get("FNumber", 33437)),
        "iso": _ratio(iso),
        "focal_mm": _ratio(get("FocalLength", 37386)),
        "timestamp": date if isinstance(date, str) else "",
    }
    return {key: value for key, value in facts.items() if value}


def _camera_name(tags: dict[int, Any]) -> str:
    if 50708 in tags and isinstance(tags[50708].value, str):
        return str(tags[50708].value)
    return " ".join(str(tags[code].value).strip() for code in (271, 272) if code in tags)


def _dng_sensor(name: str, pages: list[Any], file_size: int) -> dict[str, Any]:
    """Size, CFA, black and white of a DNG's full-size mosaic."""
    page = _mosaic_page(name, pages)
    tags = {tag.code: tag for tag in page.tags.values()}
    _refuse_truncated(name, tags, file_size)
    _refuse_float(name, tags)
    top, left, bottom, right = _area_of(tags)
    repeat = _numbers(tags, 33421)
    pattern = bytes(tags[33422].value)
    if repeat is None or tuple(repeat) != (2, 2) or (cfa := "".join("RGB?"[min(c, 3)] for c in pattern)) not in BAYER:
        raise CaptureError(f"{name}: colour filter {pattern.hex()} is no 2x2 Bayer pattern; only Bayer RAW is read")
    bits = int(np.ravel(tags[258].value)[0])
    white = _numbers(tags, 50717)
    return {
        "width": right - left,
        "height": bottom - top,
        "cfa": cfa,
        "black": _dng_black(name, tags),
        "white": float(2**bits - 1 if white is None else white[0]),
    }


def _mosaic_page(name: str, pages: list[Any]) -> Any:
    """The largest CFA image of a DNG."""
    kinds = {int(page.tags[262].value) for page in pages if 262 in page.tags}
    mosaics = [page for page in pages if 262 in page.tags and int(page.tags[262].value) == CFA_PHOTOMETRIC]
    if not mosaics:
        kind = "a linear (demosaicked) DNG" if LINEAR_RAW_PHOTOMETRIC in kinds else "no mosaic"
        raise CaptureError(f"{name}: holds {kind}, needed Bayer RAW; give the camera's own file or a mosaic DNG")
    return max(mosaics, key=lambda page: int(page.tags[256].value) * int(page.tags[257].value))


def _refuse_truncated(name: str, tags: dict[int, Any], file_size: int) -> None:
    """LibRaw decodes a DNG with missing tiles to zeros without an error, so the declared bytes are counted here."""
    width, height = int(tags[256].value), int(tags[257].value)
    tiled = 324 in tags
    offsets, counts = _numbers(tags, 324 if tiled else 273), _numbers(tags, 325 if tiled else 279)
    if offsets is None or counts is None:
        raise CaptureError(f"{name}: declares no image data; copy the file again")
    if tiled:
        across, down = int(tags[322].value), int(tags[323].value)
        expected = -(-width // across) * -(-height // down)
    else:
        expected = -(-height // int(tags[278].value)) if 278 in tags else 1
    if len(offsets) < expected or len(counts) < expected:
        raise CaptureError(f"{name}: {len(offsets)} of {expected} pieces of the picture are there; copy the file again")
    if (end := int((offsets + counts).max())) > file_size:
        raise CaptureError(f"{name}: {file_size} bytes, its image data end at {end}; copy the file again")


def _refuse_float(name: str, tags: dict[int, Any]) -> None:
    if 339 in tags and int(np.ravel(tags[339].value)[0]) != 1:
        raise CaptureError(f"{name}: a floating-point DNG, needed integers; give the camera's own file")


def _area_of(tags: dict[int, Any]) -> tuple[int, int, int, int]:
    """ActiveArea (top, left, bottom, right) of a raw IFD, by default all of it."""
    area = _numbers(tags, 50829)
    if area is None:
        return 0, 0, int(tags[257].value), int(tags[256].value)
    top, left, bottom, right = (int(value) for value in area)
    if not (0 <= top < bottom <= int(tags[257].value) and 0 <= left < right <= int(tags[256].value)):
        raise ValueError(f"ActiveArea {area.tolist()} lies outside the picture")
    return top, left, bottom, right


def _dng_black(name: str, tags: dict[int, Any]) -> np.ndarray:
    """BlackLevel (2, 2) DN in CFA cell order, origin at the active area's corner."""
    level = _numbers(tags, 50714)
    repeat = _numbers(tags, 50713)
    rows, columns = (1, 1) if repeat is None else (int(repeat[0]), int(repeat[1]))
    if rows > 2 or columns > 2:
        raise CaptureError(f"{name}: BlackLevel repeats over {rows} x {columns}, needed at most 2 x 2; convert it")
    black = np.zeros((2, 2)) if level is None else np.broadcast_to(level.reshape(rows, columns), (2, 2))
    deltas = [_numbers(tags, code) for code in (50715, 50716)]
    return black + sum(float(delta.mean()) for delta in deltas if delta is not None)


def _dng_colour(tags: dict[int, Any]) -> dict[str, Any]:
    """Colour and noise tags of a DNG; AnalogBalance and CameraCalibration are folded into the matrices."""
    if 50706 not in tags:
        return {}
    balance = _numbers(tags, 50727)

    def calibrated(matrix_code: int, calibration_code: int) -> np.ndarray | None:
        matrix, calibration = _numbers(tags, matrix_code), _numbers(tags, calibration_code)
        if matrix is None or matrix.size != 9:
            return None
        result = matrix.reshape(3, 3)
        if calibration is not None and calibration.size == 9:
            result = calibration.reshape(3, 3) @ result
        return result if balance is None or balance.size != 3 else balance[:, None] * result

    neutral, noise = _numbers(tags, 50728), _numbers(tags, 51041)
    return {
        "color_matrix": calibrated(50721, 50723),
        "color_matrix_2": calibrated(50722, 50724),
        "illuminant": int(tags[50778].value) if 50778 in tags else 0,
        "illuminant_2": int(tags[50779].value) if 50779 in tags else 0,
        "as_shot_neutral": neutral if neutral is not None and neutral.size == 3 else None,
        "noise_profile": noise if noise is not None and noise.size in (2, 6) else None,
    }


def _libraw_sensor(name: str, path: Path) -> dict[str, Any]:
    """Size, CFA, black, white and colour of a RAW that is no DNG, as LibRaw knows its camera."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            pattern = raw.raw_pattern
            if raw.raw_type != rawpy.RawType.Flat or pattern is None or pattern.shape != (2, 2):
                raise CaptureError(f"{name}: its sensor is no 2x2 Bayer mosaic; only Bayer RAW is read")
            letters = raw.color_desc.decode()
            cfa = "".join(letters[number] for number in pattern.ravel())
            if cfa not in BAYER:
                raise CaptureError(f"{name}: colour filter {cfa} is no Bayer pattern; only Bayer RAW is read")
            black = np.asarray(raw.black_level_per_channel, float)[pattern]
            linear = [value for value in (raw.camera_white_level_per_channel or []) if value > 0]
            matrix = np.asarray(raw.rgb_xyz_matrix, float)[:3]
            balance = np.asarray(raw.camera_whitebalance, float)[:3]
            return {
                "width": raw.sizes.width, "height": raw.sizes.height, "cfa": cfa, "black": black,
                "white": float(min([raw.white_level, *linear])),
                "color_matrix": matrix if np.any(matrix) else None, "illuminant": 21,  # LibRaw keeps the D65 matrix
                "as_shot_neutral": 1 / balance if np.all(balance > 0) and np.ptp(balance) > 0 else None,
                **_libraw_exposure(raw.other),
            }  # fmt: skip
    except rawpy.LibRawError as error:
        raise CaptureError(f"{name}: not a readable RAW file ({_libraw_text(error)}); give the camera's RAW") from error


def _libraw_exposure(other: Any) -> dict[str, float]:
    """LibRaw's exposure of a file whose EXIF is elsewhere; 1 s at f/1 is what it says when it found none."""
    invented = other.shutter_speed == 1.0 and other.aperture in (0.0, 1.0)
    found = {"iso": other.iso_speed, "focal_mm": other.focal_length}
    if not invented:
        found |= {"exposure_s": other.shutter_speed, "fnumber": other.aperture}
    return {key: float(value) for key, value in found.items()}


def _libraw_text(error: Exception) -> str:
    text = error.args[0] if error.args else type(error).__name__
    return text.decode() if isinstance(text, bytes) else str(text)


def _active_area(path: Path) -> tuple[int, int, int, int] | None:
    """ActiveArea of a DNG as its tags say; None for other files, whose margins LibRaw knows."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            pages = _all_pages(tiff)
            if 50706 not in _main_tags(pages):
                return None
            page = _mosaic_page(path.name, pages)
            return _area_of({tag.code: tag for tag in page.tags.values()})
    except tifffile.TiffFileError:
        return None
