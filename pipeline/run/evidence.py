"""What a row of evidence says: a term of a model, whether it was modelled and why, what leaving it out costs and saves.

A stage writes ``{"term", "modelled", "because", "could_cost"}``. ``modelled`` is True, False, or says how far. What is
not wholly modelled has its cost in numbers, too, or says why it has none:

bound_rel  the most that it could cost, as a share of what ``could_cost`` names
bound_px   how far it could move things in the plate; of a lens, rms over the frame, and more in its corners
bound_deg  how far it could turn light; of a ball, rms over it, and more at its rim
no_bound   in words, why no number can be stated

Of what is known by a standard uncertainty, two of it are the bound. What leaving the term out saved, where the stage
knows: ``saved_rel``, over the CPU seconds that the stage took (from counts: evidence is the same on every machine), or
``saved_s`` [CPU s]; ``saved_by`` says how that was estimated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

BOUNDS = {"bound_rel": "{:.2%}", "bound_px": "{:.3f} px", "bound_deg": "{:.2f} degrees"}  # and how they are written
TRIED: dict[str, Any] = {"saved_rel": 0.0, "saved_by": "it was tried, so nothing is"}  # to be told: not needed
ABSENT: dict[str, Any] = {"bound_rel": 0.0, "saved_rel": 0.0, "saved_by": "there is nothing to model"}


def is_open(row: Mapping[str, Any]) -> bool:
    """Whether the term is not wholly modelled."""
    return row.get("modelled") is not True


def costs_nothing(row: Mapping[str, Any]) -> bool:
    """Whether the row states that leaving its term out costs nothing."""
    stated = [row[name] for name in BOUNDS if row.get(name) is not None]
    return bool(stated) and not any(stated)


def silent(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Terms that are not wholly modelled and state neither a finite bound of at least 0 nor why there is none."""
    return [
        str(row["term"])
        for row in rows
        if is_open(row)
        and not row.get("no_bound")
        and not any(0 <= row[name] < float("inf") for name in BOUNDS if row.get(name) is not None)
    ]


def bound_text(row: Mapping[str, Any]) -> str:
    """The bounds of a row with their units, or why it has none."""
    known = [words.format(row[name]) for name, words in BOUNDS.items() if row.get(name) is not None]
    return ", ".join(known) or f"none: {row.get('no_bound', '')}"


def not_covered(records: Mapping[str, Mapping[str, Any]]) -> list[dict[str, str]]:
    """What stages did not model and what they say that it could cost: {stage, term, could_cost}; no sigma holds it.

    ``records``: by stage.
    """
    return [
        {"stage": name, "term": str(row["term"]), "could_cost": str(row["could_cost"])}
        for name, record in records.items()
        for row in record.get("evidence") or []
        if row.get("modelled") is False and row.get("could_cost") and not costs_nothing(row)
    ]
