"""Probes that are no mirror ball, on closed forms: round trip, six directions, constant worlds, energy, exposure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from command import DESK, command
from mirror_scene import Place, look_at, photograph

from pipeline.camera.lens import project
from pipeline.camera.rigid import rotation_exp, rotation_log
from pipeline.conventions import (
    direction_from_latlong,
    latlong_directions,
    latlong_from_direction,
    latlong_solid_angles,
)
from pipeline.image.colour import convert
from pipeline.light.environment import AXES, irradiance, resize_environment, total_energy
from pipeline.probes import combine, fisheye, map_scale, orientation
from pipeline.probes.kinds import KINDS
from pipeline.probes.observation import Grid, Observation, Shots
from pipeline.probes.ready_made import rotation_of
from pipeline.run import formats
from pipeline.run.errors import ArtifactError, CaptureError
from pipeline.run.manifest import BALL_KINDS, PROBE_KINDS, CaptureFacts, load_capture
from pipeline.types import Camera, Raster, View
from stages import knobs, probe

GRID = Grid(64)
BOARD = {"dictionary": "DICT_5X5_100", "squares": [7, 5], "square_m": 0.03, "marker_m": 0.022, "legacy": False}
EYE = np.array([0.0, 0.12, 0.0])  # where the light is measured in the synthetic place


def wallpaper(height: int = 512, patches: int = 900) -> np.ndarray:
    """RGB (H, 2H, 3) of a far room: hard-edged patches of every size and colour, so that pictures have features."""
    rng = np.random.default_rng(0)
    rgb = np.ones((height, 2 * height, 3))
    for row, column, tall, wide in rng.integers((0, 0, 3, 3), (height, 2 * height, 60, 90), (patches, 4)):
        rgb[row : row + tall, column : column + wide] *= rng.uniform(0.5, 1.7, 3)
    return np.clip(rgb, 0.1, 6.0)


WALLPAPER = wallpaper()


def room(w: np.ndarray) -> np.ndarray:
    """RGB (N, 3) of the wallpaper in directions (N, 3): texels of constant radiance."""
    u, v = latlong_from_direction(w)
    height, width = WALLPAPER.shape[:2]
    return WALLPAPER[np.minimum((v * height).astype(int), height - 1), (u * width).astype(int) % width]


ROOM = Place(room, plane=True, ball=None)
CAMERA = Camera(width=300, height=225, fx=190, fy=190, cx=151, cy=110, distortion=np.array([-0.05, 0.01, 0, 0, 0]))
POSE = look_at((0.3, 0.45, 0.7), (0.1, 0.4, 0.0))


def raster(picture: np.ndarray) -> Raster:
    channels = {**Raster.split(np.float32(picture)), **Raster.split(np.float32(1e-6 + 0 * picture), "variance")}
    return Raster(channels | {"mask": np.zeros(picture.shape[:2], np.uint32)}, "acescg")


@pytest.fixture(scope="module")
def plate() -> Raster:
    return raster(photograph(ROOM, CAMERA, POSE, 3))


def latlong_of(place: Place, eye: np.ndarray, height: int, split: int = 2) -> np.ndarray:
    w = latlong_directions(height * split, 2 * height * split).reshape(-1, 3)
    rgb = place.radiance(np.broadcast_to(eye, w.shape), w)
    return resize_environment(rgb.reshape(height * split, 2 * height * split, 3), height, 2 * height)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return latlong_of(ROOM, EYE, 128)


def facts(kind: str, board: bool = False, **stated: Any) -> dict[str, Any]:
    """Facts of a kind as ingest writes them, defaults and all."""
    model = PROBE_KINDS[kind].model_validate({"kind": kind, **stated.pop("facts", {}), **stated})
    return {"probe": model.model_dump(mode="json"), "ball": [], "board": BOARD if board else None}


def shots(of: dict[str, Any], plate: Raster | None = None, **photographs: Raster) -> Shots:
    empty = raster(np.ones((CAMERA.height, CAMERA.width, 3)))
    view = View(world_from_camera=POSE, covariance=np.eye(6) * 1e-8, route="given", rms_px=0.1, points=20)
    return Shots(
        of, {"plate": plate or empty, **photographs}, CAMERA, {"plate": view, **dict.fromkeys(photographs, view)}
    )


def mapped(folder, rgb: np.ndarray, stored: str = "acescg", kind: str = "map", **stated: Any) -> dict[str, Any]:
    """Facts of a map that was written to a folder."""
    path = folder / "light.exr"
    formats.write_exr(path, Raster(Raster.split(np.float32(rgb)), stored))
    found = facts(kind, stated.pop("board", False), facts={"file": path.name} | stated)
    found["probe"]["path"] = str(path)
    return found


def seen(folder, rgb: np.ndarray, plate: Raster | None = None, grid: Grid = GRID, **stated: Any) -> Observation:
    """What the kind ``map`` makes of a picture."""
    return KINDS["map"].observe(shots(mapped(folder, rgb, **stated), plate), grid)


def lamp_map(direction: np.ndarray, height: int = 64) -> np.ndarray:
    """A dark world with one bright texel where ``direction`` points."""
    w = latlong_directions(height, 2 * height)
    rgb = np.full((height, 2 * height, 3), 1e-6)
    rgb[np.unravel_index((w @ direction).argmax(), w.shape[:2])] = 1e4
    return rgb


# ---- a ready-made map ------------------------------------------------------------------------------------------------


def test_every_kind_has_facts_and_a_class():
    assert set(PROBE_KINDS) == set(KINDS)
    assert set(BALL_KINDS) < set(KINDS)


def test_map_comes_back_as_it_was(tmp_path, truth):
    small = np.float32(resize_environment(truth, 32, 64))
    found = seen(tmp_path, small, scale=1.0).maps["map"]
    assert np.array_equal(np.float32(found.rgb), small)
    assert found.coverage.min() == 1
    assert (found.variance > 0).all()


@pytest.mark.parametrize("axis", range(6))
def test_lamp_is_where_the_rotation_puts_it(tmp_path, axis):
    rotation = rotation_of(37.0, np.array([0.2, 0.9, -0.3]))
    found = seen(tmp_path, lamp_map(AXES[axis]), scale=1.0, yaw_deg=37.0, up=[0.2, 0.9, -0.3]).maps["map"].rgb
    row, column = np.unravel_index(found.sum(-1).argmax(), found.shape[:2])
    there = direction_from_latlong((column + 0.5) / 64, (row + 0.5) / 32)
    assert np.degrees(np.arccos(there @ rotation @ AXES[axis])) < 6  # a texel of the grid


def test_yaw_is_counter_clockwise_seen_from_above_and_up_is_up():
    assert rotation_of(90.0, AXES[2]) @ [0, 0, 1] == pytest.approx([1, 0, 0], abs=1e-12)
    for up in (*AXES, np.array([0.3, -0.8, 0.2])):
        found = rotation_of(25.0, up)
        assert found @ (up / np.linalg.norm(up)) == pytest.approx([0, 1, 0], abs=1e-12)
        assert found @ found.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(found) == pytest.approx(1)


def test_constant_world_stays_constant_whatever_the_turn(tmp_path):
    found = seen(tmp_path, np.full((50, 100, 3), 0.7), scale=2.0, yaw_deg=33.0, up=[0.5, 0.5, 0.1]).maps["map"]
    assert found.rgb == pytest.approx(1.4, rel=1e-5)  # float32 sums


@pytest.mark.parametrize("height", [16, 64, 256])  # half, twice and eight times the grid
def test_energy_of_a_lamp_of_one_texel_is_kept(tmp_path, height):
    # 2 %: over 40 lamps and turns the worst was 1.5 %, the mean 0.2 %
    for seed in range(4):
        rng = np.random.default_rng(seed)
        lamp = lamp_map(rng.normal(size=3), height)
        found = seen(tmp_path, lamp, scale=1.0, yaw_deg=rng.uniform(-180, 180), up=rng.normal(size=3).tolist())
        assert total_energy(found.maps["map"].rgb) == pytest.approx(total_energy(lamp), rel=0.02)


def test_colours_follow_the_file_and_the_manifest(tmp_path):
    rgb = np.broadcast_to(np.float32([0.9, 0.4, 0.1]), (8, 16, 3))
    in_acescg = convert(np.array([0.9, 0.4, 0.1]), "linear_rec709", "acescg")
    path = tmp_path / "light.exr"
    for attributes, stated, expected in (
        ({}, {}, in_acescg),
        ({"chromaticities": formats.REC709_CHROMATICITIES}, {}, in_acescg),
        ({"chromaticities": formats.AP1_CHROMATICITIES}, {}, [0.9, 0.4, 0.1]),
        ({"chromaticities": formats.AP1_CHROMATICITIES}, {"space": "linear_rec709"}, in_acescg),
        ({"chromaticities": (0.641, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)}, {}, in_acescg),
    ):
        found = mapped(tmp_path, rgb, scale=1.0, **stated)
        header = {"insitu:space": "unknown", **attributes}
        formats.write_exr(path, Raster(Raster.split(rgb), "unknown", header))
        drop_space(path, attributes)
        view = KINDS["map"].observe(shots(found), GRID).maps["map"]
        assert view.rgb[16, 32] == pytest.approx(np.asarray(expected), rel=5e-3)  # the last primaries differ by 0.001


def drop_space(path, attributes: dict[str, Any]) -> None:
    """Write the file again as other programs do, without our attribute."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    OpenEXR.File({"type": OpenEXR.scanlineimage, **attributes}, channels).write(str(path))


def radiance_bytes(rgb: np.ndarray, *lines: str) -> bytes:
    """A flat (not run-length coded) Radiance picture with further header lines."""
    mantissa, exponent = np.frexp(rgb.max(-1))
    code = np.concatenate([rgb * (mantissa * 256 / rgb.max(-1))[..., None], exponent[..., None] + 128], -1)
    head = ["#?RADIANCE", *lines, "FORMAT=32-bit_rle_rgbe", "", f"-Y {rgb.shape[0]} +X {rgb.shape[1]}", ""]
    return "\n".join(head).encode() + code.astype(np.uint8).tobytes()


def test_radiance_files_are_read_to_their_last_bit(tmp_path):
    rgb = np.random.default_rng(0).gamma(1, 1.0, (8, 16, 3)) + 1e-3
    path = tmp_path / "a.hdr"
    lines = "EXPOSURE=4", "EXPOSURE=0.5", "PRIMARIES=0.713 0.293 0.165 0.83 0.128 0.044 0.32168 0.33767"
    path.write_bytes(radiance_bytes(rgb, *lines))
    found = formats.read_latlong(path)
    assert np.abs(found.rgb() - rgb).max() <= rgb.max() / 128
    assert found.attributes["exposure"] == 2
    assert found.space == "acescg"


def test_damaged_and_misshapen_maps_are_refused_in_one_line(tmp_path):
    rgb, path = np.ones((8, 16, 3)), tmp_path / "a.hdr"
    whole = radiance_bytes(rgb)
    for content, said in (
        (whole[:-40], "cut off or damaged"), (b"hello", "cut off or damaged"),
        (radiance_bytes(rgb[:, :12]), "twice as wide as high"), (radiance_bytes(rgb, "EXPOSURE=dim"), "no number"),
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(ArtifactError, match=said) as caught:
            formats.read_latlong(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(CaptureError, match="no texel is positive"):
        seen(tmp_path, np.zeros((8, 16, 3)))


def test_texels_that_are_no_light_are_counted_and_not_believed(tmp_path):
    rgb = np.ones((32, 64, 3))
    rgb[3, 5], rgb[20, 30, 1], rgb[10, 10] = np.nan, np.inf, -2.0
    found = seen(tmp_path, rgb, scale=1.0)
    counts = found.numbers["map"]
    assert (counts["nan_texels"], counts["infinite_texels"], counts["negative_texels"]) == (1, 1, 1)
    view = found.maps["map"]
    assert view.coverage[3, 5] == 0
    assert view.clipped[20, 30] == 1
    assert view.rgb.min() == 0
    assert np.isfinite(view.rgb).all()
    assert len([text for text in found.warnings if "texels are" in text]) == 3


def test_plateau_is_pointed_at_and_the_stated_limit_marks_it(tmp_path):
    rgb = np.ones((32, 64, 3))
    rgb[4, 4:10] = 50
    assert any("probe.clipped_at = 50" in text for text in seen(tmp_path, rgb, scale=1.0).warnings)
    assert seen(tmp_path, rgb, scale=1.0, clipped_at=50).maps["map"].clipped.sum() == 6


# ---- its scale -------------------------------------------------------------------------------------------------------


def test_scale_from_what_plate_and_map_both_see(tmp_path, plate, truth):
    for factor in (1.0, 0.5):  # the plate in another unit than the map
        found = seen(tmp_path, truth * factor, plate, Grid(256), position_m=EYE.tolist())
        scale = found.numbers["scale"]
        assert scale["route"] == "plate"
        # three standard deviations of what it says itself: 1 % and the spread over the cells
        assert scale["factor"][0] == pytest.approx(1 / factor, rel=3 * scale["sigma_rel_shared"])
        assert scale["sigma_rel_shared"] < 0.03


def test_another_white_balance_is_taken_off(tmp_path, plate, truth):
    gains = np.array([1.3, 1.0, 0.7])
    found = seen(tmp_path, truth * gains, plate, Grid(256), position_m=EYE.tolist())
    assert np.array(found.numbers["scale"]["factor"]) * gains == pytest.approx(1, rel=0.03)
    assert any("colours differ" in text for text in found.warnings)


def test_map_of_another_place_is_not_levelled_by_what_it_does_not_see(tmp_path, plate):
    strange = np.random.default_rng(1).lognormal(0, 1.2, (64, 128, 3))
    found = seen(tmp_path, strange, plate, Grid(256), position_m=EYE.tolist())
    assert found.numbers["scale"]["route"] == "unknown"
    assert any("do not see the same things" in text for text in found.warnings)
    assert any("NOTHING SAYS HOW BRIGHT" in text for text in found.warnings)
    assert found.numbers["scale"]["sigma_rel_shared"] == 1


def test_stated_scale_is_believed_and_the_plate_may_object(tmp_path, plate, truth):
    found = seen(tmp_path, truth, plate, Grid(256), position_m=EYE.tolist(), scale=2.0)
    assert found.numbers["scale"]["factor"] == [2, 2, 2]
    assert any("but the plate says" in text for text in found.warnings)


@pytest.mark.parametrize("route", ["plane_albedo", "paper"])
def test_scale_from_a_surface_of_known_albedo(tmp_path, route):
    # A diffuse plane under a map of 3 units: the plate shows albedo E / pi, exactly, so only the albedo is unsure.
    albedo = map_scale.PAPER_ALBEDO if route == "paper" else 0.4
    light = np.full((16, 32, 3), 0.25)
    radiance = albedo * irradiance(resize_environment(light * 12, 32, 64), AXES[2:3])[0] / np.pi
    plate = raster(np.broadcast_to(radiance, (CAMERA.height, CAMERA.width, 3)))
    stated = {"board": True} if route == "paper" else {"plane_albedo": 0.4}
    scale = seen(tmp_path, light, plate, **stated).numbers["scale"]
    assert scale["route"] == route
    assert scale["factor"] == pytest.approx([12, 12, 12], rel=1e-4)
    assert scale["sigma_rel_shared"] == pytest.approx(0.09 if route == "paper" else 0.1)


def test_shared_error_of_the_scale_is_told_apart_from_that_of_texels(tmp_path, plate):
    stated = mapped(tmp_path, np.full((32, 64, 3), 2.0), scale=1.0, scale_sigma_rel=0.2, sigma_rel=0.0)
    found = KINDS["map"].observe(shots(stated), GRID)
    assert found.scale_sigma == 0.2
    assert np.sqrt(found.maps["map"].variance.max()) < 0.01  # the file's eight bits
    variance = stage_on(stated, plate)[1].outputs["environment"].rgb("variance")
    assert np.sqrt(variance[:28]) == pytest.approx(0.4, rel=1e-3)  # above the plane that the plate lays


# ---- a panorama ------------------------------------------------------------------------------------------------------


def panorama(rotation: np.ndarray, height: int = 256, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    """The room from EYE as a camera turned by ``rotation`` (world_from_map) stitches it, in another unit, noisy."""
    w = latlong_directions(2 * height, 4 * height).reshape(-1, 3) @ rotation.T
    rgb = ROOM.radiance(np.broadcast_to(EYE, w.shape), w).reshape(2 * height, 4 * height, 3)
    rgb = resize_environment(rgb, height, 2 * height)
    return 0.4 * rgb * (1 + noise * np.random.default_rng(seed).normal(size=rgb.shape))


@pytest.mark.parametrize("seed", [0, 3])
def test_panorama_is_turned_by_what_the_plate_shows(tmp_path, plate, seed):
    rng = np.random.default_rng(seed)
    rotation = rotation_of(rng.uniform(-180, 180), np.array([0.05 * rng.normal(), 1.0, 0.03]))
    found = mapped(tmp_path, panorama(rotation, seed=seed), kind="panorama", position_m=EYE.tolist())
    numbers = KINDS["panorama"].observe(shots(found, plate), GRID).numbers
    error = rotation_log(np.array(numbers["orientation"]["world_from_map"]) @ rotation.T)
    # three standard deviations of what it says; eight other turns and noises had 0.03 to 1.1 as chi2 of three
    assert np.degrees(np.linalg.norm(error)) < 3 * np.sqrt(3) * numbers["orientation"]["sigma_deg"]
    assert numbers["orientation"]["sigma_deg"] < 0.15
    assert numbers["scale"]["route"] == "plate"
    assert numbers["scale"]["factor"][1] == pytest.approx(2.5, rel=3 * numbers["scale"]["sigma_rel_shared"])


def test_panorama_without_anything_in_common_asks_for_a_click(tmp_path, plate):
    strange = np.random.default_rng(0).gamma(1, 1, (64, 128, 3))
    with pytest.raises(CaptureError, match=r"click one lamp or corner in both|needed 8"):
        KINDS["panorama"].observe(shots(mapped(tmp_path, strange, kind="panorama"), plate), GRID)


def test_tones_turn_a_panorama_that_is_too_blurred_for_features(tmp_path, plate):
    for yaw in (-70.0, 151.0):
        blurred = resize_environment(panorama(rotation_of(yaw, AXES[2])), 32, 64)
        found = mapped(tmp_path, blurred, kind="panorama", position_m=EYE.tolist())
        told = KINDS["panorama"].observe(shots(found, plate), GRID).numbers["orientation"]
        assert told["route"] == "tones"
        error = rotation_log(np.array(told["world_from_map"]) @ rotation_of(yaw, AXES[2]).T)
        assert np.degrees(np.linalg.norm(error)) < 3 * told["sigma_deg"]  # half a texel of 2.8 degrees, and up


def test_a_clicked_lamp_and_up_turn_the_panorama(tmp_path):
    rotation = rotation_of(-140.0, np.array([0.0, 1.0, 0.0]))
    lamp = np.array([0.5, 0.6, -0.4]) / np.linalg.norm([0.5, 0.6, -0.4])
    u, v = latlong_from_direction(rotation.T @ lamp)
    px = [float(u * 128), float(v * 64)]
    on_plate = project(CAMERA, (POSE[:3, :3].T @ np.array([0.05, 0.1, -1.0]))[None])[0]
    u, v = latlong_from_direction(rotation.T @ np.array([0.05, 0.1, -1.0]))
    for point in ({"px": px, "direction": (3 * lamp).tolist()}, {"px": px, "world_m": (EYE + 2 * lamp).tolist()},
                  {"px": [float(u * 128), float(v * 64)], "plate_px": on_plate.tolist()}):  # fmt: skip
        found = mapped(tmp_path, np.ones((64, 128, 3)), kind="panorama", position_m=EYE.tolist(), point=[point])
        told = KINDS["panorama"].observe(shots(found), GRID).numbers["orientation"]
        assert np.array(told["world_from_map"]) == pytest.approx(rotation, abs=1e-6)
        assert told["sigma_deg"] > 3  # three pixels of 2.8 degrees


def test_clicks_that_contradict_each_other_raise_the_uncertainty():
    up, sigma = np.array([0.0, 1, 0]), np.full(2, 0.01)
    one = AXES[[0, 4]]
    good = orientation.from_points(one, one, sigma, up, 0.01)
    off = orientation.from_points(one, one @ rotation_exp(np.array([0, 0.3, 0])) * [[1], [0]] + one * [[0], [1]],
                                  sigma, up, 0.01)  # fmt: skip
    assert off.sigma_rad > 5 * good.sigma_rad


def test_spots_on_the_plane_turn_a_picture_that_was_taken_elsewhere():
    """Directions of the same spots of the plane from two places: only their second reading agrees."""
    rng = np.random.default_rng(0)
    spots = np.stack([rng.uniform(-0.5, 0.5, 60), np.zeros(60), rng.uniform(-0.5, 0.5, 60)], -1)
    eye, centre, rotation = POSE[:3, 3], EYE, rotation_of(50.0, np.array([0.1, 1.0, 0.0]))

    def directions(origin: np.ndarray) -> np.ndarray:
        return (spots - origin) / np.linalg.norm(spots - origin, axis=1, keepdims=True)

    local = directions(centre) @ rotation
    local[40:] = rng.permutation(local[40:])  # a third is wrong
    found = orientation.robust(local, directions(eye), directions(centre), np.arange(60))
    assert np.linalg.norm(rotation_log(found.rotation @ rotation.T)) < 1e-9
    assert found.numbers["on_plane"] >= 40
    wrong = orientation.robust(local, directions(eye), np.full((60, 3), np.nan), np.arange(60))
    assert wrong is None or wrong.numbers["agree"] < 40


def test_wahba_is_as_sure_as_it_says():
    # 300 trials: the mean of chi2 over three degrees of freedom has a standard error of 0.14
    rng, sigma = np.random.default_rng(1), 0.01
    world = rng.normal(size=(20, 3)) * [1, 0.3, 1]
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    information = np.linalg.inv(orientation.rotation_covariance(world, np.full(20, sigma)))
    chi2 = []
    for _ in range(300):
        seen = world + sigma * rng.normal(size=world.shape)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        error = rotation_log(orientation.wahba(seen, world, np.ones(20)))
        chi2.append(error @ information @ error)
    assert np.mean(chi2) == pytest.approx(3, abs=0.5)


def test_nadir_is_not_believed_and_the_plane_is_laid_there(tmp_path, plate):
    tripod = panorama(np.eye(3), noise=0)
    tripod[latlong_directions(*tripod.shape[:2])[..., 1] < -np.cos(np.radians(14))] = 1e3
    told = {"position_m": EYE.tolist(), "yaw_deg": 0.0}
    found = mapped(tmp_path, tripod, kind="panorama", **told)
    view = KINDS["panorama"].observe(shots(found, plate), GRID).maps["panorama"]
    assert (view.coverage[-2:] == 0).all()
    assert view.coverage[:28].min() == 1
    light, _ = stage_on(found, plate)
    assert light.max() < 2 * WALLPAPER.max()
    believed = found | {"probe": found["probe"] | {"nadir_deg": 0.0}}
    assert KINDS["panorama"].observe(shots(believed, plate), GRID).maps["panorama"].rgb.max() > 100


# ---- fisheye photographs ---------------------------------------------------------------------------------------------

LENS = {"fov_deg": 200.0, "radius_px": 90.0, "centre_px": (92.0, 91.0)}  # a pixel is 1.1 degrees
FINE = {"fov_deg": 200.0, "radius_px": 150.0, "centre_px": (152.0, 151.0)}


def fisheye_picture(lens: dict[str, Any], rotation: np.ndarray, light) -> np.ndarray:
    """(size, size, 3) by the inverse of the projection, 3 x 3 rays a pixel; black outside the image circle."""
    size = int(2 * lens["centre_px"][0])
    steps = (np.arange(3 * size) + 0.5) / 3
    y, x = np.meshgrid(steps - lens["centre_px"][1], steps - lens["centre_px"][0], indexing="ij")
    half, r = np.radians(lens["fov_deg"]) / 2, np.hypot(x, y) / lens["radius_px"]
    theta = {
        "equidistant": r * half, "equisolid": 2 * np.arcsin(np.minimum(r * np.sin(half / 2), 1)),
        "stereographic": 2 * np.arctan(r * np.tan(half / 2)),
    }[lens["projection"]]  # fmt: skip
    phi = np.arctan2(y, x)
    ray = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    rgb = light(ray @ rotation.T) * (r.ravel() < 1)[:, None]
    return rgb.reshape(size, 3, size, 3, 3).mean((1, 3))


def pair(
    folder, light, gains=(1.0, 1.0), turns=((30.0, 0.0, 0.0), (-150.0, 4.0, 10.0)), **stated: Any
) -> dict[str, Any]:
    """Facts of two fisheye pictures, written to a folder; ``turns``: their yaw, pitch, roll in degrees."""
    projection, optics = stated.pop("projection", "equidistant"), stated.pop("optics", LENS)
    lenses = []
    for number, (yaw, pitch, roll) in enumerate(turns):
        lens = optics | {"name": f"eye_{number}", "file": f"{number}.exr", "projection": projection}
        held = {"yaw_deg": yaw, "pitch_deg": pitch, "roll_deg": roll}
        picture = gains[number] * fisheye_picture(lens, fisheye.rotation_of(held), light)
        formats.write_exr(folder / lens["file"], Raster(Raster.split(np.float32(picture)), "acescg"))
        lenses.append(lens | (held if number not in stated.get("hidden", ()) else {}))
    stated.pop("hidden", None)
    found = facts("fisheye_pair", fisheye=lenses, position_m=EYE.tolist(), **stated)
    for lens in found["probe"]["fisheye"]:
        lens["path"] = str(folder / lens["file"])
    return found


def around(w: np.ndarray) -> np.ndarray:
    """The place as seen from EYE in directions (N, 3)."""
    return ROOM.radiance(np.broadcast_to(EYE, w.shape), w)


@pytest.mark.parametrize("projection", ["equidistant", "equisolid", "stereographic"])
def test_two_fisheyes_make_the_whole_sphere(tmp_path, projection):
    def smooth(w: np.ndarray) -> np.ndarray:
        return 1 + 0.4 * w + 0.2 * w[:, :1] * w[:, 1:2]

    found = KINDS["fisheye_pair"].observe(shots(pair(tmp_path, smooth, projection=projection, scale=1.0)), GRID)
    merged = combine.merge(list(found.maps.values()))
    assert merged.seen.min() > 0.95  # texels cut by the rim of one photograph
    w = latlong_directions(32, 64)
    # 1 %: a texel of 5.6 degrees differs from its centre by 0.1 %
    assert merged.rgb == pytest.approx(smooth(w.reshape(-1, 3)).reshape(w.shape), rel=0.01)
    assert found.numbers["seams"]["overlap_sr"] == pytest.approx(4 * np.pi * np.sin(np.radians(10)), rel=0.1)
    assert found.numbers["seams"]["disagreement_median_rel"]["0-1"] < 2e-3


@pytest.mark.parametrize("axis", range(6))
def test_fisheye_shows_a_lamp_where_it_is(tmp_path, axis):
    def lamp(w: np.ndarray) -> np.ndarray:
        return np.where((w @ AXES[axis] > np.cos(0.06))[:, None], 100.0, 0.01) * np.ones(3)

    found = KINDS["fisheye_pair"].observe(shots(pair(tmp_path, lamp, scale=1.0)), Grid(128))
    merged = combine.merge(list(found.maps.values())).rgb
    seen_at = (latlong_directions(64, 128) * (merged[..., :1] - 0.01) * latlong_solid_angles(64, 128)[..., None]).sum(
        (0, 1)
    )
    assert np.degrees(np.arccos(seen_at @ AXES[axis] / np.linalg.norm(seen_at))) < 0.5  # half a pixel
    true = 100 * 2 * np.pi * (1 - np.cos(0.06)) + 0.01 * 4 * np.pi
    # 3 %: 3 x 3 rays a pixel cut the rim of a lamp of 6 pixels across
    assert total_energy(merged)[1] == pytest.approx(true, rel=0.03)


def test_fisheyes_of_unequal_exposure_and_unknown_rotation(tmp_path, plate):
    """The first is turned by the plate's features, the second by those of the overlap; exposures are made equal."""
    turns = ((190.0, 0.0, 0.0), (10.0, 0.0, 0.0))  # the first looks where the plate does
    given = pair(tmp_path, around, (0.5, 0.8), turns, hidden=(0, 1), optics=FINE)
    found = KINDS["fisheye_pair"].observe(shots(given, plate), GRID)
    for number, route in enumerate(("features", "overlap")):
        told = found.numbers[f"eye_{number}"]
        held = dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), turns[number], strict=True))
        error = rotation_log(np.array(told["world_from_camera"]) @ fisheye.rotation_of(held).T)
        assert told["route"] == route
        assert np.degrees(np.linalg.norm(error)) < 3 * np.sqrt(3) * told["sigma_deg"]
    assert found.numbers["seams"]["exposure_over_first"][1] == pytest.approx(1.6, rel=0.05)
    scale = found.numbers["scale"]
    assert scale["factor"][1] == pytest.approx(2.0, rel=3 * scale["sigma_rel_shared"])


def test_stage_takes_a_fisheye_pair(tmp_path, plate, truth):
    found, result = stage_on(pair(tmp_path, around), plate)
    expected = resize_environment(truth, 64, 128)
    # 4 %: 3 sigma of the scale's 1 %, and pixels of 1.1 degrees
    assert irradiance(found, AXES) == pytest.approx(irradiance(expected, AXES), rel=0.04)
    assert result.numbers["seen_fraction"] > 0.99


# ---- the manifest ----------------------------------------------------------------------------------------------------

HEAD = 'name = "k"\n[plate]\nfiles = ["a.dng"]\n[camera]\ngiven = { fx = 1.0 }\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[probe]\nkind = "mapp"\n', r"toml:6: probe\.kind: is 'mapp'; expected one of mirror_ball, "),
        ('[probe]\nkind = "map"\n', r"toml:6: probe\.file: missing"),
        ('[probe]\nkind = "map"\nfil = "a.hdr"\n', r"toml:8: probe\.fil: unknown key; did you mean file\?"),
        ('[probe]\nkind = "map"\nfile = "a.hdr"\nclipped_at = -1\n', r"toml:9: probe\.clipped_at: is -1"),
        ('[probe]\nkind = "map"\nfile = "a.hdr"\nup = [0, 0, 0]\n', "up is"),
        ("[probe]\ndiameter_m = 0.1\n", "mirror_ball needs at least one"),
        ('[[ball]]\nname = "b"\nfiles = ["b"]\n[probe]\nkind = "map"\nfile = "a.hdr"\n', "looks at no ball"),
    ],
)
def test_manifest_names_the_line_and_the_kind(tmp_path, text, said):
    (tmp_path / "capture.toml").write_text(HEAD + text)
    with pytest.raises(Exception, match=said):
        load_capture(tmp_path)


def test_probe_without_a_kind_is_a_mirror_ball():
    given = {"name": "k", "plate": {"files": ["a"]}, "camera": {"given": {"fx": 1.0}}}
    found = CaptureFacts.model_validate(given | {"ball": [{"name": "b", "files": ["b"]}], "probe": {"diameter_m": 0.1}})
    assert found.probe.kind == "mirror_ball"


# ---- from photographs to the light -----------------------------------------------------------------------------------


def stage_on(of: dict[str, Any], plate: Raster, **photographs: Raster) -> tuple[np.ndarray, Any]:
    """The whole stage on arrays: the environment's radiance (H, W, 3), and its result."""
    given = shots(of, plate, **photographs)
    result = probe.compute(of, given.photographs, given.camera, given.views, {}, knobs.Probe(width=128, supersample=2))
    return result.outputs["environment"].rgb(), result


def test_stage_takes_a_map(tmp_path, plate, truth):
    found, result = stage_on(mapped(tmp_path, truth, position_m=EYE.tolist()), plate)
    expected = resize_environment(truth, 64, 128)
    # 3 %: the scale is good to 1 %, the plane is laid from pixels of 0.3 degrees
    assert irradiance(found, AXES) == pytest.approx(irradiance(expected, AXES), rel=0.03)
    assert result.outputs["balls"] == {}


def test_capture_with_a_map_instead_of_balls_gives_the_true_light(tmp_path):
    """The desk's plate with the true environment as a file: every stage up to the lights, by the command."""
    text = (DESK / "capture.toml").read_text()
    start, end = text.index("[[ball]]"), text.index("[board]")
    told = '[probe]\nkind = "map"\nfile = "truth/environment.exr"\nposition_m = [0.31, 0.04, 0.115]\n\n'
    text = f'root = "{DESK}"\n' + text[:start].replace('truth = "truth/truth.json"', "") + told + text[end:]
    (tmp_path / "capture.toml").write_text(text)
    done = command("run", tmp_path, "--out", tmp_path / "build", "--quality", "draft", "--upto", "reflectance")
    assert done.returncode == 0, done.stderr
    found = formats.read_exr(tmp_path / "build/probe/environment.exr").rgb()
    true = formats.read_exr(DESK / "truth/environment.exr").rgb()
    ours, expected = (
        irradiance(resize_environment(found, 64, 128), AXES),
        irradiance(resize_environment(true, 64, 128), AXES),
    )
    # 3 %: three standard deviations of the scale's 1 %
    assert ours == pytest.approx(expected, rel=0.03)
