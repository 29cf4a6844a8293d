"""Less noise in what was rendered, never in the photograph: Open Image Denoise on albedo-free quantities.

The change is denoised as lost and gained light relative to LS_noobj: smooth where the ground's texture is not, so the
texture is neither blurred nor mistaken for noise. The object layer leans on its base colour and normals. Isolated
bright pixels are spread over a few pixels first, because a denoiser drops or smears them; that light is counted, not
lost.
"""

from __future__ import annotations

import numpy as np

MARGIN = 16  # px of surroundings given to the denoiser
SPECKLE_GAIN = 2.0  # a pixel may exceed its brightest neighbour by this factor
SPREAD = 3.0  # px, over which the excess of a speckle goes


def spread_speckles(rgb: np.ndarray) -> tuple[np.ndarray, float]:
    """Pixels of (H, W, 3) >= 0 brighter than twice their brightest neighbour give the excess to their surroundings.

    Returns the picture, of the same sum but for what falls off its border, and the share of light that was moved.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    level = rgb.max(-1)
    bound = SPECKLE_GAIN * maximum_filter(level, footprint=ring, mode="nearest")
    scale = np.divide(bound, level, out=np.ones_like(level), where=level > bound)
    excess = rgb * (1 - scale)[..., None]
    total = float(rgb.sum())
    if not excess.any():
        return rgb, 0.0
    return rgb - excess + gaussian_filter(excess, (SPREAD, SPREAD, 0), mode="nearest"), float(excess.sum()) / total


def denoise(rgb: np.ndarray, albedo: np.ndarray, normal: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Denoise linear values (H, W, 3) >= 0; also the share of light moved by `spread_speckles`.

    Args:
        rgb: what is noisy.
        albedo: (H, W, 3) in [0, 1], an edge guide with little noise of its own.
        normal: (H, W, 3) in [-1, 1], a second guide.
    """
    import mitsuba_oidn

    calm, moved = spread_speckles(rgb)
    guides = {"albedo": np.ascontiguousarray(np.clip(albedo, 0, 1), np.float32)}
    if normal is not None:
        guides["normal"] = np.ascontiguousarray(normal, np.float32)
    result = mitsuba_oidn.denoise(np.ascontiguousarray(calm, np.float32), hdr=True, **guides)
    return np.maximum(result, 0), moved


def bounding_window(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around True pixels of (H, W), with a margin; the whole when there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return slice(None), slice(None)
    return (
        slice(max(rows[0] - MARGIN, 0), rows[-1] + 1 + MARGIN),
        slice(max(columns[0] - MARGIN, 0), columns[-1] + 1 + MARGIN),
    )
