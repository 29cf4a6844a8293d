"""Figures of the report: a picture, lines drawn over it as SVG, a colour bar or legend, a caption; numbers as text.

Lines are vectors in the plate's pixels (first pixel's centre at 0.5), so they stay sharp at any size and show the lens:
every straight line of the world is cut into short pieces before it is projected.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import invert_rigid, transform_points
from pipeline.image import pictures
from pipeline.types import BallFit, Camera

PIECES = 24  # per projected line
UNITS = {"_deg": "°", "_px": " px", "_mm": " mm", "_m": " m", "_s": " s", "_ev": " EV", "_db": " dB", "_px2": " px²"}
SHARES = ("_fraction", "_rel", "_err", "_p90", "_diff", "_region")  # fractions that read better in per cent


@dataclass(frozen=True)
class Line:
    """A polyline in picture coordinates; ``style`` is a CSS class of the page."""

    points: str
    style: str


@dataclass(frozen=True)
class Label:
    """A word at a place in picture coordinates."""

    x: float
    y: float
    text: str
    style: str = "label"


@dataclass(frozen=True)
class Figure:
    """One picture of the page. ``size`` (w, h) is the coordinate frame of lines and labels."""

    uri: str
    size: tuple[float, float]
    title: str
    caption: str = ""
    lines: list[Line] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)
    bar: dict[str, str] | None = None  # {"kind", "low", "high"}
    legend: list[tuple[str, str]] = field(default_factory=list)  # (CSS colour, meaning)
    width: str = ""  # CSS class: "", "wide", "small"


def photo(picture: np.ndarray, title: str, caption: str = "", quality: int = 84, **more: Any) -> Figure:
    """A figure of a display picture (H, W, 3) uint8, as JPEG."""
    size = more.pop("size", (picture.shape[1], picture.shape[0]))
    return Figure(pictures.jpeg_uri(picture, quality), size, title, caption, **more)


def heat_figure(values: np.ndarray, high: float, title: str, caption: str = "", unit: str = "%", **more: Any) -> Figure:
    """A heat map with its bar; per cent when the unit says so."""
    factor, ending = (100, " %") if unit == "%" else (1, f" {unit}".rstrip())
    bar = {"kind": "heat", "low": "0", "high": f"≥ {short(high * factor)}{ending}"}
    return photo(pictures.heat(values, high), title, caption, 88, bar=bar, **more)


def signed_figure(values: np.ndarray, high: float, title: str, caption: str = "", **more: Any) -> Figure:
    """A signed map with its bar, in per cent."""
    bar = {"kind": "signed", "low": f"−{short(100 * high)} %", "high": f"+{short(100 * high)} %"}
    return photo(pictures.signed(values, high), title, caption, 88, bar=bar, **more)


def class_figure(
    values: np.ndarray, meanings: list[tuple[tuple[int, int, int], str]], title: str, caption: str = "", **more: Any
) -> Figure:
    """A map of classes with its legend; classes that do not occur are left out of the legend."""
    present = set(np.unique(values).tolist())
    legend = [(f"rgb{colour}", text) for i, (colour, text) in enumerate(meanings) if i in present]
    picture = pictures.classes(values, [colour for colour, _ in meanings])
    size = (picture.shape[1], picture.shape[0])
    return Figure(pictures.png_uri(picture), more.pop("size", size), title, caption, legend=legend, **more)


def polyline(px: np.ndarray, style: str, frame: tuple[float, float]) -> list[Line]:
    """Lines of pixels (N, 2), broken where they are NaN or far outside the ``frame`` (w, h)."""
    reach = 2 * max(frame)
    good = np.isfinite(px).all(-1) & (np.abs(np.where(np.isfinite(px), px, 0)) < reach).all(-1)
    parts = np.split(np.arange(len(px)), np.flatnonzero(np.diff(good.astype(int))) + 1)
    text = [" ".join(f"{x:.1f},{y:.1f}" for x, y in px[part]) for part in parts if good[part].all() and len(part) > 1]
    return [Line(points, style) for points in text]


def world_lines(
    camera: Camera, world_from_camera: np.ndarray, segments: list[tuple[np.ndarray, np.ndarray, str]]
) -> list[Line]:
    """World segments (start (3,), end (3,), style) as they appear through the lens."""
    steps = np.linspace(0, 1, PIECES)[:, None]
    found: list[Line] = []
    for start, end, style in segments:
        points = np.asarray(start, float) + steps * (np.asarray(end, float) - start)
        px = project(camera, transform_points(invert_rigid(world_from_camera), points))
        found += polyline(px, style, (camera.width, camera.height))
    return found


def world_pixel(camera: Camera, world_from_camera: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Pixel (2,) of a world point (3,); NaN when the lens does not show it."""
    return project(camera, transform_points(invert_rigid(world_from_camera), np.asarray(point, float)[None]))[0]


def ball_outline(camera: Camera, ball: BallFit, style: str = "ball") -> list[Line]:
    """The sphere's silhouette: the cone of its tangent rays, through the lens."""
    centre = ball.centre_camera_m
    distance = np.linalg.norm(centre)
    axis = centre / distance
    across = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, 97)[:, None]
    sine = ball.radius_m / distance
    ring = np.sqrt(1 - sine**2) * axis + sine * (np.cos(angle) * across + np.sin(angle) * np.cross(axis, across))
    return polyline(project(camera, ring * distance), style, (camera.width, camera.height))


def moved(lines: list[Line], dx: float, dy: float) -> list[Line]:
    """Lines shifted into the coordinates of a crop whose corner is at (dx, dy)."""
    found = []
    for line in lines:
        pairs = [pair.split(",") for pair in line.points.split()]
        found.append(Line(" ".join(f"{float(x) - dx:.1f},{float(y) - dy:.1f}" for x, y in pairs), line.style))
    return found


def grid_segments(
    corners: np.ndarray, columns: int, rows: int, style: str, edge: str
) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """Lines of a grid over the parallelogram of ``corners`` (4, 3), its border in another style."""
    origin, along, down = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    found = []
    for i in range(columns + 1):
        at = origin + along * i / columns
        found.append((at, at + down, edge if i in (0, columns) else style))
    for j in range(rows + 1):
        at = origin + down * j / rows
        found.append((at, at + along, edge if j in (0, rows) else style))
    return found


def short(value: float) -> str:
    """Three figures without trailing zeros; exponents only when they are needed."""
    if value == 0 or not np.isfinite(value):
        return "0" if value == 0 else ("not known" if np.isnan(value) else "∞" if value > 0 else "−∞")
    size = abs(value)
    if size >= 1e5 or size < 1e-4:
        mantissa, exponent = f"{value:.1e}".split("e")
        return f"{mantissa}·10{_raised(int(exponent))}".replace("-", "−")
    if size >= 100:
        return f"{value:.0f}".replace("-", "−")
    digits = max(0, 2 - int(np.floor(np.log10(size))))
    text = f"{value:.{digits}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "−")


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def reading(key: str, value: Any) -> str:
    """A measured value as text, its unit taken from the key's ending."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ") + next((u for e, u in UNITS.items() if key.endswith(e)), "")
    if isinstance(value, float):
        if key.endswith(SHARES) and np.isfinite(value):
            return "< 0.0001 %" if 0 < abs(value) < 1e-6 else f"{short(100 * value)} %"
        return short(value) + next((u for e, u in UNITS.items() if key.endswith(e)), "")
    if isinstance(value, (list, tuple)):
        shown = [reading(key, v) for v in value[:8]]
        return ", ".join(shown) + (" …" if len(value) > 8 else "")
    return str(value)


def readings(values: dict[str, Any], prefix: str = "", unit_key: str = "") -> list[tuple[str, str]]:
    """Nested numbers as flat rows (name, text); names lose unit endings, and inherit the unit of what they are in."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        name = f"{prefix} · {words(key)}" if prefix else words(key)
        known = key if key.endswith((*UNITS, *SHARES)) else unit_key or key
        if isinstance(value, dict):
            rows += readings(value, name, known)
        else:
            rows.append((name, reading(known, value)))
    return rows


def words(key: str) -> str:
    """A key as words, less its unit."""
    ending = next((e for e in (*UNITS, "_fraction", "_rel") if key.endswith(e) and len(key) > len(e)), "")
    return key.removesuffix(ending).replace("_", " ").strip() or key
