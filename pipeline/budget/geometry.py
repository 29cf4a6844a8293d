"""How pose and lens may be wrong, seen in the picture: displacement fields of what is drawn into the plate.

The plate stays where it is; objects and their shadows are drawn through an estimated pose and lens. With the joint
covariance of both (six numbers of the pose, those of the lens, and their correlation, which undoes most of a lens
error), the displacement of every world point that is seen is J theta; its principal components over the picture are
the modes, a few because the covariance moves all points nearly alike. First order: a layer L moves by -grad(L) . d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project_jacobians
from pipeline.camera.rigid import camera_points
from pipeline.types import Camera, View


@dataclass(frozen=True, eq=False)
class Field:
    """A displacement [px] per standard uncertainty: quadratic in the pixel's position, one for objects, one for ground.

    ``on_object``, ``on_ground``: (6, 2) coefficients of 1, x, y, xx, xy, yy with x, y from -1 to 1 over the frame.
    ``rms_px``: over what is seen of both.
    """

    on_object: np.ndarray
    on_ground: np.ndarray
    rms_px: float


def joint_covariance(camera: Camera, view: View) -> np.ndarray:
    """(6 + K, 6 + K) of pose and lens; the lens's part is zero where it is part of the pose's, or given."""
    lens = len(np.asarray(camera.covariance))
    whole = np.zeros((6 + lens, 6 + lens))
    whole[:6, :6] = view.covariance
    if view.lens_covariance is not None:
        whole[:6, 6:], whole[6:, 6:] = view.lens_covariance, camera.covariance
        whole[6:, :6] = whole[:6, 6:].T
    return whole


def displacements(camera: Camera, view: View, points: np.ndarray) -> np.ndarray:
    """(N, 2, M) px of world points (N, 3) for M independent unit errors of pose and lens."""
    values, vectors = np.linalg.eigh(joint_covariance(camera, view))
    root = vectors * np.sqrt(np.maximum(values, 0))
    inside, by_pose = camera_points(view.world_from_camera, points)
    _, by_point, by_lens = project_jacobians(camera, inside)
    jacobian = np.concatenate([by_point @ by_pose, by_lens], -1)
    return np.asarray(np.where(np.isfinite(jacobian), jacobian, 0) @ root)


def terms(px: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(..., 6) the monomials of `Field` at pixel positions (..., 2)."""
    x, y = np.moveaxis(2 * px / (shape[1], shape[0]) - 1, -1, 0)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)


def fields(
    camera: Camera, view: View, points: np.ndarray, px: np.ndarray, is_object: np.ndarray, share: float
) -> list[Field]:
    """Principal displacement fields, until what is left is below ``share`` of the variance.

    ``points`` (N, 3) world, seen at ``px`` (N, 2), ``is_object`` (N,).
    """
    shape = camera.height, camera.width
    moved = displacements(camera, view, points)
    flat = moved.reshape(-1, moved.shape[-1])
    _, size, axes = np.linalg.svd(flat, full_matrices=False)
    left = 1 - np.cumsum(size**2) / max((size**2).sum(), 1e-300)
    kept = int(np.searchsorted(-left, -share)) + 1 if size.size and size[0] > 0 else 0
    found = []
    basis = terms(px, shape)
    for axis in axes[:kept]:
        shift = moved @ axis
        parts = []
        for chosen in (is_object, ~is_object):
            some = chosen if chosen.any() else np.ones(len(chosen), bool)
            parts.append(np.linalg.lstsq(basis[some], shift[some], rcond=1e-6)[0])
        found.append(Field(parts[0], parts[1], float(np.sqrt((shift**2).sum(1).mean()))))
    return found


def slope(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences per pixel (H, W, ...) to the right and down; zero for a picture one pixel wide."""
    down, right = (np.gradient(values, axis=a) if values.shape[a] > 1 else np.zeros_like(values) for a in (0, 1))
    return right, down


def moved_by(values: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """First-order change (H, W, 3) of a layer (H, W, 3) that moves by ``shift`` (H, W, 2) px."""
    right, down = slope(values)
    return np.asarray(-(right * shift[..., :1] + down * shift[..., 1:]))


def shifts(field: Field, shape: tuple[int, int], window: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 2) px within a window of the frame (H, W), of objects and of the ground."""
    rows, columns = (np.arange(size)[part] + 0.5 for size, part in zip(shape, window, strict=True))
    basis = terms(np.stack(np.meshgrid(columns, rows), -1), shape)
    return basis @ field.on_object, basis @ field.on_ground
