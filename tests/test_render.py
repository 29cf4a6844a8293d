"""The render stage against the lens and the plate: half pixels, texture flips, rotation of the world, the region."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from test_composite_render import inputs, wish
from test_transport import GREY, camera, ground, looking_down, sky, sphere

from benchmarks.scenes import ray_grid
from pipeline.camera.lens import project
from pipeline.conventions import HALF_PIXEL, invert_rigid, transform_points
from pipeline.light.environment import irradiance
from pipeline.run import progress
from pipeline.transport.difference import difference_block
from pipeline.transport.region import CELL, LEAST, Limits, cell_pixels, interpolate, limits_for, plan
from pipeline.transport.scene import build_worlds
from pipeline.transport.surfaces import material_bsdf, mesh_shape
from pipeline.transport.trace import Rays, reference_block, trace
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Plane, Raster, Result, Surface
from stages import knobs, render

MARKER_SIDE = 0.16


def marker_camera() -> Camera:
    return Camera(width=320, height=240, fx=380.0, fy=381.0, cx=161.5, cy=118.0, distortion=[-0.08, 0.02, 1e-3, 0, 0])


def test_marker_in_a_render_is_where_the_lens_says() -> None:
    """A marker as the ground's texture: read by its id, so no flip; its corners agree with the projection.

    The texture's first row lies on the edge from corner 0 to corner 1 of the plane. 0.15 px: the detector's own bias on
    markers of 90 px is up to 1 % of their side per corner pair, half of it each way; a half-pixel error would show as
    0.5 px on every corner.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    cells = cv2.aruco.generateImageMarker(dictionary, 23, 7 * 16)
    texture = np.full((11 * 16, 11 * 16), 255, np.uint8)
    texture[32:-32, 32:-32] = cells
    half = MARKER_SIDE / 7 * 11 / 2
    # Seen from above with x to the right and z towards the viewer, the print's top left is (-x, -z); a plane's corners
    # run counter-clockwise from (-x, +z), so the texture's first row is the print's last.
    corners = np.array([[-half, 0, half], [half, 0, half], [half, 0, -half], [-half, 0, -half]])
    plane = Plane(normal=[0, 1, 0], offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=corners, source="test")
    albedo = np.repeat((texture[::-1] / 255.0 * 0.8 + 0.05)[..., None], 3, -1)
    worlds = build_worlds(plane, albedo, np.ones((16, 32, 3)), {})
    xn, dxn = ray_grid(marker_camera())
    rays = Rays.of(looking_down(), xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    picture = trace(reference_block, worlds, rays, 64, 2, 0).without.mean(1).reshape(240, 320)
    picture = np.uint8(np.clip(picture * 250, 0, 255))
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
    assert ids is not None
    assert ids.ravel().tolist() == [23]
    sub = cv2.cornerSubPix(picture, found[0].reshape(-1, 1, 2).astype(np.float32), (3, 3), (-1, -1), (3, 50, 1e-3))
    side = MARKER_SIDE / 2
    world = np.array([[-side, 0, -side], [side, 0, -side], [side, 0, side], [-side, 0, side]])
    expected = project(marker_camera(), transform_points(invert_rigid(looking_down()), world))
    error = sub.reshape(-1, 2) + HALF_PIXEL - expected
    assert np.abs(error.mean(0)).max() < 0.15
    assert np.abs(error).max() < 0.5


def rotated(quarter_turns: int):
    """The sphere scene with everything turned about +Y."""
    mi = use_mitsuba()
    angle = quarter_turns * np.pi / 2
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    # u = atan2(x, -z) / 2 pi: a turn by +angle about +Y lowers u by angle / 2 pi.
    light = np.roll(sky(), -quarter_turns * sky().shape[1] // 4, axis=1)
    plane = ground().model_copy(update={"corners_m": transform_points(turn, ground().corners_m)})
    shapes = {"o": mesh_shape(mi, "o", sphere(0.1, (0.05, 0.1, 0.02), GREY), turn, material_bsdf(mi, GREY, "acescg"))}
    xn, dxn = ray_grid(camera())
    rays = Rays.of(turn @ looking_down(), xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    worlds = build_worlds(plane, np.array([0.5, 0.3, 0.2]), light, shapes)
    return [trace(difference_block, worlds, rays, 64, 4, seed) for seed in range(6)]


def test_turning_the_world_changes_nothing() -> None:
    """Means over 16 x 16 tiles of two turned worlds agree within their errors (t, 10 degrees of freedom)."""
    straight, turned = rotated(0), rotated(1)
    for part in (lambda t: t.lost, lambda t: t.gained, lambda t: t.obj):
        means = []
        for samples in (straight, turned):
            tiles = np.stack([part(t).reshape(3, 16, 4, 16, 3).mean((1, 3)) for t in samples])
            means.append((tiles.mean(0), tiles.std(0, ddof=1) / np.sqrt(len(samples))))
        sigma = np.hypot(means[0][1], means[1][1])
        z = np.abs(means[0][0] - means[1][0])[sigma > 0] / sigma[sigma > 0]
        assert z.max() < 6


def test_interpolation_is_exact_for_linear_fields() -> None:
    shape = (50, 67)
    index, grid = cell_pixels(*shape)
    rows, columns = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    ramp = 0.3 * rows - 0.2 * columns + 1.0
    field = interpolate(np.repeat(ramp[index].reshape(*grid, 1), 3, -1), shape)[..., 0]
    inner = (slice(CELL // 2, -CELL), slice(CELL // 2, -CELL))
    np.testing.assert_allclose(field[inner], ramp.reshape(shape)[inner], atol=1e-9)


def test_region_bounds_what_it_leaves_out() -> None:
    """Compared with tracing every pixel: outside the region the change is below the threshold, inside the error is."""
    mi = use_mitsuba()
    shapes = {"o": mesh_shape(mi, "o", sphere(0.05, (0, 0.05, 0), GREY), np.eye(4), material_bsdf(mi, GREY, "acescg"))}
    soft = np.ones((16, 32, 3)) * np.linspace(1, 0.3, 16)[:, None, None]
    worlds = build_worlds(ground(), np.array([0.5, 0.4, 0.3]), soft, shapes)
    big = Camera(width=128, height=96, fx=120.0, fy=120.0, cx=64, cy=48)
    xn, dxn = ray_grid(big)
    rays = Rays.of(looking_down(), xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    light = irradiance(soft, np.array([[0.0, 1, 0]]))[0]
    index, grid = cell_pixels(96, 128)
    pilot = trace(difference_block, worlds, rays[index], 1024, 4, 1, CELL)
    region, left = plan(pilot, pilot.albedo * light / np.pi, grid, (96, 128), Limits(0.01, 0.005, 0.01))
    full = trace(difference_block, worlds, rays, 1024, 4, 2)
    model = full.albedo * light / np.pi
    change = np.divide(full.lost + full.gained, model, out=np.zeros_like(model), where=model > 0).reshape(96, 128, 3)
    noise = np.sqrt(full.change_variance).max() / model.max()
    outside = np.ones((96, 128), bool)
    outside[region.window] = region.weight == 0
    assert outside.any()
    assert region.interpolated.any()
    assert np.abs(change[outside]).max() < 0.01 + 5 * noise
    assert left["left_out_max"] < 0.01
    error = np.abs(region.lost + region.gained - change[region.window])[region.interpolated & (region.weight == 1)]
    assert np.quantile(error, 0.99) < 0.01 / 2 + 3 * noise


def test_the_threshold_follows_the_photographs_noise() -> None:
    """White noise of 1 %: a quarter of the noise of 8 x 8 means is 1 % / 32; the user's threshold only lowers it."""
    plate = np.full((40, 40, 3), 2.0)
    noisy, clean = np.full(plate.shape, 0.02**2), np.full(plate.shape, 1e-16)
    assert np.isclose(limits_for(plate, noisy, 0.004).threshold, 0.01 / 32)
    assert limits_for(plate, noisy, 1e-5).threshold == 1e-5
    assert limits_for(plate, clean, 0.004).threshold == LEAST


def test_no_objects_give_empty_layers() -> None:
    everything = {
        "camera": camera(),
        "views": {"plate": type("V", (), {"world_from_camera": looking_down()})},
        "environment": Raster(Raster.split(sky()), "acescg"),
        "plane": ground(),
        "albedo": Raster(Raster.split(np.full((4, 4, 3), 0.4)), "acescg"),
        "photographs": {},
        "emitters": [],
        "surface": Surface(),
        "local_proxies": [],
        "occluders": [],
        "params": knobs.Render(samples=4),
    }
    result = render.compute(wishes={"object": []}, **everything)
    assert not any(values.any() for values in result.outputs["layers"].channels.values())
    assert result.warnings


class Stops(progress.Host):
    """Wants to stop after so many checkpoints."""

    def __init__(self, after: int, saved: dict[str, np.ndarray] | None = None) -> None:
        self.after, self.saved, self.saves, self.offers = after, saved, 0, 0

    def offer(self, make: Callable[[], Result]) -> None:
        assert set(make().outputs) == {"layers"}
        self.offers += 1

    def interrupted(self) -> bool:
        return self.saves >= self.after

    def checkpoint_load(self) -> dict[str, np.ndarray] | None:
        return self.saved

    def checkpoint_save(self, make: Callable[[], dict[str, np.ndarray]]) -> None:
        self.saved, self.saves = make(), self.saves + 1


def test_an_interrupted_render_keeps_its_passes_and_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Broken off within the second pass: the picture of the first, said to be incomplete; then the whole."""
    params = {"samples": 12, "denoise": False}
    wishes = [wish(tmp_path, 0.0, base_color=[0.6, 0.3, 0.2])]

    def rendered(host: progress.Host) -> Result:
        with progress.hosted(host):
            return render.compute(
                wishes={"object": wishes},
                **inputs(),
                surface=Surface(),
                local_proxies=[],
                params=knobs.Render(**params),
            )

    whole, stopped = rendered(progress.NOBODY), Stops(1)
    part = rendered(stopped)
    assert stopped.offers == 1
    assert part.numbers["complete"] is False
    assert 0 < part.numbers["share_done"] < 1
    assert part.numbers["passes"] == 1
    assert any("interrupted" in warning for warning in part.warnings)
    again = rendered(Stops(99, stopped.saved))
    assert "complete" not in again.numbers
    assert again.numbers == whole.numbers
    for name, values in whole.outputs["layers"].channels.items():
        assert values.tobytes() == again.outputs["layers"][name].tobytes()
        assert np.isfinite(values).all()
