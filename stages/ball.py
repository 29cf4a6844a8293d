"""Unwrap photographs of a mirror ball alone, JPEGs cropped to it, to a lat-long map: no board, no lens, no pose.

The quick look that needs nothing but the ball; `insitu run` with a capture.toml is the measurement. Limits: the curve
is recovered, not known (`pipeline.image.jpeg`); the silhouette is taken as a circle from afar
(`pipeline.probes.cropped`); the map's +Z is where the camera looks, its unit is free, its colours are the camera's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import ACESCG
from pipeline.image import jpeg
from pipeline.image.colour import convert
from pipeline.light.emitters import lights
from pipeline.probes import cropped
from pipeline.probes.mirror_geometry import Mirror
from pipeline.probes.unwrap import unwrap
from pipeline.run import formats
from pipeline.run.errors import ManifestError
from pipeline.types import Raster

RIM = 0.97  # outermost radius used, as a fraction of the outline's
LEAST_SHARE, WIDEST = 0.01, np.radians(30)  # of the lights that are listed


def exposures_of(text: str, count: int) -> list[float]:
    """Exposures in seconds from "1/20,1/60,...". Raises ManifestError."""
    try:
        found = [float(Fraction(part.strip())) for part in text.split(",")]
    except (ValueError, ZeroDivisionError) as error:
        raise ManifestError(f"--exposures: is {text!r}; expected numbers as 1/20,1/60 or 0.05") from error
    if len(found) != count or min(found) <= 0:
        raise ManifestError(f"--exposures: {text!r} has {len(found)} values; expected {count} above 0, one per file")
    return found


def ball(
    files: list[Path], out: Path, exposures: str | None, distance_ratio: float, width: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Write the map and return what was measured. Raises ManifestError, CaptureError."""
    if distance_ratio <= 1.5:
        raise ManifestError(f"--distance-ratio: is {distance_ratio:g}; expected above 1.5 (metres from the camera / R)")
    if width < 64 or width % 2:
        raise ManifestError(f"--width: is {width}; expected an even number from 64")
    frames = [jpeg.read(path) for path in files]
    if exposures is not None:
        frames = [replace(f, exposure=t) for f, t in zip(frames, exposures_of(exposures, len(frames)), strict=True)]
    merged = jpeg.merge(frames)
    circle = cropped.find_circle(merged.rgb)
    camera, centre = cropped.camera_of(circle, merged.rgb.shape, distance_ratio)
    rgb = convert(merged.rgb, "linear_rec709", "acescg")
    matrix = convert(np.eye(3), "linear_rec709", "acescg")  # rows: what each channel gives to the others
    variance = merged.variance @ matrix**2
    channels = np.concatenate([rgb, variance, merged.clipped[..., None]], -1).astype(np.float32)
    mirror = Mirror(camera, cropped.WORLD_FROM_CAMERA[:3, :3].T, centre, 1.0, RIM)
    valid = np.ones(merged.clipped.shape, np.float32)
    found = unwrap(valid, list(np.moveaxis(channels, -1, 0).copy()), mirror, width // 2, width)
    values = found.values
    environment = Raster(
        {
            **Raster.split(values[..., :3]), **Raster.split(values[..., 3:6], "variance"),
            "seen": found.coverage, "clipped": values[..., 6],
        },
        ACESCG,
        {"insitu:unit": "free", "insitu:frame": "camera: +Z is where it looks, +Y is up", "envmap": "latlong"},
    )  # fmt: skip
    formats.write_exr(out, environment)
    share = float(merged.clipped[_inside(circle, merged.clipped.shape)].mean())
    numbers = {
        "circle_px": [circle.x, circle.y, circle.radius], "outline_votes": circle.votes,
        "outline_in_frame": circle.inside, "correlations": merged.correlations, "clipped_fraction": share,
        "lamps": listed(values, found.coverage),
    }  # fmt: skip
    report(numbers, out, distance_ratio, say)
    return numbers


def _inside(circle: cropped.Circle, shape: tuple[int, ...]) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.hypot(x - circle.x, y - circle.y) < circle.radius


def listed(values: np.ndarray, coverage: np.ndarray) -> list[dict[str, Any]]:
    """Compact lights of the map: direction (3,), share of the light, and how much of each is clipped."""
    seen = np.where(coverage[..., None] > 0, values, 0)
    compact, wide = lights(seen[..., :3], LEAST_SHARE, WIDEST)
    rows = []
    for patch in sorted([*compact, *wide], key=lambda patch: -patch.share):
        clipped = seen[..., 6].ravel()[patch.texels]
        rows.append(
            {"direction": patch.direction.tolist(), "share": patch.share, "clipped_fraction": float(clipped.mean())}
        )
    return rows


def report(numbers: dict[str, Any], out: Path, distance_ratio: float, say: Callable[[str], None]) -> None:
    """The result in words."""
    x, y, radius = numbers["circle_px"]
    say(f"ball: centre ({x:.1f}, {y:.1f}), radius {radius:.1f} px; taken as {distance_ratio:g} radii away")
    if numbers["clipped_fraction"] > 0:
        say(
            f"{numbers['clipped_fraction']:.2%} of the ball is clipped in every frame: those lamps are lower bounds; "
            "add a shorter exposure or an ND filter"
        )
    for number, lamp in enumerate(numbers["lamps"], 1):
        px, py, pz = lamp["direction"]
        say(
            f"light {number}: {lamp['share']:.1%} of the light from ({px:+.2f}, {py:+.2f}, {pz:+.2f}), "
            f"{lamp['clipped_fraction']:.0%} of it clipped"
        )
    say(f"{out}")
