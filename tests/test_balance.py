"""Balance of two cameras by references both saw: against truth of simulated photographs, refusals, CDL."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pytest
from command import manifest

from pipeline.camera.markers import apply, square_homography
from pipeline.conventions import CLIPPED
from pipeline.image import balance as estimate
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.run.manifest import load_capture
from pipeline.types import Balance, Bracket, Frame, Raster
from stages import balance, knobs

CARD = {
    "plate": np.array([[20.0, 12.0], [88.0, 18.0], [83.0, 70.0], [16.0, 63.0]]),
    "ball": np.array([[90.0, 70.0], [24.0, 66.0], [30.0, 22.0], [97.0, 30.0]]),  # turned: the same corner first
}
SHAPE = {"plate": (80, 110), "ball": (90, 120)}
SENSITIVITY = {"plate": np.array([1.0, 1.0, 1.0]), "ball": np.array([0.82, 1.21, 1.07])}
ELECTRONS, READ = {"plate": 9000.0, "ball": 2500.0}, {"plate": 4.0, "ball": 9.0}  # at radiance 1; e- rms


def lit(uv: np.ndarray, slope: float = 0.5) -> np.ndarray:
    """Radiance (N, 3) of a grey card whose light falls off across it and changes colour a little."""
    fall = 0.3 * (1 + slope * (uv[:, :1] - 0.5) + 0.3 * (uv[:, 1:] - 0.5) ** 2)
    return fall * (1.1, 1.0, 0.8) * (1 + 0.05 * uv[:, :1] * (1, 0, -1))


@functools.cache
def radiance_of(view: str, card) -> np.ndarray:
    """(N, 3) of every pixel: the card, and nearly nothing around it."""
    height, width = SHAPE[view]
    y, x = np.mgrid[:height, :width] + 0.5
    uv = apply(np.linalg.inv(square_homography(CARD[view])), np.stack([x, y], -1).reshape(-1, 2))
    on = ((uv >= 0) & (uv <= 1)).all(-1)
    return np.where(on[:, None], card(np.clip(uv, 0, 1)), 0.02)


def photograph(view: str, seed: int, gains: np.ndarray | None = None, card=lit) -> Raster:
    """A camera's picture of the card: its sensitivity, shot and read noise; black around it."""
    height, width = SHAPE[view]
    radiance = radiance_of(view, card)
    signal = radiance * (SENSITIVITY[view] if gains is None else gains) * ELECTRONS[view]
    rng = np.random.default_rng([seed, view == "plate"])
    measured = (rng.poisson(signal) + READ[view] * rng.standard_normal(signal.shape)) / ELECTRONS[view]
    variance = (signal + READ[view] ** 2) / ELECTRONS[view] ** 2
    channels = {**Raster.split(np.float32(measured).reshape(height, width, 3)),
                **Raster.split(np.float32(variance).reshape(height, width, 3), "variance"),
                "mask": np.zeros((height, width), np.uint32)}  # fmt: skip
    return Raster(channels, "acescg")


def both(seed: int, floor: float, kind: str = "grey_card", **ball: Any) -> estimate.Gains:
    across = estimate.cells_across(list(CARD.values()), kind)
    shots = {"plate": photograph("plate", seed), "ball": photograph("ball", seed, **ball)}
    cells = {view: estimate.cells_of(shot, CARD[view], kind, across) for view, shot in shots.items()}
    found = estimate.ratio(cells["plate"], cells["ball"], floor)
    assert found is not None
    return found


TRUE = -np.log(SENSITIVITY["ball"])


@pytest.mark.parametrize("floor", [0.0, estimate.SAME_PLACE, estimate.OTHER_PLACE])
def test_gains_lie_within_what_they_say(floor):
    """200 simulated pairs; the floors are drawn as stated. 95 % intervals hold 90 to 98 %: three binomial errors.

    Measured: 0.92, 0.93, 0.94 by channel without a floor (noise and scatter alone), 0.955 to 0.965 with one.
    """
    rng = np.random.default_rng(1)
    shared = floor**2 * ((1 - estimate.OWN_SHARE) + estimate.OWN_SHARE * np.eye(3))
    z, chi2 = [], []
    for seed in range(200):
        off = rng.multivariate_normal(np.zeros(3), shared) if floor else np.zeros(3)
        found = both(seed, floor, gains=SENSITIVITY["ball"] * np.exp(off))
        error = found.log - TRUE
        z.append(error / np.sqrt(np.diag(found.covariance)))
        chi2.append(error @ np.linalg.solve(found.covariance, error))
    inside = (np.abs(z) < 1.96).mean(0)
    assert ((inside >= 0.90) & (inside <= 0.98)).all(), inside
    assert 0.90 <= np.mean(np.array(chi2) < 7.815) <= 0.98  # 95 % of chi2 with three degrees of freedom
    assert np.abs(np.mean(z, 0)).max() < 4 / np.sqrt(200)  # no bias


def test_uneven_light_on_the_card_cancels_and_noise_alone_remains():
    found = both(3, 0.0)
    assert np.sqrt(np.diag(found.covariance)).max() < 2e-3  # the light differs by 50 % across the card
    assert found.cells > 50


def test_swapping_the_views_inverts_the_gains():
    cells = {v: estimate.cells_of(photograph(v, 5), CARD[v], "grey_card", 8) for v in CARD}
    there, back = (estimate.ratio(cells[a], cells[b], 0.01) for a, b in (("plate", "ball"), ("ball", "plate")))
    assert there.log == pytest.approx(-back.log, abs=1e-12)
    assert there.covariance == pytest.approx(back.covariance, abs=1e-12)


def test_light_that_moved_goes_into_sigma():
    """The gradient on the card differs between the photographs: what averaging hides is said."""
    still, moved = both(7, 0.0), both(7, 0.0, card=lambda uv: lit(uv, 0.8))
    sigma = np.sqrt(np.diag(moved.covariance))
    assert sigma.min() > 20 * np.sqrt(np.diag(still.covariance)).max()
    assert (np.abs(moved.log - TRUE) < 3 * sigma).all()


def test_a_glint_and_a_clipped_corner_change_nothing():
    shots = {view: photograph(view, 11) for view in CARD}
    clean = {view: estimate.cells_of(shot, CARD[view], "grey_card", 8) for view, shot in shots.items()}
    glint = shots["ball"].channels | {c: shots["ball"][c].copy() for c in "RGB"}
    for c in "RGB":
        glint[c][40:50, 50:60] *= 3
    glint["mask"] = shots["ball"]["mask"].copy()
    glint["mask"][60:70, 80:95] |= CLIPPED
    glint["R"][62:64, 82:84] = np.nan
    hurt = estimate.cells_of(Raster(glint, "acescg"), CARD["ball"], "grey_card", 8)
    one = estimate.ratio(clean["plate"], clean["ball"], 0.0)
    other = estimate.ratio(clean["plate"], hurt, 0.0)
    assert other.cells < one.cells - 4
    assert (np.abs(other.log - one.log) < 4 * np.sqrt(np.diag(other.covariance))).all()


def test_three_references_outvote_one_that_is_lit_otherwise():
    cov = estimate.OTHER_PLACE**2 * np.eye(3)
    odd = [estimate.Gains(TRUE + off, cov, 50) for off in (0.004, -0.005, 0.002, 0.4)]
    found, disagreement = estimate.joined(odd)
    plain = np.mean([one.log for one in odd], 0)
    assert np.abs(found.log - TRUE).max() < 0.15 * np.abs(plain - TRUE).max()
    assert disagreement > balance.DISAGREE
    alone, _ = estimate.joined(odd[:1])
    assert found.covariance[0, 0] > alone.covariance[0, 0]  # raised, not averaged down


def test_joined_references_lie_within_what_they_say():
    """Three references of different covariance, 2000 draws: 90 to 98 % of the 95 % intervals; measured 0.960 to 0.966.

    Huber's weights and a covariance that only ever grows make them a little wide.
    """
    rng = np.random.default_rng(2)
    roots = [s * rng.normal(size=(3, 3)) for s in (0.003, 0.006, 0.01)]
    inside = []
    for _ in range(2000):
        drawn = [estimate.Gains(TRUE + root @ rng.normal(size=3), root @ root.T, 50) for root in roots]
        found, _ = estimate.joined(drawn)
        inside.append(np.abs(found.log - TRUE) < 1.96 * np.sqrt(np.diag(found.covariance)))
    assert ((np.mean(inside, 0) >= 0.90) & (np.mean(inside, 0) <= 0.98)).all(), np.mean(inside, 0)


# ---- a chart ---------------------------------------------------------------------------------------------------------


def chart(uv: np.ndarray) -> np.ndarray:
    column, row = np.minimum((uv * (6, 4)).astype(int), (5, 3)).T
    return estimate.chart_acescg()[row * 6 + column]


def test_constants_of_the_chart_are_those_of_colour_science():
    import colour

    known = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
    assert pytest.approx(np.array(list(known.data.values())), abs=5.1e-5) == estimate.CHART_XYY  # four decimals
    assert known.illuminant == pytest.approx(estimate.D50_WHITE_XY, abs=1e-8)
    xyz = colour.xyY_to_XYZ(np.array(list(known.data.values())))
    space = colour.RGB_COLOURSPACES["ACEScg"]
    expected = colour.XYZ_to_RGB(xyz, space, known.illuminant, chromatic_adaptation_transform="Bradford")
    assert estimate.chart_acescg() == pytest.approx(expected, abs=2e-4)


def test_a_chart_gives_the_gains_and_shows_what_they_leave():
    across = estimate.cells_across(list(CARD.values()), "chart")
    crossed = np.array([[0.9, 0.08, 0.02], [0.05, 0.9, 0.05], [0.0, 0.12, 0.88]])
    for mixed, low, high in ((np.eye(3), 0, 0.02), (crossed, 0.03, 0.5)):  # a camera whose colours are not the plate's
        shots = {"plate": photograph("plate", 2, card=chart),
                 "ball": photograph("ball", 2, card=lambda uv, m=mixed: chart(uv) @ m.T)}  # fmt: skip
        cells = {view: estimate.cells_of(shot, CARD[view], "chart", across) for view, shot in shots.items()}
        gains = estimate.ratio(*(estimate.greys(one) for one in cells.values()), estimate.OTHER_PLACE)
        assert (np.abs(gains.log - TRUE) < 3 * np.sqrt(np.diag(gains.covariance))).all()
        assert low <= estimate.chart_residual(cells["plate"], cells["ball"], gains) <= high
        assert estimate.chart_agreement(cells["plate"]) > 0.99


# ---- the stage -------------------------------------------------------------------------------------------------------


def frame(view: str, camera: str) -> Frame:
    height, width = SHAPE[view]
    return Frame(file=f"{view}.dng", sha256=view, exposure_s=0.1, iso=100, fnumber=8, width=width, height=height,
                 cfa="RGGB", black=np.zeros((2, 2)), white=1000, camera=camera)  # fmt: skip


def stage(references: list[dict], shots: dict[str, Raster], cameras=("One", "Two"), tripod: bool = False):
    brackets = {v: Bracket(name=v, role=v, frames=[frame(v, c)]) for v, c in zip(("plate", "ball"), cameras)}
    facts = {"reference": references, "ball": [{"name": "ball", "tripod": tripod, "camera": None}]}
    exposures = {view: [{"sigma_rel": 0.002}] for view in brackets}
    return balance.compute(facts, brackets, exposures, shots, knobs.Balance())


def card(kind: str = "grey_card", **views: np.ndarray) -> dict:
    seen = [{"view": view, "corners_px": corners.tolist()} for view, corners in (views or CARD).items()]
    return {"name": "grey", "kind": kind, "reflectance": None, "reflectance_space": "acescg", "seen": seen}


@pytest.fixture(scope="module")
def shots() -> dict[str, Raster]:
    return {view: photograph(view, 21) for view in CARD}


def test_stage_brings_the_ball_to_the_plate(shots):
    result = stage([card()], shots)
    found = result.outputs["balance"]["ball"]
    assert found.applied
    assert np.abs(np.log(found.gains) - TRUE).max() < 3 * estimate.OTHER_PLACE
    assert result.numbers["ball"]["exposure"] == pytest.approx(np.exp(TRUE.mean()), rel=0.02)
    brought = estimate.balanced(shots, result.outputs["balance"])
    assert brought["plate"] is shots["plate"]
    assert brought["ball"].rgb() == pytest.approx(shots["ball"].rgb() * found.gains, rel=1e-6)
    assert brought["ball"].rgb("variance") == pytest.approx(shots["ball"].rgb("variance") * found.gains**2, rel=1e-6)
    modelled = {row["term"]: row["modelled"] for row in result.evidence}
    assert modelled == {"balance of ball": True, "neutral plate": False}


def test_nothing_is_applied_within_the_uncertainty():
    """Equal cameras: the card tells gains of 1 to a percent, and the photograph stays bit for bit."""
    equal = {view: photograph(view, 4, gains=np.ones(3)) for view in CARD}
    result = stage([card()], equal)
    assert not result.outputs["balance"]["ball"].applied
    assert estimate.balanced(equal, result.outputs["balance"])["ball"] is equal["ball"]


def test_without_a_reference_the_gains_are_one_and_how_sure_that_is_is_said(shots):
    one, two = (stage([], shots, cameras) for cameras in (("One", "One"), ("One", "Two")))
    same, other = (result.outputs["balance"]["ball"] for result in (one, two))
    assert (same.gains == 1).all()
    assert not same.applied
    assert np.sqrt(same.covariance[0, 0]) == pytest.approx(0.003)
    assert two.numbers["ball"]["exposure_sigma_rel"] > 0.05
    assert "unknown" in two.evidence[0]["because"]
    assert "lay a grey card in both" in two.warnings[0]
    assert one.warnings == []
    assert (other.gains == 1).all()
    assert estimate.shared_sigma(two.outputs["balance"], "ball") == pytest.approx(np.full(3, np.hypot(0.05, 0.05)))
    assert (estimate.shared_sigma({}, "ball") == 0).all()
    assert stage([], {"plate": shots["plate"]}).outputs["balance"] == {}


def test_a_grey_ball_counts_from_the_plates_place_only(shots):
    place = {"plate": CARD["plate"], "ball": CARD["ball"]}
    still, moved = (stage([card("grey_ball", **place)], shots, tripod=tripod) for tripod in (True, False))
    assert still.outputs["balance"]["ball"].references == ["grey"]
    assert moved.outputs["balance"]["ball"].references == []
    assert "another side" in moved.warnings[0]


def test_clipped_and_tiny_cards_are_left_out_with_a_reason(shots):
    clipped = Raster({**shots["ball"].channels, "mask": np.full(SHAPE["ball"], CLIPPED, np.uint32)}, "acescg")
    tiny = {view: np.array([[40.0, 40], [44, 40], [44, 44], [40, 44]]) for view in CARD}
    for reference, taken in ((card(), {**shots, "ball": clipped}), (card(**tiny), shots)):
        result = stage([reference], taken)
        assert result.outputs["balance"]["ball"].references == []
        assert "needed 8 in common; left out; is it clipped, too small or hidden" in result.warnings[0]


def test_a_reference_that_the_plate_does_not_show_is_pointed_out(shots):
    assert "the plate does not show it" in stage([card(ball=CARD["ball"])], shots).warnings[-1]


def test_corners_of_a_chart_in_wrong_order_are_refused(shots):
    pictures = {view: photograph(view, 2, card=chart) for view in CARD}
    upside_down = {"plate": CARD["plate"], "ball": np.roll(CARD["ball"], 2, 0)}
    with pytest.raises(CaptureError, match=r"grey: in ball its patches follow .* needed 0.9; give the corners"):
        stage([card("chart", **upside_down)], pictures)
    assert stage([card("chart")], pictures).outputs["balance"]["ball"].applied


def test_a_polygon_serves_a_card_that_is_partly_hidden(shots):
    """Five corners: the bounding box is cut into cells, those inside count; from one place both show the same."""
    outline = np.array([[30.0, 22], [70, 24], [76, 45], [60, 58], [28, 52]])
    same = {view: Raster(dict(shots["plate"].channels), "acescg") for view in CARD}
    result = stage([card(plate=outline, ball=outline)], same, tripod=True)
    assert np.log(result.outputs["balance"]["ball"].gains) == pytest.approx(0, abs=1e-12)
    assert result.numbers["ball"]["cells"] >= 20


# ---- ASC CDL ---------------------------------------------------------------------------------------------------------


def through(text: str, name: str, picture: np.ndarray, folder) -> np.ndarray:
    import PyOpenColorIO as ocio

    path = folder / "corrections.ccc"
    path.write_text(text)
    processor = ocio.Config.CreateRaw().getProcessor(ocio.FileTransform(str(path), cccId=name))
    changed = np.array(picture, np.float32, order="C")
    processor.getDefaultCPUProcessor().applyRGB(changed)
    return changed


def test_corrections_and_their_inverse_give_the_picture_back(shots, tmp_path):
    result = stage([card()], shots)
    text = result.outputs["corrections"]
    names = ["ball_to_plate", "plate_to_ball", "plate_to_neutral", "neutral_to_plate"]
    listing = {e.get("id"): e for e in ET.fromstring(text) if e.tag.endswith("ColorCorrection")}
    assert list(listing) == names
    fields = {e.tag.split("}")[-1]: e.text for e in listing["ball_to_plate"].iter()}
    assert fields["InputDescription"] == "scene-linear ACEScg"
    assert (fields["Offset"], fields["Power"], fields["Saturation"]) == ("0 0 0", "1 1 1", "1")
    assert np.array(fields["Slope"].split(), float) == pytest.approx(result.outputs["balance"]["ball"].gains, rel=1e-12)
    assert "applied to the light" in fields["Description"]
    # highlights and negative values are neither clipped nor clamped
    picture = np.concatenate([shots["ball"].rgb().reshape(-1, 3), [[1e4, -0.3, 7]]])
    for there, back in (names[:2], names[2:]):
        changed = through(text, there, picture, tmp_path)
        assert np.abs(changed / picture - 1).max() > 0.05
        assert through(text, back, changed, tmp_path) == pytest.approx(picture, rel=3e-7, abs=0)  # two roundings
    used = estimate.balanced({"ball": shots["ball"]}, result.outputs["balance"])["ball"].rgb().reshape(-1, 3)
    assert through(text, names[0], picture, tmp_path)[:-1] == pytest.approx(used, rel=3e-7)


def test_the_neutral_plate_is_grey_as_the_card_and_as_bright(shots):
    stated = card() | {"reflectance": [0.18, 0.19, 0.17]}
    for reference, colour in ((card(), np.ones(3)), (stated, np.array([0.18, 0.19, 0.17]))):
        slope = np.array(stage([reference], shots).numbers["plate_neutral"]["slope"])
        cells = estimate.cells_of(shots["plate"], CARD["plate"], "grey_card", 8).mean
        seen = np.exp(np.log(cells * slope).mean(0))
        assert seen / seen.mean() == pytest.approx(colour / colour.mean(), rel=3e-3)  # the light's colour changes on it


def test_a_collection_may_be_empty(shots):
    assert "ColorCorrectionCollection" in stage([], {"plate": shots["plate"]}).outputs["corrections"]


# ---- what capture.toml may say ---------------------------------------------------------------------------------------

REFERENCE = """[[reference]]
name = "grey"
kind = "grey_card"
[[reference.seen]]
view = "plate"
corners_px = [[20, 12], [88, 18], [83, 70], [16, 63]]
[[reference.seen]]
view = "ball"
corners_px = [[20, 12], [88, 18], [83, 70], [16, 63]]
"""
MANIFEST = manifest("two", "plate.dng", "ball.dng", REFERENCE, width=110)


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('"grey_card"', '"gray_card"', r"capture.toml:14: reference\[0\].kind: is 'gray_card'; expected"),
        ("[[20, 12], [88, 18], [83, 70], [16, 63]]\n[[ref", "[[20, 12], [83, 70], [88, 18], [16, 63]]\n[[ref",
         r"capture.toml:15: reference\[0\].seen\[0\]: corners_px cross, coincide or turn inward"),
        ('view = "ball"\ncorners_px = [[20, 12], [88, 18], [83, 70], [16, 63]]',
         'view = "ball"\ncorners_px = [[20, 12], [88, 18]]',
         r"capture.toml:20: reference\[0\].seen\[1\].corners_px: .*at least 3"),
        ('view = "ball"', 'view = "bal"', r"reference.seen.view is \['bal'\]; expected one of \['ball', 'plate'\]"),
        ('view = "ball"', 'view = "plate"', r"capture.toml:12: reference\[0\]: seen.view .* expected each view once"),
        ('"grey_card"', '"chart"\nreflectance = [0.1, 0.1, 0.1]', r"reference\[0\]: reflectance: a chart's 24 patches"),
        ('"grey_card"', '"grey_card"\nreflectance = [0.1, 0.1, 0]', r"expected three numbers above 0"),
        ('"grey_card"', '"grey_card"\ncolour = 3', r"capture.toml:15: reference\[0\].colour: unknown key"),
        ('files = ["ball.dng"]', 'files = ["ball.dng"]\ntripod = true\ncamera = { given = { fx = 3 } }',
         r"capture.toml:5: ball\[0\]: tripod = true says the plate's camera in its place"),
        ('files = ["ball.dng"]', 'files = ["ball.dng"]\ncamera = { }', r"neither calibration photographs nor given"),
    ],
)  # fmt: skip
def test_refusals_of_the_manifest(tmp_path, before, after, complaint):
    assert before in MANIFEST
    (tmp_path / "capture.toml").write_text(MANIFEST.replace(before, after, 1))
    with pytest.raises(ManifestError, match=complaint):
        load_capture(tmp_path)


def test_record_goes_through_json():
    one = Balance(gains=np.ones(3), covariance=np.eye(3), references=["a"], applied=False)
    assert Balance.model_validate_json(one.model_dump_json()).gains.tolist() == [1, 1, 1]
