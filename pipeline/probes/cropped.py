"""A mirror ball cut out of photographs, with neither board nor lens: the outermost round outline, seen from afar.

Without the lens a sphere's silhouette is taken as a circle and the camera as looking straight at it; its distance in
radii is a given number. What that costs: directions near the rim by up to asin(R / D) when it is wrong by infinity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.light.sampling import bilinear, planes
from pipeline.probes.sphere_fit import tone
from pipeline.run.errors import CaptureError
from pipeline.types import Camera

RADII, OFFSETS = (0.40, 0.54), 0.1  # of the picture's shorter side: radius of a ball that fills a crop, its centre
AZIMUTHS = 180
STEPS = (4.0, 1.0, 0.25)  # px, of the search on a picture about 400 px wide
OUTERMOST = 0.9  # of the best votes: the silhouette is the outermost of the circles that score so high
MIN_VOTES, MIN_INSIDE = 0.35, 0.6  # real balls had 0.46 to 0.60, noise and other pictures below 0.3
# The camera's axes in the world of a map without a pose: y down is -Y, forward is +Z, so right is -X.
WORLD_FROM_CAMERA = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Circle:
    """Centre and radius [px], first pixel centre at (0.5, 0.5); votes in [0, 1]; share of the outline in the frame."""

    x: float
    y: float
    radius: float
    votes: float
    inside: float


def find_circle(rgb: np.ndarray) -> Circle:
    """The ball's outline in a crop (H, W, 3) that it fills. Raises CaptureError when there is none.

    A vote is the slope of the tone across the circle, saturating, times how squarely it points across. The room's
    picture in the ball has round edges too, and they lie inside: of all radii that score nearly best the largest is
    taken.
    """
    from scipy.ndimage import gaussian_filter

    side = min(rgb.shape[:2])
    down, right = np.gradient(gaussian_filter(tone(rgb), 0.004 * side))
    slope = planes(np.stack([right, down], -1))
    typical = 2 * float(np.median(np.hypot(down, right))) + 1e-9
    step = STEPS[0] * side / 400
    reach = np.arange(-OFFSETS * side, OFFSETS * side + step, step)
    middle = np.array(rgb.shape[1::-1]) / 2
    radii = np.arange(RADII[0] * side, RADII[1] * side, step)
    best = _best(slope, typical, middle[0] + reach, middle[1] + reach, radii, rgb.shape[:2])
    for finer in STEPS[1:]:
        step = finer * side / 400
        around = step * np.arange(-5, 6)
        candidates = [
            _best(slope, typical, c.x + around, c.y + around, c.radius + around, rgb.shape[:2])[0] for c in best
        ]
        best = candidates
    most = max(circle.votes for circle in best)
    outer = max((circle for circle in best if circle.votes >= OUTERMOST * most), key=lambda circle: circle.radius)
    if outer.votes < MIN_VOTES:
        raise CaptureError(
            f"no mirror ball: the best round outline that fills the picture scores {outer.votes:.2f}, needed "
            f"{MIN_VOTES}; crop the photograph to the ball"
        )
    return outer


def _best(
    slope: list[np.ndarray], typical: float, xs: np.ndarray, ys: np.ndarray, radii: np.ndarray, shape: tuple[int, ...]
) -> list[Circle]:
    """For each radius the centre with most votes, those that are local maxima over the radii; the best one first."""
    azimuth = 2 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    x, y = (grid.ravel()[:, None] for grid in np.meshgrid(xs, ys))
    rows = []
    for radius in radii:
        px, py = x + radius * across[:, 0], y + radius * across[:, 1]
        inside = (px > 2) & (px < shape[1] - 2) & (py > 2) & (py < shape[0] - 2)
        found = bilinear(slope, px, py)
        strength = np.linalg.norm(found, axis=-1) + 1e-12
        square = np.abs((found * across).sum(-1))
        votes = (inside * (square / strength) ** 2 * square / (square + typical)).sum(1) / np.maximum(inside.sum(1), 1)
        votes[inside.mean(1) < MIN_INSIDE] = 0
        top = int(votes.argmax())
        rows.append(
            Circle(float(x[top, 0]), float(y[top, 0]), float(radius), float(votes[top]), float(inside[top].mean()))
        )
    scores = np.array([circle.votes for circle in rows])
    padded = np.concatenate([[-1], scores, [-1]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    return [rows[i] for i in sorted(peaks, key=lambda i: -scores[i])]


def camera_of(circle: Circle, shape: tuple[int, ...], distance_ratio: float) -> tuple[Camera, np.ndarray]:
    """A lens that sees a ball of radius 1 at ``distance_ratio`` as this circle, on its axis; and the centre (3,)."""
    focal = circle.radius * np.sqrt(distance_ratio**2 - 1)
    camera = Camera(
        width=shape[1], height=shape[0], fx=focal, fy=focal, cx=circle.x, cy=circle.y, source="a circle, from afar"
    )
    return camera, np.array([0.0, 0.0, distance_ratio])
