"""What the map of several markers says: where each lies, how well that is known, and what does not fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.camera.marker_map import MarkerMap, residuals_of

LARGE_RMS_PX = 0.5


def report(facts: list[dict[str, Any]], found: MarkerMap, min_ambiguity: float) -> tuple[dict[str, Any], list[str]]:
    """Numbers and warnings of a map; ``facts`` of the markers in the manifest's order."""
    off = residuals_of(found)
    table, warnings = [], []
    for at, marker in enumerate(found.markers):
        sigma = np.sqrt(np.diag(found.done.marker_covariance[at]))
        names = [name for name, number in off if number == marker]
        rms = float(np.sqrt(np.concatenate([off[name, marker] ** 2 for name in names]).mean())) if names else 0.0
        label = f"marker {facts[marker]['id']}"
        table.append({
            **{key: facts[marker][key] for key in ("dictionary", "id", "side_m")},
            "world_from_marker": found.done.bundle.markers[at].tolist(), "seen_in": names, "rms_px": rms,
            "rotation_sigma_deg": float(np.degrees(np.linalg.norm(sigma[:3]))),
            "position_sigma_m": float(np.linalg.norm(sigma[3:])), "ambiguity": found.unsure.get(marker),
        })  # fmt: skip
        if found.unsure.get(marker, np.inf) < min_ambiguity:
            warnings.append(f"{label}: two places explain the pictures; photograph it from another side as well")
        if rms > LARGE_RMS_PX:
            warnings.append(f"{label}: residual {rms:.2f} px; was it moved, is its side_m right, is the print flat?")
    for name, marker in found.left_out:
        warnings.append(f"{name}: marker {facts[marker]['id']} contradicts the other views and is left out")
    lost = [marker["id"] for number, marker in enumerate(facts) if number not in found.markers]
    if lost:
        warnings.append(f"markers {lost} hang together with no other; the map is without them")
    numbers = {
        "markers": table, "corner_sigma_px": found.done.corner_sigma_px, "seen_by": found.names,
        "left_out": [[name, facts[marker]["id"]] for name, marker in found.left_out],
    }  # fmt: skip
    return numbers, warnings
