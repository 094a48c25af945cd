# One verb per chore. Each target makes its own virtual environment in .venv and does nothing twice.

PYTHON ?= python3.11
JOBS ?= 2
BIN := .venv/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check

.PHONY: help run test check bench clean

help:
	@echo "make run    run two long-horizon episodes and print their table"
	@echo "make test   run every test, the fast ones first"
	@echo "make check  ruff, mypy, import-linter"
	@echo "make bench  speed and memory, with ratios"
	@echo "make clean  remove the virtual environment and caches"

run: .venv/run.stamp
	@$(BIN)/cosim run long-horizon --policy route --episodes 2 --jobs $(JOBS)

test: .venv/dev.stamp
	@$(BIN)/python -m pytest -m "not engine"
	@$(BIN)/python -m pytest -m engine -n $(JOBS) --dist loadfile

check: .venv/dev.stamp
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo

bench: .venv/run.stamp
	@$(BIN)/cosim bench

.venv/pip.stamp:
	@command -v $(PYTHON) >/dev/null || { echo "Python 3.11 is needed: no '$(PYTHON)' here. Name yours: make PYTHON=/path/to/python3.11"; exit 1; }
	@echo "Setting up .venv (once) ..."
	@$(PYTHON) -m venv .venv
	@touch $@

.venv/run.stamp: .venv/pip.stamp pyproject.toml
	@$(PIP) install --editable .
	@touch $@

.venv/dev.stamp: .venv/run.stamp pyproject.toml
	@$(PIP) install --editable '.[dev]'
	@touch $@

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
