"""Bad input to calibration, pose and plane, each with its own line; on rendered pictures where pictures matter."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from printed_board import BOARD, MARKER, charuco_print, looking_at, marker_print, photograph
from test_bundle import noisy, world
from test_calibrate import POINTS, TRUTH, corners_of, poses_of

from pipeline.camera import board_doubts, board_photos, view_checks
from pipeline.camera.bundle import adjust
from pipeline.camera.lens import project
from pipeline.camera.lens_ladder import Photos, drop_bad
from pipeline.camera.markers import tone
from pipeline.camera.opencv_bridge import board_sightings, first_calibration, repeated
from pipeline.camera.rigid import camera_points
from pipeline.camera.sights import sighted_marker
from pipeline.image.brackets import check_zoom
from pipeline.probes.finding import Found, complaints
from pipeline.probes.outline import Height
from pipeline.run.errors import CaptureError
from pipeline.types import Camera, Frame, Raster, Reconstruction
from stages import ingest, knobs, pose

CAMERA = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
CENTRE = np.array([0.105, 0, 0.075])
PLATE = looking_at(CENTRE, 40, 10, 0.42)


def eight_bit(picture: np.ndarray) -> np.ndarray:
    return (tone(picture) * 255 + 0.5).astype(np.uint8)


@pytest.fixture(scope="module")
def board_picture(radiance) -> np.ndarray:
    return eight_bit(radiance)


@pytest.fixture(scope="module")
def radiance() -> np.ndarray:
    return photograph(charuco_print(BOARD), CAMERA, PLATE, 3)


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
        where = looking_at(np.zeros(3), 40, 10, 0.42)
        px = sighted_marker(marker_radiance, MARKER, CAMERA).px
        measured = board_doubts.side_on_plane(CAMERA, where, px)
        assert measured is not None
        assert measured[0] == pytest.approx(0.1, abs=4 * measured[1])
        said = board_doubts.wrong_size({**MARKER, "side_m": stated}, measured, "board")
        assert (line in said) if line else said == ""

    def test_a_standing_marker_says_nothing_of_sizes(self):
        upright = np.array([[-0.05, 0.1, 0], [0.05, 0.1, 0], [0.05, 0, 0], [-0.05, 0, 0]])
        where = looking_at(np.zeros(3), 40, 10, 0.42)
        assert board_doubts.side_on_plane(CAMERA, where, project(CAMERA, camera_points(where, upright)[0])) is None


class TestCalibration:
    def photographs(self, folder, pictures: list[np.ndarray], board: dict):
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(folder / f"{number}.png"), picture)
        facts = {"capture_root": str(folder), "board": board, "camera": {"calibration": ["*.png"], "given": None}}
        photos = [{"file": f"{number}.png"} for number in range(len(pictures))]
        return board_photos.corners_of(facts, photos, [])

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
    def test_a_moved_zoom_is_named(self, factor):
        """One photograph of nine at another focal length: left out, and by how much to a per cent or so.

        Its own focal length is known to 1 % from one view of 24 corners at 0.03 px; the text rounds to one more.
        """
        poses = poses_of(9, (20, 50), 6)
        corners = corners_of(poses, TRUTH, 0.03, 6)
        moved = TRUTH.model_copy(update={"fx": factor * TRUTH.fx, "fy": factor * TRUTH.fy})
        corners[4] = corners_of(poses[4:5], moved, 0.03, 7)[0]
        photos = Photos([f"{n}.jpg" for n in range(9)], [POINTS] * 9, corners)
        start, found = first_calibration([POINTS] * 9, corners, (1024, 768))
        warnings: list[str] = []
        rest, _ = drop_bad(start, photos, found, warnings)
        assert rest.files == [f"{n}.jpg" for n in range(9) if n != 4]
        (line,) = warnings
        assert line.startswith("4.jpg: residual")
        assert float(line.split("focal length ")[1].split("%")[0]) / 100 == pytest.approx(factor - 1, abs=0.021)


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


class TestPose:
    def posed(self, radiance: np.ndarray, **facts):
        camera = CAMERA.model_copy(update={"width": radiance.shape[1], "height": radiance.shape[0]})
        picture = Raster({channel: np.asarray(radiance, np.float32) for channel in "RGB"}, "acescg")
        stated = {"board": None, "marker": [], "ball": [], "pose": [], "capture_root": ".", **facts}
        return pose.compute(stated, {"plate": picture}, camera, {}, Reconstruction(), [], knobs.Pose())

    def test_wrong_dictionary(self, radiance):
        with pytest.raises(CaptureError, match=r"plate: 0 corners .* what it shows fits dictionary = \"DICT_5X5_100\""):
            self.posed(radiance, board={**BOARD, "dictionary": "DICT_4X4_50"})

    def test_mirrored(self, radiance):
        with pytest.raises(CaptureError, match="mirror image"):
            self.posed(radiance[:, ::-1], board=BOARD)

    def test_two_boards(self, radiance):
        with pytest.raises(CaptureError, match=r"plate: ids 0, 1, 2, 3, \.\.\. are seen twice, needed one board"):
            self.posed(np.concatenate([radiance, radiance], 1), board=BOARD)

    def test_another_marker(self, marker_radiance):
        with pytest.raises(CaptureError, match=r"it shows DICT_5X5_100, id 7; \[marker\] says DICT_5X5_100, id 3"):
            self.posed(marker_radiance, marker=[{**MARKER, "id": 3}])

    def test_part_of_the_board(self):
        """The right third is out of the frame: said, and the pose is still the right one."""
        aside = looking_at(np.array([0.2, 0, 0.075]), 40, 10, 0.42)
        result = self.posed(photograph(charuco_print(BOARD), CAMERA, aside, 3), board=BOARD)
        assert any("of the board's outline is out of the frame" in text for text in result.warnings)
        found = result.outputs["views"]["plate"].world_from_camera
        assert np.abs(found[:3, 3] - aside[:3, 3]).max() < 2e-3  # of 0.42 m; corners of one side only

    @pytest.mark.parametrize(("square_m", "line"), [(0.030, ""), (0.0285, "(-5.0%)")])
    def test_a_board_printed_too_small_beside_a_marker(self, square_m, line):
        """Board of 30 mm squares, marker of 60 mm beside it: stating 28.5 mm makes the marker 5 % smaller."""
        picture, per_metre, first = charuco_print(BOARD)
        marker, _, _ = marker_print({**MARKER, "side_m": 0.06, "id": 40})
        size = round((0.06 + 4 * 0.06 / 7) * per_metre)
        marker = cv2.resize(marker, (size, size), interpolation=cv2.INTER_NEAREST)
        sheet = np.full((max(picture.shape[0], size), picture.shape[1] + 100 + size), 255, np.uint8)
        sheet[: picture.shape[0], : picture.shape[1]] = picture
        sheet[:size, -size:] = marker
        view = looking_at(np.array([0.16, 0, 0.075]), 30, 10, 0.6)
        radiance = photograph((sheet, per_metre, first), CAMERA, view, 3)
        stated = {"board": {**BOARD, "square_m": square_m, "marker_m": square_m * 0.022 / 0.03}}
        warnings = self.posed(radiance, **stated, marker=[{**MARKER, "id": 40, "side_m": 0.06}]).warnings
        said = [text for text in warnings if "marker 40: its side is" in text]
        assert (not said) if not line else ("57.0 mm by the board" in said[0] and line in said[0])


@pytest.mark.parametrize("stated", [1.0, 0.97, 1.05])
def test_a_print_of_another_size_is_told_by_the_ball(stated):
    """A world ``stated`` times as large as the real one: the ball, of true size by its rim, then misses the plane."""
    height, radius, normal = 0.5, 0.04, np.array([0.0, -0.8, -0.6])
    centre = normal * (radius - height) + np.array([0, 0.6, -0.8]) * 0.1  # stands on the real plane
    fit = SimpleNamespace(centre=centre, radius_px=200.0, blur_px=0.5, visible=1.0, covariance=np.eye(3) * 1e-10)
    ball = Found(fit, fit, Height(normal, stated * height, 1e-4), centre)  # type: ignore[arg-type]
    said = [text for text in complaints("ball_a", ball, radius) if "off the plane" in text]
    assert bool(said) == (stated != 1.0)
    assert all(f"measures {1 / stated:.1%} +- 0.0% of its stated size" in text for text in said)


def test_metadata_of_files_are_asked(tmp_path):
    """Through ingest: EXIF of JPEG files; one without says nothing and is let pass."""
    from PIL import Image

    for number, mm in enumerate((24.0, 24.0, 35.0, None)):
        exif = Image.Exif()
        if mm is not None:
            exif.get_ifd(0x8769)[0x920A] = mm  # FocalLength
        Image.new("L", (64, 48), 128).save(tmp_path / f"{number}.jpg", exif=exif)
    facts = SimpleNamespace(camera=SimpleNamespace(calibration=["*.jpg"]), ball=[])
    problems: list[str] = []
    flaws: list[str] = []
    photos, frames = ingest._board_photos(facts, tmp_path, tmp_path / "capture.toml", problems, flaws)  # type: ignore[arg-type]
    assert len(photos) == 4
    assert not problems
    assert flaws == ["2.jpg: focal length 35 mm, the other board photographs 24 mm; needed one; take it out"]
    plate = SimpleNamespace(role="plate", frames=[frame("p.dng", focal_mm=35.0)])
    flaws.clear()
    check_zoom({"plate": plate}, {"plate": frames["plate"][:2]}, flaws, [])  # type: ignore[dict-item]
    assert flaws[0].startswith("plate: taken at 35 mm, its board photographs at 24 mm; needed one focal length")


@pytest.mark.parametrize("stated", [1.0, 1.004, 0.97, 1.05])
def test_markers_that_contradict_each_other(stated):
    """One of two markers stated ``stated`` times its size: told to half a per cent from ten views at 0.08 px."""
    rng = np.random.default_rng(3)
    made = noisy(world(rng), rng, 0.0)
    corners = [replace(c, points=c.points * stated) if c.marker == 1 else c for c in made.corners]
    done = adjust(replace(made, corners=corners))
    marks = [{"id": 7, "side_m": 0.06}, {"id": 23, "side_m": 0.06 * stated}]
    said = board_doubts.sizes_in_views(done.bundle, [0, 1], marks)
    if abs(stated - 1) < 0.01:
        assert said == []
    else:
        off = float(said[0].split("other by ")[1].split("%")[0]) / 100
        assert off == pytest.approx(abs(np.expm1(abs(np.log(stated)))), abs=5e-3)
        assert "markers 7 and 23" in said[0] or "markers 23 and 7" in said[0]
