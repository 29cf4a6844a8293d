"""Which printed board a folder's photographs show: the dictionary of its markers, and the layout that their places fit.

Markers of every family are looked for at once. Their numbers tell the order on the board; of all ChArUco boards and
marker grids the one is taken whose marker centres lie where a plane's homography puts them. Sizes in metres cannot be
seen, the ratio of marker to square can. Bridges cv2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.opencv_bridge import dictionary, ours, shrunk
from pipeline.run.board_facts import LAYOUTS

# The largest of each family: the smaller ones are its first markers, so any that reaches far enough reads the same.
FAMILIES = (
    "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12",
    "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10", "DICT_APRILTAG_36h11",
)  # fmt: skip
SMALL_FAMILIES = ("DICT_4X4_1000", "DICT_APRILTAG_16h5")  # 16 bits: noise and texture read as markers
COUNTS = (100, 250, 1000)  # of markers; 50 is never proposed, 100 reads it
UPSAMPLE_BELOW = 1.2e6  # px: half-size pictures of small sensors have markers of 2 px per cell
MAX_RMS = 0.1  # of the marker's side: a lens bends less, a wrong layout is off by whole squares
FEWEST = 6  # markers in a picture that tells a layout
MOST_SQUARES = 20


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers of one family in one picture: ids (N,), corners (N, 4, 2) px, first pixel centre at (0.5, 0.5)."""

    family: str
    ids: np.ndarray
    corners: np.ndarray
    shape: tuple[int, int]  # (h, w) of the picture

    @property
    def area_share(self) -> float:
        """Area of the convex hull of the markers over that of the picture."""
        import cv2

        if not len(self.ids):
            return 0.0
        hull = cv2.convexHull(self.corners.reshape(-1, 2).astype(np.float32))
        return float(cv2.contourArea(hull)) / (self.shape[0] * self.shape[1])


@dataclass(frozen=True)
class Layout:
    """What was printed. ``kind``: charuco, grid or marker; ``marker_over_square``: of a grid, over its pitch."""

    kind: str
    dictionary: str
    squares: tuple[int, int]
    legacy: bool
    marker_over_square: float
    rms: float  # of the marker centres, in marker sides
    pictures: int  # that agree
    ids: tuple[int, ...]
    first_id: int = 0
    name: str = ""  # of a layout that `insitu board` prints


def find_markers(grey: np.ndarray, families: Sequence[str] = FAMILIES) -> Markers:
    """Markers of the family with most of them in a picture (H, W) uint8; none leaves ``ids`` empty.

    All families at once cost ten times what one does: once a picture has told the family, give that.
    """
    import cv2

    small, step = shrunk(grey)
    scale = 1.0 / step
    if small.size < UPSAMPLE_BELOW:
        small, scale = cv2.resize(small, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 2.0
    detector = cv2.aruco.ArucoDetector([dictionary(name) for name in families], cv2.aruco.DetectorParameters())
    quads, ids, _, which = detector.detectMarkersMultiDict(small)
    none = Markers("", np.empty(0, int), np.empty((0, 4, 2)), grey.shape)
    if ids is None or not len(ids):
        return none
    found, family_of = np.ravel(ids), np.ravel(which)
    counts = np.bincount(family_of, minlength=len(families))
    best = int(counts.argmax())
    if families[best] in SMALL_FAMILIES and counts[best] < 4:
        return none
    corners = ours(np.concatenate([np.reshape(quad, (4, 2)) for quad in quads])).reshape(-1, 4, 2) / scale
    kept = family_of == best
    return Markers(families[best], found[kept], corners[kept], grey.shape)


def proposed_dictionary(family: str, largest_id: int) -> str:
    """Name of the dictionary of a family that holds the ids seen."""
    stem, _, count = family.rpartition("_")
    if not count.isdigit():
        return family
    return f"{stem}_{next(n for n in COUNTS if n > largest_id)}"


def layout_of(pictures: Sequence[Markers]) -> Layout | None:
    """The print that the pictures' markers fit; None without any."""
    families = [picture.family for picture in pictures if len(picture.ids)]
    if not families:
        return None
    family = max(set(families), key=lambda name: sum(len(p.ids) for p in pictures if p.family == name))
    chosen = [picture for picture in pictures if picture.family == family]
    ids = sorted({int(i) for picture in chosen for i in picture.ids})
    name = proposed_dictionary(family, ids[-1])
    if len(ids) == 1:
        return Layout("marker", name, (1, 1), False, 1.0, 0.0, len(chosen), tuple(ids))
    rich = [p for p in chosen if len(set(p.ids.tolist())) == len(p.ids) and len(p.ids) >= FEWEST]
    if (printed := _printed(rich)) is not None:
        return printed
    best: Layout | None = None
    for kind, squares, legacy, centres in _candidates(max(int(p.ids.max()) for p in rich) if rich else 0):
        known = [p for p in rich if p.ids.max() < len(centres)]
        fits = [fit for p in known if (fit := _fit(p, centres)) is not None]
        if len(fits) < max(1, len(rich) // 2):
            continue
        rms = float(np.median([fit[0] for fit in fits]))
        if rms < MAX_RMS and (best is None or rms < 0.98 * best.rms):
            largest = sorted(fits, key=lambda fit: -fit[2])[: max(1, len(fits) // 4)]  # least shrunk by detection
            ratio = float(np.median([fit[1] for fit in largest]))
            agree = sum(fit[0] < MAX_RMS for fit in fits)
            best = Layout(kind, name, squares, legacy, ratio, rms, agree, tuple(ids))
    if best is not None:
        return best
    return Layout("unknown", name, (0, 0), False, 0.0, np.inf, len(chosen), tuple(ids))


def _printed(pictures: Sequence[Markers]) -> Layout | None:
    """The layout of `insitu board` that pictures of one family show: its ids are its own, and their places must fit."""
    for name, facts in LAYOUTS.items():
        across, down = facts["squares"]
        centres, first = charuco_centres(across, down, False), facts["first_id"]
        mine = [_only(p, first, first + len(centres)) for p in pictures if facts["dictionary"].startswith(p.family[:8])]
        mine = [p for p in mine if len(p.ids) >= FEWEST]
        fits = [fit for p in mine if (fit := _fit(p, centres, first)) is not None and fit[0] < MAX_RMS]
        if fits and len(fits) >= len(pictures) // 2:
            rms, ratio, _ = np.median(np.array(fits), 0)
            ids = sorted({int(i) for p in mine for i in p.ids})
            found = ("charuco", facts["dictionary"], (across, down), False, float(ratio), float(rms), len(fits))
            return Layout(*found, tuple(ids), first, name)
    return None


def _only(picture: Markers, first: int, end: int) -> Markers:
    kept = (picture.ids >= first) & (picture.ids < end)
    return replace(picture, ids=picture.ids[kept], corners=picture.corners[kept])


def _candidates(largest: int) -> list[tuple[str, tuple[int, int], bool, np.ndarray]]:
    """Kind, squares, legacy and marker centres (N, 2) in squares, of the smallest boards that hold the largest id."""
    found: list[tuple[str, tuple[int, int], bool, np.ndarray]] = []
    for across in range(3, MOST_SQUARES + 1):
        for legacy in (False, True):
            first = 2 * (largest + 1) // across
            for down in range(max(2, first - 1), first + 3):
                centres = charuco_centres(across, down, legacy)
                if len(centres) > largest and not (legacy and down % 2):
                    found.append(("charuco", (across, down), legacy, centres))
                    break
    for across in range(1, MOST_SQUARES + 1):
        down = largest // across + 1
        index = np.arange(across * down)
        found.append(("grid", (across, down), False, np.stack([index % across, index // across], -1) + 0.5))
    return found


def charuco_centres(across: int, down: int, legacy: bool) -> np.ndarray:
    """Centres (N, 2) of a ChArUco board's markers in squares, by id: the white squares row by row.

    The first square is black; a legacy board of an even number of rows has it white.
    """
    first_white = legacy and down % 2 == 0
    places = [(x, y) for y in range(down) for x in range(across) if (x + y) % 2 == (0 if first_white else 1)]
    return np.array(places, float).reshape(-1, 2) + 0.5


def _fit(picture: Markers, centres: np.ndarray, first: int = 0) -> tuple[float, float, float] | None:
    """Rms of the centres about their homography, in marker sides; the side in squares, and in px."""
    import cv2

    flat = centres[picture.ids - first]
    seen = marker_centres(picture)
    side = float(np.median(np.linalg.norm(picture.corners - np.roll(picture.corners, 1, 1), axis=-1)))
    homography, _ = cv2.findHomography(flat, seen, 0)
    if homography is None:
        return None
    mapped = cv2.perspectiveTransform(flat[None], homography)[0]
    rms = float(np.sqrt(((mapped - seen) ** 2).sum(-1).mean())) / side
    try:
        back = cv2.perspectiveTransform(picture.corners.reshape(1, -1, 2), np.linalg.inv(homography))[0].reshape(
            -1, 4, 2
        )
    except np.linalg.LinAlgError:
        return None
    return rms, float(np.median(np.linalg.norm(back - np.roll(back, 1, 1), axis=-1))), side


def marker_centres(picture: Markers) -> np.ndarray:
    """Pictures (N, 2) of the markers' centres."""
    return np.array([_crossing(quad) for quad in picture.corners]).reshape(-1, 2)


def _crossing(quad: np.ndarray) -> np.ndarray:
    """Where the diagonals of a quadrilateral (4, 2) cross: the picture of a square's centre."""
    a, b, c, d = quad
    matrix = np.stack([c - a, b - d], -1)
    try:
        return a + np.linalg.solve(matrix, b - a)[0] * (c - a)
    except np.linalg.LinAlgError:
        return np.asarray(quad.mean(0))
