"""What this machine offers: libraries, renderer, memory, cores; what is missing and what that costs."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys

NEEDED = "numpy scipy opencv-contrib-python-headless pycolmap mitsuba OpenEXR colour-science rawpy opencolorio"
COSTS = {
    "cuda_ad_rgb": "the fastest",
    "llvm_ad_rgb": "the usual one without a GPU",
    "scalar_rgb": "about 5 times slower than LLVM: pip install karellen-llvm-core brings LLVM back",
}
# In a process of its own: an unsuitable libLLVM passes the import and then aborts the process at the first render.
PROBE = """
from pipeline.transport.variant import bundled_llvm, use_mitsuba
mi = use_mitsuba()
scene = mi.load_dict({"type": "scene", "i": {"type": "path"}, "e": {"type": "constant"}, "s": {"type": "sphere"},
    "c": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}})
mi.render(scene, spp=4).numpy()
print(mi.variant(), bundled_llvm())
"""


def examine() -> tuple[list[str], bool]:
    """Lines to print, and whether everything needed was found."""
    lines = [f"python      {sys.version.split()[0]} at {sys.prefix}"]
    healthy = True
    for name in NEEDED.split():
        try:
            lines.append(f"{name:<32} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            healthy = False
            lines.append(f"{name:<32} MISSING: pip install {name}")
    result = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=False)
    if result.returncode == 0:
        variant, library = result.stdout.split()[:2]
        lines.append(f"renderer    {variant} ({COSTS.get(variant, 'chosen by INSITU_VARIANT')}); libLLVM {library}")
    else:
        healthy = False
        reason = (result.stderr.strip().splitlines() or [f"exit code {result.returncode}"])[-1]
        lines.append(f"renderer    NONE: {reason}; INSITU_VARIANT=scalar_rgb needs no LLVM, 5 x slower")
    cores, memory = os.cpu_count() or 1, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    lines.append(f"cores       {cores}" + ("" if cores > 1 else ": rendering takes about twice as long as with two"))
    lines.append(f"memory      {memory:.1f} GiB" + ("" if memory >= 4 else ": 24 Mpx captures need about 4 GiB"))
    gpu = os.path.exists("/dev/nvidiactl")
    lines.append("GPU         " + ("found" if gpu else "none: LLVM renders on the cores"))
    return lines, healthy
