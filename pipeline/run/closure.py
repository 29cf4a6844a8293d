"""Which files of this project a module needs: read from its import statements, without importing it.

The set is both a stage's Make prerequisites and its code digest, so that editing a room re-runs that room only.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Declarations and plumbing: what a stage declares enters its record by value, so their edits re-run nothing.
PLUMBING = {"pipeline.run.artifacts", "pipeline.run.stage", "stages.knobs", "pipeline.run.errors"}
# Imports are found by pattern: parsing cost 0.5 s of every run. A test holds the pattern to what the parser finds.
STATEMENT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]+)|import[ \t]+([^\n]+))", re.M)


def path_of(module: str) -> Path | None:
    """File of a module of this project; None for other modules and for packages."""
    path = ROOT / (module.replace(".", "/") + ".py")
    return path if module.split(".")[0] in ("pipeline", "stages") and path.is_file() else None


@functools.cache
def imports(module: str) -> frozenset[str]:
    """Modules of this project that one module imports, at any depth of its code."""
    path = path_of(module)
    if path is None:
        return frozenset()
    found = set()
    for source, names, plain in STATEMENT.findall(path.read_text()):
        lines = (line.partition("#")[0] for line in (names or plain).strip("()").splitlines())
        listed = {words[0] for line in lines for part in line.split(",") if (words := part.split())}
        found |= {source, *(f"{source}.{name}" for name in listed)} if source else listed
    return frozenset(name for name in found if path_of(name) and name not in PLUMBING)


@functools.cache
def closure(module: str) -> tuple[Path, ...]:
    """Files that a module needs, itself included, sorted."""
    seen, todo = set(), [module]
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += imports(name)
    return tuple(sorted(path for name in seen if (path := path_of(name))))


def digest(module: str) -> str:
    """sha256 over the contents of the closure."""
    total = hashlib.sha256()
    for path in closure(module):
        total.update(path.read_bytes())
    return total.hexdigest()


def summary(module: str) -> str:
    """First docstring line of a module of this project, read without importing it."""
    path = path_of(module)
    text = ast.get_docstring(ast.parse(path.read_text())) if path else None
    return (text or "").partition("\n")[0]
