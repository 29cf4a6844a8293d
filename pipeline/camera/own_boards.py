"""A lens that only EXIF tells of, made surer by the board or the markers in the capture's own views.

One least squares (`bundle.adjust` without a cloud) over the poses, the markers' places and the lens: one focal length,
the principal point and k1, each held near EXIF's word by its stated uncertainty. A view seen squarely says little of
the focal length and then nothing is gained; two tilts several ways say most. Views from one tripod position count as
one, as their boards are the same points at the same places. The pose stage then finds poses through this lens from the
same corners: noise at a given lens plus the lens's covariance carried through is their joint covariance exactly.
Limits: terms of distortion beyond k1 keep EXIF's (or lensfun's) word.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.camera.adjustment import free_columns, lens_vector
from pipeline.camera.bundle import Adjusted, adjust
from pipeline.camera.reprojection import Bundle, Corners, residuals_of
from pipeline.camera.resection import resect_plane
from pipeline.camera.sfm import Seen
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

TERMS = ("k1",)
FEWEST_CORNERS = 16  # fewer leave next to nothing over for the lens beside the poses
GAINED = 0.8  # of EXIF's uncertainty of the focal length: what must be left, or nothing is changed
SURPRISE_CHI2 = 18.5  # 99.9 % of chi-square of focal length, centre (2) and k1


def bundle_of_boards(exif: Camera, seen: dict[str, Seen], sigma_px: float, min_ambiguity: float) -> Bundle:
    """One board or marker in several views (each from a place of its own) as a bundle; ambiguous views are left out."""
    poses: list[np.ndarray] = []
    corners: list[Corners] = []
    for one in seen.values():
        try:
            best, _, ambiguity = resect_plane(exif, one.points, one.px, sigma_px)
        except NumericalError:
            continue
        if ambiguity < min_ambiguity:
            continue
        corners.append(Corners(len(poses), 0, one.points[best.kept], one.px[best.kept]))
        poses.append(best.world_from_camera)
    nowhere = np.zeros(0, int)
    return Bundle([exif], poses, np.zeros(len(poses), int), np.zeros((0, 3)), nowhere, nowhere, np.zeros((0, 2)),
                  [np.eye(4)], corners)  # fmt: skip


def sharpened(exif: Camera, boards: Bundle, sigma_px: float) -> tuple[Camera, float] | None:
    """The lens with covariance, and chi-square of how far it lies from EXIF's word; None where little is gained.

    ``boards``: a start, its only lens ``exif`` (Brown's, with a diagonal covariance but for one focal length).
    ``sigma_px``: the least standard uncertainty of a corner; residuals that are larger count as they are.
    """
    if sum(len(one.px) for one in boards.corners) < FEWEST_CORNERS:
        return None
    columns = free_columns(TERMS, True)
    prior = np.sqrt(np.diag(exif.covariance))
    prior[1] = np.inf  # one focal length: its word counts once
    prior = np.where(prior > 0, prior, np.inf)
    start = replace(boards, cameras=[exif])
    try:
        found = adjust(start, [columns], [prior])
        found = adjust(start, [columns], [prior], corner_sigma_px=max(sigma_px, found.corner_sigma_px))
    except NumericalError:
        return None
    camera = found.bundle.cameras[0]
    if not np.sqrt(found.lens_covariance[0][0, 0]) < GAINED * prior[0]:
        return None
    moved = (lens_vector(camera) - lens_vector(exif)) / prior
    return camera.model_copy(
        update={"covariance": found.lens_covariance[0], "rms_px": _rms(found), "source": "exif and boards"}
    ), float((moved**2).sum())


def _rms(found: Adjusted) -> float:
    """Root mean square distance [px] of the corners from where the adjusted boards have them."""
    return float(np.sqrt((residuals_of(found.bundle) ** 2).sum(-1).mean()))
