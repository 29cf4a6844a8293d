"""The fast strategy: what the objects change on the local scene, estimated directly.

At a point x of the local scene the worlds with and without objects differ in two ways: light that an object hides
(lost), and radiance that arrives from an object instead of what was behind it (gained):

    LS_obj - LS_noobj = integral of f(x, w) (L_obj(w) - L_noobj(w)) cos(theta) dw

The integrand is zero in every direction that meets the same thing in both worlds, unless that thing is another point
of the local scene whose own light has changed: then the same formula applies there. So a *difference path* starts at
the camera, runs along local surfaces, and ends where it meets an object; only there do the worlds part, one path
gathering L_obj, another L_noobj. On a plane under distant light it ends after one step and L_noobj is the distant
light itself.

Every light group is sampled on its own (an emitter's shadow costs one ray and has no noise in umbra and in light). The
sky is combined with the sampled directions by multiple importance sampling (balance heuristic, Veach and Guibas 1995):
directions are drawn towards the bounding spheres of the objects, and from the BSDF where the ground is glossy or local
surfaces see each other. LS_noobj is not rendered here. Unbiased; equal to the reference strategy in the mean (tested).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.transport.caustics import against_camera
from pipeline.transport.directions import cone_pdf, cone_share, object_cones, sample_cone
from pipeline.transport.paths import Caustic, distant, trace_paths
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import Rays, Samples, camera_hits, collect, make_sampler


def difference_block(worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
    """Trace a block of pixels; see `pipeline.transport.trace.trace`."""
    import drjit as dr

    mi = worlds.mi
    sampler = make_sampler(mi, samples)
    count = sampler.sample_count()
    sampler.set_samples_per_wavefront(count)
    sampler.seed(seed, len(rays) * count)
    ray, hit, on_object, on_local = camera_hits(worlds, rays, count, sampler.next_2d(), footprint_px)

    zero = mi.Color3f(0.0)
    lost, split, beta, behind, density = follow(worlds, sampler, hit, on_local, depth)
    # One path per sample: on from the camera where an object is seen, else along the direction that met an object.
    parted = dr.any(beta != 0)
    onward = mi.Ray3f(dr.select(on_object, ray.o, split.o), dr.select(on_object, ray.d, split.d))
    shared = None if worlds.photons == 0 else caustic(worlds, rays, count, ray, hit, on_object, split, density)
    found = trace_paths(worlds, worlds.with_objects, sampler, onward, on_object | parted, depth, shared)
    gained = dr.select(parted, found * beta, zero)
    if not worlds.convex:
        covered = trace_paths(worlds, worlds.without_objects, sampler, split, behind, depth)
        lost -= dr.select(behind, covered * beta, zero)
    finite = dr.all(dr.isfinite(found)) & dr.all(dr.isfinite(lost)) & dr.all(dr.isfinite(gained))
    return collect(
        mi,
        count,
        obj=dr.select(on_object & finite, found, zero),
        lost=dr.select(finite, lost, zero),
        gained=dr.select(finite, gained, zero),
        without=zero + 0 * lost,
        hit=hit,
        masks=(on_object, on_local, finite),
    )


def caustic(
    worlds: Worlds, rays: Rays, count: int, ray: Any, hit: Any, on_object: Any, split: Any, density: Any
) -> Caustic:
    """What paths that left the point ``hit`` along ``split``, with ``density``, share with light tracing."""
    import drjit as dr

    mi = worlds.mi
    pixel = dr.arange(mi.UInt32, len(rays) * count) // count
    solid_angle = dr.gather(mi.Float, mi.Float(rays.solid_angles().astype(np.float32)), pixel)
    pixels_per_area = dr.abs(dr.dot(hit.n, ray.d)) / (dr.square(hit.t) * solid_angle)
    scale = dr.abs(dr.dot(hit.n, split.d)) / (pixels_per_area * density)
    active = (density > 0) & (pixels_per_area > 0)

    def against(point: Any, along: Any, light: Any) -> Any:
        return against_camera(worlds, point, -along.d, light) * scale

    return Caustic(active, on_object, against)


def follow(worlds: Worlds, sampler: Any, hit: Any, active: Any, depth: int) -> tuple[Any, ...]:
    """Difference paths from points of the local scene.

    Returns the lost light so far; the ray that met an object and its weight (0 when none did); whether, where local
    surfaces see each other, that ray would have met one of them without the objects; and the density of its direction
    when it left the very point that the camera sees, else 0.
    """
    import drjit as dr

    mi = worlds.mi
    zero = mi.Color3f(0.0)
    nothing = dr.zeros(mi.Ray3f, dr.width(active))
    if worlds.convex:
        lost, ray, weight, density = step(worlds, sampler, hit, active)
        meets = dr.any(weight != 0) & worlds.with_objects.ray_test(ray, dr.any(weight != 0))
        beta = dr.select(meets, weight, zero)
        return (
            lost - hidden_light(worlds, ray, beta, density, meets),
            ray,
            beta,
            mi.Bool(False),
            dr.select(meets, density, 0.0),
        )

    def bounce(*state: Any) -> tuple[Any, ...]:
        active, point, through, left, lost, split, beta, behind, drawn, sampler = state
        taken, ray, weight, density = step(worlds, sampler, point, active)
        lost += dr.select(active, through * taken, zero)
        weight = dr.select(active, through * weight, zero)
        following = worlds.with_objects.ray_intersect(ray, active=active & dr.any(weight != 0))
        local = worlds.is_local(following)
        meets = following.is_valid() & ~local
        covered = meets & worlds.without_objects.ray_test(ray, meets)
        lost -= hidden_light(worlds, ray, dr.select(meets & ~covered, weight, zero), density, meets & ~covered)
        split = dr.select(meets, ray, split)
        beta = dr.select(meets, weight, beta)
        behind |= covered
        drawn = dr.select(meets & (left == depth), density, drawn)
        return active & local & (left > 1), following, weight, left - 1, lost, split, beta, behind, drawn, sampler

    width = dr.width(active)
    state = (
        mi.Bool(active),
        hit,
        dr.full(mi.Color3f, 1.0, width),
        dr.full(mi.UInt32, depth, width),
        dr.zeros(mi.Color3f, width),
        nothing,
        dr.zeros(mi.Color3f, width),
        dr.full(mi.Bool, False, width),
        dr.zeros(mi.Float, width),
        sampler,
    )
    state = dr.while_loop(state, lambda *s: s[0], bounce, label="difference path")
    return state[4:9]


def step(worlds: Worlds, sampler: Any, hit: Any, active: Any) -> tuple[Any, Any, Any, Any]:
    """At a local point: direct light that the objects hide (<= 0), and one direction with its weight and density.

    The weight is BSDF times cosine over density, (3,); 0 where the direction leads nowhere.
    """
    import drjit as dr

    mi = worlds.mi
    context = mi.BSDFContext()
    bsdf = hit.bsdf()
    normal = dr.mulsign(mi.Vector3f(hit.n), hit.wi.z)
    origin = hit.p + normal * (1e-5 * (1 + dr.max(dr.abs(hit.p))))  # ten times nearer than Mitsuba's own offset
    cones = object_cones(worlds, origin)
    share = cone_share(worlds)
    lost = mi.Color3f(0.0)
    for group in worlds.lights_above:
        light, radiance = group.scene.sample_emitter_direction(hit, sampler.next_2d(active), False, active)
        value, pdf = bsdf.eval_pdf(context, hit, hit.to_local(light.d), active & (light.pdf > 0))
        lit = active & (light.pdf > 0) & (dr.dot(light.d, normal) > 0)
        shadow = mi.Ray3f(origin, light.d)
        if not worlds.convex:
            lit &= ~worlds.without_objects.ray_test(shadow, lit)
        blocked = lit & worlds.with_objects.ray_test(shadow, lit)
        if not group.compact:
            chosen = share * cone_pdf(cones, light.d, normal) + (1 - share) * pdf
            value *= light.pdf / (light.pdf + chosen)
        lost -= dr.select(blocked, value * radiance, mi.Color3f(0.0))
    toward = sample_cone(mi, cones, sampler.next_1d(active), sampler.next_2d(active), normal)
    if share < 1:
        drawn, _ = bsdf.sample(context, hit, sampler.next_1d(active), sampler.next_2d(active), active)
        toward = dr.select(sampler.next_1d(active) < share, toward, hit.to_world(drawn.wo))
    value, pdf = bsdf.eval_pdf(context, hit, hit.to_local(toward), active)
    density = share * cone_pdf(cones, toward, normal) + (1 - share) * pdf
    usable = active & (dr.dot(toward, normal) > 0) & (density > 0)
    return lost, mi.Ray3f(origin, toward), dr.select(usable, value / density, mi.Color3f(0.0)), density


def hidden_light(worlds: Worlds, ray: Any, weight: Any, density: Any, active: Any) -> Any:
    """Distant light that a direction no longer receives; what of it `step` finds by sampling the light is left out."""
    import drjit as dr

    mi = worlds.mi
    wide = [group for group in worlds.lights_above if not group.compact]
    light = distant(worlds, wide, ray.d, active, density, mi.Bool(False), mi.Bool(False))
    return dr.select(active, weight * light, mi.Color3f(0.0))
