"""A camera that capture.toml states number by number."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.run.errors import ManifestError
from pipeline.types import Camera


def given_camera(given: dict[str, Any], where: str = "camera") -> Camera:
    """The manifest's numbers as a camera. Raises ManifestError with every problem."""
    known = {"width", "height", "fx", "fy", "cx", "cy", "distortion"}
    problems = [f"{where}.given.{key}: unknown key" for key in sorted(set(given) - known)]
    problems += [f"{where}.given.{key}: missing; it is required" for key in sorted(known - set(given) - {"distortion"})]
    distortion = np.ravel(given.get("distortion", []))
    if len(distortion) > 5:
        problems.append(f"{where}.given.distortion: has {len(distortion)} terms; expected at most 5 (k1 k2 p1 p2 k3)")
    if problems:
        raise ManifestError(*problems)
    numbers = {key: given[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
    if min(numbers["width"], numbers["height"], numbers["fx"], numbers["fy"]) <= 0:
        raise ManifestError(f"{where}.given: is {numbers}; expected positive sizes and focal lengths")
    return Camera(**numbers, distortion=np.pad(distortion, (0, 5 - len(distortion))), source="given")
