"""Random small scenes for tests of bias: every kind of local scene, light and material, from a seed.

A frame of 24 x 16 pixels, 6 tiles, shows about ten metres: a plane alone, with boxes that see each other, between
walls, glossy, or glossy with boxes; one to three objects out of every material; a sky with none to two lamps, which
half of the time are told apart as emitters. Lamps are discs of 6 to 10 degrees: smaller ones would need another order
of samples behind glass, for the reference finds them there by chance alone.

Objects are a metre and more in size, for Mitsuba lifts the start of a ray 9e-5 (1 + max |p|) off its surface, as if the
plane were that much higher. At 0.1 m that is a bias of the reference of 0.1 % of the light beside an object (measured;
the fast strategy starts nine times nearer), which would be found here; at this size it is 0.02 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.scenes import Shape, ball, box, column, floor, looking, pinhole, ray_grid
from pipeline.camera.lens import project
from pipeline.conventions import (
    direction_from_latlong,
    invert_rigid,
    latlong_directions,
    latlong_solid_angles,
    transform_points,
)
from pipeline.light.emitters import lights
from pipeline.light.environment import irradiance, total_energy
from pipeline.transport import proxies
from pipeline.transport.caustics import Film
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import object_shape
from pipeline.transport.trace import Rays
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Emitter, Plane, Proxy, Surface

KINDS = ("plane", "boxes", "walls", "glossy", "glossy boxes")
MATERIALS = {
    "diffuse": Material((0.6, 0.3, 0.2), 0.0, 1.0),
    "gloss": Material((0.2, 0.4, 0.5), 0.0, 0.35),
    "rough metal": Material((0.9, 0.75, 0.5), 1.0, 0.45),
    "mirror": Material((0.95, 0.95, 0.95), 1.0, 0.0),
    "glass": Material(transmission=1.0),
    "rough glass": Material((0.8, 0.9, 0.85), roughness=0.4, transmission=1.0),
    "emissive": Material((0.3, 0.3, 0.3), 0.0, 0.8, emission=(2.0, 1.4, 0.8)),
}
MAP = (64, 128)
SIZE = (16, 24)  # rows, columns
LIFT = 0.02  # m: flat undersides do not lie in the plane, where either could be hit first
EXTENT_M = 30.0
TARGET = (1.0, 0.3, 0.4)  # between the middle and the first object
UP = np.array([[0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Case:
    """A scene ready to trace, what it is made of, its plane's irradiance (3,), and the lens, for light tracing."""

    name: str
    worlds: Worlds
    rays: Rays
    shape: tuple[int, int]
    light: np.ndarray
    film: Film


def random_case(seed: int, shape: tuple[int, int] = SIZE, fov_deg: float = 42.0) -> Case:
    """Scene number ``seed``; five in a row hold every kind of local scene, seven every material."""
    random = np.random.default_rng([seed, 3])
    kind = KINDS[seed % len(KINDS)]
    names = list(MATERIALS)
    chosen = [names[seed % len(names)], *random.choice(names, random.integers(0, 3))]
    environment, lamps = random_map(random)
    told_apart = bool(random.random() < 0.5)
    emitters = told_from_sky(environment) if told_apart else []
    light = irradiance(environment, UP)[0]
    mi = use_mitsuba()
    white = float(light.mean() / np.pi)
    shapes = {}
    for number, material in enumerate(chosen):
        form = random_form(random, number)
        mesh = Mesh(form.vertices, form.faces, form.normals, None, MATERIALS[material])
        shapes[f"object_{number}"], _ = object_shape(
            mi, f"object_{number}", mesh, np.eye(4), mesh.material, "acescg", white
        )
    gloss = None
    if "glossy" in kind:
        metal = bool(random.random() < 0.3)
        gloss = Surface(
            model="metallic" if metal else "rough", roughness=random.uniform(0.3, 0.6),
            f0=random.uniform(0.04, 0.12), metallic=0.7 if metal else 0.0,
        )  # fmt: skip
    albedo = random.uniform(0.15, 0.75, (9, 9, 3))
    worlds = build_worlds(ground(), albedo, environment, shapes, random_proxies(random, kind), emitters, gloss)
    azimuth = random.uniform(0.1, 1.4) if kind == "walls" else random.uniform(0, 2 * np.pi)
    eye = 9.0 * np.array([np.sin(azimuth), random.uniform(0.7, 1.2), np.cos(azimuth)])
    camera, pose = pinhole(shape[1], shape[0], fov_deg), looking(tuple(eye), TARGET)
    xn, dxn = ray_grid(camera)
    rays = Rays.of(pose, xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    camera_from_world = invert_rigid(pose)
    film = Film(
        lambda points: project(camera, transform_points(camera_from_world, points)), shape,
        lambda pixels: rays[pixels].solid_angles(), pose[:3, 3],
    )  # fmt: skip
    lit = f"{lamps} lamps" + (f", {len(emitters)} apart" if emitters else "")
    return Case(f"{kind}: {', '.join(chosen)}; {lit}", worlds, rays, shape, light, film)


def ground() -> Plane:
    """The plane y = 0, wide enough to end far behind the frame."""
    return floor().model_copy(update={"corners_m": floor().corners_m * (EXTENT_M / floor().corners_m.max())})


def random_map(random: np.random.Generator) -> tuple[np.ndarray, int]:
    """A sky (H, W, 3) of soft lobes and texel noise, with none to two lamps, and their number."""
    directions = latlong_directions(*MAP)
    sky = np.full((*MAP, 3), 0.15)
    for _ in range(4):
        axis = random.normal(size=3)
        lobe = np.maximum(directions @ (axis / np.linalg.norm(axis)), 0) ** random.uniform(1, 8)
        sky += lobe[..., None] * random.uniform(0.1, 1.0, 3)
    sky *= random.gamma(20.0, 1 / 20.0, (*MAP, 1))
    count = int(random.integers(0, 3))
    solid_angles = latlong_solid_angles(*MAP)
    energy = total_energy(sky).mean()
    for _ in range(count):
        elevation, azimuth = random.uniform(0.5, 1.4), random.uniform(0, 1)
        toward = direction_from_latlong(np.array(azimuth), np.array(0.5 - elevation / np.pi))
        inside = directions @ toward > np.cos(np.radians(random.uniform(6, 10)))
        level = energy * random.uniform(0.1, 0.8) / solid_angles[inside].sum()
        sky[inside] += level * random.uniform(0.6, 1.0, 3)
    return sky, count


def told_from_sky(environment: np.ndarray) -> list[Emitter]:
    """The compact lights of the map, as the stage `lights` finds them."""
    found, _ = lights(environment, 0.02, np.radians(12.0))
    return [
        Emitter(
            name=f"lamp_{number}", direction=patch.direction, solid_angle_sr=patch.solid_angle_sr,
            half_angle_rad=patch.half_angle_rad, irradiance=patch.irradiance, texels=patch.texels,
        )
        for number, patch in enumerate(found, 1)
    ]  # fmt: skip


def random_form(random: np.random.Generator, number: int) -> Shape:
    """A ball, box or column on a place of its own: objects may touch each other's bounds, never each other."""
    place = 1.9 * np.array([np.cos(2.1 * number + 0.4), np.sin(2.1 * number + 0.4)]) + random.uniform(-0.2, 0.2, 2)
    size = random.uniform(0.5, 1.1)
    form = random.integers(0, 3)
    if form == 0:
        return ball(size, (place[0], size + LIFT, place[1]), 32)
    if form == 1:
        height = random.uniform(0.8, 2.5)
        measures = (1.2 * size, height, 1.2 * size)
        return box(measures, (place[0], height / 2 + LIFT, place[1]), random.uniform(0, 90))
    return column(0.6 * size, random.uniform(0.8, 3.0), (place[0], LIFT, place[1]), 48)


def random_proxies(random: np.random.Generator, kind: str) -> list[Proxy]:
    """Boxes sunk a little into the plane, or two walls behind the objects."""
    shapes = []
    if "boxes" in kind:
        for number in range(2):
            angle = 2.1 * number + 1.5
            height = random.uniform(0.8, 3.0)
            centre = (3.0 * np.cos(angle), height / 2 - 0.1, 3.0 * np.sin(angle))
            shapes.append(proxies.box(centre, (1.6, height, 1.2), random.uniform(0, 90)))
    elif kind == "walls":
        shapes.append(proxies.box((0.0, 2.9, -3.6), (12.0, 6.0, 0.2)))
        shapes.append(proxies.box((-3.6, 2.9, 0.0), (0.2, 6.0, 12.0)))
    return [
        Proxy(name=f"proxy_{number}", vertices_m=vertices, faces=faces, albedo=random.uniform(0.2, 0.75, 3))
        for number, (vertices, faces) in enumerate(shapes)
    ]
