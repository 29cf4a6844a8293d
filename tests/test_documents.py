"""What documents name exists: commands and their switches, make targets, links, files, knobs."""

from __future__ import annotations

import argparse
import re
import subprocess
from pathlib import Path

import pytest

from pipeline.run.cli import build_parser
from stages.knobs import KNOBS
from stages.order import NAMES

ROOT = Path(__file__).resolve().parents[1]
LISTING = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
TRACKED = {line for line in LISTING.splitlines() if (ROOT / line).is_file()}
PAGES = {name: (ROOT / name).read_text() for name in sorted(TRACKED) if name.endswith(".md")}
pytestmark = pytest.mark.skipif(not PAGES, reason="not a git checkout")

FILE = re.compile(r"`([\w./-]+\.(?:py|toml|md|json))`")
KNOB = re.compile(rf"`(?:--set )?({'|'.join(KNOBS)})\.([a-z_]+)(?:=[^`]*)?`")
SUFFIXES = {"py", "md", "json", "toml", "exr", "png", "html"}


def commands(page: str, word: str) -> list[str]:
    """What follows ``word`` where it starts a line of a block or stands in backticks, one per use."""
    blocks = "".join(re.findall(r"^```\w*\n(.*?)^```", page, re.MULTILINE | re.DOTALL))
    codes = re.findall(r"`([^`\n]+)`", page) + blocks.splitlines()
    uses = (re.match(rf"(?:\.venv/bin/)?{word} (.*)", code.strip()) for code in codes)
    return [use[1].split("#")[0] for use in uses if use]


def test_commands_and_switches_exist():
    parsers = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    used = set()
    for name, page in PAGES.items():
        for line in commands(page, "insitu"):
            verb = line.split()[0].rstrip(",.`:")
            if not re.fullmatch(r"[a-z]+", verb):
                continue
            assert verb in parsers, f"{name}: insitu {line}"
            switches = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", line.split("`")[0]))
            known = {switch for action in parsers[verb]._actions for switch in action.option_strings}
            assert switches <= known, f"{name}: insitu {line}"
            used.add(verb)
    assert {"run", "trade", "evaluate", "simulate"} <= used  # the pattern finds what is there


def test_make_targets_exist():
    targets = {*re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE), *NAMES}
    used = set()
    for name, page in PAGES.items():
        for line in commands(page, "make"):
            words = line.split()
            named = words[: next((n for n, word in enumerate(words) if not re.fullmatch(r"[a-z-]+", word)), len(words))]
            assert set(named) <= targets, f"{name}: make {line}"
            used |= set(named)
    assert {"demo", "test", "trade", "bench-render"} <= used


@pytest.mark.parametrize("name", PAGES)
def test_links_and_files_exist(name):
    """A file is named from the root, from its page, or alone where only one folder has it; what runs write is told."""
    folder = (ROOT / name).parent
    for link in re.findall(r"\]\(([^)\s]+)\)", PAGES[name]):
        if not re.match(r"https?:|#", link):
            assert (folder / link.split("#")[0]).exists(), link
    for file in FILE.findall(PAGES[name]):
        if file.split("/")[0] in ("pipeline", "stages", "benchmarks", "tests", "docs", "sample_captures"):
            assert (ROOT / file).exists() or (folder / file).exists(), file
        elif file.endswith(".py"):
            assert any(path == file or path.endswith("/" + file) for path in TRACKED), file


@pytest.mark.parametrize("name", [name for name in PAGES if not name.endswith("numerics.md")])
def test_knobs_exist(name):
    """Ids of extremes, in the page left out, look alike."""
    fields = {stage: set(model.model_fields) for stage, model in KNOBS.items()}
    fields["probe"] |= {"nadir_deg", "glass_mm"}  # facts of [probe] in capture.toml
    for stage, knob in KNOB.findall(PAGES[name]):
        assert knob in fields[stage] | SUFFIXES, f"{stage}.{knob}"
