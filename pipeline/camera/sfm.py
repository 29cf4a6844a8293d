"""A reconstruction from photographs, brought into the world: lens found from its tracks, pose of every view by markers.

The cloud comes from COLMAP in a frame of its own. Markers seen in at least two photographs place it: their corners are
triangulated, a similarity (Umeyama 1991) starts, and `bundle.adjust` finds tracks and corners together. What moves the
edges of all markers alike is scale: it is not in the corners' scatter, and is added to the positions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.adjustment import free_columns, lens_vector, with_lens
from pipeline.camera.bundle import Adjusted, adjust
from pipeline.camera.exif_camera import equivalent_focal_px
from pipeline.camera.lens import pixel_rays
from pipeline.camera.lens_ladder import bound_of, disagreement
from pipeline.camera.reprojection import Bundle, Corners
from pipeline.camera.rigid import umeyama
from pipeline.conventions import transform_points
from pipeline.run.errors import NumericalError
from pipeline.run.evidence import TRIED
from pipeline.types import Camera, Frame, Reconstruction

USUAL_FOCAL = 1.2  # of the long side, without any hint
FOCAL_SIGMA, CENTRE_SIGMA = 0.25, 0.02  # of the start; the principal point in units of the long side
NEEDED_DEVIANCE = 9.0  # per parameter that buys a term of the lens: three standard errors
MOST_POINTS = 5000  # of the cloud that are adjusted: more cost time and add little
CELLS = 8  # of the frame along each side, for keeping points that reach everywhere
EDGE_BIAS_PX = 0.05  # of a marker's side, in every view alike: blur, clipped paper, tone curve
LADDER: tuple[tuple[str, ...], ...] = (("k1",), ("k2",), ("p1", "p2"))


@dataclass(frozen=True)
class Seen:
    """Points of one marker or board in one photograph: which, their place on it (n, 3) m, +Y outward, pixels (n, 2)."""

    marker: int
    points: np.ndarray
    px: np.ndarray


def camera_start(frame: Frame) -> Camera:
    """A start for a lens that nothing is known of but what EXIF says of its focal length."""
    long = max(frame.width, frame.height)
    focal = equivalent_focal_px(frame) or USUAL_FOCAL * long
    return Camera(
        width=frame.width, height=frame.height, fx=focal, fy=focal, cx=frame.width / 2, cy=frame.height / 2,
        source="exif" if frame.focal_35mm > 0 else "guess",
    )  # fmt: skip


def bundle_of(reconstruction: Reconstruction, cameras: list[Camera]) -> Bundle:
    """The cloud and its sightings, for adjusting, with these lenses; at most `MOST_POINTS` points.

    Long tracks are kept before short ones, and those that reach into parts of the frame that few do: distortion shows
    at the corners.
    """
    counted = len(reconstruction.points)
    size = np.array([(camera.width, camera.height) for camera in cameras])[reconstruction.camera_of]
    place = np.clip(reconstruction.px / size[reconstruction.seen_view] * CELLS, 0, CELLS - 1).astype(int)
    cell = place[:, 1] * CELLS + place[:, 0]
    rare = 1 / np.maximum(np.bincount(cell, minlength=CELLS**2), 1)[cell]
    worth = np.bincount(reconstruction.seen_point, weights=rare, minlength=counted)
    kept = np.sort(np.argsort(-worth, kind="stable")[:MOST_POINTS])
    number = np.full(counted, -1)
    number[kept] = np.arange(len(kept))
    mine = number[reconstruction.seen_point] >= 0
    return Bundle(
        cameras, list(reconstruction.world_from_camera), reconstruction.camera_of, reconstruction.points[kept],
        reconstruction.seen_view[mine], number[reconstruction.seen_point[mine]], reconstruction.px[mine],
    )  # fmt: skip


def scale_sigma(done: Adjusted) -> float:
    """Relative standard uncertainty of the world's scale from what biases all markers alike: their edges."""
    sides = [float(np.ptp(corners.px, axis=0).max()) for corners in done.bundle.corners]
    return EDGE_BIAS_PX / float(np.median(sides))


def scaled_covariance(covariance: np.ndarray, pose: np.ndarray, sigma: float) -> np.ndarray:
    """A pose's covariance (6, 6) with that of a common scale about the origin, the first marker."""
    along = np.concatenate([np.zeros(3), pose[:3, 3]]) * sigma
    return covariance + np.outer(along, along)


def self_calibrated(
    reconstruction: Reconstruction, body: int, distortion: str = "auto"
) -> tuple[Camera, dict[str, Any], list[dict[str, Any]]]:
    """Lens of one body from the tracks alone, with covariance; numbers and evidence.

    One focal length and the principal point (held near the middle by a prior of 2 % of the long side) are free; terms
    of distortion are added while the robust deviance of the same tracks falls by more than nine per parameter.
    ``distortion``: as in `lens_ladder.best_lens`.
    """
    start = reconstruction.cameras[body]
    long = max(start.width, start.height)
    prior = np.array([FOCAL_SIGMA * long] * 2 + [CENTRE_SIGMA * long] * 2 + [np.inf] * 5)
    others = [len(lens_vector(camera)) for camera in reconstruction.cameras]
    priors = [prior if n == body else np.full(size, np.inf) for n, size in enumerate(others)]

    bundle = bundle_of(reconstruction, reconstruction.cameras)

    def fit(terms: tuple[str, ...], start: Bundle, like: Adjusted | None) -> Adjusted:
        columns = free_columns(terms, True)
        lens = lens_vector(start.cameras[body]) * (columns.sum(1) > 0)
        cameras = [with_lens(c, lens) if n == body else c for n, c in enumerate(start.cameras)]
        free = [columns if n == body else np.zeros((size, 0)) for n, size in enumerate(others)]
        return adjust(replace(start, cameras=cameras), free, priors, hold_first=True, like=like)

    # noise and outliers are those of the richest model: by a poorer one's, its own misfit would pass for noise
    every = tuple(term for step in LADDER for term in step)
    richest = fit(every, bundle, None)
    terms: tuple[str, ...] = ()
    best = fit(terms, richest.bundle, richest)
    evidence = []
    said = "" if distortion == "auto" else f"knob calibrate.distortion = {distortion}; "
    for step in LADDER:
        richer = fit(terms + step, richest.bundle, richest)
        gain = best.deviance - richer.deviance
        taken = bool(gain > NEEDED_DEVIANCE * len(step)) if distortion == "auto" else distortion == "always"
        apart = disagreement(best.bundle.cameras[body], richer.bundle.cameras[body])
        evidence.append({
            "term": f"lens {' '.join(step)}", "modelled": taken,
            "because": said + f"deviance of the tracks falls by {gain:.0f} (needs {NEEDED_DEVIANCE * len(step):g})",
            "could_cost": "" if taken else f"{apart:.3f} px rms over the frame",
            **({} if taken else TRIED | bound_of(apart)),
        })  # fmt: skip
        if taken:
            best, terms = richer, terms + step
    found = {"covariance": best.lens_covariance[body], "rms_px": float(best.track_sigma_px * np.sqrt(2))}
    camera = best.bundle.cameras[body].model_copy(update={**found, "source": "colmap"})
    sigma = np.sqrt(np.diag(camera.covariance))
    numbers = {
        "source": "colmap", "track_sigma_px": float(best.track_sigma_px), "photos": len(reconstruction.names),
        "points": len(reconstruction.points), "sightings": int(best.used.sum()),
        "left_out": int((~best.used).sum()), "focal_sigma_rel": float(sigma[0] / camera.fx),
        "principal_point_sigma_px": sigma[2:4].tolist(), "terms": list(terms),
    }  # fmt: skip
    return camera, numbers, evidence


def oriented(
    reconstruction: Reconstruction, cameras: list[Camera], seen: dict[str, list[Seen]], corner_sigma_px: float | None
) -> tuple[Adjusted, list[int]]:
    """All views in the world of marker 0, metres; and which markers were placed, by their place in the result.

    ``cameras``: lens of each body, held. ``seen``: by photograph. Raises NumericalError when marker 0 is not seen from
    two places.
    """
    at = {name: view for view, name in enumerate(reconstruction.names)}
    sights: dict[int, list[tuple[int, Seen]]] = {}
    for name, marks in seen.items():
        for one in marks:
            if name in at:
                sights.setdefault(one.marker, []).append((at[name], one))
    placed = {marker: _placed(reconstruction, cameras, marks) for marker, marks in sorted(sights.items())}
    if placed.get(0) is None:
        count = len(sights.get(0, []))
        raise NumericalError(
            f"sfm: the first marker is seen in {count} of the {len(at)} oriented photographs, needed two from places "
            "that differ, to bring the cloud to metres; check its dictionary and id, or photograph it more often"
        )
    markers = [marker for marker, where in placed.items() if where is not None]
    matrix, scale = umeyama(*_matched(placed[0]), scale=True)
    bundle = bundle_of(reconstruction, cameras)
    poses = [_moved(matrix, scale, pose) for pose in bundle.poses]
    places = [np.eye(4)]
    for marker in markers[1:]:
        own, cloud = _matched(placed[marker])
        places.append(umeyama(transform_points(matrix, cloud), own)[0])
    corners = [
        Corners(view, markers.index(marker), one.points, one.px)
        for marker in markers for view, one in sights[marker]
    ]  # fmt: skip
    world = Bundle(
        bundle.cameras, poses, bundle.camera_of, transform_points(matrix, bundle.points), bundle.seen_view,
        bundle.seen_point, bundle.px, places, corners,
    )  # fmt: skip
    return adjust(world, corner_sigma_px=corner_sigma_px), markers


def _matched(placed: tuple[np.ndarray, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
    assert placed is not None
    return placed


def _moved(matrix: np.ndarray, scale: float, pose: np.ndarray) -> np.ndarray:
    """A pose (4, 4) after a similarity (4, 4) of its world."""
    moved = matrix @ pose
    moved[:3, :3] /= scale
    return moved


def _placed(
    reconstruction: Reconstruction, cameras: list[Camera], marks: list[tuple[int, Seen]]
) -> tuple[np.ndarray, np.ndarray] | None:
    """A marker's points (n, 3) in its own frame and triangulated in the cloud's; None from fewer than two places."""
    rays: dict[tuple[float, ...], list[tuple[np.ndarray, np.ndarray]]] = {}
    for view, one in marks:
        pose = reconstruction.world_from_camera[view]
        directions = pixel_rays(cameras[reconstruction.camera_of[view]], one.px) @ pose[:3, :3].T
        for point, direction in zip(one.points, directions, strict=True):
            rays.setdefault(tuple(point), []).append((pose[:3, 3], direction))
    own, cloud = [], []
    for point, beams in rays.items():
        across = [np.eye(3) - np.outer(d, d) for _, d in beams]
        total = np.sum(across, 0)
        values = np.linalg.eigvalsh(total)
        if len(beams) >= 2 and values[0] > 1e-4 * values[-1]:  # rays that differ by half a degree and more
            own.append(point)
            cloud.append(np.linalg.solve(total, np.sum([a @ o for a, (o, _) in zip(across, beams)], 0)))
    return (np.array(own), np.array(cloud)) if len(own) >= 3 else None
