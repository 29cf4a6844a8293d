"""Objects read from files: transforms, exact factors, textures, and what is refused or left out."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from pipeline.run.errors import ManifestError
from pipeline.transport.meshes import Material, load_meshes


def glb(path: Path, **factors: object) -> Path:
    material = trimesh.visual.material.PBRMaterial(name="m", **factors)
    box = trimesh.creation.box((1, 2, 3))
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), material=material)
    scene = trimesh.Scene()
    transform = trimesh.transformations.translation_matrix([10, 0, 0])
    scene.add_geometry(box, transform=transform)
    scene.export(path)
    return path


def edit_glb(path: Path, change) -> None:
    """Rewrite the JSON chunk of a .glb."""
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I", len(text)) + b"JSON" + text + data[20 + length :]
    path.write_bytes(data[:8] + struct.pack("<I", 12 + len(body)) + body)


def test_node_transform_and_unrounded_factors(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb", baseColorFactor=[0.5, 0.5, 0.5, 1.0], metallicFactor=0.25, roughnessFactor=0.3)

    def exact(document: dict) -> None:
        document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.0213, 0.5, 0.5, 1.0]

    edit_glb(path, exact)
    meshes, warnings = load_meshes(path)
    assert not warnings
    np.testing.assert_allclose(meshes[0].vertices.mean(0), [10, 0, 0], atol=1e-6)
    assert meshes[0].material.base_color[0] == 0.0213  # trimesh alone would give 5 / 255
    assert (meshes[0].material.metallic, meshes[0].material.roughness) == (0.25, 0.3)


def test_missing_decoder_is_named(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb")
    edit_glb(path, lambda document: document.update(extensionsRequired=["KHR_draco_mesh_compression"]))
    with pytest.raises(ManifestError, match="KHR_draco_mesh_compression"):
        load_meshes(path)


def test_zero_area_faces_are_left_out_and_counted(tmp_path: Path, saw) -> None:
    path = tmp_path / "a.ply"
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]]
    trimesh.Trimesh(vertices, [[0, 1, 2], [0, 1, 3]], process=False).export(path)
    meshes, warnings = load_meshes(path)
    assert len(meshes[0].faces) == 1
    assert "1 of 2 faces" in warnings[0]
    saw("object.zero_area", "degraded", len(meshes[0].faces) - 1, said=warnings[0])


@pytest.mark.parametrize("name", ["a.glb", "a.obj", "a.ply"])
def test_unreadable_files_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("this is no mesh")
    with pytest.raises(ManifestError) as refused:
        load_meshes(path)
    assert "\n" not in str(refused.value)
    assert name in str(refused.value)


def test_glass_and_light_of_a_gltf_file(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb", baseColorFactor=[1.0, 1.0, 1.0, 1.0])

    def declare(document: dict) -> None:
        document["materials"][0] |= {
            "emissiveFactor": [1.0, 0.5, 0.25],
            "extensions": {
                "KHR_materials_transmission": {"transmissionFactor": 0.75},
                "KHR_materials_ior": {"ior": 1.33},
                "KHR_materials_emissive_strength": {"emissiveStrength": 8.0},
                "KHR_materials_sheen": {},
            },
        }
        document["extensionsRequired"] = ["KHR_materials_transmission"]

    edit_glb(path, declare)
    meshes, warnings = load_meshes(path)
    material = meshes[0].material
    assert (material.transmission, material.ior) == (0.75, 1.33)
    assert material.emission == (8.0, 4.0, 2.0)
    assert len(warnings) == 1
    assert "KHR_materials_sheen" in warnings[0]


def test_emissive_texture_is_decoded(tmp_path: Path) -> None:
    picture = Image.fromarray(np.full((4, 4, 3), (255, 188, 0), np.uint8))
    path = glb(tmp_path / "a.glb", emissiveFactor=[1.0, 1.0, 1.0], emissiveTexture=picture)
    material = load_meshes(path)[0][0].material
    np.testing.assert_allclose(material.emission_texture[0, 0], [1.0, 0.5029, 0.0], atol=1e-4)


def test_materials_of_one_name_are_told(tmp_path: Path) -> None:
    path = glb(tmp_path / "a.glb")
    edit_glb(path, lambda document: document["materials"].append({"name": "m"}))
    assert any("several materials are named 'm'" in warning for warning in load_meshes(path)[1])


def test_what_is_not_said_follows_from_the_kind() -> None:
    assert Material().shown_color == (0.8, 0.8, 0.8)
    assert Material().shown_roughness == 0.5
    glass = Material(transmission=1.0)
    assert (glass.shown_color, glass.shown_roughness) == ((1.0, 1.0, 1.0), 0.0)
    assert Material((0.1, 0.2, 0.3), 0.0, 0.7, transmission=1.0).shown_roughness == 0.7
