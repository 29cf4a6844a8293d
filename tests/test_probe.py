"""The mirror ball against an independent forward ray tracer: geometry, energy, fit, stage, extremes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from mirror_scene import Lamp, Place, look_at, photograph, sky

from pipeline.conventions import CLIPPED, direction_from_latlong, invert_rigid, latlong_directions, transform_points
from pipeline.light import near_field
from pipeline.light.environment import AXES, irradiance, resize_environment, total_energy
from pipeline.probes import reflection, shadow_flux
from pipeline.probes.combine import merge
from pipeline.probes.filling import fill
from pipeline.probes.kinds import KINDS
from pipeline.probes.levelling import relative_exposure
from pipeline.probes.mirror_geometry import Mirror, texel_directions
from pipeline.probes.observation import Grid, Observation, Shots, ViewMap
from pipeline.probes.photographer import toward_photographer
from pipeline.probes.unwrap import unwrap
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Raster, View
from stages import knobs, probe

RADIUS = 0.04
LAMPS = [Lamp((0.3, 0.8, 0.4), 0.06, 200.0), Lamp((-0.6, 0.3, -0.5), 0.1, 30.0)]


def camera_of(radius_px: float, distance: float = 0.5, width: int = 420, height: int = 340) -> Camera:
    focal = radius_px * distance / RADIUS
    return Camera(
        width=width, height=height, fx=focal, fy=focal * 1.001, cx=width / 2 - 5, cy=height / 2 + 7,
        distortion=np.array([-0.08, 0.02, 5e-4, -3e-4, 0]),
    )  # fmt: skip


def raster(picture: np.ndarray, noise: float = 0.003) -> Raster:
    variance = (noise * picture) ** 2
    mask = np.zeros(picture.shape[:2], np.uint32)
    return Raster(
        {**Raster.split(np.float32(picture)), **Raster.split(np.float32(variance), "variance"), "mask": mask}, "acescg"
    )


def view(world_from_camera: np.ndarray) -> View:
    covariance = np.diag([2e-4**2] * 3 + [2e-4**2] * 3)
    return View(world_from_camera=world_from_camera, covariance=covariance, route="given", rms_px=0.1, points=20)


def facts(*balls: tuple[str, bool]) -> dict[str, Any]:
    return {
        "ball": [{"name": name, "tripod": tripod} for name, tripod in balls],
        "probe": {
            "kind": "mirror_ball",
            "diameter_m": 2 * RADIUS,
            "reflectance": (0.8, 0.8, 0.8),
            "reflectance_space": "acescg",
        },
    }


def truth_map(place: Place, height: int, width: int, split: int = 4) -> np.ndarray:
    w = latlong_directions(height * split, width * split).reshape(-1, 3)
    rgb = place.radiance(np.broadcast_to(place.ball, w.shape), w).reshape(height * split, width * split, 3)
    return resize_environment(rgb, height, width)


# ---- geometry ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [1e-6, 0.05, 0.3, 0.9])
def test_incidence_inverts_deviation(ratio):
    sine = np.linspace(0, 1, 500)
    again = np.sin(reflection.incidence(reflection.deviation(sine, ratio), ratio))
    assert again == pytest.approx(sine, abs=1e-9)


def test_far_away_is_debevecs_formula_and_blind_cone_is_the_limit():
    sine = np.linspace(0, 1, 100)
    assert reflection.deviation(sine, 1e-9) == pytest.approx(2 * np.arcsin(sine), abs=1e-8)
    assert np.pi - reflection.deviation(1.0, 0.3) == pytest.approx(reflection.blind_half_angle(0.3), abs=1e-12)


def test_reflected_rays_come_back():
    w = np.random.default_rng(0).normal(size=(2000, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    centre = np.array([0.05, 0.1, 0.3])
    distance = np.linalg.norm(centre)
    rays, sine = reflection.rays_from_directions(w, -centre / distance, RADIUS / distance)
    seen = ~np.isnan(sine)
    blind = w @ (centre / distance) > np.cos(reflection.blind_half_angle(RADIUS / distance))
    assert (seen == ~blind).all()
    assert reflection.directions_from_rays(rays[seen], centre, RADIUS) == pytest.approx(w[seen], abs=1e-9)


def test_radians_per_pixel_is_the_derivative():
    ratio, step = 0.2, 1e-6
    sine = np.array([0.0, 0.3, 0.9])
    radial, _ = reflection.radians_per_pixel(sine, ratio, 100)
    numeric = (reflection.deviation(sine + step, ratio) - reflection.deviation(sine, ratio)) / (100 * step)
    assert radial == pytest.approx(numeric, rel=1e-4)


# ---- unwrap with the true centre -----------------------------------------------------------------------------------


def unwrapped(place: Place, camera: Camera, pose: np.ndarray, height: int = 64, split: int = 4):
    picture = photograph(place, camera, pose, split)
    centre = transform_points(invert_rigid(pose), np.array(place.ball))
    mirror = Mirror(camera, invert_rigid(pose)[:3, :3], centre, RADIUS, 0.97)
    channels = [np.float32(picture[..., i]) for i in range(3)]
    return unwrap(np.ones(picture.shape[:2], np.float32), channels, mirror, height, 2 * height)


@pytest.mark.parametrize("name", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_six_directions(name):
    axis = dict(zip(("+x", "-x", "+y", "-y", "+z", "-z"), AXES, strict=True))[name]
    place = Place(sky([Lamp(tuple(axis + np.array([0.02, 0.03, 0.01])), 0.12, 500.0)], 0.0))
    camera, pose = camera_of(60, width=160, height=160), look_at((0.25, 0.35, 0.3), (0, RADIUS, 0))
    found = unwrapped(place, camera, pose, 32, 2)
    row, column = np.unravel_index(found.values[..., 1].argmax(), found.coverage.shape)
    brightest = direction_from_latlong((column + 0.5) / 64, (row + 0.5) / 32)
    assert np.degrees(np.arccos(brightest @ axis)) < 12  # within the lamp and a texel


def test_constant_light_gives_a_constant_map():
    place = Place(sky([], 0.0), reflectance=0.8)
    found = unwrapped(place, camera_of(50, width=140, height=140), look_at((0.25, 0.35, 0.3), (0, RADIUS, 0)), 32, 2)
    inner = found.coverage > 0
    assert found.values[inner] == pytest.approx(0.8, rel=2e-5)  # float32
    blind = 1 - inner.mean()
    assert 0 < blind < 0.1


@pytest.mark.parametrize(
    ("position", "radius_px"), [((0.25, 0.35, 0.3), 40.0), ((0.25, 0.35, 0.3), 120.0), ((-0.3, 0.3, 0.35), 60.0)]
)
def test_lamp_energy_is_conserved(position, radius_px):
    # 3 %: a lamp of 7 degrees on 40 px; the truth's 4 x 4 rays per pixel cut its edge (measured 0.3 to 1 %)
    lamp = Lamp((0.2, 0.9, 0.3), 0.06, 1000.0)
    place = Place(sky([lamp], 0.0), reflectance=1.0)
    camera = camera_of(radius_px, width=int(2.6 * radius_px), height=int(2.6 * radius_px))
    camera = camera.model_copy(update={"cx": camera.width / 2, "cy": camera.height / 2})
    found = unwrapped(place, camera, look_at(position, (0, RADIUS, 0)))
    w = latlong_directions(64, 128)
    near = w @ (np.array(lamp.direction) / np.linalg.norm(lamp.direction)) > np.cos(0.2)
    energy = total_energy((found.values - 1) * near[..., None])[0]
    assert energy == pytest.approx(2 * np.pi * (1 - np.cos(0.06)) * 999, rel=0.03)


def test_sun_on_the_seam_is_whole():
    lamp = Lamp((0.0, 0.25, -1.0), 0.08, 1000.0)
    place = Place(sky([lamp], 0.0), reflectance=1.0)
    found = unwrapped(place, camera_of(60, width=160, height=160), look_at((0.4, 0.3, 0.0), (0, RADIUS, 0)))
    energy = total_energy(found.values - (found.coverage > 0)[..., None])[0]
    assert energy == pytest.approx(2 * np.pi * (1 - np.cos(0.08)) * 999, rel=0.03)  # as above


# ---- fit -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shots() -> dict[str, Any]:
    """A plate and two ball views of a ball of about 100 px by a chequered board, 0.3 % noise."""
    place = Place(sky(LAMPS), plane=True, ball=(0.02, RADIUS, 0.01))
    a, b = look_at((0.08, 0.27, 0.40), (0.03, 0.03, 0)), look_at((0.45, 0.30, 0.05), (0.03, 0.03, 0))
    camera = camera_of(100)
    empty = dataclasses.replace(place, ball=None)
    return {
        "place": place, "camera": camera, "views": {"plate": view(a), "ball_a": view(a), "ball_b": view(b)},
        "photographs": {
            "plate": raster(photograph(empty, camera, a, 3, 0.003, 1)),
            "ball_a": raster(photograph(place, camera, a, 3, 0.003, 2)),
            "ball_b": raster(photograph(place, camera, b, 3, 0.003, 3)),
        },
    }  # fmt: skip


def run(shots: dict[str, Any], *balls: tuple[str, bool], width: int = 256):
    used = ["plate", *(name for name, _ in balls)]
    photographs = {name: shots["photographs"][name] for name in used}
    return probe.compute(
        facts(*balls), photographs, shots["camera"], shots["views"], {}, {}, knobs.Probe(width=width, supersample=2)
    )


class Remembered:
    """A kind that looks once; later stages are then tested on what it saw, ``changed`` or not."""

    def __init__(self) -> None:
        self.seen: Observation | None = None
        self.changed: dict[str, ViewMap] = {}

    def observe(self, shots: Shots, grid: Grid) -> Observation:
        self.seen = self.seen or KINDS["mirror_ball"].observe(shots, grid)
        return dataclasses.replace(self.seen, maps={**self.seen.maps, **self.changed})


@pytest.fixture(scope="module")
def looked() -> Remembered:
    return Remembered()


@pytest.fixture(scope="module")
def result(shots, looked):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(probe, "KINDS", {"mirror_ball": looked})
        return run(shots, ("ball_a", True), ("ball_b", False))


@pytest.fixture
def again(result, looked, monkeypatch) -> Remembered:
    """The observation of ``result`` once more, for what comes after it."""
    monkeypatch.setattr(probe, "KINDS", {"mirror_ball": looked})
    monkeypatch.setattr(looked, "changed", {})
    return looked


def direction_rms_deg(fitted: np.ndarray, true: np.ndarray) -> float:
    """Error of reflected directions over the disc r < 0.9, weighted by picture area."""
    rng = np.random.default_rng(0)
    r, angle = 0.9 * np.sqrt(rng.random(4000)), 2 * np.pi * rng.random(4000)
    axis = true / np.linalg.norm(true)
    first = np.cross(axis, (0, 1, 0)) / np.linalg.norm(np.cross(axis, (0, 1, 0)))
    second = np.cross(axis, first)
    sine = r * RADIUS / np.linalg.norm(true)
    rays = np.sqrt(1 - sine**2)[:, None] * axis + sine[:, None] * (
        np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    )
    two = [reflection.directions_from_rays(rays, centre, RADIUS) for centre in (fitted, true)]
    error = np.arccos(np.clip((two[0] * two[1]).sum(1), -1, 1))
    return float(np.degrees(np.sqrt(np.mean(error**2))))


@pytest.mark.parametrize("name", ["ball_a", "ball_b"])
def test_directions_of_the_fit(shots, result, name):
    ball = result.outputs["balls"][name]
    true = transform_points(invert_rigid(shots["views"][name].world_from_camera), np.array(shots["place"].ball))
    assert ball.radius_px > 80
    assert direction_rms_deg(ball.centre_camera_m, true) < 0.3 * 100 / ball.radius_px  # the mission's figure at 100 px
    assert abs(result.numbers[name]["height_discrepancy_mm"]) < 4 * result.numbers[name]["height_discrepancy_sigma_mm"]


def test_map_and_irradiance_against_truth(shots, result):
    environment = result.outputs["environment"]
    truth = truth_map(shots["place"], 128, 256)
    found, expected = irradiance(environment.rgb(), AXES), irradiance(truth, AXES)
    error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
    # The plane lies within a few radii, so directions near the horizon are displaced by parallax (measured 0.9 %).
    assert error.max() < 0.02
    assert error[2] < 0.01  # upwards, the light of things that lie on the plane
    assert result.numbers["views"]["ball_b"]["exposure_ratio"] == pytest.approx(1, abs=0.01)
    assert result.numbers["seen_fraction"] > 0.99


def test_exposure_doubles_the_map_and_keeps_the_fit(shots, result):
    bright = {
        name: Raster(
            {k: v * (2 if "mask" not in k else 1) * (2 if "var" in k else 1) for k, v in r.channels.items()}, r.space
        )
        for name, r in shots["photographs"].items()
    }
    doubled = run({**shots, "photographs": bright}, ("ball_a", True), ("ball_b", False))
    assert doubled.outputs["environment"].rgb() == pytest.approx(2 * result.outputs["environment"].rgb(), rel=1e-4)


def test_view_twice_as_bright_is_levelled(shots, result, again):
    """That a map doubles with its photograph is the test above."""
    again.changed = {"ball_b": again.seen.maps["ball_b"].scaled(2)}
    found = run(shots, ("ball_a", True), ("ball_b", False))
    assert found.numbers["views"]["ball_b"]["exposure_ratio"] == pytest.approx(2, rel=0.02)
    assert any("brought to it" in warning for warning in found.warnings)
    error = irradiance(found.outputs["environment"].rgb(), AXES) / irradiance(result.outputs["environment"].rgb(), AXES)
    assert error == pytest.approx(1, abs=0.01)


def test_one_view_marks_what_it_does_not_see(shots):
    found = run(shots, ("ball_a", True))
    environment = found.outputs["environment"]
    assert 0.8 < found.numbers["seen_fraction"] < 0.999
    assert np.isfinite(environment.rgb()).all()
    hidden = environment["seen"] == 0
    assert hidden.any()
    relative = environment.rgb("variance")[hidden] / environment.rgb()[hidden] ** 2
    measured = environment.rgb("variance")[~hidden] / environment.rgb()[~hidden] ** 2
    assert relative.min() > 3 * np.median(measured)  # how well it is known, is tested in test_probe_views


def test_clipped_lamp_is_a_lower_bound(shots, monkeypatch):
    monkeypatch.setattr(shadow_flux, "POINTS", 400)  # what the shadow tells is tested in test_clipped
    photographs = dict(shots["photographs"])
    old = photographs["ball_a"]
    over = old["G"] > 20
    channels = {k: (np.where(over, 20, v) if k in "RGB" else v) for k, v in old.channels.items()}
    for c in "RGB":
        channels[f"variance.{c}"] = np.where(over, np.inf, old[f"variance.{c}"]).astype(np.float32)
    channels["mask"] = np.where(over, CLIPPED, old["mask"]).astype(np.uint32)
    photographs["ball_a"] = Raster(channels, "acescg")
    found = run({**shots, "photographs": photographs}, ("ball_a", True))
    assert found.numbers["clipped_texels"] > 0
    assert any("lower bound" in warning for warning in found.warnings)
    assert np.isfinite(found.outputs["environment"].rgb("variance")).all()


def test_room_moves_the_map_to_the_objects(shots, result, again):
    box = {"centre_m": [0.1, 0.8, 0.0], "size_m": [2.2, 2.4, 2.0], "yaw_deg": 15.0}
    wishes = {"object": [{"name": "cube", "position_m": [0.3, 0.1]}]}
    photographs = {name: shots["photographs"][name] for name in ("plate", "ball_a", "ball_b")}

    def moved(budget: float, room: dict[str, Any]):
        return probe.compute(
            facts(("ball_a", True), ("ball_b", False)) | {"room": room}, photographs, shots["camera"], shots["views"],
            {}, wishes, knobs.Probe(width=256, supersample=2, near_budget=budget),
        )  # fmt: skip

    found = moved(0.001, box)
    environment, before = found.outputs["environment"], result.outputs["environment"].rgb()
    assert found.numbers["near_irradiance_error"] > found.numbers["near_irradiance_error_left"] == 0
    assert not np.allclose(environment.rgb(), before)
    room = near_field.room_of({"room": box})
    back = near_field.at_probe(environment.rgb(), environment.attributes, room)
    assert irradiance(back, AXES) == pytest.approx(irradiance(before, AXES), rel=0.02)
    assert np.array_equal(moved(1.0, box).outputs["environment"].rgb(), before)  # bit for bit
    with pytest.raises(CaptureError, match="room: the probe"):
        moved(1.0, box | {"centre_m": [9.0, 1.0, 0.0]})


# ---- refused and flagged -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bare() -> dict[str, Any]:
    """The table without its ball from both places, at half the size; as if the photographer forgot it."""
    place = Place(sky(LAMPS), plane=True, ball=None)
    a, b = look_at((0.08, 0.27, 0.40), (0.03, 0.03, 0)), look_at((0.45, 0.30, 0.05), (0.03, 0.03, 0))
    camera = camera_of(50, width=210, height=170)
    one, other = (raster(photograph(place, camera, pose, 3, 0.003, seed)) for pose, seed in ((a, 1), (b, 4)))
    views = {"plate": view(a), "ball_a": view(a), "ball_b": view(b)}
    return {"camera": camera, "views": views, "photographs": {"plate": one, "ball_a": one, "ball_b": other}}


def test_no_ball_is_refused(bare):
    with pytest.raises(CaptureError, match="ball_b: no mirror ball"):
        run(bare, ("ball_b", False))


def test_tripod_view_without_ball_is_refused(bare):
    with pytest.raises(CaptureError, match="ball_a: no mirror ball"):
        run(bare, ("ball_a", True))


def lone_shot(radius_px: float, target: tuple[float, float, float], width: int = 400):
    place = Place(sky(LAMPS), plane=True, ball=(0.02, RADIUS, 0.01))
    pose = look_at((0.08, 0.27, 0.40), target)
    camera = camera_of(radius_px, width=width, height=360)
    shots = {
        "camera": camera, "views": {"plate": view(pose), "ball_a": view(pose)},
        "photographs": {
            "plate": raster(photograph(dataclasses.replace(place, ball=None), camera, pose, 3, 0.003, 1)),
            "ball_a": raster(photograph(place, camera, pose, 3, 0.003, 2)),
        },
    }  # fmt: skip
    return shots, transform_points(invert_rigid(pose), np.array(place.ball))


def test_small_ball_is_flagged(saw):
    shots, true = lone_shot(34.0, (0.02, 0.03, 0.01))
    found = run(shots, ("ball_a", True))
    ball = found.outputs["balls"]["ball_a"]
    assert ball.radius_px < 40
    said = [warning for warning in found.warnings if "coarse" in warning]
    # one pixel of outline: 2.8 rad / radius on average over r < 0.9 (sqrt of the mean of 4 / (1 - r^2), and across)
    error = direction_rms_deg(ball.centre_camera_m, true) / np.degrees(2.8 / ball.radius_px)
    saw("ball.small", "degraded", error, said=said[0])


def test_ball_cut_by_the_frame_is_flagged_then_refused(saw):
    shots, true = lone_shot(60.0, (0.02, 0.115, 0.01), 260)
    found = run(shots, ("ball_a", True))
    said = [warning for warning in found.warnings if "cuts the ball" in warning]
    ball = found.outputs["balls"]["ball_a"]
    # 1.5 px of outline; measured 1.1 px, towards the part of the outline that is missing
    error = direction_rms_deg(ball.centre_camera_m, true) / np.degrees(2.8 / ball.radius_px)
    saw("ball.cut", "degraded", error, said=said[0])
    shots, _ = lone_shot(60.0, (0.02, 0.14, 0.01), 260)
    with pytest.raises(CaptureError, match="frame") as refusal:
        run(shots, ("ball_a", True))
    saw("ball.cut_away", "refused", said=str(refusal.value))


def test_ball_thirty_degrees_off_axis(saw):
    place = Place(sky(LAMPS, 0.3), reflectance=0.8)
    pose = look_at((0.25, 0.35, 0.3), (0, RADIUS, 0))
    turn = np.radians(30)
    pose[:3, :3] = pose[:3, :3] @ np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    camera = camera_of(60, width=780, height=160).model_copy(update={"distortion": np.zeros(5)})
    found = unwrapped(place, camera, pose, 32, 2)
    truth = 0.8 * truth_map(place, 32, 64)
    smooth = (found.coverage > 0.999) & (truth.max(-1) < 2)
    mirror = Mirror(
        camera, invert_rigid(pose)[:3, :3], transform_points(invert_rigid(pose), np.array(place.ball)), RADIUS, 0.97
    )
    inner = smooth & (texel_directions(mirror, 32, 64, np.zeros((3, 3)), np.zeros((3, 3)))[0] < 0.9)
    saw("ball.off_axis", "exact", np.median(np.abs(found.values[inner] / truth[inner] - 1)))


# ---- combination ---------------------------------------------------------------------------------------------------


def test_photographer_is_where_the_camera_is():
    toward = np.array([0.6, 0.5, -0.6])
    toward /= np.linalg.norm(toward)
    hidden = toward_photographer(64, 128, toward, 0.7)
    w = latlong_directions(64, 128)
    assert hidden[np.unravel_index((w @ toward).argmax(), hidden.shape)] == 1
    assert hidden[np.unravel_index((w @ -toward).argmax(), hidden.shape)] == 0


def test_fill_keeps_constants_and_known_texels():
    known = np.ones((32, 64))
    known[10:20, 50:64] = 0
    rgb = np.where(known[..., None] > 0, 3.0, 99.0) * np.ones(3)
    assert fill(rgb, known) == pytest.approx(3.0)


def test_merge_of_equal_views_halves_the_variance():
    one = np.ones((8, 16))
    map_of = ViewMap(np.full((8, 16, 3), 2.0), np.full((8, 16, 3), 0.1), one, one)
    merged = merge([map_of, map_of])
    assert merged.rgb == pytest.approx(2)
    assert merged.variance == pytest.approx(0.05)
    assert merged.seen == pytest.approx(1)


def test_relative_exposure_sees_through_a_moved_lamp():
    rng = np.random.default_rng(2)
    base = resize_environment(rng.gamma(4, 0.25, (16, 32, 3)), 64, 128)
    other = 1.1 * base * (1 + 0.01 * rng.normal(size=base.shape))
    other[10:14, 20:26] = 500
    one = np.ones((64, 128))
    pair = relative_exposure(ViewMap(base, base, one, one), ViewMap(other, other, one, one))
    assert np.exp(pair.log) == pytest.approx(1.1, rel=0.003)
    assert pair.sigma < 0.002
