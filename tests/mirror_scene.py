"""A mirror ball photographed in a known place: a forward ray tracer in numpy, sharing no code with the unwrap.

Only the lens of `pipeline.camera` is shared (it has tests of its own). Rays go pixel -> lens -> ball -> plane or sky.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.camera.lens import unproject
from pipeline.simulation.lens import look_at as look_at
from pipeline.types import Camera

Light = Callable[[np.ndarray], np.ndarray]
Mirror = Callable[[np.ndarray, np.ndarray], np.ndarray]  # outward normals (N, 3), cosines (N,) -> reflectance (N, 3)
Dent = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # unit (N, 3) -> height in radii (N,), gradient (N, 3)


@dataclass
class Lamp:
    """A disc of constant radiance in a direction."""

    direction: tuple[float, float, float]
    half_angle: float
    radiance: float


def sky(lamps: list[Lamp], contrast: float = 1.0) -> Light:
    """Directions (N, 3) -> RGB: a smooth room with walls of different colour, and lamps."""

    def light(w: np.ndarray) -> np.ndarray:
        x, y, z = w.T
        room = 1 + contrast * np.stack(
            [0.5 * x + 0.2 * np.sin(3 * z), 0.4 * y + 0.3 * x * z, 0.3 * y - 0.3 * np.cos(4 * x)], -1
        )
        room = np.maximum(room, 0.05)
        for lamp in lamps:
            centre = np.asarray(lamp.direction) / np.linalg.norm(lamp.direction)
            room = np.where((w @ centre > np.cos(lamp.half_angle))[:, None], lamp.radiance, room)
        return room

    return light


@dataclass
class Place:
    """World: +Y up; the plane y = 0 with a chequered board in front of the far light, or no plane at all."""

    light: Light
    plane: bool = False
    ball: tuple[float, float, float] | None = (0.0, 0.04, 0.0)
    radius: float = 0.04
    reflectance: float | tuple[float, float, float] | Mirror = 0.8
    dent: Dent | None = None  # the ball is R (1 + height); slopes to first order
    glass: float | None = None  # thickness before the mirror, of the radius; ``reflectance`` is then the silver's
    index: float = 1.52

    def radiance(self, origin: np.ndarray, w: np.ndarray) -> np.ndarray:
        """RGB (N, 3) seen from ``origin`` (N, 3) along ``w`` (N, 3), the ball left out."""
        rgb = self.light(w)
        if self.plane:
            below = w[:, 1] < -1e-9
            t = np.where(below, -origin[:, 1] / np.where(below, w[:, 1], 1), 0)
            x, z = (origin + t[:, None] * w)[:, ::2].T
            wood = 0.5 + 0.06 * np.sin(40 * x + 3 * np.sin(9 * z)) + 0.05 * np.sin(160 * z)
            board = (x > 0.1) & (x < 0.3) & (np.abs(z) < 0.1)
            check = np.where((np.floor(x / 0.03) + np.floor(z / 0.03)) % 2 > 0, 0.9, 0.08)
            value = np.where(board, check, wood)
            rgb = np.where(below[:, None], value[:, None] * (1.0, 0.9, 0.8), rgb)
        return rgb

    def traced(self, origin: np.ndarray, w: np.ndarray) -> np.ndarray:
        """RGB (N, 3) with the ball in place."""
        if self.ball is None:
            return self.radiance(origin, w)
        to_ball = np.asarray(self.ball) - origin
        along = (to_ball * w).sum(1)
        size = np.full(len(w), self.radius)
        if self.dent is not None:  # first where the ray is nearest to the centre, then where it meets the ball
            size *= 1 + self.dent(_unit(along[:, None] * w - to_ball))[0]
        inside = size**2 - (to_ball**2).sum(1) + along**2
        hit = (inside > 0) & (along > 0)
        rgb = np.empty_like(w)
        rgb[~hit] = self.radiance(origin[~hit], w[~hit])
        origin, w, to_ball, along, inside = origin[hit], w[hit], to_ball[hit], along[hit], inside[hit]
        point = origin + (along - np.sqrt(inside))[:, None] * w
        normal = _unit(point - self.ball)
        for _ in range(4 if self.dent is not None else 0):
            size = self.radius * (1 + self.dent(normal)[0])
            point = origin + (along - np.sqrt(np.maximum(size**2 - (to_ball**2).sum(1) + along**2, 0)))[:, None] * w
            normal = _unit(point - self.ball)
        if self.glass is not None:
            rgb[hit] = self.behind_glass(point, normal, w)
            return rgb
        body = normal
        if self.dent is not None:
            normal = _unit(normal - self.dent(normal)[1])
        cosine = -(w * normal).sum(1)
        mirrored = w + 2 * cosine[:, None] * normal
        given = self.reflectance
        reflectance = given(body, np.clip(cosine, 0, 1)) if callable(given) else np.asarray(given)
        rgb[hit] = reflectance * self.radiance(point, mirrored)
        return rgb

    def behind_glass(self, point: np.ndarray, normal: np.ndarray, w: np.ndarray, orders: int = 6) -> np.ndarray:
        """RGB (N, 3) of rays ``w`` (N, 3) that meet a glass ball at ``point``: Snell, Fresnel, mirror, ray by ray."""
        ball = np.asarray(self.ball)
        front, within = snell(w, normal, 1.0, self.index)
        rgb = front[:, None] * self.radiance(point, w - 2 * (w * normal).sum(1, keepdims=True) * normal)
        carried = (1 - front)[:, None] * np.asarray(self.reflectance)
        for _ in range(orders):
            inner = meets(point, within, ball, self.radius * (1 - self.glass), first=True)
            outward = _unit(inner - ball)
            within = within - 2 * (within * outward).sum(1, keepdims=True) * outward
            point = meets(inner, within, ball, self.radius, first=False)
            outward = _unit(point - ball)
            back, out = snell(within, -outward, self.index, 1.0)
            rgb += carried * (1 - back)[:, None] * self.radiance(point, out)
            carried = carried * back[:, None] * np.asarray(self.reflectance)
            within = within - 2 * (within * outward).sum(1, keepdims=True) * outward
        return rgb


def snell(w: np.ndarray, normal: np.ndarray, before: float, behind: float) -> tuple[np.ndarray, np.ndarray]:
    """Fresnel's unpolarised reflectance (N,) and refracted unit directions (N, 3); ``normal`` against the rays."""
    ratio = before / behind
    cosine = -(w * normal).sum(1)
    inside = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    out = ratio * w + (ratio * cosine - inside)[:, None] * normal
    s = (before * cosine - behind * inside) / (before * cosine + behind * inside)
    p = (behind * cosine - before * inside) / (behind * cosine + before * inside)
    return 0.5 * (s**2 + p**2), out


def meets(origin: np.ndarray, w: np.ndarray, centre: np.ndarray, radius: float, first: bool) -> np.ndarray:
    """Points (N, 3) where rays meet a sphere, the first or the last of both."""
    along = ((centre - origin) * w).sum(1)
    half = np.sqrt(radius**2 - ((centre - origin) ** 2).sum(1) + along**2)
    return origin + (along - half if first else along + half)[:, None] * w


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def photograph(
    place: Place, camera: Camera, world_from_camera: np.ndarray, split: int = 4, noise: float = 0.0, seed: int = 0
) -> np.ndarray:
    """(H, W, 3): box-filtered pixels of ``split**2`` rays each, with relative Gaussian noise."""
    steps = (np.arange(split) + 0.5) / split
    total = np.zeros((camera.height * camera.width, 3))
    y, x = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    for dy in steps:
        for dx in steps:
            xy = unproject(camera, np.stack([(x + dx).ravel(), (y + dy).ravel()], -1))
            rays = np.concatenate([xy, np.ones((len(xy), 1))], 1) @ world_from_camera[:3, :3].T
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            total += place.traced(np.broadcast_to(world_from_camera[:3, 3], rays.shape), rays)
    picture = (total / split**2).reshape(camera.height, camera.width, 3)
    return picture * (1 + noise * np.random.default_rng(seed).normal(size=picture.shape))
