"""A picture in which markers can be found, and the corners of one square marker measured from its four edges.

An edge lies where the light lost along a profile across it says: between plateaus ``white`` and ``black``, a profile of
half length h about the guess has its edge at
``h (1 - 2 (mean - black) / (white - black))``, counted outward. In linear radiance this is unbiased for every
symmetric blur, while OpenCV's corner refinements shrink a marker by 0.25 to 1 %. Lines are fitted on
the marker's own plane, through homography and lens, so neither perspective nor distortion bends them.

Where a cell is but a few blurs wide, the white cells of the code shine through the black border and would pull the
edge outward. The code is known, so what leaks is taken off: blur (Gaussian here) and contrast are fitted to each
edge's mean profile.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.distortion import distort
from pipeline.camera.lens import unproject
from pipeline.conventions import WORLD_FROM_MARKER, transform_points
from pipeline.run.errors import CaptureError
from pipeline.types import Camera

SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)  # corners in ArUco's order, y down the print
PROFILES, SAMPLES = 200, 33  # profiles nearer than a pixel: wider ones beat with the pixel grid
DEEPEST = 3  # rows of cells behind the border that can shine through
BLURS = np.geomspace(0.04, 1.0, 33)  # standard deviations tried, in cells


def grey(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32 mean of the channels of (H, W, 3).

    A board is grey, so any weights show it; equal ones cancel most of the Bayer pattern that demosaicing leaves at its
    edges. Measured on two developed captures: corners to 0.05 px rms, 0.07 to 0.12 px with the weights of luminance.
    """
    return np.asarray(rgb.mean(-1), np.float32)


def tone(radiance: np.ndarray, curve: str = "gamma") -> np.ndarray:
    """(H, W) float32 in [0, 1] of radiance, for finding markers: between robust percentiles, ``gamma`` or ``log``.

    Non-finite pixels become black: markers there cannot be read anyhow.
    """
    finite = np.isfinite(radiance)
    if not finite.any():
        raise CaptureError("picture: no finite pixel, needed a photograph; develop it again")
    sample = radiance[finite][:: max(1, radiance.size // 100_000)]
    low, high = (float(v) for v in np.percentile(sample, (1.0, 99.0)))
    if not high > max(low, 0.0):
        return np.zeros(radiance.shape, np.float32)
    floor = max(low, high * 1e-4) if curve == "log" else min(low, 0.0)
    level = np.minimum(np.maximum(np.where(finite, radiance, floor), floor), high)
    if curve == "log":
        return np.asarray(np.log(level / floor) / np.log(high / floor), np.float32)
    return np.sqrt(np.asarray((level - floor) / (high - floor), np.float32))


def marker_points(side_m: float) -> np.ndarray:
    """Corners (4, 3) of a single marker in the world, in ArUco's order: the first is at -x, -z."""
    right, up = SQUARE[:, 0] - 0.5, 0.5 - SQUARE[:, 1]
    return transform_points(WORLD_FROM_MARKER, np.stack([right, up, np.zeros(4)], -1) * side_m)


def bilinear(picture: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Values at pixels (..., 2), first centre at (0.5, 0.5); NaN outside."""
    x, y = px[..., 0] - 0.5, px[..., 1] - 0.5
    height, width = picture.shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    col = np.clip(np.where(inside, x, 0).astype(int), 0, width - 2)
    row = np.clip(np.where(inside, y, 0).astype(int), 0, height - 2)
    u, v = np.where(inside, x, 0) - col, np.where(inside, y, 0) - row
    top = picture[row, col] * (1 - u) + picture[row, col + 1] * u
    bottom = picture[row + 1, col] * (1 - u) + picture[row + 1, col + 1] * u
    return np.where(inside, top * (1 - v) + bottom * v, np.nan)


def square_homography(corners: np.ndarray) -> np.ndarray:
    """(3, 3) homography from the unit square `SQUARE` to four points (4, 2)."""
    rows = []
    for (u, v), (x, y) in zip(SQUARE, corners, strict=True):
        rows.append([u, v, 1, 0, 0, 0, -u * x, -v * x])
        rows.append([0, 0, 0, u, v, 1, -u * y, -v * y])
    return np.append(np.linalg.solve(np.array(rows), np.asarray(corners, float).ravel()), 1).reshape(3, 3)


def apply(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (..., 2) through a homography."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def fit_marker(radiance: np.ndarray, rough_px: np.ndarray, camera: Camera, black: np.ndarray) -> np.ndarray:
    """Corners (4, 2) px of a marker from its edges in linear radiance (H, W), started at rough corners (4, 2).

    ``black``: (n, n) bool, its black cells with the border; n bounds how far a profile may reach.
    Raises CaptureError when an edge cannot be followed (occluded, clipped or cut by the frame).
    """
    corners = np.asarray(rough_px, float)
    for turn in range(5):
        homography = square_homography(unproject(camera, corners))
        sides = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
        white = ~black if turn else None  # the first corners are too far off to tell the blur
        lines = [_edge(radiance, homography, camera, side, len(black), sides, white) for side in range(4)]
        square = np.array([_cross(lines[side - 1], lines[side]) for side in range(4)])
        fitted = distort(camera.distortion, apply(homography, square)) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        moved = np.abs(fitted - corners).max()
        corners = fitted
        if moved < 1e-3 and turn:
            break
    if not np.isfinite(corners).all() or np.abs(corners - rough_px).max() > max(3.0, 0.05 * sides.max()):
        raise CaptureError(
            "marker: its edges do not meet near its detected corners, needed four clear edges with white paper around; "
            "photograph it unobstructed and unclipped"
        )
    return corners


def _edge(
    radiance: np.ndarray, homography: np.ndarray, camera: Camera, side: int, cells: int, sides: np.ndarray,
    white_cells: np.ndarray | None,
) -> np.ndarray:  # fmt: skip
    """Line (a, b, c), a u + b v = c, of one side on the unit square, fitted to its profiles."""
    start, end = SQUARE[side], SQUARE[(side + 1) % 4]
    along = end - start
    outward = np.array([along[1], -along[0]])
    across_px = min(sides[side - 1], sides[(side + 1) % 4])  # the unit across this edge, at its shorter end
    half = min(0.8 / cells, max(5.0 / across_px, 0.3 / cells))
    t = np.linspace(0.06, 0.94, PROFILES)
    s = (np.arange(SAMPLES) + 0.5) / SAMPLES * 2 - 1
    position = start + t[:, None, None] * along + (s * half)[None, :, None] * outward
    px = distort(camera.distortion, apply(homography, position)) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    values = bilinear(radiance, px)
    if white_cells is not None and np.isfinite(values).all(1).sum() >= PROFILES // 3:
        values = values - _leak(values, t, s * half, np.rot90(white_cells, side), across_px / sides[side])
    plateau = SAMPLES // 6
    black, white = np.median(values[:, :plateau], 1), np.median(values[:, -plateau:], 1)
    contrast = white - black
    usable = np.isfinite(values).all(1) & (contrast > 0.3 * np.nanmedian(contrast)) & (contrast > 0)
    if usable.sum() < PROFILES // 3:
        raise CaptureError(
            f"marker: {int(usable.sum())} of {PROFILES} profiles across an edge are usable, needed {PROFILES // 3}; "
            "photograph it unobstructed and unclipped"
        )
    dark = (white[usable] - values[usable].mean(1)) / contrast[usable]
    offset, place = (2 * dark - 1) * half, t[usable]
    good = np.ones(len(place), bool)
    for _ in range(3):
        slope, level = np.polyfit(place[good], offset[good], 1)
        error = np.abs(offset - (slope * place + level))
        good = error <= max(3 * 1.4826 * float(np.median(error[good])), 0.1 / across_px)
    normal = outward - slope * along
    return np.append(normal, normal @ (start + level * outward))


def _leak(values: np.ndarray, t: np.ndarray, s: np.ndarray, cells: np.ndarray, across_over_along: float) -> np.ndarray:
    """What the white cells add to profiles (P, S) at places ``t`` (P,) along and ``s`` (S,) across an edge.

    ``cells``: (n, n) bool, the white ones, row 0 the border at this edge; lengths in sides of the marker, ``s`` grows
    outward.
    """
    from scipy.special import ndtr

    finite = np.isfinite(values).all(1)
    profile = values[finite].mean(0)
    size, depth = len(cells), np.arange(1, min(DEEPEST + 1, len(cells)))

    def shining(sigma: float) -> tuple[np.ndarray, np.ndarray]:
        """Blurred rows of cells across (rows, S), and how white each is along the edge (P, rows)."""
        reach = ndtr((-np.append(depth, depth[-1] + 1)[:, None] / size - s) / sigma)
        ends = ndtr((t[:, None] - np.arange(size + 1) / size) / (sigma * across_over_along))
        return reach[:-1] - reach[1:], (ends[:, :-1] - ends[:, 1:]) @ cells[depth].T

    best, fitted = np.inf, (0.0, BLURS[0] / size)
    for sigma in BLURS / size:
        rows, white = shining(sigma)
        edge = ndtr(s / sigma) + white[finite].mean(0) @ rows
        columns = np.stack([np.ones_like(s), edge, np.gradient(edge, s)], -1)  # dark, contrast, contrast times shift
        solved, *_ = np.linalg.lstsq(columns, profile, rcond=None)
        misfit = float(((columns @ solved - profile) ** 2).sum())
        if misfit < best:
            best, fitted = misfit, (float(solved[1]), float(sigma))
    rows, white = shining(fitted[1])
    return fitted[0] * white @ rows


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Where two lines (a, b, c) meet."""
    return np.linalg.solve(np.stack([first[:2], second[:2]]), np.array([first[2], second[2]]))
