"""The benchmark's own promises: scenes are what they say, statistics know their truth, opponents agree."""

import numpy as np
import pytest

from benchmarks import render, resimulate
from benchmarks.cycles import layers
from benchmarks.estimators import closed_form, load, naive, ours, sun_of
from benchmarks.measures import Point, cost_at, display, exposure_gain, middle, speedup, squared_error
from benchmarks.page import write_page
from benchmarks.plates import LARGE, SMALL, cameras
from benchmarks.render import lattice
from benchmarks.scenes import SCENES, Scene, ball, box, column, facts
from pipeline.camera.lens import unproject


@pytest.fixture(params=SCENES, scope="module")
def scene(request: pytest.FixtureRequest) -> Scene:
    return SCENES[request.param](64, 36)


@pytest.mark.parametrize(
    "shape", [ball(0.2, (1, 0.2, 0), 12), box((0.3, 0.2, 0.1), (0, 0.1, 0), 30), column(0.1, 0.5, (0, 0, 0), 12)]
)
def test_shapes_are_closed_and_face_outwards(shape) -> None:
    """Volume by the divergence theorem is positive, areas sum to zero as vectors, normals agree with the faces."""
    a, b, c = (shape.vertices[shape.faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a) / 2
    assert np.einsum("ij,ij->", (a + b + c) / 3, area) > 0
    np.testing.assert_allclose(area.sum(0), 0, atol=1e-12)
    assert (np.einsum("ij,ij->i", area, shape.normals[shape.faces].mean(1)) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-12)


def test_scene_is_what_it_says(scene: Scene) -> None:
    light = facts(scene)
    assert light["map_max_over_median"] > 2e5
    share = {"hard_sun": 0.7, "corner": 0.6}.get(scene.name, 0.8)
    np.testing.assert_allclose(light["sun_share_red"], share, atol=1e-9)
    assert scene.environment.min() >= 0
    assert scene.albedo.min() > 0
    assert scene.albedo.max() < 1
    for item in scene.items:
        assert item.shape.vertices[:, 1].min() > -1e-9, "an object reaches below the plane"


def test_no_pixel_looks_past_the_model(scene: Scene) -> None:
    """The corner rays of the frame meet the plane inside its rectangle, or a wall before."""
    size = scene.camera.width, scene.camera.height
    xn = unproject(scene.camera, np.array([[0.0, 0], [size[0], 0], [0, size[1]], size]))
    direction = np.concatenate([xn, np.ones((4, 1))], 1) @ scene.world_from_camera[:3, :3].T
    eye = scene.world_from_camera[:3, 3]
    reach = np.where(direction[:, 1] < 0, -eye[1] / np.minimum(direction[:, 1], -1e-9), np.inf)
    for wall in scene.walls:
        axis = int(np.argmin(np.ptp(wall.vertices, 0)))
        distance = (wall.vertices[0, axis] - eye[axis]) / direction[:, axis]
        point = eye + distance[:, None] * direction
        low, high = wall.vertices.min(0) - 1e-9, wall.vertices.max(0) + 1e-9
        reach = np.where(((point >= low) & (point <= high)).all(1) & (distance > 0), np.minimum(reach, distance), reach)
    assert np.isfinite(reach).all()
    assert np.abs(eye + reach[:, None] * direction)[:, [0, 2]].max() <= np.abs(scene.plane.corners_m).max() + 1e-9


def test_squared_error_needs_no_quiet_truth() -> None:
    """X with noise 3 and bias 0.5 against two estimates with noise 5: 9.25, though they differ from X by 34."""
    rng = np.random.default_rng(2)
    count = 400_000
    x, a, b = (rng.normal(mean, sigma, count) for mean, sigma in ((0.5, 3), (0, 5), (0, 5)))
    # Var (X - A)(X - B) = E d^4 + E d^2 (25 + 25) + 25 * 25 - 9.25^2 with d = X - truth: below 1300.
    assert abs(squared_error(x, a, b) - 9.25) < 5 * np.sqrt(1300 / count)


def test_cost_at_follows_one_over_time() -> None:
    curve = [Point(100 / seconds, seconds) for seconds in (1.0, 4.0, 16.0)]
    for error in (300.0, 100.0, 40.0, 7.0, 0.5):
        np.testing.assert_allclose(cost_at(error, curve), 100 / error, rtol=1e-12)
    np.testing.assert_allclose(speedup(Point(2.0, 5.0), curve), 10.0, rtol=1e-12)


def test_cost_at_goes_through_every_point() -> None:
    curve = [Point(90.0, 1.0), Point(10.0, 4.0), Point(1.0, 20.0)]
    for point in curve:
        np.testing.assert_allclose(cost_at(point.error, curve), point.cpu_s, rtol=1e-12)


def test_middle_is_the_median_of_each() -> None:
    assert middle([Point(1, 9, 4), Point(5, 2, 4), Point(3, 3, 4)]) == Point(3, 3, 4)


def test_display_puts_the_plate_in_the_middle() -> None:
    plate = np.full((5, 3), 7.0)
    np.testing.assert_allclose(display(plate, exposure_gain(plate)), 255 * 0.4614, atol=0.1)  # sRGB of 0.18
    np.testing.assert_allclose(display(np.array([-1.0, 1e9]), 1.0), [0, 255], atol=1e-9)


def test_crop_sees_what_the_large_photograph_sees() -> None:
    large, small = cameras()
    offset = (np.array(LARGE) - SMALL) / 2
    px = np.array([[0.5, 0.5], [600.0, 300.0]])
    np.testing.assert_allclose(unproject(small, px), unproject(large, px + offset), atol=1e-12)
    assert np.prod(LARGE) == 24e6
    assert abs(np.prod(SMALL) - 1e6) < 5e3


def test_lattice_lies_in_the_frame() -> None:
    rows, columns = np.divmod(lattice(10, 7), 10)
    assert sorted(set(rows)) == [1, 4]
    assert sorted(set(columns)) == [1, 4, 7]


def test_two_renders_and_the_difference_agree() -> None:
    """Means over the frame of both composites, 6 seeds each: within five standard errors of their difference."""
    stage = load(SCENES["diffuse_glossy"](64, 36))
    plate = closed_form(stage)
    gain = exposure_gain(plate)
    means = [
        np.array([np.minimum(strategy(stage, plate, 16, 6, seed) * gain, 4).mean(0) for seed in range(6)])
        for strategy in (naive, ours)
    ]
    error = np.sqrt(sum(values.var(0, ddof=1) / 6 for values in means))
    assert (np.abs(means[0].mean(0) - means[1].mean(0)) < 5 * error).all()


def test_sun_is_the_brightest_texels() -> None:
    scene = SCENES["hard_sun"](64, 36)
    sun = sun_of(scene)
    level = scene.environment.sum(-1).ravel()
    assert level[sun.texels].min() > 1e3 * np.delete(level, sun.texels).max()
    np.testing.assert_allclose(np.linalg.norm(sun.direction), 1, atol=1e-12)
    assert abs(np.degrees(np.arcsin(sun.direction[1])) - 22) < 0.5


def test_layers_of_cycles_are_told_by_name() -> None:
    names = [f"ViewLayer.Combined.{c}" for c in "RGBA"] + [f"ViewLayer.Shadow Catcher.{c}" for c in "RGB"]
    channels = {name: np.full((2, 2), float(i)) for i, name in enumerate(names)}
    objects, alpha, ratio = layers(channels)
    assert objects[0].tolist() == [0, 1, 2]
    assert alpha[0] == 3
    assert ratio[0].tolist() == [4, 5, 6]


def test_page_without_cycles(tmp_path) -> None:
    point = {"error": 2.0, "cpu_s": 3.0, "samples": 4}
    speedups = {f"speedup_over_{o}{e}": None for o in ("naive", "cycles") for e in ("", "_region", "_estimator")}
    scene = {
        "curves": {"naive": [point], "insitu": [point]},
        "cycles": None,
        "map": {"map_max_over_median": 3e5, "sun_share_red": 0.8},
        "reference_noise": 0.1,
    }
    tiny = {"large_cpu_s": 2.0, "small_cpu_s": 1.0}
    record = {"size": [64, 36], "threads": 2, "tiny_24mpx_over_1mpx": 2.0, "tiny": tiny, "zscore_max": None}
    write_page(record | {"diffuse_glossy": scene | speedups}, tmp_path)
    page = (tmp_path / "render.md").read_text()
    assert "bench-cycles-env" in page
    assert "two renders | 4 | 3.00 | 1.41" in page
    assert (tmp_path / "render.svg").stat().st_size > 1000


def test_a_part_that_was_measured_is_kept_for_the_same_settings(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(render, "KEPT", tmp_path)
    calls = []

    def part() -> dict[str, object]:
        calls.append(1)
        return {"row": len(calls)}

    one, two = {"size": [64, 36]}, {"size": [128, 72]}
    assert render.measured("part", part, one, True)["rows"] == {"row": 1}
    assert render.measured("part", part, one, True)["rows"] == {"row": 1}
    assert render.measured("part", part, two, True)["rows"] == {"row": 2}
    assert render.measured("part", part, two, False)["rows"] == {"row": 3}


@pytest.mark.parametrize("by_px", [0.1, 0.3, 0.6])
def test_captures_taken_again_are_as_soft_as_stated(by_px) -> None:
    """Variances add: a point that is made softer by a sigma has that variance along each axis, the sum kept."""
    point = np.zeros((9, 9, 1))
    point[4, 4] = 1
    soft, place = resimulate.softened(point, by_px)[..., 0], np.arange(9) - 4
    assert soft.sum() == pytest.approx(1)
    assert (soft.sum(0) * place**2).sum() == pytest.approx(by_px**2)
    assert (soft.sum(1) * place**2).sum() == pytest.approx(by_px**2)
