"""The probe kinds, by their name in capture.toml: ``[probe] kind``."""

from __future__ import annotations

from pipeline.probes.fisheye import FisheyePair
from pipeline.probes.grey_ball import GreyBall
from pipeline.probes.mirror_ball import MirrorBall
from pipeline.probes.observation import Kind
from pipeline.probes.panorama import Panorama
from pipeline.probes.ready_made import ReadyMade

KINDS: dict[str, Kind] = {
    "mirror_ball": MirrorBall(), "grey_ball": GreyBall(), "map": ReadyMade(), "panorama": Panorama(),
    "fisheye_pair": FisheyePair(),
}  # fmt: skip
