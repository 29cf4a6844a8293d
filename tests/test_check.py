"""insitu check: every judgement by itself, then one thing broken at a time in the desk: it must bring just its line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from command import tiny
from small_photos import NOISE, photo, place

from pipeline.camera.board_families import Layout, Markers, charuco_centres
from pipeline.capture import checks
from pipeline.capture.measures import (
    Drift,
    Lamps,
    board_tilt,
    calibration_spread,
    darkest_snr,
    lamps_of,
    sub_pixel_shift,
)
from pipeline.capture.roles import Shot
from pipeline.run.cli import main
from stages.check import Checked, bracket, judge

FRAME = photo(place(1), 1 / 250, "f").frame
NEUTRAL = {"as_shot_neutral": np.array([0.5, 1, 0.7])}


def frames(*seconds: float, **facts: object) -> list:
    return [FRAME.model_copy(update={"exposure_s": t, **facts}) for t in seconds]


FOCAL_20, FOCAL_35 = (frames(1, focal_mm=focal)[0] for focal in (20.0, 35.0))


class TestMeasures:
    @pytest.mark.parametrize("stops", [0.5, 1.0, 2.0, 4.0])
    def test_a_round_lamp_is_over_by_what_its_areas_say(self, stops):
        """Areas of a Gaussian spot are exact but for the pixel grid: 5 % at these sizes."""
        rows, columns = np.mgrid[:400, :400] + 0.5
        spot = 2.0**stops * np.exp(-((rows - 200) ** 2 + (columns - 190) ** 2) / (2 * 40**2))
        lamps = lamps_of(np.minimum(spot, 1.0), 0.99999, np.ones(spot.shape, bool), 2)
        assert lamps.stops == pytest.approx(stops, rel=0.05)
        wide = 4 * 40 * np.sqrt(2 * np.log(2) * stops)  # px: two per cell
        assert lamps.width_px == pytest.approx(wide, rel=0.02)

    def test_a_sharp_lamp_and_a_hot_pixel(self):
        top = np.full((50, 50), 0.01)
        top[10, 10] = 1.0
        assert lamps_of(top, 0.98, np.ones(top.shape, bool), 2) == Lamps(0.0, 0.0, 0.0)
        top[20:24, 20:24] = 1.0
        assert lamps_of(top, 0.98, np.ones(top.shape, bool), 2).stops == 8.0

    def test_stops_to_the_wanted_signal_over_noise(self):
        one = photo(1e-4 * np.ones((60, 80, 3)), 1.0, "dark")
        snr, stops = darkest_snr(one, np.ones((60, 80), bool))
        shot, floor = NOISE
        signal = float(np.percentile(one.rgb.mean(-1), 2)) * 2**stops
        assert snr < 5
        assert signal / np.sqrt(shot * signal + floor) == pytest.approx(5.0, rel=1e-4)

    @pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.2), (1.5, 0.8)])
    def test_shift_to_a_twentieth_of_a_pixel(self, shift):
        from scipy.ndimage import shift as moved

        one = np.log(place(1)[..., 1])
        other = moved(one, shift[::-1], order=3, mode="nearest")
        noise = 0.01 * np.random.default_rng(1).normal(size=(2, *one.shape))
        found = sub_pixel_shift(one + noise[0], other + noise[1], np.ones(one.shape, bool))
        assert found == pytest.approx(shift, abs=0.05)

    @pytest.mark.parametrize("tilt", [0.0, 20.0, 45.0])
    def test_tilt_of_a_board(self, tilt):
        markers = board_at(tilt)
        assert board_tilt(markers, LAYOUT) == pytest.approx(tilt, abs=0.5)

    def test_spread_of_board_photographs(self):
        shots = [board_shot(board_at(t, turn)) for t, turn in ((10, 0), (40, 0), (40, 90), (35, 200), (30, 130))]
        tilts, span, camera = calibration_spread(shots, LAYOUT)
        assert tilts == pytest.approx([10, 40, 40, 35, 30], abs=1.0)
        assert min(span) > 0.3
        assert camera is not None


LAYOUT = Layout("charuco", "DICT_5X5_100", (7, 5), False, 0.7, 0.0, 1, tuple(range(17)))


def board_at(tilt_deg: float, turn_deg: float = 30.0) -> Markers:
    """Markers of the board seen by the lens that is assumed (1.1 of the width), its middle on the axis."""
    centres = charuco_centres(7, 5, False)
    quads = centres[:, None] + 0.35 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) - (3.5, 2.5)
    tilt, turn = np.radians([tilt_deg, turn_deg])
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    points = np.concatenate([quads, np.zeros((*quads.shape[:2], 1))], -1) @ (lean @ spin).T + (0, 0, 12)
    px = 1.1 * 600 * points[..., :2] / points[..., 2:] + (300, 200)
    return Markers("DICT_5X5_1000", np.arange(len(centres)), px, (400, 600))


def board_shot(markers: Markers) -> Shot:
    empty = np.zeros((4, 6, 3), np.float32)
    return Shot([], [], empty, empty[..., 0] > 0, markers=markers, role="calibration")


JUDGED = [
    (checks.clipped_lights("a", Lamps(0.002, 12, 2.5), FRAME, True), "problem", "one more frame at 1/2000 s"),
    (checks.clipped_lights("a", Lamps(0.002, 12, 7.0), FRAME, True), "problem", "1/8000 s with a 2 EV neutral filter"),
    (checks.clipped_lights("a", Lamps(0.002, 12, 1.0), FRAME, False), "advice", "one more frame at 1/500 s"),
    (
        checks.clipped_lights("a", Lamps(0.01, 9, 8.0), frames(1 / 8000, fnumber=8.0)[0], True),
        "problem", "if it is the sun, 12 EV darker",
    ),
    (checks.clipped_lights("a", Lamps(0.01, 9, 8.0), FRAME, True), "problem", "1/1000 s, and so on by 2 EV until"),
    (checks.clipped_lights("a", Lamps(0.0, 0, 0), FRAME, True), "ok", ""),
    (checks.darkest("a", 2.0, 1.2, frames(1 / 4)[0]), "advice", "2 EV longer, 1 s"),
    (checks.darkest("a", 9.0, 0.0, FRAME), "ok", ""),
    (checks.ball_size("a", 50.0), "advice", "from 50% of the distance"),
    (checks.ball_size("a", 20.0), "problem", "5.0 times the focal length"),
    (checks.ball_size("a", 120.0), "ok", ""),
    (checks.ball_focus("a", 3.0), "advice", "focused on the ball's rim"),
    (checks.ball_focus("a", 6.0), "problem", "focused"),
    (checks.ball_focus("a", 0.8), "ok", ""),
    (checks.ball_framed("a", 0.9), "advice", "ball in frame"),
    (checks.ball_framed("a", 0.5), "problem", "ball in frame"),
    (checks.ball_framed("a", 1.0), "ok", ""),
    (checks.ball_found("a", False), "problem", "nearer"),
    (checks.second_ball("a", 1, 0), "advice", "90 degrees around"),
    (checks.second_ball("a", 2, 0), "advice", "90 degrees around"),
    (checks.second_ball("a", 2, 1), "ok", ""),
    (checks.board_seen("a", 2, 40), "problem", "whole board"),
    (checks.board_seen("a", 17, 12), "advice", "nearer"),
    (checks.board_seen("a", 17, 40), "ok", ""),
    (checks.board_tilted("a", 5, False), "advice", "20 degrees"),
    (checks.board_tilted("a", 5, True), "problem", "20 degrees"),
    (checks.board_tilted("a", 40, True), "ok", ""),
    (checks.bracketed("a", 1), "advice", "two more frames"),
    *[(one, "problem", "filling the frame") for one in checks.calibration("c", 2, [], (0, 0))],
    *[(one, "advice", "4 more of the board") for one in checks.calibration("c", 6, [10, 40], (0.9, 0.9))],
    *[(one, "problem", "tilted 30 to 45") for one in checks.calibration("c", 12, [4, 10], (0.9, 0.9))],
    *[(one, "advice", "in each corner") for one in checks.calibration("c", 12, [4, 40], (0.9, 0.4))],
    *[(one, "ok", "") for one in checks.calibration("c", 12, [4, 40], (0.9, 0.8))],
    *[(one, "advice", "at 1/25 s") for one in checks.ladder("a", frames(1 / 100, 4 / 25), [1, 16])],
    *[(one, "problem", "one more frame") for one in checks.ladder("a", frames(1 / 100, 1), [1, 100])],
    *[(one, "problem", "note the times") for one in checks.ladder("a", frames(0.0, 1), [0, 1])],
    *[(one, "ok", "") for one in checks.ladder("a", frames(0.1, 0.4, 1.6), [0.1, 0.4, 1.6])],
    *[(one, "advice", "manual mode") for one in checks.settings("a", [*frames(1), *frames(2, iso=200.0)])],
    *[(one, "advice", "manual mode") for one in checks.settings("a", [*frames(1), *frames(2, fnumber=4.0)])],
    *[(one, "problem", "manual") for one in checks.settings("a", [FOCAL_20, FOCAL_35])],
    *[(one, "advice", "as RAW") for one in checks.settings("a", frames(1, 2, encoding="display"))],
    *[
        (one, "advice", "white balance fixed")
        for one in checks.settings("a", [*frames(1, **NEUTRAL), *frames(2, as_shot_neutral=np.array([0.6, 1, 0.7]))])
    ],
    *[(one, "problem", "plate's camera") for one in checks.same_lens("a", FRAME, frames(1, width=99)[0], False, False)],
    *[(one, "problem", "plate's camera") for one in checks.same_lens("a", FOCAL_20, FOCAL_35, False, False)],
    *[(one, "advice", "grey card") for one in checks.same_lens("a", FRAME, frames(1, camera="B")[0], True, False)],
    *[(one, "problem", "tripod") for one in checks.drifted("a", Drift(0.0, 2.0, 1.0, True))],
    *[(one, "advice", "tripod") for one in checks.drifted("a", Drift(0.0, 0.5, 1.0, True))],
    *[(one, "advice", "light is steady") for one in checks.drifted("a", Drift(0.05, 0.0, 1.0, True))],
    *[(one, "ok", "") for one in checks.drifted("a", Drift(0.05, 0.0, 1.0, False))],
    *[(one, "advice", "focus fixed") for one in checks.drifted("a", Drift(0.0, 0.0, 0.4, True))],
    *[(one, "problem", "without the ball") for one in checks.present({"ball": 1})],
    *[(one, "problem", "mirror ball") for one in checks.present({"plate": 1})],
    *[(one, "problem", "printed board") for one in checks.no_board("a", False, False)],
]  # fmt: skip


def test_every_case_gave_one_finding():
    assert len(JUDGED) == 53


@pytest.mark.parametrize(("finding", "severity", "take"), JUDGED)
def test_each_judgement(finding, severity, take):
    assert finding.severity == severity
    assert take in finding.take
    assert bool(finding.take) == (severity != "ok")
    assert "\n" not in finding.line()
    assert finding.line().startswith(severity)


def test_nothing_is_said_twice_about_another_lens():
    assert checks.same_lens("a", FRAME, FRAME, False, False) == []
    assert len(checks.same_lens("a", FRAME, frames(1, camera="B")[0], False, False)) == 2
    assert checks.same_lens("a", FRAME, frames(1, camera="B")[0], True, True) == []
    assert checks.no_board("a", False, True) == []


@pytest.fixture(scope="module")
def desk(desk_proposal) -> Checked:
    plate = desk_proposal.of("plate")[0]
    return Checked(plate, desk_proposal.of("ball"), desk_proposal.of("calibration"), desk_proposal.layout)


def wanting(capture: Checked) -> set[tuple[str, str, str]]:
    return {(f.check, f.severity, f.where) for f in judge(capture) if f.severity != "ok"}


def without(shot: Shot, *left_out: int) -> Shot:
    kept = [photo for i, photo in enumerate(shot.photos) if i not in left_out]
    new = bracket(shot.name, shot.role, kept, tripod=shot.tripod)
    return replace(new, ball=shot.ball, markers=shot.markers)


def darker(shot: Shot, share: float) -> Shot:
    photos = [replace(p, rgb=share * p.rgb, top=share * p.top, limit=share * p.limit) for p in shot.photos]
    return replace(bracket(shot.name, shot.role, photos, tripod=shot.tripod), ball=shot.ball, markers=shot.markers)


def moved(shot: Shot, columns: int) -> Shot:
    photos = [replace(p, rgb=np.roll(p.rgb, columns, 1), top=np.roll(p.top, columns, 1)) for p in shot.photos]
    return replace(bracket(shot.name, shot.role, photos, tripod=shot.tripod), ball=shot.ball, markers=shot.markers)


def restated(shot: Shot, number: int, **facts: object) -> Shot:
    photos = [
        replace(p, frame=p.frame.model_copy(update=facts)) if i == number else p for i, p in enumerate(shot.photos)
    ]
    return replace(shot, photos=photos)


BROKEN = {
    "clipped_lights problem ball_a": lambda c: replace(c, balls=[without(c.balls[0], 0), c.balls[1]]),
    "ladder advice ball_b": lambda c: replace(c, balls=[c.balls[0], without(c.balls[1], 2)]),
    "second_ball advice ball": lambda c: replace(c, balls=c.balls[:1]),
    "bracketed advice plate": lambda c: replace(c, plate=without(c.plate, 1, 2)),
    "calibration_count advice camera": lambda c: replace(c, boards=c.boards[:8]),
    "calibration_tilt problem camera": lambda c: replace(c, boards=[min(c.boards, key=tilt_of)] * 10),
    "moved problem plate": lambda c: replace(c, plate=moved(c.plate, 1)),
    "light_changed advice ball_a": lambda c: replace(c, balls=[darker(c.balls[0], 0.8), c.balls[1]]),
    "mixed_fnumber advice plate": lambda c: replace(c, plate=restated(c.plate, 1, fnumber=8.2)),
    "no_plate problem plate": lambda c: replace(c, plate=None),
    "board_seen problem ball_b": lambda c: replace(c, balls=[c.balls[0], replace(c.balls[1], markers=None)]),
}


def tilt_of(shot: Shot) -> float:
    return board_tilt(shot.markers, LAYOUT) or 90.0


@pytest.mark.parametrize("line", BROKEN)
def test_what_is_broken_brings_its_line_and_no_other(desk, line):
    check, severity, where = line.split()
    where = "ball_a" if check == "moved" else where
    assert wanting(BROKEN[line](desk)) - wanting(desk) == {(check, severity, where)}


def test_desk_lacks_a_large_ball_alone(desk):
    assert wanting(desk) == {("ball_size", "advice", "ball_a"), ("ball_size", "advice", "ball_b")}
    sizes = [f.text for f in judge(desk) if f.check == "ball_size"]
    found = [float(text.split()[2]) for text in sizes]
    assert found == pytest.approx([85.4, 90.1], rel=0.06)  # outlines of the truth's ball; a rim at half size, no lens


def test_command_and_exit_codes(tmp_path, capsys):
    folder = tiny(tmp_path)
    (folder / "capture.toml").write_text((folder / "capture.toml").read_text().replace("0.08", '"TODO: by caliper"'))
    assert main(["check", str(folder), "--json"]) == 3
    found = {(row["check"], row["severity"]) for row in json.loads(capsys.readouterr().out)}
    assert {("no_board", "problem"), ("ball_found", "problem"), ("bracketed", "advice")} <= found
    (folder / "capture.toml").write_text('name = "x"\nnonsense = 1\n')
    assert main(["check", str(folder)]) == 2
