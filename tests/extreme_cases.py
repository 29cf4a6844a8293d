"""The table of extremes: what `extremes/cases.toml` defines, what tests saw of it, and the page of both.

A test takes the fixture ``saw`` and says what it saw of a case; that it is what was defined is asserted there. Tests
that take it are marked ``extreme``. With ``--extremes=FOLDER`` the session writes numerics.json and numerics.md there.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

TABLE = Path(__file__).parent / "extremes/cases.toml"
CASES: dict[str, dict[str, Any]] = {row["id"]: row for row in tomllib.loads(TABLE.read_text())["case"]}
Saw = Callable[..., None]


class Record:
    """What was seen of every case in this session."""

    def __init__(self) -> None:
        self.seen: dict[str, dict[str, Any]] = {}

    def saw(self, case: str, outcome: str, error: float | None = None, said: str = "", **precision: float) -> None:
        """A case ended as ``outcome``, its worst ``error`` in the unit of the table's ``of``.

        ``said``: the line, flag or number that tells the user; needed unless exact. ``precision``: float32=...,
        float64=..., worst errors of a formula evaluated so. Of several calls the worst is kept.
        """
        defined = CASES[case]
        bound = defined.get("bound", 0.0)
        error = 0.0 if error is None else float(error)
        ok = outcome == defined["defined"] and error <= bound
        if outcome != "exact":
            assert said, f"{case}: {outcome}, and nothing says so"
            assert "\n" not in said, f"{case}: needed one line"
        now = {"seen": outcome, "ok": ok, "worst_error": error, "said": said, **precision}
        before = self.seen.get(case)
        if before is None or (before["ok"] and (not ok or error > before["worst_error"])):
            self.seen[case] = now
        assert outcome == defined["defined"], f"{case}: {outcome}, defined as {defined['defined']}"
        assert error <= bound, f"{case}: {error:.3g}, defined as at most {bound:g} ({defined['of']})"

    def rows(self) -> list[dict[str, Any]]:
        """One row for each case of the table, in its order; those that no test told of are not ok."""
        missing = {"seen": "not run", "ok": False, "worst_error": None, "said": ""}
        return [
            {"case": name, "defined": row["defined"], "bound": row.get("bound"), **self.seen.get(name, missing)}
            for name, row in CASES.items()
        ]


def figure(value: float | None) -> str:
    """Two digits, or a dash."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:.2g}"


def page(rows: Iterable[dict[str, Any]], formulas: Iterable[dict[str, Any]]) -> str:
    """docs/numerics.md of what a run saw."""
    text = (TABLE.parent / "page.md").read_text()
    lines = ["| id | case | defined | bound | seen | worst error | of |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        case = CASES[row["case"]]
        refused = row["defined"] == "refused"
        bound, error = ("-", "-") if refused else (figure(row["bound"]), figure(row["worst_error"]))
        kept = " (1)" * bool(case.get("never_refused")) + " (2)" * bool(case.get("added"))
        seen = row["seen"] if row["ok"] else f"**{row['seen']}, not as defined**"
        what = f"*{row['said']}*" if refused and row["said"] else case.get("of", "")
        lines.append(
            f"| `{row['case']}` | {case['case']} | {row['defined']}{kept} | {bound} | {seen} | {error} | "
            f"{what.replace('|', chr(92) + '|')} |"
        )
    names = ("formula", "condition number", "sweep", "float32", "float64", "float32 breaks at", "what is done")
    heads = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    for row in formulas:
        heads.append("| " + " | ".join(row[key] for key in FORMULA_COLUMNS) + " |")
    return text.replace("{cases}", "\n".join(lines)).replace("{formulas}", "\n".join(heads))


FORMULA_COLUMNS = ("formula", "condition", "sweep", "float32", "float64", "breaks", "done")


def write(folder: Path, rows: list[dict[str, Any]], formulas: list[dict[str, Any]]) -> None:
    """numerics.json, formulas.json and numerics.md."""
    for name, content in (("numerics", rows), ("formulas", formulas)):
        lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in content)
        (folder / f"{name}.json").write_text(f"[\n{lines}\n]\n")
    (folder / "numerics.md").write_text(page(rows, formulas))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--extremes", metavar="FOLDER", help="write numerics.json, formulas.json and numerics.md there")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "saw" in getattr(item, "fixturenames", ()):
            item.add_marker("extreme")


RECORD = Record()


@pytest.fixture(scope="session")
def saw() -> Saw:
    """Says what was seen of an extreme case; see `Record.saw`."""
    return RECORD.saw


def pytest_sessionfinish(session: pytest.Session) -> None:
    folder = session.config.getoption("--extremes", default=None)
    if folder:
        from formula_sweeps import rows as sweeps

        write(Path(folder), RECORD.rows(), sweeps())
