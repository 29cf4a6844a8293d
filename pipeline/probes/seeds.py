"""Where a mirror ball might be: votes of outlines over the plane or anywhere, and the place nearby that gets most.

A mirror's rim continues its background, so single edges are weak while grain, shadows and mirrored edges are strong:
the whole outline votes at once, every slope saturating.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.lens import unproject
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.outline import Height, azimuths, inside, part_of, radius_in_pixels, silhouette
from pipeline.types import Camera

SEARCH_AZIMUTHS, SEARCH_RADIUS_PX = 36, 20.0
MIN_RADIUS_PX = 8.0  # below this a ball has no profile to fit
MIN_FRAMED = 0.35  # of an outline that may be voted for
BATCH = 20000
ANYWHERE_RADIUS_PX = 10.0
SIZE_STEP = 1.15  # between the radii that are tried where nothing is known


def search_on_plane(
    signals: list[np.ndarray], camera: Camera, radius: float, height: Height, keep: int = 12
) -> np.ndarray:
    """Centres (M <= keep, 3) of balls standing on the plane whose outlines get most votes, best first.

    The centre is restricted to the plane at the ball's height, so the search is over two pixel coordinates; it is done
    on pictures reduced until the ball is about 20 px in radius.
    """
    focal = 0.5 * (camera.fx + camera.fy)
    middle = unproject(camera, np.array([[camera.width / 2, camera.height / 2]]))[0]
    depth = float(_depth_at_height(np.append(middle, 1.0), height, radius))
    typical = focal * radius / depth if depth > 0 else SEARCH_RADIUS_PX
    small, view = zip(
        *(reduced(signal, camera, max(1, round(typical / SEARCH_RADIUS_PX))) for signal in signals), strict=True
    )
    centres = _lattice(view[0], radius, height, 2.0)
    if not len(centres):
        return centres
    return _best_apart(centres, _lattice_votes(list(small), view[0], centres, radius), radius, keep)


def _best_apart(centres: np.ndarray, score: np.ndarray, radius: float, keep: int) -> np.ndarray:
    """The ``keep`` centres of most votes that differ by more than 0.3 radii in place, or 15 % in size."""
    found: list[np.ndarray] = []
    for index in np.argsort(-score):
        if len(found) == keep or not np.isfinite(score[index]):
            break
        here = centres[index]
        for other in found:
            size = np.linalg.norm(here) / np.linalg.norm(other)
            if abs(np.log(size)) < 0.15 and np.linalg.norm(here / size - other) < 0.3 * radius:
                break
        else:
            found.append(here)
    return np.array(found).reshape(-1, 3)


def search_anywhere(
    signals: list[np.ndarray], camera: Camera, radius: float, each: int = 3,
    about_px: tuple[float, float] | None = None,
) -> np.ndarray:  # fmt: skip
    """Centres (M, 3) of balls anywhere: for each size in the picture the ``each`` whose outlines get most votes.

    A lattice of cones per size, on pictures reduced until the ball is about 10 px in radius, from 30 px or 6 % to
    55 % of the frame's shorter side: smaller circles are lamps and knots. ``about_px`` is a click inside the ball,
    which the centre is near; then from 12 px.
    """
    short = min(camera.width, camera.height)
    least = max(30.0, 0.06 * short) if about_px is None else max(12.0, 0.03 * short)
    found = []
    for size in np.exp(np.arange(np.log(least), np.log(0.55 * short), np.log(SIZE_STEP))):
        factor = max(1, round(size / ANYWHERE_RADIUS_PX))
        small, view = zip(*(reduced(signal, camera, factor) for signal in signals), strict=True)
        about = None if about_px is None else np.array(about_px) / factor
        cone = _cones(view[0], radius, size / factor, 2.0 if about is None else 1.0, about)
        if len(cone):
            found.append(_best_apart(cone, _lattice_votes(list(small), view[0], cone, radius), radius, each))
    return np.concatenate([*found, np.zeros((0, 3))])


def _cones(camera: Camera, radius: float, size: float, pitch: float, about: np.ndarray | None) -> np.ndarray:
    """Centres (N, 3) on a pixel lattice at the distance where the ball's outline has ``size`` px; NaN rays left out."""
    x, y = np.meshgrid(np.arange(pitch / 2, camera.width, pitch), np.arange(pitch / 2, camera.height, pitch))
    px = np.stack([x.ravel(), y.ravel()], -1)
    if about is not None:
        px = px[np.linalg.norm(px - about, axis=1) < 0.5 * size]
    xy = unproject(camera, px)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    # Area of the outline, radius rho in angle: pixels per radian grow with 1 / cos^2 along the radius, 1 / cos across.
    secant = np.linalg.norm(rays, axis=1)
    rho = np.arctan(size / (0.5 * (camera.fx + camera.fy) * secant**1.5))
    return rays * (radius / np.sin(rho) / secant)[:, None]


def reduced(signal: np.ndarray, camera: Camera, factor: int) -> tuple[np.ndarray, Camera]:
    """Signal and camera averaged down by a whole factor."""
    if factor == 1:
        return signal, camera
    height, width = (n // factor for n in signal.shape)
    means = signal[: height * factor, : width * factor].reshape(height, factor, width, factor).mean((1, 3))
    scaled = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return means, camera.model_copy(update={"width": width, "height": height, **scaled})


def _lattice(camera: Camera, radius: float, height: Height, pitch: float) -> np.ndarray:
    """Centres (N, 3) at the ball's height on a pixel lattice, those that make an outline of useful size."""
    x, y = np.meshgrid(np.arange(pitch / 2, camera.width, pitch), np.arange(pitch / 2, camera.height, pitch))
    xy = unproject(camera, np.stack([x.ravel(), y.ravel()], -1))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1)
    depths = _depth_at_height(rays, height, radius)
    size = 0.5 * (camera.fx + camera.fy) * radius / np.where(depths > 0, depths, np.inf)
    return (rays * depths[:, None])[(depths > 1.2 * radius) & (size > MIN_RADIUS_PX)]


def _lattice_votes(signals: list[np.ndarray], camera: Camera, centres: np.ndarray, radius: float) -> np.ndarray:
    """Votes of outlines all over small pictures, less half of those just outside; -inf when mostly out of frame."""
    if len(centres) > BATCH:  # the lookups' limit, and bounded memory
        parts = np.array_split(centres, -(-len(centres) // BATCH))
        return np.concatenate([_lattice_votes(signals, camera, part, radius) for part in parts])
    slopes = [_slopes(signal, 0.8) for signal in signals]
    total, beside = np.zeros(len(centres)), [np.zeros((len(centres), 1))] * len(slopes)
    for grown, share in ((1.25, -0.5), (1.0, 1.0)):
        px, normal, _ = silhouette(camera, centres, radius * grown, azimuths(SEARCH_AZIMUTHS))
        framed = inside(camera, px, 1)
        count = np.maximum(framed.sum(-1), 1)
        for i, slope in enumerate(slopes):
            found = bilinear(slope, px[..., 0], px[..., 1])
            strength = np.linalg.norm(found, axis=-1) + 1e-12
            if grown > 1:
                beside[i] = 2 * np.median(strength, -1, keepdims=True) + 1e-9
            across = np.abs((found * normal).sum(-1))
            vote = framed * (across / strength) ** 2 * across / (across + beside[i])
            total += share * vote.sum(-1) / count / len(slopes)
    total[framed.mean(-1) < MIN_FRAMED] = -np.inf
    return total


def _depth_at_height(rays: np.ndarray, height: Height, radius: float) -> np.ndarray:
    """Factor by which rays (..., 3) reach the plane parallel to the ground through the ball's centre."""
    speed = rays @ height.normal
    return (radius - height.offset_m) / np.where(np.abs(speed) < 1e-12, 1e-12, speed)


def _slopes(signal: np.ndarray, sigma_px: float) -> list[np.ndarray]:
    """Gradient (H, W, 2) of the smoothed signal, per pixel, for lookups."""
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(signal, sigma_px, truncate=3)
    down, right = np.gradient(smooth)
    return planes(np.stack([right, down], -1))


def settle(
    signals: list[np.ndarray], camera: Camera, radius: float, seed: np.ndarray, height: Height | None
) -> tuple[np.ndarray, float, float]:
    """Centre (3,) near a seed where the outline has most votes; those, and the median votes about it.

    Three grids of centres, from a tenth of the radius or more to an eighth of a pixel: two coordinates on the plane, or
    without it (``height`` None) two across the ray and the size. A vote is the slope across the outline over that slope
    plus twice the slope usual beside the ball, times how squarely it points across; ``signals`` (H, W) vote alike.
    """
    centre, votes, chance = seed, 0.0, 0.0
    if height is not None:
        centre = seed + height.normal * (radius - height.of(seed))
    typical = min(radius_in_pixels(camera, centre, radius), 200.0)
    free = height is None
    widest = max(5.0, 0.1 * typical) if free else max(10.0, 0.15 * typical)
    coarse = max(1.0, widest / 5) if free else 1.0
    for blur, reach, step in ((1.0, widest, coarse), (1.0, 1.5 * coarse, 0.5 * coarse), (0.7, 0.75, 0.25)):
        metres = radius / radius_in_pixels(camera, centre, radius)
        offsets = np.arange(-reach, reach + 1e-9, step / (2 if step < 0.5 and not free else 1)) * metres
        if height is not None:
            along = np.linalg.svd(height.normal[None])[2][1:]
        else:
            distance = np.linalg.norm(centre)
            along = np.linalg.svd(centre[None] / distance)[2]
            along[0] = centre / radius  # a metre across is as many pixels as this is of size
        grid = centre + np.stack(np.meshgrid(*[offsets] * len(along)), -1).reshape(-1, len(along)) @ along
        azimuth = azimuths(int(np.clip(np.pi * typical, 60, 120 if step >= 1.0 else 360)))
        vote, framed = ballots(signals, camera, grid, radius, blur, azimuth)
        counted = (vote.sum(-1) / np.maximum(framed.sum(-1), 1)).mean(0)
        chance = chance or float(np.median(counted))
        centre, votes = grid[counted.argmax()], float(counted.max())
    return centre, votes, chance


def ballots(
    signals: list[np.ndarray], camera: Camera, centres: np.ndarray, radius: float, blur: float, azimuth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vote (S, N, A) in each signal (H, W) of every azimuth of the outlines of centres (N, 3) that lie close together;

    and whether it is in frame (N, A).
    """
    middle = centres[len(centres) // 2]
    window, view = _around(camera, middle, 1.4 * radius)
    beside = silhouette(view, middle, 1.25 * radius, azimuth)[0]
    px, normal, _ = silhouette(view, centres, radius, azimuth)
    framed = inside(camera, px + np.array([window[1].start, window[0].start]), 2)
    votes = []
    for signal in signals:
        slope = _slopes(signal[window], blur)
        usual = np.linalg.norm(bilinear(slope, beside[None, :, 0], beside[None, :, 1]), axis=-1)
        floor = 2 * float(np.median(usual)) + 1e-9
        found = bilinear(slope, px[..., 0], px[..., 1])
        right, down = found[..., 0], found[..., 1]
        across = np.abs(right * normal[..., 0] + down * normal[..., 1])
        strength = np.sqrt(right * right + down * down) + 1e-12
        votes.append(framed * (across / strength) ** 2 * across / (across + floor))
    return np.stack(votes), framed


def _around(camera: Camera, centre: np.ndarray, radius: float) -> tuple[tuple[slice, slice], Camera]:
    """Rows and columns of the part of a picture about a sphere, with 15 px to spare, and its camera."""
    px = silhouette(camera, centre, radius, azimuths(60))[0]
    limit = np.array([camera.width, camera.height])
    low = np.clip(np.floor(np.nanmin(px, 0)) - 15, 0, limit - 2).astype(int)
    high = np.clip(np.ceil(np.nanmax(px, 0)) + 15, low + 2, limit).astype(int)
    return (slice(low[1], high[1]), slice(low[0], high[0])), part_of(camera, low, high)


def azimuth_count(size: float) -> int:
    """How many azimuths of an outline of ``size`` px in radius are asked."""
    return int(np.clip(np.pi * size, 48, 240))


def coverage(signals: list[np.ndarray], camera: Camera, centre: np.ndarray, radius: float) -> tuple[float, float]:
    """Share of the outline's azimuths, in frame, that vote for it rather than for outlines around it; and chance's.

    Around it are four outlines 3 to 12 px larger, or in proportion for small balls; within it a mirror has stronger
    edges than its rim. An edge of the table crosses an outline here and there; only a ball has it all around. The best
    signal counts.
    """
    size = radius_in_pixels(camera, centre, radius)
    pitch = min(3.0, 0.12 * size)
    azimuth = azimuths(azimuth_count(size))
    shifts = pitch * np.arange(5)
    near = np.array([-0.8, 0.0, 0.8]) * min(1.0, size / 40)
    places = np.array([centre * size / (size + d + e) for d in shifts for e in near])
    best = 0.0
    votes, framed = ballots(signals, camera, places, radius, 0.7, azimuth)
    seen = framed.reshape(len(shifts), len(near), -1).all((0, 1))
    for vote in votes if seen.any() else []:
        first = vote.reshape(len(shifts), len(near), -1).max(1).argmax(0) == 0
        best = max(best, float(first[seen].mean()))
    return best, 1 / len(shifts)
