"""What in the photographs answers to the fluxes of clipped lamps: the plane around a ball, cards of known albedo."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.conventions import transform_points
from pipeline.light import ball_shadow
from pipeline.probes.cards import Cards, cards_of
from pipeline.probes.observation import Observation, Shots
from pipeline.probes.shadow_blocks import Blocks, plane_blocks

LEVEL = np.diag([1.0, 0.0, 1.0])  # the ball stands on the plane


@dataclass(frozen=True)
class Witness:
    """What may answer to the fluxes: blocks of the plane around a ball, or surfaces of known albedo; either or both.

    ``cards``: surfaces of known reflectance. ``shift`` (3,): one standard deviation
    of the ball's centre [m] on the plane, along the axis where it is largest, world frame; ``eye`` (3,): the camera.
    ``place`` (3, 3): covariance of the ball's centre [m^2], world. ``scale_sigma`` (3,): relative, of the whole map.
    """

    ball: ball_shadow.Ball | None = None
    blocks: Blocks | None = None
    cards: Cards = field(default_factory=Cards)
    scale_sigma: np.ndarray | float = 0.0
    shift: np.ndarray | None = None
    place: np.ndarray | None = None
    eye: np.ndarray | None = None
    missing: str = "no photograph of the ball from the tripod"


def witness_of(shots: Shots, observed: Observation) -> Witness:
    """What the photographs offer: the plane beside the first ball that the tripod saw, as the plate did."""
    scale, cards = np.broadcast_to(observed.scale_sigma, 3), cards_of(shots)
    for ball in shots.facts.get("ball", []):
        name = ball["name"]
        if not ball.get("tripod", False) or name not in observed.balls or shots.views[name].camera is not None:
            continue
        if shots.photographs[name].shape != shots.photographs["plate"].shape:
            continue
        fit, pose = observed.balls[name], shots.views[name].world_from_camera
        blocks = plane_blocks(shots.photographs[name], shots.photographs["plate"], shots.camera, pose, fit)
        centre = transform_points(pose, fit.centre_camera_m)
        place = pose[:3, :3] @ fit.covariance @ pose[:3, :3].T
        values, axes = np.linalg.eigh(LEVEL @ place @ LEVEL)
        return Witness(
            ball_shadow.Ball(centre, fit.radius_m, fit.reflectance), blocks, cards,
            shift=axes[:, -1] * np.sqrt(values[-1]), place=place, eye=pose[:3, 3],
            scale_sigma=scale, missing="the plane beside the ball cannot be compared with the plate",
        )  # fmt: skip
    return Witness(cards=cards, scale_sigma=scale)
