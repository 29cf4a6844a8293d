"""The page of conventions: six named directions, round trips, solid angles, and the frames of boards and markers."""

import numpy as np
import pytest

from pipeline.conventions import (
    WORLD_FROM_BOARD,
    WORLD_FROM_MARKER,
    direction_from_latlong,
    invert_rigid,
    latlong_directions,
    latlong_from_direction,
    latlong_solid_angles,
    transform_points,
)

# Where OpenEXR's lat-long (and Mitsuba's) has the axes: the centre of the picture looks along +Z.
NAMED = {
    "+x": ((1, 0, 0), (0.25, 0.5)),
    "-x": ((-1, 0, 0), (0.75, 0.5)),
    "+z": ((0, 0, 1), (0.5, 0.5)),
    "-z": ((0, 0, -1), (0.0, 0.5)),
    "+y": ((0, 1, 0), (None, 0.0)),  # a pole has no u
    "-y": ((0, -1, 0), (None, 1.0)),
}


@pytest.mark.parametrize("name", NAMED)
def test_six_named_directions(name: str) -> None:
    direction, (u, v) = NAMED[name]
    found_u, found_v = latlong_from_direction(np.array(direction, float))
    assert found_v == pytest.approx(v, abs=1e-12)
    if u is not None:
        assert found_u == pytest.approx(u, abs=1e-12)
    np.testing.assert_allclose(direction_from_latlong(u or 0.0, v), direction, atol=1e-12)


def test_round_trip_everywhere() -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(1000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    np.testing.assert_allclose(direction_from_latlong(*latlong_from_direction(direction)), direction, atol=1e-12)


def test_texels_cover_the_sphere_once() -> None:
    assert latlong_solid_angles(7, 12).sum() == pytest.approx(4 * np.pi)
    assert np.linalg.norm(latlong_directions(5, 9), axis=-1) == pytest.approx(np.ones((5, 9)))


@pytest.mark.parametrize("matrix", [WORLD_FROM_BOARD, WORLD_FROM_MARKER])
def test_prints_lie_face_up_without_mirroring(matrix: np.ndarray) -> None:
    """Rigid, and the print's outward normal is +Y: -z of a board's frame, +z of a single marker's."""
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    outward = [0, 0, -1] if matrix is WORLD_FROM_BOARD else [0, 0, 1]
    np.testing.assert_allclose(matrix[:3, :3] @ outward, [0, 1, 0])
    down_the_print = [0, 1, 0] if matrix is WORLD_FROM_BOARD else [0, -1, 0]
    np.testing.assert_allclose(matrix[:3, :3] @ down_the_print, [0, 0, 1])


def test_rigid_inverse() -> None:
    angle = 0.3
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [1, 2, 3]
    points = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(transform_points(invert_rigid(pose), transform_points(pose, points)), points, atol=1e-12)
