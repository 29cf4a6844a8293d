"""What a map from elsewhere is worth in the plate's unit: one factor, and how sure it is.

In this order: stated; the plate's own pixels in the directions that the map shows too (only for a map that was taken
here); the plane's stated albedo, or the white paper of the board, under the map's irradiance (equation 8 solved for the
light); else unknown, and said loudly. The factor's error is the same for all texels: it does not average out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import invert_rigid, latlong_directions, latlong_solid_angles, transform_points
from pipeline.light.environment import irradiance, resize_environment
from pipeline.light.prediction import paper_points, sample
from pipeline.probes.observation import Shots, lookup_channels

PAPER_ALBEDO, PAPER_SIGMA_REL = 0.825, 0.09  # uncoated to coated white paper reflects 0.70 to 0.95
COARSE = (64, 128)  # texels on which map and plate are compared
HORIZON = np.radians(7.0)  # below it a direction meets the plane, above it nothing near
FEWEST_SR = 0.05  # solid angle that plate and map must share: a square of 13 degrees
CELL_SR = 0.0375  # solid angle taken as one independent comparison: 11 degrees
FLOOR_REL = 0.01  # of a ratio: parallax, blur, gloss of the plane
PATCHY = 0.5  # spread of the logarithm of the ratio beyond which map and plate do not show the same things
SIGNIFICANT = 3.0  # standard deviations


@dataclass(frozen=True)
class Scale:
    """Factor (3,) on the map, the relative standard uncertainty that all texels share, and how it came about."""

    factor: np.ndarray
    sigma_rel: float
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Ratio:
    """Plate over map per channel (3,), relative sigma (3,), the spread of its logarithm, and the share compared."""

    value: np.ndarray
    sigma_rel: np.ndarray
    spread: float
    shared_sr: float


def solve(
    shots: Shots, rgb: np.ndarray, known: np.ndarray, centre: np.ndarray, taken_here: bool, developed: bool = False
) -> Scale:
    """The scale of a map (H, W, 3), world frame, in its own unit; ``known`` (H, W) in [0, 1]; ``centre`` (3,) of it.

    ``developed``: it was made of the capture's own photographs, which are in the plate's unit as well as their
    exposures are known; that uncertainty comes from the stage balance.
    """
    probe = shots.facts["probe"]
    ratio = plate_ratio(shots, rgb, known, centre) if taken_here else None
    if probe.get("scale"):
        return _stated(float(probe["scale"]), float(probe["scale_sigma_rel"]), ratio)
    if ratio is not None and ratio.spread < PATCHY:
        return _from_plate(ratio)
    said = []
    if ratio is not None:
        said.append(
            f"map: it and the plate differ by a factor that varies by {np.expm1(ratio.spread):.0%} over the directions "
            "that both show: they do not see the same things; the scale is taken from elsewhere. Is position_m right?"
        )
    if developed:
        return Scale(np.ones(3), 0.0, _numbers("developed", np.ones(3), 0.0), said, [_reason("developed", 0.0, True)])
    from_plane = _from_surface(shots, rgb, known)
    if from_plane is not None:
        return Scale(from_plane.factor, from_plane.sigma_rel, from_plane.numbers, said + from_plane.warnings,
                     from_plane.evidence)  # fmt: skip
    said.append(
        "map: NOTHING SAYS HOW BRIGHT IT IS against the plate; taken as being in the plate's unit (scale 1), so that "
        "objects and albedo may be off by any factor. State probe.scale or probe.plane_albedo, or where it was taken "
        "(probe.position_m), or lay the board into the plate"
    )
    return Scale(np.ones(3), 1.0, _numbers("unknown", np.ones(3), 1.0), said, [_reason("unknown", 1.0, False)])


def plate_ratio(shots: Shots, rgb: np.ndarray, known: np.ndarray, centre: np.ndarray) -> Ratio | None:
    """Plate over map, robustly, in the directions that both show; None when they share too little.

    A direction 7 degrees or more under the horizon meets the plane: there the plate's pixel of the same spot counts;
    one above the horizon is taken as distant.
    """
    means, weight = seen_by_plate(shots, centre)
    share = resize_environment(known[..., None].astype(float), *COARSE)[..., 0]
    ours = resize_environment(rgb * known[..., None], *COARSE) / np.where(share > 0, share, 1)[..., None]
    good = (weight > 0) & (share > 0.99) & (means > 0).all(-1) & (ours > 0).all(-1)
    area = latlong_solid_angles(*COARSE)[good]
    if area.sum() < FEWEST_SR:
        return None
    logarithm = np.log(means[good] / ours[good])
    centre_log = np.array([_median(logarithm[:, i], area) for i in range(3)])
    spread = np.array([1.4826 * _median(np.abs(logarithm[:, i] - centre_log[i]), area) for i in range(3)])
    cells = max(float(area.sum()) / CELL_SR, 1.0)
    sigma = np.hypot(1.2533 * spread / np.sqrt(cells), FLOOR_REL)
    return Ratio(np.exp(centre_log), sigma, float(spread.mean()), float(area.sum()))


def seen_by_plate(shots: Shots, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plate's radiance (H, W, 3) in the directions of the coarse grid as seen from ``centre``, and which are good.

    A texel is the mean of 4 x 4 lookups; one with an invalid or clipped pixel among them is not good.
    """
    camera, view = shots.camera, shots.views["plate"].world_from_camera
    split = 4
    w = latlong_directions(COARSE[0] * split, COARSE[1] * split).reshape(-1, 3)
    elevation = np.arcsin(w[:, 1])
    on_plane = (elevation < -HORIZON) & (centre[1] > 0)
    down = np.where(on_plane, w[:, 1], -1.0)
    local = transform_points(invert_rigid(view), centre - w * (centre[1] / down)[:, None])
    local[~on_plane] = w[~on_plane] @ view[:3, :3]
    px = project(camera, local)
    usable = on_plane | (elevation > 0)
    inside = np.isfinite(px).all(-1) & (px > 1).all(-1) & (px < (camera.width - 1, camera.height - 1)).all(-1) & usable
    picture = lookup_channels(shots.photographs["plate"])
    found = np.zeros((len(w), 5), np.float32)
    found[inside] = sample(picture, px[inside, 0], px[inside, 1])[:, [0, 1, 2, 6, 7]]
    parts = found.reshape(COARSE[0], split, COARSE[1], split, 5).mean((1, 3))
    return parts[..., :3], (parts[..., 3] > 0.999) & (parts[..., 4] < 1e-6)


def _median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _stated(scale: float, sigma: float, ratio: Ratio | None) -> Scale:
    """The manifest's scale; when the plate says another one, both are told."""
    said = []
    if ratio is not None and ratio.spread < PATCHY:
        measured, doubt = float(ratio.value.mean()), float(np.hypot(sigma, ratio.sigma_rel.mean()))
        if abs(np.log(measured / scale)) > SIGNIFICANT * doubt:
            said.append(
                f"map: probe.scale is {scale:.4g}, but the plate says {measured:.4g} in the directions it shows"
            )
    factor = np.full(3, scale)
    return Scale(factor, sigma, _numbers("stated", factor, sigma, ratio), said, [_reason("stated", sigma, True)])


def _from_plate(ratio: Ratio) -> Scale:
    """One factor, or one per channel when the channels disagree beyond their noise: another white balance."""
    logarithm = np.log(ratio.value)
    differ = bool(np.ptp(logarithm) > SIGNIFICANT * float(ratio.sigma_rel.max()))
    factor = ratio.value if differ else np.full(3, np.exp(logarithm.mean()))
    sigma = float(ratio.sigma_rel.mean())
    said = []
    if differ:
        said.append(
            f"map: its colours differ from the plate's by {', '.join(f'{v:.3f}' for v in ratio.value)} (R, G, B); "
            "brought to the plate's"
        )
    return Scale(factor, sigma, _numbers("plate", factor, sigma, ratio), said, [_reason("plate", sigma, True)])


def _from_surface(shots: Shots, rgb: np.ndarray, known: np.ndarray) -> Scale | None:
    """The light that the plane, or the board's paper, must have got: ``pi L / (albedo E)``; None without either."""
    probe, board = shots.facts["probe"], shots.facts.get("board")
    if probe.get("plane_albedo"):
        albedo, sigma, route, points = probe["plane_albedo"], probe["plane_albedo_sigma_rel"], "plane_albedo", None
    elif board:
        albedo, sigma, route = PAPER_ALBEDO, PAPER_SIGMA_REL, "paper"
        points = paper_points(tuple(board["squares"]), board["square_m"], board["marker_m"], board.get("legacy", False))
    else:
        return None
    radiance = _radiance_at(shots, _around_the_aim(shots) if points is None else points, route)
    mean = (rgb * known[..., None]).sum((0, 1)) / max(float(known.sum()), 1e-12)
    light = irradiance(resize_environment(np.where(known[..., None] > 0, rgb, mean), *COARSE), np.array([[0, 1.0, 0]]))
    if radiance is None or not (light > 0).all():
        return None
    each = np.pi * radiance / (albedo * light[0])
    factor = np.full(3, float(np.exp(np.log(each).mean())))
    numbers = _numbers(route, factor, sigma) | {"factor_rgb": each.tolist()}
    said = [f"map: its brightness is known only from the {route.replace('_', ' ')}, to {sigma:.0%}"]
    return Scale(factor, float(sigma), numbers, said, [_reason(route, float(sigma), True)])


def _around_the_aim(shots: Shots) -> np.ndarray:
    """World points (N, 3) of the plane around where the plate's camera looks, as far as it is high."""
    view = shots.views["plate"].world_from_camera
    eye, height = view[:3, 3], abs(float(view[1, 3]))
    middle = np.array([[shots.camera.width / 2, shots.camera.height / 2]])
    axis = (pixel_rays(shots.camera, middle) @ view[:3, :3].T)[0]
    aim = eye - axis * (eye[1] / axis[1]) if axis[1] < -0.05 else eye + 2 * height * axis
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 64) * height, np.linspace(-0.5, 0.5, 64) * height)
    return np.stack([aim[0] + x.ravel(), 0 * x.ravel(), aim[2] + z.ravel()], -1)


def _radiance_at(shots: Shots, points: np.ndarray, route: str) -> np.ndarray | None:
    """The plate's radiance (3,) at points (N, 3): the mean over the plane, the median over paper; None if not shown."""
    camera, view = shots.camera, shots.views["plate"].world_from_camera
    px = project(camera, transform_points(invert_rigid(view), points))
    px = px[np.isfinite(px).all(-1) & (px > 1).all(-1) & (px < (camera.width - 1, camera.height - 1)).all(-1)]
    found = sample(lookup_channels(shots.photographs["plate"]), px[:, 0], px[:, 1])
    found = found[(found[:, 6] > 0.999) & (found[:, 7] < 1e-6), :3]
    if len(found) < 20:
        return None
    radiance = np.asarray(np.median(found, 0) if route == "paper" else found.mean(0), float)
    return radiance if (radiance > 0).all() else None


def _numbers(route: str, factor: np.ndarray, sigma: float, ratio: Ratio | None = None) -> dict[str, Any]:
    found: dict[str, Any] = {"route": route, "factor": factor.tolist(), "sigma_rel_shared": sigma}
    if ratio is not None:
        found |= {"plate_over_map": ratio.value.tolist(), "plate_over_map_sigma_rel": ratio.sigma_rel.tolist(),
                  "spread": ratio.spread, "shared_sr": ratio.shared_sr}  # fmt: skip
    return found


def _reason(route: str, sigma: float, modelled: bool) -> dict[str, Any]:
    because = {
        "stated": "probe.scale states it",
        "plate": "plate and map show the same directions, the plane from the plate's pixels of the same spots",
        "plane_albedo": "probe.plane_albedo states how the plane reflects",
        "paper": f"the board's white paper reflects {PAPER_ALBEDO} +- {PAPER_SIGMA_REL:.0%}",
        "developed": "its photographs are in the plate's unit as well as the stage balance knows exposures",
        "unknown": "nothing in the capture ties the map to the plate",
    }
    return {
        "term": "scale of the map against the plate",
        "modelled": modelled,
        "because": because[route],
        "could_cost": f"{sigma:.1%} of all light at once; it does not average over texels",
        "bound_rel": 2 * sigma,
    }
