"""Radiance along rays: a path tracer that samples every light on its own.

At the first vertex every light group (sky, sun, lamps) gets a sample of its own, later ones share one over the whole
map; every light-giving object gets one too. All are combined with the BSDF's by multiple importance sampling (balance
heuristic, Veach and Guibas 1995). Mitsuba's own ``path`` picks one light per vertex, which is the larger part of its
noise under a sun and a sky.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.transport.scene import LightGroup, Worlds


@dataclass(frozen=True, eq=False)
class Caustic:
    """What a path leaves to light tracing: light of an emitter that objects alone threw on its first vertex.

    ``active``: (N,) rays that left the local scene, where the camera sees it, towards an object. ``against(hit, from,
    light)``: at their first vertex, for light from a direction, the density of light tracing over that of the path.
    ``seen``: (N,) rays from the camera itself to an object.
    """

    active: Any
    seen: Any
    against: Callable[[Any, Any, Any], Any]


def trace_paths(
    worlds: Worlds, scene: Any, sampler: Any, ray: Any, active: Any, depth: int, caustic: Caustic | None = None
) -> Any:
    """Radiance (3,) that arrives along rays; zero where not ``active``.

    Args:
        worlds: for the light groups.
        scene: ``with_objects`` or ``without_objects``.
        sampler: its next dimensions are used up.
        ray: (N,) Mitsuba rays.
        active: (N,) which to trace.
        depth: longest path in segments, 1 sees lights only; as ``max_depth`` of Mitsuba's ``path``.
        caustic: leave to light tracing what it finds better.
    """
    import drjit as dr

    mi = worlds.mi
    lamps = [emitter for emitter in scene.emitters() if not emitter.is_environment()]
    # Textured lights are not sampled, see `pipeline.transport.surfaces.area_emitter`.
    aimed = [lamp for lamp in lamps if mi.traverse(lamp)["sampling_weight"] > 0]
    width = dr.width(active)

    def vertex(lights: Sequence[LightGroup], *state: Any) -> tuple[Any, ...]:
        active, ray, through, found, length, density, delta, mirrors, sampler = state
        hit = scene.ray_intersect(ray, active=active)
        escaped = active & ~hit.is_valid()
        left = mi.Bool(False)
        if caustic is not None:
            left = (mirrors & ~(caustic.seen & (length == 1))) | (caustic.active & (length == 1))
        apart = (length <= 1) | mirrors
        for groups, here in ((worlds.lights, escaped & apart), ((worlds.whole,), escaped & ~apart)):
            found += dr.select(here, through * distant(worlds, groups, ray.d, here, density, delta, left), 0.0)
        given = active & hit.is_valid()
        for lamp in lamps:
            alone = delta if lamp in aimed else mi.Bool(True)
            found += dr.select(given, through * _seen(worlds, scene, lamp, hit, ray, given, density, alone), 0.0)
        onward = given & (length + 1 < depth)
        bsdf = hit.bsdf()
        smooth = onward & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        for group in lights:
            found = _aimed_far(mi, scene, group, hit, ray, smooth, through, found, caustic, sampler)
        for lamp in aimed:
            found = _aimed_near(mi, scene, lamp, hit, smooth, through, found, sampler)
        drawn, weight = bsdf.sample(mi.BSDFContext(), hit, sampler.next_1d(onward), sampler.next_2d(onward), onward)
        through = dr.select(onward, through * weight, 0.0)
        delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
        kept = mirrors & delta
        if caustic is not None:
            kept |= caustic.seen & (length == 0) & ~delta
        mirrors = kept & ~worlds.is_local(hit)
        onward &= dr.any(through != 0)
        following = hit.spawn_ray(hit.to_world(drawn.wo))
        return onward, following, through, found, length + 1, drawn.pdf, delta, mirrors, sampler

    state = (
        mi.Bool(active),
        mi.Ray3f(ray),
        dr.full(mi.Color3f, 1.0, width),
        dr.zeros(mi.Color3f, width),
        dr.zeros(mi.UInt32, width),
        dr.zeros(mi.Float, width),
        dr.full(mi.Bool, True, width),
        mi.Bool(caustic.active) if caustic is not None else dr.full(mi.Bool, False, width),
        sampler,
    )
    state = vertex(worlds.lights, *state)
    return dr.while_loop(state, lambda *s: s[0], functools.partial(vertex, (worlds.whole,)), label="path")[3]


def _aimed_far(
    mi: Any, scene: Any, group: LightGroup, hit: Any, ray: Any, active: Any, through: Any, found: Any,
    caustic: Caustic | None, sampler: Any,
) -> Any:  # fmt: skip
    """``found`` and what a sample of a light group's directions adds at a vertex."""
    import drjit as dr

    light, radiance = group.scene.sample_emitter_direction(hit, sampler.next_2d(active), False, active)
    lit = active & (light.pdf > 0)
    lit &= ~scene.ray_test(hit.spawn_ray(light.d), lit)
    value, pdf = hit.bsdf().eval_pdf(mi.BSDFContext(), hit, hit.to_local(light.d), lit)
    weight = light.pdf / (light.pdf + pdf)
    if caustic is not None and group.compact:
        shared = lit & caustic.active
        weight = dr.select(shared, 1 / (1 + caustic.against(hit, ray, light.d)), weight)
    return found + dr.select(lit, through * value * radiance * weight, 0.0)


def _aimed_near(mi: Any, scene: Any, lamp: Any, hit: Any, active: Any, through: Any, found: Any, sampler: Any) -> Any:
    """``found`` and what a sample of an object that gives light adds at a vertex."""
    import drjit as dr

    light, radiance = lamp.sample_direction(hit, sampler.next_2d(active), active)
    lit = active & (light.pdf > 0)
    lit &= ~scene.ray_test(hit.spawn_ray_to(light.p), lit)
    value, pdf = hit.bsdf().eval_pdf(mi.BSDFContext(), hit, hit.to_local(light.d), lit)
    return found + dr.select(lit, through * value * radiance * (light.pdf / (light.pdf + pdf)), 0.0)


def distant(
    worlds: Worlds, groups: Sequence[LightGroup], direction: Any, active: Any, density: Any, delta: Any, left: Any
) -> Any:
    """Light of the groups that a direction, drawn with ``density``, finds; ``left``: not that of the emitters."""
    import drjit as dr

    mi = worlds.mi
    total = mi.Color3f(0.0)
    for group in groups:
        emitter = group.scene.environment()
        away = dr.zeros(mi.SurfaceInteraction3f)
        away.wi = -direction
        record = dr.zeros(mi.DirectionSample3f)
        record.d = direction
        pdf = dr.select(delta, 0.0, emitter.pdf_direction(away, record, active))
        weight = dr.select(delta, 1.0, density / (density + pdf))
        if group.compact:
            weight = dr.select(left, 0.0, weight)
        total += emitter.eval(away, active) * weight
    return total


def _seen(worlds: Worlds, scene: Any, lamp: Any, hit: Any, ray: Any, active: Any, density: Any, alone: Any) -> Any:
    """Light that a ray, drawn with ``density``, meets on a light-giving object; ``alone``: nothing else finds it."""
    import drjit as dr

    mi = worlds.mi
    met = active & (hit.emitter(scene, active) == mi.EmitterPtr(lamp))
    start = dr.zeros(mi.Interaction3f)
    start.p = ray.o
    pdf = dr.select(alone, 0.0, lamp.pdf_direction(start, mi.DirectionSample3f(scene, hit, start), met))
    return dr.select(met, lamp.eval(hit, met) * dr.select(alone, 1.0, density / (density + pdf)), 0.0)
