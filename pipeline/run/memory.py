"""The most memory that this process held resident over a while: Linux keeps it, and lets it be set back.

Where it cannot be set back (another system, a guarded /proc) the figure is that of the process since its start: an
upper bound.
"""

from __future__ import annotations

import contextlib
import resource
from pathlib import Path


def reset_peak() -> None:
    """Begin a new while: the peak falls to what is resident now (``man 5 proc``: 5 into clear_refs)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_mb() -> float:
    """Most resident memory since `reset_peak`, of this process and all its threads [MB, 1e6 bytes]."""
    with contextlib.suppress(OSError, StopIteration):
        status = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in status if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
