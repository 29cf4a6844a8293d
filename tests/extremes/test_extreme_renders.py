"""Extremes of objects and worlds through the render stage; tests of the same things at rest lie in test_render."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from small_renders import ball, largest_z, moved, rendered, several, wide, wish, world
from test_transport import all_rays, camera, ground, looking_down, scene, sky, sphere

from pipeline.camera.lens import pixel_rays
from pipeline.light.emitters import lights
from pipeline.light.environment import irradiance
from pipeline.run.errors import ManifestError
from pipeline.transport.difference import difference_block
from pipeline.transport.meshes import Material
from pipeline.transport.near_one import near_one
from pipeline.transport.placing import turns_around
from pipeline.transport.trace import trace
from pipeline.types import Raster

COUNT = (
    6  # renders on either side: Student's t of 10 degrees of freedom passes 6 once in 7000; 144 tile channels a part
)

GREY = Material((0.5, 0.4, 0.3), 0.0, 0.6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("objects")


@pytest.fixture(scope="module")
def base(folder):
    """Renders of a ball on a table in the common world."""
    return several([wish(ball(folder))], count=COUNT, samples=8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "scale", "shift"),
    [("world.1mm", 1e-3, (0, 0)), ("world.1km", 1e3, (0, 0)), ("world.far", 1.0, (1e6, -1e6))],
)
def test_scale_and_place_of_the_world(case, scale, shift, folder, base, saw):
    thing = moved(wish(ball(folder)), scale, shift)
    other = several([thing], world(scale, shift), first=100, count=COUNT, samples=8)
    saw(case, "exact", largest_z(base, other))


def test_common_worlds_are_left_as_they_are():
    pose = looking_down()
    assert near_one(pose, np.zeros((1, 3))) is None
    tiny = pose.copy()
    tiny[:3, 3] *= 1e-3
    found = near_one(tiny, np.zeros((1, 3)))
    assert found is not None
    assert found.scale == 1024.0
    assert not found.origin_m.any()


@pytest.mark.slow
def test_half_out_of_the_frame(folder, saw):
    """The same pixels of a photograph with 32 more columns, other seeds."""
    crop = slice(None), slice(32, None)
    for case, x in (("object.half_out", -0.31), ("object.shadow_only", -0.5)):
        thing = wish(ball(folder), x)
        narrow = several([thing], count=COUNT, samples=8)
        alpha, lost = narrow[0]["obj.A"], narrow[0].rgb("lost")
        assert lost.min() < -0.05
        assert (alpha[:, 0].max() > 0) if case == "object.half_out" else not alpha.any()
        broad = several([thing], wide(world(), 32), first=70, count=COUNT, samples=8)
        saw(case, "exact", largest_z(narrow, broad, crop))


def test_an_object_that_cuts_the_plane(folder, saw):
    """Half sunk: what is covered is what sees the sphere before the plane, 8 x 8 rays a pixel; 80 samples of a mesh."""
    layers = rendered([wish(ball(folder), lift=0.0)], samples=32).outputs["layers"]
    step = (np.arange(8) + 0.5) / 8
    y, x = (axis.ravel() for axis in np.mgrid[:48, :64])
    offsets = np.stack(np.meshgrid(step, step), -1).reshape(1, -1, 2)
    px = (np.stack([x, y], -1)[:, None] + offsets).reshape(-1, 2)
    pose = looking_down()
    way = pixel_rays(camera(), px) @ pose[:3, :3].T
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    eye = pose[:3, 3]
    along = -(way @ eye)
    inside = 0.08**2 - (eye @ eye) + along**2
    height = eye[1] + (along - np.sqrt(np.maximum(inside, 0))) * way[:, 1]
    area = ((inside > 0) & (height > 0)).reshape(-1, 64).mean(1).sum()
    saw("object.cuts_plane", "exact", abs(layers["obj.A"].sum() / area - 1))


def test_an_object_around_the_camera(folder, saw):
    around = wish(ball(folder), 0.1, 0.5, 0.5)
    with pytest.raises(ManifestError, match="camera is inside it") as refusal:
        rendered([around])
    saw("object.holds_camera", "refused", said=str(refusal.value))
    beside = wish(ball(folder), 0.1, 0.5, 0.5 - 0.1)  # below the camera by 100 mm: it is not around it
    rendered([wish(ball(folder)), beside], samples=1)


@pytest.mark.slow
def test_inverted_faces_of_an_opaque_object(folder, base, saw):
    turned = wish(ball(folder, "turned.ply", inverted=True))
    saw("object.inverted", "exact", largest_z(base, several([turned], first=300, count=COUNT, samples=8)))


@pytest.mark.slow
def test_one_sample_per_pixel(folder, saw):
    few = several([wish(ball(folder))], count=8, samples=1)
    many = several([wish(ball(folder))], first=500, count=6, samples=8)
    for layers in few:
        assert all(np.isfinite(values).all() for values in layers.channels.values())
    noisy = few[0].rgb("variance")[few[0].rgb("lost").min(-1) < -0.05]
    assert (noisy > 0).mean() > 0.9
    saw("render.one_sample", "degraded", largest_z(few, many), said="variance of every pixel stated")


def test_environment_without_light(saw):
    samples = trace(
        difference_block,
        scene(np.zeros((16, 32, 3)), np.full(3, 0.5), sphere(0.1, (0, 0.1, 0), GREY)),
        all_rays(),
        4,
        4,
        0,
    )
    values = np.concatenate([samples.obj, samples.lost, samples.gained, samples.without])
    assert np.isfinite(values).all()
    saw("environment.black", "exact", np.abs(values).max())


def test_environment_of_one_radiance(saw):
    """The plane shows albedo times it: the tracer, 64 samples each of 3072 rays; and no texel is a light."""
    level = 3.0
    constant = np.full((16, 32, 3), level)
    assert lights(constant, 0.02, np.radians(10)) == ([], [])
    samples = trace(difference_block, scene(constant, np.array([0.5, 0.3, 0.2]), None), all_rays(), 4, 3, 0)
    light = np.pi * level
    closed = irradiance(constant, np.array([[0.0, 1, 0]]))[0] / light - 1
    model = samples.albedo.mean(0) / samples.ground.mean() * light / np.pi / (np.array([0.5, 0.3, 0.2]) * level) - 1
    saw("environment.constant", "exact", max(np.abs(closed).max(), np.abs(model).max()))


def test_white_furnace(saw):
    far_below = ground().model_copy(update={"offset_m": -200.0, "corners_m": ground().corners_m - [0, 200, 0]})
    white = sphere(0.1, (0, 0.1, 0), Material((1.0, 1, 1), 1.0, 0.1))
    samples = trace(difference_block, scene(np.ones((16, 32, 3)), np.zeros(3), white, far_below), all_rays(), 256, 2, 0)
    metal = samples.obj[samples.alpha == 1].mean()
    table = irradiance(np.ones((64, 128, 3)), np.array([[0.0, 1, 0]]))[0, 0] / np.pi
    saw("law.white_furnace", "exact", max(abs(metal - 1), abs(table - 1)))


@pytest.mark.slow
def test_turned_world_and_seed(folder, base, saw):
    """A quarter turn of everything, other seeds; and the same seed twice."""
    again = rendered([wish(ball(folder))], samples=8, seed=0).outputs["layers"]
    differ = sum(int((again[name] != values).sum()) for name, values in base[0].channels.items())
    saw("law.same_seed", "exact", differ)
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    given = world()
    view = given["views"]["plate"]
    given["views"] = {"plate": view.model_copy(update={"world_from_camera": turn @ view.world_from_camera})}
    given["environment"] = Raster(Raster.split(np.roll(sky(), -sky().shape[1] // 4, axis=1)), "acescg")
    lamp = given["emitters"][0]
    texels = np.flatnonzero(given["environment"].rgb().max(-1) > 5)
    given["emitters"] = [lamp.model_copy(update={"direction": turn[:3, :3] @ lamp.direction, "texels": texels})]
    corners = given["plane"].corners_m @ turn[:3, :3].T
    given["plane"] = given["plane"].model_copy(update={"corners_m": corners})
    turned = several([wish(ball(folder)) | {"yaw_deg": 90.0}], given, first=900, count=COUNT, samples=8)
    saw("law.rotate_world", "exact", largest_z(base, turned))


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.2, 5), away=st.floats(0.0, 3.0))
def test_what_a_surface_encloses(seed, size, away):
    """Winding of a ball about a point: 1 inside, 0 outside, whatever its size, place and way round."""
    if abs(away - 1) < 0.02:  # between the polyhedron and its sphere
        return
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    centre, mesh = rng.normal(size=3), trimesh.creation.icosphere(3, size)
    point = centre + away * size * direction / np.linalg.norm(direction)
    for faces, sign in ((mesh.faces, 1), (mesh.faces[:, ::-1], -1)):
        assert turns_around(mesh.vertices + centre, faces, point) == pytest.approx(sign * (away < 1), abs=1e-9)
