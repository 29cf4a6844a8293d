"""The four scenes of the render benchmark: arrays and small records, no renderer.

Frame, lat-long and colour as in `pipeline.conventions`; every number is ACEScg. A scene is a textured plane of 6 x 6 m,
objects, walls (further surfaces of the local scene), a lat-long map and a camera that sees nothing but local scene and
objects, so that no pixel looks past the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.camera.lens import rays_through
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import irradiance
from pipeline.types import Camera, Plane

MAP = (512, 1024)
EXTENT_M = 6.0
TEXTURE_PX = 512
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles with smooth or flat normals, world frame."""

    vertices: np.ndarray  # (N, 3) m
    normals: np.ndarray  # (N, 3) unit
    faces: np.ndarray  # (M, 3) counter-clockwise seen from outside


@dataclass(frozen=True, eq=False)
class Item:
    """One object and what it is made of.

    ``kind``: diffuse (Lambert), glossy (GGX of width ``alpha``, white Fresnel), glass (smooth, ``ior``) or mirror.
    """

    name: str
    kind: str
    shape: Shape
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    alpha: float = 0.0
    ior: float = 1.0


@dataclass(frozen=True, eq=False)
class Wall:
    """A diffuse rectangle of the local scene, one albedo, seen from both sides."""

    name: str
    vertices: np.ndarray  # (4, 3) m
    albedo: tuple[float, float, float]
    faces: np.ndarray = field(default_factory=lambda: np.array([[0, 1, 2], [0, 2, 3]]))


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything a renderer has to be told."""

    name: str
    environment: np.ndarray  # (H, W, 3) radiance
    sun: np.ndarray  # flat texel indices of the sun
    albedo: np.ndarray  # (h, w, 3), first row on the edge from corner 0 to corner 1
    plane: Plane
    camera: Camera
    world_from_camera: np.ndarray  # (4, 4)
    items: list[Item]
    walls: list[Wall] = field(default_factory=list)


def textured_albedo(seed: int = 5) -> np.ndarray:
    """(h, w, 3) in [0.15, 0.65]: planks with a smooth grain, sharp joints."""
    rng = np.random.default_rng(seed)
    v, u = (np.mgrid[:TEXTURE_PX, :TEXTURE_PX] + 0.5) / TEXTURE_PX
    plank = np.floor(12 * v).astype(int)
    grain = sum(
        0.04 * np.sin(2 * np.pi * (k * 3 * u + rng.random(12)[plank] * 5 + 2 * k * v) + rng.random() * 6)
        for k in (1, 2, 5, 9)
    )
    level = 0.3 + 0.12 * rng.random(12)[plank] + grain
    joint = (np.abs(12 * v - np.round(12 * v)) < 0.03) | (np.abs((5 * u + 0.4 * plank) % 1 - 0.5) < 0.008)
    level = np.where(joint, 0.16, level)
    return np.clip(level[..., None] * np.array([1.15, 1.0, 0.8]), 0.15, 0.65)


def sky_with_sun(
    elevation_deg: float, azimuth_deg: float, share: float, size: tuple[int, int], clear: bool
) -> tuple[np.ndarray, np.ndarray]:
    """A lat-long sky (H, W, 3) and the flat indices of its sun.

    Args:
        elevation_deg: of the sun.
        azimuth_deg: of the sun, from -z towards +x.
        share: of the red irradiance of a horizontal plane that comes from the sun.
        size: rows and columns of the sun in texels.
        clear: blue, with a bright horizon and an aureole; else an even haze with soft clouds.
    """
    d = latlong_directions(*MAP)
    up = np.clip(d[..., 1], 0, 1)
    if clear:
        level = 0.55 + 0.9 * (1 - up) ** 6
        colour = np.stack([0.35 + 0.5 * (1 - up) ** 4, 0.55 + 0.35 * (1 - up) ** 4, 1.0 + 0 * up], -1)
    else:
        level = 0.9 + 0.25 * np.sin(3 * d[..., 0] + 1) * np.sin(4 * d[..., 2]) + 0.15 * (1 - up) ** 4
        colour = np.stack([0.9 + 0 * up, 0.96 + 0 * up, 1.05 + 0 * up], -1)
    toward = np.radians([elevation_deg, azimuth_deg])
    sun = np.array([np.cos(toward[0]) * np.sin(toward[1]), np.sin(toward[0]), -np.cos(toward[0]) * np.cos(toward[1])])
    sky = level[..., None] * colour
    sky += (0.6 * np.exp(12 * (d @ sun - 1)))[..., None] * np.array([1.0, 0.95, 0.85])
    ground = np.array([0.26, 0.22, 0.18])
    sky = np.where(d[..., 1:2] > 0, sky, ground)
    row = int((90 - elevation_deg) / 180 * MAP[0])
    column = int(azimuth_deg / 360 * MAP[1])
    index = ((row + np.arange(size[0]))[:, None] * MAP[1] + column + np.arange(size[1])).ravel()
    flat = sky.reshape(-1, 3)
    flat[index] = 0
    wanted = irradiance(sky, UP[None])[0, 0] * share / (1 - share)
    one = np.zeros_like(flat)
    one[index] = np.array([1.0, 0.93, 0.82])
    flat[index] = one[index] * wanted / irradiance(one.reshape(*MAP, 3), UP[None])[0, 0]
    return sky, index


def floor() -> Plane:
    """The plane y = 0."""
    h = EXTENT_M / 2
    corners = np.array([[-h, 0, h], [h, 0, h], [h, 0, -h], [-h, 0, -h]])
    return Plane(normal=UP, offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=corners, source="benchmark")


def looking(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) world_from_camera of an upright camera."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return pose


def ray_grid(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """`rays_through` every pixel centre: (H, W, 2) and (H, W, 2, 2)."""
    y, x = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    xn, dxn = rays_through(camera, np.stack([x.ravel(), y.ravel()], -1))
    return xn.reshape(*x.shape, 2), dxn.reshape(*x.shape, 2, 2)


def pinhole(width: int, height: int, fov_deg: float = 50.0) -> Camera:
    """A camera with its principal point in the middle; ``fov_deg`` across."""
    focal = width / 2 / np.tan(np.radians(fov_deg / 2))
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def ball(radius: float, centre: tuple[float, float, float], steps: int = 96) -> Shape:
    """A sphere as a grid of longitudes and latitudes with exact normals; its poles are fans of thin triangles."""
    theta = np.linspace(0, np.pi, steps + 1)[1:-1]
    phi = 2 * np.pi * np.arange(2 * steps) / (2 * steps)
    ring = np.stack(
        [
            np.sin(theta)[:, None] * np.cos(phi),
            np.cos(theta)[:, None] + 0 * phi,
            np.sin(theta)[:, None] * np.sin(phi),
        ],
        -1,
    )
    normals = np.concatenate([UP[None], ring.reshape(-1, 3), -UP[None]])
    count, last = 2 * steps, len(normals) - 1
    here = np.arange(count)
    beside = (here + 1) % count
    top = np.stack([0 * here, 1 + beside, 1 + here], -1)
    base = 1 + count * np.arange(steps - 2)[:, None]
    corners = [base + here, base + beside, base + count + here, base + count + beside]
    a, b, c, e = (corner.ravel() for corner in corners)
    bottom = np.stack([0 * here + last, 1 + count * (steps - 2) + here, 1 + count * (steps - 2) + beside], -1)
    faces = np.concatenate([top, np.stack([a, b, c], -1), np.stack([b, e, c], -1), bottom])
    return Shape(radius * normals + centre, normals, faces)


def box(size: tuple[float, float, float], centre: tuple[float, float, float], yaw_deg: float) -> Shape:
    """A box with flat faces: four vertices of its own for each."""
    vertices: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    for axis in range(3):
        for sign in (-1, 1):
            normal, along = np.zeros(3), np.zeros(3)
            normal[axis], along[(axis + 1) % 3] = sign, 1
            across = np.cross(normal, along)
            square = [normal + s * along + t * across for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            faces += [np.array([0, 1, 2]) + len(vertices), np.array([0, 2, 3]) + len(vertices)]
            vertices += square
            normals += [normal] * 4
    return turned(np.array(vertices) * np.divide(size, 2), np.array(normals), np.array(faces), centre, yaw_deg)


def column(radius: float, height: float, centre: tuple[float, float, float], steps: int = 96) -> Shape:
    """An upright cylinder that stands on ``centre``, closed above and below."""
    phi = 2 * np.pi * np.arange(steps) / steps
    side = np.stack([np.cos(phi), 0 * phi, np.sin(phi)], -1)
    low, high = radius * side, radius * side + height * UP
    vertices = np.concatenate([low, high, low, high, [[0, 0, 0]], [[0, height, 0]]])
    normals = np.concatenate([side, side, -UP + 0 * side, UP + 0 * side, [-UP], [UP]])
    here = np.arange(steps)
    beside = (here + 1) % steps
    faces = np.concatenate(
        [
            np.stack([here, here + steps, beside], -1),
            np.stack([beside, here + steps, beside + steps], -1),
            np.stack([here + 2 * steps, beside + 2 * steps, 0 * here + 4 * steps], -1),
            np.stack([beside + 3 * steps, here + 3 * steps, 0 * here + 4 * steps + 1], -1),
        ]
    )
    return turned(vertices, normals, faces, centre, 0.0)


def turned(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, centre: tuple[float, float, float], yaw_deg: float
) -> Shape:
    """A mesh turned about +Y and moved."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return Shape(vertices @ rotation.T + centre, normals @ rotation.T, faces)


def plain_items() -> list[Item]:
    """A diffuse ball, a glossy ball, a diffuse box."""
    return [
        Item("clay", "diffuse", ball(0.2, (-0.55, 0.2, 0.05)), color=(0.55, 0.2, 0.12)),
        Item("steel", "glossy", ball(0.2, (0.0, 0.2, -0.15)), alpha=0.2),
        Item("crate", "diffuse", box((0.32, 0.3, 0.32), (0.55, 0.15, 0.0), 25), color=(0.2, 0.35, 0.5)),
    ]


def diffuse_glossy(width: int = 1280, height: int = 720) -> Scene:
    """Haze with a sun of four texels that gives 80 % of the red irradiance; nothing specular."""
    environment, sun = sky_with_sun(45, 60, 0.8, (2, 2), clear=False)
    pose = looking((0, 1.8, 2.6), (0, 0, 0.03))
    return Scene(
        "diffuse_glossy", environment, sun, textured_albedo(), floor(), pinhole(width, height), pose, plain_items()
    )


def glass_mirror(width: int = 1280, height: int = 720) -> Scene:
    """The same with a glass and a mirror ball: caustics of the sun."""
    base = diffuse_glossy(width, height)
    glass = Item("glass", "glass", ball(0.15, (-0.2, 0.15, 0.45)), ior=1.5)
    mirror = Item("mirror", "mirror", ball(0.15, (0.3, 0.15, 0.5)))
    return replace(base, name="glass_mirror", items=[*base.items, glass, mirror])


def hard_sun(width: int = 1280, height: int = 720) -> Scene:
    """A clear sky, a low sun of two texels (its true size), one tall column: a long umbra with a hard edge."""
    environment, sun = sky_with_sun(22, 285, 0.7, (1, 2), clear=True)
    pose = looking((0, 1.8, 2.6), (0, 0, 0.03))
    items = [Item("column", "diffuse", column(0.06, 0.7, (-0.85, 0.0, 0.1)), color=(0.5, 0.45, 0.4))]
    return Scene("hard_sun", environment, sun, textured_albedo(), floor(), pinhole(width, height), pose, items)


def corner(width: int = 1280, height: int = 720) -> Scene:
    """Two bright walls behind the objects: the local scene lights itself."""
    environment, sun = sky_with_sun(50, 120, 0.6, (1, 2), clear=False)
    pose = looking((0.35, 1.5, 2.4), (-0.15, 0.25, 0.0))
    walls = [
        Wall("back", np.array([[-1.0, 0, -0.8], [3, 0, -0.8], [3, 3, -0.8], [-1.0, 3, -0.8]]), (0.75, 0.7, 0.6)),
        Wall("side", np.array([[-1.0, 0, 3], [-1.0, 0, -0.8], [-1.0, 3, -0.8], [-1.0, 3, 3]]), (0.7, 0.25, 0.2)),
    ]
    return Scene(
        "corner", environment, sun, textured_albedo(), floor(), pinhole(width, height), pose, plain_items(), walls
    )


SCENES: dict[str, Callable[..., Scene]] = {
    "diffuse_glossy": diffuse_glossy,
    "glass_mirror": glass_mirror,
    "hard_sun": hard_sun,
    "corner": corner,
}


def facts(scene: Scene) -> dict[str, float]:
    """What the map is like: maximum over median, the sun's share of the red irradiance, its solid angle."""
    red = scene.environment[..., 0]
    without = scene.environment.copy().reshape(-1, 3)
    without[scene.sun] = 0
    whole = irradiance(scene.environment, UP[None])[0, 0]
    rest = irradiance(without.reshape(scene.environment.shape), UP[None])[0, 0]
    return {
        "map_max_over_median": float(red.max() / np.median(red)),
        "sun_share_red": float(1 - rest / whole),
        "sun_sr": float(latlong_solid_angles(*MAP).ravel()[scene.sun].sum()),
    }
