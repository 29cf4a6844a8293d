from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.image import colour, metrics
from pipeline.image.display import auto_exposure
from pipeline.run import formats
from pipeline.types import Raster

SHAPE = (60, 80)


@pytest.fixture(scope="module")
def scene():
    """A textured plate, one grey and one red disc, and a soft shadow."""
    rng = np.random.default_rng(7)
    plate = 0.2 + 0.6 * rng.random((*SHAPE, 3))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    coverage = {
        "grey": np.clip(10 - np.hypot(x - 20, y - 30), 0, 1),
        "red": np.clip(7 - np.hypot(x - 55, y - 20), 0, 1),
    }
    dim = 1 - 0.5 * np.exp(-((x - 34) ** 2 + (y - 40) ** 2) / 200)
    truth = plate * dim[..., None]
    for name, rgb in (("grey", (0.4, 0.4, 0.4)), ("red", (0.5, 0.1, 0.1))):
        truth = truth + coverage[name][..., None] * (np.array(rgb) - truth)
    return plate, truth, coverage


def figures(composite, plate, scene, scale=1.0):
    true_plate, truth, coverage = scene
    ref = metrics.reference(truth, metrics.box(true_plate), coverage, scale)
    return metrics.errors(metrics.error_maps(composite, metrics.box(composite), metrics.box(plate), ref), ref)


def test_truth_has_no_error(scene):
    found = figures(scene[1], scene[0], scene)
    assert found.pop("object_rel_err_of") == {"grey": 0, "red": 0}
    assert max(found.values()) < 1e-12  # rounding of the running sums


def test_doing_nothing_misses_all_of_the_change(scene):
    found = figures(scene[0], scene[0], scene)
    assert found["shadow_change_err"] == pytest.approx(1)
    assert found["faint_change_err"] == pytest.approx(1)


def test_half_the_change_is_half_wrong(scene):
    half = 0.5 * (scene[0] + scene[1])
    assert figures(half, scene[0], scene)["shadow_change_err"] == pytest.approx(0.5)


def test_exposure_does_not_matter(scene):
    plate, truth, _ = scene
    composite = truth * 1.03
    scale = metrics.scale_of(metrics.box(4 * plate), metrics.box(plate))
    assert scale == pytest.approx(4)
    first, second = figures(composite, plate, scene), figures(4 * composite, 4 * plate, scene, scale)
    first.pop("object_rel_err_of"), second.pop("object_rel_err_of")
    assert first == pytest.approx(second)
    assert first["object_rel_err"] == pytest.approx(0.03)


def test_classes_do_not_overlap(scene):
    plate, truth, coverage = scene
    ref = metrics.reference(truth, metrics.box(plate), coverage, 1.0)
    assert set(np.unique(ref.classes)) == {0, 1, 2, 3, 4}
    assert not (ref.shadow & ref.faint).any()
    assert not ((ref.shadow | ref.faint) & ref.covered).any()


def test_no_object_and_no_change_is_none(scene):
    plate = scene[0]
    found = figures(plate, plate, (plate, plate, {}))
    assert found["object_rel_err"] is None
    assert found["shadow_change_err"] is None


def test_black_truth_and_tiny_pictures():
    black = np.zeros((1, 1, 3))
    assert metrics.scale_of(black, black) == 1
    assert metrics.relative(black, black).item() == 0
    assert np.isinf(metrics.relative(black + 1, black).item())
    assert np.isnan(metrics.ssim(black.astype(np.float32), black.astype(np.float32)))


def test_non_finite_is_counted():
    picture = np.ones((3, 3, 3))
    picture[1, 1, 0], picture[0, 0] = np.nan, np.inf
    clean, bad = metrics.finite(picture)
    assert bad == 4
    assert np.isfinite(clean).all()
    assert np.isnan(picture[1, 1, 0])


def test_untouched_compares_bits():
    plate = np.random.default_rng(1).random((5, 6, 3)).astype(np.float32)
    plate[0, 0] = np.nan
    influence, alpha = np.zeros((5, 6)), np.zeros((5, 6))
    influence[2] = 1
    composite = plate.copy()
    composite[2] *= 1.5
    assert metrics.untouched(composite, plate, influence, alpha) == (True, pytest.approx(0.8))
    composite[4, 4, 1] = np.nextafter(composite[4, 4, 1], np.float32(2))
    assert not metrics.untouched(composite, plate, influence, alpha)[0]


def test_perceptual_figures_of_the_same_picture(scene):
    truth = scene[1]
    picture = coded = metrics.coded(truth, auto_exposure(truth))
    assert metrics.psnr(picture, coded) == np.inf
    assert metrics.ssim(picture, coded) == pytest.approx(1)
    mean, found = metrics.flip(picture, coded, 67)
    assert mean == 0
    assert found.shape == SHAPE


def test_perceptual_figures_order_errors(scene):
    truth = scene[1]
    right, small, large = (metrics.coded(gain * truth, auto_exposure(truth)) for gain in (1, 1.02, 1.5))
    assert metrics.psnr(small, right) > metrics.psnr(large, right)
    assert metrics.ssim(small, right) > metrics.ssim(large, right)
    assert metrics.flip(small, right, 67)[0] < metrics.flip(large, right, 67)[0]


def test_psnr_of_a_known_error():
    assert metrics.psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)) == pytest.approx(20)


def test_agrees_with_the_independent_script(tmp_path):
    data = Path(os.environ.get("INSITU_DATA", "../shared/data"))
    capture, script = data / "captures/kitchen_table", data.parent / "tools/score.py"
    if not (capture.is_dir() and script.is_file()):
        pytest.skip("the capture with truth or the script is not here")
    rec709 = {
        name: formats.read_exr(capture / f"truth/{file}.exr").rgb().astype(float)
        for name, file in (("P", "plate_radiance"), ("T", "plate_with_all_objects"))
    }
    true_plate, truth = (colour.convert(rec709[k], "linear_rec709", "acescg") for k in "PT")
    rng = np.random.default_rng(5)
    plate = (1.7 * true_plate * (1 + 0.02 * rng.standard_normal(true_plate.shape))).astype(np.float32)
    composite = (plate + 1.6 * (truth - true_plate)).astype(np.float32)
    for name, picture in (("c", composite), ("b", plate)):
        formats.write_exr(tmp_path / f"{name}.exr", Raster(Raster.split(picture), "acescg"))
    command = [sys.executable, script, capture, "--composite", tmp_path / "c.exr", "--plate", tmp_path / "b.exr"]
    theirs = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    mask = formats.read_png(capture / "truth/mask_objects.png")
    mask = mask / np.iinfo(mask.dtype).max
    coverage = dict(zip(("grey", "red", "gold"), np.moveaxis(mask[..., :3], -1, 0)))
    scale = metrics.scale_of(metrics.box(plate), metrics.box(true_plate))
    assert scale == pytest.approx(theirs["scale"], rel=1e-6)
    for picture, expected in ((composite, theirs), (plate, theirs["do_nothing"])):
        ours = figures(picture.astype(float), plate.astype(float), (true_plate, truth, coverage), scale)
        for key in ours.keys() & expected.keys():
            assert ours[key] == pytest.approx(expected[key], rel=1e-4), key
    ref = metrics.reference(truth, metrics.box(true_plate), coverage, scale)
    counts = {
        f"{n}_pixels": int(m.sum()) for n, m in (("object", ref.inside), ("shadow", ref.shadow), ("faint", ref.faint))
    }
    assert counts == {key: theirs[key] for key in counts}
