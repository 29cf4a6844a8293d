"""Synthetic objects: meshes with smooth normals, written as .glb. Frame: metres, +Y up, origin at the foot's centre."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.simulation.scene_file import BoxModel, Lathe, ObjectModel, Sphere, Torus

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]  # vertices (N, 3), unit normals (N, 3), faces (M, 3)


def revolve(radius: np.ndarray, height: np.ndarray, normal: np.ndarray, segments: int) -> Mesh:
    """Turn a profile that runs upwards on the outside; ``normal`` (N, 2) is (radial, up)."""
    angle = 2 * np.pi * np.arange(segments + 1) / segments
    around = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    vertices = radius[:, None, None] * around + height[:, None, None] * np.array([0, 1, 0])
    normals = normal[:, None, :1] * around + normal[:, None, 1:] * np.array([0, 1, 0])
    return vertices.reshape(-1, 3), normals.reshape(-1, 3), grid_faces(len(radius), segments + 1)


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """(M, 3) triangles of a grid of vertices, counter-clockwise when rows go up and columns to the right."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    right, up, diagonal = corner + 1, corner + columns, corner + columns + 1
    return np.concatenate([np.stack([corner, right, diagonal], -1), np.stack([corner, diagonal, up], -1)])


def lathe(profile: list[tuple[float, float]], segments: int) -> Mesh:
    """Smooth profile through the given (radius, height), from the foot to where it closes; the foot is a flat disc."""
    from scipy.interpolate import PchipInterpolator

    points = np.asarray(profile, float)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    curve = PchipInterpolator(length, points)
    samples = np.linspace(0, length[-1], 4 * segments // 3)
    position, tangent = curve(samples), curve.derivative()(samples)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    body = revolve(position[:, 0], position[:, 1], np.stack([tangent[:, 1], -tangent[:, 0]], -1), segments)
    foot_radius = np.array([0.0, points[0, 0]])
    foot = revolve(foot_radius, np.full(2, points[0, 1]), np.array([[0.0, -1.0]] * 2), segments)
    faces = np.concatenate([body[2], foot[2] + len(body[0])])
    return np.concatenate([body[0], foot[0]]), np.concatenate([body[1], foot[1]]), faces


def sphere(radius: float, segments: int) -> Mesh:
    """A sphere that touches y = 0."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    return revolve(radius * normal[:, 0], radius * (1 + normal[:, 1]), normal, segments)


def torus(major: float, minor: float, standing: bool, segments: int) -> Mesh:
    """A ring about the y axis, or about the z axis when it stands; it touches y = 0."""
    angle = np.linspace(-np.pi, np.pi, segments // 2 + 1)
    normal = np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices, normals, faces = revolve(major + minor * normal[:, 0], minor * normal[:, 1], normal, segments)
    if standing:
        turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        vertices, normals = vertices @ turn.T, normals @ turn.T
    foot = np.array([0, major + minor if standing else minor, 0])
    return vertices + foot, normals, faces


def build(model: ObjectModel) -> Mesh:
    """The mesh of an object, without its degenerate faces."""
    shape = model.shape
    if isinstance(shape, Lathe):
        vertices, normals, faces = lathe(shape.profile_m, model.segments)
    elif isinstance(shape, Sphere):
        vertices, normals, faces = sphere(shape.radius_m, model.segments)
    else:
        assert isinstance(shape, Torus)
        vertices, normals, faces = torus(shape.major_m, shape.minor_m, shape.standing, 2 * model.segments)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return vertices, normals, faces[area > 1e-12]


def placed(model: ObjectModel) -> Mesh:
    """An object where it stands: turned about +Y and moved, world frame."""
    vertices, normals, faces = build(model)
    cosine, sine = np.cos(np.radians(model.yaw_deg)), np.sin(np.radians(model.yaw_deg))
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    x, z = model.position_m
    return vertices @ turn.T + [x, 0, z], normals @ turn.T, faces


def stored_colour(model: ObjectModel) -> np.ndarray:
    """(3,) linear Rec.709 base colour as the .glb stores it, rounded to 1/255."""
    return np.round(np.asarray(model.base_color) * 255) / 255


def write_glb(path: Path, mesh: Mesh, model: ObjectModel) -> None:
    """Write the mesh with its metallic-roughness material."""
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual.material import PBRMaterial

    colour = [*[int(c) for c in np.round(stored_colour(model) * 255)], 255]
    material = PBRMaterial(
        name=model.name, baseColorFactor=colour, metallicFactor=model.metallic, roughnessFactor=model.roughness
    )
    vertices, normals, faces = mesh
    visual = trimesh.visual.TextureVisuals(material=material)
    solid = trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        export_glb(trimesh.Scene(dict[str, trimesh.parent.Geometry]({model.name: solid})), include_normals=True)
    )


def standing_box(model: BoxModel) -> tuple[Mesh, np.ndarray]:
    """Four sides and the top of a box in the world frame, and uv (N, 2) into `surfaces.box_texture`."""
    width, height, depth = model.size_m
    around, high = 2 * (width + depth), height + depth
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * np.array([width, depth]) / 2  # x, z: front, right, ...
    lengths = np.array([0, width, depth, width, depth]).cumsum()
    vertices, normals, uv = [], [], []
    for side in range(4):
        (x0, z0), (x1, z1) = corners[side], corners[(side + 1) % 4]
        vertices += [[x0, 0, z0], [x1, 0, z1], [x1, height, z1], [x0, height, z0]]
        normals += [[[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]][side]] * 4
        u0, u1, v1 = lengths[side] / around, lengths[side + 1] / around, height / high
        uv += [[u0, 0], [u1, 0], [u1, v1], [u0, v1]]
    vertices += [[x, height, z] for x, z in corners]
    normals += [[0, 1, 0]] * 4
    uv += [[0, height / high], [width / around, height / high], [width / around, 1], [0, 1]]
    faces = np.concatenate([4 * np.arange(5)[:, None] + np.array(part) for part in ((0, 1, 2), (0, 2, 3))])
    cosine, sine = np.cos(np.radians(model.yaw_deg)), np.sin(np.radians(model.yaw_deg))
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    placed = np.array(vertices, float) @ turn.T + [model.position_m[0], 0, model.position_m[1]]
    return (placed, np.array(normals, float) @ turn.T, faces), np.array(uv, float)
