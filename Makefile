# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs/demo

.PHONY: setup demo test slow faults lint clean

setup: $(VENV)/.ready

# torch first, from the CPU wheel: anything that lets pip choose another torch downloads gigabytes of CUDA packages
$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $$(grep '^torch==' constraints.txt)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# demonstrations, training with 2 % of the labels, 60 rollouts, report
demo: setup
	$(BIN)/koap train --task avoiding --dataset scripted --label-fraction 0.02 --label-unit trajectory --seed 0 --out $(OUT)
	$(BIN)/koap eval $(OUT) --episodes 60 --seed 100
	@echo "report: $(OUT)/index.html"

test: setup
	$(BIN)/python -m pytest -n 2 -q

slow: setup
	$(BIN)/python -m pytest -q -m slow

# every fault of the ledger, and the state machines at length
faults: setup
	$(BIN)/python -m pytest -q -m "faults or not faults" tests/faults

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean:
	rm -rf $(VENV) runs build *.egg-info
