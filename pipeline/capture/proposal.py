"""capture.toml as `insitu init` proposes it: what was guessed, why, and what only the photographer knows as TODO."""

from __future__ import annotations

import glob
import json
import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any

from pipeline.camera.board_families import Layout
from pipeline.capture.photographs import Photo
from pipeline.capture.roles import Proposal, Shot

TODO = "TODO"
NAME = re.compile(r"^[a-z][a-z0-9_]*$")
WIDTH = 118


def text_of(proposal: Proposal, name: str, root: str = ".") -> str:
    """The manifest's text. ``root``: the photographs' folder as seen from the manifest."""
    known = [shot.first.frame.file for shot in proposal.shots]
    everything = everything_of(proposal)
    plates, balls = proposal.of("plate"), proposal.of("ball")
    lines = [
        *comment(
            f"Proposed by insitu init from {len(everything)} photographs. Every guess says why; look them through, "
        ),
        *comment("fill in what says TODO, and run: insitu check on this file before you leave the place."),
        f'name = "{re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "capture"}"',
        *([f"root = {json.dumps(root)}"] if root != "." else []),
        "",
        *(plate_lines(plates[0], everything) if plates else missing_plate()),
    ]
    names = ball_names(balls, everything)
    for ball, called in zip(balls, names):
        lines += ["", *ball_lines(ball, called, everything, plates[0] if plates else None)]
    if not balls:
        lines += [
            "",
            *comment("No photograph with a mirror ball was found; or state another [probe] kind."),
            "[[ball]]",
        ]
        lines += ['name = "ball_a"', f'files = ["{TODO}: photographs of the mirror ball where the objects will stand"]']
    lines += ["", "[probe]", 'kind = "mirror_ball"']
    lines += [
        todo("diameter_m", "the ball's diameter [m], by caliper; without this line it is solved from the plane, to 1 %")
    ]
    size = next(((s.first.frame.width, s.first.frame.height) for s in [*plates, *balls] or proposal.shots), (0, 0))
    lines += ["", *board_lines(proposal.layout), "", *camera_lines(proposal, everything, size)]
    lines += chart_lines([(name, shot) for name, shot in zip(["plate", *names], [*plates[:1], *balls])])
    lines += views_lines(proposal.of("views"), everything)
    lines += exposure_lines([photo for shot in [*plates, *balls] for photo in shot.photos])
    lines += left_lines(proposal, known)
    return "\n".join(lines) + "\n"


def everything_of(proposal: Proposal) -> list[str]:
    """Every file of the folder."""
    taken = [photo.frame.file for shot in proposal.shots for photo in shot.photos]
    return [*taken, *proposal.left_out, *proposal.flaws]


def comment(text: str) -> list[str]:
    """The text as comment lines of at most WIDTH characters."""
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + 1 + len(word) > WIDTH - 2:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}".strip()
    return [f"# {part}" for part in [*lines, line] if part]


def todo(key: str, what: str) -> str:
    """A line that only the photographer can fill in; the manifest is refused, naming it, until it is."""
    return f'{key} = "{TODO}: {what}"'


def evidence(title: str, shot: Shot) -> list[str]:
    """Comments before a table: what it was taken for and why, and what is not sure."""
    because = comment(f"{title}: {'; '.join(shot.because) or 'the only bracket'}.")
    doubts = [f"{len(shot.unsure)} frames, as {shot.unsure[0]}"] if len(shot.unsure) > 3 else shot.unsure
    return because + [line for doubt in doubts for line in comment(f"UNSURE: {doubt}.")]


def listing(photos: Sequence[Photo], everything: Sequence[str]) -> str:
    """The files of a table: one glob where a folder holds them and no others of their kind, else their names."""
    names = sorted(photo.frame.file for photo in photos)
    folders = {str(PurePosixPath(name).parent) for name in names}
    suffixes = {PurePosixPath(name).suffix for name in names}
    if len(folders) == len(suffixes) == 1:
        folder, suffix = folders.pop(), suffixes.pop()
        same = [n for n in everything if str(PurePosixPath(n).parent) == folder and PurePosixPath(n).suffix == suffix]
        if sorted(same) == names and (len(names) > 1 or folder != "."):
            start = "" if folder == "." else glob.escape(folder) + "/"
            return f"[{json.dumps(f'{start}*{suffix}')}]"
    quoted = [json.dumps(glob.escape(name)) for name in names]
    if len(", ".join(quoted)) < WIDTH - 10:
        return f"[{', '.join(quoted)}]"
    return "[\n" + "".join(f"  {name},\n" for name in quoted) + "]"


def plate_lines(plate: Shot, everything: Sequence[str]) -> list[str]:
    """The [plate] table."""
    return [*evidence("Plate", plate), *marks(plate), "[plate]", f"files = {listing(plate.photos, everything)}"]


def missing_plate() -> list[str]:
    """A [plate] table for a folder without one."""
    return [
        *comment("No bracket was found that could be the plate."),
        "[plate]",
        f'files = ["{TODO}: the bracket without the ball, which objects are put into"]',
    ]


def marks(shot: Shot) -> list[str]:
    """Comments on what is odd about the files of a bracket."""
    frame = shot.first.frame
    said = sorted({mark for photo in shot.photos for mark in photo.frame.marks})
    if frame.encoding == "display":
        said.append("not RAW: its response curve must be recovered; RAW is better")
    settings = sorted({photo.frame.iso for photo in shot.photos if photo.frame.iso})
    if len(settings) > 1:
        said.append(f"ISO differs within it: {', '.join(f'{iso:g}' for iso in settings)}")
    return [line for text in said for line in comment(f"Note: {text}.")]


def ball_names(balls: Sequence[Shot], everything: Sequence[str]) -> list[str]:
    """Names of the ball's views: of the folders that hold them alone, else ball_a, ball_b, ..."""
    folders = [PurePosixPath(ball.first.frame.file).parent.name for ball in balls]
    alone = all("*" in listing(ball.photos, everything) for ball in balls)
    good = all(NAME.match(folder) and folder != "plate" for folder in folders)
    return folders if alone and good and len(set(folders)) == len(folders) else [ball.name for ball in balls]


def ball_lines(ball: Shot, name: str, everything: Sequence[str], plate: Shot | None) -> list[str]:
    """One [[ball]] table."""
    frame = ball.first.frame
    lines = [*evidence(name, ball), *marks(ball), "[[ball]]", f'name = "{name}"']
    lines += [f"files = {listing(ball.photos, everything)}"]
    if ball.tripod:
        lines.append("tripod = true")
    other = plate.first.frame if plate is not None else frame
    if (frame.width, frame.height) != (other.width, other.height) or frame.camera != other.camera:
        lines += comment("Another camera or size than the plate's: its own lens, or its own board photographs.")
        lines.append(f"camera = {{ {given(frame.width, frame.height)} }}")
    return lines


def given(width: int, height: int) -> str:
    """Intrinsics to be filled in."""
    unknown = ", ".join(f'{key} = "{TODO} px"' for key in ("fx", "fy", "cx", "cy"))
    return f"given = {{ width = {width}, height = {height}, {unknown} }}"


def board_lines(layout: Layout | None) -> list[str]:
    """The [board] or [marker] table, as far as it can be seen."""
    if layout is None:
        return comment(
            "No board or marker was found: give [[pose]] tables, or photograph the board in plate and ball views."
        )
    seen = f"{len(layout.ids)} markers of {layout.dictionary} (ids {layout.ids[0]} to {layout.ids[-1]})"
    if layout.name:
        return [
            *comment(
                f"Board: {seen} are those of {layout.name}, as insitu board prints it, in {layout.pictures} "
                "photographs. If a square measures otherwise on the print, say so: square_m = 0.0278"
            ),
            "[board]", f'layout = "{layout.name}"',
        ]  # fmt: skip
    if layout.kind == "charuco":
        across, down = layout.squares
        lines = comment(
            f"Board: {seen} fit a ChArUco board of {across} x {down} squares in {layout.pictures} photographs, to "
            f"{layout.rms:.1%} of a marker. Dictionaries of one family share their first markers. Sizes cannot be seen."
        )
        return [
            *lines, "[board]", f'dictionary = "{layout.dictionary}"', f"squares = [{across}, {down}]",
            todo("square_m", "side of a square [m], measured over several on the print"),
            todo("marker_m", f"side of a marker [m]; it looks like {layout.marker_over_square:.2f} of a square"),
            f"legacy = {str(layout.legacy).lower()}",
        ]  # fmt: skip
    what = {
        "grid": f"a grid of {layout.squares[0]} x {layout.squares[1]} markers, no ChArUco board",
        "marker": "one marker",
    }
    text = what.get(layout.kind, "no board of one layout")
    side = todo("side_m", "side of its black square [m]")
    return [
        *comment(f"Board: {seen}: {text}. One marker gives the pose; which one lies at the origin is UNSURE."),
        "[marker]", f'dictionary = "{layout.dictionary}"', f"id = {layout.ids[0]}", side,
    ]  # fmt: skip


def camera_lines(proposal: Proposal, everything: Sequence[str], size: tuple[int, int]) -> list[str]:
    """The [camera] table: board photographs, or numbers to be given."""
    boards = proposal.of("calibration")
    usable = proposal.layout is not None and proposal.layout.kind == "charuco"
    if boards and usable:
        spans = sorted(shot.markers.area_share for shot in boards if shot.markers is not None)
        lines = comment(
            f"Board photographs: {sum(len(s.photos) for s in boards)} that show the board over {spans[0]:.0%} to "
            f"{spans[-1]:.0%} of the frame, of the plate's size."
        )
        return [*lines, "[camera]", f"calibration = {listing([p for s in boards for p in s.photos], everything)}"]
    return [
        *comment("No photographs of the board from many sides: photograph ten, or give the lens."),
        "[camera]",
        given(*size),
    ]


def views_lines(views: Sequence[Shot], everything: Sequence[str]) -> list[str]:
    """The [views] table: photographs of the place by the plate's camera, neither plate nor ball nor board alone."""
    photos = [photo for shot in views for photo in shot.photos]
    if not photos:
        return []
    boards = sum(shot.markers is not None and len(shot.markers.ids) > 1 for shot in views)
    lines = comment(f"Further views: {len(photos)} of the plate's size, {boards} of them show the board from afar.")
    return ["", *lines, "[views]", f"files = {listing(photos, everything)}"]


def chart_lines(views: Sequence[tuple[str, Shot]]) -> list[str]:
    """The [[reference]] table of a 24-patch chart that views show."""
    seen = [(name, shot.chart) for name, shot in views if shot.chart is not None]
    if not seen:
        return []
    lines = ["", *comment("A 24-patch chart was found in these views; corners are read at half size."), "[[reference]]"]
    lines += ['name = "chart"', 'kind = "chart"']
    for name, corners in seen:
        places = ", ".join(f"[{x:.1f}, {y:.1f}]" for x, y in corners)
        lines += ["", "[[reference.seen]]", f'view = "{name}"', f"corners_px = [{places}]"]
    return lines


def exposure_lines(photos: Sequence[Photo]) -> list[str]:
    """[[exposure]] tables for what the files do not say."""
    keys = {"exposure_s": "shutter time [s]", "iso": "ISO", "fnumber": "f-number"}
    lines: list[str] = []
    for photo in photos:
        lacking = [key for key in keys if not getattr(photo.frame, key)]
        if lacking:
            lines += ["", "[[exposure]]", f"files = [{json.dumps(glob.escape(photo.frame.file))}]"]
            lines += [todo(key, f"{keys[key]}, which the file does not say") for key in lacking]
    return lines


def left_lines(proposal: Proposal, known: Sequence[str]) -> list[str]:
    """Comments on every photograph that no table names."""
    lines: list[str] = []
    for shot in proposal.shots:
        if shot.role in ("view", "left", "crop"):
            names = ", ".join(photo.frame.file for photo in shot.photos)
            why = "; ".join([*shot.because, *shot.unsure]) or "shows neither ball nor board"
            lines += comment(f"{names}: {why}.")
    lines += [line for file, why in proposal.left_out.items() for line in comment(f"{file}: {why}.")]
    lines += [line for file, why in proposal.flaws.items() for line in comment(f"{file}: not read: {why}.")]
    return ["", "# Not used:", *lines] if lines else []


def filled(data: Any, number: float = 0.05) -> Any:
    """A parsed manifest with a number in place of every TODO, so that all the rest can be validated."""
    if isinstance(data, dict):
        smaller = {"marker_m": 0.7}  # than its square
        return {key: filled(value, smaller.get(key, 1.0) * number) for key, value in data.items()}
    if isinstance(data, list):
        return [filled(value, number) if isinstance(value, dict | list) else value for value in data]
    return number if isinstance(data, str) and data.startswith(TODO) else data
