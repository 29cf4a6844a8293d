"""Intrinsics and distortion from board photographs, with covariance; held-out error chooses the model.

Method: ChArUco corners; a start by Zhang's method (OpenCV); joint least squares over lens and board poses
(Gauss-Newton, poses eliminated). From one focal length without distortion, the terms k1, k2, separate fx and fy, p1 p2
and k3 are offered in turn, twice; a term stays when photographs that it was not fitted to gain more than 9 in deviance
per parameter (three standard errors of a Gaussian) and do so consistently. Covariance: inverse normal matrix of the
chosen model times chi2 per degree of freedom. A ball that states a camera of its own gets it in the same way. Without
board photographs the lens comes from the tracks of the further views (stage sfm), with the same covariance; from a
former calibration; or, for want of all these, from the focal length in EXIF and lensfun, with the uncertainty that such
words have. A set of photographs that leaves rays of the frame uncertain is flagged, and the one to take next is named.
Limits: one focus and zoom for all photographs of a camera; a flat board; Brown's five terms: whether residuals still
have a pattern over the frame is tested, a fisheye is refused; terms left out have no variance, so the evidence says
what they could cost.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera import board_doubts
from pipeline.camera.adjustment import Adjustment, adjust, free_columns, lens_vector, with_lens
from pipeline.camera.board_pictures import board_picture
from pipeline.camera.exif_camera import exif_camera
from pipeline.camera.former_camera import reused
from pipeline.camera.given_camera import given_camera
from pipeline.camera.lens import project, unproject
from pipeline.camera.opencv_bridge import Sightings, board_sightings, first_calibration
from pipeline.camera.resection import minimise, refine, residuals_and_jacobian, robust_scale
from pipeline.camera.residual_pattern import pattern
from pipeline.camera.sfm import self_calibrated
from pipeline.camera.view_set import ViewSet, doubts_of, lens_sigma, next_photograph, summed
from pipeline.run.artifacts import BOARD_PHOTOS, BRACKETS, CAMERA, FACTS, RECONSTRUCTION, VIEW_CAMERAS
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.run.stage import Stage
from pipeline.types import Bracket, Camera, Frame, Reconstruction, Result
from stages import knobs

LADDER: tuple[tuple[str, ...], ...] = (("k1",), ("k2",), ("fy",), ("p1", "p2"), ("k3",))
FEWEST_CORNERS = 8  # of a photograph that is used
FEWEST_PHOTOS = 3
SAME_FOCAL = 0.01
NEEDED_DEVIANCE = 9.0  # gain on held-out photographs, per parameter, that buys a term: three standard errors
NEEDED_CONSISTENCY = 1.0  # and the mean gain of a photograph over its standard error, against a single odd photograph
GATE = 5.0  # corners, and photographs, beyond this many times the typical residual are left out
CORNER_SIGMA_PX = 0.1
REFUSED_FOCAL = 0.05  # standard uncertainty, relative
SURE, PATTERN_PX = 1e-3, 0.1  # chance by which, and size from which, residuals are said to have a pattern


@dataclass(frozen=True)
class Photos:
    """Corners of the usable photographs: file names, world points (N_i, 3) and pixels (N_i, 2)."""

    files: list[str]
    world_m: list[np.ndarray]
    px: list[np.ndarray]

    def only(self, chosen: list[int]) -> Photos:
        """A subset by index."""
        return Photos(*([values[i] for i in chosen] for values in (self.files, self.world_m, self.px)))  # type: ignore[arg-type]


def compute(
    facts: dict[str, Any], brackets: dict[str, Bracket], board_photos: list[dict[str, str]],
    reconstruction: Reconstruction, params: knobs.Calibrate,
) -> Result:  # fmt: skip
    """The plate's camera (pixels with the first centre at (0.5, 0.5)), and those of balls that state their own.

    Balls that state one camera in the same words share one estimate; their figures bear the first one's name.
    """
    stated, photos, frame = facts["camera"], photos_of(board_photos, "plate"), frame_of(brackets, "plate")
    if stated.get("given") or stated.get("former") or photos:
        whole = calibrated(facts, "camera", stated, frame, photos, params)
    elif facts.get("views"):
        whole = from_tracks(reconstruction, frame)
    else:
        lens_name = (facts.get("lens") or {}).get("name") or ""
        camera, numbers, warnings, evidence = exif_camera(_known(frame), lens_name)
        whole = Result({"camera": camera}, numbers, warnings, evidence)
    cameras: dict[str, Camera] = {}
    done: list[tuple[dict[str, Any], Camera]] = []
    for number, ball in enumerate(facts.get("ball", [])):
        stated = ball.get("camera")
        if stated is None:
            continue
        same = next((camera for other, camera in done if other == stated), None)
        if same is None:
            photos, frame = photos_of(board_photos, ball["name"]), frame_of(brackets, ball["name"])
            found = calibrated(facts, f"ball[{number}].camera", stated, frame, photos, params)
            same = found.outputs["camera"]
            done.append((stated, same))
            whole.numbers[ball["name"]] = found.numbers
            whole.warnings.extend(f"{ball['name']}: {text}" for text in found.warnings)
            whole.evidence.extend({**row, "term": f"{row['term']} ({ball['name']})"} for row in found.evidence)
        cameras[ball["name"]] = same
    return Result({**whole.outputs, "view_cameras": cameras}, whole.numbers, whole.warnings, whole.evidence)


def frame_of(brackets: dict[str, Bracket], view: str) -> Frame | None:
    """A photograph of the view, for what its metadata say of the optics."""
    return next(iter(brackets[view].frames), None) if view in brackets else None


def _known(frame: Frame | None) -> Frame:
    assert frame is not None  # ingest has read every view
    return frame


def of_optics(camera: Camera, frame: Frame | None) -> Camera:
    """The camera with the names of what it is the camera of, so that it can be told when it is used again."""
    if frame is None:
        return camera
    return camera.model_copy(update={"body": frame.camera, "lens": frame.lens, "focal_mm": frame.focal_mm})


def from_tracks(reconstruction: Reconstruction, frame: Frame | None) -> Result:
    """The plate's camera from the tracks of the reconstruction, for want of board photographs."""
    if "plate" not in reconstruction.names:
        raise CaptureError(
            "plate: hangs together with none of the further views, needed one and the same lens in both; photograph "
            "them nearer to the plate's place, or a board for [camera] calibration"
        )
    camera, numbers, evidence = self_calibrated(reconstruction, 0)
    warnings = []
    if numbers["focal_sigma_rel"] > 0.01:
        warnings.append(
            f"calibrate: the focal length is known to {numbers['focal_sigma_rel']:.1%} only; add views from other "
            "heights and with the camera turned by 90 degrees, or photographs of a board"
        )
    return Result({"camera": of_optics(camera, frame)}, numbers, warnings, evidence)


def photos_of(board_photos: list[dict[str, str]], view: str) -> list[dict[str, str]]:
    """The board photographs of one view's camera."""
    return [photo for photo in board_photos if photo.get("view", "plate") == view]


def calibrated(
    facts: dict[str, Any], where: str, stated: dict[str, Any], frame: Frame | None, board_photos: list[dict[str, str]],
    params: knobs.Calibrate,
) -> Result:  # fmt: skip
    """One camera, from its given numbers, a former calibration or its board photographs."""
    if stated.get("former"):
        former = Camera.model_validate(stated["former"])
        camera, said, terms = reused(former, _known(frame), where)
        relative = float(np.sqrt(camera.covariance[0, 0]) / camera.fx)
        numbers = {"source": "reused", "of": former.source, "rms_px": camera.rms_px, "focal_sigma_rel": relative}
        return Result({"camera": camera}, numbers, said, terms)
    if stated.get("given"):
        camera = given_camera(stated["given"], where)
        term = {
            "term": "intrinsics",
            "modelled": True,
            "because": "given",
            "could_cost": "unknown: no covariance given",
        }
        return Result({"camera": camera}, {"source": "given"}, [], [term])
    warnings: list[str] = []
    photos, size = sight(facts, board_photos, warnings)
    start, poses = first_calibration(photos.world_m, photos.px, size)
    photos, poses = drop_bad(start, photos, poses, warnings)
    chosen, errors, evidence = climb(start, poses, photos)
    judged = judge(chosen, photos, errors, evidence, warnings, params)
    return replace(judged, outputs={"camera": of_optics(judged.outputs["camera"], frame)})


def sight(
    facts: dict[str, Any], board_photos: list[dict[str, str]], warnings: list[str]
) -> tuple[Photos, tuple[int, int]]:
    """Corners of every photograph in which enough are seen, and (width, height)."""
    root = Path(facts["capture_root"])
    files = [photo["file"] for photo in board_photos]

    def look(file: str) -> tuple[tuple[int, int], Sightings]:
        plain, precise = board_picture(root / file)
        return (plain.shape[1], plain.shape[0]), board_sightings(plain, precise, facts["board"])

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # OpenCV releases the GIL
        found = list(pool.map(look, files))
    sizes = {size: file for file, (size, _) in zip(files, found, strict=True)}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h} ({file})" for (w, h), file in sizes.items())
        turned = " as on the sensor (some are turned by 90 degrees)" if len({min(s) for s in sizes}) == 1 else ""
        raise CaptureError(f"calibration photographs: sizes {listed}, needed one size{turned}; take out the others")
    double = [i for i, (_, seen) in enumerate(found) if len(seen.twice) >= board_doubts.TWICE]
    usable = [i for i, (_, seen) in enumerate(found) if len(seen.px) >= FEWEST_CORNERS and i not in double]
    for i in double:
        warnings.append(f"{files[i]}: {len(found[i][1].twice)} ids are seen twice, needed one board; left out")
    for i in sorted(set(range(len(files))) - set(usable) - set(double)):
        seen = found[i][1]
        warnings.append(
            f"{files[i]}: {len(seen.px)} corners ({seen.markers} markers) found, needed {FEWEST_CORNERS}; left out"
        )
    if len(usable) < FEWEST_PHOTOS:
        others = [board_picture(root / files[i])[0] for i in range(len(files)) if i not in usable and i not in double]
        instead = board_doubts.of_board(others, facts["board"]) if others else ""
        cover = "; cover all boards but one" if double else ""
        raise CaptureError(
            f"calibration: {len(usable)} of {len(files)} photographs show the board, needed {FEWEST_PHOTOS}{cover}; "
            + (instead or "check [board] (dictionary, squares, legacy)")
            + "; photograph the whole board sharply from several tilts"
        )
    photos = Photos([files[i] for i in usable], [found[i][1].world_m for i in usable], [found[i][1].px for i in usable])
    return photos, next(iter(sizes))


def drop_bad(
    start: Camera, photos: Photos, poses: list[np.ndarray], warnings: list[str]
) -> tuple[Photos, list[np.ndarray]]:
    """Leave out single wrong corners, and photographs whose residual is far above the typical one."""
    fit = fit_model(start, poses, photos, ("k1", "k2"))
    scale = max(robust_scale(np.concatenate(fit.residuals_px)), 0.02)
    rms = np.array([np.sqrt((r**2).mean()) for r in fit.residuals_px])
    limit = GATE * max(float(np.median(rms)), scale)
    bad = [i for i in range(len(rms)) if rms[i] > limit]
    rest = [i for i in range(len(rms)) if i not in bad]
    if bad and len(rest) >= FEWEST_PHOTOS:
        lens = fit_model(start, [fit.poses[i] for i in rest], photos.only(rest), ("k1", "k2")).camera
    for i in bad:
        why = ""
        if len(rest) >= FEWEST_PHOTOS:
            why = zoomed(lens, fit.poses[i], photos.world_m[i], photos.px[i], 2 * float(np.median(rms)))
        warnings.append(f"{photos.files[i]}: residual {rms[i]:.2f} px, others {np.median(rms):.2f} px{why}; left out")
    if len(rest) < FEWEST_PHOTOS:
        raise CaptureError(
            f"calibration: {len(rest)} of {len(rms)} photographs agree with one lens, needed {FEWEST_PHOTOS}; is the "
            "board flat, and focus and zoom the same in all?"
        )
    kept = [np.hypot(*fit.residuals_px[i].T) <= GATE * scale * 2 for i in rest]
    photos = photos.only(rest)
    world_m = [points[keep] for points, keep in zip(photos.world_m, kept, strict=True)]
    px = [points[keep] for points, keep in zip(photos.px, kept, strict=True)]
    return Photos(photos.files, world_m, px), [fit.poses[i] for i in rest]


def zoomed(camera: Camera, pose: np.ndarray, world_m: np.ndarray, px: np.ndarray, limit_px: float) -> str:
    """What to say of a photograph (points (N, 3), pixels (N, 2)) that another focal length explains to ``limit_px``."""
    best = (np.inf, 1.0)
    for step in (0.04, 0.01):  # a coarse search of a factor between 0.6 and 1.65, then a fine one around it
        for factor in best[1] * np.exp(step * np.arange(-12, 13)):
            lens = camera.model_copy(update={"fx": camera.fx * factor, "fy": camera.fy * factor})
            off = residuals_and_jacobian(lens, minimise(lens, pose, world_m, px), world_m, px)[0]
            best = min(best, (float(np.sqrt((off**2).mean())), float(factor)))
    if not (best[0] < limit_px and abs(best[1] - 1) > SAME_FOCAL):
        return ""
    return f"; it fits a focal length {best[1] - 1:+.0%} off: the zoom was moved"


def fit_model(start: Camera, poses: list[np.ndarray], photos: Photos, terms: tuple[str, ...]) -> Adjustment:
    """Adjust with these terms free and the others zero; without "fy" one focal length serves both axes."""
    one_focal = "fy" not in terms
    free = free_columns(tuple(term for term in terms if term != "fy"), one_focal)
    values = lens_vector(start) * (free.sum(1) > 0)
    if one_focal:
        values[:2] = values[:2].mean()
    return adjust(with_lens(start, values), poses, photos.world_m, photos.px, free)


def held_out(start: Camera, poses: list[np.ndarray], photos: Photos, terms: tuple[str, ...]) -> np.ndarray:
    """Mean squared residual (photos,) px^2 of each photograph under a lens fitted to the others (five folds)."""
    count = len(photos.files)
    folds = min(5, count)
    errors = np.full(count, np.inf)
    for fold in range(folds):
        train = [i for i in range(count) if i % folds != fold]
        try:
            lens = fit_model(start, [poses[i] for i in train], photos.only(train), terms).camera
            for i in range(fold, count, folds):
                every = np.ones(len(photos.px[i]), bool)
                seen = refine(lens, poses[i], photos.world_m[i], photos.px[i], CORNER_SIGMA_PX, every)
                errors[i] = (seen.residuals_px**2).sum(-1).mean()
        except NumericalError:
            continue  # too rich for this fold: its error stays infinite and the term is not taken
    return np.where(np.isfinite(errors), errors, np.inf)


def climb(
    start: Camera, poses: list[np.ndarray], photos: Photos
) -> tuple[Adjustment, dict[str, float], list[dict[str, Any]]]:
    """Add terms while photographs that they were not fitted to gain by them; with the reason for each."""
    terms: tuple[str, ...] = ()
    best = held_out(start, poses, photos, terms)
    corners = np.array([len(px) for px in photos.px])
    errors = {"none": float(np.sqrt(best.mean()))}
    evidence: dict[tuple[str, ...], dict[str, Any]] = {}
    for _ in range(2):  # a term may pay only once a later one is in
        before = terms
        for step in LADDER:
            if set(step) <= set(terms):
                continue
            error = held_out(start, poses, photos, terms + step)
            gain, consistency = improvement(best, error, corners)
            taken = gain > NEEDED_DEVIANCE * len(step) and consistency > NEEDED_CONSISTENCY
            errors[" ".join(terms + step)] = float(np.sqrt(error.mean()))
            because = (
                f"held-out error {np.sqrt(best.mean()):.4f} -> {np.sqrt(error.mean()):.4f} px: gain in deviance "
                f"{gain:.1f} (needs {NEEDED_DEVIANCE * len(step):g}), photographs agree at {consistency:+.1f} sigma"
            )
            evidence[step] = {"term": f"lens {' '.join(step)}", "modelled": taken, "because": because, "could_cost": ""}
            if taken:
                best, terms = error, terms + step
        if terms == before:
            break
    chosen = fit_model(start, poses, photos, terms)
    for step, entry in evidence.items():
        if not entry["modelled"]:
            entry["could_cost"] = cost_of(step, terms, chosen, start, poses, photos)
    return chosen, errors, list(evidence.values())


def cost_of(
    step: tuple[str, ...],
    terms: tuple[str, ...],
    chosen: Adjustment,
    start: Camera,
    poses: list[np.ndarray],
    photos: Photos,
) -> str:
    """How far the lens with the term left out would be from the chosen one."""
    try:
        shift = disagreement(chosen.camera, fit_model(start, poses, photos, terms + step).camera)
    except NumericalError:
        return "unknown: these photographs do not determine it"
    return f"{shift:.3f} px rms over the frame"


def improvement(before: np.ndarray, after: np.ndarray, corners: np.ndarray) -> tuple[float, float]:
    """Gain in deviance of the held-out corners, and the photographs' mean gain in its standard errors.

    The latter on logarithms, as distortion costs a board in the corner of the frame a hundred times what it costs one
    in the middle: the plain mean would carry the scatter of the photographs, not of the models.
    """
    if not np.isfinite(after).all():
        return -np.inf, -np.inf
    variance = max(float((corners * after).sum() / (2 * corners.sum())), 1e-12)  # of one coordinate
    gain = np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
    scatter = max(float(gain.std(ddof=1)) / np.sqrt(len(gain)), 1e-12)
    return float((corners * (before - after)).sum() / variance), float(gain.mean() / scatter)


def disagreement(first: Camera, second: Camera) -> float:
    """Rms distance, px, between where two lenses image the same rays, over the frame."""
    y, x = np.meshgrid(np.linspace(0, first.height, 13), np.linspace(0, first.width, 17), indexing="ij")
    px = np.stack([x, y], -1).reshape(-1, 2)
    try:
        xy = unproject(first, px)
    except NumericalError:
        return np.inf
    moved = project(second, np.concatenate([xy, np.ones((len(xy), 1))], -1)) - px
    finite = np.isfinite(moved).all(-1)
    return float(np.sqrt((moved[finite] ** 2).sum(-1).mean())) if finite.any() else np.inf


def judge(
    chosen: Adjustment,
    photos: Photos,
    errors: dict[str, float],
    evidence: list[dict[str, Any]],
    warnings: list[str],
    params: knobs.Calibrate,
) -> Result:
    """Refuse what does not determine a lens, warn about what hardly does and say what to photograph, and report."""
    camera = chosen.camera
    shape = pattern(photos.px, chosen.residuals_px, camera.width, camera.height)
    if chosen.rms_px > params.max_rms_px:
        fisheye = "" if shape.chance > SURE else "; residuals have a pattern over the frame: is it a fisheye?"
        raise NumericalError(
            f"calibrate: residual {chosen.rms_px:.2f} px, needed {params.max_rms_px} px; is the board flat, are "
            f"square_m and squares right, and focus and zoom the same in all photographs?{fisheye}"
        )
    views = ViewSet(camera, chosen.poses, photos.world_m, photos.px, chosen.sigma_px)
    try:
        certain = lens_sigma(camera, summed(views), chosen.sigma_px)
    except NumericalError as error:
        raise NumericalError(
            "calibrate: the distortion ends within the frame, needed a lens that fills it: a fisheye is not modelled; "
            "if it is none, photograph the board in the corners of the frame"
        ) from error
    sigma = np.sqrt(np.diag(camera.covariance))
    relative = float(sigma[0] / camera.fx)
    # The board's normal is world +Y; its angle to the optical axis is the tilt.
    tilts = np.degrees([np.arccos(min(1.0, abs(pose[1, 2]))) for pose in chosen.poses])
    everything = np.concatenate(photos.px)
    span = (np.ptp(everything, axis=0) / (camera.width, camera.height)).tolist()
    doubts = doubts_of(camera, len(photos.files), float(tilts.max()), relative, everything, span, certain[1])
    numbers = {
        "source": camera.source, "rms_px": chosen.rms_px, "corner_sigma_px": chosen.sigma_px,
        "photos": len(photos.files), "corners": len(everything), "held_out_rms_px": errors,
        "focal_sigma_rel": relative, "principal_point_sigma_px": sigma[2:4].tolist(),
        "tilt_max_deg": float(tilts.max()), "frame_span": span,
        "lens_sigma_px": {"rms": certain[0], "worst": certain[1]},
        "photo_rms_px": {
            file: float(np.sqrt((r**2).sum(-1).mean()))
            for file, r in zip(photos.files, chosen.residuals_px, strict=True)
        },
    }  # fmt: skip
    if doubts:
        best, left = next_photograph(views)
        advice = f"photograph next: {best}; it brings the lens from {certain[0]:.2g} to {left:.2g} px over the frame"
        if relative > REFUSED_FOCAL:
            raise NumericalError(f"calibrate: {doubts[0]}; {advice}")
        warnings += [f"calibrate: {text}" for text in (*doubts, advice)]
        numbers["next_photograph"] = best
    if shape.chance < SURE and shape.rms_px > PATTERN_PX:
        warnings.append(
            f"calibrate: residuals have a pattern over the frame, {shape.rms_px:.2f} px rms, {shape.largest_px:.2f} px "
            "at most; the lens bends as Brown's terms cannot, or the board is not flat"
        )
    beyond = {
        "term": "lens beyond Brown's terms (rational, fisheye)", "modelled": False,
        "because": f"residuals averaged over {shape.cells} cells of the frame: so large without a pattern in "
        f"{shape.chance:.2g} of sets",
        "could_cost": f"{shape.rms_px:.3f} px rms over the frame, {shape.largest_px:.3f} px at most",
    }  # fmt: skip
    return Result({"camera": camera}, numbers, warnings, [*evidence, beyond])


STAGE = Stage(
    "calibrate",
    compute,
    knobs.Calibrate,
    inputs={"facts": FACTS, "brackets": BRACKETS, "board_photos": BOARD_PHOTOS, "reconstruction": RECONSTRUCTION},
    outputs={"camera": CAMERA, "view_cameras": VIEW_CAMERAS},
)
