"""Joint adjustment of cloud and markers: truth found, regions that hold it, better than a similarity alone."""

from __future__ import annotations

import numpy as np
import pytest
from joint_world import CAMERA, CORNER_PX, CORNERS, TRACK_PX, noisy, world

from pipeline.camera.adjustment import free_columns
from pipeline.camera.bundle import Adjusted, adjust
from pipeline.camera.reprojection import Bundle
from pipeline.camera.rigid import difference, umeyama
from pipeline.conventions import transform_points
from pipeline.run.errors import NumericalError


def test_exact_data_give_the_truth() -> None:
    rng = np.random.default_rng(1)
    truth = world(rng)
    start = noisy(truth, rng, 0.0)
    start = Bundle(**{**vars(start), "px": truth.px, "corners": truth.corners})
    found = adjust(start, corner_sigma_px=0.1)
    for pose, true in zip(found.bundle.poses, truth.poses, strict=True):
        assert np.abs(difference(pose, true)).max() < 1e-6  # Newton's last step; the data are float64
    assert np.abs(difference(found.bundle.markers[1], truth.markers[1])).max() < 1e-6


def pooled(trials: int) -> tuple[np.ndarray, np.ndarray, list[Adjusted]]:
    """Errors (trials, 6) of the view that shows no marker, their chi-square, the adjustments."""
    errors, chi2, done = [], [], []
    for seed in range(trials):
        rng = np.random.default_rng(100 + seed)
        truth = world(rng, views=8, points=160)
        found = adjust(noisy(truth, rng))
        errors.append(difference(found.bundle.poses[0], truth.poses[0]))
        chi2.append(errors[-1] @ np.linalg.solve(found.pose_covariance[0], errors[-1]))
        done.append(found)
    return np.array(errors), np.array(chi2), done


def test_regions_hold_the_truth_and_noise_is_found() -> None:
    _, chi2, done = pooled(24)
    inside = float((chi2 < 12.59).mean())  # 95 % of chi-square with 6 degrees
    assert inside >= 0.79, chi2  # binomial: 24 trials at 95 % give fewer than 19 once in 1600
    assert 4.0 < np.mean(chi2) < 9.0  # 6 expected, its standard error 0.7; Huber widens by 5 %
    assert np.median([one.track_sigma_px for one in done]) == pytest.approx(TRACK_PX, rel=0.1)
    # 79 of 112 coordinates are spare: 8 % each, 2 % for the median of 24. With 100 spare, as if tracks alone held the
    # views, it was 11 % low, and of 240 regions 89 % held the truth; now 92 %.
    assert np.median([one.corner_sigma_px for one in done]) == pytest.approx(CORNER_PX, rel=0.06)


def test_beats_a_similarity_alone() -> None:
    """The cloud adjusted by itself and then fitted to the markers' triangulated corners is worse than both together.

    Compared over the root mean square of the position of the view that shows no marker.
    """
    ours, theirs = [], []
    for seed in range(6):
        rng = np.random.default_rng(300 + seed)
        truth = world(rng, views=8, points=160)
        start = noisy(truth, rng)
        ours.append(difference(adjust(start).bundle.poses[0], truth.poses[0]))
        bare = Bundle(**{**vars(start), "markers": [], "corners": []})
        cloud = adjust(bare, hold_first=True).bundle
        seen = np.array([_triangulated(cloud, start, marker) for marker in (0, 1)]).reshape(-1, 3)
        true = np.concatenate([transform_points(place, CORNERS) for place in truth.markers])
        matrix, scale = umeyama(true, seen, scale=True)
        pose = matrix @ cloud.poses[0]
        pose[:3, :3] /= scale
        theirs.append(difference(pose, truth.poses[0]))
    rms = [float(np.sqrt((np.array(e)[:, 3:] ** 2).mean())) for e in (ours, theirs)]
    assert rms[0] < rms[1], rms


def _triangulated(cloud: Bundle, start: Bundle, marker: int) -> np.ndarray:
    """Corners (4, 3) of a marker from its sights in the cloud's frame: nearest point to the rays."""
    from pipeline.camera.lens import pixel_rays

    seen = [c for c in start.corners if c.marker == marker]
    answer = []
    for corner in range(4):
        A, b = np.zeros((3, 3)), np.zeros(3)
        for c in seen:
            pose = cloud.poses[c.view]
            ray = pose[:3, :3] @ pixel_rays(cloud.cameras[0], c.px[corner : corner + 1])[0]
            across = np.eye(3) - np.outer(ray, ray)
            A, b = A + across, b + across @ pose[:3, 3]
        answer.append(np.linalg.solve(A, b))
    return np.array(answer)


def test_lens_is_found_with_its_covariance() -> None:
    chi2 = []
    for seed in range(10):
        rng = np.random.default_rng(500 + seed)
        truth = world(rng, views=8, points=160)
        start = noisy(truth, rng)
        off = CAMERA.model_copy(update={"fx": 1070.0, "fy": 1070.0, "distortion": np.zeros(5)})
        found = adjust(
            Bundle(**{**vars(start), "cameras": [off]}), [free_columns(("k1", "k2"), True)],
            [np.array([50, 50, 10, 10, 1, 1, 1, 1, 1.0])],
        )  # fmt: skip
        camera = found.bundle.cameras[0]
        error = np.array(
            [camera.fx - 1046, camera.cx - 484.2, camera.cy - 356.1, *(camera.distortion - CAMERA.distortion)[:2]]
        )
        keep = [0, 2, 3, 4, 5]
        chi2.append(error @ np.linalg.solve(found.lens_covariance[0][np.ix_(keep, keep)], error))
    assert np.mean(chi2) < 9.0  # 5 expected, standard error 1


def test_too_little_is_refused() -> None:
    rng = np.random.default_rng(3)
    truth = world(rng)
    few = Bundle(
        **{**vars(truth), "seen_view": truth.seen_view[:5], "seen_point": truth.seen_point[:5], "px": truth.px[:5]}
    )
    with pytest.raises(NumericalError, match="overlap"):
        adjust(few)
    with pytest.raises(NumericalError, match="nothing fixes metre"):
        adjust(Bundle(**{**vars(truth), "markers": [], "corners": []}))
    blind = Bundle(**{**vars(truth), "poses": [*truth.poses, np.eye(4)], "camera_of": np.zeros(11, int)})
    with pytest.raises(NumericalError, match="do not fix the poses"):
        adjust(blind)
