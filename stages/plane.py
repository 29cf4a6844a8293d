"""The local scene's plane, the rectangle of it that is modelled, how surely objects stand on it, and what stands by it.

The markers define the world, so the plane is ``y = 0`` exactly; what is uncertain is where the camera stands to it.
Covariance: the plate's pose covariance turned into the plane's tilt and offset as seen from the camera. Contact: pose
and lens covariance, with their correlation, projected to pixels at the foot of each object; of a plate that was
registered to a tripod view also what the turn between them leaves there, and more than a pixel is said. Rectangle: the
board and every point at which an object can change the light by more than ``left_out``, by its bounding sphere under
the map (`pipeline.transport.extent`); what lies behind the plate camera is cut off. Where further views were adjusted
with the markers, a plane is fitted to their cloud (robust, weighted) and its agreement with the markers' is tested; the
markers' plane stays the world's. Flat surfaces that stand beside it are found in the same cloud, and are modelled where
the objects would change them. Limits: one flat surface carries the objects; what a concave object focuses may reach
farther than the rectangle; surfaces without texture are not found.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.cloud_plane import AGREE_CHI2, CloudPlane, plane_of_cloud
from pipeline.camera.contact import contact_sigma
from pipeline.camera.lens import project
from pipeline.camera.planes_in_cloud import flat_surfaces
from pipeline.camera.rigid import camera_points
from pipeline.camera.tripod_registration import motion_at, motion_said, rest_of
from pipeline.camera.view_checks import check_feet, feet_of, height_above
from pipeline.run.artifacts import (
    CAMERA,
    CLOUD,
    EMITTERS,
    FACTS,
    LIGHTING,
    PLANE,
    PROXIES,
    SURROUNDINGS,
    VIEWS,
    WISHES,
)
from pipeline.run.errors import CaptureError
from pipeline.run.stage import Stage
from pipeline.transport.beside import as_proxy, weighed
from pipeline.transport.extent import FAR_SEEN, Standing, beyond, needed, standing
from pipeline.transport.influence import light_on
from pipeline.types import Camera, Emitter, Plane, Proxy, Raster, Reconstruction, Result, View
from stages import knobs

EDGE_ON_DEG, GRAZING_DEG = 1.0, 5.0  # elevation of the camera over the plane, seen from a foot: refused, warned of
NEAREST_DEPTH = (
    0.1  # of the depth of the nearest thing that stands: the rectangle ends there, before the camera's plane
)
BISECTIONS = 50  # to rounding
BARE = 8.0  # sizes around a marker where no object stands
UP = np.array([0.0, 1.0, 0.0])


def compute(
    facts: dict[str, Any], wishes: dict[str, Any], camera: Camera, views: dict[str, View], cloud: Reconstruction,
    environment: Raster, emitters: list[Emitter], proxies: list[Proxy], params: knobs.Plane,
) -> Result:  # fmt: skip
    """Plane ``y = 0`` of the world with covariance, the modelled rectangle, and the contact uncertainty in pixels."""
    view = views["plate"]
    height = height_above(view)
    feet = feet_of(wishes)
    warnings = check_feet(feet, camera, view)
    marked, size = marker_rectangle(facts, height)
    ground = np.array([*marked, *feet.values()]) if feet or len(marked) else np.zeros((1, 3))
    spots = feet or {"marker": ground.mean(0)}
    elevation = elevation_deg(view, list(spots.values()))
    contact = {name: sigma for name, spot in spots.items() if np.isfinite(sigma := contact_sigma(camera, view, spot))}
    moved = motion_at(camera, view, spots)
    contact |= {name: float(np.hypot(contact[name], rest_of(at))) for name, at in moved.items() if name in contact}
    warnings += motion_said(view.motion.of if view.motion else "", moved)
    covariance = plane_covariance(view)
    deviations = np.sqrt(np.diag(covariance))
    warnings += edge_on(elevation, view, list(spots.values()), float(np.hypot(*deviations[:2])), contact)
    level = Plane(
        normal=UP, offset_m=0.0, covariance=covariance, corners_m=np.zeros((4, 3)), source=view.route,
        contact_sigma_px=max(contact.values(), default=0.0),
    )  # fmt: skip
    objects = standing(wishes, level, size)
    corners, extent = rectangle(ground, objects, size, view, camera, environment, emitters, params, warnings)
    plane = level.model_copy(update={"corners_m": corners})
    numbers = {
        "normal_sigma_deg": float(np.degrees(np.hypot(deviations[0], deviations[1]))),
        "offset_sigma_m": float(deviations[2]),
        "contact_sigma_px": contact, "camera_height_m": height, "elevation_deg": elevation,
        "rectangle_m": [float(corners[:, 0].min()), float(corners[:, 2].min()),
                        float(corners[:, 0].max()), float(corners[:, 2].max())],
    } | extent | ({"motion_px": moved} if moved else {})  # fmt: skip
    found = plane_of_cloud(cloud, height, corners) if len(cloud.points) else None
    shown, rows, surroundings = None, None, list(proxies)
    if found is not None:
        numbers["cloud"] = shown = against_cloud(found, covariance, spots, camera, view, warnings)
        table = beside(cloud, corners, found.uneven_m, objects, proxies, environment, emitters, camera, view, params)
        numbers["surfaces"] = rows = [row for row, _ in table]
        surroundings += [proxy for row, proxy in table if row["modelled"]]
    uneven_px = 0.0
    if shown is not None:
        height = max(map(abs, shown["height_m"].values())) + 2 * shown["uneven_m"]
        uneven_px = moved_by_height(height, list(spots.values()), view, camera, emitters)
    terms = [
        *evidence(view, shown, uneven_px),
        extent_evidence(extent, params.left_out),
        beside_evidence(proxies, rows),
    ]
    return Result({"plane": plane, "surroundings": surroundings}, numbers, warnings, terms)


def rectangle(
    ground: np.ndarray, objects: list[Standing], size: float, view: View, camera: Camera, environment: Raster,
    emitters: list[Emitter], params: knobs.Plane, warnings: list[str],
) -> tuple[np.ndarray, dict[str, Any]]:  # fmt: skip
    """Corners (4, 3) of what is modelled around the board and the feet (N, 3), and the figures that say why."""
    light = light_on(UP, environment.rgb(), emitters)
    if objects:
        ends, reaches = needed(objects, light, params.left_out, params.extent)
    else:
        ends, reaches = np.array([ground.min(0) - BARE * size, ground.max(0) + BARE * size]), np.zeros(0)
    corners, kept = modelled_rectangle(ground, ends, view)
    if kept < 1:
        warnings.append(
            f"plane: the margin of the rectangle is cut to {kept:.0%} towards the plate camera, as it reached behind it"
        )
    border, change = beyond(corners, objects, light)
    px = project(camera, camera_points(view.world_from_camera, border)[0])
    shown = np.isfinite(px).all(-1) & (px >= 0).all(-1) & (px <= (camera.width, camera.height)).all(-1)
    left = float(change[shown].max(initial=0.0))
    if left > 2 * params.left_out:
        warnings.append(
            f"plane: up to {left:.1%} of the light may change at the border of the rectangle within the frame, needed "
            f" {params.left_out:.1%}; raise plane.extent, or say with [[proxy]] where the surface ends"
        )
    return corners, {
        "margin_kept": kept, "reach_m": {thing.name: float(r) for thing, r in zip(objects, reaches)},
        "left_out_bound": left, "left_out_bound_anywhere": float(change.max(initial=0.0)),
    }  # fmt: skip


def beside(
    cloud: Reconstruction, corners: np.ndarray, uneven_m: float, objects: list[Standing], proxies: list[Proxy],
    environment: Raster, emitters: list[Emitter], camera: Camera, view: View, params: knobs.Plane,
) -> list[tuple[dict[str, Any], Proxy]]:  # fmt: skip
    """Flat surfaces of the cloud: what is known of each, whether it is modelled and why, and it as a proxy."""
    table = []
    for number, surface in enumerate(flat_surfaces(cloud, corners, uneven_m), 1):
        row = weighed(surface, objects, proxies, environment.rgb(), emitters, camera, view)
        if row["described"]:
            why = f"it is proxy {row['described']}"
        elif params.find_proxies == "never":
            why = "plane.find_proxies = never"
        elif row["change"] < params.left_out:
            why = f"less than plane.left_out, {params.left_out:.1%}"
        elif not row["seen_px"]:
            why = "the plate does not show it"
        else:
            why = ""
        wanted = not row["described"] and params.find_proxies == "always"
        name = f"found_{number}"
        row |= {"name": name, "modelled": wanted or not why, "because": "" if wanted else why}
        table.append((row, as_proxy(name, surface)))
    return table


def against_cloud(
    found: CloudPlane, covariance: np.ndarray, spots: dict[str, np.ndarray], camera: Camera, view: View,
    warnings: list[str],
) -> dict[str, Any]:  # fmt: skip
    """The surface that the cloud shows against the markers' plane: figures, and a warning where they differ.

    ``covariance`` (3, 3): of the markers' plane. At each spot (3,) the surface's height [m] and its cost [px].
    """
    heights = {name: found.height(spot) for name, spot in spots.items()}
    shifts = {}
    for name, spot in spots.items():
        ends = camera_points(view.world_from_camera, np.array([spot, spot + np.array([0, heights[name], 0])]))[0]
        shifts[name] = float(np.linalg.norm(np.diff(project(camera, ends), axis=0)))
    chi2 = found.chi2(covariance)
    if chi2 > AGREE_CHI2:
        worst = max(spots, key=lambda name: abs(heights[name]))
        normal = ", ".join(f"{value:.5f}" for value in found.normal)
        warnings.append(
            f"plane: the surface that further views show is {1000 * heights[worst]:+.2f} mm off the markers' plane "
            f"at {worst} ({shifts[worst]:.2f} px), its normal ({normal}), the markers' (0, 1, 0) (chi2 {chi2:.0f}, "
            f"expected below {AGREE_CHI2:.0f}): are markers flat, on thin paper? [[object]] lift_m corrects the height"
        )
    sigma = np.sqrt(np.diag(found.covariance))
    return {
        "points": found.points, "normal": found.normal.tolist(),
        "tilt_deg": float(np.degrees(np.hypot(*found.fit[:2]))),
        "offset_m": float(found.fit[2]), "offset_sigma_m": float(sigma[2]),
        "tilt_sigma_deg": float(np.degrees(np.hypot(*sigma[:2]))),
        "scatter_m": found.scatter_m, "uneven_m": found.uneven_m, "chi2": chi2, "agrees": chi2 <= AGREE_CHI2,
        "height_m": heights, "shift_px": shifts,
    }  # fmt: skip


def marker_rectangle(facts: dict[str, Any], camera_height_m: float) -> tuple[np.ndarray, float]:
    """Two opposite corners (2, 3) of the marker in the world, and the size that stands for an object's, metres.

    Without a board or a marker there are no corners (0, 3).
    """
    if facts.get("board"):
        board = facts["board"]
        x, z = np.array(board["squares"], float) * board["square_m"]
        margin = board.get("margin_m", 0.0)
        return np.array([[-margin, 0, -margin], [x + margin, 0, z + margin]]), float(min(x, z) / 2)
    if facts.get("marker"):
        half = facts["marker"][0]["side_m"] / 2
        return np.array([[-half, 0, -half], [half, 0, half]]), float(2 * half)
    return np.empty((0, 3)), 0.1 * camera_height_m


def elevation_deg(view: View, spots: list[np.ndarray]) -> float:
    """Lowest elevation [deg] of the plate camera above the plane, seen from points (3,) on it."""
    eye = view.world_from_camera[:3, 3]
    away = [float(np.linalg.norm((eye - spot)[[0, 2]])) for spot in spots]
    return float(np.degrees(min(np.arctan2(eye[1], distance) for distance in away)))


def edge_on(
    elevation: float, view: View, spots: list[np.ndarray], tilt_sigma: float, contact: dict[str, float]
) -> list[str]:
    """Refuse a plane seen edge-on, warn of one seen at a graze, with what that costs where the objects stand.

    A tilt error moves a foot along the line of sight by itself times distance over the sine of the elevation; in the
    picture little is seen of it (the contact uncertainty), in size and shadow it is.
    """
    text = (
        f"plate: the camera is {elevation:.1f} degrees above the plane where the objects stand, needed "
        f"{GRAZING_DEG:g}; photograph from higher up, or bring the objects nearer"
    )
    if elevation < EDGE_ON_DEG:
        raise CaptureError(text)
    if elevation >= GRAZING_DEG:
        return []
    eye = view.world_from_camera[:3, 3]
    along = max(float((eye - spot) @ (eye - spot)) / eye[1] for spot in spots) * tilt_sigma
    px = max(contact.values(), default=float("nan"))
    return [
        f"{text} (the tilt, known to {np.degrees(tilt_sigma):.2g} degrees, leaves a foot uncertain by "
        f"{1000 * along:.2g} mm along the line of sight and {px:.2g} px across the picture)"
    ]


def modelled_rectangle(ground: np.ndarray, ends: np.ndarray, view: View) -> tuple[np.ndarray, float]:
    """Corners (4, 3) that hold points (N, 3) and the ``ends`` (2, 3), all before the camera; the margin's share kept.

    Raises CaptureError when the points themselves reach behind the camera.
    """
    low, high = ground.min(0), ground.max(0)
    (x_low, _, z_low), (x_high, _, z_high) = low, high
    below, above = np.maximum(low - ends[0], 0), np.maximum(ends[1] - high, 0)

    def corners(share: float) -> np.ndarray:
        # Only the sides whose way outward leads towards the camera are drawn in.
        ahead = view.world_from_camera[[0, 2], 2]
        x_minus, z_minus = np.where(ahead > 0, share, 1.0) * below[[0, 2]]
        x_plus, z_plus = np.where(ahead < 0, share, 1.0) * above[[0, 2]]
        x0, x1, z0, z1 = x_low - x_minus, x_high + x_plus, z_low - z_minus, z_high + z_plus
        return np.array([[x0, 0, z1], [x1, 0, z1], [x1, 0, z0], [x0, 0, z0]])

    def nearest(points: np.ndarray) -> float:
        return float(camera_points(view.world_from_camera, points)[0][:, 2].min())

    limit = NEAREST_DEPTH * nearest(ground)
    if limit <= 0 or nearest(corners(0.0)) < limit:
        raise CaptureError(
            "plate: the rectangle around the marker and the objects reaches behind the camera, needed all before it; "
            "move the objects nearer to the marker or photograph the plate from farther away"
        )
    if nearest(corners(1.0)) >= limit:
        return corners(1.0), 1.0
    inside, outside = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if nearest(corners(middle)) >= limit else (inside, middle)
    return corners(inside), inside


def plane_covariance(view: View) -> np.ndarray:
    """(3, 3) of (tilt about x, tilt about z, offset at the origin): the pose's error seen as the plane's.

    A camera moved by (w, d) sees the plane turned by -w about the camera and shifted by -d; at the origin, ``-t`` from
    the camera, that lifts it by ``(w x t)_y - d_y``.
    """
    x, _, z = view.world_from_camera[:3, 3]
    by_pose = np.array([[-1.0, 0, 0, 0, 0, 0], [0, 0, -1.0, 0, 0, 0], [-z, 0, x, 0, -1.0, 0]])
    return by_pose @ view.covariance @ by_pose.T


def moved_by_height(
    height_m: float, spots: list[np.ndarray], view: View, camera: Camera, emitters: list[Emitter]
) -> float:
    """How far [px] contact and shadow are off at the nearest foot (3,) if the surface there lies higher or lower.

    A shadow moves by the height times the cotangent of its lamp's elevation; without lamps it stays below.
    """
    nearest = min(float(np.linalg.norm(view.world_from_camera[:3, 3] - spot)) for spot in spots)
    slopes = [float(np.hypot(*e.direction[[0, 2]]) / e.direction[1]) for e in emitters if e.direction[1] > 0]
    return camera.fx * height_m / nearest * max([1.0, *slopes])


def evidence(view: View, cloud: dict[str, Any] | None = None, uneven_px: float = 0.0) -> list[dict[str, Any]]:
    """The model ladder of the plane; ``cloud``: what further views show of it; ``uneven_px`` by its heights."""
    uneven = "no points off the board are measured"
    bound: dict[str, Any] = {"no_bound": uneven}
    if cloud is not None:
        bound = {"bound_px": uneven_px}
        uneven = (
            f"{cloud['points']} points scatter by {1000 * cloud['scatter_m']:.2f} mm about a plane that is "
            f"{cloud['tilt_deg']:.3f} deg and {1000 * cloud['offset_m']:+.2f} mm off the markers' "
            f"(chi2 {cloud['chi2']:.1f})"
        )
    return [
        {"term": "plane", "modelled": True, "because": f"defined by the pose ({view.route})", "could_cost": ""},
        {
            "term": "unevenness of the surface, paper thickness", "modelled": False,
            "because": uneven,
            "could_cost": "contact and shadow shift by the height error times the cotangent of the light's elevation",
            **bound,
        },
    ]  # fmt: skip


def extent_evidence(extent: dict[str, Any], left_out: float) -> dict[str, Any]:
    """Why the rectangle is as large as it is: at its end objects change the light by less than ``left_out``."""
    if not extent["reach_m"]:
        because = f"no objects: {BARE:g} marker sizes around it"
    else:
        reaches = ", ".join(f"{name} {reach:.2f} m" for name, reach in extent["reach_m"].items())
        because = "by bounding spheres under the map objects change the plane by more than knob plane.left_out = "
        because += f"{left_out:g} within {reaches}"
    return {
        "term": "plane beyond the rectangle", "modelled": False, "because": because,
        "could_cost": f"at most {extent['left_out_bound']:.2%} of the light at its border in the frame, more where a "
        f"concave object focuses light; of what upright faces see of the ground, {FAR_SEEN:.0%} comes from the map",
        "bound_rel": max(float(extent["left_out_bound"]), FAR_SEEN if extent["reach_m"] else 0.0),
    }  # fmt: skip


def beside_evidence(proxies: list[Proxy], surfaces: list[dict[str, Any]] | None) -> dict[str, Any]:
    """Which further surfaces there are, and why the others are not modelled."""
    term = {"term": "further surfaces, occluders"}
    stated = f"{len(proxies)} described" if proxies else "no geometry was given"
    missing = "shadows on them and their light on the objects are missing"
    if surfaces is None:
        row = {**term, "modelled": bool(proxies), "because": stated, "could_cost": "" if proxies else missing}
        return row if proxies else row | {"no_bound": "nothing tells what stands there"}
    rows = [
        f"{row['name']} ({1e4 * row['area_m2']:.0f} cm2, {row['distance_m']:.2f} m off, changed by {row['change']:.1%} "
        f"and at most {row['change_bound']:.0%}): {row['because'] or 'modelled'}"
        for row in surfaces
    ]
    found = "; ".join(rows) or "no flat surface stands out of the cloud"
    left = [row["change"] for row in surfaces if not row["modelled"] and not row["described"]]
    cost = f"changes of up to {max(left):.1%} on surfaces left out" if left else "backs and sides that no view shows"
    bound = {"bound_rel": float(max(left))} if left else {"no_bound": "nothing tells what no view shows"}
    modelled = bool(proxies) or any(row["modelled"] for row in surfaces)
    return {**term, "modelled": modelled, "because": f"{stated}; {found}", "could_cost": cost, **bound}


STAGE = Stage(
    "plane",
    compute,
    knobs.Plane,
    {
        "facts": FACTS, "wishes": WISHES, "camera": CAMERA, "views": VIEWS, "cloud": CLOUD,
        "environment": LIGHTING, "emitters": EMITTERS, "proxies": PROXIES,
    },
    {"plane": PLANE, "surroundings": SURROUNDINGS},
)  # fmt: skip
