"""What several test files share: one draft build of the bundled capture, made once per session by the command."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest
from command import DESK, SAMPLES, command
from extreme_cases import pytest_addoption, pytest_collection_modifyitems, pytest_sessionfinish, saw  # noqa: F401

from pipeline.capture.photographs import files_of, read_all
from pipeline.capture.roles import Proposal, propose


def draft_of(name: str):
    """Fixture: build folder of ``insitu run sample_captures/<name> --quality draft``; read it, never write into it.

    What the command printed is beside it, in ``stdout``.
    """

    @pytest.fixture(scope="session")
    def build(tmp_path_factory) -> Path:
        out = tmp_path_factory.mktemp(name) / "build"
        done = command("run", SAMPLES / name, "--out", out, "--quality", "draft")
        assert done.returncode == 0, done.stderr
        (out.parent / "stdout").write_text(done.stdout)
        return out

    return build


desk_build = draft_of("desk")
counter_build = draft_of("counter")
courtyard_build = draft_of("courtyard")
lacquer_build = draft_of("lacquer")
cellar_build = draft_of("cellar")
corner_build = draft_of("corner")


@pytest.fixture(scope="session")
def desk_shuffled(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    """The photographs of desk in one folder under names that tell nothing; and the names they had."""
    folder = tmp_path_factory.mktemp("card")
    files = [file for file in sorted(DESK.rglob("*")) if file.suffix in (".dng", ".jpg")]
    order = random.Random(5).sample(range(len(files)), len(files))
    names = {f"IMG_{number:04d}{file.suffix}": file for number, file in zip(order, files)}
    for name, file in names.items():
        shutil.copyfile(file, folder / name)
    return folder, {name: file.relative_to(DESK).as_posix() for name, file in names.items()}


@pytest.fixture(scope="session")
def desk_proposal(desk_shuffled) -> Proposal:
    """What a folder of them is taken for; about 9 CPU seconds, once."""
    folder, _ = desk_shuffled
    return propose(*read_all(files_of(folder), folder))
