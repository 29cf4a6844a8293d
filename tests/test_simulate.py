"""The simulator: laws of its lens, sensor, light and shapes; then whole captures of a tiny scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.conventions import (
    WORLD_FROM_BOARD,
    invert_rigid,
    latlong_directions,
    latlong_from_direction,
    latlong_solid_angles,
    transform_points,
)
from pipeline.run.errors import ManifestError
from pipeline.run.formats import digest, read_exr
from pipeline.run.manifest import SceneWishes, load_capture, load_toml
from pipeline.simulation import capture, light, sensor, shapes, surfaces
from pipeline.simulation.lens import Lens, aim, blur, look_at
from pipeline.simulation.photograph import Measure, camera_rays, path_radiance, picture, surface_albedo
from pipeline.simulation.scene_file import LampFacts, LightFacts, SimulatedScene, TableFacts, load_scene
from pipeline.simulation.world import Place
from pipeline.transport.variant import use_mitsuba
from stages.simulate import Studio, board_pose, box_mean, grow, resampled_change, shadow_pixels, simulate

LENS = Lens(1024, 768, 1150.0, 1151.2, 515.3, 381.6, (-0.081, 0.021, 0.0006, -0.0004, 0.001))
DESK = Path("sample_captures/scenes/desk.toml")
FLAT = {"wall": (1, 1, 1), "ceiling": (1, 1, 1), "floor": (1, 1, 1), "wall_variation": 0.0, "map_width": 64}


def desk_scene() -> SimulatedScene:
    return load_scene(Path(__file__).parents[1] / DESK)


# ---------------------------------------------------------------- lens


def test_undistort_inverts_distort() -> None:
    random = np.random.default_rng(0)
    x, y = random.uniform(-0.5, 0.5, (2, 1000))
    back = LENS.undistort(*LENS.distort(x, y))
    assert np.max(np.abs(back - np.array([x, y]))) < 1e-12


def test_lens_agrees_with_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    random = np.random.default_rng(1)
    points = np.concatenate([random.uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], 1)
    matrix = np.array([[LENS.fx, 0, LENS.cx - 0.5], [0, LENS.fy, LENS.cy - 0.5], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(LENS.distortion))
    assert np.allclose(LENS.project(points), expected.reshape(-1, 2) + 0.5, atol=1e-9)


def test_look_at_and_aim() -> None:
    target, position = np.array([0.1, 0.0, 0.05]), np.array([0.3, 0.5, 0.6])
    pose = look_at(position, target)
    seen = transform_points(invert_rigid(pose), target)
    assert np.allclose(seen[:2], 0, atol=1e-15)
    assert seen[2] > 0
    assert pose[1, 0] == pytest.approx(0, abs=1e-15)  # the horizon is level
    assert pose[1, 1] < 0  # and the world's up is up in the picture
    turned = aim(look_at(position, target, 0.7), (0.2, -0.1))
    assert np.allclose(turned[:3, :3].T @ turned[:3, :3], np.eye(3), atol=1e-14)
    seen = transform_points(invert_rigid(turned), target)
    assert np.allclose(seen[:2] / seen[2], (0.2, -0.1), atol=1e-14)


def test_blur_adds_its_variance_and_keeps_energy() -> None:
    picture = np.zeros((9, 9))
    picture[4, 4] = 2.0
    spread = blur(picture, 0.55)
    offset = np.arange(9) - 4.0
    assert spread.sum() == pytest.approx(2.0, rel=1e-14)
    assert (spread.sum(0) * offset**2).sum() / 2 + 1 / 12 == pytest.approx(0.55**2, rel=1e-12)
    assert np.allclose(blur(np.full((5, 5, 3), 7.0), 0.6), 7.0, rtol=1e-14)
    with pytest.raises(ValueError, match="expected 0"):
        blur(picture, 1.0)


# ---------------------------------------------------------------- sensor


def body(**changes: object) -> sensor.Sensor:
    given = {
        "cfa": "RGGB", "black": (512, 514, 511, 513), "white": 15800, "e_per_dn": 2.5, "read_noise_e": 3.2, "prnu": 0.0,
        "hot_pixels": 0, "hot_e_per_s": (2e3, 1e5), "color_matrix": np.eye(3), "seed": 5,
    }  # fmt: skip
    return sensor.Sensor(**{**given, **changes})  # type: ignore[arg-type]


def test_shutter_ladder() -> None:
    assert sensor.shutter(0) == (1.0, 1)
    for third, label in ((21, 1 / 125), (18, 1 / 60), (5, 0.3), (39, 1 / 8000), (-15, 30), (12, 1 / 15)):
        assert float(sensor.shutter(third)[1]) == pytest.approx(label)
    errors = [float(sensor.shutter(n)[1]) / sensor.shutter(n)[0] - 1 for n in range(-15, 40)]
    assert max(np.abs(errors)) < 0.07  # rounding of names, as on real cameras
    with pytest.raises(ValueError, match="off the ladder"):
        sensor.shutter(40)


def test_matrices_agree_with_colour_science() -> None:
    colour = pytest.importorskip("colour")
    ours = sensor.xyz_from_rgb(sensor.AP1_XY, sensor.ACES_WHITE_XY)
    # colour keeps the matrix of the ACES document, which has ten decimals
    assert np.allclose(ours, colour.RGB_COLOURSPACES["ACEScg"].matrix_RGB_to_XYZ, atol=1e-9)
    theirs = colour.matrix_RGB_to_RGB("sRGB", "ACEScg", "Bradford")
    assert np.allclose(sensor.acescg_from_rec709(), theirs, atol=5e-4)  # colour's sRGB matrix has four decimals


def test_neutral_is_the_camera_value_of_white() -> None:
    scene = desk_scene()
    built = capture.sensor_of(scene)
    assert np.allclose(sensor.camera_from_acescg(built.color_matrix) @ np.ones(3), built.neutral, atol=1e-12)
    assert built.neutral[1] == pytest.approx(1, abs=1e-4)  # the matrix has four decimals
    assert np.array_equal(np.round(built.color_matrix, 4), built.color_matrix)


@pytest.mark.parametrize("level", [0.0, 0.002, 0.05, 0.6])
def test_noise_follows_the_profile(level: float) -> None:
    built = body()
    mosaic = built.expose(np.full((400, 400, 3), level), 1.0, 1.0, 0).astype(float)
    black = built.cells(400, 400, built.black)
    signal = (mosaic - black) / (built.white - black)
    slope, offset = built.noise_profile()
    # 160000 samples: the mean is known to sigma / 400, the variance to 0.35 % (one sigma); four sigmas are allowed
    sigma = np.sqrt(slope * level + offset)
    assert abs(signal.mean() - level) < 4 * sigma / 400
    assert signal.var() == pytest.approx(sigma**2, rel=0.016)


def test_fixed_pattern_stays_and_noise_changes() -> None:
    built = body(prnu=0.02, read_noise_e=0.0)
    flat = np.full((200, 200, 3), 0.8)
    frames = np.stack([built.expose(flat, 1.0, 1.0, n).astype(float) for n in range(40)])
    mean = frames.mean(0) - built.cells(200, 200, built.black)
    # photon noise of a mean of 40 frames: 1 / sqrt(40 * 0.8 * 38000) = 0.09 %
    assert mean.std() / mean.mean() == pytest.approx(0.02, rel=0.03)
    assert not np.array_equal(frames[0], frames[1])
    assert np.array_equal(frames[0], built.expose(flat, 1.0, 1.0, 0))


def test_clipping_and_hot_pixels() -> None:
    built = body(hot_pixels=5, hot_e_per_s=(1e4, 1e4 + 1))
    assert (built.expose(np.full((20, 20, 3), 3.0), 1.0, 1.0, 0) == built.white).all()
    _, hot = built.fixed_pattern(20, 20)
    rows, columns = hot[:, :2].astype(int).T
    dark = [
        built.expose(np.zeros((20, 20, 3)), 1.0, t, 0).astype(float)[rows, columns].mean() - 512.5 for t in (0.5, 1.0)
    ]
    # 1e4 e- are 4000 DN; the mean of five has sigma sqrt(1e4) / 2.5 / sqrt(5) = 18 DN
    assert dark[0] == pytest.approx(2000, abs=60)
    assert dark[1] == pytest.approx(4000, abs=80)


# ---------------------------------------------------------------- light, surfaces, shapes


def test_lamp_has_its_flux_where_it_should_be() -> None:
    lamp = LampFacts(azimuth_deg=90, elevation_deg=40, diameter_deg=8, radiance=(50, 40, 30), edge_deg=0.6)
    facts = LightFacts(wall=(0, 0, 0), ceiling=(0, 0, 0), floor=(0, 0, 0), lamp=[lamp], scale=2.0)
    directions = latlong_directions(512, 1024)
    values = light.radiance(facts, directions) * latlong_solid_angles(512, 1024)[..., None]
    cap = 2 * np.pi * (1 - np.cos(np.radians(4)))
    assert np.allclose(values.sum((0, 1)), 2 * cap * np.array([50, 40, 30]), rtol=5e-3)  # soft edge and texels
    centre = (values[..., :1] * directions).sum((0, 1))
    centre /= np.linalg.norm(centre)
    assert np.allclose(centre, [np.cos(np.radians(40)), np.sin(np.radians(40)), 0], atol=2e-3)  # azimuth 90 is +X
    u, v = latlong_from_direction(centre)
    assert (float(u), float(v)) == pytest.approx((0.25, 50 / 180), abs=1e-3)


def test_wood_is_in_range_and_uniform_without_contrast() -> None:
    table = TableFacts(x_m=(-0.85, 0.75), z_m=(-0.75, 0.45), texel_m=0.004, albedo=(0.46, 0.35, 0.25), contrast=0.8)
    wood = surfaces.table_texture(table, 1)
    assert wood.shape == (300, 400, 3)
    assert 0.05 < wood.std() < 0.2
    even = surfaces.table_texture(table.model_copy(update={"contrast": 0.0}), 1)
    assert np.allclose(even, (0.46, 0.35, 0.25), atol=1e-6)


@pytest.mark.parametrize("index", [0, 1, 2])
def test_objects_are_closed_stand_on_the_table_and_face_outwards(index: int) -> None:
    model = desk_scene().object[index]
    vertices, normals, faces = shapes.build(model)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    assert vertices[:, 1].min() == pytest.approx(0, abs=1e-9)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert (np.einsum("ij,ij->i", cross, normals[faces].sum(1)) > 0).all()  # winding agrees with the normals
    assert np.abs(cross.sum(0)).max() < 1e-9 * np.abs(cross).sum()  # closed: the area vectors cancel
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    if model.shape.kind == "sphere":  # inscribed polyhedron of 80 x 40 facets
        assert volume == pytest.approx(4 / 3 * np.pi * model.shape.radius_m**3, rel=4e-3)
    if model.shape.kind == "torus":
        exact = 2 * np.pi**2 * model.shape.major_m * model.shape.minor_m**2
        assert volume == pytest.approx(exact, rel=1e-2)
    assert volume > 0


def test_glb_reads_back(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    model = desk_scene().object[1]
    mesh = shapes.build(model)
    path = tmp_path / "object.glb"
    shapes.write_glb(path, mesh, model)
    (read,) = trimesh.load_scene(path, process=False).geometry.values()
    assert np.allclose(read.vertices, mesh[0], atol=1e-8)  # float32
    assert np.allclose(read.vertex_normals, mesh[1], atol=1e-6)
    text = path.read_bytes()
    facts = json.loads(text[20 : 20 + int.from_bytes(text[12:16], "little")])["materials"][0]["pbrMetallicRoughness"]
    assert np.allclose(facts["baseColorFactor"][:3], shapes.stored_colour(model), atol=1e-9)
    assert facts["roughnessFactor"] == model.roughness
    assert facts["metallicFactor"] == model.metallic


def test_masks_grow_by_three() -> None:
    mask = np.zeros((21, 21), bool)
    mask[10, 10] = True
    assert grow(mask).sum() == 49
    assert box_mean(np.full((4, 6), 3.0)).tolist() == np.full((4, 6), 3.0).tolist()


# ---------------------------------------------------------------- scene file


def test_all_problems_at_once(tmp_path: Path) -> None:
    text = (Path(__file__).parents[1] / DESK).read_text()
    bad = tmp_path / "bad.toml"
    bad.write_text(text.replace("read_noise_e = 3.2", "read_noice_e = 3.2").replace("width = 1024", "width = 1023"))
    with pytest.raises(ManifestError) as caught:
        load_scene(bad)
    message = str(caught.value)
    assert "did you mean read_noise_e" in message
    assert "camera.width" in message
    assert len(caught.value.problems) == 3  # unknown, missing, odd
    for change in ("1024", "8000"):  # fewer than region; no whole passes
        bad.write_text(text.replace("change = 8192", f"change = {change}"))
        with pytest.raises(ManifestError, match=f"change is {change}; expected 0, or whole passes"):
            load_scene(bad)


# ---------------------------------------------------------------- whole captures


def tiny_toml(folder: Path, **changes: str) -> Path:
    """The desk at 96x72, one frame of each kind, few samples, flat texture."""
    text = (Path(__file__).parents[1] / DESK).read_text()
    text = text[: text.index("[[calibration]]", text.index("[[calibration]]") + 5)]  # one board photograph
    swaps = {
        "width = 1024": "width = 96", "height = 768": "height = 72", "fx = 1150.0": "fx = 107.8",
        "fy = 1151.2": "fy = 107.9",
        "cx = 515.3": "cx = 48.3", "cy = 381.6": "cy = 35.8", "texel_m = 0.0005": "texel_m = 0.01",
        "plate_ev = [-2, 0, 2]": "plate_ev = [0]", "ball_frames = 6": "ball_frames = 2", "plate = 256": "plate = 4",
        "region = 4096": "region = 8", "change = 8192": "change = 8", "object = 20480": "object = 8",
        "region_pass = 1024": "region_pass = 4",
        "ball = 256": "ball = 4", "calibration = 64": "calibration = 4", "environment = 256": "environment = 4",
        "depth = 10": "depth = 4", "environment_width = 512": "environment_width = 32",
        "wall_azimuth_deg = 250.0": "wall_azimuth_deg = 250.0\nmap_width = 128",
    }  # fmt: skip
    for old, new in {**swaps, **changes}.items():
        assert old in text, old
        text = text.replace(old, new)
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny")
    simulate(tiny_toml(folder), folder / "capture", lambda _: None)
    return folder / "capture"


def test_manifests_validate(tiny: Path) -> None:
    facts, _, root = load_capture(tiny)
    assert [ball.name for ball in facts.ball] == ["ball_a", "ball_b"]
    assert [ball.tripod for ball in facts.ball] == [True, False]
    for pattern in [*facts.plate.files, *facts.ball[0].files, *facts.ball[1].files, *facts.camera.calibration]:
        assert list(root.glob(pattern))
    tables = load_toml(tiny / "scene.toml")
    assert tables.pop("render") == {"materials": "gltf"}  # what the truth is made of
    wishes = SceneWishes.model_validate(tables)
    assert all((tiny / wish.file).is_file() for wish in wishes.object)
    assert (tiny / str(facts.truth)).is_file()


def test_truth_is_complete_and_consistent(tiny: Path) -> None:
    truth = json.loads((tiny / "truth" / "truth.json").read_text())
    assert set(truth["views"]) == {"plate", "ball_a", "ball_b"}
    assert truth["views"]["plate"] == truth["views"]["ball_a"]
    assert set(truth["exposures"]) == {str(p.relative_to(tiny)) for p in tiny.glob("*/*.dng")}
    for name in ("plate", "with_objects", "albedo"):
        raster = read_exr(tiny / "truth" / truth[name], "acescg")
        assert raster.shape == (72, 96)
        assert np.isfinite(raster.rgb()).all()
    coverage = read_exr(tiny / "truth" / truth["coverage"])
    assert set(coverage.channels) == {"vase", "red_sphere", "gold_ring"}
    assert np.sum(list(coverage.channels.values()), 0).max() <= 1 + 1e-3  # half floats
    plate, filled = (read_exr(tiny / "truth" / truth[name]).rgb() for name in ("plate", "with_objects"))
    assert np.abs(filled - plate)[sum(coverage.channels.values()) > 0.99].mean() > 1
    environment = read_exr(tiny / "truth" / truth["environment"]["file"], "acescg")
    assert environment.shape == (16, 32)


def test_raw_frame_is_the_truth_times_the_exposure(tiny: Path) -> None:
    """The mosaic over t ISO / (100 N^2), with the true time, is the camera_rgb of truth/plate.exr within its noise."""
    import rawpy

    truth = json.loads((tiny / "truth" / "truth.json").read_text())
    plate = read_exr(tiny / "truth" / "plate.exr").rgb().astype(float)
    scene = desk_scene()
    facts = truth["sensor"]
    camera_rgb = plate @ np.array(facts["camera_from_acescg"]).T
    gain = truth["exposures"]["plate/plate_ev0.dng"]["true_s"] * scene.camera.iso / (100 * scene.camera.fnumber**2)
    with rawpy.imread(str(tiny / "plate" / "plate_ev0.dng")) as raw:
        mosaic = raw.raw_image_visible.astype(float)
    black = np.tile(np.reshape(facts["black"], (2, 2)), (36, 48))
    fraction = (mosaic - black) / (facts["white"] - black)
    colour = np.tile([[0, 1], [1, 2]], (36, 48))
    expected = np.take_along_axis(camera_rgb, colour[..., None], 2)[..., 0] * gain
    sane = np.ones((72, 96), bool)
    for hot in facts["hot_pixels"]:
        sane[hot["row"], hot["column"]] = False
    slope, offset = facts["noise_profile"]
    z = (fraction - expected) / np.sqrt(slope * expected + offset + (facts["prnu"] * expected) ** 2)
    # 6872 photosites: mean within 4 / sqrt(N), variance within 4 sqrt(2 / N); half floats add 3e-4
    assert abs(z[sane].mean()) < 0.06
    assert z[sane].var() == pytest.approx(1, abs=0.08)


def test_same_seed_same_bytes(tiny: Path, tmp_path: Path) -> None:
    again = tmp_path / "capture"
    simulate(tiny_toml(tmp_path), again, lambda _: None)
    names = sorted(str(path.relative_to(tiny)) for path in tiny.rglob("*") if path.is_file())
    assert names == sorted(str(path.relative_to(again)) for path in again.rglob("*") if path.is_file())
    assert [name for name in names if digest(tiny / name) != digest(again / name)] == []
    with pytest.raises(ManifestError, match="not empty"):
        simulate(tiny_toml(tmp_path), again, lambda _: None)


def test_more_samples_of_the_change_leave_the_photographs_alone(tiny: Path, tmp_path: Path) -> None:
    """Only the truth's uncovered shadows differ from a capture without them; they can be added to one, bit for bit."""
    plain = tmp_path / "capture"
    simulate(tiny_toml(tmp_path, **{"change = 8192": "change = 0"}), plain, lambda _: None)
    studio, worlds = tiny_worlds(tmp_path)
    names = sorted(str(path.relative_to(tiny)) for path in tiny.rglob("*") if path.is_file())
    differ = [name for name in names if digest(tiny / name) != digest(plain / name)]
    assert differ == ["truth/truth.json", "truth/with_objects.exr"]
    finer, old = (read_exr(f / "truth" / "with_objects.exr").rgb().astype(float) for f in (tiny, plain))
    plate = read_exr(tiny / "truth" / "plate.exr").rgb().astype(float)
    covered = np.sum(list(read_exr(tiny / "truth" / "coverage.exr").channels.values()), 0) > 0
    moved = (finer != old).any(-1)
    assert moved.any()
    assert not moved[covered].any()
    assert (shadow_pixels(old, plate, covered.astype(float)) >= moved).all()
    noise, before = (json.loads((f / "truth" / "truth.json").read_text())["noise"] for f in (tiny, plain))
    assert noise["spp_change"] == 8
    assert noise["object_median_rel"] == before["object_median_rel"]
    assert noise["shadow_median_rel"] > 0
    coverage = np.sum(list(read_exr(plain / "truth" / "coverage.exr").channels.values()), 0)
    added, found = resampled_change(studio, worlds, {"plate": plate, "with_objects": old}, coverage, lambda _: None)
    assert np.array_equal(added.astype(np.float16), finer)
    assert before | found == noise


def tiny_worlds(folder: Path, **changes: str) -> tuple[Studio, tuple[Measure, Measure]]:
    """The tiny scene's plate with and without objects."""
    mi, scene = use_mitsuba(), load_scene(tiny_toml(folder, **changes))
    studio = Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera))
    people, objects = studio.place.photographer(studio.pose(scene.plate)), studio.place.objects()
    filled, plate = (
        path_radiance(mi, studio.place.load(*p), scene.sampling.depth) for p in ((people, objects), (people,))
    )
    return studio, (filled, plate)


def test_resampled_change_is_that_of_path_tracing(tmp_path: Path) -> None:
    """Given pictures that are wrong by a known change everywhere, the new samples bring the path-traced change."""
    studio, worlds = tiny_worlds(tmp_path, **{"change = 8192": "change = 32"})
    rays = camera_rays(studio.mi, studio.lens, studio.pose(studio.scene.plate))
    filled, plate = (picture(studio.mi, rays, world, (72, 96), 64, 64, 7) for world in worlds)
    coverage = np.zeros((72, 96))
    wrong = {"plate": 0 * plate + 64.0, "with_objects": 0 * plate + 32.0}  # half floats hold both exactly
    truth, found = resampled_change(studio, worlds, wrong, coverage, lambda _: None)
    assert found["spp_change"] == 32
    share = 32 / (32 + 8)
    new = (truth - 32.0) / share - 32.0
    error = (new - blur(filled - plate, studio.scene.camera.blur_sigma_px)).mean(-1)
    # the blur over three pixels doubles the error of the mean at most
    assert abs(error.mean()) < 4 * 2 * error.std() / np.sqrt(error.size)
    assert np.abs(new.mean()) > 10 * 2 * error.std() / np.sqrt(error.size)  # so that the line above says something


def test_board_is_not_mirrored_and_lies_where_the_pose_says() -> None:
    """OpenCV finds the print in the rendered plate, and its corners fall where pose and lens put them."""
    cv2 = pytest.importorskip("cv2")

    mi, scene = use_mitsuba(), desk_scene()
    flat = scene.model_copy(
        update={"light": LightFacts(**FLAT), "table": scene.table.model_copy(update={"texel_m": 0.004})}
    )  # fmt: skip
    place = Place(mi, flat)
    lens = capture.lens_of(scene.camera)
    pose = look_at(np.array(scene.plate.position_m), np.array(scene.plate.target_m))
    pixels = picture(mi, camera_rays(mi, lens, pose), path_radiance(mi, place.load(), 2), (768, 1024), 4, 4, 1)
    grey = np.clip(255 * pixels.mean(-1) ** (1 / 2.2), 0, 255).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((7, 5), 0.030, 0.022, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    assert len(ids) == 24
    world = transform_points(WORLD_FROM_BOARD, board.getChessboardCorners()[ids.ravel()].astype(float))
    expected = lens.project(transform_points(invert_rigid(pose), world))
    error = corners.reshape(-1, 2) + 0.5 - expected
    # OpenCV's corner refinement scatters by 0.1 to 0.2 px on small squares; a bias would be ours
    assert np.abs(error.mean(0)).max() < 0.1
    assert np.sqrt((error**2).sum(1).mean()) < 0.3


def test_white_furnace_shows_the_albedo() -> None:
    """Under a constant room of radiance one a flat diffuse table has the radiance of its albedo, everywhere."""

    mi, scene = use_mitsuba(), desk_scene()
    flat = scene.model_copy(
        update={"light": LightFacts(**FLAT), "table": scene.table.model_copy(update={"texel_m": 0.004})}
    )  # fmt: skip
    place = Place(mi, flat)
    lens = Lens(64, 48, 72.0, 72.0, 32.0, 24.0, LENS.distortion)
    rays = camera_rays(mi, lens, look_at(np.array(scene.plate.position_m), np.array(scene.plate.target_m)))
    seen = picture(mi, rays, path_radiance(mi, place.load(), 4), (48, 64), 64, 64, 1)
    albedo = picture(
        mi, rays, surface_albedo(mi, place.load(), list(place.table_and_prints().values())), (48, 64), 64, 64, 1
    )
    assert (albedo[..., 3] == 1).all()
    # the room is sampled with a relative scatter of at most 0.6 per sample: 3072 pixels x 64 samples
    assert (seen.mean((0, 1)) / albedo[..., :3].mean((0, 1))).tolist() == pytest.approx(
        [1, 1, 1], abs=4 * 0.6 / np.sqrt(3072 * 64)
    )


def test_calibration_photographs_show_the_board() -> None:
    scene = desk_scene()
    lens = capture.lens_of(scene.camera)
    board = scene.board
    assert board is not None
    grid = [[(i + 1) * board.square_m, 0.0, (j + 1) * board.square_m] for j in range(4) for i in range(6)]
    assert len(scene.calibration) == 10
    for photo in scene.calibration:
        pixels = lens.project(transform_points(invert_rigid(board_pose(scene, lens, photo)), np.array(grid)))
        inside = ((pixels > 8) & (pixels < (lens.width - 8, lens.height - 8))).all(1)
        assert inside.sum() >= 12
