"""The three spheres: constant light, where a lamp shows, and that light is neither made nor lost."""

from __future__ import annotations

import numpy as np
import pytest
from mirror_scene import look_at

from pipeline.conventions import latlong_directions
from pipeline.light.harmonics import sh9_of_environment
from pipeline.light.spheres import GREY, disc, mirrored, pictures, widened

POSE = look_at((0.0, 0.3, 0.5), (0.0, 0.0, 0.0))


def shown(environment: np.ndarray) -> dict[str, np.ndarray]:
    return pictures(environment, sh9_of_environment(environment), POSE, 64)


def test_constant_light_makes_even_spheres():
    values = shown(np.full((64, 128, 3), 2.0))
    for name, level in (("mirror", 2.0), ("matte silver", 2.0), ("grey 18 %", 2.0 * GREY)):
        inside = values[name][..., 0] > 0
        # Texel centres stand for their texels in the harmonics: 1e-3 at 64 rows.
        assert values[name][inside] == pytest.approx(level, rel=2e-3)
        assert inside.mean() == pytest.approx(np.pi / 4, abs=0.01)


def test_mirror_shows_the_lamp_where_the_normal_halves_the_way():
    normals, to_camera = disc(65, POSE)
    assert normals[32, 32] == pytest.approx(to_camera, abs=1e-6)
    lamp = mirrored(normals[20, 40], to_camera)
    environment = np.exp(300 * (latlong_directions(256, 512) @ lamp - 1))[..., None] * np.ones(3)
    bright = pictures(environment, sh9_of_environment(environment), POSE, 65)["mirror"][..., 1]
    assert np.abs(np.array(np.unravel_index(bright.argmax(), bright.shape)) - (20, 40)).max() <= 1


def test_light_from_above_brightens_the_top():
    environment = np.maximum(latlong_directions(64, 128)[..., 1:2], 0) * np.ones(3) + 0.1
    for value in shown(environment).values():
        assert value[:20].sum() > 2 * value[-20:].sum() > 0


def test_lobe_keeps_the_mean_of_smooth_light():
    environment = (1 + latlong_directions(64, 128)[..., :1]) * np.ones(3)
    # A cos^n lobe keeps the first band times (n + 1) / (n + 2).
    ways = latlong_directions(32, 64)
    assert widened(environment)[..., 0] == pytest.approx(1 + 31 / 32 * ways[..., 0], abs=5e-3)
