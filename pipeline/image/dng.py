"""What the tags of a DNG say: geometry, levels, colour, opcodes, and what is odd. DNG 1.7.1 (Adobe 2023).

LibRaw exposes neither ColorMatrix1 nor NoiseProfile of a DNG and labels odd active areas wrongly, so everything comes
from the tags: the CFA pattern and BlackLevel start at the corner of ActiveArea. Levels are those after
LinearizationTable. Nothing is invented: a white level that is not there comes back as 0 and must be stated.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.image.tags import Tags, numbers, tags_of, text, whole
from pipeline.run.errors import CaptureError

BAYER = ("RGGB", "GRBG", "GBRG", "BGGR")
CFA_PHOTOMETRIC, LINEAR_RAW_PHOTOMETRIC = 32803, 34892
DNG_VERSION = 50706
MAX_BAD_PIXELS = 200_000  # of an opcode list: more is no list of defects but a damaged one
OPCODES = {
    1: "WarpRectilinear", 2: "WarpFisheye", 3: "FixVignetteRadial", 4: "FixBadPixelsConstant", 5: "FixBadPixelsList",
    6: "TrimBounds", 7: "MapTable", 8: "MapPolynomial", 9: "GainMap", 10: "DeltaPerRow", 11: "DeltaPerColumn",
    12: "ScalePerRow", 13: "ScalePerColumn", 14: "WarpRectilinear2",
}  # fmt: skip
CURVES = ("MapTable", "MapPolynomial", "DeltaPerRow", "DeltaPerColumn", "ScalePerRow", "ScalePerColumn", "TrimBounds")

Box = tuple[int, int, int, int]  # top, left, bottom, right


@dataclass(frozen=True)
class Opcode:
    """One entry of an OpcodeList."""

    name: str
    optional: bool
    data: bytes


def raw_pages(pages: list[Any]) -> list[Any]:
    """Directories that hold sensor data of full size: no previews, masks or enhanced versions."""
    kinds = (CFA_PHOTOMETRIC, LINEAR_RAW_PHOTOMETRIC)
    return [page for page in pages if whole(t := tags_of(page), 262, 0) in kinds and whole(t, 254, 0) == 0]


def raw_page(name: str, pages: list[Any]) -> Any:
    """The largest directory that holds sensor data of full size. Raises CaptureError where none does."""
    raws = raw_pages(pages)
    if not raws:
        raise CaptureError(f"{name}: holds no sensor data, needed a mosaic or linear DNG; give the camera's own file")
    return max(raws, key=lambda page: whole(tags_of(page), 256, 0) * whole(tags_of(page), 257, 0))


def mosaic_of(name: str, tags: Tags) -> str:
    """``"bayer"``, ``"linear"`` (three channels per pixel) or ``"xtrans"`` (another mosaic that LibRaw can develop)."""
    samples = whole(tags, 277, 1)
    if whole(tags, 262, 0) == LINEAR_RAW_PHOTOMETRIC:
        if samples != 3:
            raise CaptureError(f"{name}: linear DNG of {samples} channels, needed 3; give the camera's own file")
        return "linear"
    if samples != 1:
        raise CaptureError(f"{name}: mosaic of {samples} samples a pixel, needed 1; give the camera's own file")
    repeat, layout = numbers(tags, 33421), whole(tags, 50711, 1)
    shape = () if repeat is None else tuple(int(n) for n in repeat)
    pattern = bytes(tags[33422].value) if 33422 in tags else b""
    if layout != 1:
        raise CaptureError(f"{name}: CFALayout {layout}, a staggered mosaic; needed a rectangular one; convert it")
    if shape == (2, 2) and cfa_of(tags) in BAYER:
        return "bayer"
    if shape == (6, 6) and len(pattern) == 36 and set(pattern) == {0, 1, 2}:
        return "xtrans"
    size = " x ".join(map(str, shape))
    raise CaptureError(
        f"{name}: colour filter {pattern.hex()} of {size or 'no size'}, needed 2x2 Bayer of red, green, blue or "
        "X-Trans; convert the file to a linear DNG"
    )


def cfa_of(tags: Tags) -> str:
    """Letters of the CFA pattern; "?" for what is neither red, green nor blue."""
    planes = bytes(tags[50710].value) if 50710 in tags else b"\0\1\2"
    letters = {plane: "RGB?"[min(plane, 3)] for plane in planes}
    return "".join(letters.get(number, "?") for number in bytes(tags[33422].value))


def sensor_of(name: str, main: Tags, tags: Tags) -> dict[str, Any]:
    """Size, CFA, black, white, linear limit of a DNG's raw directory ``tags``. Raises CaptureError, one line."""
    kind = mosaic_of(name, tags)
    top, left, bottom, right = active_area(tags)
    limit = numbers(main, 50734)
    if limit is not None and not 0.05 < limit[0] <= 1:
        raise CaptureError(f"{name}: LinearResponseLimit is {limit[0]:g}, needed above 0 and at most 1; fix the file")
    black, white = black_of(name, tags, kind), white_of(name, tags)
    if 0 < white <= black.max():
        raise CaptureError(
            f"{name}: BlackLevel {black.max():g} is not below WhiteLevel {white:g}; fix or copy the file again"
        )
    return {
        "width": right - left,
        "height": bottom - top,
        "cfa": cfa_of(tags) if kind == "bayer" else "",
        "black": black,
        "white": white,
        "linear_limit": 1.0 if limit is None else float(limit[0]),
    }


def active_area(tags: Tags) -> Box:
    """ActiveArea (top, left, bottom, right) of a raw directory, by default all of it."""
    height, width = whole(tags, 257, 0), whole(tags, 256, 0)
    area = numbers(tags, 50829)
    if area is None:
        return 0, 0, height, width
    top, left, bottom, right = (int(value) for value in area)
    origin, size = numbers(tags, 50719), numbers(tags, 50720)
    if size is not None and size.size == 2:
        needed = size + (np.zeros(2) if origin is None else origin)
        if needed[0] > right - left + 1 or needed[1] > bottom - top + 1:  # both are rationals, and some round up
            raise ValueError(f"ActiveArea {area.tolist()} does not hold the default crop {needed.tolist()}")
    if any(t < bottom and top < b and le < right and left < r for t, le, b, r in masked_areas(tags)):
        raise ValueError(f"ActiveArea {area.tolist()} overlaps MaskedAreas")
    if not (0 <= top < bottom <= height and 0 <= left < right <= width):
        raise ValueError(f"ActiveArea {area.tolist()} lies outside the picture")
    return top, left, bottom, right


def masked_areas(tags: Tags) -> list[Box]:
    """MaskedAreas: rectangles of photosites without light, in stored coordinates; less those that are none."""
    values, (height, width) = numbers(tags, 50830), (whole(tags, 257, 0), whole(tags, 256, 0))
    boxes = [] if values is None or values.size % 4 else values.astype(int).reshape(-1, 4).tolist()
    return [(t, le, b, r) for t, le, b, r in boxes if 0 <= t < b <= height and 0 <= le < r <= width]


def black_of(name: str, tags: Tags, kind: str) -> np.ndarray:
    """BlackLevel with the mean of its deltas: (2, 2) DN in CFA cell order from ActiveArea, or (1, 3) of R, G, B."""
    samples = whole(tags, 277, 1)
    level, repeat = numbers(tags, 50714), numbers(tags, 50713)
    rows, columns = (1, 1) if repeat is None else (int(repeat[0]), int(repeat[1]))
    cell = np.zeros((1, 1, samples)) if level is None else level.reshape(rows, columns, samples)
    cell = cell + sum(float(delta.mean()) for code in (50715, 50716) if (delta := numbers(tags, code)) is not None)
    if kind == "linear":
        return np.asarray(cell.mean((0, 1)).reshape(1, 3))
    if kind == "xtrans":
        pattern = np.frombuffer(bytes(tags[33422].value), np.uint8).reshape(6, 6)
        spread = np.tile(cell[..., 0], (6 * rows, 6 * columns))[: 6 * rows, : 6 * columns]
        colours = np.tile(pattern, (rows, columns))
        return np.array([[spread[colours == number].mean() for number in range(3)]])
    cells = np.tile(cell[..., 0], (2, 2))
    if (rows > 2 or columns > 2) and not all(np.array_equal(cells, np.roll(cells, 2, axis)) for axis in (0, 1)):
        raise CaptureError(f"{name}: BlackLevel repeats over {rows} x {columns}, needed at most 2 x 2; convert it")
    return np.asarray(cells[:2, :2])


def black_ripple(tags: Tags) -> np.ndarray | None:
    """What BlackLevelDeltaH and V add to the mean black, (H, W) of the active area; None when it is nothing."""
    top, left, bottom, right = active_area(tags)
    along, down = numbers(tags, 50715), numbers(tags, 50716)
    ripple = np.zeros((bottom - top, right - left), np.float32)
    for delta, size, shape in ((along, right - left, (1, -1)), (down, bottom - top, (-1, 1))):
        if delta is not None:
            if delta.size != size:
                raise ValueError(f"{delta.size} black level deltas for {size} photosites")
            ripple += (delta - delta.mean()).reshape(shape).astype(np.float32)
    return ripple if ripple.any() else None


def white_of(name: str, tags: Tags) -> float:
    """WhiteLevel DN; 0 where nothing says it (samples through a table, whose range the tag alone knows)."""
    level = numbers(tags, 50717)
    if level is None:
        if floating(tags):
            return 1.0
        return 0.0 if 50712 in tags else float(2 ** whole(tags, 258, 16) - 1)
    if np.ptp(level) > 0:
        raise CaptureError(f"{name}: WhiteLevel {level.tolist()} differs by channel, needed one; convert the file")
    return float(level[0])


def floating(tags: Tags) -> bool:
    """Whether the samples are IEEE numbers."""
    return whole(tags, 339, 1) == 3


def colour_of(tags: Tags) -> tuple[dict[str, Any], list[str]]:
    """Colour and noise facts with AnalogBalance and CameraCalibration folded into the ColorMatrices, and marks.

    ForwardMatrix maps white balanced camera_rgb to XYZ D50; a diagonal calibration cancels out of it (chapter 6), with
    another one it is left out.
    """
    balance, marks = numbers(tags, 50727), []
    gains = np.ones(3) if balance is None or balance.size != 3 else balance

    def matrix(code: int) -> np.ndarray | None:
        values = numbers(tags, code)
        return values.reshape(3, 3) if values is not None and values.size == 9 and values.any() else None

    facts: dict[str, Any] = {}
    for suffix, colour, calibration, forward in (("", 50721, 50723, 50964), ("_2", 50722, 50724, 50965)):
        color_matrix, own = matrix(colour), matrix(calibration)
        own = np.eye(3) if own is None else own
        facts["color_matrix" + suffix] = None if color_matrix is None else gains[:, None] * (own @ color_matrix)
        facts["forward_matrix" + suffix] = matrix(forward)
        if np.any(own != np.diag(np.diag(own))) and facts["forward_matrix" + suffix] is not None:
            facts["forward_matrix" + suffix] = None
            marks.append("ForwardMatrix left out: CameraCalibration mixes channels")
    neutral, noise = numbers(tags, 50728), numbers(tags, 51041)
    if neutral is None and 50729 in tags:
        marks.append("white balance is stated as AsShotWhiteXY, which is not used")
    if 52531 in tags:
        marks.append("the third calibration illuminant is not used")
    facts |= {
        "illuminant": whole(tags, 50778, 0),
        "illuminant_2": whole(tags, 50779, 0),
        "as_shot_neutral": neutral if neutral is not None and neutral.size == 3 else None,
        "noise_profile": noise if noise is not None and noise.size in (2, 6) else None,
    }
    return facts, marks


def opcodes_of(tags: Tags, code: int) -> list[Opcode]:
    """Entries of an OpcodeList tag (big-endian whatever the file). Raises ValueError when it is damaged."""
    if code not in tags:
        return []
    data = bytes(tags[code].value)
    try:
        (count,), at, found = struct.unpack_from(">I", data), 4, []
        for _ in range(count):
            number, _, flags, size = struct.unpack_from(">IIII", data, at)
            at += 16
            if at + size > len(data):
                raise ValueError(f"OpcodeList {code} ends within its entries")
            found.append(Opcode(OPCODES.get(number, f"opcode {number}"), bool(flags & 1), data[at : at + size]))
            at += size
    except struct.error as error:
        raise ValueError(f"OpcodeList {code} is damaged") from error
    return found


def listed_defects(tags: Tags) -> np.ndarray:
    """Photosites (N, 2) row, column of the active area in FixBadPixelsList of OpcodeList1, boxes filled."""
    top, left, bottom, right = active_area(tags)
    places: list[np.ndarray] = [np.zeros((0, 2), int)]
    for opcode in opcodes_of(tags, 51008):
        if opcode.name == "FixBadPixelsList":
            _, points, boxes = struct.unpack_from(">III", opcode.data)
            if points + boxes > MAX_BAD_PIXELS or 12 + 8 * points + 16 * boxes != len(opcode.data):
                raise ValueError(f"FixBadPixelsList of {points} points and {boxes} boxes is damaged")
            values = np.frombuffer(opcode.data, ">u4", offset=12).astype(int)
            places.append(values[: 2 * points].reshape(-1, 2))
            for t, le, b, r in values[2 * points :].reshape(-1, 4):
                if not (t < b and le < r and (b - t) * (r - le) <= MAX_BAD_PIXELS):
                    raise ValueError("FixBadPixelsList names a box without an end")
                places.append(np.add(np.argwhere(np.ones((b - t, r - le), bool)), (t, le)))
    listed = np.unique(np.concatenate(places), axis=0) - (top, left)
    inside = np.all((listed >= 0) & (listed < (bottom - top, right - left)), axis=1)
    return np.asarray(listed[inside])


def defect_value(tags: Tags) -> int | None:
    """DN that marks a defect in the samples (FixBadPixelsConstant of OpcodeList1)."""
    values = [o.data for o in opcodes_of(tags, 51008) if o.name == "FixBadPixelsConstant"]
    return int(struct.unpack_from(">I", values[0])[0]) if values else None


def vignetting_of(tags: Tags) -> np.ndarray | None:
    """k0..k4 of the gain and its centre x, y (7,) that FixVignetteRadial of OpcodeList3 states; None without it."""
    for opcode in opcodes_of(tags, 51022):
        if opcode.name == "FixVignetteRadial" and len(opcode.data) == 56:
            return np.array(struct.unpack(">7d", opcode.data))
    return None


def oddities(name: str, main: Tags, tags: Tags) -> Iterator[str]:
    """What is odd about the file and does not forbid its use. Raises CaptureError for curves that are not applied."""
    for code, label in ((51008, "OpcodeList1"), (51009, "OpcodeList2"), (51022, "OpcodeList3")):
        for opcode in opcodes_of(tags, code):
            if opcode.name in CURVES and label != "OpcodeList3" and not opcode.optional:
                raise CaptureError(
                    f"{name}: {label} maps samples by {opcode.name}, which is not applied; give the camera's own file"
                )
            if not opcode.name.startswith(("FixBadPixels", "FixVignetteRadial")):
                yield f"{label} {opcode.name} is not applied"
    yield from _coding_oddities(tags)
    scale = numbers(tags, 50718)
    if scale is not None and scale.size == 2 and scale[0] != scale[1]:
        yield f"pixels are not square: DefaultScale {scale[0]:g}, {scale[1]:g}"
    if (reduced := numbers(main | tags, 50935)) is not None and reduced[0] > 0:
        yield f"noise was reduced in the file (NoiseReductionApplied {reduced[0]:g}): variances are too large"
    if (ripple := black_ripple(tags)) is not None:
        yield f"black differs along rows and columns by up to {np.ptp(ripple):.2g} DN; subtracted"


def _coding_oddities(tags: Tags) -> Iterator[str]:
    compression, bits = whole(tags, 259, 1), whole(tags, 258, 16)
    if compression == 34892:
        yield "lossy JPEG: coding errors are not in the variance"
    if compression == 52546:
        distance = numbers(tags, 52553)
        if distance is None or distance[0] > 0:
            said = "of unstated distance" if distance is None else f"of distance {distance[0]:g}"
            yield f"JPEG XL {said}, not lossless: coding errors are not in the variance"
    if bits < 12 and not floating(tags):
        yield f"{bits}-bit samples: steps between them are not in the variance"


def lens_of(tags: Tags) -> str:
    """Lens as DNG LensInfo says it (focal lengths, f-numbers); empty when absent."""
    tag = tags.get(50736)
    pairs = list(tag.value) if tag is not None and isinstance(tag.value, tuple) else []
    values = [a / b if b else 0.0 for a, b in zip(pairs[0::2], pairs[1::2])]
    if len(values) != 4 or not values[0]:
        return ""
    span = f"{values[0]:g}" if values[0] == values[1] else f"{values[0]:g}-{values[1]:g}"
    return f"{span} mm" + (f" f/{values[2]:g}" if values[2] else "")


def semantic_masks(pages: list[Any]) -> bool:
    """Whether the file carries masks of what is seen, as phones write beside their merged pictures."""
    return any(52526 in (tags := tags_of(page)) or whole(tags, 254, 0) & 0x10004 == 0x10004 for page in pages)


def phone_maker(tags: Tags) -> str:
    """Maker's name when it makes phones that merge frames; empty otherwise."""
    from pipeline.image.computational import PHONES

    maker = text(tags, 271)
    return maker if maker.lower().startswith(PHONES) else ""
