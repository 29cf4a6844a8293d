"""Intrinsics and distortion from board photographs, with covariance; held-out error chooses the model.

Method: corners of the board; a start by Zhang's method (OpenCV); joint least squares over lens and board poses
(Gauss-Newton, poses eliminated); which terms of distortion stay, and whether the lens is a fisheye, is decided by
photographs that it was not fitted to (`pipeline/camera/lens_ladder.py`). Covariance: inverse normal matrix of the
chosen model times chi2 per degree of freedom. A ball that states a camera of its own gets it in the same way. Without
board photographs the lens comes from the tracks of the further views where they were oriented (stage sfm); from a
former calibration; or, for want of all these, from the focal length in EXIF and lensfun, with the uncertainty of such
words, which boards in the capture's own views make less (stage sources). A set of photographs that leaves rays of the
frame uncertain is flagged, and the one to take next is named.
Limits: one focus and zoom for all photographs of a camera; a flat board; a fisheye to 88 degrees from its axis; whether
residuals still have a pattern over the frame is tested; terms left out have no variance, so the evidence says what they
could cost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.camera.adjustment import Adjustment
from pipeline.camera.board_photos import corners_of
from pipeline.camera.distortion import model_of
from pipeline.camera.exif_camera import exif_camera
from pipeline.camera.former_camera import reused
from pipeline.camera.given_camera import given_camera
from pipeline.camera.lens_ladder import SURE, Photos, best_lens
from pipeline.camera.residual_pattern import pattern
from pipeline.camera.sfm import self_calibrated
from pipeline.camera.view_set import WARNED_FOCAL, ViewSet, doubts_of, lens_sigma, next_photograph, summed
from pipeline.run.artifacts import BOARD_PHOTOS, BRACKETS, CAMERA, FACTS, RECONSTRUCTION, SOURCES, VIEW_CAMERAS
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.run.stage import Stage
from pipeline.types import Bracket, Camera, Frame, Reconstruction, Result, Sources
from stages import knobs

REFUSED_FOCAL = 0.05  # standard uncertainty, relative
NAMES = {"brown": "Brown's", "rational": "the rational model's", "fisheye": "the fisheye's"}
PATTERN_PX = 0.1  # size from which residuals are said to have a pattern


def compute(
    facts: dict[str, Any], brackets: dict[str, Bracket], board_photos: list[dict[str, str]],
    reconstruction: Reconstruction, sources: Sources, params: knobs.Calibrate,
) -> Result:  # fmt: skip
    """The plate's camera (pixels with the first centre at (0.5, 0.5)), and those of balls that state their own.

    Balls that state one camera in the same words share one estimate; their figures bear the first one's name.
    """
    stated, photos, frame = facts["camera"], photos_of(board_photos, "plate"), frame_of(brackets, "plate")
    if stated.get("given") or stated.get("former") or photos:
        whole = calibrated(facts, "camera", stated, frame, photos, params)
    elif reconstruction.names:
        whole = from_tracks(reconstruction, frame, params)
    else:
        lens_name = (facts.get("lens") or {}).get("name") or ""
        camera, numbers, warnings, evidence = exif_camera(_known(frame), lens_name)
        if sources.lens is not None:
            camera = sources.lens
            sigma = np.sqrt(np.diag(camera.covariance))
            relative = float(sigma[0] / camera.fx)
            numbers |= {"source": camera.source, "focal_sigma_rel": relative, "rms_px": camera.rms_px,
                        "principal_point_sigma_px": sigma[2:4].tolist()}  # fmt: skip
            del numbers["corner_sigma_rel"]
            warnings, evidence = few_boards(relative), rows_by_boards(camera, evidence)
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


def few_boards(relative: float) -> list[str]:
    """What to say of a focal length that EXIF and the boards in view tell to a share ``relative`` (one sigma)."""
    if relative <= WARNED_FOCAL:
        return []
    return [
        f"calibrate: focal length by EXIF and the board in the capture's own views, known to {relative:.1%} only, and "
        "what is placed scales with it; photograph a board for [camera] calibration"
    ]


def rows_by_boards(camera: Camera, by_word: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """EXIF's rows of focal length and distortion, as boards in the capture's own views have them: ``camera``'s."""
    sigma = np.sqrt(np.diag(camera.covariance))
    half = 0.5 * float(np.hypot(camera.width, camera.height))
    corner_px = half * float(sigma[4]) * (half / camera.fx) ** 2  # of k1, which alone is free of the distortion
    costs = {
        "focal length": f"{sigma[0] / camera.fx:.2%} of distances (one sigma)",
        "distortion": f"{corner_px:.2g} px at the corners (one sigma of k1)",
    }
    return [
        row
        if row["term"] not in costs
        else row | {"modelled": True, "could_cost": costs[row["term"]],
                    "because": f"{row['because']}; fitted to the boards in the capture's own views"}
        for row in by_word
    ]  # fmt: skip


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


def from_tracks(reconstruction: Reconstruction, frame: Frame | None, params: knobs.Calibrate) -> Result:
    """The plate's camera from the tracks of the reconstruction, for want of board photographs."""
    if "plate" not in reconstruction.names:
        raise CaptureError(
            "plate: hangs together with none of the further views, needed one and the same lens in both; photograph "
            "them nearer to the plate's place, or a board for [camera] calibration"
        )
    camera, numbers, evidence = self_calibrated(reconstruction, 0, params.distortion)
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
    photos, size = corners_of(facts, board_photos, warnings)
    chosen, warnings = best_lens(photos, size, warnings, params.distortion)
    judged = judge(chosen.fit, chosen.photos, chosen.errors, chosen.evidence, warnings, params)
    return replace(judged, outputs={"camera": of_optics(judged.outputs["camera"], frame)})


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
    model = model_of(camera.distortion)
    shape = pattern(photos.px, chosen.residuals_px, camera.width, camera.height)
    if chosen.rms_px > params.max_rms_px:
        curved = "" if shape.chance > SURE else "; residuals have a pattern over the frame: no known lens bends so"
        raise NumericalError(
            f"calibrate: residual {chosen.rms_px:.2f} px, needed {params.max_rms_px} px; is the board flat, are "
            f"square_m and squares right, and focus and zoom the same in all photographs?{curved}"
        )
    views = ViewSet(camera, chosen.poses, photos.world_m, photos.px, chosen.sigma_px)
    try:
        certain = lens_sigma(camera, summed(views), chosen.sigma_px)
    except NumericalError as error:
        raise NumericalError(
            "calibrate: the distortion ends within the frame, needed a lens that fills it (a fisheye to 88 degrees "
            "from its axis); photograph the board in the corners of the frame, or crop a circular fisheye's photographs"
        ) from error
    sigma = np.sqrt(np.diag(camera.covariance))
    relative = float(sigma[0] / camera.fx)
    # The board's normal is world +Y; its angle to the optical axis is the tilt.
    tilts = np.degrees([np.arccos(min(1.0, abs(pose[1, 2]))) for pose in chosen.poses])
    everything = np.concatenate(photos.px)
    span = (np.ptp(everything, axis=0) / (camera.width, camera.height)).tolist()
    doubts = doubts_of(camera, len(photos.files), float(tilts.max()), relative, everything, span, certain[1])
    numbers = {
        "source": camera.source, "distortion_model": model, "rms_px": chosen.rms_px, "corner_sigma_px": chosen.sigma_px,
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
            f"at most; the lens bends as {NAMES[model]} terms cannot, or the board is not flat"
        )
    beyond = {
        "term": f"lens beyond {NAMES[model]} terms" + (" (fisheye)" if model == "brown" else ""), "modelled": False,
        "because": f"residuals averaged over {shape.cells} cells of the frame: so large without a pattern in "
        f"{shape.chance:.2g} of sets",
        "could_cost": f"{shape.rms_px:.3f} px rms over the frame, {shape.largest_px:.3f} px at most",
        "bound_px": float(shape.largest_px),
    }  # fmt: skip
    return Result({"camera": camera}, numbers, warnings, [*evidence, beyond])


STAGE = Stage(
    "calibrate",
    compute,
    knobs.Calibrate,
    inputs={
        "facts": FACTS,
        "brackets": BRACKETS,
        "board_photos": BOARD_PHOTOS,
        "reconstruction": RECONSTRUCTION,
        "sources": SOURCES,
    },
    outputs={"camera": CAMERA, "view_cameras": VIEW_CAMERAS},
)
