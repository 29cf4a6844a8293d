"""What a stage is: a pure function, the artifacts it reads and writes, its parameters. Declares; does no work."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

STATED = "stated"  # space of an artifact whose rasters each say their own


@dataclass(frozen=True)
class Artifact:
    """One thing on disk. ``kind``: json, raster, rasters (a folder of EXR), picture (PNG), page (HTML) or cdl (XML)."""

    name: str
    kind: str
    meaning: str
    unit: str = ""
    space: str = ""
    type: Any = None  # for json: the type that validates it

    @property
    def filename(self) -> str:
        """Path below the stage's folder."""
        suffixes = {"json": ".json", "raster": ".exr", "picture": ".png", "page": ".html", "cdl": ".ccc"}
        return self.name + suffixes.get(self.kind, "")


@dataclass(frozen=True)
class Stage:
    """A verb. ``compute(**inputs, params) -> Result``; keys of ``inputs`` are its argument names."""

    name: str
    compute: Callable[..., Any]
    params: type
    inputs: dict[str, Artifact]
    outputs: dict[str, Artifact]
    impure: bool = False  # takes (capture_folder, scene_file, params): reads outside the build, so asked every time
    live: bool = False  # quick, and makes a picture: also run on what an earlier stage offers while it computes


class Graph:
    """The stages in reading order: unique producers, inputs made before they are read, signatures that agree."""

    def __init__(self, stages: Iterable[Stage]) -> None:
        self.stages = list(stages)
        self.producer: dict[str, Stage] = {}
        for stage in self.stages:
            names = ["capture_folder", "scene_file", "params"] if stage.impure else [*stage.inputs, "params"]
            arguments = list(inspect.signature(stage.compute).parameters)
            if arguments != names:
                raise TypeError(f"{stage.name}: compute takes {arguments}, the stage declares {names}")
            for artifact in stage.inputs.values():
                if artifact.kind != "records" and artifact.name not in self.producer:
                    raise TypeError(f"{stage.name}: reads {artifact.name}, which no earlier stage writes")
            for artifact in stage.outputs.values():
                if artifact.name in self.producer:
                    raise TypeError(
                        f"{artifact.name} is written by {self.producer[artifact.name].name} and {stage.name}"
                    )
                self.producer[artifact.name] = stage

    def __getitem__(self, name: str) -> Stage:
        return next(stage for stage in self.stages if stage.name == name)

    def parents(self, stage: Stage) -> list[Stage]:
        """Stages whose outputs this one reads, in order, without repeats."""
        if any(artifact.kind == "records" for artifact in stage.inputs.values()):
            return self.stages[: self.stages.index(stage)]
        names = {self.producer[artifact.name].name for artifact in stage.inputs.values()}
        return [parent for parent in self.stages if parent.name in names]

    def upto(self, name: str) -> list[Stage]:
        """The stage and everything it needs, in order."""
        wanted = {name}
        for stage in reversed(self.stages):
            if stage.name in wanted:
                wanted |= {parent.name for parent in self.parents(stage)}
        return [stage for stage in self.stages if stage.name in wanted]
