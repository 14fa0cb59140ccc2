# Short commands. `make run` and `make test` do everything on a fresh machine.
VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin

# Python writes the bytecode of what it imports, once for all processes; pip would compile three times as many files, on one core.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: run test suite long quick lint format docs clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install -q -e .
	touch $@

$(VENV)/.test: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install -q --no-compile -e '.[test]'
	touch $@

run: $(VENV)/.run           ## install, then train on the Lego scene (or the built-in bricks)
	$(BIN)/python -m nerf_lightning +experiment=lego

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: $(VENV)/.test         ## install, check style and types, and run the tests meanwhile
	$(MAKE) -j2 lint suite

suite: $(VENV)/.test
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses=4 --dist worksteal

long: $(VENV)/.test         ## what a test run leaves out: launchers of sweeps, kernels of a compiler, the notebook, whole runs on a pretended device
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m long

QUICK := $(wildcard tests/test_import_layers.py tests/test_line_budget.py $(addprefix tests/, cameras sampler renderer cli/test_app.py dataset/test_rays.py dataset/test_npz.py) \
	tests/runs/test_folder.py $(addprefix tests/config/test_, defaults.py learning_rates.py resolvers.py))

quick: $(VENV)/.test        ## what a change most likely breaks, in half a minute
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses=4 --dist worksteal $(QUICK)

format: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/.docs: $(BIN)/python pyproject.toml
	$(BIN)/python -m pip install -q -e '.[docs]'
	touch $@

docs: $(VENV)/.docs         ## the documentation as a site, in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .mypy_cache site
