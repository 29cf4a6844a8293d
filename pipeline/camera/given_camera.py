"""A camera that capture.toml states number by number."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.distortion import MODELS, TERMS
from pipeline.run.errors import ManifestError
from pipeline.types import Camera


def given_camera(given: dict[str, Any], where: str = "camera") -> Camera:
    """The manifest's numbers as a camera. Raises ManifestError with every problem."""
    needed = {"width", "height", "fx", "fy", "cx", "cy"}
    known = needed | {"distortion", "distortion_model"}
    problems = [f"{where}.given.{key}: unknown key" for key in sorted(set(given) - known)]
    problems += [f"{where}.given.{key}: missing; it is required" for key in sorted(needed - set(given))]
    distortion = np.ravel(given.get("distortion", []))
    model = given.get("distortion_model", "brown")
    count = {name: count for count, name in MODELS.items()}.get(model)
    if count is None:
        problems.append(f"{where}.given.distortion_model: is {model!r}; expected {', '.join(MODELS.values())}")
    elif len(distortion) > count:
        terms = f"{model}: {' '.join(TERMS[count])}"
        problems.append(f"{where}.given.distortion: has {len(distortion)} terms; expected at most {count} ({terms})")
    if problems:
        raise ManifestError(*problems)
    numbers = {key: given[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
    if min(numbers["width"], numbers["height"], numbers["fx"], numbers["fy"]) <= 0:
        raise ManifestError(f"{where}.given: is {numbers}; expected positive sizes and focal lengths")
    assert count is not None
    bend = np.pad(distortion, (0, count - len(distortion)))
    return Camera(**numbers, distortion=bend, covariance=np.zeros((4 + count, 4 + count)), source="given")
