"""Cameras placed by other programs: .chan and USD, there and back."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.camera.rigid import nearest_rotation
from pipeline.camera.stated import FLIP, chan_matrix, read_pose, rigid
from pipeline.run.camera_facts import PoseFacts
from pipeline.run.errors import ManifestError
from stages import ingest


def some_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = nearest_rotation(rng.normal(size=(3, 3)))
    pose[:3, 3] = rng.normal(size=3)
    return pose


def test_a_level_camera_looks_where_conventions_say() -> None:
    """All angles 0: along -Z, y up. 90 degrees about Y: along -X, as seen from above counter-clockwise."""
    level = chan_matrix(np.array([1.0, 2, 3]), np.zeros(3), "zxy")
    np.testing.assert_allclose(level[:3, 2], [0, 0, -1])
    np.testing.assert_allclose(level[:3, 1], [0, -1, 0])
    turned = chan_matrix(np.zeros(3), np.array([0, 90.0, 0]), "zxy")
    np.testing.assert_allclose(turned[:3, 2], [-1, 0, 0], atol=1e-15)


def chan_numbers(world_from_camera: np.ndarray, order: str = "zxy") -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) m and rotations (3,) deg about x, y, z of a pose, for a .chan line."""
    R = (world_from_camera @ FLIP)[:3, :3]
    first, second, third = ("xyz".index(axis) for axis in order)
    sign = 1.0 if (second - first) % 3 == 1 else -1.0  # Tait-Bryan: R = R_third R_second R_first
    angle = np.zeros(3)
    angle[second] = -sign * np.arcsin(np.clip(R[third, first], -1, 1))
    if abs(R[third, first]) < 1 - 1e-12:
        angle[first] = sign * np.arctan2(R[third, second], R[third, third])
        angle[third] = sign * np.arctan2(R[second, first], R[first, first])
    else:  # first and third turn about the same axis: only their sum is known
        angle[first] = -sign * np.arctan2(R[second, third], R[second, second])
    return world_from_camera[:3, 3].copy(), np.degrees(angle)


def test_the_named_axis_is_applied_first() -> None:
    """zxy: roll about the camera's own axis, then pitch, then heading: heading leaves the horizon level."""
    pose = chan_matrix(np.zeros(3), np.array([-30.0, 40, 0]), "zxy")
    assert pose[1, 0] == pytest.approx(0)  # its x axis is horizontal
    assert pose[1, 2] == pytest.approx(-0.5)  # it looks 30 degrees down
    other = chan_matrix(np.zeros(3), np.array([-30.0, 40, 0]), "yxz")
    assert abs(other[1, 0]) > 0.1


@pytest.mark.parametrize("order", ["".join(order) for order in permutations("xyz")])
def test_chan_there_and_back(order: str, tmp_path: Path) -> None:
    poses = [some_pose(seed) for seed in range(5)]
    upright = np.eye(4) @ FLIP
    lines = [f"{n} {' '.join(repr(float(v)) for v in np.concatenate(chan_numbers(p, order)))} 40" for n, p in
             enumerate([*poses, upright])]  # fmt: skip
    file = tmp_path / "camera.chan"
    file.write_text("# frame tx ty tz rx ry rz fov\n" + "\n".join(lines) + "\n")
    for number, pose in enumerate([*poses, upright]):
        np.testing.assert_allclose(read_pose(file, number, order, None, None), pose, atol=1e-12)
    locked = chan_matrix(np.zeros(3), np.array([90.0, 90.0, 90.0]), order)  # both outer axes are one
    np.testing.assert_allclose(chan_matrix(*chan_numbers(locked, order), order), locked, atol=1e-7)
    np.testing.assert_allclose(read_pose(file, 2, order, 0.01, None)[:3, 3], 0.01 * poses[2][:3, 3])


def test_chan_that_cannot_be_read(tmp_path: Path) -> None:
    file = tmp_path / "camera.chan"
    for text, message in (
        ("1 0 0 0 0 0 0\n", r"no frame 7 \(frames: 1 to 1\)"),
        ("7 0 0 0\n", r"camera.chan:1: has 4 numbers"),
        ("\n7 a b c d e f\n", r"camera.chan:2: is '7 a b c d e f'"),
    ):
        file.write_text(text)
        with pytest.raises(ManifestError, match=message):
            read_pose(file, 7, "zxy", None, None)


@pytest.mark.parametrize(("up", "unit"), [("Y", 1.0), ("Z", 0.01)])
def test_usd_there_and_back(up: str, unit: float, tmp_path: Path) -> None:
    """A camera under a moved and scaled rig, animated, in a stage of either up axis."""
    usd, geom, gf = (pytest.importorskip("pxr").__dict__.get(n) or pytest.importorskip(f"pxr.{n}")
                     for n in ("Usd", "UsdGeom", "Gf"))  # fmt: skip
    stage = usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    geom.SetStageUpAxis(stage, up)
    geom.SetStageMetersPerUnit(stage, unit)
    rig = geom.Xform.Define(stage, "/rig")
    outer = np.diag([2.0, 2, 2, 1])
    outer[:3, 3] = (10, 20, 30)
    rig.AddTransformOp().Set(gf.Matrix4d(outer.T.tolist()))
    camera = geom.Camera.Define(stage, "/rig/cam")
    move = camera.AddTransformOp()
    pose = some_pose(3)
    theirs = pose @ FLIP
    theirs[:3, 3] /= unit
    if up == "Z":
        theirs = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]) @ theirs  # y up to z up
    inner = np.linalg.inv(outer) @ theirs
    inner[:3, :3] *= 2
    move.Set(gf.Matrix4d(np.eye(4).tolist()), 1)
    move.Set(gf.Matrix4d(inner.T.tolist()), 2)
    stage.GetRootLayer().Save()
    np.testing.assert_allclose(read_pose(tmp_path / "shot.usda", 2, "zxy", None, None), pose, atol=1e-9)
    geom.Camera.Define(stage, "/second")
    stage.GetRootLayer().Save()
    with pytest.raises(ManifestError, match=r"cameras are .*expected one, or its path as prim"):
        read_pose(tmp_path / "shot.usda", 2, "zxy", None, None)
    assert np.isfinite(read_pose(tmp_path / "shot.usda", 2, "zxy", None, "/rig/cam")).all()


def test_stated_pose_is_rigid_and_stated_once() -> None:
    with pytest.raises(ManifestError, match="off a rigid motion"):
        rigid(np.diag([1.0, 1, -1, 1]), "pose: view plate")
    with pytest.raises(ValidationError, match="both place the camera"):
        PoseFacts(view="plate", route="given", file="a.chan", world_from_camera=np.eye(4).tolist())
    with pytest.raises(ValidationError, match=r"expected one of .chan"):
        PoseFacts(view="plate", route="given", file="a.fbx")


def test_ingest_reads_the_file_beside_the_manifest(tmp_path: Path) -> None:
    position, degrees = chan_numbers(some_pose(1), "xyz")
    numbers = " ".join(repr(float(value)) for value in (*position, *degrees))
    (tmp_path / "camera.chan").write_text(f"7 {numbers}\n")
    table = {"view": "plate", "route": "given", "file": "camera.chan", "rotation_order": "xyz"}
    problems: list[str] = []
    for frame in (7, 8):
        facts = SimpleNamespace(pose=[PoseFacts.model_validate({**table, "frame": frame})])
        dumped = ingest._poses(facts, tmp_path, tmp_path / "capture.toml", problems)
        if frame == 7:
            np.testing.assert_allclose(dumped[0]["world_from_camera"], some_pose(1), atol=1e-12)
    assert len(problems) == 1
    assert "pose[0].file" in problems[0]
    assert "no frame 8" in problems[0]
