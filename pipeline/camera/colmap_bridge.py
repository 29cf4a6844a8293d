"""The only importer of pycolmap. COLMAP's pixel origin is ours: no half pixel here."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.conventions import invert_rigid
from pipeline.run.errors import NumericalError
from pipeline.run.formats import write_png
from pipeline.types import Camera, Reconstruction

LARGEST_SIDE_PX = 2400  # features are found on pictures at most this large
FEATURES = 6000  # of a photograph
FEWEST_POINTS = 30
FREE_MODEL, KNOWN_MODEL = "SIMPLE_RADIAL", "FULL_OPENCV"  # the latter is Brown's with its denominator 1
FISHEYE_MODEL = "OPENCV_FISHEYE"


def colmap_camera(camera: Camera) -> Any:
    """The same camera for pycolmap; FULL_OPENCV is Brown's model when its denominator is 1."""
    import pycolmap

    model, params = _model(camera)
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params)


def _model(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's name of a known lens and its numbers."""
    frame, bend = [camera.fx, camera.fy, camera.cx, camera.cy], list(camera.distortion)
    if len(bend) == 4:
        return FISHEYE_MODEL, frame + bend
    return KNOWN_MODEL, frame + bend + [0.0] * (8 - len(bend))


def pose_of_points(camera: Camera, world_points: np.ndarray, px: np.ndarray, max_error_px: float) -> np.ndarray:
    """``world_from_camera`` (4, 4) of points (N, 3) seen at pixels (N, 2), robust (LO-RANSAC over P3P).

    Raises NumericalError when no pose explains at least four of the points.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = 0
    answer = pycolmap.estimate_and_refine_absolute_pose(
        np.asarray(px, float), np.asarray(world_points, float), colmap_camera(camera), options
    )
    if answer is None or answer["num_inliers"] < 4:
        found = 0 if answer is None else answer["num_inliers"]
        raise NumericalError(
            f"pose: {found} of {len(px)} points agree with one pose within {max_error_px:g} px, needed 4; "
            "check the points"
        )
    camera_from_world = np.eye(4)
    camera_from_world[:3] = answer["cam_from_world"].matrix()
    return invert_rigid(camera_from_world)


def reconstruct(
    pictures: dict[str, np.ndarray], bodies: dict[str, int], cameras: list[Camera],
    method: Literal["incremental", "global"] = "incremental", threads: int = 2,
) -> Reconstruction:  # fmt: skip
    """Orient photographs by what they show: SIFT, exhaustive matching, mapping. One seed, so that it repeats.

    Args:
        pictures: (H, W) uint8 by name.
        bodies: number of the camera in ``cameras`` that took each.
        cameras: start of each lens; one whose source is "given" or "calibrated" is held, of any other focal length
            and one radial term are found.
        method: incremental mapping, or global (faster with many photographs).
        threads: the number changes the result in its last digits.

    Raises NumericalError when fewer than three photographs hang together.
    """
    _quiet()
    with tempfile.TemporaryDirectory() as folder:
        root, database = Path(folder), Path(folder) / "database.db"
        (root / "pictures").mkdir()
        files = {name: f"{number:04d}.png" for number, name in enumerate(pictures)}
        _write(pictures, files, root / "pictures")
        for body, camera in enumerate(cameras):
            mine = [files[name] for name in pictures if bodies[name] == body]
            if mine:
                _extract(database, root / "pictures", mine, camera, threads)
        _match(database, threads)
        known = all(_known(cameras[body]) for body in set(bodies.values()))
        models = _map(database, root, method, known, threads)
        if not models:
            raise NumericalError(_too_few(0, len(pictures)))
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
        if best.num_reg_images() < 3 or best.num_points3D() < FEWEST_POINTS:
            raise NumericalError(_too_few(best.num_reg_images(), len(pictures)))
        return _record(best, files, bodies, cameras, method)


def _too_few(oriented: int, given: int) -> str:
    return (
        f"sfm: {oriented} of {given} photographs hang together, needed 3; photograph with more overlap, from places "
        "that differ, with texture in view"
    )


def _known(camera: Camera) -> bool:
    return camera.source in ("given", "calibrated")


def _quiet() -> None:
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value


def _write(pictures: dict[str, np.ndarray], files: dict[str, str], folder: Path) -> None:
    for name, picture in pictures.items():
        write_png(folder / files[name], picture)


def _extract(database: Path, folder: Path, files: list[str], camera: Camera, threads: int) -> None:
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    if _known(camera):
        reader.camera_model, params = _model(camera)
    else:
        reader.camera_model, params = FREE_MODEL, [camera.fx, camera.cx, camera.cy, camera.distortion[0]]
    reader.camera_params = ",".join(repr(float(value)) for value in params)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = threads, LARGEST_SIDE_PX
    options.sift.max_num_features = FEATURES
    pycolmap.extract_features(
        database, folder, image_names=files, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=options, device=pycolmap.Device.cpu,
    )  # fmt: skip


def _match(database: Path, threads: int) -> None:
    import pycolmap

    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = threads
    verification.ransac.random_seed = 0
    pycolmap.match_exhaustive(
        database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu
    )


def _map(database: Path, root: Path, method: str, known: bool, threads: int) -> dict[int, Any]:
    import pycolmap

    options: Any
    (root / "models").mkdir()
    if method == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed, options.num_threads = 0, threads
        return dict(pycolmap.global_mapping(database, root / "pictures", root / "models", options))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = 0, threads
    options.ba_refine_focal_length = options.ba_refine_extra_params = not known
    return dict(pycolmap.incremental_mapping(database, root / "pictures", root / "models", options))


def _record(
    model: Any, files: dict[str, str], bodies: dict[str, int], cameras: list[Camera], method: str
) -> Reconstruction:
    """The model of pycolmap as ours: photographs in the order given, points in the order of their ids."""
    names_of = {file: name for name, file in files.items()}
    images = {names_of[image.name]: image for image in model.images.values() if image.has_pose}
    names = [name for name in files if name in images]
    points = {number: i for i, number in enumerate(sorted(model.points3D))}
    poses, seen_view, seen_point, px = [], [], [], []
    lenses = dict(enumerate(cameras))
    for view, name in enumerate(names):
        image = images[name]
        matrix = np.eye(4)
        matrix[:3] = image.cam_from_world().matrix()
        poses.append(invert_rigid(matrix))
        if not _known(cameras[bodies[name]]):
            lenses[bodies[name]] = _found(cameras[bodies[name]], model.cameras[image.camera_id])
        shown = set()
        for spot in image.points2D:
            if spot.has_point3D() and spot.point3D_id not in shown:
                shown.add(spot.point3D_id)
                seen_view.append(view)
                seen_point.append(points[spot.point3D_id])
                px.append(spot.xy)
    return Reconstruction(
        method=method, names=names, missing=[name for name in files if name not in images],
        world_from_camera=np.array(poses), cameras=[lenses[n] for n in range(len(cameras))],
        camera_of=np.array([bodies[name] for name in names], int),
        points=np.array([model.points3D[number].xyz for number in sorted(model.points3D)]),
        seen_view=np.array(seen_view, int), seen_point=np.array(seen_point, int), px=np.round(np.array(px), 4),
    )  # fmt: skip


def _found(start: Camera, camera: Any) -> Camera:
    """What the mapping made of a free lens."""
    if camera.model.name != FREE_MODEL:
        return start
    focal, cx, cy, k1 = (float(value) for value in camera.params)
    distortion = np.array([k1, 0, 0, 0, 0])
    return start.model_copy(
        update={"fx": focal, "fy": focal, "cx": cx, "cy": cy, "distortion": distortion, "source": "colmap"}
    )
