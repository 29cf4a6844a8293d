"""The command: how fast it answers, and what it says about everything that can be wrong with its input."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command import (
    DESK,
    FOCAL,
    GIVEN,
    HEIGHT,
    POSE,
    ROOT,
    WIDTH,
    command,
    copied,
    cpu_seconds,
    desk_with,
    dng,
    quick_limit,
    refused,
    tiny,
)

from pipeline.run.board_facts import DICTIONARIES
from pipeline.run.cli import main, share_cores
from stages.order import NAMES

OBJECT = '[[object]]\nname = "cube"\nfile = "cube.obj"\nposition_m = [{x}, {z}]\n'
CUBE = "v 0 0 0\nv 0.02 0 0\nv 0 0.02 0\nv 0 0 0.02\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


@pytest.fixture
def wrong(tmp_path):
    """A manifest and a scene with a mistake of every kind."""
    text = (DESK / "capture.toml").read_text()
    text = text.replace("[probe]", "[probe]\ndiamter_m = 0.08").replace("diameter_m = 0.08\nr", "r")
    text = text.replace("squares = [7, 5]", "squares = [7, 5, 3]").replace('name = "ball_b"', 'name = "Ball B"')
    (tmp_path / "capture.toml").write_text(text)
    scene = 'quality = "best"\n[render]\nsmaples = 3\ndepth = 1\n[[object]]\nname = "a"\n'
    (tmp_path / "scene.toml").write_text(scene)
    return tmp_path


QUICK = (  # and how many modules: 119 and 250 are measured, a data class or an encoding more is none of our doing
    (["--help"], 150),
    (["--version"], 150),
    (["run", "{wrong}"], 300),
    (["run", str(DESK), "--set", "render.samples=0"], 300),
)


@pytest.mark.parametrize(("arguments", "modules"), QUICK, ids=["help", "version", "manifest", "set"])
def test_quick_answers_are_quick_and_leave_numpy_alone(arguments, modules, wrong):
    arguments = [word.format(wrong=wrong) for word in arguments]
    limit = quick_limit()
    assert cpu_seconds(arguments, limit) < limit
    words = [sys.executable, "-X", "importtime", "-m", "stages", *arguments]
    log = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False).stderr
    assert "pipeline.run.cli" in log
    assert "numpy" not in log
    assert log.count("import time:") < modules


def test_help_names_every_stage_and_the_exit_codes(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    for name in (*NAMES, "run", "simulate", "doctor", "verify"):
        assert re.search(rf"\n +{name}\s+\w", text), name
    assert "3 photographs" in " ".join(text.split())


def test_every_problem_of_the_texts_at_once(wrong, capsys):
    lines = refused(capsys, 2, "run", wrong, "--set", "render.samples=many", "--set", "redner.samples=3")
    found = "\n".join(lines)
    number = {
        key: next(i for i, line in enumerate(text.splitlines(), 1) if line.startswith(key))
        for text in [(wrong / "capture.toml").read_text(), (wrong / "scene.toml").read_text()]
        for key in ("diamter_m", "squares", "quality", "smaples", "depth")
        if f"\n{key}" in f"\n{text}"
    }
    for expected in (
        f"capture.toml:{number['diamter_m']}: probe.diamter_m: unknown key; did you mean diameter_m?",
        f"capture.toml:{number['squares']}: board.squares",
        "ball[1].name: is 'Ball B'",
        f"scene.toml:{number['quality']}: quality: is 'best'",
        f"scene.toml:{number['smaples']}: render.smaples: unknown key; did you mean samples?",
        f"scene.toml:{number['depth']}: render.depth: is 1",
        "object[0].file: missing",
        "--set: is 'redner.samples=3'",
    ):
        assert expected in found
    assert len(lines) == len(set(lines))


@pytest.mark.parametrize(
    ("switch", "says"),
    [
        (("--set", "render.samples=0"), "--set: render.samples: is 0; expected: greater than or equal to 1"),
        (("--set", "render.smaples=4"), "did you mean samples"),
        (("--set", "rendersamples"), "expected stage.knob=value"),
        (("--set", "composite.exposure_ev=NaN"), "composite.exposure_ev: is nan"),
        (("--upto", "rendr"), "--upto: is 'rendr'; expected one of ingest"),
        (("--set", "composite.view=Filmic"), "composite.view: is 'Filmic'; 'sRGB - Display'"),
        (("--set", "composite.display=CRT"), "composite.display: is 'CRT'"),
        (("--view", "Filmic"), "composite.view: is 'Filmic'; 'sRGB - Display'"),
        (("--display", "CRT"), "composite.display: is 'CRT'"),
        (("--look", "Grade"), "'ACES 1.3 Reference Gamut Compression'"),
        (("--scene", "nowhere.toml"), "nowhere.toml: no such file"),
    ],
)
def test_wrong_switch_is_one_line_before_anything_runs(switch, says, capsys, tmp_path):
    lines = refused(capsys, 2, "run", DESK, "--out", tmp_path / "out", *switch)
    assert len(lines) == 1
    assert says in lines[0]
    assert not (tmp_path / "out").exists()


def test_ocio_config_that_cannot_be_read(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("OCIO", str(tmp_path / "none.ocio"))
    assert "OCIO" in refused(capsys, 2, "run", DESK, "--out", tmp_path / "out")[0]


# A config of one display, two views and one look.
OCIO = """ocio_profile_version: 2
roles: {aces_interchange: aces, scene_linear: aces, default: aces}
displays: {Wall: [!<View> {name: Plain, colorspace: aces}, !<View> {name: Half, colorspace: half}]}
looks: [!<Look> {name: twice, process_space: aces, transform: !<CDLTransform> {slope: [2, 2, 2]}}]
colorspaces:
  - !<ColorSpace> {name: aces, encoding: scene-linear}
  - !<ColorSpace> {name: half, from_scene_reference: !<CDLTransform> {slope: [0.5, 0.5, 0.5]}}
"""


@pytest.fixture
def own_ocio(tmp_path, monkeypatch) -> Path:
    path = tmp_path / "own.ocio"
    path.write_text(OCIO)
    monkeypatch.setenv("OCIO", str(path))
    return path


@pytest.mark.parametrize(
    ("switches", "says"),
    [
        ((), "composite.display: is 'sRGB - Display'; {} has ['Wall']"),
        (("--display", "Wall"), "'Wall' of {} has ['Plain', 'Half']"),
        (("--display", "Wall", "--view", "Half", "--look", "thrice"), "composite.look: is 'thrice'; {} has ['twice']"),
    ],
)
def test_choices_are_those_of_the_config_in_force(switches, says, own_ocio, capsys, tmp_path):
    (line,) = refused(capsys, 2, "settings", DESK, "--out", tmp_path / "out", *switches)
    assert says.format(own_ocio) in line
    assert not (tmp_path / "out").exists()


def composite_knobs(out: Path) -> dict[str, object]:
    return json.loads((out / "settings.json").read_text())["params"]["composite"]


def test_switches_for_looking_are_settings(own_ocio, tmp_path):
    """They win over --set, and a stage takes them too; what is not given stays as it was asked last."""
    out = tmp_path / "out"
    switches = ["--display", "Wall", "--view", "Half", "--set", "composite.view=Plain", "--set", "composite.kind=ratio"]
    assert main(["settings", str(DESK), "--out", str(out), *switches]) == 0
    found = composite_knobs(out)
    assert (found["display"], found["view"], found["look"], found["kind"]) == ("Wall", "Half", "", "ratio")


def test_composite_takes_the_switches_for_looking(desk_build, tmp_path):
    """The picture changes, the linear result does not; the settings say so, for make and for the next command."""
    out = copied(desk_build, tmp_path / "out")
    shutil.copy(desk_build / "settings.json", out)
    assert main(["composite", str(DESK), "--out", str(out), "--view", "Un-tone-mapped"]) == 0
    before, found = composite_knobs(desk_build), composite_knobs(out)
    assert found == before | {"view": "Un-tone-mapped"}
    for name, same in (("display.png", False), ("composite.exr", True)):
        assert ((out / "composite" / name).read_bytes() == (desk_build / "composite" / name).read_bytes()) == same


@pytest.mark.parametrize("text", ["name = ", "\xff\xfe", ""])
def test_manifest_that_is_no_toml_or_empty(text, capsys, tmp_path):
    (tmp_path / "capture.toml").write_bytes(text.encode("latin1"))
    assert "capture.toml" in refused(capsys, 2, "run", tmp_path)[0]


def test_manifest_in_another_encoding_is_refused_by_its_line(capsys, tmp_path):
    (tmp_path / "capture.toml").write_bytes('name = "desk"\n# café\n'.encode("latin1"))
    (line,) = refused(capsys, 2, "run", tmp_path)
    assert line == f"{tmp_path}/capture.toml:2: not valid TOML: byte 0xe9 is no UTF-8; save it as UTF-8"


@pytest.fixture
def closed(monkeypatch):
    """Makes one file refuse to be opened, which the modes of a file do not do to the superuser."""

    def close(name: str) -> None:
        def refuse(path: Path, *args: object, **options: object) -> object:
            if path.name == name:
                raise PermissionError(errno.EACCES, "Permission denied", str(path))
            return open_path(path, *args, **options)

        open_path, access = Path.open, os.access
        monkeypatch.setattr(Path, "open", refuse)
        monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != name and access(path, mode))

    return close


@pytest.mark.parametrize(
    ("name", "code", "says"),
    [
        ("capture.toml", 2, "capture.toml: cannot be read (Permission denied)"),
        ("scene.toml", 2, "scene.toml: cannot be read (Permission denied)"),
        ("cube.obj", 2, "object[0].file: is 'cube.obj', which cannot be read"),
        ("plate.dng", 3, "plate.dng: cannot be read (Permission denied)"),
        ("truth.json", 4, "truth.json: Permission denied, needed to read or write it"),
    ],
)
def test_file_that_may_not_be_read(name, code, says, closed, capsys, tmp_path):
    folder = tiny(tmp_path, scene=OBJECT.format(x=0, z=0))
    (folder / "capture.toml").write_text('truth = "truth/truth.json"\n' + (folder / "capture.toml").read_text())
    (folder / "truth").mkdir()  # by itself: every file beside truth.json is part of the truth
    (folder / "truth" / "truth.json").write_text("{}")
    (folder / "cube.obj").write_text(CUBE)
    closed(name)
    lines = refused(capsys, code, "run", folder, "--upto", "ingest", "--out", tmp_path / "out")
    assert any(says in line for line in lines)


def test_folder_without_manifest(capsys, tmp_path):
    assert refused(capsys, 2, "run", tmp_path) == [f"{tmp_path}/capture.toml: no such file"]


def test_root_that_is_no_folder(capsys, tmp_path):
    text = (DESK / "capture.toml").read_text().replace('name = "desk"', 'name = "desk"\nroot = "$INSITU_NONE/x"')
    (tmp_path / "capture.toml").write_text(text)
    (line,) = refused(capsys, 2, "run", tmp_path)
    assert "root: is '$INSITU_NONE/x', which is no folder" in line


def test_every_missing_file_at_once(capsys, tmp_path):
    scene = OBJECT.format(x=0, z=0)
    folder = tiny(tmp_path, 'truth = "no.json"\n', scene)
    text = (folder / "capture.toml").read_text().replace('truth = "no.json"\n', "")
    text = 'truth = "no.json"\n' + text.replace('"ball.dng"', '"b*.dng", "c.dng"').replace("plate.dng", "p.dng")
    text = text.replace("[camera.given]", '[camera]\ncalibration = ["calib/*.jpg"]\n[camera.given]')
    (folder / "capture.toml").write_text(text)
    found = "\n".join(refused(capsys, 2, "run", folder, "--out", tmp_path / "out"))
    for name in ("cube.obj", "no.json", "c.dng", "p.dng", "calib/*.jpg"):
        assert f"{name}'; no such file" in found


NOT_RAW = {
    "text": b"hello",
    "empty": b"",
    "jpeg": b"\xff\xd8\xff\xe0" + bytes(400),
    "tiff": b"II*\0" + bytes(400),
}


@pytest.mark.parametrize("content", NOT_RAW.values(), ids=NOT_RAW.keys())
def test_file_that_is_no_raw(content, capsys, tmp_path):
    folder = tiny(tmp_path)
    (folder / "plate.dng").write_bytes(content)
    lines = refused(capsys, 3, "run", folder, "--out", tmp_path / "out")
    assert any(line.startswith("plate.dng: ") for line in lines)


def test_truncated_raw(capsys, tmp_path):
    folder = tiny(tmp_path)
    data = (folder / "plate.dng").read_bytes()
    (folder / "plate.dng").write_bytes(data[: len(data) // 2])
    assert "plate.dng: " in refused(capsys, 3, "run", folder, "--out", tmp_path / "out")[0]


def test_raw_that_decodes_to_zeros(capsys, tmp_path):
    folder = tiny(tmp_path)
    dng(folder / "ball.dng", np.zeros((HEIGHT, WIDTH), np.uint16))
    (line,) = refused(capsys, 3, "run", folder, "--out", tmp_path / "out")
    assert line.startswith("ball.dng: every pixel is 0")


def test_frames_of_other_sizes(capsys, tmp_path):
    folder = tiny(tmp_path)
    dng(folder / "ball.dng", np.full((HEIGHT, WIDTH - 32), 700, np.uint16))
    (line,) = refused(capsys, 3, "run", folder, "--out", tmp_path / "out")
    assert "96 x 96 RGGB, the plate's 128 x 96 RGGB" in line


def test_board_not_seen(capsys, tmp_path):
    (line,) = refused(capsys, 3, "run", tiny(tmp_path), "--out", tmp_path / "out")
    assert line.startswith("plate: 0 corners of the board found")


def test_board_of_another_kind_than_photographed(capsys, tmp_path):
    folder = desk_with(tmp_path / "d", {'dictionary = "DICT_5X5_100"': 'dictionary = "DICT_4X4_50"'})
    (line,) = refused(capsys, 3, "run", folder, "--upto", "calibrate", "--out", tmp_path / "out")
    assert "photographs show the board" in line


def test_unknown_dictionary(capsys, tmp_path):
    folder = desk_with(tmp_path / "d", {"DICT_5X5_100": "DICT_5X5_10"})
    (line,) = refused(capsys, 2, "settings", folder, "--out", tmp_path / "out")
    assert re.search(r"capture.toml:\d+: board.dictionary: is 'DICT_5X5_10'; did you mean DICT_5X5_100", line)
    small = tiny(tmp_path / "t", '[[marker]]\ndictionary = "DICT_5x5_100"\nid = 3\nside_m = 0.1\n')
    (line,) = refused(capsys, 2, "settings", small, "--out", tmp_path / "out")
    assert line.endswith("marker[0].dictionary: is 'DICT_5x5_100'; did you mean DICT_5X5_100?")
    cv2 = pytest.importorskip("cv2")
    assert sorted(DICTIONARIES) == sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


def test_wishes_that_are_meant_otherwise(capsys, tmp_path):
    objects = '[[object]]\nname = "a"\nfile = "a.ply"\nposition_m = [0.1, 0.2, 0.3]\nheight_m = 0.1\n'
    lines = refused(capsys, 2, "settings", tiny(tmp_path, GIVEN, objects), "--out", tmp_path / "out")
    assert sorted(line.removeprefix(f"{tmp_path}/") for line in lines) == [
        "scene.toml:4: object[0].position_m: is [0.1, 0.2, 0.3]; expected two numbers, x and z on the plane; the "
        "height above it is lift_m",
        "scene.toml:5: object[0].height_m: unknown key; did you mean lift_m?",
    ]
    twice = 2 * '[[object]]\nname = "a"\nfile = "a.ply"\nposition_m = [0.1, 0.2]\n'
    (line,) = refused(capsys, 2, "settings", tiny(tmp_path, GIVEN, twice), "--out", tmp_path / "out")
    assert line == f"{tmp_path}/scene.toml: object names are ['a', 'a']; each must be unique"


def test_a_build_folder_that_changes_hands_says_so(capsys, tmp_path):
    for name in ("one", "two"):
        assert main(["settings", str(tiny(tmp_path / name, GIVEN)), "--out", str(tmp_path / "out")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    ours, theirs = ((tmp_path / name / "capture.toml").resolve() for name in ("one", "two"))
    assert line == f"insitu: {tmp_path / 'out'}: was a build of {ours}, becomes one of {theirs}"


def test_help_of_a_stage_lists_its_knobs(capsys):
    with pytest.raises(SystemExit):
        main(["render", "--help"])
    assert re.search(r"\n  render\.samples \(\d+\): \w", capsys.readouterr().out)


def test_no_ball_in_its_photograph(desk_build, capsys, tmp_path):
    folder = desk_with(tmp_path / "d", {"ball_a/*.dng": "plate/*.dng"})
    out = copied(desk_build, tmp_path / "out")
    (line,) = refused(capsys, 3, "run", folder, "--upto", "probe", "--out", out, "--quality", "draft")
    assert line.startswith("ball_a: no mirror ball")


def test_ambiguous_pose(capsys, tmp_path):
    """The corners of a 20 cm square from 2 m, tilted by 20 degrees, clicked to whole pixels: two tilts fit."""
    tilt = np.radians(20)
    eye, down = 2 * np.array([0, np.cos(tilt), np.sin(tilt)]), np.array([0, -np.sin(tilt), np.cos(tilt)])
    points = ""
    for x, z in ((-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)):
        offset = np.array([x, 0, z]) - eye
        px = np.array([WIDTH, HEIGHT]) / 2 + np.round(np.array([x, offset @ down]) / (offset @ -eye / 2) * FOCAL)
        points += f"[[pose.points]]\nworld_m = [{x}, 0.0, {z}]\npx = {px.tolist()}\n"
    folder = tiny(tmp_path, f'[[pose]]\nview = "plate"\nroute = "points"\n{points}')
    (line,) = refused(capsys, 6, "run", folder, "--upto", "pose", "--out", tmp_path / "out")
    assert "two poses explain" in line
    assert line.count("camera at") == 2


def test_object_behind_the_camera(capsys, tmp_path):
    folder = tiny(tmp_path, GIVEN, OBJECT.format(x=0.1, z=5.0))
    (folder / "cube.obj").write_text(CUBE)
    (line,) = refused(capsys, 2, "run", folder, "--upto", "plane", "--out", tmp_path / "out")
    assert line.startswith("object cube: position_m is (0.1, 5) m, which is behind the plate camera")


def glb(document: dict) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


BAD_OBJECTS = {
    "draco.glb": (glb({"extensionsRequired": ["KHR_draco_mesh_compression"]}), "KHR_draco_mesh_compression"),
    "text.glb": (b"hello, this is no model at all", "expected a binary glTF"),
    "cut.glb": (glb({"asset": {"version": "2.0"}})[:40], "damaged"),
    "text.ply": (b"hello", "expected a PLY"),
    "model.fbx": (b"hello", "expected a .glb, .obj or .ply"),
}


@pytest.mark.parametrize("name", BAD_OBJECTS)
def test_object_file_that_cannot_be_read_is_refused_first(name, capsys, tmp_path):
    content, says = BAD_OBJECTS[name]
    folder = tiny(tmp_path, GIVEN, OBJECT.format(x=0, z=0).replace("cube.obj", name))
    (folder / name).write_bytes(content)
    (line,) = refused(capsys, 2, "run", folder, "--out", tmp_path / "out")
    assert "object[0].file" in line
    assert says in line


@pytest.mark.parametrize("content", [b"", b"hello\n", b"v 0 0 0\n", b"\x00\xff\x00\xff"])
def test_object_file_without_triangles(content, desk_build, capsys, tmp_path):
    (tmp_path / "cube.obj").write_bytes(content)
    (tmp_path / "scene.toml").write_text(OBJECT.format(x=0.3, z=0.1))
    out = copied(desk_build, tmp_path / "out")
    asked = ("--scene", tmp_path / "scene.toml", "--quality", "draft", "--upto", "render", "--out", out)
    (line,) = refused(capsys, 2, "run", DESK, *asked)
    assert "cube.obj" in line


def test_pose_that_is_no_rotation(capsys, tmp_path):
    mirrored = GIVEN.replace("[[1,0,0,0.1]", "[[-1,0,0,0.1]", 1)
    (line,) = refused(capsys, 2, "run", tiny(tmp_path, mirrored), "--upto", "pose", "--out", tmp_path / "out")
    assert "off a rigid motion" in line


@pytest.mark.parametrize(("more", "says"), [(POSE.format(view="ball_z"), "ball_z"), (GIVEN + GIVEN, "several")])
def test_pose_of_an_unknown_view_or_twice(more, says, capsys, tmp_path):
    (line,) = refused(capsys, 2, "run", tiny(tmp_path, more), "--out", tmp_path / "out")
    assert says in line


def test_stage_whose_inputs_are_missing(capsys, tmp_path):
    (line,) = refused(capsys, 4, "render", DESK, "--out", tmp_path / "out")
    assert "has not run; needed by render; run insitu" in line


def test_damaged_build_files(desk_build, capsys, tmp_path):
    out = copied(desk_build, tmp_path / "out")
    shutil.copy(desk_build / "settings.json", out)
    for name, stage in (("lights/lighting.exr", "reflectance"), ("calibrate/camera.json", "plane")):
        size = (out / name).stat().st_size
        (out / name).unlink()  # a link: the original stays
        (out / name).write_bytes(b"{" * min(size, 1000))
        (out / stage / "record.json").unlink()
        (line,) = refused(capsys, 4, stage, DESK, "--out", out)
        assert name in line
    assert main(["verify", str(DESK), "--out", str(out)]) == 4
    text = capsys.readouterr().out
    assert "lighting.exr: differs from what lights wrote" in text
    assert "camera.json: differs from what calibrate wrote" in text


def test_damaged_settings(capsys, tmp_path):
    (tmp_path / "settings.json").write_text("{}")
    assert "damaged" in refused(capsys, 4, "merge", DESK, "--out", tmp_path)[0]


def test_build_of_another_capture(desk_build, capsys, tmp_path):
    (line,) = refused(capsys, 2, "merge", tiny(tmp_path), "--out", desk_build)
    assert "is a build of" in line


def test_renderer_that_does_not_load(desk_build, tmp_path):
    out = copied(desk_build, tmp_path / "out")
    shutil.copy(desk_build / "settings.json", out)
    (out / "render/record.json").unlink()
    done = command("render", DESK, "--out", out, INSITU_VARIANT="no_such_variant")
    assert done.returncode == 5
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("insitu: mitsuba: no variant loads; no_such_variant")


def test_doctor_says_what_renders():
    done = command("doctor")
    assert done.returncode == 0, done.stdout
    for word in ("numpy", "renderer", "cores", "memory", "GPU"):
        assert word in done.stdout


def test_verify_and_summary(desk_build, capsys):
    assert main(["verify", str(DESK), "--out", str(desk_build)]) == 0
    assert "every file is as its stage wrote it" in capsys.readouterr().out
    assert main(["summary", str(DESK), "--out", str(desk_build)]) == 0
    text = capsys.readouterr().out
    assert "doing nothing" in text
    assert re.search(r"\nobject, relative \(rms\) +0\.\d{4} +0\.\d{4}\n", text)
    assert all(f"\n{name} " in text for name in NAMES)


def test_run_says_which_renderer_was_chosen(desk_build):
    assert re.search(
        r"\nrender +ran +[\d.]+ s  (cuda_ad|llvm_ad|scalar)_rgb\n", (desk_build.parent / "stdout").read_text()
    )


def test_nothing_is_written_into_the_capture(desk_build):
    """After the whole run of the session's build."""
    assert desk_build.exists()
    listing = {path.name for path in DESK.iterdir()}
    assert not listing & {"build", "settings.json", *NAMES}
    assert os.access(desk_build / "report/report.html", os.R_OK)


def test_evaluate_takes_the_capture_either_way():
    refused = command("evaluate")
    assert refused.returncode == 2
    assert "--capture" in refused.stderr


def test_a_command_gives_openblas_one_thread_unless_told_otherwise(monkeypatch) -> None:
    """Before numpy is there to read it: parsing the command line imports none."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    share_cores()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2"
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    share_cores()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    words = "import sys; from pipeline.run import cli; cli.build_parser(); sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", words], check=False).returncode == 0
