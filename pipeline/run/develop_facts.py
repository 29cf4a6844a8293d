"""What capture.toml says for developing: a photographed 24-patch chart, and the lens. Imports no numpy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipeline.run.strict import Coordinate, Strict


class ChartFacts(Strict):
    """A 24-patch chart in the scene's light: gives the plate's neutral, and on request its colour matrix."""

    files: list[str] = Field([], description="photographs of its own, RAW; without them the plate shows the chart")
    corners_px: list[tuple[Coordinate, Coordinate]] | None = Field(
        None, min_length=4, max_length=4,
        description="beside dark skin, bluish green, black, white; first pixel centre at (0.5, 0.5); else it is found",
    )  # fmt: skip
    edition: Literal["before_2014", "after_2014"] = Field("after_2014", description="made before or after Nov. 2014")
    fit: Literal["neutral", "matrix"] = Field("neutral", description="what is taken from it")


class LensFacts(Strict):
    """What the plate's lens loses towards the corners."""

    name: str | None = Field(None, description="as lensfun names it, where the photographs do not say")
    flat: list[str] = Field([], description="RAW photographs of an even surface, same focal length and aperture")
    vignetting: Literal["auto", "none"] = Field(
        "auto", description="auto: flat photographs, else what the file says, else lensfun, else none"
    )

    @model_validator(mode="after")
    def _one_wish(self) -> LensFacts:
        if self.flat and self.vignetting == "none":
            raise ValueError('flat photographs are given and vignetting = "none"; take one of them out')
        return self
