"""The simulated place as a Mitsuba scene: distant room, table with the print let into it, photographer, ball, objects.

Everything is given to Mitsuba as ACEScg arrays (raw textures); its rgb variants only multiply and add channels.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.simulation import leaving, light, shapes, surfaces
from pipeline.simulation.scene_file import RoomModel, SimulatedScene
from pipeline.simulation.sensor import acescg_from_rec709

PEOPLE_ALBEDO = (0.07, 0.06, 0.06)
BODY_ALBEDO = (0.03, 0.03, 0.03)


def texture(mi: Any, pixels: np.ndarray) -> dict[str, Any]:
    """A linear, unconverted Mitsuba texture of (H, W, 3); its first row is at v = 0."""
    return {"type": "bitmap", "data": mi.TensorXf(pixels), "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}


def colour(value: Any) -> dict[str, Any]:
    """A constant (3,) spectrum, unconverted."""
    return {"type": "rgb", "value": [float(v) for v in value]}


def mesh(mi: Any, name: str, parts: shapes.Mesh, bsdf: Any, uv: np.ndarray | None = None, smooth: bool = True) -> Any:
    """A Mitsuba mesh of vertices, normals and faces, in the world frame."""
    vertices, normals, faces = parts
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    made = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    if smooth:
        parameters["vertex_normals"] = np.ravel(normals).astype(np.float32)
    if uv is not None:
        parameters["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    parameters.update()
    return made


def rectangles(spans: list[tuple[float, float, float, float]], whole: tuple[float, float, float, float]) -> Any:
    """Mesh and uv of rectangles (x0, z0, x1, z1) at y = 0, facing up; uv (0, 0) is x0, z0 of ``whole``."""
    corners = np.array([[[x0, z0], [x0, z1], [x1, z1], [x1, z0]] for x0, z0, x1, z1 in spans]).reshape(-1, 2)
    vertices = np.stack([corners[:, 0], 0 * corners[:, 0], corners[:, 1]], -1)
    first = 4 * np.arange(len(spans))[:, None]
    faces = np.concatenate([first + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))])
    uv = (corners - whole[:2]) / (np.array(whole[2:]) - whole[:2])
    return (vertices, np.tile([0.0, 1.0, 0.0], (len(vertices), 1)), faces), uv


Rectangle = tuple[float, float, float, float]  # x0, z0, x1, z1


def around(whole: Rectangle, holes: list[Rectangle]) -> list[Rectangle]:
    """Rectangles that fill ``whole`` but for the holes in it, without overlap: strips along x between all edges."""
    edges = sorted({whole[1], whole[3], *(z for hole in holes for z in (hole[1], hole[3]))})
    filled = []
    for low, high in itertools.pairwise(edges):
        x = whole[0]
        for hole in sorted(hole for hole in holes if hole[1] < high and hole[3] > low):
            filled.append((x, low, hole[0], high))
            x = hole[2]
        filled.append((x, low, whole[2], high))
    return filled


@dataclass
class Place:
    """Builds the scenes of one simulation; textures are made once."""

    mi: Any
    scene: SimulatedScene
    _surfaces: dict[bool, dict[str, Any]] = field(default_factory=dict)
    _materials: dict[str, Any] = field(default_factory=dict)
    _boxes: dict[str, Any] = field(default_factory=dict)

    @property
    def ball_centre(self) -> np.ndarray:
        """(3,) world, metres."""
        x, z = self.scene.ball.position_m
        return np.array([x, self.scene.ball.diameter_m / 2, z])

    def prints(self) -> dict[str, tuple[float, float, float, float]]:
        """(x0, z0, x1, z1) of every printed sheet, its margin included."""
        scene = self.scene
        sheets = {}
        if scene.board is not None:
            margin, square = scene.board.margin_m, scene.board.square_m
            x, z = (count * square + margin for count in scene.board.squares)
            sheets["board"] = (-margin, -margin, x, z)
        for number, marker in enumerate(scene.marker):
            (x, z), half = marker.position_m, marker.side_m / 2 + marker.margin_m
            sheets[f"marker_{number}"] = (x - half, z - half, x + half, z + half)
        return sheets

    def print_pixels(self, name: str) -> np.ndarray:
        """(H, W, 3) albedo of a printed sheet."""
        scene = self.scene
        if name == "board" and scene.board is not None:
            return surfaces.board_texture(scene.board, scene.board_print)
        return surfaces.marker_texture(scene.marker[int(name.removeprefix("marker_"))], scene.board_print)

    def pixels(self, name: str) -> dict[str, Any]:
        """The texture of the table or of a printed sheet."""
        if name == "table":
            return texture(self.mi, surfaces.table_texture(self.scene.table, self.scene.seed))
        return texture(self.mi, self.print_pixels(name))

    def table_and_prints(self, prints: bool = True) -> dict[str, Any]:
        """The table top and, let into it, the printed sheets: one plane, no gap, no overlap."""
        if prints in self._surfaces:
            return self._surfaces[prints]
        mi, table = self.mi, self.scene.table
        whole = (table.x_m[0], table.z_m[0], table.x_m[1], table.z_m[1])
        sheets = self.prints() if prints else {}
        if not self._materials:
            for name in ["table", *self.prints()]:
                material: dict[str, Any] = {"type": "diffuse", "reflectance": self.pixels(name)}
                if name == "table" and table.roughness is not None:
                    gloss = {"metallic": 0.0, "roughness": table.roughness}
                    material = {"type": "insitu_gltf", "base_color": material["reflectance"], **gloss}
                if name == "table" and self.scene.leave.table_coat is not None:
                    coat = {"distribution": "ggx", "alpha": self.scene.leave.table_coat, "int_ior": 1.5, "ext_ior": 1.0}
                    material = {"type": "roughplastic", "diffuse_reflectance": material["reflectance"], **coat}
                self._materials[name] = mi.load_dict(material)
        made = {}
        curl = self.scene.leave.curl_radius_m
        parts = {"table": (around(whole, [] if curl else list(sheets.values())), whole)}
        parts |= {name: ([sheet], sheet) for name, sheet in sheets.items()}
        for name, (spans, extent) in parts.items():
            bent = curl is not None and name != "table"
            shape, uv = leaving.curled_sheet(extent, curl) if bent and curl else rectangles(spans, extent)
            made[name] = mesh(mi, name, shape, self._materials[name], uv, smooth=bent)
        self._surfaces[prints] = made
        return made

    def boxes(self) -> dict[str, Any]:
        """The real boxes; made once."""
        if not self._boxes:
            for number, model in enumerate(self.scene.box):
                pixels = surfaces.box_texture(model, self.scene.table.texel_m, self.scene.seed + 100 + number)
                bsdf = self.mi.load_dict({"type": "diffuse", "reflectance": texture(self.mi, pixels)})
                parts, uv = shapes.standing_box(model)
                self._boxes[f"box_{model.name}"] = mesh(self.mi, model.name, parts, bsdf, uv, smooth=False)
        return self._boxes

    def room(self) -> dict[str, Any]:
        """The distant light, or a closed room's walls; and what glows nearby."""
        facts = self.scene.light
        made: dict[str, Any] = {}
        if self.scene.room is None:
            made["room"] = {"type": "envmap", "bitmap": self.mi.Bitmap(light.mitsuba_envmap(facts))}
        else:
            made |= self.walls(self.scene.room)
        for number, lamp in enumerate(self.scene.near_lamp):
            emitter = {"type": "area", "radiance": colour(np.asarray(lamp.radiance) * facts.scale)}
            sphere = {"type": "sphere", "center": list(lamp.position_m), "radius": lamp.diameter_m / 2}
            made[f"near_lamp_{number}"] = {**sphere, "emitter": emitter}
        return made

    def walls(self, room: RoomModel) -> dict[str, Any]:
        """Six matt faces that look inwards."""
        transform, half = self.mi.ScalarTransform4f, np.asarray(room.size_m) / 2
        made = {}
        for axis in range(3):
            for sign in (-1, 1):
                normal = -sign * np.eye(3)[axis]
                middle = np.asarray(room.centre_m) + sign * half * np.eye(3)[axis]
                right, up = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
                frame = np.eye(4)
                frame[:3, 0], frame[:3, 1] = half[(axis + 1) % 3] * right, half[(axis + 2) % 3] * up * -sign
                frame[:3, 2], frame[:3, 3] = normal, middle
                albedo = room.wall if axis != 1 else room.ceiling if sign > 0 else room.floor
                made[f"wall_{'xyz'[axis]}{'np'[sign > 0]}"] = {
                    "type": "rectangle", "to_world": transform(frame),
                    "bsdf": {"type": "diffuse", "reflectance": colour(albedo)},
                }  # fmt: skip
        return made

    def photographer(self, world_from_camera: np.ndarray) -> dict[str, Any]:
        """Camera, tripod column and a person behind it, none of it in front of the lens."""
        mi = self.mi
        position, forward = world_from_camera[:3, 3], world_from_camera[:3, 2]
        back = -np.array([forward[0], 0, forward[2]]) / np.hypot(forward[0], forward[2])
        dark = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour(BODY_ALBEDO)}}
        cloth = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour(PEOPLE_ALBEDO)}}
        to_world = world_from_camera.copy()
        to_world[:3, 3] = position - 0.055 * forward
        person = position + 0.38 * back

        def rod(start: np.ndarray, end: np.ndarray, radius: float, bsdf: dict[str, Any]) -> dict[str, Any]:
            return {"type": "cylinder", "p0": start.tolist(), "p1": end.tolist(), "radius": radius, "bsdf": bsdf}

        column = position + 0.06 * back
        top, hip = np.array([person[0], 0.36 + position[1], person[2]]), np.array([person[0], -0.75, person[2]])
        return {
            "camera_body": {
                "type": "cube", "bsdf": dark,
                "to_world": mi.ScalarTransform4f(to_world @ np.diag([0.065, 0.045, 0.05, 1.0])),
            },
            "column": rod(column - [0, 0.05, 0], np.array([column[0], -0.75, column[2]]), 0.02, dark),
            "torso": rod(hip, top - [0, 0.12, 0], 0.17, cloth),
            "shoulders": {"type": "sphere", "center": (top - [0, 0.12, 0]).tolist(), "radius": 0.17, "bsdf": cloth},
            "head": {"type": "sphere", "center": (top - [0, -0.16, 0]).tolist(), "radius": 0.11, "bsdf": cloth},
        }  # fmt: skip

    def ball(self, black: bool = False) -> dict[str, Any]:
        """The mirror ball, perfectly smooth, its reflectance the same at all angles; or a black one in its place."""
        mirror = {"type": "conductor", "material": "none", "specular_reflectance": colour(self.scene.ball.reflectance)}
        if black:
            mirror = {"type": "diffuse", "reflectance": colour((0.0, 0.0, 0.0))}
        radius = self.scene.ball.diameter_m / 2
        if self.scene.leave.dent:
            vertices, normals, faces = leaving.dented_sphere(radius, self.scene.leave.dent)
            dented = (vertices + self.ball_centre, normals, faces)
            return {"ball": mesh(self.mi, "ball", dented, self.mi.load_dict(mirror))}
        return {"ball": {"type": "sphere", "center": self.ball_centre.tolist(), "radius": radius, "bsdf": mirror}}

    def objects(self) -> dict[str, Any]:
        """Every object as a Mitsuba mesh, where it stands."""
        made = {}
        for model in self.scene.object:
            base = acescg_from_rec709() @ shapes.stored_colour(model)
            bsdf = {
                "type": "insitu_gltf", "base_color": colour(base),
                "metallic": model.metallic, "roughness": model.roughness,
            }  # fmt: skip
            made[f"object_{model.name}"] = mesh(self.mi, model.name, shapes.placed(model), self.mi.load_dict(bsdf))
        return made

    def load(self, *parts: dict[str, Any], prints: bool = True) -> Any:
        """A Mitsuba scene of the table, the printed sheets on it, the boxes, the room and the given parts."""
        scene: dict[str, Any] = {"type": "scene", **self.table_and_prints(prints), **self.boxes()}
        scene |= self.room()
        for part in parts:
            scene.update(part)
        return self.mi.load_dict(scene)
