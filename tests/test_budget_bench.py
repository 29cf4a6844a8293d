"""The judge of coverage, and the rooms that it draws."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import budget, rooms
from pipeline.simulation.light import unit_direction
from pipeline.simulation.scene_file import load_scene


def records(count: int, regions: int, spread: float, bias: float, seed: int) -> budget.Records:
    """Captures of one place whose errors are normal, ``spread`` sigma wide about ``bias`` sigma."""
    random = np.random.default_rng(seed)

    def part(places: int) -> dict[str, list[list[float]]]:
        error = bias + spread * random.standard_normal((places, 3))
        return {"error": error.tolist(), "sigma": np.ones((places, 3)).tolist(), "level": np.ones((places, 3)).tolist()}

    def capture() -> dict[str, object]:
        named = {f"object_{n}": part(1) for n in range(regions)} | {f"shadow_{n}": part(1) for n in range(regions)}
        means = {name: {key: values[0] for key, values in p.items()} for name, p in named.items()}
        return {"pixels": {"object": part(4), "shadow": part(6)}, "means": means, "near_field": 0.0}

    return [capture() for _ in range(count)]


def test_errors_as_stated_are_held():
    """Places of different numbers of regions pool; 4000 z and more: a share's standard error is under 0.8 %."""
    found = budget.grouped([records(100, 4, 1.0, 0.0, 1), records(100, 3, 1.0, 0.0, 2)])
    assert list(found)[:2] == list(budget.CLASSES)
    for name in budget.CLASSES:
        assert all(found[name]["truth"]["holds"].values()), found[name]
        assert found[name]["truth"]["n"] == sum(found[kind]["truth"]["n"] for kind in budget.CLASSES[name])
    assert found["pixels"]["truth"]["n"] == 2 * 100 * 10 * 3
    assert found["region means"]["truth"]["n"] == 100 * 14 * 3


def test_a_bias_is_seen_against_truth_alone():
    found = budget.grouped([records(100, 4, 1.0, 2.0, 3)])
    assert not any(found["pixels"]["truth"]["holds"].values())
    assert all(found["pixels"]["scatter"]["holds"].values())


def test_what_is_bounded_counts_the_bound_in():
    group = records(50, 3, 0.1, 3.0, 4)  # three sigma off, and everything has the level 1
    assert max(budget.bounded([group]).values()) < 0.01
    for record in group:
        record["near_field"] = 2.0
    assert min(budget.bounded([group]).values()) > 0.99


@pytest.mark.parametrize("number", range(budget.PLACES["rooms"]))
def test_rooms_keep_lamps_apart_and_in_sight(number):
    """A room is the same each time; its lamps stand apart, and above whoever stands behind a camera."""
    room = rooms.drawn(number)
    assert room == rooms.drawn(number)
    assert room.ball.diameter_m > rooms.drawn(number, "small_balls").ball.diameter_m
    assert room.light == rooms.drawn(number, "small_balls").light
    assert room.name != rooms.drawn(number + 1).name
    assert room.light != rooms.drawn(number + 1).light
    assert (room.camera.width, room.camera.height) == (512, 384)
    assert 1 <= len(room.light.lamp) <= 3
    towards = [unit_direction(lamp.azimuth_deg, lamp.elevation_deg) for lamp in room.light.lamp]
    for i, first in enumerate(towards):
        assert all(first @ other <= np.cos(np.radians(rooms.APART_DEG)) + 1e-9 for other in towards[:i])
    window, cameras = room.light.softbox[0].azimuth_deg, rooms.cameras(load_scene(rooms.DESK))
    assert all(rooms.apart(window, camera) >= rooms.WINDOW_CLEAR_DEG for camera in cameras)
    camera = np.array(room.plate.position_m)
    x, z = room.ball.position_m
    behind = np.degrees(np.arctan2(camera[0] - x, z - camera[2]))
    for lamp in room.light.lamp:
        near = abs((lamp.azimuth_deg - behind + 180) % 360 - 180) < rooms.CLEAR_DEG[0] - 5  # the ball was nudged
        assert not near or lamp.elevation_deg >= rooms.CLEAR_DEG[1]
