"""Find a 24-patch chart in a photograph: OpenCV's detector to know where, the patches' own outlines to know exactly.

OpenCV's corners are off by a fifth of a patch, which is too much. Each patch it points at is grown from its middle over
pixels of its colour; the centroids of those that grow into a square of the right size give the homography, again until
it stands still. A find counts when a 3x3 matrix can make its patches the chart's.

Sources: Ernst, Sivic and others' detector as in OpenCV (cv2.mcc).
Limits: the chart must be fairly frontal and span some 200 pixels; the detector looks for light squares on a dark frame.
"""

from __future__ import annotations

import numpy as np

from pipeline.camera.markers import apply, square_homography
from pipeline.image import balance, chart
from pipeline.types import Raster

LONGEST_PX = 1200  # of the picture given to the detector
CANDIDATES = 4
GAINS = (1.0, 3.0)  # over the brightest half per cent: a chart in the shade is found in the second
ALIKE = 0.12  # log difference to a patch's middle that still is the patch
FEWEST_CENTRES = 10
FARTHEST = 10.0  # mean delta E of a chart's patches after a fit; 24 equal squares leave 22
PATCH_SHARE = (0.35, 1.0)  # of a cell's area that a patch may fill
CENTRES = np.stack(np.meshgrid((np.arange(6) + 0.5) / 6, (np.arange(4) + 0.5) / 4), -1).reshape(-1, 2)


def find(photograph: Raster) -> np.ndarray | None:
    """Corners (4, 2) px of the chart, beside dark skin, bluish green, black, white; None when there is none.

    ``photograph``: R G B of any linear space, roughly white balanced, and its mask.
    """
    rgb = photograph.rgb()
    best, corners = FARTHEST, None
    for rough in _candidates(rgb):
        outline = refined(rgb, rough)
        if outline is None or balance.area(outline) < 24 * 16:
            continue
        patches = chart.measure(photograph, outline)
        read = chart.fit(patches, chart.reference(), hold_out=False)
        if read is not None and (error := float(read.delta_e[read.used].mean())) < best:
            best, corners = error, outline
    return corners


def _candidates(rgb: np.ndarray) -> list[np.ndarray]:
    """Corners (4, 2) px of what OpenCV takes for charts, the likeliest first."""
    import cv2

    scale = min(1.0, LONGEST_PX / max(rgb.shape[:2]))
    small = cv2.resize(np.nan_to_num(rgb), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found = []
    for gain in GAINS:
        level = np.percentile(small, 99.5) / gain
        picture = (255 * np.sqrt(np.clip(small / max(level, 1e-12), 0, 1))).astype(np.uint8)[..., ::-1]
        cv2.setRNGSeed(0)  # its clustering draws numbers: the same picture, the same corners
        detector = cv2.mcc.CCheckerDetector.create()
        detector.setColorChartType(cv2.mcc.MCC24)
        if detector.process(np.ascontiguousarray(picture), CANDIDATES):
            found += [(one.getCost(), np.array(one.getBox(), float) / scale) for one in detector.getListColorChecker()]
    return [corners for _, corners in sorted(found, key=lambda pair: pair[0])]


def refined(rgb: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """The corners (4, 2) px to a fraction of a pixel, from rough ones; None when the patches are not there."""
    for _ in range(6):
        centres = np.array([_centre(rgb, corners, place) for place in CENTRES])
        seen = np.isfinite(centres).all(-1)
        if seen.sum() < FEWEST_CENTRES:
            return None
        previous, corners = corners, _corners_of(CENTRES[seen], centres[seen])
        if np.abs(corners - previous).max() < 0.01:
            break
    return corners


def _corners_of(places: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Corners of the chart whose places (N, 2) are seen at px (N, 2), strays left out."""
    import cv2

    tolerance = max(1.0, 0.1 * float(np.ptp(px, axis=0).max()) / 6)
    cv2.setRNGSeed(0)
    homography, _ = cv2.findHomography(places, px, cv2.RANSAC, tolerance)
    return np.full((4, 2), np.nan) if homography is None else np.asarray(apply(homography, _SQUARE))


_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def _centre(rgb: np.ndarray, corners: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Centroid (2,) px of the patch about a place on the chart; NaN when none of its size is there."""
    import cv2

    nothing = np.full(2, np.nan)
    if not np.isfinite(corners).all():
        return nothing
    half = np.array([1 / 12, 1 / 8])
    homography = square_homography(corners)
    middle = apply(homography, place[None])[0]
    cell = apply(homography, place + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    reach = np.ceil(0.75 * np.ptp(cell, axis=0)).astype(int)
    low, high = np.floor(middle).astype(int) - reach, np.floor(middle).astype(int) + reach + 1
    if low.min() < 0 or high[0] > rgb.shape[1] or high[1] > rgb.shape[0] or reach.min() < 4:
        return nothing
    window = np.asarray(rgb[low[1] : high[1], low[0] : high[0]], np.float32)
    size = max(1, int(0.15 * reach.min()))
    heart = window[reach[1] - size : reach[1] + size + 1, reach[0] - size : reach[0] + size + 1].reshape(-1, 3)
    level = np.median(heart, 0)
    if not level.min() > 0:
        return nothing
    smooth = cv2.medianBlur(window, 3)
    alike = (np.abs(np.log(np.maximum(smooth, 1e-9) / level)).max(-1) < ALIKE).astype(np.uint8)
    _, labels, stats, centroids = cv2.connectedComponentsWithStats(alike, connectivity=4)
    number = int(labels[reach[1], reach[0]])
    left, top, width, height, area = stats[number]
    inside = left > 0 and top > 0 and left + width < window.shape[1] and top + height < window.shape[0]
    share = area / balance.area(cell)
    if number == 0 or not inside or not PATCH_SHARE[0] <= share <= PATCH_SHARE[1]:
        return nothing
    return np.asarray(centroids[number] + low + 0.5)
