"""The libraries' silent traps, one test each: what they would corrupt comes out right, or the call is never made.

A trap is a function of a library that gives wrong pixels or poses without an error.
"""

from __future__ import annotations

import ast
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes import ray_grid
from pipeline.camera.lens import project
from pipeline.camera.rigid import rotation_exp, umeyama
from pipeline.conventions import latlong_directions, latlong_from_direction
from pipeline.image.raw import read_metadata, read_mosaic
from pipeline.run.formats import data_window, displayed, read_exr, write_exr
from pipeline.simulation.dng import DngFacts, dng_bytes
from pipeline.transport.difference import difference_block
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.scene import build_worlds, environment_emitter
from pipeline.transport.surfaces import material_bsdf, mesh_shape
from pipeline.transport.trace import Rays, Samples, reference_block, trace
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Plane, Raster

ROOT = Path(__file__).resolve().parents[1]
SOURCES = {
    path.relative_to(ROOT).as_posix(): ast.parse(path.read_text())
    for path in (*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("stages/*.py"))
}


def mentions(*words: str) -> set[str]:
    """Files that name an attribute, a module or a string of code that is one of ``words``."""
    found = set()
    for name, tree in SOURCES.items():
        for node in ast.walk(tree):
            said = {
                ast.Attribute: lambda n: [n.attr],
                ast.Name: lambda n: [n.id],
                ast.Import: lambda n: [part for alias in n.names for part in alias.name.split(".")],
                ast.ImportFrom: lambda n: [*(n.module or "").split("."), *(alias.name for alias in n.names)],
                ast.Constant: lambda n: [n.value] if isinstance(n.value, str) else [],
                ast.keyword: lambda n: [n.arg or ""],
            }.get(type(node), lambda n: [])(node)
            if set(said) & set(words):
                found.add(name)
    return found


NOISE = np.random.default_rng(0).normal(size=(24, 40, 4)).astype(np.float32)
VIEWS = {
    "channel": NOISE[..., 0],
    "flipped": NOISE[::-1, :, 1],
    "mirrored": NOISE[:, ::-1, 1],
    "crop": NOISE[3:17, 5:20, 2],
    "transposed": NOISE[..., 0].T,
    "fortran": np.asfortranarray(NOISE[..., 0]),
    "strided": NOISE[::2, ::3, 0],
    "broadcast": np.broadcast_to(np.float32(3.5), (8, 9)),
    "float64": NOISE[..., 0].astype(np.float64),
}


@pytest.mark.parametrize("name", VIEWS)
def test_trap_1_openexr_writes_wrong_pixels_of_views(name, tmp_path):
    view = VIEWS[name]
    flags = (view > 0).astype(np.uint32).T.copy().T  # Fortran order
    write_exr(tmp_path / "a.exr", Raster({"v": view, "flags": flags}, "data"))
    back = read_exr(tmp_path / "a.exr", "data")
    assert np.array_equal(back["v"], view.astype(np.float32))
    assert np.array_equal(back["flags"], flags)
    assert back["flags"].dtype == np.uint32


def test_maps_say_that_they_are_latlong(tmp_path):
    import OpenEXR

    path = tmp_path / "map.exr"
    write_exr(path, Raster(Raster.split(np.ones((4, 8, 3), np.float32)), "acescg", {"envmap": "latlong"}))
    assert read_exr(path).attributes["envmap"] == "latlong"
    with OpenEXR.File(str(path)) as file:
        assert file.header()["envmap"] == OpenEXR.ENVMAP_LATLONG


def test_an_exr_is_read_in_its_display_window(tmp_path):
    """OpenEXR gives the pixels of the data window, wherever they lie: a crop would be taken for the whole picture."""
    whole = np.zeros((40, 60), np.float32)
    whole[10:25, 33:] = NOISE[:15, :27, 0]
    flags = (whole != 0).astype(np.uint32)
    window = data_window(slice(10, 25), slice(33, 60))
    write_exr(tmp_path / "part.exr", Raster({"v": whole, "flags": flags}, "data", {"dataWindow": window}))
    write_exr(tmp_path / "whole.exr", Raster({"v": whole, "flags": flags}, "data"))
    assert (tmp_path / "part.exr").stat().st_size < (tmp_path / "whole.exr").stat().st_size
    for name in ("part", "whole"):
        back = read_exr(tmp_path / f"{name}.exr")
        assert np.array_equal(back["v"], whole), name
        assert np.array_equal(back["flags"], flags), name
        assert not {"dataWindow", "displayWindow"} & back.attributes.keys()
    beyond = {"dataWindow": ((-2, -3), (5, 4)), "displayWindow": ((0, 0), (3, 7))}  # overscan, and too short below
    pixels = NOISE[:8, :8, 0]
    assert np.array_equal(displayed(pixels, beyond)[:5], pixels[3:, 2:6])
    assert not displayed(pixels, beyond)[5:].any()


def test_trap_1_one_place_writes_exr():
    assert mentions("OpenEXR", "scanlineimage") - {"pipeline/run/runner.py"} == {
        "pipeline/run/formats.py"
    }  # asks its version


@pytest.mark.parametrize("top", [1000, 13000, 15000])
def test_trap_2_libraw_scales_each_frame_by_its_maximum(top, tmp_path):
    """DN come back as stored however bright the frame gets; LibRaw's developer is never called for Bayer."""
    facts = DngFacts(
        exposure=Fraction(1, 60), iso=100, fnumber=Fraction(8), focal_mm=Fraction(35), make="Maker", model="One",
        timestamp="2026:01:02 03:04:05", cfa="RGGB", black=(0, 0, 0, 0), white=15000, color_matrix=np.eye(3),
        neutral=np.ones(3), noise=(1e-5, 1e-9),
    )  # fmt: skip
    mosaic = np.linspace(0, top, 60 * 80).reshape(60, 80).astype(np.uint16)
    (tmp_path / "a.dng").write_bytes(dng_bytes(mosaic, facts))
    frame = read_metadata(tmp_path / "a.dng")
    assert np.array_equal(read_mosaic(tmp_path / "a.dng", frame), mosaic)
    assert frame.white == 15000
    assert mentions("postprocess") == {"pipeline/image/libraw.py"}  # X-Trans alone, scaling off (test_dng_reader.py)


def test_trap_3_colmap_cannot_align_coplanar_points():
    """Markers on a desk are coplanar: our own similarity transform recovers them, pycolmap's is not called."""
    rng = np.random.default_rng(3)
    points = rng.normal(size=(20, 3)) * [0.3, 0.0, 0.2]
    turn, shift, size = rotation_exp(np.array([0.4, -1.1, 2.0])), np.array([0.3, -2.0, 5.0]), 2.5
    matrix, scale = umeyama(size * points @ turn.T + shift, points, scale=True)
    assert abs(scale / size - 1) < 1e-12
    moved = points @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(moved, size * points @ turn.T + shift, atol=1e-12)
    assert not mentions("estimate_sim3d", "estimate_sim3d_robust")


def test_trap_4_mitsuba_environment_rows_are_corner_aligned():
    """A map that is linear in the polar angle reads as that angle in Mitsuba; else it is off by half a row."""
    mi = use_mitsuba()
    height = 32
    directions = latlong_directions(height, 2 * height)
    rgb = np.repeat(latlong_from_direction(directions)[1][..., None], 3, -1)
    emitter = mi.load_dict(environment_emitter(mi, rgb))
    rng = np.random.default_rng(4)
    asked = rng.normal(size=(60, 3))
    asked /= np.linalg.norm(asked, axis=1, keepdims=True)
    asked = asked[np.abs(asked[:, 1]) < 0.9]  # the rows next to the poles are means
    interaction = mi.SurfaceInteraction3f()
    read = []
    for x, y, z in asked.tolist():
        interaction.wi = mi.Vector3f(-x, -y, -z)
        read.append(float(np.array(emitter.eval(interaction)).ravel()[0]))
    error = np.abs(np.array(read) - latlong_from_direction(asked)[1])
    # Linear interpolation of a linear function: float32. Half a row would be 0.5 / 32 = 0.016 at the poles.
    assert error.max() < 1e-5


def sphere_before(camera: Camera, centre: np.ndarray, radius: float, light: float) -> Samples:
    """Trace a small white mirror ball before a camera at the origin that looks along its own +z."""
    import trimesh

    mi = use_mitsuba()
    ball = trimesh.creation.icosphere(4, radius)
    mesh = Mesh(ball.vertices + centre, ball.faces, ball.vertices / radius, None, Material((1.0, 1, 1), 1.0, 0.1))
    shape = mesh_shape(mi, "ball", mesh, np.eye(4), material_bsdf(mi, mesh.material, "acescg"))
    corners = np.array([[-9, -90, -9], [-9, -90, 9], [9, -90, 9], [9, -90, -9]], float)
    plane = Plane(normal=[0, 1, 0], offset_m=-90, covariance=np.zeros((3, 3)), corners_m=corners, source="test")
    worlds = build_worlds(plane, np.full(3, 0.5), np.full((16, 32, 3), light), {"ball": shape})
    xn, dxn = ray_grid(camera)
    rays = Rays.of(np.eye(4), xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    return trace(difference_block, worlds, rays, 64, 3, 0)


OFF_CENTRE = Camera(width=64, height=48, fx=70.0, fy=90.0, cx=19.0, cy=35.5)


def test_trap_5_mitsuba_principal_point_has_the_other_sign():
    """Rays go through our lens: a ball on the axis appears at the principal point, fx and fy apart."""
    centre = np.array([0.0, 0.0, 2.0])
    alpha = sphere_before(OFF_CENTRE, centre, 0.1, 1.0).alpha.reshape(48, 64)
    rows, columns = np.mgrid[:48, :64] + 0.5
    seen = np.array([(alpha * columns).sum(), (alpha * rows).sum()]) / alpha.sum()
    # 28 px of alpha at 64 samples: centroid noise below 0.02 px.
    np.testing.assert_allclose(seen, project(OFF_CENTRE, centre[None])[0], atol=0.05)
    np.testing.assert_allclose(seen, [19.0, 35.5], atol=0.05)
    assert not mentions("principal_point_offset_x", "principal_point_offset_y")
    assert mentions("perspective") <= {"pipeline/run/doctor.py"}  # a picture nobody looks at


def test_trap_6_imageio_cannot_read_its_own_exr():
    assert not mentions("imageio")
    assert "imageio" not in (ROOT / "pyproject.toml").read_text()


def test_trap_7_opencv_has_no_exr_codec(tmp_path):
    """OpenCV writes no file and reads PNG and board photographs only."""
    assert not mentions("imwrite", "imencode", "IMREAD_ANYDEPTH")
    assert mentions("imread", "imdecode") - {"pipeline/image/libraw.py"} == {  # rawpy has a function of that name
        "pipeline/run/formats.py",
        "pipeline/camera/opencv_bridge.py",
    }


def test_trap_8_blender_dims_what_it_saves(tmp_path):
    """A sun of 1e9 over a sky of 1e-3 survives writing and reading; Blender is not used."""
    rgb = np.full((8, 16, 3), 1e-3, np.float32)
    rgb[2, 5] = 1e9
    write_exr(tmp_path / "sun.exr", Raster(Raster.split(rgb), "acescg"))
    assert np.array_equal(read_exr(tmp_path / "sun.exr", "acescg").rgb(), rgb)
    assert not mentions("bpy")


def test_trap_9_mitsuba_film_is_half_float_and_gaussian():
    """Light beyond a half float's 65504 stays finite, and a sample counts in its own pixel only."""
    light = 1e6
    samples = sphere_before(OFF_CENTRE, np.array([0.0, 0.0, 2.0]), 0.1, light)
    inside = samples.alpha == 1
    assert not samples.not_finite.any()
    assert abs(samples.obj[inside].mean() / light - 1) < 0.01  # a white furnace, see test_transport
    rows, columns = np.mgrid[:48, :64] + 0.5
    offset = np.stack([(columns - OFF_CENTRE.cx) / OFF_CENTRE.fx, (rows - OFF_CENTRE.cy) / OFF_CENTRE.fy], -1)
    angle = np.arctan(np.linalg.norm(offset, axis=-1)).ravel()
    pixel = np.arctan(np.hypot(0.5 / 70, 0.5 / 90))  # half the diagonal of a pixel
    assert np.all(samples.alpha[angle > np.arcsin(0.1 / 2) + pixel] == 0)
    assert mentions("hdrfilm", "rfilter") <= {"pipeline/run/doctor.py"}


def test_traps_of_rendering_hold_for_the_reference_too():
    """Both strategies take their rays from the same place."""
    names = {strategy.__module__ for strategy in (reference_block, difference_block)}
    assert all("mi.render" not in (ROOT / f"{name.replace('.', '/')}.py").read_text() for name in names)
