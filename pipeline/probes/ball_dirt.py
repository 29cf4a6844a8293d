"""Dirt on a mirror ball: spots of its body that are darker than two independent predictions of them.

Where the plane is mirrored: darker than the plane is directly, and darker than the rest of the ball's picture around,
while the plane itself is not brighter there (a highlight would be). Elsewhere, with two views: the spot is darker in
either view than what the other view saw in the same direction, at another place of the ball. One of two alone may be a
photographer, parallax or gloss; both, at one place of the body, are the ball's. Nothing is taken without either.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.lens import project
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.ball_pairs import Pairs, Sight, ball_pixels, ball_points, pixel_step
from pipeline.probes.ball_surface import Surface
from pipeline.probes.reflection import rays_from_directions

DARKER, SIGNIFICANT = 0.10, 5.0  # least loss of light, and its least number of standard deviations
LEAST_SAMPLES = 4  # connected: less is a hot pixel, or chance
MOST = 0.2  # of the ball; more is no dirt but a wrong model
NEAR_RADII = 10.0  # things nearer than this (the plane apart) could be displaced by more than is allowed for
HORIZON = 0.05  # sine of the elevation from which on directions are compared between views
LOOKUP_ROW = 1024


def plane_spots(pairs: Pairs, residual: np.ndarray, scale: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Pairs (M,) that are darker than the direct view of the plane and than their surroundings in the ball.

    ``residual`` (M, 3): log of mirrored over direct times reflectance; ``scale`` (M, 3) expected of it; ``block`` (M,).
    """
    loss, sigma = -residual.mean(1), scale.mean(1)
    dark = np.isfinite(sigma) & (loss > DARKER) & (loss > SIGNIFICANT * sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        own, plane = np.log(pairs.mirrored.mean(1)), np.log(pairs.direct.mean(1))
    for number in np.unique(block[dark]):
        member = (block == number) & np.isfinite(own) & np.isfinite(plane)
        chosen = member & dark
        darker = np.median(own[member]) - own[chosen] > 0.5 * loss[chosen]
        brighter = plane[chosen] - np.median(plane[member]) > 0.5 * loss[chosen]
        dark[chosen] = darker & ~brighter
    return dark & np.isfinite(own)


def shared_spots(one: Sight, other: Sight, surface: Surface, rim: float) -> tuple[np.ndarray, int]:
    """Pixels (M, 2) of ``one`` whose spot of the body is darker in both views than the other view predicts it.

    Also how many pixels could be tested. The ball must not have been moved between the two.
    """
    px = ball_pixels(one, pixel_step(one))
    normal, sine, away, _ = ball_points(one, px + 0.5)
    keep = (sine < rim) & (away[:, 1] > HORIZON)
    px, normal, sine, away = px[keep], normal[keep], sine[keep], away[keep]
    there = _pixel_of_body(other, normal)
    _, sine_there, away_there, _ = ball_points(other, np.nan_to_num(there, nan=1.0))
    with np.errstate(invalid="ignore"):
        facing = np.isfinite(there[:, 0]) & (sine_there < rim) & (away_there[:, 1] > HORIZON)
    px, sine, away = px[facing], sine[facing], away[facing]
    there, sine_there, away_there = there[facing], sine_there[facing], away_there[facing]
    seen, expected, expected_error = _predicted(other, surface, away, rim)
    seen_there, expected_there, error_there = _predicted(one, surface, away_there, rim)
    found, error = _grey(one, px + 0.5)
    found_there, error_of_there = _grey(other, there)
    tested = seen & seen_there & (found > 0) & (found_there > 0)
    dark = _darker(found, expected * surface.at(sine).mean(-1), error, expected_error)
    dark &= _darker(found_there, expected_there * surface.at(sine_there).mean(-1), error_of_there, error_there)
    return px[tested & dark], int(tested.sum())


def _darker(found: np.ndarray, expected: np.ndarray, error: np.ndarray, expected_error: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        loss = -np.log(found / expected)
    return np.asarray((loss > DARKER) & (loss > SIGNIFICANT * np.hypot(error, expected_error)))


def _pixel_of_body(sight: Sight, normal: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of the spots of the ball with these outward normals (N, 3), world; NaN where they face away."""
    local = normal @ sight.world_from_camera[:3, :3]
    point = sight.centre + sight.radius * local
    facing = (point * local).sum(-1) < 0
    return np.where(facing[:, None], project(sight.camera, point), np.nan)


def _predicted(
    sight: Sight, surface: Surface, directions: np.ndarray, rim: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a view sees world ``directions`` (N, 3), the least radiance about them, and its relative error.

    The least within what parallax may displace: nothing is called dark that is dark somewhere near.
    """
    from scipy.ndimage import minimum_filter

    distance = float(np.linalg.norm(sight.centre))
    local = directions @ sight.world_from_camera[:3, :3]
    rays, sine = rays_from_directions(local, -sight.centre / distance, sight.radius / distance, sight.glass)
    size = sight.camera.fx * sight.radius / distance
    reach = int(np.ceil(np.sqrt(2) / NEAR_RADII * size / 2))  # half the angle, on the ball
    px = project(sight.camera, np.nan_to_num(rays, nan=1.0))
    with np.errstate(invalid="ignore"):
        seen = (sine < rim) & np.isfinite(px).all(-1)
    usable = (sight.picture[..., 6] > 0) & (sight.picture[..., 7] == 0)
    grey = np.where(usable, sight.picture[..., :3].mean(-1), 0)
    low = sight.picture.copy()
    low[..., 0] = minimum_filter(grey, 2 * reach + 1)
    values = _lookup(low, np.where(seen[:, None], px, 1))
    error = np.sqrt(values[:, 3:6].sum(-1)) / 3 / np.maximum(values[:, 0], 1e-30)
    return seen & (values[:, 0] > 0), values[:, 0] / surface.at(sine).mean(-1), error


def _grey(sight: Sight, px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the channels (N,) at pixels (N, 2), 0 where it is not measured, and its relative error."""
    values = _lookup(sight.picture, px)
    grey = np.where((values[:, 6] > 0.999) & (values[:, 7] == 0), values[:, :3].mean(-1), 0)
    return grey, np.sqrt(values[:, 3:6].sum(-1)) / 3 / np.maximum(grey, 1e-30)


def _lookup(picture: np.ndarray, px: np.ndarray) -> np.ndarray:
    shape = (-(-max(len(px), 1) // LOOKUP_ROW), LOOKUP_ROW)
    if not len(px):
        return np.zeros((0, picture.shape[2]))
    x, y = (np.resize(px[:, i], shape) for i in (0, 1))
    return bilinear(planes(picture), x, y).reshape(-1, picture.shape[2])[: len(px)].astype(float)


def spot_mask(pixels: np.ndarray, shape: tuple[int, int], step: int) -> np.ndarray:
    """Mask (H, W) of dirty pixels from samples (M, 2) that lie ``step`` apart: connected ones, grown by 2 px."""
    from scipy.ndimage import binary_dilation, label

    mask = np.zeros(shape, bool)
    if not len(pixels):
        return mask
    low = pixels.min(0)
    coarse = np.zeros((pixels - low).max(0)[::-1] // step + 1, bool)
    coarse[tuple(((pixels - low) // step).T[::-1])] = True
    labels, _ = label(coarse, np.ones((3, 3)))
    size = np.bincount(labels.ravel())
    size[0] = 0
    kept = size[labels[tuple(((pixels - low) // step).T[::-1])]] >= LEAST_SAMPLES
    mask[tuple(pixels[kept].T[::-1])] = True
    reach = 2 + step
    return np.asarray(binary_dilation(mask, np.ones((2 * reach + 1, 2 * reach + 1))))
