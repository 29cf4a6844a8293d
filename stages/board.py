"""Write the board to print, as a vector PDF, with the list of photographs to take.

The layout is in the ids of its markers: photographs of it need no facts, only a square measured on the print if the
printer was off. Never overwrites a file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pipeline.capture.sheet import layout_of_paper, write_pdf
from pipeline.run.errors import ManifestError


def board(paper: str, out: Path, say: Callable[[str], None]) -> None:
    """Write the PDF of a paper, "A4" or "Letter". Raises ManifestError when the file is there or cannot be written."""
    part = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        write_pdf(paper, part)
        os.link(part, out)  # unlike a rename, never replaces what is there
    except FileExistsError as error:
        raise ManifestError(
            f"{out}: is there already and is never overwritten; name another file with --out"
        ) from error
    except OSError as error:
        raise ManifestError(f"{out}: cannot be written ({error.strerror}); name another file with --out") from error
    finally:
        part.unlink(missing_ok=True)
    say(f'{out}: print at 100 %, glue flat, matte; in capture.toml: [board] layout = "{layout_of_paper(paper)}"')
