"""A camera that another program placed: a matrix, a line of a .chan file, or a camera of a USD stage.

All give ``world_from_camera`` of conventions: metres, +Y up; camera x right, y down, z forward. In .chan (Nuke,
Houdini) and USD the camera has y up and looks along -Z: its y and z axes are turned round. A .chan line is
``frame tx ty tz rx ry rz [...]``, degrees; the order names the axis applied first, Nuke's default being zxy. What the
file says of the focal length is not read: the lens is calibrated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.camera.rigid import nearest_rotation, rotation_exp
from pipeline.run.errors import ManifestError

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between y up, -z forward and y down, z forward
Y_FROM_Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
LARGEST_DEFECT = 1e-3


def rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """The matrix (4, 4) with its rotation made exact. Raises ManifestError when it is no rigid motion."""
    matrix = np.asarray(matrix, float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ManifestError(f"{where}: world_from_camera is not a 4x4 matrix; it is required by route 'given'")
    rotation = nearest_rotation(matrix[:3, :3])
    error = float(np.abs(matrix[:3, :3] - rotation).max())
    if error > LARGEST_DEFECT or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ManifestError(
            f"{where}: world_from_camera is off a rigid motion by {error:.3g}; expected a rotation (no scale, no "
            "mirror) and a last row 0 0 0 1"
        )
    exact = matrix.copy()
    exact[:3, :3] = rotation
    return exact


def read_pose(path: Path, frame: float, order: str, unit_m: float | None, prim: str | None) -> np.ndarray:
    """``world_from_camera`` (4, 4) of a .chan file or USD stage at a frame.

    ``order``: of the rotations of a .chan file; ``unit_m``: metres per unit, None for 1 (.chan) or the stage's own;
    ``prim``: path of the camera in a stage, None when it has one. Raises ManifestError naming the file.
    """
    if path.suffix.lower() == ".chan":
        return chan_pose(path, frame, order, 1.0 if unit_m is None else unit_m)
    return usd_pose(path, frame, unit_m, prim)


def chan_pose(path: Path, frame: float, order: str, unit_m: float) -> np.ndarray:
    """``world_from_camera`` (4, 4) of one line of a .chan file."""
    frames = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError as error:
            raise ManifestError(f"{path}:{number}: is {line.strip()!r}; expected numbers only") from error
        if len(values) < 7:
            raise ManifestError(f"{path}:{number}: has {len(values)} numbers; expected frame tx ty tz rx ry rz")
        if values[0] == frame:
            return chan_matrix(np.array(values[1:4]) * unit_m, np.array(values[4:7]), order)
        frames.append(values[0])
    held = f"{min(frames):g} to {max(frames):g}" if frames else "none"
    raise ManifestError(f"{path}: has no frame {frame:g} (frames: {held}); set frame in [[pose]]")


def chan_matrix(position_m: np.ndarray, degrees: np.ndarray, order: str) -> np.ndarray:
    """``world_from_camera`` (4, 4) of a position and rotations (3,) about x, y, z, applied in this order."""
    pose = np.eye(4)
    for axis in order:
        at = "xyz".index(axis)
        pose[:3, :3] = rotation_exp(np.radians(degrees[at]) * np.eye(3)[at]) @ pose[:3, :3]
    pose[:3, 3] = position_m
    return pose @ FLIP


def usd_pose(path: Path, frame: float, unit_m: float | None, prim: str | None) -> np.ndarray:
    """``world_from_camera`` (4, 4) of a camera of a USD stage, its up axis and unit brought to conventions."""
    try:
        from pxr import Usd, UsdGeom
    except ImportError as error:
        raise ManifestError(f"{path}: reading USD needs the package usd-core; pip install insitu[usd]") from error
    try:
        stage = Usd.Stage.Open(str(path))
    except Exception as error:  # pxr raises its own kinds
        raise ManifestError(f"{path}: is no USD stage that opens; export it again") from error
    cameras = [one for one in stage.Traverse() if one.IsA(UsdGeom.Camera)]
    names = [str(one.GetPath()) for one in cameras]
    chosen = [one for one in cameras if prim is None or str(one.GetPath()) == prim]
    if len(chosen) != 1:
        raise ManifestError(f"{path}: cameras are {names}; expected one, or its path as prim in [[pose]]")
    matrix = np.array(UsdGeom.Xformable(chosen[0]).ComputeLocalToWorldTransform(Usd.TimeCode(frame))).T
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if lengths.min() <= 0:
        raise ManifestError(f"{path}: {chosen[0].GetPath()} is scaled to nothing; take its scale out")
    matrix[:3, :3] /= lengths  # a scaled rig scales no picture
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        matrix = Y_FROM_Z_UP @ matrix
    matrix[:3, 3] *= UsdGeom.GetStageMetersPerUnit(stage) if unit_m is None else unit_m
    return rigid(matrix @ FLIP, f"{path}: {chosen[0].GetPath()}")
