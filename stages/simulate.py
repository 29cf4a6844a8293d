"""Makes a capture with known truth from a SCENE.toml: RAW brackets, board photographs, objects, and the answer.

A Mitsuba scene in ACEScg is photographed through a distorted, slightly soft lens onto a Bayer sensor with photon noise,
read noise, fixed pattern, hot photosites and clipping, and written as DNGs whose shutter labels are rounded as cameras
round them. The truth is path traced with the objects really standing there, with the glTF material, through the same
lens; pixels that the objects cover or change get most of the samples. In the shadows the change is sampled again, with
random numbers that both worlds share; it is added to the plate as photographed, whose own noise is part of the
photographed surface. The stated noise is measured from independent halves.

What the estimators do not model can be added on purpose ([leave] of the scene file): veiling glare, dents of the ball,
curled sheets, a clear coat. Imports nothing that estimates. Limits: no depth of field, no vignetting, no ghosts of the
lens.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.run.errors import ManifestError, ToolError
from pipeline.run.formats import write_bytes
from pipeline.simulation import capture, shapes
from pipeline.simulation.leaving import glare
from pipeline.simulation.lens import Lens, aim, blur, look_at
from pipeline.simulation.light import SMALL_DEG, with_small_lamps
from pipeline.simulation.photograph import (
    Measure,
    camera_rays,
    first_hit,
    latlong_rays,
    mirrored_radiance,
    path_radiance,
    picture,
    surface_albedo,
    trace,
)
from pipeline.simulation.scene_file import BoardPhoto, SimulatedScene, Span, ViewFacts, load_scene
from pipeline.simulation.spectral import Size, main, twin
from pipeline.simulation.thrown import seen_on_table, thrown_irradiance
from pipeline.simulation.world import Place

SMOOTHING_PX = 5.0  # of the light that the ball throws
REGION_GROWTH = 3  # pixels added round the region that gets more samples
CHANGE_SEED = 80_000
LAMP_ITSELF = 1e-3  # of a small lamp's radiance: a sample above it met the lamp by way of a mirror
SHADOW = 0.05  # relative change of what is called a shadow


@dataclass
class Studio:
    """The loaded scene description, Mitsuba, and the seeds of each picture."""

    scene: SimulatedScene
    mi: Any
    place: Place
    lens: Lens

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of a photograph."""
        return self.lens.height, self.lens.width

    def pose(self, view: ViewFacts) -> np.ndarray:
        """world_from_camera of a view; without its own position it is the plate's."""
        position = view.position_m or self.scene.plate.position_m
        target = view.target_m or self.scene.plate.target_m
        return look_at(np.array(position), np.array(target))

    def radiance(self, *parts: dict[str, Any]) -> Measure:
        """Path-traced radiance of the place with these parts in it."""
        return path_radiance(self.mi, self.place.load(*parts), self.scene.sampling.depth)

    def glared(self, picture: np.ndarray) -> np.ndarray:
        """What the lens' glare makes of a picture (H, W, 3)."""
        return glare(picture, self.scene.leave.glare, self.scene.leave.glare_radius_px)

    def sharp(self, raw: np.ndarray) -> np.ndarray:
        """A photograph (H, W, 3) after blur and glare of the lens."""
        return self.glared(blur(raw, self.scene.camera.blur_sigma_px))

    def photograph(self, measure: Measure, pose: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """(H, W, K) before the lens' blur."""
        passes = self.scene.sampling.pass_samples
        return picture(self.mi, camera_rays(self.mi, self.lens, pose), measure, self.shape, samples, passes, seed)


def simulate(scene_toml: Path, out: Path, progress: Callable[[str], None]) -> None:
    """Write the capture that ``scene_toml`` describes into ``out``.

    Raises ManifestError for a bad scene file, or when ``out`` is not empty; ToolError when Mitsuba can only run
    its scalar variants.
    """
    from pipeline.transport.variant import use_mitsuba

    scene = load_scene(scene_toml)
    if out.exists() and any(out.iterdir()):
        raise ManifestError(f"{out}: is not empty; a capture is written into a new folder")
    mi = use_mitsuba()
    if mi.variant().startswith("scalar"):
        raise ToolError("simulate: Mitsuba runs without LLVM and CUDA; one of them is needed; run insitu doctor")
    studio = Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera))
    shoot = capture.Shoot(scene, out, capture.sensor_of(scene))
    for model in scene.object:
        shapes.write_glb(out / "objects" / f"{model.name}.glb", shapes.build(model), model)
    capture.write_manifests(scene, out)
    views = {view.name: studio.pose(view) for view in [scene.plate, *scene.ball_view, *scene.view]}
    take_calibration(studio, shoot, progress)
    take_views(studio, shoot, progress)
    pictures = ball_pictures(studio, progress)
    pictures["plate"], noise = plate_truth(studio, out, progress)
    pictures |= turned_plates(studio, progress)
    capture.take_brackets(shoot, pictures)
    surface_truth(studio, out, views["plate"], progress)
    record = capture.truth_record(scene, shoot, views, studio.place.ball_centre, noise)
    capture.write_truth(out / "truth" / "truth.json", record)
    progress(f"{scene.name}: {len(shoot.exposures)} RAW frames, {len(scene.calibration)} board photographs")


def board_pose(scene: SimulatedScene, lens: Lens, photo: BoardPhoto) -> np.ndarray:
    """world_from_camera of a calibration photograph."""
    board = scene.board
    assert board is not None  # the scene file has been validated: calibration needs a board
    centre = np.array([board.squares[0] * board.square_m / 2, 0.0, board.squares[1] * board.square_m / 2])
    tilt, azimuth = np.radians(photo.tilt_deg), np.radians(photo.azimuth_deg)
    offset = np.array([np.sin(tilt) * np.sin(azimuth), np.cos(tilt), np.sin(tilt) * np.cos(azimuth)])
    pose = look_at(centre + photo.distance_m * offset, centre, np.radians(photo.roll_deg))
    x, y = lens.ideal_from_pixel(photo.at[0] * lens.width, photo.at[1] * lens.height)
    return aim(pose, (float(x), float(y)))


def take_calibration(studio: Studio, shoot: capture.Shoot, progress: Callable[[str], None]) -> None:
    """The board photographs."""
    measure = studio.radiance()
    for number, photo in enumerate(studio.scene.calibration):
        progress(f"board photograph {number + 1} of {len(studio.scene.calibration)}")
        pose = board_pose(studio.scene, studio.lens, photo)
        raw = studio.photograph(measure, pose, studio.scene.sampling.calibration, 900_000 + 1000 * number)
        data = capture.srgb_jpeg(studio.sharp(raw), shoot.sensor, number)
        write_bytes(shoot.out / "calibration" / f"calib_{number:02d}.jpg", data)


def take_views(studio: Studio, shoot: capture.Shoot, progress: Callable[[str], None]) -> None:
    """The further photographs."""
    scene = studio.scene
    measure = studio.radiance()
    for number, view in enumerate(scene.view):
        progress(f"photograph {number + 1} of {len(scene.view)}")
        raw = studio.photograph(measure, studio.pose(view), scene.sampling.calibration, 800_000 + 1000 * number)
        exif = capture.lens_exif(scene.camera)
        data = capture.srgb_jpeg(studio.sharp(raw), shoot.sensor, 1000 + number, "view", exif)
        write_bytes(shoot.out / "views" / f"{view.name}.jpg", data)


def ball_picture(studio: Studio, view: ViewFacts, frame: int | None = None) -> np.ndarray:
    """(H, W, 3) radiance of a ball view, through the lens; of that frame of its bracket which a hand turned."""
    black = mirrored_picture(studio, view, frame)
    return studio.sharp(black + thrown_light(studio, view, black, frame))


def mirrored_picture(studio: Studio, view: ViewFacts, frame: int | None = None) -> np.ndarray:
    """(H, W, 3) of a ball view before the lens' blur, without the light that the ball throws onto the table."""
    return _mirrored(studio, view, frame, studio.scene.sampling.ball, np.inf)


def _mirrored(studio: Studio, view: ViewFacts, frame: int | None, samples: int, brightest: float) -> np.ndarray:
    """The same with so many samples; those above ``brightest`` count nothing."""
    dark, ball = _dark(studio, view)
    reflectance = studio.scene.ball.reflectance
    base = mirrored_radiance(studio.mi, dark, studio.scene.sampling.depth, ball, reflectance, brightest)
    pose, seed = _shot(studio, view, frame)
    return studio.photograph(base, pose, samples, seed)


def _shot(studio: Studio, view: ViewFacts, frame: int | None) -> tuple[np.ndarray, int]:
    """Pose (4, 4) and seed of a ball view, or of that frame of its bracket."""
    pose = turned(studio.pose(view), (0.0, 0.0) if frame is None else studio.scene.bracket.ball_turn_deg[frame])
    number = studio.scene.ball_view.index(view)
    return pose, 100_000 * (2 + number) + (0 if frame is None else 10_000 * (frame + 1))


def _dark(studio: Studio, view: ViewFacts) -> tuple[Any, Any]:
    """The place as a ball view shows it, with a black ball; and that ball."""
    scene = studio.place.load(studio.place.photographer(studio.pose(view)), studio.place.ball(black=True))
    return scene, next(shape for shape in scene.shapes() if shape.id() == "ball")


def thrown_light(studio: Studio, view: ViewFacts, black: np.ndarray, frame: int | None = None) -> np.ndarray:
    """(H, W, 3) of the light that the ball throws onto its surroundings, before the lens; ``black``: the rest.

    It is hard to sample and would speckle the picture. It is smooth, since the ball is convex, so it is found as the
    difference from a black ball under the same random numbers and smoothed, as irradiance on each surface and as
    radiance in the ball; its energy is kept. What it throws of small lamps themselves is traced from them
    (`pipeline.simulation.thrown`), and samples that meet one by way of the ball are left out here.
    """
    scene, place, sampling = studio.scene, studio.place, studio.scene.sampling
    pose, seed = _shot(studio, view, frame)
    small = [lamp for lamp in scene.light.lamp if lamp.diameter_deg < SMALL_DEG]
    lamps = min((scene.light.scale * max(lamp.radiance) for lamp in small), default=np.inf)
    some = max(16, sampling.ball // 4) if small else sampling.ball  # what is smoothed needs fewer
    lit = place.load(place.photographer(studio.pose(view)), place.ball())
    bright = path_radiance(studio.mi, lit, sampling.depth, LAMP_ITSELF * lamps)
    mirror = studio.photograph(bright, pose, some, seed)
    without = _mirrored(studio, view, frame, some, LAMP_ITSELF * lamps) if small else black
    dark, ball = _dark(studio, view)

    def seen(measure: Measure) -> np.ndarray:
        return studio.photograph(measure, pose, sampling.pass_samples, seed)

    surfaces = [list(place.table_and_prints().values()), *([box] for box in place.boxes().values())]
    albedo = [seen(surface_albedo(studio.mi, dark, shapes)) for shapes in surfaces]
    thrown = spread_light(mirror - without, albedo, seen(first_hit(studio.mi, dark, [ball])))
    for number, lamp in enumerate(small):
        radius, reflectance = scene.ball.diameter_m / 2, scene.ball.reflectance
        light = thrown_irradiance(lamp, scene.light.scale, place.ball_centre, radius, reflectance, scene.seed + number)
        thrown = thrown + seen(
            seen_on_table(studio.mi, dark, light, place.ball_centre, surfaces[0], ball, reflectance)
        )  # fmt: skip
    return thrown


def spread_light(light: np.ndarray, albedo: list[np.ndarray], cover: np.ndarray) -> np.ndarray:
    """Smooth the light (H, W, 3) thrown by the ball within each surface and within the ball.

    ``albedo``: (H, W, 4) of each surface, times its coverage, and its coverage; ``cover``: (H, W, 1) of the ball.
    """
    from scipy.ndimage import gaussian_filter

    def within(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        near = gaussian_filter(weight, SMOOTHING_PX)
        sums = gaussian_filter(values * weight[..., None], (SMOOTHING_PX, SMOOTHING_PX, 0))
        return sums / np.maximum(near, 1e-9)[..., None] * (near > 1e-6)[..., None]

    spread = cover * within(light, (cover[..., 0] > 0.999).astype(float))
    for surface in albedo:
        irradiance = within(light / np.maximum(surface[..., :3], 1e-3), (surface[..., 3] > 0.999).astype(float))
        spread = surface[..., :3] * irradiance + spread
    return np.asarray(spread)


def plate_truth(studio: Studio, out: Path, progress: Callable[[str], None]) -> tuple[np.ndarray, dict[str, float]]:
    """Write plate.exr, with_objects.exr and coverage.exr; returns the plate (H, W, 3) and the measured noise."""
    scene, place, sampling = studio.scene, studio.place, studio.scene.sampling
    pose, sigma = studio.pose(scene.plate), studio.scene.camera.blur_sigma_px
    people, objects = place.photographer(pose), place.objects()
    prints = not scene.bare_plate
    with_scene = place.load(people, objects, prints=prints)
    progress("coverage of the objects")
    hits = first_hit(studio.mi, with_scene, list(objects.values()))
    seen = studio.photograph(hits, pose, 4 * sampling.pass_samples, 50_000) if objects else np.zeros((*studio.shape, 0))
    coverage = blur(seen, sigma)
    plate = path_radiance(studio.mi, place.load(people, prints=prints), sampling.depth)
    filled = path_radiance(studio.mi, with_scene, sampling.depth)
    progress(f"plate and with_objects: whole picture, {sampling.plate} samples")
    raw = {"plate": studio.photograph(plate, pose, sampling.plate, 1)}
    raw["with_objects"] = studio.photograph(filled, pose, sampling.plate, 1)
    region = changed_region(raw, coverage, sigma, sampling.region_threshold)
    covered = grow(seen.sum(-1) > 0)
    half = np.zeros(raw["plate"].shape)
    refine(studio, plate, raw["plate"], half, region, sampling.region, 10_000, progress)
    refine(studio, filled, raw["with_objects"], half, region & ~covered, sampling.region, 10_000, progress)
    refine(studio, filled, raw["with_objects"], half, covered, sampling.object, 30_000, progress)
    pictures = {name: blur(values, sigma) for name, values in raw.items()}
    found = measured_noise(pictures, blur(half, sigma), coverage.sum(-1), region)
    truth, finer = resampled_change(studio, (filled, plate), pictures, coverage.sum(-1), progress)
    for name, pixels in (("plate", pictures["plate"]), ("with_objects", truth)):
        capture.write_picture(out / "truth" / f"{name}.exr", studio.glared(pixels))
    names = [model.name for model in scene.object]
    capture.write_layers(
        out / "truth" / "coverage.exr", {n: coverage[..., i] for i, n in enumerate(names)}, studio.shape
    )
    spent = {"spp": sampling.object, "spp_shadow": sampling.region, "spp_else": sampling.plate}
    return studio.glared(pictures["plate"]), found | spent | finer


def turned(pose: np.ndarray, turn: Span) -> np.ndarray:
    """world_from_camera after a turn about the camera's own centre, by degrees to the right and upwards."""
    right, up = np.tan(np.radians(turn))
    return aim(pose, (-float(right), float(up)))  # where the old axis is seen


def turned_plates(studio: Studio, progress: Callable[[str], None]) -> dict[str, np.ndarray]:
    """Plate frames (H, W, 3), "plate_0" and so on, of a hand that turned the camera between them; none on a tripod."""
    made: dict[str, np.ndarray] = {}
    for number, (right, up) in enumerate(studio.scene.bracket.plate_turn_deg):
        if right or up:
            progress(f"plate frame {number}, turned by {right} and {up} degrees")
            pose = turned(studio.pose(studio.scene.plate), (right, up))
            people = studio.place.photographer(studio.pose(studio.scene.plate))
            world = studio.place.load(people, prints=not studio.scene.bare_plate)
            measure = path_radiance(studio.mi, world, studio.scene.sampling.depth)
            raw = studio.photograph(measure, pose, studio.scene.sampling.plate, 40_000 + 1000 * number)
            made[f"plate_{number}"] = studio.sharp(raw)
    return made


def ball_pictures(studio: Studio, progress: Callable[[str], None]) -> dict[str, np.ndarray]:
    """Ball views (H, W, 3) by name, and their frames that a hand turned, "ball_a_0" and so on from the darkest."""
    made: dict[str, np.ndarray] = {}
    for view in studio.scene.ball_view:
        progress(f"{view.name}: mirror ball")
        made[view.name] = ball_picture(studio, view)
        for number, (right, up) in enumerate(studio.scene.bracket.ball_turn_deg):
            if right or up:
                progress(f"{view.name} frame {number}, turned by {right} and {up} degrees")
                made[f"{view.name}_{number}"] = ball_picture(studio, view, number)
    return made


def changed_region(raw: dict[str, np.ndarray], coverage: np.ndarray, sigma: float, threshold: float) -> np.ndarray:
    """(H, W) bool: where the objects are seen, or change the picture by more than the threshold on 5x5 means."""
    change = box_mean(np.linalg.norm(blur(raw["with_objects"] - raw["plate"], sigma), axis=-1))
    relative = change / np.linalg.norm(blur(raw["plate"], sigma), axis=-1)
    return grow(relative > threshold) | grow(coverage.sum(-1) > 0)


def refine(
    studio: Studio, measure: Measure, raw: np.ndarray, half: np.ndarray, where: np.ndarray, samples: int, seed: int,
    progress: Callable[[str], None],
) -> None:  # fmt: skip
    """Replace pixels of ``raw`` by their mean over many passes, and of ``half`` by half the two halves' difference."""
    sampling = studio.scene.sampling
    passes = max(2, round(samples / sampling.region_pass))
    pixels = np.flatnonzero(where)
    if not len(pixels):
        return
    shoot = camera_rays(studio.mi, studio.lens, studio.pose(studio.scene.plate))
    sums = np.zeros((2, len(pixels), 3))
    for number in range(passes):
        progress(f"{len(pixels)} pixels in detail, pass {number + 1} of {passes}")
        sums[number % 2] += trace(studio.mi, shoot, measure, pixels, min(samples, sampling.region_pass), seed + number)
    raw[where] = sums.sum(0) / passes
    half[where] = (sums[0] / ((passes + 1) // 2) - sums[1] / (passes // 2)) / 2


def resampled_change(
    studio: Studio, worlds: tuple[Measure, Measure], pictures: dict[str, np.ndarray], coverage: np.ndarray,
    progress: Callable[[str], None],
) -> tuple[np.ndarray, dict[str, float]]:  # fmt: skip
    """with_objects (H, W, 3) with more samples of the change in the shadows, and the noise that is left there.

    The change of the pictures, as their half floats store it, is averaged with that of new passes by sample count.
    ``worlds``: with and without objects, traced with the same random numbers; ``coverage``: (H, W), of all objects.
    """
    sampling, sigma = studio.scene.sampling, studio.scene.camera.blur_sigma_px
    truth, plate = (pictures[name].astype(np.float16).astype(float) for name in ("with_objects", "plate"))
    where = shadow_pixels(truth, plate, coverage)
    passes = sampling.change // sampling.region_pass
    if passes < 2 or not where.any():
        return truth, {}
    pixels = np.flatnonzero(box_mean(where.astype(float), 1) > 0)  # the lens' blur needs the neighbours
    shoot = camera_rays(studio.mi, studio.lens, studio.pose(studio.scene.plate))
    sums = np.zeros((2, where.size, 3))
    for number in range(passes):
        progress(f"change of {len(pixels)} pixels in the shadows, pass {number + 1} of {passes}")
        seen = [trace(studio.mi, shoot, m, pixels, sampling.region_pass, CHANGE_SEED + number) for m in worlds]
        sums[number % 2, pixels] += seen[0].astype(float) - seen[1]
    first, second = (blur(part.reshape(truth.shape), sigma) for part in sums)
    new, share = (first + second) / passes, sampling.change / (sampling.change + sampling.region)
    half = (first / ((passes + 1) // 2) - second / (passes // 2)) / 2
    step = new - (truth - plate)
    truth = np.where(where[..., None], truth + share * step, truth)
    # The squared step is the old variance plus the new one, the squared half difference is the new one.
    variance = (1 - share) ** 2 * (step**2).sum(-1) + (2 * share - 1) * (half**2).sum(-1)
    relative = np.sqrt(box_mean(np.where(where, variance, 0))) / np.linalg.norm(truth, axis=-1)
    strong = np.linalg.norm(truth - plate, axis=-1) > SHADOW * np.linalg.norm(plate, axis=-1)
    mask = (box_mean(where.astype(float)) > 0.999) & strong
    found: dict[str, float] = {"shadow_pixels": int(mask.sum()), "spp_change": sampling.change}
    return truth, found | ({"shadow_median_rel": float(np.median(relative[mask]))} if mask.any() else {})


def shadow_pixels(truth: np.ndarray, plate: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """(H, W) bool: no object is seen, and the picture changes by more than SHADOW on 5x5 means, or is near that."""
    change = box_mean(np.linalg.norm(truth - plate, axis=-1))
    return grow(change > SHADOW * np.linalg.norm(plate, axis=-1)) & (coverage == 0)


def measured_noise(
    pictures: dict[str, np.ndarray], half_difference: np.ndarray, coverage: np.ndarray, region: np.ndarray
) -> dict[str, float]:
    """Median relative standard deviation of the truth on the objects and in their shadows."""
    truth, plate = pictures["with_objects"], pictures["plate"]
    rms = np.sqrt(box_mean((half_difference**2).sum(-1)))
    relative = rms / np.linalg.norm(truth, axis=-1)
    inside = box_mean(region.astype(float)) > 0.999
    changed = np.linalg.norm(truth - plate, axis=-1) > SHADOW * np.linalg.norm(plate, axis=-1)
    masks = {"object": inside & (coverage > 0.999), "shadow": inside & (coverage == 0) & changed}
    found: dict[str, float] = {"region_fraction": float(region.mean())}
    for name, mask in masks.items():
        if mask.any():
            found[f"{name}_median_rel"] = float(np.median(relative[mask]))
        found[f"{name}_pixels"] = int(mask.sum())
    return found


def surface_truth(studio: Studio, out: Path, pose: np.ndarray, progress: Callable[[str], None]) -> None:
    """Write albedo.exr (as the plate's camera sees it), environment.exr (at the ball's centre), and light elsewhere."""
    scene, place, sampling = studio.scene, studio.place, studio.scene.sampling
    progress("albedo and environment")
    prints = not scene.bare_plate
    surfaces = place.table_and_prints(prints)
    albedo = surface_albedo(studio.mi, place.load(prints=prints), list(surfaces.values()))
    pixels = blur(studio.photograph(albedo, pose, sampling.pass_samples, 60_000), scene.camera.blur_sigma_px)
    capture.write_picture(out / "truth" / "albedo.exr", pixels[..., :3], {"seen": pixels[..., 3]}, "1")
    measure = studio.radiance(place.photographer(pose))
    height, width = sampling.environment_width // 2, sampling.environment_width
    for name, at in {"environment": place.ball_centre, **capture.other_places(scene, place.ball_centre)}.items():
        shoot = latlong_rays(studio.mi, at, width, height)
        light = picture(studio.mi, shoot, measure, (height, width), sampling.environment, sampling.pass_samples, 70_000)
        capture.write_picture(out / "truth" / f"{name}.exr", with_small_lamps(scene.light, light))


def box_mean(values: np.ndarray, half: int = 2) -> np.ndarray:
    """Mean over a square of (2 half + 1)^2 pixels; edges repeat."""
    for axis in (0, 1):
        wide = np.pad(values, [(half, half) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        shifted = [np.take(wide, range(k, k + values.shape[axis]), axis) for k in range(2 * half + 1)]
        values = sum(shifted[1:], shifted[0]) / (2 * half + 1)
    return values


def grow(mask: np.ndarray) -> np.ndarray:
    """The mask and what lies within REGION_GROWTH pixels of it."""
    return box_mean(mask.astype(float), REGION_GROWTH) > 0.5 / (2 * REGION_GROWTH + 1) ** 2


def simulate_spectral(
    scene_toml: Path, out: Path, progress: Callable[[str], None], size: Size | None = None
) -> dict[str, Any]:
    """Compare RGB with spectra on ``scene_toml``: spectral.json, spectral.md and pictures in ``out``; no capture."""
    return twin(scene_toml, out, progress, __name__, size)


if __name__ == "__main__":  # the process that simulate_spectral starts: Mitsuba's variant is global
    from pipeline.transport.variant import switch_to

    sys.exit(main(sys.argv[1:], switch_to))
