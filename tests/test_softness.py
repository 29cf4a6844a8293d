"""How soft a picture is, against printed boards whose blur is known.

A print is sampled on a grid four times finer, blurred there and averaged over the pixels, so that Gaussian and box make
up the stated standard deviation exactly. Tolerances: over 30 such pictures (five prints, tilts to 55 degrees, b from
0.35 to 1.4 px, poses off by 0.1 mm, noise of 1 % of the paper) errors were 0.3 % rms, 0.8 % at the most, where the
stated uncertainty is 1 % and more of b: what is asked is three times that uncertainty, and that it stay below 2 %.
"""

from __future__ import annotations

import numpy as np
import printed_board
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.camera import softness
from pipeline.camera.pose_report import softness_reason
from pipeline.conventions import CLIPPED
from pipeline.image.demosaic import demosaic
from pipeline.run import evidence
from pipeline.types import Camera, Raster

FINER = 4
DISTORTION = np.array([-0.12, 0.03, 0.001, -0.002, 0.0])
LEGACY = {"dictionary": "DICT_5X5_100", "squares": (7, 6), "square_m": 0.03, "marker_m": 0.022, "legacy": True}
GRID = {"kind": "grid", "dictionary": "DICT_6X6_250", "squares": (4, 3), "square_m": 0.05, "marker_m": 0.04}
CHESSBOARD = {"kind": "chessboard", "squares": (8, 6), "square_m": 0.03}
NOISE = 0.008  # of a white of 0.8
POSE = printed_board.looking_at(np.array([0.105, 0.0, 0.075]), 35, 20, 0.36, 3)


def camera(finer: int = 1, width: int = 480) -> Camera:
    return Camera(
        width=width * finer, height=width * 3 // 4 * finer, fx=width * 1.08 * finer, fy=width * 1.08 * finer,
        cx=width / 2 * finer, cy=width * 3 / 8 * finer, distortion=DISTORTION,
    )  # fmt: skip


def fine_picture(printed: tuple[np.ndarray, float, np.ndarray], pose: np.ndarray, width: int = 480) -> np.ndarray:
    return printed_board.photograph(printed, camera(FINER, width), pose, supersample=1)


def soft(fine: np.ndarray, b: float, noise: float = NOISE, seed: int = 0) -> np.ndarray:
    """(H, W) of a fine picture, so that Gaussian and the pixel's box have the standard deviation ``b`` px together."""
    sigma = np.sqrt((FINER * b) ** 2 - (FINER**2 - 1) / 12)
    blurred = gaussian_filter(fine.astype(float), sigma, truncate=5)
    height, width = (n // FINER for n in fine.shape)
    picture = blurred.reshape(height, FINER, width, FINER).mean((1, 3))
    return picture + np.random.default_rng(seed).normal(0, noise, picture.shape)


def measured(
    picture: np.ndarray, facts: dict, pose: np.ndarray = POSE, flags: np.ndarray | None = None
) -> softness.Softness | None:
    rgb = np.repeat(picture[..., None].astype(np.float32), 3, -1)
    mask = np.zeros(picture.shape, np.uint32) if flags is None else flags
    photograph = Raster({**Raster.split(rgb), "mask": mask}, "acescg")
    return softness.softness(photograph, camera(width=picture.shape[1]), pose, facts)


def assert_is(found: softness.Softness | None, b: float) -> None:
    assert found is not None
    assert abs(found.px - b) < 3 * found.sigma_px
    assert found.sigma_px < 0.02 * b


@pytest.fixture(scope="module")
def charuco() -> np.ndarray:
    return fine_picture(printed_board.charuco_print(printed_board.BOARD), POSE)


@pytest.mark.parametrize("b", [0.35, 0.45, 0.55, 0.76, 1.0, 1.5])
def test_known_softness_of_a_board(charuco: np.ndarray, b: float) -> None:
    assert_is(measured(soft(charuco, b), {"board": printed_board.BOARD}), b)


PRINTS: dict[str, tuple[tuple[np.ndarray, float, np.ndarray], dict, tuple[float, float], float]] = {
    "legacy": (printed_board.charuco_print(LEGACY), {"board": LEGACY}, (0.105, 0.09), 0.36),
    "grid": (printed_board.grid_print(GRID), {"board": GRID}, (0.1, 0.075), 0.36),
    "chessboard": (printed_board.chessboard_print(CHESSBOARD), {"board": CHESSBOARD}, (0.12, 0.09), 0.4),
    "marker": (printed_board.marker_print(printed_board.MARKER), {"marker": [printed_board.MARKER]}, (0, 0), 0.24),
}


@pytest.mark.parametrize("kind", PRINTS)
def test_every_kind_of_print(kind: str) -> None:
    printed, facts, (x, z), distance = PRINTS[kind]
    pose = printed_board.looking_at(np.array([x, 0.0, z]), 30, -25, distance, 7)
    fine = fine_picture(printed, pose)
    for b in (0.5, 0.8):
        assert_is(measured(soft(fine, b), facts, pose), b)


def test_edges_along_the_pixel_rows_are_less_sure() -> None:
    """Seen squarely every edge meets one phase of the pixels; together they still find b, and say less sure."""
    pose = printed_board.looking_at(np.array([0.105, 0.0, 0.075]), 0, 0, 0.36)
    fine = fine_picture(printed_board.charuco_print(printed_board.BOARD), pose)
    found = measured(soft(fine, 0.55), {"board": printed_board.BOARD}, pose)
    assert found is not None
    assert abs(found.px - 0.55) < 3 * found.sigma_px
    assert 0.015 * 0.55 < found.sigma_px < 0.1 * 0.55


def test_out_of_focus(charuco: np.ndarray) -> None:
    """Softer than the first reach shows: a chessboard's edges are far enough apart for 3 px."""
    pose = printed_board.looking_at(np.array([0.12, 0.0, 0.09]), 25, 30, 0.3, 4)
    fine = fine_picture(printed_board.chessboard_print(CHESSBOARD), pose)
    assert_is(measured(soft(fine, 3.0), {"board": CHESSBOARD}, pose), 3.0)
    # 4 mm of white are 5 px here: edges so near to each other say nothing of a blur of 3 px
    assert measured(soft(charuco, 3.0), {"board": printed_board.BOARD}) is None


def test_what_stands_on_the_board_and_shadows_are_left_out(charuco: np.ndarray) -> None:
    picture = soft(charuco, 0.6)
    row, column = np.indices(picture.shape)
    covered = np.where(np.hypot(row - 190, column - 200) < 60, 0.3 + 0.1 * np.sin(column / 3), picture)
    shade = 0.15 + 0.85 / (1 + np.exp((column - 0.4 * row - 190) / 2))
    for changed in (covered, picture * shade):
        found = measured(changed, {"board": printed_board.BOARD})
        assert_is(found, 0.6)
        assert found is not None
        assert found.edges < found.tried


def test_clipped_pixels_are_not_used(charuco: np.ndarray) -> None:
    """Paper that clips on one side of the picture leaves the other; where it clips everywhere nothing is said."""
    picture, facts = soft(charuco, 0.6), {"board": printed_board.BOARD}
    bright = picture > 0.12  # all but the black: a board that was far overexposed
    flags = np.where(bright, np.uint32(CLIPPED), np.uint32(0))
    clipped = np.where(bright, np.float32(0.12), picture)
    assert measured(clipped, facts, flags=flags) is None
    flags[:, 230:], clipped[:, 230:] = 0, picture[:, 230:]
    assert_is(measured(clipped, facts, flags=flags), 0.6)


def test_no_print_where_it_should_be(charuco: np.ndarray) -> None:
    facts = {"board": printed_board.BOARD}
    assert measured(soft(charuco, 0.6), {"board": None, "marker": None}) is None
    rng = np.random.default_rng(3)
    texture = gaussian_filter(rng.normal(size=(360, 480)), 1.5) + 0.4
    assert measured(texture, facts) is None
    behind = POSE @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert measured(soft(charuco, 0.6), facts, behind) is None
    aside = POSE.copy()
    aside[[0, 2], 3] += (0.008, 0.01)  # 12 px both ways: no edge is where another should be
    assert measured(soft(charuco, 0.6), facts, aside) is None


def test_what_demosaicking_adds(charuco: np.ndarray) -> None:
    """At grey edges in px^2: bilinear as much as its kernels' mean variance, 5/12, Malvar little, Menon next to none.

    Measured at 0.35 to 1 px over four poses: bilinear 0.42 to 0.45 (its kernel is no Gaussian), Malvar from -0.10 to
    0.10, less the softer and by the direction of the edges, Menon -0.012 to 0.010.
    """
    for b, malvar in ((0.55, (0.03, 0.09)), (1.0, (-0.11, 0.03))):
        mosaic = soft(charuco, b).astype(np.float32)
        added = {}
        for method in ("bilinear", "malvar", "menon"):
            rgb = demosaic(mosaic, "RGGB", method)
            found = measured(rgb.mean(-1), {"board": printed_board.BOARD})
            assert found is not None
            added[method] = found.px**2 - b**2
        assert added["bilinear"] == pytest.approx(5 / 12 + 0.02, abs=0.02)
        assert malvar[0] < added["malvar"] < malvar[1]
        assert abs(added["menon"]) < 0.02


def test_scatter_beyond_the_edges_own_uncertainty_is_told_apart() -> None:
    rng = np.random.default_rng(5)
    own = rng.uniform(0.01, 0.05, 4000)
    for between in (0.0, 0.04):
        value = 0.7 + rng.normal(0, 1, 4000) * np.hypot(own, between)
        mean, sigma, spread = softness.random_effects(value, own)
        assert abs(mean - 0.7) < 3 * sigma
        assert spread == pytest.approx(between, abs=0.005)


def test_edges_are_cut_and_thinned_out_evenly() -> None:
    for pieces in range(1, 500):
        of, number, share = softness._cut(np.full(pieces, 3))
        assert len(of) == len(number) == len(share) == min(3 * pieces, softness.MOST_PIECES)
        assert of.max() < pieces
        assert np.ptp(np.diff(of)) <= 1 + 2 * (3 * pieces < softness.MOST_PIECES)
    assert [len(part) for part in softness._cut(np.zeros(4, int))] == [0, 0, 0]


def test_reason_of_the_plate() -> None:
    found = softness.Softness(0.61, 0.008, 0.006, 50, 60)
    rows = [
        softness_reason(found, None, []),
        softness_reason(None, None, ["ball_a"]),
        softness_reason(None, "menon", []),
    ]
    assert [row["modelled"] for row in rows] == [True, True, False]
    assert "0.610 +- 0.010 px" in rows[0]["because"]
    assert "ball_a" in rows[1]["because"]
    assert not evidence.silent(rows)


def test_demosaicking_is_taken_off() -> None:
    """Variances: bilinear's 0.42 px^2 are off, what is unsure is added, no pixel is sharper than its box."""
    seen = softness.Softness(0.85, 0.006, 0.008, 50, 60)
    assert softness.of_lens(seen, None).px == 0.85
    assert softness.of_lens(seen, None).sigma_px == pytest.approx(0.01)
    lens = softness.of_lens(seen, "bilinear")
    assert lens.px**2 == pytest.approx(0.85**2 - 0.42)
    assert lens.sigma_px == pytest.approx(np.hypot(2 * 0.85 * 0.01, 0.01) / (2 * lens.px))
    assert softness.of_lens(softness.Softness(0.2, 0.01, 0, 50, 60), "menon").px ** 2 == pytest.approx(1 / 12)
