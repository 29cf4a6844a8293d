"""insitu init: brackets and roles from what photographs show, however they are named; nothing is ever overwritten."""

from __future__ import annotations

import os
import random
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import DESK, SAMPLES, dng, refused, tiny
from small_photos import photo, place, with_disc

from pipeline.camera.board_families import Markers, charuco_centres, layout_of, proposed_dictionary
from pipeline.capture.grouping import compare_all, group, repeats
from pipeline.capture.likeness import cells_of, compare, compare_moved
from pipeline.capture.photographs import binned, combined, files_of, read_all, reduced
from pipeline.capture.proposal import filled, text_of
from pipeline.capture.roles import propose
from pipeline.run.cli import main
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.run.manifest import CaptureFacts, load_capture
from pipeline.types import Frame
from stages.init import write_new

DATA = Path(os.environ.get("INSITU_DATA", Path(__file__).resolve().parents[1] / "../shared/data"))


def grouped(photos, shuffle: int | None = None) -> set[frozenset[str]]:
    if shuffle is not None:
        photos = random.Random(shuffle).sample(photos, len(photos))
    cells = [cells_of(one) for one in photos]
    left = repeats(photos)
    pairs = compare_all(photos, cells, [i for i in range(len(photos)) if i not in left])
    return {frozenset(photos[i].frame.file for i in members) for members in group(photos, pairs, left).groups}


class TestLikeness:
    @pytest.mark.parametrize("curve", [lambda x: x, lambda x: x**0.45, lambda x: np.tanh(2 * x)])
    def test_a_view_is_itself_through_any_tone_curve(self, curve):
        light = 0.1 * place(1)
        one, other = photo(light, 1.0, "a"), photo(light, 0.25, "b")
        like = compare(cells_of(one), cells_of(replace(other, rgb=curve(np.maximum(other.rgb, 0)))))
        assert like.same_view
        assert like.changed.mean() < 0.01

    def test_another_place_is_another_view(self):
        assert compare(cells_of(photo(place(1), 0.1, "a")), cells_of(photo(place(2), 0.1, "b"))).other_view

    def test_what_was_put_down_is_one_region_of_its_size(self):
        light, radius = place(1), 20.0
        like = compare(*(cells_of(photo(x, 0.1, "n")) for x in (light, with_disc(light, 150, 90, radius))))
        assert like.same_view
        disc = np.pi * radius**2 / (light.shape[1] / like.changed.shape[1]) ** 2
        assert 0.5 * disc < like.blob < 1.2 * disc  # where the two places are as bright by chance nothing changed

    def test_overexposed_frames_are_told_by_what_clips(self):
        light = place(1)
        like = compare(cells_of(photo(light, 0.1, "a")), cells_of(photo(light, 0.8, "b")))
        assert like.rough
        assert like.same_view
        assert not compare(cells_of(photo(place(2), 0.1, "a")), cells_of(photo(light, 0.8, "b"))).same_view

    def test_noise_alone_tells_nothing(self):
        dark = [photo(1e-4 * place(1), 0.1, name) for name in "ab"]
        assert not compare(*(cells_of(one) for one in dark)).other_view
        assert not compare(*(cells_of(one) for one in dark)).same_view

    def test_a_camera_in_the_hand(self):
        light = place(1, (200, 260))
        here, there = light[10:190, 10:250], light[14:194, 4:244]  # moved by (-6, +4)
        like = compare_moved(cells_of(photo(here, 0.1, "a")), cells_of(photo(there, 0.1, "b")))
        assert like.value > compare(cells_of(photo(here, 0.1, "a")), cells_of(photo(there, 0.1, "b"))).value
        assert like.shift == pytest.approx((4, -3), abs=1.5)  # in cells of two px, the other way


class TestGrouping:
    @pytest.mark.parametrize("shuffle", [1, 2])
    def test_plate_and_ball_of_one_tripod_are_two_brackets(self, shuffle):
        plate, ball = place(1), with_disc(place(1), 150, 90, 20)
        photos = [photo(plate, 0.03 * 4**i, f"p{i}") for i in range(3)]
        photos += [photo(ball, 0.006 * 4**i, f"b{i}") for i in range(4)]
        photos += [photo(place(3), 0.03 * 4**i, f"o{i}") for i in range(2)]
        assert grouped(photos, shuffle) == {
            frozenset({"p0", "p1", "p2"}), frozenset({"b0", "b1", "b2", "b3"}), frozenset({"o0", "o1"}),
        }  # fmt: skip

    def test_nothing_need_be_stated(self):
        photos = [photo(place(1), 0.03 * 4**i, f"p{i}") for i in range(3)]
        photos = [replace(p, frame=p.frame.model_copy(update={"exposure_s": 0.0, "camera": ""})) for p in photos]
        assert grouped(photos, 3) == {frozenset({"p0", "p1", "p2"})}

    def test_cameras_and_sizes_are_never_mixed(self):
        light = place(1)
        photos = [photo(light, 0.1, "a"), photo(light, 0.2, "b", camera="Maker Two"), photo(light[:-20], 0.05, "c")]
        assert len(grouped(photos)) == 3

    def test_a_black_frame_goes_where_its_time_puts_it(self):
        times = [f"2026:01:01 10:00:{second:02d}" for second in (0, 5, 10, 40, 45)]
        photos = [photo(place(1), 0.03 * 4**i, f"p{i}", timestamp=times[i]) for i in range(2)]
        photos += [photo(place(1), 1e-7, "black", timestamp=times[2])]
        photos += [photo(place(2), 0.03 * 4**i, f"q{i}", timestamp=times[3 + i]) for i in range(2)]
        assert frozenset({"p0", "p1", "black"}) in grouped(photos, 4)

    def test_repeated_files_count_once(self):
        photos = [photo(place(1), 0.1, name, sha256="one") for name in ("a.dng", "copy.dng")]
        photos += [photo(place(1), 0.1, "a.jpg", cfa="", encoding="display", black=np.zeros((1, 3)))]
        assert set(repeats(photos).values()) == {"the same file as a.dng", "the picture beside RAW a.dng"}


class TestBoards:
    @pytest.mark.parametrize(("squares", "legacy"), [((7, 5), False), ((8, 6), False), ((8, 6), True), ((5, 9), False)])
    def test_layout_is_told_by_the_places_of_the_markers(self, squares, legacy):
        centres = charuco_centres(*squares, legacy)
        quad = 0.35 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        flat = centres[:, None] + quad
        bend = np.array([[90, 12, 200], [-8, 80, 150], [0.004, 0.01, 1]])
        mapped = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1) @ bend.T
        seen = Markers("DICT_5X5_1000", np.arange(len(centres)), mapped[..., :2] / mapped[..., 2:], (900, 1200))
        layout = layout_of([seen])
        assert (layout.kind, layout.squares, layout.legacy) == ("charuco", squares, legacy)
        assert layout.marker_over_square == pytest.approx(0.7, abs=1e-6)
        assert layout.dictionary == "DICT_5X5_100"

    def test_opencv_puts_its_markers_there(self):
        cv2 = pytest.importorskip("cv2")
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        for squares, legacy in [((7, 5), False), ((8, 6), True), ((5, 8), False)]:
            board = cv2.aruco.CharucoBoard(squares, 1.0, 0.7, dictionary)
            board.setLegacyPattern(legacy)
            theirs = np.array([np.asarray(quad).mean(0)[:2] for quad in board.getObjPoints()])
            np.testing.assert_allclose(charuco_centres(*squares, legacy), theirs, atol=1e-6)

    def test_dictionaries_of_a_family(self):
        assert proposed_dictionary("DICT_4X4_1000", 16) == "DICT_4X4_100"
        assert proposed_dictionary("DICT_4X4_1000", 249) == "DICT_4X4_250"
        assert proposed_dictionary("DICT_APRILTAG_36h11", 3) == "DICT_APRILTAG_36h11"


def test_cells_of_every_layout_keep_the_light():
    frame = Frame(
        file="f",
        sha256="",
        exposure_s=1,
        iso=100,
        fnumber=1,
        width=4,
        height=4,
        cfa="GBRG",
        black=[[0, 1], [2, 3]],
        white=100,
    )
    mosaic = np.tile(np.array([[50, 20], [80, 40]], np.uint16), (2, 2))
    rgb, top = binned(mosaic, frame)
    np.testing.assert_allclose(rgb[0, 0], [78 / 98, (50 / 100 + 37 / 97) / 2, 19 / 99], rtol=1e-6)
    assert top[0, 0] == pytest.approx(78 / 98)
    means, tops, step = reduced(np.ones((100, 60, 3), np.float32), np.zeros((100, 60), np.float32), 30)
    assert means.shape == (25, 15, 3)
    assert (tops.shape, step) == ((25, 15), 8)


def test_light_is_that_of_unclipped_frames():
    light = place(1)
    frames = [photo(light, t, f"f{t}") for t in (0.02, 0.1, 0.5)]
    found, clipped = combined(frames, [frame.exposure for frame in frames])
    assert np.median(np.abs(found / light - 1)) < 0.01
    assert np.array_equal(clipped, frames[0].clipped)


class TestRoundTrip:
    def test_desk_comes_back_from_shuffled_names(self, desk_proposal, desk_shuffled, tmp_path):
        folder, names = desk_shuffled
        text = text_of(desk_proposal, "card", str(folder))
        facts = CaptureFacts.model_validate(filled(tomllib.loads(text)))
        wanted, _, _ = load_capture(DESK)

        def files(patterns: list[str], root: Path, back: dict[str, str] | None) -> set[str]:
            found = {file.relative_to(root).as_posix() for pattern in patterns for file in root.glob(pattern)}
            return {back[name] for name in found} if back else found

        assert files(facts.plate.files, folder, names) == files(wanted.plate.files, DESK, None)
        assert files(facts.camera.calibration, folder, names) == files(wanted.camera.calibration, DESK, None)
        for ball, known in zip(facts.ball, wanted.ball, strict=True):
            assert (ball.name, ball.tripod) == (known.name, known.tripod)
            assert files(ball.files, folder, names) == files(known.files, DESK, None)
        assert (facts.board.dictionary, facts.board.squares) == (wanted.board.dictionary, wanted.board.squares)
        assert not any(shot.unsure for shot in desk_proposal.shots)
        assert 0.70 < desk_proposal.layout.marker_over_square < 0.75  # truth 0.733; at half size cells are 2.6 px
        manifest = tmp_path / "capture.toml"
        write_new(manifest, text)
        asked = [line.split(" = ")[0] for line in text.splitlines() if '= "TODO' in line]
        assert asked == ["diameter_m", "square_m", "marker_m"]

    def test_ingest_names_what_is_to_be_filled_in(self, desk_proposal, desk_shuffled, tmp_path, capsys):
        folder, _ = desk_shuffled
        write_new(tmp_path / "capture.toml", text_of(desk_proposal, "card", str(folder)))
        lines = refused(capsys, 2, "ingest", tmp_path, "--out", tmp_path / "out")
        assert sorted(line.split(": ")[1].rpartition(".")[2] for line in lines) == [
            "diameter_m",
            "marker_m",
            "square_m",
        ]
        assert all("still to be filled in" in line for line in lines)


def test_a_manifest_is_never_overwritten(tmp_path):
    there = tmp_path / "capture.toml"
    write_new(there, "first")
    with pytest.raises(ManifestError, match="never overwritten"):
        write_new(there, "second")
    assert there.read_text() == "first"
    assert [file.name for file in tmp_path.iterdir()] == ["capture.toml"]


def test_the_command_refuses_in_one_line(tmp_path, capsys):
    assert "no such folder" in refused(capsys, 3, "init", tmp_path / "none")[0]
    assert "no photographs" in refused(capsys, 3, "init", tmp_path)[0]
    dng(tmp_path / "a.dng")
    (tmp_path / "there.toml").write_text("")
    assert "never overwritten" in refused(capsys, 2, "init", tmp_path, "-o", tmp_path / "there.toml")[0]
    (tmp_path / "a.dng").write_bytes(b"II*\0 no photograph")
    (line,) = refused(capsys, 3, "init", tmp_path)
    assert line.startswith("a.dng: ")


def test_a_folder_with_little_is_proposed_all_the_same():
    photos = [photo(place(1), 0.05, "a/only.dng")]
    text = text_of(propose(photos, {"b.dng": "b.dng: damaged"}), "two words", "..")
    facts = CaptureFacts.model_validate(filled(tomllib.loads(text)))
    assert facts.name == "two_words"
    assert facts.plate.files == ["a/*.dng"]
    assert "b.dng: not read" in text
    assert 'files = ["TODO' in text  # the ball


def test_a_plate_that_a_board_fills_is_told_by_the_ball_that_stood_there(tmp_path, capsys):
    """The board's markers span 11 % of the corner's plate, as on photographs of a board."""
    corner = SAMPLES / "corner"
    for name in ("plate", "ball_a"):
        shutil.copytree(corner / name, tmp_path / name)
    assert main(["init", str(tmp_path), "-o", str(tmp_path / "capture.toml")]) == 0
    text = (tmp_path / "capture.toml").read_text()
    assert f"{sum('TODO' in line for line in text.splitlines()[2:])} lines to fill in" in capsys.readouterr().out
    facts = CaptureFacts.model_validate(filled(tomllib.loads(text)))
    assert facts.plate.files == ["plate/*.dng"]
    assert [(ball.name, ball.tripod) for ball in facts.ball] == [("ball_a", True)]
    assert facts.camera.calibration == []


def test_files_still_to_be_named_are_said_so(tmp_path, capsys):
    folder = tiny(tmp_path)
    text = (folder / "capture.toml").read_text()
    (folder / "capture.toml").write_text(text.replace('["plate.dng"]', '["TODO: the bracket without the ball"]'))
    (line,) = refused(capsys, 2, "run", folder, "--upto", "ingest", "--out", tmp_path / "out")
    assert line.endswith("capture.toml: plate.files: still to be filled in: the bracket without the ball")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('fx = "TODO px"', "fx is 'TODO px'; expected pixels above 0"),
        ("fx = nan", "fx is nan; expected pixels above 0"),
        ("width = 128.5", "width is 128.5; expected whole pixels above 0"),
        ("distortion = [0.1, inf]", "distortion is [0.1, inf]; expected finite numbers"),
        ("distortion_model = [1.0]", "distortion_model is [1.0]; expected a name"),
    ],
)
def test_camera_numbers_that_are_none_are_refused_before_anything_runs(line, says, tmp_path, capsys):
    """As `init` leaves the lens where no board photographs tell it."""
    folder = tiny(tmp_path)
    text = (folder / "capture.toml").read_text()
    key = line.split(" ")[0]
    kept = [one for one in text.splitlines() if not one.startswith(f"{key} ")]
    kept.insert(kept.index("[camera.given]") + 1, line)
    (folder / "capture.toml").write_text("\n".join(kept))
    (found,) = refused(capsys, 2, "run", folder, "--out", tmp_path / "out")
    assert found.endswith(f"capture.toml:{kept.index('[camera.given]') + 1}: camera.given: {says}")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("line", ["yaw_deg = inf", "lift_m = nan", "scale = inf", "position_m = [nan, 0.1]"])
def test_wishes_that_are_no_finite_number_are_refused_before_anything_runs(line, tmp_path, capsys):
    kept = [one for one in ("position_m = [0.1, 0.1]",) if one.split()[0] != line.split()[0]]
    scene = "\n".join(["[[object]]", 'name = "cube"', 'file = "cube.obj"', line, *kept])
    folder = tiny(tmp_path, scene=scene)
    (found,) = refused(capsys, 2, "run", folder, "--out", tmp_path / "out")
    assert f"scene.toml:4: object[0].{line.split()[0]}" in found
    assert found.endswith("expected: a finite number")
    assert not (tmp_path / "out").exists()


def folder_groups(name: str) -> list[list[str]]:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    photos, _ = read_all(files_of(folder), folder)
    return sorted(sorted(g) for g in grouped(photos))


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("brackets_corridor", 23),
        ("brackets_desktop02", 17),
        ("brackets_frobisher", 3),
        ("brackets_memorial", 16),
        ("brackets_servers", 10),
    ],
)
def test_real_brackets_are_one_each(name, count):
    assert [len(members) for members in folder_groups(name)] == [count]


@pytest.mark.slow
def test_unsorted_frames_of_a_camera_in_the_hand():
    """Frame 4 repeats the exposure of 3 at another brightness (developed apart): it is not mixed in."""
    groups = folder_groups("brackets_misaligned_d800")
    assert [name for name in groups[0] if name in ("1.jpg", "2.jpg", "3.jpg")] == ["1.jpg", "2.jpg", "3.jpg"]
    assert not any({"3.jpg", "4.jpg"} <= set(members) for members in groups)


@pytest.mark.slow
def test_kitchen_table_comes_back():
    folder = DATA / "captures/kitchen_table"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    facts = CaptureFacts.model_validate(
        filled(tomllib.loads(text_of(propose(*read_all(files_of(folder), folder)), "kitchen", str(folder))))
    )
    assert facts.plate.files == ["plate/*.dng"]
    assert {(ball.name, *ball.files, ball.tripod) for ball in facts.ball} == {
        ("probe_a", "probe_a/*.dng", True), ("probe_b", "probe_b/*.dng", False),
    }  # fmt: skip
    assert facts.camera.calibration == ["calibration/*.jpg"]
    assert facts.views.files == ["views/*.jpg"]
    assert facts.board.squares == (7, 5)


@pytest.mark.parametrize("name", ["raw_broken"])
def test_damaged_files_are_named_one_by_one(name, capfd):
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    photos, flaws = read_all(files_of(folder), folder)
    assert not photos
    assert all("\n" not in flaw for flaw in flaws.values())
    with pytest.raises(CaptureError):
        files_of(folder / "nothing")
