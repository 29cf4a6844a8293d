"""Whether further views are needed: what boards and markers alone leave uncertain, in pixels where the objects stand.

Method: poses by what is cheap (board, markers, a stated pose; a bare plate by its tripod) through the lens as known
without further views (stated, calibrated before, of board photographs, or EXIF's), and their covariance pushed to the
objects' feet. Further views are oriented (stage sfm, COLMAP) when a view shows no mark, when its marker has two poses,
when corner noise alone leaves the foot less certain than ``contact_px``, or when a lens that only EXIF tells of does: a
lens of other sources would be held by the cloud as well, so its part is not what the cloud could lessen. A lens of EXIF
is first made surer by board and markers in the capture's own views (`pipeline/camera/own_boards.py`). Limits: corner
noise and the ambiguity that is refused are taken at pose's defaults; surfaces beside the plane that only a cloud shows
are no reason (cloud = always looks for them).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.markers import grey
from pipeline.camera.own_boards import SURPRISE_CHI2
from pipeline.camera.sources import (
    KnownLens,
    by_marks,
    known_lens,
    left_at,
    marks_of,
    marks_of_photos,
    only_words,
    stated_view,
    surer,
)
from pipeline.camera.view_checks import feet_of
from pipeline.run.artifacts import BOARD_PHOTOS, BRACKETS, FACTS, PHOTOGRAPHS, SOURCES, VIEW_PHOTOS, WISHES
from pipeline.run.errors import ManifestError
from pipeline.run.stage import Stage
from pipeline.types import Bracket, Camera, Frame, Raster, Result, Sources, View
from stages import knobs

NO_VIEWS = {
    "term": "cloud of further views", "modelled": False, "because": "none are given",
    "could_cost": "nothing where a board or marker is in the plate; else there is no pose", "bound_px": 0.0,
}  # fmt: skip
PHOTO_CPU_S = 1.7  # that one costs to orient: 23.5 CPU s for the 14 of 0.6 Mpx of the bundled counter
NOT_LOOKED = "surfaces beside the plane are not looked for in a cloud; sources.cloud = always looks"


def compute(
    facts: dict[str, Any], wishes: dict[str, Any], brackets: dict[str, Bracket], board_photos: list[dict[str, str]],
    view_photos: list[Frame], photographs: dict[str, Raster], params: knobs.Sources,
) -> Result:  # fmt: skip
    """What the further views are needed for, and the lens that boards in view make surer; nothing without either."""
    routes = {entry["view"]: entry["route"] for entry in facts.get("pose", [])}
    named = [name for name, route in routes.items() if route == "colmap"]
    if named and params.cloud == "never":
        raise ManifestError(
            f"sources.cloud: is never, but [[pose]] orients {', '.join(named)} by route colmap; expected auto or always"
        )
    if not view_photos and not (has_marks(facts) and only_words(facts, board_photos)):
        return Result({"sources": Sources()}, {"cloud": False}, [], [NO_VIEWS])
    reasons = dict.fromkeys(named, "asked for by [[pose]]")
    free = [name for name in by_plates_camera(facts) if name not in routes] if has_marks(facts) else []
    numbers: dict[str, Any] = {}
    lens_reason, lens = "", None
    rows: list[dict[str, Any]] = []
    warnings: list[str] = []
    if free or "plate" not in named:  # else the cloud gives the lens and every pose, whatever else would
        lens, found, rows, warnings = cheap(facts, routes, brackets, board_photos, photographs, view_photos)
        reasons |= {name: missing for name in free if isinstance(missing := found.get(name), str)}
        if isinstance(plate := found.get("plate"), View):
            numbers, short, lens_reason = judged(plate, lens, spots_of(facts, wishes), params.contact_px)
            reasons |= {"plate": short} if short and "plate" in free else {}
        elif lens.source == "unknown" and "plate" not in reasons:
            lens_reason = "nothing is said of it"
    why = [f"{name}: {reason}" for name, reason in reasons.items()] + [f"lens: {lens_reason}"] * bool(lens_reason)
    cloud = bool(view_photos) and (params.cloud == "always" or (params.cloud == "auto" and bool(why)))
    views = list(dict.fromkeys([*reasons, *(free if params.cloud == "always" else [])])) if cloud else []
    numbers = {"cloud": cloud, "budget_px": params.contact_px, "views": views, "because": why, **numbers}
    if why and view_photos and not cloud:
        warnings.append(f"sources: cloud = never, although {'; '.join(why)}")
    made = Sources(cloud=cloud, views=views, lens=lens.camera if rows and lens is not None else None)
    rows = [told(numbers, params.cloud, len(view_photos)) if view_photos else NO_VIEWS, *rows]
    return Result({"sources": made}, numbers, warnings, rows)


def cheap(
    facts: dict[str, Any], routes: dict[str, str], brackets: dict[str, Bracket], board_photos: list[dict[str, str]],
    photographs: dict[str, Raster], view_photos: list[Frame],
) -> tuple[KnownLens, dict[str, View | str], list[dict[str, Any]], list[str]]:  # fmt: skip
    """The lens and the pose of each view without a cloud, or why there is none; evidence of a surer lens, warnings."""
    usual = knobs.Pose()
    lens = known_lens(facts, brackets["plate"].frames[0], board_photos)
    asked = [name for name in by_plates_camera(facts) if routes.get(name, "marker") in ("charuco", "marker")]
    tripod = [ball["name"] for ball in facts["ball"] if ball.get("tripod") and ball["name"] not in routes]
    found: dict[str, View | str] = {}
    rows: list[dict[str, Any]] = []
    warnings: list[str] = []
    if has_marks(facts) and asked:
        marks, notes = marks_of(facts, [*asked, *tripod], lambda name: grey(photographs[name].rgb()), lens.camera)
        marks |= marks_of_photos(facts, view_photos, lens.camera)
        if lens.source == "as EXIF says":
            before = lens.camera
            lens, chi2, views = surer(lens, marks, tripod, usual.corner_sigma_px, usual.min_ambiguity)
            rows, warnings = said_of_lens(before, lens.camera, chi2, views) if views else ([], [])
        route = "charuco" if facts.get("board") else "marker"
        found = by_marks(
            marks, notes, asked, tripod, route, lens.camera, usual.corner_sigma_px, usual.min_ambiguity
        )  # fmt: skip
    stated = stated_view(facts, lens.camera, usual.corner_sigma_px)
    return lens, found if stated is None else {**found, "plate": stated}, rows, warnings


def said_of_lens(before: Camera, after: Camera, chi2: float, views: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Evidence that boards in view were asked about EXIF's lens, and a warning where they contradict it."""
    sigma = [float(np.sqrt(camera.covariance[0, 0]) / camera.fx) for camera in (before, after)]
    moved = f"focal length {after.fx / before.fx - 1:+.1%}, known to {sigma[1]:.1%} instead of {sigma[0]:.0%}"
    row = {
        "term": "EXIF's lens by boards in view", "modelled": True, "could_cost": "",
        "because": f"{views} views show them: {moved} (chi2 {chi2:.1f} of its word)",
    }  # fmt: skip
    if chi2 <= SURPRISE_CHI2:
        return [row], []
    return [row], [
        f"sources: boards in view contradict EXIF's lens (chi2 {chi2:.0f}, expected below {SURPRISE_CHI2:g}): {moved}; "
        "are the photographs cropped, the board flat and its size right? photograph a board for [camera] calibration"
    ]


def has_marks(facts: dict[str, Any]) -> bool:
    """Whether a board or a marker is described: without either a cloud has no metre."""
    return bool(facts.get("board") or facts.get("marker"))


def by_plates_camera(facts: dict[str, Any]) -> list[str]:
    """The plate, and ball views from elsewhere with its camera: those whose pose needs a source of its own."""
    balls = [ball["name"] for ball in facts["ball"] if not ball.get("tripod") and not ball.get("camera")]
    return ["plate", *balls]


def spots_of(facts: dict[str, Any], wishes: dict[str, Any]) -> dict[str, np.ndarray]:
    """Feet (3,) of the objects, world; where no object is asked for, the middle of the board or of the first marker."""
    if feet := feet_of(wishes):
        return feet
    middle = np.zeros(3)
    if board := facts.get("board"):
        middle[[0, 2]] = np.array(board["squares"]) * board["square_m"] / 2
    return {"board" if facts.get("board") else "marker": middle}


def judged(
    plate: View, lens: KnownLens, spots: dict[str, np.ndarray], budget_px: float
) -> tuple[dict[str, Any], str, str]:
    """Figures, and in words why pose or lens is not good enough; empty where it is."""
    whole, noise = left_at(lens.camera, plate, spots)
    numbers = {"route": plate.route, "lens": lens.source, "contact_px": whole, "contact_noise_px": noise}
    if not whole:
        return numbers, "", "nothing is said of it" if lens.source == "unknown" else ""
    short = of_lens = ""
    worst = max(noise, key=noise.__getitem__)
    if noise[worst] > budget_px:
        short = f"{plate.route} alone leaves {worst} uncertain by {noise[worst]:.2f} px, budget {budget_px:g}"
    worst = max(whole, key=whole.__getitem__)
    if lens.source == "unknown":
        of_lens = "nothing is said of it"
    elif lens.bettered and whole[worst] > budget_px:
        of_lens = f"{lens.source} it leaves {worst} uncertain by {whole[worst]:.2f} px, budget {budget_px:g}"
    return numbers, short, of_lens


def told(numbers: dict[str, Any], asked: str, photos: int) -> dict[str, Any]:
    """The decision as evidence; ``photos``: how many further views there are."""
    why, whole = numbers["because"], numbers.get("contact_px") or {}
    left = "; ".join(f"{value:.2f} px at {name}" for name, value in whole.items())
    bound: dict[str, Any] = {
        "saved_s": PHOTO_CPU_S * photos, "saved_by": f"{photos} views, {PHOTO_CPU_S:g} s each as in counter's",
        **({"bound_px": 2 * max(whole.values())} if whole else {"no_bound": "the given pose states no uncertainty"}),
    }  # fmt: skip
    good = f"{numbers.get('route')} and the lens {numbers.get('lens')} leave {left}, budget {numbers['budget_px']:g}"
    if numbers["cloud"]:
        return term(True, "; ".join(why) or f"knob sources.cloud = {asked}, although {good}", "")
    if why:
        return term(False, f"knob sources.cloud = never, although {'; '.join(why)}", f"that; {NOT_LOOKED}") | bound
    because = good if whole else "poses and lens are stated"
    return term(False, because, f"{left or 'unknown'} (one sigma); {NOT_LOOKED}") | bound


def term(modelled: bool, because: str, could_cost: str) -> dict[str, Any]:
    """A row of evidence."""
    return {"term": "cloud of further views", "modelled": modelled, "because": because, "could_cost": could_cost}


STAGE = Stage(
    "sources",
    compute,
    knobs.Sources,
    {
        "facts": FACTS, "wishes": WISHES, "brackets": BRACKETS, "board_photos": BOARD_PHOTOS,
        "view_photos": VIEW_PHOTOS, "photographs": PHOTOGRAPHS,
    },
    {"sources": SOURCES},
)  # fmt: skip
