"""Irradiance on the plane where proxies stand: distant light that they hide, and light that they and the plane bounce.

Distant light and form factors come from `patches`, the bounced light from `radiosity` with what the plate measured. On
the plane, which is looked at closely, both are then gathered again on cells FINER times smaller than the patches, from
the patches' radiosity, and the edges of strong lights' shadows are traced at every texel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import CLIPPED, invert_rigid, transform_points
from pipeline.light.environment import irradiance
from pipeline.light.sampling import bilinear, planes
from pipeline.transport import radiosity
from pipeline.transport.patches import (
    Geometry,
    direct_irradiance,
    enlarged,
    form_factors,
    lights_of,
    point_light,
    shadow_edges,
)
from pipeline.transport.plate_texture import Texture, window_points
from pipeline.transport.reflectance import fill_unseen
from pipeline.types import Camera, Occluder, Plane, Proxy, Raster, View

POINTS = 8  # of a patch, looked up in the plate
RIM_PX = 1.0  # beside a thing in front of the plane
FINER = 4  # cells of the plane's irradiance along the side of a patch
MIN_SEEN = 0.25  # of a patch's points that the plate must show


@dataclass(frozen=True, eq=False)
class LocalLight:
    """Irradiance (h, w, 3) on a texture's window; ``shown`` (h, w): texels that nothing hides from the camera."""

    irradiance: np.ndarray
    shown: np.ndarray
    bounced: np.ndarray  # (h, w, 3) the part of it that other surfaces reflect
    proxies: list[Proxy]  # with the albedo that was measured
    estimate: radiosity.Estimate
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class PatchLight:
    """What the patches of a local scene get and show."""

    direct: np.ndarray  # (N, 3)
    factors: np.ndarray  # (N, N)
    radiosity: np.ndarray  # (N, 3), NaN where the plate does not show the patch
    likeness: np.ndarray  # (N, N) by which an unseen patch takes its albedo from others
    given: np.ndarray  # (N, 3) albedo from the capture's description, NaN where there is none


def patch_light(
    geometry: Geometry, environment: np.ndarray, plate: Raster, camera: Camera, view: View, proxies: Sequence[Proxy]
) -> PatchLight:
    """Distant light, form factors and measured radiosity of every patch."""
    patches = geometry.patches
    direct, buried = direct_irradiance(geometry, environment, lights_of(environment))
    points = patches.points(POINTS)[0]
    shown = visible(geometry, points.reshape(-1, 3), np.repeat(patches.normal, POINTS, 0), camera, view)
    rgb, usable = plate_at(plate, camera, view, points.reshape(-1, 3))
    good = (shown & usable).reshape(len(patches), POINTS)
    count = good.sum(1, keepdims=True)
    mean = np.pi * (rgb.reshape(len(patches), POINTS, 3) * good[..., None]).sum(1) / np.maximum(count, 1)
    seen = (count >= MIN_SEEN * POINTS) & np.isfinite(direct)
    centre = patches.points(1)[0][:, 0]
    square = ((centre[:, None] - centre[None]) ** 2).sum(-1)
    likeness = (patches.surface[:, None] == patches.surface[None]) / (square + np.median(patches.area))
    given = np.full((len(patches), 3), np.nan)
    for number, proxy in enumerate(proxies, 1):
        if proxy.albedo is not None:
            given[patches.surface == number] = proxy.albedo
    return PatchLight(
        np.where(np.isfinite(direct), direct, 0.0),
        form_factors(geometry) * (buried < 1)[:, None] * (buried < 1)[None],
        np.where(seen, mean, np.nan), likeness, given,
    )  # fmt: skip


def visible(geometry: Geometry, points: np.ndarray, normals: np.ndarray, camera: Camera, view: View) -> np.ndarray:
    """Whether the camera sees points (N, 3) of surfaces: they face it and nothing is between."""
    arm = view.world_from_camera[:3, 3] - points
    distance = np.linalg.norm(arm, axis=1)
    way = arm / distance[:, None]
    facing = (way * normals).sum(1) > 0
    start = points + geometry.clearance * normals
    return facing & geometry.clear(start, way, distance - 2 * geometry.clearance)


def plate_at(plate: Raster, camera: Camera, view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plate radiance (N, 3) where world points (N, 3) are imaged, and whether it is usable there (N,)."""
    rgb = plate.rgb()
    fine = np.isfinite(rgb).all(-1) & ((plate["mask"] & CLIPPED) == 0)
    picture = planes(np.dstack([np.where(fine[..., None], rgb, 0.0), fine]))
    px = project(camera, transform_points(invert_rigid(view.world_from_camera), points))
    inside = np.all((px >= 0) & (px <= (camera.width, camera.height)), -1)
    px = np.where(inside[:, None], px, 0.0)
    size = 8192  # OpenCV takes at most 32767 positions in one row
    full = np.resize(px, (-(-len(px) // size), size, 2))
    found = bilinear(picture, full[..., 0], full[..., 1]).reshape(-1, 4)[: len(px)]
    return found[:, :3], inside & (found[:, 3] > 0.999)


def local_light(
    plane: Plane, proxies: Sequence[Proxy], occluders: Sequence[Occluder], environment: np.ndarray, plate: Raster,
    camera: Camera, view: View, texture: Texture, shape: tuple[int, int],
) -> LocalLight:  # fmt: skip
    """Irradiance on the window of a texture of ``shape`` over the plane, and the albedo of the proxies."""
    from scipy.ndimage import minimum_filter

    geometry = Geometry(plane, proxies, occluders)
    light = patch_light(geometry, environment, plate, camera, view, proxies)
    found = radiosity.estimate(light.radiosity, light.direct, light.factors, light.likeness, light.given)
    points = window_points(plane, texture.window, shape)
    wanted = texture.seen > 0.5
    shown = np.zeros(wanted.shape, bool)
    chosen = points[wanted]
    shown[wanted] = visible(geometry, chosen, np.tile(plane.normal, (len(chosen), 1)), camera, view)
    rim = 2 * int(np.ceil(RIM_PX / texture.texel_px)) + 1  # texels whose pixels also hold what hides their neighbours
    shown &= minimum_filter(np.where(wanted, shown, True), rim)
    alone = irradiance(environment, plane.normal[None])[0]
    lights = lights_of(environment)
    rows, columns = (min(FINER * cells, texels) for cells, texels in zip(geometry.patches.grid, shape))
    centres = window_points(plane, (slice(0, rows), slice(0, columns)), (rows, columns))
    near = needed(shown, texture.window, shape, (rows, columns))
    radiosity_of = np.where(np.isfinite(light.radiosity), light.radiosity, found.albedo * found.irradiance)
    fine = np.full((rows, columns, 6), np.nan)
    fine[near] = np.concatenate(point_light(geometry, lights, plane.normal, alone, centres[near], radiosity_of), -1)
    fine = fill_unseen(np.nan_to_num(fine), np.isfinite(fine).all(-1).astype(float))
    everything = enlarged(fine, *shape)[texture.window]
    edges = shadow_edges(geometry, lights, plane.normal, alone, centres, points, shown, texture.window, shape)
    extra = everything[..., 3:]
    measured, warnings = measured_proxies(proxies, geometry, light, found)
    total = np.maximum(everything[..., :3] + edges, 0.0) + extra
    return LocalLight(total, shown, extra, measured, found, warnings)


def needed(shown: np.ndarray, window: tuple[slice, slice], shape: tuple[int, int], grid: tuple[int, int]) -> np.ndarray:
    """Cells of a ``grid`` over the rectangle that hold a texel of ``shown`` (h, w), or touch one that does: (R, C)."""
    from scipy.ndimage import maximum_filter

    row, column = np.nonzero(shown)
    result = np.zeros(grid, bool)
    at = [(index + part.start) * cells // size for index, part, size, cells in zip((row, column), window, shape, grid)]
    result[at[0], at[1]] = True
    return maximum_filter(result, 3)


def measured_proxies(
    proxies: Sequence[Proxy], geometry: Geometry, light: PatchLight, found: radiosity.Estimate
) -> tuple[list[Proxy], list[str]]:
    """The proxies with one albedo each, the mean over their seen area; and a warning for those that nothing shows."""
    patches = geometry.patches
    seen = np.isfinite(light.radiosity).all(1) & (found.irradiance > 0).all(1)
    result, warnings = [], []
    for number, proxy in enumerate(proxies, 1):
        here = (patches.surface == number) & seen
        if proxy.albedo is None and here.any():
            area = patches.area[here][:, None]
            albedo = (area * light.radiosity[here]).sum(0) / (area * found.irradiance[here]).sum(0)
            proxy = proxy.model_copy(update={"albedo": np.clip(albedo, 0.0, radiosity.MAX_ALBEDO)})
        elif proxy.albedo is None:
            warnings.append(
                f"proxy {proxy.name}: the plate shows none of it, so its albedo is unknown and it bounces no light; "
                "give its albedo in capture.toml"
            )
        result.append(proxy)
    return result, warnings
