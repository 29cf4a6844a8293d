"""Which lens board photographs ask for: terms that photographs gain by which they were not fitted to.

From one focal length without distortion Brown's terms k1, k2, separate fx and fy, p1 p2 and k3, and the rational k4 k5
k6, are offered in turn, twice; a term stays when held-out photographs gain more than 9 in deviance per parameter (three
standard errors of a Gaussian) and do so consistently. A fisheye has a ladder of its own, climbed on evidence only, and
is judged on the same held-out photographs, those of the lens that explains most of them: a photograph that speaks
against a lens must not be left out for it. The model with fewer terms wins a tie; where photographs do not tell two
families apart that differ over the frame, that is said. Decentring p1 p2 that is left out is in the lens's covariance:
the principal point imitates it, so that residuals show little of it, but boards and things elsewhere do not move alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.adjustment import Adjustment, adjust, considered, free_columns, lens_vector, with_lens
from pipeline.camera.distortion import model_of
from pipeline.camera.lens import project, unproject
from pipeline.camera.opencv_bridge import first_calibration
from pipeline.camera.resection import minimise, planar_candidates, refine, residuals_and_jacobian, robust_scale
from pipeline.camera.residual_pattern import pattern
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.run.evidence import TRIED
from pipeline.types import Camera

LADDER: tuple[tuple[str, ...], ...] = (("k1",), ("k2",), ("fy",), ("p1", "p2"), ("k3",), ("k4", "k5", "k6"))
WIDE_LADDER: tuple[tuple[str, ...], ...] = (("k1", "k2", "k3", "k4", "k5", "k6"), ("fy",), ("p1", "p2"))
EQUIDISTANT = np.array([4 / 15, 0, 0, 0, 0, 9 / 15, 0, 0])  # atan(r) / r as a ratio of polynomials (Pade)
ROUGH_PX = 0.3  # of a corner: beyond it another lens is tried
FISHEYE_LADDER: tuple[tuple[str, ...], ...] = (("k1",), ("k2",), ("fy",), ("k3", "k4"))
DECENTRING = ("p1", "p2")
DECENTRING_SIGMA = 5e-4  # of p1 and p2 in lenses that are sold: a tenth to twice of it
RATIONAL = LADDER[-1]  # the denominator: nothing to divide where k1 alone explains the bend
FEWEST_PHOTOS = 3
SAME_FOCAL = 0.01
NEEDED_DEVIANCE = 9.0  # gain on held-out photographs, per parameter, that buys a term: three standard errors
CLEAR = 3.0  # standard errors over photographs from which one family of lenses is told from another
APART_PX = 1.0  # over the frame, from which it matters which
NEEDED_CONSISTENCY = 1.0  # and the mean gain of a photograph over its standard error, against a single odd photograph
GATE = 5.0  # corners, and photographs, beyond this many times the typical residual are left out
CORNER_SIGMA_PX = 0.1
SURE = 1e-3  # chance by which residuals are said to have a pattern


@dataclass(frozen=True)
class Photos:
    """Corners of the usable photographs: file names, world points (N_i, 3) and pixels (N_i, 2)."""

    files: list[str]
    world_m: list[np.ndarray]
    px: list[np.ndarray]

    def only(self, chosen: list[int]) -> Photos:
        """A subset by index."""
        return Photos(*([values[i] for i in chosen] for values in (self.files, self.world_m, self.px)))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Climbed:
    """The lens that a ladder ended with, and its photographs.

    ``held``: mean squared residual (photos,) px^2 of each photograph under a lens fitted to others; ``errors``: the
    table of what was tried, rms px; ``evidence``: a row for each step.
    """

    fit: Adjustment
    photos: Photos
    terms: tuple[str, ...]
    held: np.ndarray
    errors: dict[str, float]
    evidence: list[dict[str, Any]]


def best_lens(
    photos: Photos, size: tuple[int, int], warnings: list[str], distortion: str = "auto"
) -> tuple[Climbed, list[str]]:
    """The lens that the photographs ask for, and the warnings with those of the photographs that were left out.

    ``distortion``: "auto", or "always" and "never" for all of the ladder's terms and none, whatever they ask for.

    Wide lenses, a fisheye and the rational one from a wide start, are offered on evidence only: a residual or a pattern
    that no board has, photographs that agree with no other lens, a model that ends within the frame, or a denominator
    that was needed. All are then judged on the photographs of the wide lens that keeps most.
    """
    said: list[str] = []
    if distortion != "auto":
        start, poses = first_calibration(photos.world_m, photos.px, size)
        kept, poses = drop_bad(start, photos, poses, said)
        return forced(start, poses, kept, distortion), warnings + said
    narrow: Climbed | None = None
    try:
        start, poses = first_calibration(photos.world_m, photos.px, size)
        kept, poses = drop_bad(start, photos, poses, said)
        narrow = climb(start, poses, kept, LADDER)
        why = asks_for_wide(narrow, len(photos.files))
    except (NumericalError, CaptureError) as error:
        why, failed = "no other lens agrees with the photographs", error
    if narrow is not None and not why:
        return narrow, warnings + said
    try:
        wide = wide_lenses(photos, size)
    except (NumericalError, CaptureError):
        if narrow is None:
            raise failed from None
        return replace(narrow, evidence=[*narrow.evidence, wide_row(narrow, f"{why}; none fits")]), warnings + said
    entrants = [one for one in (narrow, *(lens for lens, _ in wide)) if one is not None]
    best, table, doubt = contest(entrants)
    left_out = next((notes for lens, notes in wide if lens is best), said)
    errors = {key: value for one in entrants for key, value in one.errors.items()}
    row = wide_row(best, f"{why}; held-out error " + ", ".join(table), [lens for lens, _ in wide])
    return replace(best, errors=errors, evidence=[*best.evidence, row]), [*warnings, *left_out, *doubt]


def contest(entrants: list[Climbed]) -> tuple[Climbed, list[str], list[str]]:
    """The best of several, fewer terms first; the table of their errors, and what leaves it open, in words.

    They are judged on the photographs of the wide one that keeps most of them.
    """
    most = max((one for one in entrants if model_of(one.fit.camera.distortion) != "brown"), default=entrants[-1],
               key=lambda one: len(one.photos.files))  # fmt: skip
    photos, poses = most.photos, most.fit.poses
    corners = np.array([len(px) for px in photos.px])
    held = [held_out(one.fit.camera, poses, photos, one.terms) for one in entrants]
    order = sorted(range(len(entrants)), key=lambda n: len(entrants[n].terms))
    best = order[0]
    for n in order[1:]:
        gain, consistency = improvement(held[best], held[n], corners)
        more = max(len(entrants[n].terms) - len(entrants[best].terms), 1)
        if gain > NEEDED_DEVIANCE * more and consistency > NEEDED_CONSISTENCY:
            best = n
    table = [
        f"{np.sqrt(error.mean()):.4f} px as {model_of(one.fit.camera.distortion)} ({' '.join(one.terms) or 'no terms'})"
        for one, error in zip(entrants, held, strict=True)
    ]
    return entrants[best], table, undecided(entrants, held, best, corners)


def undecided(entrants: list[Climbed], held: list[np.ndarray], best: int, corners: np.ndarray) -> list[str]:
    """The warning that another family of lenses explains the photographs as well, and where it would matter.

    ``held``: of each entrant, by photograph; ``corners``: how many each photograph shows. A fisheye that needed all its
    terms and that no rational lens could be compared with is one such.
    """
    lens = entrants[best].fit.camera
    families = [model_of(one.fit.camera.distortion) for one in entrants]
    if families[best] == "fisheye" and "rational" not in families and "k4" in entrants[best].terms:
        return [
            f"calibrate: a fisheye was taken as {len(corners)} photographs do not fix a rational lens to compare it "
            "with; where no board was seen the two may differ by tens of px: photograph boards there, 20 or more in all"
        ]
    for one, family, error in zip(entrants, families, held, strict=True):
        gain, consistency = improvement(error, held[best], corners)
        apart = disagreement(lens, one.fit.camera)
        if family != families[best] and not (gain > NEEDED_DEVIANCE and consistency > CLEAR) and apart > APART_PX:
            return [
                f"calibrate: {len(corners)} photographs tell {families[best]} from {family} at {consistency:.1f} sigma "
                f"only, needed {CLEAR:g}, and the two differ by {apart:.1f} px over the frame; photograph boards where "
                "none was seen"
            ]
    return []


def wide_row(best: Climbed, because: str, others: Sequence[Climbed] = ()) -> dict[str, Any]:
    """Evidence for or against a wide lens; ``others``: the wide ones that were fitted."""
    taken = model_of(best.fit.camera.distortion) != "brown"
    row = {"term": "lens fisheye or rational", "modelled": taken, "because": because, "could_cost": ""}
    if taken:
        return row
    apart = [disagreement(best.fit.camera, one.fit.camera) for one in others]
    cost = bound_of(min(apart)) if apart else {"no_bound": "none fits these photographs"}
    return row | {"could_cost": "nothing that held-out photographs show", **cost, **TRIED}


def asks_for_wide(found: Climbed, offered: int) -> str:
    """Why a wide lens may explain the photographs better; empty when nothing speaks for one."""
    camera = found.fit.camera
    shape = pattern(found.photos.px, found.fit.residuals_px, camera.width, camera.height)
    if found.fit.sigma_px > ROUGH_PX:
        return f"corners are off by {found.fit.sigma_px:.2f} px"
    if shape.chance < SURE:
        return f"residuals have a pattern over the frame ({shape.rms_px:.3f} px rms)"
    if len(found.photos.files) < offered:
        return f"{offered - len(found.photos.files)} photographs do not agree with the lens of the others"
    if np.isinf(disagreement(camera, camera)):
        return "the distortion ends within the frame"
    return "the rational model was taken" if set(RATIONAL) <= set(found.terms) else ""


def wide_lenses(photos: Photos, size: tuple[int, int]) -> list[tuple[Climbed, list[str]]]:
    """The rational lens and the fisheye that the photographs ask for, each with warnings of those that it leaves out.

    The fisheye's start: the equidistant lens of ten focal lengths that explains the boards best. The rational lens
    starts from the fisheye that was found, on all photographs.
    """
    diagonal = float(np.hypot(*size))
    best: tuple[float, Camera, list[np.ndarray]] | None = None
    for focal in diagonal * np.geomspace(0.33, 1.6, 10):  # 174 to 36 degrees across the diagonal
        camera = Camera(
            width=size[0], height=size[1], fx=focal, fy=focal, cx=size[0] / 2, cy=size[1] / 2,
            distortion=np.zeros(4), covariance=np.zeros((8, 8)), source="calibrated",
        )  # fmt: skip
        try:
            seen = zip(photos.world_m, photos.px, strict=True)
            poses = [planar_candidates(camera, world_m, px)[0] for world_m, px in seen]
        except NumericalError:
            continue  # so short that a corner lies behind the lens
        each = zip(poses, photos.world_m, photos.px, strict=True)
        off = [float((residuals_and_jacobian(camera, *one)[0] ** 2).sum(-1).mean()) for one in each]
        cost = float(np.nanmedian(off)) if np.isfinite(off).any() else np.inf
        if best is None or cost < best[0]:
            best = (cost, camera, poses)
    if best is None:
        raise NumericalError("calibrate: no fisheye images all corners, needed one that does; check [board]")
    warnings: list[str] = []
    kept, poses = drop_bad(best[1], photos, best[2], warnings)
    curved = climb(best[1], poses, kept, FISHEYE_LADDER)
    start = curved.fit.camera.model_copy(update={"distortion": EQUIDISTANT})
    said: list[str] = []
    try:
        each = zip(best[2], photos.world_m, photos.px, strict=True)
        through = [minimise(curved.fit.camera, *one) for one in each]
        own, through = drop_bad(start, photos, through, said, WIDE_LADDER[0])
        return [(climb(start, through, own, WIDE_LADDER), said), (curved, warnings)]
    except (NumericalError, CaptureError):
        return [(curved, warnings)]


def drop_bad(
    start: Camera, photos: Photos, poses: list[np.ndarray], warnings: list[str], terms: tuple[str, ...] = ("k1", "k2")
) -> tuple[Photos, list[np.ndarray]]:
    """Leave out single wrong corners, and photographs far off a lens of these ``terms``, compared with the others."""
    fit = fit_model(start, poses, photos, terms)
    scale = max(robust_scale(np.concatenate(fit.residuals_px)), 0.02)
    rms = np.array([np.sqrt((r**2).mean()) for r in fit.residuals_px])
    limit = GATE * max(float(np.median(rms)), scale)
    bad = [i for i in range(len(rms)) if rms[i] > limit]
    rest = [i for i in range(len(rms)) if i not in bad]
    if bad and len(rest) >= FEWEST_PHOTOS:
        lens = fit_model(start, [fit.poses[i] for i in rest], photos.only(rest), terms).camera
    for i in bad:
        why = ""
        if len(rest) >= FEWEST_PHOTOS:
            why = zoomed(lens, fit.poses[i], photos.world_m[i], photos.px[i], 2 * float(np.median(rms)))
        warnings.append(f"{photos.files[i]}: residual {rms[i]:.2f} px, others {np.median(rms):.2f} px{why}; left out")
    if len(rest) < FEWEST_PHOTOS:
        raise CaptureError(
            f"calibration: {len(rest)} of {len(rms)} photographs agree with one lens, needed {FEWEST_PHOTOS}; is the "
            "board flat, and focus and zoom the same in all?"
        )
    kept = [np.hypot(*fit.residuals_px[i].T) <= GATE * scale * 2 for i in rest]
    photos = photos.only(rest)
    world_m = [points[keep] for points, keep in zip(photos.world_m, kept, strict=True)]
    px = [points[keep] for points, keep in zip(photos.px, kept, strict=True)]
    return Photos(photos.files, world_m, px), [fit.poses[i] for i in rest]


def zoomed(camera: Camera, pose: np.ndarray, world_m: np.ndarray, px: np.ndarray, limit_px: float) -> str:
    """What to say of a photograph (points (N, 3), pixels (N, 2)) that another focal length explains to ``limit_px``."""
    best = (np.inf, 1.0)
    for step in (0.04, 0.01):  # a coarse search of a factor between 0.6 and 1.65, then a fine one around it
        for factor in best[1] * np.exp(step * np.arange(-12, 13)):
            lens = camera.model_copy(update={"fx": camera.fx * factor, "fy": camera.fy * factor})
            off = residuals_and_jacobian(lens, minimise(lens, pose, world_m, px), world_m, px)[0]
            best = min(best, (float(np.sqrt((off**2).mean())), float(factor)))
    if not (best[0] < limit_px and abs(best[1] - 1) > SAME_FOCAL):
        return ""
    return f"; it fits a focal length {best[1] - 1:+.0%} off: the zoom was moved"


def fit_model(start: Camera, poses: list[np.ndarray], photos: Photos, terms: tuple[str, ...]) -> Adjustment:
    """Adjust with these terms free and the others zero; without "fy" one focal length serves both axes.

    The start's family stays; Brown's is the rational one where a term of the denominator is free.
    """
    one_focal = "fy" not in terms
    count = len(start.distortion)
    if count != 4:
        count = 8 if set(RATIONAL) & set(terms) else 5
        padded = np.pad(start.distortion, (0, 3))[:count]
        start = start.model_copy(update={"distortion": padded})
    free = free_columns(tuple(term for term in terms if term != "fy"), one_focal, count)
    values = lens_vector(start) * (free.sum(1) > 0)
    if one_focal:
        values[:2] = values[:2].mean()
    return adjust(with_lens(start, values), poses, photos.world_m, photos.px, free)


def held_out(start: Camera, poses: list[np.ndarray], photos: Photos, terms: tuple[str, ...]) -> np.ndarray:
    """Mean squared residual (photos,) px^2 of each photograph under a lens fitted to the others (five folds)."""
    count = len(photos.files)
    folds = min(5, count)
    errors = np.full(count, np.inf)
    for fold in range(folds):
        train = [i for i in range(count) if i % folds != fold]
        try:
            lens = fit_model(start, [poses[i] for i in train], photos.only(train), terms).camera
            for i in range(fold, count, folds):
                every = np.ones(len(photos.px[i]), bool)
                seen = refine(lens, poses[i], photos.world_m[i], photos.px[i], CORNER_SIGMA_PX, every)
                errors[i] = (seen.residuals_px**2).sum(-1).mean()
        except NumericalError:
            continue  # too rich for this fold: its error stays infinite and the term is not taken
    return np.where(np.isfinite(errors), errors, np.inf)


def climb(start: Camera, poses: list[np.ndarray], photos: Photos, ladder: tuple[tuple[str, ...], ...]) -> Climbed:
    """Add terms while photographs that they were not fitted to gain by them; with the reason for each."""
    terms: tuple[str, ...] = ()
    best = held_out(start, poses, photos, terms)
    corners = np.array([len(px) for px in photos.px])
    family = {FISHEYE_LADDER: "fisheye ", WIDE_LADDER: "wide "}.get(ladder, "")
    errors = {f"{family}none": float(np.sqrt(best.mean()))}
    evidence: dict[tuple[str, ...], dict[str, Any]] = {}
    for _ in range(2):  # a term may pay only once a later one is in
        before = terms
        for step in ladder:
            if set(step) <= set(terms) or (step == RATIONAL and not {"k2", "k3"} & set(terms)):
                continue
            error = held_out(start, poses, photos, terms + step)
            gain, consistency = improvement(best, error, corners)
            taken = gain > NEEDED_DEVIANCE * len(step) and consistency > NEEDED_CONSISTENCY
            errors[family + " ".join(terms + step)] = float(np.sqrt(error.mean()))
            because = (
                f"held-out error {np.sqrt(best.mean()):.4f} -> {np.sqrt(error.mean()):.4f} px: gain in deviance "
                f"{gain:.1f} (needs {NEEDED_DEVIANCE * len(step):g}), photographs agree at {consistency:+.1f} sigma"
            )
            evidence[step] = {
                "term": f"lens {family}{' '.join(step)}",
                "modelled": taken,
                "because": because,
                "could_cost": "",
            }
            if taken:
                best, terms = error, terms + step
        if terms == before:
            break
    chosen = fit_model(start, poses, photos, terms)
    for step, entry in evidence.items():
        if not entry["modelled"]:
            entry |= cost_of(step, terms, chosen, start, poses, photos)
    if DECENTRING in ladder and not set(DECENTRING) & set(terms):
        chosen = perhaps_decentred(chosen, photos, terms)
        evidence[DECENTRING]["because"] += f"; what is left out of {DECENTRING_SIGMA:g} each is in the covariance"
    return Climbed(chosen, photos, terms, best, errors, list(evidence.values()))


def perhaps_decentred(fit: Adjustment, photos: Photos, terms: tuple[str, ...]) -> Adjustment:
    """A lens fitted without decentring, its covariance with what that may be, which the principal point took up."""
    lens, count = fit.camera, len(fit.camera.distortion)
    free = free_columns(tuple(term for term in terms if term != "fy"), "fy" not in terms, count)
    left_out = free_columns(DECENTRING, True, count)[:, -2:]
    sigma = np.full(2, DECENTRING_SIGMA)
    more = considered(fit, photos.world_m, photos.px, free, left_out, sigma)
    return replace(fit, camera=lens.model_copy(update={"covariance": lens.covariance + more}))


def forced(start: Camera, poses: list[np.ndarray], photos: Photos, distortion: str) -> Climbed:
    """The lens of all terms that the photographs determine ("always"), or of none ("never"), whatever is gained."""
    terms: tuple[str, ...] = ()
    chosen, best = fit_model(start, poses, photos, terms), held_out(start, poses, photos, terms)
    errors = {"none": float(np.sqrt(best.mean()))}
    rows: list[dict[str, Any]] = []
    for step in LADDER:
        because = f"knob calibrate.distortion = {distortion}"
        row = {"term": f"lens {' '.join(step)}", "modelled": False, "because": because, "could_cost": ""}
        rows.append(row)
        if distortion == "never":
            row |= cost_of(step, (), chosen, start, poses, photos)
            continue
        error = held_out(start, poses, photos, terms + step)
        errors[" ".join(terms + step)] = float(np.sqrt(error.mean()))
        try:
            richer = fit_model(start, poses, photos, terms + step)
        except NumericalError:
            richer = None
        if richer is None or not np.isfinite(error).all():  # too rich for all of them, or for four fifths
            row |= {"could_cost": "unknown", "no_bound": "these photographs do not determine it", **TRIED}
            continue
        said = f"{because}; held-out error {np.sqrt(best.mean()):.4f} -> {np.sqrt(error.mean()):.4f} px"
        row |= {"modelled": True, "because": said}
        chosen, best, terms = richer, error, terms + step
    return Climbed(chosen, photos, terms, best, errors, rows)


def cost_of(
    step: tuple[str, ...],
    terms: tuple[str, ...],
    chosen: Adjustment,
    start: Camera,
    poses: list[np.ndarray],
    photos: Photos,
) -> dict[str, Any]:
    """How far the lens with the term left out would be from the chosen one, in words and [px], as evidence has it."""
    try:
        shift = disagreement(chosen.camera, fit_model(start, poses, photos, terms + step).camera)
    except NumericalError:
        return {"could_cost": "unknown", "no_bound": "these photographs do not determine it", **TRIED}
    return {"could_cost": f"{shift:.3f} px rms over the frame", **bound_of(shift), **TRIED}


def bound_of(shift_px: float) -> dict[str, Any]:
    """What evidence says of a lens that is so far from another, rms over the frame; infinite where one of them ends."""
    if not np.isfinite(shift_px):
        return {"no_bound": "one of the lenses ends within the frame"}
    return {"bound_px": float(shift_px)}


def improvement(before: np.ndarray, after: np.ndarray, corners: np.ndarray) -> tuple[float, float]:
    """Gain in deviance of the held-out corners, and the photographs' mean gain in its standard errors.

    The latter on logarithms, as distortion costs a board in the corner of the frame a hundred times what it costs one
    in the middle: the plain mean would carry the scatter of the photographs, not of the models.
    """
    if not np.isfinite(after).all():
        return -np.inf, -np.inf
    if not np.isfinite(before).all():
        return np.inf, np.inf
    variance = max(float((corners * after).sum() / (2 * corners.sum())), 1e-12)  # of one coordinate
    gain = np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
    scatter = max(float(gain.std(ddof=1)) / np.sqrt(len(gain)), 1e-12)
    return float((corners * (before - after)).sum() / variance), float(gain.mean() / scatter)


def disagreement(first: Camera, second: Camera) -> float:
    """Rms distance, px, between where two lenses image the same rays, over the frame."""
    y, x = np.meshgrid(np.linspace(0, first.height, 13), np.linspace(0, first.width, 17), indexing="ij")
    px = np.stack([x, y], -1).reshape(-1, 2)
    try:
        xy = unproject(first, px)
    except NumericalError:
        return np.inf
    moved = project(second, np.concatenate([xy, np.ones((len(xy), 1))], -1)) - px
    finite = np.isfinite(moved).all(-1)
    return float(np.sqrt((moved[finite] ** 2).sum(-1).mean())) if finite.any() else np.inf
