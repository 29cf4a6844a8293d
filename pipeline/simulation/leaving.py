"""What leaves the estimators' model class on purpose: veiling glare, a dented ball, printed sheets that curl."""

from __future__ import annotations

import numpy as np

from pipeline.simulation.light import unit_direction
from pipeline.simulation.scene_file import DentFacts
from pipeline.simulation.shapes import Mesh, grid_faces

SHEET_LIFT_M = 0.0002  # of a curled sheet's lowest line over the table
BALL_ROWS = 512  # of a dented ball's mesh: normals between two rows are off by less than 0.01 degrees
SHEET_COLUMNS = 128


def glare(picture: np.ndarray, share: float, radius_px: float) -> np.ndarray:
    """(H, W, C) of which ``share`` is spread by the bell ``(1 + (r / radius)^2)^(-3/2)``; what lies outside goes on as
    the edge does.

    The bell is cut at half a picture and sums to one, so an even picture stays as it is.
    """
    if share == 0:
        return picture
    from scipy.fft import irfft2, rfft2

    height, width = picture.shape[:2]
    half = (height // 2, width // 2)
    wide = np.pad(picture.astype(float), [(half[0],) * 2, (half[1],) * 2, (0, 0)], mode="edge")
    rows, columns = (np.fft.fftfreq(size) * size for size in wide.shape[:2])
    bell = (1 + (rows[:, None] ** 2 + columns[None, :] ** 2) / radius_px**2) ** -1.5
    bell[(np.abs(rows) > half[0])[:, None] | (np.abs(columns) > half[1])[None, :]] = 0
    spectrum = rfft2(wide, axes=(0, 1)) * rfft2(bell / bell.sum())[..., None]
    spread = irfft2(spectrum, s=wide.shape[:2], axes=(0, 1))
    return np.asarray((1 - share) * picture + share * spread[half[0] : half[0] + height, half[1] : half[1] + width])


def dented_sphere(radius: float, dents: list[DentFacts], rows: int = BALL_ROWS) -> Mesh:
    """A sphere about the origin, its surface at ``radius - sum of depth exp(-angle^2 / (2 sigma^2))``, with exact
    normals.
    """
    theta, phi = np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, 2 * rows + 1)
    sine = np.sin(theta)[::-1, None]  # from the lowest row upwards, as `grid_faces` wants it
    way = np.stack(
        [sine * np.sin(phi), np.broadcast_to(np.cos(theta)[::-1, None], (rows + 1, len(phi))), sine * np.cos(phi)], -1
    )
    distance, slope = np.full(way.shape[:2], radius), np.zeros(way.shape)
    for dent in dents:
        middle, sigma = unit_direction(dent.azimuth_deg, dent.elevation_deg), np.radians(dent.sigma_deg)
        angle = np.arccos(np.clip(way @ middle, -1, 1))
        depth = dent.depth_m * np.exp(-(angle**2) / (2 * sigma**2))
        away = way * np.cos(angle)[..., None] - middle
        away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
        distance = distance - depth
        slope = slope + (depth * angle / sigma**2)[..., None] * away
    normal = distance[..., None] * way - slope
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    faces = grid_faces(rows + 1, len(phi))
    vertices = (distance[..., None] * way).reshape(-1, 3)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) < 1e-14
    return vertices, normal.reshape(-1, 3), faces[~flat]


def curled_sheet(sheet: tuple[float, float, float, float], radius: float) -> tuple[Mesh, np.ndarray]:
    """Mesh and uv of a print (x0, z0, x1, z1) that touches the table along its middle and bends up on both sides of it:
    ``y = (x - middle)^2 / (2 radius)``. Its width is that along x: the arc is longer by a millionth or so.
    """
    x0, z0, x1, z1 = sheet
    x = np.linspace(x0, x1, SHEET_COLUMNS + 1)
    off = (x - (x0 + x1) / 2) / radius
    line = np.stack([x, off**2 * radius / 2 + SHEET_LIFT_M, 0 * x], -1)
    vertices = np.concatenate([line + np.array([0, 0, z]) for z in (z1, z0)])  # near row first: faces look up
    normal = np.stack([-off, np.ones_like(off), 0 * off], -1) / np.hypot(off, 1)[:, None]
    u = np.linspace(0, 1, SHEET_COLUMNS + 1)
    uv = np.concatenate([np.stack([u, 0 * u + v], -1) for v in (1.0, 0.0)])
    return (vertices, np.tile(normal, (2, 1)), grid_faces(2, SHEET_COLUMNS + 1)), uv
