# One way to do each thing. Everything runs in .venv of this folder; nothing else on the computer is changed.
# A stamp file per lock file inside .venv remembers what is installed, so that setting up happens only when a lock changes.

PYTHON ?= python3
ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-input
RUN_READY := $(VENV)/.ready-run
DEV_READY := $(VENV)/.ready-dev
BENCH_VENV := .venv-bench
BENCH_READY := $(BENCH_VENV)/.ready
SITE_VENV := .venv-site
SITE_READY := $(SITE_VENV)/.ready
RELEASE_VENV := .venv-release
RELEASE_READY := $(RELEASE_VENV)/.ready
COMPILE := uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-header --no-annotate

.DEFAULT_GOAL := help
.PHONY: help demo test test-long lint fmt docs site pictures bench lock release clean
# Most of a test's time is waiting for ports and processes, so there are more workers than cores; each may take a gigabyte.
CORES := $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
GIGABYTES := $(shell awk '/MemAvailable/ {print int($$2 / 1000000)}' /proc/meminfo 2>/dev/null || echo 8)
WORKERS ?= $(shell n=$$(( $(CORES) * 2 )); m=$(or $(GIGABYTES),8); n=$$(( n < 8 ? n : 8 )); n=$$(( n < m ? n : m )); echo $$(( n > 1 ? n : 1 )))

help: ## list what can be made
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "Options go into ARGS: make demo ARGS=--help, make test ARGS='tests/service -k table'. Another Python: make test PYTHON=python3.12"

demo: $(RUN_READY) ## measure, correct and verify a simulated machine; writes a report
	@$(BIN)/abbe demo $(ARGS)

test: $(DEV_READY) ## all tests, side by side, 7 to 15 minutes on two cores; ARGS=FILE: only these, one after the other
	@env -u PYTHONDONTWRITEBYTECODE OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest $(or $(ARGS),-p tests.progress -n $(WORKERS) --dist loadfile --no-loadscope-reorder --timeout 400)

test-long: $(DEV_READY) ## hours: what is too long for every run, at full size; Ctrl-C stops it, and it goes on where it was
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.long $(ARGS)
	$(if $(ARGS),,@OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.experiments.campaigns.mutants)

lint: $(DEV_READY) ## style, formatting, types, import walls
	$(BIN)/ruff check --output-format concise
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

fmt: $(DEV_READY) ## sort imports and format
	$(BIN)/ruff check --fix-only --quiet
	$(BIN)/ruff format

docs: $(DEV_READY) ## write the pages of docs/ that come from the code: commands, Python, machine file, error codes, formats, faults, decisions, schemas
	@$(BIN)/python -m tests.project.cli_page
	@$(BIN)/python -m tests.project.machine_file_page
	@$(BIN)/python -m tests.project.device_file_page
	@$(BIN)/python -m tests.project.decisions_page
	@$(BIN)/python -m tests.project.python_page
	@$(BIN)/python -m tests.service.formats.page
	@$(BIN)/python -m tests.faults.page
	@$(BIN)/python -m abbe.service.web.catalogue > docs/reference/error-codes.md
	@$(BIN)/abbe schema

site: $(SITE_READY) ## README and docs/ as a site in build/site, with search, the notebooks run; it needs no server and no network
	@OPENBLAS_NUM_THREADS=1 $(SITE_VENV)/bin/python -W ignore -m sphinx -q -W --keep-going -c docs $(ARGS) . build/site
	@echo "build/site/index.html"

pictures: $(DEV_READY) ## take the pictures of docs/pictures and the layouts of tests/system/layouts anew; needs Chromium
	@ABBE_PICTURES=$(CURDIR)/docs/pictures OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest tests/system/test_pictures.py tests/system/test_layouts.py

bench: $(BENCH_READY) ## speed and memory of the fast paths against other libraries (own environment, .venv-bench)
	@ABBE_TEST_REQUIRE=numba,lmfit,GTC,uncertainties,sklearn,statsmodels $(BENCH_VENV)/bin/python -m pytest tests/experiments/kernel/test_kernel.py tests/experiments/test_bench_case.py tests/experiments/test_bench_trials.py tests/experiments/test_bench_discovery.py
	@$(BENCH_VENV)/bin/python -m tests.experiments.bench $(ARGS)

lock: ## pin the dependencies of pyproject.toml anew (ARGS=--upgrade for newer versions)
	@command -v uv >/dev/null || { echo "make lock needs uv, a Python package resolver: install it from your package source, then try again."; exit 1; }
	$(COMPILE) $(ARGS) pyproject.toml -o requirements.lock
	$(COMPILE) $(ARGS) --extra dev -c requirements.lock pyproject.toml -o requirements-dev.lock
	$(COMPILE) $(ARGS) --extra bench -c requirements-dev.lock pyproject.toml -o requirements-bench.lock
	$(COMPILE) $(ARGS) --extra site -c requirements.lock pyproject.toml -o requirements-site.lock
	$(COMPILE) $(ARGS) --extra release -c requirements.lock pyproject.toml -o requirements-release.lock

release: $(RELEASE_READY) ## source archive, wheel, bill of materials and wheelhouse in dist/, checked and tried without a network; a dry run
	@deploy/release.sh $(ARGS)

clean: ## remove caches and build products (.venv stays)
	rm -rf $(BENCH_VENV) $(RELEASE_VENV) $(SITE_VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find service drivers models simulators tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	|| { echo "Abbe needs Python 3.11 or newer, and '$(PYTHON)' is not: make ... PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
	|| { rm -rf $(VENV); echo "'$(PYTHON) -m venv' failed (see above); on Debian and Ubuntu it needs the package python3-venv."; exit 1; }

$(RUN_READY): requirements.lock pyproject.toml deploy/npm_files.py | $(BIN)/python
	@echo "setting up .venv from requirements.lock, about a minute"
	@$(PIP) --require-hashes -r requirements.lock
	@$(PIP) --no-deps --no-build-isolation -e .
	@$(BIN)/python deploy/npm_files.py uplot || true
	@touch $@

# The developers' lock holds everything of the users' lock (a test sees to it), so the second stamp is due as well.
$(DEV_READY): requirements-dev.lock requirements.lock pyproject.toml deploy/npm_files.py | $(BIN)/python
	@echo "setting up .venv from requirements-dev.lock, about a minute"
	@$(PIP) --require-hashes -r requirements-dev.lock
	@$(PIP) --no-deps --no-build-isolation -e .
	@$(BIN)/python deploy/npm_files.py || true
	@touch $(RUN_READY) $@

# The libraries that we compare with are no business of the product's environment.
$(BENCH_READY): requirements-bench.lock pyproject.toml | $(BIN)/python
	@echo "setting up $(BENCH_VENV) from requirements-bench.lock, about a minute"
	@$(BIN)/python -m venv $(BENCH_VENV)
	@$(BENCH_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-input --require-hashes -r requirements-bench.lock
	@$(BENCH_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-input --no-deps --no-build-isolation -e .
	@touch $@

# Sphinx runs the notebooks, so this environment holds Abbe as well.
$(SITE_READY): requirements-site.lock pyproject.toml | $(BIN)/python
	@echo "setting up $(SITE_VENV) from requirements-site.lock, about a minute"
	@$(BIN)/python -m venv $(SITE_VENV)
	@$(SITE_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-input --require-hashes -r requirements-site.lock
	@$(SITE_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-input --no-deps --no-build-isolation -e .
	@touch $@

# The tools of a release see the product's packages and add their own.
$(RELEASE_READY): requirements-release.lock pyproject.toml | $(BIN)/python
	@echo "setting up $(RELEASE_VENV) from requirements-release.lock, about a minute"
	@$(BIN)/python -m venv $(RELEASE_VENV)
	@$(RELEASE_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-input --require-hashes -r requirements-release.lock
	@touch $@
