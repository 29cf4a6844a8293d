"""Formulas that subtract or divide, run in float32 and float64 over a sweep: where single precision breaks."""

from __future__ import annotations


def rows() -> list[dict[str, str]]:
    """One row for each formula; see `extreme_cases.FORMULA_COLUMNS`."""
    return []
