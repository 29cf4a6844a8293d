"""The ladder diffuse -> rough -> metallic on path-traced plates whose truth is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from small_plates import CAMERA, VIEW, ground, lamp_and_sky, photograph, texture

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import irradiance
from pipeline.transport import specular
from pipeline.transport.patches import lights_of
from pipeline.types import Raster
from stages import knobs, reflectance

LAMP = lamp_and_sky(400.0, (0.05, 0.62, -0.75))  # its mirror image lies in the middle of the plate


def solve(plate: Raster, environment: np.ndarray = LAMP, gloss: str = "auto"):
    light = Raster(Raster.split(environment), "acescg")
    params = knobs.Reflectance(texture_px=256, gloss=gloss)
    return reflectance.compute(
        {"plate": plate}, CAMERA, {"plate": VIEW}, light, [], ground(), [], [], params
    )  # fmt: skip


def base_error(result, truth: np.ndarray) -> float:
    """Median relative error of the base colour over 16 x 16 means: there the plate's noise of 5 % is 0.3 %."""
    albedo = result.outputs["albedo"]
    seen = albedo["seen"].reshape(16, 16, 16, 16).min((1, 3)) > 0.9
    found, true = (a.reshape(16, 16, 16, 16, 3).mean((1, 3))[seen] for a in (albedo.rgb(), truth))
    return float(np.median(np.abs(found / true - 1)))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_textured_matte_plane_stays_diffuse(seed):
    truth = texture(seed)
    result = solve(photograph(truth, LAMP, seed=seed))
    assert result.outputs["surface"].model == "diffuse"
    assert base_error(result, truth) < 0.015
    rough = result.outputs["surface"].scores[1]
    assert rough["gain"] < 0


@pytest.mark.parametrize("lamp", [400.0, 0.0])
@pytest.mark.parametrize("kind", ["blobs", "patchwork"])
def test_coarse_patterns_are_not_taken_for_gloss(kind, lamp):
    """Patterns as coarse as a lobe, under a lamp and under a bare sky; noise 0.3 %."""
    environment = lamp_and_sky(lamp, (0.05, 0.62, -0.75))
    rng = np.random.default_rng(5)
    size = (CAMERA.height, CAMERA.width)
    for _ in range(2):
        blobs = gaussian_filter(rng.normal(size=size), 25)
        albedo = np.array([0.4, 0.35, 0.3]) * np.exp(0.3 * blobs / blobs.std())[..., None]
        if kind == "patchwork":
            albedo = rng.uniform(0.1, 0.8, (6, 8, 3)).repeat(20, 0).repeat(20, 1)
        radiance = albedo * irradiance(environment, np.array([[0.0, 1, 0]]))[0] / np.pi
        noisy = radiance * (1 + 0.003 * rng.normal(size=radiance.shape))
        variance = Raster.split((0.003 * radiance) ** 2, "variance")
        plate = Raster({**Raster.split(noisy), **variance, "mask": np.zeros(size, np.uint32)}, "acescg")
        assert solve(plate, environment).outputs["surface"].model == "diffuse"


@pytest.mark.parametrize(("roughness", "f0"), [(0.3, 0.04), (0.5, 0.06)])
def test_a_glossy_plane_climbs_once(roughness, f0):
    """Roughness within 0.03 and f0 within 0.01; the lamp's lobe is 40 % of the radiance at roughness 0.3."""
    truth = texture(2)
    result = solve(photograph(truth, LAMP, {"roughness": roughness, "f0": f0}, seed=2))
    surface = result.outputs["surface"]
    assert surface.model == "rough"
    assert surface.roughness == pytest.approx(roughness, abs=0.03)
    assert surface.f0 == pytest.approx(f0, abs=0.01)
    assert surface.scores[1]["sigmas"] > specular.MIN_SIGMAS
    assert base_error(result, truth) < 0.03  # the lobe is taken off: without it the highlight would be 60 % too bright


def test_a_metal_plane_climbs_to_the_top():
    truth = texture(3, (0.8, 0.6, 0.4), 0.05)
    result = solve(photograph(truth, LAMP, {"roughness": 0.3, "metallic": 1.0}, seed=3))
    surface = result.outputs["surface"]
    assert surface.model == "metallic"
    assert surface.metallic == 1
    assert surface.roughness == pytest.approx(0.3, abs=0.03)
    assert base_error(result, truth) < 0.05


def test_gloss_is_forced_in_and_out():
    """On a glossy plane: forced in it is the one that evidence takes; left out, its cost is said."""
    glossy = photograph(texture(3), LAMP, {"roughness": 0.4, "f0": 0.05}, samples=8)
    assert solve(glossy, gloss="always").outputs["surface"].model == "rough"
    matt = solve(glossy, gloss="never")
    assert matt.outputs["surface"].model == "diffuse"
    row = next(row for row in matt.evidence if row["term"] == "specular lobe of the ground")
    assert not row["modelled"]
    assert row["bound_rel"] > 0.01
    assert "reflectance.gloss = never" in row["because"]


def test_lobes_against_a_sum_over_every_texel():
    """The lights of the split map against the full map; a furnace gives back the energy of a smooth-enough lobe."""
    view = np.array([[0.0, 0.6, 0.8], [0.3, 0.9, 0.1]])
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    normal, roughness = np.array([0.0, 1, 0]), np.array([0.4, 0.7])
    split = specular.lobes(lights_of(LAMP, specular.FINE_MAP), normal, view, roughness)
    d, solid = latlong_directions(*LAMP.shape[:2]), latlong_solid_angles(*LAMP.shape[:2])
    full = specular.Lights(d.reshape(-1, 3), (LAMP * solid[..., None]).reshape(-1, 3))
    direct = specular.lobes(full, normal, view, roughness)
    for name in ("g0", "g5", "e", "e5"):
        np.testing.assert_allclose(getattr(split, name), getattr(direct, name), rtol=5e-3)
    furnace = specular.lobes(lights_of(np.ones((64, 128, 3)), specular.FINE_MAP), normal, view, np.array([0.3]))
    assert np.all((furnace.g0 > 0.97) & (furnace.g0 < 1.01))  # single scattering loses 1 to 2 % at this roughness


def test_too_few_cells_stay_diffuse():
    cells = specular.Cells(np.ones((9, 3)), np.zeros((9, 3)), np.tile([0.0, 1, 0], (9, 1)), np.zeros(9, int))
    surface = specular.climb(cells, LAMP, np.array([0.0, 1, 0]))
    assert surface.model == "diffuse"
    assert not specular.explain(surface)["modelled"]


def test_what_a_gloss_taken_for_matt_costs_grows_with_it_and_leaves_out_other_materials():
    """The lobe of a plane that is what the model says; of a third that is another material little is heard."""
    view = np.stack([np.sin(a := np.linspace(0.2, 1.2, 60)), np.cos(a), 0 * a], -1)
    lights, up = lights_of(LAMP), np.array([0.0, 1, 0])
    found = specular.lobes(lights, up, view, np.array([0.4]))

    def cost(f0: float, others: slice = slice(0)) -> float:
        fields = specular.rough(found, np.array([f0]))
        radiance = 0.4 * fields.scale[0] + fields.offset[0]
        radiance[others] *= 6  # paper on the plane
        cells = specular.Cells(radiance, 1e-6 * radiance**2, view, np.arange(60))
        lobe = specular.Lobe.of(cells, LAMP, up, {"model": "rough", "roughness": 0.4, "f0": f0})
        return specular.taken_for_matt(lobe, cells, up)

    costs = [cost(f0) for f0 in (0.01, 0.03, 0.09)]
    assert costs[0] < costs[1] < costs[2]
    assert costs[0] < 0.1
    assert cost(0.03, others=slice(0, None, 3)) < costs[1]


def test_what_objects_feel_of_a_gloss_taken_for_matt():
    """Nothing where a plane looks alike from everywhere; more of a stronger coat, and of a metal the most.

    A white metal under an even sky is such a plane, but for what single scattering loses, 1 to 2 % at this roughness.
    """
    view = np.stack([np.sin(a := np.linspace(0.2, 1.2, 60)), np.cos(a), 0 * a], -1)
    up = np.array([0.0, 1, 0])

    def cost(light: np.ndarray, base: float, **model: float | str) -> float:
        row = {"roughness": 0.4, **model}
        bare = specular.Lobe(lights_of(light), up, row, np.zeros((0, 3)), np.zeros(0))
        fields = bare.fields(bare.lights, view)[0]
        radiance = base * fields.scale[0] + fields.offset[0]
        cells = specular.Cells(radiance, 1e-6 * radiance**2, view, np.arange(60))
        return specular.objects_of_matt(specular.Lobe.of(cells, light, up, row), cells, light, up)

    assert cost(np.ones((64, 128, 3)), 1.0, model="metallic", roughness=0.3) < 0.02
    coats = [cost(LAMP, 0.4, model="rough", f0=f0) for f0 in (0.02, 0.12)]
    assert 0.01 < coats[0] < coats[1] < cost(LAMP, 0.4, model="metallic")
