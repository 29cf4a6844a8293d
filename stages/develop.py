"""Develop merged mosaics to linear ACEScg, with variance and mask.

Method: white balance of the mosaic by AsShotNeutral (so that interpolation does not colour edges), demosaicking
(bilinear, Malvar-He-Cutler 2004 or Menon 2007), and one 3x3 matrix from camera_rgb to ACEScg by the DNG's one or two
ColorMatrix tags (DNG 1.7.1 chapter 6, Bradford): the camera's neutral becomes (1, 1, 1) times its green signal. All
views use one profile, so plate and ball agree. Variances go through the squared kernels and the squared matrix.

Limits: interpolation error is not in the variance (at edges it exceeds the noise), nor is the covariance of
neighbouring pixels and channels that kernels and matrix make; vignetting is not corrected. Values that touched a
clipped photosite are lower bounds: they carry CLIPPED and an infinite variance. Negative and out-of-gamut values are
kept and counted.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, CLIPPED, DARK
from pipeline.image import colour
from pipeline.image.demosaic import REACH, Method, demosaic, demosaic_variance, dilate
from pipeline.image.radiometry import tiled
from pipeline.run.artifacts import MOSAICS, PHOTOGRAPHS
from pipeline.run.errors import ArtifactError
from pipeline.run.stage import Stage
from pipeline.types import Raster, Result
from stages import knobs


def compute(mosaics: dict[str, Raster], params: knobs.Develop) -> Result:
    """Photographs by view: R G B in radiance units, ACEScg; variance.RGB; mask."""
    profiles = {view: profile_of(view, raster) for view, raster in mosaics.items()}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        developed = list(
            pool.map(lambda v: develop(mosaics[v], profiles[v], method_of(v, params.demosaic), v), mosaics)
        )
    photographs = dict(zip(mosaics, developed))
    numbers = {view: _numbers(raster) for view, raster in photographs.items()}
    warnings, evidence = [], [_vignetting()]
    profile = next(iter(profiles.values()))  # merge gives all views one
    if profile["as_shot_neutral"] is None:
        warnings.append(f"{profile['file']}: no AsShotNeutral; the scene's white is taken as D65")
    if profile["color_matrix_2"] is None:
        evidence.append(_one_matrix(profile))
    return Result({"photographs": photographs}, {"views": numbers}, warnings, evidence)


def method_of(view: str, asked: Method) -> Method:
    """The method for a view: a ball is always interpolated bilinearly, whatever the plate gets.

    Sharper methods borrow from the other channels, which tints a lamp a few photosites wide; bilinear kernels keep each
    channel's sum. Irradiance of the desk capture over 200 upward normals against truth, root mean square of R, G, B:
    bilinear 0.5, 0.7, 1.0 %; Malvar 0.6, 0.9, 1.2 %; Menon moved red by up to 5 %.
    """
    return asked if view == "plate" else "bilinear"


def profile_of(view: str, mosaic: Raster) -> dict[str, Any]:
    """The colour profile that merge left in the mosaic's header. Raises ArtifactError when it is not there."""
    try:
        profile = json.loads(mosaic.attributes["insitu:colour"])
    except (KeyError, TypeError, ValueError) as error:
        raise ArtifactError(f"{view}: mosaic carries no colour profile; run merge again") from error
    for key in ("color_matrix", "color_matrix_2", "as_shot_neutral"):
        profile[key] = None if profile[key] is None else np.array(profile[key], float)
    return dict(profile)


def develop(mosaic: Raster, profile: dict[str, Any], method: Method, where: str) -> Raster:
    """One view. Raises CaptureError when the file has no usable ColorMatrix."""
    acescg_from_camera = colour.acescg_from_camera(
        profile["color_matrix"],
        profile["as_shot_neutral"],
        profile["color_matrix_2"],
        profile["illuminant"],
        profile["illuminant_2"],
        f"{where} ({profile['file']})",
    )
    cfa = str(mosaic.attributes["insitu:cfa"])
    # the row sums of the inverse are the camera's response to ACEScg white: the neutral, green = 1
    neutral = np.linalg.solve(acescg_from_camera, np.ones(3))
    gains = tiled(np.array([1 / neutral["RGB".index(letter)] for letter in cfa]).reshape(2, 2), mosaic.shape)
    balanced = mosaic["Y"] * gains
    variance = mosaic["variance"] * gains * gains
    mask = _spread_mask(mosaic["mask"], REACH[method])
    unknown = ~np.isfinite(variance)
    matrix = acescg_from_camera * neutral  # of white balanced camera_rgb
    rgb = colour.apply_matrix(matrix, demosaic(balanced, cfa, method))
    # infinity times a zero coefficient would be NaN: infinite variances are put back after the sums
    spread = colour.apply_matrix(matrix**2, demosaic_variance(np.where(unknown, 0, variance), cfa, method))
    spread[mask & CLIPPED > 0] = np.inf
    return Raster({**Raster.split(rgb), **Raster.split(spread, "variance"), "mask": mask}, ACESCG)


def _spread_mask(mask: np.ndarray, reach: int) -> np.ndarray:
    """Bits of every photosite that a pixel's kernel can touch; DARK stays with its photosite, for it is no defect."""
    return dilate(mask & ~np.uint32(DARK), reach) | (mask & np.uint32(DARK))


def _numbers(photograph: Raster) -> dict[str, Any]:
    rgb = photograph.rgb()
    usable = photograph["mask"] & CLIPPED == 0
    return {
        "negative_fraction": float(np.mean(np.any(rgb < 0, -1))),
        "outside_rec709_fraction": float(np.mean(np.any(colour.convert(rgb, "acescg", "linear_rec709") < 0, -1))),
        "clipped_fraction": float(1 - np.mean(usable)),
        "median_rgb": [float(v) for v in np.median(rgb[usable], 0)] if usable.any() else [0.0, 0.0, 0.0],
    }


def _vignetting() -> dict[str, Any]:
    return {
        "term": "vignetting",
        "modelled": False,
        "because": "no flat field was given",
        "could_cost": "radiance low by about the cosine to the fourth of the field angle at the corners",
    }


def _one_matrix(profile: dict[str, Any]) -> dict[str, Any]:
    return {
        "term": "second calibration illuminant",
        "modelled": False,
        "because": f"{profile['camera'] or profile['file']} carries one ColorMatrix",
        "could_cost": "colour error of 1 to 3 delta E under light far from the calibration illuminant",
    }


STAGE = Stage("develop", compute, knobs.Develop, inputs={"mosaics": MOSAICS}, outputs={"photographs": PHOTOGRAPHS})
