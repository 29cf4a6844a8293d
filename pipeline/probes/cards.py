"""Grey cards, charts and grey balls of known reflectance as witnesses of the light: irradiance where they face.

A diffuse surface of reflectance rho shows ``rho E / pi``. A card faces as the plane does if it lies on it: said, or its
four corners, put on the plane, are a rectangle (of its size, if that is given) as far as corners can be told. A tilted
one faces as the pose from its four corners says (`pipeline.camera.resection`), if its size is given and only one pose
explains them. A ball's outline is a cone about its centre, which gives the normal of every pixel, from any place.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays
from pipeline.camera.resection import resect_plane
from pipeline.image import balance
from pipeline.image.colour import convert
from pipeline.probes.grey_ball import LOWEST, RIM, sphere_normals
from pipeline.probes.observation import Shots
from pipeline.run.errors import NumericalError
from pipeline.types import Camera

CORNER_PX = 1.0  # standard deviation of a corner that was clicked
TILT = np.radians(1.0)  # of a card that lies flat: paper curls
REFLECTANCE_SIGMA = 0.02  # relative, of a stated reflectance, and of a surface that is no perfect diffuser
SIZE_SIGMA = 0.01  # relative, of a stated size on the plane: the pose's scale, the card's thickness
RECTANGLE_CHI2 = {3: 16.3, 5: 20.5}  # of so many conditions, exceeded once in a thousand
LEAST_AMBIGUITY = 9.0  # chi2 of the second pose of a tilted card over that of the first: three sigma
UP = np.array([0.0, 1.0, 0.0])
BALL_CELLS = 6  # along each side of the square around a ball


@dataclass(frozen=True)
class Cards:
    """Irradiance (M, 3), sigma (M, 3) and unit normals (M, 3), world frame, and what was said of each reference."""

    irradiance: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    sigma: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    normal: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    said: dict[str, str] = field(default_factory=dict)


def cards_of(shots: Shots) -> Cards:
    """All references of known reflectance, in the plate where it shows them (no probe shades them there)."""
    parts, said = [], {}
    for one in shots.facts.get("reference", []):
        seen = {place["view"]: np.array(place["corners_px"], float) for place in one["seen"]}
        view = "plate" if "plate" in seen else next((name for name in seen if name in shots.views), "")
        if one["kind"] != "chart" and one.get("reflectance") is None:
            said[one["name"]] = "no evidence of the lamps: its reflectance is not given"
        elif view not in shots.views or view not in shots.photographs:
            said[one["name"]] = "no evidence of the lamps: no view with a pose shows it"
        else:
            found, said[one["name"]] = (_ball if one["kind"] == "grey_ball" else _card)(shots, one, view, seen[view])
            parts += [found] if found else []
    if not parts:
        return Cards(said=said)
    irradiance, sigma, normal = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Cards(irradiance, sigma, normal, said)


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]


def _reflectance(one: dict[str, Any], cells: int) -> np.ndarray:
    """(K, 3), ACEScg."""
    stated = one.get("reflectance")
    rgb = None if stated is None else convert(np.array(stated), one["reflectance_space"], "acescg")
    return balance.reflectance_of(one["kind"], rgb, cells)


def _card(shots: Shots, one: dict[str, Any], view: str, outline: np.ndarray) -> tuple[Rows | None, str]:
    """One row: the mean over its cells. A slope across it counts as uncertainty."""
    normal, tilt, why = facing(one, shots.camera_of(view), shots.views[view].world_from_camera, outline)
    if normal is None:
        return None, f"no evidence of the lamps: {why}"
    cells = balance.cells_of(
        shots.photographs[view], outline, one["kind"], balance.cells_across([outline], one["kind"])
    )
    cells = balance.greys(cells) if one["kind"] == "chart" else cells
    light = np.pi * cells.mean / _reflectance(one, len(cells.mean))
    light = light[np.isfinite(light).all(-1)]
    if len(light) < balance.FEWEST_CELLS:
        return None, f"no evidence of the lamps: {len(light)} cells usable, needed {balance.FEWEST_CELLS}"
    mean = light.mean(0)
    sigma = np.hypot(light.std(0), mean * np.hypot(REFLECTANCE_SIGMA, tilt))
    return (mean[None], sigma[None], normal[None]), f"irradiance in {view}, {why}"


def facing(
    one: dict[str, Any], camera: Camera, world_from_camera: np.ndarray, outline: np.ndarray
) -> tuple[np.ndarray | None, float, str]:
    """A card's unit normal (3,), world frame, or None; standard deviation of its tilt [rad]; why."""
    size = np.array(one["size_mm"], float) * 1e-3 if one.get("size_mm") else None
    if one.get("on_plane"):
        return UP, TILT, "said to lie on the plane"
    if one.get("on_plane") is None:
        chi2 = rectangle_chi2(camera, world_from_camera, outline, size)
        if chi2 < RECTANGLE_CHI2[3 if size is None else 5]:
            return UP, TILT, f"on the plane: its corners there are a rectangle (chi2 {chi2:.1f})"
    if size is None or len(outline) != 4:
        return None, 0.0, "it does not lie on the plane, as far as its corners tell; give size_mm, or on_plane = true"
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], float) * (size[0], 0, size[1])
    try:
        best, _, ambiguity = resect_plane(camera, points, outline, CORNER_PX)
    except (NumericalError, np.linalg.LinAlgError):
        return None, 0.0, "its four corners give no pose; are they right?"
    if ambiguity < LEAST_AMBIGUITY:
        return None, 0.0, f"two tilts explain its corners (chi2 ratio {ambiguity:.1f}); show it larger or from the side"
    pose = best.world_from_camera
    normal = pose[:3, :3].T @ UP * np.sign(pose[1, 3])  # towards the camera
    tilt = float(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1]))
    normal = world_from_camera[:3, :3] @ normal
    turned = np.degrees(np.arccos(np.clip(normal[1], -1, 1)))
    return (
        normal,
        float(np.hypot(tilt, TILT)),
        f"tilted by {turned:.0f} +- {np.degrees(tilt):.1f} degrees by its corners",
    )


def rectangle_chi2(
    camera: Camera, world_from_camera: np.ndarray, outline: np.ndarray, size: np.ndarray | None
) -> float:
    """How badly four corners (4, 2) px make a rectangle on the plane y = 0, of sides (2,) if given; else infinite."""
    if len(outline) != 4:
        return np.inf

    def conditions(px: np.ndarray) -> np.ndarray:
        rays = pixel_rays(camera, px) @ world_from_camera[:3, :3].T
        start = world_from_camera[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            q = (start - rays * np.where(rays[:, 1:2] < 0, start[1] / rays[:, 1:2], np.nan))[:, [0, 2]]
        first, second = q[1] - q[0], q[2] - q[1]
        lengths = np.linalg.norm([first, second], axis=-1)
        wanted = [*(q[0] - q[1] + q[2] - q[3]), float(first @ second) / lengths.max()]
        return np.array([*wanted, *(lengths - size if size is not None else [])])

    at = conditions(outline)
    if not np.isfinite(at).all():
        return np.inf
    steps = CORNER_PX * np.eye(8).reshape(8, 4, 2)
    slope = np.stack([(conditions(outline + step) - conditions(outline - step)) / 2 for step in steps], -1)
    covariance = slope @ slope.T
    if size is not None:
        covariance[3:, 3:] += np.diag((SIZE_SIGMA * size) ** 2)
    return float(at @ np.linalg.solve(covariance, at))


def _ball(shots: Shots, one: dict[str, Any], view: str, outline: np.ndarray) -> tuple[Rows | None, str]:
    """A row for each cell of the ball: its mean and its normal."""
    camera, photograph = shots.camera_of(view), shots.photographs[view]
    centre, radius = cone(camera, outline)
    height, width = photograph.shape
    low, high = np.floor(outline.min(0)).astype(int), np.ceil(outline.max(0)).astype(int)
    rows, columns = slice(max(low[1], 0), min(high[1], height)), slice(max(low[0], 0), min(high[0], width))
    y, x = np.mgrid[rows, columns] + 0.5
    normal, sine = sphere_normals(pixel_rays(camera, np.stack([x, y], -1).reshape(-1, 2)), centre, radius)
    normal = normal @ shots.views[view].world_from_camera[:3, :3].T
    rgb = np.stack([photograph[c][rows, columns] for c in "RGB"], -1).reshape(-1, 3).astype(float)
    clean = np.isfinite(rgb).all(-1) & (rgb > 0).all(-1) & (photograph["mask"][rows, columns].ravel() == 0)
    used = (sine < RIM) & (normal[:, 1] > LOWEST) & clean
    cell = np.stack([(x.ravel() - low[0]) / (high[0] - low[0]), (y.ravel() - low[1]) / (high[1] - low[1])], -1)
    number = np.minimum((cell * BALL_CELLS).astype(int), BALL_CELLS - 1) @ (BALL_CELLS, 1)
    count = np.bincount(number[used], minlength=BALL_CELLS**2)
    full = count >= max(balance.FEWEST_PIXELS, 0.5 * np.median(count[count > 0])) if used.any() else count > 0
    if full.sum() < balance.FEWEST_CELLS:
        return None, f"no evidence of the lamps: {full.sum()} cells usable, needed {balance.FEWEST_CELLS}"
    light, facings = (
        np.stack([np.bincount(number[used], part[used, c], BALL_CELLS**2)[full] for c in range(3)], -1)
        / count[full, None]
        for part in (rgb * np.pi / _reflectance(one, 1), normal)
    )
    facings /= np.linalg.norm(facings, axis=-1, keepdims=True)
    # One reflectance for all: as rows are taken as independent, each bears what the mean of all must keep.
    sigma = light * np.hypot(REFLECTANCE_SIGMA * np.sqrt(full.sum()), CORNER_PX * RIM / _radius_px(outline))
    return (light, sigma, facings), f"irradiance on {full.sum()} parts of the ball in {view}"


def cone(camera: Camera, outline: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit direction (3,) to a ball's centre, camera frame, and R / D, from its outline (N, 2) or the square around it.

    Rays of an outline lie on a cone: ``ray . a = 1`` with ``a`` along the axis, ``1 / |a|`` the cosine of its angle.
    """
    edge = (outline + np.roll(outline, -1, 0)) / 2 if len(outline) == 4 else outline
    a = np.linalg.lstsq(pixel_rays(camera, edge), np.ones(len(edge)), rcond=None)[0]
    length = float(np.linalg.norm(a))
    return a / length, float(np.sqrt(max(1 - 1 / length**2, 1e-12)))


def _radius_px(outline: np.ndarray) -> float:
    return float(np.ptp(outline, axis=0).mean() / 2)
