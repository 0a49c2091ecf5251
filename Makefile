# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs/demo
LOCKED := --no-deps --require-hashes --requirement requirements-ci.txt

.PHONY: setup demo test slow faults test-matrix lock lint types docs tutorials check-tutorials dist clean

setup: $(VENV)/.ready

# What users need. torch first, from the CPU wheel: anything that lets pip choose another torch downloads gigabytes of
# CUDA packages; HASHES=1 takes the files of requirements-ci.txt and no others (Python 3.11, x86-64 Linux)
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(if $(HASHES),--no-deps) $$(grep '^torch==' constraints.txt)
ifdef HASHES
	$(BIN)/python -m pip install --quiet $(LOCKED)
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m pip check
else
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[hdf5,lerobot,video]'
	$(BIN)/python -m pip install --quiet --no-deps $$(grep '^dm-control==' constraints.txt)  # all but labmaze
endif
	touch $@

# and what tests, types and documentation need
$(VENV)/.ready: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet $(if $(HASHES),$(LOCKED),--constraint constraints.txt --editable '.[dev]')
	touch $@

# demonstrations, training with 2 % of the labels, 60 rollouts, report
demo: $(VENV)/.installed
	$(BIN)/koap demos --task avoiding --episodes 96 --seed 0 --out $(OUT)-data
	$(BIN)/koap train --task avoiding --dataset $(OUT)-data --labels 0.02 --seed 0 --out $(OUT)
	$(BIN)/koap eval $(OUT) --episodes 60 --seed 100

test: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -q

slow: setup
	$(BIN)/python -m pytest -q -m slow

# every fault of the ledger
faults: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -q -m "faults or not faults" tests/faults
	$(BIN)/python -m pytest -n 2 --dist worksteal -q -m faults tests/commands tests/studies

# lowest and newest dependencies on every Python that is here (needs uv); TORCH is the version of the CPU wheels
test-matrix:
	$(PYTHON) tests/try_versions.py

# what CI installs, with checksums (needs uv)
lock:
	mkdir -p build
	uv pip compile --quiet --generate-hashes --no-emit-package torch --no-annotate --no-header --extra dev \
	    --python-version 3.11 --python-platform x86_64-manylinux_2_28 --constraint constraints.txt pyproject.toml \
	    --output-file build/requirements-ci.txt
	(grep '^# ' requirements-ci.txt; cat build/requirements-ci.txt) > build/lock && mv build/lock requirements-ci.txt

lint: types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

# the site in build/docs/html, without network; warnings are errors, links inside are checked
docs: setup
	$(BIN)/python -m sphinx -W --keep-going -q -j auto -d build/docs/doctrees docs build/docs/html
	@echo "site: build/docs/html/index.html"

# runs every tutorial and keeps output and pictures for the site
tutorials: setup
	$(BIN)/python docs/extensions/run_tutorials.py

# runs them, or those named by TUTORIALS, and compares what they print with what the site shows; nothing is kept
check-tutorials: setup
	$(BIN)/python docs/extensions/run_tutorials.py --check --jobs 2 $(TUTORIALS)

# wheel and sdist, tried in a fresh environment outside of the repository
dist: setup
	rm -rf dist build/lib
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(BIN)/python tests/try_dist.py dist

clean:
	rm -rf $(VENV) runs build dist docs/generated *.egg-info
