"""The plane stage: covariance against perturbed cameras, the rectangle, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import BOARD, looking_at

from pipeline.camera.lens import project
from pipeline.camera.resection import refine
from pipeline.camera.rigid import camera_points, perturb
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.types import Camera, View
from stages import knobs, plane

CAMERA = Camera(width=640, height=480, fx=700, fy=700, cx=320, cy=240)
CENTRE = np.array([0.105, 0, 0.075])
POSE = looking_at(CENTRE, 45, 15, 0.6)
FACTS = {"board": {**BOARD, "margin_m": 0.01}, "marker": None}
COVARIANCE = np.diag([1e-3, 2e-3, 1.5e-3, 5e-4, 6e-4, 7e-4]) ** 2


def view_of(pose: np.ndarray, **changes) -> View:
    return View(
        **{"world_from_camera": pose, "covariance": COVARIANCE, "route": "charuco", "rms_px": 0.1, "points": 24}
        | changes
    )


def run(pose: np.ndarray = POSE, objects: list | None = None, **params):
    wishes = {"object": [{"name": f"thing{i}", "position_m": p} for i, p in enumerate(objects or [])]}
    return plane.compute(FACTS, wishes, CAMERA, {"plate": view_of(pose)}, knobs.Plane(**params))


def test_plane_is_the_board_and_faces_up() -> None:
    made = run(objects=[(0.3, 0.05)]).outputs["plane"]
    np.testing.assert_array_equal(made.normal, [0, 1, 0])
    assert made.offset_m == 0
    edges = np.roll(made.corners_m, -1, 0) - made.corners_m
    turns = np.cross(edges, np.roll(edges, -1, 0))
    assert (turns[:, 1] > 0).all()  # counter-clockwise seen from above
    assert not made.corners_m[:, 1].any()


def test_rectangle_covers_board_and_objects_with_the_margin() -> None:
    result = run(looking_at(CENTRE, 45, 15, 3.0), objects=[(0.4, -0.1), (0.1, 0.3)])
    x0, z0, x1, z1 = result.numbers["rectangle_m"]
    margin = 8 * 0.075  # half of the board's shorter side times the default extent
    np.testing.assert_allclose([x0, z0, x1, z1], [-0.01 - margin, -0.1 - margin, 0.4 + margin, 0.3 + margin])
    assert run(extent=2).numbers["rectangle_m"][0] == pytest.approx(-0.01 - 0.15)


def test_rectangle_ends_before_the_camera() -> None:
    grazing = looking_at(CENTRE, 80, 0, 0.3)
    result = run(grazing)
    corners = result.outputs["plane"].corners_m
    assert (camera_points(grazing, corners)[0][:, 2] > 0).all()
    assert 0 < result.numbers["margin_kept"] < 1
    assert "reached behind it" in result.warnings[0]
    far_side = 0.075 * 8 + 0.01  # where the camera looks, towards -z, nothing is cut
    assert result.numbers["rectangle_m"][1] == pytest.approx(-far_side)


def test_covariance_is_what_a_moved_camera_sees() -> None:
    """Sampled: the plane through three world points, carried by the camera's error."""
    rng = np.random.default_rng(0)
    points = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0, 0.3]])
    found = []
    for delta in rng.multivariate_normal(np.zeros(6), COVARIANCE, 4000):
        # What the camera sees stays; the believed camera moves: the plane moves by truth * moved^-1.
        seen = camera_points(perturb(POSE, delta), points)[0]
        believed = seen @ POSE[:3, :3].T + POSE[:3, 3]
        normal = np.cross(believed[2] - believed[0], believed[1] - believed[0])
        normal /= np.linalg.norm(normal)
        found.append([normal[2], -normal[0], normal @ believed[0]])  # a tilt w turns +Y into (-w_z, 1, w_x)
    # 4000 samples: a variance has 2.2 % standard error; correlations of 1.6 %
    np.testing.assert_allclose(
        np.cov(np.array(found).T), plane.plane_covariance(view_of(POSE)), rtol=0.1, atol=0.06 * 1.5e-3 * 1e-3
    )


def test_contact_agrees_with_re_estimated_poses() -> None:
    """Noise of corners and of the lens, pose estimated anew each time: the spread of a far foot, in px."""
    rng = np.random.default_rng(1)
    x, z = np.meshgrid(np.arange(1, 7) * 0.03, np.arange(1, 5) * 0.03)
    points = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], -1)
    exact = project(CAMERA, camera_points(POSE, points)[0])
    lens_covariance = np.zeros((9, 9))
    lens_covariance[:4, :4] = np.diag([3.0, 3.0, 2.0, 2.0]) ** 2
    foot = np.array([0.35, 0, 0.2])
    spread = []
    for _ in range(400):
        error = rng.multivariate_normal(np.zeros(4), lens_covariance[:4, :4])
        camera = CAMERA.model_copy(
            update=dict(zip(("fx", "fy", "cx", "cy"), error + np.array([700, 700, 320, 240]), strict=True))
        )
        camera = camera.model_copy(update={"covariance": lens_covariance})
        fit = refine(camera, POSE, points, exact + 0.1 * rng.normal(size=exact.shape), 0.1)
        spread.append(project(camera, camera_points(fit.world_from_camera, foot[None])[0])[0])
    largest = np.sqrt(np.linalg.eigvalsh(np.cov(np.array(spread).T))[-1])
    stated_camera = CAMERA.model_copy(update={"covariance": lens_covariance})
    fit = refine(stated_camera, POSE, points, exact, 0.1)
    view = view_of(POSE, covariance=fit.covariance, lens_covariance=fit.lens_covariance)
    # 400 samples: a standard deviation has 3.5 % standard error
    assert plane.contact_sigma(stated_camera, view, foot) == pytest.approx(largest, rel=0.12)
    without = view_of(POSE, covariance=fit.covariance)
    assert plane.contact_sigma(stated_camera, without, foot) > 2 * largest  # the correlation matters


@pytest.mark.parametrize(("tilt", "outcome"), [(80, "fine"), (87, "warned"), (89.5, "refused")])
def test_a_plane_seen_edge_on(tilt: float, outcome: str) -> None:
    grazing = looking_at(CENTRE, tilt, 15, 2.0)
    if outcome == "refused":
        with pytest.raises(CaptureError, match=r"0\.5 degrees above the plane"):
            run(grazing, objects=[(CENTRE[0], CENTRE[2])])
        return
    result = run(grazing, objects=[(CENTRE[0], CENTRE[2])])
    assert result.numbers["elevation_deg"] == pytest.approx(90 - tilt)
    assert any("degrees above the plane" in text for text in result.warnings) == (outcome == "warned")


def test_refusals() -> None:
    below = POSE.copy()
    below[1, 3] = -0.4
    with pytest.raises(CaptureError, match="below the marker's plane"):
        run(below)
    with pytest.raises(ManifestError) as error:
        run(objects=[(0.3, 0.05), tuple(POSE[[0, 2], 3] * 20), (-500.0, 0.0)])
    assert len(error.value.problems) == 2
    assert "thing1" in error.value.problems[0]
    assert "behind the plate camera" in error.value.problems[0]
    assert any("outside the plate" in text for text in run(objects=[(0.6, 0.1)]).warnings)


def test_marker_and_bare_worlds() -> None:
    params, views = knobs.Plane(), {"plate": view_of(looking_at(np.zeros(3), 40, 0, 2.0))}
    marked = plane.compute({"board": None, "marker": [{"side_m": 0.1}]}, {"object": []}, CAMERA, views, params)
    np.testing.assert_allclose(marked.numbers["rectangle_m"], [-0.85, -0.85, 0.85, 0.85])
    bare = plane.compute({"board": None, "marker": None}, {"object": []}, CAMERA, views, params)
    assert bare.numbers["rectangle_m"][2] == pytest.approx(8 * 0.1 * 2.0 * np.cos(np.radians(40)))


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scale_of_the_world_does_not_matter(scale: float) -> None:
    moved = POSE.copy()
    moved[:3, 3] *= scale
    facts = {"board": {**FACTS["board"], "square_m": 0.03 * scale, "margin_m": 0.01 * scale}, "marker": None}
    result = plane.compute(facts, {"object": []}, CAMERA, {"plate": view_of(moved)}, knobs.Plane())
    np.testing.assert_allclose(result.numbers["rectangle_m"], np.array(run().numbers["rectangle_m"]) * scale)
