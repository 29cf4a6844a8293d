"""The glTF 2.0 metallic-roughness material as a Mitsuba BSDF: conserving, or as appendix B of the specification.

Appendix B, which real-time viewers follow:

    dielectric = mix(base / pi, D V, F),  F = f0 + (1 - f0) (1 - |v.h|)^5
    metal      = D V (base + (1 - base) (1 - |v.h|)^5 - dip)
    material   = mix(dielectric, metal, metallic)

D is Trowbridge-Reitz with alpha = roughness^2, V the separable Smith term. ``f0``, the reflectance of the dielectric at
normal incidence, is 0.04 unless KHR_materials_ior says otherwise. ``dip`` is not glTF's: measured metals fall below
Schlick's curve towards grazing angles, by the factor ``edge_tint`` at a cosine of 1/7 (Kutz, Hasan and Edmondson 2021);
1, the default, is glTF.

It is reciprocal, but no energy is kept: Schlick's F is up to 23 % below Fresnel's at f0 = 0.04 (cosine 0.6), light
that meets two facets is lost (3 % of a white dielectric of roughness 1, two thirds of such a metal), and a smooth white
dielectric near grazing angles gives back more than it gets (20 % at a cosine of 0.2 and roughness 0.3). Offline
renderers repair that, each its own way; ``conserving`` does by terms that stay reciprocal (see `energy`):

    dielectric = D V F' + base / pi (1 - Ed(i)) (1 - Ed(o)) / (1 - Ed mean),  F' by Fresnel
    metal      = D V F + Fms / pi (1 - E(i)) (1 - E(o)) / (1 - E mean),  Fms = Fmean^2 E mean / (1 - Fmean (1 - E mean))

A white surface then returns all light at every angle. Both sides of a face are lit, as in offline renderers.
``alpha`` >= 1e-3. Mitsuba's own ``principled`` is a third model (a white furnace differs by 6 %).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.transport.conductors import GRAZING
from pipeline.transport.energy import Kept

DIELECTRIC_F0 = 0.04
MIN_ALPHA = 1e-3
SCHLICK_AT_EDGE = (1 - GRAZING) ** 5
DIP_AT_EDGE = GRAZING * (1 - GRAZING) ** 6
SCHLICK_MEAN = 1 / 21  # 2 integral of (1 - c)^5 c
DIP_MEAN = 1 / 126 / DIP_AT_EDGE  # the same of c (1 - c)^6


def _schlick(cosine: Any) -> Any:
    import drjit as dr

    return dr.power(1.0 - dr.clip(dr.abs(cosine), 0.0, 1.0), 5)


def _glossy_share(kept: Kept | None, base: Any, metallic: Any, alpha: Any, f0: Any, cos_i: Any) -> Any:
    """Share of the samples that the glossy lobe gets: what it is expected to return of all."""
    import drjit as dr

    fresnel = f0 + (1 - f0) * _schlick(cos_i)
    mirror, least = 1.0, 0.1
    if kept is not None:
        mirror, fresnel = kept.at(cos_i, alpha)
    diffuse = (1 - metallic) * (1 - fresnel) * dr.mean(base)
    diffuse += metallic * dr.maximum(dr.mean(base), least) * (1 - mirror)
    glossy = metallic * dr.maximum(dr.mean(base), least) * mirror + (1 - metallic) * fresnel
    return dr.clip(glossy / (glossy + diffuse + 1e-8), 0.05, 1.0 - 0.05 * (1 - metallic))


def _rest(kept: Kept, cos_i: Any, cos_o: Any, alpha: Any) -> tuple[Any, Any]:
    """What the facets of a mirror and of the dielectric leave to the lobe of the rest, over pi and a cosine."""
    import drjit as dr

    left = (1 - kept.at(cos_i, alpha)) * (1 - kept.at(cos_o, alpha))
    left /= dr.maximum(1 - kept.over_cosine(alpha), 1e-6)
    return left[0], left[1]


def _again(kept: Kept, base: Any, tint: Any, alpha: Any) -> Any:
    """Colour of light that met several facets of a metal (Kulla and Conty 2017)."""
    import drjit as dr

    mean = base + (1 - base) * SCHLICK_MEAN - tint * (base + (1 - base) * SCHLICK_AT_EDGE) * DIP_MEAN
    share = kept.over_cosine(alpha)[0]
    return dr.square(mean) * share / (1 - mean * (1 - share))


def _value_and_pdf(
    mi: Any, kept: Kept | None, wi: Any, wo: Any, base: Any, metallic: Any, alpha: Any, f0: Any, tint: Any
) -> tuple[Any, Any]:
    """BSDF times the cosine of ``wo``, and the density of sampling it, both directions above the surface."""
    import drjit as dr

    half = dr.normalize(wi + wo)
    lobe = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
    d = lobe.eval(half)
    glossy = d * lobe.smith_g1(wi, half) * lobe.smith_g1(wo, half) / (4 * wi.z)  # times cos(wo)
    cosine, under = dr.clip(dr.abs(dr.dot(wi, half)), 0.0, 1.0), dr.inv_pi * wo.z
    edge = _schlick(cosine)
    dip = cosine * dr.power(1.0 - cosine, 6) / DIP_AT_EDGE * tint
    metal = glossy * (base + (1 - base) * edge - dip * (base + (1 - base) * SCHLICK_AT_EDGE))
    if kept is None:
        fresnel = f0 + (1 - f0) * edge
        dielectric = base * under * (1 - fresnel) + glossy * fresnel
    else:
        mirror, through = _rest(kept, wi.z, wo.z, alpha)
        dielectric = glossy * mi.fresnel(cosine, kept.eta)[0] + base * under * through
        metal += under * mirror * _again(kept, base, tint, alpha)
    value = dielectric * (1 - metallic) + metal * metallic
    share = _glossy_share(kept, base, metallic, alpha, f0, wi.z)
    pdf_glossy = lobe.pdf(wi, half) / (4 * dr.dot(wo, half))
    return value, share * pdf_glossy + (1 - share) * under


def register(mi: Any) -> None:
    """Register ``insitu_gltf`` for the current variant.

    Its parameters, textures or numbers: base_color, metallic, roughness, f0, edge_tint. ``conserving``, a flag, takes
    f0 as one number, when it is made.
    """
    import drjit as dr

    class GltfBsdf(mi.BSDF):
        """Reflection only; two lobes, diffuse and glossy, sampled by their expected share."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.base = props.get_texture("base_color", 0.8)
            self.metallic = props.get_texture("metallic", 0.0)
            self.roughness = props.get_texture("roughness", 0.5)
            self.f0 = props.get_texture("f0", DIELECTRIC_F0)
            self.edge_tint = props.get_texture("edge_tint", 1.0)
            self.kept = Kept(mi, float(np.ravel(self.f0.mean())[0])) if props.get("conserving", False) else None
            side = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.DiffuseReflection | side, mi.BSDFFlags.GlossyReflection | side]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: Any) -> None:
            for name in ("base", "metallic", "roughness", "f0", "edge_tint"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def _parameters(self, si: Any, active: Any) -> tuple[Any, Any, Any, Any]:
            metallic = self.metallic.eval_1(si, active)
            alpha = dr.maximum(dr.square(self.roughness.eval_1(si, active)), MIN_ALPHA)
            return self.base.eval(si, active), metallic, alpha, self.f0.eval_1(si, active)

        @staticmethod
        def _flip(wi: Any, wo: Any) -> tuple[Any, Any]:
            sign = dr.sign(wi.z)
            return mi.Vector3f(wi.x, wi.y, wi.z * sign), mi.Vector3f(wo.x, wo.y, wo.z * sign)

        def _value_and_pdf(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            wi, wo = self._flip(si.wi, wo)
            parameters = self._parameters(si, active)
            active = active & (wi.z > 0) & (wo.z > 0)
            value, pdf = _value_and_pdf(mi, self.kept, wi, wo, *parameters, 1 - self.edge_tint.eval(si, active))
            return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            base, metallic, alpha, f0 = self._parameters(si, active)
            sign = dr.sign(si.wi.z)
            wi = mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * sign)
            share = _glossy_share(self.kept, base, metallic, alpha, f0, wi.z)
            take_glossy = sample1 < share
            lobe = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
            half, _ = lobe.sample(wi, sample2)
            wo = dr.select(take_glossy, mi.reflect(wi, half), mi.warp.square_to_cosine_hemisphere(sample2))
            sample = mi.BSDFSample3f()
            sample.wo = mi.Vector3f(wo.x, wo.y, wo.z * sign)
            sample.eta = 1.0
            sample.sampled_type = dr.select(
                take_glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            sample.sampled_component = dr.select(take_glossy, mi.UInt32(1), mi.UInt32(0))
            value, sample.pdf = self._value_and_pdf(si, sample.wo, active)
            valid = active & (sample.pdf > 0)
            return sample, dr.select(valid, value / sample.pdf, 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._value_and_pdf(si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._value_and_pdf(si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self._value_and_pdf(si, wo, active)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.base.eval(si, active)

        def to_string(self) -> str:
            return f"GltfBsdf[base={self.base}, metallic={self.metallic}, roughness={self.roughness}]"

    mi.register_bsdf("insitu_gltf", lambda props: GltfBsdf(props))
