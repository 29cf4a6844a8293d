"""How far the camera turned between two photographs from one tripod, from what both show, with covariance.

The pictures are averaged down and made even in tone; windows with texture measure their own shift by least squares on
intensity, gain and offset free (Lucas and Kanade 1981; window shifts as in Kybic and Unser 2003), starting from the
peak of the whole pictures' phase correlation. A robust fit of one small rotation through the lens says which windows
belong to the still scene: what was put in or taken out (ball, board, their shadows) is left out. Covariance: the
windows' scatter about the rotation, as windows of one picture share no pixels, and what interpolation makes of a turn,
nothing for none. What the rotation leaves is fitted by an
affine field, with covariance, and told at the objects' feet. Limits: a rotation only is undone, as a tripod that is
knocked turns far more than it shifts; turns of less than half a window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera.lens import project_jacobians, unproject
from pipeline.camera.opencv_bridge import Sightings
from pipeline.camera.rigid import camera_points, rotation_exp, skew
from pipeline.run.errors import NumericalError
from pipeline.types import Camera, Motion, View

LARGEST = 1.5e6  # pixels of the pictures that are compared
WINDOW = 32  # px of them
FEWEST = 8  # windows that must agree
LEAST_SHARE = 0.3  # of the windows with texture
NOISE_SHIFT_PX = 0.2  # a window whose texture fixes its shift no better says nothing
BLURS_PX = (4.0, 2.0, 1.0, 0.0)  # from coarse to fine, as a shift is found from within half a wave
ROUNDS, SETTLED_PX = 6, 2e-3
LEAST_LIKENESS = 0.7  # correlation of a window with its place in the other picture
GATE = 4.0
SYSTEMATIC_PX = 0.02  # at most, that all windows share: interpolation; 0.015 px is measured at a turn of 7 px
FLOOR_PX = 0.02  # in weights, windows agree no better than interpolation does
SHIFTED_PX = 1.0  # at a foot: beyond it the plate is not where the board was seen
CLEAR = 3.0  # standard uncertainties from which what a turn leaves is no noise


@dataclass(frozen=True)
class Registration:
    """Rotation vector (3,) rad with ``p_other = exp(rotation) p_plate`` in camera frames, and its covariance (3, 3).

    ``rest`` (3, 2) px and ``rest_covariance`` (3, 3): what it leaves, as in `pipeline.types.Motion`. ``evidence``: chi2
    of having turned at all holds `SYSTEMATIC_PX` and `FLOOR_PX` against it whole, so that less is no motion.
    """

    rotation: np.ndarray
    covariance: np.ndarray
    rest: np.ndarray
    rest_covariance: np.ndarray
    evidence: dict[str, Any]


def registered(plate: np.ndarray, other: np.ndarray, camera: Camera) -> Registration:
    """The small rotation between two photographs (H, W), linear radiance, of one camera on one tripod.

    Raises NumericalError when too few windows agree on one.
    """
    from scipy.ndimage import gaussian_filter

    step = max(1, int(np.ceil(np.sqrt(plate.size / LARGEST))))
    one, two = even(plate, step), even(other, step)
    corners = windows(one.shape)
    centre = (corners + WINDOW / 2) * step
    rays = np.concatenate([unproject(camera, centre), np.ones((len(centre), 1))], -1)
    _, by_point, _ = project_jacobians(camera, rays)
    turn = (by_point @ -skew(rays)) / step  # (N, 2, 3) compared px by rotation vector
    shift = np.broadcast_to(coarse_shift(one, two), (len(corners), 2)).astype(float)
    for blur in BLURS_PX:
        here, there = (gaussian_filter(picture, blur) if blur else picture for picture in (one, two))
        for _ in range(ROUNDS):
            measured, sigma = window_shifts(here, there, corners, shift)
            rotation, kept, noise = fitted(turn, measured, sigma)
            moved = np.abs(turn @ rotation - shift).max()
            shift = turn @ rotation
            if moved < SETTLED_PX:
                break
    good = kept & np.isfinite(sigma)
    textured = int(np.isfinite(sigma).sum())
    if good.sum() < FEWEST or good.sum() < LEAST_SHARE * textured:
        raise NumericalError(
            f"{int(good.sum())} of {textured} windows with texture agree on how the camera turned, needed {FEWEST} and "
            f"{LEAST_SHARE:.0%}; show the board in the plate, or photograph [views]"
        )
    weight = 1 / (sigma[good] ** 2 + noise**2)
    left = (measured - turn @ rotation)[good]
    moved = np.hypot(*(turn @ rotation).T)
    share = min(1.0, 2 * np.pi * float(np.sqrt((moved**2).mean())))  # interpolation errs as a sine of the shift
    between = SYSTEMATIC_PX * share
    covariance = scattered(turn[good], weight, left) + (between * step / camera.fx) ** 2 * np.eye(3)
    along = affine(centre[good], camera)
    rest = np.linalg.solve(along.T @ (weight[:, None] * along), along.T @ (weight[:, None] * left))
    # from the scatter about the turn, of which a rest is part: a window's one step falls short of large ones
    rest_covariance = max((scattered(along[:, None], weight, one[:, None]) for one in left.T), key=np.trace)
    rest_covariance = rest_covariance + between**2 * np.diag([0, 1, 1])  # a shift of all is the turn's
    normal = np.einsum("n,nki,nkj->ij", weight, turn[good], turn[good])
    widest = np.linalg.inv(normal) + (SYSTEMATIC_PX * step / camera.fx) ** 2 * np.eye(3)
    return Registration(rotation, covariance, rest * step, rest_covariance * step**2, {
        "windows": int(good.sum()), "textured": textured, "scatter_px": float(noise * step),
        "shift_px": float(np.sqrt((moved**2).mean())) * step, "shift_max_px": float(moved.max()) * step,
        "chi2": float(rotation @ np.linalg.solve(widest, rotation)),
    })  # fmt: skip


def scattered(design: np.ndarray, weight: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Covariance (P, P) of a weighted least squares fit from what it leaves (N, K), whatever the weights meant.

    ``design`` (N, K, P), ``weight`` (N,). White 1980 (heteroskedasticity-consistent), times N / (N - P) for few.
    """
    inverse = np.linalg.inv(np.einsum("n,nki,nkj->ij", weight, design, design))
    pull = np.einsum("n,nki,nk->ni", weight, design, left)
    count, unknowns = pull.shape
    found: np.ndarray = inverse @ (pull.T @ pull) @ inverse * count / max(count - unknowns, 1)
    return (found + found.T) / 2


def affine(px: np.ndarray, camera: Camera) -> np.ndarray:
    """(N, 3) of pixels (N, 2): 1, and x and y from the middle of the frame over its sides."""
    return np.concatenate([np.ones((len(px), 1)), px / (camera.width, camera.height) - 0.5], -1)


def even(picture: np.ndarray, step: int) -> np.ndarray:
    """(h, w) float64: blocks of ``step`` averaged, and a root that makes noise and contrast alike in light and dark."""
    height, width = (n // step * step for n in picture.shape)
    mean = np.asarray(picture[:height, :width], float)
    mean = mean.reshape(height // step, step, width // step, step).mean((1, 3))
    typical = float(np.median(mean[np.isfinite(mean)])) if np.isfinite(mean).any() else 1.0
    return np.asarray(np.sqrt(np.clip(np.nan_to_num(mean / max(typical, 1e-12)), 0, 16)))


def windows(shape: tuple[int, ...]) -> np.ndarray:
    """(N, 2) x, y of the first pixels of windows side by side, a margin of one window around."""
    y, x = (np.arange(WINDOW, n - 2 * WINDOW + 1, WINDOW) for n in shape)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def coarse_shift(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """(2,) whole pixels x, y by which ``two`` shows the same farther, at most a window: peak of phase correlation."""
    fade = np.hanning(one.shape[0])[:, None] * np.hanning(one.shape[1])
    cross = np.conj(np.fft.rfft2((one - one.mean()) * fade)) * np.fft.rfft2((two - two.mean()) * fade)
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), one.shape)
    reach = WINDOW // 2
    near = np.roll(peak, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    return np.array([column - reach, row - reach], float)


def window_shifts(
    one: np.ndarray, two: np.ndarray, corners: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts (N, 2) px of windows and their standard uncertainty (N,); infinite where texture does not fix them."""
    from scipy.ndimage import map_coordinates, spline_filter

    smooth = spline_filter(two, 3)
    rows, columns = np.mgrid[-1 : WINDOW + 1, -1 : WINDOW + 1]
    found, sigma = start.copy(), np.full(len(corners), np.inf)
    for n, (x, y) in enumerate(corners):
        here = one[y : y + WINDOW, x : x + WINDOW].ravel()
        at = [rows + y + start[n, 1], columns + x + start[n, 0]]
        there = map_coordinates(smooth, at, order=3, mode="nearest", prefilter=False)
        slope_y, slope_x = (part[1:-1, 1:-1].ravel() for part in np.gradient(there))
        there = there[1:-1, 1:-1].ravel()
        design = np.stack([slope_x, slope_y, -here, -np.ones_like(here)], -1)
        normal = design.T @ design
        if np.linalg.cond(normal) > 1e10:
            continue
        inverse = np.linalg.inv(normal)
        step = -inverse @ design.T @ there  # there + slope step = gain here + offset
        left = float(((there + design @ step) ** 2).sum()) / (len(here) - 4)
        spread = float(np.sqrt(left * np.linalg.eigvalsh(inverse[:2, :2])[-1]))
        if spread < NOISE_SHIFT_PX and np.corrcoef(here, there)[0, 1] > LEAST_LIKENESS:
            found[n] += np.clip(step[:2], -1, 1)
            sigma[n] = spread
    return found, sigma


def fitted(turn: np.ndarray, shift: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation (3,) of the windows that agree, which do (N,), and their scatter beyond their own noise, px.

    A start by the median shift, as a small rotation is nearly one; then least squares with a gate that closes.
    """
    usable = np.isfinite(sigma)
    if usable.sum() < 3:
        return np.zeros(3), np.zeros(len(sigma), bool), FLOOR_PX
    centre = np.median(shift[usable], 0)
    off = np.hypot(*(shift - centre).T)
    kept = usable & (off <= max(2.0 * float(np.median(off[usable])), 0.5))
    rotation, noise = np.zeros(3), FLOOR_PX
    for _ in range(10):
        weight = 1 / (sigma[kept] ** 2 + noise**2)
        normal = np.einsum("n,nki,nkj->ij", weight, turn[kept], turn[kept])
        rotation = np.linalg.solve(
            normal + 1e-9 * np.trace(normal) * np.eye(3), np.einsum("n,nki,nk->i", weight, turn[kept], shift[kept])
        )
        residual = shift - turn @ rotation
        typical = 1.4826 * float(np.median(np.abs(residual[kept])))
        noise = max(FLOOR_PX, float(np.sqrt(max(typical**2 - float(np.median(sigma[kept])) ** 2, 0.0))))
        allowed = GATE * np.sqrt(np.where(usable, sigma, 0) ** 2 + noise**2)
        again = usable & (np.abs(residual).max(-1) <= allowed)
        if again.sum() < 3 or np.array_equal(again, kept):
            break
        kept = again
    return rotation, kept, noise


def lender(sights: dict[str, Sightings], tripod: list[str], fewest: int) -> str:
    """The tripod view that shows most of the board which the plate does not show; empty for none."""
    if "plate" not in sights or len(sights["plate"].px) >= fewest:
        return ""
    shown = {name: len(sights[name].px) for name in tripod if name in sights and len(sights[name].px) >= fewest}
    return max(shown, key=lambda name: shown[name], default="")


def turned(view: View, found: Registration, of: str = "") -> View:
    """The pose of the registration's first picture (the plate) from the ``view`` of its second, covariances added.

    Its route is "tripod". Position and lens are the other's: a tripod only turns. ``of``: the second's name, for the
    record of the motion.
    """
    whole = np.eye(4)
    whole[:3, :3] = rotation_exp(found.rotation)
    covariance = view.covariance.copy()
    about = view.world_from_camera[:3, :3]
    covariance[:3, :3] += about @ found.covariance @ about.T
    motion = Motion(of=of, rotation=found.rotation, covariance=found.covariance, rest=found.rest,
                    rest_covariance=found.rest_covariance) if of else None  # fmt: skip
    changed = {"covariance": covariance, "route": "tripod", "motion": motion}
    return view.model_copy(update={"world_from_camera": view.world_from_camera @ whole, **changed})


def motion_at(camera: Camera, view: View, spots: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """How far the picture moved at places (3,) of the world, px, and what of it is left, each with its uncertainty.

    Empty for a view that was registered to none. Uncertainties are the larger axis's.
    """
    moved: dict[str, dict[str, float]] = {}
    for name, spot in spots.items() if view.motion is not None else []:
        assert view.motion is not None
        point = camera_points(view.world_from_camera, spot[None])[0]
        px, by_point, _ = project_jacobians(camera, point)
        if not np.isfinite(px).all():
            continue
        by_turn = by_point[0] @ -skew(point[0])
        along = affine(px, camera)[0]
        moved[name] = {
            "shift_px": float(np.linalg.norm(by_turn @ view.motion.rotation)),
            "sigma_px": float(np.sqrt(np.linalg.eigvalsh(by_turn @ view.motion.covariance @ by_turn.T)[-1])),
            "rest_px": float(np.linalg.norm(along @ view.motion.rest)),
            "rest_sigma_px": float(np.sqrt(along @ view.motion.rest_covariance @ along)),
        }
    return moved


def rest_of(moved: dict[str, float]) -> float:
    """What is left at a spot, px, where it is no noise; else 0."""
    return moved["rest_px"] if moved["rest_px"] > CLEAR * moved["rest_sigma_px"] else 0.0


def motion_said(of: str, moved: dict[str, dict[str, float]]) -> list[str]:
    """Warnings about feet at which the plate is a pixel or more from where the view ``of`` showed the board."""
    said = []
    for name, at in moved.items():
        rest = f"{at['rest_px']:.2f} +- {at['rest_sigma_px']:.2f} px"
        if at["shift_px"] > SHIFTED_PX:
            said.append(
                f"plate: between {of}, which shows the board, and the plate the camera turned by "
                f"{at['shift_px']:.2f} +- {at['sigma_px']:.2f} px at {name}, needed below {SHIFTED_PX:g}; "
                f"undone, {rest} are left there: photograph the plate again right after the board"
            )
        if rest_of(at) > SHIFTED_PX:
            said.append(
                f"plate: still things are {rest} off a turn at {name}, needed below {SHIFTED_PX:g} px: tripod or lens "
                f"was pushed after {of}, and objects stand wrong by as much; photograph the plate again, or add [views]"
            )
    return said
