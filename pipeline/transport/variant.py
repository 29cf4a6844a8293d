"""Which Mitsuba runs: CUDA when there is a GPU, else LLVM, else scalar. The only place that sets the variant."""

from __future__ import annotations

import functools
import logging
import os
import sys
from pathlib import Path
from typing import Any

from pipeline.run.errors import ToolError

PREFERENCE = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"


def bundled_llvm() -> Path | None:
    """The libLLVM that was installed with the Python packages; None when there is none."""
    found = sorted((Path(sys.prefix) / "lib").glob("libLLVM.so.*"))
    return found[-1] if found else None


def candidates() -> tuple[str, ...]:
    """Variants worth trying here, best first; ``INSITU_VARIANT`` overrides."""
    if asked := os.environ.get("INSITU_VARIANT"):
        return (asked,)
    has_gpu = Path("/dev/nvidiactl").exists() or "CUDA_VISIBLE_DEVICES" in os.environ
    return PREFERENCE if has_gpu else PREFERENCE[1:]


@functools.cache
def use_mitsuba() -> Any:
    """The mitsuba module with its variant set and insitu's materials registered.

    LLVM is looked for beside Python before the system, because Debian's 15 and 16 pass the first check and then abort
    the process. Raises ToolError when no variant loads.
    """
    if (library := bundled_llvm()) is not None:
        os.environ.setdefault(LLVM_VARIABLE, str(library))
    import mitsuba as mi

    reasons = []
    for variant in candidates():
        try:
            mi.set_variant(variant)
        except (ImportError, RuntimeError) as error:
            reasons.append(f"{variant}: {error}")
            continue
        if reasons:
            logging.getLogger("insitu").warning("rendering with %s: %s", variant, "; ".join(reasons))
        from pipeline.transport.materials import register

        register(mi)
        mi.set_log_level(mi.LogLevel.Error)
        return mi
    raise ToolError("mitsuba: no variant loads; " + "; ".join(reasons) + "; run insitu doctor")


def kernel_input(mi: Any, value: float) -> Any:
    """A number that a compiled kernel is given, not one that is part of it: another value compiles nothing anew."""
    import drjit as dr

    return dr.opaque(mi.Float, float(value))


def switch_to(kind: str) -> Any:
    """Mitsuba in its ``spectral`` or ``rgb`` variant of the best backend; later calls switch the whole process.

    For a process of its own: whoever else uses Mitsuba in it would find another variant. Raises ToolError without LLVM
    and CUDA.
    """
    if (library := bundled_llvm()) is not None:
        os.environ.setdefault(LLVM_VARIABLE, str(library))
    import mitsuba as mi

    reasons = []
    for variant in (name for name in candidates() if not name.startswith("scalar")):
        try:
            mi.set_variant(variant.replace("rgb", kind))
        except (ImportError, RuntimeError) as error:
            reasons.append(f"{variant}: {error}")
            continue
        from pipeline.transport.materials import register

        register(mi)
        mi.set_log_level(mi.LogLevel.Error)
        return mi
    found = "; ".join(reasons) or f"only {', '.join(candidates())} may be tried"
    raise ToolError(f"mitsuba: no {kind} variant with LLVM or CUDA loads; {found}; run insitu doctor")
