"""Develop merged mosaics to linear ACEScg, with variance and mask.

Method: vignetting undone by flat photographs, the file's own word or lensfun; white balance of the mosaic (so that
interpolation does not colour edges), demosaicking (bilinear, Malvar-He-Cutler 2004 or Menon 2007), and one 3x3 matrix
from camera_rgb to ACEScg by the DNG's ColorMatrix and ForwardMatrix tags (DNG 1.7.1 chapter 6, Bradford): the camera's
neutral becomes (1, 1, 1) times its green signal. The neutral is AsShotNeutral, or a photographed chart's, whose fit is
the matrix where that is asked for. Data without a mosaic come from the space that they say. All views of one camera
model use one profile; another model has its own matrices, and its neutral is how it would see the plate's white:
however either was set, plate and ball agree. Variances go through squared kernels and squared matrix.

Lights a few photosites wide in views of a ball lose what photosites make of them (`pipeline.image.small_lights`).
What interpolation errs besides the noise, which it exceeds at edges, is no part of the variance, as it hides nothing:
the plate has it apart (``interpolation.RGB``), for the uncertainty of its pixels.

Limits: the covariance of neighbouring pixels and channels that kernels and matrix make is not in the variance. Values
that touched a clipped photosite are lower bounds: they carry CLIPPED and an infinite variance. Negative and
out-of-gamut values are kept and counted.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG, CAMERA_RGB, CHART_VIEW, CLIPPED, FLAT_VIEW, GHOST
from pipeline.image import colour, sensitivities
from pipeline.image.charted import read_chart, with_chart
from pipeline.image.demosaic import METHOD, Method, balance_gains, balanced_rgb, demosaic, interpolation_variance
from pipeline.image.small_lights import RESTORED, SmallLights, restored
from pipeline.image.vignetting import Losses
from pipeline.run.artifacts import FACTS, MOSAICS, PHOTOGRAPHS
from pipeline.run.errors import ArtifactError
from pipeline.run.evidence import ABSENT
from pipeline.run.stage import Stage
from pipeline.types import Raster, Result
from stages import knobs

SURE = 5.0  # standard uncertainties: by noise alone, a negative value in 3e6
FEW = 1e-4  # of the pixels: so many negative ones are counted in silence
EDGE_PX = 1024  # side of the middle of the plate on which the error of interpolation is measured


def compute(facts: dict[str, Any], mosaics: dict[str, Raster], params: knobs.Develop) -> Result:
    """Photographs by view: R G B in radiance units, ACEScg; variance.RGB; mask."""
    warnings: list[str] = []
    evidence: list[dict[str, Any]] = []
    numbers: dict[str, Any] = {}
    lens = facts.get("lens") or {}
    flats = [view for view in mosaics if view.startswith(FLAT_VIEW) and lens.get("flat")]
    chart_view = CHART_VIEW if CHART_VIEW in mosaics else "plate"
    views = [view for view in mosaics if view not in flats and not (view == CHART_VIEW == chart_view)]
    profiles = {view: profile_of(view, raster) for view, raster in mosaics.items()}
    losses = Losses(lens, {view: mosaics[view] for view in flats}, profiles)
    if facts.get("chart") is not None:
        seen = losses.corrected(mosaics[chart_view], profiles[chart_view])
        charted = read_chart(facts["chart"], chart_view, seen, profiles[chart_view])
        profiles = with_chart(profiles, plate_profile(profiles)["camera"], charted)
        numbers["chart"] = charted.numbers
        evidence += charted.evidence
        warnings += charted.warnings
    profiles = one_white(profiles)

    balls = {ball["name"] for ball in facts.get("ball", [])}
    small: dict[str, SmallLights] = {}

    def one(view: str) -> Raster:
        mosaic = losses.corrected(mosaics[view], profiles[view])
        photograph = develop(mosaic, profiles[view], method_of(view, params.demosaic), view)
        if view in balls and mosaic.attributes["insitu:cfa"]:
            photograph, small[view] = without_aliases(photograph, mosaic, acescg_of(profiles[view], view))
        return photograph

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        photographs = dict(zip(views, pool.map(one, views)))
    numbers |= {"views": {view: _numbers(raster) for view, raster in photographs.items()}, **losses.numbers}
    for view, lights in small.items():
        numbers["views"][view]["small_lights"] = len(lights.fitted)
        numbers["views"][view]["largest_alias_rel"] = lights.largest_alias
    evidence += [_small_lights(dict(sorted(small.items())))] * bool(small)
    shown_in = "plate" if "plate" in views else views[0]
    if mosaics[shown_in].attributes["insitu:cfa"]:
        numbers["interpolation"] = edge_error(mosaics[shown_in], acescg_of(profiles[shown_in], shown_in))
        if shown_in == "plate":
            photographs["plate"].channels.update(interpolation(mosaics["plate"], acescg_of(profiles["plate"], "plate")))
        evidence.append(_interpolation(shown_in, numbers["interpolation"]))
    evidence = [*losses.evidence(views, profiles, {view: mosaics[view].shape for view in views}), *evidence]
    warnings += losses.warnings
    warnings += _negative(shown_in, photographs[shown_in], numbers["views"][shown_in]["negative_px"])
    plate = plate_profile(profiles)
    if plate["as_shot_neutral"] is None and plate["space"] == CAMERA_RGB and "fitted" not in plate:
        warnings.append(f"{plate['file']}: no AsShotNeutral; the scene's white is taken as D65")
    shown = {profiles[view]["camera"]: profiles[view] for view in views}
    for profile in shown.values():
        evidence += _of_profile(profile)
        if profile["camera"] != plate["camera"]:
            evidence.append(_other_camera(profile))
    return Result({"photographs": photographs}, numbers, warnings, evidence)


def _negative(view: str, photograph: Raster, count: int) -> list[str]:
    """A line when many pixels are negative beyond noise."""
    if count <= FEW * photograph["mask"].size:
        return []
    least = float(photograph.rgb()[photograph["mask"] & CLIPPED == 0].min())
    return [
        f"{view}: {count} pixels are negative beyond noise, to {least:.3g}: edges that interpolation overshoots "
        "(least with develop.demosaic = bilinear), or colours lie outside ACEScg; they are kept as they are"
    ]


def interpolation(mosaic: Raster, acescg_from_camera: np.ndarray) -> dict[str, np.ndarray]:
    """Channels ``interpolation.RGB`` (H, W), ACEScg: squared error that interpolation makes besides the noise."""
    neutral = np.linalg.solve(acescg_from_camera, np.ones(3))
    cfa = str(mosaic.attributes["insitu:cfa"])
    gains = balance_gains(neutral, cfa, mosaic.shape)
    variance = mosaic["variance"] * gains * gains
    spread = interpolation_variance(mosaic["Y"] * gains, np.where(np.isfinite(variance), variance, 0), cfa)
    squared = colour.apply_matrix((acescg_from_camera * neutral) ** 2, spread)
    return Raster.split(squared.astype(np.float32), "interpolation")


def edge_error(mosaic: Raster, acescg_from_camera: np.ndarray) -> dict[str, float]:
    """How large the error of interpolation is in the middle of a mosaic, white balanced, against its noise."""
    cfa, (height, width) = str(mosaic.attributes["insitu:cfa"]), mosaic.shape
    top, left = (max(0, (size - EDGE_PX) // 4 * 2) for size in (height, width))
    part = np.s_[top : top + EDGE_PX, left : left + EDGE_PX]
    neutral = np.linalg.solve(acescg_from_camera, np.ones(3))
    gains = balance_gains(neutral, cfa, (height, width))
    values, variance = (mosaic["Y"] * gains)[part], (mosaic["variance"] * gains * gains)[part]
    usable = np.isfinite(variance)
    spread = interpolation_variance(values, np.where(usable, variance, 0), cfa)[usable]
    level = np.maximum(np.abs(values[usable]), 1e-30)
    if not usable.any():
        return {"beyond_noise_fraction": 0.0, "median_rel": 0.0, "p95_rel": 0.0}
    relative = np.sqrt(spread.max(-1)) / level
    return {
        "beyond_noise_fraction": float(np.mean(spread.max(-1) > variance[usable])),
        "median_rel": float(np.median(relative)),
        "p95_rel": float(np.percentile(relative, 95)),
    }


def _interpolation(view: str, numbers: dict[str, float]) -> dict[str, Any]:
    return {
        "term": "interpolation error of the pixels",
        "modelled": view == "plate",
        "because": f"where kernels disagree: beyond noise in {numbers['beyond_noise_fraction']:.0%} of {view}'s middle",
        "could_cost": f"values there are off by {numbers['median_rel']:.1%} (median), {numbers['p95_rel']:.1%} (95 %)",
        "bound_rel": numbers["p95_rel"],
    }


def without_aliases(
    photograph: Raster, mosaic: Raster, acescg_from_camera: np.ndarray
) -> tuple[Raster, SmallLights]:  # fmt: skip
    """A ball's bilinear photograph without its small lights' aliases, which its header says; and those lights."""
    neutral, cfa = np.linalg.solve(acescg_from_camera, np.ones(3)), str(mosaic.attributes["insitu:cfa"])
    values = mosaic["Y"] * balance_gains(neutral, cfa, mosaic.shape)
    plain = demosaic(values, cfa, "bilinear")
    unusable = photograph["mask"] & (CLIPPED | GHOST) > 0
    better, lights = restored(plain, values, cfa, unusable)
    change = colour.apply_matrix(acescg_from_camera * neutral, better - plain)
    channels = photograph.channels | Raster.split(photograph.rgb() + change)
    told = photograph.attributes | {RESTORED: str(int(lights.left == 0))}
    return Raster(channels, photograph.space, told), lights


def _small_lights(small: dict[str, SmallLights]) -> dict[str, Any]:
    """Whether balls mirror lights that their photosites sample too coarsely."""
    told = [f"{view} {len(one.fitted)}, by up to {one.largest_alias:.1%}" for view, one in small.items() if one.fitted]
    left = [f"{view} {one.left}" for view, one in small.items() if one.left]
    because = f"lights a few photosites wide, whose colours they misstate: {'; '.join(told)}" if told else ""
    if left:
        because += f"{'; ' if told else ''}left as they are, clipped or no ellipses: {', '.join(left)}"
    done: dict[str, Any] = {} if told and not left else ABSENT
    if left:
        done = {"no_bound": "it is in the sigma of the lamps' flux"}
    return {
        "term": "aliases of small lights",
        "modelled": bool(told) if not (told and left) else "in part",
        "because": because or f"{' and '.join(small)} show no light that is small and stands alone",
        "could_cost": "light and colour of lamps that are a few photosites wide",
        **done,
    }


def _of_profile(profile: dict[str, Any]) -> list[dict[str, Any]]:
    """What a camera's colours rest on."""
    if profile["space"] != CAMERA_RGB:
        return [_known_space(profile)]
    if "fitted" in profile:
        return []  # the chart's own evidence says it
    return [_adaptation(profile)] + [_one_matrix(profile)] * (profile["color_matrix_2"] is None)


def method_of(view: str, asked: Method) -> Method:
    """The method for a view: a ball is always interpolated bilinearly, whatever the plate gets.

    Sharper methods borrow from the other channels, which tints a lamp a few photosites wide; bilinear kernels keep each
    channel's sum, from which `small_lights` then takes what photosites made of it. Irradiance of the desk capture over
    200 upward normals against truth, root mean square of R, G, B, without that: bilinear 0.5, 0.7, 1.0 %; Malvar 0.6,
    0.9, 1.2 %; Menon moved red by up to 5 %.
    """
    return asked if view == "plate" else "bilinear"


def profile_of(view: str, mosaic: Raster) -> dict[str, Any]:
    """The colour profile that merge left in the mosaic's header. Raises ArtifactError when it is not there."""
    try:
        profile = json.loads(mosaic.attributes["insitu:colour"])
    except (KeyError, TypeError, ValueError) as error:
        raise ArtifactError(f"{view}: mosaic carries no colour profile; run merge again") from error
    for key in ("color_matrix", "color_matrix_2", "as_shot_neutral", "forward_matrix", "forward_matrix_2"):
        profile[key] = None if profile.get(key) is None else np.array(profile[key], float)
    if profile["color_matrix"] is None and (known := sensitivities.known_profile(profile["camera"])):
        profile |= known | {"source": "measured sensitivities of this model (colour-science)"}
    profile["space"] = mosaic.space
    return dict(profile)


def plate_profile(profiles: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The plate's profile, or the first where there is no plate."""
    return profiles.get("plate") or next(iter(profiles.values()))


def one_white(profiles: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The profiles with the neutral of every other camera model set to how it sees the white of the plate's.

    Each body has a white balance of its own; developed by those, a grey card would be neutral in both photographs even
    under different lamps, and the ball's light would have lost its colour against the plate.
    """
    plate = plate_profile(profiles)
    matrices = ("color_matrix", "color_matrix_2", "illuminant", "illuminant_2")
    if plate["space"] != CAMERA_RGB:
        return profiles
    if plate["as_shot_neutral"] is None or plate["color_matrix"] is None:
        return {view: {**p, "as_shot_neutral": plate["as_shot_neutral"]} for view, p in profiles.items()}
    white = colour.camera_white(plate["color_matrix"], plate["as_shot_neutral"], *(plate[k] for k in matrices[1:]))[1]
    return {
        view: profile
        if profile["camera"] == plate["camera"] or profile["color_matrix"] is None
        else {**profile, "as_shot_neutral": colour.neutral_of_white(white, *(profile[k] for k in matrices))}
        for view, profile in profiles.items()
    }


def acescg_of(profile: dict[str, Any], where: str) -> np.ndarray:
    """(3, 3) from the view's data to ACEScg. Raises CaptureError for camera_rgb without a usable ColorMatrix."""
    if "fitted" in profile:
        return np.asarray(profile["fitted"])
    if profile["space"] != CAMERA_RGB:
        return colour.matrix(profile["space"], "acescg")
    return colour.acescg_from_camera(
        profile["color_matrix"],
        profile["as_shot_neutral"],
        profile["color_matrix_2"],
        profile["illuminant"],
        profile["illuminant_2"],
        f"{where} ({profile['file']})",
        profile["forward_matrix"],
        profile["forward_matrix_2"],
    )


def develop(mosaic: Raster, profile: dict[str, Any], method: Method, where: str) -> Raster:
    """One view, a mosaic or data that have all three channels. Raises CaptureError without a usable ColorMatrix."""
    acescg_from_camera = acescg_of(profile, where)
    # the row sums of the inverse are the camera's response to ACEScg white: the neutral, green = 1
    neutral = np.linalg.solve(acescg_from_camera, np.ones(3))
    camera_rgb, variance, mask = balanced_rgb(mosaic, neutral, method)
    matrix = acescg_from_camera * neutral
    unknown = ~np.isfinite(variance).all(-1) | (mask & CLIPPED > 0)
    rgb = colour.apply_matrix(matrix, camera_rgb)
    # infinity times a zero coefficient would be NaN: infinite variances are put back after the sums
    variance[unknown] = 0
    spread = colour.apply_matrix(matrix**2, variance)
    spread[unknown] = np.inf
    told = {METHOD: method} if mosaic.attributes["insitu:cfa"] else {}
    return Raster({**Raster.split(rgb), **Raster.split(spread, "variance"), "mask": mask}, ACESCG, told)


def _numbers(photograph: Raster) -> dict[str, Any]:
    rgb = photograph.rgb()
    usable = photograph["mask"] & CLIPPED == 0
    beyond_noise = np.any(rgb < -SURE * np.sqrt(photograph.rgb("variance")), -1) & usable
    return {
        "negative_px": int(np.count_nonzero(beyond_noise)),
        "negative_fraction": float(np.mean(np.any(rgb < 0, -1))),
        "outside_rec709_fraction": float(np.mean(np.any(colour.convert(rgb, "acescg", "linear_rec709") < 0, -1))),
        "clipped_fraction": float(1 - np.mean(usable)),
        "median_rgb": [float(v) for v in np.median(rgb[usable], 0)] if usable.any() else [0.0, 0.0, 0.0],
    }


def _adaptation(profile: dict[str, Any]) -> dict[str, Any]:
    """Which white was found, and whether it lies between the calibrations."""
    neutral = profile["as_shot_neutral"]
    if neutral is None:
        neutral = profile["color_matrix"] @ colour.xyz_of_xy(colour.REC709_CHROMATICITIES[3])
    keys = ("color_matrix_2", "illuminant", "illuminant_2")
    white = colour.camera_white(profile["color_matrix"], neutral, *(profile[key] for key in keys))[1]
    kelvin, range_ = (
        colour.temperature_of_xy(white[:2] / white.sum()),
        colour.kelvin_of(*(profile[k] for k in keys[1:])),
    )
    text = f"white x {white[0] / white.sum():.4f}, y {white[1] / white.sum():.4f} ({kelvin:.0f} K) of {profile['file']}"
    source = profile.get("source", "ForwardMatrix" if profile["forward_matrix"] is not None else "ColorMatrix")
    cost = "surfaces whose colour changes with the light by more than a Bradford adaptation"
    if profile["color_matrix_2"] is not None and range_ and not min(range_) <= kelvin <= max(range_):
        cost += f"; the calibrations end at {min(range_):.0f} and {max(range_):.0f} K, the nearer one is held"
    because = f"{text}, by {source}, becomes ACEScg's white"
    return {"term": "chromatic adaptation", "modelled": True, "because": because, "could_cost": cost}


def _one_matrix(profile: dict[str, Any]) -> dict[str, Any]:
    return {
        "term": "second calibration illuminant",
        "modelled": False,
        "because": f"{profile['camera'] or profile['file']} carries one ColorMatrix",
        "could_cost": "colour error of 1 to 3 delta E under light far from the calibration illuminant",
        "no_bound": "a difference of colour, delta E, is no share of light",
    }


def _known_space(profile: dict[str, Any]) -> dict[str, Any]:
    return {
        "term": "colour matrix of the camera",
        "modelled": False,
        "because": f"{profile['file']} is not camera_rgb but {profile['space']}, as whoever developed it says",
        "could_cost": "what that development did to colours: its white balance and its matrix are taken as they are",
        "no_bound": "nothing in the file tells what was done to it",
    }


def _other_camera(profile: dict[str, Any]) -> dict[str, Any]:
    return {
        "term": f"colour of {profile['camera'] or 'another camera'}",
        "modelled": True,
        "because": "views of another model than the plate's: its own ColorMatrix, the plate's white",
        "could_cost": "a cast between plate and ball; a grey card or chart that both saw tells what is left",
    }


STAGE = Stage(
    "develop",
    compute,
    knobs.Develop,
    inputs={"facts": FACTS, "mosaics": MOSAICS},
    outputs={"photographs": PHOTOGRAPHS},
)
