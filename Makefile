# insitu: `make demo` shows what it does, `make test` shows that it works, `make help` lists the rest.
MAKEFLAGS += --warn-undefined-variables --no-builtin-rules
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.SUFFIXES:
.DEFAULT_GOAL := help

CAPTURE ?= sample_captures/desk
SCENE ?=
export INSITU_DATA ?= $(abspath ../shared/data)
QUALITY ?=
MAX_ERROR ?=
TIME_BUDGET ?=
BENCH ?=
OUT ?= build/$(notdir $(CAPTURE:/=))
PYTHON ?= python3
VENV := .venv
READY := $(VENV)/.ready
INSITU := $(VENV)/bin/insitu
CAPTURE_FILES = $(shell find $(CAPTURE) -type f 2>/dev/null)

-include build/stages.mk

help: $(READY)  ## list the targets
	@grep -hE '^[a-z-]+:.*  ## ' $(MAKEFILE_LIST) | sed -E 's/:.*  ## /\t/' | expand -t 16

# Debian's python3 comes without ensurepip: the environment is made without pip, and the system's pip fills it.
$(READY): requirements.lock pyproject.toml
	@test -x $(VENV)/bin/python || $(PYTHON) -m venv --without-pip $(VENV)
	$(PYTHON) -m pip --python $(VENV)/bin/python install --quiet --require-hashes -r requirements.lock
	$(PYTHON) -m pip --python $(VENV)/bin/python install --quiet --no-deps --no-build-isolation -e .
	@touch $@

setup: $(READY)  ## create .venv with everything in it

build/stages.mk: $(READY) stages/order.py $(wildcard stages/*.py) $(wildcard pipeline/*/*.py)
	@mkdir -p build && $(INSITU) rules > $@.part && mv $@.part $@

$(OUT)/settings.json: FORCE | $(READY)
	@$(INSITU) settings $(CAPTURE) --out $(OUT) $(if $(QUALITY),--quality $(QUALITY)) $(if $(SCENE),--scene $(SCENE)) \
		$(if $(MAX_ERROR),--max-error $(MAX_ERROR)) $(if $(TIME_BUDGET),--time-budget $(TIME_BUDGET))

demo: $(OUT)/report/record.json  ## composite the bundled capture and say how good it is
	@$(INSITU) summary $(CAPTURE) --out $(OUT)

all: $(OUT)/report/record.json  ## every stage of CAPTURE

test: $(READY)  ## run the tests
	$(VENV)/bin/python -m pytest

test-all: $(READY)  ## run the slow tests too
	$(VENV)/bin/python -m pytest -m 'slow or not slow'

check: $(READY)  ## lint and type check
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check . && $(VENV)/bin/mypy

docs: $(READY)  ## regenerate stages/README.md
	@$(INSITU) docs > stages/README.md

SIMULATED ?= sample_captures/scenes/desk.toml
TO ?= build/simulated/$(basename $(notdir $(SIMULATED)))
simulate: $(READY)  ## make a capture with known truth from the scene SIMULATED, in the folder TO
	@$(INSITU) simulate $(SIMULATED) $(TO)

QUALITIES := final preview draft
FIGURES := $(addprefix build/figures/desk_,$(QUALITIES)) $(if $(wildcard $(INSITU_DATA)/captures/kitchen_table),$(addprefix build/figures/kitchen_table_,$(QUALITIES)))

figures: $(READY)  ## regenerate docs/figures.md and its picture (minutes)
	@for q in $(QUALITIES); do $(INSITU) run sample_captures/desk --quality $$q --out build/figures/desk_$$q; done
	@for q in $(if $(findstring kitchen,$(FIGURES)),$(QUALITIES)); do \
		$(INSITU) run tests/kitchen_table --quality $$q --out build/figures/kitchen_table_$$q; done
	@$(INSITU) evaluate sample_captures/desk --out build/figures/desk_preview --with-truth probe,pose,camera,albedo
	@$(INSITU) figures $(FIGURES) --picture docs/desk.jpg > docs/figures.md

HARD := counter courtyard lacquer cellar corner
TRUTHS_cellar := ,places
OFF_cellar := --without alignment,exposures,near_field
OFF_courtyard := --without sun
OFF_lacquer := --without gloss
OFF_corner := --without bounces
figures-hard: $(READY)  ## regenerate docs/figures_hard.md, of the other bundled captures (minutes)
	@for c in $(HARD); do for q in preview draft; do \
		$(INSITU) run sample_captures/$$c --quality $$q --out build/figures/$${c}_$$q; done; done
	@$(foreach c,$(HARD),$(INSITU) evaluate sample_captures/$(c) --out build/figures/$(c)_draft \
		--with-truth probe,pose,camera,albedo$(value TRUTHS_$(c)) $(value OFF_$(c)) &&) true
	@$(INSITU) figures $(foreach c,$(HARD),$(foreach q,preview draft,build/figures/$(c)_$(q))) > docs/figures_hard.md

extremes: $(READY)  ## run every case of tests/extremes/cases.toml, into docs/numerics.md, numerics.json and formulas.json
	$(VENV)/bin/python -m pytest -m extreme --extremes=docs tests

accuracy: $(READY)  ## regenerate docs/accuracy.md: what is promised beside what records of real runs say
	@$(VENV)/bin/python -m benchmarks.accuracy > docs/accuracy.md.part && mv docs/accuracy.md.part docs/accuracy.md

trade: $(READY)  ## measure what speed costs in accuracy on CAPTURE, into build/<capture>/trade (an hour or more)
	@$(INSITU) trade $(CAPTURE) --out $(OUT)

speed: trade  ## regenerate docs/speed.md and its picture from the trade of CAPTURE
	@cp $(OUT)/trade/trade.md docs/speed.md && cp $(OUT)/trade/trade.svg docs/trade.svg
	@mkdir -p docs/trade && cp $(OUT)/trade/presets.json docs/trade/$(notdir $(CAPTURE:/=)).json

bench-ask: $(READY)  ## ask errors and a time of the desk, and say what was reached, for docs/benchmarks
	@$(VENV)/bin/python -m benchmarks.ask

bench-ladders: $(READY)  ## force each rung that desk does not climb: change against what was stated, for docs/benchmarks
	@$(VENV)/bin/python -m benchmarks.ladders

bench-render: $(READY)  ## measure the render at equal error, for docs/benchmarks (BENCH=--full for more)
	@$(VENV)/bin/python -m benchmarks.render $(BENCH)

bench-zscore: $(READY)  ## test the fast strategy for bias against the reference, for docs/benchmarks (scenes are kept)
	@$(VENV)/bin/python -m benchmarks.zscore $(BENCH)

bench-probe: $(READY)  ## measure the probe against truth and peers, for docs/benchmarks
	@$(VENV)/bin/python -m benchmarks.probe $(BENCH)

bench-pose: $(READY)  ## measure poses against truth, plain OpenCV and pycolmap, for docs/benchmarks
	@$(VENV)/bin/python -m benchmarks.pose $(BENCH)

bench-colour: $(READY)  ## measure colours of measured cameras against spectra, for docs/benchmarks
	@$(VENV)/bin/python -m benchmarks.colour

bench-skylibs-env:  ## skylibs for bench-probe, in .skylibs
	@test -x .skylibs/bin/python || python3 -m venv --without-pip .skylibs
	python3 -m pip --python .skylibs/bin/python install --quiet skylibs

bench-budget: $(READY)  ## do stated uncertainties hold, over re-simulated captures, for docs/benchmarks (BENCH=100; hours)
	@$(VENV)/bin/python -m benchmarks.budget $(BENCH)

bench-merge: $(READY)  ## measure the merge against the noise bound, memory bandwidth and peers, for docs/benchmarks
	@$(VENV)/bin/python -m benchmarks.merge $(BENCH)

bench-merge-env:  ## HDRutils and colour-hdri for bench-merge, in .merge-peers (500 MB)
	@test -x .merge-peers/bin/python || python3 -m venv --without-pip .merge-peers
	python3 -m pip --python .merge-peers/bin/python install --quiet HDRutils colour-hdri

bench-cycles-env:  ## Blender's Cycles for bench-render, in .blender (Python 3.11, 1 GB)
	@test -x .blender/bin/python || python3.11 -m venv --without-pip .blender
	python3 -m pip --python .blender/bin/python install --quiet 'bpy==5.0.1' 'numpy<2'

verify: $(READY)  ## recompute the digests of a build
	@$(INSITU) verify $(CAPTURE) --out $(OUT)

lock: $(READY)  ## pin the dependencies with hashes
	$(VENV)/bin/pip-compile --quiet --extra dev --generate-hashes --no-emit-index-url --no-emit-find-links --allow-unsafe \
		--strip-extras --output-file requirements.lock pyproject.toml

clean:  ## remove what was built
	rm -rf build

FORCE:
.PHONY: bench-ladders bench-pose figures-hard accuracy extremes trade speed bench-budget bench-colour bench-render bench-zscore bench-cycles-env bench-probe bench-skylibs-env simulate help setup demo all test test-all check docs figures verify lock clean FORCE
