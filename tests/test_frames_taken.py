"""Which frames of a bracket are merged when fewer than all are asked for."""

from __future__ import annotations

import pytest

from pipeline.types import Bracket, Frame
from stages.merge import taken


def bracket(frames: int) -> Bracket:
    """Exposures of 1, 2, 4, ... s; nothing else of a frame matters."""
    return Bracket.model_construct(
        name="plate", role="plate", frames=[Frame.model_construct(exposure_s=2.0**n) for n in range(frames)]
    )


@pytest.mark.parametrize(
    ("which", "frames", "kept"),
    [
        ("all", 5, [1, 2, 4, 8, 16]),
        ("second", 5, [1, 4, 16]),
        ("second", 4, [1, 4]),
        ("extremes", 5, [1, 16]),
        ("extremes", 2, [1, 2]),
        ("extremes", 1, [1]),
        ("second", 1, [1]),
    ],
)
def test_the_shortest_frame_always_stays(which, frames, kept):
    assert [frame.exposure_s for frame in taken(bracket(frames), which).frames] == kept
