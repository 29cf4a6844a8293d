"""Which source orients the plate: the cheapest that leaves the foot certain enough, and what is said of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import SAMPLES, command
from printed_board import MARKER, looking_at, marker_print, photograph

from pipeline.camera.contact import contact_covariance
from pipeline.camera.lens import project
from pipeline.camera.rigid import camera_points
from pipeline.camera.sources import KnownLens, left_at
from pipeline.run import artifacts as A
from pipeline.run import formats
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Bracket, Camera, Frame, Raster, Reconstruction, Sources, View
from stages import calibrate, knobs, pose, sfm, sources

TRUTH = Camera(width=480, height=360, fx=640, fy=640, cx=240, cy=180)
GIVEN = {key: getattr(TRUTH, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
FOOT = np.array([0.09, 0.0, 0.06])
CHI2_2 = 13.8  # 99.9 % of chi-square with two degrees of freedom
FACTS = {"board": None, "marker": [MARKER], "ball": [], "pose": [], "capture_root": ".", "lens": None,
         "views": {"own_camera": False}, "camera": {"given": GIVEN}}  # fmt: skip


def frame(name: str, **known: Any) -> Frame:
    given = {"file": name, "sha256": "", "exposure_s": 1.0, "iso": 100.0, "fnumber": 8.0, "width": 480, "height": 360,
             "cfa": "", "black": np.zeros((1, 3)), "white": 255.0}  # fmt: skip
    return Frame(**{**given, **known})


# The focal length that EXIF rounds to: 640 px of a diagonal of 600 px, in 35 mm terms
EXIF = {"focal_35mm": 640 / 600 * float(np.hypot(36, 24))}


def raster(picture: np.ndarray) -> Raster:
    return Raster({channel: np.asarray(picture, np.float32) for channel in "RGB"}, "acescg")


def decided(photographs: dict[str, np.ndarray], foot: np.ndarray = FOOT, exif: dict | None = None, **changes: Any):
    """The stage on a capture with one further view; ``cloud`` and ``contact_px`` are knobs, the rest facts."""
    asked = {name: changes.pop(name) for name in ("cloud", "contact_px") if name in changes}
    wishes = {"object": [{"name": "cup", "position_m": [float(foot[0]), float(foot[2])]}]}
    brackets = {"plate": Bracket(name="plate", role="plate", frames=[frame("p.dng", **(exif or EXIF))])}
    rasters = {name: raster(picture) for name, picture in photographs.items()}
    return sources.compute(
        {**FACTS, **changes}, wishes, brackets, [], [frame("v.jpg")], rasters, knobs.Sources(**asked)
    )


@pytest.fixture(scope="module")
def plates() -> list[tuple[np.ndarray, np.ndarray]]:
    """Plates that show the marker, 130 to 190 px wide, and where each was taken from."""
    poses = [looking_at(np.zeros(3), 25 + 6 * n, 50 * n, 0.34 + 0.03 * n, 7 * n) for n in range(6)]
    rng = np.random.default_rng(4)
    shown = [photograph(marker_print(MARKER), TRUTH, at, 3) for at in poses]
    return [(one * (1 + 0.01 * rng.normal(size=one.shape)), at) for one, at in zip(shown, poses, strict=True)]


def test_a_marker_in_the_plate_is_enough_and_its_word_holds(plates) -> None:
    """Six plates: no cloud, and the foot lies where it truly is, within what was said before."""
    for picture, true in plates:
        result = decided({"plate": picture})
        assert result.outputs["sources"].cloud is False
        assert result.warnings == []
        rows = result.evidence[0]
        assert rows["modelled"] is False
        assert "marker and the lens stated leave" in rows["because"]
        photographs = {"plate": raster(picture)}
        empty = sfm.compute(FACTS, {}, [frame("v.jpg")], photographs, result.outputs["sources"], knobs.Sfm())
        cloud = empty.outputs["reconstruction"]
        assert cloud.names == []
        made = pose.compute(FACTS, photographs, TRUTH, {}, cloud, [], knobs.Pose()).outputs["views"]["plate"]
        assert made.route == "marker"
        spread = contact_covariance(TRUTH, made, FOOT)
        foreseen = result.numbers["contact_px"]["cup"]
        assert foreseen == pytest.approx(np.sqrt(np.linalg.eigvalsh(spread)[-1]), rel=1e-6)
        ends = [project(TRUTH, camera_points(at, FOOT[None])[0])[0] for at in (made.world_from_camera, true)]
        off = ends[0] - ends[1]
        assert off @ np.linalg.solve(spread, off) < CHI2_2
        assert np.linalg.norm(off) < foreseen * np.sqrt(CHI2_2)


def test_a_far_foot_asks_for_the_cloud(plates) -> None:
    """Ten marker sides away the marker's tilt is worth pixels: the cloud is to orient the plate; the budget rules."""
    far = np.array([-0.1, 0, -0.9])
    result = decided({"plate": plates[0][0]}, far)
    asked = result.outputs["sources"]
    assert asked.cloud
    assert asked.views == ["plate"]
    assert result.numbers["because"][0].startswith("plate: marker alone leaves cup uncertain by")
    enough = decided({"plate": plates[0][0]}, far, contact_px=1.01 * result.numbers["contact_px"]["cup"])
    assert enough.outputs["sources"].cloud is False


def test_a_lens_that_only_exif_tells_of(plates) -> None:
    """5 % of focal length: at the marker's middle the pose undoes it, a few sides away it does not."""
    words = {"camera": {"given": None}}
    middle = decided({"plate": plates[0][0]}, np.zeros(3), **words)
    assert middle.outputs["sources"].cloud is False
    assert middle.numbers["contact_px"]["cup"] > 1.2 * middle.numbers["contact_noise_px"]["cup"]
    away = decided({"plate": plates[2][0]}, np.array([0.2, 0, -0.2]), contact_px=1.0, **words)
    asked = away.outputs["sources"]
    assert asked.cloud
    assert asked.views == []
    assert away.numbers["because"][0].startswith("lens: as EXIF says it leaves cup uncertain by")
    silent = decided({"plate": plates[0][0]}, np.zeros(3), {"focal_35mm": 0.0}, **words)
    assert silent.numbers["because"] == ["lens: nothing is said of it"]


def test_what_shows_no_marker_is_oriented_by_the_cloud(plates) -> None:
    bare = np.full((360, 480), 0.3)
    assert decided({"plate": bare}).outputs["sources"].views == ["plate"]
    balls = [{"name": "tripod", "tripod": True}, {"name": "hand", "tripod": False}]
    pictures = {"plate": bare, "tripod": plates[1][0], "hand": bare}
    result = decided(pictures, ball=balls)
    assert result.outputs["sources"].views == ["hand"]  # the plate takes the tripod view's pose
    assert result.numbers["because"] == ["hand: it shows 0 corners of the marker, needed 4"]


def test_forced_both_ways(plates) -> None:
    shown = {"plate": plates[0][0]}
    always = decided(shown, cloud="always")
    assert always.outputs["sources"].cloud
    assert always.outputs["sources"].views == ["plate"]
    assert always.evidence[0]["because"].startswith("knob sources.cloud = always, although marker")
    never = decided({"plate": np.full((360, 480), 0.3)}, cloud="never")
    assert never.outputs["sources"].cloud is False
    assert never.warnings == ["sources: cloud = never, although plate: it shows 0 corners of the marker, needed 4"]
    asked = [{"view": "plate", "route": "colmap"}]
    assert decided(shown, pose=asked).numbers["because"] == ["plate: asked for by [[pose]]"]
    with pytest.raises(ManifestError, match=r"is never, but \[\[pose\]\] orients plate by route colmap"):
        decided(shown, pose=asked, cloud="never")


def test_a_stated_pose_undoes_nothing_of_the_lens() -> None:
    """Half a degree off the axis of a lens known to 5 %: 5 % of the way to the axis, and the axis's own error."""
    lens = TRUTH.model_copy(update={"covariance": np.diag([(0.05 * 640) ** 2] * 2 + [4.8**2] * 2 + [0.0] * 5)})
    stated = View(world_from_camera=looking_at(np.zeros(3), 0, 0, 1.0), covariance=np.zeros((6, 6)), route="given",
                  rms_px=0, points=0, lens_covariance=np.zeros((6, 9)))  # fmt: skip
    whole, noise = left_at(lens, stated, {"cup": np.array([0.1, 0, 0])})
    assert whole["cup"] == pytest.approx(np.hypot(0.05 * 64, 4.8))
    assert noise["cup"] == pytest.approx(0, abs=1e-9)
    numbers, short, of_lens = sources.judged(stated, KnownLens(lens, "as EXIF says", True), {"cup": np.zeros(3)}, 0.5)
    assert not short
    assert "4.80 px" in of_lens
    assert numbers["route"] == "given"


def test_without_a_cloud_the_lens_is_what_exif_says() -> None:
    facts = {**FACTS, "camera": {"given": None}}
    brackets = {"plate": Bracket(name="plate", role="plate", frames=[frame("p.dng", **EXIF)])}
    camera = calibrate.compute(facts, brackets, [], Reconstruction(), Sources(), knobs.Calibrate()).outputs["camera"]
    assert camera.source == "exif"


def test_a_cloud_that_no_marker_places_leaves_the_pose_to_the_plates_marker(plates) -> None:
    """Sources asked for the cloud, but one photograph of it shows the marker: said, and the marker orients."""
    picture, true = plates[3]
    cloud = Reconstruction(
        names=["plate"], world_from_camera=true[None], cameras=[TRUTH], camera_of=[0], orients=["plate"]
    )
    result = pose.compute(FACTS, {"plate": raster(picture)}, TRUTH, {}, cloud, [], knobs.Pose())
    assert result.outputs["views"]["plate"].route == "marker"
    assert result.warnings[0].startswith("pose: further views cannot orient plate (sfm: the first marker is seen in 1")


def test_neither_cloud_nor_marker_is_said_with_both_reasons() -> None:
    """The plate shows no mark, so the marker route ends too: what ended the cloud is said before it."""
    cloud = Reconstruction(
        names=["plate"], world_from_camera=looking_at(np.zeros(3), 30, 0, 0.4)[None], cameras=[TRUTH], camera_of=[0],
        orients=["plate"],
    )  # fmt: skip
    with pytest.raises(CaptureError) as error:
        pose.compute(FACTS, {"plate": raster(np.full((360, 480), 0.3))}, TRUTH, {}, cloud, [], knobs.Pose())
    said = str(error.value)
    assert said.startswith("pose: further views cannot orient plate (sfm: the first marker is seen in none of the 1")
    assert ", nor can boards and markers alone: plate: 0 corners of the marker found" in said
    assert "\n" not in said


SEEN = """
name = "seen"
root = "{root}"
[plate]
files = ["views/view_04.jpg"]
[[ball]]
name = "hand"
files = ["views/view_02.jpg"]
[[exposure]]
files = ["views/view_04.jpg", "views/view_02.jpg"]
exposure_s = 0.1
iso = 100
fnumber = 8
[probe]
kind = "mirror_ball"
diameter_m = 0.07
[[marker]]
dictionary = "DICT_5X5_100"
id = 7
side_m = 0.06
[[marker]]
dictionary = "DICT_5X5_100"
id = 23
side_m = 0.06
[views]
files = ["views/view_01.jpg", "views/view_03.jpg", "views/view_05.jpg", "views/view_06.jpg", "views/view_07.jpg"]
"""


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["stated", "of EXIF and the boards in view"])
def test_counter_seen_with_its_markers_needs_no_cloud(lens: str, tmp_path: Path) -> None:
    """The plate shows both markers, and there are five further views: COLMAP does not run, and the foot is right."""
    truth = json.loads((SAMPLES / "counter/truth/truth.json").read_text())
    true = Camera(**{key: truth["camera"][key] for key in (*GIVEN, "distortion")})
    stated = "".join(f"{key} = {getattr(true, key)}\n" for key in GIVEN) + f"distortion = {true.distortion.tolist()}\n"
    text = SEEN.format(root=SAMPLES / "counter") + (f"[camera.given]\n{stated}" if lens == "stated" else "")
    (tmp_path / "capture.toml").write_text(text)
    done = command("run", tmp_path, "--out", tmp_path / "build", "--upto", "pose")
    assert done.returncode == 0, done.stderr
    numbers = json.loads((tmp_path / "build/sources/record.json").read_text())["numbers"]
    assert (numbers["cloud"], numbers["lens"], numbers["route"]) == (False, lens, "marker")
    assert numbers["contact_px"]["marker"] < 0.5
    assert json.loads((tmp_path / "build/sfm/record.json").read_text())["numbers"] == {"photos": 0}
    view = formats.read(tmp_path / "build/pose", A.VIEWS)["plate"]
    camera = formats.read(tmp_path / "build/calibrate", A.CAMERA)
    at = np.array(truth["views"]["view_04"]["world_from_camera"])
    for foot in (np.zeros(3), np.array([0.165, 0, 0.02])):
        ends = [(camera, view.world_from_camera), (true, at)]
        off = np.subtract(*(project(one, camera_points(pose, foot[None])[0])[0] for one, pose in ends))
        assert np.linalg.norm(off) < 0.5
        assert off @ np.linalg.solve(contact_covariance(camera, view, foot), off) < CHI2_2
