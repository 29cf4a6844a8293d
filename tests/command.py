"""Runs the ``insitu`` command as a user does, and writes captures for it."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np

from pipeline.run.cli import main
from pipeline.simulation.dng import DngFacts, dng_bytes

ROOT = Path(__file__).resolve().parents[1]
SAMPLES = ROOT / "sample_captures"
DESK = SAMPLES / "desk"
WIDTH, HEIGHT, FOCAL = 128, 96, 150.0

# A capture as small as can be: noise for a plate and a ball, camera and poses given.
TINY = f"""name = "tiny"
[plate]
files = ["plate.dng"]
[[ball]]
name = "ball_a"
files = ["ball.dng"]
[probe]
diameter_m = 0.08
[board]
squares = [7, 5]
square_m = 0.03
marker_m = 0.022
[camera.given]
width = {WIDTH}
height = {HEIGHT}
fx = {FOCAL}
fy = {FOCAL}
cx = {WIDTH / 2}
cy = {HEIGHT / 2}
"""
# Half a metre above the board's middle and as far in front of it, looking down by 45 degrees.
POSE = """[[pose]]
view = "{view}"
route = "given"
world_from_camera = [[1,0,0,0.1],[0,-0.70710678,-0.70710678,0.5],[0,0.70710678,-0.70710678,0.6],[0,0,0,1]]
"""
GIVEN = POSE.format(view="plate") + POSE.format(view="ball_a")


QUICK_CPU_S = 0.3  # mission: --help, --version and refused manifests


def manifest(name: str, plate: str, ball: str, more: str = "", ball_camera: str = "", **given: float) -> str:
    """A capture.toml of one plate and one ball, of a camera that is ``given``, and ``more`` tables."""
    camera = "".join(f"{key} = {value}\n" for key, value in given.items())
    own = f"camera = {ball_camera}\n" if ball_camera else ""
    return f"""
name = "{name}"
[plate]
files = ["{plate}"]
[[ball]]
name = "ball"
files = ["{ball}"]
{own}[probe]
diameter_m = 0.08
[camera.given]
{camera}{more}"""


def command(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    words = [sys.executable, "-m", "stages", *map(str, arguments)]
    env = {**os.environ, **environment}
    return subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, check=False)


def refused(capsys, code: int, *arguments: object) -> list[str]:
    """The lines of a refusal, the prefix taken off; the exit code must be ``code``."""
    capsys.readouterr()
    assert main(list(map(str, arguments))) == code
    lines = capsys.readouterr().err.splitlines()
    assert lines
    assert all(line.startswith("insitu: ") for line in lines)
    return [line.removeprefix("insitu: ") for line in lines]


def dng(path: Path, mosaic: np.ndarray | None = None, exposure: Fraction = Fraction(1, 60)) -> Path:
    """A DNG of noise, or of a mosaic (H, W) uint16."""
    if mosaic is None:
        mosaic = np.random.default_rng(len(path.name)).integers(600, 9000, (HEIGHT, WIDTH)).astype(np.uint16)
    matrix = np.array([[0.742, -0.205, -0.062], [-0.456, 1.248, 0.233], [-0.106, 0.215, 0.648]])
    facts = DngFacts(
        exposure=exposure, iso=100, fnumber=Fraction(8), focal_mm=Fraction(35), make="Maker", model="One", cfa="RGGB",
        timestamp="2026:01:02 03:04:05", black=(512, 512, 512, 512), white=15800, color_matrix=matrix,
        neutral=np.array([0.5, 1.0, 0.75]), noise=(2.5e-5, 6e-9),
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(dng_bytes(mosaic, facts))
    return path


def tiny(folder: Path, more: str = "", scene: str = "") -> Path:
    """Folder of the tiny capture with more text in its manifest."""
    dng(folder / "plate.dng")
    dng(folder / "ball.dng")
    (folder / "capture.toml").write_text(TINY + more)
    (folder / "scene.toml").write_text(scene)
    return folder


def desk_with(folder: Path, changes: dict[str, str]) -> Path:
    """A manifest in ``folder`` that takes the photographs of desk, with strings of it replaced."""
    text = (DESK / "capture.toml").read_text()
    wanted = {'name = "desk"': f'name = "desk"\nroot = "{DESK}"', "truth/truth.json": f"{DESK}/truth/truth.json"}
    for old, new in (wanted | changes).items():
        assert old in text, old
        text = text.replace(old, new)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "capture.toml").write_text(text)
    shutil.copy(DESK / "scene.toml", folder)
    return folder


def copied(build: Path, folder: Path) -> Path:
    """A copy of a build to run further; links are enough, since outputs are replaced and never written into."""
    shutil.copytree(build, folder, copy_function=os.link)
    (folder / "settings.json").unlink()
    return folder


def spent_by(words: list[str]) -> float:
    """User and system time of a command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(words, cwd=ROOT, capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def quick_limit() -> float:
    """The limit, or five imports of what reads manifests if longer: a refusal took 3.2 of them on a slow machine."""
    return max(
        QUICK_CPU_S, 5 * min(spent_by([sys.executable, "-c", "import argparse, pydantic.main"]) for _ in "12345")
    )


def cpu_seconds(arguments: list[str], limit: float) -> float:
    """User and system time of the command: the first of ten below the limit, else the least.

    Beside other work a process needs half as much again, its caches being shared: what it can do is the least, and what
    it does is told by the modules that it imports.
    """
    spent: list[float] = []
    while len(spent) < 10 and min(spent, default=limit) >= limit:
        spent.append(spent_by([sys.executable, "-m", "stages", *arguments]))
    return min(spent)
