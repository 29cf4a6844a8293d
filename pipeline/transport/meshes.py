"""Objects from .glb, .obj and .ply: triangles and metallic-roughness materials, in the file's own frame.

Formats are trimesh's work; this adds what it loses (colour factors are rounded to 8 bit there) and refuses what it
cannot decode.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.colour import decode_srgb
from pipeline.run.errors import ManifestError

GLB_MAGIC = b"glTF"
MODELLED_EXTENSIONS = {"KHR_materials_ior", "KHR_materials_transmission", "KHR_materials_emissive_strength"}
SUPPORTED_EXTENSIONS = {"KHR_texture_transform", "KHR_mesh_quantization"} | MODELLED_EXTENSIONS


@dataclass(frozen=True, eq=False)
class Material:
    """glTF metallic-roughness, glass, metals by name, emission. Colours linear Rec.709, or as who reads them says.

    Textures (H, W, C) are linear, first row at v = 1, or None. What is None follows from the rest: see `shown_color`
    and `shown_roughness`.
    """

    base_color: tuple[float, float, float] | None = None
    metallic: float = 0.0
    roughness: float | None = None
    conductor: str | None = None  # a metal of `pipeline.transport.conductors`, in place of colour and metallic
    transmission: float = 0.0  # share of the light that is not reflected which goes through, as a thick solid
    ior: float = 1.5
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)  # 1 is the radiance of a white surface lying on the plane
    base_texture: np.ndarray | None = None  # (H, W, 3), multiplies base_color
    metallic_texture: np.ndarray | None = None  # (H, W)
    roughness_texture: np.ndarray | None = None  # (H, W)
    emission_texture: np.ndarray | None = None  # (H, W, 3), multiplies emission

    @property
    def shown_color(self) -> tuple[float, float, float]:
        """Base colour: what was given, else clear glass or light grey."""
        grey = 1.0 if self.transmission else 0.8
        return self.base_color or (grey, grey, grey)

    @property
    def shown_roughness(self) -> float:
        """Roughness: what was given, else polished glass or half rough."""
        return (0.0 if self.transmission else 0.5) if self.roughness is None else self.roughness


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with one material. ``vertices`` (N, 3), ``faces`` (M, 3), ``normals`` (N, 3), ``uv`` (N, 2) or None."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray | None
    material: Material

    def flaw_as_solid(self) -> str:
        """Why light cannot pass through it as through a solid: a hole, faces turned inwards, or nothing ("")."""
        _, corner = np.unique(self.vertices, axis=0, return_inverse=True)
        faces = corner.reshape(-1)[self.faces]
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
        code, other = edges @ [len(self.vertices), 1], edges @ [1, len(self.vertices)]
        if not np.array_equal(np.sort(code), np.sort(other)):  # every edge is run once each way
            return "is not closed"
        a, b, c = (self.vertices[self.faces[:, i]] - self.vertices.mean(0) for i in range(3))
        return "has its faces turned inwards" if np.einsum("ij,ij->", a, np.cross(b, c)) < 0 else ""


def refuse_undecodable(path: Path) -> None:
    """Raise ManifestError for what the head of an object file tells to be unreadable; reads no geometry."""
    if path.suffix.lower() == ".glb":
        _glb_materials(path)
    elif path.suffix.lower() == ".ply":
        with path.open("rb") as stream:
            head = stream.read(3)
        if head != b"ply":
            raise ManifestError(f"{path}: starts with {head!r}; expected a PLY file ('ply')")


def load_meshes(path: Path) -> tuple[list[Mesh], list[str]]:
    """Meshes of a file, node transforms applied, and what was left out (zero-area faces, unread material features).

    Raises ManifestError when the file cannot be read, holds no triangles, or needs an extension that is not decoded.
    """
    import trimesh

    factors: dict[str, dict[str, Any]] = {}
    warnings: list[str] = []
    if path.suffix.lower() == ".glb":
        factors, warnings = _glb_materials(path)
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers raise
        raise ManifestError(f"{path}: not a readable {path.suffix} file ({type(error).__name__}: {error})") from error
    meshes = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not hasattr(geometry, "faces") or len(geometry.faces) == 0:
            continue
        mesh, dropped = _convert(geometry, np.asarray(transform, float), factors)
        if dropped:
            warnings.append(
                f"{path.name}: {dropped} of {dropped + len(mesh.faces)} faces have no area or are not finite; left out"
            )
        meshes.append(mesh)
    if not meshes or not any(len(mesh.faces) for mesh in meshes):
        raise ManifestError(f"{path}: holds no triangles")
    return meshes, warnings


def _glb_materials(path: Path) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Materials by name, as written in the file, and warnings of what is not modelled."""
    with path.open("rb") as stream:
        head = stream.read(20)
        if len(head) < 20 or head[:4] != GLB_MAGIC:
            raise ManifestError(f"{path}: starts with {head[:4]!r}; expected a binary glTF ('glTF')")
        try:
            document = json.loads(stream.read(struct.unpack("<I", head[12:16])[0]))
        except ValueError as error:
            raise ManifestError(f"{path}: its glTF description is damaged ({error}); export it again") from error
    missing = set(document.get("extensionsRequired", [])) - SUPPORTED_EXTENSIONS
    if missing:
        raise ManifestError(f"{path}: needs {', '.join(sorted(missing))}, which is not decoded; export it without")
    warnings = []
    factors: dict[str, dict[str, Any]] = {}
    for material in document.get("materials", []):
        name = material.get("name", "")
        if name in factors:
            warnings.append(f"{path.name}: several materials are named {name!r}; the last one's numbers hold for all")
        factors[name] = material
        extra = sorted(
            {"normalTexture", "occlusionTexture"} & set(material)
            | (set(material.get("extensions", {})) - MODELLED_EXTENSIONS)
        )
        if "transmissionTexture" in material.get("extensions", {}).get("KHR_materials_transmission", {}):
            extra.append("transmissionTexture")
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            extra.append(f"alphaMode {material['alphaMode']}")
        if extra:
            warnings.append(f"{path.name}: material {name!r}: not modelled: {', '.join(extra)}")
    return factors, warnings


def _convert(geometry: Any, transform: np.ndarray, factors: dict[str, dict[str, Any]]) -> tuple[Mesh, int]:
    normals = np.asarray(geometry.vertex_normals, float) @ np.linalg.inv(transform[:3, :3])
    vertices = np.asarray(geometry.vertices, float) @ transform[:3, :3].T + transform[:3, 3]
    faces = np.asarray(geometry.faces)
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    good = area > 1e-14 * max(np.ptp(vertices, axis=0).max(), 1e-30) ** 2
    visual = geometry.visual
    uv = getattr(visual, "uv", None)
    material = _material(getattr(visual, "material", None), factors)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.tile([0.0, 1.0, 0.0], (len(normals), 1)), where=length > 0)
    return Mesh(vertices, faces[good], normals, None if uv is None else np.asarray(uv, float), material), int(
        (~good).sum()
    )


def _material(source: Any, factors: dict[str, dict[str, Any]]) -> Material:
    if source is None or not hasattr(source, "baseColorFactor"):  # .obj and .ply: a diffuse colour at most
        main = getattr(source, "main_color", None)
        if main is None:
            return Material()
        return Material(base_color=tuple(decode_srgb(np.asarray(main[:3]) / 255.0).tolist()))
    written = factors.get(source.name or "", {})
    pbr, extensions = written.get("pbrMetallicRoughness", {}), written.get("extensions", {})
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    red, green, blue = (float(strength * value) for value in written.get("emissiveFactor", (0.0, 0.0, 0.0)))
    material = Material(
        base_color=tuple(pbr.get("baseColorFactor", (1.0, 1.0, 1.0))[:3]),
        metallic=float(pbr.get("metallicFactor", 1.0)),
        roughness=float(pbr.get("roughnessFactor", 1.0)),
        transmission=float(extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0)),
        ior=float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5)),
        emission=(red, green, blue),
    )
    if source.baseColorTexture is not None:
        texture = np.asarray(source.baseColorTexture.convert("RGB"), np.float32) / 255
        material = replace(material, base_texture=decode_srgb(texture))
    if source.metallicRoughnessTexture is not None:
        texture = np.asarray(source.metallicRoughnessTexture.convert("RGB"), np.float32) / 255
        material = replace(material, metallic_texture=texture[..., 2], roughness_texture=texture[..., 1])
    if source.emissiveTexture is not None and any(material.emission):
        texture = np.asarray(source.emissiveTexture.convert("RGB"), np.float32) / 255
        material = replace(material, emission_texture=decode_srgb(texture))
    return material
