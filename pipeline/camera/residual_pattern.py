"""Whether residuals of a fitted lens still have a pattern over the frame: what Brown's five terms cannot follow.

Means of the residuals over cells of the frame, one per photograph and cell; their scatter between photographs is the
noise, so that a board that is bent or a biased photograph does not pass for the lens. F-test of the cells' means
against it; what they exceed it by is the systematic error. Limits: cells of a quarter by a third of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COLUMNS, ROWS = 4, 3
FEWEST = 3  # photographs that a cell needs


@dataclass(frozen=True)
class Pattern:
    """Systematic error (rms distance, px), its largest cell (px), chance of it without a pattern, cells used."""

    rms_px: float
    largest_px: float
    chance: float
    cells: int


def pattern(px: list[np.ndarray], residuals: list[np.ndarray], width: int, height: int) -> Pattern:
    """Of pixels (N_i, 2) and residuals (N_i, 2) of each photograph."""
    means: dict[int, list[np.ndarray]] = {}
    for at, off in zip(px, residuals, strict=True):
        column = np.clip(at[:, 0] / width * COLUMNS, 0, COLUMNS - 1).astype(int)
        row = np.clip(at[:, 1] / height * ROWS, 0, ROWS - 1).astype(int)
        cell = row * COLUMNS + column
        for number in np.unique(cell):
            means.setdefault(int(number), []).append(off[cell == number].mean(0))
    used = [np.array(found) for found in means.values() if len(found) >= FEWEST]
    freedom = sum(2 * (len(found) - 1) for found in used)
    if not used or freedom < 1:
        return Pattern(0.0, 0.0, 1.0, 0)
    from scipy.special import fdtrc

    variance = max(sum(float(((one - one.mean(0)) ** 2).sum()) for one in used) / freedom, 1e-12)
    counts = np.array([len(found) for found in used])
    squares = np.array([float((found.mean(0) ** 2).sum()) for found in used])
    ratio = float((counts * squares).sum() / (2 * len(used)) / variance)
    excess = squares - 2 * variance / counts
    return Pattern(
        float(np.sqrt(max(excess.mean(), 0.0))), float(np.sqrt(max(excess.max(), 0.0))),
        float(fdtrc(2 * len(used), freedom, ratio)), len(used),
    )  # fmt: skip
