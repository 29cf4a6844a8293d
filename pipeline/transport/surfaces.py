"""Objects as Mitsuba shapes: a mesh in the world frame with its material, colours converted to ACEScg.

Mitsuba's rgb variants multiply channel by channel and never ask which primaries those are. So every colour is converted
here, once, and handed over as `raw` arrays; what a product of two RGB colours means is that of their space (ACEScg),
which stands for the product of two spectra only approximately (docs/spectral.md measures that).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.image.colour import Space, convert
from pipeline.transport.conductors import preset
from pipeline.transport.materials import MIN_ALPHA
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


def material_bsdf(
    mi: Any, material: Material, space: Space = "linear_rec709", conserving: bool = True
) -> dict[str, Any]:
    """Mitsuba description of a material whose colours are linear in ``space``.

    Metallic-roughness as glTF has it; a conductor takes its colours from `pipeline.transport.conductors`; the share
    ``transmission`` of it is a thick solid of refractive index ``ior`` (glTF tints a path once: each of its two
    crossings by the root of the base colour). ``conserving``: see `pipeline.transport.materials`.
    """
    color = np.asarray(material.shown_color, float)
    if material.base_texture is not None:
        color = material.base_texture * color
    color = np.clip(convert(color, space, "acescg"), 0.0, 1.0)
    if material.transmission == 1:
        return solid_bsdf(mi, material, color)
    described = {
        "type": "insitu_gltf",
        "conserving": conserving,
        "base_color": color_texture(mi, color),
        "metallic": scalar_texture(mi, material.metallic, material.metallic_texture),
        "roughness": scalar_texture(mi, material.shown_roughness, material.roughness_texture),
        "f0": scalar_texture(mi, ((material.ior - 1) / (material.ior + 1)) ** 2, None),
    }
    if material.conductor:
        facing, edge = preset(material.conductor)
        described["base_color"], described["edge_tint"] = color_texture(mi, facing), color_texture(mi, edge)
        described["metallic"] = scalar_texture(mi, 1.0, None)
    if material.transmission:
        solid = solid_bsdf(mi, material, color)
        return {"type": "blendbsdf", "weight": float(material.transmission), "opaque": described, "solid": solid}
    return described


def solid_bsdf(mi: Any, material: Material, color: np.ndarray) -> dict[str, Any]:
    """Glass, smooth or rough, of base colour (3,) or (H, W, 3), ACEScg; air outside has index 1.

    Rough glass is Walter et al. 2007 with one scattering per crossing: under an even sky a solid ball of roughness 0.3
    keeps 97 % of the light, of 0.5 only 81 %.
    """
    alpha = material.shown_roughness**2
    rough = {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha}
    return {
        **(rough if alpha > MIN_ALPHA else {"type": "dielectric"}),
        "int_ior": float(material.ior),
        "ext_ior": 1.0,
        "specular_transmittance": color_texture(mi, np.sqrt(color)),
    }


def area_emitter(mi: Any, material: Material, space: Space, white: float) -> dict[str, Any] | None:
    """Mitsuba description of the light that a material sends out, None when there is none.

    ``white`` is the radiance that an emission of 1 stands for: that of a white surface lying on the plane,
    luminance of the irradiance / pi. A scalar, so that the emission keeps its own colour under any light.
    """
    if not any(material.emission) or white == 0:
        return None
    color = np.asarray(material.emission, float) * white
    if material.emission_texture is None:
        radiance = np.maximum(convert(color, space, "acescg"), 0.0)
        return {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}}
    radiance = np.maximum(convert(material.emission_texture * color, space, "acescg"), 0.0)
    # Mitsuba samples a textured light by its texture and takes texture coordinates for unique, which those of a file
    # need not be. Left to paths that meet it, it is right, and noisier.
    return {"type": "area", "radiance": color_texture(mi, radiance), "sampling_weight": 0.0}


def mesh_shape(
    mi: Any,
    name: str,
    mesh: Mesh,
    world_from_mesh: np.ndarray,
    bsdf: dict[str, Any],
    emitter: dict[str, Any] | None = None,
) -> Any:
    """A Mitsuba mesh in the world frame; an area light, one-sided, when it has an emitter."""
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    if emitter is not None:
        props["mesh_emitter"] = mi.load_dict(emitter)
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


def object_shape(
    mi: Any,
    name: str,
    mesh: Mesh,
    world_from_mesh: np.ndarray,
    material: Material,
    space: Space,
    white: float,
    conserving: bool = True,
) -> tuple[Any, list[str]]:
    """A mesh as a Mitsuba shape with its material and light, and warnings; see `area_emitter` and `material_bsdf`."""
    bsdf, emitter = material_bsdf(mi, material, space, conserving), area_emitter(mi, material, space, white)
    flaw = mesh.flaw_as_solid() if material.transmission else ""
    warnings = [f"{name}: lets light through, but {flaw}; it is refracted as if it were a solid"] if flaw else []
    if material.transmission and material.roughness_texture is not None:
        warnings.append(f"{name}: a roughness texture is left out of what lets light through")
    return mesh_shape(mi, name, mesh, world_from_mesh, bsdf, emitter), warnings
