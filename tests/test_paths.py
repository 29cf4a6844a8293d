"""The path tracer that samples every light on its own against Mitsuba's `path`: same mean, same depth."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from agreement import tile_means
from test_transport import SIZE, all_rays, ground, sky, sphere

from pipeline.transport.meshes import Material
from pipeline.transport.paths import trace_paths
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import object_shape
from pipeline.transport.trace import NEVER, camera_rays
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Emitter

SAMPLES = 64
OBJECTS = {
    "metal": ((0.1, (0, 0.1, 0)), Material((0.9, 0.8, 0.5), 1.0, 0.4)),
    "glass": ((0.06, (0.19, 0.06, 0.05)), Material((1.0, 0.9, 0.8), transmission=1.0)),
    "frosted": ((0.05, (0.1, 0.05, 0.2)), Material(transmission=1.0, roughness=0.4)),
    "glow": ((0.05, (-0.17, 0.05, 0.08)), Material((0.3, 0.3, 0.3), 0.0, 0.6, emission=(6.0, 4.0, 2.0))),
}


def lamp_of(environment: np.ndarray) -> Emitter:
    """The lamp of `sky`."""
    lamp = np.flatnonzero(environment[..., 0].ravel() > 5)
    return Emitter(
        name="lamp_1",
        direction=[0.4, 0.8, 0.447],
        solid_angle_sr=0.13,
        half_angle_rad=0.2,
        irradiance=np.ones(3),
        texels=lamp,
    )


@functools.cache
def worlds() -> Worlds:
    """Every kind of material under a lamp and a sky that are sampled apart."""
    mi, light = use_mitsuba(), sky()
    shapes = {
        name: object_shape(mi, name, sphere(*place, material), np.eye(4), material, "acescg", 0.5)[0]
        for name, (place, material) in OBJECTS.items()
    }
    return build_worlds(ground(), np.array([0.5, 0.3, 0.2]), light, shapes, emitters=[lamp_of(light)])


def radiance(depth: int, seed: int, own: bool) -> np.ndarray:
    """(pixels, samples, 3) by our path tracer or by Mitsuba's."""
    mi, count = use_mitsuba(), len(all_rays()) * SAMPLES
    import drjit as dr

    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    ray = camera_rays(mi, dr, all_rays(), SAMPLES, sampler.next_2d(), 1.0)
    if own:
        found = trace_paths(
            worlds(), worlds().with_objects, sampler, ray, dr.arange(mi.UInt32, count) % SAMPLES > 0, depth
        )
    else:
        path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": NEVER})
        found = path.sample(worlds().with_objects, sampler, ray)[0]
    return np.asarray(found).T.reshape(-1, SAMPLES, 3).astype(float)


@pytest.mark.parametrize("depth", [2, 3, 12])
def test_same_mean_as_mitsuba(depth: int) -> None:
    """Tile means of direct light, of one bounce more, and of all; independent samples, so their z are known.

    z of 144 tile channels exceeds 5 once in 12 000 times; the mean of their squares is 1 and scatters by
    sqrt(2 / 48) = 0.2, the channels being alike: 3.5 of those. z of the whole: 4, once in 5000.
    """
    means, variances = [], []
    for seed, own in ((3, True), (4, False)):
        found = radiance(depth, seed, own)[:, 1:]
        means.append(tile_means(found.mean(1), SIZE))
        variances.append(tile_means(found.var(1, ddof=1) / found.shape[1], SIZE) / 64)
    (a, b), variance = means, sum(variances)
    z = (a - b) / np.sqrt(variance)
    assert np.abs(z).max() < 5
    assert (z**2).mean() < 1.7
    assert np.all(np.abs((a - b).sum(0)) < 4 * np.sqrt(variance.sum(0)))


def test_depth_one_sees_lights_only() -> None:
    """Nothing but what gives light, and of the same rays exactly the same."""
    own, mitsuba = radiance(1, 3, True)[:, 1:], radiance(1, 3, False)[:, 1:]
    assert np.array_equal(own, mitsuba)
    assert 0 < (own > 0).mean() < 0.1


def test_lanes_that_are_not_active_stay_zero() -> None:
    assert not radiance(12, 3, True)[:, 0].any()
