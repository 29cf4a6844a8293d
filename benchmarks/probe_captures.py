"""The probe on captures with truth and on real photographs of balls, and what an orthographic unwrap makes of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions, latlong_from_direction
from pipeline.image.metrics import box, scale_of
from pipeline.image.truth import Truth, load_truth
from pipeline.light.environment import AXES, irradiance, resize_environment
from pipeline.light.harmonics import COSINE_LOBE, sh9_of_environment
from pipeline.light.sampling import bilinear, planes
from pipeline.probes import sphere_fit
from pipeline.probes.cropped import Circle, camera_of
from pipeline.probes.mirror_geometry import Mirror
from pipeline.probes.unwrap import unwrap
from pipeline.run import artifacts as A
from pipeline.run import formats
from pipeline.run.errors import InsituError
from pipeline.types import BallFit, Camera, Raster, View

DATA = Path(os.environ.get("INSITU_DATA", "../shared/data")).resolve()
ROWS = 256  # of the maps that are compared: irradiance differs by less than 1e-4 from the full maps'
AFAR = 1e4  # radii: what orthographic tools assume
REAL = {  # set: files, exposures where their metadata lack them, distance over radius
    "ball_uiuc": (("0024.jpg", "0060.jpg", "0120.jpg", "0205.jpg", "0553.jpg"), None, 15.0),
    "ball_molly1": (
        ("0020.jpg", "0060.jpg", "0160.jpg", "0320.jpg", "0640.jpg"), "1/20,1/60,1/160,1/320,1/640", 20.0,
    ),
    "ball_kartik": (("10.JPG", "40.JPG", "160.JPG"), None, 20.0),
}  # fmt: skip


def built(capture: Path, out: Path) -> Path:
    """Folder of a build of the capture up to its probe, at preview quality."""
    from pipeline.run.cli import main

    code = main(["run", str(capture), "--quality", "preview", "--out", str(out), "--upto", "probe"])
    if code:
        raise SystemExit(code)
    return out


def true_map(truth: Truth, scale: float) -> np.ndarray:
    """The true environment (ROWS, 2 ROWS, 3), world frame, in the plate's unit."""
    assert truth.environment is not None
    coarse = resize_environment(truth.environment, 2 * ROWS, 4 * ROWS)
    u, v = latlong_from_direction(latlong_directions(ROWS, 2 * ROWS) @ truth.world_from_map)
    around = np.concatenate([coarse[:, -1:], coarse, coarse[:, :1]], 1)
    return scale * bilinear(planes(around), u * coarse.shape[1] + 1, v * coarse.shape[0])


def errors(ours: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Of the irradiance: as nine harmonics, over all normals (root mean square), and on the worst of six sides."""
    found, wanted = (sh9_of_environment(picture) * COSINE_LOBE[:, None] for picture in (ours, true))
    sides, true_sides = irradiance(ours, AXES), irradiance(true, AXES)
    worst = np.linalg.norm(sides - true_sides, axis=1) / np.linalg.norm(true_sides, axis=1)
    return {
        "sh_rel_err": float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted)),
        "worst_side_rel_err": float(worst.max()),
    }


def orthographic(photograph: Raster, camera: Camera, view: View, ball: BallFit, reflectance: np.ndarray) -> np.ndarray:
    """The map (ROWS, 2 ROWS, 3) of a tool that fits a circle and takes the camera to be far and to look at the ball.

    It is given the best circle there is, the true camera rotation and the ball's reflectance. What it does not see is
    the mean of what it sees.
    """
    around = 2 * np.pi * np.arange(180) / 180
    px = sphere_fit.silhouette(camera, ball.centre_camera_m, ball.radius_m, around)[0]
    x, y = px.mean(0)
    circle = Circle(float(x), float(y), float(np.linalg.norm(px - (x, y), axis=1).mean()), 1.0, 1.0)
    lens, centre = camera_of(circle, photograph.shape, AFAR)
    mirror = Mirror(lens, view.world_from_camera[:3, :3].T, centre, 1.0, 0.98)
    channels = [np.ascontiguousarray(photograph[c], np.float32) for c in "RGB"]
    found = unwrap(np.ones(photograph.shape, np.float32), channels, mirror, ROWS, 2 * ROWS)
    seen = found.coverage > 0
    return np.where(seen[..., None], found.values, found.values[seen].mean(0)) / reflectance


def measure(capture: Path, out: Path) -> dict[str, Any]:
    """Errors of the capture's map, and of the orthographic peer on its first ball."""
    folder = built(capture, out)

    def read(stage: str, artifact: A.Artifact) -> Any:
        return formats.read(folder / stage, artifact)

    facts, camera, views = read("ingest", A.FACTS), read("calibrate", A.CAMERA), read("pose", A.VIEWS)
    photographs, balls = read("develop", A.PHOTOGRAPHS), read("probe", A.BALLS)
    truth = load_truth(Path(facts["truth_path"]))
    scale = scale_of(box(photographs["plate"].rgb()), box(truth.plate))
    true = true_map(truth, scale)
    ours = resize_environment(read("probe", A.ENVIRONMENT).rgb(), ROWS, 2 * ROWS)
    name, ball = next(iter(balls.items()))
    peer = orthographic(photographs[name], camera, views[name], ball, ball.reflectance)
    return {**errors(ours, true), "orthographic": errors(peer, true), "radius_px": ball.radius_px}


def real(folder: Path) -> dict[str, Any]:
    """What ``insitu ball`` says of each real set: lamps and clipped share, or why it refuses."""
    from stages.ball import ball

    found: dict[str, Any] = {}
    for name, (files, exposures, distance) in REAL.items():
        paths = [DATA / name / file for file in files]
        if not all(path.is_file() for path in paths):
            continue
        try:
            numbers = ball(paths, folder / f"{name}.exr", exposures, distance, 1024, lambda text: None)
        except InsituError as error:
            found[name] = {"refused": str(error)}
            continue
        found[name] = {key: numbers[key] for key in ("circle_px", "clipped_fraction", "correlations", "lamps")}
    if "lamps" in found.get("ball_uiuc", {}):
        found["ball_uiuc"]["lamps_worst_deg"] = against_set(found["ball_uiuc"]["lamps"])
    return found


def against_set(lamps: list[dict[str, Any]]) -> float:
    """Largest angle [deg] between our lamps and those of the set's own map, after one rotation of all."""
    import cv2

    from pipeline.light.emitters import lights

    rgb = cv2.imread(str(DATA / "ball_uiuc/latlon.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(float)
    theirs = np.array([patch.direction for group in lights(rgb, 0.01, np.radians(30)) for patch in group])
    ours = np.array([lamp["direction"] for lamp in lamps])
    ours = ours[np.argmax(ours @ theirs.T, 0)]
    left, _, right = np.linalg.svd(theirs.T @ ours)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    cosine = np.clip((theirs * (ours @ rotation.T)).sum(-1), -1, 1)
    return float(np.degrees(np.arccos(cosine)).max())
