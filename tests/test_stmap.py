"""STMaps: their convention, their round trip, and that they are the lens that render and composite use."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from test_transport import looking_down

from pipeline.camera import lens
from pipeline.camera.stmap import NOWHERE, pixels_of_st, round_trip_px, st_of_pixels, stmaps
from pipeline.conventions import invert_rigid, transform_points
from pipeline.run.errors import NumericalError
from pipeline.run.formats import read_exr
from pipeline.transport.scene import build_worlds
from pipeline.transport.trace import LensRays, reference_block, trace
from pipeline.types import Camera, Plane
from stages.stmap import stmap

LENSES = {
    "straight": np.zeros(5),
    "barrel": np.array([-0.28, 0.09, 1.2e-3, -8e-4, -0.012]),
    "pincushion": np.array([0.12, 0.03, -6e-4, 9e-4, 0.01]),
    "moustache": np.array([-0.22, 0.31, 0, 0, -0.08]),
}


def camera_with(distortion: np.ndarray) -> Camera:
    return Camera(width=512, height=384, fx=520.0, fy=517.0, cx=259.3, cy=187.1, distortion=distortion)


@pytest.mark.parametrize("name", LENSES)
def test_maps_give_each_other_back(name: str) -> None:
    """The issue's figure is 0.01 px. Measured: 3e-5 px (float32 of 0..1 on 800 px) to 6e-4 px (bilinear, barrel)."""
    camera = camera_with(LENSES[name])
    maps = stmaps(camera)
    assert maps.undistort.dtype == maps.distort.dtype == np.float32
    assert maps.undistort.shape == (maps.straight.height, maps.straight.width, 2)
    assert maps.distort.shape == (384, 512, 2)
    assert round_trip_px(maps, camera).max() < 0.002
    # Overscan: every pixel of the plate looks inside the straight picture, which is no larger than that asks for.
    px = pixels_of_st(maps.distort, maps.straight)
    low, high = px.min((0, 1)), px.max((0, 1))
    size = np.array([maps.straight.width, maps.straight.height])
    assert (low > 0.5).all()
    assert (high < size - 0.5).all()
    assert (low < 6).all()  # margin 1, half a pixel to the edge stretched by at most 3, rounding 1
    assert (high > size - 6).all()


def test_a_straight_lens_has_straight_maps() -> None:
    """R = (x + 0.5) / W, and G counts from the bottom; the frame is the plate's and one pixel around."""
    camera = camera_with(np.zeros(5))
    maps = stmaps(camera)
    assert maps.offset == (1, 1)
    assert (maps.straight.width, maps.straight.height) == (514, 386)
    columns, rows = np.arange(512), np.arange(384)
    inner = maps.undistort[1:-1, 1:-1]
    np.testing.assert_allclose(inner[0, :, 0], (columns + 0.5) / 512, atol=1e-7)
    np.testing.assert_allclose(inner[:, 0, 1], (383 - rows + 0.5) / 384, atol=1e-7)


def test_the_maps_are_the_lens_of_render() -> None:
    """One world point, three ways: projection, the ray that render sends through that pixel, and both maps."""
    camera = camera_with(LENSES["barrel"])
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.sign(np.linalg.det(turn)), (0.3, 0.8, -0.2)
    maps = stmaps(camera)
    rows, columns = np.array([3, 200, 380]), np.array([5, 256, 505])
    centre = np.stack([columns, rows], -1) + 0.5
    rays = LensRays(camera, pose)[rows * camera.width + columns]  # what render traces, of difference and reference
    points = rays.origin + 1.7 * rays.centre
    inverse = np.linalg.inv(pose)
    # rounding: 1e-16 relative of 1000 px, through two 4x4 matrices
    np.testing.assert_allclose(lens.project(camera, transform_points(inverse, points)), centre, atol=1e-9)
    straight = lens.project(maps.straight, transform_points(inverse, points))
    looked = pixels_of_st(maps.distort[rows, columns], maps.straight)
    np.testing.assert_allclose(looked, straight, atol=1e-4)  # float32: 6e-8 of 700 px
    # A point at a pixel of the straight picture is where the undistort map says, in the plate.
    at = np.floor(straight).astype(int)
    xy = lens.unproject(maps.straight, at + 0.5)
    plate = lens.project(camera, np.concatenate([xy, np.ones((3, 1))], -1))
    np.testing.assert_allclose(pixels_of_st(maps.undistort[at[:, 1], at[:, 0]], camera), plate, atol=1e-4)


def rendered(camera: Camera, spots: np.ndarray) -> np.ndarray:
    """(H, W) of a dark plane with a bright spot round each of ``spots`` (N, 2) x, z, as render's rays see it."""
    side, half = 480, 0.3
    at = (np.arange(side) + 0.5) / side * 2 * half - half
    x, z = np.meshgrid(at, -at)  # the texture's first row lies on the edge from corner 0 to corner 1: +z
    texture = 0.05 + 0.8 * sum(np.exp(-((x - sx) ** 2 + (z - sz) ** 2) / (2 * 0.012**2)) for sx, sz in spots)
    corners = np.array([[-half, 0, half], [half, 0, half], [half, 0, -half], [-half, 0, -half]])
    plane = Plane(normal=[0, 1, 0], offset_m=0.0, covariance=np.zeros((3, 3)), corners_m=corners, source="test")
    worlds = build_worlds(plane, np.repeat(texture[..., None], 3, -1), np.ones((16, 32, 3)), {})
    rays = LensRays(camera, looking_down())[np.arange(camera.width * camera.height)]
    return trace(reference_block, worlds, rays, 16, 2, 0).without.mean(1).reshape(camera.height, camera.width)


def centroid(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Of what is brighter than the plane within 6 px of ``near`` (x, y)."""
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    weight = np.where(np.hypot(x - near[0], y - near[1]) < 6, np.maximum(picture - 0.06, 0), 0)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def test_a_straight_render_distorted_lies_on_the_direct_one() -> None:
    """Spots on the plane: rendered through the lens as insitu does, and through the pinhole and the distort map.

    Composite knows no lens: its layers have the plate's pixels. Spots have a sigma of 2 px, so noise and bilinear
    filtering move a centroid by less than 0.03 px (measured 0.02); without the map they differ by up to 2.3 px.
    """
    camera = Camera(width=128, height=96, fx=130, fy=129, cx=66.2, cy=46.5, distortion=LENSES["barrel"])
    maps = stmaps(camera)
    spots = np.array([[0.0, 0.0], [0.24, 0.14], [-0.24, 0.14], [0.22, -0.16]])
    direct, straight = rendered(camera, spots), rendered(maps.straight, spots)
    at = pixels_of_st(maps.distort, maps.straight) - 0.5
    warped = map_coordinates(straight, [at[..., 1], at[..., 0]], order=1)
    world = np.stack([spots[:, 0], 0 * spots[:, 0], spots[:, 1]], -1)
    expected = lens.project(camera, transform_points(invert_rigid(looking_down()), world))
    assert np.isfinite(expected).all()
    found = np.array([[centroid(picture, px) for px in expected] for picture in (direct, warped)])
    assert np.abs(found[0] - found[1]).max() < 0.05
    assert np.abs(found - expected).max() < 0.1  # measured 0.07, all down: nearer parts of a spot are larger


def test_files(tmp_path: Path) -> None:
    camera = camera_with(LENSES["moustache"])
    said: list[str] = []
    numbers = stmap({"plate": camera}, tmp_path, said.append)
    assert numbers["plate"]["round_trip_px"] < 0.01
    assert "round trip" in said[0]
    found = read_exr(tmp_path / "plate_distort.exr")
    np.testing.assert_array_equal(found["R"], stmaps(camera).distort[..., 0])
    assert read_exr(tmp_path / "plate_undistort.exr").shape == tuple(numbers["plate"]["straight_px"][::-1])
    straight = json.loads((tmp_path / "plate_straight.json").read_text())
    assert straight["fx"] == camera.fx
    assert straight["cx"] == camera.cx + straight["plate_offset_px"][0]


def test_where_the_model_ends() -> None:
    """What the lens does not image points nowhere; a fold inside the plate, or a fisheye, is refused in one line."""
    barrel = Camera(width=400, height=300, fx=265.0, fy=265.0, cx=200.0, cy=150.0, distortion=[-0.16, 0, 0, 0, 0])
    assert round_trip_px(stmaps(barrel), barrel).max() < 0.01  # its corners are at 0.98 of the fold
    outside = lens.project(barrel, np.array([[1.4, 0.7, 1.0], [0.1, 0.1, 1.0]]))
    assert (st_of_pixels(outside, barrel)[0] == NOWHERE).all()
    np.testing.assert_allclose(pixels_of_st(st_of_pixels(outside, barrel), barrel)[1], outside[1], atol=1e-12)
    with pytest.raises(NumericalError, match="beyond the distortion model"):
        stmaps(barrel.model_copy(update={"distortion": np.array([-0.2, 0, 0, 0, 0])}))
    # 130 degrees and more: what fits its middle folds before the corners.
    wide = Camera(width=400, height=300, fx=100.0, fy=100.0, cx=200.0, cy=150.0, distortion=[-0.08, 0.0022, 0, 0, 0])
    with pytest.raises(NumericalError, match=r"beyond the distortion model|at most 3 times"):
        stmaps(wide)


@pytest.mark.parametrize(
    "distortion", [[0.42, -0.11, 7e-4, -5e-4, 0.02, 0.71, 0.05, -0.01], [0.031, -0.012, 0.004, -0.0015]],
    ids=["rational", "fisheye"],
)  # fmt: skip
def test_maps_of_wide_lenses_come_back(distortion: list[float]) -> None:
    """Float32 maps read as a warp does: required 0.01 px, measured 0.0007. 107 degrees from corner to corner."""
    size = 4 + len(distortion)
    camera = Camera(
        width=320, height=240, fx=215.0, fy=214.0, cx=161.0, cy=119.0, distortion=np.array(distortion),
        covariance=np.zeros((size, size)),
    )  # fmt: skip
    off = round_trip_px(stmaps(camera), camera)
    assert np.isfinite(off).all()
    assert off.max() < 0.01
