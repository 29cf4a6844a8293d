"""Many captures of one place: its radiance is rendered once and photographed again and again.

    .venv/bin/python -m benchmarks.resimulate SCENE.toml CAPTURE FOLDER COUNT

The truth of the bundled CAPTURE that SCENE.toml made (plate, plate with objects, coverage) is brought to half its size,
2 x 2 pixels to one, which leaves it less noise than it had; ball views and board photographs are rendered at that size.
All is kept in FOLDER/radiance. Capture k then has its own photon and read noise, fixed pattern,
hot photosites, JPEG noise of the board photographs (so corners, lens and pose of its own) and shutter: each setting of
the dial is off by `DIAL`, each frame by `FRAME` more. Truth is the same for all and is linked to.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.run.cli import say
from pipeline.run.formats import read_exr, write_bytes
from pipeline.simulation import capture, shapes
from pipeline.simulation.lens import blur
from pipeline.simulation.scene_file import SimulatedScene, load_scene
from pipeline.simulation.world import Place
from pipeline.transport.variant import use_mitsuba
from stages import simulate

HALF = 2  # pixels of the bundled truth along a side that become one
SAMPLING = {"ball": 64, "calibration": 32, "environment": 64, "environment_width": 256}
SOFT_PX = 0.4  # Gaussian on the halved truth: 0.37 px are its own, together 0.55 as the simulated lens has it
DIAL = 0.01  # of log time, of each setting of the shutter; real ones are off by up to several percent
FRAME = 0.002  # of log time, of each frame: what one setting repeats to


@dataclass(frozen=True, eq=False)
class Pictures:
    """Radiance (H, W, 3), ACEScg, through the lens: of the plate, of every ball view, of the board photographs."""

    plate: np.ndarray
    balls: dict[str, np.ndarray]
    boards: list[np.ndarray]

    def save(self, path: Path) -> None:
        """As one file."""
        named = {f"ball:{name}": values for name, values in self.balls.items()}
        named |= {f"board:{number:02d}": values for number, values in enumerate(self.boards)}
        np.savez(path, plate=self.plate.astype(np.float32), **{n: v.astype(np.float32) for n, v in named.items()})

    @classmethod
    def load(cls, path: Path) -> Pictures:
        """What `save` wrote."""
        with np.load(path) as kept:
            balls = {n.removeprefix("ball:"): kept[n] for n in kept.files if n.startswith("ball:")}
            return cls(kept["plate"], balls, [kept[n] for n in sorted(kept.files) if n.startswith("board:")])


def reduced(scene: SimulatedScene) -> SimulatedScene:
    """The scene at half its frame, with fewer samples."""
    camera = scene.camera
    smaller = camera.model_copy(
        update={n: getattr(camera, n) / HALF for n in ("fx", "fy", "cx", "cy")}
        | {n: getattr(camera, n) // HALF for n in ("width", "height")}
    )
    sampling = scene.sampling.model_copy(update=SAMPLING)
    return scene.model_copy(update={"camera": smaller, "sampling": sampling})


def halved(values: np.ndarray) -> np.ndarray:
    """(H / 2, W / 2, ...) means over 2 x 2 pixels, a little softened."""
    height, width = (size // HALF for size in values.shape[:2])
    small = values.reshape(height, HALF, width, HALF, -1).mean((1, 3)).reshape(height, width, *values.shape[2:])
    return np.asarray(blur(np.asarray(small, float), SOFT_PX))


def halve_truth(bundled: Path, folder: Path, shape: tuple[int, int]) -> np.ndarray:
    """Truth pictures of ``bundled`` at half their size, written into ``folder``; returns the plate (H, W, 3)."""
    pictures = {}
    for name in ("plate", "with_objects", "albedo"):
        raster = read_exr(bundled / f"{name}.exr")
        extra = {"seen": halved(raster["seen"][..., None])[..., 0]} if "seen" in raster.channels else {}
        pictures[name] = halved(raster.rgb())
        capture.write_picture(folder / f"{name}.exr", pictures[name], extra)
    layers = {n: halved(v[..., None])[..., 0] for n, v in read_exr(bundled / "coverage.exr").channels.items()}
    capture.write_layers(folder / "coverage.exr", layers, shape)
    light = read_exr(bundled / "environment.exr")
    capture.write_picture(folder / "environment.exr", light.rgb())
    return pictures["plate"]


def render(scene: SimulatedScene, bundled: Path, folder: Path) -> Pictures:
    """Radiance of all photographs; truth and objects are written into ``folder``. Minutes."""
    mi = use_mitsuba()
    studio = simulate.Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera))
    shoot = capture.Shoot(scene, folder, capture.sensor_of(scene))
    views = {view.name: studio.pose(view) for view in [scene.plate, *scene.ball_view]}
    for model in scene.object:
        shapes.write_glb(folder / "objects" / f"{model.name}.glb", shapes.build(model), model)
    plate = halve_truth(bundled, folder / "truth", studio.shape)
    record = capture.truth_record(scene, shoot, views, studio.place.ball_centre, {})
    capture.write_truth(folder / "truth" / "truth.json", record)
    balls = {view.name: simulate.ball_picture(studio, view, say) for view in scene.ball_view}
    measure, sigma = studio.radiance(), scene.camera.blur_sigma_px
    boards = []
    for number, photo in enumerate(scene.calibration):
        say(f"board photograph {number + 1}")
        pose = simulate.board_pose(scene, studio.lens, photo)
        raw = studio.photograph(measure, pose, scene.sampling.calibration, 900_000 + 1000 * number)
        boards.append(blur(raw, sigma))
    return Pictures(plate, balls, boards)


@dataclass
class Reshoot(capture.Shoot):
    """A shoot whose shutter is off: by as much for every frame of one setting, and a little more for each."""

    off: dict[int, float] = field(default_factory=dict)
    now: float = 1.0  # true over nominal time of the frame that is being taken

    def gain(self, time_s: float) -> float:
        """As the frame that is being taken has it."""
        return super().gain(time_s) * self.now

    def take(self, name: str, acescg: np.ndarray, third: int) -> None:
        """One frame at a time that is a little off."""
        random = np.random.default_rng([self.scene.seed, 4, len(self.exposures)])
        dial = np.random.default_rng([self.scene.seed, 5, third + 100])
        self.now = float(np.exp(DIAL * dial.standard_normal() + FRAME * random.standard_normal()))
        super().take(name, acescg, third)
        self.off[third] = self.now
        self.exposures[name]["true_s"] *= self.now
        self.now = 1.0


def photograph(scene: SimulatedScene, pictures: Pictures, number: int, shared: Path, out: Path) -> None:
    """Write capture ``number`` into ``out``; truth and objects are links to those in ``shared``."""
    scene = scene.model_copy(update={"seed": scene.seed + 1000 * (number + 1)})
    out.mkdir(parents=True)
    for part in ("truth", "objects"):
        (out / part).symlink_to((shared / part).resolve())
    shoot = Reshoot(scene, out, capture.sensor_of(scene))
    capture.write_manifests(scene, out)
    capture.take_brackets(shoot, {**pictures.balls, "plate": pictures.plate})
    for board, picture in enumerate(pictures.boards):
        write_bytes(out / "calibration" / f"calib_{board:02d}.jpg", capture.srgb_jpeg(picture, shoot.sensor, board))


def place_of(scene_toml: Path, bundled: Path, folder: Path) -> tuple[SimulatedScene, Pictures]:
    """The reduced scene and its pictures, rendered when they are not there; ``bundled``: the capture with its truth."""
    scene = reduced(load_scene(scene_toml))
    kept = folder / "radiance.npz"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        render(scene, bundled / "truth", folder).save(kept)
    return scene, Pictures.load(kept)


if __name__ == "__main__":
    scene_file, capture_folder, where = (Path(word) for word in sys.argv[1:4])
    place, shots = place_of(scene_file, capture_folder, where / "radiance")
    for index in range(int(sys.argv[4])):
        photograph(place, shots, index, where / "radiance", where / f"capture_{index:03d}")
