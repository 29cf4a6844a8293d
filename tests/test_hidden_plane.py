"""What the plate shows that is not the plane does not become albedo: real things in front, other photographs."""

from __future__ import annotations

import numpy as np
import pytest
from small_plates import CAMERA, VIEW, ground
from test_reflectance import NORMAL, SIZE, SKY, plate, smooth, where_seen

from pipeline.conventions import CLIPPED
from pipeline.light.environment import irradiance
from pipeline.run.errors import CaptureError
from pipeline.run.formats import write_exr, write_png
from pipeline.types import Occluder, Raster
from stages import knobs, reflectance


def solved(photographs: dict[str, Raster], occluders: list[Occluder]) -> Raster:
    light = Raster(Raster.split(SKY), "acescg")
    return reflectance.compute(
        photographs, CAMERA, {"plate": VIEW}, light, [], ground(), [], occluders, knobs.Reflectance(texture_px=128)
    ).outputs["albedo"]


@pytest.fixture(scope="module")
def bare() -> Raster:
    return plate(smooth(where_seen()), irradiance(SKY, NORMAL[None])[0])


def test_a_masked_thing_is_not_taken_for_the_plane(bare, tmp_path) -> None:
    """A red plant with a soft outline: unmasked it is in the albedo, masked the plane goes on behind it, unseen."""
    coverage = np.zeros(SIZE, np.float32)
    coverage[40:70, 60:100], coverage[38:40, 60:100] = 1.0, 0.5
    shown = bare.rgb() * (1 - coverage[..., None]) + coverage[..., None] * [5.0, 0.1, 0.1]
    plant = Raster({**Raster.split(shown), "mask": np.zeros(SIZE, np.uint32)}, "acescg")
    write_exr(tmp_path / "plant.exr", Raster({"A": coverage}, "data"))
    mask = Occluder(name="plant", mask_file=str(tmp_path / "plant.exr"))
    before, baked, freed = solved({"plate": bare}, []), solved({"plate": plant}, []), solved({"plate": plant}, [mask])
    assert np.abs(baked.rgb() - before.rgb()).max() > 0.3
    same = freed["seen"] > 0.999
    assert 0.3 < same.mean() < (before["seen"] > 0.999).mean()
    np.testing.assert_allclose(freed.rgb()[same], before.rgb()[same], atol=0.01)  # texels of a few pixels, beside it
    assert np.abs(freed.rgb() - before.rgb()).max() < 0.25  # and behind it, a smooth continuation
    assert not (plant["mask"] & CLIPPED).any()  # what was handed in stays as it was


def test_other_photographs_are_not_read(bare) -> None:
    """Board and ball stand in frames of their own: whatever those show, the albedo is the plate's to the bit."""
    ball = Raster({**Raster.split(np.full((*SIZE, 3), np.nan)), "mask": np.zeros(SIZE, np.uint32)}, "acescg")
    one, other = solved({"plate": bare}, []), solved({"plate": bare, "ball_a": ball}, [])
    for name, channel in one.channels.items():
        assert channel.tobytes() == other[name].tobytes(), name


def test_a_mask_of_another_size_is_refused(bare, tmp_path) -> None:
    write_png(tmp_path / "small.png", np.zeros((3, 5), np.uint8))
    with pytest.raises(CaptureError, match=r"occluder hand: .*is 5 x 3 pixels; expected"):
        solved({"plate": bare}, [Occluder(name="hand", mask_file=str(tmp_path / "small.png"))])
    with pytest.raises(CaptureError, match="occluder hand"):
        solved({"plate": bare}, [Occluder(name="hand", mask_file=str(tmp_path / "none.png"))])
