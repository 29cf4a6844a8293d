"""Corners of the board in the photographs that calibrate a lens: which can be used, and why the others cannot."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pipeline.camera import board_doubts
from pipeline.camera.board_kinds import sightings_of
from pipeline.camera.board_pictures import board_picture
from pipeline.camera.lens_ladder import FEWEST_PHOTOS, Photos
from pipeline.camera.opencv_bridge import Sightings
from pipeline.run.errors import CaptureError

FEWEST_CORNERS = 8  # of a photograph that is used


def corners_of(
    facts: dict[str, Any], board_photos: list[dict[str, str]], warnings: list[str]
) -> tuple[Photos, tuple[int, int]]:
    """Corners of every photograph in which enough are seen, and (width, height); ``warnings`` gains those left out.

    Raises CaptureError for photographs of several sizes, or too few of the stated board.
    """
    root = Path(facts["capture_root"])
    files = [photo["file"] for photo in board_photos]

    def look(file: str) -> tuple[tuple[int, int], Sightings]:
        plain, precise = board_picture(root / file)
        return (plain.shape[1], plain.shape[0]), sightings_of(plain, precise, facts["board"])

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # OpenCV releases the GIL
        found = list(pool.map(look, files))
    sizes = {size: file for file, (size, _) in zip(files, found, strict=True)}
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h} ({file})" for (w, h), file in sizes.items())
        turned = " as on the sensor (some are turned by 90 degrees)" if len({min(s) for s in sizes}) == 1 else ""
        raise CaptureError(f"calibration photographs: sizes {listed}, needed one size{turned}; take out the others")
    double = [i for i, (_, seen) in enumerate(found) if len(seen.twice) >= board_doubts.TWICE]
    usable = [i for i, (_, seen) in enumerate(found) if len(seen.px) >= FEWEST_CORNERS and i not in double]
    for i in double:
        warnings.append(f"{files[i]}: {len(found[i][1].twice)} ids are seen twice, needed one board; left out")
    for i in sorted(set(range(len(files))) - set(usable) - set(double)):
        seen = found[i][1]
        warnings.append(
            f"{files[i]}: {len(seen.px)} corners ({seen.markers} markers) found, needed {FEWEST_CORNERS}; left out"
        )
    if len(usable) < FEWEST_PHOTOS:
        others = [board_picture(root / files[i])[0] for i in range(len(files)) if i not in usable and i not in double]
        instead = board_doubts.of_board(others, facts["board"]) if others else ""
        cover = "; cover all boards but one" if double else ""
        raise CaptureError(
            f"calibration: {len(usable)} of {len(files)} photographs show the board, needed {FEWEST_PHOTOS}{cover}; "
            + (instead or "check [board] (dictionary, squares, legacy)")
            + "; photograph the whole board sharply from several tilts"
        )
    photos = Photos([files[i] for i in usable], [found[i][1].world_m for i in usable], [found[i][1].px for i in usable])
    return photos, next(iter(sizes))
