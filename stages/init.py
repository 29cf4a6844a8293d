"""Propose capture.toml for a folder of photographs: brackets, roles, board; with the reasons.

All photographs are read and compared at half size or smaller. Frames of one view at several exposures are one bracket,
told by content first, then by exposure, camera, size and time (`pipeline.capture.grouping`); what each is for is
guessed from what it shows (`pipeline.capture.roles`). Nothing is moved; nothing is written unless a file is named.

Limits: what cannot be seen (the sizes of ball and board) is asked for, as a line that says TODO.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from pathlib import Path

from pipeline.capture.photographs import files_of, read_all
from pipeline.capture.proposal import TODO, ball_names, everything_of, filled, text_of
from pipeline.capture.roles import Proposal, propose
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.run.manifest import CaptureFacts


def init(folder: Path, out: Path | None, say: Callable[[str], None]) -> Proposal:
    """Say the proposed manifest, or write it to ``out``, a new file. Raises ManifestError, CaptureError."""
    if out is not None and out.exists():
        raise ManifestError(f"{out}: is there already and is never overwritten; name another file with -o")
    files = files_of(folder)
    photos, flaws = read_all(files, folder)
    if not photos:
        raise CaptureError("\n".join(flaws.values()))
    proposal = propose(photos, flaws)
    home = out.parent if out is not None else folder
    root = Path(os.path.relpath(folder.resolve(), home.resolve())).as_posix()
    text = text_of(proposal, folder.resolve().name, root)
    CaptureFacts.model_validate(filled(tomllib.loads(text)))  # what is proposed is valid but for what it asks for
    if out is None:
        say(text.rstrip("\n"))
        return proposal
    write_new(out, text)
    balls = proposal.of("ball")
    names = ["plate"] * len(proposal.of("plate")) + ball_names(balls, everything_of(proposal))
    for name, shot in zip(names, (*proposal.of("plate"), *balls), strict=True):
        say(f"{name:<8} {len(shot.photos)} frames: {'; '.join(shot.because)}" + (" (unsure)" if shot.unsure else ""))
    open_lines = sum(f'"{TODO}' in line for line in text.splitlines() if not line.startswith("#"))
    say(f"{out}: {open_lines} lines to fill in (TODO); then: insitu check {out}")
    return proposal


def write_new(path: Path, text: str) -> None:
    """Write a file whole or not at all, and only when there is none. Raises ManifestError."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_text(text)
        os.link(part, path)  # unlike a rename, never replaces what another process has just written
    except FileExistsError as error:
        raise ManifestError(f"{path}: is there already and is never overwritten; name another file with -o") from error
    except OSError as error:
        raise ManifestError(f"{path}: cannot be written ({error.strerror}); name another file with -o") from error
    finally:
        part.unlink(missing_ok=True)
