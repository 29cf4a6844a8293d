"""What two pictures of one texture share when their contrast differs from place to place, as gloss makes it differ.

A coat mirrors a window to the camera that it does not mirror to the ball: radiance is then added to the plane's texture
on one side, on what is coated only, so that the steps of its logarithm shrink, grow or turn around by place, and broad
ramps come in. Neither moves a step. Ramps are fitted and taken off, as a mean alone leaves them at borders; the rest is
compared up to a gain of its own at every place (as normalised correlation does: Lewis 1995; Evangelidis and Psarakis
2008).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

GAIN_LOG, MOST_GAIN = 0.01, 3.0  # contrasts below a percent tell no gain, which is then one; no gain is larger
FLAT = 0.02  # of the window's second moment that every place has: where few pixels are known, mean and no ramp


def windowed(values: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean (H, W) of values (H, W), zero outside; ``sigma`` [px]."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(values, sigma, truncate=3, mode="constant"))


def means(used: np.ndarray, width: float) -> Callable[[np.ndarray], np.ndarray]:
    """Mean about every pixel, by a Gaussian window over the used ones (H, W; 0 or 1), of values (H, W) given later.

    ``width``: the window's sigma [px].
    """
    count = np.maximum(windowed(used, width), 1e-6)
    return lambda values: np.asarray(windowed(values * used, width) / count)


def ramps(used: np.ndarray, width: float) -> Callable[[np.ndarray], np.ndarray]:
    """As `means`, of planes that are fitted to the values about every pixel: their height at it."""
    y, x = (part / width for part in np.mgrid[: used.shape[0], : used.shape[1]].astype(float))
    count = np.maximum(windowed(used, width), 1e-6)
    mean_x, mean_y, xx, xy, yy = (windowed(used * part, width) / count for part in (x, y, x * x, x * y, y * y))
    xx, xy, yy = xx - mean_x**2 + FLAT, xy - mean_x * mean_y, yy - mean_y**2 + FLAT
    determinant = xx * yy - xy**2

    def fitted(values: np.ndarray) -> np.ndarray:
        mean, by_x, by_y = (windowed(values * used * part, width) / count for part in (1.0, x, y))
        by_x, by_y = by_x - mean * mean_x, by_y - mean * mean_y
        slope_x, slope_y = (yy * by_x - xy * by_y) / determinant, (xx * by_y - xy * by_x) / determinant
        return np.asarray(mean + slope_x * (x - mean_x) + slope_y * (y - mean_y))

    return fitted


def local_gain(real: np.ndarray, model: np.ndarray, width: float) -> np.ndarray:
    """Factor (H, W) that brings the model's detail nearest to the real one's, in a Gaussian window about every pixel.

    Both (H, W) are logarithms less their broad parts, zero where not known.
    """
    both, own = windowed(real * model, width), windowed(model**2, width)
    return np.asarray(np.clip((both + GAIN_LOG**2) / (own + GAIN_LOG**2), 0, MOST_GAIN))
