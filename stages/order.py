"""The stages in reading order: this is the architecture."""

from __future__ import annotations

import functools
import importlib

from pipeline.run.stage import Graph

NAMES = (
    "ingest", "merge", "develop", "balance", "sources", "sfm", "calibrate", "pose", "probe", "lights", "plane",
    "reflectance", "render", "composite", "uncertainty", "evaluate", "report",
)  # fmt: skip


@functools.cache
def graph() -> Graph:
    """Import every room and join them. Raises TypeError when a signature and its declaration disagree."""
    return Graph(importlib.import_module(f"stages.{name}").STAGE for name in NAMES)
