"""Pictures of what stands before the objects, as capture.toml names them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from pipeline.run.errors import ArtifactError, CaptureError
from pipeline.run.formats import read_mask
from pipeline.types import Occluder


def masks_of(occluders: Iterable[Occluder], shape: tuple[int, int]) -> Iterator[np.ndarray]:
    """Coverage (H, W), 0 to 1, of each occluder that is a picture.

    Raises CaptureError when a mask cannot be read or has another size than the plate, ``shape``.
    """
    for occluder in occluders:
        if occluder.mask_file is None:
            continue
        try:
            mask = read_mask(Path(occluder.mask_file))
        except ArtifactError as error:
            raise CaptureError(f"occluder {occluder.name}: {error}") from error
        if mask.shape != shape:
            raise CaptureError(
                f"occluder {occluder.name}: {occluder.mask_file} is {mask.shape[1]} x {mask.shape[0]} pixels; expected "
                f"{shape[1]} x {shape[0]}, the plate's; export it at that size"
            )
        yield mask
