"""Numbers about a bracket that say whether it will do, at half size: lamps, noise, rim, board, drift between views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.camera.board_families import Layout, Markers, charuco_centres, marker_centres
from pipeline.camera.opencv_bridge import first_calibration, planar_poses
from pipeline.capture.balls import assumed_camera, rim_of
from pipeline.capture.likeness import compare
from pipeline.capture.photographs import Photo, read_photo
from pipeline.capture.roles import Shot
from pipeline.conventions import WORLD_FROM_BOARD, transform_points
from pipeline.run.errors import CaptureError
from pipeline.types import Camera

SNR = 5.0  # of one sample in the darkest part that is needed
DARKEST = 2.0  # percentile of the light that is the darkest part
MOST_STOPS = 8.0  # that can be told from how a clipped spot ends
LARGE = 10**6  # px: no reduction below half size
SAME_CELLS = 0.05  # share of the cells needed to compare two views' light


@dataclass(frozen=True)
class Lamps:
    """Clipped light of a shortest frame: share of the pixels, width of the largest spot [px], stops it is over."""

    share: float
    width_px: float
    stops: float


def disc(shot: Shot, grown: float = 1.0) -> np.ndarray:
    """(h, w) bool: the ball of a view; all of a picture without one."""
    if shot.ball is None:
        return np.ones(shot.clipped.shape, bool)
    step = shot.first.step
    rows, columns = np.mgrid[: shot.clipped.shape[0], : shot.clipped.shape[1]] + 0.5
    return np.hypot(columns * step - shot.ball.x, rows * step - shot.ball.y) < grown * shot.ball.radius


def lamps_of(top: np.ndarray, limit: float, within: np.ndarray, step: int) -> Lamps:
    """What clips in a frame (h, w), within a region.

    A lamp is taken for a spot with a Gaussian profile, A exp(-r^2 / 2 s^2): the area above a level then falls with the
    logarithm of the level, so with areas A0 above the limit and A2 above a quarter of it the peak is 2 A0 / (A2 - A0)
    stops over. A lamp with sharp edges is over by more than can be told: MOST_STOPS. Single cells are hot pixels.
    """
    from scipy.ndimage import label, sum_labels

    spots, count = label(within & (top >= limit / 4), np.ones((3, 3)))
    if not count:
        return Lamps(0.0, 0.0, 0.0)
    numbers = np.arange(1, count + 1)
    clipped = np.asarray(sum_labels(top >= limit, spots, numbers))
    whole = np.asarray(sum_labels(np.ones(top.shape), spots, numbers))
    real = (clipped > 0) & (whole > 1)
    if not real.any():
        return Lamps(0.0, 0.0, 0.0)
    inner, outer = clipped[real], whole[real]
    stops = float(np.clip(2 * inner / np.maximum(outer - inner, 1e-9), 0, MOST_STOPS).max())
    return Lamps(float(inner.sum() / within.sum()), float(2 * np.sqrt(inner.max() / np.pi)) * step, stops)


def darkest_snr(photo: Photo, within: np.ndarray) -> tuple[float, float]:
    """Signal over noise of one sample in the darkest part of a frame's region, and the stops that reach SNR."""
    shot, floor = photo.noise
    signal = float(np.percentile(photo.rgb[within].mean(-1), DARKEST))
    here = max(signal, 0.0) / np.sqrt(shot * max(signal, 0.0) + floor + 1e-30)
    needed = (shot * SNR**2 + np.sqrt(shot**2 * SNR**4 + 4 * SNR**2 * floor)) / 2  # x^2 = SNR^2 (shot x + floor)
    return float(here), float(np.clip(np.log2(needed / max(signal, 1e-6)), 0, 10))


def rim_at_half_size(shot: Shot) -> tuple[float, float, float] | None:
    """Radius, blur (sigma) and share in the frame of the ball's rim, in px of the photograph; None when it fails.

    Measured at half size on the frame that shows most of the rim unclipped and bright.
    """
    if shot.ball is None:
        return None
    ring = disc(shot, 1.15) & ~disc(shot, 0.85)
    shown = [float(np.mean((p.rgb[ring].mean(-1) > 0.01) & ~p.clipped[ring])) for p in shot.photos]
    best = shot.photos[int(np.argmax(shown))]
    if best.step > 2:
        best = read_photo(best.path, best.frame.file, LARGE)
    step, ball = best.step, shot.ball
    light = np.where(best.clipped[..., None], np.minimum(best.rgb, best.limit), best.rgb)
    reach = 2.2 * ball.radius / step
    x, y = ball.x / step, ball.y / step
    left, upper = max(int(x - reach), 0), max(int(y - reach), 0)
    part = light[upper : int(y + reach) + 1, left : int(x + reach) + 1]
    found = rim_of(part, x - left, y - upper, ball.radius / step)
    if found is None:
        return None
    cell = 1 / 12  # variance of the mean over a cell, in cells
    return found[0] * step, float(np.sqrt(max(found[1] ** 2 - cell, 0.0))) * step, ball.visible


def board_points(markers: Markers, layout: Layout) -> tuple[np.ndarray, np.ndarray] | None:
    """Marker centres on the print (N, 2) in squares, and in the picture (N, 2); None when the layout does not say."""
    if layout.kind == "charuco":
        flat = charuco_centres(*layout.squares, layout.legacy)
    elif layout.kind == "grid":
        index = np.arange(layout.squares[0] * layout.squares[1])
        flat = np.stack([index % layout.squares[0], index // layout.squares[0]], -1) + 0.5
    else:
        return None
    place = markers.ids - layout.first_id
    known = (place >= 0) & (place < len(flat))
    return flat[place[known]], marker_centres(markers)[known]


def board_tilt(markers: Markers, layout: Layout, camera: Camera | None = None) -> float | None:
    """Angle [deg] between the board's normal and the line of sight to it; None when it cannot be told.

    ``camera`` of the markers' picture; without it one of a usual angle, which changes the tilt by a few degrees.
    """
    camera = camera or assumed_camera(markers.shape)
    points = board_points(markers, layout)
    if points is None:
        side = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        points = (side, markers.corners[0]) if len(markers.ids) else None
    if points is None or len(points[0]) < 4:
        return None
    xy = (points[1] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    pose = planar_poses(points[0], xy)[0]
    middle = pose[:3, :3] @ np.append(points[0].mean(0), 0) + pose[:3, 3]
    return float(np.degrees(np.arccos(np.clip(abs(pose[:3, 2] @ middle) / np.linalg.norm(middle), 0, 1))))


def marker_side_px(shot: Shot) -> float:
    """Median side of the markers of a bracket, px of the photograph."""
    if shot.markers is None or not len(shot.markers.ids):
        return 0.0
    quads = shot.markers.corners
    return float(np.median(np.linalg.norm(quads - np.roll(quads, 1, 1), axis=-1))) * shot.first.step


def calibration_spread(shots: Sequence[Shot], layout: Layout) -> tuple[list[float], tuple[float, float], Camera | None]:
    """Tilts [deg] of the board photographs, the share of the frame that its markers span (x, y), and the lens."""
    seen = [(s.markers, points) for s in shots if s.markers is not None and (points := board_points(s.markers, layout))]
    seen = [(markers, points) for markers, points in seen if len(points[0]) >= 6]
    if len(seen) < 3:
        return [], (0.0, 0.0), None
    height, width = seen[0][0].shape
    world = [transform_points(WORLD_FROM_BOARD, np.c_[flat, np.zeros(len(flat))]) for _, (flat, _) in seen]
    corners = np.concatenate([markers.corners.reshape(-1, 2) for markers, _ in seen])
    span = np.ptp(corners, axis=0) / (width, height)
    try:
        camera, poses = first_calibration(world, [px for _, (_, px) in seen], (width, height))
    except CaptureError:
        return [], (float(span[0]), float(span[1])), None
    tilts = [float(np.degrees(np.arccos(np.clip(abs(pose[1, 2]), 0, 1)))) for pose in poses]
    return tilts, (float(span[0]), float(span[1])), camera


@dataclass(frozen=True)
class Drift:
    """Of a tripod view against the plate: light (relative change), shift [px], sharpness ratio; labels: one setting?"""

    light_rel: float
    shift_px: float
    sharpness: float
    same_setting: bool


def drift_between(plate: Shot, ball: Shot) -> Drift | None:
    """What changed between plate and a ball's view besides the ball; None when they share too little.

    The pair of frames of the nearest exposures is compared, where neither clips and the ball changed nothing.
    """
    pairs = [(a, b) for a in range(len(plate.photos)) for b in range(len(ball.photos))]
    if plate.light.shape != ball.light.shape:
        return None

    def told(pair: tuple[int, int]) -> float:
        one, other = plate.cells[pair[0]], ball.cells[pair[1]]
        stops = abs(np.log2(max(plate.photos[pair[0]].exposure, 1e-9) / max(ball.photos[pair[1]].exposure, 1e-9)))
        return float((one.usable & other.usable).mean()) / (1 + stops)

    a, b = max(pairs, key=told)
    one, other = plate.cells[a], ball.cells[b]
    like = compare(one, other)
    still = one.usable & other.usable & ~like.changed
    if still.mean() < SAME_CELLS:
        return None
    first, second = plate.photos[a], ball.photos[b]
    difference = (other.log - one.log)[still]
    label = np.log(second.exposure / first.exposure) if min(first.exposure, second.exposure) > 0 else np.nan
    linear = first.frame.encoding == "linear"
    light = float(np.expm1(np.median(difference) - label)) if linear else float("nan")
    keep = upsampled(still, first.top.shape)
    keep &= ~first.clipped & ~second.clipped
    logs = [np.log(np.maximum(photo.rgb.mean(-1), 1e-4)) for photo in (first, second)]
    shift = sub_pixel_shift(logs[0], logs[1], keep)
    sharp = [float(np.median(np.abs(laplacian(log))[keep[1:-1, 1:-1]])) for log in logs]
    return Drift(
        light,
        float(np.hypot(*shift)) * first.step,
        sharp[1] / max(sharp[0], 1e-12),
        abs(label) < 0.01 if linear else False,
    )


def upsampled(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) bool of cells at a picture's size; what the cells do not cover is False."""
    side = [max(1, n // m) for n, m in zip(shape, cells.shape)]
    grown = np.repeat(np.repeat(cells, min(side), 0), min(side), 1)
    full = np.zeros(shape, bool)
    part = grown[: shape[0], : shape[1]]
    full[: part.shape[0], : part.shape[1]] = part
    return full


def laplacian(values: np.ndarray) -> np.ndarray:
    """Five-point Laplacian (h - 2, w - 2) of (h, w)."""
    inner = values[1:-1, 1:-1]
    return np.asarray(values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:] - 4 * inner)


def sub_pixel_shift(one: np.ndarray, other: np.ndarray, keep: np.ndarray) -> tuple[float, float]:
    """Shift (x, y) px of ``other`` (h, w) against ``one`` where ``keep``: least squares on the gradient, outliers cut.

    Lucas and Kanade 1981, with the mean of both gradients (Brandt), four rounds at shifts found so far; up to some px.
    """
    from scipy.ndimage import gaussian_filter, shift

    first, second = gaussian_filter(one, 1.5), gaussian_filter(other, 1.5)
    total = np.zeros(2)
    for _ in range(4):
        moved = shift(second, -total[::-1], order=1, mode="nearest")
        down, right = np.gradient((first + moved) / 2)
        left = (moved - first)[keep]
        left = left - np.median(left)
        scale = 3 * 1.4826 * float(np.median(np.abs(left))) + 1e-9
        good = np.abs(left) < scale
        slopes = np.stack([right[keep][good], down[keep][good]], -1)
        step = -np.linalg.lstsq(slopes.T @ slopes, slopes.T @ left[good], rcond=None)[0]
        total += step
        if np.abs(step).max() < 0.01:
            break
    return float(total[0]), float(total[1])
