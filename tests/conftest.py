"""What several test files share: one draft build of the bundled capture, made once per session by the command."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import DESK, command


@pytest.fixture(scope="session")
def desk_build(tmp_path_factory) -> Path:
    """Build folder of ``insitu run sample_captures/desk --quality draft``; read it, never write into it."""
    out = tmp_path_factory.mktemp("desk") / "build"
    done = command("run", DESK, "--out", out, "--quality", "draft")
    assert done.returncode == 0, done.stderr
    (out.parent / "stdout").write_text(done.stdout)
    return out
