"""Score the composite against truth where truth exists; predict what really stood there where it does not.

Against truth: the figures of `pipeline/image/metrics.py`, for our result and for doing nothing, and how far camera,
probe and albedo are off. One scale per capture, from the plates, is used for all of them.

Self-check, without truth: the mirror ball's photograph from the map, each ball view against the other, the ball's own
shadow on the plane, and the albedo of the board's white paper. The map was made from these ball photographs, so their
prediction is *in sample*: it finds errors of geometry, not of exposure. The disagreement of two views and the shadow
use data that the map was not fitted to. Limits: the map is distant light but for what the plane and the ball exchange.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.rigid import difference
from pipeline.conventions import transform_points
from pipeline.image import metrics
from pipeline.image.balance import balanced
from pipeline.image.display import auto_exposure
from pipeline.image.truth import Truth, load_truth, other_scene, read_acescg
from pipeline.light import ball_shadow, near_field, prediction
from pipeline.light.environment import AXES, AXIS_NAMES, irradiance, resize_environment
from pipeline.probes import shadow_flux
from pipeline.run.artifacts import (
    ALBEDO,
    BALANCE,
    BALLS,
    CAMERA,
    COMPOSITE,
    ENVIRONMENT,
    ERROR_MAP,
    FACTS,
    LAYERS,
    METRICS,
    PHOTOGRAPHS,
    PLANE,
    RECORDS,
    SELFCHECK,
    VIEWS,
    WISHES,
)
from pipeline.run.errors import ManifestError
from pipeline.run.stage import Stage
from pipeline.types import Balance, BallFit, Camera, Plane, Raster, Result, View
from stages import knobs

IRRADIANCE_MAP = (128, 256)  # truth and map are averaged to this before the irradiance: below 1e-4 for both
PAIR_MAP = (64, 128)  # texels on which two ball views are compared: 2.8 deg
BALL_LIMIT = 0.9  # of the ball's radius: beyond, a pixel spans many degrees
GRID, REACH = 32, 5.0  # points per side and half side in ball radii of the shadow check
UNCHANGED = 0.01  # predicted change by the ball below which a spot of the plane tells the exposure
GAIN_WARNING, MIN_GAIN_POINTS = 0.01, 50
STRIDE = 2  # albedo is compared at every second pixel


def compute(
    facts: dict[str, Any], wishes: dict[str, Any], photographs: dict[str, Raster], camera: Camera,
    views: dict[str, View], balls: dict[str, BallFit], environment: Raster, plane: Plane, albedo: Raster,
    layers: Raster, composite: Raster, balance: dict[str, Balance], records: dict[str, Any], params: knobs.Evaluate,
) -> Result:  # fmt: skip
    """Metrics and the error map (empty and 1x1 without truth, or where it shows another scene), and the self-check."""
    photographs = balanced(photographs, balance)
    plate = photographs["plate"].rgb()
    same, fraction = metrics.untouched(composite.rgb(), plate, layers["influence"], layers["obj.A"])
    numbers: dict[str, Any] = {"untouched_identical": same, "untouched_fraction": fraction}
    found: dict[str, Any] = {}
    error_map = Raster({"class": np.zeros((1, 1), np.uint32)}, ERROR_MAP.space)
    truth = load_truth(Path(facts["truth_path"])) if facts.get("truth_path") else None
    other = other_scene(truth.objects, wishes["object"]) if truth is not None else []
    with ThreadPoolExecutor(1) as pool:  # beside the figures: FLIP leaves Python to others
        checking = pool.submit(self_check, facts, photographs, camera, views, balls, environment, plane, albedo)
        if truth is not None and not other:
            light = near_field.at_probe(environment.rgb(), environment.attributes, near_field.room_of(facts))
            found, ref, error_map = score(composite.rgb(), plate, truth, params.pixels_per_degree)
            free = (layers["influence"] == 0) & (layers["obj.A"] == 0)
            found |= numbers | {
                "shadow_outside_region": _share(free, ref.shadow),
                "faint_outside_region": _share(free, ref.faint),
                **pose_errors(truth, camera, views, balls),
                **probe_errors(truth, light, found["scale"]),
                **albedo_errors(truth, camera, views["plate"], plane, albedo),
                "seconds": {stage: record["seconds"] for stage, record in records.items()},
            }
            numbers = {key: value for key, value in found.items() if not isinstance(value, dict)}
        checks = checking.result()
    warnings = exposure_warnings(checks)
    if other:
        numbers["other_scene"] = other
        warnings.append(f"the truth shows another scene: no figures ({'; '.join(other)})")
    warnings += [] if same else ["pixels outside the region of influence differ from the plate; report this"]
    if found.get("non_finite"):
        warnings.append(
            f"the composite holds {found['non_finite']} values that are not finite; they are scored as black"
        )
    if truth is not None and truth.objects is None:
        warnings.append("truth.json: names no objects, so its picture is taken to show those of scene.toml; add them")
    return Result({"metrics": found, "selfcheck": checks, "error_map": error_map}, numbers, warnings)


def score(
    composite: np.ndarray, plate: np.ndarray, truth: Truth, pixels_per_degree: float
) -> tuple[dict[str, Any], metrics.Reference, Raster]:
    """All figures of a picture and of doing nothing, the scaled truth, and the error map. ACEScg (H, W, 3).

    Raises ManifestError when the sizes differ.
    """
    if not composite.shape == plate.shape == truth.plate.shape:
        raise ManifestError(
            f"evaluate: composite {composite.shape}, plate {plate.shape}, truth {truth.plate.shape}; sizes must agree"
        )
    (composite, bad), (plate, bad_plate) = metrics.finite(composite), metrics.finite(plate)
    plate_box, true_box = metrics.box(plate), metrics.box(truth.plate)
    scale = metrics.scale_of(plate_box, true_box)
    scaled = scale * truth.with_objects
    exposure = auto_exposure(scaled)
    coded = metrics.coded(scaled, exposure)
    with ThreadPoolExecutor(2) as pool:  # FLIP releases the GIL, the rest runs beside it
        looks = [pool.submit(_perceptual, p, coded, exposure, pixels_per_degree) for p in (composite, plate)]
        ref = metrics.reference(truth.with_objects, true_box, truth.coverage, scale)
        maps = metrics.error_maps(composite, metrics.box(composite), plate_box, ref)
        found = metrics.errors(maps, ref)
        nothing = metrics.errors(metrics.error_maps(plate, plate_box, plate_box, ref), ref)
        (seen, flip_map), (seen_nothing, _) = (look.result() for look in looks)
    found |= {**seen, "scale": scale, "non_finite": bad, "non_finite_plate": bad_plate}
    found |= {"pixels_per_degree": pixels_per_degree, "object_pixels": int(ref.inside.sum())}
    found |= {"shadow_pixels": int(ref.shadow.sum()), "faint_pixels": int(ref.faint.sum())}
    found["do_nothing"] = {**nothing, **seen_nothing}
    channels = {"relative": maps[0], "change": maps[2], "flip": flip_map, "class": ref.classes}
    return found, ref, Raster(channels, ERROR_MAP.space)


def _perceptual(
    picture: np.ndarray, truth: np.ndarray, exposure_ev: float, pixels_per_degree: float
) -> tuple[dict[str, float], np.ndarray]:
    picture = metrics.coded(picture, exposure_ev)
    flip, flip_map = metrics.flip(picture, truth, pixels_per_degree)
    return {"flip": flip, "psnr": metrics.psnr(picture, truth), "ssim": metrics.ssim(picture, truth)}, flip_map


def _share(part: np.ndarray, whole: np.ndarray) -> float | None:
    return float(part[whole].mean()) if whole.any() else None


def pose_errors(truth: Truth, camera: Camera, views: dict[str, View], balls: dict[str, BallFit]) -> dict[str, Any]:
    """Rotation [deg] and position [fraction of the distance to the ball] of every view, and of the plate by itself."""
    found: dict[str, Any] = {}
    target = np.zeros(3)  # without a ball the origin stands for the place of the objects
    for name, ball in list(balls.items())[:1]:
        target = transform_points(views[name].world_from_camera, ball.centre_camera_m)
    each = {}
    for view in views.keys() & truth.views.keys():
        true = truth.views[view]
        delta = difference(views[view].world_from_camera, true)
        distance = np.linalg.norm(target - true[:3, 3])
        each[view] = {
            "rot_deg": float(np.degrees(np.linalg.norm(delta[:3]))),
            "pos_rel": float(np.linalg.norm(delta[3:]) / distance),
        }
    if "plate" in each:
        found |= {"pose_rot_deg": each["plate"]["rot_deg"], "pose_pos_rel": each["plate"]["pos_rel"]}
    if each:
        found["pose_views"] = dict(sorted(each.items()))
    if "fx" in truth.camera:
        found["focal_rel_err"] = abs(camera.fx / truth.camera["fx"] - 1)
    return found


def probe_errors(truth: Truth, environment: np.ndarray, scale: float) -> dict[str, Any]:
    """Relative error of the irradiance on six world axes; norms over RGB, the capture's one scale."""
    if truth.environment is None:
        return {}
    ours = irradiance(resize_environment(environment, *IRRADIANCE_MAP), AXES)
    true = irradiance(resize_environment(truth.environment, *IRRADIANCE_MAP), AXES @ truth.world_from_map)
    error = metrics.relative(ours - scale * true, scale * true)
    each = {name: float(value) for name, value in zip(AXIS_NAMES, error)}
    return {"probe_irradiance_rel_err": float(error.max()), "probe_irradiance_rel_err_of": each}


def albedo_errors(truth: Truth, camera: Camera, view: View, plane: Plane, albedo: Raster) -> dict[str, Any]:
    """Median relative albedo error over the plate's pixels that truly show the plane and that no object covers."""
    if truth.albedo is None:
        return {}
    covered = sum(truth.coverage.values(), np.zeros(truth.plate.shape[:2])) > 0
    chosen = (truth.albedo[..., 3] > 0.99) & ~covered
    rows, columns = np.nonzero(chosen[::STRIDE, ::STRIDE])
    rows, columns = rows * STRIDE, columns * STRIDE
    points = prediction.plane_hits(plane, camera, view.world_from_camera, np.stack([columns, rows], -1) + 0.5)
    ours = prediction.plane_texture(plane, np.dstack([albedo.rgb(), albedo["seen"]]), points)
    known = np.isfinite(ours[:, 0]) & (ours[:, 3] > 0.5)
    if not known.any():
        return {"albedo_rel_err": None, "albedo_known_fraction": 0.0}
    true = truth.albedo[rows[known], columns[known], :3]
    error = metrics.relative(ours[known, :3] - true, true)
    gain = metrics.norm(ours[known, :3]).sum() / metrics.norm(true).sum()  # a wrong light, apart from blur and noise
    return {
        "albedo_rel_err": float(np.median(error)),
        "albedo_gain": float(gain),
        "albedo_known_fraction": float(known.mean()),
    }


def self_check(
    facts: dict[str, Any], photographs: dict[str, Raster], camera: Camera, views: dict[str, View],
    balls: dict[str, BallFit], environment: Raster, plane: Plane, albedo: Raster,
) -> dict[str, Any]:  # fmt: skip
    """Predictions beside photographs. Every figure is a median relative (or absolute, for ratios) error."""
    light = near_field.at_probe(environment.rgb(), environment.attributes, near_field.room_of(facts))
    checks: dict[str, Any] = {"ball": {}, "shadow": {}}
    maps = {}
    for name, ball in balls.items():
        lens = views[name].camera or camera
        rows, columns = prediction.ball_crop(lens, ball)
        directions, sine = prediction.ball_directions(lens, ball, views[name].world_from_camera, rows, columns)
        photograph, bad = photographs[name].rgb()[rows, columns], photographs[name]["mask"][rows, columns] != 0
        used = (sine < BALL_LIMIT) & ~bad
        predicted = prediction.mirrored_picture(light, directions, prediction.ball_reflectance(ball, sine))
        error = metrics.relative((predicted - photograph)[used], photograph[used])
        median = float(np.median(error)) if used.any() else None
        checks["ball"][name] = {"median_rel_err": median, "pixels": int(used.sum()), "in_sample": True}
        maps[name] = prediction.splat(directions[used], photograph[used], *PAIR_MAP)
        stayed = np.allclose(views[name].world_from_camera, views["plate"].world_from_camera, atol=1e-9)
        if stayed and views[name].camera is None:
            checks["shadow"][name] = shadow_check(photographs, name, camera, views[name], ball, light, plane)
    checks["pairs"] = pair_check(maps)
    if facts.get("board"):
        checks["paper"] = paper_check(facts["board"], plane, albedo)
    return checks


def pair_check(maps: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """Each two ball views against each other, on the directions that both mirror: median of |a - b| / |(a + b) / 2|."""
    names, found = list(maps), {}
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            (a, seen_a), (b, seen_b) = maps[first], maps[second]
            both = (seen_a > 0) & (seen_b > 0)
            error = metrics.relative((a - b)[both], ((a + b) / 2)[both])
            gain = metrics.norm(b[both]).sum() / metrics.norm(a[both]).sum() if both.any() else None
            median = float(np.median(error)) if both.any() else None
            found[f"{first}-{second}"] = {
                "median_rel_diff": median,
                "gain": gain,
                "texels": int(both.sum()),
                "in_sample": False,
            }
    return found


def shadow_check(
    photographs: dict[str, Raster], name: str, camera: Camera, view: View, ball: BallFit, light: np.ndarray,
    plane: Plane,
) -> dict[str, Any]:  # fmt: skip
    """The ball's shadow on the plane, predicted from the map and measured as ball photograph over plate.

    Where the ball changes next to nothing the two photographs should agree: what they differ by there is ``gain``, an
    error of exposure between ball and plate, and it is taken out before the shapes of the shadows are compared.
    """
    centre = transform_points(view.world_from_camera, ball.centre_camera_m)
    foot = centre - (centre @ plane.normal - plane.offset_m) * plane.normal
    along = plane.corners_m[1] - plane.corners_m[0]
    along = along / np.linalg.norm(along)
    steps = np.linspace(-REACH, REACH, GRID) * ball.radius_m
    points = (foot + steps[:, None, None] * along + steps[None, :, None] * np.cross(along, plane.normal)).reshape(-1, 3)
    plate, photograph = photographs["plate"], photographs[name]
    bad = (plate["mask"] != 0) | (photograph["mask"] != 0)
    measured, usable = prediction.shadow_ratio(
        photograph.rgb(), plate.rgb(), bad, camera, view.world_from_camera, ball, points
    )
    if not usable.any():
        return {"points": 0}
    rest = shadow_flux.setting(light, np.zeros_like(light), [])
    blocked, mirrored = (
        shadow_flux.shadow_of(rest, points[usable], ball_shadow.Ball(centre, ball.radius_m, reflectance))
        for reflectance in (np.zeros(3), ball.reflectance)
    )
    far = np.abs(mirrored - 1).max(-1) < UNCHANGED
    gain = np.median(measured[usable][far] / mirrored[far], axis=0) if far.any() else np.ones(3)
    seen = (measured[usable] / gain).mean(-1)
    found: dict[str, Any] = {"points": int(usable.sum()), "gain": float(gain.mean()), "gain_rgb": gain.tolist()}
    found |= {"gain_points": int(far.sum()), "median_measured_ratio": float(np.median(measured[usable].mean(-1)))}
    for key, ratio in (("blocked_only", blocked.mean(-1)), ("with_mirror", mirrored.mean(-1))):
        found[f"{key}_median_abs_err"] = float(np.median(np.abs(ratio - seen)))
        moving = min(np.std(ratio), np.std(seen)) > 0
        found[f"{key}_correlation"] = float(np.corrcoef(ratio, seen)[0, 1]) if moving else None
    return found


def exposure_warnings(checks: dict[str, Any]) -> list[str]:
    """A line for each ball view whose exposure disagrees with the plate's on the table beyond its shadow."""
    return [
        f"{name}: {abs(shadow['gain'] - 1):.1%} {'darker' if shadow['gain'] < 1 else 'brighter'} than the plate on "
        f"{shadow['gain_points']} spots of the plane that the ball leaves alone; exposure labels or lamps differ, "
        "and the light is off by as much; shoot one setting that plate and ball share"
        for name, shadow in checks["shadow"].items()
        if shadow.get("gain_points", 0) >= MIN_GAIN_POINTS and abs(shadow["gain"] - 1) > GAIN_WARNING
    ]


def paper_check(board: dict[str, Any], plane: Plane, albedo: Raster) -> dict[str, Any]:
    """Median albedo of the board's white paper and its largest over smallest channel; expected 0.7 to 0.95 and 1."""
    points = prediction.paper_points(tuple(board["squares"]), board["square_m"], board["marker_m"], board["legacy"])
    values = prediction.plane_texture(plane, np.dstack([albedo.rgb(), albedo["seen"]]), points)
    known = np.isfinite(values[:, 0]) & (values[:, 3] > 0.5)
    if not known.any():
        return {"points": 0}
    rgb = np.median(values[known, :3], 0)
    neutrality = float(rgb.max() / rgb.min()) if rgb.min() > 0 else None
    return {"points": int(known.sum()), "albedo": rgb.tolist(), "neutrality": neutrality, "expected": [0.7, 0.95]}


def score_files(
    capture: Path, composite: Path, plate: Path | None, probe: Path | None, out: Path | None = None
) -> dict[str, Any]:
    """Score anybody's composite EXR (and lat-long probe EXR, our world and formula) against a capture with truth.

    ``plate`` defaults to the developed plate of the build ``out``. Primaries come from the chromaticities, else ACEScg.
    """
    from pipeline.run.manifest import load_capture

    facts, path, _ = load_capture(capture)
    if facts.truth is None:
        raise ManifestError(f"{path}: truth: is not given, and a score needs it; name a truth.json")
    truth = load_truth(path.parent / os.path.expandvars(facts.truth))
    build = out if out is not None else Path("build") / facts.name
    plate = plate or build / "develop" / PHOTOGRAPHS.filename / "plate.exr"
    pixels_per_degree = knobs.Evaluate.model_validate({}).pixels_per_degree
    found, _, _ = score(read_acescg(composite), read_acescg(plate), truth, pixels_per_degree)
    if probe is not None:
        found |= probe_errors(truth, read_acescg(probe), found["scale"])
    return found


STAGE = Stage(
    "evaluate",
    compute,
    knobs.Evaluate,
    inputs={
        "facts": FACTS, "wishes": WISHES, "photographs": PHOTOGRAPHS, "camera": CAMERA, "views": VIEWS, "balls": BALLS,
        "environment": ENVIRONMENT, "plane": PLANE, "albedo": ALBEDO, "layers": LAYERS, "composite": COMPOSITE,
        "balance": BALANCE, "records": RECORDS,
    },
    outputs={"metrics": METRICS, "selfcheck": SELFCHECK, "error_map": ERROR_MAP},
)  # fmt: skip
