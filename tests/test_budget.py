"""Laws of the error budget: every mode against finite differences, squares that add, scaling, no NaN at the edges."""

import json

import numpy as np
import pytest
from test_transport import GREY, all_rays, camera, ground, looking_down, sky, sphere

from pipeline.budget import geometry, light, pixels
from pipeline.budget.response import DIMMER, Grid, Layers, Response, Seen, points_on, rendered, share_of
from pipeline.camera.lens import project
from pipeline.camera.rigid import camera_points, perturb, rotation_exp
from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light import alike
from pipeline.light.environment import AXES, SCALE_SIGMA, irradiance, total_energy
from pipeline.run.formats import read_exr
from pipeline.transport.scene import build_worlds
from pipeline.transport.surfaces import material_bsdf, mesh_shape
from pipeline.transport.variant import use_mitsuba
from pipeline.types import BallFit, Emitter, Raster, Surface, View
from stages import knobs, uncertainty

LAMP = np.array([0.4, 0.8, 0.447])
LAYERS = ("obj", "lost", "gained", "without", "variance", "objvariance")


def environment(rgb: np.ndarray, sigma: np.ndarray | float = 0.0, shared: str = "0 0 0") -> Raster:
    variance = np.broadcast_to(np.square(sigma), rgb.shape)
    channels = {**Raster.split(rgb), **Raster.split(variance, "variance"), "seen": np.ones(rgb.shape[:2])}
    return Raster(channels, "acescg", {SCALE_SIGMA: shared})


def lamp_of(rgb: np.ndarray, relative: float) -> Emitter:
    height, width = rgb.shape[:2]
    texels = np.flatnonzero((latlong_directions(height, width) @ LAMP > 0.97).ravel() & (rgb[..., 0].ravel() > 5))
    alone = np.zeros_like(rgb)
    alone.reshape(-1, 3)[texels] = rgb.reshape(-1, 3)[texels]
    flux = irradiance(alone, LAMP[None] / np.linalg.norm(LAMP))[0]
    return Emitter(
        name="lamp_1", direction=LAMP / np.linalg.norm(LAMP), solid_angle_sr=0.1, half_angle_rad=0.2, irradiance=flux,
        texels=texels, irradiance_sigma=relative * flux,
    )  # fmt: skip


def test_scale_patterns_are_the_covariance():
    root = np.array([[0.01, 0, 0], [0.008, 0.004, 0], [0.007, -0.001, 0.003]])
    found = light.scale_patterns(root @ root.T)
    assert np.sum([np.outer(p.factor, p.factor) for p in found], 0) == pytest.approx(root @ root.T, rel=1e-9)
    assert light.scale_patterns(np.zeros((3, 3))) == []


def test_scale_joins_balance_and_what_else_is_shared():
    joined = light.scale_covariance(np.full(3, 0.05), np.full((3, 3), 0.03**2))
    assert joined == pytest.approx(np.full((3, 3), 0.05**2))  # 3 and 4 %, each in all channels alike


def test_shared_part_is_taken_off_the_texels():
    rgb = sky()
    whole = environment(rgb, 0.05 * rgb, "0.03 0.03 0.03")
    assert alike.own_sigma(whole, alike.shared_sigma_of(whole)) == pytest.approx(0.04 * rgb, rel=1e-6)


def test_lobes_carry_the_variance_of_irradiance():
    """Against irradiance under 400 maps whose cells err independently; 400 draws tell a sigma to 3.5 %.

    Lobes are fitted to the six axes together; normals between them see up to a tenth more or less.
    """
    height, width = 64, 128
    rgb, random = np.ones((height, width, 3)), np.random.default_rng(1)
    found = light.sky_patterns(environment(rgb, 0.1), [], np.zeros(3))
    assert len(found) == 6
    normals = np.array([[0, 1, 0], [1, 0, 0], [0.6, 0.8, 0]])
    stated = np.sqrt(np.sum([irradiance(p.radiance, normals) ** 2 for p in found], 0))[:, 0]
    rows = round(height * alike.ALIKE_DEG / 180)
    assert rows == 1
    directions = latlong_directions(height, width)
    cosine = np.maximum(np.einsum("hwc,nc->nhw", directions, normals), 0) * latlong_solid_angles(height, width)
    parts = []
    for row in range(height):  # cells as wide as high on the sphere
        columns = max(1, round(1 / np.sqrt(1 - directions[row, 0, 1] ** 2)))
        parts.append(np.add.reduceat(cosine[:, row], np.arange(0, width, columns), 1))
    cells = np.concatenate(parts, 1)
    drawn = (0.1 * random.standard_normal((400, cells.shape[1])) @ cells.T).std(0)
    assert stated == pytest.approx(drawn, rel=0.1 + 2 * 0.035)


def test_flux_pattern_is_the_emitters_sigma():
    rgb = sky()
    lamp = lamp_of(rgb, 0.02)
    (pattern,) = light.flux_patterns(environment(rgb), [lamp], np.zeros(3))
    assert irradiance(pattern.radiance, lamp.direction[None])[0] == pytest.approx(lamp.irradiance_sigma, rel=1e-6)
    assert 0 < pattern.bound < 0.02
    (pattern,) = light.flux_patterns(environment(rgb), [lamp], np.full(3, 0.012))
    assert irradiance(pattern.radiance, lamp.direction[None])[0] == pytest.approx(0.8 * lamp.irradiance_sigma, rel=1e-6)


def test_lamps_are_unsure_by_what_they_state_of_their_width():
    rgb = sky()
    lamp = lamp_of(rgb, 0.02)
    assert light.width_patterns(environment(rgb), [lamp]) == []
    assert light.width_patterns(environment(rgb), []) == []
    unsure = lamp.model_copy(update={"half_angle_sigma_rad": 0.05})
    (pattern,) = light.width_patterns(environment(rgb), [unsure])
    assert 0 < pattern.bound <= (1 - 0.2 / 0.25) / 2
    assert pattern.lamps is not None
    up = lamp.direction[None]
    assert irradiance(pattern.lamps.rgb, up)[0] == pytest.approx(irradiance(rgb, up)[0], rel=2e-3)


def test_a_turned_map_is_the_light_from_elsewhere():
    rgb, turn = sky(), np.array([0.05, -0.1, 0.03])
    moved = light.turned(rgb, turn)
    assert total_energy(moved) == pytest.approx(total_energy(rgb), rel=1e-12)
    before = irradiance(rgb, AXES @ rotation_exp(turn))  # the light that came to R^T n now comes to n
    assert irradiance(moved, AXES) == pytest.approx(before, rel=0.01)  # bilinear, lamp of eight texels
    assert light.turned(rgb, np.zeros(3)) == pytest.approx(rgb)


def test_a_turned_lamp_takes_its_border_along():
    """Every texel on which the turned map shows a lamp is the lamp's, and no more than two about them."""
    height, random = 64, np.random.default_rng(5)
    for start in (40 * 128 + 60, 10 * 128 + 127, 2 * 128 + 3):  # the second at the seam, the third near the pole
        texels, alone = np.array([start, start + 128]), np.zeros((height, 128, 1))
        alone.reshape(-1)[texels] = 1
        turn = 0.02 * random.standard_normal(3)
        found = light.turned_texels(texels, height, turn)
        assert np.isin(np.flatnonzero(light.turned(alone, turn)), found).all()
        assert len(found) <= 2 * 25


def test_ball_off_centre_turns_the_map_by_twice_its_tilt():
    radius, sigma = 0.04, 1e-4
    ball = BallFit(
        centre_camera_m=[0, 0, 0.6], radius_m=radius, covariance=np.diag([sigma**2, 0, 0.0]), rms_px=0.1, points=100,
        radius_px=80,
    )  # fmt: skip
    view = View(world_from_camera=np.eye(4), covariance=np.zeros((6, 6)), route="given", rms_px=0, points=0)
    found = light.direction_covariance({"a": ball}, {"a": view})
    assert np.sqrt(found) == pytest.approx(np.diag([0, 2 * sigma / radius, 0]))
    # Mirrored direction by finite differences: normal at the middle of the ball's image when its centre moves by sigma.
    normals = [np.array([-shift, 0, -np.sqrt(radius**2 - shift**2)]) / radius for shift in (0, sigma)]
    mirrored = [np.array([0, 0, 1.0]) - 2 * n[2] * n for n in normals]
    assert np.linalg.norm(mirrored[1] - mirrored[0]) == pytest.approx(2 * sigma / radius, rel=1e-3)


def test_weak_patterns_are_left_out_together():
    some = [light.Pattern(f"p{i}", "sky", bound) for i, bound in enumerate([0.1, 0.005, 0.005, 0.008])]
    kept, left = light.worth_following(some, 0.01)
    assert [p.name for p in kept] == ["p0", "p3"]  # 2 x 0.005^2 is 0.5 %, with 0.008^2 1.1 % of the squares
    assert {p.name for p in left} == {"p1", "p2"}
    assert light.worth_following(some, 0.0)[1] == []
    assert light.worth_following([], 0.01) == ([], [])


def joint() -> tuple[View, np.ndarray]:
    root = (
        np.random.default_rng(2).standard_normal((15, 15))
        * np.repeat([1e-4, 2e-4, 0.3, 0.3, 1e-3], [3, 3, 2, 2, 5])[:, None]
    )
    whole = root @ root.T
    view = View(
        world_from_camera=looking_down(), covariance=whole[:6, :6], route="given", rms_px=0, points=9,
        lens_covariance=whole[:6, 6:],
    )  # fmt: skip
    return view, whole


def test_displacements_have_the_projected_covariance():
    """By perturbing pose and lens along every axis of a joint covariance."""
    view, whole = joint()
    lens = camera().model_copy(update={"covariance": whole[6:, 6:]})
    points = np.array([[0.05, 0.02, 0.0], [-0.1, 0, 0.1], [0.0, 0.1, 0.05]])
    moved = geometry.displacements(lens, view, points)
    stated = np.einsum("nim,njm->nij", moved, moved)
    step, jacobian = 1e-6, np.zeros((3, 2, 15))
    names = ("fx", "fy", "cx", "cy")
    for axis in range(15):
        pose, other = view.world_from_camera, lens
        if axis < 6:
            pose = perturb(pose, step * np.eye(6)[axis])
        elif axis < 10:
            other = lens.model_copy(update={names[axis - 6]: getattr(lens, names[axis - 6]) + step})
        else:
            other = lens.model_copy(update={"distortion": lens.distortion + step * np.eye(5)[axis - 10]})
        ends = [project(c, camera_points(p, points)[0]) for c, p in ((lens, view.world_from_camera), (other, pose))]
        jacobian[:, :, axis] = (ends[1] - ends[0]) / step
    assert stated == pytest.approx(jacobian @ whole @ np.swapaxes(jacobian, 1, 2), rel=1e-3)


def test_fields_keep_all_but_a_share_of_the_displacement():
    view, whole = joint()
    lens = camera().model_copy(update={"covariance": whole[6:, 6:]})
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.15, 0.15, 7), np.linspace(-0.15, 0.15, 7)))
    points = np.stack([x, 0 * x, z], -1)
    px = project(lens, camera_points(view.world_from_camera, points)[0])
    found = geometry.fields(lens, view, points, px, np.arange(len(px)) % 2 == 0, 0.01)
    assert 1 <= len(found) < 15
    true = (geometry.displacements(lens, view, points) ** 2).sum((1, 2))
    kept = sum(((geometry.terms(px, (48, 64)) @ f.on_ground) ** 2).sum(-1) for f in found)
    assert kept.sum() == pytest.approx(true.sum(), rel=0.02)  # 1 % left out, the rest the quadratic's
    given = view.model_copy(update={"covariance": np.zeros((6, 6)), "lens_covariance": None})
    assert geometry.fields(lens, given, points, px, np.ones(len(px), bool), 0.01) == []


def test_a_layer_that_moves_changes_by_its_slope():
    row, column = np.mgrid[:20, :30]
    ramp = (3.0 * column - 2.0 * row)[..., None] * np.ones(3)
    shift = np.broadcast_to([0.2, 0.1], (20, 30, 2))
    assert geometry.moved_by(ramp, shift) == pytest.approx(np.full((20, 30, 3), -(3 * 0.2 - 2 * 0.1)))


def test_grid_enlarges_what_is_linear_exactly():
    wanted = np.zeros((60, 80), bool)
    wanted[10:50, 20:71] = True
    grid = Grid.over(wanted, 120)
    assert grid.step > 1
    assert len(grid.pixels) == grid.chosen.sum() <= 1.3 * 120
    row, column = np.divmod(grid.pixels, 80)
    seen = grid.scattered(np.stack([row + 2.0 * column, row, column], -1))
    big = grid.enlarged(seen)
    rows, columns = np.mgrid[grid.window]
    inner = np.s_[grid.step : -grid.step, grid.step : -grid.step]
    assert big[inner] == pytest.approx(np.stack([rows + 2.0 * columns, rows, columns], -1)[inner])


def test_share_of_what_is_too_faint_is_the_mean():
    whole = np.zeros((8, 8, 3))
    whole[:4] = 2.0
    share = share_of(0.3 * whole, whole)
    assert share == pytest.approx(np.full((8, 8, 3), 0.3))
    assert share_of(whole, np.zeros_like(whole)) == pytest.approx(np.zeros((8, 8, 3)))


SEEN = Seen(-np.ones((6, 6, 3)), 0.5 * np.ones((6, 6, 3)), 4 * np.ones((6, 6, 3)))


def response() -> Response:
    grid = Grid.over(np.ones((6, 6), bool), 100)
    one = np.ones((6, 6, 3))
    layers = Layers(lost=-2 * one, gained=one, obj=8 * one, on_lost=0.9 * one, on_gained=1.1 * one)
    # Lost light meets the ground once, added light 1.5 times, a quarter of the objects' light once.
    dim = Seen(0.8 * SEEN.lost, 0.7 * SEEN.gained, 0.95 * SEEN.obj)
    return Response(grid, layers, SEEN, dim)


def test_light_that_is_too_bright_as_a_whole_changes_no_shadow():
    """Albedo is as much too low: lost light is right; of the objects' only what reaches them directly is wrong."""
    all_of_it = Seen(0.01 * SEEN.lost, 0.01 * SEEN.gained, 0.01 * SEEN.obj)
    found = response().of_light(all_of_it, np.full(3, 0.01))
    assert found == pytest.approx(np.full((6, 6, 3), 0.01 * (0.75 * 8 - 0.5 * 1.1)))
    assert response().of_factor(np.full(3, 0.01)) == pytest.approx(found)


def test_plate_sigma_alone_where_nothing_is_inserted():
    variance = np.full((4, 5, 3), 0.04)
    variance[0, 0] = np.inf
    found = pixels.plate_variance(np.ones((4, 5, 3)), variance)
    assert np.array_equal(found, variance)
    covered = np.ones((4, 5, 3))
    covered[0, 0] = 0.0
    assert pixels.plate_variance(covered, variance)[0, 0] == pytest.approx(np.zeros(3))  # the object hides the clip


def budget_of(exposure: float) -> tuple[np.ndarray, dict]:
    random = np.random.default_rng(5)
    shape = (24, 32)
    alpha = np.zeros(shape)
    alpha[8:16, 8:16] = 1
    plate = exposure * (1 + random.random((*shape, 3)))
    obj = alpha[..., None] * exposure * np.array([0.8, 0.5, 0.1])
    mul = (1 - alpha)[..., None] * np.ones(3)
    mul[16:, :16] *= 0.6
    composite = plate * mul + obj
    own = {
        "plate": pixels.plate_variance(mul, (0.01 * plate) ** 2),
        "render": pixels.render_variance(
            np.ones((*shape, 3)), plate, obj, np.full(shape, 0.003 * exposure), 0.02 * exposure * alpha
        ),
    }
    window = np.s_[8:24, 4:20]
    modes = [pixels.Mode("scale", "scale", 0.01 * obj[window]), pixels.Mode("p", "pose", 0.02 * composite[window])]
    sigma = np.sqrt(pixels.total_variance(list(own.values()), modes, window))
    means = {"plate": pixels.PLATE_PX * own["plate"], "render": 4 * own["render"]}
    return sigma, pixels.waterfall(composite, plate, alpha, own, means, modes, window)


def test_twice_the_exposure_is_twice_the_sigma():
    (one, fall), (two, other) = budget_of(1.0), budget_of(2.0)
    assert two == pytest.approx(2 * one, rel=1e-12)
    assert other["object"]["pixel_rel"] == pytest.approx(fall["object"]["pixel_rel"], rel=1e-9)
    assert fall["shadow"]["unknown_pixels"] == 0


def test_sources_of_a_waterfall_add_in_squares():
    _, fall = budget_of(1.0)
    for region in fall.values():
        for column in ("pixel_rel", "mean_rel", "mean_of_change"):
            parts = dict(region[column])
            total = parts.pop("total")
            assert np.sqrt(sum(value**2 for value in parts.values())) == pytest.approx(total, rel=1e-9)
    assert fall["object"]["mean_rel"]["scale"] == pytest.approx(0.01, rel=1e-9)  # of the objects' mean
    pixel, mean = (fall["object"][key]["render"] for key in ("pixel_rel", "mean_rel"))
    assert mean == pytest.approx(pixel * np.sqrt(4 / 64), rel=1e-9)  # 64 px, samples four times as noisy
    pixel, mean = (fall["shadow"][key]["plate"] for key in ("pixel_rel", "mean_rel"))
    assert mean == pytest.approx(pixel * np.sqrt(5 / fall["shadow"]["pixels"]), rel=0.05)  # relative to rms and to mean


def test_stored_pictures_keep_infinity_and_digits():
    kept = pixels.stored({"a": np.array([[1.5, np.inf, 0.001]])}, 10.0)["a"]
    assert kept.dtype == np.float16
    assert kept[0] == pytest.approx([1.5, np.inf, 0.001], rel=1e-3)
    assert pixels.stored({"a": np.ones((1, 1))}, 1e-5)["a"].dtype == np.float32


def test_flux_of_a_lamp_against_a_brighter_lamp():
    """A lamp 10 % brighter over a plane whose albedo was measured under it, by brute force and by its mode.

    The same random numbers in both; what is left is the second order: the lamp is 10 % brighter and gives up to two
    thirds of the irradiance, so the first order is up to 7 % off.
    """
    mi, rgb, eps = use_mitsuba(), sky(), 0.1
    lamp, albedo = lamp_of(rgb, eps), np.array([0.6, 0.5, 0.4])
    mesh = sphere(0.08, (0.0, 0.1, 0.0), GREY)
    grid = Grid.over(np.ones((48, 64), bool), 48 * 64)

    def seen(light_map: np.ndarray, ground_albedo: np.ndarray, emitters: list[Emitter]) -> Seen:
        shapes = {"o": mesh_shape(mi, "o", mesh, np.eye(4), material_bsdf(mi, mesh.material, "acescg"))}
        worlds = build_worlds(ground(), ground_albedo, light_map, shapes, (), emitters)
        return rendered(worlds, all_rays(), grid, 64, 4, 1)

    (pattern,) = light.flux_patterns(environment(rgb), [lamp], np.zeros(3))
    up = [irradiance(m, AXES[2:3])[0] for m in (rgb, pattern.radiance)]
    share = up[1] / up[0]
    whole, dim = seen(rgb, albedo, [lamp]), seen(rgb, DIMMER * albedo, [lamp])
    one = np.ones(whole.obj.shape)
    mode = Response(grid, Layers(whole.lost, whole.gained, whole.obj, one, one), whole, dim).of_light(
        seen(pattern.radiance, albedo, [lamp]), share
    )
    brighter = seen(rgb + pattern.radiance, albedo / (1 + share), [lamp]).minus(whole)
    true = brighter.lost + brighter.gained + brighter.obj
    size = np.abs(true).max()
    assert np.abs(mode - true).mean() < 0.01 * size
    for part in (brighter.obj.sum(-1) != 0, brighter.lost.sum(-1) < -0.1 * size):
        assert mode[part].mean(0) == pytest.approx(true[part].mean(0), rel=0.07)


def test_points_that_pixels_see_project_back():
    mi = use_mitsuba()
    mesh = sphere(0.08, (0.0, 0.1, 0.0), GREY)
    shapes = {"o": mesh_shape(mi, "o", mesh, np.eye(4), material_bsdf(mi, mesh.material, "acescg"))}
    worlds = build_worlds(ground(), np.full(3, 0.5), sky(), shapes)
    grid = Grid.over(np.ones((48, 64), bool), 48 * 64)
    points, px, on_object = points_on(worlds, all_rays(), grid)
    assert 0 < on_object.sum() < len(on_object)
    assert project(camera(), camera_points(looking_down(), points)[0]) == pytest.approx(px, abs=2e-3)  # float32 rays
    assert points[~on_object][:, 1] == pytest.approx(np.zeros((~on_object).sum()), abs=1e-5)


def test_desk_says_how_far_its_pixels_can_be_trusted(desk_build):
    """Squares add up as the header says (to the digits of 16 bit); what nothing touches has the plate's own sigma."""
    unsure = read_exr(desk_build / "uncertainty" / "uncertainty.exr")
    layers = read_exr(desk_build / "render" / "layers.exr")
    plate = read_exr(desk_build / "develop" / "photographs" / "plate.exr")
    modes = unsure.attributes["insitu:modes"].split(",")
    assert {"scale", "flux_lamp_1", "pose_0"} <= set(modes)
    sigma = unsure.rgb("sigma").astype(float)
    parts = sum(unsure.rgb(name).astype(float) ** 2 for name in ("plate", "render", *(f"mode_{m}" for m in modes)))
    assert np.isfinite(sigma).all()
    assert np.sqrt(parts) == pytest.approx(sigma, rel=2e-3)
    alone = (layers["influence"] == 0) & (layers["obj.A"] == 0)
    assert alone.any()
    own = np.sqrt(plate.rgb("variance") + pixels.INTERPOLATED * plate.rgb("interpolation"))
    assert sigma[alone] == pytest.approx(own[alone], rel=2e-3)
    covered = layers["obj.A"] > 0.999
    own = own[covered]
    assert (unsure.rgb("plate")[covered] <= 1.01e-3 * own).all()  # no more of the plate is left there; 16 bit
    budget = json.loads((desk_build / "uncertainty" / "budget.json").read_text())
    assert "near field: the map at the objects" in {row["term"] for row in budget["not_covered"]}
    assert 0.001 < budget["regions"]["object"]["mean_rel"]["total"] < 0.02


def test_likelihood_tells_which_source_is_overstated():
    """A shared source at half of what it states, an own one at twice: 40 captures of 12 places.

    The shared one is one number per capture: its factor is known to 1 / sqrt(80) = 11 %; the own one better than 3 %.
    """
    from benchmarks.budget_sources import OWN, Capture, fitted

    random = np.random.default_rng(5)
    captures = []
    for _ in range(40):
        mode, noise = random.normal(0, 0.05, (1, 12, 3)), np.full((12, 3), 0.01)
        error = 0.5 * random.normal() * mode[0] + 2 * noise * random.normal(size=(12, 3))
        own = {name: noise**2 if name == "plate" else 0 * noise for name in OWN}
        captures.append(Capture(error, {"turn": mode}, own))
    found = dict(zip(["turn", *OWN], fitted(["turn", *OWN], captures), strict=True))
    assert found["turn"] == pytest.approx(0.5, rel=0.33)
    assert found["plate"] == pytest.approx(2, rel=0.1)


def test_nothing_inserted_is_the_plate_and_its_sigma():
    random = np.random.default_rng(3)
    rgb = 1 + random.random((16, 24, 3)).astype(np.float32)
    variance = (0.01 * rgb) ** 2
    variance[3, 4] = np.inf
    plate = Raster({**Raster.split(rgb), **Raster.split(variance, "variance")}, "acescg")
    names = [f"{layer}.{c}" for layer in LAYERS for c in "RGB"]
    layers = Raster({n: np.zeros((16, 24)) for n in [*names, "obj.A", "ground", "noise.change", "noise.obj"]}, "acescg")
    channels = {**Raster.split(rgb), **Raster.split(np.ones_like(rgb), "mul"), **Raster.split(0 * rgb, "add")}
    composite = Raster({**channels, **Raster.split(0 * rgb, "obj"), "obj.A": np.zeros((16, 24))}, "acescg")
    result = uncertainty.compute(
        wishes={"object": []}, camera=camera(), views={"plate": joint()[0]}, photographs={"plate": plate}, balance={},
        balls={}, environment=environment(sky()), emitters=[], plane=ground(), albedo=environment(sky()),
        surface=Surface(), local_proxies=[], occluders=[], layers=layers, composite=composite, records={},
        params=knobs.Uncertainty.model_validate({}),
    )  # fmt: skip
    found = result.outputs["uncertainty"].rgb("sigma").astype(float)
    assert found == pytest.approx(np.sqrt(variance), rel=1e-3)
    assert result.numbers["unknown_px"] == 1
    assert result.numbers["modes"] == {}
    assert "1 px" in result.warnings[0]
