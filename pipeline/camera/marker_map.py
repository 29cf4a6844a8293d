"""Where several markers of unknown layout lie and where every view was taken from, by their corners alone.

Each marker in each view has one or two poses (IPPE, both refined). From the first marker, which is the world, views and
markers are placed in turn; where both poses remain possible both are followed (a beam of hypotheses), so that a later
view or marker decides. Then one least squares with all corners (`bundle.adjust` without a cloud) gives poses, places
and their joint covariance. A sighting that the others contradict (a misread id, a marker that was moved) is left out.

A view that shows a single marker takes nothing from the others but that marker's place: it keeps the two-fold test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipeline.camera.bundle import Adjusted, adjust, settled
from pipeline.camera.reprojection import Bundle, Corners
from pipeline.camera.resection import Resection, minimise, refine, resect_plane, residuals_and_jacobian
from pipeline.camera.rigid import difference
from pipeline.camera.sfm import Seen
from pipeline.conventions import invert_rigid, transform_points
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.types import Camera

SURE = 25.0  # chi2 ratio beyond which a marker's second pose is not followed
BEAM = 6  # hypotheses followed at once
HOPELESS = 25.0  # and those whose chi2 exceeds the best one's this many times are dropped
OUT_OF_LINE = 4.0  # chi2 per degree of freedom above which a sighting that contradicts the others is sought
CLEARLY = 3.0  # and how many times it must fall without that one, more than without any other
MOST_LEFT_OUT = 5


@dataclass(frozen=True)
class MarkerMap:
    """Poses of the views and places of the markers.

    ``names``, ``markers``: what each pose and place of ``done.bundle`` belongs to (markers by their number in the
    manifest); ``ambiguity``: of each view, on the scale of `resect_plane`; ``alternatives``: its second pose;
    ``unsure``: markers whose place has a second solution, with its ambiguity; ``left_out``: sightings, (view, marker).
    """

    names: list[str]
    markers: list[int]
    done: Adjusted
    ambiguity: dict[str, float]
    alternatives: dict[str, np.ndarray]
    lone: dict[str, Resection]  # views that show one marker: their pose in its world
    unsure: dict[int, float]
    left_out: list[tuple[str, int]]

    def world_points(self, marks: list[Seen]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """World points (n, 3), pixels (n, 2) and ids (n,) of one view's marks that are in the map."""
        kept = [one for one in marks if one.marker in self.markers]
        place = [self.done.bundle.markers[self.markers.index(one.marker)] for one in kept]
        world = [transform_points(where, one.points) for where, one in zip(place, kept, strict=True)]
        ids = [100 * one.marker + np.arange(len(one.px)) for one in kept]
        return np.concatenate(world), np.concatenate([one.px for one in kept]), np.concatenate(ids)

    def covariance(self, name: str, lens: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Covariance (6, 6) of a view's pose with its lens's part, and with the lens (6, L)."""
        at = self.names.index(name)
        by_lens = self.done.by_lens[at]
        own = self.done.pose_covariance[at] + by_lens @ lens.covariance @ by_lens.T
        if name in self.lone and self.lone[name].frontal:  # the linearised one promises too much, see `widened`
            own = own + self.lone[name].noise_covariance
        return (own + own.T) / 2, by_lens @ lens.covariance


@dataclass(frozen=True)
class _State:
    """A hypothesis: where views and markers are, and chi-square of all their corners."""

    poses: dict[str, np.ndarray]
    places: dict[int, np.ndarray]
    chi2: float = 0.0


@dataclass(frozen=True)
class _Task:
    """What was measured: marks and lens of each view, and the poses ``camera_from_marker`` that each mark allows."""

    seen: dict[str, list[Seen]]
    cameras: dict[str, Camera]
    branches: dict[tuple[str, int], list[np.ndarray]]
    sigma_px: float


def solve(seen: dict[str, list[Seen]], cameras: dict[str, Camera], sigma_px: float) -> MarkerMap:
    """The map of marker 0's world from the marks of each view, each view's lens, and a corner's uncertainty, px.

    Views and markers that do not hang together with marker 0 are not in it. Raises CaptureError when no view shows
    marker 0.
    """
    left_out: list[tuple[str, int]] = []
    seen = {name: list(marks) for name, marks in seen.items() if marks}
    while True:
        found = _solve(seen, cameras, sigma_px, left_out)
        wrong = _out_of_line(found, seen, sigma_px) if len(left_out) < MOST_LEFT_OUT else None
        if wrong is None:
            return found
        left_out.append(wrong)
        seen[wrong[0]] = [one for one in seen[wrong[0]] if one.marker != wrong[1]]
        seen = {name: marks for name, marks in seen.items() if marks}


def _solve(
    seen: dict[str, list[Seen]], cameras: dict[str, Camera], sigma_px: float, left_out: list[tuple[str, int]]
) -> MarkerMap:
    if not any(one.marker == 0 for marks in seen.values() for one in marks):
        raise CaptureError(
            "the first marker is seen in no view, needed in one: it is the world; put it first or nearer"
        )
    task = _Task(seen, cameras, _branches(seen, cameras, sigma_px), sigma_px)
    states = _search(task)
    best = states[0]
    lone: dict[str, Resection] = {}
    ambiguity, alternatives = dict.fromkeys(best.poses, np.inf), {}
    for name, marks in seen.items():
        known = [one for one in marks if one.marker in best.places]
        if name in best.poses or not known:
            continue
        world, px = _points(known, best)
        first, second, ratio = resect_plane(cameras[name], world, px, sigma_px)
        lone[name], ambiguity[name] = first, ratio
        if second is not None:
            alternatives[name] = second.world_from_camera
        best = replace(best, poses={**best.poses, name: first.world_from_camera})
    bundle = _bundle(task, best)
    names, markers = list(best.poses), list(best.places)
    freedom = max(sum(2 * len(c.px) for c in bundle.corners) - 6 * (len(names) + len(markers) - 1), 1)
    _, chi2 = settled(bundle, sigma_px)
    noise = sigma_px * float(np.sqrt(max(1.0, chi2 / freedom)))
    done = adjust(bundle, corner_sigma_px=noise)
    unsure: dict[int, float] = {}
    for other in states[1:]:
        ratio = 1 + (other.chi2 - states[0].chi2) / (noise / sigma_px) ** 2 / 2  # a single marker has two spare numbers
        for name, pose in other.poses.items():
            if ratio < ambiguity[name] and _apart(pose, done.bundle.poses, done.pose_covariance, names.index(name)):
                ambiguity[name], alternatives[name] = ratio, pose
        for marker, place in other.places.items():
            at = markers.index(marker)
            smaller = bool(marker) and ratio < unsure.get(marker, np.inf)
            if smaller and _apart(place, done.bundle.markers, done.marker_covariance, at):
                unsure[marker] = ratio
    return MarkerMap(names, markers, done, ambiguity, alternatives, lone, unsure, list(left_out))


def _apart(pose: np.ndarray, of: list[np.ndarray], covariance: np.ndarray, at: int) -> bool:
    """Whether a motion differs from the adjusted one by more than its own uncertainty."""
    delta = difference(pose, of[at])
    return bool(delta @ np.linalg.pinv(covariance[at]) @ delta > 1)


def _branches(
    seen: dict[str, list[Seen]], cameras: dict[str, Camera], sigma_px: float
) -> dict[tuple[str, int], list[np.ndarray]]:
    """The poses of each marker in the camera (4, 4), best first; marks whose pose cannot be found have none."""
    found: dict[tuple[str, int], list[np.ndarray]] = {}
    for name, marks in seen.items():
        for one in marks:
            try:
                best, second, ratio = resect_plane(cameras[name], one.points, one.px, sigma_px)
            except NumericalError:
                found[name, one.marker] = []
                continue
            both = [best] if second is None or ratio > SURE else [best, second]
            found[name, one.marker] = [invert_rigid(way.world_from_camera) for way in both]
    return found


def _search(task: _Task) -> list[_State]:
    """Hypotheses of all views that show two markers or more and of all markers, best first, each at its minimum."""
    states = [_State({}, {0: np.eye(4)})]
    core = {name for name, marks in task.seen.items() if len(marks) > 1}
    while True:
        first = states[0]
        views = [
            name for name in core - first.poses.keys()
            if any(task.branches[name, one.marker] for one in task.seen[name] if one.marker in first.places)
        ]  # fmt: skip
        marks = [
            (one.marker, name) for name in first.poses for one in task.seen[name]
            if one.marker not in first.places and task.branches[name, one.marker]
        ]  # fmt: skip
        if views:
            shown = {name: sum(len(o.px) for o in task.seen[name] if o.marker in first.places) for name in views}
            chosen = max(sorted(views), key=lambda name: (shown[name], len(task.seen[name])))
            grown = [new for state in states for new in _with_view(task, state, chosen)]
        elif marks:
            count = [marker for marker, _ in marks]
            pick = max(sorted(set(count)), key=count.count)
            through = [name for marker, name in marks if marker == pick]
            nearest = max(through, key=lambda name: _extent(task.seen[name], pick))
            grown = [new for state in states for new in _with_marker(task, state, pick, nearest)]
        else:
            return _best([_at_minimum(task, state) for state in states]) if first.poses else states
        states = _best(grown)


def _with_view(task: _Task, state: _State, name: str) -> list[_State]:
    """The hypothesis with one view more, once for each pose that the placed markers in it allow."""
    known = [one for one in task.seen[name] if one.marker in state.places]
    world, px = _points(known, state)
    camera = task.cameras[name]
    grown = []
    for one in known:
        for way in task.branches[name, one.marker]:
            pose = minimise(camera, state.places[one.marker] @ invert_rigid(way), world, px)
            residuals = residuals_and_jacobian(camera, pose, world, px)[0]
            chi2 = float((residuals**2).sum()) / task.sigma_px**2
            if np.isfinite(chi2):
                grown.append(_State({**state.poses, name: pose}, state.places, state.chi2 + chi2))
    return grown


def _with_marker(task: _Task, state: _State, marker: int, through: str) -> list[_State]:
    """The hypothesis with one marker more, once for each of its poses in one view; all views then agree on it."""
    ways = task.branches[through, marker]
    return [
        _at_minimum(task, replace(state, places={**state.places, marker: state.poses[through] @ way})) for way in ways
    ]


def _at_minimum(task: _Task, state: _State) -> _State:
    """The hypothesis after least squares."""
    found, chi2 = settled(_bundle(task, state), task.sigma_px)
    poses = dict(zip(state.poses, found.poses, strict=True))
    return _State(poses, dict(zip(state.places, found.markers, strict=True)), chi2)


def _best(states: list[_State]) -> list[_State]:
    """The hypotheses worth following, best first, each minimum once."""
    ordered = sorted((state for state in states if np.isfinite(state.chi2)), key=lambda state: state.chi2)
    if not ordered:
        raise NumericalError("the markers' poses do not converge; photograph them larger and tilted by 30 deg or more")
    freedom = 2.0 * (len(ordered[0].poses) + len(ordered[0].places))
    kept: list[_State] = []
    for state in ordered:
        if state.chi2 > HOPELESS * max(ordered[0].chi2, freedom) or len(kept) == BEAM:
            break
        if not any(_same(state, other) for other in kept):
            kept.append(state)
    return kept


def _same(state: _State, other: _State) -> bool:
    """Whether two hypotheses are one minimum: the two poses of a marker differ by degrees."""
    pairs = [(state.poses[name], other.poses[name]) for name in state.poses]
    pairs += [(state.places[marker], other.places[marker]) for marker in state.places]
    return all(np.abs(difference(a, b)[:3]).max() < 1e-3 for a, b in pairs)


def _points(known: list[Seen], state: _State) -> tuple[np.ndarray, np.ndarray]:
    world = [transform_points(state.places[one.marker], one.points) for one in known]
    return np.concatenate(world), np.concatenate([one.px for one in known])


def _extent(marks: list[Seen], marker: int) -> float:
    return max(float(np.ptp(one.px, axis=0).min()) for one in marks if one.marker == marker)


def _bundle(task: _Task, state: _State) -> Bundle:
    """The hypothesis as a bundle without a cloud; views and markers in the order of the hypothesis."""
    names, markers = list(state.poses), list(state.places)
    lenses: list[Camera] = []
    for name in names:
        if not any(task.cameras[name] is lens for lens in lenses):
            lenses.append(task.cameras[name])
    camera_of = np.array([next(i for i, c in enumerate(lenses) if c is task.cameras[name]) for name in names], int)
    corners = [
        Corners(view, markers.index(one.marker), one.points, one.px)
        for view, name in enumerate(names) for one in task.seen[name] if one.marker in state.places
    ]  # fmt: skip
    nowhere = np.zeros(0, int)
    return Bundle(
        lenses, list(state.poses.values()), camera_of, np.zeros((0, 3)), nowhere, nowhere, np.zeros((0, 2)),
        list(state.places.values()), corners,
    )  # fmt: skip


def residuals_of(found: MarkerMap) -> dict[tuple[str, int], np.ndarray]:
    """Distances (n,) px between measured and predicted corners, by view and marker."""
    bundle = found.done.bundle
    out = {}
    for one in bundle.corners:
        world = transform_points(bundle.markers[one.marker], one.points)
        camera = bundle.cameras[bundle.camera_of[one.view]]
        off = residuals_and_jacobian(camera, bundle.poses[one.view], world, one.px)[0]
        out[found.names[one.view], found.markers[one.marker]] = np.hypot(*off.T)
    return out


def _out_of_line(found: MarkerMap, seen: dict[str, list[Seen]], sigma_px: float) -> tuple[str, int] | None:
    """The sighting without which the rest agrees, when it is one; None also when two explain the contradiction.

    Marker 0 and views that show one marker are kept.
    """
    bundle = found.done.bundle
    spare = sum(2 * len(c.px) for c in bundle.corners) - 6 * (len(found.names) + len(found.markers) - 1)
    chi2 = sum(float((d**2).sum()) for d in residuals_of(found).values()) / sigma_px**2
    if chi2 <= OUT_OF_LINE * max(spare, 1):
        return None
    left = {}
    for at, one in enumerate(bundle.corners):
        name, marker = found.names[one.view], found.markers[one.marker]
        others = bundle.corners[:at] + bundle.corners[at + 1 :]
        if marker and len(seen[name]) > 1 and any(other.marker == one.marker for other in others):
            left[name, marker] = settled(replace(bundle, corners=others), sigma_px)[1]
    if not left:
        return None
    order = sorted(left, key=lambda key: left[key])
    second = left[order[1]] if len(order) > 1 else chi2
    return order[0] if CLEARLY * max(left[order[0]], spare) < min(second, chi2) else None


def with_tripod(
    seen: dict[str, list[Seen]], cameras: dict[str, Camera], tripod: list[str], sigma_px: float, limit: float
) -> tuple[MarkerMap, dict[str, tuple[float, float]]]:
    """The map, with the corners of views that stayed where the plate was taken averaged into the plate's.

    Returns also, for every view of ``tripod`` that shows what the plate shows: chi-square (6 numbers) of its motion,
    from the map's places held, and its shift in pixels, rms. Those above ``limit`` keep a pose of their own.
    """
    found = solve(seen, cameras, sigma_px)
    moved: dict[str, tuple[float, float]] = {}
    if "plate" not in found.names:
        return found, moved
    here = found.done.bundle.poses[found.names.index("plate")]
    world, px, ids = found.world_points(seen["plate"])
    own = refine(cameras["plate"], here, world, px, sigma_px)
    for name in [name for name in tripod if name in found.names]:
        places, spots, numbers = found.world_points(seen[name])
        other = refine(cameras[name], here, places, spots, sigma_px)
        apart = difference(other.world_from_camera, own.world_from_camera)
        chi2 = float(apart @ np.linalg.solve(other.noise_covariance + own.noise_covariance, apart))
        _, a, b = np.intersect1d(ids, numbers, return_indices=True)
        shift = float(np.sqrt(((px[a] - spots[b]) ** 2).sum(-1).mean())) if len(a) else 0.0
        moved[name] = (chi2, shift)
    stayed = ["plate", *(name for name, (chi2, _) in moved.items() if chi2 <= limit)]
    if len(stayed) == 1:
        return found, moved
    rest = {name: marks for name, marks in seen.items() if name not in stayed}
    return solve({"plate": averaged([seen[name] for name in stayed]), **rest}, cameras, sigma_px), moved


def averaged(sights: list[list[Seen]]) -> list[Seen]:
    """Marks of one place, the mean over the views that saw them: their scatter stays, and is not counted twice."""
    by_marker: dict[int, list[Seen]] = {}
    for one in (one for marks in sights for one in marks):
        by_marker.setdefault(one.marker, []).append(one)
    return [
        Seen(marker, ones[0].points, np.mean([one.px for one in ones], 0))
        if all(len(a.px) == len(b.px) for a, b in pairwise(ones)) else ones[0]
        for marker, ones in sorted(by_marker.items())
    ]  # fmt: skip
