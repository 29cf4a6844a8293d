"""The denoiser against known pictures: never worse than without, its error known, light kept, highlights left alone."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.transport.denoise import (
    TILE,
    Half,
    Quiet,
    QuietChange,
    bounding_window,
    glimpsed,
    needs_more,
    oidn,
    quieted,
    spread_speckles,
    tile_means,
)

SHAPE = (120, 168)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
GREY = np.ones(3)
RNG = np.random.default_rng(11)
TEXTURE = np.kron(RNG.uniform(0.1, 0.9, (15, 21, 3)), np.ones((8, 8, 1))) * RNG.uniform(0.9, 1.1, (*SHAPE, 1))


def disc(row: float, column: float, radius: float, softness: float) -> np.ndarray:
    """(H, W) one inside, with an edge of that many pixels."""
    return np.clip((radius - np.hypot(ROWS - row, COLUMNS - column)) / softness + 0.5, 0, 1)


def soft_shadow() -> np.ndarray:
    return (1 - 0.7 * disc(60, 84, 40, 45))[..., None] * GREY


def contact_shadow() -> np.ndarray:
    """From soft to a hard edge, and a dark crease one pixel wide."""
    shadow = 1 - 0.6 * disc(60, 84, 40, 30) * disc(60, 60, 45, 1)
    return (shadow * (1 - 0.8 * (np.abs(ROWS - COLUMNS * 0.3 - 40) < 0.7)))[..., None] * GREY


def caustic() -> np.ndarray:
    """Thin bright arcs crossing at a cusp, on a faint glow."""
    arcs = sum(
        np.exp(-(((np.hypot(ROWS - 60, COLUMNS - c) - r) / 0.8) ** 2)) for c, r in ((60, 30), (84, 22), (100, 38))
    )
    return (2.0 * arcs + 0.1 * disc(60, 84, 50, 40))[..., None] * np.array([1.0, 0.9, 0.7])


def mirror() -> np.ndarray:
    """Reflections with sharp edges, a smooth sky, and the sun, three pixels wide and a hundred times white."""
    picture = 0.3 + 0.3 * ROWS / SHAPE[0] + 0.4 * (np.sin(COLUMNS / 3 + ROWS / 7) > 0.3)
    return (picture + 100 * disc(30, 100, 1.5, 1))[..., None] * GREY


def noisy(truth: np.ndarray, relative: float, fireflies: float, rng: np.random.Generator) -> np.ndarray:
    """Unbiased: gamma noise of that standard deviation; that share of pixels carries a tenth of the light instead."""
    usual = rng.gamma(1 / relative**2, relative**2, SHAPE)[..., None]
    if not fireflies:
        return truth * usual
    struck = (rng.random(SHAPE) < fireflies)[..., None]
    return truth * (0.9 * usual + 0.1 * struck / fireflies)


ALPHA = disc(60, 120, 32, 1)
SIGNALS = {
    "soft shadow": soft_shadow(),
    "contact shadow": contact_shadow(),
    "bounced light": 0.3 * soft_shadow(),
    "caustic": caustic(),
    "textured object": TEXTURE * ALPHA[..., None],
    "mirror": mirror() * ALPHA[..., None],
}
WORLDS = (
    ("soft shadow", "bounced light", "textured object"),
    ("contact shadow", "caustic", "mirror"),
)
NOISE = ((1.0, 0.002), (0.3, 0.002), (0.1, 0.0005), (0.03, 0.0), (0.01, 0.0))  # of a pixel, and share of fireflies


@dataclass(frozen=True, eq=False)
class Case:
    """One signal: truth, mean of the halves, their mean after the denoiser alone, the result, where it counts."""

    truth: np.ndarray
    raw: np.ndarray
    quiet: Quiet
    support: np.ndarray
    fireflies: bool

    def square(self, picture: np.ndarray) -> np.ndarray:
        """(H, W) squared error, relative above white, as the result is chosen by."""
        bright = np.maximum(1, self.truth.max(-1))[..., None]
        return (((picture - self.truth) / bright) ** 2).mean(-1)

    def rms(self, picture: np.ndarray) -> float:
        return float(np.sqrt((self.square(picture) * self.support).sum() / self.support.sum()))

    def coarse(self, picture: np.ndarray) -> np.ndarray:
        """RMS over blocks of 24 x 24 pixels that mostly count."""
        blocks = [
            (values * self.support).reshape(5, 24, 7, 24).sum((1, 3))
            for values in (self.square(picture), np.ones(SHAPE))
        ]
        return np.sqrt(blocks[0] / np.maximum(blocks[1], 1e-9))[blocks[1] > 200]


def halves_of(world: tuple[str, str, str], relative: float, fireflies: float, seed: int) -> tuple[Half, Half]:
    rng = np.random.default_rng(seed)
    survives, added, obj = (SIGNALS[name] for name in world)
    without = 0.5 * (1 - ALPHA)[..., None] * GREY
    return tuple(
        Half(
            lost=(noisy(survives, relative, 0, rng) - 1) * without,
            gained=noisy(added, relative, fireflies, rng) * without,
            without=without,
            obj=noisy(obj, relative, 0, rng),
        )
        for _ in range(2)
    )


def quiet_world(world: tuple[str, str, str], a: Half, b: Half) -> QuietChange:
    albedo = (TEXTURE if world[2] == "textured object" else np.zeros_like(TEXTURE)) * ALPHA[..., None]
    return quieted(a, b, ALPHA, albedo, np.zeros_like(TEXTURE), 1.0)


@pytest.fixture(scope="module")
def cases() -> dict[tuple[str, float], Case]:
    found = {}
    for world, (relative, fireflies) in itertools.product(WORLDS, NOISE):
        a, b = halves_of(world, relative, fireflies, 1)
        result = quiet_world(world, a, b)
        bare = (1 - ALPHA) * (a.without > 0).all(-1)
        full = np.where(bare[..., None] > 0, a.without, 1)
        raws = (1 + (a.lost + b.lost) / 2 / full, (a.gained + b.gained) / 2 / full, (a.obj + b.obj) / 2)
        for name, raw, quiet, support in zip(
            world, raws, (result.survives, result.added, result.obj), (bare, bare, ALPHA), strict=True
        ):
            struck = fireflies > 0 and name in ("bounced light", "caustic")
            found[name, relative] = Case(SIGNALS[name], raw, quiet, support, struck)
    return found


@pytest.mark.parametrize("name", list(SIGNALS))
def test_never_worse_than_without(cases: dict[tuple[str, float], Case], name: str) -> None:
    """Over the picture never; over blocks, within the noise of the estimate.

    The share of the raw mean rests on 16 x 16 pixels, with products of two errors of variance 2 s^2 (s: raw mean) in
    each: its standard error is about 2 / sqrt(256) = 1/8 where the denoiser is good and 1/16 where it is as bad as the
    samples. A share wrong by three of the latter adds 3.5 % to the square. A window across an edge has one share for
    both sides, which costs one of them as much again.
    """
    for relative, _ in NOISE:
        case = cases[name, relative]
        assert case.rms(case.quiet.rgb) < 1.005 * case.rms(case.raw)
        if not case.fireflies:  # their light goes to neighbouring blocks
            excess = case.coarse(case.quiet.rgb) ** 2 - 1.07 * case.coarse(case.raw) ** 2
            assert excess.max() < 0.001**2  # of white, less than any display resolves: where there is no light


@pytest.mark.parametrize("name", ["caustic", "mirror", "textured object", "contact shadow"])
def test_the_denoiser_alone_is_worse_than_without(cases: dict[tuple[str, float], Case], name: str) -> None:
    """Else the test above would hold nothing: at 1 % noise the denoiser alone loses, by up to ten."""
    case = cases[name, 0.01]
    assert case.rms(oidn(case.raw)) > 1.5 * case.rms(case.raw)


@pytest.mark.parametrize("name", list(SIGNALS))
def test_much_better_than_without_when_noisy(cases: dict[tuple[str, float], Case], name: str) -> None:
    """At a noise of one (two samples of a shadow) the result is worth more than ten times the samples."""
    case = cases[name, 1.0]
    assert case.rms(case.quiet.rgb) < case.rms(case.raw) / np.sqrt(10)


@pytest.mark.parametrize("name", list(SIGNALS))
def test_the_estimated_noise_is_the_error(cases: dict[tuple[str, float], Case], name: str) -> None:
    """RMS of the picture: told within 20 % from below, and above by no more than the noise of the estimate.

    That noise, 1/8 of the raw mean's square as above, cut at zero, has a mean of 0.4 / 8 = 1/20 of it. What halves do
    not know of each other (fireflies), and errors above white, which count in full in `Quiet.noise`, are left out.
    """
    for relative, _ in NOISE:
        case = cases[name, relative]
        if case.fireflies or case.truth.max() > 1:
            continue
        weight = tile_means(case.support)
        told = (case.quiet.noise**2 * weight).sum() / weight.sum()
        true = case.rms(case.quiet.rgb) ** 2
        assert 0.8**2 * true < told < 1.2**2 * true + case.rms(case.raw) ** 2 / 20


def test_a_sparse_caustic_becomes_an_even_one() -> None:
    """Fireflies of both halves over the same 40 px: all their light stays, none goes further than 48 px."""
    half = np.full((*SHAPE, 3), 0.1, np.float32)
    struck = [half.copy(), half.copy()]
    rng = np.random.default_rng(4)
    inside = (np.hypot(ROWS - 60, COLUMNS - 50) < 20)[..., None]
    for part in struck:
        part[np.nonzero((rng.random(SHAPE) < 0.02) & inside[..., 0])] += (40.0, 20.0, 10.0)
    results = spread_speckles(*struck, np.ones(SHAPE, np.float32))
    for part, result in zip(struck, results, strict=True):
        np.testing.assert_allclose(result.sum((0, 1), float), part.sum((0, 1), float), rtol=0.02)
        # Those next to one of the other half pass for a highlight: 9 x 2 % of them by chance.
        assert (result[..., 0] > 20).sum() < 0.5 * (part[..., 0] > 20).sum()
        far = np.hypot(ROWS - 60, COLUMNS - 50) > 20 + 1.5 * 48
        np.testing.assert_allclose(result[far], half[far], rtol=1e-6)


def test_what_only_one_half_saw_is_held_back_and_counted() -> None:
    a, b = halves_of(WORLDS[1], 0.01, 0, 3)
    clean = quiet_world(WORLDS[1], a, b)
    a.obj[60, 120] += 500.0
    result = quiet_world(WORLDS[1], a, b)
    assert result.obj.held_back == pytest.approx(1500 / (a.obj + b.obj).sum(), rel=0.01)
    assert clean.obj.held_back == 0
    assert result.obj.moved[60 // TILE, 120 // TILE] == pytest.approx(-500 / 2 / TILE**2, rel=0.01)
    assert np.abs(result.obj.rgb - clean.obj.rgb)[60, 120].max() < 3.0  # four times what its surroundings show


def test_a_shadow_of_few_samples_keeps_its_depth() -> None:
    """A glossy ground finds now and then that much more light is lost than there is: its mean is not cut off at zero.

    A fifth survives; of what is lost each half's pixels find an exponential variable, so that 29 % of their means lie
    below zero. Cut off there, the mean would be 0.348 (an integral over a gamma variable of shape 2). The denoiser may
    err by a third of that bias; the noise of the mean of 2 x 128 x 128 is 0.8 / 181.
    """
    rng = np.random.default_rng(6)
    shape = (128, 128)
    one, none = np.ones((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    a, b = (Half(-0.8 * rng.gamma(1.0, 1.0, shape)[..., None] * one, none, one, none) for _ in range(2))
    survives, _, _ = glimpsed(a, b, np.zeros(shape), none, none, 1.0, fast=False)
    assert abs(survives.mean() - 0.2) < 0.05, survives.mean()


def test_speckles_stay_on_their_object() -> None:
    alpha = ALPHA.astype(np.float32)
    struck = [0.1 * alpha[..., None] * GREY.astype(np.float32) for _ in range(2)]
    for part, column in zip(struck, (90, 93), strict=True):
        part[[58, 60, 62], column] = 30.0  # a few pixels from the outline
    for part, result in zip(struck, spread_speckles(*struck, alpha), strict=True):
        np.testing.assert_allclose(result.sum(dtype=float), part.sum(dtype=float), rtol=1e-5)
        assert result.max() < 10
        assert not result[alpha == 0].any()


def test_a_highlight_that_both_halves_see_is_left_alone() -> None:
    half = np.full((*SHAPE, 3), 0.1, np.float32)
    half[50, 60] = 40.0
    other = 1.5 * half
    a, b = spread_speckles(half, other, np.ones(SHAPE, np.float32))
    assert a is half
    assert b is other


def test_noise_free_halves_come_back() -> None:
    """Nothing differs, so nothing is better than the samples: to float32, squares of the ratio included."""
    world = WORLDS[1]
    a, _ = halves_of(world, 0.3, 0, 5)
    result = quiet_world(world, a, a)
    np.testing.assert_allclose(result.obj.rgb, a.obj, rtol=1e-5, atol=1e-6)
    bare = (a.without > 0).all(-1) & (ALPHA < 1)
    np.testing.assert_allclose(result.added.rgb[bare], (a.gained[bare] / a.without[bare]), rtol=1e-5, atol=1e-5)
    assert not result.noise(np.ones((15, 21))).any()


def test_same_input_same_bytes() -> None:
    a, b = halves_of(WORLDS[0], 0.3, 0.001, 6)
    first, second = quiet_world(WORLDS[0], a, b), quiet_world(WORLDS[0], a, b)
    for signal in ("survives", "added", "obj"):
        assert getattr(first, signal).rgb.tobytes() == getattr(second, signal).rgb.tobytes()


@pytest.mark.parametrize("covered", [0.0, 1.0])
def test_without_object_or_without_ground(covered: float) -> None:
    a, b = halves_of(WORLDS[0], 0.3, 0, 7)
    alpha = np.full((61, 83), covered)
    cut = [
        Half(**{k: v[:61, 85:] * (covered if k == "obj" else 1 - covered) for k, v in vars(half).items()})
        for half in (a, b)
    ]
    result = quieted(*cut, alpha, TEXTURE[:61, 85:] * covered, TEXTURE[:61, 85:] * 0, 1.0)
    assert result.obj.rgb.shape == (61, 83, 3)
    assert np.isfinite(result.noise(np.ones((8, 11)))).all()
    assert result.obj.rgb.any() == bool(covered)


def test_sampling_ends_below_half_of_what_the_photograph_hides() -> None:
    """Rounding to 8 bit of sRGB: the standard deviation of a uniform error one code wide, in linear light."""
    sigma = np.zeros((16, 24))
    sigma[:8, :8] = 0.02  # the photograph's own noise
    sigma[:8, 8:16] = np.inf  # clipped: unknown, so only rounding counts
    level = np.full((2, 3), 0.2140411)  # sRGB code 0.5
    codes = (np.array([0.5 - 0.5 / 255, 0.5 + 0.5 / 255]) + 0.055) / 1.055
    rounding = np.ptp(codes**2.4) / np.sqrt(12)
    for factor, more in ((0.99, False), (1.01, True)):
        noise = np.full((2, 3), 0.5 * rounding * factor)
        noise[0, 0] = 0.5 * np.hypot(0.02, rounding) * factor
        assert (needs_more(noise, sigma, level, 1.0) == more).all()
    assert np.array_equal(needs_more(3 * noise, 3 * sigma, 3 * level, 3.0), needs_more(noise, sigma, level, 1.0))


def test_tiles_at_the_border_are_cut() -> None:
    values = np.arange(11 * 9, dtype=float).reshape(11, 9)
    means = tile_means(values)
    assert means.shape == (2, 2)
    np.testing.assert_allclose(means[1, 1], values[TILE:, TILE:].mean())


def test_the_window_holds_the_mask() -> None:
    mask = np.zeros((100, 120), bool)
    mask[40:50, 60:90] = True
    rows, columns = bounding_window(mask)
    assert mask[rows, columns].sum() == mask.sum()
    assert (rows.start, rows.stop, columns.start, columns.stop) == (24, 66, 44, 106)
    assert bounding_window(np.zeros((4, 4), bool)) == (slice(None), slice(None))
