"""The ball's surface against ray-traced balls: its reflectance, given and measured, and how that depends on angle."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, get_args

import numpy as np
import pytest
from ball_sights import BALL, CAMERA, POSES, RADIUS, ROOM, SPOTS, TRUE, channels, sights
from mirror_scene import Place, photograph

from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes import ball_surface
from pipeline.probes.ball_evidence import find_dirt, unbinned, without
from pipeline.probes.ball_pairs import Pairs, Sight, ball_points, neighbourhood, plane_pairs
from pipeline.probes.ball_shape import dents, patch_shifts
from pipeline.probes.ball_surface import GIVEN_SIGMA, Measured, Surface, decide, measure, under_gloss
from pipeline.run.probe_facts import MirrorBallFacts
from pipeline.run.strict import Metal
from pipeline.transport.conductors import GRAZING, REFLECTANCE, preset, reflectance_at
from pipeline.types import Raster


def chrome(normal: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """An edge that is far from Schlick's: tint 0.8."""
    at_edge = (TRUE + (1 - TRUE) * (1 - GRAZING) ** 5) * 0.8
    return reflectance_at(TRUE, at_edge, cosine)


def schlick(normal: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    return reflectance_at(np.full(3, 0.3), np.full(3, 0.3 + 0.7 * (1 - GRAZING) ** 5), cosine)


def even(*values: float) -> Any:
    return lambda normal, cosine: np.broadcast_to(np.array(values), (*np.shape(cosine), 3))


MIRRORS = {"plain": even(*TRUE), "tinted": even(0.55, 0.40, 0.15), "schlick": schlick, "chrome": chrome}


@functools.cache
def traced(view: str) -> Pairs:
    """Pairs of a ray-traced ball of the mirror `chrome`."""
    place = Place(ROOM, plane=True, ball=BALL, reflectance=chrome)
    picture = photograph(place, CAMERA, POSES[view], 2, 0.003, 1)
    centre = transform_points(invert_rigid(POSES[view]), np.array(BALL))
    return plane_pairs(Sight(channels(picture), CAMERA, POSES[view], centre, RADIUS))


def pairs(mirror: str, view: str) -> Pairs:
    """The same picture with another mirror: each pixel times what the one reflects there over the other."""
    found = traced(view)
    cosine = np.sqrt(1 - found.sine**2)
    factor = MIRRORS[mirror](None, cosine) / chrome(None, cosine)
    return dataclasses.replace(
        found, mirrored=found.mirrored * factor, mirrored_variance=found.mirrored_variance * factor**2
    )


def measured(mirror: str) -> Measured:
    found = measure([pairs(mirror, view) for view in POSES])
    assert found is not None
    return found


def test_both_ways_show_the_same_radiance():
    """A perfect pair: mirrored over direct is the reflectance at every single point, up to texture and noise."""
    found = pairs("plain", "a")
    assert len(found) > 500
    rel = np.sqrt(found.texture / found.direct**2).max(1)
    smooth = rel < 0.01
    ratio = found.mirrored[smooth] / found.direct[smooth] / TRUE
    # 0.3 % photon noise, and 1 % of texture: 99 of 100 within three of both
    assert np.quantile(np.abs(ratio - 1), 0.99) < 3 * np.hypot(0.003, 0.01)


@pytest.mark.parametrize("mirror", ["plain", "tinted"])
def test_reflectance_is_measured(mirror):
    true, found = MIRRORS[mirror](None, 1.0), measured(mirror)
    # three of its own standard uncertainties, which are to be useful: under 0.5 % (measured: error 0.02 %)
    assert (np.abs(found.facing - true) < 3 * found.sigma).all()
    assert (found.sigma / true < 0.005).all()
    assert found.tint is None
    assert not any(row["taken"] for row in found.tests)


def test_schlick_is_found_where_it_is():
    found = measured("schlick")
    assert found.tint is not None
    assert found.tint == pytest.approx(1.0, abs=0.05)
    assert (np.abs(found.facing - 0.3) < 3 * found.sigma + 0.003).all()


def test_a_dark_edge_is_found_where_it_is():
    found = measured("chrome")
    assert found.tint is not None
    sine = np.sin(np.radians([0, 30, 50, 65]))
    shape = Surface(found.facing, found.sigma, np.full(3, found.tint)).at(sine)
    # 1 %: three of its own uncertainties at the angles that the plane covers (30 to 76 degrees)
    assert shape == pytest.approx(chrome(None, np.sqrt(1 - sine**2)), rel=0.01)


def test_gloss_of_the_plane_is_a_term_where_it_is():
    """Ball and camera see the plane under other elevations, which gloss tells apart: 30 % per unit of their sines."""
    views = [pairs("plain", view) for view in POSES]
    glossy = [dataclasses.replace(view, mirrored=view.mirrored * np.exp(0.3 * view.tilt)[:, None]) for view in views]
    found = measure(glossy)
    assert found is not None
    assert found.tests[0]["taken"]
    assert (np.abs(found.facing - TRUE) < 3 * found.sigma).all()


def test_known_metal_replaces_the_ladder():
    _, tint = preset("chromium")
    found = measure([pairs("plain", "a")], tint)
    assert found is not None
    assert found.tint is None
    assert [row["term"] for row in found.tests] == ["gloss of the plane"]


def test_too_little_plane_is_no_evidence():
    found = pairs("plain", "a")
    assert measure([found.at(np.arange(len(found)) < 100)]) is None
    assert measure([found.at(found.azimuth > np.pi - 0.3)]) is None  # one sector says nothing of its own error


def test_hidden_and_clipped_points_are_left_out():
    place = Place(ROOM, plane=True, ball=BALL)
    picture = channels(photograph(place, CAMERA, POSES["a"], 1))
    centre = transform_points(invert_rigid(POSES["a"]), np.array(BALL))
    free = plane_pairs(Sight(picture, CAMERA, POSES["a"], centre, RADIUS))
    picture[:, :150, 7] = 1  # the left third is clipped: neither seen directly nor in the ball
    rest = plane_pairs(Sight(picture, CAMERA, POSES["a"], centre, RADIUS))
    assert 0 < len(rest) < len(free)
    assert rest.pixel[:, 0].min() >= 150
    behind = free.point - np.array(BALL) * (1, 0, 1)
    to_camera = POSES["a"][:3, 3] - free.point
    along = np.linalg.norm(np.cross(to_camera, behind - np.array([0, RADIUS, 0])), axis=1) / np.linalg.norm(
        to_camera, axis=1
    )
    assert (along > RADIUS).all()  # no point is seen through the ball


def test_nothing_to_compare_is_no_evidence():
    blind = channels(np.ones((CAMERA.height, CAMERA.width, 3)))
    blind[..., 6] = 0
    sight = dataclasses.replace(sights(False)["a"], picture=blind)
    found = plane_pairs(sight)
    assert len(found) == 0
    assert measure([found]) is None
    assert dents(sight, 100.0, np.eye(3) * 1e-8, patch_shifts(found)) is None
    empty, figures, _ = find_dirt(
        {"a": sight}, {"a": found}, None, Surface(TRUE, np.zeros(3)), 0.97, {"a": (CAMERA.height, CAMERA.width)}, []
    )
    assert not empty
    assert not figures


# ---- angle dependence ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(REFLECTANCE))
def test_metals_pass_their_two_angles(name):
    facing, grazing = (np.array(values) for values in REFLECTANCE[name])
    assert reflectance_at(facing, grazing, np.array([1.0, GRAZING])) == pytest.approx(np.stack([facing, grazing]))
    base, tint = preset(name)
    surface = Surface(base, np.zeros(3), tint)
    assert surface.at(np.array([0.0, np.sqrt(1 - GRAZING**2)])) == pytest.approx(np.stack([facing, grazing]))


def test_without_a_tint_all_angles_are_the_same():
    assert Surface(TRUE, np.zeros(3)).at(np.array([[0.0, 0.9], [np.nan, 1.0]])) == pytest.approx(
        np.broadcast_to(TRUE, (2, 2, 3))
    )


def test_the_manifest_knows_the_metals():
    assert set(get_args(Metal)) == set(REFLECTANCE)
    assert MirrorBallFacts(diameter_m=0.1).reflectance is None
    assert MirrorBallFacts(diameter_m=0.1, material="silver").material == "silver"


# ---- what is used --------------------------------------------------------------------------------------------------


def finding(values: np.ndarray, sigma: float = 0.004, tint: float | None = None) -> Measured:
    return Measured(values, sigma * values, tint, 1000, 20, np.zeros(3))


def test_given_and_measured_are_averaged_when_they_agree():
    surface, warnings = decide(TRUE, None, finding(TRUE * 1.003))
    share = 0.004**-2 / (0.004**-2 + ball_surface.GIVEN_SIGMA**-2)
    assert surface.facing == pytest.approx(TRUE * (1 + 0.003 * share), rel=1e-4)
    assert surface.source == "given and measured"
    assert not warnings
    # two independent statements of the same thing
    assert surface.sigma == pytest.approx(1 / np.hypot(1 / 0.004, 1 / ball_surface.GIVEN_SIGMA), rel=0.01)


def test_given_is_doubted_when_measured_disagrees():
    surface, warnings = decide(np.full(3, 0.93), None, finding(np.full(3, 0.80)))
    assert (surface.facing == 0.93).all()
    assert surface.sigma == pytest.approx(0.13 / 0.93, rel=1e-6)
    assert "given (0.930, 0.930, 0.930), measured (0.800, 0.800, 0.800) +- (0.003, 0.003, 0.003)" in warnings[0]


def test_a_glossy_plane_doubts_nothing():
    """Measured 14 to 28 % too low on a lacquered table: the given stays, and no surer or unsurer by it."""
    found = under_gloss(finding(np.array([0.79, 0.71, 0.62])))
    assert decide(np.array([0.92, 0.90, 0.87]), None, finding(np.array([0.79, 0.71, 0.62])))[1]
    surface, warnings = decide(np.array([0.92, 0.90, 0.87]), None, found)
    assert not warnings
    np.testing.assert_allclose(surface.sigma, GIVEN_SIGMA, rtol=0.02)
    surface, _ = decide(None, None, found)
    assert (np.abs(surface.facing - (0.92, 0.90, 0.87)) < 2 * surface.sigma * surface.facing).all()


def test_measured_serves_when_nothing_is_given():
    surface, warnings = decide(None, None, finding(TRUE, tint=1.0))
    assert (surface.facing == TRUE).all()
    assert surface.sigma == pytest.approx(0.004)
    assert surface.tint == pytest.approx(1.0)
    assert surface.source == "measured"
    assert not warnings


def test_metal_by_name():
    surface, warnings = decide(None, "aluminium", None)
    assert surface.facing == pytest.approx(REFLECTANCE["aluminium"][0])
    assert surface.source == "aluminium"
    assert surface.sigma == pytest.approx(ball_surface.GIVEN_SIGMA)
    assert not warnings
    scaled, _ = decide(TRUE, "aluminium", None)
    assert (scaled.facing == TRUE).all()
    assert scaled.tint is not None


def test_nothing_known_is_chrome_and_said():
    surface, warnings = decide(None, None, None)
    assert surface.facing == pytest.approx(REFLECTANCE["chromium"][0])
    assert (surface.sigma == 0.1).all()
    assert "neither given nor measurable" in warnings[0]


# ---- dirt ----------------------------------------------------------------------------------------------------------


@functools.cache
def masks(spotted: bool, *views: str) -> tuple[dict[str, np.ndarray], list[str]]:
    chosen = {view: sights(spotted)[view] for view in views}
    pairs = {view: plane_pairs(sight) for view, sight in chosen.items()}
    found = measure(list(pairs.values()))
    warnings: list[str] = []
    shapes = dict.fromkeys(views, (CAMERA.height, CAMERA.width))
    dirt, _, _ = find_dirt(chosen, pairs, found, Surface(TRUE, np.zeros(3)), 0.97, shapes, warnings)
    return dirt, warnings


def true_mask(view: str, spot: str, grown: float) -> np.ndarray:
    """(H, W) of the pixels on a spot, its radius grown [rad]."""
    axis, size = SPOTS[spot]
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    normal = ball_points(sights(True)[view], np.stack([x, y], -1).reshape(-1, 2) + 0.5)[0]
    on = normal @ (axis / np.linalg.norm(axis)) > -1e-9 + np.cos(min(size + grown, np.pi))
    return on.reshape(CAMERA.height, CAMERA.width)


def test_a_clean_ball_has_no_dirt():
    assert masks(False, "a", "b") == ({}, [])


def test_dirt_is_found_by_two_views_and_by_the_plane():
    dirt, warnings = masks(True, "a", "b")
    assert set(dirt) == {"a", "b"}
    assert len(warnings) == 2
    for view, mask in dirt.items():
        about = true_mask(view, "above", 0.0) | true_mask(view, "below", 0.0)
        # The mask grows by a square of 4 px: 0.065 rad at its corners on 90 px, three times that towards the limb.
        ball = true_mask(view, "above", 4.0)
        assert not (mask & ball & ~(true_mask(view, "above", 0.2) | true_mask(view, "below", 0.2))).any(), view
        assert (mask & about).sum() > 0.9 * about.sum(), view


def test_one_view_finds_what_hides_the_plane_only():
    dirt, _ = masks(True, "a")
    assert (dirt["a"] & true_mask("a", "below", 0.0)).sum() > 0.5 * true_mask("a", "below", 0.0).sum()
    assert not (dirt["a"] & true_mask("a", "above", 0.02)).any()


def test_dirt_does_not_pull_the_reflectance():
    found = measure([plane_pairs(sight) for sight in sights(True).values()])
    assert found is not None
    assert (np.abs(found.facing - TRUE) < 3 * found.sigma).all()


def test_masked_pixels_are_unknown_and_the_rest_untouched():
    mask = np.zeros((4, 6), bool)
    mask[1, 2] = True
    whole = Raster({**Raster.split(np.ones((4, 6, 3), np.float32)), "mask": np.zeros((4, 6), np.uint32)}, "acescg")
    left = without(whole, mask)
    assert np.isnan(left.rgb()[1, 2]).all()
    assert np.isnan(left.rgb()).sum() == 3
    assert without(whole, None) is whole


def test_large_balls_are_looked_at_in_larger_pixels():
    """Twice the pixels: the same pairs from pictures binned 2 x 2, and a mask that returns to them."""
    camera = CAMERA.model_copy(
        update={
            "width": 840, "height": 640, "fx": CAMERA.fx * 2, "fy": CAMERA.fy * 2, "cx": CAMERA.cx * 2,
            "cy": CAMERA.cy * 2,
        }
    )  # fmt: skip
    picture = photograph(Place(ROOM, plane=True, ball=BALL, reflectance=tuple(TRUE)), camera, POSES["a"], 1)
    whole = Raster(
        {
            **Raster.split(np.float32(picture)), **Raster.split(np.float32(1e-6 * picture), "variance"),
            "mask": np.zeros(picture.shape[:2], np.uint32),
        },
        "acescg",
    )  # fmt: skip
    centre = transform_points(invert_rigid(POSES["a"]), np.array(BALL))
    sight = neighbourhood(whole, camera, POSES["a"], centre, RADIUS)
    assert sight.binned == 2
    found = measure([plane_pairs(sight)])
    assert found is not None
    assert found.facing == pytest.approx(TRUE, rel=0.003)  # one ray per pixel; as METHOD_SIGMA
    mask = np.zeros(sight.picture.shape[:2], bool)
    mask[5, 7] = True
    rows, columns = np.nonzero(unbinned(mask, sight, picture.shape[:2]))
    assert (rows.min(), rows.max()) == (sight.corner[1] + 10, sight.corner[1] + 11)
    assert (columns.min(), columns.max()) == (sight.corner[0] + 14, sight.corner[0] + 15)
