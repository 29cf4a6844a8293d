"""Truth in place of a stage: what is refused, and that it lowers the error it should."""

import numpy as np
import pytest
from command import DESK, command

from pipeline.conventions import direction_from_latlong
from pipeline.image.truth import Truth
from pipeline.light import near_field
from pipeline.run import settings, substitution
from pipeline.run.errors import ManifestError
from pipeline.run.runner import Build
from pipeline.run.substitution import true_environment, waterfall
from pipeline.types import Camera, Raster, View
from stages.knobs import KNOBS
from stages.order import graph


def built(out) -> Build:
    return Build(graph(), out, settings.load(out), KNOBS)


def test_unknown_names_are_refused(desk_build):
    with pytest.raises(ManifestError, match="lens"):
        waterfall(built(desk_build), ["lens"], str)


def test_unknown_terms_are_refused(desk_build):
    with pytest.raises(ManifestError, match="--without: is colour; expected names of alignment"):
        waterfall(built(desk_build), [], str, ["colour"])


def test_empty_terms_are_none(desk_build):
    refused = command("evaluate", DESK, "--out", desk_build, "--without", "sun,,colour, ")
    assert refused.returncode == 2
    assert "--without: is colour; expected" in refused.stderr


@pytest.mark.parametrize(("names", "terms", "said"), [(["probe"], [], "--with-truth"), ([], ["sun"], "--without")])
def test_a_capture_without_truth_is_refused_by_the_option_that_asks_for_it(names, terms, said, desk_build, monkeypatch):
    build = built(desk_build)
    monkeypatch.setattr(build, "value", lambda artifact: {})
    with pytest.raises(ManifestError, match=f"^{said}: this capture has no truth"):
        waterfall(build, names, str, terms)


def test_rows_of_both_questions_are_kept_while_composite_and_truth_stay(desk_build, tmp_path, monkeypatch):
    build = Build(graph(), tmp_path, settings.load(desk_build), KNOBS)
    composite = {"outputs": {"composite": "one"}}
    monkeypatch.setattr(build, "record", lambda name: composite)
    build.keep_waterfall({"nothing": {"e": 0.5}, "without sun": {"e": 0.9}})
    build.keep_waterfall({"nothing": {"e": 0.5}, "probe": {"e": 0.3}})
    build.keep_waterfall({"nothing": {"e": 0.5}, "probe": {"e": 0.2}})  # asked again: the new row
    rows = {"nothing": {"e": 0.5}, "probe": {"e": 0.2}, "without sun": {"e": 0.9}}
    assert build.waterfall() == rows
    assert list(build.waterfall()) == list(rows)
    build.keep_waterfall({"nothing": {"e": 0.4}, "pose": {"e": 0.3}})  # another truth
    assert list(build.waterfall()) == ["nothing", "pose"]
    composite["outputs"]["composite"] = "two"
    build.keep_waterfall({"nothing": {"e": 0.4}, "albedo": {"e": 0.1}})
    assert list(build.waterfall()) == ["nothing", "albedo"]


def test_environment_is_turned_and_scaled():
    """A map whose centre looks along +X of the world, under a rotation; the plate's unit is twice the truth's."""
    light = np.zeros((8, 16, 3), np.float32)
    light[4, 8] = 1.0  # along +Z of the map
    world_from_map = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)  # +Z of the map is +X of the world
    plate = np.full((12, 12, 3), 0.5)
    truth = Truth(plate, plate, {}, environment=light, world_from_map=world_from_map)
    used = Raster(Raster.split(light), "acescg")
    values = {"photographs": {"plate": Raster(Raster.split(2 * plate), "acescg")}, "environment": used, "facts": {}}
    found = true_environment(values, truth)["R"]
    assert np.unravel_index(found.argmax(), found.shape) == (4, 4)  # u = 1/4 is +X
    assert found.max() == pytest.approx(2.0, rel=0.02)  # the lookup rounds positions to 1/32 texel


def test_true_light_is_brought_to_where_the_map_that_it_replaces_holds():
    """A lamp on a wall 1 m away in +X: from 0.5 m nearer to +Z it is seen 26.6 degrees off; texels are 5.6 wide."""
    light = np.zeros((32, 64, 3))
    light[15:17, 15:17] = 1.0
    plate = np.ones((12, 12, 3))
    truth = Truth(plate, plate, {}, environment=light, world_from_map=np.eye(3))
    measured, valid = np.array([0, 1.0, 0]), np.array([0, 1.0, 0.5])
    used = Raster(Raster.split(light), "acescg", near_field.places(valid, measured))
    room = {"centre_m": [0, 1.0, 0], "size_m": [2.0, 6.0, 8.0], "yaw_deg": 0.0}
    values = {"photographs": {"plate": Raster(Raster.split(plate), "acescg")}, "environment": used}
    found = true_environment({**values, "facts": {"room": room}}, truth)["R"]
    row, column = np.unravel_index(found.argmax(), found.shape)
    x, _, z = direction_from_latlong(np.array((column + 0.5) / 64), np.array((row + 0.5) / 32))
    assert np.degrees(np.arctan2(-z, x)) == pytest.approx(np.degrees(np.arctan(0.5)), abs=6)


def near_values(light, valid):
    """Values and truth of a room with objects at x = -0.5 and 0.5 m, seen from above by a lens of 10 px per metre."""
    plate = np.ones((12, 24, 3))
    used = Raster(Raster.split(light), "acescg", near_field.places(valid, np.array([0, 0.1, 2.0])))
    down = np.array([[1, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    camera = Camera(width=24, height=12, fx=10, fy=10, cx=12, cy=6)
    values = {
        "photographs": {"plate": Raster(Raster.split(plate), "acescg")}, "environment": used, "camera": camera,
        "views": {"plate": View(world_from_camera=down, covariance=np.eye(6), route="given", rms_px=0, points=0)},
        "wishes": {"object": [{"position_m": [x, 0.0]} for x in (-0.5, 0.5)]}, "facts": {},
        "layers": Raster({"with.R": plate[..., 0]}, "acescg"),
    }  # fmt: skip
    elsewhere = [(np.array([x, 0.1, 0.0]), np.full(light.shape, 2.0 + x)) for x in (0.0, -0.5, 0.5)]
    return values, Truth(plate, plate, {}, environment=light, elsewhere=elsewhere)


def test_true_light_of_the_place_itself_is_taken_where_the_truth_tells_it():
    light = np.ones((8, 16, 3))
    values, truth = near_values(light, np.array([0.0, 0.11, 0.0]))
    np.testing.assert_allclose(true_environment(values, truth)["R"], 2.0)
    values, truth = near_values(light, np.array([0.2, 0.1, 0.0]))  # no place that it tells
    np.testing.assert_allclose(true_environment(values, truth)["R"], 1.0)


def test_layers_under_the_light_of_every_place_are_interpolated(monkeypatch):
    """Each object's pixels have its own light, those halfway the mean; where any light changes, all are influenced."""
    values, truth = near_values(np.ones((8, 16, 3)), np.array([0.0, 0.1, 0.0]))

    def recompute(build, values, truth, names, given, last):
        assert (names, last) == (["albedo"], "render")
        level = float(given["environment"]["R"].mean())
        influence = np.zeros((12, 24), np.float32)
        influence[:, int(level * 4)] = 1
        return {"layers": Raster({"with.R": np.full((12, 24), level), "influence": influence}, "acescg")}

    monkeypatch.setattr(substitution, "recompute", recompute)
    found = substitution.true_places(values, truth, None, ["probe", "albedo", "places"])
    assert found["with.R"][6, 6] == pytest.approx(1.5, abs=0.02)  # feet at pixels (7, 6) and (17, 6): 1 : 75
    assert found["with.R"][6, 17] == pytest.approx(2.5, abs=0.02)
    np.testing.assert_allclose(found["with.R"][:, 11:13].mean(), 2.0, atol=1e-6)
    assert sorted(np.flatnonzero(found["influence"].any(0))) == [6, 10]
    assert found["influence"].max() == 1
    with pytest.raises(ManifestError, match="does not tell the light at every object"):
        substitution.true_places(values, Truth(truth.plate, truth.plate, {}), None, ["places"])


@pytest.mark.slow
def test_true_light_lowers_the_error_of_the_desk(tmp_path):
    """At preview, where noise is no longer the largest term: measured 0.70 of the error, shadow 0.019."""
    done = command("run", DESK, "--out", tmp_path / "out", "--quality", "preview")
    assert done.returncode == 0, done.stderr
    found = waterfall(built(tmp_path / "out"), ["probe", "camera", "pose", "albedo"], str)
    everything = next(errors for label, errors in found.items() if "+" in label)
    assert everything["object_rel_err"] < 0.8 * found["nothing"]["object_rel_err"]
    assert everything["shadow_change_err"] <= 0.04
