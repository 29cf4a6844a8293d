"""What is known per CFA cell, (2, 2), or per channel, (1, 3), brought to the samples of (H, W) or (H, W, 3) data."""

from __future__ import annotations

import numpy as np


def planes(values: np.ndarray) -> list[np.ndarray]:
    """Views of the samples of each CFA cell or channel, in the order of a ravelled (2, 2) or (1, 3) array."""
    if values.ndim == 3:
        return [values[..., channel] for channel in range(values.shape[2])]
    return [values[row::2, column::2] for row, column in np.ndindex(2, 2)]


def per_sample(cell: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A (2, 2) or (1, 3) array as float32 that broadcasts against ``values``, which start on a whole cell."""
    cell = np.asarray(cell, np.float32)
    if np.all(cell == cell.flat[0]):
        return cell.flat[0]
    if values.ndim == 3:
        return cell.reshape(-1)
    height, width = values.shape
    return np.tile(cell, (-(-height // 2), -(-width // 2)))[:height, :width]
