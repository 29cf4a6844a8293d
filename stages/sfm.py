"""Orient all photographs by what they show (COLMAP), when stage sources asks: poses, cloud, lens; no unit yet.

Method: SIFT features on the photographs as they are and on the developed plate and ball views through a tone curve,
exhaustive matching, incremental or global mapping (COLMAP), one seed. Views taken with the plate's camera share its
lens; a lens that capture.toml gives is held, of any other the focal length and one radial term are found here and the
rest by calibrate. Which way is up and how long a metre is, pose learns from the markers. Limits: needs texture and
photographs from places that differ; a few further views cost 10 to 30 CPU seconds at a megapixel.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.colmap_bridge import reconstruct
from pipeline.camera.given_camera import given_camera
from pipeline.camera.markers import grey, tone
from pipeline.camera.opencv_bridge import read_grey
from pipeline.camera.sfm import camera_start
from pipeline.camera.view_checks import only_turned, parallax_deg
from pipeline.run.artifacts import BRACKETS, FACTS, PHOTOGRAPHS, RECONSTRUCTION, SOURCES, VIEW_PHOTOS
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.run.stage import Stage
from pipeline.types import Bracket, Camera, Frame, Raster, Reconstruction, Result, Sources
from stages import knobs

FEW_TRACKS = 30  # a photograph with fewer sightings of the cloud hangs by a thread


def compute(
    facts: dict[str, Any], brackets: dict[str, Bracket], view_photos: list[Frame], photographs: dict[str, Raster],
    sources: Sources, params: knobs.Sfm,
) -> Result:  # fmt: skip
    """The reconstruction; empty where it is not needed. What that could cost, stage sources says."""
    if not sources.cloud:
        return Result({"reconstruction": Reconstruction()}, {"photos": 0})
    cameras, bodies = bodies_of(facts, brackets, view_photos)
    root = Path(facts["capture_root"])
    pictures = {name: _seen(photograph) for name, photograph in photographs.items() if name in bodies}
    pictures |= {photo.file: read_grey(root / photo.file) for photo in view_photos}
    for photo in view_photos:
        if pictures[photo.file].shape != (photo.height, photo.width):
            found = "x".join(str(n) for n in pictures[photo.file].shape[::-1])
            raise CaptureError(
                f"{photo.file}: decodes to {found}, metadata say {photo.width}x{photo.height}; copy again"
            )
    made = reconstruct(pictures, bodies, cameras, params.method, min(os.cpu_count() or 1, 8))
    if turned := only_turned(made):
        raise NumericalError(turned)
    warnings = [
        f"{name}: shares too little with the other photographs to be oriented; take it nearer to one of them"
        for name in made.missing
    ]
    tracks = np.bincount(made.seen_view, minlength=len(made.names))
    warnings += [
        f"{name}: {count} points of the cloud are seen in it, usual are hundreds; its pose is weak"
        for name, count in zip(made.names, tracks) if count < FEW_TRACKS
    ]  # fmt: skip
    lengths = np.bincount(made.seen_point)
    numbers = {
        "method": made.method, "photos": len(made.names), "missing": made.missing, "points": len(made.points),
        "sightings": len(made.px),
        "parallax_deg": parallax_deg(made), "median_track": float(np.median(lengths)),
        "focal_px": [c.fx for c in made.cameras],
    }  # fmt: skip
    term = {
        "term": "further views", "modelled": True,
        "because": f"{len(made.names)} of {len(pictures)} photographs hang together by {len(made.points)} points",
        "could_cost": "",
    }  # fmt: skip
    made = made.model_copy(update={"orients": sources.views})
    return Result({"reconstruction": made}, numbers, warnings, [term])


def bodies_of(
    facts: dict[str, Any], brackets: dict[str, Bracket], view_photos: list[Frame]
) -> tuple[list[Camera], dict[str, int]]:
    """Start of each lens, and which of them took each photograph. Raises CaptureError when sizes do not fit.

    Ball views with a camera of their own are left out: they are oriented by it and by the markers.
    """
    own = {ball["name"] for ball in facts["ball"] if ball.get("camera")}
    plate = brackets["plate"].frames[0]
    cameras = [_start(facts["camera"], plate, view_photos)]
    bodies = {name: 0 for name, b in brackets.items() if name not in own and b.role in ("plate", "ball")}
    other = bool(facts["views"]["own_camera"])
    size = (plate.width, plate.height) if not other else (view_photos[0].width, view_photos[0].height)
    for photo in view_photos:
        if (photo.width, photo.height) != size:
            raise CaptureError(
                f"{photo.file}: is {photo.width}x{photo.height}, needed {size[0]}x{size[1]} as "
                f"{'the others' if other else 'the plate'}; views.own_camera = true if another camera took them"
            )
    if other:
        cameras.append(camera_start(view_photos[0]))
    bodies |= {photo.file: int(other) for photo in view_photos}
    return cameras, bodies


def _hinted(plate: Frame, view_photos: list[Frame]) -> Frame:
    """The plate's frame with a focal length, where only the other photographs state one."""
    hint = next((p.focal_35mm for p in view_photos if p.focal_35mm > 0), 0.0)
    return plate if plate.focal_35mm > 0 else plate.model_copy(update={"focal_35mm": hint})


def _start(stated: dict[str, Any], plate: Frame, view_photos: list[Frame]) -> Camera:
    """The plate's lens as known so far: stated or of a former build, which are held, else what EXIF makes of it."""
    if stated.get("given"):
        return given_camera(stated["given"])
    if stated.get("former"):
        return Camera.model_validate({**stated["former"], "source": "given"})
    return camera_start(_hinted(plate, view_photos))


def _seen(photograph: Raster) -> np.ndarray:
    """(H, W) uint8 of a developed view, through the tone curve that features are found in."""
    return (tone(grey(photograph.rgb())) * 255 + 0.5).astype(np.uint8)


STAGE = Stage(
    "sfm",
    compute,
    knobs.Sfm,
    inputs={
        "facts": FACTS,
        "brackets": BRACKETS,
        "view_photos": VIEW_PHOTOS,
        "photographs": PHOTOGRAPHS,
        "sources": SOURCES,
    },
    outputs={"reconstruction": RECONSTRUCTION},
)
