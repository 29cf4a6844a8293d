"""The runner on a graph of three numpy stages: when it works, when it does not, and what a failure leaves behind."""

from __future__ import annotations

import ast
import json
import multiprocessing
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import BaseModel

from pipeline.run import closure, formats
from pipeline.run.derive import print_summary
from pipeline.run.errors import ArtifactError, CaptureError
from pipeline.run.runner import Build, as_read, settle
from pipeline.run.settings import Settings
from pipeline.run.stage import Artifact, Graph, Stage
from pipeline.types import Raster, Result


class Knob(BaseModel):
    gain: float = 1.0


INDEX = Artifact("index", "json", "what lies in the folder", type=dict[str, float])
PICTURES = Artifact("pictures", "rasters", "a picture per name", "1", "data")
SIGN = Artifact("sign", "raster", "sign of their sum", "1", "data")
CALLS: list[str] = []


def index(capture_folder: Path, scene_file: Path | None, params: Knob) -> Result:
    CALLS.append("index")
    return Result({"index": json.loads((capture_folder / "facts.json").read_text())})


def pictures(index: dict[str, float], params: Knob) -> Result:
    CALLS.append("pictures")
    if params.gain < 0:
        raise CaptureError("pictures: negative gain, needed a positive one; change it")
    ramp = np.arange(12.0).reshape(3, 4).T  # not contiguous, float64: settle must mend both
    made = {name: Raster({"v": ramp * value * params.gain, "mask": ramp > 3}, "data") for name, value in index.items()}
    return Result({"pictures": made}, {"gain": np.float64(params.gain)})


def sign(pictures: dict[str, Raster], params: Knob) -> Result:
    CALLS.append("sign")
    total = sum(raster["v"] for raster in pictures.values())
    return Result({"sign": Raster({"v": np.sign(total) * params.gain}, "data")}, warnings=["a warning"])


STAGES = [
    Stage("index", index, Knob, {}, {"index": INDEX}, impure=True),
    Stage("pictures", pictures, Knob, {"index": INDEX}, {"pictures": PICTURES}),
    Stage("sign", sign, Knob, {"pictures": PICTURES}, {"sign": SIGN}),
]
KNOBS = {stage.name: Knob for stage in STAGES}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "facts.json").write_text(json.dumps({"a": 1.0, "b": 2.0}))
    return tmp_path


def build(folder: Path, gains: dict[str, float] | None = None, out: str = "out") -> Build:
    params = {name: {"gain": (gains or {}).get(name, 1.0)} for name in KNOBS}
    settings = Settings(capture=str(folder), scene=None, quality="draft", params=params)
    return Build(Graph(STAGES), folder / out, settings, KNOBS)


def run(folder: Path, gains: dict[str, float] | None = None, out: str = "out") -> dict[str, str]:
    """Outcome of each stage in a fresh Build, as a new process would have it."""
    outcomes: dict[str, str] = {}
    CALLS.clear()
    one = build(folder, gains, out)
    one.run_all(one.graph.stages, lambda name, outcome, seconds: outcomes.update({name: outcome}))
    return outcomes


def bytes_of(folder: Path) -> dict[str, bytes]:
    """Every output's bytes; records hold times."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in ("record.json", ".lock"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_first_run_runs_and_second_does_not(folder):
    assert run(folder) == {"index": "ran", "pictures": "ran", "sign": "ran"}
    assert run(folder) == {"index": "same", "pictures": "fresh", "sign": "fresh"}
    assert CALLS == ["index"]  # what reads outside the build is asked every time, nothing else computes


def test_parameter_reruns_its_stage_and_those_after_it(folder):
    run(folder)
    assert run(folder, {"pictures": 3.0}) == {"index": "same", "pictures": "ran", "sign": "same"}
    assert run(folder, {"pictures": 3.0, "sign": 2.0}) == {"index": "same", "pictures": "fresh", "sign": "ran"}


def test_same_bytes_stop_the_wave(folder):
    run(folder)
    (folder / "facts.json").write_text('{"b": 2, "a": 1}')  # other text, same facts: but the order of names differs
    assert run(folder) == {"index": "ran", "pictures": "same", "sign": "fresh"}


def test_touched_files_are_fresh(folder):
    run(folder)
    for path in [folder / "facts.json", *(folder / "out").rglob("*.exr")]:
        path.touch()
    assert run(folder) == {"index": "same", "pictures": "fresh", "sign": "fresh"}


@pytest.mark.parametrize("name", ["pictures/pictures", "pictures/record.json", "sign/sign.exr"])
def test_deleted_file_is_made_again(folder, name):
    run(folder)
    before = bytes_of(folder / "out")
    path = folder / "out" / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    outcomes = run(folder)
    assert outcomes[name.split("/")[0]] in ("ran", "same")
    assert bytes_of(folder / "out") == before


@pytest.mark.parametrize("damage", ["", "{", "[]", "{}", '{"outputs": {}}', "\xff"])
def test_damaged_record_runs_again(folder, damage):
    run(folder)
    (folder / "out/pictures/record.json").write_bytes(damage.encode("latin1"))
    assert run(folder) == {"index": "same", "pictures": "ran", "sign": "fresh"}
    assert build(folder).verify() == []


def test_failing_stage_leaves_no_record_and_the_next_run_goes_on(folder):
    with pytest.raises(CaptureError, match="negative gain"):
        run(folder, {"pictures": -1.0})
    assert build(folder).record("pictures") is None
    assert build(folder).record("index") is not None
    assert run(folder) == {"index": "same", "pictures": "ran", "sign": "ran"}


def test_interrupted_writing_is_not_taken_for_the_old_result(folder, monkeypatch):
    """Stopped between output and record, then asked for the first settings again: outputs must be the first ones."""
    run(folder)
    before = bytes_of(folder / "out")
    whole = formats.write_bytes

    def stopped(path: Path, data: bytes) -> None:
        if path.name == "record.json" and path.parent.name == "pictures":
            raise KeyboardInterrupt
        whole(path, data)

    monkeypatch.setattr(formats, "write_bytes", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(folder, {"pictures": 5.0})
    monkeypatch.undo()
    assert bytes_of(folder / "out") != before
    assert run(folder)["pictures"] == "ran"
    assert bytes_of(folder / "out") == before


def test_no_temporary_files_remain(folder, monkeypatch):
    run(folder)
    monkeypatch.setattr("os.replace", lambda *paths: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(ArtifactError, match=r"cannot be written \(disk full\)"):
        run(folder, {"pictures": 2.0})
    monkeypatch.undo()
    run(folder, {"pictures": 2.0})
    names = {path.name for path in (folder / "out").rglob("*")}
    assert names == {
        "index", "pictures", "sign", "index.json", "a.exr", "b.exr", "sign.exr", "record.json", ".lock",
    }  # fmt: skip


def test_verify_detects_one_flipped_byte(folder):
    run(folder)
    assert build(folder).verify() == []
    path = folder / "out/pictures/pictures/a.exr"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert build(folder).verify() == [f"{path.parent}: differs from what pictures wrote"]


def test_missing_input_names_the_stage_to_run(folder):
    one = build(folder)
    with pytest.raises(ArtifactError, match="run insitu pictures"):
        one.run(one.graph["sign"])


def test_memory_and_disk_give_the_same_bytes(folder):
    run(folder, out="memory")
    for name in KNOBS:  # one Build per stage: each reads what the one before wrote
        one = build(folder, out="disk")
        one.run(one.graph[name])
    assert bytes_of(folder / "memory") == bytes_of(folder / "disk")


def test_what_memory_holds_is_what_disk_holds(folder):
    one = build(folder)
    one.run_all(one.graph.stages, lambda *_: None)
    for artifact in (PICTURES, SIGN):
        held, read = one.value(artifact), formats.read(one.out / one.graph.producer[artifact.name].name, artifact)
        pairs = [(held[k], read[k]) for k in read] if isinstance(read, dict) else [(held, read)]
        for ours, theirs in pairs:
            assert ours.channels.keys() == theirs.channels.keys()
            for name, values in ours.channels.items():
                assert values.dtype == theirs[name].dtype
                assert np.array_equal(values, theirs[name])


def test_memory_is_dropped_when_another_process_wrote_since(folder):
    one = build(folder)
    one.run(one.graph["index"])
    one.run(one.graph["pictures"])
    run(folder, {"pictures": 7.0})  # the other process
    assert one.value(PICTURES)["a"]["v"].max() == 7 * 11


def _repeat(folder: Path, gain: float) -> None:
    for step in range(20):
        run(folder, {"pictures": gain + step % 2, "sign": gain})


def test_two_runs_at_once_do_not_corrupt(folder, saw):
    """Whatever run was last, records and files agree and nothing crashes; four processes with other settings each."""
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_repeat, args=(folder, gain)) for gain in (1.0, 2.0, 3.0, 4.0)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0, 0, 0]
    assert build(folder).verify() == []
    run(folder)
    after = bytes_of(folder / "out")
    run(folder, out="alone")
    alone = bytes_of(folder / "alone")
    saw("machine.two_runs", "exact", sum(after.get(name) != data for name, data in alone.items()))
    assert after.keys() == alone.keys()


def test_settle_makes_plain_contiguous_arrays():
    raster = Raster({"v": np.ones((4, 6))[:, ::2], "mask": np.ones((4, 3), bool)}, "data")
    settled = settle(SIGN, raster)
    assert {name: values.dtype for name, values in settled.channels.items()} == {"v": np.float32, "mask": np.uint32}
    assert all(values.flags.c_contiguous for values in settled.channels.values())


def test_a_stage_that_returns_other_outputs_is_a_bug(folder):
    wrong = Stage("index", lambda capture_folder, scene_file, params: Result({}), Knob, {}, {"index": INDEX}, True)
    one = build(folder)
    one = Build(Graph([wrong]), folder / "out", one.settings, KNOBS)
    with pytest.raises(TypeError, match="declared"):
        one.run(wrong)


def test_graph_refuses_two_writers_unknown_inputs_and_wrong_signatures():
    twice = [STAGES[0], Stage("again", index, Knob, {}, {"index": INDEX}, impure=True)]
    for stages, message in (
        (twice, "written by"),
        ([STAGES[2]], "no earlier stage"),
        ([STAGES[0], Stage("sign", sign, Knob, {"index": INDEX}, {"sign": SIGN})], "compute takes"),
    ):
        with pytest.raises(TypeError, match=message):
            Graph(stages)


def test_upto_takes_only_what_is_needed():
    graph = Graph([*STAGES[:2], Stage("other", pictures_only, Knob, {"index": INDEX}, {}), STAGES[2]])
    assert [stage.name for stage in graph.upto("sign")] == ["index", "pictures", "sign"]


def pictures_only(index: dict[str, float], params: Knob) -> Result:
    return Result({})


def test_code_digest_follows_the_files_that_are_imported(tmp_path, monkeypatch):
    for name, text in (
        ("stages/a.py", "from pipeline.run import noun\n"),
        ("pipeline/run/noun.py", "import pipeline.deep\n"),
        ("pipeline/deep.py", "VALUE = 1\n"),
        ("pipeline/other.py", "VALUE = 1\n"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(closure, "ROOT", tmp_path)

    def digest() -> str:
        closure.imports.cache_clear()
        closure.closure.cache_clear()
        return closure.digest("stages.a")

    try:
        first = digest()
        (tmp_path / "pipeline/other.py").write_text("VALUE = 2\n")
        assert digest() == first
        (tmp_path / "pipeline/deep.py").write_text("VALUE = 2\n")
        assert digest() != first
    finally:
        closure.imports.cache_clear()
        closure.closure.cache_clear()


def parsed(module: str) -> frozenset[str]:
    """What `closure.imports` must find."""
    found = set()
    for node in ast.walk(ast.parse(closure.path_of(module).read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(name for name in found if closure.path_of(name) and name not in closure.PLUMBING)


def test_imports_found_by_pattern_hold_those_the_parser_finds():
    """One too few would keep what is stale. More are only those in programs that are written as text."""
    files = [
        path.relative_to(closure.ROOT) for top in ("pipeline", "stages") for path in (closure.ROOT / top).rglob("*.py")
    ]
    modules = [".".join(file.with_suffix("").parts) for file in files]
    modules = [module for module in modules if closure.path_of(module)]
    assert len(modules) > 150
    more = {module: closure.imports(module) - parsed(module) for module in modules}
    assert all(closure.imports(module) >= parsed(module) for module in modules)
    assert sum(map(len, more.values())) <= 1, more


def test_what_a_stage_stores_in_16_bit_lies_so_on_disk_and_is_the_same_in_memory(tmp_path):
    """Half floats are written as they are; the next stage has them widened, from memory as from the file."""
    import OpenEXR

    value = settle(SIGN, Raster({"Y": np.array([[0.1, 2.0]], np.float16), "Z": np.array([[0.1, 2.0]])}, "data"))
    path = formats.write(tmp_path, SIGN, value)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert [file.channels()[name].pixels.dtype for name in "YZ"] == [np.float16, np.float32]
    read, kept = formats.read(tmp_path, SIGN), as_read(value)
    for name in "YZ":
        assert read[name].dtype == kept[name].dtype == np.float32
        assert np.array_equal(read[name], kept[name])


def test_memory_has_the_attributes_that_the_file_is_read_with(tmp_path):
    """A window of the picture is how it lies on disk; what the stage says of the picture passes either way."""
    said = {"dataWindow": ((1, 0), (1, 0)), "insitu:unit": "1", "envmap": "latlong"}
    value = settle(SIGN, Raster({"Y": np.array([[0.0, 2.0]], np.float32)}, "data", said))
    formats.write(tmp_path, SIGN, value)
    read, kept = formats.read(tmp_path, SIGN), as_read(value)
    assert kept.attributes == read.attributes == {"insitu:unit": "1", "envmap": "latlong"}
    assert np.array_equal(read["Y"], kept["Y"])


def test_changed_code_runs_again(folder, monkeypatch):
    run(folder)
    monkeypatch.setattr(closure, "digest", lambda module: "other code")
    assert run(folder) == {"index": "same", "pictures": "same", "sign": "same"}
    assert CALLS == ["index", "pictures", "sign"]


def test_summary_of_a_capture_without_truth_or_with_figures_missing(folder):
    """A capture without objects has neither object nor shadow pixels: their figures are None."""
    metrics = {"object_rel_err": None, "shadow_change_err": 0.5, "do_nothing": {"object_rel_err": None}}
    record = {"seconds": 1.0, "cpu_seconds": 2.0}
    for value in ({}, metrics):
        stub = SimpleNamespace(
            settings=SimpleNamespace(quality="draft"), out=folder, value=lambda artifact, value=value: value,
            record=lambda name: record, graph=SimpleNamespace(stages=STAGES, producer=_AnyProducer()),
        )  # fmt: skip
        text = print_summary(stub)
        assert "draft" in text
        assert "index" in text
    assert "0.5000" in text
    assert re.search(r"object, relative error +- +-\n", text)


class _AnyProducer(dict):
    def __missing__(self, key: str) -> SimpleNamespace:
        return SimpleNamespace(name="evaluate")
