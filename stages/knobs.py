"""Every knob of every stage with its default, range and meaning, and the presets that set several.

Here rather than in the rooms so that a wrong scene.toml is refused without importing numpy. A stage's digest holds the
values it was given, not this file.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    """Base of the knobs of one stage: immutable, unknown names refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Ingest(Params):
    """No knobs: the manifest says it all."""


class Merge(Params):
    """Merging brackets."""

    frames: Literal["all", "second", "extremes"] = Field(
        "all", description="of a bracket: all, every second, or the shortest and the longest"
    )
    weights: Literal["poisson", "optimal"] = Field("optimal", description="per-sample weights")
    align: Literal["auto", "always", "never"] = Field(
        "auto",
        description="frames of a view brought onto each other: where they lie a pixel apart, or always, or never",
    )
    estimate_exposures: bool = Field(True, description="estimate exposure ratios instead of trusting labels")
    noise: Literal["stated", "measured"] = Field(
        "stated", description="[[noise]] or NoiseProfile, or what the frames show, where both are there"
    )


class Develop(Params):
    """From mosaic to ACEScg."""

    demosaic: Literal["bilinear", "malvar", "menon"] = Field("malvar", description="demosaicking method")


class Balance(Params):
    """No knobs: the references are facts."""


class Sources(Params):
    """Which source of pose and lens is good enough."""

    cloud: Literal["auto", "always", "never"] = Field(
        "auto", description="orient further views: when cheaper sources leave too much, or always, or never"
    )
    contact_px: float = Field(
        0.5, gt=0, description="uncertainty where objects stand, up to which a cheaper source is taken [px]"
    )


class Sfm(Params):
    """Structure from motion over further views."""

    method: Literal["incremental", "global"] = Field("incremental", description="COLMAP's mapper; global is for many")


class Calibrate(Params):
    """Intrinsics from board photographs."""

    max_rms_px: float = Field(1.0, gt=0, description="refuse a calibration with a larger residual [px]")
    distortion: Literal["auto", "always", "never"] = Field(
        "auto", description="terms of a lens that is fitted: those that held-out photographs gain by, all, or none"
    )


class Pose(Params):
    """Pose of every view."""

    corner_sigma_px: float = Field(0.1, gt=0, description="standard uncertainty of a corner, where no board tells [px]")
    min_ambiguity: float = Field(4.0, gt=1, description="refuse when the second pose fits within this chi2 ratio")


class Probe(Params):
    """From photographs of a probe to an environment map."""

    width: int = Field(1024, ge=64, le=8192, description="width of the lat-long [px]; its height is half")
    supersample: int = Field(
        3, ge=1, le=16, description="samples per texel and axis of maps and panoramas; a ball is summed exactly"
    )
    rim: float = Field(
        0.999, gt=0.5, lt=1, description="outermost radius that may be used, as a fraction of the ball's"
    )
    recover: Literal["auto", "never"] = Field(
        "auto", description="flux of lamps that clip in every frame: solved for where something answers to it, or left"
    )
    near_budget: float = Field(
        0.02, ge=0, le=1e6, description="error of irradiance at the objects beyond which [room] moves the map to them"
    )


class Lights(Params):
    """Compact lights of the environment."""

    min_share: float = Field(0.02, ge=0.001, le=1, description="least share of the light to be told from sky")
    max_half_angle_deg: float = Field(10.0, gt=0, le=45, description="wider lights stay in the sky [degrees]")
    width: Literal["unblurred", "seen"] = Field(
        "unblurred", description="lamps without what the probe's picture spread them, or as wide as it shows them"
    )


class Plane(Params):
    """The local scene's plane."""

    left_out: float = Field(
        0.004, gt=0, le=0.1, description="change of light that may end at the modelled rectangle, as a fraction"
    )
    extent: float = Field(40.0, ge=1, description="most half size of the rectangle in radii of the objects")
    find_proxies: Literal["evidence", "always", "never"] = Field(
        "evidence", description="flat surfaces found in the cloud: modelled where objects change them, all, or none"
    )


class Reflectance(Params):
    """Albedo of the local scene."""

    model: Literal["uniform", "textured"] = Field("textured", description="albedo model of the plane")
    route: Literal["ratio", "gradient"] = Field(
        "ratio", description="albedo by equation 8, or refined by differentiable rendering (slow)"
    )
    gloss: Literal["auto", "always", "never"] = Field(
        "auto", description="specular lobe of the plane: if held-out cells ask for it, the likeliest, or none"
    )
    texture_px: int = Field(1024, ge=16, le=8192, description="size of the albedo texture [px]")


class Render(Params):
    """With and without the objects."""

    strategy: Literal["difference", "reference"] = Field("difference", description="the change itself, or two renders")
    samples: int = Field(48, ge=1, le=65536, description="most samples per pixel; up to four times as many on objects")
    depth: int = Field(6, ge=2, le=64, description="longest path [vertices]")
    materials: Literal["conserving", "gltf"] = Field(
        "conserving", description="glTF materials that keep all light, or as appendix B of glTF words them"
    )
    threshold: float = Field(0.004, ge=0, le=0.05, description="change below this fraction is left to the plate")
    denoise: bool = Field(True, description="denoise the object layer and the relative change")
    softness_px: float | None = Field(
        None, ge=0, le=20, description="of the plate, lens and pixel as a Gaussian [px]; default: by the print it shows"
    )
    light_groups: bool = Field(False, description="layers of every light alone: sky, sun, lamps")
    seed: int = Field(0, ge=0, description="seed of the sampler")


class Composite(Params):
    """Putting it together."""

    kind: Literal["additive", "ratio", "auto"] = Field("auto", description="equation 4, 5, or chosen per pixel")
    view: str = Field("ACES 2.0 - SDR 100 nits (Rec.709)", description="OCIO view of the display picture")
    display: str = Field("sRGB - Display", description="OCIO display")
    look: str = Field("", description="OCIO look or looks of the display picture; empty takes the view's own")
    exposure_ev: float = Field(0.0, ge=-20, le=20, description="over automatic display exposure [EV]")
    half: bool = Field(False, description="store the factor on the plate (mul) as 16-bit floats")


class Uncertainty(Params):
    """How far each pixel can be trusted."""

    pixels: int = Field(4000, ge=100, le=1_000_000, description="most pixels that are traced for a wrong light")
    samples: int = Field(8, ge=4, le=4096, description="samples of each of them")
    share: float = Field(0.01, ge=0, lt=1, description="of the variance: errors that stay below together are left out")


class Evaluate(Params):
    """Error against truth, prediction without it."""

    pixels_per_degree: float = Field(67.0, gt=0, description="viewing condition of FLIP [px/deg]")


class Report(Params):
    """The page."""


KNOBS: dict[str, type[Params]] = {
    "ingest": Ingest, "merge": Merge, "develop": Develop, "balance": Balance, "sources": Sources, "sfm": Sfm,
    "calibrate": Calibrate, "pose": Pose, "probe": Probe, "lights": Lights, "plane": Plane, "reflectance": Reflectance,
    "render": Render, "composite": Composite, "uncertainty": Uncertainty, "evaluate": Evaluate, "report": Report,
}  # fmt: skip

# What each preset changes from the defaults above: points of the front of the run that docs/trade/desk.json names.
PRESETS: dict[str, dict[str, dict[str, object]]] = {
    "draft": {
        "merge": {"weights": "poisson"}, "develop": {"demosaic": "bilinear"}, "probe": {"width": 512, "supersample": 2},
        "plane": {"left_out": 0.008, "find_proxies": "never"}, "reflectance": {"texture_px": 512},
        "render": {"samples": 8, "depth": 4, "threshold": 0.008},
    },
    "preview": {},
    "final": {
        "develop": {"demosaic": "menon"}, "probe": {"width": 2048, "supersample": 4},
        "plane": {"left_out": 0.001}, "reflectance": {"texture_px": 2048},
        "render": {"samples": 512, "depth": 10, "threshold": 0.001},
    },
}  # fmt: skip
