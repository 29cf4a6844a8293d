"""How a picture of all directions is turned in the world: from the plate, by matched features or by clicked points.

Wahba's problem (1965): the rotation that takes directions of the picture to directions of the world, solved by the SVD
(Markley 1988) inside RANSAC (Fischler and Bolles 1981), then reweighted (Huber). A spot in the plate has two readings:
it lies on the plane, whose direction from the picture's place is known, or it is far away; the better one counts.
Limits: a near spot off the plane is displaced by parallax, so rooms smaller than some metres leave fewer matches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays
from pipeline.camera.markers import grey, tone
from pipeline.camera.opencv_bridge import Features, feature_matches, features
from pipeline.camera.rigid import nearest_rotation, rotation_exp
from pipeline.conventions import direction_from_latlong, latlong_from_direction, latlong_solid_angles
from pipeline.light.environment import resize_environment
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.map_scale import COARSE, FEWEST_SR, seen_by_plate
from pipeline.probes.observation import Shots

CROP_DEG, CROP_YAWS, CROP_PITCHES = 66.0, 8, (-45.0, 0.0, 45.0)  # perspective windows onto the panorama
SMALLEST_FOCAL = 200.0  # px per radian of a window: coarser panoramas are enlarged, for SIFT's sake
LOWE_RATIO = 0.8
TRIALS, SEED = 4000, 0
COARSE_RAD, FINE_RAD = np.radians(2.0), np.radians(0.1)  # of a match: at first, and at least
FEWEST_MATCHES, SHARE = 8, 2e-3  # that must agree, and more of many: wrong ones agree to 2 degrees at 0.0006
LEAST_ALIKE, STANDS_OUT = 0.6, 0.15  # correlation of the tones at the right yaw, and its lead over others
FINEST_TEXELS = 0.1  # of the panorama: what interpolation and the feature's own place cost all matches alike
HORIZON = np.radians(3.0)  # below it a ray of the plate may end on the plane
FARTHEST = 20.0  # times the camera's height: beyond, the plane is no longer believed


@dataclass(frozen=True)
class Orientation:
    """``world_from_map`` (3, 3), its covariance (3, 3) rad^2 in the world, how it was found, and figures."""

    rotation: np.ndarray
    covariance: np.ndarray
    route: str
    numbers: dict[str, Any]

    @property
    def sigma_rad(self) -> float:
        """Standard uncertainty per axis."""
        return float(np.sqrt(np.trace(self.covariance) / 3))


def wahba(local: np.ndarray, world: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that minimises ``sum weight |world - R local|^2`` over unit directions (N, 3)."""
    return nearest_rotation((world * weight[:, None]).T @ local)


def rotation_covariance(world: np.ndarray, sigma_rad: np.ndarray) -> np.ndarray:
    """(3, 3) of a rotation known from world directions (N, 3), each to ``sigma_rad`` (N,) across itself."""
    weight = 1 / np.square(sigma_rad)
    information = np.eye(3) * weight.sum() - np.einsum("n,ni,nj->ij", weight, world, world)
    return np.linalg.inv(information)


def from_points(
    local: np.ndarray, world: np.ndarray, sigma_rad: np.ndarray, up_local: np.ndarray, up_sigma_rad: float
) -> Orientation:
    """From a few directions known in both frames (N, 3) and the picture's up, each with its uncertainty.

    With points that disagree by more than they say, the covariance grows by chi2 per degree of freedom (Birge 1932).
    """
    local = np.concatenate([local, up_local[None] / np.linalg.norm(up_local)])
    world = np.concatenate([world, [[0.0, 1.0, 0.0]]])
    sigma = np.append(sigma_rad, max(up_sigma_rad, 1e-6))
    rotation = wahba(local, world, 1 / sigma**2)
    apart = angles(local @ rotation.T, world)
    chi2 = float(((apart / sigma) ** 2).sum() / max(2 * len(sigma) - 3, 1))
    covariance = rotation_covariance(world, sigma) * max(chi2, 1.0)
    numbers = {"points": len(local) - 1, "residual_deg": np.degrees(apart).tolist(), "chi2_per_dof": chi2}
    return Orientation(rotation, covariance, "points", numbers)


def angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle [rad] (...) between unit directions (..., 3); exact for small ones."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=-1) / 2, 0, 1))


def from_features(latlong: np.ndarray, shown: np.ndarray, shots: Shots, centre: np.ndarray) -> Orientation | None:
    """From features that the plate shares with a lat-long picture (h, w, 3) in its own frame; None with too few.

    ``shown`` (h, w): False where the picture is empty; ``centre`` (3,): where it was taken, world frame.
    """
    local, px = matches(latlong, shown, shots)
    if len(local) < FEWEST_MATCHES:
        return None
    spot = np.unique(np.round(px), axis=0, return_inverse=True)[1].ravel()
    found = robust(local, *plate_directions(px, shots, centre), spot)
    if found is None:
        return None
    texel = FINEST_TEXELS * 2 * np.pi / latlong.shape[1]
    covariance = found.covariance + shots.views["plate"].covariance[:3, :3] + texel**2 * np.eye(3)
    return Orientation(found.rotation, covariance, found.route, found.numbers)


def from_overlap(
    latlong: np.ndarray, shown: np.ndarray, other: np.ndarray, other_shown: np.ndarray, known: Orientation
) -> Orientation | None:
    """From features that two lat-long pictures share, both in their own frames, the other's rotation ``known``."""
    focal = max(latlong.shape[1] / (2 * np.pi), SMALLEST_FOCAL)
    here, there = visible_windows(latlong, shown, focal), visible_windows(other, other_shown, focal)
    local, world = [np.empty((0, 3))], [np.empty((0, 3))]
    for picture in there:
        for window in here:
            on_other, on_this = feature_matches(picture.features, window.features, LOWE_RATIO)
            whole = window.holds(on_this) & picture.holds(on_other)
            local.append(window.directions(on_this[whole]))
            world.append(picture.directions(on_other[whole]) @ known.rotation.T)
    ours, theirs = np.concatenate(local), np.concatenate(world)
    if len(ours) < FEWEST_MATCHES:
        return None
    spot = np.unique(np.round(theirs, 2), axis=0, return_inverse=True)[1].ravel()
    found = robust(ours, theirs, np.full(theirs.shape, np.nan), spot)
    if found is None:
        return None
    return Orientation(found.rotation, found.covariance + known.covariance, "overlap", found.numbers)


def robust(local: np.ndarray, far: np.ndarray, near: np.ndarray, spot: np.ndarray) -> Orientation | None:
    """RANSAC and refinement over matches (N, 3); ``near`` is NaN where a spot cannot lie on the plane.

    ``spot`` (N,): equal for matches of one spot of the plate, which several windows show and which count once.
    """
    needed = FEWEST_MATCHES + SHARE * len(local)
    rotation = ransac(local, far, near, needed)
    if rotation is None:
        return None
    limit = COARSE_RAD
    for _ in range(20):
        world, apart = nearer(local @ rotation.T, far, near)
        kept = apart < limit
        if kept.sum() < needed:
            return None
        scale = max(float(np.median(apart[kept])) / 1.1774, FINE_RAD / 3)  # Rayleigh's median over its sigma
        weight = np.where(kept, 1 / np.maximum(apart / (1.5 * scale), 1), 0)
        before, rotation = rotation, wahba(local, world, weight)
        limit = min(COARSE_RAD, max(4 * scale, FINE_RAD))
        if np.abs(rotation - before).max() < 1e-9:
            break
    used = kept & (apart < limit)
    sigma = float(np.sqrt((apart[used] ** 2).sum() / max(2 * used.sum() - 3, 1)))
    spots = len(np.unique(spot[used]))
    covariance = rotation_covariance(world[used], np.full(int(used.sum()), sigma)) * used.sum() / spots
    numbers = {"matches": len(local), "agree": int(used.sum()), "spots": spots, "rms_deg": float(np.degrees(sigma)),
               "on_plane": int((np.isfinite(near[used, 0]) & (world[used] == near[used]).all(-1)).sum())}  # fmt: skip
    return Orientation(rotation, covariance, "features", numbers)


def from_tones(
    rgb: np.ndarray, shown: np.ndarray, shots: Shots, centre: np.ndarray, upright: np.ndarray, up_sigma_rad: float
) -> Orientation | None:
    """Yaw at which the picture's tones resemble the plate's most, given how it is upright; None when none stands out.

    Weighted correlation of log radiance on texels of 2.8 degrees, the plane seen from ``centre``; ``rgb`` (H, W, 3)
    is already turned by ``upright`` (3, 3). The peak must exceed 0.6, and every other by 0.15. Covariance: half a texel
    of yaw, and the stated uncertainty of up.
    """
    theirs, weight = seen_by_plate(shots, centre)
    share = resize_environment(shown[..., None].astype(float), *COARSE)[..., 0]
    ours = resize_environment(rgb * shown[..., None], *COARSE).mean(-1) / np.where(share > 0, share, 1)
    known = share > 0.99
    area = latlong_solid_angles(*COARSE) * weight * (theirs.mean(-1) > 0)
    if area.sum() < FEWEST_SR:
        return None
    tones = [
        np.log(np.maximum(picture, 1e-6 * max(float(picture.max()), 1e-30))) for picture in (ours, theirs.mean(-1))
    ]
    shifts = range(COARSE[1])
    score = np.array([_alike(np.roll(tones[0], k, 1), tones[1], area * np.roll(known, k, 1)) for k in shifts])
    best = int(score.argmax())
    apart = np.abs((np.arange(COARSE[1]) - best + COARSE[1] // 2) % COARSE[1] - COARSE[1] // 2)
    second = float(score[apart > 8].max())
    if score[best] < LEAST_ALIKE or score[best] - second < STANDS_OUT:
        return None
    left, middle, right = (float(score[(best + k) % COARSE[1]]) for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    step = 2 * np.pi / COARSE[1]
    # A roll by k columns raises u: the picture turns clockwise seen from above (u grows from -Z over +X).
    yaw = -step * (best + (0.5 * (left - right) / bend if bend < 0 else 0.0))
    covariance = np.diag([up_sigma_rad**2, (0.5 * step) ** 2, up_sigma_rad**2])
    numbers = {"correlation": middle, "second": second}
    return Orientation(rotation_exp(np.array([0, yaw, 0])) @ upright, covariance, "tones", numbers)


def _alike(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> float:
    """Weighted correlation (Pearson) of two pictures (H, W)."""
    weight = weight / max(float(weight.sum()), 1e-12)
    first, second = first - (weight * first).sum(), second - (weight * second).sum()
    power = (weight * first**2).sum() * (weight * second**2).sum()
    return float((weight * first * second).sum() / np.sqrt(power)) if power > 0 else 0.0


def nearer(turned: np.ndarray, far: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of two readings of each match the one that agrees better: directions (N, 3) and the angle left (N,)."""
    to_far, to_near = angles(turned, far), angles(turned, near)
    on_plane = np.isfinite(to_near) & (np.nan_to_num(to_near, nan=np.inf) < to_far)
    return np.where(on_plane[:, None], near, far), np.where(on_plane, to_near, to_far)


def ransac(local: np.ndarray, far: np.ndarray, near: np.ndarray, needed: float) -> np.ndarray | None:
    """The rotation of two matches with which most agree to 2 degrees; None with fewer than ``needed``."""
    rng = np.random.default_rng(SEED)
    plane = np.isfinite(near[:, 0])
    first, second = rng.integers(0, len(local), (2, TRIALS))
    read = [np.where((plane[i] & (rng.random(TRIALS) < 0.5))[:, None], near[i], far[i]) for i in (first, second)]
    sound = (first != second) & (np.abs(angles(local[first], local[second]) - angles(*read)) < COARSE_RAD)
    sound &= angles(local[first], local[second]) > np.radians(3.0)
    if not sound.any():
        return None
    frames = triad(read[0][sound], read[1][sound]) @ np.swapaxes(triad(local[first[sound]], local[second[sound]]), 1, 2)
    best, most = None, int(np.ceil(needed)) - 1
    for rotation in frames:
        _, apart = nearer(local @ rotation.T, far, near)
        agree = int((apart < COARSE_RAD).sum())
        if agree > most:
            best, most = rotation, agree
    return best


def triad(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(N, 3, 3) frames of pairs of directions (N, 3): along the first, across both, and the third."""
    across = np.cross(first, second)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([first, across, np.cross(first, across)], -1)


def plate_directions(px: np.ndarray, shots: Shots, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World directions (N, 3) from ``centre`` of plate pixels (N, 2): taken as far, and as on the plane (or NaN)."""
    view = shots.views["plate"].world_from_camera
    rays = pixel_rays(shots.camera, px) @ view[:3, :3].T
    eye = view[:3, 3]
    down = rays[:, 1] < -np.sin(HORIZON)
    reach = -eye[1] / np.where(down, rays[:, 1], -1.0)
    down &= (reach > 0) & (reach < FARTHEST * eye[1])
    arm = eye + reach[:, None] * rays - centre
    near = arm / np.linalg.norm(arm, axis=-1, keepdims=True)
    return rays, np.where(down[:, None], near, np.nan)


def matches(latlong: np.ndarray, shown: np.ndarray, shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) in the picture's frame and pixels (N, 2) of the plate that look like the same spot."""
    focal = max(latlong.shape[1] / (2 * np.pi), SMALLEST_FOCAL)
    step = max(1, int(shots.camera.fx / focal))
    plate = np.nan_to_num(grey(shots.photographs["plate"].rgb()))
    height, width = (n // step * step for n in plate.shape)
    plate = plate[:height, :width].reshape(height // step, step, width // step, step).mean((1, 3))
    found, local, px = features(coded(plate)), [np.empty((0, 3))], [np.empty((0, 2))]
    for window in visible_windows(latlong, shown, focal):
        on_plate, on_window = feature_matches(found, window.features, LOWE_RATIO)
        whole = window.holds(on_window)
        local.append(window.directions(on_window[whole]))
        px.append(on_plate[whole] * step)
    return np.concatenate(local), np.concatenate(px)


@dataclass(frozen=True)
class Window:
    """A perspective window onto a lat-long picture: its features, and which pixels are shown (N, N)."""

    features: Features
    shown: np.ndarray
    map_from_window: np.ndarray
    focal: float

    def holds(self, px: np.ndarray) -> np.ndarray:
        """Which pixels (N, 2) lie where the picture is not empty."""
        size = self.shown.shape[0]
        return np.asarray(self.shown[tuple(np.clip(px.astype(int), 0, size - 1).T[::-1])])

    def directions(self, px: np.ndarray) -> np.ndarray:
        """Directions (N, 3), the picture's frame, of pixels (N, 2)."""
        xy = (px - self.shown.shape[0] / 2) / self.focal
        ray = np.concatenate([xy, np.ones((len(xy), 1))], 1)
        return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True) @ self.map_from_window.T)


def visible_windows(latlong: np.ndarray, shown: np.ndarray, focal: float) -> list[Window]:
    """The windows of which at least 30 % are shown."""
    picture = np.dstack([grey(latlong), shown]).astype(np.float32)
    around = planes(np.concatenate([picture[:, -1:], picture, picture[:, :1]], 1))
    found = []
    for rotation in windows():
        u, v = latlong_from_direction(window_rays(focal) @ rotation.T)
        crop = bilinear(around, u * latlong.shape[1] + 1, v * latlong.shape[0])
        whole = crop[..., 1] > 0.999
        if whole.mean() > 0.3:
            tones = coded(np.where(whole, crop[..., 0], 0))
            found.append(Window(features(tones), whole, rotation, focal))
    return found


def coded(radiance: np.ndarray) -> np.ndarray:
    """(H, W) uint8 in which detail shows in light and shade alike."""
    return (tone(np.maximum(radiance, 0), "log") * 255 + 0.5).astype(np.uint8)


def windows() -> list[np.ndarray]:
    """``map_from_window`` (3, 3) of the perspective windows: x right, y down, z ahead."""
    upright = np.diag([-1.0, -1.0, 1.0])  # looks along +Z of the map, whose x is then to the left
    return [
        rotation_exp(np.array([0, np.radians(360 * i / CROP_YAWS), 0]))
        @ rotation_exp(np.array([-np.radians(pitch), 0, 0])) @ upright
        for pitch in CROP_PITCHES
        for i in range(CROP_YAWS)
    ]  # fmt: skip


def window_rays(focal: float) -> np.ndarray:
    """(N, N, 3) unit rays of a window's pixels, ``focal`` px."""
    size = int(2 * focal * np.tan(np.radians(CROP_DEG / 2)))
    y, x = (np.mgrid[:size, :size] + 0.5 - size / 2) / focal
    rays = np.stack([x, y, np.ones_like(x)], -1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def clicked(
    points: list[dict[str, Any]], size: tuple[int, int], shots: Shots, centre: np.ndarray, sigma_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (N, 3) in the map and in the world, and their sigma (N,) rad, of [[probe.point]] tables.

    ``size``: (h, w) of the picture that ``px`` points into. A pixel of the plate 3 degrees or more under the horizon is
    taken to show the plane, else something far.
    """
    local, world, sigma = [], [], []
    for point in points:
        x, y = point["px"]
        local.append(direction_from_latlong(np.array(x / size[1]), np.array(y / size[0])))
        if point.get("direction") is not None:
            w = np.array(point["direction"], float)
        elif point.get("world_m") is not None:
            w = np.array(point["world_m"], float) - centre
        else:
            far, near = plate_directions(np.array([point["plate_px"]], float), shots, centre)
            w = near[0] if np.isfinite(near[0]).all() else far[0]
        world.append(w / np.linalg.norm(w))
        sigma.append(np.hypot(sigma_px * 2 * np.pi / size[1], sigma_px / shots.camera.fx))
    return np.array(local), np.array(world), np.array(sigma)
