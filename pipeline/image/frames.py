"""The one door for photographs: what a file says about itself and its samples, whatever its format.

RAW (mosaic DNG and every camera's own) is `pipeline.image.raw`, all else `pipeline.image.encoded`; the suffix decides,
and for .tif the content, because some cameras name their RAW so.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.image import encoded, raw
from pipeline.types import Frame


def is_encoded(path: Path) -> bool:
    """Whether a file is a picture and no RAW, by its suffix, of a .tif by its tags."""
    suffix = path.suffix.lower()
    return suffix in encoded.SUFFIXES and not (suffix in encoded.TIFF and encoded.is_mosaic_tiff(path))


def read_frame(path: Path, name: str = "") -> Frame:
    """What a photograph says about itself; ``name`` (default: the file's) becomes ``Frame.file``.

    Raises CaptureError, one line, when it cannot be used.
    """
    return encoded.read_metadata(path, name) if is_encoded(path) else raw.read_metadata(path, name)


def read_samples(path: Path, frame: Frame) -> np.ndarray:
    """Samples as stored: (H, W) DN of a mosaic, (H, W, 3) of a frame with an empty ``cfa``.

    Raises CaptureError when they cannot be decoded or are not what ``frame`` says.
    """
    return encoded.read_samples(path, frame) if is_encoded(path) else raw.read_mosaic(path, frame)
