"""What boards and markers alone would give: lens, pose of every view, and how surely a foot is then seen where it is.

These are the sources that cost little. What they leave is compared, in pixels at the objects' feet, with a budget; only
beyond it are the further views oriented (stage sfm), which costs ten times as much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.board_photos import corners_of
from pipeline.camera.board_pictures import linear_of
from pipeline.camera.contact import contact_sigma
from pipeline.camera.estimates import (
    MOVED_CHI2,
    Estimate,
    given_view,
    map_estimate,
    points_estimate,
    refuse_ambiguous,
    view_of,
)
from pipeline.camera.exif_camera import exif_camera
from pipeline.camera.given_camera import given_camera
from pipeline.camera.lens_ladder import fit_model
from pipeline.camera.marker_map import with_tripod
from pipeline.camera.opencv_bridge import Sightings, first_calibration
from pipeline.camera.resection import resect_plane
from pipeline.camera.sfm import Seen, camera_start
from pipeline.camera.sights import FEWEST_CORNERS, marks_in, sighted_board
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.types import Camera, Frame, View

Look = Callable[[str], np.ndarray]  # linear radiance (H, W) of a view


@dataclass(frozen=True)
class KnownLens:
    """The plate's lens without further views; ``bettered``: tracks of them would replace it."""

    camera: Camera
    source: str
    bettered: bool


def known_lens(facts: dict[str, Any], frame: Frame, board_photos: list[dict[str, str]]) -> KnownLens:
    """Stated, of a former build, of board photographs (here with two terms of distortion), or what EXIF says.

    Where EXIF says nothing that can be used, a guess stands in, as markers must be looked for through some lens.
    """
    stated = facts["camera"]
    if stated.get("given"):
        return KnownLens(given_camera(stated["given"]), "stated", False)
    if stated.get("former"):
        return KnownLens(Camera.model_validate(stated["former"]), "of a former calibration", False)
    mine = [photo for photo in board_photos if photo.get("view", "plate") == "plate"]
    if mine:
        photos, size = corners_of(facts, mine, [])
        start, poses = first_calibration(photos.world_m, photos.px, size)
        return KnownLens(fit_model(start, poses, photos, ("k1", "k2")).camera, "of board photographs", False)
    try:
        camera = exif_camera(frame, (facts.get("lens") or {}).get("name") or "")[0]
    except CaptureError:
        return KnownLens(camera_start(frame), "unknown", True)
    return KnownLens(camera, "as EXIF says", True)


def by_marks(
    facts: dict[str, Any], asked: list[str], tripod: list[str], look: Look, view_photos: list[Frame], lens: Camera,
    corner_sigma_px: float, min_ambiguity: float,
) -> dict[str, View | str]:  # fmt: skip
    """The pose of each view by board or markers, or in words why there is none.

    ``asked``: views of the plate's camera; a plate that shows nothing takes the pose of a view of its ``tripod``.
    """
    if len(facts.get("marker") or []) > 1 and not facts.get("board"):
        estimates = _mapped(facts, asked, tripod, look, view_photos, lens, corner_sigma_px)
    else:
        estimates = {name: _alone(facts, look(name), lens, corner_sigma_px) for name in asked}
        for name in tripod if "plate" in asked and isinstance(estimates["plate"], str) else []:
            if isinstance(found := _alone(facts, look(name), lens, corner_sigma_px), Estimate):
                estimates["plate"] = found
                break
    return {name: _decided(estimate, min_ambiguity) for name, estimate in estimates.items()}


def _decided(estimate: Estimate | str, min_ambiguity: float) -> View | str:
    if isinstance(estimate, str):
        return estimate
    try:
        refuse_ambiguous(estimate, min_ambiguity)
    except NumericalError:
        return f"two poses explain its marker (chi2 ratio {estimate.ambiguity:.1f}, needed {min_ambiguity:g})"
    return view_of(estimate)


def _alone(facts: dict[str, Any], radiance: np.ndarray, lens: Camera, sigma_px: float) -> Estimate | str:
    """One view by the board or the only marker."""
    route = "charuco" if facts.get("board") else "marker"
    try:
        if facts.get("board"):
            seen = sighted_board(radiance, facts["board"], lens)
            world_m, px, needed = seen.world_m, seen.px, FEWEST_CORNERS
        else:
            marks = marks_in(facts, radiance, lens)[0]
            world_m, px = (marks[0].points, marks[0].px) if marks else (np.empty((0, 3)), np.empty((0, 2)))
            needed = 4
        if len(px) < needed:
            return f"it shows {len(px)} corners of the {'board' if facts.get('board') else 'marker'}, needed {needed}"
        return Estimate(
            route, Sightings(world_m, px, np.arange(len(px)), 0), *resect_plane(lens, world_m, px, sigma_px)
        )
    except (CaptureError, NumericalError) as error:
        return str(error)


def _mapped(
    facts: dict[str, Any], asked: list[str], tripod: list[str], look: Look, view_photos: list[Frame], lens: Camera,
    sigma_px: float,
) -> dict[str, Estimate | str]:  # fmt: skip
    """Several views by markers of unknown layout; further photographs of the plate's camera help to find it."""
    seen: dict[str, list[Seen]] = {
        name: marks_in(facts, look(name), lens)[0] for name in dict.fromkeys([*asked, *tripod])
    }
    if not (facts.get("views") or {}).get("own_camera", False):
        root = Path(facts["capture_root"])
        seen |= {photo.file: marks_in(facts, linear_of(root / photo.file), lens)[0] for photo in view_photos}
    try:
        found = with_tripod(seen, dict.fromkeys(seen, lens), tripod, sigma_px, MOVED_CHI2)[0]
    except (CaptureError, NumericalError) as error:
        return dict.fromkeys(asked, str(error))
    return {
        name: map_estimate(found, name, seen[name], lens, sigma_px) if name in found.names
        else "it shows no marker that hangs together with the first"
        for name in asked
    }  # fmt: skip


def stated_view(facts: dict[str, Any], lens: Camera, corner_sigma_px: float) -> View | None:
    """The plate's pose where [[pose]] says it, by points or a matrix; None for other routes.

    A stated pose owes nothing to the lens, so none of the lens's error is undone by it.
    """
    order = next((entry for entry in facts.get("pose", []) if entry["view"] == "plate"), {"route": ""})
    if order["route"] == "given":
        nothing = np.zeros((6, len(lens.covariance)))
        return given_view("plate", order).model_copy(update={"lens_covariance": nothing})
    if order["route"] == "points":
        return view_of(points_estimate(order, lens, corner_sigma_px))
    return None


def left_at(lens: Camera, view: View, spots: dict[str, np.ndarray]) -> tuple[dict[str, float], dict[str, float]]:
    """Contact uncertainty [px] at each spot (3,) that the plate shows: whole, and what it is with the lens exact."""
    exact = lens.model_copy(update={"covariance": np.zeros_like(lens.covariance)})
    by_lens = np.zeros((6, 6))
    if view.lens_covariance is not None and np.any(lens.covariance):
        # with_lens = M C and its part of the pose M C M^T, so M C C^-1 (M C)^T
        by_lens = view.lens_covariance @ np.linalg.pinv(lens.covariance) @ view.lens_covariance.T
    noise = view.model_copy(update={"covariance": view.covariance - by_lens, "lens_covariance": None})
    whole = {name: contact_sigma(lens, view, spot) for name, spot in spots.items()}
    alone = {name: contact_sigma(exact, noise, spot) for name, spot in spots.items()}
    shown = [name for name, value in whole.items() if np.isfinite(value)]
    return {name: whole[name] for name in shown}, {name: alone[name] for name in shown}
