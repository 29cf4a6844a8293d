"""Albedo of the table and of the printed board, as textures whose first row is the far edge (smallest z).

`cv2` is used for the bits of the ArUco dictionary and the layout of the board only: the print is data, not an estimate.
"""

from __future__ import annotations

import numpy as np

from pipeline.run.manifest import BoardFacts
from pipeline.simulation.scene_file import BoxModel, MarkerModel, PrintFacts, TableFacts


def value_noise(x: np.ndarray, z: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in [0, 1]: random values on the integer lattice (repeating after 256), cubic between."""
    lattice = np.random.default_rng(seed).random((256, 256))
    ix, iz = np.floor(x).astype(int), np.floor(z).astype(int)
    fx, fz = x - ix, z - iz
    fx, fz = fx * fx * (3 - 2 * fx), fz * fz * (3 - 2 * fz)
    near = lattice[iz % 256, ix % 256] * (1 - fx) + lattice[iz % 256, (ix + 1) % 256] * fx
    far = lattice[(iz + 1) % 256, ix % 256] * (1 - fx) + lattice[(iz + 1) % 256, (ix + 1) % 256] * fx
    return near * (1 - fz) + far * fz


def wood_albedo(
    x: np.ndarray, z: np.ndarray, albedo: tuple[float, float, float], contrast: float, seed: int
) -> np.ndarray:
    """(..., 3) albedo of planks that run along x, at world positions in metres. ``contrast`` 0 is uniform."""
    plank = np.floor(z / 0.12 + 0.35)
    shade = np.random.default_rng([seed, 5]).uniform(-1, 1, 256)[plank.astype(int) % 256]
    along = x + 0.37 * plank
    bend = value_noise(along * 1.7, z * 11, seed + 1) + 0.45 * value_noise(along * 4.3, z * 31, seed + 2)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (z * 17 + 3.4 * bend))
    fibre = value_noise(along * 24, z * 900, seed + 3) - 0.5
    patch = value_noise(along * 3, z * 6, seed + 4) - 0.5
    groove = np.exp(-(((np.mod(z / 0.12 + 0.35 + 0.5, 1) - 0.5) * 0.12 / 0.0009) ** 2))
    tone = 1 + contrast * (0.15 * shade + 0.24 * (rings**1.5 - 0.4) + 0.16 * fibre + 0.22 * patch)
    tone = tone * (1 - 0.55 * min(contrast, 1.0) * groove)
    warm = contrast * 0.10 * (rings - 0.5)
    colour = np.asarray(albedo) * tone[..., None]
    return colour * (1 + warm[..., None] * np.array([1.0, -0.1, -0.9]))


def speckled_albedo(
    x: np.ndarray, z: np.ndarray, albedo: tuple[float, float, float], contrast: float, seed: int
) -> np.ndarray:
    """(..., 3) albedo of terrazzo: chips of three sizes (3 to 12 mm) of many tones in an even ground."""
    tone = np.ones((*np.broadcast(x, z).shape, 3))
    for number, per_metre in enumerate((85.0, 160.0, 330.0)):
        cell = value_noise(x * per_metre, z * per_metre, seed + 10 + number)
        chip = np.clip((cell - 0.60) / 0.05, 0, 1)[..., None]
        shades = [value_noise(x * per_metre / 2.3, z * per_metre / 2.3, seed + 20 + 3 * number + c) for c in range(3)]
        grey = shades[0][..., None]
        chip_tone = 1 + contrast * (1.9 * (grey - 0.5) + 0.35 * (np.stack(shades, -1) - grey))
        tone = tone * (1 - chip) + chip * chip_tone
    return np.asarray(albedo) * tone


def table_texture(table: TableFacts, seed: int) -> np.ndarray:
    """(H, W, 3) float32 of the whole table top, checked to lie in [0.02, 0.95]."""
    columns = max(2, round((table.x_m[1] - table.x_m[0]) / table.texel_m))
    rows = max(2, round((table.z_m[1] - table.z_m[0]) / table.texel_m))
    x = table.x_m[0] + (np.arange(columns) + 0.5) / columns * (table.x_m[1] - table.x_m[0])
    z = table.z_m[0] + (np.arange(rows) + 0.5) / rows * (table.z_m[1] - table.z_m[0])
    pattern = wood_albedo if table.pattern == "wood" else speckled_albedo
    texture = pattern(x[None, :] + 0 * z[:, None], z[:, None] + 0 * x[None, :], table.albedo, table.contrast, seed)
    if not (texture.min() >= 0.02 and texture.max() <= 0.95):
        raise ValueError(f"table: albedo reaches {texture.min():.3f} to {texture.max():.3f}; expected 0.02 to 0.95")
    return texture.astype(np.float32)


def board_texture(board: BoardFacts, paper: PrintFacts) -> np.ndarray:
    """(H, W, 3) float32 of the ChArUco print with its paper margin."""
    import cv2

    aruco = cv2.aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, board.dictionary))
    layout = aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, dictionary)
    layout.setLegacyPattern(board.legacy)
    square = round(board.square_m * 1000 * paper.px_per_mm)
    margin = round(board.margin_m * 1000 * paper.px_per_mm)
    print_size = (board.squares[0] * square, board.squares[1] * square)
    white = np.pad(layout.generateImage(print_size, marginSize=0, borderBits=1), margin, constant_values=255) / 255.0
    return (np.asarray(paper.ink) + white[..., None] * (np.asarray(paper.paper) - paper.ink)).astype(np.float32)


def marker_texture(marker: MarkerModel, paper: PrintFacts) -> np.ndarray:
    """(H, W, 3) float32 of a marker with its paper margin."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    cells = dictionary.markerSize + 2
    side = cells * max(1, round(marker.side_m * 1000 * paper.px_per_mm / cells))
    margin = round(side * marker.margin_m / marker.side_m)
    bits = cv2.aruco.generateImageMarker(dictionary, marker.id, side, borderBits=1)
    white = np.pad(bits, margin, constant_values=255) / 255.0
    return (np.asarray(paper.ink) + white[..., None] * (np.asarray(paper.paper) - paper.ink)).astype(np.float32)


def box_texture(box: BoxModel, texel_m: float, seed: int) -> np.ndarray:
    """(H, W, 3) float32 around the four sides of a box, and its top below them; checked to lie in [0.02, 0.95]."""
    width, height, depth = box.size_m
    u = (np.arange(round(2 * (width + depth) / texel_m)) + 0.5) * texel_m
    v = (np.arange(round((height + depth) / texel_m)) + 0.5) * texel_m
    pixels = speckled_albedo(u[None, :], v[:, None], box.albedo, box.contrast, seed)
    return np.clip(pixels, 0.02, 0.95).astype(np.float32)
