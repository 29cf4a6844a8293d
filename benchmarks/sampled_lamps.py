"""How a mosaic samples the light of small lamps in a mirror ball: the law of `pipeline.light.alike.sampled`.

    .venv/bin/python -m benchmarks.sampled_lamps [SEEDS] [--folder build/sampled]

Lamps of 0.5 to 6 degrees in balls of 45 to 130 px, under lenses of `SOFT` px (with the pixel, standard deviation of a
Gaussian), through RGGB mosaics of four cameras, bilinear, unwrapped by the probe's own code. Each lamp's light in
the texels that `pipeline.light.emitters.lights` finds is compared with the truth. No photon noise, no error of pose or
fit. Prints the rms of relative errors and of errors over the stated sigma by softness and covered pixels, and the
constants that fit best. Five seeds: five minutes of one core.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.conventions import invert_rigid, latlong_directions, latlong_solid_angles, transform_points
from pipeline.image.demosaic import demosaic
from pipeline.light.alike import GREEN, sampled
from pipeline.light.emitters import lights
from pipeline.probes.ball_surface import Surface
from pipeline.probes.combine import alike_deg
from pipeline.probes.finding import Found
from pipeline.probes.mirror_ball import view_map
from pipeline.probes.observation import Grid
from pipeline.probes.sphere_fit import Height, SphereFit
from pipeline.run.cli import say
from pipeline.simulation.sensor import camera_from_acescg
from pipeline.types import Camera, Raster, View
from tests.mirror_scene import Lamp, Place, look_at, photograph, sky

SOFT = (0.55, 0.65, 0.76, 0.85)  # px
RADII, HALF_DEG = (45, 64, 90, 130), (0.5, 1.5, 3.0, 6.0)
RADIUS, CONTRAST, LAMPS = 0.04, 0.4, 7
# camera_rgb from XYZ: of four bodies of three makers, as DNG's ColorMatrix rounds them.
MATRICES = np.array(
    [
        [[0.6347, -0.0479, -0.0972], [-0.8297, 1.5954, 0.2480], [-0.1968, 0.2131, 0.7649]],
        [[0.8139, -0.2171, -0.0663], [-0.8747, 1.6541, 0.2295], [-0.1925, 0.2008, 0.8093]],
        [[0.5271, -0.0712, -0.0347], [-0.6153, 1.3653, 0.2763], [-0.1601, 0.2366, 0.7242]],
        [[0.8458, -0.2451, -0.0855], [-0.4597, 1.2447, 0.2407], [-0.1475, 0.2482, 0.6526]],
    ]
)
SMALLEST = 0.8  # px of a lamp that counts: the simulated picture itself has 8 x 8 samples to a pixel
COVERED = (6, 10, 14, 18, 25, 50, 200)
FREEDOM = 8.0  # of Student's likelihood: of 4, 6, 8, 16 that with intervals of 50, 68, 95 % all within 5 % of theirs


def tint(kelvin: float) -> np.ndarray:
    """(3,) of a black body over one of 6000 K, at 610, 540 and 460 nm."""
    metres = np.array([610.0, 540.0, 460.0]) * 1e-9
    ratio = np.expm1(0.014388 / (metres * 6000)) / np.expm1(0.014388 / (metres * kelvin))
    return np.asarray(ratio / ratio[1])


def measured(radius_px: float, half: float, soft_px: float, seed: int) -> list[list[float]]:
    """Of every lamp that is told apart: softness, its true px, covered px of green, relative errors of R, G, B."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(seed)
    pose, centre = look_at(np.array([0.2, 0.3, 0.3]), np.array([0, RADIUS, 0])), np.array([0, RADIUS, 0.0])
    away = (pose[:3, 3] - centre) / np.linalg.norm(pose[:3, 3] - centre)
    lamps: list[np.ndarray] = []
    while len(lamps) < LAMPS:
        one = random.normal(size=3)
        one /= np.linalg.norm(one)
        if one @ away > -0.3 and all(one @ other < np.cos(0.6) for other in lamps):
            lamps.append(one)
    focal = radius_px / np.tan(np.arcsin(RADIUS / np.linalg.norm(pose[:3, 3] - centre)))
    size = int(2.2 * radius_px) + 10
    middle = size / 2 + random.random(2)
    camera = Camera(width=size, height=size, fx=focal, fy=focal, cx=middle[0], cy=middle[1])
    radiance, colour = 300.0 * max(1.0, (np.radians(3) / half) ** 2), tint(random.uniform(2500, 6500))
    place = Place(sky([Lamp(tuple(d), half, radiance) for d in lamps], CONTRAST), reflectance=1.0)
    rest, lens = sky([], CONTRAST), np.sqrt(soft_px**2 - 1 / 12)
    picture = gaussian_filter(photograph(place, camera, pose, 8) * colour, (lens, lens, 0))
    camera_rgb = camera_from_acescg(MATRICES[seed % len(MATRICES)])
    camera_rgb = camera_rgb / camera_rgb.sum(1, keepdims=True)
    row, column = np.mgrid[:size, :size] % 2
    mosaic = np.take_along_axis(picture @ camera_rgb.T, (row + column)[..., None], -1)[..., 0].astype(np.float32)
    rgb = (demosaic(mosaic, "RGGB", "bilinear") @ np.linalg.inv(camera_rgb).T).astype(np.float32)
    layers = {**Raster.split(rgb), **Raster.split(1e-5 * np.abs(rgb), "variance"), "mask": np.zeros((size, size))}
    fit = SphereFit(
        centre=transform_points(invert_rigid(pose), centre), covariance=(0.02 * RADIUS / radius_px) ** 2 * np.eye(3),
        rms_px=0.05, points=400, radius_px=float(radius_px), blur_px=0.6, support=1.0, contrast=1.0, visible=1.0,
    )  # fmt: skip
    view = View(world_from_camera=pose, covariance=1e-10 * np.eye(6), route="given", rms_px=0.1, points=20)
    ball = Found(fit, fit, Height(np.array([0, -1.0, 0]), 0.0, 1e-4), centre)
    layers["mask"] = layers["mask"].astype(np.uint32)
    seen = view_map(Raster(layers, "acescg"), camera, view, ball, RADIUS, Surface(np.ones(3), np.zeros(3)), Grid(512))
    degrees = alike_deg([seen])
    assert degrees is not None
    pixel, shape = np.radians(degrees / 3) ** 2, seen.rgb.shape[:2]
    solid, ways = latlong_solid_angles(*shape), latlong_directions(*shape)
    patches, rows = lights(seen.rgb, 0.001, np.radians(14))[0], []
    for direction in lamps:
        near = [patch for patch in patches if patch.direction @ direction > np.cos(half + 0.05)]
        if len(near) != 1:
            continue
        (patch,) = near
        inside = np.zeros(shape, bool)
        inside.ravel()[patch.texels] = True
        weight = solid * np.maximum(ways @ patch.direction, 0) * inside
        under = (weight[inside][:, None] * rest(ways[inside])).sum(0)
        true = colour * (under + (radiance - rest(direction[None])[0]) * np.pi * np.sin(half) ** 2)
        light = weight * seen.rgb[..., 1]
        covered = light.sum() ** 2 / (light**2 / solid).sum() / pixel
        assert seen.quality is not None
        area = np.pi * np.sin(half) ** 2 * seen.quality.pixels[inside].sum() / solid[inside].sum()
        rows.append([soft_px, area, covered, *(patch.irradiance / true - 1)])
    return rows


def fitted(found: np.ndarray) -> tuple[float, float, float]:
    """POINT, FADES, SPREAD of largest likelihood: errors of red and blue of Student's distribution.

    What lenses differ by makes tails; sigmas of a normal likelihood hold 61 and 76 % where 50 and 68 are said.
    """
    from scipy.optimize import minimize

    covered, error = found[:, 2], found[:, [3, 5]]

    def loss(p: np.ndarray) -> float:
        point, edge = np.exp(p[0] - covered * np.exp(p[1])), np.exp(p[2]) * covered**-0.75
        sigma = np.minimum(np.hypot(point, edge), 1)[:, None]
        return float((np.log(sigma) + (FREEDOM + 1) / 2 * np.log1p((error / sigma) ** 2 / FREEDOM)).sum())

    point, rate, spread = np.exp(minimize(loss, np.log([5, 0.3, 0.5]), method="Nelder-Mead").x)
    return float(point), float(1 / rate), float(spread)


def table(found: np.ndarray) -> list[str]:
    """Rows by softness, then by covered pixels: errors' rms in per cent, over sigma, and coverage by one and two."""
    sigma = np.stack([sampled(covered) for covered in found[:, 2]])
    z = found[:, 3:] / sigma
    groups = [(f"{soft} px", found[:, 0] == soft) for soft in SOFT]
    groups += [(f"covers {a} to {b}", (found[:, 2] >= a) & (found[:, 2] < b)) for a, b in pairwise(COVERED)]
    lines = []
    for name, some in [*groups, ("all", np.ones(len(z), bool))]:
        if some.any():
            rms = 100 * np.sqrt((found[some, 3:] ** 2).mean(0))
            over, inside = np.sqrt((z[some] ** 2).mean(0)), [(np.abs(z[some]) < q).mean() for q in (0.674, 1, 1.96)]
            lines.append(
                f"{name:18s} {some.sum():5d} lamps  error {np.round(rms, 1)} %  over sigma {np.round(over, 2)}  "
                f"within {np.round(inside, 2)}"
            )
    return lines


def main() -> None:
    """Simulate what is missing, print."""
    parser = argparse.ArgumentParser(prog="benchmarks.sampled_lamps")
    parser.add_argument("seeds", type=int, nargs="?", default=5)
    parser.add_argument("--folder", type=Path, default=Path("build/sampled"))
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    parts = []
    for seed in range(asked.seeds):
        kept = asked.folder / f"seed_{seed}.npy"
        if not kept.exists():
            cases = [(r, np.radians(h), s) for r in RADII for h in HALF_DEG for s in SOFT]
            rows = [row for n, case in enumerate(cases) for row in measured(*case, seed * len(cases) + n)]
            np.save(kept, np.array(rows))
        parts.append(np.load(kept))
        say(f"seed {seed}: {len(parts[-1])} lamps")
    found = np.concatenate(parts)
    found = found[(found[:, 1] > SMALLEST) & (found[:, 2] > COVERED[0])]
    point, fades, spread = fitted(found)
    green = float(np.sqrt((found[:, 4] ** 2).mean() / (found[:, [3, 5]] ** 2).mean()))
    say("\n".join(table(found)))
    say(
        f"fit: POINT {point:.2f}, FADES {fades:.2f}, SPREAD {spread:.2f}; green over red and blue {green:.2f} ({GREEN})"
    )


if __name__ == "__main__":
    main()
