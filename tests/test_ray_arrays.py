"""Rays from arrays: what stands between an eye and points, against line and solid, and in batches."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.run.errors import ToolError
from pipeline.transport import ray_arrays
from pipeline.transport.proxies import box
from pipeline.transport.ray_arrays import batches, hidden_by
from pipeline.types import Proxy

EYE = np.array([0.1, 0.5, 0.6])


def points_on_plane() -> np.ndarray:
    """(N, 3) of a square metre, as pixels would ask for them."""
    x, z = np.random.default_rng(3).uniform(-0.5, 0.5, (2, 40_000))
    return np.stack([x, 0 * x, z], -1)


def ball(centre: np.ndarray, radius: float, rows: int) -> Proxy:
    """A ball as (2 rows - 2) 2 rows triangles whose corners lie on it."""
    theta = np.pi * np.arange(1, rows) / rows
    phi = 2 * np.pi * np.arange(2 * rows) / (2 * rows)
    rim = np.stack(
        [np.sin(theta)[:, None] * np.cos(phi), np.cos(theta)[:, None] + 0 * phi, np.sin(theta)[:, None] * np.sin(phi)],
        -1,
    )
    vertices = np.concatenate([[[0, 1, 0]], rim.reshape(-1, 3), [[0, -1, 0]]])
    at = 1 + np.arange(2 * rows * (rows - 1)).reshape(rows - 1, -1)
    after = np.roll(at, -1, 1)
    last = len(vertices) - 1
    caps = (0 * at[0], after[0], at[0]), (at[-1], after[-1], 0 * at[0] + last)
    quads = (at[:-1], after[:-1], at[1:]), (after[:-1], after[1:], at[1:])
    faces = [np.stack(corners, -1).reshape(-1, 3) for corners in (*caps, *quads)]
    return Proxy(name="ball", vertices_m=centre + radius * vertices, faces=np.concatenate(faces), albedo=np.ones(3))


def test_a_fine_mesh_hides_what_lies_behind_it() -> None:
    """A ball of 10^5 faces over the plane: all lines that pass nearer than its flattest face, none that pass it by.

    An edge between corners on the ball lies at least cos(pi / rows) radii from its middle, a face cos^2 of that.
    """
    rows, centre, radius = 160, np.array([0.05, 0.2, 0.1]), 0.1
    proxy = ball(centre, radius, rows)
    assert len(proxy.faces) > 1e5
    points = points_on_plane()
    way = (points - EYE) / np.linalg.norm(points - EYE, axis=-1, keepdims=True)
    nearest = np.linalg.norm(np.cross(centre - EYE, way), axis=-1)
    found = hidden_by([proxy], EYE, points)
    rounding = 1e-6  # m: float32 on coordinates below 1 m, several operations
    assert found[nearest < radius * np.cos(np.pi / rows) ** 2 - rounding].all()
    assert not found[nearest > radius + rounding].any()
    assert 0.02 < found.mean() < 0.5


def test_a_box_that_stands_on_the_plane() -> None:
    """By the slabs that a line crosses; points below it are hidden, those it stands on the edge of are left out."""
    size, centre = np.array([0.2, 0.15, 0.1]), np.array([-0.1, 0.075, 0.0])
    vertices, faces = box(centre, size)
    points = points_on_plane()
    low, high = ((centre + sign * 0.5 * size - EYE) / (points - EYE) for sign in (-1, 1))
    enter, leave = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
    truth = (enter < leave) & (enter > 0) & (enter < 1)
    clearly = np.abs(np.minimum(leave - enter, 1 - enter)) > 1e-5  # of the way: not on an edge, nor at the foot
    found = hidden_by([Proxy(name="box", vertices_m=vertices, faces=faces)], EYE, points)
    np.testing.assert_array_equal(found[clearly], truth[clearly])
    assert clearly.mean() > 0.99
    assert truth.any()


def test_several_proxies_hide_together_and_none_hides_nothing() -> None:
    one, two = ball(np.array([0.05, 0.2, 0.1]), 0.1, 20), ball(np.array([-0.2, 0.1, 0.0]), 0.05, 20)
    points = points_on_plane()
    both = hidden_by([one, two], EYE, points)
    np.testing.assert_array_equal(both, hidden_by([one], EYE, points) | hidden_by([two], EYE, points))
    assert not hidden_by([], EYE, points).any()
    assert hidden_by([one], EYE, points[:0]).shape == (0,)


def test_batches_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    points, proxy = points_on_plane()[:1001], ball(np.array([0.05, 0.2, 0.1]), 0.1, 20)
    whole = hidden_by([proxy], EYE, points)
    monkeypatch.setattr(ray_arrays, "RAYS", 100)
    np.testing.assert_array_equal(hidden_by([proxy], EYE, points), whole)
    assert [part.stop - part.start for part in batches(25, 10)] == [10, 10, 5]
    assert len(batches(3, 1000)) == 3
    assert batches(0) == []


def test_without_arrays_of_rays_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Scalar:
        @staticmethod
        def variant() -> str:
            return "scalar_rgb"

    monkeypatch.setattr(ray_arrays, "use_mitsuba", Scalar)
    with pytest.raises(ToolError, match=r"^composite: proxies .* need LLVM or CUDA, found only scalar_rgb; run insitu"):
        hidden_by([ball(np.zeros(3), 0.1, 4)], EYE, points_on_plane())
