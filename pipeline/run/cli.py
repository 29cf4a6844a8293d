"""The ``insitu`` command: parses, calls, prints. The one place that turns an error into one line and an exit code.

Imports nothing heavy at the top, so that ``--help``, ``--version`` and a refused manifest answer at once.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pipeline
from pipeline.run import closure
from pipeline.run.errors import ArtifactError, InsituError, ManifestError

if TYPE_CHECKING:
    from pipeline.run.runner import Build
    from pipeline.run.settings import Settings

EPILOG = (
    "Exit codes: 0 done, 2 manifest or switch, 3 photographs, 4 build files, 5 external tool, 6 no unique answer, "
    "130 interrupted. Ctrl-C keeps the best picture so far, twice stops at once; the same command goes on."
)
LOOKING = {"display": "display", "view": "view of the display", "look": "look"}  # knobs of composite with a switch


def stage_names() -> tuple[str, ...]:
    """Stages in reading order."""
    from stages.order import NAMES

    return NAMES


class Help(argparse.Action):
    """Help of a verb; a stage's with its knobs, which are read only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it and leave."""
        parser.print_help()
        if stage := parser.get_default("stage"):
            from stages.knobs import KNOBS

            fields = KNOBS[stage].model_fields
            if fields:
                say("\nknobs, of scene.toml or of insitu run --set:")
            for name, field in fields.items():
                say(f"  {stage}.{name} ({field.default}): {field.description}")
        parser.exit()


def build_parser() -> argparse.ArgumentParser:
    """The command line: one verb per stage and a few that join them."""
    parser = argparse.ArgumentParser(prog="insitu", description="Put objects into a photograph.", epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"insitu {pipeline.__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def verb(name: str, text: str, capture: bool = True) -> argparse.ArgumentParser:
        sub = verbs.add_parser(name, help=text, description=text, add_help=False)
        sub.add_argument("-h", "--help", action=Help, nargs=0, help="show this help and exit")
        if capture:
            either = "?" if name == "evaluate" else None  # evaluate also takes --capture, as scoring scripts write it
            sub.add_argument("capture", type=Path, nargs=either, help="capture folder, or its capture.toml")
            sub.add_argument("--out", type=Path, help="build folder (default: build/<capture name>)")
        return sub

    def asking(sub: argparse.ArgumentParser) -> argparse.ArgumentParser:
        sub.add_argument("--scene", type=Path, help="scene.toml (default: the one beside capture.toml)")
        sub.add_argument("--quality", choices=["draft", "preview", "final"], help="preset (default: scene.toml's)")
        sub.add_argument("--set", action="append", default=[], metavar="STAGE.KNOB=VALUE", help="set one knob")
        sub.add_argument("--max-error", type=float, help="solve for settings that err by at most this share, as 0.02")
        sub.add_argument("--time-budget", type=float, metavar="CPU_S", help="and take at most so many CPU seconds")
        return looking(sub)

    def looking(sub: argparse.ArgumentParser) -> argparse.ArgumentParser:
        for knob, text in LOOKING.items():
            sub.add_argument(f"--{knob}", help=f"{text} of the OCIO config ($OCIO, else a built-in one)")
        return sub

    board = verb("board", closure.summary("stages.board"), capture=False)
    board.add_argument("--paper", choices=["A4", "Letter"], required=True, help="A4 or Letter")
    board.add_argument("--out", type=Path, default=Path("board.pdf"), help="the PDF (default: board.pdf)")
    init = verb("init", closure.summary("stages.init"), capture=False)
    init.add_argument("folder", type=Path, help="folder of photographs, searched with all folders below")
    init.add_argument("-o", dest="out", type=Path, help="write it here (default: print it); never overwrites")
    check = verb("check", closure.summary("stages.check"), capture=False)
    check.add_argument("capture", type=Path, help="folder of photographs, or a capture.toml")
    check.add_argument("--json", action="store_true", help="print the findings as JSON")
    run = asking(verb("run", "run every stage that is not up to date, in one process"))
    run.add_argument("--upto", help="last stage to run")
    asking(verb("settings", "resolve what a run is asked into settings.json"))
    verb("summary", "print results, errors against truth and seconds per stage")
    maps = verb("stmap", closure.summary("stages.stmap"))
    maps.add_argument("--to", type=Path, help="folder of the maps (default: stmap in the build folder)")
    told = verb("needs", "say what was modelled and what was not, on what evidence, and what that could cost")
    told.add_argument("--json", action="store_true", help="print it as JSON")
    _trading(verb("trade", "measure what speed costs in accuracy: every knob alone, presets, combinations"))
    verb("verify", "recompute the digest of every file of a build")
    for name in stage_names():
        sub = verb(name, closure.summary(f"stages.{name}"))
        sub.set_defaults(stage=name)
        if name == "evaluate":
            _scoring(sub)
        if name == "composite":
            looking(sub)
    simulate = verb("simulate", closure.summary("stages.simulate"), capture=False)
    simulate.add_argument("scene", type=Path, help="SCENE.toml")
    simulate.add_argument("folder", type=Path, help="folder of the new capture")
    simulate.add_argument("--spectral", action="store_true", help="no capture: compare RGB with spectra on this scene")
    ball = verb("ball", closure.summary("stages.ball"), capture=False)
    ball.add_argument("files", type=Path, nargs="+", help="photographs of the ball, cropped to it, one per exposure")
    ball.add_argument("--out", type=Path, default=Path("ball.exr"), help="the map (default: ball.exr)")
    ball.add_argument("--exposures", help="seconds, as 1/20,1/60,..., where the files' metadata lack them")
    ball.add_argument("--distance-ratio", type=float, default=20.0, help="distance over radius of the ball (20)")
    ball.add_argument("--width", type=int, default=1024, help="of the map [px]; its height is half (1024)")
    verb("doctor", "say what was found on this machine, what is missing and what that costs", capture=False)
    figures = verb("figures", "print the page of figures of finished builds", capture=False)
    figures.add_argument("builds", type=Path, nargs="+", help="build folders")
    figures.add_argument("--picture", type=Path, help="also write plate and composite of the first build as JPEG")
    verb("rules", "print the generated make rules", capture=False)
    verb("docs", "print the table of stages, artifacts and knobs", capture=False)
    return parser


def _scoring(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--composite", type=Path, help="score this EXR instead of the build's composite")
    sub.add_argument("--plate", type=Path, help="the developed plate that belongs to it (default: the build's)")
    sub.add_argument("--probe", type=Path, help="score this lat-long EXR too")
    sub.add_argument("--capture", dest="capture_option", type=Path, help="the capture, instead of the argument")
    sub.add_argument(
        "--with-truth", metavar="NAMES", help="put truth in place of camera,pose,probe,albedo,places: where error is"
    )
    sub.add_argument(
        "--without",
        metavar="TERMS",
        help="force off alignment,exposures,sun,near_field,proxies,gloss,texture,bounces: what they are worth",
    )


def _trading(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--scene", type=Path, help="scene.toml (default: the one beside capture.toml)")
    sub.add_argument("--knobs", metavar="A.B,C.D", help="try these alone (default: all that have a ladder)")
    sub.add_argument("--set", action="append", default=[], metavar="STAGE.KNOB=VALUE", help="at every point")
    sub.add_argument("--quality", choices=["draft", "preview", "final"], default="preview", help="base (preview)")
    sub.add_argument("--repeats", type=int, default=2, help="further runs of the base, for the error bar (2)")
    sub.add_argument("--against", choices=["truth", "final"], default="", help="default: truth where there is one")
    sub.add_argument("--no-presets", action="store_true", help="leave the other presets out")
    sub.add_argument("--no-design", action="store_true", help="leave combinations out")
    sub.add_argument("--reuse", action="store_true", help="take finished stages of the build, and their seconds")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING, stream=sys.stderr)
    args = build_parser().parse_args(argv)
    share_cores()
    try:
        return dispatch(args)
    except InsituError as error:
        for line in str(error).splitlines() or [repr(error)]:
            say(f"insitu: {line}", stream=sys.stderr)
        return error.exit_code
    except PermissionError as error:  # of a file that none of the readers expects to be closed to it
        say(f"insitu: {error.filename}: {error.strerror}, needed to read or write it; allow that", stream=sys.stderr)
        return ArtifactError.exit_code
    except KeyboardInterrupt:
        say("insitu: interrupted; finished stages are kept, run the same command to go on", stream=sys.stderr)
        return 130


def share_cores() -> None:
    """What the libraries do with the cores, unless the user says otherwise; before any of them is imported.

    OpenBLAS gets one thread: matrices here are thin, and its further threads wait for work in a busy loop. Where other
    processes want the cores that is a sixth of the CPU seconds of a draft, and a fifth of its wall time.
    """
    os.environ.setdefault("OMP_NUM_THREADS", str(os.cpu_count()))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def say(text: str, stream: Any = None) -> None:
    """Print a line at once."""
    (stream or sys.stdout).write(text + "\n")
    (stream or sys.stdout).flush()


def dispatch(args: argparse.Namespace) -> int:
    """Do what was asked."""
    if args.verb == "evaluate":
        args.capture = args.capture or args.capture_option
        if args.capture is None:
            raise ManifestError("evaluate: no capture; expected a capture folder as argument or --capture")
    if args.verb == "simulate" and args.spectral:
        from stages.simulate import simulate_spectral

        simulate_spectral(args.scene, args.folder, say)
        say((args.folder / "spectral.md").read_text())
        return 0
    if args.verb == "simulate":
        from stages.simulate import simulate

        simulate(args.scene, args.folder, say)
        return 0
    if args.verb == "ball":
        from stages.ball import ball

        ball(args.files, args.out, args.exposures, args.distance_ratio, args.width, say)
        return 0
    if args.verb == "board":
        from stages.board import board

        board(args.paper, args.out, say)
        return 0
    if args.verb == "init":
        from stages.init import init

        init(args.folder, args.out, say)
        return 0
    if args.verb == "check":
        from stages.check import check

        return check(args.capture, args.json, say)
    if args.verb == "doctor":
        from pipeline.run.doctor import examine

        lines, healthy = examine()
        say("\n".join(lines))
        return 0 if healthy else 5
    if args.verb == "figures":
        from pipeline.run.figures import page, write_picture

        if args.picture:
            write_picture(args.builds[0], args.picture)
        say(page(args.builds, os.cpu_count() or 1, stage_names()))
        return 0
    if args.verb in ("rules", "docs"):
        from pipeline.run import derive
        from stages.knobs import KNOBS
        from stages.order import graph

        say(derive.rules(graph()) if args.verb == "rules" else derive.table(graph(), KNOBS))
        return 0
    if args.verb == "evaluate" and args.composite:
        from stages.evaluate import score_files

        scores = score_files(args.capture, args.composite, args.plate, args.probe, out_of(args))
        say(json.dumps(scores, indent=1))
        return 0
    if args.verb == "trade":
        return trading(args)
    return with_build(args)


def trading(args: argparse.Namespace) -> int:
    """Measure the trade of a capture."""
    from pipeline.run.manifest import load_capture
    from pipeline.run.settings import resolve
    from pipeline.trade.points import chosen_knobs, without_effect
    from stages.knobs import KNOBS, PRESETS

    if args.repeats < 0:
        raise ManifestError(f"--repeats: is {args.repeats}; expected 0 or more")

    def settle(quality: str, switches: list[str]) -> Settings:
        return resolve(args.capture, args.scene, quality, [*args.set, *switches], KNOBS, PRESETS)

    knobs = chosen_knobs(args.knobs)
    settle(args.quality, [])
    idle = without_effect(knobs, load_capture(args.capture)[0].views is not None)
    for knob, because in idle.items():
        say(f"{knob}: not tried, {because}")
    knobs = [knob for knob in knobs if knob not in idle]
    from pipeline.trade.trade import Asked, trade
    from stages.order import graph

    asked = Asked(
        out_of(args), settle, graph(), KNOBS, args.quality, knobs, args.repeats, not args.no_presets,
        not args.no_design, args.reuse, args.against,
    )  # fmt: skip
    trade(asked, say)
    return 0


def out_of(args: argparse.Namespace) -> Path:
    """The build folder: what was given, else build/<name of the capture>."""
    from pipeline.run.manifest import load_capture

    return args.out or Path("build") / load_capture(args.capture)[0].name


def resolved(args: argparse.Namespace) -> Settings:
    """Settings of this run. Raises ManifestError with every problem that the texts alone tell."""
    from pipeline.run.settings import resolve
    from stages.knobs import KNOBS, PRESETS

    switches = getattr(args, "set", [])
    chosen = resolve(
        args.capture, getattr(args, "scene", None), getattr(args, "quality", None), switches, KNOBS, PRESETS
    )
    if getattr(args, "max_error", None) is not None or getattr(args, "time_budget", None) is not None:
        chosen = solved(chosen, args)
    return looked_at(chosen, args)


def solved(chosen: Settings, args: argparse.Namespace) -> Settings:
    """The settings that --max-error and --time-budget ask for; a pilot runs where none is known."""
    from pipeline.run.settings import given, resolve
    from pipeline.trade.points import Point
    from stages.knobs import KNOBS, PRESETS

    if args.quality:
        raise ManifestError("--quality: is given with --max-error or --time-budget, which choose it; leave one out")

    def settle(changes: Mapping[str, Any]) -> Settings:
        switches = Point("", "", "", tuple(changes.items())).switches
        return resolve(args.capture, args.scene, "preview", [*switches, *args.set], KNOBS, PRESETS)

    from pipeline.trade.ask import Question, answer

    fixed = given(args.capture, args.scene, args.set, KNOBS)
    question = Question(args.max_error, args.time_budget, settle, fixed)
    from pipeline.run.progress import shown
    from pipeline.run.runner import Build
    from stages.order import graph

    with shown():
        return answer(question, Build(graph(), out_of(args), chosen, KNOBS), say)


def looked_at(chosen: Settings, args: argparse.Namespace) -> Settings:
    """The settings with the switches for looking put in. Raises ManifestError for what the OCIO config lacks."""
    from stages.knobs import KNOBS

    known = KNOBS["composite"]().model_dump()
    given = {knob: value for knob in LOOKING if (value := getattr(args, knob, None)) is not None}
    wanted = known | chosen.params["composite"] | given
    if os.environ.get("OCIO") or any(wanted[knob] != known[knob] for knob in LOOKING):
        import numpy as np

        from pipeline.image.display import display_transform

        display_transform(np.zeros((1, 1, 3)), **{knob: wanted[knob] for knob in LOOKING})  # now, not after rendering
    return chosen.model_copy(update={"params": {**chosen.params, "composite": wanted}}) if given else chosen


def with_build(args: argparse.Namespace) -> int:
    """Verbs that need a build folder."""
    from pipeline.run import settings as asked
    from pipeline.run.manifest import load_capture
    from stages.knobs import KNOBS

    last = getattr(args, "upto", None) or stage_names()[-1]
    if last not in stage_names():
        raise ManifestError(f"--upto: is {last!r}; expected one of {', '.join(stage_names())}")
    if args.verb in ("run", "settings"):
        chosen = resolved(args)
        out = out_of(args)
        if (out / "settings.json").exists() and (before := asked.load(out).capture) != chosen.capture:
            say(f"insitu: {out}: was a build of {before}, becomes one of {chosen.capture}", stream=sys.stderr)
        asked.save(chosen, out)
    else:
        out = out_of(args)
        if not (out / "settings.json").exists():
            asked.save(resolved(args), out)
        chosen = asked.load(out)
        if Path(chosen.capture) != (file := load_capture(args.capture)[1].resolve()):
            raise ManifestError(f"{out}: is a build of {chosen.capture}, not of {file}; give another --out")
        if any(getattr(args, knob, None) is not None for knob in LOOKING):
            chosen = looked_at(chosen, args)
            asked.save(chosen, out)
    if args.verb == "settings":
        return 0
    from pipeline.run.derive import print_summary
    from pipeline.run.formats import threads
    from pipeline.run.progress import shown
    from pipeline.run.runner import Build
    from stages.order import graph

    build = Build(graph(), out, chosen, KNOBS)
    if args.verb == "summary":
        say(print_summary(build))
        return 0
    if args.verb == "needs":
        from pipeline.run.needs import as_text, needs

        found = needs(build)
        say(json.dumps(found, indent=1) if args.json else as_text(found, build))
        return 0
    if args.verb == "verify":
        problems = build.verify()
        say("\n".join(problems) or f"{out}: every file is as its stage wrote it")
        return 4 if problems else 0
    if args.verb == "stmap":
        return straightened(args, build)
    with threads(), shown(), build.stop.listening():
        return at_work(args, build, last)


def straightened(args: argparse.Namespace, build: Build) -> int:
    """Lens maps of the plate's camera and of balls that have their own, after what they need."""
    from pipeline.run.artifacts import CAMERA, VIEW_CAMERAS
    from stages.stmap import stmap

    build.run_all(build.graph.upto("calibrate"), lambda *_: None)
    stmap({"plate": build.value(CAMERA), **build.value(VIEW_CAMERAS)}, args.to or build.out / "stmap", say)
    return 0


def at_work(args: argparse.Namespace, build: Build, last: str) -> int:
    """Verbs that compute."""
    from pipeline.run.derive import print_summary, unfinished

    given = (getattr(args, "with_truth", None), getattr(args, "without", None))
    names, terms = ([name.strip() for name in (text or "").split(",") if name.strip()] for text in given)
    if names or terms:
        from pipeline.run.substitution import FIGURES, waterfall

        say(f"{'truth in place of':<40}" + "".join(f"{key.removesuffix('_err')[:9]:>10}" for key in FIGURES))
        found = waterfall(build, names, say, terms)
        build.keep_waterfall(found)
        build.run(build.graph["report"])  # it shows the waterfall
        return 0
    stages = build.graph.upto(last) if args.verb == "run" else [build.graph[args.stage]]

    def tell(name: str, outcome: str, seconds: float) -> None:
        variant = (build.record(name) or {"numbers": {}})["numbers"].get("variant", "")
        say(f"{name:<12} {outcome:<6} {seconds:7.2f} s  {variant}".rstrip())

    build.run_all(stages, tell)
    if build.settings.asked:
        from pipeline.trade.ask import note

        if told := note(build):
            say(told)
    if args.verb == "run" and last == stage_names()[-1]:
        say(print_summary(build))
    if not build.stop.asked:
        return 0
    kept = ", ".join(unfinished(build)) or "everything that was asked for was done"
    say(f"insitu: interrupted; {kept}; run the same command to go on from there", stream=sys.stderr)
    return 130
