from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.camera.rigid import rotation_exp
from pipeline.image.truth import load_truth, other_scene, read_acescg
from pipeline.run import formats
from pipeline.run.errors import ArtifactError, ManifestError
from pipeline.types import Raster
from stages import evaluate, knobs
from tests import staged


@pytest.fixture(scope="module")
def everything():
    return staged.artifacts()


def run(found, **changes):
    inputs = {name: {**found, **changes}[name] for name in evaluate.STAGE.inputs}
    return evaluate.compute(**inputs, params=knobs.Evaluate.model_validate({}))


def with_truth(found, folder, **options):
    return {**found["facts"], "truth_path": staged.write_truth(folder, found, **options)}


def test_without_truth_there_are_no_metrics(everything):
    result = run(everything)
    assert result.outputs["metrics"] == {}
    assert result.outputs["error_map"].shape == (1, 1)
    assert result.numbers["untouched_identical"] is True


def test_perfect_result_scores_perfectly(everything, tmp_path):
    result = run(everything, facts=with_truth(everything, tmp_path))
    found = result.outputs["metrics"]
    assert found["scale"] == pytest.approx(2)
    # float32 pictures: 6e-8 of the value, up to 1e-4 of a change of 0.5 %.
    for key in ("object_rel_err", "shadow_change_err", "faint_change_err", "shadow_rel_err", "flip"):
        assert found[key] < 1e-4, key
    assert found["do_nothing"]["shadow_change_err"] == pytest.approx(1)
    assert found["do_nothing"]["flip"] > 0.01
    assert found["pose_rot_deg"] < 1e-9
    assert found["probe_irradiance_rel_err"] < 1e-6
    assert found["albedo_rel_err"] < 1e-6
    assert found["albedo_known_fraction"] == 1
    assert found["albedo_gain"] == pytest.approx(1)
    assert found["shadow_outside_region"] == 0
    assert set(found["probe_irradiance_rel_err_of"]) == {"+x", "-x", "+y", "-y", "+z", "-z"}


CUBE = {"name": "cube", "sha256": "ab", "position_m": [0.1, 0.05], "yaw_deg": 0.0}
WISHED = {**CUBE, "lift_m": 0.0, "scale": 1.0, "material": None}


def test_a_truth_of_another_scene_gives_no_figures(everything, tmp_path):
    facts = with_truth(everything, tmp_path)
    (remark,) = run(everything, facts=facts, wishes={"object": [WISHED]}).warnings
    assert remark.startswith("truth.json: names no objects, so its picture is taken to show those of scene.toml")
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"objects": [CUBE]}))
    same = run(everything, facts=facts, wishes={"object": [WISHED]})
    assert "other_scene" not in same.numbers
    assert same.outputs["metrics"]["object_rel_err"] < 1e-4
    lifted = run(everything, facts=facts, wishes={"object": [{**WISHED, "lift_m": 0.1}]})
    assert lifted.outputs["metrics"] == {}
    assert lifted.outputs["error_map"].shape == (1, 1)
    assert lifted.numbers["other_scene"] == ["cube: lift_m is 0.1, there 0"]
    assert any(line.startswith("the truth shows another scene: no figures") for line in lifted.warnings)
    assert not any("names no objects" in line for line in [*same.warnings, *lifted.warnings])


def test_what_of_a_scene_differs_from_the_truths():
    other = {**CUBE, "name": "ring", "sha256": "cd"}
    assert other_scene(None, [WISHED]) == []  # nobody says
    assert other_scene([other, CUBE], [{**WISHED, "name": "box", "yaw_deg": 360.0}, other]) == []
    assert other_scene([CUBE], []) == ["cube is in it alone"]
    assert other_scene([CUBE], [WISHED, other]) == ["ring is not in it"]
    changed = {**WISHED, "sha256": "ef", "position_m": [0.1, 0.06], "material": {"conductor": "gold"}}
    words = ["cube: another file", "cube: position_m is 0.1, 0.06, there 0.1, 0.05", "cube: another material"]
    assert other_scene([CUBE], [changed]) == words


def test_object_error_is_what_it_is(everything, tmp_path):
    found = run(everything, facts=with_truth(everything, tmp_path, gain=1 / 1.1)).outputs["metrics"]
    assert found["object_rel_err"] == pytest.approx(0.1, rel=1e-4)
    assert found["object_rel_err_of"] == {"cube": pytest.approx(0.1, rel=1e-4)}


def test_turned_camera_is_measured(everything, tmp_path):
    facts = with_truth(everything, tmp_path)
    plate = everything["views"]["plate"]
    moved = plate.world_from_camera.copy()
    moved[:3, :3] = rotation_exp(np.array([0, np.radians(0.3), 0])) @ moved[:3, :3]
    views = {**everything["views"], "plate": plate.model_copy(update={"world_from_camera": moved})}
    found = run(everything, facts=facts, views=views).outputs["metrics"]
    assert found["pose_rot_deg"] == pytest.approx(0.3)
    assert found["pose_pos_rel"] < 1e-9


def test_turned_probe_is_measured(everything, tmp_path):
    facts = with_truth(everything, tmp_path)
    light = everything["environment"].rgb()
    turned = staged.acescg(np.roll(light, light.shape[1] // 2, 1))
    found = run(everything, facts=facts, environment=turned).outputs["metrics"]
    each = found["probe_irradiance_rel_err_of"]
    assert each["+y"] < 1e-3  # half a turn about the vertical moves nothing overhead
    assert each["+x"] > 0.05


def test_world_from_map_turns_the_truth(everything, tmp_path):
    path = with_truth(everything, tmp_path)["truth_path"]
    truth = json.loads((tmp_path / "truth.json").read_text())
    light = staged.sky()
    quarter = light.shape[1] // 4
    formats.write_exr(tmp_path / "light.exr", staged.acescg(np.roll(light, quarter, 1) / 2))
    # Rolling right by a quarter adds pi/2 to phi: what was at +x (phi = pi/2) is now at +z (phi = pi).
    truth["environment"]["world_from_map"] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    found = run(everything, facts={**everything["facts"], "truth_path": path}).outputs["metrics"]
    assert found["probe_irradiance_rel_err"] < 1e-3


def test_touched_pixel_outside_the_region_is_told(everything):
    channels = {name: values.copy() for name, values in everything["composite"].channels.items()}
    channels["R"][0, 0] += 1e-6
    result = run(everything, composite=Raster(channels, "acescg"))
    assert result.numbers["untouched_identical"] is False
    assert result.warnings


def test_not_a_number_is_counted_and_scored(everything, tmp_path):
    channels = {name: values.copy() for name, values in everything["composite"].channels.items()}
    channels["G"][60, 60] = np.nan
    result = run(everything, facts=with_truth(everything, tmp_path), composite=Raster(channels, "acescg"))
    assert result.outputs["metrics"]["non_finite"] == 1
    assert np.isfinite(result.outputs["metrics"]["object_rel_err"])
    assert "not finite" in result.warnings[0]


def test_self_check_of_a_perfect_capture(everything):
    checks = run(everything).outputs["selfcheck"]
    for name in ("ball_a", "ball_b"):
        # The photograph was made by the same mirror from the same map.
        assert checks["ball"][name]["median_rel_err"] < 1e-4
        assert checks["ball"][name]["in_sample"] is True
    pair = checks["pairs"]["ball_a-ball_b"]
    assert pair["texels"] > 40  # the balls are 18 px: 800 pixels on 8192 texels, a part of them in both
    # Means over different parts of a 2.8 deg texel of a sky whose slope is 0.5 per radian: 0.5 * 0.05 / 2.
    assert pair["median_rel_diff"] < 0.012
    assert pair["gain"] == pytest.approx(1, abs=0.01)
    shadow = checks["shadow"]["ball_a"]
    assert set(checks["shadow"]) == {"ball_a"}
    assert shadow["points"] > 200
    # 5x5 means over a curved shadow.
    assert shadow["with_mirror_median_abs_err"] < 0.005
    assert shadow["with_mirror_correlation"] > 0.98
    assert shadow["gain"] == pytest.approx(1, abs=1e-3)
    assert checks["paper"]["albedo"] == pytest.approx([staged.ALBEDO] * 3)
    assert checks["paper"]["neutrality"] == pytest.approx(1)


def test_self_check_sees_a_map_turned_by_ten_degrees(everything):
    light = everything["environment"].rgb()
    turned = staged.acescg(np.roll(light, round(light.shape[1] * 10 / 360), 1))
    right = run(everything).outputs["selfcheck"]["ball"]["ball_a"]["median_rel_err"]
    wrong = run(everything, environment=turned).outputs["selfcheck"]["ball"]["ball_a"]["median_rel_err"]
    assert wrong > 20 * right


def test_wrong_exposure_of_the_ball_is_found_on_the_table(everything):
    ball = everything["photographs"]["ball_a"]
    darker = Raster({k: v * np.float32(0.97) if k in "RGB" else v for k, v in ball.channels.items()}, "acescg")
    result = run(everything, photographs={**everything["photographs"], "ball_a": darker})
    shadow = result.outputs["selfcheck"]["shadow"]["ball_a"]
    assert shadow["gain"] == pytest.approx(0.97, abs=1e-3)
    assert shadow["with_mirror_median_abs_err"] < 0.005  # the shape is judged without it
    assert any("3.0% darker" in warning for warning in result.warnings)
    assert run(everything).warnings == []


def test_score_files_of_anybody(everything, tmp_path):
    truth = tmp_path / "truth"
    truth.mkdir()
    staged.write_truth(truth, everything)
    (tmp_path / "plate.dng").touch()
    (tmp_path / "capture.toml").write_text(
        'name = "s"\ntruth = "truth/truth.json"\n[plate]\nfiles = ["plate.dng"]\n'
        '[[ball]]\nname = "a"\nfiles = ["a.dng"]\n[probe]\ndiameter_m = 0.08\n[camera.given]\n'
        "width = 192\nheight = 128\nfx = 200\nfy = 200\ncx = 96\ncy = 64\n"
    )
    plate, composite = everything["photographs"]["plate"].rgb(), everything["composite"].rgb()
    layered = Raster({f"Combined.{c}": composite[..., i] for i, c in enumerate("RGB")}, "unknown")
    formats.write_exr(tmp_path / "theirs.exr", layered)
    formats.write_exr(tmp_path / "plate.exr", staged.acescg(plate))
    found = evaluate.score_files(tmp_path, tmp_path / "theirs.exr", tmp_path / "plate.exr", truth / "light.exr")
    assert found["object_rel_err"] < 1e-6
    assert found["probe_irradiance_rel_err"] == pytest.approx(0.5)  # the file is in the truth's unit, half of ours
    with pytest.raises(ArtifactError, match="missing"):
        evaluate.score_files(tmp_path, tmp_path / "theirs.exr", None, None, tmp_path / "nobuild")


def test_other_sizes_are_refused(everything, tmp_path):
    truth = load_truth(Path(staged.write_truth(tmp_path, everything)))
    with pytest.raises(ManifestError, match="sizes"):
        evaluate.score(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), truth, 67)


def test_other_primaries_are_converted(tmp_path):
    from pipeline.image.colour import convert

    rgb = np.random.default_rng(1).random((4, 5, 3)).astype(np.float32)
    # Rec.709 primaries with a fifth decimal changed are no named space, so the general route is taken.
    primaries = (0.6401, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3295)
    formats.write_exr(tmp_path / "x.exr", Raster(Raster.split(rgb), "unknown", {"chromaticities": primaries}))
    assert np.allclose(read_acescg(tmp_path / "x.exr"), convert(rgb, "linear_rec709", "acescg"), rtol=0.01, atol=0.005)


def test_masks_in_png_and_rec709(everything, tmp_path, monkeypatch):
    path = Path(staged.write_truth(tmp_path, everything))
    facts = json.loads(path.read_text())
    mask = np.zeros((staged.HEIGHT, staged.WIDTH, 3), np.uint8)
    mask[:10, :, 0], mask[10:20, :, 1] = 255, 51
    formats.write_png(tmp_path / "mask.png", mask)
    more = {"coverage": "mask.png", "coverage_names": ["one", "two"], "albedo_seen": "mask.png", "root": "$STAGED"}
    path.write_text(json.dumps({**facts, **more}))
    monkeypatch.setenv("STAGED", str(tmp_path))
    truth = load_truth(path)
    assert list(truth.coverage) == ["one", "two"]
    assert truth.coverage["two"][15, 0] == pytest.approx(0.2)
    assert truth.albedo[..., 3].mean() == pytest.approx(10 / staged.HEIGHT)


@pytest.mark.parametrize("text", ["{", "{}", '{"plate": "p", "with_objects": "w", "coverage": "c", "space": "srgb"}'])
def test_bad_truth_is_refused_by_name(tmp_path, text):
    (tmp_path / "truth.json").write_text(text)
    with pytest.raises(ManifestError, match=r"truth\.json"):
        load_truth(tmp_path / "truth.json")
