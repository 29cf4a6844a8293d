"""Fisheye photographs as the probe: three projections, lamps, seams, rotations from plate and overlap."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from command import dng, tiny
from lit_room import EYE, GRID, ROOM, facts, room_light, room_plate, shots, stage_on

from pipeline.camera.rigid import rotation_log
from pipeline.conventions import (
    latlong_directions,
    latlong_solid_angles,
)
from pipeline.light.environment import AXES, irradiance, resize_environment
from pipeline.probes import combine, fisheye
from pipeline.probes.kinds import KINDS
from pipeline.probes.observation import Grid
from pipeline.run import formats
from pipeline.run.errors import CaptureError
from pipeline.types import Raster
from stages import ingest, knobs

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
    assert merged.seen.min() > 0.9  # texels cut by the rim of one photograph
    w = latlong_directions(32, 64)
    # 1 %: a texel of 5.6 degrees differs from its centre by 0.1 %
    assert merged.rgb == pytest.approx(smooth(w.reshape(-1, 3)).reshape(w.shape), rel=0.01)
    assert found.numbers["seams"]["overlap_sr"] == pytest.approx(4 * np.pi * np.sin(np.radians(10)), rel=0.1)
    assert found.numbers["seams"]["disagreement_median_rel"]["0-1"] < 2e-3


def test_fisheye_shows_lamps_where_they_are(tmp_path):
    """One lamp on each of the six axes."""

    def lamps(w: np.ndarray) -> np.ndarray:
        return np.where((w @ AXES.T > np.cos(0.06)).any(-1)[:, None], 100.0, 0.01) * np.ones(3)

    found = KINDS["fisheye_pair"].observe(shots(pair(tmp_path, lamps, scale=1.0)), Grid(128))
    flux = (combine.merge(list(found.maps.values())).rgb[..., 0] - 0.01) * latlong_solid_angles(64, 128)
    w = latlong_directions(64, 128)
    for axis in AXES:
        near = flux * (w @ axis > 0.9)
        seen_at = (w * near[..., None]).sum((0, 1))
        assert np.degrees(np.arccos(seen_at @ axis / np.linalg.norm(seen_at))) < 0.5  # half a pixel
        # 3 %: 3 x 3 rays a pixel cut the rim of a lamp of 6 pixels across
        assert near.sum() == pytest.approx(100 * 2 * np.pi * (1 - np.cos(0.06)), rel=0.03)


def test_fisheyes_of_unequal_exposure_and_unknown_rotation(tmp_path):
    """The first is turned by the plate's features, the second by those of the overlap; exposures are made equal."""
    turns = ((190.0, 0.0, 0.0), (10.0, 0.0, 0.0))  # the first looks where the plate does
    given = pair(tmp_path, around, (0.5, 0.8), turns, hidden=(0, 1), optics=FINE)
    found = KINDS["fisheye_pair"].observe(shots(given, room_plate()), GRID)
    for number, route in enumerate(("features", "overlap")):
        told = found.numbers[f"eye_{number}"]
        held = dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), turns[number], strict=True))
        error = rotation_log(np.array(told["world_from_camera"]) @ fisheye.rotation_of(held).T)
        assert told["route"] == route
        assert np.degrees(np.linalg.norm(error)) < 3 * np.sqrt(3) * told["sigma_deg"]
    assert found.numbers["seams"]["exposure_over_first"][1] == pytest.approx(1.6, rel=0.05)
    scale = found.numbers["scale"]
    assert scale["factor"][1] == pytest.approx(2.0, rel=3 * scale["sigma_rel_shared"])


def test_stage_takes_a_fisheye_pair(tmp_path):
    found, result = stage_on(pair(tmp_path, around), room_plate())
    expected = resize_environment(room_light(), 64, 128)
    # 4 %: 3 sigma of the scale's 1 %, and pixels of 1.1 degrees
    assert irradiance(found, AXES) == pytest.approx(irradiance(expected, AXES), rel=0.04)
    assert result.numbers["seen_fraction"] > 0.99


def test_brackets_and_files_of_fisheyes_are_indexed(tmp_path):
    """RAW of another size than the plate's is a view of its own; a picture file is found, digested, and judged."""
    folder = tiny(tmp_path)
    dng(folder / "front.dng", np.full((60, 80), 300, np.uint16))
    formats.write_exr(folder / "back.exr", Raster(Raster.split(np.ones((10, 12, 3), np.float32)), "acescg"))
    text = (folder / "capture.toml").read_text()
    start, end = text.index("[[ball]]"), text.index("[board]")
    lens = '[[probe.fisheye]]\nname = "{}"\n{}\nfov_deg = 190\nradius_px = 30\nyaw_deg = 0\n'
    told = '[probe]\nkind = "fisheye_pair"\n' + lens.format("front", 'files = ["front.dng"]')
    told += lens.format("back", 'file = "back.exr"')
    (folder / "capture.toml").write_text(text[:start] + told + text[end:])
    outputs = ingest.compute(folder, None, knobs.Ingest()).outputs
    assert {name: bracket.role for name, bracket in outputs["brackets"].items()} == {
        "plate": "plate",
        "front": "fisheye",
    }
    front, back = outputs["facts"]["probe"]["fisheye"]
    assert back["path"].endswith("back.exr")
    assert len(back["sha256"]) == 64
    assert "path" not in front
    (folder / "back.exr").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match=r"back\.exr: not a readable EXR"):
        ingest.compute(folder, None, knobs.Ingest())
