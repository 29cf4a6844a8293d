"""ingest, merge and develop on captures written for the test, and on one that another renderer made."""

from __future__ import annotations

import json
import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from command import manifest

from pipeline.conventions import CLIPPED, DARK, GHOST, HOT
from pipeline.image import colour
from pipeline.image.demosaic import REACH, demosaic, demosaic_variance, dilate
from pipeline.run import formats
from pipeline.run.artifacts import BRACKETS, EXPOSURES, FACTS, MOSAICS, PHOTOGRAPHS
from pipeline.run.errors import CaptureError, ManifestError
from pipeline.simulation.dng import DngFacts, dng_bytes
from pipeline.types import Raster
from stages import develop, ingest, knobs, merge

DATA = Path(os.environ.get("INSITU_DATA", "../shared/data"))
KITCHEN = DATA / "captures/kitchen_table"
MATRIX = np.array([[0.742, -0.205, -0.062], [-0.456, 1.248, 0.233], [-0.106, 0.215, 0.648]])
D65 = colour.xyz_of_xy(colour.REC709_CHROMATICITIES[3])
NEUTRAL = MATRIX @ D65 / (MATRIX @ D65)[1]
BLACK, WHITE, ELECTRONS = 512, 15800, 30000.0
BOTH = ("poisson", "optimal")


def scene(height: int = 96, width: int = 128) -> np.ndarray:
    """Smooth ACEScg radiance (H, W, 3) over four decades, white in the middle."""
    y, x = np.mgrid[:height, :width] / [[[height]], [[width]]]
    level = 10 ** (4 * x - 2)
    tint = np.stack([1 + 0.3 * np.sin(3 * y), np.ones_like(y), 1 + 0.3 * np.cos(2 * y)], -1)
    return level[..., None] * tint


def sensor_rgb(acescg: np.ndarray) -> np.ndarray:
    """Camera response, neutral green 1, of ACEScg radiance."""
    return acescg @ np.linalg.inv(colour.acescg_from_camera(MATRIX, NEUTRAL, illuminant=21)).T


def write_frame(
    path: Path, acescg: np.ndarray, label: float, actual: float, seed: int, clip: int = WHITE, **changes: object
) -> None:
    """A frame of the scene: exposure ``label`` in EXIF, ``actual`` in truth, samples clipped at ``clip`` DN."""
    height, width, _ = acescg.shape
    channel = np.tile([[0, 1], [1, 2]], (height // 2, width // 2))
    signal = np.take_along_axis(sensor_rgb(acescg), channel[..., None], 2)[..., 0] * actual
    random = np.random.default_rng(seed)
    electrons = random.poisson(np.clip(signal, 0, 4) * ELECTRONS) + 3 * random.standard_normal(signal.shape)
    mosaic = np.clip(np.rint(electrons / ELECTRONS * (WHITE - BLACK) + BLACK), 0, clip).astype(np.uint16)
    values: dict = {
        "exposure": Fraction(label).limit_denominator(10000),
        "iso": 100,
        "fnumber": Fraction(1),
        "focal_mm": Fraction(35),
        "make": "Maker",
        "model": "One",
        "timestamp": "2026:01:02 03:04:05",
        "cfa": "RGGB",
        "black": (BLACK,) * 4,
        "white": WHITE,
        "color_matrix": MATRIX,
        "neutral": NEUTRAL,
        "noise": (1 / ELECTRONS, (3 / ELECTRONS) ** 2),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(dng_bytes(mosaic, DngFacts(**{**values, **changes})))


MANIFEST = manifest("small", "plate/*.dng", "ball/*.dng", width=128, height=96, fx=100, fy=100, cx=64, cy=48)
# label, true exposure: shared speeds are off by the same factor in both brackets
PLATE = [(1 / 50, 0.0210), (1 / 10, 0.0960), (1 / 2, 0.51)]
BALL = [(1 / 100, 0.0103), (1 / 50, 0.0210), (1 / 10, 0.0960), (1 / 2, 0.51)]


@pytest.fixture
def capture(tmp_path):
    (tmp_path / "capture.toml").write_text(MANIFEST)
    for view, frames in (("plate", PLATE), ("ball", BALL)):
        for number, (label, actual) in enumerate(frames):
            write_frame(tmp_path / view / f"{9 - number}.dng", scene(), label, actual, seed=number + 10 * len(frames))
    return tmp_path


def run(folder: Path, weights: str = "optimal", method: str = "bilinear"):
    index = ingest.compute(folder, None, knobs.Ingest())
    merged = merge.compute(index.outputs["facts"], index.outputs["brackets"], knobs.Merge(weights=weights))
    developed = develop.compute({}, merged.outputs["mosaics"], knobs.Develop(demosaic=method))
    return index, merged, developed


# the whole way


@pytest.mark.parametrize("weights", BOTH)
def test_radiance_of_both_views_comes_back_in_one_unit(capture, weights):
    _, merged, developed = run(capture, weights)
    truth = scene()
    scales = []
    for view in ("plate", "ball"):
        photograph = developed.outputs["photographs"][view]
        usable = (photograph["mask"] == 0) & (truth[..., 1] > 0.05)
        relative = photograph.rgb()[usable] / truth[usable]
        scales.append(np.median(relative))
        # median of some 8 000 pixels of 5 % at worst: 0.1 %; 0.3 % is the figure for exposure ratios
        np.testing.assert_allclose(np.median(relative, 0), np.median(relative), rtol=0.003)
    assert scales[0] == pytest.approx(scales[1], rel=0.003)
    assert scales[0] == pytest.approx(1, rel=0.05)  # the common factor is the labels' (5 % prior)
    rows = merged.outputs["exposures"]["plate"]
    found = np.array([row["estimated_s"] for row in rows])
    actual = np.array([actual for _, actual in PLATE])
    np.testing.assert_allclose(found / found[0], actual / actual[0], rtol=0.003)


def test_listing_order_and_names_change_no_byte(capture):
    _, first, _ = run(capture)
    for number, file in enumerate(sorted((capture / "ball").iterdir())):
        file.rename(file.with_name(f"z{(number * 2) % 5}.dng"))
    _, second, _ = run(capture)
    for view in ("plate", "ball"):
        for name in ("Y", "variance", "mask"):
            a, b = (r.outputs["mosaics"][view][name].tobytes() for r in (first, second))
            assert a == b


def test_exposure_times_two_halves_the_radiance(capture):
    """Stating twice the times for the same files halves every value."""
    _, _, before = run(capture)
    text = MANIFEST
    for view, frames in (("plate", PLATE), ("ball", BALL)):
        for number, (label, _) in enumerate(frames):
            text += f'[[exposure]]\nfiles = ["{view}/{9 - number}.dng"]\nexposure_s = {2 * label!r}\n'
    (capture / "capture.toml").write_text(text)
    _, _, after = run(capture)
    for view in ("plate", "ball"):
        a, b = before.outputs["photographs"][view].rgb(), after.outputs["photographs"][view].rgb()
        np.testing.assert_allclose(a, 2 * b, rtol=1e-5, atol=1e-6 * a.max())  # times pass through decimals and logs


def test_results_survive_the_disk(capture, tmp_path):
    index, merged, developed = run(capture)
    out = tmp_path / "build"
    for artifact, value in (
        (FACTS, index.outputs["facts"]),
        (BRACKETS, index.outputs["brackets"]),
        (MOSAICS, merged.outputs["mosaics"]),
        (EXPOSURES, merged.outputs["exposures"]),
        (PHOTOGRAPHS, developed.outputs["photographs"]),
    ):
        formats.write(out, artifact, value)
    again = develop.compute({}, formats.read(out, MOSAICS), knobs.Develop(demosaic="bilinear"))
    for view, photograph in formats.read(out, PHOTOGRAPHS).items():
        for name, values in photograph.channels.items():
            np.testing.assert_array_equal(values, again.outputs["photographs"][view][name])
    for result in (index, merged, developed):
        json.dumps([result.numbers, result.evidence])
    stored = formats.read(out, BRACKETS)
    assert [f.file for f in stored["plate"].frames] == ["plate/9.dng", "plate/8.dng", "plate/7.dng"]


def test_labels_are_trusted_when_asked(capture):
    index = ingest.compute(capture, None, knobs.Ingest())
    params = knobs.Merge(estimate_exposures=False)
    rows = merge.compute(index.outputs["facts"], index.outputs["brackets"], params).outputs["exposures"]["plate"]
    assert all(row["estimated_s"] == row["label_s"] for row in rows)


def test_single_frames_work(capture):
    for view in ("plate", "ball"):
        for file in sorted((capture / view).iterdir())[1:]:
            file.unlink()
    _, merged, developed = run(capture)
    for view in ("plate", "ball"):
        rgb = developed.outputs["photographs"][view].rgb()
        assert np.all(np.isfinite(rgb))
        assert merged.numbers["views"][view]["frames"] == 1


def test_all_clipped_view_is_flagged(capture):
    for number, file in enumerate(sorted((capture / "ball").iterdir())):
        write_frame(file, np.full((96, 128, 3), 1e4), 0.1 * (number + 1), 1.0, 1)
    _, merged, developed = run(capture)
    photograph = developed.outputs["photographs"]["ball"]
    assert np.all(photograph["mask"] & CLIPPED)
    assert np.all(np.isinf(photograph.rgb("variance")))
    assert np.all(np.isfinite(photograph.rgb()))
    assert any("clip in every frame" in text for text in merged.warnings)


def test_all_dark_view_is_flagged(capture):
    for number, file in enumerate(sorted((capture / "ball").iterdir())):
        write_frame(file, np.zeros((96, 128, 3)), 0.1 * (number + 1), 1.0, number)
    _, merged, developed = run(capture)
    assert np.mean(developed.outputs["photographs"]["ball"]["mask"] & DARK > 0) > 0.7
    assert any("below noise" in text for text in merged.warnings)


def test_wrong_label_is_reported(capture, saw):
    write_frame(capture / "plate/8.dng", scene(), 1 / 10 * 1.4, 0.1, seed=1)
    _, merged, _ = run(capture)
    said = [text for text in merged.warnings if "times its label" in text]
    rows = {row["file"]: row["estimated_s"] for row in merged.outputs["exposures"]["plate"]}
    other = next(name for name in rows if name != "plate/8.dng")
    _, actual = PLATE[9 - int(other[6])]
    measured = rows["plate/8.dng"] / rows[other]
    saw("exif.wrong_40", "degraded", abs(measured / (0.1 / actual) - 1), said=said[0])
    assert "plate/8.dng" in said[0]


def test_lower_clip_level_than_white_is_found(capture):
    for view, frames in (("plate", PLATE), ("ball", BALL)):
        for number, (label, actual) in enumerate(frames):
            write_frame(capture / view / f"{9 - number}.dng", scene(), label, actual, seed=number, clip=13000)
    _, merged, developed = run(capture)
    assert any("clip at 13000 DN" in text for text in merged.warnings)
    photograph, truth = developed.outputs["photographs"]["plate"], scene()
    usable = (photograph["mask"] == 0) & (truth[..., 1] > 1)
    relative = photograph.rgb()[usable] / truth[usable]
    assert np.percentile(np.abs(relative / np.median(relative) - 1), 99) < 0.05


def test_noise_without_profile_is_measured_scaled_or_assumed(capture):
    """DNG without NoiseProfile (its tag renamed): ISO 100 from frame pairs, ISO 400 from ISO 100, alone: assumed."""

    def strip(file: Path) -> None:
        entry = np.array([51041], "<u2").tobytes() + np.array([12], "<u2").tobytes()  # tag, type double
        data = file.read_bytes()
        assert data.count(entry) == 1
        file.write_bytes(data.replace(entry, np.array([65000], "<u2").tobytes() + entry[2:]))

    for number, (label, actual) in enumerate(PLATE):
        write_frame(capture / f"plate/{9 - number}.dng", scene(192, 256), label, actual, seed=number)
    for file in (capture / "ball").iterdir():
        file.unlink()
    write_frame(capture / "ball/0.dng", scene(192, 256), 0.1, 0.4, 9, iso=400)
    for file in [*(capture / "plate").iterdir(), *(capture / "ball").iterdir()]:
        strip(file)
    _, merged, _ = run(capture)
    noise = merged.numbers["noise"]
    assert noise["iso_100"]["source"] == "photon transfer"
    assert noise["iso_100"]["electrons_at_white"] == pytest.approx(ELECTRONS, rel=0.15)  # a few bins of 300 samples
    assert noise["iso_400"]["source"] == "scaled from ISO 100"
    assert noise["iso_400"]["electrons_at_white"] == pytest.approx(noise["iso_100"]["electrons_at_white"] / 4)
    for file in sorted((capture / "plate").iterdir())[1:]:
        file.unlink()
    _, alone, developed = run(capture)
    assert alone.numbers["noise"]["iso_100"]["source"] == "assumed"
    assert any("a usual sensor is assumed" in text for text in alone.warnings)
    assert np.all(np.isfinite(developed.outputs["photographs"]["plate"].rgb()))


# ingest


def test_duplicates_count_once(capture):
    (capture / "plate/copy.dng").write_bytes((capture / "plate/9.dng").read_bytes())
    index = ingest.compute(capture, None, knobs.Ingest())
    assert len(index.outputs["brackets"]["plate"].frames) == 3
    assert any("same content" in text for text in index.warnings)


def test_all_problems_at_once(capture):
    (capture / "plate/text.dng").write_text("no picture")
    write_frame(capture / "ball/none.dng", scene(), 0, 0.1, 1)
    text = MANIFEST.replace('"ball/*.dng"', '"ball/*.dng", "gone.dng"')
    (capture / "capture.toml").write_text(text)
    (capture / "scene.toml").write_text(
        '[render]\nsamples = 3\n[[object]]\nname = "a"\nfile = "a.fbx"\nposition_m = [0, 0]\n'
        '[[object]]\nname = "b"\nfile = "b.glb"\nposition_m = [0, 0]\n'
    )
    with pytest.raises(ManifestError) as error:
        ingest.compute(capture, None, knobs.Ingest())
    text = str(error.value)
    for part in ("gone.dng", "a.fbx", "b.glb", "text.dng", "[[exposure]]"):
        assert part in text
    assert len(text.splitlines()) == 5


def test_missing_exposure_is_asked_for_and_taken(capture, saw):
    write_frame(capture / "plate/9.dng", scene(), 0, 0.021, 1)
    with pytest.raises(CaptureError, match=r"plate/9.dng: exposure_s missing .* \[\[exposure\]\]") as refusal:
        ingest.compute(capture, None, knobs.Ingest())
    saw("exif.missing", "refused", said=str(refusal.value))
    (capture / "capture.toml").write_text(MANIFEST + '[[exposure]]\nfiles = ["plate/9.dng"]\nexposure_s = 0.02\n')
    index = ingest.compute(capture, None, knobs.Ingest())
    assert index.outputs["brackets"]["plate"].frames[0].exposure_s == 0.02


def test_mixed_sizes_are_refused(capture):
    write_frame(capture / "plate/small.dng", scene(64, 64), 0.3, 0.3, 1)
    with pytest.raises(CaptureError, match="plate: its frames are 64 x 64 RGGB, 128 x 96 RGGB"):
        ingest.compute(capture, None, knobs.Ingest())
    (capture / "plate/small.dng").unlink()
    for file in (capture / "ball").iterdir():
        write_frame(file, scene(64, 64), 0.3, 0.3, 1)
    with pytest.raises(CaptureError, match="ball: its frames are 64 x 64 RGGB, the plate's 128 x 96"):
        ingest.compute(capture, None, knobs.Ingest())


def test_wishes_name_their_files(capture):
    (capture / "b.obj").write_text("v 0 0 0\n")
    (capture / "scene.toml").write_text(
        'quality = "draft"\n[merge]\nweights = "poisson"\n'
        '[[object]]\nname = "b"\nfile = "b.obj"\nposition_m = [0.1, 0]\n'
    )
    index = ingest.compute(capture, None, knobs.Ingest())
    wish = index.outputs["wishes"]["object"][0]
    assert (wish["path"], len(wish["sha256"])) == (str((capture / "b.obj").resolve()), 64)
    assert index.outputs["facts"]["capture_root"] == str(capture.resolve())
    (capture / "other.toml").write_text("")
    assert ingest.compute(capture, capture / "other.toml", knobs.Ingest()).outputs["wishes"]["object"] == []


def test_different_white_balance_is_reported(capture):
    write_frame(capture / "plate/8.dng", scene(), 0.1, 0.096, 1, neutral=np.array([0.6, 1, 0.6]))
    _, merged, _ = run(capture)
    assert any("white balance differs" in text for text in merged.warnings)


def test_missing_colour_matrix_is_refused():
    raster = Raster(
        {k: np.ones((8, 8), np.float32) for k in ("Y", "variance")} | {"mask": np.zeros((8, 8), np.uint32)},
        "camera_rgb",
    )
    profile = {
        "file": "a.nef",
        "camera": "",
        "color_matrix": None,
        "color_matrix_2": None,
        "illuminant": 0,
        "illuminant_2": 0,
        "as_shot_neutral": None,
    }
    raster.attributes.update({"insitu:cfa": "RGGB", "insitu:colour": json.dumps(profile)})
    with pytest.raises(CaptureError, match=r"a\.nef.*ColorMatrix1"):
        develop.compute({}, {"plate": raster}, knobs.Develop())


# demosaicking


@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "GBRG", "BGGR"])
@pytest.mark.parametrize("shape", [(24, 30), (23, 31)])
def test_linear_demosaicking_agrees_with_the_library(cfa, shape):
    library = pytest.importorskip("colour_demosaicing")
    mosaic = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    for method, function in (
        ("bilinear", library.demosaicing_CFA_Bayer_bilinear),
        ("malvar", library.demosaicing_CFA_Bayer_Malvar2004),
    ):
        ours, theirs = demosaic(mosaic, cfa, method), function(mosaic.astype(float), cfa)
        # float32 rounding; the library mirrors its border differently
        np.testing.assert_allclose(ours[4:-4, 4:-4], theirs[4:-4, 4:-4], atol=1e-6)


@pytest.mark.parametrize("method", ["bilinear", "malvar", "menon"])
def test_a_grey_wall_stays_grey_to_the_edge(method):
    np.testing.assert_allclose(demosaic(np.full((21, 26), 0.7, np.float32), "GBRG", method), 0.7, rtol=1e-6)


@pytest.mark.parametrize("method", ["bilinear", "malvar"])
def test_demosaic_variance_by_simulation(method):
    random = np.random.default_rng(1)
    deviation = random.uniform(0.5, 2, (12, 14))
    samples = [demosaic(deviation * random.standard_normal((12, 14)), "RGGB", method) for _ in range(4000)]
    # away from the mirrored border, where one sample enters twice; a variance of 4000 is known to 2.2 %, 5 sigma
    inner = (slice(4, -4), slice(4, -4))
    expected = demosaic_variance((deviation**2).astype(np.float32), "RGGB", method)
    np.testing.assert_allclose(np.var(samples, 0)[inner], expected[inner], rtol=0.11)


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 5)])
def test_tiny_pictures(shape):
    for method in ("bilinear", "malvar"):
        result = demosaic(np.full(shape, 2.0, np.float32), "RGGB", method)
        assert result.shape == (*shape, 3)
        assert np.all(np.isfinite(result))


def test_dilate_spreads_bits_by_their_reach():
    mask = np.zeros((9, 9), np.uint32)
    mask[4, 4], mask[0, 0] = GHOST, HOT
    expected = np.zeros((9, 9), np.uint32)
    expected[2:7, 2:7] |= GHOST
    expected[:3, :3] |= HOT
    np.testing.assert_array_equal(dilate(mask, 2), expected)
    assert REACH["malvar"] == 2


def test_clipped_photosites_poison_nothing_beyond_the_kernel():
    mosaic = np.ones((20, 20), np.float32)
    variance, mask = np.full((20, 20), 0.01, np.float32), np.zeros((20, 20), np.uint32)
    variance[10, 10], mask[10, 10] = np.inf, CLIPPED
    profile = {
        "file": "a",
        "camera": "",
        "color_matrix": MATRIX.tolist(),
        "color_matrix_2": None,
        "illuminant": 21,
        "illuminant_2": 0,
        "as_shot_neutral": NEUTRAL.tolist(),
    }
    header = {"insitu:cfa": "RGGB", "insitu:colour": json.dumps(profile)}
    raster = Raster({"Y": mosaic, "variance": variance, "mask": mask}, "camera_rgb", header)
    for method in ("bilinear", "malvar"):
        result = develop.compute({}, {"plate": raster}, knobs.Develop(demosaic=method)).outputs["photographs"]["plate"]
        infinite = np.isinf(result.rgb("variance")).all(-1)
        side = 2 * REACH[method] + 1
        assert infinite.sum() == side * side
        assert np.all(np.isfinite(result.rgb("variance")[~infinite]))
        assert np.all(np.isfinite(result.rgb()))


# a capture that we did not make


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitchen")
    text = MANIFEST.replace('name = "small"', f'name = "kitchen"\nroot = "{KITCHEN.resolve()}"', 1)
    (folder / "capture.toml").write_text(text.replace("ball/*.dng", "probe_a/*.dng"))
    return run(folder, "optimal", "malvar")


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="no INSITU_DATA")
class TestKitchenTable:
    def test_exposures_and_sensor(self, kitchen):
        merged = kitchen[1]
        for row in [row for rows in merged.outputs["exposures"].values() for row in rows]:
            # labels are exact there; the shortest frame has only some hundred lamp pixels
            assert row["estimated_s"] == pytest.approx(row["label_s"], rel=max(0.003, 3 * row["sigma_rel"]))
        sensor = merged.numbers["noise"]["iso_100"]
        assert sensor["electrons_at_white"] == pytest.approx(40000, rel=0.03)
        assert sensor["read_noise_electrons"] == pytest.approx(np.hypot(3.0, 2.604 / np.sqrt(12)), rel=0.05)

    def test_hot_photosites(self, kitchen):
        truth = json.loads((KITCHEN / "truth/truth.json").read_text())["sensor"]
        mask = kitchen[1].outputs["mosaics"]["plate"]["mask"]
        found = {tuple(p) for p in np.argwhere(mask & HOT > 0).tolist()}
        hottest = {tuple(p) for p, rate in zip(truth["hot_pixels_yx"], truth["hot_rates_e_per_s"]) if rate > 2e4}
        assert hottest <= found
        assert len(found - {tuple(p) for p in truth["hot_pixels_yx"]}) <= 3

    def test_plate_is_the_truth_without_a_cast(self, kitchen):
        photograph = kitchen[2].outputs["photographs"]["plate"]
        truth = formats.read_exr(KITCHEN / "truth/plate_radiance.exr").rgb()
        truth = colour.convert(truth, "linear_rec709", "acescg")
        developed = photograph.rgb()
        scale = np.median(developed / truth)
        signed = np.median(developed / (scale * truth), (0, 1)) - 1
        assert np.abs(signed).max() < 0.001  # colour matrix of four decimals; measured 1e-4
        size = (truth.shape[0] // 8 * 8, truth.shape[1] // 8 * 8)

        def means(rgb: np.ndarray) -> np.ndarray:
            return rgb[: size[0], : size[1]].reshape(size[0] // 8, 8, size[1] // 8, 8, 3).mean((1, 3))

        relative = means(developed) / (scale * means(truth)) - 1
        assert np.median(np.abs(relative), (0, 1)).max() < 0.01


def test_a_lamp_keeps_its_colour_in_ball_views():
    """A few bright photosites in a dim field: the sum of each channel stays that of the mosaic (a linear kernel)."""
    assert develop.method_of("plate", "menon") == "menon"
    assert develop.method_of("ball_a", "menon") == "bilinear"
    mosaic = np.full((40, 40), 0.01, np.float32)
    mosaic[18:22, 18:22] = 100.0
    rgb = demosaic(mosaic, "RGGB", develop.method_of("ball_a", "menon"))
    # Each photosite of R and B stands for four pixels, of G for two.
    expected = [4 * mosaic[0::2, 0::2].sum(), 2 * (mosaic[0::2, 1::2].sum() + mosaic[1::2, 0::2].sum())]
    np.testing.assert_allclose(rgb.sum((0, 1))[:2], expected, rtol=1e-3)  # the frame's border, 0.01 of 400
