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

from pipeline.transport.paths import trace_paths
from pipeline.transport.scene import Worlds
from pipeline.transport.trace import Rays, Samples, camera_hits, collect, make_sampler

CONE_SHARE = 0.5  # of the directions, where the BSDF is sampled too


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
    lost, split, beta, behind = follow(worlds, sampler, hit, on_local, depth)
    # One path per sample: on from the camera where an object is seen, else along the direction that met an object.
    parted = dr.any(beta != 0)
    onward = mi.Ray3f(dr.select(on_object, ray.o, split.o), dr.select(on_object, ray.d, split.d))
    found = trace_paths(worlds, worlds.with_objects, sampler, onward, on_object | parted, depth)
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


def follow(worlds: Worlds, sampler: Any, hit: Any, active: Any, depth: int) -> tuple[Any, Any, Any, Any]:
    """Difference paths from points of the local scene.

    Returns the lost light so far; the ray that met an object and its weight (0 when none did); and, where local
    surfaces see each other, whether that ray would have met one of them without the objects.
    """
    import drjit as dr

    mi = worlds.mi
    zero = mi.Color3f(0.0)
    nothing = dr.zeros(mi.Ray3f, dr.width(active))
    if worlds.convex:
        lost, ray, weight, density = step(worlds, sampler, hit, active)
        meets = dr.any(weight != 0) & worlds.with_objects.ray_test(ray, dr.any(weight != 0))
        beta = dr.select(meets, weight, zero)
        return lost - hidden_light(worlds, hit, ray, beta, density, meets), ray, beta, mi.Bool(False)

    def onward(state: tuple[Any, ...]) -> Any:
        return state[0]

    def bounce(state: tuple[Any, ...]) -> tuple[Any, ...]:
        active, point, through, left, lost, split, beta, behind, sampler = state
        taken, ray, weight, density = step(worlds, sampler, point, active)
        lost += dr.select(active, through * taken, zero)
        weight = dr.select(active, through * weight, zero)
        following = worlds.with_objects.ray_intersect(ray, active=active & dr.any(weight != 0))
        local = worlds.is_local(following)
        meets = following.is_valid() & ~local
        covered = meets & worlds.without_objects.ray_test(ray, meets)
        lost -= hidden_light(worlds, point, ray, dr.select(meets & ~covered, weight, zero), density, meets & ~covered)
        split = dr.select(meets, ray, split)
        beta = dr.select(meets, weight, beta)
        behind |= covered
        return active & local & (left > 1), following, weight, left - 1, lost, split, beta, behind, sampler

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
        sampler,
    )
    state = dr.while_loop(state, lambda *s: onward(s), lambda *s: bounce(s), label="difference path")
    return state[4], state[5], state[6], state[7]


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
    share = 1.0 if worlds.convex and worlds.diffuse else CONE_SHARE
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


def hidden_light(worlds: Worlds, hit: Any, ray: Any, weight: Any, density: Any, active: Any) -> Any:
    """Distant light that a direction no longer receives; what of it `step` finds by sampling the light is left out."""
    import drjit as dr

    mi = worlds.mi
    total = mi.Color3f(0.0)
    for group in worlds.lights_above:
        if group.compact:
            continue
        emitter = group.scene.environment()
        away = dr.zeros(mi.SurfaceInteraction3f)
        away.wi = -ray.d
        record = dr.zeros(mi.DirectionSample3f)
        record.d = ray.d
        pdf = emitter.pdf_direction(hit, record, active)  # the only light of that scene
        total += emitter.eval(away, active) * (density / (density + pdf))
    return dr.select(active, weight * total, mi.Color3f(0.0))


def object_cones(worlds: Worlds, origin: Any) -> list[tuple[Any, Any, Any]]:
    """Per object: axis, cosine of the half angle (-1 when the point is inside the sphere), and share of samples.

    Shares follow the cones' solid angles, an upper bound of what each object can change.
    """
    import drjit as dr

    mi = worlds.mi
    cones = []
    for x, y, z, radius in worlds.bounds:
        offset = mi.Vector3f(float(x), float(y), float(z)) - origin
        distance = dr.norm(offset)
        sine = float(radius) * 1.001 / distance
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
