"""A ball of glass that is silvered inside: where its mirror sends light, and what the glass mirrors besides.

Outer radius R, mirror at R (1 - t), index n. A ray of incidence i, s = sin i, passes the centre at ``R s`` before the
glass and at ``R s / n`` in it (Bouguer's law, which also makes it leave under i), so that it turns about the centre by
``asin(s / (n (1 - t))) - asin(s / n)`` down to the mirror and by as much back. What leaves the ball has therefore
turned by twice that, `Glass.turn`, from what the front would mirror. Lines in and out are symmetric about the point of
the mirror, as if a sphere of radius ``R s / sin(i + turn / 2)`` had mirrored them (`Glass.virtual`).

Fresnel's F of the front is the same on the way out. Order 0, the front's own image, has F; order m, mirrored m times,
has ``(1 - F)^2 rho^m F^(m - 1)`` of a silver rho and is turned m times. Order 1 is the ball's image, 0 and 2 are its
ghosts, 4 % each of it head on, on both sides. All orders together: ``F + (1 - F)^2 rho / (1 - rho F)``. Silver is met
under less than 45 degrees, where no metal's reflectance depends on the angle; tint is the silver's or the glass's,
whose path grows by a third towards the rim, which is not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

INDEX = 1.52  # soda-lime
MOST = 0.3  # of the radius: from 1 - 1 / n on rays pass the mirror by
STEPS = 400  # of the incidence, in the table of `virtual`


@dataclass(frozen=True)
class Glass:
    """Glass of a thickness, as a share of the ball's outer radius, before the mirror; ``order`` of its image."""

    thickness: float
    index: float = INDEX
    order: int = 1

    def turn(self, sine: np.ndarray) -> np.ndarray:
        """Angle [rad], away from the camera, between what the ball mirrors and what its front would; by sin(i)."""
        sine = np.asarray(sine)
        return np.asarray(2 * self.order * (np.arcsin(sine / self._inner) - np.arcsin(sine / self.index)))

    @property
    def _inner(self) -> float:
        return self.index * (1 - self.thickness)

    def turn_slope(self, sine: np.ndarray) -> np.ndarray:
        """Derivative of `turn` by the sine of the incidence."""
        square = np.asarray(sine) ** 2
        steep = 1 / np.sqrt(self._inner**2 - square) - 1 / np.sqrt(self.index**2 - square)
        return np.asarray(2 * self.order * steep)

    def virtual(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radius, over the ball's, of the sphere that mirrors alike a ray under this ``angle`` [rad] to its normal.

        Also which angles there are: up to that of the silhouette.
        """
        sine = np.sin(np.linspace(0, np.pi / 2, STEPS + 1)[1:])
        known = np.arcsin(sine) + 0.5 * self.turn(sine)
        size = sine / np.sin(known)
        return np.interp(angle, known, size), np.asarray(angle) <= known[-1]

    def fresnel(self, sine: np.ndarray) -> np.ndarray:
        """Unpolarised reflectance of the front by the sine of the incidence."""
        square = np.minimum(np.asarray(sine, float) ** 2, 1)
        into, within = np.sqrt(1 - square), np.sqrt(self.index**2 - square)
        across = (into - within) / (into + within)
        along = (self.index**2 * into - within) / (self.index**2 * into + within)
        return np.asarray(0.5 * (across**2 + along**2))

    def silver(self, facing: np.ndarray) -> np.ndarray:
        """Reflectance of the mirror, its glass passed twice, of a ball that reflects ``facing`` head on."""
        front = float(self.fresnel(np.array(0.0)))
        over = np.asarray(facing, float) - front
        return np.clip(over / ((1 - front) ** 2 + front * over), 0, 1)

    def total(self, facing: np.ndarray, sine: np.ndarray) -> np.ndarray:
        """Reflectance (..., 3), all orders, at sines (...) of the incidence, of a ball of ``facing`` (3,) head on."""
        return self.total_of(self.silver(facing), sine)

    def total_of(self, silver: np.ndarray, sine: np.ndarray) -> np.ndarray:
        """The same of a mirror of ``silver`` (3,), its glass passed twice."""
        front = self.fresnel(sine)[..., None]
        return np.asarray(front + (1 - front) ** 2 * silver / (1 - silver * front))

    def ghosts(self, facing: np.ndarray, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shares (..., 3) of the total that orders 0 and 2 have; order 1, with the little of those above, the rest."""
        front, silver = self.fresnel(sine)[..., None], self.silver(facing)
        total = self.total(facing, sine)
        return front / total, (1 - front) ** 2 * silver**2 * front / total

    def displacement(self, rim: float = 0.97) -> tuple[float, float]:
        """Root mean square of `turn` over the disc inside ``rim``, and its largest there [rad]."""
        ways = self.turn(rim * np.sqrt((np.arange(200) + 0.5) / 200))
        return float(np.sqrt((ways**2).mean())), float(ways[-1])


def leaving(glass: Glass, rays: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (N, 3) where rays leave the ball, and their unit directions (N, 3) there.

    Of unit ``rays`` (N, 3) that meet it at outward unit ``normal`` (N, 3), any one frame; NaN stays.
    """
    cosine = -(rays * normal).sum(-1, keepdims=True)
    ahead = rays + cosine * normal
    sine = np.linalg.norm(ahead, axis=-1, keepdims=True)
    ahead = ahead / np.maximum(sine, 1e-12)
    turn = glass.turn(np.minimum(sine, 1.0))
    whole = np.arctan2(sine, cosine) + turn
    return np.cos(turn) * normal + np.sin(turn) * ahead, np.cos(whole) * normal + np.sin(whole) * ahead


def unghosted(
    rgb: np.ndarray, seen: np.ndarray, sine: np.ndarray, away: np.ndarray, glass: Glass, facing: np.ndarray,
    rounds: int = 8,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """A map (H, W, 3) of a glass ball, all orders in it, without its ghosts; and what was taken away (H, W, 3).

    ``rgb``: photographed radiance over `Glass.total`; ``seen`` (H, W) coverage; ``sine`` (H, W) of the incidence, NaN
    where blind; ``away`` (3,): unit direction from the camera to the ball, world frame. A texel at angle theta shows,
    at two shares, what lies at theta - turn and theta + turn: fixed-point iteration, each round a tenth of the one
    before, near the rim 0.4. Ghosts of what is not seen are taken to be as bright as the texel. Nothing becomes
    negative by it.
    """
    from pipeline.conventions import latlong_directions, latlong_from_direction
    from pipeline.light.sampling import bilinear, planes

    height, width = seen.shape
    known = np.isfinite(sine) & (seen > 0)
    safe = np.where(known, sine, 0.0)
    w = latlong_directions(height, width)
    cosine = -(w @ away)
    spoke = w + cosine[..., None] * away
    spoke /= np.maximum(np.linalg.norm(spoke, axis=-1, keepdims=True), 1e-12)
    theta, turn = np.arccos(np.clip(cosine, -1, 1)), glass.turn(safe)
    places = []
    for way in (theta - turn, theta + turn):
        u, v = latlong_from_direction(np.sin(way)[..., None] * spoke - np.cos(way)[..., None] * away)
        places.append((u * width + 1, v * height))
    shares = glass.ghosts(facing, safe)
    main = 1 - shares[0] - shares[1]
    covered = seen[..., None]

    def elsewhere(light: np.ndarray, place: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        stack = np.concatenate([light * covered, covered], -1).astype(np.float32)
        found = bilinear(planes(np.concatenate([stack[:, -1:], stack, stack[:, :1]], 1)), *place)
        enough = found[..., 3:] > 0.5
        return np.where(enough, found[..., :3] / np.where(enough, found[..., 3:], 1), light)

    light = rgb
    for _ in range(rounds):
        taken = sum(share * elsewhere(light, place) for share, place in zip(shares, places, strict=True))
        light = np.where(known[..., None], np.maximum((rgb - taken) / main, np.minimum(rgb, 0)), rgb)
    return light, rgb - main * light
