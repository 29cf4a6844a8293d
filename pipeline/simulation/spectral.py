"""The spectral twin: the same place once in spectra and once in RGB, to see what RGB costs.

The spectral scene comes first. The main window and the lamps are CIE illuminants, the rest of the room is D65 times
smooth spectra, wood and print are smooth spectra (Jakob and Hanika 2019, as Mitsuba has them), each object is the
measured patch nearest to its colour, people are grey. A camera with measured sensitivities photographs it; its 3x3
matrix makes ACEScg. The RGB scene is what that camera says of every light, and of every surface under D65: what is seen
directly, or lit by D65 once, agrees by construction. What remains is the cost of multiplying three numbers per bounce.

Wavelengths are spread by the curves they meet, with one random shift per path (Wilkie et al. 2014, without weights: no
direction depends on them, but for the choice of lobe); Mitsuba follows four at a time, so each path is followed several
times with the same random numbers. The RGB world has the same again, so that most noise cancels in the comparison.
Light is added up per group, so one tracing serves every spectrum of the lamps. Mitsuba's variant is global to a
process, so ``twin`` works in one of its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.run.errors import InsituError, ManifestError, ToolError
from pipeline.run.formats import write_bytes
from pipeline.simulation import capture, spectra
from pipeline.simulation.lens import Lens, look_at
from pipeline.simulation.photograph import camera_rays, first_hit, latlong_rays, picture
from pipeline.simulation.scene_file import SimulatedScene, load_scene
from pipeline.simulation.twin_report import compare, markdown
from pipeline.simulation.twin_world import (
    Twin,
    dim,
    group_curves,
    groups,
    patch_of,
    rec709,
    rgb_radiance,
    rgb_world,
    spectral_radiance,
    table_white,
)

MitsubaIn = Callable[[str], Any]  # "spectral" or "rgb" -> mitsuba in that variant, with insitu's material
SEEDS = (1, 2)  # of the halves, whose difference is the noise
FURNACE = ("grey 18 %", "white, glossy", "white, metal", "red patch")


@dataclass(frozen=True)
class Size:
    """What a twin may cost: paths per pixel and half, and how often each is followed with other wavelengths."""

    width: int = 256
    height: int = 192
    samples: int = 16
    shifts: int = 4
    environment_width: int = 64


def twin(
    scene_toml: Path, out: Path, progress: Callable[[str], None], worker: str, size: Size | None = None
) -> dict[str, Any]:
    """Render both worlds of ``scene_toml`` into ``out``; returns what spectral.json holds.

    ``worker`` is the module that calls ``main`` in a process of its own. Raises ManifestError for a bad scene file or
    a folder that is not empty, ToolError when Mitsuba cannot run.
    """
    load_scene(scene_toml)
    if out.exists() and any(out.iterdir()):
        raise ManifestError(f"{out}: is not empty; the spectral twin is written into a new folder")
    numbers = [str(value) for value in astuple(size or Size())]
    command = [sys.executable, "-m", worker, str(scene_toml.resolve()), str(out.resolve()), *numbers]
    with (
        tempfile.TemporaryFile("w+") as complaints,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=complaints, text=True) as process,
    ):
        assert process.stdout is not None
        for line in process.stdout:
            progress(line.rstrip())
        code = process.wait()
        complaints.seek(0)
        said = complaints.read().strip().splitlines()
    if code:
        raise ToolError(f"spectral twin: {said[-1] if said else f'exit code {code}, run insitu doctor'}")
    record: dict[str, Any] = json.loads((out / "spectral.json").read_text())
    return record


def view_of(scene: SimulatedScene, size: Size) -> tuple[Lens, np.ndarray]:
    """Lens and world_from_camera: the middle half of the plate about the objects, scaled to ``size``."""
    assert scene.plate.position_m is not None
    assert scene.plate.target_m is not None
    pose = look_at(np.array(scene.plate.position_m), np.array(scene.plate.target_m))
    lens = capture.lens_of(scene.camera)
    places = [(o.position_m[0], 0.03, o.position_m[1]) for o in scene.object] or [scene.plate.target_m]
    local = np.array([*np.mean(places, 0), 1.0]) @ np.linalg.inv(pose).T
    centre = lens.project(local[None, :3])[0]
    scale = 2 * size.width / lens.width
    shift = np.array([lens.cx, lens.cy]) - centre
    cx, cy = shift * scale + (size.width / 2, size.height / 2)
    return Lens(size.width, size.height, lens.fx * scale, lens.fy * scale, cx, cy, lens.distortion), pose


# ---------------------------------------------------------------- rendering


@dataclass
class Session:
    """What both worlds are photographed with."""

    scene: SimulatedScene
    camera: spectra.Camera
    size: Size
    lens: Lens
    pose: np.ndarray
    say: Callable[[str], None]

    def shoot(self, place: Twin, kind: str, curves: dict[str, np.ndarray]) -> dict[str, Any]:
        """Pictures {group: {plate, with, environment: [half, half]}} (H, W, K), and the objects' coverage."""
        mi, size, depth = place.mi, self.size, min(self.scene.sampling.depth, 8)
        people, objects = place.photographer(self.pose), place.objects()
        wide = (size.environment_width // 2, size.environment_width)
        sphere = latlong_rays(mi, place.ball_centre, wide[1], wide[0])
        views: dict[str, tuple[Any, tuple[int, int], list[Any]]] = {
            "plate": (camera_rays(mi, self.lens, self.pose), (size.height, size.width), [people]),
            "with": (camera_rays(mi, self.lens, self.pose), (size.height, size.width), [people, objects]),
            "environment": (sphere, wide, [people]),
        }
        found: dict[str, Any] = {}
        for group in place.lights or {}:
            place.group, found[group] = group, {}
            for name, (rays, shape, parts) in views.items():
                self.say(f"{kind}: {group}, {name}")
                world = place.load(*parts)
                measures = [rgb_radiance(mi, world, depth)]
                if kind == "spectral":
                    shifts = 0.25 * np.arange(size.shifts) / size.shifts
                    measures = [spectral_radiance(mi, world, depth, curves[group], s) for s in shifts]
                found[group][name] = [
                    np.mean([picture(mi, rays, m, shape, size.samples, size.samples, seed) for m in measures], 0)
                    for seed in SEEDS
                ]
        if kind == "rgb" and objects:
            hits = first_hit(mi, place.load(people, objects), list(objects.values()))
            rays = camera_rays(mi, self.lens, self.pose)
            found["coverage"] = picture(mi, rays, hits, (size.height, size.width), 16, 16, 3)
        return found


def furnace(mi: Any, place: Twin, camera: spectra.Camera, curves: np.ndarray | None, samples: int) -> np.ndarray:
    """(4, 3) mean ACEScg of four spheres under an even D65 sky of radiance 1, light once reflected."""
    bsdfs = [
        {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.18}},
        {"type": "insitu_gltf", "base_color": {"type": "uniform", "value": 1.0}, "metallic": 0.0, "roughness": 0.5},
        {"type": "insitu_gltf", "base_color": {"type": "uniform", "value": 1.0}, "metallic": 1.0, "roughness": 0.3},
        {"type": "diffuse", "reflectance": place.base("red")},
    ]
    sky = mi.Bitmap(np.ones((17, 32, 3), np.float32))
    means = []
    for bsdf in bsdfs:
        sphere = {"type": "sphere", "radius": 1.0, "bsdf": bsdf}
        world = mi.load_dict({"type": "scene", "sphere": sphere, "sky": {"type": "envmap", "bitmap": sky}})
        lens = Lens(16, 16, 60.0, 60.0, 8.0, 8.0, (0, 0, 0, 0, 0))  # sees nothing but the sphere
        rays = camera_rays(mi, lens, look_at(np.array([0, 0.1, 4.0]), np.zeros(3)))
        measure = rgb_radiance(mi, world, 2) if curves is None else spectral_radiance(mi, world, 2, curves)
        means.append(picture(mi, rays, measure, (16, 16), samples, samples, 1).mean((0, 1)))
    values = np.array(means, float)
    return values if curves is None else values[:, :3] @ camera.acescg_from_camera.T


def developed(
    found: dict[str, Any], names: dict[str, tuple[str, ...]], camera: spectra.Camera, lamp: str, name: str, sort: str
) -> np.ndarray:
    """(2, H, W, 3) halves of one picture in ACEScg; ``sort``: rgb, camera or observer."""
    total = np.zeros(1)
    for group, some in names.items():
        values, power = np.array(found[group][name], float), lamp if group == "lamps" else some[0]
        if sort == "rgb":
            total = total + values * (1.0 if group == "room" else camera.develop(spectra.illuminant(power)))
            continue
        first = 6 * some.index(power) + (3 if sort == "observer" else 0)
        matrix = camera.acescg_from_camera if sort == "camera" else spectra.acescg_from_xyz()
        total = total + values[..., first : first + 3] @ matrix.T
    return total


def make(scene_toml: Path, out: Path, size: Size, say: Callable[[str], None], mitsuba_in: MitsubaIn) -> None:
    """Both worlds, the comparison, and its files. Sets Mitsuba's variant."""
    scene, camera = dim(load_scene(scene_toml)), spectra.camera_of(spectra.CAMERAS[0])
    lens, pose = view_of(scene, size)
    session = Session(scene, camera, size, lens, pose, say)
    mi = mitsuba_in("spectral")
    lights, names = groups(scene)
    place = Twin(mi, scene, camera=camera, lights={name: rec709(values) for name, values in lights.items()})
    curves = group_curves(mi, camera, names)
    furnaces = {"spectral": furnace(mi, place, camera, curves["room"], 256)}
    maps, rgb_lights = rgb_world(place, camera)
    pictures = {"spectral": session.shoot(place, "spectral", curves)}
    del place
    mi = mitsuba_in("rgb")
    place = Twin(mi, scene, camera=camera, maps=maps, lights=rgb_lights)
    furnaces["rgb"] = furnace(mi, place, camera, None, 256)
    pictures["rgb"] = session.shoot(place, "rgb", curves)
    say("comparing")
    white = table_white(rgb_lights)
    record = head(scene, size, camera, names) | {"furnace_relative_difference": furnace_record(furnaces), "lamps": {}}
    for lamp in spectra.LAMPS if scene.light.lamp else ("D65",):
        worlds = {
            sort: {
                n: developed(pictures[world], names, camera, lamp, n, sort) for n in ("plate", "with", "environment")
            }
            for sort, world in (("rgb", "rgb"), ("camera", "spectral"), ("observer", "spectral"))
        }
        record["lamps"][lamp] = compare(worlds, pictures["rgb"].get("coverage"), [o.name for o in scene.object], white)
        for sort, name in [(s, n) for s in ("rgb", "camera") for n in ("plate", "with", "environment")]:
            capture.write_picture(out / f"{name}_{sort}_{lamp.lower()}.exr", worlds[sort][name].mean(0), unit="1")
    write_bytes(out / "spectral.json", (json.dumps(record, indent=1) + "\n").encode())
    write_bytes(out / "spectral.md", markdown(record).encode())


def furnace_record(furnaces: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest relative difference between both worlds' channels, per sphere."""
    return dict(zip(FURNACE, np.abs(furnaces["spectral"] / furnaces["rgb"] - 1).max(1).tolist()))


def head(
    scene: SimulatedScene, size: Size, camera: spectra.Camera, names: dict[str, tuple[str, ...]]
) -> dict[str, Any]:
    """What was compared, and what follows from the spectra alone."""
    return {
        "scene": scene.name,
        "camera": camera.name,
        "pixels": [size.width, size.height],
        "paths_per_pixel": len(SEEDS) * size.samples,
        "wavelengths_per_path": 4 * size.shifts,
        "window": names["window"][0] if "window" in names else None,
        "objects": {model.name: patch_of(model) for model in scene.object},
        "acescg_from_camera": camera.acescg_from_camera.tolist(),
        "matrix_delta_e": {name: spectra.matrix_cost(spectra.camera_of(name)) for name in spectra.CAMERAS},
        "bounce_delta_e": {str(n): spectra.bounce_cost(camera, n) for n in (1, 2, 3)},
    }


def main(argv: list[str], mitsuba_in: MitsubaIn) -> int:
    """Run in a process of its own; the last line on stderr tells what went wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("numbers", type=int, nargs=len(astuple(Size())))
    args = parser.parse_args(argv)

    def say(text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    try:
        make(args.scene, args.out, Size(*args.numbers), say, mitsuba_in)
    except InsituError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    return 0
