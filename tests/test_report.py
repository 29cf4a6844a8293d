from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.image import figures as fig
from pipeline.image import panels
from pipeline.image.display import display_transform
from pipeline.types import Raster
from stages import evaluate, knobs, report
from tests import staged

RECORD = {
    "numbers": {"rms_px": 0.21, "held": {"k1_rel": 0.0123}, "source": "charuco", "ok": True, "none": None},
    "warnings": ["the <shortest> frame is clipped"],
    "evidence": [
        {"term": "k1", "modelled": True, "because": "held-out error", "could_cost": "0.1 px"},
        {"term": "k2", "modelled": False, "because": "no gain", "could_cost": "0.2 px", "bound_px": 0.21},
    ],
    "seconds": 1.25,
    "params": {"width": 512},
    "versions": {"numpy": "2.0"},
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    found = staged.artifacts()
    found["facts"]["truth_path"] = staged.write_truth(tmp_path_factory.mktemp("truth"), found, gain=0.95)
    result = evaluate.compute(**{n: found[n] for n in evaluate.STAGE.inputs}, params=knobs.Evaluate.model_validate({}))
    found |= result.outputs
    found |= trusted(found["composite"])
    found["display"] = display_transform(found["composite"].rgb())
    found["plate_display"] = display_transform(found["photographs"]["plate"].rgb())
    frame = {"file": "p_1.dng", "label_s": 0.25, "estimated_s": 0.251, "sigma_rel": 1e-3, "clipped_fraction": 0.01}
    found |= {"brackets": {}, "exposures": {"plate": [frame]}, "records": dict.fromkeys(report.TITLES, RECORD)}
    return found


def trusted(composite: Raster) -> dict[str, object]:
    """An uncertainty of 2 % with one shared error, clipped in a corner, and its budget."""
    rgb = composite.rgb()
    sigma = 0.02 * rgb
    sigma[:2, :2] = np.inf
    channels = {**Raster.split(sigma, "sigma"), **Raster.split(0.01 * rgb, "mode_scale")}
    parts = {"render": 0.012, "scale": 0.016, "total": 0.02}
    region = {"pixels": 900, "unknown_pixels": 4, "pixel_rel": parts, "mean_rel": parts, "mean_of_change": parts}
    return {
        "uncertainty": Raster(channels, "acescg", {"insitu:modes": "scale"}),
        "budget": {
            "regions": {"object": region},
            "not_covered": [{"stage": "probe", "term": "near field", "could_cost": "5 % of the irradiance"}],
        },
    }


def page_of(found, **changes):
    given = {**found, **changes}
    result = report.compute(**{n: given[n] for n in report.STAGE.inputs}, params=knobs.Report())
    return result.outputs["report"]


def test_page_is_self_contained(inputs):
    text = page_of(inputs)
    assert len(text) < 4e6
    assert not re.search(r"(src|href)=\"(?!data:|#)", text)
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)
    assert text.count("<section") == len(report.TITLES) + 2
    for name in report.TITLES:
        assert f'id="{name}"' in text


def test_budget_names_its_sources_and_what_it_leaves_out(inputs):
    text = page_of(inputs)
    assert "scale of the light: 1.6 %" in text
    assert "5 % of the irradiance" in text
    bare = page_of(inputs, budget={"regions": {}, "not_covered": []})
    assert "What no sigma covers" not in bare


def test_errors_stand_beside_doing_nothing(inputs):
    text = page_of(inputs)
    value = fig.reading("object_rel_err", inputs["metrics"]["object_rel_err"])
    nothing = fig.reading("object_rel_err", inputs["metrics"]["do_nothing"]["object_rel_err"])
    assert value in text
    assert f"doing nothing {nothing}" in text
    assert "off target" in text or "near target" in text


def test_text_is_escaped(inputs):
    facts = {**inputs["facts"], "name": "<script>alert(1)</script>"}
    text = page_of(inputs, facts=facts)
    assert "<script>alert" not in text
    assert "the &lt;shortest&gt; frame" in text


def test_same_inputs_same_bytes(inputs):
    assert page_of(inputs) == page_of(inputs)


def test_without_truth_the_self_check_leads(inputs):
    nothing = Raster({"class": np.zeros((1, 1), np.uint32)}, "data")
    text = page_of(inputs, metrics={}, error_map=nothing)
    assert "No truth is known" in text
    assert "rendered against photographed" in text
    assert "<h3>Against truth" not in text


def test_missing_things_are_absent(inputs):
    wishes = {"object": []}
    layers = Raster({name: 0 * values for name, values in inputs["layers"].channels.items()}, "acescg")
    environment = Raster({c: inputs["environment"][c] for c in "RGB"}, "acescg")
    facts = {**inputs["facts"], "board": None}
    text = page_of(
        inputs, wishes=wishes, layers=layers, environment=environment, facts=facts, balls={}, records={},
        selfcheck={"ball": {}, "shadow": {}, "pairs": {}}, metrics={},
        error_map=Raster({"class": np.zeros((1, 1), np.uint32)}, "data"),
    )  # fmt: skip
    assert "The ball, photographed" not in text
    full = page_of(
        inputs, wishes=wishes, layers=layers, environment=environment, facts=facts,
        selfcheck={"ball": {}, "shadow": {}, "pairs": {}},
    )  # fmt: skip
    assert "LS_obj over" not in full


def test_not_a_number_shows_up_in_words(inputs):
    metrics = {**inputs["metrics"], "object_rel_err": None, "psnr": float("nan")}
    assert "not known" in page_of(inputs, metrics=metrics)


def test_board_overlay_lies_on_the_projected_board(inputs):
    build = panels.Build(**{name: inputs[name] for name in panels.Build.__dataclass_fields__})
    view = build.views["plate"]
    lines, labels = panels.board_overlay(build, view, inputs["facts"]["board"])
    corner = fig.world_pixel(build.camera, view.world_from_camera, np.array([0.21, 0, 0.15]))
    ends = [np.array([float(v) for v in line.points.split()[-1].split(",")]) for line in lines]
    assert min(np.abs(end - corner).max() for end in ends) < 0.06  # written with one decimal
    assert [label.text for label in labels] == ["+x", "+y", "+z"]


def test_ball_outline_is_where_the_sphere_is_tangent(inputs):
    camera, ball = inputs["camera"], inputs["balls"]["ball_a"]
    points = np.array([pair.split(",") for pair in fig.ball_outline(camera, ball)[0].points.split()], float)
    from pipeline.camera.lens import pixel_rays

    rays = pixel_rays(camera, points)
    nearest = np.linalg.norm(np.cross(rays, ball.centre_camera_m), axis=-1)
    # A tenth of a pixel at 0.6 m and 200 px focal length is 0.3 mm.
    assert np.allclose(nearest, ball.radius_m, atol=3e-4)


def test_lines_behind_the_camera_are_left_out(inputs):
    camera, pose = inputs["camera"], inputs["views"]["plate"].world_from_camera
    behind = pose[:3, 3] - 2 * pose[:3, 2]
    assert fig.world_lines(camera, pose, [(behind, behind + 0.1, "x")]) == []
    crossing = fig.world_lines(camera, pose, [(behind, pose[:3, 3] + 2 * pose[:3, 2], "x")])
    assert all("nan" not in line.points for line in crossing)


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("rms_px", 0.2134, "0.213 px"), ("object_rel_err", 0.01234, "1.23 %"), ("n", 12345, "12 345"),
        ("ok", True, "yes"), ("x", None, "–"), ("x_deg", -0.5, "−0.5°"), ("x", 1e-7, "1·10⁻⁷".replace("1·", "1.0·")),
        ("x", float("inf"), "∞"), ("x", float("nan"), "not known"), ("size_px", [640, 480], "640 px, 480 px"),
        ("x", 0.0, "0"), ("x", 123.4, "123"), ("x", 99.96, "100"),
    ],
)  # fmt: skip
def test_readings(key, value, text):
    assert fig.reading(key, value) == text


def test_nested_numbers_become_rows():
    rows = fig.readings({"plate": {"rms_px": 0.5, "held_out": {"k1": 1.0}}})
    assert rows == [("plate · rms", "0.5 px"), ("plate · held out · k1", "1")]
    assert fig.readings({"contact_px": {"cube": 0.25}}) == [("contact · cube", "0.25 px")]


def test_lights():
    assert [panels.light_of(v, 0.02, 0.05) for v in (0.02, 0.03, 0.06, None)] == ["good", "fair", "bad", ""]
    assert panels.light_of(0.5, None, None) == ""


def test_mask_bits_survive_reduction():
    mask = np.zeros((1000, 1200), np.uint32)
    mask[501, 701] = 8
    assert (panels.reduced_mask(mask) == 8).sum() == 1


def test_what_was_left_out_stands_with_its_bound(inputs):
    page = page_of(inputs)
    assert "0.210 px" in page
    assert page.count("no gain") == page.count("0.210 px")
