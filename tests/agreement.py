"""Whether two sets of independent pictures have the same mean: z of the means of 8 x 8 tiles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TILE = 8
LARGEST = 6.0  # Student's t of 18 degrees of freedom exceeds it once in 90 000; a picture has 144 tile channels


def tile_means(picture: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(tiles, 3) of a picture (H W, 3) or (H, W, 3)."""
    height, width = shape[0] // TILE, shape[1] // TILE
    return picture.reshape(height, TILE, width, TILE, 3).mean((1, 3)).reshape(-1, 3)


def standing(pictures: Sequence[np.ndarray], shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and squared standard error of the tiles (tiles, 3) of independent pictures, and of the whole as last row."""
    tiles = np.stack([tile_means(picture, shape) for picture in pictures])
    rows = np.concatenate([tiles, tiles.mean(1, keepdims=True)], 1)
    return rows.mean(0), rows.var(0, ddof=1) / len(rows)


def assert_same_mean(first: Sequence[np.ndarray], second: Sequence[np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    """No tile differs by `LARGEST` standard errors, nor does the whole, and the squares of z are those of chance.

    Of z = difference over standard error. With f degrees of freedom z^2 has the mean f / (f - 2); of 48 independent
    tiles (their channels alike) the mean scatters by sqrt(2 / 48) = 0.2, of which 3.5 are allowed. This takes samples
    enough for the mean of a tile to be nearly normal, and seeds that the two do not share. Returns z.
    """
    (a, a_square), (b, b_square) = standing(first, shape), standing(second, shape)
    spread = np.sqrt(a_square + b_square)
    z = (a - b)[spread > 0] / spread[spread > 0]
    assert np.all(a[spread == 0] == b[spread == 0])
    freedom = min(len(first), len(second)) - 1  # at least
    tiles = max(len(z) / 3, 1)
    assert np.abs(z).max() < LARGEST, np.abs(z).max()
    assert (z**2).mean() < freedom / (freedom - 2) * (1 + 3.5 * np.sqrt(2 / tiles)), (z**2).mean()
    return z
