"""A camera that was calibrated before, taken up again with its covariance: whether it is of these photographs.

Size, body, lens and focal length must be those that metadata state. Focus is in no metadata that is read, and moves the
focal length: that is said, not known.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from pipeline.camera.distortion import MODELS
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Camera, Frame

SAME_FOCAL = 0.01  # as metadata round it


def read_camera(path: Path) -> Camera:
    """The camera.json that a build's calibrate folder holds. Raises ManifestError when it is not one."""
    try:
        camera = Camera.model_validate(json.loads(path.read_bytes()))
    except (ValidationError, ValueError, OSError) as error:
        raise ManifestError(f"is {path.name!r}; expected the camera.json of a build's calibrate folder") from error
    numbers = np.concatenate(
        [[camera.fx, camera.fy, camera.cx, camera.cy], camera.distortion, camera.covariance.ravel()]
    )
    size = 4 + camera.distortion.size
    shaped = camera.distortion.ndim == 1 and size - 4 in MODELS and camera.covariance.shape == (size, size)
    if not shaped or not np.isfinite(numbers).all() or min(camera.fx, camera.fy) <= 0:
        raise ManifestError(f"is {path.name!r}, whose numbers are no camera's; calibrate again")
    return camera


def add_former_cameras(facts: dict[str, Any], manifest: Path, folders: list[Path]) -> list[str]:
    """Put what every ``camera.file`` holds beside its name, as ``former``; returns the problems found."""
    tables = {"camera": facts["camera"]}
    tables |= {f"ball[{i}].camera": ball["camera"] for i, ball in enumerate(facts["ball"]) if ball["camera"]}
    problems = []
    for key, table in tables.items():
        if not table["file"]:
            continue
        name = os.path.expandvars(table["file"])
        path = next((folder / name for folder in folders if (folder / name).is_file()), None)
        try:
            if path is None:
                listed = " or ".join(map(str, dict.fromkeys(folders)))
                raise ManifestError(f"is {table['file']!r}; no such file in {listed}")
            table["former"] = read_camera(path).model_dump(mode="json")
        except ManifestError as error:
            problems.append(f"{manifest}: {key}.file: {error}")
    return problems


def reused(former: Camera, frame: Frame, where: str) -> tuple[Camera, list[str], list[dict[str, Any]]]:
    """The former camera for photographs such as ``frame``, warnings and evidence.

    Raises CaptureError when its size, body, lens or focal length differ.
    """
    wrong = []
    if (former.width, former.height) != (frame.width, frame.height):
        wrong.append(("", f"{former.width}x{former.height}", f"{frame.width}x{frame.height}"))
    wrong += [
        (f"{key} ", repr(old), repr(new))
        for key, old, new in (("body", former.body, frame.camera), ("lens", former.lens, frame.lens))
        if old and new and old != new
    ]
    if former.focal_mm > 0 and frame.focal_mm > 0 and abs(former.focal_mm / frame.focal_mm - 1) > SAME_FOCAL:
        wrong.append(("focal length ", f"{former.focal_mm:g} mm", f"{frame.focal_mm:g} mm"))
    if wrong:
        listed = ", ".join(f"{what}{old}" for what, old, _ in wrong)
        raise CaptureError(
            f"{where}.file: is the camera of {listed}, {frame.file} is {', '.join(new for *_, new in wrong)}; needed "
            "the same; calibrate again with a board, or take it out"
        )
    warnings = []
    if not (former.focal_mm > 0 and frame.focal_mm > 0):
        whose = "the former calibration" if not former.focal_mm > 0 else frame.file
        warnings.append(
            f"{where}.file: metadata of {whose} state no focal length, so nothing tells that the zoom is the same"
        )
    term = {
        "term": "intrinsics", "modelled": True, "because": f"a former calibration ({former.source}), same by metadata",
        "could_cost": "what was refocused since: from far to 20 focal lengths, 5 % of the focal length; not in the "
        "stated uncertainty",
    }  # fmt: skip
    return former.model_copy(update={"source": "reused"}), warnings, [term]
