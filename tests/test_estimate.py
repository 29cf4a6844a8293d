"""Region, interpolation and stop rule against tracing everything; light groups against the whole."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from agreement import tile_means
from scipy.ndimage import binary_dilation
from test_caustics import MIRROR_BSDF, film, placed
from test_paths import lamp_of
from test_transport import GREY, SIZE, all_rays, ground, looking_down, sky, sphere

from benchmarks.scenes import ray_grid
from pipeline.light.environment import irradiance
from pipeline.transport import passes
from pipeline.transport.canvas import TRUSTED, Canvas, pictures
from pipeline.transport.difference import difference_block
from pipeline.transport.estimate import lit, prepare, sampled, settled
from pipeline.transport.meshes import Material, Mesh
from pipeline.transport.passes import OBJECT_BOOST, Halves
from pipeline.transport.pilot import Effort, Pilot, looked
from pipeline.transport.region import BLUR, CELL, Limits, limits_for, near_objects
from pipeline.transport.scene import Worlds, build_worlds
from pipeline.transport.surfaces import material_bsdf, object_shape
from pipeline.transport.trace import LensRays, Rays, Samples, trace
from pipeline.transport.variant import use_mitsuba
from pipeline.types import Camera, Emitter
from stages import render

ALBEDO = np.array([0.5, 0.4, 0.3])
FRAME = (96, 128)
SIGMA = 0.01  # of the plate
SAMPLES = 320  # several passes
TRUTH = 128  # samples per pixel


def upward(light: np.ndarray) -> np.ndarray:
    return irradiance(light, np.array([[0.0, 1, 0]]))[0]


@functools.cache
def truth() -> tuple[Worlds, Rays, Samples]:
    """A ball of 2 cm under lamp and sky, and what it changes, everywhere and without stopping."""
    light = sky()
    shapes = {"ball": placed("ball", sphere(0.02, (0, 0.02, 0.05), GREY), material_bsdf(use_mitsuba(), GREY, "acescg"))}
    worlds = build_worlds(ground(), ALBEDO, light, shapes, emitters=[lamp_of(light)])
    xn, dxn = ray_grid(Camera(width=FRAME[1], height=FRAME[0], fx=120.0, fy=120.0, cx=64, cy=48))
    rays = Rays.of(looking_down(), xn.reshape(-1, 2), dxn.reshape(-1, 2, 2))
    return worlds, rays, trace(difference_block, worlds, rays, TRUTH, 6, 77)


@functools.cache
def adaptive() -> tuple[Canvas, Halves, dict[str, float], Limits]:
    """The same by region, interpolation and passes, under a photograph with noise of `SIGMA`."""
    worlds, rays, _ = truth()
    model = np.broadcast_to(ALBEDO * upward(sky()) / np.pi, (*FRAME, 3))
    plate = model * (1 + SIGMA * np.random.default_rng(2).normal(size=model.shape))
    variance = np.square(SIGMA * model)
    limits = limits_for(plate, variance, 0.004)
    sigma = np.sqrt(variance.mean(-1))
    effort = Effort(samples=SAMPLES, denoise=False, seed=5)
    canvas, left = prepare(worlds, rays, FRAME, upward(sky()), sigma, float(plate.max()), limits, effort)
    *_, shot = sampled(canvas)
    return shot.canvas, shot.halves, left, limits


def relative(change: np.ndarray) -> np.ndarray:
    """(tiles, 3) means of a change relative to LS_noobj."""
    return tile_means(change.reshape(-1, 3), FRAME) / (ALBEDO * upward(sky()) / np.pi)


def wholly(mask: np.ndarray) -> np.ndarray:
    """(rows, columns) tiles of which every pixel is in the mask (H, W)."""
    return mask.reshape(FRAME[0] // CELL, CELL, FRAME[1] // CELL, CELL).all((1, 3))


def test_adaptive_differs_by_no_more_than_its_numbers_say() -> None:
    """Tile means: left to the plate by `left_out_max`, interpolated by the second differences, traced by noise.

    A blur of s cells and linear interpolation err by (s^2 / 2 + 1 / 8) times the second differences, of which the
    tolerance bounds an eighth. In the feather at most the threshold is missing besides. Five standard errors of the
    samples of either render are allowed.
    """
    canvas, halves, left, limits = adaptive()
    everything, weight = truth()[2], canvas.framed(canvas.region.weight)
    images = {name: canvas.framed(image) for name, image in pictures(canvas, halves)[0].items()}
    used = relative((images["lost"] + images["gained"]) * weight[..., None])
    exact = relative(everything.lost + everything.gained)
    error = np.abs(used - exact).reshape(*wholly(weight > 0).shape, 3).max(-1)
    noise = np.sqrt(everything.change_variance + images["change_variance"].reshape(-1, 3))
    noise = 5 * np.sqrt(relative(noise**2) / (ALBEDO * upward(sky()) / np.pi) / 64).max(-1).reshape(error.shape)
    masks = [canvas.framed(mask) > 0 for mask in (canvas.region.traced, canvas.region.interpolated)]
    outside, traced, interpolated = (wholly(mask) for mask in (weight == 0, *masks))
    assert min(part.mean() for part in (outside, traced, interpolated)) > 0.05
    assert np.all(error[outside] < left["left_out_max"] + 5 * left["left_out_noise"] + noise[outside])
    assert left["left_out_max"] < limits.threshold
    assert np.all(error[traced] < noise[traced])
    bent = limits.tolerance * (4 * BLUR**2 + 1)
    assert np.all(error[interpolated] < bent + limits.threshold + noise[interpolated])
    assert np.median(error[interpolated]) < limits.tolerance / 20


def wide(scale: int) -> Pilot:
    """Of a small ball and a thin rod in a frame of 30 by 40 cells, or ``scale`` times as many each way."""
    light, mi = sky(), use_mitsuba()
    rod = Mesh(*quads_of_rod(), None, GREY)
    shapes = {
        "ball": placed("ball", sphere(0.01, (0, 0.01, 0.05), GREY), material_bsdf(mi, GREY, "acescg")),
        "rod": placed("rod", rod, material_bsdf(mi, GREY, "acescg")),
    }
    worlds = build_worlds(ground(), ALBEDO, light, shapes, emitters=[lamp_of(light)])
    height, width = (scale * CELL * cells for cells in (30, 40))
    camera = Camera(width=width, height=height, fx=600.0, fy=600.0, cx=width / 2, cy=height / 2)
    rays = LensRays(camera, looking_down())
    effort, limits = Effort(samples=32, seed=3), Limits(0.01, 0.005, 0.01)
    return looked(worlds, rays, (height, width), upward(light), limits, effort, None, lambda share: None)


def quads_of_rod() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rod of half a millimetre, an upright strip: its shadow is thinner than a cell."""
    corners = np.array([[0.03, 0, 0], [0.0305, 0, 0], [0.0305, 0.06, 0], [0.03, 0.06, 0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0, 1], (4, 1))


def test_what_gets_no_more_than_a_glance_does_not_change() -> None:
    """Against 256 samples of every cell: object and hard shadow lie near the spheres, the rest is below the threshold.

    Five standard errors of the 256 samples are allowed. A frame nine times as large has no more to look at.
    """
    pilot, large = wide(1), wide(3)
    camera = Camera(width=320, height=240, fx=600.0, fy=600.0, cx=160, cy=120)
    rays = LensRays(camera, looking_down())[pilot.index]
    all_cells = trace(difference_block, pilot.worlds, rays, 256, 4, 9, CELL)
    change, noise = all_cells.lost + all_cells.gained, np.sqrt(all_cells.change_variance)
    near = near_objects(pilot.worlds, rays)
    assert 0.01 < near.mean() < 0.3
    assert near[all_cells.alpha > 0].all()
    assert (all_cells.alpha > 0).sum() > 10
    model = ALBEDO * upward(sky()) / np.pi
    assert near[(change < -0.25 * model).all(1)].all()
    assert np.all((np.abs(change) < 0.01 * model + 5 * noise)[pilot.glanced])
    assert large.glanced.mean() > 0.8
    assert abs((~large.glanced).sum() - (~pilot.glanced).sum()) < 0.3 * (~large.glanced).sum()


def test_the_pilot_grows_where_it_stands_for_pixels() -> None:
    """After the first picture its noise falls where it is more than interpolation may err; traced pixels stay.

    From 128 samples to 512: a quarter of the variance, up to what strata do to its estimate.
    """
    worlds, rays, _ = truth()
    limits, effort = Limits(0.01, 3e-3, 0.01), Effort(samples=64, seed=4)
    first, _ = prepare(worlds, rays, FRAME, upward(sky()), np.full(FRAME, 0.01), 1.0, limits, effort)
    assert first.pilot is not None
    calm = replace(first, pilot=replace(first.pilot, tolerance=1.0))
    assert settled(calm, lambda share: None).region is first.region
    first = replace(first, pilot=replace(first.pilot, tolerance=0.0))
    assert first.pilot is not None
    cells = first.pilot.too_noisy(first.region)
    assert len(cells) > 10
    after, again = (settled(first, lambda share: None) for _ in range(2))
    assert np.array_equal(after.region.lost, again.region.lost)
    assert np.array_equal(after.region.traced, first.region.traced)
    before, now = (
        canvas.framed(canvas.region.variance).reshape(-1, 3)[first.pilot.index[cells]].max(1).mean()
        for canvas in (first, after)
    )
    np.testing.assert_allclose(now / before, 128 / 512, rtol=0.5)


def test_the_regions_border_is_hidden_by_the_photographs_noise() -> None:
    """The composite's step from a tile that is left alone to the next: below a quarter of the noise of its mean."""
    canvas, halves, _, limits = adaptive()
    images = {name: canvas.framed(image) for name, image in pictures(canvas, halves)[0].items()}
    weight = canvas.framed(canvas.region.weight)
    change = relative((images["lost"] + images["gained"]) * weight[..., None])
    alone = wholly(weight == 0)
    border = binary_dilation(alone) & ~alone
    assert border.sum() > 20
    hidden = SIGMA / CELL / 4
    np.testing.assert_allclose(limits.hidden, hidden, rtol=0.02)  # median of noisy plate values: 0.6 % / sqrt(36864)
    assert np.abs(change).max(-1).reshape(alone.shape)[border].max() < hidden
    assert np.abs(change).max() > 100 * hidden


def test_sampling_stops_where_the_photograph_hides_the_noise() -> None:
    """Most of the shadow leaves early; no pixel takes more than its share, but for a grid of strata (32 become 35)."""
    count, alpha = (getattr(adaptive()[1].both, name) for name in ("count", "alpha"))
    assert (count[alpha == 0] < SAMPLES).mean() > 0.5
    assert count[alpha == 0].max() <= SAMPLES * 1.1
    assert count.max() <= OBJECT_BOOST * SAMPLES * 1.1
    assert count.min() >= 2 * TRUSTED


def test_light_groups_sum_to_the_whole(monkeypatch) -> None:
    """Objects, lost and gained light of sky and lamp alone against all at once: tile means within their noise.

    A mirror and a light of its own (which belongs to the sky). Samples are stratified, so their variance is an upper
    bound: z of 144 tile channels below 5, their mean square below 1.7 (see `test_paths`). In one pass, for speed.
    """
    monkeypatch.setattr(passes, "schedule", lambda samples: ([samples // 2], 1))
    mi, light = use_mitsuba(), sky()
    glow = Material((0.3, 0.3, 0.3), 0.0, 0.6, emission=(6.0, 4.0, 2.0))
    lamp = lamp_of(light)

    def under(part: np.ndarray, lamps: list[Emitter], white: float) -> Worlds:
        lit_ball = object_shape(mi, "glow", sphere(0.05, (-0.17, 0.05, 0.08), glow), np.eye(4), glow, "acescg", white)[
            0
        ]
        mirror = placed("mirror", sphere(0.1, (0, 0.1, 0), Material()), MIRROR_BSDF)
        return build_worlds(ground(), ALBEDO, part, {"glow": lit_ball, "mirror": mirror}, emitters=lamps)

    effort = Effort(samples=32, denoise=False, adaptive=False)
    sigma, worlds = np.full(SIZE, 0.01), under(light, [lamp], 0.5)
    limits = Limits(1e-4, 1e-4, 1e-4)
    canvas, left = prepare(worlds, all_rays(), SIZE, upward(light), sigma, 1.0, limits, effort, film())
    assert left["light_traced_share"] > 0.02
    whole, _, _ = render.refined(canvas)
    parts = {
        name: lit(canvas, under(part, lamps, 0.5 if name == "sky" else 0.0), upward(part))
        for name, (part, lamps) in render.groups(light, [lamp]).items()
    }
    apart, numbers, _ = render.by_group(parts)
    assert np.isfinite(list(numbers.values())).all()  # the lamp alone leaves the one object black, the other mirrors
    assert apart.attributes["insitu:groups"] == "sky,lamp_1"
    for layer in ("obj", "lost", "gained"):
        summed = sum(apart.rgb(f"{layer}.{name}").astype(float) for name in parts)
        np.testing.assert_allclose(summed, apart.rgb(layer), rtol=1e-5, atol=1e-6)
        noise = "objvariance" if layer == "obj" else "variance"
        variance = (whole.rgb(noise) + apart.rgb(noise)).astype(float)
        spread = np.sqrt(tile_means(variance, SIZE) / 64)
        gap = tile_means(summed - whole.rgb(layer), SIZE)
        z = gap[spread > 0] / spread[spread > 0]
        assert np.abs(z).max() < 5
        assert (z**2).mean() < 1.7
        assert np.median(spread) < 0.05 * np.abs(tile_means(whole.rgb(layer), SIZE)).max()
    np.testing.assert_array_equal(apart["obj.A"], whole["obj.A"])
