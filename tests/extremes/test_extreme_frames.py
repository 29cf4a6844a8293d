"""Extremes of frames, balls, poses and the machine that no other test holds; searches of the merge and of poses."""

from __future__ import annotations

import re
import resource
from types import SimpleNamespace

import numpy as np
import pytest
import test_board_doubts
import test_radiometry
import test_resection
from command import refused, tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from printed_board import looking_at
from test_composite import world

from pipeline.camera import view_checks
from pipeline.camera.colmap_bridge import reconstruct
from pipeline.camera.lens import project
from pipeline.camera.markers import marker_points
from pipeline.camera.resection import resect_plane, residuals_and_jacobian
from pipeline.camera.rigid import camera_points, difference
from pipeline.conventions import CLIPPED, DARK
from pipeline.image.radiometry import Exposed, merge
from pipeline.light.prediction import pixel_centres, plane_hits, plane_texture
from pipeline.probes.finding import Found, complaints, refuse
from pipeline.probes.sphere_fit import Height
from pipeline.run.errors import CaptureError, NumericalError
from pipeline.transport import differential as d
from pipeline.types import Camera
from stages import composite, knobs

# ---- balls ---------------------------------------------------------------------------------------------------------


def test_balls_that_cannot_be_used(saw):
    """Nearer than 1.5 radii, and smaller than 12 px."""
    for case, distance, radius_px in (("ball.touching", 1.4, 300.0), ("ball.tiny", 20.0, 11.0)):
        fit = SimpleNamespace(centre=np.array([0, 0, distance * 0.04]), radius_px=radius_px, visible=1.0)
        with pytest.raises(CaptureError) as refusal:
            refuse("ball_a", fit, 0.04)  # type: ignore[arg-type]
        saw(case, "refused", said=str(refusal.value))


def test_a_print_of_another_size(saw):
    """A board 5 % larger than stated, and 3 % smaller: the ball, of true size by its rim, misses the plane."""
    for stated in (0.97, 1.05):
        height, radius, normal = 0.5, 0.04, np.array([0.0, -0.8, -0.6])
        centre = normal * (radius - height) + np.array([0, 0.6, -0.8]) * 0.1
        fit = SimpleNamespace(centre=centre, radius_px=200.0, blur_px=0.5, visible=1.0, covariance=np.eye(3) * 1e-10)
        ball = Found(fit, fit, Height(normal, stated * height, 1e-4), centre)  # type: ignore[arg-type]
        (said,) = [text for text in complaints("ball_a", ball, radius) if "measures" in text]
        named = float(said.split("measures ")[1].split("%")[0]) / 100
        saw("marker.wrong_size", "degraded", abs(named * stated - 1), said=said)


# ---- poses ---------------------------------------------------------------------------------------------------------


def test_a_marker_seen_squarely(saw):
    """50 photographs of it with noise: rotation in stated deviations (three numbers), and that they are large."""
    rng = np.random.default_rng(7)
    points, pose = marker_points(0.1), looking_at(np.zeros(3), 0, 0, 1.2)
    worst, deviations = 0.0, []
    for _ in range(50):
        best, _, _ = resect_plane(
            test_resection.CAMERA, points, test_resection.seen(points, pose, rng), test_resection.SIGMA
        )
        turned = difference(best.world_from_camera, pose)[:3]
        deviations.append(np.degrees(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1])))
        worst = max(worst, float(np.sqrt(turned @ np.linalg.solve(best.covariance[:3, :3], turned))))
    assert np.median(deviations) > 1
    saw("marker.frontal", "degraded", worst, said=f"covariance of {np.median(deviations):.1f} degrees, frontal")


def test_turned_on_the_spot(saw):
    made = test_board_doubts.cloud(0.005)
    exact = np.degrees(2 * np.arctan(0.0075 / 3.0))  # a baseline of 15 mm at 3 m, the median depth
    said = view_checks.only_turned(made)
    assert "turned on the spot" in said
    saw("views.pure_rotation", "degraded", abs(view_checks.parallax_deg(made) / exact - 1), said=said)


@pytest.mark.slow
def test_two_views(saw):
    """Two photographs of a wall full of texture, from places that differ."""
    rng = np.random.default_rng(1)
    wall = np.kron(rng.integers(0, 256, (60, 80)), np.ones((6, 6))).astype(np.uint8)
    pictures = {"a": wall[:300, :400], "b": np.ascontiguousarray(wall[20:320, 30:430])}
    camera = Camera(width=400, height=300, fx=400, fy=400, cx=200, cy=150, source="guess")
    with pytest.raises(NumericalError, match="hang together, needed 3") as refusal:
        reconstruct(pictures, {"a": 0, "b": 0}, [camera])
    saw("views.two", "refused", said=str(refusal.value))


def test_horizon_in_the_frame(saw):
    """A camera that looks along the plane: above the horizon no hit, no texture, and the plate's own bits."""
    inputs = world(4)
    view = inputs["views"]["plate"]
    level = view.world_from_camera.copy()
    level[:3, :3] = np.diag([1.0, -1.0, -1.0])
    level[:3, 3] = [0, 0.3, 0.5]
    inputs["views"] = {"plate": view.model_copy(update={"world_from_camera": level})}
    camera, plane = inputs["camera"], inputs["plane"]
    px = pixel_centres(slice(0, camera.height), slice(0, camera.width)).reshape(-1, 2)
    hits = plane_hits(plane, camera, level, px)
    above = ~np.isfinite(hits[:, 0])
    assert 0.2 < above.mean() < 0.8
    np.testing.assert_allclose(hits[~above] @ plane.normal, plane.offset_m, atol=1e-9)
    texture = plane_texture(plane, np.ones((4, 4, 3)), hits)
    for name, values in inputs["layers"].channels.items():
        if name not in ("influence",):
            values[above.reshape(camera.height, camera.width)] = 0
    made = composite.compute(**inputs, params=knobs.Composite()).outputs["composite"].rgb()
    plate = inputs["photographs"]["plate"].rgb()
    changed = (made.view(np.uint32) != plate.view(np.uint32)).any(-1).ravel()
    wrong = np.count_nonzero(changed & above) + np.count_nonzero(~np.isfinite(made))
    saw(
        "plane.horizon",
        "exact",
        wrong + np.count_nonzero(np.isfinite(texture[above]).all(-1) & (texture[above] > 0).any(-1)),
    )


@pytest.mark.slow
@settings(max_examples=20)
@given(
    tilt=st.floats(0, 80), azimuth=st.floats(0, 360), distance=st.floats(-1, 2), sigma=st.floats(-2, 0.3),
    scale=st.floats(-3, 3),
)  # fmt: skip
def test_covariance_of_poses(tilt, azimuth, distance, sigma, scale, saw):
    """Symmetric, positive, and the inverse of the information, for a board of any size, seen from anywhere.

    Both scaled to unit deviations: radians and metres are up to 1e6 apart.
    """
    size, away = 10.0**scale, 0.4 * 10.0 ** (scale + distance)
    points = test_resection.BOARD * size
    pose = looking_at(test_resection.CENTRE * size, tilt, azimuth, away)
    px = project(test_resection.CAMERA, camera_points(pose, points)[0])
    if not np.isfinite(px).all():
        return
    best, _, _ = resect_plane(test_resection.CAMERA, points, px, 10.0**sigma)
    found = best.noise_covariance
    assert np.isfinite(found).all()
    deviations = np.sqrt(np.diag(found))
    unit = found / np.outer(deviations, deviations)
    assert np.linalg.eigvalsh(unit)[0] > 0
    if best.frontal:  # widened on purpose: see `widened`
        return
    jacobian = residuals_and_jacobian(test_resection.CAMERA, best.world_from_camera, points, px)[1][best.kept]
    scaled = (jacobian.reshape(-1, 6) * deviations / best.sigma_px).astype(np.longdouble)
    residual = unit.astype(np.longdouble) @ (scaled.T @ scaled) - np.eye(6)
    saw("formula.covariance", "exact", np.abs(residual).max())


# ---- frames --------------------------------------------------------------------------------------------------------


@st.composite
def brackets(draw):
    """Two to six frames of a sensor, up to four stops apart, of a scene over up to 24 stops; some of them equal."""
    count, gap = draw(st.integers(1, 6)), draw(st.floats(0, 4))
    stops = [2.0 ** (-gap * k) for k in range(count)]
    low, span = draw(st.floats(-4, 0)), draw(st.floats(0, 7))
    shape = draw(st.sampled_from([(1, 1), (2, 3), (6, 40), (17, 9)]))
    radiance = np.geomspace(10**low, 10 ** (low + span), int(np.prod(shape))).reshape(shape)
    return test_radiometry.bracket(radiance, draw(st.integers(0, 10**6)), stops), radiance


@given(case=brackets(), order=st.randoms(use_true_random=False))
def test_any_order_of_any_bracket(case, order, saw):
    frames, _ = case
    mixed = list(frames)
    order.shuffle(mixed)
    one, other = merge(frames), merge(mixed)
    differ = sum(
        getattr(one, name).tobytes() != getattr(other, name).tobytes() for name in ("radiance", "variance", "mask")
    )
    saw("law.frame_order", "exact", differ)


@given(case=brackets(), stops=st.integers(-20, 20))
def test_twice_the_exposure_of_any_bracket(case, stops, saw):
    frames, _ = case
    scale = 2.0**stops
    longer = [Exposed(f.mosaic, scale * f.exposure, f.black, f.white, f.limit, f.noise) for f in frames]
    one, other = merge(frames), merge(longer)
    differ = np.count_nonzero(one.radiance != np.float32(scale) * other.radiance)
    saw("law.exposure_doubled", "exact", differ + np.count_nonzero(one.mask != other.mask))


@given(case=brackets())
def test_merge_against_double_precision(case, saw):
    """Poisson weights, where no sample clips: counts over times in float64."""
    frames, _ = case
    found = merge(frames, "poisson")
    signal = np.array([(f.mosaic.astype(float) - test_radiometry.BLACK) * test_radiometry.STEP for f in frames])
    plain = signal.sum(0) / sum(f.exposure for f in frames)
    unclipped = (signal < min(float(f.limit.min()) for f in frames) - 1e-3).all(0)
    if unclipped.any():
        error = np.abs(found.radiance - plain) / np.sqrt(found.variance)
        saw("formula.merge", "exact", error[unclipped].max())
    assert not np.isnan(found.radiance).any()
    assert (found.variance > 0).all()
    assert np.isfinite(found.radiance[(found.mask & (CLIPPED | DARK)) == 0]).all()


def test_probe_and_plate_a_thousand_times(saw):
    """Frames of a thousandth of the exposure, through merge and composite: every value times 1000."""
    radiance = np.geomspace(1e-3, 50, 24 * 40).reshape(24, 40)
    frames = test_radiometry.bracket(radiance)
    brighter = [Exposed(f.mosaic, f.exposure / 1000, f.black, f.white, f.limit, f.noise) for f in frames]
    one, other = merge(frames), merge(brighter)
    plate = np.abs(np.repeat(one.radiance[..., None], 3, -1)) + np.float32(1e-3)
    shadow = d.Change(
        0.1 * plate, np.zeros(plate.shape[:2]), -0.4 * plate, 0.2 * plate, 0.8 * plate, np.ones(plate.shape[:2])
    )
    bright = d.Change(100.0 * plate, shadow.alpha, -400.0 * plate, 200.0 * plate, 800.0 * plate, shadow.ground)
    out = [
        d.build(c, d.chosen(c, p, np.full(p.shape, v))).apply(p)
        for c, p, v in ((shadow, plate, 1e-6), (bright, 1000 * plate, 1.0))
    ]
    merged = np.abs(other.radiance / (1000 * one.radiance) - 1).max()
    saw("probe.x1000_with_plate", "exact", max(merged, np.abs(out[1] / (1000 * out[0]) - 1).max()))


@pytest.mark.slow
def test_a_hundred_megapixels(tmp_path, saw):
    """Five frames in memory, their merge and the search for defects: peak of the process."""
    from benchmarks.merge import memory

    saw("picture.100Mpx", "exact", memory(tmp_path)["peak_gib"])


def test_one_pixel_composite():
    """A plate of one pixel goes through the default form."""
    one = np.ones((1, 1, 3))
    found = d.Change(0 * one, np.zeros((1, 1)), -0.5 * one, 0.1 * one, one, np.ones((1, 1)))
    plate = one.astype(np.float32)
    assert np.isfinite(d.build(found, d.chosen(found, plate, 1e-4 * one)).apply(plate)).all()


# ---- the machine ---------------------------------------------------------------------------------------------------


def test_disk_full(capsys, tmp_path, saw):
    """The system refuses to lengthen any file beyond 20 kB, as a full disk does, in the middle of a stage's output."""
    folder, out = tiny(tmp_path), tmp_path / "out"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        (line,) = refused(capsys, 4, "run", folder, "--out", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not (out / "merge/record.json").exists()
    assert not [path for path in out.rglob("*") if path.suffix in (".exr", ".part") or path.name.startswith(".plate")]
    said = re.sub(r"\.\w+\.\w{8}/", "", line.replace(str(tmp_path), "..."))  # without the temporary folder
    saw("machine.disk_full", "refused", said=said)
