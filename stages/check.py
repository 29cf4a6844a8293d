"""Say on the spot what a capture lacks, each line with the photograph to take before leaving.

Reads the photographs at half size or smaller; with a capture.toml its roles are taken (lines that still say TODO are no
hindrance), for a folder without one those that `insitu init` would propose. Every judgement is one function of
`pipeline.capture.checks` on numbers of `pipeline.capture.measures`.

Limits: the lens is a usual one until board photographs tell it; lamps that clip are taken for round spots.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.camera.board_families import Layout
from pipeline.capture import checks
from pipeline.capture.balls import find_ball, outermost
from pipeline.capture.checks import Finding
from pipeline.capture.likeness import cells_of, relative_exposures
from pipeline.capture.measures import (
    board_tilt,
    calibration_spread,
    darkest_snr,
    disc,
    drift_between,
    lamps_of,
    marker_side_px,
    rim_at_half_size,
)
from pipeline.capture.photographs import Photo, combined, files_of, read_all
from pipeline.capture.proposal import filled
from pipeline.capture.roles import Proposal, Shot, against_plate, markers_in, propose, with_ball, with_markers
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.run.manifest import CaptureFacts, load_toml, problems_of, resolve_files
from pipeline.types import Camera


@dataclass(frozen=True, eq=False)
class Checked:
    """A capture to be judged: its brackets by role, the board, and what its manifest states besides."""

    plate: Shot | None
    balls: list[Shot]
    boards: list[Shot]
    layout: Layout | None
    own_camera: frozenset[str] = frozenset()
    references: bool = False
    camera_given: bool = False
    posed: frozenset[str] = frozenset()
    flaws: tuple[str, ...] = ()


def check(where: Path, as_json: bool, say: Callable[[str], None]) -> int:
    """Print every judgement, worst first; returns the exit code: 3 when something must be photographed again."""
    findings = judge(proposed(where) if is_bare(where) else stated(where))
    order = {"problem": 0, "advice": 1, "ok": 2}
    findings.sort(key=lambda finding: order[finding.severity])
    if as_json:
        say(json.dumps([finding.model_dump() for finding in findings], indent=1))
    else:
        for finding in findings:
            say(finding.line())
        counts = {level: sum(f.severity == level for f in findings) for level in order}
        say(f"problems: {counts['problem']}, advice: {counts['advice']}, passed: {counts['ok']}")
    return 3 if any(finding.severity == "problem" for finding in findings) else 0


def is_bare(where: Path) -> bool:
    """Whether a path is a folder without a capture.toml."""
    return where.suffix != ".toml" and not (where / "capture.toml").is_file()


def proposed(folder: Path) -> Checked:
    """What `insitu init` takes a folder for. Raises CaptureError."""
    photos, flaws = read_all(files_of(folder), folder)
    if not photos:
        raise CaptureError("\n".join(flaws.values()))
    found: Proposal = propose(photos, flaws)
    plates = found.of("plate")
    boards = found.of("calibration")
    return Checked(
        plates[0] if plates else None, found.of("ball"), boards, found.layout, references=found.charted,
        flaws=tuple(flaws.values()),
    )  # fmt: skip


def stated(where: Path) -> Checked:
    """What a capture.toml says, its TODO lines apart. Raises ManifestError."""
    path = where if where.suffix == ".toml" else where / "capture.toml"
    try:
        facts = CaptureFacts.model_validate(filled(load_toml(path)))
    except ValidationError as error:
        raise ManifestError(*problems_of(error, path, CaptureFacts)) from error
    root = (path.parent / os.path.expandvars(facts.root)).resolve()
    problems: list[str] = []
    flaws: list[str] = []

    def shot(name: str, role: str, patterns: list[str], **more: Any) -> Shot | None:
        files, missing = resolve_files([p for p in patterns if not p.startswith("TODO")], root, f"{path}: {name}")
        problems.extend(missing)
        photos, unread = read_all(files, root)
        flaws.extend(unread.values())
        return bracket(name, role, photos, **more) if photos else None

    plate = shot("plate", "plate", facts.plate.files)
    balls = [shot(b.name, "ball", b.files, tripod=b.tripod) for b in facts.ball]
    boards = boards_of(facts.camera.calibration, root, problems, flaws)
    if problems:
        raise ManifestError(*problems)
    listed = [s for s in (plate, *balls) if s is not None]
    marked, layout = with_markers([*listed, *boards])
    listed = [sighted(s) if s.role == "ball" else s for s in marked]
    plate = next((s for s in listed if s.role == "plate"), None)
    return Checked(
        plate, [against_plate(s, plate) if plate is not None else s for s in listed if s.role == "ball"],
        [s for s in listed if s.role == "calibration"], layout,
        frozenset(b.name for b in facts.ball if b.camera is not None), bool(facts.reference),
        facts.camera.given is not None or facts.camera.file is not None,
        frozenset(p.view for p in facts.pose), tuple(flaws),
    )  # fmt: skip


def bracket(name: str, role: str, photos: list[Photo], **more: Any) -> Shot:
    """A bracket whose role is known."""
    photos = sorted(photos, key=lambda photo: (photo.exposure, photo.frame.file))
    cells = [cells_of(photo) for photo in photos]
    sizes = {photo.rgb.shape for photo in photos}
    if len(sizes) > 1:
        raise CaptureError(f"{name}: frames of {len(sizes)} sizes; expected one; take the others out of its files")
    return Shot(photos, cells, *combined(photos, relative_exposures(photos, cells)), role=role, name=name, **more)


def boards_of(patterns: list[str], root: Path, problems: list[str], flaws: list[str]) -> list[Shot]:
    """Every board photograph as a bracket of its own."""
    files, missing = resolve_files(patterns, root, "camera.calibration")
    problems.extend(missing)
    photos, unread = read_all(files, root)
    flaws.extend(unread.values())
    return [bracket("calibration", "calibration", [photo]) for photo in photos]


def sighted(shot: Shot) -> Shot:
    """A ball's view with the ball found in it, if it is."""
    seen = find_ball(shot.light, shot.first.step, shot.first.frame.focal_35mm)
    if seen is None or not seen.is_ball:
        return replace(shot, unsure=[*shot.unsure, "no ball is found"])
    return with_ball(shot, outermost(seen, shot.light, shot.first.step, None, shot.first.frame.focal_35mm))


def judge(capture: Checked) -> list[Finding]:
    """Every judgement about a capture."""
    plates = [capture.plate] if capture.plate is not None else []
    findings = checks.present({"plate": len(plates), "ball": len(capture.balls)})
    findings += checks.no_board("board", capture.layout is not None, bool(capture.posed))
    findings += [checks.unread(flaw) for flaw in capture.flaws]
    lens, found = judge_lens(capture)
    for shot in [*plates, *capture.balls]:
        findings += judge_bracket(shot)
    for shot in [*plates, *(ball for ball in capture.balls if not ball.tripod)]:
        if capture.layout is not None and shot.name not in capture.posed:
            findings += judge_board(shot, capture.layout, lens)
    for ball in capture.balls:
        findings += judge_ball(ball, capture)
    if capture.balls:
        others = sum(not ball.tripod for ball in capture.balls)
        findings.append(checks.second_ball("ball", len(capture.balls), others))
    return findings + found


def judge_lens(capture: Checked) -> tuple[Camera | None, list[Finding]]:
    """The lens that the board photographs tell, at the size they were read, and whether they will do."""
    if capture.camera_given and not capture.boards:
        return None, []
    if capture.layout is None or capture.layout.kind != "charuco":
        return None, checks.calibration("camera", 0, [], (0.0, 0.0))
    tilts, span, camera = calibration_spread(capture.boards, capture.layout)
    return camera, checks.calibration("camera", len(tilts), tilts, span)


def judge_bracket(shot: Shot) -> list[Finding]:
    """Exposure and settings of the plate or of a ball's view."""
    frames = [photo.frame for photo in shot.photos]
    within = disc(shot, 0.97)
    lamps = lamps_of(shot.first.top, shot.first.limit, within, shot.first.step)
    longest = shot.photos[-1]
    return [
        checks.clipped_lights(shot.name, lamps, shot.first.frame, shot.role == "ball"),
        checks.darkest(shot.name, *darkest_snr(longest, within), longest.frame),
        checks.bracketed(shot.name, len(frames)),
        *checks.ladder(shot.name, frames, [photo.exposure for photo in shot.photos]),
        *checks.settings(shot.name, frames),
    ]


def judge_board(shot: Shot, layout: Layout, lens: Camera | None) -> list[Finding]:
    """The board in a view whose pose it gives."""
    single = layout.kind == "marker"
    count = checks.MARKERS_ASKED if single and markers_in(shot) else markers_in(shot)
    found = [checks.board_seen(shot.name, count, marker_side_px(shot))]
    if shot.markers is None or not markers_in(shot):
        return found
    fits = lens is not None and (lens.height, lens.width) == shot.markers.shape
    tilt = board_tilt(shot.markers, layout, lens if fits else None)
    return found if tilt is None else [*found, checks.board_tilted(shot.name, tilt, single)]


def judge_ball(ball: Shot, capture: Checked) -> list[Finding]:
    """The ball's rim, its lens against the plate's, and what drifted between the two."""
    found = [checks.ball_found(ball.name, ball.ball is not None)]
    rim = rim_at_half_size(ball)
    if rim is not None:
        radius, blur, visible = rim
        found += [checks.ball_size(ball.name, radius), checks.ball_focus(ball.name, blur)]
        found.append(checks.ball_framed(ball.name, visible))
    if capture.plate is None:
        return found
    own = ball.name in capture.own_camera
    found += checks.same_lens(ball.name, capture.plate.first.frame, ball.first.frame, own, capture.references)
    drift = drift_between(capture.plate, ball) if ball.tripod else None
    return found + (checks.drifted(ball.name, drift) if drift is not None else [])
