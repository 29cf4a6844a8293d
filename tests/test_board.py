"""The board that is printed: its geometry in the PDF, and that photographs of it need no further facts."""

from __future__ import annotations

import tomllib

import numpy as np
import pypdfium2
import pytest
from printed_board import looking_at, photograph

from pipeline.camera import opencv_bridge
from pipeline.camera.board_families import find_markers, layout_of
from pipeline.camera.markers import tone
from pipeline.capture import sheet
from pipeline.capture.measures import board_points
from pipeline.capture.proposal import board_lines
from pipeline.run.board_facts import LAYOUTS, BoardFacts
from pipeline.run.cli import main
from pipeline.run.errors import ManifestError
from pipeline.types import Camera

PX_PER_MM = 10.0


def rendered(path, page: int = 0) -> np.ndarray:
    """(H, W) uint8 of a page at PX_PER_MM; page 0 is made as large as the paper to a hundredth of a pixel."""
    picture = pypdfium2.PdfDocument(path)[page].render(scale=PX_PER_MM * 25.4 / 72, grayscale=True)
    return picture.to_numpy().reshape(picture.height, picture.width)


@pytest.mark.parametrize("paper", list(sheet.PAPERS_MM))
def test_corners_lie_where_they_should_on_the_page(paper: str, tmp_path) -> None:
    """Read back from the rendered PDF: all markers, corners to 0.01 mm, a tenth of a rendered pixel."""
    path = tmp_path / "board.pdf"
    assert main(["board", "--paper", paper, "--out", str(path)]) == 0
    page = rendered(path)
    facts = BoardFacts(layout=sheet.layout_of_paper(paper)).model_dump()
    width, height = sheet.PAPERS_MM[paper]
    stretch = np.array([page.shape[1] / width, page.shape[0] / height])  # whole pixels hold the page
    seen = opencv_bridge.board_sightings(page, page, facts)
    across, down = facts["squares"]
    assert seen.markers == across * down // 2
    assert len(seen.px) == (across - 1) * (down - 1)
    expected = sheet.board_corner_mm(paper) + 1000 * seen.world_m[:, [0, 2]]
    assert np.abs(seen.px / stretch - expected).max() < 0.01


@pytest.mark.parametrize("paper", list(sheet.PAPERS_MM))
def test_ruler_and_quiet_zone(paper: str, tmp_path) -> None:
    sheet.write_pdf(paper, tmp_path / "board.pdf")
    page = rendered(tmp_path / "board.pdf") < 128
    black = sheet.black_mm(paper)
    corner, facts = sheet.board_corner_mm(paper), LAYOUTS[sheet.layout_of_paper(paper)]
    end = corner + 1000 * facts["square_m"] * np.array(facts["squares"])
    top = end[1] + sheet.RULER_GAP_MM
    row = page[round((top + 1.2) * PX_PER_MM)] | page[round((top + 3.7) * PX_PER_MM)]
    left = round((corner[0] + sheet.RULER_MM + 1) * PX_PER_MM)
    bar = np.flatnonzero(row[:left])
    assert (bar[-1] + 1 - bar[0]) / PX_PER_MM == pytest.approx(sheet.RULER_MM, abs=0.2)  # two whole pixels
    quiet = np.concatenate([page[: round((corner[1] - 0.2) * PX_PER_MM)].ravel(),
                            page[round((end[1] + 0.2) * PX_PER_MM) : round((top - 0.2) * PX_PER_MM)].ravel(),
                            page[:, : round((corner[0] - 0.2) * PX_PER_MM)].ravel()])  # fmt: skip
    assert not quiet.any()
    assert black[:, 0].min() > 12  # mm: no printer leaves that out
    assert sheet.PAPERS_MM[paper][1] - (black[:, 1] + black[:, 3]).max() > 12


def test_pdf_is_vector_small_and_the_same_each_time(tmp_path) -> None:
    for name in ("one.pdf", "other.pdf"):
        sheet.write_pdf("A4", tmp_path / name)
    data = (tmp_path / "one.pdf").read_bytes()
    assert data == (tmp_path / "other.pdf").read_bytes()
    assert len(data) < 20_000
    assert b"/Subtype /Image" not in data
    document = pypdfium2.PdfDocument(tmp_path / "one.pdf")
    texts = [page.get_textpage().get_text_range() for page in document]
    assert "Print at 100 %, glue flat, matte." in texts[0]
    assert all(word in texts[1] for word in ("Plate", "Ball again", "Lens", "Grey card", "Clean plate", "insitu-a4"))


def test_no_text_leaves_the_sheet() -> None:
    from reportlab.pdfbase.pdfmetrics import stringWidth

    for paper, (width, height) in sheet.PAPERS_MM.items():
        for text in [text for page in sheet.texts_mm(paper) for text in page]:
            font = "Helvetica-Bold" if text.bold else "Helvetica"
            assert text.x + stringWidth(text.text, font, text.size) / sheet.POINTS_PER_MM < width - 12, text.text
            assert text.y < height - 5


def test_a_file_is_never_overwritten(tmp_path, capsys) -> None:
    path = tmp_path / "board.pdf"
    path.write_text("mine")
    assert main(["board", "--paper", "A4", "--out", str(path)]) == ManifestError.exit_code
    assert "never overwritten" in capsys.readouterr().err
    assert path.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [path]


def test_ids_of_layouts_are_apart() -> None:
    taken = [f["first_id"] + i for f in LAYOUTS.values() for i in range(f["squares"][0] * f["squares"][1] // 2)]
    assert len(set(taken)) == len(taken)


def sheet_print(paper: str) -> tuple[np.ndarray, float, np.ndarray]:
    """The sheet as `photograph` takes prints: picture, pixels per metre, place of its corner in the world."""
    scale = 10  # px per mm: no edge is off by more than half of that, 0.05 mm
    width, height = sheet.PAPERS_MM[paper]
    picture = np.full((round(height * scale), round(width * scale)), 255, np.uint8)
    for x, y, w, h in np.round(sheet.black_mm(paper) * scale).astype(int):
        picture[y : y + h, x : x + w] = 0
    return picture, 1000.0 * scale, -sheet.board_corner_mm(paper) / 1000


@pytest.fixture(scope="module")
def photographed() -> np.ndarray:
    """(H, W) uint8 of the Letter sheet at 35 degrees."""
    camera = Camera(width=960, height=720, fx=1000.0, fy=1000.0, cx=480.0, cy=360.0)
    pose = looking_at(np.array([0.126, 0, 0.09]), 35, 20, 0.55, 15)
    return np.asarray(255 * tone(photograph(sheet_print("Letter"), camera, pose, 2)), np.uint8)


def test_ids_tell_the_layout(photographed) -> None:
    layout = layout_of([find_markers(photographed)])
    assert layout is not None
    assert layout.name == "insitu-letter"
    assert layout.marker_over_square == pytest.approx(0.75, abs=0.03)  # markers shrink by detection
    proposed = tomllib.loads("\n".join(board_lines(layout)))
    facts = BoardFacts.model_validate(proposed["board"]).model_dump()
    seen = opencv_bridge.board_sightings(photographed, photographed, facts)
    assert len(seen.px) == 40
    points = board_points(find_markers(photographed), layout)
    assert points is not None
    assert len(points[0]) == 27


class TestFacts:
    def test_a_layout_says_everything(self):
        facts = BoardFacts(layout="insitu-a4")
        assert (facts.first_id, facts.squares, facts.square_m, facts.marker_m) == (600, (9, 6), 0.028, 0.021)
        assert BoardFacts.model_validate(facts.model_dump(mode="json")) == facts  # as facts of a build are read

    def test_a_measured_square_scales_the_marker(self):
        facts = BoardFacts(layout="insitu-a4", square_m=0.0272)
        assert facts.marker_m == pytest.approx(0.021 * 0.0272 / 0.028)
        assert BoardFacts.model_validate(facts.model_dump()) == facts

    @pytest.mark.parametrize(
        ("given", "line"),
        [
            ({"layout": "insitu-a5"}, "expected insitu-a4 or insitu-letter"),
            ({"layout": "insitu-a4", "dictionary": "DICT_4X4_50"}, "does not have this dictionary"),
            ({"layout": "insitu-a4", "square_m": 28.0}, "measure one square"),
        ],
    )
    def test_refusals(self, given, line):
        with pytest.raises(ValueError, match=line):
            BoardFacts.model_validate(given)

    def test_ids_beyond_the_dictionary(self):
        board = {"dictionary": "DICT_5X5_50", "squares": (7, 5), "square_m": 0.03, "marker_m": 0.02, "first_id": 40}
        with pytest.raises(ManifestError, match="DICT_5X5_50 holds 50"):
            opencv_bridge.charuco_board(board)
