"""Three spheres under an environment, as a camera sees them: mirror, matte silver and 18 % grey.

The camera is far away, light is distant, spheres neither shade each other nor stand on anything: the light alone.
"""

from __future__ import annotations

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light.environment import resize_environment
from pipeline.light.harmonics import sh9_irradiance
from pipeline.light.prediction import lookup

GREY = 0.18  # albedo of the grey sphere
MATTE_POWER = (
    30.0  # of the cosine lobe about the mirrored direction; GGX of roughness 0.5 is as wide (alpha^2 = 2 / 32)
)
LIGHT_MAP, LOBE_MAP = (64, 128), (32, 64)  # texels that are summed, and lobe directions that are kept


def disc(size: int, world_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (size, size, 3) of a sphere, world frame, NaN outside it, and the unit direction (3,) to the camera."""
    y, x = (np.mgrid[:size, :size] + 0.5) * 2 / size - 1
    square = x * x + y * y
    z = -np.sqrt(np.where(square <= 1, 1 - square, np.nan))
    normals = np.stack([np.where(square <= 1, x, np.nan), np.where(square <= 1, y, np.nan), z], -1)
    rotation = world_from_camera[:3, :3]
    return normals @ rotation.T, -rotation[:, 2]


def mirrored(normals: np.ndarray, to_camera: np.ndarray) -> np.ndarray:
    """Directions (..., 3) seen by reflection at normals (..., 3) from ``to_camera`` (3,)."""
    return 2 * (normals @ to_camera)[..., None] * normals - to_camera


def widened(environment: np.ndarray, power: float = MATTE_POWER) -> np.ndarray:
    """Map (32, 64, C) of the mean of an environment (H, W, C) over lobes ``cos^power`` about each direction."""
    light = resize_environment(environment, *LIGHT_MAP)
    ways = latlong_directions(*LOBE_MAP)[:, 0]
    weight = (
        np.maximum(latlong_directions(*LIGHT_MAP) @ ways.T, 0) ** power * latlong_solid_angles(*LIGHT_MAP)[..., None]
    )
    # A lobe of the next column is the same lobe turned by two columns of the light, so one lobe per row is computed.
    step = LIGHT_MAP[1] // LOBE_MAP[1]
    turned = np.stack([np.roll(light, -step * column, axis=1) for column in range(LOBE_MAP[1])])
    mean = np.einsum("ijr,vijc->rvc", weight, turned, optimize=True) / weight.sum((0, 1))[:, None, None]
    return np.asarray(mean)


def pictures(
    environment: np.ndarray, coefficients: np.ndarray, world_from_camera: np.ndarray, size: int
) -> dict[str, np.ndarray]:
    """Radiance (size, size, 3) of each sphere, zero outside, under a lat-long map and its harmonics (9, 3)."""
    normals, to_camera = disc(size, world_from_camera)
    inside = np.isfinite(normals[..., 0])
    ways = mirrored(normals[inside], to_camera)
    values = {
        "mirror": lookup(environment, ways),
        "matte silver": lookup(widened(environment), ways),
        "grey 18 %": GREY / np.pi * np.maximum(sh9_irradiance(coefficients, normals[inside]), 0),
    }
    shown = {}
    for name, value in values.items():
        shown[name] = np.zeros((size, size, 3), np.float32)
        shown[name][inside] = value
    return shown
