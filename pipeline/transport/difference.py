"""The fast strategy: what the objects change on a plane under distant light, estimated directly.

At a point x of a convex local scene the two worlds differ only in directions that meet an object:

    LS_obj - LS_noobj = rho_d  integral over the objects' solid angle of (L_object - L_distant) cos(theta) dw

so only those directions are sampled. The lost light, ``-L_distant``, combines samples of the lights with samples of the
cones around the objects' bounding spheres by multiple importance sampling (balance heuristic, Veach and Guibas 1995);
the gained light, ``L_object``, follows the cone samples with an ordinary path tracer, so colour bleeding, mirrors and
caustics of every order are in it. LS_noobj is not rendered: it is ``rho_d E`` in closed form (equation 7). Unbiased;
equal to the reference strategy in the mean (tested).
"""

from __future__ import annotations

from typing import Any

from pipeline.transport.scene import Worlds
from pipeline.transport.trace import NEVER, Rays, Samples, camera_rays, collect, make_sampler, object_surface


def difference_block(worlds: Worlds, rays: Rays, samples: int, depth: int, seed: int, footprint_px: float) -> Samples:
    """Trace a block of pixels; see `pipeline.transport.trace.trace`."""
    import drjit as dr

    mi = worlds.mi
    scene = worlds.with_objects
    sampler = make_sampler(mi, samples)
    count = sampler.sample_count()
    sampler.set_samples_per_wavefront(count)
    sampler.seed(seed, len(rays) * count)
    ray = camera_rays(mi, dr, rays, count, sampler.next_2d(), footprint_px)
    hit = scene.ray_intersect(ray)
    on_ground = hit.is_valid() & (hit.shape == mi.ShapePtr(worlds.ground_with))
    on_object = hit.is_valid() & ~on_ground
    normal = mi.Vector3f(*[float(v) for v in worlds.plane.normal])
    origin = hit.p + normal * (1e-5 * (1 + dr.max(dr.abs(hit.p))))

    # Light samples: blocked by an object or not.
    light, radiance = worlds.above.sample_emitter_direction(hit, sampler.next_2d(), False, on_ground)
    cos_light = dr.dot(light.d, normal)
    lit = on_ground & (light.pdf > 0) & (cos_light > 0)
    blocked = lit & scene.ray_test(mi.Ray3f(origin, light.d), lit)
    pdf_cone = cone_pdf(mi, dr, worlds, origin, light.d)
    lost = dr.select(blocked, -radiance * light.pdf * cos_light / (light.pdf + pdf_cone), mi.Color3f(0.0))

    # Cone samples: what the object sends instead, less what it hides.
    toward, pdf_toward = sample_cone(mi, dr, worlds, origin, sampler.next_1d(), sampler.next_2d())
    cos_toward = dr.dot(toward, normal)
    aimed = on_ground & (cos_toward > 0) & (pdf_toward > 0)

    # One path per sample: on from the camera where an object is seen, else from the ground towards an object.
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NEVER, "hide_emitters": True})
    onward = mi.RayDifferential3f(dr.select(on_object, ray.o, origin), dr.select(on_object, ray.d, toward))
    found, arrives, _ = integrator.sample(scene, sampler, onward, active=on_object | aimed)
    meets = aimed & arrives
    hidden, pdf_light = distant_light(mi, worlds, hit, toward, meets)
    lost -= dr.select(meets, hidden * cos_toward / (pdf_light + pdf_toward), mi.Color3f(0.0))
    albedo = dr.select(on_ground, worlds.ground_albedo.eval(hit, on_ground), mi.Color3f(0.0))
    brdf = albedo * dr.inv_pi
    gained = dr.select(meets, found * cos_toward / pdf_toward, mi.Color3f(0.0)) * brdf
    lost *= brdf
    finite = dr.all(dr.isfinite(found)) & dr.all(dr.isfinite(lost)) & dr.all(dr.isfinite(gained))
    zero = mi.Color3f(0.0)
    return collect(
        mi,
        count,
        obj=dr.select(on_object & finite, found, zero),
        lost=dr.select(finite, lost, zero),
        gained=dr.select(finite, gained, zero),
        without=zero + 0 * albedo,
        albedo=albedo,
        surface=object_surface(mi, hit, on_object),
        masks=(on_object, on_ground, finite),
    )


def distant_light(mi: Any, worlds: Worlds, hit: Any, direction: Any, active: Any) -> tuple[Any, Any]:
    """Radiance of the distant scene along a direction, and the density with which light sampling would choose it."""
    import drjit as dr

    emitter = worlds.above.environment()
    away = dr.zeros(mi.SurfaceInteraction3f)
    away.wi = -direction
    record = dr.zeros(mi.DirectionSample3f)
    record.d = direction
    pdf = emitter.pdf_direction(hit, record, active)  # the only light of that scene
    return emitter.eval(away, active), dr.select(active, pdf, 0.0)


def _cones(mi: Any, dr: Any, worlds: Worlds, origin: Any) -> list[tuple[Any, Any, Any]]:
    """Per object: axis, cosine of the half angle (-1 when the point is inside the sphere), and share of samples.

    Shares follow the cones' solid angles, an upper bound of what each object can change.
    """
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


def cone_pdf(mi: Any, dr: Any, worlds: Worlds, origin: Any, direction: Any) -> Any:
    """Density [1/sr] with which `sample_cone` chooses a direction."""
    density = mi.Float(0.0)
    normal = mi.Vector3f(*[float(v) for v in worlds.plane.normal])
    hemisphere = dr.maximum(dr.dot(direction, normal), 0.0) * dr.inv_pi
    for axis, cosine, share in _cones(mi, dr, worlds, origin):
        within = dr.select(dr.dot(direction, axis) >= cosine, 1 / (dr.two_pi * dr.maximum(1 - cosine, 1e-12)), 0.0)
        density += share * dr.select(cosine == -1, hemisphere, within)
    return density


def sample_cone(mi: Any, dr: Any, worlds: Worlds, origin: Any, choice: Any, point: Any) -> tuple[Any, Any]:
    """A direction towards one of the objects and its density over all of them."""
    normal = mi.Vector3f(*[float(v) for v in worlds.plane.normal])
    hemisphere = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(point))
    direction = mi.Vector3f(hemisphere)
    passed = mi.Float(0.0)
    for axis, cosine, share in _cones(mi, dr, worlds, origin):
        here = (choice >= passed) & (choice < passed + share)
        local = mi.warp.square_to_uniform_cone(point, cosine)
        aimed = dr.select(cosine == -1, hemisphere, mi.Frame3f(axis).to_world(local))
        direction = dr.select(here, aimed, direction)
        passed += share
    return direction, cone_pdf(mi, dr, worlds, origin, direction)
