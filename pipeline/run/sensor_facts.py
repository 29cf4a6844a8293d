"""What capture.toml says of a sensor whose files say too little, or the wrong thing. Imports no numpy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipeline.run.strict import Coordinate, Length, Share, Strict

Matrix3 = tuple[tuple[Coordinate, Coordinate, Coordinate], ...]


class SensorFacts(Strict):
    """Facts of the sensor that files lack or state wrongly; what is given here replaces the file's."""

    files: list[str] = Field(min_length=1, description="RAW files or globs, relative to root")
    color_matrix: Matrix3 | None = Field(
        None, min_length=3, max_length=3, description="3 rows of 3, camera_rgb from XYZ, as DNG ColorMatrix1"
    )
    illuminant: int | None = Field(None, ge=0, le=255, description="of color_matrix: EXIF LightSource, 21 is D65")
    as_shot_neutral: tuple[Length, Length, Length] | None = Field(None, description="camera_rgb of a neutral surface")
    black: float | list[Coordinate] | None = Field(
        None, description="DN: one number, the four of the CFA cell in rows, or three of R, G, B"
    )
    white: Length | None = Field(None, description="DN at which the sensor clips")
    linear_limit: Share | None = Field(None, gt=0.05, description="share of white - black up to which it is linear")
    encoding: Literal["linear", "display"] | None = Field(
        None, description="of a picture that is no RAW: proportional to light, or through a curve that is recovered"
    )
    space: Literal["linear_rec709", "linear_p3", "linear_rec2020", "linear_adobe_rgb", "acescg"] | None = Field(
        None, description="primaries of a picture that is no RAW"
    )
    bad_pixels: str | None = Field(
        None, description="text file, .gz or not: row column, or dcraw's column row time; relative to capture.toml"
    )

    @model_validator(mode="after")
    def _sensible(self) -> SensorFacts:
        if isinstance(self.black, list) and len(self.black) not in (3, 4):
            raise ValueError(f"black has {len(self.black)} numbers; expected one, three (R, G, B) or four (CFA cell)")
        if self.color_matrix is None and self.illuminant is not None:
            raise ValueError("illuminant says under which light color_matrix holds; give both or take it out")
        levels = [] if self.black is None else self.black if isinstance(self.black, list) else [self.black]
        if self.white is not None and levels and max(levels) >= self.white:
            raise ValueError(f"black {max(levels):g} is not below white {self.white:g}")
        return self
