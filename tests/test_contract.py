"""The promises of the code's structure, checked on its syntax trees: who imports whom, what is declared."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from pipeline.run import artifacts, closure
from pipeline.run.derive import rules, table
from pipeline.run.stage import Artifact
from stages.knobs import KNOBS, PRESETS
from stages.order import NAMES, graph

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted([*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("stages/*.py")])
ROOMS = [*NAMES, "simulate", "ball", "board", "init", "check", "stmap"]
LONGEST = 520  # lines; a file that one reads in one sitting

# The composition roots: the only files outside stages/ that may know them.
KNOW_STAGES = {"pipeline/run/cli.py"}

# Library -> the files that may import it. A library in no row is numpy, pydantic, scipy, or undeclared.
BRIDGES = {
    "cv2": {
        "pipeline/camera/board_families.py",
        "pipeline/camera/board_kinds.py",
        "pipeline/camera/opencv_bridge.py",
        "pipeline/image/alignment.py",
        "pipeline/image/chart_finder.py",
        "pipeline/image/jpeg.py",
        "pipeline/light/sampling.py",
        "pipeline/run/formats.py",
        "pipeline/transport/denoise.py",  # its filters: 3 to 10 times quicker than those of scipy
        "pipeline/transport/region.py",  # likewise, and loaded in a tenth of the time
        "pipeline/transport/softened.py",  # likewise
        "pipeline/simulation/surfaces.py",  # draws the board; shares no code with what reads it
    },
    "mitsuba": {"pipeline/transport/variant.py"},
    "pxr": {"pipeline/camera/stated.py"},
    "drjit": {
        "pipeline/transport/caustics.py",
        "pipeline/transport/difference.py",
        "pipeline/transport/directions.py",
        "pipeline/transport/energy.py",
        "pipeline/transport/gradient.py",
        "pipeline/transport/materials.py",
        "pipeline/transport/paths.py",
        "pipeline/transport/trace.py",
        "pipeline/transport/variant.py",  # after mitsuba has chosen its LLVM
        "pipeline/simulation/lens.py",  # tan of an array in a kernel
        "pipeline/simulation/photograph.py",
        "pipeline/simulation/thrown.py",
        "pipeline/simulation/twin_world.py",
    },
    "pycolmap": {"pipeline/camera/colmap_bridge.py"},
    "numba": {"pipeline/image/machine_code.py"},
    "rawpy": {"pipeline/image/libraw.py"},
    "tifffile": {"pipeline/image/encoded.py", "pipeline/image/tags.py"},
    "imagecodecs": {"pipeline/image/dng_data.py", "pipeline/image/encoded.py", "pipeline/simulation/dng.py"},
    "OpenEXR": {"pipeline/run/formats.py"},
    "PIL": {
        "pipeline/image/encoded.py",
        "pipeline/run/formats.py",
        "pipeline/run/figures.py",
        "pipeline/image/jpeg.py",
        "pipeline/image/pictures.py",
        "pipeline/simulation/capture.py",
    },
    "pi_heif": {"pipeline/image/encoded.py"},
    "PyOpenColorIO": {"pipeline/image/display.py"},
    "colour": {  # spectra, charts, delta E; its matrices are constants here, tested against it
        "pipeline/image/chart.py",
        "pipeline/image/sensitivities.py",
        "pipeline/simulation/spectra.py",
    },
    "reportlab": {"pipeline/capture/sheet.py"},
    "lensfunpy": {"pipeline/image/lens_database.py"},
    "colour_demosaicing": {"pipeline/image/demosaic.py"},
    "flip_evaluator": {"pipeline/image/metrics.py"},
    "skimage": {"pipeline/image/metrics.py"},
    "trimesh": {"pipeline/transport/meshes.py", "pipeline/simulation/shapes.py"},
    "jinja2": {"pipeline/image/page.py"},
    "mitsuba_oidn": {"pipeline/transport/denoise.py"},
}
SLOW = {*BRIDGES, "scipy"}  # to import; scipy has no place of its own
LIGHT = {"numpy", "pydantic", "pipeline", "stages"}
# Import name -> name in pyproject.toml, where they differ.
DISTRIBUTIONS = {
    "pxr": "usd-core",
    "pi_heif": "pi-heif",
    "cv2": "opencv-contrib-python-headless", "drjit": "mitsuba", "PIL": "pillow", "PyOpenColorIO": "opencolorio",
    "colour": "colour-science", "colour_demosaicing": "colour-demosaicing", "flip_evaluator": "flip-evaluator",
    "mitsuba_oidn": "mitsuba-oidn",
    "skimage": "scikit-image",
}  # fmt: skip


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@functools.cache
def imported(path: Path) -> frozenset[tuple[str, bool]]:
    """(dotted module, whether it is imported when the file is) of every import; those for type checkers left out."""
    found: set[tuple[str, bool]] = set()

    def visit(node: ast.AST, at_import: bool) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.Import):
            found.update((alias.name, at_import) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update((f"{node.module}.{alias.name}", at_import) for alias in node.names)
        inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            visit(child, at_import and not inside)

    visit(tree(path), True)
    return frozenset(found)


def roots(path: Path) -> set[str]:
    return {module.split(".")[0] for module, _ in imported(path)}


def test_rooms_do_not_import_rooms():
    for name in ROOMS:
        others = {m for m, _ in imported(ROOT / f"stages/{name}.py") if m.startswith("stages")}
        assert others <= {"stages.knobs"}, f"stages/{name}.py"


def test_pipeline_does_not_import_stages():
    knowing = {name_of(path) for path in SOURCES if path.parts[-2] != "stages" and "stages" in roots(path)}
    assert knowing == KNOW_STAGES


def test_relative_imports_are_not_used():
    """The code digest and the rules above read absolute names."""
    for path in SOURCES:
        assert not any(isinstance(node, ast.ImportFrom) and node.level for node in ast.walk(tree(path))), path


def test_simulation_shares_no_code_with_what_it_tests():
    shared = ("pipeline.simulation", "pipeline.conventions", "pipeline.types", "pipeline.run")
    for path in sorted(ROOT.glob("pipeline/simulation/*.py")):
        strange = {m for m, _ in imported(path) if m.startswith("pipeline.") and not m.startswith(shared)}
        assert not strange, name_of(path)
    users = {
        name_of(path)
        for path in SOURCES
        if any(module.startswith("pipeline.simulation") for module, _ in imported(path))
    }
    assert {user for user in users if not user.startswith("pipeline/simulation/")} == {"stages/simulate.py"}


def test_heavy_libraries_are_imported_inside_functions():
    for path in SOURCES:
        heavy = {m for m, at_import in imported(path) if at_import and m.split(".")[0] in SLOW}
        assert not heavy, name_of(path)


@pytest.mark.parametrize("library", sorted(BRIDGES))
def test_library_has_its_bridges_only(library):
    assert {name_of(path) for path in SOURCES if library in roots(path)} <= BRIDGES[library]


def test_every_library_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    items = project["dependencies"] + project["optional-dependencies"]["usd"]
    declared = {re.split(r"[><=\[ ]", item)[0] for item in items}
    for path in SOURCES:
        foreign = roots(path) - set(sys.stdlib_module_names) - LIGHT
        assert foreign <= SLOW, name_of(path)
        assert {DISTRIBUTIONS.get(name, name) for name in foreign} <= declared, name_of(path)


def test_every_package_is_installed():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT).as_posix().replace("/", ".") for path in SOURCES}
    assert set(listed) == folders


def test_every_module_has_a_docstring_and_every_room_a_summary():
    for path in SOURCES:
        assert ast.get_docstring(tree(path)), name_of(path)
    for name in ROOMS:
        assert 20 < len(closure.summary(f"stages.{name}")) <= 120


def test_every_public_function_has_a_docstring():
    for path in SOURCES:
        for node in tree(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                assert ast.get_docstring(node), f"{name_of(path)}: {node.name}"


def test_stages_are_the_files_in_stages():
    files = {path.stem for path in ROOT.glob("stages/*.py")} - {"__init__", "__main__", "knobs", "order"}
    assert files == set(ROOMS)
    assert tuple(stage.name for stage in graph().stages) == NAMES == tuple(KNOBS)


def test_every_knob_is_described_and_used():
    for stage, model in KNOBS.items():
        text = (ROOT / f"stages/{stage}.py").read_text()
        for knob, field in model.model_fields.items():
            assert field.description, f"{stage}.{knob}"
            assert f"params.{knob}" in text, f"{stage}.{knob} changes nothing"


def test_presets_set_existing_knobs_to_allowed_values():
    for preset in PRESETS.values():
        for stage, values in preset.items():
            assert values.keys() <= KNOBS[stage].model_fields.keys()
            KNOBS[stage].model_validate(values)


def test_every_artifact_is_written_once_and_read():
    """Graph refuses two writers; here: every row is written, and only page and CDL are read by no stage."""
    rows = {row.name: row for row in vars(artifacts).values() if isinstance(row, Artifact)}
    stages = graph().stages
    written = [artifact.name for stage in stages for artifact in stage.outputs.values()]
    read = {artifact.name for stage in stages for artifact in stage.inputs.values()}
    assert sorted([*written, "records"]) == sorted(rows)  # records come from the runner
    assert set(written) - read == {"report", "corrections"}
    for row in rows.values():
        assert row.meaning
        assert (row.type is not None) == (row.kind == "json")
        assert bool(row.space) == (row.kind in ("raster", "rasters", "picture"))


def test_table_of_stages_is_up_to_date():
    assert (ROOT / "stages/README.md").read_text() == table(graph(), KNOBS) + "\n", "run: make docs"


def test_rules_name_every_stage_and_only_files_that_exist():
    text = rules(graph())
    for name in NAMES:
        assert f"\n$(OUT)/{name}/record.json: stages/{name}.py" in text or f"stages/{name}.py" in text
    for file in set(re.findall(r"\b(?:stages|pipeline)/[\w/]+\.py", text)):
        assert (ROOT / file).is_file()


def test_files_are_short():
    for path in [*SOURCES, *ROOT.glob("tests/*.py")]:
        assert len(path.read_text().splitlines()) <= LONGEST, name_of(path)


def tracked() -> list[Path]:
    listing = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / line for line in listing.stdout.splitlines() if (ROOT / line).is_file()]


def test_no_path_of_a_machine_is_written_down():
    pattern = re.compile(r"(?<![\w.$~}])/(?:home|root|Users|work|mnt)/\w")
    for path in tracked():
        if path.suffix in (".py", ".md", ".toml", ".json", ".lock", ".yml", "") and path != Path(__file__):
            found = pattern.search(path.read_text())
            assert not found, f"{name_of(path)}: {found and found[0]}"


def test_nothing_built_is_tracked():
    for path in tracked():
        assert not {"build", ".venv", "__pycache__"} & set(path.relative_to(ROOT).parts), path


def test_readme_shows_what_the_figures_say():
    """The errors printed in the README are those of the desk at preview in the generated page of figures."""
    rows = [line.split("|")[1:-1] for line in (ROOT / "docs/figures.md").read_text().splitlines() if "|" in line]
    rows = [[cell.strip() for cell in row] for row in rows]
    names = next(row for row in rows if row[0] == "capture")
    ours, nothing = (
        dict(zip(names, next(row for row in rows if row[:2] == ["desk", quality])))
        for quality in ("preview", "*doing nothing*")
    )
    text = " ".join((ROOT / "README.md").read_text().split())
    assert f"object, relative error {ours['object']} {nothing['object']}" in text
    assert f"shadow, error of the change {ours['shadow change']} {nothing['shadow change']}" in text
