"""Loops as machine code: what the compiler is asked for is heeded, and no code of other sources is taken up again."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.image import machine_code


def doubled(values: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(values)):
        out[i] = 2 * values[i]


def made(values: np.ndarray) -> np.ndarray:
    return np.zeros(len(values))


def test_without_counting_no_array_can_be_made():
    """What `counted=False` asks for is no public option of the compiler: when it goes, this says so."""
    from numba.core.errors import NumbaError

    ones = np.ones(3)
    assert machine_code.compiled(made)(ones).tolist() == [0, 0, 0]
    try:
        kernel = machine_code.compiled(made, counted=False)
    except KeyError as error:
        pytest.fail(f"the compiler no longer takes _nrt ({error}): drop it, and see what benchmarks.merge says of that")
    with pytest.raises(NumbaError, match="returning of array"):
        kernel(ones)


def test_code_of_other_sources_is_forgotten(monkeypatch):
    """Kept for the same sources, also of helpers in other files; compiled anew for others."""
    values, out = np.arange(3.0), np.zeros(3)
    for sources, kept in (("one", None), ("one", True), ("two", False), ("two", True), ("one", False)):
        monkeypatch.setattr(machine_code, "digest", lambda module, sources=sources: sources)
        kernel = machine_code.compiled(doubled)
        kernel(values, out)
        assert out.tolist() == [0, 2, 4]
        if kept is not None:  # whatever an earlier run of the tests left
            assert bool(kernel.stats.cache_hits) == kept
