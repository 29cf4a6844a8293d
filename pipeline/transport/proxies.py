"""Triangles of proxies and occluders: boxes from their measures, mesh files as one list of triangles, world frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.transport.meshes import Mesh

# Faces of the box whose corner number is 4 [x high] + 2 [y high] + [z high], counter-clockwise seen from outside.
_BOX_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
    [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def box(centre_m: Sequence[float], size_m: Sequence[float], yaw_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) and faces (12, 3) of a box turned about +Y, counter-clockwise seen from above."""
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    yaw = np.radians(yaw_deg)
    rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    return signs * np.asarray(size_m, float) @ rotation.T + np.asarray(centre_m, float), _BOX_FACES.copy()


def join(meshes: Sequence[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) and faces (M, 3) of several meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([np.asarray(mesh.faces, int) + offset for mesh, offset in zip(meshes, offsets, strict=True)])
    return vertices, faces
