"""Where the mirror image of the plane puts the ball's centre: the photograph aligned with itself, pixel by pixel.

The plane's texture is seen twice, directly and in the ball. For an assumed centre every pixel of the ball is followed
to the plane and on to where that point is seen directly (`ball_pairs`), which predicts the ball's picture; the centre
is moved until both agree (Lucas and Kanade 1981, with the centre instead of a shift), from coarse to fine. The
logarithm is compared and its broad parts are taken off, so that reflectance, dirt and gloss change nothing, and a
Laplacian takes up that both are blurred unequally. All textured pixels speak, so that a ball of 30 px is enough.
Gloss that differs by place (a print on a lacquered table) needs more: the contrast is then left free (`contrast`).

What is left scatters more than noise and neighbours share it: the covariance is clustered by blocks (sandwich; White
1980). The pose moves all of them at once and comes in by its own covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.camera.lens import pixel_rays, project
from pipeline.conventions import invert_rigid, transform_points
from pipeline.probes.ball_pairs import Sight, ball_points, neighbourhood, plane_pairs
from pipeline.probes.contrast import local_gain, means, ramps, windowed
from pipeline.probes.glass import Glass
from pipeline.types import Camera, Raster, View

LUMA = np.array([0.25, 0.5, 0.25])  # in this sum the colour mosaic's errors cancel at first order
RIM, PREDICTED = 0.97, 0.99  # outermost radius whose pixels are compared, and predicted
SMOOTH_PX = (3.0, 2.0, 1.2, 0.8, 0.8, 0.8)  # of the rounds, coarse to fine; each about the moved centre
BROAD_PX = 3.5  # what is broader is not compared, or three times the smoothing
MOST_STEP_PX = 2.0
RAYS = 300  # over the radius in pixels: rays per axis and pixel, as small balls mirror the plane much reduced
RAYS_BLUR, BLUR_SIGMA = 1 / 6, 0.6  # variance [px^2] of the rays about a pixel; of the rim's, how sure that is
INSET_BLURS, MOST_INSET = 1.5, 0.03  # blurs, radii; at the border of what is compared the prediction lacks light
EDGE_BLURS = 2.5  # inside the rim, where the background is blurred in
LEAST_PIXELS, LEAST_BLOCKS, BLOCK_PX = 60, 9, 6
FLOOR_PX, FLOOR_LOG = 0.1, 3e-3  # what the prediction of a pixel is good to: its place, its logarithm
# What all pixels share beside the pose, in blurs: that of two pictures of the plane is never quite the same. Simulated
# balls of 60 to 100 px in colour mosaics, blurred by 0.6 to 1.2 px, were off by 0.02 to 0.06, those of 30 px by 0.16.
COMMON_BLURS = 0.1
MAX_CONDITION = 1e5


@dataclass(frozen=True)
class Aligned:
    """Centre (3,) [m], camera frame, with covariance (3, 3); ``left_px``: what no centre explains, as a shift.

    Where the contrast was left free it is the shift alone: what differs otherwise is the contrast's.
    """

    centre: np.ndarray
    covariance: np.ndarray
    left_px: float
    blocks: int


@dataclass(frozen=True)
class Equations:
    """Weighted equations of the pixels: residual (N,), by centre and blur (N, 4), by pose (N, 6), slope (N, 2).

    With glass asked for, its thickness, of the radius, is a fifth column. ``free``: the contrast was.
    """

    left: np.ndarray
    by_centre: np.ndarray
    by_pose: np.ndarray
    slope: np.ndarray
    weight: np.ndarray
    block: np.ndarray
    free: bool


def align(
    photograph: Raster, camera: Camera, view: View, centre: np.ndarray, radius: float, blur_px: float,
    glass: Glass | None = None, free: bool = False,
) -> Aligned | None:  # fmt: skip
    """The centre (3,) that makes ball and plane agree, started at ``centre`` [m, camera frame], good to a few pixels.

    ``blur_px``: of the photograph, to start with; what is seen in the ball is much reduced before it is blurred.
    ``free``: the contrast may differ from place to place. None when too few pixels mirror a textured part of the plane
    that is in the frame, or these leave the centre open.
    """
    start, blurred, inset = 0.0, None, 0
    for smooth in SMOOTH_PX:
        sight = neighbourhood(photograph, camera, view.world_from_camera, centre, radius, glass)
        pixel = radius / size_px(sight)
        if blurred is None:
            start = blurred = max((blur_px / sight.binned) ** 2 - RAYS_BLUR, 0.0)
            inset = int(min(np.ceil(INSET_BLURS * np.sqrt(start)), np.ceil(MOST_INSET * radius / pixel)))
        equations = equations_of(sight, smooth, blurred, inset, pixel, free=free)
        if equations is None:
            return None
        wider, wider_sigma = 0.5 * (start - blurred), 0.5 * BLUR_SIGMA * (start + RAYS_BLUR)
        held = np.diag([0, 0, 0, wider_sigma**-2])
        found = solve(equations, view.covariance, held, np.array([0, 0, 0, wider / wider_sigma**2]))
        if found is None:
            return None
        step, covariance, left, blocks = found
        blurred = float(max(blurred + 2 * step[3], 0.0))
        step = step[:3]
        centre = centre + pixel * step * min(1.0, MOST_STEP_PX / max(float(np.linalg.norm(step)), 1e-12))
    ray = centre / np.linalg.norm(centre)
    along = pixel * float(np.linalg.norm(centre)) / radius  # metres that change the outline's radius by a pixel
    common = pixel**2 * np.eye(3) + (along**2 - pixel**2) * np.outer(ray, ray)
    covariance = pixel**2 * covariance[:3, :3] + (COMMON_BLURS * blur_px / sight.binned) ** 2 * common
    return Aligned(centre, covariance, left * sight.binned, blocks)


def size_px(sight: Sight) -> float:
    """Radius in pixels of the sight, near enough."""
    return float(0.5 * (sight.camera.fx + sight.camera.fy) * sight.radius / sight.centre[2])


def equations_of(
    sight: Sight, smooth: float, blurred: float, inset: int, pixel: float, with_glass: bool = False,
    free: bool = False,
) -> Equations | None:  # fmt: skip
    """How the ball's picture differs from its prediction, and how that goes with the centre: pixels of metre ``pixel``.

    Columns are in pixels: a change of the centre by ``pixel`` metres. ``free``: up to local contrast.
    """
    limit = 1 - max(1 - RIM, EDGE_BLURS * np.sqrt(blurred + RAYS_BLUR) * pixel / sight.radius)
    pairs = plane_pairs(sight, PREDICTED, every=True, split=int(np.clip(RAYS * pixel / sight.radius, 3, 8)))
    pairs = pairs.at(np.asarray((np.minimum(pairs.mirrored, pairs.direct) > 0).all(1)))
    if len(pairs) < LEAST_PIXELS:
        return None
    column, row = pairs.pixel.T
    low = np.array([row.min(), column.min()])
    at = (row - low[0], column - low[1])
    shape = tuple(np.array([row.max(), column.max()]) - low + 1)

    def grid(values: np.ndarray) -> np.ndarray:
        out = np.zeros(shape)
        out[at] = values
        return out

    level = 2.0 ** np.round(np.log2(np.median(pairs.direct)))  # exposure's powers of two keep the bits
    known = grid(np.ones(len(pairs)))
    # Light is blurred, not its logarithm: at a shadow's edge of 1:2.5 they differ by a seventh of the blur.
    spread = np.stack([_smoothed(grid(part), known, np.sqrt(blurred))[at] for part in pairs.direct.T], -1)
    real, model = (_smoothed(grid(np.log(part / level) @ LUMA), known, smooth) for part in (pairs.mirrored, spread))
    slope, bend, inner = _derivatives(model, known)
    shift = _shifts(sight, pairs.pixel + 0.5, with_glass)
    inner = _shrunk(inner, inset)
    use = inner[at] & (pairs.sine < limit) & np.isfinite(shift).all((1, 2))
    if use.sum() < LEAST_PIXELS:
        return None
    used = grid(use)
    far = max(BROAD_PX, 3 * smooth)
    under = ramps(used, far) if free else means(used, far)

    def sharp(values: np.ndarray) -> np.ndarray:
        return np.asarray((values - under(values))[at][use])

    left = sharp(real - model)
    if free:
        there, detail = (used * (part - under(part)) for part in (real, model))
        gain = local_gain(there, detail, far)
        left = np.asarray((there - gain * detail)[at][use])
        slope, bend = gain[..., None] * slope, gain * bend
    moved = -np.einsum("ni,nij->nj", slope[at], np.nan_to_num(shift))
    columns = [sharp(grid(moved[:, k])) * pixel for k in range(3)] + [sharp(bend)]
    columns += [sharp(grid(moved[:, 9]))] if with_glass else []
    steep = slope[at][use]
    noise = (pairs.mirrored_variance / pairs.mirrored**2).mean(1)[use] / 3 / max(4 * np.pi * smooth**2, 1.0)
    weight = 1 / (noise + FLOOR_PX**2 * (steep**2).sum(1) + FLOOR_LOG**2)
    block = (row[use] // BLOCK_PX) * 100_000 + column[use] // BLOCK_PX
    return Equations(
        left, np.stack(columns, -1), np.stack([sharp(grid(moved[:, k])) for k in range(3, 9)], -1),
        steep, weight, np.unique(block, return_inverse=True)[1], free,
    )  # fmt: skip


def _smoothed(values: np.ndarray, known: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean (H, W) of the known values, zero where nothing is."""
    return windowed(values * known, sigma) / np.maximum(windowed(known, sigma), 1e-6) * known


def _shrunk(inside: np.ndarray, pixels: int) -> np.ndarray:
    """Without its outermost pixels (H, W)."""
    from scipy.ndimage import binary_erosion

    return binary_erosion(inside, iterations=pixels) if pixels else inside


def _derivatives(model: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradient (H, W, 2) along x and y, Laplacian (H, W), and where all four neighbours are known."""
    slope, bend = np.zeros((*model.shape, 2)), np.zeros(model.shape)
    inner = np.zeros(model.shape, bool)
    middle = (slice(1, -1), slice(1, -1))
    right, left, down, up = (
        (slice(1 + y, model.shape[0] - 1 + y), slice(1 + x, model.shape[1] - 1 + x))
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
    )
    inner[middle] = known[middle] * known[right] * known[left] * known[down] * known[up] > 0
    slope[middle] = 0.5 * np.stack([model[right] - model[left], model[down] - model[up]], -1)
    bend[middle] = model[right] + model[left] + model[down] + model[up] - 4 * model[middle]
    return slope, bend, inner


def _shifts(sight: Sight, px: np.ndarray, with_glass: bool = False) -> np.ndarray:
    """How far (N, 2, 9) the mirror image at pixels (N, 2) moves with the centre [px/m] and the pose; and the glass.

    The point of the plane is held, and what it is known by is the pixel ``P`` where it is seen directly:
    ``dx = -(dP/dx)^-1 dP/dq``, by central differences.
    """
    rays = pixel_rays(sight.camera, px)

    def direct(place: np.ndarray, changed: Sight) -> np.ndarray:
        point = ball_points(changed, place, rays if place is px else None)[3]
        return project(changed.camera, transform_points(invert_rigid(changed.world_from_camera), point))

    def change(plus: np.ndarray, minus: np.ndarray, step: float) -> np.ndarray:
        return (plus - minus) / (2 * step)

    quarter = 0.25
    by_px = [change(direct(px + quarter * e, sight), direct(px - quarter * e, sight), quarter) for e in np.eye(2)]
    by_q = []
    for e in np.eye(3):
        step = 1e-3 * sight.radius
        both = [direct(px, replace(sight, centre=sight.centre + sign * step * e)) for sign in (1, -1)]
        by_q.append(change(both[0], both[1], step))
    for e in np.eye(6):
        step = 1e-4
        both = [direct(px, replace(sight, world_from_camera=_turned(sight, sign * step * e))) for sign in (1, -1)]
        by_q.append(change(both[0], both[1], step))
    if with_glass:
        step, glass = 1e-3, sight.glass or Glass(0.0)
        thinner, thicker = (replace(glass, thickness=glass.thickness + sign * step) for sign in (-1, 1))
        both = [direct(px, replace(sight, glass=one)) for one in (thicker, thinner)]
        by_q.append(change(both[0], both[1], step))
    jacobian, by_q_px = np.stack(by_px, -1), np.stack(by_q, -1)
    good = np.isfinite(jacobian).all((1, 2)) & np.isfinite(by_q_px).all((1, 2))
    good &= np.abs(np.linalg.det(np.where(good[:, None, None], jacobian, 0))) > 1e-6
    found = np.full(by_q_px.shape, np.nan)
    found[good] = -np.linalg.solve(jacobian[good], by_q_px[good])
    return found


def _turned(sight: Sight, change: np.ndarray) -> np.ndarray:
    """The sight's pose (4, 4) changed by (rotation vector [rad], position [m]), small, in the world frame."""
    x, y, z = change[:3]
    turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = sight.world_from_camera.copy()
    pose[:3, :3] = np.linalg.svd(turn)[0] @ np.linalg.svd(turn)[2] @ pose[:3, :3]
    pose[:3, 3] += change[3:]
    return pose


def solve(
    equations: Equations, pose: np.ndarray, held: np.ndarray, pull: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, int] | None:
    """Step (K,) of centre, blur and what else is asked, its covariance (K, K), what is left [px], number of blocks.

    ``pose`` (6, 6) is its covariance; ``held`` (K, K) is what is known before of the step, as an inverse covariance,
    and ``pull`` (K,) that times where it ought to be. None where the centre stays open. Cauchy's weights: dirt, gloss
    and what stands between plane and ball is astray.
    """
    columns, target, own = equations.by_centre, equations.left, equations.weight
    weight, solved, over = own, np.zeros(len(held)), target
    for _ in range(10):
        normal = columns.T @ (weight[:, None] * columns) + held
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > MAX_CONDITION:
            return None
        solved = np.linalg.solve(normal, columns.T @ (weight * target) + pull)
        over = target - columns @ solved
        middle = float(np.median(np.abs(over) * np.sqrt(own))) / 0.6745 + 1e-9
        weight = own / (1 + own * (over / (2 * middle)) ** 2)
    score = np.stack([np.bincount(equations.block, weight * over * column) for column in columns.T], -1)
    blocks = len(score)
    if blocks < LEAST_BLOCKS:
        return None
    inverse = np.linalg.inv(normal)
    lever = inverse @ columns.T @ (weight[:, None] * equations.by_pose)
    spread = inverse @ (score.T @ score) @ inverse * blocks / (blocks - 4)
    known = held.copy()
    known[3, 3] = 0  # the blur's is an opinion
    covariance = spread + inverse @ known @ inverse + lever @ pose @ lever.T
    return solved, covariance, left_px(equations, over, weight), blocks


def left_px(equations: Equations, over: np.ndarray, weight: np.ndarray) -> float:
    """What is left ``over`` (N,) as a shift [px]: all of it over the slopes; with free contrast the blocks' shifts.

    A block's residual is projected on its slopes along x and y; what they take up by chance, two degrees of freedom of
    the rest's scatter, is subtracted.
    """
    slope = equations.slope
    steep = float((weight[:, None] * slope**2).sum())
    if not equations.free:
        return float(np.sqrt((weight * over**2).sum() / steep))
    pixels = np.bincount(equations.block)
    normal, pull = np.zeros((len(pixels), 2, 2)), np.zeros((len(pixels), 2))
    np.add.at(normal, equations.block, weight[:, None, None] * slope[:, :, None] * slope[:, None])
    np.add.at(pull, equations.block, (weight * over)[:, None] * slope)
    shift = np.linalg.solve(normal + 1e-9 * steep * np.eye(2), pull[..., None])[..., 0]
    taken = (shift * pull).sum(1)
    rest = np.bincount(equations.block, weight * over**2) - taken
    chance = 2 * rest.sum() / max(np.maximum(pixels - 2, 0).sum(), 1)
    return float(np.sqrt(max(float(taken.sum() - len(pixels) * chance), 0.0) / steep))
