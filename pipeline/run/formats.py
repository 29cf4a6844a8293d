"""Kind of artifact -> how it is written and read. The only opener of build files.

Everything appears whole: written to a temporary name in the same folder, then renamed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG
from pipeline.image.blank import blank
from pipeline.run.errors import ArtifactError
from pipeline.run.stage import STATED, Artifact
from pipeline.types import Raster

AP1_CHROMATICITIES = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# Attributes of how an EXR lies on disk: a reader of the picture gets none of them.
LAYOUT = frozenset(
    ("compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio", "screenWindowCenter",
     "screenWindowWidth")
)  # fmt: skip


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary sibling that replaces ``path`` when the block ends well and vanishes when it does not.

    Raises ArtifactError when it cannot be written: the disk is full, or read only.
    """
    scratch = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        yield scratch / path.name
        if path.is_dir():
            path.rename(scratch / "old")
        os.replace(scratch / path.name, path)
    except OSError as error:
        raise ArtifactError(
            f"{path}: cannot be written ({error.strerror or error}), needed room and permission there; make some and "
            "run the same command again, what is finished is kept"
        ) from error
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a small file atomically."""
    with atomic_path(path) as scratch:
        scratch.write_bytes(data)


@contextlib.contextmanager
def threads() -> Iterator[None]:
    """Compress and expand EXR files on all cores; the bytes are the same.

    For commands only, and ended with them: threads do not survive a fork, and a child that waits for them waits for
    ever.
    """
    import OpenEXR

    before = OpenEXR.global_thread_count()
    OpenEXR.set_global_thread_count(os.cpu_count() or 1)
    try:
        yield
    finally:
        OpenEXR.set_global_thread_count(before)


def write_exr(path: Path, raster: Raster, half: bool = False) -> None:
    """Write a single-part scanline EXR, ZIP: uint32 and float16 arrays as they are, all others float32 (or half).

    Where the attribute ``dataWindow`` names a part of the picture, only that is written, zeros are read around it.
    Raises ValueError when channels differ in size. OpenEXR writes wrong pixels from non-contiguous arrays, so every
    channel is made contiguous first.
    """
    import OpenEXR

    shapes = {values.shape for values in raster.channels.values()}
    if len(shapes) != 1:
        raise ValueError(f"{path}: channels of different sizes {sorted(shapes)}")
    height, width = shapes.pop()
    whole = ((0, 0), (width - 1, height - 1))
    part = rows_and_columns(raster.attributes.get("dataWindow", whole))
    kept = {np.dtype(np.uint32), np.dtype(np.float16)}
    float_type = np.float16 if half else np.float32
    channels = {
        name: np.ascontiguousarray(values[part], values.dtype if values.dtype in kept else float_type)
        for name, values in raster.channels.items()
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "displayWindow": whole}
    header |= raster.attributes
    if "envmap" in header:
        header["envmap"] = {"latlong": OpenEXR.ENVMAP_LATLONG, "cube": OpenEXR.ENVMAP_CUBE}[header["envmap"]]
    header["insitu:space"] = raster.space
    if raster.space == ACESCG:
        header["chromaticities"] = AP1_CHROMATICITIES
    with atomic_path(path) as scratch:
        try:
            OpenEXR.File(header, channels).write(str(scratch))
        except RuntimeError as error:
            raise OSError(str(error).replace(str(scratch), path.name)) from error


def read_exr(path: Path, space: str | None = None, without_opaque: bool = False) -> Raster:
    """Read an EXR, all channels as stored (half widened to float32).

    The picture is that of its display window: zero where there are no data, cut where data lie beyond it. An alpha that
    is 1 wherever there are data is dropped if ``without_opaque``.
    ``space`` None takes what the file says. Raises ArtifactError when it cannot be read, or its space is another one.
    """
    import OpenEXR

    if not path.exists():
        raise ArtifactError(f"{path}: missing; run the stage that writes it")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header, pixels = dict(file.header()), file.channels()  # closing the file empties its header
            if without_opaque and "A" in pixels and len(pixels) > 1 and np.all(np.asarray(pixels["A"].pixels) == 1):
                del pixels["A"]
            channels = {
                name: displayed(np.asarray(c.pixels, np.uint32 if c.pixels.dtype == np.uint32 else np.float32), header)
                for name, c in pixels.items()
            }
    except (RuntimeError, ValueError) as error:
        raise ArtifactError(f"{path}: not a readable EXR ({error})") from error
    if "envmap" in header:
        header["envmap"] = "cube" if header["envmap"] == OpenEXR.ENVMAP_CUBE else "latlong"
    found = header.get("insitu:space")
    if found is None:
        found = space_of_chromaticities(header.get("chromaticities"))
    if space is not None and found is not None and found != space:
        raise ArtifactError(f"{path}: colour space is {found}, expected {space}; re-run the stage that writes it")
    known = {*LAYOUT, "type", "channels", "insitu:space"}
    if found not in (None, "unknown"):
        known.add("chromaticities")  # primaries without a name stay in the attributes
    return Raster(channels, found or space or "unknown", {k: v for k, v in header.items() if k not in known})


def rows_and_columns(window: Any) -> tuple[slice, slice]:
    """Of a window as OpenEXR has it: x, y of the first and of the last pixel."""
    (left, top), (right, bottom) = ((int(v) for v in corner) for corner in window)
    return slice(top, bottom + 1), slice(left, right + 1)


def data_window(rows: slice, columns: slice) -> tuple[tuple[int, int], tuple[int, int]]:
    """The same the other way round."""
    return (int(columns.start), int(rows.start)), (int(columns.stop) - 1, int(rows.stop) - 1)


def displayed(pixels: np.ndarray, header: dict[str, Any]) -> np.ndarray:
    """Pixels of the data window brought to the display window."""
    data, shown = (rows_and_columns(header[name]) for name in ("dataWindow", "displayWindow"))
    if data == shown:
        return pixels
    picture = blank(tuple(axis.stop - axis.start for axis in shown)).view(pixels.dtype)
    both = [slice(max(d.start, s.start), min(d.stop, s.stop)) for d, s in zip(data, shown, strict=True)]
    if all(axis.start < axis.stop for axis in both):
        to, of = (
            tuple(slice(b.start - own.start, b.stop - own.start) for b, own in zip(both, window, strict=True))
            for window in (shown, data)
        )
        picture[to] = pixels[of]
    return picture


def space_of_chromaticities(chromaticities: Any) -> str | None:
    """``acescg``, ``linear_rec709`` or None for the EXR attribute of eight floats."""
    if chromaticities is None:
        return None
    values = np.asarray(chromaticities, float).ravel()
    for name, known in ((ACESCG, AP1_CHROMATICITIES), ("linear_rec709", REC709_CHROMATICITIES)):
        if np.allclose(values, known, atol=2e-4):
            return name
    return None


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write (H, W, 3) or (H, W) uint8."""
    from PIL import Image

    with atomic_path(path) as scratch:
        Image.fromarray(np.ascontiguousarray(picture)).save(scratch, format="PNG", compress_level=4)


def read_png(path: Path) -> np.ndarray:
    """(H, W, C) or (H, W) as stored, 8 or 16 bit."""
    picture = _decode(path)
    return picture if picture.ndim == 2 else np.ascontiguousarray(picture[..., 2::-1])


def _decode(path: Path) -> np.ndarray:
    """Picture as stored, its colours in OpenCV's order: (H, W), or (H, W, 3 or 4) as B G R A."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise ArtifactError(f"{path}: not a readable picture")
    return picture


def read_linear(path: Path) -> Raster:
    """A linear picture .exr or .hdr (Radiance): R G B as stored, finite or not; space ``unknown`` when not said.

    Attributes of a Radiance header are ``exposure`` (1 when not said; radiance is the value over it) and, where given,
    ``chromaticities``. Raises ArtifactError when the file cannot be read or has no colours.
    """
    if path.suffix.lower() != ".exr":
        return _read_radiance(path)
    raster = read_exr(path)
    names = ["R", "G", "B"] if {"R", "G", "B"} <= raster.channels.keys() else ["Y"] * 3
    if not set(names) <= raster.channels.keys():
        raise ArtifactError(f"{path}: channels are {', '.join(sorted(raster.channels))}; expected R G B or Y")
    rgb = np.stack([raster.channels[name] for name in names], -1)
    return Raster(Raster.split(rgb), raster.space, raster.attributes)


def read_latlong(path: Path) -> Raster:
    """`read_linear` of a map of all directions. Raises ArtifactError, too, when it is not twice as wide as high."""
    found = read_linear(path)
    height, width = found.shape
    if width != 2 * height:
        raise ArtifactError(f"{path}: is {width} x {height}; expected a lat-long map, twice as wide as high; crop none")
    return found


def _read_radiance(path: Path) -> Raster:
    """A Radiance picture: decoded by cv2, which drops the header's EXPOSURE and PRIMARIES lines; they are kept."""
    import cv2

    if not path.is_file():
        raise ArtifactError(f"{path}: missing; expected a Radiance .hdr")
    head = path.read_bytes()[:8192].split(b"\n\n", 1)[0].decode("latin-1").replace("\r", "")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the reason of a refusal is ours to say
    try:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if picture is None or picture.ndim != 3 or picture.dtype != np.float32:
        raise ArtifactError(f"{path}: not a readable Radiance .hdr: cut off or damaged; export it again, or as .exr")
    attributes: dict[str, Any] = {"exposure": 1.0}
    try:
        for line in head.splitlines():
            if line.startswith("EXPOSURE="):
                attributes["exposure"] *= float(line.split("=")[1])
            elif line.startswith("PRIMARIES="):
                attributes["chromaticities"] = tuple(float(value) for value in line.split("=")[1].split())
    except ValueError as error:
        raise ArtifactError(f"{path}: its header says {line!r}, which is no number; export it again") from error
    space = space_of_chromaticities(attributes.get("chromaticities")) or "unknown"
    return Raster(Raster.split(np.ascontiguousarray(picture[..., ::-1])), space, attributes)


def read_mask(path: Path) -> np.ndarray:
    """Coverage (H, W) float32 in [0, 1] of a mask picture, .png (8 or 16 bit) or .exr: 1 in front, 0 not.

    Grey, or a colour picture whose channels agree; an alpha of 1 throughout says nothing and is dropped; so is one that
    is 1 within a crop (an EXR's data window), outside which the mask is 0. Raises
    ArtifactError when the picture cannot be read, is ambiguous, or leaves [0, 1].
    """
    if path.suffix.lower() == ".exr":
        named = read_exr(path, without_opaque=True).channels
    else:
        stored = _decode(path)
        planes = np.atleast_3d(stored.astype(np.float32) / np.iinfo(stored.dtype).max)
        named = {name: planes[..., i] for i, name in enumerate("BGRA"[: planes.shape[-1]])}
    layers = [layer for name, layer in named.items() if name != "A" or len(named) == 1 or np.any(layer != 1)]
    mask = np.asarray(layers[0], np.float32)
    if any(not np.array_equal(layer, layers[0]) for layer in layers):
        raise ArtifactError(f"{path}: its {len(layers)} channels differ; expected a grey picture; save one channel")
    if not (np.isfinite(mask).all() and mask.min() >= 0 and mask.max() <= 1):
        raise ArtifactError(f"{path}: values from {mask.min():.3g} to {mask.max():.3g}; expected 0 to 1")
    return mask


def write(folder: Path, artifact: Artifact, value: Any) -> Path:
    """Write a value as its artifact says; returns the path."""
    path = folder / artifact.filename
    if artifact.kind == "json":
        from pydantic import TypeAdapter

        adapter = TypeAdapter(artifact.type)
        write_bytes(path, adapter.dump_json(value, indent=1) + b"\n")
    elif artifact.kind == "raster":
        _check(path, artifact, value)
        write_exr(path, value)
    elif artifact.kind == "rasters":
        with atomic_path(path) as scratch:
            for name, raster in value.items():
                _check(path / name, artifact, raster)
                write_exr(scratch / f"{name}.exr", raster)
            scratch.mkdir(exist_ok=True)
    elif artifact.kind == "picture":
        write_png(path, value)
    else:
        write_bytes(path, value.encode())
    return path


def _check(path: Path, artifact: Artifact, raster: Raster) -> None:
    if artifact.space not in (STATED, raster.space):
        raise ArtifactError(f"{path}: stage wrote colour space {raster.space}, declared {artifact.space}")


def _space(artifact: Artifact) -> str | None:
    return None if artifact.space == STATED else artifact.space


def read(folder: Path, artifact: Artifact) -> Any:
    """Read an artifact back; raises ArtifactError when it is missing or not what its row says."""
    path = folder / artifact.filename
    if not path.exists():
        raise ArtifactError(f"{path}: missing; run the stage that writes {artifact.name}")
    if artifact.kind == "json":
        from pydantic import TypeAdapter, ValidationError

        try:
            return TypeAdapter(artifact.type).validate_json(path.read_bytes())
        except ValidationError as error:
            raise ArtifactError(f"{path}: does not read as {artifact.name} ({error.error_count()} problems)") from error
    if artifact.kind == "raster":
        return read_exr(path, _space(artifact))
    if artifact.kind == "rasters":
        return {file.stem: read_exr(file, _space(artifact)) for file in sorted(path.glob("*.exr"))}
    if artifact.kind == "picture":
        return read_png(path)
    return path.read_text()


def digest(path: Path) -> str:
    """sha256 of a file, or of the names and contents of a folder."""
    total = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if path.is_dir():
            total.update(str(file.relative_to(path)).encode())
        if file.is_file():
            with file.open("rb") as stream:
                total.update(hashlib.file_digest(stream, "sha256").digest())
    return total.hexdigest()
