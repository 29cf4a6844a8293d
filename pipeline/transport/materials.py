"""The glTF 2.0 metallic-roughness material as a Mitsuba BSDF, exactly as appendix B of the specification.

    dielectric = mix(base / pi, D V, F),  F = f0 + (1 - f0) (1 - |v.h|)^5
    metal      = D V (base + (1 - base) (1 - |v.h|)^5 - dip)
    material   = mix(dielectric, metal, metallic)

D is Trowbridge-Reitz with alpha = roughness^2, V the separable Smith term. ``f0``, the reflectance of the dielectric at
normal incidence, is 0.04 unless KHR_materials_ior says otherwise. ``dip`` is not glTF's: measured metals fall below
Schlick's curve towards grazing angles, by the factor ``edge_tint`` at a cosine of 1/7 (Kutz, Hasan and Edmondson 2021);
1, the default, is glTF.

Mitsuba's own ``principled`` is another model (a white furnace differs by 6 %). The specification's mix is reciprocal,
and keeps the energy of metals and of dielectrics seen from above; a smooth white dielectric near grazing angles gives
back more than it gets (20 % at a cosine of 0.2 and roughness 0.3). Both sides of a face are lit, as in offline
renderers. ``alpha`` >= 1e-3.
"""

from __future__ import annotations

from typing import Any

from pipeline.transport.conductors import GRAZING

DIELECTRIC_F0 = 0.04
MIN_ALPHA = 1e-3
SCHLICK_AT_EDGE = (1 - GRAZING) ** 5
DIP_AT_EDGE = GRAZING * (1 - GRAZING) ** 6


def register(mi: Any) -> None:
    """Register ``insitu_gltf`` for the current variant.

    Its parameters, textures or numbers: base_color, metallic, roughness, f0, edge_tint.
    """
    import drjit as dr

    def schlick(cosine: Any) -> Any:
        return dr.power(1.0 - dr.clip(dr.abs(cosine), 0.0, 1.0), 5)

    class GltfBsdf(mi.BSDF):  # type: ignore[misc, name-defined]
        """Reflection only; two lobes, diffuse and glossy, sampled by their expected share."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.base = props.get_texture("base_color", 0.8)
            self.metallic = props.get_texture("metallic", 0.0)
            self.roughness = props.get_texture("roughness", 0.5)
            self.f0 = props.get_texture("f0", DIELECTRIC_F0)
            self.edge_tint = props.get_texture("edge_tint", 1.0)
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
        def _glossy_share(base: Any, metallic: Any, f0: Any, cos_i: Any) -> Any:
            fresnel = f0 + (1 - f0) * schlick(cos_i)
            diffuse = (1 - metallic) * (1 - fresnel) * dr.mean(base)
            glossy = metallic * dr.maximum(dr.mean(base), 0.1) + (1 - metallic) * fresnel
            return dr.clip(glossy / (glossy + diffuse + 1e-8), 0.05, 1.0 - 0.05 * (1 - metallic))

        @staticmethod
        def _flip(wi: Any, wo: Any) -> tuple[Any, Any]:
            sign = dr.sign(wi.z)
            return mi.Vector3f(wi.x, wi.y, wi.z * sign), mi.Vector3f(wo.x, wo.y, wo.z * sign)

        def _value_and_pdf(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            wi, wo = self._flip(si.wi, wo)
            base, metallic, alpha, f0 = self._parameters(si, active)
            active = active & (wi.z > 0) & (wo.z > 0)
            half = dr.normalize(wi + wo)
            lobe = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
            d = lobe.eval(half)
            glossy = d * lobe.smith_g1(wi, half) * lobe.smith_g1(wo, half) / (4 * wi.z)  # times cos(wo)
            edge = schlick(dr.dot(wi, half))
            fresnel = f0 + (1 - f0) * edge
            diffuse = base * (dr.inv_pi * wo.z)
            dielectric = diffuse * (1 - fresnel) + glossy * fresnel
            cosine = dr.clip(dr.abs(dr.dot(wi, half)), 0.0, 1.0)
            dip = cosine * dr.power(1.0 - cosine, 6) / DIP_AT_EDGE * (1 - self.edge_tint.eval(si, active))
            metal = glossy * (base + (1 - base) * edge - dip * (base + (1 - base) * SCHLICK_AT_EDGE))
            value = dielectric * (1 - metallic) + metal * metallic
            share = self._glossy_share(base, metallic, f0, wi.z)
            pdf_glossy = lobe.pdf(wi, half) / (4 * dr.dot(wo, half))
            pdf = share * pdf_glossy + (1 - share) * dr.inv_pi * wo.z
            return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            base, metallic, alpha, f0 = self._parameters(si, active)
            sign = dr.sign(si.wi.z)
            wi = mi.Vector3f(si.wi.x, si.wi.y, si.wi.z * sign)
            share = self._glossy_share(base, metallic, f0, wi.z)
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
