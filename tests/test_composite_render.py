"""Render and composite together: glowing, golden and glass objects; light groups that add up to the picture."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from test_transport import camera, ground, looking_down, sky

from pipeline.camera.lens import project
from pipeline.conventions import invert_rigid, transform_points
from pipeline.image.colour import luminance
from pipeline.light.environment import irradiance
from pipeline.run.manifest import MaterialWish
from pipeline.types import Emitter, Raster, Surface, View
from stages import composite, knobs, render


def wish(folder: Path, x: float, **material: Any) -> dict[str, Any]:
    path = folder / "ball.ply"
    trimesh.creation.icosphere(3, 0.08).export(path)
    return {
        "name": f"ball{round(100 * x)}".replace("-", "m"), "path": str(path), "position_m": (x, 0.0), "lift_m": 0.09,
        "yaw_deg": 0.0, "scale": 1.0, "material": MaterialWish.model_validate(material).model_dump(mode="json"),
    }  # fmt: skip


def inputs() -> dict[str, Any]:
    """What both stages read: a uniform table under a lamp and a soft sky, photographed with 1 % noise."""
    shape = (camera().height, camera().width)
    albedo, light = np.full(3, 0.4), irradiance(sky(), np.array([[0.0, 1, 0]]))[0]
    rng = np.random.default_rng(0)
    plate = albedo * light / np.pi * (1 + 0.01 * rng.normal(size=(*shape, 3)))
    photograph = Raster(
        Raster.split(plate.astype(np.float32))
        | Raster.split((0.01 * plate).astype(np.float32) ** 2, "variance")
        | {"mask": np.zeros(shape, np.uint32)},
        "acescg",
    )
    lamp = np.flatnonzero(sky().max(-1) > 5)
    return {
        "photographs": {"plate": photograph},
        "camera": camera(),
        "views": {
            "plate": View(
                world_from_camera=looking_down(), covariance=np.zeros((6, 6)), route="given", rms_px=0.0, points=0
            )
        },
        "environment": Raster(Raster.split(sky()), "acescg"),
        "emitters": [
            Emitter(
                name="lamp_1", direction=[0.4, 0.8, 0.447], solid_angle_sr=0.1, half_angle_rad=0.2,
                irradiance=[1, 1, 1], texels=lamp,
            )
        ],
        "plane": ground(),
        "albedo": Raster(Raster.split(np.full((4, 4, 3), 0.4)) | {"seen": np.ones((4, 4))}, "acescg"),
        "occluders": [],
    }  # fmt: skip


def made(wishes: list[dict[str, Any]], **params: Any) -> tuple[dict[str, Any], Raster]:
    """Inputs of the composite, and the layers rendered for them."""
    given = inputs()
    params = {"samples": 4, "depth": 5, "denoise": False} | params
    result = render.compute(
        wishes={"object": wishes}, **given, surface=Surface(), local_proxies=[], params=knobs.Render(**params)
    )
    return given | {"proxies": []}, result.outputs["layers"]


def test_lights_of_a_real_render_rebuild_the_picture(tmp_path: Path) -> None:
    """Gold, glass and a lamp, light by light: mul, add and obj of the groups give the result to float32 rounding.

    The lamp's ball is black and emits (2, 1, 0.5): its middle shows that times the plane's white, in the sky's group;
    0.05 for what a black ball of index 1.01 reflects. Its outline is premultiplied: obj is alpha times that colour.
    """
    glow = (2.0, 1.0, 0.5)
    lamp = {"base_color": (0, 0, 0), "emission": glow, "ior": 1.01, "roughness": 1.0, "space": "acescg"}
    wishes = [
        wish(tmp_path, -0.2, conductor="gold", roughness=0.3),
        wish(tmp_path, 0.0, transmission=1.0),
        wish(tmp_path, 0.2, **lamp),
    ]
    given, layers = made(wishes, light_groups=True)
    result = composite.compute(layers=layers, **given, params=knobs.Composite())
    stored, plate = result.outputs["composite"], given["photographs"]["plate"].rgb()
    names = stored.attributes["insitu:groups"].split(",")
    assert names == ["sky", "lamp_1"]
    mul = 1 - stored["obj.A"][..., None] + sum(stored.rgb(f"mul.{name}") - 1 for name in names)
    add, obj = (sum(stored.rgb(f"{layer}.{name}") for name in names) for layer in ("add", "obj"))
    scale = plate + np.abs(add) + obj
    assert np.all(np.abs(plate * mul + add + obj - stored.rgb()) <= 16 * np.finfo(np.float32).eps * scale)

    gold = layers.rgb("obj.lamp_1")[:, :20].mean() / layers.rgb("obj.sky")[:, :20].mean()
    assert 0.5 < gold < 5  # the lamp gives 2/3 of the irradiance here: neither group is empty

    white = luminance(irradiance(sky(), np.array([[0.0, 1, 0]]))[0]) / np.pi
    (column, row), *_ = project(camera(), transform_points(invert_rigid(looking_down()), np.array([[0.2, 0.09, 0.0]])))
    around = np.hypot(*np.meshgrid(np.arange(64) + 0.5 - column, np.arange(48) + 0.5 - row)) < 12
    shown = layers["obj.A"] > 0.1
    straight = obj[around & shown] / stored["obj.A"][around & shown][:, None] / white
    assert (stored["obj.A"][around & shown] < 1).sum() > 10
    np.testing.assert_allclose(np.median(straight, 0), glow, atol=0.05)
    assert np.quantile(straight[:, 0], 0.1) > 1.9  # Mitsuba's smooth normals leave a few rays at the outline dark
    assert layers.rgb("obj.lamp_1")[around].max() < 0.5 * layers.rgb("obj.sky")[around].max()


@pytest.mark.parametrize("kind", ["additive", "ratio", "auto"])
def test_edges_and_what_lies_outside(rendered: tuple[dict[str, Any], Raster], kind: str) -> None:
    """Object, coverage and change come from the same camera samples; where no layer says more, the plate's own bits."""
    given, layers = rendered
    result = composite.compute(layers=layers, **given, params=knobs.Composite(kind=kind))
    plate, picture = given["photographs"]["plate"].rgb(), result.outputs["composite"].rgb()
    alpha, ground = layers["obj.A"], layers["ground"]
    stored = result.outputs["composite"]
    free = (stored.rgb("mul") == 1).all(-1) & ~(stored.rgb("add").any(-1) | stored.rgb("obj").any(-1))
    assert picture[free].tobytes() == plate[free].tobytes()
    shared = (alpha > 0) & (alpha < 1)
    assert shared.sum() > 5
    np.testing.assert_allclose((alpha + ground)[shared], 1, atol=1e-6)
    assert not layers.rgb("obj")[alpha == 0].any()
    assert not layers.rgb("lost")[alpha == 1].any()
    assert not layers.rgb("gained")[alpha == 1].any()
    assert np.array_equal(picture[alpha == 1], layers.rgb("obj")[alpha == 1].astype(np.float32))


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Raster]:
    """A small grey ball; the left of the frame is left to the plate."""
    small = wish(tmp_path_factory.mktemp("ball"), 0.0, base_color=(0.5, 0.5, 0.5)) | {"scale": 0.25, "lift_m": 0.02}
    given, layers = made([small], threshold=0.05)
    for layer in ("lost", "gained"):
        for name in "RGB":
            layers.channels[f"{layer}.{name}"][:, :8] = 0  # as outside the region of influence
    return given, layers
