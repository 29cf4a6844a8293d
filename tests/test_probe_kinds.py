"""A ready-made map as the probe, and what all kinds share: facts, scale, a capture without balls."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import DESK, command
from lit_room import CAMERA, EYE, GRID, lamp_map, mapped, raster, room_light, room_plate, seen, shots, stage_on

from pipeline.conventions import (
    direction_from_latlong,
)
from pipeline.image.colour import convert
from pipeline.light.environment import AXES, irradiance, resize_environment, total_energy
from pipeline.probes import map_scale
from pipeline.probes.kinds import KINDS
from pipeline.probes.observation import Grid
from pipeline.probes.ready_made import clean, rotation_of
from pipeline.probes.resample import turned
from pipeline.run import formats
from pipeline.run.errors import ArtifactError, CaptureError
from pipeline.run.manifest import BALL_KINDS, PROBE_KINDS, CaptureFacts, load_capture
from pipeline.types import Raster

# ---- a ready-made map ------------------------------------------------------------------------------------------------


def test_every_kind_has_facts_and_a_class():
    assert set(PROBE_KINDS) == set(KINDS)
    assert set(BALL_KINDS) < set(KINDS)


def test_map_comes_back_as_it_was(tmp_path):
    small = np.float32(resize_environment(room_light(), 32, 64))
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


def test_scale_from_what_plate_and_map_both_see(tmp_path):
    for factor in (1.0, 0.5):  # the plate in another unit than the map
        found = seen(tmp_path, room_light() * factor, room_plate(), Grid(256), position_m=EYE.tolist())
        scale = found.numbers["scale"]
        assert scale["route"] == "plate"
        # three standard deviations of what it says itself: 1 % and the spread over the cells
        assert scale["factor"][0] == pytest.approx(1 / factor, rel=3 * scale["sigma_rel_shared"])
        assert scale["sigma_rel_shared"] < 0.03


def test_another_white_balance_is_taken_off(tmp_path):
    gains = np.array([1.3, 1.0, 0.7])
    found = seen(tmp_path, room_light() * gains, room_plate(), Grid(256), position_m=EYE.tolist())
    assert np.array(found.numbers["scale"]["factor"]) * gains == pytest.approx(1, rel=0.03)
    assert any("colours differ" in text for text in found.warnings)


def test_map_of_another_place_is_not_levelled_by_what_it_does_not_see(tmp_path):
    strange = np.random.default_rng(1).lognormal(0, 1.2, (64, 128, 3))
    found = seen(tmp_path, strange, room_plate(), Grid(256), position_m=EYE.tolist())
    assert found.numbers["scale"]["route"] == "unknown"
    assert any("do not see the same things" in text for text in found.warnings)
    assert any("NOTHING SAYS HOW BRIGHT" in text for text in found.warnings)
    assert found.numbers["scale"]["sigma_rel_shared"] == 1


def test_stated_scale_is_believed_and_the_plate_may_object(tmp_path):
    found = seen(tmp_path, room_light(), room_plate(), Grid(256), position_m=EYE.tolist(), scale=2.0)
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


def test_shared_error_of_the_scale_is_told_apart_from_that_of_texels(tmp_path):
    stated = mapped(tmp_path, np.full((32, 64, 3), 2.0), scale=1.0, scale_sigma_rel=0.2, sigma_rel=0.0)
    found = KINDS["map"].observe(shots(stated), GRID)
    assert found.scale_sigma == 0.2
    assert np.sqrt(found.maps["map"].variance.max()) < 0.01  # the file's eight bits
    variance = stage_on(stated, room_plate())[1].outputs["environment"].rgb("variance")
    assert np.sqrt(variance[:28]) == pytest.approx(0.4, rel=1e-3)  # above the plane that the plate lays


# ---- the manifest ----------------------------------------------------------------------------------------------------

HEAD = 'name = "k"\n[plate]\nfiles = ["a.dng"]\n[camera]\ngiven = { fx = 1.0 }\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[probe]\nkind = "mapp"\n', r"toml:7: probe\.kind: is 'mapp'; expected one of mirror_ball, "),
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


# ---- maps that others made -------------------------------------------------------------------------------------------

DATA = Path(os.environ.get("INSITU_DATA", Path(__file__).resolve().parents[2] / "shared/data"))
REAL = sorted(DATA.glob("env_*/*.*"))


@pytest.mark.skipif(not REAL, reason="no maps under INSITU_DATA")
def test_real_maps_are_read_and_keep_their_energy():
    for path in REAL:
        light = clean(formats.read_latlong(path), {}, path.name)
        assert light.valid.all()
        turn = turned(light.channels(), rotation_of(77.0, np.array([0.1, 1.0, 0.0])), 64, 128, 2)
        # 3 %: suns of one texel, as above; most maps stay within 0.3 %
        assert total_energy(turn.values[..., :3]) == pytest.approx(total_energy(light.rgb), rel=0.03)


@pytest.mark.skipif(not (DATA / "brackets_memorial/memorial.hdr").is_file(), reason="not under INSITU_DATA")
def test_a_damaged_file_of_the_field_is_refused():
    with pytest.raises(ArtifactError, match="cut off or damaged"):
        formats.read_latlong(DATA / "brackets_memorial/memorial.hdr")


# ---- from photographs to the light -----------------------------------------------------------------------------------


def test_stage_takes_a_map(tmp_path):
    found, result = stage_on(mapped(tmp_path, room_light(), position_m=EYE.tolist()), room_plate())
    expected = resize_environment(room_light(), 64, 128)
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
