# Two commands: `make demo` runs the main job on the built-in duets, `make test` passes the tests.
# Both make .venv when it is missing and need Python 3.11+, make and a package index, nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STORE ?= store

.PHONY: demo test lint docs setup blender film soak faults mutants clean

$(VENV)/.installed: pyproject.toml deploy/constraints.txt
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), f"Python 3.11 or newer is needed, this is {sys.version.split()[0]}; say make PYTHON=python3.11"'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --constraint deploy/constraints.txt --editable .
	touch $@

$(VENV)/.tested: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint deploy/constraints.txt --group test
	touch $@

setup: $(VENV)/.tested

demo: $(VENV)/.installed
	@$(BIN)/python -c 'import importlib.util as u; u.find_spec("torch") or print("torch is not installed: duets has no networks and does without (make setup brings it)")'
	$(BIN)/pasdedeux run duets --store $(STORE)

lint: $(VENV)/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: $(VENV)/.tested lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadgroup

# Builds the site of the documentation into docs/_build; every warning is an error.
docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint deploy/constraints.txt --group docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build
	@echo "open docs/_build/index.html"

# Half an hour in which something of a toy build is killed every 20 s; not among the tests.
soak: $(VENV)/.tested
	$(BIN)/python -m tests.fault.soak --minutes 30 --every 20

# Plants faults in copies of the sources and tells which of them no test notices, half an hour; not among the tests.
faults: $(VENV)/.tested
	$(BIN)/python -m tests.planted_faults

# Draws mutants of the packages and tells which of them no test notices, an hour or two; not among the tests.
N ?= 100
SEED ?= 0
mutants: $(VENV)/.tested
	$(BIN)/python -m pip install --quiet --constraint deploy/constraints.txt --group mutants
	$(BIN)/python -m tests.mutants --number $(N) --seed $(SEED)

# Loads files of `pasdedeux reconstruct` into Blender; its module is large and GPL, so it has an environment of its own.
blender:
	test -x $(VENV)-blender/bin/python || $(PYTHON) -m venv $(VENV)-blender
	$(VENV)-blender/bin/python -m pip install --quiet bpy numpy usd-core
	$(VENV)-blender/bin/python benchmarks/blender_check.py $(FILES)

# What a real network sees of real film, and what becomes of it; needs the store of `make demo`.  The network comes with
# mediapipe, the film with a package under the GPL: both stay in an environment of their own.
FILM := $(VENV)-film
DANCER := $(FILM)/unpacked/musicalgestures/examples/dancer.avi
film: $(VENV)/.installed
	test -x $(FILM)/bin/python || $(PYTHON) -m venv $(FILM)
	$(FILM)/bin/python -m pip install --quiet mediapipe==0.10.21
	$(FILM)/bin/python -m pip download --quiet --no-deps --dest $(FILM) musicalgestures==1.32.0
	$(FILM)/bin/python -m zipfile -e $(FILM)/musicalgestures-1.32.0-py3-none-any.whl $(FILM)/unpacked
	$(FILM)/bin/python benchmarks/film_check.py $(DANCER) $(FILM)/dancer.csv
	$(BIN)/pasdedeux annotate $(DANCER) --detections $(FILM)/dancer.csv --out $(FILM)/annotations.csv \
		--sheet $(FILM)/next.png --overlay $(FILM)/seen.mp4
	$(BIN)/pasdedeux reconstruct $(DANCER) --detections $(FILM)/dancer.csv --database projections:duets \
		--store $(STORE) --out $(FILM)/out

clean:
	rm -rf $(VENV) build dist *.egg-info
