# Everything runs in .venv, which the first command makes; TORCH and PYTHON may be set on the command line.
PYTHON ?= python3
# the version that the published results were measured with; any torch >= 2.8 does
TORCH ?= torch==2.13.0
# where it is from: TORCH_INDEX=https://download.pytorch.org/whl/cpu is the build without CUDA
TORCH_INDEX ?=
VENV := .venv
BIN := $(VENV)/bin
SOURCES := sb3_lac battery_env benchmarks checks tests examples docs

.DEFAULT_GOAL := help
.PHONY: help install demo test test-attacks test-browser test-oldest format lint type-check docs commit-checks clean

help:  ## list the commands
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

# pip has much to say: it is shown only if the command fails
logged = ($(1)) > $(VENV)/install.log 2>&1 || { cat $(VENV)/install.log >&2; exit 1; }
comma := ,
$(VENV)/.installed: EXTRAS := zoo$(comma)peers$(comma)onnx$(comma)dev$(comma)docs
# what the demo needs; after make install it needs nothing more
$(VENV)/.demo: EXTRAS := zoo
# without the RL Zoo, which needs a newer Stable-Baselines3
OLDEST_EXTRAS := peers$(comma)onnx$(comma)dev$(comma)docs

# one stamp per state of the packaging files: made again when they change
$(VENV)/.installed $(VENV)/.demo: setup.cfg pyproject.toml battery_env/setup.cfg battery_env/pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "Python 3.10 or newer is needed: make PYTHON=...")'
	@echo "making $(VENV)"
	@mkdir -p $(VENV)
	@$(call logged,test -x $(BIN)/python || $(PYTHON) -m venv $(VENV))
	@$(call logged,$(BIN)/python -m pip install --upgrade pip)
	@echo "installing $(TORCH)"
	@$(call logged,$(BIN)/python -m pip install $(addprefix --index-url ,$(TORCH_INDEX)) "$(TORCH)")
	@echo "installing battery_env and sb3_lac, with the extras $(EXTRAS)"
	@$(call logged,$(BIN)/python -m pip install --editable "./battery_env[cyclers]" --editable ".[$(EXTRAS)]")
	@touch $@

install: $(VENV)/.installed  ## make .venv with everything in it

demo: $(firstword $(wildcard $(VENV)/.installed) $(VENV)/.demo)  ## LAC, SAC and TD3 learn R_o, then the life of a real cell: some minutes; figures in results/
	$(BIN)/python -m benchmarks.demo

test: install  ## all tests of the product but attacks
	$(BIN)/python -m pytest -n 2 --dist worksteal  # neighbours share their fixtures, and no worker is idle in the end

test-attacks: install  ## attacks: sweeps over faults, their sizes and places, studies, and what trains long
	$(BIN)/python -m pytest -n 2 --dist worksteal -m attacks

test-browser: install  ## the page for the bench in Chromium, which must be there; PICTURES=FOLDER keeps what is seen
	@$(call logged,$(BIN)/python -m pip install --editable ".[browser]")
	$(BIN)/python -m pytest -m browser

test-oldest:  ## those of both packages, with the oldest versions that setup.cfg names of all but torch
	$(PYTHON) -m venv --clear $(VENV)/oldest
	$(VENV)/oldest/bin/python -m pip install --quiet uv
	$(VENV)/oldest/bin/python -m pip install --quiet $(addprefix --index-url ,$(TORCH_INDEX)) "$(TORCH)"
	VIRTUAL_ENV=$(VENV)/oldest $(VENV)/oldest/bin/uv pip install --quiet --resolution lowest-direct \
		"$(TORCH)" ./battery_env ".[$(OLDEST_EXTRAS)]" "pyparsing==3.2.0"  # later ones warn of old versions of matplotlib
	$(VENV)/oldest/bin/python -m pytest -n 2 --dist worksteal tests/battery_env tests/sb3_lac

format: install  ## black, and what ruff can mend
	$(BIN)/python -m ruff check --fix $(SOURCES)
	$(BIN)/python -m black --quiet $(SOURCES)

lint: install  ## what ruff, black and the rules of checks/ find: of code, sizes, pages, the reference and published tables
	$(BIN)/python -m ruff check $(SOURCES)
	$(BIN)/python -m black --check --quiet $(SOURCES)
	$(BIN)/python -m pytest -q checks

type-check: install  ## mypy
	$(BIN)/python -m mypy

docs: install  ## the documentation site, in docs/_build/html
	rm -rf docs/_api docs/_build/html  # pages of names that are gone would stay, and the search lose entries
	$(BIN)/python -m sphinx -q -W --keep-going docs docs/_build/html

commit-checks: lint type-check docs test test-attacks  ## everything that must pass before a commit

clean:  ## remove what the build left (not .venv, not results)
	rm -rf build docs/_build docs/_api docs/_notebooks *.egg-info battery_env/*.egg-info .pytest_cache .mypy_cache .ruff_cache
