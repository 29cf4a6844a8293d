"""What every table of a manifest is made of: strict models, and numbers that are checked."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Rgb = tuple[float, float, float]
Matrix4 = list[list[float]]
Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Metal = Literal["aluminium", "brass", "chromium", "copper", "gold", "iron", "silver"]  # of transport/conductors.py


class Strict(BaseModel):
    """Immutable; unknown keys, and numbers that are not finite, refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
