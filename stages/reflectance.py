"""Albedo of the plane: the plate's radiance over the light that the probe saw (equations 6 to 8).

The plate is read at every texel of the modelled rectangle through the lens; texels that the plate does not show, or
shows clipped, continue their surroundings and are marked in ``seen``. Limits: diffuse, one convex plane under distant
light (one step of the iteration is exact); shadows in the plate are taken for albedo, which the ratio composite undoes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import ACESCG, CLIPPED, invert_rigid, transform_points
from pipeline.light.environment import irradiance
from pipeline.light.sampling import bilinear, planes
from pipeline.run import artifacts as A
from pipeline.run.errors import NumericalError
from pipeline.run.stage import Stage
from pipeline.transport.reflectance import fill_unseen, updated_brdf
from pipeline.types import Camera, Plane, Proxy, Raster, Result, Surface, View
from stages import knobs

MAX_SUPERSAMPLE = 2


def texel_centres(plane: Plane, height: int, width: int, splits: int) -> np.ndarray:
    """World points (splits^2, H, W, 3) of the sub-texels of a texture over the plane's corners (row 0 at corner 0)."""
    step = (np.arange(splits) + 0.5) / splits
    u = (np.arange(width) + step[:, None]) / width
    v = (np.arange(height) + step[:, None]) / height
    along_u, along_v = plane.corners_m[1] - plane.corners_m[0], plane.corners_m[3] - plane.corners_m[0]
    points = plane.corners_m[0] + v[:, None, :, None, None] * along_v + u[None, :, None, :, None] * along_u
    return points.reshape(splits * splits, height, width, 3)


def read_plate(plate: Raster, camera: Camera, view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plate radiance (H, W, 3) averaged over the sub-texels (S, H, W, 3), and the share of them that is seen (H, W)."""
    rgb = plate.rgb()
    usable = np.all(np.isfinite(rgb), -1) & ((plate["mask"] & CLIPPED) == 0)
    picture = planes(np.concatenate([np.where(usable[..., None], rgb, 0.0), usable[..., None]], -1))
    camera_from_world = invert_rigid(view.world_from_camera)
    total = np.zeros((*points.shape[1:3], 4))
    for sub in points:
        px = project(camera, transform_points(camera_from_world, sub.reshape(-1, 3))).reshape(*sub.shape[:2], 2)
        inside = np.all((px >= 0) & (px <= (camera.width, camera.height)), -1)  # False for NaN: not imaged
        px = np.where(inside[..., None], px, 0.0)
        total += np.where(inside[..., None], bilinear(picture, px[..., 0], px[..., 1]), 0.0)
    seen = total[..., 3]
    return total[..., :3] / np.maximum(seen, 1e-6)[..., None], seen / len(points)


def compute(
    photographs: dict[str, Raster],
    camera: Camera,
    views: dict[str, View],
    environment: Raster,
    plane: Plane,
    proxies: list[Proxy],
    params: knobs.Reflectance,
) -> Result:
    """Albedo texture, ACEScg. Raises NumericalError when no light arrives or the plate does not show the plane."""
    plate, view = photographs["plate"], views["plate"]
    light = irradiance(environment.rgb(), plane.normal[None])[0]
    if not np.all(light > 0):
        raise NumericalError(
            f"environment: irradiance on the plane is {light}, needed > 0; the probe saw no light from above"
        )
    size = np.linalg.norm(plane.corners_m[[1, 3]] - plane.corners_m[0], axis=1)
    width, height = np.maximum(1, np.round(params.texture_px * size / size.max())).astype(int)
    distance = np.linalg.norm(view.world_from_camera[:3, 3] - plane.corners_m.mean(0))
    pixels_per_texel = camera.fx / distance * size.max() / params.texture_px
    splits = int(np.clip(np.ceil(pixels_per_texel), 1, MAX_SUPERSAMPLE))
    l_r1, seen = read_plate(plate, camera, view, texel_centres(plane, height, width, splits))
    if seen.max() < 0.5:
        raise NumericalError(
            "plate: shows none of the modelled rectangle; check the board's pose and the object positions"
        )
    measured = np.pi * updated_brdf(l_r1, light)
    whole = np.where(seen > 0.5, seen, 0.0)
    if params.model == "uniform":
        measured = np.broadcast_to(np.median(measured[seen > 0.5], axis=0), measured.shape)
        albedo = measured
    else:
        albedo = fill_unseen(measured, np.minimum(whole, 1.0))
    numbers, warnings = judge(measured[seen > 0.5], light, albedo)
    numbers["texel_mm"] = float(1e3 * size.max() / params.texture_px)
    numbers["seen_fraction"] = float((seen > 0.5).mean())
    raster = Raster({**Raster.split(np.clip(albedo, 0.0, 0.98)), "seen": seen}, ACESCG, {"insitu:unit": "albedo"})
    return Result(
        {"albedo": raster, "surface": Surface(), "local_proxies": proxies}, numbers, warnings, evidence(params.model)
    )


def judge(measured: np.ndarray, light: np.ndarray, albedo: np.ndarray) -> tuple[dict[str, Any], list[str]]:
    """Numbers, and a warning when the albedo leaves [0, 1]: then probe and plate disagree about the light's scale."""
    above = float((measured > 1).any(-1).mean())
    below = float((measured < 0).any(-1).mean())
    numbers: dict[str, Any] = {
        "irradiance": light,
        "albedo_median": np.median(measured, axis=0),
        "albedo_p99": np.quantile(measured, 0.99, axis=0),
        "above_one_fraction": above,
        "below_zero_fraction": below,
        "limited_texels": int(((albedo < 0) | (albedo > 0.98)).any(-1).sum()),
    }
    warnings = []
    if above > 0.01:
        scale = float(np.quantile(measured, 0.99))
        warnings.append(
            f"albedo: {above:.1%} of the seen texels exceed 1 (99 % quantile {scale:.2f}), needed <= 1; the probe is "
            f"too dark by up to {scale:.2f} x: check the ball's reflectance, clipped lights, and exposure between "
            "plate and ball"
        )
    return numbers, warnings


def evidence(model: str) -> list[dict[str, Any]]:
    """What was modelled of the surface, and why."""
    return [
        {
            "term": "texture",
            "modelled": model == "textured",
            "because": f"knob reflectance.model = {model}",
            "could_cost": "wrong reflections of the ground in shiny objects",
        },
        {
            "term": "inter-reflection of the ground with itself",
            "modelled": False,
            "because": "one convex plane: no point of it sees another",
            "could_cost": "0 for a plane",
        },
        {
            "term": "specular lobe of the ground",
            "modelled": False,
            "because": "no evidence is gathered for it yet",
            "could_cost": "missing mirror image of the objects on a glossy table",
        },
    ]


STAGE = Stage(
    "reflectance",
    compute,
    knobs.Reflectance,
    inputs={
        "photographs": A.PHOTOGRAPHS,
        "camera": A.CAMERA,
        "views": A.VIEWS,
        "environment": A.ENVIRONMENT,
        "plane": A.PLANE,
        "proxies": A.PROXIES,
    },
    outputs={"albedo": A.ALBEDO, "surface": A.SURFACE, "local_proxies": A.LOCAL_PROXIES},
)
