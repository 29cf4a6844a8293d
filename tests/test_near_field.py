"""The map brought from the probe to the objects, against a simulated room whose light is known at every place."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light import near_field
from pipeline.light.environment import AXES, irradiance, resize_environment, total_energy
from pipeline.light.near_field import Room
from pipeline.run.substitution import TERMS
from stages.knobs import KNOBS

PROBE, OBJECT = np.array([0.0, 0.04, 0.0]), np.array([0.5, 0.15, -0.35])
CENTRE, SIZE, YAW = np.array([0.2, 0.7, -0.1]), np.array([3.0, 2.8, 2.4]), np.radians(25)
EYE = np.array([0.2, 0.5, 1.0])  # of the camera
ALONG = np.array([0.2, 0.0, 0.0])
ROOM = Room(CENTRE, SIZE, YAW)


def radiance_at(place: np.ndarray, height: int) -> np.ndarray:
    """What a place in the box sees (H, W, 3): walls of six colours, a lamp on the ceiling, the plane y = 0 striped.

    Traced here by planes, one after the other, in the box's own frame; 4 x 4 rays per texel.
    """
    w = latlong_directions(4 * height, 8 * height).reshape(-1, 3)
    cosine, sine = np.cos(-YAW), np.sin(-YAW)
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    start, way = turn @ (place - CENTRE), w @ turn.T
    best, rgb = np.full(len(w), np.inf), np.zeros((len(w), 3))
    for axis in range(3):
        for side in (-1, 1):
            with np.errstate(divide="ignore"):
                t = (side * SIZE[axis] / 2 - start[axis]) / way[:, axis]
            hit = (t > 0) & (t < best)
            point = start + t[hit, None] * way[hit]
            colour = np.broadcast_to(0.3 + 0.1 * np.array([axis, side, 1 - axis * side]), (int(hit.sum()), 3))
            if axis == 1 and side == 1:
                lamp = np.hypot(point[:, 0] - 0.4, point[:, 2]) < 0.25
                colour = np.where(lamp[:, None], (40.0, 35.0, 28.0), colour)
            rgb[hit], best[hit] = colour, t[hit]
    with np.errstate(divide="ignore"):
        t = -place[1] / w[:, 1]
    hit = (t > 0) & (t < best)
    stripes = np.sin(4 * (place[0] + t[hit] * w[hit, 0]))
    rgb[hit] = (0.4 + 0.1 * stripes)[:, None] * (1.0, 0.8, 0.6)
    return resize_environment(rgb.reshape(4 * height, 8 * height, 3), height, 2 * height)


@pytest.fixture(scope="module")
def maps() -> tuple[np.ndarray, np.ndarray]:
    return radiance_at(PROBE, 128), radiance_at(OBJECT, 128)


def axis_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    a, b = irradiance(found, AXES), irradiance(true, AXES)
    return np.linalg.norm(a - b, axis=1) / np.linalg.norm(b, axis=1)


def test_relocation_finds_the_light_at_the_object(maps):
    at_probe, at_object = maps
    moved = near_field.relocate([at_probe], ROOM.depth, PROBE, OBJECT)[0]
    assert axis_errors(at_probe, at_object).max() > 0.2  # measured 0.26
    assert axis_errors(moved, at_object).max() < 0.02  # measured 0.0085: lamps end at old texels
    plain = np.abs(moved - at_object).max(-1) < 0.02
    assert (
        plain * latlong_solid_angles(128, 256)
    ).sum() > 0.85 * 4 * np.pi  # but for seams, and stripes that the probe saw at a grazing angle


def test_no_offset_returns_the_map_itself(maps):
    assert near_field.relocate([maps[0]], ROOM.depth, PROBE, PROBE.copy())[0] is maps[0]


def test_there_and_back_again(maps):
    moved = near_field.relocate([maps[0]], ROOM.depth, PROBE, OBJECT)[0]
    back = near_field.relocate([moved], ROOM.depth, OBJECT, PROBE)[0]
    assert total_energy(back) == pytest.approx(total_energy(maps[0]), rel=0.005)
    assert axis_errors(back, maps[0]).max() < 0.01


def test_a_uniform_room_looks_alike_everywhere():
    uniform = np.full((32, 64, 3), 2.5)
    assert near_field.relocate([uniform], ROOM.depth, PROBE, OBJECT)[0] == pytest.approx(2.5)


def test_a_far_room_changes_nothing(maps):
    far = Room(np.zeros(3), np.full(3, 2e4))
    depth = near_field.sphere(PROBE, 1e5)
    moved = near_field.relocate([maps[0]], depth, PROBE, OBJECT)[0]
    assert moved == pytest.approx(maps[0], abs=1e-9)
    found = near_field.assess(maps[0], PROBE, [PROBE + ALONG], far, 0.02, EYE)
    assert found.target is None or found.numbers["near_irradiance_error"] > 0.02


def test_variance_and_coverage_move_with_the_light(maps):
    seen = (latlong_directions(128, 256)[..., :1] > 0).astype(float)
    moved, covered = near_field.relocate([maps[0], seen], ROOM.depth, PROBE, OBJECT)
    assert moved.shape == maps[0].shape
    assert seen.mean() < covered.mean() < 1  # walked towards +x: of what lies there, some is behind now


def test_a_point_lamp_falls_with_the_square_of_its_distance():
    """A small lamp on the ceiling straight above: closer by a factor 1.5, and so 2.25 times the irradiance."""
    tall = Room(np.array([0, 1.0, 0]), np.array([9.0, 2.0, 9.0]))
    source, target = np.array([0, 0.5, 0]), np.array([0, 1.0, 0])
    w = latlong_directions(256, 512)
    lamp = np.where(w[..., 1:2] > np.cos(0.06), 100.0, 0.0) * np.ones(3)
    moved = near_field.relocate([lamp], tall.depth, source, target)[0]
    ratio = irradiance(moved, AXES)[2] / irradiance(lamp, AXES)[2]
    assert ratio == pytest.approx((1.5 / 1.0) ** 2, rel=0.03)  # an edge between 5 samples of a texel, of 7.5


def test_room_is_used_beyond_the_budget_only(maps):
    at_probe = maps[0]
    needed = near_field.assess(at_probe, PROBE, [OBJECT, OBJECT + ALONG / 4], ROOM, 0.02, EYE)
    assert needed.target == pytest.approx(OBJECT + ALONG / 8)
    assert needed.evidence["modelled"]
    true = axis_errors(at_probe, maps[1]).max()
    single = near_field.assess(at_probe, PROBE, [OBJECT], ROOM, 0.02, EYE)
    assert single.numbers["near_irradiance_error"] == pytest.approx(
        true, rel=0.15
    )  # from the probe's map, on 64 rows; measured 0.1
    assert single.numbers["near_irradiance_error_left"] == 0
    around = near_field.assess(at_probe, PROBE, [OBJECT, 2 * PROBE * [0, 1, 0] - OBJECT * [1, -1, 1]], ROOM, 0.02, EYE)
    assert around.target is None
    assert "no one place serves" in around.evidence["because"]
    assert around.warnings
    close = near_field.assess(at_probe, PROBE, [PROBE + ALONG / 40], ROOM, 0.02, EYE)
    assert close.target is None
    assert not close.evidence["modelled"]
    assert "budget 2.00%" in close.evidence["because"]


def test_light_on_what_objects_show_is_that_of_a_ball_seen_from_the_camera(maps):
    """Against every normal that it shows, weighted by its size in the picture: 96 on the sphere find it within 2 %."""
    found = near_field.error_on_objects(maps[0], ROOM.depth, PROBE, OBJECT, EYE)
    moved = near_field.relocate([resize_environment(maps[0], 64, 128)], ROOM.depth, PROBE, OBJECT)[0]
    way = (EYE - OBJECT) / np.linalg.norm(EYE - OBJECT)
    normals = np.random.default_rng(0).standard_normal((600, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = np.maximum(normals @ way, 0)
    small = resize_environment(maps[0], 64, 128)
    a, b = irradiance(small, normals), irradiance(moved, normals)
    errors = np.linalg.norm(a - b, axis=1) / np.linalg.norm(b, axis=1)
    assert found == pytest.approx(errors @ seen / seen.sum(), rel=0.06)  # 600 random normals: 4 % by chance


def test_forced_off_beside_a_lamp_it_is_off():
    """The probe 0.5 m from a lamp on the wall, the object 1.3 m: light on it is off by more than all of it."""
    light = np.full((32, 64, 3), 0.05)
    light[14:18, 14:18] = 50.0  # about +X
    room = Room(np.array([0, 1.2, 0]), np.array([2.0, 2.4, 3.0]))
    probe, places, eye = np.array([0.5, 1.1, 0]), [np.array([-0.3, 1.1, 0])], np.array([0, 2.0, 1.4])
    stage, forced = TERMS["near_field"]
    budget = KNOBS[stage](**forced).near_budget
    found = near_field.assess(light, probe, places, room, budget, eye)
    assert found.target is None
    assert found.numbers["near_irradiance_error"] > 1
    assert near_field.assess(light, probe, places, room, KNOBS[stage]().near_budget, eye).target is not None


def test_without_a_room_the_error_is_stated_for_three_distances(maps):
    found = near_field.assess(maps[0], PROBE, [OBJECT], None, 0.02, EYE)
    errors = found.numbers["near_irradiance_error_if_walls_at"]
    assert found.target is None
    assert errors["1_m"] > errors["2_m"] > errors["4_m"] > 0
    assert "not known" in found.evidence["because"]


def test_objects_outside_the_room_are_named(maps):
    found = near_field.assess(maps[0], PROBE, [np.array([5.0, 0.04, 0])], ROOM, 0.02, EYE)
    assert found.target is None
    assert "outside" in found.warnings[0]
    assert not ROOM.holds(np.array([0, -0.1, 0]))


def test_a_moved_map_is_found_again_at_the_probe(maps):
    moved = near_field.relocate([maps[0]], ROOM.depth, PROBE, OBJECT)[0]
    header = near_field.places(OBJECT, PROBE)
    assert axis_errors(near_field.at_probe(moved, header, ROOM), maps[0]).max() < 0.01
    np.testing.assert_array_equal(near_field.from_probe(maps[0], header, ROOM), moved)
    assert near_field.at_probe(moved, header, None) is moved
    assert near_field.at_probe(maps[0], near_field.places(PROBE, PROBE), ROOM) is maps[0]


def test_room_and_places_come_from_the_manifests():
    box = {"centre_m": CENTRE.tolist(), "size_m": SIZE.tolist(), "yaw_deg": 25.0}
    found = near_field.room_of({"room": box})
    assert found is not None
    w = latlong_directions(16, 32)
    assert found.depth(PROBE, w) == pytest.approx(ROOM.depth(PROBE, w))
    assert near_field.room_of({}) is None
    wishes = {"object": [{"position_m": [0.1, 0.2], "lift_m": 0.05}]}
    assert near_field.places_of(wishes, 0.04)[0] == pytest.approx([0.1, 0.09, 0.2])
