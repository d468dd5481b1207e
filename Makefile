# make demo   rovgraph demo: a dive, its track, and how far it is from the truth
# make test   linters, types and tests
# make matrix tests with the oldest and the newest numba, numpy, gtsam and pandas
# make docs   this documentation as pages, in build/site
# make mutants   faults are planted in a copy, and those that the fast tests miss are named
# Each makes the environment that it needs in .venv.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
DEMO   ?= results/demo

# Tests start many programs, which load faster from bytecode that is kept.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help venv demo test lint docs bench matrix mutants clean
.DELETE_ON_ERROR:

help:
	@sed -n 's/^# //p' Makefile | head -5

venv: $(VENV)/dev.stamp

$(VENV)/venv.stamp:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 || { \
	  echo "Python 3.11 or newer is needed, and $(PYTHON) is none; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; \
	  exit 2; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/run.stamp: $(VENV)/venv.stamp pyproject.toml
	$(PIP) --editable .
	@touch $@

$(VENV)/dev.stamp: $(VENV)/venv.stamp pyproject.toml
	$(PIP) --editable '.[dev]'
	@touch $@ $(VENV)/run.stamp

$(VENV)/docs.stamp: $(VENV)/venv.stamp pyproject.toml
	$(PIP) --editable '.[docs]'
	@touch $@ $(VENV)/run.stamp

demo: $(VENV)/run.stamp
	$(BIN)/rovgraph demo --out $(DEMO) --force

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/pytest -n 2 --dist loadfile -m 'not slow'

docs: $(VENV)/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

matrix:
	$(PYTHON) benchmarks/matrix.py

bench: $(VENV)/dev.stamp
	$(BIN)/python benchmarks/batch.py

mutants: $(VENV)/dev.stamp
	$(BIN)/python benchmarks/mutants.py

clean:
	rm -rf $(VENV) build dist rovgraph.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis $(DEMO)
