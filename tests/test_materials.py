"""Laws of the materials, each lobe by itself: furnace, reciprocity, sampling that matches its density."""

from typing import Any

import numpy as np
import pytest

from pipeline.transport.variant import use_mitsuba

COSINES = np.array([1.0, 0.8, 0.5, 0.2])
SAMPLES = 1 << 14


def bsdf(**parameters: Any) -> Any:
    mi = use_mitsuba()
    color = parameters.pop("base_color", (0.5, 0.4, 0.3))
    pixel = mi.Bitmap(np.asarray(color, np.float32).reshape(1, 1, 3))
    base = {"type": "bitmap", "bitmap": pixel, "raw": True}
    numbers = {name: {"type": "uniform", "value": float(value)} for name, value in parameters.items()}
    return mi.load_dict({"type": "insitu_gltf", "base_color": base, **numbers})


def interaction(mi: Any, wi: np.ndarray) -> Any:
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in wi.T])
    return si


def directional_albedo(material: Any, cosine: float) -> tuple[np.ndarray, np.ndarray]:
    """Reflected share of light from one direction, by sampling, and its standard error: (3,), (3,)."""
    mi = use_mitsuba()
    rng = np.random.default_rng(5)
    wi = np.tile([np.sqrt(1 - cosine**2), 0, cosine], (SAMPLES, 1))
    grid = (np.arange(SAMPLES) + rng.random(SAMPLES)) / SAMPLES
    pair = rng.random((2, SAMPLES))
    _, weight = material.sample(
        mi.BSDFContext(),
        interaction(mi, wi),
        mi.Float(grid.astype(np.float32)),
        mi.Point2f(*[mi.Float(axis.astype(np.float32)) for axis in pair]),
    )
    values = np.array(weight).reshape(3, -1)
    return values.mean(1), values.std(1) / np.sqrt(SAMPLES)


def integrated_albedo(material: Any, cosine: float, rows: int = 256) -> np.ndarray:
    """The same by quadrature over the hemisphere (midpoints in cosine and azimuth): (3,)."""
    mi = use_mitsuba()
    z, phi = np.meshgrid((np.arange(rows) + 0.5) / rows, 2 * np.pi * (np.arange(rows) + 0.5) / rows)
    s = np.sqrt(1 - z**2)
    out = np.stack([s * np.cos(phi), s * np.sin(phi), z], -1).reshape(-1, 3)
    wi = np.tile([np.sqrt(1 - cosine**2), 0, cosine], (len(out), 1))
    wo = mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in out.T])
    value = material.eval(mi.BSDFContext(), interaction(mi, wi), wo)
    return np.array(value).reshape(3, -1).mean(1) * 2 * np.pi


@pytest.mark.parametrize("f0", [0.0, 0.02, 0.04, 0.17, 1.0])
@pytest.mark.parametrize("cosine", COSINES)
def test_a_smooth_black_dielectric_reflects_by_schlick(f0: float, cosine: float) -> None:
    """base 0, roughness 0: the reflected share is f0 + (1 - f0)(1 - cos)^5.

    2e-3 of it: alpha is held at 1e-3, which spreads the half vector by that angle; float32 normals.
    """
    share, error = directional_albedo(bsdf(base_color=(0, 0, 0), roughness=0, f0=f0), cosine)
    expected = f0 + (1 - f0) * (1 - cosine) ** 5
    np.testing.assert_allclose(share, expected, rtol=2e-3, atol=5 * error.max() + 1e-7)


@pytest.mark.parametrize("f0", [0.02, 0.04, 0.17, 0.6])
@pytest.mark.parametrize("roughness", [0.3, 1.0])
@pytest.mark.parametrize("metallic", [0.0, 1.0, 0.4])
def test_white_furnace(f0: float, roughness: float, metallic: float) -> None:
    """Sampling agrees with the quadrature of the same lobe, and no more light comes back than came.

    The bound holds for metals at every angle and for dielectrics from above; towards grazing angles the specification's
    mix gives a white dielectric back more than it got (1.20 at roughness 0.3, cosine 0.2), which is held here too, so
    that a change of it is seen.
    """
    material = bsdf(base_color=(1, 1, 1), roughness=roughness, metallic=metallic, f0=f0)
    for cosine in COSINES:
        share, error = directional_albedo(material, cosine)
        # 2e-3: the quadrature's own error on the narrowest lobe here (alpha 0.09), by halving its step
        np.testing.assert_allclose(share, integrated_albedo(material, cosine), atol=5 * error.max() + 2e-3)
        if metallic == 1 or cosine >= 0.8:
            assert np.all(share < 1 + 5 * error)
    if (f0, roughness, metallic) == (0.04, 0.3, 0.0):
        np.testing.assert_allclose(share, 1.1995, atol=5 * error.max() + 2e-3)


def test_reciprocity() -> None:
    """f(wi, wo) = f(wo, wi): eval carries the cosine of its second direction."""
    mi = use_mitsuba()
    rng = np.random.default_rng(2)
    pairs = rng.normal(size=(2, 4096, 3))
    pairs[..., 2] = np.abs(pairs[..., 2])
    pairs /= np.linalg.norm(pairs, axis=-1, keepdims=True)
    for f0 in (0.02, 0.04, 0.3):
        material = bsdf(roughness=0.5, metallic=0.3, f0=f0)
        there, back = (
            np.array(
                material.eval(
                    mi.BSDFContext(),
                    interaction(mi, a),
                    mi.Vector3f(*[mi.Float(np.ascontiguousarray(column, np.float32)) for column in b.T]),
                )
            ).reshape(3, -1)
            / b[:, 2]
            for a, b in (pairs, pairs[::-1])
        )
        np.testing.assert_allclose(there, back, rtol=1e-4)
