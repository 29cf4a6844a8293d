"""What one run was asked: resolved once into build/<capture>/settings.json, rewritten only when its content changes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from pipeline.run.errors import ArtifactError, ManifestError
from pipeline.run.manifest import SceneWishes, load_capture, load_toml, problems_of


class Settings(BaseModel):
    """Paths, quality, and every stage's knobs with defaults filled in."""

    capture: str
    scene: str | None
    quality: str  # a preset, or "solved"
    params: dict[str, dict[str, Any]]
    asked: dict[str, float] = {}  # max_error, time_budget [CPU s]: what solved settings answer

    @property
    def switches(self) -> str:
        """What to give to ``insitu run`` for these settings again."""
        if not self.asked:
            return f"--quality {self.quality}"
        return " ".join(f"--{name.replace('_', '-')} {value:g}" for name, value in self.asked.items())


def resolve(
    capture: Path,
    scene: Path | None,
    quality: str | None,
    switches: list[str],
    knobs: Mapping[str, type[BaseModel]],
    presets: dict[str, dict[str, dict[str, Any]]],
) -> Settings:
    """Defaults, then the preset, then scene.toml's tables, then ``stage.knob=value`` switches.

    Raises ManifestError with the problems of capture.toml, scene.toml and the switches together.
    """
    problems: list[str] = []
    try:
        _, capture_file, _ = load_capture(capture)
    except ManifestError as error:
        problems += error.problems
        capture_file = capture if capture.suffix == ".toml" else capture / "capture.toml"
    default = capture_file.parent / "scene.toml"
    path = scene or (default if default.is_file() else None)
    try:
        tables = load_toml(path) if path else {}
    except ManifestError as error:
        raise ManifestError(*problems, *error.problems) from error
    own = {name: tables.pop(name) for name in list(tables) if name in knobs}
    try:
        wishes = SceneWishes.model_validate(tables)
        quality = quality or wishes.quality
    except ValidationError as error:
        problems += problems_of(error, path or default, SceneWishes)
        quality = quality or "preview"
    asked, more = parse_switches(switches, knobs)
    problems += more
    params = {}
    for name, model in knobs.items():
        values = {**presets[quality].get(name, {}), **own.get(name, {})}
        try:
            model.model_validate(values)
        except ValidationError as error:
            problems += problems_of(error, path or default, model, name)
            continue
        try:
            params[name] = model.model_validate({**values, **asked.get(name, {})}).model_dump()
        except ValidationError as error:
            problems += [
                line.replace(str(path or default), "--set") for line in problems_of(error, Path("--set"), model, name)
            ]
    if problems:
        raise ManifestError(*problems)
    return Settings(
        capture=str(capture_file.resolve()), scene=str(path.resolve()) if path else None, quality=quality, params=params
    )


def given(
    capture: Path, scene: Path | None, switches: list[str], knobs: Mapping[str, type[BaseModel]]
) -> frozenset[str]:
    """``stage.knob`` of every knob that scene.toml or a switch sets. Raises ManifestError where either is damaged."""
    path = scene or load_capture(capture)[1].parent / "scene.toml"
    tables = load_toml(path) if scene or path.is_file() else {}
    asked, problems = parse_switches(switches, knobs)
    if problems:
        raise ManifestError(*problems)
    own = {name: tables[name] for name in knobs if name in tables}
    return frozenset(f"{stage}.{knob}" for part in (own, asked) for stage, values in part.items() for knob in values)


def parse_switches(
    switches: list[str], knobs: Mapping[str, type[BaseModel]]
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """``stage.knob=value`` strings as nested values (JSON where it parses, else text), and the problems."""
    asked: dict[str, dict[str, Any]] = {}
    problems = []
    for switch in switches:
        key, equals, text = switch.partition("=")
        stage, dot, knob = key.partition(".")
        if not (equals and dot and stage in knobs):
            problems.append(f"--set: is {switch!r}; expected stage.knob=value with a stage of {', '.join(knobs)}")
            continue
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = text
        asked.setdefault(stage, {})[knob] = value
    return asked, problems


def save(settings: Settings, out: Path) -> Path:
    """Write settings.json unless it already says the same (its time stamp is a Make prerequisite)."""
    from pipeline.run.formats import write_bytes

    path = out / "settings.json"
    data = settings.model_dump_json(indent=1).encode() + b"\n"
    if not path.exists() or path.read_bytes() != data:
        write_bytes(path, data)
    return path


def load(out: Path) -> Settings:
    """Read settings.json. Raises ArtifactError when it is missing or damaged."""
    path = out / "settings.json"
    if not path.exists():
        raise ArtifactError(f"{path}: missing; run insitu settings CAPTURE first")
    try:
        return Settings.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise ArtifactError(f"{path}: damaged; delete it and run again") from error
