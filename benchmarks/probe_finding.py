"""False alarms of the search for a mirror ball: how much of an outline is seen where there is none.

    python -m benchmarks.probe_finding BUILD ... [--pictures GLOB ...]

BUILD: folders of finished builds, whose plates show no ball: single places on the plane, and the best of the plane for
each of some sizes. Pictures: best place at any size. The statistic is that of `pipeline.probes.finding.SURE`: share of
azimuths less chance's, times the root of their number. Printed: median, largest, one in a hundred by Gumbel's law.
"""

from __future__ import annotations

import argparse
import glob
import sys
from pathlib import Path

import numpy as np

from pipeline.camera.lens import pixel_rays
from pipeline.probes import finding, seeds, sphere_fit
from pipeline.probes.outline import Height, fraction_in_frame, radius_in_pixels
from pipeline.run import artifacts as A
from pipeline.run import formats
from pipeline.types import Camera, Raster

RADII_M = (0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1)
PLACES = 14  # per size and plate
WIDE = 700  # px of pictures


def statistic(camera: Camera, merit: float, size: float, visible: float) -> float:
    """The share, chance taken off, times the root of the number of azimuths in the frame."""
    return merit * float(np.sqrt(seeds.azimuth_count(size) * visible))


def best(picture: Raster, camera: Camera, radius: float, height: Height, places: np.ndarray, on_plane: bool) -> float:
    """The largest statistic of the fits of four places; 0 without any."""
    signals, most, measured = finding.signals_of(picture, None), 0.0, finding.measured(picture)
    prior = height if on_plane else None
    for centre, votes, _ in finding.settled(signals, camera, radius, list(places), prior)[:4]:
        fit = sphere_fit.fit_sphere(*measured, camera, radius, centre, prior, 0.0, 1.0, votes)[0]
        if fit.rms_px < finding.MAX_RMS_PX and fit.visible > seeds.MIN_FRAMED:
            merit = finding.seen(signals, camera, fit, radius)
            most = max(most, statistic(camera, merit, fit.radius_px, fit.visible))
    return most


def singles(picture: Raster, camera: Camera, radius: float, height: Height, rng: np.random.Generator) -> list[float]:
    """Statistics of random places on the plane, each settled nearby."""
    signals, found = finding.signals_of(picture, None), []
    for px in rng.uniform((0, 0), (camera.width, camera.height), (PLACES, 2)):
        ray = pixel_rays(camera, px[None])[0]
        reach = (radius - height.offset_m) / (ray @ height.normal)
        if not 2 * radius < reach < 50 * radius:
            continue
        centre, _, _ = seeds.settle(signals, camera, radius, reach * ray, height)
        share, even = seeds.coverage(signals, camera, centre, radius)
        size, visible = radius_in_pixels(camera, centre, radius), fraction_in_frame(camera, centre, radius)
        if size >= finding.REFUSE_RADIUS_PX and visible > finding.MIN_VISIBLE_ANCHORED:
            found.append(statistic(camera, max(share - even, 0) / (1 - even), size, visible))
    return found


def opened(path: str) -> tuple[Raster, Camera]:
    """A picture of 8 bits, reduced, as a photograph, and a camera of an ordinary angle."""
    from PIL import Image

    with Image.open(path) as file:
        shrunk = file.convert("RGB")
        shrunk.thumbnail((WIDE, WIDE), Image.Resampling.BOX)
    rgb = ((np.asarray(shrunk) / 255.0) ** 2.2).astype(np.float32)
    height, width = rgb.shape[:2]
    channels = {**Raster.split(rgb), **Raster.split((0.01 * rgb + 0.001) ** 2, "variance")}
    channels["mask"] = np.zeros((height, width), np.uint32)
    camera = Camera(width=width, height=height, fx=1.2 * width, fy=1.2 * width, cx=width / 2, cy=height / 2)
    return Raster(channels, "acescg"), camera


def line(name: str, values: list[float]) -> str:
    """What is printed of one kind of search."""
    found = np.array(values)
    scale = found.std(ddof=1) * np.sqrt(6) / np.pi
    rare = found.mean() - np.euler_gamma * scale - scale * np.log(-np.log(0.99))
    return (
        f"{name}: {len(found)}, median {np.median(found):.1f}, largest {found.max():.1f}, one in a hundred {rare:.1f}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("builds", type=Path, nargs="*")
    parser.add_argument("--pictures", nargs="*", default=[])
    given = parser.parse_args()
    rng = np.random.default_rng(3)
    found: dict[str, list[float]] = {"a place": [], "plane": [], "anywhere": []}
    for build in given.builds:
        camera = formats.read(build / "calibrate", A.CAMERA)
        plate, view = (formats.read(build / s, a)["plate"] for s, a in (("develop", A.PHOTOGRAPHS), ("pose", A.VIEWS)))
        signals = finding.signals_of(plate, None)
        for radius in RADII_M:
            height = finding.height_prior(view, radius)
            places = seeds.search_on_plane(signals, camera, radius, height, 8)
            found["plane"].append(best(plate, camera, radius, height, places, True))
            found["a place"] += singles(plate, camera, radius, height, rng)
        places = seeds.search_anywhere(signals, camera, 0.05)
        found["anywhere"].append(best(plate, camera, 0.05, finding.height_prior(view, 0.05), places, False))
    for path in (file for pattern in given.pictures for file in sorted(glob.glob(pattern))):
        picture, camera = opened(path)
        places = seeds.search_anywhere(finding.signals_of(picture, None), camera, 0.05)
        nowhere = Height(np.array([0.0, -1.0, 0.0]), 1.0, 1.0)
        found["anywhere"].append(best(picture, camera, 0.05, nowhere, places, False))
    for name, values in found.items():
        if len(values) > 1:
            sys.stdout.write(line(name, values) + "\n")


if __name__ == "__main__":
    main()
