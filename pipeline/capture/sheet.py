"""The printed board as a vector PDF: a ChArUco board, a ruler to check the print, and what to photograph with it.

`black_mm` is the whole geometry, rectangles in millimetres; the PDF draws them as one path, so that no hairlines show
between cells that touch. Written with ReportLab; its fonts are the fourteen that every reader has.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.opencv_bridge import marker_pattern
from pipeline.run.board_facts import LAYOUTS

PAPERS_MM = {"A4": (297.0, 210.0), "Letter": (279.4, 215.9)}  # width, height, lying
TOP_MM = 12.0  # white above the board, and the least beside it: printers leave out 4 to 6 mm
RULER_MM, RULER_GAP_MM, BLOCK_MM, BAR_MM = 100.0, 10.0, 10.0, 2.5
POINTS_PER_MM = 72 / 25.4

PHOTOGRAPHS = (
    ("Board", "flat on the surface, where plate and ball views show it; the objects will stand beside it"),
    (
        "Plate",
        "3 to 5 RAW frames, 2 stops apart, from a tripod; one aperture, one ISO; the shortest unclipped",
    ),
    ("Ball", "the same frames from the same tripod position, the mirror ball where the objects will stand"),
    ("Ball again", "from about 90 degrees around, the board in the frame; the shortest frame must not clip the lamps"),
    (
        "Lens",
        "10 photographs of the board with the plate's focus and zoom: tilted 30 to 45 degrees left, right,",
    ),
    ("", "front and back, three of them with the board in the corners of the frame, two with the camera turned by 90"),
    ("Grey card", "matt and flat in plate and ball view, lit alike: only where ball and plate have different cameras"),
    ("Clean plate", "if the plate may show no board: 8 to 12 views of the place with it, then take it away"),
    ("Measure", "the ball's diameter with a caliper; one square of the print, over nine of them"),
)
LINE_MM, FIRST_COLUMN_MM, LEFT_MM = 9.0, 30.0, 25.0


@dataclass(frozen=True)
class Text:
    """A line of text: its left end on the baseline (x, y) mm from the sheet's top left, and its size in points."""

    x: float
    y: float
    size: float
    text: str
    bold: bool = False


def layout_of_paper(paper: str) -> str:
    """Name of the layout that is printed on a paper of `PAPERS_MM`."""
    return f"insitu-{paper.lower()}"


def board_corner_mm(paper: str) -> np.ndarray:
    """Outer corner (x, y) of the board's top-left square, the world's origin, from the sheet's top left."""
    board = LAYOUTS[layout_of_paper(paper)]
    return np.array([(PAPERS_MM[paper][0] - 1000 * board["square_m"] * board["squares"][0]) / 2, TOP_MM])


def black_mm(paper: str) -> np.ndarray:
    """Everything black on the first sheet but text: rectangles (N, 4) as x, y, width, height, mm from the top left."""
    board = LAYOUTS[layout_of_paper(paper)]
    across, down = board["squares"]
    square, side = 1000 * board["square_m"], 1000 * board["marker_m"]
    corner = board_corner_mm(paper)
    found, marker_id = [], board["first_id"]
    for y in range(down):
        for x in range(across):
            place = corner + square * np.array([x, y])
            if (x + y) % 2 == 0:
                found.append([*place, square, square])
                continue
            pattern = marker_pattern(board["dictionary"], marker_id)
            cell = side / len(pattern)
            start = place + (square - side) / 2
            found += [[*(start + cell * np.array([j, i])), cell, cell] for i, j in np.argwhere(pattern)]
            marker_id += 1
    left, top = corner + np.array([0, down * square + RULER_GAP_MM])
    blocks = np.arange(0, RULER_MM, 2 * BLOCK_MM)
    found += [[left + x, top, BLOCK_MM, BAR_MM] for x in blocks]
    found += [[left + x + BLOCK_MM, top + BAR_MM, BLOCK_MM, BAR_MM] for x in blocks]
    return np.array(found, float)


def texts_mm(paper: str) -> list[list[Text]]:
    """Text of both sheets."""
    name = layout_of_paper(paper)
    board = LAYOUTS[name]
    corner = board_corner_mm(paper)
    top = corner[1] + 1000 * board["square_m"] * board["squares"][1] + RULER_GAP_MM
    left = corner[0] + RULER_MM + 8
    first = [
        Text(left, top + 3.5, 11, "Print at 100 %, glue flat, matte.", True),
        Text(
            left, top + 7.0, 8, f"The bar is {RULER_MM:.0f} mm long, a square {1000 * board['square_m']:.0f} mm wide."
        ),
        Text(left, top + 11.5, 8, f"{name}: ids {board['first_id']} and up; insitu init knows it by them."),
        Text(corner[0], top + 8.5, 8, "0"),
        Text(corner[0] + RULER_MM - 10, top + 8.5, 8, f"{RULER_MM:.0f} mm"),
    ]
    second = [Text(LEFT_MM, 25.0, 16, "What to photograph", True)]
    for number, (what, how) in enumerate(PHOTOGRAPHS):
        y = 40.0 + LINE_MM * number
        second += [Text(LEFT_MM, y, 10, what, True), Text(LEFT_MM + FIRST_COLUMN_MM, y, 10, how)]
    end = 40.0 + LINE_MM * (len(PHOTOGRAPHS) + 1)
    for number, line in enumerate(
        (
            f'In capture.toml:   [board]   layout = "{name}"   and, if nine squares do not measure '
            f"{9000 * board['square_m']:.0f} mm,   square_m = a ninth of what they do",
            f"The world's origin is the outer corner of the square beside marker {board['first_id']}, x along the long "
            "side, z along the short one, y up.",
            "Then, in the folder of the photographs:   insitu init . -o capture.toml   and   insitu check .   before "
            "you leave the place.",
        )
    ):
        second.append(Text(LEFT_MM, end + LINE_MM * number, 10, line))
    return [first, second]


def write_pdf(paper: str, path: Path) -> None:
    """Both sheets as a PDF; the same bytes every time. Asks readers not to scale it."""
    from reportlab.pdfgen.canvas import Canvas

    width, height = PAPERS_MM[paper]
    page = Canvas(str(path), pagesize=(width * POINTS_PER_MM, height * POINTS_PER_MM), invariant=1)
    page.setTitle(f"Board {layout_of_paper(paper)}")
    page.setViewerPreference("PrintScaling", "None")
    for number, texts in enumerate(texts_mm(paper)):
        if number == 0:
            _fill(page, black_mm(paper), height)
        for text in texts:
            page.setFont("Helvetica-Bold" if text.bold else "Helvetica", text.size)
            page.drawString(text.x * POINTS_PER_MM, (height - text.y) * POINTS_PER_MM, text.text)
        page.showPage()
    page.save()


def _fill(page: Any, rectangles: np.ndarray, height: float) -> None:
    """Rectangles (N, 4) mm from the top left as one path."""
    path = page.beginPath()
    for x, y, w, h in rectangles:
        path.rect(x * POINTS_PER_MM, (height - y - h) * POINTS_PER_MM, w * POINTS_PER_MM, h * POINTS_PER_MM)
    page.drawPath(path, stroke=0, fill=1, fillMode=1)
