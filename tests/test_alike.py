"""Which errors of texels are alike: the sigma of a light's flux against the truth of lamps photographed by a mosaic."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from mirror_scene import Lamp, Place, look_at, photograph, sky

from pipeline.conventions import invert_rigid, latlong_directions, latlong_solid_angles, transform_points
from pipeline.image.demosaic import Method, demosaic, demosaic_variance
from pipeline.light import alike
from pipeline.light.emitters import lights
from pipeline.light.environment import SCALE_SIGMA
from pipeline.probes.ball_surface import Surface
from pipeline.probes.combine import alike_deg
from pipeline.probes.finding import Found
from pipeline.probes.mirror_ball import view_map
from pipeline.probes.observation import Grid
from pipeline.probes.sphere_fit import Height, SphereFit
from pipeline.types import Camera, Raster, View

RADIUS, CONTRAST, RADIANCE = 0.04, 0.4, 300.0
BLUR_PX = 0.58  # of a lens besides the pixel's box: 0.65 px together


def map_of(rgb: np.ndarray, sigma: np.ndarray | float, attributes: dict, **channels: np.ndarray) -> Raster:
    variance = np.broadcast_to(np.square(sigma), rgb.shape)
    return Raster({**Raster.split(rgb), **Raster.split(variance, "variance"), **channels}, "acescg", attributes)


def square_lamp() -> tuple[np.ndarray, np.ndarray]:
    """A map (256, 512, 3) with 16 bright texels in one corner of its cells, and these."""
    rgb = np.full((256, 512, 3), 0.1)
    rgb[100:104, :4] = 50.0
    return rgb, np.flatnonzero(rgb[..., 0].ravel() > 1)


def flux_of(rgb: np.ndarray, texels: np.ndarray, direction: np.ndarray) -> np.ndarray:
    weight = latlong_solid_angles(*rgb.shape[:2]) * np.maximum(latlong_directions(*rgb.shape[:2]) @ direction, 0)
    return (weight[..., None] * rgb).reshape(-1, 3)[texels].sum(0)


def test_noise_is_alike_within_a_pixel_and_a_displacement_cancels_about_a_lamp():
    rgb, texels = square_lamp()
    direction = latlong_directions(256, 512)[102, 2]
    flux = flux_of(rgb, texels, direction)
    fine = map_of(rgb, 0.1 * rgb, {alike.ALIKE: "0.7"})  # pixels of one texel
    lamp = (latlong_solid_angles(256, 512)[..., None] * rgb) * (rgb > 1)
    noise, sampled = 0.1 / 4, alike.sampling_sigma(fine, lamp)
    # About an even lamp slopes point inwards all round: of 16 errors, those of one side undo those of the other.
    assert alike.displaced_sums(0.1 * lamp, rgb) == pytest.approx(np.zeros((2, 3)), abs=0.01 * 0.1 * lamp.sum() / 3)
    assert alike.flux_sigma(fine, texels, direction) == pytest.approx(np.hypot(noise, sampled) * flux, rel=0.03)
    one = alike.flux_sigma(map_of(rgb, 0.1 * rgb, {alike.ALIKE: "12"}), texels, direction)  # two pixels of six rows
    sampled = alike.sampling_sigma(map_of(rgb, 0, {alike.ALIKE: "12"}), lamp)
    assert one == pytest.approx(flux * np.hypot(0.1 / np.sqrt(2), sampled), rel=1e-3)
    # What views disagree by about a lamp is displacement and sampling: its sum takes the variance that was not raised.
    twice = map_of(rgb, 0.2 * rgb, {alike.ALIKE: "12"}, **{alike.RAISED: np.full((256, 512), 4.0)})
    assert alike.flux_sigma(twice, texels, direction) == pytest.approx(one)


def test_half_a_lamp_errs_by_its_displacement():
    """The flux of a smooth lamp's one half, moved by d, is off by d times what lies on the line that divides it."""
    directions = latlong_directions(256, 512)
    east = np.arctan2(directions[..., 0], -directions[..., 2])
    rgb = np.repeat(np.exp(-0.5 * ((east**2 + np.arcsin(directions[..., 1]) ** 2) / 0.1**2))[..., None], 3, -1)
    solid = latlong_solid_angles(256, 512)[..., None]
    step = 2 * np.pi / 512  # of one column, on the equator
    slopes = [(np.roll(rgb, 1, axis) - np.roll(rgb, -1, axis)) / 2 for axis in (0, 1)]
    sigma = np.hypot(*slopes)  # of a displacement by one texel along each axis
    half = east[..., None] > 0
    moved = alike.displaced_sums(solid * sigma * half, rgb)
    line = rgb[:, :2].mean(1).sum(0) * np.pi / 256 * step
    assert np.abs(moved[0]) == pytest.approx(line, rel=0.03)  # a texel is a twelfth of the lamp's width
    assert np.abs(alike.displaced_sums(solid * sigma, rgb)) == pytest.approx(np.zeros((2, 3)), abs=1e-3 * line[0])


def test_what_all_share_and_what_was_recovered_add_without_root():
    rgb, texels = square_lamp()
    direction = latlong_directions(256, 512)[102, 2]
    flux = flux_of(rgb, texels, direction)
    alone = {SCALE_SIGMA: "0.03 0.02 0.01"}
    shared = np.array([0.03, 0.02, 0.01])
    only_scale = alike.flux_sigma(map_of(rgb, shared * rgb, alone), texels, direction)
    assert only_scale == pytest.approx(shared * flux, rel=1e-6)
    told = {"recovered": (rgb[..., 0] > 1).astype(float)}
    recovered = alike.flux_sigma(map_of(rgb, 0.1 * rgb, alone, **told), texels, direction)
    assert recovered == pytest.approx(0.1 * flux, rel=1e-6)
    nothing = Raster(Raster.split(rgb), "acescg", alone)
    assert alike.flux_sigma(nothing, texels, direction) == pytest.approx(np.zeros(3))


def test_cells_hold_every_texel_once_and_are_about_square():
    weight = latlong_solid_angles(64, 128)[..., None]
    for rows in (1, 3, 7, 64):
        assert alike.cell_sums(weight, rows).sum() == pytest.approx(4 * np.pi)
    inner = np.sort(alike.cell_sums(weight, 4)[:, 0])
    assert np.median(inner) == pytest.approx((4 * np.pi / 64) ** 2, rel=0.1)


def shot(radius_px: int, half_angle: float, seed: int, method: Method) -> tuple[Raster, list[np.ndarray]]:
    """The map of a ball of ``radius_px`` under seven lamps, through lens and RGGB mosaic; and their directions."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(seed)
    pose, centre = look_at((0.2, 0.3, 0.3), (0, RADIUS, 0)), np.array([0, RADIUS, 0.0])
    away = (pose[:3, 3] - centre) / np.linalg.norm(pose[:3, 3] - centre)
    found: list[np.ndarray] = []
    while len(found) < 7:
        one = random.normal(size=3)
        one /= np.linalg.norm(one)
        if one @ away > -0.5 and all(one @ other < np.cos(0.5) for other in found):
            found.append(one)
    focal = radius_px / np.tan(np.arcsin(RADIUS / np.linalg.norm(pose[:3, 3] - centre)))
    size = int(2.2 * radius_px) + 10
    middle = size / 2 + random.random(2)
    camera = Camera(width=size, height=size, fx=focal, fy=focal, cx=middle[0], cy=middle[1])
    place = Place(sky([Lamp(tuple(d), half_angle, RADIANCE) for d in found], CONTRAST), reflectance=1.0)
    picture = gaussian_filter(photograph(place, camera, pose, 5), (BLUR_PX, BLUR_PX, 0))
    row, column = np.mgrid[:size, :size] % 2
    mosaic = np.take_along_axis(picture, (row + column)[..., None], -1)[..., 0].astype(np.float32)
    rgb, variance = demosaic(mosaic, "RGGB", method), demosaic_variance(1e-5 * mosaic, "RGGB", method)
    layers = {**Raster.split(rgb), **Raster.split(variance, "variance"), "mask": np.zeros(rgb.shape[:2], np.uint32)}
    fit = SphereFit(
        centre=transform_points(invert_rigid(pose), centre), covariance=(0.02 * RADIUS / radius_px) ** 2 * np.eye(3),
        rms_px=0.05, points=400, radius_px=float(radius_px), blur_px=0.6, support=1.0, contrast=1.0, visible=1.0,
    )  # fmt: skip
    view = View(world_from_camera=pose, covariance=1e-10 * np.eye(6), route="given", rms_px=0.1, points=20)
    ball = Found(fit, fit, Height(np.array([0, -1.0, 0]), 0.0, 1e-4), centre)
    seen = view_map(Raster(layers, "acescg"), camera, view, ball, RADIUS, Surface(np.ones(3), np.zeros(3)), Grid(512))
    return map_of(seen.rgb, np.sqrt(seen.variance), {alike.ALIKE: str(alike_deg([seen]))}), found


@functools.cache
def errors(radius_px: int, half_angle_deg: float, method: Method, seeds: int = 2) -> np.ndarray:
    """Relative errors of lamps' irradiance over their stated sigma, (N, 3), and the median of that sigma."""
    half_angle, rest, rows = np.radians(half_angle_deg), sky([], CONTRAST), []
    for seed in range(seeds):
        seen, lamps = shot(radius_px, half_angle, seed, method)
        ways = latlong_directions(*seen.shape).reshape(-1, 3)
        patches = lights(seen.rgb(), 0.005, np.radians(10))[0]
        for direction in lamps:
            near = [patch for patch in patches if patch.direction @ direction > np.cos(half_angle + 0.03)]
            if len(near) != 1:
                continue
            (patch,) = near
            under = np.zeros((*seen.shape, 3))
            under.reshape(-1, 3)[patch.texels] = rest(ways[patch.texels])
            true = flux_of(under, patch.texels, patch.direction)
            true = true + (RADIANCE - rest(direction[None])[0]) * np.pi * np.sin(half_angle) ** 2
            rows.append((patch.irradiance - true) / alike.flux_sigma(seen, patch.texels, patch.direction))
    return np.array(rows)


@pytest.mark.parametrize(("radius_px", "half_angle_deg"), [(60, 4.0), (120, 2.0)])
def test_flux_of_a_lamp_is_off_by_what_it_states(radius_px, half_angle_deg):
    """Lamps of 20 pixels, lens and pixel 0.65 px together, in the middle of what the law is for.

    Measured over 14 lamps each, rms of error over sigma: 1.02 and 1.02; over the law's own lamps at this softness 1.2
    (`benchmarks.sampled_lamps`). Red and blue err together, so 28 independent numbers: an rms scatters by a factor of
    1 / sqrt(56) = 0.13, twice as much for tails as heavy as these. 1.0 less two of them, 1.2 and two more.
    """
    z = errors(radius_px, half_angle_deg, "bilinear")
    assert len(z) >= 10
    assert 0.5 < np.sqrt((z**2).mean()) < 1.8
    assert (np.abs(z) < 2).mean() > 0.9


def off_by_photosites(area_px: float, soft_px: float) -> tuple[np.ndarray, float]:
    """Relative errors (16, 16) of a white disc's light by every other photosite of every other row, and its pixels.

    ``soft_px``: lens and pixel. A photosite is a pixel's whole area, which is in the softness; phases go in 1/8 px.
    """
    from scipy.ndimage import gaussian_filter

    fine, period, cells = 8, 16, 16
    y, x = np.mgrid[: period * cells, : period * cells] - (period * cells - 1) / 2
    disc = (np.hypot(x, y) < fine * np.sqrt(area_px / np.pi)).astype(float)
    picture = gaussian_filter(disc, fine * soft_px)
    sums = picture.reshape(cells, period, cells, period).sum((0, 2))
    return sums / sums.mean() - 1, picture.sum() ** 2 / (picture**2).sum() / fine**2


@pytest.mark.parametrize("area_px", [20, 40, 80, 160])
def test_the_law_falls_with_the_area_as_photosites_sample_a_disc(area_px):
    """A white disc's own sampling, without what colours that mix add to it: less than stated, at the sharpest lens too.

    Of nine discs over an octave of area, rms over all phases. Measured at 0.55 px: 0.69 to 0.86 of what is stated, over
    four octaves; at 0.85 px 0.09 to 0.12. Matrices of the law's cameras multiply the error of a neutral lamp's red and
    blue by 1.0 to 1.3, of a warm one's blue by more: so at least half, and no more than all.
    """
    over = {}
    for soft_px in (0.55, 0.85):
        discs = [off_by_photosites(area, soft_px) for area in np.geomspace(area_px, 2 * area_px, 9)]
        over[soft_px] = np.sqrt(np.mean([(error / alike.sampled(pixels)[0]) ** 2 for error, pixels in discs]))
    assert 0.5 < over[0.55] < 1
    assert over[0.85] < 0.2


def test_sampling_counts_the_pixels_that_a_lamp_covers():
    rgb, texels = square_lamp()
    alone = np.zeros_like(rgb)
    alone.reshape(-1, 3)[texels] = 1.0
    weight = latlong_solid_angles(256, 512)[..., None]
    pixel = float(np.degrees(np.sqrt(weight.reshape(-1)[texels].sum() / 10)))  # the lamp covers ten
    told = map_of(rgb, 0.0, {alike.ALIKE: repr(alike.ALIKE_PX * pixel)})
    assert alike.sampling_sigma(told, weight * alone) == pytest.approx(alike.sampled(10.0), rel=1e-3)
    both = map_of(rgb, 0.0, {alike.ALIKE: repr(alike.ALIKE_PX * pixel), alike.ALIKE_VIEWS: "2"})
    assert alike.sampling_sigma(both, weight * alone) == pytest.approx(alike.sampled(10.0) / np.sqrt(2), rel=1e-3)
    assert not alike.sampling_sigma(map_of(rgb, 0.0, {}), weight * alone).any()


def test_a_lamp_without_green_covers_what_a_white_one_does():
    """Noise in its empty channel covers next to nothing: by that a red lamp would be unsure by all of its light."""
    rgb, texels = square_lamp()
    alone = np.zeros(rgb.shape)
    alone.reshape(-1, 3)[texels] = rgb.reshape(-1, 3)[texels]
    light = latlong_solid_angles(*rgb.shape[:2])[..., None] * alone
    told = map_of(rgb, 0.0, {alike.ALIKE: "2"})
    white = alike.sampling_sigma(told, light)
    assert 0 < white.max() < 0.5
    red = light * [1.0, 0.0, 0.01]
    assert alike.sampling_sigma(told, red) == pytest.approx(white)
    red[..., 1] = 1e-3 * light[..., 0] * np.random.default_rng(0).normal(size=rgb.shape[:2])
    assert alike.sampling_sigma(told, red) == pytest.approx(white)
    assert alike.sampling_sigma(told, 0 * light).max() == 1  # nothing there
