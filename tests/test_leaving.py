"""What a simulated capture does that is hard, or that no estimator models: laws of the simulator itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.conventions import latlong_solid_angles
from pipeline.run.errors import ManifestError
from pipeline.run.manifest import CaptureFacts
from pipeline.simulation import capture, shapes, thrown
from pipeline.simulation.leaving import SHEET_LIFT_M, curled_sheet, dented_sphere, glare
from pipeline.simulation.light import mitsuba_envmap, unit_direction, with_small_lamps
from pipeline.simulation.photograph import path_radiance, trace
from pipeline.simulation.scene_file import BoxModel, DentFacts, LampFacts, SimulatedScene, load_scene
from pipeline.simulation.world import Place, rectangles
from pipeline.transport.proxies import box
from pipeline.transport.variant import use_mitsuba
from stages import simulate
from stages.simulate import Studio, turned_plates

ROOM = {
    "centre_m": (0.1, 0.5, 0.2), "size_m": (2.0, 2.5, 2.2), "wall": (0.5,) * 3, "ceiling": (0.6,) * 3,
    "floor": (0.3,) * 3,
}  # fmt: skip
SCENES = Path(__file__).parents[1] / "sample_captures/scenes"


def desk_scene(**changes: object) -> SimulatedScene:
    return load_scene(SCENES / "desk.toml").model_copy(update=changes)


def test_glare_keeps_an_even_picture_and_spreads_the_stated_share() -> None:
    even = np.full((40, 60, 3), 5.0)
    np.testing.assert_allclose(glare(even, 0.1, 20.0), even, rtol=1e-12)
    spot = np.zeros((101, 101, 1))
    spot[50, 50] = 1.0
    seen = glare(spot, 0.2, 4.0)
    # The bell is cut at half a picture, so all of it falls inside; its peak is 1 over the sum of its samples.
    assert seen.sum() == pytest.approx(1.0, rel=1e-9)
    rows = np.arange(-50, 51)
    bell = (1 + (rows[:, None] ** 2 + rows**2) / 16.0) ** -1.5
    np.testing.assert_allclose(seen[..., 0], 0.8 * spot[..., 0] + 0.2 * bell / bell.sum(), atol=1e-12)


def test_normals_of_a_dented_sphere_are_those_of_its_shape() -> None:
    dents = [
        DentFacts(azimuth_deg=30, elevation_deg=20, depth_m=0.002, sigma_deg=12),
        DentFacts(azimuth_deg=200, elevation_deg=60, depth_m=-0.001, sigma_deg=25),
    ]
    vertices, normals, _ = dented_sphere(0.06, dents, rows=256)
    grid = vertices.reshape(257, 513, 3)
    up, right = grid[2:, 1:-1] - grid[:-2, 1:-1], grid[1:-1, 2:] - grid[1:-1, :-2]
    seen = np.cross(right, up)[8:-8]  # not at the poles, where a row is short
    seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    # Central differences over 1.4 degrees deviate by the third derivative: dents of 12 degrees, 0.05 degrees at most.
    cosine = (seen * normals.reshape(257, 513, 3)[9:-9, 1:-1]).sum(-1)
    assert np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))) < 0.05
    deepest = vertices[np.argmax(vertices @ unit_direction(30, 20) / np.linalg.norm(vertices, axis=1))]
    assert np.linalg.norm(deepest) == pytest.approx(0.058, abs=2e-5)  # the nearest vertex is up to 0.5 degrees away
    round_ball = dented_sphere(0.06, [], rows=64)
    np.testing.assert_allclose(round_ball[0], 0.06 * round_ball[1], atol=1e-12)


def test_a_curled_sheet_is_a_flat_one_bent_up() -> None:
    sheet = (-0.01, -0.02, 0.22, 0.16)
    (vertices, normals, faces), uv = curled_sheet(sheet, 2.0)
    off = vertices[:, 0] - 0.105
    np.testing.assert_allclose(vertices[:, 1], off**2 / 4.0 + SHEET_LIFT_M, atol=1e-15)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 1] > 0).all()  # it looks up
    tangent = np.stack([np.ones_like(off), off / 2.0, 0 * off], -1)
    np.testing.assert_allclose((tangent * normals).sum(1), 0, atol=1e-12)
    (flat, _, _), flat_uv = rectangles([sheet], sheet)
    for corner, place in zip(flat, flat_uv):
        nearest = np.argmin(np.linalg.norm(vertices[:, [0, 2]] - corner[[0, 2]], axis=1))
        np.testing.assert_allclose(uv[nearest], place, atol=1e-12)


def test_light_thrown_by_the_ball_is_where_the_law_of_reflection_puts_it() -> None:
    """Lamp at the zenith: what meets the sphere beyond the angle t from its top lands within a known radius.

    A ray that meets it there leaves at 2 t from the zenith, from the height R (1 + cos t). Tolerance: four sigma of the
    rays counted, and half a percent for the smoothing and the cells at the rim.
    """
    lamp = LampFacts(azimuth_deg=0, elevation_deg=89.999, diameter_deg=0.2, radiance=(3.0, 2.0, 1.0))
    radius, rays = 0.05, 1_000_000
    found = thrown.thrown_irradiance(lamp, 2.0, np.array([0.0, radius, 0.0]), radius, (0.9, 0.8, 0.7), 1, rays)
    at = (np.arange(len(found)) - thrown.HALF_WIDTH_CELLS + 0.5) * thrown.CELL_M
    away = np.hypot(at[:, None], at[None, :])
    arriving = 2 * np.pi * (1 - np.cos(np.radians(0.1))) * 2.0 * np.array([3 * 0.9, 2 * 0.8, 1 * 0.7])
    for t in np.radians([52.0, 60.0, 70.0]):
        limit = radius * np.sin(t) - radius * (1 + np.cos(t)) * np.tan(2 * t)
        share = 1 - np.sin(t) ** 2
        landed = found[away < limit].sum(0) * thrown.CELL_M**2
        expected = np.pi * radius**2 * arriving * share
        np.testing.assert_allclose(landed, expected, rtol=4 / np.sqrt(rays * share) + 0.005)


def test_a_wrong_label_is_written_and_the_true_time_kept(tmp_path: Path) -> None:
    import exifread

    file = "plate/plate_ev0.dng"
    scene = desk_scene()
    wrong_label = {"wrong_label": [{"file": file, "factor": 1.4}]}
    bracket = scene.bracket.model_validate(scene.bracket.model_dump() | wrong_label)
    camera = scene.camera.model_copy(update={"width": 32, "height": 24})
    scene = scene.model_copy(update={"bracket": bracket, "camera": camera})
    shoot = capture.Shoot(scene, tmp_path, capture.sensor_of(scene))
    for name in (file, "plate/plate_ev+2.dng"):
        shoot.take(name, np.full((24, 32, 3), 10.0), 9)
    wrong, right = shoot.exposures[file], shoot.exposures["plate/plate_ev+2.dng"]
    assert wrong["true_s"] == right["true_s"]
    assert wrong["label_s"] == pytest.approx(1.4 * right["label_s"], rel=1e-4)
    with (tmp_path / file).open("rb") as stream:
        label = exifread.process_file(stream, details=False)["EXIF ExposureTime"].values[0]
    assert float(label) == pytest.approx(wrong["label_s"])


def test_frames_that_are_not_taken_are_refused(tmp_path: Path) -> None:
    text = (SCENES / "desk.toml").read_text()
    path = tmp_path / "scene.toml"
    wrong = '[[bracket.wrong_label]]\nfile = "plate/plate_ev1.dng"\nfactor = 1.4\n\n[sampling]'
    path.write_text(text.replace("[sampling]", wrong))
    with pytest.raises(ManifestError, match=r"no frame \['plate/plate_ev1.dng'\]"):
        load_scene(path)
    path.write_text(text.replace("ball_frames = 6", "ball_frames = 6\nplate_turn_deg = [[0.1, 0.0]]"))
    with pytest.raises(ManifestError, match="plate_turn_deg has 1 entries"):
        load_scene(path)
    path.write_text(text.replace("ball_frames = 6", "ball_frames = 6\nball_turn_deg = [[0.1, 0.0]]"))
    with pytest.raises(ManifestError, match="ball_turn_deg has 1 entries"):
        load_scene(path)


def test_stated_boxes_and_room_are_facts_of_the_same_shape() -> None:
    """The [[proxy]] of a box, as insitu builds it, has the corners of the box that is rendered."""
    model = BoxModel(
        name="crate", position_m=(0.2, -0.1), size_m=(0.1, 0.2, 0.3), yaw_deg=25, albedo=(0.5, 0.5, 0.5), stated=True
    )
    hidden = model.model_copy(update={"name": "tin", "stated": False})
    scene = SimulatedScene.model_validate(desk_scene(box=[model, hidden]).model_dump() | {"room": ROOM})
    tables: dict[str, object] = {}
    for heading, keys in capture.capture_tables(scene):
        name = heading.strip("[]")
        if heading.startswith("[["):
            tables.setdefault(name, []).append(keys)  # type: ignore[attr-defined]
        else:
            tables.update({name: keys} if name else keys)
    facts = CaptureFacts.model_validate(tables)
    assert facts.room is not None
    assert facts.room.size_m == (2.0, 2.5, 2.2)
    (proxy,) = facts.proxy
    assert proxy.centre_m
    assert proxy.size_m
    corners, _ = box(proxy.centre_m, proxy.size_m, proxy.yaw_deg)
    rendered = shapes.standing_box(model)[0][0]
    gap = np.linalg.norm(rendered[:, None] - corners[None], axis=-1).min(1)
    assert gap.max() < 1e-12


def test_walls_of_a_room_look_inwards() -> None:
    mi = use_mitsuba()
    scene = SimulatedScene.model_validate(desk_scene().model_dump() | {"room": ROOM})
    walls = mi.load_dict({"type": "scene", **Place(mi, scene).walls(scene.room)})
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    hit = walls.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.5, 0.2), mi.Vector3f(ways.T.astype(np.float32))))
    np.testing.assert_allclose(np.array(hit.t), [1.0, 1.25, 1.1] * 2, rtol=1e-5)
    np.testing.assert_allclose(np.array(hit.n).T, -ways, atol=1e-6)


def test_a_small_lamp_keeps_its_flux_in_the_true_environment() -> None:
    """Of a sun, alone in the sky: flux of the coarse picture against the sum over the map that Mitsuba is given.

    The map's rows run from pole to pole, so each stands for the belt around it; both sums are exact but for the belt's
    curvature: 1e-3.
    """
    scene = load_scene(SCENES / "courtyard.toml")
    dark = {"wall": (0, 0, 0), "ceiling": (0, 0, 0), "floor": (0, 0, 0), "softbox": [], "map_width": 2048}
    sky = scene.light.model_validate(scene.light.model_dump() | dark)
    texels = mitsuba_envmap(sky).astype(float)
    rows = np.arange(len(texels)) * np.pi / (len(texels) - 1)
    belts = np.sin(rows) * 2 * np.sin(np.pi / (len(texels) - 1) / 2) * 2 * np.pi / texels.shape[1]
    flux = (texels * belts[:, None, None]).sum((0, 1))
    found = with_small_lamps(sky, np.zeros((128, 256, 3)))
    np.testing.assert_allclose((found * latlong_solid_angles(128, 256)[..., None]).sum((0, 1)), flux, rtol=1e-3)


def table_scene(albedo: float = 0.5, **changes: object) -> SimulatedScene:
    """An even table under whatever ``changes`` say; without them, a sky of radiance one."""
    even = {"wall": (1, 1, 1), "ceiling": (1, 1, 1), "floor": (1, 1, 1), "wall_variation": 0.0, "map_width": 64}
    bare = {"light": even, "near_lamp": [], "room": None, "box": [], "object": [], "leave": {}}
    table = {"pattern": "terrazzo", "x_m": (-5, 5), "z_m": (-5, 5), "texel_m": 0.5, "contrast": 0}
    table |= {"albedo": (albedo,) * 3}
    return SimulatedScene.model_validate(desk_scene().model_dump() | bare | {"table": table} | changes)


def radiance_of_table(scene: SimulatedScene, spots: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Mean radiance (N, 3) of the bare table at ``spots`` (N, 3), seen along ``away`` (N, 3) from it; 65536 samples."""
    mi = use_mitsuba()  # before drjit, which else takes another LLVM
    import drjit as dr

    measure = path_radiance(mi, Place(mi, scene).load(prints=False), depth=3)

    def shoot(number: Any, _: Any) -> Any:
        start = [dr.gather(mi.Float, mi.Float((spots + away)[:, i].astype(np.float32)), number) for i in range(3)]
        way = [dr.gather(mi.Float, mi.Float(-away[:, i].astype(np.float32)), number) for i in range(3)]
        return mi.RayDifferential3f(mi.Point3f(*start), dr.normalize(mi.Vector3f(*way)))

    return trace(mi, shoot, measure, np.arange(len(spots)), 65536, 1)


def test_a_near_lamp_obeys_the_inverse_square_law() -> None:
    """A glowing ball of radius r, wholly above the table, gives ``pi L (r / d)^2 cos``, exactly, at any distance d.

    Tolerance: 1e-3. The lamp is sampled by the cone that it fills, whose cosines differ by at most 40 % here: noise of
    5e-4 at 65536 samples of the nearest spot.
    """
    dark = {"wall": (0, 0, 0), "ceiling": (0, 0, 0), "floor": (0, 0, 0), "scale": 2.0, "map_width": 64}
    place, radius, radiance = np.array([0.3, 0.5, -0.2]), 0.1, np.array([30.0, 20.0, 10.0])
    lamp = {"position_m": tuple(place), "diameter_m": 2 * radius, "radiance": tuple(radiance)}
    spots = np.array([[0.3, 0, -0.2], [0.9, 0, -0.2], [0.3, 0, 1.3], [-2.0, 0, -1.0]])
    up = np.tile([0.01, 3.0, 0.01], (4, 1))  # past the lamp that hangs over the first
    up[0] = [2.0, 1.0, 0.0]
    found = radiance_of_table(table_scene(light=dark, near_lamp=[lamp]), spots, up)
    distance = np.linalg.norm(place - spots, axis=1)
    expected = np.pi * (radius / distance) ** 2 * place[1] / distance
    np.testing.assert_allclose(found, 0.5 / np.pi * expected[:, None] * 2.0 * radiance, rtol=1e-3)


def test_a_coated_table_reflects_what_a_smooth_coat_does() -> None:
    """Under an even sky of radiance one, a coat over albedo a reflects ``F(t) + (1 - F(t)) a``, seen at the angle t.

    F is Fresnel's reflectance, exact for a smooth coat; what is under it gives what it would give without, since light
    goes around within the coat as over white ground. Tolerances: F to 2 % (alpha 0.02 hides 1.4 % of its facets at 75
    degrees); the rest 3.5 %, of the transmittance that Mitsuba reads from tables, 2.6 to 3.3 % low at all angles.
    """
    cosine = np.cos(np.radians([0.0, 30.0, 60.0, 75.0]))
    away = np.stack([np.sqrt(1 - cosine**2), cosine, 0 * cosine], -1)
    light, dark = (
        radiance_of_table(table_scene(leave={"table_coat": 0.02}, albedo=albedo), np.zeros((4, 3)), away)
        for albedo in (0.5, 0.25)
    )
    inner = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
    s, p = (cosine - 1.5 * inner) / (cosine + 1.5 * inner), (inner - 1.5 * cosine) / (inner + 1.5 * cosine)
    fresnel = ((s**2 + p**2) / 2)[:, None].repeat(3, 1)
    np.testing.assert_allclose(2 * dark - light, fresnel, rtol=0.02)
    np.testing.assert_allclose(2 * (light - dark), (1 - fresnel) * 0.5, rtol=0.035)


def test_a_hand_turns_each_plate_frame_by_what_is_stated(monkeypatch) -> None:
    """The old axis is seen left of the new one by the turn to the right, below it by the turn upwards; no other move.

    Exact: a rotation about the camera's centre. Frames that are not turned are the plate itself.
    """
    turns = [(0.3, 0.0), (0.0, 0.0), (-0.15, 0.32)]
    scene = table_scene()
    bracket = scene.bracket.model_copy(update={"plate_turn_deg": turns, "plate_ev": [-2, 0, 2]})
    scene = scene.model_copy(update={"bracket": bracket})
    taken: list[np.ndarray] = []

    def photograph(self: Studio, measure: object, pose: np.ndarray, samples: int, seed: int) -> np.ndarray:
        taken.append(pose)
        return np.full((4, 4, 3), float(len(taken)))

    monkeypatch.setattr(Studio, "photograph", photograph)
    mi = use_mitsuba()
    studio = Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera))
    made = turned_plates(studio, lambda _: None)
    assert list(made) == ["plate_0", "plate_2"]
    plate = studio.pose(scene.plate)
    for pose, (right, up) in zip(taken, (turns[0], turns[2]), strict=True):
        np.testing.assert_allclose(pose[:3, 3], plate[:3, 3], rtol=0, atol=0)
        x, y, z = pose[:3, :3].T @ plate[:3, 2]
        assert np.degrees(np.arctan2(-x, z)) == pytest.approx(right, abs=1e-9)
        assert np.degrees(np.arctan2(y, z)) == pytest.approx(up, abs=1e-9)
    shot: dict[str, float] = {}
    monkeypatch.setattr(capture.Shoot, "take", lambda self, name, rgb, third: shot.update({name: float(rgb.mean())}))
    pictures = {"plate": np.full((4, 4, 3), 9.0)} | {view.name: np.ones((4, 4, 3)) for view in scene.ball_view} | made
    capture.take_brackets(capture.Shoot(scene, Path(), capture.sensor_of(scene)), pictures)
    assert [shot[f"plate/plate_ev{ev}.dng"] for ev in ("-2", "0", "+2")] == [1.0, 9.0, 2.0]


def test_a_hand_turns_frames_of_the_ball(monkeypatch) -> None:
    """A turned frame is another picture, with noise of its own; the others are the view as it stands."""
    turns = [(0.0, 0.0), (0.2, -0.1), (0.0, 0.0)]
    scene = table_scene()
    bracket = scene.bracket.model_copy(update={"ball_turn_deg": turns, "ball_frames": 3})
    scene = scene.model_copy(update={"bracket": bracket})
    seeds: list[int] = []

    def photograph(self: Studio, measure: object, pose: np.ndarray, samples: int, seed: int) -> np.ndarray:
        seeds.append(seed)
        x, _, z = pose[:3, :3].T @ self.pose(self.scene.plate)[:3, 2]  # where the old axis is seen
        return np.full((*self.shape, 4), np.round(np.arctan2(-x, z), 12))  # equal axes: rounding of their product

    monkeypatch.setattr(Studio, "photograph", photograph)
    monkeypatch.setattr(simulate, "spread_light", lambda light, *_: 0 * light)
    mi = use_mitsuba()
    made = simulate.ball_pictures(Studio(scene, mi, Place(mi, scene), capture.lens_of(scene.camera)), lambda _: None)
    name = scene.ball_view[0].name
    assert list(made)[:2] == [name, f"{name}_1"]
    assert np.degrees(made[f"{name}_1"].mean()) == pytest.approx(0.2, abs=1e-6)
    assert made[name].max() == 0
    assert len(set(seeds)) == len(made)
    shot: dict[str, float] = {}
    monkeypatch.setattr(capture.Shoot, "metered", lambda self, pictures, fill: 0)
    monkeypatch.setattr(capture.Shoot, "take", lambda self, name, rgb, third: shot.update({name: float(rgb.mean())}))
    capture.take_brackets(capture.Shoot(scene, Path(), capture.sensor_of(scene)), {"plate": np.ones((4, 4, 3)), **made})
    assert [shot[f"{name}/{name}_{number}.dng"] > 0 for number in (1, 2, 3)] == [False, True, False]
