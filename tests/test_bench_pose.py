"""The pose benchmark's own promises: its pictures, its statistics and its similarity know their truth."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import BOARD, charuco_print, looking_at, photograph

from benchmarks import pose_boards, pose_coverage
from benchmarks.pose import figures
from benchmarks.pose_page import write_page
from benchmarks.pose_real import against
from pipeline.camera.rigid import perturb


def test_pictures_are_those_of_the_slower_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two ways from a pixel to the print, both sampled 4 x 4: they differ where a sample meets an edge, by rounding."""
    small = pose_boards.CAMERA.model_copy(update={"width": 200, "height": 160, "fx": 240.0, "fy": 240.0, "cx": 101.0,
                                                  "cy": 82.0})  # fmt: skip
    monkeypatch.setattr(pose_boards, "CAMERA", small)
    monkeypatch.setattr(pose_boards, "BLURS_PX", (1e-3, 1e-3))
    monkeypatch.setattr(pose_boards, "NOISE", 0.0)
    pose_boards.sub_rays.cache_clear()
    pose = looking_at(pose_boards.CENTRE, 30, 40, 0.45)
    ours = pose_boards.rendered(charuco_print(BOARD), pose, np.random.default_rng(0))
    pose_boards.sub_rays.cache_clear()
    theirs = photograph(charuco_print(BOARD), small, pose, 4)
    assert np.abs(ours - theirs).max() <= (pose_boards.WHITE - pose_boards.BLACK) * 3 / 16  # three samples of sixteen
    assert np.abs(ours - theirs).mean() < 1e-4


def test_interval_is_the_exact_one() -> None:
    low, high = pose_coverage.interval(95, 100)
    assert low == pytest.approx(0.8872, abs=1e-4)  # Clopper and Pearson's tables
    assert high == pytest.approx(0.9836, abs=1e-4)
    assert pose_coverage.interval(0, 10)[0] == 0
    assert pose_coverage.interval(10, 10)[1] == 1


def test_similarity_is_found_where_centres_leave_it_open() -> None:
    """Eight cameras nearly on a line: centres alone turn them all alike, centres and rotations together do not."""
    rng = np.random.default_rng(0)
    true = [
        perturb(np.eye(4), np.array([*rng.normal(size=3) * 0.3, t, *rng.normal(size=2) * 0.02]))
        for t in np.linspace(-8, 8, 8)
    ]
    moved = perturb(np.eye(4), np.array([0.3, 0.2, 0.9, 1, 2, 3]))
    noise = np.array([2e-4] * 3 + [3e-3] * 3)
    ours = [moved @ perturb(pose, noise * rng.normal(size=6)) for pose in true]
    for pose in ours:
        pose[:3, 3] *= 0.4
    found = against(ours, true)
    assert found["rot_deg"] < np.degrees(2e-4 * np.sqrt(3)) * 1.3  # its noise; eight draws, 25 % off at three sigma
    assert found["rot_deg_by_centres"] > 10 * found["rot_deg"]
    assert found["centre_mm"] < 1.2 * found["centre_mm_by_centres"]


def test_lens_of_a_trial_has_its_covariance() -> None:
    rng = np.random.default_rng(1)
    found = np.array(
        [pose_coverage.lens_vector(pose_coverage.estimated_lens(rng, pose_coverage.TRUE, False)) for _ in range(2000)]
    )
    free = pose_coverage.LENS_SIGMA > 0
    ratio = found.std(0)[free] / np.sqrt(np.diag(pose_coverage.LENS_COVARIANCE))[free]
    assert np.abs(ratio - 1).max() < 5 / np.sqrt(2 * 2000)
    np.testing.assert_allclose(found[:, 0], found[:, 1])


def test_page_says_what_is_missing(tmp_path) -> None:
    """Without the photographs that lie outside the repository."""
    spread = dict.fromkeys(("median", "p95", "worst"), 0.01)
    lens = dict.fromkeys(("reproj_px", "rot_deg", "pos_rel", "normal_deg", "contact_px"), spread) | {"held_95": 1.0}
    route = {"trials": 10, "refused": 1, "held_95": 0.95, "interval": [0.9, 0.98], "chi2_mean": 6.0}
    cell = {"size_px": 30, "tilt_deg": 5, "photographs": 4, "refused": 1, "unseen": 0, "opencv_unseen": 0}
    cell |= {f"{who}_{key}": 0.1 for who in ("ours", "opencv") for key in ("rot_deg", "pos_rel")}
    record = {
        "coverage": dict.fromkeys(pose_coverage.ROUTES, route),
        "markers": [cell | {"ours_flipped": 0, "opencv_flipped": 2}],
        "boards": {"photographs": 8, "true_lens": lens, "calibrated_lens": lens, "corner_rms_px": 0.03,
                   "corner_bias_px": 0.001, "corner_mean_rms_px": 0.01},
        "real": {"herzjesu": {}, "abakisita": {}, "captures": {}},
    }  # fmt: skip
    record = {**figures(record), "threads": 2, "cpu_seconds": {"boards": 1.0}, **record}
    assert record["herzjesu_rot_deg"] is None
    write_page(record, tmp_path)
    page = (tmp_path / "pose.md").read_text()
    assert "were not there" in page
    assert "2 with plain OpenCV" in page
    assert (tmp_path / "pose.svg").stat().st_size > 1000
