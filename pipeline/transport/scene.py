"""The three-way split of differential rendering as Mitsuba scenes: distant scene, local scene, synthetic objects.

Debevec 1998: the distant scene is light only (the environment map), the local scene is what the objects change (the
plane with its albedo), the objects are added. Mitsuba's world is ours; its rgb variants multiply channels, so ACEScg
passes through as arrays (`raw`), never through its colour conversions.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions
from pipeline.transport.surfaces import color_texture
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Emitter, Occluder, Plane, Proxy, Surface

UNKNOWN_ALBEDO = 0.5  # of a proxy that nobody measured


@dataclass(frozen=True, eq=False)
class LightGroup:
    """A part of the distant light that is sampled on its own: an emitter's texels, or all the rest (the sky)."""

    name: str
    scene: Any  # Mitsuba scene that holds only this light
    emitter: Emitter | None = None  # None: the sky, or all light

    @property
    def compact(self) -> bool:
        """An emitter: its own samples suffice, no other technique would find it."""
        return self.emitter is not None


@dataclass(frozen=True, eq=False)
class Worlds:
    """The scene with the objects and without them, and what a strategy has to know about it.

    ``local_with`` are the surfaces of the local scene inside ``with_objects``, the plane first: they tell the local
    scene from the objects. ``convex`` says that no point of the local scene sees another (a plane alone);
    ``diffuse`` that all of it reflects without gloss.
    """

    mi: Any
    with_objects: Any
    without_objects: Any
    local_with: tuple[Any, ...]
    lights: tuple[LightGroup, ...]
    whole: LightGroup  # all of them together
    lights_above: tuple[LightGroup, ...]  # what can reach the local scene: on a plane alone, nothing from below it
    plane: Plane
    bounds: np.ndarray  # (K, 4) centre and radius of a sphere around each object, world
    convex: bool = True
    diffuse: bool = True
    photons: float = 0.0  # for every sample of a pixel and every emitter: what camera paths leave to light tracing
    own_light: bool = True  # whether the two scenes hold the same distant light as the groups
    occluders: Any = None  # scene of real things that hide the objects from the camera; they take no part in the light

    def is_local(self, hit: Any) -> Any:
        """Mask of the interactions with ``with_objects`` that lie on the local scene."""
        mask = hit.shape == self.mi.ShapePtr(self.local_with[0])
        for shape in self.local_with[1:]:
            mask |= hit.shape == self.mi.ShapePtr(shape)
        return mask & hit.is_valid()


def envmap_grid(rgb: np.ndarray) -> np.ndarray:
    """Our half-texel rows (H, W, 3) on Mitsuba's grid, where rows 0 and H - 1 are the poles; columns already agree."""
    grid = np.empty((len(rgb) + 1, *rgb.shape[1:]))
    np.add(rgb[:-1], rgb[1:], out=grid[1:-1])  # row r of H + 1 is at theta = pi r / H: midway between two of ours
    grid[1:-1] *= 0.5
    grid[0], grid[-1] = rgb[0].mean(0), rgb[-1].mean(0)
    return grid


def environment_emitter(mi: Any, rgb: np.ndarray) -> dict[str, Any]:
    """Mitsuba description of a lat-long radiance map (H, W, 3), ACEScg, as in conventions."""
    if not (rgb > 0).any():  # a map without light has no density to sample by: 0 / 0
        return {"type": "constant", "radiance": {"type": "rgb", "value": 0.0}}
    bitmap = mi.Bitmap(np.ascontiguousarray(envmap_grid(np.maximum(rgb, 0.0)), np.float32))
    return {"type": "envmap", "bitmap": bitmap}


def ground_shape(plane: Plane, bsdf: dict[str, Any]) -> dict[str, Any]:
    """The modelled rectangle; u runs from corner 0 to corner 1, v from corner 0 to corner 3."""
    mi = use_mitsuba()
    origin = plane.corners_m.mean(0)
    along_u = (plane.corners_m[1] - plane.corners_m[0]) / 2
    along_v = (plane.corners_m[3] - plane.corners_m[0]) / 2
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = along_u, along_v, plane.normal, origin
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), "bsdf": bsdf}


def ground_texture(mi: Any, albedo: np.ndarray) -> dict[str, Any]:
    """Albedo (H, W, 3) over the rectangle, first row at v = 0 (corners 0 and 1), or one colour (3,)."""
    values = np.asarray(albedo, np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(values.reshape(1, 1, 3) if values.ndim == 1 else values))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}


def above_plane(rgb: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A map (H, W, 3) with nothing in texels that lie wholly below the plane: their light never reaches it."""
    return np.where(_reaches(*rgb.shape[:2], np.asarray(normal, float).tobytes()), rgb, 0.0)


@functools.lru_cache(maxsize=4)  # one plane, and maps of one or two sizes
def _reaches(height: int, width: int, normal_bytes: bytes) -> np.ndarray:
    """(H, W, 1) texels that lie above a plane, at least in part; its normal as the bytes of (3,) float64."""
    reach = np.hypot(np.pi / height, 2 * np.pi / width)
    return (latlong_directions(height, width) @ np.frombuffer(normal_bytes) > -reach)[..., None]


def bounding_sphere(shape: Any) -> np.ndarray:
    """(4,) centre and radius of the sphere around a shape's bounding box."""
    box = shape.bbox()
    low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
    return np.array([*(low + high) / 2, np.linalg.norm(high - low) / 2])


@dataclass(frozen=True, eq=False)
class Light:
    """The distant light as `Worlds` holds it."""

    lights: tuple[LightGroup, ...]
    whole: LightGroup
    lights_above: tuple[LightGroup, ...]


def distant_light(
    mi: Any, environment: np.ndarray, emitters: Sequence[Emitter], normal: np.ndarray, convex: bool
) -> Light:
    """The environment (H, W, 3) as a partition of its texels: the sky, then each emitter; and all of it.

    For the local scene the sky is parted at the plane, so that no sample meant for the plane is lost on what lies
    below; unless ``convex`` that part is kept, for other surfaces.
    """
    sky, lamps = environment, []
    if emitters:
        sky = environment.copy()
        flat = sky.reshape(-1, 3)
        for emitter in emitters:
            texels = np.asarray(emitter.texels, int)
            alone = np.zeros(sky.shape)
            alone.reshape(-1, 3)[texels] = flat[texels]
            flat[texels] = 0.0
            lamps.append(light_group(mi, emitter.name, alone, emitter))
    above = above_plane(sky, normal)
    parts = [light_group(mi, "sky", above)]
    if not convex:
        parts.append(light_group(mi, "below", sky - above))
    everywhere = light_group(mi, "sky", sky)
    whole = light_group(mi, "all", environment) if emitters else LightGroup("all", everywhere.scene)
    return Light((everywhere, *lamps), whole, (*parts, *lamps))


def light_group(mi: Any, name: str, radiance: np.ndarray, emitter: Emitter | None = None) -> LightGroup:
    """A scene with nothing but this light."""
    return LightGroup(name, mi.load_dict({"type": "scene", "distant": environment_emitter(mi, radiance)}), emitter)


def relit(worlds: Worlds, environment: np.ndarray, emitters: Sequence[Emitter] = ()) -> Worlds:
    """The same surfaces under another distant light, for the difference strategy: it asks the light groups alone.

    The two scenes keep the light that they were built with; the reference strategy, which asks them, refuses.
    """
    light = distant_light(worlds.mi, environment, emitters, worlds.plane.normal, worlds.convex)
    return replace(worlds, **vars(light), own_light=False)


def ground_bsdf(mi: Any, albedo: np.ndarray, surface: Surface | None) -> dict[str, Any]:
    """BSDF of the plane: diffuse, or the glossy model that `surface` found."""
    texture = ground_texture(mi, albedo)
    if surface is None or surface.model == "diffuse":
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}
    return {
        "type": "insitu_gltf",
        "base_color": texture,
        "metallic": {"type": "uniform", "value": float(surface.metallic)},
        "roughness": {"type": "uniform", "value": float(surface.roughness)},
        "f0": {"type": "uniform", "value": float(surface.f0)},
    }


def proxy_shape(mi: Any, proxy: Proxy | Occluder, albedo: np.ndarray | None) -> Any:
    """A real surface, diffuse, of one albedo (3,); flat faces."""
    color = np.full(3, UNKNOWN_ALBEDO) if albedo is None else np.asarray(albedo, float)
    props = mi.Properties()
    diffuse = {"type": "diffuse", "reflectance": color_texture(mi, color)}
    props["mesh_bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse})
    vertices, faces = np.asarray(proxy.vertices_m), np.asarray(proxy.faces)
    shape = mi.Mesh(proxy.name, len(vertices), len(faces), props)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices.ravel(), np.float32)
    parameters["faces"] = np.ascontiguousarray(faces.ravel(), np.uint32)
    parameters.update()
    return shape


def build_worlds(
    plane: Plane,
    albedo: np.ndarray,
    environment: np.ndarray,
    objects: dict[str, Any],
    proxies: Sequence[Proxy] = (),
    emitters: Sequence[Emitter] = (),
    surface: Surface | None = None,
    occluders: Sequence[Occluder] = (),
) -> Worlds:
    """Scenes with and without objects.

    Args:
        plane: the local scene's ground.
        albedo: (H, W, 3) texture over the plane's corners (first row at corner 0 to 1), or (3,).
        environment: (H, W, 3) lat-long radiance, the distant scene.
        objects: name -> Mitsuba shape, world frame.
        proxies: further surfaces of the local scene.
        emitters: compact lights, as texels of ``environment``; each is sampled on its own.
        surface: how the plane reflects; diffuse when None.
        occluders: real things in front of the objects; those that are pictures are left to the composite.
    """
    mi = use_mitsuba()
    local = ground_shape(plane, ground_bsdf(mi, albedo, surface))
    shared = {"type": "scene", "distant": environment_emitter(mi, environment)}
    scenes = []
    for synthetic in (objects, {}):
        shapes = {"ground": mi.load_dict(local)}
        shapes |= {f"proxy_{proxy.name}": proxy_shape(mi, proxy, proxy.albedo) for proxy in proxies}
        scenes.append((mi.load_dict({**shared, **shapes, **synthetic}), tuple(shapes.values())))
    (with_objects, local_with), (without, _) = scenes
    light = distant_light(mi, environment, emitters, plane.normal, convex=not proxies)
    hiding = {f"occluder_{o.name}": proxy_shape(mi, o, None) for o in occluders if o.vertices_m is not None}
    return Worlds(
        mi=mi,
        with_objects=with_objects,
        without_objects=without,
        local_with=local_with,
        **vars(light),
        plane=plane,
        bounds=np.array([bounding_sphere(shape) for shape in objects.values()]).reshape(-1, 4),
        convex=not proxies,
        diffuse=surface is None or surface.model == "diffuse",
        occluders=mi.load_dict({"type": "scene", **hiding}) if hiding else None,
    )
