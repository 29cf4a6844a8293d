"""Pictures of printed boards of known pose, for the tests: every subsample's ray meets the plane of the print.

Written without the project's projection code.
"""

from __future__ import annotations

import cv2
import numpy as np

BOARD = {"dictionary": "DICT_5X5_100", "squares": (7, 5), "square_m": 0.03, "marker_m": 0.022, "legacy": False}
MARKER = {"dictionary": "DICT_5X5_100", "id": 7, "side_m": 0.1}
CELL_PX = 20  # pixels of the print per square or cell


def looking_at(
    target: np.ndarray, tilt_deg: float, azimuth_deg: float, distance: float, roll_deg: float = 0.0
) -> np.ndarray:
    """``world_from_camera`` of a camera above y = 0 at ``distance``, its axis ``tilt`` from the vertical."""
    tilt, azimuth, roll = np.radians([tilt_deg, azimuth_deg, roll_deg])
    away = np.array([np.sin(tilt) * np.sin(azimuth), np.cos(tilt), np.sin(tilt) * np.cos(azimuth)])
    right = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    down = np.cross(-away, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    pose[:3, 2] = -away
    pose[:3, 3] = target + distance * away
    return pose


def charuco_print(board: dict) -> tuple[np.ndarray, float, np.ndarray]:
    """The print (rows along z, columns along x), its pixels per metre, and the world x, z of its first corner."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board["dictionary"]))
    made = cv2.aruco.CharucoBoard(board["squares"], board["square_m"], board["marker_m"], dictionary)
    made.setLegacyPattern(board["legacy"])
    per_square = 30 * 7  # divisible by squares and by the marker's cells: no edge is rounded
    size = (board["squares"][0] * per_square, board["squares"][1] * per_square)
    return made.generateImage(size, marginSize=0), per_square / board["square_m"], np.zeros(2)


def grid_print(board: dict) -> tuple[np.ndarray, float, np.ndarray]:
    """The same for a grid of markers, each in the middle of its white cell, ids row by row."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board["dictionary"]))
    cells = dictionary.markerSize + 2
    side = 12 * cells
    pitch = round(side * board["square_m"] / board["marker_m"] / 2) * 2
    assert abs(pitch / side * board["marker_m"] / board["square_m"] - 1) < 1e-9  # nothing is rounded
    across, down = board["squares"]
    picture, rim = np.full((down * pitch, across * pitch), 255, np.uint8), (pitch - side) // 2
    for number in range(across * down):
        y, x = number // across * pitch + rim, number % across * pitch + rim
        marker = cv2.aruco.generateImageMarker(dictionary, board.get("first_id", 0) + number, side)
        picture[y : y + side, x : x + side] = marker
    return picture, pitch / board["square_m"], np.zeros(2)


def chessboard_print(board: dict) -> tuple[np.ndarray, float, np.ndarray]:
    """The same for a chessboard whose first square is black, in a white rim of one square."""
    across, down = board["squares"]
    squares = np.pad((np.indices((down, across)).sum(0) % 2 * 255).astype(np.uint8), 1, constant_values=255)
    return np.kron(squares, np.ones((40, 40), np.uint8)), 40 / board["square_m"], np.full(2, -board["square_m"])


def marker_print(marker: dict) -> tuple[np.ndarray, float, np.ndarray]:
    """The same for a single marker with two cells of white around."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker["dictionary"]))
    cells = dictionary.markerSize + 2
    picture = np.full(((cells + 4) * CELL_PX,) * 2, 255, np.uint8)
    picture[2 * CELL_PX : -2 * CELL_PX, 2 * CELL_PX : -2 * CELL_PX] = cv2.aruco.generateImageMarker(
        dictionary, marker["id"], cells * CELL_PX
    )
    per_metre = cells * CELL_PX / marker["side_m"]
    return picture, per_metre, np.full(2, -marker["side_m"] / 2 - 2 * CELL_PX / per_metre)


def straightened(distorted: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Undistorted coordinates by the plain fixed-point iteration, another way than the project's Newton."""
    k1, k2, p1, p2, k3 = distortion
    x, y = distorted.T
    for _ in range(15 if np.any(distortion) else 0):
        s = x * x + y * y
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        bend_x, bend_y = 2 * p1 * x * y + p2 * (s + 2 * x * x), p1 * (s + 2 * y * y) + 2 * p2 * x * y
        x, y = (distorted[:, 0] - bend_x) / radial, (distorted[:, 1] - bend_y) / radial
    return np.stack([x, y], -1)


def photograph(
    printed: tuple[np.ndarray, float, np.ndarray], camera, world_from_camera: np.ndarray, supersample: int = 5,
    black: float = 0.04, white: float = 0.8, table: float = 0.3,
) -> np.ndarray:  # fmt: skip
    """(H, W) float32 linear radiance, box-filtered over each pixel."""
    picture, per_metre, first = printed
    sub = (np.arange(supersample) + 0.5) / supersample
    total = np.zeros((camera.height, camera.width))
    K = camera.K
    for dy in sub:
        for dx in sub:
            y, x = np.meshgrid(np.arange(camera.height) + dy, np.arange(camera.width) + dx, indexing="ij")
            px = np.stack([x, y], -1).reshape(-1, 2)
            xy = straightened((px - K[:2, 2]) / (K[0, 0], K[1, 1]), camera.distortion)
            rays = np.concatenate([xy, np.ones((len(xy), 1))], -1) @ world_from_camera[:3, :3].T
            depth = np.where(rays[:, 1] < 0, -world_from_camera[1, 3] / np.minimum(rays[:, 1], -1e-12), np.nan)
            ground = world_from_camera[[0, 2], 3] + depth[:, None] * rays[:, [0, 2]]
            cell = np.floor((ground - first) * per_metre)
            inside = ((cell >= 0) & (cell < (picture.shape[1], picture.shape[0]))).all(-1)
            index = np.where(inside[:, None], cell, 0).astype(int)
            value = black + (white - black) * picture[index[:, 1], index[:, 0]] / 255
            total += np.where(inside, value, table).reshape(total.shape)
    return (total / supersample**2).astype(np.float32)
