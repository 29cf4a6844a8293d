"""Whether a photograph shows a mirror ball, and where: told by its outline and by the lamps that it gathers.

No lens is known yet, so one of a usual angle is assumed: for finding it does. An outline alone is not enough, as
dishes and knots have one too; that the brightest spot of the picture lies within it by stops is what mirrors do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.lens import project
from pipeline.probes import finding, seeds
from pipeline.probes.outline import Height, fraction_in_frame, radius_in_pixels
from pipeline.types import Camera, Raster

FOCAL_OVER_WIDTH = 1.1  # of a lens of about 50 degrees, where nothing tells it
RADIUS_M = 0.05  # any: without the scale only the angle counts
EACH = 2  # places per size that are looked at closer
MERIT, MERIT_WITH_LAMP, MERIT_SURE, LAMP_STOPS = 0.65, 0.45, 0.55, 1.5  # measured: see find_ball
LEAST_VISIBLE = 0.5
LEAST_GROWN, MOST_GROWN, NEARLY = 0.95, 1.6, 0.85  # sizes about a found outline, and share of the best merit


@dataclass(frozen=True)
class BallSeen:
    """A round outline: centre and radius [px of the photograph, first centre at (0.5, 0.5)], and what speaks for it.

    ``merit``: share of azimuths that see the outline, chance taken off; ``lamp_stops``: brightest inside over the
    brightest 0.1 % outside; ``visible``: share of the outline in the frame.
    """

    x: float
    y: float
    radius: float
    merit: float
    lamp_stops: float
    visible: float

    @property
    def sure(self) -> bool:
        """Whether outline and lamps both speak for a ball."""
        return self.merit >= MERIT_SURE and self.lamp_stops >= LAMP_STOPS

    @property
    def is_ball(self) -> bool:
        """Whether it is taken for one."""
        return self.merit >= (MERIT_WITH_LAMP if self.lamp_stops >= LAMP_STOPS else MERIT)


def assumed_camera(shape: tuple[int, ...], focal_35mm: float = 0.0) -> Camera:
    """A pinhole for a picture (h, w): by its 35 mm equivalent where stated (of the diagonal, 43.3 mm), else usual."""
    height, width = shape[:2]
    focal = focal_35mm / 43.27 * float(np.hypot(height, width)) if focal_35mm > 0 else FOCAL_OVER_WIDTH * max(shape[:2])
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, source="assumed")


def find_ball(light: np.ndarray, step: int, focal_35mm: float = 0.0) -> BallSeen | None:
    """The most likely mirror ball of a picture (h, w, 3) linear, each pixel ``step`` px of the photograph wide.

    At half size the balls of two captures had merits of 0.58 to 0.74 and lamps of +3 to +7 stops, the best outlines of
    their plates, which show none, 0.27 and 0.64 with lamps of 0.0 stops.
    """
    camera = assumed_camera(light.shape, focal_35mm)
    signals = finding.signals_of(raster_of(light), None)
    places = seeds.search_anywhere(signals, camera, RADIUS_M, EACH)
    found = [seen for place in places if (seen := settled(light, signals, camera, place, step)) is not None]
    return max(found, key=lambda seen: rank(seen, step), default=None)


def rank(seen: BallSeen, step: int) -> float:
    """How much speaks for an outline: azimuths in excess of chance, in its spread, and stops of its lamps."""
    return seen.merit * float(np.sqrt(min(seen.radius / step, 100.0))) + 0.5 * float(np.clip(seen.lamp_stops, 0, 4))


def settled(
    light: np.ndarray, signals: list[np.ndarray], camera: Camera, place: np.ndarray, step: int
) -> BallSeen | None:
    """The outline near a place (3,) that gets most votes; None when most of it is out of the frame."""
    centre, _, _ = seeds.settle(signals, camera, RADIUS_M, place, None)
    visible = fraction_in_frame(camera, centre, RADIUS_M)
    if visible < LEAST_VISIBLE:
        return None
    share, even = seeds.coverage(signals, camera, centre, RADIUS_M)
    size = radius_in_pixels(camera, centre, RADIUS_M)
    x, y = (float(value) for value in project(camera, centre[None])[0])
    lamp = lamp_stops(light, x, y, size)
    return BallSeen(x * step, y * step, size * step, (share - even) / (1 - even), lamp, visible)


def outermost(
    seen: BallSeen, light: np.ndarray, step: int, behind: np.ndarray | None = None, focal_35mm: float = 0.0
) -> BallSeen:
    """The largest outline about a found one that is seen nearly as well: what a ball mirrors has round edges too.

    ``behind`` (h, w, 3): the same view without the ball, whose difference ends at the rim.
    """
    camera = assumed_camera(light.shape, focal_35mm)
    signals = finding.signals_of(raster_of(light), None if behind is None else raster_of(behind))
    best, found = seen, [seen]
    for place in seeds.search_anywhere(signals, camera, RADIUS_M, 3, (seen.x / step, seen.y / step)):
        if LEAST_GROWN < radius_in_pixels(camera, place, RADIUS_M) * step / seen.radius < MOST_GROWN:
            other = settled(light, signals, camera, place, step)
            if other is not None and np.hypot(other.x - seen.x, other.y - seen.y) < 0.5 * other.radius:
                found.append(other)
                best = max(best, other, key=lambda one: one.merit)
    largest = max((one for one in found if one.merit >= NEARLY * best.merit), key=lambda one: one.radius)
    return replace(largest, merit=best.merit)  # that there is a ball is as sure as the best of its outlines


def lamp_stops(light: np.ndarray, x: float, y: float, radius: float) -> float:
    """Stops by which the brightest spot within a circle [px of ``light``] exceeds the brightest 0.1 % outside it."""
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    away = np.hypot(columns - x, rows - y)
    grey = light.mean(-1)
    inside, outside = grey[away < 0.9 * radius], grey[away > 1.15 * radius]
    if not inside.size or not outside.size:
        return 0.0
    bright = float(np.percentile(outside, 99.9))
    return float(np.log2(max(float(inside.max()), 1e-30) / max(bright, 1e-30)))


def raster_of(light: np.ndarray, sigma_rel: float = 0.01) -> Raster:
    """A picture (h, w, 3) as a photograph whose noise is a share of its light; for finding, not for measuring."""
    floor = 1e-4 * float(np.median(light)) ** 2
    variance = np.square(sigma_rel * light) + floor
    mask = np.zeros(light.shape[:2], np.uint32)
    return Raster({**Raster.split(light), **Raster.split(variance, "variance"), "mask": mask}, "acescg")


def rim_of(light: np.ndarray, x: float, y: float, radius: float) -> tuple[float, float, float] | None:
    """Radius, blur (sigma of the edge) and share in the frame, of a ball near a circle [px of ``light``]; None without.

    A blur in px of ``light``, which is averaged over cells already: 0.29 px of the cell is in it.
    """
    camera = assumed_camera(light.shape)
    ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    rho = np.arctan(radius / (camera.fx * np.linalg.norm(ray) ** 1.5))
    centre = ray / np.linalg.norm(ray) * RADIUS_M / np.sin(rho)
    picture = raster_of(light)
    signals = finding.signals_of(picture, None)
    nothing = Height(np.array([0.0, -1.0, 0.0]), 1.0, 1.0)
    pair = finding.best_fit(signals, picture, camera, RADIUS_M, nothing, [centre], False)
    return None if pair is None else (pair[0].radius_px, pair[0].blur_px, pair[0].visible)
