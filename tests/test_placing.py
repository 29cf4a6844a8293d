"""Where wished objects stand: how far their lowest point is from the plane, and what is said of it."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.transport.placing import clearances, off_plane
from pipeline.types import Plane

CORNERS = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]])
CUBE = "v 0 0 0\nv 0.1 0 0\nv 0 0.2 0\nv 0 0 0.1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


def level(offset_m: float = 0.0) -> Plane:
    up = np.array([0.0, 1.0, 0.0])
    corners = CORNERS + offset_m * up
    return Plane(normal=up, offset_m=offset_m, covariance=np.zeros((3, 3)), corners_m=corners, source="board")


@pytest.mark.parametrize(
    ("low", "lift", "warned", "explained"),
    [
        (0.0, 0.0, "", False),
        (0.0, 0.05, "", True),
        (0.0015, 0.0, "", False),  # within 1 % of the height of 0.2 m
        (0.05, 0.0, "lowest point is 50 mm above the plane: it floats; lift_m = -0.05 puts it on", False),
        (-0.05, 0.0, "lowest point is 50 mm below the plane; lift_m = 0.05 puts it on", False),
        (0.0, -0.05, "lowest point is 50 mm below the plane; lift_m = 0 puts it on", False),
        (-0.05, 0.05, "", False),
    ],
)
def test_what_is_said_of_an_object_off_the_plane(low, lift, warned, explained, tmp_path):
    """Coordinates are stored as text; float32 rounds them to 1e-8 m."""
    shifted = [line.split() for line in CUBE.splitlines()]
    text = "".join(f"v {x} {float(y) + low} {z}\n" if kind == "v" else f"f {x} {y} {z}\n" for kind, x, y, z in shifted)
    (tmp_path / "a.obj").write_text(text)
    wish = {"name": "a", "path": str(tmp_path / "a.obj"), "position_m": [0.3, 0.1], "yaw_deg": 20.0, "scale": 1.0}
    wishes = {"object": [wish | {"lift_m": lift}]}
    found = clearances(wishes, level(0.01))
    assert found["a"] == pytest.approx((low + lift, 0.2), abs=1e-7)
    warnings, evidence = off_plane(wishes, found)
    assert bool(warnings) == bool(warned)
    assert all(warned in line for line in warnings)
    assert bool(evidence) == explained
