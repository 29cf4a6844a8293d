"""[[noise]] of capture.toml: what is known of the sensor. Imports no numpy."""

from __future__ import annotations

from pydantic import Field, model_validator

from pipeline.run.strict import Strict


class NoiseFacts(Strict):
    """Gain, read noise and photo-response non-uniformity of the sensor at one ISO, from its maker or a bench."""

    iso: float = Field(gt=0)
    camera: str = Field("", description="as EXIF names it; needed only when the capture has several")
    electrons_at_white: float | None = Field(None, gt=0, description="between black and white level")
    electrons_per_dn: float | None = Field(None, gt=0, description="instead of electrons_at_white")
    read_noise_electrons: float = Field(ge=0, lt=1000)
    prnu: float | None = Field(None, ge=0, lt=0.1, description="relative standard deviation of the photosites' gain")
    gain_sigma_rel: float = Field(0.02, gt=0, lt=1)
    read_noise_sigma_rel: float = Field(0.05, gt=0, lt=1)
    prnu_sigma_rel: float = Field(0.1, gt=0, lt=1)

    @model_validator(mode="after")
    def _one_gain(self) -> NoiseFacts:
        if (self.electrons_at_white is None) == (self.electrons_per_dn is None):
            raise ValueError("expected either electrons_at_white or electrons_per_dn")
        return self
