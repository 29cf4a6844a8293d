"""What boards and markers alone would give: lens, pose of every view, and how surely a foot is then seen where it is.

These are the sources that cost little. What they leave is compared, in pixels at the objects' feet, with a budget; only
beyond it are the further views oriented (stage sfm), which costs ten times as much.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
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
from pipeline.camera.marker_map import solve, with_tripod
from pipeline.camera.opencv_bridge import Sightings, first_calibration
from pipeline.camera.own_boards import bundle_of_boards, sharpened
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


def only_words(facts: dict[str, Any], board_photos: list[dict[str, str]]) -> bool:
    """Whether nothing but metadata tells of the plate's lens, further views apart."""
    stated, mine = facts["camera"], [photo for photo in board_photos if photo.get("view", "plate") == "plate"]
    return not (stated.get("given") or stated.get("former") or mine)


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


def marks_of(
    facts: dict[str, Any], names: Iterable[str], look: Look, lens: Camera
) -> tuple[dict[str, list[Seen]], dict[str, str]]:
    """Board or markers in each view, none where too little is seen, and then in words why."""
    marks: dict[str, list[Seen]] = {}
    notes: dict[str, str] = {}
    for name in dict.fromkeys(names):
        marks[name] = []
        try:
            if facts.get("board"):
                seen = sighted_board(look(name), facts["board"], lens)
                count, needed = len(seen.px), FEWEST_CORNERS
                marks[name] = [Seen(0, seen.world_m, seen.px)] if count >= needed else []
            else:
                marks[name], said = marks_in(facts, look(name), lens)
                count, needed = sum(len(one.px) for one in marks[name]), 4
                if said and not marks[name]:
                    raise CaptureError(said[0])
        except CaptureError as error:
            notes[name] = str(error)
            continue
        if not marks[name]:
            notes[name] = (
                f"it shows {count} corners of the {'board' if facts.get('board') else 'marker'}, needed {needed}"
            )
    return marks, notes


def marks_of_photos(facts: dict[str, Any], view_photos: list[Frame], lens: Camera) -> dict[str, list[Seen]]:
    """Markers in further photographs of the plate's camera, which help to map several of unknown layout; else none."""
    if len(facts.get("marker") or []) < 2 or facts.get("board") or (facts.get("views") or {}).get("own_camera", False):
        return {}
    root = Path(facts["capture_root"])
    return {photo.file: marks_in(facts, linear_of(root / photo.file), lens)[0] for photo in view_photos}


def surer(
    known: KnownLens, marks: dict[str, list[Seen]], tripod: list[str], corner_sigma_px: float, min_ambiguity: float
) -> tuple[KnownLens, float, int]:
    """EXIF's lens with what board and markers in the capture's own views say of it, if they say much.

    Returns also chi-square of how far it then lies from EXIF's word, and the number of views; 0 where it is as it was.
    """
    shown = {name: seen for name, seen in marks.items() if seen}
    here = [name for name in ("plate", *tripod) if name in shown][1:]  # the first of them stands for the place
    shown = {name: seen for name, seen in shown.items() if name not in here}
    if any(one.marker for seen in shown.values() for one in seen):
        try:
            boards = solve(shown, dict.fromkeys(shown, known.camera), corner_sigma_px).done.bundle
        except (CaptureError, NumericalError):
            return known, 0.0, 0
    else:
        boards = bundle_of_boards(
            known.camera, {name: seen[0] for name, seen in shown.items()}, corner_sigma_px, min_ambiguity
        )
    found = sharpened(known.camera, boards, corner_sigma_px)
    if found is None:
        return known, 0.0, 0
    return KnownLens(found[0], "of EXIF and the boards in view", True), found[1], len(boards.poses)


def by_marks(
    marks: dict[str, list[Seen]], notes: dict[str, str], asked: list[str], tripod: list[str], route: str, lens: Camera,
    corner_sigma_px: float, min_ambiguity: float,
) -> dict[str, View | str]:  # fmt: skip
    """The pose of each view by board or markers, or in words why there is none.

    ``asked``: views of the plate's camera; a plate that shows nothing takes the pose of a view of its ``tripod``.
    ``route``: charuco, or marker, of which there may be several.
    """
    if any(one.marker for seen in marks.values() for one in seen):
        estimates = _mapped(marks, asked, tripod, lens, corner_sigma_px)
    else:
        estimates = {name: _alone(marks[name], notes.get(name, ""), route, lens, corner_sigma_px) for name in asked}
        for name in tripod if "plate" in asked and not marks["plate"] else []:
            if marks[name]:
                estimates["plate"] = _alone(marks[name], "", route, lens, corner_sigma_px)
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


def _alone(marks: list[Seen], note: str, route: str, lens: Camera, sigma_px: float) -> Estimate | str:
    """One view by the board or the only marker."""
    if not marks:
        return note
    world_m, px = marks[0].points, marks[0].px
    try:
        best = resect_plane(lens, world_m, px, sigma_px, route == "charuco")
    except NumericalError as error:
        return str(error)
    return Estimate(route, Sightings(world_m, px, np.arange(len(px)), 0), *best)


def _mapped(
    marks: dict[str, list[Seen]], asked: list[str], tripod: list[str], lens: Camera, sigma_px: float
) -> dict[str, Estimate | str]:
    """Several views by markers of unknown layout."""
    try:
        found = with_tripod(marks, dict.fromkeys(marks, lens), tripod, sigma_px, MOVED_CHI2)[0]
    except (CaptureError, NumericalError) as error:
        return dict.fromkeys(asked, str(error))
    return {
        name: map_estimate(found, name, marks[name], lens, sigma_px) if name in found.names
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
