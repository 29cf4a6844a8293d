"""Objects as Mitsuba shapes: a mesh in the world frame with its material, colours converted to ACEScg."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.image.colour import Space, convert
from pipeline.transport.meshes import Material, Mesh


def color_texture(mi: Any, rgb: np.ndarray) -> dict[str, Any]:
    """A colour, (3,), or a texture, (H, W, 3) with its first row at v = 1, taken as it is (no colour conversion)."""
    values = np.asarray(rgb, np.float32).reshape(1, 1, 3) if np.ndim(rgb) == 1 else np.asarray(rgb, np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(values[::-1]))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}


def scalar_texture(mi: Any, value: float, texture: np.ndarray | None) -> Any:
    """A number, or a texture (H, W) times a number."""
    if texture is None:
        return {"type": "uniform", "value": float(value)} if value else {"type": "uniform", "value": 0.0}
    bitmap = mi.Bitmap(np.ascontiguousarray(texture[::-1, :, None] * value, np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}


def material_bsdf(mi: Any, material: Material, space: Space = "linear_rec709") -> dict[str, Any]:
    """Mitsuba description of a metallic-roughness material whose colours are linear in ``space``."""
    color = np.asarray(material.base_color, float)
    if material.base_texture is not None:
        color = material.base_texture * color
    return {
        "type": "insitu_gltf",
        "base_color": color_texture(mi, np.clip(convert(color, space, "acescg"), 0.0, 1.0)),
        "metallic": scalar_texture(mi, material.metallic, material.metallic_texture),
        "roughness": scalar_texture(mi, material.roughness, material.roughness_texture),
    }


def mesh_shape(mi: Any, name: str, mesh: Mesh, world_from_mesh: np.ndarray, bsdf: dict[str, Any]) -> Any:
    """A Mitsuba mesh in the world frame."""
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), props, True, mesh.uv is not None)
    vertices = mesh.vertices @ world_from_mesh[:3, :3].T + world_from_mesh[:3, 3]
    normals = mesh.normals @ np.linalg.inv(world_from_mesh[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices.ravel(), np.float32)
    parameters["vertex_normals"] = np.ascontiguousarray(normals.ravel(), np.float32)
    parameters["faces"] = np.ascontiguousarray(mesh.faces.ravel(), np.uint32)
    if mesh.uv is not None:
        parameters["vertex_texcoords"] = np.ascontiguousarray(mesh.uv.ravel(), np.float32)
    parameters.update()
    return shape
