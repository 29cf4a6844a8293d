"""A lens as two pictures of coordinates (STMaps), as compositing programs warp by, from the one camera model.

Each texel says where in the other picture to look: R = (x + 0.5) / W of its column x, G = (y + 0.5) / H of its row y
counted from the bottom, W and H those of the picture that is looked into. ``undistort`` has the straight picture's size
and looks into the plate, ``distort`` has the plate's size and looks into the straight picture. The straight picture is
a pinhole of the plate's focal lengths whose frame is moved by whole pixels and large enough to hold every pixel of the
plate, so that a straight render, distorted, covers the plate (overscan).
Limits: float32, as half floats step by 0.5 px on 1000; what the lens does not image is `NOWHERE`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project, unproject
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

NOWHERE = -1.0  # outside any picture, so that a warp leaves it black
MARGIN_PX = 1  # beyond the plate's edges: a filter of a warp reads a neighbour
LARGEST = 3.0  # of the straight picture, in sides of the plate: beyond it a pinhole is the wrong picture
ROWS = 256  # of a map at once


@dataclass(frozen=True, eq=False)
class STMaps:
    """``undistort`` (H', W', 2) and ``distort`` (H, W, 2) float32, R and G; ``straight`` is the pinhole in between.

    ``offset`` is where the plate's first pixel lies in the straight picture if the lens did nothing, (x, y) px.
    """

    undistort: np.ndarray
    distort: np.ndarray
    straight: Camera
    offset: tuple[int, int]


def straight_camera(camera: Camera) -> tuple[Camera, tuple[int, int]]:
    """The pinhole that holds all of the plate, and where the plate's origin lies in it (x, y) px.

    A lens that is one-to-one maps edge to edge, so the edges of the plate bound the straight picture. Raises
    NumericalError where the model ends inside the plate, or the picture would be more than three times the plate.
    """
    x, y = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
    edge = np.concatenate([
        np.stack([x, 0 * x], -1), np.stack([x, 0 * x + camera.height], -1),
        np.stack([0 * y, y], -1), np.stack([0 * y + camera.width, y], -1),
    ])  # fmt: skip
    px = unproject(camera, edge) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    low = np.floor(px.min(0)).astype(int) - MARGIN_PX
    width, height = (int(n) for n in np.ceil(px.max(0)).astype(int) + MARGIN_PX - low)
    if width > LARGEST * camera.width or height > LARGEST * camera.height:
        raise NumericalError(
            f"lens: straightened it fills {width} x {height}, needed at most {LARGEST:g} times the plate's "
            f"{camera.width} x {camera.height}; a fisheye cannot be rendered through a pinhole, crop the plate"
        )
    straight = camera.model_copy(
        update={
            "width": width, "height": height, "cx": camera.cx - int(low[0]), "cy": camera.cy - int(low[1]),
            "distortion": np.zeros(5),
        }
    )  # fmt: skip
    return straight, (-int(low[0]), -int(low[1]))


def stmaps(camera: Camera) -> STMaps:
    """Both maps of a lens. Raises NumericalError as `straight_camera`."""
    straight, offset = straight_camera(camera)
    return STMaps(_map(straight, camera), _map(camera, straight), straight, offset)


def _map(of: Camera, into: Camera) -> np.ndarray:
    """(H, W, 2) float32: where in ``into`` each pixel centre of ``of`` is, same ray."""
    found = np.empty((of.height, of.width, 2), np.float32)
    for start in range(0, of.height, ROWS):
        stop = min(start + ROWS, of.height)
        y, x = np.meshgrid(np.arange(start, stop) + 0.5, np.arange(of.width) + 0.5, indexing="ij")
        xy = unproject(of, np.stack([x.ravel(), y.ravel()], -1))
        px = project(into, np.concatenate([xy, np.ones((len(xy), 1))], -1)).reshape(*x.shape, 2)
        found[start:stop] = st_of_pixels(px, into)
    return found


def st_of_pixels(px: np.ndarray, camera: Camera) -> np.ndarray:
    """(..., 2) R and G of pixels (..., 2), first centre (0.5, 0.5) and y down; `NOWHERE` for what is not finite."""
    st = np.stack([px[..., 0] / camera.width, 1 - px[..., 1] / camera.height], -1)
    return np.where(np.isfinite(st).all(-1, keepdims=True), st, NOWHERE)


def pixels_of_st(st: np.ndarray, camera: Camera) -> np.ndarray:
    """Inverse of `st_of_pixels`."""
    st = np.asarray(st, float)
    return np.stack([st[..., 0] * camera.width, (1 - st[..., 1]) * camera.height], -1)


def round_trip_px(maps: STMaps, camera: Camera, step: int = 1) -> np.ndarray:
    """(N,) px: how far a pixel of the plate lands from itself through both maps, as a warp reads them (bilinear)."""
    from scipy.ndimage import map_coordinates

    rows, columns = np.mgrid[: camera.height : step, : camera.width : step]
    at = pixels_of_st(maps.distort[rows, columns], maps.straight).reshape(-1, 2) - 0.5
    looked = np.stack(
        [map_coordinates(maps.undistort[..., c], [at[:, 1], at[:, 0]], np.float64, order=1) for c in range(2)], -1
    )
    back = pixels_of_st(looked, camera)
    return np.asarray(np.hypot(*(back - np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], -1)).T))
