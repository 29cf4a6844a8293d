"""Which directions a point of the local scene looks in: towards the objects, since all else is equal in both worlds."""

from __future__ import annotations

from typing import Any

from pipeline.transport.scene import Worlds
from pipeline.transport.variant import kernel_input

CONE_SHARE = 0.5  # of the directions, where the BSDF is sampled too


def cone_share(worlds: Worlds) -> float:
    """Share of the directions that are drawn towards the objects; the BSDF draws the others where it can find more."""
    return 1.0 if worlds.convex and worlds.diffuse else CONE_SHARE


def direction_density(worlds: Worlds, origin: Any, normal: Any, direction: Any, bsdf_pdf: Any) -> Any:
    """Density [1/sr] with which a point looks along ``direction``, whose density by the BSDF is ``bsdf_pdf``."""
    share = cone_share(worlds)
    return share * cone_pdf(object_cones(worlds, origin), direction, normal) + (1 - share) * bsdf_pdf


def object_cones(worlds: Worlds, origin: Any) -> list[tuple[Any, Any, Any]]:
    """Per object: axis, cosine of the half angle (-1 when the point is inside the sphere), and share of samples.

    Shares follow the cones' solid angles, an upper bound of what each object can change.
    """
    import drjit as dr

    mi = worlds.mi
    cones = []
    for sphere in worlds.bounds:
        x, y, z, radius = (kernel_input(mi, value) for value in sphere)
        offset = mi.Vector3f(x, y, z) - origin
        distance = dr.norm(offset)
        sine = radius * 1.001 / distance
        inside = sine >= 0.999
        cosine = dr.select(inside, -1.0, dr.sqrt(dr.maximum(1 - sine * sine, 0.0)))
        # A point inside uses the whole hemisphere with the cosine, of weight 1; a cone 1 - cos of one hemisphere.
        share = dr.select(inside, 1.0, dr.maximum(1 - cosine, 1e-4))
        cones.append((offset / distance, cosine, share))
    total = sum((share for _, _, share in cones), mi.Float(0.0))
    return [(axis, cosine, share / total) for axis, cosine, share in cones]


def cone_pdf(cones: list[tuple[Any, Any, Any]], direction: Any, normal: Any) -> Any:
    """Density [1/sr] with which `sample_cone` chooses a direction."""
    import drjit as dr

    density = 0.0 * dr.dot(direction, normal)
    hemisphere = dr.maximum(dr.dot(direction, normal), 0.0) * dr.inv_pi
    for axis, cosine, share in cones:
        within = dr.select(dr.dot(direction, axis) >= cosine, 1 / (dr.two_pi * dr.maximum(1 - cosine, 1e-12)), 0.0)
        density += share * dr.select(cosine == -1, hemisphere, within)
    return density


def sample_cone(mi: Any, cones: list[tuple[Any, Any, Any]], choice: Any, point: Any, normal: Any) -> Any:
    """A direction towards one of the objects."""
    import drjit as dr

    hemisphere = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(point))
    direction = mi.Vector3f(hemisphere)
    passed = mi.Float(0.0)
    for axis, cosine, share in cones:
        here = (choice >= passed) & (choice < passed + share)
        local = mi.warp.square_to_uniform_cone(point, cosine)
        aimed = dr.select(cosine == -1, hemisphere, mi.Frame3f(axis).to_world(local))
        direction = dr.select(here, aimed, direction)
        passed += share
    return direction
