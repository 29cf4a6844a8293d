"""What of a board or of markers one developed photograph shows, measured to hundredths of a pixel.

Markers are looked for in a gamma-like picture and, where that hides them, in a logarithmic one; corners are measured on
linear radiance.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from pipeline.camera.board_kinds import points_on, sightings_of, turns_alike
from pipeline.camera.markers import fit_marker, marker_points, tone
from pipeline.camera.opencv_bridge import Sightings, marker_pattern, markers_px
from pipeline.camera.sfm import Seen
from pipeline.run.errors import CaptureError
from pipeline.types import Camera

FEWEST_CORNERS = 6
ENOUGH_OF_BOARD = 0.7  # with fewer corners than this fraction the other tone curve is tried too
CURVES = ("gamma", "log")
Look = Callable[[str, str], tuple[np.ndarray, np.ndarray]]  # of a tone curve and a dictionary


def eight_bit(toned: np.ndarray) -> np.ndarray:
    """(H, W) uint8 of a picture in [0, 1]."""
    return (toned * 255 + 0.5).astype(np.uint8)


def sighted_board(radiance: np.ndarray, board: dict[str, Any], camera: Camera) -> Sightings:
    """Corners of the board in linear radiance (H, W), through the tone curve that shows more of them."""
    total = points_on(board)
    tries = []
    for curve in CURVES:
        toned = tone(radiance, curve)
        tries.append(sightings_of(eight_bit(toned), toned, board, camera))
        if len(tries[-1].px) >= ENOUGH_OF_BOARD * total:
            break
    return max(tries, key=lambda seen: len(seen.px))


def looked_at(radiance: np.ndarray) -> Look:
    """Ids and rough corners of the markers in a picture by tone curve and dictionary, each looked for once."""

    @cache
    def look(curve: str, dictionary: str) -> tuple[np.ndarray, np.ndarray]:
        return markers_px(eight_bit(tone(radiance, curve)), dictionary)

    return look


def sighted_marker(radiance: np.ndarray, marker: dict[str, Any], camera: Camera, look: Look | None = None) -> Sightings:
    """The four corners of a marker in linear radiance (H, W); none when it is not seen.

    ``look`` keeps what was found for the next marker of the same dictionary (`looked_at`).

    Raises CaptureError when it is seen twice, or when an edge cannot be followed.
    """
    look = look or looked_at(radiance)
    for curve in CURVES:
        ids, all_quads = look(curve, marker["dictionary"])
        quads, markers = all_quads[ids == marker["id"]], len(ids)
        if len(quads):
            break
    if len(quads) > 1:
        raise CaptureError(
            f"marker {marker['id']} is seen {len(quads)} times, needed once; cover the copies or use another id"
        )
    if not len(quads):
        return Sightings(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, int), markers)
    px = fit_marker(radiance, quads[0], camera, marker_pattern(marker["dictionary"], marker["id"]))
    return Sightings(marker_points(marker["side_m"]), px, np.arange(4), markers)


def marks_in(facts: dict[str, Any], radiance: np.ndarray, camera: Camera) -> tuple[list[Seen], list[str]]:
    """The board, or the markers, in linear radiance (H, W), and why some that are seen are left out."""
    if facts.get("board") and not turns_alike(facts["board"]):
        sights = sighted_board(radiance, facts["board"], camera)
        return ([Seen(0, sights.world_m, sights.px)] if len(sights.px) >= FEWEST_CORNERS else []), []
    found, notes, look = [], [], looked_at(radiance)
    for number, marker in enumerate(facts.get("marker") or []):
        try:
            sights = sighted_marker(radiance, marker, camera, look)
        except CaptureError as error:
            notes.append(str(error))
            continue
        if len(sights.px):
            found.append(Seen(number, sights.world_m, sights.px))
    return found, notes


def averaged(sightings: list[Sightings]) -> Sightings:
    """Corners by id, the mean over the views that saw them: their scatter stays in the residuals, not counted twice."""
    ids, where = np.unique(np.concatenate([seen.ids for seen in sightings]), return_inverse=True)
    count = np.bincount(where)[:, None]
    world_m, px = np.zeros((len(ids), 3)), np.zeros((len(ids), 2))
    np.add.at(world_m, where, np.concatenate([seen.world_m for seen in sightings]))
    np.add.at(px, where, np.concatenate([seen.px for seen in sightings]))
    return Sightings(world_m / count, px / count, ids, sightings[0].markers)
