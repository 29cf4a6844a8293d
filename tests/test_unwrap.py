"""Ball to map: energy to rounding for any lamp, its law of variance by Monte Carlo, the rim, the blind cone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mirror_scene import Place, look_at, photograph, sky

from pipeline.conventions import (
    direction_from_latlong,
    invert_rigid,
    latlong_directions,
    latlong_solid_angles,
    transform_points,
)
from pipeline.light.environment import resize_environment
from pipeline.light.harmonics import sh9_irradiance, sh9_of_environment
from pipeline.probes import reflection
from pipeline.probes.area_sums import _stairs, _stairs_kernel, area_sums
from pipeline.probes.ball_surface import Surface
from pipeline.probes.finding import Found
from pipeline.probes.mirror_ball import EDGE_PX, usable_rim, view_map
from pipeline.probes.mirror_geometry import Mirror, corners, pixel_solid_angles, pixels_of, texel_directions
from pipeline.probes.observation import Grid
from pipeline.probes.sphere_fit import Height, SphereFit
from pipeline.probes.unwrap import displaced_variance, enlargement, footprint, unwrap
from pipeline.types import Camera, Raster, View

RADIUS = 0.04
NONE = np.zeros((3, 3))


def mirror_of(radius_px: float, distance_over_radius: float, rim: float = 0.97, off_axis: float = 0.1) -> Mirror:
    """A ball in a distorted picture that just holds it, the world turned by any rotation."""
    focal = radius_px / np.tan(np.arcsin(1 / distance_over_radius))
    axis = np.array([np.sin(off_axis), 0.05, np.cos(off_axis)])
    axis /= np.linalg.norm(axis)
    size = int(2.4 * radius_px) + 10
    distortion = np.array([-0.05, 0.01, 2e-4, -1e-4, 0])
    camera = Camera(width=size, height=size, fx=focal, fy=1.001 * focal, cx=0, cy=0, distortion=distortion)
    middle = size / 2 - focal * axis[:2] / axis[2]
    camera = camera.model_copy(update={"cx": middle[0], "cy": middle[1]})
    rotation, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    return Mirror(camera, rotation * np.linalg.det(rotation), axis * RADIUS * distance_over_radius, RADIUS, rim)


def ball_energy(mirror: Mirror, picture: np.ndarray) -> float:
    """Sum of L dw over the ball's pixels inside the rim."""
    return float((picture * pixel_solid_angles(mirror, slice(0, len(picture))).astype(float)).sum())


def map_energy(found, channel: int = 0) -> float:
    solid = latlong_solid_angles(*found.coverage.shape)
    return float((found.values[..., channel] * found.coverage.astype(float) * solid).sum())


# ---- geometry ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance_over_radius", [1.5, 8, 50])
def test_texels_are_looked_up_where_their_light_is_reflected(distance_over_radius):
    # table of the reflection: 1e-5 rad (its docstring), and the pixel's ray amplified by the ball
    mirror = mirror_of(200, distance_over_radius)
    row, column = np.arange(32) + 0.5, np.arange(64) + 0.5
    x, y, angle = pixels_of(mirror, row, column, 32, 64)
    seen = angle < np.arcsin(0.97)
    from pipeline.camera.lens import pixel_rays

    rays = pixel_rays(mirror.camera, np.stack([x[seen], y[seen]], -1))
    back = reflection.directions_from_rays(rays, mirror.centre, RADIUS) @ mirror.rotation
    assert np.abs(back - latlong_directions(32, 64)[seen]).max() < 2e-5
    blind = latlong_directions(32, 64) @ mirror.rotation.T @ mirror.axis > np.sqrt(1 - mirror.ratio**2)
    assert ((angle > np.pi / 2) == blind).all()


def test_gain_of_the_reflection_is_the_derivative():
    for ratio in (1 / 1.5, 1 / 8, 1e-3):
        sine, step = np.array([1e-3, 0.3, 0.7, 0.95]), 1e-6
        theta, rho = (lambda s, k=ratio: reflection.deviation(s, k)), (lambda s, k=ratio: np.arcsin(k * s))
        numeric = (np.cos(theta(sine + step)) - np.cos(theta(sine - step))) / (
            np.cos(rho(sine + step)) - np.cos(rho(sine - step))
        )
        # differences of cosines of 1e-3 rad: relative rounding 1e-16 / (1e-3 * 1e-6 * ratio^2)
        assert reflection.solid_angle_gain(sine**2, ratio)[1:] == pytest.approx(numeric[1:], rel=1e-3)


@pytest.mark.parametrize("distance_over_radius", [1.5, 8, 50])
def test_solid_angles_of_pixels_sum_to_the_seen_part_of_the_sphere(distance_over_radius, saw):
    mirror = mirror_of(120, distance_over_radius)
    total = pixel_solid_angles(mirror, slice(0, mirror.camera.height)).sum(dtype=float)
    end = reflection.deviation(np.array(0.97), mirror.ratio)
    # a jagged rim: half a pixel of error in each of 2 pi 116 rim pixels, independent, of gain 4 to 8 times the mean
    assert total == pytest.approx(2 * np.pi * (1 - np.cos(end)), rel=2e-3)
    saw("ball.rim", "exact", abs(total / (2 * np.pi * (1 - np.cos(end))) - 1))


# ---- energy --------------------------------------------------------------------------------------------------------


def lamp_pixels(mirror: Mirror, direction: np.ndarray) -> tuple[int, int] | None:
    """Row and column of the pixel that shows a world direction."""
    v, u = np.arccos(direction[1]) / np.pi, np.arctan2(direction[0], -direction[2]) / (2 * np.pi) % 1
    x, y, angle = pixels_of(mirror, np.array([v]), np.array([2 * u]), 1, 2)
    return (int(y[0, 0]), int(x[0, 0])) if angle[0, 0] < np.arcsin(mirror.rim) - 0.05 else None


def lamp_sine(mirror: Mirror, direction: np.ndarray) -> float:
    """Radius of the lamp's image as a fraction of the silhouette's."""
    theta = np.arccos(-(mirror.rotation @ direction @ mirror.axis) / np.linalg.norm(direction))
    return float(np.sin(reflection.incidence(np.array(theta), mirror.ratio)))


LAMPS = {
    "pole": (0.0, 1.0, 0.0), "nadir": (0.0, -1.0, 0.0), "seam": (0.001, 0.1, -1.0), "other": (0.5, 0.3, 0.6),
    "corner": (-0.7, -0.2, 0.1),
}  # fmt: skip


@pytest.mark.parametrize("distance_over_radius", [1.5, 4, 50])
@pytest.mark.parametrize("radius_px", [60, 250])
def test_lamps_of_one_pixel_keep_their_energy(distance_over_radius, radius_px, saw):
    # Sums are conserved to rounding (next test). Means take a pixel's solid angle as even over the pixel and texels as
    # polygons: 0.1 %, and the square of the solid angle's slope s / (1 - s^2) / radius, 7 % per px at 0.9 of 60 px.
    mirror = mirror_of(radius_px, distance_over_radius)
    base = np.full((mirror.camera.height, mirror.camera.width), 1e-3, np.float32)
    valid, tested = np.ones_like(base), 0
    for direction in LAMPS.values():
        pixel = lamp_pixels(mirror, np.array(direction) / np.linalg.norm(direction))
        if pixel is None:
            continue
        picture = base.copy()
        picture[pixel] = 1e5
        found = unwrap(valid, [picture], mirror, 128, 256, 1)
        sine = lamp_sine(mirror, np.array(direction))
        bound = 1e-3 + (sine / (1 - sine**2) / radius_px) ** 2
        assert map_energy(found) == pytest.approx(ball_energy(mirror, picture), rel=bound)
        if (distance_over_radius, radius_px) == (1.5, 250):
            saw("ball.near", "exact", abs(map_energy(found) / ball_energy(mirror, picture) - 1))
        tested += 1
    assert tested >= 2


@pytest.mark.parametrize("distance_over_radius", [1.5, 8, 50, 1e4])
@pytest.mark.parametrize("radius_px", [25, 90, 400])
def test_sums_over_texels_are_sums_over_pixels(distance_over_radius, radius_px):
    mirror = mirror_of(radius_px, distance_over_radius)
    rng = np.random.default_rng(0)
    picture = rng.gamma(0.05, 1.0, (mirror.camera.height, mirror.camera.width)).astype(np.float32) ** 3
    sums = area_sums([picture], mirror, corners(mirror, 64, 128))
    assert -sums[sums < 0].sum() < 4e-3 * sums.sum()  # stairs that cross near the rim; measured 0.2 % of such light
    # texels are float32: 6e-8 each
    assert sums.sum(dtype=float) == pytest.approx(ball_energy(mirror, picture), rel=1e-6)


def test_compiled_stairs_are_their_source():
    """Bit by bit, within the table and beyond it; what has no place becomes no number instead of a wild read."""
    random = np.random.default_rng(0)
    table = random.random((12, 17, 4)).cumsum(0).cumsum(1)
    edges = random.uniform(-3, 20, (4, 60))
    edges[1, 7] = np.nan
    beyond, found = np.arange(60) % 9 == 0, np.zeros((2, 60, 4))
    for run, total in zip((_stairs, _stairs_kernel()), found, strict=True):
        run(table, *edges, beyond, 2.0, total)
    np.testing.assert_array_equal(*found)
    assert np.isnan(found[0, 7]).all()
    assert not found[0, beyond].any()


def test_enlarged_pixels_keep_their_energy():
    # a tent of one pixel over the solid angle per pixel, which grows as d^-1/2 at d px under the silhouette: at 0.9 of
    # 60 px, 1/12 * 0.75 / 6^2 of it: 0.2 % there, less inside; and the texel's 0.1 %.
    mirror = mirror_of(60, 8)
    valid = np.ones((mirror.camera.height, mirror.camera.width), np.float32)
    assert enlargement(mirror, 512) > 1
    for direction in LAMPS.values():
        pixel = lamp_pixels(mirror, np.array(direction) / np.linalg.norm(direction))
        if pixel is not None:
            picture = np.zeros_like(valid)
            picture[pixel] = 1e5
            found = unwrap(valid, [picture], mirror, 256, 512)
            assert map_energy(found) == pytest.approx(ball_energy(mirror, picture), rel=3e-3)


def test_constant_light_is_constant_and_its_coverage_is_the_seen_fraction():
    mirror = mirror_of(200, 6)
    one = np.ones((mirror.camera.height, mirror.camera.width), np.float32)
    found = unwrap(one, [0.8 * one], mirror, 128, 256)
    assert found.values[found.coverage > 0] == pytest.approx(0.8, rel=1e-5)
    theta = np.arccos(np.clip(-(latlong_directions(128, 256) @ mirror.rotation.T @ mirror.axis), -1, 1))
    end = reflection.deviation(np.array(mirror.rim), mirror.ratio)
    # 4 px inside the cut the solid angle changes by 5 % from pixel to pixel, of which texels see parts (measured 0.3 %)
    inner = reflection.deviation(np.array(mirror.rim - 4 / 200), mirror.ratio)
    covered = found.coverage[theta < inner]
    assert np.percentile(np.abs(covered - 1), 99) < 5e-3
    assert covered.min() > 0.98  # single texels that are smaller than a pixel
    assert (found.coverage[theta > end + 2 * np.pi / 128] == 0).all()
    assert (found.values[found.coverage == 0] == 0).all()


def test_invalid_pixels_lower_coverage_and_not_radiance():
    mirror = mirror_of(100, 8)
    valid = np.ones((mirror.camera.height, mirror.camera.width), np.float32)
    valid[::3, ::2] = 0
    found = unwrap(valid, [2 * valid], mirror, 32, 64)
    seen = found.coverage > 0
    assert found.values[seen] == pytest.approx(2, rel=1e-5)
    assert np.median(found.coverage[seen]) == pytest.approx(5 / 6, rel=0.02)


def test_ball_cut_by_the_frame_covers_what_is_left():
    mirror = mirror_of(100, 8)
    camera = mirror.camera.model_copy(update={"cx": mirror.camera.cx - 80})
    cut = dataclasses.replace(mirror, camera=camera)
    one = np.ones((camera.height, camera.width), np.float32)
    found = unwrap(one, [one], cut, 32, 64)
    assert map_energy(found) == pytest.approx(ball_energy(cut, one), rel=5e-3)  # jags of rim and frame
    assert found.values[found.coverage > 0] == pytest.approx(1, rel=1e-5)
    assert 0.3 < (found.coverage * latlong_solid_angles(32, 64)).sum() / (4 * np.pi) < 0.9


def test_same_bytes_whatever_the_threads(monkeypatch):
    mirror = mirror_of(150, 8)
    picture = np.random.default_rng(0).random((mirror.camera.height, mirror.camera.width), np.float32)
    edges = corners(mirror, 64, 128)
    first = area_sums([picture], mirror, edges)
    monkeypatch.setattr("pipeline.probes.area_sums.WORKERS", 1)
    assert (area_sums([picture], mirror, edges) == first).all()


def test_map_of_a_ray_traced_ball_is_the_room():
    place = Place(sky([], 0.4), reflectance=1.0, ball=(0.0, 0.04, 0.0))
    pose = look_at((0.2, 0.3, 0.3), (0, 0.04, 0))
    camera = Camera(
        width=240, height=240, fx=1000, fy=1002, cx=121, cy=119, distortion=np.array([-0.05, 0.01, 0, 0, 0])
    )
    picture = photograph(place, camera, pose, 2)
    mirror = Mirror(
        camera, invert_rigid(pose)[:3, :3], transform_points(invert_rigid(pose), np.array(place.ball)), RADIUS, 0.97
    )
    one = np.ones(picture.shape[:2], np.float32)
    found = unwrap(one, [np.float32(picture[..., i]) for i in range(3)], mirror, 64, 128)
    w = latlong_directions(256, 512)
    truth = resize_environment(
        place.radiance(np.zeros((w.size // 3, 3)), w.reshape(-1, 3)).reshape(256, 512, 3), 64, 128
    )
    inner = found.coverage > 0.999
    error = np.abs(found.values[inner] / truth[inner] - 1)
    assert np.median(error) < 5e-4
    assert np.percentile(error, 99) < 0.02  # pixels of 5 degrees near the rim
    seen = found.coverage[..., None]
    normals = direction_from_latlong(np.arange(20) * 0.618 % 1, np.arccos(1 - (np.arange(20) + 0.5) / 10) / np.pi)
    one, two = (sh9_irradiance(sh9_of_environment(seen * m), normals) for m in (found.values, truth))
    assert np.abs(one / two - 1).max() < 0.01  # issue: 1 % from 100 px on, lights split; measured 0.1 %


# ---- variance ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("radius_px", "width"), [(40, 256), (120, 128), (250, 256)])
def test_photon_noise_of_texels(radius_px, width, monkeypatch):
    monkeypatch.setattr("pipeline.probes.unwrap.LEAST_WIDTH", width)  # quicker; the noise is the same
    mirror = mirror_of(radius_px, 8)
    shape = (mirror.camera.height, mirror.camera.width)
    rng = np.random.default_rng(1)
    draws = [rng.normal(1, 0.1, shape).astype(np.float32) for _ in range(48)]
    found = unwrap(np.ones(shape, np.float32), draws, mirror, width // 2, width)
    inner = found.coverage > 0.99
    ratio = found.values[inner].var(1, ddof=1) / (0.01 * found.spread[inner])
    for low in (0.0, 0.5):  # by size of texel, so that poles and rim do not hide in the mean
        some = (found.pixels[inner] > low * found.pixels[inner].max()) & (
            found.pixels[inner] < (low + 0.5) * found.pixels.max()
        )
        assert 0.8 < ratio[some].mean() < 1.25  # 48 draws: 0.2 a texel, over hundreds of texels 0.01
    assert (np.abs(ratio - 1) < 0.75).mean() > 0.9


def test_direction_noise_of_texels(monkeypatch):
    """Fits and poses drawn from their covariance: scatter of texels over what the fit's covariance predicts."""
    monkeypatch.setattr("pipeline.probes.unwrap.LEAST_WIDTH", 128)
    mirror = mirror_of(120, 6, 0.95)
    rng = np.random.default_rng(2)
    centre_covariance = np.diag([4e-5, 3e-5, 2e-4]) ** 2
    turn_covariance = np.diag([1e-3, 2e-3, 1.5e-3]) ** 2
    w = latlong_directions(256, 512) @ mirror.rotation.T
    picture = _picture(mirror, lambda d: 1 + 0.5 * np.sin(3 * d[..., 0]) * np.cos(2 * d[..., 1]) + 0.3 * d[..., 2])
    one, maps = np.ones_like(picture), []
    for _ in range(60):
        turn = rng.normal(size=3) * np.sqrt(np.diag(turn_covariance))
        skew = np.cross(np.eye(3), turn)
        centre = mirror.centre + rng.normal(size=3) * np.sqrt(np.diag(centre_covariance))
        drawn = dataclasses.replace(mirror, centre=centre, rotation=mirror.rotation @ (np.eye(3) + skew))
        maps.append(unwrap(one, [picture], drawn, 64, 128).values[..., 0])
    nominal = unwrap(one, [picture], mirror, 64, 128)
    _, direction = texel_directions(mirror, 64, 128, centre_covariance, turn_covariance)
    predicted = displaced_variance(nominal.values, direction, nominal.coverage)[..., 0]
    theta = np.arccos(-(resize_environment(w, 64, 128) @ mirror.axis))
    bulk = (nominal.coverage > 0.99) & (theta < 2.0) & (predicted > np.percentile(predicted, 20))
    ratio = np.var(maps, 0, ddof=1)[bulk] / predicted[bulk]
    assert 0.8 < np.median(ratio) < 1.25  # texels share six numbers: 60 draws of a variance, 0.18 each
    assert 0.8 < np.mean(ratio) < 1.25


def _picture(mirror: Mirror, light) -> np.ndarray:
    from pipeline.camera.lens import pixel_rays

    y, x = np.mgrid[: mirror.camera.height, : mirror.camera.width] + 0.5
    rays = pixel_rays(mirror.camera, np.stack([x.ravel(), y.ravel()], -1))
    w = reflection.directions_from_rays(rays, mirror.centre, RADIUS).reshape(*x.shape, 3)
    return np.where(np.isfinite(w[..., 0]), light(np.nan_to_num(w)), 0).astype(np.float32)


def test_covariance_of_directions_is_that_of_the_reflection():
    mirror, step = mirror_of(100, 4), 1e-7
    w = latlong_directions(16, 32)
    rays, sine = reflection.rays_from_directions((w @ mirror.rotation.T).reshape(-1, 3), -mirror.axis, mirror.ratio)
    for axis in np.eye(3):
        moved = reflection.directions_from_rays(rays, mirror.centre + step * axis, RADIUS) @ mirror.rotation
        shift = np.linalg.norm(moved.reshape(w.shape) - w, axis=-1) / step
        found, k = texel_directions(mirror, 16, 32, np.outer(axis, axis), NONE)
        good = np.isfinite(found) & (found < 0.97)
        assert found[good] == pytest.approx(sine.reshape(16, 32)[good], abs=1e-5)
        assert np.sqrt(k[..., 0] + k[..., 1])[good] == pytest.approx(
            shift[good], rel=2e-3, abs=2e-3 * shift[good].max()
        )


def test_footprint_of_a_turned_texel():
    # exact for wide texels: 1 / area; within KERNEL_FIT's 6 %
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    grid = np.stack(np.meshgrid([0, 12.0], [0, 9.0]), -1) @ turn.T
    pixels, spread = footprint(grid[..., 0], grid[..., 1], 1 / 12)
    assert pixels[0, 0] == pytest.approx(108, rel=1e-6)
    assert spread[0, 0] == pytest.approx(1 / 108, rel=0.12)


# ---- rim and view --------------------------------------------------------------------------------------------------


def fit_of(radius_px: float, sigma_px: float, distance_over_radius: float = 8) -> SphereFit:
    sigma = sigma_px * RADIUS / radius_px
    centre = np.array([0, 0, RADIUS * distance_over_radius])
    return SphereFit(centre, np.diag([sigma, sigma, sigma]) ** 2, 0.1, 300, radius_px, 0.3, 1.0, 5.0, 1.0)


def test_rim_moves_out_with_the_ball_and_in_with_its_uncertainty():
    sharp = [usable_rim(fit_of(r, 0.02), RADIUS) for r in (30, 100, 500, 1500)]
    assert (np.diff(sharp) > 0).all()
    assert sharp[1] == pytest.approx(1 - (EDGE_PX + 0.06) / 100, abs=5e-3)  # or the half pixel's direction
    assert usable_rim(fit_of(100, 1.0), RADIUS) < sharp[1] - 0.02


def test_view_marks_the_blind_cone_and_invents_nothing_there(saw):
    fit = fit_of(90, 0.05)
    focal = 90 / np.tan(np.arcsin(1 / 8))
    mirror = Mirror(Camera(width=260, height=240, fx=focal, fy=focal, cx=130, cy=120), np.eye(3), fit.centre, RADIUS, 1)
    picture = _picture(mirror, lambda d: 1 + 0.3 * d[..., 0])[..., None] * np.ones(3, np.float32)
    layers = Raster.split(picture) | Raster.split(1e-4 * picture, "variance")
    photo = Raster(layers | {"mask": np.zeros(picture.shape[:2], np.uint32)}, "acescg")
    view = View(world_from_camera=np.eye(4), covariance=1e-8 * np.eye(6), route="given", rms_px=0.1, points=20)
    found = Found(fit, fit, Height(np.array([0.0, -1.0, 0.0]), 0.0, 1e-4), fit.centre)
    got = view_map(photo, mirror.camera, view, found, RADIUS, Surface(np.full(3, 0.5), np.full(3, 0.02)), Grid(128))
    w = latlong_directions(64, 128)
    end = reflection.deviation(np.array(usable_rim(fit, RADIUS)), 1 / 8)
    unseen = w[..., 2] > -np.cos(end + 0.08)
    saw("ball.blind_cone", "degraded", np.count_nonzero(got.coverage[unseen]), said="coverage and weight of zero")
    assert (got.weight[unseen] == 0).all()
    assert (got.rgb[unseen] == 0).all()
    seen = got.coverage > 0.999
    assert np.median(np.abs(got.rgb[seen][:, 1] / (2 + 0.6 * w[seen][:, 0]) - 1)) < 1e-3
    assert (got.variance[seen] > 0).all()
    blind = reflection.blind_half_angle(1 / 8)
    share = 1 - (got.coverage * latlong_solid_angles(64, 128)).sum() / (4 * np.pi)
    assert share > 0.5 * (1 - np.cos(blind))
