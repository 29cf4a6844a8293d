"""The truth of a capture: what a noise-free camera would have seen, and what really stood there.

Read from a ``truth.json`` (only `stages/evaluate.py` opens it, after everything is done):

    space       "acescg" or "linear_rec709", of every picture named here
    root        folder of the files; default: that of truth.json; environment variables expand
    plate       EXR; with_objects: EXR
    coverage    EXR with one float channel per object, or PNG whose R, G, B are ``coverage_names``
    albedo      EXR, optional: R G B and ``seen``, of the plane as the plate camera sees it, or PNG ``albedo_seen``
    environment {"file", "world_from_map"}: lat-long, formula of conventions; 3x3 rotation of its directions to world
    elsewhere   [{"file", "at_m"}], optional: such maps of other places [m, world], under light that is not distant
    camera      {width height fx fy cx cy distortion}, first pixel centre (0.5, 0.5)
    views       {name: {"world_from_camera": 4x4}}
    objects     what ``with_objects`` shows, optional: [{name sha256 position_m yaw_deg lift_m scale}], as scene.toml
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.colour import (
    ACESCG_CHROMATICITIES,
    Space,
    adaptation,
    apply_matrix,
    convert,
    matrix,
    xyz_from_rgb,
    xyz_of_xy,
)
from pipeline.run import formats
from pipeline.run.errors import ArtifactError, ManifestError

PLACED = {"position_m": (0.0, 0.0), "yaw_deg": 0.0, "lift_m": 0.0, "scale": 1.0}  # where an object stands; defaults
SAME_PLACE = 1e-6  # a micrometre: what digits of a text may leave out, far below a pixel


@dataclass(frozen=True, eq=False)
class Truth:
    """Pictures are ACEScg float32, in the truth's own unit; absent things are None or empty."""

    plate: np.ndarray  # (H, W, 3)
    with_objects: np.ndarray  # (H, W, 3)
    coverage: dict[str, np.ndarray]  # (H, W) in [0, 1] of each object
    albedo: np.ndarray | None = None  # (H, W, 4): RGB and seen
    environment: np.ndarray | None = None  # (h, w, 3)
    world_from_map: np.ndarray = field(default_factory=lambda: np.eye(3))
    elsewhere: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)  # places (3,), world, and maps there
    camera: dict[str, Any] = field(default_factory=dict)
    views: dict[str, np.ndarray] = field(default_factory=dict)  # (4, 4) world_from_camera
    objects: list[dict[str, Any]] | None = None  # what with_objects shows; None: nobody says


def load_truth(path: Path) -> Truth:
    """Read a truth.json and its pictures. Raises ManifestError naming the wrong key, ArtifactError for files."""
    try:
        facts = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ManifestError(f"{path}: not a readable truth.json ({error}); fix capture.toml's truth") from error
    missing = [key for key in ("plate", "with_objects", "coverage") if key not in facts]
    space: Space = facts.get("space", "acescg")
    if missing or space not in ("acescg", "linear_rec709"):
        raise ManifestError(f"{path}: missing keys {missing}, space {space!r}; see pipeline/image/truth.py")
    folder = path.parent / os.path.expandvars(facts.get("root", "."))

    def picture(name: str) -> np.ndarray:
        return convert(formats.read_exr(folder / name).rgb(), space, "acescg")

    plate, with_objects = picture(facts["plate"]), picture(facts["with_objects"])
    coverage = _coverage(folder / facts["coverage"], facts.get("coverage_names"), path)
    for name, found in {"with_objects": with_objects, **coverage}.items():
        if found.shape[:2] != plate.shape[:2]:
            raise ManifestError(f"{path}: {name} is {found.shape[:2]}, the plate {plate.shape[:2]}; render both alike")
    light = facts.get("environment")
    return Truth(
        plate=plate,
        with_objects=with_objects,
        coverage=coverage,
        albedo=_albedo(folder, facts, space) if facts.get("albedo") else None,
        environment=picture(light["file"]) if light else None,
        world_from_map=np.asarray(light.get("world_from_map", np.eye(3)) if light else np.eye(3), float),
        elsewhere=[(np.asarray(one["at_m"], float), picture(one["file"])) for one in facts.get("elsewhere", [])],
        camera=facts.get("camera", {}),
        views={n: np.asarray(v["world_from_camera"], float) for n, v in facts.get("views", {}).items()},
        objects=facts.get("objects"),
    )


def other_scene(shown: list[dict[str, Any]] | None, wished: list[dict[str, Any]]) -> list[str]:
    """What is wished otherwise than the truth's picture shows it, one phrase each; none where nobody says.

    Order and names do not matter: objects are alike by file and placement, lengths to `SAME_PLACE`, in metres, degrees.
    """
    if shown is None:
        return []
    left = list(shown)
    strangers = []
    for wish in wished:
        alike = next((i for i, one in enumerate(left) if not _unlike(one, wish)), None)
        if alike is None:
            strangers.append(wish)
        else:
            left.pop(alike)
    said = []
    for wish in strangers:
        same = next((one for one in left if one["name"] == wish["name"]), None)
        if same is None:
            said.append(f"{wish['name']} is not in it")
        else:
            left.remove(same)
            said += [f"{wish['name']}: {text}" for text in _unlike(same, wish)]
    return said + [f"{one['name']} is in it alone" for one in left]


def _unlike(shown: dict[str, Any], wish: dict[str, Any]) -> list[str]:
    """Facts of one object that differ, as words."""
    found = []
    if shown.get("sha256") != wish.get("sha256"):
        found.append("another file")
    for key, default in PLACED.items():
        ours, theirs = wish.get(key, default), shown.get(key, default)
        apart = np.abs(np.subtract(ours, theirs, dtype=float))
        if np.any((np.minimum(apart % 360, -apart % 360) if key == "yaw_deg" else apart) > SAME_PLACE):
            found.append(f"{key} is {_digits(ours)}, there {_digits(theirs)}")
    if shown.get("material") != wish.get("material"):
        found.append("another material")
    return found


def _digits(value: Any) -> str:
    return ", ".join(f"{number:g}" for number in np.ravel(value))


def _coverage(file: Path, names: list[str] | None, path: Path) -> dict[str, np.ndarray]:
    if file.suffix == ".exr":
        return formats.read_exr(file).channels
    mask = formats.read_png(file)
    if not names or mask.ndim != 3 or len(names) > mask.shape[2]:
        raise ManifestError(f"{path}: coverage_names is {names} for {file.name} {mask.shape}; name its R, G, B")
    mask = (mask / np.iinfo(mask.dtype).max).astype(np.float32)
    return {name: mask[..., i] for i, name in enumerate(names)}


def _albedo(folder: Path, facts: dict[str, Any], space: Space) -> np.ndarray:
    raster = formats.read_exr(folder / facts["albedo"])
    seen = raster.channels.get("seen", np.ones(raster.shape, np.float32))
    if "albedo_seen" in facts:
        mask = formats.read_png(folder / facts["albedo_seen"])
        seen = (mask / np.iinfo(mask.dtype).max).astype(np.float32).reshape(*raster.shape, -1)[..., 0]
    return np.concatenate([convert(raster.rgb(), space, "acescg"), seen[..., None]], -1)


def read_acescg(path: Path) -> np.ndarray:
    """(H, W, 3) ACEScg of any EXR with R G B, or of its first layer that has them.

    Primaries come from the file's chromaticities (Bradford to the white of ACES), else they are taken as ACEScg.
    """
    raster = formats.read_exr(path)
    layers = sorted(name[:-1].rstrip(".") for name in raster.channels if name == "R" or name.endswith(".R"))
    layers = [name for name in layers if all((f"{name}." if name else "") + c in raster.channels for c in "RGB")]
    if not layers:
        raise ArtifactError(f"{path}: channels {sorted(raster.channels)}, needed R G B; export a colour picture")
    rgb = raster.rgb(layers[0])
    if raster.space == "linear_rec709":
        return convert(rgb, "linear_rec709", "acescg")
    chromaticities = raster.attributes.get("chromaticities")
    if chromaticities is None:
        return rgb
    primaries = np.asarray(chromaticities, float).reshape(4, 2)
    to_aces = adaptation(xyz_of_xy(primaries[3]), xyz_of_xy(ACESCG_CHROMATICITIES[3]))
    return apply_matrix(matrix("xyz", "acescg") @ to_aces @ xyz_from_rgb(primaries), rgb)
