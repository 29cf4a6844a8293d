"""One row per file of a build: its name, kind, meaning, unit and colour space. Stages meet here and nowhere else."""

from __future__ import annotations

from typing import Any

from pipeline.conventions import ACESCG, RADIANCE_UNIT
from pipeline.run.stage import STATED, Artifact
from pipeline.types import (
    Balance,
    BallFit,
    Bracket,
    Camera,
    Emitter,
    Frame,
    Harmonics,
    Occluder,
    Plane,
    Proxy,
    Reconstruction,
    Sources,
    Surface,
    View,
)

FACTS = Artifact("facts", "json", "capture.toml, validated, with defaults", type=dict[str, Any])
WISHES = Artifact("wishes", "json", "scene.toml, validated; files resolved, with their digests", type=dict[str, Any])
BRACKETS = Artifact("brackets", "json", "every RAW file by view, with its metadata", type=dict[str, Bracket])
BOARD_PHOTOS = Artifact(
    "board_photos", "json", "calibration photographs: file, sha256, view they calibrate", type=list[dict[str, str]]
)
VIEW_PHOTOS = Artifact("view_photos", "json", "further photographs, with their metadata", type=list[Frame])
PROXIES = Artifact("proxies", "json", "further real surfaces of the local scene: meshes, albedo", "m", type=list[Proxy])
OCCLUDERS = Artifact("occluders", "json", "real things before the objects: meshes or masks", "m", type=list[Occluder])

MOSAICS = Artifact(
    "mosaics",
    "rasters",
    "merged bracket of each view: Y, variance, mask before demosaicking (camera_rgb); of data without a mosaic R G B, "
    "variance.RGB, mask",
    RADIANCE_UNIT,
    STATED,
)
EXPOSURES = Artifact(
    "exposures",
    "json",
    "per view and frame: file, label and estimated exposure, sigma, clipped fraction",
    type=dict[str, list[dict[str, Any]]],
)
PHOTOGRAPHS = Artifact(
    "photographs",
    "rasters",
    "developed view: R G B, variance.RGB, mask; of the plate interpolation.RGB",
    RADIANCE_UNIT,
    ACESCG,
)

BALANCE = Artifact(
    "balance", "json", "gains that bring each view to the plate's exposure and colour, covariance", "1",
    type=dict[str, Balance],
)  # fmt: skip
CORRECTIONS = Artifact(
    "corrections", "cdl", "ASC CDL collection: every view's gains and their inverse; the plate made neutral, offered"
)

SOURCES = Artifact(
    "sources", "json", "what further views are needed for: nothing, lens, pose of which view; EXIF's lens by boards",
    type=Sources,
)  # fmt: skip
RECONSTRUCTION = Artifact(
    "reconstruction", "json", "poses and cloud of all photographs in a frame of its own; empty unless needed",
    type=Reconstruction,
)  # fmt: skip
CAMERA = Artifact("camera", "json", "the plate's intrinsics, distortion, covariance", "px", type=Camera)
VIEW_CAMERAS = Artifact("view_cameras", "json", "cameras of views that have their own", "px", type=dict[str, Camera])
CLOUD = Artifact(
    "cloud", "json", "poses and cloud of all photographs, adjusted with the markers, in the world; empty without", "m",
    type=Reconstruction,
)  # fmt: skip
VIEWS = Artifact("views", "json", "pose of every view with covariance", "m, rad", type=dict[str, View])

BALLS = Artifact("balls", "json", "fitted mirror ball of each ball view", "m", type=dict[str, BallFit])
ENVIRONMENT = Artifact(
    "environment",
    "raster",
    "world-oriented lat-long at the ball: R G B, variance.RGB, seen, clipped (0..1), recovered (0 or 1), raised "
    "(by what disagreement of views multiplied the variance); relative sigma that all texels share, and how far apart "
    "they err alike, in the header",
    RADIANCE_UNIT,
    ACESCG,
)
HARMONICS = Artifact(
    "harmonics", "json", "the environment's nine spherical harmonics", RADIANCE_UNIT + " sr", type=Harmonics
)
EMITTERS = Artifact(
    "emitters",
    "json",
    "compact lights as sets of texels of the lighting, strongest first; the other texels are the sky",
    RADIANCE_UNIT,
    type=list[Emitter],
)
LIGHTING = Artifact(
    "lighting",
    "raster",
    "the environment with its lamps as wide as they are, which is what renders: R G B, variance.RGB, seen; finer than "
    "the environment where lamps ask for it, and the environment itself where none was narrowed",
    RADIANCE_UNIT,
    ACESCG,
)

PLANE = Artifact("plane", "json", "plane of the local scene and its modelled rectangle", "m", type=Plane)
SURROUNDINGS = Artifact(
    "surroundings", "json", "surfaces beside the plane that are modelled: those described, and found in the cloud", "m",
    type=list[Proxy],
)  # fmt: skip
ALBEDO = Artifact("albedo", "raster", "albedo of the modelled rectangle, as a texture: R G B, seen (0..1)", "1", ACESCG)

SURFACE = Artifact(
    "surface", "json", "how the plane reflects besides its albedo, and the scores that decided", type=Surface
)

LOCAL_PROXIES = Artifact(
    "local_proxies", "json", "the proxies with their albedo, measured where it was not given", "m", type=list[Proxy]
)

LAYERS = Artifact(
    "layers",
    "raster",
    "plate-sized render: obj.RGBA premultiplied, with.RGB (LS_obj) and without.RGB (LS_noobj) of the local scene, "
    "their difference's variance, noise.change and noise.obj (RMS error left after denoising), influence (0 or 1)",
    RADIANCE_UNIT,
    ACESCG,
)
COMPOSITE = Artifact(
    "composite",
    "raster",
    "the photograph with the objects: R G B, and the layers mul, add, obj with "
    "plate * mul + add + obj = result, also per light when the render keeps them apart; guards (uint32)",
    RADIANCE_UNIT,
    ACESCG,
)
DISPLAY = Artifact("display", "picture", "composite through the display transform", "", "display")
PLATE_DISPLAY = Artifact("plate_display", "picture", "plate through the display transform", "", "display")

UNCERTAINTY = Artifact(
    "uncertainty",
    "raster",
    "standard uncertainty of the composite: sigma.RGB, its parts plate and render, of_means for sums over regions, and "
    "mode_k.RGB, the change per one sigma of each shared error",
    RADIANCE_UNIT,
    ACESCG,
)
BUDGET = Artifact(
    "budget", "json", "uncertainty by source, of pixels and of means, on objects and in shadows; what is not covered",
    "1", type=dict[str, Any],
)  # fmt: skip

METRICS = Artifact("metrics", "json", "errors against truth; empty without truth", type=dict[str, Any])
SELFCHECK = Artifact("selfcheck", "json", "predictions of what really stood there", type=dict[str, Any])
ERROR_MAP = Artifact(
    "error_map", "raster", "relative error and change error against truth: relative, change", "1", "data"
)
REPORT = Artifact("report", "page", "one self-contained page")

# Supplied by the runner: stage -> numbers, warnings, evidence, params, seconds of every earlier stage.
RECORDS = Artifact("records", "records", "what every earlier stage measured")
