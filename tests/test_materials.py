"""Laws of the materials: furnace, reciprocity, measured metals, glass, emission; colours come back as given."""

from typing import Any, get_args

import numpy as np
import pytest
from metals import TABLES, acescg_reflectance, fresnel, index_of

from pipeline.image.colour import convert, luminance
from pipeline.light.environment import irradiance
from pipeline.run.manifest import MaterialWish
from pipeline.transport.conductors import REFLECTANCE, preset
from pipeline.transport.energy import albedos
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.paths import trace_paths
from pipeline.transport.scene import build_worlds
from pipeline.transport.surfaces import area_emitter, material_bsdf, object_shape
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Plane

COSINES = np.array([1.0, 0.8, 0.5, 0.2])
SAMPLES = 1 << 14


def bsdf(**parameters: Any) -> Any:
    mi = use_mitsuba()
    color = parameters.pop("base_color", (0.5, 0.4, 0.3))
    conserving = bool(parameters.pop("conserving", False))
    pixel = mi.Bitmap(np.asarray(color, np.float32).reshape(1, 1, 3))
    base = {"type": "bitmap", "bitmap": pixel, "raw": True}
    numbers = {name: {"type": "uniform", "value": float(value)} for name, value in parameters.items()}
    return mi.load_dict({"type": "insitu_gltf", "base_color": base, "conserving": conserving, **numbers})


def interaction(mi: Any, wi: np.ndarray) -> Any:
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in wi.T])
    return si


def directional_albedo(material: Any, cosine: float) -> tuple[np.ndarray, np.ndarray]:
    """Reflected share of light from one direction, by sampling, and its standard error: (3,), (3,)."""
    mi = use_mitsuba()
    rng = np.random.default_rng(5)
    wi = np.tile([np.sqrt(1 - cosine**2), 0, cosine], (SAMPLES, 1))
    grid = (np.arange(SAMPLES) + rng.random(SAMPLES)) / SAMPLES
    pair = rng.random((2, SAMPLES))
    _, weight = material.sample(
        mi.BSDFContext(),
        interaction(mi, wi),
        mi.Float(grid.astype(np.float32)),
        mi.Point2f(*[mi.Float(axis.astype(np.float32)) for axis in pair]),
    )
    values = np.array(weight).reshape(3, -1)
    return values.mean(1), values.std(1) / np.sqrt(SAMPLES)


def integrated_albedo(material: Any, cosine: float, rows: int = 256) -> np.ndarray:
    """The same by quadrature over the hemisphere (midpoints in cosine and azimuth): (3,)."""
    mi = use_mitsuba()
    z, phi = np.meshgrid((np.arange(rows) + 0.5) / rows, 2 * np.pi * (np.arange(rows) + 0.5) / rows)
    s = np.sqrt(1 - z**2)
    out = np.stack([s * np.cos(phi), s * np.sin(phi), z], -1).reshape(-1, 3)
    wi = np.tile([np.sqrt(1 - cosine**2), 0, cosine], (len(out), 1))
    wo = mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in out.T])
    value = material.eval(mi.BSDFContext(), interaction(mi, wi), wo)
    return np.array(value).reshape(3, -1).mean(1) * 2 * np.pi


@pytest.mark.parametrize("f0", [0.0, 0.02, 0.04, 0.17, 1.0])
@pytest.mark.parametrize("cosine", COSINES)
def test_a_smooth_black_dielectric_reflects_by_schlick(f0: float, cosine: float) -> None:
    """base 0, roughness 0: the reflected share is f0 + (1 - f0)(1 - cos)^5.

    2e-3 of it: alpha is held at 1e-3, which spreads the half vector by that angle; float32 normals.
    """
    share, error = directional_albedo(bsdf(base_color=(0, 0, 0), roughness=0, f0=f0), cosine)
    expected = f0 + (1 - f0) * (1 - cosine) ** 5
    np.testing.assert_allclose(share, expected, rtol=2e-3, atol=5 * error.max() + 1e-7)


@pytest.mark.parametrize("f0", [0.02, 0.04, 0.17, 0.6])
@pytest.mark.parametrize("roughness", [0.3, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 1.0, 0.4])
def test_white_furnace(f0: float, roughness: float, metallic: float) -> None:
    """Sampling agrees with the quadrature of the same lobe, and no more light comes back than came.

    The bound holds for metals at every angle and for dielectrics from above; towards grazing angles the specification's
    mix gives a white dielectric back more than it got (1.20 at roughness 0.3, cosine 0.2), which is held here too, so
    that a change of it is seen.
    """
    material = bsdf(base_color=(1, 1, 1), roughness=roughness, metallic=metallic, f0=f0)
    for cosine in COSINES:
        share, error = directional_albedo(material, cosine)
        # 2e-3: the quadrature's own error on the narrowest lobe here (alpha 0.09), by halving its step
        np.testing.assert_allclose(share, integrated_albedo(material, cosine), atol=5 * error.max() + 2e-3)
        if metallic == 1 or cosine >= 0.8:
            assert np.all(share < 1 + 5 * error)
    if (f0, roughness, metallic) == (0.04, 0.3, 0.0):
        np.testing.assert_allclose(share, 1.1995, atol=5 * error.max() + 2e-3)


@pytest.mark.parametrize("roughness", [0.12, 0.3, 0.6, 1.0])
@pytest.mark.parametrize(("metallic", "f0"), [(0.0, 0.04), (0.0, 0.17), (1.0, 0.04), (0.4, 0.04)])
def test_a_conserving_white_surface_returns_all_light(roughness: float, metallic: float, f0: float) -> None:
    """The furnace, at every angle. 2.5e-3: the tables' interpolation and sampling (1e-3 each, measured)."""
    material = bsdf(base_color=(1, 1, 1), roughness=roughness, metallic=metallic, f0=f0, conserving=True)
    for cosine in COSINES:
        share, error = directional_albedo(material, cosine)
        np.testing.assert_allclose(share, 1, atol=5 * error.max() + 2.5e-3)
        if roughness >= 0.6:  # the quadrature resolves the lobe
            np.testing.assert_allclose(share, integrated_albedo(material, cosine), atol=5 * error.max() + 2e-3)


@pytest.mark.parametrize("f0", [0.02, 0.04, 0.17])
@pytest.mark.parametrize("cosine", COSINES)
def test_a_conserving_black_dielectric_reflects_by_fresnel(f0: float, cosine: float) -> None:
    """base 0, roughness 0; tolerance as for Schlick above."""
    share, error = directional_albedo(bsdf(base_color=(0, 0, 0), roughness=0, f0=f0, conserving=True), cosine)
    eta = (1 + f0**0.5) / (1 - f0**0.5)
    np.testing.assert_allclose(share, fresnel(np.array(eta), cosine), rtol=2e-3, atol=5 * error.max() + 1e-7)


def test_a_conserving_rough_metal_gives_back_what_its_facets_lose() -> None:
    """Single scattering plus the lost share times Fms: a grey metal of roughness 1 against the tables themselves."""
    facing = 0.5
    (table, mean), steps = albedos(0.04), np.linspace(0, 1, 32)
    plain, kept = (bsdf(base_color=(facing,) * 3, roughness=1, metallic=1, conserving=c) for c in (False, True))
    average = facing + (1 - facing) / 21
    again = average**2 * mean[-1, 0] / (1 - average * (1 - mean[-1, 0]))
    for cosine in COSINES:
        lost = 1 - np.interp(cosine**0.5, steps, table[-1, :, 0])
        expected = integrated_albedo(plain, cosine) + again * lost
        np.testing.assert_allclose(integrated_albedo(kept, cosine), expected, atol=1e-3)  # the tables' error


@pytest.mark.parametrize("conserving", [False, True])
def test_reciprocity(conserving: bool) -> None:
    """f(wi, wo) = f(wo, wi): eval carries the cosine of its second direction."""
    mi = use_mitsuba()
    rng = np.random.default_rng(2)
    pairs = rng.normal(size=(2, 4096, 3))
    pairs[..., 2] = np.abs(pairs[..., 2])
    pairs /= np.linalg.norm(pairs, axis=-1, keepdims=True)
    for f0 in (0.02, 0.04, 0.3):
        material = bsdf(roughness=0.5, metallic=0.3, f0=f0, conserving=conserving)
        there, back = (
            np.array(
                material.eval(
                    mi.BSDFContext(),
                    interaction(mi, a),
                    mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in b.T]),
                )
            ).reshape(3, -1)
            / b[:, 2]
            for a, b in (pairs, pairs[::-1])
        )
        np.testing.assert_allclose(there, back, rtol=1e-4)


def evaluated(material: Any, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """(N, 3) BSDF times cosine for directions (N, 3)."""
    mi = use_mitsuba()
    out = mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in wo.T])
    return np.array(material.eval(mi.BSDFContext(), interaction(mi, wi), out)).reshape(3, -1).T


@pytest.mark.parametrize("metal", sorted(REFLECTANCE))
def test_metals_are_their_spectral_integrals(metal: str) -> None:
    """The presets, to the digits they are written with; and Schlick with an edge tint, at every angle.

    0.0235: the largest error of the interpolation, chromium near grazing (0.0231); 0.20 without the tint.
    """
    index = index_of(metal)
    for cosine, written in zip((1.0, 1 / 7), REFLECTANCE[metal]):
        np.testing.assert_allclose(acescg_reflectance(fresnel(index, cosine)), written, atol=6e-5)
    facing, edge = preset(metal)
    for cosine in np.linspace(0.05, 1, 20):
        schlick = facing + (1 - facing) * (1 - cosine) ** 5
        dip = cosine * (1 - cosine) ** 6 / (1 / 7 * (6 / 7) ** 6)
        model = schlick - dip * (1 - edge) * (facing + (1 - facing) * (6 / 7) ** 5)
        np.testing.assert_allclose(acescg_reflectance(fresnel(index, cosine)), model, atol=0.0235)


def test_a_metal_in_the_renderer_reflects_its_preset() -> None:
    """A smooth mirror of each metal, by sampling, at both angles; 1e-3: alpha is not quite zero."""
    mi = use_mitsuba()
    for metal, angles in REFLECTANCE.items():
        made = mi.load_dict(material_bsdf(mi, Material(conductor=metal, roughness=0.0)))
        for cosine, reflectance in zip((1.0, 1 / 7), angles):
            share, error = directional_albedo(made, cosine)
            np.testing.assert_allclose(share, reflectance, atol=1e-3 + 5 * error.max())


def test_the_manifest_knows_every_metal() -> None:
    named = get_args(get_args(MaterialWish.model_fields["conductor"].annotation)[0])
    assert sorted(named) == sorted(REFLECTANCE) == sorted(TABLES)
    assert set(MaterialWish.model_fields) - {"space"} <= set(Material.__dataclass_fields__)


@pytest.mark.parametrize(
    "wish",
    [
        {"conductor": "gold", "base_color": (1, 0, 0)},
        {"conductor": "gold", "metallic": 0.5},
        {"conductor": "gold", "transmission": 1},
        {"metallic": 0.5, "transmission": 0.5},
        {"emission": (1, -1, 0)},
        {"conductor": "unobtainium"},
    ],
)
def test_contradictory_wishes_are_refused(wish: dict) -> None:
    with pytest.raises(ValueError, match=r"conductor|transmission|emission"):
        MaterialWish.model_validate(wish)


def ball(material: Material) -> Mesh:
    import trimesh

    sphere = trimesh.creation.icosphere(4, 0.1)
    return Mesh(sphere.vertices, sphere.faces, sphere.vertices / 0.1, None, material)


def seen(
    scene: Any, origins: np.ndarray, direction: tuple[float, float, float] = (0, 0, -1), depth: int = 32
) -> np.ndarray:
    """(N, 3) radiance along parallel rays, one path each."""
    mi = use_mitsuba()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, len(origins))
    start = mi.Point3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in origins.T])
    rays = mi.RayDifferential3f(start, mi.Vector3f(*direction))
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
    return np.array(integrator.sample(scene, sampler, rays)[0]).reshape(3, -1).T


def in_the_open(material: Material, space: Any = "acescg", white: float = 1.0, sky: float = 1.0) -> Any:
    mi = use_mitsuba()
    shape, warnings = object_shape(mi, "o", ball(material), np.eye(4), material, space, white)
    assert not warnings
    bitmap = mi.Bitmap(np.full((5, 8, 3), sky, np.float32))
    return mi.load_dict({"type": "scene", "o": shape, "sky": {"type": "envmap", "bitmap": bitmap}})


def across(count: int) -> np.ndarray:
    """Starting points of rays along -z that all meet the ball."""
    rng = np.random.default_rng(4)
    radius, angle = 0.09 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, 1.0)], -1)


def test_clear_glass_in_a_furnace_is_invisible(saw) -> None:
    """Every path leaves a clear solid with all its light; those of 32 vertices are cut (1e-3 of the light at most)."""
    light = seen(in_the_open(Material(transmission=1.0)), across(4096))
    np.testing.assert_allclose(light.mean(0), 1.0, atol=2e-3)
    saw("object.glass", "exact", np.abs(light.mean(0) - 1).max())


@pytest.mark.parametrize(("roughness", "kept"), [(0.1, 0.998), (0.2, 0.992), (0.3, 0.967), (0.5, 0.812)])
def test_rough_glass_loses_light_between_its_facets(roughness: float, kept: float) -> None:
    """The model follows one scattering per crossing: what a solid ball keeps of an even sky, as measured."""
    light = seen(in_the_open(Material(transmission=1.0, roughness=roughness)), across(4096))
    np.testing.assert_allclose(light.mean(), kept, atol=5 * light.std() / 64)


def test_glass_bends_as_snell_says() -> None:
    """A ray 50 mm off the axis of a ball of 100 mm, index 1.5: it leaves turned by 2 (30 - asin(1/3)) = 21.06 degrees.

    A quarter of the sky is bright, bounded by that direction plus and minus half a degree; the mesh is a polyhedron.
    """
    mi = use_mitsuba()
    material = Material(transmission=1.0)
    shape, _ = object_shape(mi, "o", ball(material), np.eye(4), material, "acescg", 1.0)
    turned = 2 * (np.radians(30) - np.arcsin(1 / 3))
    for offset, expected in ((np.radians(1.0), 1), (-np.radians(1.0), 0)):
        # Rays at x = +50 mm along -z leave towards -x; longitudes beyond the turn are dark.
        columns = (np.arange(2048) + 0.5) / 2048 * 2 * np.pi  # phi = atan2(x, -z)
        bright = (columns > 2 * np.pi - turned - offset) | (columns < np.pi / 2)
        bitmap = mi.Bitmap(np.repeat(np.tile(bright[None, :, None], (9, 1, 3)), 1, 0).astype(np.float32))
        scene = mi.load_dict({"type": "scene", "o": shape, "sky": {"type": "envmap", "bitmap": bitmap}})
        light = seen(scene, np.tile([[0.05, 0.0, 1.0]], (512, 1)), (0, 0, -1), depth=4).mean()
        assert abs(light - expected) < 0.15  # Fresnel: 4 % at each of the two crossings goes elsewhere


def test_coloured_glass_tints_a_path_once() -> None:
    """Straight through the middle: (1 - R)^2 of the light, times the base colour."""
    color = (0.9, 0.5, 0.2)
    light = seen(
        in_the_open(Material(transmission=1.0, base_color=color)), np.tile([[0, 0, 1.0]], (1 << 14, 1)), (0, 0, -1), 3
    )
    reflected = 0.04  # depth 3: straight through, or back from the first face
    expected = reflected + (1 - reflected) ** 2 * np.array(color)
    np.testing.assert_allclose(light.mean(0), expected, atol=5 * light.std(0).max() / 128)


def test_half_glass_is_a_blend() -> None:
    mi = use_mitsuba()
    wi = np.tile([[0.3, 0.1, np.sqrt(0.9)]], (64, 1))
    rng = np.random.default_rng(8)
    wo = rng.normal(size=(64, 3))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)  # both sides: reflected and let through
    opaque, half, clear = (
        evaluated(
            mi.load_dict(material_bsdf(mi, Material((0.2, 0.4, 0.6), 0.0, 0.5, transmission=t), "acescg")), wi, wo
        )
        for t in (0.0, 0.5, 1.0)
    )
    np.testing.assert_allclose(half, (opaque + clear) / 2, rtol=1e-5, atol=1e-7)


def test_a_solid_with_a_hole_or_turned_inwards_is_named(saw) -> None:
    mi = use_mitsuba()
    glass = Material(transmission=1.0)
    whole = ball(glass)
    open_mesh = Mesh(whole.vertices, whole.faces[1:], whole.normals, None, glass)
    inside_out = Mesh(whole.vertices, whole.faces[:, ::-1], -whole.normals, None, glass)
    for mesh, expected in ((whole, ""), (open_mesh, "not closed"), (inside_out, "inwards")):
        warnings = object_shape(mi, "vase", mesh, np.eye(4), glass, "acescg", 1.0)[1]
        assert bool(warnings) == bool(expected)
        assert all(expected in warning and "vase" in warning for warning in warnings)
    saw("object.inverted_glass", "degraded", float(not warnings), said=warnings[0])


SWATCHES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) * 0.85 + 0.05


@pytest.mark.parametrize("swatch", SWATCHES)
def test_saturated_colours_come_back_as_they_were_given(swatch: np.ndarray) -> None:
    """ACEScg in, ACEScg out, as the ground's albedo, as a base colour and as an emission.

    The channels of every single path are in the swatch's own proportion, so hue is tested to float32 (1e-5 after a
    few products), not to noise. A dielectric adds white reflections, so its base colour is tested through its BSDF,
    which is linear in it.
    """
    mi = use_mitsuba()
    corners = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], float)
    plane = Plane(normal=[0, 1, 0], offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=corners, source="test")
    sky = np.ones((16, 32, 3))
    worlds = build_worlds(plane, swatch, sky, {})
    ground = seen(worlds.without_objects, np.tile([[0.1, 1.0, 0.1]], (256, 1)), (0, -1, 0))
    np.testing.assert_allclose(
        ground / ground.sum(1, keepdims=True), swatch[None] / swatch.sum() + 0 * ground, rtol=1e-5
    )
    np.testing.assert_allclose(ground.mean(0), swatch, rtol=5 * (ground / swatch).std() / 16)

    rng = np.random.default_rng(6)
    wi, wo = rng.normal(size=(2, 64, 3))
    wi[:, 2], wo[:, 2] = np.abs(wi[:, 2]), np.abs(wo[:, 2])
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    given, white, black = (
        evaluated(mi.load_dict(material_bsdf(mi, Material(tuple(color), 0.0, 0.4), "acescg")), wi, wo)
        for color in (swatch, np.ones(3), np.zeros(3))
    )
    np.testing.assert_allclose(given, black + swatch * (white - black), rtol=1e-4)

    level = luminance(irradiance(sky, np.array([[0.0, 1, 0]]))[0]) / np.pi
    lamp = Material(tuple(np.zeros(3)), emission=tuple(swatch))
    shown = seen(in_the_open(lamp, white=float(level), sky=0.0), across(16))
    np.testing.assert_allclose(shown, np.tile(swatch, (16, 1)) * level, rtol=1e-5)
    np.testing.assert_allclose(level, 1.0, rtol=1e-3)  # white under a sky of 1 has radiance 1


def test_colours_of_files_are_linear_rec709() -> None:
    mi = use_mitsuba()
    red = Material((1.0, 0.0, 0.0), 0.0, 1.0, emission=(2.0, 0.0, 0.0))
    assert area_emitter(mi, Material(), "acescg", 1.0) is None
    shown = seen(in_the_open(red, "linear_rec709", 0.5, 0.0), across(4))
    np.testing.assert_allclose(
        shown, np.tile(convert(np.array([1.0, 0, 0]), "linear_rec709", "acescg"), (4, 1)), rtol=1e-5
    )


def test_an_emissive_mesh_lights_the_ground(saw) -> None:
    """A glowing ball above a white plane: irradiance pi L (r / d)^2 below it (within a sphere's exact view factor)."""
    mi = use_mitsuba()
    lamp = Material((0.0, 0.0, 0.0), emission=(1.0, 1.0, 1.0), ior=1.001)
    lifted = np.eye(4)
    lifted[1, 3] = 0.5
    shape, _ = object_shape(mi, "o", ball(lamp), lifted, lamp, "acescg", 2.0)
    corners = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], float)
    plane = Plane(normal=[0, 1, 0], offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=corners, source="test")
    worlds = build_worlds(plane, np.full(3, 0.5), np.zeros((16, 32, 3)), {"o": shape})
    below = np.tile([[0.0, 0.2, 0.0]], (1 << 14, 1))
    light = seen(worlds.with_objects, below, (0, -1, 0), 2)
    expected = 0.5 * 2.0 * (0.1 / 0.5) ** 2
    # 0.4 %: the polyhedron's silhouette against the sphere's
    np.testing.assert_allclose(light.mean(0), expected, atol=5 * light.std() / 128 + 0.004 * expected)
    saw("object.emissive", "exact", np.abs(light.mean(0) / expected - 1).max())


def test_a_glowing_texture_needs_no_unique_coordinates() -> None:
    """Both triangles of a square use the same coordinates; the ground below is lit by both.

    A square of side 0.2 at 1 m, a quarter of it glowing with radiance 4: E = L A / d^2 of a patch seen small (2 %).
    """
    mi = use_mitsuba()
    vertices = np.array([[-0.1, 1, -0.1], [0.1, 1, -0.1], [0.1, 1, 0.1], [-0.1, 1, 0.1]])
    faces = np.array([[0, 1, 2], [2, 3, 0]])
    corners = np.concatenate([vertices[face] for face in faces])
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], (2, 1))
    glow = np.zeros((64, 64, 3), np.float32)
    glow[:, :32] = 1.0
    material = Material((0.0, 0.0, 0.0), emission=(4.0, 4.0, 4.0), emission_texture=glow, ior=1.001)
    mesh = Mesh(corners, np.arange(6).reshape(2, 3), np.tile([[0, -1.0, 0]], (6, 1)), uv, material)
    shape, _ = object_shape(mi, "o", mesh, np.eye(4), material, "acescg", 1.0)
    edges = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], float)
    plane = Plane(normal=[0, 1, 0], offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=edges, source="test")
    worlds = build_worlds(plane, np.full(3, 1.0), np.zeros((16, 32, 3)), {"o": shape})
    below = np.tile([[0.0, 0.2, 0.0]], (1 << 18, 1))
    # u runs 0 to 1 over each triangle and the glowing half is u < 1/2: a quarter of it, at the corner where u = 0.
    expected = 4.0 * 0.04 / np.pi * 0.25
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, len(below))
    rays = mi.Ray3f(mi.Point3f(0.0, 0.2, 0.0), mi.Vector3f(0.0, -1.0, 0.0))
    own = trace_paths(worlds, worlds.with_objects, sampler, rays, mi.Bool(np.ones(len(below), bool)), 2)
    for light in (seen(worlds.with_objects, below, (0, -1, 0), 2), np.array(own)):
        assert abs(light.mean() - expected) < 5 * light.std() / 512 + 0.02 * expected
