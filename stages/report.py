"""One self-contained page: before and after, errors beside doing nothing, and what every stage saw, measured and chose.

Pictures are embedded, lines over them are vectors projected through the estimated lens, so a wrong pose is visible as a
grid that leaves the print. What does not exist is absent. Nothing is estimated here, except the picture of the ball
that the map predicts. Limits: pictures are small and in the display's range; the numbers are the measurement.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pipeline.image import figures as fig
from pipeline.image import page, pictures
from pipeline.image.balance import balanced
from pipeline.image.panels import PARTS, TARGETS, Build, ball_rows, checks, light_of
from pipeline.run import artifacts as A
from pipeline.run.evidence import bound_text, is_open
from pipeline.run.stage import Stage
from pipeline.types import Balance, BallFit, Bracket, Camera, Harmonics, Plane, Raster, Result, View
from stages import knobs

HERO = 1600  # px at most, about, of the picture on top
TITLES = {
    "ingest": ("What was photographed", "Files by role, with what their metadata say."),
    "merge": ("Brackets to radiance", "Merged on the sensor's mosaic, each sample weighted by its noise."),
    "develop": ("Radiance to colour", "Demosaicked and brought to ACEScg by the camera's own matrices."),
    "balance": ("One scale for all views", "Exposure and colour of each view against the plate's, by what both saw."),
    "sources": (
        "What is good enough",
        "Whether board and markers leave the objects' feet certain enough, or a cloud is needed.",
    ),
    "sfm": ("What all photographs share", "Poses and a cloud of points from further views, when there are any."),
    "calibrate": ("The lens", "Intrinsics and distortion from board or tracks; terms are taken on evidence."),
    "pose": (
        "Where the camera stood",
        "The board's squares drawn through the estimated lens and pose must lie on its print.",
    ),
    "probe": ("The light", "What the probe saw as a world-oriented map; directions that it did not see are marked."),
    "lights": ("Lamps and sky", "Compact lights told apart from the map; each casts its own hard shadow."),
    "plane": ("The local scene", "The rectangle of the plane whose light the objects change."),
    "reflectance": ("What the surface reflects", "The plate over the light the probe saw, equations 6 to 8."),
    "render": ("With and without", "LS_obj and LS_noobj on the same samples; only their difference touches the plate."),
    "composite": ("Put together", "plate × mul + add + obj. Every guard that fired is counted."),
    "uncertainty": (
        "How far it can be trusted",
        "What every stage is unsure of, carried to the pixels; what no sigma covers is named.",
    ),
    "evaluate": (
        "How wrong it is",
        "Against truth where it exists; else what the estimates predict of things that stood there.",
    ),
}
COLOURS = ["#4c78a8", "#72b7b2", "#54a24b", "#eeca3b", "#f58518", "#e45756", "#b279a2", "#9d755d", "#79706e", "#bab0ac",
           "#2f6f8f", "#88b04b", "#d67195"]  # fmt: skip


def compute(
    facts: dict[str, Any], wishes: dict[str, Any], brackets: dict[str, Bracket],
    exposures: dict[str, list[dict[str, Any]]], photographs: dict[str, Raster], camera: Camera, views: dict[str, View],
    balls: dict[str, BallFit], environment: Raster, harmonics: Harmonics, plane: Plane, albedo: Raster, layers: Raster,
    composite: Raster, display: np.ndarray, plate_display: np.ndarray, metrics: dict[str, Any],
    selfcheck: dict[str, Any], error_map: Raster, uncertainty: Raster, budget: dict[str, Any],
    balance: dict[str, Balance], records: dict[str, Any], params: knobs.Report,
) -> Result:  # fmt: skip
    """The page as text."""
    photographs = balanced(photographs, balance)
    build = Build(
        facts, wishes, brackets, exposures, photographs, camera, views, balls, environment, harmonics, plane, albedo,
        layers, composite, display, plate_display, metrics, selfcheck, error_map, uncertainty,
        budget, records,
    )  # fmt: skip
    with ThreadPoolExecutor() as pool:  # pictures: display transform, means and JPEG hold no lock
        sections = list(pool.map(lambda name: section(build, name), [name for name in TITLES if name in records]))
    names = [wish["name"] for wish in wishes.get("object", [])]
    lead = (
        f"{len(names)} object{'s' if len(names) != 1 else ''} in the photograph: {', '.join(names)}." if names else ""
    )
    headline, note = headlines(build)
    text = page.render(
        heat=", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in pictures.HEAT),
        title=facts["name"], lead=lead, headline=headline, headline_note=note, sections=sections, ball=ball_rows(build),
        after=pictures.jpeg_uri(fitted(display), 90), before=pictures.jpeg_uri(fitted(plate_display), 90),
        warning_count=sum(len(s["warnings"]) for s in sections), times=times(records), provenance=provenance(build),
    )  # fmt: skip
    return Result({"report": text}, {"size_mb": len(text) / 1e6})


def fitted(picture: np.ndarray) -> np.ndarray:
    """A display picture no wider than about twice HERO."""
    return pictures.shrink(picture, HERO).round().astype(np.uint8)


def section(build: Build, name: str) -> dict[str, Any]:
    """What the page says about one stage."""
    title, text = TITLES[name]
    record = build.records[name]
    shown: dict[str, Any] = {"figures": [], "tables": [], "cards": []}
    if name in PARTS:
        shown |= PARTS[name](build)
    seconds = record.get("seconds")
    return {
        "name": name, "title": title, "text": text,
        "seconds": f"{seconds:.2f} s" if seconds is not None else "",
        "numbers": fig.readings(record.get("numbers") or {}), "warnings": record.get("warnings") or [],
        "evidence": [
            {key: entry.get(key, "") for key in ("term", "modelled", "because", "could_cost")}
            | {"bound": bound_text(entry) if is_open(entry) else ""}
            for entry in record.get("evidence") or []
        ],
        "params": fig.readings(record.get("params") or {}), **shown,
    }  # fmt: skip


def headlines(build: Build) -> tuple[list[dict[str, str]], str]:
    """The cards under the picture: errors against truth beside doing nothing, or what could be checked without it."""
    if not build.metrics:
        if other := (build.records.get("evaluate", {}).get("numbers") or {}).get("other_scene"):
            return checks(build), f"The truth shows another scene, so there are no figures: {'; '.join(other)}."
        return checks(build), "No truth is known for this capture: these are predictions of what really stood there."
    cards, nothing = [], build.metrics.get("do_nothing", {})
    for key, name, good, fair in TARGETS:
        value = build.metrics.get(key)
        if value is None:
            continue
        light = light_of(value, good, fair)
        verdict = {"good": "within target", "fair": "near target", "bad": "off target"}.get(light, "")
        notes = [f"target {fig.reading(key, good)}"] if good is not None else []
        notes += [f"doing nothing {fig.reading(key, nothing[key])}"] if nothing.get(key) is not None else []
        cards.append(
            {
                "name": name,
                "value": fig.reading(key, value),
                "light": light,
                "verdict": verdict,
                "note": ", ".join(notes),
            }
        )
    same = build.metrics.get("untouched_identical")
    if same is not None:
        share = fig.reading("untouched_fraction", build.metrics["untouched_fraction"])
        verdict = "bit-identical" if same else "changed: a fault"
        light = "good" if same else "bad"
        cards.append({"name": "pixels left alone", "value": share, "light": light, "verdict": verdict, "note": ""})
    return cards, ""


def times(records: dict[str, Any]) -> list[dict[str, Any]]:
    """The bar of seconds."""
    spent = [(name, record["seconds"]) for name, record in records.items() if record.get("seconds")]
    return [
        {
            "name": name,
            "share": f"{seconds:.3f}",
            "text": f"{seconds:.2f} s",
            "colour": COLOURS[i % len(COLOURS)],
        }
        for i, (name, seconds) in enumerate(spent)
    ]


def provenance(build: Build) -> list[dict[str, Any]]:
    """Objects, photographs and libraries, each with its digest or version."""
    objects = [[wish["name"], wish["file"], wish.get("sha256", "")[:16]] for wish in build.wishes.get("object", [])]
    files = [[view, f.file, f.sha256[:16]] for view, bracket in build.brackets.items() for f in bracket.frames]
    versions: dict[str, str] = {}
    for record in build.records.values():
        versions |= record.get("versions") or {}
    tables: list[dict[str, Any]] = [
        {"title": "Objects", "head": ["name", "file", "sha256"], "rows": objects, "numeric": False, "folded": False},
        {"title": "Libraries", "head": ["name", "version"], "rows": [[*item] for item in sorted(versions.items())],
         "numeric": False, "folded": False},
    ]  # fmt: skip
    inner = {"title": "", "head": ["view", "file", "sha256"], "rows": files, "numeric": False}
    tables = [table for table in tables if table["rows"]]
    return [*tables, {"title": f"{len(files)} photographs", "folded": True, "inner": inner}]


STAGE = Stage(
    "report",
    compute,
    knobs.Report,
    inputs={
        "facts": A.FACTS, "wishes": A.WISHES, "brackets": A.BRACKETS, "exposures": A.EXPOSURES,
        "photographs": A.PHOTOGRAPHS, "camera": A.CAMERA, "views": A.VIEWS, "balls": A.BALLS,
        "environment": A.ENVIRONMENT, "harmonics": A.HARMONICS, "plane": A.PLANE, "albedo": A.ALBEDO,
        "layers": A.LAYERS, "composite": A.COMPOSITE, "display": A.DISPLAY, "plate_display": A.PLATE_DISPLAY,
        "metrics": A.METRICS, "selfcheck": A.SELFCHECK, "error_map": A.ERROR_MAP, "uncertainty": A.UNCERTAINTY,
        "budget": A.BUDGET, "balance": A.BALANCE,
        "records": A.RECORDS,
    },
    outputs={"report": A.REPORT},
)  # fmt: skip
