"""What lensfun's database knows of a body and a lens: size of the sensor, distortion, vignetting. The one importer.

Source: lensfun (database measured by its users with the ptlens, poly3 and poly5 models; no uncertainty stated). A lens
is taken only when its name finds one that has the focal length, and no second one as well.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

FAR_M = 1000.0  # distance lensfun is asked for
FULL_FRAME_DIAGONAL_MM = float(np.hypot(36.0, 24.0))  # what crop factors and 35 mm equivalents refer to


@functools.cache
def _database() -> Any:
    import lensfunpy

    return lensfunpy.Database()


def _body(camera: str) -> Any:
    """The database's entry of a body named as EXIF does, model or maker and model; None when it is not there."""
    names = (camera.lower(), camera.split(" ", 1)[-1].lower())  # makers that begin the model with their name
    known = ((body, (body.model.lower(), f"{body.maker} {body.model}".lower())) for body in _database().cameras)
    return next((body for body, spelled in known if camera and any(name in spelled for name in names)), None)


def _lens(body: Any, name: str, focal_mm: float) -> Any:
    """The database's one lens of this name for a body, with this focal length [mm]; None when none or several fit."""
    if body is None or not name or not focal_mm > 0:
        return None
    found = sorted(_database().find_lenses(body, None, name), key=lambda one: -one.score)
    found = [one for one in found if one.min_focal * 0.95 <= focal_mm <= one.max_focal * 1.05]
    return None if not found or (len(found) > 1 and found[1].score == found[0].score) else found[0]


def sensor_diagonal_mm(camera: str) -> float | None:
    """Diagonal of a body's sensor; None when the database does not know the body."""
    body = _body(camera)
    return None if body is None else FULL_FRAME_DIAGONAL_MM / body.crop_factor


def is_fisheye(camera: str, name: str, focal_mm: float) -> bool:
    """Whether a lens is one by its name, or in the database."""
    import lensfunpy

    found = _lens(_body(camera), name, focal_mm)
    return "fisheye" in name.lower().replace("-", "") or (
        found is not None and found.type not in (lensfunpy.LensType.RECTILINEAR, lensfunpy.LensType.UNKNOWN)
    )


def vignetting_gain(
    camera: str, lens: str, focal_mm: float, fnumber: float, height: int, width: int
) -> tuple[np.ndarray, str] | None:
    """(H, W) float32 gain that undoes the loss, and the lens as lensfun names it; None unless all of it is known."""
    body = _body(camera)
    found = _lens(body, lens, focal_mm)
    if found is None or not fnumber > 0:
        return None
    import lensfunpy

    modifier = lensfunpy.Modifier(found, body.crop_factor, width, height)
    modifier.initialize(focal_mm, fnumber, FAR_M, pixel_format=np.float32, flags=lensfunpy.ModifyFlags.VIGNETTING)
    picture = np.ones((height, width, 3), np.float32)
    if not modifier.apply_color_modification(picture):
        return None
    return np.ascontiguousarray(picture[..., 1]), found.model


def distortion_samples(
    camera: str, lens: str, focal_mm: float, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, str] | None:
    """Radii (N,) px from the picture's centre without distortion and with it, and the lens as lensfun names it.

    Along half a diagonal; None unless body, lens and its distortion are known. No scaling to fill the frame is in it.
    """
    body = _body(camera)
    found = _lens(body, lens, focal_mm)
    if found is None:
        return None
    import lensfunpy

    modifier = lensfunpy.Modifier(found, body.crop_factor, width, height)
    modifier.initialize(focal_mm, 8.0, FAR_M, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    centre = np.array([width - 1, height - 1]) / 2  # lensfun counts from the first pixel's centre
    if modifier.apply_geometry_distortion(0, 0, 1, 1) is None:
        return None
    straight, bent = [], []
    for share in np.linspace(0.05, 1.0, 40):
        at = centre * (1 + share)
        moved = modifier.apply_geometry_distortion(float(at[0]), float(at[1]), 1, 1)[0, 0]
        straight.append(np.hypot(*(at - centre)))
        bent.append(np.hypot(*(moved - centre)))
    return np.array(straight), np.array(bent), found.model
