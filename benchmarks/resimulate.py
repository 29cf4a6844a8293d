"""Many captures of one place: its radiance is rendered once and photographed again and again.

    .venv/bin/python -m benchmarks.resimulate SCENE.toml CAPTURE FOLDER COUNT

The truth of the bundled CAPTURE that SCENE.toml made (plate, plate with objects, coverage) is brought to `WIDTH` pixels
across, 2 x 2 to one where it is twice as wide, which leaves it less noise than it had; ball views and board photographs
are rendered at that size.
All is kept in FOLDER/radiance. Capture k then has its own photon and read noise, fixed pattern, hot photosites, JPEG
noise of the board photographs, corners (so lens and pose of its own) and shutter: each setting of the dial is off by
`DIAL`, each frame by `FRAME` more. Its cameras are turned by up to a pixel, so that lamps and edges fall otherwise
on the mosaic; pictures and truth are resampled for that (splines of order 5 on a picture as soft as `BLUR_PX`). Ball
views are rendered on `FINE` points to a pixel and axis, and turned there; then the lens acts, and then the pixels: of a
lamp one or two photosites wide, what photosites make of it is all in the order of these. How soft its ball views are,
which decides that and which nobody states, is drawn from `BALL_PX`.
The ball's reflectance is stated off by what the probe stage takes such numbers to be off by.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.camera.rigid import rotation_exp
from pipeline.probes.ball_surface import GIVEN_SIGMA
from pipeline.run.cli import say
from pipeline.run.formats import read_exr, write_bytes
from pipeline.simulation import capture, shapes
from pipeline.simulation.leaving import glare
from pipeline.simulation.lens import Lens, blur, look_at
from pipeline.simulation.scene_file import SimulatedScene, ViewFacts, load_scene
from pipeline.simulation.world import Place
from pipeline.transport.variant import use_mitsuba
from stages import simulate

WIDTH = 512  # px of a frame: wider truths are halved until they fit
SAMPLING = {"ball": 64, "calibration": 32, "environment": 64, "environment_width": 256}
BLUR_PX = 0.76  # of plate and board photographs: a sharper one could not be resampled by a part of a pixel
BALL_PX = (0.6, 0.85)  # of a ball view, uniform: from nearly as sharp as the bundled captures to a little out of focus
DIAL = 0.01  # of log time, of each setting of the shutter; real ones are off by up to several percent
CORNER_PX = 0.1  # of each corner, as the pose stage takes its own at the full size
FRAME = 0.002  # of log time, of each frame: what one setting repeats to
FINE = 4  # points to a pixel and axis of ball views, each a box: a lamp of a pixel is nowhere off by 2 % of its aliases
FINE_SAMPLES = 16  # of each: the table's noise in a pixel, which no capture's variance has in it, is a percent
TURN_PX = 1.0  # of each camera, either way: a whole period of the mosaic, so that lamps fall on it in every way alike


@dataclass(frozen=True, eq=False)
class Pictures:
    """Radiance (H, W, 3), ACEScg: of the plate and the board photographs, through the lens; of every ball view on
    `FINE` points to a pixel and axis, before the lens.
    """

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


def factor_of(scene: SimulatedScene) -> int:
    """Pixels of the bundled truth along a side that become one."""
    return max(1, scene.camera.width // WIDTH)


def softened_by(own_px: float, factor: int) -> float:
    """Sigma [px] that brings means over factor x factor pixels of a picture as soft as ``own_px`` to `BLUR_PX`.

    A picture's own Gaussian holds its pixel's box, so what averaging adds is the variance of the pixels' centres.
    """
    return float(np.sqrt(BLUR_PX**2 - (own_px / factor) ** 2 - (1 - factor**-2) / 12))


def reduced(scene: SimulatedScene) -> SimulatedScene:
    """The scene at the reduced frame, with fewer samples."""
    camera, factor = scene.camera, factor_of(scene)
    smaller = camera.model_copy(
        update={n: getattr(camera, n) / factor for n in ("fx", "fy", "cx", "cy")}
        | {n: getattr(camera, n) // factor for n in ("width", "height")}
        | {"blur_sigma_px": BLUR_PX}
    )
    sampling = scene.sampling.model_copy(update=SAMPLING)
    return scene.model_copy(update={"camera": smaller, "sampling": sampling})


def smaller(values: np.ndarray, factor: int, soft_px: float) -> np.ndarray:
    """(H / factor, W / factor, ...) means over factor x factor pixels, a little softened."""
    height, width = (size // factor for size in values.shape[:2])
    small = values.reshape(height, factor, width, factor, -1).mean((1, 3)).reshape(height, width, *values.shape[2:])
    return softened(np.asarray(small, float), soft_px)


def softened(picture: np.ndarray, by_px: float) -> np.ndarray:
    """A picture (H, W, ...) blurred by ``by_px`` more: the simulator's lens counts a pixel's box in, which it has."""
    return np.asarray(blur(picture, float(np.hypot(by_px, np.sqrt(1 / 12)))))


def reduce_truth(bundled: Path, folder: Path, shape: tuple[int, int], factor: int, own_px: float) -> np.ndarray:
    """Truth pictures of ``bundled``, as soft as ``own_px``, made smaller and written; returns the plate (H, W, 3)."""

    def shrunk(values: np.ndarray) -> np.ndarray:
        return smaller(values, factor, softened_by(own_px, factor))

    pictures = {}
    for name in ("plate", "with_objects", "albedo"):
        raster = read_exr(bundled / f"{name}.exr")
        extra = {"seen": shrunk(raster["seen"][..., None])[..., 0]} if "seen" in raster.channels else {}
        pictures[name] = shrunk(raster.rgb())
        capture.write_picture(folder / f"{name}.exr", pictures[name], extra)
    layers = {n: shrunk(v[..., None])[..., 0] for n, v in read_exr(bundled / "coverage.exr").channels.items()}
    capture.write_layers(folder / "coverage.exr", layers, shape)
    light = read_exr(bundled / "environment.exr")
    capture.write_picture(folder / "environment.exr", light.rgb())
    return pictures["plate"]


def fine(studio: simulate.Studio) -> simulate.Studio:
    """With `FINE` pixels to one of the camera's along a side, at `FINE_SAMPLES` each."""
    camera, sampling = studio.scene.camera, studio.scene.sampling
    camera = camera.model_copy(
        update={n: getattr(camera, n) * FINE for n in ("fx", "fy", "cx", "cy", "width", "height")}
    )
    sampling = sampling.model_copy(update={"ball": FINE_SAMPLES})
    scene = studio.scene.model_copy(update={"camera": camera, "sampling": sampling})
    return simulate.Studio(scene, studio.mi, studio.place, capture.lens_of(camera))


def ball_before_lens(studio: simulate.Studio, view: ViewFacts) -> np.ndarray:
    """(H * FINE, W * FINE, 3) of a ball view; the smooth light that the ball throws is found at the camera's pixels."""
    from scipy.ndimage import zoom

    thrown = simulate.thrown_light(studio, view, simulate.mirrored_picture(studio, view))
    spread = zoom(thrown, (FINE, FINE, 1), order=1, mode="nearest", grid_mode=True)
    return np.asarray(simulate.mirrored_picture(fine(studio), view) + spread)


def through_lens(scene: SimulatedScene, picture: np.ndarray, soft_px: float, turn: np.ndarray) -> np.ndarray:
    """(H, W, 3) of a fine ball view, turned by ``turn`` (3, 3), behind lens and pixel of ``soft_px`` px together."""
    from scipy.ndimage import gaussian_filter

    sigma = FINE * np.sqrt(soft_px**2 - 1 / 12)  # the boxes of the points make the pixel's
    soft = gaussian_filter(picture.astype(float), (sigma, sigma, 0), mode="nearest")
    moved = seen_turned(capture.lens_of(scene.camera), soft, turn, FINE)
    height, width = picture.shape[0] // FINE, picture.shape[1] // FINE
    seen = moved.reshape(height, FINE, width, FINE, -1).mean((1, 3))
    return np.asarray(glare(seen, scene.leave.glare, scene.leave.glare_radius_px))


def render(whole: SimulatedScene, bundled: Path, folder: Path) -> Pictures:
    """Radiance of all photographs; truth and objects are written into ``folder``. Minutes."""
    mi, scene = use_mitsuba(), reduced(whole)
    studio = simulate.Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera))
    shoot = capture.Shoot(scene, folder, capture.sensor_of(scene))
    views = {view.name: studio.pose(view) for view in [scene.plate, *scene.ball_view]}
    for model in scene.object:
        shapes.write_glb(folder / "objects" / f"{model.name}.glb", shapes.build(model), model)
    plate = reduce_truth(bundled, folder / "truth", studio.shape, factor_of(whole), whole.camera.blur_sigma_px)
    record = capture.truth_record(scene, shoot, views, studio.place.ball_centre, {})
    capture.write_truth(folder / "truth" / "truth.json", record)
    balls = {view.name: ball_before_lens(studio, view) for view in scene.ball_view}
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


def soft_px(scene: SimulatedScene) -> dict[str, float]:
    """Sigma [px] of lens and pixel of each ball view."""
    random = np.random.default_rng([scene.seed, 8])
    return {view.name: float(random.uniform(*BALL_PX)) for view in scene.ball_view}


def turns(scene: SimulatedScene) -> dict[str, np.ndarray]:
    """Rotation (3, 3) of each view's camera against the scene file's: views on the tripod share the plate's."""
    random = np.random.default_rng([scene.seed, 7])
    found: dict[str, np.ndarray] = {}
    for view in [scene.plate, *scene.ball_view]:
        angles = random.uniform(-TURN_PX, TURN_PX, 2) / (scene.camera.fx, scene.camera.fy)
        alone = view is scene.plate or view.position_m is not None
        found[view.name] = rotation_exp(np.array([*angles, 0.0])) if alone else found[scene.plate.name]
    return found


def stated_wrongly(scene: SimulatedScene) -> SimulatedScene:
    """The scene with the ball's reflectance as its owner wrote it down: off by `GIVEN_SIGMA`, all channels alike."""
    off = np.exp(GIVEN_SIGMA * np.random.default_rng([scene.seed, 9]).standard_normal())
    told = tuple(min(float(value * off), 0.999) for value in scene.ball.reflectance)
    return scene.model_copy(update={"ball": scene.ball.model_copy(update={"reflectance": told})})


def seen_turned(lens: Lens, values: np.ndarray, turn: np.ndarray, finer: int = 1) -> np.ndarray:
    """A picture (H, W, C) as the camera sees it when it is turned by ``turn`` (3, 3) in its own frame.

    ``finer``: points of the picture to a pixel of the lens and axis. Splines of order 5, of a picture as soft as
    `BLUR_PX`; of order 3 where the points are finer, as soft to them as to pixels and more.
    """
    from scipy.ndimage import map_coordinates, zoom

    rows, columns = np.mgrid[: lens.height, : lens.width] + 0.5
    rays = np.stack([*lens.ideal_from_pixel(columns, rows), np.ones(rows.shape)], -1)
    moved = lens.project((rays @ turn.T).reshape(-1, 3)).reshape(*rows.shape, 2) - np.stack([columns, rows], -1)
    if finer > 1:  # by how much is smooth
        moved = finer * zoom(moved, (finer, finer, 1), order=1, mode="nearest", grid_mode=True)
    y, x = np.mgrid[: values.shape[0], : values.shape[1]] + np.moveaxis(moved[..., ::-1], -1, 0)
    order = 5 if finer == 1 else 3
    channels = [map_coordinates(channel, [y, x], order=order, mode="nearest") for channel in np.moveaxis(values, -1, 0)]
    return np.stack(channels, -1)


def write_truth_of(scene: SimulatedScene, shared: Path, out: Path, turned: dict[str, np.ndarray]) -> None:
    """The truth of a capture whose cameras are turned; pictures of the plate's camera are resampled."""
    lens, turn = capture.lens_of(scene.camera), turned[scene.plate.name]
    record = json.loads((shared / "truth.json").read_text())
    for name, view in record["views"].items():
        pose = np.array(view["world_from_camera"])
        pose[:3, :3] = pose[:3, :3] @ turned[name]
        view["world_from_camera"] = pose.tolist()
    capture.write_truth(out / "truth.json", record)
    for name in ("plate", "with_objects"):
        rgb = read_exr(shared / f"{name}.exr").rgb().astype(float)
        capture.write_picture(out / f"{name}.exr", seen_turned(lens, rgb, turn))
    layers = read_exr(shared / "coverage.exr").channels
    moved = {n: np.clip(seen_turned(lens, v[..., None].astype(float), turn)[..., 0], 0, 1) for n, v in layers.items()}
    capture.write_layers(out / "coverage.exr", moved, (lens.height, lens.width))
    for name in ("albedo.exr", "environment.exr"):
        (out / name).symlink_to((shared / name).resolve())


def write_poses(scene: SimulatedScene, manifest: Path, turned: dict[str, np.ndarray]) -> None:
    """Append the board's inner corners as surveyed points of the plate and of ball views that moved.

    At this size its markers are too small to be read; so corners are where they truly are, off by `CORNER_PX`.
    """
    board, lens = scene.board, capture.lens_of(scene.camera)
    assert board is not None
    across, down = board.squares
    x, z = (axis.ravel() * board.square_m for axis in np.meshgrid(np.arange(1, across), np.arange(1, down)))
    world = np.stack([x, 0 * x, z], -1)
    lines = []
    for number, view in enumerate([scene.plate, *(v for v in scene.ball_view if v.position_m is not None)]):
        pose = look_at(
            np.array(view.position_m or scene.plate.position_m), np.array(view.target_m or scene.plate.target_m)
        )
        px = lens.project((world - pose[:3, 3]) @ pose[:3, :3] @ turned[view.name])
        px += CORNER_PX * np.random.default_rng([scene.seed, 6, number]).standard_normal(px.shape)
        points = ", ".join(
            f"{{ world_m = {w.tolist()}, px = {p.round(4).tolist()}, sigma_m = 1e-5, sigma_px = {CORNER_PX} }}"
            for w, p in zip(world, px, strict=True)
        )
        lines += ["", "[[pose]]", f'view = "{view.name}"', 'route = "points"', f"points = [{points}]"]
    with manifest.open("a") as file:
        file.write("\n".join(lines) + "\n")


def photograph(scene: SimulatedScene, pictures: Pictures, number: int, shared: Path, out: Path) -> None:
    """Write capture ``number`` into ``out``; objects are a link to those in ``shared``."""
    scene = scene.model_copy(update={"seed": scene.seed + 1000 * (number + 1)})
    out.mkdir(parents=True)
    (out / "objects").symlink_to((shared / "objects").resolve())
    turned, lens, soft = turns(scene), capture.lens_of(scene.camera), soft_px(scene)
    shoot = Reshoot(scene, out, capture.sensor_of(scene))
    capture.write_manifests(stated_wrongly(scene), out)
    write_poses(scene, out / "capture.toml", turned)
    shots = {n: through_lens(scene, ball, soft[n], turned[n]) for n, ball in pictures.balls.items()}
    shots["plate"] = seen_turned(lens, pictures.plate, turned[scene.plate.name])
    capture.take_brackets(shoot, shots)
    for board, picture in enumerate(pictures.boards):
        write_bytes(out / "calibration" / f"calib_{board:02d}.jpg", capture.srgb_jpeg(picture, shoot.sensor, board))
    (out / "truth").mkdir()
    write_truth_of(scene, shared / "truth", out / "truth", turned)


def place_of(scene_toml: Path, bundled: Path, folder: Path) -> tuple[SimulatedScene, Pictures]:
    """The reduced scene and its pictures, rendered when they are not there; ``bundled``: the capture with its truth."""
    whole = load_scene(scene_toml)
    kept = folder / "radiance.npz"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        render(whole, bundled / "truth", folder).save(kept)
    return reduced(whole), Pictures.load(kept)


if __name__ == "__main__":
    scene_file, capture_folder, where = (Path(word) for word in sys.argv[1:4])
    place, shots = place_of(scene_file, capture_folder, where / "radiance")
    for index in range(int(sys.argv[4])):
        photograph(place, shots, index, where / "radiance", where / f"capture_{index:03d}")
