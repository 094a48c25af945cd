# One verb per chore. Each looks first whether the machine has what is needed, makes its virtual environment in .venv and
# does nothing twice.

PYTHON ?= python3.11
JOBS ?= 2
# Tests often wait for other processes: three of pytest keep two cores busy.
WORKERS ?= 3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: help run test check docs bench lock clean machine

help:
	@echo "make run    run two long-horizon episodes and print their table"
	@echo "make test   run every test, the longest first; the fast ones alone: pytest -m 'not engine'"
	@echo "make check  ruff, mypy, import-linter"
	@echo "make docs   the documentation as a site in build/docs, every warning an error"
	@echo "make bench  speed and memory, with ratios"
	@echo "make lock   write the lock files anew after a change of pyproject.toml"
	@echo "make clean  remove the virtual environment and caches"

run: .venv/run.stamp | machine
	@$(BIN)/cosim run long-horizon --policy orca --episodes 2 --jobs $(JOBS)

test: .venv/dev.stamp | machine
	@$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

check: .venv/dev.stamp | machine
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo

# Links to other sites are not fetched.
docs: .venv/docs.stamp | machine
	@$(BIN)/python -m sphinx -b html -W --keep-going -n -q -d build/doctrees docs build/docs
	@echo "The documentation is in build/docs/index.html"

bench: .venv/run.stamp | machine
	@$(BIN)/cosim bench

# Any Python 3 can look; root on Debian or Ubuntu gets what is missing installed, others are told and stopped.
machine:
	@python=$$(command -v $(PYTHON) || command -v python3) || { \
	  echo "error: there is no $(PYTHON). On Debian, as root: apt-get install python3.11 python3.11-venv" >&2; exit 3; }; \
	$$python -I cosim/machine.py --install --python $(PYTHON)

.venv/pip.stamp: | machine
	@echo "Set-up, 1 of 3: a virtual environment in .venv"
	@$(PYTHON) -m venv .venv
	@touch $@

.venv/run.stamp: .venv/pip.stamp requirements.lock pyproject.toml | machine
	$(call install,requirements.lock)
	@touch $@

.venv/dev.stamp: .venv/pip.stamp requirements-dev.lock pyproject.toml | machine
	$(call install,requirements-dev.lock)
	@touch .venv/run.stamp $@

.venv/docs.stamp: .venv/pip.stamp requirements-docs.lock pyproject.toml | machine
	$(call install,requirements-docs.lock)
	@touch $@

# Python compiles a module when it is first imported: doing all of them here would double the time of the set-up.
define install
@echo "Set-up, 2 of 3: the packages of $(1), each held against its hash"
@$(PIP) install --no-compile --require-hashes --requirement $(1)
@echo "Set-up, 3 of 3: cosim itself"
@$(PIP) install --quiet --no-deps --no-build-isolation --editable .
@echo "Set-up is done."
endef

# Packages that are locked stay as they are while pyproject.toml allows it; delete the files to take the newest of all.
UV := .venv/lock/bin/uv --no-config pip compile --quiet --generate-hashes --no-emit-index-url --no-annotate
lock: | machine
	@test -x .venv/lock/bin/uv || { $(PYTHON) -m venv .venv/lock && .venv/lock/bin/python -m pip install --quiet uv; }
	@set -e; lock() { $(UV) --custom-compile-command "make lock" --python-version 3.11 \
	  --python-platform x86_64-manylinux_2_28 pyproject.toml --group build "$$@"; }; \
	lock --output-file requirements.lock; \
	lock --output-file requirements-dev.lock --extra dev --constraint requirements.lock; \
	lock --output-file requirements-docs.lock --extra docs --constraint requirements-dev.lock

clean:
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
