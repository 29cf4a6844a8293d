"""A plate that shows no board is registered to the tripod view that does: turn, covariance, and what is flagged."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import BOARD, charuco_print, looking_at, photograph

from pipeline.camera.lens import pixel_rays, project
from pipeline.camera.rigid import camera_points, difference, rotation_exp
from pipeline.camera.tripod_registration import motion_at, motion_said, registered, rest_of, scattered, turned
from pipeline.run.errors import NumericalError
from pipeline.types import Camera, Raster, Reconstruction, Result, View
from stages import knobs, pose

CAMERA = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1, distortion=np.array([-0.1, 0.02, 0, 0, 0]))
BOARD_FROM = looking_at(np.array([0.105, 0, 0.075]), 40, 10, 0.6)


def far_scene(seed: int):
    """Radiance of directions (N, 3): waves of 4 to 200 px, as rough as a wall or a lawn."""
    rng = np.random.default_rng(seed)
    waves = [(rng.normal(size=2) * rng.uniform(20, 140), rng.uniform(0, 6.3), 1 / (1 + 0.05 * i)) for i in range(30)]

    def radiance(directions: np.ndarray) -> np.ndarray:
        xy = directions[:, :2] / directions[:, 2:]
        return np.exp(0.2 * sum(size * np.sin(xy @ wave + phase) for wave, phase, size in waves))

    return radiance


def shot(scene, turn: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """(H, W): the far scene by a camera with ``p_here = exp(turn) p_plate``, 2 x 2 samples a pixel."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    total = 0.0
    for dx in (-0.25, 0.25):
        for dy in (-0.25, 0.25):
            px = np.stack([x + dx, y + dy], -1).reshape(-1, 2)
            total = total + scene(pixel_rays(CAMERA, px) @ rotation_exp(turn))
    picture = np.reshape(total, x.shape) / 4
    return picture * (1 + noise * np.random.default_rng(seed).normal(size=x.shape))


def with_ball(picture: np.ndarray) -> np.ndarray:
    """A ball of 60 px and its shadow."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    shaded = np.where((abs(x - 330) < 60) & (abs(y - 200) < 40), 0.5 * picture, picture)
    return np.where(np.hypot(x - 220, y - 180) < 60, 0.4 + 0.3 * np.sin(x / 9), shaded)


def on_board(picture: np.ndarray) -> np.ndarray:
    """The board lying before the scene."""
    board = photograph(charuco_print(BOARD), CAMERA, BOARD_FROM, 3)
    there = photograph(charuco_print(BOARD), CAMERA, BOARD_FROM, 3, black=1, white=1, table=0)
    return there * board + (1 - there) * picture


def posed(plate: np.ndarray, ball: np.ndarray) -> Result:
    """Stage pose on a plate and a ball from one tripod."""
    photographs = {
        name: Raster(dict.fromkeys("RGB", np.asarray(one, np.float32)), "acescg")
        for name, one in {"plate": plate, "ball": ball}.items()
    }
    facts = {"board": BOARD, "marker": [], "capture_root": ".", "ball": [{"name": "ball", "tripod": True}], "pose": []}
    return pose.compute(facts, photographs, CAMERA, {}, Reconstruction(), [], knobs.Pose())


def test_turn_and_its_covariance() -> None:
    """Tripods, still or knocked by up to a few px: 3 degrees of freedom, 99.9 % of each below 16.3.

    Of a still one nothing is interpolated, and what is stated is what it errs by: by the windows' scatter a turn across
    is known to 0.002 px here (2 % noise, 100 windows); chi2 of three lies above 0.2 by 99.9 %.
    """
    chi2, still, errors = [], [], []
    for seed in range(7):
        turn = np.random.default_rng(100 + seed).normal(size=3) * 0.0015 * (seed % 3)
        scene = far_scene(seed)
        plate, other = shot(scene, np.zeros(3), 0.02, seed), 1.3 * with_ball(shot(scene, turn, 0.02, seed + 50))
        found = registered(plate, other, CAMERA)
        error = found.rotation - turn
        chi2.append(float(error @ np.linalg.solve(found.covariance, error)))
        errors.append(np.abs(error[:2]).max() * CAMERA.fx)
        assert found.evidence["windows"] > 0.5 * found.evidence["textured"]
        if not seed % 3:
            still.append(chi2[-1])
            assert np.sqrt(np.diag(found.covariance)[:2]).max() * CAMERA.fx < 0.004
            assert np.sqrt(np.diag(found.rest_covariance)).max() < 0.02  # at a border of the frame
    assert max(chi2) < 16.3
    assert sum(still) > 0.95  # 0.1 % of nine degrees of freedom: 1.15
    assert max(errors) < 0.05  # px; measured below 0.02


def test_scatter_tells_the_covariance_whatever_the_weights_meant() -> None:
    """4000 lines through 40 points whose noise is 1 to 5 and whose weights know only half of it.

    Mean of the stated covariances over the covariance of the results; the latter is known to sqrt(2 / 4000) = 2.2 %,
    4 of which are allowed, and White's estimate is low by 1 / 40 of leverage (MacKinnon and White 1985).
    """
    rng = np.random.default_rng(0)
    design = np.stack([np.ones(40), np.linspace(-1, 1, 40)], -1)
    noise = np.linspace(1, 5, 40)
    weight = 1 / (noise**2 + 9)
    solve = np.linalg.solve(design.T @ (weight[:, None] * design), design.T * weight)
    results, stated = [], []
    for _ in range(4000):
        values = noise * rng.normal(size=40)
        results.append(solve @ values)
        stated.append(scattered(design[:, None], weight, (values - design @ results[-1])[:, None]))
    ratio = np.diag(np.mean(stated, 0)) / np.diag(np.cov(np.transpose(results)))
    assert np.all(np.abs(ratio - 1) < 4 * 0.022 + 1 / 40)


def test_nothing_in_common_is_refused() -> None:
    with pytest.raises(NumericalError, match=r"windows with texture agree .* show the board in the plate"):
        registered(shot(far_scene(1), np.zeros(3), 0, 0), shot(far_scene(2), np.zeros(3), 0, 0), CAMERA)
    with pytest.raises(NumericalError, match="0 of 0 windows"):
        registered(np.full((360, 480), 0.3), np.full((360, 480), 0.3), CAMERA)


@pytest.mark.parametrize("px", [0.0, 3.0])
def test_a_bare_plate_is_placed_by_the_tripod(px: float) -> None:
    turn = np.array([0.6, -0.8, 0.2]) * px / 640
    scene = far_scene(3)
    result = posed(shot(scene, np.zeros(3), 0.01, 2), on_board(shot(scene, turn, 0.01, 1)))
    views = result.outputs["views"]
    truth = BOARD_FROM.copy()
    truth[:3, :3] = truth[:3, :3] @ rotation_exp(turn)
    assert (views["plate"].route, views["ball"].route) == ("tripod", "charuco")
    off = difference(views["plate"].world_from_camera, truth)
    assert off @ np.linalg.solve(views["plate"].covariance, off) < 22.5  # 99.9 % of six
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1
    assert np.trace(views["plate"].covariance[:3, :3]) > np.trace(views["ball"].covariance[:3, :3])
    numbers = result.numbers["plate"]
    assert numbers["registered_to"] == "ball"
    assert numbers["registration"]["shift_px"] == pytest.approx(np.hypot(0.6, 0.8) * px, abs=0.15 * px + 0.05)
    spot = np.array([0.16, 0, 0.05])
    moved = motion_at(CAMERA, views["plate"], {"cup": spot})
    shown = [project(CAMERA, camera_points(at, spot[None])[0])[0] for at in (truth, BOARD_FROM)]
    assert abs(moved["cup"]["shift_px"] - np.linalg.norm(shown[0] - shown[1])) < 4 * moved["cup"]["sigma_px"] + 0.01
    assert moved["cup"]["sigma_px"] < 0.1
    assert rest_of(moved["cup"]) == 0  # a turn is all there was
    said = motion_said(views["plate"].motion.of, moved)
    assert [text.split(" turned by ")[0] for text in said] == (
        ["plate: between ball, which shows the board, and the plate the camera"] if px > 1 else []
    )


def test_what_a_turn_leaves_is_told_where_objects_stand() -> None:
    """The zoom was touched by 0.8 %: no turn undoes that, and it grows with the distance from the middle."""
    scene = far_scene(7)
    plate = shot(scene, np.zeros(3), 0.01, 1)
    other = shot(lambda rays: scene(rays * (1, 1, 1.008)), np.zeros(3), 0.01, 2)
    found = registered(plate, other, CAMERA)
    stood = looking_at(np.zeros(3), 30, 0, 0.6)
    view = View(world_from_camera=stood, covariance=1e-8 * np.eye(6), route="charuco", rms_px=0, points=24)
    px = np.array([[242.3, 178.1], [430.0, 320.0]])
    rays = pixel_rays(CAMERA, px) @ stood[:3, :3].T
    spots = dict(zip(("middle", "corner"), stood[:3, 3] - rays * (stood[1, 3] / rays[:, 1:2]), strict=True))
    moved = motion_at(CAMERA, turned(view, found, "ball"), spots)
    # where the other photograph shows the same ray; the affine field is that of a lens without its bend to 0.02 px
    true = np.linalg.norm(px[1] - px[0]) * 0.008
    assert moved["corner"]["rest_px"] == pytest.approx(true, abs=4 * moved["corner"]["rest_sigma_px"] + 0.05)
    assert rest_of(moved["middle"]) < 0.2
    said = motion_said("ball", moved)
    assert len(said) == 1
    assert "off a turn at corner, needed below 1 px: tripod or lens was pushed after ball" in said[0]


@pytest.mark.parametrize("px", [0.0, 3.0])
def test_a_ball_that_hides_the_board_is_checked_by_the_picture(px: float) -> None:
    """The plate shows the board, the ball's photograph does not: what else both show says whether the tripod stayed."""
    turn = np.array([0.6, -0.8, 0.2]) * px / 640
    scene = far_scene(3)
    result = posed(on_board(shot(scene, np.zeros(3), 0.01, 1)), with_ball(shot(scene, turn, 0.01, 2)))
    plate_view, ball_view = result.outputs["views"]["plate"], result.outputs["views"]["ball"]
    assert plate_view.route == "charuco"
    assert ball_view.route == ("tripod" if px else "same_as")
    truth = plate_view.world_from_camera.copy()
    truth[:3, :3] = truth[:3, :3] @ rotation_exp(turn).T
    off = difference(ball_view.world_from_camera, truth)[:3]
    assert np.linalg.norm(off) * CAMERA.fx < 0.1  # px; the registration is good to 0.02 across, worse about the axis
    assert len([text for text in result.warnings if "the picture shifted by" in text]) == (px > 0)
    assert result.numbers["ball"]["registration"]["shift_px"] == pytest.approx(px, abs=0.15 * px + 0.05)
