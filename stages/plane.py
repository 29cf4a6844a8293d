"""The local scene's plane, the rectangle of it that is modelled, and how surely objects stand on the spot.

The markers define the world, so the plane is ``y = 0`` exactly; what is uncertain is where the camera stands to it.
Covariance: the plate's pose covariance turned into the plane's tilt and offset as seen from the camera. Contact: pose
and lens covariance, with their correlation, projected to pixels at the foot of each object. Rectangle: the board and
every object with ``extent`` object sizes around; half the board's shorter side (a marker's side, without either a tenth
of the camera's height) stands for the size of an object, as meshes are not read here. What lies behind the plate camera
is cut off. Where further views were adjusted with the markers, a plane is fitted to their cloud (robust, weighted) and
its agreement with the markers' is tested; the markers' plane stays the world's. Limits: one flat surface; objects much
larger than the board need a larger ``extent``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.cloud_plane import AGREE_CHI2, CloudPlane, plane_of_cloud
from pipeline.camera.lens import project, project_jacobians
from pipeline.camera.rigid import camera_points
from pipeline.run.artifacts import CAMERA, CLOUD, FACTS, PLANE, VIEWS, WISHES
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.run.stage import Stage
from pipeline.types import Camera, Plane, Reconstruction, Result, View
from stages import knobs

EDGE_ON_DEG, GRAZING_DEG = 1.0, 5.0  # elevation of the camera over the plane, seen from a foot: refused, warned of
NEAREST_DEPTH = (
    0.1  # of the depth of the nearest thing that stands: the rectangle ends there, before the camera's plane
)
FAR_OUTSIDE = 2.0  # frame diagonals beyond the frame, where not even a shadow returns
BISECTIONS = 50  # to rounding


def compute(
    facts: dict[str, Any], wishes: dict[str, Any], camera: Camera, views: dict[str, View], cloud: Reconstruction,
    params: knobs.Plane,
) -> Result:  # fmt: skip
    """Plane ``y = 0`` of the world with covariance, the modelled rectangle, and the contact uncertainty in pixels."""
    view = views["plate"]
    height = float(view.world_from_camera[1, 3])
    if not height > 0:
        raise CaptureError(
            f"plate: the camera is {-height:.3g} m below the marker's plane, needed above; is the board described as "
            "printed (legacy, squares), or a given pose in the wrong frame?"
        )
    feet = {
        wish["name"]: np.array([wish["position_m"][0], 0.0, wish["position_m"][1]]) for wish in wishes.get("object", [])
    }
    warnings = check_feet(feet, camera, view)
    marked, size = marker_rectangle(facts, height)
    ground = np.array([*marked, *feet.values()]) if feet or len(marked) else np.zeros((1, 3))
    corners, kept = modelled_rectangle(ground, params.extent * size, view)
    if kept < 1:
        warnings.append(
            f"plane: the margin of the rectangle is cut to {kept:.0%} towards the plate camera, as it reached behind it"
        )
    spots = feet or {"marker": ground.mean(0)}
    elevation = elevation_deg(view, list(spots.values()))
    warnings += edge_on(elevation)
    contact = {name: sigma for name, spot in spots.items() if np.isfinite(sigma := contact_sigma(camera, view, spot))}
    covariance = plane_covariance(view)
    plane = Plane(
        normal=np.array([0.0, 1.0, 0.0]), offset_m=0.0, covariance=covariance, corners_m=corners, source=view.route,
        contact_sigma_px=max(contact.values(), default=0.0),
    )  # fmt: skip
    deviations = np.sqrt(np.diag(covariance))
    numbers = {
        "normal_sigma_deg": float(np.degrees(np.hypot(deviations[0], deviations[1]))),
        "offset_sigma_m": float(deviations[2]),
        "contact_sigma_px": contact, "camera_height_m": height, "elevation_deg": elevation,
        "object_size_assumed_m": size,
        "rectangle_m": [float(corners[:, 0].min()), float(corners[:, 2].min()),
                        float(corners[:, 0].max()), float(corners[:, 2].max())],
        "margin_kept": kept,
    }  # fmt: skip
    found = plane_of_cloud(cloud, height, corners) if len(cloud.points) else None
    shown = None
    if found is not None:
        numbers["cloud"] = shown = against_cloud(found, covariance, spots, camera, view, warnings)
    return Result({"plane": plane}, numbers, warnings, evidence(view, shown))


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
        warnings.append(
            f"plane: the surface that further views show is {1000 * heights[worst]:+.2f} mm off the markers' plane "
            f"at {worst} ({shifts[worst]:.2f} px; chi2 {chi2:.0f}, expected below {AGREE_CHI2:.0f}): are markers "
            "flat, on thin paper? [[object]] lift_m corrects the height"
        )
    sigma = np.sqrt(np.diag(found.covariance))
    return {
        "points": found.points, "tilt_deg": float(np.degrees(np.hypot(*found.fit[:2]))),
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


def check_feet(feet: dict[str, np.ndarray], camera: Camera, view: View) -> list[str]:
    """Refuse objects that the plate cannot show; warn about feet outside the frame."""
    problems, warnings = [], []
    frame = np.array([camera.width, camera.height])
    for name, foot in feet.items():
        x, y, z = camera_points(view.world_from_camera, foot[None])[0][0]
        where = f"object {name}: position_m is ({foot[0]:g}, {foot[2]:g})"
        if z <= 0:
            problems.append(f"{where}, which is behind the plate camera; expected a place in front of it")
            continue
        px = np.array(
            [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]
        )  # without the lens's bend: far out
        outside = float(np.linalg.norm(np.maximum(np.maximum(-px, px - frame), 0)))
        if outside > FAR_OUTSIDE * np.hypot(*frame):
            problems.append(f"{where}, {outside:.0f} px outside the plate; expected a place that it shows, or near it")
        elif outside > 0:
            warnings.append(f"{where}: its foot is {outside:.0f} px outside the plate")
    if problems:
        raise ManifestError(*problems)
    return warnings


def elevation_deg(view: View, spots: list[np.ndarray]) -> float:
    """Lowest elevation [deg] of the plate camera above the plane, seen from points (3,) on it."""
    eye = view.world_from_camera[:3, 3]
    away = [float(np.linalg.norm((eye - spot)[[0, 2]])) for spot in spots]
    return float(np.degrees(min(np.arctan2(eye[1], distance) for distance in away)))


def edge_on(elevation: float) -> list[str]:
    """Refuse a plane seen edge-on, warn of one seen at a graze: an error of its tilt moves feet by its cotangent."""
    text = (
        f"plate: the camera is {elevation:.1f} degrees above the plane where the objects stand, needed "
        f"{GRAZING_DEG:g}; photograph from higher up, or bring the objects nearer"
    )
    if elevation < EDGE_ON_DEG:
        raise CaptureError(text)
    return [text] if elevation < GRAZING_DEG else []


def modelled_rectangle(ground: np.ndarray, margin_m: float, view: View) -> tuple[np.ndarray, float]:
    """Corners (4, 3) around points (N, 3) with a margin that ends before the camera; and the margin's share kept."""
    (x_low, _, z_low), (x_high, _, z_high) = ground.min(0), ground.max(0)

    def corners(share: float) -> np.ndarray:
        # Only the sides whose way outward leads towards the camera are drawn in.
        x_minus, z_minus = np.where(view.world_from_camera[[0, 2], 2] > 0, share, 1.0) * margin_m
        x_plus, z_plus = np.where(view.world_from_camera[[0, 2], 2] < 0, share, 1.0) * margin_m
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


def contact_sigma(camera: Camera, view: View, spot: np.ndarray) -> float:
    """Largest standard uncertainty, px, of where a point (3,) of the world appears in the plate; NaN outside the lens.

    Pose and lens were estimated together: a lens error is mostly undone by the pose, which their correlation carries.
    """
    point, by_pose = camera_points(view.world_from_camera, spot[None])
    _, by_point, by_lens = project_jacobians(camera, point)
    if not np.isfinite(by_point).all():
        return float("nan")
    pose, lens = by_point[0] @ by_pose[0], by_lens[0]
    covariance = pose @ view.covariance @ pose.T
    if view.lens_covariance is not None:
        cross = pose @ view.lens_covariance @ lens.T
        covariance = covariance + cross + cross.T + lens @ camera.covariance @ lens.T
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def evidence(view: View, cloud: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """The model ladder of the plane; ``cloud``: figures of what further views show of it."""
    uneven = "no points off the board are measured"
    if cloud is not None:
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
        },
        {
            "term": "further surfaces, occluders", "modelled": False, "because": "no geometry was given",
            "could_cost": "shadows on them and their light on the objects are missing",
        },
    ]  # fmt: skip


STAGE = Stage(
    "plane",
    compute,
    knobs.Plane,
    {"facts": FACTS, "wishes": WISHES, "camera": CAMERA, "views": VIEWS, "cloud": CLOUD},
    {"plane": PLANE},
)
