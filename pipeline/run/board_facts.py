"""Facts of the printed board: stated number by number, or by the name of a layout that `insitu board` prints.

The ids of a printed layout's markers are its own, so a photograph tells which layout it shows. Imports no numpy.
"""

from __future__ import annotations

import difflib
import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from pipeline.run.strict import Strict

# Both carry the same squares. A range of ids is never used again for another layout: prints outlive versions.
LAYOUTS: dict[str, dict[str, Any]] = {
    "insitu-a4": {"dictionary": "DICT_5X5_1000", "first_id": 600, "squares": [9, 6], "square_m": 0.028,
                  "marker_m": 0.021, "margin_m": 0.012},
    "insitu-letter": {"dictionary": "DICT_5X5_1000", "first_id": 650, "squares": [9, 6], "square_m": 0.028,
                      "marker_m": 0.021, "margin_m": 0.012},
}  # fmt: skip
MEASURED = {"layout", "square_m", "margin_m"}  # what may stand beside a layout's name
FEWEST_SQUARES = 4  # each way, of a chessboard
SMALLEST_MARKER_M = 0.0005
FARTHEST_SCALE = 1.5  # of a print: beyond it the measured number is a slip


DICTIONARIES = (  # of OpenCV
    *(f"DICT_{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    *("DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36H12", "DICT_ARUCO_MIP_36h12"),
    *(f"DICT_APRILTAG_{bits}{h}{distance}" for bits, distance in ((16, 5), (25, 9), (36, 10), (36, 11)) for h in "hH"),
)


def _known_dictionary(name: str) -> str:
    if name not in DICTIONARIES:
        close = difflib.get_close_matches(name.upper(), DICTIONARIES, 1)
        meant = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(DICTIONARIES)}"
        raise ValueError(f"is {name!r}; {meant}")
    return name


Dictionary = Annotated[str, AfterValidator(_known_dictionary)]


class BoardFacts(Strict):
    """The printed board that defines the world. A grid's square is the pitch of its markers."""

    kind: Literal["charuco", "grid", "chessboard"] = Field(
        "charuco", description="grid: of ArUco markers or AprilTags, ids row by row; a chessboard has no markers"
    )
    layout: str | None = Field(None, description=f"{' or '.join(LAYOUTS)}, as insitu board prints it; says the rest")
    dictionary: Dictionary = "DICT_5X5_100"
    first_id: int = Field(0, ge=0, description="of its markers")
    squares: tuple[int, int] = Field(description="along x, along y")
    square_m: float = Field(gt=0.001, lt=1.0, description="beside a layout: as measured on the print")
    marker_m: float = Field(0.0, ge=0, lt=1.0, description="side of a marker; none on a chessboard")
    margin_m: float = Field(0.0, ge=0, description="white paper around the print")
    legacy: bool = False

    @model_validator(mode="after")
    def _of_its_kind(self) -> BoardFacts:
        if self.kind == "chessboard" and (self.marker_m or self.first_id or self.legacy):
            raise ValueError("kind is 'chessboard', which has no marker_m, first_id or legacy; take them out")
        if self.kind == "chessboard" and min(self.squares) < FEWEST_SQUARES:
            raise ValueError(f"squares is {list(self.squares)}; a chessboard needs {FEWEST_SQUARES} or more each way")
        if self.kind != "chessboard" and not SMALLEST_MARKER_M < self.marker_m < self.square_m:
            raise ValueError(
                f"marker_m is {self.marker_m:g}; expected the side of a marker, above {SMALLEST_MARKER_M:g} and below "
                f"square_m = {self.square_m:g}"
            )
        if self.kind == "grid" and self.legacy:
            raise ValueError("legacy is for kind 'charuco'; take it out")
        return self

    @model_validator(mode="before")
    @classmethod
    def _laid_out(cls, value: Any) -> Any:
        """The numbers of a named layout, scaled to the measured square."""
        if not isinstance(value, dict) or value.get("layout") is None:
            return value
        known = LAYOUTS.get(value["layout"])
        if known is None:
            raise ValueError(f"layout is {value['layout']!r}; expected {' or '.join(LAYOUTS)}")
        square_m = value.get("square_m", known["square_m"])
        scale = square_m / known["square_m"] if isinstance(square_m, int | float) else 1.0
        if not 1 / FARTHEST_SCALE < scale < FARTHEST_SCALE:
            raise ValueError(
                f"square_m is {square_m:g}; layout {value['layout']} prints {known['square_m']:g}; measure one square"
            )
        whole = {**known, "kind": "charuco", "legacy": False, "marker_m": known["marker_m"] * scale}
        said = [key for key in value if key not in MEASURED and not _same(value[key], whole.get(key))]
        if said:
            raise ValueError(f"layout {value['layout']} does not have this {said[0]}; expected only square_m beside it")
        return whole | value


def _same(stated: Any, known: Any) -> bool:
    """Whether two facts say the same: facts of a build are filled in already."""
    if isinstance(stated, float) and isinstance(known, float):
        return math.isclose(stated, known)
    return bool(stated == known or (isinstance(stated, list | tuple) and list(stated) == list(known or [])))
