"""Runs inside Blender's own Python (bpy): a scene described in files, rendered by Cycles with its shadow catcher.

    python cycles_worker.py JOB.json

Knows nothing of insitu. The job names the meshes (.npz), the map and the albedo (.exr) and the renders wanted; each is
written as a multi-layer EXR, and the CPU seconds of each go to ``times.json`` beside the job. Blender's world has +Z
up: its (x, y, z) are our (x, -z, y), its camera looks along -Z, and its map starts a quarter turn later than ours.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np

BLENDER_FROM_WORLD = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)


def material(name: str, kind: str, color: list[float], alpha: float, ior: float, texture: Path | None) -> Any:
    """A Cycles material of one node; ``alpha`` is the width of the GGX lobe."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.clear()
    out = nodes.new("ShaderNodeOutputMaterial")
    if kind == "diffuse":
        shader = nodes.new("ShaderNodeBsdfDiffuse")
        shader.inputs["Roughness"].default_value = 0.0
    elif kind in ("glossy", "mirror"):
        shader = nodes.new("ShaderNodeBsdfAnisotropic")
        shader.distribution = "GGX"
        shader.inputs["Roughness"].default_value = alpha**0.5  # Cycles squares it
    else:
        shader = nodes.new("ShaderNodeBsdfGlass")
        shader.inputs["Roughness"].default_value = 0.0
        shader.inputs["IOR"].default_value = ior
    shader.inputs["Color"].default_value = (*color, 1.0)
    if texture is not None:
        picture = nodes.new("ShaderNodeTexImage")
        picture.image = load_image(texture)
        picture.interpolation, picture.extension = "Linear", "EXTEND"
        links.new(picture.outputs["Color"], shader.inputs["Color"])
    links.new(shader.outputs["BSDF"], out.inputs["Surface"])
    return made


def load_image(path: Path) -> Any:
    """A picture whose numbers are taken as they are."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    return image


def mesh_object(name: str, arrays: dict[str, Any], made: Any) -> Any:
    """A mesh in Blender's frame, linked into the scene."""
    vertices = arrays["vertices"] @ BLENDER_FROM_WORLD.T
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], arrays["faces"].tolist())
    if "uv" in arrays:
        layer = mesh.uv_layers.new(name="uv")
        corners = arrays["uv"][arrays["faces"].ravel()]
        layer.data.foreach_set("uv", np.ascontiguousarray(corners, np.float32).ravel())
    if "normals" in arrays:
        mesh.shade_smooth()
        mesh.normals_split_custom_set_from_vertices((arrays["normals"] @ BLENDER_FROM_WORLD.T).tolist())
    mesh.materials.append(made)
    made_object = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made_object)
    return made_object


def build(job: dict[str, Any], folder: Path) -> Any:
    """The scene of a job: meshes, map, camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for part in job["meshes"]:
        arrays = dict(np.load(folder / part["file"]))
        texture = folder / part["texture"] if part["texture"] else None
        made = material(part["name"], part["kind"], part["color"], part["alpha"], part["ior"], texture)
        mesh_object(part["name"], arrays, made).is_shadow_catcher = part["catcher"]
    world = bpy.data.worlds.new("distant")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    environment = nodes.new("ShaderNodeTexEnvironment")
    environment.image = load_image(folder / job["environment"])
    environment.interpolation = "Linear"
    background, out = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    links.new(environment.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], out.inputs["Surface"])
    world.cycles.sampling_method = "AUTOMATIC"

    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = job["focal_px"] * 36.0 / job["width"]
    lens.clip_start, lens.clip_end = 0.01, 1000.0
    camera = bpy.data.objects.new("camera", lens)
    matrix = np.eye(4)
    pose = np.array(job["world_from_camera"])
    matrix[:3, :3] = BLENDER_FROM_WORLD @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = BLENDER_FROM_WORLD @ pose[:3, 3]
    camera.matrix_world = matrix.T.tolist()  # Blender reads columns
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def configure(scene: Any, job: dict[str, Any], want: dict[str, Any]) -> None:
    """Settings of one render: no clamp, box filter, no adaptive sampling, so that its mean is the truth."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = job["width"], job["height"], 100
    render.film_transparent = True
    render.use_persistent_data = True
    render.threads_mode, render.threads = "FIXED", job["threads"]
    cycles.device = "CPU"
    cycles.samples, cycles.seed = want["samples"], want["seed"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = want["denoise"]
    if want["denoise"]:
        cycles.denoiser, cycles.denoising_use_gpu = "OPENIMAGEDENOISE", False
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = True
    cycles.blur_glossy = 0.0
    depth = job["bounces"]
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = depth
    cycles.transparent_max_bounces = depth
    scene.view_layers[0].cycles.use_pass_shadow_catcher = True
    settings = render.image_settings
    settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth, settings.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
    settings.use_exr_interleave = True  # one part, not one part per pass


def main(path: str) -> None:
    """Every render of the job."""
    folder = Path(path).parent
    job = json.loads(Path(path).read_text())
    started = time.process_time()
    scene = build(job, folder)
    times = {"build_cpu_s": time.process_time() - started, "blender": bpy.app.version_string, "renders": []}
    for want in job["renders"]:
        configure(scene, job, want)
        scene.render.filepath = str(folder / want["file"])
        start, wall = time.process_time(), time.perf_counter()
        bpy.ops.render.render(write_still=True)
        times["renders"].append({"cpu_s": time.process_time() - start, "wall_s": time.perf_counter() - wall})
    (folder / "times.json").write_text(json.dumps(times))


main(sys.argv[1])
