"""Metals by name: what they reflect in ACEScg, head on and near grazing.

Unpolarised Fresnel reflectance of measured complex refractive indices, integrated over the visible under D65 (CIE 1931,
Bradford, a perfect mirror being (1, 1, 1)): an RGB index in the Fresnel equations, or a colour in another space, would
both be wrong. Between the two angles the BSDF interpolates as Schlick 1994 with the tint of Kutz, Hasan and Edmondson
2021 at a cosine of 1/7. `tests/test_materials.py` recomputes these numbers from the tables and holds the interpolation
against the spectral integral at every angle (largest error 0.023, chromium; 0.20 for Schlick alone).

Sources of n and k: Johnson and Christy 1972 (gold, silver, copper), 1974 (iron, chromium); Rakic 1995 (aluminium);
Querry 1985 (brass, 70 % copper). Clean, polished metal; Mitsuba's own tables differ by up to 0.06 (0.14 chromium).
"""

from __future__ import annotations

import numpy as np

GRAZING = 1 / 7  # cosine of the second angle

# Name -> reflectance at normal incidence, and at the cosine of GRAZING.
REFLECTANCE = {
    "aluminium": ((0.9109, 0.9153, 0.9213), (0.8440, 0.8603, 0.8890)),
    "brass": ((0.8421, 0.7822, 0.4727), (0.8814, 0.8627, 0.7259)),
    "chromium": ((0.5520, 0.5555, 0.5543), (0.5671, 0.5702, 0.6124)),
    "copper": ((0.8074, 0.6430, 0.5418), (0.8695, 0.7676, 0.7132)),
    "gold": ((0.9007, 0.7452, 0.4183), (0.9292, 0.8637, 0.6766)),
    "iron": ((0.5224, 0.5141, 0.4971), (0.5705, 0.5672, 0.5816)),
    "silver": ((0.9870, 0.9842, 0.9787), (0.9870, 0.9861, 0.9869)),
}


def preset(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Base colour (3,) and edge tint (3,), ACEScg, of ``insitu_gltf`` for a metal of `REFLECTANCE`."""
    facing, grazing = (np.array(values) for values in REFLECTANCE[name])
    return facing, grazing / (facing + (1 - facing) * (1 - GRAZING) ** 5)


def reflectance_at(facing: np.ndarray, grazing: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Reflectance (..., 3) at a cosine of incidence (...), from that head on and at GRAZING (3,).

    Schlick 1994 less Kutz, Hasan and Edmondson's dip ``cos (1 - cos)^6``, scaled to meet ``grazing``: what
    ``insitu_gltf`` computes.
    """
    cosine = np.asarray(cosine, float)[..., None]
    at_edge = facing + (1 - facing) * (1 - GRAZING) ** 5
    dip = (at_edge - grazing) / (GRAZING * (1 - GRAZING) ** 6)
    return np.asarray(facing + (1 - facing) * (1 - cosine) ** 5 - dip * cosine * (1 - cosine) ** 6)
