"""What each stage's section of the report shows: pictures, tables and cards, drawn from the build's artifacts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import CLIPPED, DARK, GHOST, HOT, latlong_from_direction
from pipeline.image import figures as fig
from pipeline.image import pictures, trust
from pipeline.image.colour import convert, encode_srgb, luminance
from pipeline.image.display import display_exposure, display_transform
from pipeline.light import prediction, spheres
from pipeline.transport import differential as d
from pipeline.types import BallFit, Bracket, Camera, Harmonics, Plane, Raster, View

WIDTH = 560  # px of a stage's picture
SPHERE = 240  # px of a rendered sphere
MASKS = [((24, 25, 27), "clean"), ((240, 96, 70), "clipped in every frame"), ((70, 110, 220), "below the noise"),
         ((245, 200, 60), "frames disagree"), ((90, 220, 200), "defect, replaced")]  # fmt: skip
UNTOUCHED = (24, 25, 27)
GUARDS = {
    d.NEGATIVE: ((232, 80, 70), "below zero"), d.CLIPPED_PLATE: ((240, 160, 60), "plate clipped"),
    d.GAIN_LIMITED: ((120, 190, 90), "gain limited"), d.NO_MODEL: ((80, 160, 220), "no model"),
    d.BOUNDED: ((170, 110, 210), "ratio bounded"), d.EDGE_OF_MODEL: ((230, 230, 120), "edge of the model"),
    d.UNSEEN_ALBEDO: ((120, 210, 200), "albedo not seen"),
}  # fmt: skip
KINDS = [((24, 25, 27), "unchanged"), ((250, 170, 52), "object"), ((90, 140, 230), "shadow"),
         ((60, 80, 120), "faint shadow"), ((172, 49, 88), "edge")]  # fmt: skip
# key, name, good at most, fair at most: the figures the project has set itself for a whole capture.
NAMES = {
    "object_rel_err": "object, relative error", "object_rel_err_p90": "object, worst tenth from",
    "shadow_change_err": "shadow, error of the change", "shadow_change_err_p90": "shadow, worst tenth from",
    "faint_change_err": "faint shadow, error of the change", "shadow_rel_err": "shadow, relative error",
    "flip": "FLIP", "psnr": "PSNR [dB]", "ssim": "SSIM",
}  # fmt: skip
TARGETS = [
    ("object_rel_err", "object", 0.02, 0.05), ("shadow_change_err", "shadow, error of the change", 0.08, 0.15),
    ("faint_change_err", "faint shadow, error of the change", None, None), ("flip", "FLIP", None, None),
    ("probe_irradiance_rel_err", "light, worst of six sides", 0.01, 0.03), ("albedo_rel_err", "albedo", 0.02, 0.05),
    ("pose_rot_deg", "camera rotation", 0.05, 0.1), ("pose_pos_rel", "camera position of distance", 0.002, 0.005),
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Build:
    """Everything the page draws from."""

    facts: dict[str, Any]
    wishes: dict[str, Any]
    brackets: dict[str, Bracket]
    exposures: dict[str, list[dict[str, Any]]]
    photographs: dict[str, Raster]
    camera: Camera
    views: dict[str, View]
    balls: dict[str, BallFit]
    environment: Raster
    harmonics: Harmonics
    plane: Plane
    albedo: Raster
    layers: Raster
    composite: Raster
    display: np.ndarray
    plate_display: np.ndarray
    metrics: dict[str, Any]
    selfcheck: dict[str, Any]
    error_map: Raster
    uncertainty: Raster
    budget: dict[str, Any]
    records: dict[str, Any]

    def camera_of(self, view: str) -> Camera:
        """The camera of a view: its own, else the plate's."""
        return self.views[view].camera or self.camera

    @property
    def frame(self) -> tuple[int, int]:
        """(w, h) of the plate: the coordinates of everything drawn over it."""
        return self.camera.width, self.camera.height

    @property
    def plate_picture(self) -> np.ndarray:
        """The plate's display picture at the width of a stage's picture."""
        return pictures.shrink(self.plate_display, WIDTH).round().astype(np.uint8)


def light_of(value: float | None, good: float | None, fair: float | None) -> str:
    """``good``, ``fair``, ``bad``, or nothing where no target is set."""
    if value is None or good is None or fair is None:
        return ""
    return "good" if value <= good else "fair" if value <= fair else "bad"


def checks(build: Build) -> list[dict[str, str]]:
    """Cards of the self-check."""
    cards, found = [], build.selfcheck

    def card(name: str, key: str, value: float | None, note: str, limits: tuple[float, float] | None = None) -> None:
        light = light_of(value, *limits) if limits else ""
        cards.append({"name": name, "value": fig.reading(key, value), "light": light, "verdict": "", "note": note})

    for name, ball in found.get("ball", {}).items():
        card(
            f"{name}, rendered against photographed",
            "median_rel_err",
            ball["median_rel_err"],
            "in sample",
            (0.05, 0.15),
        )
    for name, pair in found.get("pairs", {}).items():
        note = f"{pair['texels']} directions seen by both"
        card(f"two ball views, {name}", "median_rel_diff", pair["median_rel_diff"], note, (0.1, 0.3))
    for name, shadow in found.get("shadow", {}).items():
        if shadow["points"]:
            note = f"correlation {fig.reading('', shadow['with_mirror_correlation'])}, {shadow['points']} points"
            error = shadow["with_mirror_median_abs_err"]
            card(f"shadow of {name}, predicted", "_err", error, note, (0.03, 0.08))
            if shadow["gain_points"]:
                note = f"{shadow['gain_points']} spots of the plane that the ball leaves alone"
                card(f"{name} against plate, exposure", "_err", abs(shadow["gain"] - 1), note, (0.01, 0.03))
    paper = found.get("paper", {})
    if paper.get("points"):
        grey = float(np.mean(paper["albedo"]))
        ok = paper["expected"][0] <= grey <= paper["expected"][1]
        note = f"expected 0.7 to 0.95; largest over smallest channel {fig.reading('', paper['neutrality'])}"
        card("albedo of the board's paper", "", grey, note, (1, 1) if ok else (0, 1))
    return cards


def ball_rows(build: Build) -> dict[str, Any] | None:
    """Photographed ball, rendered ball, difference; one row per view. None for a probe that is no mirror ball."""
    if not build.balls:
        return None
    rows = []
    light = build.environment.rgb()
    for name, ball in build.balls.items():
        camera = build.camera_of(name)
        rows_at, columns = prediction.ball_crop(camera, ball, 1.15)
        photograph = build.photographs[name].rgb()[rows_at, columns]
        view = build.views[name].world_from_camera
        directions, sine = prediction.ball_directions(camera, ball, view, rows_at, columns)
        predicted = prediction.mirrored_picture(light, directions, prediction.ball_reflectance(ball, sine))
        inside = np.isfinite(sine)
        exposure = display_exposure(photograph[inside])
        shown = np.where(inside[..., None], predicted, photograph)
        below = luminance(photograph)
        difference = np.where(inside & (below > 0), luminance(predicted) / np.where(below > 0, below, 1) - 1, np.nan)
        corner = columns.start, rows_at.start
        outline = fig.moved(fig.ball_outline(camera, ball), *corner)
        rows.append([
            fig.photo(pictures.thumbnail(photograph, 400, exposure), f"{name}, photographed", "with the fitted outline",
                      lines=outline, size=(photograph.shape[1], photograph.shape[0])),
            fig.photo(pictures.thumbnail(shown, 400, exposure), "rendered", "from the map, by exact mirror reflection"),
            fig.signed_figure(pictures.shrink(difference, 400), 0.5, "rendered over photographed", "luminance"),
        ])  # fmt: skip
    text = (
        "If light, sphere and camera are right, the map put back on the ball gives the photograph. The map was made "
        "from these views, so this finds errors of geometry and of merging, not of absolute exposure."
    )
    return {"text": text, "rows": rows} if rows else None


def merge_part(build: Build) -> dict[str, Any]:
    """Exposures as labelled, and as estimated against what the label means; masks."""
    head = ["frame", "label", "estimated", "σ", "clipped"]
    tables = []
    for view, frames in build.exposures.items():
        rows = [
            [f["file"], shutter(f["label_s"]),
             f"{100 * (f['estimated_s'] / f.get('nominal_s', f['label_s']) - 1):+.2f} %".replace("-", "−"),
             fig.reading("_rel", f["sigma_rel"]), fig.reading("_fraction", f["clipped_fraction"])]
            for f in frames if f.get("label_s")
        ]  # fmt: skip
        tables.append({"title": view, "head": head, "rows": rows, "numeric": True})
    shown = []
    for name, raster in build.photographs.items():
        mask = reduced_mask(raster["mask"])
        if (mask & np.uint32(CLIPPED | DARK | GHOST)).any():  # defects alone are a number, not a picture
            mask = pictures.first_bit(mask)
            shown.append(fig.class_figure(mask, MASKS, f"{name}, masks", "worst of each block of pixels"))
    return {"tables": tables, "figures": shown}


def reduced_mask(mask: np.ndarray) -> np.ndarray:
    """A bit mask at about WIDTH columns, bits joined over each block: no defect is too small to be seen."""
    factor = max(1, round(mask.shape[1] / WIDTH))
    rows, columns = (side // factor for side in mask.shape)
    blocks = mask[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor).astype(np.uint32)
    joined = np.bitwise_or.reduce(np.bitwise_or.reduce(blocks, 3), 1)
    return joined & np.uint32(CLIPPED | DARK | GHOST | HOT)


def shutter(seconds: float) -> str:
    """1/250 s, 2 s."""
    return f"1/{1 / seconds:.0f} s" if seconds < 0.4 else f"{fig.short(seconds)} s"


def develop_part(build: Build) -> dict[str, Any]:
    """Every view at the plate's exposure."""
    exposure = display_exposure(build.photographs["plate"].rgb())
    return {
        "figures": [
            fig.photo(
                pictures.thumbnail(raster.rgb(), WIDTH, exposure), name, "at the plate's exposure" * (name != "plate")
            )
            for name, raster in sorted(build.photographs.items(), key=lambda item: item[0] != "plate")
        ]
    }


def calibrate_part(build: Build) -> dict[str, Any]:
    """What distortion does to a straight grid, ten times exaggerated."""
    camera = build.camera
    straight = camera.model_copy(update={"distortion": np.zeros(5)})
    width, height = build.frame
    grid = np.stack(np.meshgrid(np.linspace(0.02, 0.98, 13) * width, np.linspace(0.02, 0.98, 10) * height), -1)
    rays = np.concatenate([(grid - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((*grid.shape[:2], 1))], -1)
    shift = fig.project(camera, rays.reshape(-1, 3)) - fig.project(straight, rays.reshape(-1, 3))
    bent = grid + 10 * np.where(np.isfinite(shift), shift, 0).reshape(grid.shape)
    lines = [line for row in (*bent, *bent.transpose(1, 0, 2)) for line in fig.polyline(row, "edge", build.frame)]
    lines = [
        line for row in (*grid, *grid.transpose(1, 0, 2)) for line in fig.polyline(row, "grid", build.frame)
    ] + lines
    known = np.linalg.norm(shift[np.isfinite(shift[:, 0])], axis=-1)
    caption = (
        f"at most {fig.short(known.max(initial=0.0))} px in the frame; the yellow grid shows it ten times exaggerated"
    )
    return {
        "figures": [fig.photo(build.plate_picture, "Distortion", caption, size=build.frame, lines=lines, width="half")]
    }


def pose_part(build: Build) -> dict[str, Any]:
    """Board and axes, drawn through every pose."""
    board, shown = build.facts.get("board"), []
    for name in build.views:
        lines, labels = board_overlay(build, build.views[name], board)
        picture = build.plate_picture if name == "plate" else pictures.thumbnail(build.photographs[name].rgb(), WIDTH)
        caption = f"{build.views[name].route}, residual {fig.short(build.views[name].rms_px)} px"
        camera = build.camera_of(name)
        size = camera.width, camera.height
        shown.append(fig.photo(picture, name, caption, size=size, lines=lines, labels=labels))
    return {"figures": shown}


def board_overlay(build: Build, view: View, board: dict[str, Any] | None) -> tuple[list[fig.Line], list[fig.Label]]:
    """The board's squares, and the world's axes at its origin."""
    markers = build.facts.get("marker") or [{"side_m": 0.1}]
    side = board["square_m"] if board else 0.5 * markers[0]["side_m"]
    segments, camera = [], view.camera or build.camera
    if board:
        x, z = np.array(board["squares"]) * side
        corners = np.array([[0, 0, 0], [x, 0, 0], [x, 0, z], [0, 0, z]], float)
        segments += fig.grid_segments(corners, board["squares"][0], board["squares"][1], "board", "board")
    tips = 2 * side * np.eye(3)
    segments += [(np.zeros(3), tip, style) for tip, style in zip(tips, "xyz")]
    labels = []
    for tip, text in zip(1.15 * tips, ("+x", "+y", "+z")):
        px = fig.world_pixel(camera, view.world_from_camera, tip)
        labels += [fig.Label(float(px[0]), float(px[1]), text)] if np.isfinite(px).all() else []
    return fig.world_lines(camera, view.world_from_camera, segments), labels


def probe_part(build: Build) -> dict[str, Any]:
    """The map, what of it was seen, and how sure it is."""
    light = build.environment
    height, width = light.shape
    labels = []
    for direction, text in zip([*np.eye(3), *-np.eye(3)], ("+x", "+y", "+z", "−x", "−y", "−z")):
        u, v = latlong_from_direction(direction)
        labels.append(fig.Label(float(np.clip(u, 0.02, 0.98)) * width, float(np.clip(v, 0.05, 0.97)) * height, text))
    horizon = fig.Line(f"0,{height / 2} {width},{height / 2}", "horizon")
    caption = "world frame, centre +z, horizon dashed"
    shown = [
        fig.photo(pictures.thumbnail(light.rgb(), 900), "The light", caption, size=(width, height), lines=[horizon],
                  labels=labels, width="wide"),
    ]  # fmt: skip
    if "seen" in light.channels:
        shown.append(fig.heat_figure(pictures.shrink(light["seen"], WIDTH), 1.0, "Seen", "dark: no view mirrors it"))
    if "variance.R" in light.channels:
        sigma = np.sqrt(np.maximum(luminance(light.rgb("variance")), 0))
        level = np.maximum(luminance(light.rgb()), 1e-12)
        known = np.isfinite(sigma) & (light.channels.get("seen", np.ones_like(sigma)) > 0)
        small = pictures.shrink(np.where(known, sigma / level, np.nan), WIDTH)
        shown.append(fig.heat_figure(small, 0.2, "Standard uncertainty", "of the radiance; grey: not known"))
    view = build.views["plate"].world_from_camera
    seen = spheres.pictures(light.rgb(), build.harmonics.coefficients, view, SPHERE)
    exposure = display_exposure(build.photographs["plate"].rgb())
    for name, ball in list(build.balls.items())[:1]:
        crop = build.photographs[name].rgb()[prediction.ball_crop(build.camera_of(name), ball, 1.02)]
        shown.append(fig.photo(pictures.thumbnail(crop, SPHERE, exposure), name, "the ball as photographed"))
    shown += [
        fig.photo(pictures.thumbnail(picture, SPHERE, exposure), f"A {name} sphere", "in this light, from the plate")
        for name, picture in seen.items()
    ]
    return {"figures": shown}


def plane_part(build: Build) -> dict[str, Any]:
    """The modelled rectangle, and where the objects stand."""
    view = build.views["plate"].world_from_camera
    segments = fig.grid_segments(build.plane.corners_m, 10, 10, "grid", "edge")
    lines, labels = fig.world_lines(build.camera, view, segments), []
    whole = any(fig.world_lines(build.camera, view, [segment]) for segment in segments if segment[2] == "edge")
    reach = 0.012 * np.linalg.norm(build.plane.corners_m[1] - build.plane.corners_m[0])
    for wish in build.wishes.get("object", []):
        foot = np.array([wish["position_m"][0], 0.0, wish["position_m"][1]])
        foot = foot + (build.plane.offset_m - foot @ build.plane.normal) * build.plane.normal
        cross = [(foot - d, foot + d, "foot") for d in reach * np.eye(3)[[0, 2]]]
        lines += fig.world_lines(build.camera, view, cross)
        px = fig.world_pixel(build.camera, view, foot)
        if np.isfinite(px).all():
            labels.append(fig.Label(float(px[0]), float(px[1]) + 0.032 * build.frame[0], wish["name"]))
    caption = "yellow: the rectangle that is modelled, in tenths" if whole else "lines: tenths of what is modelled"
    caption += "; orange: where the objects stand" * bool(labels)
    figure = fig.photo(
        build.plate_picture, "Plane", caption, size=build.frame, lines=lines, labels=labels, width="half"
    )
    return {"figures": [figure]}


def reflectance_part(build: Build) -> dict[str, Any]:
    """The albedo texture as it is, white paper near white."""
    texture = np.dstack([build.albedo.rgb(), build.albedo["seen"]])
    seen = np.argwhere(texture[..., 3] > 0.5)
    if len(seen):  # what the plate shows, and a margin
        (top, left), (bottom, right) = seen.min(0), seen.max(0)
        texture = texture[max(0, top - 8) : bottom + 9, max(0, left - 8) : right + 9]
    small = pictures.shrink(texture, WIDTH)
    coded = encode_srgb(np.clip(convert(small[..., :3], "acescg", "linear_rec709"), 0, 1))
    picture = (coded * 255 + 0.5).astype(np.uint8)
    picture = np.where((small[..., 3] > 0.5)[..., None], picture, (0.35 * picture + 70).astype(np.uint8))
    grey = luminance(small[..., :3])
    caption = "of the plane from above, albedo 1 is white; veiled: not seen by the plate, filled in"
    return {
        "figures": [
            fig.photo(picture, "Albedo", caption, 88),
            fig.heat_figure(grey, 1.0, "Albedo, luminance", "the board's paper should lie at 0.7 to 0.95", ""),
        ]
    }


def render_part(build: Build) -> dict[str, Any]:
    """Model with and without objects, their difference, and the objects alone."""
    layers, exposure = build.layers, display_exposure(build.photographs["plate"].rgb())
    if not (layers["influence"] > 0).any():
        return {}
    small = {name: pictures.shrink(layers.rgb(name), WIDTH) for name in ("with", "without", "obj")}
    alpha, touched = (pictures.shrink(layers[name], WIDTH) for name in ("obj.A", "influence"))
    before = luminance(small["without"])
    change = np.where(
        (touched > 0) & (before > 0), luminance(small["with"]) / np.where(before > 0, before, 1) - 1, np.nan
    )
    opaque = small["obj"] / np.where(alpha > 0, alpha, 1)[..., None]
    straight = np.where(alpha[..., None] > 0, display_transform(opaque, exposure_ev=exposure), 0)
    modelled = small["obj"] + (1 - alpha[..., None]) * small["with"]

    def veiled(rgb: np.ndarray) -> np.ndarray:
        known = ((touched > 0) & (luminance(rgb) > 0))[..., None]
        return np.where(known, display_transform(rgb, exposure_ev=exposure), np.array(pictures.NOT_KNOWN, np.uint8))

    return {
        "figures": [
            fig.photo(veiled(modelled), "LS_obj", "the model with the objects; grey: left to the plate"),
            fig.photo(veiled(small["without"]), "LS_noobj", "the local scene without them; grey: not needed"),
            fig.signed_figure(
                change, 0.5, "LS_obj over LS_noobj", "on the local scene, luminance; grey: left to the plate"
            ),
            fig.photo(pictures.checkered(straight, alpha), "Objects", "as they cover the plate"),
        ]
    }


def composite_part(build: Build) -> dict[str, Any]:
    """A closer look at the objects, the factor on the plate, and guards."""
    composite, shown = build.composite, []
    touched = np.argwhere(build.layers["obj.A"] > 0)
    if len(touched):
        (top, left), (bottom, right) = touched.min(0), touched.max(0)
        margin = int(0.35 * max(bottom - top, right - left)) + 8
        rows, columns = slice(max(0, top - margin), bottom + margin), slice(max(0, left - margin), right + margin)
        crop = pictures.shrink(build.display[rows, columns], 900).round().astype(np.uint8)
        shown.append(fig.photo(crop, "Closer", "the objects and their contact with the ground", 90, width="wide"))
    if "mul.R" in composite.channels:
        factor = luminance(pictures.shrink(composite.rgb("mul"), WIDTH)) - 1
        covered = pictures.shrink(build.layers["obj.A"], WIDTH) > 0
        shown.append(
            fig.signed_figure(np.where(covered, np.nan, factor), 0.5, "Factor on the plate", "mul − 1; grey: object")
        )
    if "guards" in composite.channels and composite["guards"].any():
        guards = composite["guards"][:: max(1, build.frame[0] // WIDTH), :: max(1, build.frame[0] // WIDTH)]
        meanings = [(UNTOUCHED, "none")] + [GUARDS.get(1 << bit, (UNTOUCHED, f"bit {bit}")) for bit in range(8)]
        shown.append(fig.class_figure(pictures.first_bit(guards), meanings, "Guards", "the first that fired"))
    return {"figures": shown}


def uncertainty_part(build: Build) -> dict[str, Any]:
    """The map of sigma, the budget as a waterfall, the largest shared errors."""
    return trust.shown(build.uncertainty, build.composite, build.budget, WIDTH)


def evaluate_part(build: Build) -> dict[str, Any]:
    """Error maps, the table beside doing nothing, and the self-check."""
    if not build.metrics:
        return {}
    nothing = build.metrics["do_nothing"]
    rows: list[list[Any]] = []
    limits = {key: (good, fair) for key, _, good, fair in TARGETS}
    for key in nothing:
        if isinstance(nothing[key], dict):
            rows += [
                [
                    f"{fig.words(key)} {name}",
                    fig.reading("_err", build.metrics[key][name]),
                    fig.reading("_err", value),
                    "",
                ]
                for name, value in nothing[key].items()
            ]
            continue
        good, fair = limits.get(key, (None, None))
        ours: Any = fig.reading(key, build.metrics[key])
        if good is not None:
            ours = {"text": ours, "light": light_of(build.metrics[key], good, fair)}
        target = f"≤ {fig.reading(key, good)}" if good is not None else ""
        rows.append([NAMES.get(key, key.replace("_", " ")), ours, fig.reading(key, nothing[key]), target])
    for name, value in (build.metrics.get("probe_irradiance_rel_err_of") or {}).items():
        rows.append([f"irradiance on a plane facing {name}", fig.reading("_err", value), "", ""])
    table = {"title": "Against truth", "head": ["", "ours", "doing nothing", "target"], "rows": rows, "numeric": True}
    errors = build.error_map
    maps = []
    if "relative" in errors.channels:
        maps = [
            fig.heat_figure(pictures.shrink(errors["relative"], WIDTH), 0.2, "Relative error", "of every pixel"),
            fig.heat_figure(
                np.where(pictures.shrink((errors["class"] > 0).astype(float), WIDTH) > 0.5,
                         pictures.shrink(errors["change"], WIDTH), np.nan),
                1.0, "Error of the change", "5×5 means, where truth changes; 100 % is what doing nothing scores"),
            fig.heat_figure(pictures.shrink(errors["flip"], WIDTH), 0.4, "FLIP", "what an eye would notice", ""),
            fig.class_figure(errors["class"][::2, ::2], KINDS, "Where it is scored", "masks from truth"),
        ]  # fmt: skip
    return {"figures": maps, "tables": [table, *waterfall(build)], "cards": checks(build)}


def waterfall(build: Build) -> list[dict[str, Any]]:
    """Where the error comes from: errors with the truth in place of what stages estimated, when that was asked for."""
    errors = build.records.get("evaluate", {}).get("waterfall") or {}
    if not errors:
        return []
    keys = list(next(iter(errors.values())))
    head = ["truth in place of", *(key.removesuffix("_err").removesuffix("_rel").replace("_", " ") for key in keys)]
    rows = [[label, *(f"{row[key]:.4f}" for key in keys)] for label, row in errors.items()]
    return [{"title": "Where the error comes from", "head": head, "rows": rows, "numeric": True}]


PARTS: dict[str, Callable[[Build], dict[str, Any]]] = {
    "merge": merge_part, "develop": develop_part, "calibrate": calibrate_part, "pose": pose_part, "probe": probe_part,
    "plane": plane_part, "reflectance": reflectance_part, "render": render_part, "composite": composite_part,
    "uncertainty": uncertainty_part, "evaluate": evaluate_part,
}  # fmt: skip
