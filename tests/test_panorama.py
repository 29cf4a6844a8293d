"""A panorama as the probe: its rotation by features, tones, clicks; spots on the plane; the nadir."""

from __future__ import annotations

import numpy as np
import pytest
from lit_room import CAMERA, EYE, GRID, POSE, ROOM, WALLPAPER, mapped, room_plate, shots, stage_on

from pipeline.camera.lens import project
from pipeline.camera.rigid import rotation_exp, rotation_log
from pipeline.conventions import (
    latlong_directions,
    latlong_from_direction,
)
from pipeline.light.environment import AXES, resize_environment
from pipeline.probes import orientation
from pipeline.probes.kinds import KINDS
from pipeline.probes.ready_made import rotation_of
from pipeline.run.errors import CaptureError

# ---- a panorama ------------------------------------------------------------------------------------------------------


def panorama(rotation: np.ndarray, height: int = 256, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    """The room from EYE as a camera turned by ``rotation`` (world_from_map) stitches it, in another unit, noisy."""
    w = latlong_directions(2 * height, 4 * height).reshape(-1, 3) @ rotation.T
    rgb = ROOM.radiance(np.broadcast_to(EYE, w.shape), w).reshape(2 * height, 4 * height, 3)
    rgb = resize_environment(rgb, height, 2 * height)
    return 0.4 * rgb * (1 + noise * np.random.default_rng(seed).normal(size=rgb.shape))


def test_panorama_is_turned_by_what_the_plate_shows(tmp_path):
    rng = np.random.default_rng(3)
    rotation = rotation_of(rng.uniform(-180, 180), np.array([0.05 * rng.normal(), 1.0, 0.03]))
    found = mapped(tmp_path, panorama(rotation), kind="panorama", position_m=EYE.tolist())
    numbers = KINDS["panorama"].observe(shots(found, room_plate()), GRID).numbers
    error = rotation_log(np.array(numbers["orientation"]["world_from_map"]) @ rotation.T)
    # three standard deviations of what it says; eight other turns and noises had 0.03 to 1.1 as chi2 of three
    assert np.degrees(np.linalg.norm(error)) < 3 * np.sqrt(3) * numbers["orientation"]["sigma_deg"]
    assert numbers["orientation"]["sigma_deg"] < 0.15
    assert numbers["scale"]["route"] == "plate"
    assert numbers["scale"]["factor"][1] == pytest.approx(2.5, rel=3 * numbers["scale"]["sigma_rel_shared"])


def test_panorama_without_anything_in_common_asks_for_a_click(tmp_path):
    strange = np.random.default_rng(0).gamma(1, 1, (64, 128, 3))
    with pytest.raises(CaptureError, match=r"click one lamp or corner in both|needed 8"):
        KINDS["panorama"].observe(shots(mapped(tmp_path, strange, kind="panorama"), room_plate()), GRID)


def test_tones_turn_a_panorama_that_is_too_blurred_for_features(tmp_path):
    for yaw in (-70.0, 151.0):
        blurred = resize_environment(panorama(rotation_of(yaw, AXES[2])), 32, 64)
        found = mapped(tmp_path, blurred, kind="panorama", position_m=EYE.tolist())
        told = KINDS["panorama"].observe(shots(found, room_plate()), GRID).numbers["orientation"]
        assert told["route"] == "tones"
        error = rotation_log(np.array(told["world_from_map"]) @ rotation_of(yaw, AXES[2]).T)
        assert np.degrees(np.linalg.norm(error)) < 3 * told["sigma_deg"]  # half a texel of 2.8 degrees, and up


def test_a_clicked_lamp_and_up_turn_the_panorama(tmp_path):
    rotation = rotation_of(-140.0, np.array([0.0, 1.0, 0.0]))
    lamp = np.array([0.5, 0.6, -0.4]) / np.linalg.norm([0.5, 0.6, -0.4])
    u, v = latlong_from_direction(rotation.T @ lamp)
    px = [float(u * 128), float(v * 64)]
    on_plate = project(CAMERA, (POSE[:3, :3].T @ np.array([0.05, 0.1, -1.0]))[None])[0]
    u, v = latlong_from_direction(rotation.T @ np.array([0.05, 0.1, -1.0]))
    for point in ({"px": px, "direction": (3 * lamp).tolist()}, {"px": px, "world_m": (EYE + 2 * lamp).tolist()},
                  {"px": [float(u * 128), float(v * 64)], "plate_px": on_plate.tolist()}):  # fmt: skip
        found = mapped(tmp_path, np.ones((64, 128, 3)), kind="panorama", position_m=EYE.tolist(), point=[point])
        told = KINDS["panorama"].observe(shots(found), GRID).numbers["orientation"]
        assert np.array(told["world_from_map"]) == pytest.approx(rotation, abs=1e-6)
        assert told["sigma_deg"] > 3  # three pixels of 2.8 degrees


def test_clicks_that_contradict_each_other_raise_the_uncertainty():
    up, sigma = np.array([0.0, 1, 0]), np.full(2, 0.01)
    one = AXES[[0, 4]]
    good = orientation.from_points(one, one, sigma, up, 0.01)
    off = orientation.from_points(one, one @ rotation_exp(np.array([0, 0.3, 0])) * [[1], [0]] + one * [[0], [1]],
                                  sigma, up, 0.01)  # fmt: skip
    assert off.sigma_rad > 5 * good.sigma_rad


def test_spots_on_the_plane_turn_a_picture_that_was_taken_elsewhere():
    """Directions of the same spots of the plane from two places: only their second reading agrees."""
    rng = np.random.default_rng(0)
    spots = np.stack([rng.uniform(-0.5, 0.5, 60), np.zeros(60), rng.uniform(-0.5, 0.5, 60)], -1)
    eye, centre, rotation = POSE[:3, 3], EYE, rotation_of(50.0, np.array([0.1, 1.0, 0.0]))

    def directions(origin: np.ndarray) -> np.ndarray:
        return (spots - origin) / np.linalg.norm(spots - origin, axis=1, keepdims=True)

    local = directions(centre) @ rotation
    local[40:] = rng.permutation(local[40:])  # a third is wrong
    found = orientation.robust(local, directions(eye), directions(centre), np.arange(60))
    assert np.linalg.norm(rotation_log(found.rotation @ rotation.T)) < 1e-9
    assert found.numbers["on_plane"] >= 40
    wrong = orientation.robust(local, directions(eye), np.full((60, 3), np.nan), np.arange(60))
    assert wrong is None or wrong.numbers["agree"] < 40


def test_wahba_is_as_sure_as_it_says():
    # 300 trials: the mean of chi2 over three degrees of freedom has a standard error of 0.14
    rng, sigma = np.random.default_rng(1), 0.01
    world = rng.normal(size=(20, 3)) * [1, 0.3, 1]
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    information = np.linalg.inv(orientation.rotation_covariance(world, np.full(20, sigma)))
    chi2 = []
    for _ in range(300):
        seen = world + sigma * rng.normal(size=world.shape)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        error = rotation_log(orientation.wahba(seen, world, np.ones(20)))
        chi2.append(error @ information @ error)
    assert np.mean(chi2) == pytest.approx(3, abs=0.5)


def test_nadir_is_not_believed_and_the_plane_is_laid_there(tmp_path):
    tripod = panorama(np.eye(3), noise=0)
    tripod[latlong_directions(*tripod.shape[:2])[..., 1] < -np.cos(np.radians(14))] = 1e3
    told = {"position_m": EYE.tolist(), "yaw_deg": 0.0}
    found = mapped(tmp_path, tripod, kind="panorama", **told)
    view = KINDS["panorama"].observe(shots(found, room_plate()), GRID).maps["panorama"]
    assert (view.coverage[-2:] == 0).all()
    assert view.coverage[:28].min() == 1
    light, _ = stage_on(found, room_plate())
    assert light.max() < 2 * WALLPAPER.max()
    believed = found | {"probe": found["probe"] | {"nadir_deg": 0.0}}
    assert KINDS["panorama"].observe(shots(believed, room_plate()), GRID).maps["panorama"].rgb.max() > 100
