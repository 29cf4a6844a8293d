"""Which photographs are one bracket: the same view at different exposures, told by content, then exposure, then time.

Pairs that show the same are joined, those that agree best first, unless that would bring two together that contradict
each other: another view, a compact region that changed (a ball was put down), or one exposure twice and some change.
Frames that show too little to be compared go where their clipped cells, or else their time, put them, and are doubted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import combinations
from pathlib import PurePosixPath

import numpy as np

from pipeline.capture.likeness import LEAST_CELLS, OTHER, Cells, Likeness, compare_moved
from pipeline.capture.photographs import Photo

CHANGED_BLOB = 36  # connected cells, of 160 along the longer side: a ball of 3.4 cells radius
WEAK_CHANGE = 12  # cells: with one exposure twice, two brackets
SAME_EXPOSURE = 0.01  # of ln exposure
MOST_AGAINST = 0.25
NEAR_S = 120.0  # between frames of one bracket


@dataclass(frozen=True)
class Grouping:
    """Groups of indices, each sorted by exposure; photographs left out, and why; doubts about some, by index."""

    groups: list[list[int]]
    left_out: dict[int, str] = field(default_factory=dict)
    doubts: dict[int, str] = field(default_factory=dict)


def seconds_of(timestamp: str) -> float | None:
    """An EXIF time as seconds; None when there is none."""
    try:
        return datetime.strptime(timestamp.strip()[:19], "%Y:%m:%d %H:%M:%S").timestamp()
    except ValueError:
        return None


def kind_of(photo: Photo) -> tuple[object, ...]:
    """What frames of one bracket share for certain: camera, size, and whether they are RAW or developed."""
    frame = photo.frame
    return frame.camera, frame.width, frame.height, frame.encoding, frame.cfa


def repeats(photos: Sequence[Photo]) -> dict[int, str]:
    """Copies of a file (the first by name stays), and pictures that a camera wrote beside a RAW of the same name."""
    found: dict[int, str] = {}
    first: dict[str, int] = {}
    order = sorted(range(len(photos)), key=lambda i: photos[i].frame.file)
    for i in order:
        same = first.setdefault(photos[i].frame.sha256, i)
        if same != i:
            found[i] = f"the same file as {photos[same].frame.file}"
    raws = {_stem(photos[i]): i for i in order if photos[i].frame.cfa}
    for i in order:
        raw = raws.get(_stem(photos[i]))
        if raw is None or photos[i].frame.cfa or i in found:
            continue
        one, other = photos[i].frame, photos[raw].frame
        if one.exposure_s and abs(np.log(one.exposure_s / max(other.exposure_s, 1e-9))) < SAME_EXPOSURE:
            found[i] = f"the picture beside RAW {other.file}"
    return found


def _stem(photo: Photo) -> str:
    return PurePosixPath(photo.frame.file).stem.lower()


def compare_all(
    photos: Sequence[Photo], cells: Sequence[Cells], wanted: Sequence[int]
) -> dict[tuple[int, int], Likeness]:
    """Likeness of every pair (i < j) of one kind."""
    kinds = {i: kind_of(photos[i]) for i in wanted}
    return {
        (i, j): compare_moved(cells[i], cells[j])
        for i, j in combinations(sorted(wanted), 2)
        if kinds[i] == kinds[j] and cells[i].log.shape == cells[j].log.shape
    }


def group(photos: Sequence[Photo], pairs: dict[tuple[int, int], Likeness], left_out: dict[int, str]) -> Grouping:
    """Brackets of photographs from the likeness of pairs."""
    home = {i: i for i in range(len(photos)) if i not in left_out}
    contrary = {pair: contradicts(likeness, *(photos[i] for i in pair)) for pair, likeness in pairs.items()}

    def may_join(one: int, other: int) -> bool:
        return not against(pairs, contrary, members(home, one), members(home, other))

    sure = [(pair, like) for pair, like in pairs.items() if like.same_view and not like.rough]
    gap = {pair: abs(_log_exposure(photos[pair[0]]) - _log_exposure(photos[pair[1]])) for pair, _ in sure}
    for (i, j), _ in sorted(sure, key=lambda item: (int(item[1].changed.sum()), gap[item[0]], item[0])):
        if home[i] != home[j] and not contrary[i, j] and may_join(home[i], home[j]):
            _join(home, home[i], home[j])
    doubts: dict[int, str] = {}
    _place_by_clipping(pairs, home)
    _place_by_time(photos, pairs, contrary, home, doubts)
    groups = [sorted(members(home, root), key=lambda i: _order(photos[i])) for root in sorted(set(home.values()))]
    return Grouping(groups, dict(left_out), doubts)


def members(home: dict[int, int], root: int) -> list[int]:
    """Indices of one group."""
    return [i for i, r in home.items() if r == root]


def against(
    pairs: dict[tuple[int, int], Likeness], contrary: dict[tuple[int, int], bool], one: list[int], other: list[int]
) -> bool:
    """Whether two groups contradict each other: in more than MOST_AGAINST of all cells that were compared."""
    told = [pair for a in one for b in other if (pair := (min(a, b), max(a, b))) in pairs]
    known = sum(pairs[pair].cells for pair in told if not pairs[pair].rough)
    return sum(pairs[pair].cells for pair in told if contrary[pair]) > MOST_AGAINST * known


def contradicts(likeness: Likeness, one: Photo, other: Photo) -> bool:
    """Whether two photographs cannot be of one bracket."""
    if likeness.rough:
        return False
    if likeness.other_view or likeness.blob >= CHANGED_BLOB:
        return True
    return same_exposure(one, other) and int(likeness.changed.sum()) >= WEAK_CHANGE


def same_exposure(one: Photo, other: Photo) -> bool:
    """Whether two photographs state one exposure."""
    stated = min(one.exposure, other.exposure) > 0
    return stated and abs(_log_exposure(one) - _log_exposure(other)) < SAME_EXPOSURE


def _log_exposure(photo: Photo) -> float:
    return float(np.log(photo.exposure)) if photo.exposure > 0 else 0.0


def _order(photo: Photo) -> tuple[float, float, str]:
    """By exposure, without one by brightness, then by name."""
    return photo.exposure, float(photo.rgb.mean()) if photo.exposure == 0 else 0.0, photo.frame.file


def _join(home: dict[int, int], one: int, other: int) -> None:
    for i, root in home.items():
        if root == max(one, other):
            home[i] = min(one, other)


def _alone(home: dict[int, int]) -> list[int]:
    roots = list(home.values())
    return [i for i, root in home.items() if roots.count(root) == 1]


def _place_by_clipping(pairs: dict[tuple[int, int], Likeness], home: dict[int, int]) -> None:
    """Overexposed frames go to the group whose bright parts are just those that clip in them."""
    for i in _alone(home):
        scores: dict[int, list[tuple[float, int]]] = {}
        for j in home:
            likeness = pairs.get((min(i, j), max(i, j)))
            if likeness is not None and likeness.rough and likeness.cells >= LEAST_CELLS:
                scores.setdefault(home[j], []).append((likeness.value, int(likeness.changed.sum())))
        best = sorted((-max(v for v, _ in found), min(c for _, c in found), root) for root, found in scores.items())
        if best and -best[0][0] > OTHER:
            near = [entry for entry in best if entry[0] < best[0][0] + 0.1]  # then the one with least change
            _join(home, home[i], min(near, key=lambda entry: (entry[1], entry[0]))[2])


def _place_by_time(
    photos: Sequence[Photo], pairs: dict[tuple[int, int], Likeness], contrary: dict[tuple[int, int], bool],
    home: dict[int, int], doubts: dict[int, str],
) -> None:  # fmt: skip
    """Groups that content left apart without contradicting: joined when near in time, the nearest first.

    Without times a frame that shows nothing goes to the only bracket of its kind.
    """
    while True:
        found = []
        for one, other in combinations(sorted(set(home.values())), 2):
            a, b = members(home, one), members(home, other)
            few, many = sorted((a, b), key=len)
            if kind_of(photos[one]) != kind_of(photos[other]) or against(pairs, contrary, a, b):
                continue
            if any(same_exposure(photos[i], photos[j]) for i in a for j in b):
                continue
            near = min((_cost(photos[i], photos[j]), i, j) for i in a for j in b)
            apart = _apart(photos[near[1]], photos[near[2]])
            told = [like for i in a for j in b if (like := pairs.get((min(i, j), max(i, j)))) is not None]
            best = max((like.value for like in told if like.cells >= LEAST_CELLS and not like.rough), default=np.nan)
            if apart <= NEAR_S or (np.isinf(apart) and np.isnan(best) and len(few) == 1 and len(many) > 2):
                found.append((near[0], one, other, best, few, apart))
        if not found:
            return
        _, one, other, best, few, apart = min(found, key=lambda entry: entry[:3])
        told_by = f"{apart:.0f} s from a frame of it" if np.isfinite(apart) else "the only bracket of its kind"
        looks = "too dark or bright to compare" if np.isnan(best) else f"likeness {best:.2f}"
        doubts.update(dict.fromkeys(few, f"{looks}, {told_by}"))
        _join(home, one, other)


def _cost(one: Photo, other: Photo) -> float:
    """How unlikely two photographs are neighbours in a bracket: seconds between them times stops between them."""
    stops = abs(_log_exposure(one) - _log_exposure(other)) / float(np.log(2))
    return (_apart(one, other) + 1) * (stops + 1)


def _apart(one: Photo, other: Photo) -> float:
    """Seconds between two photographs; infinite when one does not say when it was taken."""
    times = [seconds_of(photo.frame.timestamp) for photo in (one, other)]
    return abs(times[0] - times[1]) if times[0] is not None and times[1] is not None else float("inf")
