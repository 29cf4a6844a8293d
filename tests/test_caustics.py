"""Light tracing: the same light as without it, less noise, and what geometry says of flat mirrors and clear glass."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from agreement import assert_same_mean, standing, tile_means
from scipy.ndimage import minimum_filter
from test_paths import lamp_of
from test_transport import SIZE, all_rays, camera, ground, looking_down, sky, sphere

from pipeline.camera.lens import project
from pipeline.conventions import invert_rigid, latlong_directions, transform_points
from pipeline.light.environment import irradiance
from pipeline.transport.caustics import Film, thrown, throws
from pipeline.transport.difference import difference_block
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.passes import Halves
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import material_bsdf, mesh_shape
from pipeline.transport.trace import Samples, reference_block, trace
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Emitter, Occluder, Proxy, Surface

ALBEDO = np.array([0.5, 0.3, 0.2])
SAMPLES = 16
REPEATS = 10
PHOTONS = 0.1 * SIZE[0] * SIZE[1]
MIRROR_BSDF = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}


def film() -> Film:
    camera_from_world = invert_rigid(looking_down())
    return Film(
        lambda points: project(camera(), transform_points(camera_from_world, points)),
        SIZE,
        lambda pixels: all_rays()[pixels].solid_angles(),
        looking_down()[:3, 3],
    )


def cast(worlds: Worlds, film: Film, samples: int, seed: int) -> np.ndarray:
    """(2, H, W, 3) thrown light of every pixel."""
    pixels = film.shape[0] * film.shape[1]
    return thrown(worlds, film, samples, seed, lambda pixel: pixel, pixels).reshape(2, *film.shape, 3)


def placed(name: str, mesh: Mesh, bsdf: dict[str, Any]) -> Any:
    return mesh_shape(use_mitsuba(), name, mesh, np.eye(4), bsdf)


def throwing_objects() -> dict[str, Any]:
    """A glass ball, a mirror and a rough metal."""
    rough = {"type": "roughconductor", "alpha": 0.1, "material": "none"}
    return {
        "glass": placed("glass", sphere(0.1, (0, 0.12, 0), Material()), {"type": "dielectric"}),
        "mirror": placed("mirror", sphere(0.05, (0.17, 0.05, 0.05), Material()), MIRROR_BSDF),
        "rough": placed("rough", sphere(0.04, (-0.17, 0.05, 0.05), Material()), rough),
    }


def quad(corners: Any) -> Mesh:
    """A rectangle of two triangles; corners counter-clockwise seen from its front."""
    corners = np.asarray(corners, float)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    normals = np.repeat(normal[None] / np.linalg.norm(normal), 4, 0)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), normals, None, Material())


def wall() -> Proxy:
    import trimesh

    box = trimesh.creation.box((0.5, 0.3, 0.02))
    box.apply_translation([0, 0.15, -0.2])
    return Proxy(name="wall", vertices_m=box.vertices, faces=box.faces, albedo=[0.8, 0.6, 0.4])


def changes(worlds: Worlds, photons: float, seeds: range, objects: bool = False) -> list[np.ndarray]:
    """What the objects change, or are and change, (pixels, 3), of independent renders, the thrown light in it."""
    worlds = replace(worlds, photons=photons)
    pictures = []
    for seed in seeds:
        samples = trace(difference_block, worlds, all_rays(), SAMPLES, 16, seed)
        light = cast(worlds, film(), SAMPLES, 1000 + seed).reshape(2, -1, 3) if photons else np.zeros(2)
        own = samples.obj + light[1] if objects else 0.0
        pictures.append(samples.lost + samples.gained + light[0] + own)
    return pictures


@pytest.mark.parametrize("place", ["plane", "wall", "glossy"])
def test_with_light_tracing_as_without_as_the_reference(place: str) -> None:
    """The same mean in every tile, by paths from the camera alone and shared with paths from the lamp; less noise.

    Measured: the mean variance of a pixel falls 4 times (plane, gloss), 2.5 times (wall).
    """
    light = sky()
    worlds = build_worlds(
        ground(),
        ALBEDO,
        light,
        throwing_objects(),
        proxies=[wall()] if place == "wall" else [],
        emitters=[lamp_of(light)],
        surface=Surface(model="rough", roughness=0.4, f0=0.04) if place == "glossy" else None,
    )
    assert throws(worlds)
    shared = changes(worlds, PHOTONS, range(REPEATS), objects=True)
    both = [trace(reference_block, worlds, all_rays(), 8 * SAMPLES, 16, 100 + seed) for seed in range(REPEATS)]
    reference = [samples.lost + samples.gained + samples.obj for samples in both]
    assert_same_mean(shared, reference, SIZE)
    if place != "plane":
        return
    alone = changes(worlds, 0.0, range(50, 50 + REPEATS), objects=True)
    assert_same_mean(shared, alone, SIZE)
    with_light, without = (changes(worlds, photons, range(REPEATS)) for photons in (PHOTONS, 0.0))
    assert np.var(without, 0, ddof=1).mean() > 1.5 * np.var(with_light, 0, ddof=1).mean()


def small_lamp(height: int = 256) -> tuple[np.ndarray, Emitter]:
    """A lamp of three degrees half angle in a black sky, from +x and a little from behind."""
    towards = np.array([0.6, 0.75, 0.28])
    directions = latlong_directions(height, 2 * height)
    inside = directions @ (towards / np.linalg.norm(towards)) > np.cos(np.radians(3))
    light = inside[..., None] * np.array([800.0, 700, 600])
    lamp = lamp_of(light).model_copy(update={"texels": np.flatnonzero(inside), "direction": towards})
    return light, lamp


def test_a_small_lamp_through_glass_costs_a_fraction() -> None:
    """Three degrees: a rare find for paths from the camera, not for those from the lamp. Measured: 46 times."""
    light, lamp = small_lamp()
    worlds = build_worlds(ground(), ALBEDO, light, throwing_objects(), emitters=[lamp])
    shared, alone = changes(worlds, PHOTONS, range(8)), changes(worlds, 0.0, range(50, 58))
    (a, a_square), (b, b_square) = standing(shared, SIZE), standing(alone, SIZE)
    assert np.all(np.abs(a - b)[-1] < 5 * np.sqrt(a_square + b_square)[-1])  # whole picture; t of 7 to 14
    assert np.var(alone, 0, ddof=1).mean() > 4 * np.var(shared, 0, ddof=1).mean()


def test_glass_of_index_one_changes_nothing() -> None:
    """What it hides, light tracing brings back: the change is zero in every tile, the lamp's share from light alone."""
    light = sky()
    clear = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0}
    ball = {"ghost": placed("ghost", sphere(0.1, (0, 0.12, 0), Material()), clear)}
    worlds = build_worlds(ground(), ALBEDO, light, ball, emitters=[lamp_of(light)])
    found = changes(worlds, PHOTONS, range(REPEATS))
    assert_same_mean(found, [np.zeros_like(picture) for picture in found], SIZE)
    lost = trace(difference_block, worlds, all_rays(), SAMPLES, 16, 0).lost
    assert -tile_means(lost, SIZE).min() > 50 * np.sqrt(standing(found, SIZE)[1]).max()


class FlatMirror:
    """A standing mirror that faces the lamp, and the parallelogram of light before it on the ground."""

    x, half_width, height = -0.22, 0.15, 0.2

    def __init__(self, occluders: list[Occluder] | None = None) -> None:
        self.light, self.lamp = small_lamp()
        z, y = self.half_width, self.height
        corners = [[self.x, 0, z], [self.x, 0, -z], [self.x, y, -z], [self.x, y, z]]
        self.shapes = {"mirror": placed("mirror", quad(corners), MIRROR_BSDF)}
        worlds = build_worlds(
            ground(), ALBEDO, self.light, self.shapes, emitters=[self.lamp], occluders=occluders or []
        )
        self.worlds = replace(worlds, photons=0.2 * SIZE[0] * SIZE[1])

    def thrown(self, film: Film) -> np.ndarray:
        return cast(self.worlds, film, 256, 5)[0]


def ground_points() -> tuple[np.ndarray, np.ndarray]:
    """Where the pixels' centres meet the ground (H W, 3), and their area on it (H W,)."""
    rays = all_rays()
    distance = -rays.origin[1] / rays.centre[:, 1]
    points = rays.origin + distance[:, None] * rays.centre
    along = rays.centre / np.linalg.norm(rays.centre, axis=1, keepdims=True)
    squared = ((points - rays.origin) ** 2).sum(1)
    return points, rays.solid_angles() * squared / -along[:, 1]


def test_a_flat_mirror_throws_what_geometry_says() -> None:
    """A mirror leaves irradiance as it is, so within its light the ground gets the lamp's once more; beyond it none.

    157 000 photons, of which a tenth lands within: 0.8 % of noise, three times that allowed.
    """
    mirror = FlatMirror()
    picture = mirror.thrown(film()).reshape(-1, 3)
    points, area = ground_points()
    lamp = mirror.lamp.direction / np.linalg.norm(mirror.lamp.direction)
    # Towards the lamp's image: x turned over. It is seen in the mirror where that line meets the mirror.
    reach = (points[:, 0] - mirror.x) / lamp[0]
    seen = np.stack([reach * lamp[1], points[:, 2] + reach * lamp[2]], 1)
    blur = reach * np.tan(np.radians(5)) + 0.02  # of the lamp, of interpolation between texels; and a pixel
    middle = np.array([mirror.height / 2, 0])
    beyond = np.abs(seen - middle) - np.array([mirror.height / 2, mirror.half_width])
    inside = (beyond < -blur[:, None])[:, 1] & (seen[:, 0] < mirror.height - blur) & (reach > 0)
    outside = (beyond > blur[:, None]).any(1) | (reach < -0.02)
    assert inside.sum() > 100
    up = irradiance(mirror.light, np.array([[0.0, 1, 0]]))[0]
    np.testing.assert_allclose(picture[inside].mean(0), ALBEDO / np.pi * up, rtol=0.025)
    assert not picture[outside].any()
    # Energy: what the mirror takes in is what the ground gets. Its share of the lamp is that on an upright plane.
    caught = irradiance(mirror.light, np.array([[1.0, 0, 0]]))[0] * 2 * mirror.half_width * mirror.height
    received = (picture * area[:, None]).sum(0) * np.pi / ALBEDO
    np.testing.assert_allclose(received, caught, rtol=0.025)


def test_what_stands_before_the_camera_hides_thrown_light() -> None:
    """An occluder half way to the camera: nothing behind it, the same bytes beside it. An object: nothing behind it.

    Behind: the pixel and those around it are covered in all of 64 samples; a photon may find a corner that those miss.
    """
    free = FlatMirror()
    corners = np.array([[-0.05, 0.25, 0.3], [0.05, 0.25, 0.3], [0.05, 0.25, 0.2], [-0.05, 0.25, 0.2]])
    hidden = FlatMirror([Occluder(name="card", vertices_m=corners, faces=[[0, 1, 2], [0, 2, 3]])])
    seen = trace(difference_block, hidden.worlds, all_rays(), 64, 2, 0)
    behind = minimum_filter(((seen.ground + seen.alpha) == 0).reshape(SIZE), 3)
    beside = (seen.ground == 1).reshape(SIZE)
    whole, part = free.thrown(film()), hidden.thrown(film())
    assert whole[behind].sum() > 0.01 * whole.sum()
    assert not part[behind].any()
    assert np.array_equal(part[beside], whole[beside])
    light = sky()
    worlds = build_worlds(ground(), ALBEDO, light, throwing_objects(), emitters=[lamp_of(light)])
    worlds = replace(worlds, photons=PHOTONS)
    alpha = trace(difference_block, worlds, all_rays(), 64, 2, 0).alpha.reshape(SIZE)
    assert not cast(worlds, film(), 64, 3)[0][minimum_filter(alpha == 1, 3)].any()


def test_a_part_of_the_frame_gets_its_part() -> None:
    """Photons beyond the frame are dropped, none is folded back: a crop is the same bytes as the crop of the whole."""
    mirror, whole = FlatMirror(), film()
    rows, columns = slice(10, 30), slice(7, 41)
    shape, index = (20, 34), np.arange(SIZE[0] * SIZE[1]).reshape(SIZE)[rows, columns].ravel()
    crop = Film(
        lambda points: whole.project(points) - [7, 10],
        shape,
        lambda pixels: whole.pixel_sr(index[pixels]),
        whole.origin,
    )
    assert np.array_equal(mirror.thrown(crop), mirror.thrown(whole)[rows, columns])
    # Two slots: the crop, and nowhere for the rest.
    into = np.where(np.isin(np.arange(SIZE[0] * SIZE[1]), index), 0, -1)
    total = thrown(mirror.worlds, whole, 256, 5, lambda pixel: into[pixel], 1)[0, 0]
    np.testing.assert_allclose(total, mirror.thrown(crop).sum((0, 1)), rtol=1e-12)


def test_nothing_is_thrown_without_lamps_or_objects() -> None:
    light = sky()
    ball = {"glass": placed("glass", sphere(0.1, (0, 0.12, 0), Material()), {"type": "dielectric"})}
    assert not throws(build_worlds(ground(), ALBEDO, light, ball))
    assert not throws(build_worlds(ground(), ALBEDO, light, {}, emitters=[lamp_of(light)]))


def test_a_rough_object_gets_through_clear_glass_what_it_gets_without() -> None:
    """A pane of index 1 between lamp and ball: all of the lamp's light on the ball comes as photons, none is weakened.

    The whole picture within 4 standard errors, which are a thirtieth of it.
    """
    light = np.where(sky() > 5, sky(), 0.0)
    towards = np.array([0.4, 0.8, 0.447])
    aside = np.cross(towards, [0, 1, 0]) / np.linalg.norm(np.cross(towards, [0, 1, 0]))
    up = np.cross(towards, aside)
    corners = [
        [0, 0.06, 0] + 0.2 * towards + 0.09 * (a * aside + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    gloss = material_bsdf(use_mitsuba(), Material((0.8, 0.8, 0.8), 0.0, 0.6), "acescg")
    ball = placed("ball", sphere(0.05, (0, 0.06, 0), Material()), gloss)
    pane = placed("pane", quad(corners), {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0})
    found = []
    for shapes, photons in (({"ball": ball, "pane": pane}, PHOTONS), ({"ball": ball}, 0.0)):
        worlds = build_worlds(ground(), np.zeros(3), light, shapes, emitters=[lamp_of(light)])
        found.append(standing(changes(worlds, photons, range(30), objects=True), SIZE))
    (behind, first), (free, second) = found
    spread = np.sqrt(first + second)[-1]
    assert np.all(np.abs(behind - free)[-1] < 4 * spread)
    assert np.all(spread < free[-1] / 30)


def test_variance_holds_the_noise_of_thrown_light() -> None:
    """By two halves, against the scatter of 16 independent pairs; sums over the picture, of thrown light and of all.

    A variance of 16 scatters by 37 % in one pixel and hundreds of pixels share the noise: 4 %, and what is noted as
    much; four times their root sum of squares is 0.2. Measured: 1.02. With strata in the paths from the camera the
    whole is noted 13 % too large; thrown light is 73 % of it, and was not noted at all before.
    """
    light = sky()
    worlds = build_worlds(ground(), ALBEDO, light, throwing_objects(), emitters=[lamp_of(light)])
    worlds = replace(worlds, photons=PHOTONS)
    pixels = SIZE[0] * SIZE[1]
    noted, found = [], []
    for seed in range(0, 64, 4):
        first, second = (trace(difference_block, worlds, all_rays(), SAMPLES, 16, seed + half) for half in range(2))
        lit = np.stack([cast(worlds, film(), SAMPLES, 1000 + seed + half).reshape(2, -1, 3) for half in range(2)])
        halves = Halves(first, second, lit, 1, np.ones(pixels, bool))
        alone = Halves(Samples.none(pixels), Samples.none(pixels), lit, 1, np.ones(pixels, bool))
        noted.append([halves.both.change_variance.sum(), alone.both.change_variance.sum()])
        found.append([halves.both.lost + halves.both.gained, lit.mean(0)[0]])
    scatter = np.array([np.var([pair[kind] for pair in found], 0, ddof=1).sum() for kind in range(2)])
    whole, thrown_part = np.mean(noted, 0) / scatter
    assert thrown_part == pytest.approx(1, abs=0.2)
    assert 0.8 < whole < 1.6
