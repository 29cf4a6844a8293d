"""Clipped lamps: found, bounded, recovered from the ball's own shadow where it tells, and named where it does not.

Truth is `benchmarks.flux_scene`: photographs of a ball on a table by numerical integration, of lamps with known fluxes.
One scene with four lamps is photographed once; light is linear, so that every case switches some of them on.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import flux_scene
from pipeline.conventions import CLIPPED, invert_rigid, latlong_directions, latlong_solid_angles, transform_points
from pipeline.light import ball_shadow
from pipeline.light.environment import irradiance
from pipeline.light.flux import Card, Shadow, predicted, solve
from pipeline.light.placed import axes_about, header_of
from pipeline.probes import clipped, shadow_flux
from pipeline.probes.cards import Cards
from pipeline.probes.clipped_lights import find_lights
from pipeline.probes.shadow_blocks import MODEL, plane_blocks
from pipeline.probes.witness import Witness
from pipeline.types import BallFit, Raster
from stages import knobs
from stages import lights as room

HIGH, LOW, NEAR_HIGH, HIDDEN = range(4)
CLIP = 30.0
DIRECTIONS = [(45, 120), (25, -100), (50, 126), (34, 2)]  # elevation, azimuth; the camera stands at (35, 0)
COLOUR = np.array([1.0, 0.9, 0.8])


@pytest.fixture(autouse=True)
def fewer_points(monkeypatch):
    """Half the points of the product: twice as quick."""
    monkeypatch.setattr(shadow_flux, "POINTS", 800)


@pytest.fixture(scope="module")
def scene():
    lamps = [
        flux_scene.Lamp(flux_scene.from_angles(*angles), np.ones(3), np.radians(half))
        for angles, half in zip(DIRECTIONS, (0.27, 0.5, 0.27, 0.27), strict=True)
    ]
    return flux_scene.with_lamps(flux_scene.standard(60.0, 300, 220), *lamps)


@pytest.fixture(scope="module")
def pictures(scene):
    return flux_scene.photograph(scene, 1)


def ball_fit(scene, sigma: float = 5e-5) -> BallFit:
    centre = transform_points(invert_rigid(scene.world_from_camera), flux_scene.CENTRE)
    return BallFit(
        centre_camera_m=centre, radius_m=flux_scene.RADIUS, covariance=np.eye(3) * sigma**2, rms_px=0.1, points=99,
        radius_px=60.0, reflectance=scene.reflectance,
    )  # fmt: skip


def case(scene, pictures, strengths, columns: slice = slice(None), unmapped: tuple[int, ...] = ()):
    """`recover` with lamps of irradiance ``strengths`` (4,), as a multiple of the sky's on the table, and their fluxes.

    ``columns``: the part of the pictures that exists; ``unmapped``: lamps that the probe did not see.
    """
    free = flux_scene.sky_irradiance(scene).mean()
    fluxes = [
        strength * free * COLOUR / lamp.direction[1] for strength, lamp in zip(strengths, scene.lamps, strict=True)
    ]
    plate, ball = pictures.at(fluxes)
    rasters = [flux_scene.raster(one[:, columns], np.inf, seed) for seed, one in enumerate((ball, plate))]
    start = columns.indices(scene.camera.width)[0]
    moved = {"cx": scene.camera.cx - start, "width": rasters[0].shape[1]}
    camera, fit = scene.camera.model_copy(update=moved), ball_fit(scene)
    blocks = plane_blocks(rasters[0], rasters[1], camera, scene.world_from_camera, fit)
    mapped = [np.zeros(3) if number in unmapped else flux for number, flux in enumerate(fluxes)]
    rgb, over = flux_scene.true_map(scene, mapped, CLIP)
    seen = Witness(
        ball_shadow.Ball(flux_scene.CENTRE, flux_scene.RADIUS, scene.reflectance), blocks,
        shift=np.array([0, 0, 5e-5]), place=np.eye(3) * 5e-5**2, eye=scene.world_from_camera[:3, 3],
    )  # fmt: skip
    return clipped.recover(rgb, (0.01 * rgb) ** 2, over, seen), fluxes, rgb, over


def check(row, flux, tolerance: float = 0.03):
    """Within 3 %, the figure that is asked of a sun with evidence, and within three of its own sigmas."""
    error = np.abs(np.array(row["flux"]) / flux - 1)
    assert not row["lower_bound"], row["why_not"]
    assert error.max() < tolerance
    assert np.all(error * flux < 3 * np.array(row["flux_sigma"]))


@pytest.mark.parametrize(("lamp", "strength"), [(HIGH, 0.3), (HIGH, 20.0), (LOW, 1.0)])
def test_one_lamp_is_recovered(scene, pictures, lamp, strength):
    strengths = np.zeros(4)
    strengths[lamp] = strength
    found, fluxes, _, _ = case(scene, pictures, strengths)
    (row,) = found.numbers["clipped_lights"]
    assert np.mean(row["bound"]) < 0.5 * fluxes[lamp].mean()
    check(row, fluxes[lamp])
    assert row["condition"] < clipped.WORST_CONDITION
    assert found.warnings == []
    assert [reason["modelled"] for reason in found.evidence] == [True]


def test_the_map_holds_the_flux_exactly_and_its_sigma_is_shared(scene, pictures):
    found, _, rgb, over = case(scene, pictures, [1, 0, 0, 0])
    (row,) = found.numbers["clipped_lights"]
    weight = latlong_solid_angles(*over.shape)[..., None]
    touched = found.recovered > 0
    assert np.array_equal(found.rgb[~touched], rgb[~touched])
    assert np.all(found.recovered[over > 0] == 1)
    gained = ((found.rgb - rgb) * weight).sum((0, 1))
    np.testing.assert_allclose(gained, np.array(row["flux"]) - row["bound"], rtol=1e-9)
    disc = touched & (found.rgb.min(-1) > 3)  # the rest of the clipped texels shows the sky again
    sigma = (np.sqrt(found.variance) * weight)[disc].sum(0)
    np.testing.assert_allclose(sigma, row["flux_sigma"], rtol=1e-9)


def test_the_shadows_edge_makes_it_a_sun(scene, pictures):
    """Its picture is blurred to 1 degree and clipped, its shadow's edge is not; texels are 1.4 degrees here."""
    found, fluxes, _, _ = case(scene, pictures, [20.0, 0, 0, 0])
    (row,) = found.numbers["clipped_lights"]
    assert row["half_angle_deg"] > 2
    check_edge(row, scene.lamps[HIGH])
    channels = {
        **Raster.split(found.rgb.astype(np.float32)),
        **Raster.split(found.variance.astype(np.float32), "variance"),
    }
    channels |= {"clipped": found.clipped.astype(np.float32), "recovered": found.recovered.astype(np.float32)}
    picture = Raster(channels, "acescg", header_of(found.placed))
    (emitter,) = room.compute(picture, knobs.Lights()).outputs["emitters"]
    assert (emitter.name, emitter.evidence, emitter.lower_bound) == ("sun", "recovered", False)
    off = axes_about(emitter.direction) @ (scene.lamps[HIGH].direction - emitter.direction)
    assert np.all(np.abs(off) < 3 * emitter.direction_sigma_rad)
    assert np.degrees(emitter.direction_sigma_rad).max() < 0.15  # of texels of 1.4
    np.testing.assert_allclose(emitter.irradiance, fluxes[HIGH], rtol=0.03)


@pytest.mark.parametrize("lamp", [HIGH, LOW])
def test_the_edge_tells_the_lamps_width_from_the_photographs_blur(scene, pictures, lamp):
    """0.27 and 0.5 degrees through a lens that makes about a degree of either: near and far parts of one edge tell."""
    strengths = np.zeros(4)
    strengths[lamp] = 1.0
    (row,) = case(scene, pictures, strengths)[0].numbers["clipped_lights"]
    check_edge(row, scene.lamps[lamp])
    assert row["edge_half_angle_sigma_deg"] < 0.1
    assert abs(row["edge_blur_px"] - 0.7) < 0.2  # of the prior's 50 %, what 0.2 degrees of half angle would hide


def check_edge(row, lamp):
    """Width within three sigmas, of its square, which is what an edge tells; direction within 0.1 degrees.

    Of a pixel, 0.2 to 0.8 degrees here, the shadow's place is known to a hundredth, and its ball's to 5e-5 m of 0.06.
    """
    half, sigma = row["edge_half_angle_deg"], row["edge_half_angle_sigma_deg"]
    assert abs(half**2 - np.degrees(lamp.half_angle) ** 2) < 3 * ((half + sigma) ** 2 - half**2)
    found = flux_scene.from_angles(row["elevation_deg"], row["azimuth_deg"])
    assert np.degrees(np.arccos(found @ lamp.direction)) < 0.1


def test_two_lamps_are_told_apart(scene, pictures):
    found, fluxes, _, _ = case(scene, pictures, [1.0, 0.6, 0, 0])
    rows = sorted(found.numbers["clipped_lights"], key=lambda row: -row["elevation_deg"])
    assert len(rows) == 2
    for row, lamp in zip(rows, (HIGH, LOW), strict=True):
        check(row, fluxes[lamp], 0.04)  # each carries the other's error too: 3 % of a lamp 1.7 times as strong


def test_a_lamp_whose_shadow_the_ball_hides_is_named_not_fitted(scene, pictures):
    found, _, rgb, _ = case(scene, pictures, [0, 0, 0, 1.0])
    (row,) = found.numbers["clipped_lights"]
    assert row["lower_bound"]
    assert row["why_not"] == "the shadow that it casts of the ball is not in the picture"
    assert np.array_equal(found.rgb, rgb)
    assert "lower bound" in found.warnings[0]
    # It lights the plane beyond, by nobody knows how much, so a second lamp's share of the light is unknown too.
    found, _, _, _ = case(scene, pictures, [1.0, 0, 0, 1.0])
    assert all(row["lower_bound"] for row in found.numbers["clipped_lights"])


def test_shadow_half_outside_the_frame(scene, pictures, monkeypatch):
    """The visible half tells as much; only the noise of fewer points is added."""
    monkeypatch.setattr(shadow_flux, "POINTS", 1600)  # the product's: more than the whole shadow has
    whole, _, _, _ = case(scene, pictures, [1.0, 0, 0, 0])
    half, fluxes, _, _ = case(scene, pictures, [1.0, 0, 0, 0], columns=slice(75, None))
    check(half.numbers["clipped_lights"][0], fluxes[0])
    assert half.numbers["shadow_points"] < whole.numbers["shadow_points"]
    gone, _, _, _ = case(scene, pictures, [0, 1.0, 0, 0], columns=slice(0, 160))
    assert gone.numbers["clipped_lights"][0]["lower_bound"]


def test_a_lamp_that_the_map_lacks_is_noticed(scene, pictures):
    found, _, _, _ = case(scene, pictures, [1.0, 1.0, 0, 0], unmapped=(LOW,))
    (row,) = found.numbers["clipped_lights"]
    assert row["lower_bound"]
    assert "one is unseen" in row["why_not"]


def test_a_clipped_window_leaves_the_others_open(scene, pictures):
    """A patch of 25 degrees, clipped, has no shadow of its own: the plane's light is unknown, and so its shares."""
    free = flux_scene.sky_irradiance(scene).mean()
    fluxes = [free * COLOUR, *np.zeros((3, 3))]
    rgb, over = flux_scene.true_map(scene, fluxes, CLIP)
    window = latlong_directions(*over.shape) @ flux_scene.from_angles(40, -60) > np.cos(np.radians(25))
    rgb[window], over[window] = CLIP, 1
    plate, ball = pictures.at(fluxes)
    rasters = [flux_scene.raster(one, np.inf, seed) for seed, one in enumerate((ball, plate))]
    blocks = plane_blocks(*rasters, scene.camera, scene.world_from_camera, ball_fit(scene))
    place = ball_shadow.Ball(flux_scene.CENTRE, flux_scene.RADIUS, scene.reflectance)
    found = clipped.recover(rgb, rgb**2, over, Witness(place, blocks))
    whys = [row["why_not"] for row in found.numbers["clipped_lights"]]
    assert "degrees wide" in whys[0]
    assert "another clipped light" in whys[1]
    assert np.array_equal(found.rgb, rgb)


def test_without_a_tripod_view_the_bound_stays(scene, pictures):
    rgb, over = flux_scene.true_map(scene, [20 * COLOUR, *np.zeros((3, 3))], CLIP)
    found = clipped.recover(rgb, rgb**2, over, Witness())
    (row,) = found.numbers["clipped_lights"]
    assert row["lower_bound"]
    assert "tripod" in found.warnings[0]
    assert np.array_equal(found.rgb, rgb)
    assert not found.recovered.any()


def test_nothing_clipped_changes_nothing(scene):
    rgb, over = flux_scene.true_map(scene, list(np.zeros((4, 3))), CLIP)
    found = clipped.recover(rgb, rgb**2, over, Witness())
    assert np.array_equal(found.rgb, rgb)
    assert found.warnings == []
    assert [reason["because"] for reason in found.evidence] == ["nothing is clipped in every frame"]


def test_a_card_of_known_albedo_is_evidence_too(scene, pictures):
    """Exact irradiance of a tilted card: the flux comes back to what the map's 1 degree blur does to its cosine."""
    normal = np.array([0.3, 0.9, -0.2]) / np.linalg.norm([0.3, 0.9, -0.2])
    flux = 5 * COLOUR
    rgb, over = flux_scene.true_map(scene, [flux, *np.zeros((3, 3))], CLIP)
    sky, _ = flux_scene.true_map(scene, list(np.zeros((4, 3))), CLIP)
    weight = latlong_solid_angles(*over.shape) * np.maximum(latlong_directions(*over.shape) @ normal, 0)
    below = latlong_directions(*over.shape)[..., 1:2] < 0
    plane_lit = np.where(below, rgb, sky)
    measured = (plane_lit * weight[..., None]).sum((0, 1)) + flux * (normal @ scene.lamps[0].direction)
    found = clipped.recover(
        rgb, (0.01 * rgb) ** 2, over, Witness(cards=Cards(measured[None], 0.005 * measured[None], normal[None]))
    )
    check(found.numbers["clipped_lights"][0], flux)


def test_lit_patches_alone_are_not_evidence():
    """Two lamps, one card: one equation for two unknowns has no finite condition number."""
    card = Card.measured(
        np.full(3, 5.0), np.full(3, 0.1), np.array([0, 1.0, 0]), np.ones(3), np.array([[0, 1.0, 0]] * 2)
    )
    found = solve(None, card, np.full((2, 3), 0.1))
    assert np.all(found.condition > 1e6)
    assert found.value.sum(0) == pytest.approx(np.full(3, 4.0), rel=1e-6)
    assert np.all(found.value >= 0.1)


def test_one_card_does_not_tell_two_lamps_and_two_cards_do(scene):
    """Degenerate by evidence: one equation for two fluxes names both; a second normal makes it two equations."""
    fluxes = [5 * COLOUR, 4 * COLOUR]
    rgb, over = flux_scene.true_map(scene, [*fluxes, *np.zeros((2, 3))], CLIP)
    sky, _ = flux_scene.true_map(scene, list(np.zeros((4, 3))), CLIP)
    below = latlong_directions(*over.shape)[..., 1:2] < 0
    normals = np.array([[0, 1.0, 0], 0.4 * scene.lamps[0].direction + [0, 0.7, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facing = np.maximum(normals @ np.stack([lamp.direction for lamp in scene.lamps[:2]], 1), 0)
    assert facing.min() > 0.1
    light = irradiance(np.where(below, rgb, sky), normals) + facing @ np.stack(fluxes)

    def told(cards: int) -> tuple[list, clipped.Recovered]:
        seen = Cards(light[:cards], 0.005 * light[:cards], normals[:cards])
        found = clipped.recover(rgb, (0.01 * rgb) ** 2, over, Witness(cards=seen))
        return found.numbers["clipped_lights"], found

    rows, found = told(1)
    assert [row["lower_bound"] for row in rows] == [True, True]
    assert all("cannot be told from another lamp's" in row["why_not"] for row in rows)
    assert np.array_equal(found.rgb, rgb)
    rows, _ = told(2)
    for row in rows:
        assert not row["lower_bound"], row["why_not"]
        near = min(range(2), key=lambda k: abs(row["elevation_deg"] - DIRECTIONS[k][0]))
        error = np.abs(np.array(row["flux"]) - fluxes[near])
        assert np.all(error < 3 * np.array(row["flux_sigma"]))


def test_lamps_with_the_same_response_are_named():
    reach = synthetic(np.random.default_rng(0))
    twin = [np.concatenate([part, part], 1) for part in (reach.visible, reach.lamp, reach.lost)]
    twins = ball_shadow.Reach(reach.sky, reach.free, reach.lost_sky, *twin, np.repeat(reach.cosine, 2))
    flux = np.array([[2.0] * 3, [1.0] * 3])
    shadow = shadow_of(twins, flux, 0.0)
    found = solve(shadow, None, np.zeros((2, 3)))
    assert np.all(found.condition > 1e6)
    assert np.all(np.abs(found.weakest) > clipped.INVOLVED)
    assert found.value.sum(0) == pytest.approx(np.full(3, 3.0), rel=1e-4)


def synthetic(random) -> ball_shadow.Reach:
    """Points in and out of one lamp's shadow, without what the ball mirrors."""
    dark = random.random(300) < 0.4
    visible = 1.0 - dark[:, None]
    lamp = 0.7 * np.repeat(visible[..., None], 3, -1)
    sky = 3 * (1 - 0.3 * random.random((300, 1))) * np.ones(3)
    zero = np.zeros((300, 3))
    return ball_shadow.Reach(sky, 3 * np.ones(3), zero, visible, lamp, zero[:, None], np.array([0.7]))


def shadow_of(reach, flux, noise: float, seed: int = 0) -> Shadow:
    random = np.random.default_rng(seed)
    ratio = predicted(reach, flux)[0]
    sigma = np.full(ratio.shape, noise or 1e-6)
    ratio = ratio + noise * random.normal(size=ratio.shape)
    return Shadow(ratio, sigma, reach, np.arange(len(ratio)) // 3, np.zeros((0, 3)))


@pytest.mark.parametrize("contrast", [1e-2, 1.0, 1e3, 1e6])
def test_the_solver_is_unbiased_and_its_sigma_covers(contrast):
    """200 channels' draws; a mean of 200 lies within 4 / sqrt(200) sigma, the spread within 20 % (4 / sqrt(400))."""
    random = np.random.default_rng(3)
    reach = synthetic(random)
    flux = np.full((1, 3), contrast)
    noise = 1e-3 * float(predicted(reach, flux)[0].min())
    score = []
    for seed in range(67):
        found = solve(shadow_of(reach, flux, noise, seed), None, np.zeros((1, 3)))
        score.append((found.value[0] - flux[0]) / np.sqrt(found.covariance[:, 0, 0]))
    score = np.concatenate(score)
    assert abs(score.mean()) < 4 / np.sqrt(len(score))
    assert score.std() == pytest.approx(1, abs=0.2)


def test_bounds_hold():
    reach = synthetic(np.random.default_rng(0))
    found = solve(shadow_of(reach, np.full((1, 3), 2.0), 1e-3), None, np.full((1, 3), 3.0))
    assert np.all(found.value == 3.0)


def test_thrown_light_is_that_of_counted_rays(scene):
    """Closed form against a bundle of 640 000 rays; cells of the count are 0.1 radii wide, 2 % of what is there."""
    points = flux_scene.grid_points()
    near = (np.hypot(points[:, 0], points[:, 2]) > flux_scene.RADIUS) & (
        np.hypot(points[:, 0], points[:, 2]) < 6 * flux_scene.RADIUS
    )
    ball = ball_shadow.Ball(flux_scene.CENTRE, flux_scene.RADIUS, np.ones(3))
    counted = flux_scene.scattered(scene.lamps[0], 800)
    closed = ball_shadow.thrown(points, scene.lamps[0].direction, ball)
    bright = near & (counted > 0.1 * counted[near].max())
    assert np.median(np.abs(closed[bright] / counted[bright] - 1)) < 0.02
    assert closed[near].sum() == pytest.approx(counted[near].sum(), rel=0.02)


def test_visible_part_of_a_disc():
    assert ball_shadow.visible_part(np.array([-1.0, -0.1, 0.0, 0.1, 1.0]), 0.1) == pytest.approx([0, 0, 0.5, 1, 1])


@pytest.mark.parametrize("strengths", [[0, 0, 0, 0], [1, 0.5, 0, 0], [20, 0, 0, 0]])
def test_the_shadow_of_a_known_map_is_that_of_the_photographs(scene, pictures, strengths):
    """What the self-check predicts, against an integration that shares no code; away from the shadows' sharp edges.

    `MODEL` is what the model is said to leave out; 95 % of the blocks must be within it.
    """
    free = flux_scene.sky_irradiance(scene).mean()
    fluxes = [strength * free * COLOUR for strength in strengths]
    plate, ball = pictures.at(fluxes)
    rasters = [flux_scene.raster(one, np.inf, 0, noise=0, floor=1e-9, blur=0.01) for one in (ball, plate)]
    blocks = plane_blocks(*rasters, scene.camera, scene.world_from_camera, ball_fit(scene))
    rgb, _ = flux_scene.true_map(scene, fluxes, np.inf)
    place = ball_shadow.Ball(flux_scene.CENTRE, flux_scene.RADIUS, scene.reflectance)
    predicted = shadow_flux.shadow_of(shadow_flux.setting(rgb, 0 * rgb, []), blocks.points, place)
    clear = np.ones(len(blocks.points), bool)
    for lamp, strength in zip(scene.lamps, strengths, strict=True):
        edge = ball_shadow.edge_angle(blocks.points, lamp.direction, place)
        clear &= (strength == 0) | (np.abs(edge) > np.radians(4))
    assert np.percentile(np.abs(predicted - blocks.ratio)[clear], 95) < MODEL


def test_components_join_over_the_seam_and_glare_belongs_to_its_lamp():
    height, width = 64, 128
    directions = latlong_directions(height, width)
    angle = np.arccos(np.clip(directions @ np.array([0, 0.6, -0.8]), -1, 1))  # on the seam
    rgb = np.minimum(1 + 1e4 * np.exp(-0.5 * (angle / np.radians(2)) ** 2), 30)[..., None] * np.ones(3)
    (light,) = find_lights(rgb, np.asarray(angle < np.radians(5), float))
    assert np.degrees(np.arccos(light.direction @ (0, 0.6, -0.8))) < 0.1 * 180 / height
    assert angle.ravel()[light.texels].max() > np.radians(7)
    assert light.around == pytest.approx(1, rel=0.02)
    assert light.shape.sum(0) == pytest.approx(np.ones(3))


# what the stage of lights makes of it


@pytest.mark.parametrize(("recovered", "source"), [(0.0, "clipped"), (1.0, "recovered")])
def test_lights_know_what_is_a_lower_bound(recovered, source):
    height, width = 64, 128
    directions = latlong_directions(height, width)
    lamp = directions @ np.array([0, 0.6, 0.8]) > np.cos(np.radians(5))
    rgb = np.where(lamp, 50.0, 1.0)[..., None] * np.ones(3)
    channels = {
        **Raster.split(rgb.astype(np.float32)), **Raster.split((0.1 * rgb).astype(np.float32) ** 2, "variance"),
        "clipped": lamp.astype(np.float32), "recovered": (lamp * recovered).astype(np.float32),
    }  # fmt: skip
    found = room.compute(Raster(channels, "acescg"), knobs.Lights())
    (emitter,) = found.outputs["emitters"]
    assert (emitter.evidence, emitter.lower_bound) == (source, source == "clipped")
    assert bool(found.warnings) == emitter.lower_bound
    # One error of all texels is a tenth of the light; independent ones are less by the root of their number.
    share = 1.0 if recovered else 1 / np.sqrt(len(emitter.texels))
    assert emitter.irradiance_sigma == pytest.approx(0.1 * share * emitter.irradiance, rel=0.1)


def test_hot_and_clipped_pixels_are_not_compared(scene, pictures):
    plate, ball = pictures.at(list(np.zeros((4, 3))))
    one, other = flux_scene.raster(ball, np.inf, 0), flux_scene.raster(plate, np.inf, 1)
    before = plane_blocks(one, other, scene.camera, scene.world_from_camera, ball_fit(scene))
    mask = one["mask"].copy()
    mask[150:] = CLIPPED
    masked = Raster({**one.channels, "mask": mask}, "acescg")
    after = plane_blocks(masked, other, scene.camera, scene.world_from_camera, ball_fit(scene))
    assert 0 < len(after.points) < len(before.points)
    assert np.abs(after.ratio - 1).max() < 1
