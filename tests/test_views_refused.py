"""Views that cannot be oriented, each with its one line: what was found, what was needed, what to do."""

from __future__ import annotations

import numpy as np
import pytest
from printed_board import BOARD, MARKER, charuco_print, looking_at, marker_print, photograph

from pipeline.camera.colmap_bridge import reconstruct
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.types import Camera, Raster, Reconstruction
from stages import knobs, pose

CAMERA = Camera(width=480, height=360, fx=640, fy=640, cx=242.3, cy=178.1)
FACTS = {"board": None, "marker": [], "ball": [], "pose": [], "capture_root": "."}


def posed(facts: dict, picture: np.ndarray, cloud: Reconstruction) -> None:
    height, width = picture.shape
    camera = CAMERA.model_copy(update={"width": width, "height": height})
    photographs = {"plate": Raster({channel: np.asarray(picture, np.float32) for channel in "RGB"}, "acescg")}
    pose.compute({**FACTS, **facts}, photographs, camera, {}, cloud, [], knobs.Pose())


@pytest.mark.parametrize(
    ("printed", "facts", "says"),
    [
        ("marker", {"marker": [{**MARKER, "id": 3}]}, "it shows DICT_5X5_100, id 7; [marker] says DICT_5X5_100, id 3"),
        ("board", {"board": {**BOARD, "dictionary": "DICT_4X4_50"}}, 'what it shows fits dictionary = "DICT_5X5_100"'),
        ("nothing", {"marker": [MARKER]}, "check its dictionary and id"),
    ],
)
def test_what_the_views_show_instead(printed: str, facts: dict, says: str) -> None:
    """A plate oriented by further views whose marker is another than stated: in the words of the marker route."""
    where = looking_at(np.zeros(3), 40, 10, 0.42)
    picture = np.full((360, 480), 0.3)
    if printed == "marker":
        picture = photograph(marker_print(MARKER), CAMERA, where, 4)
    elif printed == "board":
        picture = photograph(charuco_print(BOARD), CAMERA, looking_at(np.array([0.105, 0, 0.075]), 40, 10, 0.42), 3)
    cloud = Reconstruction(
        names=["plate"], world_from_camera=where[None], cameras=[CAMERA], camera_of=[0], points=np.zeros((0, 3))
    )
    facts = {**facts, "pose": [{"view": "plate", "route": "colmap"}]}
    with pytest.raises(CaptureError) as error:
        posed(facts, picture, cloud)
    assert str(error.value).startswith("sfm: the ")
    assert "is seen in none of the 1 oriented photographs" in str(error.value)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def texture(seed: int) -> np.ndarray:
    """(180, 240) uint8 of blobs that SIFT finds."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(180, 240)), 2.0)
    return np.uint8(np.clip(128 + 400 * noise, 0, 255))


def test_two_views_do_not_hang_together() -> None:
    """Two photographs that match perfectly are still two: nothing confirms their geometry."""
    one = texture(1)
    camera = Camera(width=240, height=180, fx=300, fy=300, cx=120, cy=90, source="given")
    pictures = {"a": one, "b": np.roll(one, 9, 1)}
    with pytest.raises(
        NumericalError, match=r"sfm: \d of 2 photographs hang together, needed 3; .* places that differ"
    ):
        reconstruct(pictures, dict.fromkeys(pictures, 0), [camera])


def test_points_on_a_line_orient_nothing() -> None:
    points = [{"world_m": [0.1 * n, 0.0, 0.02 * n], "px": [40.0 + 50 * n, 200.0 - 20 * n]} for n in range(7)]
    facts = {"pose": [{"view": "plate", "route": "points", "points": points}]}
    with pytest.raises(NumericalError, match=r"^plate: .*on a line"):
        posed(facts, np.full((360, 480), 0.3), Reconstruction())
