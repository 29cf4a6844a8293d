"""Lights a few photosites wide: what a mosaic's photosites make of them is taken off their bilinear picture.

Bilinear kernels keep each colour's sum, so the light of a lamp that a picture shows is, in each colour, a sum over that
colour's photosites: a quarter of all for red and blue. By Poisson's formula the sum is off by what the lamp's picture
has at the photosites' frequency, with the sign and size that the lamp's place among them gives: 13 % rms of a lamp of 3
to 12 px behind a lens of 0.55 px. One colour alone cannot tell it, all photosites together can: a lamp has one shape
in all colours, and behind a lens, at the pitch of all photosites, next to nothing of it is lost. So a uniform ellipse
behind a Gaussian is fitted to the mosaic, with a flux and a background for each colour. Only what bilinear
interpolation would do wrong with that fit is taken off: as far as the lamp is no such ellipse its light stays as it was
photographed, and errs as it did. See `benchmarks.sampled_lamps`.

Limits: a lens is taken for a Gaussian, a lamp for uniform and of one colour; what touches a clipped photosite is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.image.demosaic import demosaic

RESTORED = "insitu:restored"  # in a photograph's header: 1 where no small light kept its aliases, else 0
LENS_PX, LENS_LOG_SIGMA = 0.68, 0.25  # lens and pixel, of the sharpest lenses and softer; what the fit starts from
FIT = 0.01  # of the lamp's peak: what the fit is to reach, so that the lens' prior counts where a lamp cannot tell
STANDS_OUT, GLARES = 4.0, 20.0  # times its surroundings, and the picture's median: print and highlights are no lamps
EDGE = 0.15  # of its peak: where a lamp ends
LARGEST_PX = 220  # of what is so bright: more photosites sample a lamp well
APART_PX = 4  # a lamp is the brightest within so many
MOST = 48  # lamps of a picture, brightest first
MARGIN_PX = 4  # around that, in which the lamp's light ends
BESIDE_PX = 2.5  # of background around a lamp, in the fit
# Of the lamp's sum of squares, what the fit may leave. Ellipses leave up to 0.0018 behind a simulated lens that is no
# Gaussian; windows with bars and pairs of lamps 0.005 to 0.2: of them the fit tells nothing, or the wrong.
UNEXPLAINED = 0.004
RINGS, RING_PX = 5, 0.8  # of points in a disc, at least, and how far apart at most
FAINT = 0.02  # of the brightest colour's peak: a colour with less has no light of its own to correct
WORST = 0.8  # relative error of a colour's sum beyond which the fit is not believed


@dataclass(frozen=True, eq=False)
class SmallLight:
    """A lamp as fitted: ``shape`` (x, y, disc matrix' lower triangle, log of the lens), [px] but the last, x and y of
    photosite centres at whole numbers; ``flux`` (3,) white balanced camera_rgb times px^2; ``alias`` (3,) by how much
    its sum over a colour's photosites is off, relative.
    """

    shape: np.ndarray
    flux: np.ndarray
    alias: np.ndarray


@dataclass(frozen=True, eq=False)
class SmallLights:
    """Of a picture: those whose aliases were taken off, brightest first; how many were ``left`` as they are."""

    fitted: list[SmallLight]
    left: int

    @property
    def largest_alias(self) -> float:
        """The most that photosites made of a colour of a light, relative; 0 without lights."""
        return float(max((np.abs(light.alias).max() for light in self.fitted), default=0.0))


def restored(rgb: np.ndarray, mosaic: np.ndarray, cfa: str, unusable: np.ndarray) -> tuple[np.ndarray, SmallLights]:
    """(H, W, 3) bilinear picture of a white balanced mosaic (H, W) without its small lights' aliases; those lights.

    ``unusable`` (H, W): photosites, and what interpolation took from them, whose value is no light.
    """
    result, fitted, left = rgb.copy(), [], 0
    colours = _colours(mosaic.shape, cfa)
    for place, reach in candidates(rgb.sum(-1)):
        found = None
        if _usable(unusable, place, reach + MARGIN_PX):
            found = _fitted(mosaic, colours, place, reach)
        if found is None:
            left += 1
        else:
            _take_off(result, found, colours, place, reach)
            fitted.append(found)
    return result, SmallLights(fitted, left)


def _colours(shape: tuple[int, ...], cfa: str) -> np.ndarray:
    """(H, W) index of each photosite's colour."""
    cell = np.array(["RGB".index(letter) for letter in cfa]).reshape(2, 2)
    return np.tile(cell, ((shape[0] + 1) // 2, (shape[1] + 1) // 2))[: shape[0], : shape[1]]


def candidates(grey: np.ndarray) -> list[tuple[tuple[int, int], int]]:
    """Middle (row, column) and reach [px] of small bright spots that stand alone, brightest first."""
    from scipy.ndimage import label, maximum_filter, uniform_filter

    smooth, seen = uniform_filter(grey, 3), np.zeros(grey.shape, bool)
    tops = (smooth == maximum_filter(smooth, 2 * APART_PX + 1)) & (smooth > GLARES * np.median(smooth))
    places = np.argwhere(tops)
    places = places[np.argsort(-smooth[tops], kind="stable")]
    found: list[tuple[tuple[int, int], int]] = []
    around = int(np.ceil(np.sqrt(LARGEST_PX))) + MARGIN_PX
    for row, column in places:
        if seen[row, column] or len(found) == MOST:
            continue
        top, left = max(row - around, 0), max(column - around, 0)
        part = np.s_[top : row + around + 1, left : column + around + 1]
        border = np.concatenate([side for cut in (grey[part], grey[part].T) for side in (cut[0], cut[-1])])
        level, peak = float(np.median(border)), float(smooth[row, column])
        if peak <= STANDS_OUT * level:
            continue
        parts, _ = label(grey[part] - level > EDGE * (peak - level))
        lamp = parts == parts[row - top, column - left]
        seen[part] |= lamp
        rows, columns = np.nonzero(lamp)
        if len(rows) <= LARGEST_PX:
            middle = round(rows.mean()), round(columns.mean())
            far = np.sqrt(((rows - middle[0]) ** 2 + (columns - middle[1]) ** 2).max())
            found.append(((middle[0] + top, middle[1] + left), int(np.ceil(far + BESIDE_PX))))
    return found


def _usable(unusable: np.ndarray, place: tuple[int, int], reach: int) -> bool:
    """Whether a window lies in the picture (H, W) and holds nothing that is ``unusable``."""
    window = _window(place, reach)
    inside = all(cut.start >= 0 and cut.stop <= size for cut, size in zip(window, unusable.shape, strict=True))
    return inside and not unusable[window].any()


def _window(place: tuple[int, int], reach: int) -> tuple[slice, slice]:
    return (slice(place[0] - reach, place[0] + reach + 1), slice(place[1] - reach, place[1] + reach + 1))


@cache
def _disc(count: int) -> np.ndarray:
    """Points (N, 2) of the unit disc on ``count`` rings, of its second moments."""
    rings = [np.linspace(0, 2 * np.pi, max(6 * ring, 1), endpoint=False) + ring for ring in range(count)]
    points = np.concatenate([ring * np.stack([np.cos(a), np.sin(a)], 1) for ring, a in enumerate(rings)])
    points *= np.sqrt(0.25 / (points**2).mean())
    points.setflags(write=False)
    return points


def _shown(shape: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(N,) of a lamp of unit flux at photosites (N,): a uniform ellipse behind a Gaussian that has the pixel in it."""
    matrix = np.array([[shape[2], 0], [shape[3], shape[4]]])
    across = min(float(np.linalg.norm(matrix)), np.sqrt(LARGEST_PX))
    points = shape[:2] + _disc(max(RINGS, int(np.ceil(across / RING_PX)) + 1)) @ matrix.T
    twice = 2 * np.exp(2 * shape[5])
    east, south = ((seen[:, None] - points[:, axis]) ** 2 for axis, seen in enumerate((x, y)))
    return np.asarray(np.exp(-(east + south) / twice).mean(1) / (np.pi * twice))


def _fitted(mosaic: np.ndarray, colours: np.ndarray, place: tuple[int, int], reach: int) -> SmallLight | None:
    """The ellipse that photosites within ``reach`` px show, and its aliases; None where they show none."""
    from scipy.optimize import least_squares

    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    near = rows**2 + columns**2 <= reach**2 + 1
    x, y = columns[near].astype(float), rows[near].astype(float)
    seen, colour = mosaic[_window(place, reach)][near].astype(float), colours[_window(place, reach)][near]
    far = np.hypot(x, y) > reach - BESIDE_PX / 2
    levels = np.array([np.median(seen[far & (colour == one)]) for one in range(3)])
    above = np.maximum(seen - levels[colour], 0)
    peaks = np.array([above[colour == one].max() for one in range(3)])
    if not peaks.max() > 0:
        return None
    lit = peaks > FAINT * peaks.max()
    kept = lit[colour]
    x, y, colour, seen, above = (values[kept] for values in (x, y, colour, seen, above))
    of_colour, height = np.eye(3)[:, lit][colour], peaks[colour]

    def solved(shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        design = np.concatenate([of_colour * _shown(shape, x, y)[:, None], of_colour], 1) / height[:, None]
        values = np.linalg.lstsq(design, seen / height, rcond=None)[0]
        return values[: lit.sum()], design @ values - seen / height

    def misses(shape: np.ndarray) -> np.ndarray:
        return np.append(solved(shape)[1] / FIT, (shape[5] - np.log(LENS_PX)) / LENS_LOG_SIGMA)

    weight = above / height
    weight /= weight.sum()
    middle = np.array([weight @ x, weight @ y])
    spread = np.array([weight @ (x - middle[0]) ** 2, weight @ (y - middle[1]) ** 2])
    wide = 2 * np.sqrt(np.maximum(spread - LENS_PX**2, 0.05))
    start = np.array([*middle, wide[0], 0, wide[1], np.log(LENS_PX)])
    shape = least_squares(misses, start, method="lm", max_nfev=300).x
    if not np.isfinite(shape).all() or np.hypot(*shape[:2]) > reach:
        return None
    values, left = solved(shape)
    if (values <= 0).any() or left @ left > UNEXPLAINED * (above / height) @ (above / height):
        return None
    flux, alias = np.zeros(3), np.where(lit, _sums(shape, place, reach + MARGIN_PX, colours) - 1, 0)
    flux[lit] = values
    if (np.abs(alias) > WORST).any():
        return None
    return SmallLight(shape + np.array([place[1], place[0], 0, 0, 0, 0]), flux, alias)


def _sums(shape: np.ndarray, place: tuple[int, int], reach: int, colours: np.ndarray) -> np.ndarray:
    """(3,) sums of a lamp of unit flux, middle at ``place``, as its bilinear picture has them."""
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    shown, colour = (
        _shown(shape, columns.ravel().astype(float), rows.ravel().astype(float)),
        colours[_window(place, reach)],
    )
    return np.array([4.0, 2.0, 4.0]) * np.bincount(colour.ravel(), shown, 3)


def _take_off(
    rgb: np.ndarray, light: SmallLight, colours: np.ndarray, place: tuple[int, int], reach: int
) -> None:  # fmt: skip
    """Scale the lamp's part in ``rgb`` (H, W, 3), in place, so that every colour's sum is its flux."""
    window = _window(place, reach + MARGIN_PX)
    rows, columns = np.mgrid[window]
    shown = _shown(light.shape, columns.ravel().astype(float), rows.ravel().astype(float)).reshape(rows.shape)
    colour = colours[window]
    cell = "".join("RGB"[one] for one in colour[:2, :2].ravel())
    picture = demosaic(light.flux[colour] * shown, cell, "bilinear")
    rgb[window] += (picture * (1 / (1 + light.alias) - 1)).astype(rgb.dtype)
