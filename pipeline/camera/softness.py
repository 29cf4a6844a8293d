"""How soft a photograph is, measured on the black and white edges of the board or marker that it shows.

A slanted edge (ISO 12233) samples its own blur more finely than the pixels do. With pose and lens known, the straight
edges of the print are projected, and the pixels beside each, as they are (interpolation would blur them), are fitted by

    v = dark + contrast F((x - offset) / b),   x: distance from the projected edge along its normal, px,

``F`` a Gaussian's integral; levels and offset may tilt along the edge. ``b`` holds lens, demosaicking and the pixel's
own box, whose variance is 1/12 whichever way the edge runs (the convention of `simulation.lens.blur`); that a box is no
Gaussian is told to ``F`` by its fourth cumulant (Edgeworth's first term, which a symmetric kernel has). Between a black
square of a ChArUco board and the marker beside it the white is so narrow that both its edges are fitted, their distance
known. Each edge says for itself how sure it is of ``b``: one along the pixel rows meets few phases of the grid and
counts for little. Edges that are clipped, faint, covered or crossed by a shadow fit badly and are left out.

Limits: one softness per picture, where the print lies; what lies nearer or farther may be out of focus. A sharpened
edge (JPEG) gives its nearest Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pipeline.camera.board_families import charuco_centres
from pipeline.camera.board_kinds import kind_of
from pipeline.camera.lens import project
from pipeline.camera.markers import SQUARE, grey
from pipeline.camera.opencv_bridge import marker_cells
from pipeline.camera.rigid import camera_points
from pipeline.conventions import BOX_PX2, CLIPPED, HOT, WORLD_FROM_BOARD, WORLD_FROM_MARKER, transform_points
from pipeline.image.demosaic import ADDED_PX2
from pipeline.types import Camera, Raster

PIECE_PX = 32  # longest piece of an edge: short enough for lens and light to be straight along it
SHORTEST_PX = 8.0  # of a piece
MOST_PIECES = 100  # evenly taken: more cost time and tell no more
FEWEST_PIECES = 6  # that must agree
CLEAR = 0.4  # of the distance of an edge that the fit does not know: what lies farther has that one's blur in it
FAR = 1 - CLEAR
MOST_LEFT_OUT = 0.3  # of a side, at either end
LEAST_REACH_PX = 1.2  # on either side: with less no level is seen
REACHES_PX = (6.0, 24.0)  # pixels taken on either side; the second where the first shows less than WIDE blurs
WIDE = 3.5
MOST_FLAWED = 0.3  # of the pixels beside a piece, which is left out beyond it
UNKNOWNS, STEPS, START_PX, LONGEST_STEP = 7, 10, 0.7, 0.4
B_RANGE_PX, TINY = (0.15, 20.0), 1e-30
LEAST_LEVELLED = 7  # pixels beyond b on either side: where one side clips, nothing tells the contrast
LEAST_CONTRAST = 0.5  # of the white side
FAINT = 0.25  # of the median contrast: in deep shadow
MISFIT = 3.0  # times the median misfit: covered, or crossed by a shadow
FARTHEST_PX = 1.5  # an edge this far from where it is projected is another one
NEAREST = 2.3  # blurs that an edge unknown to the fit must stay away
OUTLYING = 3.5  # standard deviations
# What an edge cannot know, as shares of b; measured on simulated plates (tests/test_softness.py):
FEW_PHASES = 0.025  # over the px that it drifts across the grid
LEAKED = 2.5  # times the part of an unknown edge that shines in
MODEL = 0.01  # and what all share: lens and demosaicking are no Gaussians
PIXEL_BOX_PX, PIXEL_BOX_CUMULANT = 12**-0.5, -1 / 120  # standard deviation and fourth cumulant, of a box of width 1
FLAWED = CLIPPED | HOT  # where frames disagree one frame is taken, as sharp as the others


@dataclass(frozen=True)
class Softness:
    """Standard deviation ``b`` of the picture's Gaussian [px], pixel box included, and what says so."""

    px: float
    sigma_px: float  # standard uncertainty of ``px``: the edges' own scatter over their number
    spread_px: float  # standard deviation over the edges, their own uncertainty taken off: how b varies over the print
    edges: int  # pieces of edges that were used
    tried: int

    @property
    def local_sigma_px(self) -> float:
        """Standard uncertainty of the softness at one place, where ``px`` is its mean over the print."""
        return float(np.hypot(self.sigma_px, self.spread_px))


@dataclass(frozen=True)
class Lens:
    """Standard deviation [px] of lens and pixel box together, and its standard uncertainty at one place."""

    px: float
    sigma_px: float


def of_lens(seen: Softness, method: str | None) -> Lens:
    """What of a picture's softness lens and pixel make, without demosaicking by ``method`` (None: as the file has it).

    No pixel is sharper than its box: a picture that looks so was sharpened.
    """
    added, unsure = ADDED_PX2.get(method or "", (0.0, 0.0))
    px = float(np.sqrt(max(seen.px**2 - added, BOX_PX2)))
    return Lens(px, float(np.hypot(2 * seen.px * seen.local_sigma_px, unsure) / (2 * px)))


@dataclass(frozen=True)
class Edges:
    """Straight edges of a print in the world.

    ``ends``: (N, 2, 3) m, the white side to the left of start to end, seen from outside. ``widths``: (N, 3) m, how far
    the print is black on one side, white on the other, and black again behind the white (0: nobody knows).
    """

    ends: np.ndarray
    widths: np.ndarray


def softness(
    photograph: Raster, camera: Camera, world_from_camera: np.ndarray, facts: dict[str, Any]
) -> Softness | None:
    """Softness of a developed photograph at the print that ``facts`` describes; None when too few edges can be used."""
    edges = print_edges(facts)
    if edges is None:
        return None
    mask = photograph.channels.get("mask")
    flawed = None if mask is None else np.bitwise_and(mask.astype(np.uint32), FLAWED) > 0
    return softness_of(grey(photograph.rgb()), flawed, camera, world_from_camera, edges)


def print_edges(facts: dict[str, Any]) -> Edges | None:
    """Edges of the board, else of the first marker, which is at the world's origin; None without either."""
    board, markers = facts.get("board"), facts.get("marker")
    if board:
        flat = {"charuco": _charuco, "grid": _grid, "chessboard": _chessboard}[kind_of(board)](board)
        return _placed(WORLD_FROM_BOARD, *flat)
    if markers:
        side, cell = markers[0]["side_m"], markers[0]["side_m"] / marker_cells(markers[0]["dictionary"])
        flat = _sides(np.full((1, 2), -0.5 * side), side, (cell, cell, 0.0), FAR * cell)
        return _placed(WORLD_FROM_MARKER @ np.diag([1.0, -1.0, -1.0, 1.0]), *flat)
    return None


def _placed(world_from_print: np.ndarray, ends: np.ndarray, widths: np.ndarray) -> Edges:
    """Edges of flat ends (N, 2, 2), x right and y down the print, m."""
    solid = np.concatenate([ends, np.zeros((*ends.shape[:2], 1))], -1)
    return Edges(transform_points(world_from_print, solid), widths)


def _sides(
    corners: np.ndarray, side: float, widths: tuple[float, float, float], left_out: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ends (4 N, 2, 2) and widths (4 N, 3) of black squares of ``side`` whose first corners are (N, 2), y down.

    ``left_out``: m at either end of each side, where other edges are near.
    """
    at = corners[:, None] + SQUARE * side
    inward = (np.roll(at, -1, 1) - at) / side * min(left_out, MOST_LEFT_OUT * side)
    ends = np.stack([at + inward, np.roll(at, -1, 1) - inward], 2).reshape(-1, 2, 2)
    return ends, np.tile(widths, (len(ends), 1))


def _inner(ends: np.ndarray, board: dict[str, Any], margin: float) -> np.ndarray:
    """(N,) which edges lie farther than ``margin`` m from the outline of the squares."""
    middle, size = ends.mean(1), np.array(board["squares"]) * board["square_m"]
    return np.asarray(((middle > margin) & (middle < size - margin)).all(-1))


def _between_squares(
    board: dict[str, Any], white: float, again: float, left_out: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ends and widths of the edges between black squares and white ones; the rest as in `_sides`."""
    (across, down), square = board["squares"], board["square_m"]
    white_first = bool(board.get("legacy")) and down % 2 == 0
    black = [(x, y) for y in range(down) for x in range(across) if (x + y) % 2 == int(white_first)]
    ends, widths = _sides(np.array(black, float) * square, square, (square, white, again), left_out)
    inner = _inner(ends, board, 0.25 * square)
    return ends[inner], widths[inner]


def _charuco(board: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    square, marker = board["square_m"], board["marker_m"]
    gap, cell = 0.5 * (square - marker), marker / marker_cells(board["dictionary"])
    across, down = board["squares"]
    centres = charuco_centres(across, down, bool(board.get("legacy"))) * square
    ends, widths = _sides(centres - 0.5 * marker, marker, (cell, gap, square), FAR * min(cell, gap))
    widths[~_inner(ends, board, 1.5 * gap), 2] = 0.0  # there the margin begins
    squares = _between_squares(board, gap, cell, gap + FAR * cell)  # beside the whole border of the marker
    return np.concatenate([squares[0], ends]), np.concatenate([squares[1], widths])


def _grid(board: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    (across, down), pitch, marker = board["squares"], board["square_m"], board["marker_m"]
    index = np.arange(across * down)
    centres = (np.stack([index % across, index // across], -1) + 0.5) * pitch
    cell, gap = marker / marker_cells(board["dictionary"]), pitch - marker
    ends, widths = _sides(centres - 0.5 * marker, marker, (cell, gap, cell), FAR * min(cell, gap))
    widths[~_inner(ends, board, gap)] = (cell, 0.5 * gap, 0.0)  # there the margin begins
    return ends, widths


def _chessboard(board: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    return _between_squares(board, board["square_m"], 0.0, MOST_LEFT_OUT * board["square_m"])


@dataclass(frozen=True)
class Pieces:
    """Short straight pieces of edges in the picture: middle, unit direction, unit normal to the white side, (N, 2)."""

    middle: np.ndarray
    along: np.ndarray
    normal: np.ndarray
    length: np.ndarray  # (N,) px
    widths: np.ndarray  # (N, 3) px, as of `Edges`
    opens: np.ndarray  # (N,) px by which the white is wider at the end than in the middle: perspective

    @property
    def back(self) -> np.ndarray:
        """(N,) px from the edge to the one where the white ends, inf where what follows is not known."""
        return np.where(self.widths[:, 2] > 0, self.widths[:, 1], np.inf)

    @property
    def reach(self) -> np.ndarray:
        """(N, 2) px that pixels may lie away, on the black and on the white side; at most on the next edge."""
        white = np.where(self.widths[:, 2] > 0, 1.0, CLEAR) * self.widths[:, 1]
        return np.stack([CLEAR * self.widths[:, 0], white], -1)

    @property
    def stranger(self) -> np.ndarray:
        """(N,) px from the farthest of these pixels to the nearest edge that the fit does not know."""
        white = np.where(self.widths[:, 2] > 0, self.widths[:, 2], FAR * self.widths[:, 1])
        return np.minimum(FAR * self.widths[:, 0], white)

    @property
    def phases(self) -> np.ndarray:
        """(N,) px that the piece drifts across the pixel grid: how many phases of a pixel it meets."""
        return self.length * np.abs(self.along).min(1)

    def __getitem__(self, chosen: np.ndarray) -> Pieces:
        return Pieces(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def turned(self) -> Pieces:
        """With x and y changed over, as in the transposed picture."""
        middle, along, normal = (part[:, ::-1] for part in (self.middle, self.along, self.normal))
        return replace(self, middle=middle, along=along, normal=normal)


def softness_of(
    picture: np.ndarray, flawed: np.ndarray | None, camera: Camera, world_from_camera: np.ndarray, edges: Edges
) -> Softness | None:
    """Softness of a grey picture (H, W), linear, at the edges of a print; ``flawed``: (H, W) pixels not to be used."""
    pieces, found = pieces_of(edges, camera, world_from_camera), None
    for reach in REACHES_PX:
        found = combined(pieces, fitted_pieces(picture, flawed, pieces, reach)) or found
        if found is not None and WIDE * found.px < reach:
            break
    return found


def pieces_of(edges: Edges, camera: Camera, world_from_camera: np.ndarray) -> Pieces:
    """Pieces of the edges that lie within the picture, their ends left out as far as other edges reach there."""

    def pixels(world: np.ndarray) -> np.ndarray:
        flat = camera_points(world_from_camera, world.reshape(-1, 3))[0]
        return project(camera, flat).reshape(*world.shape[:-1], 2)

    start, along_m = edges.ends[:, 0], edges.ends[:, 1] - edges.ends[:, 0]
    whole_m = np.linalg.norm(along_m, axis=-1)
    # an end that the lens does not show has no pixel: NaN, length 0, and the edge is not cut into pieces
    whole = np.nan_to_num(np.linalg.norm(pixels(start + along_m) - pixels(start), axis=-1))
    whole = np.minimum(whole, camera.width + camera.height)  # one that ends beside the lens is longer
    of, number, share = _cut(np.where(whole >= SHORTEST_PX, np.ceil(whole / PIECE_PX), 0).astype(int))
    first = start[of] + (number * share)[:, None] * along_m[of]
    step = share[:, None] * along_m[of]
    a, b = pixels(first), pixels(first + step)
    middle, length = 0.5 * (a + b), np.linalg.norm(b - a, axis=-1)
    along = (b - a) / length[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], -1)
    left = np.cross([0.0, 1.0, 0.0], along_m[of]) / whole_m[of, None]

    def width(place: float, which: int) -> np.ndarray:
        """(N,) px from the line through the piece to what is parallel to it in the world, at a place in [0, 1]."""
        aside = (1, -1)[which == 0] * edges.widths[of, which, None] * left
        return np.asarray(np.abs(((pixels(first + place * step + aside) - middle) * normal).sum(-1)))

    ends = width(0.0, 1), width(1.0, 1)
    white = 0.5 * (ends[0] + ends[1])
    again = edges.widths[of, 2] / edges.widths[of, 1] * white
    widths = np.stack([width(0.5, 0), white, again], -1)
    pieces = Pieces(middle, along, normal, length, widths, 0.5 * (ends[1] - ends[0]))
    inside = (np.minimum(a, b) > 2).all(-1) & (np.maximum(a, b) < [camera.width - 2, camera.height - 2]).all(-1)
    return pieces[inside & np.isfinite(pieces.widths).all(-1) & (pieces.reach.min(1) >= LEAST_REACH_PX)]


def _cut(pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges cut into so many ``pieces`` (N,) each: of which edge, which piece of it, its share; evenly thinned out."""
    of = np.repeat(np.arange(len(pieces)), pieces)
    number = np.arange(len(of)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    chosen = (np.arange(min(len(of), MOST_PIECES)) * max(1.0, len(of) / MOST_PIECES)).astype(int)
    return of[chosen], number[chosen], 1.0 / pieces[of[chosen]]


@dataclass(frozen=True)
class Samples:
    """Pixels beside N edges, P places each, and what the fit knows of the edges."""

    value: np.ndarray  # (N, P)
    x: np.ndarray  # (N, P) px from the edge to the white side
    t: np.ndarray  # (N, P) in [-1, 1] along the edge
    weight: np.ndarray  # (N, P), 1 where the place is a pixel to be used, else 0
    back: np.ndarray  # (N, P) px from the edge to the one where the white ends, or inf
    cumulant: np.ndarray  # (N,) px^4, fourth of the pixel's box along the normal


@dataclass(frozen=True)
class Fits:
    """What each of N edges says: b, its own uncertainty and offset [px], misfit over contrast, levels."""

    b: np.ndarray
    sigma: np.ndarray
    misfit: np.ndarray
    contrast: np.ndarray
    offset: np.ndarray
    dark: np.ndarray
    levelled: np.ndarray  # pixels that show the level on the side that has fewer of them


def fitted_pieces(picture: np.ndarray, flawed: np.ndarray | None, pieces: Pieces, farthest: float) -> Fits:
    """Every piece's fit to the pixels at most ``farthest`` px from it."""
    steep = np.abs(pieces.along[:, 1]) > np.abs(pieces.along[:, 0])
    order, parts = np.concatenate([np.flatnonzero(~steep), np.flatnonzero(steep)]), []
    if (~steep).any():
        parts.append(fitted(_beside(picture, flawed, pieces[~steep], farthest)))
    if steep.any():
        turned = None if flawed is None else flawed.T
        parts.append(fitted(_beside(picture.T, turned, pieces[steep].turned(), farthest)))
    back = np.argsort(order)
    joined = {f.name: np.concatenate([np.empty(0), *(getattr(part, f.name) for part in parts)]) for f in fields(Fits)}
    return Fits(**{name: values[back] for name, values in joined.items()})


def _beside(picture: np.ndarray, flawed: np.ndarray | None, pieces: Pieces, farthest: float) -> Samples:
    """The pixels beside pieces that run along the rows rather than the columns: walked column by column."""
    far = np.minimum(pieces.reach, farthest)
    half = 0.5 * pieces.length
    steps = np.arange(-(PIECE_PX // 2) - 1, PIECE_PX // 2 + 2)
    side = int(np.ceil(np.sqrt(2) * far.max())) + 1
    column = np.floor(pieces.middle[:, :1]).astype(int) + steps
    slope = pieces.along[:, 1:] / pieces.along[:, :1]
    crossing = pieces.middle[:, 1:] + slope * (column + 0.5 - pieces.middle[:, :1])
    row = np.floor(crossing).astype(int)[:, :, None] + np.arange(-side, side + 1)
    shape = (len(half), -1)
    column = np.broadcast_to(column[:, :, None], row.shape).reshape(shape)
    row = row.reshape(shape)
    dx, dy = column + 0.5 - pieces.middle[:, :1], row + 0.5 - pieces.middle[:, 1:]
    t = (dx * pieces.along[:, :1] + dy * pieces.along[:, 1:]) / half[:, None]
    x = dx * pieces.normal[:, :1] + dy * pieces.normal[:, 1:]
    within = (np.abs(t) <= 1) & (x >= -far[:, :1]) & (x <= far[:, 1:])
    within &= (row >= 0) & (row < picture.shape[0]) & (column >= 0) & (column < picture.shape[1])
    order = np.argsort(~within, axis=1, kind="stable")[:, : max(1, int(within.sum(1).max()))]  # the empty places last
    row, column, t, x, within = (np.take_along_axis(part, order, 1) for part in (row, column, t, x, within))
    at = np.where(within, row, 0), np.where(within, column, 0)
    value = picture[at].astype(float)
    sound = np.isfinite(value) if flawed is None else np.isfinite(value) & ~flawed[at]
    whole = (within & ~sound).sum(1) <= MOST_FLAWED * within.sum(1)
    used = within & sound & whole[:, None]
    back = pieces.back[:, None] + pieces.opens[:, None] * t
    fourth = PIXEL_BOX_CUMULANT * (pieces.normal**4).sum(-1)
    return Samples(np.where(used, value, 0.0), x, t, used.astype(float), back, fourth)


def fitted(samples: Samples) -> Fits:
    """Gauss and Newton on dark, contrast and offset, their tilts along the edge, and b: all edges at once."""
    count = len(samples.value)
    offset, tilt, b = np.zeros(count), np.zeros(count), np.full(count, START_PX)
    for _ in range(STEPS):
        columns, levels, left = _linearised(samples, offset, tilt, b)
        matrix, right, size = _normal_equations(columns, left)
        step = np.linalg.solve(matrix, right)[..., 0] / size
        offset += np.clip(step[:, 4], -LONGEST_STEP, LONGEST_STEP)
        tilt += np.clip(step[:, 5], -LONGEST_STEP, LONGEST_STEP)
        b *= np.exp(np.clip(step[:, 6] / b, -LONGEST_STEP, LONGEST_STEP))
        b = np.clip(b, *B_RANGE_PX)
    columns, levels, left = _linearised(samples, offset, tilt, b)
    aside = samples.x - offset[:, None]
    levelled = [(samples.weight * (sign * aside > b[:, None])).sum(1) for sign in (-1, 1)]
    variance = (left**2).sum(1) / np.maximum(samples.weight.sum(1) - UNKNOWNS, 1)
    matrix, _, size = _normal_equations(columns, left)
    own = np.linalg.inv(matrix)[:, 6, 6] / size[:, 6] ** 2 * variance
    contrast = np.where(levels[:, 2] == 0, np.nan, levels[:, 2])
    return Fits(b, np.sqrt(own), np.sqrt(variance) / contrast, contrast, offset, levels[:, 0], np.minimum(*levelled))


def _normal_equations(columns: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrices (N, 7, 7) and right sides (N, 7, 1) of columns brought to length 1, and their lengths (N, 7).

    The matrices are held off zero, where pixels say nothing.
    """
    size = np.sqrt((columns**2).sum(1)) + TINY
    transposed = columns.swapaxes(1, 2)
    matrix = transposed @ columns / (size[:, :, None] * size[:, None, :])
    return matrix + 1e-9 * np.eye(UNKNOWNS), transposed @ left[..., None] / size[..., None], size


def _linearised(
    samples: Samples, offset: np.ndarray, tilt: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives (N, P, 7), the levels that fit best (N, 4: dark, its tilt, contrast, its tilt), the rest (N, P)."""
    x = samples.x - offset[:, None] - tilt[:, None] * samples.t
    rise, slope, widening = _edge(x, b, samples.cumulant)
    two = np.isfinite(samples.back[:, 0])
    if two.any():
        fall = _edge(x[two] - samples.back[two], b[two], samples.cumulant[two])
        for whole, second in zip((rise, slope, widening), fall, strict=True):
            whole[two] -= second
    w, t = samples.weight, samples.t
    columns = np.empty((*x.shape, UNKNOWNS))
    columns[..., 0], columns[..., 1], columns[..., 2], columns[..., 3] = w, w * t, w * rise, w * rise * t
    linear = columns[..., :4]
    matrix = linear.swapaxes(1, 2) @ linear
    size = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    value = (w * samples.value)[..., None]
    levels = np.linalg.solve(matrix + (1e-12 * size + TINY) * np.eye(4), linear.swapaxes(1, 2) @ value)
    contrast = w * (levels[:, 2] + levels[:, 3] * t)
    columns[..., 4] = -contrast * slope
    columns[..., 5] = columns[..., 4] * t
    columns[..., 6] = -contrast * widening
    return columns, levels[..., 0], (value - linear @ levels)[..., 0]


def _edge(x: np.ndarray, b: np.ndarray, cumulant: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An edge at x (N, P) px from it, and its derivatives by x and, less its sign, by b."""
    from scipy.special import ndtr

    z = x / b[:, None]
    square = z * z
    bell = np.exp(-0.5 * square) / np.sqrt(2 * np.pi)
    # a sharpened edge may be sharper than the box, whose excess is the most that there is
    excess = (cumulant / np.maximum(b, PIXEL_BOX_PX) ** 4 / 24)[:, None]
    slope = bell * (1 + excess * (square * square - 6 * square + 3)) / b[:, None]
    return ndtr(z) - excess * z * (square - 3) * bell, slope, slope * z


def combined(pieces: Pieces, fits: Fits) -> Softness | None:
    """The mean of what the edges say, each weighted by what it cannot know and by how much they differ; robust."""
    from scipy.special import ndtr

    good = (fits.levelled >= LEAST_LEVELLED) & (fits.contrast > LEAST_CONTRAST * (fits.dark + fits.contrast))
    good &= (np.abs(fits.offset) < FARTHEST_PX) & (fits.b > B_RANGE_PX[0])
    if good.any():
        # By what all say: an edge that is too near another says a smaller b itself.
        good &= pieces.stranger > NEAREST * np.median(fits.b[good])
    if good.any():
        good &= fits.contrast > FAINT * np.median(fits.contrast[good])
        good &= fits.misfit < MISFIT * np.median(fits.misfit[good])
    if good.sum() < FEWEST_PIECES:
        return None
    b = fits.b[good]
    few = FEW_PHASES / np.maximum(pieces.phases[good], 0.05)
    leaked = LEAKED * ndtr(-pieces.stranger[good] / b)
    own = np.sqrt(fits.sigma[good] ** 2 + (few**2 + leaked**2) * np.median(b) ** 2)
    kept, centre = np.ones(len(b), bool), float(np.median(b))
    spread = 1.4826 * float(np.median(np.abs(b - centre)))
    for _ in range(4):
        kept = np.abs(b - centre) <= OUTLYING * np.sqrt(own**2 + spread**2)
        if kept.sum() < FEWEST_PIECES:
            return None
        centre, sigma, spread = random_effects(b[kept], own[kept])
    return Softness(centre, float(np.hypot(sigma, MODEL * centre)), spread, int(kept.sum()), len(pieces.length))


def random_effects(value: np.ndarray, sigma: np.ndarray) -> tuple[float, float, float]:
    """Mean, its standard uncertainty, and the standard deviation among values (N,) beyond their own ``sigma`` (N,).

    DerSimonian and Laird 1986.
    """
    weight = 1 / sigma**2
    mean = (weight * value).sum() / weight.sum()
    excess = (weight * (value - mean) ** 2).sum() - (len(value) - 1)
    between = max(excess / (weight.sum() - (weight**2).sum() / weight.sum()), 0.0)
    weight = 1 / (sigma**2 + between)
    mean = (weight * value).sum() / weight.sum()
    return float(mean), float(weight.sum() ** -0.5), float(np.sqrt(between))
