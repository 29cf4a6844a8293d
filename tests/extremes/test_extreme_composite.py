"""Extremes of the composite and the reflectance, and searches of equations 4, 5 and 8 between them."""

from __future__ import annotations

import numpy as np
import pytest
import test_reflectance
import test_reflectance_bounces as bounces
from hypothesis import given
from hypothesis import strategies as st
from test_composite import auto, change, world

from pipeline.conventions import CLIPPED
from pipeline.light.environment import irradiance
from pipeline.run.errors import NumericalError
from pipeline.transport import differential as d
from pipeline.transport import radiosity
from pipeline.transport.reflectance import reflected_radiance, updated_brdf
from stages import composite, knobs

SIZE = (9, 12)
FLOAT32 = 2.0**-24


def lit(lost: float, gained: float, model: float = 0.5, size: tuple[int, int] = SIZE) -> d.Change:
    """Uncovered ground whose light changes by the same everywhere."""
    whole = np.ones((*size, 3))
    nothing = np.zeros(size)
    return d.Change(
        0 * whole, nothing, np.minimum(lost, 0) * whole, gained * whole, model * whole, np.ones(size), 1e-10 * whole
    )


def test_no_model(saw):
    """LS_noobj of zero, and of anything down to denormals beside a lit median: the additive form, finite."""
    plate = np.full((*SIZE, 3), 0.7, np.float32)
    worst = 0.0
    for faint in (0.0, 1e-300, 1e-30, 1e-12):
        found = lit(0.0, 0.1)
        found.without[:4, :4] = faint
        for kind in (d.ratio(found), d.chosen(found, plate, np.full(plate.shape, 1e-6))):
            layers = d.build(found, kind)
            assert np.all(layers.guards[:4, :4] & d.NO_MODEL)
            assert not np.any(layers.guards[5:, 5:] & d.NO_MODEL)
            out = layers.apply(plate)
            assert np.isfinite(out).all()
            worst = max(worst, np.abs(out[:4, :4] / 0.8 - 1).max())
    saw("noobj.zero", "degraded", worst, said="guard NO_MODEL")


def test_more_light_than_before(saw):
    """A right model: LS_b = LS_noobj, so the truth is LS_obj."""
    plate = np.full((*SIZE, 3), 0.5, np.float32)
    worst = 0.0
    for gained in (1e-6, 0.1, 10.0, 1e4):
        found = lit(0.0, gained)
        for layers in (d.build(found, d.additive(found)), d.build(found, d.ratio(found)), auto(found, plate, 1e-8)):
            worst = max(worst, np.abs(layers.apply(plate) / (0.5 + gained) - 1).max())
    saw("obj.brighter", "exact", worst)


@pytest.mark.parametrize(("case", "factor"), [("model.3x_bright", 3.0), ("model.3x_dark", 1 / 3)])
def test_a_model_three_times_off(case, factor, saw):
    """The model is the truth times ``factor``: a shadow takes a share of the light, over a plate with 1 % noise."""
    rng = np.random.default_rng(0)
    size, truth = (60, 60), 0.5
    worst = 0.0
    for share in (0.1, 0.5, 0.9, 0.99):
        plate = (truth * (1 + 0.01 * rng.normal(size=(*size, 3)))).astype(np.float32)
        found = lit(-share * truth * factor, 0.0, truth * factor, size)
        out = auto(found, plate, (0.01 * truth) ** 2).apply(plate)
        assert out.min() >= 0
        # the photograph's own noise stays in the result, and is no error of the form: compared with the plate shaded
        worst = max(worst, abs(out.mean() / (plate.mean() * (1 - share)) - 1))
    saw(case, "exact", worst)


def test_added_light_of_a_model_three_times_off(saw):
    """All of the factor is the albedo's, so added light is off by it too; the gain brings back what it may."""
    plate, worst = np.full((*SIZE, 3), 0.5, np.float32), 0.0
    for factor in (3.0, 1 / 3):
        found = lit(0.0, 0.05 * factor, 0.5 * factor)
        layers = auto(found, plate, 1e-8)
        assert np.all(layers.guards & d.GAIN_LIMITED)
        worst = max(worst, np.abs((layers.apply(plate) - 0.5) / 0.05 - 1).max())
    saw("model.3x_added", "degraded", worst, said="guard GAIN_LIMITED")


def test_black_plane(saw):
    """Albedo zero: no light to lose, none to gain; the plate beside the object comes back."""
    found = lit(0.0, 0.0, 0.0)
    plate = np.random.default_rng(1).normal(0, 1e-3, (*SIZE, 3)).astype(np.float32)
    worst = 0.0
    for layers in (d.build(found, d.additive(found)), d.build(found, d.ratio(found)), auto(found, plate, 1e-6)):
        assert not layers.guards.any()
        out = layers.apply(plate)
        assert np.isfinite(out).all()
        worst = max(worst, np.abs(out - plate).max())
    black = test_reflectance.plate(np.zeros((*test_reflectance.SIZE, 3)), np.ones(3))
    solved = test_reflectance.solve(black).outputs["albedo"].rgb()
    assert np.isfinite(solved).all()
    saw("plane.black", "exact", worst + np.abs(solved).max())


def test_no_light_on_the_plane_is_refused():
    with pytest.raises(NumericalError, match="no light from above"):
        test_reflectance.solve(
            test_reflectance.plate(np.full((*test_reflectance.SIZE, 3), 0.3), np.ones(3)), np.zeros((8, 16, 3))
        )


def test_clipped_plate_under_a_shadow(saw):
    inputs = world(4)
    plate, layers = inputs["photographs"]["plate"], inputs["layers"]
    rng = np.random.default_rng(2)
    clipped = rng.random(plate.shape) < 0.3
    plate.channels["mask"][clipped] = CLIPPED
    for c in "RGB":
        plate.channels[f"variance.{c}"][clipped] = np.inf
        layers.channels[f"lost.{c}"][:] = -0.3 * layers.channels[f"without.{c}"]
        layers.channels[f"gained.{c}"][:] = 0
    made = composite.compute(**inputs, params=knobs.Composite()).outputs["composite"]
    assert np.isfinite(made.rgb()).all()
    open_ground = layers["obj.A"] < 1
    changed = (made.rgb() != plate.rgb()).any(-1) & clipped & open_ground
    assert changed.sum() > 20
    unflagged = np.count_nonzero(changed & ((made["guards"] & d.CLIPPED_PLATE) == 0))
    saw("plate.clipped_shadow", "degraded", unflagged, said="guard CLIPPED_PLATE")


def test_corner_of_albedo_095(saw):
    """Boxes whose surfaces reflect 0.95 at most, open and closed by what else stands there: worst albedo."""
    worst = 0.0
    for name in ("corner", "three"):
        factors = bounces.form_factors(bounces.SCENES[name])
        rng = np.random.default_rng(3)
        direct = rng.uniform(0.3, 1.0, (len(factors), 1))
        albedo = np.full((len(factors), 1), 0.95)
        measured = albedo * radiosity.irradiance(albedo, direct, factors)
        for method in ("damped", "gathered"):
            found = radiosity.estimate(measured, direct, factors, np.eye(len(albedo)), method=method)
            worst = max(worst, np.abs(found.albedo / albedo - 1).max())
    saw("corner.095", "exact", worst)


def test_radiance_beyond_half(saw):
    """Plate, change and object from 1 to 10^6 times unity, the factor stored as half: see `Layers.with_half_mul`."""
    rng = np.random.default_rng(5)
    plate = 10 ** rng.uniform(0, 6, (32, 32, 3))
    found = change(0.0, shape=(32, 32))
    found = d.Change(
        np.full(plate.shape, 2e5), np.full((32, 32), 0.2), -plate * rng.uniform(0, 0.7, plate.shape),
        plate * rng.uniform(0, 3, plate.shape), 0.8 * plate, np.full((32, 32), 0.8),
    )  # fmt: skip
    layers = d.build(found, d.ratio(found))
    error = np.abs(layers.with_half_mul().apply(plate) / layers.apply(plate) - 1).max()
    saw("half.overflow", "exact", error)


# ---- searches ------------------------------------------------------------------------------------------------------

decades = st.floats(-6, 6)
shares = st.floats(0, 1)


@st.composite
def changes(draw):
    """A plate and a change of any size, up to six decades apart; some of the ground covered."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    level, spread = draw(decades), draw(st.floats(0, 3))
    shape = draw(st.sampled_from([(1, 1), (3, 5), (7, 2)]))

    def values(scale: float = 1.0) -> np.ndarray:
        return scale * 10 ** (level + spread * rng.normal(size=(*shape, 3)))

    alpha = rng.random(shape) * draw(st.sampled_from([0.0, 1.0]))
    model = values() * (1 - alpha[..., None])
    obj, lost = values(draw(shares)) * alpha[..., None], -model * rng.random(model.shape)
    gained = values(draw(shares)) * (alpha < 1)[..., None]
    found = d.Change(obj, alpha, lost, gained, model, 1 - alpha, 0 * model)
    return found, values().astype(np.float32), 10.0 ** (2 * level)


@given(case=changes())
def test_equation_4(case, saw):
    found, plate, _ = case
    layers = d.build(found, d.additive(found))
    out = plate.astype(float) * layers.mul + layers.add + layers.obj
    truth = plate * (1 - found.alpha)[..., None].astype(float) + found.difference + found.obj
    size = plate + np.abs(found.lost) + found.gained + found.obj
    saw("formula.4", "exact", np.abs(out - truth).max() if not size.any() else (np.abs(out - truth) / size).max())
    assert np.isfinite(layers.apply(plate)).all()


@given(case=changes())
def test_equation_5(case, saw):
    found, plate, _ = case
    usable = found.usable & (found.alpha < 1)[..., None]
    if not usable.any():
        return
    layers = d.build(found, d.ratio(found))
    out = plate.astype(float) * layers.mul + layers.add + layers.obj
    open_share = (1 - found.alpha)[..., None]
    n = np.where(usable, found.without, 1.0)
    truth = plate * open_share * (n + found.difference) / n + found.obj
    size = plate * (1 + (np.abs(found.lost) + found.gained) / n) + found.obj
    saw("formula.5", "exact", (np.abs(out - truth) / size)[usable].max())


@given(case=changes(), variance=st.floats(0, 1))
def test_the_default_never_makes_light_negative_nor_invents_it(case, variance, saw):
    """Between the forms: no less than zero over a plate that is not, and the plate where nothing changes."""
    found, plate, unit = case
    out = d.build(found, d.chosen(found, plate, np.full(plate.shape, variance * unit))).apply(plate)
    assert np.isfinite(out).all()
    size = plate + np.abs(found.lost) + found.gained + found.obj
    assert (out >= -8 * FLOAT32 * size).all()
    still = d.Change(0 * found.obj, 0 * found.alpha, 0 * found.lost, 0 * found.gained, found.without, found.ground)
    same = d.build(still, d.chosen(still, plate, np.full(plate.shape, variance * unit))).apply(plate)
    saw("law.insert_nothing", "exact", np.count_nonzero(same.view(np.uint32) != plate.view(np.uint32)))


@given(case=changes(), stops=st.integers(-12, 12))
def test_twice_the_exposure_is_twice_the_result(case, stops, saw):
    """By powers of two, so that only the forms could break it; every bit."""
    found, plate, unit = case
    scale = 2.0**stops
    more = d.Change(
        scale * found.obj, found.alpha, scale * found.lost, scale * found.gained, scale * found.without, found.ground
    )
    noise = np.full(plate.shape, 1e-4 * unit)
    one = d.build(found, d.chosen(found, plate, noise)).apply(plate)
    bright = plate * np.float32(scale)
    other = d.build(more, d.chosen(more, bright, scale**2 * noise)).apply(bright)
    saw("law.exposure_doubled", "exact", np.count_nonzero(other != np.float32(scale) * one))


@given(rho=st.floats(1e-6, 1 / np.pi), light=st.floats(-9, 9), tint=st.tuples(shares, shares))
def test_equations_6_to_8(rho, light, tint, saw):
    """One step is exact without inter-reflection, whatever the start."""
    brdf = rho * np.array([1.0, *(0.01 + 0.99 * np.array(tint))])
    e = 10.0**light * np.array([1.0, 0.3, 2.0])
    found = updated_brdf(*(reflected_radiance(np.pi * one, e) for one in (brdf, np.ones(3))))
    saw("formula.8", "exact", np.abs(found / brdf - 1).max())


def test_probe_a_thousand_times_too_bright(saw):
    """A map 1000 times too bright: the albedo is as dark as nothing is, and the factor that cures it is named.

    It is what brings 99 % of the texels to 1, so 1000 over the brightest albedo, which nobody knows.
    """
    light = irradiance(test_reflectance.SKY, test_reflectance.NORMAL[None])[0]
    albedo = test_reflectance.smooth(test_reflectance.where_seen())
    result = test_reflectance.solve(test_reflectance.plate(albedo, light), 1000 * test_reflectance.SKY)
    (said,) = [text for text in result.warnings if "nothing is so dark" in text]
    named = float(said.split("a map ")[1].split()[0])
    saw("probe.x1000_alone", "degraded", abs(named * 1000 / 0.7 - 1), said=said)  # `smooth` reflects 0.7 at most
