"""Mirror ball to lat-long map: error of irradiance and of the sun's energy, and time, for us and for peers.

    .venv/bin/python -m benchmarks.probe_unwrap

A ball of known place is drawn pixel by pixel from a smooth sky and a sun of 0.53 degrees, 1e5 times as bright as the
sky, at 60, 120, 145 and 165 degrees from the direction to the camera, as far as the rim's cut allows; what lies beyond
it counts for nobody. Every method gets the same picture and the true centre and radius, and makes a map of 1024 x 512.

- ``ours``: splat; ``ours, as photographed``: never enlarged; where they are the same, the first alone.
- ``orthographic``: one bilinear lookup per texel under an infinitely far camera (`cv2.remap`), the usual way.
- ``skylibs``: the same with that library, from an environment of its own:
  ``python3 -m venv .skylibs && .skylibs/bin/pip install skylibs``; left out when there is none.

`sh_rel_err`: largest difference of irradiance over 200 normals, from orders 0 to 2, over the mean irradiance.
`sun_rel_err`: what the map holds within 1 degree and 4 pixels or texels of the sun, less the sky, over the sun's.
`split_sh_rel_err`: `sh_rel_err` of the sky alone, as when the sun is split out.
Times are of the unwrap alone, warm, the better of two.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import direction_from_latlong, latlong_directions, latlong_solid_angles
from pipeline.light.harmonics import sh9_basis, sh9_irradiance
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.ball_surface import Surface
from pipeline.probes.finding import Found
from pipeline.probes.mirror_ball import view_map
from pipeline.probes.mirror_geometry import Mirror
from pipeline.probes.observation import Grid
from pipeline.probes.reflection import deviation, directions_from_rays
from pipeline.probes.sphere_fit import Height, SphereFit
from pipeline.probes.unwrap import enlargement, unwrap
from pipeline.types import Camera, Raster, View

RADIUS_M = 0.04
WIDTH = 1024
SUN_HALF_ANGLE, SUN_RADIANCE = np.radians(0.53 / 2), 1e5
SUN_ANGLES_DEG = (60.0, 120.0, 145.0, 165.0)
RIM_PX = 2.0  # of the ball's edge that no method may use
PEER = Path(".skylibs/bin/python")
PEER_SCRIPT = """
import sys, time, numpy as np
from envmap import EnvironmentMap
picture = np.load(sys.argv[1])
times = []
for _ in range(2):
    start = time.perf_counter(), time.process_time()
    found = EnvironmentMap(picture, "sphere").convertTo("latlong", int(sys.argv[3]))
    times.append((time.perf_counter() - start[0], time.process_time() - start[1]))
x, y, z, _ = found.worldCoordinates()
np.savez(sys.argv[2], rgb=found.data, directions=np.stack([x, -y, z], -1), solid=found.solidAngles(), times=times)
"""


def ball(radius_px: float, distance_over_radius: float, off_axis_deg: float = 0.0) -> Mirror:
    """A ball in the middle of a square picture that just holds it, turned against the world."""
    ratio = 1 / distance_over_radius
    size = int(2 * radius_px) + 8
    focal = radius_px / np.tan(np.arcsin(ratio))
    turn = np.radians(off_axis_deg)
    axis = np.array([np.sin(turn), 0, np.cos(turn)])
    camera = Camera(
        width=size, height=size, fx=focal, fy=focal, cx=size / 2 - focal * np.tan(turn), cy=size / 2,
        distortion=np.zeros(5),
    )  # fmt: skip
    rotation, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    return Mirror(camera, rotation, axis * RADIUS_M / ratio, RADIUS_M, 1 - RIM_PX / radius_px)


def sky(w: np.ndarray) -> np.ndarray:
    """Radiance (...) of the smooth part in camera-frame directions (..., 3)."""
    x, y, z = np.moveaxis(w, -1, 0)
    return 1 + 0.5 * x - 0.4 * y + 0.3 * z + 0.2 * x * z + 0.1 * np.sin(3 * y)


def traced(mirror: Mirror, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mirrored directions (N, 3), camera frame, of pixels (N, 2), and whether they show the ball."""
    camera = mirror.camera
    rays = np.concatenate([(px - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((len(px), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    w = directions_from_rays(rays, mirror.centre, mirror.radius)
    return w, np.isfinite(w[:, 0])


def lit(mirror: Mirror, w: np.ndarray) -> np.ndarray:
    """Whether directions (..., 3) are inside the cut at the rim: what counts."""
    return -(w @ mirror.axis) > np.cos(deviation(np.array(mirror.rim), mirror.ratio))


def sky_picture(mirror: Mirror) -> np.ndarray:
    """(h, w) photograph of the ball under the sky, at pixel centres."""
    camera = mirror.camera
    picture = np.zeros((camera.height, camera.width), np.float32)
    x = np.arange(camera.width) + 0.5
    for row in range(camera.height):
        w, seen = traced(mirror, np.stack([x, np.full_like(x, row + 0.5)], -1))
        picture[row] = np.where(seen, sky(w), 0)
    return picture


def sun_picture(mirror: Mirror, sun: np.ndarray) -> np.ndarray:
    """(h, w) photograph of the sun alone: means over pixels of about two million rays in all."""
    camera = mirror.camera
    picture = np.zeros((camera.height, camera.width), np.float32)
    step = 8 if camera.width > 1000 else 4
    y, x = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    coarse, _ = traced(mirror, np.stack([x.ravel(), y.ravel()], -1) + 0.5 * step)
    best = np.nan_to_num(coarse @ sun, nan=-2).argmax()
    half = int(24 + 0.06 * camera.width / 2)  # beside the rim the sun is drawn out along it
    rows, columns = (
        np.arange(max(0, middle - half), min(size, middle + half))
        for middle, size in ((y.ravel()[best], camera.height), (x.ravel()[best], camera.width))
    )
    hit = _hits(mirror, sun, rows, columns, 8) > 0
    rows, columns = (
        lines[max(0, seen[0] - 1) : seen[-1] + 2]
        for lines, seen in ((rows, np.flatnonzero(hit.any(1))), (columns, np.flatnonzero(hit.any(0))))
    )
    split = int(np.sqrt(2e6 / (len(rows) * len(columns))))
    picture[np.ix_(rows, columns)] = SUN_RADIANCE * _hits(mirror, sun, rows, columns, split)
    return picture


def _hits(mirror: Mirror, sun: np.ndarray, rows: np.ndarray, columns: np.ndarray, split: int) -> np.ndarray:
    """Share (N, M) of pixels that shows the sun."""
    steps = (np.arange(split) + 0.5) / split
    fine = np.meshgrid((columns[:, None] + steps).ravel(), (rows[:, None] + steps).ravel())
    w, seen = traced(mirror, np.stack(fine, -1).reshape(-1, 2))
    hit = seen & (w @ sun > np.cos(SUN_HALF_ANGLE))
    return hit.reshape(len(rows), split, len(columns), split).mean((1, 3))


def ours(factor: int | None) -> Callable[[Mirror, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Radiance, directions in the camera's frame and solid angle of our map's texels."""

    def run(mirror: Mirror, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = unwrap(np.ones_like(picture), [picture], mirror, WIDTH // 2, WIDTH, factor)
        return (
            found.values[..., 0] * found.coverage,
            latlong_directions(WIDTH // 2, WIDTH) @ mirror.rotation.T,
            texel_areas(),
        )

    return run


def texel_areas() -> np.ndarray:
    """(H, W) steradian."""
    return latlong_solid_angles(WIDTH // 2, WIDTH)


def orthographic(mirror: Mirror, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One lookup per texel: the radius in the picture is sin(theta / 2) of the silhouette's; camera's frame."""
    w = latlong_directions(WIDTH // 2, WIDTH)
    middle, size = 0.5 * picture.shape[0], mirror.camera.fx * np.tan(np.arcsin(mirror.ratio))
    half = np.sqrt(np.maximum(0.5 * (1 + w[..., 2]), 1e-12))  # sin(theta / 2), theta from -z
    along = 0.5 * size / np.sqrt(np.maximum(1 - half**2, 1e-12))
    found = bilinear(planes(picture), middle + along * w[..., 0], middle + along * w[..., 1])[..., 0]
    return np.where(lit(mirror, w), found, 0), w, texel_areas()


def skylibs(mirror: Mirror, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
    """The library's own conversion, in its own process; also its times."""
    margin = 4
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npy", Path(folder) / "out.npz"
        np.save(source, np.repeat(picture[margin:-margin, margin:-margin, None], 3, -1).astype(np.float32))
        subprocess.run([str(peer()), "-c", PEER_SCRIPT, str(source), str(target), str(WIDTH // 2)], check=True)
        found = np.load(target)
        wall, cpu = found["times"].min(0)
        w = found["directions"]
        rgb = np.where(lit(mirror, w), found["rgb"][..., 0], 0)
        return rgb, w, np.nan_to_num(found["solid"]), float(wall), float(cpu)


def peer() -> Path:
    """Python that has skylibs; INSITU_SKYLIBS overrides."""
    return Path(os.environ.get("INSITU_SKYLIBS", PEER))


def coefficients(rgb: np.ndarray, w: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """(9, 1) of a map in any frame."""
    return np.einsum("hwk,hw->k", sh9_basis(w), np.nan_to_num(rgb) * solid)[:, None]


def sky_truth(mirror: Mirror) -> np.ndarray:
    """(9, 1) of the sky, by integration on rings about the axis that end where the light does."""
    end = float(deviation(np.array(mirror.rim), mirror.ratio))
    node, weight = np.polynomial.legendre.leggauss(200)
    cosine = 0.5 * ((1 - np.cos(end)) * node + 1 + np.cos(end))
    phi = 2 * np.pi * np.arange(400) / 400
    first = np.linalg.svd(mirror.axis[None])[2][1]
    frame = np.stack([first, np.cross(mirror.axis, first), -mirror.axis])
    sine = np.sqrt(1 - cosine**2)[:, None]
    w = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine[:, None] + 0 * phi], -1) @ frame
    share = weight[:, None] * 0.5 * (1 - np.cos(end)) * 2 * np.pi / 400 + 0 * phi
    return coefficients(sky(w), w, share)


def sun_direction(mirror: Mirror, angle_deg: float) -> np.ndarray:
    """(3,) camera frame, ``angle_deg`` from the direction to the camera, off the pixel grid's axes."""
    first = np.cross(mirror.axis, (0.3, 1.0, 0.1))
    first /= np.linalg.norm(first)
    angle = np.radians(angle_deg)
    return -np.cos(angle) * mirror.axis + np.sin(angle) * first


def suns(mirror: Mirror) -> list[float]:
    """Angles of the suns that lie inside the cut by 2 degrees."""
    end = float(np.degrees(deviation(np.array(mirror.rim), mirror.ratio)))
    return [angle for angle in SUN_ANGLES_DEG if angle < end - 2]


def irradiance_error(found: np.ndarray, true: np.ndarray) -> float:
    """Largest difference over 200 normals, over the mean irradiance."""
    golden = np.arange(200) + 0.5
    normals = direction_from_latlong(golden * 0.6180339887 % 1, np.arccos(1 - golden / 100) / np.pi)
    one, two = (sh9_irradiance(c, normals) for c in (found, true))
    return float(np.abs(one - two).max() / np.abs(two.mean()))


def measured(mirror: Mirror, radius_px: float, pictures: dict[float, np.ndarray], name: str, run: Callable) -> dict:
    """One row: worst of the suns."""
    flux = SUN_RADIANCE * 2 * np.pi * (1 - np.cos(SUN_HALF_ANGLE))
    truth, rows = sky_truth(mirror), []
    bare = coefficients(*run(mirror, pictures[0.0])[:3])
    for angle in (a for a in pictures if a):
        start = time.perf_counter(), time.process_time()
        rgb, w, solid, *times = run(mirror, pictures[angle])
        wall, cpu = times or (time.perf_counter() - start[0], time.process_time() - start[1])
        sun = sun_direction(mirror, angle)
        total = truth + flux * sh9_basis(sun)[:, None]
        near = w @ sun > np.cos(np.radians(1) + 4 * max(2 / radius_px / np.cos(np.radians(angle / 2)), np.pi / 512))
        over = np.sum(np.where(near, np.nan_to_num(rgb) - np.where(lit(mirror, w), sky(w), 0), 0) * solid)
        rows.append((irradiance_error(coefficients(rgb, w, solid), total), over / flux - 1, cpu, wall))
    errors = np.array(rows)
    return {
        "radius_px": radius_px, "distance_over_radius": round(1 / mirror.ratio), "method": name,
        "sh_rel_err": float(errors[:, 0].max()), "split_sh_rel_err": irradiance_error(bare, truth),
        "sun_rel_err": float(np.abs(errors[:, 1]).max()), "cpu_s": float(errors[:, 2].min()),
        "wall_s": float(errors[:, 3].min()), "suns_deg": [a for a in pictures if a],
    }  # fmt: skip


CELLS = ((100.0, 8.0), (200.0, 8.0), (500.0, 8.0), (1500.0, 8.0), (100.0, 1000.0), (500.0, 1000.0))


def rows(cells: tuple[tuple[float, float], ...] = CELLS) -> list[dict]:
    """Ours and the peers over cells of radius [px] and distance over radius."""
    found = []
    for radius_px, distance in cells:
        mirror = ball(radius_px, distance)
        base = sky_picture(mirror)
        pictures = {0.0: base}
        pictures |= {a: base + sun_picture(mirror, sun_direction(mirror, a)) for a in suns(mirror)}
        runs: dict[str, Any] = {"ours": ours(None), "orthographic": orthographic}
        if enlargement(mirror, WIDTH) > 1:
            runs["ours, as photographed"] = ours(1)
        if peer().exists():
            runs["skylibs"] = skylibs
        for name, run in runs.items():
            found.append(measured(mirror, radius_px, pictures, name, run))
    return found


def unwrap_s_24mpx(repeats: int = 3) -> dict[str, float]:
    """Wall and processor seconds, warm, of one view's map, 2048 x 1024, from a ball of 1500 px in 6000 x 4000 px.

    All of it: radiance, variance, coverage and weights from a photograph in memory. The best of ``repeats``.
    """
    ratio, radius_px = 1 / 8, 1500.0
    focal = radius_px / np.tan(np.arcsin(ratio))
    distortion = np.array([-0.05, 0.01, 0, 0, 0])
    camera = Camera(width=6000, height=4000, fx=focal, fy=focal, cx=3000, cy=2000, distortion=distortion)
    centre = np.array([0.0, 0.0, RADIUS_M / ratio])
    fit = SphereFit(centre, np.diag([1e-10, 1e-10, 1e-9]), 0.1, 500, radius_px, 0.3, 1.0, 5.0, 1.0)
    found = Found(fit, fit, Height(np.array([0.0, -1.0, 0.0]), 0.0, 1e-4), centre)
    view = View(world_from_camera=np.eye(4), covariance=1e-8 * np.eye(6), route="given", rms_px=0.1, points=20)
    radiance = np.random.default_rng(0).random((4000, 6000, 3), np.float32)
    photograph = Raster(
        {
            **Raster.split(radiance),
            **Raster.split(1e-4 * radiance, "variance"),
            "mask": np.zeros((4000, 6000), np.uint32),
        },
        "acescg",
    )
    surface, best = Surface(np.full(3, 0.6), np.full(3, 0.02)), []
    for _ in range(repeats + 1):
        start = time.perf_counter(), time.process_time()
        view_map(photograph, camera, view, found, RADIUS_M, surface, Grid(2048))
        best.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    wall, cpu = np.min(best[1:], 0)
    return {"unwrap_s_24mpx": float(wall), "unwrap_cpu_s_24mpx": float(cpu)}


if __name__ == "__main__":
    for row in [*rows(), unwrap_s_24mpx()]:
        sys.stdout.write(json.dumps({k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}) + "\n")
