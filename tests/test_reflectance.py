"""Albedo of a plane: the equations, noise, shadows that nothing explains, and disagreement about the light's scale."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, minimum_filter
from small_plates import CAMERA, EYE, VIEW, ground, lamp_and_sky

from pipeline.camera.lens import pixel_rays
from pipeline.conventions import CLIPPED, latlong_directions
from pipeline.light.environment import irradiance
from pipeline.transport import scale, shadows
from pipeline.transport.plate_texture import read_plate, shrunk, weights
from pipeline.transport.reflectance import fill_unseen, reflected_radiance, updated_brdf
from pipeline.types import Emitter, Raster
from stages import knobs, reflectance

NORMAL = np.array([0.0, 1, 0])
SKY = np.ones((32, 64, 3)) * [1.0, 1.2, 1.5]
SIZE = (CAMERA.height, CAMERA.width)


def where_seen() -> np.ndarray:
    """(H, W, 2) x and z [m] of the plane at the middle of each pixel."""
    row, column = np.divmod(np.arange(SIZE[0] * SIZE[1]), SIZE[1])
    way = pixel_rays(CAMERA, np.stack([column, row], -1) + 0.5) @ VIEW.world_from_camera[:3, :3].T
    return (EYE + way * (-EYE[1] / way[:, 1])[:, None])[:, [0, 2]].reshape(*SIZE, 2)


def smooth(at: np.ndarray) -> np.ndarray:
    """A smooth albedo (..., 3) of positions (..., 2)."""
    wave = np.sin(6 * at[..., 0]) * np.cos(5 * at[..., 1])
    return np.stack([0.5 + 0.2 * wave, 0.4 + 0.1 * wave, 0.3 - 0.1 * wave], -1)


def plate(albedo: np.ndarray, light: np.ndarray, variance: np.ndarray | None = None) -> Raster:
    rgb = albedo * light / np.pi
    noise = {} if variance is None else Raster.split(np.broadcast_to(variance, rgb.shape), "variance")
    return Raster({**Raster.split(rgb), **noise, "mask": np.zeros(SIZE, np.uint32)}, "acescg")


def solve(photograph: Raster, environment: np.ndarray = SKY, emitters: tuple[Emitter, ...] = (), **values):
    params = knobs.Reflectance(texture_px=values.pop("texture_px", 256), **values)
    light = Raster(Raster.split(environment), "acescg")
    return reflectance.compute(
        {"plate": photograph}, CAMERA, {"plate": VIEW}, light, list(emitters), ground(), [], [], params
    )  # fmt: skip


def texel_positions(size: int) -> np.ndarray:
    """(size, size, 2) x and z of the texels of `ground`: rows along x, columns along z."""
    steps = (np.arange(size) + 0.5) / size * 2 - 1
    return np.stack(np.meshgrid(steps, steps, indexing="ij"), -1)


def test_equations_6_to_8():
    light = np.array([2.0, 3, 4])
    rho = np.array([0.1, 0.2, 0.05])
    l_r1, l_r2 = (reflected_radiance(np.pi * one, light) for one in (rho, np.ones(3)))
    np.testing.assert_allclose(updated_brdf(l_r1, l_r2), rho)
    assert np.isnan(updated_brdf(np.ones(3), np.zeros(3))).all()


def test_fill_keeps_what_is_seen_and_stays_in_range():
    rng = np.random.default_rng(1)
    values = rng.uniform(0.2, 0.6, (33, 47, 3))
    weight = (rng.uniform(size=(33, 47)) < 0.1).astype(float)
    filled = fill_unseen(values, weight)
    assert np.array_equal(filled[weight == 1], values[weight == 1])
    assert filled.min() >= 0.2 - 1e-9
    assert filled.max() <= 0.6 + 1e-9
    assert np.all(fill_unseen(values, np.zeros_like(weight)) == 0)


def test_plane_under_distant_light_is_closed_form():
    """A smooth albedo is read back to the error of bilinear interpolation: a pixel is 4 to 9 mm, 0.1 % of the wave."""
    light = irradiance(SKY, NORMAL[None])[0]
    result = solve(plate(smooth(where_seen()), light))
    albedo = result.outputs["albedo"]
    known = minimum_filter(albedo["seen"], 5) == 1  # the outermost half pixel repeats its neighbour
    np.testing.assert_allclose(albedo.rgb()[known], smooth(texel_positions(256))[known], rtol=4e-3)
    assert result.outputs["surface"].model == "diffuse"
    assert result.outputs["local_proxies"] == []
    assert not result.warnings


def test_twice_the_exposure_is_the_same_albedo():
    light = irradiance(SKY, NORMAL[None])[0]
    one = solve(plate(smooth(where_seen()), light)).outputs["albedo"].rgb()
    two = solve(plate(smooth(where_seen()), 2 * light), 2 * SKY).outputs["albedo"].rgb()
    np.testing.assert_allclose(one, two, rtol=1e-5)


def test_clipped_pixels_are_not_read():
    light = irradiance(SKY, NORMAL[None])[0]
    photograph = plate(smooth(where_seen()), light)
    photograph.channels["R"][50:60, 70:90] = 50.0
    photograph.channels["mask"][50:60, 70:90] = CLIPPED
    albedo = solve(photograph).outputs["albedo"]
    assert albedo.rgb().max() < 0.75
    assert (albedo["seen"] == 0).any()


@pytest.mark.parametrize(("noise", "texture", "gain"), [(0.1, 0.0, 0.4), (0.1, 0.01, 0.4), (0.002, 0.1, 1.01)])
def test_noise_does_not_become_albedo(noise, texture, gain):
    """Relative noise and texture: the error against what the plate resolves falls below ``gain`` of the noise.

    A texel of 7.8 mm covers 1 to 2 pixels; a window of 7 holds 49, so a mean over it has 1/7 of the noise and the share
    kept by chance (spread of a sample variance over 49) 1/5: 0.4 leaves room for both. Detail above the noise stays.
    """
    rng = np.random.default_rng(0)
    light = irradiance(SKY, NORMAL[None])[0]
    detail = gaussian_filter(rng.normal(size=SIZE), 1.0)
    clean = plate((0.4 + 0.4 * texture / detail.std() * detail)[..., None] * np.ones(3), light)
    sigma = noise * 0.4 * light / np.pi
    noisy = plate(clean.rgb() * np.pi / light + noise * 0.4 * rng.normal(size=(*SIZE, 3)), light, sigma**2)
    shape = (256, 256)
    reading = read_plate(noisy, CAMERA, VIEW, ground(), shape)
    truth = read_plate(clean, CAMERA, VIEW, ground(), shape)
    known = truth.seen == 1
    before = np.sqrt(((reading.radiance - truth.radiance)[known] ** 2).mean())
    after = np.sqrt(((shrunk(reading)[0] - truth.radiance)[known] ** 2).mean())
    assert after < gain * before + 0.1 * texture * before
    # the stated variance is that of one pixel or less: bilinear reading averages up to four
    stated = np.sqrt(reading.variance[known].mean())
    assert before < 1.05 * stated < 2.5 * before


def test_weights_do_not_prefer_dark_pixels():
    """Poisson counts of mean 25: weighting each by its own 1 / count would read 4 % low."""
    counts = np.random.default_rng(0).poisson(25, (*SIZE, 3)).astype(float)
    weight = weights(counts, counts)[..., None]
    mean = (weight * counts).sum() / (3 * weight.sum())
    assert mean == pytest.approx(25, abs=4 * 5 / np.sqrt(counts.size))
    frames_disagree = counts.copy()
    frames_disagree[10, 10] *= 100
    assert weights(counts, frames_disagree)[10, 10] < 0.1 * weight.mean()


def lamp_emitter(environment: np.ndarray, towards: np.ndarray) -> Emitter:
    inside = latlong_directions(*environment.shape[:2]) @ towards > 0.99
    alone = irradiance(np.where(inside[..., None], environment, 0.0), np.stack([towards]))[0]
    return Emitter(
        name="lamp_1", direction=towards, solid_angle_sr=0.03, half_angle_rad=0.1, irradiance=alone,
        texels=np.flatnonzero(inside),
    )  # fmt: skip


TOWARDS = np.array([0.3, 0.8, 0.2]) / np.linalg.norm([0.3, 0.8, 0.2])
LAMP = lamp_and_sky(120.0, tuple(TOWARDS))


def wood(seed: int) -> np.ndarray:
    """(H, W, 3) streaks of 10 %."""
    rng = np.random.default_rng(seed)
    grain = gaussian_filter(rng.normal(size=SIZE), (1, 12)) + 0.5 * gaussian_filter(rng.normal(size=SIZE), (2, 2))
    return np.array([0.5, 0.36, 0.25]) * np.exp(0.1 * grain / grain.std())[..., None]


def disc(column: float, row: float, radius: float) -> np.ndarray:
    """(H, W, 1) 1 inside, with an edge of three pixels."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.clip((radius - np.hypot(x - column, y - row)) / 3 + 0.5, 0, 1)[..., None]


@pytest.mark.parametrize("seed", range(4))
def test_a_shadow_that_nothing_casts_is_masked_and_reported(seed):
    light = irradiance(LAMP, NORMAL[None])[0]
    lamp = lamp_emitter(LAMP, TOWARDS)
    ratio = np.exp(shadows.darkening([lamp], NORMAL, light)["lamp_1"])
    assert ratio.max() < 0.75
    shade = disc(60 + 12 * seed, 60, 18 + 2 * seed)
    truth = wood(seed)
    result = solve(plate(truth * (1 - shade * (1 - ratio)), light), LAMP, (lamp,))
    assert result.numbers["unexplained_shadow_fraction"] == pytest.approx((shade > 0.5).mean(), rel=0.9, abs=0.01)
    assert any("shadow of lamp_1" in warning for warning in result.warnings)
    # nothing of the shadow is left: what is seen has the colours of the wood
    albedo = result.outputs["albedo"]
    known = albedo["seen"] > 0.5
    assert np.quantile(albedo.rgb()[known], 0.001, axis=0) == pytest.approx(np.quantile(truth, 0.001, (0, 1)), rel=0.15)


@pytest.mark.parametrize("seed", range(6))
def test_paint_is_not_taken_for_a_shadow(seed):
    """Discs of other colours or other darkness than the hidden lamp would leave."""
    light = irradiance(LAMP, NORMAL[None])[0]
    lamp = lamp_emitter(LAMP, TOWARDS)
    ratio = np.exp(shadows.darkening([lamp], NORMAL, light)["lamp_1"])
    paint = [ratio**0.5, ratio**1.6, ratio[::-1], ratio * [1, 1, 0.7], np.full(3, ratio.mean()), 1 / ratio][seed]
    result = solve(plate(wood(seed) * (1 - disc(80, 60, 20) * (1 - paint)), light), LAMP, (lamp,))
    assert result.numbers["unexplained_shadow_fraction"] == 0


def test_scale_disagreement_names_factor_and_cause(saw):
    light = irradiance(SKY, NORMAL[None])[0]
    everywhere = solve(plate(2.5 * smooth(where_seen()), light))
    assert everywhere.numbers["map_factor"] == pytest.approx(2.5 * 0.7, rel=0.05)
    assert "exposure between plate and ball" in everywhere.warnings[0]
    error = abs(everywhere.numbers["map_factor"] / (2.5 * 0.7) - 1)
    saw("albedo.above_one", "degraded", error, said=everywhere.warnings[0])
    patch = solve(plate(smooth(where_seen()) * (1 + 3 * disc(80, 60, 14)), light))
    assert "highlight" in patch.warnings[0]
    below = solve(plate(smooth(where_seen()) - 0.35, light))
    assert "black level" in below.warnings[0]
    assert not solve(plate(smooth(where_seen()), light)).warnings


def test_a_clipped_lamp_is_named():
    light = irradiance(LAMP, NORMAL[None])[0]
    clipped = np.minimum(LAMP, 20.0)
    variance = np.where(LAMP > 20, clipped**2, 1e-8)
    share = scale.unsure_share(clipped, variance, NORMAL, irradiance(clipped, NORMAL[None])[0])
    assert share > scale.UNSURE
    found = scale.disagreement(np.full((100, 3), 1.4), np.zeros((100, 3)), share)
    assert "lamp's light is missing" in found.cause
    assert scale.unsure_share(LAMP, None, NORMAL, light) == 0


def test_gloss_taken_off_something_matt_is_named_and_black_level_is_not():
    """A tenth of the texels is a black board on a glossy ground: the lobe of 0.2 leaves it below zero."""
    albedo, sigma = np.full((100, 3), 0.4), np.full((100, 3), 1e-3)
    albedo[:10] = 0.03 - 0.2
    found = scale.disagreement(albedo, sigma, 0.0, albedo + 0.2)
    assert "something matt lies on the glossy ground" in found.cause
    assert found.below == pytest.approx(0.1)
    raw = np.where(albedo < 0, -0.05, albedo + 0.2)  # dark in the plate itself, whatever is taken off
    assert "black level" in scale.disagreement(albedo, sigma, 0.0, raw).cause
    assert "black level" in scale.disagreement(albedo, sigma, 0.0).cause


def test_uniform_model_is_the_median():
    light = irradiance(SKY, NORMAL[None])[0]
    albedo = solve(plate(smooth(where_seen()), light), model="uniform").outputs["albedo"].rgb()
    assert np.ptp(albedo, axis=(0, 1)).max() < 1e-6
