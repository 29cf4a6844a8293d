"""Light tracing: what an emitter throws by way of the objects straight onto the local scene.

A path from the camera finds the mirror image of the sun in an object by chance only; a path from the sun finds it
always. So paths emitter - object(s) - local scene - camera are also built from the light: directions and points of the
emitter's light on discs around the objects, on along the BSDFs, and where a local surface is met that the camera sees,
into its pixel. Three kinds of such paths come from here:

* off one object: shared with the paths from the camera by multiple importance sampling (balance heuristic), whatever
  the material, so that each finds what it is good at;
* along mirrors and glass of any number: from here alone, since camera paths cannot (a small light, a delta BSDF);
* along mirrors and glass to a rough object that the camera sees: likewise.

Light of the sky, and what bounces more than once off rough objects, stays with the camera's paths.
Arvo, *Backward ray tracing*, 1986; Veach, *Robust Monte Carlo methods for light transport simulation*, 1997, ch. 10.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.transport.directions import direction_density
from pipeline.transport.scene import LightGroup, Worlds
from pipeline.transport.variant import kernel_input

MIRRORS = 12  # longest chain of mirrors and glass surfaces
PHOTONS_PER_SAMPLE = 0.3  # photons for every pixel and every sample of it
PHOTONS_PER_BLOCK = 1 << 21
Slot = Callable[[np.ndarray], np.ndarray]  # of flat indices of pixels (N,): where their light goes, -1 for nowhere


@dataclass(frozen=True, eq=False)
class Film:
    """Where photons land: through the photograph's own lens.

    ``project``: world points (N, 3) to pixels (N, 2), NaN where the lens does not see them. ``shape``: (H, W).
    ``pixel_sr``: flat indices (N,) of pixels to their solid angles (N,). ``origin``: (3,) the camera.
    """

    project: Callable[[np.ndarray], np.ndarray]
    shape: tuple[int, int]
    pixel_sr: Callable[[np.ndarray], np.ndarray]
    origin: np.ndarray


def throws(worlds: Worlds) -> bool:
    """Whether there is an emitter, and an object that could throw its light."""
    return any(group.compact for group in worlds.lights) and len(worlds.bounds) > 0


def photons_for(worlds: Worlds, pixels: int) -> float:
    """Photons for one sample of each of so many pixels, of every emitter."""
    return PHOTONS_PER_SAMPLE * pixels / max(1, sum(group.compact for group in worlds.lights))


def disc_density(worlds: Worlds, point: Any, direction: Any) -> Any:
    """Density [1/m^2] of photons, per photon, on the line through ``point`` against ``direction``.

    They start on discs across the objects' bounding spheres, on one as often as on another.
    """
    import drjit as dr

    mi = worlds.mi
    density = 0.0 * direction.x
    for sphere in worlds.bounds:
        x, y, z, radius = (kernel_input(mi, value) for value in sphere)
        offset = point - mi.Point3f(x, y, z)
        aside = dr.squared_norm(offset - direction * dr.dot(offset, direction))
        share = 1 / (np.pi * dr.square(radius) * len(worlds.bounds))
        density += dr.select(aside <= dr.square(radius), share, 0.0)
    return density


def against_camera(worlds: Worlds, hit: Any, back: Any, light: Any) -> Any:
    """Off one object: density of light tracing over that of a path from the camera, but for what `lens_term` holds.

    At a point ``hit`` of an object that light from the unit direction ``light`` reaches and leaves along ``back``.
    """
    import drjit as dr

    mi = worlds.mi
    lit = mi.SurfaceInteraction3f(hit)
    lit.wi = hit.to_local(light)
    pdf = hit.bsdf().pdf(mi.BSDFContext(mi.TransportMode.Importance), lit, hit.to_local(back))
    arriving, leaving = dr.abs(dr.dot(hit.n, light)), dr.abs(dr.dot(hit.n, back))
    ratio = kernel_input(mi, worlds.photons) * disc_density(worlds, hit.p, light) * arriving * pdf / leaving
    return dr.select(leaving > 0, ratio, 0.0)


def thrown(worlds: Worlds, film: Film, samples: float, seed: int, slot: Slot, slots: int) -> np.ndarray:
    """(2, slots, 3) radiance of the local scene, and of objects, by light that emitters send there by way of objects.

    Takes ``worlds.photons`` photons for each of ``samples`` samples of a pixel, for each emitter. Add it to what paths
    from the camera find with the same ``worlds.photons``; together they are unbiased. ``slot`` tells where the light of
    a pixel goes, pixels by their flat indices (N,), -1 for nowhere; a slot of several pixels gets their sum.
    """
    height, width = film.shape
    picture = np.zeros((3, 2 * slots))
    lamps = [group for group in worlds.lights if group.compact]
    wanted = max(1, round(worlds.photons * samples))
    for number, lamp in enumerate(lamps):
        for start in range(0, wanted, PHOTONS_PER_BLOCK):
            count = min(PHOTONS_PER_BLOCK, wanted - start)
            landed = _landed(worlds, film, lamp, count, seed + 104729 * (number + 1) + start)
            pixel = film.project(landed["point"])
            with np.errstate(invalid="ignore"):
                column, row = np.floor(pixel).T
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            index = (row[inside] * width + column[inside]).astype(int)
            place = slot(index)
            wished = place >= 0
            inside, index, place = np.flatnonzero(inside)[wished], index[wished], place[wished]
            layer = place + slots * landed["on_object"][inside].astype(int)
            per_area = landed["per_area"][inside] / film.pixel_sr(index)  # pixels per m^2 of the surface
            ratio = landed["ratio"][inside] / per_area
            share = np.where(np.isinf(ratio), 1.0, ratio / (1 + np.where(np.isinf(ratio), 0, ratio)))
            value = landed["value"][inside] * (share * per_area / wanted)[:, None]
            for channel in range(3):
                picture[channel] += np.bincount(layer, value[:, channel], 2 * slots)
    return np.moveaxis(picture.reshape(3, 2, slots), 0, -1)


def _landed(worlds: Worlds, film: Film, lamp: LightGroup, count: int, seed: int) -> dict[str, np.ndarray]:
    """Photons that reached a local surface, or by mirrors a rough object, which the camera sees.

    ``point`` (N, 3); ``value`` (N, 3) BSDF towards the camera times flux; ``per_area`` (N,) cosine over squared
    distance to the camera, [sr / m^2]; ``ratio`` (N,) density against paths from the camera but for pixels per area,
    infinite where no such path competes; ``on_object`` (N,) 0 or 1.
    """
    import drjit as dr

    mi = worlds.mi
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed % 2**32, count)
    state = (
        *_emitted(worlds, lamp, count, sampler),
        dr.full(mi.Float, float("inf"), count),
        dr.full(mi.Int32, MIRRORS, count),
        dr.full(mi.Bool, False, count),
        dr.zeros(mi.SurfaceInteraction3f, count),
        sampler,
    )
    body = functools.partial(_flown, worlds, mi.BSDFContext(mi.TransportMode.Importance))
    _, _, flux, ratio, _, landed, found, _ = dr.while_loop(state, lambda *s: s[0], body, label="photons")
    landed, value, per_area, ratio = _towards_camera(worlds, film, found, landed, flux, ratio)
    keep = landed & dr.all(dr.isfinite(value))
    on_object = dr.select(worlds.is_local(found), mi.Float(0.0), mi.Float(1.0))
    numbers = [mi.Float(number) for number in (*found.p, *value, per_area, ratio, on_object)]
    dr.eval(keep, numbers)  # once, else every gather below would run the whole kernel again
    index = mi.UInt32(dr.compress(keep))
    rows = np.stack([np.asarray(dr.gather(mi.Float, number, index)) for number in numbers]).astype(float)
    return {"point": rows[:3].T, "value": rows[3:6].T, "per_area": rows[6], "ratio": rows[7], "on_object": rows[8]}


def _emitted(worlds: Worlds, lamp: LightGroup, count: int, sampler: Any) -> tuple[Any, Any, Any]:
    """Photons of a lamp across the objects' bounding spheres: which carry light, their rays, flux."""
    import drjit as dr

    mi = worlds.mi
    anywhere = dr.zeros(mi.SurfaceInteraction3f, count)
    light, weight = lamp.scene.sample_emitter_direction(anywhere, sampler.next_2d(), False)
    choice = dr.minimum(mi.UInt32(sampler.next_1d() * len(worlds.bounds)), len(worlds.bounds) - 1)
    columns = [dr.gather(mi.Float, mi.Float(np.ascontiguousarray(c, np.float32)), choice) for c in worlds.bounds.T]
    disc = mi.warp.square_to_uniform_disk(sampler.next_2d()) * columns[3]
    centre = mi.Point3f(*columns[:3])
    start = centre + mi.Frame3f(light.d).to_world(mi.Vector3f(disc.x, disc.y, 0.0))
    far = kernel_input(mi, 4 * (np.abs(worlds.plane.corners_m).max() + np.abs(worlds.bounds).sum(1).max()))
    flux = dr.select(light.pdf > 0, weight / disc_density(worlds, start, light.d), mi.Color3f(0.0))
    return dr.any(flux != 0), mi.Ray3f(start + light.d * far, -light.d), flux


def _flown(worlds: Worlds, context: Any, *state: Any) -> tuple[Any, ...]:
    """One flight of the photons, to where they land or to the next surface."""
    import drjit as dr

    mi = worlds.mi
    scene = worlds.with_objects
    active, ray, flux, ratio, left, landed, found, sampler = state
    hit = scene.ray_intersect(ray, active=active)
    local = worlds.is_local(hit)
    rough = mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Smooth)
    arrives = active & hit.is_valid() & (left < MIRRORS) & (local | (rough & dr.isinf(ratio)))
    # Half rough and half mirror: it ends there or goes on, by a coin.
    either = arrives & ~local & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Delta)
    arrives &= ~either | (sampler.next_1d(either) < 0.5)
    flux = dr.select(either, 2 * flux, flux)
    found = dr.select(arrives, hit, found)
    landed |= arrives
    # On an object: after a rough one the path ends at the next surface, whatever that is.
    onward = active & hit.is_valid() & ~arrives & ~local & dr.isinf(ratio) & (left > 0)
    drawn, weight = hit.bsdf().sample(context, hit, sampler.next_1d(onward), sampler.next_2d(onward), onward)
    outward = hit.to_world(drawn.wo)
    # Shading normals make a BSDF asymmetric (Veach, section 5.3).
    coming, going = dr.dot(hit.n, -ray.d), dr.dot(hit.n, outward)
    cos_in, cos_out = mi.Frame3f.cos_theta(hit.wi), mi.Frame3f.cos_theta(drawn.wo)
    onward &= (coming * cos_in > 0) & (going * cos_out > 0)
    weight *= dr.abs(cos_in * going / (cos_out * coming))
    flux = dr.select(onward, flux * weight, flux)
    delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
    scatters = onward & ~delta
    onward &= dr.any(flux != 0) & (delta | (left == MIRRORS))  # rough only as the first and only one
    off_one = against_camera(worlds, hit, outward, -ray.d)
    ratio = dr.select(scatters, off_one, ratio)
    return onward, dr.select(onward, hit.spawn_ray(outward), ray), flux, ratio, left - 1, landed, found, sampler


def _towards_camera(
    worlds: Worlds, film: Film, found: Any, landed: Any, flux: Any, ratio: Any
) -> tuple[Any, Any, Any, Any]:
    """Of the photons at ``found``: which the camera sees, and ``value``, ``per_area`` and ``ratio`` of `_landed`."""
    import drjit as dr

    mi = worlds.mi
    scene = worlds.with_objects
    eye = mi.Point3f(*[kernel_input(mi, v) for v in film.origin])
    back = found.to_world(found.wi)  # where the photon came from
    offset = eye - found.p
    distance = dr.norm(offset)
    toward = offset / distance
    landed &= (dr.dot(found.n, toward) * dr.dot(found.n, back)) > 0
    sight = found.spawn_ray_to(eye)
    landed &= ~scene.ray_test(sight, landed)
    if worlds.occluders is not None:
        landed &= ~worlds.occluders.ray_test(sight, landed)
    seen = mi.SurfaceInteraction3f(found)
    seen.wi = found.to_local(toward)
    value, pdf = found.bsdf().eval_pdf(mi.BSDFContext(), seen, found.wi, landed)
    cosine = dr.abs(dr.dot(found.n, back))
    normal = dr.mulsign(mi.Vector3f(found.n), dr.dot(found.n, toward))
    density = direction_density(worlds, found.p, normal, back, pdf)
    value *= flux / cosine
    ratio = dr.select(density > 0, ratio * cosine / density, float("inf"))
    return landed, value, dr.abs(dr.dot(found.n, toward)) / dr.square(distance), ratio
