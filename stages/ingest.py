"""Check capture.toml, scene.toml and every photograph; index them with their metadata.

Method: both manifests are validated and every RAW file is asked for its metadata; all problems are reported together,
one line each. Photographs are never copied: what later stages get is an index of paths, digests and metadata. This is
the one stage that looks outside the build, so it is asked at every run.

Frames of a view are sorted by exposure (label), then by name, so the order of the listing never matters; a file given
twice (same content) counts once. An exposure that EXIF lacks must be stated in [[exposure]]; it is never invented.
Proxies and mesh occluders become triangles in the world frame here; a mask occluder is named by path and digest.

Limits: Bayer RAW; a view has the plate's size unless it states a camera of its own.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from pipeline.camera.former_camera import add_former_cameras
from pipeline.camera.stated import read_pose
from pipeline.camera.view_checks import lens_strangers
from pipeline.image.brackets import check_zoom, read_brackets
from pipeline.image.colour import convert
from pipeline.image.frames import read_frame
from pipeline.image.raw import file_sha256
from pipeline.run.artifacts import BOARD_PHOTOS, BRACKETS, FACTS, OCCLUDERS, PROXIES, VIEW_PHOTOS, WISHES
from pipeline.run.camera_facts import CAMERA_SUFFIXES
from pipeline.run.errors import ArtifactError, CaptureError, ManifestError
from pipeline.run.formats import read_latlong, read_linear, read_mask
from pipeline.run.manifest import (
    CaptureFacts,
    SceneWishes,
    line_of,
    load_capture,
    load_toml,
    problems_of,
    resolve_files,
)
from pipeline.run.probe_facts import FisheyePairFacts, LatLongFacts
from pipeline.run.stage import Stage
from pipeline.transport.meshes import load_meshes, refuse_undecodable
from pipeline.transport.proxies import box, join
from pipeline.types import Bracket, Frame, Occluder, Proxy, Result
from stages import knobs

OBJECT_SUFFIXES = (".glb", ".obj", ".ply")
MASK_SUFFIXES = (".png", ".exr")
MAP_SUFFIXES = (".hdr", ".exr")
FAR_M = 100.0  # a local scene that reaches farther is in another unit
DEFAULT_SCENE = "scene.toml"


def compute(capture_folder: Path, scene_file: Path | None, params: knobs.Ingest) -> Result:
    """Validated facts and wishes, brackets by view name, board photographs.

    Raises ManifestError (text) or CaptureError (photographs) listing every problem found.
    """
    facts, manifest, root = load_capture(capture_folder)
    problems: list[str] = []
    flaws: list[str] = []
    warnings: list[str] = []
    scene = scene_file or next((f for f in [manifest.parent / DEFAULT_SCENE] if f.is_file()), None)
    if scene is None:
        warnings.append(f"{manifest.parent / DEFAULT_SCENE}: no such file: nothing is put in, the plate comes back")
    wishes = _wishes(scene, root, problems)
    board, board_frames = _board_photos(facts, root, manifest, problems, flaws)
    dumped = {**facts.model_dump(mode="json"), "capture_root": str(root), **_truth(facts, manifest, problems)}
    brackets = read_brackets(facts, root, manifest, problems, flaws, warnings)
    check_zoom(brackets, board_frames, flaws, warnings)
    problems.extend(add_former_cameras(dumped, manifest, [manifest.parent, root]))
    dumped["probe"] |= _probe_files(facts, root, manifest, problems, flaws)
    view_photos = _view_photos(facts, root, manifest, problems, flaws)
    dumped["pose"] = _poses(facts, root, manifest, problems)
    proxies = _proxies(facts, root, manifest, problems, warnings)
    occluders = _occluders(facts, root, manifest, _size(brackets), problems, warnings)
    _check_references(facts, manifest, brackets, problems)
    if problems:
        raise ManifestError(*problems, *flaws)
    if flaws:
        raise CaptureError("\n".join(flaws))
    numbers = {
        "frames": {name: len(bracket.frames) for name, bracket in brackets.items()},
        "board_photos": len(board),
        "view_photos": len(view_photos),
        "objects": len(wishes["object"]),
        "proxies": len(proxies),
        "occluders": len(occluders),
        "size_px": _size(brackets),
        "camera": brackets["plate"].frames[0].camera,
    }
    outputs = {
        "facts": dumped, "wishes": wishes, "brackets": brackets, "board_photos": board,
        "view_photos": view_photos, "proxies": proxies, "occluders": occluders,
    }  # fmt: skip
    return Result(outputs, numbers, warnings)


def _wishes(scene: Path | None, root: Path, problems: list[str]) -> dict[str, Any]:
    """scene.toml less the stages' knobs, each object with its path and digest; all defaults without a scene."""
    data: dict[str, Any] = {} if scene is None else load_toml(scene)
    try:
        wishes = SceneWishes.model_validate({k: v for k, v in data.items() if k not in knobs.KNOBS})
    except ValidationError as error:
        problems.extend(problems_of(error, scene or Path(DEFAULT_SCENE), SceneWishes))
        return {"object": []}
    dumped = wishes.model_dump(mode="json")
    for number, wish in enumerate(dumped["object"]):
        where = f"{scene}: object[{number}].file"
        found = _found(wish["file"], [scene.parent, root] if scene else [root], where, OBJECT_SUFFIXES, problems)
        if found is not None:
            try:
                refuse_undecodable(found)
            except ManifestError as error:
                problems.append(f"{where}: {error}")
            wish |= {"path": str(found), "sha256": file_sha256(found)}
    return dumped


def _board_photos(
    facts: CaptureFacts, root: Path, manifest: Path, problems: list[str], flaws: list[str]
) -> tuple[list[dict[str, str]], dict[str, list[Frame]]]:
    """Board photographs of every camera, and their frames by view: one lens and focal length each, as they say."""
    cameras = {"plate": ("camera", facts.camera)}
    cameras |= {b.name: (f"ball[{i}].camera", b.camera) for i, b in enumerate(facts.ball) if b.camera is not None}
    photos: list[dict[str, str]] = []
    taken: dict[str, list[Frame]] = {}
    for view, (key, camera) in cameras.items():
        frames = _single_frames(camera.calibration, root, f"{manifest}: {key}.calibration", problems, flaws)
        flaws.extend(lens_strangers(frames, "board photographs"))
        taken[view] = frames
        photos += [{"file": frame.file, "sha256": frame.sha256, "view": view} for frame in frames]
    return photos, taken


def _view_photos(facts: CaptureFacts, root: Path, manifest: Path, problems: list[str], flaws: list[str]) -> list[Frame]:
    """The further photographs; exposure does not matter for them."""
    if facts.views is None:
        return []
    frames = _single_frames(facts.views.files, root, f"{manifest}: views.files", problems, flaws)
    flaws.extend(lens_strangers(frames, "further views"))
    return frames


def _single_frames(patterns: list[str], root: Path, where: str, problems: list[str], flaws: list[str]) -> list[Frame]:
    """Photographs that are no brackets, those that can be used; what is wrong with the others is said."""
    files, found = resolve_files(patterns, root, where)
    problems.extend(found)
    frames = []
    for file in files:
        try:
            frames.append(read_frame(file, file.relative_to(root).as_posix()))
        except CaptureError as error:
            flaws.append(str(error))
    return frames


def _poses(facts: CaptureFacts, root: Path, manifest: Path, problems: list[str]) -> list[dict[str, Any]]:
    """The [[pose]] tables, those that name a file with its camera as world_from_camera."""
    tables = []
    for number, table in enumerate(facts.pose):
        tables.append(table.model_dump(mode="json"))
        where = f"{manifest}: pose[{number}].file"
        path = table.file and _found(table.file, [manifest.parent, root], where, CAMERA_SUFFIXES, problems)
        if path:
            try:
                pose = read_pose(path, table.frame, table.rotation_order, table.unit_m, table.prim)
                tables[-1]["world_from_camera"] = pose.tolist()
            except ManifestError as error:
                problems.append(f"{where}: {error}")
    return tables


def _probe_files(
    facts: CaptureFacts, root: Path, manifest: Path, problems: list[str], flaws: list[str]
) -> dict[str, Any]:
    """Paths and digests of the pictures that some kinds of probe are, once they could be read; empty for the others."""

    def found(name: str, where: str, read: Callable[[Path], Any]) -> dict[str, str]:
        path = _found(name, [manifest.parent, root], f"{manifest}: {where}", MAP_SUFFIXES, problems)
        if path is None:
            return {}
        try:
            read(path)
        except ArtifactError as error:
            flaws.append(str(error))
        return {"path": str(path), "sha256": file_sha256(path)}

    if isinstance(facts.probe, LatLongFacts):
        return found(facts.probe.file, "probe.file", read_latlong)
    if isinstance(facts.probe, FisheyePairFacts):
        lenses = []
        for number, lens in enumerate(facts.probe.fisheye):
            where = f"probe.fisheye[{number}].file"
            lenses.append(lens.model_dump(mode="json") | (found(lens.file, where, read_linear) if lens.file else {}))
        return {"fisheye": lenses}
    return {}


def _proxies(facts: CaptureFacts, root: Path, manifest: Path, problems: list[str], warnings: list[str]) -> list[Proxy]:
    """Boxes and mesh files as triangles in the world frame, albedo in ACEScg."""
    proxies = []
    for number, table in enumerate(facts.proxy):
        if table.file:
            where = f"{manifest}: proxy[{number}].file"
            path = _found(table.file, [manifest.parent, root], where, OBJECT_SUFFIXES, problems)
            triangles = _triangles(path, where, problems, warnings) if path else None
        elif table.centre_m and table.size_m:
            triangles = box(table.centre_m, table.size_m, table.yaw_deg)
        if triangles is not None:
            albedo = None if table.albedo is None else convert(np.array(table.albedo), table.albedo_space, "acescg")
            proxies.append(Proxy(name=table.name, vertices_m=triangles[0], faces=triangles[1], albedo=albedo))
    return proxies


def _occluders(
    facts: CaptureFacts, root: Path, manifest: Path, size_px: list[int], problems: list[str], warnings: list[str]
) -> list[Occluder]:
    """Meshes as triangles in the world frame; masks as the path and digest of a picture of the plate's size."""
    occluders = []
    for number, table in enumerate(facts.occluder):
        where = f"{manifest}: occluder[{number}].file"
        path = _found(table.file, [manifest.parent, root], where, OBJECT_SUFFIXES + MASK_SUFFIXES, problems)
        if path is None:
            continue
        if path.suffix.lower() in OBJECT_SUFFIXES:
            if triangles := _triangles(path, where, problems, warnings):
                occluders.append(Occluder(name=table.name, vertices_m=triangles[0], faces=triangles[1]))
            continue
        try:
            height, width = read_mask(path).shape
        except ArtifactError as error:
            problems.append(f"{where}: {error}")
            continue
        if size_px and [width, height] != size_px:
            problems.append(f"{where}: is {width} x {height}; expected the plate's {size_px[0]} x {size_px[1]}")
        else:
            occluders.append(Occluder(name=table.name, mask_file=str(path), mask_sha256=file_sha256(path)))
    return occluders


def _check_references(facts: CaptureFacts, manifest: Path, brackets: dict[str, Bracket], problems: list[str]) -> None:
    """Every reference lies within the photographs that show it."""
    text = manifest.read_text().splitlines()
    for number, table in enumerate(facts.reference):
        for place, seen in enumerate(table.seen):
            frame = next(iter(brackets[seen.view].frames), None) if seen.view in brackets else None
            xs, ys = zip(*seen.corners_px)
            inside = frame and min(xs) >= 0 and min(ys) >= 0 and max(xs) <= frame.width and max(ys) <= frame.height
            if frame and not inside:
                line = line_of(text, ["reference", str(number), "seen", str(place), "corners_px"])
                problems.append(
                    f"{manifest}:{line}: reference[{number}].seen[{place}].corners_px: reach x {min(xs):g} to "
                    f"{max(xs):g}, y {min(ys):g} to {max(ys):g}; expected within {seen.view}'s {frame.width} x "
                    f"{frame.height}"
                )


def _found(name: str, folders: list[Path], where: str, suffixes: tuple[str, ...], problems: list[str]) -> Path | None:
    """The file in the first folder that has it, resolved; None and a problem when its kind or place is wrong."""
    file = Path(os.path.expandvars(name))
    path = next((folder / file for folder in folders if (folder / file).is_file()), None)
    if file.suffix.lower() not in suffixes:
        problems.append(f"{where}: is {name!r}; expected a {', '.join(suffixes[:-1])} or {suffixes[-1]} file")
    elif path is None:
        problems.append(f"{where}: is {name!r}; no such file in {' or '.join(map(str, dict.fromkeys(folders)))}")
    elif not os.access(path, os.R_OK):
        problems.append(f"{where}: is {name!r}, which cannot be read; give it permission ({path})")
    else:
        return path.resolve()
    return None


def _triangles(
    path: Path, where: str, problems: list[str], warnings: list[str]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices and faces of a mesh file in the world frame; None and a problem when it cannot be read."""
    try:
        meshes, said = load_meshes(path)
    except ManifestError as error:
        problems.append(f"{where}: {error}")
        return None
    vertices, faces = join(meshes)
    warnings.extend(text for text in said if "not modelled" not in text)  # only the shape of its materials is used
    farthest = float(np.abs(vertices).max())
    if farthest > FAR_M:
        warnings.append(f"{path.name}: reaches {farthest:.0f} m from the origin: is the file in metres, world frame?")
    return vertices, faces


def _size(brackets: dict[str, Bracket]) -> list[int]:
    """Width and height of the plate [px]; empty when none of its frames could be read."""
    return [size for frame in brackets["plate"].frames[:1] for size in (frame.width, frame.height)]


def _truth(facts: CaptureFacts, manifest: Path, problems: list[str]) -> dict[str, str]:
    """Where a simulated capture's truth lies, for evaluate alone."""
    if facts.truth is None:
        return {}
    path = (manifest.parent / os.path.expandvars(facts.truth)).resolve()
    if not path.is_file():
        problems.append(f"{manifest}: truth: is {facts.truth!r}; no such file ({path})")
        return {}
    root = path.parent / os.path.expandvars(json.loads(path.read_bytes()).get("root", "."))
    files = [path, *sorted(file for file in root.glob("*") if file.is_file())]
    together = hashlib.sha256("".join(file_sha256(file) for file in files).encode()).hexdigest()
    return {"truth_path": str(path), "truth_sha256": together}


STAGE = Stage(
    "ingest",
    compute,
    knobs.Ingest,
    inputs={},
    outputs={
        "facts": FACTS, "wishes": WISHES, "brackets": BRACKETS, "board_photos": BOARD_PHOTOS,
        "view_photos": VIEW_PHOTOS, "proxies": PROXIES, "occluders": OCCLUDERS,
    },
    impure=True,
)  # fmt: skip
