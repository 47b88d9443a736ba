# make venv | reproduce | test | trust | lint | bench | clean. All but the first make the environment they need.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
DEVELOPER := .venv/.installed-dev
PIP := $(BIN)/python -m pip install --quiet -c constraints.txt

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help venv venv-dev reproduce test lint warmup check-tables pytest trust bench clean

help:
	@echo "make venv        .venv to plan and reproduce with, pinned in constraints.txt (PYTHON=python3.11 picks another)"
	@echo "make venv-dev    the same with torch and tools, to train, test and develop"
	@echo "make reproduce   20 problems of the place task, all planners, and their table"
	@echo "make test        lint, table regression, tests"
	@echo "make trust       attack what docs/guarantees.md promises, for two hours, and write the figures there"
	@echo "make lint        ruff, mypy, import-linter"
	@echo "make bench       what kernels and planners cost here"
	@echo "make clean       remove caches and builds; .venv and runs/ stay"

venv: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or newer is needed: make venv PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
	$(PIP) -e .
	@touch $@

venv-dev: $(DEVELOPER)

$(DEVELOPER): $(STAMP)
	$(PIP) -e '.[dev,train]'
	@touch $@

warmup: venv
	$(BIN)/cvqmpt warmup

reproduce: warmup
	$(BIN)/cvqmpt reproduce place-task --problems 20 --seeds 1 --cutoff 10 --out runs/place-task-small

lint: venv-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check-tables: venv
	$(BIN)/cvqmpt check-tables

pytest: venv-dev
	$(BIN)/pytest -n 2

# Tests come last, so that their summary is the last thing printed.
test: lint warmup check-tables pytest

trust: venv-dev warmup
	nice $(BIN)/cvqmpt trust --long --record docs/guarantees.md

bench: warmup
	$(BIN)/cvqmpt bench kernels
	$(BIN)/cvqmpt bench planners

clean:
	rm -rf build ./*.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +
