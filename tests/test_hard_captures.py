"""What is hard about the bundled captures is climbed by evidence, and what the evidence says it saves is saved."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import SAMPLES

from pipeline.image.truth import load_truth
from pipeline.probes.anchor import MOST_LEFT_PX
from pipeline.run import artifacts as A
from pipeline.run import formats, settings, substitution
from pipeline.run.runner import Build
from pipeline.transport import local_light
from stages.knobs import KNOBS
from stages.order import graph


def built(out: Path) -> Build:
    return Build(graph(), out, settings.load(out), KNOBS)


def numbers(out: Path, stage: str) -> dict[str, Any]:
    return json.loads((out / stage / "record.json").read_text())["numbers"]


def evidence_of(out: Path, stage: str, term: str) -> dict[str, Any]:
    rows = json.loads((out / stage / "record.json").read_text())["evidence"]
    return next(row for row in rows if row["term"] == term)


def values_of(build: Build) -> dict[str, Any]:
    return {one.name: build.value(one) for stage in build.graph.stages for one in stage.outputs.values()}


def forced(out: Path, name: str, change: Any, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Metrics of a build with an artifact replaced by what ``change`` makes of all values; the rest computed again."""
    build = built(out)
    values = values_of(build)
    monkeypatch.setitem(substitution.TRUTHS, "forced", (name, lambda values, truth: change(values)))
    truth = load_truth(Path(values["facts"]["truth_path"]))
    return substitution.recompute(build, values, truth, ["forced"])["metrics"]


def forced_off(out: Path, term: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics of a build, and with a term of the model off, as by ``insitu evaluate --without``."""
    build = built(out)
    values = values_of(build)
    return values["metrics"], substitution.forced_off(build, values, term)["metrics"]


# ---------------------------------------------------------------- courtyard: a sun clipped in every frame


def test_sun_of_the_courtyard_is_recovered_from_the_shadow_of_the_ball(courtyard_build):
    """Flux within three stated sigma of the true one, and within the project's 3 %; direction within half a degree."""
    (sun,) = formats.read(courtyard_build / "lights", A.EMITTERS)
    assert (sun.name, sun.evidence, sun.lower_bound) == ("sun", "recovered", False)
    (row,) = numbers(courtyard_build, "probe")["clipped_lights"]
    assert np.mean(row["flux"]) > 20 * np.mean(row["bound"])  # the photographs themselves hold a twentieth at most
    truth = load_truth(Path(formats.read(courtyard_build / "ingest", A.FACTS)["truth_path"]))
    scale = json.loads((courtyard_build / "evaluate/metrics.json").read_text())["scale"]
    flux, towards = true_sun(truth.environment)
    error = sun.irradiance / (scale * flux) - 1
    assert np.abs(error).max() < 0.03
    assert (np.abs(error) < 3 * sun.irradiance_sigma / sun.irradiance).all()
    assert np.degrees(np.arccos(np.clip(sun.direction @ towards, -1, 1))) < 0.5


def true_sun(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance (3,) facing the sun, and direction (3,), from the texels of a true map that outshine all others."""
    from pipeline.conventions import latlong_directions, latlong_solid_angles

    inside = light.mean(-1) > 100 * np.median(light.mean(-1))
    weight = latlong_solid_angles(*light.shape[:2])[inside][:, None] * light[inside]
    towards = (weight.mean(-1)[:, None] * latlong_directions(*light.shape[:2])[inside]).sum(0)
    return weight.sum(0), towards / np.linalg.norm(towards)


@pytest.mark.slow
def test_without_the_recovery_the_courtyard_loses_what_it_said_it_would(courtyard_build):
    """The sun left at what the photographs hold. Predicted: its share of all light, 45 %, is lost.

    Measured: error of the shadows' change 0.011 -> 0.90, on the objects 0.018 -> 0.17; they are seen from their shaded
    side, and the ground, its albedo held at 0.98, still throws on them what it shows.
    """
    (row,) = numbers(courtyard_build, "probe")["clipped_lights"]
    left = np.array(row["bound"]) / np.array(row["flux"])
    predicted = row["share"] * (1 - left.mean())
    before, after = forced_off(courtyard_build, "sun")
    assert after["shadow_change_err"] - before["shadow_change_err"] > predicted / 2
    assert after["object_rel_err"] > 5 * before["object_rel_err"]


# ---------------------------------------------------------------- lacquer: a ground that mirrors, its coat none of ours


def test_gloss_of_the_lacquer_is_taken_up_by_held_out_evidence(lacquer_build):
    """The true coat has alpha 0.10 and an index of 1.5: in our nearest material, roughness 0.316 and f0 0.04.

    It is another function than ours (light goes through it twice, and around within it), so what fits best is not that:
    measured 0.346 and 0.065, 444 nats and 6.5 sigma over diffuse.
    """
    surface = formats.read(lacquer_build / "reflectance", A.SURFACE)
    assert surface.model == "rough"
    assert surface.roughness == pytest.approx(0.346, abs=0.05)
    assert 0.03 < surface.f0 < 0.1
    rough = next(row for row in surface.scores if row["model"] == "rough")
    assert rough["gain"] > 100
    assert rough["sigmas"] > 4


def test_what_does_not_fit_the_lacquer_is_said(lacquer_build):
    """The board is not lacquered: its ink becomes darker than black when the gloss is taken off, and that is said."""
    said = json.loads((lacquer_build / "reflectance/record.json").read_text())["warnings"]
    assert any("lie below 0 beyond their noise" in line for line in said)


def test_the_ball_on_lacquer_is_found_by_the_print_beside_it(lacquer_build):
    """The window's mirror image changes the contrast of board and table by place, which moves nothing.

    Measured: centre off by 0.26 mm, a quarter of a pixel, much of it the pose's error; by rim and height 1.6 mm.
    """
    found = numbers(lacquer_build, "probe")
    anchor = found["ball_a"]["mirrored_plane"]
    assert anchor["used"]
    assert anchor["left_with_its_contrast_px"] > MOST_LEFT_PX  # what left the contrast free
    true = json.loads((SAMPLES / "lacquer/truth/truth.json").read_text())["ball"]["centre_world_m"]
    assert np.linalg.norm(np.subtract(found["ball_a"]["centre_world_m"], true)) < 5e-4
    # The ratio of the plane's image to the plane is 14 to 28 % low for the same reason: the given is not doubted by it.
    assert max(found["reflectance"]["sigma_rel"]) < 0.021
    because = evidence_of(lacquer_build, "probe", "reflectance measured from the plane")["because"]
    assert "for the plane's gloss" in because


@pytest.mark.slow
def test_without_gloss_the_lacquer_is_worse(lacquer_build):
    """Forced to a diffuse ground. Predicted: 32 % of the shadows' change.

    Measured: error of the shadows' change 0.062 -> 0.241, on the objects 0.050 -> 0.083; they mirror the
    ground, of which the plate shows what it is.
    """
    predicted = evidence_of(lacquer_build, "reflectance", "specular lobe of the ground")["bound_rel"]
    before, after = forced_off(lacquer_build, "gloss")
    assert predicted > 0.2
    assert after["shadow_change_err"] - before["shadow_change_err"] > predicted / 2
    assert after["object_rel_err"] > 1.3 * before["object_rel_err"]


# ---------------------------------------------------------------- cellar: near lamps, a knocked camera, lying labels


@pytest.mark.slow
def test_light_of_the_cellar_is_brought_to_the_objects_because_of_what_it_would_cost(cellar_build):
    """Forced off: the map as the ball saw it, 0.3 m away. Predicted: 18 % of the light on what objects show the camera,
    28 % of that on the plane; 6 % is left on the worst of six sides.

    Measured: error on the objects 0.045 -> 0.145, of the shadows' change 0.060 -> 0.306.
    """
    found = numbers(cellar_build, "probe")
    assert found["near_irradiance_error"] > 5 * KNOBS["probe"]().near_budget
    assert found["near_irradiance_error_left"] < 0.75 * found["near_irradiance_error"]
    before, after = forced_off(cellar_build, "near_field")
    assert after["object_rel_err"] - before["object_rel_err"] > found["near_object_error"] / 2
    assert after["shadow_change_err"] - before["shadow_change_err"] > found["near_plane_error"] / 2


@pytest.mark.slow
def test_true_light_of_the_places_explains_most_of_the_cellar(cellar_build):
    """The near light is what is hard here: no other truth takes more off the shadows, and places more than one map.

    Measured: shadows' change 0.060; 0.057 under the true light amid the objects, 0.046 under that of each one's place;
    0.058 with the true pose.
    """
    found = substitution.waterfall(built(cellar_build), ["probe", "pose", "places"], lambda _: None)
    errors = {label: found[label]["shadow_change_err"] for label in ("nothing", "probe", "pose", "places")}
    assert errors["places"] < errors["probe"] < errors["nothing"]
    assert errors["places"] < errors["pose"]
    assert errors["places"] < 0.85 * errors["nothing"]  # measured 0.76


@pytest.mark.slow
def test_frames_of_the_cellar_left_where_they_lie_cost_what_was_predicted(cellar_build):
    """Forced off: alignment. Predicted: 3.8 % of the ball view's light would lie elsewhere by more than the shift.

    The knocked frame is the one that most of the light is read from; the lamps are in the others. Measured: error on
    the objects 0.045 -> 0.086, of the shadows' change 0.060 -> 0.098, of the albedo 0.10 -> 0.25.
    """
    said = evidence_of(cellar_build, "merge", "alignment of frames")
    assert said["modelled"]
    assert said["predicted_rel"] > 0.02
    before, after = forced_off(cellar_build, "alignment")
    for figure in ("object_rel_err", "shadow_change_err", "albedo_rel_err"):
        assert after[figure] - before[figure] > said["predicted_rel"] / 2, figure


@pytest.mark.slow
def test_hand_and_labels_of_the_cellar_are_found_out(cellar_build):
    """Shifts are the stated turns'; every exposure is that of the shutter, not of the label, but for a common factor.

    Measured: 4.20 px of 4.03 on the axis (off it a turn moves more, by a tenth at the corners), 3.24 of 3.18; exposures
    within 0.6 % where labels are 40 and 20 % off.
    """
    camera = formats.read(cellar_build / "calibrate", A.CAMERA)
    merged = json.loads((cellar_build / "merge/record.json").read_text())
    aligned = next(row for row in merged["evidence"] if row["term"] == "alignment of frames")
    assert aligned["modelled"]
    for view, degrees in (("plate", 0.30), ("ball_a", 0.38)):
        turned = camera.fx * np.tan(np.radians(degrees))
        (told,) = [line for line in merged["warnings"] if line.startswith(f"{view}: frames lay")]
        assert float(told.split("up to ")[1].split()[0]) == pytest.approx(turned, rel=0.06)
    assert not [line for line in merged["warnings"] if "tone curve" in line or "NoiseProfile" in line]
    truth = json.loads((SAMPLES / "cellar/truth/truth.json").read_text())["exposures"]
    rows = [row for view in formats.read(cellar_build / "merge", A.EXPOSURES).values() for row in view]
    off = np.array([np.log(row["estimated_s"] / truth[row["file"]]["true_s"]) for row in rows])
    lies = np.array([np.log(row["label_s"] / truth[row["file"]]["true_s"]) for row in rows])
    assert np.ptp(lies) > np.log(1.4 / 0.8) - 0.1
    assert np.abs(off - np.median(off)).max() < 0.01


@pytest.mark.slow
def test_labels_of_the_cellar_at_their_word_cost_what_was_predicted(cellar_build):
    """Forced: exposures by their labels. Predicted: 2.7 % of the ball view's light, 32 % of what its short frames hold.

    Those are the lamps. Measured: error on the objects 0.045 -> 0.080, of the shadows' change 0.060 -> 0.116, of the
    albedo 0.099 -> 0.203: more than the first figure, as the lamps give half of the light on little of the picture.
    """
    said = evidence_of(cellar_build, "merge", "exposure errors")
    assert said["modelled"]
    assert said["bound_rel"] > 0.25
    before, after = forced_off(cellar_build, "exposures")
    for figure in ("object_rel_err", "shadow_change_err", "albedo_rel_err"):
        assert said["predicted_rel"] / 2 < after[figure] - before[figure] < said["bound_rel"], figure


# ---------------------------------------------------------------- corner: bright surfaces that light each other


@pytest.mark.slow
def test_bounce_in_the_corner_is_taken_off_because_of_what_it_would_cost(corner_build, monkeypatch):
    """Forced off: what the walls throw on the table is taken for albedo. Predicted: 7.6 % too bright (median).

    Measured: error of the albedo 0.031 -> 0.093, of the shadows' change 0.067 -> 0.157; the objects keep theirs, 0.03.
    """
    found = numbers(corner_build, "reflectance")
    bounce = local_light.local_light

    def without(*given: Any) -> local_light.LocalLight:
        near = bounce(*given)
        return replace(near, irradiance=near.irradiance - near.bounced)

    monkeypatch.setattr(local_light, "local_light", without)
    before = json.loads((corner_build / "evaluate/metrics.json").read_text())
    after = forced(corner_build, "plane", lambda values: values["plane"], monkeypatch)
    assert after["albedo_rel_err"] - before["albedo_rel_err"] > found["bounce_ignored_rel"] / 2


@pytest.mark.slow
def test_walls_of_the_corner_have_their_colour(corner_build):
    """Albedo of both proxies, which capture.toml does not say, against the scene file; measured 1.7 and 1.2 % off."""
    scene = tomllib.loads((SAMPLES / "scenes/corner.toml").read_text())
    true = {box["name"]: np.array(box["albedo"]) for box in scene["box"]}
    for proxy in formats.read(corner_build / "reflectance", A.LOCAL_PROXIES):
        error = np.linalg.norm(proxy.albedo - true[proxy.name]) / np.linalg.norm(true[proxy.name])
        assert error < 0.03, proxy.name
