"""What a map's texels leave open, on maps where it is known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.light import resolution


def test_of_an_even_sky_an_edge_leaves_half_a_row_open():
    """A row at elevation 45 degrees holds most, sin 2e of the light: pi / H of it, by the mean over a row."""
    height = 64
    found = resolution.unresolved(np.ones((height, 2 * height, 3)))
    assert found == pytest.approx(np.pi / height / 2, rel=1e-2)  # of the upper half, sin 2e de integrates to 1


def test_a_lamp_within_one_texel_is_on_either_side():
    lamp = np.zeros((32, 64, 3))
    lamp[8, 20] = 5.0
    assert resolution.unresolved(lamp) == pytest.approx(0.5)
    assert resolution.unresolved(np.zeros((32, 64, 3))) == 0


def test_finer_texels_leave_less_open():
    sky = np.random.default_rng(0).random((32, 64, 3))
    fine = sky.repeat(4, 0).repeat(4, 1)
    assert resolution.unresolved(fine) == pytest.approx(resolution.unresolved(sky) / 4, rel=0.1)
    assert resolution.reason(fine)["bound_rel"] == resolution.unresolved(fine)


def test_bounces_beyond_the_depth_are_what_is_left_of_a_geometric_series():
    from stages import render

    kept = render.WHITE / 2
    for depth in (2, 4, 10):
        assert render.deeper_light(depth) == pytest.approx(sum(kept**n for n in range(depth - 1, 200)))
