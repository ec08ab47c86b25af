# `make help` lists the targets. Everything runs in .venv, from exact versions; nothing but Python and pip is needed.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

# The first Python that is new enough; PYTHON=... names another.
PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$python && break; done)
BIN := .venv/bin
# Where this is set, as in many containers, every command compiles all its modules again when it starts.
unexport PYTHONDONTWRITEBYTECODE
INSTALLED := .venv/.installed
LOCK := requirements/lock.txt
TYPED := schemas mesh bridges peers tests bench examples documentation
# Processes that run the tests. They wait more than they compute, so there are two for each core; 0 runs all in one.
JOBS ?= $(shell echo $$((2 * $$(getconf _NPROCESSORS_ONLN))))
# CI measures coverage, which takes time.
COVERAGE := $(if $(filter true,$(CI)),--cov --cov-report=term --durations=10)
# A busy machine may delay or drop what a test waits for. At most eight tests run a second time, each with its traceback.
RERUNS := --reruns 1 --max-suite-reruns 8 --rerun-show-tracebacks

.PHONY: help setup demo test simulate simulate-mutants compose-test crash-test lint peers bench contracts contracts-check \
	page page-check slither firmware docs pictures lock release upgrade-sample clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(INSTALLED) ## the virtual environment with everything in it

define NEEDS_PYTHON
$(or $(PYTHON),false) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	{ echo "Python 3.11 or later is needed, and $(or $(PYTHON),python3) is: $$($(or $(PYTHON),python3) --version 2>&1)" >&2; exit 1; }
endef

# The lock lists every package, so nothing is resolved: older pips would take a newer version of a package with extras.
# Made again when the exact versions or the project's own metadata change; otherwise there is nothing to do.
$(INSTALLED): $(LOCK) pyproject.toml
	@$(NEEDS_PYTHON)
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| { echo "$(PYTHON) has no venv module; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@rm -f $@
	@$(PYTHON) -m venv .venv
	@echo "installing into .venv ..."
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r $(LOCK)
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@$(BIN)/pip check --quiet --disable-pip-version-check
	@touch $@

demo: $(INSTALLED) ## a whole market on this machine, in one process; ARGS="..." are passed on
	@$(BIN)/aira demo $(ARGS)

test: $(INSTALLED) ## the tests, without containers; ARGS="-k name" chooses some
	@$(BIN)/pytest -n $(JOBS) --dist loadfile -m "not compose" $(RERUNS) $(COVERAGE) $(ARGS)

simulate: $(INSTALLED) ## whole markets in simulated time, with faults; ARGS="--seed N --jobs J --json"
	@$(BIN)/python -m tests.simulation $(ARGS)

simulate-mutants: $(INSTALLED) ## whether the simulator finds the bugs planted by tests/simulation/mutations.py
	@$(BIN)/python -m tests.simulation --mutants --seed 1 $(ARGS)

compose-test: $(INSTALLED) ## the compose files in real containers (`make peers` installs Docker)
	@$(BIN)/pytest -m compose tests/deploy tests/support $(ARGS)

crash-test: $(INSTALLED) ## the crash matrix: each role fails at each point of a job, by each fault (a quarter of an hour)
	@CRASH_CELLS=$${CRASH_CELLS:-all} $(BIN)/pytest -v tests/crashes -n 3 $(ARGS)

lint: $(INSTALLED) ## style, types, the import rule, and the built contracts and page where node is there
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy $(wildcard $(TYPED))
	@$(BIN)/lint-imports --no-cache
	@if command -v npm > /dev/null; then $(MAKE) --no-print-directory contracts-check page-check; \
		else echo "contracts and page not checked: npm is not installed"; fi

peers: ## the real programs that some tests run against
	@$(NEEDS_PYTHON)
	@$(PYTHON) -m peers.install

bench: $(INSTALLED) ## what the mesh and the contracts can do here; ARGS="book rpc" chooses; fails where a bar is missed
	@$(BIN)/python bench/record.py $(ARGS)

contracts/node_modules/.package-lock.json: contracts/package-lock.json
	@npm --prefix contracts ci --no-audit --no-fund
	@touch $@

contracts: contracts/node_modules/.package-lock.json ## compile the Solidity sources into mesh/chain/artifacts
	@npm --prefix contracts run build

contracts-check: contracts/node_modules/.package-lock.json ## whether the built artifacts are those of the sources
	@npm --prefix contracts run check

bridges/web/app/node_modules/.package-lock.json: bridges/web/app/package-lock.json
	@npm --prefix bridges/web/app ci --no-audit --no-fund
	@touch $@

page: bridges/web/app/node_modules/.package-lock.json ## build the page of `aira web` into bridges/web/static
	@npm --prefix bridges/web/app run build

page-check: bridges/web/app/node_modules/.package-lock.json ## whether the built page is that of its sources
	@npm --prefix bridges/web/app run check
	@npm --prefix bridges/web/app test

slither: contracts/node_modules/.package-lock.json ## look for weaknesses in the contracts (`make peers` installs Slither)
	@slither=$$($(PYTHON) -m peers.where slither) && SLITHER=$$slither npm --prefix contracts run --silent slither

firmware: $(INSTALLED) ## compile the sketches of the examples into build/firmware (`make peers` installs the AVR tools)
	@$(BIN)/python -m bridges.serial.firmware examples/*/*_frames examples/*/*_rosserial -o build/firmware -L examples/firmware

# What builds the site has an environment of its own: no program here needs any of it.
DOCS_TOOLS := build/docs-tools/.installed

$(DOCS_TOOLS): requirements/docs.txt
	@$(NEEDS_PYTHON)
	@rm -rf $(@D)
	@$(PYTHON) -m venv $(@D)
	@$(@D)/bin/pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r $<
	@touch $@

docs: $(INSTALLED) $(DOCS_TOOLS) ## the documentation as a site, in build/docs/site; a warning or a broken link fails
	@$(BIN)/python -m documentation

pictures: $(INSTALLED) ## the pictures of the page in docs/pictures, from its tests in Chromium (`make peers` installs it)
	@mkdir -p build/pictures
	@CI=true PAGE_PICTURES=$(CURDIR)/build/pictures $(BIN)/pytest -q -n $(JOBS) --dist loadfile tests/web/test_page.py \
		tests/web/test_robots.py tests/web/test_order_form.py tests/test_tutorials.py
	@$(BIN)/python -m documentation.pictures build/pictures

COMPILE_FLAGS := --universal --python-version 3.11 --generate-hashes --upgrade --quiet \
	--no-header --no-annotate --no-emit-index-url --no-emit-find-links
COMPILE := uv pip compile pyproject.toml $(COMPILE_FLAGS)

# Of the same versions, what the images need.
lock: ## update the locked versions (needs uv)
	@$(COMPILE) --extra dev --output-file $(LOCK)
	@$(COMPILE) --constraint $(LOCK) --extra serial --extra metrics --output-file requirements/edge.txt
	@$(COMPILE) --constraint $(LOCK) --extra chain --extra identity --extra ipfs --extra metrics --extra web \
		--output-file requirements/server.txt
	@uv pip compile --group pyproject.toml:docs $(COMPILE_FLAGS) --output-file requirements/docs.txt

release: $(INSTALLED) ## wheel, sdist, SBOM, notes and checksums in dist/, built twice and tried; ARGS=--no-try builds only
	@$(BIN)/python .ci/release $(ARGS)

upgrade-sample: $(INSTALLED) ## what this version keeps, for the upgrade test of later ones, in tests/upgrade
	@$(BIN)/python -m tests.upgrade.make

clean: ## remove what the targets above have made here; the peers' cache stays
	@rm -rf .venv build dist *.egg-info .coverage .coverage.* htmlcov \
		.pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis contracts/node_modules \
		bridges/web/app/node_modules
