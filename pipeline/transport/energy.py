"""Light that a rough surface sends back: what its facets reflect at once, and what is left for the rest.

GGX with the separable Smith term follows light to one facet only and loses the rest (two thirds of all on a white metal
of roughness 1). Tables of the directional albedo E say how much, so that the missing part can be added as a lobe that
is reciprocal and restores it (Kulla and Conty, *Revisiting physically based shading at Imageworks*, 2017), and so that
a base under a dielectric gets what the gloss lets through on the way in and out (Kelemen and Szirmay-Kalos, *A
microfacet based coupled specular-matte BRDF model with importance sampling*, 2001):

    (1 - E(i)) (1 - E(o)) / (pi (1 - Emean)),  Emean = 2 integral of E cos
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

STEPS = 32  # of roughness, and of the root of the cosine
SAMPLES = 32  # along both axes of the sampled normals; E is off by 1e-3 at worst
LEAST_ROUGHNESS = 0.032  # alpha = 1e-3, the narrowest lobe there is
MOST_F0 = 0.98  # a dielectric of a finite index


def index_of(f0: float) -> float:
    """Refractive index of a dielectric that reflects ``f0`` head on."""
    root = np.sqrt(min(f0, MOST_F0))
    return float((1 + root) / (1 - root))


def reflectance(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Fresnel's unpolarised reflectance of a dielectric, from outside."""
    inside = np.sqrt(np.maximum(1 - (1 - cosine**2) / eta**2, 0))
    across = (cosine - eta * inside) / (cosine + eta * inside)
    along = (eta * cosine - inside) / (eta * cosine + inside)
    return np.asarray((across**2 + along**2) / 2)


@functools.cache
def albedos(f0: float) -> tuple[np.ndarray, np.ndarray]:
    """Directional albedo of the facets, and its mean over the cosine, of a mirror (0) and of a dielectric (1).

    (STEPS, STEPS, 2) by roughness, then by the root of the cosine, both from 0 to 1; and (STEPS, 2). Sampled by visible
    normals (Heitz 2018), densest where they are steep, since those lose most.
    """
    alpha = np.maximum(np.linspace(0, 1, STEPS), LEAST_ROUGHNESS)[:, None, None] ** 2
    root = np.linspace(0, 1, STEPS)
    view_z = np.maximum(root**2, 1e-4)[None, :, None]
    view_x = np.sqrt(1 - view_z**2)
    normal_x, normal_z, weight = _visible_normals(alpha, view_x, view_z)
    cosine = np.clip(view_x * normal_x + view_z * normal_z, 0, 1)
    leaving = 2 * cosine * normal_z - view_z
    slope = 1 / np.maximum(leaving, 1e-6) ** 2 - 1
    passes = np.where(leaving > 0, 2 / (1 + np.sqrt(1 + alpha**2 * np.maximum(slope, 0))), 0)
    mirror, dielectric = weight * passes, weight * passes * reflectance(cosine, index_of(f0))
    table = np.stack([mirror.mean(-1), dielectric.mean(-1)], -1)
    squared = (np.arange(1024) + 0.5) / 1024  # the mean of E(sqrt(t)) over t is that of 2 E(c) c over c
    each = [[np.interp(squared**0.25, root, row).mean() for row in part.T] for part in table]
    return table, np.array(each)


def _visible_normals(alpha: np.ndarray, view_x: np.ndarray, view_z: np.ndarray) -> tuple[np.ndarray, ...]:
    """X and z of normals that a direction (view_x, 0, view_z) sees, and their weights of mean 1; last axis: samples."""
    grid = (np.arange(SAMPLES) + 0.5) / SAMPLES
    radius, angle = (axis.ravel() for axis in np.meshgrid(1 - (1 - grid) ** 3, np.pi * grid))
    weight = np.tile(3 * (1 - grid) ** 2, SAMPLES)
    stretched = np.sqrt((alpha * view_x) ** 2 + view_z**2)
    x, z = alpha * view_x / stretched, view_z / stretched
    aside, ahead = np.sqrt(radius) * np.sin(angle), np.sqrt(radius) * np.cos(angle)  # half of the disc: both are alike
    ahead = (1 - z) / 2 * np.sqrt(1 - aside**2) + (1 + z) / 2 * ahead
    up = np.sqrt(np.maximum(1 - aside**2 - ahead**2, 0))
    normal = alpha * (x * up - z * ahead), alpha * aside, np.maximum(x * ahead + z * up, 1e-9)
    length = np.sqrt(sum(part**2 for part in normal))
    return normal[0] / length, normal[2] / length, weight / weight.mean()


class Kept:
    """The tables of one ``f0`` on Mitsuba's side."""

    def __init__(self, mi: Any, f0: float) -> None:
        import drjit as dr

        self.mi, self.eta = mi, index_of(f0)
        table, mean = (np.ascontiguousarray(part, np.float32) for part in albedos(round(f0, 6)))
        self.table = mi.Texture2f(mi.TensorXf(table), wrap_mode=dr.WrapMode.Clamp)
        self.mean = mi.Texture1f(mi.TensorXf(mean), wrap_mode=dr.WrapMode.Clamp)

    def at(self, cosine: Any, alpha: Any) -> Any:
        """E of a mirror and of the dielectric, for cosines and widths of the lobe."""
        import drjit as dr

        return self.table.eval(self.mi.Point2f(_texel(dr.sqrt(dr.clip(cosine, 0, 1))), _texel(dr.sqrt(alpha))))

    def over_cosine(self, alpha: Any) -> Any:
        """Emean of a mirror and of the dielectric."""
        import drjit as dr

        return self.mean.eval(_texel(dr.sqrt(alpha)))


def _texel(value: Any) -> Any:
    return (value * (STEPS - 1) + 0.5) / STEPS
