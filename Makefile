# make venv | reproduce | test | docs | notebooks | trust | lint | wheel | bench | clean. All but the first make the environment they need.
PYTHON ?= python3
BIN := .venv/bin
ALL := '.[dev,docs,train]'
STAMP := .venv/.installed
DEVELOPER := .venv/.installed-dev
# Python compiles a module when it is first imported; to compile all packages takes more than a minute.
PIP := $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt
# uv, where it is installed, needs half a minute where pip needs minutes; where it reaches no index, pip may.
install = { command -v uv >/dev/null && uv pip install --quiet --python $(BIN)/python -c constraints.txt $(1); } || $(PIP) $(1)

.DEFAULT_GOAL := help
# Without files of bytecode every process of a test compiles all Python that it imports again.
unexport PYTHONDONTWRITEBYTECODE
.PHONY: help venv venv-dev locked inventory audit reproduce test lint warmup check-tables docs notebooks pytest trust wheel bench clean

help:
	@echo "make venv        .venv to plan and reproduce with, pinned in constraints.txt (PYTHON=python3.11 picks another)"
	@echo "make venv LOCKED=1   the same from locked.txt, where pip refuses whatever has not the hash that stands there"
	@echo "make venv-dev    the same with torch and tools, to train, test and develop"
	@echo "make reproduce   20 problems of the place task: all planners, and the paper's experiment in OMPL"
	@echo "make test        lint, table regression, the site with all notebooks run, tests"
	@echo "make notebooks   run all notebooks and store their outputs in them"
	@echo "make docs        docs/*.html, and the site in build/site: README, docs, results, the API, notebooks with outputs compared with the stored ones"
	@echo "make trust       attack what docs/guarantees.md promises, for two hours, and write the figures there"
	@echo "make lint        ruff, mypy, import-linter"
	@echo "make wheel       the wheel in dist/, which pip installs elsewhere with -c constraints.txt"
	@echo "make bench       what the stages of planning cost here"
	@echo "make clean       remove caches and builds; .venv and runs/ stay"

venv: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' \
		|| { echo "Python 3.11, 3.12, 3.13 or 3.14 (without OMPL) is needed: make venv PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
ifdef LOCKED
	$(BIN)/python -m pip install --quiet --require-hashes -r locked.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
else
	$(call install,-e .)
endif
	@touch $@

venv-dev: $(DEVELOPER)

$(DEVELOPER): $(STAMP)
	$(call install,-e $(ALL))
	@touch $@

# What follows is for those who change constraints.txt: hashes, licences and bill of materials, known vulnerabilities.
locked: venv-dev
	$(PIP) uv
	echo setuptools | $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
		--no-header --no-annotate --no-emit-index-url --no-emit-find-links \
		-c constraints.txt pyproject.toml - -o locked.txt

inventory: venv-dev
	$(PIP) pip-licenses cyclonedx-bom
	sed -i.old '/^| Name /,$$d' LICENSES.md && rm LICENSES.md.old
	$(BIN)/pip-licenses --with-system --from=mixed --format=markdown \
		--packages $$(sed -n 's/==.*//p' locked.txt) >> LICENSES.md
	$(BIN)/cyclonedx-py requirements locked.txt --pyproject pyproject.toml --output-reproducible -o sbom.json

# --strict: fails, rather than passes, where the database of vulnerabilities cannot be reached.
audit: venv-dev
	$(PIP) pip-audit
	$(BIN)/pip-audit --strict --require-hashes --disable-pip -r locked.txt

# From this folder, also while `venv-dev` installs the package again.
warmup: venv
	PYTHONPATH="$(CURDIR)" $(BIN)/cvqmpt warmup

reproduce: warmup
	@$(BIN)/cvqmpt reproduce place-task --problems 20 --seeds 1 --cutoff 3 --out runs/place-task-small
	@$(BIN)/cvqmpt reproduce place-task-ompl-tuning --problems 20 --out runs/place-task-ompl-small \
		--planners ompl-projected,ompl-uniform,ompl-cvq,ompl-opt-cvq,ompl-cvq-tuned
	@$(BIN)/cvqmpt report runs/place-task-small
	@echo "What ran: 20 problems of the place task with every planner, and the paper's experiment in OMPL on 20 other problems."
	@echo "What it shows: how many certified paths each planner finds, and how fast; for verdicts on the paper these are too few: $(BIN)/cvqmpt claims"
	@echo "What to do next: open the report in a browser, then plan for your arm: $(BIN)/cvqmpt problems new mine.json --robot ur5"

lint: venv-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check-tables: venv-dev warmup
	$(BIN)/cvqmpt check-tables

pytest: venv-dev
	$(BIN)/pytest -n 2 --dist worksteal

docs: venv-dev warmup
	$(BIN)/python docs/pages.py
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -c docs . build/site
	$(BIN)/python docs/compare_outputs.py build/jupyter_execute

notebooks: venv-dev warmup
	$(BIN)/python docs/run_notebooks.py

# Two steps run at a time: kernels are compiled while packages are installed, then two checks each. Tests
# come last, so that their summary is the last thing printed.
test: venv
	@failed=0; \
	$(MAKE) --no-print-directory --keep-going --output-sync=target -j2 venv-dev warmup docs lint check-tables \
		|| failed=1; \
	$(MAKE) --no-print-directory pytest || failed=1; \
	exit $$failed

# Each finding is recorded as soon as it is made.
trust: venv-dev warmup
	nice $(BIN)/pytest -n 2 --long --record docs/guarantees.md tests/fuzz tests/properties

# From nothing: setuptools would pack modules which an earlier build left in build/lib.
wheel: venv
	rm -rf build/lib build/bdist.* dist
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	@echo "pip install $$(echo dist/*.whl) -c constraints.txt"

bench: warmup
	$(BIN)/cvqmpt bench stages

clean:
	rm -rf build dist ./*.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +
