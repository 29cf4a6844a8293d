"""What the size of the map's texels may cost: light that an edge across a texel hides or does not."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions, latlong_solid_angles


def unresolved(rgb: np.ndarray) -> float:
    """Share of the light on a level surface that is not known where a straight edge crosses a map (H, W, 3): at most.

    A texel holds the mean of its radiance, so sums over texels are exact; where within it the light comes from is not
    known. Half of the brightest column (an upright edge) or row (a level one) of texels may lie on either side.
    """
    shape = rgb.shape[:2]
    level = np.maximum(latlong_directions(*shape)[..., 1], 0) * latlong_solid_angles(*shape)
    light = level * np.maximum(rgb, 0).sum(-1)
    total = light.sum()
    return float(max(light.sum(0).max(), light.sum(1).max()) / 2 / total) if total > 0 else 0.0


def reason(rgb: np.ndarray) -> dict[str, Any]:
    """The map's resolution as evidence."""
    width, share = rgb.shape[1], unresolved(rgb)
    return {
        "term": "directions finer than a texel",
        "modelled": f"{width} px, {360 / width:.2f} degrees each",
        "because": "knob probe.width; irradiance is a sum over texels, and exact",
        "could_cost": f"{share:.2%} of the light at the edge of a shadow; sharpness of mirror images",
        "bound_rel": share,
    }
