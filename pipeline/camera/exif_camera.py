"""A camera for which there is nothing but what the photograph says of itself: focal length, body, lens.

Focal length in pixels = focal length / sensor diagonal (lensfun's crop factor) * diagonal in pixels, or, by the 35 mm
equivalent of EXIF, in units of the diagonal of 36 x 24 mm (CIPA DCG-001). Distortion from lensfun where the lens is
named and the data are not a maker's finished picture, fitted by one focal length, k1, k2 and k3.

Uncertainty, by rule: 4 and 5 % of the focal length, the axis within 1 % of the longer side, corners bent by 3 % of the
radius where lensfun does not know the lens: finished pictures may be corrected by their maker, or not. One real lens
tested it, a compact of 2001 whose photographs alone (COLMAP) say 7 % longer and bent by 6 % at the corners: two sigma.
Limits: a lens focused at less than twenty focal lengths is longer than its label by up to 5 % (1 / 20), macro by more;
crop modes that change the shape of the picture.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.image.lens_database import FULL_FRAME_DIAGONAL_MM, distortion_samples, is_fisheye, sensor_diagonal_mm
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Frame

LABEL_SIGMA, EQUIVALENT_SIGMA = 0.04, 0.05  # of a focal length with a known sensor, and of a 35 mm equivalent
CENTRE_SIGMA = 0.01  # of the longer side, each way
UNKNOWN_CORNER, LENSFUN_CORNER = 0.03, 0.005  # of the radius at the corners
NATIVE_SHAPES = (3 / 2, 4 / 3)  # of sensors; another shape is a crop, and which sides it cut is not said
SHAPE_TOLERANCE = 0.02
DISAGREEMENT = 0.05  # of the two focal lengths that one file states: beyond it the sensor was cropped


def exif_camera(frame: Frame, lens_name: str = "") -> tuple[Camera, dict[str, Any], list[str], list[dict[str, Any]]]:
    """The camera, numbers, warnings and evidence; ``lens_name`` is used where the file names no lens.

    Raises CaptureError when the file states no focal length that can be used, or the lens is a fisheye.
    """
    name = frame.lens or lens_name
    if is_fisheye(frame.camera, name, frame.focal_mm):
        raise CaptureError(
            f"{frame.file}: its lens {name!r} is a fisheye, needed a rectilinear one, as EXIF does not say how it "
            "bends; photograph a board for [camera] calibration"
        )
    focal, sigma, because = _focal_px(frame)
    bend, corner, said = _distortion(frame, name, focal)
    focal *= bend[0]
    sigma = float(np.hypot(sigma, (bend[0] - 1) / 2))
    long = max(frame.width, frame.height)
    radius2 = (np.hypot(frame.width, frame.height) / 2 / focal) ** 2
    covariance = np.zeros((9, 9))
    covariance[:2, :2] = (sigma * focal) ** 2  # one error for both axes
    covariance[2, 2] = covariance[3, 3] = (CENTRE_SIGMA * long) ** 2
    covariance[4, 4] = (corner / radius2) ** 2
    camera = Camera(
        width=frame.width, height=frame.height, fx=focal, fy=focal, cx=frame.width / 2, cy=frame.height / 2,
        distortion=np.array([bend[1], bend[2], 0, 0, bend[3]]), covariance=covariance, source="exif",
        body=frame.camera, lens=name, focal_mm=frame.focal_mm,
    )  # fmt: skip
    numbers = {
        "source": "exif", "focal_sigma_rel": sigma, "focal_mm": frame.focal_mm, "focal_35mm": frame.focal_35mm,
        "principal_point_sigma_px": [CENTRE_SIGMA * long] * 2, "corner_sigma_rel": corner,
    }  # fmt: skip
    warnings = [
        f"calibrate: focal length from EXIF ({because}), known to {sigma:.0%} only, and what is placed scales with it; "
        "photograph a board for [camera] calibration"
    ]
    evidence = [
        {"term": "focal length", "modelled": True, "because": because,
         "could_cost": f"{sigma:.0%} of distances by rule; more where it was focused nearer than 20 focal lengths"},
        {"term": "distortion", "modelled": bool(bend[1:].any()), "because": said,
         "could_cost": f"{corner * np.hypot(frame.width, frame.height) / 2:.1f} px at the corners, by rule",
         "bound_px": float(corner * np.hypot(frame.width, frame.height))},
    ]  # fmt: skip
    return camera, numbers, warnings, evidence


def equivalent_focal_px(frame: Frame) -> float | None:
    """Focal length [px] of the 35 mm equivalent in EXIF, by the diagonal (CIPA DCG-001); None without one."""
    if frame.focal_35mm <= 0:
        return None
    return float(frame.focal_35mm / FULL_FRAME_DIAGONAL_MM * np.hypot(frame.width, frame.height))


def _focal_px(frame: Frame) -> tuple[float, float, str]:
    """Focal length [px], its relative standard uncertainty, and where it comes from."""
    diagonal = float(np.hypot(frame.width, frame.height))
    shape = max(frame.width, frame.height) / min(frame.width, frame.height)
    native = any(abs(shape / usual - 1) < SHAPE_TOLERANCE for usual in NATIVE_SHAPES)
    sensor = sensor_diagonal_mm(frame.camera) if frame.focal_mm > 0 else None
    by_label = frame.focal_mm / sensor * diagonal if sensor else None
    by_equivalent = equivalent_focal_px(frame)
    if by_label is not None and (by_equivalent is None or abs(by_label / by_equivalent - 1) < DISAGREEMENT):
        sigma = LABEL_SIGMA if native else EQUIVALENT_SIGMA
        return by_label, sigma, f"{frame.focal_mm:g} mm on the {sensor:.1f} mm diagonal of {frame.camera}"
    if by_equivalent is not None:
        return by_equivalent, EQUIVALENT_SIGMA, f"{frame.focal_35mm:g} mm in 35 mm terms"
    found = f"{frame.focal_mm:g} mm on an unknown sensor ({frame.camera or 'no body named'})" if frame.focal_mm else ""
    raise CaptureError(
        f"{frame.file}: focal length in EXIF: {found or 'none'}; needed one with its sensor, as there is no other "
        "word on the lens; photograph a board for [camera] calibration, or give its numbers in [camera] given"
    )


def _distortion(frame: Frame, name: str, focal: float) -> tuple[np.ndarray, float, str]:
    """Factor of the focal length, k1, k2, k3 (4,); relative uncertainty of the radius at the corners; the reason."""
    none = np.array([1.0, 0, 0, 0])
    if frame.encoding == "display":
        return none, UNKNOWN_CORNER, "a finished picture: whether its maker corrected it is not said"
    known = distortion_samples(frame.camera, name, frame.focal_mm, frame.height, frame.width)
    if known is None:
        return none, UNKNOWN_CORNER, f"lensfun does not know {name!r} on {frame.camera!r}"
    straight, bent, model = known
    fitted, residual = brown_of(straight / focal, bent / focal)
    return fitted, LENSFUN_CORNER, f"lensfun, {model} (as Brown's terms to {residual * focal:.2f} px)"


def brown_of(straight: np.ndarray, bent: np.ndarray) -> tuple[np.ndarray, float]:
    """(s, k1, k2, k3) with bent = s r (1 + k1 r^2 + k2 r^4 + k3 r^6) for radii r = straight (N,), and the residual.

    Radii are in units of the stated focal length, so r is X / Z, and s is the focal length's factor: the database fixes
    its scale at half the shorter side, not at the centre. Whether a label means the one or the other nobody says.
    """
    powers = np.stack([straight**n for n in (1, 3, 5, 7)], -1)
    solved = np.linalg.lstsq(powers, bent, rcond=None)[0]
    residual = float(np.abs(powers @ solved - bent).max())
    return np.concatenate([solved[:1], solved[1:] / solved[0]]), residual
