"""The frames of every view that capture.toml lists: read, completed by what it states, sorted, and checked together.

Problems are text of the manifest, flaws those of photographs; both are collected, so that all are reported at once.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pipeline.camera.view_checks import lens_strangers, zoom_differs
from pipeline.image.exposure import exposure_of
from pipeline.image.frames import read_frame
from pipeline.image.sensitivities import is_known
from pipeline.image.sensor import missing, read_bad_pixels, restated
from pipeline.run.errors import CaptureError
from pipeline.run.manifest import CaptureFacts, resolve_files
from pipeline.run.probe_facts import FisheyePairFacts
from pipeline.types import Bracket, Frame


def read_brackets(
    facts: CaptureFacts, root: Path, manifest: Path, problems: list[str], flaws: list[str], warnings: list[str]
) -> dict[str, Bracket]:
    """Every view's frames, read in parallel (decoders and digests release the interpreter)."""
    lenses = facts.probe.fisheye if isinstance(facts.probe, FisheyePairFacts) else []
    tables = {"plate": ("plate", facts.plate.files)}
    tables |= {ball.name: (f"ball[{i}]", ball.files) for i, ball in enumerate(facts.ball)}
    tables |= {lens.name: (f"probe.fisheye[{i}]", lens.files) for i, lens in enumerate(lenses) if lens.files}
    if facts.chart is not None and facts.chart.files:
        tables["chart"] = ("chart", facts.chart.files)
    stated = _stated_exposures(facts, root, manifest, problems)
    sensors = _stated_sensors(facts, root, manifest, problems, flaws)
    listing = {}
    for name, (table, wanted) in tables.items():
        listing[name], found = resolve_files(wanted, root, f"{manifest}: {table}.files")
        problems.extend(found)
    flats, found = resolve_files(facts.lens.flat if facts.lens else [], root, f"{manifest}: lens.flat")
    problems.extend(found)
    for number, flat in enumerate(flats, 1):  # a view each: the light may change between them
        name = f"flat_{number}"
        tables[name], listing[name] = ("lens", []), [flat]

    def read(path: Path) -> Frame | str:
        try:
            return read_frame(path, path.relative_to(root).as_posix())
        except CaptureError as error:
            return str(error)

    unique = sorted({file for files in listing.values() for file in files})
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        read_files = dict(zip(unique, pool.map(read, unique)))
    flaws.extend(flaw for flaw in read_files.values() if isinstance(flaw, str))
    charted = facts.chart is not None and facts.chart.fit == "matrix"
    _complete(read_files, sensors, charted, flaws, warnings)
    brackets = {}
    for name, files in listing.items():
        frames = [_restated(frame, stated.get(f, {})) for f in files if isinstance(frame := read_files[f], Frame)]
        role = tables[name][0].split("[")[0].removeprefix("probe.")
        brackets[name] = Bracket(name=name, role=role, frames=_sorted_unique(name, frames, flaws, warnings))
    own = {ball.name for ball in facts.ball if ball.camera is not None} | {lens.name for lens in lenses}
    _check_sizes(brackets, own, flaws, warnings)
    return brackets


def _stated_exposures(
    facts: CaptureFacts, root: Path, manifest: Path, problems: list[str]
) -> dict[Path, dict[str, float]]:
    """What [[exposure]] says, by file; a later table adds to an earlier one."""
    stated: dict[Path, dict[str, float]] = {}
    for number, entry in enumerate(facts.exposure):
        files, found = resolve_files(entry.files, root, f"{manifest}: exposure[{number}].files")
        problems.extend(found)
        for file in files:
            stated.setdefault(file, {}).update(entry.model_dump(exclude={"files"}, exclude_none=True))
    return stated


def _stated_sensors(
    facts: CaptureFacts, root: Path, manifest: Path, problems: list[str], flaws: list[str]
) -> dict[Path, dict[str, Any]]:
    """What [[sensor]] says, by file, lists of bad pixels read; a later table adds to an earlier one."""
    stated: dict[Path, dict[str, Any]] = {}
    for number, entry in enumerate(facts.sensor):
        files, found = resolve_files(entry.files, root, f"{manifest}: sensor[{number}].files")
        problems.extend(found)
        given = entry.model_dump(exclude={"files", "bad_pixels"}, exclude_none=True)
        if entry.bad_pixels is not None:
            name = Path(os.path.expandvars(entry.bad_pixels))
            lists = [folder / name for folder in (manifest.parent, root) if (folder / name).is_file()]
            try:
                if lists:
                    given["bad_pixels"] = read_bad_pixels(lists[0])
            except CaptureError as error:
                flaws.append(str(error))
            if not lists:
                problems.append(f"{manifest}: sensor[{number}].bad_pixels: is {entry.bad_pixels!r}; no such file")
        for file in files:
            stated.setdefault(file, {}).update(given)
    return stated


def _complete(
    read_files: dict[Path, Frame | str],
    sensors: dict[Path, dict[str, Any]],
    charted: bool,
    flaws: list[str],
    warnings: list[str],
) -> None:
    """Puts what [[sensor]] says into the frames; asks for what is still missing, and says what is odd about them.

    ``charted``: a chart gives the colour matrix.
    """
    odd: dict[str, list[str]] = {}
    for path, frame in read_files.items():
        if not isinstance(frame, Frame):
            continue
        try:
            frame = read_files[path] = restated(frame, sensors.get(path, {}))
        except CaptureError as error:
            flaws.append(str(error))
            continue
        flaws.extend(missing(frame, matrix=not charted and not is_known(frame.camera)))
        for mark in frame.marks:
            odd.setdefault(mark, []).append(frame.file)
    for mark, names in odd.items():
        warnings.append(f"{names[0]}{f' and {len(names) - 1} more' if len(names) > 1 else ''}: {mark}")


def _restated(frame: Frame, stated: dict[str, float]) -> Frame:
    return frame.model_copy(update=stated) if stated else frame


def _sorted_unique(view: str, frames: list[Frame], flaws: list[str], warnings: list[str]) -> list[Frame]:
    """Frames with a known exposure, shortest first, each content once."""
    kept: dict[str, Frame] = {}
    for frame in sorted(frames, key=lambda frame: frame.file):
        lacking = [key for key in ("exposure_s", "iso", "fnumber") if not getattr(frame, key) > 0]
        if lacking:
            flaws.append(
                f"{frame.file}: {', '.join(lacking)} missing in EXIF, needed for radiance; "
                f'state it in capture.toml: [[exposure]] files = ["{frame.file}"], '
                + ", ".join(f"{k} = ..." for k in lacking)
            )
        elif frame.sha256 in kept:
            warnings.append(f"{frame.file}: same content as {kept[frame.sha256].file} in view {view}; counted once")
        else:
            kept[frame.sha256] = frame
    return sorted(kept.values(), key=lambda frame: (exposure_of(frame), frame.file))


def _check_sizes(brackets: dict[str, Bracket], own: set[str], flaws: list[str], warnings: list[str]) -> None:
    """One size and one colour filter within a bracket; the plate's in every view whose camera is the plate's.

    ``own``: views that state a camera of their own; its size is compared with the photograph's once it is developed.
    """
    reference = brackets["plate"].frames[0] if brackets["plate"].frames else None
    for name, bracket in brackets.items():
        kinds = sorted({(frame.width, frame.height, frame.cfa) for frame in bracket.frames})
        shown = ", ".join(f"{width} x {height} {cfa}" for width, height, cfa in kinds)
        models = sorted({frame.camera for frame in bracket.frames})
        if len(kinds) > 1:
            flaws.append(f"{name}: its frames are {shown}; needed one size and colour filter; take out the strangers")
        elif len(models) > 1:
            flaws.append(f"{name}: its frames are of {' and '.join(models)}; needed one camera; take out the strangers")
        elif reference and kinds and name not in own:
            if kinds[0] != (reference.width, reference.height, reference.cfa):
                expected = f"{reference.width} x {reference.height} {reference.cfa}"
                flaws.append(
                    f"{name}: its frames are {shown}, the plate's {expected}; use one camera and one RAW size, or "
                    "state the ball's own camera: [[ball]] camera = { given = { ... } }"
                )
            elif models != [reference.camera]:
                warnings.append(
                    f"{name}: taken with {models[0] or 'an unnamed camera'}, the plate with {reference.camera or 'one'}"
                    "; the plate's lens is taken for both; state [[ball]] camera if it had another"
                )


def check_zoom(
    brackets: dict[str, Bracket], board_frames: dict[str, list[Frame]], flaws: list[str], warnings: list[str]
) -> None:
    """One focal length within a view, in its board photographs, and in views that share the plate's lens."""
    for name, bracket in brackets.items():
        own, plate = board_frames.get(name), brackets["plate"].frames
        if len({frame.camera for frame in bracket.frames}) == 1:  # several are refused already
            flaws.extend(lens_strangers(bracket.frames, f"frames of {name}"))
        if own and (mm := zoom_differs(bracket.frames, own)):
            flaws.append(
                f"{name}: taken at {mm[0]:g} mm, its board photographs at {mm[1]:g} mm; needed one focal length; "
                "photograph the board again with the zoom as it was"
            )
        elif name not in board_frames and bracket.role == "ball" and (mm := zoom_differs(plate, bracket.frames)):
            warnings.append(
                f"{name}: taken at {mm[1]:g} mm, the plate at {mm[0]:g} mm; the plate's lens is taken for both; state "
                "[[ball]] camera"
            )
