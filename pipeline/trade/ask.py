"""``--max-error`` and ``--time-budget``: settings for a question, and what became of the prediction, in run.json.

run.json      asked, predicted, reached, settings, warnings, and the key of what the answer holds for
pilot.json    what the pilot measured, and its key; another question of the same capture takes it

The key is a digest of photographs, wishes, code, libraries and the knobs that the user fixed. The same question of the
same things gets the stored answer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.run import closure, formats
from pipeline.run.errors import ManifestError
from pipeline.run.runner import Build, is_complete
from pipeline.run.settings import Settings
from pipeline.trade import model
from pipeline.trade.model import EXPECTED, FIGURES, FINEST, PILOT_WIDTH, Model, Setting
from pipeline.trade.pilot import FEW, Pilot, flux_sigma, stated
from pipeline.trade.work import LAST, code_of, digest_of, source_of

RUN, PILOT = "run.json", "pilot.json"
TRUTH = {"object": "object_rel_err", "shadow": "shadow_change_err"}  # figure -> its name among evaluate's
# Of what is asked, taken where it can be had: a run's own records say up to 2 % more than was predicted (desk), and it
# would warn of what it was solved for.
MARGIN = 0.95
Say = Callable[[str], None]


@dataclass(frozen=True)
class Question:
    """What a run may cost: an error of the final pixels, CPU seconds with the pilot's; either, or both.

    ``settle`` gives the settings with some knobs at these values; ``given`` names the knobs that the user set himself.
    """

    max_error: float | None
    time_budget: float | None
    settle: Callable[[Mapping[str, Any]], Settings]
    given: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.max_error is not None and not 0 < self.max_error < 1:
            raise ManifestError(f"--max-error: is {self.max_error:g}; expected a share between 0 and 1, as 0.02")
        if self.time_budget is not None and not 0 < self.time_budget < math.inf:
            raise ManifestError(f"--time-budget: is {self.time_budget:g}; expected CPU seconds above 0")

    @property
    def asked(self) -> dict[str, float]:
        """What was given of the two."""
        both = {"max_error": self.max_error, "time_budget": self.time_budget}
        return {name: value for name, value in both.items() if value is not None}

    def settings(self, changes: Mapping[str, Any]) -> Settings:
        """Resolved, knobs that the user fixed at his values."""
        free = {knob: value for knob, value in changes.items() if knob not in self.given}
        return self.settle(free).model_copy(update={"quality": "solved", "asked": self.asked})


def answer(question: Question, build: Build, say: Say) -> Settings:
    """The settings that the question asks for, after a pilot where none is known. ``build``: any settings; they change.

    Writes run.json. Raises ManifestError when nothing answers, naming what could be had.
    """
    build.settings = question.settings(Setting(FEW[-1], PILOT_WIDTH).changes)
    key = key_of(build)
    known = read(build.out / RUN)
    if known.get("key") == key and known.get("asked") == question.asked:
        say(f"{build.out / RUN}: asked before; its settings are taken")
        return question.settings(known["settings"])
    old = read(build.out / PILOT)
    pilot = Pilot(build, old["pilot"] if old.get("key") == key else None)
    if not pilot.record:
        say("pilot: the stages before the render, and three small renders")
        pilot.begin()
    setting, found = chosen(question, build, pilot)
    if setting.samples > FEW[-1] and pilot.is_short:
        say("pilot: one more small render, of more samples")
        pilot.extend()
        setting, found = chosen(question, build, pilot)
    write(build.out / PILOT, {"key": key, "pilot": pilot.record})
    check(question, found, setting, pilot.record)
    told = {
        "asked": question.asked,
        "predicted": foretold(found, setting, pilot.record),
        "reached": None,
        "settings": {knob: value for knob, value in setting.changes.items() if knob not in question.given},
        "key": key,
    }
    write(build.out / RUN, told)
    say(in_words(told))
    return question.settings(setting.changes)


def key_of(build: Build) -> str:
    """Digest of all that an answer depends on but the question. Runs ingest, which is quick."""
    source, _ = source_of(build, "")
    code = code_of(build.graph) | {"pilot": closure.digest("pipeline.trade.pilot")}
    params = {stage.name: build.settings.params[stage.name] for stage in build.graph.upto(LAST)}
    return digest_of([source, code, build.versions, params])


def chosen(question: Question, build: Build, pilot: Pilot) -> tuple[Setting, Model]:
    """The best setting for the question, or that nearest to it; and the model that says so."""
    found = model.fitted(pilot.record)
    if not found.sampling:
        raise ManifestError(
            "--max-error, --time-budget: the pilot shows too little of an object or its shadow to measure an error; "
            "put a larger one into scene.toml, or take --quality"
        )
    params = build.settings.params
    fixed = {knob: params[knob.split(".")[0]][knob.split(".")[1]] for knob in question.given if knob in FINEST.changes}
    among = model.candidates(fixed)
    if question.max_error is not None:
        setting = model.cheapest(found, among, MARGIN * question.max_error)
    else:
        assert question.time_budget is not None
        setting = model.best_within(found, among, question.time_budget - pilot.record["cpu_seconds"])
    if setting is None and question.max_error is not None:
        setting = min(among, key=found.error)
    return setting or min(among, key=found.left), found


def check(question: Question, found: Model, setting: Setting, pilot: Mapping[str, Any]) -> None:
    """Raise ManifestError when the setting, which is the nearest, is not what was asked."""
    error, seconds = found.error(setting), found.left(setting) + pilot["cpu_seconds"]
    if question.max_error is not None and error > question.max_error:
        least = math.ceil(error * 1e4) / 1e4
        which = "the finest setting, as final's" if setting == FINEST else "the finest that the given knobs leave"
        which += f" ({setting.samples} samples, a map of {setting.width} px)"
        raise ManifestError(
            f"--max-error: is {question.max_error:g}; {which}, is predicted to err by {error:.4f}, "
            f"most of it {largest(found.parts(setting))}; ask {least:g} or more"
        )
    if question.time_budget is not None and seconds > question.time_budget:
        where = f" for an error of {question.max_error:g}" if question.max_error is not None else ""
        raise ManifestError(
            f"--time-budget: is {question.time_budget:g} CPU seconds; {seconds:.0f} are needed{where}, of which the "
            f"pilot took {pilot['cpu_seconds']:.0f}; ask {math.ceil(seconds)} or more"
            + (", or allow a larger error" if where else "")
        )


def largest(parts: Mapping[str, Mapping[str, float]]) -> str:
    """The largest part of the larger figure (as `Model.parts` has them), in words."""
    figure = max(parts, key=lambda name: parts[name]["all"])
    name = max((part for part in parts[figure] if part != "all"), key=lambda part: parts[figure][part])
    words = {
        "sampling": "noise of sampling",
        "map": "the map's width",
        "lamp": "the flux of lamps",
        "stated": "what the photographs leave uncertain",
    }
    return f"{words[name]}, in {figure} pixels"


def foretold(found: Model, setting: Setting, pilot: Mapping[str, Any]) -> dict[str, Any]:
    """The prediction as run.json has it."""
    cost = found.cost(setting)
    return {
        "error": found.error(setting),
        "figures": found.parts(setting),
        "cpu_seconds": found.seconds(setting),
        "stages": cost,
        "still_to_run": [name for name in cost if name in found.rest(setting)],
        "with_pilot_cpu_seconds": found.left(setting) + pilot["cpu_seconds"],
        "pilot_cpu_seconds": pilot["cpu_seconds"],
        "wall_seconds_at_the_pilots_pace": found.left(setting) * pilot["wall_over_cpu"],
        "stated": pilot["stated"],
        "not_in_it": pilot["bounds"],
    }


def note(build: Build) -> str:
    """Write into run.json what a finished run reached, and say it in a line, a warning of what was missed in another.

    Empty when there is nothing to say.

    ``error`` is the model's, with what this run's own records say: noise of its samples, uncertainties of its stages.
    ``against_truth`` is what `insitu evaluate` found, where there is truth.
    """
    told, pilot = read(build.out / RUN), read(build.out / PILOT)
    records = {stage.name: build.record(stage.name) for stage in build.graph.upto(LAST)}
    if not (told and pilot and told.get("asked") == build.settings.asked):
        return ""
    if any(record is None or not is_complete(record) for record in records.values()):
        return ""
    figures = posterior(build, told["predicted"]["figures"], pilot["pilot"])
    truth = against_truth(build)
    costs = {name: float(record["cpu_seconds"]) for name, record in records.items() if record}
    reached = {
        "error": max(part["all"] for part in figures.values()),
        "figures": figures,
        "cpu_seconds": math.fsum(costs.values()),
        "with_pilot_cpu_seconds": told["predicted"]["pilot_cpu_seconds"]
        + math.fsum(costs[name] for name in told["predicted"]["still_to_run"]),
        "stages": costs,
        "against_truth": truth and {"error": max(truth.values()), **truth},
    }
    over = missed(told["asked"], reached)
    write(build.out / RUN, told | {"reached": reached, "warnings": over})
    seconds = f"{reached['cpu_seconds']:.0f} CPU s (predicted {told['predicted']['cpu_seconds']:.0f})"
    against = f", {max(truth.values()):.4f} against truth" if truth else ""
    predicted = f"(predicted {told['predicted']['error']:.4f})"
    line = f"reached: error {reached['error']:.4f} by its own records {predicted}{against}; {seconds}"
    return "\n".join([line, *(f"warning: {text}" for text in over)])


def missed(asked: Mapping[str, float], reached: Mapping[str, Any]) -> list[str]:
    """What a finished run did not keep of what was asked, a sentence each: by its own records, not by truth."""
    error, seconds, found = reached["error"], reached["with_pilot_cpu_seconds"], []
    if error > asked.get("max_error", math.inf):
        found.append(
            f"--max-error: was {asked['max_error']:g}; the run's own records say {error:.4f}; ask less than was asked"
        )
    if seconds > asked.get("time_budget", math.inf):
        found.append(f"--time-budget: was {asked['time_budget']:g} CPU seconds; {seconds:.0f} were taken")
    return found


def posterior(build: Build, predicted: Mapping[str, Any], pilot: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The predicted parts, noise scaled to what the run's samples had of it, and stated uncertainties as now stated."""
    numbers = (build.record("render") or {"numbers": {}})["numbers"]
    samples = build.settings.params["render"]["samples"]
    last = pilot["renders"][-1]
    expected = last["noise"] * math.sqrt(last["samples"] / samples)
    ratio = numbers["object_noise_rel"] / expected if expected and numbers.get("object_noise_rel") else 1.0
    anew = stated(build)
    surer = flux_sigma(build) / pilot["flux_sigma"] if pilot["flux_sigma"] else 1.0
    found = {}
    for figure in (name for name in FIGURES if name in predicted):
        old = predicted[figure]
        parts = {
            "sampling": old["sampling"] * ratio,
            "map": old["map"],
            "lamp": old["lamp"] * surer,
            "stated": EXPECTED * math.hypot(0.0, *anew[figure].values()),
        }
        found[figure] = parts | {"all": math.hypot(*parts.values())}
    return found


def against_truth(build: Build) -> dict[str, float]:
    """Both figures as evaluate found them for this composite; empty without truth, or before evaluate."""
    record = build.record("evaluate")
    composite = build.record(LAST)
    if record is None or composite is None or record["inputs"].get("composite") != composite["outputs"]["composite"]:
        return {}
    found = {figure: record["numbers"].get(name) for figure, name in TRUTH.items()}
    return {figure: value for figure, value in found.items() if value is not None}


def in_words(told: Mapping[str, Any]) -> str:
    """One line on an answer."""
    predicted = told["predicted"]
    knobs = ", ".join(f"{knob} {value}" for knob, value in told["settings"].items())
    return f"predicted: error {predicted['error']:.4f}, {predicted['cpu_seconds']:.0f} CPU s; {knobs}"


def read(path: Path) -> dict[str, Any]:
    """A JSON file; empty when it is missing or damaged."""
    try:
        found = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write(path: Path, told: Mapping[str, Any]) -> None:
    """A JSON file."""
    formats.write_bytes(path, json.dumps(told, indent=1).encode() + b"\n")
