"""Cards and grey balls as witnesses of clipped lamps: painted into a plate with the exact light of their normals."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import flux_scene
from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import invert_rigid, latlong_directions, transform_points
from pipeline.light.environment import irradiance, resize_environment
from pipeline.probes import cards, clipped
from pipeline.probes.grey_ball import sphere_normals
from pipeline.probes.observation import Shots
from pipeline.probes.witness import Witness
from pipeline.run.manifest import ReferenceFacts
from pipeline.types import Raster

LAMP = flux_scene.Lamp(flux_scene.from_angles(40, 110), np.ones(3), np.radians(0.5))
SCENE = flux_scene.with_lamps(flux_scene.standard(100.0, 360, 280), LAMP)
POSE, CAMERA = SCENE.world_from_camera, SCENE.camera
FLUX, RHO, CLIP = np.array([20.0, 18.0, 15.0]), 0.18, 30.0
SIZE = np.array([0.08, 0.06])


@pytest.fixture(scope="module")
def light():
    """The map with the lamp clipped, which texels are, and the irradiance (N, 3) at normals (N, 3) of the true one."""
    rgb, over = flux_scene.true_map(SCENE, [FLUX], CLIP)
    dark, _ = flux_scene.true_map(SCENE, [0 * FLUX], CLIP)
    below = latlong_directions(*over.shape)[..., 1:2] < 0
    sky = resize_environment(np.where(below, rgb, dark), 64, 128)  # the plane is lit by the lamp, too

    def at(normals: np.ndarray, shaded: bool = False) -> np.ndarray:
        lamp = np.maximum(normals @ LAMP.direction, 0)[:, None] * FLUX
        return irradiance(sky, normals) + (0 if shaded else lamp)

    return rgb, over, at


def turned(tilt_deg: float, azimuth_deg: float) -> np.ndarray:
    """A card's corners (4, 3) in the world, one side on the plane, turned up about it; and its normal (3,)."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    first = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    second = np.cos(tilt) * np.array([np.sin(azimuth), 0, np.cos(azimuth)]) - np.sin(tilt) * np.array([0, -1.0, 0])
    corners = np.array([-0.03, 0, 0.01]) + np.array([0 * first, first * SIZE[0], first * SIZE[0] + second * SIZE[1],
                                                     second * SIZE[1]])  # fmt: skip
    normal = np.cross(second, first)
    return corners, normal


def card(corners: np.ndarray, **facts) -> dict:
    px = project(CAMERA, transform_points(invert_rigid(POSE), corners))
    seen = [{"view": "plate", "corners_px": px.tolist()}]
    given = {"name": "grey", "kind": "grey_card", "reflectance": [RHO] * 3, "reflectance_space": "acescg"}
    return {**given, "on_plane": None, "size_mm": None, "seen": seen, **facts}


def shots(picture: np.ndarray, *references: dict, view: str = "plate") -> Shots:
    raster = Raster(
        {**Raster.split(picture.astype(np.float32)), "mask": np.zeros(picture.shape[:2], np.uint32)}, "acescg"
    )
    return Shots({"reference": list(references)}, {view: raster}, CAMERA, {view: flux_scene.view(POSE)})


def lit(light: np.ndarray) -> np.ndarray:
    """A picture all of which shows a surface under irradiance (3,)."""
    return np.broadcast_to(RHO / np.pi * light, (CAMERA.height, CAMERA.width, 3))


def recovered(light, found: cards.Cards):
    rgb, over, _ = light
    result = clipped.recover(rgb, (0.005 * rgb) ** 2, over, Witness(cards=found))
    return result.numbers["clipped_lights"][0], result.numbers


def check(row):
    """Within 3 %, what is asked of a flux with evidence, and within three of its sigmas; these say 2 to 8 %."""
    assert not row["lower_bound"], row["why_not"]
    error = np.abs(np.array(row["flux"]) / FLUX - 1)
    assert error.max() < 0.03
    assert np.all(error * FLUX < 3 * np.array(row["flux_sigma"]))
    assert np.max(np.array(row["flux_sigma"]) / FLUX) < 0.1


def test_a_card_on_the_plane_gives_the_flux(light):
    corners, _ = turned(0, 20)
    found = cards.cards_of(shots(lit(light[2](cards.UP[None])[0]), card(corners)))
    assert "rectangle" in found.said["grey"]
    row, numbers = recovered(light, found)
    check(row)
    assert numbers["flux_references"] == found.said
    assert numbers["flux_rows_shaded"] == 0


@pytest.mark.parametrize(("tilt", "azimuth"), [(30, 20), (-40, 150), (60, 145)])
def test_a_tilted_card_is_not_taken_to_lie_and_its_size_gives_its_normal(light, tilt, azimuth):
    corners, normal = turned(tilt, azimuth)
    normal = normal * np.sign(normal @ (POSE[:3, 3] - corners[0]))
    picture = lit(light[2](normal[None])[0])
    refused = cards.cards_of(shots(picture, card(corners)))
    assert not len(refused.normal)
    assert "size_mm" in refused.said["grey"]
    found = cards.cards_of(shots(picture, card(corners, size_mm=tuple(1e3 * SIZE))))
    np.testing.assert_allclose(found.normal[0], normal, atol=1e-5)
    if normal @ LAMP.direction > 0.3:
        check(recovered(light, found)[0])


def test_the_normal_of_a_tilted_card_is_as_sure_as_it_says():
    """Corners moved by 1 px, 100 draws: two angles each, sigma that of the larger, so mean (error / sigma)^2 <= 2.

    Measured: 1.3.
    """
    corners, normal = turned(30, 20)
    exact = card(corners, size_mm=tuple(1e3 * SIZE))
    px, random, pulls = np.array(exact["seen"][0]["corners_px"]), np.random.default_rng(0), []
    for _ in range(100):
        moved = px + random.normal(size=(4, 2)) * cards.CORNER_PX
        found, sigma, _ = cards.facing({**exact, "on_plane": False}, CAMERA, POSE, moved)
        if found is not None:
            pulls.append(np.arccos(min(found @ normal, 1)) ** 2 / (sigma**2 - cards.TILT**2))
    assert len(pulls) == 100
    assert 0.5 < np.mean(pulls) < 2


def test_a_flat_card_with_clicked_corners_is_seen_to_lie():
    """Chi2 of three conditions on 200 draws of corners: mean 3 +- 0.35 (twice its standard error, sqrt(6 / 200))."""
    px = np.array(card(turned(0, 20)[0])["seen"][0]["corners_px"])
    random = np.random.default_rng(1)
    moved = [px + random.normal(size=(4, 2)) * cards.CORNER_PX for _ in range(200)]
    assert np.mean([cards.rectangle_chi2(CAMERA, POSE, one, None) for one in moved]) == pytest.approx(3, abs=0.35)


def test_a_grey_ball_gives_the_flux_from_any_view(light):
    centre = transform_points(invert_rigid(POSE), np.array([0.02, 0.012, 0.03]))
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    normals, _ = sphere_normals(pixel_rays(CAMERA, np.stack([x, y], -1).reshape(-1, 2)), centre, 0.012)
    hit = np.isfinite(normals[:, 0])
    picture = np.full((CAMERA.height * CAMERA.width, 3), 0.2)
    picture[hit] = RHO / np.pi * light[2](normals[hit] @ POSE[:3, :3].T)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)[:, None]
    axis, distance = centre / np.linalg.norm(centre), np.linalg.norm(centre)
    side = np.linalg.svd(axis[None])[2][1:]
    ratio = 0.012 / distance
    outline = project(CAMERA, np.sqrt(1 - ratio**2) * axis + ratio * (np.cos(turn) * side[0] + np.sin(turn) * side[1]))
    ball = card(np.zeros((4, 3)), kind="grey_ball", seen=[{"view": "walk", "corners_px": outline.tolist()}])
    found = cards.cards_of(shots(picture.reshape(CAMERA.height, CAMERA.width, 3), ball, view="walk"))
    check(recovered(light, found)[0])


def test_a_shaded_card_is_left_out_and_counted(light):
    corners, _ = turned(0, 20)
    bright = *flux_scene.true_map(SCENE, [FLUX], 1000.0), light[2]
    picture = lit(light[2](cards.UP[None], shaded=True)[0])
    row, numbers = recovered(bright, cards.cards_of(shots(picture, card(corners))))
    assert row["lower_bound"]
    assert "shade" in row["why_not"]
    assert numbers["flux_rows_shaded"] == 1


def test_a_card_without_reflectance_is_no_evidence_and_says_so(light):
    corners, _ = turned(0, 20)
    found = cards.cards_of(shots(lit(np.ones(3)), card(corners, reflectance=None)))
    assert not len(found.normal)
    assert "reflectance" in found.said["grey"]


def test_a_size_is_for_a_card_with_four_corners():
    facts = {"name": "grey", "kind": "grey_card", "size_mm": (210, 297), "reflectance": (0.18, 0.18, 0.18)}
    four, three = ([{"view": "plate", "corners_px": [(0, 0), (9, 0), (9, 9), (0, 9)][:count]}] for count in (4, 3))
    assert ReferenceFacts.model_validate({**facts, "seen": four}).on_plane is None
    for wrong in ({"seen": three}, {"seen": four, "kind": "grey_ball"}):
        with pytest.raises(ValueError, match="size_mm"):
            ReferenceFacts.model_validate({**facts, **wrong})
