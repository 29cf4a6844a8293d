"""Detail of two pictures whose contrast differs by place: ramps are taken off, gains are found."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.probes.contrast import MOST_GAIN, local_gain, means, ramps

Y, X = np.mgrid[:40, :60].astype(float)
USED = ((X - 30) ** 2 / 25**2 + (Y - 20) ** 2 / 15**2 < 1).astype(float)


def test_ramps_are_taken_off_up_to_the_border():
    ramp = 0.3 + 0.02 * X - 0.05 * Y
    inside = USED > 0
    # By FLAT, 2 % of a window's second moment is held to no slope: so much of a mean's error is left, more at borders.
    left = np.abs(ramps(USED, 3.5)(ramp) - ramp)[inside].max()
    assert left < 0.1 * np.abs(means(USED, 3.5)(ramp) - ramp)[inside].max()


def test_both_keep_a_constant():
    for broad in (means(USED, 3.5), ramps(USED, 3.5)):
        np.testing.assert_allclose(broad(np.full(USED.shape, 2.5))[USED > 0], 2.5, rtol=1e-12)


@pytest.mark.parametrize("gain", [0.4, 1.0, 2.0])
def test_gain_is_found_by_place(gain):
    detail = np.random.default_rng(0).normal(size=USED.shape) * USED
    real = np.where(X < 30, gain, 1.0) * detail
    found = local_gain(real, detail, 3.5)
    # A window's tail beyond three sigma is cut off, so that places farther from the border know nothing of the other.
    np.testing.assert_allclose(found[(X < 19) & (USED > 0)], gain, rtol=1e-3)
    np.testing.assert_allclose(found[(X > 41) & (USED > 0)], 1.0, rtol=1e-3)


def test_no_detail_tells_no_gain_and_none_is_wild():
    faint = 1e-4 * np.random.default_rng(1).normal(size=USED.shape)
    np.testing.assert_allclose(local_gain(2 * faint, faint, 3.5), 1.0, atol=1e-3)
    found = local_gain(1e3 * np.sin(X), np.sin(X), 3.5)
    assert found.max() == MOST_GAIN
    assert local_gain(-np.sin(X), np.sin(X), 3.5).min() == 0  # turned around: it says nothing, and is not believed
