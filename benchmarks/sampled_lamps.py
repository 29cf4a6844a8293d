"""How a mosaic samples the light of small lamps in a mirror ball, and how wide its picture makes them.

    .venv/bin/python -m benchmarks.sampled_lamps [SEEDS] [--folder build/sampled]

The laws of `pipeline.light.alike` (`AS_SEEN`, `RESTORED`, `point_px`). Lamps of 0.5 to 6 degrees in balls of 45
to 130 px, under lenses of `SOFT` px (with the pixel, standard deviation of a Gaussian), through RGGB mosaics of four
cameras, bilinear, as they are and without small lights' aliases (`pipeline.image.small_lights`), unwrapped by the
probe's own code to maps of 512 and 1024 columns. Of each lamp, the light in the texels that
`pipeline.light.emitters.lights` finds is compared with the truth, and the second moments of what they show with those
of the lamp's disc. No photon noise, no error of pose or fit. Constants of the light are fitted to even seeds, its
tables are of odd ones. Six seeds: twenty minutes of one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.conventions import invert_rigid, latlong_directions, latlong_solid_angles, transform_points
from pipeline.image.demosaic import demosaic
from pipeline.image.small_lights import restored
from pipeline.light import alike
from pipeline.light.emitters import Patch, lights
from pipeline.light.narrowing import above_least
from pipeline.probes.ball_surface import Surface
from pipeline.probes.combine import alike_deg
from pipeline.probes.finding import Found
from pipeline.probes.mirror_ball import view_map
from pipeline.probes.observation import Grid, ViewMap
from pipeline.probes.sphere_fit import Height, SphereFit
from pipeline.run.cli import say
from pipeline.simulation.sensor import camera_from_acescg
from pipeline.types import Camera, Raster, View
from tests.mirror_scene import Lamp, Place, look_at, photograph, sky

SOFT = (0.55, 0.65, 0.76, 0.85, 1.0)  # px
UNKNOWN = (0.55, 0.85)  # px: lenses that the law without a softness is for, evenly
RADII, HALF_DEG, WIDTHS = (45, 64, 90, 130), (0.5, 1.5, 3.0, 6.0), (512, 1024)
RADIUS, CONTRAST, LAMPS = 0.04, 0.4, 7
SPLIT = 8  # samples to a pixel and axis of what is photographed
# camera_rgb from XYZ: of four bodies of three makers, as DNG's ColorMatrix rounds them.
MATRICES = np.array(
    [
        [[0.6347, -0.0479, -0.0972], [-0.8297, 1.5954, 0.2480], [-0.1968, 0.2131, 0.7649]],
        [[0.8139, -0.2171, -0.0663], [-0.8747, 1.6541, 0.2295], [-0.1925, 0.2008, 0.8093]],
        [[0.5271, -0.0712, -0.0347], [-0.6153, 1.3653, 0.2763], [-0.1601, 0.2366, 0.7242]],
        [[0.8458, -0.2451, -0.0855], [-0.4597, 1.2447, 0.2407], [-0.1475, 0.2482, 0.6526]],
    ]
)
SMALLEST, LEAST = 0.8, 6.0  # px of a lamp that counts, and that it covers: finer than `SPLIT` shows is none
RESOLVED_PX = 45.0  # lamps of more px keep nine tenths of their width, and lose some of their border with the patch
# Of Student's likelihood: those of 4, 8, 16, 32 with intervals of 50, 68 and 95 % nearest to it.
UNKNOWN_FREEDOM, KNOWN_FREEDOM, RESTORED_FREEDOM = 8.0, 32.0, 8.0
AREAS = (0.8, 1.5, 3, 6, 12, 20, 45, 90, 200)  # px of lamps, for tables


@dataclass(frozen=True, eq=False)
class Shot:
    """A ball under lamps of one half angle, as a lens without blur shows it (``picture``, (h, w, 3), ACEScg).

    ``lamps``: their directions (3,), each of ``radiance`` in `sky` of `CONTRAST`.
    """

    picture: np.ndarray
    camera: Camera
    view: View
    ball: Found
    lamps: list[np.ndarray]
    radiance: float


@dataclass(frozen=True, eq=False)
class Measured:
    """N lamps: ``soft_px``, their own and covered px, errors (N, 3), px^2 by which each axis is wider, texel in px."""

    soft_px: np.ndarray
    area: np.ndarray
    covered: np.ndarray
    error: np.ndarray
    wider: np.ndarray
    texel: np.ndarray
    odd: np.ndarray

    def where(self, some: np.ndarray) -> Measured:
        """Those of ``some`` (N,)."""
        return Measured(*(values[some] for values in vars(self).values()))


def tint(kelvin: float) -> np.ndarray:
    """(3,) of a black body over one of 6000 K, at 610, 540 and 460 nm."""
    metres = np.array([610.0, 540.0, 460.0]) * 1e-9
    ratio = np.expm1(0.014388 / (metres * 6000)) / np.expm1(0.014388 / (metres * kelvin))
    return np.asarray(ratio / ratio[1])


def directions_of_lamps(random: np.random.Generator, away: np.ndarray) -> list[np.ndarray]:
    """`LAMPS` directions (3,), apart, and not behind the ball as seen from ``away`` (3,)."""
    found: list[np.ndarray] = []
    while len(found) < LAMPS:
        one = random.normal(size=3)
        one /= np.linalg.norm(one)
        if one @ away > -0.3 and all(one @ other < np.cos(0.6) for other in found):
            found.append(one)
    return found


def shot(radius_px: float, half: float, seed: int) -> Shot:
    """`LAMPS` lamps of half angle ``half`` [rad] in a ball of ``radius_px``, each elsewhere on its pixels."""
    random = np.random.default_rng(seed)
    pose, centre = look_at(np.array([0.2, 0.3, 0.3]), np.array([0, RADIUS, 0])), np.array([0, RADIUS, 0.0])
    away = (pose[:3, 3] - centre) / np.linalg.norm(pose[:3, 3] - centre)
    lamps = directions_of_lamps(random, away)
    focal = radius_px / np.tan(np.arcsin(RADIUS / np.linalg.norm(pose[:3, 3] - centre)))
    size = int(2.2 * radius_px) + 10
    middle = size / 2 + random.random(2)
    camera = Camera(width=size, height=size, fx=focal, fy=focal, cx=middle[0], cy=middle[1])
    radiance = 300.0 * max(1.0, (np.radians(3) / half) ** 2)
    place = Place(sky([Lamp(tuple(d), half, radiance) for d in lamps], CONTRAST), reflectance=1.0)
    fit = SphereFit(
        centre=transform_points(invert_rigid(pose), centre), covariance=(0.02 * RADIUS / radius_px) ** 2 * np.eye(3),
        rms_px=0.05, points=400, radius_px=float(radius_px), blur_px=0.6, support=1.0, contrast=1.0, visible=1.0,
    )  # fmt: skip
    view = View(world_from_camera=pose, covariance=1e-10 * np.eye(6), route="given", rms_px=0.1, points=20)
    ball = Found(fit, fit, Height(np.array([0, -1.0, 0]), 0.0, 1e-4), centre)
    return Shot(photograph(place, camera, pose, SPLIT), camera, view, ball, lamps, radiance)


def through_mosaic(picture: np.ndarray, matrix: np.ndarray, better: bool) -> Raster | None:
    """A photograph of ``picture`` (h, w, 3), ACEScg, by an RGGB mosaic whose camera has ``matrix`` (3, 3) from XYZ.

    ``better``: without small lights' aliases; then None where some light kept them.
    """
    camera_rgb = camera_from_acescg(matrix)
    camera_rgb = camera_rgb / camera_rgb.sum(1, keepdims=True)
    row, column = np.mgrid[: len(picture), : picture.shape[1]] % 2
    mosaic = np.take_along_axis(picture @ camera_rgb.T, (row + column)[..., None], -1)[..., 0].astype(np.float32)
    seen = demosaic(mosaic, "RGGB", "bilinear")
    if better:
        seen, lights = restored(seen, mosaic, "RGGB", np.zeros(mosaic.shape, bool))
        if lights.left:
            return None
    rgb = (seen @ np.linalg.inv(camera_rgb).T).astype(np.float32)
    layers = {**Raster.split(rgb), **Raster.split(1e-5 * np.abs(rgb), "variance")}
    return Raster({**layers, "mask": np.zeros(rgb.shape[:2], np.uint32)}, "acescg")


def rows_of(radius_px: float, half: float, seed: int, width: int, better: bool) -> list[list[float]]:
    """Of every lamp that is told apart behind every lens of `SOFT`: what `Measured` holds, in its order."""
    from scipy.ndimage import gaussian_filter

    one, rows = shot(radius_px, half, seed), []
    surface, random = Surface(np.ones(3), np.zeros(3)), np.random.default_rng([seed, 1])
    for number, soft_px in enumerate(SOFT):
        lens, colour = np.sqrt(soft_px**2 - 1 / 12), tint(random.uniform(2500, 6500))
        picture = gaussian_filter(one.picture, (lens, lens, 0)) * colour
        taken = through_mosaic(picture, MATRICES[(seed + number) % len(MATRICES)], better)
        if taken is None:
            continue
        seen = view_map(taken, one.camera, one.view, one.ball, RADIUS, surface, Grid(width))
        patches = lights(seen.rgb, 0.001, np.radians(14))[0]
        for direction in one.lamps:
            near = [patch for patch in patches if patch.direction @ direction > np.cos(half + 0.05)]
            if len(near) == 1:
                rows.append([soft_px, *of_lamp(near[0], seen, half, (one.radiance, direction, colour))])
    return rows


def of_lamp(
    patch: Patch, seen: ViewMap, half: float, lamp: tuple[float, np.ndarray, np.ndarray]
) -> list[float]:  # fmt: skip
    """Of a lamp (radiance, direction (3,), colour (3,)) that ``patch`` shows: a row without softness and seed."""
    degrees, (radiance, direction, colour) = alike_deg([seen]), lamp
    assert degrees is not None
    assert seen.quality is not None
    pixel, shape = np.radians(degrees / alike.ALIKE_PX), seen.rgb.shape[:2]
    solid = latlong_solid_angles(*shape).ravel()[patch.texels]
    ways = latlong_directions(*shape).reshape(-1, 3)[patch.texels]
    weight, rest = solid * np.maximum(ways @ patch.direction, 0), sky([], CONTRAST)
    excess = (radiance - rest(direction[None])[0]) * np.pi * np.sin(half) ** 2
    true = colour * (weight @ rest(ways) + excess)
    light = weight * seen.rgb[..., 1].ravel()[patch.texels]
    covered = light.sum() ** 2 / (light**2 / solid).sum() / pixel**2
    area = np.pi * np.sin(half) ** 2 * seen.quality.pixels.ravel()[patch.texels].sum() / solid.sum()
    shown = above_least(seen.rgb.astype(float).reshape(-1, 3), patch.texels).half_angle_rad
    wider = (shown**2 - half**2) / 4 / pixel**2
    return [area, covered, *(patch.irradiance / true - 1), wider, np.pi / shape[0] / pixel]


def simulated(seed: int, folder: Path, better: bool) -> np.ndarray:
    """Rows (N, 8) of one seed, read from ``folder`` or simulated and written there."""
    kept = folder / f"{'restored' if better else 'as_seen'}_{seed}.npy"
    if not kept.exists():
        cases = [(radius, np.radians(half)) for radius in RADII for half in HALF_DEG]
        width = WIDTHS[seed // 2 % 2]
        rows = [row for n, case in enumerate(cases) for row in rows_of(*case, seed * len(cases) + n, width, better)]
        np.save(kept, np.array(rows))
    return np.asarray(np.load(kept))


def read(parts: list[np.ndarray]) -> Measured:
    """Rows of seeds 0, 1, ... as one; lamps too small for what was simulated left out."""
    odd = np.concatenate([np.full(len(part), number % 2 == 1) for number, part in enumerate(parts)])
    rows = np.concatenate(parts)
    found = Measured(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:6], rows[:, 6], rows[:, 7], odd)
    return found.where((found.area > SMALLEST) & (found.covered > LEAST))


def likeliest(
    law: Callable[[np.ndarray], np.ndarray], start: list[float], error: np.ndarray, freedom: float
) -> np.ndarray:
    """Constants of largest Student's likelihood: of errors (N, 2) of red and blue, sigmas ``law(constants)`` (N,).

    What one sigma does not tell of a lamp, its phase and shape, makes tails, to which a normal likelihood yields.
    """
    from scipy.optimize import minimize

    def loss(logarithms: np.ndarray) -> float:
        sigma = np.minimum(law(np.exp(logarithms)), 1)[:, None]
        return float((np.log(sigma) + (freedom + 1) / 2 * np.log1p((error / sigma) ** 2 / freedom)).sum())

    found = minimize(loss, np.log(start), method="Nelder-Mead", options={"maxiter": 5000, "maxfev": 5000})
    return np.asarray(np.exp(found.x))


def fitted_unknown(found: Measured) -> np.ndarray:
    """``point, fades, spread`` of `alike.Sampling`."""

    def law(p: np.ndarray) -> np.ndarray:
        return np.asarray(np.hypot(p[0] * np.exp(-found.covered / p[1]), p[2] * found.covered**-0.75))

    return likeliest(law, [5, 3, 0.5], found.error[:, [0, 2]], UNKNOWN_FREEDOM)


def fitted_known(found: Measured, better: bool) -> np.ndarray:
    """``top, border`` of `alike.Sampling`, the powers being a disc's; ``better``: also ``knee, falls, ends``."""
    fades, point = np.exp(-((np.pi * found.soft_px) ** 2) / 2), points_of(found)

    def law(p: np.ndarray) -> np.ndarray:
        own = np.maximum(found.covered - 4 * np.pi * point**2, 0)
        knee, falls, ends = p[2:] if better else (1.0, 0.75, 0.5)
        return np.asarray(np.hypot(p[0] * fades * (1 + own / knee) ** -falls, p[1] * point * found.covered**-ends))

    start = [1, 0.06, 1, 0.75, 0.5] if better else [2, 0.07]
    return likeliest(law, start, found.error[:, [0, 2]], RESTORED_FREEDOM if better else KNOWN_FREEDOM)


def points_of(found: Measured) -> np.ndarray:
    """(N,) px that a point becomes, by `alike.ADDED_PX2`."""
    return np.asarray(np.sqrt(found.soft_px**2 + alike.ADDED_PX2 + found.texel**2 / 6))


def sigmas(found: Measured, known: bool, law: alike.Sampling) -> np.ndarray:
    """(N, 3) stated sigma, with or without the softness."""
    if not known:
        return np.stack([alike.sampled(covered, law) for covered in found.covered])
    columns = zip(found.covered, found.soft_px, points_of(found), strict=True)
    return np.stack([alike.sampled_behind(*lamp, law) for lamp in columns])


def groups(found: Measured) -> list[tuple[str, np.ndarray]]:
    """Names and members (N,) of what tables have a row of."""
    by_lens = [(f"{soft} px", found.soft_px == soft) for soft in SOFT]
    by_area = [(f"lamps of {a} to {b} px", (found.area >= a) & (found.area < b)) for a, b in pairwise(AREAS)]
    return [(name, some) for name, some in [*by_lens, *by_area, ("all", found.area > 0)] if some.any()]


def light_table(found: Measured, known: bool, law: alike.Sampling) -> list[str]:
    """Rows: errors' rms in per cent, over sigma, and the share that intervals of 50, 68 and 95 % hold."""
    z, lines = found.error / sigmas(found, known, law), []
    for name, some in groups(found):
        rms, over = 100 * np.sqrt((found.error[some] ** 2).mean(0)), np.sqrt((z[some] ** 2).mean(0))
        inside = [(np.abs(z[some]) < q).mean() for q in (0.674, 1, 1.96)]
        lines.append(
            f"{name:22s} {some.sum():5d} lamps  error {np.round(rms, 1)} %  over sigma {np.round(over, 2)}  "
            f"within {np.round(inside, 2)}"
        )
    return lines


def spread_table(found: Measured) -> list[str]:
    """Rows: what a point becomes [px], measured (mean, scatter of one lamp) and by `alike.point_px`; px^2 added."""
    added, lines = found.wider - found.soft_px**2 - found.texel**2 / 6, []
    for name, some in groups(found):
        spread = np.sqrt(np.maximum(found.wider[some], 0))
        lines.append(
            f"{name:22s} {some.sum():5d} lamps  spread {spread.mean():.3f} +- {spread.std():.3f} px, stated "
            f"{points_of(found)[some].mean():.3f}  added {added[some].mean():.3f} +- {added[some].std():.3f} px^2"
        )
    return lines


def told(rows: list[np.ndarray], better: bool) -> None:
    """Say the tables and constants of the pictures as they are, or of those without small lights' aliases."""
    law = alike.RESTORED if better else alike.AS_SEEN
    found = read(rows)
    even, odd = found.where(~found.odd), found.where(found.odd)
    of_law = even.where((even.soft_px >= UNKNOWN[0]) & (even.soft_px <= UNKNOWN[1]))
    known, unknown = fitted_known(even, better), fitted_unknown(of_law)
    small = found.where(found.area < RESOLVED_PX)
    added = small.wider - small.soft_px**2 - small.texel**2 / 6
    relative = np.sqrt(np.maximum(small.wider, 0)) / points_of(small)
    say("without small lights' aliases" if better else "as seen")
    say("light, softness known\n" + "\n".join(light_table(odd, True, law)))
    say("light, softness unknown\n" + "\n".join(light_table(odd, False, law)))
    say("width of a point\n" + "\n".join(spread_table(small)))
    say(f"fit, known: top, border (knee, falls, ends) {np.round(known, 3)}")
    say("fit, unknown: point {:.2f}, fades {:.2f}, spread {:.2f}".format(*unknown))
    say(f"ADDED_PX2 {added.mean():.3f}; scatter of one lamp's spread {relative.std():.3f}")
    green = [np.median(np.abs(even.error[:, channels])) for channels in ([1], [0, 2])]
    say(f"green over red and blue, medians {green[0] / green[1]:.2f} ({law.green})\n")


def main() -> None:
    """Simulate what is missing, print."""
    parser = argparse.ArgumentParser(prog="benchmarks.sampled_lamps")
    parser.add_argument("seeds", type=int, nargs="?", default=6)
    parser.add_argument("--folder", type=Path, default=Path("build/sampled"))
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    for better in (False, True):
        told([simulated(seed, asked.folder, better) for seed in range(asked.seeds)], better)


if __name__ == "__main__":
    main()
