"""Grids of markers and chessboards: their points in rendered pictures, poses by them, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import chessboard_print, grid_print, looking_at, photograph

from pipeline.camera import board_doubts
from pipeline.camera.board_kinds import points_on, sightings_of, turns_alike
from pipeline.camera.lens import project
from pipeline.camera.markers import tone
from pipeline.camera.resection import resect_plane
from pipeline.camera.rigid import camera_points, difference
from pipeline.camera.sights import eight_bit, sighted_board
from pipeline.run.board_facts import BoardFacts
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Camera

ARUCO = {"kind": "grid", "dictionary": "DICT_5X5_100", "squares": (5, 4), "square_m": 0.04, "marker_m": 0.03}
APRILTAG = {**ARUCO, "dictionary": "DICT_APRILTAG_36h11", "first_id": 20}
CHESS = {"kind": "chessboard", "squares": (7, 6), "square_m": 0.03, "marker_m": 0.0}
EVEN = {**CHESS, "squares": (8, 6)}
CAMERA = Camera(width=640, height=480, fx=700, fy=698, cx=322.3, cy=238.1, distortion=np.array([-0.1, 0.02, 0, 0, 0]))


def pictured(board: dict, pose: np.ndarray) -> np.ndarray:
    printed = (chessboard_print if board["kind"] == "chessboard" else grid_print)(board)
    return photograph(printed, CAMERA, pose, 3)


def middle(board: dict) -> np.ndarray:
    across, down = np.array(board["squares"]) * board["square_m"] / 2
    return np.array([across, 0, down])


@pytest.mark.parametrize("board", [ARUCO, APRILTAG, CHESS], ids=["aruco", "apriltag", "chessboard"])
@pytest.mark.parametrize("tilt", [10.0, 35.0])
def test_points_and_pose(board: dict, tilt: float) -> None:
    """Turned in the picture by 70 degrees, so that a board that is read the wrong way round is told."""
    pose = looking_at(middle(board), tilt, 200, 0.42, 70)
    radiance = pictured(board, pose)
    seen = sighted_board(radiance, board, CAMERA)
    assert len(seen.px) == points_on(board)
    off = seen.px - project(CAMERA, camera_points(pose, seen.world_m)[0])
    # 3 x 3 samples a pixel place an edge to 1/3 px / sqrt(12) = 0.1 px: less over a corner's window, half of it in the
    # mean of four corners. Measured 0.02 px on a chessboard, 0.055 on grids
    assert np.sqrt((off**2).mean()) < (0.05 if board is CHESS else 0.08)
    assert np.abs(off.mean(0)).max() < (0.02 if board is CHESS else 0.08 / np.sqrt(20) * 3)  # three sigma of the mean
    best, _, _ = resect_plane(CAMERA, seen.world_m, seen.px, 0.05)
    assert np.degrees(np.linalg.norm(difference(best.world_from_camera, pose)[:3])) < 0.1
    whole = np.ptp(seen.px @ np.linalg.svd(seen.px - seen.px.mean(0))[2].T, axis=0).max()
    size = np.ptp((seen.px - off) @ np.linalg.svd(seen.px - seen.px.mean(0))[2].T, axis=0).max()
    assert whole / size - 1 == pytest.approx(0, abs=5e-4)  # of 300 px: 0.15 px; refinements alone shrink markers by 1 %


def test_every_turn_of_a_chessboard_is_read_alike() -> None:
    """A picture turned by quarters holds the same corners at turned places."""
    toned = tone(pictured(CHESS, looking_at(middle(CHESS), 25, 30, 0.36)))
    first = sightings_of(eight_bit(toned), toned, CHESS)
    at = first.px - (320, 240)
    for turns in range(1, 4):
        turned = np.ascontiguousarray(np.rot90(toned, turns))
        seen = sightings_of(eight_bit(turned), turned, CHESS)
        at = at @ np.array([[0, -1], [1, 0]])  # counter-clockwise as seen, y down
        np.testing.assert_allclose(seen.px - np.array(turned.shape[::-1]) / 2, at, atol=0.02)


def test_a_chessboard_that_turns_alike_is_for_the_lens_only() -> None:
    assert turns_alike(EVEN)
    assert turns_alike({**CHESS, "squares": (5, 5)})
    assert not turns_alike(CHESS)
    assert not turns_alike(ARUCO)
    pose = looking_at(middle(EVEN), 25, 30, 0.4)
    radiance = pictured(EVEN, pose)
    toned = tone(radiance)
    assert len(sightings_of(eight_bit(toned), toned, EVEN).px) == 35  # photographs of the lens take it
    with pytest.raises(CaptureError, match=r"8 x 6 squares looks the same .* an even and an odd count; lay"):
        board_doubts.sighted({"board": EVEN}, "charuco", radiance, CAMERA)


def test_another_board_is_named() -> None:
    picture = eight_bit(tone(pictured(APRILTAG, looking_at(middle(APRILTAG), 15, 10, 0.36))))
    said = board_doubts.of_board([picture], ARUCO | {"squares": (5, 4)})
    assert "DICT_APRILTAG_36h11" in said
    with pytest.raises(ManifestError, match="needs marker ids up to 119; DICT_5X5_100 holds 100"):
        sightings_of(picture, picture, {**ARUCO, "first_id": 100})


def test_a_grid_seen_twice_is_named() -> None:
    picture = eight_bit(tone(pictured(ARUCO, looking_at(middle(ARUCO), 15, 10, 0.36))))
    seen = sightings_of(np.concatenate([picture, picture], 1), picture, ARUCO)
    assert len(seen.twice) == 20
    assert not len(seen.px)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"kind": "cross"}, "charuco"),
        ({"kind": "chessboard", "marker_m": 0.02}, "which has no marker_m"),
        ({"kind": "chessboard", "squares": [3, 6]}, r"squares is \[3, 6\]; a chessboard needs 4 or more"),
        ({"kind": "grid", "marker_m": 0.05}, r"marker_m is 0.05; expected .* below square_m = 0.04"),
        ({"kind": "grid"}, "marker_m is 0; expected the side of a marker"),
        ({"kind": "grid", "marker_m": 0.03, "legacy": True}, "legacy is for kind 'charuco'"),
        ({"kind": "grid", "layout": "insitu-a4"}, "layout insitu-a4 does not have this kind"),
    ],
)
def test_facts_that_do_not_fit(changes: dict, line: str) -> None:
    facts = {"squares": [5, 4], "square_m": 0.04} if "layout" not in changes else {}
    with pytest.raises(ValueError, match=line):
        BoardFacts.model_validate(facts | changes)
