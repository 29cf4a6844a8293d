"""Alignment of frames: shifts measured within their uncertainty, nothing touched without need, refusals in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.image import alignment, radiometry
from pipeline.image.noise import Noise
from pipeline.image.radiometry import Exposed
from pipeline.run.errors import CaptureError

WHITE, BLACK, SHOT = 15800.0, 512.0, 1 / 30000
NAMES = ["a.dng", "b.dng", "c.dng"]


def scene(dx: float = 0.0, dy: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """(300, 420) radiance of smooth structure whose content lies (dx, dy) px off, turned about the middle."""
    y, x = np.mgrid[:300, :420].astype(float)
    x, y = x - dx, y - dy
    u, v = x - 210, y - 150
    x, y = 210 + u * np.cos(turn) - v * np.sin(turn), 150 + u * np.sin(turn) + v * np.cos(turn)
    waves = np.sin(x / 7 + np.sin(y / 13)) + np.sin(y / 9 + x / 31) + 0.7 * np.sin((x - y) / 5) + np.sin(x * y / 4000)
    return 0.3 + 0.06 * waves


def photograph(radiance: np.ndarray, exposure: float, seed: int) -> Exposed:
    random = np.random.default_rng(seed)
    signal = random.poisson(np.maximum(radiance, 0) * exposure / SHOT) * SHOT + 1e-4 * random.standard_normal(
        radiance.shape
    )
    mosaic = np.clip(np.rint(signal * (WHITE - BLACK) + BLACK), 0, WHITE).astype(np.uint16)
    cell = (2, 2) if radiance.ndim == 2 else (1, 3)
    noise = Noise(np.full(cell, SHOT), np.full(cell, 1.1e-8), "given")
    return Exposed(mosaic, exposure, np.full(cell, BLACK), WHITE, np.full(cell, 0.998), noise)


def bracket(places: list[tuple[float, float]]) -> list[Exposed]:
    return [photograph(scene(*place), g, i) for i, (g, place) in enumerate(zip((0.25, 0.5, 1.0), places, strict=True))]


@pytest.mark.parametrize("place", [(0, 0), (0.3, -0.2), (1.7, 0.9), (-6.4, 3.1), (9.0, -8.0)])
def test_shift_is_measured(place):
    found = alignment.measure(photograph(scene(), 0.5, 1), photograph(scene(*place), 1.0, 2))
    assert found is not None
    # the gradient is a central difference of 2 px cells: 3 % of the fractional part, beside the noise
    assert abs(found.dx - place[0]) < 0.06 + 5 * found.sigma
    assert abs(found.dy - place[1]) < 0.06 + 5 * found.sigma
    assert found.sigma < 0.05


@pytest.mark.parametrize("place", [(0.0, 0.0), (3.2, -1.1)])
def test_shift_of_a_frame_in_the_dark_is_measured_though_a_lamp_moves_in_it_alone(place):
    """Nine electrons in the short frame beside three of read noise, and its exposure said to be 1.4 times what it is.

    A lamp clips in the long frame alone: most of the short one's light, and of what differs. Without care for these a
    camera that stands still is found to have moved by 2.00 +- 0.002 px. Measured: within 0.05 px, +- 0.08.
    """
    lamp = np.hypot(*(np.mgrid[:300, :420] - np.array([90.0, 120.0])[:, None, None])) < 7
    moved = np.hypot(*(np.mgrid[:300, :420] - np.array([90.0 + place[1], 120.0 + place[0]])[:, None, None])) < 7
    short = photograph(scene() + 300 * lamp, 1e-3, 1)
    long = photograph(scene(*place) + 300 * moved, 0.5, 2)
    found = alignment.measure(replace(short, exposure=1.4 * short.exposure), long)
    assert found is not None
    assert np.hypot(found.dx - place[0], found.dy - place[1]) < 4 * found.sigma + 0.06
    assert found.sigma < 0.12


def test_frames_that_stand_still_are_not_touched():
    frames = bracket([(0, 0), (0.1, 0), (0, 0.2)])
    same, _, evidence = alignment.align(frames, NAMES)
    assert all(one is other for one, other in zip(same, frames, strict=True))
    assert evidence["modelled"] is False


def test_mosaic_is_moved_by_whole_cells_exactly():
    frames = bracket([(0, 0), (0, 0), (0, 0)])
    far = frames[2].mosaic.copy()
    far = np.roll(far, (4, -6), (0, 1))
    moved, _, evidence = alignment.align([*frames[:2], replace(frames[2], mosaic=far)], NAMES)
    assert evidence["modelled"] is True
    inner = (slice(10, -10), slice(10, -10))
    np.testing.assert_array_equal(moved[2].mosaic[inner], frames[2].mosaic[inner])
    assert moved[0] is frames[0]
    assert np.all(np.isfinite(radiometry.merge(moved).radiance))


def test_data_without_mosaic_are_moved_by_fractions():
    colours = np.array([1.0, 0.8, 0.6])
    places = [(0, 0), (0, 0), (1.6, -2.3)]
    frames = [
        photograph(scene(*place)[..., None] * colours, g, i)
        for i, (g, place) in enumerate(zip((0.25, 0.5, 1.0), places, strict=True))
    ]
    moved, _, evidence = alignment.align(frames, NAMES)
    assert evidence["modelled"] is True
    left = alignment.measure(moved[1], moved[2])
    assert left is not None
    assert left.length < 0.1


def test_large_motion_and_rotation_are_refused():
    with pytest.raises(CaptureError, match=r"b\.dng, c\.dng: frames are shifted by .* use a tripod"):
        alignment.align(bracket([(0, 0), (0, 0), (19, 12)]), NAMES)
    turned = [photograph(scene(), 0.5, 1), photograph(scene(1.5, 0, turn=0.02), 1.0, 2)]
    with pytest.raises(CaptureError, match="quadrants disagree"):
        alignment.align(turned, NAMES)


def test_without_structure_nothing_is_said_to_be_known():
    frames = [photograph(np.full((200, 200), 0.2), g, i) for i, g in enumerate((0.5, 1.0))]
    same, _, evidence = alignment.align(frames, NAMES[:2])
    assert same[0] is frames[0]
    assert "no structure" in evidence["because"]


def test_a_frame_below_the_stated_black_shows_no_shift():
    """As of a dark frame whose metadata state too high a black; in one quadrant the others still tell."""
    frames = bracket([(0, 0), (3, 2), (0, 0)])[:2]
    under = [replace(one, mosaic=np.full_like(one.mosaic, int(BLACK) - 9)) for one in frames]
    assert alignment.measure(under[0], frames[1]) is None
    assert alignment.measure(*under) is None
    part = frames[0].mosaic.copy()
    part[:150, :210] = int(BLACK) - 9
    found = alignment.measure(replace(frames[0], mosaic=part), frames[1])
    assert (found.dx, found.dy) == pytest.approx((3, 2), abs=0.1)


def test_what_no_shift_was_measured_of_is_told():
    """A dark frame of three lies where its neighbour does, as said; one frame alone has nothing to lie off."""
    frames = bracket([(0, 0), (0, 0), (4, 0)])
    frames[0] = replace(frames[0], mosaic=np.full_like(frames[0].mosaic, int(BLACK)))
    moved, _, evidence = alignment.align(frames, NAMES)
    assert "1 of 2 pairs of frames show too little" in evidence["because"]
    assert moved[0] is frames[0]
    _, shift, evidence = alignment.align(frames[2:], NAMES[2:])
    assert (shift, evidence["because"], evidence["bound_rel"]) == (None, "one frame", 0.0)


def test_what_a_shift_would_cost_is_the_light_that_it_carries_away():
    """Of a lamp of 30 % of the light, moved to another square: 30 %. What stays within its square costs nothing."""
    aligned = np.full((48, 60), 0.7 / (48 * 60))
    aligned[20, 20] += 0.3
    far, near = (np.roll(aligned, step, 1) for step in (5, -2))
    assert alignment.cost(aligned, far, 3.0)["predicted_rel"] == pytest.approx(0.3, abs=1e-12)
    assert alignment.cost(aligned, near, 3.0)["predicted_rel"] == pytest.approx(0.0, abs=1e-12)
    edge = aligned.copy()
    edge[:, :2] = np.nan  # what a moved frame does not show is no light that moved
    assert alignment.cost(edge, aligned, 3.0)["predicted_rel"] == 0


def test_alignment_can_be_forced_and_forbidden():
    frames = bracket([(0, 0), (0, 0), (4, 0)])
    same, shift, evidence = alignment.align(frames, NAMES, "never")
    assert all(one is other for one, other in zip(same, frames, strict=True))
    assert shift == pytest.approx(4, abs=0.1)
    assert evidence["modelled"] is False
    assert "merge.align = never" in evidence["because"]
    colour = [replace(one, mosaic=np.repeat(one.mosaic[:, :, None], 3, 2), black=np.full((1, 3), BLACK),
                      limit=np.full((1, 3), 0.998)) for one in bracket([(0, 0), (0.3, 0), (0, 0)])]  # fmt: skip
    assert alignment.align(colour, NAMES)[2]["modelled"] is False
    assert alignment.align(colour, NAMES, "always")[2]["modelled"] is True  # by fractions: there is no mosaic


@pytest.mark.parametrize(("when", "place"), [("auto", (0.85, 0.85)), ("always", (0.3, -0.2))])
def test_what_whole_cells_cannot_mend_is_not_said_to_be_aligned(when, place):
    """A shift of more than a pixel, but of less along either side: no frame is moved, and the blur is told."""
    frames = bracket([(0, 0), place, (0, 0)])
    same, shift, evidence = alignment.align(frames, NAMES, when)
    assert all(one is other for one, other in zip(same, frames, strict=True))
    assert evidence["modelled"] is False
    assert evidence["bound_px"] == shift == pytest.approx(np.hypot(*place), abs=0.05)
