# Two commands: `make demo` and `make test`. Both make their own environment in .venv.
# `make test-slow` adds slow tests: whole runs, compiled against eager, images beside Mitsuba's;
# `make test-long` those of half a minute or more, by hand: the whole loss against differences, a whole
# sweep, two hosts, another process. `.ci/run` runs the first, and of the second what fits into half an hour.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
INSTALLED = $(VENV)/.installed
DEMO = demo

.PHONY: demo test test-slow test-compiling test-computing test-long lint format bench docs clean

$(INSTALLED): pyproject.toml
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "geosplat_jax needs Python 3.11 or newer, got " + sys.version'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@

demo: $(INSTALLED)
	$(BIN)/python experiments/demo.py --output $(DEMO)

# Files in the order of tests/conftest.py; pytest would begin with those of most tests.
IN_FILES = --numprocesses 2 --dist loadfile --no-loadscope-reorder

test: $(INSTALLED)
	$(BIN)/python -m pytest $(IN_FILES) -m 'not slow'

test-slow:
	$(MAKE) test-compiling
	$(MAKE) test-computing

test-compiling: $(INSTALLED)
	$(BIN)/python -m pytest $(IN_FILES) -m 'slow and not computes and not long'

# These compute more than they compile: with the optimisations that the others do without.
test-computing: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test,scene]'
	XLA_FLAGS= $(BIN)/python -m pytest --numprocesses 2 --dist loadgroup -m 'slow and computes and not long'

test-long: $(INSTALLED)
	$(BIN)/python -m pytest $(IN_FILES) -m 'long and not computes'
	XLA_FLAGS= $(BIN)/python -m pytest --numprocesses 2 --dist load -m 'long and computes'

lint: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright --pythonpath $(BIN)/python

format:
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

bench: $(INSTALLED)
	$(BIN)/python -m benchmarks.suite

# Writes build/docs/index.html, which opens from disk; links that lead nowhere are errors.
docs: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info
