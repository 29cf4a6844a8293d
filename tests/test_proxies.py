"""Proxies and occluders: from capture.toml to triangles and masks, and every way to get them wrong."""

from __future__ import annotations

import numpy as np
import pytest
from command import GIVEN, HEIGHT, WIDTH, tiny

from pipeline.image.colour import convert
from pipeline.run import formats
from pipeline.run.artifacts import OCCLUDERS, PROXIES
from pipeline.run.errors import ArtifactError, ManifestError
from pipeline.run.runner import Build, settle
from pipeline.run.settings import Settings
from pipeline.run.stage import Graph
from pipeline.transport.proxies import box
from pipeline.types import Raster
from stages import ingest, knobs

BOX = '[[proxy]]\nname = "wall"\ncentre_m = [0.1, 0.2, -0.3]\nsize_m = [0.4, 0.4, 0.02]\nyaw_deg = 30\n'
FILES = """[[proxy]]
name = "step"
file = "step.obj"
albedo = [0.5, 0.25, 0.1]
[[occluder]]
name = "plant"
file = "plant.png"
[[occluder]]
name = "edge"
file = "step.obj"
"""
STEP = "v 0 0 0\nv 0.1 0 0\nv 0 0.05 0\nf 1 2 3\no second\nv 1 0 0\nv 1 1 0\nv 1 0 1\nf 4 5 6\n"


def captured(folder, more, mask_shape=(HEIGHT, WIDTH)):
    (folder / "step.obj").write_text(STEP)
    mask = np.zeros(mask_shape, np.uint8)
    mask[:, : mask_shape[1] // 2] = 255
    formats.write_png(folder / "plant.png", mask)
    return tiny(folder, GIVEN + more)


def indexed(folder):
    return ingest.compute(folder, None, knobs.Ingest())


def volume(vertices, faces) -> float:
    """Of a closed surface whose faces are counter-clockwise seen from outside (divergence theorem)."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_box_has_its_measures_outward_faces_and_yaw():
    vertices, faces = box((1.0, 2.0, 3.0), (0.4, 0.2, 0.1))
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[0.8, 1.9, 2.95], [1.2, 2.1, 3.05]])
    assert volume(vertices, faces) == pytest.approx(0.4 * 0.2 * 0.1)
    turned, _ = box((0, 0, 0), (2.0, 0.2, 0.2), 90.0)  # counter-clockwise from above takes +X to -Z
    np.testing.assert_allclose(turned.max(0), [0.1, 0.1, 1.0], atol=1e-12)
    far_x = vertices[:, 0] > 1
    turned, _ = box((1.0, 2.0, 3.0), (0.4, 0.2, 0.1), 90.0)
    assert turned[far_x, 2].max() < 3.0


def test_nothing_stated_is_empty_lists(tmp_path):
    outputs = indexed(tiny(tmp_path, GIVEN)).outputs
    assert outputs["proxies"] == outputs["occluders"] == []


def test_boxes_meshes_and_masks_arrive(tmp_path):
    index = indexed(captured(tmp_path, BOX + FILES))
    wall, step = settle(PROXIES, index.outputs["proxies"])
    assert (wall.name, wall.albedo, len(wall.faces)) == ("wall", None, 12)
    np.testing.assert_allclose(wall.vertices_m, box((0.1, 0.2, -0.3), (0.4, 0.4, 0.02), 30)[0])
    corners = step.vertices_m[step.faces]
    assert corners.shape == (2, 3, 3)
    np.testing.assert_allclose(sorted(corners[:, :, 0].max(1)), [0.1, 1.0])
    np.testing.assert_allclose(step.albedo, convert(np.array([0.5, 0.25, 0.1]), "linear_rec709", "acescg"))
    plant, edge = settle(OCCLUDERS, index.outputs["occluders"])
    mask = formats.read_mask(tmp_path / "plant.png")
    assert plant.mask_file == str((tmp_path / "plant.png").resolve())
    assert (mask.shape, mask.dtype, mask.mean()) == ((HEIGHT, WIDTH), np.float32, 0.5)
    assert edge.mask_file is None
    np.testing.assert_array_equal(edge.vertices_m, step.vertices_m)
    assert (index.numbers["proxies"], index.numbers["occluders"]) == (2, 2)
    assert index.warnings == []


def test_every_problem_at_once(tmp_path):
    more = (
        '[[proxy]]\nname = "a"\nfile = "gone.obj"\n[[proxy]]\nname = "b"\nfile = "plant.png"\n'
        '[[proxy]]\nname = "c"\nfile = "empty.obj"\n[[occluder]]\nname = "d"\nfile = "plant.png"\n'
        '[[occluder]]\nname = "e"\nfile = "plant.tif"\n[[occluder]]\nname = "f"\nfile = "text.png"\n'
    )
    captured(tmp_path, more, (HEIGHT, WIDTH + 2))
    for name in ("empty.obj", "text.png"):
        (tmp_path / name).write_text("v 0 0 0\n")
    with pytest.raises(ManifestError) as error:
        indexed(tmp_path)
    lines = str(error.value).splitlines()
    for where, says in [
        ("proxy[0].file", "no such file"), ("proxy[1].file", "expected a .glb, .obj or .ply"),
        ("proxy[2].file", "empty.obj"), ("occluder[0].file", f"is {WIDTH + 2} x {HEIGHT}; expected the plate's"),
        ("occluder[1].file", "expected a .glb, .obj, .ply, .png or .exr"), ("occluder[2].file", "not a readable"),
    ]:  # fmt: skip
        assert any(where in line and says in line for line in lines), where
    assert len(lines) == 6


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BOX.replace("centre_m", "center_m"), "did you mean centre_m?"),
        (BOX + 'file = "step.obj"\n', "expected either file, or centre_m with size_m"),
        ('[[proxy]]\nname = "a"\n', "expected either file, or centre_m with size_m"),
        (BOX.replace("0.02]", "0.0]"), "proxy[0].size_m[2]: is 0.0"),
        (BOX + "albedo = [0.5, 1.2, 0.1]\n", "proxy[0].albedo[1]: is 1.2"),
        ('[[proxy]]\nname = "a"\nfile = "step.obj"\nyaw_deg = 4\n', "yaw_deg turns a box"),
        (BOX + BOX, "proxy names are ['wall', 'wall']"),
        ('[[occluder]]\nname = "a"\n', "occluder[0].file: missing"),
    ],
)
def test_wrong_tables_are_refused(text, says, tmp_path):
    with pytest.raises(ManifestError) as error:
        indexed(captured(tmp_path, text))
    assert says in str(error.value)


def test_mesh_in_millimetres_is_suspected(tmp_path):
    folder = captured(tmp_path, '[[proxy]]\nname = "step"\nfile = "step.obj"\n')
    (folder / "step.obj").write_text("v 0 0 0\nv 400 0 0\nv 0 300 0\nf 1 2 3\n")
    assert any("is the file in metres" in text for text in indexed(folder).warnings)


def test_a_changed_mask_or_mesh_changes_the_index_and_nothing_else_does(tmp_path):
    folder = captured(tmp_path, FILES)
    settings = Settings(capture=str(folder), scene=None, quality="preview", params={"ingest": {}})
    build = Build(Graph([ingest.STAGE]), tmp_path / "out", settings, {"ingest": knobs.Ingest})
    assert [build.run(ingest.STAGE) for _ in range(2)] == ["ran", "same"]
    formats.write_png(folder / "plant.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert [build.run(ingest.STAGE) for _ in range(2)] == ["ran", "same"]
    (folder / "step.obj").write_text(STEP.replace("0.05", "0.06"))
    assert [build.run(ingest.STAGE) for _ in range(2)] == ["ran", "same"]


GREY = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)


def test_masks_are_read_alike_from_every_kind_of_picture(tmp_path):
    formats.write_png(tmp_path / "grey.png", np.rint(GREY * 255).astype(np.uint8))
    colour = np.repeat(np.rint(GREY * 255).astype(np.uint8)[..., None], 3, 2)
    formats.write_png(tmp_path / "colour.png", colour)
    formats.write_png(tmp_path / "opaque.png", np.concatenate([colour, np.full((3, 4, 1), 255, np.uint8)], 2))
    formats.write_png(tmp_path / "deep.png", np.rint(GREY * 65535).astype(np.uint16))
    formats.write_exr(tmp_path / "mask.exr", Raster({"A": GREY}, "data"))
    for file in sorted(tmp_path.iterdir()):
        np.testing.assert_allclose(formats.read_mask(file), GREY, atol=0.5 / 255, err_msg=file.name)


def test_a_cropped_mask_is_zero_around_its_crop(tmp_path):
    """As a compositor's autocrop writes it: grey and opaque where there are data, nothing around."""
    whole = np.zeros((5, 7), np.float32)
    whole[1:4, 2:6] = GREY
    layers = dict.fromkeys("RGB", whole) | {"A": np.ones_like(whole)}
    formats.write_exr(tmp_path / "crop.exr", Raster(layers, "data", {"dataWindow": ((2, 1), (5, 3))}))
    assert np.array_equal(formats.read_mask(tmp_path / "crop.exr"), whole)
    layers["A"] = np.where(whole > 0.5, 1, 0).astype(np.float32)
    formats.write_exr(tmp_path / "crop.exr", Raster(layers, "data", {"dataWindow": ((2, 1), (5, 3))}))
    with pytest.raises(ArtifactError, match="4 channels differ"):
        formats.read_mask(tmp_path / "crop.exr")


def test_masks_that_say_two_things_are_refused(tmp_path):
    alpha = np.full((3, 4, 4), 255, np.uint8)
    alpha[0, 0, 3] = 0
    formats.write_png(tmp_path / "alpha.png", alpha)
    formats.write_exr(tmp_path / "bright.exr", Raster({"Y": 2 * GREY}, "data"))
    for name, says in (("alpha.png", "4 channels differ"), ("bright.exr", "expected 0 to 1")):
        with pytest.raises(ArtifactError, match=says):
            formats.read_mask(tmp_path / name)
