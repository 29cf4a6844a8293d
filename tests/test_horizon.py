"""A horizon in the frame: nothing above it is plane, at no level; what lies behind the objects is not touched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_composite_render import wish
from test_transport import sky

from pipeline.camera.lens import pixel_rays, project
from pipeline.camera.rigid import camera_points
from pipeline.light.environment import irradiance
from pipeline.run.stage import Stage
from pipeline.types import Camera, Raster, Reconstruction, View
from stages import composite, knobs, plane, reflectance, render

CAMERA = Camera(width=96, height=72, fx=90.0, fy=90.0, cx=48.0, cy=36.0)
EYE = np.array([0.05, 0.3, 1.0])
ALBEDO = 0.4
BRIGHT = 50.0  # of the sky over the ground in the plate


def level_view(down_deg: float) -> View:
    """A camera that looks towards -z and slightly down, so that the horizon is in its frame."""
    angle = np.radians(down_deg)
    forward = np.array([0, -np.sin(angle), -np.cos(angle)])
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    pose[:3, 3] = EYE
    return View(world_from_camera=pose, covariance=np.eye(6) * 1e-8, route="given", rms_px=0.0, points=0)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, Any]:
    """Everything from the plane to the composite, of a grey ball on an even table under a bright sky."""
    view = level_view(12.0)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    rays = pixel_rays(CAMERA, np.stack([columns, rows], -1).reshape(-1, 2)) @ view.world_from_camera[:3, :3].T
    above = (rays[:, 1] >= 0).reshape(CAMERA.height, CAMERA.width)
    light = irradiance(sky(), np.array([[0.0, 1, 0]]))[0]
    picture = np.where(above[..., None], BRIGHT, 1.0) * ALBEDO * light / np.pi
    variance = (0.01 * picture) ** 2
    plate = Raster(
        {**Raster.split(np.float32(picture)), **Raster.split(np.float32(variance), "variance"),
         "mask": np.zeros(above.shape, np.uint32)}, "acescg",
    )  # fmt: skip
    values: dict[str, Any] = {
        "facts": {"board": None, "marker": [{"side_m": 0.1}]}, "camera": CAMERA, "views": {"plate": view},
        "wishes": {"object": [wish(tmp_path_factory.mktemp("ball"), 0.0, base_color=[0.5, 0.5, 0.5])]},
        "cloud": Reconstruction(), "lighting": Raster(Raster.split(sky()), "acescg"), "emitters": [],
        "proxies": [], "occluders": [], "photographs": {"plate": plate}, "above": above,
    }  # fmt: skip

    def run(stage: Stage, params: knobs.Params) -> None:
        inputs = {name: values[artifact.name] for name, artifact in stage.inputs.items()}
        result = stage.compute(**inputs, params=params)
        values.update({artifact.name: result.outputs[name] for name, artifact in stage.outputs.items()})
        values[f"{stage.name} numbers"] = result.numbers

    run(plane.STAGE, knobs.Plane())
    run(reflectance.STAGE, knobs.Reflectance(texture_px=64))
    run(render.STAGE, knobs.Render(samples=4, depth=3, denoise=False))
    run(composite.STAGE, knobs.Composite())
    return values


def test_the_rectangle_lies_below_the_horizon(made) -> None:
    assert made["above"].any()
    assert not made["above"].all()
    corners = made["plane"].corners_m
    assert np.isfinite(corners).all()
    assert (camera_points(made["views"]["plate"].world_from_camera, corners)[0][:, 2] > 0).all()
    horizon = np.nonzero(~made["above"])[0].min()
    assert project(CAMERA, camera_points(made["views"]["plate"].world_from_camera, corners)[0])[:, 1].min() > horizon


def test_no_sky_becomes_albedo(made) -> None:
    """The sky of the plate is 50 times the ground: one pixel of it would show, far beyond 1 % of rounding."""
    albedo = made["albedo"]
    seen = albedo["seen"] > 0.5
    assert seen.any()
    assert np.abs(albedo.rgb()[seen] / ALBEDO - 1).max() < 0.01
    assert albedo.rgb().max() < 1.01 * ALBEDO


def test_nothing_above_the_horizon_changes(made) -> None:
    layers, above = made["layers"], made["above"]
    for name, channel in layers.channels.items():
        assert np.isfinite(channel).all(), name
        # The region of influence is made of cells, with a margin: it may reach over the horizon, nothing else does.
        assert name == "influence" or not channel[above].any(), name
    assert (layers["influence"] > 0).any()
    plate, result = made["photographs"]["plate"].rgb(), made["composite"].rgb()
    np.testing.assert_array_equal(result[above], plate[above])
    assert (result != plate).any()
