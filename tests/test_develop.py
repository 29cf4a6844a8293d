"""Developing merged data: with a mosaic and without one, in every space that a file may say."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pipeline.conventions import CLIPPED
from pipeline.image import colour
from pipeline.run import formats
from pipeline.run.artifacts import MOSAICS
from pipeline.types import Raster
from stages import develop, knobs

MATRIX = np.array([[0.742, -0.205, -0.062], [-0.456, 1.248, 0.233], [-0.106, 0.215, 0.648]])
NEUTRAL = MATRIX @ colour.xyz_of_xy(colour.REC709_CHROMATICITIES[3])


def profile(**changes: object) -> dict[str, object]:
    """A colour profile as merge writes it."""
    known: dict[str, object] = {"file": "a.dng", "camera": "One", "color_matrix": MATRIX.tolist(), "illuminant": 21}
    known |= {"color_matrix_2": None, "illuminant_2": 0, "as_shot_neutral": (NEUTRAL / NEUTRAL[1]).tolist()}
    return known | changes


def three_channels(rgb: np.ndarray, space: str, known: dict[str, object] | None = None) -> Raster:
    """Merged data without a mosaic, variance 1 % of the value."""
    planes = {**Raster.split(rgb), **Raster.split(0.01 * np.abs(rgb), "variance")}
    header = {"insitu:cfa": "", "insitu:colour": json.dumps(known or profile())}
    return Raster({**planes, "mask": np.zeros(rgb.shape[:2], np.uint32)}, space, header)


@pytest.mark.parametrize("space", ["linear_rec709", "acescg", "camera_rgb"])
def test_data_without_a_mosaic_become_acescg(space, tmp_path):
    """Exact: the same numbers through the one matrix, pixel by pixel, and through the disk."""
    rgb = np.random.default_rng(0).uniform(0.1, 2, (7, 5, 3)).astype(np.float32)
    known = profile() if space == "camera_rgb" else profile(color_matrix=None, as_shot_neutral=None)
    raster = three_channels(rgb, space, known)
    formats.write(tmp_path, MOSAICS, {"plate": raster})
    result = develop.compute({}, formats.read(tmp_path, MOSAICS), knobs.Develop(demosaic="menon"))
    photograph = result.outputs["photographs"]["plate"]
    if space == "camera_rgb":
        matrix = colour.acescg_from_camera(MATRIX, NEUTRAL, illuminant=21)
    else:
        matrix = colour.matrix(space, "acescg")
    np.testing.assert_allclose(photograph.rgb(), rgb @ matrix.T, rtol=1e-5)  # float32
    np.testing.assert_allclose(photograph.rgb("variance"), 0.01 * rgb @ (matrix**2).T, rtol=1e-5)
    assert photograph.space == "acescg"
    said = [row for row in result.evidence if row["term"] == "colour matrix of the camera"]
    assert bool(said) == (space != "camera_rgb")
    assert not any("AsShotNeutral" in text for text in result.warnings)


def test_a_clipped_channel_makes_its_pixel_alone_a_lower_bound():
    raster = three_channels(np.ones((6, 6, 3), np.float32), "linear_rec709")
    raster["variance.R"][2, 3], raster["mask"][2, 3] = np.inf, CLIPPED
    photograph = develop.compute({}, {"plate": raster}, knobs.Develop()).outputs["photographs"]["plate"]
    infinite = np.isinf(photograph.rgb("variance"))
    assert infinite.sum() == 3
    assert infinite[2, 3].all()
    assert photograph["mask"][2, 3] == CLIPPED
    assert np.isfinite(photograph.rgb()).all()


def test_a_camera_beside_developed_data_keeps_its_own_white():
    """Nothing says which white a developed plate was balanced to, so nothing is taken over from it."""
    developed = three_channels(np.ones((4, 4, 3), np.float32), "acescg", profile(camera="Two", color_matrix=None))
    raw = three_channels(np.tile(NEUTRAL / NEUTRAL[1], (4, 4, 1)).astype(np.float32), "camera_rgb")
    result = develop.compute({}, {"plate": developed, "ball": raw}, knobs.Develop())
    np.testing.assert_allclose(result.outputs["photographs"]["ball"].rgb(), 1, rtol=1e-5)
