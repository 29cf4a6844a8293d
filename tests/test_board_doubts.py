"""Bad input to calibration, pose and plane, each with its own line; on rendered pictures where pictures matter."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from printed_board import BOARD, MARKER, charuco_print, looking_at, marker_print, photograph
from test_calibrate import TRUTH, corners_of, poses_of
from test_calibrate import run as calibrated

from pipeline.camera import board_doubts, view_checks
from pipeline.camera.markers import fit_marker, tone
from pipeline.camera.opencv_bridge import board_sightings, marker_corners_px, repeated
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Frame, Reconstruction
from stages import calibrate, knobs

CAMERA = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
CENTRE = np.array([0.105, 0, 0.075])
PLATE = looking_at(CENTRE, 40, 10, 0.42)


def eight_bit(picture: np.ndarray) -> np.ndarray:
    return (tone(picture) * 255 + 0.5).astype(np.uint8)


@pytest.fixture(scope="module")
def board_picture() -> np.ndarray:
    return eight_bit(photograph(charuco_print(BOARD), CAMERA, PLATE, 3))


@pytest.fixture(scope="module")
def marker_radiance() -> np.ndarray:
    return photograph(marker_print(MARKER), CAMERA, looking_at(np.zeros(3), 40, 10, 0.42), 4)


class TestBoard:
    @pytest.mark.parametrize(
        "stated",
        [
            {"dictionary": "DICT_4X4_50"},
            {"dictionary": "DICT_APRILTAG_36h11"},
            {"squares": (5, 7)},
            {"squares": (8, 6)},
        ],
    )
    def test_what_fits_is_suggested(self, board_picture, stated):
        wrong = {**BOARD, **stated}
        assert len(board_sightings(board_picture, board_picture, wrong).px) == 0
        assert (
            board_doubts.of_board([board_picture], wrong)
            == 'what it shows fits dictionary = "DICT_5X5_100", squares = [7, 5]'
        )

    def test_nothing_is_said_of_the_right_board_or_of_none(self, board_picture):
        assert board_doubts.of_board([board_picture], {**BOARD, "dictionary": "DICT_5X5_250"}) == ""
        assert board_doubts.of_board([np.full((360, 480), 90, np.uint8)], BOARD) == ""

    def test_mirrored(self, board_picture):
        mirrored = np.ascontiguousarray(board_picture[:, ::-1])
        assert len(board_sightings(mirrored, mirrored, BOARD).px) == 0
        assert "17 markers of DICT_5X5_1000 are read in its mirror image" in board_doubts.of_board([mirrored], BOARD)

    def test_two_boards_are_noticed(self, board_picture):
        both = np.full((720, 960), 90, np.uint8)
        both[:360, :480] = both[360:, 480:] = board_picture
        assert board_sightings(both, both, BOARD).twice == tuple(range(17))
        assert board_sightings(board_picture, board_picture, BOARD).twice == ()

    def test_one_marker_found_as_two_outlines_is_one(self):
        quad = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
        assert repeated(np.array([quad, quad + 1, quad + 30]), np.array([4, 4, 5])) == ()
        assert repeated(np.array([quad, quad + 30, quad + 60]), np.array([4, 4, 5])) == (4,)

    def test_out_of_frame(self, board_picture):
        assert board_doubts.cut(CAMERA, PLATE, BOARD, 24) == ""
        aside = looking_at(np.array([0.225, 0, 0.075]), 40, 10, 0.42)
        text = board_doubts.cut(CAMERA, aside, BOARD, 9)
        share = board_doubts.outside_frame(CAMERA, aside, BOARD)
        assert 0.1 < share < 0.6
        assert text.startswith(f"{share:.0%} of the board's outline is out of the frame, 9 of 24 corners")


class TestMarker:
    def test_what_is_shown_is_named(self, marker_radiance):
        picture = eight_bit(marker_radiance)
        assert board_doubts.of_marker(picture, MARKER) == ""
        other = board_doubts.of_marker(picture, {**MARKER, "dictionary": "DICT_6X6_50", "id": 3})
        assert other == "it shows DICT_5X5_100, id 7; [marker] says DICT_6X6_50, id 3"
        mirrored = np.ascontiguousarray(picture[:, ::-1])
        assert "mirror image" in board_doubts.of_marker(mirrored, MARKER)

    @pytest.mark.parametrize(("stated", "line"), [(0.100, ""), (0.103, "(-2.9%)"), (0.090, "(+11.1%)")])
    def test_a_wrong_size_beside_another_print(self, marker_radiance, stated, line):
        """The pose is right to the world's metre; the marker on the plane is then 100 mm, whatever is stated."""
        pose = looking_at(np.zeros(3), 40, 10, 0.42)
        quads = marker_corners_px(eight_bit(marker_radiance), MARKER["dictionary"], 7)[0]
        px = fit_marker(marker_radiance, quads[0], CAMERA, 7)
        measured = board_doubts.side_on_plane(CAMERA, pose, px)
        assert measured is not None
        assert measured[0] == pytest.approx(0.1, abs=4 * measured[1])
        said = board_doubts.wrong_size({**MARKER, "side_m": stated}, measured, "board")
        assert (line in said) if line else said == ""

    def test_a_standing_marker_says_nothing_of_sizes(self):
        upright = np.array([[-0.05, 0.1, 0], [0.05, 0.1, 0], [0.05, 0, 0], [-0.05, 0, 0]])
        pose = looking_at(np.zeros(3), 40, 10, 0.42)
        from pipeline.camera.lens import project
        from pipeline.camera.rigid import camera_points

        assert board_doubts.side_on_plane(CAMERA, pose, project(CAMERA, camera_points(pose, upright)[0])) is None


class TestCalibration:
    def photographs(self, folder, pictures: list[np.ndarray], board: dict):
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(folder / f"{number}.png"), picture)
        facts = {"capture_root": str(folder), "board": board, "camera": {"calibration": ["*.png"], "given": None}}
        photos = [{"file": f"{number}.png"} for number in range(len(pictures))]
        return calibrate.compute(facts, photos, Reconstruction(), knobs.Calibrate())

    def test_wrong_dictionary(self, board_picture, tmp_path):
        with pytest.raises(CaptureError, match=r'0 of 3 .* what it shows fits dictionary = "DICT_5X5_100", squares'):
            self.photographs(tmp_path, [board_picture] * 3, {**BOARD, "dictionary": "DICT_6X6_250"})

    def test_two_photographs(self, board_picture, tmp_path):
        with pytest.raises(CaptureError, match="2 of 2 photographs show the board, needed 3"):
            self.photographs(tmp_path, [board_picture] * 2, BOARD)

    def test_two_boards(self, board_picture, tmp_path):
        half = cv2.resize(board_picture, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
        both = np.concatenate([half, half], 1)
        with pytest.raises(CaptureError, match="0 of 3 photographs show the board, needed 3; cover all boards but one"):
            self.photographs(tmp_path, [both] * 3, BOARD)

    def test_turned_files(self, board_picture, tmp_path):
        with pytest.raises(CaptureError, match="turned by 90 degrees"):
            self.photographs(tmp_path, [board_picture, np.rot90(board_picture).copy(), board_picture], BOARD)

    @pytest.mark.parametrize("factor", [0.9, 1.1])
    def test_a_moved_zoom_is_named(self, monkeypatch, factor):
        """One photograph of nine at another focal length: left out, and by how much to a per cent."""
        poses = poses_of(9, (20, 50), 6)
        corners = corners_of(poses, TRUTH, 0.03, 6)
        zoomed = TRUTH.model_copy(update={"fx": factor * TRUTH.fx, "fy": factor * TRUTH.fy})
        corners[4] = corners_of(poses[4:5], zoomed, 0.03, 7)[0]
        monkeypatch.setattr(calibrate, "compute", with_reconstruction(calibrate.compute))
        result = calibrated(monkeypatch, corners)
        line = next(text for text in result.warnings if text.startswith("4.jpg: residual"))
        said = float(line.split("focal length ")[1].split("%")[0]) / 100
        assert said == pytest.approx(factor - 1, abs=0.02)
        assert result.numbers["photos"] == 8


def with_reconstruction(compute):
    def inner(*args):
        return compute(*args) if len(args) == 4 else compute(*args[:-1], Reconstruction(), args[-1])

    return inner


def frame(name: str, **more) -> Frame:
    return Frame(
        file=name, sha256=name, exposure_s=0.1, iso=100, fnumber=8, width=8, height=6, cfa="", black=np.zeros((1, 3)),
        white=255, **more,
    )  # fmt: skip


class TestLens:
    def test_zoom_by_metadata(self):
        frames = [frame(f"{i}.jpg", focal_mm=24.0) for i in range(4)] + [frame("z.jpg", focal_mm=35.0)]
        (line,) = view_checks.lens_strangers(frames, "board photographs")
        assert line.startswith("z.jpg: focal length 35 mm, the other board photographs 24 mm")
        assert view_checks.lens_strangers([*frames[:4], frame("n.jpg"), frame("r.jpg", focal_mm=24.2)], "x") == []

    def test_a_phone_that_changes_lenses(self):
        frames = [frame(f"{i}.jpg", focal_mm=5.7, lens="back camera 5.7mm f/1.8") for i in range(3)]
        frames.append(frame("w.jpg", focal_mm=1.5, lens="back camera 1.5mm f/2.4"))
        (line,) = view_checks.lens_strangers(frames, "further views")
        assert line.startswith("w.jpg: lens 'back camera 1.5mm f/2.4'")
        assert "lock it" in line

    def test_plate_and_board(self):
        assert view_checks.zoom_differs([frame("a", focal_mm=50.0)], [frame("b", focal_mm=35.0)]) == (50.0, 35.0)
        assert view_checks.zoom_differs([frame("a", focal_mm=50.0)], [frame("b", focal_mm=50.4)]) is None
        assert view_checks.zoom_differs([frame("a", focal_mm=50.0)], [frame("b")]) is None


def cloud(step_m: float) -> Reconstruction:
    """Four cameras in a row, ``step_m`` apart, and points 2 to 4 m away that all of them see."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (50, 3))
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(4)
    seen = np.stack(np.meshgrid(np.arange(4), np.arange(50), indexing="ij")).reshape(2, -1)
    return Reconstruction(
        method="incremental", names=list("abcd"), missing=[], world_from_camera=poses, cameras=[CAMERA],
        camera_of=np.zeros(4, int), points=points, seen_view=seen[0], seen_point=seen[1],
        px=np.zeros((200, 2)),
    )  # fmt: skip


def test_pure_rotation() -> None:
    made = cloud(0.005)
    exact = np.degrees(2 * np.arctan(0.0075 / 3.0))  # a baseline of 15 mm at 3 m, the median depth
    assert view_checks.parallax_deg(made) == pytest.approx(exact, rel=0.2)  # by the spread of the points
    assert "turned on the spot" in view_checks.only_turned(made)
    assert view_checks.only_turned(cloud(0.05)) == ""
