"""What each bracket is for: ball, plate, board photograph, chart, or a further view; with the reasons in words.

The ball's views show a ball. The plate is the bracket of the ball's view without the ball, else the one that shows
the board. Board photographs show the board large, from many sides. Nothing is certain, so every guess says why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.camera.board_families import FAMILIES, Layout, Markers, find_markers, layout_of
from pipeline.camera.markers import tone
from pipeline.capture.balls import BallSeen, find_ball, outermost, raster_of
from pipeline.capture.grouping import Grouping, compare_all, group, repeats
from pipeline.capture.likeness import Cells, Likeness, cells_of, compare_moved, relative_exposures
from pipeline.capture.photographs import Photo, combined
from pipeline.image import chart_finder
from pipeline.probes.cropped import find_circle
from pipeline.run.errors import CaptureError

BOARD_AREA = 0.1  # of the frame: a photograph of the board, not of a place with the board in it
FEW_MARKERS = 2
MOST_SEARCHES = 12  # of balls: each takes seconds
CROP_PX, CROP_ASPECT, CROP_RADIUS = 1000, 0.06, 0.47  # a ball alone, cut out: at most so long, so far from square
SINGLE_LAMP_STOPS = 2.0  # one frame has clipped lamps, so less of them can be asked for; and knots shine too


@dataclass(frozen=True, eq=False)
class Shot:
    """One bracket: its photographs from the shortest exposure, light (h, w, 3), what it shows, its role and why."""

    photos: list[Photo]
    cells: list[Cells]
    light: np.ndarray
    clipped: np.ndarray  # (h, w) in the shortest frame, and so in all
    markers: Markers | None = None
    ball: BallSeen | None = None
    role: str = "left"  # ball, plate, calibration, views (of the place), view (other), crop or left
    name: str = ""
    tripod: bool = False
    chart: np.ndarray | None = None  # (4, 2) corners px of a 24-patch chart
    because: list[str] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)

    @property
    def first(self) -> Photo:
        """The shortest exposure."""
        return self.photos[0]

    @property
    def best(self) -> int:
        """Index of the frame of middling brightness: what shows most to the eye."""
        return int(np.argmin([abs(np.log(max(float(np.mean(p.rgb)), 1e-6) / 0.15)) for p in self.photos]))


@dataclass(frozen=True, eq=False)
class Proposal:
    """What a folder is taken for: its brackets with roles, the board, files left out or not readable, and why."""

    shots: list[Shot]
    layout: Layout | None
    left_out: dict[str, str]
    flaws: dict[str, str]

    @property
    def charted(self) -> bool:
        """Whether plate and a ball view show a 24-patch chart."""
        return len([shot for shot in self.shots if shot.chart is not None]) > 1

    def of(self, role: str) -> list[Shot]:
        """Brackets of a role."""
        return [shot for shot in self.shots if shot.role == role]


def propose(photos: Sequence[Photo], flaws: dict[str, str]) -> Proposal:
    """Group photographs and guess what each group is for."""
    cells = [cells_of(photo) for photo in photos]
    left_out = repeats(photos)
    wanted = [i for i in range(len(photos)) if i not in left_out]
    grouping = group(photos, compare_all(photos, cells, wanted), left_out)
    shots = [shot_of(photos, cells, members, grouping) for members in grouping.groups]
    shots, layout = with_markers(shots)
    shots = with_balls([as_crop(shot) for shot in shots])
    shots = with_plate(shots)
    shots = with_boards(shots, layout)
    shots = [with_chart(shot) if shot.role in ("plate", "ball") else shot for shot in shots]
    return Proposal(named(shots), layout, {photos[i].frame.file: why for i, why in left_out.items()}, flaws)


def shot_of(photos: Sequence[Photo], cells: Sequence[Cells], members: Sequence[int], grouping: Grouping) -> Shot:
    """One bracket with its light."""
    frames, parts = [photos[i] for i in members], [cells[i] for i in members]
    light, clipped = combined(frames, relative_exposures(frames, parts))
    doubts = [f"{photos[i].frame.file}: {grouping.doubts[i]}" for i in members if i in grouping.doubts]
    return Shot(frames, parts, light, clipped, unsure=doubts)


def grey_of(photo: Photo) -> np.ndarray:
    """(h, w) uint8 of a photograph in which markers can be read."""
    return np.asarray(255 * tone(photo.rgb.mean(-1)), np.uint8)


def with_markers(shots: list[Shot]) -> tuple[list[Shot], Layout | None]:
    """Markers in the frame of middling brightness of every bracket, and the board they belong to."""
    family: tuple[str, ...] = FAMILIES
    found: list[Shot] = []
    looked = 0
    for shot in sorted(shots, key=lambda s: -len(s.photos)):
        if len(family) > 1 and looked >= MOST_SEARCHES:
            found.append(shot)
            continue
        seen = find_markers(grey_of(shot.photos[shot.best]), family)
        looked += 1
        if len(seen.ids) >= 4 and len(family) > 1:
            family = (seen.family,)
        found.append(replace(shot, markers=seen))
    order = {id(shot.photos): i for i, shot in enumerate(shots)}
    found.sort(key=lambda s: order[id(s.photos)])
    return found, layout_of([s.markers for s in found if s.markers is not None and len(s.markers.ids) >= FEW_MARKERS])


def as_crop(shot: Shot) -> Shot:
    """The bracket as photographs of a ball alone, if they are cut out so that it fills them."""
    width, height = shot.first.frame.width, shot.first.frame.height
    if max(width, height) > CROP_PX or abs(width / height - 1) > CROP_ASPECT or markers_in(shot):
        return shot
    try:
        circle = find_circle(shot.photos[shot.best].rgb)
    except CaptureError:
        return shot
    if circle.radius < CROP_RADIUS * min(shot.light.shape[:2]):
        return shot
    names = " ".join(photo.frame.file for photo in shot.photos)
    return replace(
        shot, role="crop", because=[f"cut out to a ball, which plate and lens cannot be: insitu ball {names}"]
    )


def with_balls(shots: list[Shot]) -> list[Shot]:
    """Brackets that show a mirror ball; single photographs are searched only when no bracket does."""
    brackets = [s for s in shots if len(s.photos) > 1 and s.role == "left"][:MOST_SEARCHES]
    singles = [s for s in shots if len(s.photos) == 1 and area(s) < BOARD_AREA and s.role == "left"][:MOST_SEARCHES]
    found: dict[int, BallSeen] = {}
    for several in (brackets, singles):
        for shot in several:
            seen = find_ball(shot.light, shot.first.step, shot.first.frame.focal_35mm)
            if seen is None or (several is singles and seen.lamp_stops < SINGLE_LAMP_STOPS):
                continue
            if seen.is_ball:
                found[id(shot)] = outermost(seen, shot.light, shot.first.step, None, shot.first.frame.focal_35mm)
        if found:
            break
    return [with_ball(shot, found[id(shot)]) if id(shot) in found else shot for shot in shots]


def with_ball(shot: Shot, seen: BallSeen) -> Shot:
    """The bracket as a view of the ball."""
    text = (
        f"a mirror ball at ({seen.x:.0f}, {seen.y:.0f}), radius {seen.radius:.0f} px: {seen.merit:.0%} of its outline "
        f"is seen, its brightest spot is {seen.lamp_stops:+.1f} stops over all outside"
    )
    unsure = [] if seen.sure else ["the ball: outline and lamps do not both speak for it"]
    unsure += ["the ball: a single frame"] if len(shot.photos) == 1 else []
    return replace(shot, ball=seen, role="ball", because=[*shot.because, text], unsure=[*shot.unsure, *unsure])


def area(shot: Shot) -> float:
    """Share of the frame that the board's markers span."""
    return shot.markers.area_share if shot.markers is not None else 0.0


def markers_in(shot: Shot) -> int:
    """Markers that a bracket shows."""
    return len(shot.markers.ids) if shot.markers is not None else 0


def alike(one: Shot, other: Shot) -> Likeness | None:
    """Likeness of the frames of two brackets that tell most; None when sizes differ."""
    if one.cells[0].log.shape != other.cells[0].log.shape or one.first.frame.width != other.first.frame.width:
        return None
    pairs = [(a, b) for a in one.cells for b in other.cells]
    pairs.sort(key=lambda pair: -int((pair[0].usable & pair[1].usable).sum()))
    return max((compare_moved(a, b) for a, b in pairs[:3]), key=lambda like: (like.same_view, like.cells))


def with_plate(shots: list[Shot]) -> list[Shot]:
    """The plate among the brackets without a ball, and which balls were taken from its place."""
    balls = [s for s in shots if s.role == "ball"]
    scores = []
    largest = max(shot.first.frame.width * shot.first.frame.height for shot in shots)
    for shot in shots:
        close = area(shot) >= BOARD_AREA
        if shot.role != "left" or (close and len(shot.photos) < 2):
            continue
        likes = [like for ball in balls if (like := alike(shot, ball)) is not None]
        same = [like for like in likes if like.same_view]
        if close and not same:  # a board that fills this much of a plate is told by the ball that stood there, too
            continue
        reasons, score = [], 0.0
        if same:
            score += 4
            changed = max(int(like.changed.sum()) / like.cells for like in same)
            reasons.append(
                f"the view of a ball bracket without the ball (likeness {same[0].value:.2f}, {changed:.0%} changed)"
            )
        if len(shot.photos) > 1:
            score += 2
            reasons.append(f"a bracket of {len(shot.photos)}")
        size = shot.first.frame.width * shot.first.frame.height
        score += 0.9 * size / largest
        score += bool(shot.first.frame.cfa) + 0.5 * bool(markers_in(shot))
        if markers_in(shot):
            reasons.append(f"shows {markers_in(shot)} markers of the board")
        scores.append((score, len(shot.photos), shot, reasons))
    if not scores:
        return shots
    score, _, plate, reasons = max(scores, key=lambda entry: entry[:2])
    rivals = [s for other, _, s, _ in scores if s is not plate and other >= score - 0.5]
    unsure = [f"{len(rivals)} other brackets could be the plate"] if rivals and score >= 2 else []
    unsure += ["no bracket shows a ball's view without the ball"] if score < 4 and balls else []
    found = []
    for shot in shots:
        if shot is plate:
            shot = replace(shot, role="plate", because=[*shot.because, *reasons], unsure=[*shot.unsure, *unsure])
        elif shot.role == "ball":
            shot = against_plate(with_tripod(shot, alike(plate, shot)), plate)
        found.append(shot)
    return found


def with_tripod(ball: Shot, like: Likeness | None) -> Shot:
    """Whether a ball's view is the plate's own."""
    if like is not None and like.same_view and like.shift == (0, 0):
        text = f"the plate's own view (likeness {like.value:.2f}): tripod"
        return replace(ball, tripod=True, because=[*ball.because, text])
    if like is not None and like.same_view:
        text = "the plate's view, moved a little: not taken as the tripod's"
        return replace(ball, unsure=[*ball.unsure, text])
    return replace(ball, because=[*ball.because, "another view than the plate's"])


def against_plate(ball: Shot, plate: Shot) -> Shot:
    """A tripod's ball with its outline measured on what differs from the plate."""
    if not ball.tripod or ball.ball is None or ball.light.shape != plate.light.shape:
        return ball
    return replace(
        ball, ball=outermost(ball.ball, ball.light, ball.first.step, plate.light, ball.first.frame.focal_35mm)
    )


def with_boards(shots: list[Shot], layout: Layout | None) -> list[Shot]:
    """Photographs of the board by the plate's camera, and what is left as further views."""
    plates = [s for s in shots if s.role == "plate"] or [s for s in shots if s.role == "ball"]
    size = (plates[0].first.frame.width, plates[0].first.frame.height) if plates else None
    camera = plates[0].first.frame.camera if plates else ""
    found = []
    for shot in shots:
        frame = shot.first.frame
        if shot.role == "left" and layout is not None and markers_in(shot) >= 4 and area(shot) >= BOARD_AREA:
            own = size is None or own_size(shot, size)
            known = {frame.camera, camera} - {""}
            if own and len(known) < 2:
                text = f"{markers_in(shot)} markers over {area(shot):.0%} of the frame"
                shot = replace(shot, role="calibration", because=[text])
            else:
                text = (
                    f"shows the board, but is {frame.width} x {frame.height} by {frame.camera or 'an unnamed camera'}"
                )
                shot = replace(shot, role="view", because=[text])
        elif shot.role == "left" and (
            markers_in(shot) >= FEW_MARKERS or (size and (frame.width, frame.height) == size)
        ):
            board = f", shows {markers_in(shot)} markers" if markers_in(shot) else ""
            of_place = own_size(shot, size) and (markers_in(shot) >= FEW_MARKERS or frame.camera == camera != "")
            shot = replace(shot, role="views" if of_place else "view", because=[f"a further view{board}"])
        found.append(shot)
    return found


def own_size(shot: Shot, size: tuple[int, int] | None) -> bool:
    """Whether a bracket's photographs are of this size."""
    return (shot.first.frame.width, shot.first.frame.height) == size


def with_chart(shot: Shot) -> Shot:
    """A 24-patch chart in a bracket, if it shows one."""
    neutral = shot.first.frame.as_shot_neutral
    balanced = shot.light / np.asarray(neutral if neutral is not None else np.ones(3), np.float32)
    corners = chart_finder.find(raster_of(balanced))
    if corners is None:
        return shot
    corners = corners * shot.first.step
    text = f"a 24-patch chart about ({corners[:, 0].mean():.0f}, {corners[:, 1].mean():.0f})"
    return replace(shot, chart=corners, because=[*shot.because, text])


def named(shots: list[Shot]) -> list[Shot]:
    """Ball brackets named in the order they were taken, the tripod's first; others by their role."""
    balls = sorted(
        (s for s in shots if s.role == "ball"),
        key=lambda s: (not s.tripod, s.first.frame.timestamp, s.first.frame.file),
    )
    names = {id(shot): f"ball_{chr(97 + i)}" for i, shot in enumerate(balls[:26])}
    called = [replace(shot, name=names.get(id(shot), shot.role)) for shot in shots]
    return sorted(called, key=lambda shot: shot.name if shot.role == "ball" else "")
