"""Photographs that are no RAW: JPEG, HEIC, AVIF, PNG, TIFF, EXR, Radiance. What they say about themselves, and samples.

Two kinds. *Linear*: EXR, Radiance .hdr, floating-point TIFF, and integer TIFF whose ICC profile has a linear curve; the
samples are proportional to light. *Display*: all others went through a response curve that nobody states
(`pipeline.image.response` recovers it); an ICC profile's curve is what a screen does, not what the camera did.

Pixels come back as they lie on the sensor: orientation tags are not followed, and the turn that a HEIC decoder makes by
itself is taken back, so that plate, views and board photographs of one camera share one lens. Primaries are those of
the ICC profile, of EXIF ColorSpace or of an EXR's chromaticities, and sRGB's where none are said, which is marked.
Exposures come from EXIF alone; what it lacks is 0. Sources: EXIF 2.32, ICC.1:2022 (tags), ISO/IEC 23008-12 (irot).
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image import colour
from pipeline.image.raw import file_sha256
from pipeline.run.errors import ArtifactError, CaptureError
from pipeline.run.formats import read_linear
from pipeline.types import Frame

HEIF = (".heic", ".heif", ".hif")
PILLOW = (".jpg", ".jpeg", ".avif", ".png")
TIFF = (".tif", ".tiff")
LINEAR = (".exr", ".hdr")
SUFFIXES = (*HEIF, *PILLOW, *TIFF, *LINEAR)

EXIF_NUMBERS = {
    "exposure_s": 33434, "fnumber": 33437, "iso": 34855, "shutter_apex": 37377, "aperture_apex": 37378,
    "focal_mm": 37386, "color_space": 40961, "focal_35mm": 41989, "iso_index": 34866,
}  # fmt: skip
MAKE, MODEL, ORIENTATION, DATE, DATE_TAKEN, LENS, EXIF_IFD, INTEROP_IFD, ICC = (
    271, 272, 274, 306, 36867, 42036, 34665, 40965, 34675,
)  # fmt: skip
SRGB, NO_INDEX = 1, 65535  # EXIF ColorSpace; EXIF's "this ISO does not fit into 16 bit"
COLORANT_TOLERANCE = 3e-3  # of ICC colorants: published sRGB profiles differ by half of it
ASSUMED_SRGB = "says no primaries: those of sRGB are taken"


def read_metadata(path: Path, name: str = "") -> Frame:
    """What a photograph that is no RAW says about itself; ``name`` (default: the file's) becomes ``Frame.file``.

    Always data without a mosaic: ``cfa`` empty, black (1, 3) of zeros. Exposure time, ISO and f-number that are not
    stated come back as 0. ``white``: the largest code, of floating-point data the largest sample, at least 1.
    Raises CaptureError, one line, when the file cannot be read or has another kind of samples.
    """
    name = name or path.name
    if not path.is_file():
        raise CaptureError(f"{name}: no such file")
    suffix = path.suffix.lower()
    read = _linear if suffix in LINEAR else _tiff if suffix in TIFF else _heif if suffix in HEIF else _pillow
    facts = {"exposure_s": 0.0, "iso": 0.0, "fnumber": 0.0, "cfa": "", "black": np.zeros((1, 3)), **read(path, name)}
    return Frame(**facts, file=name, sha256=file_sha256(path))


def read_samples(path: Path, frame: Frame) -> np.ndarray:
    """(H, W, 3) samples as stored, R G B: uint8, uint16, or float32 of linear floating-point files.

    Raises CaptureError when the file cannot be decoded or has another size than ``frame`` says.
    """
    if not path.is_file():
        raise CaptureError(f"{frame.file}: no such file; restore it or run ingest again")
    suffix = path.suffix.lower()
    if suffix in LINEAR:
        samples = _read_linear(path, frame.file).rgb()
    elif suffix in TIFF:
        samples = _tiff_samples(path, frame.file)
    elif suffix in HEIF:
        samples = _heif_samples(path, frame.file)
    else:
        samples = _pillow_samples(path, frame.file)
    samples = np.repeat(samples[..., None], 3, -1) if samples.ndim == 2 else samples[..., :3]
    if samples.shape[:2] != (frame.height, frame.width):
        found = f"{samples.shape[1]} x {samples.shape[0]}"
        raise CaptureError(f"{frame.file}: decodes to {found}, metadata say {frame.width} x {frame.height}; copy again")
    return np.ascontiguousarray(samples)


# What the files say ---------------------------------------------------------------------------------------------------


def _pillow(path: Path, name: str) -> dict[str, Any]:

    with _opened(path, name) as picture:
        if picture.mode not in ("RGB", "RGBA", "L", "LA", "P", "I;16"):
            raise CaptureError(f"{name}: its samples are {picture.mode}, needed RGB; export it again as RGB")
        exif = picture.getexif()
        tags = {**exif, **exif.get_ifd(EXIF_IFD)}
        adobe = exif.get_ifd(INTEROP_IFD).get(1) == "R03"
        deep = picture.mode == "I;16" or _png_depth(path) == 16
        facts = _exif_facts(tags) | {"width": picture.width, "height": picture.height, "encoding": "display"}
        return facts | {"white": 65535.0 if deep else 255.0} | _colours(picture.info.get("icc_profile"), tags, adobe)


def _heif(path: Path, name: str) -> dict[str, Any]:
    from PIL import Image

    picture = _heif_opened(path, name)
    exif = Image.Exif()
    exif.load(picture.info.get("exif") or b"")
    tags = {**exif, **exif.get_ifd(EXIF_IFD)}
    width, height = picture.size
    if _heif_turns(path) % 2:
        width, height = height, width
    white = 2.0 ** picture.info.get("bit_depth", 8) - 1
    facts = _exif_facts(tags) | {"width": width, "height": height, "white": white, "encoding": "display"}
    return facts | _colours(picture.info.get("icc_profile"), tags, False)


def _tiff(path: Path, name: str) -> dict[str, Any]:
    with _tiff_opened(path, name) as tiff:
        page = tiff.pages[0]
        tags = {tag.code: tag.value for tag in page.tags.values()}
        if page.photometric not in (0, 1, 2, 6) or page.samplesperpixel not in (1, 3, 4) or page.dtype is None:
            raise CaptureError(f"{name}: a TIFF of {page.samplesperpixel} samples, needed RGB; export it again as RGB")
        nested = tags.get(EXIF_IFD)
        if isinstance(nested, dict):
            codes = {value: code for code, value in _tiff_names().items()}
            tags |= {codes[key]: value for key, value in nested.items() if key in codes}
        icc = tags.get(ICC)
        floating = page.dtype.kind == "f"
        linear = floating or (icc is not None and linear_curve(icc))
        white = _largest(_tiff_samples(path, name)) if floating else float(np.iinfo(page.dtype).max)
        facts = _exif_facts(tags) | {"width": page.imagewidth, "height": page.imagelength, "white": white}
        return facts | {"encoding": "linear" if linear else "display"} | _colours(icc, tags, False)


def _linear(path: Path, name: str) -> dict[str, Any]:
    picture = _read_linear(path, name)
    height, width = picture.shape
    said = picture.space in (*colour.PRIMARIES, "acescg")
    header = {"exposure_s": "expTime", "iso": "isoSpeed", "fnumber": "aperture"}  # standard attributes of OpenEXR
    facts = {key: float(picture.attributes[word]) for key, word in header.items() if word in picture.attributes}
    return facts | {
        "width": width, "height": height, "white": _largest(picture.rgb()), "encoding": "linear",
        "space": picture.space if said else "linear_rec709", "marks": [] if said else [ASSUMED_SRGB],
    }  # fmt: skip


def _largest(samples: np.ndarray) -> float:
    """The white of floating-point samples: nothing says where they clip, so only the largest is taken as clipped."""
    finite = samples[np.isfinite(samples)]
    return max(1.0, float(finite.max())) if finite.size else 1.0


def _exif_facts(tags: Mapping[int, Any]) -> dict[str, Any]:
    """Exposure, camera and lens of EXIF tags by code, as far as they say something; times may be stated as APEX."""
    numbers = {key: _number(tags.get(code)) for key, code in EXIF_NUMBERS.items()}
    if isinstance(iso := tags.get(EXIF_NUMBERS["iso"]), (tuple, list)):  # it may be several, and is no rational
        numbers["iso"] = _number(iso[0]) if iso else 0.0
    marks = []
    if not numbers["exposure_s"] and EXIF_NUMBERS["shutter_apex"] in tags:
        numbers["exposure_s"] = 2.0 ** -numbers["shutter_apex"]
        marks.append("exposure time from ShutterSpeedValue")
    if not numbers["fnumber"] and numbers["aperture_apex"] > 0:
        numbers["fnumber"] = 2.0 ** (numbers["aperture_apex"] / 2)
        marks.append("f-number from ApertureValue")
    if numbers["iso"] in (0.0, NO_INDEX):
        numbers["iso"] = numbers["iso_index"]
    if (turned := int(_number(tags.get(ORIENTATION)))) > 1:
        marks.append(f"orientation tag {turned} not followed: pixels are taken as they lie on the sensor")
    camera = " ".join(_text(tags.get(code)) for code in (MAKE, MODEL)).strip()
    return {
        **{key: numbers[key] for key in ("exposure_s", "fnumber", "iso", "focal_mm", "focal_35mm") if numbers[key] > 0},
        "camera": camera, "lens": _text(tags.get(LENS)), "marks": marks,
        "timestamp": _text(tags.get(DATE_TAKEN)) or _text(tags.get(DATE)),
    }  # fmt: skip


def _number(value: Any) -> float:
    """A tag's number, its rational divided; 0 when it says nothing."""
    if isinstance(value, (tuple, list)):
        if len(value) == 2 and all(isinstance(part, int) for part in value):  # a rational
            return value[0] / value[1] if value[1] else 0.0
        value = value[0] if value else 0
    try:
        number = float(value or 0)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if np.isfinite(number) else 0.0


def _text(value: Any) -> str:
    return value.replace("\0", "").strip() if isinstance(value, str) else ""


def _colours(icc: bytes | None, tags: Mapping[int, Any], adobe: bool) -> dict[str, Any]:
    """Frame's ``space``, and its marks with one more where the primaries are a guess."""
    marks = list(_exif_facts(tags)["marks"])
    space = space_of_profile(icc) if icc else None
    if space is None and adobe:
        space = "linear_adobe_rgb"
    if space is None and (icc or _number(tags.get(EXIF_NUMBERS["color_space"])) != SRGB):
        marks.append("its ICC profile has primaries nobody here knows: sRGB's are taken" if icc else ASSUMED_SRGB)
    return {"space": space or "linear_rec709", "marks": marks}


# ICC profiles ---------------------------------------------------------------------------------------------------------


def _icc_tag(icc: bytes, signature: bytes) -> bytes:
    """Content of one tag of an ICC profile; empty when it has none."""
    try:
        (count,) = struct.unpack_from(">I", icc, 128)
        for number in range(min(count, 100)):
            found, offset, size = struct.unpack_from(">4sII", icc, 132 + 12 * number)
            if found == signature:
                return icc[offset : offset + size]
    except struct.error:
        pass
    return b""


def space_of_profile(icc: bytes) -> str | None:
    """Name of the linear space whose primaries an ICC matrix profile has; None when it is none that is known."""
    tags = [_icc_tag(icc, signature) for signature in (b"rXYZ", b"gXYZ", b"bXYZ")]
    if any(len(tag) < 20 for tag in tags):
        return None
    columns = [np.array(struct.unpack_from(">3i", tag, 8)) / 65536 for tag in tags]
    d50 = colour.xyz_of_xy(colour.D50_XY)
    for name, chromaticities in colour.PRIMARIES.items():
        adapted = colour.adaptation(colour.xyz_of_xy(chromaticities[3]), d50) @ colour.xyz_from_rgb(chromaticities)
        if np.allclose(np.stack(columns, -1), adapted, atol=COLORANT_TOLERANCE):
            return name
    return None


def linear_curve(icc: bytes) -> bool:
    """Whether an ICC profile says that samples are proportional to light: a curve that is the identity."""
    tag = _icc_tag(icc, b"rTRC")
    if tag[:4] == b"curv" and len(tag) >= 12:
        (count,) = struct.unpack_from(">I", tag, 8)
        return count == 0 or (count == 1 and tag[12:14] == b"\x01\x00")
    return tag[:4] == b"para" and tag[8:10] == b"\0\0" and tag[12:16] == b"\0\x01\0\0"


# Decoders -------------------------------------------------------------------------------------------------------------


def _opened(path: Path, name: str) -> Any:
    """The picture, not decoded yet. Raises CaptureError."""
    from PIL import Image

    try:
        return Image.open(path)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{name}: not a readable picture ({_why(error)}); copy it again from the camera") from error


def _pillow_samples(path: Path, name: str) -> np.ndarray:
    if _png_depth(path) == 16:  # Pillow cuts 16-bit colours to 8
        import imagecodecs

        try:
            return np.asarray(imagecodecs.png_decode(path.read_bytes()))
        except (imagecodecs.PngError, ValueError) as error:
            raise CaptureError(f"{name}: cannot be decoded ({_why(error)}); copy it again") from error
    with _opened(path, name) as picture:
        try:
            return np.asarray(picture if picture.mode in ("RGB", "L") else picture.convert("RGB"))
        except (OSError, SyntaxError, ValueError) as error:
            raise CaptureError(f"{name}: cannot be decoded ({_why(error)}); copy it again") from error


def _png_depth(path: Path) -> int:
    """Bits per sample that a PNG's header states; 0 of other files."""
    with path.open("rb") as stream:
        head = stream.read(25)
    return head[24] if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) == 25 else 0


def _heif_opened(path: Path, name: str) -> Any:
    import pi_heif

    try:
        return pi_heif.open_heif(path, convert_hdr_to_8bit=False, hdr_to_16bit=False)
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError) as error:
        raise CaptureError(f"{name}: not a readable HEIC ({_why(error)}); copy it again from the camera") from error


def _heif_samples(path: Path, name: str) -> np.ndarray:
    try:
        samples = np.asarray(_heif_opened(path, name))
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError) as error:
        raise CaptureError(f"{name}: cannot be decoded ({_why(error)}); copy it again") from error
    return np.rot90(samples, -_heif_turns(path))


def _heif_turns(path: Path) -> int:
    """Quarter turns, counter-clockwise, that the file's irot property asks for and the decoder has made."""
    head = path.read_bytes().partition(b"mdat")[0]
    found = head.find(b"irot")
    return head[found + 4] & 3 if 0 <= found < len(head) - 4 else 0


def _tiff_opened(path: Path, name: str) -> Any:
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # it logs what is raised here as errors
    try:
        return tifffile.TiffFile(path)
    except (tifffile.TiffFileError, ValueError, OSError, struct.error) as error:
        raise CaptureError(f"{name}: not a readable TIFF ({_why(error)}); export it again") from error


def _tiff_samples(path: Path, name: str) -> np.ndarray:
    with _tiff_opened(path, name) as tiff:
        page = tiff.pages[0]
        try:
            samples = np.asarray(page.asarray())
        except (ValueError, OSError, RuntimeError, struct.error) as error:
            raise CaptureError(f"{name}: cannot be decoded ({_why(error)}); export it again") from error
        if page.planarconfig == 2 and samples.ndim == 3:
            samples = np.moveaxis(samples, 0, -1)
    return samples.astype(np.float32) if samples.dtype.kind == "f" else samples


def _tiff_names() -> dict[int, str]:
    """EXIF tag codes and the names that tifffile gives them."""
    import tifffile

    return {int(code): str(word) for code, word in dict(tifffile.TIFF.EXIF_TAGS).items()}


def is_mosaic_tiff(path: Path) -> bool:
    """Whether a .tif is a RAW: a DNG, or a colour filter array. False when it cannot be read as a TIFF."""
    try:
        with _tiff_opened(path, path.name) as tiff:
            tags = tiff.pages[0].tags
            return 50706 in tags or int(tags[262].value) == 32803 if 262 in tags else 50706 in tags
    except (CaptureError, IndexError):
        return False


def _read_linear(path: Path, name: str) -> Any:
    try:
        return read_linear(path)
    except ArtifactError as error:
        raise CaptureError(str(error).replace(str(path), name)) from error


def _why(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
