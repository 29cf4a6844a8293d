"""Laws of the lens: inverse, derivatives, fold, agreement with OpenCV."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.camera import lens
from pipeline.camera.distortion import distort, distortion_jacobian, model_of, undistorted
from pipeline.run.errors import NumericalError
from pipeline.simulation.lens import Lens
from pipeline.types import Camera

BARREL = np.array([-0.28, 0.09, 1.2e-3, -8e-4, -0.012])
PINCUSHION = np.array([0.12, 0.03, -6e-4, 9e-4, 0.01])
RATIONAL = np.array([0.42, -0.11, 7e-4, -5e-4, 0.02, 0.71, 0.05, -0.01])
FISHEYE = np.array([0.031, -0.012, 0.004, -0.0015])


def camera_with(distortion: np.ndarray, width: int = 1024, height: int = 768) -> Camera:
    return Camera(width=width, height=height, fx=1100.0, fy=1093.0, cx=519.3, cy=377.1, distortion=distortion)


def pixels_of(camera: Camera, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.uniform(0, 1, (count, 2)) * (camera.width, camera.height)


@pytest.mark.parametrize("distortion", [np.zeros(5), BARREL, PINCUSHION, RATIONAL, FISHEYE, np.zeros(4)])
def test_unproject_inverts_project(distortion: np.ndarray) -> None:
    camera = camera_with(distortion)
    px = pixels_of(camera)
    rays = lens.pixel_rays(camera, px)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-14)
    assert np.abs(lens.project(camera, rays * 3.7) - px).max() < 1e-9  # rounding of ~1e3 px
    # The same ray stored in float32 moves by 6e-8 of 1100 px at most.
    assert np.abs(lens.project(camera, rays.astype(np.float32)) - px).max() < 3e-4


def test_rays_are_unproject_and_its_derivative() -> None:
    camera = camera_with(BARREL, 97, 61)
    rows, cols = np.mgrid[:61, :97]
    centre = np.stack([cols + 0.5, rows + 0.5], -1).reshape(-1, 2)
    xn, dxn = lens.rays_through(camera, centre)
    np.testing.assert_array_equal(xn, lens.unproject(camera, centre))
    step = 1e-3
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        numeric = (lens.unproject(camera, centre + shift) - lens.unproject(camera, centre - shift)) / (2 * step)
        # central difference: rounding 1e-16 / 1e-3 dominates
        np.testing.assert_allclose(dxn[..., axis], numeric, atol=1e-12)


def test_jitter_through_the_derivative_stays_on_the_pixel() -> None:
    camera = camera_with(BARREL)
    rows, cols = np.mgrid[: camera.height, : camera.width]
    centre = np.stack([cols + 0.5, rows + 0.5], -1).reshape(-1, 2)
    xn, dxn = lens.rays_through(camera, centre)
    jitter = np.array([0.5, -0.5])
    rays = np.concatenate([xn + dxn @ jitter, np.ones((len(xn), 1))], -1)
    assert (
        np.abs(lens.project(camera, rays) - centre - jitter).max() < 1e-3
    )  # second order: |f''| / 8 of strong barrel distortion


@pytest.mark.parametrize("distortion", [BARREL, RATIONAL, FISHEYE])
def test_jacobians_against_differences(distortion: np.ndarray) -> None:
    camera = camera_with(distortion)
    points = lens.pixel_rays(camera, pixels_of(camera, 50)) * 2.0
    px, by_point, by_lens = lens.project_jacobians(camera, points)
    np.testing.assert_allclose(px, lens.project(camera, points), atol=1e-10)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (lens.project(camera, points + step) - lens.project(camera, points - step)) / 2e-6
        np.testing.assert_allclose(by_point[:, :, axis], numeric, rtol=1e-6, atol=1e-5)
    values = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])

    def moved(vector: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy = vector[:4]
        other = Camera(width=1024, height=768, fx=fx, fy=fy, cx=cx, cy=cy, distortion=vector[4:])
        return lens.project(other, points)

    for column in range(len(values)):
        step = 1e-5 * np.eye(len(values))[column]
        numeric = (moved(values + step) - moved(values - step)) / 2e-5
        np.testing.assert_allclose(by_lens[:, :, column], numeric, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("distortion", [PINCUSHION, RATIONAL])
def test_agrees_with_opencv(distortion: np.ndarray) -> None:
    cv2 = pytest.importorskip("cv2")
    camera = camera_with(distortion)
    points = lens.pixel_rays(camera, pixels_of(camera, 200)) * 1.7
    K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(lens.project(camera, points), theirs + 0.5, atol=1e-8)


def test_behind_and_beyond_the_fold() -> None:
    barrel = np.array([-0.3, 0, 0, 0, 0])
    camera = camera_with(barrel)
    assert lens.fold_radius_squared(barrel) == pytest.approx(1 / 0.9)
    assert lens.fold_radius_squared(np.zeros(5)) == np.inf
    px = lens.project(camera, np.array([[0, 0, -1.0], [0, 0, 0], [2.0, 0, 1], [0.1, 0, 1]]))
    assert np.isnan(px[:3]).all()
    assert np.isfinite(px[3]).all()
    with pytest.raises(NumericalError, match="1 of 1 positions"):
        lens.unproject(camera, np.array([[4000.0, 400.0]]))


def wide(distortion: np.ndarray = FISHEYE) -> Camera:
    """140 degrees across: theta of the corner is 80 degrees."""
    return Camera(width=1024, height=768, fx=452.0, fy=450.0, cx=515.0, cy=380.0, distortion=distortion)


def test_a_fisheye_agrees_with_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    camera = wide()
    points = lens.pixel_rays(camera, pixels_of(camera, 200)) * 1.7
    assert np.degrees(np.arccos(points[:, 2] / 1.7)).max() > 75
    K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    theirs = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, FISHEYE)[0].reshape(-1, 2)
    np.testing.assert_allclose(lens.project(camera, points), theirs + 0.5, atol=1e-8)


@pytest.mark.parametrize("camera", [wide(), wide(RATIONAL)], ids=["fisheye", "rational"])
def test_a_wide_lens_round_trips_in_single_precision(camera: Camera) -> None:
    """Required: 0.01 px. A float32 ray turns by 6e-8 rad, and a pixel of these lenses is 2e-3 rad: 1e-4 px."""
    px = pixels_of(camera)
    xn, dxn = lens.rays_through(camera, px)
    rays = np.concatenate([xn, np.ones((len(xn), 1))], -1).astype(np.float32)
    assert np.abs(lens.project(camera, rays) - px).max() < 2e-3
    step = 1e-3
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        numeric = (lens.unproject(camera, px + shift) - lens.unproject(camera, px - shift)) / (2 * step)
        np.testing.assert_allclose(dxn[..., axis], numeric, rtol=1e-4, atol=1e-9)


def test_on_the_axis_a_fisheye_is_smooth() -> None:
    """Series and formula meet: at the radius where one takes over from the other both are alike to rounding."""
    near, far = np.array([[9.99e-4, 0.0]]), np.array([[1.001e-3, 0.0]])
    slope = (distort(FISHEYE, far) - distort(FISHEYE, near)) / 2e-6
    assert slope[0, 0] == pytest.approx(distortion_jacobian(FISHEYE, (near + far) / 2)[0, 0, 0], abs=1e-9)
    np.testing.assert_allclose(
        distortion_jacobian(FISHEYE, near), distortion_jacobian(FISHEYE, far), atol=1e-8
    )  # curvature times 2e-6
    assert np.array_equal(distort(FISHEYE, np.zeros((1, 2))), np.zeros((1, 2)))


def test_regions_end_where_the_curve_turns() -> None:
    pole = np.array([0.0, 0, 0, 0, 0, -0.25, 0, 0])  # 1 / (1 - s / 4): a pole at r = 2, growing until then
    assert lens.fold_radius_squared(pole) == pytest.approx(4.0)
    turning = np.array([-0.1, 0, 0, 0, 0, 0.1, 0, 0])
    r = np.linspace(0.01, 4, 40000)
    bent = distort(turning, np.stack([r, 0 * r], -1))[:, 0]
    assert np.sqrt(lens.fold_radius_squared(turning)) == pytest.approx(r[np.argmax(bent)], abs=2e-4)
    # a fisheye that folds at 1 / sqrt(3 * 0.2) = 1.29 rad, and one that is only bounded by the half sphere
    assert np.arctan(np.sqrt(lens.fold_radius_squared(np.array([-0.2, 0, 0, 0])))) == pytest.approx(1 / np.sqrt(0.6))
    assert np.degrees(np.arctan(np.sqrt(lens.fold_radius_squared(np.zeros(4))))) == pytest.approx(88.0)
    camera = wide(np.zeros(4)).model_copy(update={"fx": 350.0, "fy": 350.0})  # its corners look beyond 90 degrees
    y, x = np.mgrid[:768:8, :1024:8] + 0.5
    px = np.stack([x, y], -1).reshape(-1, 2)
    angle = np.hypot(*((px - (camera.cx, camera.cy)) / 350.0).T)
    _, inside = undistorted(camera.distortion, (px - (camera.cx, camera.cy)) / 350.0)
    assert np.array_equal(inside, angle < np.radians(88.0))
    with pytest.raises(NumericalError, match=f"{int((~inside).sum())} of {len(px)} positions"):
        lens.unproject(camera, px)
    with pytest.raises(NumericalError, match=r"6 coefficients .* needed one of 5 \(brown\)"):
        model_of(np.zeros(6))


@pytest.mark.parametrize("distortion", [BARREL, RATIONAL, FISHEYE], ids=["brown", "rational", "fisheye"])
def test_the_simulators_lens_is_the_same_lens(distortion: np.ndarray) -> None:
    """Two programs, one model: pixels agree to rounding, and rays in the single precision of a kernel to 1e-3 px."""
    dr = pytest.importorskip("drjit")
    camera = camera_with(distortion) if len(distortion) == 5 else wide(distortion)
    simulated = Lens(1024, 768, camera.fx, camera.fy, camera.cx, camera.cy, tuple(distortion))
    px = pixels_of(camera, 500)
    rays = lens.pixel_rays(camera, px)
    np.testing.assert_allclose(simulated.project(rays), px, atol=1e-8)
    x, y = simulated.ideal_from_pixel(*px.T)
    np.testing.assert_allclose(np.stack([x, y], -1), lens.unproject(camera, px), atol=1e-9)
    u, v = (dr.llvm.Float(values.astype(np.float32)) for values in px.T)
    traced = np.stack([np.array(values) for values in (*simulated.ideal_from_pixel(u, v), 0 * u + 1)], -1)
    assert np.abs(lens.project(camera, traced) - px).max() < 1e-3
