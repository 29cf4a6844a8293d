"""Many captures of one place: its radiance is rendered once and photographed again and again.

    .venv/bin/python -m benchmarks.resimulate SCENE.toml FOLDER COUNT

A scene's pictures (plate, ball views, board photographs, truth) are rendered once, at ``SCALE`` of the scene's frame
and with fewer samples, and kept in FOLDER/radiance. Capture k then has its own photon and read noise, fixed pattern,
hot photosites, JPEG noise of the board photographs (so corners, lens and pose of its own) and shutter: each setting of
the dial is off by `DIAL`, each frame by `FRAME` more. Truth is the same for all and is linked to.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.run.formats import write_bytes
from pipeline.simulation import capture, shapes
from pipeline.simulation.lens import blur
from pipeline.simulation.scene_file import SimulatedScene, load_scene
from pipeline.simulation.world import Place
from pipeline.transport.variant import use_mitsuba
from stages import simulate

SCALE = 0.5  # of the frame; the same field of view
SAMPLING = {
    "plate": 128, "region": 1024, "change": 2048, "object": 4096, "region_pass": 1024, "ball": 256, "calibration": 64,
    "environment": 64, "environment_width": 256,
}  # fmt: skip
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
    """The scene at `SCALE` of its frame, with fewer samples."""
    camera = scene.camera
    smaller = camera.model_copy(
        update={n: SCALE * getattr(camera, n) for n in ("fx", "fy", "cx", "cy")}
        | {n: 2 * round(SCALE * getattr(camera, n) / 2) for n in ("width", "height")}
    )
    sampling = scene.sampling.model_copy(update=SAMPLING)
    return scene.model_copy(update={"camera": smaller, "sampling": sampling})


def render(scene: SimulatedScene, folder: Path) -> Pictures:
    """Radiance of all photographs; truth and objects are written into ``folder``. Minutes."""
    mi = use_mitsuba()
    studio = simulate.Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera))
    shoot = capture.Shoot(scene, folder, capture.sensor_of(scene))
    views = {view.name: studio.pose(view) for view in [scene.plate, *scene.ball_view]}
    for model in scene.object:
        shapes.write_glb(folder / "objects" / f"{model.name}.glb", shapes.build(model), model)
    measure, sigma = studio.radiance(), scene.camera.blur_sigma_px
    boards = []
    for number, photo in enumerate(scene.calibration):
        pose = simulate.board_pose(scene, studio.lens, photo)
        boards.append(
            blur(studio.photograph(measure, pose, scene.sampling.calibration, 900_000 + 1000 * number), sigma)
        )
    balls = {view.name: simulate.ball_picture(studio, view, print) for view in scene.ball_view}
    plate, noise = simulate.plate_truth(studio, folder, print)
    simulate.surface_truth(studio, folder, views["plate"], print)
    record = capture.truth_record(scene, shoot, views, studio.place.ball_centre, noise)
    capture.write_truth(folder / "truth" / "truth.json", record)
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


def place_of(scene_toml: Path, folder: Path) -> tuple[SimulatedScene, Pictures]:
    """The reduced scene and its pictures, rendered when they are not there."""
    scene = reduced(load_scene(scene_toml))
    kept = folder / "radiance.npz"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        pictures = render(scene, folder)
        pictures.save(kept)
    return scene, Pictures.load(kept)


if __name__ == "__main__":
    place, shots = place_of(Path(sys.argv[1]), Path(sys.argv[2]) / "radiance")
    for index in range(int(sys.argv[3])):
        photograph(place, shots, index, Path(sys.argv[2]) / "radiance", Path(sys.argv[2]) / f"capture_{index:03d}")
